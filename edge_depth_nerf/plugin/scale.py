"""How many metres one unit of the scene stands for.

nerfacto's scene contraction keeps the cube |x|_inf <= 1 unit and squeezes the rest into 1..2, its hash grid spans
the contracted -2..2, and its sampler spends half of its samples below 1 unit. The drive should lie inside the
cube: beyond r units, cells grow with r². The finest cell, 4 · metres_per_unit / resolution, should stay small.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SMALLEST_METRES_PER_UNIT = 10.0
"""What stands around the road is some 10 m away, however short the drive."""
COARSEST_CELL_M = 0.25
"""Beyond this the finest cell of the hash grid would blur kerbs and poles; the ends of the drive are squeezed."""


def default_metres_per_unit(camera_positions_m: NDArray, hash_resolution: int) -> float:
    """Choose metres_per_unit for a drive.

    Args:
        camera_positions_m: N×3 camera centres, metres.
        hash_resolution: cells of the finest hash-grid level along one axis.

    Returns:
        Half of the drive's extent along its longest axis, at least 10 m, at most what keeps the finest cell
        at 0.25 m (and never under 10 m).

    """
    half_extent_m = float(np.ptp(camera_positions_m, axis=0).max()) / 2
    largest = max(SMALLEST_METRES_PER_UNIT, COARSEST_CELL_M * hash_resolution / 4)
    return float(np.clip(half_extent_m, SMALLEST_METRES_PER_UNIT, largest))
