"""What `process` reports of bad drives: broken JPEGs, inverted transforms, a vehicle that few pictures show, drives
without LiDAR, pictures of any exposure."""

import ast
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask, write_png
from edge_depth_nerf.inspecting.findings import find
from edge_depth_nerf.lidar import Sweep
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.process import build
from edge_depth_nerf.process.build import _never_held_out
from edge_depth_nerf.process.colmap.scale import _scan
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.feature_masks import FeatureMasks
from edge_depth_nerf.process.found_path import upright
from edge_depth_nerf.process.lidar_checks import LidarCheck, check_lidar
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.process.vehicle import find_vehicle
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.scene.writer import ProcessReport
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

FRAMES = 7


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("warned") / "drive"
    synthesize_drive(SynthesizeOptions(root, "street", frames=FRAMES, size=128, layout="rig"))
    # without what only rendered drives have
    keep = [line for line in (root / "rig.toml").read_text().splitlines() if not re.match("truth_|mono", line)]
    (root / "rig.toml").write_text("\n".join(keep))
    return root


@pytest.fixture
def mine(drive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(drive, tmp_path / "drive", ignore=shutil.ignore_patterns("truth", "mono")))


def edit(root: Path, change: Callable[[str], str]) -> None:
    (root / "rig.toml").write_text(change((root / "rig.toml").read_text()))


def run(root: Path, **changes) -> tuple[ProcessReport, str]:
    given = {"root": root, "output": root.parent / "scene", "sweeps": 1, "holdout_every": 4, "refine_poses": False}
    console = Console(width=10_000, force_terminal=False)
    with console.capture() as said:
        report = convert(RigOptions(**{**given, **changes}), console)
    return report, said.get()


# ---- broken pictures ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("downscale", [1, 2])
def test_a_cut_jpeg_is_left_out_and_named(mine: Path, downscale: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
    for path in sorted((mine / "images/front").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), read_image(path)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        path.unlink()
    broken = mine / "images/front/000002.jpg"
    broken.write_bytes(broken.read_bytes()[:2000])
    assert cv2.imread(str(broken)) is not None, "OpenCV makes a picture of it"
    changes = {"downscale": downscale, "cameras": ("front",)}
    report, said = run(mine, **changes)
    assert [item.key for item in report.left_out] == ["front, frame 2"]
    assert re.search(r"Left out: front, frame 2\. .*000002\.jpg: cannot be decoded .*2000 bytes; truncated", said)
    frames = read_json(report.scene / "transforms.json")["frames"]
    assert [frame["frame"] for frame in frames] == [0, 1, 3, 4, 5, 6]
    assert not (report.scene / "images/front/0000000002.png").exists()
    with pytest.raises(InputError, match=r"000002\.jpg: cannot be decoded"):
        run(mine, output=mine.parent / "strict", strict=True, **changes)


# ---- what is wrong with a recording --------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def recording(drive: Path) -> Recording:
    return read_rig_recording(RigOptions(root=drive, output=drive.parent / "unused"))


def test_a_camera_that_is_never_held_out_is_named(recording: Recording) -> None:
    """As of two that take turns, when every 8th moment is always one of the first."""
    turns = [
        replace(picture, frame=2 * picture.frame + (picture.camera == "left"))
        for picture in recording.pictures
        if picture.camera != "front"
    ]
    alternating = replace(recording, pictures=tuple(turns))
    (notice,) = _never_held_out(alternating, {4, 12}, 4)
    assert notice.startswith("No picture of left is held out") and "--holdout-every 5" in notice
    assert _never_held_out(alternating, {4, 9}, 4) == _never_held_out(recording, {4}, 4) == []
    assert _never_held_out(alternating, set(), 4) == []


def test_a_scanner_may_hang_head_down(recording: Recording) -> None:
    """A path that is found is upright as the cameras are."""
    trajectory = recording.trajectory
    assert trajectory is not None
    sweeps = [
        replace(sweep, to_vehicle=sweep.to_vehicle @ np.diag([1.0, -1.0, -1.0, 1.0])) for sweep in recording.sweeps
    ]
    turned = upright(replace(recording, sweeps=tuple(sweeps)), trajectory)
    assert turned.vehicle_to_world == pytest.approx(upright(recording, trajectory).vehicle_to_world)


@pytest.mark.parametrize("strict", [False, True])
def test_damaged_masks_and_scans_do_not_stop_what_looks_for_features(
    recording: Recording, tmp_path: Path, strict: bool
) -> None:
    """They are reported when their maps are made."""
    damaged = tmp_path / "mask.png"
    damaged.write_bytes(b"no PNG")
    options = RigOptions(root=tmp_path, output=tmp_path / "scene", strict=strict)
    masks = FeatureMasks(recording, options, {camera.name: 1.5 for camera in recording.cameras})
    picture = recording.pictures[0]
    assert masks.of(picture).any()
    if strict:
        with pytest.raises(InputError, match=r"mask\.png"):
            masks.of(replace(picture, mask=damaged))
    else:
        assert not masks.of(replace(picture, mask=damaged)).any()

    def unreadable() -> Sweep:
        raise InputError("none of its points can be used")

    assert _scan(replace(recording.sweeps[0], read=unreadable), recording.trajectory) is None
    assert _scan(recording.sweeps[0], recording.trajectory) is not None


def test_process_says_it_before_the_work(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[LidarCheck] = []

    def once(*given) -> LidarCheck:
        found.append(found[0] if found else check_lidar(*given))
        return found[0]

    monkeypatch.setattr(build, "check_lidar", once)
    rows = re.compile(r"(\[cameras\.left\].*?to_vehicle = )\[\n(.*?)\n\]", re.S)
    given = rows.search((mine / "rig.toml").read_text())
    assert given is not None
    matrix = np.array(ast.literal_eval(f"[{given[2]}]"))
    edit(mine, lambda text: rows.sub(lambda match: match[1] + str(np.linalg.inv(matrix).tolist()), text))
    with pytest.raises(InputError, match=r"to_vehicle of left is inverted.*Without --strict"):
        run(mine, strict=True, cameras=("left",))
    assert not (mine.parent / "scene/transforms.json").exists()
    report, said = run(mine, cameras=("left",))
    (warning,) = report.warnings
    assert "to_vehicle of left is inverted" in warning and warning in said
    # a scene that is done is not looked at again, and what was found is said again
    again, said = run(mine, cameras=("left",))
    assert again.written == 0 and again.warnings == report.warnings and warning in said and len(found) == 2
    told = [one for one in find(read_scene(report.scene), []) if one.kind == "recording"]
    assert [one.text.startswith(warning) for one in told] == [True]


# ---- the vehicle -------------------------------------------------------------------------------------------------
def without_masks(text: str) -> str:
    return re.sub(r"ego_mask = .*\n", "", text)


def test_the_vehicle_is_found_in_few_pictures_with_lidars_help(mine: Path) -> None:
    edit(mine, without_masks)
    options = RigOptions(root=mine, output=mine.parent / "scene", cameras=("left", "right"), theta_max_deg=110.0)
    recording = read_rig_recording(options)
    _, notices = find_vehicle(recording, recording.pictures, options, Console(quiet=True))
    assert [camera.name for camera in recording.cameras] == ["left", "right"]
    for camera in recording.cameras:
        true, kept = (read_mask(root / f"{camera.name}.png") for root in (mine / "masks", options.output / "ego_masks"))
        lens = lens_circle(camera.camera, 110.0)
        vehicle, hidden = lens & ~true, lens & ~kept
        assert (vehicle & hidden).sum() > 0.93 * (vehicle | hidden).sum()
        assert any(one.startswith(f"{camera.name}: the vehicle was detected") for one in notices)


# ---- no LiDAR ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("mono", "motion", "words"),
    [
        (True, True, "monocular maps only"),
        (False, True, "distances from motion only"),
        (False, False, "plain nerfacto"),
    ],
)
def test_neither_lidar_nor_depth_is_said(mine: Path, drive: Path, mono: bool, motion: bool, words: str) -> None:
    edit(mine, lambda text: text[: text.index("[lidars.roof]")])
    if mono:
        shutil.copytree(drive / "mono", mine / "mono")
        edit(mine, lambda text: re.sub(r"\[cameras\.(\w+)\]\n", r'[cameras.\1]\nmono = "mono/\1"\n', text))
    report, said = run(mine, motion=motion)
    (notice,) = [one for one in report.notices if "neither LiDAR nor depth maps" in one]
    assert words in notice and notice in said


# ---- exposure ----------------------------------------------------------------------------------------------------
def test_pictures_of_any_exposure_are_taken(mine: Path) -> None:
    """Black, saturated, and of four times the exposure from one picture to the next: no crash, no NaN, no warning."""
    for number, path in enumerate(sorted((mine / "images/left").iterdir())):
        picture = read_image(path).astype(float) * (0.0, 1.0, 0.25, 1.0, 4.0, 1000.0, 1.0)[number]
        write_png(path, picture.clip(0, 255).astype(np.uint8))
    edit(mine, without_masks)
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        report, _ = run(mine, cameras=("left",), refine_poses=True)
    assert report.training + report.held_out == FRAMES and not report.left_out
    assert not any("to_vehicle inverted" in one or "do not lie" in one for one in report.notices)
    assert read_mask(report.scene / "masks/left.png").mean() > 0.2
    assert (read_distance_png(report.scene / "lidar/left/0000000000.png") > 0).any()
