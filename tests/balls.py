"""Views inside a textured ball, whose distances follow from a formula."""

import math

import numpy as np

from edge_depth_nerf.cameras import Camera, KannalaBrandt
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.stereo.views import View

RADIUS_M = 6.0
THETA_MAX_RAD = math.radians(105)
# 105° at the rim
FISHEYE = KannalaBrandt(110, 110, 29.0, 29.0, 55.2, 54.7, 0.01, -0.002, 0.0, 0.0, 4e-4, -3e-4)


def pose(x: float, y: float = 0.0, z: float = 0.0, turn_rad: float = 0.0) -> np.ndarray:
    """Turned about the axis that points down."""
    found = np.eye(4)
    found[0, [0, 2]] = math.cos(turn_rad), math.sin(turn_rad)
    found[2, [0, 2]] = -math.sin(turn_rad), math.cos(turn_rad)
    found[:3, 3] = x, y, z
    return found


def texture(points: np.ndarray, lengths_m: tuple[float, float]) -> np.ndarray:
    """Grey levels of points in the world: waves in all directions."""
    rng = np.random.default_rng(7)
    waves = rng.standard_normal((40, 3))
    waves *= (2 * np.pi / rng.uniform(*lengths_m, 40) / np.linalg.norm(waves, axis=1))[:, None]
    return 120 + 15 * np.sin(points @ waves.T + rng.uniform(0, 6, 40)).sum(-1)


def in_ball(camera: Camera, to_world: np.ndarray, theta_max_rad: float = THETA_MAX_RAD) -> tuple[View, np.ndarray]:
    """A view inside a textured ball, and its true distances."""
    found = rays(camera, theta_max_rad)
    world, centre = found.directions.astype(np.float64) @ to_world[:3, :3].T, to_world[:3, 3]
    along = world @ centre
    distance = -along + np.sqrt(along**2 + RADIUS_M**2 - centre @ centre)
    grey = np.rint(texture(centre + distance[..., None] * world, (1.2, 3.0))).astype(np.float32)
    return View(np.where(found.within, grey, np.float32(np.nan)), camera, to_world, theta_max_rad), distance
