"""Eq. 4 on the CPU: the edge loss of each ray and its gradient in one pass, as `losses.edge_loss` has it.

Samples whose part of the Gaussian is 0 in float32 are passed over: the most, as a prior is narrow and rays are long.
float32 but for the sum over a ray's samples. Importing this module imports Numba.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat, flat_rows
from edge_depth_nerf.kernels.gradients import sloped
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
def _edge_loss(
    weights, weight_stride, starts, start_stride, ends, end_stride, priors, sigmas, losses, slopes, samples,
    eps, narrow, interval, norm, follow, first, last,
):  # fmt: skip
    """Write the losses of rays; `slopes`, which are 0, get what each weight would change its ray's by."""
    for ray in range(first, last):
        prior, sigma, loss = priors[ray], sigmas[ray], 0.0
        if not (ZERO < prior < np.inf and ZERO < sigma < np.inf):
            losses[ray] = ZERO
            continue
        weight_of = weights[ray * weight_stride :]
        start_of, end_of = starts[ray * start_stride :], ends[ray * end_stride :]
        # a sample begins where the one before it ends: its value of Φ serves again
        last_high, of_last = np.float32(np.inf), ZERO
        for k in range(samples):
            begin, end = start_of[k], end_of[k]
            # false with NaN, too
            if not (-np.inf < begin < end < np.inf):
                continue
            # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
            length = (end - begin) / sigma
            low, high = (begin - prior) / sigma, (end - prior) / sigma
            if low > FAR or high < -FAR:
                continue
            midpoint = low + length / TWO
            if interval and not length < narrow:
                of_low = of_last if low == last_high else np.float32(math.erf(low * SQRT_HALF))
                last_high, of_last = high, np.float32(math.erf(high * SQRT_HALF))
                mass = SQRT_HALF_PI * (of_last - of_low)
            else:
                mass = np.float32(math.exp(-HALF * midpoint * midpoint)) * length
                if interval:
                    mass *= ONE + (midpoint * midpoint - ONE) * length * length * SECOND_ORDER
            if mass == ZERO:
                continue
            target = mass / SQRT_TWO_PI if norm else mass * sigma
            weight = weight_of[k] + eps
            loss -= target * np.float32(math.log(weight))
            if follow:
                slopes[ray * samples + k] = -target / weight
        losses[ray] = loss


def edge_loss(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    sigma_m: Float[Tensor, "rays"],
    *,
    interval: bool,
    divide_by_norm: bool,
    eps: float,
    narrow: float,
) -> Float[Tensor, "rays"]:
    """Compute Eq. 4 of each ray, as `edge_loss_triton` does."""
    options = np.float32(eps), np.float32(narrow), interval, divide_by_norm
    (rays, samples), weights = weights.shape, weights.float()

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        losses, slopes = torch.empty(rays), torch.zeros(weights.shape if follow else (0, 0))
        matrices = [each for matrix in (weights, starts_m, ends_m) for each in flat_rows(matrix.float())]
        arrays = *matrices, *map(flat, (prior_m.float(), sigma_m.float(), losses, slopes)), samples, *options, follow
        in_parts(lambda first, last: _edge_loss(*arrays, first, last), rays, LEAST_SHARE // max(1, samples))
        return losses, slopes

    return sloped(weights, compute)
