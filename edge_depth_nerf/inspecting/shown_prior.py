"""The prior of a scene's pictures for show: as training makes it by default."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from edge_depth_nerf.method.error_model import Trust, read_trust
from edge_depth_nerf.method.prior import Prior, PriorOptions, default_source, make_prior, view_of
from edge_depth_nerf.mono.calibration import saved_trust
from edge_depth_nerf.scene.format import TRUST_FILE
from edge_depth_nerf.scene.reader import PictureMaps, SceneFolder, ScenePicture


@dataclass(frozen=True)
class ShownMaps(PictureMaps):
    """All that one picture has, with the prior that training makes of it."""

    source: str | None
    """What the prior is made of; None with neither LiDAR nor monocular distance."""
    prior: Prior | None
    """None without a source."""


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
        prior = None
        if source:
            view = view_of(picture.lens, picture.up_in_camera) if self.trust else None
            prior = make_prior(maps.distances_m, maps.usable, source, PriorOptions(), self.trust, view)
        return ShownMaps(**vars(maps), source=source, prior=prior)
