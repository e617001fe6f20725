"""Eq. 4's kernels against the slow twin and torch in float64: Numba's, and Triton's interpreted and compiled."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import reference
import torch
from ahead_of_time import ARCHITECTURES, compiled
from interpreted import NEEDS_A_GPU, assert_near, in_interpreter, on_a_gpu

from edge_depth_nerf.kernels import back_ends, edge_loss_numba
from edge_depth_nerf.method import losses
from edge_depth_nerf.method.losses import EPS, NARROW, Gaussian, edge_loss, edge_losses

FORMS: list[tuple[Gaussian, bool]] = [("point", False), ("point", True), ("interval", False), ("interval", True)]
METRES_PER_UNIT = 3.0
Level = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def levels_of(rays: int, *samples: int, seed: int = 0) -> tuple[list[Level], torch.Tensor, torch.Tensor]:
    """Levels of samples, their edges in units; some rays without a prior, and some samples of no length."""
    generator = np.random.default_rng(seed)
    levels = []
    for count in samples:
        steps = generator.exponential(1, (rays, count + 1)) * generator.choice([0, 0.01, 1, 5], (rays, count + 1))
        edges = 0.1 + np.cumsum(steps, 1) * 50 / np.maximum(steps.sum(1, keepdims=True), 1)
        edges = torch.tensor(edges, dtype=torch.float32)
        weights = torch.tensor(generator.dirichlet(np.full(count, 0.3), rays), dtype=torch.float32)
        weights[:, count // 2] = 0
        levels.append((weights.requires_grad_(), edges[:, :-1], edges[:, 1:]))
    prior, sigma = generator.uniform(3, 120, rays), 10 ** generator.uniform(-1.3, 1.3, rays)
    prior[:4], sigma[4:6] = [0, np.nan, np.inf, -2][: len(prior[:4])], [0, np.nan][: len(sigma[4:6])]
    return levels, torch.tensor(prior, dtype=torch.float32), torch.tensor(sigma, dtype=torch.float32)


def by_kernels(levels, prior, sigma, gaussian="interval", norm=True, kernels: Any = None) -> torch.Tensor:
    if kernels is None:
        from edge_depth_nerf.kernels import edge_loss_triton as kernels

    return kernels.edge_losses(
        levels,
        prior,
        sigma,
        metres_per_unit=METRES_PER_UNIT,
        interval=gaussian == "interval",
        divide_by_norm=norm,
        eps=EPS,
        narrow=NARROW,
    )


def check_values_and_gradients(kernels: Any = None) -> None:
    """Rays and samples that are no multiple of what a program works on, several programs and several passes."""
    for (gaussian, norm), (rays, *samples) in zip(
        FORMS, ((13, 30, 65, 5), (8, 64), (70, 1, 130), (21, 48)), strict=True
    ):
        levels, prior, sigma = levels_of(rays, *samples)
        found = by_kernels(levels, prior, sigma, gaussian, norm, kernels=kernels)
        factors = torch.arange(1.0, len(levels) + 1)
        gradients = torch.autograd.grad((found * factors).sum(), [level[0] for level in levels])
        for number, (weights, starts, ends) in enumerate(levels):
            lengths = (starts * METRES_PER_UNIT).double(), (ends * METRES_PER_UNIT).double()
            exact = weights.detach().double().requires_grad_()
            given = (exact.detach(), *lengths, prior, sigma)
            twin = reference.edge_loss(*given, gaussian=gaussian, divide_by_norm=norm)
            assert twin > 0
            assert float(found[number].detach()) == pytest.approx(twin, rel=5e-6)
            loss = edge_loss(exact, *lengths, prior.double(), sigma.double(), gaussian=gaussian, divide_by_norm=norm)
            (expected,) = torch.autograd.grad(loss * factors[number], exact)
            assert_near(gradients[number], expected, 5e-6)


def check_nothing_to_look_at(kernels: Any = None) -> None:
    for rays, samples in ((0, 5), (5, 0), (4, 7)):  # the first four rays have no prior
        levels, prior, sigma = levels_of(max(rays, 1), max(samples, 1))
        weights, starts, ends = (each.detach()[:rays, :samples] for each in levels[0])
        levels = [(weights.requires_grad_(), starts, ends)]
        prior, sigma = (each[:1].expand(rays).contiguous() if rays != 4 else each for each in (prior, sigma))
        loss = by_kernels(levels, prior, sigma, kernels=kernels)
        assert float(loss.detach()) == 0
        (gradient,) = torch.autograd.grad(loss.sum(), weights)
        assert gradient.shape == (rays, samples) and not gradient.any()


def check_what_is_not_finite(kernels: Any = None) -> None:
    """In a ray without a prior it counts for nothing; in another one a sample without an end gives nothing."""
    levels, prior, sigma = levels_of(9, 20)
    expected = by_kernels(levels, prior, sigma, kernels=kernels)
    weights, starts, ends = (each.detach().clone() for each in levels[0])
    weights[1], starts[2], ends[3] = float("nan"), float("nan"), float("inf")
    assert torch.equal(by_kernels([(weights, starts, ends)], prior, sigma, kernels=kernels), expected)
    starts[7, 3], ends[8, 4:6] = -float("inf"), float("nan")
    weights.requires_grad_()
    loss = by_kernels([(weights, starts, ends)], prior, sigma, kernels=kernels)
    of_torch = edge_loss(weights, starts * 3, ends * 3, prior, sigma, gaussian="interval", divide_by_norm=True)
    assert float(loss.detach()) == pytest.approx(float(of_torch.detach()), rel=1e-6)
    gradients = [torch.autograd.grad(each.sum(), weights)[0] for each in (loss, of_torch)]
    assert_near(gradients[0], gradients[1], 1e-6)
    with torch.no_grad():
        weights[8] = float("nan")  # a broken training has to be seen
    assert by_kernels([(weights, starts, ends)], prior, sigma, kernels=kernels).isnan().all()


def check_a_level_that_rests(kernels: Any = None) -> None:
    levels, prior, sigma = levels_of(9, 20, 7)
    levels[0][0].requires_grad_(False)
    by_kernels(levels, prior, sigma, kernels=kernels).sum().backward()
    gradient = levels[1][0].grad
    assert levels[0][0].grad is None and gradient is not None and gradient.any()


@pytest.mark.slow
def test_in_the_interpreter():
    pytest.importorskip("triton")
    in_interpreter(
        check_values_and_gradients, check_nothing_to_look_at, check_what_is_not_finite, check_a_level_that_rests
    )


@pytest.mark.parametrize(
    "check", [check_values_and_gradients, check_nothing_to_look_at, check_what_is_not_finite, check_a_level_that_rests]
)
def test_the_same_on_the_cpu(check):
    check(edge_loss_numba)


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(check_values_and_gradients, check_nothing_to_look_at, check_what_is_not_finite, check_a_level_that_rests)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("gaussian", ["point", "interval"])
def test_compiled_without_spills(gaussian, architecture, tmp_path):
    pytest.importorskip("triton")
    kernels = compiled(
        lambda: by_kernels(*levels_of(16, 256, 96, 48), gaussian).sum().backward(), architecture, tmp_path
    )
    assert [kernel.name for kernel in kernels] == ["_share_kernel", "_sum_kernel", "_scale_kernel"]
    assert [kernel.spilled for kernel in kernels] == [0, 0, 0]
    assert max(kernel.registers for kernel in kernels) <= 64


@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
def test_several_levels_are_edge_loss_of_each(gaussian, norm):
    levels, prior, sigma = levels_of(12, 30, 8)
    found = edge_losses(levels, prior, sigma, metres_per_unit=METRES_PER_UNIT, gaussian=gaussian, divide_by_norm=norm)
    expected = [
        edge_loss(weights, starts * 3, ends * 3, prior, sigma, gaussian=gaussian, divide_by_norm=norm)
        for weights, starts, ends in levels
    ]
    torch.testing.assert_close(found, torch.stack(expected), rtol=5e-6, atol=0)


def test_the_kernels_serve_what_they_can_do(monkeypatch):
    """float32 and half precision with a gradient to the weights alone; all else is left to torch."""
    asked = []
    monkeypatch.setattr(losses, "of_edge_loss", lambda device: asked.append(device.type))
    levels, prior, sigma = levels_of(12, 30)
    edge_losses(levels, prior, sigma)
    assert asked == ["cpu"]
    weights, starts, ends = (each.double() for each in levels[0])
    edge_losses([(weights, starts, ends)], prior, sigma)
    edge_losses(levels, prior, sigma.clone().requires_grad_())
    assert len(asked) == 1
    monkeypatch.undo()
    assert back_ends.of_edge_loss(torch.device("cpu")) is edge_loss_numba
