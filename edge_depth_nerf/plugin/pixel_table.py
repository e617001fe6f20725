"""The training pixels that count, on disk in a random order.

Pure. Each valid pixel is a record of 15 bytes: colour as uint8, prior distance and sigma as uint16 in 1/256 m (0 = no
prior; the sky has no distance and the largest sigma), and where the pixel is. A prior that 16 bits cannot hold, beyond
255.996 m or below 2 mm, is none; a sigma beyond is kept as 255.996 m. As the order is random, a batch is one
contiguous read of a memory-mapped file, which needs next to no memory of the process's own. All pixels are passed
before one comes again. Behind the records, a line of JSON counts the pixels with a prior, and those at which each of
its sources has a distance.

The order is made in two passes: each pixel goes to one of several files, drawn at random; then each file, small enough
for memory, is shuffled and appended to the whole. That is a uniformly random permutation.
"""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.checked_cache import is_whole, write_checked
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import DISTANCE_STEPS_PER_METRE

TABLE_VERSION = 6
"""Raised whenever the form of the file changes."""
BUCKET_BYTES = 64 << 20
"""So much is shuffled in memory at once, as long as `MOST_BUCKETS` are enough."""
MOST_BUCKETS = 128
"""Open at a time; a process may have 256 files or more."""
RECORD = np.dtype(
    [("rgb", "u1", 3), ("distance", "<u2"), ("sigma", "<u2"), ("picture", "<u4"), ("row", "<u2"), ("column", "<u2")]
)
"""One pixel, packed."""
SKY = 65535
"""The sigma, in steps, of a pixel that shows the sky; its distance is 0."""
LARGEST_SIDE_PX = 1 << 16
"""Rows and columns are kept in 16 bits."""


def to_steps(distance_m: NDArray) -> NDArray[np.uint16]:
    """Turn metres into counts of 1/256 m; what is not positive or beyond 16 bits becomes 0 (none)."""
    steps = np.rint(np.nan_to_num(distance_m, nan=0.0, posinf=0.0, neginf=0.0) * DISTANCE_STEPS_PER_METRE)
    return np.where((steps > 0) & (steps <= 65535), steps, 0).astype(np.uint16)


def _sigma_steps(sigma_m: NDArray) -> NDArray[np.uint16]:
    """Do as `to_steps`, but what is too small or too large for 16 bits stays a standard deviation."""
    usable = np.isfinite(sigma_m) & (sigma_m > 0)
    steps = np.clip(np.rint(np.where(usable, sigma_m, 0) * DISTANCE_STEPS_PER_METRE), 1, 65535)
    return np.where(usable, steps, 0).astype(np.uint16)


@dataclass
class PixelBatch:
    """A batch of n training pixels."""

    indices: Int[Tensor, "n 3"]
    """Picture, row, column."""
    rgb: Float[Tensor, "n 3"]
    """Colour in 0..1."""
    prior_distance_m: Float[Tensor, "n 1"]
    """Prior of the distance along the ray, metres, 0 = none."""
    prior_sigma_m: Float[Tensor, "n 1"]
    """Its standard deviation, metres; 0 without a prior."""
    sky: Bool[Tensor, "n 1"]
    """Whether the pixel is known to show the sky."""

    def __getitem__(self, chosen: slice) -> PixelBatch:
        """Choose some neighbouring pixels."""
        return PixelBatch(**{entry.name: getattr(self, entry.name)[chosen] for entry in fields(self)})

    def where(self, chosen: Bool[Tensor, "n"]) -> PixelBatch:
        """Choose some of the pixels."""
        rows = chosen.nonzero()[:, 0]  # rows by their numbers take a quarter of the time
        return PixelBatch(**{entry.name: getattr(self, entry.name).index_select(0, rows) for entry in fields(self)})


def decode(packed: UInt8[Tensor, "n 15"]) -> PixelBatch:
    """Unpack the bytes of records where they are; a GPU then gets 15 bytes a pixel and not 53."""
    # distance, sigma, low and high half of the picture's number, row, column
    words = packed[:, 3:].contiguous().view(torch.int16).int() & 0xFFFF
    # only without a distance is the difference so large
    sky = words[:, 1:2] - words[:, :1] == SKY
    picture = words[:, 2:3].add(words[:, 3:4], alpha=1 << 16)
    distance_m, sigma_m = (words[:, :2] / DISTANCE_STEPS_PER_METRE).split(1, dim=1)
    return PixelBatch(
        indices=torch.cat([picture, words[:, 4:]], dim=1).long(),
        rgb=packed[:, :3] / 255,
        prior_distance_m=distance_m,
        prior_sigma_m=sigma_m.masked_fill(sky, 0),
        sky=sky,
    )


class PixelTable:
    """All valid pixels of some pictures, in a random order, memory-mapped."""

    def __init__(self, path: Path):
        """Open a table that `write_table` wrote; all of it is read once, to check that it is unchanged.

        Raises:
            InputError, OSError: it is not there, of another version, or not whole.
        """
        if not is_whole(path, TABLE_VERSION):
            raise InputError(f"{path}: missing, changed, or of another version")
        records: np.memmap = np.load(path, mmap_mode="r", allow_pickle=False)
        # fields would be copied one by one
        self._records = np.asarray(records).view(np.uint8).reshape(-1, RECORD.itemsize)
        with path.open("rb") as file:
            file.seek(records.offset + records.nbytes)
            self._with: dict[str, int] = json.loads(file.readline())

    def __len__(self) -> int:
        """Count the records: the valid pixels."""
        return len(self._records)

    @property
    def share_with_prior(self) -> float:
        """Give the share of the records that have a prior."""
        return self._with["prior"] / len(self)

    @property
    def shares_of_sources(self) -> dict[str, float]:
        """Give the share of the records at which each source has a distance."""
        return {name: count / len(self) for name, count in self._with.items() if name != "prior"}

    def records(self, start: int, count: int) -> UInt8[np.ndarray, "n 15"]:
        """Give the bytes of `count` records from number `start` on; the first comes after the last."""
        first = start % len(self)
        records = self._records[first : first + count]
        if len(records) < count:
            records = self._records[np.arange(first, first + count) % len(self)]
        return records

    def packed(self, start: int, count: int) -> UInt8[Tensor, "n 15"]:
        """Give the bytes of `count` records from number `start` on, for `decode`; memory of its own."""
        return torch.from_numpy(np.array(self.records(start, count)))

    def read_into(self, place: UInt8[Tensor, "n 15"], start: int) -> None:
        """Read as many records as there is place for, from number `start` on."""
        place.numpy()[:] = self.records(start, len(place))

    def batch(self, start: int, count: int) -> PixelBatch:
        """Read `count` pixels from number `start` on; after the last one comes the first again."""
        return decode(self.packed(start, count))


@dataclass(frozen=True, eq=False)
class PicturePixels:
    """What a table takes of a picture; all maps H×W."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: Bool[np.ndarray, "h w"]
    """True where a pixel may be used."""
    prior_distance_m: Float[np.ndarray, "h w"] | None = None
    """Metres, 0 = none; None: no prior anywhere."""
    prior_sigma_m: Float[np.ndarray, "h w"] | None = None
    sky: Bool[np.ndarray, "h w"] | None = None
    """Where it is known to show the sky; None: nowhere."""
    sources: Mapping[str, Bool[np.ndarray, "h w"]] = field(default_factory=dict)
    """Where each source of the prior has a distance."""


def write_table(path: Path, most_pixels: int, pictures: Iterable[PicturePixels]) -> None:
    """Write a table of pictures.

    Args:
        path: the file to be, .npy; its folder is made.
        most_pixels: an upper bound of the pixels.
        pictures: read one after the other.

    Raises:
        InputError: no valid pixel in any picture.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rng, number, pixels = np.random.default_rng(0), 0, 0
    having: Counter[str] = Counter()
    with ExitStack() as stack:
        buckets: list[IO[bytes]] = [
            stack.enter_context(tempfile.TemporaryFile(dir=path.parent, prefix=".pixels."))
            for _ in range(min(MOST_BUCKETS, max(1, -(-most_pixels * RECORD.itemsize // BUCKET_BYTES))))
        ]
        for number, picture in enumerate(pictures, 1):
            records = _records(picture, number - 1)
            pixels += len(records)
            having["prior"] += int((records["distance"] > 0).sum())
            having.update({name: int((has & picture.mask).sum()) for name, has in picture.sources.items()})
            bucket = rng.integers(len(buckets), size=len(records))
            ordered = records[np.argsort(bucket, kind="stable")]
            ends = np.cumsum(np.bincount(bucket, minlength=len(buckets)))
            for file, part in zip(buckets, np.split(ordered, ends[:-1]), strict=True):
                file.write(part.tobytes())
        if not pixels:
            raise InputError(
                f"None of the {number} pictures has a valid pixel: the masks exclude everything. "
                "Masks are 255 where a pixel may be used; check that they are not inverted."
            )

        def write(out: Any) -> None:
            header = {"descr": np.lib.format.dtype_to_descr(RECORD), "fortran_order": False}
            np.lib.format.write_array_header_1_0(out, {**header, "shape": (pixels,)})
            for file in buckets:
                file.seek(0)
                records = np.frombuffer(file.read(), RECORD)
                out.write(records[rng.permutation(len(records))].tobytes())
                file.seek(0)
                file.truncate()
            out.write(f"{json.dumps(having)}\n".encode())

        write_checked(path, TABLE_VERSION, write)


def _records(picture: PicturePixels, number: int) -> NDArray:
    """Pack a picture's valid pixels."""
    assert max(picture.mask.shape) < LARGEST_SIDE_PX
    rows, columns = np.nonzero(picture.mask)
    records = np.zeros(len(rows), RECORD)
    records["rgb"] = picture.rgb[rows, columns]
    records["row"], records["column"], records["picture"] = rows, columns, number
    if picture.prior_distance_m is not None and picture.prior_sigma_m is not None:
        records["distance"] = to_steps(picture.prior_distance_m[rows, columns])
        # without a distance a large sigma would say "sky"
        sigma = _sigma_steps(picture.prior_sigma_m[rows, columns])
        records["sigma"] = np.where(records["distance"] > 0, sigma, 0)  # pyrefly: ignore[unsupported-operation]
    if picture.sky is not None:
        records["sigma"][picture.sky[rows, columns] & (records["distance"] == 0)] = SKY
    return records
