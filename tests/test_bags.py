"""Bags of each form become recordings whose LiDAR lies where it is; and whatever a bag lacks, or has wrong, is said."""

import io
import math
import re
import shutil
import struct
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bags
import cv2
import data_sets
import numpy as np
import pytest
from backports import zstd
from numpy.typing import NDArray
from rich.console import Console
from scenes import tree
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.process.bags import command, lenses, pictures, scans, survey
from edge_depth_nerf.process.bags.bag import Topic
from edge_depth_nerf.process.bags.command import todo_lines, unpack
from edge_depth_nerf.process.bags.frames import by_satellite
from edge_depth_nerf.process.bags.options import UnpackOptions
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.poses import read_tum
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.process.rig_file import read_rig

QUIET = Console(quiet=True)


def run(bag: Path, output: Path | None, **options: Any) -> str:
    """Unpack, and give what was said."""
    console = Console(width=400, record=True, quiet=False, file=io.StringIO())
    unpack(UnpackOptions(bag, output, **options), console)
    return console.export_text()


@pytest.fixture(scope="module", params=bags.FORMS)
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A bag of each form, and the recording that it becomes."""
    folder = tmp_path_factory.mktemp(request.param)
    bag = bags.write_bag(folder, request.param, list(bags.hall()))
    run(bag, folder / "recording")
    return bag, folder / "recording"


@pytest.mark.slow
@pytest.mark.parametrize("whole", ["mcap"], indirect=True)
def test_lidar_lies_on_the_walls(whole: tuple[Path, Path], tmp_path: Path) -> None:
    """Pictures, calibration, mountings, poses and the points' own times together."""
    options = RigOptions(root=whole[1], output=tmp_path / "scene", find_ego=False, sky=False, strict=True)
    report = convert(replace(options, refine_poses=False), QUIET)
    assert (report.training, report.held_out) == (10, 2)
    assert not any("points of a scan get one time" in notice for notice in report.notices)
    data_sets.check_walls(report.scene, {"front": "front", "side": "side"})


def test_what_is_written(whole: tuple[Path, Path]) -> None:
    recording = whole[1]
    for name, suffix, most in (("front", ".png", 0), ("side", ".jpg", 20)):
        for number in range(data_sets.FRAMES):
            stamp = bags.stamp_ns(data_sets.camera_time(name, number))
            found = read_image(recording / f"images/{name}/{stamp}{suffix}").astype(int)
            assert np.abs(found - data_sets.picture(name, number)).max() <= most
    start_s = 2 * data_sets.INTERVAL_S - 0.05
    points, offsets = data_sets.turn(start_s)
    table = np.load(recording / f"lidar/lidar/{bags.stamp_ns(start_s)}.npy")
    assert table.dtype.names == ("x", "y", "z", "intensity", "t") and len(table) == len(points)
    np.testing.assert_allclose(np.stack([table[axis] for axis in "xyz"], -1), points, atol=1e-5)
    np.testing.assert_allclose(table["t"], offsets, atol=1e-8)
    times, poses, _ = read_tum(recording / "poses.txt")
    np.testing.assert_allclose(times[0], bags.stamp_ns(-0.2) / 1e9, atol=1e-6)
    for time, pose in zip(times, poses, strict=True):
        np.testing.assert_allclose(pose, bags.world(time - bags.FIRST_NS / 1e9), atol=1e-5)
    rig = read_rig(recording / "rig.toml", recording)
    sensors = {sensor.name: sensor.to_vehicle for sensor in (*rig.cameras, *rig.lidars)}
    for name, theirs in (("front", "front"), ("side", "side"), ("lidar", "scanner")):
        np.testing.assert_allclose(sensors[name], data_sets.to_vehicle(theirs), atol=1e-9)
    assert not todo_lines(recording)


@pytest.mark.parametrize("whole", ["bag"], indirect=True)
def test_topics_are_listed_and_nothing_is_written(whole: tuple[Path, Path]) -> None:
    bag, recording = whole
    before = tree(bag.parent)
    said = run(bag, None, list=True)
    lines = {line.split("│")[0].strip(): [part.strip() for part in line.split("│")[1:]] for line in said.splitlines()}
    assert lines["/front/image_raw"] == ["sensor_msgs/Image", "6", "5.1", "pictures of front"]
    assert lines["/side/image_raw/compressed"][-1] == "pictures of side"
    assert lines["/lidar/points"][-1] == "scans of lidar"
    assert lines["/front/camera_info"][-1] == "calibration of front"
    assert lines["/tf_static"] == ["tf2_msgs/TFMessage", "1", "", "mountings"]
    assert lines["/odometry"][1:] == ["50", "50.0", "poses"]
    assert lines["/rosout"][-1] == "nothing"
    assert "points have times: t, in ns from the scan's stamp" in said
    assert tree(bag.parent) == before and recording.is_dir()


@pytest.mark.parametrize("whole", ["db3"], indirect=True)
def test_an_interrupted_run_is_continued(whole: tuple[Path, Path], tmp_path: Path, monkeypatch: Any) -> None:
    bag, recording = whole
    output = tmp_path / "recording"
    write, calls = np.save, []

    def interrupted(path: Path, table: NDArray) -> None:
        calls.append(path)
        if len(calls) > 3:
            raise KeyboardInterrupt
        write(path, table)

    monkeypatch.setattr(command.np, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run(bag, output)
    monkeypatch.undo()
    there = {path: path.stat().st_mtime_ns for path in output.rglob("*.npy")}
    assert 0 < len(there) < data_sets.FRAMES and not (output / "rig.toml").exists()
    run(bag, output)
    assert tree(output) == tree(recording)
    assert all(path.stat().st_mtime_ns == time for path, time in there.items())
    # what is complete stays, also what was corrected in it
    (output / "rig.toml").write_text("mine")
    assert "is complete" in run(bag, output)
    assert (output / "rig.toml").read_text() == "mine"


@pytest.mark.parametrize("whole", ["mcap"], indirect=True)
def test_a_part_of_a_bag(whole: tuple[Path, Path], tmp_path: Path) -> None:
    """The bag begins 0.2 s before the first picture."""
    run(whole[0], tmp_path / "part", start_s=0.3, seconds=0.25)
    assert len(list((tmp_path / "part/images/front").iterdir())) == 3
    # with poses that were recorded before and after
    assert len(read_tum(tmp_path / "part/poses.txt")[0]) == 50
    with pytest.raises(InputError, match=r"--start-s 9: .* ends 0\.98 s after its start"):
        run(whole[0], tmp_path / "none", start_s=9.0)


def test_what_was_not_found_is_asked_for(tmp_path: Path) -> None:
    said = list(bags.hall(poses=False, calibrated=False, mounted=False, timed=False))
    recording = tmp_path / "recording"
    run(bags.write_bag(tmp_path, "mcap", said), recording)
    text = (recording / "rig.toml").read_text()
    assert "--poses lidar" in text and "[poses]\n" not in text
    lines = todo_lines(recording)
    assert len(lines) == 2 * 6 + 1
    first = text.splitlines()[lines[0] - 1]
    assert first == 'model = "TODO: mei, kannala-brandt or pinhole"'
    options = RigOptions(root=recording, output=tmp_path / "scene", poses="lidar")
    with pytest.raises(InputError) as refused:
        read_rig_recording(options)
    assert str(refused.value).startswith(
        f"{recording}/rig.toml, line {lines[0]}: cameras.front.model is a TODO; write there what it asks for: "
        f"mei, kannala-brandt or pinhole. TODO stands in lines {', '.join(map(str, lines[1:]))}, too."
    )
    # the scanner is the vehicle, where nothing else is known
    values = {"fx": "50.0", "fy": "50.0", "cx": "47.0", "cy": "31.5", "model": '"pinhole"'}
    identity = "[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]"
    values |= {"direction": '"clockwise"', "to_vehicle": identity}
    named = [(line, line.split(" = ")[0]) for line in text.splitlines()]
    filled = [f"{name} = {values[name]}" if '"TODO' in line else line for line, name in named]
    # the driver stamps the start
    (recording / "rig.toml").write_text("\n".join(filled).replace('timestamp = "end"', 'timestamp = "start"'))
    found = read_rig_recording(options)
    assert len(found.pictures) == 12 and found.sweeps[0].timing is not None
    np.testing.assert_array_equal(found.sweeps[0].to_vehicle, np.eye(4))


@pytest.mark.parametrize("source", ["pose", "covariance", "transform", "tf", "gps"])
def test_poses_of_each_kind(tmp_path: Path, source: str) -> None:
    said = [each for each in bags.hall(poses=False) if "lidar" not in each.topic]
    for step in range(-10, 40):
        said += list(pose_messages(source, step * 0.02))
    text = run(bags.write_bag(tmp_path, "db3", said), tmp_path / "recording", vehicle="base_link")
    assert "left out" not in text
    times, poses, _ = read_tum(tmp_path / "recording/poses.txt")
    # the origin of fixes is the antenna's first one
    origin = (bags.world(-0.2) @ ANTENNA)[:3, 3] if source == "gps" else np.zeros(3)
    assert len(times) >= 49
    for time, pose in zip(times, poses, strict=True):
        expected = bags.world(time - bags.FIRST_NS / 1e9)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], atol=1e-4)
        np.testing.assert_allclose(pose[:3, 3], expected[:3, 3] - origin, atol=2e-3)


def test_fixes_a_second_apart_have_poses_between_them(tmp_path: Path) -> None:
    """The vehicle turns with 1 Hz while fixes come each second, with some milliseconds of delay, and then stop."""
    seconds = np.arange(0, 9, 0.01)
    angle = 0.25 * np.sin(2 * np.pi * seconds)
    fixes = [(number + 0.002 * (number % 2), 49 + number * 1e-4, 8.4, 115) for number in (0, 1, 2, 3, 4, 8)]
    turns = np.column_stack((seconds, Rotation.from_euler("z", angle[:, None]).as_quat()))
    times_s, poses = by_satellite(np.array(fixes), turns, np.eye(4), np.eye(4))
    # none where fixes are missing for 4 s
    assert times_s[-1] == 4 and np.diff(times_s).max() < 0.011
    found = Rotation.from_matrix(poses[:, :3, :3]).as_euler("zyx")[:, 0]
    np.testing.assert_allclose(found, 0.25 * np.sin(2 * np.pi * times_s), atol=1e-3)
    metres_a_second = poses[-1, 1, 3] / 4
    assert 11.1 < metres_a_second < 11.2
    np.testing.assert_allclose(poses[:, 1, 3], metres_a_second * times_s, atol=0.05)
    assert len(by_satellite(np.array(fixes)[:1], turns, np.eye(4), np.eye(4))[0]) == 0


def test_the_first_source_that_has_poses_is_taken(tmp_path: Path) -> None:
    """/tf repeats the mountings, as ROS 1 publishes them, and no vehicle's pose."""
    said = [each for each in bags.hall(poses=False, mounted=False) if "lidar" not in each.topic]
    for step in range(-10, 40):
        said += [each for each in pose_messages("gps", step * 0.02) if each.topic != "/more/tf_static"]
    both = [bags.transform(0, "base_link", "gps", ANTENNA), bags.transform(0, "base_link", "imu", TURNED)]
    mounted = [*bags.mountings().fields["transforms"], *both]
    for seconds in (-0.1, 0.3):
        sent = [{**each, "header": bags.header(seconds, each["header"]["frame_id"])} for each in mounted]
        said.append(bags.Said("/tf", "tf2_msgs/msg/TFMessage", seconds, {"transforms": sent}))
    bag = bags.write_bag(tmp_path, "bag", said)
    listed = {
        line.split("│")[0].strip(): line.split("│")[-1].strip() for line in run(bag, None, list=True).splitlines()
    }
    assert listed["/tf"] == "poses, mountings, where nothing moves"
    assert listed["/fix"] == listed["/imu"] == "poses, if /tf has none; --poses chooses"
    text = run(bag, tmp_path / "recording")
    assert "/tf: has 0 poses of base_link; at least two are needed." in text
    times, poses, _ = read_tum(tmp_path / "recording/poses.txt")
    expected = np.array([bags.world(time - bags.FIRST_NS / 1e9) for time in times])
    np.testing.assert_allclose(poses[:, :3, :3], expected[:, :3, :3], atol=1e-4)
    assert "by /fix and /imu" in (tmp_path / "recording/rig.toml").read_text()


EARTH = (6378137.0, 6.69437999014e-3)
LATITUDE, LONGITUDE, ALTITUDE = 49.0, 8.4, 115.0


def pose_messages(source: str, seconds: float) -> Any:
    pose, head = bags.world(seconds), bags.header(seconds, "map")
    if source == "tf":
        # the map's origin drifts away from the odometry's, which comes half as often; the vehicle is in between
        drift = data_sets.rigid(Rotation.from_euler("z", 0.1 * seconds), [3.0, 2 * seconds, 0])
        moved = [bags.transform(seconds, "odom", "base_footprint", np.linalg.inv(drift) @ pose @ np.linalg.inv(UP))]
        if round(seconds / 0.02) % 2 == 0 or seconds > 0.75:
            moved.append(bags.transform(seconds, "map", "odom", drift))
        moved.append(bags.transform(seconds, "base_footprint", "base_link", UP))
        yield bags.Said("/tf", "tf2_msgs/msg/TFMessage", seconds, {"transforms": moved})
    elif source == "gps":
        # the antenna is beside the vehicle's origin, the IMU is turned
        antenna = pose @ ANTENNA
        if seconds == -0.2:
            both = [bags.transform(0, "base_link", "gps", ANTENNA), bags.transform(0, "base_link", "imu", TURNED)]
            yield bags.Said("/more/tf_static", "tf2_msgs/msg/TFMessage", seconds - 0.01, {"transforms": both})
        east, north, up = antenna[:3, 3] - data_sets.OFF
        sine = math.sin(math.radians(LATITUDE))
        radius = EARTH[0] / math.sqrt(1 - EARTH[1] * sine**2)
        meridian = radius * (1 - EARTH[1]) / (1 - EARTH[1] * sine**2)
        latitude = LATITUDE + math.degrees(north / (meridian + ALTITUDE))
        longitude = LONGITUDE + math.degrees(east / ((radius + ALTITUDE) * math.cos(math.radians(LATITUDE))))
        fix = {"header": bags.header(seconds, "gps"), "altitude": ALTITUDE + up}
        fix |= {"latitude": latitude, "longitude": longitude}
        yield bags.Said("/fix", "sensor_msgs/msg/NavSatFix", seconds, fix)
        turn = {"header": bags.header(seconds, "imu"), "orientation": bags.xyzw((pose @ TURNED)[:3, :3])}
        yield bags.Said("/imu", "sensor_msgs/msg/Imu", seconds, turn)
    else:
        inner = {"position": bags.xyz(pose[:3, 3]), "orientation": bags.xyzw(pose[:3, :3])}
        kinds: dict[str, tuple[str, dict[str, Any]]] = {
            "pose": ("PoseStamped", {"header": head, "pose": inner}),
            "covariance": ("PoseWithCovarianceStamped", {"header": head, "pose": {"pose": inner}}),
            "transform": ("TransformStamped", bags.transform(seconds, "map", "base_link", pose)),
        }
        name, fields = kinds[source]
        yield bags.Said("/where", f"geometry_msgs/msg/{name}", seconds, fields)


UP = data_sets.rigid(Rotation.identity(), [0, 0, 0.3])
ANTENNA = data_sets.rigid(Rotation.identity(), [0.4, 0.1, 1.5])
TURNED = data_sets.rigid(Rotation.from_euler("z", 90, degrees=True), [0.2, 0, 0.5])


def test_a_truncated_bag(whole: tuple[Path, Path], tmp_path: Path) -> None:
    bag = Path((shutil.copytree if whole[0].is_dir() else shutil.copy)(whole[0], tmp_path / whole[0].name))
    file = next(path for path in (bag, *bag.rglob("*")) if path.suffix in (".bag", ".db3", ".mcap") and path.is_file())
    for content, said in ((file.read_bytes()[: file.stat().st_size // 2], "truncated or damaged"), (b"", "is empty")):
        file.write_bytes(content)
        with pytest.raises(InputError, match=said):
            run(bag, tmp_path / "recording")
    assert not (tmp_path / "recording").exists()


def test_bags_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"drive\.bag: no such file or folder"):
        run(tmp_path / "drive.bag", tmp_path / "recording")
    (tmp_path / "drive.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(InputError, match=r"is no ROS bag.*rosbag reindex"):
        run(tmp_path / "drive.bag.active", tmp_path / "recording")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"folder: is no ROS bag; expected a file \.bag, \.mcap, \.db3"):
        run(tmp_path / "folder", tmp_path / "recording")
    bag = bags.write_bag(tmp_path / "two", "bag", list(bags.hall()))
    (tmp_path / "two/drive.mcap").write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(InputError, match="bags of different kinds"):
        run(bag.parent, tmp_path / "recording")
    (tmp_path / "two/drive.mcap").write_bytes(b"\x89MCAP0\r\n\x01" + struct.pack("<QI4sI", 12, 4, b"ros1", 0))
    with pytest.raises(InputError, match=r"drive\.mcap: is an MCAP file of ROS 1\. Give the \.bag"):
        run(tmp_path / "two/drive.mcap", tmp_path / "recording")
    bag = bags.write_bag(tmp_path / "log", "db3", list(bags.hall()))
    next(bag.glob("*.db3")).with_name(f"{next(bag.glob('*.db3')).name}-wal").write_bytes(b"more")
    with pytest.raises(InputError, match="PRAGMA wal_checkpoint"):
        run(bag, tmp_path / "recording")


@pytest.mark.parametrize("whole", ["mcap"], indirect=True)
def test_folders_of_other_names_and_compressed_files(whole: tuple[Path, Path], tmp_path: Path) -> None:
    bag = shutil.copytree(whole[0], tmp_path / "drive.bag")
    expected = run(whole[0], None, list=True).splitlines()[1:]
    assert "pictures of front" in "".join(expected)
    assert run(bag, None, list=True).splitlines()[1:] == expected
    (file,) = bag.glob("*.mcap")
    file.with_name(f"{file.name}.zstd").write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    metadata = (bag / "metadata.yaml").read_text().replace(f"- {file.name}", f"- {file.name}.zstd")
    metadata = re.sub("compression_format: .*", "compression_format: zstd", metadata)
    (bag / "metadata.yaml").write_text(re.sub("compression_mode: .*", "compression_mode: FILE", metadata))
    assert run(bag, None, list=True).splitlines()[1:] == expected


def test_bags_without_pictures_and_with_unknown_types(tmp_path: Path) -> None:
    said = [each for each in bags.hall() if "Image" not in each.type]
    said.append(bags.Said("/mine", "my_msgs/msg/Mine", 0.0, {"data": 3}))
    bag = bags.write_bag(tmp_path, "bag", said, {"my_msgs/msg/Mine": "int32 data"})
    text = run(bag, None, list=True)
    assert "nothing: of a type that is not known" in text and "my_msgs/Mine" in text
    with pytest.raises(InputError, match=r"drive\.bag: has no pictures that can be read\. .*/mine: nothing: of a type"):
        run(bag, tmp_path / "recording")
    with pytest.raises(InputError, match=r"--topics /mine: messages of type my_msgs/msg/Mine cannot be read"):
        run(bag, tmp_path / "recording", topics=("/mine",))
    with pytest.raises(InputError, match=r"--poses /nothing: .* has no such topic; --list shows"):
        run(bag, tmp_path / "recording", poses="/nothing")
    with pytest.raises(InputError, match=r"--poses /rosout: expected a topic with poses"):
        run(bag, tmp_path / "recording", poses="/rosout")


@pytest.mark.parametrize("whole", ["bag"], indirect=True)
def test_folders_that_hold_something_else(whole: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other/thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"holds something else \(thesis\.tex\)"):
        run(whole[0], tmp_path / "other")
    with pytest.raises(InputError, match=r"holds other unpacked bags \(options differs\)"):
        run(whole[0], whole[1], seconds=0.5)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="is a file"):
        run(whole[0], tmp_path / "file")


@pytest.mark.parametrize("whole", ["mcap"], indirect=True)
def test_without_rosbags(whole: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.interfaces", None)
    with pytest.raises(InputError, match=r"needs rosbags, which is not installed\. Run `pip install '\.\[bags\]'`"):
        run(whole[0], tmp_path / "recording")


def test_options_out_of_range() -> None:
    for options, said in (
        (UnpackOptions(Path("a.bag")), "--output: is not set"),
        (UnpackOptions(Path("a.bag"), Path("b"), start_s=-1.0), "--start-s -1"),
        (UnpackOptions(Path("a.bag"), Path("b"), seconds=0.0), "--seconds 0"),
    ):
        with pytest.raises(InputError, match=said):
            options.check()


def test_broken_messages_are_left_out_and_many_of_them_refused(tmp_path: Path) -> None:
    said = list(bags.hall())
    pictures_ = [index for index, each in enumerate(said) if each.topic == "/front/image_raw"]
    said[pictures_[2]] = replace(said[pictures_[2]], fields={**said[pictures_[2]].fields, "data": np.zeros(10)})
    # the same stamp twice, and a quaternion that is none
    said.append(replace(said[pictures_[3]], seconds=said[pictures_[3]].seconds + 0.001))
    said[-2] = replace(said[-2], fields={**said[-2].fields, "pose": {"pose": {}}})
    text = run(bags.write_bag(tmp_path / "one", "bag", said), tmp_path / "recording")
    assert "/front/image_raw: left out 1 broken messages; the first has 10 bytes with a step of 293" in text
    assert "/front/image_raw: left out 1 messages with the stamp of an earlier one" in text
    assert "/odometry: left out 1 messages without a pose" in text
    for index in pictures_[3:]:
        said[index] = replace(said[index], fields={**said[index].fields, "data": np.zeros(10)})
    with pytest.raises(InputError, match=r"4 of the 6 messages of /front/image_raw are broken"):
        run(bags.write_bag(tmp_path / "many", "bag", said), tmp_path / "another")


def test_messages_without_stamp_get_the_time_of_their_recording(tmp_path: Path) -> None:
    said = list(bags.hall())
    for index, each in enumerate(said):
        if each.topic == "/front/image_raw":
            said[index] = replace(each, fields={**each.fields, "header": {"frame_id": "front_optical_frame"}})
    text = run(bags.write_bag(tmp_path, "mcap", said), tmp_path / "recording")
    assert "/front/image_raw: 6 messages have no stamp" in text
    expected = bags.stamp_ns(data_sets.camera_time("front", 0)) + bags.LATE_NS
    assert (tmp_path / f"recording/images/front/{expected}.png").is_file()


def test_one_topic_of_each_camera_and_scanner(tmp_path: Path) -> None:
    said = list(bags.hall())
    for number in range(data_sets.FRAMES):
        again = bags.image("front", number, data_sets.picture("front", number), compressed=True)
        said += [again, replace(again, topic="/front/image_rect_color")]
        points, _ = data_sets.turn(number * 0.1)
        said.append(bags.cloud(number * 0.1, points[:100], None, topic="/lidar/filtered"))
    said.append(bags.cloud(0.0, data_sets.turn(0.0)[0], None, topic="/map"))
    depth = {"header": bags.header(0, "d"), "height": 2, "width": 2, "step": 4, "encoding": "16UC1", "data": [0] * 8}
    said.append(bags.Said("/depth/image_raw", "sensor_msgs/msg/Image", 0.0, depth))
    bag = bags.write_bag(tmp_path, "db3", said)
    text = run(bag, None, list=True)
    for topic, taken in (
        ("/front/image_raw", "pictures of front"),
        ("/front/image_raw/compressed", "nothing: the same camera as /front/image_raw; --topics chooses"),
        ("/front/image_rect_color", "nothing: the same camera as /front/image_raw; --topics chooses"),
        ("/lidar/filtered", "nothing: the same scanner as /lidar/points; --topics chooses"),
        ("/map", "nothing: a single cloud, not scans"),
        ("/depth/image_raw", "nothing: depth pictures, which are not unpacked"),
    ):
        (line,) = [line for line in text.splitlines() if line.split("│")[0].strip() == topic]
        assert line.split("│")[-1].strip() == taken
    run(bag, tmp_path / "recording", topics=("/front/image_raw/compressed", "/lidar/filtered"))
    assert todo_lines(tmp_path / "recording") and "direction" in (tmp_path / "recording/rig.toml").read_text()
    assert {path.name for path in (tmp_path / "recording/images").iterdir()} == {"front"}
    assert {path.suffix for path in (tmp_path / "recording/images/front").iterdir()} == {".jpg"}


def test_a_stereo_pair_with_one_frame(tmp_path: Path) -> None:
    """ROS's rectified pairs have the left camera's frame; the right one's place is in its P."""
    said = [bags.mountings(), *(bags.odometry(step * 0.02) for step in range(-10, 40))]
    for side, column in (("left", 0.0), ("right", -data_sets.FOCAL * 0.5)):
        for number in range(data_sets.FRAMES):
            picture = bags.image("front", number, data_sets.picture("front", number), compressed=False)
            said.append(replace(picture, topic=f"/stereo/{side}/image_rect"))
        made = bags.camera_info("front", 0.0)
        projection = np.array(made.fields["p"], float)
        projection[3] = column
        said.append(replace(made, topic=f"/stereo/{side}/camera_info", fields={**made.fields, "p": projection}))
    run(bags.write_bag(tmp_path, "mcap", said), tmp_path / "recording")
    rig = read_rig(tmp_path / "recording/rig.toml", tmp_path / "recording")
    left, right = (next(each.to_vehicle for each in rig.cameras if each.name == name) for name in ("left", "right"))
    np.testing.assert_allclose(left, data_sets.to_vehicle("front"), atol=1e-9)
    np.testing.assert_allclose(
        np.linalg.inv(left) @ right, data_sets.rigid(Rotation.identity(), [0.5, 0, 0]), atol=1e-9
    )
    assert "# 0.5 m from the origin of its frame, by P" in (tmp_path / "recording/rig.toml").read_text()


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        *((f"/left/{name}", True) for name in ("image_rect", "image_rect_color", "rectified/image", "rect/compressed")),
        *((f"/{name}/image_raw", False) for name in ("camera_direct", "rectangle", "correct")),
    ],
)
def test_which_topics_are_rectified(topic: str, rectified: bool) -> None:
    assert survey._rectified(Topic(topic, survey.IMAGE, 1, 0.0, True)) is rectified


def test_a_bright_street_after_a_dark_garage(tmp_path: Path) -> None:
    """Pictures of 12 bits are as bright as others, even if the first ones use fewer; what is beyond them is told."""
    said = []
    for number in range(24):
        table = np.full((4, 6), 900 if number < 8 else 3000 if number < 23 else 5000, np.uint16)
        head = {"header": bags.header(number * 0.1, "c"), "height": 4, "width": 6, "step": 12, "encoding": "mono16"}
        said.append(bags.Said("/c", survey.IMAGE, number * 0.1, {**head, "data": table.view(np.uint8).ravel()}))
    text = run(bags.write_bag(tmp_path, "mcap", said), tmp_path / "recording")
    assert "/c: 1 pictures are white where they use more than 12 bits." in text
    found = [read_image(path).max() for path in sorted((tmp_path / "recording/images/c").iterdir())]
    assert found == [900 >> 4] * 8 + [3000 >> 4] * 15 + [255]


def test_livox(tmp_path: Path) -> None:
    """Its own message, whose definition is in the bag."""
    types = {
        "livox_ros_driver2/msg/CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity",
        "livox_ros_driver2/msg/CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\n"
        "livox_ros_driver2/CustomPoint[] points",
    }
    said = [each for each in bags.hall() if each.topic != "/lidar/points"]
    points, offsets = data_sets.turn(0.05)
    points, offsets = points[::7], offsets[::7]
    inner = [
        {"offset_time": round(offset * 1e9), **bags.xyz(point), "reflectivity": 9}
        for point, offset in zip(points, offsets, strict=True)
    ]
    for start_s in (-0.05, 0.05, 0.15):
        fields = {"header": bags.header(start_s, "lidar_link"), "points": inner}
        said.append(bags.Said("/livox/lidar", "livox_ros_driver2/msg/CustomMsg", start_s, fields))
    run(bags.write_bag(tmp_path, "bag", said, types), tmp_path / "recording")
    table = np.load(tmp_path / f"recording/lidar/lidar/{bags.stamp_ns(0.05)}.npy")
    np.testing.assert_allclose(table["t"], offsets, atol=1e-8)
    np.testing.assert_allclose(table["x"], points[:, 0], atol=1e-5)
    assert (table["intensity"] == 9).all()


def smooth(height: int = 24, width: int = 32) -> NDArray[np.uint8]:
    row, column = np.mgrid[:height, :width]
    return np.stack((40 + 4 * column, 200 - 3 * row, 60 + 2 * row + 2 * column), -1).astype(np.uint8)


def message(encoding: str, table: NDArray, *, big: bool = False, padding: int = 6) -> Any:
    """A message whose rows are padded; `table` has rows of numbers."""
    wide = table.astype(table.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(wide).view(np.uint8).reshape(len(table), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    height = len(table) * 2 // 3 if encoding.startswith("nv") else len(table)
    per_pixel = {"r": 3, "b": 3, "y": 2, "u": 2}.get(encoding[0], 1) if "bayer" not in encoding else 1
    per_pixel = 4 if "a8" in encoding or "a16" in encoding or encoding.endswith("C4") else per_pixel
    per_pixel = 3 if encoding.endswith("C3") else per_pixel
    shape = {"height": height, "width": table.shape[1] // per_pixel, "step": rows.shape[1]}
    return SimpleNamespace(encoding=encoding, is_bigendian=int(big), data=rows.ravel(), **shape)


RGB = smooth()
GREY = RGB[..., 1]
ALPHA = np.full((*GREY.shape, 1), 9, np.uint8)


@pytest.mark.parametrize(
    ("encoding", "table", "expected"),
    [
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.concatenate((RGB, ALPHA), -1), RGB),
        ("bgra8", np.concatenate((RGB[..., ::-1], ALPHA), -1), RGB),
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("rgb16", RGB.astype(np.uint16) * 256 + 7, RGB),
        ("bgr16", RGB[..., ::-1].astype(np.uint16) * 256, RGB),
    ],
)
@pytest.mark.parametrize("big", [False, True])
def test_encodings(encoding: str, table: NDArray, expected: NDArray, big: bool) -> None:
    made = message(encoding, table.reshape(len(table), -1), big=big)
    assert pictures.why_no_picture(made) is None
    np.testing.assert_array_equal(pictures.decode(made, pictures.bits_used(made)), expected)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_pictures_of_16_bits_are_as_bright_as_their_sensor_says(bits: int) -> None:
    table = GREY.astype(np.uint16) << (bits - 8)
    table[0, 0] = (1 << bits) - 1
    made = message("mono16", table)
    assert pictures.bits_used(made) == bits
    np.testing.assert_array_equal(pictures.decode(made, bits)[1:], GREY[1:])


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
def test_bayer(pattern: str, bits: int) -> None:
    """A mosaic of a smooth picture becomes that picture, but for its border."""
    mosaic = np.zeros(GREY.shape, np.uint8)
    for place, letter in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = RGB[row::2, column::2, "rgb".index(letter)]
    table = mosaic if bits == 8 else mosaic.astype(np.uint16) * 256
    made = message(f"bayer_{pattern}{bits}", table)
    found = pictures.decode(made, bits).astype(int)
    assert np.abs(found - RGB)[2:-2, 2:-2].max() <= 2
    ok, content = cv2.imencode(".png", mosaic)
    assert ok
    compressed = SimpleNamespace(format=f"bayer_{pattern}8; png compressed ", data=content.ravel())
    assert pictures.why_no_picture(compressed) is None
    assert pictures.file_of(compressed, 8)[0] == ".png"
    developed = pictures._developed(content.tobytes(), pictures._PATTERNS[pattern]).astype(int)
    assert np.abs(developed - RGB)[2:-2, 2:-2].max() <= 2


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv", "nv12", "nv21"])
def test_yuv(encoding: str) -> None:
    """Luma and chroma by BT.601, written out."""
    red, green, blue = (RGB[..., channel].astype(float) for channel in range(3))
    y = 16 + 0.257 * red + 0.504 * green + 0.098 * blue
    u, v = 128 - 0.148 * red - 0.291 * green + 0.439 * blue, 128 + 0.439 * red - 0.368 * green - 0.071 * blue
    if encoding.startswith("nv"):
        pair = (u, v) if encoding == "nv12" else (v, u)
        table = np.vstack((y, np.stack([each[::2, ::2] for each in pair], -1).reshape(len(y) // 2, -1)))
    else:
        chroma = np.stack((u[:, ::2], v[:, ::2]), -1).reshape(y.shape)
        both = (chroma, y) if encoding in ("yuv422", "uyvy") else (y, chroma)
        table = np.stack(both, -1).reshape(len(y), -1)
    made = message(encoding, np.rint(table).astype(np.uint8), padding=0)
    made.width = GREY.shape[1]
    found = pictures.decode(made, 8).astype(int)
    assert np.abs(found - RGB).max() <= 8


def test_what_is_no_picture() -> None:
    for made, said in (
        (message("16UC1", GREY), "depth"),
        (SimpleNamespace(encoding="32FC1"), "depth"),
        (SimpleNamespace(encoding="vyuy10"), "of encoding vyuy10, which is not known"),
        (SimpleNamespace(format="16UC1; compressedDepth png", data=b""), "depth"),
        (SimpleNamespace(format="h264", data=b"\0\0\0\1"), "compressed as h264, which is neither JPEG nor PNG"),
    ):
        assert said in str(pictures.why_no_picture(made))


OFFSETS = np.repeat(np.arange(500) / 500 * 0.1, 8)
STAMP = 1_700_000_000_250_000_000


@pytest.mark.parametrize(
    ("times", "unit", "counted_from"),
    [
        ((OFFSETS * 1e9).astype(np.uint32), "ns", "stamp"),
        ((OFFSETS * 1e6).astype(np.uint32), "us", "stamp"),
        (OFFSETS.astype(np.float32), "s", "stamp"),
        ((OFFSETS - 0.1).astype(np.float32), "s", "stamp"),
        ((OFFSETS * 1e3).astype(np.float32), "ms", "stamp"),
        ((STAMP + np.rint(OFFSETS * 1e9)).astype(np.uint64), "ns", "1970"),
        (STAMP / 1e9 + OFFSETS, "s", "1970"),
        (STAMP + np.rint(OFFSETS * 1e9), "ns", "1970"),
        ((77_000_000_000 + np.rint(OFFSETS * 1e9)).astype(np.uint64), "ns", "first"),
    ],
)
def test_units_of_times_are_found_by_their_values(times: NDArray, unit: str, counted_from: str) -> None:
    found, note = scans.find_times([(STAMP, times)], "t", 0.1)
    assert found is not None and (found.unit, found.counted_from) == (unit, counted_from)
    assert bool(note) == (counted_from == "first")
    columns = {axis: np.ones(len(times), np.float32) for axis in "xyz"} | {"time": times}
    ends = times.min() < 0
    np.testing.assert_allclose(scans.offsets_s(columns, found, STAMP), OFFSETS - 0.1 * ends, atol=1e-6)


def test_times_that_are_none() -> None:
    coarse = (STAMP / 1e9 + OFFSETS).astype(np.float32)
    for times, said in (
        (coarse, "as float32, which cannot be times"),
        (np.zeros(4000), "only 1 different values"),
        (OFFSETS * 10, "in no unit"),
    ):
        found, note = scans.find_times([(STAMP, times)], "time", 0.1)
        assert found is None and said in note


def test_clouds_with_rows_and_big_numbers() -> None:
    """Organised, big-endian, rows padded, intensity of another name and type."""
    names, formats = ["x", "y", "z", "reflectivity"], [">f8", ">f8", ">f8", ">u2"]
    record = {"names": names, "formats": formats, "offsets": [0, 8, 16, 26], "itemsize": 32}
    table = np.zeros((3, 5), np.dtype(record))
    table["x"] = np.arange(15).reshape(3, 5) + 1
    table["reflectivity"] = 300
    rows = np.pad(table.view(np.uint8).reshape(3, 160), ((0, 0), (0, 8)))
    fields = [
        SimpleNamespace(name=name, offset=at, datatype=kind, count=1)
        for name, at, kind in (("x", 0, 8), ("y", 8, 8), ("z", 16, 8), ("reflectivity", 26, 4))
    ]
    made = SimpleNamespace(
        fields=fields, is_bigendian=True, height=3, width=5, point_step=32, row_step=168, data=rows.ravel()
    )
    columns = scans.columns_of(made)
    np.testing.assert_array_equal(scans.table_of(columns, None)["x"], np.arange(15) + 1)
    assert (scans.table_of(columns, None)["intensity"] == 300).all()
    made.data = made.data[:-100]
    with pytest.raises(InputError, match="cannot hold 3 rows of 5 points"):
        scans.columns_of(made)


def info(**changes: Any) -> Any:
    given: dict[str, Any] = {"width": 640, "height": 480, "distortion_model": "plumb_bob"}
    given |= {"d": [-0.3, 0.1, 1e-3, -2e-3, 0.02], "k": [400, 0, 320, 0, 410, 240, 0, 0, 1], "r": np.eye(3).ravel()}
    given |= {"p": [390, 0, 310, 0, 0, 390, 230, 0, 0, 0, 1, 0], "binning_x": 0, "binning_y": 0}
    given |= {"roi": SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)}
    return SimpleNamespace(**{**given, **changes})


def lens(made: Any, width: int = 640, height: int = 480, rectified: bool = False) -> dict[str, Any]:
    found = lenses.lens_of(made, width, height, rectified, False)
    assert isinstance(found, lenses.Lens), found
    return found.keys


def test_calibrations() -> None:
    keys = lens(info())
    assert keys["model"] == "pinhole" and [keys[key] for key in ("fx", "fy", "cx", "cy")] == [400, 410, 320, 240]
    assert [keys[key] for key in ("k1", "k2", "p1", "p2", "k3")] == [-0.3, 0.1, 1e-3, -2e-3, 0.02]
    keys = lens(info(distortion_model="equidistant", d=[0.1, -0.02, 0.003, -0.0004]))
    assert keys["model"] == "kannala-brandt" and [keys[f"k{n}"] for n in (1, 2, 3, 4)] == [0.1, -0.02, 0.003, -0.0004]
    # a rational one without its denominator is plumb_bob
    assert lens(info(distortion_model="rational_polynomial", d=[-0.3, 0.1, 0, 0, 0.02, 0, 0, 0]))["k3"] == 0.02
    keys = lens(info(), rectified=True)
    assert [keys[key] for key in ("fx", "cx", "cy")] == [390, 310, 230] and "k1" not in keys
    # ROS 1 writes large letters
    old = info()
    for name in "dkrp":
        setattr(old, name.upper(), getattr(old, name))
        delattr(old, name)
    assert lens(old) == lens(info())


def test_a_rational_distortion_is_fitted() -> None:
    """Pixels of the fitted model against OpenCV's of the calibration."""
    distortion = np.array([0.55, -2.8, 9e-4, -2e-4, 1.6, 0.43, -2.6, 1.5])
    keys = lens(info(distortion_model="rational_polynomial", d=distortion))
    points = np.random.default_rng(0).uniform([-0.75, -0.55, 1], [0.75, 0.55, 1], (500, 3))
    matrix = np.array([[400.0, 0, 320], [0, 410, 240], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, distortion)
    if keys["model"] == "pinhole":
        five = np.array([keys.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
        found, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, five)
    else:
        four = np.array([keys.get(f"k{number}", 0.0) for number in (1, 2, 3, 4)])
        found, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), matrix, four)
    assert np.sqrt(((found - expected) ** 2).sum(-1).mean()) < 0.3
    hopeless = lenses.lens_of(
        info(distortion_model="rational_polynomial", d=[30, -20, 0.1, 0.1, 3, 0, 0, 9]), 640, 480, False, False
    )
    assert isinstance(hopeless, str) and "has no equal here" in hopeless


def test_parts_of_pictures() -> None:
    """A pixel sees the same ray in the whole picture and in what is published of it."""
    roi = SimpleNamespace(x_offset=100, y_offset=60, width=400, height=300)
    keys = lens(info(roi=roi, binning_x=2, binning_y=2), 200, 150)
    # the published pixel (10, 20) averages the whole picture's (120, 100) to (121, 101)
    assert (10 - keys["cx"]) / keys["fx"] == pytest.approx((120.5 - 320) / 400)
    assert (20 - keys["cy"]) / keys["fy"] == pytest.approx((100.5 - 240) / 410)
    keys = lens(info(), 320, 240)
    assert (10 - keys["cx"]) / keys["fx"] == pytest.approx((20.5 - 320) / 400)
    found = lenses.lens_of(info(), 320, 320, False, False)
    assert isinstance(found, str) and "is of 640×480 px, its pictures of 320×320 px" in found
    assert "not calibrated" in str(lenses.lens_of(info(k=[0.0] * 9), 640, 480, False, False))
    assert "'ftheta' is not known" in str(lenses.lens_of(info(distortion_model="ftheta"), 640, 480, False, False))
