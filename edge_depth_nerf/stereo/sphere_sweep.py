"""The loops of the sphere sweep on the CPU, compiled by Numba; what they are for stands in `stereo.sweep`.

Pictures are float32 grey levels, NaN where they are not used: a window with such a pixel has no value, by itself. All
arithmetic is float32. Inner loops run over neighbouring pixels of a row, or over neighbouring hypotheses, without
branches, so that the compiler turns them into vector instructions.

Importing this module imports Numba.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np

from edge_depth_nerf.kernels.compiled import compiled

RADIUS_PX = 2
"""Of the windows that are compared; known to the compiler."""
PATHS = 8
"""Of the semi-global aggregation."""

_SIDE = 2 * RADIUS_PX + 1
_ZERO, _ONE, _TWO, _HALF = np.float32(0), np.float32(1), np.float32(2), np.float32(0.5)
_NAN, _NONE = np.float32(np.nan), np.float32(-2)
_PER_WINDOW = np.float32(1 / _SIDE**2)

_compiled = compiled(fastmath={"contract"}, error_model="numpy")


@_compiled
@no_type_check
def _project_row(rays, inverses_per_m, turn, shift, factors, numbers, work):
    """Project points on a row of rays into another picture, by its `ProjectionSeries`.

    Args:
        rays: [3, n] unit rays; 0 where there is none.
        inverses_per_m: [n] of the points' distances along them; 0 is infinity.
        turn: [3, 3] rotation to the other camera's axes.
        shift: [3] this camera's centre in the other's axes, metres.
        factors: of the series.
        numbers: of the series.
        work: [8 or more, n] working space. Its row 5 gets the column, counted from the first pixel's centre, -1 where
            the picture does not reach; row 6 the row; row 7 the distance from the other camera over that from this one.
    """
    x, y, place, radial, plain = work[0], work[1], work[2], work[3], work[4]
    u, v, length = work[5], work[6], work[7]
    p1, p2, least, per_cosine = numbers[4], numbers[5], numbers[6], numbers[7]
    for j in range(len(u)):
        near = inverses_per_m[j]
        a = turn[0, 0] * rays[0, j] + turn[0, 1] * rays[1, j] + turn[0, 2] * rays[2, j] + shift[0] * near
        b = turn[1, 0] * rays[0, j] + turn[1, 1] * rays[1, j] + turn[1, 2] * rays[2, j] + shift[1] * near
        c = turn[2, 0] * rays[0, j] + turn[2, 1] * rays[1, j] + turn[2, 2] * rays[2, j] + shift[2] * near
        length[j] = math.sqrt(a * a + b * b + c * c)
        inverse = _ONE / length[j]
        x[j], y[j] = a * inverse, b * inverse
        place[j] = (c * inverse - least) * per_cosine - _ONE
        radial[j] = factors[0, 0]
        plain[j] = factors[1, 0]
    for k in range(1, factors.shape[1]):
        for j in range(len(u)):
            radial[j] = radial[j] * place[j] + factors[0, k]
    if p1 != _ZERO or p2 != _ZERO:
        for k in range(1, factors.shape[1]):
            for j in range(len(u)):
                plain[j] = plain[j] * place[j] + factors[1, k]
    for j in range(len(u)):
        a, b = plain[j] * x[j], plain[j] * y[j]
        square, along = a * a + b * b, _TWO * (p2 * a + p1 * b)
        column = numbers[0] * (radial[j] * x[j] + p2 * square + along * a) + numbers[2] - _HALF
        u[j] = column if place[j] >= -_ONE else -_ONE
        v[j] = numbers[1] * (radial[j] * y[j] + p1 * square + along * b) + numbers[3] - _HALF


@_compiled
@no_type_check
def _sample_row(picture, u, v, out):
    """Read a picture between pixels, bilinearly; NaN outside, and beside a pixel that is NaN."""
    last_column, last_row = np.float32(picture.shape[1] - 1), np.float32(picture.shape[0] - 1)
    for j in range(len(out)):
        column, row = u[j], v[j]
        if column >= _ZERO and row >= _ZERO and column < last_column and row < last_row:
            x, y = np.int32(column), np.int32(row)
            right, below = column - np.float32(x), row - np.float32(y)
            upper = picture[y, x] + right * (picture[y, x + 1] - picture[y, x])
            lower = picture[y + 1, x] + right * (picture[y + 1, x + 1] - picture[y + 1, x])
            out[j] = upper + below * (lower - upper)
        else:
            out[j] = _NAN


@_compiled
@no_type_check
def _sum_windows_along(reference, other, first, second, cross):
    """Sum a row, its square and its product with another over the width of windows; the ends stay unchanged."""
    for j in range(RADIUS_PX, len(reference) - RADIUS_PX):
        a = b = c = _ZERO
        for k in range(-RADIUS_PX, RADIUS_PX + 1):
            value = other[j + k]
            a += value
            b += value * value
            c += value * reference[j + k]
        first[j], second[j], cross[j] = a, b, c


@_compiled
@no_type_check
def _correlate_row(first, second, cross, mean, inverse_deviation, noise, out):
    """Correlate the windows of a row from the sums along its _SIDE rows; NaN where a window is not whole."""
    for j in range(len(out)):
        a = b = c = _ZERO
        for k in range(_SIDE):
            a += first[k, j]
            b += second[k, j]
            c += cross[k, j]
        average = a * _PER_WINDOW
        spread = b * _PER_WINDOW - average * average
        variance = (spread if spread > _ZERO else _ZERO) + noise
        found = (c * _PER_WINDOW - average * mean[j]) * inverse_deviation[j] / math.sqrt(variance)
        # what is not a number is not seen
        out[j] = found if spread == spread and mean[j] == mean[j] else _NONE


@_compiled
@no_type_check
def _window_statistics(picture, noise, mean, inverse_deviation):
    """Give the mean and the inverse standard deviation of windows of a picture, NaN at its rim."""
    height, width = picture.shape
    mean[:], inverse_deviation[:] = _NAN, _NAN
    for i in range(RADIUS_PX, height - RADIUS_PX):
        for j in range(RADIUS_PX, width - RADIUS_PX):
            first = second = _ZERO
            for k in range(-RADIUS_PX, RADIUS_PX + 1):
                for l in range(-RADIUS_PX, RADIUS_PX + 1):
                    value = picture[i + k, j + l]
                    first += value
                    second += value * value
            average = first * _PER_WINDOW
            mean[i, j] = average
            inverse_deviation[i, j] = _ONE / math.sqrt(max(second * _PER_WINDOW - average * average, _ZERO) + noise)


@_compiled
@no_type_check
def _best_half_row(found, count, total, cost):
    """Average the greater half of each column of `found`, of those that are seen; `found` is put in order."""
    neighbours = len(found)
    for last in range(neighbours - 1, 0, -1):
        for n in range(last):
            greater, less = found[n], found[n + 1]
            for j in range(len(cost)):
                a, b = greater[j], less[j]
                greater[j] = a if a > b else b
                less[j] = b if a > b else a
    for j in range(len(cost)):
        count[j], total[j] = _ZERO, _ZERO
    for n in range(neighbours):
        for j in range(len(cost)):
            count[j] += _ONE if found[n, j] > _NONE else _ZERO
    for n in range((neighbours + 1) // 2):
        for j in range(len(cost)):
            taken = found[n, j] > _ZERO and count[j] > np.float32(2 * n)
            total[j] += found[n, j] if taken else _ZERO
    for j in range(len(cost)):
        half = np.float32(np.int32((count[j] + _ONE) * _HALF))
        cost[j] = _ONE - total[j] / (half if half > _ONE else _ONE)


@_compiled
@no_type_check
def sweep(reference, pictures, rays, spans, turns, shifts, factors, numbers, inverses_per_m, noise, cost):
    """Fill `cost` with 1 - the mean correlation of the best half of the neighbours; 1 where none sees the point.

    Args:
        reference: [h, w] grey levels.
        pictures: [neighbours, h, w] theirs, NaN beyond the smaller ones.
        rays: [3, h, w] of the reference picture.
        spans: [h, 2] first column of each row that is used, and the one after the last.
        turns: [neighbours, 3, 3] from the reference's axes to theirs.
        shifts: [neighbours, 3] the reference's centre in their axes, metres.
        factors: [neighbours, 2, length] of their projection series.
        numbers: [neighbours, 8] of these.
        inverses_per_m: [hypotheses].
        noise: variance of the pictures' noise, grey levels².
        cost: [h, hypotheses, w], gets 0 to 1.
    """
    height, width = reference.shape
    neighbours = len(pictures)
    mean, inverse_deviation = np.empty_like(reference), np.empty_like(reference)
    _window_statistics(reference, noise, mean, inverse_deviation)
    work = np.empty((10, width), np.float32)
    # sums along the last rows, of each neighbour
    sums = np.empty((neighbours, 3, _SIDE, width), np.float32)
    found = np.empty((neighbours, width), np.float32)
    cost[:] = _ONE
    for h in range(len(inverses_per_m)):
        sums[:] = _NAN
        work[9] = inverses_per_m[h]
        for i in range(height):
            first, last = spans[i]
            ring = i % _SIDE
            for n in range(neighbours):
                if last - first < _SIDE:
                    continue
                part = work[:, first:last]
                _project_row(rays[:, i, first:last], part[9], turns[n], shifts[n], factors[n], numbers[n], part)
                _sample_row(pictures[n], part[5], part[6], part[8])
                row = sums[n, :, ring, first:last]
                _sum_windows_along(reference[i, first:last], part[8], row[0], row[1], row[2])
            centre = i - RADIUS_PX
            if centre < 0:
                continue
            # where a window of the reference picture is whole, its rows' sums are those of this round
            first, last = spans[centre]
            if last > first:
                part = sums[:, :, :, first:last]
                for n in range(neighbours):
                    _correlate_row(
                        *(part[n, 0], part[n, 1], part[n, 2]),
                        *(mean[centre, first:last], inverse_deviation[centre, first:last], noise),
                        found[n, first:last],
                    )
                _best_half_row(
                    *(found[:, first:last], work[0, first:last], work[1, first:last], cost[centre, h, first:last])
                )


@_compiled
@no_type_check
def _step(cost, before, least_before, small, large, after):
    """Take one step of a path (Hirschmüller 2008, eq. 13); rows have a number on each side that is no hypothesis."""
    far = least_before + large
    for d in range(len(cost)):
        beside = before[d] if before[d] < before[d + 2] else before[d + 2]
        near = beside + small
        near = near if near < before[d + 1] else before[d + 1]
        after[d + 1] = cost[d] + (near if near < far else far) - least_before


@compiled(fastmath={"contract", "nnan", "nsz", "reassoc"})
@no_type_check
def _least(row):
    least = row[0]
    for d in range(len(row)):
        least = row[d] if row[d] < least else least
    return least


@_compiled
@no_type_check
def _take_paths(cost, picture, small, large, edge, i, direction, rows, leasts, total):
    """Take the four paths that come to the pixels of a row from one side, and add them to `total` [w, hypotheses]."""
    height, width = picture.shape
    count = cost.shape[1]
    above, here = rows[(i + 1) % 2], rows[i % 2]
    least_above, least_here = leasts[(i + 1) % 2], leasts[i % 2]
    for step in range(width):
        j = step if direction > 0 else width - 1 - step
        value = picture[i, j]
        for path in range(4):
            if not value == value:
                least_here[path, j] = _NAN
                continue
            # from beside, and from the three above (or below)
            y, x = (i, j - direction) if path == 0 else (i - direction, j + path - 2)
            after = here[path, j]
            there = 0 <= y < height and 0 <= x < width
            least = (least_here[path, x] if path == 0 else least_above[path, x]) if there else _NAN
            if least == least:
                # a change of brightness is where a thing may end
                jump = large / (_ONE + abs(value - picture[y, x]) / edge)
                before = here[path, x] if path == 0 else above[path, x]
                _step(cost[j], before, least, small, jump if jump > small else small, after)
            else:
                after[1 : count + 1] = cost[j]
            least_here[path, j] = _least(after[1 : count + 1])
            here_total = total[j]
            for d in range(count):
                here_total[d] += after[d + 1]


@_compiled
@no_type_check
def aggregate(cost, picture, small, large, edge, total):
    """Average the cost along eight paths to each pixel (semi-global matching).

    Args:
        cost: [h, hypotheses, w].
        picture: [h, w] grey levels, NaN where not used; no path goes there.
        small: penalty for one hypothesis from a pixel to the next.
        large: penalty for more; less where brightness changes.
        edge: the change of brightness, grey levels, that halves it.
        total: [h, w, hypotheses] gets the mean of the paths; 0 where not used.
    """
    height, count, width = cost.shape
    rows = np.empty((2, 4, width, count + 2), np.float32)
    leasts = np.empty((2, 4, width), np.float32)
    costs = np.empty((width, count), np.float32)
    share = np.float32(1 / PATHS)
    total[:] = _ZERO
    for direction in (1, -1):
        leasts[:] = _NAN
        rows[:] = np.inf
        for step in range(height):
            i = step if direction > 0 else height - 1 - step
            for d in range(count):
                for j in range(width):
                    costs[j, d] = cost[i, d, j] * share
            _take_paths(costs, picture, small * share, large * share, edge, i, direction, rows, leasts, total[i])


@_compiled
@no_type_check
def choose(total, cost, picture, inverses_per_m, apart, place, correlation, margin):
    """Find each pixel's best hypothesis, between the hypotheses by the parabola through it and those beside it.

    Args:
        total: [h, w, hypotheses] from `aggregate`.
        cost: [h, hypotheses, w] from `sweep`.
        picture: [h, w] grey levels, NaN where not used.
        inverses_per_m: [hypotheses].
        apart: hypotheses within so many of the best are no others.
        place: [h, w] gets the inverse distance; 0 where not used.
        correlation: [h, w] gets the correlation at the best hypothesis, before the aggregation.
        margin: [h, w] gets how much worse the best of the others is, after it.
    """
    height, width, count = total.shape
    place[:], correlation[:], margin[:] = _ZERO, _ZERO, _ZERO
    for i in range(height):
        for j in range(width):
            if not picture[i, j] == picture[i, j]:
                continue
            row = total[i, j]
            best = 0
            for d in range(count):
                best = d if row[d] < row[best] else best
            other = np.float32(np.inf)
            for d in range(count):
                if (d < best - apart or d > best + apart) and row[d] < other:
                    other = row[d]
            correlation[i, j] = _ONE - cost[i, best, j]
            margin[i, j] = other - row[best] if other < np.inf else _ZERO
            place[i, j] = inverses_per_m[best]
            if 0 < best < count - 1:
                bend = row[best - 1] - _TWO * row[best] + row[best + 1]
                off = _HALF * (row[best - 1] - row[best + 1]) / bend if bend > _ZERO else _ZERO
                beside = inverses_per_m[best + 1] if off > _ZERO else inverses_per_m[best - 1]
                place[i, j] += abs(off) * (beside - inverses_per_m[best])


@_compiled
@no_type_check
def parallax(rays, inverses_per_m, pictures, turns, shifts, factors, numbers, angle):
    """Fill `angle` [h, w] with the largest angle between a point and the infinity behind it, of those that see it.

    It is in radians, and 0 where no neighbour sees the point. `inverses_per_m` [h, w] are the points'; all else is as
    for `sweep`.
    """
    height, width = inverses_per_m.shape
    work = np.empty((9, width), np.float32)
    angle[:] = _ZERO
    for n in range(len(turns)):
        offset = turns[n].T.copy() @ shifts[n]
        square = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
        for i in range(height):
            _project_row(rays[:, i], inverses_per_m[i], turns[n], shifts[n], factors[n], numbers[n], work)
            _sample_row(pictures[n], work[5], work[6], work[8])
            for j in range(width):
                if work[8, j] == work[8, j]:
                    along = offset[0] * rays[0, i, j] + offset[1] * rays[1, i, j] + offset[2] * rays[2, i, j]
                    across = math.sqrt(max(square - along * along, _ZERO))
                    near = inverses_per_m[i, j]
                    angle[i, j] = max(angle[i, j], math.atan2(near * across, _ONE + near * along))


@_compiled
@no_type_check
def compare(rays, inverses_per_m, unsure, theirs, turns, shifts, factors, numbers, share, agree, against, mean):
    """Ask neighbours' maps about a map's points; what is not listed is as for `sweep`.

    `inverses_per_m` [h, w] is the map, 0 where there is none, and `theirs` [neighbours, h, w] are the neighbours'. They
    agree if they differ by less than `share` of an inverse distance and `unsure` [h, w] together. `agree` [h, w] gets
    how many neighbours have the point, `against` [h, w] how many see through it, `mean` [h, w] the mean of the inverse
    distances that agree, its own among them.
    """
    height, width = inverses_per_m.shape
    work = np.empty((8, width), np.float32)
    agree[:], against[:] = 0, 0
    mean[:] = inverses_per_m
    for n in range(len(turns)):
        last_row, last_column = theirs[n].shape[0] - 1, theirs[n].shape[1] - 1
        for i in range(height):
            _project_row(rays[:, i], inverses_per_m[i], turns[n], shifts[n], factors[n], numbers[n], work)
            for j in range(width):
                here = inverses_per_m[i, j]
                u, v = work[5, j] + _HALF, work[6, j] + _HALF
                if not (here > _ZERO and u >= _ZERO and v >= _ZERO and u < last_column + 1 and v < last_row + 1):
                    continue
                there = theirs[n, int(v), int(u)]
                if there == _ZERO:
                    continue
                # both as inverse distances from this camera
                seen = there * work[7, j]
                allowed = share * here + unsure[i, j]
                if abs(seen - here) <= allowed:
                    agree[i, j] += 1
                    mean[i, j] += seen
                elif seen < here:
                    against[i, j] += 1
    for i in range(height):
        for j in range(width):
            mean[i, j] /= np.float32(agree[i, j] + 1)
