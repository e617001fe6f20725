"""Poses in the formats that people have, against numbers written out by hand."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.process.poses import read_kitti, read_nerfstudio, read_times, read_tum, transform_of_rows

HALF = math.sqrt(0.5)


def text(folder: Path, content: str) -> Path:
    (folder / "poses.txt").write_text(content)
    return folder / "poses.txt"


def test_tum(tmp_path: Path) -> None:
    # a quarter turn about z: x goes to y
    times, poses, _ = read_tum(
        text(tmp_path, f"# time x y z qx qy qz qw\n\n1.5 1 2 3 0 0 {HALF} {HALF}\n2.5 0 0 0 0 0 0 1\n")
    )
    assert times.tolist() == [1.5, 2.5]
    assert poses[0] == pytest.approx(np.array([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]), abs=1e-12)
    assert np.array_equal(poses[1], np.eye(4))


def test_poses_of_one_time_are_one(tmp_path: Path) -> None:
    """Sensors that were read at once bring the vehicle's pose each, with the digits that they have."""
    times, poses, _ = read_tum(text(tmp_path, "1 1 2 3 0 0 0 1\n1 1.01 2 3 0 0 0.001 1\n2 5 2 3 0 0 0 1\n"))
    assert times.tolist() == [1, 2]
    assert poses[0, :3, 3].tolist() == [1, 2, 3]
    # nanoseconds that float64 cannot tell apart
    times, _, _ = read_tum(text(tmp_path, "315968112.449927216 1 2 3 0 0 0 1\n315968112.449927217 1 2 3 0 0 0 1\n"))
    assert len(times) == 1
    # a doubled time in many lines is left out
    lines = [f"{number} {number} 0 0 0 0 0 1" for number in range(200)]
    lines.insert(31, "30 30.5 0 0 0 0 0 1")
    times, poses, doubled = read_tum(text(tmp_path, "\n".join(lines)))
    assert times.tolist() == list(range(200)) and doubled == [32]
    assert poses[30, 0, 3] == 30


def test_kitti(tmp_path: Path) -> None:
    poses = read_kitti(text(tmp_path, "0 0 1 7 0 1 0 8 -1 0 0 9\n"))
    assert poses.tolist() == [[[0, 0, 1, 7], [0, 1, 0, 8], [-1, 0, 0, 9], [0, 0, 0, 1]]]


def test_nerfstudio_turns_the_cameras_axes(tmp_path: Path) -> None:
    # OpenGL's camera looks along -z: this one looks along the world's -z, its y is the world's
    frame = {"file_path": "./images/front/0001.png", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame]}))
    poses = read_nerfstudio(tmp_path / "transforms.json")
    assert list(poses) == ["images/front/0001"]
    pose = poses["images/front/0001"]
    assert (pose @ [0, 0, 1, 0]).tolist() == [0, 0, -1, 0]
    assert (pose @ [0, 1, 0, 0]).tolist() == [0, -1, 0, 0]


def test_times(tmp_path: Path) -> None:
    assert read_times(text(tmp_path, "1.5\n2.25 # later\n")) == [(None, 1.5), (None, 2.25)]
    assert read_times(text(tmp_path, "a.png, 3\nb.png 4\n")) == [("a.png", 3.0), ("b.png", 4.0)]
    assert read_times(text(tmp_path, "time,file\n3,Bild 1.jpg\n4 b.jpg,\n")) == [("Bild 1.jpg", 3.0), ("b.jpg", 4.0)]


@pytest.mark.parametrize(
    ("read", "content", "message"),
    [
        (read_tum, "0 1 2 3 0 0 0\n", "line 1: 7 numbers, expected 8"),
        (read_tum, "0 1 2 3 0 0 0 1\n0 1.1 2 3 0 0 0 1\n", r"line 2: its time 0\.0+ is not after.* within 2 cm"),
        (read_tum, "0 1 2 3 0 0 0 1\n0 1 2 3 0 0 0.01 0.99995\n", r"line 2: its time 0\.0+ is not after"),
        (read_tum, "0 1 2 3 1 0 0 1\n", r"line 1: the quaternion 1 0 0 1 has the length 1\.414.*w last"),
        (read_tum, "0 1 2 nan 0 0 0 1\n", "line 1: 'nan' is not a finite number"),
        (read_kitti, "0 0 0 1 0 0 0 1\n", "line 1: 8 numbers as TUM's format has, expected 12"),
        (read_kitti, "1 0 0 0 0 1.1 0 0 0 0 1 0\n", "line 1: not a rotation and a translation"),
        (read_times, "1 2 3\n", "line 1: 3 words"),
        (read_times, "2013-05-28 08:46:02,123\n", "line 1: 3 words"),
        (read_times, "09:57:9.936530\n", r"line 1: '09:57:9\.936530' is not a finite number\. Write times as seconds"),
        (read_times, "a 1\n2\n", "line 2: some lines have a file's name"),
        (read_times, "\x00\xff\n", "line 1: .* is not a finite number"),
    ],
)
def test_a_broken_line_is_named(tmp_path: Path, read, content: str, message: str) -> None:
    path = text(tmp_path, content)
    with pytest.raises(InputError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)
    with pytest.raises(FileNotFoundError, match="absent"):
        read(tmp_path / "absent")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "has no list of frames"),
        ({"frames": [{}]}, r"frames\[0\] has no file_path"),
        ({"frames": [{"file_path": "a.png"}]}, r"frames\[0\]\.transform_matrix: expected 4 rows of 4 numbers"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}] * 2}, "has a pose already"),
    ],
)
def test_a_broken_transforms_json_is_named(tmp_path: Path, content: dict, message: str) -> None:
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_nerfstudio(tmp_path / "transforms.json")


@pytest.mark.parametrize("rows", [None, [[1, 2], [3]], [["a"] * 4] * 4, np.eye(3).tolist(), {}])
def test_what_is_no_matrix_is_said(rows: object) -> None:
    with pytest.raises(InputError, match="here: expected 4 rows of 4 numbers"):
        transform_of_rows(rows, "here")
