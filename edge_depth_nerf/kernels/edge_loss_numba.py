"""Eq. 4 on the CPU: the edge loss of a level of samples and its gradient in one pass, as `losses.edge_loss` has it.

Samples whose part of the Gaussian is 0 in float32 are passed over: the most, as a prior is narrow and rays are long.
float32 but for the sum over all samples. Importing this module imports Numba.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.pointwise_numba import flat_rows
from edge_depth_nerf.kernels.threads import in_parts

LEAST_SHARE = 1 << 13
"""A thread gets at least so many samples."""
ZERO, ONE, TWO, HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
FAR = np.float32(15)
"""In units of σ̂: the Gaussian there is 0 in float32."""
SQRT_HALF, SQRT_HALF_PI, SQRT_TWO_PI = (np.float32(math.sqrt(each)) for each in (0.5, math.pi / 2, 2 * math.pi))
SECOND_ORDER = np.float32(1 / 24)


@compiled()
@no_type_check
def edge_loss_of_ray(
    weights, starts, ends, prior, sigma, slopes, samples, metres_per_unit, eps, narrow, interval, norm, follow
):
    """Give the loss of a ray that has a prior; `slopes`, which are 0, get what each weight would change it by."""
    loss = 0.0
    # a sample begins where the one before it ends: its value of Φ serves again
    last, of_last = np.float32(np.inf), ZERO
    for k in range(samples):
        begin, end = starts[k] * metres_per_unit, ends[k] * metres_per_unit
        # false with NaN, too
        if not (-np.inf < begin < end < np.inf):
            continue
        # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
        length = (end - begin) / sigma
        low, high = (begin - prior) / sigma, (end - prior) / sigma
        if low > FAR or high < -FAR:
            continue
        middle = low + length / TWO
        if interval and not length < narrow:
            of_low = of_last if low == last else np.float32(math.erf(low * SQRT_HALF))
            last, of_last = high, np.float32(math.erf(high * SQRT_HALF))
            mass = SQRT_HALF_PI * (of_last - of_low)
        else:
            mass = np.float32(math.exp(-HALF * middle * middle)) * length
            if interval:
                mass *= ONE + (middle * middle - ONE) * length * length * SECOND_ORDER
        if mass == ZERO:
            continue
        target = mass / SQRT_TWO_PI if norm else mass * sigma
        weight = weights[k] + eps
        loss -= target * np.float32(math.log(weight))
        if follow:
            slopes[k] = -target / weight
    return loss


@compiled()
@no_type_check
def has_prior(prior, sigma):
    """Whether a ray has one."""
    return ZERO < prior < np.inf and ZERO < sigma < np.inf


@compiled()
@no_type_check
def _edge_loss(
    weights, weight_stride, starts, start_stride, ends, end_stride, priors, sigmas, slopes, samples,
    metres_per_unit, eps, narrow, interval, norm, follow, first, last,
):  # fmt: skip
    """Give the sum of the loss and how many rays have a prior; `slopes` gets what each weight would change it by."""
    loss, count = 0.0, 0
    for ray in range(first, last):
        if has_prior(priors[ray], sigmas[ray]):
            count += 1
            loss += edge_loss_of_ray(
                weights[ray * weight_stride :], starts[ray * start_stride :], ends[ray * end_stride :], priors[ray],
                sigmas[ray], slopes[ray * samples :], samples, metres_per_unit, eps, narrow, interval, norm, follow,
            )  # fmt: skip
    return loss, count


class _EdgeLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, starts: Tensor, ends: Tensor, prior: Tensor, sigma: Tensor, options: tuple[Any, ...]
    ) -> Tensor:
        follow = ctx.needs_input_grad[0]
        slopes = torch.zeros(weights.shape if follow else (0, 0))
        matrices = [each for matrix in (weights, starts, ends) for each in flat_rows(matrix)]
        of_rays = (each.detach().contiguous().numpy() for each in (prior, sigma))
        rays, samples = weights.shape
        arrays = *matrices, *of_rays, slopes.view(-1).numpy(), samples, *options, follow
        # in the order of the rays, whichever thread was ready first: the same sum each time
        of_parts: dict[int, tuple[float, int]] = {}

        def work(first: int, last: int) -> None:
            of_parts[first] = _edge_loss(*arrays, first, last)

        in_parts(work, rays, LEAST_SHARE // max(1, samples))
        total, count = (sum(of_parts[first][k] for first in sorted(of_parts)) for k in (0, 1))
        if follow:
            ctx.save_for_backward(slopes)
        ctx.count = max(1, count)
        return torch.tensor(total / ctx.count, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        return ctx.saved_tensors[0] * (gradients[0] / ctx.count), None, None, None, None, None


def edge_losses(
    levels: Sequence[tuple[Tensor, Tensor, Tensor]],
    prior_m: Float[Tensor, "rays"],
    sigma_m: Float[Tensor, "rays"],
    *,
    metres_per_unit: float,
    interval: bool,
    divide_by_norm: bool,
    eps: float,
    narrow: float,
) -> Float[Tensor, "levels"]:
    """Compute Eq. 4 of each level of samples, mean over rays that have a prior, as `edge_loss_triton` does."""
    options = np.float32(metres_per_unit), np.float32(eps), np.float32(narrow), interval, divide_by_norm
    of_rays = prior_m.float(), sigma_m.float()
    return torch.stack([_EdgeLoss.apply(*(each.float() for each in level), *of_rays, options) for level in levels])
