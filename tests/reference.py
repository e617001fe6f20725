"""Slow twins in float64, written straight from the equations as plain loops.

They share no code with the package. NumPy arrays in, NumPy arrays or floats out; units as there.
"""

import math
from itertools import pairwise

import numpy as np


def urban_nerf_loss(weights, starts_m, ends_m, prior_m, sigma_m, expected=1.0, empty=1.0, near=1.0, steps=2000):
    """UrbanNeRF's three terms by sums over places along each ray; h is w / Δt within a sample, and 0 elsewhere."""
    total, count = 0.0, 0
    reach = 3 * sigma_m

    def kernel(places, prior):
        return np.exp(-((places - prior) ** 2) / (2 * sigma_m**2))

    def places_in(start, end):
        return start + (np.arange(steps) + 0.5) * (end - start) / steps

    integral = kernel(places_in(-reach, reach), 0.0).sum() * 2 * reach / steps
    for ray in range(len(prior_m)):
        prior = float(prior_m[ray])
        if not (prior > 0 and math.isfinite(prior)):
            continue
        count += 1
        spans = [
            (float(start), float(end), float(weight))
            for start, end, weight in zip(starts_m[ray], ends_m[ray], weights[ray], strict=True)
            if end > start
        ]
        rendered = sum(weight * (start + end) / 2 for start, end, weight in spans)
        total += expected * (rendered - prior) ** 2
        # from each edge to the next one, of samples and of the kernel, h is constant
        edges = sorted({prior - reach, prior + reach, *(edge for span in spans for edge in span[:2])})
        for start, end in pairwise(edges):
            middle = (start + end) / 2
            h = sum(weight / (b - a) for a, b, weight in spans if a <= middle < b)
            if middle < prior - reach:
                total += empty * h**2 * (end - start)
            elif middle < prior + reach:
                difference = h - kernel(places_in(start, end), prior) / integral
                total += near * (difference**2).sum() * (end - start) / steps
    return total / max(count, 1)


def edge_loss(weights, starts_m, ends_m, prior_m, sigma_m, gaussian="point", divide_by_norm=False, eps=1e-7):
    """Eq. 4 with rendering weights: mean over the rays that have a prior; 0 without any."""
    rays, samples = np.shape(weights)
    total, count = 0.0, 0
    for ray in range(rays):
        prior, sigma = float(prior_m[ray]), float(sigma_m[ray])
        if not (prior > 0 and sigma > 0 and math.isfinite(prior) and math.isfinite(sigma)):
            continue
        count += 1
        for k in range(samples):
            start, end = float(starts_m[ray][k]), float(ends_m[ray][k])
            if gaussian == "point":
                mass = math.exp(-(((start + end) / 2 - prior) ** 2) / (2 * sigma**2)) * (end - start)
            else:
                upper, lower = (math.erf((t - prior) / (sigma * math.sqrt(2))) for t in (end, start))
                mass = 0.5 * (upper - lower) * sigma * math.sqrt(2 * math.pi)
            if divide_by_norm:
                mass /= sigma * math.sqrt(2 * math.pi)
            total -= math.log(float(weights[ray][k]) + eps) * mass
    return total / max(count, 1)
