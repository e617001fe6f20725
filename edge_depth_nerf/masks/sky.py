"""The sky in a picture: where a depth prior has nothing to say.

A monocular network gives the sky some distance, and LiDAR gives none: a prior there is wrong. Sky is what lies above
the horizon, is far by all that is known, is brighter than the ground, never reddish, and hangs together with a
smooth bright part high up. In doubt a pixel is not sky: a prior that is kept can be weighed down later, one that was
removed is lost.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.masks.regions import (
    block_mean,
    components,
    dilated,
    enlarge,
    from_nearest,
    larger,
    means_within,
    opened,
    touching,
    whole_blocks,
)

WORKING_PX = 500
"""Pictures are averaged down until the longer side is no longer than this."""
NEAR_M = 20.0
"""A monocular distance below this is trusted to be no sky: networks put the sky at tens of metres, rarely nearer,
and ceilings, tree crowns and house fronts beside the road lie below."""

_HORIZON_DEG = 1.0
"""Below this elevation nothing is sky: hills and houses hide it, and poses are not exact."""
_HIGH_DEG = 25.0
"""Where sky begins to be looked for: above most houses across the street."""
_BRIGHTER_THAN_GROUND = 1.4
"""How much brighter the high part must be than the ground: below a ceiling it hardly is."""
_ROAD_QUANTILE = 0.25
"""Of the brightness below the horizon: a white van close by is no measure."""
_BRIGHT_LEVEL = 220.0
"""Sky may always be this bright: near white nothing can be much brighter than bright ground."""
_DARKEST_LEVEL = 150.0
"""By day the sky is brighter than the middle of a picture's range; by night, and under a lit ceiling, nothing is."""
_SMOOTH_LEVELS = 8.0
"""Steepest change from one pixel to the next, in grey levels, of what sky is first looked for in."""
_REDDEST = 0.95
"""Least ratio of blue to red."""
_BRIGHTNESS_CHANGE = 0.25
_COLOUR_CHANGE = 0.20
"""Shares by which brightness may differ from the sky around, and blue over red fall below it: clouds differ so
much, house fronts mostly more."""
_AROUND = 1 / 16
"""Scale of the sky around, as a share of the picture's longer side."""
_MIN_SHARE_AROUND = 1e-3
"""Share of a Gaussian that must lie in the sky for its mean to say anything."""
_SMALLEST_SHARE = 0.005
"""A smaller patch, as a share of the mask, is a lamp or a window."""
_LARGEST_HOLE_PX = 10.0
"""Larger holes in the sky are lamps, wires, birds."""
_ROUNDS = 3
"""How often what was found is grown, a distance of some `_AROUND` each time."""


def find_sky(
    picture: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    up_in_camera: Float[np.ndarray, "3"],
    camera: Camera,
    lidar_m: Float[np.ndarray, "h w"],
    mono_m: Float[np.ndarray, "h w"] | None = None,
) -> Bool[np.ndarray, "h w"]:
    """Find the sky, rather too little than too much.

    Args:
        picture: RGB.
        mask: True = use: inside the lens, not the vehicle.
        up_in_camera: unit vector away from the ground, in the camera's frame.
        camera: of the picture, at its size. Its rays are worked out once and remembered.
        lidar_m: distance of LiDAR's returns in metres, 0 = none. A return is no sky, however far.
        mono_m: monocular distance in metres, 0 = none; None without.

    Returns:
        True = sky.

    """
    factor = math.ceil(max(mask.shape) / WORKING_PX)
    usable = whole_blocks(mask, factor)
    blocks = rays(camera.downscaled(factor))
    height_sine = blocks.directions @ up_in_camera.astype(np.float32)
    possible = usable & blocks.within & (height_sine > math.sin(math.radians(_HORIZON_DEG)))
    far = lidar_m == 0
    possible &= ~dilated(~whole_blocks(far, factor), 1.0)
    if mono_m is not None:
        far &= (mono_m == 0) | (mono_m >= NEAR_M)
        possible &= block_mean(far.astype(np.float32), factor) > 0.5
    sky = _grow(block_mean(picture, factor).astype(np.float32), possible, usable, height_sine)
    if usable.any():
        # blocks that the mask cuts, along the lens's rim, are as those beside them
        sky = from_nearest(sky, usable)[0]
    return enlarge(sky, factor, (mask.shape[0], mask.shape[1])) & mask & far


def regions_like_sky(
    picture: UInt8[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"], ground: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Of regions without distance, those that may be sky: on average as bright as `find_sky` wants it.

    A stereo matcher or a depth camera has nothing to say of dark crowns and of what one eye alone sees, either.

    Args:
        picture: RGB.
        where: the regions.
        ground: where the ground is seen, whose brightness counts.

    """
    brightness = picture.max(-1)
    labels, sizes = components(where)
    sums = np.bincount(labels.ravel(), weights=brightness.ravel(), minlength=len(sizes))
    return (sums >= np.maximum(sizes, 1) * _darkest(brightness[ground]))[labels] & where


def _darkest(ground: Shaped[np.ndarray, "n"]) -> float:
    """The least brightness of the sky above ground of these."""
    if not ground.size:
        return _DARKEST_LEVEL
    road = float(np.quantile(ground, _ROAD_QUANTILE))
    return max(_DARKEST_LEVEL, min(_BRIGHTER_THAN_GROUND * road, _BRIGHT_LEVEL))


def _grow(
    colour: Float32[np.ndarray, "h w 3"],
    possible: Bool[np.ndarray, "h w"],
    usable: Bool[np.ndarray, "h w"],
    height_sine: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """From what is high, smooth and bright to all that hangs together with it and looks like it."""
    side = max(possible.shape)
    brightness = colour.max(-1)
    blue_to_red = np.log((colour[..., 2] + 8) / (colour[..., 0] + 8))
    ground = usable & (height_sine < 0)
    darkest = _darkest(brightness[ground])
    possible = possible & (brightness >= darkest) & (blue_to_red >= math.log(_REDDEST))
    grey = cv2.GaussianBlur(brightness, (0, 0), 0.8)
    slope = np.hypot(cv2.Sobel(grey, -1, 1, 0, scale=1 / 8), cv2.Sobel(grey, -1, 0, 1, scale=1 / 8))
    sky = possible & (slope <= _SMOOTH_LEVELS) & (height_sine > math.sin(math.radians(_HIGH_DEG)))
    sky = larger(sky, _SMALLEST_SHARE * usable.sum())
    for _ in range(_ROUNDS):
        (around, blue_around), share = means_within((brightness, blue_to_red), sky, _AROUND * side)
        alike = np.abs(brightness - around) <= _BRIGHTNESS_CHANGE * around
        alike &= blue_to_red >= blue_around - _COLOUR_CHANGE
        grown = possible & alike & (share > _MIN_SHARE_AROUND)
        # what only a bridge one pixel wide connects is another thing
        sky = touching(opened(grown, 1.0) | (grown & sky), sky)
    # noise in clouds and about the sun leaves holes of a few pixels
    return sky | (possible & ~larger(~sky, _LARGEST_HOLE_PX))
