"""The sky in a picture: where a depth prior has nothing to say.

A monocular network gives the sky some distance, and LiDAR gives none: a prior there is wrong. Sky is what lies above
the horizon, is far by all that is known, is brighter than the ground, never reddish, and hangs together with a
smooth bright part that is high up or reaches the picture's upper rim. In doubt a pixel is not sky: a prior that is kept
can be weighed down later, one that was removed is lost.

The search has three steps. First, whole smooth regions are evaluated: those that continue below the horizon, contain
LiDAR points, or are whiter than a bluer sky beside them are house fronts and vans. Then the remaining regions grow to
all that is connected with them and alike. Last come the small holes close by, as between twigs.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt8

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import Rays, rays
from edge_depth_nerf.masks.regions import (
    block_mean,
    components,
    dilated,
    enlarge,
    filled,
    from_nearest,
    larger,
    means_within,
    opened,
    touching,
    whole_blocks,
)

WORKING_PX = 750
"""Pictures are averaged down until they have no more pixels than a square of this side."""
NEAR_M = 20.0
"""A monocular distance below this is trusted to be no sky: networks put the sky at tens of metres, rarely nearer,
and ceilings, tree crowns and house fronts beside the road lie below."""

_HORIZON_DEG = 1.0
"""Below this elevation nothing is sky: hills and houses hide it, and poses are not exact."""
_HIGH_DEG = 25.0
"""Above most houses across the street: from here on a smooth bright region need not reach the picture's rim."""
_BRIGHTER_THAN_GROUND = 1.4
"""How much brighter the sky must be than the ground: below a ceiling it hardly is."""
_ROAD_QUANTILE = 0.25
"""Of the brightness below the horizon: a white van close by is no measure."""
_BRIGHT_LEVEL = 220.0
"""Sky may always be this bright: near white nothing can be much brighter than bright ground."""
_DARKEST_LEVEL = 150.0
"""By day the sky is brighter than the middle of a picture's range; by night, and under a lit ceiling, nothing is."""
_SMOOTH_LEVELS = 5.0
"""Steepest change from one pixel to the next, in levels of any colour, of what sky is first looked for in."""
_REDDEST = 0.95
"""Least ratio of blue to red."""
_BRIGHTNESS_CHANGE = 0.18
_COLOUR_CHANGE = 0.20
"""Shares by which brightness may differ from the sky around, and blue over red fall below it: clouds differ so
much, house fronts mostly more."""
_STEEP_BRIGHTNESS_CHANGE = 0.15
"""The same where the picture is not smooth: at outlines, where a pixel shows the sky and something before it."""
_AROUND = 1 / 16
"""Scale of the sky around, as a share of the picture's longer side."""
_MIN_SHARE_AROUND = 1e-3
"""Share of a Gaussian that must lie in the sky for its mean to say anything."""
_SMALLEST_SHARE = 0.005
"""A smaller region, as a share of the mask, is a lamp or a window, unless it reaches the picture's rim."""
_SMALLEST_LOW_SHARE = 0.002
"""The same of one that reaches the rim."""
_LARGEST_HOLE_PX = 10.0
"""Larger holes in the sky are lamps, wires, birds."""
_ROUNDS = 3
"""How often what was found is grown, a distance of some `_AROUND` each time."""
_MOST_BELOW = 0.25
"""A region goes on below the horizon if so much lies there, as a share of what lies above."""
_MOST_POINTS = 0.3
"""LiDAR points in a region, as a share of those to be expected: the sky has none, but for where it runs into a car's
roof or twigs."""
_FEWEST_POINTS = 8
_NARROWEST = 1 / 60
"""Radius of the disc, as a share of the longer side, that fills most of a grey or white sky."""
_NARROWEST_BLUE = 1 / 120
"""The same of a blue one."""
_MOST_HOLES = 0.05
"""Area of holes over a region's: house fronts have windows; trees and lamps before the sky stand on the ground."""
_MOST_FADING = 0.3
"""Share of a region's border without an edge."""
_BLUE_FOR_SIZE, _BLUEST = 10.0, 0.5
"""Worth of the logarithm of blue over red beside that of the size, and up to what."""
_RIM_SHARE = 1 / 150
"""How near to the rim, as a share of the picture's longer side, a region reaches it."""
_BLUE = 0.15
"""Logarithm of blue over red from which on a region is surely no wall in the light."""
_WHITER_PER_DEG = 0.012
"""How fast, beside `_COLOUR_CHANGE`, the logarithm of blue over red may fall with the distance from a bluer region."""
_MOST_WHITER = 0.4
_LEAST_ALIKE = 0.7
"""Share of a region's pixels that must fit the sky that was found before."""
_BRIGHTEST_QUANTILE = 0.98
_GREY_BESIDE, _BLUE_BESIDE = 0.8, 0.7
"""How bright a grey or white sky, and a blue one, is at least beside the brightest that the picture shows."""
_LARGEST_GAP_DEG = 0.5
"""Largest hole between twigs (its side), and its largest distance from the sky."""


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
        lidar_m: distance of LiDAR points in metres, 0 = none. A pixel with one is no sky, however far it is.
        mono_m: monocular distance in metres, 0 = none; None without.

    Returns:
        True = sky.
    """
    factor = math.ceil(math.sqrt(mask.size) / WORKING_PX)
    usable = whole_blocks(mask, factor)
    seen = rays(camera.downscaled(factor))
    far = lidar_m == 0
    lidar_points = ~whole_blocks(far, factor)
    if mono_m is not None:
        far &= (mono_m == 0) | (mono_m >= NEAR_M)
    possible = usable & ~dilated(lidar_points, 1.0) & (block_mean(far.astype(np.float32), factor) > 0.5)
    blocks = _Blocks(block_mean(picture, factor).astype(np.float32), seen, usable, possible, lidar_points, up_in_camera)
    sky = _with_gaps(blocks, _grow(blocks, _regions(blocks)))
    if usable.any():
        # blocks that the mask cuts, along the lens's rim, are as those beside them
        sky = from_nearest(sky, usable)[0]
    return enlarge(sky, factor, (mask.shape[0], mask.shape[1])) & mask & far


def regions_like_sky(
    picture: UInt8[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"], ground: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Of regions without distance, those that may be sky: on average as bright as `find_sky` wants it.

    A stereo matcher or a depth camera has nothing to say of dark crowns and of what one eye alone sees, either. The
    brightness of what `ground` shows counts.
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


class _Blocks:
    """A picture averaged down, and what is known of its pixels."""

    def __init__(
        self,
        colour: Float32[np.ndarray, "h w 3"],
        seen: Rays,
        usable: Bool[np.ndarray, "h w"],
        possible: Bool[np.ndarray, "h w"],
        lidar_points: Bool[np.ndarray, "h w"],
        up_in_camera: Float[np.ndarray, "3"],
    ) -> None:
        """Work out what the steps share."""
        usable, height_sine = usable & seen.within, seen.directions @ up_in_camera.astype(np.float32)
        self.usable, self.lidar_points = usable, lidar_points
        self.directions, self.height_sine = seen.directions, height_sine
        self.side = max(usable.shape)
        self.brightness = colour.max(-1)
        self.blue = np.log((colour[..., 2] + 8) / (colour[..., 0] + 8))
        bright = self.brightness >= _darkest(self.brightness[usable & (height_sine < 0)])
        self.like_sky = usable & bright & (self.blue >= math.log(_REDDEST))
        """By colour alone."""
        self.possible = self.like_sky & possible & (height_sine > _sine(_HORIZON_DEG))
        """By distance and elevation as well."""
        soft = cv2.GaussianBlur(colour, (0, 0), 0.8)
        slope = np.hypot(cv2.Sobel(soft, -1, 1, 0, scale=1 / 8), cv2.Sobel(soft, -1, 0, 1, scale=1 / 8))
        self.smooth = slope.max(-1) <= _SMOOTH_LEVELS
        beside = np.linalg.norm(np.diff(seen.directions[:, : self.side // 2 + 1], axis=1), axis=-1)
        inside = (usable[:, 1:] & usable[:, :-1])[:, : beside.shape[1]]
        self.degrees_per_px = math.degrees(float(np.median(beside[inside]))) if inside.any() else 1.0


def _sine(angle_deg: float) -> float:
    return math.sin(math.radians(angle_deg))


def _regions(blocks: _Blocks) -> Bool[np.ndarray, "h w"]:
    """Smooth regions that are sky as a whole."""
    labels, sizes = components(blocks.possible & blocks.smooth)
    used = int(blocks.usable.sum())
    high = np.zeros(len(sizes), np.int64)
    np.add.at(high, labels[blocks.height_sine > _sine(_HIGH_DEG)], 1)
    at_rim = np.zeros(len(sizes), bool)
    at_rim[labels[_upper_rim(blocks)]] = True
    kept = (high >= _SMALLEST_SHARE * used) | (at_rim & (sizes >= _SMALLEST_LOW_SHARE * used))
    kept[0] = False
    brightest = float(np.quantile(blocks.brightness[blocks.usable], _BRIGHTEST_QUANTILE)) if used else 0.0
    surfaces = _surfaces(blocks)
    found: list[tuple[bool, float, np.ndarray]] = []
    for label in np.flatnonzero(kept):
        region = labels == label
        low = bool(high[label] < 0.5 * sizes[label])
        if surfaces[region].mean() < 0.5 and _may_be_sky(blocks, region, low, brightest):
            # the bluest first, unless it is small
            blue = min(float(np.quantile(blocks.blue[region], 0.9)), _BLUEST)
            found.append((_is_wide(blocks, region), math.log(sizes[label]) + _BLUE_FOR_SIZE * blue, region))
    sky = np.zeros(blocks.usable.shape, bool)
    for wide, _, region in sorted(found, key=lambda each: each[:2], reverse=True):
        # narrow ones are sky between trees beside a wide one, and lamps and pipes without
        if _fits(blocks, region, sky) if sky.any() else wide:
            sky |= region
    return sky


def _may_be_sky(blocks: _Blocks, region: Bool[np.ndarray, "h w"], low: bool, brightest: float) -> bool:
    """Whether a region has the brightness and the shape of a sky; `low` ones must not look like house fronts either."""
    bluish = float(np.median(blocks.blue[region])) >= _BLUE
    if np.median(blocks.brightness[region]) < (_BLUE_BESIDE if bluish else _GREY_BESIDE) * brightest:
        return False
    if not low:
        return True
    border = dilated(region, 1.0) & ~region & blocks.usable & (blocks.height_sine > _sine(_HORIZON_DEG))
    # where no edge is, a shade of the same wall begins
    fades = (border & blocks.smooth & ~blocks.like_sky).sum() > _MOST_FADING * border.sum()
    holes = larger(filled(region) & ~region, _LARGEST_HOLE_PX)
    windows = holes.sum() > _MOST_HOLES * region.sum()
    return not (fades or (windows and not bluish))


def _is_wide(blocks: _Blocks, region: Bool[np.ndarray, "h w"]) -> bool:
    """Whether discs fill most of a region."""
    bluish = float(np.median(blocks.blue[region])) >= _BLUE
    narrowest_px = (_NARROWEST_BLUE if bluish else _NARROWEST) * blocks.side
    return bool((region & _near(~_near(~region, narrowest_px), narrowest_px)).sum() > 0.5 * region.sum())


def _near(where: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """What `dilated` gives, of large radii in less time."""
    if not where.any():
        return where
    return np.asarray(cv2.distanceTransform((~where).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)) <= radius_px


def _upper_rim(blocks: _Blocks) -> Bool[np.ndarray, "h w"]:
    """Pixels above which the picture ends."""
    reach = max(2.0, _RIM_SHARE * blocks.side)
    height = blocks.height_sine.astype(np.float32)
    slope = np.stack([cv2.Sobel(height, -1, *along) for along in ((1, 0), (0, 1))], -1)
    step = reach * slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-9)
    y, x = np.indices(height.shape, np.float32)
    usable = blocks.usable.astype(np.float32)
    above = cv2.remap(usable, x + step[..., 0], y + step[..., 1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return blocks.usable & (above == 0)


def _surfaces(blocks: _Blocks) -> Bool[np.ndarray, "h w"]:
    """Smooth bright regions of a surface: they continue below the horizon, or have as many LiDAR points as others."""
    labels, sizes = components(blocks.like_sky & blocks.smooth)

    def sums(values: Shaped[np.ndarray, "h w"]) -> Float[np.ndarray, "n"]:
        return np.bincount(labels.ravel(), weights=values.ravel(), minlength=len(sizes))

    above = sums(blocks.height_sine > _sine(_HORIZON_DEG))
    low = sums(blocks.height_sine > _sine(_HIGH_DEG)) < 0.5 * above
    goes_on = low & (sums(blocks.height_sine < -_sine(_HORIZON_DEG)) > _MOST_BELOW * above)
    # as many as one would have at these elevations where no sky can be
    bins = np.clip((90 + np.degrees(np.arcsin(np.clip(blocks.height_sine, -1, 1)))).astype(np.int64), 0, 179)
    others = blocks.usable & ~blocks.like_sky
    there, returned = (np.bincount(bins[where], minlength=180) for where in (others, others & blocks.lidar_points))
    expected = sums((returned / np.maximum(there, 1))[bins])
    surface = goes_on | (sums(blocks.lidar_points) > np.maximum(_MOST_POINTS * expected, _FEWEST_POINTS))
    surface[0] = False
    return surface[labels]


def _fits(blocks: _Blocks, region: Bool[np.ndarray, "h w"], sky: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a region may be the same sky: nowhere much darker or whiter than the sky next to it."""
    means, _ = means_within((blocks.brightness, blocks.blue), sky, _AROUND * blocks.side)
    number = np.arange(sky.size, dtype=np.int64).reshape(sky.shape)
    nearest = from_nearest(number, sky)[0][region]
    around, blue_around = (mean.ravel()[nearest] for mean in means)
    cosine = np.sum(blocks.directions.reshape(-1, 3)[nearest] * blocks.directions[region], -1)
    away_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    whiter = np.minimum(_COLOUR_CHANGE + _WHITER_PER_DEG * away_deg, _MOST_WHITER)
    alike = blocks.blue[region] >= blue_around - whiter
    alike &= blocks.brightness[region] >= (1 - _BRIGHTNESS_CHANGE) * around
    return bool(alike.mean() >= _LEAST_ALIKE)


def _alike(blocks: _Blocks, sky: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """What is like the sky around it, by colour alone."""
    (around, blue_around), share = means_within((blocks.brightness, blocks.blue), sky, _AROUND * blocks.side)
    change = np.where(blocks.smooth, _BRIGHTNESS_CHANGE, _STEEP_BRIGHTNESS_CHANGE)
    alike = np.abs(blocks.brightness - around) <= change * around
    alike &= np.abs(blocks.blue - blue_around) <= _COLOUR_CHANGE
    return blocks.like_sky & alike & (share > _MIN_SHARE_AROUND)


def _grow(blocks: _Blocks, sky: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """From what is surely sky to all that hangs together with it and looks like it."""
    for _ in range(_ROUNDS):
        grown = blocks.possible & _alike(blocks, sky)
        # what only a bridge one pixel wide connects is another thing
        sky = sky | touching(opened(grown, 1.0), sky)
    # noise in clouds and about the sun leaves holes of a few pixels
    return sky | (blocks.possible & ~larger(~sky, _LARGEST_HOLE_PX))


def _with_gaps(blocks: _Blocks, sky: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The sky and the small holes between twigs beside it."""
    reach_px = max(1.0, _LARGEST_GAP_DEG / blocks.degrees_per_px)
    for _ in range(_ROUNDS):
        others = _alike(blocks, sky) & ~sky
        # a van with LiDAR points on it is one thing, of which they leave pieces
        gaps = blocks.possible & others & ~larger(others, reach_px**2)
        sky = sky | touching(gaps, gaps & _near(sky, reach_px))
    return sky
