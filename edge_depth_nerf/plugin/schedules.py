"""Schedules that follow the length of the training: learning rates and warm-ups.

Their lengths are shares of all steps of a training, also of one that is resumed, or numbers of steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig

USUAL_STEPS = 30_000
"""Of a training whose length no trainer states."""


def in_steps(length: float, steps: int) -> int:
    """Turn a length into steps: below 1 it is a share of the training's `steps`, else it is in steps already."""
    return round(length * steps if length < 1 else length)


def proposals_in_steps(config: Any, steps: int) -> None:
    """Turn the proposal networks' warm-up and annealing into steps of a training, as nerfacto reads them; in place."""
    for name in ("proposal_warmup", "proposal_weights_anneal_max_num_iters"):
        setattr(config, name, max(1, in_steps(getattr(config, name), steps)))


@dataclass
class TrainingScheduleConfig(ExponentialDecaySchedulerConfig):
    """nerfstudio's exponential decay, over the steps of the training unless a number of steps is given."""

    max_steps: int | None = None  # pyrefly: ignore
    """The step from which the learning rate is `lr_final`. Not set: the end of the training."""
    warmup_steps: float = 0.0  # pyrefly: ignore
    """How long the learning rate rises: below 1 a share of the training, else steps."""

    def over(self, steps: int) -> ExponentialDecaySchedulerConfig:
        """Make nerfstudio's own for a training of `steps` steps in all."""
        warmup = in_steps(self.warmup_steps, steps)
        return ExponentialDecaySchedulerConfig(
            lr_pre_warmup=self.lr_pre_warmup,
            lr_final=self.lr_final,
            warmup_steps=warmup,
            # nerfstudio divides by what is between the two
            max_steps=max(steps if self.max_steps is None else self.max_steps, warmup + 1),
            ramp=self.ramp,
        )

    def setup(self, **kwargs: Any) -> Any:
        """Make the scheduler of a training of `USUAL_STEPS`, until `follow_training` states how many there are."""
        return self.over(USUAL_STEPS).setup(**kwargs)


def follow_training(optimizers: Optimizers, steps: int) -> None:
    """Let the schedules of learning rates end after `steps` steps in all.

    A resumed training then has the rates of one in one go, even if it was to be shorter before.
    """
    for name, before in optimizers.schedulers.items():
        config = optimizers.config[name]
        if isinstance(config["scheduler"], TrainingScheduleConfig):
            after = config["scheduler"].over(steps).setup().get_scheduler(before.optimizer, config["optimizer"].lr)
            if before.last_epoch > 0:
                after.load_state_dict(before.state_dict())
                # once more to this step, which sets its rate
                after.last_epoch -= 1
                after.step()
            optimizers.schedulers[name] = after
