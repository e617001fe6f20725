"""transforms.json: what tells this project's scenes from other people's, and the checks that every reader needs.

This module is light: both readers import it, and so does all other code that reads the file. The checks are written
out, unlike those of rig files. Paths, sizes and comparisons with other frames take most of the lines and of the time
(two thirds of it for paths), and a schema would cover none of them. Keys of nerfstudio that nothing here reads must
pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from edge_depth_nerf.base.bounds import MAX_LENGTH_M, check_pixels, finite, path_inside, shown
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json

TRANSFORMS = "transforms.json"
POINTS = "points.ply"
EXPORT_FIGURES = "export_figures.json"
"""What `export` writes of its cloud into its own folder, which lies beside the scene."""
CALIBRATION_FILE = "mono_trust.json"
"""The calibration of the prior, beside the maps that it was measured on."""
REFINED_POSES = "refined_poses.json"
"""What refining the poses by the pictures found; the next `process` reads it."""

CHECKS = "checks.json"
"""What `process` measured of LiDAR against the pictures, and what it warns of."""

OWN_MOTION = "sphere sweep"
"""Kind of distances from motion that `process` finds itself, in transforms.json."""

LayerKind = Literal["picture", "mask", "distance", "sigma", "check"]


@dataclass(frozen=True)
class Layer:
    """What a scene's pictures have: every one of them, or none."""

    key: str
    """Of a frame in transforms.json: names its file."""
    folder: str
    """Where `process` and `write_maps` put the files."""
    kind: LayerKind
    """picture: RGB. mask: 255 = use. distance: metres along the ray, 0 = none. sigma: standard deviation of another
    layer's distances, metres, 0 = none. check: distances that others are compared with, metres, 0 = none."""
    words: str
    """What messages call it."""
    is_truth: bool = False
    """Whether it is what is really there: for evaluation alone, no training reads it."""


LAYERS: dict[str, Layer] = {
    "image": Layer("file_path", "images/{camera}", "picture", "pictures"),
    "mask": Layer("mask_path", "masks/{camera}", "mask", "masks"),
    "lidar": Layer("lidar_file_path", "lidar/{camera}", "distance", "LiDAR maps"),
    "mono": Layer("mono_file_path", "mono/{camera}", "distance", "monocular maps"),
    "motion": Layer("motion_file_path", "motion/{camera}", "distance", "maps from motion"),
    "motion_sigma": Layer("motion_sigma_file_path", "motion_sigma/{camera}", "sigma", "errors of maps from motion"),
    "motion_around": Layer(
        "motion_around_file_path", "motion_around/{camera}", "check", "maps from motion of neighbouring pictures"
    ),
    "beams": Layer("beams_file_path", "beams/{camera}", "distance", "held-out LiDAR beams", True),
    "truth_distance": Layer("truth_distance_file_path", "truth/{camera}/distance", "distance", "true distances", True),
    "truth_rgb": Layer("truth_rgb_file_path", "truth/{camera}/rgb", "picture", "true pictures", True),
}
"""The one table of what a scene holds. A distance layer that is not ground truth is a source of depth: a prior can be
made of it (`--pipeline.datamanager.depth-source`). A new source is a line here; see docs/extending.md."""
DEPTH_KEY = "depth_file_path"
"""nerfstudio's own key of a depth map; counts as LiDAR where there is no other. What its files hold (unit, distance or
z-depth) the scene says, or `--depth-unit-scale-factor` and `--depth-kind`."""
DepthKind = Literal["auto", "distance", "z_depth"]


def depth_sources() -> list[str]:
    """The layers that a prior can be made of."""
    return [name for name, layer in LAYERS.items() if layer.kind == "distance" and not layer.is_truth]


def later_layers() -> list[str]:
    """The layers that can be put into a scene that exists: sources of depth, their errors, and what checks them."""
    kinds = ("distance", "sigma", "check")
    return [name for name, layer in LAYERS.items() if layer.kind in kinds and not layer.is_truth]


def path_keys() -> list[str]:
    """Keys of a frame that name files."""
    return [*(layer.key for layer in LAYERS.values()), DEPTH_KEY]


def layers_of(frame: Mapping[str, Any]) -> set[str]:
    """The layers that a frame of transforms.json has; nerfstudio's own depth counts as LiDAR."""
    return {name for name, layer in LAYERS.items() if layer.key in frame} | ({"lidar"} if DEPTH_KEY in frame else set())


INTRINSICS = ("fl_x", "fl_y", "cx", "cy")
"""Keys of a frame, or of the whole scene, that are numbers of pixels."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
DISTORTION_PARAMS = "distortion_params"
"""Another key of nerfstudio's: these six in a list."""
_MAX_FRAMES = 1_000_000
"""Also an upper bound of frame numbers."""
_NUMBERS = (
    *INTRINSICS,
    *DISTORTION,
    *("timestamp_s", "theta_max_deg", "depth_unit_scale_factor", "applied_scale", "fisheye_crop_radius"),
)
_MAY_BE_NULL = ("timestamp_s", "fisheye_crop_radius")
_ORIENTATIONS = ("pca", "up", "vertical", "none")


def read_transforms(path: Path) -> dict[str, Any]:
    """Read a transforms.json whose frames have pictures and whose values are what they are taken for.

    What a reader needs beyond that (poses, intrinsics, a model that it knows) is for that reader to check.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is broken, has no frames, a number is none, or a path leads out of the scene's folder.
    """
    meta = read_json(path)
    if not isinstance(meta, dict) or not isinstance(meta.get("frames"), list) or not meta["frames"]:
        raise InputError(
            f"{path}: has no list of frames. Expected a transforms.json of nerfstudio's format; "
            "`edge-depth-nerf process` writes one."
        )
    if len(meta["frames"]) > _MAX_FRAMES:
        raise InputError(f"{path}: {len(meta['frames'])} frames, expected at most {_MAX_FRAMES}. Split the scene.")
    names: set[str] = set()
    for number, frame in enumerate(meta["frames"]):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {number} has no file_path. Every frame needs a picture and a pose.")
        where = f"{path}: frame {number}"
        _check_frame(frame, where, path.parent)
        if frame["file_path"] in names:
            raise InputError(f"{where}: {shown(frame['file_path'])} has a frame already; expected one per picture.")
        names.add(frame["file_path"])
    _check_scene(meta, path)
    spelled = {PurePosixPath(name): name for name in names}
    for key in (f"{split}_filenames" for split in ("train", "val", "test")):
        if key in meta:
            # ./images/1.png is images/1.png, as for nerfstudio
            meta[key] = [spelled.get(PurePosixPath(name), name) for name in meta[key]]
    return meta


def number_of(value: Any, where: str) -> float:
    """A number as a float.

    Raises:
        InputError: it is none, or not finite; names `where`.
    """
    found = finite(value)
    if found is None:
        raise InputError(f"{where} is {shown(value)}, expected a number. Repair the file, or process the drive again.")
    return found


def pose_of(frame: Mapping[str, Any], where: str) -> Float64[np.ndarray, "4 4"]:
    """A frame's transform_matrix: camera (OpenGL) to scene.

    Raises:
        InputError: it is not 4×4 finite numbers, or lies nowhere near; names `where`.
    """
    return _matrix(frame.get("transform_matrix"), f"{where}: transform_matrix", 4)


def _matrix(value: Any, where: str, rows: int) -> Float64[np.ndarray, "rows 4"]:
    lists = value if isinstance(value, list) and all(isinstance(row, list) for row in value) else []
    numbers = [[finite(item) for item in row] for row in lists[: rows + 1]]
    if len(numbers) != rows or any(len(row) != 4 or None in row for row in numbers):
        raise InputError(
            f"{where} must be {rows}×4 finite numbers, found {shown(value)}. Every frame needs a pose; process the "
            "drive again, or repair the file."
        )
    matrix = np.array(numbers, dtype=np.float64)
    if np.abs(matrix).max() > MAX_LENGTH_M:
        raise InputError(f"{where} holds {np.abs(matrix).max():.3g}, more than {MAX_LENGTH_M:g}. Is it in metres?")
    return matrix


def _check_frame(frame: Mapping[str, Any], where: str, folder: Path) -> None:
    for key in path_keys():
        if key in frame:
            path_inside(folder, frame[key], f"{where}: {key}")
    _check_numbers(frame, where)
    if "transform_matrix" in frame:
        pose_of(frame, where)
    number = frame.get("frame", 0)
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < 10**10:
        raise InputError(f"{where}: frame is {shown(number)}, expected a frame number. Repair the file.")
    if "camera" in frame:
        # maps lie in folders of cameras' names
        path_inside(folder, frame["camera"], f"{where}: camera")


def _check_numbers(entry: Mapping[str, Any], where: str) -> None:
    for key in _NUMBERS:
        if key in entry and not (entry[key] is None and key in _MAY_BE_NULL):
            number_of(entry[key], f"{where}: {key}")
    _check_size(entry, where)
    given = entry.get(DISTORTION_PARAMS, [0.0] * 6)
    if not isinstance(given, list) or len(given) != 6 or any(finite(value) is None for value in given):
        raise InputError(f"{where}: {DISTORTION_PARAMS} is {shown(given)}, expected 6 numbers. Repair the file.")


def _check_size(entry: Mapping[str, Any], where: str) -> None:
    sides = [number_of(entry[key], f"{where}: {key}") for key in ("w", "h") if key in entry]
    if any(side % 1 or not 1 <= side < 2**31 for side in sides):
        raise InputError(f"{where}: w and h are {sides}, expected whole numbers of pixels. Repair the file.")
    if len(sides) == 2:
        check_pixels(int(sides[0]), int(sides[1]), where)


def _check_scene(meta: Mapping[str, Any], path: Path) -> None:
    _check_numbers(meta, str(path))
    # a width of the whole scene with a height of each frame
    for number, frame in enumerate(meta["frames"]):
        _check_size({**{key: meta[key] for key in ("w", "h") if key in meta}, **frame}, f"{path}: frame {number}")
    if "orientation_override" in meta and meta["orientation_override"] not in _ORIENTATIONS:
        raise InputError(
            f"{path}: orientation_override is {shown(meta['orientation_override'])}, expected one of "
            f"{', '.join(_ORIENTATIONS)}. Repair the file."
        )
    if "applied_transform" in meta:
        rows = 4 if isinstance(meta["applied_transform"], list) and len(meta["applied_transform"]) == 4 else 3
        _matrix(meta["applied_transform"], f"{path}: applied_transform", rows)
    if meta.get("applied_scale") == 0:
        raise InputError(f"{path}: applied_scale is 0, expected a number above. Repair the file.")
    if meta.get("ply_file_path") is not None:
        path_inside(path.parent, meta["ply_file_path"], f"{path}: ply_file_path")
    for split in ("train", "val", "test"):
        names = meta.get(f"{split}_filenames", [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {split}_filenames is {shown(names)}, expected a list of file_paths.")
    _check_shifted(meta.get("shifted_views", {}), path)


def _check_shifted(views: Any, path: Path) -> None:
    """The true views beside the path that synthetic drives have."""
    wrong = InputError(f"{path}: shifted_views are none; expected lists of views by metres. Process the drive again.")
    if not isinstance(views, dict):
        raise wrong
    for metres, entries in views.items():
        try:
            if abs(float(metres)) > 1e3 or not isinstance(entries, list):
                raise wrong
        except ValueError:
            raise wrong from None
        for number, entry in enumerate(entries):
            where = f"{path}: shifted_views, {metres} m, view {number}"
            if not isinstance(entry, dict) or not isinstance(entry.get("camera"), str):
                raise wrong
            pose_of(entry, where)
            for key in (LAYERS["truth_rgb"].key, LAYERS["truth_distance"].key):
                path_inside(path.parent, entry.get(key), f"{where}: {key}")
