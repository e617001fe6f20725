"""Formulas of losses: Eq. 4, which draws a ray's termination distribution towards the prior, its rivals, and the sky's.

Shapes: `[rays, samples]` along rays, `[rays]` for what a ray has once; no trailing singleton. Lengths are metres,
so that λ and σ̂ mean the same in every scene. A loss on the prior is a number for each ray, the sum over its samples; a
ray whose prior is 0 or not finite has none, and its loss is 0. Half precision is computed in float32, float64 in
float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.kernels.back_ends import Example, Function, GpuForm
from edge_depth_nerf.kernels.functions import Sizes, gpu_forms, on_gpu, spread

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
    sigma_m: Float[Tensor, "rays"],
    *,
    gaussian: Gaussian = "point",
    divide_by_norm: bool = False,
) -> Float[Tensor, "rays"]:
    """Compute Eq. 4 of each ray, L = -Σ_k log(w_k) · K_k · Δt_k.

    K_k = exp(-(t_k - d̃)² / 2σ̂²) at the sample's midpoint t_k, Δt_k its length. Eq. 4 has h_k = w_k / Δt_k for w_k;
    as samples' places are not learned the gradient is the same.

    The defaults are the literal form, for a σ̂ that is the same everywhere. Where σ̂ differs between pixels,
    `divide_by_norm` keeps an uncertain pixel from pulling harder than a certain one.

    Args:
        weights: rendering weights, 0 or more.
        starts_m: where each sample begins along its ray. A sample of no length, of negative length or with an end
            that is not finite gives nothing.
        ends_m: where it ends.
        prior_m: d̃.
        sigma_m: σ̂; a ray where it is 0 or not finite has no prior.
        gaussian: "point" takes K_k · Δt_k; "interval" the Gaussian's integral over the sample, which a Gaussian
            narrower than the samples cannot slip through.
        divide_by_norm: divide by σ̂ √(2π), the Gaussian's own integral; "interval" is then Φ(end) - Φ(start).

    Returns:
        The loss of each ray, connected to `weights` also where it is 0.

    Raises:
        InputError: shapes that do not fit, or an unknown `gaussian`.
    """
    if gaussian not in get_args(Gaussian):
        raise InputError(f"edge_loss: gaussian is {gaussian!r}; expected one of {get_args(Gaussian)}.")
    _check_shapes("edge_loss", weights, starts_m=starts_m, ends_m=ends_m, prior_m=prior_m, sigma_m=sigma_m)
    weights, starts, ends, prior, sigma = _exact(weights, starts_m, ends_m, prior_m, sigma_m)
    has_prior = (prior > 0) & torch.isfinite(prior) & (sigma > 0) & torch.isfinite(sigma)
    counts = has_prior[:, None] & (ends > starts) & torch.isfinite(starts) & torch.isfinite(ends)
    # what does not count gets harmless values before the arithmetic: `where` after it would let NaN into gradients
    prior, sigma = torch.where(has_prior, prior, 1)[:, None], torch.where(has_prior, sigma, 1)[:, None]
    starts, ends = torch.where(counts, starts, 0), torch.where(counts, ends, 1)
    weights = torch.where(has_prior[:, None], weights, 1)

    # in units of σ̂; the length from the ends themselves, as their distances to a far prior have lost digits
    start, end, length = (starts - prior) / sigma, (ends - prior) / sigma, (ends - starts) / sigma
    mass = _point_mass(start, length) if gaussian == "point" else _interval_mass(start, end, length)
    target = torch.where(counts, mass, 0)
    target = target / math.sqrt(2 * math.pi) if divide_by_norm else target * sigma
    return -(target * torch.log(weights + EPS)).sum(-1)


def _by_numba() -> Callable[..., Tensor]:
    from edge_depth_nerf.method import edge_loss_numba

    return edge_loss_numba.edge_loss


def _by_triton() -> Callable[..., Tensor]:
    from edge_depth_nerf.method import edge_loss_triton

    return edge_loss_triton.edge_loss


def _by_torch(*, interval: bool, divide_by_norm: bool, eps: float, narrow: float, **rays: Tensor) -> Tensor:
    """Compute `edge_loss` with the arguments of its kernels; EPS and NARROW are its own."""
    assert (eps, narrow) == (EPS, NARROW)
    return edge_loss(**rays, gaussian="interval" if interval else "point", divide_by_norm=divide_by_norm)


def _examples(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    """Samples of rays, of which some have no prior; both forms of the Gaussian."""
    rays, samples = sizes.rays, sizes.samples[-1]
    edges = 120 * spread(device, rays, samples + 1).sort(dim=1)[0]
    weights = (spread(device, rays, samples, seed=3) ** 4).requires_grad_()
    prior_m, sigma_m = 100 * spread(device, rays, seed=5) - 8, 0.2 + 8 * spread(device, rays, seed=7)
    given = {"weights": weights, "starts_m": edges[:, :-1], "ends_m": edges[:, 1:], "prior_m": prior_m}
    forms = ({"interval": True, "divide_by_norm": True}, {"interval": False, "divide_by_norm": False})
    return [{**given, "sigma_m": sigma_m, **form, "eps": EPS, "narrow": NARROW} for form in forms]


_ON_GPU = on_gpu("edge loss", _by_triton, _by_torch, _examples, tolerance=1e-4)
EDGE_LOSS = Function(_by_numba, _ON_GPU)
"""`edge_loss` in its compiled forms, differentiable once, by the weights alone."""


def step_kernels() -> list[GpuForm]:
    """List the kernels that a training step takes on a GPU; the first one is small."""
    return [_ON_GPU, *gpu_forms()]


def ds_nerf_loss(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    sigma_m: float,
) -> Float[Tensor, "rays"]:
    """Compute the DS-NeRF loss of each ray, -Σ_k log(w_k) · exp(-(t_k - z)² / 2σ²) · Δt_k.

    Deng et al., Depth-supervised NeRF, CVPR 2022, Eq. 6: Eq. 4's literal form with one σ for all rays. nerfstudio's
    divides by 2σ instead, so what it calls sigma is a variance. Arguments are those of `edge_loss`, with one σ.
    """
    return edge_loss(weights, starts_m, ends_m, prior_m, torch.full_like(prior_m, _positive("ds_nerf_loss", sigma_m)))


REACH_OF_NERFSTUDIO = 3.0
"""nerfstudio's UrbanNeRF loss takes its σ for the kernel's reach, of so many standard deviations."""


def urban_nerf_loss_of_nerfstudio(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    expected_m: Float[Tensor, "rays"],
    sigma_m: float,
) -> Float[Tensor, "rays"]:
    """Compute UrbanNeRF's loss of each ray as nerfstudio has it: (E - z)² + Σ near (w_k - K(t_k - z))² + Σ empty w_k².

    A midpoint t_k is near within σ of z, and empty before that; K is a Gaussian of standard deviation σ/3. Weights,
    which have no unit, are held against K, which is a density (nerfstudio issues 1793 and 1871). Arguments are those of
    `edge_loss`, with one σ, and E, the expected distance of the ray's final samples.
    """
    given = {"starts_m": starts_m, "ends_m": ends_m, "prior_m": prior_m, "expected_m": expected_m}
    _check_shapes("urban_nerf_loss_of_nerfstudio", weights, **given)
    weights, starts_m, ends_m, prior_m, expected_m = _exact(weights, starts_m, ends_m, prior_m, expected_m)
    deviation_m = _positive("urban_nerf_loss_of_nerfstudio", sigma_m) / REACH_OF_NERFSTUDIO
    has_prior = (prior_m > 0) & torch.isfinite(prior_m)
    prior = torch.where(has_prior, prior_m, 1)
    off = (starts_m + ends_m) / 2 - prior[:, None]
    kernel = torch.exp(-0.5 * (off / deviation_m) ** 2) / (deviation_m * math.sqrt(2 * math.pi))
    near = torch.where(off.abs() <= sigma_m, (weights - kernel) ** 2, 0)
    empty = torch.where(off < -sigma_m, weights**2, 0)
    return torch.where(has_prior, (expected_m - prior) ** 2 + (near + empty).sum(-1), 0)


KERNEL_REACH = 3.0
"""The kernel of UrbanNeRF's loss ends at so many of its standard deviations: ε = 3σ."""


def urban_nerf_loss(
    weights: Float[Tensor, "rays samples"],
    starts_m: Float[Tensor, "rays samples"],
    ends_m: Float[Tensor, "rays samples"],
    prior_m: Float[Tensor, "rays"],
    sigma_m: float,
    *,
    expected: float,
    empty: float,
    near: float,
) -> Float[Tensor, "rays"]:
    """Compute UrbanNeRF's loss on LiDAR of each ray: expected distance and line of sight.

    Rematas et al., Urban Radiance Fields, CVPR 2022, "Lidar losses". With z the prior, h(t) the density of where a ray
    ends, K a Gaussian of standard deviation σ = ε/3 that is cut at ±ε and has the integral 1:

        expected  (∫ h(t) t dt - z)²
        empty     ∫ h(t)² dt                up to z - ε
        near      ∫ (h(t) - K(t - z))² dt   from z - ε to z + ε

    Their third term of the line of sight, behind z + ε, is left out: weight behind is weight that near lacks.
    h(t) = w_k / Δt_k within a sample, and the integrals are exact for that, however short ε is. Arguments are those of
    `edge_loss`, with one σ, and the weights of the three terms: `expected` per m², `empty` and `near` in metres.

    Raises:
        InputError: shapes that do not fit, or a σ that is not positive.
    """
    _check_shapes("urban_nerf_loss", weights, starts_m=starts_m, ends_m=ends_m, prior_m=prior_m)
    _positive("urban_nerf_loss", sigma_m)
    weights, starts, ends, prior = _exact(weights, starts_m, ends_m, prior_m)
    has_prior = (prior > 0) & torch.isfinite(prior)
    counts = has_prior[:, None] & (ends > starts) & torch.isfinite(starts) & torch.isfinite(ends)
    # harmless values before the arithmetic, as in edge_loss
    prior = torch.where(has_prior, prior, 1)[:, None]
    weights = torch.where(counts, weights, 0)
    starts, ends = torch.where(counts, starts, 0), torch.where(counts, ends, 1)

    squared_error = ((weights * (starts + ends) / 2).sum(-1) - prior[:, 0]).square()
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

    of_empty = (density.square() * empty_m).sum(-1)
    of_near = (density * (density * near_m - 2 * mass)).sum(-1) + squared_kernel
    return torch.where(has_prior, expected * squared_error + empty * of_empty + near * of_near, 0)


def sky_loss(weights: Float[Tensor, "rays samples"], sky: Bool[Tensor, "rays"]) -> Float[Tensor, ""]:
    """Compute what rays into the sky hit: the sum of their weights, mean over them.

    0 where all of them reach the background, 1 where none does; 0, still connected to `weights`, without such rays.
    """
    hit = weights.sum(dim=1, dtype=torch.promote_types(weights.dtype, torch.float32))
    return (hit * (sky / sky.sum().clamp(min=1))).sum()


def _check_shapes(caller: str, weights: Tensor, **others: Tensor) -> None:
    """Make sure that weights are [rays, samples], and that the others fit: the samples' ends, or one number a ray.

    Raises:
        InputError: they do not.
    """
    if weights.ndim != 2:
        raise InputError(f"{caller}: weights {tuple(weights.shape)}; expected two dimensions, (rays, samples).")
    for name, tensor in others.items():
        expected = weights.shape if name in ("starts_m", "ends_m") else weights.shape[:1]
        if tensor.shape != expected:
            raise InputError(
                f"{caller}: {name} {tuple(tensor.shape)} does not fit weights {tuple(weights.shape)}; "
                f"expected {tuple(expected)}."
            )


def _positive(caller: str, sigma_m: float) -> float:
    """Give σ, metres.

    Raises:
        InputError: it is no positive number.
    """
    if not (math.isfinite(sigma_m) and sigma_m > 0):
        raise InputError(f"{caller}: sigma_m is {sigma_m}; expected a positive number of metres.")
    return sigma_m


def _exact(*tensors: Tensor) -> list[Tensor]:
    """Give tensors in float64 if one of them is, else in float32."""
    dtype = torch.float64 if any(tensor.dtype == torch.float64 for tensor in tensors) else torch.float32
    return [tensor.to(dtype) for tensor in tensors]


def _point_mass(start: Tensor, length: Tensor) -> Tensor:
    """Give exp(-z²/2) at the midpoint, times the length; all in units of σ̂."""
    midpoint = start + length / 2
    return torch.exp(-0.5 * midpoint**2) * length


def _interval_mass(start: Tensor, end: Tensor, length: Tensor) -> Tensor:
    """Give the integral of exp(-z²/2) from start to end; all in units of σ̂."""
    midpoint = start + length / 2
    narrow = _point_mass(start, length) * (1 + (midpoint**2 - 1) * length**2 / 24)
    wide = math.sqrt(math.pi / 2) * (torch.erf(end / math.sqrt(2)) - torch.erf(start / math.sqrt(2)))
    return torch.where(length < NARROW, narrow, wide)
