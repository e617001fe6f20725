"""Rays of pixels from a table of their lenses' rays and the cameras' poses, in one pass; on the CPU.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.threads import in_parts

LEAST_SHARE = 1 << 12
"""A thread gets at least so many rays: they lie anywhere in a large table."""


@compiled()
@no_type_check
def _turn(table, begins, widths, indices, poses, origins, directions, rest, first, last):
    """Give False for a pixel that is not there; compiled code would read behind the arrays."""
    for j in range(first, last):
        picture, row, column = indices[j, 0], indices[j, 1], indices[j, 2]
        if not 0 <= picture < len(begins):
            return False
        place = begins[picture] + row * widths[picture] + column
        if not 0 <= place < len(table):
            return False
        ray, pose = table[place], poses[picture]
        x, y, z = ray[0], ray[1], ray[2]
        for axis in range(3):
            directions[j, axis] = x * pose[axis, 0] + y * pose[axis, 1] + z * pose[axis, 2]
            origins[j, axis] = pose[axis, 3]
        rest[j, 0], rest[j, 1] = ray[3], ray[4]
    return True


def turned(
    table: Float[Tensor, "pixels 5"],
    begins: Int[Tensor, "cameras"],
    widths: Int[Tensor, "cameras"],
    indices: Int[Tensor, "rays 3"],
    poses: Float[Tensor, "cameras rows 4"],
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"], Float[Tensor, "rays 2"]]:
    """Turn the rays of pixels into the world.

    Args:
        table: of each pixel of each lens, row by row, its direction as the camera has it and two more numbers.
        begins: where the pixels of each camera's lens begin in it.
        widths: of the cameras' pictures, px.
        indices: camera, row and column of the pixels.
        poses: camera to world.

    Returns:
        Origins, directions, and the two other numbers.

    Raises:
        IndexError: a camera, or a place in the table, that there is none of.
    """
    count = len(indices)
    origins, directions, rest = torch.empty(count, 3), torch.empty(count, 3), torch.empty(count, 2)
    given = (table, begins, widths, indices.contiguous(), poses.contiguous(), origins, directions, rest)
    arrays, found = [each.numpy() for each in given], []
    in_parts(lambda first, last: found.append(_turn(*arrays, first, last)), count, LEAST_SHARE)
    if not all(found):
        raise IndexError(
            f"Pixels from {indices.amin(0).tolist()} to {indices.amax(0).tolist()} (camera, row, column) were asked "
            f"for; there are {len(begins)} cameras, and {len(table)} pixels in the table of their rays."
        )
    return origins, directions, rest
