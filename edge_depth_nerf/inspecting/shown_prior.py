"""The prior of a scene's pictures for show: as training makes it by default."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.method.error_model import Trust, read_trust
from edge_depth_nerf.method.integration import INTEGRATED
from edge_depth_nerf.method.prior import FARTHEST_M, Prior, PriorOptions, View, default_source, make_prior, view_of
from edge_depth_nerf.mono.calibration import saved_trust
from edge_depth_nerf.scene.format import TRUST_FILE
from edge_depth_nerf.scene.reader import PictureMaps, SceneFolder, ScenePicture

ORIGINS = ("LiDAR", "monocular", "both", "motion")
"""What is known at a pixel with a prior: a LiDAR point; without one a monocular distance, one from motion as well, or
that from motion alone."""


@dataclass(frozen=True)
class ShownMaps(PictureMaps):
    """All that one picture has, with the prior that training makes of it."""

    source: str | None
    """What the prior is made of; None with neither LiDAR nor monocular distance."""
    prior: Prior | None
    """None without a source."""
    origin: NDArray[np.int8] | None
    """H×W, what the prior comes from: an index of `ORIGINS`, -1 without a prior. None without a source."""


class ShownScene:
    """A scene whose pictures come with their priors."""

    def __init__(self, scene: SceneFolder) -> None:
        self.scene = scene

    @cached_property
    def trust(self) -> Trust | None:
        """The calibration beside the maps, if it was made of them as they are.

        Without one, sigma is as under sigma_mode combined.

        Raises:
            InputError: the file is broken.

        """
        path = self.scene.folder / TRUST_FILE
        if not path.is_file():
            return None
        read_trust(path)
        return saved_trust(self.scene, PriorOptions())

    def maps(self, picture: ScenePicture) -> ShownMaps:
        """Read all that a picture has, and make its prior.

        Raises:
            InputError: a file cannot be decoded, or has another size than the camera.

        """
        maps = self.scene.maps(picture)
        source = default_source(picture.files)
        prior = origin = None
        if source:
            view = view_of(picture.lens, picture.up_in_camera) if self.trust else None
            prior = make_prior(maps.distances_m, maps.usable, source, PriorOptions(), self.trust, view)
            origin = _origin(maps, source, prior, self.trust, view)
        return ShownMaps(**vars(maps), source=source, prior=prior, origin=origin)


def _origin(maps: PictureMaps, source: str, prior: Prior, trust: Trust | None, view: View | None) -> NDArray[np.int8]:
    """Say for each pixel what its prior comes from, by the rules of `make_prior`."""

    def has(name: str) -> NDArray[np.bool_]:
        found = maps.distances_m.get(name)
        return np.zeros_like(maps.usable) if found is None else np.nan_to_num(found) > 0

    with_motion = source == "motion" or (source == INTEGRATED and (trust is None or trust.motion is not None))
    moved = has("motion") if with_motion else np.zeros_like(maps.usable)
    estimated = has("mono")
    if trust is not None and view is not None:
        # beyond, a monocular distance means "far"
        estimated &= np.nan_to_num(maps.distances_m.get("mono", np.zeros(1))) <= FARTHEST_M
        alone = trust.motion is not None and trust.motion.beyond is not None
        if not trust.everywhere or alone:
            # beyond, motion counts alone where it has a distance
            estimated &= trust.in_field(view.elevation_rad)
    points = has("lidar") if source != "mono" else np.zeros_like(maps.usable)
    of_estimates = np.where(moved, np.where(estimated, 2, 3), 1)
    return np.where(prior.distance_m > 0, np.where(points, 0, of_estimates), -1).astype(np.int8)
