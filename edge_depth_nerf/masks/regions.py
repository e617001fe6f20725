"""What finding masks needs of image processing: averages over parts of a picture, connected regions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, Shaped, UInt8

WORKING_PX = 700
"""Pictures are averaged down until the longer side is no longer than this."""


def working_factor(shape: tuple[int, ...]) -> int:
    """By how much pictures of a size are averaged down to `WORKING_PX`."""
    return math.ceil(max(shape[:2]) / WORKING_PX)


def block_mean(values: UInt8[np.ndarray, "H W *c"] | Float32[np.ndarray, "H W"], factor: int) -> np.ndarray:
    """Average blocks of `factor`×`factor` pixels, in the type of the values; incomplete blocks are dropped."""
    height, width = values.shape[0] // factor, values.shape[1] // factor
    whole = np.ascontiguousarray(values[: height * factor, : width * factor])
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)


def whole_blocks(where: Bool[np.ndarray, "H W"], factor: int) -> Bool[np.ndarray, "h w"]:
    """Blocks that are True in all their pixels."""
    return block_mean(where.astype(np.float32), factor) == 1


def enlarge(where: Bool[np.ndarray, "h w"], factor: int, shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """Undo `whole_blocks`, with smooth outlines; what filled no block, at the right and at the bottom, is as beside."""
    size = (where.shape[1] * factor, where.shape[0] * factor)
    enlarged = cv2.resize(where.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    missing = (0, shape[0] - enlarged.shape[0], 0, shape[1] - enlarged.shape[1])
    return cv2.copyMakeBorder(enlarged, *missing, cv2.BORDER_REPLICATE) > 0.5


def means_within(
    layers: Sequence[Float32[np.ndarray, "h w"]], where: Bool[np.ndarray, "h w"], sigma_px: float
) -> tuple[list[Float32[np.ndarray, "h w"]], Float32[np.ndarray, "h w"]]:
    """Gaussian means of the layers' values at `where` alone, and the share of each one's Gaussian that lay there.

    Wide ones are worked out at a lower resolution, which they do not show.
    """
    height, width = where.shape
    step = max(1, int(sigma_px / 3))
    small = (math.ceil(width / step), math.ceil(height / step))

    def smooth(layer: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        reduced = cv2.resize(layer, small, interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(reduced, (0, 0), sigma_px / step)
        return np.asarray(cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

    weight = where.astype(np.float32)
    share = smooth(weight)
    return [smooth(layer * weight) / np.maximum(share, 1e-6) for layer in layers], share


def disc(radius_px: float) -> UInt8[np.ndarray, "k k"]:
    """Structuring element of at least 3×3 pixels."""
    size = 2 * max(1, round(radius_px)) + 1
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)), np.uint8)


def dilated(where: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """Grow by a radius; nothing grows in from outside the picture."""
    return cv2.dilate(where.astype(np.uint8), disc(radius_px)).astype(bool)


def eroded(where: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """Shrink by a radius, at the picture's border as well."""
    return cv2.erode(where.astype(np.uint8), disc(radius_px), borderType=cv2.BORDER_CONSTANT, borderValue=(0,)) > 0


def opened(where: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """Remove what is narrower than the disc; the picture's border does not narrow."""
    return cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_OPEN, disc(radius_px)).astype(bool)


def closed(where: Bool[np.ndarray, "h w"], radius_px: float) -> Bool[np.ndarray, "h w"]:
    """Fill what is narrower than the disc."""
    return cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_CLOSE, disc(radius_px)).astype(bool)


def components(where: Bool[np.ndarray, "h w"]) -> tuple[Int32[np.ndarray, "h w"], Int64[np.ndarray, "n"]]:
    """Number the regions that hang together by their sides, from 1; second their sizes in pixels, that of 0 being 0."""
    count, labels = cv2.connectedComponents(where.astype(np.uint8), connectivity=4, ltype=cv2.CV_32S)
    labels = np.asarray(labels, np.int32)
    sizes = np.bincount(labels.ravel(), minlength=count).astype(np.int64)
    sizes[0] = 0
    return labels, sizes


def touching(where: Bool[np.ndarray, "h w"], seeds: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Those regions of `where` that contain a seed."""
    labels, sizes = components(where)
    kept = np.zeros(len(sizes), bool)
    kept[np.unique(labels[seeds])] = True
    kept[0] = False
    return kept[labels]


def larger(where: Bool[np.ndarray, "h w"], smallest_px: float) -> Bool[np.ndarray, "h w"]:
    """Those regions of `where` that have at least so many pixels."""
    labels, sizes = components(where)
    return (sizes >= max(smallest_px, 1))[labels]


def filled(where: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Fill holes: what does not hang together with the picture's border."""
    border = np.zeros(where.shape, bool)
    border[[0, -1]] = border[:, [0, -1]] = True
    return ~touching(~where, border)


def from_nearest(
    values: Shaped[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
) -> tuple[Shaped[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Give each pixel the value of the nearest pixel that is known, of which there is one; second, how far that is."""
    away_px, labels = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(labels)
    of_label = np.zeros(int(labels.max()) + 1, values.dtype)
    of_label[labels[known]] = values[known]
    return of_label[labels], np.asarray(away_px, np.float32)
