"""The monocular network: losses, lens-true augmentation, training, weights on disk, maps in scenes."""

import dataclasses
import io
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors import safe_open
from safetensors.torch import load_file, save, save_file
from scenes import fisheye, frame_entry, transforms, tree, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    read_distance_png,
    read_json,
    read_mask,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.entry import main
from edge_depth_nerf.mono.estimate import (
    PRESETS,
    WEIGHTS,
    camera_heights_m,
    estimate_depth,
    predict,
    predicted_maps,
    training_split,
)
from edge_depth_nerf.mono.examples import Examples, load_examples, network_view, reduced
from edge_depth_nerf.mono.network import (
    ARCHITECTURE,
    DepthNetwork,
    NetworkSettings,
    load_network,
    log_room_distance,
    save_network,
)
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.mono.training import (
    Batch,
    TrainingOptions,
    _losses,
    augmented,
    make_batch,
    scale_invariant_loss,
    smoothness_loss,
    torch_threads,
    train,
)
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene

pytestmark = pytest.mark.slow

CPU, QUIET = torch.device("cpu"), Console(quiet=True)
HEIGHT_M = 1.5
TINY = NetworkSettings((8, 16), 32, HEIGHT_M, 5.0)
LENS = KannalaBrandt(40, 36, 11.0, 11.2, 20.7, 17.1, 0.01, -0.003, 0.0, 0.0, 1e-3, -2e-3)


@pytest.fixture(autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def write_street(folder: Path, frames: int = 10, seed: int = 0, lidar: bool = True) -> Path:
    """A floor and a round wall whose colour says how far it is: red is at 3 m, green at 12 m."""
    rng = np.random.default_rng(seed)
    directions, valid = LENS.unproject(LENS.pixel_centres())
    rays, known = torch.nan_to_num(directions).numpy(), valid.numpy()
    entries = []
    for index in range(frames):
        yaw, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(-0.1, 0.1)
        about_up = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        nod = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
        # OpenCV's axes of a camera that looks along the world's y
        pose = np.eye(4)
        pose[:3, :3] = about_up @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ nod
        pose[:3, 3] = [0.3 * index, 0, HEIGHT_M]
        world = rays @ pose[:3, :3].T
        starts = np.sort(rng.uniform(-np.pi, np.pi, 5))
        sector = np.searchsorted(starts, np.arctan2(world[..., 1], world[..., 0])) % 5
        is_far = rng.permutation([True, True, False, False, True])[sector]
        wall_m = np.where(is_far, 12.0, 3.0) / np.maximum(np.hypot(world[..., 0], world[..., 1]), 1e-3)
        floor_m = np.where(world[..., 2] < 0, HEIGHT_M / np.maximum(-world[..., 2], 1e-9), np.inf)
        distance = np.where(known, np.minimum(wall_m, floor_m), 0)
        wall = np.where(is_far[..., None], [40, 130, 60], [200, 50, 40])
        colours = np.where((floor_m < wall_m)[..., None], 110, wall) + rng.normal(0, 6, rays.shape)
        name = f"{index:04d}.png"
        write_png(folder / "images" / name, (colours.clip(0, 255) * known[..., None]).astype(np.uint8))
        write_distance_png(folder / "truth" / name, distance)
        keep = known.copy()
        keep[-6:, :9] = False
        write_mask(folder / "mask.png", keep)
        entry = {
            **frame_entry(LENS, pose, name),
            **{"mask_path": "mask.png", "truth_distance_file_path": f"truth/{name}", "camera": "front", "frame": index},
        }
        if lidar:
            lidar_points = distance * (rng.random(distance.shape) < 0.4) * (np.abs(world[..., 2]) < 0.6)
            write_distance_png(folder / "lidar" / name, lidar_points)
            entry["lidar_file_path"] = entry["depth_file_path"] = f"lidar/{name}"
        entries.append(entry)
    names = [entry["file_path"] for entry in entries]
    held_out = [name for number, name in enumerate(names) if number % 8 == 4]
    meta = {"camera_model": "OPENCV_FISHEYE", "depth_unit_scale_factor": 1 / 256, "theta_max_deg": 95.0}
    split = {"train_filenames": [name for name in names if name not in held_out]}
    split |= {"val_filenames": held_out, "test_filenames": held_out}
    write_json(folder / "transforms.json", {**meta, **split, "frames": entries})
    return folder


@pytest.fixture(scope="module")
def street(tmp_path_factory) -> Path:
    return write_street(tmp_path_factory.mktemp("street"), frames=18)


@pytest.fixture(scope="module")
def ten_frames(tmp_path_factory) -> Path:
    return write_street(tmp_path_factory.mktemp("ten") / "street")


@pytest.fixture
def small_street(ten_frames, tmp_path) -> Path:
    return Path(shutil.copytree(ten_frames, tmp_path / "street"))


@pytest.fixture
def tiny_preset(monkeypatch) -> None:
    """For commands whose network is of no matter."""
    values = dataclasses.replace(PRESETS["lite"], channels=TINY.channels, working_px=TINY.working_px)
    monkeypatch.setitem(PRESETS, "lite", values)


def examples_of(scene: Path, held_out: bool = False) -> Examples:
    found = read_scene(scene)
    pictures = [picture for picture in found.pictures if picture.held_out == held_out]
    return load_examples([found], [pictures], [{"front": HEIGHT_M}], TINY.working_px, TINY.multiple_px)


def same(one: DepthNetwork, other: DepthNetwork) -> bool:
    weights, others = one.state_dict(), other.state_dict()
    return weights.keys() == others.keys() and all(torch.equal(weights[name], others[name]) for name in weights)


# ---- losses ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
def test_scale_invariant_loss_is_its_formula_averaged_over_pictures(balance):
    rng = np.random.default_rng(0)
    error, valid = rng.normal(0.2, 0.5, (3, 7, 9)), rng.random((3, 7, 9)) < 0.3
    valid[1] = False
    expected = []
    for picture in (0, 2):
        e = error[picture][valid[picture]]
        expected.append(np.sqrt((e**2).mean() - balance * e.mean() ** 2 + 1e-6))
    error[~valid] = np.nan  # what was not measured has no say
    found = scale_invariant_loss(torch.from_numpy(error), torch.from_numpy(valid), balance)
    assert float(found) == pytest.approx(np.mean(expected), rel=1e-9)


def test_scale_invariant_loss_forgives_a_scale_and_its_gradient_stays_finite():
    error = torch.full((1, 4, 4), 0.7, requires_grad=True)
    loss = scale_invariant_loss(error, torch.ones(1, 4, 4, dtype=torch.bool), 1.0)
    loss.backward()
    assert float(loss.detach()) == pytest.approx(1e-3, abs=1e-4)
    assert error.grad is not None and torch.isfinite(error.grad).all()


def test_smoothness_is_its_formula_over_usable_pairs():
    rng = np.random.default_rng(1)
    ratio, rgb, usable = rng.normal(size=(2, 5, 6)), rng.random((2, 3, 5, 6)), rng.random((2, 5, 6)) < 0.7
    total, count = 0.0, 0
    for n in range(2):
        for y in range(5):
            for x in range(6):
                for below, right in ((y + 1, x), (y, x + 1)):
                    if below < 5 and right < 6 and usable[n, y, x] and usable[n, below, right]:
                        unlike = np.abs(rgb[n, :, y, x] - rgb[n, :, below, right]).mean()
                        total += abs(ratio[n, y, x] - ratio[n, below, right]) * np.exp(-10 * unlike)
                        count += 1
    found = smoothness_loss(torch.from_numpy(ratio), torch.from_numpy(rgb), torch.from_numpy(usable))
    assert float(found) == pytest.approx(total / count, rel=1e-9)


def test_the_room_is_its_floor_and_its_wall():
    sine = np.array([-1.0, -0.5, -0.2, -0.01, 0.0, 0.5, 1.0])
    expected = [1.5, 3.0, min(7.5, 5 / np.sqrt(0.96)), 5 / np.sqrt(1 - 1e-4), 5.0, 5 / np.sqrt(0.75), 50.0]
    found = log_room_distance(torch.from_numpy(sine), 1.5, 5.0).exp()
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-9)


# ---- augmentation ----------------------------------------------------------------------------------------------
def test_mirrored_and_cut_pictures_still_show_the_plane_they_showed(small_street):
    """A rendered floor: after any augmentation the ray of each pixel still meets it at the pixel's distance."""
    height_m, examples = 1.3, examples_of(small_street)
    for index in range(len(examples)):
        sine = examples.rays[examples.lens[index]] @ examples.up_in_camera[index]
        on_floor = examples.usable[index] & (sine < -0.05)
        examples.lidar_m[index] = np.where(on_floor, height_m / np.where(on_floor, -sine, 1), 0)
        # the picture says where each pixel looks: red = right or left, in the camera's frame
        examples.rgb[index, ..., 0] = 127 + 120 * examples.rays[examples.lens[index]][..., 0]
    plain = make_batch(examples, np.arange(4), TINY, CPU)
    options = TrainingOptions(steps=1, crop=0.5, jitter=0.0)
    mirrored, cut = 0, 0
    for seed in range(6):
        batch = augmented(plain, options, TINY.multiple_px, np.random.default_rng(seed))
        assert batch.rgb.shape[2] % TINY.multiple_px == 0 and batch.rgb.shape[3] % TINY.multiple_px == 0
        cut += batch.usable.shape != plain.usable.shape
        floor = batch.lidar_m > 0
        sine = batch.geometry[:, 3]
        torch.testing.assert_close(batch.lidar_m[floor], height_m / -sine[floor])
        for index in range(4):
            x, y, z = batch.geometry[index, :3]
            up = torch.from_numpy(examples.up_in_camera[index])
            is_mirrored = bool((x.diff(dim=1)[batch.usable[index, :, 1:]] < 0).float().mean() > 0.5)
            assert not is_mirrored, "to the right in the picture is to the right in the camera's frame"
            seen = batch.usable[index]
            shown = (batch.rgb[index, 0] * 255 - 127) / 120
            flipped = bool((shown - x).abs()[seen].mean() > (shown + x).abs()[seen].mean())
            mirrored += flipped
            sign = -1.0 if flipped else 1.0
            torch.testing.assert_close(shown[seen], (sign * x)[seen], atol=0.01, rtol=0)
            # the ray and its elevation agree under the up vector mirrored likewise
            again = sign * x * up[0] + y * up[1] + z * up[2]
            torch.testing.assert_close(again[seen], sine[index][seen], atol=1e-5, rtol=0)
    assert 6 <= mirrored <= 18 and cut >= 3


@pytest.mark.parametrize(("preset", "sides_px"), [("lite", {192}), ("full", {448, 512})])
def test_the_presets_cut_what_is_said(preset, sides_px):
    values = PRESETS[preset]
    settings = NetworkSettings(values.channels, values.working_px, HEIGHT_M, 5.0)
    side = values.working_px
    flat = torch.ones(1, side, side)
    plain = Batch(torch.zeros(1, 3, side, side), torch.zeros(1, 5, side, side), flat, flat > 0, flat, flat)
    shapes = {
        augmented(plain, values.training, settings.multiple_px, np.random.default_rng(seed)).usable.shape[1:]
        for seed in range(24)
    }
    assert shapes == {(height, width) for height in sides_px for width in sides_px}


def test_of_several_points_in_a_pixel_the_one_nearest_its_centre_is_learned(small_street):
    scene = read_scene(small_street)
    picture = scene.pictures[0]
    _, usable = network_view(scene, picture, 12)
    rows, columns = usable.shape
    lidar = read_distance_png(picture.files["lidar"])
    expected = np.zeros((rows, columns), np.float32)
    nearest = np.full((rows, columns), np.inf)
    for row, column in zip(*np.nonzero(lidar), strict=True):
        y, x = (row + 0.5) * rows / LENS.height, (column + 0.5) * columns / LENS.width
        off = np.hypot(y - int(y) - 0.5, x - int(x) - 0.5)
        if off < nearest[int(y), int(x)] - 1e-9:
            nearest[int(y), int(x)], expected[int(y), int(x)] = off, lidar[row, column]
    found = reduced(scene.lidar_m(picture), usable)
    assert ((found > 0) == ((expected > 0) & usable)).all() and (found > 0).sum() > 20
    # equally near ones may be taken either way
    assert (found == np.where(usable, expected, 0)).mean() > 0.9


def test_the_camera_height_is_that_above_the_floor(small_street):
    found = camera_heights_m(read_scene(small_street), TINY)
    assert found["front"] == pytest.approx(HEIGHT_M, abs=0.1)


# ---- training --------------------------------------------------------------------------------------------------
def test_it_learns_what_colours_mean(street):
    """Held-out pictures of a toy street, against truth, beside the best constant and the plain room."""
    scene = read_scene(street)
    settings = dataclasses.replace(TINY, working_px=40, channels=(8, 16, 32))
    pictures = [picture for picture in scene.pictures if not picture.held_out]
    examples = load_examples([scene], [pictures], [{"front": HEIGHT_M}], 40, settings.multiple_px)
    trained = train(examples, None, settings, TrainingOptions(steps=160, learning_rate=1e-2))
    room = DepthNetwork(settings)
    logs = np.log(examples.lidar_m[examples.lidar_m > 0])
    errors: dict[str, list[np.ndarray]] = {"network": [], "room": [], "constant": []}
    for picture in scene.pictures:
        if picture.held_out:
            truth = read_distance_png(picture.files["truth_distance"])
            evaluated = read_mask(picture.files["mask"]) & (read_distance_png(picture.files["lidar"]) > 0)
            for name, found in {
                "network": predict(trained.network, scene, picture, HEIGHT_M, CPU),
                "room": predict(room, scene, picture, HEIGHT_M, CPU),
                "constant": np.full(truth.shape, np.exp(np.median(logs)), np.float32),
            }.items():
                errors[name].append((np.abs(found - truth) / np.maximum(truth, 0.1))[evaluated])
    abs_rel = {name: float(np.concatenate(values).mean()) for name, values in errors.items()}
    assert abs_rel["network"] < 0.2, abs_rel
    assert abs_rel["network"] < 0.5 * min(abs_rel["room"], abs_rel["constant"]), abs_rel


def test_the_same_seed_gives_the_same_weights_and_another_one_others(small_street):
    examples = examples_of(small_street)
    runs = [train(examples, None, TINY, TrainingOptions(steps=4, seed=seed)).network for seed in (3, 3, 4)]
    assert same(runs[0], runs[1]) and not same(runs[0], runs[2])
    assert torch.get_num_threads() == 1
    with torch_threads(2):
        assert same(train(examples, None, TINY, TrainingOptions(steps=4, seed=3)).network, runs[0])
        assert torch.get_num_threads() == 2


def test_the_loss_of_a_batch_is_the_sum_of_its_parts(small_street):
    """Also where the parts have unlike numbers of measured pictures and of usable pixels."""
    options, network = TrainingOptions(steps=1), DepthNetwork(TINY)
    torch.nn.init.normal_(network.head.weight, generator=torch.Generator().manual_seed(0))
    batch = make_batch(examples_of(small_street), np.arange(4), TINY, CPU)
    batch.lidar_m[1] = 0
    batch.usable[3, 4:] = False
    log_ratio = network(batch.rgb, batch.geometry, batch.usable)
    valid = (batch.lidar_m > 0) & batch.usable
    log_error = log_ratio + batch.log_room - batch.lidar_m.clamp(min=1e-3).log()
    expected = scale_invariant_loss(log_error, valid, options.balance, batch.weight)
    expected = expected + options.smoothness * smoothness_loss(log_ratio, batch.rgb, batch.usable)
    parts = [loss() for loss in _losses(network, batch, options)]
    assert len(parts) == 2 and float(expected.detach()) > 0
    assert not torch.isclose(parts[0], parts[1], rtol=1e-2)
    torch.testing.assert_close(sum(parts), expected)


def test_a_killed_training_goes_on_as_if_nothing_had_been(small_street, tmp_path):
    examples, kept = examples_of(small_street), examples_of(small_street, held_out=True)
    options = TrainingOptions(steps=12, evaluate_every=3)
    whole = train(examples, kept, TINY, options)
    checkpoint = tmp_path / "training.checkpoint"
    calls = 0

    class KilledError(Exception):
        pass

    def kill(share: float, error: float) -> None:
        nonlocal calls
        calls += 1
        if calls == 7:
            raise KilledError

    with pytest.raises(KilledError):
        train(examples, kept, TINY, options, checkpoint=checkpoint, checkpoint_seconds=0.0, report=kill)
    shares: list[float] = []
    noted = {"checkpoint": checkpoint, "report": lambda share, error: shares.append(share)}
    again = train(examples, kept, TINY, options, **noted)
    assert shares[0] == pytest.approx(8 / 12) and len(shares) == 5
    assert same(whole.network, again.network)
    assert (again.best_step, again.abs_rel) == (whole.best_step, whole.abs_rel)

    # one that began with other weights is not taken up
    one, two = DepthNetwork(TINY), DepthNetwork(TINY)
    calls = 0
    with pytest.raises(KilledError):
        train(examples, kept, TINY, options, start=one, checkpoint=checkpoint, checkpoint_seconds=0.0, report=kill)
    shares.clear()
    train(examples, kept, TINY, options, start=two, **noted)
    assert len(shares) == 12

    # one of another training, or a broken one, is not taken up
    other = dataclasses.replace(options, seed=1)
    fresh = train(examples, kept, TINY, other)
    assert same(train(examples, kept, TINY, other, checkpoint=checkpoint).network, fresh.network)
    checkpoint.write_bytes(b"broken")
    assert same(train(examples, kept, TINY, other, checkpoint=checkpoint).network, fresh.network)


def test_training_ends_in_time_and_where_nothing_improves(small_street):
    examples = examples_of(small_street)
    in_time = train(examples, None, TINY, TrainingOptions(steps=10**6, seconds=0.5))
    assert 0 < in_time.steps < 10**5

    kept = dataclasses.replace(examples, lidar_m=np.where(examples.lidar_m > 0, 0.11, 0).astype(np.float32))
    hardly = TrainingOptions(steps=200, evaluate_every=2, patience=3, learning_rate=1e-6, hidden_learning_rate=1e-6)
    stopped = train(examples, kept, TINY, hardly)
    assert stopped.steps <= stopped.best_step + 6 < 200 and stopped.stopped_early


def test_what_is_kept_for_stopping_are_whole_training_frames(tmp_path):
    folder = write_street(tmp_path / "two", frames=20)
    with transforms(folder) as meta:
        for frame in meta["frames"]:
            frame["camera"], frame["frame"] = ("left", "right")[frame["frame"] % 2], frame["frame"] // 2
        held_out = [frame["file_path"] for frame in meta["frames"] if frame["frame"] == 4]
        meta["val_filenames"] = meta["test_filenames"] = held_out
        meta["train_filenames"] = [f["file_path"] for f in meta["frames"] if f["file_path"] not in held_out]
    used, kept = training_split(read_scene(folder))
    assert {picture.frame for picture in kept} == {5}
    assert {picture.frame for picture in used} == set(range(10)) - {4, 5}
    assert len(used) == 16 and len(kept) == 2

    for name in ("train", "val", "test"):
        del meta[f"{name}_filenames"]
    write_json(folder / "transforms.json", meta)
    with pytest.raises(InputError, match=r"which pictures are held out \(train_filenames"):
        training_split(read_scene(folder))


# ---- the command -----------------------------------------------------------------------------------------------
@pytest.mark.usefixtures("tiny_preset")
def test_held_out_pictures_have_no_say_and_the_command_continues(small_street, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(small_street, other)
    held_out = "0004.png"
    write_png(other / "images" / held_out, np.full((LENS.height, LENS.width, 3), 200, np.uint8))
    write_distance_png(other / "lidar" / held_out, np.full((LENS.height, LENS.width), 33.0))
    done = [estimate_depth(EstimateDepthOptions((scene,), train_steps=3), QUIET) for scene in (small_street, other)]
    weights = [load_file(path) for path, _ in done]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[0])
    assert done[0][1] is not None and done[0][1].steps == 3
    assert not list(small_street.glob("*.checkpoint"))
    entry = read_json(small_street / "transforms.json")["mono"]
    # frame 4 is held out, frame 5 kept for stopping
    assert entry["trained_frames"] == [f"images/{number:04d}.png" for number in (0, 1, 2, 3, 6, 7, 8, 9)]

    # what is trained is not trained again, until something is asked for differently
    assert estimate_depth(EstimateDepthOptions((small_street,), train_steps=3), QUIET)[1] is None
    assert estimate_depth(EstimateDepthOptions((small_street,), train_steps=4), QUIET)[1] is not None


def test_a_network_whose_time_was_up_early_is_told_of(small_street, capsys):
    options = EstimateDepthOptions((small_street,), train_steps=100_000, seconds=0.3)
    _, trained = estimate_depth(options, Console(width=200))
    assert trained is not None and trained.steps < 200
    said = capsys.readouterr().out
    assert f"Trained {trained.steps} steps of 100,000, where the time limit was reached, in " in said
    assert "make poor maps: increase --seconds" in said


def test_weights_know_how_they_were_made_and_predict_other_scenes(small_street, tmp_path, monkeypatch, capsys):
    model = tmp_path / "street.safetensors"
    words = ["estimate-depth", str(small_street), "--train-steps", "3", "--output", str(model)]
    monkeypatch.setattr(sys, "argv", ["x", *words])
    main()
    with safe_open(model, framework="pt") as file:
        metadata = file.metadata()
    header = json.loads(metadata["header"])
    assert metadata["architecture"] == ARCHITECTURE
    assert header["settings"]["working_px"] == 192 and header["settings"]["channels"] == [16, 24, 48, 96, 128]
    assert header["settings"]["camera_height_m"] == pytest.approx(HEIGHT_M, abs=0.1)
    assert header["settings"]["room_radius_m"] == pytest.approx(6.0, abs=3.0)
    assert header["about"]["preset"] == "lite" and header["about"]["scenes"] == ["street"]
    assert header["about"]["identity"]["training"]["steps"] == 3

    # another scene, without LiDAR
    target = write_street(tmp_path / "target", frames=3, seed=5, lidar=False)
    monkeypatch.setattr(sys, "argv", ["x", "estimate-depth", str(target), "--model", str(model)])
    main()
    assert "3 pictures got a monocular map" in capsys.readouterr().out
    entry = read_json(target / "transforms.json")["mono"]
    assert entry["trained_frames"] == [] and entry["trained_on"] == "scene" and entry["weights"] == "street.safetensors"
    scene = read_scene(target)
    network, _ = load_network(model)
    for (name, expected), picture in zip(predicted_maps(network, scene), scene.pictures, strict=True):
        found = read_distance_png(picture.files["mono"])
        keep = scene.usable(picture)
        assert name == picture.name
        np.testing.assert_allclose(found[keep], expected[keep], atol=1 / 256)
        assert (found[~keep] == 0).all() and keep.mean() > 0.3


def test_a_map_has_the_size_of_its_picture_and_begins_as_the_room(small_street):
    """Untrained, and shown a third of the pixels, the network gives floor and wall where the full picture has them."""
    scene = read_scene(small_street)
    picture = scene.pictures[0]
    network = DepthNetwork(dataclasses.replace(TINY, working_px=16))
    found = predict(network, scene, picture, HEIGHT_M, CPU)
    directions, valid = LENS.unproject(LENS.pixel_centres())
    rays = torch.nan_to_num(directions).numpy() @ (picture.rotation @ np.diag([1.0, -1.0, -1.0])).T
    wall_m = TINY.room_radius_m / np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 0.1)
    floor_m = np.where(rays[..., 2] < 0, HEIGHT_M / np.maximum(-rays[..., 2], 1e-9), np.inf)  # pyrefly: ignore
    inside = (valid & (directions[..., 2] >= np.cos(np.radians(95)))).numpy()
    np.testing.assert_allclose(found[inside], np.minimum(wall_m, floor_m)[inside], rtol=1e-4)


def test_training_goes_on_from_given_weights(small_street, tmp_path):
    settings, start = dataclasses.replace(TINY, camera_height_m=1.0), tmp_path / "start.safetensors"
    save_network(start, DepthNetwork(settings), {})
    weights, _ = estimate_depth(EstimateDepthOptions((small_street,), model=start, train_steps=2), QUIET)
    network, _ = load_network(weights)
    assert weights == small_street / WEIGHTS and network.settings == settings
    assert float(network.head.weight.detach().abs().max()) > 0


def said_by(options: EstimateDepthOptions) -> str:
    console = Console(file=io.StringIO(), width=1000)
    estimate_depth(options, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


@pytest.mark.usefixtures("tiny_preset")
@pytest.mark.parametrize("architecture", ["edge-depth-nerf/u-net-0", ARCHITECTURE])
def test_weights_in_the_scene_that_are_of_no_use_are_made_anew(small_street, architecture):
    path = small_street / WEIGHTS
    save_file({"a": torch.zeros(2)}, path, {"architecture": architecture, "header": "[]"})
    said = said_by(EstimateDepthOptions((small_street,), train_steps=1))
    assert said.count("training starts again") == 1 and str(path) in said
    assert load_network(path)[1]["steps"] == 1


@pytest.mark.usefixtures("tiny_preset")
def test_no_file_of_others_is_overwritten(small_street, tmp_path):
    path = tmp_path / "theirs.safetensors"
    options = EstimateDepthOptions((small_street,), train_steps=1, output=path)
    for content in (save({"a": torch.zeros(2)}, {"format": "pt"}), b"no safetensors"):
        path.write_bytes(content)
        with pytest.raises(InputError, match="was not written by `estimate-depth`"):
            estimate_depth(options, QUIET)
        assert path.read_bytes() == content
    # what was written by another version of this project may go
    save_file({"a": torch.zeros(2)}, path, {"architecture": "edge-depth-nerf/u-net-0", "header": "{}"})
    estimate_depth(options, QUIET)
    assert load_network(path)[1]["steps"] == 1


def test_training_never_writes_over_the_weights_it_starts_from(small_street, tmp_path, monkeypatch):
    path = small_street / WEIGHTS
    save_network(path, DepthNetwork(TINY), {})
    before = path.read_bytes()
    monkeypatch.chdir(small_street)
    for model in (path, Path(WEIGHTS), tmp_path / "street" / ".." / "street" / WEIGHTS):
        with pytest.raises(InputError, match="Name another file with --output"):
            estimate_depth(EstimateDepthOptions((small_street,), model=model, train_steps=1), QUIET)
    assert path.read_bytes() == before
    other = EstimateDepthOptions((small_street,), model=path, train_steps=1, output=tmp_path / "on.safetensors")
    assert estimate_depth(other, QUIET)[1] is not None
    assert estimate_depth(other, QUIET)[1] is None
    assert path.read_bytes() == before


@pytest.mark.usefixtures("tiny_preset")
def test_pictures_kept_for_stopping_without_points(small_street):
    # frame 5 is kept
    write_distance_png(small_street / "lidar" / "0005.png", np.zeros((LENS.height, LENS.width)))
    said = said_by(EstimateDepthOptions((small_street,), train_steps=2))
    assert "its error is unknown" in said
    about = load_network(small_street / WEIGHTS)[1]
    assert about["steps"] == 2 and about["abs_rel"] is None


@pytest.mark.usefixtures("tiny_preset")
def test_scenes_of_one_name_keep_their_own_trained_frames(tmp_path):
    one = write_street(tmp_path / "a" / "scene", frames=10, seed=1)
    other = write_street(tmp_path / "b" / "scene", frames=4, seed=2)
    unseen = write_street(tmp_path / "c" / "scene", frames=3, seed=3)
    weights, _ = estimate_depth(EstimateDepthOptions((one, other), train_steps=1), QUIET)
    moved = other.rename(tmp_path / "elsewhere")
    estimate_depth(EstimateDepthOptions((unseen, moved), model=weights), QUIET)

    def frames(scene: Path) -> list[str]:
        return [str(Path(name).stem) for name in read_json(scene / "transforms.json")["mono"]["trained_frames"]]

    assert frames(one) == ["0000", "0001", "0002", "0003", "0006", "0007", "0008", "0009"]
    assert frames(moved) == ["0000", "0001", "0002", "0003"]
    assert frames(unseen) == []


@pytest.mark.usefixtures("tiny_preset")
def test_the_field_of_the_training_points_goes_with_weights_and_maps(tmp_path):
    low, high = (write_street(tmp_path / name, seed=seed) for seed, name in enumerate(("low", "high")))
    expected = []
    for folder, sign in ((low, 1), (high, -1)):
        up = []
        scene = read_scene(folder)
        used = {picture.name for picture in training_split(scene)[0]}
        for picture in scene.pictures:
            directions, valid = picture.lens.unproject(picture.lens.pixel_centres())
            world = torch.nan_to_num(directions).numpy() @ (picture.rotation @ np.diag([1.0, -1.0, -1.0])).T
            elevation = np.degrees(np.arcsin(np.clip(world[..., 2], -1, 1)))
            # returns of the one scene end 4° above the horizon, those of the other begin 4° below
            lidar = np.where(sign * elevation < 4, read_distance_png(picture.files["lidar"]), 0)
            # what is masked, outside the lens or not trained on has no say
            inside = (valid & (directions[..., 2] >= np.cos(np.radians(95)))).numpy()
            up.append(elevation[(lidar > 0) & inside & read_mask(picture.files["mask"])])
            if picture.name not in used:
                lidar, up = np.where(directions[..., 2].numpy() > 0, 9.0, 0), up[:-1]
            write_distance_png(picture.files["lidar"], lidar)
        expected.append(np.quantile(np.concatenate(up), [0.001, 0.999]))
    expected = [min(e[0] for e in expected), max(e[1] for e in expected)]
    assert expected[0] < -30 and expected[1] > 30
    weights, _ = estimate_depth(EstimateDepthOptions((low, high), train_steps=1), QUIET)
    # pixels are degrees apart
    found = load_network(weights)[1]["field_deg"]
    assert found == pytest.approx(expected, abs=0.5)
    target = write_street(tmp_path / "target", frames=2, seed=5, lidar=False)
    estimate_depth(EstimateDepthOptions((target,), model=weights), QUIET)
    assert read_json(target / "transforms.json")["mono"]["field_deg"] == found

    # weights of before have none
    save_network(tmp_path / "old.safetensors", DepthNetwork(TINY), {"trained_frames": {"target": ["x"]}})
    estimate_depth(EstimateDepthOptions((target,), model=tmp_path / "old.safetensors"), QUIET)
    entry = read_json(target / "transforms.json")["mono"]
    assert "field_deg" not in entry and entry["trained_frames"] == ["x"]


def test_bad_weights_are_named(tmp_path, small_street, monkeypatch, capsys):
    path = tmp_path / "weights.safetensors"
    save_file({"encoder.patch_embed.weight": torch.zeros(2)}, path, {"format": "pt"})
    monkeypatch.setattr(sys, "argv", ["x", "estimate-depth", str(small_street), "--model", str(path)])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    message = capsys.readouterr().err
    assert str(path) in message and "another architecture" in message and "encoder.patch_embed.weight" in message

    path.write_bytes(b"\x00" * 100)
    with pytest.raises(InputError, match="cannot be read as weights"):
        load_network(path)
    with pytest.raises(FileNotFoundError, match="no such file"):
        load_network(tmp_path / "none.safetensors")

    network = DepthNetwork(TINY)
    save_network(path, network, {})
    tensors, header = load_file(path), {"settings": dataclasses.asdict(TINY), "about": {}}

    def rewrite(changed: dict[str, torch.Tensor], **settings) -> None:
        described = {**header, "settings": {**header["settings"], **settings}}
        save_file(changed, path, {"architecture": ARCHITECTURE, "header": json.dumps(described)})

    rewrite(tensors, channels=[16, 16])
    with pytest.raises(InputError, match="tensors are not those"):
        load_network(path)
    rewrite(tensors, channels=[10**6, 8])
    with pytest.raises(InputError, match="describe no network"):
        load_network(path)
    rewrite({**tensors, "head.bias": torch.full((4,), torch.nan)})
    with pytest.raises(InputError, match="not finite"):
        load_network(path)


def test_bad_scenes_and_options_are_named(tmp_path, small_street):
    no_lidar = write_street(tmp_path / "no_lidar", frames=3, lidar=False)
    with pytest.raises(InputError, match="has no LiDAR maps"):
        estimate_depth(EstimateDepthOptions((no_lidar,)), QUIET)
    with pytest.raises(InputError, match="given twice"):
        estimate_depth(EstimateDepthOptions((small_street, small_street)), QUIET)
    with pytest.raises(FileNotFoundError):
        estimate_depth(EstimateDepthOptions((tmp_path / "none",)), QUIET)
    wrong: list[dict[str, Any]] = [{"train_steps": 0}, {"seconds": 0.0}, {"seconds": float("nan")}]
    for bad in (*wrong, dict[str, Any](output=Path("x.pt"))):
        with pytest.raises(InputError, match="expected"):
            EstimateDepthOptions((small_street,), **bad).check()
    for lidar in (small_street / "lidar").iterdir():
        write_distance_png(lidar, np.zeros((LENS.height, LENS.width)))
    with pytest.raises(InputError, match="nothing to train on"):
        estimate_depth(EstimateDepthOptions((small_street,), train_steps=1), QUIET)


# ---- maps in scenes --------------------------------------------------------------------------------------------
def test_maps_are_put_into_a_scene_and_nothing_else_changes(tmp_path):
    folder = write_scene(tmp_path / "scene", [fisheye()], frames=4, mono=False, theta_max_deg=60.0)
    (folder / CALIBRATION_FILE).write_text("{}")
    before = read_json(folder / "transforms.json")
    scene = read_scene(folder)
    metres = np.full((28, 32), 7.25, np.float32)
    metres[10, 10:13] = [np.nan, np.inf, 200.5]
    metres[12, 12] = -1.0
    source = {"trained_on": "elsewhere", "a": 1}
    write_maps(folder, "mono", ((picture.name, metres) for picture in scene.pictures), source)
    after = read_json(folder / "transforms.json")
    assert after.pop("mono") == source
    for frame in after["frames"]:
        assert frame.pop("mono_file_path") == f"mono/images/{Path(frame['file_path']).name}"
    assert after == before
    assert not (folder / CALIBRATION_FILE).exists() and not (folder / ".mono.partial").exists()
    picture = read_scene(folder).pictures[1]
    found = read_distance_png(picture.files["mono"])
    directions, valid = picture.lens.unproject(picture.lens.pixel_centres())
    inside = (valid & (directions[..., 2] >= 0.5)).numpy() & read_mask(picture.files["mask"])
    inside[10, 10:13] = inside[12, 12] = False
    np.testing.assert_array_equal(found, np.where(inside, 7.25, 0))


def test_a_run_that_fails_leaves_the_scene_as_it_was(tmp_path):
    folder = write_scene(tmp_path / "scene", [fisheye()], frames=4)
    good = np.full((28, 32), 5.0, np.float32)
    names = [picture.name for picture in read_scene(folder).pictures]
    before = tree(folder)

    def killed():
        yield names[0], good
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_maps(folder, "mono", killed(), {"trained_on": "scene"})
    assert tree(folder) == before
    whole = [(name, good) for name in names]
    for maps, match in (
        (whole[:-1], "1 of 4 frames have no monocular map"),
        ([*whole, whole[0]], "comes twice"),
        ([*whole, ("images/else.png", good)], "is of no frame"),
        ([*whole[:-1], (names[-1], good[:, 1:])], "31×28 pixels"),
        ([*whole[:-1], (names[-1], 0 * good)], "no distance between"),
        ([*whole[:-1], (names[-1], np.nan * good)], "no distance between"),
    ):
        with pytest.raises(InputError, match=match):
            write_maps(folder, "mono", maps, {"trained_on": "scene"})
        assert tree(folder) == before
    with pytest.raises(InputError, match="trained_on"):
        write_maps(folder, "mono", whole, {})
