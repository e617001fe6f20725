"""How Triton kernels are launched, and how they find the rows of a matrix."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


@contextmanager
def untraced() -> Iterator[None]:
    """Stop tracing: nerfstudio ends a picture of its viewer by an error in any line, also of Triton's compiler."""
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        yield
    finally:
        sys.settrace(trace)


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
    """Launch a kernel where its first argument, a tensor, lies; nothing if there is no program to run.

    A product and a sum stay two roundings, as in torch: where a point lies in its cell must not depend on the compiler.
    `constants` are what the kernel is compiled for, and options of the compiler.
    """
    if 0 not in grid:
        with torch.cuda.device_of(arguments[0]), untraced():
            kernel[grid](*arguments, **constants, enable_fp_fusion=False)


def rows_of(matrix: Float[Tensor, "rows columns"]) -> tuple[Float[Tensor, "rows columns"], int]:
    """Give a matrix whose rows are stretches of memory, and how many numbers lie from one to the next.

    Where samples begin is such a view of all edges, which need not be copied.
    """
    matrix = matrix.detach()
    if matrix.stride(1) != 1 and matrix.shape[1] > 1:
        matrix = matrix.contiguous()
    return matrix, matrix.stride(0)
