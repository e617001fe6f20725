"""KITTI's raw data and odometry benchmark: small drives in their layouts, and the same drive described by hand."""

import shutil
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import cv2
import data_sets
import numpy as np
import pytest
from drives import Change, spoil
from numpy.typing import NDArray
from rich.console import Console
from scenes import tree
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.kitti.calibration import read_oxts
from edge_depth_nerf.process.kitti.converter import read_kitti
from edge_depth_nerf.process.options import KittiOptions, RigOptions

DRIVE = "2011_09_26_drive_0005_sync"
FIRST_S = 1_317_042_145
CAMERAS = {"image_02": [0.06, 0.0, 0.003], "image_03": [-0.47, 0.002, 0.003]}
"""Where the origin of the rectified camera 0 is in each of them."""
RECTIFYING = Rotation.from_euler("xyz", [0.01, -0.008, 0.005])
LATITUDE, LONGITUDE = 49.011, 8.423
EARTH_M = 6378137.0
SCANNER_TO_VEHICLE = data_sets.to_vehicle("scanner")


def camera_to_vehicle(name: str) -> NDArray:
    moved = np.eye(4)
    moved[:3, 3] = np.negative(CAMERAS[name])
    return data_sets.to_vehicle("front") @ moved


def true_distance(name: str, number: int) -> NDArray:
    column, row = np.meshgrid(np.arange(data_sets.WIDTH), np.arange(data_sets.HEIGHT))
    (cx, cy), focal = data_sets.CENTRE, data_sets.FOCAL
    rays = np.stack(((column - cx) / focal, (row - cy) / focal, np.ones(row.shape)), -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    to_world = data_sets.vehicle(number * data_sets.INTERVAL_S) @ camera_to_vehicle(name)
    return data_sets.reach(to_world[:3, 3], rays @ to_world[:3, :3].T)


def write_picture(path: Path, name: str, number: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shade = np.clip(true_distance(name, number) * 8, 0, 255).astype(np.uint8)
    assert cv2.imwrite(str(path), np.stack((shade // 2, 255 - shade, shade), -1))


def write_points(path: Path, points: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    record = np.column_stack((points, np.full(len(points), 0.5))).astype("<f4")
    # sorted by ring, as KITTI's are
    path.write_bytes(record[np.argsort(record[:, 2], kind="stable")].tobytes())


def numbers(values: NDArray) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(values))


def projection(name: str) -> str:
    (cx, cy), focal = data_sets.CENTRE, data_sets.FOCAL
    matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]])
    return numbers(np.column_stack((matrix, matrix @ CAMERAS[name])))


def dates(offset_s: float = 0.0) -> str:
    lines = []
    for number in range(data_sets.FRAMES):
        nanoseconds = round((number * data_sets.INTERVAL_S + offset_s) * 1e9)
        stamp = datetime.fromtimestamp(FIRST_S + nanoseconds // 10**9, timezone.utc)
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}.{nanoseconds % 10**9:09d}\n")
    return "".join(lines)


def oxts_line(pose: NDArray) -> str:
    """Mercator's projection the other way round."""
    scale = np.cos(np.radians(LATITUDE)) * EARTH_M
    north = np.log(np.tan(np.pi / 4 + np.radians(LATITUDE) / 2)) + pose[1, 3] / scale
    latitude = np.degrees(2 * np.arctan(np.exp(north)) - np.pi / 2)
    longitude = LONGITUDE + np.degrees(pose[0, 3] / scale)
    angles = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
    return (
        f"{latitude!r} {longitude!r} {112.5 + pose[2, 3]!r} " + " ".join(map(repr, angles.tolist())) + " 0" * 24 + "\n"
    )


def write_raw(root: Path) -> Path:
    day = root / DRIVE[:10]
    drive = day / DRIVE
    (drive / "oxts/data").mkdir(parents=True)
    rectifying = np.eye(4)
    rectifying[:3, :3] = RECTIFYING.as_matrix()
    camera_0_to_vehicle = data_sets.to_vehicle("front") @ rectifying
    velo_to_cam = np.linalg.inv(camera_0_to_vehicle) @ SCANNER_TO_VEHICLE
    imu_to_velo = np.linalg.inv(SCANNER_TO_VEHICLE)
    lines = [
        "calib_time: 09-Jan-2012 13:57:47",
        "corner_dist: 9.950000e-02",
        f"R_rect_00: {numbers(RECTIFYING.as_matrix())}",
    ]
    for name in CAMERAS:
        lines += [f"S_{name[-2:]}: 1.392e+03 5.12e+02", f"S_rect_{name[-2:]}: {data_sets.WIDTH:e} {data_sets.HEIGHT:e}"]
        lines.append(f"P_rect_{name[-2:]}: {projection(name)}")
    (day / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, matrix in (("velo_to_cam", velo_to_cam), ("imu_to_velo", imu_to_velo)):
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {numbers(matrix[:3, :3])}\nT: {numbers(matrix[:3, 3])}\n"
        (day / f"calib_{name}.txt").write_text(text)
    for number in range(data_sets.FRAMES):
        seconds = number * data_sets.INTERVAL_S
        for name in CAMERAS:
            write_picture(drive / name / f"data/{number:010d}.png", name, number)
        # it faces forward in the middle of its turn
        write_points(
            drive / f"velodyne_points/data/{number:010d}.bin", data_sets.turn(seconds - data_sets.TURN_S / 2)[0]
        )
        (drive / f"oxts/data/{number:010d}.txt").write_text(oxts_line(data_sets.vehicle(seconds)))
    (drive / "velodyne_points/timestamps.txt").write_text(dates())
    for name in (*CAMERAS, "oxts"):
        (drive / name / "timestamps.txt").write_text(dates(0.0106))
    return root


def write_rig(root: Path, raw: Path) -> Path:
    """The same drive, described by hand."""
    shutil.copytree(raw / DRIVE[:10] / DRIVE, root)
    times = [FIRST_S + number * data_sets.INTERVAL_S for number in range(data_sets.FRAMES)]
    (root / "times.txt").write_text("".join(f"{time!r}\n" for time in times))
    lines = []
    for number, time in enumerate(times):
        pose = data_sets.vehicle(number * data_sets.INTERVAL_S)
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        lines.append(f"{time!r} {' '.join(map(repr, [*pose[:3, 3].tolist(), *quaternion.tolist()]))}\n")
    (root / "poses.txt").write_text("".join(lines))
    text = '[poses]\nfile = "poses.txt"\nformat = "tum"\n'
    (cx, cy), focal = data_sets.CENTRE, data_sets.FOCAL
    for name in CAMERAS:
        text += f'[cameras.{name}]\nimages = "{name}/data"\ntimes_file = "times.txt"\nmodel = "pinhole"\n'
        text += f"width = {data_sets.WIDTH}\nheight = {data_sets.HEIGHT}\n"
        text += f"fx = {focal}\nfy = {focal}\ncx = {cx}\ncy = {cy}\n"
        text += f"to_vehicle = {camera_to_vehicle(name).tolist()}\n"
    text += '[lidars.velodyne]\nscans = "velodyne_points/data"\ntimes_file = "times.txt"\n'
    text += 'turn_s = 0.1\ntimestamp = "middle"\n'
    text += f'direction = "clockwise"\nstart_azimuth_deg = 180\nto_vehicle = {SCANNER_TO_VEHICLE.tolist()}\n'
    (root / "rig.toml").write_text(text)
    return root


def write_odometry(root: Path) -> Path:
    sequence = root / "sequences/07"
    to_vehicle = data_sets.to_vehicle("front")
    lines = [f"P{name[-1]}: {projection(name)}" for name in CAMERAS]
    lines.append(f"Tr: {numbers((np.linalg.inv(to_vehicle) @ SCANNER_TO_VEHICLE)[:3])}")
    poses = []
    for number in range(data_sets.FRAMES):
        seconds = number * data_sets.INTERVAL_S
        for name in CAMERAS:
            write_picture(sequence / f"image_{name[-1]}/{number:06d}.png", name, number)
        write_points(sequence / f"velodyne/{number:06d}.bin", data_sets.points(seconds, SCANNER_TO_VEHICLE))
        first = data_sets.vehicle(0.0) @ to_vehicle
        poses.append(numbers((np.linalg.inv(first) @ data_sets.vehicle(seconds) @ to_vehicle)[:3]) + "\n")
    (sequence / "calib.txt").write_text("\n".join(lines) + "\n")
    (sequence / "times.txt").write_text("".join(f"{n * data_sets.INTERVAL_S:e}\n" for n in range(data_sets.FRAMES)))
    (root / "poses").mkdir()
    (root / "poses/07.txt").write_text("".join(poses))
    return root


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_raw(tmp_path_factory.mktemp("kitti") / "raw")


@pytest.fixture(scope="module")
def odometry(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_odometry(tmp_path_factory.mktemp("odometry") / "dataset")


def options(root: Path, sequence: str = DRIVE, **changes) -> KittiOptions:
    given: dict[str, Any] = {"find_ego": False, "sky": False, "strict": True, "refine_poses": False, **changes}
    return KittiOptions(root=root, sequence=sequence, output=root.parent / "scene", **given)


@pytest.mark.slow
def test_raw_data_and_a_rig_of_the_same_drive_give_the_same_scene(raw: Path, tmp_path: Path) -> None:
    report = convert(replace(options(raw), output=tmp_path / "kitti"), Console(quiet=True))
    assert (report.training, report.held_out) == (10, 2)
    assert not [notice for notice in report.notices if "LiDAR covers" not in notice]
    data_sets.check_walls(report.scene, dict(zip(CAMERAS, CAMERAS, strict=True)), true_distance)
    meta = read_json(report.scene / "transforms.json")
    source = {"kind": "kitti", "root": "raw", "sequence": DRIVE, "cameras": ["image_02", "image_03"]}
    assert {key: meta["source"][key] for key in source} == source
    by_hand = RigOptions(root=write_rig(tmp_path / "rig", raw), output=tmp_path / "scene")
    given = {name: getattr(options(raw), name) for name in ("find_ego", "sky", "strict", "refine_poses")}
    other = convert(replace(by_hand, **given), Console(quiet=True)).scene
    lens = ("fl_x", "fl_y", "cx", "cy")
    for ours, theirs in zip(meta["frames"], read_json(other / "transforms.json")["frames"], strict=True):
        assert ours["file_path"] == theirs["file_path"]
        np.testing.assert_allclose(ours["transform_matrix"], theirs["transform_matrix"], atol=1e-6)
        assert [ours[key] for key in lens] == pytest.approx([theirs[key] for key in lens], abs=1e-6)
    assert tree(report.scene / "images") == tree(other / "images")
    maps = [path.relative_to(other) for path in sorted((other / "lidar").rglob("*.png"))]
    assert len(maps) == 12
    for path in maps:
        first, second = read_distance_png(report.scene / path), read_distance_png(other / path)
        # a point on a pixel's border may fall to either side
        assert np.mean((first > 0) != (second > 0)) < 0.002
        assert np.mean(np.abs(first - second)[(first > 0) & (second > 0)] > 1 / 256) < 0.002


@pytest.mark.slow
def test_a_sequence_of_the_odometry_benchmark(odometry: Path, tmp_path: Path) -> None:
    report = convert(replace(options(odometry, "07"), output=tmp_path / "scene"), Console(quiet=True))
    assert (report.training, report.held_out) == (10, 2)
    assert not [notice for notice in report.notices if "LiDAR covers" not in notice]
    data_sets.check_walls(report.scene, dict(zip(CAMERAS, CAMERAS, strict=True)), true_distance)


def test_what_is_read(raw: Path, odometry: Path) -> None:
    recording = read_kitti(options(raw))
    sweep = recording.sweeps[3]
    assert sweep.timing is not None and sweep.timing.clockwise and sweep.timing.turn_s == pytest.approx(0.1)
    assert sweep.timing.reference_azimuth_rad == 0
    np.testing.assert_allclose(sweep.to_vehicle, SCANNER_TO_VEHICLE, atol=1e-9)
    # pictures, sweeps and poses of a frame have one time: that of the scanner
    assert {picture.time_s for picture in recording.pictures} == {sweep.time_s for sweep in recording.sweeps}
    assert recording.pictures[0].time_s == FIRST_S
    for camera in recording.cameras:
        np.testing.assert_allclose(camera.to_vehicle, camera_to_vehicle(camera.name), atol=1e-9)
        # the first pixel's centre is 0 in the file
        assert camera.camera.cx == data_sets.CENTRE[0] + 0.5
    for picture in recording.pictures:
        expected = data_sets.vehicle(picture.frame * 0.1) @ camera_to_vehicle(picture.camera)
        np.testing.assert_allclose(recording.pose(picture), expected, atol=1e-6)
    recording = read_kitti(options(odometry, "07", cameras=("image_03",)))
    assert [camera.name for camera in recording.cameras] == ["image_03"] and len(recording.pictures) == 6
    assert recording.sweeps[0].timing is None
    # up is z: the drive is level
    places = np.array([recording.pose(picture)[:3, 3] for picture in recording.pictures])
    assert np.ptp(places[:, 2]) < 1e-9 and np.ptp(places[:, :2], axis=0).max() > 2


def test_poses_turn_about_x_then_y_then_z(tmp_path: Path) -> None:
    """KITTI's devkit: R = Rz(yaw) · Ry(pitch) · Rx(roll)."""
    roll, pitch, yaw = 0.1, -0.2, 2.5
    for number in range(2):
        (tmp_path / f"{number:010d}.txt").write_text(f"49 {8 + 1e-4 * number} {100 + number} {roll} {pitch} {yaw} 0 0")
    poses = read_oxts(tmp_path)
    x = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    y = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    z = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    np.testing.assert_allclose(poses[1][:3, :3], z @ y @ x, atol=1e-12)
    east = np.cos(np.radians(49)) * EARTH_M * np.radians(1e-4)
    np.testing.assert_allclose(poses[1][:3, 3], [east, 0, 1], atol=1e-6)
    np.testing.assert_array_equal(poses[0][:3, 3], 0)


@pytest.mark.parametrize("lost", [0, 2])
@pytest.mark.parametrize("empty", [False, True])
def test_frames_without_sweep_keep_the_others_times(raw: Path, tmp_path: Path, empty: bool, lost: int) -> None:
    """Some of KITTI's drives lack sweeps, and their lines of times are empty."""
    root = Path(shutil.copytree(raw, tmp_path / "raw"))
    scans = root / f"{DRIVE[:10]}/{DRIVE}/velodyne_points"
    (scans / f"data/{lost:010d}.bin").unlink()
    lines = (scans / "timestamps.txt").read_text().splitlines(keepends=True)
    (scans / "timestamps.txt").write_text("".join([*lines[:lost], "\n" if empty else lines[lost], *lines[lost + 1 :]]))
    recording = read_kitti(options(root))
    expected = [number / 10 for number in range(6) if number != lost]
    assert [sweep.time_s - FIRST_S for sweep in recording.sweeps] == pytest.approx(expected, abs=1e-6)
    front = [each.time_s - FIRST_S for each in recording.pictures if each.camera == "image_02"]
    assert front == pytest.approx(np.arange(6) / 10, abs=1e-6)


DAY, FOLDER = DRIVE[:10], f"{DRIVE[:10]}/{DRIVE}"
CAM, TURNS = f"{DAY}/calib_cam_to_cam.txt", f"{FOLDER}/velodyne_points"


@pytest.mark.parametrize(
    ("pattern", "change", "said"),
    [
        (DAY, None, r"2011_09_26: no such folder; .* the drive is not downloaded"),
        (f"{FOLDER}/image_03", None, r"image_03/data: no such folder; .* or leave out that camera"),
        (CAM, None, r"calib_cam_to_cam\.txt: no such file"),
        (CAM, ("P_rect_03:.*", ""), r"cam_to_cam\.txt: has no line P_rect_03; there are corner"),
        (CAM, ("P_rect_03: \\S+", "P_rect_03:"), r"P_rect_03 has 11 numbers, expected 12"),
        (CAM, ("P_rect_03: \\S+", "P_rect_03: 0"), r"P_rect_03 is no projection of rectified"),
        (CAM, ("S_rect_02: \\S+", "S_rect_02: 1.242e+03"), r"S_rect_02 is 1242×64, but .*96×64"),
        (CAM, ("S_02.*", "junk"), r"line 4: 'junk', expected a name, a colon and numbers"),
        (f"{DAY}/calib_velo_to_cam.txt", ("R: \\S+", "R: 3"), r"velo_to_cam\.txt: R and T: not a rotation"),
        (f"{TURNS}/timestamps.txt", b"2011-09-26 13:02:25.0\n", r"ends after line 1, but .* needs line 6"),
        (f"{TURNS}/timestamps.txt", b"2011-09-26 13:02:25\n" * 6, r"line 2: not after the line before"),
        (f"{FOLDER}/oxts/data", None, r"oxts/data: no files such as 0000000000\.txt"),
        (f"{FOLDER}/oxts/data/0000000001.txt", b"49 8 100\n", r"0000000001\.txt: 3 numbers, expected latitude"),
        (f"{FOLDER}/oxts/data/0000000001.txt", b"8 490 1 0 0 0\n", r"8, 490 is no latitude and longitude"),
        (f"{FOLDER}/oxts/data/000000000[1-9].txt", None, r"oxts/data: a path needs at least two poses"),
        (f"{FOLDER}/image_02/data/*.png", None, r"image_02/data: no \.png"),
    ],
)
def test_what_is_wrong_with_raw_data(raw: Path, tmp_path: Path, pattern: str, change: Change, said: str) -> None:
    root = Path(shutil.copytree(raw, tmp_path / "raw"))
    spoil(root, pattern, change)
    with pytest.raises((InputError, FileNotFoundError), match=said):
        read_kitti(options(root))


@pytest.mark.parametrize(
    ("pattern", "change", "said"),
    [
        ("sequences/07/calib.txt", ("Tr:.*", ""), r"calib\.txt: has no line Tr; there are P2, P3"),
        ("poses/07.txt", None, r"poses/07\.txt: no such file; sequences from 11 on have none\. .*--poses lidar"),
        ("sequences/07/image_3", None, r"image_3: no such folder; .*image_03"),
    ],
)
def test_what_is_wrong_with_odometry(odometry: Path, tmp_path: Path, pattern: str, change: Change, said: str) -> None:
    root = Path(shutil.copytree(odometry, tmp_path / "dataset"))
    spoil(root, pattern, change)
    with pytest.raises((InputError, FileNotFoundError), match=said):
        read_kitti(options(root, "07"))
    if pattern.startswith("poses"):
        assert len(read_kitti(options(root, "07", poses="lidar")).sweeps) == 6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sequence": "2011_09_26_drive_0005_extract"}, "Download the synced and rectified one"),
        ({"sequence": "0005"}, "--sequence 0005: expected a drive of the raw data such as"),
        ({"sequence": "07"}, "is not the folder of the odometry benchmark"),
        ({"cameras": ("image_2",)}, "--cameras image_2: expected some of image_00"),
        ({"cameras": ()}, "--cameras : expected some of"),
        ({"root": Path("nowhere")}, "nowhere: no such folder"),
    ],
)
def test_options(raw: Path, changes: dict, said: str) -> None:
    with pytest.raises((InputError, FileNotFoundError), match=said):
        read_kitti(replace(options(raw), **changes))
