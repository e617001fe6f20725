"""Reads what a drive recorded: depth maps as distance along the ray, pictures and maps at the scene's size."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.process.downscale import downscale_distance, downscale_image
from edge_depth_nerf.process.recording import DepthFile
from edge_depth_nerf.scene.checks import size_error
from edge_depth_nerf.scene.writer import DistanceMap, Picture


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
    rays, valid = rays_of(camera)
    cosine = rays[..., 2].numpy()
    # a depth along the axis says nothing where the ray is at right angles to it, or points backwards
    usable = valid.numpy() & (cosine > 0.01)
    return np.where(usable, distance_m / np.where(usable, cosine, 1), 0).astype(np.float32)


@functools.lru_cache(maxsize=8)
def rays_of(camera: Camera) -> tuple[Float[Tensor, "h w 3"], Bool[Tensor, "h w"]]:
    """Unit rays of all pixels, 0 where there is none; takes seconds."""
    rays, valid = camera.unproject(camera.pixel_centres())
    return torch.where(valid[..., None], rays, 0.0).float(), valid


def load_picture(path: Path, factor: int) -> Picture:
    """A picture at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_image(read_image(path), factor)


def load_distance(path: Path, factor: int) -> DistanceMap:
    """A distance map at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_distance(read_distance_png(path), factor)
