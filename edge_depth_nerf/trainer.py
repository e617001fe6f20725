"""Trains so that a run killed at any moment can be taken up again, and stops where numbers are no longer finite."""

from __future__ import annotations

import dataclasses
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path

import torch
import yaml
from nerfstudio.engine.trainer import TRAIN_INTERATION_OUTPUT, Trainer, TrainerConfig
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import remove_leftovers, write_text
from edge_depth_nerf.pipeline import NotFiniteError
from edge_depth_nerf.runs import checkpoints_in, newest_checkpoint


@dataclass
class EdgeDepthTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with checkpoints that are whole, and with finite numbers."""

    _target: type = field(default_factory=lambda: EdgeDepthTrainer)
    """Target class to instantiate."""

    def save_config(self) -> None:
        """Save config.yml as nerfstudio does, but atomically: half of one could not be loaded any more."""
        path = self.get_base_dir() / "config.yml"
        CONSOLE.log(f"Saving config to: {path}")
        write_text(path, yaml.dump(self))
        remove_leftovers(path.parent)


class EdgeDepthTrainer(Trainer):
    """nerfstudio's trainer with checkpoints that are whole, and with finite numbers."""

    config: EdgeDepthTrainerConfig  # pyright: ignore[reportIncompatibleVariableOverride]

    def train_iteration(self, step: int) -> TRAIN_INTERATION_OUTPUT:
        """Do a step as nerfstudio does.

        Raises:
            InputError: a loss was not finite; it says in which pictures, and which checkpoint was kept.

        """
        try:
            return super().train_iteration(step)
        except NotFiniteError as error:
            raise InputError(f"{error} {self._kept()}") from error

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save into a folder beside the checkpoints, then move the whole file there.

        nerfstudio writes in place: a kill in that moment leaves half a file as the newest checkpoint. The folder
        lies outside, since resuming parses every name in the checkpoint folder.

        Raises:
            InputError: a parameter is not finite, or the file cannot be written; the checkpoint before is kept.

        """
        for name, parameter in self.pipeline.model.named_parameters():
            # a sum is not finite if one of its terms is not
            if not torch.isfinite(parameter.detach().sum(dtype=torch.float64)):
                raise InputError(
                    f"The parameter {name} is no longer finite after step {step}: a gradient was not. {self._kept()}"
                )
        folder = self.checkpoint_dir
        partial = self.base_dir / ".unfinished_checkpoint"
        shutil.rmtree(partial, ignore_errors=True)
        self.checkpoint_dir = partial
        try:
            try:
                super().save_checkpoint(step)
            finally:
                self.checkpoint_dir = folder
            folder.mkdir(parents=True, exist_ok=True)
            (written,) = partial.iterdir()
            os.replace(written, folder / written.name)
        except (OSError, RuntimeError) as error:
            # torch says no more than that it failed
            raise InputError(
                f"{folder}: the checkpoint of step {step} cannot be written ({error}). Is the disk full? {self._kept()}"
            ) from error
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        if self.config.save_only_latest_checkpoint:
            for checkpoint in folder.glob("*.ckpt"):
                if checkpoint.name != written.name:
                    checkpoint.unlink()

    def _load_checkpoint(self) -> None:
        """Load a checkpoint as nerfstudio does; of `load_dir` the newest that is whole.

        Raises:
            InputError: there is none.

        """
        folder = self.config.load_dir
        if folder is None or self.config.load_step is not None:
            super()._load_checkpoint()
            return
        newest = newest_checkpoint(folder)
        every = checkpoints_in(folder)
        if newest is None:
            found = f"{len(every)} checkpoints, none of them whole" if every else "no checkpoint"
            raise InputError(
                f"{folder}: found {found}; --load-dir takes the folder nerfstudio_models of a training. Leave it out "
                "to begin from the start."
            )
        if newest != every[-1]:
            CONSOLE.print(f"[bold yellow]{every[-1]} is not whole; going on from {newest.name}.")
        given = self.config
        self.config = dataclasses.replace(given, load_step=_step_of(newest))
        try:
            super()._load_checkpoint()
        finally:
            self.config = given

    def _kept(self) -> str:
        """Say what can be gone on from."""
        newest = newest_checkpoint(self.checkpoint_dir)
        if newest is None and self.config.load_dir is not None:
            newest = newest_checkpoint(self.config.load_dir)
        if newest is None:
            return "No checkpoint was saved before."
        return f"The last checkpoint, {newest}, is kept; --load-dir {newest.parent} goes on from it."


def _step_of(checkpoint: Path) -> int:
    return int(checkpoint.stem.removeprefix("step-"))
