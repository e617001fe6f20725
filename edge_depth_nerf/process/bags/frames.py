"""Frames of ROS: where sensors are mounted, and where the vehicle was.

A transform of ROS maps points of its child's frame to its header's frame: it is the child's pose there. Frames form a
tree; a chain from one to the other may go up and down. Transforms are 4×4, metres, named a_to_b.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.lidar.trajectory import Trajectory

Edge = tuple[str, str]
"""Parent and child."""
VEHICLE_FRAMES = ("base_link", "base_footprint", "ego_vehicle", "vehicle", "body", "imu_link", "imu")
"""What the vehicle's frame is called, where nothing tells."""
_UNIT = 1e-2
"""How far the length of a quaternion may be from 1; they are brought to 1."""
_SAME = 1e-6
"""A transform that never changes by more, in metres and in the quaternion's parts, is a mounting."""
_MOST_GAP_S = 2.5
"""Fixes that are farther apart are not joined."""
_A, _E2 = 6378137.0, 6.69437999014e-3
"""WGS 84: the earth's larger radius, and its eccentricity squared."""


def name_of(frame: str) -> str:
    """A frame's name; old drivers write a slash before it."""
    return frame.lstrip("/")


@dataclass
class Poses:
    """Poses over time, collected one by one; those that are none are counted."""

    values: array = field(default_factory=lambda: array("d"))
    """Time (s), x, y, z, qx, qy, qz, qw, one pose after another."""
    broken: int = 0
    """How many had no unit quaternion, or no numbers."""

    def add(self, time_ns: int, place: Any, turn: Any) -> None:
        """Append a pose of a position and a quaternion of ROS."""
        self._append(time_ns, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def add_place(self, time_ns: int, *place: float) -> None:
        """Append three numbers, with no turn."""
        self._append(time_ns, (*place, 0.0, 0.0, 0.0, 1.0))

    def _append(self, time_ns: int, numbers: tuple[float, ...]) -> None:
        length = float(np.linalg.norm(numbers[3:]))
        if not (np.isfinite(numbers).all() and abs(length - 1) <= _UNIT):
            self.broken += 1
            return
        self.values.extend((time_ns / 1e9, *numbers[:3], *(part / length for part in numbers[3:])))

    @property
    def table(self) -> Float64[np.ndarray, "poses 8"]:
        """All of them, in order of time, one for each time."""
        table = np.array(self.values, np.float64).reshape(-1, 8)
        return table[np.unique(table[:, 0], return_index=True)[1]]

    @property
    def is_constant(self) -> bool:
        """Whether nothing moves."""
        table = self.table
        return bool(len(table)) and bool((np.ptp(table[:, 1:], axis=0) <= _SAME).all())


def matrices(table: Float64[np.ndarray, "poses 8"]) -> Float64[np.ndarray, "poses 4 4"]:
    """Poses as transforms."""
    if not len(table):
        return np.empty((0, 4, 4))
    return rigid(Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4])


def mounting(edges: Mapping[Edge, Transform], source: str, target: str) -> Transform | None:
    """The transform from a frame to another along mountings, up and down; None without a chain."""
    found = {source: np.eye(4)}
    reached = [source]
    for frame in reached:
        for (parent, child), child_to_parent in edges.items():
            if child == frame and parent not in found:
                found[parent] = child_to_parent @ found[frame]
                reached.append(parent)
            elif parent == frame and child not in found:
                found[child] = np.linalg.inv(child_to_parent) @ found[frame]
                reached.append(child)
    return found.get(target)


def path_of(
    moving: Mapping[Edge, Poses], fixed: Mapping[Edge, Transform], vehicle: str
) -> tuple[Float64[np.ndarray, "poses"], Float64[np.ndarray, "poses 4 4"], str] | None:
    """The vehicle's poses in the topmost frame above it, at the times of the fastest edge, and that frame's name.

    None if nothing between them moves.
    """
    parents = {child: parent for parent, child in (*moving, *fixed)}
    above = [vehicle]
    while (parent := parents.get(above[-1])) is not None and parent not in above:
        above.append(parent)
    way = list(zip(above[1:], above, strict=False))
    paths = {edge: poses.table for edge in way if (poses := moving.get(edge)) is not None}
    if not paths or min(map(len, paths.values())) < 2:
        return None
    times_s = max(paths.values(), key=len)[:, 0]
    first, last = max(table[0, 0] for table in paths.values()), min(table[-1, 0] for table in paths.values())
    times_s = times_s[(times_s >= first) & (times_s <= last)]
    found = np.tile(np.eye(4), (len(times_s), 1, 1))
    for edge in way:
        table = paths.get(edge)
        step = fixed[edge] if table is None else Trajectory(table[:, 0], matrices(table)).at(times_s)
        found = step @ found
    return times_s, found, above[-1]


def by_satellite(
    fixes: Float64[np.ndarray, "fixes 4"],
    turns: Float64[np.ndarray, "turns 5"],
    antenna_to_vehicle: Transform,
    imu_to_vehicle: Transform,
) -> tuple[Float64[np.ndarray, "poses"], Float64[np.ndarray, "poses 4 4"]]:
    """The vehicle's poses by satellite fixes and the IMU's orientations, in a world of east, north and up.

    Its origin is the first fix, on the ellipsoid of WGS 84. There is a pose for each fix and each orientation. Between
    fixes the antenna follows a spline, as they may be a second apart; there are no poses where fixes are missing.

    Args:
        fixes: time (s), latitude and longitude (degrees), altitude (m) of the antenna.
        turns: time (s) and quaternion (x, y, z, w) of the IMU, by ROS from east.
        antenna_to_vehicle: where the antenna is.
        imu_to_vehicle: where the IMU is.
    """
    if len(turns) > 1:
        fixes = fixes[(fixes[:, 0] >= turns[0, 0]) & (fixes[:, 0] <= turns[-1, 0])]
    runs = np.split(fixes, np.flatnonzero(np.diff(fixes[:, 0]) > _MOST_GAP_S) + 1)
    runs = [run for run in runs if len(run) > 1]
    if len(turns) < 2 or not runs:
        return np.empty(0), np.empty((0, 4, 4))
    axes = _east_north_up(*np.radians(runs[0][0, 1:3]))
    origin, times, places = _on_earth(runs[0][:1]), [], []
    for run in runs:
        inside = turns[(turns[:, 0] >= run[0, 0]) & (turns[:, 0] <= run[-1, 0]), 0]
        times.append(np.union1d(inside, run[:, 0]))
        places.append(CubicSpline(run[:, 0], (_on_earth(run) - origin) @ axes.T)(times[-1]))
    times_s = np.concatenate(times)
    imu_to_world = Slerp(turns[:, 0], Rotation.from_quat(turns[:, 1:]))(times_s).as_matrix()
    turn = imu_to_world @ imu_to_vehicle[:3, :3].T
    return times_s, rigid(turn, np.concatenate(places) - turn @ antenna_to_vehicle[:3, 3])


def _on_earth(fixes: Float64[np.ndarray, "fixes 4"]) -> Float64[np.ndarray, "fixes 3"]:
    """Fixes in metres from the earth's centre."""
    latitude, longitude = np.radians(fixes[:, 1]), np.radians(fixes[:, 2])
    radius = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    flat = (radius + fixes[:, 3]) * np.cos(latitude)
    up_axis = (radius * (1 - _E2) + fixes[:, 3]) * np.sin(latitude)
    return np.stack((flat * np.cos(longitude), flat * np.sin(longitude), up_axis), -1)


def _east_north_up(lat: float, lon: float) -> Float64[np.ndarray, "3 3"]:
    """These directions at a place (radians), a row each, in the earth's frame."""
    return np.array(
        [
            [-np.sin(lon), np.cos(lon), 0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
