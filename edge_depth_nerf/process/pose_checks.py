"""How good poses that were found are: held against features of the pictures, and against another way to find them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.poses.matches import along_drive
from edge_depth_nerf.poses.path_agreement import compare_paths, read_agreement, write_agreement
from edge_depth_nerf.process.feature_masks import FeatureMasks, posed_pictures
from edge_depth_nerf.process.lidar_poses import check_sweeps, path_of
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import Recording

_WARN_PX = 2.0
_WARN_APART_M = 0.2
_WARN_APART = 0.02
"""As a share of the path's length."""


def features_say(recording: Recording, options: ProcessOptions, console: Console) -> list[str]:
    """Say how far features of successive pictures lie from their epipolar curves, in pixels of the raw pictures.

    Raises:
        InputError: under `strict`, a picture or a mask cannot be read.
    """
    limit_rad = math.radians(options.theta_max_deg)
    masks = FeatureMasks(recording, options, {camera.name: limit_rad for camera in recording.cameras})
    posed = posed_pictures(recording, masks, lambda picture, _: read_image(picture.path))
    with console.status("Comparing the poses with features of the pictures"):
        try:
            found = [pair for pair in along_drive(posed) if np.isfinite(pair.median_px)]
        except (InputError, FileNotFoundError) as error:
            if options.strict:
                raise
            return [f"The poses are not compared with features of the pictures: {error}"]
    if not found:
        return ["Too few features match between successive pictures to check the poses."]
    worst = max(found, key=lambda pair: pair.median_px)
    median_px = float(np.median([pair.median_px for pair in found]))
    said = [
        f"Features of successive pictures lie {median_px:.2f} px from their epipolar curves (median of {len(found)} "
        f"pairs of pictures; at worst {worst.median_px:.2f} px, frames {worst.first} and {worst.second} of "
        f"{worst.camera})."
    ]
    if median_px > _WARN_PX:
        said.append(
            "This is far: check the calibration between LiDAR and cameras, and the times of pictures and sweeps, "
            "or compute the poses from the pictures (--poses colmap)."
        )
    return said


def lidar_says(recording: Recording, scene: Path, console: Console) -> list[str]:
    """Hold poses that were found from pictures against LiDAR odometry, and write down in the scene how far they agree.

    Says nothing where KISS-ICP is not installed, or the sweeps of the recording, which has a path, cannot be followed.

    Raises:
        InputError: what an earlier run wrote down is broken.
    """
    assert recording.trajectory is not None
    # a run that goes on does not begin again
    found = read_agreement(scene, recording.trajectory)
    if found is None:
        try:
            found = compare_paths(recording.trajectory, path_of(check_sweeps(recording), console))
        except (InputError, FileNotFoundError):
            return []
        if found is None:
            return []
        write_agreement(scene, found, recording.trajectory)
    longer = "longer" if found.scale > 1 else "shorter"
    said = [f"LiDAR odometry's path of the same drive lies {found.text()}; it is {abs(found.scale - 1):.2%} {longer}."]
    if found.max_m > _WARN_APART_M + _WARN_APART * found.length_m:
        said.append(
            "This is much: one of the two is wrong. Make the scene with --poses lidar as well, and check with "
            "`edge-depth-nerf inspect` with which path the LiDAR points fit the pictures better."
        )
    return said
