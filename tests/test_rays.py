"""The rays of a lens's pixels, against formulas written out again."""

import math

import numpy as np
import pytest

from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.rays import KEPT, rays

PINHOLE = Pinhole(40, 30, 25.0, 26.0, 19.0, 14.5)
EQUIDISTANT = KannalaBrandt(64, 48, 15.0, 15.0, 32.5, 24.5, 0.0, 0.0, 0.0, 0.0)
"""θ of a pixel is its distance from the principal point, over the focal length."""
FOLDS_BACK = MEI(60, 60, 20.0, 20.0, 30.0, 30.0, 1.5, 0.0, 0.0, 0.0, 0.0)
"""Its lens circle lies within the picture."""


def off_axis(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return x - camera.cx, y - camera.cy


def test_a_pinholes_rays():
    x, y = off_axis(PINHOLE)
    expected = np.stack([x / PINHOLE.fx, y / PINHOLE.fy, np.ones_like(x)], -1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    found = rays(PINHOLE)
    assert found.directions.dtype == np.float32 and found.within.all()
    assert np.abs(found.directions - expected).max() < 2e-7
    assert np.array_equal(found.cos_theta, found.directions[..., 2])


def test_a_fisheyes_rays_end_at_the_limit():
    x, y = off_axis(EQUIDISTANT)
    theta, azimuth = np.hypot(x, y) / 15.0, np.arctan2(y, x)
    sine = np.sin(theta)
    expected = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(theta)], -1)
    limit = math.radians(100.0)
    found = rays(EQUIDISTANT, limit)
    assert np.array_equal(found.within, theta <= limit) and 0 < found.within.mean() < 1
    assert np.abs(found.directions - expected)[found.within].max() < 2e-7
    assert (found.directions[~found.within] == 0).all()


@pytest.mark.parametrize(("past", "inside"), [(-1e-10, False), (1e-10, True)])
def test_the_rim_is_decided_before_anything_is_rounded(past, inside):
    """A limit 10⁻¹⁰ rad short of a pixel's ray leaves it out: single precision could not tell."""
    row, column = 24, 60  # on the axis's row, 28 px to the right
    theta = (column + 0.5 - 32.5) / 15.0
    assert np.float32(math.cos(theta)) == np.float32(math.cos(theta + past))
    assert bool(rays(EQUIDISTANT, theta + past).within[row, column]) is inside


def test_outside_the_lens_circle_there_is_no_ray():
    x, y = off_axis(FOLDS_BACK)
    found = rays(FOLDS_BACK)
    assert np.array_equal(found.within, np.hypot(x, y) < 20 / math.sqrt(1.5**2 - 1)) and 0.2 < found.within.mean() < 0.4
    assert not found.directions[~found.within].any()
    # a unit ray's x and y over z + ξ, times the focal length, is its pixel
    ray = found.directions[found.within].astype(np.float64)
    pixels = 20 * ray[:, :2] / (ray[:, 2:] + 1.5)
    assert np.abs(pixels - np.stack([x, y], -1)[found.within]).max() < 1e-4


def test_they_are_kept_and_nobody_writes_into_them():
    found = rays(EQUIDISTANT, 1.0)
    assert rays(KannalaBrandt(64, 48, 15.0, 15.0, 32.5, 24.5, 0.0, 0.0, 0.0, 0.0), 1.0) is found
    assert rays(EQUIDISTANT, 1.1) is not found
    for array in (found.directions, found.within):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1
    for number in range(KEPT):
        rays(PINHOLE.downscaled(2 + number % 4), 0.5 + number / 100)
    assert rays.cache_info().currsize == KEPT
    assert rays(EQUIDISTANT, 1.0) is not found
