"""The hash grid on the CPU: loops compiled by Numba, shared out to threads; meaning and shapes as in `hash_grid`.

A level is worked on tile by tile. First the table rows and offsets of a whole tile are computed, in a loop of vector
instructions. Then all its rows are called into the cache, so that the reads or additions do not wait for memory one by
one: half the time forward, two thirds backward. The kernels get the number of a row's features as the length of a
tuple, which is a constant to the compiler, so it writes out the loops over them: a third less time. The encoding has
the order of nerfstudio's torch form and no fused multiply-add: the same to the last bit.

Threads are Python's own: they wait for each other without spinning, and unlike Numba's they allow concurrent callers
and forked processes. There are as many as torch may use. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.threads import in_parts, kernel_threads, share_out, stretches

TILE = 64
"""Points worked on together: their rows of the table, 32 kB at most, stay in the nearest cache."""
BLOCK = 1 << 15
"""Points taken through all levels before the next ones: the more, the longer a level's table stays in the cache; but
each level writes into all of the block's rows, which should stay near too."""
LEAST_SHARE = 1 << 14
"""A thread gets at least so many points times levels, 0.2 ms of work: fewer are not worth its waking."""

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)
"""Instant-NGP's factors of the second and third coordinate; the first's is 1."""
ONE = np.float32(1)


@intrinsic
@no_type_check  # the tests' type checker would wrap what Numba has to read
def _call_into_cache(_, array, at):
    """Let the processor fetch the place `at` of a flat array, and wait for nothing."""

    def generate(context, build, signature, given):
        pointer, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        prefetch = build.module.declare_intrinsic(
            "llvm.prefetch", [pointer], ir.FunctionType(ir.VoidType(), [pointer, number, number, number])
        )
        base = context.make_array(signature.args[0])(context, build, given[0]).data
        address = build.bitcast(build.gep(base, [given[1]]), pointer)
        to_read, nearest, of_data = (ir.Constant(number, value) for value in (0, 3, 1))
        build.call(prefetch, [address, to_read, nearest, of_data])
        return context.get_dummy_value()

    return types.void(array, at), generate


@compiled()
@no_type_check
def _call_corners(grid, begins, count):
    """Call the corners of a tile's first points into the cache."""
    for corner in range(8):
        for j in range(count):
            _call_into_cache(grid, np.intp(begins[corner * TILE + j]))


@compiled()
@no_type_check
def _find_corners(x, y, z, count, scaling, size, features, begins, offsets):
    """Give where the eight corners around each of `count` points begin in a level's table, and the places between them.

    Corner k stands from k * TILE on, as row times `len(features)`; its bits say on which axes it is the upper one (1 =
    x, 2 = y, 4 = z). A point on a border of cells has the same lower and upper corner there. nerfstudio hashes in
    int64; the lowest 32 bits, of which the mask keeps some, are those of arithmetic in uint32, for negative coordinates
    too. A level's table has less than 2^32 numbers.
    """
    mask, times = np.uint32(size - 1), np.uint32(len(features))
    for j in range(count):
        scaled_x, scaled_y, scaled_z = x[j] * scaling, y[j] * scaling, z[j] * scaling
        x_low, y_low, z_low = np.int32(np.floor(scaled_x)), np.int32(np.floor(scaled_y)), np.int32(np.floor(scaled_z))
        x_high, y_high, z_high = np.int32(np.ceil(scaled_x)), np.int32(np.ceil(scaled_y)), np.int32(np.ceil(scaled_z))
        offsets[j] = scaled_x - np.float32(x_low)
        offsets[TILE + j] = scaled_y - np.float32(y_low)
        offsets[2 * TILE + j] = scaled_z - np.float32(z_low)
        x0, x1 = np.uint32(x_low), np.uint32(x_high)
        y0, y1 = np.uint32(np.uint32(y_low) * PRIME_Y), np.uint32(np.uint32(y_high) * PRIME_Y)
        z0, z1 = np.uint32(np.uint32(z_low) * PRIME_Z), np.uint32(np.uint32(z_high) * PRIME_Z)
        begins[j] = ((x0 ^ y0 ^ z0) & mask) * times
        begins[TILE + j] = ((x1 ^ y0 ^ z0) & mask) * times
        begins[2 * TILE + j] = ((x0 ^ y1 ^ z0) & mask) * times
        begins[3 * TILE + j] = ((x1 ^ y1 ^ z0) & mask) * times
        begins[4 * TILE + j] = ((x0 ^ y0 ^ z1) & mask) * times
        begins[5 * TILE + j] = ((x1 ^ y0 ^ z1) & mask) * times
        begins[6 * TILE + j] = ((x0 ^ y1 ^ z1) & mask) * times
        begins[7 * TILE + j] = ((x1 ^ y1 ^ z1) & mask) * times


@compiled()
@no_type_check
def _corners_of(begins, j, c):
    """Give where one feature stands at the eight corners of one point of a tile."""
    c = np.uint32(c)  # without a sign: else each index is looked at whether it counts from the end
    return (
        begins[j] + c,
        begins[TILE + j] + c,
        begins[2 * TILE + j] + c,
        begins[3 * TILE + j] + c,
        begins[4 * TILE + j] + c,
        begins[5 * TILE + j] + c,
        begins[6 * TILE + j] + c,
        begins[7 * TILE + j] + c,
    )


@compiled()
@no_type_check
def _turn(values, turned, begin, end):
    """Copy [points, n] to [n, points], some points, tile by tile; calls for different points may run at once."""
    for first in range(begin, end, TILE):
        last = min(first + TILE, end)
        for column in range(values.shape[1]):
            for point in range(first, last):
                turned[column, point] = values[point, column]


@compiled()
@no_type_check
def encode_points(axes, table, features, scalings, encoded, first_point, last_point):
    """Encode some points; calls for different points may run at once.

    `axes` are the positions, [3, points]; `table` is flat: rows of `len(features)` numbers, level after level.
    """
    numbers = len(table) // len(scalings)
    begins, offsets = np.empty(8 * TILE, np.uint32), np.empty(3 * TILE, np.float32)
    for block in range(first_point, last_point, BLOCK):
        block_end = min(block + BLOCK, last_point)
        for level in range(len(scalings)):
            grid = table[level * numbers : (level + 1) * numbers]
            column, size = level * len(features), numbers // len(features)
            for first in range(block, block_end, TILE):
                count = min(TILE, block_end - first)
                x_from, y_from, z_from = axes[0, first:], axes[1, first:], axes[2, first:]
                _find_corners(x_from, y_from, z_from, count, scalings[level], size, features, begins, offsets)
                _call_corners(grid, begins, count)
                for j in range(count):
                    x, y, z = offsets[j], offsets[TILE + j], offsets[2 * TILE + j]
                    rest_x, rest_y, rest_z = ONE - x, ONE - y, ONE - z
                    for c in range(len(features)):
                        r0, r1, r2, r3, r4, r5, r6, r7 = _corners_of(begins, j, c)
                        low_low = grid[r1] * x + grid[r0] * rest_x
                        high_low = grid[r3] * x + grid[r2] * rest_x
                        low_high = grid[r5] * x + grid[r4] * rest_x
                        high_high = grid[r7] * x + grid[r6] * rest_x
                        low = high_low * y + low_low * rest_y
                        high = high_high * y + low_high * rest_y
                        encoded[first + j, column + c] = high * z + low * rest_z


@compiled()
@no_type_check
def _add_to_grid(axes, scaling, gradient, column, features, grid, first_point, last_point):
    """Add to one level's flat gradient what some points give; calls for different ones may run at once.

    The level's features begin at row `column` of `gradient`, [levels * features, points].
    """
    size = len(grid) // len(features)
    begins, offsets = np.empty(8 * TILE, np.uint32), np.empty(3 * TILE, np.float32)
    for first in range(first_point, last_point, TILE):
        count = min(TILE, last_point - first)
        x_from, y_from, z_from = axes[0, first:], axes[1, first:], axes[2, first:]
        _find_corners(x_from, y_from, z_from, count, scaling, size, features, begins, offsets)
        _call_corners(grid, begins, count)
        for j in range(count):
            x, y, z = offsets[j], offsets[TILE + j], offsets[2 * TILE + j]
            rest_x, rest_y, rest_z = ONE - x, ONE - y, ONE - z
            low_low, high_low, low_high, high_high = rest_y * rest_z, y * rest_z, rest_y * z, y * z
            for c in range(len(features)):
                r0, r1, r2, r3, r4, r5, r6, r7 = _corners_of(begins, j, c)
                g = gradient[column + c, first + j]
                grid[r0] += g * low_low * rest_x
                grid[r1] += g * low_low * x
                grid[r2] += g * high_low * rest_x
                grid[r3] += g * high_low * x
                grid[r4] += g * low_high * rest_x
                grid[r5] += g * low_high * x
                grid[r6] += g * high_high * rest_x
                grid[r7] += g * high_high * x


@compiled()
@no_type_check
def _differentiate_points(axes, table, features, scalings, gradient, to_positions, first_point, last_point):
    """Give the gradient to some positions, [points, 3]; calls for different points may run at once."""
    numbers = len(table) // len(scalings)
    begins, offsets = np.empty(8 * TILE, np.uint32), np.empty(3 * TILE, np.float32)
    to_positions[first_point:last_point] = 0
    for block in range(first_point, last_point, BLOCK):
        block_end = min(block + BLOCK, last_point)
        for level in range(len(scalings)):
            grid = table[level * numbers : (level + 1) * numbers]
            column, scaling, size = level * len(features), scalings[level], numbers // len(features)
            for first in range(block, block_end, TILE):
                count = min(TILE, block_end - first)
                x_from, y_from, z_from = axes[0, first:], axes[1, first:], axes[2, first:]
                _find_corners(x_from, y_from, z_from, count, scaling, size, features, begins, offsets)
                _call_corners(grid, begins, count)
                for j in range(count):
                    x, y, z = offsets[j], offsets[TILE + j], offsets[2 * TILE + j]
                    rest_x, rest_y, rest_z = ONE - x, ONE - y, ONE - z
                    to_x, to_y, to_z = np.float32(0), np.float32(0), np.float32(0)
                    for c in range(len(features)):
                        r0, r1, r2, r3, r4, r5, r6, r7 = _corners_of(begins, j, c)
                        g = gradient[first + j, column + c]
                        v0, v1, v2, v3 = grid[r0], grid[r1], grid[r2], grid[r3]
                        v4, v5, v6, v7 = grid[r4], grid[r5], grid[r6], grid[r7]
                        to_x += g * (
                            ((v1 - v0) * rest_y + (v3 - v2) * y) * rest_z + ((v5 - v4) * rest_y + (v7 - v6) * y) * z
                        )
                        low_low, high_low = v1 * x + v0 * rest_x, v3 * x + v2 * rest_x
                        low_high, high_high = v5 * x + v4 * rest_x, v7 * x + v6 * rest_x
                        to_y += g * ((high_low - low_low) * rest_z + (high_high - low_high) * z)
                        to_z += g * ((low_high - low_low) * rest_y + (high_high - high_low) * y)
                    to_positions[first + j, 0] += to_x * scaling
                    to_positions[first + j, 1] += to_y * scaling
                    to_positions[first + j, 2] += to_z * scaling


def _threads(points: int, levels: int) -> int:
    return max(1, min(kernel_threads(), points * levels // LEAST_SHARE))


def _by_column(values: Tensor) -> np.ndarray:
    """[points, n] to [n, points], so that neighbours in memory are neighbouring points."""
    columns = values.detach().t()
    if columns.is_contiguous():
        return columns.numpy()
    given = columns.t().contiguous().numpy()
    turned = np.empty(given.shape[::-1], np.float32)
    in_parts(lambda begin, end: _turn(given, turned, begin, end), len(given), LEAST_SHARE)
    return turned


def encode(
    positions: Float[Tensor, "points 3"], table: Float[Tensor, "rows features"], scalings: Float[Tensor, "levels"]
) -> Float[Tensor, "points encoded"]:
    """Encode points, float32; see `hash_grid`."""
    points, levels = len(positions), len(scalings)
    encoded = torch.empty(points, levels * table.shape[1])
    arrays = _by_column(positions), flat(table), (0,) * table.shape[1], scalings.numpy(), encoded.numpy()
    share_out(lambda part: encode_points(*arrays, *part), stretches(points, _threads(points, levels)))
    return encoded


class Prepared(NamedTuple):
    """A pass of points, as the compiled functions want it."""

    axes: np.ndarray
    """Positions, [3, points]."""
    gradient: np.ndarray
    """To the encoded values, [levels * features, points]: a level reads its own rows alone."""
    scalings: np.ndarray


def prepared(positions: Tensor, gradient: Tensor, scalings: Tensor) -> Prepared:
    """Arrange a pass of points for `add_to_level`."""
    return Prepared(_by_column(positions), _by_column(gradient), scalings.numpy())


def add_to_level(
    points: Prepared, level: int, features: int, grid: np.ndarray, first: int = 0, last: int | None = None
) -> None:
    """Add what points from `first` to `last` give to the gradient of one level of a table, flat; in this thread."""
    axes, gradient, scalings = points
    last = axes.shape[1] if last is None else last
    _add_to_grid(axes, scalings[level], gradient, level * features, (0,) * features, grid, first, last)


def table_gradient(
    positions: Float[Tensor, "points 3"],
    gradient: Float[Tensor, "points encoded"],
    scalings: Float[Tensor, "levels"],
    rows: int,
) -> Float[Tensor, "rows features"]:
    """Give the gradient to a table of `rows` rows, from the gradient to the encoded values.

    Each thread takes an equal stretch of the levels' points, levels far apart in resolution one after the other (fine
    ones take longer). Where a stretch begins within a level, which another thread begins, it adds into a table of its
    own, and that is added in the end.
    """
    count, levels = len(positions), len(scalings)
    size, features = rows // levels, gradient.shape[1] // levels
    points = prepared(positions, gradient, scalings)
    # NumPy asks the system for large pages, torch does not: a third of the time of a table of 64 MB
    grids = np.empty((levels, size * features), np.float32)
    threads = _threads(count, levels)
    order = [level for thread in range(threads) for level in range(thread, levels, threads)]
    own_grids: dict[tuple[int, int], np.ndarray] = {}

    def work(stretch: tuple[int, int]) -> None:
        for place in range(stretch[0] // max(1, count), levels):
            first, last = max(stretch[0] - place * count, 0), min(stretch[1] - place * count, count)
            if last <= first and count > 0:
                break
            level = order[place]
            if first == 0:
                grid = grids[level]
                grid[:] = 0
            else:
                grid = np.zeros(size * features, np.float32)
                own_grids[level, first] = grid
            add_to_level(points, level, features, grid, first, last)

    share_out(work, stretches(count * levels, threads))
    # in one order, whichever thread was ready first: the same sums each time
    for (level, _), grid in sorted(own_grids.items(), key=lambda item: item[0]):
        grids[level] += grid
    return torch.from_numpy(grids).view(rows, features)


def position_gradient(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    gradient: Float[Tensor, "points encoded"],
    scalings: Float[Tensor, "levels"],
) -> Float[Tensor, "points 3"]:
    """Give the gradient to the positions, from the gradient to the encoded values."""
    points, levels = len(positions), len(scalings)
    result = torch.empty(points, 3)
    arrays = (
        _by_column(positions),
        flat(table),
        (0,) * table.shape[1],
        scalings.numpy(),
        gradient.detach().contiguous().numpy(),
        result.numpy(),
    )
    share_out(lambda part: _differentiate_points(*arrays, *part), stretches(points, _threads(points, levels)))
    return result
