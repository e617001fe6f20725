"""Gradients of kernels that are differentiated once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class _Sloped(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, followed: Tensor, compute: Callable[[bool], tuple[Tensor, Tensor]]) -> Tensor:
        loss, slopes = compute(ctx.needs_input_grad[0])
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(slopes)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        return ctx.saved_tensors[0] * gradients[0].reshape(-1, 1), None


def sloped(followed: Tensor, compute: Callable[[bool], tuple[Tensor, Tensor]]) -> Tensor:
    """Make a loss differentiable once by one matrix, [rays, n], with the gradient that its kernel gives beside it.

    `compute` gives the loss, a number or one for each ray, and its slope at each number of the matrix; its argument
    says whether slopes are asked for.
    """
    loss = _Sloped.apply(followed, compute)
    assert isinstance(loss, Tensor)
    return loss


class _Once(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, kernel: str, compute: Callable[[], tuple[Tensor | None, ...]], *_: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        ctx.kernel = kernel
        return compute()

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise NotImplementedError(
            f"{ctx.kernel} has no second derivative. For a loss on gradients (normals that are trained by "
            "differentiating the density, say) choose --pipeline.model.implementation torch."
        )


def once(kernel: str, compute: Callable[[], tuple[Tensor | None, ...]], *made_of: Tensor | None) -> Any:
    """Give gradients computed from `made_of` that refuse to be differentiated again; an error names the kernel."""
    return _Once.apply(kernel, compute, *made_of)
