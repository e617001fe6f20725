"""The edge loss (Eq. 4): draws a ray's termination distribution towards the integrated depth prior; and a rival's.

Shapes: `[rays, samples]` along rays, `[rays]` for what a ray has once; no trailing singleton. Lengths are metres,
so that λ and σ̂ mean the same in every scene. Reduction: sum over the samples, mean over the rays that have a prior.
Half precision is computed in float32, float64 in float64.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.kernels.back_ends import of_edge_loss

Gaussian = Literal["point", "interval"]

EPS = 1e-7
"""Added to the weights inside the logarithm: a sample of weight 0 counts as one of 1e-7, and the gradient there is
at most 1e7 times the sample's part of the Gaussian. nerfstudio's depth losses have the same value."""

NARROW = 0.05
"""Below this length, in units of σ̂, an interval's mass comes from its midpoint (with the second-order term; relative
error under 1e-6), because the difference of two values of Φ would lose float32's digits."""


def edge_loss(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    sigma_m: Float[Tensor, "rays"] | float,
    *,
    gaussian: Gaussian = "point",
    divide_by_norm: bool = False,
) -> Float[Tensor, ""]:
    """Compute Eq. 4, L = -Σ_k log(w_k) · K_k · Δt_k, mean over the rays that have a prior.

    K_k = exp(-(t_k - d̃)² / 2σ̂²) at the sample's middle t_k, Δt_k its length. Eq. 4 has h_k = w_k / Δt_k for w_k;
    as samples' places are not learned the gradient is the same.

    The defaults are the literal form, for a σ̂ that is the same everywhere. Where σ̂ differs between pixels,
    `divide_by_norm` keeps an uncertain pixel from pulling harder than a certain one.

    Args:
        weights: rendering weights, 0 or more.
        starts_m: where each sample begins along its ray. A sample of no length, of negative length or with an end
            that is not finite gives nothing.
        ends_m: where it ends.
        prior_m: d̃; a ray where it is 0 or not finite has no prior, adds nothing and is not counted.
        sigma_m: σ̂; a ray where it is 0 or not finite likewise has no prior. A float must be positive.
        gaussian: "point" takes K_k · Δt_k; "interval" the Gaussian's integral over the sample, which a Gaussian
            narrower than the samples cannot slip through.
        divide_by_norm: divide by σ̂ √(2π), the Gaussian's own integral; "interval" is then Φ(end) - Φ(start).

    Returns:
        The loss; 0, still connected to `weights`, if no ray has a prior.

    Raises:
        InputError: shapes that do not fit, a σ̂ that is not positive, or an unknown `gaussian`.

    """
    if gaussian not in get_args(Gaussian):
        raise InputError(f"edge_loss: gaussian is {gaussian!r}; expected one of {get_args(Gaussian)}.")
    _check_shapes(
        "edge_loss", weights, {"starts_m": starts_m, "ends_m": ends_m}, {"prior_m": prior_m, "sigma_m": sigma_m}
    )
    if not isinstance(sigma_m, Tensor):
        if not (math.isfinite(sigma_m) and sigma_m > 0):
            raise InputError(f"edge_loss: sigma_m is {sigma_m}; expected a positive number of metres.")
        sigma_m = torch.full_like(prior_m, sigma_m, dtype=torch.promote_types(prior_m.dtype, torch.float32))

    inputs = (weights, starts_m, ends_m, prior_m, sigma_m)
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in inputs) else torch.float32
    weights, starts, ends, prior, sigma = (tensor.to(dtype) for tensor in inputs)

    has_prior = (prior > 0) & torch.isfinite(prior) & (sigma > 0) & torch.isfinite(sigma)
    if weights.device.type == "cpu":
        # a GPU would have to wait for how many there are
        chosen = has_prior.nonzero()[:, 0]
        weights, starts, ends = (tensor[chosen] for tensor in (weights, starts, ends))
        prior, sigma, has_prior = (tensor[chosen] for tensor in (prior, sigma, has_prior))
    counts = has_prior[:, None] & (ends > starts) & torch.isfinite(starts) & torch.isfinite(ends)
    # what does not count gets harmless values before the arithmetic: `where` after it would let NaN into gradients
    prior, sigma = torch.where(has_prior, prior, 1)[:, None], torch.where(has_prior, sigma, 1)[:, None]
    starts, ends = torch.where(counts, starts, 0), torch.where(counts, ends, 1)

    # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
    start, end, length = (starts - prior) / sigma, (ends - prior) / sigma, (ends - starts) / sigma
    mass = _point_mass(start, length) if gaussian == "point" else _interval_mass(start, end, length)
    target = torch.where(counts, mass, 0)
    target = target / math.sqrt(2 * math.pi) if divide_by_norm else target * sigma
    total = -(target * torch.log(weights + EPS)).sum()
    return total / has_prior.sum().clamp(min=1)


def edge_losses(
    levels: Sequence[tuple[Float[Tensor, "rays _"], Float[Tensor, "rays _"], Float[Tensor, "rays _"]]],
    prior_m: Float[Tensor, "rays"],
    sigma_m: Float[Tensor, "rays"],
    *,
    metres_per_unit: float = 1.0,
    gaussian: Gaussian = "point",
    divide_by_norm: bool = False,
) -> Float[Tensor, "levels"]:
    """Compute `edge_loss` of several levels of samples of the same rays, by kernels where there are some.

    Args:
        levels: rendering weights of each, and where its samples begin and end, in any unit of length.
        prior_m: d̃, as in `edge_loss`.
        sigma_m: σ̂ likewise.
        metres_per_unit: metres in one unit of the samples' starts and ends.
        gaussian: as in `edge_loss`.
        divide_by_norm: as in `edge_loss`.

    Returns:
        The loss of each level. By kernels it is differentiable once, and by the weights alone; where starts, ends or
        the prior ask for a gradient, or a tensor is float64, torch computes it.

    Raises:
        InputError: as in `edge_loss`.

    """
    weights, starts, ends = zip(*levels, strict=True)
    every = (*weights, *starts, *ends, prior_m, sigma_m)
    is_float = all(each.dtype in (torch.float32, torch.float16, torch.bfloat16) for each in every)
    of_weights_alone = not any(each.requires_grad for each in (*starts, *ends, prior_m, sigma_m))
    kernels = of_edge_loss(prior_m.device) if is_float and of_weights_alone else None
    if kernels is None or gaussian not in get_args(Gaussian):
        per_level = [
            edge_loss(
                weight,
                start * metres_per_unit,
                end * metres_per_unit,
                prior_m,
                sigma_m,
                gaussian=gaussian,
                divide_by_norm=divide_by_norm,
            )
            for weight, start, end in levels
        ]
        return torch.stack(per_level)
    for weight, start, end in levels:
        _check_shapes("edge_losses", weight, {"starts": start, "ends": end}, {"prior_m": prior_m, "sigma_m": sigma_m})
    return kernels.edge_losses(
        levels,
        prior_m,
        sigma_m,
        metres_per_unit=metres_per_unit,
        interval=gaussian == "interval",
        divide_by_norm=divide_by_norm,
        eps=EPS,
        narrow=NARROW,
    )


KERNEL_REACH = 3.0
"""The kernel of UrbanNeRF's loss ends at so many of its standard deviations: ε = 3σ."""


@dataclass(frozen=True)
class UrbanTerms:
    """Weights of the terms of UrbanNeRF's loss, beside λ, and how its kernel narrows.

    In metres an error of ten metres counts 100 and the other terms a few at most, so `expected` weighs a hundredth.
    """

    expected: float = 0.01
    """Weight of the squared error of the expected distance, per m²."""
    empty: float = 1.0
    """Weight of the light that ends before the surface, metres."""
    near: float = 1.0
    """Weight of how light ends at the surface, metres."""
    narrowing: float = 10.0
    """Ratio of σ at the start of training to σ at its end; it decreases exponentially."""

    def sigma_m(self, last_m: float, share: float) -> float:
        """σ, metres, after a share of the training, 0 to 1; `last_m` is that of the end."""
        return last_m * self.narrowing ** (1 - share)


URBAN_TERMS = UrbanTerms()


def urban_nerf_loss(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    sigma_m: float,
    terms: UrbanTerms = URBAN_TERMS,
) -> Float[Tensor, ""]:
    """Compute UrbanNeRF's loss on LiDAR: expected distance and line of sight, mean over the rays that have a prior.

    Rematas et al., Urban Radiance Fields, CVPR 2022, "Lidar losses". With z the prior, h(t) the density of where a ray
    ends, K a Gaussian of standard deviation σ = ε/3 that is cut at ±ε and has the integral 1:

        expected  (∫ h(t) t dt - z)²
        empty     ∫ h(t)² dt                up to z - ε
        near      ∫ (h(t) - K(t - z))² dt   from z - ε to z + ε

    Their third term of the line of sight, behind z + ε, is left out: weight behind is weight that near lacks.
    h(t) = w_k / Δt_k within a sample, and the integrals are exact for that, however short ε is.
    nerfstudio's form holds weights, which have no unit, against K, which is a density (nerfstudio issues 1793 and
    1871), adds all terms at one weight, and takes K at the samples' middles.

    Args:
        weights: rendering weights, 0 or more.
        starts_m: where each sample begins along its ray. A sample of no length, of negative length or with an end
            that is not finite gives nothing.
        ends_m: where it ends.
        prior_m: z; a ray where it is 0 or not finite has no prior, adds nothing and is not counted.
        sigma_m: σ; ε is three times that. It narrows over a training: `UrbanTerms.sigma_m`.
        terms: weights of the three; their units make the loss a number.

    Returns:
        The loss; 0, still connected to `weights`, if no ray has a prior.

    Raises:
        InputError: shapes that do not fit, or a σ that is not positive.

    """
    _check_shapes("urban_nerf_loss", weights, {"starts_m": starts_m, "ends_m": ends_m}, {"prior_m": prior_m})
    if not (math.isfinite(sigma_m) and sigma_m > 0):
        raise InputError(f"urban_nerf_loss: sigma_m is {sigma_m}; expected a positive number of metres.")
    inputs = (weights, starts_m, ends_m, prior_m)
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in inputs) else torch.float32
    weights, starts, ends, prior = (tensor.to(dtype) for tensor in inputs)

    has_prior = (prior > 0) & torch.isfinite(prior)
    counts = has_prior[:, None] & (ends > starts) & torch.isfinite(starts) & torch.isfinite(ends)
    # harmless values before the arithmetic, as in edge_loss
    prior = torch.where(has_prior, prior, 1)[:, None]
    weights = torch.where(counts, weights, 0)
    starts, ends = torch.where(counts, starts, 0), torch.where(counts, ends, 1)

    expected = ((weights * (starts + ends) / 2).sum(-1) - prior[:, 0]).square()
    density = weights / (ends - starts)
    reach_m = KERNEL_REACH * sigma_m
    first, last = prior - reach_m, prior + reach_m
    empty_m = (torch.minimum(ends, first) - starts).clamp(min=0)
    inner_starts, inner_ends = torch.maximum(starts, first), torch.minimum(ends, last)
    near_m = (inner_ends - inner_starts).clamp(min=0)
    # of a sample that does not reach the kernel the mass is that of no length
    start = ((inner_starts - prior) / sigma_m).clamp(-KERNEL_REACH, KERNEL_REACH)
    whole = math.sqrt(2 * math.pi) * math.erf(KERNEL_REACH / math.sqrt(2))
    mass = _interval_mass(start, start + near_m / sigma_m, near_m / sigma_m) / whole
    squared_kernel = math.sqrt(math.pi) * math.erf(KERNEL_REACH) / (sigma_m * whole**2)

    empty = (density.square() * empty_m).sum(-1)
    near = (density * (density * near_m - 2 * mass)).sum(-1) + squared_kernel
    per_ray = terms.expected * expected + terms.empty * empty + terms.near * near
    return torch.where(has_prior, per_ray, 0).sum() / has_prior.sum().clamp(min=1)


def sky_loss(weights: Float[Tensor, "rays samples"], sky: Bool[Tensor, "rays"]) -> Float[Tensor, ""]:
    """Compute what rays into the sky hit: the sum of their weights, mean over them.

    Args:
        weights: rendering weights, 0 or more.
        sky: which rays are known to reach the sky.

    Returns:
        0 where all of them reach the background, 1 where none does; 0, still connected to `weights`, without such rays.

    """
    hit = weights.sum(dim=1, dtype=torch.promote_types(weights.dtype, torch.float32))
    return (hit * (sky / sky.sum().clamp(min=1))).sum()


def _check_shapes(
    caller: str, weights: Tensor, per_sample: Mapping[str, Tensor], per_ray: Mapping[str, Tensor | float]
) -> None:
    """Make sure that weights are [rays, samples], and that the others fit.

    Raises:
        InputError: they do not.

    """
    if weights.ndim != 2:
        raise InputError(f"{caller}: weights {tuple(weights.shape)}; expected two dimensions, (rays, samples).")
    rules = {name: weights.shape for name in per_sample} | {name: weights.shape[:1] for name in per_ray}
    for name, tensor in {**per_sample, **per_ray}.items():
        if isinstance(tensor, Tensor) and tensor.shape != rules[name]:
            raise InputError(
                f"{caller}: {name} {tuple(tensor.shape)} does not fit weights {tuple(weights.shape)}; "
                f"expected {tuple(rules[name])}."
            )


def _point_mass(start: Tensor, length: Tensor) -> Tensor:
    """Give exp(-z²/2) at the middle, times the length; all in units of σ̂."""
    middle = start + length / 2
    return torch.exp(-0.5 * middle**2) * length


def _interval_mass(start: Tensor, end: Tensor, length: Tensor) -> Tensor:
    """Give the integral of exp(-z²/2) from start to end; all in units of σ̂."""
    middle = start + length / 2
    narrow = _point_mass(start, length) * (1 + (middle**2 - 1) * length**2 / 24)
    wide = math.sqrt(math.pi / 2) * (torch.erf(end / math.sqrt(2)) - torch.erf(start / math.sqrt(2)))
    return torch.where(length < NARROW, narrow, wide)
