"""Muon: against its formula by singular values, and AdamW beside it against torch's."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import nn

from edge_depth_nerf.mono.optimizer import HiddenMuon, orthogonalised


def with_iterated_singular_values(matrix: np.ndarray) -> np.ndarray:
    """U·f(S)·Vᵀ, where f is the quintic polynomial of Muon's authors, five times, after division by the norm."""
    left, values, right = np.linalg.svd(matrix / np.linalg.norm(matrix), full_matrices=False)
    for _ in range(5):
        values = 3.4445 * values - 4.7750 * values**3 + 2.0315 * values**5
    return left * values @ right


@pytest.mark.parametrize(("rows", "columns"), [(8, 72), (24, 16), (12, 12)])
def test_a_matrix_becomes_nearly_orthogonal(rows, columns):
    matrix = np.random.default_rng(rows).normal(size=(rows, columns))
    found = orthogonalised(torch.from_numpy(matrix))
    np.testing.assert_allclose(found.numpy(), with_iterated_singular_values(matrix), atol=1e-6)
    single = orthogonalised(torch.from_numpy(matrix).float())
    np.testing.assert_allclose(single.numpy(), found.numpy(), atol=1e-4)
    assert 0.5 < np.linalg.svd(found.numpy(), compute_uv=False).min() and rows * columns > 0


def test_no_gradient_changes_nothing_but_the_decay():
    assert torch.equal(orthogonalised(torch.zeros(4, 9)), torch.zeros(4, 9))


def small() -> tuple[nn.Conv2d, nn.Conv2d, nn.Sequential]:
    torch.manual_seed(0)
    first, last = nn.Conv2d(3, 8, 3), nn.Conv2d(8, 4, 3)
    network = nn.Sequential(first, nn.GroupNorm(2, 8), last).double()
    return first, last, network.to(memory_format=torch.channels_last)


def of_adam(first: nn.Conv2d, network: nn.Sequential) -> list[nn.Parameter]:
    return [parameter for parameter in network.parameters() if parameter is not first.weight]


@pytest.mark.parametrize("threads", [1, 2])
def test_its_steps_are_those_of_its_formula(threads):
    first, last, network = small()
    optimizer = HiddenMuon(network, last, learning_rate=1e-3, hidden_learning_rate=5e-3, weight_decay=0.1)
    expected = first.weight.detach().numpy().copy()
    momentum = np.zeros_like(expected)
    rest = [nn.Parameter(each.detach().clone()) for each in of_adam(first, network)]
    adam = torch.optim.AdamW(rest, lr=1e-3, weight_decay=0.1)
    rng = np.random.default_rng(1)
    with ThreadPoolExecutor(2) as pool:
        for share in (1.0, 0.5, 0.25):
            gradient = rng.normal(size=expected.shape)
            momentum = 0.95 * momentum + 0.05 * gradient
            change = with_iterated_singular_values((0.05 * gradient + 0.95 * momentum).reshape(8, 27))
            expected = expected * (1 - share * 1e-3 * 0.1) - share * 5e-3 * change.reshape(expected.shape)
            first.weight.grad = torch.from_numpy(gradient)
            for own, other in zip(of_adam(first, network), rest, strict=True):
                own.grad = other.grad = torch.from_numpy(rng.normal(size=tuple(own.shape)))
            adam.param_groups[0]["lr"] = share * 1e-3
            adam.step()
            optimizer.step(share, map if threads == 1 else pool.map)
    np.testing.assert_allclose(first.weight.detach().numpy(), expected, atol=1e-8)
    for own, other in zip(of_adam(first, network), rest, strict=True):
        torch.testing.assert_close(own.detach(), other.detach())


def test_without_a_rate_of_its_own_everything_is_left_to_adam():
    (_, last, network), (_, _, other), (_, _, untouched) = small(), small(), small()
    ours = HiddenMuon(network, last, learning_rate=1e-2, hidden_learning_rate=None, weight_decay=0.1)
    torchs = torch.optim.AdamW(other.parameters(), lr=1e-2, weight_decay=0.1)
    for own, twin in zip(network.parameters(), other.parameters(), strict=True):
        own.grad = twin.grad = torch.randn(own.shape, generator=torch.Generator().manual_seed(own.numel())).double()
    ours.step(1.0)
    torchs.step()
    found, expected, before = (
        torch.cat([values.detach().flatten() for values in each.parameters()]) for each in (network, other, untouched)
    )
    torch.testing.assert_close(found, expected)
    assert (found != before).all()
