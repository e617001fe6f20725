"""A small network; on the CPU for a part of the points at a time, so that the part stays in the cache.

y = W_n relu(… relu(W_1 x + b_1) …) + b_n. torch takes all points through one layer after the other: each layer is
written to memory and read again, and its ReLU makes a second copy. Here a part of the points passes all layers, the
ReLU works in place, forward and backward. The products are torch's own.

The first bias may differ between groups of neighbouring points: what all points of a ray share in their inputs
(direction, appearance) is multiplied once a ray and given as that.

Pure: knows nothing of nerfstudio. float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.triton_back_end import of_network

PART = 2048
"""So many points at a time: 512 kB in a layer of 64."""

_relu_backward = torch.ops.aten.threshold_backward.grad_input


def _parts(points: int, group: int) -> list[slice]:
    """Whole groups, about PART points each; all in one where torch shares each product out to several threads.

    They wait for each other after every one of them: the fewer, the better.
    """
    step = group * max(1, PART // group) if torch.get_num_threads() == 1 else max(1, points)
    return [slice(first, min(first + step, points)) for first in range(0, points, step)]


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, keep: bool, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[::2], parameters[1::2]
        last = len(weights) - 1
        groups = len(biases[0])
        group = 1 if groups == 1 else len(x) // groups
        parts = _parts(len(x), group)
        # what backward does not ask for is written over by the next part
        rows = [len(x) if keep or number == last else parts[0].stop for number in range(last + 1)]
        layers = [x.new_empty(count, len(weight)) for count, weight in zip(rows, weights, strict=True)]
        for part in parts:
            h = x[part]
            for number, (weight, bias, layer) in enumerate(zip(weights, biases, layers, strict=True)):
                out = layer[part] if keep or number == last else layer[: len(h)]
                if number == 0 and groups > 1:
                    h = torch.mm(h, weight.t(), out=out)
                    h.view(-1, group, len(weight)).add_(bias[part.start // group : part.stop // group, None])
                else:
                    h = torch.addmm(bias, h, weight.t(), out=out)
                if number < last:
                    h.relu_()
        if keep:
            ctx.save_for_backward(x, *layers[:-1], *weights)
        ctx.groups = groups
        return layers[-1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        to_x, *others = _Gradients.apply(gradients[0], ctx.groups, ctx.needs_input_grad[0], *ctx.saved_tensors)
        return to_x, None, *others


class _Gradients(torch.autograd.Function):
    """The gradients, as a step of its own that refuses to be differentiated once more."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, groups: int, follow_x: bool, *saved: Tensor) -> tuple[Any, ...]:
        count = len(saved) // 2
        inputs, weights = saved[:count], saved[count:]
        points = len(gradient)
        group = 1 if groups == 1 else points // groups
        to_x = torch.empty_like(inputs[0], memory_format=torch.contiguous_format) if follow_x else None
        to_weights = [torch.zeros_like(weight) for weight in weights]
        to_biases = [
            weight.new_zeros(points // group if number == 0 else 1, len(weight))
            for number, weight in enumerate(weights)
        ]
        ones = gradient.new_ones(points)
        for part in _parts(points, group):
            g = gradient[part]
            for number in range(count - 1, -1, -1):
                to_weights[number].addmm_(g.t(), inputs[number][part])
                if number == 0 and groups > 1:
                    rays = slice(part.start // group, part.stop // group)
                    torch.sum(g.view(-1, group, g.shape[1]), 1, out=to_biases[0][rays])
                else:
                    to_biases[number][0].addmv_(g.t(), ones[part])
                if number > 0:
                    g = g @ weights[number]
                    _relu_backward(g, inputs[number][part], 0, grad_input=g)
                elif to_x is not None:
                    torch.mm(g, weights[0], out=to_x[part])
        return to_x, *(each for pair in zip(to_weights, to_biases, strict=True) for each in pair)

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise NotImplementedError(
            "The network in parts has no second derivative. For a loss on gradients (normals that are trained by "
            "differentiating the density, say) choose --pipeline.model.implementation torch."
        )


def _layer_by_layer(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]) -> Tensor:
    """Apply a network by torch's own products."""
    shared = biases[0].view(-1, biases[0].shape[-1])
    groups = len(shared)
    x = F.linear(x, weights[0]).view(groups, -1, len(weights[0]))
    x = x + shared[:, None]
    for weight, bias in zip(weights[1:], biases[1:], strict=True):
        # in place before it is flattened: backward would copy what is changed through another view
        x = F.linear(x.relu_().view(-1, x.shape[-1]), weight, bias)
    return x.view(-1, x.shape[-1])


def network(
    x: Float[Tensor, "points in"], weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Float[Tensor, "points out"]:
    """Apply a network to points, differentiable once by all it is given.

    Args:
        x: float32; on a GPU, where torch's products take all points at once, whatever autocast makes of it.
        weights: of each layer, [out, in].
        biases: of each layer, [out]; the first may be [groups, out] for equal groups of neighbouring points.

    Returns:
        The last layer, without activation.

    """
    if x.device.type != "cpu":
        kernels = of_network(x, weights)
        return (_layer_by_layer if kernels is None else kernels.network)(x, weights, biases)
    rows = [bias.view(-1, bias.shape[-1]) for bias in biases]
    parameters = [each for pair in zip(weights, rows, strict=True) for each in pair]
    result = _Network.apply(x, torch.is_grad_enabled(), *parameters)
    assert isinstance(result, Tensor)
    return result
