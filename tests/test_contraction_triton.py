"""The contraction's Triton kernel against the CPU's, in Triton's interpreter; and compiled."""

from __future__ import annotations

import pytest
import torch
from ahead_of_time import ARCHITECTURES, compiled
from interpreted import NEEDS_A_GPU, in_interpreter, on_a_gpu


def check_places() -> None:
    """Near and far, on borders, no numbers; no multiple of what a program works on, and no point at all."""
    from edge_depth_nerf.kernels import contraction_numba, contraction_triton

    at = torch.tensor([-30.0, -2.0, -1.0, -0.5, 0.0, 0.3, 1.0, 1e6, 1e30, float("nan")])
    x = torch.cat([torch.cartesian_prod(at, at, at), 3 * torch.randn(300, 3)])
    usable = ~x.isnan().any(1)
    (places, inside), (expected, marked) = (module.contract(x) for module in (contraction_triton, contraction_numba))
    assert torch.equal(inside[usable], marked[usable]) and 0 < int(inside.sum()) < len(x)
    torch.testing.assert_close(places[usable], expected[usable], rtol=2e-7, atol=0)
    assert not inside[~usable].any() and places[~usable].isnan().any(1).all()
    assert [each.shape for each in contraction_triton.contract(x[:0])] == [(0, 3), (0,)]


@pytest.mark.slow
def test_in_the_interpreter():
    pytest.importorskip("triton")
    in_interpreter(check_places)


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(check_places)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiled_without_spills(architecture, tmp_path):
    kernels = pytest.importorskip("edge_depth_nerf.kernels.contraction_triton")
    (kernel,) = compiled(lambda: kernels.contract(torch.rand(300, 3)), architecture, tmp_path)
    assert kernel.spilled == 0 and kernel.registers <= 64
