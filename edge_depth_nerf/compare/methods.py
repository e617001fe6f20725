"""The compared methods: each is made from a loss, a prior and extras, and its name follows from them. Light to import.

A name is LOSS[-PRIOR][-EXTRAS]; what a loss usually has is not named. docs/compare.md explains it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, Literal, get_args

from edge_depth_nerf.base.errors import InputError

Preset = Literal["lite", "full", "paper"]
MethodName = str
Sigma = float | Literal["own"]
Loss = Literal["none", "urban-nerf", "urban-nerf-los", "ds-nerf", "edge"]
PriorName = Literal["lidar", "mono", "gaussian", "integrated"]

LOSS_TITLES: dict[Loss, str] = {
    "none": "no depth loss",
    "urban-nerf": "UrbanNeRF loss",
    "urban-nerf-los": "UrbanNeRF, line of sight",
    "ds-nerf": "DS-NeRF loss",
    "edge": "edge loss",
}
PRIOR_TITLES: dict[PriorName, str] = {
    "lidar": "LiDAR",
    "mono": "monocular",
    "gaussian": "spatial Gaussian",
    "integrated": "integrated",
}
SHORT_TITLES = {
    "nerfacto": "nerfacto",
    "nerfacto-embedding": "nerfacto, appearance embedding",
    "edge-paper": "as published",
    "edge": "ours",
    "edge-sharp": "ours, LiDAR keeps its weight",
}
EXTRAS_TITLES = {False: "without extras", True: "with extras"}
"""What the tables call losses, priors and extras, and methods as they usually are."""

LAMBDA = "pipeline.model.depth_loss_mult"
"""The weight of the depth loss, in every method."""
RIVALS: tuple[Loss, ...] = ("urban-nerf", "urban-nerf-los", "ds-nerf")
SIGMA_FIELDS: dict[Loss, str] = {
    "edge": "pipeline.datamanager.prior.sigma_constant_m",
    **{loss: f"pipeline.model.losses.{loss.replace('-', '_')}.sigma_m" for loss in RIVALS},
}
"""The options that take a loss's σ, metres."""
SIGMA_MODE = "pipeline.datamanager.prior.sigma_mode"
WITHOUT_EXTRAS: dict[str, Any] = {
    "pipeline.model.surface_loss_mult": 0.0,
    "pipeline.datamanager.surface_rays_per_batch": 0,
    "pipeline.model.sky_loss_mult": 0.0,
    "pipeline.model.sky_background": False,
    "pipeline.model.depth_loss_final": 1.0,
}
"""No colours at the surface, no sky loss, no colour at infinity, a λ that stays: what any depth loss can have, too."""


@dataclass(frozen=True)
class Method:
    """A row of the tables: a loss on a prior, with extras or without."""

    loss: Loss
    prior: PriorName | None
    """gaussian: integrated by the kernel without a depth factor. None: it uses none."""
    extras: bool
    """Whether it has surface, sky and a λ that falls."""
    variant: Literal["", "embedding", "paper", "sharp"] = ""
    """embedding: nerfstudio's own exposure model; paper: the published method to the letter, what the preset paper sets
    beyond the size of full; sharp: ours, whose λ stays where the prior is as sure as LiDAR."""

    @property
    def _usual(self) -> Method:
        """The one with the prior and the extras that a name leaves out."""
        if self.loss == "edge":
            return replace(self, prior="integrated", extras=self.variant != "paper")
        return replace(self, prior=None if self.loss == "none" else "lidar", extras=False)

    @property
    def differs_without_extras(self) -> bool:
        """Whether it is another method than all others where a preset has no extras."""
        return self.variant in ("", "embedding") and self.extras == self._usual.extras

    @cached_property
    def name(self) -> MethodName:
        """What the command line, folders and results call it."""
        loss = "nerfacto" if self.loss == "none" else self.loss
        prior = None if self.prior == self._usual.prior else self.prior
        extras = None if self.extras == self._usual.extras else "extras" if self.extras else "plain"
        return "-".join(word for word in (loss, self.variant, prior, extras) if word)

    @cached_property
    def title(self) -> str:
        """What the tables call it."""
        short = SHORT_TITLES.get(self._usual.name, LOSS_TITLES[self.loss])
        if self == self._usual or self.prior is None:
            return short
        prior = PRIOR_TITLES[self.prior]
        if self.loss == "edge" and self.extras == self._usual.extras:
            changed = f"{prior} alone" if self.prior in ("lidar", "mono") else prior
            return f"{short}, {changed}" if self.variant else changed
        loss = LOSS_TITLES["none"] if self.loss == "none" else short
        return f"{loss}, {prior}, {EXTRAS_TITLES[self.extras]}"

    @property
    def overrides(self) -> dict[str, Any]:
        """Dotted names of the configuration that it sets; in all else it is the preset."""
        loss: dict[str, Any] = {"pipeline.model.depth_loss": self.loss}
        if self.loss == "none" and self.extras:
            # the prior serves the extras alone
            loss = {"pipeline.model.depth_loss": "edge", LAMBDA: 0.0}
        elif self.loss in RIVALS:
            loss |= {LAMBDA: 0.01, SIGMA_FIELDS[self.loss]: 0.5}
        source = {None: "none", "gaussian": "integrated"}.get(self.prior, self.prior)
        kernel = {"pipeline.datamanager.prior.integration.kernel": "spatial-gaussian"}
        return {
            **loss,
            "pipeline.datamanager.depth_source": source,
            **(kernel if self.prior == "gaussian" else {}),
            **({"pipeline.model.exposure": "embedding"} if self.variant == "embedding" else {}),
            **({"pipeline.model.depth_loss_sharp": 0.02} if self.variant == "sharp" else {}),
            **({} if self.extras else WITHOUT_EXTRAS),
        }

    @property
    def needs(self) -> tuple[str, ...]:
        """What a scene must have for it: "lidar", "mono"."""
        if self.prior is None:
            return ()
        return (self.prior,) if self.prior in ("lidar", "mono") else ("lidar", "mono")

    @property
    def sigma_field(self) -> str | None:
        """Dotted name of σ, metres; None without a depth loss."""
        return SIGMA_FIELDS.get(self.loss)

    @property
    def by_default(self) -> bool:
        """Whether it is compared though nobody names it: each loss as usual, and ours with each prior."""
        if self.variant == "sharp":
            return False
        return self == self._usual or (self.loss == "edge" and self.extras and not self.variant)


def _every() -> Iterator[Method]:
    """Make all methods in the tables' order, but for those that are compared by default, which come first."""
    yield Method("none", None, False)
    yield Method("none", None, False, "embedding")
    for loss, extras, prior in product(get_args(Loss), (False, True), get_args(PriorName)):
        # without loss and extras nothing uses a prior
        if loss != "none" or extras:
            yield Method(loss, prior, extras)
    for prior in get_args(PriorName):
        yield Method("edge", prior, False, "paper")
    yield Method("edge", "integrated", True, "sharp")


METHODS: dict[MethodName, Method] = {
    method.name: method for method in sorted(_every(), key=lambda method: not method.by_default)
}
"""λ and σ of the rivals stand here; those of edge-… are the configuration's own, unless a search found better ones."""

GRID: dict[Method, MethodName] = {
    method: name
    for name, method in METHODS.items()
    if not method.variant and method.prior in (None, "lidar", "integrated")
}
"""The cells of the grid: each loss with each prior, without and with the extras."""


def check_name(name: str) -> None:
    """Make sure that a name is a method's.

    Raises:
        InputError: no method has it.
    """
    if name not in METHODS:
        usual = ", ".join(known for known, method in METHODS.items() if method == method._usual)
        close = difflib.get_close_matches(name, METHODS, 1, 0.6)
        meant = f" Is {close[0]} meant?" if close else ""
        raise InputError(
            f"--methods {name}: no such method.{meant} Expected {usual}; then -lidar, -mono, -gaussian or "
            "-integrated for another prior than usual; then -extras or -plain for other extras than usual."
        )


@dataclass(frozen=True)
class Setting:
    """λ and σ that a method is trained with; None: its own."""

    weight: float | None = None
    """λ, the weight of the depth loss."""
    sigma_m: Sigma | None = None
    """σ, metres, or own."""

    def overrides(self, method: Method) -> dict[str, Any]:
        """The dotted names that it sets for a method."""
        found: dict[str, Any] = {} if self.weight is None else {LAMBDA: self.weight}
        if isinstance(self.sigma_m, (int, float)) and method.sigma_field is not None:
            # a σ in metres takes the place of the one that the prior has at each pixel
            found |= {SIGMA_MODE: "constant"} if method.loss == "edge" else {}
            found[method.sigma_field] = float(self.sigma_m)
        return found

    def __str__(self) -> str:
        return "its own λ and σ" if self.weight is None else f"λ {self.weight:g} and σ {self.sigma_m}"


def default_methods(preset: Preset, with_loss: bool = False) -> tuple[MethodName, ...]:
    """All methods that are compared under a preset though nobody names them; `with_loss`: those that have a λ."""
    return tuple(
        name
        for name, method in METHODS.items()
        if method.by_default
        and not (preset == "paper" and method.variant == "paper")
        and not (with_loss and method.loss == "none")
    )
