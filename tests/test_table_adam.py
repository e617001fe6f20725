"""Adam for tables whose gradients are added in place, against torch's Adam."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding

from edge_depth_nerf.kernels.fused_hash_grid import use_fused_encodings
from edge_depth_nerf.kernels.table_adam import CLEARED, IN_PLACE, TableAdam

SETTINGS: dict[str, Any] = {"lr": 1e-2, "eps": 1e-15}


def grid() -> HashEncoding:
    torch.manual_seed(0)
    encoding = HashEncoding(num_levels=4, max_res=64, log2_hashmap_size=8, implementation="torch")
    use_fused_encodings(encoding)
    return encoding


def loss(encoding: HashEncoding, step: int) -> torch.Tensor:
    """Of two calls, as proposals and samples make them; not all rows are met in a step."""
    points = torch.rand(2, 30, 3, generator=torch.Generator().manual_seed(step))
    return (encoding(points[0]) - 0.1).square().sum() + encoding(points[1]).sum() * 1e-3


def train(encoding: HashEncoding, optimizer: torch.optim.Optimizer, steps: range) -> list[torch.Tensor]:
    tables = []
    for step in steps:
        optimizer.zero_grad()
        loss(encoding, step).backward()
        optimizer.step()
        tables.append(encoding.hash_table.detach().clone())
    return tables


@pytest.mark.parametrize(("threads", "betas"), [(1, (0.9, 0.999)), (2, (0.9, 0.999)), (1, (0.8, 0.99))])
def test_its_steps_are_torchs(threads, betas, monkeypatch):
    from edge_depth_nerf.kernels import table_adam_numba

    monkeypatch.setattr(table_adam_numba, "LEAST_SHARE", 64)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        ours, others = grid(), grid()
        found = train(ours, TableAdam(ours.parameters(), **SETTINGS, betas=betas), range(12))
        expected = train(others, torch.optim.Adam(others.parameters(), **SETTINGS, betas=betas), range(12))
    finally:
        torch.set_num_threads(before)
    assert not torch.equal(expected[-1], expected[0])
    for each, other in zip(found, expected, strict=True):
        torch.testing.assert_close(each, other, rtol=1e-5, atol=1e-7)


def test_the_gradient_stays_where_it_is_and_is_cleared():
    encoding = grid()
    optimizer = TableAdam(encoding.parameters(), **SETTINGS)
    train(encoding, optimizer, range(1))
    gradient = encoding.hash_table.grad
    assert gradient is not None and not bool(gradient.any())
    optimizer.zero_grad()
    assert encoding.hash_table.grad is gradient
    loss(encoding, 1).backward()
    assert encoding.hash_table.grad is gradient and bool(gradient.any())
    optimizer.step()
    assert not bool(gradient.any())


def test_gradients_of_several_passes_add_up():
    ours, others = grid(), grid()
    optimizer = TableAdam(ours.parameters(), **SETTINGS)
    train(ours, optimizer, range(1))
    others.load_state_dict(ours.state_dict())
    for step in (1, 2):
        loss(ours, step).backward()
        loss(others, step).backward()
    assert ours.hash_table.grad is not None and others.hash_table.grad is not None
    torch.testing.assert_close(ours.hash_table.grad, others.hash_table.grad)
    # what no step has read is cleared when that is asked for
    optimizer.zero_grad()
    assert ours.hash_table.grad is None or not bool(ours.hash_table.grad.any())


def test_a_table_without_gradient_is_left_alone():
    encoding = grid()
    optimizer = TableAdam(encoding.parameters(), **SETTINGS)
    (table,) = train(encoding, optimizer, range(1))
    optimizer.zero_grad()
    optimizer.step()
    assert torch.equal(encoding.hash_table, table)
    assert float(optimizer.state[encoding.hash_table]["step"]) == 1


def test_checkpoints_go_back_and_forth():
    ours, others = grid(), grid()
    optimizer, of_torch = TableAdam(ours.parameters(), **SETTINGS), torch.optim.Adam(others.parameters(), **SETTINGS)
    train(ours, optimizer, range(3))
    others.load_state_dict(ours.state_dict())
    of_torch.load_state_dict(deepcopy(optimizer.state_dict()))
    expected = train(others, of_torch, range(3, 6))[-1]
    torch.testing.assert_close(train(ours, optimizer, range(3, 6))[-1], expected, rtol=1e-5, atol=1e-7)
    again = grid()
    again.load_state_dict(others.state_dict())
    back = TableAdam(again.parameters(), **SETTINGS)
    back.load_state_dict(deepcopy(of_torch.state_dict()))
    expected = train(others, of_torch, range(6, 8))[-1]
    torch.testing.assert_close(train(again, back, range(6, 8))[-1], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("options", [{"weight_decay": 0.1}, {"amsgrad": True}, {"maximize": True}], ids=str)
def test_other_forms_of_adam_are_torchs(options):
    ours, others = grid(), grid()
    found = train(ours, TableAdam(ours.parameters(), **SETTINGS, **options), range(3))[-1]
    expected = train(others, torch.optim.Adam(others.parameters(), **SETTINGS, **options), range(3))[-1]
    assert torch.equal(found, expected)
    assert getattr(ours.hash_table, IN_PLACE) is False and not getattr(ours.hash_table, CLEARED, False)


def test_with_several_processes_gradients_go_through_torch(monkeypatch):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    encoding = grid()
    train(encoding, TableAdam(encoding.parameters(), **SETTINGS), range(2))
    assert getattr(encoding.hash_table, IN_PLACE) is False
