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
Look = Literal["auto", "camera", "forward"]

SMALLEST_PX, LARGEST_PX = 16, 8192
LARGEST_FOV_DEG = {"fisheye": 240.0, "perspective": 170.0}
"""Corners of a wider fisheye picture would lie beyond the whole sphere; a wider pinhole shows but its rim."""


@dataclass(frozen=True)
class CameraPathOptions:
    """Write a camera's path through a trained scene: `ns-render camera-path` makes a film of it."""

    scene: tyro.conf.Positional[Path | None] = None
    """The scene folder. With --load-config only needed if it lies elsewhere than at training."""
    load_config: Path | None = None
    """The training's config.yml: it knows the scene, and which coordinates the model was trained in."""
    kind: Kind = "replay"
    """replay: along the recorded path; lane-shift: eased to one side of it and back; orbit: around a point before
    the vehicle, looking at it, as wide as LiDAR found nothing in the way."""
    camera: FilmCamera = "fisheye"
    """fisheye: equidistant, without the distortion of the drive's own lens; perspective: a pinhole; equirectangular:
    the whole sphere."""
    output: Path | None = None
    """The path file. Not set: camera_paths/KIND_CAMERA.json beside config.yml, or in the scene."""
    follow: str | None = None
    """The camera of the drive whose way is taken. Not set: the scene's first."""
    look: Look = "auto"
    """Where it looks on the drive's way. camera: where the drive's camera looked; forward: where the vehicle went;
    auto: camera for fisheye, forward for the others."""
    shift_m: float = 1.0
    """lane-shift: how far to the left, metres; negative to the right."""
    ahead_m: float = 5.0
    """orbit: how far along the way, from the drive's middle, the point lies, metres."""
    radius_m: float = 3.0
    """orbit: the circle's radius at most, metres."""
    width: int | None = None
    """Of the film, px. Not set: as the drive's pictures, for equirectangular twice their height."""
    height: int | None = None
    """Of the film, px. Not set: fisheye in the proportions of the drive's pictures, perspective 16:9,
    equirectangular 2:1."""
    fov_deg: float | None = None
    """Angle of view across the film's width, degrees. Not set: fisheye as the drive's lens (180 without one),
    perspective 90."""
    fps: float | None = None
    """Pictures a second. Not set: the drive's own rate, 10 where the scene knows no times."""
    seconds: float | None = None
    """How long the film runs. Not set: as long as the drive; an orbit 6 s."""
    metres_per_unit: float | None = None
    """Without --load-config: the value that the training was given, if it was."""

    def check(self) -> None:
        """Check what can be checked before anything is read.

        Raises:
            InputError: an option is out of its range, or has no meaning beside another.

        """
        if self.scene is None and self.load_config is None:
            raise InputError(
                "neither --load-config nor a scene was given. The path is written in the trained model's "
                "coordinates: give the training's config.yml with --load-config."
            )
        if self.load_config is not None and self.metres_per_unit is not None:
            raise InputError(
                f"--metres-per-unit {self.metres_per_unit} beside --load-config: {self.load_config} knows the scale "
                "that the model was trained in. Leave one of the two away."
            )
        for name, value in (("width", self.width), ("height", self.height)):
            if value is not None and not (SMALLEST_PX <= value <= LARGEST_PX and value % 2 == 0):
                raise InputError(
                    f"--{name} {value}: expected an even number of {SMALLEST_PX} to {LARGEST_PX} px (films are "
                    "coded in blocks of two pixels)."
                )
        self._check_view()
        for name, value in (("fps", self.fps), ("seconds", self.seconds), ("radius-m", self.radius_m)):
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"--{name} {value}: expected a positive number.")
        if not math.isfinite(self.shift_m):
            raise InputError(f"--shift-m {self.shift_m}: expected a number of metres.")
        if not (math.isfinite(self.ahead_m) and self.ahead_m >= 0):
            raise InputError(f"--ahead-m {self.ahead_m}: expected 0 or more metres.")

    def _check_view(self) -> None:
        """Check what the kind of camera has a say in."""
        if self.camera == "equirectangular":
            if self.fov_deg is not None:
                raise InputError("--fov-deg: an equirectangular film always shows the whole sphere. Leave it away.")
            if self.width and self.height and self.width != 2 * self.height:
                raise InputError(
                    f"--width {self.width} --height {self.height}: an equirectangular film is twice as wide as high. "
                    "Give one of the two."
                )
        elif self.fov_deg is not None and not 1 <= self.fov_deg <= LARGEST_FOV_DEG[self.camera]:
            raise InputError(
                f"--fov-deg {self.fov_deg}: expected 1 to {LARGEST_FOV_DEG[self.camera]:g} degrees for "
                f"--camera {self.camera}."
            )
