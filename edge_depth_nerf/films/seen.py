"""Which places of a trained scene its training pictures have seen, and which rays of a film they have not."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64

from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.plugin.scanning import Caster, points_within
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

REACH_M = 25.0
"""A picture from further away shows too little of the road."""
TRIES = 3
"""So many pictures, the nearest ones in which a place would be visible, are asked whether something hides it."""
AGREE = 0.1
AGREE_M = 0.3
"""A place is seen if the field shows something at its distance from the camera, within this share and this length."""
KEPT_MASKS = 64
ALONG_M = 10.0
"""A ray of a film was recorded if a picture shows the place so far along it, inside its mask."""
ASKED_POSES, ASKED_PICTURES = 8, 6
"""So many poses of a film are asked for what they show, and so many pictures of each camera within reach of a pose."""


class TrainingViews:
    """The training pictures of a scene, asked for what they see."""

    def __init__(self, scene: SceneFolder, caster: Caster | None = None) -> None:
        """Take a scene and, for `see`, what casts rays into the model that was trained on it."""
        self._caster = caster
        self._pictures = [each for each in scene.pictures if not (scene.split_known and each.held_out)]
        self._positions_m = np.stack([picture.position_m for picture in self._pictures])
        self._usable = lru_cache(KEPT_MASKS)(lambda number: scene.usable(self._pictures[number]))

    def unseen_share(
        self, camera_to_scene: Float64[np.ndarray, "poses 4 4"], rays: Float64[np.ndarray, "rays 3"]
    ) -> float:
        """Share of a film's rays along which no picture near shows the place `ALONG_M` away.

        Args:
            camera_to_scene: poses of the film.
            rays: unit vectors in the film's camera (OpenGL's axes).
        """
        cameras = np.array([picture.camera for picture in self._pictures])
        seen = []
        for pose in camera_to_scene[spread_over(len(camera_to_scene), ASKED_POSES)]:
            points_m = pose[:3, 3] + ALONG_M * rays @ pose[:3, :3].T
            near = np.linalg.norm(self._positions_m - pose[:3, 3], axis=1) <= REACH_M - ALONG_M
            found = np.zeros(len(rays), bool)
            for of_camera in (np.flatnonzero(near & (cameras == camera)) for camera in np.unique(cameras)):
                for number in of_camera[spread_over(len(of_camera), ASKED_PICTURES)].tolist():
                    found |= np.isfinite(self._distance_m(number, points_m))
            seen.append(found.mean())
        return 1 - float(np.mean(seen))

    def see(self, points_m: Float64[np.ndarray, "points 3"]) -> Bool[np.ndarray, "points"]:
        """Say which points a picture shows: inside its mask, and with nothing before them in the field."""
        assert self._caster is not None
        seen = np.zeros(len(points_m), bool)
        if not len(points_m):
            return seen
        middle = points_m.mean(axis=0)
        reach_m = REACH_M + np.linalg.norm(points_m - middle, axis=1).max()
        numbers = np.flatnonzero(np.linalg.norm(self._positions_m - middle, axis=1) <= reach_m)
        if not len(numbers):
            return seen
        distance_m = np.stack([self._distance_m(number, points_m) for number in numbers.tolist()])
        order = np.argsort(distance_m, axis=0)[:TRIES]
        for nearest in order:
            away_m = distance_m[nearest, np.arange(len(points_m))]
            asked = np.flatnonzero(~seen & np.isfinite(away_m))
            if not len(asked):
                break
            origin_m = self._positions_m[numbers[nearest[asked]]]
            cast = self._caster.cast(origin_m, (points_m[asked] - origin_m) / away_m[asked, None])
            seen[asked] = np.abs(cast.distance_m - away_m[asked]) <= AGREE * away_m[asked] + AGREE_M
        return seen

    def _distance_m(self, number: int, points_m: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "points"]:
        """Distances from a picture's camera to those points that lie inside its mask; infinite for the others."""
        picture: ScenePicture = self._pictures[number]
        found = np.full(len(points_m), np.inf)
        used = points_within(picture, self._usable(number), points_m)
        away_m = np.linalg.norm(points_m[used] - picture.position_m, axis=1)
        found[used] = np.where(away_m <= REACH_M, away_m, np.inf)
        return found
