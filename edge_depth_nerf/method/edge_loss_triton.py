"""Eq. 4 on a GPU: the edge loss of each ray and its gradient in one pass, as `losses.edge_loss` has it.

torch needs some fifty kernels. Here one gives each ray's loss and what that changes with the weights, and backward
scales. All arithmetic is float32. With TRITON_INTERPRET=1 set before the import the kernels run on CPU tensors.
"""

from __future__ import annotations

import math
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.gradients import sloped
from edge_depth_nerf.kernels.triton_launch import launch, rows_of

RAYS = 8
"""Rays that one program works on."""
SAMPLES = tl.constexpr(64)
"""Samples of a ray that a program works on at a time."""

SQRT_HALF = tl.constexpr(math.sqrt(0.5))
SQRT_HALF_PI = tl.constexpr(math.sqrt(math.pi / 2))
SQRT_TWO_PI = tl.constexpr(math.sqrt(2 * math.pi))


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _loss_kernel(
    weights, weight_stride, starts, start_stride, ends, end_stride, priors, sigmas, losses, slopes, rays, samples, eps,
    narrow, INTERVAL: tl.constexpr, NORM: tl.constexpr, FOLLOW: tl.constexpr, RAYS: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0).to(tl.int64) * RAYS + tl.arange(0, RAYS)
    prior, sigma = tl.load(priors + ray, ray < rays, 0.0), tl.load(sigmas + ray, ray < rays, 0.0)
    has_prior = (prior > 0) & (prior < float("inf")) & (sigma > 0) & (sigma < float("inf"))
    prior, sigma = tl.where(has_prior, prior, 1.0)[:, None], tl.where(has_prior, sigma, 1.0)[:, None]
    loss = tl.zeros((RAYS, SAMPLES), tl.float32)
    for first in range(0, samples, SAMPLES):
        sample = first + tl.arange(0, SAMPLES)[None]
        inside = (ray < rays)[:, None] & (sample < samples)
        used = has_prior[:, None] & inside
        # what is not finite may stand in a ray without a prior: it is not read
        weight = tl.load(weights + ray[:, None] * weight_stride + sample, used, 1.0)
        start = tl.load(starts + ray[:, None] * start_stride + sample, used, 0.0)
        end = tl.load(ends + ray[:, None] * end_stride + sample, used, 0.0)
        counts = used & (end > start) & (tl.abs(start) < float("inf")) & (tl.abs(end) < float("inf"))
        start, end = tl.where(counts, start, 0.0), tl.where(counts, end, 1.0)
        # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
        length = (end - start) / sigma
        start, end = (start - prior) / sigma, (end - prior) / sigma
        midpoint = start + length / 2
        mass = tl.exp(-0.5 * midpoint * midpoint) * length
        if INTERVAL:
            narrow_mass = mass * (1 + (midpoint * midpoint - 1) * length * length / 24)
            wide_mass = SQRT_HALF_PI * (tl.erf(end * SQRT_HALF) - tl.erf(start * SQRT_HALF))
            mass = tl.where(length < narrow, narrow_mass, wide_mass)
        target = mass / SQRT_TWO_PI if NORM else mass * sigma
        target = tl.where(counts, target, 0.0)
        loss -= tl.where(used, target * tl.log(weight + eps), 0.0)
        if FOLLOW:
            slope = tl.where(used, -target / (weight + eps), 0.0)
            tl.store(slopes + ray[:, None] * samples + sample, slope, inside)
    tl.store(losses + ray, tl.sum(loss, 1), ray < rays)


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
    """Compute Eq. 4 of each ray, as `losses.edge_loss` does with these arguments; float32.

    Differentiable once, by the weights alone. `eps` is added to the weights inside the logarithm; below a length of
    `narrow`, in units of σ̂, an interval's mass comes from its midpoint.
    """
    options = {"eps": eps, "narrow": narrow, "INTERVAL": interval, "NORM": divide_by_norm, "RAYS": RAYS}
    (rays, samples), weights = weights.shape, weights.float()
    matrices = [each for matrix in (weights, starts_m, ends_m) for each in rows_of(matrix.float())]
    prior, sigma = prior_m.float().contiguous(), sigma_m.float().contiguous()

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        losses, slopes = torch.empty_like(prior), torch.empty_like(weights, memory_format=torch.contiguous_format)
        arguments = *matrices, prior, sigma, losses, slopes, rays, samples
        launch(_loss_kernel, (triton.cdiv(rays, RAYS),), *arguments, **options, FOLLOW=follow)
        return losses, slopes

    return sloped(weights, compute)
