"""The poses of a film's camera: along the drive, beside it, or around a point.

Frames: the scene (metres) and a camera with OpenGL's axes (x right, y up, z backward); transforms are 4×4, float64.
Times are seconds of one clock. The vehicle's motion is that of one camera, which is fixed to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.lidar.trajectory import check_times

EASE = 0.25
"""Share of a shifted film in which the camera moves aside. It moves back during the same share at the end."""
Z_IS_UP_WITHIN_DEG = 25.0
"""The scene's z is used as up if it is within this angle of the cameras' mean up."""
LEAST_RADIUS_M = 1.0
"""The vehicle itself occupied the space within this distance of the path."""
CLEARANCE_M = 1.0
"""An orbit keeps this distance from LiDAR points."""
OBSTACLE_BAND_M = 1.0
"""Only points within this height above and below the camera block an orbit: not the road, and not the treetops."""
STRAY_POINTS = 4
"""This many nearest points are ignored as outliers."""

Poses = Float64[np.ndarray, "poses 4 4"]
Direction = Float64[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The path of one camera through a scene.

    Raises:
        InputError: fewer than two poses, or times that do not increase.
    """

    times_s: Float64[np.ndarray, "poses"]
    """Increasing."""
    camera_to_scene: Poses
    up: Direction
    """Unit vector upwards, in the scene."""

    def __post_init__(self) -> None:
        check_times(self.times_s, "picture")

    @property
    def duration_s(self) -> float:
        """Time from the first picture to the last."""
        return float(self.times_s[-1] - self.times_s[0])

    @property
    def frame_rate_hz(self) -> float:
        """Pictures per second, from the median time between two pictures."""
        return float(1 / np.median(np.diff(self.times_s)))

    @cached_property
    def vehicle_in_camera(self) -> Float64[np.ndarray, "3 3"]:
        """Unit vectors forward, left and up of the vehicle, as columns, in the camera's axes.

        They are the same for the whole drive, because the camera is fixed to the vehicle. Forward is the mean direction
        of the camera's motion, so it is known even if the vehicle stands or reverses for a while.

        Raises:
            InputError: the camera does not move.
        """
        rotation, position = self.camera_to_scene[:, :3, :3], self.camera_to_scene[:, :3, 3]
        up = np.einsum("nji,j->i", rotation, self.up)
        up /= np.linalg.norm(up)
        step = np.diff(position, axis=0)
        forward = np.einsum("nji,nj->i", rotation[:-1], step)
        forward -= (forward @ up) * up
        length = np.linalg.norm(forward)
        if not length > 1e-3 * max(1.0, float(np.abs(position).max())):
            raise InputError(
                "the drive's camera does not move, so its direction is unknown. Use --kind replay --camera fisheye."
            )
        forward /= length
        return np.stack((forward, np.cross(up, forward), up), axis=1)

    @cached_property
    def _splines(self) -> tuple[CubicSpline, RotationSpline]:
        rotations = Rotation.from_matrix(self.camera_to_scene[:, :3, :3])
        return CubicSpline(self.times_s, self.camera_to_scene[:, :3, 3]), RotationSpline(self.times_s, rotations)

    def at(self, times_s: Float64[np.ndarray, "times"]) -> Float64[np.ndarray, "times 4 4"]:
        """The camera's poses at some times within the drive.

        At the drive's own times they are exactly its poses. Between them they are smooth (twice differentiable).
        """
        position, rotation = self._splines
        return rigid(rotation(times_s).as_matrix(), position(times_s))


def up_of(rotations: Float64[np.ndarray, "poses 3 3"]) -> Direction:
    """The up direction of a scene: z if the cameras (OpenGL's axes) agree with it, else their mean up."""
    mean = rotations[:, :, 1].mean(axis=0)
    z = np.array([0.0, 0.0, 1.0])
    length = float(np.linalg.norm(mean))
    # cameras that look down in all directions, or lie on their side, have no mean up
    if length < 0.1 or mean @ z >= length * np.cos(np.radians(Z_IS_UP_WITHIN_DEG)):
        return z
    return mean / length


def replay(drive: CameraPath, times_s: Float64[np.ndarray, "times"], forward: bool) -> Float64[np.ndarray, "times 4 4"]:
    """Poses along the recorded path at the film's times, camera to scene.

    `forward` looks in the direction of travel, not in that of the drive's camera.
    """
    poses = drive.at(times_s)
    if forward:
        ahead, left, up = drive.vehicle_in_camera.T
        poses[:, :3, :3] = poses[:, :3, :3] @ np.stack((-left, up, -ahead), axis=1)
    return poses


def lane_shift(
    drive: CameraPath, times_s: Float64[np.ndarray, "times"], forward: bool, shift_m: float
) -> Float64[np.ndarray, "times 4 4"]:
    """Poses beside the recorded path: moving aside in the film's first quarter, and back in its last.

    `shift_m` is the largest offset to the vehicle's left; negative to the right. All else is as in `replay`.
    """
    poses = replay(drive, times_s, forward)
    left = drive.at(times_s)[:, :3, :3] @ drive.vehicle_in_camera[:, 1]
    share = (times_s - times_s[0]) / (times_s[-1] - times_s[0])
    poses[:, :3, 3] += (shift_m * _ease(np.minimum(share, 1 - share) / EASE))[:, None] * left
    return poses


def orbit(
    drive: CameraPath,
    frames: int,
    ahead_m: float,
    largest_radius_m: float,
    points_m: Float[np.ndarray, "points 3"] | None,
) -> tuple[Poses, float]:
    """Poses on a level circle around a point of the drive's path, looking at the point.

    The point is on the path, some metres after its middle, so the vehicle has been there. The circle starts behind the
    point and runs counter-clockwise, seen from above. It is as wide as requested, unless LiDAR points lie within it.
    Without LiDAR points it stays where the vehicle itself has been.

    Args:
        drive: the camera's path.
        frames: number of the film's pictures; one more would repeat the first.
        ahead_m: distance from the middle of the path to the point, along the path.
        largest_radius_m: the largest radius of the circle.
        points_m: LiDAR points in the scene.

    Returns:
        Camera to scene, and the circle's radius in metres.

    Raises:
        InputError: the camera does not move.
    """
    position = drive.camera_to_scene[:, :3, 3]
    driven_m = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))))
    heading = drive.camera_to_scene[:, :3, :3] @ drive.vehicle_in_camera[:, 0]
    reached_m = min(driven_m[-1] / 2 + ahead_m, driven_m[-1])
    time_s = np.interp(reached_m, driven_m, drive.times_s)
    centre = drive.at(np.array([time_s]))[0, :3, 3]
    ahead = heading[np.argmin(np.abs(drive.times_s - time_s))]
    ahead = ahead - (ahead @ drive.up) * drive.up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(drive.up, ahead)

    free_m = _free_radius_m(centre, drive.up, points_m)
    radius_m = float(np.clip(free_m - CLEARANCE_M, min(LEAST_RADIUS_M, largest_radius_m), largest_radius_m))
    angle = np.linspace(0, 2 * np.pi, frames, endpoint=False)[:, None]
    outward = -np.cos(angle) * ahead + np.sin(angle) * -left
    right = np.cross(-outward, drive.up)
    rotation = np.stack((right, np.broadcast_to(drive.up, right.shape), outward), axis=2)
    return rigid(rotation, centre + radius_m * outward), radius_m


def _free_radius_m(centre: Direction, up: Direction, points_m: Float[np.ndarray, "points 3"] | None) -> float:
    """Return the level distance from a point to the nearest LiDAR points; 0 if that is unknown."""
    if points_m is None:
        return 0.0
    offset = points_m - centre
    height = offset @ up
    level = offset[np.abs(height) <= OBSTACLE_BAND_M]
    distance = np.linalg.norm(level - (level @ up)[:, None] * up, axis=1)
    if len(distance) <= STRAY_POINTS:
        return float("inf") if len(points_m) > STRAY_POINTS else 0.0
    return float(np.partition(distance, STRAY_POINTS)[STRAY_POINTS])


def _ease(share: np.ndarray) -> np.ndarray:
    """Rise from 0 at 0 to 1 at 1, with zero speed at both ends."""
    share = np.clip(share, 0, 1)
    return share**2 * (3 - 2 * share)
