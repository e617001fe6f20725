"""Options of `edge-depth-nerf demo`; a module of its own so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass
class DemoOptions:
    """Process a rendered drive, or your recording, and compare nerfacto and ours on it.

    You can stop at any time; run the same command again to resume.
    """

    output: Path | None = None
    """Folder for all results. Not set: outputs/demo, or outputs/demo_FOLDER with --real."""
    real: Path | None = None
    """Your recording: a folder with rig.toml (docs/rig.md), or KITTI-360's or KITTI's (its first sequence)."""
    scene: Literal["street", "parking", "turn"] = "street"
    """What the rendered drive passes."""
    frames: int | None = None
    """Frames of the drive. Not set: 40, or the first 30 of a recording."""
    size: int = 256
    """Width and height of rendered pictures, px."""
    steps: int = 800
    """Training steps of each model."""

    @property
    def folder(self) -> Path:
        """The output folder that applies."""
        name = "demo" if self.real is None else f"demo_{self.real.resolve().name}"
        return self.output or Path("outputs") / name

    @property
    def scene_name(self) -> str:
        """What the tables call the drive."""
        return self.scene if self.real is None else self.real.resolve().name
