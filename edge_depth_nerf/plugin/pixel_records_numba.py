"""Packed records of pixels (`pixel_table`) as numbers, in one pass; on the CPU.

Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.threads import in_parts

BYTES = 15
"""Of a record: colour (3 bytes), then distance, sigma, picture (4 bytes), row and column; low bytes first."""
LEAST_SHARE = 1 << 13
"""A thread gets at least so many records."""
WHITE = np.float32(255)


@compiled()
@no_type_check
def _word(packed, at):
    return np.int64(packed[at]) | np.int64(packed[at + 1]) << 8


@compiled()
@no_type_check
def _unpack(packed, indices, rgb, distance, sigma, sky, steps_per_metre, sigma_of_sky, first, last):
    for j in range(first, last):
        at = j * BYTES
        for channel in range(3):
            rgb[j, channel] = np.float32(packed[at + channel]) / WHITE
        far, vague = _word(packed, at + 3), _word(packed, at + 5)
        sky[j] = far == 0 and vague == sigma_of_sky
        distance[j] = np.float32(far) / steps_per_metre
        sigma[j] = np.float32(0 if sky[j] else vague) / steps_per_metre
        indices[j, 0] = _word(packed, at + 7) | _word(packed, at + 9) << 16
        indices[j, 1], indices[j, 2] = _word(packed, at + 11), _word(packed, at + 13)


def unpacked(
    packed: UInt8[np.ndarray, "bytes"], steps_per_metre: int, sigma_of_sky: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Unpack records of 15 bytes.

    Args:
        packed: the records, one after the other.
        steps_per_metre: of distances and sigmas.
        sigma_of_sky: the sigma, in steps, that says, without a distance, that a pixel shows the sky.

    Returns:
        Picture, row and column, int64 [n, 3]; colours in 0..1, [n, 3]; distances and sigmas in metres, and whether a
        pixel shows the sky, [n, 1] each.
    """
    count = len(packed) // BYTES
    indices, rgb = torch.empty(count, 3, dtype=torch.int64), torch.empty(count, 3)
    distance, sigma, sky = torch.empty(count, 1), torch.empty(count, 1), torch.empty(count, 1, dtype=torch.bool)
    arrays = packed, indices.numpy(), rgb.numpy(), *(each.view(-1).numpy() for each in (distance, sigma, sky))
    numbers = np.float32(steps_per_metre), sigma_of_sky
    in_parts(lambda first, last: _unpack(*arrays, *numbers, first, last), count, LEAST_SHARE)
    return indices, rgb, distance, sigma, sky
