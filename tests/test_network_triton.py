"""The network's Triton kernels against torch, in Triton's interpreter; and compiled."""

from __future__ import annotations

import itertools
from types import ModuleType
from typing import Any

import pytest
import torch
from ahead_of_time import ARCHITECTURES, compiled
from interpreted import NEEDS_A_GPU, assert_near, in_interpreter, on_a_gpu
from torch._subclasses.fake_tensor import FakeTensorMode

from edge_depth_nerf.kernels import back_ends
from edge_depth_nerf.kernels.fields import use_fused_fields

WIDTHS = ((32, 64, 16), (15, 64, 64, 3), (10, 16, 1))
"""nerfacto's two networks of the field (without what a ray's points share), and a proposal network."""


def layers(widths: tuple[int, ...], groups: int = 0) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    weights = [torch.randn(out, width) / width**0.5 for width, out in itertools.pairwise(widths)]
    biases = [torch.randn(len(weight)) for weight in weights]
    if groups:
        biases[0] = torch.randn(groups, widths[1])
    return weights, biases


def straight(x: torch.Tensor, weights: list[torch.Tensor], biases: list[torch.Tensor], half: bool) -> torch.Tensor:
    """The network in float64; `half` rounds what enters a product to float16, as autocast does."""
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        rows = bias.repeat_interleave(len(x) // len(bias), 0) if bias.ndim == 2 else bias
        x, weight = (each.half().double() if half else each.double() for each in (x, weight))
        x = x @ weight.T + rows
        x = x.clamp(min=0) if number < len(weights) - 1 else x
    return x


def check_values() -> None:
    """Points that are no multiple of a program's, several programs, groups that begin within one."""
    from edge_depth_nerf.kernels import network_triton

    for widths, (points, groups) in zip(WIDTHS, ((1, 0), (310, 31), (64 * 5 + 7, 0)), strict=True):
        torch.manual_seed(points)
        weights, biases = layers(widths, groups)
        x = torch.randn(points, widths[0] + 3)[:, 2:-1]
        found = network_triton.network(x, weights, biases)
        assert_near(found, straight(x, weights, biases, half=True), 5e-4)
        assert_near(found, straight(x, weights, biases, half=False), 5e-3)


def check_gradients() -> None:
    """To points, weights and biases, beside a twin that rounds as autocast does, and one in float64."""
    from edge_depth_nerf.kernels import network_triton

    for widths, (points, groups) in zip(WIDTHS, ((1, 0), (310, 31), (64 * 5 + 7, 0)), strict=True):
        torch.manual_seed(points)
        weights, biases = layers(widths, groups)
        x, slope = torch.randn(points, widths[0] + 3)[:, 2:-1], torch.randn(points, widths[-1])
        given = [each.clone().requires_grad_() for each in (x, *weights, *biases)]
        exact = [each.detach().double().requires_grad_() for each in given]
        count = len(weights)
        found = network_triton.network(given[0], given[1 : count + 1], given[count + 1 :])
        gradients = torch.autograd.grad(found, given, slope)
        # a hidden number near 0 may fall to the other side of its ReLU where float16 rounds it
        for half, tolerance in ((True, 5e-3), (False, 5e-2)):
            twin = straight(exact[0], exact[1 : count + 1], exact[count + 1 :], half)
            for one, another in zip(gradients, torch.autograd.grad(twin, exact, slope.double()), strict=True):
                off = float((one - another).norm() / another.norm())
                assert one.dtype == torch.float32 and off < tolerance, (widths, half, one.shape, off)
    empty = [each.detach()[:0].requires_grad_() if each is given[0] else each for each in given]
    nothing = network_triton.network(empty[0], empty[1 : count + 1], empty[count + 1 :]).sum()
    gradients = torch.autograd.grad(nothing, empty)
    assert [each.shape for each in gradients] == [each.shape for each in empty]
    assert not any(each.any() for each in gradients)


def check_half_precision_empty_and_not_finite() -> None:
    from edge_depth_nerf.kernels import network_triton

    weights, biases = layers((10, 16, 1))
    x = torch.randn(70, 10)
    whole = network_triton.network(x, weights, biases)
    assert torch.equal(network_triton.network(x.half(), weights, biases), whole)
    x[5, 3], x[66, 0] = float("nan"), float("inf")
    found = network_triton.network(x, weights, biases)
    usable = x.isfinite().all(1)
    # each point is its own
    assert torch.equal(found[usable], whole[usable]) and found.dtype == torch.float32
    assert network_triton.network(x[:0], weights, biases).shape == (0, 1)


def check_encoding_before_it() -> None:
    """Two kernels, one after the other, give the same; a point that is no number spoils no other."""
    from edge_depth_nerf.kernels import hash_grid_triton, network_triton

    for widths, features, points in (((10, 16, 1), 2, 1), ((32, 64, 16), 4, 131), ((5, 24, 24, 3), 1, 64)):
        torch.manual_seed(points)
        levels = widths[0] // features
        table, scalings = torch.randn(levels << 7, features), 16.0 * 1.5 ** torch.arange(levels)
        weights, biases = layers(widths)
        places = torch.rand(points, 3)
        found = network_triton.encoded_network(places, table, scalings, weights, biases)
        x = hash_grid_triton.encode(places, table, scalings)
        assert found.shape == (points, widths[-1]) and x.abs().max() > 0.1
        assert_near(found, straight(x, weights, biases, half=True), 5e-4)
        places[points // 2, 1] = float("nan")
        usable = places.isfinite().all(1)
        assert usable.sum() == points - 1
        spoilt = network_triton.encoded_network(places, table, scalings, weights, biases)
        assert torch.equal(spoilt[usable], found[usable])
        assert network_triton.encoded_network(places[:0], table, scalings, weights, biases).shape == (0, widths[-1])


def check_what_it_serves() -> None:
    from edge_depth_nerf.kernels import network_triton

    served = [network_triton.fits(layers(widths)[0]) for widths in (*WIDTHS, (4, 2), (8, 64, 32, 3), (128, 64, 3))]
    assert served == [True, True, True, False, False, False]


@pytest.mark.slow
def test_in_the_interpreter():
    pytest.importorskip("triton")
    in_interpreter(
        check_values,
        check_gradients,
        check_half_precision_empty_and_not_finite,
        check_encoding_before_it,
        check_what_it_serves,
    )


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(check_values, check_gradients, check_half_precision_empty_and_not_finite, check_encoding_before_it)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
def test_compiled_without_spills(architecture, tmp_path):
    kernels = pytest.importorskip("edge_depth_nerf.kernels.network_triton")

    def step():
        for widths, groups in zip(WIDTHS, (0, 4, 0), strict=True):
            x = torch.rand(64, widths[0], requires_grad=True)
            kernels.network(x, *layers(widths, groups)).sum().backward()
        for widths in WIDTHS[::2]:
            levels = widths[0] // 2
            grid = torch.rand(64, 3), torch.rand(levels << 7, 2), torch.rand(levels)
            kernels.encoded_network(*grid, *layers(widths))

    found = compiled(step, architecture, tmp_path)
    names = [kernel.name.split()[0] for kernel in found]
    assert names == ["_forward_kernel", "_backward_kernel"] * 3 + ["_encoded_kernel"] * 2
    assert {kernel.spilled for kernel in found} == {0}
    # tensor cores do the products
    assert all(any("MMA" in name for name in kernel.instructions) for kernel in found)


def test_it_is_off_unless_it_is_asked_for(monkeypatch):
    """And serves what autocast would compute in float16 on CUDA."""
    asked = []
    monkeypatch.setattr(back_ends, "working", lambda *given: asked.append(given))
    weights, _ = layers((32, 64, 16))
    with FakeTensorMode():
        x = torch.empty(4, 32, device="cuda")
    monkeypatch.setattr(torch, "get_autocast_dtype", lambda _: torch.float16)
    for chosen, half, expected in ((None, True, 0), ("torch", True, 0), ("triton", False, 0), ("triton", True, 1)):
        monkeypatch.setenv(back_ends.NETWORK, chosen or "")
        monkeypatch.setattr(torch, "is_autocast_enabled", lambda _, half=half: half)
        assert back_ends.of_network(x, weights) is None
        assert len(asked) == expected
    assert back_ends.of_network(torch.empty(4, 32), weights) is None
    assert [module for module, *_ in asked] == ["network_triton"]


@pytest.mark.parametrize("chosen", ["triton", "triton+encoding"])
def test_the_encoding_joins_the_network_where_no_gradient_is_followed(chosen, monkeypatch):
    from nerfstudio.field_components.encodings import HashEncoding
    from nerfstudio.field_components.mlp import MLP

    torch.manual_seed(0)
    encoding, mlp = (
        HashEncoding(5, 16, 64, 8, implementation="torch"),
        MLP(10, 2, 16, 1, out_activation=torch.nn.Tanh()),
    )
    base = torch.nn.Sequential(encoding, mlp)
    places = torch.rand(7, 2, 3)
    expected = base(places)
    use_fused_fields(base)
    called = []

    def joined(*given: Any) -> torch.Tensor:
        called.append([tuple(each.shape) for each in given[:3]])
        return mlp.layers[1](mlp.layers[0](encoding(given[0])).relu())

    stand_in = ModuleType("stand_in")
    monkeypatch.setattr(stand_in, "encoded_network", joined, raising=False)
    monkeypatch.setenv(back_ends.NETWORK, chosen)
    monkeypatch.setattr(back_ends, "of_network", lambda *_: stand_in)
    torch.testing.assert_close(base(places), expected)
    assert not called
    with torch.no_grad():
        torch.testing.assert_close(base(places), expected)
    assert called == ([[(14, 3), (5 << 8, 2), (5,)]] if chosen == "triton+encoding" else [])
