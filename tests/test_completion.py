from __future__ import annotations

import cv2
import numpy as np
import pytest

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.mono import completion
from edge_depth_nerf.mono.completion import CompletionOptions, complete

SHAPE = (60, 80)
Image = np.ndarray

needs_contrib = pytest.mark.skipif(not completion.available(), reason="this OpenCV has no contrib modules")


def slanted() -> tuple[Image, Image, Image, Image, Image, Image]:
    """Picture, LiDAR, mono, its sigma, valid, truth: two colours, mono 20 % too near left, 10 % too far right."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    truth = (8 + 0.2 * y + np.where(x < 40, 0, 15)).astype(np.float32)
    picture = np.where((x < 40)[..., None], [200, 90, 30], [40, 90, 160]).astype(np.uint8)
    mono = (truth * np.where(x < 40, 0.8, 1.1)).astype(np.float32)
    lidar = np.where(rng.random(SHAPE) < 0.03, truth, 0).astype(np.float32)
    return picture, lidar, mono, 0.15 * mono, np.ones(SHAPE, bool), truth


@needs_contrib
def test_carries_the_error_to_the_edge_of_the_surface():
    picture, lidar, mono, sigma, valid, truth = slanted()
    result = complete(picture, lidar, mono, sigma, valid)
    assert result.dtype == np.float32
    relative = np.abs(result / truth - 1)
    # mono is wrong by 10 and 20 %; what is left beside returns is the part that mono is believed
    assert relative.mean() < 0.03
    near_edge = relative[:, 38:42]
    assert near_edge.mean() < 0.03 and near_edge.max() < 0.1


@needs_contrib
def test_without_returns_mono_stays():
    picture, lidar, mono, sigma, valid, _ = slanted()
    np.testing.assert_allclose(complete(picture, 0 * lidar, mono, sigma, valid), mono, rtol=1e-6)


@needs_contrib
def test_confidence_decides():
    picture, lidar, mono, sigma, valid, truth = slanted()

    def error(lidar_sigma_m: float, mono_sigma_m: np.ndarray) -> float:
        options = CompletionOptions(lidar_sigma_m=lidar_sigma_m)
        return float(np.abs(complete(picture, lidar, mono, mono_sigma_m, valid, options) / truth - 1).mean())

    sure_of_lidar, usual, sure_of_mono = error(0.05, 3 * sigma), error(0.05, sigma), error(0.05, 0.03 * sigma)
    assert sure_of_lidar < usual < sure_of_mono
    assert error(1.0, sigma) > usual


@needs_contrib
def test_what_is_not_valid_gives_nothing_and_gets_nothing():
    picture, lidar, mono, sigma, valid, _ = slanted()
    valid[20:30, 20:30] = False
    mono[40, 50] = 0
    expected = complete(picture, lidar, mono, sigma, valid)
    assert (expected[20:30, 20:30] == 0).all() and expected[40, 50] == 0
    assert (expected > 0).sum() == valid.sum() - 1
    for rubbish in (np.nan, np.inf, -5.0, 1e4):
        bad_lidar, bad_mono, bad_sigma = (np.where(valid, i, rubbish).astype(np.float32) for i in (lidar, mono, sigma))
        np.testing.assert_array_equal(complete(picture, bad_lidar, bad_mono, bad_sigma, valid), expected)
    for rubbish in (np.nan, np.inf, -5.0):
        mono[40, 50] = rubbish
        np.testing.assert_array_equal(complete(picture, lidar, mono, sigma, valid), expected)


@needs_contrib
def test_bad_input(unchecked_types):
    picture, lidar, mono, sigma, valid, _ = slanted()
    with pytest.raises(InputError, match=r"complete: found .*mono_m \(60, 79\).*expected one height"):
        complete(picture, lidar, mono[:, 1:], sigma, valid)
    sigma[3, 4] = np.nan
    with pytest.raises(InputError, match="mono_sigma_m has values that are not finite"):
        complete(picture, lidar, mono, sigma, valid)


def test_opencv_without_contrib_is_named(monkeypatch):
    picture, lidar, mono, sigma, valid, _ = slanted()
    monkeypatch.delattr(cv2, "ximgproc", raising=False)
    assert not completion.available()
    with pytest.raises(InputError, match=r"needs OpenCV's contrib modules \(cv2.ximgproc\).*pip install"):
        complete(picture, lidar, mono, sigma, valid)
