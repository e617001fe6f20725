"""Whether the masks that are given hide the vehicle: it stays the same in all pictures, and what is used does not."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.process.reading import downscale_image, downscale_mask, read_if_whole
from edge_depth_nerf.process.recording import RecordedCamera, Recording
from edge_depth_nerf.scene.checks import read_camera_mask

_WORKING_PX = 160
"""Pictures are averaged down until the longer side is about so long."""
_PICTURES = 8
"""So many pictures of a camera, spread over the drive."""
_MOST_HIDDEN = 0.5
"""A mask that hides more of the lens is reported."""
_INVERTED = 1.5
"""What is hidden may change by so much more than what is used. Right masks of rendered drives give 0.08 to 0.14,
inverted ones 7 to 12."""
_FEWEST_PX = 100


def mask_warnings(recording: Recording, lenses: Mapping[str, Bool[np.ndarray, "h w"]]) -> list[str]:
    """Say which cameras' masks are inverted, or hide most of the lens.

    Args:
        recording: with the masks that are given. Of those of single pictures, some are read.
        lenses: of each camera, True within its lens.
    """
    found = []
    for camera in recording.cameras:
        masks = _masks(recording, camera)
        if not masks:
            continue
        lens = lenses[camera.name]
        hidden = float(np.median([1 - (mask & lens).sum() / max(1, lens.sum()) for mask in masks]))
        change = _change(recording, camera, masks[0], lens) if camera.ego_mask is not None else None
        name = "masks" if camera.ego_mask is None else str(camera.ego_mask)
        if change is not None and change > _INVERTED:
            found.append(
                f"{camera.name}: {name} hides what changes from picture to picture and keeps what stays the same, such "
                "as the vehicle. Is it inverted? Expected 255 = use the pixel, 0 = ignore it."
            )
        elif hidden > _MOST_HIDDEN:
            found.append(
                f"{camera.name}: {name} hides {hidden:.0%} of the lens. Expected 255 = use the pixel, 0 = ignore it; "
                "check that so much is to be ignored."
            )
    return found


def _masks(recording: Recording, camera: RecordedCamera) -> list[Bool[np.ndarray, "h w"]]:
    """The camera's own mask with those of some pictures; none where none is given."""
    pictures = [one for one in recording.pictures if one.camera == camera.name and one.mask is not None]
    paths = [pictures[index].mask for index in spread_over(len(pictures), _PICTURES)]
    read = [None if path is None else read_if_whole(partial(read_camera_mask, path, camera.camera)) for path in paths]
    of_pictures = [mask for mask in read if mask is not None]
    if camera.ego_mask is None:
        return of_pictures
    own = read_camera_mask(camera.ego_mask, camera.camera)
    return [own & mask for mask in of_pictures] or [own]


def _change(
    recording: Recording, camera: RecordedCamera, mask: Bool[np.ndarray, "h w"], lens: Bool[np.ndarray, "h w"]
) -> float | None:
    """How much more what is hidden changes over the drive than what is used; None if that cannot be told."""
    pictures = [one for one in recording.pictures if one.camera == camera.name]
    factor = max(1, round(max(mask.shape) / _WORKING_PX))
    chosen = [pictures[index] for index in spread_over(len(pictures), _PICTURES)]
    read = [read_if_whole(partial(read_image, picture.path)) for picture in chosen]
    contrasts = [_contrast(downscale_image(one, factor)) for one in read if one is not None]
    if len(contrasts) < 3:
        return None
    over_time = np.std(contrasts, axis=0)
    inner = cv2.erode(downscale_mask(lens, factor).astype(np.uint8), np.ones((5, 5))) > 0
    used, hidden = downscale_mask(mask, factor) & inner, downscale_mask(~mask, factor) & inner
    if min(used.sum(), hidden.sum()) < _FEWEST_PX:
        return None
    return float(over_time[hidden].mean() / max(over_time[used].mean(), 1e-6))


def _contrast(picture: np.ndarray) -> Float32[np.ndarray, "h w"]:
    light = np.log(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32) + np.float32(8))
    return light - cv2.GaussianBlur(light, (0, 0), 4.0)
