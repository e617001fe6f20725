"""A small network on the CPU, a tile of points at a time: meaning and shapes as in `network`.

The points of a tile pass all layers, forward and backward, and stay in the nearest caches. Backward computes the layers
again, which is faster than writing them to memory and reading them. All three products of a layer (values, gradient to
the inputs, gradient to the weights) are the same sum of products with other strides. Its function keeps the sums in
registers; LLVM is told the vectors' length, because it makes no vectors of loops that keep more than one sum.

Rows of layers and weights are filled up with zeros to a multiple of 16. Importing this module imports Numba.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, no_type_check

import llvmlite.binding as llvm
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.threads import kernel_threads, share_out, stretches

TILE = 96
"""Points worked on together, a multiple of 16."""
LEAST_SHARE = 1 << 11
"""A thread gets at least so many points."""
_WIDE = llvm.get_host_cpu_features().get("avx512f", False)
VECTOR = 16 if _WIDE else 8
"""Numbers of a vector."""
FULL = 16
"""Rows are filled up to a multiple of so many numbers."""
ZERO = np.float32(0)


def _sums_of_products(rows: int, vectors: int) -> Callable[..., Any]:
    """Make the function that writes sums of products to a block of `rows` by `vectors`.

    Its arguments are (a, at_a, a_row, a_term, b, at_b, b_term, terms, start, at_start, start_row, into, at, row), with
    flat arrays. into[at + r · row + c] becomes start[at_start + r · start_row + c] plus the sum over t of
    a[at_a + r · a_row + t · a_term] · b[at_b + t · b_term + c].
    """

    def generate(context: Any, build: Any, signature: Any, given: Any) -> Any:
        number, whole, index = ir.FloatType(), ir.IntType(64), ir.IntType(32)
        vector, nothing = ir.VectorType(number, VECTOR), ir.Constant(ir.VectorType(number, VECTOR), ir.Undefined)
        arrays = (0, 4, 8, 11)
        a, b, start, into = (context.make_array(signature.args[k])(context, build, given[k]).data for k in arrays)
        at_a, a_row, a_term, at_b, b_term, terms, at_start, start_row, at, row = (
            each for k, each in enumerate(given) if k not in arrays
        )

        def place(base: Any, begin: Any, count: int, step: Any, more: int = 0) -> Any:
            """Give the address of base[begin + count · step + more]."""
            moved = build.add(begin, build.mul(ir.Constant(whole, count), step))
            return build.gep(base, [build.add(moved, ir.Constant(whole, more))])

        def load(address: Any) -> Any:
            value = build.load(build.bitcast(address, vector.as_pointer()))
            value.align = 4
            return value

        block = [(r, c) for r in range(rows) for c in range(vectors)]
        before = [load(place(start, at_start, r, start_row, c * VECTOR)) for r, c in block]
        entry, loop, end = build.block, build.append_basic_block(), build.append_basic_block()
        some = build.icmp_signed(">", terms, ir.Constant(whole, 0))
        build.cbranch(some, loop, end)
        build.position_at_end(loop)
        term, sums = build.phi(whole), [build.phi(vector) for _ in block]
        of_a, of_b = build.add(at_a, build.mul(term, a_term)), build.add(at_b, build.mul(term, b_term))
        columns = [load(place(b, of_b, 0, row, c * VECTOR)) for c in range(vectors)]
        factors = []
        for r in range(rows):
            first = build.insert_element(nothing, build.load(place(a, of_a, r, a_row)), ir.Constant(index, 0))
            factors.append(
                build.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(index, VECTOR), [0] * VECTOR))
            )
        # "contract": one fused multiply-add where the processor has it
        products = [build.fmul(factors[r], columns[c], flags=("contract",)) for r, c in block]
        more = [build.fadd(product, each, flags=("contract",)) for product, each in zip(products, sums, strict=True)]
        following = build.add(term, ir.Constant(whole, 1))
        build.cbranch(build.icmp_signed("<", following, terms), loop, end)
        phis = zip([term, *sums], [ir.Constant(whole, 0), *before], [following, *more], strict=True)
        for phi, first, then in phis:
            phi.add_incoming(first, entry)
            phi.add_incoming(then, loop)
        build.position_at_end(end)
        results = [build.phi(vector) for _ in block]
        for phi, first, then in zip(results, before, more, strict=True):
            phi.add_incoming(first, entry)
            phi.add_incoming(then, loop)
        for (r, c), result in zip(block, results, strict=True):
            address = place(into, at, r, row, c * VECTOR)
            build.store(result, build.bitcast(address, vector.as_pointer())).align = 4
        return context.get_dummy_value()

    @intrinsic
    @no_type_check
    def sums_of_products(_, a, at_a, a_row, a_term, b, at_b, b_term, terms, start, at_start, start_row, into, at, row):
        n = types.intp
        return types.void(a, n, n, n, b, n, n, n, start, n, n, into, n, n), generate

    return sums_of_products


_FOUR_ROWS = 4 * VECTOR if _WIDE else 2 * VECTOR
"""Columns of the sums that registers have room for, of four rows at once."""
_four_rows = _sums_of_products(4, _FOUR_ROWS // VECTOR)
# not called without wide vectors
_eight_rows, _sixteen_rows = _sums_of_products(8, 2), _sums_of_products(16, 1)


@compiled()
@no_type_check
def _multiply(a, at_a, a_row, a_term, b, at_b, b_term, terms, start, at_start, start_row, into, at, row, rows, columns):
    """Write `rows` by `columns` sums of products; both are filled up to a multiple of 16."""
    done = columns - columns % _FOUR_ROWS
    for c in range(0, done, _FOUR_ROWS):
        for r in range(0, rows, 4):
            _four_rows(
                *(a, at_a + r * a_row, a_row, a_term, b, at_b + c, b_term, terms),
                *(start, at_start + r * start_row + c, start_row, into, at + r * row + c, row),
            )
    if columns - done >= 2 * VECTOR:
        for r in range(0, rows, 8):
            _eight_rows(
                *(a, at_a + r * a_row, a_row, a_term, b, at_b + done, b_term, terms),
                *(start, at_start + r * start_row + done, start_row, into, at + r * row + done, row),
            )
        done += 2 * VECTOR
    if columns > done:
        for r in range(0, rows, 16):
            _sixteen_rows(
                *(a, at_a + r * a_row, a_row, a_term, b, at_b + done, b_term, terms),
                *(start, at_start + r * start_row + done, start_row, into, at + r * row + done, row),
            )


@compiled()
@no_type_check
def _filled(width):
    """Fill a layer's width up."""
    return (width + FULL - 1) // FULL * FULL


@compiled()
@no_type_check
def _copy(values, begin, into, at, count):
    """Copy numbers of one flat array to another.

    Without a sign: else Numba looks whether an index counts from the end, and no vector instructions come out.
    """
    for i in range(count):
        into[np.uint64(at + i)] = values[np.uint64(begin + i)]


@compiled()
@no_type_check
def _add(values, begin, into, at, count):
    """Add numbers of one flat array to another."""
    for i in range(count):
        into[np.uint64(at + i)] += values[np.uint64(begin + i)]


@compiled()
@no_type_check
def _fill(into, at, count):
    """Set numbers to 0."""
    for i in range(count):
        into[np.uint64(at + i)] = ZERO


@compiled()
@no_type_check
def _load(values, width, first, count, into, row):
    """Copy some rows of `width` to a tile whose other numbers become 0."""
    _fill(into, 0, TILE * row)
    for p in range(count):
        _copy(values, (first + p) * width, into, p * row, width)


@compiled()
@no_type_check
def _apply_layers(
    layers, room, ins, more_width, joint, down, begins, biases, shared, more, first, points, group, last
):  # fmt: skip
    """Compute a tile's layers up to `last` from the inputs in front; layer by layer, `room` numbers each.

    What stands beyond a layer's width is 0 in new layers, and stays so.
    """
    for layer in range(last):
        inputs, row, at = _filled(ins[layer]), _filled(ins[layer + 1]), (layer + 1) * room
        joins = joint > 0 and layer + 1 == joint
        width = ins[layer + 1] - more_width if joins else ins[layer + 1]
        columns = _filled(width)
        start, at_start, start_row = biases, begins[len(ins) + layer], 0
        if layer == joint and len(shared) > width:
            start, at_start, start_row = layers, at, row
            for p in range(TILE):
                _copy(shared, min((first + p) // group * width, len(shared) - width), layers, at + p * row, width)
        _multiply(
            *(layers, layer * room, inputs, 1, down, begins[layer], columns, ins[layer]),
            *(start, at_start, start_row, layers, at, row, TILE, columns),
        )
        if joins:
            if more_width > 0:
                for p in range(points):
                    _copy(more, (first + p) * more_width, layers, at + p * row + width, more_width)
        elif layer + 2 < len(ins):
            for i in range(TILE * row):
                place = np.uint64(at + i)
                layers[place] = ZERO if layers[place] < ZERO else layers[place]


@compiled()
@no_type_check
def apply_to_points(
    x, ins, more_width, joint, down, begins, biases, shared, more, group, result, to_point, to_number, begin, end
):  # fmt: skip
    """Apply the network to points from `begin` to `end`; calls for different points may run at once."""
    count, room = len(ins) - 1, TILE * _filled(ins.max())
    layers = np.zeros((count + 1) * room, np.float32)
    inputs, row, width = _filled(ins[0]), _filled(ins[count]), ins[count]
    for first in range(begin, end, TILE):
        points = min(TILE, end - first)
        _load(x, ins[0], first, points, layers, inputs)
        _apply_layers(
            layers, room, ins, more_width, joint, down, begins, biases, shared, more, first, points, group, count
        )
        if joint == 0:
            for p in range(points):
                _copy(layers, count * room + p * row, result, (first + p) * to_point, width)
            continue
        of_joint = _filled(ins[joint])
        for p in range(points):
            result[first + p] = layers[joint * room + p * of_joint]
        for c in range(width):
            for p in range(points):
                result[np.uint64((c + 1) * to_number + first + p)] = layers[np.uint64(count * room + p * row + c)]


@compiled()
@no_type_check
def _backward(
    x, ins, more_width, joint, down, begins, up, begins_up, biases, shared, more, group, gradient, to_number, to_x,
    to_up, to_biases, to_shared, begin, end,
):  # fmt: skip
    """Add the gradients that points from `begin` to `end` give; `to_x` is written, and may be empty.

    Calls for different points may run at once, if each has `to_up` and `to_biases` of its own, and all points of a
    group, which has its own place in `to_shared`.
    """
    count, room = len(ins) - 1, TILE * _filled(ins.max())
    layers, slopes = np.zeros(count * room, np.float32), np.zeros(2 * room, np.float32)
    nothing, one = np.zeros(room // TILE, np.float32), np.ones(1, np.float32)
    total = np.zeros(FULL * len(nothing), np.float32)
    for first in range(begin, end, TILE):
        points = min(TILE, end - first)
        _load(x, ins[0], first, points, layers, _filled(ins[0]))
        _apply_layers(
            layers, room, ins, more_width, joint, down, begins, biases, shared, more, first, points, group, count - 1
        )
        at = 0
        if joint == 0:
            _load(gradient, ins[count], first, points, slopes, _filled(ins[count]))
        else:
            row = _filled(ins[count])
            _fill(slopes, 0, TILE * row)
            for c in range(ins[count]):
                for p in range(points):
                    slopes[np.uint64(p * row + c)] = gradient[np.uint64((c + 1) * to_number + first + p)]
        for layer in range(count - 1, -1, -1):
            inputs, row = _filled(ins[layer]), _filled(ins[layer + 1])
            width = ins[layer + 1] - more_width if joint > 0 and layer + 1 == joint else ins[layer + 1]
            outputs = _filled(width)
            _multiply(
                *(slopes, at, 1, row, layers, layer * room, inputs, points, to_up, begins_up[layer], inputs),
                *(to_up, begins_up[layer], inputs, width, inputs),
            )
            if layer == joint and len(shared) > width:
                for p in range(points):
                    of_group = min((first + p) // group * width, len(shared) - width)
                    _add(slopes, at + p * row, to_shared, of_group, width)
            else:
                # 1 times each row; all rows of the result are the same
                _multiply(one, 0, 0, 0, slopes, at, row, points, nothing, 0, 0, total, 0, outputs, 1, outputs)
                _add(total, 0, to_biases, begins[len(ins) + layer], width)
            if layer == 0 and len(to_x) == 0:
                break
            to = room - at
            # nobody asks for the gradient to what is joined
            columns = _filled(ins[layer] - more_width) if layer == joint else inputs
            _multiply(
                *(slopes, at, row, 1, up, begins_up[layer], inputs, width, nothing, 0, 0),
                *(slopes, to, inputs, TILE, columns),
            )
            at = to
            if layer == 0 and joint == 0:
                for p in range(points):
                    _copy(slopes, at + p * inputs, to_x, (first + p) * ins[0], ins[0])
            elif layer == 0:
                for c in range(ins[0]):
                    for p in range(points):
                        to_x[np.uint64(c * to_number + first + p)] = slopes[np.uint64(at + p * inputs + c)]
            elif layer == joint:
                own = ins[layer] - more_width
                for p in range(points):
                    slopes[np.uint64(at + p * inputs)] += gradient[np.uint64(first + p)]
                    # what is joined is no output of the layer before
                    _fill(slopes, at + p * inputs + own, columns - own)
            else:
                for i in range(TILE * inputs):
                    value, place = layers[np.uint64(layer * room + i)], np.uint64(at + i)
                    slopes[place] = slopes[place] if value > ZERO else ZERO


def _packed(weights: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Give matrices in one array, their rows filled up, and where each begins."""
    rows = [-(-weight.shape[1] // FULL) * FULL for weight in weights]
    begins = np.cumsum([0, *(len(weight) * row for weight, row in zip(weights, rows, strict=True))])
    packed = np.zeros(begins[-1], np.float32)
    for weight, row, begin, end in zip(weights, rows, begins, begins[1:], strict=False):
        packed[begin:end].reshape(-1, row)[:, : weight.shape[1]] = weight
    return packed, begins


class Arrays:
    """A network and its points as the compiled functions want them: flat arrays.

    Weights and biases are copies.
    """

    def __init__(
        self, x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], joint: int = 0, more: Tensor | None = None
    ) -> None:
        """Arrange what a network is given.

        Args:
            x: [points, in].
            weights: [out, in] of each layer; of layer `joint` the inputs in front are the layer's before.
            biases: of each layer, [1, out]; that of layer `joint` may be [groups, out].
            joint: a layer that gets what the one before gives without ReLU. The first number of that, which it leaves
                out (its weights there are 0), is also a result. 0: none.
            more: further inputs of that layer, [points, more], without a gradient.
        """
        self.points, self.groups = len(x), len(biases[joint])
        self.weights = [weight.detach().numpy() for weight in weights]
        # [in, out] each
        down, begins = _packed([weight.T for weight in self.weights])
        self.ins = np.array([*(weight.shape[1] for weight in weights), len(weights[-1])])
        self.shared = flat(biases[joint])
        self.biases, begins_of_biases = _packed([bias.detach().numpy()[:1] for bias in biases])
        # where each layer's bias begins, behind where its weights do
        self.begins = np.concatenate([begins, begins_of_biases])
        group = self.points if self.groups == 1 else self.points // self.groups
        self.step = 1 if self.groups == 1 else group
        joined = np.empty(0, np.float32) if more is None else flat(more)
        self.joint, self.joins = joint, more is not None
        self.arrays = flat(x), self.ins, 0 if more is None else more.shape[1], joint, down, self.begins
        self.of_groups = self.biases, self.shared, joined, group

    def parts(self) -> list[tuple[int, int]]:
        """Share the points out to threads, whole groups each."""
        threads = max(1, min(kernel_threads(), self.points // LEAST_SHARE))
        return [(first * self.step, last * self.step) for first, last in stretches(self.points // self.step, threads)]


def _unpacked(packed: np.ndarray, begins: np.ndarray, shapes: Sequence[Sequence[int]]) -> list[np.ndarray]:
    """Give matrices without what their rows were filled up with.

    Contiguous: torch's fused Adam reads a gradient as if it had its parameter's strides.
    """
    return [
        np.ascontiguousarray(packed[begin:end].reshape(rows, -1)[:, :columns])
        for (begin, end), (rows, columns) in zip(pairwise(begins), shapes, strict=True)
    ]


def forward(net: Arrays) -> Tensor:
    """Apply a network; see `network`."""
    result = torch.empty(net.points, len(net.weights[-1]))
    write = writes_forward(net, flat(result), 0)
    share_out(lambda part: write(*part), net.parts())
    return result


def writes_forward(net: Arrays, result: np.ndarray, to_number: int) -> Callable[[int, int], None]:
    """Make the function that applies a network to points from one to another, and writes to a flat array.

    With a joint the result is one row for each number that a point gets, the joint's first: a row begins `to_number`
    behind the one before.
    """
    arrays = *net.arrays, *net.of_groups, result, int(net.ins[-1]), to_number
    return lambda begin, end: apply_to_points(*arrays, begin, end)


def backward(net: Arrays, gradient: Tensor, follow_x: bool) -> tuple[Tensor | None, list[Tensor], list[Tensor]]:
    """Give the gradients to the inputs (None unless `follow_x`), to the weights and to the biases."""
    to_x = torch.empty(net.points if follow_x else 0, int(net.ins[0]))
    slopes, parts = Slopes(net, flat(gradient), 0, flat(to_x)), net.parts()
    sums = [slopes.nothing() for _ in parts]
    share_out(lambda number: slopes.add(sums[number], *parts[number]), list(range(len(parts))))
    to_weights, to_biases = ([torch.from_numpy(each) for each in arrays] for arrays in slopes.total(sums))
    return (to_x if follow_x else None), to_weights, to_biases


class Slopes:
    """The gradients of a network, which threads sum up over points of their own."""

    def __init__(self, net: Arrays, gradient: np.ndarray, to_number: int, to_x: np.ndarray) -> None:
        """Prepare for the gradient to what the network gives.

        Args:
            net: the network and its points.
            gradient: to what `writes_forward` writes.
            to_number: as there.
            to_x: gets the gradient to the inputs, unless it is empty; with a joint, it has a row for each input.
        """
        self.net, (up, self.begins) = net, _packed(net.weights)
        self.to_shared = np.zeros_like(net.shared)
        self.arrays = *net.arrays, up, self.begins, *net.of_groups, gradient, to_number, to_x
        # rows are added sixteen at once, some of them (zeros) behind the last matrix
        self.room = len(up) + FULL * (net.ins.max() + FULL)

    def nothing(self) -> tuple[np.ndarray, np.ndarray]:
        """Give sums of no points, for a thread."""
        return np.zeros(self.room, np.float32), np.zeros_like(self.net.biases)

    def add(self, sums: tuple[np.ndarray, np.ndarray], begin: int, end: int) -> None:
        """Add what points from `begin` to `end` give; calls for different ones, of whole groups, may run at once."""
        _backward(*self.arrays, *sums, self.to_shared, begin, end)

    def total(self, every: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Give the gradients to weights and biases, in the order of the threads: the same sums each time."""
        net = self.net
        to_up, to_biases = (np.sum(each, axis=0) for each in zip(*every, strict=True))
        to_weights = _unpacked(to_up, self.begins, [each.shape for each in net.weights])
        of_layers = _unpacked(to_biases, net.begins[len(net.ins) :], [(1, len(weight)) for weight in net.weights])
        if net.groups > 1:
            of_layers[net.joint] = self.to_shared.reshape(net.groups, -1)
        return to_weights, of_layers
