"""What distances from motion teach the depth network, and which of them are left out to evaluate it.

Where no LiDAR point ever fell, neither a picture's own nor one of others seen from afar, only consistent distances from
motion are known. They count less the less exact they are. Some places in the world are left out of all pictures'
training: there the network's error is measured (`mono.calibration`). They are left out by place, not by picture,
because the same wall is seen from many of them.

Lengths are metres, distances along the ray, 0 = none.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from edge_depth_nerf.method.prior import motion_sigma
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

PLACE_M = 2.0
"""Side of the cubes of the world that are left out as a whole."""
LEFT_OUT_EVERY = 8
"""One cube of so many is left out."""
NETWORK_ERROR = 0.05
"""Relative error of a network of this size: a measurement with the same error counts half."""
_PRIMES = np.array([73_856_093, 19_349_663, 83_492_791], np.int64)


def left_out_places(points_m: Float64[np.ndarray, "*shape 3"]) -> Bool[np.ndarray, "*shape"]:
    """Which points in the world lie in a place that no training sees: a fixed rule of the place alone."""
    x, y, z = np.moveaxis(np.floor(points_m / PLACE_M).astype(np.int64) * _PRIMES, -1, 0)
    number = x ^ y ^ z
    # the low bits of a product are those of its factors
    number = (number ^ (number >> 13)) * 1_274_126_177
    return ((number ^ (number >> 16)) & 0x7FFFFFFF) % LEFT_OUT_EVERY == 0


def left_out_pixels(
    scene: SceneFolder, picture: ScenePicture, distance_m: Float32[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Which of a picture's distances, at its size, lie in such a place."""
    points_m = to_world(picture, scene.rays(picture).directions * distance_m[..., None])
    return left_out_places(points_m) & (distance_m > 0)


def to_world(picture: ScenePicture, in_camera: Float[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """Move points from a picture's camera (x right, y down, z forward) to the world."""
    return (in_camera * np.array([1.0, -1.0, -1.0])) @ picture.rotation.T + picture.position_m


def taught_by_motion(
    scene: SceneFolder, picture: ScenePicture
) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]] | None:
    """A picture's distances from motion without those in left-out places, and their weight beside a LiDAR point's 1.

    Both at the picture's size, 0 = none; None if the picture has no map.
    """
    motion_m = scene.distance_m(picture, "motion")
    if motion_m is None:
        return None
    motion_m = np.where(left_out_pixels(scene, picture, motion_m), np.float32(0), motion_m)
    sigma_m = motion_sigma(motion_m, scene.distance_m(picture, "motion_sigma"))
    relative = sigma_m / np.maximum(motion_m, np.float32(1e-3))
    weight = 1 / (1 + (relative / NETWORK_ERROR) ** 2)
    return motion_m, np.where(motion_m > 0, weight, 0).astype(np.float32)
