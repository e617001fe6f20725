"""The prior of each picture of a scene, made once and kept in files until the export is complete."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, write_distance_png
from edge_depth_nerf.inspecting.shown_prior import ShownScene
from edge_depth_nerf.method.prior import Prior, default_source
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture


class Priors:
    """Priors in a folder, as training's defaults make them: distance and sigma, metres, 0 = none."""

    def __init__(self, scene: SceneFolder, folder: Path) -> None:
        """Name the files, and read the calibration.

        Raises:
            InputError: no picture has anything that a prior is made of, or the calibration is broken.
        """
        if not any(default_source(picture.files) for picture in scene.pictures):
            raise InputError(
                f"{scene.path}: no picture has LiDAR, monocular distance or distance from motion, so there is no prior "
                "to export. `edge-depth-nerf process` makes LiDAR maps, `edge-depth-nerf estimate-depth` adds "
                "monocular ones."
            )
        self.scene, self._folder = scene, folder
        self._shown = ShownScene(scene)
        self.stems = _stems(scene)
        """A file name for each picture, by its name in the scene."""
        _ = self._shown.calibration

    def _files(self, picture: ScenePicture) -> tuple[Path, Path]:
        stem = self.stems[picture.name]
        return self._folder / f"{stem}_distance.png", self._folder / f"{stem}_sigma.png"

    def is_made(self, picture: ScenePicture) -> bool:
        """Whether the files are there."""
        return all(path.is_file() for path in self._files(picture))

    def make(self, picture: ScenePicture) -> None:
        """Compute the prior of a picture and write it.

        Raises:
            InputError: a map of the scene cannot be read.
        """
        maps = self._shown.maps(picture)
        prior, none = maps.prior, np.zeros_like(maps.usable, np.float32)
        pairs = (none, none) if prior is None else (prior.distance_m, prior.sigma_m)
        for path, values in zip(self._files(picture), pairs, strict=True):
            write_distance_png(path, values)

    def read(self, picture: ScenePicture) -> Prior:
        """Read what `make` wrote."""
        return Prior(*map(read_distance_png, self._files(picture)))


def _stems(scene: SceneFolder) -> dict[str, str]:
    names = [picture.name for picture in scene.pictures]
    stems = [name.removeprefix("images/").rsplit(".", 1)[0].replace("/", "_").replace(" ", "_") for name in names]
    if len(set(stems)) < len(stems):
        stems = [f"{number:06d}_{stem}" for number, stem in enumerate(stems)]
    return dict(zip(names, stems, strict=True))
