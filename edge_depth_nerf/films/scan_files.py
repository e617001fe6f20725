"""Files of scans: .ply, .pcd and .bin, in binary form, little-endian."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int16
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray

from edge_depth_nerf.base.files import pcd_bytes, write_bytes
from edge_depth_nerf.lidar.ply import ply_bytes
from edge_depth_nerf.lidar.scans import ScanFormat, read_scan


@dataclass(frozen=True, eq=False)
class Scan:
    """A scan, point by point, in the order of time."""

    points_m: Float32[np.ndarray, "points 3"]
    """In the scanner's frame at each point's own time, as a scanner records them."""
    offset_s: Float32[np.ndarray, "points"]
    """When, counted from the scan's own time."""
    ring: Int16[np.ndarray, "points"]
    """From the highest, 0, to the lowest."""
    intensity: Float32[np.ndarray, "points"] | None = None
    """In the recording's unit; None: the scanner measures none."""


def _records(scan: Scan) -> NDArray:
    kinds = [*((axis, "<f4") for axis in "xyz"), ("time", "<f4"), ("ring", "<u2")]
    columns = [scan.points_m, scan.offset_s, scan.ring]
    if scan.intensity is not None:
        kinds, columns = [*kinds, ("intensity", "<f4")], [*columns, scan.intensity]
    return unstructured_to_structured(np.column_stack(columns), np.dtype(kinds))


def _bin(scan: Scan) -> bytes:
    intensity = np.zeros(len(scan.ring), np.float32) if scan.intensity is None else scan.intensity
    return np.column_stack((scan.points_m, intensity)).astype("<f4").tobytes()


_WRITERS: dict[str, Callable[[Scan], bytes]] = {
    "ply": lambda scan: ply_bytes(_records(scan)),
    "pcd": lambda scan: pcd_bytes(_records(scan)),
    "bin": _bin,
}


def write_scan(path: Path, scan: Scan) -> None:
    """Write a scan in the format of the file's suffix, atomically."""
    write_bytes(path, _WRITERS[path.suffix[1:]](scan))


def read_points(path: Path) -> Float[np.ndarray, "points 3"]:
    """Read the points of a scan that `write_scan` wrote; one of no points, which no drive has, is no error.

    Raises:
        InputError: the file is broken.
    """
    none = Scan(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int16))
    if path.read_bytes() == _WRITERS[path.suffix[1:]](none):
        return none.points_m
    return read_scan(path, ScanFormat()).points_m.numpy()
