"""Batches read ahead: the same ones in the same order, whatever is asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_pixel_table import table_of

from edge_depth_nerf.plugin import upload
from edge_depth_nerf.plugin.datamanager import TablePixelSampler
from edge_depth_nerf.plugin.pixel_table import PixelTable, decode
from edge_depth_nerf.plugin.upload import Stretch, Uploads


@pytest.fixture
def tables(tmp_path) -> list[PixelTable]:
    masks = [[np.ones((7, 9), bool)], [np.ones((5, 5), bool), np.ones((4, 4), bool)]]
    return [table_of(tmp_path / f"{number}.npy", each) for number, each in enumerate(masks)]


def indices(packed: torch.Tensor) -> torch.Tensor:
    return decode(packed).indices


def test_batches_of_two_tables_come_in_one_piece_and_in_order(tables):
    samplers, others = ([TablePixelSampler(table, 10) for table in tables] for _ in range(2))
    for sampler, other in zip(samplers, others, strict=True):
        other._first = sampler._first
    uploads = Uploads("cpu")
    for step in (0, 1, 2, 3, 7, 8, 20):  # a training is taken up again, and the end of the table is passed
        found = indices(uploads.upload([sampler.draw(step) for sampler in samplers]))
        expected = [other.sample(step).indices for other in others]
        assert torch.equal(found, torch.cat(expected)), step


def test_the_next_batch_is_read_before_it_is_asked_for(tables, monkeypatch):
    reads = []

    def read(stretches):
        reads.append([each.start for each in stretches])
        return given(stretches)

    given = upload.read
    monkeypatch.setattr(upload, "read", read)
    uploads, sampler = Uploads("cpu"), TablePixelSampler(tables[0], 10)
    sampler._first = 0
    uploads.upload([sampler.draw()])
    uploads._reader.shutdown(wait=True)
    assert reads == [[0], [10]]
    uploads._reader = type(uploads._reader)(max_workers=1)
    uploads.upload([sampler.draw()])
    uploads._reader.shutdown(wait=True)
    assert reads == [[0], [10], [20]]
    # the exporter asks for other numbers of rays
    uploads._reader = type(uploads._reader)(max_workers=1)
    sampler.num_rays_per_batch = 5
    assert torch.equal(indices(uploads.upload([sampler.draw()])), tables[0].batch(20, 5).indices)
    uploads._reader.shutdown(wait=True)
    assert reads == [[0], [10], [20], [20], [25]]


def test_of_several_processes_each_reads_its_part_ahead(tables):
    found = []
    for rank in range(2):
        sampler, uploads = TablePixelSampler(tables[0], 10), Uploads("cpu")
        sampler._first, sampler._rank, sampler._world_size = 3, rank, 2
        found.append([indices(uploads.upload([sampler.draw(step)])) for step in range(2)])
        assert uploads._ahead is not None and uploads._ahead[0][0] == sampler.draw(2)
    every = torch.cat([found[rank][step] for step in range(2) for rank in range(2)])
    assert torch.equal(every, tables[0].batch(3, 40).indices)


def test_what_is_read_is_memory_of_its_own(tables):
    first = upload.read([Stretch(tables[0], 0, 4, 4), Stretch(tables[1], 39, 4, 4)])
    assert first.shape == (8, 15) and first.flags.owndata and first.flags.writeable
