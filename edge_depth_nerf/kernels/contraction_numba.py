"""nerfacto's contraction of space into the unit cube, in one pass over the positions; on the CPU.

A position p, in units of the scene box, becomes p where its largest coordinate |p|∞ is below 1, else
(2 - 1 / |p|∞) p / |p|∞ (mip-NeRF 360, Eq. 10, in the infinity norm); that cube of -2..2 is then moved to 0..1. Points
that do not end strictly inside become 0, and are marked. The order of nerfstudio's arithmetic, so the same to the last
bit.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.threads import in_parts

LEAST_SHARE = 1 << 14
"""A thread gets at least so many points."""
ONE, TWO, FOUR = np.float32(1), np.float32(2), np.float32(4)


@compiled()
@no_type_check
def contract_points(positions, axes, inside, first, last):
    """Contract points from `first` to `last`; calls for different ones may run at once."""
    for j in range(first, last):
        x, y, z = positions[j, 0], positions[j, 1], positions[j, 2]
        norm = max(max(abs(x), abs(y)), abs(z))
        if not norm < ONE:
            factor = TWO - ONE / norm
            x, y, z = factor * (x / norm), factor * (y / norm), factor * (z / norm)
        x, y, z = (x + TWO) / FOUR, (y + TWO) / FOUR, (z + TWO) / FOUR
        within = x > 0 and y > 0 and z > 0 and x < ONE and y < ONE and z < ONE
        inside[j] = within
        axes[0, j], axes[1, j], axes[2, j] = (x, y, z) if within else (x * 0, y * 0, z * 0)


def contract(positions: Float[Tensor, "points 3"]) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Contract positions, float32, without a gradient.

    Returns:
        The positions in 0..1, coordinate after coordinate in memory (as the hash grid wants them); 1 where a point is
        inside, else 0.
    """
    axes, inside = torch.empty(3, len(positions)), torch.empty(len(positions))
    arrays = positions.detach().numpy(), axes.numpy(), inside.numpy()
    in_parts(lambda first, last: contract_points(*arrays, first, last), len(positions), LEAST_SHARE)
    return axes.t(), inside
