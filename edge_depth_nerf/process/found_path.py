"""What a path that was found becomes, whether from pictures or from LiDAR: a world, and the poses of the pictures.

The world has z up, after the scanner's own z axis, averaged over the drive (or the cameras' -y axes without a
scanner); the first pose is its origin, and the vehicle drives off along x.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.scene.writer import Skipped

_ASKEW_RAD = math.radians(3)


def with_path(
    recording: Recording, trajectory: Trajectory, lacking: Callable[[RecordedPicture], str | None]
) -> Recording:
    """Give a recording a path, and its pictures the poses on it.

    Args:
        recording: its trajectory and its pictures' poses, if any, are replaced.
        trajectory: the vehicle's path.
        lacking: why a picture has no place on it; None = it has. The others are listed in `skipped`.
    """
    to_vehicle = {camera.name: camera.to_vehicle for camera in recording.cameras}
    kept, skipped = [], []
    for picture in recording.pictures:
        if reason := lacking(picture):
            skipped.append(Skipped(picture.frame, picture.camera, reason))
            continue
        vehicle_to_world = trajectory.at(np.array([picture.time_s]))[0]
        kept.append(dataclasses.replace(picture, camera_to_world=vehicle_to_world @ to_vehicle[picture.camera]))
    beside = ("The drive's true views beside the path are left out, because they belong to other poses.",)
    return dataclasses.replace(
        recording,
        pictures=tuple(kept),
        trajectory=trajectory,
        skipped=(*recording.skipped, *skipped),
        notices=(*recording.notices, *(beside if recording.shifted else ())),
        # their poses are of the world that the drive was written in
        shifted=(),
    )


def with_all_cameras(found: Recording, whole: Recording) -> Recording:
    """Give a recording whose poses were found by some of its cameras the pictures of the others, of the same frames."""
    assert found.trajectory is not None
    reasons = {item.frame: item.reason for item in found.skipped}
    frames = {picture.frame for picture in found.pictures}
    every = with_path(
        whole, found.trajectory, lambda p: None if p.frame in frames else reasons.get(p.frame, "no pose was found")
    )
    return dataclasses.replace(found, cameras=whole.cameras, pictures=every.pictures, skipped=every.skipped)


def path_length_m(trajectory: Trajectory) -> float:
    """How far it is along a path, from pose to pose."""
    return float(np.linalg.norm(np.diff(trajectory.vehicle_to_world[:, :3, 3], axis=0), axis=-1).sum())


def upright(recording: Recording, trajectory: Trajectory) -> Trajectory:
    """Turn and shift a path so that z is up, the first pose the origin, and the drive starts along x.

    Args:
        recording: whose scanners, or cameras where it has none, say which way is up.
        trajectory: the vehicle's path in any world, in metres.
    """
    rotations = trajectory.vehicle_to_world[:, :3, :3]
    up = (rotations @ _up_in_vehicle(recording)).mean(0)
    up /= np.linalg.norm(up)
    positions = trajectory.vehicle_to_world[:, :3, 3]
    away = positions - positions[0]
    # horizontally, towards the first place that is half as far as the furthest
    away = away - (away @ up)[:, None] * up
    reach = np.linalg.norm(away, axis=-1)
    ahead = away[int(np.argmax(reach >= reach.max() / 2))] if reach.max() > 0 else np.cross(up, rotations[0, :, 0])
    ahead = ahead / np.linalg.norm(ahead)
    turn = np.stack((ahead, np.cross(up, ahead), up))
    return Trajectory(trajectory.times_s, rigid(turn, -turn @ positions[0]) @ trajectory.vehicle_to_world)


def _up_in_vehicle(recording: Recording) -> Float64[np.ndarray, "3"]:
    scanners = {sweep.scanner: sweep.to_vehicle for sweep in recording.sweeps}
    up = of_cameras = -np.sum([camera.to_vehicle[:3, 1] for camera in recording.cameras], axis=0)
    if scanners:
        axes = [to_vehicle[:3, 2] for to_vehicle in scanners.values()]
        # one may hang head down
        up = np.sum([-axis if axis @ of_cameras < 0 else axis for axis in axes], axis=0)
    up /= np.linalg.norm(up)
    # scanners sit on a vehicle a little askew; its own frame has an upright axis, which one depends on the recording
    axis = np.zeros(3)
    nearest = int(np.abs(up).argmax())
    axis[nearest] = np.sign(up[nearest])
    return axis if up @ axis >= math.cos(_ASKEW_RAD) else up
