"""Functions run in a process of their own, whose Triton kernels take CPU tensors: interpreted, or on a GPU.

The variable TRITON_INTERPRET has to be set before Triton is imported.
"""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils._pytree import tree_map_only

DONE = "the checks have run"
NEEDS_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
GPUS_SLACK = 20.0
"""A GPU's exp, log and division are approximations, which the interpreter's are not."""
slack = 1.0
"""Tolerances are multiplied by this."""


def in_interpreter(*checks: Callable[[], None]) -> None:
    """Run functions of a module of tests, one after the other; raises what they raise."""
    _in_a_process(checks, [], {"TRITON_INTERPRET": "1"})


def moved_in_interpreter(*checks: Callable[[], None]) -> None:
    """As `in_interpreter`, the memory of all tensors copied at each launch as `on_a_gpu` does it."""
    _in_a_process(checks, ["import interpreted; interpreted.launch_on('cpu')"], {"TRITON_INTERPRET": "1"})


def on_a_gpu(*checks: Callable[[], None]) -> None:
    """As `in_interpreter`, but kernels are compiled, and run on the GPU; all else stays on the CPU."""
    _in_a_process(checks, ["import interpreted; interpreted.launch_on('cuda')"], {"TRITON_INTERPRET": "0"})


def _in_a_process(checks: Sequence[Callable[[], None]], before: Sequence[str], variables: Mapping[str, str]) -> None:
    calls = [f"import {check.__module__}; {check.__module__}.{check.__name__}()" for check in checks]
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", "\n".join([*before, *calls, f"print({DONE!r})"])],
        env={**os.environ, "PYTHONPATH": path, **variables},
        capture_output=True,
        text=True,
        timeout=480,
    )
    assert done.stdout.endswith(f"{DONE}\n"), done.stdout + done.stderr


def launch_on(device: str) -> None:
    """Let all kernels of modules that are imported from now on run on a device, whatever their tensors are on.

    At each launch the memory of all tensors is copied there and back, so that a view is a view there too.
    """
    from edge_depth_nerf.kernels import triton_launch

    if device != "cpu":
        global slack
        slack = GPUS_SLACK
    launch = triton_launch.launch

    def launched(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
        memory: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

        def moved(tensor: torch.Tensor) -> torch.Tensor:
            here = tensor.untyped_storage()
            if here._cdata not in memory:
                memory[here._cdata] = here, torch.UntypedStorage(here.nbytes(), device=device)
                memory[here._cdata][1].copy_(here)
            there, at = memory[here._cdata][1], tensor.storage_offset()
            return torch.empty(0, dtype=tensor.dtype, device=device).set_(there, at, tensor.shape, tensor.stride())

        given = tree_map_only(torch.Tensor, moved, arguments)
        launch(kernel, grid, *given, **constants)
        for here, there in memory.values():
            here.copy_(there)

    triton_launch.launch = launched


def assert_near(found: torch.Tensor | None, expected: torch.Tensor | None, tolerance: float) -> None:
    """Differences relative to the largest value, of which there is one; NaN only where NaN is expected."""
    assert found is not None and expected is not None
    assert found.shape == expected.shape
    expected = expected.double()
    is_nan = expected.isnan()
    assert torch.equal(found.isnan(), is_nan)
    difference = (found.double() - expected)[~is_nan].abs().max()
    largest = expected[~is_nan].abs().max()
    assert largest > 0
    assert difference <= slack * tolerance * largest, (float(difference), float(largest))
