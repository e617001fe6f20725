"""Losses on the distance prior by name: objects with their own options, which a training looks up in one table.

A loss gives a number for each ray of a level of samples; the model averages it over the rays, adds up the levels and
multiplies by λ. One of your own is a frozen dataclass of the same protocol, registered under a name:
docs/extending.md.
"""

from __future__ import annotations

import keyword
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import ClassVar

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.method.losses import (
    EDGE_LOSS,
    EPS,
    NARROW,
    Gaussian,
    ds_nerf_loss,
    edge_loss,
    urban_nerf_loss,
    urban_nerf_loss_of_nerfstudio,
)


@dataclass(frozen=True)
class Level:
    """What a loss knows of the samples of one level: the final ones, or those of a proposal network."""

    weights: Float[Tensor, "rays samples"]
    """Rendering weights, 0 or more."""
    starts_m: Float[Tensor, "rays samples"]
    """Where each sample begins along its ray, metres."""
    ends_m: Float[Tensor, "rays samples"]
    """Where it ends."""
    prior_m: Float[Tensor, "rays"]
    """The prior's distance, metres; 0 where there is none."""
    sigma_m: Float[Tensor, "rays"]
    """The prior's standard deviation, metres; positive where there is one."""
    final: Level | None = None
    """The final samples of the same rays; None where these are."""
    share_done: float = 0.0
    """The share of the training that is behind, 0 to 1; NaN for a loss that does not say that it `varies`."""

    @cached_property
    def expected_m(self) -> Float[Tensor, "rays"]:
        """Expected distance of the samples, metres, as nerfstudio renders it."""
        midpoints = (self.starts_m + self.ends_m) / 2
        expected = (self.weights * midpoints).sum(-1) / (self.weights.sum(-1) + 1e-10)
        return expected.clamp(midpoints.detach().min(), midpoints.detach().max())


@dataclass(frozen=True)
class DepthLoss:
    """A loss on the distance prior; its fields are its options."""

    over_all_rays: ClassVar[bool] = False
    """Whether rays without a prior are counted in the mean."""
    of_resting_levels: ClassVar[bool] = False
    """Whether a level whose proposal network is not updated in this step still has a gradient, to the final samples."""
    varies: ClassVar[bool] = False
    """Whether it changes over a training beside λ, so that a recorded step cannot be replayed."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give the loss of each ray, differentiable by the weights; 0 for a ray without a prior."""
        raise NotImplementedError


@dataclass(frozen=True)
class EdgeLoss(DepthLoss):
    """Eq. 4, with the prior's own σ̂."""

    gaussian: tyro.conf.Suppress[Gaussian] = "interval"
    """How Eq. 4 weighs a sample: by the Gaussian's value at its midpoint times its length, or by the Gaussian's mass
    over its interval."""
    divide_by_norm: tyro.conf.Suppress[bool] = True
    """Divide Eq. 4's Gaussian by σ̂·√(2π), so that a wide one does not pull harder than a narrow one."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give Eq. 4 of each ray, by a kernel where one serves."""
        given = level.weights, level.starts_m, level.ends_m, level.prior_m, level.sigma_m
        is_float = all(each.dtype in (torch.float32, torch.float16, torch.bfloat16) for each in given)
        of_weights_alone = not any(each.requires_grad for each in given[1:])
        compute = EDGE_LOSS.on(level.prior_m.device) if is_float and of_weights_alone else None
        if compute is None:
            return edge_loss(*given, gaussian=self.gaussian, divide_by_norm=self.divide_by_norm)
        options = {"interval": self.gaussian == "interval", "divide_by_norm": self.divide_by_norm}
        return compute(*given, **options, eps=EPS, narrow=NARROW)


@dataclass(frozen=True)
class DsNerfLoss(DepthLoss):
    """The DS-NeRF loss, averaged over all rays, as in nerfstudio."""

    over_all_rays: ClassVar[bool] = True
    sigma_m: float = 0.5
    """Standard deviation of the prior, metres."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give the loss of each ray."""
        return ds_nerf_loss(level.weights, level.starts_m, level.ends_m, level.prior_m, self.sigma_m)


@dataclass(frozen=True)
class UrbanNerfLoss(DepthLoss):
    """UrbanNeRF's loss as nerfstudio has it: the final samples' expected distance counts in every level."""

    over_all_rays: ClassVar[bool] = True
    of_resting_levels: ClassVar[bool] = True
    sigma_m: float = 0.5
    """Standard deviation of the prior, metres."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give the loss of each ray."""
        expected_m = (level.final or level).expected_m
        given = level.weights, level.starts_m, level.ends_m, level.prior_m, expected_m
        return urban_nerf_loss_of_nerfstudio(*given, self.sigma_m)


@dataclass(frozen=True)
class UrbanNerfSightLoss(DepthLoss):
    """UrbanNeRF's loss as its authors publish it: line of sight with a narrowing σ, and separate weights.

    In metres an error of ten metres counts 100 and the other terms a few at most, so `expected` weighs a hundredth.
    """

    varies: ClassVar[bool] = True
    sigma_m: float = 0.5
    """Standard deviation of the kernel at the end of the training, metres."""
    expected: tyro.conf.Suppress[float] = 0.01
    """Weight of the squared error of the expected distance, per m²."""
    empty: tyro.conf.Suppress[float] = 1.0
    """Weight of the light that ends before the surface, metres."""
    near: tyro.conf.Suppress[float] = 1.0
    """Weight of how light ends at the surface, metres."""
    narrowing: tyro.conf.Suppress[float] = 10.0
    """Ratio of σ at the start of training to σ at its end; it decreases exponentially."""

    def __call__(self, level: Level) -> Float[Tensor, "rays"]:
        """Give the loss of each ray."""
        sigma_m = self.sigma_m * self.narrowing ** (1 - level.share_done)
        weights = {"expected": self.expected, "empty": self.empty, "near": self.near}
        return urban_nerf_loss(level.weights, level.starts_m, level.ends_m, level.prior_m, sigma_m, **weights)


LOSSES: dict[str, type[DepthLoss]] = {
    "edge": EdgeLoss,
    "ds-nerf": DsNerfLoss,
    "urban-nerf": UrbanNerfLoss,
    "urban-nerf-los": UrbanNerfSightLoss,
}
"""The losses by name."""
GROUP = "edge_depth_nerf.depth_losses"
"""Entry points of this group in installed packages add losses under their names."""
VARIABLE = "EDGE_DEPTH_NERF_LOSSES"
"""Environment variable that adds losses: NAME=MODULE:CLASS, separated by commas."""


def register(named: str) -> None:
    """Add to `LOSSES` those of installed packages, and those that `VARIABLE`'s value names; warn of what is none."""
    words = [word.partition("=") for word in named.split(",") if word.strip()]
    further = [EntryPoint(name.strip(), value.strip(), VARIABLE) for name, _, value in words]
    for entry in [*entry_points(group=GROUP), *further]:
        try:
            found = entry.load()
            if not issubclass(found, DepthLoss):
                raise TypeError("it is not derived from DepthLoss")
            option = entry.name.replace("-", "_")
            if not option.isidentifier() or keyword.iskeyword(option):
                raise ValueError("its name cannot be that of an option")
            others = {name.replace("-", "_") for name, kind in LOSSES.items() if (name, kind) != (entry.name, found)}
            if option in {"none", *others}:
                raise ValueError("there is another loss of this name")
            found()  # every option needs a default
        except Exception as error:  # whatever somebody's module raises
            warnings.warn(
                f"{entry.group}: the loss {entry.name}={entry.value} is left out ({type(error).__name__}: {error}); "
                "expected NAME=MODULE:CLASS.",
                stacklevel=2,
            )
        else:
            LOSSES[entry.name] = found


def depth_loss(
    loss: DepthLoss, levels: Sequence[Level], count: int | None = None, weights: Float[Tensor, "rays"] | None = None
) -> Float[Tensor, ""]:
    """Compute a loss on the prior: mean over the rays, then over the levels.

    Args:
        loss: what to compute.
        levels: of the same rays and prior. Those without a gradient would only add a number and may be left out, unless
            the loss wants them (`of_resting_levels`).
        count: how many levels there are; None: these.
        weights: what the loss of each ray is multiplied by; None: 1.
    """
    prior_m = levels[0].prior_m
    rays = len(prior_m) if loss.over_all_rays else (prior_m > 0).sum().clamp(min=1)
    per_ray = [loss(level) for level in levels]
    per_level = [each.sum() if weights is None else (each * weights).sum() for each in per_ray]
    return sum(per_level[1:], per_level[0]) / (rays * (count or len(levels)))
