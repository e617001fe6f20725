"""Sums along rays on the CPU, one ray after the other: weights, where samples go, two losses with their gradients.

The weights of a ray's samples are a histogram over its intervals. torch forms cumulative sums, searches in them and
gathers from them, each a pass over all rays; here two sorted lists are walked once, side by side. Cumulative sums are
float64 and rounded to float32, as torch's own.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.exponential_numba import exp
from edge_depth_nerf.kernels.gradients import sloped
from edge_depth_nerf.kernels.pointwise_numba import flat_rows
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE, TWO, THREE = (np.float32(number) for number in range(4))
LEAST_SHARE = 1 << 16
"""A thread gets at least so many samples."""
LEAST_WALKED = 1 << 15
"""The same where lists are walked, which takes longer."""
EPS = np.float32(1e-7)
"""nerfstudio's, in the interlevel loss."""


@compiled()
@no_type_check
def _sum_depths(density, delta, depths, reached):
    """Write the optical depths of a ray's samples, and the sums of those in front of each."""
    for k in range(len(depths)):
        depths[k] = delta[k] * density[k]
    running = 0.0
    for k in range(len(depths)):
        reached[k] = np.float32(running)
        running += depths[k]


@compiled()
@no_type_check
def find_weights(densities, deltas, weights, samples, first, last):
    """Write the weights of some rays; calls for different ones may run at once."""
    depths, reached = np.empty(samples, np.float32), np.empty(samples, np.float32)
    for ray in range(first, last):
        begin = ray * samples
        density, delta, weight = densities[begin:], deltas[begin:], weights[begin:]
        _sum_depths(density, delta, depths, reached)
        for k in range(samples):
            found = (ONE - exp(-depths[k])) * exp(-reached[k])
            # as nerfstudio: what is not a number weighs nothing
            weight[k] = found if found == found else ZERO


@compiled()
@no_type_check
def _density_gradients(densities, deltas, gradient, to_densities, samples, first, last):
    depths, reached = np.empty(samples, np.float32), np.empty(samples, np.float32)
    for ray in range(first, last):
        begin = ray * samples
        density, delta = densities[begin:], deltas[begin:]
        of_weight, into = gradient[begin:], to_densities[begin:]
        _sum_depths(density, delta, depths, reached)
        for k in range(samples):
            depths[k], reached[k] = exp(-depths[k]), exp(-reached[k])
        # Σ_j>k g_j w_j, of what lies behind each sample; 0 times what is not a number is none: a broken training shows
        behind = 0.0
        for k in range(samples - 1, -1, -1):
            weight = (ONE - depths[k]) * reached[k]
            g = of_weight[k] if weight == weight else ZERO
            into[k] = delta[k] * (g * depths[k] * reached[k] - np.float32(behind))
            behind += g * weight


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, densities: Tensor, deltas: Tensor) -> Tensor:
        densities, deltas = densities.detach().contiguous(), deltas.detach().contiguous()
        weights = torch.empty_like(densities)
        _along(find_weights, densities, deltas, weights)
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(densities, deltas)
        return weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        densities, deltas = ctx.saved_tensors
        to_densities = torch.empty_like(densities)
        _along(_density_gradients, densities, deltas, gradients[0].contiguous(), to_densities)
        return to_densities, None


def _along(kernel: Callable[..., None], *matrices: Tensor) -> None:
    """Call a kernel for all rays; the matrices are [rays, samples] and contiguous."""
    rays, samples = matrices[0].shape
    arrays = [each.view(-1).numpy() for each in matrices]
    in_parts(lambda first, last: kernel(*arrays, samples, first, last), rays, LEAST_SHARE // max(1, samples))


def weights_from_densities(
    densities: Float[Tensor, "rays samples"], deltas: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Compute rendering weights, w_k = (1 - exp(-σ_k δ_k)) exp(-Σ_j<k σ_j δ_j); NaN becomes 0.

    Args:
        densities: σ, 0 or more, float32. Differentiable once, by them alone.
        deltas: δ, the samples' lengths, float32.
    """
    weights = _Weights.apply(densities, deltas)
    assert isinstance(weights, Tensor)
    return weights


@compiled()
@no_type_check
def _sample_pdf(weights, edges, wanted, padding, least, placed, first, last):
    samples = weights.shape[1]
    cumulative = np.empty(samples + 1, np.float32)
    for ray in range(first, last):
        total = 0.0
        for i in range(samples):
            total += weights[ray, i] + padding
        lacking = max(least - np.float32(total), ZERO)
        total = np.float32(total) + lacking
        cumulative[0] = ZERO
        running = 0.0
        for i in range(samples):
            running += (weights[ray, i] + padding + lacking / np.float32(samples)) / total
            cumulative[i + 1] = min(np.float32(running), ONE)
        above = 0
        for k in range(wanted.shape[1]):
            u = wanted[ray, k]
            while above <= samples and cumulative[above] <= u:
                above += 1
            if above > samples:
                placed[ray, k] = edges[ray, samples]
            elif above == 0:
                placed[ray, k] = edges[ray, 0]
            else:
                low, high = cumulative[above - 1], cumulative[above]
                start, end = edges[ray, above - 1], edges[ray, above]
                placed[ray, k] = start + (u - low) / (high - low) * (end - start)


def sample_pdf(
    weights: Float[Tensor, "rays intervals"],
    edges: Float[Tensor, "rays edges"],
    wanted: Float[Tensor, "rays places"],
    padding: float,
    least: float,
) -> Float[Tensor, "rays places"]:
    """Invert the cumulative distribution of a histogram over each ray.

    Args:
        weights: of the intervals, 0 or more, float32.
        edges: of the intervals, one more than these.
        wanted: shares of the distribution, ascending, in 0..1.
        padding: added to each weight.
        least: the sum of a ray's weights is raised to this, equally in all intervals.

    Returns:
        Where these shares are reached, linear within an interval.
    """
    placed = torch.empty(wanted.shape)
    arrays = [each.detach().contiguous().numpy() for each in (weights, edges, wanted)]
    arguments = *arrays, np.float32(padding), np.float32(least), placed.numpy()
    numbers = weights.shape[1] + wanted.shape[1]
    in_parts(lambda first, last: _sample_pdf(*arguments, first, last), len(weights), LEAST_WALKED // numbers)
    return placed


@compiled()
@no_type_check
def _interlevel_loss(edges, weights, outer_edges, outer_weights, to_outer, follow, begin, end):
    """Give the sum of the loss; what each outer weight would change it by goes to `to_outer`, if wanted."""
    samples, intervals = weights.shape[1], outer_weights.shape[1]
    cumulative = np.empty(intervals + 1, np.float32)
    slope = np.empty(intervals + 1, np.float32)
    loss = 0.0
    for ray in range(begin, end):
        cumulative[0] = ZERO
        running = 0.0
        for i in range(intervals):
            running += outer_weights[ray, i]
            cumulative[i + 1] = np.float32(running)
        slope[:] = 0
        first = last = 0
        for k in range(samples):
            while first < intervals and outer_edges[ray, first] <= edges[ray, k]:
                first += 1
            while last < intervals and outer_edges[ray, last + 1] <= edges[ray, k + 1]:
                last += 1
            low, high = max(first - 1, 0), min(last, intervals - 1)
            w = weights[ray, k]
            excess = w - (cumulative[high + 1] - cumulative[low])
            if excess > ZERO:
                loss += excess * excess / (w + EPS)
                step = np.float32(-2) * excess / (w + EPS)
                slope[low] += step
                slope[high + 1] -= step
        if follow:
            running = 0.0
            for i in range(intervals):
                running += slope[i]
                to_outer[ray, i] = running
    return loss


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    outer_edges: Float[Tensor, "rays outer_edges"],
    outer_weights: Float[Tensor, "rays outer_samples"],
) -> Float[Tensor, ""]:
    """Measure how far an outer histogram fails to bound another one: mip-NeRF 360's interlevel loss (Eq. 13).

    Mean over all samples of max(0, w - bound)² / (w + 1e-7), where the bound sums the outer weights of all intervals
    that a sample touches. Differentiable once, by `outer_weights` alone. float32.
    """
    arrays = [each.detach().contiguous().numpy() for each in (edges, weights, outer_edges, outer_weights)]

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        slope = torch.empty(outer_weights.shape if follow else (0, 0))
        # in the order of the rays, whichever thread was ready first: the same sum each time
        of_parts: dict[int, float] = {}

        def work(first: int, last: int) -> None:
            of_parts[first] = _interlevel_loss(*arrays, slope.numpy(), follow, first, last)

        in_parts(work, len(weights), LEAST_WALKED // max(1, weights.shape[1] + outer_weights.shape[1]))
        loss = sum(of_parts[first] for first in sorted(of_parts)) / max(1, weights.numel())
        return torch.tensor(loss, dtype=torch.float32), slope / max(1, weights.numel())

    return sloped(outer_weights, compute)


@compiled()
@no_type_check
def distortion_of_ray(edge, weight, slopes, before, samples, follow):
    """Give the loss of a ray; what each weight would change it by goes to `slopes`, if wanted. Overwrites `before`."""
    loss = 0.0
    # Σ_j<k w_j and Σ_j<k w_j m_j, then the same of what lies behind
    total = moment = 0.0
    for k in range(samples):
        middle = (edge[k] + edge[k + 1]) / TWO
        before[k] = middle * total - moment
        total += weight[k]
        moment += weight[k] * middle
    total = moment = 0.0
    for k in range(samples - 1, -1, -1):
        middle = (edge[k] + edge[k + 1]) / TWO
        away = before[k] + moment - middle * total
        own = weight[k] * (edge[k + 1] - edge[k]) / THREE
        loss += weight[k] * (away + own)
        if follow:
            slopes[k] = 2 * (away + own)
        total += weight[k]
        moment += weight[k] * middle
    return loss


@compiled()
@no_type_check
def _distortion_loss(edges, edge_stride, weights, slopes, samples, follow):
    """Give the sum of the loss; what each weight would change it by goes to `slopes`, if wanted."""
    before = np.empty(samples, np.float64)
    loss = 0.0
    for ray in range(len(weights) // max(1, samples)):
        begin = ray * samples
        loss += distortion_of_ray(edges[ray * edge_stride :], weights[begin:], slopes[begin:], before, samples, follow)
    return loss


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (Eq. 15), mean over the rays; differentiable once, by the weights alone.

    Σ_ij w_i w_j |m_i - m_j| + 1/3 Σ_i w_i² Δ_i, with midpoints m and lengths Δ of the samples.

    Args:
        edges: of the samples, ascending, in the spacing of 0..1, float32.
        weights: rendering weights, float32.
    """
    rays, samples = weights.shape

    def compute(follow: bool) -> tuple[Tensor, Tensor]:
        slopes = torch.empty(weights.shape if follow else (0, 0))
        loss = _distortion_loss(*flat_rows(edges), flat(weights), slopes.view(-1).numpy(), samples, follow)
        return torch.tensor(loss / max(1, rays), dtype=torch.float32), slopes

    return sloped(weights, compute, max(1, rays))
