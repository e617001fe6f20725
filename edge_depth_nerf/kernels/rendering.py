"""What a pixel is made of, whichever kernels compute it."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Background(IntEnum):
    """What colours light that no sample stops."""

    BLACK = 0
    """Nothing."""
    LAST_SAMPLE = 1
    """The colour of the ray's last sample, as in nerfacto."""
    POINT = 2
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


class Rendered(NamedTuple):
    """Pixels, and what losses read."""

    rgb: Float[Tensor, "rays 3"]
    accumulation: Float[Tensor, "rays 1"]
    """The sum of the weights."""
    weights: Float[Tensor, "rays samples"]
    point_rgb: Float[Tensor, "points 3"]
    """Colours of the single points that are no ray's background."""
