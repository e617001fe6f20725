"""Reads what a drive recorded: depth maps as distance along the ray, pictures and maps at the scene's size.

They are made smaller by a whole factor K: one pixel from each block of K×K. Rows and columns that do not fill a block,
at the bottom and at the right, are cut off, as `Camera.downscaled` does; pixel centres are at +0.5, so a block's centre
is its pixel's centre.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import distance_from_z_depth, rays
from edge_depth_nerf.masks.regions import block_mean
from edge_depth_nerf.process.recording import DepthFile
from edge_depth_nerf.scene.checks import size_error
from edge_depth_nerf.scene.writer import DistanceMap, Picture

Content = TypeVar("Content")
_SAME_SURFACE = 1.1
"""Two distances whose ratio is below this are taken to lie on one surface."""


def read_if_whole(read: Callable[[], Content], *, strict: bool = False) -> Content | None:
    """Read something; None for a missing or broken file, which is reported when its turn comes, unless `strict`."""
    try:
        return read()
    except (InputError, FileNotFoundError):
        if strict:
            raise
        return None


def _blocks(map_: np.ndarray, factor: int) -> np.ndarray:
    """H×W to (H/K)×(W/K)×K²."""
    height, width = map_.shape[0] // factor, map_.shape[1] // factor
    cut = map_[: height * factor, : width * factor]
    return cut.reshape(height, factor, width, factor).swapaxes(1, 2).reshape(height, width, factor * factor)


def downscale_image(image: UInt8[np.ndarray, "h w 3"], factor: int) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Average each block of a picture."""
    return image if factor == 1 else block_mean(image, factor)


def downscale_mask(mask: Bool[np.ndarray, "h w"], factor: int) -> Bool[np.ndarray, "h2 w2"]:
    """Keep a block only if every pixel of it is kept."""
    return mask if factor == 1 else _blocks(mask, factor).all(-1)


def downscale_distance(distance_m: Float[np.ndarray, "h w"], factor: int) -> Float[np.ndarray, "h2 w2"]:
    """Take each block's median distance, metres, 0 = none.

    Pixels without a value do not count; a block of which more than half has none gets none. Of an even count the
    two middle values are averaged where they lie on one surface, which puts the value on the block's centre, and
    the nearer one is taken where they do not: no distance arises at which there is nothing.
    """
    if factor == 1:
        return distance_m
    blocks = _blocks(distance_m, factor)
    # what has no value is sorted to the end
    ordered = np.sort(np.where(blocks > 0, blocks, np.inf), -1)
    count = (blocks > 0).sum(-1)
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[..., None], -1)[..., 0]
    high = np.take_along_axis(ordered, np.minimum(count // 2, factor**2 - 1)[..., None], -1)[..., 0]
    has_value = count * 2 >= factor**2
    low, high = np.where(has_value, low, 0.0), np.where(has_value, high, 0.0)
    return np.where(high < _SAME_SURFACE * low, (low + high) / 2, low).astype(distance_m.dtype)


def read_depth(depth: DepthFile, camera: Camera) -> Float[np.ndarray, "h w"]:
    """Read a depth map and turn it into distance along the ray, metres, 0 = none.

    Raises:
        InputError: broken, or not of the camera's size.
    """
    distance_m = read_distance_png(depth.path, depth.metres_per_count)
    if distance_m.shape != (camera.height, camera.width):
        raise InputError(size_error(depth.path, distance_m.shape[1], distance_m.shape[0], camera))
    if depth.kind == "distance":
        return distance_m
    return distance_from_z_depth(distance_m, rays(camera))


def load_picture(path: Path, factor: int) -> Picture:
    """A picture at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_image(read_image(path), factor)


def load_distance(path: Path, factor: int) -> DistanceMap:
    """A distance map at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_distance(read_distance_png(path), factor)
