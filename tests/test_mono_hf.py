"""Ready-made networks: pinhole views of a fisheye picture, views brought to agree and blended, networks from disk."""

import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from lenses import FISHEYE
from scenes import FLIP, RADIUS_M, fisheye, pinhole, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, write_distance_png, write_json
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.entry import main
from edge_depth_nerf.mono.elsewhere import FittedMaps
from edge_depth_nerf.mono.estimate import estimate_depth
from edge_depth_nerf.mono.examples import scaled_lens
from edge_depth_nerf.mono.hf import load_ready_network, view_layers
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.mono.pinhole_views import PinholeView, pinhole_views
from edge_depth_nerf.mono.relative import Layer, Line, Samples, blend, fit_lines, take_samples
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import ScenePicture, read_scene

pytestmark = pytest.mark.slow

THETA_MAX = np.radians(95.0)


LENS = scaled_lens(FISHEYE, (200, 200))
WITHIN, RAYS = rays(LENS, THETA_MAX).within, rays(LENS, THETA_MAX).directions


def view_rays(view: PinholeView) -> np.ndarray:
    """Unit rays of a view's pixel centres in the camera, written out."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5 - view.width / 2, np.arange(view.height) + 0.5 - view.height / 2)
    found = np.stack([x / view.focal_px, y / view.focal_px, np.ones_like(x)], -1)
    return found / np.linalg.norm(found, axis=-1, keepdims=True) @ view.view_to_camera.T


def in_a_room(along: np.ndarray) -> np.ndarray:
    """Distance to the nearest of six walls: -4 and 9 m in x, -3.5 and 1.6 m in y, -12 and 20 m in z."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = np.array([-4.0, -3.5, -12.0]) / along, np.array([9.0, 1.6, 20.0]) / along
    return np.where(along > 0, to_high, np.where(along < 0, to_low, np.inf)).min(-1)


@pytest.mark.parametrize(
    ("lens", "theta_deg", "count"),
    [
        pytest.param(LENS, 95, 7, id="kitti"),
        pytest.param(LENS, 112, 13, id="beyond-100-degrees"),
        pytest.param(LENS, 40, 1, id="narrow-fisheye"),
        pytest.param(fisheye(90, 80), 180, None, id="small-fisheye"),
        pytest.param(pinhole(64, 56), 95, 1, id="pinhole"),
    ],
)
def test_the_views_see_every_pixel_of_the_lens(lens, theta_deg, count):
    theta_max = np.radians(theta_deg)
    views = pinhole_views(lens, theta_max)
    directions, valid = lens.unproject(lens.pixel_centres())
    within = valid.numpy() & (torch.nan_to_num(directions[..., 2]).numpy() >= np.cos(theta_max))
    weight = np.zeros(within.shape)
    for view in views:
        np.maximum(weight[view.box], view.weight, out=weight[view.box])
        assert ((view.weight > 0) <= (view.cosine > 0)).all()
        # only pixels of the lens, and in the view
        assert within[view.box][view.weight > 0].all()
        x, y = view.view_xy[view.weight > 0].T
        assert x.min() >= 0 and y.min() >= 0 and x.max() <= view.width - 1 and y.max() <= view.height - 1
    # where there is one view its weight does not matter
    assert within.any() and weight[within].min() > (0.02 if len(views) > 1 else 0)
    assert count is None or len(views) == count


def test_neighbouring_views_overlap():
    views = pinhole_views(LENS, THETA_MAX)
    seen = np.zeros((len(views), LENS.height, LENS.width), bool)
    for number, view in enumerate(views):
        seen[number][view.box] = view.weight > 0
    shared = np.array([[(a & b).sum() for b in seen] for a in seen])
    # the middle view (first) and the six around it
    assert (shared[0] > 500).all()
    assert seen.sum(0).max() >= 3


def test_a_view_shows_upright_what_lies_along_its_rays():
    # colours say where a ray goes
    picture = np.where(WITHIN[..., None], np.rint(127.5 + 127.5 * RAYS), 0).astype(np.uint8)
    views = pinhole_views(LENS, THETA_MAX)
    assert len(views) == 7
    for view in views:
        shown = view.cut(picture)
        assert shown.shape == (view.height, view.width, 3)
        expected = 127.5 + 127.5 * view_rays(view)
        inside = cv2.erode((shown > 0).any(-1).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        inside &= view_rays(view)[..., 2] > np.cos(np.radians(93))
        assert inside.mean() > 0.35
        assert np.abs(shown - expected)[inside].max() < 3
        # a view's x is level, its y goes down
        assert view.view_to_camera[1, 0] == 0 and view.view_to_camera[1, 1] > 0.5
        assert np.allclose(view.view_to_camera.T @ view.view_to_camera, np.eye(3))
        assert np.linalg.det(view.view_to_camera) == pytest.approx(1)


@pytest.mark.parametrize("kind", ["metric", "relative", "inverse"])
def test_an_exact_network_gives_the_truth(kind):
    """A scale and shift of their own for each view of a map of unknown scale; for a metric one none."""
    rng = np.random.default_rng(3)
    truth = np.where(WITHIN, in_a_room(RAYS.astype(np.float64)), 0)
    # a tenth of the pixels between 25° below and 3° above the horizon
    elevation = np.degrees(np.arcsin(-RAYS[..., 1]))
    hit = (rng.random(truth.shape) < 0.1) & (elevation > -25) & (elevation < 3)
    lidar = np.where(hit, truth, 0).astype(np.float32)
    assert 400 < (lidar > 0).sum() < 1500
    # one return of twenty is wrong by a factor
    wrong = (lidar > 0) & (rng.random(lidar.shape) < 0.05)
    lidar[wrong] *= rng.uniform(0.2, 4, wrong.sum())
    layers = []
    for view in pinhole_views(LENS, THETA_MAX):
        seen = view_rays(view)
        z = in_a_room(seen) * (seen @ view.view_to_camera[:, 2])
        scale, shift = rng.uniform(0.3, 3), rng.uniform(-1, 1)
        said = {"metric": z, "relative": scale * z + 5 * shift, "inverse": scale / z + 0.2 * shift}[kind]
        layers.append(view.layer(said))
    samples = take_samples(layers, lidar, WITHIN, 3000)
    lines = fit_lines(samples, kind, [Line()] * len(layers) if kind == "metric" else None)
    blended = blend(layers, lines, kind, (LENS.height, LENS.width))
    assert (blended[~WITHIN] == 0).all() and (blended[WITHIN] > 0).all()
    error = np.abs(blended - truth)[WITHIN] / truth[WITHIN]
    assert error.mean() < 0.002 and np.quantile(error, 0.99) < 0.01
    if kind != "metric":
        # without agreement the views' own lines are far from one another
        scales = [line.scale for line in lines]
        assert max(scales) > 2 * min(scales)


def test_metric_views_that_differ_by_factors_meet_in_the_middle():
    rng = np.random.default_rng(0)
    views = pinhole_views(LENS, THETA_MAX)
    factors = np.exp(rng.uniform(-0.2, 0.2, len(views)))
    layers = []
    for view, factor in zip(views, factors, strict=True):
        seen = view_rays(view)
        layers.append(view.layer(factor * in_a_room(seen) * (seen @ view.view_to_camera[:, 2])))
    samples = take_samples(layers, np.zeros(WITHIN.shape, np.float32), WITHIN, 3000)
    lines = fit_lines(samples, "metric", [Line()] * len(views))
    left = np.log([line.scale * factor for line, factor in zip(lines, factors, strict=True)])
    assert all(line.shift == 0 for line in lines)
    assert np.ptp(np.log(factors)) > 0.25
    assert np.ptp(left) < 0.1 * np.ptp(np.log(factors))
    assert abs(left.mean()) < np.abs(np.log(factors)).max()


def test_a_view_that_nothing_is_known_of_says_nothing():
    values = np.array([[1.0, 2, 3, 4, np.nan, np.nan], [np.nan] * 4 + [5.0, 6]])
    lidar = np.array([2.0, 4, 6, 8, 0, 0])
    lines = fit_lines(Samples(values, np.ones((2, 6)), np.ones((2, 6)), lidar), "relative")
    assert lines[0].scale == pytest.approx(2, rel=1e-3) and lines[0].shift == pytest.approx(0, abs=1e-2)
    assert (lines[1].distance_m(values[1], 1.0, "relative") == 0).all()


@pytest.mark.parametrize(("kind", "expected"), [("metric", 10.0), ("relative", 10.0), ("inverse", 0.4)])
def test_a_line_is_its_formula(kind, expected):
    # p = 2 · 2 + 1 = 5; z = 5 or 1/5; distance = z / 0.5
    found = Line(2.0, 1.0).distance_m(np.array([2.0, np.nan, -3.0, np.inf]), 0.5, kind)
    assert found.tolist() == pytest.approx([expected, 0, 0, 0])


def test_layers_are_blended_by_weight_in_log_distance():
    whole, left = (slice(0, 1), slice(0, 3)), (slice(0, 1), slice(0, 2))
    first = Layer(whole, np.array([[2.0, 2.0, np.nan]]), np.ones((1, 3)), np.array([[1.0, 1.0, 1.0]]))
    second = Layer(left, np.array([[8.0, np.nan]]), np.ones((1, 2)), np.array([[3.0, 3.0]]))
    blended = blend([first, second], [Line(), Line()], "metric", (1, 3))
    assert blended[0].tolist() == pytest.approx([2.0**0.25 * 8.0**0.75, 2.0, 0.0])


# ---- scenes -------------------------------------------------------------------------------------------------------
def seen_in_the_ball(picture: ScenePicture, in_camera: np.ndarray) -> np.ndarray:
    """Distance from a picture of `write_scene` to the wall, along rays of the camera."""
    world = in_camera @ (picture.rotation @ FLIP[:3, :3]).T
    along = world @ picture.position_m
    return -along + np.sqrt(along**2 + RADIUS_M**2 - picture.position_m @ picture.position_m)  # pyrefly: ignore


@pytest.mark.parametrize("kind", ["relative", "inverse"])
def test_frames_with_few_points_take_the_drives_fit(tmp_path, kind):
    """Scales differ from view to view, but not from frame to frame, except in the held-out one."""
    folder = write_scene(tmp_path, [scaled_lens(FISHEYE, (90, 90))], frames=5, mono=False)
    few = "images/0002.png"
    lidar = read_distance_png(folder / "lidar/0002.png")
    lidar[lidar > 0] *= np.random.default_rng(0).random((lidar > 0).sum()) < 0.005
    write_distance_png(folder / "lidar/0002.png", lidar)
    scene = read_scene(folder)

    def layers(picture: ScenePicture) -> list[Layer]:
        rng = np.random.default_rng(5)
        odd = 3.0 if picture.held_out else 1.0
        said = []
        for view in pinhole_views(picture.lens, scene.theta_max_rad):
            seen = view_rays(view)
            z = seen_in_the_ball(picture, seen) * (seen @ view.view_to_camera[:, 2])
            scale, shift = odd * rng.uniform(0.5, 2), rng.uniform(-0.05, 0.05)
            said.append(view.layer(scale * z + shift if kind == "relative" else scale / z + shift))
        return said

    fitted = FittedMaps(scene, kind, layers)
    maps = {picture.name: metres for picture, metres in fitted}
    assert fitted.by_the_drive == [few]
    assert list(maps)[-1] == few and len(maps) == len(scene.pictures)
    assert any(picture.held_out for picture in scene.pictures)
    for picture in scene.pictures:
        truth = read_distance_png(picture.files["truth_distance"])
        known = rays(picture.lens, np.radians(90)).within & (truth > 0)
        error = np.abs(maps[picture.name] - truth)[known] / truth[known]
        assert error.mean() < 0.01, picture.name


def test_maps_of_unknown_scale_need_lidar(tmp_path):
    folder = write_scene(tmp_path, mono=False)
    meta = read_json(folder / "transforms.json")
    # held-out pictures do not count
    for entry in meta["frames"]:
        if entry["file_path"] in meta["train_filenames"]:
            write_distance_png(folder / entry["lidar_file_path"], np.zeros((28, 32)))
    with pytest.raises(InputError, match=r"no training picture of images has 50 LiDAR points.*cannot be made"):
        FittedMaps(read_scene(folder), "inverse", lambda picture: [])
    FittedMaps(read_scene(folder), "metric", lambda picture: [])


@pytest.mark.parametrize(("is_said", "kind"), [("inverse", "relative"), ("relative", "inverse")])
def test_a_map_that_runs_the_wrong_way_is_told(tmp_path, is_said, kind):
    scene = read_scene(write_scene(tmp_path, [scaled_lens(FISHEYE, (60, 60))], frames=2, mono=False))

    def layers(picture: ScenePicture) -> list[Layer]:
        found = scene.rays(picture)
        distance = seen_in_the_ball(picture, found.directions)
        values = 1 / distance if is_said == "inverse" else distance
        return [Layer((slice(0, 60), slice(0, 60)), values, np.ones((60, 60)), found.within.astype(float))]

    with pytest.raises(InputError, match=rf"rank correlation.*not {kind}. Declare it {is_said}"):
        list(FittedMaps(scene, kind, layers))


def test_one_odd_picture_has_no_map_and_ends_no_run(tmp_path):
    """A network fails on the fifth; what it finds in the eighth is all sky."""
    folder = write_scene(tmp_path, [scaled_lens(FISHEYE, (60, 60))], frames=20, mono=False)
    scene = read_scene(folder)

    def layers(picture: ScenePicture) -> list[Layer]:
        found = scene.rays(picture)
        distance = seen_in_the_ball(picture, found.directions)
        values = distance if picture is scene.pictures[4] else 1 / distance
        return [Layer((slice(0, 60), slice(0, 60)), values, np.ones((60, 60)), found.within.astype(float))]

    maps = [(picture, metres) for picture, metres in FittedMaps(scene, "inverse", layers)]
    assert [picture.frame for picture, metres in maps if not metres.any()] == [4]
    named = [(picture.name, 1e4 if number == 7 else metres) for number, (picture, metres) in enumerate(maps)]
    source = {"trained_on": "elsewhere"}
    given = [(name, np.broadcast_to(metres, (60, 60))) for name, metres in named]
    assert write_maps(folder, "mono", given, source) == [scene.pictures[4].name, scene.pictures[7].name]
    assert read_scene(folder).has("mono")
    # three of twenty are too many
    given[9] = (given[9][0], np.zeros((60, 60)))
    with pytest.raises(InputError, match=rf"{scene.pictures[4].name}: its monocular map .* as 3 of the first 10\."):
        write_maps(folder, "mono", given, source)


# ---- networks from disk -------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def networks(tmp_path_factory) -> Path:
    transformers = pytest.importorskip("transformers")
    folder = tmp_path_factory.mktemp("networks")
    transformers.utils.logging.disable_progress_bar()
    torch.manual_seed(0)
    sizes, square = {"hidden_size": 16, "num_attention_heads": 2}, {"image_size": 32, "patch_size": 16}
    stages = {"out_features": ["stage1", "stage2"], "reshape_hidden_states": False}
    dino = transformers.Dinov2Config(**sizes, **stages, num_hidden_layers=2, mlp_ratio=1, image_size=28, patch_size=14)
    head = {"neck_hidden_sizes": [8, 8], "fusion_hidden_size": 8, "head_hidden_size": 4}
    parts = {"patch_size": 14, "reassemble_hidden_size": 16, "reassemble_factors": [2, 1]}
    relative, metric = (
        transformers.DepthAnythingConfig(backbone_config=dino, **parts, **head, **more)
        for more in ({}, {"depth_estimation_type": "metric", "max_depth": 80})
    )
    deep, neck = {**sizes, **square, "num_hidden_layers": 4, "intermediate_size": 16}, {"neck_hidden_sizes": [8] * 4}
    dpt = transformers.DPTConfig(**deep, **neck, backbone_out_indices=[0, 1, 2, 3], fusion_hidden_size=8)
    ones, eights = [1, 1, 1, 1], [8, 8, 8, 8]
    glpn = transformers.GLPNConfig(
        depths=ones, hidden_sizes=eights, decoder_hidden_size=8, num_attention_heads=ones, sr_ratios=ones, max_depth=40
    )
    stages["out_features"] = ["stage1", "stage2", "stage3", "stage4"]
    beit = transformers.BeitConfig(**deep, **stages, use_relative_position_bias=True)
    bins = {"bin_configurations": [{"n_bins": 8, "min_depth": 0.1, "max_depth": 80.0, "name": "kitti"}]}
    few = {"bottleneck_features": 8, "num_relative_features": 4, "bin_embedding_dim": 8, "num_attractors": [2] * 4}
    zoe = transformers.ZoeDepthConfig(
        backbone_config=beit, backbone_hidden_size=16, fusion_hidden_size=8, **neck, **few, **bins
    )
    square_px = {"height": 32, "width": 32}
    fourteen = transformers.DPTImageProcessor(size={"height": 28, "width": 28}, ensure_multiple_of=14)
    sixteen = transformers.DPTImageProcessor(size=square_px)
    for name, model, processor in (
        ("anything", transformers.DepthAnythingForDepthEstimation(relative), fourteen),
        ("anything-metric", transformers.DepthAnythingForDepthEstimation(metric), fourteen),
        ("dpt", transformers.DPTForDepthEstimation(dpt), sixteen),
        ("glpn", transformers.GLPNForDepthEstimation(glpn), transformers.GLPNImageProcessor()),
        ("zoe", transformers.ZoeDepthForDepthEstimation(zoe), transformers.ZoeDepthImageProcessor(size=square_px)),
        # the trunk of a depth network, and one that knows no depth
        ("trunk", transformers.DPTModel(dpt), sixteen),
        ("dino", transformers.Dinov2Model(dino), sixteen),
    ):
        model.save_pretrained(folder / name)
        processor.save_pretrained(folder / name)
    return folder


@pytest.mark.parametrize(
    ("name", "kind"),
    [("anything", "inverse"), ("anything-metric", "metric"), ("dpt", "inverse"), ("glpn", "metric"), ("zoe", "metric")],
)
def test_networks_say_what_their_maps_are(networks, name, kind):
    network = load_ready_network(str(networks / name))
    assert network.kind == kind
    assert load_ready_network(str(networks / name), "relative").kind == "relative"
    pictures = [np.random.default_rng(i).integers(0, 256, (40, 56, 3), dtype=np.uint8) for i in range(2)]
    maps = network(pictures)
    assert [each.shape for each in maps] == [(40, 56), (40, 56)]
    assert all(each.dtype == np.float32 and np.isfinite(each).all() for each in maps)
    if kind == "metric":
        assert min(each.min() for each in maps) > 0


def test_a_network_is_shown_its_own_preparation_of_the_picture(networks):
    """DPT by hand; a picture of the size that it is prepared to is only normalised."""
    import transformers

    picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    (found,) = load_ready_network(str(networks / "dpt"))([picture])
    model = transformers.DPTForDepthEstimation.from_pretrained(networks / "dpt").eval()
    seen = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
    with torch.no_grad():
        expected = model((seen / 255 - 0.5) / 0.5).predicted_depth
    assert np.ptp(found) > 0
    assert np.abs(found - expected[0].numpy()).max() < 0.01 * np.ptp(found)


@pytest.mark.parametrize("name", ["anything-metric", "dpt"])
def test_the_command_writes_maps_of_a_ready_made_network(networks, name, tmp_path, monkeypatch, capsys):
    folder = write_scene(tmp_path / "scene", [fisheye(48, 44)], frames=4, mono=False)
    before = read_json(folder / "transforms.json")
    command = ["edge-depth-nerf", "estimate-depth", str(folder), "--hf", str(networks / name)]
    monkeypatch.setattr(sys, "argv", command)
    main()
    said = capsys.readouterr().out
    assert ("metric maps" if name == "anything-metric" else "inverse maps, fitted to LiDAR") in said
    meta = read_json(folder / "transforms.json")
    assert meta["mono"]["trained_on"] == "elsewhere" and meta["mono"]["network"] == name
    assert str(tmp_path) not in str(meta["mono"])
    assert len(meta["frames"]) == len(before["frames"])
    for entry in meta["frames"]:
        found = read_distance_png(folder / entry["mono_file_path"])
        assert found.shape == (44, 48) and (found > 0).any()
    assert (folder / "mono_trust.json").is_file()


def test_the_maps_in_the_scene_are_those_of_the_network(networks, tmp_path):
    """Of one view, a pinhole's, no blending is left: z of the view over the cosine."""
    folder = write_scene(tmp_path / "scene", [pinhole(48, 44)], frames=2, lidar=False, mono=False, mask=False)
    estimate_depth(EstimateDepthOptions((folder,), hf=str(networks / "glpn")))
    scene = read_scene(folder)
    network = load_ready_network(str(networks / "glpn"))
    picture = scene.pictures[0]
    rgb = read_image(picture.files["image"])
    (view,) = pinhole_views(picture.lens, scene.theta_max_rad)
    (layer,) = view_layers(network, [view], rgb)
    z = network([view.cut(rgb)])[0]
    to_x, to_y, ahead = np.moveaxis(scene.rays(picture).directions, -1, 0)
    x = to_x / ahead * view.focal_px + view.width / 2 - 0.5
    y = to_y / ahead * view.focal_px + view.height / 2 - 0.5
    expected = cv2.remap(z, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR) / ahead
    written = read_distance_png(picture.files["mono"])
    kept = written > 0
    assert kept.mean() > 0.5
    assert np.abs(written - expected)[kept].max() < 0.01
    assert np.allclose(layer.cosine, ahead[layer.box])


def test_networks_that_cannot_be_used_are_named(networks, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    folder = write_scene(tmp_path / "scene", frames=2, mono=False)
    truncated, unprepared = (shutil.copytree(networks / "dpt", tmp_path / name) for name in ("truncated", "unprepared"))
    weights = truncated / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1000])
    (unprepared / "preprocessor_config.json").unlink()
    nameless = tmp_path / "nameless"
    write_json(nameless / "config.json", {"model_type": "nothing-known"})
    for name, expected in (
        (str(networks / "trunk"), "misses .* of its network's weights, such as .*head"),
        (str(networks / "dino"), "dinov2 is not a depth network. Expected one of .*depth_anything"),
        (str(truncated), "cannot be loaded as a depth network .*Copy or download"),
        (str(unprepared), "cannot be loaded as a depth network"),
        (str(nameless), "cannot be loaded as a depth network"),
        (str(folder), "has no config.json"),
        ("nobody/no-such-network", "neither a folder here nor .*hf download nobody/no-such-network"),
    ):
        with pytest.raises(InputError, match=expected):
            load_ready_network(name)
    words = ["estimate-depth", str(folder), "--hf", "nobody/no-such-network"]
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", *words])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2 and "Nothing is downloaded" in capsys.readouterr().err


def test_without_the_library_its_name_is_told(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(InputError, match=r"pip install '\.\[hf\]'"):
        load_ready_network(str(tmp_path))
