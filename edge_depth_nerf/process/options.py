"""Options of the converters. Light: the command line imports it to print its help."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Kitti360Options:
    """Turn a stretch of a KITTI-360 drive, or of one written by `synthesize`, into a scene folder."""

    root: Path
    """The data set's folder: the one that holds calibration, data_2d_raw, data_3d_raw and data_poses."""
    sequence: str
    """The drive, such as 2013_05_28_drive_0000_sync."""
    output: Path
    """The scene folder to write. A run that was interrupted is continued by the same command."""
    first: int = 0
    """Number of the first frame, as in the file names."""
    frames: int | None = None
    """How many frames to look at: first, first + stride, and so on. Not set: to the end of the drive. Those without
    pose, picture or sweep are listed and skipped."""
    stride: int = 1
    """Take every stride-th frame."""
    cameras: tuple[str, ...] = ("image_02", "image_03")
    """Which of the two fisheye cameras: image_02 (left), image_03 (right)."""
    downscale: int = 1
    """Average blocks of this many pixels by this many into one. What does not fill a block, at the right and at the
    bottom, is cut off."""
    ego_mask: Path | None = None
    """What of the picture is never used, such as the vehicle itself (255 = use the pixel, 0 = ignore it): a PNG for
    all cameras, or a folder with image_02.png and image_03.png. In the size of the raw pictures."""
    frame_masks: Path | None = None
    """Masks of single frames, such as moving things: a folder with image_02/0000000123.png. In the size of the raw
    pictures; one for every frame taken."""
    mono: Path | None = None
    """Monocular distance maps: a folder with image_02/0000000123.png, 16 bit, 1/256 m along the ray, 0 = none. In
    the size of the raw pictures; one for every frame taken."""
    theta_max_deg: float = 95.0
    """Rays further than this from the optical axis are masked out, in degrees."""
    holdout_every: int = 8
    """One frame of so many is held out of training, for all cameras at once: frames 4, 12, 20 of every 8. 0 holds out
    none."""
