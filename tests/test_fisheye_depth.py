"""Distance maps of fisheye pictures without a scene: cut into views, joined, and all that can be wrong with either."""

import dataclasses
import json
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lenses import FISHEYE, kitti_360
from rich.console import Console
from test_mono_hf import in_a_room, view_rays

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, write_png
from edge_depth_nerf.cameras import KannalaBrandt, calibration_file
from edge_depth_nerf.cameras.calibration_file import read_lens
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.entry import main
from edge_depth_nerf.mono.examples import scaled_lens
from edge_depth_nerf.mono.fisheye import fisheye_depth
from edge_depth_nerf.mono.options import FisheyeDepthOptions
from edge_depth_nerf.mono.pinhole_views import pinhole_views
from edge_depth_nerf.process.rig_file import RigCamera

pytestmark = pytest.mark.slow

LENS = scaled_lens(FISHEYE, (160, 160))
FOUND = rays(LENS, np.radians(95.0))
TRUTH = np.where(FOUND.within, in_a_room(FOUND.directions.astype(np.float64)), 0)
VIEWS = pinhole_views(LENS, np.radians(95.0))


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two pictures, whose colours say where rays go, and the lens."""
    shown = np.where(FOUND.within[..., None], np.rint(127.5 + 127.5 * FOUND.directions), 0).astype(np.uint8)
    for name in ("a", "b"):
        write_png(tmp_path / "pictures" / f"{name}.png", shown)
    (tmp_path / "pictures" / "._a.png").write_bytes(b"of macOS")
    keys = {"model": "opencv_fisheye", "cx": LENS.cx - 0.5, "cy": LENS.cy - 0.5}
    keys |= {key: getattr(LENS, key) for key in ("width", "height", "fx", "fy", "k1", "k2", "k3", "k4")}
    (tmp_path / "lens.toml").write_text("".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items()))
    return tmp_path


def options(folder: Path, **more: Any) -> FisheyeDepthOptions:
    return FisheyeDepthOptions(folder / "pictures", folder / "lens.toml", folder / "out", **more)


def run(folder: Path, **more: Any) -> Path:
    return fisheye_depth(options(folder, **more), Console(quiet=True))


def write_maps(folder: Path, kind: str, along: str = "z", suffix: str = ".npy") -> Path:
    """Write exact maps of all views; of an unknown scale, each view has its own scale and shift."""
    rng = np.random.default_rng(5)
    (folder / "maps").mkdir(exist_ok=True)
    for picture in ("a", "b"):
        for number, view in enumerate(VIEWS):
            seen = view_rays(view)
            depth = in_a_room(seen) * (seen @ view.view_to_camera[:, 2] if along == "z" else 1)
            scale, shift = rng.uniform(0.3, 3), rng.uniform(0.1, 1)
            said = {"metric": depth, "relative": scale * depth + 5 * shift, "inverse": scale / depth + 0.2 * shift}
            path = folder / "maps" / f"{picture}_{number}{suffix}"
            if suffix == ".npy":
                np.save(path, said[kind].astype(np.float32))
            else:
                write_png(path, np.rint(said[kind] * 1000).astype(np.uint16))
    return folder / "maps"


def check(found: np.ndarray) -> None:
    """Hold a map against the truth, up to one scale for all of it unless it is metric."""
    assert (found[~FOUND.within] == 0).all() and (found > 0).sum() > 0.97 * FOUND.within.sum()
    ratio = found[found > 0] / TRUTH[found > 0]
    error = np.abs(ratio / np.median(ratio) - 1)
    assert error.mean() < 0.005 and np.quantile(error, 0.99) < 0.03


def test_the_views_are_those_of_the_lens(folder):
    out = run(folder)
    about = read_json(out / "views.json")
    assert len(about["views"]) == len(VIEWS) == 7
    assert len(list((out / "views").iterdir())) == 14
    for number, (view, said) in enumerate(zip(VIEWS, about["views"], strict=True)):
        shown = read_image(out / "views" / f"b_{number}.png")
        assert shown.shape == (said["height"], said["width"], 3)
        # its middle, of an even number of pixels, looks along the view's axis as the file says it
        axis = np.array(said["view_to_camera"])[:, 2]
        middle = shown[view.height // 2 - 1 : view.height // 2 + 1, view.width // 2 - 1 : view.width // 2 + 1]
        assert np.abs(middle.mean((0, 1)) - (127.5 + 127.5 * axis)).max() < 4


@pytest.mark.parametrize(("kind", "along"), [("metric", "z"), ("metric", "ray"), ("relative", "z"), ("inverse", "z")])
def test_maps_of_the_views_become_distances(folder, kind, along):
    out = run(folder, maps=write_maps(folder, kind, along), maps_kind=kind, maps_along=along)
    for name in ("a", "b"):
        path = out / "distance" / name
        found = read_distance_png(path.with_suffix(".png")) if kind == "metric" else np.load(path.with_suffix(".npy"))
        check(found)
        median = np.median(TRUTH[TRUTH > 0]) if kind == "metric" else 1
        assert np.median(found[found > 0]) == pytest.approx(median, 0.02)
        assert read_image(out / "coloured" / f"{name}.png").shape == (160, 320, 3)


def test_pngs_need_their_unit(folder):
    maps = write_maps(folder, "metric", suffix=".png")
    with pytest.raises(InputError, match="Give --metres-per-count"):
        run(folder, maps=maps, maps_kind="metric")
    found = read_distance_png(run(folder, maps=maps, maps_kind="metric", metres_per_count=0.001) / "distance/a.png")
    check(found)
    assert np.abs(found - TRUTH)[found > 0].mean() < 0.05


def test_what_is_there_stays_unless_its_map_is_newer(folder):
    maps = write_maps(folder, "inverse")
    out = run(folder, maps=maps, maps_kind="inverse")
    before = {path: path.stat().st_mtime_ns for path in (out / "distance").iterdir()}
    np.save(maps / "b_0.npy", np.load(maps / "b_0.npy"))
    run(folder, maps=maps, maps_kind="inverse")
    changed = {path.name for path, time in before.items() if path.stat().st_mtime_ns != time}
    assert changed == {"b.npy"}
    with pytest.raises(InputError, match=r"distance: holds other maps \(kind differs\)"):
        run(folder, maps=maps, maps_kind="relative")
    with pytest.raises(InputError, match=r"out: holds other views \(theta_max_deg differs\)"):
        run(folder, theta_max_deg=80.0)


def test_a_mask_hides_pixels_and_a_view_may_have_no_value(folder):
    mask = np.full((160, 160), 255, np.uint8)
    mask[100:] = 0
    write_png(folder / "mask.png", mask)
    given = {"maps": write_maps(folder, "relative"), "maps_kind": "relative"}
    found = np.load(run(folder, **given, mask=folder / "mask.png") / "distance/a.npy")
    assert (found[100:] == 0).all() and (found[:100][FOUND.within[:100]] > 0).mean() > 0.97
    mask[60:] = 0
    write_png(folder / "mask.png", mask)
    found = np.load(run(folder, **given, mask=folder / "mask.png") / "distance/a.npy")
    assert (found[60:] == 0).all() and found[:60].any()
    shutil.rmtree(folder / "out")
    np.save(folder / "maps/a_3.npy", np.full((VIEWS[0].height, VIEWS[0].width), np.nan, np.float32))
    found = np.load(run(folder, **given) / "distance/a.npy")
    ratio = found[found > 0] / TRUTH[found > 0]
    assert 0.7 < (found > 0).sum() / FOUND.within.sum() < 1
    assert np.abs(ratio / np.median(ratio) - 1).mean() < 0.005


def no_number(folder: Path) -> None:
    for path in (folder / "maps").glob("b_*"):
        np.save(path, np.full(np.load(path).shape, np.nan))


def no_picture(folder: Path) -> None:
    for path in (folder / "pictures").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (lambda folder: (folder / "maps/b_4.npy").unlink(), r"b_4\.npy: no such file, nor b_4\.png"),
        (
            lambda folder: np.save(folder / "maps/a_1.npy", np.ones((20, 30), np.float32)),
            rf"a_1\.npy: is 30×20 \(width × height\), its picture a_1 {VIEWS[1].width}×{VIEWS[1].height}",
        ),
        (no_number, r"b_0\.npy: contains no positive number, .*, and so do those of the picture's other views"),
        (lambda folder: (folder / "lens.toml").unlink(), r"lens\.toml: no such file\. --calibration names"),
        (
            lambda folder: (folder / "lens.toml").write_text("model = 'fisheye'\n"),
            r"lens\.toml: camera: model is 'fisheye', expected one of mei, kannala-brandt",
        ),
        (
            lambda folder: write_png(folder / "pictures/b.png", np.zeros((120, 160, 3), np.uint8)),
            r"b\.png: .*160.*120",
        ),
        (lambda folder: (folder / "pictures/b.webp").write_bytes(b""), r"several pictures b\. Keep one"),
        (no_picture, r"has no picture; expected files that end in \.png"),
    ],
)
def test_what_is_wrong_is_named(folder, spoil, expected):
    maps = write_maps(folder, "inverse")
    spoil(folder)
    with pytest.raises((InputError, FileNotFoundError), match=expected):
        run(folder, maps=maps, maps_kind="inverse")


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"maps": Path("m")}, "--maps and --maps-kind: give both"),
        ({"maps": Path("m"), "maps_kind": "metric", "hf": "x"}, "expected one source"),
        ({"maps": Path("m"), "maps_kind": "inverse", "maps_along": "ray"}, "nothing tells the maps' shift"),
        ({"hf_output": "metric"}, "is for --hf"),
        ({"theta_max_deg": 0.0}, "--theta-max-deg 0: expected"),
        ({"metres_per_count": -1.0}, "--metres-per-count -1: expected"),
    ],
)
def test_options_that_cannot_be_used(folder, given, expected):
    with pytest.raises(InputError, match=expected):
        run(folder, **given)


def test_a_rig_file_names_the_lens(tmp_path):
    """Its pixels count from the first one's centre; a model with a place of its own for the centre, and its limit."""
    lens = kitti_360("image_02")
    numbers = {key: getattr(lens, key) for key in ("fx", "fy", "xi", "k1", "k2", "p1", "p2", "width", "height")}
    text = "".join(f"{key} = {value}\n" for key, value in numbers.items())
    text = f"[cameras.left]\nmodel = 'mei'\nimages = 'left'\n{text}cx = {lens.cx}\ncy = {lens.cy}\n"
    (tmp_path / "rig.toml").write_text(text + "pixel_centre = 0.5\ntheta_max_deg = 95\n[poses]\nfile = 'poses.txt'\n")
    assert read_lens(tmp_path / "rig.toml", "left") == dataclasses.replace(lens, theta_limit_rad=np.radians(95.0))
    with pytest.raises(InputError, match=r"no camera 'right'; it has left\. Name one: --camera left"):
        read_lens(tmp_path / "rig.toml", "right")


@pytest.mark.parametrize(
    ("given", "wrong", "said"),
    [
        ("k1 = 0.01", "kl = 0.01", "kl: unknown key; docs/rig.md"),
        ("k1 = 0.01", "k5 = 0.01", "k5: unknown key; .* undistort the pictures"),
        ("k1 = 0.01", "xi = 0.01", r"\.xi: unknown key; a camera of model kannala-brandt has k1, k2, k3, k4"),
        ("cx = 63.5", "cx = 6350", r"\.cx is 6350\.0, expected a pixel within the picture, 0 to 128"),
        ("width = 128", "width = 128.5", "expected whole numbers"),
        ("k1", "pixel_centre = 7\nk1", r"\.pixel_centre is 7\.0, expected one of"),
        ("k1", "theta_max_deg = -10\nk1", "theta_max_deg -10: expected more than 0"),
    ],
)
def test_a_table_of_a_lens_is_checked_as_a_rig_file_is(tmp_path, given, wrong, said):
    text = "model = 'kannala-brandt'\nwidth = 128\nheight = 128\nfx = 40\nfy = 40\ncx = 63.5\ncy = 63.5\nk1 = 0.01\n"
    path = tmp_path / "lens.toml"
    path.write_text(text)
    assert read_lens(path) == KannalaBrandt(128, 128, 40.0, 40.0, 64.0, 64.0, 0.01, 0.0, 0.0, 0.0)
    path.write_text(text.replace(given, wrong))
    with pytest.raises(InputError, match=rf"lens\.toml.*{said}"):
        read_lens(path)


def test_keys_of_a_rig_file_are_known_where_its_lenses_are_read():
    known = (*calibration_file.LENS, *calibration_file.LENS_NUMBERS, *calibration_file.LENS_PLACE)
    assert sorted((*known, *calibration_file.BESIDE_LENS)) == sorted(RigCamera.model_fields)


def test_a_lens_that_the_views_cannot_be_cut_with_is_refused(folder):
    sheared = "3 -60 0 0.002\n1 0\n80 80\n1 0 0.2\n160 160\n"
    (folder / "calib_results.txt").write_text(sheared)
    with pytest.raises(
        InputError, match=r"calib_results.txt: a Kannala.* OCAM lens by 8.* px: expected at most 0\.5 px"
    ):
        fisheye_depth(FisheyeDepthOptions(folder / "pictures", folder / "calib_results.txt", folder / "out"))


def test_the_command_with_a_ready_made_network(folder, monkeypatch, capsys):
    transformers = pytest.importorskip("transformers")
    ones, eights = [1, 1, 1, 1], [8, 8, 8, 8]
    config = transformers.GLPNConfig(
        depths=ones, hidden_sizes=eights, decoder_hidden_size=8, num_attention_heads=ones, sr_ratios=ones, max_depth=40
    )
    transformers.GLPNForDepthEstimation(config).save_pretrained(folder / "network")
    transformers.GLPNImageProcessor().save_pretrained(folder / "network")
    words = f"edge-depth-nerf fisheye-depth {folder}/pictures --calibration {folder}/lens.toml --output {folder}/out"
    monkeypatch.setattr(sys, "argv", shlex.split(f"{words} --hf {folder}/network"))
    main()
    found = read_distance_png(folder / "out/distance/b.png")
    assert (found[FOUND.within] > 0).mean() > 0.97 and (found[~FOUND.within] == 0).all()
    assert "2 distance maps (metres" in capsys.readouterr().out
    weights = folder / "network/model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4] + bytes(4))
    with pytest.raises(InputError, match=r"distance: holds other maps \(weights differs\)"):
        fisheye_depth(
            FisheyeDepthOptions(folder / "pictures", folder / "lens.toml", folder / "out", hf=str(folder / "network"))
        )
