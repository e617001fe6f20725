"""A stand-in for a monocular depth network: the true distances with the faults such a network has.

Arrays are H×W, distances in metres along the ray, 0 = none. The faults: a scale error of some 10 % that varies
smoothly over the picture and from frame to frame; edges blurred over a few pixels, so that distances between the
front and the back appear and thin things fade into what is behind; a sky at a finite distance.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

SCALE_ERROR = 0.10
"""Standard deviation of the logarithm of the scale error, over pixels and frames."""

_BLUR_SHARE = 0.004
_SKY_M = 70.0
_KEYFRAME_INTERVAL = 10
_GRID = 5
# a whole frame's error, the part that stays with the camera, and the part that comes and goes
_PARTS = (0.5, 0.5, 0.7071)


def _smooth_field(rng: Generator, height: int, width: int) -> NDArray[np.float32]:
    """Smooth noise of unit variance at the knots."""
    knots = rng.standard_normal((_GRID, _GRID)).astype(np.float32)
    return np.asarray(cv2.resize(knots, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def simulated_estimate(
    distance_m: NDArray[np.float32],
    own_car_m: NDArray[np.float32],
    lens: NDArray[np.bool_],
    frame: int,
    seed: int,
    camera: int,
) -> NDArray[np.float32]:
    """Turn a true distance map into an estimate with realistic faults.

    Args:
        distance_m: true distances, 0 = sky, own car or outside the lens.
        own_car_m: distances of the own car, which a network sees as well; 0 elsewhere.
        lens: True inside the lens circle; outside there is no estimate.
        frame: the frame's index; errors change smoothly with it.
        seed: of the drive.
        camera: number of the camera.

    Returns:
        Estimated distances, 0 outside the lens.

    """
    height, width = distance_m.shape
    whole = np.where(distance_m > 0, distance_m, own_car_m)
    log = np.log(np.where(whole > 0, np.minimum(whole, 250.0), _SKY_M)).astype(np.float32)
    # the blur must not draw in what lies outside the lens: normalised by the blurred lens
    sigma = max(0.6, _BLUR_SHARE * width)
    weight = cv2.GaussianBlur(lens.astype(np.float32), (0, 0), sigma)
    log = cv2.GaussianBlur(np.where(lens, log, 0), (0, 0), sigma) / np.maximum(weight, 1e-6)

    def fields(number: int) -> tuple[float, NDArray[np.float32]]:
        rng = np.random.default_rng([seed, 40, camera, number])
        return float(rng.standard_normal()), _smooth_field(rng, height, width)

    position = frame / _KEYFRAME_INTERVAL
    first = int(position)
    # both weights on a circle, so that the variance stays the same in between
    angle = (position - first) * np.pi / 2
    (scale_a, field_a), (scale_b, field_b) = fields(first), fields(first + 1)
    scale = np.cos(angle) * scale_a + np.sin(angle) * scale_b
    changing = np.cos(angle) * field_a + np.sin(angle) * field_b
    lasting = _smooth_field(np.random.default_rng([seed, 41, camera]), height, width)
    error = _PARTS[0] * scale + _PARTS[1] * lasting + _PARTS[2] * changing
    return np.where(lens, np.exp(log + SCALE_ERROR * error), 0).astype(np.float32)
