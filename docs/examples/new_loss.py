"""A loss of one's own on the depth prior: Huber's, on the ratio of rendered to prior distance.

It takes the place of Eq. 4; prior, batches, metrics and everything else stay as they are.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.plugins.types import MethodSpecification
from torch import Tensor

from edge_depth_nerf.plugin.config import edge_depth_nerf_lite
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel, EdgeDepthNerfModelConfig


def ratio_loss(
    weights: Float[Tensor, "rays samples"],
    middles_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    delta: float,
) -> Float[Tensor, ""]:
    """Huber's loss of log(rendered / prior), mean over the rays that have a prior."""
    has_prior = prior_m > 0
    rendered_m = (weights * middles_m).sum(-1) + 1e-3  # a ray may still be empty
    ratio = torch.log(rendered_m / torch.where(has_prior, prior_m, 1))
    loss = torch.nn.functional.huber_loss(ratio, torch.zeros_like(ratio), reduction="none", delta=delta)
    return torch.where(has_prior, loss, 0).sum() / has_prior.sum().clamp(min=1)


@dataclass
class RatioModelConfig(EdgeDepthNerfModelConfig):
    """Our model with the loss above."""

    _target: type = field(default_factory=lambda: RatioModel)
    """Target class to instantiate."""
    ratio_delta: float = 0.1
    """From this logarithm of the ratio on the loss grows linearly."""


class RatioModel(EdgeDepthNerfModel):
    """Our model with the loss above."""

    config: RatioModelConfig

    def _depth_loss(
        self,
        weights: Float[Tensor, "rays samples 1"],
        samples: RaySamples,
        outputs: dict[str, Any],
        batch: dict[str, Any],
    ) -> Float[Tensor, ""]:
        middles_m = (samples.frustums.starts + samples.frustums.ends) / 2 * self.metres_per_unit
        prior_m = batch["prior_distance_m"].to(weights)
        return ratio_loss(weights[..., 0], middles_m[..., 0], prior_m[..., 0], self.config.ratio_delta)


def ratio() -> MethodSpecification:
    """The method that nerfstudio registers: edge-depth-nerf-lite with another model."""
    config = copy.deepcopy(edge_depth_nerf_lite.config)
    config.method_name = "ratio"
    of_lite = {name: value for name, value in vars(config.pipeline.model).items() if name != "_target"}
    config.pipeline.model = RatioModelConfig(**{**of_lite, "depth_loss_mult": 0.1})
    return MethodSpecification(config=config, description="Huber's loss on the ratio of distances.")
