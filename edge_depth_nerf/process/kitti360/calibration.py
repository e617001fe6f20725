"""KITTI-360's calibration, poses and timestamps, as its files write them.

Frames: cameras (x right, y down, z forward), velodyne (x forward, y left, z up), pose = the vehicle (x forward,
y right, z down), world (z up). Transforms are 4×4, metres, named a_to_b. All of it is of the unrectified cameras.
Each error names the file and the line.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from edge_depth_nerf.base.bounds import shown, text_lines
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import MEI
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.process.poses import finite_number, transform_of_rows
from edge_depth_nerf.process.recording import RecordedCamera

_MEI_FIELDS = {
    "mirror_parameters": ("xi",),
    "distortion_parameters": ("k1", "k2", "p1", "p2"),
    "projection_parameters": ("gamma1", "gamma2", "u0", "v0"),
}
_DOWNLOAD = "Copy the file again from the data set."
_MAX_YAML_VALUES = 1000
_MAX_FRAME = 10**10
"""Numbers of frames have ten digits."""


def read_rig(calibration: Path, cameras: tuple[str, ...]) -> tuple[dict[str, RecordedCamera], Transform]:
    """Read what the folder `calibration` says of some fisheye cameras and the scanner.

    Returns:
        The cameras by name, at their full size, and the transform from the scanner's frame to the vehicle's.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a file is truncated or holds something else.
    """
    pose_file = calibration / "calib_cam_to_pose.txt"
    camera_to_pose = read_cam_to_pose(pose_file)
    for name in ("image_00", *cameras):
        if name not in camera_to_pose:
            raise InputError(
                f"{pose_file}: has no line for {name}, only for {', '.join(camera_to_pose) or 'nothing'}. {_DOWNLOAD}"
            )
    cam0_to_velo = read_cam_to_velo(calibration / "calib_cam_to_velo.txt")
    found = {
        name: RecordedCamera(name, read_mei_camera(calibration / f"{name}.yaml"), camera_to_pose[name])
        for name in cameras
    }
    return found, camera_to_pose["image_00"] @ np.linalg.inv(cam0_to_velo)


def read_mei_camera(path: Path) -> MEI:
    """Read image_02.yaml or image_03.yaml: OpenCV's dialect of YAML, a MEI camera with integer pixel centres.

    Returns:
        The camera with pixel centres at +0.5: cx = u0 + 0.5.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: broken, truncated, or another camera model.
    """
    values, lines = _read_yaml(path)

    def text(key: str) -> tuple[int, str]:
        if key not in values:
            raise InputError(
                f"{path}: ends after line {lines} without {key}; expected a MEI camera's parameters. The file is "
                f"truncated or for another camera. {_DOWNLOAD}"
            )
        return values[key]

    def number(*keys: str) -> float:
        key = ".".join(keys)
        line, word = text(key)
        return finite_number(word, f"{path}, line {line}: {key}", _DOWNLOAD)

    line, model = text("model_type")
    if model.strip("\"'") != "MEI":
        raise InputError(
            f"{path}, line {line}: model_type is not MEI. Only KITTI-360's fisheye cameras image_02 and image_03 can "
            "be read."
        )
    xi, k1, k2, p1, p2, gamma1, gamma2, u0, v0 = (
        number(group, key) for group, keys in _MEI_FIELDS.items() for key in keys
    )
    width, height = number("image_width"), number("image_height")
    for key, size in (("image_width", width), ("image_height", height)):
        if size % 1:
            raise InputError(f"{path}, line {values[key][0]}: {key} is {size:g}, expected a whole number. {_DOWNLOAD}")
    for key, centre, size in (("u0", u0, width), ("v0", v0, height)):
        # a number that lost its last digits, or its exponent, is still a number
        if not 0.25 * size <= centre <= 0.75 * size:
            line, _ = values[f"projection_parameters.{key}"]
            raise InputError(
                f"{path}, line {line}: {key} is {centre:g}, which is not in the middle half of a "
                f"picture of {size:g} pixels. The file is truncated or of another camera. {_DOWNLOAD}"
            )
    try:
        # KITTI-360 counts integer pixel centres
        return MEI(int(width), int(height), gamma1, gamma2, u0 + 0.5, v0 + 0.5, xi, k1, k2, p1, p2)
    except InputError as error:
        raise InputError(f"{path}: {error} {_DOWNLOAD}") from None


def read_cam_to_pose(path: Path) -> dict[str, Transform]:
    """Read calib_cam_to_pose.txt: a line "image_00: r11 r12 r13 t1 …" for each camera.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is not a name and 12 numbers that are a rotation and a translation.
    """
    transforms = {}
    for number, line in _lines(path):
        name, colon, rest = line.partition(":")
        if not colon:
            raise InputError(f"{path}, line {number}: expected 'image_00: ' and 12 numbers. {_DOWNLOAD}")
        if name.strip() in transforms:
            raise InputError(f"{path}, line {number}: {shown(name.strip())} occurs twice. {_DOWNLOAD}")
        transforms[name.strip()] = _transform(rest, path, number)
    return transforms


def read_cam_to_velo(path: Path) -> Transform:
    """Read calib_cam_to_velo.txt: one line of 12 numbers, unrectified camera 0 to the scanner.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not one line of 12 numbers that are a rotation and a translation.
    """
    lines = list(_lines(path))
    if len(lines) != 1:
        raise InputError(f"{path}: {len(lines)} lines with text, expected one with 12 numbers. {_DOWNLOAD}")
    return _transform(lines[0][1], path, lines[0][0])


def read_poses(path: Path) -> dict[int, Transform]:
    """Read poses.txt: lines "frame r11 r12 r13 t1 …", the vehicle's pose in the world; not every frame has one.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is not a frame and 12 numbers, or a frame has two poses.
    """
    poses: dict[int, Transform] = {}
    for number, line in _lines(path):
        first, rest = (*line.split(maxsplit=1), "")[:2]
        frame = finite_number(first, f"{path}, line {number}", _DOWNLOAD)
        if frame != int(frame) or not 0 <= frame < _MAX_FRAME:
            raise InputError(f"{path}, line {number}: {shown(first)} is not a frame number. {_DOWNLOAD}")
        if int(frame) in poses:
            raise InputError(f"{path}, line {number}: frame {int(frame)} has a pose already. {_DOWNLOAD}")
        poses[int(frame)] = _transform(rest, path, number)
    if not poses:
        raise InputError(f"{path}: no poses in it. {_DOWNLOAD}")
    return poses


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with something in them, counted from 1."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file. It is part of the data set's calibration, poses or timestamps.")
    return text_lines(path)


def _read_yaml(path: Path) -> tuple[dict[str, tuple[int, str]], int]:
    """Read the part of OpenCV's YAML that KITTI-360 uses: values, and tables of values.

    A general parser does more than is wanted: aliases that multiply, tags that build objects, depth without end.

    Returns:
        Line and text of each value by its dotted name; and the number of the last line.
    """
    values: dict[str, tuple[int, str]] = {}
    group, last = "", 0
    for last, line in _lines(path):
        if line.startswith(("%", "#", "---", "...")):
            continue
        key, colon, value = (part.strip() for part in line.partition(":"))
        if not colon:
            raise InputError(f"{path}, line {last}: Missing ':'; expected OpenCV's YAML with a MEI camera. {_DOWNLOAD}")
        if not value:
            group = key
            continue
        name = f"{group}.{key}" if key in _MEI_FIELDS.get(group, ()) else key
        if name in values:
            raise InputError(f"{path}, line {last}: {shown(name)} occurs twice. {_DOWNLOAD}")
        values[name] = last, value
        if len(values) > _MAX_YAML_VALUES:
            raise InputError(f"{path}: more than {_MAX_YAML_VALUES} values; expected a MEI camera's. {_DOWNLOAD}")
    if not values:
        raise InputError(f"{path}: nothing in it; expected OpenCV's YAML with a MEI camera. {_DOWNLOAD}")
    return values, last


def _transform(text: str, path: Path, line: int) -> Transform:
    numbers = [finite_number(word, f"{path}, line {line}", _DOWNLOAD) for word in text.split()]
    if len(numbers) != 12:
        raise InputError(
            f"{path}, line {line}: {len(numbers)} numbers, expected 12 (the 3×4 matrix of rotation and translation, "
            f"row by row). {_DOWNLOAD}"
        )
    return transform_of_rows(np.reshape(numbers, (3, 4)), f"{path}, line {line}")
