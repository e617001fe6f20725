"""A scene's place in the coordinates of a model: from nerfstudio's own dataparser, with the training's settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from rich.console import Console
from scipy.spatial import KDTree

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json_object
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.films.options import TrainedOptions
from edge_depth_nerf.films.training import read_dataparser
from edge_depth_nerf.plugin.compat import quiet_host
from edge_depth_nerf.plugin.scanning import SceneToModel
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

SAVED_TRANSFORM = "dataparser_transforms.json"
"""A file beside config.yml. It contains the scene's transform at the time of the training."""
OUTSIDE_M = 10.0
"""A message warns of a path that is further from the drive than this."""
SAME_PLACE = 1e-3
"""Largest difference of a camera's position between the path and the training, in scene units."""


def poses_of(pictures: Sequence[ScenePicture]) -> Float64[np.ndarray, "n 4 4"]:
    """Give the pictures' poses, camera (OpenGL) to scene."""
    return rigid(
        np.stack([picture.rotation for picture in pictures]), np.stack([picture.position_m for picture in pictures])
    )


def outside(poses: Float64[np.ndarray, "n 4 4"], scene: SceneFolder) -> str | None:
    """Warn of poses in the scene that are far from where anything was recorded; None if there are none."""
    driven = np.stack([picture.position_m for picture in scene.pictures])
    away_m = KDTree(driven).query(poses[:, :3, 3])[0]
    if not (away_m > OUTSIDE_M).any():
        return None
    return (
        f"{int((away_m > OUTSIDE_M).sum())} of {len(poses)} poses of the path are more than {OUTSIDE_M:g} m from the "
        f"drive, the furthest {away_m.max():.0f} m: nothing was recorded there, and what is rendered may be anything."
    )


def placed(options: TrainedOptions, console: Console) -> tuple[SceneFolder, SceneToModel]:
    """Return the scene, and its place in the model's coordinates by the training's own dataparser.

    Raises:
        FileNotFoundError: there is no scene, or no config.yml, at the given path.
        InputError: the scene or the training cannot be used.
    """
    with console.status("Reading the scene's place in the model's coordinates from nerfstudio …"), quiet_host():
        dataparser = read_dataparser(options.load_config)
        scene = read_scene(options.scene or Path(dataparser.data))
        dataparser.data = scene.path
        outputs = dataparser.setup().get_dataparser_outputs(split="train")
    _check_unchanged(outputs, options.load_config.parent / SAVED_TRANSFORM, scene)
    to_model = SceneToModel.of(outputs, scene.meta)

    trained = outputs.cameras.camera_to_worlds.numpy()[:, :3, 3].astype(np.float64)
    ours = to_model.poses(poses_of(scene.pictures))[:, :3, 3]
    furthest = max(float(np.linalg.norm(ours - place, axis=1).min()) for place in trained)
    if furthest > SAME_PLACE * max(1.0, float(np.abs(trained).max())):
        raise InputError(
            f"{scene.path}: the training's dataparser places the cameras {furthest:.3g} scene units away from where "
            "its own transform places them, so no path can be computed. Train with fisheye-depth-data or "
            "nerfstudio-data."
        )
    return scene, to_model


def _check_unchanged(outputs: Any, saved: Path, scene: SceneFolder) -> None:
    """Compare the scene's place with the one that the training saved; raise an InputError if they differ."""
    if not saved.is_file():
        return
    record = read_json_object(saved, "transform", "scale")
    now = np.append(outputs.dataparser_transform.numpy(), outputs.dataparser_scale)
    try:
        then = np.append(np.asarray(record["transform"], dtype=np.float64), float(record["scale"]))
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{saved}: expected a matrix under transform and a number under scale. Train again.") from None
    if now.shape != then.shape or not np.allclose(now, then, rtol=1e-4, atol=1e-4):
        raise InputError(
            f"{scene.path}: its place in the model's coordinates differs from {saved}. It is another scene, or it was "
            "changed after the training. Give the scene that the model was trained on, or train again."
        )
