"""Moving things in a picture: from the places of LiDAR points on them to all that the picture shows of them.

LiDAR points on a thing lie some pixels apart, miss its outline, and end at the upper edge of the scanner's field. What
lies between them is the thing's; how far it goes beyond them the picture tells: the outline is put where colour changes
most between the thing's LiDAR points and those of what holds still (watershed). Above the scanner's field the roof is
the height along which the picture has an edge.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from edge_depth_nerf.masks.regions import closed, dilated, eroded, filled

_FREE_REACH = 0.5
_FREE_PX = 1.0
"""A LiDAR point stands for half the way to the next one; the outline may lie beyond that by so many times the way
between two, and so many pixels."""
_STRONG_EDGE, _WEAK_EDGE = 6.0, 2.5
"""Steepest change from one pixel to the next, in grey levels, that counts; and the least mean along an edge."""
_STANDS_OUT = 1.2
"""So many times the median of all lines a line on an edge has."""
_ABOUT_AS_CLEAR = 0.9
"""Of lines whose means are this near to the highest the first counts: behind a roof there are others."""
_LEAST_POINTS = 5
_MARGIN = 1 / 400
"""What was found is widened by this share of the picture's longer side: motion and the lens blur the outline."""


def grow_moving(
    picture: UInt8[np.ndarray, "h w 3"],
    points_px: Float[np.ndarray, "n 2"],
    reach_px: Float[np.ndarray, "n"],
    still: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Grow the LiDAR points on moving things to the things' outlines.

    Args:
        picture: RGB.
        points_px: where LiDAR points on moving things are seen, column and row.
        reach_px: how far apart LiDAR points are there.
        still: pixels with a LiDAR point on a still thing, and those that are not used.

    Returns:
        True = a thing that moves.
    """
    shape = still.shape
    if not len(points_px):
        return np.zeros(shape, bool)
    longest_px = float(np.quantile(reach_px, 0.9))
    core = closed(_discs(shape, points_px, 0.5 * reach_px), longest_px)
    seeds = _discs(shape, points_px, np.zeros(len(points_px)))
    possible = dilated(core, _FREE_REACH * longest_px + _FREE_PX)
    inner = eroded(core, 1.0) | seeds
    against = (still & ~inner) | ~possible
    markers = np.zeros(shape, np.int32)
    markers[against], markers[inner & ~against] = 1, 2
    smooth = cv2.bilateralFilter(np.ascontiguousarray(picture), 5, 25, 2)
    grown = cv2.watershed(smooth, markers) == 2
    return dilated(filled(grown | inner), max(_MARGIN * max(shape), 1.0))


def clearest_edge(picture: UInt8[np.ndarray, "h w 3"], lines_px: Sequence[Float[np.ndarray, "_ 2"]]) -> int | None:
    """Find which of some lines (column and row of points inside the picture) lies on an edge of the picture.

    It is the first of those that are about as clear; None where none stands out.
    """
    if all(len(line) < _LEAST_POINTS for line in lines_px):
        return None
    grey = cv2.GaussianBlur(picture, (0, 0), 0.8).max(-1).astype(np.float32)
    slope = np.hypot(cv2.Sobel(grey, -1, 1, 0, scale=1 / 8), cv2.Sobel(grey, -1, 0, 1, scale=1 / 8))
    # an edge counts by its length, not by how bright the sky is behind a part of it
    slope = cv2.dilate(np.minimum(slope, _STRONG_EDGE), np.ones((3, 3), np.uint8))
    means = []
    for line in lines_px:
        column, row = np.floor(line).astype(int).T
        means.append(float(slope[row, column].mean()) if len(line) >= _LEAST_POINTS else 0.0)
    if max(means) < max(_STANDS_OUT * float(np.median(means)), _WEAK_EDGE):
        return None
    return next(number for number, mean in enumerate(means) if mean >= _ABOUT_AS_CLEAR * max(means))


def _discs(
    shape: tuple[int, ...], centres_px: Float[np.ndarray, "n 2"], radius_px: Float[np.ndarray, "n"]
) -> Bool[np.ndarray, "h w"]:
    """Paint discs about points; a radius of 0 paints the point's pixel."""
    painted = np.zeros(shape, np.uint8)
    for (x, y), radius in zip(np.floor(centres_px).astype(int).tolist(), np.rint(radius_px).astype(int), strict=True):
        cv2.circle(painted, (x, y), int(radius), (1,), -1)
    return painted.astype(bool)
