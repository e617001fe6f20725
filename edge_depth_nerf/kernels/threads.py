"""How many threads the compiled kernels on the CPU take, and torch in a training step.

A step's tensors in torch are small: to wake a second thread takes longer than it saves (docs/speed.md). So torch gets
one thread in a step, and the kernels, which have the large work, all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_kept: int | None = None


def kernel_threads() -> int:
    """Threads for a kernel: torch's number, or what that was before `torch_on_one_thread`."""
    return torch.get_num_threads() if _kept is None else _kept


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch work on one thread, and the kernels on as many as before."""
    global _kept
    if _kept is not None:
        yield
        return
    _kept = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_kept)
        _kept = None
