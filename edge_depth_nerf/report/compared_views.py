"""Held-out views of a scene, with the renderings of trained models that `ns-eval` wrote."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.base.pictures import colour_distance
from edge_depth_nerf.scene.format import LAYERS, read_transforms

DISTANCE_KEYS = (LAYERS["truth_distance"].key, LAYERS["lidar"].key)
"""Sources of a view's distances, the better one first."""
BY_VIEW = "by_view.json"
"""In a folder of rendered views: the figures of each, by its number."""


def held_out_frames(scene: Path) -> list[dict[str, Any]]:
    """Return the held-out frames of a scene's transforms.json, in the order of the evaluation."""
    transforms = read_transforms(scene / "transforms.json")
    names = set(transforms.get("test_filenames", ()))
    frames = [frame for frame in transforms["frames"] if frame["file_path"] in names]
    # as nerfstudio's parser: folder by folder, not letter by letter
    return sorted(frames, key=lambda frame: Path(frame["file_path"]))


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A held-out view: its ground truth, and each run's rendering. Pictures are H×W×3 uint8, maps H×W."""

    name: str
    """Its file name in the scene."""
    rgb: NDArray[np.uint8]
    """The recorded picture."""
    clean_rgb: NDArray[np.uint8] | None
    """The same without noise and exposure drift, if known."""
    mask: NDArray[np.bool_]
    """True = the pixel is evaluated."""
    distance_m: NDArray[np.float32]
    """Metres along the ray, 0 = unknown."""
    distance_key: str | None
    """The one of `DISTANCE_KEYS` that it is from; None without any."""
    colours: dict[str, NDArray[np.uint8]]
    """Each run's rendered picture, black outside the mask."""
    distances: dict[str, NDArray[np.uint8]]
    """Each run's rendered median distances, in the colours of `colour_distance`."""
    figures: dict[str, dict[str, float]]
    """Each run's figures of this view, by name; empty where a run left none."""

    def rows(self) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
        """Return colours and distances: the recorded ones first, then each run's."""
        known = colour_distance(self.distance_m, self.mask)
        return [self.rgb, *self.colours.values()], [known, *self.distances.values()]


def compared_view(scene: Path, frame: Mapping[str, Any], index: int, views_of: Mapping[str, Path]) -> ComparedView:
    """Read the held-out view `frame`, which is number `index` of `held_out_frames`.

    `views_of` gives each run's folder of rendered views, as `ns-eval --render-output-path` writes them.
    """
    rgb = read_image(scene / frame["file_path"])
    mask = read_mask(scene / frame["mask_path"]) if "mask_path" in frame else np.ones(rgb.shape[:2], bool)
    key = next((key for key in DISTANCE_KEYS if key in frame), None)
    clean = frame.get(LAYERS["truth_rgb"].key)
    colours, distances, figures = {}, {}, {}
    for name, folder in views_of.items():
        # nerfstudio saves ground truth and rendering side by side
        rendered = read_image(folder / f"eval_img_{index:04d}.png")[:, rgb.shape[1] :]
        colours[name] = np.where(mask[..., None], rendered, 0).astype(np.uint8)
        distances[name] = read_image(folder / f"eval_distance_{index:04d}.png")
        by_view = folder / BY_VIEW
        figures[name] = read_json(by_view).get(str(index), {}) if by_view.is_file() else {}
    return ComparedView(
        name=frame["file_path"],
        rgb=rgb,
        clean_rgb=None if clean is None else read_image(scene / clean),
        mask=mask,
        distance_m=np.zeros(mask.shape, np.float32) if key is None else read_distance_png(scene / frame[key]),
        distance_key=key,
        colours=colours,
        distances=distances,
        figures=figures,
    )


def compared_views(scene: Path, views_of: Mapping[str, Path], most: int | None = None) -> Iterator[ComparedView]:
    """Read held-out views: all, or `most` that are spread over the drive; `views_of` as for `compared_view`."""
    frames = held_out_frames(scene)
    for index in spread_over(len(frames), len(frames) if most is None else most):
        yield compared_view(scene, frames[index], index, views_of)
