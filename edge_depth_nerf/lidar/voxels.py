"""Thinning points: one of each cube of space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

_CELL_BITS = 21
"""Bits of a cube's number along one axis."""


def first_in_voxel(points_m: Float[np.ndarray, "points 3"], voxel_m: float) -> Int64[np.ndarray, "kept"]:
    """Find the first point of each cube of `voxel_m`, in the order given; indices in that order.

    The points are to lie within a million cubes of the origin.
    """
    cells = np.floor(points_m / voxel_m).astype(np.int64) + (1 << (_CELL_BITS - 1))
    keys = (cells[:, 0] << (2 * _CELL_BITS)) | (cells[:, 1] << _CELL_BITS) | cells[:, 2]
    return np.sort(np.unique(keys, return_index=True)[1])
