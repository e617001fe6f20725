"""Poses by angles, and the similarity between two sets of points, for poses that have a world of their own."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def pose(turn_deg: Sequence[float], position_m: Sequence[float]) -> NDArray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    found[:3, 3] = position_m
    return found


def umeyama(points: NDArray, truth: NDArray) -> tuple[float, NDArray]:
    """Lay N×3 points over the true ones (Umeyama, PAMI 1991): the factor that takes, and the distances that stay."""
    source, goal = points - points.mean(0), truth - truth.mean(0)
    left, values, right = np.linalg.svd(goal.T @ source)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = float(np.trace(np.diag(values) @ flip) / (source**2).sum())
    return scale, np.linalg.norm(scale * source @ (left @ flip @ right).T - goal, axis=-1)
