"""From a raw drive to a scene: geometry against closed forms, KITTI-360's files, and everything that can be wrong."""

import json
import math
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import (
    CAM0_TO_VELO,
    CAM_TO_POSE,
    ROOM,
    SEQUENCE,
    Change,
    RoomDrive,
    aimed_points,
    cut,
    halve,
    matrix,
    pose,
    spoil,
    wall_distance,
    without_lidar_check,
    write_masks,
    write_mono,
    write_points,
    write_room_drive,
)
from lenses import IMAGE_02, IMAGE_03
from rich.console import Console
from scenes import tree
from test_scene import read_ply

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    read_distance_png,
    read_image,
    read_json,
    read_mask,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.cameras import MEI, KannalaBrandt
from edge_depth_nerf.cameras.transforms import opencv_to_opengl
from edge_depth_nerf.inspecting.findings import find
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.masks.ego import NoEgo
from edge_depth_nerf.masks.ego_files import vehicles_unknown
from edge_depth_nerf.mono.calibration import calibrate_scene
from edge_depth_nerf.process import build
from edge_depth_nerf.process.colmap import poses as colmap_poses
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.kitti360.calibration import (
    read_cam_to_pose,
    read_cam_to_velo,
    read_mei_camera,
    read_poses,
    read_rig,
)
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions
from edge_depth_nerf.process.poses import read_frame_times
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.scene.writer import ProcessReport, Skipped

pytestmark = pytest.mark.slow

CAMERAS = ("image_02", "image_03")
STEP_M = 1 / 256


def process(drive: RoomDrive | Path, output: Path, **options: Any) -> ProcessReport:
    root = drive if isinstance(drive, Path) else drive.root
    console = options.pop("console", Console(quiet=True))
    given: dict[str, Any] = {"root": root, "sequence": SEQUENCE, "output": output, "sweeps": 0, "strict": True}
    given |= {"refine_poses": False, "find_ego": False}
    return convert(Kitti360Options(**given | options), console)


def refused(drive: RoomDrive, output: Path, message: str, **options: Any) -> None:
    """Check that a drive is refused before anything is written."""
    with pytest.raises((InputError, FileNotFoundError), match=message):
        process(drive, output, **options)
    assert not output.exists()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    without_lidar_check(monkeypatch)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=6, truth=True, beams=4500)


@pytest.fixture(scope="module")
def scene(room: RoomDrive) -> Path:
    output = room.root.parent / "scene"
    process(room, output, ego_mask=write_masks(room.root.parent / "masks", room))
    return output


@pytest.fixture(scope="module")
def three_frames(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("three") / "drive", frames=3, beams=300, size=32)


@pytest.fixture
def drive(three_frames: RoomDrive, tmp_path: Path) -> RoomDrive:
    return replace(three_frames, root=shutil.copytree(three_frames.root, tmp_path / "drive"))


def maps(scene: Path, key: str) -> dict[tuple[str, int], np.ndarray]:
    frames = read_json(scene / "transforms.json")["frames"]
    return {(f["camera"], f["frame"]): read_distance_png(scene / f[key]) for f in frames}


def scene_camera(frame: dict[str, Any]) -> KannalaBrandt:
    keys = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
    return KannalaBrandt(frame["w"], frame["h"], *(frame[key] for key in keys))


def test_lidar_is_at_the_walls_of_the_room(room: RoomDrive, scene: Path) -> None:
    found = maps(scene, "lidar_file_path")
    assert set(found) == {(name, frame) for name in CAMERAS for frame in room.frames}
    assert min(np.count_nonzero(lidar) for lidar in found.values()) > 300
    assert off_the_walls(room, scene, slack=0.02).max() <= STEP_M


@pytest.mark.parametrize("camera", CAMERAS)
def test_points_aimed_at_pixels_land_in_them(tmp_path: Path, camera: str) -> None:
    """Half a pixel of error, in either direction, would move half of them to a neighbour."""
    drive = write_room_drive(tmp_path / "drive", frames=2, aim=camera)
    process(drive, tmp_path / "scene")
    mask = read_mask(tmp_path / f"scene/masks/{camera}.png")
    rng = np.random.default_rng(0)
    assert drive.frames
    for frame in drive.frames:
        _, pixels, distance = aimed_points(drive, camera, frame, rng)
        expected = np.zeros((drive.size, drive.size))
        expected[pixels[:, 1], pixels[:, 0]] = distance
        found = maps(tmp_path / "scene", "lidar_file_path")[camera, frame]
        assert np.count_nonzero(expected) > 400
        # float32 of the sweep and steps of the PNG
        np.testing.assert_allclose(found, np.where(mask, expected, 0), atol=STEP_M / 2 + 1e-4)


def test_fitted_camera_and_opengl_pose_put_points_where_the_raw_chain_does(room: RoomDrive, scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    rng = np.random.default_rng(1)
    walls = rng.uniform(ROOM[0], ROOM[1], (2000, 3))
    side = rng.integers(0, 2, 2000)
    axis = rng.integers(0, 3, 2000)
    walls[np.arange(2000), axis] = ROOM[side, axis]
    assert meta["frames"]
    for frame in meta["frames"]:
        world_to_camera = np.linalg.inv(room.camera_to_world(frame["camera"], frame["frame"]))
        raw = walls @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        seen = raw[:, 2] > np.cos(np.radians(94)) * np.linalg.norm(raw, axis=-1)
        raw_pixels = room.camera(frame["camera"]).project(raw[seen]) + 0.5

        world_to_opengl = np.linalg.inv(np.array(frame["transform_matrix"]))
        opengl = (walls[seen] - meta["world_offset_m"]) @ world_to_opengl[:3, :3].T + world_to_opengl[:3, 3]
        pixels, valid = scene_camera(frame).project(torch.from_numpy(opengl * (1.0, -1.0, -1.0)))
        assert valid.all() and len(pixels) > 500
        assert np.linalg.norm(pixels.numpy() - raw_pixels, axis=-1).max() < 0.02


def test_world_is_moved_near_the_cameras(room: RoomDrive, scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    centres = np.array([frame["transform_matrix"] for frame in meta["frames"]])[:, :3, 3]
    assert np.abs(centres.mean(0)).max() <= 0.5
    assert meta["world_offset_m"] == [round(value) for value in meta["world_offset_m"]]
    # up stays up: the floor is below the cameras
    assert (centres[:, 2] + meta["world_offset_m"][2] > ROOM[0, 2]).all()


def test_cloud_lies_on_the_walls_in_their_colours(room: RoomDrive, scene: Path) -> None:
    vertices, colours = read_ply(scene / "points.ply")
    world = vertices + np.array(read_json(scene / "transforms.json")["world_offset_m"])
    assert len(world) > 3000
    assert np.abs(world[:, None] - ROOM).min((1, 2)).max() < 1e-3
    middle = ROOM.mean(0)
    rays = (world - middle) / np.linalg.norm(world - middle, axis=-1, keepdims=True)
    expected = wall_distance(middle, rays)[1]
    # pixels on an edge may have the neighbour's colour
    assert (colours == expected).all(-1).mean() > 0.9


def off_the_walls(drive: RoomDrive, scene: Path, slack: float = 0.0) -> np.ndarray:
    """How far each pixel's LiDAR distance is outside what the room's walls allow there, metres; all training maps."""
    # integer pixel centres: the pixel in column c covers u from c - 0.5 to c + 0.5
    samples = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 5)] * 2), -1).reshape(-1, 2)
    off = []
    for (name, frame), lidar in maps(scene, "lidar_file_path").items():
        rows, columns = np.nonzero(lidar)
        distance, _, _ = drive.see(name, frame, np.stack((columns, rows), -1)[:, None] + samples)
        hits, nearest, farthest = lidar[rows, columns], distance.min(1), distance.max(1)
        off.append(np.maximum(nearest - hits, hits - farthest).clip(min=0) - slack * farthest)
    return np.concatenate(off)


def test_without_deskewing_points_are_where_the_scanner_was_not(room: RoomDrive, tmp_path: Path) -> None:
    process(room, tmp_path / "moved", frames=3)
    process(room, tmp_path / "skewed", frames=3, raw_lidar=True)
    moved, skewed = (off_the_walls(room, tmp_path / name) for name in ("moved", "skewed"))
    # 0.5 m a turn: up to a quarter of a metre on either side
    assert moved.max() < 0.02 * 30
    assert np.quantile(moved, 0.99) < 0.05 < 0.1 < np.quantile(skewed, 0.99)


def test_training_maps_do_not_depend_on_held_out_sweeps(tmp_path: Path) -> None:
    """Another sweep at the frame held out: not a byte of what training reads changes."""
    scenes = []
    for nearer in (1.0, 0.5):
        drive = write_room_drive(tmp_path / f"drive_{nearer}", frames=6, beams=500, size=32)
        write_points(drive.sweep(4), drive.as_measured(drive.points_m[4] * nearer, 4))
        scenes.append(tmp_path / f"scene_{nearer}")
        process(drive, scenes[-1], sweeps=3)
    trained = [f"lidar/{name}/{frame:010d}.png" for name in CAMERAS for frame in (0, 1, 2, 3, 5)]
    for file in ("points.ply", *trained):
        assert (scenes[0] / file).read_bytes() == (scenes[1] / file).read_bytes(), file
    held_out = [(scene / "lidar/image_02/0000000004.png").read_bytes() for scene in scenes]
    assert held_out[0] != held_out[1]


def test_sweeps_without_a_pose_of_their_own_are_used_by_others(tmp_path: Path) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=5, beams=1000)
    lines = drive.poses_file().read_text().splitlines(keepends=True)
    drive.poses_file().write_text("".join(lines[:2] + lines[3:]))
    report = process(drive, tmp_path / "scene", sweeps=1, holdout_every=0)
    assert report.skipped == (Skipped(2, None, "no pose"),)
    alone = process(drive, tmp_path / "alone", holdout_every=0)
    assert alone.training == report.training == 8
    one, many = (maps(tmp_path / name, "lidar_file_path") for name in ("alone", "scene"))
    # frame 3 has the sweeps of 2 and 4 beside its own
    assert np.count_nonzero(many["image_02", 3]) > 2.2 * np.count_nonzero(one["image_02", 3])
    assert np.quantile(off_the_walls(drive, tmp_path / "scene"), 0.99) < 0.05


def test_vehicle_mask_is_found_corrected_and_kept(tmp_path: Path) -> None:
    """The drive is too short to find it: a mask without the vehicle is written, which a person then corrects."""
    drive = write_room_drive(tmp_path / "drive", frames=3, beams=1000, size=32)
    for again in (False, True):
        report = process(drive, tmp_path / "scene", find_ego=True)
        assert (report.written == 0) is again, "a mask that is looked for again is no other mask"
        (said,) = [notice for notice in report.notices if "nothing is masked as the vehicle" in notice]
        assert said.startswith("image_02, image_03: nothing is masked") and said.count("--ego-mask") == 1
    assert vehicles_unknown(tmp_path / "scene") == list(CAMERAS)
    found = find(read_scene(tmp_path / "scene"), [])
    assert [one.cameras for one in found if one.kind == "vehicle"] == [(name,) for name in CAMERAS]
    path = tmp_path / "scene/ego_masks/image_02.png"
    mask = read_mask(path)
    before = (tmp_path / "scene/lidar/image_02/0000000000.png").read_bytes()
    mask[18:] = False
    write_mask(path, mask)
    report = process(drive, tmp_path / "scene", find_ego=True)
    assert report.written >= 3, "that camera's pictures"
    assert vehicles_unknown(tmp_path / "scene") == ["image_03"]
    assert ["image_03: nothing is masked" in notice for notice in report.notices].count(True) == 1
    assert not read_mask(tmp_path / "scene/masks/image_02.png")[18:].any()
    after = read_distance_png(tmp_path / "scene/lidar/image_02/0000000000.png")
    assert not after[18:].any() and after[:18].any()
    process(drive, tmp_path / "other", ego_mask=tmp_path / "scene/ego_masks")
    assert (tmp_path / "other/lidar/image_02/0000000000.png").read_bytes() != before
    assert (read_distance_png(tmp_path / "other/lidar/image_02/0000000000.png") == after).all()


def test_the_vehicle_is_looked_for_in_training_pictures_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=6, beams=300, size=32)
    looked: set[str] = set()

    def look(pictures: Any, lens: np.ndarray) -> NoEgo:
        looked.update(picture.args[0].name for picture in pictures)
        return NoEgo("not looked for here")

    monkeypatch.setattr("edge_depth_nerf.process.vehicle.find_ego", look)
    process(drive, tmp_path / "scene", find_ego=True)
    assert looked == {f"{frame:010d}.png" for frame in range(6) if frame != 4}


def found_by(options: dict[int, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the search for poses keep some frames, each shifted along the world's x axis."""

    def found(recording: Recording, _options: ProcessOptions, _console: Console) -> Recording:
        kept = []
        for picture in recording.pictures:
            if picture.frame in options:
                camera = next(c for c in recording.cameras if c.name == picture.camera)
                vehicle = pose(picture.frame)
                vehicle[0, 3] += options[picture.frame]
                kept.append(replace(picture, camera_to_world=vehicle @ camera.to_vehicle))
        poses = np.stack([pose(frame) for frame in options])
        poses[:, 0, 3] += list(options.values())
        path = Trajectory(np.array([0.1 * frame for frame in options]), poses)
        return replace(recording, pictures=tuple(kept), trajectory=path)

    monkeypatch.setattr(colmap_poses, "colmap_poses", found)
    monkeypatch.setattr(build, "lidar_says", lambda *_: [])


def test_other_poses_found_make_other_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the search had been made anew: what was held out by the old poses is not by the new ones."""
    drive = write_room_drive(tmp_path / "drive", frames=7, beams=300, size=32)
    for scene, kept in (("scene", range(7)), ("scene", range(2, 7)), ("fresh", range(2, 7))):
        found_by({frame: 0.02 * len(kept) for frame in kept}, monkeypatch)
        process(drive, tmp_path / scene, poses="colmap", sweeps=1, ego_mask=write_masks(tmp_path / "ego", drive))
    meta = read_json(tmp_path / "scene/transforms.json")
    assert {name[-14:-4] for name in meta["val_filenames"]} == {"0000000006"}
    for name in [f[key] for f in meta["frames"] for key in ("lidar_file_path", "file_path")] + ["points.ply"]:
        assert (tmp_path / "scene" / name).read_bytes() == (tmp_path / "fresh" / name).read_bytes(), name


def test_a_single_frame_is_not_enough_for_everything(drive: RoomDrive, tmp_path: Path) -> None:
    # a search that cannot begin leaves nothing behind
    refused(drive, tmp_path / "scene", "2 pictures, expected 3 or more", poses="colmap", frames=1)
    cut(drive.sweep(drive.frames[0]))
    message = r"\.bin: .*expected a multiple of 16.*choose more by --frames"
    refused(drive, tmp_path / "scene", message, frames=1, strict=False)


def test_frames_split_masks_and_truth(room: RoomDrive, scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    assert meta["camera_model"] == "OPENCV_FISHEYE"
    assert meta["val_filenames"] == [f"images/{name}/0000000004.png" for name in CAMERAS]
    assert len(meta["train_filenames"]) == 10
    assert meta["source"]["sequence"] == SEQUENCE and meta["source"]["root"] == "drive"
    for frame in meta["frames"]:
        name, number = frame["camera"], frame["frame"]
        assert frame["depth_file_path"] == frame["lidar_file_path"]
        assert (scene / frame["file_path"]).read_bytes() == room.image(name, number).read_bytes()
        assert frame["mask_path"] == f"masks/{name}.png"
        truth = room.root / f"truth/{SEQUENCE}/{name}"
        for key, kind in (("truth_distance_file_path", "distance"), ("truth_rgb_file_path", "rgb")):
            assert (scene / frame[key]).read_bytes() == (truth / kind / f"{number:010d}.png").read_bytes()
    # 0.123456789 s and one tenth a frame; 2013-05-28 08:46:00 UTC
    times = [frame["timestamp_s"] for frame in meta["frames"][:3]]
    np.testing.assert_allclose(times, [1369730760.023456789, 1369730760.123456789, 1369730760.223456789], atol=1e-6)
    for name in CAMERAS:
        mask = read_mask(scene / f"masks/{name}.png")
        _, theta = room.camera(name).rays(room.grid())
        lens = np.nan_to_num(theta, nan=np.inf) <= np.radians(95)
        assert np.array_equal(mask[:56], lens[:56])
        assert not mask[56:].any(), "the vehicle"
        original = meta["original_cameras"][name]
        assert original["model"] == "MEI" and original["cx"] == pytest.approx(room.camera(name).u0 + 0.5, abs=1e-12)


def test_shifted_views(room: RoomDrive, scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    assert set(meta["shifted_views"]) == {"1", "2"}
    for metres, views in meta["shifted_views"].items():
        assert [(view["camera"], view["frame"]) for view in views] == [(name, 4) for name in CAMERAS]
        for view in views:
            centre = np.array(view["transform_matrix"])[:3, 3] + meta["world_offset_m"]
            path = room.camera_to_world(view["camera"], 4)[:3, 3]
            assert np.linalg.norm(centre - path) == pytest.approx(float(metres))
            distance = read_distance_png(scene / view["truth_distance_file_path"])
            assert distance.shape == (70, 70) and distance.any()
            assert read_image(scene / view["truth_rgb_file_path"]).shape == (70, 70, 3)


def test_downscaled_scene_agrees_with_the_camera(room: RoomDrive, tmp_path: Path) -> None:
    mono = room.root / "truth" / SEQUENCE
    mono_folder = tmp_path / "mono"
    for name in CAMERAS:
        shutil.copytree(mono / name / "distance", mono_folder / name)
    ego = write_masks(tmp_path / "masks", room)
    process(room, tmp_path / "scene", downscale=4, mono=mono_folder, ego_mask=ego, frames=2)
    meta = read_json(tmp_path / "scene/transforms.json")
    samples = np.stack(np.meshgrid(*[np.linspace(-2, 2, 9)] * 2), -1).reshape(-1, 2)
    assert len(meta["frames"]) == 2 * 2
    for frame in meta["frames"]:
        name, number = frame["camera"], frame["frame"]
        # 70 = 17 · 4 + 2
        assert (frame["w"], frame["h"]) == (17, 17)
        image = read_image(tmp_path / "scene" / frame["file_path"])
        raw = read_image(room.image(name, number)).astype(float)
        np.testing.assert_allclose(image[3, 5], raw[12:16, 20:24].mean((0, 1)), atol=0.51)
        mask = read_mask(tmp_path / "scene" / frame["mask_path"])
        assert not mask[14:].any() and mask[5, 8]
        # the block in row 3 covers raw rows 12 to 15, whose centres' mean is 13.5
        rows, columns = np.nonzero(mask)
        centres = np.stack((columns, rows), -1)[:, None] * 4 + 1.5
        distance, _, _ = room.see(name, number, centres + samples)
        at_centre, _, _ = room.see(name, number, centres[:, 0])
        for key in ("mono_file_path", "truth_distance_file_path"):
            small = read_distance_png(tmp_path / "scene" / frame[key])[mask]
            # where the block lies on one wall, away from the lens's rim, the value is that of its centre
            smooth = (distance.max(1) < 1.25 * distance.min(1)) & (small > 0)
            assert smooth.sum() > 60
            assert np.median(np.abs(small - at_centre)[smooth] / at_centre[smooth]) < 0.01
            assert (small[smooth] >= distance.min(1)[smooth] - STEP_M).all()
            assert (small[smooth] <= distance.max(1)[smooth] + STEP_M).all()
        lidar = read_distance_png(tmp_path / "scene" / frame["lidar_file_path"])[mask]
        hit = lidar > 0
        assert hit.sum() > 60
        assert (lidar[hit] >= 0.98 * distance.min(1)[hit] - STEP_M).all()
        assert (lidar[hit] <= 1.02 * distance.max(1)[hit] + STEP_M).all()


def test_frame_masks_and_mono(drive: RoomDrive, tmp_path: Path) -> None:
    for name in CAMERAS:
        for frame in drive.frames:
            keep = np.ones((32, 32), bool)
            keep[:, : 10 + frame] = False
            write_mask(tmp_path / f"moving/{name}/{frame:010d}.png", keep)
    mono = write_mono(tmp_path / "mono", drive, lambda _, frame: 3.0 + frame)
    process(drive, tmp_path / "scene", frame_masks=tmp_path / "moving", mono=mono)
    for frame in read_json(tmp_path / "scene/transforms.json")["frames"]:
        mask = read_mask(tmp_path / "scene" / frame["mask_path"])
        assert not mask[:, : 10 + frame["frame"]].any() and mask[16, 14 + frame["frame"]]
        assert not read_distance_png(tmp_path / "scene" / frame["lidar_file_path"])[~mask].any()
        assert (read_distance_png(tmp_path / "scene" / frame["mono_file_path"]) == 3 + frame["frame"]).all()
    world = read_ply(tmp_path / "scene/points.ply")[0]
    assert 0 < len(world) < 3 * 600
    assert calibrate_scene(tmp_path / "scene").everywhere, "maps that are brought count beyond LiDAR"


def test_an_empty_monocular_map_is_named(drive: RoomDrive, tmp_path: Path) -> None:
    write_mono(tmp_path / "mono", drive, lambda *picture: 0.0 if picture == ("image_03", 1) else 3.0)
    with pytest.raises(InputError, match=r"image_03/0000000001\.png: its monocular map contains no distance"):
        process(drive, tmp_path / "scene", mono=tmp_path / "mono")
    assert not (tmp_path / "scene/transforms.json").exists()


def test_one_ego_mask_for_both_cameras(drive: RoomDrive, tmp_path: Path) -> None:
    keep = np.ones((32, 32), bool)
    keep[20:] = False
    write_mask(tmp_path / "ego.png", keep)
    process(drive, tmp_path / "scene", ego_mask=tmp_path / "ego.png", frames=1)
    assert not any(read_mask(tmp_path / f"scene/masks/{name}.png")[20:].any() for name in CAMERAS)


def test_one_camera_alone(drive: RoomDrive, tmp_path: Path) -> None:
    shutil.rmtree(drive.image("image_02", 0).parents[1])
    report = process(drive, tmp_path / "scene", cameras=("image_03",))
    assert (report.training, set(report.fits)) == (3, {"image_03"})
    assert not (tmp_path / "scene/images/image_02").exists()


def test_points_that_are_none_are_counted(drive: RoomDrive, tmp_path: Path) -> None:
    points = drive.points_m[1].copy()
    points[:5], points[5:12] = np.nan, 0
    write_points(drive.sweep(1), points)
    report = process(drive, tmp_path / "scene")
    # once a sweep, though both cameras read it
    assert any(notice.startswith("5 LiDAR points were left out of 3 sweeps: NaN") for notice in report.notices)
    assert any(notice.startswith("7 LiDAR points were left out of 3 sweeps: zero") for notice in report.notices)


def test_frames_without_pose_sweep_or_picture_are_listed_and_skipped(tmp_path: Path) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=12, beams=300, size=32)
    lines = drive.poses_file().read_text().splitlines(keepends=True)
    drive.poses_file().write_text("".join(lines[1:3] + lines[5:]))
    drive.sweep(7).unlink()
    drive.image("image_03", 9).unlink()
    console = Console(record=True, width=300, file=open(os.devnull, "w"))
    report = process(drive, tmp_path / "scene", console=console)
    assert report.skipped == (
        *(Skipped(frame, None, "no pose") for frame in (0, 3, 4)),
        Skipped(7, None, "no sweep"),
        Skipped(9, "image_03", "no picture"),
    )
    assert "Left out: no pose: 0, 3-4; no sweep: 7; no picture of image_03: 9" in console.export_text()
    meta = read_json(tmp_path / "scene/transforms.json")
    by_camera = {n: [f["frame"] for f in meta["frames"] if f["camera"] == n] for n in CAMERAS}
    # moments in order: 1 2 5 6 8 9 10 11, of which the fifth, 8, is held out
    assert by_camera == {"image_02": [1, 2, 5, 6, 8, 9, 10, 11], "image_03": [1, 2, 5, 6, 8, 10, 11]}
    assert meta["val_filenames"] == [f"images/{name}/0000000008.png" for name in CAMERAS]
    for frame in meta["frames"]:
        expected = opencv_to_opengl(drive.camera_to_world(frame["camera"], frame["frame"]))
        expected[:3, 3] -= meta["world_offset_m"]
        np.testing.assert_allclose(frame["transform_matrix"], expected, atol=1e-9)


def test_first_frames_and_stride(tmp_path: Path) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=7, beams=300, size=32, truth=True)
    for chosen, expected in (({"first": 1, "frames": 2, "stride": 4}, [1, 5]), ({"first": 3}, [3, 4, 5, 6])):
        report = process(drive, tmp_path / str(len(expected)), **chosen)
        told = any("beside the path are left out: none is of a held-out frame" in said for said in report.notices)
        assert told == (4 in expected)
        meta = read_json(tmp_path / str(len(expected)) / "transforms.json")
        assert [frame["frame"] for frame in meta["frames"]] == 2 * expected
        assert "shifted_views" not in meta, "those are of frame 4, which is not held out"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"first": 3}, "--first 3: reaches frame 3, but the pictures .* are of frames 0 to 2"),
        ({"frames": 4}, "--first 0 --frames 4 --stride 1: reaches frame 3.*leave out --first and --frames"),
        ({"first": -1}, "--first -1: expected"),
        ({"stride": 0}, "--stride 0: expected 1 or more"),
        ({"downscale": 33}, "downscale factor 33: expected 1 to 32"),
        ({"holdout_every": 1}, "--holdout-every 1: expected 2 or more, or 0"),
        ({"theta_max_deg": math.nan}, "--theta-max-deg nan: expected degrees"),
        ({"cameras": ()}, "--cameras : expected image_02, image_03 or both"),
        ({"cameras": ("image_00",)}, "--cameras image_00: expected image_02"),
        ({"cameras": ("image_02", "image_02")}, "--cameras image_02 image_02: expected"),
    ],
)
def test_options_out_of_range(drive: RoomDrive, tmp_path: Path, options: dict[str, Any], message: str) -> None:
    refused(drive, tmp_path / "scene", message, **options)


YAML = "calibration/image_03.yaml"
TO_POSE, TO_VELO = "calibration/calib_cam_to_pose.txt", "calibration/calib_cam_to_velo.txt"
POSES = f"data_poses/{SEQUENCE}/poses.txt"
PICTURES, SWEEPS = f"data_2d_raw/{SEQUENCE}", f"data_3d_raw/{SEQUENCE}/velodyne_points/data"
TIMES, PICTURE = f"{PICTURES}/image_03/timestamps.txt", f"{PICTURES}/image_03/data_rgb/0000000001.png"


def _pose_line(frame: int) -> str:
    return f"{frame} " + " ".join(str(value) for value in pose(0)[:3].ravel().tolist()) + "\n"


BROKEN: list[tuple[str, Change, str]] = [
    ("calibration", None, "drive/calibration: no such folder; .*drive holds data_2d_raw, data_3d_raw, data_poses"),
    (
        f"data_poses/{SEQUENCE}",
        lambda path: path.rename(path.with_name("2013_05_28_drive_0002_sync")),
        rf"data_poses/{SEQUENCE}: no such folder; .*data_poses holds 2013_05_28_drive_0002_sync",
    ),
    (f"{PICTURES}/image_03", None, "image_03/data_rgb: no such folder; .*holds image_02. .*leave out that camera"),
    (
        f"{PICTURES}/image_02/data_rgb",
        lambda path: path.rename(path.with_name("data_rect")),
        "image_02/data_rgb: no such folder; .*image_02 holds data_rect",
    ),
    (SWEEPS, None, "velodyne_points/data: no such folder"),
    (f"{SWEEPS}/*", None, "none of frames 0 to 2.*no sweep: 0-2"),
    (f"{PICTURES}/*/data_rgb/*", None, r"no pictures with names like 0000000123\.png"),
    (
        *(POSES, _pose_line(70).encode()),
        "none of frames 0 to 2 can be used: no pose: 0-2. .*has poses of frames 70 to 70, .*sweeps of frames 0 to 2",
    ),
    (YAML, b"", r"image_03\.yaml: nothing in it"),
    (YAML, b"\x93\xff\x00", r"image_03\.yaml: not a text file"),
    (YAML, ("(?s)   p1:.*", ""), r"image_03\.yaml: ends after line 11 without distortion_parameters\.p1"),
    (YAML, (r"v0: 15\.", "v0: 1."), r"image_03\.yaml, line 18: v0 is 1\..*not in the middle half"),
    (YAML, ("u0: ", "u0: about "), r"image_03\.yaml, line 17: .*u0: .* is not a finite number"),
    (YAML, ("k2:", "k2"), r"image_03\.yaml, line 11: Missing ':'"),
    (YAML, ("MEI", "PINHOLE"), r"image_03\.yaml, line 3: model_type is not MEI"),
    (TO_POSE, None, r"calib_cam_to_pose\.txt: no such file"),
    (TO_POSE, (r" \S+\n\Z", ""), r"calib_cam_to_pose\.txt, line 3: 11 numbers, expected 12"),
    (TO_POSE, ("image_02:.*\n", ""), r"calib_cam_to_pose\.txt: has no line for image_02, only for image_00, image_03"),
    (TO_POSE, ("image_02:", ""), "line 2: expected 'image_00: ' and"),
    (TO_POSE, (r"-0\.0307524527", "O.0307"), r"calib_cam_to_pose\.txt, line 2: 'O\.0307' is not a finite number"),
    (TO_POSE, (r"0\.9995185086", "0.9895185086"), r"calib_cam_to_pose\.txt, line 2: not a rotation"),
    (TO_VELO, b"", r"calib_cam_to_velo\.txt: 0 lines with text, expected one"),
    (POSES, b"\n", r"poses\.txt: no poses in it"),
    (POSES, (r" \S+\n\Z", " nan\n"), r"poses\.txt, line 3: 'nan' is not a finite number"),
    (POSES, (r"\Z", _pose_line(1)), r"poses\.txt, line 4: frame 1 has a pose already"),
    (POSES, ("^0 ", "1.5 "), r"poses\.txt, line 1: '1\.5' is not a frame number"),
    (POSES, (r"(?s)\n.*", "\n"), r"poses\.txt: a path needs at least two poses for the vehicle's motion, found 1"),
    (TIMES, (r".*\n\Z", ""), r"image_03/timestamps\.txt: ends after line 2, but frame 2"),
    (TIMES, (r"2013-05-28 08:46:00\.1", "yesterday "), r"image_03/timestamps\.txt, line 2: 'yesterday .*is not a time"),
    (TIMES, (r"\S+\n\Z", "08:46:00.0\n"), r"timestamps\.txt, line 3: not after the line before"),
    (f"{SWEEPS}/0000000001.bin", cut, r"0000000001\.bin: 4797 bytes, expected a multiple of 16"),
    (PICTURE, halve, r"image_03/data_rgb/0000000001\.png: truncated"),
    (
        *(PICTURE, lambda path: write_png(path, np.zeros((32, 31, 3), np.uint8))),
        r"0000000001\.png: 31×32 pixels, but its camera's calibration says 32×32",
    ),
]


@pytest.mark.parametrize(("file", "change", "message"), BROKEN)
def test_broken_drive_is_an_error_before_the_work(
    drive: RoomDrive, tmp_path: Path, file: str, change: Change, message: str
) -> None:
    spoil(drive.root, file, change)
    refused(drive, tmp_path / "scene", message)


def test_wrong_root_or_sequence_says_what_is_there(drive: RoomDrive, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"drives: no such folder; .* holds drive\. --root takes"):
        process(tmp_path / "drives", tmp_path / "scene")
    with pytest.raises(
        FileNotFoundError, match=r"calibration: no such folder; .* holds drive. --root .* is not the data"
    ):
        process(tmp_path, tmp_path / "scene")
    with pytest.raises(FileNotFoundError, match=f"no such folder; .*data_2d_raw holds {SEQUENCE}. --sequence needs"):
        process(drive, tmp_path / "scene", sequence="2013_05_28_drive_0007_sync")


@pytest.mark.parametrize("option", ["mono", "frame_masks"])
def test_maps_beside_the_drive_are_checked(drive: RoomDrive, tmp_path: Path, option: str) -> None:
    given = {option: tmp_path / "maps"}
    name = "--" + option.replace("_", "-")

    def refuse(message: str) -> None:
        refused(drive, tmp_path / "scene", message, **given)

    refuse(f"maps/image_02: no such folder; .*{name} needs a folder with one folder per camera")
    write_mono(tmp_path / "maps", drive, 4.0)
    path = tmp_path / "maps/image_03/0000000002.png"
    path.unlink()
    refuse(rf"maps/image_03/0000000002\.png: no such file; {name} needs one for every picture taken")
    write_distance_png(path, np.full((16, 32), 4.0))
    refuse(r"0000000002\.png: 32×16 pixels")
    write_distance_png(path, np.full((32, 32), 4.0))
    halve(path)
    refuse(r"0000000002\.png: truncated")
    if option == "mono":
        write_mask(path, np.ones((32, 32), bool))
        refuse(r"0000000002\.png: 8-bit grey, expected a 16-bit grey PNG in units of 1/256 m")


def test_ego_masks_are_checked(drive: RoomDrive, tmp_path: Path) -> None:
    masks = write_masks(tmp_path / "masks", drive)

    def refuse(message: str) -> None:
        refused(drive, tmp_path / "scene", message, ego_mask=masks)

    write_mask(masks / "image_03.png", np.ones((32, 33), bool))
    refuse(r"masks/image_03\.png: 33×32 pixels, but its camera's calibration says 32×32")
    halve(masks / "image_03.png")
    refuse(r"masks/image_03\.png: cannot be decoded")
    write_mask(masks / "image_03.png", np.zeros((32, 32), bool))
    refuse("mask of camera image_03 leaves no pixel.*inverted")
    (masks / "image_03.png").unlink()
    refuse(r"masks/image_03\.png: no such file; --ego-mask takes")


def test_truth_is_checked(tmp_path: Path) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=5, beams=300, size=32, truth=True)
    truth = drive.root / f"truth/{SEQUENCE}"

    def refuse(message: str) -> None:
        refused(drive, tmp_path / "scene", message)

    poses = read_json(truth / "shifted.json")
    poses["2"]["image_02"]["4"][0][0] += 0.1
    write_json(truth / "shifted.json", poses)
    refuse(r"shifted\.json: 2 m, image_02, frame 4: not a rotation")
    del poses["2"]["image_02"]["4"][2:]
    write_json(truth / "shifted.json", poses)
    refuse(r"shifted\.json: 2 m, image_02, frame 4: expected 4 rows of 4 numbers")
    (truth / "image_03/rgb/0000000003.png").unlink()
    refuse(r"image_03/rgb/0000000003\.png: no such file; the drive's ground truth is incomplete")


def test_sweep_without_points_is_an_error(drive: RoomDrive, tmp_path: Path) -> None:
    write_points(drive.sweep(1), np.full((50, 3), np.nan))
    with pytest.raises(InputError, match=r"0000000001\.bin: none of its 50 points can be used \(50 are NaN"):
        process(drive, tmp_path / "scene")
    # mended, the same command goes on
    write_points(drive.sweep(1), drive.points_m[1][:50])
    process(drive, tmp_path / "again")
    shutil.rmtree(tmp_path / "scene")
    process(drive, tmp_path / "scene")
    assert tree(tmp_path / "scene") == tree(tmp_path / "again")


def test_missing_timestamps_are_no_obstacle(drive: RoomDrive, tmp_path: Path) -> None:
    (drive.root / TIMES).unlink()
    report = process(drive, tmp_path / "scene")
    assert any("image_03 have no timestamp_s" in notice for notice in report.notices)
    meta = read_json(tmp_path / "scene/transforms.json")
    assert [f["camera"] for f in meta["frames"] if "timestamp_s" not in f] == ["image_03"] * 3


def test_other_options_or_other_input_are_another_scene(drive: RoomDrive, tmp_path: Path) -> None:
    process(drive, tmp_path / "scene")
    before = tree(tmp_path / "scene")
    with pytest.raises(InputError, match="contains another scene: frames is None there, 2 now"):
        process(drive, tmp_path / "scene", frames=2)
    other = write_room_drive(tmp_path / "other/drive", frames=3, beams=400, size=32)
    with pytest.raises(InputError, match="contains another scene: inputs_sha256"):
        process(other, tmp_path / "scene")
    with pytest.raises(InputError, match=r"and no process\.json"):
        process(drive, drive.root)
    assert tree(tmp_path / "scene") == before


def test_yaml_without_spaces_after_the_colon(drive: RoomDrive, tmp_path: Path) -> None:
    twin, path = drive.camera("image_02"), tmp_path / "image_02.yaml"
    path.write_text(twin.yaml("image_02", space=""))
    numbers = (twin.gamma1, twin.gamma2, twin.u0 + 0.5, twin.v0 + 0.5, twin.xi, twin.k1, twin.k2, twin.p1, twin.p2)
    assert read_mei_camera(path) == MEI(32, 32, *numbers)


def test_real_calibration(real_data: Path) -> None:
    folder = real_data / "kitti360_calibration"
    cameras, _ = read_rig(folder, CAMERAS)
    assert {name: one.camera for name, one in cameras.items()} == {"image_02": IMAGE_02, "image_03": IMAGE_03}
    poses = read_cam_to_pose(folder / "calib_cam_to_pose.txt")
    assert set(poses) == {"image_00", "image_01", "image_02", "image_03"}
    assert poses["image_01"][1].tolist() == [0.9997374956, -0.0100836652, -0.0205732716, 0.5981494900]
    for name, numbers in CAM_TO_POSE.items():
        assert np.array_equal(poses[name], matrix(numbers))
    assert np.array_equal(read_cam_to_velo(folder / "calib_cam_to_velo.txt"), matrix(CAM0_TO_VELO))


def test_report_says_how_well_the_cameras_fit(drive: RoomDrive, tmp_path: Path) -> None:
    console = Console(record=True, width=200, file=open(os.devnull, "w"))
    report = process(drive, tmp_path / "scene", console=console)
    text = console.export_text()
    for name in CAMERAS:
        assert f"{name}: the camera model for nerfstudio fits within {report.fits[name].rms_px:.4f} px rms" in text
    assert "6 training pictures, 0 held out" in text
    assert text.count("No frame is held out") == 1
    assert json.loads((tmp_path / "scene/process.json").read_text())["kind"] == "kitti360"
    assert replace(report, notices=()).scene == tmp_path / "scene"


def test_cloud_has_nothing_of_held_out_frames(tmp_path: Path, drive: RoomDrive) -> None:
    # only the sweep of frame 1, held out of every 2, reaches beyond the room
    far = drive.points_m[1] * 3
    write_points(drive.sweep(1), far)
    process(drive, tmp_path / "scene", holdout_every=2)
    meta = read_json(tmp_path / "scene/transforms.json")
    assert {name[-14:-4] for name in meta["val_filenames"]} == {"0000000001"}
    world = read_ply(tmp_path / "scene/points.ply")[0] + np.array(meta["world_offset_m"])
    assert (world > ROOM[0] - 0.01).all() and (world < ROOM[1] + 0.01).all()
    assert maps(tmp_path / "scene", "lidar_file_path")["image_02", 1].max() > 25


def test_chain_of_frames(drive: RoomDrive) -> None:
    cameras, velo_to_pose = read_rig(drive.root / "calibration", CAMERAS)
    cam0_to_pose, cam0_to_velo = matrix(CAM_TO_POSE["image_00"]), matrix(CAM0_TO_VELO)
    for name in CAMERAS:
        # velo → camera 0 → vehicle → camera k
        chain = np.linalg.inv(matrix(CAM_TO_POSE[name])) @ cam0_to_pose @ np.linalg.inv(cam0_to_velo)
        found = np.linalg.inv(cameras[name].to_vehicle) @ velo_to_pose
        np.testing.assert_allclose(found, chain, atol=1e-12)
    # the scanner's axes in the vehicle: x forward stays, y left and z up become right and down
    np.testing.assert_allclose(velo_to_pose[:3, :3], np.diag([1, -1, -1]), atol=0.02)


def test_timestamps_keep_fractions_of_a_microsecond(tmp_path: Path) -> None:
    path = tmp_path / "timestamps.txt"
    path.write_text("1970-01-02 00:00:01.123456789\n1970-01-02 00:00:02\n\n")
    first, second = read_frame_times(path)
    assert first == pytest.approx(86401.123456789, abs=1e-9)
    assert second == 86402.0


def test_poses_skip_frames(tmp_path: Path) -> None:
    path = tmp_path / "poses.txt"
    path.write_text(_pose_line(3) + "\n" + _pose_line(11).replace("11 ", "1.1e1   ", 1))
    assert {frame: found.tolist() for frame, found in read_poses(path).items()} == {
        frame: pose(0).tolist() for frame in (3, 11)
    }
