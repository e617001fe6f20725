"""JBNU-Depth360: its folders with a calibration and poses handed in go the whole way; the page's example is read."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import Change, spoil, synthesize_coarsely, without_lidar_check
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_json, write_png
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.jbnu_depth360 import read_jbnu_depth360
from edge_depth_nerf.process.options import JbnuDepth360Options
from edge_depth_nerf.process.recording import RecordedSweep
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[1] / "docs" / "rig.md"
CAMERAS = ("front", "left", "rear", "right")
FRAMES = 5


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("jbnu") / "drive"
    return synthesize_coarsely(SynthesizeOptions(root, "parking", frames=FRAMES, size=128, layout="jbnu-depth360"))


def options(root: Path, **changes) -> JbnuDepth360Options:
    given: dict[str, Any] = {"root": root, "calibration": root / "calibration.toml", "output": root.parent / "scene"}
    given |= {"strict": True, "refine_poses": False, "find_ego": False}
    return JbnuDepth360Options(**given | changes)


@pytest.fixture(scope="module")
def scene(drive: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        without_lidar_check(patch)
        report = convert(options(drive), Console(quiet=True))
    assert (report.training, report.held_out, report.skipped) == (16, 4, ())
    # nerfstudio knows the model, and its rays are right up to the lens's rim
    assert [fit.rms_px < 1e-6 for fit in report.fits.values()] == [True] * 4
    return report.scene


def test_four_fisheyes_make_a_scene(scene: Path, drive: Path) -> None:
    meta = read_json(scene / "transforms.json")
    assert meta["source"]["kind"] == "jbnu-depth360"
    assert {frame["camera"] for frame in meta["frames"]} == set(CAMERAS)
    assert {(frame["w"], frame["h"]) for frame in meta["frames"]} == {(128, 72)}
    for name in CAMERAS:
        errors = []
        for frame in range(FRAMES):
            lidar = read_distance_png(scene / f"lidar/{name}/{frame:010d}.png")
            truth = read_distance_png(drive / f"truth/{name}/distance/{frame:06d}.png")
            both = (lidar > 0) & (truth > 0)
            errors.append(np.abs(lidar[both] / truth[both] - 1))
            # rendered, so its truth comes with it
            assert np.array_equal(read_distance_png(scene / f"truth/{name}/distance/{frame:010d}.png"), truth)
        assert len(np.concatenate(errors)) > 3000
        # a pixel is 1.5° wide; a return lies anywhere in it
        assert np.median(np.concatenate(errors)) < 0.015
        assert np.mean(np.concatenate(errors) < 0.05) > 0.8


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """A sequence of six frames, of which one has no picture, and the page's calibration."""
    sequence = tmp_path / "230329/test_1"
    (sequence / "bin").mkdir(parents=True)
    write_png(sequence / "image/000020.png", np.zeros((1080, 1920, 3), np.uint8))
    for number in range(20, 26):
        np.full((8, 4), 3.0, "<f4").tofile(sequence / f"bin/{number:06d}.bin")
        if number not in (20, 22):
            shutil.copy(sequence / "image/000020.png", sequence / f"image/{number:06d}.png")
    section = PAGE.read_text().partition("## JBNU-Depth360")[2]
    block = re.findall(r"```toml\n(.*?)```", section, re.S)[0]
    (tmp_path / "calibration.toml").write_text(block)
    lines = [f"{time:.2f} {time} 0 0 0 0 0 1\n" for time in np.arange(1.9, 2.7, 0.1)]
    (tmp_path / "poses.txt").write_text("".join(lines))
    return sequence


def given(published: Path, **changes) -> JbnuDepth360Options:
    return options(published, calibration=published.parents[1] / "calibration.toml", **changes)


def test_what_the_page_says_is_left_out(published: Path) -> None:
    recording = read_jbnu_depth360(given(published))
    (camera,) = recording.cameras
    assert camera.camera == KannalaBrandt(1920, 1080, 557.87, 558.43, 962.34, 536.76, -0.02, 0.004, -0.0015, 0.0)
    # numbers are tenths of a second; the missing picture leaves the others where they are
    numbered = [("000020", 0), ("000021", 1), ("000023", 2), ("000024", 3), ("000025", 4)]
    assert [(p.path.stem, p.frame) for p in recording.pictures] == numbered
    assert [p.time_s for p in recording.pictures] == pytest.approx([2.0, 2.1, 2.3, 2.4, 2.5])
    assert [(s.path.stem, s.frame) for s in recording.sweeps if s.frame is not None] == numbered
    sweep = recording.sweeps[0]
    assert np.array_equal(sweep.to_vehicle, np.eye(4))
    assert sweep.timing is not None and sweep.timing.turn_s == pytest.approx(0.1) and sweep.timing.clockwise
    # ahead (azimuth 0) the scanner looks in the middle of the turn, when the picture is taken
    points = sweep.read().points_m * 0
    points[:, 0] = 5.0
    assert sweep.timing.offsets_s(points).abs().max() < 1e-9
    assert recording.trajectory is not None
    assert recording.trajectory.at(np.array([2.25]))[0, 0, 3] == pytest.approx(2.25)


def test_what_stands_in_the_file_is_taken(published: Path) -> None:
    path = published.parents[1] / "calibration.toml"
    lidar = (
        "\n[lidars.top]\nrate_hz = 20\nto_vehicle = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
        'columns = ["x", "y"]\nnames = {z = "y"}\nturn_s = 0.05\ndirection = "counter-clockwise"\ntimestamp = "end"\n'
    )
    path.write_text(path.read_text() + lidar)
    with pytest.raises(InputError, match="the times of front and top do not overlap"):
        read_jbnu_depth360(given(published))
    path.write_text(path.read_text().replace("rate_hz = 20", "rate_hz = 10\ntime_offset_s = 0.01"))
    sweep = read_jbnu_depth360(given(published)).sweeps[0]
    assert sweep.scanner == "top" and sweep.to_vehicle[0, 3] == 1
    assert sweep.time_s == pytest.approx(2.0 + 0.01 - 0.025)
    assert sweep.timing is not None and not sweep.timing.clockwise
    assert len(sweep.read().points_m) == 16


def test_a_key_in_the_file_replaces_its_assumption_alone(published: Path) -> None:
    path = published.parents[1] / "calibration.toml"
    content = path.read_text()

    def sweep_with(keys: str) -> RecordedSweep:
        path.write_text(f"{content}\n[lidars.ouster]\n{keys}\n")
        return read_jbnu_depth360(given(published)).sweeps[0]

    assumed = sweep_with('columns = ["x", "y", "z", "intensity"]')
    assert assumed.timing is not None and assumed.timing.clockwise and np.array_equal(assumed.to_vehicle, np.eye(4))
    for keys, turn_s, clockwise, to_middle_s in (
        ('direction = "counter-clockwise"', 0.1, False, 0.0),
        ('timestamp = "start"', 0.1, True, 0.05),
        ("turn_s = 0.08", 0.08, True, 0.0),
    ):
        sweep = sweep_with(keys)
        assert sweep.timing is not None and sweep.timing.turn_s == pytest.approx(turn_s)
        assert sweep.timing.clockwise == clockwise
        assert sweep.time_s - assumed.time_s == pytest.approx(to_middle_s)
    assert sweep_with('corrected_to = "middle"').timing is None


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("230329/test_1/bin", None, r"test_1/bin: no such folder; .* holds image.*sequence's folder"),
        ("calibration.toml", None, r"calibration\.toml: no such file"),
        ("calibration.toml", b"cameras = 3", r"calibration\.toml: cameras is 3, expected tables"),
    ],
)
def test_what_is_wrong_is_said(published: Path, file: str, change: Change, message: str) -> None:
    spoil(published.parents[1], file, change)
    with pytest.raises((InputError, FileNotFoundError), match=message):
        read_jbnu_depth360(given(published))
