"""Options of `edge-depth-nerf export`; a module of its own so that the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError, require

Form = Literal["nerfstudio", "colmap", "points"]
Views = Literal["fisheye", "pinhole"]
Pictures = Literal["all", "training"]
DepthFiles = Literal["png", "npy"]
Cuts = Literal[1, 3, 5]
LEAST_FOV_DEG, LARGEST_FOV_DEG = 20.0, 120.0
LEAST_VOXEL_M = 0.01
"""Of smaller cubes there would be more along a drive than are counted."""


@dataclass(frozen=True)
class ExportOptions:
    """Write a scene's depth prior for other programs: maps and a cloud, with pictures and cameras."""

    scene: tyro.conf.Positional[Path]
    """The scene folder."""
    form: Form = "nerfstudio"
    """nerfstudio: a folder for depth-nerfacto and other methods. colmap: a COLMAP model with pictures, masks and maps.
    points: the cloud alone, in the recording's world."""
    output: Path | None = None
    """The folder. Not set: beside the scene, with the form added to its name."""
    views: Views = "fisheye"
    """fisheye: the pictures with the lenses of the scene. pinhole: perspective views that are cut out of them."""
    cuts: Cuts = 5
    """pinhole: how many views of each fisheye picture. 1: along its axis. 3: also to the left and right. 5: also up and
    down."""
    fov_deg: float = 90.0
    """pinhole: angle of view across a view, degrees. It is less where the lens sees less."""
    pictures: Pictures = "all"
    """all: also the held-out ones, in a list of their own. training: without them. The cloud is always made of the
    training pictures alone."""
    depth_files: DepthFiles = "png"
    """png: 16 bits, up to 65.5 m; prior that is further away is left out. npy: float32 without a limit. Both count
    millimetres."""
    voxel_m: float = 0.1
    """The cloud has one point in each cube of this size, metres."""
    most_points: int = 1_000_000
    """The cloud has at most this many points. For fewer points the cubes are made larger."""
    most_error: float = 0.1
    """The cloud leaves out prior whose standard deviation is more than this share of the distance."""

    def check(self) -> None:
        """Check the options before any file is read.

        Raises:
            InputError: an option is out of its range.
        """
        if not LEAST_FOV_DEG <= self.fov_deg <= LARGEST_FOV_DEG:
            raise InputError(
                f"--fov-deg {self.fov_deg}: expected {LEAST_FOV_DEG:g} to {LARGEST_FOV_DEG:g} degrees. Wider pinhole "
                "views show little but their rim."
            )
        require(LEAST_VOXEL_M <= self.voxel_m < math.inf, f"--voxel-m {self.voxel_m}", f"{LEAST_VOXEL_M} m or more")
        require(0 < self.most_error < math.inf, f"--most-error {self.most_error}", "a positive number")
        require(self.most_points >= 1, f"--most-points {self.most_points}", "1 or more")

    def folder(self) -> Path:
        """Give the folder that is written to."""
        scene = self.scene.parent if self.scene.suffix == ".json" else self.scene
        return self.output or scene.absolute().with_name(f"{scene.absolute().name}_{self.form}")
