"""How much the lengths of a scan's neighbouring rays scatter: leaves, fences and outlines, or something solid. Pure."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Int

NEIGHBOURS = 5
"""On each side of a ray, on its ring."""


def roughness(
    distance_m: Float[np.ndarray, "rays"], ring: Int[np.ndarray, "rays"], offset_s: Float[np.ndarray, "rays"]
) -> Float64[np.ndarray, "rays"]:
    """Give the median second difference of the logarithms of lengths around each ray, on its ring, in order of time.

    It is 0 on planes that rays meet steeply or flatly alike, and does not depend on the distance. Where rings cannot be
    told apart (-1) it is NaN.
    """
    order = np.lexsort((offset_s, ring))
    lengths, rings = np.log(distance_m[order].astype(np.float64)), ring[order]
    bend = np.zeros(len(lengths))
    if len(lengths) > 2:
        inside = (rings[2:] == rings[1:-1]) & (rings[:-2] == rings[1:-1])
        bend[1:-1] = np.where(inside, np.abs(np.diff(lengths, 2)), 0.0)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(bend, NEIGHBOURS), 2 * NEIGHBOURS + 1)
    found = np.empty(len(lengths))
    found[order] = np.median(windows, axis=1)
    return np.where(ring < 0, np.nan, found)
