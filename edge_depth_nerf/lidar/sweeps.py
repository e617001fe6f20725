"""Reading LiDAR sweeps in KITTI's layout: float32 x, y, z, reflectance, little-endian, one return after another.

Coordinates are metres in the scanner's frame (x forward, y left, z up), as recorded: the vehicle moves during a
turn, and nothing is corrected for that here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.errors import InputError

MIN_RANGE_M = 0.5
"""Nearer than this a scanner measures nothing: such a point stands for "no return", or lies on its housing."""
MAX_RANGE_M = 255.0
"""Beyond this a distance map cannot hold the value; no scanner on a car measures so far."""
_BYTES_PER_POINT = 16


@dataclass(frozen=True)
class Sweep:
    """The usable returns of one turn of the scanner."""

    points_m: Float[Tensor, "returns 3"]
    """Scanner frame, float64, in the file's order."""
    reflectance: Float[Tensor, "returns"]
    """0 to 1."""
    not_finite: int
    """How many returns were left out because a coordinate is NaN or infinite."""
    out_of_range: int
    """How many returns were left out because they lie nearer than 0.5 m (zeros among them) or beyond 255 m."""


def check_sweep_size(path: Path) -> None:
    """Check that the file holds whole returns, and any, without reading it.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is empty or truncated.

    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    size = path.stat().st_size
    if size == 0 or size % _BYTES_PER_POINT:
        raise InputError(
            f"{path}: {size} bytes, expected a multiple of {_BYTES_PER_POINT} above 0 (x, y, z, reflectance as "
            "float32): the file is truncated. Copy it again, or delete it so that its frame is skipped."
        )


def read_sweep(path: Path) -> Sweep:
    """Read a sweep and leave out what is no return.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is truncated, or nothing in it is a usable return.

    """
    check_sweep_size(path)
    values = torch.from_numpy(np.fromfile(path, "<f4").reshape(-1, 4).astype(np.float64))
    finite = torch.isfinite(values[:, :3]).all(-1)
    range_m = values[:, :3].norm(dim=-1)
    # NaN compares as false
    usable = finite & (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
    if not usable.any():
        raise InputError(
            f"{path}: none of its {len(values)} points can be used ({int((~finite).sum())} are NaN or infinite, the "
            f"others lie nearer than {MIN_RANGE_M} m or beyond {MAX_RANGE_M:.0f} m). Copy the file again, or delete "
            "it so that its frame is skipped."
        )
    return Sweep(
        points_m=values[usable, :3],
        reflectance=values[usable, 3],
        not_finite=int((~finite).sum()),
        out_of_range=int((finite & ~usable).sum()),
    )
