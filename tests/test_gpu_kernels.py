"""Triton's kernels without a GPU: compiled for some, and interpreted beside the CPU's."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

triton = pytest.importorskip("triton")

FLOATS = "*fp32"
GRID_KERNELS: dict[str, list[str]] = {
    "_encode_kernel": ["positions", "table", "scalings", "encoded"],
    "_table_gradient_kernel": ["positions", "gradient", "scalings", "to_table"],
    "_position_gradient_kernel": ["positions", "table", "gradient", "scalings", "to_positions"],
}
"""The hash grid's kernels and their arrays."""
TOOLS = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"


def compiled(kernel: Any, arrays: list[str], capability: int, **constants: int) -> bytes:
    """A kernel's machine code for an architecture; its other arguments are whole numbers."""
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    kinds = {name: FLOATS if name in arrays else "i32" for name in kernel.arg_names}
    source = ASTSource(
        fn=kernel,
        signature=kinds | dict.fromkeys(constants, "constexpr"),
        constexprs={(kernel.arg_names.index(name),): value for name, value in constants.items()},
        # torch's memory is aligned
        attrs={(kernel.arg_names.index(name),): [["tt.divisibility", 16]] for name in arrays},
    )
    options = {"num_warps": 4, "enable_fp_fusion": False}
    return triton.compile(source, target=GPUTarget("cuda", capability, 32), options=options).asm["cubin"]


@pytest.mark.skipif(not (TOOLS / "cuobjdump").is_file(), reason="this Triton brings no cuobjdump")
@pytest.mark.parametrize("capability", [80, 89, 90])
@pytest.mark.parametrize("name", GRID_KERNELS)
def test_the_hash_grids_kernels_compile_and_spill_nothing(name, capability, tmp_path):
    from edge_depth_nerf.kernels import hash_grid_triton

    code = compiled(getattr(hash_grid_triton, name), GRID_KERNELS[name], capability, LEVELS=16, FEATURES=2, POINTS=128)
    (tmp_path / "kernel.cubin").write_bytes(code)
    command = [str(TOOLS / "cuobjdump"), "-res-usage", str(tmp_path / "kernel.cubin")]
    said = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    used = {what: int(number) for what, number in re.findall(r"(REG|STACK|LOCAL):(\d+)", said)}
    assert 0 < used["REG"] <= 64, said
    # registers that do not suffice are kept in local memory, or on the stack
    assert used["STACK"] == used["LOCAL"] == 0, said


INTERPRETED = """
import torch
from edge_depth_nerf.kernels import hash_grid_numba as cpu, hash_grid_triton as cuda
torch.manual_seed(0)
nan = float("nan")
# fewer points than a block, a block, one more, and what is no multiple of it
for levels, features, count in ((3, 2, 1), (2, 4, 128), (1, 1, 129), (5, 2, 300)):
    x = torch.rand(count, 3)
    # borders of cells, outside, and no number at all
    special = torch.tensor([[0.0, 1.0, 0.5], [-1.0, 1.7, -0.3], [nan, 0.2, 0.3], [1e30, 0.5, 0.5]])
    x[: len(special)] = special[:count]
    scalings, table = torch.tensor([16.0, 23.0, 64.0, 100.0, 2000.0])[:levels], torch.randn(levels * 256, features)
    gradient = torch.randn(count, levels * features)
    usable = x.abs().max(1)[0] < 10
    for name, rows, arguments in (
        ("encode", usable, (x, table, scalings)),
        ("table_gradient", slice(None), (x[usable], gradient[usable], scalings, len(table))),
        ("position_gradient", usable, (x, table, gradient, scalings)),
    ):
        expected, found = (getattr(module, name)(*arguments) for module in (cpu, cuda))
        assert found.shape == expected.shape and found.dtype == expected.dtype
        assert expected[rows].isfinite().all()
        off = (found[rows] - expected[rows]).abs().max()
        assert off <= 2e-6 * expected[rows].abs().max(), (name, levels, count, float(off))
    # what is no number gives none, as on the CPU, and spoils nobody else's
    without = cuda.encode(x, table, scalings)
    assert torch.equal(without.isnan().any(1), cpu.encode(x, table, scalings).isnan().any(1))
    # no points at all
    assert cuda.encode(x[:0], table, scalings).shape == (0, levels * features)
    assert not cuda.table_gradient(x[:0], gradient[:0], scalings, len(table)).any()
    assert cuda.position_gradient(x[:0], table, gradient[:0], scalings).shape == (0, 3)
print("all equal")
"""


def test_the_hash_grids_kernels_in_the_interpreter():
    done = subprocess.run(
        [sys.executable, "-c", INTERPRETED],
        env={**os.environ, "TRITON_INTERPRET": "1"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout == "all equal\n", done.stderr
