"""Computes the prior of a scene's pictures for display, with training's defaults."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.method.error_model import Calibration, read_calibration
from edge_depth_nerf.method.integration import INTEGRATED
from edge_depth_nerf.method.prior import (
    FARTHEST_M,
    Prior,
    PriorOptions,
    RayAngles,
    default_source,
    make_prior,
    ray_angles,
)
from edge_depth_nerf.mono.calibration import saved_calibration
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.reader import PictureMaps, SceneFolder, ScenePicture

ORIGINS = ("LiDAR", "monocular", "both", "motion")
"""Sources of a pixel's prior. LiDAR: a LiDAR point. Without one: a monocular distance, one from motion, or both."""


@dataclass(frozen=True)
class ShownMaps(PictureMaps):
    """All maps of one picture, with the prior that training makes of them."""

    source: str | None
    """The prior's depth source; None without any."""
    prior: Prior | None
    """None without a source."""
    origin: NDArray[np.int8] | None
    """H×W, the source of each pixel's prior: an index of `ORIGINS`, -1 without a prior. None without a source."""


class ShownScene:
    """A scene with the priors of its pictures."""

    def __init__(self, scene: SceneFolder) -> None:
        self.scene = scene

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration beside the maps, if it matches them; else None, and sigma_mode is combined.

        Raises:
            InputError: the file is broken.
        """
        path = self.scene.folder / CALIBRATION_FILE
        if not path.is_file():
            return None
        read_calibration(path)
        return saved_calibration(self.scene, PriorOptions())

    def maps(self, picture: ScenePicture) -> ShownMaps:
        """Read all maps of a picture, and compute its prior.

        Raises:
            InputError: a file cannot be decoded, or its size differs from the camera's.
        """
        maps = self.scene.maps(picture)
        source = default_source(picture.files)
        prior = origin = None
        if source:
            view = ray_angles(picture.lens, picture.up_in_camera) if self.calibration else None
            prior = make_prior(maps.distances_m, maps.usable, source, PriorOptions(), self.calibration, view)
            origin = _origin(maps, source, prior, self.calibration, view)
        return ShownMaps(**vars(maps), source=source, prior=prior, origin=origin)


def _origin(
    maps: PictureMaps, source: str, prior: Prior, calibration: Calibration | None, view: RayAngles | None
) -> NDArray[np.int8]:
    """Return the source of each pixel's prior, by the rules of `make_prior`."""

    def has(name: str) -> NDArray[np.bool_]:
        found = maps.distances_m.get(name)
        return np.zeros_like(maps.usable) if found is None else np.nan_to_num(found) > 0

    with_motion = source == "motion" or (
        source == INTEGRATED and (calibration is None or calibration.motion is not None)
    )
    moved = has("motion") if with_motion else np.zeros_like(maps.usable)
    estimated = has("mono")
    if calibration is not None and view is not None:
        # larger monocular distances only mean "far"
        estimated &= np.nan_to_num(maps.distances_m.get("mono", np.zeros(1))) <= FARTHEST_M
        alone = calibration.motion is not None and calibration.motion.beyond is not None
        if not calibration.everywhere or alone:
            # beyond, motion counts alone where it has a distance
            estimated &= calibration.in_field(view.elevation_rad)
    points = has("lidar") if source != "mono" else np.zeros_like(maps.usable)
    of_estimates = np.where(moved, np.where(estimated, 2, 3), 1)
    return np.where(prior.distance_m > 0, np.where(points, 0, of_estimates), -1).astype(np.int8)
