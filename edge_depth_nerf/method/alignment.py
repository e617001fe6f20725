"""Monocular distance fitted to LiDAR, frame by frame: first one curve for the picture, then a smooth local correction.

Pure. Maps are H×W metres along the ray, 0 = none. The curve is a line in logarithms, log d = scale + exponent · log m,
fitted robustly (on rendered drives it is better than a line in inverse distance); beyond the distances that have
LiDAR points it continues as a factor. Its residual, log d - log m, is spread from the LiDAR points over the picture on
a pyramid of coarse grids over column, row and log m, so that it crosses no edge of the monocular map. A cell's value is
the mean over its LiDAR points. An imagined point draws it to the value of the coarser cell around it; the coarsest is
drawn to 0 the same way, so the correction vanishes where there are no LiDAR points. Only the frame's own LiDAR points
decide: nothing of another frame is used, except the drive's fit where a frame has too few of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from edge_depth_nerf.base.pictures import is_distance
from edge_depth_nerf.method.integration import check_choice, check_maps

Align = Literal["none", "global", "local"]

LEAST_POINTS = 50
"""With fewer LiDAR points a frame takes the drive's fit."""
EXPONENT_RANGE = (0.5, 2.0)
"""The exponent stays within: beyond, the map has nothing to do with the distances."""
BEYOND_SHARE = 0.005
"""This share of the LiDAR points, at either end, is left out of the curve's range."""
OUTLIER_SCALE = 8.0
"""A residual of so many robust standard deviations counts a quarter (the weight is 1 / (1 + u²)²)."""

FINEST_CELL_SHARE = 1 / 175
"""Side of the finest cells as a share of the picture's longer side (8 px of 1400)."""
FINEST_CELL_LOG = 0.07
"""Depth of the finest cells in log m; that of all coarser ones is twice as much, a factor of 1.15 in distance."""
LEVELS = 6
"""Grids of the pyramid; each has cells of twice the side of the one below, the coarsest of a fifth of the picture."""
IMAGINED_POINTS = 0.2
"""So many imagined LiDAR points with the coarser cell's value are added to each cell."""
IMAGINED_FOR_OUTLIERS = 0.5
"""The same in the search for outliers: a LiDAR point alone in its cell is compared with those around."""


@dataclass(frozen=True)
class Fit:
    """d = exp(log_scale) · m ** exponent where it was fitted; beyond, d/m keeps its value at the end of that range.

    A floor just before the camera has no LiDAR points: an exponent continued to a tenth of the least fitted distance
    would be a guess.
    """

    log_scale: float = 0.0
    """Logarithm of the distance in metres that 1 m of the map stands for."""
    exponent: float = 1.0
    """1 for a map that is wrong by a factor alone."""
    least_log: float = -20.0
    """Logarithm of the map's least distance that it was fitted to, metres."""
    largest_log: float = 20.0
    """The same of the largest."""

    def apply(self, mono_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Apply the fit to distances; what is not a positive number becomes 0."""
        known = is_distance(mono_m)
        if self == Fit():
            return np.where(known, mono_m, 0).astype(np.float32)
        logs = np.log(np.where(known, mono_m, 1))
        fitted = np.clip(logs, self.least_log, self.largest_log)
        return np.where(known, np.exp(self.log_scale + self.exponent * fitted + logs - fitted), 0).astype(np.float32)


@dataclass(frozen=True)
class Aligned:
    """A monocular map fitted to LiDAR."""

    mono_m: Float[np.ndarray, "h w"]
    """float32 metres, 0 = none."""
    fit: Fit
    """The picture's curve, before the local correction."""
    fit_of: Literal["none", "frame", "drive"]
    """Whose LiDAR points made it. drive: the frame has fewer than LEAST_POINTS; there is no local correction then."""
    lidar_points: int
    """Pixels that have both LiDAR and mono."""


def both(
    lidar_m: Float[np.ndarray, "h w"], mono_m: Float[np.ndarray, "h w"], valid: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Find where both maps have a distance and the picture may be used.

    Raises:
        InputError: the maps differ in size.
    """
    check_maps("alignment", lidar_m=lidar_m, mono_m=mono_m, valid=valid)
    return valid & is_distance(lidar_m) & is_distance(mono_m)


def fit_logs(lidar_m: Float[np.ndarray, "n"], mono_m: Float[np.ndarray, "n"]) -> Fit:
    """Fit scale and exponent, robust against outliers (iteratively reweighted least squares, Geman-McClure weights).

    Distances of LiDAR points, at least one, and the map at the same pixels are positive.
    """
    x, y = np.log(mono_m.astype(np.float64)), np.log(lidar_m.astype(np.float64))
    middle = float(np.median(x))
    x = x - middle
    slope, at_middle = 1.0, float(np.median(y - x))
    # a map of one distance says nothing about the exponent: it is held to 1, as by distances that differ by 1 %
    hold = 1e-4 * len(x)
    for _ in range(12):
        weight = robust_weights(y - at_middle - slope * x, least_spread=1e-4)
        total = weight.sum()
        mean_x, mean_y = (weight * x).sum() / total, (weight * y).sum() / total
        covariance = (weight * (x - mean_x) * (y - mean_y)).sum()
        variance = (weight * (x - mean_x) ** 2).sum()
        slope = float(np.clip((covariance + hold) / (variance + hold), *EXPONENT_RANGE))
        at_middle = float(mean_y - slope * mean_x)
    least_log, largest_log = np.quantile(x + middle, (BEYOND_SHARE, 1 - BEYOND_SHARE)).tolist()
    return Fit(at_middle - slope * middle, slope, least_log, largest_log)


def align(
    lidar_m: Float[np.ndarray, "h w"],
    mono_m: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    mode: Align = "local",
    drive_fit: Fit | None = None,
) -> Aligned:
    """Fit a frame's monocular map to its LiDAR.

    Args:
        lidar_m: LiDAR distance, 0 = no LiDAR point.
        mono_m: monocular distance, 0 = none.
        valid: True where the picture may be used.
        mode: none leaves the map unchanged; global fits scale and exponent; local corrects what they leave.
        drive_fit: used for a frame with fewer than LEAST_POINTS LiDAR points; None leaves its map unchanged.

    Raises:
        InputError: the maps differ in size, or the mode is unknown.
    """
    check_choice("align", mode, Align)
    lidar_points = both(lidar_m, mono_m, valid)
    count = int(lidar_points.sum())
    if mode == "none":
        return Aligned(Fit().apply(mono_m), Fit(), "none", count)
    if count < LEAST_POINTS:
        fit = drive_fit or Fit()
        return Aligned(fit.apply(mono_m), fit, "none" if drive_fit is None else "drive", count)
    fit = fit_logs(lidar_m[lidar_points], mono_m[lidar_points])
    aligned = fit.apply(mono_m)
    if mode == "local":
        aligned = _correct(aligned, lidar_m, lidar_points, valid)
    return Aligned(aligned, fit, "frame", count)


def robust_weights(residual: NDArray, least_spread: float) -> NDArray:
    """Geman and McClure's weights, by the residuals' own spread; an outlier weighs next to nothing."""
    if not residual.size:
        return np.ones(0)
    spread = max(least_spread, 1.4826 * float(np.median(np.abs(residual))))
    return 1 / (1 + (residual / (OUTLIER_SCALE * spread)) ** 2) ** 2


def _correct(
    mono_m: NDArray[np.float32], lidar_m: NDArray[np.float32], lidar_points: NDArray[np.bool_], valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Add the local correction to a fitted map."""
    wanted = valid & (mono_m > 0)
    log_m = np.log(np.where(wanted, mono_m, 1))
    pyramid = _Pyramid(mono_m.shape, float(log_m[wanted].min()), float(log_m[wanted].max()))
    log_at_points = log_m[lidar_points]
    residual = np.log(lidar_m[lidar_points]) - log_at_points
    places = pyramid.places(lidar_points, log_at_points)
    # an outlier is one against its neighbours, not against the picture: twice weighted anew
    weight = robust_weights(residual, least_spread=0.1)
    for _ in range(2):
        left = residual - pyramid.read(pyramid.grid(places, residual, weight, IMAGINED_FOR_OUTLIERS), places)
        weight = robust_weights(left, least_spread=1e-3)
    correction = pyramid.read(
        pyramid.grid(places, residual, weight, IMAGINED_POINTS), pyramid.places(wanted, log_m[wanted])
    )
    corrected = mono_m.copy()
    corrected[wanted] *= np.exp(correction)
    return corrected


class _Pyramid:
    """Grids over log m, row and column."""

    def __init__(self, shape: tuple[int, ...], least_log: float, largest_log: float):
        self.cell_px = max(2.0, FINEST_CELL_SHARE * max(shape))
        self.least_log = least_log
        sizes = (largest_log - least_log) / FINEST_CELL_LOG, shape[0] / self.cell_px, shape[1] / self.cell_px
        # whole cells of the coarsest grid, so that the grids nest
        blocks = (2, 1 << (LEVELS - 1), 1 << (LEVELS - 1))
        self.shape = [block * (math.floor(size / block) + 1) for size, block in zip(sizes, blocks, strict=True)]

    def places(self, pixels: NDArray[np.bool_], log_m: NDArray[np.float32]) -> Float[torch.Tensor, "3 n"]:
        """Place some pixels (H×W, True; log m of each) in the finest grid: log m, row, column, in cells."""
        row, column = np.nonzero(pixels)
        place = np.empty((3, len(row)), np.float32)
        place[0] = (log_m - self.least_log) / FINEST_CELL_LOG
        place[1] = (row + 0.5) / self.cell_px
        place[2] = (column + 0.5) / self.cell_px
        return torch.from_numpy(place)

    def grid(
        self, places: torch.Tensor, value: NDArray, weight: NDArray, imagined: float
    ) -> Float[torch.Tensor, "1 1 z y x"]:
        """Compute corrections of the finest grid's cells."""
        z, y, x = places.long().numpy()
        cell = (z * self.shape[1] + y) * self.shape[2] + x
        sums = np.stack([np.bincount(cell, part, math.prod(self.shape)) for part in (weight * value, weight)])
        levels = [torch.from_numpy(sums).float().reshape(1, 2, *self.shape)]
        for number in range(LEVELS - 1):
            kernel = (2 if number == 0 else 1, 2, 2)
            levels.append(math.prod(kernel) * torch.nn.functional.avg_pool3d(levels[-1], kernel))
        correction = torch.zeros_like(levels[-1][:, :1])
        for level in reversed(levels):
            coarser = torch.nn.functional.interpolate(correction, size=level.shape[2:], mode="trilinear")
            correction = (level[:, :1] + imagined * coarser) / (level[:, 1:] + imagined)
        return correction

    def read(self, grid: torch.Tensor, places: torch.Tensor) -> Float[np.ndarray, "n"]:
        """Interpolate corrections between the centres of cells."""
        scale = torch.tensor(self.shape, dtype=torch.float32)[:, None]
        points = (places * (2 / scale) - 1).flip(0).T[None, None, None]
        return torch.nn.functional.grid_sample(
            grid, points, mode="bilinear", padding_mode="border", align_corners=False
        ).numpy()[0, 0, 0, 0]
