"""In which directions, and when, a turning scanner measures: patterns of known scanners, and one found from a scan."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int, Int64
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.sweeps import SweepTiming

MOST_RINGS = 256
MOST_FIRINGS = 8192
TEN_TURNS = SweepTiming(turn_s=0.1)
"""Ten turns a second, clockwise; forward at the scan's own time."""
_FAR_M = 8.0
"""Rings' elevations are measured beyond this distance: nearer, a beam's place on the scanner turns its direction."""
_LEAST_OF_RING = 20
"""A ring has so many points at least."""
_WIDEST_RING_RAD = math.radians(0.6)
"""The middle half of a ring's far points lies within this elevation."""
_GAP_RAD = math.radians(0.02)
"""Where rings are told apart by elevation alone, there is an empty gap of this between them."""


@dataclass(frozen=True, eq=False)
class ScanPattern:
    """The directions of a turning scanner's measurements: every ring at every firing."""

    name: str
    elevation_rad: Float64[np.ndarray, "rings"]
    """Of each ring above the scanner's xy plane, from the highest to the lowest."""
    firings: int
    """Measurements of a ring in a turn, evenly spread."""
    reach_m: float
    """Nothing beyond is measured."""
    timing: SweepTiming = TEN_TURNS
    """How long a turn takes, its direction, and which azimuth is measured at the scan's own time."""

    @property
    def azimuth_rad(self) -> Float64[np.ndarray, "firings"]:
        """Of each firing, counter-clockwise from x, in order of time; the middle of the turn is its reference."""
        share = (np.arange(self.firings) + 0.5) / self.firings - 0.5
        turned = 2 * np.pi * (-share if self.timing.clockwise else share)
        return turned + self.timing.reference_azimuth_rad

    @property
    def offset_s(self) -> Float64[np.ndarray, "firings"]:
        """When each firing is, counted from the scan's own time."""
        return ((np.arange(self.firings) + 0.5) / self.firings - 0.5) * self.timing.turn_s

    @property
    def directions(self) -> Float64[np.ndarray, "rings firings 3"]:
        """Unit vectors in the scanner's frame: x forward, y left, z up."""
        level, azimuth = np.cos(self.elevation_rad)[:, None], self.azimuth_rad[None]
        up = np.broadcast_to(np.sin(self.elevation_rad)[:, None], (len(self.elevation_rad), self.firings))
        return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=-1)

    def columns(self, points_m: Float64[np.ndarray, "points 3"]) -> Int64[np.ndarray, "points"]:
        """Which firing measured each point, by its azimuth."""
        turned = np.arctan2(points_m[:, 1], points_m[:, 0]) - self.timing.reference_azimuth_rad
        share = (-turned if self.timing.clockwise else turned) / (2 * np.pi) + 0.5
        return np.floor((share % 1.0) * self.firings).astype(np.int64) % self.firings


def _even(highest_deg: float, lowest_deg: float, rings: int) -> NDArray[np.float64]:
    return np.radians(np.linspace(highest_deg, lowest_deg, rings))


SENSORS: dict[str, ScanPattern] = {
    "hdl-64": ScanPattern("hdl-64", np.concatenate([_even(2.0, -8.33, 32), _even(-8.83, -24.33, 32)]), 2083, 120.0),
    "vlp-16": ScanPattern("vlp-16", _even(15.0, -15.0, 16), 1800, 100.0),
    "os1-128": ScanPattern("os1-128", _even(22.5, -22.5, 128), 2048, 120.0),
}
"""Scanners by their makers' data sheets, at ten turns a second: Velodyne's HDL-64E S2 (two blocks of beams) and VLP-16,
Ouster's OS1-128."""


def rings_of(points_m: Float64[np.ndarray, "points 3"], where: str) -> Int64[np.ndarray, "points"]:
    """Find which ring measured each point of a scan, from the highest ring, 0, to the lowest.

    A file lists either ring after ring, each of which is a turn, or rings that differ in elevation.

    Raises:
        InputError: no rings can be told apart; names `where`.
    """
    elevation = np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1]))
    for found in (_turns(points_m), _levels(elevation)):
        if found is None or not 1 < found.max() + 1 <= MOST_RINGS:
            continue
        counts = np.bincount(found)
        if counts.min() < _LEAST_OF_RING or not _are_level(elevation, found, points_m):
            continue
        middles = np.array([np.median(elevation[found == ring]) for ring in range(len(counts))])
        place = np.empty(len(counts), np.int64)
        place[np.argsort(-middles, kind="stable")] = np.arange(len(counts))
        return place[found]
    raise InputError(
        f"{where}: the rings of its {len(points_m)} points cannot be told apart, neither by their order nor by their "
        "elevation. Expected a whole scan of a turning scanner with several rings, as recorded, not corrected for the "
        f"vehicle's motion. Or name a scanner: --sensor {', '.join(SENSORS)}."
    )


def _turns(points_m: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Number the turns that the points make in the file's order; None if most steps do not go one way."""
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    way = np.sign(np.median(step))
    if way == 0 or (step * way > 0).mean() < 0.9:
        return None
    # where the azimuth begins again, wherever that is: the sum of all steps, cut at whole turns from the first point
    turned = np.concatenate([[0.0], np.cumsum(np.where(step * way > -0.5, step * way, step * way + 2 * np.pi))])
    return np.floor(turned / (2 * np.pi) + 1e-6).astype(np.int64)


def _levels(elevation: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """Number the elevations that empty gaps separate."""
    order = np.argsort(elevation)
    level = np.concatenate([[0], np.cumsum(np.diff(elevation[order]) > _GAP_RAD)])
    counts = np.bincount(level)
    # a stray point or two between rings are no ring
    big = counts >= _LEAST_OF_RING
    if not big.any() or counts[~big].sum() > 0.02 * len(elevation):
        return None
    nearest = np.maximum(np.cumsum(big) - 1, 0)
    found = np.empty(len(elevation), np.int64)
    found[order] = nearest[level]
    return found


def _are_level(elevation: NDArray[np.float64], ring: NDArray[np.int64], points_m: NDArray[np.float64]) -> bool:
    """Whether far points of each ring have about one elevation."""
    far = np.linalg.norm(points_m, axis=1) > _FAR_M
    widths = []
    for number in range(ring.max() + 1):
        of_ring = elevation[(ring == number) & far]
        if len(of_ring) >= _LEAST_OF_RING:
            low, high = np.quantile(of_ring, (0.25, 0.75))
            widths.append(high - low)
    return not widths or float(np.median(widths)) < _WIDEST_RING_RAD


def elevations_of(
    points_m: Float64[np.ndarray, "points 3"], ring: Int[np.ndarray, "points"]
) -> Float64[np.ndarray, "rings"]:
    """Elevations of the rings of a scan, radians: medians, of far points where there are enough."""
    far = np.linalg.norm(points_m, axis=1) > _FAR_M
    elevation = np.arctan2(points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1]))
    found = []
    for number in range(ring.max() + 1):
        chosen = ring == number
        chosen = chosen & far if (chosen & far).sum() >= _LEAST_OF_RING else chosen
        found.append(np.median(elevation[chosen]))
    return np.array(found)


def place_among(elevations: Float64[np.ndarray, "rings"], every: Float64[np.ndarray, "beams"]) -> int | None:
    """Give which of all beams of a scanner measured the highest ring of a scan: where the sky is open, it is not 0.

    None: the scan has more rings than these beams.
    """
    places = range(len(every) - len(elevations) + 1)
    off = [float(np.median(np.abs(elevations - every[place : place + len(elevations)]))) for place in places]
    return int(np.argmin(off)) if off else None


def pattern_of_scan(
    points_m: Float64[np.ndarray, "points 3"],
    ring: Int[np.ndarray, "points"],
    timing: SweepTiming | None,
    where: str,
) -> ScanPattern:
    """Find the pattern of a recorded scan.

    Args:
        points_m: of a whole turn, in the scanner's frame.
        ring: of each point, as `rings_of` finds them.
        timing: when which azimuth was measured; None: `TEN_TURNS`.
        where: names the scan in errors.

    Raises:
        InputError: its points do not lie at regular azimuths.
    """
    distance = np.linalg.norm(points_m, axis=1)
    azimuth = np.arctan2(points_m[:, 1], points_m[:, 0])
    # two echoes of one firing have no step between them
    every = np.concatenate([np.diff(np.sort(azimuth[ring == number])) for number in range(ring.max() + 1)])
    every = every[every > 2 * np.pi / MOST_FIRINGS / 2]
    firings = round(2 * np.pi / float(np.median(every))) if len(every) else 0
    if not _LEAST_OF_RING <= firings <= MOST_FIRINGS:
        raise InputError(
            f"{where}: {firings} measurements of a ring in a turn, expected {_LEAST_OF_RING} to {MOST_FIRINGS}. "
            f"Name a scanner: --sensor {', '.join(SENSORS)}."
        )
    return ScanPattern("recorded", elevations_of(points_m, ring), firings, float(distance.max()), timing or TEN_TURNS)
