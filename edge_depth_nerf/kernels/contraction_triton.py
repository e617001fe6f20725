"""nerfacto's contraction of space into the unit cube on a GPU, in one kernel; meaning as in `contraction_numba`.

With TRITON_INTERPRET=1 set before the import it runs on CPU tensors.
"""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.triton_launch import launch

POINTS = 256
"""Points that one program works on."""


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _contract_kernel(positions, places, inside, points, POINTS: tl.constexpr):
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    given = point < points
    x = tl.load(positions + 3 * point, given, 0.0)
    y = tl.load(positions + 3 * point + 1, given, 0.0)
    z = tl.load(positions + 3 * point + 2, given, 0.0)
    norm = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    far = norm >= 1
    size = tl.where(far, norm, 1.0)
    factor = 2 - tl.div_rn(1.0, size)
    # what is no number is not inside
    x = (tl.where(far, factor * tl.div_rn(x, size), x) + 2) / 4
    y = (tl.where(far, factor * tl.div_rn(y, size), y) + 2) / 4
    z = (tl.where(far, factor * tl.div_rn(z, size), z) + 2) / 4
    within = (x > 0) & (y > 0) & (z > 0) & (x < 1) & (y < 1) & (z < 1)
    tl.store(places + 3 * point, tl.where(within, x, x * 0), given)
    tl.store(places + 3 * point + 1, tl.where(within, y, y * 0), given)
    tl.store(places + 3 * point + 2, tl.where(within, z, z * 0), given)
    tl.store(inside + point, tl.where(within, 1.0, 0.0), given)


def contract(positions: Float[Tensor, "points 3"]) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Contract positions, float32, without a gradient.

    Returns:
        The positions in 0..1; 1 where a point is inside, else 0.

    """
    positions = positions.detach().contiguous()
    places, inside = torch.empty_like(positions), positions.new_empty(len(positions))
    programs = triton.cdiv(len(positions), POINTS)
    launch(_contract_kernel, (programs,), positions, positions, places, inside, len(positions), POINTS=POINTS)
    return places, inside


def try_out(device: torch.device) -> None:
    """Run the kernel once; raises whatever keeps it from working."""
    contract(torch.ones(1, 3, device=device))
