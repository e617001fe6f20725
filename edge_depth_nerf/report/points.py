"""A drive's LiDAR points and cameras in a small form for the page's view in 3D."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from edge_depth_nerf.base.pictures import DISTANCE
from edge_depth_nerf.scene.reader import SceneFolder

MOST_POINTS = 40_000
"""Most points of a page, over all its drives. The page has 12 bytes for each."""
NEAR_M = 40.0
"""Points farther than this from all cameras are left out, in scenes whose lengths are metres."""
STEPS = 65535
"""Number of steps that each axis is divided into."""


def show_points(scene: SceneFolder, most: int = MOST_POINTS) -> dict[str, Any] | None:
    """Choose points of a scene at random; None for a scene without points.

    Returns:
        What the page's script takes. Lengths are metres in the scene, x and y level, z up. `low`: the lowest corner of
        the points; `step`: the length of a step along each axis; `steps`: places in steps from there, uint16, and
        `colours`: RGB from the pictures, or by height if the cloud has none, uint8, N×3 in base64. `paths`: places of
        each camera's pictures, in order; `training`, `heldOut`: of those; `forward`: the direction from the first
        camera's first place to its last, or its viewing direction if it did not move.

    Raises:
        InputError: the point cloud cannot be read.
    """
    cloud = scene.cloud()
    if cloud is None:
        return None
    points_m, colours = cloud
    cameras = [np.array([picture.position_m for picture in pictures]) for pictures in scene.cameras().values()]
    if scene.own:
        near = KDTree(np.concatenate(cameras)).query(points_m, distance_upper_bound=NEAR_M)[0] <= NEAR_M
        points_m, colours = points_m[near], None if colours is None else colours[near]
    if not len(points_m):
        return None
    chosen = np.random.default_rng(0).permutation(len(points_m))[:most]
    points_m = points_m[chosen]
    if colours is None:
        low, high = np.percentile(points_m[:, 2], (2, 98))
        place = np.clip((points_m[:, 2] - low) / max(high - low, 1e-6), 0, 1)
        shown = DISTANCE.colours[np.rint(255 * (1 - place)).astype(int)]
    else:
        shown = colours[chosen]
    low_m = points_m.min(0)
    step_m = np.maximum((points_m.max(0) - low_m) / STEPS, 1e-9)
    places_m = np.array([picture.position_m for picture in scene.pictures])
    held_out = np.array([picture.held_out for picture in scene.pictures])
    first = next(iter(scene.cameras().values()))
    forward = cameras[0][-1] - cameras[0][0]
    if np.linalg.norm(forward[:2]) < 0.1:
        forward = first[0].looks_along
    steps = np.rint((points_m - low_m) / step_m).clip(0, STEPS).astype("<u2")
    return {
        "low": low_m.tolist(),
        "step": step_m.tolist(),
        "steps": base64.b64encode(steps.tobytes()).decode(),
        "colours": base64.b64encode(shown.tobytes()).decode(),
        "paths": [np.round(path, 2).tolist() for path in cameras],
        "training": np.round(places_m[~held_out], 2).tolist(),
        "heldOut": np.round(places_m[held_out], 2).tolist(),
        "forward": np.round(forward / np.linalg.norm(forward), 3).tolist(),
    }
