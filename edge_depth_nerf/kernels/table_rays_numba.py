"""Rays of pixels from a table of their lenses' rays and the cameras' poses, in one pass; on the CPU.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import torch
from jaxtyping import Float, Int
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled


@compiled()
@no_type_check
def _turn(table, places, pictures, poses, origins, directions, rest):
    for j in range(len(places)):
        ray, pose = table[places[j]], poses[pictures[j]]
        x, y, z = ray[0], ray[1], ray[2]
        for axis in range(3):
            directions[j, axis] = x * pose[axis, 0] + y * pose[axis, 1] + z * pose[axis, 2]
            origins[j, axis] = pose[axis, 3]
        rest[j, 0], rest[j, 1] = ray[3], ray[4]


def turned(
    table: Float[Tensor, "pixels 5"],
    places: Int[Tensor, "rays"],
    pictures: Int[Tensor, "rays"],
    poses: Float[Tensor, "cameras rows 4"],
) -> tuple[Float[Tensor, "rays 3"], Float[Tensor, "rays 3"], Float[Tensor, "rays 2"]]:
    """Turn rays into the world.

    Args:
        table: of each pixel its direction in the camera's frame and two more numbers, float32.
        places: of the rays in the table.
        pictures: whose poses they get.
        poses: camera to world.

    Returns:
        Origins, directions, and the two other numbers.

    Raises:
        IndexError: a place or picture that there is none of; compiled code would read behind the arrays.

    """
    count = len(places)
    for indices, rows in ((places, table), (pictures, poses)):
        if count and not 0 <= int(indices.min()) <= int(indices.max()) < len(rows):
            raise IndexError(
                f"Rays {int(indices.min())} to {int(indices.max())} were asked for; there are {len(rows)}."
            )
    origins, directions, rest = torch.empty(count, 3), torch.empty(count, 3), torch.empty(count, 2)
    given = (table, places.contiguous(), pictures.contiguous(), poses.contiguous(), origins, directions, rest)
    _turn(*(each.numpy() for each in given))
    return origins, directions, rest
