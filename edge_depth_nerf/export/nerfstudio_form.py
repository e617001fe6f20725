"""The form nerfstudio: transforms.json, for nerfstudio's own dataparser and ours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge_depth_nerf.base.files import write_json
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.cameras.transforms import opencv_to_opengl
from edge_depth_nerf.export.pictures import MILLIMETRES, ExportedView, ViewWriter
from edge_depth_nerf.scene.format import DEPTH_KEY, DISTORTION, LAYERS, TRANSFORMS
from edge_depth_nerf.scene.reader import FISHEYE_MODEL, SceneFolder

SIGMA_KEY = "depth_sigma_file_path"
"""Of a frame: standard deviation of its depth, in the same unit."""
POINTS = "points.ply"


def write_transforms(output: Path, scene: SceneFolder, views: Sequence[ExportedView], writer: ViewWriter) -> None:
    """Write transforms.json, which makes the folder complete."""
    is_fisheye = isinstance(views[0].cut.lens, KannalaBrandt)
    meta: dict[str, Any] = {
        "camera_model": FISHEYE_MODEL if is_fisheye else "OPENCV",
        "depth_unit_scale_factor": 1 / MILLIMETRES,
        "ply_file_path": POINTS,
    }
    if is_fisheye:
        meta["theta_max_deg"] = math.degrees(scene.theta_max_rad)
    names = {view: f"images/{view.file_name}" for view in views}
    held_out = [names[view] for view in views if view.picture.held_out]
    if held_out:
        meta["train_filenames"] = [names[view] for view in views if not view.picture.held_out]
        # nerfstudio wants all three lists, or none
        meta["val_filenames"] = meta["test_filenames"] = held_out
    meta["frames"] = [_frame(output, view, writer) for view in views]
    write_json(output / TRANSFORMS, meta)


def _frame(output: Path, view: ExportedView, writer: ViewWriter) -> dict[str, Any]:
    keys = {"image": LAYERS["image"].key, "mask": LAYERS["mask"].key, "depth": DEPTH_KEY, "sigma": SIGMA_KEY}
    lens = view.cut.lens
    frame: dict[str, Any] = {
        keys[kind]: path.relative_to(output).as_posix() for kind, path in writer.files(view).items()
    }
    frame |= {"camera": view.camera, "frame": view.picture.frame}
    if view.picture.timestamp_s is not None:
        frame["timestamp_s"] = view.picture.timestamp_s
    frame |= {"w": lens.width, "h": lens.height, "fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy}
    frame |= {name: getattr(lens, name) for name in DISTORTION}
    return frame | {"transform_matrix": opencv_to_opengl(view.view_to_scene).tolist()}
