"""Checks a scene's poses: distances of matched features in successive pictures from their epipolar lines."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from edge_depth_nerf.base.console import run_jobs
from edge_depth_nerf.inspecting.figures import MEASURED_PICTURES
from edge_depth_nerf.poses.matches import EpipolarAgreement, PosedPicture, along_drive
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

BAD_MEDIAN_PX = 0.4
"""Feature positions are accurate to 0.1 to 0.2 px. On a real drive, a training with LiDAR odometry's poses (0.45 px)
ended 0.7 dB below one with poses of 0.13 px."""
BAD_STEP_PX = 1.0
"""A single step is reported if it is off by more than this, and by three times the usual."""
BAD_STEP_FACTOR = 3.0
_LEAST_FRAMES = 8


def check_poses(scene: SceneFolder, console: Console) -> list[EpipolarAgreement]:
    """Match successive pictures of each camera, at some frames spread over the drive.

    Scenes of other makers are skipped: their lengths are unknown, and their pictures may be in any order.

    Raises:
        InputError: a picture or a mask cannot be read.
    """
    if not scene.own:
        return []
    cameras = scene.cameras()
    most = max(MEASURED_PICTURES // len(cameras), _LEAST_FRAMES)
    jobs = [partial(along_drive, [_posed(scene, each) for each in pictures], most) for pictures in cameras.values()]
    return [one for found in run_jobs(jobs, "Checking the poses against the pictures", console) for one in found]


def _posed(scene: SceneFolder, picture: ScenePicture) -> PosedPicture:
    return PosedPicture(
        camera=picture.camera,
        frame=picture.frame,
        lens=picture.lens,
        camera_to_world=picture.pose,
        read_rgb=partial(scene.rgb, picture),
        read_usable=partial(scene.usable, picture),
    )


def known_steps(agreements: Sequence[EpipolarAgreement], camera: str | None = None) -> list[EpipolarAgreement]:
    """Return the steps with enough matches, of one camera or of all."""
    return [one for one in agreements if np.isfinite(one.median_px) and camera in (None, one.camera)]


def bad_steps(agreements: Sequence[EpipolarAgreement], camera: str) -> list[EpipolarAgreement]:
    """Return the steps of a camera that stand out."""
    known = known_steps(agreements, camera)
    usual_px = float(np.median([one.median_px for one in known])) if known else 0.0
    return [one for one in known if one.median_px > max(BAD_STEP_PX, BAD_STEP_FACTOR * usual_px)]


def pose_figures(agreements: Sequence[EpipolarAgreement], camera: str | None = None) -> dict[str, Any] | None:
    """Return the steps' median distances of features to their epipolar lines as JSON; None if nothing was matched."""
    medians = [one.median_px for one in known_steps(agreements, camera)]
    if not medians:
        return None
    low, middle, high = (float(f"{value:.4g}") for value in (min(medians), np.median(medians), max(medians)))
    return {"median_px": middle, "min_px": low, "max_px": high, "steps": len(medians)}
