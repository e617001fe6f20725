"""Reads what a drive recorded: depth maps as distance along the ray, pictures and maps at the scene's size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import distance_from_z_depth, rays
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
    return distance_from_z_depth(distance_m, rays(camera))


def load_picture(path: Path, factor: int) -> Picture:
    """A picture at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_image(read_image(path), factor)


def load_distance(path: Path, factor: int) -> DistanceMap:
    """A distance map at the scene's size; the file itself where that is its own."""
    return path if factor == 1 else downscale_distance(read_distance_png(path), factor)
