"""Options of `edge-depth-nerf demo`; a module of its own so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass
class DemoOptions:
    """Synthesise a drive, process it, train a depth network on it, and compare nerfacto and ours.

    You can stop at any time; run the same command again to resume.
    """

    output: Path = Path("outputs/demo")
    """Folder for the drive, the scene, the comparison, report.html, results.json and a picture."""
    scene: Literal["street", "parking", "turn"] = "street"
    """What the drive passes."""
    frames: int = 40
    """Frames of the drive, with two pictures each."""
    size: int = 256
    """Width and height of the pictures, px."""
    steps: int = 800
    """Training steps of each model."""
