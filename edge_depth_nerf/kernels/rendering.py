"""What a pixel is made of, whichever kernels compute it."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Behind(IntEnum):
    """What colours light that no sample stops."""

    NOTHING = 0
    """Black."""
    LAST_SAMPLE = 1
    """The colour of the ray's last sample, as in nerfacto."""
    SINGLE_POINT = 2
    """The colour of a point of its own for each ray."""


class Rendered(NamedTuple):
    """Pixels, and what losses read."""

    rgb: Float[Tensor, "rays 3"]
    accumulation: Float[Tensor, "rays 1"]
    """The sum of the weights."""
    weights: Float[Tensor, "rays samples"]
    further: Float[Tensor, "points 3"]
    """Colours of the single points that are not behind a ray."""
