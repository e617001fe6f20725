"""Eq. 4 on a GPU: the edge loss of all levels of samples and its gradient in one pass, as `losses.edge_loss` has it.

torch needs some fifty kernels a level. Here one kernel gives each ray's share and what it changes with the weights, a
second one adds the shares up in a fixed order, and backward scales. All arithmetic is float32. With TRITON_INTERPRET=1
set before the import the kernels run on CPU tensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.triton_launch import launch, rows_of

RAYS = 8
"""Rays that one program works on."""
SAMPLES = tl.constexpr(64)
"""Samples of a ray that a program works on at a time."""
SHARES = tl.constexpr(1024)
"""Programs' shares added up at a time."""
NUMBERS = 1024
"""Numbers that one program of backward scales."""

SQRT_HALF = tl.constexpr(math.sqrt(0.5))
SQRT_HALF_PI = tl.constexpr(math.sqrt(math.pi / 2))
SQRT_TWO_PI = tl.constexpr(math.sqrt(2 * math.pi))


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _share_kernel(
    weights,
    starts,
    ends,
    slopes,
    strides,
    samples,
    priors,
    sigmas,
    shares,
    counts,
    rays,
    metres_per_unit,
    eps,
    narrow,
    LEVELS: tl.constexpr,
    INTERVAL: tl.constexpr,
    NORM: tl.constexpr,
    FOLLOW: tl.constexpr,
    RAYS: tl.constexpr,
):
    program = tl.program_id(0)
    ray = program.to(tl.int64) * RAYS + tl.arange(0, RAYS)
    prior, sigma = tl.load(priors + ray, ray < rays, 0.0), tl.load(sigmas + ray, ray < rays, 0.0)
    has_prior = (prior > 0) & (prior < float("inf")) & (sigma > 0) & (sigma < float("inf"))
    tl.store(counts + program, tl.sum(has_prior.to(tl.int32), 0))
    prior, sigma = tl.where(has_prior, prior, 1.0)[:, None], tl.where(has_prior, sigma, 1.0)[:, None]
    for level in tl.static_range(LEVELS):
        share = tl.zeros((RAYS, SAMPLES), tl.float32)
        for first in range(0, samples[level], SAMPLES):
            sample = first + tl.arange(0, SAMPLES)[None]
            inside = (ray < rays)[:, None] & (sample < samples[level])
            used = has_prior[:, None] & inside
            # what is not finite may stand in a ray without a prior: it is not read
            weight = tl.load(weights[level] + ray[:, None] * strides[level][0] + sample, used, 1.0)
            start = tl.load(starts[level] + ray[:, None] * strides[level][1] + sample, used, 0.0) * metres_per_unit
            end = tl.load(ends[level] + ray[:, None] * strides[level][2] + sample, used, 0.0) * metres_per_unit
            counts_here = used & (end > start) & (tl.abs(start) < float("inf")) & (tl.abs(end) < float("inf"))
            start, end = tl.where(counts_here, start, 0.0), tl.where(counts_here, end, 1.0)
            # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
            length = (end - start) / sigma
            start, end = (start - prior) / sigma, (end - prior) / sigma
            middle = start + length / 2
            mass = tl.exp(-0.5 * middle * middle) * length
            if INTERVAL:
                narrow_mass = mass * (1 + (middle * middle - 1) * length * length / 24)
                wide_mass = SQRT_HALF_PI * (tl.erf(end * SQRT_HALF) - tl.erf(start * SQRT_HALF))
                mass = tl.where(length < narrow, narrow_mass, wide_mass)
            target = mass / SQRT_TWO_PI if NORM else mass * sigma
            target = tl.where(counts_here, target, 0.0)
            share -= tl.where(used, target * tl.log(weight + eps), 0.0)
            if FOLLOW:
                slope = tl.where(used, -target / (weight + eps), 0.0)
                tl.store(slopes[level] + ray[:, None] * samples[level] + sample, slope, inside)
        tl.store(shares + level * tl.num_programs(0) + program, tl.sum(tl.sum(share, 1), 0))


@triton.jit
@no_type_check
def _sum_kernel(shares, counts, losses, inverse_count, programs):
    """Divide the sum of a level's shares by the number of rays that have a prior."""
    level = tl.program_id(0)
    total = tl.zeros((SHARES,), tl.float32)
    count = tl.zeros((SHARES,), tl.int32)
    for first in range(0, programs, SHARES):
        program = first + tl.arange(0, SHARES)
        total += tl.load(shares + level * programs + program, program < programs, 0.0)
        count += tl.load(counts + program, program < programs, 0)
    inverse = 1.0 / tl.maximum(tl.sum(count, 0), 1).to(tl.float32)
    tl.store(losses + level, tl.sum(total, 0) * inverse)
    if level == 0:
        tl.store(inverse_count, inverse)


@triton.jit
@no_type_check
def _scale_kernel(slopes, to_weights, numbers, gradient, inverse_count, LEVELS: tl.constexpr, NUMBERS: tl.constexpr):
    number = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    inverse = tl.load(inverse_count)
    for level in tl.static_range(LEVELS):
        factor = tl.load(gradient + level) * inverse
        inside = number < numbers[level]
        tl.store(to_weights[level] + number, tl.load(slopes[level] + number, inside, 0.0) * factor, inside)


class _EdgeLosses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, prior: Tensor, sigma: Tensor, options: dict[str, Any], *levels: Tensor) -> Tensor:
        weights, starts, ends = levels[::3], levels[1::3], levels[2::3]
        follow = any(ctx.needs_input_grad[3:])
        rays, samples = len(prior), tuple(each.shape[1] for each in weights)
        slopes = tuple(torch.empty_like(each, memory_format=torch.contiguous_format) for each in weights)
        programs = triton.cdiv(rays, RAYS)
        shares, counts = prior.new_empty(len(weights), programs), prior.new_empty(programs, dtype=torch.int32)
        losses, inverse_count = prior.new_empty(len(weights)), prior.new_empty(())
        matrices = [[rows_of(each) for each in level] for level in zip(weights, starts, ends, strict=True)]
        tensors = [tuple(level[place][0] for level in matrices) for place in range(3)]
        strides = tuple(tuple(stride for _, stride in level) for level in matrices)
        launch(
            _share_kernel,
            (programs,),
            prior,
            *tensors,
            slopes,
            strides,
            samples,
            prior.contiguous(),
            sigma.contiguous(),
            shares,
            counts,
            rays,
            **options,
            LEVELS=len(weights),
            FOLLOW=follow,
            RAYS=RAYS,
        )
        launch(_sum_kernel, (len(weights),), prior, shares, counts, losses, inverse_count, programs)
        if follow:
            ctx.save_for_backward(inverse_count, *slopes)
        return losses

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        inverse_count, *slopes = ctx.saved_tensors
        to_weights = tuple(torch.empty_like(slope) for slope in slopes)
        numbers = tuple(slope.numel() for slope in slopes)
        launch(
            _scale_kernel,
            (triton.cdiv(max(numbers), NUMBERS),),
            inverse_count,
            tuple(slopes),
            to_weights,
            numbers,
            gradients[0].contiguous(),
            inverse_count,
            LEVELS=len(slopes),
            NUMBERS=NUMBERS,
        )
        of_levels = zip(to_weights, ctx.needs_input_grad[3::3], strict=True)
        levels = ((each if needed else None, None, None) for each, needed in of_levels)
        return None, None, None, *(each for level in levels for each in level)


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
    """Compute Eq. 4 of each level of samples, mean over the rays that have a prior; float32.

    Args:
        levels: weights, starts and ends, each [rays, samples of the level], the lengths in any unit. Differentiable
            once, by the weights alone.
        prior_m: d̃, metres; a ray where it is not positive and finite adds nothing.
        sigma_m: σ̂, metres; likewise.
        metres_per_unit: metres in one unit of starts and ends.
        interval: take the Gaussian's mass over a sample, not its value at the middle.
        divide_by_norm: divide by σ̂ √(2π).
        eps: added to the weights inside the logarithm.
        narrow: below this length, in units of σ̂, an interval's mass comes from its midpoint.

    Returns:
        The loss of each level.

    """
    options = {
        "metres_per_unit": metres_per_unit,
        "eps": eps,
        "narrow": narrow,
        "INTERVAL": interval,
        "NORM": divide_by_norm,
    }
    tensors = [each.float() for level in levels for each in level]
    losses = _EdgeLosses.apply(prior_m.float(), sigma_m.float(), options, *tensors)
    assert isinstance(losses, Tensor)
    return losses


def try_out(device: torch.device) -> None:
    """Run each kernel once; raises whatever keeps it from working."""
    edges = torch.arange(1.0, 4.0, device=device)[None]
    weights = torch.full((1, 2), 0.5, device=device, requires_grad=True)
    one = torch.ones(1, device=device)
    edge_losses(
        [(weights, edges[:, :-1], edges[:, 1:])],
        one,
        one,
        metres_per_unit=1.0,
        interval=True,
        divide_by_norm=True,
        eps=1e-7,
        narrow=0.05,
    ).sum().backward()
