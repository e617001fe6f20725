"""Options of the converters. Light: the command line imports it to print its help.

Ranges are checked after parsing, here as for the other commands: a schema library on the options' types would be
imported before every --help (pydantic: 0.14 s, on top of 0.12), and knows neither the option's name nor which two
exclude each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.cluster_address import check_address


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """What every converter can be told."""

    output: Path
    """The scene folder to write. Run the same command again to resume."""
    first: int = 0
    """Number of the first frame."""
    frames: int | None = None
    """How many frames. Not set: to the end of the drive. Frames without pose, picture or sweep are skipped."""
    stride: int = 1
    """Take every stride-th frame."""
    frames_per_scene: int | None = None
    """Split the drive into scenes of at most this many frames: 000, 001, … in the output folder."""
    downscale: int = 1
    """Average blocks of this many pixels by this many into one."""
    holdout_every: int = 8
    """Hold out one frame in this many, for all cameras; 0 holds out none."""
    holdout_cameras: tuple[str, ...] = ()
    """Hold out all pictures of these cameras, to evaluate views beside the path."""
    holdout_beams: int = 0
    """Hold out one band of elevation (0.4°) in this many, to evaluate with; 0 holds out none."""
    theta_max_deg: float = 95.0
    """Mask out rays farther than this from the optical axis, in degrees."""
    poses: Literal["recorded", "colmap", "lidar"] = "recorded"
    """recorded: the drive's own; colmap: from the pictures, with LiDAR's scale (needs `.[colmap]`); lidar: from the
    sweeps (needs `.[odometry]`)."""
    refine_poses: bool = True
    """Refine the poses by the pictures, if that improves them. Needs `pip install '.[colmap]'`."""
    sweeps: int = 3
    """Accumulate this many LiDAR sweeps before and after each picture's own; never held-out ones."""
    raw_lidar: bool = False
    """Use LiDAR points as in the paper: not de-skewed, and also those that the camera cannot see."""
    ego_mask: Path | None = None
    """Mask of the vehicle (0 = ignore the pixel): a PNG, or a folder with CAMERA.png, in the raw pictures' size."""
    find_ego: bool = True
    """Without a mask, detect the vehicle as pixels that never change. You can correct ego_masks/."""
    frame_masks: Path | None = None
    """Masks of all pictures: a folder with CAMERA/0000000123.png (0 = ignore the pixel), in the raw pictures' size."""
    find_moving: bool = False
    """Find moving objects by LiDAR sweeps, and mask them out. You can correct moving_masks/."""
    motion: bool = True
    """Find distances by comparing neighbouring pictures (docs/motion.md); this takes time."""
    mono: Path | None = None
    """Monocular maps of a network that has not seen the drive's LiDAR: a folder with CAMERA/0000000123.png (16 bit,
    1/256 m along the ray), in the raw pictures' size. For others, use `estimate-depth --maps`."""
    estimate_depth: bool = True
    """Without monocular maps, train a network on the drive's LiDAR, as `estimate-depth` does."""
    strict: bool = False
    """Stop at the first broken file or sign of a wrong unit or clock. Otherwise up to a tenth is left out, and
    listed."""
    sky: tyro.conf.Suppress[bool] = True
    """Give the sky no monocular distance, instead of a wrong one."""
    cluster: str | None = None
    """Make each scene on a Dask cluster: local, or a scheduler's address (docs/cluster.md)."""

    def chosen_frames(self, end: int, what: str) -> range:
        """Numbers of the frames that are asked for, of a drive that ends with frame `end`.

        Raises:
            InputError: they reach beyond it; `what` says which frames there are.
        """
        last = max(end, self.first) if self.frames is None else self.first + (self.frames - 1) * self.stride
        if last > end:
            asked = "" if self.frames is None else f" --frames {self.frames} --stride {self.stride}"
            raise InputError(
                f"--first {self.first}{asked}: reaches frame {last}, but {what} to {end}. Start earlier, use fewer, or "
                "leave out --first and --frames to use all."
            )
        return range(self.first, last + 1, self.stride)

    def map_of(self, camera: str, frame: int, option: Literal["frame_masks", "mono"]) -> Path | None:
        """The file that an option gives for a picture, if it is set.

        Raises:
            FileNotFoundError: its folder has none for this picture.
        """
        folder: Path | None = getattr(self, option)
        path = None if folder is None else folder / camera / f"{frame:010d}.png"
        if path is not None and not path.is_file():
            name = f"--{option.replace('_', '-')}"
            raise FileNotFoundError(
                f"{path}: no such file; {name} needs one for every picture taken, named after the frame's number. Make "
                f"the missing ones, choose other frames, or leave out {name}."
            )
        return path

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.
        """
        frames, scene, holdout, beams = self.frames, self.frames_per_scene, self.holdout_every, self.holdout_beams
        for fine, option, expected in (
            (self.first >= 0, "first", "a frame number, 0 or more"),
            (frames is None or frames > 0, "frames", "1 or more"),
            (self.stride > 0, "stride", "1 or more"),
            (scene is None or scene >= 2, "frames_per_scene", "2 or more"),
            (self.downscale > 0, "downscale", "1 or more"),
            (holdout == 0 or holdout >= 2, "holdout_every", "2 or more, or 0 to hold out none"),
            (beams == 0 or 2 <= beams <= 100, "holdout_beams", "2 to 100, or 0 to hold out none"),
            (0 < self.theta_max_deg <= 180, "theta_max_deg", "degrees above 0, up to 180"),
            (0 <= self.sweeps <= 30, "sweeps", "0 to 30"),
        ):
            if not fine:
                raise InputError(f"--{option.replace('_', '-')} {getattr(self, option)}: expected {expected}.")
        check_address(self.cluster)


@dataclass(frozen=True, kw_only=True)
class Kitti360Options(ProcessOptions):
    """Turn a stretch of a KITTI-360 drive, or of one written by `synthesize`, into a scene folder."""

    root: Path
    """The data set's folder, with calibration, data_2d_raw, data_3d_raw and data_poses."""
    sequence: str
    """The drive, such as 2013_05_28_drive_0000_sync."""
    cameras: tuple[str, ...] = ("image_02", "image_03")
    """Which fisheye cameras: image_02 (left), image_03 (right)."""


@dataclass(frozen=True, kw_only=True)
class KittiOptions(ProcessOptions):
    """Turn a drive of KITTI's raw data or of its odometry benchmark into a scene folder."""

    root: Path
    """The folder with 2011_09_26 and other days (raw data), or with sequences and poses (odometry)."""
    sequence: str
    """The drive, such as 2011_09_26_drive_0005_sync, or 07 (odometry)."""
    cameras: tuple[str, ...] = ("image_02", "image_03")
    """Which cameras: image_00, image_01 (grey, left and right), image_02, image_03 (colour)."""


@dataclass(frozen=True, kw_only=True)
class RigOptions(ProcessOptions):
    """Turn your own recording into a scene folder. docs/rig.md says how to describe it."""

    root: Path
    """The recording's folder; paths in the rig file are relative to it."""
    rig: Path | None = None
    """The description of cameras, scanners and poses. Not set: rig.toml or rig.json in the recording's folder."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras. Not set: all."""


@dataclass(frozen=True, kw_only=True)
class JbnuDepth360Options(ProcessOptions):
    """Turn a sequence of JBNU-Depth360 into a scene folder. docs/rig.md says what you have to provide."""

    root: Path
    """The sequence's folder, with image and bin."""
    calibration: Path
    """TOML or JSON with cameras, scanner and poses. Its paths are relative to its folder."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras. Not set: all."""
