"""A small network on a GPU in one kernel, and its backward in another; meaning and arguments as `network.network`.

Products are of float16 with sums of float32, as in torch under autocast, and what lies between the layers stays on the
chip. Backward computes the hidden layers again and writes them beside their gradients, in float16; torch multiplies
these to the weights' gradients, as these do not find room on the chip (three layers of 64).

Where nobody follows gradients, the hash grid in front of a network can be computed in the network's kernel, too
(`encoded_network`): the encoded values are never written to memory. That is the case for proposal networks at rest.

Networks have two or three layers, at most `WIDEST` wide. No GPU has run this: it is off unless the environment says
EDGE_DEPTH_NERF_NETWORK=triton, or triton+encoding for the second form as well. With TRITON_INTERPRET=1 set before the
import it runs on CPU tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.hash_grid_triton import find_corners, interpolated
from edge_depth_nerf.kernels.triton_launch import launch

WIDEST = 64
"""Numbers in a layer that stay on the chip."""
POINTS, BACKWARD_POINTS, BACKWARD_WARPS = 64, 128, 8
"""Points that a program works on. With fewer points or warps, backward needs more registers than sm_80 and sm_89
have."""


def fits(weights: Sequence[Tensor]) -> bool:
    """Whether this module serves a network with such weights, each [out, in]."""
    hidden = {len(weight) for weight in weights[:-1]}
    widest = max(max(weight.shape) for weight in weights)
    return len(weights) in (2, 3) and len(hidden) == 1 and widest <= WIDEST


def _block(width: int) -> int:
    """A power of two that tensor cores take."""
    return max(16, triton.next_power_of_2(width))


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _matrix(pointer, rows, columns, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    """Load a matrix in float16, 0 beyond its rows and columns."""
    row, column = tl.arange(0, ROWS)[:, None], tl.arange(0, COLUMNS)[None]
    return tl.load(pointer + row * columns + column, (row < rows) & (column < columns), 0.0).to(tl.float16)


@triton.jit
@no_type_check
def _bias(pointer, width, WIDTH: tl.constexpr):
    column = tl.arange(0, WIDTH)
    return tl.load(pointer + column, column < width, 0.0)[None]


@triton.jit
@no_type_check
def _first_layer(x, w0, bias, point, inside, group, hidden, HIDDEN: tl.constexpr):
    """Give the first hidden layer; its bias is that of the group that a point belongs to."""
    column = tl.arange(0, HIDDEN)[None]
    row = (point // group)[:, None]
    b = tl.load(bias + row * hidden + column, inside[:, None] & (column < hidden), 0.0)
    return tl.maximum(tl.dot(x, tl.trans(w0)) + b, 0.0).to(tl.float16)


@triton.jit
@no_type_check
def _points(pointer, point, inside, stride, width, WIDTH: tl.constexpr):
    """Load a row for each point, in float16."""
    column = tl.arange(0, WIDTH)[None]
    has = inside[:, None] & (column < width)
    return tl.load(pointer + point[:, None] * stride + column, has, 0.0).to(tl.float16)


@triton.jit
@no_type_check
def _store(pointer, values, point, inside, width, WIDTH: tl.constexpr):
    """Store a row for each point."""
    column = tl.arange(0, WIDTH)[None]
    has = inside[:, None] & (column < width)
    tl.store(pointer + point[:, None] * width + column, values.to(pointer.dtype.element_ty), has)


@triton.jit
@no_type_check
def _other_layers(
    h, weight1, bias1, weight2, bias2, hidden, out, LAYERS: tl.constexpr, HIDDEN: tl.constexpr, OUT: tl.constexpr
):
    """Give the last layer from the first hidden one."""
    if LAYERS == 3:
        w1 = _matrix(weight1, hidden, hidden, HIDDEN, HIDDEN)
        h = tl.maximum(tl.dot(h, tl.trans(w1)) + _bias(bias1, hidden, HIDDEN), 0.0).to(tl.float16)
    return tl.dot(h, tl.trans(_matrix(weight2, out, hidden, OUT, HIDDEN))) + _bias(bias2, out, OUT)


@triton.jit
@no_type_check
def _forward_kernel(
    xs,
    weight0,
    bias0,
    weight1,
    bias1,
    weight2,
    bias2,
    result,
    points,
    stride,
    group,
    width,
    hidden,
    out,
    LAYERS: tl.constexpr,
    WIDTH: tl.constexpr,
    HIDDEN: tl.constexpr,
    OUT: tl.constexpr,
    POINTS: tl.constexpr,
):
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    inside = point < points
    x = _points(xs, point, inside, stride, width, WIDTH)
    h = _first_layer(x, _matrix(weight0, hidden, width, HIDDEN, WIDTH), bias0, point, inside, group, hidden, HIDDEN)
    y = _other_layers(h, weight1, bias1, weight2, bias2, hidden, out, LAYERS, HIDDEN, OUT)
    _store(result, y, point, inside, out, OUT)


@triton.jit
@no_type_check
def _encoded_kernel(
    positions,
    table,
    scalings,
    weight0,
    bias0,
    weight1,
    bias1,
    weight2,
    bias2,
    result,
    points,
    size,
    levels,
    hidden,
    out,
    FEATURES: tl.constexpr,
    LAYERS: tl.constexpr,
    HIDDEN: tl.constexpr,
    OUT: tl.constexpr,
    POINTS: tl.constexpr,
):
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    inside = point < points
    column = tl.arange(0, HIDDEN)
    h = tl.zeros((POINTS, HIDDEN), tl.float32) + _bias(bias0, hidden, HIDDEN)
    for level in range(levels):
        at0, at1, at2, at3, at4, at5, at6, at7, x, y, z = find_corners(
            positions, point, inside, tl.load(scalings + level), size, FEATURES
        )
        for c in tl.static_range(FEATURES):
            place = level * FEATURES + c
            grid = table + tl.cast(level, tl.int64) * size * FEATURES + c
            value = interpolated(grid, inside, at0, at1, at2, at3, at4, at5, at6, at7, x, y, z)
            weight = tl.load(weight0 + column * (levels * FEATURES) + place, column < hidden, 0.0)
            # rounded as if it had been written for tensor cores
            value, weight = value.to(tl.float16).to(tl.float32), weight.to(tl.float16).to(tl.float32)
            h += value[:, None] * weight[None]
    h = tl.maximum(h, 0.0).to(tl.float16)
    last = _other_layers(h, weight1, bias1, weight2, bias2, hidden, out, LAYERS, HIDDEN, OUT)
    _store(result, last, point, inside, out, OUT)


@triton.jit
@no_type_check
def _backward_kernel(
    xs,
    weight0,
    bias0,
    weight1,
    bias1,
    weight2,
    gradient,
    hidden0,
    hidden1,
    to_hidden0,
    to_hidden1,
    to_x,
    points,
    stride,
    group,
    width,
    hidden,
    out,
    LAYERS: tl.constexpr,
    WIDTH: tl.constexpr,
    HIDDEN: tl.constexpr,
    OUT: tl.constexpr,
    POINTS: tl.constexpr,
):
    point = tl.program_id(0).to(tl.int64) * POINTS + tl.arange(0, POINTS)
    inside = point < points
    w0 = _matrix(weight0, hidden, width, HIDDEN, WIDTH)
    x = _points(xs, point, inside, stride, width, WIDTH)
    h0 = _first_layer(x, w0, bias0, point, inside, group, hidden, HIDDEN)
    _store(hidden0, h0, point, inside, hidden, HIDDEN)
    g = _points(gradient, point, inside, out, out, OUT)
    d = tl.dot(g, _matrix(weight2, out, hidden, OUT, HIDDEN))
    if LAYERS == 3:
        w1 = _matrix(weight1, hidden, hidden, HIDDEN, HIDDEN)
        h1 = tl.maximum(tl.dot(h0, tl.trans(w1)) + _bias(bias1, hidden, HIDDEN), 0.0).to(tl.float16)
        _store(hidden1, h1, point, inside, hidden, HIDDEN)
        d1 = tl.where(h1 > 0, d, 0.0).to(tl.float16)
        _store(to_hidden1, d1, point, inside, hidden, HIDDEN)
        d = tl.dot(d1, w1)
    d0 = tl.where(h0 > 0, d, 0.0).to(tl.float16)
    _store(to_hidden0, d0, point, inside, hidden, HIDDEN)
    _store(to_x, tl.dot(d0, w0), point, inside, width, WIDTH)


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> Tensor:
        ctx.save_for_backward(x, *parameters)
        return _forward(x, parameters[::2], parameters[1::2])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        x, *parameters = ctx.saved_tensors
        with torch.autocast(x.device.type, enabled=False):
            return _backward(x, parameters[::2], parameters[1::2], gradients[0])


def _backward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], gradient: Tensor) -> tuple[Tensor, ...]:
    """Give the gradients to x, then to weight and bias of each layer."""
    (hidden, width), out, points = weights[0].shape, len(weights[-1]), len(x)
    x, gradient = x if x.stride(1) == 1 else x.contiguous(), gradient.contiguous()
    groups = len(biases[0].view(-1, hidden))
    group = max(1, points // groups)
    layers = [(weight.contiguous(), bias.contiguous()) for weight, bias in zip(weights, biases, strict=True)]
    between = [torch.empty(points, hidden, dtype=torch.float16, device=x.device) for _ in weights[:-1]]
    to_between = [torch.empty_like(each) for each in between]
    to_x = torch.empty(points, width, dtype=x.dtype, device=x.device)
    launch(
        _backward_kernel,
        (triton.cdiv(points, BACKWARD_POINTS),),
        x,
        x,
        *layers[0],
        *layers[-2],  # of two layers the one between is not read
        layers[-1][0],
        gradient,
        between[0],
        between[-1],
        to_between[0],
        to_between[-1],
        to_x,
        points,
        x.stride(0),
        group,
        width,
        hidden,
        out,
        LAYERS=len(weights),
        WIDTH=_block(width),
        HIDDEN=_block(hidden),
        OUT=_block(out),
        POINTS=BACKWARD_POINTS,
        num_warps=BACKWARD_WARPS,
    )
    inputs, slopes = [x.half(), *between], [*to_between, gradient.half()]
    found = [to_x]
    for number, (slope, values) in enumerate(zip(slopes, inputs, strict=True)):
        rows = slope.view(groups, group, -1) if number == 0 and points > 0 else slope[None]
        to_bias = rows.sum(1, dtype=torch.float32) if points > 0 else torch.zeros_like(biases[number])
        found += [slope.t().mm(values).to(weights[number]), to_bias.view(biases[number].shape)]
    return tuple(found)


def network(
    x: Float[Tensor, "points in"], weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Float[Tensor, "points out"]:
    """Apply a network to points, differentiable once by all it is given; see `network.network`.

    Args:
        x: half precision or float32.
        weights: of each layer, [out, in], for which `fits` says yes.
        biases: of each layer, [out]; the first may be [groups, out] for equal groups of neighbouring points.

    Returns:
        The last layer, without activation, float32.

    """
    parameters = [each for pair in zip(weights, biases, strict=True) for each in pair]
    if not (torch.is_grad_enabled() and any(each.requires_grad for each in (x, *parameters))):
        return _forward(x, weights, biases)
    found = _Network.apply(x, *parameters)
    assert isinstance(found, Tensor)
    return found


@torch.no_grad()
def _forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    x = x if x.stride(1) == 1 else x.contiguous()
    layers = [(weight.contiguous(), bias.contiguous()) for weight, bias in zip(weights, biases, strict=True)]
    (hidden, width), out, groups = weights[0].shape, len(weights[-1]), biases[0].view(-1, len(weights[0])).shape[0]
    result = torch.empty(len(x), out, device=x.device)
    launch(
        _forward_kernel,
        (triton.cdiv(len(x), POINTS),),
        x,
        x,
        *layers[0],
        *layers[-2],  # of two layers the one between is not read
        *layers[-1],
        result,
        len(x),
        x.stride(0),
        max(1, len(x) // groups),
        width,
        hidden,
        out,
        LAYERS=len(weights),
        WIDTH=_block(width),
        HIDDEN=_block(hidden),
        OUT=_block(out),
        POINTS=POINTS,
    )
    return result


@torch.no_grad()
def encoded_network(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
) -> Float[Tensor, "points out"]:
    """Encode points by a hash grid and apply a network to them, in one kernel, without gradients.

    Args:
        positions: float32; see `hash_grid.hash_grid`, also for the next two.
        table: float32.
        scalings: float32.
        weights: of each layer, [out, in], for which `fits` says yes; the first layer's `in` is levels * features.
        biases: of each layer, [out].

    Returns:
        The last layer, without activation, float32.

    """
    layers = [(weight.contiguous(), bias.contiguous()) for weight, bias in zip(weights, biases, strict=True)]
    hidden, out, levels = len(weights[0]), len(weights[-1]), len(scalings)
    result = torch.empty(len(positions), out, device=positions.device)
    launch(
        _encoded_kernel,
        (triton.cdiv(len(positions), POINTS),),
        positions,
        positions.contiguous(),
        table.contiguous(),
        scalings,
        *layers[0],
        *layers[-2],  # of two layers the one between is not read
        *layers[-1],
        result,
        len(positions),
        len(table) // levels,
        levels,
        hidden,
        out,
        FEATURES=table.shape[1],
        LAYERS=len(weights),
        HIDDEN=_block(hidden),
        OUT=_block(out),
        POINTS=POINTS,
    )
    return result


def try_out(device: torch.device) -> None:
    """Run each kernel once; raises whatever keeps one from working."""
    for layers in (2, 3):
        square = torch.ones(16, 16, device=device, requires_grad=True)
        network(square[:1], [square] * layers, [square[0]] * layers).sum().backward()
        table = torch.ones(8 * 2, 2, device=device)
        encoded_network(square[:1, :3], table, square[0, :8], [square] * layers, [square[0]] * layers)
