"""What motion teaches the depth network, what is left out of it, and the calibration beyond its field that follows."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scenes import fisheye, write_scene

from edge_depth_nerf.base.files import read_distance_png, write_distance_png, write_png
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.method.error_model import FIELD_MARGIN_DEG, MOTION_KNOTS, fit_error_model, read_calibration
from edge_depth_nerf.method.prior import MotionMap, PriorOptions, RayAngles, make_prior, motion_sigma
from edge_depth_nerf.mono.calibration import calibrate_scene, combine, measure_beyond, measure_frame
from edge_depth_nerf.mono.estimate import without_sky
from edge_depth_nerf.mono.examples import Examples, fingerprint, load_examples
from edge_depth_nerf.mono.motion_seen import (
    LEFT_OUT_EVERY,
    NETWORK_ERROR,
    PLACE_M,
    left_out_pixels,
    left_out_places,
    taught_by_motion,
)
from edge_depth_nerf.mono.training import scale_invariant_loss
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.stereo.consistency import MotionDistance


def with_motion(folder: Path, sigma_share: float | None = 0.01) -> SceneFolder:
    """Give a scene the truth as distances from motion, with a standard deviation that is a share of them."""
    scene = read_scene(folder)
    truth = {picture.name: scene.distance_m(picture, "truth_distance") for picture in scene.pictures}
    if sigma_share is not None:
        sigmas = ((name, metres * sigma_share) for name, metres in truth.items() if metres is not None)
        write_maps(folder, "motion_sigma", sigmas, {"kind": "for a test"})
    for layer in ("motion_around", "motion"):
        found = ((name, metres) for name, metres in truth.items() if metres is not None)
        write_maps(folder, layer, found, {"kind": "for a test"})
    return read_scene(folder)


def examples_of(scene: SceneFolder, motion: bool = True) -> Examples:
    pictures = [picture for picture in scene.pictures if not picture.held_out]
    by_motion = [lambda picture: taught_by_motion(scene, picture)] if motion else None
    heights = [{picture.camera: 1.5 for picture in pictures}]
    return load_examples([scene], [pictures], heights, 32, 4, by_motion=by_motion)


def test_whole_places_are_left_out_by_a_fixed_rule():
    corners_m = PLACE_M * np.random.default_rng(0).integers(-200, 200, (4000, 3)).astype(float)
    left_out = left_out_places(corners_m + 0.01)
    assert left_out.mean() == pytest.approx(1 / LEFT_OUT_EVERY, abs=0.02)
    # wherever in the place
    np.testing.assert_array_equal(left_out_places(corners_m + 0.99 * PLACE_M), left_out)
    # neighbours along no axis are chosen together
    for axis in range(3):
        beside = left_out_places(corners_m + 0.01 + PLACE_M * np.eye(3)[axis])
        assert (left_out & beside).mean() == pytest.approx(1 / LEFT_OUT_EVERY**2, abs=0.012)


def test_what_is_left_out_teaches_no_picture(tmp_path: Path):
    scene = with_motion(write_scene(tmp_path))
    before = examples_of(scene)
    shares = []
    for picture in scene.pictures:
        path = picture.files["motion"]
        metres = read_distance_png(path)
        out = left_out_pixels(scene, picture, metres)
        shares.append(out.sum() / (metres > 0).sum())
        write_distance_png(path, np.where(out, 0, metres))
    assert 0.02 < np.mean(shares) < 0.4
    assert fingerprint(vars(examples_of(scene))) == fingerprint(vars(before))
    # all else does
    picture = scene.pictures[0]
    write_distance_png(picture.files["motion"], np.zeros_like(read_distance_png(picture.files["motion"])))
    assert fingerprint(vars(examples_of(scene))) != fingerprint(vars(before))


def test_motion_teaches_where_no_point_fell_and_counts_by_its_error(tmp_path: Path):
    scene = with_motion(write_scene(tmp_path / "a"), sigma_share=NETWORK_ERROR)
    without, found = examples_of(scene, motion=False), examples_of(scene)
    assert without.weight is None and found.weight is not None
    lidar_points = without.lidar_m > 0
    np.testing.assert_array_equal(found.lidar_m[lidar_points], without.lidar_m[lidar_points])
    assert (found.weight[lidar_points] == 1).all()
    new = (found.lidar_m > 0) & ~lidar_points
    assert new.sum() > lidar_points.sum()
    # as exact as the network: half; steps of the files matter a little
    np.testing.assert_allclose(found.weight[new], 0.5, atol=0.02)
    exact = examples_of(with_motion(write_scene(tmp_path / "b"), sigma_share=0.01))
    assert exact.weight is not None and exact.weight[new].min() > 0.9
    # what says nothing of its error has the usual one
    usual = examples_of(with_motion(write_scene(tmp_path / "c"), sigma_share=None))
    assert usual.weight is not None and 0.6 < usual.weight[new].mean() < 0.9


def test_the_loss_counts_by_weight():
    rng = np.random.default_rng(1)
    error, valid, weight = rng.normal(0.1, 0.4, (2, 6, 5)), rng.random((2, 6, 5)) < 0.5, rng.random((2, 6, 5))
    expected = []
    for e, v, w in zip(error, valid, weight, strict=True):
        mean, square = (np.average(values[v], weights=w[v]) for values in (e, e**2))
        expected.append(np.sqrt(square - 0.5 * mean**2 + 1e-6))
    log_error, measured = torch.from_numpy(error), torch.from_numpy(valid)
    assert float(scale_invariant_loss(log_error, measured, 0.5, torch.from_numpy(weight))) == pytest.approx(
        np.mean(expected)
    )
    whole = scale_invariant_loss(log_error, measured, 0.5, torch.ones(2, 6, 5))
    assert float(whole) == float(scale_invariant_loss(log_error, measured, 0.5))


def test_sigma_falls_with_parallax_and_confidence():
    shape = (1, 3)
    found = MotionDistance(
        np.full(shape, 10, np.float32), np.array([[0.99, 0.99, 0.75]], np.float32), np.array([[3, 30, 30]], np.float32)
    )
    near_none, exact, doubtful = found.sigma_m[0]
    assert exact < near_none and exact < doubtful
    assert motion_sigma(found.distance_m, None)[0, 0] == pytest.approx(0.3)


# ---- beyond LiDAR's field ----------------------------------------------------------------------------------------
SIZE = (80, 120)
FIELD_TOP_DEG = 2.0


def beyond_frames(mono_error: float, count: int = 12, seed: int = 0):
    """Frames whose network is right to 2 % in LiDAR's field, and to `mono_error` beyond; motion everywhere to 1 %, in
    the neighbouring frames, too.

    Left out are blocks of 10 px. Gives their measurements, and what a prior of such a frame is made of.
    """
    rng = np.random.default_rng(seed)
    elevation = np.broadcast_to(np.linspace(40, -30, SIZE[0], dtype=np.float32)[:, None], SIZE)
    view = RayAngles(np.full(SIZE, 0.5, np.float32), np.radians(elevation))
    beyond = (elevation > FIELD_TOP_DEG + FIELD_MARGIN_DEG) | (elevation < -30 - FIELD_MARGIN_DEG)
    usable, frames, maps = np.ones(SIZE, bool), [], []
    for number in range(count):
        truth = np.full(SIZE, 10, np.float32) * np.float32(np.exp(rng.normal(0, 0.3)))
        smooth = np.kron(rng.normal(0, 1, (8, 12)), np.ones((10, 10)))
        mono = truth * np.exp(np.where(beyond, mono_error * smooth, 0.02 * smooth)).astype(np.float32)
        moved = truth * (1 + rng.normal(0, 0.01, SIZE)).astype(np.float32)
        lidar_points = (elevation <= FIELD_TOP_DEG) & (rng.random(SIZE) < 0.2)
        lidar = np.where(lidar_points, truth, 0).astype(np.float32)
        blocks = np.kron(rng.random((8, 12)) < 0.25, np.ones((10, 10))) > 0
        around = truth * (1 + rng.normal(0, 0.01, SIZE)).astype(np.float32)
        motion = MotionMap(moved, 0.8, usable, beyond, around)
        sigma_m = 0.03 * moved
        measured = measure_frame(*(str(number), number, lidar, mono, usable, view, PriorOptions()), motion=motion)
        extra = measure_beyond(number, lidar, mono, usable, view, PriorOptions(), None, motion, sigma_m, blocks)
        frames.append(dataclasses.replace(measured, beyond=extra))
        # of a frame as it is used: no motion in other blocks, as where nothing matches
        holes = np.kron(rng.random((8, 12)) < 0.25, np.ones((10, 10))) > 0
        of_source = {"lidar": lidar, "mono": mono, "motion": np.where(holes, 0, moved), "motion_sigma": sigma_m}
        maps.append((truth, {**of_source, "motion_around": around}))
    return frames, maps, view, beyond


@pytest.fixture(scope="module")
def three_percent():
    """Frames whose network is wrong by 3 % beyond the field, and what they give."""
    frames, maps, view, where = beyond_frames(0.03)
    return combine(frames, "key", False, motion_errors=(0.01, 0.02)), maps, view, where


def covered(calibration, maps, view, where) -> tuple[float, float]:
    """Shares within one and two sigma of pixels beyond the field, of what motion says nothing of or of the rest."""
    scaled = []
    for truth, of_source in maps:
        prior = make_prior(of_source, np.ones(SIZE, bool), "integrated", PriorOptions(), calibration, view)
        missing = where & (of_source["motion"] == 0)
        evaluated = missing & (prior.distance_m > 0)
        # but for what lies farther from all that is known than was measured, or is wrong by more than a tenth
        assert evaluated.sum() > 0.65 * missing.sum()
        scaled.append(np.abs(prior.distance_m - truth)[evaluated] / prior.sigma_m[evaluated])
    every = np.concatenate(scaled)
    return float(np.mean(every < 1)), float(np.mean(every < 2))


def test_sigma_of_the_network_beyond_the_field_is_its_own():
    frames, _, _, _ = beyond_frames(0.06)
    calibration = combine(frames, "key", False, motion_errors=(0.01, 0.02))
    _, maps, view, beyond = beyond_frames(0.06, count=6, seed=1)
    one, two = covered(calibration, maps, view, beyond)
    assert one == pytest.approx(0.68, abs=0.12) and two == pytest.approx(0.95, abs=0.05)
    # that of the field, where the network is right to 2 %, is too small, and it shows
    assert calibration.motion is not None and calibration.motion.beyond is not None
    of_field = dataclasses.replace(calibration.motion.beyond, network_model=calibration.error_model)
    extrapolated = dataclasses.replace(calibration, motion=dataclasses.replace(calibration.motion, beyond=of_field))
    one, two = covered(extrapolated, maps, view, beyond)
    assert one < 0.5 and two < 0.8


def test_without_a_measurement_beyond_there_is_no_prior(three_percent):
    whole, maps, view, beyond = three_percent
    motion = whole.motion
    assert motion is not None and motion.beyond is not None
    beyond_field = motion.beyond

    def has_prior(**changes) -> np.ndarray:
        changed = dataclasses.replace(beyond_field, **{"reach_px": 1e3, **changes})
        calibration = dataclasses.replace(whole, motion=dataclasses.replace(motion, beyond=changed))
        prior = make_prior(maps[0][1], np.ones(SIZE, bool), "integrated", PriorOptions(), calibration, view)
        np.testing.assert_array_equal(prior.distance_m > 0, prior.sigma_m > 0)
        return prior.distance_m > 0

    matched = maps[0][1]["motion"] > 0
    assert has_prior().all()
    np.testing.assert_array_equal(has_prior(network_model=None), ~beyond | matched)
    np.testing.assert_array_equal(has_prior(motion_model=None, network_model=None), ~beyond)
    # nor far from all that is known
    lidar = maps[0][1]["lidar"] > 0
    near = cv2.distanceTransform((~(matched | lidar)).astype(np.uint8), cv2.DIST_L2, 5) <= 2
    np.testing.assert_array_equal(has_prior(reach_px=2.0), ~beyond | matched | near)
    # nor where motion never reached
    low = np.radians(20.0)
    np.testing.assert_array_equal(
        has_prior(reach_rad=(-1.0, float(low))), ~beyond | matched | (view.elevation_rad <= low)
    )


def test_beyond_the_field_a_monocular_distance_counts_only_where_neighbours_confirm_it(three_percent):
    calibration, maps, view, beyond = three_percent
    rng = np.random.default_rng(2)
    usable = np.ones(SIZE, bool)
    assert len(maps) >= 2
    for truth, of_source in maps[:2]:
        # a beam before the ceiling, which no picture has matched; something of half the distance; and a few points
        shown = np.kron(rng.choice([0.0, 0.5, 1.0], (8, 12)), np.ones((10, 10)))
        around = truth * np.where(shown == 1, rng.random(SIZE) < 0.3, shown).astype(np.float32)
        of_source = {**of_source, "motion_around": around}
        prior = make_prior(of_source, usable, "integrated", PriorOptions(), calibration, view)
        whole = make_prior(
            {**of_source, "motion_around": truth}, usable, "integrated", PriorOptions(), calibration, view
        )
        expected = whole.distance_m > 0
        for row, column in np.argwhere(beyond & (of_source["motion"] == 0)):
            beside = around[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
            # the network is wrong by far less than the tenth that may be
            expected[row, column] &= bool((beside == truth[row, column]).any())
        np.testing.assert_array_equal(prior.distance_m > 0, expected)
        np.testing.assert_array_equal(prior.sigma_m > 0, expected)
        missing = beyond & (of_source["motion"] == 0) & (whole.distance_m > 0)
        assert 0.2 < expected[missing].mean() < 0.6
        # what a scene of before cannot confirm is not used
        del of_source["motion_around"]
        before = make_prior(of_source, usable, "integrated", PriorOptions(), calibration, view)
        np.testing.assert_array_equal(before.distance_m > 0, ~beyond | (of_source["motion"] > 0))
        # maps of a network that was trained elsewhere need nobody
        elsewhere = dataclasses.replace(calibration, everywhere=True)
        assert make_prior(of_source, usable, "integrated", PriorOptions(), elsewhere, view).distance_m.all()


def test_sigma_above_the_field_is_not_that_of_the_road():
    # in the field mostly road, which matches to 0.5 %, and some upright things at the same distances: to 3 %
    rng = np.random.default_rng(3)
    elevation_deg = np.where(rng.random(40_000) < 0.9, rng.uniform(-60, -26, 40_000), rng.uniform(-10, 5, 40_000))
    true_error = np.where(elevation_deg > -18, 0.03, 0.005)
    features = {
        "elevation_deg": elevation_deg,
        "distance_m": rng.uniform(3, 12, 40_000),
        "by_matching": np.full(40_000, 0.03),
        "rim_px": np.full(40_000, 5.0),
        **{name: np.full(40_000, 0.01) for name in ("spread", "step")},
    }
    model = fit_error_model(
        {name: values.astype(np.float32) for name, values in features.items()},
        np.abs(rng.normal(0, true_error)).astype(np.float32),
        MOTION_KNOTS,
        middle=True,
    )
    assert model is not None
    for deg, expected in ((30.0, 0.03), (80.0, 0.03), (-70.0, 0.005)):
        one = {name: np.array([values[0]], np.float32) for name, values in features.items()}
        one |= {"elevation_deg": np.array([deg], np.float32), "distance_m": np.array([8], np.float32)}
        assert model.sigma_m(one)[0] == pytest.approx(8 * expected, rel=0.1)


def test_sigma_of_motion_beyond_the_field_is_that_measured_in_it():
    frames, maps, view, beyond = beyond_frames(0.15)
    calibration = combine(frames, "key", False, motion_errors=(0.01, 0.02))
    scaled = []
    for truth, of_source in maps:
        prior = make_prior(of_source, np.ones(SIZE, bool), "integrated", PriorOptions(), calibration, view)
        inner = beyond & (of_source["motion"] > 0)
        scaled.append(np.abs(prior.distance_m - truth)[inner] / prior.sigma_m[inner])
        assert (prior.sigma_m[inner] >= 0.02).all()
    every = np.concatenate(scaled)
    # the floor of sigma counts here: rather too large
    assert np.mean(every < 1) > 0.63 and np.mean(every < 2) > 0.9


def test_a_scene_keeps_what_was_measured_beyond(tmp_path: Path):
    scene = write_scene(tmp_path, frames=18)
    for picture in read_scene(scene).pictures:
        # a scanner that reaches little
        truth = read_distance_png(picture.files["truth_distance"])
        sine = rays(picture.lens).directions @ picture.up_in_camera
        write_distance_png(picture.files["lidar"], np.where(np.abs(sine) < 0.2, truth, 0))
    found = with_motion(scene)
    calibration = calibrate_scene(found.path)
    assert calibration.motion is not None and calibration.motion.beyond is not None
    assert calibration.motion.beyond.motion_model is not None and calibration.motion.beyond.network_model is not None
    assert read_calibration(scene / CALIBRATION_FILE) == calibration
    low, high = calibration.motion.beyond.reach_rad
    assert low < calibration.field_rad[0] and high > calibration.field_rad[1]


# ---- sky ---------------------------------------------------------------------------------------------------------
def test_what_is_matched_is_no_sky(tmp_path: Path):
    scene = read_scene(write_scene(tmp_path, [fisheye(96, 84)], frames=3))
    picture = scene.pictures[0]
    sine = rays(picture.lens).directions @ picture.up_in_camera
    high = scene.usable(picture) & (sine > np.sin(np.radians(10)))
    shown = np.where(high[..., None], [200, 215, 240], [70, 70, 70]).astype(np.uint8)
    write_png(picture.files["image"], shown)
    write_distance_png(picture.files["lidar"], np.where(high, 0, read_distance_png(picture.files["lidar"])))
    metres = np.full(high.shape, 30, np.float32)
    sky = without_sky(scene, picture, metres) == 0
    assert sky[high].mean() > 0.8
    motion = ((each.name, np.where(high, 30.0, 0.0)) for each in scene.pictures)
    write_maps(tmp_path, "motion", motion, {"kind": "for a test"}, some_empty=True)
    matched = read_scene(tmp_path)
    assert not (without_sky(matched, matched.pictures[0], metres) == 0)[high].any()
