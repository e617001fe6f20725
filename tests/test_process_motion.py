"""Distances from motion for scenes: written whole, continued, made of training pictures alone."""

import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from balls import FISHEYE, THETA_MAX_RAD, in_ball, pose
from drives import SEQUENCE, write_room_drive
from rich.console import Console
from scenes import frame_entry

from edge_depth_nerf.base.files import (
    read_distance_png,
    read_json,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.motion import add_motion, enlarged
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.stereo.consistency import MotionDistance
from edge_depth_nerf.stereo.motion import Motion

STEPS_M = (0.0, 0.3, 0.6, 0.9, 1.2, 1.5)
HELD_OUT = 3
MASK = "masks/camera.png"


def write_whole_mask(folder: Path) -> None:
    """The camera's mask, which hides nothing; each run of `process` writes it anew."""
    write_mask(folder / MASK, np.ones((FISHEYE.height, FISHEYE.width), bool))


def write_ball_scene(folder: Path, steps_m: tuple[float, ...] = STEPS_M) -> Path:
    """A scene inside a textured ball, with its truth; one picture is held out."""
    frames = []
    for number, x in enumerate(steps_m):
        place = pose(x, 0.1 * x, 0.05, 0.1 * x)
        view, truth = in_ball(FISHEYE, place)
        name = f"{number:04d}.png"
        grey = np.clip(np.nan_to_num(view.grey), 0, 255).astype(np.uint8)
        write_png(folder / "images" / name, np.repeat(grey[..., None], 3, -1))
        write_distance_png(folder / "truth" / name, np.where(view.used, truth, 0))
        files = {"truth_distance_file_path": f"truth/{name}", "mask_path": MASK}
        frames.append(frame_entry(FISHEYE, place, name) | files)
    write_whole_mask(folder)
    names = [frame["file_path"] for frame in frames]
    held_out = names[HELD_OUT : HELD_OUT + 1]
    meta = {"camera_model": "OPENCV_FISHEYE", "world_offset_m": [0, 0, 0], "frames": frames}
    meta |= {"train_filenames": [name for name in names if name not in held_out]}
    meta |= {"theta_max_deg": math.degrees(THETA_MAX_RAD), "val_filenames": held_out, "test_filenames": held_out}
    write_json(folder / "transforms.json", meta)
    return folder


def add(scene: Path) -> str:
    console = Console(width=200, force_terminal=False)
    with console.capture() as said:
        add_motion(read_scene(scene), console)
    return said.get()


def motion_maps(scene: Path) -> list[np.ndarray]:
    return [
        read_distance_png(scene / frame["motion_file_path"]) for frame in read_json(scene / "transforms.json")["frames"]
    ]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball_scene(tmp_path_factory.mktemp("written"))


@pytest.fixture
def scene(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "scene"))


@pytest.fixture(scope="module")
def ball(written: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = Path(shutil.copytree(written, tmp_path_factory.mktemp("ball") / "scene"))
    assert "Motion gives distances for" in add(scene)
    return scene


def test_training_pictures_get_right_maps_and_held_out_ones_none(ball: Path) -> None:
    scene = read_scene(ball)
    assert scene.meta["motion"] == {"kind": "sphere sweep"}
    assert [picture.held_out for picture in scene.pictures].index(True) == HELD_OUT
    for number, (picture, found) in enumerate(zip(scene.pictures, motion_maps(ball), strict=True)):
        if number == HELD_OUT:
            assert not found.any()
            assert not read_distance_png(picture.files["motion_around"]).any()
            continue
        truth, kept = scene.distance_m(picture, "truth_distance"), found > 0
        assert truth is not None
        assert kept.sum() > 0.4 * (truth > 0).sum()
        assert np.median(np.abs(found - truth)[kept] / truth[kept]) < 0.02
        sigma_m = scene.distance_m(picture, "motion_sigma")
        assert sigma_m is not None
        np.testing.assert_array_equal(sigma_m > 0, kept)
        # by parallax and confidence: no better than 1 %, no worse than what is wrong
        assert 0.009 < (sigma_m / np.where(kept, found, 1))[kept].min()
        assert (sigma_m / np.where(kept, found, 1))[kept].max() < 0.2
        # the neighbours show nearly all of it, also what was not matched here
        around_m = scene.distance_m(picture, "motion_around")
        assert around_m is not None
        shown = (around_m > 0) & (truth > 0)
        assert shown.sum() > 0.4 * (truth > 0).sum() and (shown & ~kept).any()
        assert np.median(np.abs(around_m - truth)[shown] / truth[shown]) < 0.02
    # what it was made by is not kept
    assert not (ball / ".cache" / "motion").exists()


def test_held_out_pictures_take_no_part(ball: Path, scene: Path) -> None:
    write_png(scene / "images" / f"{HELD_OUT:04d}.png", np.zeros((FISHEYE.height, FISHEYE.width, 3), np.uint8))
    add(scene)
    np.testing.assert_array_equal(motion_maps(scene), motion_maps(ball))


def test_a_run_that_was_stopped_goes_on_where_it_was(ball: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sweep, swept = Motion.sweep, []

    def stopped(self: Motion, index: int) -> Any:
        if index >= 3:
            raise KeyboardInterrupt
        return sweep(self, index)

    def counted(self: Motion, index: int) -> Any:
        swept.append(index)
        return sweep(self, index)

    monkeypatch.setattr("os.cpu_count", lambda: 1)
    with monkeypatch.context() as patch:
        patch.setattr(Motion, "sweep", stopped)
        with pytest.raises(KeyboardInterrupt):
            add(scene)
    assert not read_scene(scene).has("motion")
    write_whole_mask(scene)
    with monkeypatch.context() as patch:
        patch.setattr(Motion, "sweep", counted)
        add(scene)
    assert swept == [3, 4]
    np.testing.assert_array_equal(motion_maps(scene), motion_maps(ball))


def stopped_after_its_sweeps(scene: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the sweeps of a run that was stopped before it confirmed any."""
    with monkeypatch.context() as patch:
        patch.setattr(Motion, "confirm", lambda *_: pytest.fail("stopped"))
        with pytest.raises(pytest.fail.Exception):
            add(scene)
    (made,) = (scene / ".cache" / "motion").iterdir()
    return made


def test_a_damaged_sweep_is_made_anew(ball: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And each picture is confirmed once: two layers are made of it, also by a run that was stopped in between."""
    made = stopped_after_its_sweeps(scene, monkeypatch)
    whole = (made / "000001.npz").read_bytes()
    (made / "000001.npz").write_bytes(whole[:-100])
    sweep, swept = Motion.sweep, []
    monkeypatch.setattr(Motion, "sweep", lambda self, index: swept.append(index) or sweep(self, index))
    confirm, confirmed = Motion.confirm, []

    def counted(self: Motion, index: int, sweeps: Any) -> MotionDistance:
        confirmed.append(index)
        return confirm(self, index, sweeps)

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Motion, "confirm", counted)
    with monkeypatch.context() as patch:
        patch.setattr("edge_depth_nerf.process.motion.write_maps", stopped)
        with pytest.raises(KeyboardInterrupt):
            add(scene)
    add(scene)
    assert swept == [1] and sorted(confirmed) == [0, 1, 2, 3, 4]
    np.testing.assert_array_equal(motion_maps(scene), motion_maps(ball))


def test_sweeps_of_other_pictures_are_not_taken(ball: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = stopped_after_its_sweeps(scene, monkeypatch)
    assert len(list(made.iterdir())) == len(STEPS_M) - 1
    (scene / "images" / "0001.png").write_bytes((scene / "images" / "0000.png").read_bytes())
    add(scene)
    assert not np.array_equal(motion_maps(scene)[0], motion_maps(ball)[0])


@pytest.mark.parametrize(
    ("steps_m", "reason"), [((0.5,) * 6, "the vehicle stands"), ((0.0, 0.3, 0.6), "2 training pictures are too few")]
)
def test_without_motion_it_says_why(steps_m: tuple[float, ...], reason: str, tmp_path: Path) -> None:
    scene = write_ball_scene(tmp_path, steps_m)
    meta = read_json(scene / "transforms.json")
    if not meta["val_filenames"]:
        meta["train_filenames"], meta["val_filenames"] = meta["train_filenames"][:2], meta["train_filenames"][2:]
        write_json(scene / "transforms.json", meta)
    assert reason in add(scene)
    assert not read_scene(scene).has("motion")


@pytest.mark.slow
def test_process_finds_motion_once_unless_told_not_to(tmp_path: Path) -> None:
    drive = write_room_drive(tmp_path / "drive", frames=6, size=64)

    def run(**changes: Any) -> str:
        console = Console(width=200, force_terminal=False)
        common: dict[str, Any] = {"estimate_depth": False, "find_ego": False, "sweeps": 1, "output": tmp_path / "scene"}
        with console.capture() as said:
            process(Kitti360Options(root=drive.root, sequence=SEQUENCE, **common, **changes), console)
        return said.get()

    assert "from motion" not in run(motion=False)
    assert not read_scene(tmp_path / "scene").has("motion")
    assert "Motion gives distances for" in run()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "scene" / "motion").rglob("*.png")}
    assert len(before) == 12
    assert "from motion" not in run()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # a scene of before has no maps of what neighbours show; those of other tools need none
    transforms = tmp_path / "scene" / "transforms.json"
    meta = read_json(transforms)
    for frame in meta["frames"]:
        del frame["motion_around_file_path"]
    write_json(transforms, {**meta, "motion": {"kind": "another"}})
    assert "Motion gives distances for" not in run()
    meta = read_json(transforms)
    write_json(transforms, {**meta, "motion": {"kind": "sphere sweep"}})
    assert "Motion gives distances for" in run()
    assert read_scene(tmp_path / "scene").has("motion_around")
    # other pictures, other maps
    next(drive.root.rglob("image_02/**/0000000002.png")).touch()
    said = run()
    assert "They are made again, unless --no-motion is given." in said and "Motion gives distances for" in said
    assert len(read_json(tmp_path / "scene" / "transforms.json")["motion"]) == 1


def test_maps_are_enlarged_on_surfaces_and_kept_apart_at_jumps() -> None:
    distance = np.zeros((3, 6), np.float32)
    distance[:2] = [4.0, 4.1, 4.2, 9.0, 9.0, 9.0]
    large = enlarged(distance, 2, (7, 13))
    assert large.shape == (7, 13)
    assert not large[4:].any() and not large[:, 12].any()
    # between blocks' centres a quarter of the way, in inverse distance
    assert large[1, 1] == pytest.approx(1 / (0.75 / 4.0 + 0.25 / 4.1), rel=1e-5)
    np.testing.assert_allclose(large[:4, 5], 4.2, rtol=0.02)
    np.testing.assert_allclose(large[:4, 6], 9.0, rtol=1e-6)
    assert enlarged(distance, 1, (3, 6)) is distance
