"""points.ply: a coloured cloud of what the training frames' LiDAR saw, thinned.

Points are metres, in the recording's world when they come and in the scene's (nearer to its origin) when they are
stored. Each frame's part is kept in a file of its own until all are there, so that work which was interrupted is
not done twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy.lib.recfunctions import unstructured_to_structured

from edge_depth_nerf.base.files import read_npz, write_atomically, write_bytes
from edge_depth_nerf.lidar.ply import ply_bytes
from edge_depth_nerf.lidar.sweeps import first_in_voxel

MAX_POINTS = 200_000
"""points.ply holds at most so many points."""
VOXEL_M = 0.15
"""points.ply holds one point of each cube of this size; larger cubes where they would be too many."""
_MAX_PART_BYTES = 1 << 28
"""No array of a frame's part is larger."""
_MERGE_AT = 1_000_000
"""So many points are collected before they are thinned; bounds the memory for long drives."""
_MOST_KEPT = 5
"""So many times `MAX_POINTS` are kept on the way; beyond, cubes grow before all parts are read."""


@dataclass(frozen=True)
class PointCloud:
    """Coloured points."""

    points_m: Float64[np.ndarray, "points 3"]
    """In the recording's world."""
    colours: UInt8[np.ndarray, "points 3"]
    """RGB."""
    pixels: Int64[np.ndarray, "points 2"]
    """Row and column of each point in its frame's picture."""


_Part = tuple[Float32[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"]]
"""Points in the scene's world, metres, and their colours."""


def _thinned(parts: Sequence[_Part], voxel_m: float, most: int) -> tuple[_Part, float]:
    """Keep the first point of each cube, in the order given; cubes grow until at most so many are left."""
    points_m, colours = (np.concatenate(each) for each in zip(*parts, strict=True))
    while True:
        first = first_in_voxel(points_m, voxel_m)
        points_m, colours = points_m[first], colours[first]
        if len(points_m) <= most:
            return (points_m, colours), voxel_m
        voxel_m *= 1.2


def write_part(
    path: Path, cloud: PointCloud, mask: Bool[np.ndarray, "h w"], world_offset_m: Float64[np.ndarray, "3"]
) -> None:
    """Write those of one frame's points whose pixels may be used, thinned, atomically."""
    used = mask[cloud.pixels[:, 0], cloud.pixels[:, 1]]
    # before the shift float32 would round to fractions of a millimetre, or to centimetres far from the origin
    points_m = (cloud.points_m[used] - world_offset_m).astype(np.float32)
    (points_m, colours), _ = _thinned([(points_m, cloud.colours[used])], VOXEL_M, len(points_m))
    write_atomically(path, lambda temporary: np.savez(temporary, points_m=points_m, colours=colours))


def merge_parts(parts: Sequence[Path], ply: Path) -> int:
    """Merge the frames' points into one PLY file (binary: float x, y, z, uchar red, green, blue); give their number.

    With none, no file is written.
    """
    voxel_m = VOXEL_M
    pending: list[_Part] = [(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))]
    count = 0
    for path in parts:
        stored = read_npz(path, ("points_m", "colours"), _MAX_PART_BYTES)
        pending.append((stored["points_m"], stored["colours"]))
        count += len(stored["points_m"])
        if count > _MERGE_AT:
            # where more are left, the drive is so long that they would be thinned further in the end, too
            merged, voxel_m = _thinned(pending, voxel_m, _MOST_KEPT * MAX_POINTS)
            pending, count = [merged], 0
    (points_m, colours), _ = _thinned(pending, voxel_m, MAX_POINTS)
    if len(points_m):
        kinds = {"x": "<f4", "y": "<f4", "z": "<f4", "red": "u1", "green": "u1", "blue": "u1"}
        columns = np.hstack((points_m, colours))
        write_bytes(ply, ply_bytes(unstructured_to_structured(columns, np.dtype(list(kinds.items())))))
    return len(points_m)
