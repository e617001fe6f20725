"""The form colmap: a sparse model in COLMAP's binary format, written without COLMAP.

https://colmap.github.io/format.html describes the files. All numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import write_bytes, write_text
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.export.cloud import Cloud, rgb_of
from edge_depth_nerf.export.cuts import Lens
from edge_depth_nerf.export.pictures import ExportedView, Seen

MODEL = "sparse/0"
_PINHOLE, _OPENCV, _OPENCV_FISHEYE = 1, 4, 5
"""COLMAP's numbers of camera models."""
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "<u8"), ("place", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("sights", "<u8")])
_SIGHT = np.dtype([("image", "<i4"), ("observation", "<i4")])


def colmap_camera(lens: Lens) -> tuple[int, tuple[float, ...]]:
    """Give COLMAP's number of a lens's model, and its parameters."""
    middle = (lens.fx, lens.fy, lens.cx, lens.cy)
    if isinstance(lens, KannalaBrandt):
        return _OPENCV_FISHEYE, (*middle, lens.k1, lens.k2, lens.k3, lens.k4)
    if lens.k1 or lens.k2 or lens.p1 or lens.p2:
        return _OPENCV, (*middle, lens.k1, lens.k2, lens.p1, lens.p2)
    return _PINHOLE, middle


def write_model(output: Path, views: Sequence[ExportedView], seen: Sequence[Seen], cloud: Cloud) -> None:
    """Write the model, and a list of the held-out pictures; images.bin, the last file, makes the folder complete."""
    folder = output / MODEL
    lenses = list(dict.fromkeys((view.camera, view.cut.lens) for view in views))
    write_bytes(folder / "cameras.bin", _cameras([lens for _, lens in lenses]))
    write_bytes(folder / "points3D.bin", _points(cloud, seen))
    held_out = [view.file_name for view in views if view.picture.held_out]
    if held_out:
        write_text(folder / "test.txt", "\n".join(held_out) + "\n")
    camera_of = {each: number for number, each in enumerate(lenses, start=1)}
    numbers = [camera_of[view.camera, view.cut.lens] for view in views]
    write_bytes(folder / "images.bin", _images(views, numbers, seen))


def _cameras(lenses: Sequence[Lens]) -> bytes:
    parts = [struct.pack("<Q", len(lenses))]
    for number, lens in enumerate(lenses, start=1):
        model, parameters = colmap_camera(lens)
        parts.append(struct.pack("<iiQQ", number, model, lens.width, lens.height))
        parts.append(struct.pack(f"<{len(parameters)}d", *parameters))
    return b"".join(parts)


def _images(views: Sequence[ExportedView], cameras: Sequence[int], seen: Sequence[Seen]) -> bytes:
    parts = [struct.pack("<Q", len(views))]
    for number, (view, camera, sights) in enumerate(zip(views, cameras, seen, strict=True), start=1):
        scene_to_view = np.linalg.inv(view.view_to_scene)
        x, y, z, w = Rotation.from_matrix(scene_to_view[:3, :3]).as_quat()
        parts.append(struct.pack("<i7di", number, w, x, y, z, *scene_to_view[:3, 3], camera))
        rows = np.empty(len(sights.index), _OBSERVATION)
        rows["pixel"], rows["point"] = sights.pixels, sights.index + 1
        parts += [view.file_name.encode() + b"\0", struct.pack("<Q", len(rows)), rows.tobytes()]
    return b"".join(parts)


def _points(cloud: Cloud, seen: Sequence[Seen]) -> bytes:
    """Encode points with their tracks: which observation of which image shows each."""
    count = len(cloud.points_m)
    rows = np.zeros(count, _POINT)
    rows["id"], rows["place"], rows["rgb"] = np.arange(1, count + 1), cloud.points_m, rgb_of(cloud)
    point = np.concatenate([np.empty(0, np.int64), *(each.index for each in seen)])
    sights = np.empty(len(point), _SIGHT)
    sights["image"] = np.repeat(np.arange(1, len(seen) + 1), [len(each.index) for each in seen])
    sights["observation"] = np.concatenate([np.empty(0, np.int64), *(np.arange(len(each.index)) for each in seen)])
    sights = sights[np.argsort(point, kind="stable")]
    rows["sights"] = np.bincount(point, minlength=count)
    return struct.pack("<Q", count) + _interleaved(rows, sights)


def _interleaved(rows: NDArray, sights: NDArray) -> bytes:
    """Put each row's sights behind it."""
    sizes = np.stack((np.full(len(rows), _POINT.itemsize), rows["sights"].astype(np.int64) * _SIGHT.itemsize), 1)
    is_row = np.repeat(np.tile([True, False], len(rows)), sizes.reshape(-1))
    mixed = np.empty(len(is_row), np.uint8)
    mixed[is_row], mixed[~is_row] = rows.view(np.uint8), sights.view(np.uint8)
    return mixed.tobytes()
