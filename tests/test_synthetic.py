"""Synthetic drives: layout, determinism, continuing, and the sensors' physics against the truth beside them."""

import dataclasses
import platform
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from drives import without_lidar_check
from rich.console import Console
from scenes import tree as files_of

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.synthetic import layout as layout_module
from edge_depth_nerf.synthetic import lidar, rig, scenes
from edge_depth_nerf.synthetic.drive import WORLD_ORIGIN_M, _Kitti360, _manifest, synthesize_drive
from edge_depth_nerf.synthetic.layout import simulated_estimate
from edge_depth_nerf.synthetic.materials import Material, Noise
from edge_depth_nerf.synthetic.motion import Drive, Route, Turn, WindingRoute
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.render import Caster, World
from edge_depth_nerf.synthetic.scenes import ISLAND_M, build_scene, roundabout_route
from edge_depth_nerf.synthetic.traffic import traffic

pytestmark = pytest.mark.slow

SEQUENCE = SynthesizeOptions.sequence
SWEEPS = f"data_3d_raw/{SEQUENCE}/velodyne_points"
FRAMES = 5
SIZE = 128


def drive_in(world: World, options: SynthesizeOptions) -> Path:
    """The drive through a scene that is built already."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout_module, "build_scene", lambda _: world.model)
        patch.setattr(layout_module, "World", lambda *_: world)
        return synthesize_drive(options)


@pytest.fixture(scope="module")
def street_world():
    return World(build_scene(SynthesizeOptions(Path(), "street", frames=FRAMES)), 0)


@pytest.fixture(scope="module")
def street(tmp_path_factory, street_world):
    options = SynthesizeOptions(tmp_path_factory.mktemp("street") / "drive", "street", frames=FRAMES, size=SIZE)
    return options, drive_in(street_world, options)


@pytest.fixture(scope="module")
def parking(tmp_path_factory):
    output = tmp_path_factory.mktemp("parking") / "drive"
    options = SynthesizeOptions(output, "parking", frames=2, size=64, seed=3)
    return options, synthesize_drive(options)


@pytest.fixture(scope="module")
def roundabout(tmp_path_factory):
    options = SynthesizeOptions(tmp_path_factory.mktemp("roundabout") / "drive", "roundabout", frames=1, size=SIZE)
    world = World(build_scene(options), 0)
    return world, drive_in(world, options)


def poses_of(root: Path) -> np.ndarray:
    rows = np.loadtxt(root / "data_poses" / SEQUENCE / "poses.txt", ndmin=2)
    assert np.array_equal(rows[:, 0], np.arange(len(rows)))
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows[:, 1:].reshape(-1, 3, 4)
    return poses


def truth(root: Path, camera: str, kind: str, frame: int) -> Path:
    return root / "truth" / SEQUENCE / camera / kind / f"{frame:010d}.png"


def picture(root: Path, camera: str, frame: int) -> np.ndarray:
    return read_image(root / "data_2d_raw" / SEQUENCE / camera / "data_rgb" / f"{frame:010d}.png").astype(float)


def points_of(root: Path, frame: int, folder: str = "truth") -> np.ndarray:
    where = {"truth": f"truth/{SEQUENCE}/points", "raw": f"{SWEEPS}/data"}[folder]
    return np.fromfile(root / where / f"{frame:010d}.bin", "<f4").reshape(-1, 4).astype(np.float64)


def test_layout_is_complete(street):
    _, root = street
    calibration = ("image_02.yaml", "image_03.yaml", "calib_cam_to_pose.txt", "calib_cam_to_velo.txt")
    expected = {"drive.json", f"truth/{SEQUENCE}/shifted.json", f"{SWEEPS}/timestamps.txt"}
    expected |= {f"calibration/{name}" for name in calibration}
    expected |= {f"data_poses/{SEQUENCE}/{name}.txt" for name in ("poses", "cam0_to_world")}
    for camera in ("image_02", "image_03"):
        mine = f"truth/{SEQUENCE}/{camera}"
        expected |= {f"data_2d_raw/{SEQUENCE}/{camera}/timestamps.txt"}
        expected |= {f"truth/masks/{camera}{kind}.png" for kind in ("", "_lens", "_ego")}
        for frame in range(FRAMES):
            expected |= {f"{mine}/{kind}/{frame:010d}.png" for kind in ("distance", "rgb")}
            expected |= {f"{folder}/{frame:010d}.bin" for folder in (f"{SWEEPS}/data", f"truth/{SEQUENCE}/points")}
            for folder in (f"data_2d_raw/{SEQUENCE}/{camera}/data_rgb", f"simulated_mono/{SEQUENCE}/{camera}"):
                expected.add(f"{folder}/{frame:010d}.png")
        kinds = [f"shifted_{shift}m/{kind}" for shift in (1, 2) for kind in ("rgb", "distance")]
        expected |= {f"{mine}/{kind}/{4:010d}.png" for kind in kinds}
    assert set(files_of(root)) == expected


def test_calibration_is_read_by_opencv_and_scaled_about_pixel_edges(street):
    _, root = street
    for name in rig.CAMERAS:
        storage = cv2.FileStorage(str(root / "calibration" / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
        assert storage.getNode("model_type").string() == "MEI"
        assert storage.getNode("image_width").real() == SIZE
        projection, camera = storage.getNode("projection_parameters"), rig.camera(name, SIZE)
        # u0 counts integer centres, cx counts them at +0.5
        assert projection.getNode("u0").real() == pytest.approx(camera.cx - 0.5, rel=1e-14)
        assert projection.getNode("gamma2").real() == pytest.approx(camera.fy, rel=1e-14)
        storage.release()
    # (716.94323510126321 + 0.5) * 128/1400 = 65.594810066...
    assert rig.camera("image_02", SIZE).cx == pytest.approx(65.59481006640121, rel=1e-12)


def test_calibration_at_full_size_is_kitti360s(tmp_path, real_data):
    rig.write_calibration(tmp_path, rig.FULL_SIZE_PX)
    files = sorted((real_data / "kitti360_calibration").iterdir())
    assert len(files) == 4
    for file in files:
        assert (tmp_path / file.name).read_text().split() == file.read_text().split()


def test_poses_and_timestamps(street):
    options, root = street
    poses = poses_of(root)
    np.testing.assert_allclose(
        poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, :3], np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-9
    )
    assert np.all(np.linalg.det(poses[:, :3, :3]) > 0)
    # z points down, the pose's origin is 0.93 m above the road
    assert np.all(poses[:, 2, 2] < -0.99)
    np.testing.assert_allclose(poses[:, 2, 3] - WORLD_ORIGIN_M[2], 0.93, atol=0.011)
    # KITTI-360's cameras are 1.069 m and 1.075 m, its Velodyne 0.836 m above the pose's origin (z down)
    heights = [each[2, 3] for each in (*(rig.CAMERA_TO_POSE[name] for name in rig.CAMERAS), rig.VELO_TO_POSE)]
    assert rig.POSE_HEIGHT_M - np.array(heights) == pytest.approx([2.00, 2.01, 1.77], abs=0.01)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps, options.mean_speed_m_s * 0.1, rtol=0.08)
    # forwards is where the car goes
    forward = np.sum(np.diff(poses[:, :3, 3], axis=0) * poses[:-1, :3, 0], axis=1)
    np.testing.assert_allclose(forward, steps, rtol=1e-3)
    cam0 = np.loadtxt(root / "data_poses" / SEQUENCE / "cam0_to_world.txt")[:, 1:].reshape(-1, 4, 4)
    np.testing.assert_allclose(cam0, poses @ rig.CAMERA_TO_POSE["image_00"], atol=1e-6)
    for path in root.rglob("timestamps.txt"):
        lines = path.read_text().splitlines()
        assert len(lines) == FRAMES
        assert lines[0] == "2013-05-28 08:46:02.123456789"
        assert lines[1] == "2013-05-28 08:46:02.223456789"
    assert len(list(root.rglob("timestamps.txt"))) == 3


def test_each_pixel_of_small_pictures_has_its_rays(tmp_path):
    """Beside what the lens cannot reach, too."""
    drive = _Kitti360(SynthesizeOptions(tmp_path, "parking", frames=1, size=32))
    drive.build()
    assert all(np.isfinite(view._fine_rays).all() for view in drive.views.values()) and len(drive.views) == 2


def test_same_options_same_bytes_and_interrupted_runs_are_continued(parking, tmp_path, monkeypatch):
    options, root = parking
    other = dataclasses.replace(options, output=tmp_path / "again")
    write, calls = layout_module.write_distance_png, []

    def interrupted(path, distance_m):
        calls.append(path)
        if len(calls) == 4:
            raise KeyboardInterrupt
        write(path, distance_m)

    with monkeypatch.context() as patch:
        patch.setattr(layout_module, "write_distance_png", interrupted)
        with pytest.raises(KeyboardInterrupt):
            synthesize_drive(other)
    done = files_of(other.output)
    reference = files_of(root)
    assert 0 < len(done) < len(reference)
    # what a killed process leaves of a file that it was writing
    left_over = f".0000000001.{platform.node()}~999999999~1.bin"
    (other.output / "truth" / SEQUENCE / "points" / left_over).write_bytes(b"half")
    kept = other.output / "data_2d_raw" / SEQUENCE / "image_02" / "data_rgb" / "0000000000.png"
    changed_ns = kept.stat().st_mtime_ns
    synthesize_drive(other)
    assert files_of(other.output) == reference
    assert kept.stat().st_mtime_ns == changed_ns, "a finished frame was made again"
    with monkeypatch.context() as patch:
        patch.setattr(layout_module, "build_scene", None)
        assert synthesize_drive(other) == other.output, "a complete drive needs no scene"


def test_another_seed_is_another_drive(parking, tmp_path):
    options, root = parking
    other = files_of(synthesize_drive(dataclasses.replace(options, output=tmp_path / "other", seed=4, frames=1)))
    first = files_of(root)
    camera = "image_03/distance/0000000000.png"
    for name in (
        *(f"data_2d_raw/{SEQUENCE}/image_02/data_rgb/0000000000.png", f"truth/{SEQUENCE}/{camera}"),
        f"{SWEEPS}/data/0000000000.bin",
        *(f"simulated_mono/{SEQUENCE}/image_03/0000000000.png", f"data_poses/{SEQUENCE}/poses.txt"),
    ):
        assert other[name] != first[name]
    assert other["calibration/image_02.yaml"] == first["calibration/image_02.yaml"]


def test_a_folder_with_something_else_is_refused_untouched(parking, tmp_path):
    options, root = parking
    before = files_of(root)
    with pytest.raises(InputError, match=r"seed is 3 there and 9 here"):
        synthesize_drive(dataclasses.replace(options, seed=9))
    assert files_of(root) == before
    foreign = tmp_path / "holiday"
    foreign.mkdir()
    (foreign / "beach.jpg").write_bytes(b"x")
    with pytest.raises(InputError, match=r"holiday.*beach\.jpg"):
        synthesize_drive(dataclasses.replace(options, output=foreign))
    assert files_of(foreign) == {"beach.jpg": b"x"}
    with pytest.raises(InputError, match="is a file"):
        synthesize_drive(dataclasses.replace(options, output=foreign / "beach.jpg"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": 0}, "--frames 0"),
        ({"size": 31}, "--size 31"),
        ({"seed": -1}, "--seed -1"),
        ({"layout": "kitti"}, "--layout kitti: no such layout, expected one of kitti-360"),
        ({"scene": "moon"}, "--scene moon.*street, parking, turn"),
    ],
)
def test_bad_options_are_refused_before_anything_is_written(change, message, tmp_path):
    options = SynthesizeOptions(tmp_path / "drive")
    for name, value in change.items():
        # past the type checks, as a file or another program may give it
        object.__setattr__(options, name, value)
    with pytest.raises(InputError, match=message):
        synthesize_drive(options)
    assert not (tmp_path / "drive").exists()


def in_camera(root: Path, camera: str, folder: str = "truth", frame: int = 1) -> np.ndarray:
    to_camera = np.linalg.inv(rig.CAMERA_TO_POSE[camera]) @ rig.VELO_TO_POSE
    return points_of(root, frame, folder)[:, :3] @ to_camera[:3, :3].T + to_camera[:3, 3]


def agreement(points_in_camera: np.ndarray, camera: str, distance_m: np.ndarray) -> tuple[float, float, int]:
    """Shares of points that agree with the map, and that lie clearly in front of it; and how many are seen."""
    model = rig.camera(camera, distance_m.shape[1])
    pixels, valid = model.project(torch.from_numpy(points_in_camera))
    seen = (valid & model.inside(pixels)).numpy()
    x, y = pixels.numpy()[seen].astype(int).T
    there, own = distance_m[y, x], np.linalg.norm(points_in_camera[seen], axis=1)
    # where the surface is steep to the ray, distances spread within a pixel: its neighbours' range counts
    around = cv2.dilate(distance_m, np.ones((3, 3))), cv2.erode(distance_m, np.ones((3, 3)))
    keep = (there > 0) & (around[1][y, x] > 0)
    own, high, low = own[keep], around[0][y, x][keep], around[1][y, x][keep]
    agrees = (own <= high * 1.01) & (own >= low * 0.99)
    return float(agrees.mean()), float((own < low * 0.97).mean()), int(keep.sum())


def test_deskewed_points_agree_with_the_distance_maps(street):
    _, root = street
    assert len(rig.CAMERAS) == 2
    for camera in rig.CAMERAS:
        distance = read_distance_png(truth(root, camera, "distance", 1))
        share, in_front, count = agreement(in_camera(root, camera), camera, distance)
        # the LiDAR stands elsewhere: some of what it sees is hidden from the camera, nothing is in front
        assert count > 10_000
        assert share > 0.93
        assert in_front < 0.01
        assert agreement(in_camera(root, camera, "raw"), camera, distance)[0] < share


def test_points_lie_on_the_scene_exactly(street, street_world):
    _, root = street
    world = street_world
    pose = world.model.drive.pose_to_world(np.array([0.1]))[0]
    np.testing.assert_allclose(pose[:3, 3] + WORLD_ORIGIN_M, poses_of(root)[1][:3, 3], atol=1e-9)
    points = points_of(root, 1)[::50, :3]
    velo = pose @ rig.VELO_TO_POSE
    camera = (pose @ rig.CAMERA_TO_POSE["image_03"])[:3, 3]
    to_points = points @ velo[:3, :3].T + velo[:3, 3] - camera
    reach = np.linalg.norm(to_points, axis=1)
    directions = (to_points / reach[:, None]).astype(np.float32)
    hits = world.trace(np.tile(camera.astype(np.float32), (len(points), 1)), directions, 0.1)
    # a ray from the camera meets the point's surface, or something before it, never something behind it;
    # 1 cm of slack: a ray may graze past an edge that the point lies on
    beyond = hits.distance_m > reach + 0.01
    assert np.mean(beyond) < 0.005
    assert np.mean(np.abs(hits.distance_m - reach) < 2e-3) > 0.7


def test_range_noise_beams_and_azimuths(street, street_world):
    _, root = street
    drive = street_world.model.drive
    raw, true = points_of(root, 1, "raw")[:, :3], points_of(root, 1)[:, :3]
    length = np.linalg.norm(raw, axis=1)
    azimuth = np.arctan2(raw[:, 1], raw[:, 0])
    # exactly the pose of each firing's own moment: undone, only noise along the ray is left
    fired_s = 0.1 - azimuth / (2 * np.pi) * 0.1
    firing = drive.pose_to_world(fired_s) @ rig.VELO_TO_POSE
    frame = drive.pose_to_world(np.array([0.1]))[0] @ rig.VELO_TO_POSE
    world = true @ frame[:3, :3].T + frame[:3, 3]
    at_firing = np.einsum("nji,nj->ni", firing[:, :3, :3], world - firing[:, :3, 3])
    along = np.linalg.norm(at_firing, axis=1)
    noise = length - along
    assert abs(noise.mean()) < 5e-4
    assert noise.std() == pytest.approx(0.02, rel=0.02)
    across = np.linalg.norm(raw / length[:, None] - at_firing / along[:, None], axis=1) * along
    assert across.max() < 1e-3
    elevation = np.degrees(np.arcsin(raw[:, 2] / length))
    step = (2.0 + 24.8) / 63
    beam = (2.0 - elevation) / step
    np.testing.assert_allclose(beam, np.rint(beam), atol=2e-3)
    assert set(np.rint(beam).astype(int)) == set(range(64))
    firing_number = (180 - np.degrees(azimuth)) / 0.2 - 0.5
    np.testing.assert_allclose(firing_number, np.rint(firing_number), atol=2e-3)
    # in the order of firing: clockwise
    assert np.all(np.diff(np.rint(firing_number)) >= 0)
    assert along.max() <= 80
    assert len(raw) < 64 * 1800
    # the lowest beam meets the road about 1.77 m / sin 24.8° = 4.2 m away
    assert np.median(along[np.rint(beam) == 63]) == pytest.approx(4.2, abs=0.25)


def test_five_percent_of_points_are_lost(street, street_world, monkeypatch):
    _, root = street
    some = len(points_of(root, 0))
    monkeypatch.setattr(lidar, "DROPOUT", 0.0)
    every = len(lidar.sweep(street_world, street_world.model.drive, 0.0, np.random.default_rng([0, 20, 0])).raw)
    # of some 80,000: three standard deviations are 0.0023
    assert 1 - some / every == pytest.approx(0.05, abs=0.0025)


def test_masks_lens_and_own_car(street):
    _, root = street
    assert len(rig.CAMERAS) == 2
    for camera in rig.CAMERAS:
        lens = read_mask(root / "truth" / "masks" / f"{camera}_lens.png")
        not_own = read_mask(root / "truth" / "masks" / f"{camera}_ego.png")
        both = read_mask(root / "truth" / "masks" / f"{camera}.png")
        np.testing.assert_array_equal(both, lens & not_own)
        rays, valid = rig.camera(camera, SIZE).unproject(rig.camera(camera, SIZE).pixel_centres())
        theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
        np.testing.assert_array_equal(lens, (valid & (theta <= np.deg2rad(97))).numpy())
        outside = (~valid | (theta > np.deg2rad(101))).numpy()
        assert picture(root, camera, 0)[outside].mean() < 4
        own = lens & ~not_own
        # about a fifth of the picture, in its lower part
        assert 0.12 < own.sum() / lens.sum() < 0.28
        assert np.nonzero(own)[0].mean() > 0.75 * SIZE
        inner = cv2.erode((~not_own).astype(np.uint8), np.ones((3, 3))) > 0
        first, second = (read_image(truth(root, camera, "rgb", frame)) for frame in (0, 3))
        # but for gaps narrower than a pixel, through which the world is seen
        assert np.mean(first[inner] != second[inner]) < 2e-3
        assert np.mean(first[both] != second[both]) > 0.3


def test_distances_are_zero_exactly_where_nothing_is_known(street, parking):
    assert len(rig.CAMERAS) == 2
    for camera in rig.CAMERAS:
        (keep, distance), (inside, hall) = (
            (read_mask(root / f"truth/masks/{camera}.png"), read_distance_png(truth(root, camera, "distance", 0)))
            for _, root in (street, parking)
        )
        assert np.all(distance[~keep] == 0)
        sky = keep & (distance == 0)
        assert 0.2 < sky.sum() / keep.sum() < 0.6
        assert np.nonzero(sky)[0].mean() < 0.4 * SIZE
        assert np.all(hall[inside] > 0), "no sky in a car park"
        # the ceiling is 2.6 m, the camera 2.0 m above the floor: straight up it is some 0.6 m away
        top = np.nonzero(inside[:, 32])[0][0]
        assert 0.2 < hall[top + 1, 32] < 0.75


def test_sky_is_blown_out_towards_the_sun(street, parking):
    def blown(root: Path, camera: str) -> float:
        keep = read_mask(root / "truth" / "masks" / f"{camera}.png")
        return float((read_image(truth(root, camera, "rgb", 0))[keep] == 255).all(-1).mean())

    assert blown(street[1], "image_02") > 0.08
    assert blown(street[1], "image_03") < blown(street[1], "image_02")
    assert blown(parking[1], "image_02") < 0.03


def test_noise_and_exposure_drift(street):
    _, root = street
    gains = {}
    for camera in rig.CAMERAS:
        keep = read_mask(root / "truth" / "masks" / f"{camera}.png")
        for frame in range(FRAMES):
            clean = read_image(truth(root, camera, "rgb", frame)).astype(float)
            middle = keep[..., None] & (clean > 60) & (clean < 190)
            seen, clean = picture(root, camera, frame)[middle], clean[middle]
            # sRGB's curve undone, the exposure is one factor
            linear = [((value / 255 + 0.055) / 1.055) ** 2.4 for value in (seen, clean)]
            gain = float(np.median(linear[0] / linear[1]))
            gains[camera, frame] = gain
            expected = 255 * (1.055 * (gain * linear[1]) ** (1 / 2.4) - 0.055)
            # the noise's 2.0, and both roundings' 0.29
            assert np.std(seen - expected) == pytest.approx(2.04, abs=0.12)
    values = np.array(list(gains.values()))
    assert np.all(np.abs(values - 1) < 0.105)
    for camera in rig.CAMERAS:
        own = np.array([gains[camera, frame] for frame in range(FRAMES)])
        assert np.ptp(own) > 0.002
        assert np.abs(np.diff(own)).max() < 0.03, "the drift is smooth"
    assert abs(gains["image_02", 0] - gains["image_03", 0]) > 1e-3


def test_shifted_views_are_exactly_sideways(street):
    _, root = street
    pose = poses_of(root)[4]
    shifted = read_json(root / "truth" / SEQUENCE / "shifted.json")
    assert set(shifted) == {"1", "2"}
    points = points_of(root, 4)[:, :3]
    for camera in rig.CAMERAS:
        lens = read_mask(root / "truth" / "masks" / f"{camera}_lens.png")
        for shift in (1, 2):
            assert set(shifted[str(shift)][camera]) == {"4"}
            matrix = np.array(shifted[str(shift)][camera]["4"])
            camera_to_world = pose @ rig.CAMERA_TO_POSE[camera]
            np.testing.assert_allclose(matrix[:3, :3], camera_to_world[:3, :3], atol=1e-9)
            # the vehicle's y axis points right
            np.testing.assert_allclose(matrix[:3, 3] - camera_to_world[:3, 3], -shift * pose[:3, 1], atol=1e-8)
            velo_to_shifted = np.linalg.inv(matrix) @ pose @ rig.VELO_TO_POSE
            seen = points @ velo_to_shifted[:3, :3].T + velo_to_shifted[:3, 3]
            distance = read_distance_png(truth(root, camera, f"shifted_{shift}m/distance", 4))
            share, in_front, _ = agreement(seen, camera, distance)
            assert share > 0.88
            assert in_front < 0.015
            # the own car is not there: the ground below is seen
            below = int(0.6 * SIZE)
            assert np.mean(distance[below:][lens[below:]] > 0) > 0.99


def test_views_beside_the_path_can_be_chosen_and_reach_the_scene(tmp_path, street_world, monkeypatch):
    without_lidar_check(monkeypatch)
    drive = SynthesizeOptions(tmp_path / "drive", frames=FRAMES, size=40, shifts_m=(0.5, -1.0))
    drive_in(street_world, drive)
    shifted = read_json(drive.output / "truth" / SEQUENCE / "shifted.json")
    pose, place = poses_of(drive.output)[4], rig.CAMERA_TO_POSE["image_02"]
    for name, shift_m in (("0.5", 0.5), ("-1", -1.0)):
        offset = np.array(shifted[name]["image_02"]["4"])[:3, 3] - (pose @ place)[:3, 3]
        np.testing.assert_allclose(offset, -shift_m * pose[:3, 1], atol=1e-8)
    assert set(shifted) == {"0.5", "-1"}
    asked = {"sequence": SEQUENCE, "find_ego": False, "refine_poses": False, "sweeps": 0, "cameras": ("image_02",)}
    convert(Kitti360Options(root=drive.output, output=tmp_path / "scene", **asked), Console(quiet=True))
    views = read_json(tmp_path / "scene/transforms.json")["shifted_views"]
    assert {name: len(entries) for name, entries in views.items()} == {"0.5": 1, "-1": 1}
    assert (tmp_path / "scene" / views["0.5"][0]["truth_rgb_file_path"]).parts[-3] == "shifted_0.5m"
    # a drive of an earlier version is still the same drive
    assert "shifts_m" not in _manifest(SynthesizeOptions(tmp_path))["options"]
    assert _manifest(drive)["options"]["shifts_m"] == [0.5, -1.0]
    with pytest.raises(InputError, match=r"--shifts-m 0\.125: expected metres, -99 to 99, with at most two decimals"):
        SynthesizeOptions(tmp_path, shifts_m=(0.125,)).check()
    with pytest.raises(InputError, match=r"--shifts-m 3\.0 --layout rig: expected kitti-360, which alone"):
        SynthesizeOptions(tmp_path, shifts_m=(3.0,), layout="rig").check()


def test_what_moves_changes_place_and_nothing_else_is_masked(tmp_path, monkeypatch):
    options = SynthesizeOptions(tmp_path / "drive", "traffic", frames=2, size=64)
    root = synthesize_drive(options)
    monkeypatch.setattr(scenes, "traffic", lambda *_: [])
    still = synthesize_drive(dataclasses.replace(options, output=tmp_path / "still"))
    masks, differs = {}, 0
    for camera in rig.CAMERAS:
        for frame in (0, 1):
            masks[camera, frame] = read_mask(root / "truth" / SEQUENCE / "moving_masks" / camera / f"{frame:010d}.png")
        with_cars = read_distance_png(truth(root, camera, "distance", 0))
        without = read_distance_png(truth(still, camera, "distance", 0))
        changed = with_cars != without
        differs += changed.sum()
        assert np.all(with_cars[changed] < without[changed])
        assert not np.any(changed & masks[camera, 0])
    assert differs > 10
    assert not np.array_equal(masks["image_02", 0], masks["image_02", 1])
    assert all(read_mask(path).all() for path in (still / "truth" / SEQUENCE / "moving_masks").rglob("*.png"))
    before, after = (len(points_of(r, 0)) for r in (still, root))
    assert before != after or not np.array_equal(points_of(still, 0), points_of(root, 0))


@pytest.mark.parametrize("frames", [10, 80])
def test_traffic_passes_stops_and_starts_and_nobody_is_run_over(frames):
    duration_s = max(0.1 * frames, 3.0)
    route = Route((0.0, -1.75))
    drive = Drive.random(route, 0.0, 6.0, np.random.default_rng(0))
    movers = traffic(drive, 0.1 * frames, np.random.default_rng(frames))
    assert len(movers) == 8
    times = np.linspace(0, duration_s, 400)
    own = drive.pose_to_world(times)[:, :2, 3]
    standing = 0
    for mover in movers:
        place, _ = mover.at(times)
        apart = np.linalg.norm(place - own, axis=1)
        assert apart.min() > 1.3, "it does not drive into the recording car"
        assert apart.min() < 14, "it is met"
        speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / np.diff(times)
        assert speed.max() == pytest.approx(mover.speed_m_s, rel=1e-6)
        assert np.abs(np.diff(speed)).max() < 1.1 * mover.speed_m_s * (times[1] - times[0]), "none jumps"
        if mover.stands_s is not None:
            begin, end = mover.stands_s
            still = (times[:-1] > begin) & (times[1:] < end)
            assert still.any() and speed[still].max() < 1e-9
            assert speed[times[1:] > end + 0.3].max() > 0.25 * mover.speed_m_s
            standing += 1
    assert standing == 2
    heights = [mover.geometry.corners[..., 2].max() + mover.ground_m for mover in movers]
    assert max(heights) > 3.0, "the bus is higher than the scanner sees"
    assert sum(1.5 < height < 2.1 for height in heights) >= 4, "people"


def test_simulated_estimate_has_a_networks_faults(street):
    _, root = street
    camera = "image_02"
    keep = read_mask(root / "truth" / "masks" / f"{camera}.png")
    lens = read_mask(root / "truth" / "masks" / f"{camera}_lens.png")
    inner = cv2.erode(keep.astype(np.uint8), np.ones((9, 9))) > 0
    for frame in (0, 1):
        distance = read_distance_png(truth(root, camera, "distance", frame))
        estimate = read_distance_png(root / "simulated_mono" / SEQUENCE / camera / f"{frame:010d}.png")
        assert np.all(estimate[~lens] == 0)
        assert np.all(estimate[lens] > 0), "sky and own car have an estimate as well"
        sky = inner & (distance == 0)
        assert 30 < np.median(estimate[sky]) < 150
        near = inner & (distance > 0) & (distance < 60)
        error = np.log(estimate[near] / distance[near])
        assert 0.02 < np.sqrt(np.mean(error**2)) < 0.4


def test_simulated_scale_error_is_smooth_and_of_its_size():
    flat = np.full((60, 60), 10.0, np.float32)
    everywhere = np.ones((60, 60), bool)
    logs = []
    for seed in range(40):
        estimate = simulated_estimate(flat, np.zeros_like(flat), everywhere, 3, seed, 0)
        logs.append(np.log(estimate / 10.0))
        assert np.abs(np.diff(logs[-1], axis=0)).max() < 0.05
    # over drives; knots have the stated size, cubic interpolation between them a little less
    assert 0.07 < np.std(logs) < 0.13
    following = simulated_estimate(flat, np.zeros_like(flat), everywhere, 4, 0, 0)
    later = simulated_estimate(flat, np.zeros_like(flat), everywhere, 43, 0, 0)
    step = np.abs(np.log(following / 10) - logs[0])
    assert 0 < step.mean() < 0.05
    assert step.mean() < np.abs(np.log(later / 10) - logs[0]).mean()


def test_simulated_edges_are_blurred():
    step = np.full((40, 80), 5.0, np.float32)
    step[:, 40:] = 20.0
    estimate = simulated_estimate(step, np.zeros_like(step), np.ones_like(step, bool), 0, 0, 0)
    between = (estimate[20] > 1.2 * estimate[20, 30]) & (estimate[20] < 0.85 * estimate[20, 50])
    assert between.any()
    assert between.sum() < 10


def test_route_has_unit_speed_and_turns_by_its_angle():
    route = Route((1.0, -2.0), 0.3, Turn(-np.pi / 2, 8.0, 15.0))
    s, step = np.linspace(-5, 50, 2201, retstep=True)
    place, heading = route.at(s)
    np.testing.assert_allclose(np.linalg.norm(np.diff(place, axis=0), axis=1), step, rtol=2e-4)
    assert heading[0] == pytest.approx(0.3)
    assert heading[-1] == pytest.approx(0.3 - np.pi / 2, abs=1e-6)
    curvature = np.abs(np.diff(heading)) / step
    assert curvature.max() == pytest.approx(1 / 8, rel=5e-3)
    # along the heading
    direction = np.diff(place, axis=0) / step
    middle = (heading[1:] + heading[:-1]) / 2
    np.testing.assert_allclose(direction, np.stack((np.cos(middle), np.sin(middle)), -1), atol=2e-3)


def test_winding_route_has_unit_speed_and_all_of_its_turns():
    turns = (Turn(-0.6, 9.0, 4.0), Turn(2.0, 7.0), Turn(-0.4, 12.0, 3.0))
    route = WindingRoute((1.0, -2.0), 0.3, turns)
    # each turn takes its angle at the radius, and 3 m to ease in and out
    lengths = [4.0 + 0.6 * 9 + 3, 2.0 * 7 + 3, 3.0 + 0.4 * 12 + 3]
    np.testing.assert_allclose(route.ends_m, np.cumsum(lengths), rtol=1e-12)
    s, step = np.linspace(-5, 50, 5501, retstep=True)
    place, heading = route.at(s)
    np.testing.assert_allclose(np.linalg.norm(np.diff(place, axis=0), axis=1), step, rtol=1e-3)
    assert np.abs(np.diff(heading)).max() < step / 6.9
    np.testing.assert_allclose(place[500], (1.0, -2.0), atol=1e-9)
    for end, turned in zip(route.ends_m, np.cumsum([-0.6, 2.0, -0.4]), strict=True):
        assert route.at(np.array([end]))[1][0] == pytest.approx(0.3 + turned, abs=1e-6)


def test_roundabout_is_driven_around_its_island_and_left_by_the_road_to_the_left():
    route, centre = roundabout_route()
    begin, end = route.ends_m[:2]
    place, heading = route.at(np.arange(begin + 3, end - 3, 0.1))
    # the curve is eased in and out; between, it is a circle
    np.testing.assert_allclose(np.linalg.norm(place - centre, axis=1), 10.25, atol=0.02)
    assert np.degrees(heading[-1] - heading[0]) > 140
    first, last = route.at(np.array([0.0, route.ends_m[2] + 5.0]))[0]
    # on the right-hand side of roads whose middle lines meet in the island's centre
    assert centre[1] == pytest.approx(0, abs=1e-6)
    assert first[1] == -1.75
    assert last[0] - centre[0] == pytest.approx(1.75, abs=0.01)
    assert last[1] > 15


def test_nothing_stands_in_the_way_around_the_roundabout(roundabout):
    world, _ = roundabout
    model, caster = world.model, world._static
    _, centre = roundabout_route()
    assert np.hypot(*(model.drive.pose_to_world(np.array([0.1]))[0, :2, 3] - centre)) == pytest.approx(10.25, abs=0.15)
    drive = dataclasses.replace(model.drive, start_m=0.0)
    poses = drive.pose_to_world(np.arange(0, 15, 0.1))
    # the vehicle's sides: its body is 4.77 m × 1.82 m, the pose's origin 1.375 m behind and 0.30 m left of its middle
    x, left, right = np.array([-1.0, 3.76]), -0.62, 1.21
    for side in (left, right):
        for height in (0.05, 0.3, 1.0, 1.7):
            rear, front = (
                poses[:, :3, 3] + at * poses[:, :3, 0] + side * poses[:, :3, 1] + (height - 0.93) * np.array((0, 0, 1))
                for at in x
            )
            reach = np.linalg.norm(front - rear, axis=1).astype(np.float32)
            directions = ((front - rear) / reach[:, None]).astype(np.float32)
            hit = caster.blocked(rear.astype(np.float32), directions, reach)
            assert len(hit) == 150 and not hit.any(), (side, height, np.flatnonzero(hit))
    # on the island trees stand, with many small leaves
    leaves = model.static.corners[model.static.material == Material.LEAF].mean(1)
    assert (np.linalg.norm(leaves[:, :2] - centre, axis=1) < ISLAND_M).sum() > 50_000


def test_roundabout_pictures_sweeps_and_distances_agree(roundabout):
    _, root = roundabout
    assert len(rig.CAMERAS) == 2
    for camera in rig.CAMERAS:
        distance = read_distance_png(truth(root, camera, "distance", 0))
        share, in_front, count = agreement(in_camera(root, camera, frame=0), camera, distance)
        assert count > 10_000
        # leaves are smaller than a pixel
        assert share > 0.88
        assert in_front < 0.03
        keep = read_mask(root / "truth" / "masks" / f"{camera}.png")
        sky = keep & (distance == 0)
        upper, lower = sky[: SIZE // 2], sky[int(0.6 * SIZE) :]
        assert 0.2 < upper[keep[: SIZE // 2]].mean() < 0.9
        assert not lower.any(), "the road's end is not the sky"


def test_first_hits_are_the_triangles_planes():
    model = build_scene(SynthesizeOptions(Path(), "parking", frames=1))
    caster = Caster(model.static)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    origins = np.tile(np.array((1.0, -1.0, 1.9), np.float32), (500, 1))
    distance, triangle, weight = caster.first_hits(origins, directions)
    assert np.all(triangle >= 0), "a closed hall"
    corners = model.static.corners[triangle]
    u, v = weight.T.astype(np.float64)
    inside = (1 - u - v)[:, None] * corners[:, 0] + u[:, None] * corners[:, 1] + v[:, None] * corners[:, 2]
    np.testing.assert_allclose(origins + distance[:, None].astype(np.float64) * directions, inside, atol=2e-4)
    assert caster.blocked(origins, directions, distance + 0.01).all()
    assert not caster.blocked(origins, directions, distance * 0.999 - 1e-3).any()


def test_raw_points_are_skewed_by_the_cars_motion(street):
    _, root = street
    raw, true = points_of(root, 2, "raw"), points_of(root, 2)
    assert raw.shape == true.shape
    np.testing.assert_array_equal(raw[:, 3], true[:, 3])
    azimuth = np.degrees(np.arctan2(raw[:, 1], raw[:, 0]))
    speed = np.linalg.norm(poses_of(root)[3][:3, 3] - poses_of(root)[1][:3, 3]) / 0.2
    moved = true[:, 0] - raw[:, 0]
    # clockwise: the left (+90°) a quarter of a turn (25 ms) before the frame's time, the right after it;
    # a point seen while the car was still behind is nearer at the frame's time
    for side, quarter_turns in ((90, -1), (0, 0), (-90, 1)):
        chosen = (np.abs(azimuth - side) < 2) & (np.linalg.norm(raw[:, :3], axis=1) < 15)
        assert chosen.sum() > 200
        assert np.median(moved[chosen]) == pytest.approx(quarter_turns * 0.025 * speed, abs=0.02)
    assert speed * 0.025 > 0.15


def test_pose_is_a_rotation_at_every_time():
    route = Route((0.0, 0.0), 0.0, Turn(np.pi / 2, 8.0, 3.0))
    drive = Drive.random(route, 0.0, 7.0, np.random.default_rng(5))
    poses = drive.pose_to_world(np.linspace(0, 4, 81))
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (81, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    # pitch and roll are there, and small
    tilt = np.degrees(np.arccos(-rotation[:, 2, 2]))
    assert 0.2 < tilt.max() < 1.0


def test_noise_has_zero_mean_and_fades_with_the_footprint():
    noise = Noise(0)
    rng = np.random.default_rng(1)
    u, v = rng.uniform(-1000, 1000, (2, 20000)).astype(np.float32)
    spectrum = ((0.1, 1.0), (1.0, 1.0))
    sharp = noise.waves(u, v, np.full(20000, 1e-3, np.float32), spectrum)
    half = noise.waves(u, v, np.full(20000, 0.2, np.float32), spectrum)
    gone = noise.waves(u, v, np.full(20000, 2.0, np.float32), spectrum)
    assert abs(sharp.mean()) < 0.02
    # two waves of standard deviation 0.5, less what interpolation takes
    assert sharp.std() == pytest.approx(0.5 * np.sqrt(2), rel=0.08)
    assert half.std() == pytest.approx(0.5, rel=0.08)
    assert np.all(gone == 0)
    # the same place, the same value, whoever asks
    np.testing.assert_array_equal(noise.waves(u[:7], v[:7], np.full(7, 1e-3, np.float32), spectrum), sharp[:7])
    assert not np.array_equal(Noise(1).wave(u, v, 1.0, 0), noise.wave(u, v, 1.0, 0))
