"""Monocular maps by file: formats, units, z and distance, unknown scale, and everything that can be wrong with them."""

import dataclasses
import shutil
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenes import FLIP, fisheye, pinhole, transforms, view, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json, write_distance_png, write_png
from edge_depth_nerf.entry import main
from edge_depth_nerf.mono.estimate import estimate_depth
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.scene.reader import ScenePicture, read_scene

pytestmark = pytest.mark.slow

LENS = fisheye(48, 44)


def true_distance(picture: ScenePicture) -> tuple[np.ndarray, np.ndarray]:
    """Distance inside the ball, and the cosine of each ray to the axis, in float64; 0 outside the lens."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = picture.rotation @ FLIP[:3, :3], picture.position_m
    _, distance, cosine = view(picture.lens, pose)
    return distance, cosine


def write_maps(scene: Path, folder: Path, make: Any, suffix: str = ".npy", metres_per_count: float = 1 / 256) -> Path:
    """Write FOLDER/images/0000.npy and so on; `make` gets the picture, its distance and its cosine."""
    for picture in read_scene(scene).pictures:
        values = make(picture, *true_distance(picture))
        path = folder / "images" / f"{Path(picture.name).stem}{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == ".npy":
            np.save(path, values)
        else:
            write_png(path, np.rint(values / metres_per_count).clip(0, 65535).astype(np.uint16))
    return folder


def take(scene: Path, maps: Path, kind: Any = "metric", along: Any = "ray", **more: Any) -> None:
    estimate_depth(EstimateDepthOptions((scene,), maps=maps, maps_kind=kind, maps_along=along, **more))


def error(scene: Path) -> np.ndarray:
    """Largest relative error of each map where it has values, in order of names."""
    found = []
    for picture in read_scene(scene).pictures:
        written = read_distance_png(picture.files["mono"])
        truth, _ = true_distance(picture)
        kept = written > 0
        assert kept.mean() > 0.2
        found.append((np.abs(written - truth)[kept] / truth[kept]).max())
    return np.array(found)


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    return write_scene(tmp_path_factory.mktemp("written") / "scene", [LENS], frames=7, mono=False)


@pytest.fixture
def scene(written, tmp_path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "scene"))


def test_metric_distances_are_taken_as_they_are(scene, tmp_path):
    types = (np.float16, np.float32, ">f8")

    def make(picture, distance, cosine):
        """With a channel first or last, too, and in another order."""
        values = np.asfortranarray(distance)[None] if picture.held_out else distance[..., None]
        return (values if picture.frame > 2 else distance).astype(types[picture.frame % 3])

    maps = write_maps(scene, tmp_path / "maps", make)
    before = read_json(scene / "transforms.json")
    take(scene, maps)
    assert error(scene).max() < 2e-3
    meta = read_json(scene / "transforms.json")
    source = {"kind": "files", "trained_on": "elsewhere", "folder": "maps", "output": "metric", "along": "ray"}
    assert meta["mono"] == source
    assert (scene / "mono_trust.json").is_file()
    for entry, old in zip(meta["frames"], before["frames"], strict=True):
        assert entry.pop("mono_file_path").startswith("mono/images/")
        assert entry == old


def test_pngs_have_their_own_unit(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, distance, c: distance, ".png", 0.001)
    with pytest.raises(InputError, match=r"Give --metres-per-count"):
        take(scene, maps)
    take(scene, maps, metres_per_count=0.001)
    assert error(scene).max() < 4e-3


def test_z_becomes_distance_and_is_none_beyond_90_degrees(tmp_path):
    # up to 117° in its corners
    lens = dataclasses.replace(LENS, fx=14.0, fy=14.0)
    scene = write_scene(tmp_path / "scene", [lens], frames=5, mono=False, mask=False)
    # what a z map holds beyond 90° is garbage, here a plausible number
    maps = write_maps(scene, tmp_path / "maps", lambda p, distance, c: np.where(c > 0, distance * c, 3.0))
    take(scene, maps, along="z")
    assert error(scene).max() < 2e-3
    for picture in read_scene(scene).pictures:
        _, cosine = true_distance(picture)
        written = read_distance_png(picture.files["mono"])
        assert (cosine < 0).sum() > 50 and (written[cosine < 0.02] == 0).all()
        assert (written[(cosine > 0.03) & (cosine < 0.3)] > 0).mean() > 0.8


def test_a_z_map_of_a_pinhole(tmp_path):
    scene = write_scene(tmp_path / "scene", [pinhole(48, 44)], frames=3, mono=False, mask=False)
    take(scene, write_maps(scene, tmp_path / "maps", lambda p, distance, c: distance * c), along="z")
    assert error(scene).max() < 2e-3


def test_z_needs_the_cameras_intrinsics(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, distance, c: distance * c)
    with transforms(scene) as meta:
        for entry in meta["frames"]:
            del entry["fl_x"]
    with pytest.raises(InputError, match=r"transforms.json: images/0000.png: fl_x is None, expected a number"):
        take(scene, maps, along="z")


@pytest.mark.parametrize(("kind", "along"), [("relative", "z"), ("inverse", "ray")])
def test_maps_of_unknown_scale_are_fitted_to_the_frames_own_lidar(scene, tmp_path, kind, along):
    def make(picture, distance, cosine):
        rng = np.random.default_rng(picture.frame)
        depth = np.maximum(distance * cosine, 1e-3) if along == "z" else np.maximum(distance, 1e-3)
        scale, shift = rng.uniform(0.1, 10), rng.uniform(0.5, 2)
        return scale * depth + shift if kind == "relative" else scale / depth + 0.1 * shift

    # a tenth of the returns is wrong
    for picture in read_scene(scene).pictures:
        lidar = read_distance_png(picture.files["lidar"])
        rng = np.random.default_rng(100 + picture.frame)
        wrong = (lidar > 0) & (rng.random(lidar.shape) < 0.1)
        lidar[wrong] *= rng.uniform(0.2, 5, wrong.sum())
        write_distance_png(picture.files["lidar"], lidar)
    take(scene, write_maps(scene, tmp_path / "maps", make), kind, along)
    assert error(scene).max() < 0.02


def test_pngs_of_unknown_scale_need_no_unit(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: 60000 * 0.5 / np.maximum(d, 0.5), ".png", 1.0)
    take(scene, maps, "inverse")
    assert error(scene).max() < 0.02


def test_frames_with_few_points_take_the_drives_fit_and_it_is_said(scene, tmp_path, monkeypatch, capsys):
    # 0004 is held out
    odd = {"0002": 0, "0006": 30}
    for stem, count in odd.items():
        lidar = read_distance_png(scene / f"lidar/{stem}.png").ravel()
        lidar[np.flatnonzero(lidar)[count:]] = 0
        write_distance_png(scene / f"lidar/{stem}.png", lidar.reshape(44, 48))

    def make(picture, distance, cosine):
        return (5.0 if picture.held_out else 2.0) * distance + 1.0

    maps = write_maps(scene, tmp_path / "maps", make)
    command = ["estimate-depth", str(scene), "--maps", str(maps), "--maps-kind", "relative", "--maps-along", "ray"]
    monkeypatch.setattr(sys, "argv", ["edge-depth-nerf", *command])
    main()
    assert error(scene).max() < 0.02
    said = " ".join(capsys.readouterr().out.split())
    assert "2 of 7 pictures have fewer than 50 LiDAR points to fit to, such as images/0002.png" in said


def test_unknown_scale_without_lidar_is_an_error_and_metric_is_none(tmp_path):
    scene = write_scene(tmp_path / "scene", [LENS], frames=3, lidar=False, mono=False)
    maps = write_maps(scene, tmp_path / "maps", lambda p, distance, c: distance)
    with pytest.raises(InputError, match="no training picture of images has 50 LiDAR points"):
        take(scene, maps, "relative")
    take(scene, maps)
    assert error(scene).max() < 2e-3


def test_values_that_are_no_distance_are_none(scene, tmp_path):
    bad = np.array([np.nan, np.inf, -np.inf, -2.0, 0.0, 1e38, 201.0])

    def make(picture, distance, cosine):
        distance[20, 20 : 20 + len(bad)] = bad
        return distance

    take(scene, write_maps(scene, tmp_path / "maps", make), maps_trained_on="scene")
    # the maker may have seen LiDAR alone
    assert read_json(scene / "transforms.json")["mono"]["trained_on"] == "scene"
    pictures = read_scene(scene).pictures
    assert pictures
    for picture in pictures:
        written = read_distance_png(picture.files["mono"])
        assert (written[20, 20 : 20 + len(bad)] == 0).all() and (written[18, 20 : 20 + len(bad)] > 0).all()


@pytest.mark.parametrize(("which", "fill"), [("one", 0.0), ("every", np.nan)])
def test_a_map_without_a_distance_is_named_and_nothing_is_written(scene, tmp_path, fill, which):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: np.full_like(d, fill) if which == "every" else d)
    np.save(maps / "images/0005.npy", np.full((44, 48), fill))
    before = (scene / "transforms.json").read_bytes()
    name = "0005" if which == "one" else "0000"
    with pytest.raises(InputError, match=rf"{name}.npy: contains no positive number, only zeros, negative .*NaN"):
        take(scene, maps)
    assert (scene / "transforms.json").read_bytes() == before
    assert not list(scene.glob("mono*")) and not list(scene.glob(".mono*"))


def test_a_map_in_another_unit_has_nothing_in_range(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: 1000 * np.maximum(d, 1))
    with pytest.raises(InputError, match=r"0000.png: its monocular map has no distance between 0 and 200 m .*metres"):
        take(scene, maps)


def header_of(shape: str, dtype: str = "<f4") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


BROKEN_ARRAYS = [
    (header_of("(44, 48)") + bytes(100), r"truncated: 100 bytes of numbers for a shape of \(44, 48\)"),
    (header_of("(4400000, 4800000)") + bytes(100), "truncated"),
    (header_of("(44, 48)", "|O") + bytes(9000), "holds object, expected float16"),
    (header_of("(44, 48)", "<i4") + bytes(9000), "holds int32, expected float16"),
    (header_of("(44, 48, 3)") + bytes(99000), r"its shape is \(44, 48, 3\), expected height × width"),
    (header_of("(2112,)") + bytes(9000), r"its shape is \(2112,\)"),
    (header_of("(0, 48)") + bytes(9000), r"its shape is \(0, 48\)"),
    (header_of("(48, 44)") + bytes(8448), "is 44×48 .width × height., its picture images/0003.png 48×44"),
    (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535, "cannot be read as an array"),
    (b"PK\x03\x04" + bytes(500), "cannot be read as an array"),
    (b"", "cannot be read as an array"),
]


def test_broken_arrays_are_named_before_any_work(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: d)
    with pytest.raises(InputError, match=r"--metres-per-count 0.001: is for PNGs"):
        take(scene, maps, metres_per_count=0.001)
    # read first, were the headers not looked at before
    np.save(maps / "images/0000.npy", np.zeros((44, 48)))
    for content, expected in BROKEN_ARRAYS:
        (maps / "images/0003.npy").write_bytes(content)
        with pytest.raises(InputError, match=rf"0003.npy: .*{expected}"):
            take(scene, maps)


def test_broken_pngs_are_named_before_any_work(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: d, ".png")
    path = maps / "images/0003.png"
    whole = path.read_bytes()

    def is_refused(expected: str) -> None:
        with pytest.raises(InputError, match=f"0003.png: {expected}"):
            take(scene, maps, metres_per_count=1 / 256)

    write_png(path, np.zeros((44, 48), np.uint8))
    is_refused("8-bit grey, expected a 16-bit grey PNG")
    write_png(path, np.ones((22, 24), np.uint16))
    is_refused("is 24×22 .width × height., its picture images/0003.png 48×44")
    path.write_bytes(whole[:-30])
    is_refused("truncated")


def test_missing_and_double_maps_are_named(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: d)
    write_distance_png(maps / "images/0001.png", np.ones((44, 48)))
    with pytest.raises(InputError, match=r"0001.npy: 0001.png exists as well"):
        take(scene, maps)
    (maps / "images/0001.png").unlink()
    (maps / "images/0001.npy").unlink()
    with pytest.raises(FileNotFoundError, match=r"0001.npy: no such file, nor 0001.png. --maps needs a map for every"):
        take(scene, maps)
    with pytest.raises(FileNotFoundError, match=r"nowhere: no such folder"):
        take(scene, tmp_path / "nowhere")


METRIC_Z = {"maps": Path("m"), "maps_kind": "metric", "maps_along": "z"}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"hf": "x", "maps": Path("m")}, "--hf and --maps: expected one source"),
        (
            {"hf": "x", "train_steps": 5, "seconds": 1.0},
            "--train-steps, --seconds: for a network of our own, .* from --hf",
        ),
        ({"hf": "x", "model": Path("w.safetensors")}, "--model: for a network of our own"),
        ({"hf": "x", "preset": "full"}, "--preset: for a network of our own"),
        ({"hf_output": "metric"}, "--hf-output: for --hf, but the maps come from a network of our own"),
        ({"hf": "x", "maps_kind": "metric"}, "--maps-kind: for --maps, but the maps come from --hf"),
        ({"maps_along": "z", "metres_per_count": 0.1}, "--maps-along, --metres-per-count: for --maps"),
        ({"maps": Path("m")}, "describe its values with --maps-kind"),
        ({"maps": Path("m"), "maps_kind": "metric"}, "--maps-along ray or z"),
        ({"maps": Path("m"), "seconds": 3.0}, "--seconds: for a network of our own, but the maps come from --maps"),
        ({**METRIC_Z, "metres_per_count": -1.0}, "--metres-per-count -1: expected more than 0"),
        ({**METRIC_Z, "scenes": (Path("a"), Path("b"))}, "contains the maps of one scene, but 2 scenes are given"),
    ],
)
def test_options_that_do_not_go_together(options: Any, expected: str):
    with pytest.raises(InputError, match=expected):
        EstimateDepthOptions(**dict[str, Any](scenes=(Path("a"),)) | options).check()


def test_arrays_are_in_metres(scene, tmp_path):
    maps = write_maps(scene, tmp_path / "maps", lambda p, d, c: d)
    with pytest.raises(InputError, match=r"--metres-per-count 0.001: is for PNGs"):
        take(scene, maps, metres_per_count=0.001)
