"""Adam's step on the numbers of a table, which also clears the gradient. Importing this module imports Numba."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.threads import kernel_threads, share_out, stretches

LEAST_SHARE = 1 << 18
"""A thread gets at least so many numbers."""


@compiled(error_model="numpy")
@no_type_check
def _adam(values, gradient, mean, square, beta1, beta2, rate, spread, eps):
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


def adam(
    values: NDArray[np.float32],
    gradient: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    *,
    beta1: float,
    beta2: float,
    rate: float,
    spread: float,
    eps: float,
) -> None:
    """Do Adam's step (Kingma & Ba, Algorithm 1) in place, and set the gradient to 0.

    Args:
        values: what is learned, flat.
        gradient: its gradient.
        mean: m, the running mean of gradients.
        square: v, that of their squares.
        beta1: how much of m is kept.
        beta2: how much of v is kept.
        rate: learning rate over 1 - beta1^t.
        spread: √(1 - beta2^t).
        eps: added to √v / spread.

    """
    threads = max(1, min(kernel_threads(), len(values) // LEAST_SHARE))
    numbers = (beta1, beta2, rate, spread, eps)
    arrays = (values, gradient, mean, square)
    parts = [[each[first:last] for each in arrays] for first, last in stretches(len(values), threads)]
    share_out(lambda part: _adam(*part, *numbers), parts)
