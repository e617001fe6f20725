"""The hash grid's Triton kernels, interpreted beside the CPU's; `test_hash_grid_triton.py` compiles them."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("triton")

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
