"""Options of `edge-depth-nerf inspect`; a module of its own so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_depth_nerf.base.errors import require

LARGEST_PANEL_PX = 4000


@dataclass(frozen=True)
class InspectOptions:
    """Inspect a scene before training: sheets of its maps, a top view, figures and warnings."""

    scene: tyro.conf.Positional[Path]
    """The scene folder, or its transforms.json. Scenes of other makers work, too."""
    output: Path | None = None
    """Folder for the pictures and summary.json. Not set: SCENE_inspection beside the scene."""
    frames: int = 4
    """Number of frames that get a sheet per camera, spread over the drive."""
    size: tyro.conf.Suppress[int] = 410
    """Width of each picture in a sheet of three columns, px; the default makes a sheet as wide as a window."""

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.
        """
        require(self.frames >= 1, f"--frames {self.frames}", "1 or more frames")
        within = 64 <= self.size <= LARGEST_PANEL_PX
        require(within, f"--size {self.size}", f"64 to {LARGEST_PANEL_PX} px for the pictures of a sheet")
