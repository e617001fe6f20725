"""Eq. 4's kernels against the slow twin and torch in float64: Numba's, and Triton's interpreted and compiled."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import reference
import torch
from ahead_of_time import ARCHITECTURES, check_registers
from interpreted import NEEDS_A_GPU, assert_near, on_a_gpu

from edge_depth_nerf.method import depth_losses, edge_loss_numba
from edge_depth_nerf.method.depth_losses import EdgeLoss, Level
from edge_depth_nerf.method.losses import EDGE_LOSS, EPS, NARROW, Gaussian, edge_loss

Rays = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
FORMS: list[tuple[Gaussian, bool]] = [("point", False), ("point", True), ("interval", False), ("interval", True)]


def level_of(rays: int, samples: int, seed: int = 0) -> Rays:
    """Weights, starts and ends of samples, prior and sigma; some rays without one, and some samples of no length."""
    generator = np.random.default_rng(seed)
    steps = generator.exponential(1, (rays, samples + 1)) * generator.choice([0, 0.01, 1, 5], (rays, samples + 1))
    edges = 0.3 + np.cumsum(steps, 1) * 150 / np.maximum(steps.sum(1, keepdims=True), 1)
    edges = torch.tensor(edges, dtype=torch.float32)
    weights = torch.tensor(generator.dirichlet(np.full(samples, 0.3), rays), dtype=torch.float32)
    weights[:, samples // 2] = 0
    prior, sigma = generator.uniform(3, 120, rays), 10 ** generator.uniform(-1.3, 1.3, rays)
    prior[:4], sigma[4:6] = [0, np.nan, np.inf, -2][: len(prior[:4])], [0, np.nan][: len(sigma[4:6])]
    prior, sigma = (torch.tensor(each, dtype=torch.float32) for each in (prior, sigma))
    return weights.requires_grad_(), edges[:, :-1], edges[:, 1:], prior, sigma


def by_kernels(level, gaussian="interval", norm=True, kernels: Any = None) -> torch.Tensor:
    if kernels is None:
        from edge_depth_nerf.method import edge_loss_triton as kernels

    return kernels.edge_loss(*level, interval=gaussian == "interval", divide_by_norm=norm, eps=EPS, narrow=NARROW)


def check_values_and_gradients(kernels: Any = None) -> None:
    """Rays and samples that are no multiple of what a program works on, several programs and several passes."""
    sizes = (13, 65), (8, 64), (70, 130), (21, 48), (30, 1)
    for number, (gaussian, norm) in enumerate([*FORMS, FORMS[-1]]):
        level = level_of(*sizes[number])
        found = by_kernels(level, gaussian, norm, kernels=kernels)
        factors = torch.arange(1.0, len(found) + 1)
        (gradient,) = torch.autograd.grad((found * factors).sum(), level[0])
        exact = [each.detach().double() for each in level]
        prior, sigma = exact[3:]
        has_prior = (prior > 0) & prior.isfinite() & (sigma > 0) & sigma.isfinite()
        twin = reference.edge_loss(*exact, gaussian=gaussian, divide_by_norm=norm)
        assert twin > 0 and not found[~has_prior].any()
        assert float(found.detach().sum() / has_prior.sum()) == pytest.approx(twin, rel=5e-6)
        exact[0].requires_grad_()
        losses = edge_loss(*exact, gaussian=gaussian, divide_by_norm=norm)
        torch.testing.assert_close(found.double(), losses, rtol=2e-5, atol=1e-6)
        (expected,) = torch.autograd.grad((losses * factors).sum(), exact[0])
        assert_near(gradient, expected, 5e-6)


def check_nothing_to_look_at(kernels: Any = None) -> None:
    for rays, samples in ((0, 5), (5, 0), (4, 7)):  # the first four rays have no prior
        level = level_of(max(rays, 1), max(samples, 1))
        weights, starts, ends = (each.detach()[:rays, :samples] for each in level[:3])
        prior, sigma = (each[:1].expand(rays).contiguous() if rays != 4 else each for each in level[3:])
        losses = by_kernels((weights.requires_grad_(), starts, ends, prior, sigma), kernels=kernels)
        assert losses.shape == (rays,) and not losses.any()
        (gradient,) = torch.autograd.grad(losses.sum(), weights)
        assert gradient.shape == (rays, samples) and not gradient.any()


def check_what_is_not_finite(kernels: Any = None) -> None:
    """In a ray without a prior it counts for nothing; in another one a sample without an end gives nothing."""
    level = level_of(9, 20)
    expected = by_kernels(level, kernels=kernels)
    weights, starts, ends = (each.detach().clone() for each in level[:3])
    weights[1], starts[2], ends[3] = float("nan"), float("nan"), float("inf")
    assert torch.equal(by_kernels((weights, starts, ends, *level[3:]), kernels=kernels), expected)
    starts[7, 3], ends[8, 4:6] = -float("inf"), float("nan")
    given = weights.requires_grad_(), starts, ends, *level[3:]
    losses, of_torch = by_kernels(given, kernels=kernels), edge_loss(*given, gaussian="interval", divide_by_norm=True)
    torch.testing.assert_close(losses, of_torch, rtol=2e-6, atol=1e-6)
    gradients = [torch.autograd.grad(each.sum(), weights)[0] for each in (losses, of_torch)]
    assert_near(gradients[0], gradients[1], 1e-6)
    with torch.no_grad():
        weights[8] = float("nan")  # a broken training has to be seen
    assert by_kernels(given, kernels=kernels).isnan().tolist() == [False] * 8 + [True]


CHECKS = check_values_and_gradients, check_nothing_to_look_at, check_what_is_not_finite
"""In Triton's interpreter test_back_ends.py runs them, those of all kernels in one process."""


@pytest.mark.parametrize("check", CHECKS)
def test_the_same_on_the_cpu(check):
    check(edge_loss_numba)


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(*CHECKS)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiled_without_spills(architecture, tmp_path):
    pytest.importorskip("triton")

    def step() -> None:
        for gaussian in ("point", "interval"):
            by_kernels(level_of(16, 256), gaussian).sum().backward()

    check_registers(step, architecture, tmp_path, {"_loss_kernel"}, 64)


def test_the_kernels_serve_what_they_can_do(monkeypatch):
    """float32 and half precision with a gradient to the weights alone; all else is left to torch."""
    asked: list[str] = []
    monkeypatch.setattr(depth_losses, "EDGE_LOSS", SimpleNamespace(on=lambda device: asked.append(device.type)))
    level = level_of(12, 30)
    expected = EdgeLoss()(Level(*level))
    weights, starts, ends, prior, sigma = level
    EdgeLoss()(Level(weights.detach().half(), starts.half(), ends.half(), prior, sigma))
    assert asked == ["cpu", "cpu"]
    EdgeLoss()(Level(weights.double(), starts, ends, prior, sigma))
    EdgeLoss()(Level(weights, starts, ends, prior, sigma.clone().requires_grad_()))
    assert len(asked) == 2
    monkeypatch.undo()
    assert EDGE_LOSS.on(torch.device("cpu")) is edge_loss_numba.edge_loss
    torch.testing.assert_close(EdgeLoss()(Level(*level)), expected, rtol=2e-5, atol=1e-6)
