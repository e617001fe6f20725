"""Sums along rays on the CPU, one ray after the other: where samples go, and the loss of the proposals.

The weights of a ray's samples are a histogram over its intervals. torch forms cumulative sums, searches in them and
gathers from them, each a pass over all rays; here two sorted lists are walked once, side by side. Cumulative sums are
float64 and rounded to float32, as torch's own.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.gradients import sloped
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE = np.float32(0), np.float32(1)
LEAST_WALKED = 1 << 15
"""A thread gets at least so many samples."""
EPS = np.float32(1e-7)
"""nerfstudio's, in the interlevel loss."""


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
