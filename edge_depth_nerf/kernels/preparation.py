"""A GPU's kernels compiled and tried out side by side, before a step needs them.

Triton compiles a kernel the first time that it is launched, in a second or so, and keeps the result on disk. Most of
that second is spent without Python's lock or in a program of its own.
"""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any

import torch

from edge_depth_nerf.kernels.back_ends import GpuForm, tried_out

_MOST_THREADS = 8


class Preparation:
    """Trials of kernels in threads, from the construction on."""

    def __init__(self, forms: Sequence[GpuForm], device: torch.device) -> None:
        """Begin; the first kernel is tried out alone, as it also loads the driver."""
        self.total = sum(len(form.every_example(torch.device("cpu"))) for form in forms)
        """Trials: more than kernels, each of which is compiled for several types and sizes."""
        self.done = 0
        self.compiles = False
        """Whether a kernel was not on disk; with a Triton before 3.4 this is not known, and stays False."""
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._forms, self._device = forms, device
        self._thread = threading.Thread(target=self._try_all, name="prepares kernels", daemon=True)
        self._thread.start()

    def wait(self, seconds: float) -> bool:
        """Wait for the end, but no longer than this; say whether it has come."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def give_up(self) -> None:
        """Begin no further trial; those that are under way end."""
        self._ended.set()

    def _try_all(self) -> None:
        with (
            without_garbage_collection(),
            told_of_compilation(self._compiling),
            ThreadPoolExecutor(min(_MOST_THREADS, os.cpu_count() or 1), thread_name_prefix="compiles") as pool,
        ):
            self._try(self._forms[0])
            others: list[Future[None]] = [pool.submit(self._try, form) for form in self._forms[1:]]
            for each in others:
                each.result()

    def _try(self, form: GpuForm) -> None:
        if not self._ended.is_set():
            tried_out(form, self._device, self._passed)

    def _passed(self) -> None:
        with self._lock:
            self.done += 1

    def _compiling(self) -> None:
        self.compiles = True


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Collect no garbage meanwhile, so that threads may parse source side by side.

    Python 3.11 before 3.11.8 parses for one thread at a time (its issue 106905). A collection in the midst of it lets
    another thread parse, and `ast.parse` then raises SystemError.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def told_of_compilation(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` whenever Triton has compiled a kernel that was not on disk; never with a Triton before 3.4."""
    knobs: Any = None
    with suppress(ImportError):
        from triton import knobs
    if not hasattr(getattr(knobs, "compilation", None), "listener"):
        yield
        return
    before = knobs.compilation.listener

    def listen(*, cache_hit: bool, **given: Any) -> None:
        if before is not None:
            before(cache_hit=cache_hit, **given)
        if not cache_hit:
            tell()

    knobs.compilation.listener = listen
    try:
        yield
    finally:
        knobs.compilation.listener = before
