"""What a pixel is made of, whichever kernels compute it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Bool, Float, Int
from torch import Tensor


class Behind(IntEnum):
    """What colours light that no sample stops."""

    NOTHING = 0
    """Black."""
    LAST_SAMPLE = 1
    """The colour of the ray's last sample, as in nerfacto."""
    SINGLE_POINT = 2
    """The colour of a point of its own for each ray."""


class Networks(NamedTuple):
    """Two networks, the second one behind the first, as nerfacto's field has them.

    The first one's first output becomes the density. The second one gets the other outputs and what a ray has, and
    gives the colour.
    """

    first: tuple[Sequence[Tensor], Sequence[Tensor]]
    """Weights, [out, in], and biases of its layers."""
    second: tuple[Sequence[Tensor], Sequence[Tensor]]
    """Likewise; the weights of its first layer are for the first network's outputs alone."""
    by_ray: Float[Tensor, "width shared"]
    """Those of that layer for what rays have."""


class Supervision(NamedTuple):
    """What a batch tells of its pixels: of those of the rays, then of further ones with a point each."""

    image: Float[Tensor, "pixels 3"]
    """Their colours."""
    counts: Bool[Tensor, "further"]
    """Which further pixels say something."""
    gains: Float[Tensor, "pictures 3"]
    """Factors of the colours of each picture. Differentiable."""
    pictures: Int[Tensor, "pixels"]
    """Which picture a pixel is from."""
    edges: Float[Tensor, "rays edges"]
    """Where samples begin and the last one ends, ascending, in the spacing of 0..1."""
    starts: Float[Tensor, "rays samples"]
    """Distances of the samples, scene units."""
    ends: Float[Tensor, "rays samples"]
    prior_m: Float[Tensor, "rays"]
    """d̃; 0: none."""
    sigma_m: Float[Tensor, "rays"]
    """σ̂."""
    sky: Bool[Tensor, "rays"]
    """Which rays reach the sky."""
    metres_per_unit: float
    interval: bool
    """The form of Eq. 4, as in `method.losses.edge_loss`, and likewise the rest."""
    divide_by_norm: bool
    eps: float
    narrow: float


class Losses(NamedTuple):
    """Losses of the pixels and of the final samples, each a number."""

    colour: Float[Tensor, ""]
    """Mean squared error of the colours of the rays."""
    surface: Float[Tensor, ""]
    """The same of all further pixels; one that does not count has none."""
    edge: Float[Tensor, ""]
    """Eq. 4, mean over the rays that have a prior."""
    distortion: Float[Tensor, ""]
    """mip-NeRF 360's, mean over the rays."""
    sky: Float[Tensor, ""]
    """What rays into the sky hit, mean over them."""


class Rendered(NamedTuple):
    """Pixels, and what losses read."""

    rgb: Float[Tensor, "rays 3"]
    """With supervision, as their pictures have them."""
    accumulation: Float[Tensor, "rays 1"]
    """The sum of the weights."""
    weights: Float[Tensor, "rays samples"]
    further: Float[Tensor, "points 3"]
    """Colours of the single points that are not behind a ray; with supervision, as their pictures have them."""
    losses: Losses | None = None
    """With supervision."""
