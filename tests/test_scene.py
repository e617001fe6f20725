"""The scene folder's writer, and what it uses: PNG headers, smaller maps, the point cloud."""

import functools
import json
import math
import os
import platform
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console
from scenes import tree
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    read_distance_png,
    read_image,
    read_json,
    read_mask,
    write_distance_png,
    write_mask,
    write_png,
)
from edge_depth_nerf.base.png import read_png_bytes, read_png_header
from edge_depth_nerf.cameras import (
    MEI,
    Camera,
    KannalaBrandt,
    Pinhole,
    fit_kannala_brandt,
    host_residual,
)
from edge_depth_nerf.cameras.transforms import check_rigid, opencv_to_opengl
from edge_depth_nerf.process.reading import downscale_distance, downscale_image, downscale_mask
from edge_depth_nerf.scene import points as points_module
from edge_depth_nerf.scene import writer as scene
from edge_depth_nerf.scene.points import PointCloud
from edge_depth_nerf.scene.writer import (
    FrameContent,
    ProcessReport,
    SceneCamera,
    SceneFrame,
    ShiftedView,
    best_holdout,
    held_out_frames,
    write_scene,
)

SIZE = 32
FISHEYE = MEI(SIZE, SIZE, 30.5, 30.5, 16.4, 16.1, 2.2134, 0.0168, 1.6549, 4e-4, 4e-4)
POLYNOMIAL = KannalaBrandt(SIZE, SIZE, 9.5, 9.5, 16.4, 16.1, 0.01, -0.002, 0.0, 0.0)
PINHOLE = Pinhole(SIZE, SIZE, 20.0, 20.0, 16.4, 16.1, 0.01, 0.0, 1e-3, 0.0)
QUIET = Console(quiet=True)


@pytest.fixture(autouse=True)
def fit_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene, "fit_kannala_brandt", _FIT_ONCE)
    monkeypatch.setattr(scene, "host_residual", _RESIDUAL_ONCE)


_FIT_ONCE = functools.cache(fit_kannala_brandt)
_RESIDUAL_ONCE = functools.cache(host_residual)


def pose(index: int) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.from_euler("y", 0.3 * index).as_matrix()
    found[:3, 3] = [1000.4 + index, -250.0, 116.2]
    return found


def content(index: int, rng_seed: int = 0) -> FrameContent:
    rng = np.random.default_rng((rng_seed, index))
    rows = rng.integers(8, 24, (40, 2))
    return FrameContent(
        image=rng.integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8),
        lidar=np.where(rng.random((SIZE, SIZE)) < 0.2, rng.uniform(1, 60, (SIZE, SIZE)), 0),
        mono=rng.uniform(1, 60, (SIZE, SIZE)),
        cloud=PointCloud(
            pose(index)[:3, 3] + rng.uniform(-20, 20, (40, 3)), rng.integers(0, 256, (40, 3), dtype=np.uint8), rows
        ),
    )


def frames(count: int = 6, load: Callable[[int], FrameContent] | None = None) -> list[SceneFrame]:
    made = [content(index) if load is None else functools.partial(load, index) for index in range(count)]
    return [
        SceneFrame("image_02", index, pose(index), made[index], timestamp_s=1369730000.5 + index, held_out=held_out)
        for index, held_out in enumerate(held_out_frames(count, 8))
    ]


def write(
    output: Path,
    camera: Camera = FISHEYE,
    given: list[SceneFrame] | None = None,
    mask: np.ndarray | None = None,
    **options: Any,
) -> ProcessReport:
    options = {"layers": ("lidar", "mono", "cloud"), "source": {"kind": "test"}, "console": QUIET, **options}
    cameras = options.pop("cameras", [SceneCamera("image_02", camera, mask)])
    return write_scene(output, cameras, frames() if given is None else given, **options)


# ---- the format ------------------------------------------------------------------------------------------------
def test_writes_what_nerfstudio_and_this_project_read(tmp_path: Path) -> None:
    report = write(tmp_path / "scene")
    meta = read_json(tmp_path / "scene/transforms.json")
    assert meta["camera_model"] == "OPENCV_FISHEYE"
    assert meta["depth_unit_scale_factor"] == 1 / 256
    assert meta["theta_max_deg"] == 95.0
    assert meta["ply_file_path"] == "points.ply"
    assert meta["source"]["kind"] == "test"
    assert meta["original_cameras"]["image_02"] == FISHEYE.to_dict()
    names = [f"images/image_02/{index:010d}.png" for index in range(6)]
    assert [frame["file_path"] for frame in meta["frames"]] == names
    assert meta["val_filenames"] == meta["test_filenames"] == [names[4]]
    assert meta["train_filenames"] == [*names[:4], names[5]]
    frame = meta["frames"][3]
    assert frame["camera"] == "image_02" and frame["frame"] == 3 and frame["timestamp_s"] == 1369730003.5
    assert frame["mask_path"] == "masks/image_02.png"
    assert frame["depth_file_path"] == frame["lidar_file_path"] == "lidar/image_02/0000000003.png"
    assert frame["mono_file_path"] == "mono/image_02/0000000003.png"
    assert (frame["w"], frame["h"]) == (SIZE, SIZE)
    for entry in meta["frames"]:
        for key, value in entry.items():
            if key.endswith("_path"):
                assert (tmp_path / "scene" / value).is_file()
    assert (report.training, report.held_out, report.written) == (5, 1, 6)

    given = content(3)
    mask = read_mask(tmp_path / "scene/masks/image_02.png")
    assert np.array_equal(read_image(tmp_path / "scene" / frame["file_path"]), np.asarray(given.image))
    lidar, mono = (read_distance_png(tmp_path / "scene" / frame[f"{key}_file_path"]) for key in ("lidar", "mono"))
    assert not lidar[~mask].any()
    np.testing.assert_allclose(lidar[mask], np.asarray(given.lidar)[mask], atol=1 / 512 + 1e-6)
    np.testing.assert_allclose(mono, np.asarray(given.mono), atol=1 / 512 + 1e-6)


def test_fitted_camera_sees_what_the_original_sees(tmp_path: Path) -> None:
    report = write(tmp_path / "scene")
    meta = read_json(tmp_path / "scene/transforms.json")
    frame = meta["frames"][0]
    fitted = KannalaBrandt(
        SIZE, SIZE, *(frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2"))
    )
    directions, valid = FISHEYE.unproject(FISHEYE.pixel_centres())
    valid &= torch.from_numpy(read_mask(tmp_path / "scene/masks/image_02.png"))
    distance = (fitted.project(directions[valid])[0] - FISHEYE.pixel_centres()[valid]).norm(dim=-1)
    fit = meta["camera_fits"]["image_02"]
    assert distance.max() <= fit["max_px"] + 1e-5 < 0.05
    assert fit["rms_px"] == pytest.approx(report.fits["image_02"].rms_px, abs=1e-6)
    assert fit["theta_max_deg"] == pytest.approx(95.0)


def test_a_point_lands_on_the_same_pixel_by_opengl_pose_and_offset(tmp_path: Path) -> None:
    """The chain written out: scene = world - offset; OpenGL's camera looks along -z with y up."""
    write(tmp_path / "scene")
    meta = read_json(tmp_path / "scene/transforms.json")
    offset = np.array(meta["world_offset_m"])
    # mean of 1000.4 … 1005.4 is 1002.9
    assert offset.tolist() == [1003.0, -250.0, 116.0]
    point = np.array([1.3, -0.7, 4.0])
    for index, frame in enumerate(meta["frames"]):
        world = pose(index)[:3, :3] @ point + pose(index)[:3, 3]
        x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ np.append(world - offset, 1)
        np.testing.assert_allclose([x, -y, -z], point, atol=1e-9)


def test_mask_is_lens_circle_and_own_mask(tmp_path: Path) -> None:
    own = np.ones((SIZE, SIZE), bool)
    own[20:] = False
    report = write(tmp_path / "scene", mask=own, theta_max_deg=40.0)
    mask = read_mask(tmp_path / "scene/masks/image_02.png")
    directions, _ = FISHEYE.unproject(FISHEYE.pixel_centres())
    theta = np.degrees(np.arctan2(directions[..., :2].norm(dim=-1).numpy(), directions[..., 2].numpy()))
    assert np.array_equal(mask, own & (theta <= 40))
    assert report.mask_share["image_02"] == mask.mean()


@pytest.mark.parametrize("theta_max_deg", [1.0, 30.0, 80.0, 95.0, 110.0, 180.0])
@pytest.mark.parametrize(
    "camera",
    [
        *(FISHEYE, POLYNOMIAL, PINHOLE),
        # folds at 42°, within the picture
        Pinhole(SIZE, SIZE, 9.0, 11.0, 16.5, 3.0, -0.4, 0.0, 1e-2, -2e-2),
        # nearly all of the sphere in the picture, off its middle
        MEI(40, 24, 14.0, 12.0, 25.0, 10.0, 2.5, 0.05, 4.5, 1e-2, -1e-2),
    ],
)
def test_lens_circle_is_where_rays_are_within_the_limit(camera: Camera, theta_max_deg: float) -> None:
    directions, valid = camera.unproject(camera.pixel_centres())
    theta = np.degrees(np.arctan2(directions[..., :2].norm(dim=-1).numpy(), directions[..., 2].numpy()))
    circle = scene.lens_circle(camera, theta_max_deg)
    assert circle.shape == (camera.height, camera.width)
    assert np.array_equal(circle, valid.numpy() & (theta <= theta_max_deg))


def test_frame_masks_are_joined_with_the_cameras(tmp_path: Path) -> None:
    own = np.ones((SIZE, SIZE), bool)
    own[:, :9] = False
    given = frames()
    rng = np.random.default_rng(3)
    masks = [rng.random((SIZE, SIZE)) < 0.7 for _ in given]
    given = [
        replace(frame, content=replace(content(frame.frame), mask=mask))
        for frame, mask in zip(given, masks, strict=True)
    ]
    write(tmp_path / "scene", given=given, mask=own, layers=("lidar", "mask"))
    meta = read_json(tmp_path / "scene/transforms.json")
    camera_mask = read_mask(tmp_path / "scene/masks/image_02.png")
    assert masks
    for frame, mask in zip(meta["frames"], masks, strict=True):
        assert frame["mask_path"] == f"masks/image_02/{frame['frame']:010d}.png"
        joined = read_mask(tmp_path / "scene" / frame["mask_path"])
        assert np.array_equal(joined, camera_mask & mask)
        assert not read_distance_png(tmp_path / "scene" / frame["lidar_file_path"])[~joined].any()


def test_layers_that_are_not_given_leave_no_trace(tmp_path: Path) -> None:
    write(tmp_path / "scene", layers=("mono",))
    meta = read_json(tmp_path / "scene/transforms.json")
    assert "ply_file_path" not in meta and "shifted_views" not in meta
    for frame in meta["frames"]:
        assert not {"depth_file_path", "lidar_file_path", "truth_distance_file_path"} & frame.keys()
    assert sorted(path.name for path in (tmp_path / "scene").iterdir()) == [
        *("images", "masks", "mono", "process.json", "transforms.json")
    ]


@pytest.mark.parametrize("camera", [POLYNOMIAL, PINHOLE])
def test_cameras_that_nerfstudio_knows_are_not_fitted(tmp_path: Path, camera: KannalaBrandt | Pinhole) -> None:
    report = write(tmp_path / "scene", camera)
    meta = read_json(tmp_path / "scene/transforms.json")
    assert report.fits["image_02"].camera == camera
    assert report.fits["image_02"].max_px < 1e-6
    assert meta["camera_fits"]["image_02"]["rms_px"] == 0.0
    assert meta["camera_model"] == ("OPENCV" if camera is PINHOLE else "OPENCV_FISHEYE")
    for key, name in {"fl_x": "fx", "fl_y": "fy"}.items() | {
        key: key for key in ("cx", "cy", "k1", "k2", "p1", "p2")
    }.items():
        assert meta["frames"][0][key] == getattr(camera, name)


def test_principal_point_keeps_off_pixel_centres(tmp_path: Path) -> None:
    """nerfstudio's fisheye ray is NaN exactly at (cx, cy)."""
    for cx, cy, expected in ((16.5, 9.5, 16.501), (16.5, 9.4, 16.5), (16.4999, 9.5001, 16.501)):
        write(tmp_path / f"{cx} {cy}", replace(POLYNOMIAL, cx=cx, cy=cy))
        frame = read_json(tmp_path / f"{cx} {cy}/transforms.json")["frames"][0]
        assert (frame["cx"], frame["cy"]) == (expected, cy)


def test_without_held_out_frames_it_evaluates_on_the_training_frames(tmp_path: Path) -> None:
    report = write(tmp_path / "scene", given=frames(1))
    meta = read_json(tmp_path / "scene/transforms.json")
    assert meta["train_filenames"] == meta["val_filenames"] == ["images/image_02/0000000000.png"]
    assert (report.training, report.held_out) == (1, 0)


def test_shifted_views_and_truth(tmp_path: Path) -> None:
    given = []
    for frame in frames():
        truth = {"truth_distance": np.full((SIZE, SIZE), 7.0), "truth_rgb": content(frame.frame, 9).image}
        given.append(replace(frame, content=replace(content(frame.frame), **truth)))
    view = ShiftedView(
        2.0,
        "image_02",
        4,
        pose(4) @ pose(1),
        lambda: (np.full((SIZE, SIZE, 3), 9, np.uint8), np.full((SIZE, SIZE), 3.0)),
    )
    write(tmp_path / "scene", given=given, layers=("lidar", "truth_distance", "truth_rgb"), shifted=[view])
    meta = read_json(tmp_path / "scene/transforms.json")
    (found,) = meta["shifted_views"]["2"]
    assert (found["camera"], found["frame"]) == ("image_02", 4)
    expected = opencv_to_opengl(pose(4) @ pose(1))
    expected[:3, 3] -= meta["world_offset_m"]
    np.testing.assert_allclose(found["transform_matrix"], expected)
    assert found["truth_rgb_file_path"] == "truth/image_02/shifted_2m/rgb/0000000004.png"
    assert (read_distance_png(tmp_path / "scene" / found["truth_distance_file_path"]) == 3).all()
    frame = meta["frames"][1]
    assert (read_distance_png(tmp_path / "scene" / frame["truth_distance_file_path"]) == 7).all()
    truth = read_image(tmp_path / "scene" / frame["truth_rgb_file_path"])
    assert np.array_equal(truth, np.asarray(content(1, 9).image))


def test_files_are_copied_byte_by_byte_where_they_can_be(tmp_path: Path) -> None:
    plain, grey, other = tmp_path / "plain.png", tmp_path / "grey.png", tmp_path / "a.jpg"
    picture = content(0).image
    assert isinstance(picture, np.ndarray)
    # compressed otherwise than this project does
    cv2.imwrite(str(plain), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    write_png(grey, picture[..., 0])
    cv2.imwrite(str(other), picture)
    given = [replace(f, content=FrameContent(p)) for f, p in zip(frames(3), (plain, grey, other), strict=True)]
    write(tmp_path / "scene", given=given, layers=())
    images = tmp_path / "scene/images/image_02"
    assert (images / "0000000000.png").read_bytes() == plain.read_bytes()
    assert np.array_equal(read_image(images / "0000000001.png"), np.repeat(picture[..., :1], 3, -1))
    assert np.array_equal(read_image(images / "0000000002.png"), read_image(other))


# ---- points.ply ------------------------------------------------------------------------------------------------
def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    cloud = trimesh.load(path)
    assert isinstance(cloud, trimesh.PointCloud)
    return np.asarray(cloud.vertices), np.asarray(cloud.colors)[:, :3]


def test_cloud_is_of_training_frames_inside_the_mask(tmp_path: Path) -> None:
    own = np.ones((SIZE, SIZE), bool)
    own[:, 16:] = False
    write(tmp_path / "scene", mask=own)
    offset = np.array(read_json(tmp_path / "scene/transforms.json")["world_offset_m"])
    vertices, colours = read_ply(tmp_path / "scene/points.ply")
    mask = read_mask(tmp_path / "scene/masks/image_02.png")
    clouds = [content(index).cloud for index in (0, 1, 2, 3, 5)]
    used = [mask[cloud.pixels[:, 0], cloud.pixels[:, 1]] for cloud in clouds if cloud]
    points = np.concatenate([cloud.points_m[keep] for cloud, keep in zip(clouds, used, strict=True) if cloud]) - offset
    expected = np.concatenate([cloud.colours[keep] for cloud, keep in zip(clouds, used, strict=True) if cloud])
    assert 40 < len(points) < 160
    # so few points in so large a space hardly share a cube of 0.15 m
    assert len(points) - 3 <= len(vertices) <= len(points)
    distance = np.linalg.norm(vertices[:, None] - points, axis=-1)
    assert distance.min(1).max() < 1e-4
    assert np.array_equal(colours, expected[distance.argmin(1)])


def test_cloud_is_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(points_module, "MAX_POINTS", 50)
    # parts are merged before all are read
    monkeypatch.setattr(points_module, "_MERGE_AT", 30)
    write(tmp_path / "scene")
    assert 25 < len(read_ply(tmp_path / "scene/points.ply")[0]) <= 50


@given(st.integers(0, 2**31), st.floats(0.05, 3.0))
def test_one_point_of_each_cube(seed: int, voxel_m: float) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-4, 4, (300, 3)).astype(np.float32)
    part = points, rng.integers(0, 256, (300, 3), dtype=np.uint8)
    cells = {tuple(cell) for cell in np.floor(points / voxel_m).astype(int)}
    thinned, _ = points_module._thinned([part], voxel_m, 300)
    assert {tuple(cell) for cell in np.floor(thinned[0] / voxel_m).astype(int)} == cells
    assert len(thinned[0]) == len(cells)
    assert np.array_equal(points_module._thinned([thinned], voxel_m, 300)[0][0], thinned[0])


# ---- interrupted, and run again --------------------------------------------------------------------------------
@pytest.mark.slow
def test_interrupted_run_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    write(tmp_path / "whole", given=frames(load=content))

    loaded: list[int] = []
    lock = threading.Lock()

    def load(index: int, stop_at: int | None) -> FrameContent:
        with lock:
            loaded.append(index)
        if index == stop_at:
            raise KeyboardInterrupt
        if stop_at is not None and index > stop_at:
            # long enough that a busy machine hears of the stop before the one after it begins
            time.sleep(2)
        return content(index)

    output = tmp_path / "scene"
    with pytest.raises(KeyboardInterrupt):
        write(output, given=frames(load=functools.partial(load, stop_at=3)))
    # the next one may have begun
    assert loaded[:4] == [0, 1, 2, 3] and len(loaded) <= 5
    assert not (output / "transforms.json").exists()
    # what a killed process leaves
    (output / f"images/image_02/.0000000003.{platform.node()}~{2**22 + 1}~7.png").write_bytes(b"half")

    loaded.clear()
    report = write(output, given=frames(load=functools.partial(load, stop_at=None)))
    assert loaded in ([3, 4, 5], [3, 5])
    assert report.written == len(loaded)
    assert tree(output) == tree(tmp_path / "whole")
    assert write(output, given=frames(load=content)).written == 0


def test_what_is_missing_or_older_than_its_input_is_made_again(tmp_path: Path) -> None:
    inputs = [tmp_path / f"{index}.in" for index in range(6)]
    for path in inputs:
        path.write_text("x")
    loaded: set[int] = set()

    def load(index: int) -> FrameContent:
        loaded.add(index)
        return content(index)

    def run() -> set[int]:
        loaded.clear()
        given = [replace(f, inputs=(inputs[f.frame],)) for f in frames(load=load)]
        write(tmp_path / "scene", given=given)
        return set(loaded)

    assert run() == {0, 1, 2, 3, 4, 5}
    before = tree(tmp_path / "scene")
    assert run() == set()
    assert tree(tmp_path / "scene") == before
    # the held-out frame has no part in the cloud: it alone is made again
    (tmp_path / "scene/mono/image_02/0000000004.png").unlink()
    assert run() == {4}
    later = inputs[2].stat().st_mtime + 1000
    os.utime(inputs[4], (later, later))
    assert run() == {4}
    os.utime(inputs[4], (0, 0))
    # of a training frame the cloud is made of, so that all have to give their points again
    (tmp_path / "scene/lidar/image_02/0000000001.png").unlink()
    assert run() >= {0, 1, 2, 3, 5}
    assert tree(tmp_path / "scene") == before


def test_folder_with_another_scene_is_left_alone(tmp_path: Path) -> None:
    write(tmp_path / "scene", source={"kind": "test", "downscale": 1})
    before = tree(tmp_path / "scene")
    with pytest.raises(InputError, match=r"downscale is 1 there, 2 now.*another --output, or delete"):
        write(tmp_path / "scene", source={"kind": "test", "downscale": 2})
    with pytest.raises(InputError, match="contains another scene"):
        write(tmp_path / "scene", source={"kind": "other", "more": None})
    assert tree(tmp_path / "scene") == before
    (tmp_path / "scene/process.json").write_text('{"kind": ')
    with pytest.raises(InputError, match=r"process\.json: not valid JSON"):
        write(tmp_path / "scene")


def test_folder_with_foreign_files_is_left_alone(tmp_path: Path) -> None:
    output = tmp_path / "scene"
    output.mkdir()
    (output / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"holds thesis\.tex and no process\.json.*another --output"):
        write(output)
    assert list(tree(output)) == ["thesis.tex"]
    with pytest.raises(InputError, match="is a file"):
        write(output / "thesis.tex")
    with pytest.raises(InputError, match="cannot be written"):
        write(output / "thesis.tex/scene")


# ---- what cannot be a scene ------------------------------------------------------------------------------------
def bad(change: dict[str, Any]) -> list[SceneFrame]:
    return [replace(frame, content=replace(content(frame.frame), **change)) for frame in frames()]


HALF = np.zeros((SIZE, SIZE // 2))
NO_POINTS = PointCloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty((0, 2), np.int64))
SKEWED = pose(0)
SKEWED[0, 0] = 1.01


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"given": []}, "no frames"),
        ({"given": [*frames(), *frames()]}, "frame 0 of image_02 is given twice"),
        ({"given": [replace(f, held_out=True) for f in frames()]}, "all frames are held out"),
        ({"given": [replace(f, camera="image_09") for f in frames()]}, "frame 0 of image_09: no such camera"),
        ({"given": [replace(f, camera_to_world=SKEWED) for f in frames()]}, "frame 0 of image_02.*not a rotation"),
        ({"given": bad({"lidar": None})}, r"frame \d of image_02: has no lidar, but every other frame"),
        ({"given": bad({"mono": None})}, "has no mono"),
        ({"given": bad({"cloud": None})}, "has no cloud"),
        ({"given": bad({"cloud": NO_POINTS})}, "no LiDAR point lies in any training picture"),
        ({"given": bad({"lidar": HALF})}, "its LiDAR map: 16×32 pixels, expected 32×32"),
        ({"given": bad({"mono": HALF})}, "its monocular map: 16×32 pixels, expected 32×32"),
        ({"given": bad({"image": np.zeros((8, 9, 3), np.uint8)})}, "its picture: 9×8 pixels, expected 32×32"),
        ({"given": bad({"mask": HALF > 0}), "layers": ("lidar", "mask")}, "its mask: 16×32 pixels"),
        ({"mask": HALF > 0}, "mask of camera image_02: 16×32 pixels, expected 32×32"),
        ({"mask": np.zeros((SIZE, SIZE), bool)}, "mask of camera image_02 leaves no pixel.*inverted"),
        ({"layers": ("lidar", "radar")}, r"unknown layers \['radar'\]"),
        ({"theta_max_deg": 0.0}, "theta_max_deg is 0.0"),
        ({"theta_max_deg": 200.0}, "theta_max_deg is 200.0"),
        ({"cameras": [SceneCamera("a/b", FISHEYE)]}, "camera 'a/b'"),
        ({"cameras": [SceneCamera("image_02", FISHEYE)] * 2}, "two cameras have one name"),
    ],
)
def test_bad_scene_is_an_error(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        write(tmp_path / "scene", **options)
    assert not (tmp_path / "scene/transforms.json").exists()


WIDE = Pinhole(SIZE, SIZE, 4.0, 4.0, 16.4, 16.1)
"""Its corners lie at 80°: no polynomial of the angle follows the tangent so far."""
BENT = KannalaBrandt(SIZE, SIZE, 7.0, 7.0, 16.4, 16.1, 0.0652, 0.0189, -0.0042, -0.0013)
"""nerfstudio's iteration goes astray beyond some 90°."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("originals", "theta_max_deg", "message"),
    [
        ({"wide": WIDE, "round": POLYNOMIAL}, 95.0, r"wide: .* PINHOLE.*pinhole cameras only"),
        ({"bent": BENT}, 105.0, r"bent: .*diverges; at most 0\.5 px rms can be used\. Use --theta-max-deg 90,"),
    ],
)
def test_camera_that_nerfstudio_cannot_match_is_an_error(
    tmp_path: Path, originals: dict[str, Camera], theta_max_deg: float, message: str
) -> None:
    cameras = [SceneCamera(name, camera) for name, camera in originals.items()]
    given = [replace(frame, camera=cameras[0].name) for frame in frames()]
    with pytest.raises(InputError, match=message) as error:
        write(tmp_path / "scene", given=given, cameras=cameras, theta_max_deg=theta_max_deg)
    assert not (tmp_path / "scene").exists(), "an error before the work leaves no folder behind"
    # what it says to do helps
    usable_deg = float(str(error.value).split("--theta-max-deg ")[1].split(",")[0])
    write(tmp_path / "scene", given=given, cameras=cameras, theta_max_deg=usable_deg)


def test_cameras_of_all_models_make_one_scene(tmp_path: Path) -> None:
    originals: dict[str, Camera] = {"mei": FISHEYE, "polynomial": POLYNOMIAL, "pinhole": PINHOLE}
    given = [replace(frame, camera=name) for name in originals for frame in frames(3)]
    cameras = [SceneCamera(name, camera) for name, camera in originals.items()]
    report = write(tmp_path / "scene", given=given, cameras=cameras)
    meta = read_json(tmp_path / "scene/transforms.json")
    assert meta["camera_model"] == "OPENCV_FISHEYE"
    assert meta["camera_fits"].keys() == report.fits.keys() == originals.keys()
    assert all(0 <= fit["rms_px"] < 0.1 for fit in meta["camera_fits"].values())
    assert meta["original_cameras"]["pinhole"] == PINHOLE.to_dict()

    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    parser = NerfstudioDataParserConfig(data=tmp_path / "scene", orientation_method="none", center_method="none")
    outputs = parser.setup().get_dataparser_outputs("train")
    for index, picture in enumerate(outputs.image_filenames):
        name = picture.parent.name
        mask = read_mask(tmp_path / f"scene/masks/{name}.png")
        bundle = outputs.cameras.generate_rays(camera_indices=index)
        # OpenGL's axes to OpenCV's
        turned = outputs.cameras.camera_to_worlds[index, :, :3].double() * torch.tensor([1.0, -1.0, -1.0])
        directions = bundle.directions.double() @ turned
        pixels, valid = originals[name].project(directions)
        distance = (pixels - originals[name].pixel_centres()).norm(dim=-1)
        assert valid.numpy()[mask].all()
        assert distance.numpy()[mask].max() < 0.25


def test_check_rigid() -> None:
    check_rigid(pose(3), "here")
    rounded = np.round(pose(3), 6)
    check_rigid(rounded, "here")
    mirrored = pose(3) @ np.diag([1.0, 1.0, -1.0, 1.0])
    not_finite, scaled = pose(3), pose(3)
    not_finite[1, 3] = math.nan
    scaled[3, 3] = 2
    for broken in (mirrored, not_finite, scaled, np.round(pose(3), 2)):
        with pytest.raises(InputError, match="here: not a rotation and a translation"):
            check_rigid(broken, "here")


# ---- splitting, smaller maps, PNG headers ----------------------------------------------------------------------
def test_held_out_frames() -> None:
    assert [i for i, held in enumerate(held_out_frames(30, 8)) if held] == [4, 12, 20, 28]
    assert [i for i, held in enumerate(held_out_frames(6, 2)) if held] == [1, 3, 5]
    assert not any(held_out_frames(30, 0))
    assert held_out_frames(0, 8) == []
    # what a short drive is told
    assert all(sum(held_out_frames(count, best_holdout(count))) >= 1 for count in (2, 3, 4, 5, 20))


def test_downscaled_maps_cut_what_fills_no_block() -> None:
    image = np.arange(7 * 5 * 3, dtype=np.uint8).reshape(7, 5, 3)
    half = downscale_image(image, 2)
    assert half.shape == (3, 2, 3)
    # rows 0-1, columns 0-1 of channel 0: 0, 3, 15, 18, mean 9
    assert half[0, 0, 0] == 9
    mask = np.ones((7, 5), bool)
    mask[0, 3] = mask[6, 4] = False
    assert downscale_mask(mask, 2).tolist() == [[True, False], [True, True], [True, True]]
    assert downscale_distance(np.ones((7, 5)), 2).tolist() == [[1, 1]] * 3
    assert downscale_image(image, 1) is image
    # a floor whose distance falls along the rows: the mean of the middle rows' values, not one of them
    rows = np.repeat(np.linspace(20.0, 19.3, 8)[:, None], 8, 1)
    np.testing.assert_allclose(downscale_distance(rows, 4)[:, 0], [19.85, 19.45])


@pytest.mark.parametrize(
    ("block", "expected"),
    [
        # two middle values on one surface are averaged: (10.2 + 10.4) / 2
        ([10.0, 10.2, 10.4, 10.6], 10.3),
        # of two surfaces the nearer one's value, nothing in between
        ([5.0, 5.2, 40.0, 41.0], 5.2),
        # no value does not count, and is no distance
        ([0.0, 10.0, 10.2, 40.0], 10.2),
        ([0.0, 0.0, 10.0, 10.2], 10.1),
        ([0.0, 0.0, 0.0, 10.0], 0.0),
        ([0.0, 0.0, 0.0, 0.0], 0.0),
    ],
)
def test_downscaled_distance(block: list[float], expected: float) -> None:
    found = downscale_distance(np.array(block).reshape(2, 2), 2)
    assert found.shape == (1, 1)
    assert found[0, 0] == pytest.approx(expected)


@given(st.integers(0, 2**31), st.integers(2, 4))
def test_downscaled_distance_scales_and_invents_nothing(seed: int, factor: int) -> None:
    rng = np.random.default_rng(seed)
    distance = np.where(rng.random((12, 12)) < 0.7, rng.uniform(1, 50, (12, 12)), 0)
    small = downscale_distance(distance, factor)
    np.testing.assert_allclose(downscale_distance(2 * distance, factor), 2 * small)
    blocks = distance.reshape(12 // factor, factor, 12 // factor, factor).swapaxes(1, 2).reshape(*small.shape, -1)
    nearest = np.abs(blocks - small[..., None]).min(-1)
    assert (nearest <= 0.05 * small + 1e-12).all(), "each value is, within the tenth allowed, one of its block"


def test_png_header(tmp_path: Path) -> None:
    write_png(tmp_path / "rgb.png", np.zeros((3, 5, 3), np.uint8))
    write_distance_png(tmp_path / "distance.png", np.ones((4, 6)))
    write_mask(tmp_path / "mask.png", np.ones((2, 2), bool))
    rgb, distance, mask = (read_png_header(tmp_path / f"{name}.png") for name in ("rgb", "distance", "mask"))
    assert (rgb.width, rgb.height, rgb.bit_depth, rgb.colour) == (5, 3, 8, "RGB")
    assert (distance.width, distance.height, distance.bit_depth, distance.colour) == (6, 4, 16, "grey")
    assert [h.is_picture for h in (rgb, distance, mask)] == [True, False, False]
    assert [h.is_distance for h in (rgb, distance, mask)] == [False, True, False]
    assert read_png_bytes(tmp_path / "rgb.png") == (tmp_path / "rgb.png").read_bytes()


@pytest.mark.parametrize("size", [0, 5, 20, 40, -1])
def test_truncated_png_is_an_error(tmp_path: Path, size: int) -> None:
    path = tmp_path / "a.png"
    write_png(path, np.asarray(content(0).image))
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(InputError, match=r"a\.png: (truncated|not a PNG)"):
        read_png_header(path)


def test_damaged_png_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    write_png(path, np.arange(300, dtype=np.uint8).reshape(10, 10, 3))
    whole = bytearray(path.read_bytes())
    whole[60] ^= 1
    path.write_bytes(whole)
    with pytest.raises(InputError, match=r"a\.png: damaged"):
        read_png_bytes(path)
    path.write_text("GIF89a, not a PNG at all")
    with pytest.raises(InputError, match=r"a\.png: not a PNG"):
        read_png_header(path)
    with pytest.raises(FileNotFoundError, match=r"b\.png"):
        read_png_header(tmp_path / "b.png")


# ---- real data -------------------------------------------------------------------------------------------------
def test_real_fisheye_frame(tmp_path: Path, real_data: Path) -> None:
    folder = real_data / "kitti360_fisheye_frame"
    numbers = json.loads((folder / "kitti360_sample.json").read_text())["cam_params"]
    camera = MEI(
        *(1400, 1400, numbers["fx"], numbers["fy"], numbers["cx"] + 0.5, numbers["cy"] + 0.5),
        *(numbers[key] for key in ("xi", "k1", "k2", "p1", "p2")),
    )
    mask = ~np.load(folder / "mask_left_fisheye.npy")
    lidar = read_distance_png(folder / "kitti360_depth.png")
    frame = SceneFrame("image_02", 0, np.eye(4), FrameContent(folder / "kitti360_rgb.png", lidar=lidar))
    report = write(tmp_path / "scene", camera, [frame], mask, layers=("lidar",))
    assert report.fits["image_02"].rms_px < 0.05
    kept = read_mask(tmp_path / "scene/masks/image_02.png")
    # the mask that comes with the frame is larger than the lens
    assert kept.sum() < mask.sum() and not (kept & ~mask).any()
    written = read_distance_png(tmp_path / "scene/lidar/image_02/0000000000.png")
    assert np.array_equal(written, np.where(kept, lidar, 0))
    assert 25_000 < np.count_nonzero(written) < 50_789
    assert (tmp_path / "scene/images/image_02/0000000000.png").read_bytes() == frame.content.image.read_bytes()  # type: ignore[union-attr]
