"""The compared methods: what each overrides of the one configuration. Light to import."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast, get_args

from edge_depth_nerf.compare.options import MethodName, Preset, Sigma

LAMBDA = "pipeline.model.depth_loss_mult"
"""The weight of the depth loss, in every method."""
_SOURCE = "pipeline.datamanager.depth_source"
_LOSS = "pipeline.model.depth_loss"
_EXPOSURE = "pipeline.model.exposure"
_PRIOR_SIGMA = "pipeline.datamanager.prior.sigma_constant_m"
SIGMA_MODE = "pipeline.datamanager.prior.sigma_mode"
_KERNEL = "pipeline.datamanager.prior.integration.kernel"
WITHOUT_EXTRAS: dict[str, Any] = {
    "pipeline.model.surface_loss_mult": 0.0,
    "pipeline.datamanager.surface_rays_per_batch": 0,
    "pipeline.model.sky_loss_mult": 0.0,
    "pipeline.model.sky_background": False,
    "pipeline.model.depth_loss_final": 1.0,
}
"""No colours at the surface, no sky loss, no colour at infinity, a λ that stays: what any depth loss can have, too."""


Loss = Literal["none", "urban-nerf", "urban-nerf-los", "ds-nerf", "edge"]
PriorName = Literal["lidar", "integrated"]


@dataclass(frozen=True)
class Cell:
    """A method's place in the grid of `compare --grid`."""

    loss: Loss
    prior: PriorName | None
    """None: it uses none."""
    extras: bool
    """Whether it has surface, sky and a λ that falls."""


@dataclass(frozen=True)
class Method:
    """A row of the tables."""

    name: MethodName
    title: str
    """What the tables call it."""
    overrides: Mapping[str, Any]
    """Dotted names of the configuration that it sets; in all else it is the preset."""
    needs: tuple[str, ...] = ()
    """What a scene must have for it: "lidar", "mono"."""
    sigma: Mapping[str, Any] = field(default_factory=dict)
    """Further overrides that come with a σ of its own; `sigma_field` takes the number."""
    sigma_field: str | None = None
    """Dotted name of σ, metres; None without a depth loss."""
    literal: bool = False
    """Whether it is the published method to the letter: what the preset paper sets beyond the size of full, from
    nerfstudio_method.toml."""
    rival: bool = False
    """Whether it is nerfstudio's, not ours."""
    cell: Cell | None = None
    """Its place in the grid, if it has one."""
    only_in_grid: bool = False
    """Whether it is trained in the grid, or where it is named, alone."""


_NERFACTO = {_LOSS: "none", _SOURCE: "none", **WITHOUT_EXTRAS}
_NEEDS: dict[PriorName, tuple[str, ...]] = {"lidar": ("lidar",), "integrated": ("lidar", "mono")}
PRIOR_TITLES: dict[PriorName, str] = {"lidar": "LiDAR", "integrated": "integrated"}
EXTRAS_TITLES = {False: "without extras", True: "with extras"}
"""What the grid calls priors and extras."""


def _edge(
    name: MethodName,
    title: str,
    needs: tuple[str, ...],
    depth_source: str = "integrated",
    literal: bool = False,
    overrides: Mapping[str, Any] | None = None,
    cell: Cell | None = None,
) -> Method:
    # a σ in metres takes the place of the one that the prior has at each pixel
    sigma = {SIGMA_MODE: "constant"}
    named = {_LOSS: "edge", _SOURCE: depth_source, **(overrides or {})}
    return Method(name, title, named, needs, sigma, _PRIOR_SIGMA, literal=literal, cell=cell)


def _rival(name: MethodName, title: str, loss: Loss, prior: PriorName = "lidar", extras: bool = False) -> Method:
    sigma = f"pipeline.model.losses.{loss.replace('-', '_')}.sigma_m"
    named = {_LOSS: loss, _SOURCE: prior, LAMBDA: 0.01, sigma: 0.5, **({} if extras else WITHOUT_EXTRAS)}
    cell = Cell(loss, prior, extras)
    return Method(name, title, named, _NEEDS[prior], sigma_field=sigma, rival=not extras, cell=cell)


def _of_grid_alone(cell: Cell) -> Method:
    """A cell of the grid that is none of the paper's rows."""
    assert cell.prior is not None
    prior, extras = cell.prior, cell.extras
    words = f"{PRIOR_TITLES[prior]}, {EXTRAS_TITLES[extras]}"
    if cell.loss == "none":
        # the prior serves the extras alone
        named = {_LOSS: "edge", LAMBDA: 0.0, _SOURCE: prior}
        method = Method(_name(f"nerfacto-{prior}-extras"), f"no depth loss, {words}", named, _NEEDS[prior], cell=cell)
    elif cell.loss == "edge":
        name = _name("edge-lidar-plain" if prior == "lidar" else "edge-plain")
        method = _edge(name, f"ours, {words}", _NEEDS[prior], prior, overrides=WITHOUT_EXTRAS, cell=cell)
    else:
        name = f"{cell.loss}{'-integrated' if prior == 'integrated' else ''}{'-extras' if extras else ''}"
        method = _rival(_name(name), f"{LOSS_TITLES[cell.loss]}, {words}", cell.loss, prior, extras)
    return replace(method, only_in_grid=True)


def _of_the_literal(name: MethodName, title: str, needs: tuple[str, ...], **changed: Any) -> Method:
    """The literal method with one thing changed: a row of the paper's Table 3 or 4."""
    return replace(_edge(name, title, needs, literal=True, **changed), only_in_grid=True)


def _name(name: str) -> MethodName:
    assert name in get_args(MethodName), name
    return cast(MethodName, name)


LOSS_TITLES: dict[Loss, str] = {
    "none": "no depth loss",
    "urban-nerf": "UrbanNeRF loss",
    "urban-nerf-los": "UrbanNeRF, line of sight",
    "ds-nerf": "DS-NeRF loss",
    "edge": "edge loss",
}
"""What the grid calls the losses."""

METHODS: dict[MethodName, Method] = {
    method.name: method
    for method in (
        Method("nerfacto", "nerfacto", _NERFACTO, rival=True, cell=Cell("none", None, False)),
        Method(
            "nerfacto-embedding",
            "nerfacto, appearance embedding",
            {**_NERFACTO, _EXPOSURE: "embedding"},
            rival=True,
        ),
        _rival("urban-nerf", "UrbanNeRF loss", "urban-nerf"),
        _rival("urban-nerf-los", "UrbanNeRF, line of sight", "urban-nerf-los"),
        _rival("ds-nerf", "DS-NeRF loss", "ds-nerf"),
        _edge("edge-lidar", "LiDAR alone", ("lidar",), depth_source="lidar", cell=Cell("edge", "lidar", True)),
        _edge("edge-mono", "monocular alone", ("mono",), depth_source="mono"),
        _edge("edge-gaussian", "spatial Gaussian", ("lidar", "mono"), overrides={_KERNEL: "spatial-gaussian"}),
        _edge("edge-paper", "as published", ("lidar", "mono"), literal=True),
        _edge("edge", "ours", ("lidar", "mono"), cell=Cell("edge", "integrated", True)),
        _of_grid_alone(Cell("none", "lidar", True)),
        _of_grid_alone(Cell("none", "integrated", True)),
        _of_grid_alone(Cell("urban-nerf", "integrated", False)),
        _of_grid_alone(Cell("urban-nerf", "lidar", True)),
        _of_grid_alone(Cell("urban-nerf", "integrated", True)),
        _of_grid_alone(Cell("urban-nerf-los", "integrated", False)),
        _of_grid_alone(Cell("urban-nerf-los", "lidar", True)),
        _of_grid_alone(Cell("urban-nerf-los", "integrated", True)),
        _of_grid_alone(Cell("ds-nerf", "integrated", False)),
        _of_grid_alone(Cell("ds-nerf", "lidar", True)),
        _of_grid_alone(Cell("ds-nerf", "integrated", True)),
        _of_grid_alone(Cell("edge", "lidar", False)),
        _of_grid_alone(Cell("edge", "integrated", False)),
        _of_the_literal("edge-paper-lidar", "as published, LiDAR alone", ("lidar",), depth_source="lidar"),
        _of_the_literal("edge-paper-mono", "as published, monocular alone", ("mono",), depth_source="mono"),
        _of_the_literal(
            "edge-paper-gaussian",
            "as published, spatial Gaussian",
            ("lidar", "mono"),
            overrides={_KERNEL: "spatial-gaussian"},
        ),
    )
}
"""λ and σ of the rivals stand here; those of edge-… are the configuration's own, unless a search found better ones."""

GRID: dict[Cell, MethodName] = {method.cell: name for name, method in METHODS.items() if method.cell is not None}
"""Each loss with each prior, without and with the extras. Without a loss and extras no prior is used: one cell."""

assert tuple(METHODS) == get_args(MethodName)


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
            found |= {**method.sigma, method.sigma_field: float(self.sigma_m)}
        return found

    def __str__(self) -> str:
        return f"lambda {self.weight:g}, sigma {self.sigma_m}" + (" m" if self.sigma_m != "own" else "")


def default_methods(preset: Preset, with_loss: bool = False) -> tuple[MethodName, ...]:
    """All methods that differ from each other under a preset; `with_loss`: those that have a λ."""
    return tuple(
        method.name
        for method in METHODS.values()
        if not method.only_in_grid
        and not (preset == "paper" and method.literal)
        and not (with_loss and method.sigma_field is None)
    )
