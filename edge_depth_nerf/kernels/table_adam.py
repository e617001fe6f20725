"""Adam for hash tables on the CPU, whose gradients are summed up and used level by level.

A table of 50 MB has a gradient of 50 MB. torch fills it with zeros, adds to it, reads it in Adam and drops it. Here
backward keeps what the gradient is made of: the points, and the gradient to their encoded values (`TablePart`). Adam
sums up the gradient of one level, 4 MB that stay in a cache, does its step with it, and goes on to the next level.
The steps are those of torch's Adam, and so is what checkpoints hold.

Importing this module does not import Numba; the first step does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from jaxtyping import Float
from torch import Tensor

SUMS_LATER = "gradient_is_summed_later"
"""Attribute of a table's parameter: whether backward gives its optimiser no gradient, but what makes it."""
PARTS = "parts_of_gradient"
"""Attribute of such a parameter: a list of `TablePart` since the last step."""


class TablePart(NamedTuple):
    """What gives a gradient to a table: one pass of points through the hash grid."""

    positions: Float[Tensor, "points 3"]
    gradient: Float[Tensor, "points encoded"]
    """To the encoded values."""
    scalings: Float[Tensor, "levels"]


def keep_part(table: Tensor, part: TablePart) -> bool:
    """Keep what backward got for the table's optimiser. False: that optimiser wants the gradient itself."""
    # a table may have been moved since its optimiser saw it
    if not getattr(table, SUMS_LATER, False) or table.device.type != "cpu":
        return False
    parts = getattr(table, PARTS, None)
    if parts is None:
        parts = []
        setattr(table, PARTS, parts)
    parts.append(part)
    return True


def take_parts(table: Tensor) -> list[TablePart]:
    """Give what was kept of a table since the last call."""
    parts = getattr(table, PARTS, None) or []
    setattr(table, PARTS, None)
    return parts


class TableAdam(torch.optim.Adam):
    """torch's Adam; hash tables on the CPU get their gradients level by level, and `grad` stays None."""

    _whole: bool = False

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Take parameters; from here on the tables among them have no gradients of their own."""
        super().add_param_group(param_group)
        self._tell_tables(self.param_groups[-1])

    def want_whole_gradients(self) -> None:
        """Let tables have a whole gradient in `grad`, for what reads or changes it before the step."""
        self._whole = True
        for group in self.param_groups:
            self._tell_tables(group)

    def _tell_tables(self, group: dict[str, Any]) -> None:
        for table in self._tables(group):
            setattr(table, SUMS_LATER, self._may_sum(group))

    def _tables(self, group: dict[str, Any]) -> list[Tensor]:
        """List the tables of a group whose gradients this class may sum up itself."""
        return [table for table in group["params"] if hasattr(table, SUMS_LATER) and table.device.type == "cpu"]

    def _may_sum(self, group: dict[str, Any]) -> bool:
        """Say whether this class does the steps of a group's tables itself."""
        plain = not (group["amsgrad"] or group["maximize"] or group["weight_decay"] or group["differentiable"])
        # torch's hooks, by which processes share their gradients, are not called for what is summed up later
        alone = not (dist.is_available() and dist.is_initialized())
        return plain and alone and not self._whole

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """Do one step; tables that got no gradient are left alone, as torch leaves what has none."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        apart = []
        for group in self.param_groups:
            may_sum = self._may_sum(group)
            for table in self._tables(group):
                parts = take_parts(table)
                if parts and may_sum and table.grad is None:
                    apart.append((group, table, parts))
                else:
                    _add_to_grad(table, parts)
                setattr(table, SUMS_LATER, may_sum)
        super().step()
        for group, table, parts in apart:
            self._step_table(group, table, parts)
        return loss

    def _step_table(self, group: dict[str, Any], table: Tensor, parts: list[TablePart]) -> None:
        from edge_depth_nerf.kernels.table_adam_numba import step_levels

        state = self.state[table]
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(table), torch.zeros_like(table)
        state["step"] += 1
        step_levels(table, state, parts, group)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear gradients, and what was kept for them."""
        super().zero_grad(set_to_none)
        for group in self.param_groups:
            for table in self._tables(group):
                take_parts(table)


def _add_to_grad(table: Tensor, parts: list[TablePart]) -> None:
    """Sum up a table's gradient as torch has it."""
    from edge_depth_nerf.kernels.hash_grid_numba import table_gradient

    for part in parts:
        gradient = table_gradient(*part, len(table))
        table.grad = gradient if table.grad is None else table.grad + gradient
