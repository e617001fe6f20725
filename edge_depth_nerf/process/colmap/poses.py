"""Poses by COLMAP: the vehicle's path from the pictures alone, its scale from LiDAR.

`colmap.models` runs COLMAP, `colmap.scale` makes metres of what it finds, `found_path` chooses the world.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.process.colmap.models import (
    ColmapModel,
    check_folder,
    colmap_lenses,
    find_models,
    import_pycolmap,
)
from edge_depth_nerf.process.colmap.scale import MetricPath, Scale, metric_path
from edge_depth_nerf.process.found_path import path_length_m, upright, with_path
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import Recording

NOT_REGISTERED = "COLMAP could not register it"
_MIN_PICTURES = 3
_WARN_SPREAD = 0.10
_WARN_ERROR_PX = 2.0
_WARN_APART_M = 0.2


def colmap_poses(recording: Recording, options: ProcessOptions, console: Console) -> Recording:
    """Find the poses of a recording's pictures.

    They come from its rig, lenses, masks, and the sweeps or depth maps of its frames alone. COLMAP works in the folder
    `.NAME.colmap` beside the scene.

    Returns:
        The recording with the vehicle's path in metres and with the pictures whose pose was found; the others are
        listed in `skipped`. Notices say how many there are, the scale and its spread, and COLMAP's error.

    Raises:
        InputError: pycolmap is not installed, there are fewer than three pictures, no LiDAR, nothing could be
            related, LiDAR and the reconstruction share too little for a scale, or the path breaks.
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
    _check_path(path, scale)
    trajectory = upright(recording, path.trajectory)
    posed = with_path(recording, trajectory, lambda p: None if p.frame in path.vehicle_poses else NOT_REGISTERED)
    notices = _notices(recording, models, path, scale, len(posed.pictures))
    return dataclasses.replace(posed, notices=(*posed.notices, *notices))


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
    colmap_lenses(recording, options)
    found = len(recording.pictures)
    if found < _MIN_PICTURES:
        raise InputError(
            f"--poses colmap: {found} picture{'' if found == 1 else 's'}, expected {_MIN_PICTURES} or more: poses "
            "are computed from the overlap of several pictures. Use more frames."
        )
    with_lidar = {sweep.frame for sweep in recording.sweeps}
    if not any(picture.depth is not None or picture.frame in with_lidar for picture in recording.pictures):
        raise InputError(
            "--poses colmap: none of the pictures has a LiDAR sweep or a depth map, which COLMAP's scale is "
            "computed from. Use frames with LiDAR, or the poses of the recording (--poses recorded)."
        )


def _spans(recording: Recording, model: ColmapModel) -> bool:
    """Whether some camera of a model was found at two frames or more."""
    seen = [recording.pictures[index].camera for index in model.camera_to_model]
    return any(seen.count(camera.name) > 1 for camera in recording.cameras)


def _check_path(path: MetricPath, scale: Scale) -> None:
    """Raise an InputError that names the frames where the path's scale, or its steps, break."""
    frames, found = list(path.vehicle_poses), scale.broken
    if found is not None:
        first, last = found.first, found.last
        why = (
            f"LiDAR's scale goes from {found.before:.2f} to {found.after:.2f} m per unit there, and from "
            f"{found.smallest:.2f} to {found.largest:.2f} along the path"
        )
    elif (broken := find_break(path.trajectory)) is not None:
        first, last, why = frames[broken.first], frames[broken.last], broken.what
    else:
        return
    raise InputError(
        f"--poses colmap: COLMAP's path breaks between frames {first} and {last}: {why}. Compute the path "
        "from LiDAR (--poses lidar). Or give COLMAP more information: frames closer together (--stride "
        "1), all cameras, the right lens calibration, masks of moving objects (--frame-masks). Or use "
        "only the frames before or after the break (--first, --frames)."
    )


def _notices(recording: Recording, models: list[ColmapModel], path: MetricPath, scale: Scale, posed: int) -> list[str]:
    members = path.members
    registered = {index for model in members for index in model.camera_to_model}
    total = len(recording.pictures)
    notices = [
        f"COLMAP registered {len(registered)} of {total} pictures"
        + (f", {posed - len(registered)} more get their pose from the rig" if posed > len(registered) else "")
        + f": {sum(model.points for model in members)} points, mean reprojection error "
        f"{max(model.error_px for model in members):.2f} px"
        + (f", {len(members)} models joined by the rig" if len(members) > 1 else "")
        + "."
    ]
    length_m = path_length_m(path.trajectory)
    notices.append(
        f"Scale of COLMAP's poses from LiDAR: {scale.ratio:.4f} m per unit, spread {100 * scale.spread:.1f} % (half "
        f"the interquartile range of {scale.pairs} points' distances); the path is {length_m:.1f} m long"
        + (
            f"; the cameras agree on the vehicle's place within {100 * path.disagreement_m:.1f} cm (median)."
            if np.isfinite(path.disagreement_m)
            else "."
        )
    )
    left = len(models) - len(members)
    if left:
        notices.append(
            f"{left} more of COLMAP's models could not be joined with the largest (too few frames in common, or too "
            "few points with LiDAR next to them). Pictures in these models only count as not registered."
        )
    if path.disagreement_m > _WARN_APART_M:
        notices.append(
            "The cameras disagree on the vehicle's position: check their mounting in the calibration, and the "
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
