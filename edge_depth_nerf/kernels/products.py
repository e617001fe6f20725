"""Networks by torch's products, as they serve a GPU: few kernels beside the products themselves.

Parameters come into the type of the products by one kernel, and their gradients back by one. Bias and ReLU belong to a
product where torch can have it so. The gradient to a bias is a product with a row of ones, as torch's sums along
columns of half precision take several times as long.

Pure torch, for any device; products in half precision are those that autocast would make.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.gradients import once

Layers = tuple[Sequence[Tensor], Sequence[Tensor]]
"""Weights, [out, in], and biases, [out], of a network."""
LARGEST_FEATURE = 1024.0
"""What enters the second network of a field: more than scenes have, and little enough for half precision behind it."""
_ALL = slice(None)


def _relu_of_product(bias: Tensor, x: Tensor, weight: Tensor) -> Tensor:
    """What `torch._addmm_activation` gives, which is private."""
    return torch.addmm(bias, x, weight).relu_()


_with_relu: Callable[..., Tensor] = getattr(torch, "_addmm_activation", _relu_of_product)


def _parts_of(flat: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    parts = flat.split([each.numel() for each in like])
    return [part.view(each.shape) for part, each in zip(parts, like, strict=True)]


def _in_type(parameters: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Give parameters in the type of the products."""
    parameters = [each.detach() for each in parameters]
    if all(each.dtype == dtype for each in parameters):
        return parameters
    found = _parts_of(parameters[0].new_empty(sum(each.numel() for each in parameters), dtype=dtype), parameters)
    torch._foreach_copy_(found, parameters)
    return found


def _forward(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], follow: bool, hold: bool) -> list[Tensor]:
    """Give what enters each layer, all with `follow`, and what the last one gives; `hold` keeps hidden ones finite."""
    entering = [x]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        entering.append(_with_relu(bias, entering[-1], weight.t()))
        if hold:
            entering[-1].clamp_(max=torch.finfo(x.dtype).max)
        entering = entering if follow else entering[-1:]
    return [*entering, torch.addmm(biases[-1], entering[-1], weights[-1].t())]


def _backward(
    gradient: Tensor,
    weights: Sequence[Tensor],
    entering: Sequence[Tensor],
    ones: Tensor,
    into: tuple[Sequence[Tensor], Sequence[Tensor | None]],
    on: slice | None,
) -> Tensor | None:
    """Write a network's gradients, but to biases that are None; give that to some columns of what enters it, if any."""
    to_weights, to_biases = into
    for layer in reversed(range(len(weights))):
        torch.mm(gradient.t(), entering[layer], out=to_weights[layer])
        if (to_bias := to_biases[layer]) is not None:
            torch.mm(ones, gradient, out=to_bias[None])
        if layer > 0:
            gradient = torch.ops.aten.threshold_backward(gradient @ weights[layer], entering[layer], 0)
    return None if on is None else gradient @ weights[0][:, on]


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, dtype: torch.dtype, follow: bool, *parameters: Tensor) -> Tensor:
        count = len(parameters) // 2
        made = _in_type(parameters, dtype)
        *entering, found = _forward(x.detach().to(dtype), made[:count], made[count:], follow, False)
        if follow:
            ctx.count, ctx.made = count, made
            ctx.save_for_backward(x, *parameters, *entering)
        return found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        x, *saved = ctx.saved_tensors
        parameters, entering, count = saved[: 2 * ctx.count], saved[2 * ctx.count :], ctx.count

        def compute() -> tuple[Tensor | None, ...]:
            gradient = gradients[0]
            flat = gradient.new_empty(sum(each.numel() for each in parameters))
            into = _parts_of(flat, parameters)
            ones = gradient.new_ones(1, len(gradient))
            weights, layers = ctx.made[:count], (into[:count], into[count:])
            to_x = _backward(gradient, weights, entering, ones, layers, _ALL if ctx.needs_input_grad[0] else None)
            return None if to_x is None else to_x.to(x.dtype), *_parts_of(flat.to(parameters[0].dtype), parameters)

        to_x, *to_parameters = once("The network by products", compute, gradients[0], x, *parameters)
        return to_x, None, None, *to_parameters


def network(
    x: Float[Tensor, "points in"], layers: Layers, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "points out"]:
    """Apply a network of float32 with ReLU between its layers to points, differentiable once by all it is given.

    Products and results are of `dtype`, whatever `x` is of.
    """
    found = _Network.apply(x, dtype, torch.is_grad_enabled(), *layers[0], *layers[1])
    assert isinstance(found, Tensor)
    return found


class _Field(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, encoded: Tensor, of_rays: Tensor, form: tuple[Sequence[tuple[int, int]], int, int, torch.dtype, bool],
        *parameters: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        runs, directions, count, dtype, follow = form
        made = _in_type(parameters, dtype)
        weights, biases = made[: len(made) // 2], made[len(made) // 2 :]
        # where the sky is empty what it gives grows without end: losses see the skyline alone, and sharpen it
        half = dtype == torch.float16
        *entering, features = _forward(encoded.detach().to(dtype), weights[:count], biases[:count], follow, half)
        rows = weights[count]
        # the density is no input of the second network: a one of weight 0 stands there, for the bias's gradient
        weights[count] = torch.cat([rows[:, :directions], rows.new_zeros(len(rows), 1), rows[:, directions:]], 1)
        own = slice(directions, directions + features.shape[1])
        points = features.new_empty(len(features), weights[count].shape[1])
        points[:, directions].fill_(1)
        torch.clamp(features[:, 1:], -LARGEST_FEATURE, LARGEST_FEATURE, out=points[:, directions + 1 : own.stop])
        for of_points, of_run in _by_run(runs, points, of_rays.detach()):
            of_points[..., :directions].copy_(of_run[..., :directions])
            if own.stop < points.shape[1]:
                of_points[..., own.stop :].copy_(of_run[..., directions:])
        *behind, before_sigmoid = _forward(points, weights[count:], biases[count:], follow, False)
        colours = torch.sigmoid(before_sigmoid, out=torch.empty_like(before_sigmoid, dtype=torch.float32))
        if follow:
            ctx.form, ctx.weights, ctx.own = form, weights, own
            ctx.counts = len(parameters), len(entering)
            ctx.save_for_backward(encoded, of_rays, colours, *parameters, *entering, *behind)
        return features[: runs[0][0] * runs[0][1], 0], colours

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        encoded, of_rays, colours, *saved = ctx.saved_tensors
        (runs, directions, count, _, _), weights, own = ctx.form, ctx.weights, ctx.own
        parameters, entering = saved[: ctx.counts[0]], saved[ctx.counts[0] : sum(ctx.counts)]
        behind = saved[sum(ctx.counts) :]

        def compute() -> tuple[Tensor | None, ...]:
            to_before, to_colours = gradients
            flat = behind[0].new_empty(sum(each.numel() for each in parameters))
            into = _parts_of(flat, parameters)
            to_weights, to_biases = into[: len(weights)], into[len(weights) :]
            ones = flat.new_ones(1, len(colours))
            gradient = torch.empty_like(colours, dtype=flat.dtype)
            torch.ops.aten.sigmoid_backward.grad_input(to_colours, colours, grad_input=gradient)
            to_rows = torch.empty_like(weights[count])
            second = [to_rows, *to_weights[count + 1 :]], [None, *to_biases[count + 1 :]]
            learns_rays = ctx.needs_input_grad[1]
            to_points = _backward(gradient, weights[count:], behind, ones, second, _ALL if learns_rays else own)
            assert to_points is not None
            torch.cat([to_rows[:, :directions], to_rows[:, directions + 1 :]], 1, out=to_weights[count])
            to_biases[count].copy_(to_rows[:, directions])
            to_rays = None
            if learns_rays:
                parts = _by_run(runs, torch.cat([to_points[:, :directions], to_points[:, own.stop :]], 1), of_rays)
                to_rays = torch.cat([of_points.sum(1) for of_points, _ in parts]).to(of_rays.dtype)
                to_points = to_points[:, own]
            to_points[: len(to_before), 0].copy_(to_before)
            first, on = (to_weights[:count], to_biases[:count]), _ALL if ctx.needs_input_grad[0] else None
            to_encoded = _backward(to_points, weights[:count], entering, ones, first, on)
            to_encoded = None if to_encoded is None else to_encoded.to(encoded.dtype)
            return to_encoded, to_rays, *_parts_of(flat.to(parameters[0].dtype), parameters)

        made_of = *gradients, encoded, of_rays, *parameters
        to_encoded, to_rays, *to_parameters = once("The field by products", compute, *made_of)
        return to_encoded, to_rays, None, *to_parameters


def _by_run(runs: Sequence[tuple[int, int]], of_points: Tensor, of_rays: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Give, of each run, its points and its rays, [rays, points of a ray, columns] and [rays, 1, columns]."""
    points = of_points.split([count * number for count, number in runs])
    rays = of_rays.split([count for count, _ in runs])
    return [(p.view(*run, p.shape[1]), r[:, None]) for run, p, r in zip(runs, points, rays, strict=True)]


def field(
    encoded: Float[Tensor, "points encoded"],
    of_rays: Float[Tensor, "rays shared"],
    runs: Sequence[tuple[int, int]],
    first: Layers,
    second: Layers,
    directions: int,
    dtype: torch.dtype = torch.float32,
) -> tuple[Float[Tensor, "samples"], Float[Tensor, "points 3"]]:
    """Apply a field's two networks to points on rays, differentiable once by all it is given.

    The first network's first output becomes the density, its others enter the second one behind a ray's direction and
    in front of what else a ray has.

    Args:
        encoded: what enters the first network, of any type.
        of_rays: what a ray has, of any type: its encoded direction, then the rest.
        runs: numbers of rays, and of points on each of them, one run behind the other.
        first: of the first network, float32.
        second: likewise.
        directions: the width of an encoded direction.
        dtype: of the products.

    Returns:
        The first outputs of the first run's points, in the type of the products; the colours of all points, float32.
    """
    form = runs, directions, len(first[0]), dtype, torch.is_grad_enabled()
    parameters = *first[0], *second[0], *first[1], *second[1]
    before, colours = _Field.apply(encoded, of_rays, form, *parameters)  # pyrefly: ignore
    return before, colours
