"""The files of each view: picture, mask, depth and its standard deviation.

Depth counts millimetres, 0 = none: metres along the ray for fisheyes, along the axis for pinholes. So nerfstudio's
depth-nerfacto reads both with its defaults. Names are flat, because many programs leave folders out of them.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray

from edge_depth_nerf.base.files import write_atomically, write_mask, write_png
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.export.cloud import SIGMAS, Cloud
from edge_depth_nerf.export.cuts import Cut, cuts_of
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.export.priors import Priors
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

MILLIMETRES = 1000
LARGEST_COUNT = 65535
MOST_SEEN = 3000
"""A view of a COLMAP model observes at most so many points."""
SLACK = 0.02
"""A point is seen if its distance differs from the map's by at most this share."""
_SEED = 0


@dataclass(frozen=True, eq=False)
class ExportedView:
    """A picture that is written."""

    picture: ScenePicture
    cut: Cut
    stem: str
    """Of its files."""
    suffix: str
    """Of the picture's file."""

    @property
    def file_name(self) -> str:
        """Of the picture."""
        return f"{self.stem}{self.suffix}"

    @property
    def camera(self) -> str:
        """A name for the camera that takes it."""
        return f"{self.picture.camera}{self.cut.name}"

    @property
    def view_to_scene(self) -> Transform:
        """Its pose, with OpenCV's axes."""
        pose = self.picture.pose
        pose[:3, :3] = pose[:3, :3] @ self.cut.view_to_camera
        return pose


@dataclass(frozen=True, eq=False)
class Seen:
    """What a view observes of the cloud."""

    index: NDArray[np.int64]
    """Of the points."""
    pixels: NDArray[np.float64]
    """Where they lie in the view, [points, 2]."""


def views_of(scene: SceneFolder, stems: dict[str, str], options: ExportOptions) -> list[ExportedView]:
    """List the views of a scene, in the order of their pictures."""
    views = []
    for picture in scene.pictures:
        if picture.held_out and options.pictures == "training":
            continue
        given = (options.form, options.views, options.cuts, options.fov_deg)
        for cut in cuts_of(picture.lens, scene.theta_max_rad, *given):
            suffix = picture.files["image"].suffix if cut.is_whole else ".png"
            views.append(ExportedView(picture, cut, f"{stems[picture.name]}{cut.name}", suffix))
    return views


class ViewWriter:
    """Writes the files of views into an export."""

    def __init__(self, output: Path, priors: Priors, options: ExportOptions) -> None:
        self._output, self._priors, self._options = output, priors, options

    def files(self, view: ExportedView) -> dict[str, Path]:
        """Name a view's files by what they hold."""
        # COLMAP adds .png to the whole name of the picture
        mask = f"{view.file_name}.png" if self._options.form == "colmap" else f"{view.stem}.png"
        depth = f"{view.stem}.{self._options.depth_files}"
        return {
            "image": self._output / "images" / view.file_name,
            "mask": self._output / "masks" / mask,
            "depth": self._output / "depths" / depth,
            "sigma": self._output / "sigmas" / depth,
        }

    def is_written(self, view: ExportedView) -> bool:
        """Whether all files of a view are there."""
        return all(path.is_file() for path in self.files(view).values())

    def write(self, views: Sequence[ExportedView]) -> tuple[int, int]:
        """Write the files of all views of one picture.

        Returns:
            How many pixels of the picture's views have a prior, and how many of these are too far for the files.

        Raises:
            InputError: a file of the scene cannot be read.
        """
        picture, scene = views[0].picture, self._priors.scene
        prior, usable = self._priors.read(picture), scene.usable(picture)
        known = too_far = 0
        for view in views:
            files, cut = self.files(view), view.cut
            if cut.is_whole:
                source = picture.files["image"]
                write_atomically(files["image"], lambda temporary, source=source: shutil.copyfile(source, temporary))
            else:
                write_png(files["image"], cut.colours(scene.rgb(picture)))
            mask = cut.mask(usable)
            write_mask(files["mask"], mask)
            to_depth = cut.rays.cos_theta if isinstance(cut.lens, Pinhole) else np.float32(1)
            depth_m = cut.distances(prior.distance_m) * mask * to_depth
            sigma_m = cut.values(prior.sigma_m) * mask * to_depth
            within = np.ones_like(mask)
            if self._options.depth_files == "png":
                within = np.rint(depth_m * MILLIMETRES) <= LARGEST_COUNT
            known, too_far = known + int((depth_m > 0).sum()), too_far + int((~within).sum())
            self._write_depth(files["depth"], depth_m * within)
            self._write_depth(files["sigma"], sigma_m * within)
        return known, too_far

    def _write_depth(self, path: Path, values_m: Float32[np.ndarray, "h w"]) -> None:
        counts = values_m * np.float32(MILLIMETRES)
        if path.suffix == ".npy":
            write_atomically(path, lambda temporary: np.save(temporary, counts.astype(np.float32)))
        else:
            # what is positive stays a value
            steps = np.where(counts > 0, np.clip(np.rint(counts), 1, LARGEST_COUNT), 0)
            write_png(path, steps.astype(np.uint16))

    def seen(self, view: ExportedView, cloud: Cloud) -> Seen:
        """Find which points of a cloud a view sees, by the picture's own prior; some of them, where they are many."""
        prior, usable = self._priors.read(view.picture), self._priors.scene.usable(view.picture)
        cut, pose = view.cut, view.view_to_scene
        in_view = (cloud.points_m - pose[:3, 3]) @ pose[:3, :3]
        pixels, valid = (found.numpy() for found in cut.lens.project(torch.from_numpy(in_view)))
        inside = valid & (in_view[:, 2] > 0) & cut.lens.inside(torch.from_numpy(pixels)).numpy()
        index = np.flatnonzero(inside)
        column, row = np.floor(pixels[index]).astype(int).T
        mask = cut.mask(usable)
        range_m = np.linalg.norm(in_view[index], axis=1)
        distance_m, sigma_m = cut.distances(prior.distance_m)[row, column], cut.values(prior.sigma_m)[row, column]
        same = np.abs(distance_m - range_m) <= np.maximum(SIGMAS * sigma_m, SLACK * range_m)
        index = index[same & mask[row, column] & (distance_m > 0)]
        # all views prefer the same points, so that each of these is seen by many
        order = np.random.default_rng(_SEED).permutation(len(cloud.points_m))
        index = np.sort(index[np.argsort(order[index])[:MOST_SEEN]])
        return Seen(index, pixels[index])
