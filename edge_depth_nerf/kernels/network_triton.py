"""A small network on a GPU in one kernel, without gradients; meaning and arguments as `network.network`.

For views, and for proposal networks while they rest. Products are of float16 with sums of float32, as in torch under
autocast, and what lies between the layers stays on the chip. Training is left to torch: a backward kernel that holds
the weights' gradients on the chip found too few registers (three layers of 64).

Networks have two or three layers, at most `WIDEST` wide. No GPU has run this: it is off unless the environment says
EDGE_DEPTH_NERF_NETWORK=triton. With TRITON_INTERPRET=1 set before the import it runs on CPU tensors.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.triton_launch import launch

WIDEST = 64
"""Numbers in a layer that stay on the chip."""
POINTS = 64
"""Points that a program works on."""


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
    if LAYERS == 3:
        w1 = _matrix(weight1, hidden, hidden, HIDDEN, HIDDEN)
        h = tl.maximum(tl.dot(h, tl.trans(w1)) + _bias(bias1, hidden, HIDDEN), 0.0).to(tl.float16)
    y = tl.dot(h, tl.trans(_matrix(weight2, out, hidden, OUT, HIDDEN))) + _bias(bias2, out, OUT)
    column = tl.arange(0, OUT)[None]
    tl.store(result + point[:, None] * out + column, y, inside[:, None] & (column < out))


@torch.no_grad()
def network(
    x: Float[Tensor, "points in"], weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Float[Tensor, "points out"]:
    """Apply a network to points, without a gradient; see `network.network`.

    Args:
        x: half precision or float32.
        weights: of each layer, [out, in], for which `fits` says yes.
        biases: of each layer, [out]; the first may be [groups, out] for equal groups of neighbouring points.

    Returns:
        The last layer, without activation, float32.

    """
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


def try_out(device: torch.device) -> None:
    """Run each kernel once; raises whatever keeps one from working."""
    for layers in (2, 3):
        square, row = torch.ones(16, 16, device=device), torch.ones(16, device=device)
        network(square[:1], [square] * layers, [row] * layers)
