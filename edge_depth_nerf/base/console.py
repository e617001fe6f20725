"""What long commands share: lines on the terminal, and jobs in threads with progress."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from threading import Event, Thread
from typing import ClassVar, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_MAX_THREADS = 8
"""More threads would hold more maps in memory at once."""

TOLD_EVERY_S = 10.0
"""Where bars cannot be drawn, a line tells so often how far the work is."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def say(console: Console, text: str, style: str | None = None) -> None:
    """Print a line unchanged: paths and brackets are not markup, and the terminal wraps it."""
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


class _Bars(Progress):
    """Bars that `told` finds while they are shown."""

    shown: ClassVar[list[Progress]] = []

    def start(self) -> None:
        self.shown.append(self)
        super().start()

    def stop(self) -> None:
        super().stop()
        if self in self.shown:
            self.shown.remove(self)


@contextmanager
def told(console: Console, what: str) -> Iterator[None]:
    """Print a line every few seconds while something is done, if the output is a file and so shows no bars."""
    ended, began_s = Event(), time.monotonic()

    def tell() -> None:
        while not ended.wait(TOLD_EVERY_S):
            tasks = [task for bars in list(_Bars.shown) for task in bars.tasks if not task.finished]
            shares = [f", {task.description.rstrip('… ')} {task.percentage:.0f} %" for task in tasks]
            say(console, f"{what}: {time.monotonic() - began_s:.0f} s{''.join(shares)}")

    thread = Thread(target=tell, daemon=True)
    if not console.is_terminal:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        if thread.ident is not None:
            thread.join()


def progress_bars(console: Console, counted: bool = False, transient: bool = False) -> Progress:
    """Make bars with a description, the time passed and left, and if `counted` how many of how many are done."""
    count: list[ProgressColumn] = [MofNCompleteColumn()] if counted else []
    return _Bars(
        TextColumn("{task.description}"),
        BarColumn(),
        *count,
        TimeElapsedColumn(),
        TextColumn("·"),
        TimeRemainingColumn(),
        TextColumn("left"),
        console=console,
        transient=transient,
    )


def in_turn(items: Sequence[Item], title: str, console: Console, done: int = 0) -> Iterator[Item]:
    """Go through items and show how far that is; `done` others were done before."""
    with progress_bars(console, counted=True) as progress:
        task = progress.add_task(title, total=done + len(items), completed=done)
        for item in items:
            yield item
            progress.advance(task)


def run_jobs(jobs: Sequence[Callable[[], Result]], title: str, console: Console) -> list[Result]:
    """Do all jobs, several at once, and give their results in order; the first error ends it.

    Decoding, encoding and torch leave Python's lock. Torch gets one thread of its own in each job: the jobs share the
    cores already.
    """
    if not jobs:
        return []
    import torch  # takes seconds, which a worker of a cluster need not wait for

    progress = progress_bars(console, counted=True)
    inner_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with progress, ThreadPoolExecutor(min(os.cpu_count() or 1, _MAX_THREADS)) as pool:
        task = progress.add_task(title, total=len(jobs))
        futures = [pool.submit(job) for job in jobs]
        try:
            for future in as_completed(futures):
                future.result()
                progress.advance(task)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
        finally:
            torch.set_num_threads(inner_threads)
    return [future.result() for future in futures]
