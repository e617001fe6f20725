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
    """The scene folder to write. Run the same command again to resume an interrupted run."""
    first: int = 0
    """Number of the first frame."""
    frames: int | None = None
    """How many frames to consider: first, first + stride, and so on. Not set: to the end of the drive. Frames without
    pose, picture or sweep are skipped and listed."""
    stride: int = 1
    """Take every stride-th frame."""
    frames_per_scene: int | None = None
    """Split a long drive into consecutive scenes of at most this many frames, of similar length: 000, 001 and so on in
    the output folder. Unusable frames do not count. Not set: one scene."""
    downscale: int = 1
    """Average blocks of this many pixels by this many into one. Incomplete blocks at the right and at the bottom are
    cut off."""
    holdout_every: int = 8
    """Hold out one frame in this many, for all cameras: with 8 the fifth, the 13th, the 21st …; 0 holds out none."""
    holdout_cameras: tuple[str, ...] = ()
    """Hold out all pictures of these cameras, to evaluate views beside the path. Neither training nor priors nor poses
    see them."""
    holdout_beams: int = 0
    """Hold out one band of elevation in this many from every sweep. A band is 0.4° high (a beam or two of a scanner).
    No prior or network sees it; training views are evaluated with it. 0 holds out none."""
    theta_max_deg: float = 95.0
    """Mask out rays farther than this from the optical axis, in degrees."""
    poses: Literal["recorded", "colmap", "lidar"] = "recorded"
    """recorded: the poses that come with the drive; colmap: computed from the pictures, with LiDAR's scale (needs `pip
    install '.[colmap]'`); lidar: computed from the sweeps (needs `pip install '.[odometry]'`)."""
    refine_poses: bool = True
    """Refine the poses with features that pictures share; the given poses are soft constraints, and are kept if
    refining does not improve them. Needs `pip install '.[colmap]'`; without it the poses are kept, and this is
    reported."""
    sweeps: int = 3
    """Accumulate this many LiDAR sweeps before and after each picture's own. Training never sees a sweep of a held-out
    frame; a held-out picture uses only its own sweep."""
    raw_lidar: bool = False
    """Project LiDAR points as recorded, as in the paper: they are not moved by the vehicle's pose at the time they were
    measured, and points that a nearer surface hides from the camera are kept."""
    ego_mask: Path | None = None
    """Mask of pixels that are never used, such as the vehicle itself (255 = use the pixel, 0 = ignore it): a PNG for
    all cameras, or a folder with a PNG named after each camera, in the size of the raw pictures."""
    find_ego: bool = True
    """If no mask is given, detect the vehicle as the pixels that never change while it moves. The masks are written to
    ego_masks/ in the scene; you can correct them there, or give them as --ego-mask."""
    frame_masks: Path | None = None
    """Masks of single pictures, such as of moving objects: a folder with CAMERA/0000000123.png (255 = use the pixel).
    In the size of the raw pictures; one for every frame used."""
    find_moving: bool = False
    """Find moving objects with the help of LiDAR sweeps from other times, and mask them out of the pictures. The masks
    are written to moving_masks/ in the scene; you can correct them there, or give them as --frame-masks."""
    moving_classes: tuple[str, ...] = (
        *("person", "rider", "car", "truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle"),
        "unknown vehicle",
    )
    """Classes to mask out if the drive has KITTI-360's semantics; none keeps all."""
    motion: bool = True
    """Find distances by comparing each training picture with its neighbours, also above LiDAR's field, where the
    vehicle moves; off saves time: about two seconds per picture of 350×350 px on one core."""
    mono: Path | None = None
    """Monocular distance maps: a folder with CAMERA/0000000123.png, 16 bit, 1/256 m along the ray, 0 = none. In the
    size of the raw pictures; one for every frame used, of a network that was not trained on the drive's LiDAR.
    `estimate-depth --maps` accepts others. Not set: a network trained on the drive makes them."""
    estimate_depth: bool = True
    """If no monocular maps are given, train a network on the drive's LiDAR, as `edge-depth-nerf estimate-depth` does.
    Off: the scene gets no maps. With that command you can add those of other networks, or of a larger one."""
    strict: bool = False
    """Stop at the first broken or missing picture, sweep or map, and if something seems to be wrong with the recording,
    such as a unit or a clock. Otherwise up to a tenth of them are left out of the scene and named at the end."""
    sky: tyro.conf.Suppress[bool] = True
    """Give the sky no monocular distance, instead of a wrong one."""
    cluster: str | None = None
    """Work on a Dask cluster, each scene as a task: local (processes on this machine, one for each GPU or core), or the
    address of a scheduler, such as tcp://10.0.0.1:8786. Needs `pip install '.[cluster]'`; see
    docs/cluster.md."""

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
    """The data set's folder: the one that holds calibration, data_2d_raw, data_3d_raw and data_poses."""
    sequence: str
    """The drive, such as 2013_05_28_drive_0000_sync."""
    cameras: tuple[str, ...] = ("image_02", "image_03")
    """Which of the two fisheye cameras: image_02 (left), image_03 (right)."""


@dataclass(frozen=True, kw_only=True)
class KittiOptions(ProcessOptions):
    """Turn a drive of KITTI's raw data or of its odometry benchmark into a scene folder."""

    root: Path
    """The data set's folder: the one that holds 2011_09_26 and the other days (raw data), or sequences and poses
    (odometry)."""
    sequence: str
    """The drive, such as 2011_09_26_drive_0005_sync, or the sequence of the odometry benchmark, such as 07."""
    cameras: tuple[str, ...] = ("image_02", "image_03")
    """Which cameras: image_00, image_01 (grey, left and right), image_02, image_03 (colour). The odometry benchmark
    calls them image_0 to image_3."""


@dataclass(frozen=True, kw_only=True)
class RigOptions(ProcessOptions):
    """Turn your own recording into a scene folder. docs/rig.md says how to describe it."""

    root: Path
    """The recording's folder; paths in the rig file are relative to it."""
    rig: Path | None = None
    """The file that describes cameras, scanners and poses. Not set: rig.toml or rig.json in the recording's folder."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras. Not set: all."""


@dataclass(frozen=True, kw_only=True)
class JbnuDepth360Options(ProcessOptions):
    """Turn a sequence of JBNU-Depth360 into a scene folder. docs/jbnu_depth360.md says what you have to provide."""

    root: Path
    """The sequence's folder: the one that holds image and bin."""
    calibration: Path
    """TOML or JSON with cameras, scanner and poses, which the data set does not publish. Paths in it are relative to
    its own folder; those of pictures and scans are relative to the sequence's folder."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras. Not set: all."""
