"""Compile what functions with Triton kernels launch, for GPUs that are not there.

The functions are called on CPU tensors; each launch compiles its kernel for the GPU and is left out.
"""

import re
import subprocess
import sysconfig
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

ARCHITECTURES = (80, 89, 90)
"""A100, RTX 40 and L40, H100 and H200."""
PROGRAMS = Path(sysconfig.get_path("purelib")) / "triton/backends/nvidia/bin"


@dataclass(frozen=True)
class Kernel:
    """A compiled kernel; `registers` are a thread's, `spilled` bytes of a thread's that found no register."""

    name: str
    registers: int
    spilled: int
    program: Path

    def instructions(self) -> Counter[str]:
        """How often it has each, by their names; read by a program that takes half a second."""
        code = subprocess.run([PROGRAMS / "nvdisasm", self.program], capture_output=True, text=True, check=True).stdout
        return Counter(re.findall(r"^\s+/\*[0-9a-f]+\*/\s+(?:@!?U?P\w+\s+)?([A-Z][\w.]*)", code, re.MULTILINE))


@contextmanager
def _compiling_for(architecture: int) -> Iterator[dict[str, bytes]]:
    """Give the compiled programs by kernel's name; a kernel compiled for several arguments has a number behind it."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.runtime.jit import JITFunction

    found: dict[str, bytes] = {}
    launch = JITFunction.run
    seen = set()

    def run(kernel: Any, *args: Any, grid: Any, warmup: bool, **kwargs: Any) -> Any:
        compiled: Any = launch(kernel, *args, grid=grid, warmup=True, **kwargs)
        if compiled.hash not in seen:
            seen.add(compiled.hash)
            number = sum(name.split()[0] == kernel.__name__ for name in found)
            found[f"{kernel.__name__} {number}" if number else kernel.__name__] = compiled.asm["cubin"]

    device: Any = SimpleNamespace(
        get_current_target=lambda: GPUTarget("cuda", architecture, 32),
        get_current_device=lambda: architecture,
        get_current_stream=lambda _: 0,
    )
    triton.runtime.driver.set_active(device)
    try:
        with mock.patch.object(JITFunction, "run", run):
            yield found
    finally:
        triton.runtime.driver._active = None


def check_registers(
    call: Callable[[], Any], architecture: int, folder: Path, names: set[str], most: int
) -> list[Kernel]:
    """Compile what a call launches: kernels of these names, without spills, of at most so many registers a thread."""
    kernels = compiled(call, architecture, folder)
    assert {kernel.name.split()[0] for kernel in kernels} == names
    assert {kernel.spilled for kernel in kernels} == {0}
    assert max(kernel.registers for kernel in kernels) <= most
    return kernels


def compiled(call: Callable[[], Any], architecture: int, folder: Path) -> list[Kernel]:
    """Compile what a call launches."""
    with _compiling_for(architecture) as found:
        call()
    kernels = []
    for name, program in found.items():
        path = folder / f"{name}.cubin"
        path.write_bytes(program)
        use = subprocess.run([PROGRAMS / "cuobjdump", "-res-usage", path], capture_output=True, text=True, check=True)
        (sizes,) = re.findall(r"REG:(\d+) STACK:(\d+) SHARED:\d+ LOCAL:(\d+)", use.stdout)
        registers, stack, local = map(int, sizes)
        kernels.append(Kernel(name, registers, stack + local, path))
    return kernels
