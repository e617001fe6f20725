"""A loss of one's own on the depth prior: Huber's, on the ratio of rendered to prior distance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import huber_loss

from edge_depth_nerf.method.depth_losses import DepthLoss, Level


@dataclass(frozen=True)
class RatioLoss(DepthLoss):
    """Huber's loss of log(rendered / prior)."""

    delta: float = 0.1
    """From this logarithm of the ratio on, the loss grows linearly."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give the loss of each ray; 0 without a prior."""
        has_prior = level.prior_m > 0
        midpoints_m = (level.starts_m + level.ends_m) / 2
        rendered_m = (level.weights * midpoints_m).sum(-1) + 1e-3  # a ray may still be empty
        ratio = torch.log(rendered_m / torch.where(has_prior, level.prior_m, 1))
        loss = huber_loss(ratio, torch.zeros_like(ratio), reduction="none", delta=self.delta)
        return torch.where(has_prior, loss, 0)
