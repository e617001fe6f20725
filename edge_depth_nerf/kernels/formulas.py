"""What kernels compute, as formulas in torch, of any precision: tests and the trial on a GPU compare with them.

Pure: knows nothing of nerfstudio. Shapes and arguments are those of the kernels.
"""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

HARMONICS = 16
"""Spherical harmonics of four degrees."""
EPS = 1e-7
"""nerfstudio's, in the interlevel loss."""


def cube(positions: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
    """Contract positions in units of the scene box to -2..2, as mip-NeRF 360's Eq. 10 does it, in the infinity norm."""
    norm = positions.abs().amax(dim=-1, keepdim=True)
    return torch.where(norm < 1, positions, (2 - 1 / norm) * (positions / norm))


def contract(positions: Float[Tensor, "points 3"]) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Contract positions to 0..1; also give 1 for those strictly inside, else 0. What is not inside becomes 0."""
    places = (cube(positions) + 2) / 4
    inside = ((places > 0) & (places < 1)).all(dim=-1).to(positions)
    return places * inside[..., None], inside


def distances(
    places: Float[Tensor, "rays places"], nears: Float[Tensor, "rays 1"], fars: Float[Tensor, "rays 1"]
) -> Float[Tensor, "rays places"]:
    """Give distances along rays of places from 0, the near plane, to 1, the far one, in nerfstudio's spacing."""
    near, far = (torch.where(each < 1, each / 2, 1 - 1 / (2 * each)) for each in (nears, fars))
    x = torch.lerp(near, far, places)
    return torch.where(x < 0.5, 2 * x, 1 / (2 - 2 * x))


def harmonics(directions: Float[Tensor, "rays 3"], dtype: torch.dtype | None = None) -> Float[Tensor, "rays 16"]:
    """Encode directions as nerfacto does, by the real spherical harmonics of four degrees of (d + 1) / 2."""
    x, y, z = ((directions + 1) / 2).unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    one, two, three = math.sqrt(3 / math.pi) / 2, math.sqrt(15 / math.pi) / 2, math.sqrt(35 / (2 * math.pi)) / 4
    middle = math.sqrt(21 / (2 * math.pi)) / 4
    every = (
        *(torch.full_like(x, math.sqrt(1 / math.pi) / 2), one * y, one * z, one * x),
        *(two * x * y, two * y * z, math.sqrt(5 / math.pi) / 4 * (3 * zz - 1), two * x * z, two / 2 * (xx - yy)),
        *(three * y * (3 * xx - yy), math.sqrt(105 / math.pi) / 2 * x * y * z, middle * y * (5 * zz - 1)),
        *(math.sqrt(7 / math.pi) / 4 * z * (5 * zz - 3), middle * x * (5 * zz - 1)),
        *(math.sqrt(105 / math.pi) / 4 * z * (xx - yy), three * x * (xx - 3 * yy)),
    )
    return torch.stack(every, dim=1).to(dtype or directions.dtype)


def density(before: Float[Tensor, "points"], inside: Float[Tensor, "points"], scale: float) -> Float[Tensor, "points"]:
    """Compute densities of a network's outputs, in the type of `inside`; 0 where a point is not inside."""
    return scale * before.to(inside).exp() * inside


def weights_from_densities(
    densities: Float[Tensor, "rays samples"], deltas: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays samples"]:
    """Compute rendering weights of samples of these lengths; what is not a number weighs nothing."""
    depth = densities * deltas
    before = F.pad(depth[:, :-1].cumsum(1), (1, 0))
    return torch.nan_to_num((1 - (-depth).exp()) * (-before).exp())


def sample_pdf(
    weights: Float[Tensor, "rays intervals"],
    edges: Float[Tensor, "rays edges"],
    wanted: Float[Tensor, "rays places"],
    padding: float,
    least: float,
) -> Float[Tensor, "rays places"]:
    """Invert the cumulative distribution of a histogram over each ray; arguments as in `ray_numba.sample_pdf`."""
    intervals, weights = weights.shape[1], weights + padding
    total = weights.sum(1, keepdim=True)
    share = (weights + (least - total).clamp(min=0) / intervals) / total.clamp(min=least)
    cumulative = F.pad(share.cumsum(1).clamp(max=1), (1, 0))
    above = torch.searchsorted(cumulative, wanted.contiguous(), side="right").clamp(max=intervals)
    low, high = cumulative.gather(1, above - 1), cumulative.gather(1, above)
    start, end = edges.gather(1, above - 1), edges.gather(1, above)
    return start + torch.nan_to_num((wanted - low) / (high - low), 0.0).clamp(0, 1) * (end - start)


def interlevel_loss(
    edges: Float[Tensor, "rays edges"],
    weights: Float[Tensor, "rays samples"],
    outer_edges: Float[Tensor, "rays outer_edges"],
    outer_weights: Float[Tensor, "rays outer_samples"],
) -> Float[Tensor, ""]:
    """Compute the interlevel loss of mip-NeRF 360 (Eq. 13), mean over the samples; `weights` are taken as given.

    The outermost intervals stand for what lies beyond them.
    """
    begins, ends = outer_edges[:, None, :-1].clone(), outer_edges[:, None, 1:].clone()
    begins[..., 0], ends[..., -1] = -math.inf, math.inf
    touched = (ends > edges[:, :-1, None]) & (begins <= edges[:, 1:, None])
    excess = (weights.detach() - (touched * outer_weights[:, None]).sum(-1)).clamp(min=0)
    return (excess.square() / (weights.detach() + EPS)).mean()


def distortion_loss(edges: Float[Tensor, "rays edges"], weights: Float[Tensor, "rays samples"]) -> Float[Tensor, ""]:
    """Compute mip-NeRF 360's distortion loss (Eq. 15), mean over the rays.

    Σ_ij w_i w_j |m_i - m_j| + 1/3 Σ_i w_i² Δ_i, with midpoints m and lengths Δ of the samples. As the midpoints ascend,
    the double sum is 2 Σ_i w_i (m_i Σ_j<i w_j - Σ_j<i w_j m_j): two cumulative sums instead of samples² terms.
    """
    midpoints = (edges[:, 1:] + edges[:, :-1]) / 2
    # the sums up to and including i: what i itself adds cancels
    before, before_midpoints = weights.cumsum(dim=-1), (weights * midpoints).cumsum(dim=-1)
    between = 2 * (weights * (midpoints * before - before_midpoints)).sum(dim=-1)
    within = (weights**2 * (edges[:, 1:] - edges[:, :-1])).sum(dim=-1) / 3
    return (between + within).mean()


def hash_grid(
    positions: Float[Tensor, "points 3"],
    table: Float[Tensor, "rows features"],
    scalings: Float[Tensor, "levels"],
    dtype: torch.dtype | None = None,
) -> Float[Tensor, "points encoded"]:
    """Encode points; see the module `hash_grid`."""
    levels, rows = len(scalings), len(table) // len(scalings)
    scaled = positions[:, None] * scalings[:, None]
    low = scaled.floor()
    primes, place = (1, 2654435761, 805459861), scaled - low
    hashed = [[each[..., axis].long() * primes[axis] for axis in range(3)] for each in (low, scaled.ceil())]
    first = rows * torch.arange(levels, device=positions.device)
    encoded = torch.zeros_like(scaled[..., :1])
    for corner in itertools.product((0, 1), repeat=3):
        x, y, z = (hashed[upper][axis] for axis, upper in enumerate(corner))
        shares = [place[..., axis] if upper else 1 - place[..., axis] for axis, upper in enumerate(corner)]
        encoded = encoded + math.prod(shares)[..., None] * table[first + (x ^ y ^ z) % rows]  # pyrefly: ignore
    return encoded.flatten(1).to(dtype or positions.dtype)
