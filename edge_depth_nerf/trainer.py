"""Saves checkpoints so that a run killed at any moment can be taken up again."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field

from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread


@dataclass
class EdgeDepthTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with atomic checkpoints."""

    _target: type = field(default_factory=lambda: EdgeDepthTrainer)
    """Target class to instantiate."""


class EdgeDepthTrainer(Trainer):
    """nerfstudio's trainer with atomic checkpoints."""

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save into a folder beside the checkpoints, then move the whole file there.

        nerfstudio writes in place: a kill in that moment leaves half a file as the newest checkpoint. The folder
        lies outside, since resuming parses every name in the checkpoint folder.
        """
        folder = self.checkpoint_dir
        partial = self.base_dir / ".unfinished_checkpoint"
        shutil.rmtree(partial, ignore_errors=True)
        self.checkpoint_dir = partial
        try:
            super().save_checkpoint(step)
        finally:
            self.checkpoint_dir = folder
        folder.mkdir(parents=True, exist_ok=True)
        (written,) = partial.iterdir()
        older = list(folder.glob("*.ckpt")) if self.config.save_only_latest_checkpoint else []
        os.replace(written, folder / written.name)
        partial.rmdir()
        for checkpoint in older:
            if checkpoint.name != written.name:
                checkpoint.unlink()
