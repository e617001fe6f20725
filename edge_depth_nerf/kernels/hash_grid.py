"""The multiresolution hash grid as nerfstudio computes it, with its gradients, in one fused step.

A point p in [0, 1]^3 (others work too) is scaled, s = p · scaling, at each level; the eight corners of its cell have
floor(s) or ceil(s) on each axis, and each corner (i, j, k) its row of the table, in the level's own part of it:

    row = (i ⊕ 2654435761 j ⊕ 805459861 k) mod rows of a level     (Müller et al., Instant-NGP, Eq. 4)

The features are interpolated between the corners, linearly on x, then y, then z. Unlike Instant-NGP, nerfstudio hashes
coarse levels too, takes no half-cell offset, and on a border of cells lower and upper corner are the same, so that
the gradient to the position is 0 on that axis.

Shapes: positions [points, 3], table [levels * rows, features] with a power of two of rows, scalings [levels], encoded
[points, levels * features]; float32. Pure: knows nothing of nerfstudio. CPU tensors are worked on by Numba
(`hash_grid_numba`), CUDA tensors by Triton (`hash_grid_triton`); `functions.HASH_GRID` says which.
"""

from __future__ import annotations

from functools import partial
from types import ModuleType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.gradients import once
from edge_depth_nerf.kernels.table_adam import SUMS_LATER, TablePart, keep_part


class _HashGrid(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, scalings: Tensor, work: ModuleType, dtype: torch.dtype
    ) -> Tensor:
        # without a gradient to the positions the table is not needed again
        ctx.save_for_backward(positions, table if ctx.needs_input_grad[0] else None, scalings)
        ctx.work, ctx.rows = work, len(table)
        ctx.table = table if hasattr(table, SUMS_LATER) else None
        encode = work.encode if dtype == torch.float32 else partial(work.encode, dtype=dtype)
        return encode(positions, table, scalings)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        gradient = gradients[0]
        positions, table, scalings = ctx.saved_tensors
        rows = ctx.rows if ctx.needs_input_grad[1] else None
        if rows is not None and ctx.table is not None:
            kept = keep_part(ctx.table, TablePart(positions, gradient, scalings))
            rows = None if kept else rows

        def compute() -> tuple[Tensor | None, Tensor | None]:
            return (
                None if table is None else ctx.work.position_gradient(positions, table, gradient, scalings),
                None if rows is None else ctx.work.table_gradient(positions, gradient, scalings, rows),
            )

        return *once("The fused hash grid", compute, gradient, positions, table), None, None, None


def hash_grid(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    work: ModuleType,
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "points encoded"]:
    """Encode points, differentiable once by positions and table, float32 each.

    Args:
        positions: in the unit cube.
        table: all levels one after the other, each with the same power of two of rows.
        scalings: float32, cells along an axis of the unit cube, for each level.
        work: the module of kernels, for the device of these tensors.
        dtype: of what is given, level after level; the CPU has float32 alone.
    """
    encoded = _HashGrid.apply(positions, table, scalings, work, dtype)
    assert isinstance(encoded, Tensor)
    return encoded
