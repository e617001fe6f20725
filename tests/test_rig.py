"""A rig of one's own: the example of docs/rig.md goes the whole way, and whatever is wrong with a recording is said."""

import json
import math
import re
import shutil
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import recording
from drives import Change, spoil, synthesize_coarsely, without_lidar_check
from rich.console import Console
from scipy.spatial.transform import Rotation
from trainings import train

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask, write_json, write_png
from edge_depth_nerf.cameras import MEI, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.calibration_file import parse_toml
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.process.rig_file import read_rig
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[1] / "docs" / "rig.md"
FRAMES = 5
FIRST_S = 1369730762.123456789
TIMES = 'point_times = {column = "t", unit = "ns", counted_from = "timestamp"}'
RECORD = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]


def example() -> str:
    return next(block for block in re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.S) if "[lidars.roof]" in block)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    without_lidar_check(monkeypatch)


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("rig") / "drive"
    synthesize_coarsely(SynthesizeOptions(root, "parking", frames=FRAMES, size=128, layout="rig"))
    written, page = root / "rig.toml", root.parent / "page.toml"
    page.write_text(example())
    for ours, theirs in zip(read_rig(page, root).cameras, read_rig(written, root).cameras, strict=True):
        assert ours.camera == theirs.camera and ours.images == theirs.images
        assert ours.to_vehicle == pytest.approx(theirs.to_vehicle, abs=1e-9)
    shutil.copy(page, written)
    return root


@pytest.fixture
def mine(drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drive, tmp_path / "drive", ignore=shutil.ignore_patterns("truth")))


def options(root: Path, **changes) -> RigOptions:
    given: dict[str, Any] = {"root": root, "output": root.parent / "scene", "theta_max_deg": 110.0, "strict": True}
    return RigOptions(**given | {"refine_poses": False, "find_ego": False} | changes)


def read(root: Path, **changes) -> Recording:
    return read_rig_recording(options(root, **changes))


def edit(root: Path, *changes: tuple[str, str], file: str = "rig.toml") -> Path:
    path = root / file
    content = path.read_text()
    for old, new in changes:
        assert old in content, old
        content = content.replace(old, new, 1)
    path.write_text(content)
    return root


@pytest.fixture(scope="module")
def scene(drive: Path) -> Path:
    report = convert(options(drive, refine_poses=True, find_ego=True), Console(quiet=True))
    assert (report.training, report.held_out) == (12, 3)
    assert report.skipped == ()
    assert sorted(report.fits) == ["front", "left", "right"]
    assert max(fit.rms_px for fit in report.fits.values()) < 0.01
    return report.scene


def test_the_pages_example_is_a_scene(scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    assert meta["camera_model"] == "OPENCV_FISHEYE"
    assert meta["source"]["kind"] == "rig" and "/" not in json.dumps(meta["source"])
    sizes = {frame["camera"]: (frame["w"], frame["h"]) for frame in meta["frames"]}
    assert sizes == {"left": (128, 128), "right": (128, 128), "front": (128, 96)}
    times = {frame["frame"]: frame["timestamp_s"] for frame in meta["frames"]}
    assert [times[number] - times[0] for number in range(FRAMES)] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4], abs=0.02)
    # the lenses see past 95 degrees, and the masks keep it
    assert read_mask(scene / "masks/left.png").mean() > 0.5


def test_lidar_lies_on_what_the_cameras_see(scene: Path, drive: Path) -> None:
    """Models, transforms, clocks and point times together: the distances are the true ones of the pixels."""
    for name in ("left", "right", "front"):
        errors, point_count = [], 0
        for frame in range(FRAMES):
            lidar = read_distance_png(scene / f"lidar/{name}/{frame:010d}.png")
            truth = read_distance_png(drive / f"truth/{name}/distance/{frame:06d}.png")
            both = (lidar > 0) & (truth > 0)
            point_count += both.sum()
            errors.append(np.abs(lidar[both] / truth[both] - 1))
        assert point_count > 5000
        # a pixel is 1.5° wide; a return lies anywhere in it
        assert np.median(np.concatenate(errors)) < 0.015
        assert np.mean(np.concatenate(errors) < 0.05) > 0.8


def test_the_pages_example_trains(scene: Path, tmp_path: Path) -> None:
    pipeline, losses = train(scene, tmp_path, 25)
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3])
    metrics = pipeline.get_average_eval_image_metrics()
    assert np.isfinite(metrics["masked_psnr"]) and metrics["lidar_pixels"] > 100


def test_cameras_are_read_as_the_page_says(drive: Path) -> None:
    rig = read_rig(drive / "rig.toml", drive)
    left, right, front = (camera.camera for camera in rig.cameras)
    assert left == KannalaBrandt(128, 128, 33.9625035468, 33.9964660503, 64.896, 63.488, -0.012, 0.006, -0.0018, 8e-05)
    assert right == MEI(128, 128, 53.8160469987, 53.8698630457, 64.896, 63.488, 1.2, 0.03, 0.02, 0.0003, -0.0002)
    assert front == Pinhole(128, 96, 89.6, 89.856, 64.384, 47.04, -0.11, 0.03, 0.0004, -0.0003)
    # quaternion of 3 degrees about z
    angle = math.radians(3)
    rows = [[math.cos(angle), -math.sin(angle), 0, 0.8], [math.sin(angle), math.cos(angle), 0, 0.02], [0, 0, 1, 0.84]]
    assert rig.lidars[0].to_vehicle == pytest.approx(np.array([*rows, [0, 0, 0, 1]]), abs=1e-9)


def test_json_says_the_same(mine: Path) -> None:
    content = parse_toml((mine / "rig.toml").read_text())
    of_toml = read(mine)
    (mine / "rig.toml").unlink()
    write_json(mine / "rig.json", content)
    of_json = read(mine)
    assert of_json.pictures == of_toml.pictures
    assert [sweep.time_s for sweep in of_json.sweeps] == [sweep.time_s for sweep in of_toml.sweeps]


def test_pixel_centres_and_where_a_calibration_ends(mine: Path) -> None:
    edit(mine, ('model = "mei"', 'model = "mei"\ntheta_max_deg = 80'), ("cx = 64.396", "pixel_centre = 0\ncx = 64.396"))
    for centre, after, cx in (("0", "0.5", 64.896), ("0.5", "1", 64.396), ("1", "1", 63.896)):
        left, right, _ = read_rig(mine / "rig.toml", mine).cameras
        assert left.camera.cx == pytest.approx(cx)
        assert math.degrees(right.camera.theta_max_rad) == pytest.approx(80)
        edit(mine, (f"pixel_centre = {centre}\ncx", f"pixel_centre = {after}\ncx"))


def test_frames_and_scans(mine: Path) -> None:
    recording = read(mine)
    assert [picture.frame for picture in recording.pictures] == sorted(3 * list(range(FRAMES)))
    delays = {"left": 0.0, "right": 0.004, "front": 0.012}
    for picture in recording.pictures:
        time_s = FIRST_S + 0.1 * int(picture.path.stem) + delays[picture.camera]
        assert picture.time_s == pytest.approx(time_s, abs=2e-6)
        assert picture.mono is not None and picture.mono.stem == picture.path.stem
    # the name is the start of the turn; the middle of it is the pictures' moment
    assert [(sweep.frame, sweep.path.name) for sweep in recording.sweeps][:2] == [
        (0, "1369730762073456789.pcd"),
        (1, "1369730762173456789.pcd"),
    ]
    for sweep in recording.sweeps:
        assert sweep.frame is not None
        assert sweep.time_s == pytest.approx(FIRST_S + 0.1 * sweep.frame, abs=2e-6)
        offset_s = sweep.read().offset_s
        assert offset_s is not None and -0.05 < offset_s.min() < -0.04 and 0.04 < offset_s.max() < 0.05


def test_a_turn_says_the_same_as_the_points_own_times(mine: Path) -> None:
    timed = read(mine).sweeps[2]
    by_point = timed.read()
    edit(mine, (TIMES, 'direction = "clockwise"'))
    turning = read(mine).sweeps[2]
    assert (turning.time_s, turning.frame) == (timed.time_s, timed.frame)
    by_turn = turning.read()
    assert by_turn.offset_s is None and turning.timing is not None and by_point.offset_s is not None
    # 1200 firings a turn of 0.1 s: within a tenth of one
    assert (turning.timing.offsets_s(by_turn.points_m) - by_point.offset_s).abs().max() < 1e-5
    # the same counted on the clock, but for the digits that seconds since 1970 have
    for path in sorted((mine / "lidar").iterdir()):
        points = np.frombuffer(path.read_bytes().partition(b"DATA binary\n")[2], RECORD)
        on_clock = np.empty(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("stamp", "u8")])
        for name in "xyz":
            on_clock[name] = points[name]
        on_clock["stamp"] = points["t"] + np.uint64(path.stem)
        np.save(path.with_suffix(".npy"), on_clock)
        path.unlink()
    edit(mine, ('direction = "clockwise"', 'point_times = {column = "stamp", unit = "ns", counted_from = "clock"}'))
    on_clock = read(mine).sweeps[2].read()
    assert on_clock.offset_s is not None
    assert (on_clock.offset_s - by_point.offset_s).abs().max() < 1e-6
    # a clock that is off moves points and scans alike
    edit(mine, ('counted_from = "clock"}', 'counted_from = "clock"}\ntime_offset_s = 0.02'))
    late = read(mine).sweeps[2]
    late_points = late.read()
    assert late.time_s - timed.time_s == pytest.approx(0.02, abs=1e-6) and late_points.offset_s is not None
    assert (late_points.offset_s - by_point.offset_s).abs().max() < 1e-6
    edit(mine, ('unit = "ns", counted_from = "clock"', 'unit = "us", counted_from = "clock"'))
    with pytest.raises(InputError, match=r"points' times are .* s from the scan's own \(median\)\. Correct unit or"):
        read(mine).sweeps[2].read()


@pytest.mark.parametrize(
    ("time_s", "from_start_s"), [("timestamp", 0.0), ("start", 0.0), ("middle", 0.05), ("end", 0.1)]
)
def test_scans_that_are_corrected_already(mine: Path, time_s: str, from_start_s: float) -> None:
    """They go to the world by the pose of the time they are corrected to; the frame they belong to stays."""
    raw = read(mine).sweeps
    edit(mine, (TIMES, f'corrected_to = "{time_s}"'))
    recording = read(mine)
    assert not recording.notices
    for one, before in zip(recording.sweeps, raw, strict=True):
        assert one.frame == before.frame and one.timing is None and one.read().offset_s is None
        assert one.time_s - before.time_s == pytest.approx(from_start_s - 0.05, abs=1e-6)


def test_points_in_the_vehicles_frame(mine: Path) -> None:
    in_scanner = read(mine).sweeps[1]
    edit(mine, ('timestamp = "start"', 'timestamp = "start"\npoints_in = "vehicle"'))
    in_vehicle = read(mine).sweeps[1]
    # the scanner stays where it is, and the numbers of the file are the vehicle's
    assert np.array_equal(in_vehicle.to_vehicle, in_scanner.to_vehicle)
    points, place = in_vehicle.read(), in_vehicle.to_vehicle[:3, 3]
    moved = points.points_m.numpy() @ in_vehicle.to_vehicle[:3, :3].T + place
    assert moved == pytest.approx(in_scanner.read().points_m.numpy(), abs=1e-9)
    # missing echoes are no points: a recorder that moves the whole cloud moves them to the scanner's place
    lines = in_vehicle.path.read_bytes().partition(b"DATA binary\n")
    values = np.frombuffer(lines[2], RECORD).copy()
    for name, number in zip("xyz", place, strict=True):
        values[name][:7] = number
    in_vehicle.path.write_bytes(lines[0] + lines[1] + values.tobytes())
    without = read(mine).sweeps[1].read()
    assert without.out_of_range == points.out_of_range + 7
    assert len(without.points_m) == len(points.points_m) - 7 and without.points_m.norm(dim=-1).min() > 0.5


def test_a_folder_for_each_frame(mine: Path) -> None:
    """Names are alike then; folders are in the order of their numbers, and of maps none may take another's place."""
    for number in reversed(range(FRAMES)):
        folder = mine / f"moments/{number + 7}"
        folder.mkdir(parents=True)
        shutil.copy(mine / f"images/left/{number:06d}.png", folder / "left.png")
    edit(mine, ('images = "images/left"', 'images = "moments/*/left.png"'))
    text = (mine / "rig.toml").read_text()
    (mine / "rig.toml").write_text(re.sub(r"(?m)^mono = .*\n", "", text))
    pictures = [picture for picture in read(mine).pictures if picture.camera == "left"]
    assert [int(picture.path.parent.name) for picture in pictures] == [*range(7, 7 + FRAMES)]
    assert [picture.time_s for picture in pictures] == sorted(picture.time_s for picture in pictures)
    edit(mine, ("[cameras.left]\n", '[cameras.left]\nmasks = "moments/*/left.png"\n'))
    with pytest.raises(InputError, match=r"cameras\.left\.masks: .*have one name\. Give files of different names"):
        read(mine)


def test_the_path_is_the_vehicles(mine: Path) -> None:
    trajectory = read(mine).trajectory
    assert trajectory is not None
    lines = (mine / "poses.txt").read_text().splitlines()[1:]
    angle = math.radians(3)
    roof = np.eye(4)
    roof[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    roof[:3, 3] = 0.8, 0.02, 0.84
    moved = []
    for line in lines:
        time, *numbers = map(float, line.split())
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3]
        pose = pose @ roof
        row = (*(pose[:3, 3] / 2), *Rotation.from_matrix(pose[:3, :3]).as_quat())
        moved.append(f"{time - 3:.6f} {' '.join(f'{value:.10f}' for value in row)}")
    (mine / "poses.txt").write_text("\n".join(moved))
    # another sensor, another unit; the other clocks are set back by the same three seconds
    edit(mine, ('format = "tum"', 'format = "tum"\nof = "roof"\nmetres_per_unit = 2'))
    content = (mine / "rig.toml").read_text()
    content = content.replace("times_file", "time_offset_s = -3\ntimes_file").replace(
        "times_from_names", "time_offset_s = -3\ntimes_from_names"
    )
    (mine / "rig.toml").write_text(content)
    again = read(mine).trajectory
    assert again is not None
    assert again.times_s + 3 == pytest.approx(trajectory.times_s, abs=1e-5)
    assert again.vehicle_to_world == pytest.approx(trajectory.vehicle_to_world, abs=1e-6)


def test_poses_of_kitti_in_a_world_with_y_down(mine: Path) -> None:
    reference = read(mine).trajectory
    assert reference is not None
    # x right, y down, z forward of x forward, y left, z up
    turned = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    poses = turned @ reference.vehicle_to_world
    (mine / "kitti.txt").write_text(
        "".join(" ".join(f"{value:.12g}" for value in pose[:3].ravel()) + "\n" for pose in poses)
    )
    (mine / "kitti_times.txt").write_text("".join(f"{time:.6f}\n" for time in reference.times_s))
    poses_table = 'file = "kitti.txt"\nformat = "kitti"\nup = "-y"\ntimes_file = "kitti_times.txt"'
    edit(mine, ('file = "poses.txt"\nformat = "tum" ', poses_table))
    found = read(mine).trajectory
    assert found is not None
    # the same path but for a turn about the vertical axis: heights and tilts agree
    assert found.vehicle_to_world[:, 2] == pytest.approx(reference.vehicle_to_world[:, 2], abs=1e-5)
    between = np.linalg.norm(np.diff(found.vehicle_to_world[:, :3, 3], axis=0), axis=1)
    assert between == pytest.approx(np.linalg.norm(np.diff(reference.vehicle_to_world[:, :3, 3], axis=0), axis=1))


def test_poses_of_nerfstudio(mine: Path) -> None:
    reference = read(mine)
    assert reference.trajectory is not None
    to_vehicle = {camera.name: camera.to_vehicle for camera in reference.cameras}
    expected, frames = {}, []
    for picture in reference.pictures:
        pose = reference.trajectory.at(np.array([picture.time_s]))[0] @ to_vehicle[picture.camera]
        expected[picture.camera, picture.frame] = pose
        # the right camera's last picture has no pose; names of another tool, with another suffix
        if (picture.camera, picture.frame) != ("right", 4):
            name = f"colmap/{picture.camera}/{picture.path.stem}.jpg"
            matrix = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
            frames.append({"file_path": name, "transform_matrix": matrix.tolist()})
    write_json(mine / "transforms.json", {"frames": frames})
    edit(mine, ('file = "poses.txt"\nformat = "tum" ', 'file = "transforms.json"\nformat = "nerfstudio" '))
    found = read(mine)
    assert [(item.frame, item.camera, item.reason) for item in found.skipped] == [(4, "right", "no pose")]
    assert len(found.pictures) == len(reference.pictures) - 1
    for picture in found.pictures:
        assert picture.camera_to_world is not None
        assert picture.camera_to_world == pytest.approx(expected[picture.camera, picture.frame], abs=1e-9)
    times = np.array([picture.time_s for picture in found.pictures if picture.camera == "left"])
    assert found.trajectory is not None
    assert found.trajectory.at(times) == pytest.approx(reference.trajectory.at(times), abs=1e-6)

    frames[0]["file_path"] = frames[0]["file_path"].removeprefix("colmap/left/")
    write_json(mine / "transforms.json", {"frames": frames[:2]})
    with pytest.raises(InputError, match=r"000000\.?\w* fits .*Write more of the folders"):
        write_json(mine / "transforms.json", {"frames": [{**frame, "file_path": "000000.png"} for frame in frames[:1]]})
        read(mine)


def test_a_frame_without_pose_or_scan_is_skipped(mine: Path) -> None:
    lines = (mine / "poses.txt").read_text().splitlines(keepends=True)
    early = [line for line in lines[1:] if float(line.split()[0]) < FIRST_S + 0.33]
    (mine / "poses.txt").write_text("".join(early))
    sorted((mine / "lidar").iterdir())[0].unlink()
    sorted((mine / "lidar").iterdir())[0].unlink()
    recording = read(mine)
    assert [(item.frame, item.camera, item.reason) for item in recording.skipped] == [
        (0, None, "no scan"),
        (4, None, "before the first or after the last pose"),
    ]
    assert sorted({picture.frame for picture in recording.pictures}) == [1, 2, 3]


@pytest.mark.parametrize("holdout", [0, 2])
def test_a_frame_between_scans_is_a_picture_without_lidar(mine: Path, holdout: int, capsys) -> None:
    """A LiDAR of half the cameras' rate: who is held out there gets no scan of its neighbours, which are trained on."""
    scans = sorted((mine / "lidar").iterdir())
    for scan in scans[1::2]:
        scan.unlink()
    convert(options(mine, cameras=("front",), holdout_every=holdout))
    said = " ".join(capsys.readouterr().out.split())
    meta = read_json(mine.parent / "scene" / "transforms.json")
    has_lidar = {
        frame["frame"]: bool(read_distance_png(mine.parent / "scene" / frame["lidar_file_path"]).any())
        for frame in meta["frames"]
    }
    without = {number for number, has in has_lidar.items() if not has}
    assert without == ({1, 3} if holdout else set())
    assert ("No LiDAR point in 2 pictures" in said) is bool(holdout)


@pytest.mark.parametrize(
    ("frames", "every", "advice"),
    [
        (3, 8, "3 frames are too few for --holdout-every 8: use --holdout-every 5."),
        (3, 5, None),
        (3, 0, "Use --holdout-every 5 to hold frames out."),
        (1, 8, "take a longer stretch"),
    ],
)
def test_a_drive_too_short_to_hold_one_out_is_told_how(tmp_path: Path, capsys, frames, every, advice) -> None:
    recording(tmp_path)
    convert(options(tmp_path, output=tmp_path / "scene", frames=frames, holdout_every=every, sweeps=0, strict=False))
    said = " ".join(capsys.readouterr().out.split())
    assert said.count("No frame is held out") == (advice is not None)
    assert advice is None or advice in said


def test_some_cameras_and_some_frames(mine: Path) -> None:
    recording = read(mine, cameras=("front",), first=1, frames=2, stride=2)
    assert [(picture.camera, picture.frame) for picture in recording.pictures] == [("front", 1), ("front", 3)]
    assert [camera.name for camera in recording.cameras] == ["front"]
    assert [sweep.frame for sweep in recording.sweeps] == [None, 1, None, 3, None]


def test_cameras_of_different_rates(mine: Path) -> None:
    """A camera of half the rate is in every other frame."""
    for number in (1, 3):
        (mine / f"images/front/{number:06d}.png").unlink()
    lines = (mine / "times_front.txt").read_text().splitlines()
    (mine / "times_front.txt").write_text("\n".join(lines[::2]))
    frames = {name: [] for name in ("left", "right", "front")}
    for picture in read(mine).pictures:
        frames[picture.camera].append(picture.frame)
    assert frames == {"left": [0, 1, 2, 3, 4], "right": [0, 1, 2, 3, 4], "front": [0, 2, 4]}


def test_times_by_name_and_by_rate(mine: Path) -> None:
    lines = (mine / "times_left.txt").read_text().split()
    named = [f"{number:06d}.png {time}" for number, time in enumerate(lines)]
    (mine / "times_left.txt").write_text("\n".join(reversed(named)))
    edit(mine, ('times_file = "times_right.txt"', f"rate_hz = 10\ntime_offset_s = {FIRST_S}"))
    pictures = read(mine).pictures
    assert {picture.camera for picture in pictures} == {"left", "right", "front"}
    for picture in pictures:
        time_s = FIRST_S + 0.1 * picture.frame
        assert abs(picture.time_s - time_s) < 0.0121


def test_options_bring_masks_and_monocular_maps(mine: Path) -> None:
    for kind in ("moving", "depth"):
        for name, size in (("left", (128, 128)), ("right", (128, 128)), ("front", (96, 128))):
            for frame in range(FRAMES):
                values = np.full(size, 255, np.uint8 if kind == "moving" else np.uint16)
                (mine / kind / name).mkdir(parents=True, exist_ok=True)
                write_png(mine / kind / name / f"{frame:010d}.png", values)
    # they go before what the rig file names
    shutil.copytree(mine / "images/left", mine / "other_masks")
    edit(mine, ("[cameras.left]\n", '[cameras.left]\nmasks = "other_masks"\n'))
    masks = [picture.mask for picture in read(mine).pictures if picture.camera == "left"]
    assert masks[0] == mine / "other_masks/000000.png"
    recording = read(mine, frame_masks=mine / "moving", mono=mine / "depth")
    for picture in recording.pictures:
        assert picture.mask == mine / f"moving/{picture.camera}/{picture.frame:010d}.png"
        assert picture.mono == mine / f"depth/{picture.camera}/{picture.frame:010d}.png"
    (mine / "moving/front/0000000003.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"front/0000000003\.png: no such file; --frame-masks needs one"):
        read(mine, frame_masks=mine / "moving")


def test_a_rendered_drive_brings_its_truth(mine: Path, drive: Path) -> None:
    """As the generator writes it: true distances and clean pictures reach the scene, to evaluate on."""
    shutil.copytree(drive / "truth", mine / "truth")
    for name in ("left", "right", "front"):
        keys = f'truth_distance = "truth/{name}/distance"\ntruth_rgb = "truth/{name}/rgb"\n'
        edit(mine, (f"[cameras.{name}]\n", f"[cameras.{name}]\n{keys}"))
    report = convert(options(mine, frames=2, holdout_every=2), Console(quiet=True))
    for frame in read_json(report.scene / "transforms.json")["frames"]:
        name, number = frame["camera"], frame["frame"]
        for kind, read_map in (("distance", read_distance_png), ("rgb", read_image)):
            found = read_map(report.scene / frame[f"truth_{kind}_file_path"])
            assert np.array_equal(found, read_map(mine / f"truth/{name}/{kind}/{number:06d}.png"))
    eight_bits = mine / "truth/left/distance/000001.png"
    write_png(eight_bits, np.zeros((128, 128), np.uint8))
    with pytest.raises(InputError, match=r"left/distance/000001\.png: expected a 16-bit grey PNG"):
        read(mine)
    eight_bits.unlink()
    with pytest.raises(FileNotFoundError, match=r"000001\.png: no such file; cameras\.left\.truth_distance needs one"):
        read(mine)


def test_maps_of_some_cameras_alone(mine: Path) -> None:
    """All that is taken has them, or nothing; before anything is made."""
    edit(mine, ('mono = "mono/right"\n', ""))
    with pytest.raises(InputError, match=r"rig\.toml: cameras\.right\.mono is missing; give it for every camera"):
        read(mine)
    assert len(read(mine, cameras=("left",)).pictures) == FRAMES


def test_z_depth_maps_in_place_of_lidar(mine: Path, drive: Path) -> None:
    """Millimetres along the axis become distance along the ray, here against the true distances."""
    recording = read(mine)
    for camera in recording.cameras:
        directions, valid = camera.camera.unproject(camera.camera.pixel_centres())
        cosine = np.where(valid.numpy(), directions[..., 2].numpy(), 0)
        for frame in range(FRAMES):
            truth = read_distance_png(drive / f"truth/{camera.name}/distance/{frame:06d}.png")
            counts = np.rint(truth * np.clip(cosine, 0, None) * 1000)
            (mine / "depth" / camera.name).mkdir(parents=True, exist_ok=True)
            write_png(
                mine / f"depth/{camera.name}/{frame:06d}.png", np.where(counts > 65535, 0, counts).astype(np.uint16)
            )
    content = (mine / "rig.toml").read_text()
    content = content[: content.index("[lidars.roof]")]
    for name in ("left", "right", "front"):
        line = f'depth = {{files = "depth/{name}", kind = "z_depth", metres_per_count = 0.001}}\n'
        content = content.replace(f"[cameras.{name}]\n", f"[cameras.{name}]\n{line}")
    (mine / "rig.toml").write_text(content)
    report = convert(options(mine, frames=2, holdout_every=2), Console(quiet=True))
    for name in ("left", "front"):
        distance = read_distance_png(report.scene / f"lidar/{name}/0000000000.png")
        truth = read_distance_png(drive / f"truth/{name}/distance/000000.png")
        both = (distance > 0) & (truth > 0)
        assert both.mean() > 0.3
        # half a millimetre along the axis is some centimetres along a ray that is nearly at right angles to it
        assert np.quantile(np.abs(distance[both] - truth[both]), 0.99) < 0.06
        assert np.median(np.abs(distance[both] - truth[both])) < 0.004


LEFT = '[cameras.left]\nimages = "images/left"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fx = 33.9625035468\n", "", r"rig\.toml: cameras\.left\.fx is missing; expected a number above 0"),
        ("fx = 33.9625035468", "fx = 0", r"cameras\.left\.fx is 0, expected a number above 0"),
        ("fx = 33.9625035468", "fxx = 33.9", r"cameras\.left\.fx is missing.*There is fxx: is fx meant"),
        ("cx = 64.396", "cx = 643.96", r"cameras\.left\.cx is 643\.96, expected a pixel within the picture, 0 to 128"),
        ("width = 128", "width = 128.5", r"cameras\.left\.width is 128\.5, expected a whole number from 1"),
        ("width = 128", "width = 96", r"000000\.png: 128×128 pixels, but its camera's calibration says 96×128"),
        ("k4 = 8e-05", "k5 = 8e-05", r"cameras\.left\.k5: unknown key; known are .*model, .*k4"),
        ("k4 = 8e-05", "xi = 1.2", r"left\.xi: unknown key; a camera of model kannala-brandt has k1, k2, k3, k4"),
        ("k4 = 8e-05", "pixel_centre = 0.25", r"cameras\.left\.pixel_centre is 0\.25, expected one of 0, 0\.5, 1"),
        ('model = "pinhole"', 'model = "fisheye"', r"cameras\.front\.model is 'fisheye', expected one of 'mei'"),
        ("xi = 1.2", "xi = -1.2", r"cameras\.right\.model: MEI camera: xi is -1\.2, expected more than -1"),
        ('times_file = "times_left.txt"', "", r"cameras\.left\.times_file: expected one of .*found none"),
        ('times_file = "times_left.txt"', 'times_file = "t"\nrate_hz = 10', "found times_file and rate_hz"),
        ('time_unit = "ns"', 'time_unit = "minutes"', r"lidars\.roof\.time_unit is 'minutes'"),
        ("timestamp =", "time_stamp =", r"lidars\.roof\.time_stamp: unknown key; Is timestamp meant"),
        ('timestamp = "start"', "", r"lidars\.roof\.timestamp is missing; expected one of 'start', 'middle', 'end'"),
        ("turn_s = 0.1", "", r"lidars\.roof\.turn_s is missing; timestamp needs it"),
        ("turn_s = 0.1", 'turn_s = 0.1\ndirection = "clockwise"', r"roof\.direction: points with times of their"),
        ('column = "t", unit', 'column = "t", units', r"lidars\.roof\.point_times\.units: unknown key; Is unit meant"),
        ("-0.9902680687", "0.9902680687", r"cameras\.left\.to_vehicle: not a rotation and a translation"),
        ("[0.0, -0.9902680687, -0.139173101, 1.07],", "", r"left\.to_vehicle: not a rotation and a translation"),
        ("quaternion = [0.0, 0.0,", "quaternion = [0.0, 1.0,", r"roof\.to_vehicle: the quaternion .* length 1\.41"),
        ("translation = [0.8, 0.02, 0.84]", "translation = [0.8]", r"translation is \[0\.8\], expected 3 num"),
        ('format = "tum"', 'format = "tum"\nrate_hz = 10', r"poses\.rate_hz: unknown key; poses of format tum bring"),
        ('format = "tum"', 'format = "tum2"', r"poses\.format is 'tum2', expected one of 'tum', 'kitti'"),
        ('format = "tum"', 'format = "tum"\nof = "roo"', r"poses\.of is 'roo', expected one of 'vehicle', 'left'"),
        ("[poses]", "[pose]", r"rig\.toml: pose: unknown key; Is poses meant\?"),
        ("[lidars.roof]", "[lidars.left]", "left is the name of both a camera and a scanner"),
        ("[cameras.left]", "[cameras.'a/b']", r"cameras\.a/b: a sensor's name is letters"),
        ("[poses]", "[poses", r"rig\.toml: not valid TOML \(.*line 1"),
        ('"images/left"', '"images/lift"', r"images/lift: no such folder; it is named in the rig file"),
        ('"images/left"', '"images/left/*.jpeg"', r"\*\.jpeg: no file has such a name"),
        ('scans = "lidar"', 'scans = "images/front"', r"front: files of unknown format, such as 000000\.png.*\.pcd"),
        ('"start"', '"start"\ncorrected_to = "end"', r"roof\.point_times: points that .*already .*need no times"),
        (
            'turn_s = 0.1\ntimestamp = "start"\n' + TIMES,
            'corrected_to = "middle"',
            r"lidars\.roof\.turn_s is missing; corrected_to = 'middle' needs it",
        ),
        ('timestamp = "start"', 'timestamp = "start"\npoints_in = "world"', r"points_in is 'world', expected one of"),
        ('column = "t"', 'column = "time"', r"\.pcd: has no column time, only x, y, z, intensity, t"),
        (
            LEFT,
            LEFT + '\ndepth = {files = "mono/left", kind = "z_depth", metres_per_count = 0.001}',
            r"depth maps take the place of LiDAR; give one of them, not both\.",
        ),
    ],
)
def test_a_wrong_rig_file_is_named(mine: Path, old: str, new: str, message: str) -> None:
    # without the page's comments, so that whole lines can be exchanged
    (mine / "rig.toml").write_text(re.sub(r" +# [^\n]*", "", (mine / "rig.toml").read_text()))
    with pytest.raises((InputError, FileNotFoundError), match=message):
        read_rig_recording(options(edit(mine, (old, new))))


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "times_*.txt",
            lambda path: path.write_text("".join(f"{float(line) - 1e9:.6f}\n" for line in path.read_text().split())),
            r"times of left and roof do not overlap: left has 369730762\.123 to 369730762\.523 s, roof 1369730762\.073",
        ),
        ("poses.txt", b"5 0 0 0 0 0 0 1\n6 0 0 0 0 0 0 1\n", "left and the poses do not"),
        ("poses.txt", b"5 0 0 0 0 0 0 1\n", r"poses\.txt: 1 pose, expected at least two"),
        ("poses.txt", None, r"poses\.txt: no such file"),
        ("times_left.txt", b"1\n2\n", "times_left.txt: 2 times, but .*left has 5 files"),
        ("times_left.txt", b"1\n1\n1\n1\n1\n", r"000001\.png and 000000\.png have the same time, 1\.0"),
        ("images/left/000002.png", b"no", r"left/000002\.png: not a PNG"),
        ("mono/left/000002.png", None, r"mono/left/000002\.png: no such file; cameras\.left\.mono"),
        (
            *("lidar/*", lambda path: path.write_bytes(re.sub(rb"(WIDTH|POINTS) \d+", rb"\1 0", path.read_bytes()))),
            r"\.pcd: a scan without points",
        ),
        (
            *("lidar/*", lambda path: path.rename(path.with_stem(f"{path.stem[:10]}_{path.stem[-9:]}"))),
            r"lidar/1369730762_.*: its name seems to have seconds and nanoseconds apart",
        ),
        ("masks/left.png", None, r"masks/left\.png: no such file"),
        ("masks/front.png", lambda path: shutil.copy(path.with_name("left.png"), path), r"front\.png: 128×128 pixels"),
        ("rig.json", b"{}", "found rig.toml and rig.json"),
        ("rig.toml", None, "expected rig.toml or rig.json in it, found neither"),
    ],
)
def test_a_wrong_recording_is_named(mine: Path, file: str, change: Change, message: str) -> None:
    spoil(mine, file, change)
    with pytest.raises((InputError, FileNotFoundError), match=message):
        read(mine)


def test_a_scan_of_nan_is_an_error_when_it_is_read(mine: Path) -> None:
    path = sorted((mine / "lidar").iterdir())[1]
    head, _, points = path.read_bytes().partition(b"DATA binary\n")
    nothing = struct.pack("<ffffI", math.nan, math.nan, math.nan, 0, 0)
    path.write_bytes(head + b"DATA binary\n" + nothing * (len(points) // len(nothing)))
    with pytest.raises(InputError, match=rf"{path.name}: none of its \d+ points can be used"):
        convert(options(mine, cameras=("front",), frames=2, sweeps=0), Console(quiet=True))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": ("middle",)}, r"--cameras middle: .* no such camera, only left, right, front"),
        ({"first": 9}, "--first 9: reaches frame 9, but the recording has frames 0 to 4"),
        ({"root": Path("nowhere")}, "nowhere: no such folder"),
        ({"rig": Path("nowhere.toml")}, r"nowhere\.toml: no such file"),
    ],
)
def test_wrong_options_are_named(mine: Path, changes: dict, message: str) -> None:
    with pytest.raises((InputError, FileNotFoundError), match=message):
        read_rig_recording(replace(options(mine), **changes))


def test_without_poses_it_says_what_to_do(mine: Path) -> None:
    content = (mine / "rig.toml").read_text()
    (mine / "rig.toml").write_text(content[content.index("[cameras.left]") :])
    with pytest.raises(InputError, match=r"has no table \[poses\].*--poses colmap"):
        read(mine)
    recording = read(mine, poses="colmap")
    assert recording.trajectory is None and len(recording.pictures) == 15


def test_jpegs_and_patterns(mine: Path) -> None:
    import cv2

    for path in sorted((mine / "images/front").iterdir()):
        cv2.imwrite(str(mine / f"front_{int(path.stem)}.jpg"), read_image(path)[..., ::-1])
    edit(mine, ('images = "images/front"', 'images = "*front_*.jpg"'), ('mono = "mono/front"\n', ""))
    (mine / "._front_0.jpg").write_bytes(b"of macOS")
    recording = read(mine, cameras=("front",))
    assert [picture.path.name for picture in recording.pictures] == [f"front_{number}.jpg" for number in range(FRAMES)]
    (mine / "front_3.jpg").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=r"front_3\.jpg: cannot be decoded as a picture"):
        read(mine, cameras=("front",))
