"""Sums along rays on the CPU, one ray after the other: where samples go.

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

from edge_depth_nerf.compiled import compiled

ZERO, ONE = np.float32(0), np.float32(1)


@compiled()
@no_type_check
def _place_samples(weights, edges, wanted, padding, least, placed):
    samples = weights.shape[1]
    cumulative = np.empty(samples + 1, np.float32)
    for ray in range(len(weights)):
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


def place_samples(
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
    arrays = (each.detach().contiguous().numpy() for each in (weights, edges, wanted))
    _place_samples(*arrays, np.float32(padding), np.float32(least), placed.numpy())
    return placed
