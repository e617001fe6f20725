"""Poses by COLMAP: the vehicle's path from the pictures alone, its scale from LiDAR.

`colmap_models` runs COLMAP, `colmap_scale` makes metres of what it finds. The world has z up, after the scanner's
own z axis, averaged over the drive (or the cameras' -y axes without a scanner); the first pose is its origin, and the
vehicle drives off along x.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.colmap.models import (
    THETA_MAX_DEG,
    ColmapModel,
    check_folder,
    colmap_lens,
    find_models,
    import_pycolmap,
)
from edge_depth_nerf.process.colmap.scale import MetricPath, Scale, metric_path
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.scene.writer import Skipped

NOT_REGISTERED = "COLMAP could not register it"
_MIN_PICTURES = 3
_ASKEW_RAD = math.radians(3)
_WARN_SPREAD = 0.10
_WARN_ERROR_PX = 2.0
_WARN_APART_M = 0.2


def colmap_poses(recording: Recording, options: ProcessOptions, console: Console) -> Recording:
    """Find the poses of a recording's pictures.

    Args:
        recording: its trajectory and its pictures' poses, if any, are not used; its rig, lenses, masks, and the
            sweeps or depth maps of its moments are.
        options: output, beside which COLMAP works in the folder `.NAME.colmap`, and theta_max_deg.
        console: where the progress is shown.

    Returns:
        The recording with the vehicle's path in metres and with the pictures whose pose was found; the others are
        listed in `skipped`. Notices say how many there are, the scale and its spread, and COLMAP's error.

    Raises:
        InputError: pycolmap is not installed, there are fewer than three pictures, no LiDAR, nothing could be
            related, or LiDAR and the reconstruction share too little for a scale.

    """
    check_colmap(recording, options)
    models = find_models(recording, options, _folder(options), console)
    models = [model for model in models if _spans(recording, model) and model.placed()]
    if not models:
        cameras = ", ".join(camera.name for camera in recording.cameras)
        raise InputError(
            f"--poses colmap: COLMAP found no poses for the {len(recording.pictures)} pictures of {cameras}. Take more "
            "frames, closer together (--stride 1), of a stretch where the vehicle moves and the pictures show texture; "
            "and check the calibration of the lenses and the masks."
        )
    path, scale = metric_path(recording, models)
    trajectory = _upright(recording, path.trajectory)
    poses = dict(zip(path.moments, trajectory.vehicle_to_world, strict=True))
    to_vehicle = {camera.name: camera.to_vehicle for camera in recording.cameras}
    kept, skipped = [], []
    for picture in recording.pictures:
        if picture.frame not in poses:
            skipped.append(Skipped(picture.frame, picture.camera, NOT_REGISTERED))
            continue
        vehicle_to_world = trajectory.at(np.array([picture.time_s]))[0]
        kept.append(dataclasses.replace(picture, camera_to_world=vehicle_to_world @ to_vehicle[picture.camera]))
    return dataclasses.replace(
        recording,
        pictures=tuple(kept),
        trajectory=trajectory,
        skipped=(*recording.skipped, *skipped),
        notices=(*recording.notices, *_notices(recording, models, path, scale, len(kept))),
        # their poses are of the world that the drive was written in
        shifted=(),
    )


def _folder(options: ProcessOptions) -> Path:
    """Where COLMAP works: beside the scene."""
    output = options.output.absolute()
    return output.with_name(f".{output.name}.colmap")


def check_colmap(recording: Recording, options: ProcessOptions) -> None:
    """Check what can be checked before the long work.

    Raises:
        InputError: pycolmap is missing, there are too few pictures or none with LiDAR, a lens has no counterpart in
            COLMAP, or the folder to work in holds something else.

    """
    import_pycolmap()
    check_folder(_folder(options))
    for camera in recording.cameras:
        colmap_lens(camera.camera, math.radians(min(options.theta_max_deg, THETA_MAX_DEG)))
    found = len(recording.pictures)
    if found < _MIN_PICTURES:
        raise InputError(
            f"--poses colmap: {found} picture{'' if found == 1 else 's'}, expected {_MIN_PICTURES} or more: poses come "
            "from what several pictures have in common. Take more frames."
        )
    with_lidar = {sweep.frame for sweep in recording.sweeps}
    if not any(picture.depth is not None or picture.frame in with_lidar for picture in recording.pictures):
        raise InputError(
            "--poses colmap: none of the pictures has a LiDAR sweep or a depth map, which COLMAP's scale is found "
            "from. Take frames with LiDAR, or use the poses of the recording (--poses recorded)."
        )


def _spans(recording: Recording, model: ColmapModel) -> bool:
    """Whether some camera of a model was found at two moments or more."""
    seen = [recording.pictures[index].camera for index in model.camera_to_model]
    return any(seen.count(camera.name) > 1 for camera in recording.cameras)


def _upright(recording: Recording, trajectory: Trajectory) -> Trajectory:
    """Turn and shift a path so that z is up, the first pose the origin, and the drive starts along x."""
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
    to_world = np.eye(4)
    to_world[:3, :3] = np.stack((ahead, np.cross(up, ahead), up))
    to_world[:3, 3] = -to_world[:3, :3] @ positions[0]
    return Trajectory(trajectory.times_s, to_world @ trajectory.vehicle_to_world)


def _up_in_vehicle(recording: Recording) -> Float64[np.ndarray, "3"]:
    scanners = {sweep.scanner: sweep.to_vehicle for sweep in recording.sweeps}
    if scanners:
        up = np.sum([to_vehicle[:3, 2] for to_vehicle in scanners.values()], axis=0)
    else:
        up = -np.sum([camera.to_vehicle[:3, 1] for camera in recording.cameras], axis=0)
    up /= np.linalg.norm(up)
    # scanners sit on a vehicle a little askew; its own frame has an upright axis, which one depends on the recording
    axis = np.zeros(3)
    nearest = int(np.abs(up).argmax())
    axis[nearest] = np.sign(up[nearest])
    return axis if up @ axis >= math.cos(_ASKEW_RAD) else up


def _notices(recording: Recording, models: list[ColmapModel], path: MetricPath, scale: Scale, posed: int) -> list[str]:
    members = path.members
    registered = {index for model in members for index in model.camera_to_model}
    total = len(recording.pictures)
    notices = [
        f"COLMAP registered {len(registered)} of {total} pictures"
        + (f", {posed - len(registered)} more have their pose through the rig" if posed > len(registered) else "")
        + f": {sum(model.points for model in members)} points, mean reprojection error "
        f"{max(model.error_px for model in members):.2f} px"
        + (f", {len(members)} models joined by the rig" if len(members) > 1 else "")
        + "."
    ]
    step = float(np.linalg.norm(np.diff(path.trajectory.vehicle_to_world[:, :3, 3], axis=0), axis=-1).sum())
    notices.append(
        f"Scale of COLMAP's poses from LiDAR: {scale.ratio:.4f} m per unit, spread {100 * scale.spread:.1f} % (half "
        f"the interquartile range of {scale.pairs} points' distances); the path is {step:.1f} m long"
        + (
            f"; the cameras agree on the vehicle's place within {100 * path.disagreement_m:.1f} cm (median)."
            if np.isfinite(path.disagreement_m)
            else "."
        )
    )
    left = len(models) - len(members)
    if left:
        notices.append(
            f"{left} more of COLMAP's models could not be joined with the largest (too few moments in common, or too "
            "few points with LiDAR beside them); what only they hold counts as not registered."
        )
    if recording.shifted:
        notices.append("The drive's true views from beside the path are left out: COLMAP's world is another.")
    if path.disagreement_m > _WARN_APART_M:
        notices.append(
            "The cameras do not agree on where the vehicle is: check where the calibration puts them on it, and the "
            "times of the pictures."
        )
    if scale.spread > _WARN_SPREAD:
        notices.append(
            f"The spread of the scale is large ({100 * scale.spread:.0f} %): check the calibration between LiDAR and "
            "cameras, and the times of the sweeps."
        )
    if max(model.error_px for model in members) > _WARN_ERROR_PX:
        notices.append("COLMAP's reprojection error is large: check the calibration of the lenses.")
    return notices
