"""Slow twins in float64, written straight from the equations as plain loops.

They share no code with the package. NumPy arrays in, NumPy arrays or floats out; units as there.
"""

import math
from itertools import pairwise

import numpy as np


def integrate_depth(
    lidar_m,
    mono_m,
    valid,
    alpha=0.7,
    kernel_size=9,
    sigma_space_px=3.0,
    sigma_depth_m=1.0,
    sigma_depth_growth_per_m=0.0,
    kernel="edge-aware",
    normalise="pooled",
    least_returns=0.0,
    keep_returns=False,
    motion_m=None,
    motion_weight=0.0,
):
    """Eq. 5 to 7 for one map: distance, spread, monocular share, each [h, w]."""
    lidar = np.asarray(lidar_m, np.float64)
    mono = np.array(mono_m, np.float64)
    if motion_m is not None:
        # (1-α) d̂ becomes (1-α) (ρ m + (1-ρ) d̂) where there are both
        for place, motion in np.ndenumerate(np.asarray(motion_m, np.float64)):
            has_mono = math.isfinite(mono[place]) and mono[place] > 0
            if math.isfinite(motion) and motion > 0:
                mono[place] = motion_weight * motion + (1 - motion_weight) * mono[place] if has_mono else motion
    height, width = mono.shape
    radius = kernel_size // 2
    distance, spread, mono_share = np.zeros((3, height, width))

    def usable(i, j):
        return bool(valid[i, j]) and math.isfinite(mono[i, j]) and mono[i, j] > 0

    def has_lidar(i, j):
        return math.isfinite(lidar[i, j]) and lidar[i, j] > 0

    for i in range(height):
        for j in range(width):
            if not usable(i, j):
                continue
            if keep_returns and has_lidar(i, j):
                distance[i, j] = lidar[i, j]
                continue
            centre = mono[i, j]
            entries = []  # (is it LiDAR, value, g, spatial part of g)
            for k in range(-radius, radius + 1):
                for l in range(-radius, radius + 1):
                    y, x = i + k, j + l
                    if not (0 <= y < height and 0 <= x < width and usable(y, x)):
                        continue
                    spatial = math.exp(-(k**2 + l**2) / (2 * sigma_space_px**2))
                    g = spatial
                    if kernel == "edge-aware":
                        sigma_m = max(sigma_depth_m, sigma_depth_growth_per_m * centre**2)
                        g *= math.exp(-((centre - mono[y, x]) ** 2) / (2 * sigma_m**2))
                    is_lidar = has_lidar(y, x)
                    entries.append((is_lidar, lidar[y, x] if is_lidar else mono[y, x], g, spatial))
            weights = []
            for is_lidar, _, g, _ in entries:
                weight = g * (alpha if is_lidar else 1 - alpha)
                if normalise == "per-source":
                    total = sum(entry[3] for entry in entries if entry[0] == is_lidar)
                    weight /= max(total, least_returns) if is_lidar else total
                weights.append(weight)
            eta = sum(weights)
            if eta == 0:
                continue
            mean = sum(w * entry[1] for w, entry in zip(weights, entries, strict=True)) / eta
            variance = sum(w * (entry[1] - mean) ** 2 for w, entry in zip(weights, entries, strict=True)) / eta
            distance[i, j] = mean
            spread[i, j] = math.sqrt(variance)
            mono_share[i, j] = sum(w for w, entry in zip(weights, entries, strict=True) if not entry[0]) / eta
    return distance, spread, mono_share


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
