"""Pictures to look at: distance as colour, panels side by side.

Pure. Pictures are H×W×3 uint8 RGB, distances H×W metres along the ray.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

NEAREST_M, FARTHEST_M = 1.0, 60.0
"""The colours of a distance run over these, logarithmically."""
NO_VALUE_RGB = (40, 40, 40)
"""Colour of pixels without a distance."""


def colour_distance(distance_m: NDArray, mask: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Colour a distance map: near is red, far is blue, the same distance always has the same colour.

    Args:
        distance_m: H×W metres; not positive or not finite = no value.
        mask: H×W, True = show; others are drawn as having no value.

    Returns:
        H×W×3 uint8 RGB.

    """
    shown = np.isfinite(distance_m) & (distance_m > 0)
    if mask is not None:
        shown &= mask
    clipped = np.clip(np.where(shown, distance_m, NEAREST_M), NEAREST_M, FARTHEST_M)
    nearness = 1 - np.log(clipped / NEAREST_M) / np.log(FARTHEST_M / NEAREST_M)
    coloured = cv2.applyColorMap(np.rint(nearness * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.where(shown[..., None], coloured, np.array(NO_VALUE_RGB, np.uint8))


def side_by_side(rows: Sequence[Sequence[NDArray[np.uint8]]], titles: Sequence[str]) -> NDArray[np.uint8]:
    """Lay out pictures of one size in rows, with a title above each column and a thin gap between them.

    Args:
        rows: each with one H×W×3 picture a column.
        titles: one a column.

    """
    gap, bar = 6, 34
    height, width = rows[0][0].shape[:2]
    sheet = np.full((bar + len(rows) * (height + gap) - gap, len(titles) * (width + gap) - gap, 3), 255, dtype=np.uint8)
    for column, title in enumerate(titles):
        left = column * (width + gap)
        for row, pictures in enumerate(rows):
            top = bar + row * (height + gap)
            sheet[top : top + height, left : left + width] = pictures[column]
        font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.6
        (text_width, _), _ = cv2.getTextSize(title, font, scale, 1)
        at = (left + (width - text_width) // 2, 23)
        cv2.putText(sheet, title, at, font, scale, (30, 30, 30), 1, cv2.LINE_AA)
    return sheet
