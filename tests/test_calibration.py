"""Calibration of trust: error models on errors of known distribution, and scenes of known maps."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from scenes import write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json, write_distance_png, write_json
from edge_depth_nerf.method.error_model import (
    FIELD_MARGIN_DEG,
    KNOTS,
    LEAST_EVALUATED,
    MOTION_KNOTS,
    error_of_lidar_points,
    fit_error_model,
    motion_features,
    pixel_features,
    read_calibration,
)
from edge_depth_nerf.method.prior import MotionMap, PriorOptions, RayAngles, make_prior
from edge_depth_nerf.mono import calibration as calibration_module
from edge_depth_nerf.mono.calibration import (
    calibrate_scene,
    combine,
    find_calibration,
    fit_of_drive,
    held_out_points,
    measure_beyond,
    measure_frame,
    points_of_both,
)
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene


def both(lidar: np.ndarray, mono: np.ndarray) -> dict[str, np.ndarray]:
    return {"lidar": lidar, "mono": mono}


def random_features(count, seed=0, least_nearest=1.0):
    rng = np.random.default_rng(seed)
    return {
        "distance_m": np.exp(rng.uniform(0, 4, count)).astype(np.float32),
        "theta_deg": rng.uniform(0, 100, count).astype(np.float32),
        "nearest_px": (least_nearest + rng.exponential(5, count)).astype(np.float32),
        "spread": np.exp(rng.uniform(-7, -1, count)).astype(np.float32),
        "step": np.exp(rng.uniform(-6, 0, count)).astype(np.float32),
    }


def known_sigma(features):
    """Relative: 1 %, more far from returns and with spread."""
    return 0.01 * (1 + features["nearest_px"] / 10) * (1 + 20 * features["spread"])


def test_a_known_error_is_covered_in_every_part():
    features, evaluated = random_features(60_000), random_features(60_000, seed=1)
    rng = np.random.default_rng(2)
    model = fit_error_model(features, np.abs(rng.normal(0, known_sigma(features))))
    assert model is not None
    error_m = np.abs(rng.normal(0, known_sigma(evaluated))) * evaluated["distance_m"]
    scaled = error_m / model.sigma_m(evaluated)
    parts = {
        "all": np.ones(len(scaled), bool),
        "near": evaluated["nearest_px"] < 2,
        "far": evaluated["nearest_px"] > 12,
        "disagreeing": evaluated["spread"] > 0.1,
        "agreeing": evaluated["spread"] < 0.003,
        "wide": evaluated["theta_deg"] > 80,
    }
    for name, part in parts.items():
        # where the floor of 2 cm counts, sigma is too large on purpose
        part &= evaluated["distance_m"] > 5
        assert np.mean(scaled[part] < 1) == pytest.approx(0.683, abs=0.05), name
        assert np.mean(scaled[part] < 2) == pytest.approx(0.954, abs=0.03), name


def test_heavy_tails_still_have_95_percent_within_two():
    features = random_features(30_000)
    error = np.abs(np.random.default_rng(3).laplace(0, 0.02, 30_000))
    model = fit_error_model(features, error)
    assert model is not None
    scaled = error / np.exp(model.log_sigma(features))
    # a Laplace distribution scaled so: 1 - exp(-ln(1 / 0.05) / 2) within one
    assert np.mean(scaled < 2) == pytest.approx(0.95, abs=0.02)
    assert np.mean(scaled < 1) == pytest.approx(0.776, abs=0.03)


def test_too_few_errors_give_no_model():
    features = random_features(LEAST_EVALUATED - 1)
    assert fit_error_model(features, known_sigma(features)) is None


def test_at_a_point_half_of_the_variance_is_left():
    features = random_features(5_000)
    model = fit_error_model(features, np.abs(np.random.default_rng(0).normal(0, 0.02, 5_000)))
    assert model is not None
    factors = model.log_factors["nearest_px"]
    assert np.exp(2 * (factors[1] - factors[0])) == pytest.approx(2)


def test_points_against_their_neighbours():
    y, x = np.mgrid[:50, :60]
    # a plane seen by a pinhole: inverse z is linear
    plane = (1 / (0.1 + 0.001 * x + 0.002 * y)).astype(np.float32)
    lidar_points = np.ones(plane.shape, bool)
    lidar_points[10] = False
    found, error = error_of_lidar_points(np.where(lidar_points, plane, 0), lidar_points)
    assert not found[10].any() and found[20, 20] and not found[0, 0]
    assert error.max() < 1e-5
    noisy = (plane * (1 + np.random.default_rng(0).normal(0, 0.01, plane.shape))).astype(np.float32)
    _, error = error_of_lidar_points(noisy, np.ones(plane.shape, bool))
    inner = error[1:-1, 1:-1]
    # the larger of two that share the middle value: a fifth to two fifths more than one alone
    assert 1.1 < np.sqrt(np.mean(inner**2)) / 0.01 < 1.5


def test_what_other_frames_show_above_the_points_is_evaluated():
    elevation_deg = np.repeat(np.linspace(10, -30, 80)[:, None], 60, axis=1)
    view = RayAngles(np.full(elevation_deg.shape, 0.5, np.float32), np.radians(elevation_deg).astype(np.float32))
    usable = np.ones(elevation_deg.shape, bool)
    truth = np.full(elevation_deg.shape, 10, np.float32)
    lidar = np.where(elevation_deg <= 2, truth, 0).astype(np.float32)
    # right where LiDAR reaches, a third too far above
    mono = np.where(elevation_deg <= 2, truth, 4 / 3 * truth).astype(np.float32)
    far_seen = np.where(elevation_deg > 2, truth, 0).astype(np.float32)
    alone = measure_frame("a", 0, lidar, mono, usable, view, PriorOptions())
    more = measure_frame("a", 0, lidar, mono, usable, view, PriorOptions(), far_seen_m=far_seen)
    assert alone.errors.relative.max() < 0.05
    new = len(more.errors.relative) - len(alone.errors.relative)
    assert new == np.count_nonzero((elevation_deg > 2) & (elevation_deg <= 2 + FIELD_MARGIN_DEG - 0.3))
    assert np.count_nonzero(more.errors.relative > 0.2) > 0.8 * new


def test_features_of_pixels():
    mono = np.full((20, 30), 10, np.float32)
    mono[:, 20:] = 30
    mono[0] = 0
    lidar_points = np.zeros(mono.shape, bool)
    lidar_points[10, 5] = True
    spread = np.full(mono.shape, 0.5, np.float32)
    found = pixel_features(mono, spread, mono, lidar_points, np.full(mono.shape, np.pi / 4, np.float32))
    assert set(found) == set(KNOTS)
    assert found["nearest_px"][10, 5] == 0
    assert found["nearest_px"][10, 8] == pytest.approx(3, abs=0.1)
    assert found["nearest_px"][13, 9] == pytest.approx(5, abs=0.3)
    assert found["step"][10, 10] == 0
    assert found["step"][10, 20] == pytest.approx(np.log(3), rel=1e-5)
    assert found["step"][1, 10] == 0  # beside pixels without a map
    assert found["spread"][10, 10] == pytest.approx(0.05)
    assert found["theta_deg"][3, 3] == pytest.approx(45)


def test_features_of_distances_from_motion():
    motion = np.full((20, 30), 10, np.float32)
    motion[:, 20:] = 12
    motion[10, 5] = 0
    none = np.zeros_like(motion)
    found = motion_features(dict.fromkeys(("distance_m", "spread", "step"), none), motion, 0.05 * motion, none + 0.5)
    assert set(found) == {*MOTION_KNOTS, "distance_m"}
    # the pixels beside a jump, and those around one without a distance, count as rims; the picture's border does not
    assert [found["rim_px"][0, column] for column in (19, 20, 17)] == [0, 0, pytest.approx(2, abs=0.1)]
    assert found["rim_px"][10, 6] == found["rim_px"][9, 5] == 0 and found["rim_px"][10, 8] > 1.9
    assert found["rim_px"][0, 12] > 5
    assert found["by_matching"][3, 3] == pytest.approx(0.05)
    assert found["elevation_deg"][3, 3] == pytest.approx(28.648, abs=1e-3)


def few_points(points: int, number: int):
    """A frame whose monocular map is half of the truth, right to 1 %, and so many LiDAR points."""
    rng = np.random.default_rng([points, number])
    shape = (120, 160)
    truth = np.broadcast_to(20 * np.exp(0.3 * np.sin(np.arange(160) / 25 + number)), shape).astype(np.float32)
    mono = (truth / 2 * np.exp(rng.normal(0, 0.01, shape))).astype(np.float32)
    lidar = np.zeros(shape, np.float32)
    chosen = rng.choice(truth.size, points, replace=False)
    lidar.flat[chosen] = truth.flat[chosen]
    return truth, lidar, mono


def test_errors_of_frames_with_few_points_are_those_of_their_prior():
    """They take the drive's fit there; measured without it, sigma was half of the distance."""
    shape, options = (120, 160), PriorOptions()
    elevation = np.broadcast_to(np.linspace(0.3, -0.3, shape[0], dtype=np.float32)[:, None], shape)
    view, usable = RayAngles(np.zeros(shape, np.float32), elevation), np.ones(shape, bool)
    data = [few_points(45, number) for number in range(60)]
    drive_fit = fit_of_drive(
        [points_of_both(n, lidar, mono, usable) for n, (_, lidar, mono) in enumerate(data)], options
    )
    frames = [
        measure_frame(str(n), n, lidar, mono, usable, view, options, drive_fit)
        for n, (_, lidar, mono) in enumerate(data)
    ]
    calibration = combine(frames, "", everywhere=False, drive_fit=drive_fit)
    assert {frame.fit_of for frame in calibration.frames} == {"drive"}
    truth, lidar, mono = few_points(45, 60)
    prior = make_prior(both(lidar, mono), usable, "integrated", options, calibration, view)
    elsewhere = (prior.distance_m > 0) & (lidar == 0)
    off = np.abs(prior.distance_m - truth)[elsewhere]
    assert 0.9 < np.mean(off < 2 * prior.sigma_m[elsewhere]) <= 1
    assert np.median(prior.sigma_m[elsewhere] / truth[elsewhere]) < 0.02
    # what motion is compared with, and what is known beyond LiDAR's field, are measured with it, too
    motion = MotionMap(truth, 0.5, usable, ~usable)
    beyond = measure_beyond(60, lidar, mono, usable, view, options, drive_fit, motion, 0.03 * truth, ~usable)
    assert len(beyond.field.relative) > 2 and np.median(beyond.field.relative) < 0.02


def test_motion_is_compared_with_maps_that_are_fitted_by_the_drive(tmp_path):
    folder = with_motion(write_scene(tmp_path), 1.0)
    change_map(folder, "mono_file_path", 0, lambda metres: metres / 2)
    scene = read_scene(folder)
    points = calibration_module._points_of_drive(scene, (0, scene.pictures[0]))
    change_map(folder, "lidar_file_path", 0, lambda m: np.where(np.cumsum(m > 0).reshape(m.shape) < 50, m, 0))
    scene = read_scene(folder)
    drive_fit = fit_of_drive([points], PriorOptions())
    of_both, _ = calibration_module._errors_of_both(scene, PriorOptions(), drive_fit, (0, scene.pictures[0]))
    assert of_both.shape[1] > 2 and np.median(of_both[1]) < 0.01


def test_blocks_rows_and_single_points_are_left_out():
    lidar_points = np.random.default_rng(0).random((350, 350)) < 0.5
    elevation = np.broadcast_to(np.linspace(0.2, -0.5, 350)[:, None], lidar_points.shape).astype(np.float32)
    for number in (0, 1):
        left_out, in_blocks = held_out_points(lidar_points, elevation, number)
        assert not (left_out & ~lidar_points).any() and not (in_blocks & ~left_out).any()
        assert 0.06 < in_blocks.sum() / lidar_points.sum() < 0.14
        rows = left_out[:10].sum() / lidar_points[:10].sum()
        assert rows == 1 if number else rows < 0.5
        again, _ = held_out_points(lidar_points, elevation, number)
        np.testing.assert_array_equal(left_out, again)


# ---- scenes ----------------------------------------------------------------------------------------------------------
def change_map(scene, key, frame, change):
    meta = read_json(scene / "transforms.json")
    path = scene / meta["frames"][frame][key]
    write_distance_png(path, change(read_distance_png(path)))


def test_a_scene_is_calibrated_and_the_file_read_again(tmp_path):
    scene = write_scene(tmp_path)
    calibration = calibrate_scene(scene)
    assert read_calibration(scene / CALIBRATION_FILE) == calibration
    assert len(calibration.frames) == 8
    for frame in calibration.frames:
        # mono is a tenth too far, the same everywhere
        assert frame.fit_of == "frame" and frame.fit.exponent == pytest.approx(1, abs=0.05)
        assert frame.held_out_before == pytest.approx(0.1, abs=0.01)
        assert frame.held_out_after is not None and frame.held_out_after < 0.01
    assert calibration.drive_fit is not None
    assert calibration.drive_fit.apply(np.array([[11.0]], np.float32))[0, 0] == pytest.approx(10, rel=0.02)
    assert "10.0% before" in " ".join(calibration.sentences())


def test_held_out_frames_change_nothing(tmp_path):
    scene = write_scene(tmp_path)
    before = calibrate_scene(scene)
    for key in ("lidar_file_path", "mono_file_path"):
        change_map(scene, key, 4, lambda metres: metres * 3)  # the held-out frame
    assert calibrate_scene(scene) == before
    for key in ("lidar_file_path", "mono_file_path"):
        change_map(scene, key, 5, lambda metres: np.where(metres > 5, metres * 1.5, metres))
        changed = calibrate_scene(scene)
        assert changed != before
        before = changed


def test_the_host_says_which_pictures_are_for_training(tmp_path):
    scene = write_scene(tmp_path, split=False)
    images = [scene / "images" / f"{i:04d}.png" for i in (0, 2, 3)]
    calibration = find_calibration(read_scene(scene), PriorOptions(), training_images=images)
    assert [frame.frame for frame in calibration.frames] == [f"images/{i:04d}.png" for i in (0, 2, 3)]


def test_few_points_are_named(tmp_path):
    scene = write_scene(tmp_path)
    change_map(scene, "lidar_file_path", 2, lambda metres: metres * (np.arange(metres.size) < 90).reshape(metres.shape))
    calibration = calibrate_scene(scene)
    (poor,) = [frame for frame in calibration.frames if frame.fit_of == "drive"]
    assert poor.frame == "images/0002.png" and poor.returns < 50 and poor.fit == calibration.drive_fit
    assert "use that of the whole drive: images/0002.png." in " ".join(calibration.sentences())


def test_a_calibration_is_found_until_its_files_change(tmp_path, monkeypatch):
    scene = write_scene(tmp_path)
    options = PriorOptions()
    made = find_calibration(read_scene(scene), options)
    (kept,) = (scene / ".cache").iterdir()
    monkeypatch.setattr(calibration_module, "_calibrate", lambda *_: pytest.fail("made again"))
    assert find_calibration(read_scene(scene), options) == made
    # sigma's own options have no part in it
    assert find_calibration(read_scene(scene), dataclasses.replace(options, sigma_mode="combined")) == made
    shutil.move(kept, scene / CALIBRATION_FILE)
    assert find_calibration(read_scene(scene), options) == made
    monkeypatch.undo()
    change_map(scene, "mono_file_path", 0, lambda metres: metres + np.arange(metres.size).reshape(metres.shape) % 7)
    assert find_calibration(read_scene(scene), options) != made
    assert find_calibration(read_scene(scene), PriorOptions(align="none")).made_of != made.made_of


def test_a_broken_calibration_is_named_and_made_anew(tmp_path):
    """Also one whose weight of motion is no weight."""
    scene = with_motion(write_scene(tmp_path), 1.0)
    made = calibrate_scene(scene)
    whole = read_json(scene / CALIBRATION_FILE)
    del whole["sha256"]
    contents = ["{", '{"version": 0}', "[]", '{"version": 1, "error_model": {"log_base": 0, "log_factors": {}}}']
    weights = [{**whole, "motion": {**whole["motion"], "weight": weight}} for weight in (1.5, -0.1, None)]
    for content in [*contents, *map(json.dumps, weights)]:
        (scene / CALIBRATION_FILE).write_text(content)
        with pytest.raises(InputError, match=CALIBRATION_FILE):
            read_calibration(scene / CALIBRATION_FILE)
    assert find_calibration(read_scene(scene), PriorOptions()) == made


def test_a_scene_without_maps_to_measure_by(tmp_path):
    with pytest.raises(InputError, match="has no LiDAR distance maps"):
        calibrate_scene(write_scene(tmp_path / "a", lidar=False))
    with pytest.raises(InputError, match="no monocular"):
        calibrate_scene(write_scene(tmp_path / "b", mono=False))


def test_a_mono_map_of_another_size_is_named(tmp_path):
    scene = write_scene(tmp_path)
    change_map(scene, "mono_file_path", 1, lambda metres: metres[1:])
    with pytest.raises(InputError, match=r"mono/0001\.png: is 32×27"):
        calibrate_scene(scene)


def test_maps_of_zeros_give_no_model_but_no_error(tmp_path):
    scene = write_scene(tmp_path)
    for frame in range(9):
        change_map(scene, "mono_file_path", frame, lambda metres: metres * 0)
    calibration = calibrate_scene(scene)
    assert calibration.error_model is None and calibration.drive_fit is None
    assert "LiDAR points are too few" in " ".join(calibration.sentences())


def test_no_prior_beyond_lidars_field_but_from_a_source_trained_elsewhere(tmp_path):
    scene = write_scene(tmp_path)
    calibration = calibrate_scene(scene)
    assert not calibration.everywhere
    calibration = dataclasses.replace(calibration, field_rad=(-0.4, 0.1))
    shape = (28, 32)
    elevation = np.broadcast_to(np.linspace(-1, 1, 28, dtype=np.float32)[:, None], shape)
    view = RayAngles(np.full(shape, 0.5, np.float32), elevation)
    mono = np.full(shape, 9, np.float32)
    mono[14, 5] = 230  # far beyond
    lidar = np.where(np.random.default_rng(0).random(shape) < 0.3, np.float32(8), 0).astype(np.float32)
    mask = np.ones(shape, bool)
    prior = make_prior(both(lidar, mono), mask, "integrated", PriorOptions(), calibration, view)
    margin = np.radians(FIELD_MARGIN_DEG)
    expected = (elevation > -0.4 - margin) & (elevation < 0.1 + margin)
    expected[14, 5] = False
    np.testing.assert_array_equal(prior.distance_m > 0, expected)
    np.testing.assert_array_equal(prior.sigma_m > 0, expected)
    # other modes keep to what was asked for
    literal = make_prior(
        both(lidar, mono), mask, "integrated", PriorOptions(align="none", sigma_mode="constant"), calibration, view
    )
    assert (literal.distance_m > 0).all()

    meta = read_json(scene / "transforms.json")
    write_json(scene / "transforms.json", {**meta, "mono": {"trained_on": "elsewhere"}})
    elsewhere = calibrate_scene(scene)
    assert elsewhere.everywhere
    everywhere = make_prior(both(lidar, mono), mask, "integrated", PriorOptions(), elsewhere, view)
    assert (everywhere.distance_m > 0).sum() == mask.sum() - 1


def with_motion(scene, factor):
    """Give a scene maps from motion: the true distance times a factor."""
    folder = read_scene(scene)
    rng = np.random.default_rng(8)

    def made():
        for picture in folder.pictures:
            truth = folder.distance_m(picture, "truth_distance")
            assert truth is not None
            yield picture.name, (truth * factor * (1 + rng.normal(0, 0.005, truth.shape))).astype(np.float32)

    write_maps(scene, "motion", made(), {"kind": "for a test"}, some_empty=True)
    return scene


def test_motion_counts_by_its_error_beside_monos(tmp_path):
    rng = np.random.default_rng(9)
    for name in ("a", "b"):
        scene = write_scene(tmp_path / name)
        for frame in range(9):
            change_map(scene, "mono_file_path", frame, lambda metres: metres * (1 + rng.normal(0, 0.02, metres.shape)))
    right, wrong = (with_motion(tmp_path / name, factor) for name, factor in (("a", 1.0), ("b", 1.2)))
    assert not (right / CALIBRATION_FILE).exists()
    calibrated, doubted = calibrate_scene(right), calibrate_scene(wrong)
    assert calibrated.motion is not None and doubted.motion is not None
    # motion is wrong by half a per cent, or by a fifth; mono by two
    assert calibrated.motion.relative_error == pytest.approx(0.005, rel=0.25)
    assert doubted.motion.relative_error == pytest.approx(0.105, rel=0.1)
    assert calibrated.motion.mono_relative_error == pytest.approx(0.02, rel=0.25)
    assert calibrated.motion.weight == pytest.approx(16 / 17, abs=0.04)
    assert doubted.motion.weight < 0.06
    assert "95 % of the distances from motion are within" in " ".join(calibrated.sentences())
    assert read_calibration(right / CALIBRATION_FILE) == calibrated
    assert find_calibration(read_scene(right), PriorOptions()) == calibrated
    # other files, another calibration
    assert find_calibration(read_scene(right), PriorOptions(motion=False)).motion is None


def test_without_motion_a_calibration_says_nothing_of_it(tmp_path):
    scene = write_scene(tmp_path / "a")
    calibration = calibrate_scene(scene)
    assert calibration.motion is None and "motion" not in read_json(scene / CALIBRATION_FILE)
    assert "motion" not in " ".join(calibration.sentences())
    same = with_motion(write_scene(tmp_path / "b"), 1.0)
    assert find_calibration(read_scene(same), PriorOptions(motion=False)) == calibration
    empty = with_motion(write_scene(tmp_path / "c"), 0.0)
    assert calibrate_scene(empty).motion is None
