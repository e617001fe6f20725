"""The hash grid on a GPU: Triton kernels; meaning and shapes as in `hash_grid`, functions as in `hash_grid_numba`.

Triton comes with torch on Linux, and compiles at the first call for each number of features. In the table's gradient
results differ from the CPU's by the order of additions, which are atomic. A row's features are read and added as one
block: GPUs from sm_90 on add it in one instruction. Samples of a ray lie in few cells, and a GPU adds to one row one
after the other: so what neighbouring points add to a cell is summed up first. (On an H200 the gradients to the tables
of a step took four to nine times as long without.)

With TRITON_INTERPRET=1 set before the import the kernels run on CPU tensors.
"""

from __future__ import annotations

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.triton_launch import launch

POINTS = 128
"""Points that one program works on, one a thread."""
SUMMED_POINTS = 64
"""Those of a program that sums up: of 32, 64 and 128 an H200 was fastest with 64."""


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _corner_pair(scaled, prime: tl.constexpr):
    """Give the lower and the upper corner on one axis, times its prime, and the place between them."""
    low, high = tl.floor(scaled).to(tl.int32), tl.ceil(scaled).to(tl.int32)
    factor = tl.full(scaled.shape, prime, tl.uint32)
    offset = scaled - low.to(tl.float32)
    return low.to(tl.uint32, bitcast=True) * factor, high.to(tl.uint32, bitcast=True) * factor, offset


@triton.jit
@no_type_check
def _find_corners(positions, point, inside, scaling, size, FEATURES: tl.constexpr):
    """Give where the features of a point's eight corners begin in a level's grid, and the place between them."""
    x0, x1, x = _corner_pair(tl.load(positions + 3 * point, inside, 0.0) * scaling, 1)
    y0, y1, y = _corner_pair(tl.load(positions + 3 * point + 1, inside, 0.0) * scaling, 2654435761)
    z0, z1, z = _corner_pair(tl.load(positions + 3 * point + 2, inside, 0.0) * scaling, 805459861)
    mask = (size - 1).to(tl.uint32)
    at0 = ((x0 ^ y0 ^ z0) & mask).to(tl.int64) * FEATURES
    at1 = ((x1 ^ y0 ^ z0) & mask).to(tl.int64) * FEATURES
    at2 = ((x0 ^ y1 ^ z0) & mask).to(tl.int64) * FEATURES
    at3 = ((x1 ^ y1 ^ z0) & mask).to(tl.int64) * FEATURES
    at4 = ((x0 ^ y0 ^ z1) & mask).to(tl.int64) * FEATURES
    at5 = ((x1 ^ y0 ^ z1) & mask).to(tl.int64) * FEATURES
    at6 = ((x0 ^ y1 ^ z1) & mask).to(tl.int64) * FEATURES
    at7 = ((x1 ^ y1 ^ z1) & mask).to(tl.int64) * FEATURES
    return at0, at1, at2, at3, at4, at5, at6, at7, x, y, z


@triton.jit
@no_type_check
def _interpolated(grid, inside, at0, at1, at2, at3, at4, at5, at6, at7, x, y, z):
    """Give one feature of points from its values at their corners, on x, then y, then z."""
    low_low = tl.load(grid + at1, inside, 0.0) * x + tl.load(grid + at0, inside, 0.0) * (1 - x)
    high_low = tl.load(grid + at3, inside, 0.0) * x + tl.load(grid + at2, inside, 0.0) * (1 - x)
    low_high = tl.load(grid + at5, inside, 0.0) * x + tl.load(grid + at4, inside, 0.0) * (1 - x)
    high_high = tl.load(grid + at7, inside, 0.0) * x + tl.load(grid + at6, inside, 0.0) * (1 - x)
    low = high_low * y + low_low * (1 - y)
    high = high_high * y + low_high * (1 - y)
    return high * z + low * (1 - z)


@triton.jit
@no_type_check
def _encode_kernel(
    positions, table, scalings, encoded, points, size, levels, FEATURES: tl.constexpr, BLOCK: tl.constexpr,
    POINTS: tl.constexpr,
):  # fmt: skip
    level = (tl.program_id(0) % levels).to(tl.int64)
    point = (tl.program_id(0) // levels).to(tl.int64) * POINTS + tl.arange(0, POINTS)[:, None]
    feature = tl.arange(0, BLOCK)[None]
    inside = point < points
    at0, at1, at2, at3, at4, at5, at6, at7, x, y, z = _find_corners(
        positions, point, inside, tl.load(scalings + level), size, FEATURES
    )
    has = inside & (feature < FEATURES)
    grid = table + level * size * FEATURES + feature
    value = _interpolated(grid, has, at0, at1, at2, at3, at4, at5, at6, at7, x, y, z)
    place = (point * levels + level) * FEATURES + feature
    tl.store(encoded + place, value.to(encoded.dtype.element_ty), has)


@triton.jit
@no_type_check
def _same_cell(positions, point, other, inside, scaling):
    """Whether two points have the same corners; what is no number has none."""
    same = inside
    for axis in tl.static_range(3):
        here = tl.load(positions + 3 * point + axis, inside, 0.0) * scaling
        there = tl.load(positions + 3 * other + axis, inside, 0.0) * scaling
        same = same & (tl.floor(here) == tl.floor(there)) & (tl.ceil(here) == tl.ceil(there))
    return same


@triton.jit
@no_type_check
def _add_to_run(begins, a0, a1, a2, a3, a4, a5, a6, a7, anew, b0, b1, b2, b3, b4, b5, b6, b7):
    """Add what stands before, unless a run of points in one cell begins between."""
    on = anew == 0
    c0, c1, c2, c3 = tl.where(on, a0, 0.0), tl.where(on, a1, 0.0), tl.where(on, a2, 0.0), tl.where(on, a3, 0.0)
    c4, c5, c6, c7 = tl.where(on, a4, 0.0), tl.where(on, a5, 0.0), tl.where(on, a6, 0.0), tl.where(on, a7, 0.0)
    return begins | anew, c0 + b0, c1 + b1, c2 + b2, c3 + b3, c4 + b4, c5 + b5, c6 + b6, c7 + b7


@triton.jit
@no_type_check
def _table_gradient_kernel(
    positions, gradient, scalings, to_table, points, size, levels, point_stride, feature_stride,
    FEATURES: tl.constexpr, BLOCK: tl.constexpr, POINTS: tl.constexpr,
):  # fmt: skip
    local = tl.arange(0, POINTS)[:, None]
    level = (tl.program_id(0) % levels).to(tl.int64)
    point = (tl.program_id(0) // levels).to(tl.int64) * POINTS + local
    feature = tl.arange(0, BLOCK)[None]
    inside = point < points
    scaling = tl.load(scalings + level)
    at0, at1, at2, at3, at4, at5, at6, at7, x, y, z = _find_corners(positions, point, inside, scaling, size, FEATURES)
    has = inside & (feature < FEATURES)
    g = tl.load(gradient + point * point_stride + (level * FEATURES + feature) * feature_stride, has, 0.0)
    g = g.to(tl.float32)
    low_low, high_low, low_high, high_high = (1 - y) * (1 - z), y * (1 - z), (1 - y) * z, y * z
    g0, g1 = g * low_low * (1 - x), g * low_low * x
    g2, g3 = g * high_low * (1 - x), g * high_low * x
    g4, g5 = g * low_high * (1 - x), g * low_high * x
    g6, g7 = g * high_high * (1 - x), g * high_high * x
    begins = (local == 0) | (_same_cell(positions, point, point - 1, inside & (local > 0), scaling) == 0)
    begins = begins.to(tl.int32) + tl.zeros((POINTS, BLOCK), tl.int32)
    _, g0, g1, g2, g3, g4, g5, g6, g7 = tl.associative_scan((begins, g0, g1, g2, g3, g4, g5, g6, g7), 0, _add_to_run)
    # the last of a run has its sum
    more = (local < POINTS - 1) & (point + 1 < points)
    has = has & (_same_cell(positions, point, point + 1, more, scaling) == 0)
    grid = to_table + level * size * FEATURES + feature
    tl.atomic_add(grid + at0, g0, has, sem="relaxed")
    tl.atomic_add(grid + at1, g1, has, sem="relaxed")
    tl.atomic_add(grid + at2, g2, has, sem="relaxed")
    tl.atomic_add(grid + at3, g3, has, sem="relaxed")
    tl.atomic_add(grid + at4, g4, has, sem="relaxed")
    tl.atomic_add(grid + at5, g5, has, sem="relaxed")
    tl.atomic_add(grid + at6, g6, has, sem="relaxed")
    tl.atomic_add(grid + at7, g7, has, sem="relaxed")


@triton.jit
@no_type_check
def _position_gradient_kernel(
    positions, table, gradient, scalings, to_positions, points, size, point_stride, feature_stride,
    LEVELS: tl.constexpr, FEATURES: tl.constexpr, POINTS: tl.constexpr,
):  # fmt: skip
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    inside = point < points
    to_x = tl.zeros((POINTS,), tl.float32)
    to_y = tl.zeros((POINTS,), tl.float32)
    to_z = tl.zeros((POINTS,), tl.float32)
    for level in range(LEVELS):
        scaling = tl.load(scalings + level)
        at0, at1, at2, at3, at4, at5, at6, at7, x, y, z = _find_corners(
            positions, point, inside, scaling, size, FEATURES
        )
        for c in tl.static_range(FEATURES):
            grid = table + tl.cast(level, tl.int64) * size * FEATURES + c
            feature = tl.cast(level, tl.int64) * FEATURES + c
            v0, v1 = tl.load(grid + at0, inside, 0.0), tl.load(grid + at1, inside, 0.0)
            v2, v3 = tl.load(grid + at2, inside, 0.0), tl.load(grid + at3, inside, 0.0)
            v4, v5 = tl.load(grid + at4, inside, 0.0), tl.load(grid + at5, inside, 0.0)
            v6, v7 = tl.load(grid + at6, inside, 0.0), tl.load(grid + at7, inside, 0.0)
            place = point * point_stride + feature * feature_stride
            g = tl.load(gradient + place, inside, 0.0).to(tl.float32) * scaling
            along_x = ((v1 - v0) * (1 - y) + (v3 - v2) * y) * (1 - z) + ((v5 - v4) * (1 - y) + (v7 - v6) * y) * z
            low_low, high_low = v1 * x + v0 * (1 - x), v3 * x + v2 * (1 - x)
            low_high, high_high = v5 * x + v4 * (1 - x), v7 * x + v6 * (1 - x)
            to_x += g * along_x
            to_y += g * ((high_low - low_low) * (1 - z) + (high_high - low_high) * z)
            to_z += g * ((low_high - low_low) * (1 - y) + (high_high - high_low) * y)
    tl.store(to_positions + 3 * point, to_x, inside)
    tl.store(to_positions + 3 * point + 1, to_y, inside)
    tl.store(to_positions + 3 * point + 2, to_z, inside)


def encode(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    dtype: torch.dtype = torch.float32,
) -> Float[Tensor, "points encoded"]:
    """Encode points in float32; see `hash_grid`. What is given may be rounded to another type at the end."""
    positions, table = positions.detach().contiguous(), table.detach().contiguous()
    points, (rows, features), levels = len(positions), table.shape, len(scalings)
    encoded = positions.new_empty((points, levels * features), dtype=dtype)
    arguments = positions, table, scalings, encoded, points, rows // levels, levels
    constants = {"FEATURES": features, "BLOCK": triton.next_power_of_2(features), "POINTS": POINTS}
    launch(_encode_kernel, (triton.cdiv(points, POINTS) * levels,), *arguments, **constants)
    return encoded


def table_gradient(
    positions: Float[Tensor, "points 3"],
    gradient: Float[Tensor, "points encoded"],
    scalings: Float[Tensor, "levels"],
    rows: int,
) -> Float[Tensor, "rows features"]:
    """Give the gradient to a table of `rows` rows, from the gradient to the encoded values."""
    positions, gradient = positions.detach().contiguous(), gradient.detach()
    points, levels = len(positions), len(scalings)
    features = gradient.shape[1] // levels
    result = positions.new_zeros(rows, features)
    arguments = positions, gradient, scalings, result, points, rows // levels, levels, *gradient.stride()
    constants = {"FEATURES": features, "BLOCK": triton.next_power_of_2(features), "POINTS": SUMMED_POINTS}
    programs = triton.cdiv(points, SUMMED_POINTS) * levels
    launch(_table_gradient_kernel, (programs,), *arguments, **constants, num_warps=SUMMED_POINTS // 32)
    return result


def position_gradient(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    gradient: Float[Tensor, "points encoded"],
    scalings: Float[Tensor, "levels"],
) -> Float[Tensor, "points 3"]:
    """Give the gradient to the positions, from the gradient to the encoded values."""
    positions, table, gradient = positions.detach().contiguous(), table.detach().contiguous(), gradient.detach()
    points, (rows, features), levels = len(positions), table.shape, len(scalings)
    result = torch.empty_like(positions)
    arguments = positions, table, gradient, scalings, result, points, rows // levels, *gradient.stride()
    constants = {"LEVELS": levels, "FEATURES": features, "POINTS": POINTS}
    launch(_position_gradient_kernel, (triton.cdiv(points, POINTS),), *arguments, **constants)
    return result
