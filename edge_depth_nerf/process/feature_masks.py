"""Where the pictures of a recording may be searched for features."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.masks.semantics import keep_static, read_labels
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.scene.checks import read_camera_mask


class FeatureMasks:
    """What of each picture may be searched for features: within the lens, not the vehicle, nothing that moves."""

    def __init__(self, recording: Recording, options: ProcessOptions, theta_max_rad: Mapping[str, float]) -> None:
        self._options, self._theta_max_rad = options, theta_max_rad
        self._cameras = {camera.name: camera.camera for camera in recording.cameras}
        self._shared: dict[str, NDArray[np.bool_]] = {}
        self.ego_masks = {
            camera.name: options.ego_mask_of(camera.name) or camera.ego_mask for camera in recording.cameras
        }

    def of(self, picture: RecordedPicture) -> NDArray[np.bool_]:
        """The mask of one picture, at its own size, True = use; nothing of a picture whose own mask is damaged.

        Raises:
            InputError: a camera's mask cannot be read, or has another size; with --strict, a picture's.

        """
        name = picture.camera
        if name not in self._shared:
            shared = lens_circle(self._cameras[name], math.degrees(self._theta_max_rad[name]))
            ego_mask = self.ego_masks[name]
            self._shared[name] = (
                shared if ego_mask is None else shared & read_camera_mask(ego_mask, self._cameras[name])
            )
        mask = self._shared[name]
        try:
            if picture.mask is not None:
                mask = mask & read_camera_mask(picture.mask, self._cameras[name])
            if picture.semantics is not None:
                mask = mask & keep_static(read_labels(picture.semantics), self._options.moving_classes)
        except (InputError, FileNotFoundError):
            if self._options.strict:
                raise
            # it is left out, and reported when its turn comes
            return np.zeros_like(mask)
        return mask
