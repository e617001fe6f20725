"""The kernels along rays against float64 and each other: Numba's, and Triton's interpreted and compiled."""

from __future__ import annotations

from typing import Any

import interpreted
import pytest
import torch
from ahead_of_time import ARCHITECTURES, check_registers, compiled
from interpreted import NEEDS_A_GPU, assert_near, on_a_gpu

from edge_depth_nerf.kernels import formulas, ray_numba

SIZES = ((2, 1), (5, 16), (5, 17), (3, 48), (2, 256), (2, 300))
"""Rays and samples, of which few are multiples of what a program works on."""


def histograms(rays: int, samples: int, intervals: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Edges and weights of samples and of a proposal; some edges are common to both, some intervals have no length."""
    generator = torch.Generator().manual_seed(seed)
    outer_edges = torch.rand(rays, intervals + 1, generator=generator).sort(dim=1)[0]
    edges = torch.rand(rays, samples + 1, generator=generator).sort(dim=1)[0]
    common = min(samples, intervals) // 2
    edges[:, : common + 1] = outer_edges[:, : common + 1]
    edges = edges.sort(dim=1)[0]
    edges[:, samples // 2] = edges[:, samples // 2 + 1]
    weights = torch.rand(rays, samples, generator=generator) ** 4
    outer_weights = torch.rand(rays, intervals, generator=generator) ** 4
    return (
        edges,
        weights / weights.sum(1, keepdim=True),
        outer_edges,
        outer_weights / outer_weights.sum(1, keepdim=True),
    )


def torch_weights(densities: torch.Tensor, deltas: torch.Tensor) -> torch.Tensor:
    """nerfstudio's."""
    depth = densities * deltas
    before = torch.cat([torch.zeros_like(depth[:, :1]), depth[:, :-1].cumsum(1)], 1)
    return torch.nan_to_num((1 - torch.exp(-depth)) * torch.exp(-before))


def by_triton() -> Any:
    from edge_depth_nerf.kernels import ray_triton

    return ray_triton


def check_weights() -> None:
    kernels = by_triton()
    for rays, samples in (*SIZES, (33, 17)):  # several rays a program
        # a sum of float32 may be wrong by half a unit of the last place for each sample
        tolerance = max(1e-6, samples * 2**-25)
        densities = 10 ** (4 * torch.rand(rays, samples) - 2)
        densities[0] = 0
        densities[-1, samples // 2 :] = 1e9
        deltas = torch.rand(rays, samples) / samples
        gradient = torch.randn(rays, samples)
        found = kernels.weights_from_densities(densities.requires_grad_(), deltas)
        (to_densities,) = torch.autograd.grad(found, densities, gradient)
        exact = densities.detach().double().requires_grad_()
        expected = torch_weights(exact, deltas.double())
        assert_near(found.detach(), expected.detach(), tolerance)
        assert_near(to_densities, torch.autograd.grad(expected, exact, gradient.double())[0], tolerance)
    for shape in ((0, 5), (5, 0)):
        empty = torch.empty(shape, requires_grad=True)
        found = kernels.weights_from_densities(empty, torch.empty(shape))
        assert found.shape == shape and torch.autograd.grad(found.sum(), empty)[0].shape == shape


def check_weights_of_what_is_not_finite() -> None:
    kernels = by_triton()
    densities, deltas, gradient = torch.rand(4, 10), torch.rand(4, 10), torch.randn(4, 10)
    densities[1, 4], densities[2, 3] = float("inf"), float("nan")
    densities.requires_grad_()
    found, expected = (form(densities, deltas) for form in (kernels.weights_from_densities, torch_weights))
    assert_near(found.detach(), expected.detach(), 1e-6)
    assert not found.isnan().any()
    gradients = [torch.autograd.grad(each, densities, gradient)[0] for each in (found, expected)]
    assert gradients[1][2].isnan().any() and not gradients[1][[0, 3]].isnan().any()
    assert_near(gradients[0], gradients[1], 1e-6)


def exact_shares(weights: torch.Tensor, edges: torch.Tensor, placed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Which share of the weights lies before places, and up to them, in float64; what rounds to one counts for both.

    Of a ray without weights they are spread evenly over its samples.
    """
    weights, edges, placed = weights.double(), edges.double(), placed.double()
    weights = torch.where(weights.sum(1, keepdim=True) > 0, weights, 1)
    cumulative = torch.nn.functional.pad((weights / weights.sum(1, keepdim=True)).cumsum(1), (1, 0))
    last = edges.shape[1] - 1
    lower, upper = placed - 2e-7, placed + 2e-7
    to = torch.searchsorted(edges, lower).clamp(max=last)
    at = (torch.searchsorted(edges, upper, right=True) - 1).clamp(min=0)

    def between(start: torch.Tensor, end: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        start_x, end_x = edges.gather(1, start), edges.gather(1, end)
        share = ((x - start_x) / (end_x - start_x)).nan_to_num(0.0).clamp(0, 1)
        return torch.lerp(cumulative.gather(1, start), cumulative.gather(1, end), share)

    return between((to - 1).clamp(min=0), to, lower), between(at, (at + 1).clamp(max=last), upper)


def check_places() -> None:
    kernels = by_triton()
    for rays, samples in SIZES:
        for places, padding in ((1, 0.01), (17, 0.0), (49, 0.01)):
            edges, weights, _, _ = histograms(rays, samples, 5)
            weights[0] = 0
            weights[-1] = torch.arange(samples) == samples // 3
            wanted = torch.rand(rays, places).sort(dim=1)[0]
            wanted[0, 0], wanted[-1, -1] = 0, 1
            placed = kernels.sample_pdf(weights, edges, wanted, padding, 1e-5)
            expected = ray_numba.sample_pdf(weights, edges, wanted, padding, 1e-5)
            assert_near(placed, expected, 1e-6)
            before, behind = exact_shares(weights + padding, edges, placed)
            assert ((before - 1e-6 <= wanted) & (wanted <= behind + 1e-6)).all()
            # in the same order, but for rounding
            assert not bool((placed.diff() < -1e-6).any())
    assert kernels.sample_pdf(weights[:0], edges[:0], wanted[:0], 0.01, 1e-5).shape == (0, places)
    weights[1, 3], wanted[:, -1] = float("nan"), 0.5
    placed = kernels.sample_pdf(weights, edges, wanted, 0.01, 1e-5)
    assert placed[1].isnan().all() and placed[0].isfinite().all()


def check_the_interlevel_loss() -> None:
    kernels = by_triton()
    for (rays, samples), intervals in zip(SIZES, (1, 7, 64, 96, 257, 31), strict=True):
        edges, weights, outer_edges, outer_weights = histograms(rays, samples, intervals)
        outer_weights.requires_grad_()
        given = edges, weights, outer_edges, outer_weights
        exact = formulas.interlevel_loss(*(each.double() for each in given))
        losses = [exact, kernels.interlevel_loss(*given), ray_numba.interlevel_loss(*given)]
        gradients = [torch.autograd.grad(3 * loss, outer_weights)[0] for loss in losses]
        # the CPU's takes differences of cumulative sums, which have lost digits
        for loss, gradient, tolerance in zip(losses[1:], gradients[1:], (1e-6 * interpreted.slack, 5e-3), strict=True):
            assert float(loss.detach()) == pytest.approx(float(losses[0].detach()), rel=tolerance, abs=1e-12)
            assert (gradient - gradients[0]).abs().max() <= tolerance * gradients[0].abs().max()
        assert gradients[0].any() or samples == 1
    wide = torch.cat([edges, edges], 1).t().contiguous().t()[:, : samples + 1]  # other strides, the same numbers
    column_major = outer_weights.detach().t().contiguous().t().requires_grad_()
    loss = kernels.interlevel_loss(wide, weights, outer_edges, column_major)
    assert torch.equal(loss, losses[1]) and torch.equal(torch.autograd.grad(3 * loss, column_major)[0], gradients[1])
    weights[1] = float("nan")  # of such a ray neither form adds anything
    losses = [module.interlevel_loss(edges, weights, outer_edges, outer_weights) for module in (ray_numba, kernels)]
    assert float(losses[0].detach()) > 0
    assert float(losses[1].detach()) == pytest.approx(float(losses[0].detach()), rel=1e-5)
    nothing = kernels.interlevel_loss(edges[:0], weights[:0], outer_edges[:0], outer_weights[:0])
    assert float(nothing.detach()) == 0 and torch.autograd.grad(nothing, outer_weights)[0].shape == outer_weights.shape


def check_the_distortion_loss() -> None:
    kernels = by_triton()
    for rays, samples in SIZES:
        edges, weights, _, _ = histograms(rays, samples, 5)
        weights.requires_grad_()
        found = kernels.distortion_loss(edges, weights)
        (gradient,) = torch.autograd.grad(3 * found, weights)
        exact, midpoints = weights.detach().double().requires_grad_(), (edges[:, 1:] + edges[:, :-1]).double() / 2
        pairs = exact[:, :, None] * exact[:, None] * (midpoints[:, :, None] - midpoints[:, None]).abs()
        expected = (pairs.sum((1, 2)) + (exact.square() * edges.diff().double()).sum(1) / 3).mean()
        assert float(found.detach()) == pytest.approx(float(expected.detach()), rel=1e-6, abs=1e-9)
        to_weights = torch.autograd.grad(3 * expected, exact)[0]
        torch.testing.assert_close(gradient.double(), to_weights, rtol=1e-5, atol=1e-8)
        assert gradient.any() or samples == 1
    column_major = weights.detach().t().contiguous().t().requires_grad_()
    loss = kernels.distortion_loss(edges, column_major)
    assert torch.equal(torch.autograd.grad(3 * loss, column_major)[0], gradient)
    assert float(kernels.distortion_loss(edges[:0], weights[:0]).detach()) == 0
    with torch.no_grad():
        weights[0, 0] = float("nan")
    assert kernels.distortion_loss(edges, weights).isnan()


OF_WEIGHTS = (check_weights, check_weights_of_what_is_not_finite)
CHECKS = (*OF_WEIGHTS, check_places, check_the_interlevel_loss, check_the_distortion_loss)
"""In Triton's interpreter test_back_ends.py runs them, those of all kernels in one process."""


def step(samples: int = 48, intervals: int = 256) -> None:
    """All kernels along rays."""
    kernels = by_triton()
    edges, weights, outer_edges, outer_weights = (
        torch.rand(16, each) for each in (samples + 1, samples, intervals + 1, intervals)
    )
    kernels.sample_pdf(outer_weights, outer_edges, edges, 0.01, 1e-5)
    kernels.interlevel_loss(edges, weights, outer_edges, outer_weights.requires_grad_())
    kernels.distortion_loss(edges, weights.requires_grad_())
    for densities in (outer_weights.detach().requires_grad_(), weights):
        kernels.weights_from_densities(densities, torch.rand(densities.shape)).sum().backward()


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(*CHECKS)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiled_without_spills(architecture, tmp_path):
    pytest.importorskip("triton")
    along_rays = {"_place_kernel", "_bound_kernel", "_distortion_kernel", "_weight_kernel", "_density_gradient_kernel"}
    check_registers(step, architecture, tmp_path, along_rays, 96)


def test_placing_compares_no_sample_with_each_place(tmp_path):
    """Its code has no loop, and the 776 pairs that each thread would compare do not fit into it with their sums."""
    pytest.importorskip("triton")
    from edge_depth_nerf.kernels import ray_triton

    edges, wanted = torch.rand(2, 257), torch.rand(2, 97)
    (kernel,) = compiled(lambda: ray_triton.sample_pdf(edges[:, 1:], edges, wanted, 0.01, 1e-5), 90, tmp_path)
    instructions = kernel.instructions()
    # what follows the end of a program jumps to itself
    assert sum(count for name, count in instructions.items() if name.startswith("BRA")) == 1
    assert instructions.total() < 800
