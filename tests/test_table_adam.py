"""Adam for tables whose gradients are summed up level by level, against torch's Adam."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding

from edge_depth_nerf.kernels.table_adam import PARTS, SUMS_LATER, TableAdam, TablePart
from edge_depth_nerf.plugin.fused.hash_grid import FusedHashEncoding, sum_tables_later

SETTINGS: dict[str, Any] = {"lr": 1e-2, "eps": 1e-15}


def grid() -> HashEncoding:
    torch.manual_seed(0)
    encoding = FusedHashEncoding(num_levels=4, max_res=64, log2_hashmap_size=8, implementation="torch")
    sum_tables_later(encoding)
    return encoding


def pair(**options: Any) -> tuple[HashEncoding, HashEncoding, TableAdam, torch.optim.Adam]:
    """Two encodings with one table, an optimiser of ours for the one and torch's for the other."""
    ours, others, options = grid(), grid(), {**SETTINGS, **options}
    return ours, others, TableAdam(ours.parameters(), **options), torch.optim.Adam(others.parameters(), **options)


def assert_near(found: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-7)


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
        ours, others, adam, of_torch = pair(betas=betas)
        found, expected = train(ours, adam, range(12)), train(others, of_torch, range(12))
    finally:
        torch.set_num_threads(before)
    assert not torch.equal(expected[-1], expected[0])
    for each, other in zip(found, expected, strict=True):
        assert_near(each, other)


def whole_gradient(encoding: HashEncoding) -> torch.Tensor:
    """What the table's gradient is made of, summed up."""
    from edge_depth_nerf.kernels.hash_grid_numba import table_gradient

    parts: list[TablePart] = getattr(encoding.hash_table, PARTS)
    return torch.stack([table_gradient(*part, len(encoding.hash_table)) for part in parts]).sum(dim=0)


def test_no_gradient_of_the_tables_size_is_made():
    encoding, _, optimizer, _ = pair()
    train(encoding, optimizer, range(1))
    optimizer.zero_grad()
    loss(encoding, 1).backward()
    assert encoding.hash_table.grad is None and len(getattr(encoding.hash_table, PARTS)) == 2
    before = encoding.hash_table.detach().clone()
    optimizer.step()
    assert encoding.hash_table.grad is None and not getattr(encoding.hash_table, PARTS)
    assert not torch.equal(encoding.hash_table, before)


def test_gradients_of_several_passes_add_up():
    ours, others, optimizer, _ = pair()
    train(ours, optimizer, range(1))
    others.load_state_dict(ours.state_dict())
    optimizer.zero_grad()
    for step in (1, 2):
        loss(ours, step).backward()
        loss(others, step).backward()
    assert others.hash_table.grad is not None
    torch.testing.assert_close(whole_gradient(ours), others.hash_table.grad)
    # what no step has used is dropped when that is asked for, and without a gradient there is no step
    table = ours.hash_table.detach().clone()
    optimizer.zero_grad()
    optimizer.step()
    assert torch.equal(ours.hash_table, table) and float(optimizer.state[ours.hash_table]["step"]) == 1


def test_a_whole_gradient_beside_parts_is_not_lost():
    """As where one pass of a step is nerfstudio's own."""
    ours, others, optimizer, of_torch = pair()
    train(ours, optimizer, range(1))
    train(others, of_torch, range(1))
    for encoding, adam in ((ours, optimizer), (others, of_torch)):
        adam.zero_grad()
        loss(encoding, 1).backward()
        more = torch.full_like(encoding.hash_table, 1e-3)
        encoding.hash_table.grad = more if encoding.hash_table.grad is None else encoding.hash_table.grad + more
        adam.step()
    assert_near(ours.hash_table, others.hash_table)


@pytest.mark.parametrize("alike", [True, False])
def test_each_optimiser_of_a_table_sums_alike(alike, monkeypatch):
    """The first step of a second training with the same parameters is that of the first, to the last bit."""
    from edge_depth_nerf.kernels import hash_grid_numba

    # threads share the points of a level where a whole gradient is made: other orders of sums
    monkeypatch.setattr(hash_grid_numba, "LEAST_SHARE", 8)
    monkeypatch.setattr(hash_grid_numba, "kernel_threads", lambda: 3)
    encoding = grid()
    start, found = deepcopy(encoding.state_dict()), []
    for training in range(2):
        encoding.load_state_dict(start)
        optimizer = TableAdam(encoding.parameters(), **SETTINGS)
        if not alike and training == 0:
            setattr(encoding.hash_table, SUMS_LATER, False)  # as if the first step had to find out
        found.append(train(encoding, optimizer, range(3)))
    assert all(torch.equal(*each) for each in zip(*found, strict=True)) is alike


def test_gradients_that_are_clipped_are_whole():
    from edge_depth_nerf.plugin.config import FusedAdamConfig

    for max_norm, is_whole in ((1.0, True), (None, False)):
        encoding = grid()
        optimizer = FusedAdamConfig(lr=1e-2, eps=1e-15, max_norm=max_norm).setup(list(encoding.parameters()))
        for step in range(2):
            optimizer.zero_grad()
            loss(encoding, step).backward()
            assert (encoding.hash_table.grad is not None) is is_whole
            optimizer.step()


def test_checkpoints_go_back_and_forth():
    ours, others, optimizer, of_torch = pair()
    train(ours, optimizer, range(3))
    others.load_state_dict(ours.state_dict())
    of_torch.load_state_dict(deepcopy(optimizer.state_dict()))
    expected = train(others, of_torch, range(3, 6))[-1]
    assert_near(train(ours, optimizer, range(3, 6))[-1], expected)
    again = grid()
    again.load_state_dict(others.state_dict())
    back = TableAdam(again.parameters(), **SETTINGS)
    back.load_state_dict(deepcopy(of_torch.state_dict()))
    expected = train(others, of_torch, range(6, 8))[-1]
    assert_near(train(again, back, range(6, 8))[-1], expected)


@pytest.mark.parametrize("options", [{"weight_decay": 0.1}, {"amsgrad": True}, {"maximize": True}], ids=str)
def test_other_forms_of_adam_are_torchs(options):
    ours, others, optimizer, of_torch = pair(**options)
    assert torch.equal(train(ours, optimizer, range(3))[-1], train(others, of_torch, range(3))[-1])
    assert getattr(ours.hash_table, SUMS_LATER) is False


def test_with_several_processes_gradients_go_through_torch(monkeypatch):
    monkeypatch.setattr(torch.distributed, "is_initialized", lambda: True)
    encoding = grid()
    train(encoding, TableAdam(encoding.parameters(), **SETTINGS), range(2))
    assert getattr(encoding.hash_table, SUMS_LATER) is False


def test_a_table_without_gradient_is_left_alone():
    encoding = grid()
    optimizer = TableAdam(encoding.parameters(), **SETTINGS)
    (table,) = train(encoding, optimizer, range(1))
    optimizer.zero_grad()
    optimizer.step()
    assert torch.equal(encoding.hash_table, table)
    assert float(optimizer.state[encoding.hash_table]["step"]) == 1
