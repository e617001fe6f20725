"""Batches on their way to a GPU: read ahead, packed, from pinned memory, so that neither host nor device waits.

Host-facing. The records of a batch are 15 bytes a pixel; they are copied unchanged from the file and unpacked on the
device. While a step is computed, a thread reads those of the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import UInt8
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.plugin.pixel_table import RECORD, PixelTable


@dataclass(frozen=True)
class Stretch:
    """Neighbouring records of a table."""

    table: PixelTable
    start: int
    count: int
    to_next: int
    """From their start to that of the stretch which is read after them."""


def read(stretches: Sequence[Stretch]) -> UInt8[np.ndarray, "n 15"]:
    """Copy the bytes of stretches, one after the other."""
    records = [np.asarray(each.table.records(each.start, each.count)) for each in stretches]
    return np.concatenate([each.view(np.uint8).reshape(-1, RECORD.itemsize) for each in records])


class Uploads:
    """Copies batches to a device, the next already read.

    What is read ahead is what follows in the tables; where something else is requested (another number of rays, a
    resumed training), that is read instead. So batches are the same with a thread as without one.
    """

    def __init__(self, device: torch.device | str) -> None:
        self._device = torch.device(device)
        self._reader = ThreadPoolExecutor(max_workers=1, thread_name_prefix="reads batches")
        self._ahead: tuple[list[Stretch], Future[NDArray[np.uint8]]] | None = None

    def upload(self, stretches: Sequence[Stretch]) -> UInt8[Tensor, "n 15"]:
        """Start to copy the bytes of some records to the device."""
        records = self._read(stretches)
        following = [replace(each, start=each.start + each.to_next) for each in stretches]
        self._ahead = following, self._reader.submit(read, following)
        packed = torch.from_numpy(records)
        if self._device.type == "cuda":
            packed = packed.pin_memory()
        return packed.to(self._device, non_blocking=True)

    def _read(self, stretches: Sequence[Stretch]) -> NDArray[np.uint8]:
        if self._ahead is not None:
            expected, records = self._ahead
            if expected == list(stretches):
                return records.result()
        return read(stretches)
