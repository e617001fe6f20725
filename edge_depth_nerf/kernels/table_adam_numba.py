"""Adam's step on a hash table, a level at a time, with the gradient summed up just before.

Importing this module imports Numba.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, no_type_check

import numpy as np
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.hash_grid_numba import add_to_level, prepared
from edge_depth_nerf.kernels.threads import kernel_threads, share_out

LEAST_SHARE = 1 << 18
"""A thread gets at least so many numbers of a table."""


@compiled(error_model="numpy")
@no_type_check
def _adam(values, gradient, mean, square, beta1, beta2, rate, spread, eps):
    """Do Adam's step (Kingma & Ba, Algorithm 1) in place, and set the gradient to 0."""
    fresh, fresh_square = np.float32(1 - beta1), np.float32(1 - beta2)
    kept_square, rate, spread, eps = np.float32(beta2), np.float32(rate), np.float32(spread), np.float32(eps)
    # a range from 0 on: with any other Numba has to look for negative indices, and no vector instructions come out
    for i in range(len(values)):
        g = gradient[i]
        m = mean[i] + fresh * (g - mean[i])
        v = kept_square * square[i] + fresh_square * g * g
        mean[i] = m
        square[i] = v
        values[i] -= rate * (m / (np.sqrt(v) / spread + eps))
        gradient[i] = np.float32(0)


def step_levels(
    table: Tensor,
    state: Mapping[str, Tensor],
    parts: Sequence[tuple[Tensor, Tensor, Tensor]],
    options: Mapping[str, Any],
) -> None:
    """Do Adam's step of a table in place, level by level; a thread has whole levels, so sums have one order.

    Args:
        table: [levels * rows, features], float32.
        state: torch's: the step's number, and the running means of gradients and of their squares.
        parts: what the gradient is the sum of: positions, gradient to their encoded values and scalings of each pass.
        options: torch's, of the table's group.
    """
    step, (beta1, beta2) = float(state["step"]), options["betas"]
    rate, spread = float(options["lr"]) / (1 - beta1**step), math.sqrt(1 - beta2**step)
    numbers = beta1, beta2, rate, spread, options["eps"]
    levels = len(parts[0][2])
    tensors = table, state["exp_avg"], state["exp_avg_sq"]
    values, means, squares = (each.detach().view(levels, -1).numpy() for each in tensors)
    given = [prepared(*part) for part in parts]
    features = table.shape[1]
    # fine levels first, which take longer; who is ready takes the next one
    remaining = iter(range(levels - 1, -1, -1))

    def work(_: int) -> None:
        gradient = np.zeros(values.shape[1], np.float32)
        for level in remaining:
            for part in given:
                add_to_level(part, level, features, gradient)
            _adam(values[level], gradient, means[level], squares[level], *numbers)

    share_out(work, list(range(max(1, min(kernel_threads(), levels, values.size // LEAST_SHARE)))))
