"""`process` as a whole: scene, monocular maps and their calibration by one command, each done once."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import SEQUENCE, RoomDrive, without_lidar_check, write_mono, write_room_drive
from rich.console import Console
from scenes import transforms

from edge_depth_nerf.base.files import read_distance_png, read_json, write_distance_png, write_json
from edge_depth_nerf.method.error_model import read_calibration
from edge_depth_nerf.mono import estimate
from edge_depth_nerf.mono.estimate import WEIGHTS, PresetValues
from edge_depth_nerf.mono.training import TrainingOptions
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True, scope="module")
def small_network() -> Iterator[None]:
    small = PresetValues((8, 16, 24), 64, TrainingOptions(steps=12, batch=2, evaluate_every=6))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(estimate.PRESETS, "lite", small)
        without_lidar_check(patch)
        yield


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=6, size=64, cameras=("image_02",))


def options_of(room: RoomDrive, output: Path, **changes: Any) -> Kitti360Options:
    given: dict[str, Any] = {"cameras": ("image_02",), "sweeps": 1, "find_ego": False, "refine_poses": False}
    given["motion"] = False
    return Kitti360Options(root=room.root, sequence=SEQUENCE, output=output, **given | changes)


def run(options: Kitti360Options) -> str:
    console = Console(width=200, force_terminal=False)
    with console.capture() as said:
        process(options, console)
    return said.get()


@pytest.fixture(scope="module")
def done(room: RoomDrive) -> tuple[Path, str]:
    """What one command makes of the drive, and what it says."""
    scene = room.root.parent / "done"
    return scene, run(options_of(room, scene))


@pytest.fixture
def scene(done: tuple[Path, str], tmp_path: Path) -> Path:
    return Path(shutil.copytree(done[0], tmp_path / "scene"))


@pytest.fixture(scope="module")
def without_maps(room: RoomDrive) -> Path:
    scene = room.root.parent / "without_maps"
    run(options_of(room, scene, estimate_depth=False))
    return scene


def dates(scene: Path) -> dict[str, int]:
    return {str(path.relative_to(scene)): path.stat().st_mtime_ns for path in scene.rglob("*") if path.is_file()}


def test_one_command_gives_lidar_mono_and_its_calibration(room: RoomDrive, done: tuple[Path, str], scene: Path) -> None:
    meta = read_json(scene / "transforms.json")
    assert meta["mono"]["kind"] == "network" and meta["mono"]["trained_on"] == "scene"
    assert len(meta["frames"]) == 6
    for frame in meta["frames"]:
        mono = read_distance_png(scene / frame["mono_file_path"])
        assert mono.shape == (64, 64) and (mono > 0).mean() > 0.2
    # frame 4 is held out: no network saw it
    trained = meta["mono"]["trained_frames"]
    assert trained and not any("0000000004" in name for name in trained)
    calibration = read_calibration(scene / CALIBRATION_FILE)
    assert calibration.error_model is not None and len(calibration.frames) == 5
    assert (scene / WEIGHTS).is_file()
    assert "6 pictures got a monocular map" in done[1]

    before = dates(scene)
    transforms = (scene / "transforms.json").read_bytes()
    again = run(options_of(room, scene))
    assert "all of them were there" in again and "Train" not in again and "monocular map" not in again
    assert (scene / "transforms.json").read_bytes() == transforms
    changed = {name for name, date in dates(scene).items() if before[name] != date}
    assert not {name for name in changed if name.startswith(("mono/", "lidar/")) or name in (WEIGHTS, CALIBRATION_FILE)}


def test_a_run_stopped_between_its_stages_is_finished(
    room: RoomDrive, without_maps: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    scene = Path(shutil.copytree(without_maps, tmp_path / "scene"))
    for stage, has_mono in (("estimate_depth", False), ("calibrate_scene", True)):
        with monkeypatch.context() as patch:
            patch.setattr(estimate, stage, stop)
            with pytest.raises(KeyboardInterrupt):
                run(options_of(room, scene))
        assert not (scene / CALIBRATION_FILE).exists() and read_scene(scene).has("mono") == has_mono
    said = run(options_of(room, scene))
    assert (scene / CALIBRATION_FILE).is_file() and read_scene(scene).has("mono")
    assert "Trained" not in said


def test_maps_that_came_later_stay(room: RoomDrive, without_maps: Path, tmp_path: Path) -> None:
    assert not read_scene(without_maps).has("mono")
    scene = Path(shutil.copytree(without_maps, tmp_path / "scene"))
    put_in(scene, 3.0)
    said = run(options_of(room, scene))
    assert "Train" not in said
    assert read_json(scene / "transforms.json")["mono"] == {"trained_on": "elsewhere"}
    assert distances(scene) == {3.0}
    # these are calibrated, too
    assert read_calibration(scene / CALIBRATION_FILE).everywhere


def test_maps_of_pictures_that_have_changed_are_made_anew(room: RoomDrive, scene: Path, tmp_path: Path) -> None:
    drive = replace(room, root=shutil.copytree(room.root, tmp_path / "drive"))
    assert "monocular map" not in run(options_of(drive, scene))
    for picture in drive.root.rglob("0000000002.png"):
        picture.touch()
    assert "6 pictures got a monocular map" in run(options_of(drive, scene))


def test_without_lidar_it_says_what_to_do(room: RoomDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tmp_path / "scene"
    report = process(options_of(room, scene, estimate_depth=False, frames=2), Console(quiet=True))
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            del frame["lidar_file_path"], frame["depth_file_path"]
    monkeypatch.setattr("edge_depth_nerf.process.command.convert", lambda *_: report)
    assert "estimate-depth SCENE --model" in run(options_of(room, scene))
    assert not read_scene(scene).has("mono")


def put_in(scene: Path, distance_m: float) -> None:
    names = [picture.name for picture in read_scene(scene).pictures]
    maps = ((name, np.full((64, 64), distance_m, np.float32)) for name in names)
    write_maps(scene, "mono", maps, {"trained_on": "elsewhere"})


def distances(scene: Path) -> set[float]:
    frames = read_json(scene / "transforms.json")["frames"]
    return {float(value) for f in frames for value in np.unique(read_distance_png(scene / f["mono_file_path"]))} - {0.0}


def test_maps_that_are_brought_stay_until_others_are_put_in_whole(
    room: RoomDrive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, mono = tmp_path / "scene", write_mono(tmp_path / "mono", room, 9.0)
    options = options_of(room, scene, mono=mono, sky=False)
    assert "Error of the monocular maps" in run(options)
    assert distances(scene) == {9.0} and "mono" not in read_json(scene / "transforms.json")
    assert read_calibration(scene / CALIBRATION_FILE).error_model is not None and not (scene / WEIGHTS).exists()
    # killed while new maps were moved in: these are not taken for the drive's
    meta = read_json(scene / "transforms.json")
    write_distance_png(scene / meta["frames"][0]["mono_file_path"], np.full((64, 64), 5.0))
    for frame in meta["frames"]:
        del frame["mono_file_path"]
    write_json(scene / "transforms.json", {**meta, "mono": {"unfinished": True}})
    assert not read_scene(scene).has("mono")
    run(options)
    assert distances(scene) == {9.0}
    # put in over those of the drive, they stay with their source
    put_in(scene, 3.0)
    run(options)
    assert distances(scene) == {3.0}
    assert read_json(scene / "transforms.json")["mono"] == {"trained_on": "elsewhere"}
    # one file renewed: all are the drive's again, none is mixed in; a run that is stopped leaves this to be said
    (mono / "image_02/0000000002.png").touch()
    begun: list[int] = []

    def stopped_at_two(jobs: Sequence[Callable[[], object]], *_: object) -> None:
        begun.append(len(jobs))
        for job in jobs[:2]:
            job()
        raise KeyboardInterrupt

    with monkeypatch.context() as stopped:
        stopped.setattr("edge_depth_nerf.scene.writer.run_jobs", stopped_at_two)
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                run(options)
    assert begun[1] == begun[0] - 2, "what was written is not written again"
    assert "of this scene are removed" in run(options)
    assert not (scene / ".transforms.before.json").exists()
    assert distances(scene) == {9.0} and "mono" not in read_json(scene / "transforms.json")


def test_a_map_that_is_lost_is_made_again(room: RoomDrive, scene: Path) -> None:
    next((scene / "mono").rglob("*.png")).unlink()
    said = run(options_of(room, scene))
    assert "of this scene are removed" in said and "is trained already" in said
    assert read_scene(scene).has("mono") and (scene / CALIBRATION_FILE).is_file()


def test_options_that_come_too_late_are_told(room: RoomDrive, scene: Path) -> None:
    run(options_of(room, scene, motion=True))
    said = run(options_of(room, scene, motion=False))
    assert "has distances from motion already, which are kept and used" in said
