"""Values in the colours of a scale, made where the values are: the viewer asks for some views each second."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.base.pictures import NO_VALUE_RGB, ColourScale


@functools.lru_cache
def _table(scale: ColourScale, device: torch.device) -> Tensor:
    """Give the colours of a scale and, last, that of no value, [257, 3] in 0..1."""
    rows = np.concatenate([scale.colours, np.array([NO_VALUE_RGB], np.uint8)])
    return torch.from_numpy(rows).to(device).float() / 255


def coloured(values: Float[Tensor, "h w"], scale: ColourScale) -> Float[Tensor, "h w 3"]:
    """Colour values as `ColourScale.coloured` does, those that are finite; 0..1, on their device."""
    clipped = values.clamp(scale.low, scale.high)
    if scale.logarithmic:
        position = (clipped / scale.low).log() / math.log(scale.high / scale.low)
    else:
        position = (clipped - scale.low) / (scale.high - scale.low)
    steps = (position * 255).round()
    steps = torch.where(values.isfinite(), steps, 256)
    return _table(scale, values.device)[steps.long()].to(values)
