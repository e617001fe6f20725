"""The recording vehicle in its own pictures, found as what never changes while it drives.

Brightness alone does not tell: exposure drifts, light moves over the vehicle's paint, and sky and asphalt hardly
change either. What tells is contrast, a pixel's brightness against its surroundings: exposure and shading cancel in
it, on the vehicle it stays the same to the noise of the pictures, and over passing asphalt it does not, however
faint. It is evaluated first against all that surrounds a pixel, then against the vehicle found so far, which makes the
outline sharp. Of what stays the same only what reaches the lower rim of the lens (or of the picture) is the vehicle;
a sky that never changes is not. Smooth road stays the same as well: what is found must have an edge along its outline
that stays, or a texture at it that is the same in two halves of the pictures. Pictures are taken to stand upright.

Lengths are shares of the picture's longer side, so the size of the pictures does not matter. A picture is used at
`regions.WORKING_PX` or less, and only if things have moved since the last one that was: a stop at a traffic light does
not count, and memory stays below some 200 MB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32, UInt8

from edge_depth_nerf.masks.regions import (
    block_mean,
    closed,
    components,
    dilated,
    enlarge,
    eroded,
    filled,
    from_nearest,
    means_within,
    opened,
    touching,
    whole_blocks,
    working_factor,
)

Picture = UInt8[np.ndarray, "h w 3"]

MIN_PICTURES = 10
"""Fewer pictures between which things have moved say too little: asphalt may look alike in a few."""
MAX_PICTURES = 60
"""When so many are held, every other one is let go, so that they are spread over the whole drive."""

_SURROUNDINGS = 1 / 120
"""Scale of the surroundings that contrast is measured against: finer than shading, coarser than texture."""
_POOL = 1 / 100
"""Side of the square that variances are pooled over: one pixel's own says little from ten pictures."""
_DARK_LEVELS = 8.0
"""Added to a brightness that is divided by: near black, contrast is nothing but noise."""
_SATURATED_LEVEL = 240.0
"""From about here on noise is cut off."""
_ALWAYS_SATURATED = 0.9
"""Of the pictures: a patch that is white in so many, such as paint in the sun, is not told by its contrast, which
follows the exposure."""
_NOISE_FLOOR_LEVELS = 1.0
"""Rounding and compression change a pixel by about this much, however quiet the sensor."""
_EDGE_CHANGE = 0.15
"""Share by which the contrast of the vehicle's own edges may change with the light on it."""
_PAINT_CHANGE = 0.02
"""The same for contrast against the vehicle alone: small, since road beside light paint has strong contrast too."""
_CHANGED = 2.0
"""Variance of the contrast, over that of what stays, above which a pixel is not of the vehicle."""
_CLEARLY_CHANGED = 4.0
"""Variances are counted up to here, lest what changes strongly beside the vehicle spills over its outline."""
_LIGHT_CHANGE = 0.35
"""Share by which the light on a part of the vehicle may vary (one standard deviation); more is something passing."""
_LASTING_EDGE = 0.04
"""Mean contrast of an edge that stays; it must also be more than its changes."""
_REPEATED = 0.005
"""Contrast of a texture that is the same in all pictures: more than rounding and compression leave on smooth road."""
_REPEATED_POOL = 1 / 40
"""Side of the square in which pictures are compared for it."""
_ALIKE = 0.5
"""Correlation of such a texture between one half of the pictures and the other."""
_LIT_LEVELS = 24.0
"""Darker surroundings show noise, not texture."""
_TEXTURE = 0.1
"""Contrast that is more than noise."""
_MOVED_SHARE = 0.15
"""A picture counts as new if this share of the texture has changed since the last one. While the vehicle moves it is
more, though its own texture stays; another car that passes a standing one changes less."""
_LINK = 1 / 120
"""Bridges narrower than this do not connect, gaps narrower than this do not separate."""
_OUTLINE = 1 / 350
"""The outline is smoothed over this length."""
_GROWN = 1 / 175
"""The mask is larger than what is found: the pixels at the outline show both, and a rim of the vehicle in the pictures
spoils the scene more than a rim of road that is missing."""
_SMALLEST_SHARE = 0.003
"""A smaller patch, as a share of the lens, is no part of a vehicle."""
_LOWER_RIM = 0.3
"""The lower rim begins so far below the lens's middle, as a share of the way to its lowest point."""
_BROAD = 0.4
"""What is no lower corner of the picture must touch so much of the lower rim. On rendered drives vehicles touch 0.7
or more, or a corner; lane markings and verges of a real road that stayed alike touched 0.25 in the middle."""
_CORNER = 0.02
"""Side of a corner."""
_TOLERANCES = (1.0, 1.5, 2.25)
"""Factors on the noise, tried until the outline is clear: strong compression adds noise along edges alone."""
_CLEAR = 0.9
"""Certainty of a clear outline."""
_MIN_CERTAINTY = 0.5
"""Without a clear outline along half of its length it is smooth road, or things too far to move."""


@dataclass(frozen=True)
class EgoMask:
    """Where the vehicle is in a camera's pictures."""

    keep: Bool[np.ndarray, "h w"]
    """True = use the pixel. Outside the lens the nearest pixel inside it decides."""
    share: float
    """Of the lens that the vehicle covers, 0-1."""
    certainty: float
    """Share of the vehicle's outline that has an edge or a texture which stays, or beyond which things clearly change,
    whichever is less, 0-1; above 0.9 as a rule."""
    pictures: int
    """How many pictures it was found from."""


@dataclass(frozen=True)
class NoEgo:
    """No vehicle was found."""

    reason: str
    """Why, as a sentence for the user."""
    could_tell: bool = True
    """Whether the pictures were enough to find one."""


def find_ego(
    pictures: Iterable[Picture | Callable[[], Picture]], lens: Bool[np.ndarray, "h w"], fewest: int = MIN_PICTURES
) -> EgoMask | NoEgo:
    """Find the vehicle in the pictures of one camera.

    Args:
        pictures: of one drive, in order, upright, some 20 to 200 spread over it; arrays, or what loads them. They are
            taken one by one, loaders called only when needed, and let go.
        lens: True inside the lens circle; all True without one.
        fewest: fewer pictures between which things have moved are too few. Of fewer than `MIN_PICTURES` smooth road may
            be taken for the vehicle, however clear its outline: something else must agree.

    Returns:
        The mask, or why there is none: too few pictures, a vehicle that stands, or nothing that stays the same.

    Raises:
        ValueError: a picture has another size than the lens.
    """
    factor = working_factor(lens.shape)
    small_lens = whole_blocks(lens, factor)
    if not small_lens.any():
        return NoEgo("The lens mask leaves no pixel.", could_tell=False)
    taken, offered = _take_moving(pictures, lens.shape, factor, small_lens)
    if offered < fewest:
        return NoEgo(
            f"{offered} pictures are too few (held-out ones do not count); at least {fewest} are needed.",
            could_tell=False,
        )
    if len(taken) < fewest:
        return NoEgo(
            f"The vehicle stands still: only {len(taken)} of {offered} pictures show something new; at least "
            f"{fewest} are needed.",
            could_tell=False,
        )
    count, stack = len(taken), np.stack(taken)
    del taken
    noise = _noise_levels(stack, small_lens)
    vehicle, certainty = np.zeros_like(small_lens), -1.0
    for tolerance in _TOLERANCES:
        found = _find(stack, small_lens, tolerance * noise)
        if found[1] > certainty:
            vehicle, certainty = found
        if certainty >= _CLEAR:
            break
    vehicle = _at_vehicles_place(vehicle, small_lens)
    if not vehicle.any():
        return NoEgo("No region at the lower border of the pictures stays the same while the vehicle moves.")
    if certainty < _MIN_CERTAINTY:
        return NoEgo(
            "The region at the lower border of the pictures that stays the same has no clear outline: there is an "
            f"edge or a texture that stays along only {certainty:.0%} of it. It may be smooth road."
        )
    ego = enlarge(dilated(vehicle, _GROWN * max(small_lens.shape)), factor, (lens.shape[0], lens.shape[1]))
    ego = from_nearest(ego, lens)[0]
    return EgoMask(~ego, float(ego[lens].mean()), certainty, count)


# ---- taking pictures in ----------------------------------------------------------------------------------------


def _take_moving(
    pictures: Iterable[Picture | Callable[[], Picture]],
    size: tuple[int, ...],
    factor: int,
    lens: Bool[np.ndarray, "h w"],
) -> tuple[list[Float16[np.ndarray, "h w"]], int]:
    """Grey pictures between which things have moved, at most `MAX_PICTURES`, and how many were offered."""
    taken: list[Float16[np.ndarray, "h w"]] = []
    last: Float32[np.ndarray, "h w"] | None = None
    every, offered = 1, 0
    for number, picture in enumerate(pictures):
        offered = number + 1
        if number % every:
            continue
        array = picture() if callable(picture) else picture
        if array.shape[:2] != size:
            raise ValueError(f"picture {number} has shape {array.shape}, the lens mask {size}")
        grey = block_mean(np.asarray(cv2.cvtColor(array, cv2.COLOR_RGB2GRAY), np.float32), factor)
        contrast, light = _contrast(grey, lens, lens)
        if last is not None and not _moved(contrast, last, lens & (light > _LIT_LEVELS)):
            continue
        last = contrast
        # half precision: steps of at most an eighth of a level
        taken.append(grey.astype(np.float16))
        if len(taken) == MAX_PICTURES:
            taken, every = taken[::2], 2 * every
    return taken, offered


def _moved(now: Float32[np.ndarray, "h w"], before: Float32[np.ndarray, "h w"], lit: Bool[np.ndarray, "h w"]) -> bool:
    """Whether enough of the texture has changed."""
    texture = lit & (np.maximum(np.abs(now), np.abs(before)) > _TEXTURE)
    changed = texture & (np.abs(now - before) > _TEXTURE)
    return int(changed.sum()) > _MOVED_SHARE * int(texture.sum())


# ---- what stays the same ---------------------------------------------------------------------------------------


def _find(
    stack: Float16[np.ndarray, "n h w"], lens: Bool[np.ndarray, "h w"], noise_levels: float
) -> tuple[Bool[np.ndarray, "h w"], float]:
    """The vehicle, and its certainty."""
    side = max(lens.shape)
    over_time = _over_time(stack, lens, lens)
    # an edge that stays shows in the mean; of what passes, the mean is smooth
    lasting = np.abs(over_time.mean) > np.maximum(_LASTING_EDGE, np.sqrt(over_time.variance))
    change = _change(over_time, lens, noise_levels, _EDGE_CHANGE)
    vehicle = _clean(lens & (change < _CHANGED), lens)
    for _ in range(2):
        if not vehicle.any():
            return vehicle, 0.0
        change = _change(_over_time(stack, lens, vehicle), lens, noise_levels, _PAINT_CHANGE)
        # the light on the vehicle says nothing far from it
        near = lens & dilated(vehicle, 3 * _SURROUNDINGS * side)
        vehicle = _clean(near & (change < _CHANGED), lens)
    vehicle = _clean(vehicle | touching(_white_patches(over_time, lens), dilated(vehicle, _LINK * side)), lens)
    outline = lens & dilated(vehicle, 1.0) & ~vehicle
    beyond = lens & dilated(vehicle, 3 * _POOL * side) & ~dilated(vehicle, _POOL * side)
    if not (outline.any() and beyond.any()):
        return vehicle, 0.0
    # paint like the road behind it has no edge there, but a texture that stays, which smooth road has not
    repeated = vehicle & _repeated(over_time, lens, noise_levels, len(stack))
    edged = dilated((lens & lasting) | repeated, _POOL * side)[outline].mean()
    # pooled with what is clipped: three quarters of the way is clear
    changing = (change[beyond] > 0.75 * _CLEARLY_CHANGED).mean()
    return vehicle, float(min(edged, changing))


def _repeated(
    over_time: _OverTime, lens: Bool[np.ndarray, "h w"], noise_levels: float, count: int
) -> Bool[np.ndarray, "h w"]:
    """Where one half of the pictures has the same texture at the same pixels as the other, and more than noise."""
    side = 2 * round(_REPEATED_POOL * max(lens.shape) / 2) + 1
    # at the rim the surroundings lie to one side: there a vignette looks like texture
    inner = eroded(lens, 3 * _SURROUNDINGS * max(lens.shape))
    shown = inner.astype(np.float32)
    one, other = (half * shown for half in over_time.halves)
    weight = np.maximum(cv2.blur(shown, (side, side)), 1e-6)
    common, power = (np.asarray(cv2.blur(each, (side, side))) for each in (one * other, (one**2 + other**2) / 2))
    noise = 2 * noise_levels**2 * over_time.inverse_light / count
    return inner & (common > _ALIKE * power) & (common > weight * np.maximum(noise, _REPEATED**2))


def _white_patches(over_time: _OverTime, lens: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """What is always saturated and lies below the lens's middle as a whole, which a bright sky does not."""
    labels, sizes = components(lens & (over_time.saturated >= _ALWAYS_SATURATED))
    sizes[np.unique(labels[: _middle_row(lens)])] = 0
    return (sizes > 0)[labels]


@dataclass(frozen=True)
class _OverTime:
    """What became of each pixel's contrast over the pictures."""

    mean: Float32[np.ndarray, "h w"]
    halves: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
    """Means over every other picture, and over those between."""
    variance: Float32[np.ndarray, "h w"]
    inverse_light: Float32[np.ndarray, "h w"]
    """Mean square of 1/brightness around: times the variance of the noise, it is that of the contrast."""
    light_variance: Float32[np.ndarray, "h w"]
    """Of the brightness around, relative."""
    saturated: Float32[np.ndarray, "h w"]
    """Share of the pictures in which it is."""


def _over_time(
    stack: Float16[np.ndarray, "n h w"], lens: Bool[np.ndarray, "h w"], reference: Bool[np.ndarray, "h w"]
) -> _OverTime:
    count = len(stack)
    contrast_square_sum, inverse_sum, log_sum, log_square_sum = (np.zeros(lens.shape) for _ in range(4))
    sums = np.zeros((2, *lens.shape))
    saturated = np.zeros(lens.shape, np.float32)
    for number, half in enumerate(stack):
        contrast, light = _contrast(half.astype(np.float32), lens, reference)
        sums[number % 2] += contrast
        contrast_square_sum += np.square(contrast, dtype=np.float64)
        inverse_sum += np.square(1 / light)
        log_light = np.log(light)
        log_sum += log_light
        log_square_sum += np.square(log_light, dtype=np.float64)
        saturated += half > _SATURATED_LEVEL
    contrast_sum = sums[0] + sums[1]
    return _OverTime(
        mean=(contrast_sum / count).astype(np.float32),
        halves=((sums[0] / (count - count // 2)).astype(np.float32), (sums[1] / (count // 2)).astype(np.float32)),
        variance=np.maximum((contrast_square_sum - contrast_sum**2 / count) / (count - 1), 0).astype(np.float32),
        inverse_light=(inverse_sum / count).astype(np.float32),
        light_variance=np.maximum(log_square_sum / count - np.square(log_sum / count), 0).astype(np.float32),
        saturated=saturated / np.float32(count),
    )


def _change(
    over_time: _OverTime, lens: Bool[np.ndarray, "h w"], noise_levels: float, shading_change: float
) -> Float32[np.ndarray, "h w"]:
    """Variance of each pixel's contrast, as a multiple of what it would be on the vehicle, pooled and clipped."""
    allowed = noise_levels**2 * over_time.inverse_light + np.square(shading_change * over_time.mean)
    ratio = np.minimum(over_time.variance / allowed, _CLEARLY_CHANGED).astype(np.float32)
    side = 2 * round(_POOL * max(lens.shape) / 2) + 1
    weight = lens.astype(np.float32)
    pooled = cv2.blur(ratio * weight, (side, side)) / np.maximum(cv2.blur(weight, (side, side)), 1e-6)
    passing = over_time.light_variance > _LIGHT_CHANGE**2
    return np.where(passing, np.float32(_CLEARLY_CHANGED), pooled)


def _contrast(
    grey: Float32[np.ndarray, "h w"], lens: Bool[np.ndarray, "h w"], reference: Bool[np.ndarray, "h w"]
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Brightness against the mean of the reference's pixels around, 0 outside the lens; and what it is divided by."""
    (around,), _ = means_within((grey,), reference, max(1.0, _SURROUNDINGS * max(lens.shape)))
    light = around + np.float32(_DARK_LEVELS)
    return np.where(lens, (grey - around) / light, np.float32(0)), light


def _noise_levels(stack: Float16[np.ndarray, "n h w"], lens: Bool[np.ndarray, "h w"]) -> float:
    """Standard deviation of the pictures' noise in grey levels, from where they are flattest (Immerkær 1996)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
    found = []
    for half in stack:
        grey = half.astype(np.float32)
        usable = eroded(lens & (grey > 2 * _DARK_LEVELS) & (grey < _SATURATED_LEVEL), 4.0)
        if usable.any():
            # running sums of squares may end a little below 0
            power = cv2.blur(cv2.filter2D(grey, -1, kernel) ** 2, (7, 7)).clip(min=0)
            found.append(float(np.quantile(power[usable], 0.1)))
    return max(_NOISE_FLOOR_LEVELS, math.sqrt(float(np.median(found)))) if found else _NOISE_FLOOR_LEVELS


# ---- cleaning up -----------------------------------------------------------------------------------------------


def _middle_row(lens: Bool[np.ndarray, "h w"]) -> int:
    rows = np.flatnonzero(lens.any(1))
    return int((rows[0] + rows[-1]) / 2)


def _lower_rim(lens: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    middle, lowest = _middle_row(lens), int(np.flatnonzero(lens.any(1))[-1])
    rim = lens & ~eroded(lens, _LINK * max(lens.shape))
    rim[: round(middle + _LOWER_RIM * (lowest - middle))] = False
    return rim


def _at_vehicles_place(vehicle: Bool[np.ndarray, "h w"], lens: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Keep the pieces that touch the lower rim broadly, or a lower corner of the picture."""
    labels, sizes = components(vehicle)
    rim, corner = _lower_rim(lens), max(2, round(_CORNER * max(lens.shape)))
    broad = np.bincount(labels[rim], minlength=len(sizes)) >= _BROAD * rim.sum()
    kept = broad & (sizes > 0)
    for columns in (slice(None, corner), slice(-corner, None)):
        kept[np.unique(labels[-corner:, columns])] = True
    return kept[labels] & vehicle


def _clean(still: Bool[np.ndarray, "h w"], lens: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Keep what reaches the lower rim, fill its holes, drop islands, smooth the outline."""
    side, middle = max(lens.shape), _middle_row(lens)
    rim = _lower_rim(lens)
    # outside the lens all is still, lest the patches are rounded off at the rim
    labels, sizes = components(opened(still | ~lens, _LINK * side / 2) & lens)
    at_rim = np.unique(labels[rim])
    kept = np.isin(labels, at_rim[sizes[at_rim] >= _SMALLEST_SHARE * lens.sum()])
    if not kept.any():
        return kept
    below = ~lens
    below[:middle] = False
    whole = filled(closed(kept, _LINK * side) | below)
    smooth = cv2.GaussianBlur(whole.astype(np.float32), (0, 0), max(0.8, _OUTLINE * side))
    return lens & (smooth > 0.5)
