"""How sure a rendered distance is: the spread of where along the ray the light stops.

Pure. Lengths come back in the unit in which they are given.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

SMALLEST_WEIGHT = 1e-8
"""A ray whose weights add up to less is stopped by nothing."""


def termination_std(
    weights: Float[Tensor, "rays samples"], starts: Float[Tensor, "rays samples"], ends: Float[Tensor, "rays samples"]
) -> Float[Tensor, "rays"]:
    """Compute the standard deviation of a ray's termination distribution.

    The distribution is even within each sample's interval (h_k = w_k / Δt_k of Eq. 4), and normalised: what passes all
    samples does not count. Where nothing stops the ray, every place on it is as likely as any other. No weight is
    negative.
    """
    lengths = ends - starts
    stopped = weights.sum(-1, keepdim=True)
    share = torch.where(stopped > SMALLEST_WEIGHT, weights, lengths)
    share = share / share.sum(-1, keepdim=True)
    midpoints = torch.lerp(starts, ends, 0.5)
    mean = (share * midpoints).sum(-1, keepdim=True)
    # about the mean: float32 has no digits left after subtracting the squares of a kilometre
    return (share * torch.addcmul((midpoints - mean).square(), lengths, lengths, value=1 / 12)).sum(-1).sqrt()
