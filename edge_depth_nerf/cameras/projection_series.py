"""A lens as two polynomials, for compiled loops that project many points.

In all camera models a ray goes to a plane by a factor of its angle from the axis alone, and the plane is bent by
`Distortion`. Both factors are smooth functions of the cosine of that angle, also on the axis, so that low polynomials
give them as far as the picture reaches, and a projection is a root, a division and some products: what a compiler turns
into vector instructions. `stereo.sphere_sweep` evaluates them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32
from numpy.polynomial import Chebyshev, Polynomial

from edge_depth_nerf.cameras.models import Camera
from edge_depth_nerf.cameras.rays import rays

WRONG_PX = 0.01
"""The polynomials are as long as it takes to be right to this; the longest are right to 0.02 px."""
_FURTHEST_RAD = math.radians(150.0)
"""Beyond, sine over sine grows too steep for them; nothing is projected there."""
_LONGEST = 24
_COSINES = 2048
_NEAR_AXIS_RAD = 1e-4
"""Used instead of the axis itself, where sine over sine has no value."""


@dataclass(frozen=True, eq=False)
class ProjectionSeries:
    """What a compiled loop needs to project into a picture.

    Let c be the cosine of a unit ray's angle from the axis, and t = (c - `numbers[6]`) · `numbers[7]` - 1, which is -1
    where the picture ends and 1 on the axis. Row 0 of `factors` gives the factor that takes x and y of the ray to the
    distorted plane without its tangential terms. Row 1 gives the factor that takes them to the undistorted plane.
    """

    factors: Float32[np.ndarray, "2 length"]
    """Coefficients in t, the highest power first."""
    numbers: Float32[np.ndarray, "8"]
    """fx, fy, cx, cy, p1, p2, the least cosine, and 2 / (1 - that)."""


@lru_cache(maxsize=16)
def projection_series(camera: Camera, theta_max_rad: float = math.pi) -> ProjectionSeries:
    """Fit the polynomials of a lens as far as its picture's pixels have rays.

    Nothing is projected beyond `theta_max_rad` from the axis; π leaves the lens model's own limit, and 150° at most.
    """
    seen = rays(camera, theta_max_rad)
    furthest = math.acos(max(-1.0, min(1.0, float(seen.cos_theta[seen.within].min())))) if seen.within.any() else 0.0
    # a pixel beyond the outermost centres
    limit = min(camera.theta_max_rad, theta_max_rad, _FURTHEST_RAD)
    least = math.cos(min(max(furthest, _NEAR_AXIS_RAD) + 1.0 / min(camera.fx, camera.fy), limit))
    t = torch.cos(torch.linspace(math.pi, 0.0, _COSINES, dtype=torch.float64))
    theta = torch.acos((least + (t + 1.0) / 2.0 * (1.0 - least)).clamp(-1.0, 1.0)).clamp(min=_NEAR_AXIS_RAD)
    sine = theta.sin()
    plain = camera._to_plane(torch.stack((sine, torch.zeros_like(sine), theta.cos()), -1))[0][:, 0]
    distortion = camera._distortion
    square = (plain * plain)[:, None]
    factors = torch.stack((distortion._scale(square)[:, 0] * plain, plain), -1) / sine[:, None]
    wrong = WRONG_PX / max(camera.fx, camera.fy)
    places, values, reach = t.numpy(), factors.numpy(), sine.numpy()
    for degree in range(4, _LONGEST):
        fits = [Chebyshev.fit(places, values[:, row], degree, domain=(-1.0, 1.0)) for row in range(2)]
        off = max(float(np.abs((fit(places) - values[:, row]) * reach).max()) for row, fit in enumerate(fits))
        if off <= wrong:
            break
    coefficients = [fit.convert(kind=Polynomial).coef for fit in fits]
    rows = [np.pad(row, (0, degree + 1 - len(row)))[::-1] for row in coefficients]
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, distortion.p1, distortion.p2, least, 2.0 / (1.0 - least))
    return ProjectionSeries(np.stack(rows).astype(np.float32), np.array(numbers, np.float32))
