"""The similarity between two sets of points, for evaluating poses that have a world of their own."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def umeyama(points: NDArray, truth: NDArray) -> tuple[float, NDArray]:
    """Lay N×3 points over the true ones (Umeyama, PAMI 1991): the factor that takes, and the distances that stay."""
    source, goal = points - points.mean(0), truth - truth.mean(0)
    left, values, right = np.linalg.svd(goal.T @ source)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    scale = float(np.trace(np.diag(values) @ flip) / (source**2).sum())
    return scale, np.linalg.norm(scale * source @ (left @ flip @ right).T - goal, axis=-1)
