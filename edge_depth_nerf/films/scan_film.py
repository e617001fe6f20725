"""A film of scans, seen from behind and above the scanner: an animated WebP, which browsers show."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from edge_depth_nerf.base.files import write_bytes
from edge_depth_nerf.base.pictures import HEIGHT, NO_VALUE_RGB

SIZE_PX = (800, 450)
FOCAL_PX = 420.0
BEHIND_M, ABOVE_M, DOWN_DEG = 14.0, 9.0, 24.0
"""Where the film's camera is, as seen from the scanner, and how far it looks down."""
NEAR_M = 1.0


def draw_scan(points_m: Float[np.ndarray, "points 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Draw a scan from behind and above the scanner, coloured by height; points in the scanner's frame."""
    tilt = np.radians(DOWN_DEG)
    ahead, up = points_m[:, 0] + BEHIND_M, points_m[:, 2] - ABOVE_M
    along = np.cos(tilt) * ahead - np.sin(tilt) * up
    shown = np.flatnonzero(along > NEAR_M)
    below = -np.sin(tilt) * ahead - np.cos(tilt) * up
    x = SIZE_PX[0] / 2 - FOCAL_PX * points_m[shown, 1] / along[shown]
    y = SIZE_PX[1] / 2 + FOCAL_PX * below[shown] / along[shown]
    inside = (x >= 0) & (x < SIZE_PX[0] - 1) & (y >= 0) & (y < SIZE_PX[1] - 1)
    # the nearest point of a pixel is drawn last
    order = np.argsort(-along[shown[inside]], kind="stable")
    column, row = x[inside][order].astype(int), y[inside][order].astype(int)
    canvas = np.full((SIZE_PX[1], SIZE_PX[0], 3), NO_VALUE_RGB, np.uint8)
    height_m = points_m[shown[inside][order], 2][None]
    colours = HEIGHT.coloured(height_m, np.ones_like(height_m, bool))[0]
    for down, right in ((1, 1), (1, 0), (0, 1), (0, 0)):
        canvas[row + down, column + right] = colours
    return canvas


def write_film(path: Path, scans_m: Iterable[Float[np.ndarray, "points 3"]], seconds: float) -> None:
    """Write a film of scans, points in the scanner's frame, with so many seconds between two; atomically."""
    pictures = []
    for points_m in scans_m:
        # as WebP, so that a long film needs little memory
        made = BytesIO()
        Image.fromarray(draw_scan(points_m)).save(made, "WEBP", quality=90)
        pictures.append(Image.open(made))
    made = BytesIO()
    options = {"append_images": pictures[1:], "duration": round(1000 * seconds), "loop": 0, "quality": 80}
    pictures[0].save(made, "WEBP", save_all=True, **options)
    write_bytes(path, made.getvalue())
