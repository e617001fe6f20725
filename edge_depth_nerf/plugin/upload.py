"""Batches on a device: from a table that lies on the GPU, or read ahead, for a GPU into pinned memory.

Host-facing. Nothing waits for a batch. Its records are 15 bytes a pixel; they are unpacked on the device.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from edge_depth_nerf.plugin.pixel_table import RECORD, PixelTable

SHARE_OF_MEMORY = 0.25
"""A table lies on a GPU if it takes at most this share of the memory that is free there."""


@dataclass(frozen=True)
class Stretch:
    """Neighbouring records of a table."""

    start: int
    count: int
    to_next: int
    """From their start to that of the stretch which is read after them."""


class TableOnDevice:
    """Batches of a table that lies on the device."""

    def __init__(self, table: PixelTable, device: torch.device | str) -> None:
        """Copy all of the table."""
        self._records = table.packed(0, len(table)).to(device)
        self._form: tuple[list[int], list[int]] = [], []
        self._next: list[int] = []
        self._starts = self._steps = self._of = self._places = torch.empty(0, dtype=torch.long)

    def set_next(self, stretches: Sequence[Stretch]) -> None:
        """Say of which records the next batch consists; nothing is launched if they follow those of the last one."""
        device, starts = self._records.device, [each.start for each in stretches]
        counts, steps = ([getattr(each, name) for each in stretches] for name in ("count", "to_next"))
        if (counts, steps) != self._form:
            self._form = counts, steps
            self._starts, self._steps = (torch.tensor(each, device=device) for each in (starts, steps))
            self._of = torch.from_numpy(np.repeat(np.arange(len(counts)), counts)).to(device)
            self._places = torch.cat([torch.arange(count) for count in counts]).to(device)
        elif starts != self._next:
            for place, start in zip(self._starts, starts, strict=True):
                place.fill_(start)
        self._next = [start + step for start, step in zip(starts, steps, strict=True)]

    def packed(self) -> UInt8[Tensor, "n 15"]:
        """Give the bytes of the next batch, one stretch after the other, and go on to the one after it.

        It does nothing on the host, so that it can be recorded: then each replay gives the batch that is next.
        """
        rows = (self._starts[self._of] + self._places) % len(self._records)
        self._starts += self._steps
        return self._records[rows]


class Uploads:
    """Batches of a table in a file, the next one already read.

    What is read ahead is what follows in the table; where something else is requested (another number of rays, a
    resumed training), that is read instead. So batches are the same with a thread as without one.
    """

    def __init__(self, table: PixelTable, device: torch.device | str) -> None:
        self._table, self._device = table, torch.device(device)
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reads batches")
        self._ahead: tuple[list[Stretch], Future[None]] | None = None
        self._batch = torch.empty(0, RECORD.itemsize, dtype=torch.uint8)
        self._buffers: list[Tensor] = []
        self._copied: list[torch.cuda.Event | None] = []

    def set_next(self, stretches: Sequence[Stretch]) -> None:
        """Start to copy the next batch to the device, and to read the one after it."""
        expected, read = self._ahead or ([], None)
        if read is not None:
            read.result()
        count = sum(each.count for each in stretches)
        if len(self._batch) != count:
            on_gpu = self._device.type == "cuda"
            self._batch = self._batch.new_empty(count, RECORD.itemsize, device=self._device)
            self._buffers = [torch.empty(count, RECORD.itemsize, dtype=torch.uint8, pin_memory=on_gpu) for _ in "12"]
            self._copied = [None, None]
        if expected != list(stretches):
            self._read(stretches)
        self._batch.copy_(self._buffers[0], non_blocking=True)
        if self._device.type == "cuda":
            self._copied[0] = torch.cuda.Event()
            # the present device may be another one
            self._copied[0].record(torch.cuda.current_stream(self._device))
        # they take turns: the first one is read next
        self._buffers.reverse()
        self._copied.reverse()
        following = [replace(each, start=each.start + each.to_next) for each in stretches]
        self._ahead = following, self._reader.submit(self._read, following)

    def packed(self) -> UInt8[Tensor, "n 15"]:
        """Give the bytes of the next batch, once after each `set_next`."""
        return self._batch

    def _read(self, stretches: Sequence[Stretch]) -> None:
        """Read stretches into the first buffer, once its last content is on the device."""
        if (copied := self._copied[0]) is not None:
            copied.synchronize()
        for place, each in zip(self._buffers[0].split([each.count for each in stretches]), stretches, strict=True):
            self._table.read_into(place, each.start)


def batches_on(device: torch.device | str, table: PixelTable) -> TableOnDevice | Uploads:
    """Give what serves a table's batches on a device."""
    if torch.device(device).type == "cuda":
        free, _ = torch.cuda.mem_get_info(torch.device(device))
        if len(table) * RECORD.itemsize <= SHARE_OF_MEMORY * free:
            return TableOnDevice(table, device)
    return Uploads(table, device)
