"""Options of `edge-depth-nerf render-lidar`; a module of its own so that the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError

ScanForm = Literal["ply", "pcd", "bin"]


@dataclass(frozen=True)
class RenderLidarOptions:
    """Render the scans that a LiDAR would record in a trained scene."""

    load_config: Path
    """The training's config.yml."""
    scene: tyro.conf.Positional[Path | None] = None
    """The scene folder, only needed if it was moved after the training."""
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
        if not math.isfinite(self.shift_m):
            raise InputError(f"--shift-m {self.shift_m}: expected a number of metres.")
        if self.every < 1:
            raise InputError(f"--every {self.every}: expected 1 or more.")
