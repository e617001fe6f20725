"""Losses of a training step: nerfacto's, and beside them those of the prior, of the sky and of surface pixels.

Host-facing; formulas stand in `method`. A loss is an object that reads a `Step` and gives a weighted number; the model
adds up those that its configuration asks for.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, make_dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Bool, Float
from nerfstudio.model_components.losses import lossfun_outer
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels.functions import DISTORTION_LOSS, INTERLEVEL_LOSS
from edge_depth_nerf.method.depth_losses import LOSSES, VARIABLE, DepthLoss, Level, depth_loss, register
from edge_depth_nerf.method.losses import sky_loss
from edge_depth_nerf.plugin.fused.noise import normal
from edge_depth_nerf.plugin.fused.ray_samplers import edges_between, edges_of

register(os.environ.get(VARIABLE, ""))
if TYPE_CHECKING:
    DepthLossName = str

    class LossOptions:
        """Its fields are the registered losses, which a type checker cannot know."""

        def __init__(self, **losses: DepthLoss) -> None: ...
        def __getattr__(self, name: str) -> DepthLoss: ...
else:
    DepthLossName = Literal[(*LOSSES, "none")]
    """Names of losses on the prior."""
    LossOptions = make_dataclass(
        "LossOptions",
        [(name.replace("-", "_"), kind, field(default_factory=kind)) for name, kind in LOSSES.items()],
        namespace={"__module__": __name__, "__doc__": "Options of each loss on the distance prior."},
    )

LEAST_DISTANCE_M = 1e-6
"""What is nearer is no distance: without a prior it is 0."""
PROPER = torch.finfo(torch.float32).tiny, torch.finfo(torch.float32).max
"""Least and largest σ̂ of a prior."""
SHARP_M = 0.02
"""Standard deviation of a good scanner, metres."""


@dataclass(frozen=True)
class Planes:
    """Where samples lie along a ray."""

    near_m: float
    far_m: float
    metres_per_unit: float

    def hold(self, distance_m: Float[Tensor, "*rays"]) -> Bool[Tensor, "*rays"]:
        """Whether a distance lies between the planes; without a prior it is 0, in front of the near plane.

        No sample lies elsewhere: a prior there would draw all weight to the first sample or to the last.
        """
        return distance_m == distance_m.clamp(max(self.near_m, LEAST_DISTANCE_M), self.far_m)


@dataclass(frozen=True)
class Step:
    """What losses read."""

    outputs: Mapping[str, Any]
    """The model's, with `weights_list` and `ray_samples_list`, the final samples last."""
    batch: Mapping[str, Any]
    """The datamanager's."""
    planes: Planes
    share_done: float
    """The share of the training that is behind, 0 to 1."""
    depth_weight: float | Tensor
    """λ at this step."""
    surface_weight: float | Tensor = 1.0
    """That of surface pixels at this step."""


StepLoss = Callable[[Step], Tensor]
"""A loss of a training step: it gives a weighted number."""


@dataclass(frozen=True)
class PriorLoss:
    """λ times a loss on the distance prior."""

    loss: DepthLoss
    final_alone: bool
    """Whether it applies to the final samples only, not to those of the proposal networks."""
    mult: float = 0.0
    """λ at the start of the training."""
    sharp: float = 0.0
    """Rays whose σ̂ is at most this share of their distance, plus `SHARP_M`, keep that λ. 0: none do."""

    def __call__(self, step: Step) -> Float[Tensor, ""]:
        """Give the weighted loss."""
        prior_m, sigma_m = (
            step.batch[name][:, 0].to(step.outputs["rgb"].device, torch.float32)
            for name in ("prior_distance_m", "prior_sigma_m")
        )
        met = step.planes.hold(prior_m) & (sigma_m == sigma_m.clamp(*PROPER))
        prior_m = torch.where(met, prior_m, 0)
        every = [*zip(step.outputs["weights_list"], step.outputs["ray_samples_list"], strict=True)][::-1]
        every = every[:1] if self.final_alone else every
        none_learns = not any(weights.requires_grad for weights, _ in every)
        # a replayed step would have the share of the recorded one
        share_done = step.share_done if self.loss.varies else math.nan
        levels, final = [], None
        for weights, samples in every:
            if weights.requires_grad or self.loss.of_resting_levels or none_learns:
                edges_m = edges_between(samples.frustums.starts, samples.frustums.ends) * step.planes.metres_per_unit
                given = weights.squeeze(-1), edges_m[:, :-1], edges_m[:, 1:], prior_m, sigma_m, final
                levels.append(Level(*given, share_done))
                final = final or levels[0]
        if self.sharp <= 0:
            return step.depth_weight * depth_loss(self.loss, levels, len(every))
        sharp = sigma_m <= self.sharp * prior_m + SHARP_M
        weights = torch.where(sharp, self.mult, step.depth_weight)
        return depth_loss(self.loss, levels, len(every), weights)


@dataclass(frozen=True)
class SkyLoss:
    """What rays into the sky hit: the mean over the levels of samples."""

    mult: float

    def __call__(self, step: Step) -> Float[Tensor, ""]:
        """Give the weighted loss."""
        every = step.outputs["weights_list"]
        sky = step.batch["sky"][:, 0].to(every[-1].device)
        # of all their weights in one row
        return self.mult / len(every) * sky_loss(torch.cat([weights.squeeze(-1) for weights in every], dim=1), sky)


def surface_loss(step: Step) -> Float[Tensor, ""]:
    """Give the weighted colour error of the field at the surfaces of surface pixels, mean over those of use."""
    batch, image, of_use = step.batch, step.batch["surface_image"], step.batch.get("surface_counts")
    # a surface between the planes, or the sky
    counts = batch["surface_sky"] | step.planes.hold(batch["surface_distance_m"])
    counts = counts if of_use is None else counts & of_use
    # no error of others; choosing pixels would make a GPU wait
    error = torch.nn.functional.mse_loss(torch.where(counts, step.outputs["surface_rgb"], image), image)
    loss = step.surface_weight * error
    return loss if of_use is None else loss / of_use.mean(dtype=torch.float32).clamp(min=1 / len(of_use))


def step_losses_of(config: Any) -> dict[str, StepLoss]:
    """Give the losses beside nerfacto's that a model's configuration asks for, by their names.

    Raises:
        InputError: the loss on the prior is not registered.
    """
    name = config.depth_loss
    if name == "none":
        return {}
    if name not in LOSSES:
        raise InputError(
            f"--pipeline.model.depth-loss {name}: there is no such loss; expected one of {', '.join(LOSSES)}, none. "
            f"One of your own is registered by the environment variable {VARIABLE}={name}=MODULE:CLASS."
        )
    # config.yml may be from before a loss was registered
    loss = getattr(config.losses, name.replace("-", "_"), None) or LOSSES[name]()
    losses: dict[str, StepLoss] = {}
    if config.depth_loss_mult > 0:
        final_alone, mult = config.depth_loss_levels == "final", config.depth_loss_mult
        sharp = config.depth_loss_sharp if config.depth_loss_final < 1 else 0.0
        losses[f"{name.replace('-', '_')}_loss"] = PriorLoss(loss, final_alone, mult, sharp)
    if config.sky_loss_mult > 0:
        losses["sky_loss"] = SkyLoss(config.sky_loss_mult)
    if config.surface_loss_mult > 0:
        losses["surface_loss"] = surface_loss
    return losses


def draw_surface_m(batch: Mapping[str, Any], planes: Planes) -> Float[Tensor, "pixels"]:
    """Draw where the surface of each surface pixel is: any place within what its prior leaves open, metres.

    Nothing is rendered in front of the near plane or behind the far one: what is drawn there is mirrored at the prior,
    to its other side.
    """
    distance_m, sigma_m = batch["surface_distance_m"][:, 0], batch["surface_sigma_m"][:, 0]
    noise = normal(len(sigma_m), sigma_m.device)
    drawn_m, mirrored_m = (torch.addcmul(distance_m, sigma_m, noise, value=side) for side in (1, -1))
    beyond = drawn_m != drawn_m.clamp(planes.near_m, planes.far_m)
    return torch.where(beyond, mirrored_m, drawn_m).clamp(planes.near_m, planes.far_m)


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (its Eq. 15), mean over the rays.

    Edges of samples ascend, in the spacing of 0..1.
    """
    compute = None if edges.requires_grad else DISTORTION_LOSS.compiled_for(edges, weights)
    return (compute or formulas.distortion_loss)(edges, weights)


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    proposal_edges: Float[Tensor, "rays proposal_edges"],
    proposal_weights: Float[Tensor, "rays proposal_samples"],
) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's interlevel loss (its Eq. 13) of one proposal network, mean over the samples.

    `weights` are taken as given: the gradient goes to `proposal_weights` alone.
    """
    given = edges, weights.detach(), proposal_edges, proposal_weights
    compute = INTERLEVEL_LOSS.compiled_for(*given)
    return lossfun_outer(*given).mean() if compute is None else compute(*given)


def distortion_of(outputs: Mapping[str, Any]) -> Float[Tensor, ""]:
    """Compute nerfacto's distortion loss, without its weight."""
    return distortion_loss(edges_of(outputs["ray_samples_list"][-1]), outputs["weights_list"][-1].squeeze(-1))


def interlevel_of(outputs: Mapping[str, Any]) -> Float[Tensor, ""]:
    """Compute nerfacto's loss of the proposal networks, without its weight."""
    *proposals, final = (
        (edges_of(samples), weights.squeeze(-1))
        for samples, weights in zip(outputs["ray_samples_list"], outputs["weights_list"], strict=True)
    )
    losses = [interlevel_loss(*final, *proposal) for proposal in proposals]
    return sum(losses[1:], losses[0])
