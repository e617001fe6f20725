"""Rigid transforms: 4×4, metres, named a_to_b; and the one change between camera axes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from edge_depth_nerf.base.bounds import MAX_LENGTH_M
from edge_depth_nerf.base.errors import InputError

Transform = Float64[np.ndarray, "4 4"]

ROTATION_TOLERANCE = 1e-4
"""How far R·Rᵀ may be from the identity. KITTI-360's own files keep 1e-10; six written digits still pass."""


def rigid(
    rotation: Float64[np.ndarray, "*n 3 3"], shift_m: NDArray | Sequence[float] | float = 0.0
) -> Float64[np.ndarray, "*n 4 4"]:
    """Make transforms of rotations and of shifts, x, y, z."""
    found = np.zeros((*rotation.shape[:-2], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = rotation, shift_m, 1
    return found


def check_rigid(transform: Transform, where: str) -> None:
    """Check that a transform turns and shifts and does nothing else.

    Raises:
        InputError: with `where` and the deviation.
    """
    rotation = transform[:3, :3]
    # huge numbers are a deviation like others
    with np.errstate(over="ignore", invalid="ignore"):
        deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
    turns = deviation <= ROTATION_TOLERANCE and determinant > 0
    # NaN compares as false
    if not (turns and np.isfinite(transform).all() and np.array_equal(transform[3], [0, 0, 0, 1])):
        raise InputError(
            f"{where}: not a rotation and a translation (the rotation deviates from orthonormal by {deviation:.2g}, "
            f"its determinant is {determinant:.3g}; expected at most {ROTATION_TOLERANCE:g}, and 1)."
        )
    furthest = np.abs(transform[:3, 3]).max()
    if furthest > MAX_LENGTH_M:
        raise InputError(f"{where}: shifts by {furthest:.3g} m, more than {MAX_LENGTH_M:g} m. Is it in metres?")


def opencv_to_opengl(camera_to_world: Transform) -> Transform:
    """Turn a pose of OpenCV's camera axes (y down, z forward) into one of OpenGL's (y up, z backward)."""
    return camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
