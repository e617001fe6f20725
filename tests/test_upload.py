"""Batches of a GPU: the same ones in the same order, from a table there or read ahead, whatever is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from test_pixel_table import table_of

from edge_depth_nerf.plugin.datamanager import TablePixelSampler
from edge_depth_nerf.plugin.pixel_table import RECORD, PixelTable, decode
from edge_depth_nerf.plugin.upload import SHARE_OF_MEMORY, TableOnDevice, Uploads, batches_on


@pytest.fixture
def table(tmp_path) -> PixelTable:
    return table_of(tmp_path / "table.npy", [np.ones((7, 9), bool), np.ones((5, 5), bool)])


def next_indices(batches: TableOnDevice | Uploads, samplers: list[TablePixelSampler], step: int = 0) -> torch.Tensor:
    batches.set_next([sampler.draw(step) for sampler in samplers])
    return decode(batches.packed()).indices


def indices_of(samplers: list[TablePixelSampler], step: int = 0) -> torch.Tensor:
    """The same, read one after the other."""
    stretches = [(sampler.table, sampler.draw(step)) for sampler in samplers]
    return torch.cat([table.batch(each.start, each.count).indices for table, each in stretches])


@pytest.mark.parametrize("kind", [TableOnDevice, Uploads])
def test_batches_of_two_samplers_come_in_one_piece_and_in_order(table, kind):
    samplers, others = ([TablePixelSampler(table, count) for count in (10, 24)] for _ in range(2))
    for sampler, other in zip(samplers, others, strict=True):
        other._first = sampler._first
    batches = kind(table, "cpu")
    for step in (0, 1, 2, 3, 7, 8, 20):  # a training is taken up again, and the end of the table is passed
        found = next_indices(batches, samplers, step)
        assert torch.equal(found, indices_of(others, step)), step
    # the exporter asks for other numbers of rays
    for each in (samplers[0], others[0]):
        each.num_rays_per_batch = 5
    for _ in range(2):
        assert torch.equal(next_indices(batches, samplers), indices_of(others))


@pytest.mark.parametrize("kind", [TableOnDevice, Uploads])
def test_of_several_processes_each_gets_its_part(table, kind):
    found = []
    for rank in range(2):
        sampler, batches = TablePixelSampler(table, 10), kind(table, "cpu")
        sampler._first, sampler._rank, sampler._world_size = 3, rank, 2
        found.append([next_indices(batches, [sampler], step) for step in range(2)])
    every = torch.cat([found[rank][step] for step in range(2) for rank in range(2)])
    assert torch.equal(every, table.batch(3, 40).indices)


def test_a_table_on_the_device_goes_on_by_itself(table):
    """A recorded step takes the batch after the last one without a word of the host."""
    batches, sampler = TableOnDevice(table, "cpu"), TablePixelSampler(table, 10)
    sampler._first = 0
    batches.set_next([sampler.draw()])
    found = [decode(batches.packed()).indices for _ in range(3)]
    assert torch.equal(torch.cat(found), table.batch(0, 30).indices)


def test_the_next_batch_is_read_before_it_is_asked_for(table, monkeypatch):
    reads: list[int] = []
    given = table.records

    def records(start: int, count: int) -> Any:
        reads.append(start)
        return given(start, count)

    monkeypatch.setattr(table, "records", records)
    uploads, sampler = Uploads(table, "cpu"), TablePixelSampler(table, 10)
    sampler._first = 0
    for step, expected in enumerate(([0, 10], [0, 10, 20])):
        next_indices(uploads, [sampler], step)
        assert uploads._ahead is not None
        uploads._ahead[1].result()
        assert reads == expected
    # what was read ahead is not what is asked for
    assert torch.equal(next_indices(uploads, [sampler], 7), table.batch(70, 10).indices)


def test_a_table_lies_on_a_gpu_if_it_takes_a_quarter_of_its_free_memory(table, monkeypatch):
    size = len(table) * RECORD.itemsize
    monkeypatch.setattr(TableOnDevice, "__init__", lambda self, table, device: None)
    for free, expected in ((size / SHARE_OF_MEMORY, TableOnDevice), (size / SHARE_OF_MEMORY - 1, Uploads)):
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _, free=free: (free, 2 * free))
        assert type(batches_on("cuda:0", table)) is expected
