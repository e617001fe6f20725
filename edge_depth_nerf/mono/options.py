"""Options of `edge-depth-nerf estimate-depth`; a module of its own so that the command line starts fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.errors import InputError

Preset = Literal["lite", "full"]


@dataclass(frozen=True)
class EstimateDepthOptions:
    """Train a monocular depth network on scenes' own LiDAR, and write its distance maps into them.

    Held-out pictures are never trained on. Stopped at any moment, the same command takes up where it was.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders, as `edge-depth-nerf process` writes them; one network is trained on all of them."""
    model: Path | None = None
    """Weights to begin with. Without --train-steps they predict as they are, and the scenes need no LiDAR."""
    train_steps: int | None = None
    """Steps of training. Not set: the preset's number, or none with --model."""
    seconds: float | None = None
    """Seconds of training at most. What was trained so far is used, at a learning rate that ends in time."""
    preset: Preset = "lite"
    """lite: minutes on a laptop's CPU; full: a larger network on larger pictures, for a GPU."""
    output: Path | None = None
    """Where the trained weights go. Not set: mono_network.safetensors in the first scene."""
    seed: int = 0
    """Of the first weights and of the order of pictures; on one thread the same seed gives the same weights, unless
    --seconds ends the training."""

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.

        """
        if not self.scenes:
            raise InputError("no scene is given; `estimate-depth` takes one or more scene folders.")
        if self.train_steps is not None and self.train_steps < 1:
            raise InputError(f"--train-steps {self.train_steps}: expected 1 or more.")
        if self.seconds is not None and not self.seconds > 0:
            raise InputError(f"--seconds {self.seconds:g}: expected more than 0.")
        if not 0 <= self.seed < 1 << 63:
            raise InputError(f"--seed {self.seed}: expected 0 or more, below 2^63.")
        if self.output is not None and self.output.suffix != ".safetensors":
            raise InputError(f"--output {self.output}: expected a file that ends in .safetensors.")

    @property
    def trains(self) -> bool:
        """Whether anything is trained."""
        return self.model is None or self.train_steps is not None or self.seconds is not None
