"""Projecting points into a camera: a sparse map of distances along the ray.

Points are metres in the camera's frame (x right, y down, z forward). A camera decides itself which rays it can see, so
points beside and behind it count as far as its model reaches; there is no test of z. A map has the picture's size;
distance is Euclidean metres from the camera's centre, 0 = no LiDAR point.

Hidden points. The scanner sits elsewhere than the camera and sees what the camera cannot. Each LiDAR point stands for a
patch of surface as wide as the distance to its neighbours. So it hides what lies behind it within as many pixels of its
own: the nearer the surface is to the camera, the more. A road seen at a flat angle also has nearer points beside each
point. So a hidden point must lie steeply behind: further behind than `_FLATTEST` allows for the distance in the
picture. All of it is done in the picture's own pixels, with the lens's own scale at each angle.

Where several points fall into one pixel, the nearest surface wins. Of its points, the one measured nearest in time
wins, and then the one nearest to the pixel's centre. The nearest point itself would lie at the near edge of the pixel's
patch of road: on a synthesised street at 256×256 px it is 0.8 % too near in the median, the chosen one 0.1 %.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from edge_depth_nerf.cameras import Camera

_SAME_SURFACE = 1.1
"""Points of one pixel whose distances differ by less than this ratio are taken to lie on one surface."""
_BEHIND = 0.04
"""A point is only called hidden if it is further away than what hides it by more than this part of its distance."""
_FLATTEST = 0.06
"""Slope, as sideways over along the ray, of the flattest surface whose own points must not hide each other: a road from
2 m above it, 33 m away."""
_REACHES_PX = (1, 2, 3, 5, 8, 12, 18)
"""How far around itself a LiDAR point may hide what is behind."""


@dataclass(frozen=True)
class Projection:
    """What a camera sees of a set of points."""

    distance_m: Float[Tensor, "height width"]
    """Distance of the point chosen in each pixel, 0 = none."""
    point_index: Int[Tensor, "height width"]
    """Which point that is, -1 = none."""


def transform_points(a_to_b: Float[Tensor, "4 4"], points_in_a: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Express points, given in frame a, in frame b; metres."""
    return points_in_a @ a_to_b[:3, :3].T + a_to_b[:3, 3]


def project_points(
    points_in_camera: Float[Tensor, "points 3"],
    camera: Camera,
    *,
    spacing_m: Float[Tensor, "points"] | None = None,
    age_s: Float[Tensor, "points"] | None = None,
    only_hides: Bool[Tensor, "points"] | None = None,
) -> Projection:
    """Project points and choose one for each pixel that any fall into.

    Args:
        points_in_camera: metres.
        camera: its pixels are the map's.
        spacing_m: how wide a patch of surface each point stands for; points that others hide are then left out.
            None keeps them.
        age_s: how far in time from the picture each point was measured; None = all at once.
        only_hides: points that hide others and are never chosen; None = all may be chosen.
    """
    pixels, valid = camera.project(points_in_camera)
    seen = torch.nonzero(valid & camera.inside(pixels)).squeeze(-1)
    corners = pixels[seen].floor()
    column, row = corners.long().unbind(-1)
    flat = row * camera.width + column
    size = camera.height * camera.width

    def least(values: Tensor, index: Tensor, none: int | float) -> Tensor:
        """Find the smallest value in each pixel."""
        return values.new_full((size,), none).scatter_reduce(0, index, values, "amin")

    distance_m = points_in_camera[seen].norm(dim=-1)
    keep = distance_m <= _SAME_SURFACE * least(distance_m, flat, math.inf)[flat]
    if spacing_m is not None:
        cosine = points_in_camera[seen, 2] / distance_m
        keep &= ~_hidden(flat, distance_m.float(), cosine.float(), spacing_m[seen].float(), camera)
    if only_hides is not None:
        keep &= ~only_hides[seen]
    if age_s is not None:
        newest = least(torch.where(keep, age_s[seen], math.inf), flat, math.inf)
        keep &= age_s[seen] <= newest[flat]
    off_centre_px = (pixels[seen] - corners - 0.5).norm(dim=-1)
    seen, flat, off_centre_px = seen[keep], flat[keep], off_centre_px[keep]
    best = off_centre_px == least(off_centre_px, flat, math.inf)[flat]
    # of two points at the very same place the first one counts, so that the result has no chance in it
    none = len(points_in_camera)
    index = least(seen[best], flat[best], none)
    has_point = index < none
    distances = distance_m.new_zeros(size)
    distances[has_point] = points_in_camera[index[has_point]].norm(dim=-1)
    shape = (camera.height, camera.width)
    return Projection(distances.reshape(shape), torch.where(has_point, index, -1).reshape(shape))


def _hidden(
    flat: Int[Tensor, "seen"],
    distance_m: Float[Tensor, "seen"],
    cosine: Float[Tensor, "seen"],
    spacing_m: Float[Tensor, "seen"],
    camera: Camera,
) -> Bool[Tensor, "seen"]:
    """Find the points that others hide; `flat` is each one's pixel, `cosine` of its angle from the axis."""
    size = camera.height * camera.width
    scale = torch.from_numpy(_pixels_per_radian(camera))
    pixels_per_rad = scale[((1 - cosine) / 2 * (len(scale) - 1)).round().long()]
    reach_px = spacing_m / distance_m * pixels_per_rad
    hidden = torch.zeros(len(flat), dtype=torch.bool)
    for radius_px in _REACHES_PX:
        # what falls into neighbouring pixels touches whatever its size
        wide = reach_px >= radius_px if radius_px > 1 else torch.ones_like(hidden)
        if not wide.any():
            break
        nearest = torch.full((size,), math.inf).scatter_reduce(0, flat[wide], distance_m[wide], "amin")
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius_px + 1, 2 * radius_px + 1))
        image = nearest.numpy().reshape(camera.height, camera.width)
        around = cv2.erode(image, disc, borderType=cv2.BORDER_CONSTANT, borderValue=(math.inf,))
        in_front = torch.from_numpy(around.reshape(-1))[flat]
        steep = in_front * (radius_px / _FLATTEST) / pixels_per_rad
        hidden |= distance_m - in_front > torch.maximum(_BEHIND * distance_m, steep)
    return hidden


@functools.lru_cache(maxsize=64)
def _pixels_per_radian(camera: Camera) -> Float[np.ndarray, "steps"]:
    """The lens's scale, mean of along and across the radius, at steps of (1 - cos θ)/2 from 0 to 1."""
    steps = np.linspace(0, 1, 1025)
    limit = camera.theta_max_rad * (1 - 1e-6)
    theta = torch.from_numpy(np.clip(np.arccos(1 - 2 * steps), 1e-3, limit))
    angles = torch.stack((theta, theta - 1e-4), -1)

    def radius_px(azimuth_rad: float) -> Tensor:
        rays = torch.stack(
            (angles.sin() * math.cos(azimuth_rad), angles.sin() * math.sin(azimuth_rad), angles.cos()), -1
        )
        pixels = camera.project(rays)[0] - torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
        return pixels.norm(dim=-1)

    radii = (radius_px(0.0) + radius_px(math.pi / 2)) / 2
    along = (radii[:, 0] - radii[:, 1]) / 1e-4
    across = radii[:, 0] / theta.sin()
    return (along * across).clamp(min=0).sqrt().float().numpy()
