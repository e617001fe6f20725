"""Pictures as other lenses at the same place see them: pinhole views of a fisheye, lenses that COLMAP knows.

Pixel centres are at +0.5. A view's frame is the camera's, turned (x right, y down, z forward).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Shaped
from numpy.typing import NDArray

from edge_depth_nerf.cameras import KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.rays import Rays, rays
from edge_depth_nerf.export.options import Form, Views
from edge_depth_nerf.mono.pinhole_views import upright_axes

NOWHERE = -1e4
"""Coordinate of what the picture does not show."""
LEAST_TILT_DEG = 10.0
"""A view that is turned by less shows nothing new."""
COLMAP_LIMIT_RAD = math.radians(89)
"""COLMAP's cameras end at 90°."""

SAME_SHARE = 0.1
"""Neighbouring distances that differ by more belong to two surfaces."""
ALL_KNOWN = 0.999

Lens = KannalaBrandt | Pinhole


@dataclass(frozen=True, eq=False)
class Cut:
    """A view: the picture itself, or what another lens at its place sees."""

    name: str
    """Added to the picture's name; empty if there is one view."""
    lens: Lens
    source: Lens
    """The picture's lens."""
    theta_max_rad: float
    """Rays further from the view's axis are not used."""
    view_to_camera: Float64[np.ndarray, "3 3"] = dataclasses.field(default_factory=lambda: np.eye(3))

    @property
    def is_whole(self) -> bool:
        """Whether this is the picture itself."""
        return self.lens == self.source

    @property
    def rays(self) -> Rays:
        """The rays of the view's pixels, in its own frame."""
        return rays(self.lens, self.theta_max_rad)

    @cached_property
    def _source_xy(self) -> Float32[np.ndarray, "height width 2"]:
        """Where each pixel lies in the picture, as cv2.remap counts (centres at whole numbers)."""
        directions, valid = self.lens.unproject(self.lens.pixel_centres())
        turned = torch.nan_to_num(directions) @ torch.from_numpy(self.view_to_camera.T.copy())
        pixels, seen = self.source.project(turned)
        return torch.where((valid & seen)[..., None], pixels - 0.5, NOWHERE).numpy().astype(np.float32)

    def _read(self, pixels: NDArray, how: int) -> NDArray:
        x, y = self._source_xy[..., 0], self._source_xy[..., 1]
        return cv2.remap(pixels, x, y, how, borderMode=cv2.BORDER_CONSTANT)

    def colours(self, picture: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "height width 3"]:
        """Draw a picture as the view sees it; black where it sees nothing."""
        return picture if self.is_whole else self._read(picture, cv2.INTER_LINEAR)

    def values(self, pixels: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "height width"]:
        """Read a map at the pixel nearest to each of the view's; 0 where it sees nothing."""
        return pixels if self.is_whole else self._read(pixels, cv2.INTER_NEAREST)

    def distances(self, distance_m: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "height width"]:
        """Read a map of distances, 0 = none: between the pixels of one surface, elsewhere at the nearest pixel.

        On a plane 1 / distance changes evenly between pixels. The nearest pixel of a road 20 m ahead is up to 1.5 %
        off.
        """
        nearest_m = self.values(distance_m)
        if self.is_whole:
            return nearest_m
        known = distance_m > 0
        inverse_per_m = np.where(known, 1 / np.where(known, distance_m, 1), 0).astype(np.float32)
        inverse = self._read(inverse_per_m, cv2.INTER_LINEAR)
        between_m = 1 / np.maximum(inverse, np.float32(1e-6))
        same = self._read(known.astype(np.float32), cv2.INTER_LINEAR) > ALL_KNOWN
        return np.where(same & (np.abs(between_m - nearest_m) <= SAME_SHARE * nearest_m), between_m, nearest_m)

    def mask(self, usable: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "height width"]:
        """Give the pixels that may be used."""
        return (self.values(usable.astype(np.uint8)) > 0) & self.rays.within


@lru_cache(maxsize=16)
def cuts_of(lens: Lens, theta_max_rad: float, form: Form, views: Views, count: int, fov_deg: float) -> tuple[Cut, ...]:
    """Give the views that a picture of a lens is written as."""
    limit = min(theta_max_rad, COLMAP_LIMIT_RAD) if form == "colmap" else theta_max_rad
    if isinstance(lens, Pinhole):
        straight = Pinhole(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
        # COLMAP has no term of the eighth power, and other programs none of the sixth
        keeps = views == "fisheye" and (form != "colmap" or not (lens.k3 or lens.k4))
        return (Cut("", lens if keeps else straight, lens, limit),)
    if views == "fisheye":
        # COLMAP's OPENCV_FISHEYE has no tangential terms
        shown = dataclasses.replace(lens, p1=0.0, p2=0.0) if form == "colmap" else lens
        return (Cut("", shown, lens, limit),)
    return _pinhole_cuts(lens, theta_max_rad, count, math.radians(fov_deg))


def _pinhole_cuts(lens: KannalaBrandt, theta_max_rad: float, count: int, fov_rad: float) -> tuple[Cut, ...]:
    """Lay out views along the axis, to both sides, up and down, as far out as the lens sees."""
    across_rad, along_rad = _reach(lens, theta_max_rad)
    half_x, half_y = min(fov_rad / 2, across_rad), min(fov_rad / 2, along_rad)
    focal_px = (lens.fx + lens.fy) / 2  # as fine as the picture's middle
    width, height = (2 * max(1, round(focal_px * math.tan(half))) for half in (half_x, half_y))
    shown = Pinhole(width, height, focal_px, focal_px, width / 2, height / 2)
    # as far out as the lens sees, but without a gap between two views
    turn = math.degrees(min(across_rad - half_x, 1.8 * half_x))
    rise = math.degrees(min(along_rad - half_y, 1.8 * half_y))
    layout = [("front", 0.0, 0.0), ("left", -turn, 0.0), ("right", turn, 0.0), ("up", 0.0, rise), ("down", 0.0, -rise)]
    chosen = [each for each in layout[:count] if each[0] == "front" or abs(each[1] + each[2]) >= LEAST_TILT_DEG]
    return tuple(
        Cut(f"_{name}", shown, lens, math.pi, upright_axes(azimuth, elevation)) for name, azimuth, elevation in chosen
    )


def _reach(lens: KannalaBrandt, theta_max_rad: float) -> tuple[float, float]:
    """How far from the axis a picture sees to both sides, and both up and down; radians."""
    found = rays(lens, theta_max_rad)
    theta = np.where(found.within, np.arccos(np.clip(found.cos_theta, -1, 1)), 0)
    row, column = (int(np.clip(at, 0, most - 1)) for at, most in ((lens.cy, lens.height), (lens.cx, lens.width)))
    sides = (theta[row, :column], theta[row, column:], theta[:row, column], theta[row:, column])
    left, right, up, down = (float(each.max(initial=0.0)) for each in sides)
    return min(left, right), min(up, down)
