"""Commands in processes of their own, side by side: in threads of this machine, or on the workers of a cluster.

A task reports its progress in lines that begin with `WORK`. Its results are on disk, and a task that is done again
continues from them. So a task gets only paths and small values, and only its end comes back.
"""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, Protocol, runtime_checkable

from rich.console import Console
from rich.progress import Progress, TaskID

from edge_depth_nerf.base.console import progress_bars, say
from edge_depth_nerf.jobs.runs import LoggedCommands, command_line

WORK = "work done: "
"""Before the share of a task's work, 0 to 1, in the lines that tell its progress."""


@dataclass(frozen=True)
class Task:
    """A command, what it says, and what it leaves."""

    title: str
    """For people."""
    arguments: tuple[str, ...]
    """Of Python."""
    log: Path
    """File that the command and its output are appended to."""
    makes: Path
    """File that is there when it has ended well."""
    trains: bool = False
    """Whether it wants a GPU for itself, where there are any."""


def own_command(words: Sequence[str], options: Any) -> tuple[str, ...]:
    """Arguments of Python for one of our commands, with absolute paths: a worker has a working directory of its own."""

    def absolute(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(absolute, value))
        return value.absolute() if isinstance(value, Path) else value

    given = {entry.name: absolute(getattr(options, entry.name)) for entry in dataclasses.fields(options)}
    line = command_line(words, dataclasses.replace(options, **given))
    return "-m", "edge_depth_nerf", "--end-with-parent", *shlex.split(line)


def shares_told(tell: Callable[[float], None]) -> Callable[[str], None]:
    """What hears a task's lines and hands on the share of its work that some of them tell."""

    def on_line(line: str) -> None:
        if line.startswith(WORK):
            tell(float(line.removeprefix(WORK)))

    return on_line


@runtime_checkable
class Place(Protocol):
    """Where tasks are done."""

    def start(self, task: Task, tell: Callable[[float], None]) -> Future[None]:
        """Do a task when its turn comes; `tell` learns that it has begun (0) and how far it is, up to 1."""
        ...

    def stop(self) -> None:
        """End what runs, and let nothing more begin."""
        ...


class ThisMachine:
    """Tasks in processes that threads of this one wait for."""

    def __init__(self, pool: ThreadPoolExecutor, threads: int) -> None:
        """Do as many tasks at once as `pool` has threads, `threads` threads each."""
        self._pool, self._threads = pool, threads
        self._commands: list[LoggedCommands] = []
        self._failed = False

    def start(self, task: Task, tell: Callable[[float], None]) -> Future[None]:
        """Put a task into the pool."""
        commands = LoggedCommands()
        self._commands.append(commands)

        def do() -> None:
            # the thread of one that has failed is free before anybody hears of that
            if self._failed:
                return
            tell(0.0)
            try:
                commands.call([sys.executable, *task.arguments], task.log, self._threads, shares_told(tell))
            except BaseException:
                self._failed = True
                raise

        return self._pool.submit(do)

    def stop(self) -> None:
        """Kill what runs."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        for commands in self._commands:
            commands.stop()


@contextmanager
def this_machine(jobs: int | None, count: int, console: Console) -> Iterator[ThisMachine]:
    """A place for `count` tasks; `jobs` side by side, by default one for each core, or one on a GPU."""
    cores = os.cpu_count() or 1
    if jobs is None:
        import torch  # takes seconds

        jobs = 1 if torch.cuda.is_available() else cores
    # the same for the last task, which is alone: what its seconds are compared with had no more
    threads = max(1, cores // jobs)
    jobs = min(jobs, count)
    say(console, f"Runs to do: {count}; in parallel: {jobs}; threads of each: {threads}.")
    with ThreadPoolExecutor(jobs) as pool:
        yield ThisMachine(pool, threads)


class _Bars:
    """A bar for each task that runs, and one for all."""

    def __init__(self, progress: Progress, count: int) -> None:
        self._progress = progress
        self._overall = progress.add_task("All runs", total=float(count))
        self._bars: dict[Task, TaskID] = {}
        self._done: dict[Task, float] = {}
        self._ended: set[Task] = set()
        self._lock = Lock()

    def tell(self, task: Task, share: float, ends: bool = False) -> None:
        with self._lock:
            # what a cluster tells may come late
            if task in self._ended:
                return
            if task not in self._bars:
                self._bars[task] = self._progress.add_task(task.title, total=1.0)
            self._progress.update(self._bars[task], completed=share)
            self._done[task] = share
            self._progress.update(self._overall, completed=sum(self._done.values()))
            if ends:
                self._ended.add(task)
                self._progress.remove_task(self._bars[task])


def do_tasks(tasks: Sequence[Task], place: Place, console: Console) -> None:
    """Do tasks; the first that fails stops all, and what they have done so far is kept.

    Raises:
        InputError: a task failed; its log is named.
    """
    with progress_bars(console) as progress:
        bars = _Bars(progress, len(tasks))
        try:
            futures = {place.start(task, partial(bars.tell, task)): task for task in tasks}
            for future in as_completed(futures):
                future.result()
                bars.tell(futures[future], 1.0, ends=True)
        except BaseException:
            place.stop()
            raise
