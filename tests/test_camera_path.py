"""Paths of films: their geometry, and what nerfstudio makes of the files."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.cameras.camera_paths import get_path_from_json
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from rich.console import Console
from scenes import fisheye, pinhole, transforms, write_scene
from trainings import write_config

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.films.command import film_lens, write_camera_path
from edge_depth_nerf.films.options import CameraPathOptions
from edge_depth_nerf.films.paths import CameraPath, lane_shift, orbit, replay, up_of
from edge_depth_nerf.plugin.config import edge_depth_nerf_lite
from edge_depth_nerf.plugin.dataparser import FisheyeDepth, FisheyeDepthDataParserConfig
from edge_depth_nerf.scene.reader import read_scene

UP = np.array([0.0, 0.0, 1.0])
RADIUS_M, SPEED_M_S = 20.0, 8.0
QUIET = Console(quiet=True)


def looking(forward: np.ndarray, up: np.ndarray = UP) -> np.ndarray:
    """OpenGL camera axes, as columns, of a camera that looks along `forward`."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack((right, np.cross(right, forward), -forward), axis=1)


def on_circle(time_s: float, mounted: np.ndarray) -> np.ndarray:
    """Pose of a camera that drives a left turn; `mounted` turns it from looking ahead, in its own axes."""
    angle = time_s * SPEED_M_S / RADIUS_M
    pose = np.eye(4)
    pose[:3, :3] = looking(np.array([np.cos(angle), np.sin(angle), 0.0])) @ mounted
    pose[:3, 3] = RADIUS_M * np.sin(angle), RADIUS_M * (1 - np.cos(angle)), 1.5
    return pose


# to the left and 20° down
TO_THE_LEFT = looking(np.array([-np.cos(np.radians(20)), -np.sin(np.radians(20)), 0.0]), np.array([0.0, 1.0, 0.0]))


def circle(frames: int = 30, mounted: np.ndarray = TO_THE_LEFT) -> CameraPath:
    times_s = np.arange(frames) / 10
    return CameraPath(times_s, np.stack([on_circle(time, mounted) for time in times_s]), UP)


def straight(frames: int = 41) -> CameraPath:
    """Along y for 40 m, looking to the left (-x)."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = looking(np.array([-1.0, 0.0, 0.0]))
    poses[:, 1, 3] = np.arange(frames)
    return CameraPath(np.arange(frames) / 10, poses, UP)


def test_a_replay_is_the_drive_and_smooth_between():
    drive = circle()
    assert np.allclose(replay(drive, drive.times_s, forward=False), drive.camera_to_scene, atol=1e-9)
    between = drive.times_s[:-1] + np.diff(drive.times_s) * 0.37
    truth = np.stack([on_circle(time, TO_THE_LEFT) for time in between])
    assert np.abs(replay(drive, between, forward=False) - truth).max() < 1e-3


def test_forward_is_where_the_vehicle_goes_whatever_the_camera_sees():
    drive = circle()
    poses = replay(drive, drive.times_s, forward=True)
    truth = np.stack([on_circle(time, np.eye(3)) for time in drive.times_s])
    # a tenth of a second of the turn is 2.3°: half of it is all that the direction of the steps may be off
    assert np.abs(poses - truth).max() < np.radians(2.3) / 2 + 1e-3
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_forward_stays_while_the_vehicle_stands_or_backs_up():
    straight_on = straight()
    y = straight_on.camera_to_scene[:, 1, 3]
    poses = straight_on.camera_to_scene.copy()
    poses[:, 1, 3] = np.where(y < 20, y, np.where(y < 30, 20, 20 - 0.2 * (y - 30)))
    drive = CameraPath(straight_on.times_s, poses, UP)
    assert np.allclose(replay(drive, drive.times_s, forward=True)[:, :3, 2], [0, -1, 0], atol=1e-6)


def test_a_lane_shift_is_eased_to_the_left_and_back():
    drive = straight()
    times_s = np.linspace(drive.times_s[0], drive.times_s[-1], 401)
    for forward in (False, True):
        shifted = lane_shift(drive, times_s, forward, 1.5)
        plain = replay(drive, times_s, forward)
        assert np.array_equal(shifted[:, :3, :3], plain[:, :3, :3])
        # left of a drive along y is -x
        left_m = plain[:, 0, 3] - shifted[:, 0, 3]
        assert np.allclose((shifted - plain)[:, 1:3, 3], 0)
        assert left_m[0] == pytest.approx(0) and left_m[-1] == pytest.approx(0, abs=1e-9)
        assert np.allclose(left_m[100:301], 1.5) and (np.diff(left_m[:101]) >= 0).all()
        assert left_m[50] == pytest.approx(0.75)
        assert np.allclose(left_m, left_m[::-1])
        assert np.abs(np.diff(left_m)[[0, 99, 300, 399]]).max() < 1e-3  # without a jerk
    to_the_right = lane_shift(drive, times_s, False, -1.5)
    assert to_the_right[200, 0, 3] == pytest.approx(1.5)


def wall(distance_m: float, height_m: float) -> np.ndarray:
    """Points along the drive, beside it, level with the camera or not."""
    return np.stack(np.broadcast_arrays(distance_m, np.linspace(0, 40, 400), height_m), axis=1).astype(np.float64)


def test_an_orbit_goes_around_a_point_of_the_way_and_looks_at_it():
    poses, radius_m = orbit(straight(), 36, 5.0, 3.0, wall(10.0, 0.0))
    assert radius_m == 3.0
    position, centre = poses[:, :3, 3], np.array([0.0, 25.0, 0.0])
    assert np.allclose(np.linalg.norm(position - centre, axis=1), 3)
    assert np.allclose(position[:, 2], 0)
    assert np.allclose(position[0], [0, 22, 0])  # behind it
    assert np.allclose(position[9], [3, 25, 0])  # then to its right: counter-clockwise from above
    assert np.allclose(-poses[:, :3, 2], (centre - position) / 3)
    assert np.allclose(poses[:, :3, 1], UP)
    assert np.allclose(np.linalg.det(poses[:, :3, :3]), 1)
    beyond, _ = orbit(straight(), 36, 100.0, 3.0, None)
    assert np.allclose(beyond[:, :3, 3].mean(axis=0), [0, 40, 0])
    # smaller than the vehicle, where that is asked for
    assert orbit(straight(), 12, 5.0, 0.5, None)[1] == 0.5


@pytest.mark.parametrize(
    ("points", "radius_m"),
    [
        (wall(2.5, 0.5), 1.5),  # a metre from what is there
        (wall(1.2, 0.5), 1.0),  # where the vehicle itself has been is free
        (np.vstack((wall(0.3, -1.6), wall(0.0, 4.0), wall(9.0, 0.0))), 3.0),  # the road, and crowns of trees
        (np.vstack((np.tile([0.4, 25.0, 0.0], (4, 1)), wall(9.0, 0.0))), 3.0),  # a few strays
        (None, 1.0),
    ],
)
def test_an_orbit_stays_inside_what_was_seen(points, radius_m):
    assert orbit(straight(), 12, 5.0, 3.0, points)[1] == pytest.approx(radius_m, abs=0.02)


def test_which_way_is_up():
    around = np.stack([looking(np.array([np.cos(a), np.sin(a), -1.0]) / np.sqrt(2)) for a in (0.0, 2.1, 4.2)])
    assert np.array_equal(up_of(around), UP)
    pitched = np.stack([looking(np.array([1.0, 0.0, -0.3]) / np.hypot(1, 0.3))] * 2)
    assert np.array_equal(up_of(pitched), UP)
    y_up = np.stack([looking(np.array([np.cos(a), 0.0, np.sin(a)]), np.array([0.0, 1.0, 0.0])) for a in (0.0, 1.0)])
    assert np.allclose(up_of(y_up), [0, 1, 0])


def test_a_camera_that_stands_has_no_forward():
    drive = straight()
    standing = CameraPath(drive.times_s, np.tile(drive.camera_to_scene[:1], (41, 1, 1)), UP)
    assert np.allclose(replay(standing, np.array([0.05]), forward=False), drive.camera_to_scene[:1])
    for move in (lambda: replay(standing, np.array([0.05]), True), lambda: orbit(standing, 8, 5.0, 3.0, None)):
        with pytest.raises(InputError, match="does not move"):
            move()


def test_a_drive_needs_two_pictures_at_increasing_times():
    drive = straight()
    with pytest.raises(InputError, match="two pictures"):
        CameraPath(drive.times_s[:1], drive.camera_to_scene[:1], UP)
    with pytest.raises(InputError, match="increase, but picture 3"):
        CameraPath(np.array([0.0, 1.0, 1.0]), drive.camera_to_scene[:3], UP)


# -- the files
@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Two cameras that drive 8 m along x and look to its sides, with times 0.25 s apart.

    It was turned and scaled before it was written: nerfstudio's transform begins there, its poses do not.
    """
    folder = write_scene(tmp_path_factory.mktemp("scene"), [fisheye(32, 28)], frames=18)
    with transforms(folder) as meta:
        for index, frame in enumerate(meta["frames"]):
            number, side = divmod(index, 2)
            pose = np.eye(4)
            pose[:3, :3] = looking(np.array([0.0, -1.0 if side else 1.0, 0.0]))
            pose[:3, 3] = 100 + number, 0.3 - 0.6 * side, 0.1 * np.sin(number)
            frame["transform_matrix"] = pose.tolist()
            frame |= {"camera": ("left", "right")[side], "frame": number, "timestamp_s": 1.3e9 + 0.25 * number}
        names = [frame["file_path"] for frame in meta["frames"]]
        meta["val_filenames"] = meta["test_filenames"] = names[8:10]
        meta["train_filenames"] = names[:8] + names[10:]
        meta["applied_transform"] = [[0.0, 1.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
        meta["applied_scale"] = 2.5
    return folder


@pytest.fixture(scope="module")
def trained(scene, tmp_path_factory):
    """Settings of trainings: ours, and nerfstudio's own on the same scene, which turns, shifts and scales it."""
    folder = tmp_path_factory.mktemp("runs")
    ours = edge_depth_nerf_lite.config
    theirs = method_configs["nerfacto"]
    parsers = {
        "ours": (ours, FisheyeDepthDataParserConfig(metres_per_unit=7.5)),
        "host": (theirs, NerfstudioDataParserConfig(downscale_factor=1, center_method="focus")),
    }
    for name, (config, parser) in parsers.items():
        datamanager = replace(config.pipeline.datamanager, dataparser=parser, data=scene)  # pyrefly: ignore
        # pyrefly: ignore[missing-attribute, unexpected-keyword]
        settings = replace(config, data=scene, pipeline=replace(config.pipeline, datamanager=datamanager))
        (folder / f"{name}.yml").write_text(yaml.dump(settings))
        parser.data = scene
    return folder, {name: parser for name, (_, parser) in parsers.items()}


def poses_of_training(parser, scene: Path) -> dict[str, np.ndarray]:
    found = {}
    for split in ("train", "test"):
        outputs = parser.setup().get_dataparser_outputs(split=split)
        for path, pose in zip(outputs.image_filenames, outputs.cameras.camera_to_worlds.numpy(), strict=True):
            found[str(path.relative_to(scene))] = pose
    return found


@pytest.mark.parametrize("name", ["ours", "host"])
@pytest.mark.parametrize("camera", ["left", "right"])
def test_a_replay_has_the_poses_that_the_model_was_trained_with(trained, scene, tmp_path, name, camera):
    folder, parsers = trained
    output = tmp_path / "path.json"
    write_camera_path(CameraPathOptions(folder / f"{name}.yml", follow=camera, output=output), QUIET)
    path = read_json(output)
    cameras = get_path_from_json(path)
    poses = poses_of_training(parsers[name], scene)
    frames = [frame for frame in read_json(scene / "transforms.json")["frames"] if frame["camera"] == camera]
    expected = np.stack([poses[frame["file_path"]] for frame in frames])
    assert np.abs(cameras.camera_to_worlds.numpy() - expected).max() < 2e-5
    assert path["fps"] == 4 and path["seconds"] == len(expected) / 4
    # a fisheye of the same scale as the drive's own, in the middle of the picture
    assert int(cameras.camera_type[0]) == CameraType.FISHEYE.value
    assert torch.allclose(cameras.fx, torch.tensor(9.0, dtype=cameras.fx.dtype)) and torch.equal(cameras.fx, cameras.fy)
    assert (int(cameras.width[0]), int(cameras.height[0])) == (32, 28)


def film(scene: Path, tmp_path: Path, **options):
    """A film of a training with 10 m in a unit."""
    output, config = tmp_path / "path.json", write_config(tmp_path / "config.yml", scene)
    write_camera_path(CameraPathOptions(config, output=output, **options), QUIET)
    path = read_json(output)
    return path, get_path_from_json(path)


def test_a_pinhole_beside_fisheyes_is_filmed_as_a_pinhole(tmp_path):
    """The scene has a fisheye in its place, as nerfstudio takes one kind of camera."""
    scene = write_scene(tmp_path / "scene", [fisheye(32, 28)])
    with transforms(scene) as meta:
        lens = {"model": "PINHOLE", "width": 32, "height": 28, "fx": 16.0, "fy": 16.0, "cx": 16.0, "cy": 14.0}
        lens["theta_limit_rad"] = np.radians(40)
        meta["original_cameras"] = {read_scene(scene).pictures[0].camera: lens}
    path, cameras = film(scene, tmp_path)
    assert path["camera_type"] == "perspective" and (path["render_width"], path["render_height"]) == (32, 28)
    assert angles_deg(cameras, (14, 0))[0] == pytest.approx(40.0)


def angles_deg(cameras, *pixels: tuple[int, int]) -> list[float]:
    """Between the optical axis and the rays of some pixels (row, column)."""
    coords = torch.tensor(pixels, dtype=torch.float32)
    rays = cameras.generate_rays(camera_indices=torch.zeros(len(pixels), 1, dtype=torch.long), coords=coords)
    axis = -cameras.camera_to_worlds[0, :, 2]
    return torch.rad2deg(torch.arccos((rays.directions @ axis).clamp(-1, 1))).tolist()


def test_angle_of_view_of_a_pinhole(scene, tmp_path):
    _, cameras = film(scene, tmp_path, camera="perspective", width=320, fov_deg=80.0)
    assert int(cameras.camera_type[0]) == CameraType.PERSPECTIVE.value
    assert (int(cameras.width[0]), int(cameras.height[0])) == (320, 180)
    left, middle = angles_deg(cameras, (90, 0), (90, 160))
    assert left == pytest.approx(40) and middle == pytest.approx(0, abs=1e-2)
    # it looks ahead, along x
    assert np.allclose(cameras.camera_to_worlds[:, :, 2], [-1, 0, 0], atol=1e-5)


def test_angle_of_view_of_a_fisheye_grows_evenly(scene, tmp_path):
    _, cameras = film(scene, tmp_path, width=192, fov_deg=192.0)
    assert (int(cameras.width[0]), int(cameras.height[0])) == (192, 168)
    assert angles_deg(cameras, (84, 0), (84, 48), (36, 96)) == pytest.approx([96, 48, 48], abs=1e-2)
    pinholes = write_scene(tmp_path / "pinholes", [pinhole()], frames=3)
    _, cameras = film(pinholes, tmp_path)
    # that of the drive's lens, 32 px wide, evenly
    assert angles_deg(cameras, (14, 0)) == pytest.approx([np.degrees(np.arctan(16 / pinhole().fx))], abs=1e-2)
    _, cameras = film(pinholes, tmp_path, camera="perspective")
    assert (int(cameras.width[0]), int(cameras.height[0])) == (32, 28)
    assert torch.allclose(cameras.fx, torch.full_like(cameras.fx, pinhole().fx))


def test_the_whole_sphere(scene, tmp_path):
    path, cameras = film(scene, tmp_path, camera="equirectangular")
    assert int(cameras.camera_type[0]) == CameraType.EQUIRECTANGULAR.value
    assert (path["render_width"], path["render_height"]) == (56, 28)
    coords = torch.tensor([(14.0, 28.0), (14.0, 14.0), (0.0, 28.0), (14.0, 42.0)])
    rays = cameras.generate_rays(camera_indices=torch.zeros(4, 1, dtype=torch.long), coords=coords)
    # ahead is in the middle, the vehicle's left on the left, the sky above
    assert torch.allclose(rays.directions, torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]]), atol=1e-4)


def test_lengths_are_metres_of_the_scene(scene, tmp_path):
    _, plain = film(scene, tmp_path, camera="perspective")
    _, shifted = film(scene, tmp_path, camera="perspective", kind="lane-shift", shift_m=2.0)
    moved = (shifted.camera_to_worlds - plain.camera_to_worlds)[:, :, 3].numpy()
    assert np.allclose(moved[4], [0, 0.2, 0], atol=1e-5)
    assert np.allclose(moved[[0, 8]], 0, atol=1e-5)


@pytest.mark.parametrize(("shift_m", "warned"), [(9.0, False), (-14.0, True)])
def test_a_path_far_outside_the_drive_is_reported(scene, tmp_path, shift_m, warned, capsys):
    config = write_config(tmp_path / "config.yml", scene)
    asked = CameraPathOptions(config, output=tmp_path / "path.json", kind="lane-shift", shift_m=shift_m)
    write_camera_path(asked, Console(width=200))
    said = " ".join(capsys.readouterr().out.split())
    # the path is back at the drive at both ends
    assert ("5 of 9 poses of the path are more than 10 m from the drive, the furthest 13 m" in said) is warned
    assert (tmp_path / "path.json").is_file()


@pytest.mark.parametrize(
    ("camera", "options"), [("perspective", {"fov_deg": 80.0}), ("fisheye", {}), ("equirectangular", {})]
)
def test_the_rays_of_a_film_are_those_that_are_rendered(scene, tmp_path, camera, options):
    _, cameras = film(scene, tmp_path, camera=camera, width=48, **options)
    asked = CameraPathOptions(Path("c.yml"), camera=camera, width=48, **options)
    lens = film_lens(fisheye(32, 28), asked)
    rows = round(24 * lens.height / lens.width)
    pixels = (np.indices((rows, 24)).reshape(2, -1).T + 0.5) * (lens.height / rows, 2)
    coords = torch.from_numpy(pixels).float()
    rays = cameras.generate_rays(torch.zeros(len(pixels), 1, dtype=torch.long), coords=coords).directions.numpy()
    assert np.allclose(lens.rays(camera) @ cameras.camera_to_worlds[0, :, :3].numpy().T, rays, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "unseen"),
    [
        ({"fov_deg": 120.0}, 1 - (np.tan(np.radians(40)) / np.tan(np.radians(60))) ** 2),
        ({}, None),
        ({"kind": "orbit"}, 0.7),
    ],
)
def test_what_no_camera_saw_is_reported(tmp_path, capsys, options, unseen):
    """A pinhole of 80° that looks ahead; of the eight poses of an orbit, three look nearly the same way."""
    lens = replace(pinhole(32, 32), fx=16 / np.tan(np.radians(40)), fy=16 / np.tan(np.radians(40)), cx=16.0, cy=16.0)
    scene = write_scene(tmp_path / "scene", [lens], frames=18, mask=False)
    with transforms(scene) as meta:
        for number, frame in enumerate(meta["frames"]):
            pose = np.eye(4)
            pose[:3, :3], pose[0, 3] = looking(np.array([1.0, 0.0, 0.0])), number / 10
            frame["transform_matrix"] = pose.tolist()
    config = write_config(tmp_path / "config.yml", scene)
    asked = CameraPathOptions(config, output=tmp_path / "path.json", camera="perspective", **options)
    write_camera_path(asked, Console(width=300))
    found = re.search(r"(\d+)% of the film's rays show what no training picture", capsys.readouterr().out)
    assert (found is not None) is (unseen is not None)
    assert found is None or int(found[1]) / 100 == pytest.approx(unseen, abs=0.1)


def test_an_orbit_of_a_scene(scene, tmp_path):
    path, cameras = film(scene, tmp_path, kind="orbit", ahead_m=2.0, radius_m=3.0)
    place = cameras.camera_to_worlds[:, :, 3].numpy()
    assert len(place) == 24 and path["seconds"] == 6 and path["is_cycle"]
    # without LiDAR's points a metre, which is 0.1 units
    assert np.allclose(np.linalg.norm(place - place.mean(axis=0), axis=1), 0.1, atol=1e-5)


def test_length_and_rate_can_be_chosen(scene, tmp_path):
    path, cameras = film(scene, tmp_path, fps=30.0, seconds=1.5)
    assert len(cameras) == 45 and path["seconds"] == 1.5
    path, cameras = film(scene, tmp_path, fps=30.0)
    assert len(cameras) == 61 and path["fps"] == 30
    # the viewer finds its keyframes
    assert len(path["keyframes"]) == 12
    assert path["keyframes"][0]["matrix"] == path["camera_path"][0]["camera_to_world"]
    assert path["keyframes"][-1]["matrix"] == path["camera_path"][-1]["camera_to_world"]
    assert path["default_transition_sec"] * 11 == pytest.approx(path["seconds"])
    no_times = write_scene(tmp_path / "no_times", frames=5)
    path, _ = film(no_times, tmp_path)
    assert path["fps"] == 10 and len(path["camera_path"]) == 5
    with pytest.raises(InputError, match="1 pictures"):
        film(scene, tmp_path, seconds=0.2)
    with pytest.raises(InputError, match="It has left, right"):
        film(scene, tmp_path, follow="front")


def test_it_says_how_the_film_is_made(trained, tmp_path):
    config = trained[0] / "ours.yml"
    output = tmp_path / "a path.json"
    console = Console(record=True, width=400, file=(tmp_path / "said").open("w"))
    write_camera_path(CameraPathOptions(load_config=config, output=output), console)
    text = console.export_text()
    assert (
        f"ns-render camera-path --load-config {config} --camera-path-filename '{output}' "
        f"--output-path '{output.with_suffix('.mp4')}'"
    ) in text
    assert "Dataset is overriding" not in text


def test_by_default_the_path_lies_beside_the_training(trained):
    folder, _ = trained
    path = write_camera_path(CameraPathOptions(load_config=folder / "ours.yml", kind="lane-shift"), QUIET)
    assert path == folder / "camera_paths" / "lane-shift_fisheye.json" and path.is_file()


def test_a_missing_ffmpeg_is_said_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    console = Console(record=True, width=400, file=(tmp_path / "said").open("w"))
    with pytest.raises(FileNotFoundError):
        write_camera_path(CameraPathOptions(tmp_path / "none.yml"), console)
    assert "apt-get install ffmpeg" in console.export_text()


def test_a_scene_that_changed_since_the_training_is_refused(trained, scene, tmp_path):
    folder, parsers = trained
    config = shutil.copy(folder / "host.yml", tmp_path / "config.yml")
    options = CameraPathOptions(load_config=config, output=tmp_path / "path.json")
    outputs = parsers["host"].setup().get_dataparser_outputs(split="train")
    outputs.save_dataparser_transform(tmp_path / "dataparser_transforms.json")
    write_camera_path(options, QUIET)
    other = write_scene(tmp_path / "other")
    with pytest.raises(InputError, match="changed after the training"):
        write_camera_path(replace(options, scene=other), QUIET)


def test_a_scene_may_have_been_moved(trained, scene, tmp_path):
    folder, _ = trained
    moved = shutil.copytree(scene, tmp_path / "moved")
    options = [CameraPathOptions(folder / "host.yml", place) for place in (None, moved, moved / "transforms.json")]
    paths = [read_json(write_camera_path(each, QUIET)) for each in options]
    assert paths[0] == paths[1] == paths[2]


def test_a_dataparser_whose_transform_does_not_tell_is_refused(scene, tmp_path, monkeypatch):
    plain = FisheyeDepth._generate_dataparser_outputs

    def shifted(self, split="train"):
        outputs = plain(self, split)
        outputs.cameras.camera_to_worlds[..., 3] += 0.1
        return outputs

    monkeypatch.setattr(FisheyeDepth, "_generate_dataparser_outputs", shifted)
    with pytest.raises(InputError, match="no path can be computed"):
        film(scene, tmp_path)


def test_settings_that_are_none(tmp_path):
    config = tmp_path / "config.yml"
    with pytest.raises(FileNotFoundError, match=r"config\.yml that ns-train wrote"):
        write_camera_path(CameraPathOptions(load_config=config), QUIET)
    for text in ("a: [1", "a: 1", "!!python/object:no_such_plugin.Config {}"):
        config.write_text(text)
        with pytest.raises(InputError, match=r"config\.yml that ns-train wrote"):
            write_camera_path(CameraPathOptions(load_config=config), QUIET)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 33}, "--width 33: expected an even number"),
        ({"width": 8}, "--width 8"),
        ({"camera": "equirectangular", "fov_deg": 90.0}, "whole sphere"),
        ({"camera": "perspective", "fov_deg": 180.0}, "1 to 170"),
        ({"fov_deg": float("nan")}, "1 to 240"),
        ({"fps": 0.0}, "--fps"),
        ({"seconds": float("inf")}, "--seconds"),
        ({"radius_m": -1.0}, "--radius-m"),
        ({"shift_m": float("nan")}, "--shift-m"),
        ({"ahead_m": -1.0}, "--ahead-m"),
    ],
)
def test_options_out_of_range(options, message):
    with pytest.raises(InputError, match=message):
        CameraPathOptions(Path("c.yml"), **options).check()
