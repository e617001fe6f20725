"""Options of `camera-path`, `render-lidar` and `birds-eye`; a module of its own: the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError, require

Kind = Literal["replay", "lane-shift", "orbit"]
FilmCamera = Literal["fisheye", "perspective", "equirectangular"]
ScanForm = Literal["ply", "pcd", "bin"]

SMALLEST_PX, LARGEST_PX = 16, 8192
LARGEST_FOV_DEG = {"fisheye": 240.0, "perspective": 170.0}
"""The corners of a wider fisheye picture would lie outside the sphere. A wider pinhole shows little but its rim."""
RANGES = {"metres_per_pixel": (0.005, 10.0), "margin_m": (0.5, 200.0), "above_m": (-5.0, 50.0)}
"""Metres, of `birds-eye`."""


@dataclass(frozen=True)
class TrainedOptions:
    """What is rendered."""

    load_config: Path
    """The training's config.yml."""
    scene: tyro.conf.Positional[Path | None] = None
    """The scene folder, only needed if it was moved after the training."""


@dataclass(frozen=True)
class CameraPathOptions(TrainedOptions):
    """Write a camera path through a trained scene. `ns-render camera-path` renders it as a film."""

    kind: Kind = "replay"
    """replay: along the recorded path. lane-shift: to one side of it and back. orbit: a circle around a point ahead."""
    camera: FilmCamera | None = None
    """fisheye: equidistant, with the scale of the drive's lens. perspective: a pinhole that looks ahead.
    equirectangular: the whole sphere. Not set: as the drive's lens is."""
    output: Path | None = None
    """The path file. Not set: camera_paths/KIND_CAMERA.json beside config.yml."""
    follow: str | None = None
    """The camera of the drive whose path the film follows. Not set: the first."""
    shift_m: float = 1.0
    """lane-shift: how far to the left, metres; negative to the right."""
    ahead_m: float = 5.0
    """orbit: the centre's distance from the middle of the drive, forward along its path, metres."""
    radius_m: float = 3.0
    """orbit: the largest radius of the circle, metres."""
    width: int | None = None
    """The film's width, px. Not set: that of the drive's pictures; for equirectangular twice their height."""
    fov_deg: float | None = None
    """Angle of view across the width, degrees. Not set: that of the drive's lens; perspective 90 at most if that is a
    fisheye."""
    fps: float | None = None
    """Pictures per second. Not set: the drive's rate, or 10 if the scene has no times."""
    seconds: float | None = None
    """The film's length. Not set: the length of the drive; 6 s for an orbit."""

    def check(self) -> None:
        """Check the options before any file is read.

        Raises:
            InputError: an option is out of its range, or contradicts another one.
        """
        width = self.width
        if width is not None and not (SMALLEST_PX <= width <= LARGEST_PX and width % 2 == 0):
            raise InputError(
                f"--width {width}: expected an even number from {SMALLEST_PX} to {LARGEST_PX} px (films are encoded in "
                "blocks of two pixels)."
            )
        if self.fov_deg is not None and self.camera == "equirectangular":
            raise InputError("--fov-deg: an equirectangular film always shows the whole sphere. Leave this option out.")
        camera = self.camera or "fisheye"
        if self.fov_deg is not None and not 1 <= self.fov_deg <= LARGEST_FOV_DEG[camera]:
            raise InputError(
                f"--fov-deg {self.fov_deg}: expected 1 to {LARGEST_FOV_DEG[camera]:g} degrees for --camera {camera}."
            )
        for name, value in (("fps", self.fps), ("seconds", self.seconds), ("radius-m", self.radius_m)):
            require(value is None or 0 < value < math.inf, f"--{name} {value}", "a positive number")
        require(math.isfinite(self.shift_m), f"--shift-m {self.shift_m}", "a number of metres")
        require(0 <= self.ahead_m < math.inf, f"--ahead-m {self.ahead_m}", "0 or more metres")


@dataclass(frozen=True)
class RenderLidarOptions(TrainedOptions):
    """Render the scans that a LiDAR would record in a trained scene."""

    sensor: str = "recorded"
    """The scanner: recorded (the drive's own), hdl-64, vlp-16, os1-128, or the file of a scan (docs/scans.md)."""
    path: str = "recorded"
    """Where it drives: recorded, lane-shift (to one side and back), or a file of poses in TUM's format."""
    shift_m: float = 1.0
    """lane-shift: how far to the left, metres; negative to the right."""
    scanner: str | None = None
    """Which of the drive's scanners. Not set: its first one."""
    every: int = 1
    """Render one of so many scans."""
    form: ScanForm = "ply"
    """The files' format. bin: float32 x, y, z, intensity, as KITTI has it, without times."""
    film: bool = False
    """Also write the scans as a film, scans.webp."""
    output: Path | None = None
    """The folder. Not set: scans/ beside config.yml."""

    def check(self) -> None:
        """Check the options before any file is read.

        Raises:
            InputError: an option is out of its range.
        """
        require(math.isfinite(self.shift_m), f"--shift-m {self.shift_m}", "a number of metres")
        require(self.every >= 1, f"--every {self.every}", "1 or more")


@dataclass(frozen=True)
class BirdsEyeOptions(TrainedOptions):
    """Render a trained scene from straight above: a picture of the road, and its heights, for maps (GIS)."""

    metres_per_pixel: float = 0.05
    """Side of a pixel on the ground, metres."""
    margin_m: float = 10.0
    """Show what lies within this distance of the driven path, metres."""
    above_m: float = 0.5
    """Cut away what is higher than this above the vehicle's highest camera, metres: trees, bridges, roofs. Negative:
    below the camera."""
    output: Path | None = None
    """The folder. Not set: birds_eye/ beside config.yml."""

    def check(self) -> None:
        """Check the options before any file is read.

        Raises:
            InputError: an option is out of its range.
        """
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            require(low <= value <= high, f"--{name.replace('_', '-')} {value}", f"{low:g} to {high:g} metres")
