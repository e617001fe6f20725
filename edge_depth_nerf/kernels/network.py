"""A small network; on the CPU in kernels that take a tile of points through all layers.

y = W_n relu(… relu(W_1 x + b_1) …) + b_n. torch takes all points through one layer after the other: each layer is
written to memory and read again, and its ReLU makes a second copy. `network_numba` keeps them in the caches.

The first bias may differ between groups of neighbouring points: what all points of a ray share in their inputs
(direction, appearance) is multiplied once a ray and given as that.

Pure: knows nothing of nerfstudio. float32.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.back_ends import of_network


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> Tensor:
        # imported here, because Numba takes half a second to load
        from edge_depth_nerf.kernels import network_numba

        ctx.arrays = network_numba.Arrays(x, parameters[::2], parameters[1::2])
        ctx.save_for_backward(x, *parameters)
        return network_numba.forward(ctx.arrays)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        # saved_tensors finds out if one was changed since
        return _Gradients.apply(gradients[0], ctx.needs_input_grad[0], ctx.arrays, *ctx.saved_tensors)


class _Gradients(torch.autograd.Function):
    """The gradients, as a step of its own that refuses to be differentiated once more."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, follow_x: bool, arrays: Any, *_: Tensor) -> tuple[Any, ...]:
        from edge_depth_nerf.kernels import network_numba

        to_x, to_weights, to_biases = network_numba.backward(arrays, gradient, follow_x)
        return to_x, *(each for pair in zip(to_weights, to_biases, strict=True) for each in pair)

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise NotImplementedError(
            "The network in tiles has no second derivative. For a loss on gradients (normals that are trained by "
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
    result = _Network.apply(x, *parameters)
    assert isinstance(result, Tensor)
    return result


class _Joined(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, of_rays: Tensor, groups: tuple[int, int], joint: int, by_ray: Tensor, *parameters: Tensor
    ) -> Tensor:
        # imported here, because Numba takes half a second to load
        from edge_depth_nerf.kernels import network_numba

        weights, biases = list(parameters[::2]), [bias.view(1, -1) for bias in parameters[1::2]]
        rays, points = groups[0], groups[0] * groups[1]
        result = torch.empty(1 + len(weights[-1]), len(x))
        no_density = by_ray.new_zeros(len(by_ray), 1)
        ctx.parts, ctx.joint = [], joint
        for part, rows in ((slice(points), slice(rays)), (slice(points, len(x)), slice(rays, len(of_rays)))):
            given, shared = x[part], of_rays[rows]
            if len(given) == 0:
                continue
            joins = len(given) == len(shared) and not ctx.needs_input_grad[1]
            columns = [no_density, weights[joint], *([by_ray] if joins else [])]
            bias = biases[joint] if joins else torch.addmm(biases[joint], shared, by_ray.t())
            net = network_numba.Arrays(
                given,
                [*weights[:joint], torch.cat(columns, dim=1), *weights[joint + 1 :]],
                [*biases[:joint], bias, *biases[joint + 1 :]],
                joint,
                shared if joins else None,
            )
            network_numba.write_forward(net, result.view(-1)[part.start or 0 :].numpy(), len(x))
            ctx.parts.append((net, part, rows, joins))
        ctx.save_for_backward(x, of_rays, by_ray, *parameters)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Any, ...]:
        from edge_depth_nerf.kernels import network_numba

        x, of_rays, by_ray, *parameters = ctx.saved_tensors
        joint, width = ctx.joint, parameters[2 * ctx.joint].shape[1]
        # input after input in memory, as the hash grid's backward wants it
        to_x = x.new_empty(x.shape[::-1]) if ctx.needs_input_grad[0] else x.new_empty(0, 0)
        to_rays = torch.zeros_like(of_rays) if ctx.needs_input_grad[1] else None
        gradient = gradients[0].contiguous().view(-1)
        # of all parts; in numpy, which needs fewer calls for small matrices
        totals: list[np.ndarray] = []
        for net, part, rows, joins in ctx.parts:
            begin = part.start or 0
            to_weights, to_biases = network_numba.write_backward(
                net, gradient[begin:].numpy(), len(x), to_x.view(-1)[begin:].numpy()
            )
            of_joint, to_shared = to_weights[joint], to_biases[joint]
            to_by_ray = of_joint[:, 1 + width :]
            if not joins:
                # torch's products: numpy's would wake threads of their own
                of_shared = torch.from_numpy(to_shared)
                to_by_ray, to_biases[joint] = (of_shared.t() @ of_rays[rows]).numpy(), to_shared.sum(axis=0)
                if to_rays is not None:
                    to_rays[rows] = of_shared @ by_ray
            to_weights[joint] = of_joint[:, 1 : 1 + width]
            every = [to_by_ray, *(each for pair in zip(to_weights, to_biases, strict=True) for each in pair)]
            totals = [total + each for total, each in zip(totals, every, strict=True)] if totals else every
        found = [
            torch.from_numpy(np.ascontiguousarray(each)).view(parameter.shape)
            for each, parameter in zip(totals, (by_ray, *parameters), strict=True)
        ]
        return (to_x.t() if ctx.needs_input_grad[0] else None), to_rays, None, None, *found


def joined_networks(
    x: Float[Tensor, "points in"],
    of_rays: Float[Tensor, "rays_and_points shared"],
    groups: tuple[int, int],
    first: tuple[Sequence[Tensor], Sequence[Tensor]],
    second: tuple[Sequence[Tensor], Sequence[Tensor]],
    by_ray: Float[Tensor, "width shared"],
) -> Float[Tensor, "values points"]:
    """Apply a network, and a second one to all its outputs but the first one and to what rays have; on the CPU.

    As nerfacto's field: the first output becomes the density, the second network's outputs the colour. A tile of points
    passes all layers of both, so that what stands between them is never in memory.

    Args:
        x: float32, all samples, ray by ray, and any single points after them.
        of_rays: what the second network gets beside the first one's outputs: for each ray, then each single point.
        groups: how many rays there are, and how many samples each has.
        first: weights and biases of the first network's layers.
        second: those of the second network's; the weights of its first layer are for the first network's outputs alone.
        by_ray: those of that layer for what rays have.

    Returns:
        The first network's first output, then the second network's, one row for each. Differentiable once, by all that
        is float.

    """
    weights, biases = [*first[0], *second[0]], [*first[1], *second[1]]
    x, of_rays = x.contiguous(), of_rays.contiguous()
    parameters = [each for pair in zip(weights, biases, strict=True) for each in pair]
    result = _Joined.apply(x, of_rays, groups, len(first[0]), by_ray, *parameters)
    assert isinstance(result, Tensor)
    return result
