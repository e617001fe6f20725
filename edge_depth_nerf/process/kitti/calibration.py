"""KITTI's calibration and its poses by GPS and IMU, as the files of its raw data and odometry benchmark write them.

Frames: cameras (x right, y down, z forward), velodyne and IMU (x forward, y left, z up), world (x east, y north, z up).
Transforms are 4×4, metres, named a_to_b. Each error names the file.

A rectified picture is P · (x, y, z, 1), with x, y, z in the rectified camera 0. So P = K · (I | t), and a point p of
that frame is p + t in the camera of P: the fourth column tells where the cameras are. P and S belong to the published
pictures, which are rectified and cropped.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.bounds import shown, text_lines
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.process.poses import finite_number, transform_of_rows

EARTH_RADIUS_M = 6378137.0
"""KITTI's own, of its Mercator projection."""
_AGAIN = "Copy the file again from the data set."

Values = dict[str, Float64[np.ndarray, "values"]]


def read_values(path: Path) -> Values:
    """Read lines "KEY: numbers"; what is no number, such as a date, is left out.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is something else.
    """
    values = {}
    for number, line in text_lines(path):
        key, colon, rest = line.partition(":")
        if not colon:
            raise InputError(f"{path}, line {number}: {shown(line)}, expected a name, a colon and numbers. {_AGAIN}")
        try:
            values[key.strip()] = np.array([float(word) for word in rest.split()], np.float64)
        except ValueError:
            continue
    return values


def matrix_of(values: Values, key: str, shape: tuple[int, int], path: Path) -> Float64[np.ndarray, "rows columns"]:
    """The numbers of a line as a matrix.

    Raises:
        InputError: the line is missing, or has other numbers.
    """
    if key not in values:
        raise InputError(f"{path}: has no line {key}; there are {', '.join(values) or 'none'}. {_AGAIN}")
    found = values[key]
    if found.size != math.prod(shape) or not np.isfinite(found).all():
        raise InputError(f"{path}: {key} has {found.size} numbers, expected {math.prod(shape)}. {_AGAIN}")
    return found.reshape(shape)


def read_rigid(path: Path) -> Transform:
    """Read a file with R and T, such as calib_velo_to_cam.txt.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: no rotation and translation.
    """
    values = read_values(path)
    rows = np.hstack((matrix_of(values, "R", (3, 3), path), matrix_of(values, "T", (3, 1), path)))
    return transform_of_rows(rows, f"{path}: R and T")


def read_projection(values: Values, key: str, path: Path) -> tuple[dict[str, float], Transform]:
    """A camera of rectified pictures from its projection matrix P.

    Returns:
        fx, fy, cx, cy, with the first pixel's centre at 0; and from its frame to that of the rectified camera 0.

    Raises:
        InputError: it is missing, or no projection of a rectified camera.
    """
    projection = matrix_of(values, key, (3, 4), path)
    lens, column = projection[:, :3], projection[:, 3]
    wrong = lens[2].tolist() != [0, 0, 1] or lens[0, 1] != 0 or lens[1, 0] != 0 or min(lens[0, 0], lens[1, 1]) <= 0
    if wrong:
        raise InputError(f"{path}: {key} is no projection of rectified pictures (fx 0 cx; 0 fy cy; 0 0 1). {_AGAIN}")
    to_camera_0 = rigid(np.eye(3), -np.linalg.solve(lens, column))
    return {"fx": lens[0, 0], "fy": lens[1, 1], "cx": lens[0, 2], "cy": lens[1, 2]}, to_camera_0


def read_oxts(folder: Path) -> dict[int, Transform]:
    """Read the poses of the IMU, to the world, by frames: latitude, longitude, altitude, roll, pitch, yaw of each file.

    Positions are KITTI's: Mercator's projection, scaled by the cosine of the first latitude. They count from the first
    pose. The axes of the world stay east, north and up; KITTI's programs turn them to those of the first pose.

    Raises:
        FileNotFoundError: there is no such folder, or nothing in it.
        InputError: a file has something else.
    """
    files = {int(path.stem): path for path in folder.glob("*.txt") if re.fullmatch("[0-9]{10}", path.stem)}
    if not files:
        raise FileNotFoundError(f"{folder}: no files such as 0000000000.txt; the readings of GPS and IMU belong there.")
    poses = {}
    scale, origin_m = 0.0, np.zeros(3)
    for frame, path in sorted(files.items()):
        words = [word for _, line in text_lines(path) for word in line.split()]
        if len(words) < 6:
            raise InputError(f"{path}: {len(words)} numbers, expected latitude, longitude, altitude, roll … {_AGAIN}")
        latitude, longitude, altitude, *angles = (finite_number(word, str(path), _AGAIN) for word in words[:6])
        if not (abs(latitude) < 89 and abs(longitude) <= 360):
            raise InputError(f"{path}: {latitude:g}, {longitude:g} is no latitude and longitude in degrees. {_AGAIN}")
        if not poses:
            scale = math.cos(math.radians(latitude))
        north = math.log(math.tan(math.pi / 4 + math.radians(latitude) / 2))
        place_m = np.array([math.radians(longitude), north, 0.0]) * scale * EARTH_RADIUS_M
        place_m[2] = altitude
        if not poses:
            origin_m = place_m
        # about x, then y, then z of the world
        poses[frame] = rigid(Rotation.from_euler("xyz", angles).as_matrix(), place_m - origin_m)
    return poses
