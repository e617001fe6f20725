"""Threads of the compiled kernels on the CPU, and of torch in a training step.

A step's tensors in torch are small: to wake a second thread takes longer than it saves. So torch gets one
thread in a step, and the kernels, which have the large work, all of them.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

_kept: int | None = None
"""What torch had before the step that is under way."""
_trained: tuple[int, int] | None = None
"""The thread that did the last step, and what torch has in it outside of steps."""


def kernel_threads() -> int:
    """Give the threads for a kernel: torch's number, or what that was before `torch_on_one_thread`."""
    return torch.get_num_threads() if _kept is None else _kept


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Let torch work on one thread, and the kernels on as many as before."""
    global _kept, _trained
    if _kept is not None:
        yield
        return
    _kept = torch.get_num_threads()
    _trained = threading.get_ident(), _kept
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(_kept)
        _kept = None


def take_all_threads() -> None:
    """Give torch in this thread as many threads as where it trains.

    Each thread keeps the number that it found at its first use of torch. A viewer's, which begins during a step, would
    render on one for ever.
    """
    if _kept is None and _trained is not None and _trained[0] != threading.get_ident():
        torch.set_num_threads(_trained[1])


@functools.lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Start threads that stay for the next call; a forked process (another `process` id) starts its own."""
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="kernels")


def share_out(work: Callable[[Any], None], shares: list[Any]) -> None:
    """Call `work` once for each share, all at once, the first one in this thread."""
    if len(shares) == 1:
        work(shares[0])
        return
    waiting = [_pool(os.getpid()).submit(work, share) for share in shares[1:]]
    try:
        work(shares[0])
    finally:
        for future in waiting:
            future.result()


def stretches(count: int, parts: int) -> list[tuple[int, int]]:
    """Give where `parts` equal parts of a range begin and end."""
    return [(count * part // parts, count * (part + 1) // parts) for part in range(parts)]


def in_parts(work: Callable[[int, int], None], count: int, least: int) -> None:
    """Call `work` with the beginning and the end of equal parts of a range, all at once; of `least` each at least."""
    threads = max(1, min(kernel_threads(), count // max(1, least)))
    share_out(lambda part: work(*part), stretches(count, threads))
