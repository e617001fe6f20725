"""Options of `edge-depth-nerf camera-path`; a module of its own so that the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError

Kind = Literal["replay", "lane-shift", "orbit"]
FilmCamera = Literal["fisheye", "perspective", "equirectangular"]

SMALLEST_PX, LARGEST_PX = 16, 8192
LARGEST_FOV_DEG = {"fisheye": 240.0, "perspective": 170.0}
"""The corners of a wider fisheye picture would lie outside the sphere. A wider pinhole shows little but its rim."""


@dataclass(frozen=True)
class CameraPathOptions:
    """Write a camera path through a trained scene. `ns-render camera-path` renders it as a film."""

    load_config: Path
    """The training's config.yml."""
    scene: tyro.conf.Positional[Path | None] = None
    """The scene folder, only needed if it was moved after the training."""
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
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"--{name} {value}: expected a positive number.")
        if not math.isfinite(self.shift_m):
            raise InputError(f"--shift-m {self.shift_m}: expected a number of metres.")
        if not (math.isfinite(self.ahead_m) and self.ahead_m >= 0):
            raise InputError(f"--ahead-m {self.ahead_m}: expected 0 or more metres.")
