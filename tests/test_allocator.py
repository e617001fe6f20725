"""What keeping freed memory does: a large tensor's pages are not taken from the system again."""

import platform
import subprocess
import sys

import pytest

from edge_depth_nerf.kernels import allocator

FAULTS = """
import resource, torch
from edge_depth_nerf.kernels.allocator import keep_freed_memory
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.zeros(15_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
torch.set_num_threads(1)
given_back = [faults() for _ in range(3)]
assert keep_freed_memory()
kept = [faults() for _ in range(31)]  # the heap grows by and by
print(given_back[-1], kept[-1])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's allocator alone has the settings")
def test_freed_memory_is_used_again():
    """60 MB are 15,000 pages of 4 kB, or some dozen large ones where the system gives these."""
    done = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    given_back, kept = map(int, done.stdout.split())
    assert kept < given_back / 4


def test_other_allocators_are_left_alone(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(allocator.ctypes, "CDLL", lambda _: pytest.fail("asked for a setting"))
    assert not allocator.keep_freed_memory()
