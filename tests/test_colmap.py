import contextlib
import dataclasses
import functools
import math
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from alignment import umeyama
from drives import MeiTwin, without_lidar_check
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image, read_mask, write_distance_png, write_mask, write_png
from edge_depth_nerf.cameras import MEI, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.transforms import opencv_to_opengl
from edge_depth_nerf.lidar import Sweep, SweepTiming
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.process.colmap import models as colmap_models
from edge_depth_nerf.process.colmap import poses as colmap_poses_module
from edge_depth_nerf.process.colmap.models import ColmapModel, SparseView, colmap_lens
from edge_depth_nerf.process.colmap.poses import NOT_REGISTERED, colmap_poses
from edge_depth_nerf.process.colmap.scale import find_scale_break, join_models, metric_path
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.kitti360.converter import read_kitti360
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions
from edge_depth_nerf.process.recording import DepthFile, RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.process.vehicle import with_given_masks
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

QUIET = Console(quiet=True)


def read_drive(options: Kitti360Options) -> Recording:
    return with_given_masks(read_kitti360(options), options)


def options_of(root: Path, output: Path, **changes) -> Kitti360Options:
    return Kitti360Options(root=root, sequence=SynthesizeOptions.sequence, output=output, **changes)


def rays_within(degrees: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    theta, phi = np.radians(rng.uniform(0, degrees, 500)), rng.uniform(0, 2 * np.pi, 500)
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1)


def twin_of(c: KannalaBrandt | Pinhole, rays: np.ndarray) -> np.ndarray:
    """Pixels of rays, written out."""
    is_fisheye = isinstance(c, KannalaBrandt)
    along = np.arccos(rays[:, 2]) / np.hypot(*rays[:, :2].T) if is_fisheye else 1 / rays[:, 2]
    x, y = rays[:, :2].T * along
    r2 = x * x + y * y
    radial = 1 + c.k1 * r2 + c.k2 * r2**2 + c.k3 * r2**3 + (c.k4 * r2**4 if is_fisheye else 0)
    u = x * radial + 2 * c.p1 * x * y + c.p2 * (r2 + 2 * x * x)
    v = y * radial + c.p1 * (r2 + 2 * y * y) + 2 * c.p2 * x * y
    return np.stack((c.fx * u + c.cx, c.fy * v + c.cy), -1)


SEEN = (640, 480, 300.0, 306.0, 322.5, 238.0)


@pytest.mark.parametrize("name", ["image_02", "image_03", "kannala_brandt", "pinhole"])
def test_colmap_projects_as_the_camera_does(name):
    pycolmap = pytest.importorskip("pycolmap")
    if name.startswith("image"):
        twin = MeiTwin.kitti360(name, 350)
        numbers = (twin.gamma1, twin.gamma2, twin.u0 + 0.5, twin.v0 + 0.5, twin.xi, twin.k1, twin.k2, twin.p1, twin.p2)
        camera = MEI(350, 350, *map(float, numbers))
        # no COLMAP model is MEI: the nearest one is fitted
        rays, tolerance_px = rays_within(84), 0.02
        expected = twin.project(rays) + 0.5
    else:
        camera, degrees = {
            "kannala_brandt": (KannalaBrandt(*SEEN, -0.01, 0.008, -0.002, 1e-4, 3e-3, -2e-3), 84),
            "pinhole": (Pinhole(*SEEN, -0.2, 0.05, 1e-3, -2e-3, 0.01), 35),
        }[name]
        rays, tolerance_px = rays_within(degrees), 1e-9
        expected = twin_of(camera, rays)
    lens = colmap_lens(camera)
    theirs = pycolmap.Camera(model=lens.model, width=camera.width, height=camera.height, params=list(lens.parameters))
    np.testing.assert_allclose(np.array(theirs.img_from_cam(rays)), expected, rtol=0, atol=tolerance_px)


SPEED_M_S = 10.0
LEVER = {"left": (0.7, -0.3, -1.0), "right": (0.5, 0.9, -1.1)}


def looking(name: str) -> np.ndarray:
    """Camera to vehicle (x forward, y right, z down), looking left or right."""
    to_vehicle = np.eye(4)
    z = np.array([0.1, -1.0, 0.05]) if name == "left" else np.array([-0.1, 1.0, 0.0])
    z /= np.linalg.norm(z)
    x = np.cross([0, 0, 1.0], z)
    x /= np.linalg.norm(x)
    to_vehicle[:3, :3] = np.stack((x, np.cross(z, x), z), -1)
    to_vehicle[:3, 3] = LEVER[name]
    return to_vehicle


def true_pose(time_s: np.ndarray | float) -> np.ndarray:
    """Vehicle to world: a bend, z down, some pitch."""
    time_s = np.asarray(time_s, float)
    yaw = 0.25 * time_s
    rotation = Rotation.from_euler("xyz", np.stack((np.pi + 0 * yaw, 0.01 * np.sin(3 * time_s), yaw), -1)).as_matrix()
    pose = np.zeros((*time_s.shape, 4, 4))
    pose[..., :3, :3], pose[..., 3, 3] = rotation, 1
    pose[..., 0, 3] = SPEED_M_S / 0.25 * np.sin(yaw)
    pose[..., 1, 3] = -SPEED_M_S / 0.25 * np.cos(yaw)
    pose[..., 2, 3] = 0.93
    return pose


def recording(frames: int, cameras=("left", "right"), sweeps=()) -> Recording:
    lens = KannalaBrandt(300, 300, 90.0, 90.0, 150.0, 150.0, 0.0, 0.0, 0.0, 0.0)
    return Recording(
        cameras=tuple(RecordedCamera(name, lens, looking(name)) for name in cameras),
        # the right camera fires 4 ms after the left
        pictures=tuple(
            RecordedPicture(name, frame, Path(f"{name}/{frame}.png"), 0.1 * frame + 0.004 * number)
            for frame in range(frames)
            for number, name in enumerate(cameras)
        ),
        sweeps=tuple(sweeps),
        trajectory=None,
        source={},
    )


def model_of(recording: Recording, indices, metres_per_unit: float, seed: int, points=None, noise=0.0) -> ColmapModel:
    """What COLMAP would find: true poses and points in a world and a unit of their own."""
    rng = np.random.default_rng(seed)
    world_to_model = np.eye(4)
    world_to_model[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    world_to_model[:3, 3] = rng.normal(size=3) * 50
    to_vehicle = {camera.name: camera.to_vehicle for camera in recording.cameras}
    poses, views = {}, {}
    for index in indices:
        picture = recording.pictures[index]
        pose = true_pose(picture.time_s) @ to_vehicle[picture.camera]
        if points is not None:
            seen = (points - pose[:3, 3]) @ pose[:3, :3]
            distance = np.linalg.norm(seen, axis=-1)
            wanted = seen[:, 2] > 0.1 * distance
            error = 1 + noise * rng.standard_normal(wanted.sum())
            views[index] = SparseView(seen[wanted] / distance[wanted, None], distance[wanted] / metres_per_unit * error)
        pose = world_to_model @ pose
        pose[:3, 3] /= metres_per_unit
        poses[index] = pose
    return ColmapModel(poses, views, 0 if points is None else len(points), 0.3)


def worst_deviation_m(path, recording) -> float:
    """How far the path lies from the true one, after a rigid motion."""
    found = path.trajectory.vehicle_to_world
    true = true_pose(path.trajectory.times_s)
    to_true = true[0] @ np.linalg.inv(found[0])
    return float(np.abs(to_true @ found - true).max())


def test_models_without_a_common_view_are_joined_by_the_rig():
    drive = recording(20)
    left, right = range(0, len(drive.pictures), 2), range(1, len(drive.pictures), 2)
    # the right camera is lost halfway, and what is seen then has two frames in common: too few
    models = [
        model_of(drive, left[:16], 2.5, seed=1),
        model_of(drive, right[:12], 0.4, seed=2),
        model_of(drive, right[14:], 7.0, seed=3),
    ]
    # the second one's scale is off by 1 %: the first one's counts
    path = join_models(drive, models, [2.5, 0.404, 7.0])
    assert sorted(path.vehicle_poses) == list(range(16))
    assert path.scales == pytest.approx((2.5, 0.4), rel=2e-4)
    # 10 m/s for 4 ms are 4 cm
    assert worst_deviation_m(path, drive) < 1e-2
    assert path.disagreement_m < 5e-3

    # joined, where the third has more in common
    models[2] = model_of(drive, right[12:], 7.0, seed=3)
    path = join_models(drive, models, [2.5, 0.4, 7.0])
    assert sorted(path.vehicle_poses) == list(range(20))
    assert worst_deviation_m(path, drive) < 1e-2


def test_cameras_of_one_model_are_averaged():
    drive = recording(12)
    model = model_of(drive, range(24), 3.0, seed=4)
    wrong = 11  # the right camera at frame 5, moved by 10 cm
    model.camera_to_model[wrong] = model.camera_to_model[wrong].copy()
    model.camera_to_model[wrong][:3, 3] += np.array([0.1, 0, 0]) / 3.0
    path = join_models(drive, [model], [3.0])
    true = true_pose(path.trajectory.times_s)
    found = (true[0] @ np.linalg.inv(path.trajectory.vehicle_to_world[0])) @ path.trajectory.vehicle_to_world
    apart = np.linalg.norm((found - true)[:, :3, 3], axis=-1)
    assert apart[5] == pytest.approx(0.05, abs=3e-3)
    assert np.delete(apart, 5).max() < 3e-3


def wall_points(count: int, seed: int) -> np.ndarray:
    """Points on four walls around the bend."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-25, -50, 0), (30, 0, 4), (count, 3))
    side = rng.integers(0, 3, count)
    points[:, 1] = np.where(side == 0, -50.0, np.where(side == 1, 0.0, points[:, 1]))
    points[:, 0] = np.where(side == 2, 30.0, points[:, 0])
    return points


def turning_scanner(frame: int, points: np.ndarray, behind: float = 0.0) -> RecordedSweep:
    """A sweep of the points, each measured from where the vehicle is when the laser faces it; some from behind."""
    to_vehicle = np.diag([1.0, -1.0, -1.0, 1.0])
    to_vehicle[:3, 3] = (0.0, 0.1, -0.8)
    timing = SweepTiming(0.1)
    offset = np.zeros(len(points))
    local = points
    for _ in range(8):
        # when it is measured depends on where it is seen, and the other way round
        world_to_scanner = np.linalg.inv(true_pose(0.1 * frame + offset) @ to_vehicle)
        local = np.einsum("nij,nj->ni", world_to_scanner[:, :3, :3], points) + world_to_scanner[:, :3, 3]
        azimuth = np.arctan2(local[:, 1], local[:, 0])
        offset = -azimuth / (2 * np.pi) * 0.1
    rng = np.random.default_rng(frame)
    local = local * np.where(rng.random(len(local)) < behind, rng.uniform(1.2, 2, len(local)), 1.0)[:, None]
    sweep = Sweep(torch.from_numpy(local), torch.ones(len(local), dtype=torch.float64), 0, 0)
    return RecordedSweep(
        Path(f"{frame}.bin"), 0.1 * frame, frame, "scanner", to_vehicle, functools.partial(lambda s: s, sweep), timing
    )


def cloud_around(features: np.ndarray, seed: int) -> np.ndarray:
    """Four returns beside each feature, on its wall."""
    rng = np.random.default_rng(seed)
    near = np.repeat(features, 4, axis=0) + rng.uniform(-0.03, 0.03, (4 * len(features), 3))
    for axis, at in ((1, -50.0), (1, 0.0), (0, 30.0)):
        near[np.repeat(features[:, axis] == at, 4), axis] = at
    return near


def test_the_scale_is_that_of_lidar_moved_by_the_path():
    features = wall_points(150, seed=5)
    cloud = cloud_around(features, seed=6)
    drive = recording(12, sweeps=[turning_scanner(frame, cloud) for frame in range(12)])
    left, right = range(0, len(drive.pictures), 2), range(1, len(drive.pictures), 2)
    models = [
        model_of(drive, left, 2.5, seed=1, points=features, noise=0.02),
        model_of(drive, right, 0.4, seed=2, points=features, noise=0.02),
    ]
    path, scale = metric_path(drive, models)
    assert scale.ratio == pytest.approx(2.5, rel=3e-3)
    # the quartiles of a normal distribution lie 0.674 deviations from its middle
    assert scale.spread == pytest.approx(0.674 * 0.02, rel=0.25)
    assert scale.pairs > 500
    assert worst_deviation_m(path, drive) < 0.005 * SPEED_M_S * 1.1

    # the sweeps' timing is what makes it so: what lies ahead seems too far, what lies behind too near
    exact = [model_of(drive, left, 2.5, seed=1, points=features), model_of(drive, right, 0.4, seed=2, points=features)]
    still = dataclasses.replace(drive, sweeps=tuple(dataclasses.replace(s, timing=None) for s in drive.sweeps))
    assert metric_path(still, exact)[1].spread > 5 * metric_path(drive, exact)[1].spread


def test_points_that_see_past_an_edge_do_not_count():
    features = wall_points(150, seed=5)
    # a fifth of the returns lie behind what the feature is on
    sweeps = [turning_scanner(frame, cloud_around(features, seed=6), behind=0.2) for frame in range(12)]
    drive = recording(12, cameras=("left",), sweeps=sweeps)
    _, scale = metric_path(drive, [model_of(drive, range(12), 2.5, seed=1, points=features)])
    assert scale.ratio == pytest.approx(2.5, rel=2e-3)
    assert scale.spread < 0.005


def test_the_scale_can_come_from_depth_maps(tmp_path):
    features = wall_points(400, seed=7)
    drive = recording(6, cameras=("left",))
    kept = []
    for picture in drive.pictures:
        camera = drive.cameras[0]
        pose = true_pose(picture.time_s) @ camera.to_vehicle
        rays, valid = camera.camera.unproject(camera.camera.pixel_centres())
        world = rays.numpy() @ pose[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = ((1, -50.0), (1, 0.0), (0, 30.0))
            reach = np.stack([(at - pose[axis, 3]) / world[..., axis] for axis, at in walls])
        distance = np.where(valid.numpy(), np.min(np.where(reach > 0, reach, np.inf), axis=0), 0)
        # along the axis, in centimetres, as other sensors write it
        z_depth = np.where(rays.numpy()[..., 2] > 0.05, distance * rays.numpy()[..., 2], 0)
        path = tmp_path / f"{picture.frame}.png"
        write_distance_png(path, z_depth * 100 / 256)
        kept.append(dataclasses.replace(picture, depth=DepthFile(path, 0.01, "z_depth")))
    drive = dataclasses.replace(drive, pictures=tuple(kept))
    _, scale = metric_path(drive, [model_of(drive, range(6), 1.7, seed=1, points=features)])
    assert scale.ratio == pytest.approx(1.7, rel=3e-3)


def broken_at(model: ColmapModel, recording: Recording, first: int, scale: float, bend_deg: float) -> ColmapModel:
    """The model with all frames from one on scaled and turned about the place that they begin at."""
    index = next(i for i, picture in enumerate(recording.pictures) if picture.frame == first)
    pivot = model.camera_to_model[index].copy()
    turn = Rotation.from_euler("y", bend_deg, degrees=True).as_matrix()
    turn = pivot[:3, :3] @ turn @ pivot[:3, :3].T
    poses, views = dict(model.camera_to_model), dict(model.views)
    for number, pose in poses.items():
        if recording.pictures[number].frame >= first:
            moved = pose.copy()
            moved[:3, :3] = turn @ pose[:3, :3]
            moved[:3, 3] = pivot[:3, 3] + scale * turn @ (pose[:3, 3] - pivot[:3, 3])
            poses[number] = moved
            views[number] = dataclasses.replace(views[number], distance=scale * views[number].distance)
    return dataclasses.replace(model, camera_to_model=poses, views=views)


@pytest.fixture(scope="module")
def measured_drive() -> tuple[Recording, ColmapModel]:
    features = wall_points(150, seed=5)
    cloud = cloud_around(features, seed=6)
    drive = recording(24, sweeps=[turning_scanner(frame, cloud) for frame in range(24)])
    return drive, model_of(drive, range(len(drive.pictures)), 4.25, seed=1, points=features, noise=0.03)


def test_a_scale_that_changes_is_named(measured_drive):
    drive, model = measured_drive
    path, scale = metric_path(drive, [model])
    assert scale.broken is None and find_break(path.trajectory) is None
    _, scale = metric_path(drive, [broken_at(model, drive, 14, 4.25 / 6.9, 0.0)])
    assert scale.broken is not None
    assert scale.broken.first <= 13 <= scale.broken.last <= 15
    assert scale.broken.after / scale.broken.before == pytest.approx(6.9 / 4.25, rel=0.05)
    # as numbers of metres per unit, not as shares of the median
    assert scale.broken.before == pytest.approx(4.25, rel=0.05)


def test_a_path_that_bends_is_named(measured_drive):
    drive, model = measured_drive
    path, scale = metric_path(drive, [broken_at(model, drive, 14, 1.0, -60.0)])
    assert scale.broken is None
    found = find_break(path.trajectory)
    assert found is not None and found.first <= 14 <= found.last <= found.first + 10
    assert "turn" in found.what


def test_a_broken_model_ends_the_command(measured_drive, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    drive, model = measured_drive
    monkeypatch.setattr(colmap_poses_module, "check_colmap", lambda *_: None)
    options = ProcessOptions(output=tmp_path / "scene", poses="colmap")
    monkeypatch.setattr(colmap_poses_module, "find_models", lambda *_: [model])
    assert len(colmap_poses(drive, options, QUIET).pictures) == len(drive.pictures)
    for scale, bend_deg in ((4.25 / 6.9, 40.0), (1.0, 90.0)):
        wrong = broken_at(model, drive, 14, scale, bend_deg)
        monkeypatch.setattr(colmap_poses_module, "find_models", lambda *_, wrong=wrong: [wrong])
        with pytest.raises(InputError, match=r"path breaks between frames \d+ and 1\d.*--poses lidar.*--stride 1"):
            colmap_poses(drive, options, QUIET)


def test_a_window_needs_features():
    assert find_scale_break({0: np.ones(0)}) is None
    assert find_scale_break({frame: np.full(30, 1.0 + (frame > 2)) for frame in range(5)}) is None
    many = find_scale_break({frame: np.full(50, 1.0 + (frame > 4)) for frame in range(10)})
    assert many is not None and (many.first, many.last, many.before, many.after) == (4, 5, 1.0, 2.0)
    # what the spread explains is no break
    rng = np.random.default_rng(0)
    assert find_scale_break({frame: 1 + 0.4 * rng.standard_normal(50) for frame in range(40)}) is None


def test_too_few_points_beside_points_are_an_error():
    features = wall_points(4, seed=5)
    drive = recording(6, cameras=("left",), sweeps=[turning_scanner(f, cloud_around(features, 6)) for f in range(6)])
    with pytest.raises(InputError, match=r"only \d+ of COLMAP's points have a LiDAR point next to them, expected 30"):
        metric_path(drive, [model_of(drive, range(6), 2.5, seed=1, points=features)])


def pictured(folder: Path, frames: int, size: int = 64) -> Recording:
    drive = recording(frames, sweeps=[turning_scanner(f, wall_points(50, f)) for f in range(frames)])
    lens = KannalaBrandt(size, size, 20.0, 20.0, size / 2, size / 2, 0.0, 0.0, 0.0, 0.0)
    pictures = []
    for picture in drive.pictures:
        path = folder / picture.path
        write_png(path, np.zeros((size, size, 3), np.uint8))
        pictures.append(dataclasses.replace(picture, path=path))
    cameras = tuple(dataclasses.replace(camera, camera=lens) for camera in drive.cameras)
    return dataclasses.replace(drive, cameras=cameras, pictures=tuple(pictures))


def test_a_missing_package_and_a_missing_scale_are_named_before_the_work(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match="none of the pictures has a LiDAR sweep or a depth map"):
        colmap_poses(recording(12), ProcessOptions(output=tmp_path / "scene"), QUIET)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install '\.\[colmap\]'"):
        colmap_poses(recording(12), ProcessOptions(output=tmp_path / "scene"), QUIET)
    assert not list(tmp_path.iterdir())


def test_foreign_files_are_left_alone(tmp_path):
    pytest.importorskip("pycolmap")
    foreign = tmp_path / ".scene.colmap" / "thesis.txt"
    foreign.parent.mkdir()
    foreign.write_text("dear")
    with pytest.raises(InputError, match="contains other files"):
        colmap_poses(pictured(tmp_path / "raw", 3), ProcessOptions(output=tmp_path / "scene"), QUIET)
    assert foreign.read_text() == "dear"


def test_a_mask_of_another_size_is_named(tmp_path):
    pytest.importorskip("pycolmap")
    write_mask(tmp_path / "ego.png", np.ones((32, 64), bool))
    drive = pictured(tmp_path / "raw", 3)
    masked = [dataclasses.replace(camera, ego_mask=tmp_path / "ego.png") for camera in drive.cameras]
    drive = dataclasses.replace(drive, cameras=tuple(masked))
    with pytest.raises(InputError, match=r"ego\.png: 64×32 pixels, but its camera.s calibration says 64×64"):
        colmap_poses(drive, ProcessOptions(output=tmp_path / "scene"), QUIET)


def test_pictures_without_features_are_an_error(tmp_path):
    pytest.importorskip("pycolmap")
    with pytest.raises(InputError, match="COLMAP found no poses for the 8 pictures of left, right"):
        colmap_poses(pictured(tmp_path / "raw", 4), ProcessOptions(output=tmp_path / "scene"), QUIET)


FRAMES = 10
SIZE = 256


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """A street; at frame 4 the right camera sees nothing, at the last one neither does."""
    folder = tmp_path_factory.mktemp("colmap") / "street"
    synthesize_drive(SynthesizeOptions(folder, "street", frames=FRAMES, size=SIZE, shifts_m=()))
    pictures = folder / "data_2d_raw" / SynthesizeOptions(folder).sequence
    for camera, frame in (("image_03", 4), ("image_02", FRAMES - 1), ("image_03", FRAMES - 1)):
        write_png(pictures / camera / "data_rgb" / f"{frame:010d}.png", np.zeros((SIZE, SIZE, 3), np.uint8))
    return folder


def true_poses(drive: Path) -> dict[int, np.ndarray]:
    rows = np.loadtxt(next(drive.glob("data_poses/*/poses.txt")))
    return {int(row[0]): np.vstack((row[1:].reshape(3, 4), [0, 0, 0, 1])) for row in rows}


@pytest.fixture(scope="module")
def found(drive, tmp_path_factory) -> tuple[Kitti360Options, Recording]:
    """The drive's poses found, without a look at those that come with it."""
    pytest.importorskip("pycolmap")
    blind = tmp_path_factory.mktemp("colmap") / "blind"
    shutil.copytree(drive, blind, ignore=shutil.ignore_patterns("poses.txt", "cam0_to_world.txt"))
    options = options_of(blind, blind.parent / "scene", poses="colmap")
    return options, colmap_poses(read_drive(options), options, QUIET)


@pytest.mark.slow
def test_poses_of_a_drive_are_metric_and_right(drive, found):
    _, recording = found
    truth = true_poses(drive)
    to_vehicle = {camera.name: camera.to_vehicle for camera in recording.cameras}
    true = np.stack([truth[p.frame] @ to_vehicle[p.camera] for p in recording.pictures])
    poses = np.stack([p.camera_to_world for p in recording.pictures])
    path_m = sum(np.linalg.norm(truth[f + 1][:3, 3] - truth[f][:3, 3]) for f in range(FRAMES - 2))  # pyrefly: ignore
    factor, error_m = umeyama(poses[:, :3, 3], true[:, :3, 3])
    assert error_m.max() < 0.005 * path_m
    assert abs(1 / factor - 1) < 0.01
    # turns from one picture to the next, whatever the world
    for a in range(0, len(poses) - 2, 2):
        turned = poses[a][:3, :3].T @ poses[a + 2][:3, :3]
        expected = true[a][:3, :3].T @ true[a + 2][:3, :3]
        assert Rotation.from_matrix(turned.T @ expected).magnitude() < math.radians(0.3)
    # z is up, the first pose the origin
    assert recording.trajectory is not None
    vehicle = recording.trajectory.vehicle_to_world
    np.testing.assert_allclose(vehicle[0, :3, 3], 0, atol=1e-9)
    up = np.stack([truth[f][2, :3] for f in range(FRAMES - 1)])
    assert np.degrees(np.arccos((vehicle[:, 2, :3] * up).sum(-1))).max() < 1.5
    assert vehicle[-1, 0, 3] == pytest.approx(path_m, rel=0.02)


@pytest.mark.slow
def test_pictures_that_cannot_be_registered_are_listed_and_the_work_is_done_once(found):
    options, recording = found
    assert [(s.frame, s.camera, s.reason) for s in recording.skipped] == [
        (FRAMES - 1, "image_02", NOT_REGISTERED),
        (FRAMES - 1, "image_03", NOT_REGISTERED),
    ]
    # the other camera of the frame was registered, and the rig is known
    assert ("image_03", 4) in {(picture.camera, picture.frame) for picture in recording.pictures}
    notices = " ".join(recording.notices)
    assert f"COLMAP registered {2 * FRAMES - 3} of {2 * FRAMES} pictures, 1 more get their pose from the rig" in notices
    assert "m per unit, spread" in notices and "mean reprojection error 0." in notices
    # the same command finds the work done
    folder = options.output.with_name(f".{options.output.name}.colmap")
    assert not (folder / "database.db").exists()
    made = (folder / "models").stat().st_mtime_ns
    again = colmap_poses(read_drive(options), options, QUIET)
    assert (folder / "models").stat().st_mtime_ns == made
    assert again.trajectory is not None and recording.trajectory is not None
    np.testing.assert_array_equal(again.trajectory.vehicle_to_world, recording.trajectory.vehicle_to_world)


def interrupted(*_, **__):
    raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupted_run_goes_on(found, tmp_path, monkeypatch):
    import pycolmap

    options, _ = found
    options = dataclasses.replace(options, output=tmp_path / "scene", frames=4)
    database = tmp_path / ".scene.colmap" / "database.db"

    def features() -> list[int]:
        with contextlib.closing(pycolmap.Database.open(database)) as opened:
            return [opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()]

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pycolmap, "match_image_pairs", interrupted)
        colmap_poses(read_drive(options), options, QUIET)
    there = features()
    assert min(there) > 20

    extract, seen = pycolmap.extract_features, []

    def watched(*arguments, **options):
        seen.append(features())
        extract(*arguments, **options)
        seen.append(features())

    monkeypatch.setattr(pycolmap, "extract_features", watched)
    assert len(colmap_poses(read_drive(options), options, QUIET).pictures) == 8
    assert seen == [there, there]

    # other inputs, other work
    write_mask(tmp_path / "ego.png", np.ones((SIZE, SIZE), bool))
    masked = dataclasses.replace(options, ego_mask=tmp_path / "ego.png")
    colmap_poses(read_drive(masked), masked, QUIET)
    assert sum(seen[2]) == 0 < sum(seen[3])


def half_masked(drive: Path, folder: Path) -> Path:
    keep = np.zeros((SIZE, SIZE), bool)
    keep[:, : SIZE // 2] = True
    for name in ("image_02", "image_03"):
        write_mask(folder / f"{name}.png", keep & read_mask(drive / "truth" / "masks" / f"{name}.png"))
    return folder


@pytest.mark.slow
def test_masked_pixels_have_no_features(drive, tmp_path, monkeypatch):
    pycolmap = pytest.importorskip("pycolmap")

    def features(name: str, **masked) -> np.ndarray:
        options = options_of(drive, tmp_path / name, poses="colmap", frames=2, **masked)
        with pytest.raises(KeyboardInterrupt):
            colmap_poses(read_drive(options), options, QUIET)
        with contextlib.closing(pycolmap.Database.open(tmp_path / f".{name}.colmap" / "database.db")) as opened:
            found = [opened.read_keypoints(image.image_id) for image in opened.read_all_images()]
        assert len(found) == 4
        return np.concatenate([points[:, :2] for points in found])

    # what becomes of the features is another matter
    monkeypatch.setattr(pycolmap, "match_image_pairs", interrupted)
    masked = features("masked", ego_mask=half_masked(drive, tmp_path / "ego"))
    assert len(masked) > 200
    assert masked[:, 0].max() < SIZE // 2
    assert (features("whole")[:, 0] > SIZE // 2).sum() > 100


def five_frames(drive: Path, folder: Path, noise: int) -> tuple[Recording, Kitti360Options]:
    """Half of each picture masked, and with other noise of one grey value, as if taken again."""
    ego_mask = half_masked(drive, folder / "ego")
    options = options_of(drive, folder / "scene", poses="colmap", frames=5, ego_mask=ego_mask)
    recording = read_drive(options)
    rng = np.random.default_rng(noise)
    pictures = []
    for picture in recording.pictures:
        pixels = read_image(picture.path).astype(int)
        path = folder / "noisy" / picture.camera / picture.path.name
        write_png(path, np.clip(pixels + pixels.any() * rng.integers(-1, 2, pixels.shape), 0, 255).astype(np.uint8))
        pictures.append(dataclasses.replace(picture, path=path))
    return dataclasses.replace(recording, pictures=tuple(pictures)), options


@pytest.mark.slow
def test_five_frames_are_enough(drive, tmp_path):
    """With COLMAP's own demands on a picture this ends with a model of two pictures."""
    pytest.importorskip("pycolmap")
    found = colmap_poses(*five_frames(drive, tmp_path, noise=2), QUIET)
    assert found.trajectory is not None
    truth = true_poses(drive)
    assert sorted({picture.frame for picture in found.pictures}) == list(range(5))
    places, true = found.trajectory.vehicle_to_world[:, :3, 3], np.stack([truth[f][:3, 3] for f in range(5)])
    path_m = np.linalg.norm(true[-1] - true[0])
    factor, error_m = umeyama(places, true)
    assert error_m.max() < 0.02 * path_m
    assert abs(1 / factor - 1) < 0.1


@pytest.mark.slow
def test_a_model_of_two_pictures_is_not_the_end(drive, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    paths = []
    for number, pose_points in enumerate(((10_000, 15), (15,))):
        monkeypatch.setattr(colmap_models, "_POSE_POINTS", pose_points)
        found = colmap_poses(*five_frames(drive, tmp_path / str(number), 1), QUIET)
        assert found.trajectory is not None
        paths.append(found.trajectory.vehicle_to_world)
    np.testing.assert_array_equal(*paths)  # pyrefly: ignore[bad-argument-type]
    # such a model alone says so, and not that LiDAR saw nothing
    monkeypatch.setattr(colmap_models, "_POSE_POINTS", (10_000,))
    with pytest.raises(InputError, match="COLMAP found no poses for the 10 pictures"):
        colmap_poses(*five_frames(drive, tmp_path / "two", 1), QUIET)


@pytest.mark.slow
def test_most_pictures_decide_which_models_are_kept(drive, tmp_path, monkeypatch):
    """What was tried later counts only if it gives more pictures a pose."""
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(colmap_models, "_POSE_POINTS", (15, 10_000))
    monkeypatch.setattr(colmap_models, "_ENOUGH", 2.0)
    found = colmap_poses(*five_frames(drive, tmp_path, 1), QUIET)
    assert len({picture.frame for picture in found.pictures}) == 5
    left = {path.name for path in (tmp_path / ".scene.colmap").iterdir()}
    assert left == {"inputs.json", "models", "models.json", "pairs.txt"}


def steps_off(poses: dict[int, np.ndarray], truth: dict[int, np.ndarray]) -> tuple[float, float]:
    lengths_m, turns_deg = [], []
    for frame in range(FRAMES - 2):
        true = np.linalg.inv(truth[frame]) @ truth[frame + 1]
        off = np.linalg.inv(true) @ np.linalg.inv(poses[frame]) @ poses[frame + 1]
        lengths_m.append(np.linalg.norm(off[:3, 3]))
        turns_deg.append(np.degrees(np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec())))
    return float(np.mean(lengths_m)), float(np.mean(turns_deg))


@pytest.mark.slow
def test_a_drive_with_disturbed_poses_becomes_a_scene_with_better_ones(drive, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    without_lidar_check(monkeypatch)
    disturbed, truth = tmp_path / "disturbed", true_poses(drive)
    shutil.copytree(drive, disturbed)
    rng = np.random.default_rng(20)
    lines = []
    for frame, pose in truth.items():
        turn, shift = rng.normal(0, math.radians(0.2), 3), rng.normal(0, 0.03, 3)
        off = np.vstack((np.column_stack((Rotation.from_rotvec(turn).as_matrix(), shift)), [0, 0, 0, 1]))
        lines.append(" ".join([str(frame), *(f"{value:.9f}" for value in (pose @ off)[:3].ravel())]))
    next(disturbed.glob("data_poses/*/poses.txt")).write_text("\n".join(lines) + "\n")
    changes = {"refine_poses": True, "find_ego": False, "sweeps": 0, "estimate_depth": False}
    options = options_of(disturbed, tmp_path / "scene", **changes)
    report = convert(options, QUIET)
    assert any(notice.startswith("Poses refined by") for notice in report.notices)
    to_vehicle = {camera.name: camera.to_vehicle for camera in read_drive(options).cameras}
    scene = read_scene(options.output)
    poses: dict[str, dict[int, np.ndarray]] = {name: {} for name in to_vehicle}
    for picture in scene.pictures:
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3], camera_to_world[:3, 3] = picture.rotation, picture.position_m
        at = opencv_to_opengl(camera_to_world) @ np.linalg.inv(to_vehicle[picture.camera])
        poses[picture.camera][picture.frame] = at
    given = true_poses(disturbed)
    before, after = steps_off(given, truth), steps_off(poses["image_02"], truth)
    assert after[0] < 0.5 * before[0] and after[1] < 0.3 * before[1]
    # the rig is rigid
    for frame, at in poses["image_02"].items():
        np.testing.assert_allclose(at, poses["image_03"][frame], atol=1e-5)
    # the last frame's pictures are black: it moves as the one before
    last = [np.linalg.inv(path[FRAMES - 2]) @ path[FRAMES - 1] for path in (given, poses["image_02"])]
    assert np.linalg.norm(last[0][:3, 3]) == pytest.approx(np.linalg.norm(last[1][:3, 3]), abs=0.005)
    # the same command takes up what it found, and leaves the scene as it is
    written = (options.output / "transforms.json").read_bytes()
    assert not convert(options, QUIET).written
    assert (options.output / "transforms.json").read_bytes() == written
