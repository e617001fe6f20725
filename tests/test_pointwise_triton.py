"""The kernels that work number by number against float64 twins: Triton's, interpreted and compiled."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from ahead_of_time import ARCHITECTURES, check_registers
from interpreted import NEEDS_A_GPU, assert_near, moved_in_interpreter, on_a_gpu

from edge_depth_nerf.kernels import formulas

SIZES = ((1, 1), (5, 17), (33, 49), (3, 256), (7, 300))
"""Rays and samples, of which few are multiples of what a program works on."""


def spaced(distance: torch.Tensor) -> torch.Tensor:
    """nerfstudio's piecewise spacing."""
    return torch.where(distance < 1, distance / 2, 1 - 1 / (2 * distance))


def by_triton() -> Any:
    from edge_depth_nerf.kernels import pointwise_triton

    return pointwise_triton


def check_distances() -> None:
    kernels = by_triton()
    for rays, count in SIZES:
        torch.manual_seed(rays)
        places = torch.rand(rays, count + 1).sort(dim=1)[0][:, :-1]
        nears, fars = 0.01 + 0.3 * torch.rand(rays, 1), 2 + 30 * torch.rand(rays, 1)
        found = kernels.distances(places, nears, fars)
        first, last, exact = spaced(nears.double()), spaced(fars.double()), places.double()
        x = first + exact * (last - first)
        assert_near(found, torch.where(x < 0.5, 2 * x, 1 / (2 - 2 * x)), 1e-5)
        # as far as float32 goes, the inverse of the distance is that of torch, to two units in the last place of 1
        x = torch.lerp(spaced(nears), spaced(torch.full_like(fars, 1e4)), places)
        found = kernels.distances(places, nears, torch.full_like(fars, 1e4))
        inverse = torch.where(x < 0.5, 1 / (2 * x), 2 - 2 * x)
        torch.testing.assert_close(1 / found, inverse, rtol=1e-6, atol=2.4e-7)
    even = torch.linspace(0, 1, 7).expand(3, -1)  # one row for all rays
    assert torch.equal(*(kernels.distances(each, nears[:3], fars[:3]) for each in (even, even.clone())))
    assert kernels.distances(places[:0], nears[:0], fars[:0]).shape == (0, count)


def check_densities() -> None:
    kernels = by_triton()
    dtypes = ((torch.float32, 1e-6), (torch.float16, 1e-3))
    for count in (1, 255, 700):
        torch.manual_seed(count)
        for dtype, tolerance in dtypes:
            features = (12 * torch.randn(count, 5)).to(dtype)
            features[-1, 0] = 20  # steeper than the gradient follows
            before = features[:, 0].detach().requires_grad_()
            inside, gradient = (torch.arange(count) % 3 != 1).float(), torch.randn(count) * 1e-3
            found = kernels.density(before, inside, 0.01)
            exact = before.detach().double()
            assert_near(found.detach(), 0.01 * exact.exp() * inside, 1e-6)
            (to_before,) = torch.autograd.grad(found, before, gradient)
            expected = 0.01 * exact.clamp(-15, 15).exp() * inside * gradient
            assert to_before.dtype == dtype and found.dtype == torch.float32
            assert_near(to_before, expected, tolerance)
    with torch.no_grad():
        before[3] = float("nan")
    assert kernels.density(before, inside, 1.0).isnan().nonzero().tolist() == [[3]]
    found = kernels.density(before, inside, 1.0)
    assert torch.autograd.grad(found.sum(), before)[0].isnan().nonzero().tolist() == [[3]]
    assert kernels.density(before[:0], inside[:0], 1.0).shape == (0,)


def check_harmonics() -> None:
    """Against the formula that test_back_ends.py compares with nerfstudio's."""
    kernels = by_triton()
    for count in (1, 255, 700):
        directions = torch.nn.functional.normalize(torch.randn(count, 4)[:, :3], dim=1)
        expected = formulas.harmonics(directions.double())
        for dtype, tolerance in ((torch.float32, 1e-6), (torch.float16, 5e-4)):
            found = kernels.harmonics(directions, dtype)
            assert found.dtype == dtype
            assert_near(found, expected, tolerance)
        expanded = directions[:, None].expand(-1, 4, -1)[:, 2]
        assert torch.equal(kernels.harmonics(expanded, dtype), found)
    assert kernels.harmonics(directions[:0], dtype).shape == (0, 16)


def check_contraction() -> None:
    """Near and far, on borders, no numbers; no multiple of what a program works on, and no point at all."""
    from edge_depth_nerf.kernels import contraction_numba, pointwise_triton

    at = torch.tensor([-30.0, -2.0, -1.0, -0.5, 0.0, 0.3, 1.0, 1e6, 1e30, float("nan")])
    x = torch.cat([torch.cartesian_prod(at, at, at), 3 * torch.randn(300, 3)])
    usable = ~x.isnan().any(1)
    (places, inside), (expected, marked) = (module.contract(x) for module in (pointwise_triton, contraction_numba))
    assert torch.equal(inside[usable], marked[usable]) and 0 < int(inside.sum()) < len(x)
    torch.testing.assert_close(places[usable], expected[usable], rtol=2e-7, atol=0)
    assert not inside[~usable].any() and places[~usable].isnan().any(1).all()
    assert [each.shape for each in pointwise_triton.contract(x[:0])] == [(0, 3), (0,)]


CHECKS = check_distances, check_contraction, check_densities, check_harmonics


@pytest.mark.slow
def test_in_the_interpreter():
    """With all memory copied there and back at each launch, as on a GPU."""
    pytest.importorskip("triton")
    moved_in_interpreter(*CHECKS)


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(*CHECKS)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiled_without_spills(architecture, tmp_path):
    kernels = pytest.importorskip("edge_depth_nerf.kernels.pointwise_triton")

    def step():
        rays = torch.rand(300, 3)
        kernels.distances(rays, rays[:, :1], rays[:, :1])
        kernels.contract(rays)
        for dtype in (torch.float16, torch.float32):
            kernels.harmonics(rays, dtype)
            outputs = torch.rand(300, 16, dtype=dtype)[:, 0].requires_grad_()
            kernels.density(outputs, rays[:, 0], 0.01).sum().backward()

    of_densities = {"_density_kernel", "_before_gradient_kernel"}
    names = {"_contract_kernel", "_distance_kernel", "_harmonics_kernel", *of_densities}
    check_registers(step, architecture, tmp_path, names, 64)
