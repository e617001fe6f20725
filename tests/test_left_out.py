"""Broken and missing files in the middle of a drive: left out and named, not fatal; fatal under --strict."""

import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import SEQUENCE, Change, RoomDrive, cut, halve, spoil, write_mono, write_points, write_room_drive
from rich.console import Console
from scenes import tree as contents

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_distance_png
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.writer import ProcessReport

pytestmark = pytest.mark.slow

CAMERAS = ("image_02", "image_03")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    folder = tmp_path_factory.mktemp("whole")
    room = write_room_drive(folder / "drive", frames=12, beams=400, size=32)
    write_mono(folder / "mono", room, lambda _, frame: 3.0 + frame)
    return room


@pytest.fixture
def drive(whole: RoomDrive, tmp_path: Path) -> RoomDrive:
    shutil.copytree(whole.root.parent, tmp_path, dirs_exist_ok=True)
    return replace(whole, root=tmp_path / "drive")


def run(drive: RoomDrive, scene: str = "scene", **changes) -> tuple[ProcessReport, str]:
    folder = drive.root.parent
    options: dict[str, Any] = {"root": drive.root, "sequence": SEQUENCE, "output": folder / scene}
    options |= {"mono": folder / "mono", "sweeps": 1, "find_ego": False, "sky": False, "refine_poses": False, **changes}
    console = Console(width=400, force_terminal=False)
    with console.capture() as said:
        report = convert(Kitti360Options(**options), console)
    return report, said.get()


def damage(path: Path) -> None:
    """Its ends and its size stay, so that nobody sees it before it is decoded."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0x5A
    path.write_bytes(content)


PICTURE = f"drive/data_2d_raw/{SEQUENCE}/image_03/data_rgb/0000000005.png"
SWEEP = f"drive/data_3d_raw/{SEQUENCE}/velodyne_points/data/0000000007.bin"
MONO = "mono/image_02/0000000006.png"
MISSING = {PICTURE: {("image_03", 5)}, SWEEP: {("image_02", 7), ("image_03", 7)}, MONO: {("image_02", 6)}}
"""Pictures that are left out with these files."""


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (PICTURE, damage, r"0000000005\.png: (damaged|cannot be decoded)"),
        (SWEEP, cut, r"0000000007\.bin: .* bytes, expected a multiple of 16"),
        (SWEEP, lambda path: write_points(path, np.full((50, 3), np.nan)), "7.bin: none of its 50 points can be used"),
        (MONO, None, r"0000000006\.png: no such file"),
        (MONO, lambda path: write_distance_png(path, np.zeros((32, 32))), "contains no distance"),
    ],
)
def test_a_broken_file_is_left_out_and_named(drive: RoomDrive, file: str, change: Change, message: str) -> None:
    spoil(drive.root.parent, file, change)
    missing, sky = MISSING[file], message == "contains no distance"

    report, said = run(drive, sky=sky)
    scene = report.scene
    meta = read_json(scene / "transforms.json")
    every = {(name, frame) for name in CAMERAS for frame in drive.frames}
    assert {(frame["camera"], frame["frame"]) for frame in meta["frames"]} == every - missing
    assert len(meta["train_filenames"]) + len(meta["test_filenames"]) == report.training + report.held_out
    assert report.training + report.held_out == 24 - len(missing)
    # no file of them is left, and all that is named is there
    for layer in ("images", "lidar", "mono"):
        there = {(path.parent.name, int(path.stem)) for path in (scene / layer).rglob("*.png")}
        assert there == every - missing
    assert len(report.left_out) in (1, 2) and all(re.search(message, item.fault) for item in report.left_out)
    assert "Left out: " in said and re.search(message, said)
    # once more: the same is told, nothing is done, no byte changes
    before = contents(scene)
    again, said_again = run(drive, sky=sky)
    assert again.written == 0 and again.left_out == report.left_out and re.search(message, said_again)
    assert contents(scene) == before
    with pytest.raises((InputError, FileNotFoundError), match=message):
        run(drive, "strict", strict=True, sky=sky)
    assert not (drive.root.parent / "strict/transforms.json").exists()


def test_a_mended_file_may_have_an_older_date(drive: RoomDrive) -> None:
    """As `cp -p`, tar and wget leave it."""
    path = drive.image("image_03", 5)
    whole, dates = path.read_bytes(), path.stat()
    damage(path)
    assert run(drive)[0].left_out
    path.write_bytes(whole)
    os.utime(path, ns=(dates.st_atime_ns, dates.st_mtime_ns))
    assert not run(drive)[0].left_out


@pytest.mark.parametrize(("file", "change"), [(PICTURE, damage), (SWEEP, cut)])
def test_a_file_that_is_mended_comes_into_the_scene(drive: RoomDrive, file: str, change: Change) -> None:
    path = drive.root.parent / file
    whole = path.read_bytes()
    spoil(drive.root.parent, file, change)
    assert run(drive)[0].left_out
    path.write_bytes(whole)
    report, said = run(drive)
    assert report.written and not report.left_out and "Left out" not in said
    assert report.training + report.held_out == 24
    run(drive, "other")
    assert contents(report.scene) == contents(drive.root.parent / "other")
    # from here on it is whole, and another drive is another drive
    cut(path)
    with pytest.raises(InputError, match="contains another scene: inputs_sha256"):
        run(drive)


def test_a_mended_sweep_moves_the_split_and_no_held_out_sweep_stays_in_training_maps(drive: RoomDrive) -> None:
    """With poses as they are given: nothing else is written anew."""
    sweep = drive.root.parent / SWEEP.replace("07", "01")
    whole = sweep.read_bytes()
    sweep.write_bytes(whole[:-5])
    given: dict[str, Any] = {"holdout_every": 5, "strict": False}
    first, _ = run(drive, **given)
    sweep.write_bytes(whole)
    run(drive, **given)
    fresh, _ = run(drive, "fresh", **given)
    split = [read_json(each.scene / "transforms.json")["test_filenames"] for each in (first, fresh)]
    assert split[0] == split[1]
    found, expected = (contents(each.scene) for each in (first, fresh))
    assert {
        name for name in expected if name.startswith(("lidar/", "points")) and found[name] != expected[name]
    } == set()


def test_a_camera_without_pictures_for_training(drive: RoomDrive) -> None:
    """Those of a stretch may be missing; nothing is masked then."""
    for frame in drive.frames:
        drive.image("image_03", frame).unlink()
    report, said = run(drive, find_ego=True)
    assert {frame["camera"] for frame in read_json(report.scene / "transforms.json")["frames"]} == {"image_02"}
    assert "image_03" in said and "0 pictures are too few" in said


def test_a_fault_of_the_whole_drive_is_an_error(drive: RoomDrive) -> None:
    """Up to a tenth is left out: of 24 pictures two."""
    for frame in (1, 2):
        damage(drive.image("image_02", frame))
    assert len(run(drive)[0].left_out) == 2
    damage(drive.image("image_02", 3))
    with pytest.raises(
        InputError, match=r"0000000003\.png: .*3 of this drive's files cannot be used; at most 2 may be left out"
    ):
        run(drive, "more")
    for frame in (3, 6, 8):
        halve(drive.image("image_03", frame))
    with pytest.raises(InputError, match="at most 2 may be left out"):
        run(drive, "many")
    assert not (drive.root.parent / "many").exists()


def test_the_vehicle_is_found_beside_a_broken_picture(drive: RoomDrive) -> None:
    damage(drive.image("image_03", 5))
    report, _ = run(drive, find_ego=True)
    assert [item.key for item in report.left_out] == ["image_03, frame 5"]
