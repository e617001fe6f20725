"""Functions run in a process of their own, whose Triton kernels are interpreted and take CPU tensors.

The variable TRITON_INTERPRET has to be set before Triton is imported.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import torch

DONE = "the checks have run"


def in_interpreter(*checks: Callable[[], None]) -> None:
    """Run functions of a module of tests, one after the other; raises what they raise."""
    calls = [f"import {check.__module__}; {check.__module__}.{check.__name__}()" for check in checks]
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*calls, f"print({DONE!r})"])],
        env={**os.environ, "PYTHONPATH": path, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.stdout.endswith(f"{DONE}\n"), done.stdout + done.stderr


def assert_near(found: torch.Tensor, expected: torch.Tensor, tolerance: float) -> None:
    """Differences relative to the largest value, of which there is one; NaN only where NaN is expected."""
    assert found.shape == expected.shape
    expected = expected.double()
    is_nan = expected.isnan()
    assert torch.equal(found.isnan(), is_nan)
    difference = (found.double() - expected)[~is_nan].abs().max()
    largest = expected[~is_nan].abs().max()
    assert largest > 0
    assert difference <= tolerance * largest, (float(difference), float(largest))
