"""Lets OpenMP's threads sleep on the CPU while they have nothing to do.

A thread of GNU's OpenMP, which torch brings, that is done with its part turns in a loop for some milliseconds. When a
picture is rendered, torch's threads and the kernels' take turns, so those that turn take the cores from those that
work. (In a training step torch has one thread, see `threads`.)

`OMP_WAIT_POLICY=passive` would let them sleep, but is read when the library is loaded: `ns-train` has loaded it before
it imports this package. The library also lets threads sleep sooner once it has created more threads than there are
cores (`gomp_throttled_spin_count_var`, libgomp's config/linux/wait.h). So this module creates some that sleep forever.
"""

from __future__ import annotations

import os
import threading

import torch

_CHOSEN_BY = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
"""Where these are set, somebody has chosen already."""
_ENOUGH = 1 << 17
"""Numbers that torch adds with all its threads; with up to 32,768 it takes one."""
_lock = threading.Lock()
_teams: list[threading.Thread] = []


def let_idle_threads_sleep() -> bool:
    """Let torch's threads sleep when they have nothing to do, in this process, from now on.

    Returns:
        Whether that was for this function to do: not with other libraries than GNU's, with one thread, or where the
        environment says how threads wait.
    """
    threads, cores = torch.get_num_threads(), len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
    if threads < 2 or not cores or any(name in os.environ for name in _CHOSEN_BY):
        return False
    if "ATen parallel backend: OpenMP" not in torch.__config__.parallel_info():
        return False
    with _lock:
        # a Python thread that asks for work in parallel gets a team of its own, of which it is one
        while threads + len(_teams) * (threads - 1) <= cores:
            ready = threading.Event()
            _teams.append(threading.Thread(target=_work_once, args=(ready,), name="idle OpenMP team", daemon=True))
            _teams[-1].start()
            ready.wait()
    return True


def _work_once(ready: threading.Event) -> None:
    torch.zeros(_ENOUGH).add_(1.0)
    ready.set()
    threading.Event().wait()
