"""The path from LiDAR alone, against the true one of rendered sweeps; no pictures are rendered."""

import dataclasses
import functools
import math
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from drives import synthesize_coarsely, without_lidar_check
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.lidar import Sweep, SweepTiming
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.poses.odometry import TimedSweep, odometry, steps_of
from edge_depth_nerf.poses.path_agreement import PATHS_AGREE, compare_paths, read_agreement, write_agreement
from edge_depth_nerf.process import lidar_poses as lidar_poses_module
from edge_depth_nerf.process import pose_checks
from edge_depth_nerf.process.build import process_recording
from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.lidar_poses import check_sweeps, lidar_poses, path_of
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions
from edge_depth_nerf.process.pose_checks import lidar_says
from edge_depth_nerf.process.recording import DepthFile, RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.synthetic.layout import DriveLayout
from edge_depth_nerf.synthetic.lidar import Scanner, sweep
from edge_depth_nerf.synthetic.motion import Drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.render import World
from edge_depth_nerf.synthetic.rig import VELO_TO_POSE
from edge_depth_nerf.synthetic.scenes import build_scene

QUIET = Console(quiet=True)
TURN_S = 0.1
FRAMES = 14
SCANNERS = {
    32: Scanner.turning(2.0, -24.8, 32, 500, VELO_TO_POSE),
    16: Scanner.turning(15.0, -15.0, 16, 900, VELO_TO_POSE),
}
"""By their rings."""

Poses = Callable[[np.ndarray], np.ndarray]


@pytest.fixture
def options(tmp_path: Path) -> ProcessOptions:
    return ProcessOptions(output=tmp_path / "scene", poses="lidar")


class Motion(Drive):
    """A drive along any path."""

    def __init__(self, poses: Poses) -> None:
        object.__setattr__(self, "_poses", poses)

    def pose_to_world(self, time_s: np.ndarray) -> np.ndarray:
        return self._poses(time_s)  # pyrefly: ignore


@functools.cache
def rendered(scene: str) -> tuple[World, Poses]:
    model = build_scene(SynthesizeOptions(Path("none"), scene, frames=FRAMES))  # pyrefly: ignore[bad-argument-type]
    return World(model, 0), model.drive.pose_to_world


@functools.cache
def scanned(scene: str, frames: int, rings: int = 32, motion: str = "drive") -> tuple[Recording, Poses]:
    """Sweeps of a rendered scene with a picture each, whose files are not there; and where the vehicle truly is."""
    world, poses = rendered(scene)
    if motion != "drive":
        start = poses(np.array([1.0 if motion in ("stands", "turns") else 0.0]))[0]
        rate, speed_m_s = {"stands": (0.0, 0.0), "turns": (0.6, 0.0), "bends": (-0.6, 7.0)}[motion]

        def moved(time_s: np.ndarray) -> np.ndarray:
            turn = np.tile(np.eye(4), (len(time_s), 1, 1))
            turn[:, :3, :3] = Rotation.from_euler("z", np.c_[rate * time_s]).as_matrix()
            turn[:, :2, 3] = speed_m_s * np.stack((np.sin(rate * time_s), 1 - np.cos(rate * time_s)), -1) / (rate or 1)
            return start @ turn

        poses = moved

    sweeps = []
    for frame in range(frames):
        time_s = TURN_S * frame
        taken = sweep(world, Motion(poses), time_s, np.random.default_rng(frame), SCANNERS[rings])
        points = torch.from_numpy(taken.raw.astype(np.float64))
        read = Sweep(points[:, :3], points[:, 3], 0, 0)
        where = (Path(__file__), time_s, frame, "roof", VELO_TO_POSE)
        sweeps.append(RecordedSweep(*where, lambda read=read: read, SweepTiming(TURN_S)))
    lens = Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0)
    to_vehicle = np.eye(4)
    to_vehicle[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    pictures = [RecordedPicture("front", frame, Path(f"{frame}.png"), TURN_S * frame + 0.01) for frame in range(frames)]
    return Recording((RecordedCamera("front", lens, to_vehicle),), tuple(pictures), tuple(sweeps), None, {}), poses


def errors(path: Trajectory, poses: Poses) -> tuple[np.ndarray, np.ndarray, float]:
    """How far the path lies from the true one when their first poses are one; its steps' errors; its true length."""
    true = poses(path.times_s)
    found = true[0] @ np.linalg.inv(path.vehicle_to_world[0]) @ path.vehicle_to_world
    apart = np.linalg.norm((found - true)[:, :3, 3], axis=-1)
    steps = np.linalg.inv(found[:-1]) @ found[1:]
    expected = np.linalg.inv(true[:-1]) @ true[1:]
    length_m = np.linalg.norm(expected[:, :3, 3], axis=-1).sum()
    return apart, np.linalg.norm((steps - expected)[:, :3, 3], axis=-1), float(length_m)


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["drive", "bends"])
def test_the_path_is_right_from_the_first_step(motion, options):
    pytest.importorskip("kiss_icp")
    recording, poses = scanned("street", FRAMES, motion=motion)
    found = lidar_poses(recording, options, QUIET)
    assert found.trajectory is not None
    apart, steps, length_m = errors(found.trajectory, poses)
    # of a sixth of a real scanner's returns, on 8 to 11 m
    assert apart[-1] < 0.01 * length_m
    # the first step is unknown to an odometry that begins with a vehicle that stands: 0.8 m here
    assert steps[:5].max() < 0.06 and steps.mean() < 0.03
    # its world: z up, the first pose its origin, off along x
    vehicle = found.trajectory.vehicle_to_world
    np.testing.assert_allclose(vehicle[0, :3, 3], 0, atol=1e-9)
    assert np.degrees(np.arccos((vehicle[:, 2, :3] * poses(found.trajectory.times_s)[:, 2, :3]).sum(-1))).max() < 1.5
    half = np.linalg.norm(vehicle[:, :3, 3], axis=-1).argmax() // 2
    assert vehicle[half, 0, 3] > 0 and abs(vehicle[half, 1, 3]) < 0.3 * vehicle[half, 0, 3]
    # pictures at their own times, 10 ms after the sweeps
    true = poses(np.array([picture.time_s for picture in found.pictures]))
    to_true = poses(np.zeros(1))[0] @ np.linalg.inv(vehicle[0])
    centres = np.stack([(to_true @ p.camera_to_world)[:3, 3] for p in found.pictures if p.camera_to_world is not None])
    assert np.linalg.norm(centres - true[:, :3, 3], axis=-1).max() < 0.15
    assert any(f"followed {FRAMES} sweeps of roof: the path is " in notice for notice in found.notices)


@pytest.mark.slow
def test_the_same_sweeps_give_the_same_path():
    pytest.importorskip("kiss_icp")
    recording, _ = scanned("street", FRAMES)
    sweeps = [TimedSweep(s.time_s, functools.partial(points_of, s)) for s in recording.sweeps[:6]]
    steps: list[int] = []
    first = odometry(sweeps, lambda: steps.append(1))
    assert len(steps) == steps_of(6)
    np.testing.assert_array_equal(first.vehicle_to_world, odometry(sweeps).vehicle_to_world)


def points_of(recorded: RecordedSweep) -> tuple[np.ndarray, np.ndarray]:
    read, timing = recorded.read(), recorded.timing
    assert timing is not None
    in_vehicle = read.points_m.numpy() @ recorded.to_vehicle[:3, :3].T + recorded.to_vehicle[:3, 3]
    return in_vehicle, timing.offsets_s(read.points_m).numpy()


@pytest.mark.slow
@pytest.mark.parametrize(("kept", "share"), [(10, 0.01), (5, 0.02)])
def test_few_sweeps_are_enough(kept, share, options):
    pytest.importorskip("kiss_icp")
    recording, poses = scanned("street", FRAMES)
    few = dataclasses.replace(recording, sweeps=recording.sweeps[:kept], pictures=recording.pictures[:kept])
    found = lidar_poses(few, options, QUIET)
    assert found.trajectory is not None
    apart, _, length_m = errors(found.trajectory, poses)
    assert apart.max() < max(share * length_m, 0.05)


@pytest.mark.slow
def test_sixteen_rings_are_enough_on_a_street(options):
    pytest.importorskip("kiss_icp")
    recording, poses = scanned("street", FRAMES, rings=16)
    found = lidar_poses(recording, options, QUIET)
    assert found.trajectory is not None
    apart, _, length_m = errors(found.trajectory, poses)
    assert apart[-1] < 0.01 * length_m


@pytest.mark.slow
def test_pictures_away_from_the_sweeps_are_listed(options):
    pytest.importorskip("kiss_icp")
    recording, _ = scanned("street", FRAMES)
    short = dataclasses.replace(recording, sweeps=recording.sweeps[:8])
    found = lidar_poses(short, options, QUIET)
    assert [picture.frame for picture in found.pictures] == list(range(8)) and len(found.skipped) == FRAMES - 8
    # the last sweep's turn reaches half a frame further
    assert found.skipped[-1].frame == FRAMES - 1 and found.skipped[-1].reason == "no sweep near it in time"


@pytest.mark.slow
def test_a_drive_without_poses_becomes_a_scene(tmp_path, monkeypatch):
    """Every second frame of it is asked for."""
    pytest.importorskip("kiss_icp")
    root = tmp_path / "drive"
    with pytest.MonkeyPatch.context() as patch:
        # KITTI-360's own scanner measures four times as many points
        patch.setattr(DriveLayout, "scanner", Scanner.turning(2.0, -24.8, 64, 450, VELO_TO_POSE))
        synthesize_coarsely(SynthesizeOptions(root, "parking", frames=7, size=64))
    next(root.rglob("cam0_to_world.txt")).unlink()
    next(root.rglob("poses.txt")).unlink()
    blind = Kitti360Options(
        root=root,
        sequence=SynthesizeOptions(root).sequence,
        output=tmp_path / "scene",
        poses="lidar",
        stride=2,
        find_ego=False,
        refine_poses=False,
        sweeps=1,
    )
    without_lidar_check(monkeypatch)
    report = process_recording(read_drive(blind), blind, QUIET)
    # the path is kept for the next run
    monkeypatch.setattr(lidar_poses_module, "path_of", None)
    again = process_recording(read_drive(blind), blind, QUIET).notices
    assert set(again) <= set(report.notices)
    notices = " ".join(again)
    # every sweep is followed, not only those of the frames asked for: 0.6 s at some 4 m/s
    length = re.search(r"followed 7 sweeps of \w+: the path is ([0-9.]+) m long", notices)
    assert length is not None and 2.2 < float(length[1]) < 2.7
    assert "epipolar curves" in notices or "Too few features match" in notices
    assert not report.skipped
    scene = read_scene(blind.output)
    assert len(scene.frames()) == 4
    assert scene.has("lidar")


def test_paths_are_compared_in_any_world(tmp_path):
    first = driven(np.full(30, 8.0), np.linspace(0, 0.5, 30), 0.1)
    world = np.eye(4)
    world[:3, :3] = Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix()
    world[:3, 3] = (100, -40, 7)
    same = Trajectory(first.times_s, world @ first.vehicle_to_world)
    found = compare_paths(first, same)
    assert found is not None and found.max_m < 1e-9 and found.scale == pytest.approx(1)
    assert found.length_m == pytest.approx(8.0 * 2.9)
    # 2 % too long: its ends lie 1 % of the length off
    longer = same.vehicle_to_world.copy()
    longer[:, :3, 3] *= 1.02
    found = compare_paths(first, Trajectory(first.times_s, longer))
    assert found is not None and found.scale == pytest.approx(1.02)
    assert found.max_m == pytest.approx(0.01 * found.length_m, rel=0.1)
    # what lies beyond the other's ends does not count
    assert compare_paths(first, Trajectory(first.times_s[:2], first.vehicle_to_world[:2])) is None

    write_agreement(tmp_path, found, first)
    assert read_agreement(tmp_path) == read_agreement(tmp_path, first) == found
    assert read_agreement(tmp_path, same) is None
    assert read_agreement(tmp_path / "elsewhere") is None
    (tmp_path / PATHS_AGREE).write_text('{"mean_m": "far"}')
    with pytest.raises(InputError, match=r"paths_agree\.json: expected mean_m"):
        read_agreement(tmp_path)


@pytest.mark.slow
def test_a_path_from_pictures_is_held_against_lidar(tmp_path, monkeypatch):
    pytest.importorskip("kiss_icp")
    recording, poses = scanned("street", FRAMES)
    times = np.array([sweep.time_s for sweep in recording.sweeps])
    true = Trajectory(times, poses(times))
    path = path_of(check_sweeps(recording), QUIET)
    monkeypatch.setattr(pose_checks, "path_of", lambda *_: path)
    said = lidar_says(dataclasses.replace(recording, trajectory=true), tmp_path, QUIET)
    found = read_agreement(tmp_path)
    assert found is not None and found.max_m < 0.1 and found.scale == pytest.approx(1, abs=0.01)
    assert len(said) == 1 and found.text() in said[0]
    # the second time it is read
    with monkeypatch.context() as patch:
        patch.setattr(pose_checks, "path_of", None)
        assert lidar_says(dataclasses.replace(recording, trajectory=true), tmp_path, QUIET) == said
    # a path that bends where the vehicle does not
    bent = true.vehicle_to_world.copy()
    bent[7:, 1, 3] += 0.4 * np.arange(FRAMES - 7)
    said = lidar_says(dataclasses.replace(recording, trajectory=Trajectory(times, bent)), tmp_path, QUIET)
    assert len(said) == 2 and "one of the two is wrong" in said[1]
    # where it cannot be told, nothing is said
    assert lidar_says(dataclasses.replace(recording, trajectory=true, sweeps=()), tmp_path / "other", QUIET) == []


@pytest.mark.slow
@pytest.mark.parametrize(("motion", "message"), [("stands", "stands still"), ("turns", r"turns on the spot, by \d+°")])
def test_a_vehicle_that_goes_nowhere_has_no_path(motion, message, options):
    pytest.importorskip("kiss_icp")
    recording, _ = scanned("parking", 8, motion=motion)
    with pytest.raises(InputError, match=rf"--poses lidar: the vehicle {message}.*Use frames of a stretch"):
        lidar_poses(recording, options, QUIET)


def test_a_missing_package_is_named_with_the_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    with pytest.raises(InputError, match=r"pip install '\.\[odometry\]'"):
        check_sweeps(Recording((), (), (), None, {}))


def sweeps_at(times_s: list[float], points_of_sweep: int = 6000, scanner: str = "roof") -> list[RecordedSweep]:
    points = torch.rand(points_of_sweep, 3, dtype=torch.float64) + 5
    read = Sweep(points, points[:, 0], 0, 0)
    return [
        RecordedSweep(Path(f"lidar/{scanner}_{number}.bin"), time, number, scanner, np.eye(4), lambda: read)
        for number, time in enumerate(times_s)
    ]


@pytest.mark.parametrize(
    ("sweeps", "depth", "message"),
    [
        ([], False, "the recording has no LiDAR sweeps"),
        ([], True, "depth maps instead of LiDAR sweeps.*--poses colmap"),
        (sweeps_at([0.0, 0.1, 0.2, 0.3]), False, "4 sweeps of roof, expected 5 or more"),
        (sweeps_at([0.1 * n for n in range(9)], 900), False, "900 points a sweep.*expected 5000 or more"),
        (sweeps_at([0.0, 0.1, 0.2, 2.3, 2.4]), False, "no sweep for 2.1 s after lidar/roof_2.bin"),
    ],
)
def test_what_cannot_be_followed_is_said_at_once(sweeps, depth, message):
    pytest.importorskip("kiss_icp")
    maps = DepthFile(Path("depth.png"), 0.01, "distance") if depth else None
    picture = RecordedPicture("front", 0, Path("0.png"), 0.0, depth=maps)
    with pytest.raises(InputError, match=message):
        check_sweeps(Recording((), (picture,), tuple(sweeps), None, {}))


def test_the_scanner_with_most_points_is_followed():
    pytest.importorskip("kiss_icp")
    times = [0.1 * number for number in range(6)]
    sweeps = [*sweeps_at(times, 6000, "front"), *sweeps_at(times, 9000, "roof"), *sweeps_at(times[:3], 10_000, "rear")]
    followed = check_sweeps(Recording((), (), tuple(sweeps[::-1]), None, {}))
    assert [sweep.scanner for sweep in followed] == ["roof"] * 6
    assert [sweep.time_s for sweep in followed] == times


def driven(speed_m_s: np.ndarray, course_rad: np.ndarray, interval_s: float) -> Trajectory:
    ahead = np.stack((np.cos(course_rad), np.sin(course_rad), 0 * course_rad), -1)
    poses = np.tile(np.eye(4), (len(speed_m_s), 1, 1))
    poses[1:, :3, 3] = np.cumsum((ahead * speed_m_s[:, None] * interval_s)[:-1], axis=0)
    poses[:, :3, :3] = Rotation.from_euler("z", np.c_[course_rad]).as_matrix()
    return Trajectory(interval_s * np.arange(len(speed_m_s)), poses)


@pytest.mark.parametrize("interval_s", [0.05, 1.0])
def test_what_a_car_does_is_no_break(interval_s):
    time = np.arange(0, 12, interval_s)
    hard = np.clip(25 - 8 * np.maximum(time - 3, 0), 0, None)  # full braking
    assert find_break(driven(hard, 0 * time, interval_s)) is None
    circle = driven(0 * time + 5, time, interval_s)  # a circle of 5 m radius at 18 km/h
    assert find_break(circle) is None
    rng = np.random.default_rng(0)
    shaken = circle.vehicle_to_world.copy()
    shaken[:, :3, 3] += rng.normal(0, 0.03, (len(shaken), 3))
    assert find_break(Trajectory(circle.times_s, shaken)) is None


@pytest.mark.parametrize(
    ("speed", "course_deg", "message"),
    [
        ((8.0, 14.0), (0.0, 0.0), r"from 8\.0 to 14\.0 m/s"),
        ((10.0, 10.0), (0.0, 60.0), r"turn its course by 60°"),
        ((0.1, 0.1), (0.0, 100.0), r"would turn by 100°"),
    ],
)
def test_what_no_car_does_is_named(speed, course_deg, message):
    later = np.arange(40) >= 20
    path = driven(np.where(later, *speed[::-1]), np.radians(np.where(later, *course_deg[::-1])), 0.1)  # pyrefly: ignore
    found = find_break(path)
    assert found is not None and found.first < 20 <= found.last
    assert math.isclose(found.first, 15, abs_tol=5)
    assert re.search(message, found.what)
