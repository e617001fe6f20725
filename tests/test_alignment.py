"""Alignment of monocular maps to LiDAR, on maps made by formula."""

from typing import Any

import numpy as np
import pytest

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method.alignment import LEAST_POINTS, Fit, align, fit_logs

SHAPE = (120, 160)
EVERYWHERE = np.ones(SHAPE, bool)


def smooth_truth(shape=SHAPE):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (10 + 5 * np.sin(x / 25) + y / 12).astype(np.float32)


def some_points(truth, share=0.1, seed=0):
    return np.where(np.random.default_rng(seed).random(truth.shape) < share, truth, 0).astype(np.float32)


def relative_error(estimate, truth, where: Any = ...):
    return float(np.mean(np.abs(estimate / truth - 1)[where]))


@pytest.mark.parametrize("mode", ["global", "local"])
def test_scale_and_exponent_are_found_among_outliers(mode):
    truth = smooth_truth()
    # d = e^0.2 · m^1.3
    mono = ((truth / np.exp(0.2)) ** (1 / 1.3)).astype(np.float32)
    lidar = some_points(truth)
    rng = np.random.default_rng(1)
    wrong = (lidar > 0) & (rng.random(SHAPE) < 0.2)
    lidar[wrong] *= rng.uniform(1.5, 4, wrong.sum())
    aligned = align(lidar, mono, EVERYWHERE, mode)
    assert aligned.fit_of == "frame"
    assert aligned.lidar_points == (lidar > 0).sum()
    assert aligned.fit.log_scale == pytest.approx(0.2, abs=0.01)
    assert aligned.fit.exponent == pytest.approx(1.3, abs=0.01)
    # plain least squares would be a tenth off
    assert relative_error(aligned.mono_m, truth) < (0.002 if mode == "global" else 0.02)


def test_one_distance_says_nothing_about_the_exponent():
    fit = fit_logs(np.full(100, 6.0) + np.linspace(-0.01, 0.01, 100), np.full(100, 5.0))
    assert fit.exponent == pytest.approx(1, abs=1e-6)
    assert float(fit.apply(np.array([[5.0]], np.float32))[0, 0]) == pytest.approx(6, rel=1e-3)


def test_beyond_the_points_the_curve_goes_on_as_a_factor():
    mono_m = np.geomspace(4, 20, 400)
    fit = fit_logs(1.1 * mono_m**1.2, mono_m)
    assert np.exp([fit.least_log, fit.largest_log]) == pytest.approx([4, 20], rel=0.05)
    ends_m = np.exp([[fit.least_log, fit.largest_log]]).astype(np.float32)
    factors = (fit.apply(ends_m) / ends_m)[0]
    assert factors == pytest.approx(1.1 * ends_m[0] ** 0.2, rel=1e-3)
    beyond_m = np.array([[0.5, 2.0, 30.0, 60.0]], np.float32)
    assert fit.apply(beyond_m)[0] == pytest.approx(beyond_m[0] * factors[[0, 0, 1, 1]], rel=1e-5)
    # nothing is torn where it ends
    step_m = (ends_m.T * [0.999, 1.001]).astype(np.float32)
    assert np.diff(np.log(fit.apply(step_m)), axis=1) == pytest.approx(np.full((2, 1), 0.0022), abs=3e-4)


def test_a_smooth_error_is_taken_away_near_points_and_left_far_from_them():
    truth = smooth_truth((240, 480))
    x = np.arange(480)
    # waves, which no curve of the whole picture can take away; returns in the left half alone
    mono = (truth * np.exp(0.15 * np.sin(x * 2 * np.pi / 120))).astype(np.float32)
    lidar = some_points(truth, 0.3)
    lidar[:, 240:] = 0
    everywhere = np.ones(truth.shape, bool)
    whole = align(lidar, mono, everywhere, "global")
    local = align(lidar, mono, everywhere, "local")
    inside = np.s_[:, 5:235]
    assert relative_error(whole.mono_m, truth, inside) > 0.05
    assert relative_error(local.mono_m, truth, inside) < 0.25 * relative_error(whole.mono_m, truth, inside)
    # the coarsest cells are 88 px wide: two of them on, nothing is left of the correction
    np.testing.assert_allclose(local.mono_m[:, 420:], whole.mono_m[:, 420:], rtol=1e-6)
    assert local.fit == whole.fit


def test_a_correction_does_not_cross_an_edge():
    """A car at 5 m before a wall at 20 m: the car's map is a fifth too far, the wall's is right."""
    truth = np.full(SHAPE, 20, np.float32)
    truth[40:80, 60:100] = 5
    mono = truth.copy()
    mono[40:80, 60:100] *= 1.2
    aligned = align(some_points(truth, 0.2), mono, EVERYWHERE, "local").mono_m
    assert relative_error(aligned, truth, np.s_[40:80, 60:100]) < 0.01
    assert relative_error(aligned, truth, np.s_[30:40, 50:110]) < 0.01
    # also where the wall has no return of its own
    lidar = some_points(truth, 0.2)
    lidar[truth > 10] = 0
    lidar[:20] = some_points(truth, 0.2)[:20]
    before = align(lidar, mono, EVERYWHERE, "global").mono_m
    after = align(lidar, mono, EVERYWHERE, "local").mono_m
    beside = np.s_[40:80, 102:112]
    assert np.abs(np.log(after[beside] / before[beside])).max() < 0.25 * np.abs(np.log(before[60, 80] / 5))


def test_few_points_take_the_drives_fit():
    truth = smooth_truth()
    mono = (truth * 2).astype(np.float32)
    lidar = np.zeros(SHAPE, np.float32)
    lidar.flat[: LEAST_POINTS - 1] = 3  # would pull the map anywhere
    drive = Fit(float(np.log(0.5)), 1.0)
    aligned = align(lidar, mono, EVERYWHERE, "local", drive)
    assert (aligned.fit_of, aligned.lidar_points, aligned.fit) == ("drive", LEAST_POINTS - 1, drive)
    np.testing.assert_allclose(aligned.mono_m, truth, rtol=1e-5)
    # without one the map stays as it is
    alone = align(lidar, mono, EVERYWHERE, "local")
    assert alone.fit_of == "none"
    np.testing.assert_array_equal(alone.mono_m, mono)
    lidar.flat[LEAST_POINTS - 1] = 3
    assert align(lidar, mono, EVERYWHERE, "local", drive).fit_of == "frame"


def test_no_alignment_leaves_the_map():
    mono = smooth_truth()
    mono[0, :3] = np.nan, np.inf, -1
    aligned = align(some_points(smooth_truth() * 2), mono, EVERYWHERE, "none")
    assert aligned.fit_of == "none"
    assert aligned.mono_m[0, :3].tolist() == [0, 0, 0]
    np.testing.assert_array_equal(aligned.mono_m[1:], mono[1:])


@pytest.mark.parametrize("mode", ["global", "local"])
def test_what_is_no_distance_gives_and_gets_nothing(mode):
    truth = smooth_truth()
    mono, lidar = (truth * 1.2).astype(np.float32), some_points(truth)
    expected = align(np.where(np.arange(SHAPE[1]) < 100, lidar, 0).astype(np.float32), mono, EVERYWHERE, mode)
    # beyond column 100: nonsense in LiDAR that the mask excludes
    outside = lidar.copy()
    outside[:, 100:] = 77
    usable = np.broadcast_to(np.arange(SHAPE[1]) < 100, SHAPE)
    found = align(outside, mono, usable, mode)
    np.testing.assert_allclose(found.mono_m[:, :70], expected.mono_m[:, :70], rtol=1e-3)
    assert found.lidar_points == expected.lidar_points
    broken_mono, broken_lidar = mono.copy(), lidar.copy()
    broken_mono[50:60, 50:60] = np.nan
    broken_mono[60:65, 50:60] = 0
    broken_lidar[10:20, 10:20] = np.nan
    aligned = align(broken_lidar, broken_mono, EVERYWHERE, mode).mono_m
    assert np.isfinite(aligned).all()
    assert (aligned[50:65, 50:60] == 0).all()
    np.testing.assert_allclose(np.delete(aligned, np.s_[45:70], 0), np.delete(truth, np.s_[45:70], 0), rtol=0.01)


@pytest.mark.parametrize("mode", ["none", "global", "local"])
def test_a_map_of_nothing(mode):
    nothing = np.zeros(SHAPE, np.float32)
    assert not align(some_points(smooth_truth()), nothing, EVERYWHERE, mode, Fit(0.1, 1.0)).mono_m.any()
    assert not align(nothing, np.full(SHAPE, np.nan, np.float32), EVERYWHERE, mode).mono_m.any()


def test_maps_of_different_sizes(unchecked_types):
    mono = smooth_truth()
    with pytest.raises(InputError, match=r"lidar_m \(120, 159\), mono_m \(120, 160\)"):
        align(mono[:, 1:], mono, EVERYWHERE)
    with pytest.raises(InputError, match="align is 'much'"):
        align(mono, mono, EVERYWHERE, "much")  # pyrefly: ignore[bad-argument-type]
