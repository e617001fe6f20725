"""What a sweep saw through: points of other sweeps that lie where this one's beams went on.

A moving thing is measured where it was. If the beams of a sweep at another time passed that place and ended further
away, the thing has gone, or had not yet come.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from edge_depth_nerf.lidar.projection import transform_points
from edge_depth_nerf.lidar.world import WorldSweep

_CELL_SPACINGS = 1.1
"""Size of a direction's cell in spacings of the LiDAR points, so that few cells stay empty."""
_MARGIN = 1.05
_MARGIN_M = 0.3
"""A beam passed a point if it ended further away by this ratio and by this length."""


@dataclass(frozen=True)
class FreeSpace:
    """How far a sweep's beams went, by direction."""

    world_to_scanner: Float[Tensor, "4 4"]
    lowest_rad: float
    """Elevation of the lowest row's lower edge."""
    cell_rad: float
    free_to_m: Float[Tensor, "elevations azimuths"]
    """The shortest range in a cell and the eight around it; 0 where that is not known."""

    @staticmethod
    def of(sweep: WorldSweep) -> FreeSpace:
        """Sort a sweep's points by direction."""
        world_to_scanner = torch.from_numpy(sweep.world_to_scanner)
        cell_rad = _CELL_SPACINGS * sweep.spacing_rad
        lowest, highest = sweep.elevation_rad
        lowest -= cell_rad / 2
        rows, columns = math.ceil((highest - lowest) / cell_rad) + 1, math.ceil(2 * math.pi / cell_rad)
        in_scanner = transform_points(world_to_scanner, sweep.points_m)
        row, column, range_m = _cells(in_scanner, lowest, cell_rad)
        inside = (row >= 0) & (row < rows)
        shortest = torch.full((rows * columns,), math.inf, dtype=torch.float32)
        flat = (row * columns + column)[inside]
        shortest.scatter_reduce_(0, flat, range_m[inside].float(), "amin")
        image = shortest.reshape(rows, columns).numpy()
        wrapped = np.concatenate((image[:, -1:], image, image[:, :1]), axis=1)
        least = cv2.erode(wrapped, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)[:, 1:-1]
        # a cell without a LiDAR point of its own is not known
        free_to_m = torch.from_numpy(np.where(np.isfinite(image), least, 0).astype(np.float32))
        return FreeSpace(world_to_scanner, lowest, cell_rad, free_to_m)

    def observed(
        self, points_in_world: Float[Tensor, "points 3"]
    ) -> tuple[Bool[Tensor, "points"], Bool[Tensor, "points"]]:
        """Whether beams passed each point and ended beyond it, and whether they ended about there.

        Neither is so where something nearer hides the point, or nothing was measured.
        """
        rows = len(self.free_to_m)
        in_scanner = transform_points(self.world_to_scanner, points_in_world)
        row, column, range_m = _cells(in_scanner, self.lowest_rad, self.cell_rad)
        inside = (row >= 0) & (row < rows)
        free_to_m = torch.where(inside, self.free_to_m[row.clamp(0, rows - 1), column], 0)
        margin_m = torch.maximum(range_m * (_MARGIN - 1), torch.tensor(_MARGIN_M))
        passed = free_to_m > torch.maximum(range_m * _MARGIN, range_m + _MARGIN_M)
        return passed, ~passed & (free_to_m > range_m - margin_m)


def _cells(
    points_in_scanner: Float[Tensor, "points 3"], lowest_rad: float, cell_rad: float
) -> tuple[Int[Tensor, "points"], Int[Tensor, "points"], Float[Tensor, "points"]]:
    """Row (elevation, may lie outside), column (azimuth) and range of each point."""
    x, y, z = points_in_scanner.float().unbind(-1)
    across = torch.hypot(x, y)
    columns = math.ceil(2 * math.pi / cell_rad)
    row = ((torch.atan2(z, across) - lowest_rad) / cell_rad).floor().long()
    column = ((torch.atan2(y, x) / (2 * math.pi) + 0.5) * columns).long().clamp(max=columns - 1)
    return row, column, torch.hypot(across, z)
