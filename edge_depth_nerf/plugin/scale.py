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
LARGEST_METRES_PER_UNIT = 128.0
"""The finest of 2048 cells is then 0.25 m: larger ones would blur kerbs and poles. The drive's ends are squeezed."""


def default_metres_per_unit(camera_positions_m: NDArray) -> float:
    """Give half of a drive's extent along its longest axis, within the limits above.

    Args:
        camera_positions_m: N×3 camera centres, metres.

    """
    half_extent_m = float(np.ptp(camera_positions_m, axis=0).max()) / 2
    return float(np.clip(half_extent_m, SMALLEST_METRES_PER_UNIT, LARGEST_METRES_PER_UNIT))
