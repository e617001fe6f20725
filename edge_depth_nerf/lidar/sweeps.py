"""LiDAR sweeps: the points of one turn of a scanner.

Coordinates are metres in the scanner's frame (x forward, y left, z up), as recorded: the vehicle moves during a
turn, and nothing is corrected for that here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from edge_depth_nerf.base.errors import InputError

MIN_RANGE_M = 0.5
"""Nearer than this a scanner measures nothing: such a point stands for a missing echo, or lies on its housing."""
MAX_RANGE_M = 255.0
"""Beyond this a distance map cannot hold the value; no scanner on a car measures so far."""
MAX_POINTS = 5_000_000
"""A file of more points is no single scan."""
_CELL_BITS = 21
"""Bits of a cube's number along one axis."""


@dataclass(frozen=True)
class SweepTiming:
    """When a turning scanner measures which direction; it measures its reference azimuth at the sweep's own time."""

    turn_s: float
    clockwise: bool = True
    """Seen from above, from the +z axis."""
    reference_azimuth_rad: float = 0.0
    """Counter-clockwise from x. Half a turn from it the sweep begins and ends."""

    def offsets_s(self, points_m: Float[Tensor, "points 3"]) -> Float[Tensor, "points"]:
        """When each point was measured, counted from the sweep's own time: -turn_s/2 to turn_s/2."""
        azimuth = torch.atan2(points_m[:, 1], points_m[:, 0]) - self.reference_azimuth_rad
        turns = torch.remainder(azimuth / (2 * math.pi) + 0.5, 1.0) - 0.5
        return turns * (-self.turn_s if self.clockwise else self.turn_s)


@dataclass(frozen=True)
class Sweep:
    """The usable points of one turn of the scanner."""

    points_m: Float[Tensor, "points 3"]
    """Scanner frame, float64, in the file's order."""
    reflectance: Float[Tensor, "points"]
    """0 to 1."""
    not_finite: int
    """How many points were left out because a coordinate is NaN or infinite."""
    out_of_range: int
    """How many points were left out because they lie nearer than 0.5 m (zeros among them) or beyond 255 m."""
    offset_s: Float[Tensor, "points"] | None = None
    """When each point was measured, counted from the sweep's own time, if the file gives it; float64."""
    too_far: int = 0
    """How many of the points out of range lie beyond 255 m."""


BEAM_RAD = math.radians(0.4)
"""Height of the bands of elevation in which beams are held out."""


def held_out_beams(sweep: Sweep, one_of: int) -> Bool[Tensor, "points"]:
    """Say which points lie in every `one_of`-th band of elevation, `BEAM_RAD` high.

    The same bands of every sweep, whatever the scanner: what lies between its rings is what is asked for.
    """
    elevation = torch.atan2(sweep.points_m[:, 2], sweep.points_m[:, :2].norm(dim=-1))
    return torch.remainder(torch.floor(elevation / BEAM_RAD), one_of) == one_of // 2


def without_beams(sweep: Sweep, one_of: int) -> tuple[Sweep, Sweep]:
    """Split a sweep into what is kept and `held_out_beams`."""
    held_out = held_out_beams(sweep, one_of)

    def part(chosen: Tensor) -> Sweep:
        offset_s = None if sweep.offset_s is None else sweep.offset_s[chosen]
        return replace(sweep, points_m=sweep.points_m[chosen], reflectance=sweep.reflectance[chosen], offset_s=offset_s)

    return part(~held_out), part(held_out)


def usable_points(
    path: Path,
    points_m: Float[Tensor, "points 3"],
    reflectance: Float[Tensor, "points"],
    offset_s: Float[Tensor, "points"] | None = None,
) -> Sweep:
    """Leave out and count what is not a measured point: NaN and infinity, zeros, what is too near or too far.

    Raises:
        InputError: nothing is left; names `path`.
    """
    finite = torch.isfinite(points_m).all(-1)
    if offset_s is not None:
        finite &= torch.isfinite(offset_s)
    range_m = points_m.norm(dim=-1)
    # NaN compares as false
    usable = finite & (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
    if not usable.any():
        raise InputError(
            f"{path}: none of its {len(points_m)} points can be used ({int((~finite).sum())} are NaN or infinite, the "
            f"others are nearer than {MIN_RANGE_M} m or beyond {MAX_RANGE_M:.0f} m). Set metres_per_unit if they are "
            "in another unit; else copy the file again, or delete it so that its frame is skipped."
        )
    return Sweep(
        points_m=points_m[usable],
        reflectance=reflectance[usable],
        not_finite=int((~finite).sum()),
        out_of_range=int((finite & ~usable).sum()),
        offset_s=None if offset_s is None else offset_s[usable],
        too_far=int((finite & (range_m > MAX_RANGE_M)).sum()),
    )


def first_in_voxel(points_m: Float[np.ndarray, "points 3"], voxel_m: float) -> Int64[np.ndarray, "kept"]:
    """Find the first point of each cube of `voxel_m`, in the order given; indices in that order.

    The points are to lie within a million cubes of the origin.
    """
    return np.sort(np.unique(voxel_keys(points_m, voxel_m), return_index=True)[1])


def voxel_keys(points_m: Float[np.ndarray, "points 3"], voxel_m: float) -> Int64[np.ndarray, "points"]:
    """Number the cubes of `voxel_m` that points lie in; within a million cubes of the origin."""
    cells = np.floor(points_m / voxel_m).astype(np.int64) + (1 << (_CELL_BITS - 1))
    return (cells[:, 0] << (2 * _CELL_BITS)) | (cells[:, 1] << _CELL_BITS) | cells[:, 2]
