"""A recording's pictures, made ready for a search of features, and where they may be searched."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.poses.matches import PosedPicture
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.scene.checks import read_camera_mask


class FeatureMasks:
    """What of each picture may be searched for features: within the lens, not the vehicle, nothing that moves."""

    def __init__(self, recording: Recording, options: ProcessOptions, theta_max_rad: Mapping[str, float]) -> None:
        self._options, self._theta_max_rad = options, theta_max_rad
        self._cameras = {camera.name: camera for camera in recording.cameras}
        self._shared: dict[str, NDArray[np.bool_]] = {}

    def of(self, picture: RecordedPicture) -> NDArray[np.bool_]:
        """The mask of one picture, at its own size, True = use; nothing of a picture whose own mask is damaged.

        Raises:
            InputError: a camera's mask cannot be read, or has another size; with --strict, a picture's.
        """
        recorded = self._cameras[picture.camera]
        if recorded.name not in self._shared:
            shared = lens_circle(recorded.camera, math.degrees(self._theta_max_rad[recorded.name]))
            if recorded.ego_mask is not None:
                shared &= read_camera_mask(recorded.ego_mask, recorded.camera)
            self._shared[recorded.name] = shared
        shared = self._shared[recorded.name]
        if picture.mask is None:
            return shared
        own = read_if_whole(partial(read_camera_mask, picture.mask, recorded.camera), strict=self._options.strict)
        return np.zeros_like(shared) if own is None else shared & own


def posed_pictures(
    recording: Recording, masks: FeatureMasks, read: Callable[[RecordedPicture, Camera], NDArray[np.uint8]]
) -> list[PosedPicture]:
    """The pictures of a recording with a path; `read` reads one of a camera."""
    lenses = {camera.name: camera.camera for camera in recording.cameras}
    return [
        PosedPicture(
            camera=picture.camera,
            frame=picture.frame,
            lens=lenses[picture.camera],
            camera_to_world=recording.pose(picture),
            read_rgb=partial(read, picture, lenses[picture.camera]),
            read_usable=partial(masks.of, picture),
        )
        for picture in recording.pictures
    ]
