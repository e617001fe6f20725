"""A small network; on the CPU in kernels that take a tile of points through all layers.

y = W_n relu(… relu(W_1 x + b_1) …) + b_n. torch takes all points through one layer after the other: each layer is
written to memory and read again, and its ReLU makes a second copy. `network_numba` keeps them in the caches.

The first bias may differ between groups of neighbouring points: what all points of a ray share in their inputs
(direction, appearance) is multiplied once a ray and given as that.

A GPU has torch's products (`products`). Pure: knows nothing of nerfstudio.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels import products
from edge_depth_nerf.kernels.back_ends import made_by_autocast
from edge_depth_nerf.kernels.gradients import once


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
        from edge_depth_nerf.kernels import network_numba

        def compute() -> tuple[Tensor | None, ...]:
            found = network_numba.backward(ctx.arrays, gradients[0], ctx.needs_input_grad[0])
            return found[0], *(each for pair in zip(*found[1:], strict=True) for each in pair)

        # saved_tensors finds out if one was changed since
        return once("The network in tiles", compute, gradients[0], *ctx.saved_tensors)


def network(
    x: Float[Tensor, "points in"], weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> Float[Tensor, "points out"]:
    """Apply a network to points, differentiable once by all it is given.

    Args:
        x: float32; on a GPU, where torch's products take all points at once, of any type.
        weights: of each layer, [out, in].
        biases: of each layer, [out]; on the CPU the first may be [groups, out] for equal groups of neighbouring points.

    Returns:
        The last layer, without activation.
    """
    if x.device.type != "cpu":
        return products.network(x, (weights, biases), made_by_autocast(x.device))
    rows = [bias.view(-1, bias.shape[-1]) for bias in biases]
    parameters = [each for pair in zip(weights, rows, strict=True) for each in pair]
    result = _Network.apply(x, *parameters)
    assert isinstance(result, Tensor)
    return result
