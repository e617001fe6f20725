"""How bright a scanner finds places: what its training sweeps measured around them, as each beam measures it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy.typing import NDArray
from scipy.spatial import KDTree

from edge_depth_nerf.scene.sweeps import UNKNOWN_RING, SceneScanner

CELL_M = 0.1
"""Points of one cube are one: their mean."""
NEIGHBOURS = 4
LEAST_M = 0.05
"""Neighbours weigh by their distance, none more than one this far away."""
RANGES = 14
"""Parts of the distance, two for each doubling from 1 m."""
MOST_POINTS = 4_000_000
"""More are not learned from; each takes 165 bytes meanwhile."""
LEAST_POINTS = 50
"""A beam at a range with fewer points is taken as all beams together."""


class Intensities:
    """Looks up intensities of places in the scene.

    Each beam of a real scanner has a gain of its own, and what it measures falls with distance. So measurements are
    compared as deviations from what their beam measures at their range, in its standard deviations.
    """

    def __init__(
        self,
        points_m: Float[np.ndarray, "points 3"],
        intensity: Float[np.ndarray, "points"],
        ring: Int[np.ndarray, "points"],
        distance_m: Float[np.ndarray, "points"],
    ) -> None:
        """Take places, what was measured there, by which ring and from how far; at least one."""
        self._rings = max(int(ring.max()) + 1, 0)
        group = self._group(ring, distance_m)
        self._mean, self._spread = self._usual(group, intensity.astype(np.float64))
        cells = np.floor(points_m / CELL_M).astype(np.int64)
        cells -= cells.min(axis=0)
        sizes = cells.max(axis=0) + 1
        _, cell, count = np.unique(np.ravel_multi_index(cells.T, sizes), return_inverse=True, return_counts=True)

        def mean(values: NDArray) -> NDArray:
            return np.bincount(cell, values) / count

        self._deviation = mean((intensity - self._mean[group]) / self._spread[group])
        self._tree = KDTree(np.stack([mean(points_m[:, axis]) for axis in range(3)], axis=-1))

    def _group(self, ring: NDArray[Any], distance_m: NDArray[Any]) -> NDArray[np.int64]:
        """Number the ring and range of measurements; rings that were not seen are the last one."""
        rows = np.where((ring > UNKNOWN_RING) & (ring < self._rings), ring, self._rings).astype(np.int64)
        return rows * RANGES + np.clip(2 * np.log2(np.maximum(distance_m, 1.0)), 0, RANGES - 1).astype(np.int64)

    def _usual(self, group: NDArray[np.int64], intensity: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Give mean and standard deviation of each ring at each range; in the last row those of all rings."""
        sums = np.stack(
            [
                np.bincount(group, weights, (self._rings + 1) * RANGES).reshape(-1, RANGES)
                for weights in (np.ones_like(intensity), intensity, intensity**2)
            ]
        )
        sums[:, -1] = sums.sum(axis=1)
        # at a range that nothing was measured at: as at all ranges
        sums[:, -1] = np.where(sums[0, -1] >= LEAST_POINTS, sums[:, -1], sums[:, -1].sum(axis=1, keepdims=True))
        sums = np.where(sums[0] >= LEAST_POINTS, sums, sums[:, -1:])
        mean = sums[1] / sums[0]
        spread = np.sqrt(np.maximum(sums[2] / sums[0] - mean**2, 1e-12))
        return mean.reshape(-1), spread.reshape(-1)

    @classmethod
    def learned(cls, scanner: SceneScanner) -> Intensities | None:
        """Learn from the sweeps that training saw; None if the scanner measures no intensity."""
        parts: list[tuple[NDArray, ...]] = []
        training, rng = [sweep for sweep in scanner.sweeps if not sweep.held_out], np.random.default_rng(0)
        for sweep in training:
            rays = sweep.read()
            of = np.flatnonzero(~rays.held_out)
            of = rng.permutation(of)[: MOST_POINTS // len(training)]
            parts.append((rays.points_m[of], rays.intensity[of], rays.ring[of], rays.distance_m[of]))
        if not parts:
            return None
        points_m, intensity, ring, distance_m = (np.concatenate(each) for each in zip(*parts, strict=True))
        if not len(intensity) or np.ptp(intensity) == 0:
            return None
        return cls(points_m, intensity, ring, distance_m)

    def at(
        self,
        points_m: Float[np.ndarray, "points 3"],
        ring: Int[np.ndarray, "points"],
        distance_m: Float[np.ndarray, "points"],
    ) -> Float32[np.ndarray, "points"]:
        """Give the intensities of places in the scene, in the recording's unit.

        Args:
            points_m: the places.
            ring: of the drive's scanner; -1: of another one.
            distance_m: from the scanner.
        """
        ranks: Any = [*range(1, min(NEIGHBOURS, len(self._deviation)) + 1)]
        away_m, nearest = self._tree.query(points_m, k=ranks, workers=-1)
        weight: NDArray = 1 / np.maximum(away_m, LEAST_M)
        deviation = (weight * self._deviation[nearest]).sum(axis=1) / weight.sum(axis=1)
        group = self._group(ring, distance_m)
        return (self._mean[group] + self._spread[group] * deviation).astype(np.float32)
