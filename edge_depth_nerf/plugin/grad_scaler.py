"""The scale of mixed precision's losses, without waiting for the GPU in each step."""

from __future__ import annotations

from typing import Any

import torch

STEPS_PER_LOOK = 50
"""Once in so many steps the scale is read from the device."""


class PatientGradScaler(torch.amp.GradScaler):
    """torch's, but asked for its scale it gives that of its last look.

    nerfstudio's trainer asks twice in each step, to leave the learning rates alone where a step was skipped, and each
    time host and device wait for each other. Here what was skipped between two looks leaves them alone once.
    """

    def __init__(self, enabled: bool) -> None:
        super().__init__("cuda", enabled=enabled)
        self._seen = super().get_scale()
        self._updates = 0

    def get_scale(self) -> float:
        """Give the scale that was read last."""
        return self._seen

    def update(self, new_scale: Any = None) -> None:
        """Adapt the scale after a step; in some steps, look at it.

        Where gradients are added up over several steps, no optimiser may have stepped: the scale stays.
        """
        if self._enabled and new_scale is None:
            states = self._per_optimizer_states.values()
            if not any(state["found_inf_per_device"] for state in states):
                return
        super().update(new_scale)
        self.look()

    def look(self) -> None:
        """Look at the scale, if it is time; after a step whose scale was adapted by `torch.amp.GradScaler.update`."""
        self._updates += 1
        if self._updates % STEPS_PER_LOOK == 0:
            self._seen = super().get_scale()

    def forget(self) -> None:
        """Drop what an interrupted step has left."""
        if self._enabled:
            self._per_optimizer_states.clear()

    def state_dict(self) -> dict[str, Any]:
        """Give what a checkpoint keeps, with the present scale."""
        self._seen = super().get_scale()
        return super().state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a checkpoint's state; that of a training on a CPU is empty, and the scale starts again."""
        if state_dict:
            super().load_state_dict(state_dict)
            self._seen = super().get_scale()
