"""Options of `edge-depth-nerf birds-eye`; a module of its own so that the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_depth_nerf.base.errors import InputError

RANGES = {"metres_per_pixel": (0.005, 10.0), "margin_m": (0.5, 200.0), "above_m": (-5.0, 50.0)}


@dataclass(frozen=True)
class BirdsEyeOptions:
    """Render a trained scene from straight above: a picture of the road, and its heights, for maps (GIS)."""

    load_config: Path
    """The training's config.yml."""
    scene: tyro.conf.Positional[Path | None] = None
    """The scene folder. It is only needed if the folder was moved after the training."""
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
            if not (math.isfinite(value) and low <= value <= high):
                raise InputError(f"--{name.replace('_', '-')} {value}: expected {low:g} to {high:g} metres.")
