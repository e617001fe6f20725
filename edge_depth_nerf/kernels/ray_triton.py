"""Sums along rays on a GPU: weights, where samples go, the proposal and the distortion loss with their gradients.

A program holds a ray or a few on the chip, so a ray has at most `functions.MOST` samples. The losses find what the CPU
finds by walking two sorted lists (`ray_numba`) by comparing each of one with each of the other: more comparisons, none
of which waits. Sums of a ray are of float32, but for the cumulative distribution that samples are placed by, which is
of float64 as on the CPU. With TRITON_INTERPRET=1 set before the import the kernels run on CPU tensors.
"""

from __future__ import annotations

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.formulas import EPS
from edge_depth_nerf.kernels.gradients import sloped
from edge_depth_nerf.kernels.triton_launch import launch, rows_of

NUMBERS = 1024
"""Numbers that a program works on where it works on several rays."""
TOGETHER = 8
"""Places, or samples, that are compared with all samples of a ray at a time."""


def _block(samples: int) -> int:
    """Give a power of two that has room for all samples of a ray."""
    return max(16, triton.next_power_of_2(samples))


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _is_finite(x):
    return tl.abs(x) < float("inf")


@triton.jit
@no_type_check
def _optical_depths(densities, deltas, ray, sample, rays, samples):
    """Give the optical depth of some samples and their lengths, 0 outside."""
    inside = (ray < rays) & (sample >= 0) & (sample < samples)
    delta = tl.load(deltas + ray * samples + sample, inside, 0.0)
    return delta * tl.load(densities + ray * samples + sample, inside, 0.0), delta


@triton.jit
@no_type_check
def _weight_kernel(densities, deltas, weights, rays, samples, RAYS: tl.constexpr, SAMPLES: tl.constexpr):
    ray = (tl.program_id(0).to(tl.int64) * RAYS + tl.arange(0, RAYS))[:, None]
    sample = tl.arange(0, SAMPLES)[None]
    depth, _ = _optical_depths(densities, deltas, ray, sample, rays, samples)
    before, _ = _optical_depths(densities, deltas, ray, sample - 1, rays, samples)
    weight = (1 - tl.exp(-depth)) * tl.exp(-tl.cumsum(before, 1))
    # as nerfstudio: what is not a number weighs nothing
    tl.store(
        weights + ray * samples + sample, tl.where(weight == weight, weight, 0.0), (ray < rays) & (sample < samples)
    )


@triton.jit
@no_type_check
def _density_gradient_kernel(
    densities, deltas, gradient, to_densities, rays, samples, RAYS: tl.constexpr, SAMPLES: tl.constexpr
):
    ray = (tl.program_id(0).to(tl.int64) * RAYS + tl.arange(0, RAYS))[:, None]
    sample = tl.arange(0, SAMPLES)[None]
    depth, delta = _optical_depths(densities, deltas, ray, sample, rays, samples)
    before, _ = _optical_depths(densities, deltas, ray, sample - 1, rays, samples)
    after, _ = _optical_depths(densities, deltas, ray, sample + 1, rays, samples)
    reached = tl.cumsum(before, 1)
    inside, has_next = (ray < rays) & (sample < samples), (ray < rays) & (sample + 1 < samples)
    left, seen = tl.exp(-depth), tl.exp(-reached)
    g = tl.load(gradient + ray * samples + sample, inside, 0.0)
    g = tl.where(_is_finite((1 - left) * seen), g, 0.0)
    # Σ_j>k g_j w_j, of what lies behind each sample: the next one's share, summed up from the far end
    next_weight = (1 - tl.exp(-after)) * tl.exp(-(reached + depth))
    next_g = tl.load(gradient + ray * samples + sample + 1, has_next, 0.0)
    share = tl.where(_is_finite(next_weight), next_g, 0.0) * next_weight
    behind = tl.cumsum(tl.where(has_next, share, 0.0), 1, reverse=True)
    tl.store(to_densities + ray * samples + sample, delta * (g * left * seen - behind), inside)


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, densities: Tensor, deltas: Tensor) -> Tensor:
        densities, deltas = densities.detach().contiguous(), deltas.detach().contiguous()
        weights = torch.empty_like(densities)
        _along_rays(_weight_kernel, densities, deltas, weights)
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(densities, deltas)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        densities, deltas = ctx.saved_tensors
        to_densities = torch.empty_like(densities)
        _along_rays(_density_gradient_kernel, densities, deltas, gradients[0].contiguous(), to_densities)
        return to_densities, None


def _along_rays(kernel: Any, *tensors: Tensor) -> None:
    """Launch a kernel that works on several rays at a time, all samples of each."""
    rays, samples = tensors[0].shape
    block = _block(samples)
    together = max(1, NUMBERS // block)
    programs = triton.cdiv(rays, together) if samples > 0 else 0
    launch(kernel, (programs,), *tensors, rays, samples, RAYS=together, SAMPLES=block)


def weights_from_densities(
    densities: Float[Tensor, "rays samples"], deltas: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Compute rendering weights, w_k = (1 - exp(-σ_k δ_k)) exp(-Σ_j<k σ_j δ_j), of float32; NaN becomes 0.

    Differentiable once, by the densities σ alone, which are 0 or more.
    """
    weights = _Weights.apply(densities, deltas)
    assert isinstance(weights, Tensor)
    return weights


@triton.jit
@no_type_check
def _place_kernel(
    weights, edges, wanted, placed, cumulatives, samples, places, padding, least, SAMPLES: tl.constexpr,
    PLACES: tl.constexpr, STEPS: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0).to(tl.int64)
    sample = tl.arange(0, SAMPLES)
    inside = sample < samples
    weight = tl.where(inside, tl.load(weights + ray * samples + sample, inside, 0.0) + padding, 0.0)
    total = tl.sum(weight.to(tl.float64), 0).to(tl.float32)
    lacking = tl.maximum(least - total, 0.0)
    total = total + lacking
    share = tl.where(inside, (weight + lacking / samples) / total, 0.0)
    # of each interval the share of all that lies before its end
    cumulative = tl.minimum(tl.cumsum(share.to(tl.float64), 0).to(tl.float32), 1.0)
    tl.store(cumulatives + ray * samples + sample, cumulative, inside)
    # each thread reads what others have written
    tl.debug_barrier()
    place = tl.arange(0, PLACES)
    given = place < places
    u = tl.load(wanted + ray * places + place, given, 0.0)
    # a binary search for how many intervals end at or before each
    passed = tl.zeros((PLACES,), tl.int32)
    for step in tl.static_range(STEPS):
        further = passed + (SAMPLES >> step)
        ahead = tl.load(cumulatives + ray * samples + further - 1, further <= samples, float("inf"))
        passed = tl.where(ahead <= u, further, passed)
    low = tl.load(cumulatives + ray * samples + passed - 1, passed > 0, 0.0)
    high = tl.load(cumulatives + ray * samples + passed, passed < samples, float("inf"))
    start = tl.load(edges + ray * (samples + 1) + passed)
    end = tl.load(edges + ray * (samples + 1) + passed + 1, passed < samples, 0.0)
    # behind the last interval it is the last edge; a sum that is no number gives no place
    found = tl.where(_is_finite(high), start + (u - low) / (high - low) * (end - start), start)
    found = tl.where(_is_finite(total), found, float("nan"))
    tl.store(placed + ray * places + place, found, given)


def sample_pdf(
    weights: Float[Tensor, "rays intervals"],
    edges: Float[Tensor, "rays edges"],
    wanted: Float[Tensor, "rays places"],
    padding: float,
    least: float,
) -> Float[Tensor, "rays places"]:
    """Invert the cumulative distribution of a histogram over each ray; arguments as in `ray_numba.sample_pdf`."""
    rays, samples = weights.shape
    places = wanted.shape[1]
    weights, edges, wanted = (each.detach().contiguous() for each in (weights, edges, wanted))
    placed, cumulatives = torch.empty_like(wanted), torch.empty_like(weights)
    arguments = weights, edges, wanted, placed, cumulatives, samples, places, float(padding), float(least)
    block = _block(samples)
    constants = {"SAMPLES": block, "PLACES": _block(places), "STEPS": block.bit_length()}
    # one warp, as each step of the search waits for the one before
    launch(_place_kernel, (rays,), *arguments, **constants, num_warps=1)
    return placed


@triton.jit
@no_type_check
def _bound_kernel(
    edges, weights, outer_edges, outer_weights, losses, slopes, stride, outer_stride, samples, intervals, share, eps,
    INTERVALS: tl.constexpr, FOLLOW: tl.constexpr, TOGETHER: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0).to(tl.int64)
    interval = tl.arange(0, INTERVALS)
    inside = interval < intervals
    begin = tl.load(outer_edges + ray * outer_stride + interval, inside, 0.0)
    end = tl.load(outer_edges + ray * outer_stride + interval + 1, inside, 0.0)
    outer = tl.load(outer_weights + ray * intervals + interval, inside, 0.0)
    slope = tl.zeros((INTERVALS,), tl.float32)
    loss = tl.zeros((TOGETHER,), tl.float32)
    for first in range(0, samples, TOGETHER):
        sample = first + tl.arange(0, TOGETHER)
        given = sample < samples
        low = tl.load(edges + ray * stride + sample, given, 0.0)
        high = tl.load(edges + ray * stride + sample + 1, given, 0.0)
        w = tl.load(weights + ray * samples + sample, given, 0.0)
        # the outermost intervals stand for what lies beyond them
        touched = ((end[None] > low[:, None]) | (interval == intervals - 1)[None]) & inside[None]
        touched = touched & ((begin[None] <= high[:, None]) | (interval == 0)[None])
        excess = w - tl.sum(tl.where(touched, outer[None], 0.0), 1)
        exceeds = given & (excess > 0)
        loss += tl.where(exceeds, excess * excess / (w + eps), 0.0)
        if FOLLOW:
            step = tl.where(exceeds, -2 * excess / (w + eps), 0.0)
            slope += tl.sum(tl.where(touched, step[:, None], 0.0), 0)
    tl.store(losses + ray, tl.sum(loss, 0) * share)
    if FOLLOW:
        tl.store(slopes + ray * intervals + interval, slope * share, inside)


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    outer_edges: Float[Tensor, "rays outer_edges"],
    outer_weights: Float[Tensor, "rays outer_samples"],
) -> Float[Tensor, ""]:
    """Compute the interlevel loss of mip-NeRF 360 (Eq. 13); as `ray_numba.interlevel_loss`, edges ascending."""
    (rays, samples), intervals = weights.shape, outer_weights.shape[1]
    (of_edges, stride), (of_outer, outer_stride) = rows_of(edges), rows_of(outer_edges)
    given = of_edges, weights.detach().contiguous(), of_outer, outer_weights.detach().contiguous()
    numbers = stride, outer_stride, samples, intervals, 1 / max(1, weights.numel()), EPS

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        losses, slopes = weights.new_empty(rays), outer_weights.new_empty(outer_weights.shape)
        constants = {"INTERVALS": _block(intervals), "FOLLOW": follow, "TOGETHER": TOGETHER}
        launch(_bound_kernel, (rays,), *given, losses, slopes, *numbers, **constants)
        return losses.sum(), slopes

    return sloped(outer_weights, compute)


@triton.jit
@no_type_check
def _distortion_kernel(
    edges, weights, losses, slopes, stride, samples, share, SAMPLES: tl.constexpr, FOLLOW: tl.constexpr,
    TOGETHER: tl.constexpr,
):  # fmt: skip
    ray = tl.program_id(0).to(tl.int64)
    sample = tl.arange(0, SAMPLES)
    inside = sample < samples
    start = tl.load(edges + ray * stride + sample, inside, 0.0)
    end = tl.load(edges + ray * stride + sample + 1, inside, 0.0)
    middle, length = (start + end) / 2, end - start
    w = tl.load(weights + ray * samples + sample, inside, 0.0)
    away = tl.zeros((SAMPLES,), tl.float32)
    for first in range(0, samples, TOGETHER):
        other = first + tl.arange(0, TOGETHER)
        given = other < samples
        other_start = tl.load(edges + ray * stride + other, given, 0.0)
        other_end = tl.load(edges + ray * stride + other + 1, given, 0.0)
        other_w = tl.load(weights + ray * samples + other, given, 0.0)
        gap = tl.abs(middle[None] - ((other_start + other_end) / 2)[:, None])
        away += tl.sum(other_w[:, None] * gap, 0)
    away = tl.where(inside, away, 0.0)
    tl.store(losses + ray, tl.sum(w * (away + w * length / 3), 0) * share)
    if FOLLOW:
        tl.store(slopes + ray * samples + sample, 2 * (away + w * length / 3) * share, inside)


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (Eq. 15), mean over the rays; differentiable once, by the weights alone.

    Σ_ij w_i w_j |m_i - m_j| + 1/3 Σ_i w_i² Δ_i, with midpoints m and lengths Δ of the samples, in the spacing of 0..1.
    """
    (rays, samples), (of_edges, stride) = weights.shape, rows_of(edges)

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        losses, slopes = weights.new_empty(rays), weights.new_empty(weights.shape)
        arguments = of_edges, weights.detach().contiguous(), losses, slopes, stride, samples, 1 / max(1, rays)
        constants = {"SAMPLES": _block(samples), "FOLLOW": follow, "TOGETHER": TOGETHER}
        launch(_distortion_kernel, (rays,), *arguments, **constants)
        return losses.sum(), slopes

    return sloped(weights, compute)
