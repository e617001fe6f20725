"""Adam for hash tables on the CPU, whose gradients are added in place.

A table of 50 MB has a gradient of 50 MB. torch makes it again in each step: it is filled with zeros, added to, read by
Adam and dropped. Here one array stays: backward adds to it (`hash_grid`), and Adam clears each number after reading it.
The steps are those of torch's Adam, and so is what checkpoints hold.

Importing this module does not import Numba; the first step does.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

IN_PLACE = "gradient_is_added_in_place"
"""Attribute of a table's parameter: whether backward adds to its `grad`, where it has one, and returns none."""
CLEARED = "gradient_is_cleared"
"""Attribute of such a parameter: whether its `grad` is all zeros, as Adam left it."""


def adds_in_place(table: Tensor) -> bool:
    """Whether backward has to add to `table.grad`."""
    return getattr(table, IN_PLACE, False) and table.grad is not None


class TableAdam(torch.optim.Adam):
    """torch's Adam; hash tables on the CPU have gradients that stay where they are."""

    def _tables(self, group: dict[str, Any]) -> list[Tensor]:
        """The tables of a group that this class steps itself."""
        plain = not (group["amsgrad"] or group["maximize"] or group["weight_decay"] or group["differentiable"])
        # torch's hooks, by which processes share their gradients, are not called for what is added in place
        alone = not (dist.is_available() and dist.is_initialized())
        if not (plain and alone):
            return []
        return [table for table in group["params"] if hasattr(table, IN_PLACE) and table.device.type == "cpu"]

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Do one step; tables that no gradient was added to are left alone, as torch leaves what has none."""
        apart = [(group, table, table.grad) for group in self.param_groups for table in self._tables(group)]
        for _, table, _ in apart:
            table.grad = None
        loss = super().step(closure)
        for group, table, gradient in apart:
            table.grad = gradient
            if gradient is not None and not getattr(table, CLEARED, False):
                self._step_table(group, table, gradient)
                setattr(table, IN_PLACE, True)
                setattr(table, CLEARED, True)
        return loss

    def _step_table(self, group: dict[str, Any], table: Tensor, gradient: Tensor) -> None:
        from edge_depth_nerf.kernels.table_adam_numba import adam

        state = self.state[table]
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
        state["step"] += 1
        step, (beta1, beta2) = float(state["step"]), group["betas"]
        adam(
            *(each.detach().view(-1).numpy() for each in (table, gradient, state["exp_avg"], state["exp_avg_sq"])),
            beta1=beta1,
            beta2=beta2,
            rate=float(group["lr"]) / (1 - beta1**step),
            spread=math.sqrt(1 - beta2**step),
            eps=group["eps"],
        )

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear gradients; those of tables that are clear stay."""
        every = [table for group in self.param_groups for table in self._tables(group)]
        kept = [(table, table.grad) for table in every if getattr(table, CLEARED, False)]
        super().zero_grad(set_to_none)
        for table, gradient in kept:
            table.grad = gradient
