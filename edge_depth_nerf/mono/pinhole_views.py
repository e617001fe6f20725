"""Virtual pinhole views of a fisheye picture, for networks that know pinholes only; and the way back.

The views stand upright in the camera, overlap, and together see every pixel of the lens. A view's frame is the
camera's, turned (x right, y down, z forward); its pixel centres are at +0.5, its principal point is its middle. In the
picture a view is known by the box of pixels it sees: for each of them where it lies in the view, the cosine of its ray
to the view's axis (z = distance · cosine), and a weight that falls smoothly to 0 at the view's border.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, UInt8
from numpy.typing import NDArray

from edge_depth_nerf.cameras import KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.mono.relative import Layer

HALF_ANGLE_DEG = 50.0
"""Of a view, from its axis to the middle of a border: wider, perspective stretches what networks know."""
FRONT_DEG = ((0.0, 0.0), (-65.0, 0.0), (65.0, 0.0), (-48.0, 50.0), (48.0, 50.0), (-48.0, -50.0), (48.0, -50.0))
"""Azimuth (to the right) and elevation (upward) of the views' axes in the camera. They see up to 100° from the optical
axis, with some pixels in three or four of them."""
FRONT_REACH_DEG = 100.0
BACK_DEG = ((180.0, 0.0), (-130.0, 0.0), (130.0, 0.0), (-132.0, 50.0), (132.0, 50.0), (-132.0, -50.0), (132.0, -50.0))
"""Those that a lens beyond needs as well."""
SINGLE_HALF_ANGLE_DEG = 48.0
"""A fisheye that sees no farther than this needs one view, as a pinhole does."""
_SINGLE_MARGIN = 1.1
"""The one view is so much wider than the lens, so that its weight is above 0 everywhere."""


@dataclass(frozen=True)
class PinholeView:
    """One view, and where it lies in the picture."""

    view_to_camera: Float64[np.ndarray, "3 3"]
    """Its axes as columns."""
    width: int
    height: int
    focal_px: float
    picture_xy: Float32[np.ndarray, "height width 2"]
    """Where each of its pixels lies in the picture, as cv2.remap counts (centres at whole numbers); far outside where
    the lens does not see."""
    box: tuple[slice, slice]
    """Rows and columns of the picture that hold all that it sees."""
    view_xy: Float32[np.ndarray, "rows columns 2"]
    """Where each pixel of the box lies in the view, as cv2.remap counts."""
    cosine: Float32[np.ndarray, "rows columns"]
    """Of each pixel's ray to the view's axis."""
    weight: Float32[np.ndarray, "rows columns"]
    """1 in the view's middle, 0 at its border and where it sees nothing."""

    def cut(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """The view's picture; black outside the lens."""
        return np.asarray(_read(picture, self.picture_xy), np.uint8)

    def layer(self, values: Float[np.ndarray, "height width"]) -> Layer:
        """What a map of the view, of any scale of its own, says of the picture.

        NaN where the view sees nothing, and beside a value that is not finite.
        """
        found = _read(values.astype(np.float32), self.view_xy)
        found = np.where((self.weight > 0) & np.isfinite(found), found, np.float32(np.nan))
        return Layer(self.box, found, self.cosine, self.weight)


def _read(pixels: NDArray, at_xy: NDArray[np.float32]) -> NDArray:
    return cv2.remap(pixels, at_xy[..., 0], at_xy[..., 1], cv2.INTER_LINEAR)


@lru_cache(maxsize=4)
def pinhole_views(lens: KannalaBrandt | Pinhole, theta_max_rad: float) -> tuple[PinholeView, ...]:
    """Views, at least one, that together see every pixel of a lens within an angle of its axis.

    Views that are nowhere the best are left out.
    """
    found = rays(lens, theta_max_rad)
    directions, within = found.directions, found.within
    farthest_deg = math.degrees(math.acos(np.clip(found.cos_theta[within].min(initial=1.0), -1, 1)))
    focal_px = (lens.fx + lens.fy) / 2
    if isinstance(lens, Pinhole) or farthest_deg <= SINGLE_HALF_ANGLE_DEG:
        tangent = np.abs(directions[within][:, :2] / directions[within][:, 2:]).max(0, initial=0.1) * _SINGLE_MARGIN
        return (_view(lens, directions, np.eye(3), focal_px, float(tangent[0]), float(tangent[1])),)
    axes = FRONT_DEG if farthest_deg <= FRONT_REACH_DEG else FRONT_DEG + BACK_DEG
    tangent = math.tan(math.radians(HALF_ANGLE_DEG))
    views = [_view(lens, directions, upright_axes(*axis), focal_px, tangent, tangent) for axis in axes]
    best = np.full(within.shape, -1)
    most = np.zeros(within.shape, np.float32)
    for number, view in enumerate(views):
        better = view.weight > most[view.box]
        best[view.box][better] = number
        most[view.box][better] = view.weight[better]
    return tuple(view for number, view in enumerate(views) if (best == number).any())


def upright_axes(azimuth_deg: float, elevation_deg: float) -> NDArray[np.float64]:
    """Axes, as columns, of a view whose x stays level."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    forward = np.array(
        [math.sin(azimuth) * math.cos(elevation), -math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
    )
    return np.stack([right, np.cross(forward, right), forward], 1)


def _view(
    lens: KannalaBrandt | Pinhole,
    directions: Float32[np.ndarray, "h w 3"],
    view_to_camera: NDArray[np.float64],
    focal_px: float,
    tangent_x: float,
    tangent_y: float,
) -> PinholeView:
    """Lay out one view; the picture's directions are unit vectors, zeros where the lens sees nothing."""
    # as fine as the picture's middle; a view never needs to be larger than the picture
    focal_px = min(focal_px, lens.width / (2 * tangent_x), lens.height / (2 * tangent_y))
    width, height = max(round(2 * focal_px * tangent_x), 1), max(round(2 * focal_px * tangent_y), 1)
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    outward = np.stack([x, y, np.full_like(x, focal_px)], -1) @ view_to_camera.T
    pixels, valid = lens.project(torch.from_numpy(outward))
    picture_xy = torch.where(valid[..., None], pixels - 0.5, -1e4).numpy().astype(np.float32)
    seen = directions @ view_to_camera.astype(np.float32)
    ahead = seen[..., 2] > 1e-3
    plane = np.where(ahead[..., None], seen[..., :2] / np.where(ahead, seen[..., 2], 1)[..., None], np.inf)
    # the middle of the outermost pixels is the border: beyond, the view has no value to interpolate
    inner = np.array([(width - 1) / (2 * focal_px), (height - 1) / (2 * focal_px)], np.float32)
    within = np.minimum(np.abs(plane) / np.maximum(inner, 1e-6), 1)
    weight = np.prod(np.cos(np.pi / 2 * within) ** 2, -1) * (within < 1).all(-1)
    rows, columns = (np.flatnonzero(weight.any(axis)) for axis in (1, 0))
    box = tuple(slice(found[0], found[-1] + 1) if len(found) else slice(0, 0) for found in (rows, columns))
    middle = np.array([width / 2 - 0.5, height / 2 - 0.5])
    plane = np.where(weight[box][..., None] > 0, plane[box], 0)
    return PinholeView(
        view_to_camera=view_to_camera,
        width=width,
        height=height,
        focal_px=focal_px,
        picture_xy=picture_xy,
        box=(box[0], box[1]),
        view_xy=(plane * focal_px + middle).astype(np.float32),
        cosine=seen[..., 2][box],
        weight=weight[box].astype(np.float32),
    )
