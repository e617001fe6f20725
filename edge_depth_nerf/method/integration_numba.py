"""The sums of Eq. 5 to 7 on the CPU, compiled by Numba; meaning and options as in `integration.integrate_depth`.

All arithmetic is float64: no difference of distances and no tiny weight is lost, whatever the maps' type. It is
fast because the innermost loop runs over neighbouring centres at one shift of the window, without a branch, so that
the compiler turns it into vector instructions.

Importing this module imports Numba. The first call ever on a machine compiles (2 s for each type of map); the result
is kept beside this file, or in the user's cache if that folder cannot be written.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from edge_depth_nerf.kernels.compiled import compiled

TILE = 512
"""Centres of one row worked on together: nine rows of windows stay in a core's cache (larger gains nothing)."""

# Of a tile's centres, each a stretch of TILE numbers in one array, at these places. It is one array with places known
# to the compiler because it vectorises a loop only if it can tell that what is written is not what is read.
GUIDE, INVERSE_VARIANCE, ETA, FIRST, SECOND, ETA_MONO, STRETCHES = range(7)

_LOG2_E = 1 / math.log(2)
_LN2_HIGH = 6.93147180369123816490e-01
"""ln 2 to 32 bits, so that its product with a whole number below 1024 is exact (Cody and Waite's reduction)."""
_LN2_LOW = 1.90821492927058770002e-10
_ROUND = 1.5 * 2.0**52
"""Added to a number below 2^51, it leaves the nearest whole number in the lowest bits."""
_C2, _C3, _C4, _C5, _C6, _C7, _C8, _C9, _C10 = (1 / math.factorial(n) for n in range(2, 11))


_compiled = compiled(fastmath={"contract"})


@_compiled
@no_type_check
def _inverse_variance(guide, inverse_variance, growth_per_m):
    """Give 1 / σ_d² of a centre."""
    widest = growth_per_m * guide * guide
    return min(inverse_variance, 1 / (widest * widest)) if widest > 0 else inverse_variance


@_compiled
@no_type_check  # the tests' type checker would wrap what Numba has to read
def _add_shift(mono, value, is_mono, is_lidar, centres, count, spatial, alpha, lowest_exponent):
    """Add to the sums of `count` centres what they get from their neighbours at one shift of the window."""
    for j in range(count):
        difference = mono[j] - centres[GUIDE * TILE + j]
        exponent = -0.5 * difference * difference * centres[INVERSE_VARIANCE * TILE + j]
        # e^x = 2^n · e^r with |r| ≤ ln 2 / 2; ten terms of e^r's series leave 3e-13 of it, n goes into the exponent
        t = max(exponent, lowest_exponent)
        rounded = t * _LOG2_E + _ROUND
        n = rounded - _ROUND
        r = t - n * _LN2_HIGH - n * _LN2_LOW
        p = _C8 + r * (_C9 + r * _C10)
        p = _C5 + r * (_C6 + r * (_C7 + r * p))
        p = 1.0 + r * (1.0 + r * (_C2 + r * (_C3 + r * (_C4 + r * p))))
        bits = np.float64(p).view(np.int64) + (np.float64(rounded).view(np.int64) << np.int64(52))
        g = np.int64(bits).view(np.float64) * spatial if exponent > lowest_exponent else 0.0

        from_mono = g * is_mono[j] * (1 - alpha)
        weight = from_mono + g * is_lidar[j] * alpha
        x = value[j] - centres[GUIDE * TILE + j]
        weighted = weight * x
        centres[ETA * TILE + j] += weight
        centres[FIRST * TILE + j] += weighted
        centres[SECOND * TILE + j] += weighted * x
        centres[ETA_MONO * TILE + j] += from_mono


@_compiled
@no_type_check
def _fill_tile(lidar, mono, valid, top, left, tile):
    """Copy a part of the maps into `tile`, [mono, value, is_mono, is_lidar], 0 where there is nothing."""
    height, width = mono.shape
    for i in range(tile.shape[1]):
        y = top + i
        for j in range(tile.shape[2]):
            x = left + j
            estimate, value, is_mono, is_lidar = 0.0, 0.0, 0.0, 0.0
            if 0 <= y < height and 0 <= x < width and valid[y, x] and 0 < mono[y, x] < np.inf:
                estimate = value = mono[y, x]
                is_mono = 1.0
                if 0 < lidar[y, x] < np.inf:
                    value, is_mono, is_lidar = lidar[y, x], 0.0, 1.0
            tile[0, i, j], tile[1, i, j], tile[2, i, j], tile[3, i, j] = estimate, value, is_mono, is_lidar


@_compiled
@no_type_check
def integrate_rows(
    lidar,
    mono,
    valid,
    distance,
    spread,
    mono_share,
    space,
    inverse_variance,
    growth_per_m,
    lowest_exponent,
    alpha,
    rows_from,
    rows_to,
):
    """Integrate the rows `rows_from` up to `rows_to` of one map. Calls for different rows may run at once.

    Args:
        lidar: [h, w], C order, metres; what is not finite and positive is no LiDAR point.
        mono: the same for the estimates.
        valid: [h, w] bool.
        distance: [h, w], C order; gets d̃ in the given rows, 0 where there is no prior.
        spread: the same for the spread.
        mono_share: the same for the monocular share.
        space: [kernel] float64, spatial weights along one axis.
        inverse_variance: 1 / σ_d² in 1/m²; 0 leaves the distance factor away.
        growth_per_m: σ_d is at least so much times the square of the centre's distance.
        lowest_exponent: distance factors of lower exponents are 0; at least -708, where float64 loses digits.
        alpha: LiDAR's share.
        rows_from: first row.
        rows_to: row after the last.
    """
    width, radius = mono.shape[1], len(space) // 2
    columns = min(TILE, width)
    tile = np.empty((4, rows_to - rows_from + 2 * radius, columns + 2 * radius))
    centres = np.empty(STRETCHES * TILE)
    distance[rows_from:rows_to], spread[rows_from:rows_to], mono_share[rows_from:rows_to] = 0, 0, 0
    for left in range(0, width, TILE):
        _fill_tile(lidar, mono, valid, rows_from - radius, left - radius, tile)
        for i in range(rows_to - rows_from):
            used = tile[2, i + radius] + tile[3, i + radius]
            first, last = radius, columns + radius
            while first < last and used[first] == 0:
                first += 1
            while first < last and used[last - 1] == 0:
                last -= 1
            count, first = last - first, first - radius  # `first` is now the left end of its window
            if count == 0:
                continue
            for j in range(count):
                guide = tile[0, i + radius, first + j + radius]
                centres[GUIDE * TILE + j] = guide
                centres[INVERSE_VARIANCE * TILE + j] = _inverse_variance(guide, inverse_variance, growth_per_m)
            centres[ETA * TILE :] = 0
            for k in range(2 * radius + 1):
                for l in range(2 * radius + 1):
                    _add_shift(
                        tile[0, i + k, first + l :],
                        tile[1, i + k, first + l :],
                        tile[2, i + k, first + l :],
                        tile[3, i + k, first + l :],
                        centres,
                        count,
                        space[k] * space[l],
                        alpha,
                        lowest_exponent,
                    )
            for j in range(count):
                y, x = rows_from + i, left + first + j
                eta = centres[ETA * TILE + j]
                if used[first + j + radius] == 0 or not eta > 0:
                    continue
                mean = centres[FIRST * TILE + j] / eta
                variance = centres[SECOND * TILE + j] / eta - mean * mean
                distance[y, x] = centres[GUIDE * TILE + j] + mean
                spread[y, x] = math.sqrt(max(variance, 0.0))
                mono_share[y, x] = centres[ETA_MONO * TILE + j] / eta


@_compiled
@no_type_check
def correct_rows(
    lidar,
    mono,
    smooth,
    smooth_spread,
    distance,
    spread,
    mono_share,
    space,
    inverse_variance,
    growth_per_m,
    lowest_exponent,
    least_returns,
    rows_from,
    rows_to,
):
    """Correct the rows of a smoothed map by the LiDAR points around each pixel, of which there are few.

    Arguments as of `integrate_rows`, and:
        smooth: [h, w] float64, the average of the estimates, 0 where there is none.
        smooth_spread: the same of their spread.
    """
    (height, width), radius = mono.shape, len(space) // 2
    total = np.zeros((rows_to - rows_from, width))
    first, second = np.zeros_like(total), np.zeros_like(total)
    for y in range(max(0, rows_from - radius), min(height, rows_to + radius)):
        for x in range(width):
            if not (smooth[y, x] > 0 and 0 < lidar[y, x] < np.inf):
                continue
            residual = math.log(lidar[y, x] / smooth[y, x])
            for i in range(max(y - radius, rows_from), min(y + radius + 1, rows_to)):
                for j in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if smooth[i, j] == 0:
                        continue
                    difference = float(mono[y, x]) - float(mono[i, j])
                    of_centre = _inverse_variance(float(mono[i, j]), inverse_variance, growth_per_m)
                    exponent = -0.5 * difference * difference * of_centre
                    if exponent > lowest_exponent:
                        g = math.exp(exponent) * space[i - y + radius] * space[j - x + radius]
                        total[i - rows_from, j] += g
                        first[i - rows_from, j] += g * residual
                        second[i - rows_from, j] += g * residual * residual
    for i in range(rows_to - rows_from):
        y = rows_from + i
        for x in range(width):
            distance[y, x], spread[y, x] = smooth[y, x], smooth_spread[y, x]
            mono_share[y, x] = 1 if smooth[y, x] > 0 else 0
            if total[i, x] > 0:
                part = total[i, x] / max(total[i, x], least_returns)
                mean = first[i, x] / total[i, x]
                variance = max(second[i, x] / total[i, x] - mean * mean, 0.0)
                corrected = smooth[y, x] * math.exp(part * mean)
                distance[y, x], mono_share[y, x] = corrected, 1 - part
                spread[y, x] = math.sqrt(smooth_spread[y, x] ** 2 + part * variance * corrected**2)
