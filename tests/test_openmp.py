"""torch's threads sleep when they have nothing to do."""

import os
import subprocess
import sys

import pytest
import torch

from edge_depth_nerf import entry
from edge_depth_nerf.kernels import openmp

BURNT = """
import os, time
import torch
from edge_depth_nerf.kernels.openmp import let_idle_threads_sleep
torch.set_num_threads(len(os.sched_getaffinity(0)))
numbers = torch.zeros(1 << 17)
for sleeping in (False, True):
    if sleeping:
        assert let_idle_threads_sleep() and let_idle_threads_sleep()  # once more does nothing
    numbers.add_(1.0)
    started = time.process_time()
    for _ in range(60):
        numbers.add_(1.0)
        time.sleep(0.005)
    print(time.process_time() - started)
"""


def in_gnu_openmp_with_threads() -> bool:
    return (
        sys.platform == "linux"
        and len(os.sched_getaffinity(0)) > 1
        and "ATen parallel backend: OpenMP" in torch.__config__.parallel_info()
    )


@pytest.mark.skipif(not in_gnu_openmp_with_threads(), reason="no GNU OpenMP, or a single core")
def test_idle_threads_do_not_burn_the_processor():
    """60 short additions with pauses: the work is next to nothing, what the threads burn in the pauses is not."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
    done = subprocess.run([sys.executable, "-c", BURNT], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    turning, sleeping = map(float, done.stdout.split())
    assert sleeping < turning / 3


@pytest.mark.parametrize(("name", "threads"), [("OMP_WAIT_POLICY", 4), ("GOMP_SPINCOUNT", 4), ("OTHER", 1)])
def test_what_the_environment_says_stays_and_one_thread_has_nothing_to_wait_for(monkeypatch, name, threads):
    for each in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setenv(name, "active")
    monkeypatch.setattr(openmp.torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(openmp.threading, "Thread", lambda **_: pytest.fail("made a thread"))
    assert not openmp.let_idle_threads_sleep()


def test_our_commands_and_theirs_begin_with_it(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", "--no-such-option"])
    for policy in ("passive", "active"):
        with pytest.raises(SystemExit):
            entry.main()
        assert os.environ["OMP_WAIT_POLICY"] == policy
        monkeypatch.setenv("OMP_WAIT_POLICY", "active")
