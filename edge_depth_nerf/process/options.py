"""Options of the converters. Light: the command line imports it to print its help.

Ranges are checked after parsing, here as for the other commands: a schema library on the options' types would be
imported before every --help (pydantic: 0.14 s, on top of 0.12), and knows neither the option's name nor which two
exclude each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.cluster_address import check_address


@dataclass(frozen=True, kw_only=True)
class ProcessOptions:
    """What every converter can be told."""

    output: Path
    """The scene folder to write. A run that was interrupted is continued by the same command."""
    first: int = 0
    """Number of the first frame."""
    frames: int | None = None
    """How many frames to look at: first, first + stride, and so on. Not set: to the end of the drive. Those without
    pose, picture or sweep are listed and skipped."""
    stride: int = 1
    """Take every stride-th frame."""
    frames_per_scene: int | None = None
    """Cut a long drive into scenes of so many frames at most, one after another, as equal as can be: 000, 001 and so
    on in the output folder. Frames that cannot be used do not count. Not set: one scene."""
    downscale: int = 1
    """Average blocks of this many pixels by this many into one. What does not fill a block, at the right and at the
    bottom, is cut off."""
    holdout_every: int = 8
    """One frame of so many is held out of training, for all cameras at once: with 8 the fifth, the 13th, the 21st …;
    0 holds out none."""
    holdout_beams: int = 0
    """One band of elevation of so many, each 0.4° high (a beam or two of a scanner), is held out of every sweep: no
    prior or network sees it, training views are judged by it. 0 holds out none."""
    theta_max_deg: float = 95.0
    """Rays further than this from the optical axis are masked out, in degrees."""
    poses: Literal["recorded", "colmap", "lidar"] = "recorded"
    """recorded: the poses that come with the drive; colmap: found from the pictures, their scale from LiDAR (needs
    `pip install '.[colmap]'`); lidar: found from the sweeps (needs `pip install
    '.[odometry]'`)."""
    refine_poses: bool = True
    """Refine the poses by the pictures: by features that they share, with the poses held softly, unless that makes
    them no better. Needs `pip install '.[colmap]'`; without it the poses stay, and you are told."""
    sweeps: int = 3
    """Accumulate this many LiDAR sweeps before and after each picture's own. Training never sees a sweep of a moment
    that is held out; a picture that is held out gets its own alone."""
    deskew: bool = True
    """Move each point by the vehicle's pose at the time it was measured; off to compare."""
    occlusion: bool = True
    """Remove points that a nearer surface hides from the camera; off to compare."""
    ego_mask: Path | None = None
    """What of the picture is never used, such as the vehicle itself (255 = use the pixel, 0 = ignore it): a PNG for
    all cameras, or a folder with a PNG named after each camera. In the size of the raw pictures."""
    find_ego: bool = True
    """Where no mask is given, find the vehicle as what never changes while it moves; the masks found are written to
    ego_masks/ in the scene, to be corrected and given as --ego-mask."""
    frame_masks: Path | None = None
    """Masks of single frames, such as moving things: a folder with CAMERA/0000000123.png (255 = use the pixel). In
    the size of the raw pictures; one for every frame taken."""
    find_moving: bool = False
    """Find things that move by what LiDAR's sweeps of other moments saw through, and mask them out of the pictures;
    the masks are written to moving_masks/ in the scene, to be corrected there or given as --frame-masks."""
    moving_classes: tuple[str, ...] = (
        *("person", "rider", "car", "truck", "bus", "caravan", "trailer", "train", "motorcycle", "bicycle"),
        "unknown vehicle",
    )
    """Classes that are masked out where the drive brings KITTI-360's semantics; none to keep all."""
    motion: bool = True
    """Find distances by comparing each training picture with its neighbours, also above LiDAR's field, where the
    vehicle moves; off to save the time: some two seconds a picture of 350×350 px and core."""
    mono: Path | None = None
    """Monocular distance maps: a folder with CAMERA/0000000123.png, 16 bit, 1/256 m along the ray, 0 = none. In the
    size of the raw pictures; one for every frame taken. `estimate-depth --maps` takes other forms. Not set: a network
    of the drive's own makes them."""
    mono_trained_on: Literal["scene", "elsewhere"] = "elsewhere"
    """What the maker of the maps that are brought has seen: scene, if it was trained on LiDAR alone and knows nothing
    beyond a scanner's field of elevation, where no prior is made then."""
    estimate_depth: bool = True
    """Where no monocular maps are given, train a network on the drive's LiDAR, as `edge-depth-nerf estimate-depth`
    does; off to leave the scene without, or to bring maps of other networks by that command."""
    mono_model: Path | None = None
    """Weights that `estimate-depth` trained on other drives: they predict as they are, nothing is trained."""
    mono_preset: Literal["lite", "full"] = "lite"
    """Size of the drive's own network; lite: some minutes on a laptop's CPU; full: for a GPU."""
    mono_seconds: float | None = None
    """The drive's own network is trained for so many seconds at most. Not set: all steps of its preset."""
    strict: bool = False
    """Stop at the first picture, sweep or map that is broken or missing. Otherwise up to a tenth of them are left out
    of the scene and named at the end."""
    sky: bool = True
    """Leave the sky without monocular distance, instead of a wrong one."""
    cluster: str | None = None
    """Work on a Dask cluster, each scene as a task: local (processes on this machine, one for each GPU or core), or the
    address of a scheduler, such as tcp://10.0.0.1:8786. Needs `pip install '.[cluster]'`; see
    docs/cluster.md."""

    def ego_mask_of(self, camera: str) -> Path | None:
        """The mask of the vehicle that is given for a camera, if one is."""
        given = self.ego_mask
        return given / f"{camera}.png" if given is not None and given.is_dir() else given

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.

        """

        def require(fine: bool, option: str, found: object, expected: str) -> None:
            if not fine:
                raise InputError(f"--{option} {found}: expected {expected}.")

        require(self.first >= 0, "first", self.first, "the number of a frame, 0 or more")
        require(self.frames is None or self.frames > 0, "frames", self.frames, "1 or more")
        require(self.stride > 0, "stride", self.stride, "1 or more")
        scene = self.frames_per_scene
        require(scene is None or scene >= 2, "frames-per-scene", scene, "2 or more")
        check_address(self.cluster)
        require(self.downscale > 0, "downscale", self.downscale, "1 or more")
        holdout = self.holdout_every
        require(holdout == 0 or holdout >= 2, "holdout-every", holdout, "2 or more, or 0 to hold out none")
        beams = self.holdout_beams
        require(beams == 0 or 2 <= beams <= 100, "holdout-beams", beams, "2 to 100, or 0 to hold out none")
        require(0 < self.theta_max_deg <= 180, "theta-max-deg", self.theta_max_deg, "degrees above 0, up to 180")
        require(0 <= self.sweeps <= 30, "sweeps", self.sweeps, "0 to 30")
        seconds = self.mono_seconds
        require(seconds is None or seconds > 0, "mono-seconds", seconds, "more than 0")
        if self.mono_model is not None and (self.mono is not None or not self.estimate_depth):
            other = "--mono" if self.mono is not None else "--no-estimate-depth"
            raise InputError(f"--mono-model and {other} exclude each other. Give one of them.")


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
class RigOptions(ProcessOptions):
    """Turn a recording of your own into a scene folder. docs/rig.md says how it is described."""

    root: Path
    """The recording's folder; paths in the rig file count from it."""
    rig: Path | None = None
    """The file that describes cameras, scanners and poses. Not set: rig.toml or rig.json in the recording's folder."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras; none named: all."""


@dataclass(frozen=True, kw_only=True)
class JbnuDepth360Options(ProcessOptions):
    """Turn a sequence of JBNU-Depth360 into a scene folder. docs/jbnu_depth360.md says what is to be handed in."""

    root: Path
    """The sequence's folder: the one that holds image and bin."""
    calibration: Path
    """TOML or JSON with cameras, scanner and poses, which the data set does not publish; paths in it count from its own
    folder, those of pictures and scans from the sequence's."""
    cameras: tuple[str, ...] = ()
    """Which of its cameras; none named: all."""
