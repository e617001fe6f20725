"""What is kept from training: whole frames, and whole cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import RecordedPicture, Recording


def check_holdout_cameras(recording: Recording, options: ProcessOptions) -> None:
    """Check the cameras that are to be held out.

    Raises:
        InputError: the drive has no such camera, or none is left for training.
    """
    given, names = options.holdout_cameras, [camera.name for camera in recording.cameras]
    there = f"The cameras in use are {', '.join(names)}."
    for name in given:
        if name not in names:
            raise InputError(f"--holdout-cameras {name}: there is no such camera. {there}")
    if set(given) == set(names):
        raise InputError(
            f"--holdout-cameras {' '.join(given)}: no camera is left for training. {there} Hold out fewer, or use more."
        )


def is_held_out(picture: RecordedPicture, frames: Collection[int], options: ProcessOptions) -> bool:
    """Say whether a picture is kept from training: its frame, one of `frames`, or its camera is held out."""
    return picture.frame in frames or picture.camera in options.holdout_cameras


def of_training_cameras(recording: Recording, options: ProcessOptions) -> Recording:
    """Give the recording without the cameras that are held out."""
    if not options.holdout_cameras:
        return recording
    return dataclasses.replace(
        recording,
        cameras=tuple(camera for camera in recording.cameras if camera.name not in options.holdout_cameras),
        pictures=tuple(picture for picture in recording.pictures if picture.camera not in options.holdout_cameras),
    )
