"""The rays of a lens's pixels, worked out once, and the one rule for where they end.

Unprojecting a picture of 1400×1400 px takes seconds, so what comes out is kept of the lenses used last: 25 MB each.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32

from edge_depth_nerf.cameras.models import Camera

KEPT = 16
"""So many lenses, sizes and limits are kept: 400 MB of pictures of 1400×1400 px, which four cameras need."""


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of all pixels of a picture; shared by all who ask, so nobody can write into them."""

    directions: Float32[np.ndarray, "h w 3"]
    """Unit vectors in the camera's frame (x right, y down, z forward), rounded from float64; zeros outside."""
    within: Bool[np.ndarray, "h w"]
    """Whether the lens model gives the pixel a ray, and that ray lies within the limit."""

    @property
    def cos_theta(self) -> Float32[np.ndarray, "h w"]:
        """Cosine of the rays' angle from the optical axis: z-depth over distance; 0 outside."""
        return self.directions[..., 2]


@functools.lru_cache(maxsize=KEPT)
def rays(camera: Camera, theta_max_rad: float = math.pi) -> Rays:
    """The rays of a lens's pixel centres, up to an angle from the optical axis.

    Pixels are unprojected in float64, and the rim is decided before anything is rounded: a ray is within if
    cos θ >= cos `theta_max_rad` (π leaves the lens model's own limit). So all who ask about a lens and a limit agree
    about each pixel.
    """
    directions, within = camera.unproject(camera.pixel_centres())
    if theta_max_rad < math.pi:
        within = within & (directions[..., 2] >= math.cos(theta_max_rad))
    found = Rays(torch.where(within[..., None], directions, 0.0).float().numpy(), within.numpy())
    for array in (found.directions, found.within):
        array.setflags(write=False)
    return found


LEAST_COSINE = 0.02
"""Below (beyond 88.9°) z-depth says nothing of the distance: a count of 4 mm is 0.2 m."""


def distance_from_z_depth(z_depth_m: Float32[np.ndarray, "h w"], rays: Rays) -> Float32[np.ndarray, "h w"]:
    """Turn metres along the optical axis, 0 = none, into metres along the ray; 0 where there is no ray ahead."""
    ahead = rays.within & (rays.cos_theta >= LEAST_COSINE)
    return np.where(ahead, z_depth_m / np.where(ahead, rays.cos_theta, 1), 0).astype(np.float32)
