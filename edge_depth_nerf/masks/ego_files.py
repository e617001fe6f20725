"""The vehicle's own masks in a scene: `ego_masks/CAMERA.png`, as found or as corrected by users."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json_object, read_mask, sha256_of, write_json, write_mask

EGO_MASKS = "ego_masks"
"""Folder of the scene with the vehicle's masks that were found, in the size of the raw pictures."""
_UNKNOWN = "not_found.json"
"""Beside the masks: SHA-256 of those that were written without knowing where the vehicle is."""


def ego_mask_path(scene: Path, camera: str) -> Path:
    """Where a camera's mask lies: 255 = use the pixel, in the size of the raw pictures."""
    return scene / EGO_MASKS / f"{camera}.png"


def keep_ego_mask(scene: Path, camera: str, mask: NDArray[np.bool_], could_tell: bool) -> None:
    """Write a mask that was looked for (True = use the pixel); one that is there already keeps its time of change.

    `could_tell`: whether the pictures were enough to find the vehicle.
    """
    path = ego_mask_path(scene, camera)
    if not (path.is_file() and np.array_equal(read_mask(path), mask)):
        write_mask(path, mask)
    unknown = _unknown(scene)
    wanted = {name: digest for name, digest in unknown.items() if name != camera}
    if not could_tell:
        wanted[camera] = sha256_of(path)
    if wanted != unknown:
        write_json(scene / EGO_MASKS / _UNKNOWN, wanted)


def vehicles_unknown(scene: Path) -> list[str]:
    """Cameras whose pictures did not tell where the vehicle is, and whose masks nobody has corrected since."""
    unknown = _unknown(scene)
    there = [camera for camera in unknown if ego_mask_path(scene, camera).is_file()]
    return [camera for camera in there if sha256_of(ego_mask_path(scene, camera)) == unknown[camera]]


def _unknown(scene: Path) -> dict[str, object]:
    try:
        return read_json_object(scene / EGO_MASKS / _UNKNOWN)
    except (InputError, OSError):
        return {}
