"""Networks by torch's products against float64, as a GPU has them, on the CPU."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from models import layers
from torch import Tensor

from edge_depth_nerf.kernels import products

TOLERANCES = {torch.float32: 3e-6, torch.float16: 6e-2}
"""Of half precision: a number near 0 may round to the other side of a ReLU."""
RUNS = [(40, 7), (90, 1)]
WIDTHS = {"first": (8, 12, 6), "second": (8, 11, 10, 3)}


def scaled(*widths: int) -> tuple[list[Tensor], list[Tensor]]:
    """Layers whose outputs are as large as what enters them."""
    weights, biases = layers(*widths)
    return [(each.detach() / each.shape[1] ** 0.5).requires_grad_() for each in weights], biases


def straight(x: Tensor, weights: Any, biases: Any) -> Tensor:
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = (x.relu() if number else x) @ weight.T + bias
    return x


def exact_of(leaves: list[Tensor]) -> list[Tensor]:
    return [each.detach().double().requires_grad_() for each in leaves]


def assert_near(found: Any, expected: Any, dtype: torch.dtype) -> None:
    for each, other in zip(found, expected, strict=True):
        assert float((each.detach() - other).norm()) <= TOLERANCES[dtype] * float(other.detach().norm())


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("private", [True, False])
@pytest.mark.parametrize("widths", [(16, 64, 16), (10, 16, 1), (4, 2)])
def test_a_network(widths, private, dtype, monkeypatch):
    torch.manual_seed(0)
    if not private:
        monkeypatch.setattr(products, "_with_relu", products._relu_of_product)
    weights, biases = scaled(*widths)
    x, count = torch.randn(601, widths[0], requires_grad=True), len(weights)
    leaves = [x, *weights, *biases]
    found = products.network(x, (weights, biases), dtype)
    gradient = torch.randn(found.shape).to(dtype)
    exact = exact_of(leaves)
    expected = straight(exact[0], exact[1 : 1 + count], exact[1 + count :])
    gradients = torch.autograd.grad(found, leaves, gradient)
    assert found.dtype == dtype and {each.dtype for each in gradients} == {torch.float32}
    assert_near([found, *gradients], [expected, *torch.autograd.grad(expected, exact, gradient.double())], dtype)
    with torch.no_grad():
        assert torch.equal(products.network(x, (weights, biases), dtype), found)
    without = products.network(x.detach(), (weights, biases), dtype)
    assert torch.equal(torch.autograd.grad(without, weights[0], gradient)[0], gradients[1])


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("appearance", [0, 5])
def test_a_field(appearance, dtype):
    """Samples of rays and single points, whose densities nobody asks for."""
    torch.manual_seed(0)
    first, second = scaled(*WIDTHS["first"]), scaled(WIDTHS["second"][0] + appearance, *WIDTHS["second"][1:])
    encoded = torch.randn(370, 8, requires_grad=True)
    of_rays = torch.randn(130, 3 + appearance, requires_grad=True)
    leaves = [encoded, of_rays, *first[0], *first[1], *second[0], *second[1]]
    before, colours = products.field(encoded, of_rays, RUNS, first, second, 3, dtype)
    assert before.shape == (280,) and before.dtype == dtype and colours.dtype == torch.float32
    followed = torch.randn(280).to(dtype), torch.randn(370, 3)
    gradients = torch.autograd.grad([before, colours], leaves, followed, retain_graph=True)

    exact = exact_of(leaves)
    features = straight(exact[0], exact[2:4], exact[4:6])
    rays = torch.cat([exact[1][:40].repeat_interleave(7, 0), exact[1][40:]])
    entering = torch.cat([rays[:, :3], features[:, 1:], rays[:, 3:]], 1)
    outputs = [features[:280, 0], straight(entering, exact[6:9], exact[9:]).sigmoid()]
    expected = torch.autograd.grad(outputs, exact, [each.double() for each in followed])
    assert_near([before, colours, *gradients], [*outputs, *expected], dtype)
    # a loss on colours alone, and once more through what was kept
    (alone,) = torch.autograd.grad(colours, first[0][0], followed[1], retain_graph=True)
    assert not torch.equal(alone, gradients[2])
    again = torch.autograd.grad([before, colours], leaves, followed)
    assert all(map(torch.equal, again, gradients))
    with torch.no_grad():
        assert all(map(torch.equal, products.field(encoded, of_rays, RUNS, first, second, 3, dtype), (before, colours)))


@pytest.mark.parametrize("density", [-1e6, 1e6])
def test_a_density_beyond_half_precision_spoils_no_colour(density):
    """Of space that stays empty, or full, a long training makes it ever larger."""
    torch.manual_seed(0)
    first, second = scaled(*WIDTHS["first"]), scaled(*WIDTHS["second"])
    encoded, of_rays = torch.randn(370, 8, requires_grad=True), torch.randn(130, 3)
    found = []
    for bias in (0.0, density):
        with torch.no_grad():
            first[1][-1][0] = bias
        before, colours = products.field(encoded, of_rays, RUNS, first, second, 3, torch.float16)
        found.append((before, colours, *torch.autograd.grad(colours.sum(), [*second[0], encoded])))
    assert before.isinf().all()
    assert found[0][1].isfinite().all() and all(map(torch.equal, found[0][1:], found[1][1:]))


@pytest.mark.parametrize("where", [0, 1])
def test_layers_beyond_half_precision_spoil_no_colour(where):
    """Two outputs of the hidden layer, or of the last one, that half precision has no number for."""
    torch.manual_seed(0)
    first, second = scaled(*WIDTHS["first"]), scaled(*WIDTHS["second"])
    with torch.no_grad():
        first[1][where][2:4] = torch.tensor([1e6, -1e6]) if where else 1e6
    encoded, of_rays = torch.randn(370, 8, requires_grad=True), torch.randn(130, 3)
    before, colours = products.field(encoded, of_rays, RUNS, first, second, 3, torch.float16)
    assert colours.isfinite().all() and not before.isnan().any()
    assert not torch.autograd.grad(before.float().clamp(-10, 10).sum() + colours.sum(), first[0][1])[0].isnan().any()


def test_there_is_no_second_derivative():
    weights, biases = layers(4, 3, 2)
    x = torch.randn(5, 4, requires_grad=True)
    (gradient,) = torch.autograd.grad(products.network(x, (weights, biases)).sum(), x, create_graph=True)
    with pytest.raises(NotImplementedError, match="The network by products has no second derivative"):
        gradient.sum().backward()
