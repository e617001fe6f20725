import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.method import prior as prior_module
from edge_depth_nerf.method.alignment import Fit
from edge_depth_nerf.method.error_model import (
    KNOTS,
    MOTION_KNOTS,
    BeyondField,
    Calibration,
    ErrorModel,
    MotionCalibration,
)
from edge_depth_nerf.method.integration import IntegrationOptions, integrate_depth
from edge_depth_nerf.method.prior import (
    MotionMap,
    PriorCache,
    PriorOptions,
    RayAngles,
    integrate_frame,
    make_prior,
    ray_angles,
    sky_of,
)


def both(lidar: np.ndarray, mono: np.ndarray) -> dict[str, np.ndarray]:
    """The maps of a picture by source."""
    return {"lidar": lidar, "mono": mono}


def maps(height=12, width=10, seed=2):
    rng = np.random.default_rng(seed)
    mono = (5 + rng.random((height, width))).astype(np.float32)
    lidar = np.where(rng.random((height, width)) < 0.3, mono * 1.05, 0).astype(np.float32)
    mask = rng.random((height, width)) < 0.8
    return lidar, mono, mask


def test_a_prior_is_where_the_mask_is():
    lidar, mono, mask = maps()
    prior = make_prior(both(lidar, mono), mask, "integrated", PriorOptions())
    assert np.array_equal(prior.distance_m > 0, mask)
    assert np.array_equal(prior.sigma_m > 0, mask)
    assert (prior.distance_m[mask] > 4.9).all() and (prior.distance_m[mask] < 6.4).all()


def test_lidar_alone_is_lidar_and_mono_alone_is_mono():
    lidar, mono, mask = maps()
    only_lidar = make_prior({"lidar": lidar}, mask, "lidar", PriorOptions())
    assert np.array_equal(only_lidar.distance_m, lidar * mask)
    assert np.allclose(only_lidar.sigma_m[only_lidar.distance_m > 0], 0.05)
    only_mono = make_prior({"mono": mono}, mask, "mono", PriorOptions())
    assert np.array_equal(only_mono.distance_m, mono * mask)
    # a tenth of the distance and 5 cm: sqrt((0.1 * 5.5)^2 + 0.05^2) = 0.552 for 5.5 m
    assert np.allclose(only_mono.sigma_m[mask], np.sqrt((0.1 * mono[mask]) ** 2 + 0.05**2))


def test_the_cache_gives_what_was_made_and_does_not_make_it_again(tmp_path, monkeypatch):
    lidar, mono, mask = maps()
    cache = PriorCache(tmp_path / "cache", "integrated", PriorOptions())
    first = cache.prior(both(lidar, mono), mask)
    (file,) = (tmp_path / "cache").iterdir()
    monkeypatch.setattr(prior_module, "make_prior", lambda *_: pytest.fail("made again"))
    second = PriorCache(tmp_path / "cache", "integrated", PriorOptions()).prior(both(lidar, mono), mask)
    assert np.array_equal(first.distance_m, second.distance_m)
    assert np.array_equal(first.sigma_m, second.sigma_m)
    assert file.suffix == ".npz"


@pytest.mark.parametrize("change", ["lidar", "mono", "mask", "options"])
def test_whatever_changes_makes_another_file(tmp_path, change):
    lidar, mono, mask = maps()
    options = PriorOptions()
    PriorCache(tmp_path, "integrated", options).prior(both(lidar, mono), mask)
    if change == "options":
        options = dataclasses.replace(options, integration=IntegrationOptions(alpha=0.6))
    else:
        changed = {"lidar": lidar, "mono": mono, "mask": mask}[change]
        changed[3, 4] = not changed[3, 4] if change == "mask" else changed[3, 4] + 1
    again = PriorCache(tmp_path, "integrated", options).prior(both(lidar, mono), mask)
    assert len(list(tmp_path.iterdir())) == 2
    assert np.array_equal(again.distance_m, make_prior(both(lidar, mono), mask, "integrated", options).distance_m)


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    lidar, mono, mask = maps()
    prior = PriorCache(tmp_path / "file" / "cache", "integrated", PriorOptions()).prior(both(lidar, mono), mask)
    assert (prior.distance_m > 0).any()


def a_calibration(**changes):
    """Sigma is 1 % of the distance at a return, 10 % elsewhere."""
    flat = {name: [0.0] * len(knots) for name, knots in KNOTS.items()}
    models = {
        name: ErrorModel(float(np.log(part)), flat) for name, part in (("error_model", 0.1), ("return_model", 0.01))
    }
    fields: dict[str, Any] = {"made_of": "", "field_rad": (-1.0, 1.0), "everywhere": False, "drive_fit": None, **models}
    return Calibration(**fields | changes)


def level_view(shape):
    return RayAngles(np.zeros(shape, np.float32), np.zeros(shape, np.float32))


def test_a_calibrated_prior_is_aligned_and_trusted_by_the_models():
    lidar, mono, mask = maps(60, 50)
    lidar = np.where(lidar > 0, mono * 1.5, 0).astype(np.float32)
    prior = make_prior(both(lidar, mono), mask, "integrated", PriorOptions(), a_calibration(), level_view(mask.shape))
    lidar_points = mask & (lidar > 0)
    np.testing.assert_array_equal(prior.distance_m[lidar_points], lidar[lidar_points])
    elsewhere = mask & ~lidar_points
    # mono was half too near; window averages of values that lie within 1 m
    assert np.abs(prior.distance_m[elsewhere] - 1.5 * mono[elsewhere]).max() < 1.5
    assert np.mean(prior.distance_m[elsewhere]) == pytest.approx(1.5 * np.mean(mono[elsewhere]), rel=0.02)
    np.testing.assert_allclose(prior.sigma_m[lidar_points], 0.01 * lidar[lidar_points], rtol=1e-5)
    np.testing.assert_allclose(prior.sigma_m[elsewhere], 0.1 * prior.distance_m[elsewhere], rtol=1e-5)


@pytest.mark.parametrize("sigma_mode", ["calibrated", "combined"])
def test_a_frame_with_few_points_takes_the_drives_fit(sigma_mode):
    _, mono, mask = maps(60, 50)
    lidar = np.zeros_like(mono)
    lidar[3, 3:20] = 1
    calibration = a_calibration(drive_fit=Fit(float(np.log(3)), 1.0))
    options = PriorOptions(sigma_mode=sigma_mode)
    prior = make_prior(both(lidar, mono), mask, "integrated", options, calibration, level_view(mask.shape))
    assert np.mean(prior.distance_m[20:][mask[20:]]) == pytest.approx(3 * np.mean(mono[20:][mask[20:]]), rel=0.01)


def test_without_alignment_and_calibration_it_is_the_literal_form():
    lidar, mono, mask = maps()
    ramp = np.arange(mask.size, dtype=np.float32).reshape(mask.shape) / 4
    mono, lidar = mono + ramp, np.where(lidar > 0, lidar + ramp, 0).astype(np.float32)
    options = PriorOptions("none", "constant", sigma_constant_m=0.3, integration=IntegrationOptions())
    assert not options.wants_calibration("integrated")
    literal = make_prior(both(lidar, mono), mask, "integrated", options)
    expected = integrate_depth(torch.from_numpy(lidar), torch.from_numpy(mono), torch.from_numpy(mask))
    np.testing.assert_array_equal(literal.distance_m, expected.distance_m.numpy())
    np.testing.assert_array_equal(literal.sigma_m, np.where(literal.distance_m > 0, np.float32(0.3), 0))


def test_mono_alone_never_sees_lidar():
    lidar, mono, mask = maps(60, 50)
    calibration, view = a_calibration(return_model=None), level_view(mask.shape)
    prior = make_prior(both(lidar * 2, mono), mask, "mono", PriorOptions(), calibration, view)
    np.testing.assert_array_equal(prior.distance_m, mono * mask)
    np.testing.assert_allclose(prior.sigma_m[mask], 0.1 * mono[mask], rtol=1e-5)


def test_another_calibration_makes_another_file(tmp_path):
    lidar, mono, mask = maps()
    view = level_view(mask.shape)
    first = PriorCache(tmp_path, "integrated", PriorOptions(), a_calibration()).prior(both(lidar, mono), mask, view)
    second = PriorCache(tmp_path, "integrated", PriorOptions(), a_calibration(error_model=None)).prior(
        both(lidar, mono), mask, view
    )
    assert len(list(tmp_path.iterdir())) == 2
    assert not np.array_equal(first.sigma_m, second.sigma_m)
    turned = RayAngles(view.theta_rad, view.elevation_rad + 2)
    assert (
        not PriorCache(tmp_path, "integrated", PriorOptions(), a_calibration())
        .prior(both(lidar, mono), mask, turned)
        .distance_m.any()
    )


def test_the_angles_of_a_picture():
    camera = KannalaBrandt(41, 41, 12.0, 12.0, 20.5, 20.5, 0.0, 0.0, 0.0, 0.0)
    # upright: up is -y of the camera
    view = ray_angles(camera, np.array([0.0, -1.0, 0.0]))
    assert view.theta_rad[20, 20] == pytest.approx(0, abs=1e-3)
    assert view.theta_rad[20, 32] == pytest.approx(1.0, abs=1e-4)
    assert view.elevation_rad[8, 20] == pytest.approx(1.0, abs=1e-4)
    assert view.elevation_rad[32, 20] == pytest.approx(-1.0, abs=1e-4)
    # rolled by 90 degrees: up is +x
    assert ray_angles(camera, np.array([1.0, 0.0, 0.0])).elevation_rad[20, 32] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("fields", [{"align": "much"}, {"sigma_mode": "magic"}])
def test_an_unknown_choice(fields, unchecked_types):
    with pytest.raises(InputError, match="expected one of"):
        PriorOptions(**fields)


def test_a_mono_map_of_another_size(unchecked_types):
    lidar, mono, mask = maps()
    with pytest.raises(InputError, match=r"mono_m \(11, 10\)"):
        make_prior(both(lidar, mono[1:]), mask, "integrated", PriorOptions())


def test_sky_is_above_the_horizon_without_any_distance():
    mono = np.array([[0, 0, 30], [0, np.nan, 30], [0, 0, 30]], np.float32)
    lidar = np.array([[0, 40, 0], [0, 0, 0], [0, 0, 0]], np.float32)
    elevation = np.radians([[20.0] * 3, [20.0] * 3, [1.0] * 3]).astype(np.float32)
    view = RayAngles(np.zeros((3, 3), np.float32), elevation)
    picture, mask = np.full((3, 3, 3), 200, np.uint8), np.ones((3, 3), bool)
    assert sky_of(mono, lidar, view, picture, mask).tolist() == [[True, False, False], [True, True, False], [False] * 3]
    assert sky_of(mono, None, view, picture, mask)[0].tolist() == [True, True, False]
    mask[1, 1] = False
    assert sky_of(mono, lidar, view, picture, mask)[1].tolist() == [True, False, False]


def test_dark_holes_of_a_map_are_no_sky():
    """A map of stereo matching: the sky, crowns without a match, and what one of the two eyes alone sees."""
    mono = np.full((40, 60), 8, np.float32)
    picture = np.full((40, 60, 3), 60, np.uint8)
    elevation = np.radians(np.linspace(19.5, -19.5, 40, dtype=np.float32))[:, None].repeat(60, 1)
    view = RayAngles(np.zeros((40, 60), np.float32), elevation)
    sky, crown, border = np.s_[:12, 20:40], np.s_[3:9, 45:55], np.s_[:, :6]
    for hole in (sky, crown, border):
        mono[hole] = 0
    picture[sky] = 230
    picture[4, 24] = 20  # a bird
    expected = np.zeros((40, 60), bool)
    expected[sky] = True
    assert np.array_equal(sky_of(mono, None, view, picture, np.ones_like(expected)), expected)


# ---- distances from motion -------------------------------------------------------------------------------------


def motion_calibration(weight: float = 0.9) -> MotionCalibration:
    """Sigma is 3 % of the distance."""
    flat = {name: [0.0] * len(knots) for name, knots in KNOTS.items()}
    return MotionCalibration(weight, 0.01, 0.03, ErrorModel(float(np.log(0.03)), flat))


def field_view(shape):
    """From 57° above the horizon to 57° below; LiDAR's field, 3° wider, ends in the middle."""
    elevation = np.broadcast_to(np.linspace(1, -1, shape[0], dtype=np.float32)[:, None], shape).copy()
    return RayAngles(np.zeros(shape, np.float32), elevation), elevation <= np.radians(3)


def test_above_lidars_field_there_is_a_prior_where_motion_gives_one():
    lidar, mono, mask = maps(60, 50)
    view, in_field = field_view(mask.shape)
    lidar = np.where(in_field, lidar, 0).astype(np.float32)
    motion = np.where(np.random.default_rng(6).random(mask.shape) < 0.5, np.float32(7), 0).astype(np.float32)
    calibration = a_calibration(field_rad=(-1.0, 0.0), motion=motion_calibration())
    prior = make_prior({**both(lidar, mono), "motion": motion}, mask, "integrated", PriorOptions(), calibration, view)
    np.testing.assert_array_equal((prior.distance_m > 0)[~in_field], (mask & (motion > 0))[~in_field])
    np.testing.assert_array_equal((prior.distance_m > 0)[in_field], mask[in_field])
    above = ~in_field & (prior.distance_m > 0)
    # what mono says there does not count
    far_up = above & (view.elevation_rad > 0.3)
    np.testing.assert_allclose(prior.distance_m[far_up], 7, rtol=1e-5)
    np.testing.assert_allclose(prior.sigma_m[above], 0.03 * prior.distance_m[above], rtol=1e-5)
    lidar_points = mask & (lidar > 0)
    np.testing.assert_array_equal(prior.distance_m[lidar_points], lidar[lidar_points])
    np.testing.assert_allclose(prior.sigma_m[lidar_points], 0.01 * lidar[lidar_points], rtol=1e-5)
    mono_alone = mask & in_field & ~lidar_points & (motion == 0)
    np.testing.assert_allclose(prior.sigma_m[mono_alone], 0.1 * prior.distance_m[mono_alone], rtol=1e-5)


def test_a_lidar_point_keeps_its_distance_and_its_error_beside_motion():
    """Where the monocular map says nothing, or "far"; and above LiDAR's field."""
    _, mono, mask = maps(60, 50)
    view, in_field = field_view(mask.shape)
    mask[:], mono[40, 20], mono[40, 30] = True, 0, 220
    lidar, motion = np.zeros_like(mono), np.full_like(mono, 7)
    points = [40, 40, 5], [20, 30, 25]
    lidar[points] = 12
    flat, of_network = ({name: [0.0] * len(at) for name, at in knots.items()} for knots in (MOTION_KNOTS, KNOTS))
    models = ErrorModel(float(np.log(0.07)), flat), ErrorModel(float(np.log(0.2)), of_network)
    beyond = BeyondField(*models, (-1.0, 1.0), 5.0)
    of_motion = dataclasses.replace(motion_calibration(), beyond=beyond)
    calibration = a_calibration(field_rad=(-1.0, 0.0), motion=of_motion)
    prior = make_prior({**both(lidar, mono), "motion": motion}, mask, "integrated", PriorOptions(), calibration, view)
    assert not in_field[5, 25] and in_field[40, 20]
    np.testing.assert_allclose(prior.distance_m[points], 12)
    np.testing.assert_allclose(prior.sigma_m[points], 0.12, rtol=1e-5)
    assert prior.sigma_m[5, 20] == pytest.approx(0.07 * 7, rel=1e-5)


def test_where_motion_counts_alone_the_monocular_map_has_no_part():
    lidar, mono, mask = maps(60, 50)
    mask[:] = True
    _, in_field = field_view(mask.shape)
    motion = MotionMap(np.full_like(mono, 7), 0.5, mask, ~in_field)
    frame = integrate_frame(np.where(in_field, lidar, 0), mono, mask, "integrated", PriorOptions(), motion=motion)
    np.testing.assert_array_equal(frame.mono_m[~in_field], np.float32(7))
    assert not (frame.mono_m[in_field] == 7).any()


def test_motion_moves_the_prior_by_its_weight():
    _, mono, mask = maps(40, 40)
    mask[:], mono[:] = True, 10
    nothing, motion = np.zeros_like(mono), np.full_like(mono, 10.5)
    for weight in (0.0, 0.4, 1.0):
        calibration = a_calibration(motion=motion_calibration(weight))
        found = make_prior(
            *({"lidar": nothing, "mono": mono, "motion": motion}, mask, "integrated", PriorOptions(), calibration),
            level_view(mask.shape),
        )
        np.testing.assert_allclose(found.distance_m, 10 + 0.5 * weight, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "calibration"),
    [
        (PriorOptions(motion=False), a_calibration(motion=motion_calibration())),
        (PriorOptions(), a_calibration()),  # its error could not be measured
        (PriorOptions(), a_calibration(error_model=None)),
        (PriorOptions(sigma_mode="combined", motion=False), None),
    ],
)
def test_without_its_part_the_prior_is_that_of_two_sources_bit_for_bit(options, calibration):
    lidar, mono, mask = maps(60, 50)
    view = field_view(mask.shape)[0] if calibration else None
    motion = np.full_like(mono, 7)
    two, three = (
        make_prior(found, mask, "integrated", options, calibration, view)
        for found in (both(lidar, mono), {**both(lidar, mono), "motion": motion})
    )
    assert (two.distance_m > 0).any()
    assert two.distance_m.tobytes() == three.distance_m.tobytes()
    assert two.sigma_m.tobytes() == three.sigma_m.tobytes()


def test_without_a_calibration_motion_counts_by_what_is_usual_of_both():
    _, mono, mask = maps(40, 40)
    mask[:], mono[:] = True, 10
    found = {"lidar": np.zeros_like(mono), "mono": mono, "motion": np.full_like(mono, 10.5)}
    prior = make_prior(found, mask, "integrated", PriorOptions(sigma_mode="combined"))
    # 0.1² / (0.1² + 0.03²)
    np.testing.assert_allclose(prior.distance_m, 10 + 0.5 * 0.917431, rtol=1e-5)


def test_motion_alone_is_its_map():
    _, mono, mask = maps()
    only = make_prior({"motion": mono}, mask, "motion", PriorOptions())
    assert np.array_equal(only.distance_m, mono * mask)
    np.testing.assert_allclose(only.sigma_m[mask], np.sqrt((0.1 * mono[mask]) ** 2 + 0.05**2), rtol=1e-5)
    assert prior_module.default_source({"motion"}) == "motion"
    assert prior_module.default_source({"motion", "mono"}) == "mono"
    assert prior_module.default_source({"motion", "mono", "lidar"}) == "integrated"
