"""The lens circle: what of a fisheye picture is a picture, from its calibration or from its dark rim."""

from __future__ import annotations

import math
from collections.abc import Iterable

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.masks.regions import block_mean, working_factor

_ANGLES = 720
"""Number of directions from the picture's middle in which the rim is searched for."""
_DARK_LEVELS = 40.0
"""What is not lit by the lens is darker than this in every picture, glare included."""
_LIT_LEVELS = 80.0
"""Inside the rim some picture is brighter than this somewhere near: by night no rim can be told from the scene."""
_STEP_LEVELS = 12.0
"""Where, from outside, brightness first rises this much above the dark, the rim is near."""
_RIM_WIDTH = 0.06
"""The rim is no wider than this share of the picture's longer side: so far in, the picture has its full light."""
_TOLERANCE = 0.012
"""How far the rim may lie from the fitted ellipse, as a share of the longer side."""
_MIN_VISIBLE = 0.25
"""Share of the directions in which the rim must be seen; the others end at the picture's border before."""
_MIN_FITTING = 0.7
"""Share of those that must lie on the ellipse: the edge of a tunnel's mouth or of a dark wall is no ellipse."""
_MIN_DIAMETER = 0.6
"""Smallest diameter, as a share of the picture's shorter side."""
_MAX_AXIS_RATIO = 1.25
_MIN_DARK_SHARE = 0.95
"""Share of the pixels outside that must be dark; a smear or a reflection may cross them."""


def lens_circle(camera: Camera, theta_max_deg: float) -> Bool[np.ndarray, "h w"]:
    """Pixels whose ray is at most so far from the axis, and within the camera's own range.

    Up to there a camera is one-to-one: they are the pixels inside the curve that the rays at the limit draw around
    the principal point. Unprojecting every pixel gives the same and takes a hundred times as long.
    """
    limit_rad = min(math.radians(theta_max_deg), camera.theta_max_rad) * (1 - 1e-9)
    azimuth_rad = torch.linspace(0, 2 * math.pi, 8192, dtype=torch.float64)
    across, along = math.sin(limit_rad), torch.full_like(azimuth_rad, math.cos(limit_rad))
    rim = torch.stack((across * azimuth_rad.cos(), across * azimuth_rad.sin(), along), -1)
    x, y = (camera.project(rim)[0].numpy() - (camera.cx, camera.cy)).T
    column, row = np.arange(camera.width) + 0.5 - camera.cx, np.arange(camera.height)[:, None] + 0.5 - camera.cy
    rim_radius_px = np.interp(np.arctan2(row, column), np.arctan2(y, x), np.hypot(x, y), period=2 * math.pi)
    return np.hypot(row, column) <= rim_radius_px


def dark_rim(pictures: Iterable[UInt8[np.ndarray, "h w 3"]]) -> Bool[np.ndarray, "h w"] | None:
    """Find the bright lens image inside a rim that stays dark in all pictures.

    The rim is where brightness falls to half between the lens image and the dark outside, which is an ellipse; smears,
    glare and what is dark at the edge of the scene are outliers of its fit. Pictures of one camera are taken one by
    one; a few from different places are better than one.

    Returns:
        True inside; None where no such rim is seen: the pictures fill their frame, the circle is cropped to less than
        a quarter of its outline, or they are too dark to tell.

    Raises:
        ValueError: the pictures differ in size.
    """
    brightest: Float[np.ndarray, "h w"] | None = None
    shape, factor = (0, 0), 1
    for picture in pictures:
        if brightest is None:
            shape = picture.shape[:2]
            factor = working_factor(shape)
        elif picture.shape[:2] != shape:
            raise ValueError(f"pictures of different sizes: {shape} and {picture.shape[:2]}")
        small = block_mean(np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.float32), factor)
        small = cv2.GaussianBlur(small, (0, 0), 1.0)
        brightest = small if brightest is None else np.maximum(brightest, small)
    if brightest is None:
        return None
    ellipse = _fit_ellipse(_rim_points(brightest), max(brightest.shape))
    if ellipse is None or not _is_lens(ellipse, brightest):
        return None
    return _elliptic_radius(ellipse, shape, factor) <= 1


Ellipse = tuple[float, float, float, float, float]
"""Centre x and y, half axes a and b, all in pixels with centres at +0.5; angle of a against x, radians."""


def _rim_points(brightest: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """Where, from the picture's border inwards, it turns bright: x, y at most one in each direction."""
    height, width = brightest.shape
    side = max(height, width)
    points = []
    for azimuth in np.arange(_ANGLES) * (2 * math.pi / _ANGLES):
        step = np.array([math.cos(azimuth), math.sin(azimuth)])
        reach = min(np.array([width, height]) / 2 / np.maximum(np.abs(step), 1e-9)) - 1
        # from the border inwards, half a pixel at a time
        radius = np.arange(reach, 0.2 * side, -0.5, dtype=np.float32)
        if radius.size < 2 * _RIM_WIDTH * side:
            continue
        across = (width / 2 + radius * step[0] - 0.5).astype(np.float32)
        down = (height / 2 + radius * step[1] - 0.5).astype(np.float32)
        # a column: OpenCV 4 and 5 take arrays of one dimension for different shapes
        profile = cv2.remap(brightest, across[:, None], down[:, None], cv2.INTER_LINEAR)[:, 0]
        dark = float(np.median(profile[: max(3, round(0.02 * side))]))
        rise = np.flatnonzero(profile > dark + _STEP_LEVELS)
        if dark > _DARK_LEVELS or not rise.size or not rise[0]:
            continue
        bright = float(profile[rise[0] : rise[0] + round(2 * _RIM_WIDTH * side)].max())
        half = rise[0] + np.flatnonzero(profile[rise[0] :] > (dark + bright) / 2)
        if bright >= _LIT_LEVELS and half.size:
            points.append((width / 2 + radius[half[0]] * step[0], height / 2 + radius[half[0]] * step[1]))
    return np.array(points, np.float32).reshape(-1, 2)


def _fit_ellipse(points: Float[np.ndarray, "n 2"], side: int) -> Ellipse | None:
    """Fit an ellipse to most of the points: the circle through three that fits the most, then that refined."""
    if len(points) < _MIN_VISIBLE * _ANGLES:
        return None
    rng = np.random.default_rng(0)
    near = np.zeros(len(points), bool)
    for _ in range(200):
        three = points[rng.choice(len(points), 3, replace=False)].astype(np.float64)
        system = np.column_stack((2 * three, np.ones(3)))
        if abs(np.linalg.det(system)) < 1e-6 * side**2:
            continue
        x, y, rest = np.linalg.solve(system, (three**2).sum(1))
        # twice as far: the ellipse is not yet known
        off = np.abs(np.hypot(*(points - (x, y)).T) - math.sqrt(max(rest + x * x + y * y, 0)))
        candidate = off < 2 * _TOLERANCE * side
        if candidate.sum() > near.sum():
            near = candidate
    ellipse = None
    for _ in range(5):
        if near.sum() < _MIN_FITTING * len(points):
            return None
        (x, y), (width, height), degrees = cv2.fitEllipse(points[near])
        ellipse = (x, y, width / 2, height / 2, math.radians(degrees))
        if min(ellipse[2:4]) <= 0:
            return None
        off = np.abs(_elliptic_radius_of(points, ellipse) - 1) * math.sqrt(ellipse[2] * ellipse[3])
        near = off < _TOLERANCE * side
    return ellipse if near.sum() >= _MIN_FITTING * len(points) else None


def _is_lens(ellipse: Ellipse, brightest: Float[np.ndarray, "h w"]) -> bool:
    """Whether size and shape are those of a lens image, and what is outside is dark."""
    half_axes = sorted(ellipse[2:4])
    if half_axes[1] > _MAX_AXIS_RATIO * half_axes[0] or 2 * half_axes[0] < _MIN_DIAMETER * min(brightest.shape):
        return False
    radius = _elliptic_radius(ellipse, brightest.shape, 1)
    outside = radius > 1 + _RIM_WIDTH
    return bool(outside.any()) and float((brightest[outside] < _DARK_LEVELS).mean()) >= _MIN_DARK_SHARE


def _elliptic_radius(ellipse: Ellipse, shape: tuple[int, ...], factor: int) -> Float[np.ndarray, "h w"]:
    """Distance of pixels from the centre, 1 on the ellipse, for pictures `factor` times as large."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return _elliptic_radius_of((np.stack((x, y), -1) + 0.5) / factor, ellipse)


def _elliptic_radius_of(points: Float[np.ndarray, "*n 2"], ellipse: Ellipse) -> Float[np.ndarray, "*n"]:
    x, y, a, b, angle = ellipse
    across, down = points[..., 0] - x, points[..., 1] - y
    along = across * math.cos(angle) + down * math.sin(angle)
    aside = down * math.cos(angle) - across * math.sin(angle)
    return np.hypot(along / a, aside / b)
