"""Recordings that are whole and wrong: what fits is named, with the right amount; good ones give no warning.

Then what `process` says of bad drives: broken JPEGs, inverted transforms, a vehicle that few pictures show, drives
without LiDAR, pictures of any exposure.
"""

from __future__ import annotations

import ast
import re
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from drives import SEQUENCE
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask, write_mask, write_png
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.inspecting.findings import find
from edge_depth_nerf.lidar import Sweep
from edge_depth_nerf.lidar.scans import columns_told
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.process import build, lidar_checks
from edge_depth_nerf.process.build import _never_held_out
from edge_depth_nerf.process.colmap.scale import _scan
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.feature_masks import FeatureMasks
from edge_depth_nerf.process.found_path import upright
from edge_depth_nerf.process.lidar_checks import LidarCheck, check_lidar
from edge_depth_nerf.process.mask_checks import mask_warnings
from edge_depth_nerf.process.options import Kitti360Options, RigOptions
from edge_depth_nerf.process.path_checks import path_warnings
from edge_depth_nerf.process.readings import Reading, _axes
from edge_depth_nerf.process.recording import DepthFile, Recording
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.process.vehicle import find_vehicle
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.scene.writer import ProcessReport
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

Change = Callable[[Recording], Recording]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("wrong") / "drive"
    synthesize_drive(SynthesizeOptions(root, "street", frames=11, size=128, layout="rig"))
    return root


@pytest.fixture(scope="module")
def whole(drive: Path) -> Recording:
    return read_rig_recording(RigOptions(root=drive, output=drive.parent / "unused"))


@pytest.fixture(scope="module")
def recording(whole: Recording) -> Recording:
    """One camera of it, which is enough."""
    return only(whole, "right")


def only(recording: Recording, *names: str) -> Recording:
    cameras = tuple(camera for camera in recording.cameras if camera.name in names)
    return replace(recording, cameras=cameras, pictures=tuple(one for one in recording.pictures if one.camera in names))


def shorter(recording: Recording, frames: range) -> Recording:
    """Nine sweeps, and pictures of some frames: enough for large faults, and half the work."""
    pictures = tuple(one for one in recording.pictures if one.frame in frames)
    return replace(recording, pictures=pictures, sweeps=recording.sweeps[:9])


@pytest.fixture(scope="module")
def brief(recording: Recording) -> Recording:
    return shorter(recording, range(0, 9, 2))


def checked(recording: Recording) -> LidarCheck:
    usable = {}
    for camera in recording.cameras:
        usable[camera.name] = lens_circle(camera.camera, 95.0)
        if camera.ego_mask is not None:
            usable[camera.name] &= read_mask(camera.ego_mask)
    return check_lidar(recording, usable)


def with_sweeps(change: Callable[[Sweep], Sweep]) -> Change:
    def changed(recording: Recording) -> Recording:
        sweeps = [replace(one, read=lambda one=one: change(one.read())) for one in recording.sweeps]
        return replace(recording, sweeps=tuple(sweeps))

    return changed


def moved(matrix: np.ndarray) -> Change:
    return with_sweeps(lambda sweep: replace(sweep, points_m=sweep.points_m @ torch.from_numpy(matrix).T))


def beside(metres: float) -> Change:
    """Points that lie further to the left: a scanner whose place is wrong."""
    return with_sweeps(lambda sweep: replace(sweep, points_m=sweep.points_m + torch.tensor([0.0, metres, 0.0])))


def about_z(degrees: float) -> np.ndarray:
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


turned_5 = moved(about_z(5))


def pictures_later(seconds: float) -> Change:
    return lambda recording: replace(
        recording, pictures=tuple(replace(one, time_s=one.time_s + seconds) for one in recording.pictures)
    )


def scanner_inverted(recording: Recording) -> Recording:
    sweeps = [replace(one, to_vehicle=np.linalg.inv(one.to_vehicle)) for one in recording.sweeps]
    return replace(recording, sweeps=tuple(sweeps))


# ---- LiDAR -------------------------------------------------------------------------------------------------------
def test_a_good_drive_gives_no_warning(whole: Recording) -> None:
    found = checked(shorter(whole, range(2, 6)))
    assert found.warnings == ()
    assert [one.camera for one in found.figures] == ["left", "right", "front"]
    for one in found.figures:
        assert one.correlation > 0.9 and one.edge is not None and one.edge > 1
        assert one.apart_m is not None and one.apart_m < 0.05
        assert one.ratio is None or one.ratio == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (moved(np.diag([1.0, -1, 1])), r"roof is given in other axes, where \(x, -y, z\) is x, y, z"),
        (moved(np.eye(3) * 3.28084), r"the points of roof in feet\? metres_per_unit = 0.3048"),
        (scanner_inverted, "to_vehicle of roof is inverted"),
    ],
)
def test_what_is_wrong_is_named(brief: Recording, change: Change, said: str) -> None:
    """A camera whose `to_vehicle` is inverted comes below, with `process`."""
    (warning,) = checked(change(brief)).warnings
    assert re.search(said, warning), warning


def test_turns_are_named() -> None:
    for degrees in (90, -90, 180):
        said = [said for axes, said in _axes() if np.allclose(axes[:3, :3], about_z(degrees))]
        assert said == [f"turned by {degrees}° about its z axis"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (turned_5, "roof is turned by -5.0° about its z axis"),
        (
            pictures_later(0.1),
            r"the clock of (roof .* add 0\.(09|1[0-2])|right .* add -0\.(09|1[0-2])) to its time_offset_s",
        ),
    ],
)
def test_small_faults_are_named_with_their_amount(recording: Recording, change: Change, said: str) -> None:
    (warning,) = checked(change(recording)).warnings
    assert re.search(said, warning), warning
    if change is turned_5:
        rows = np.array(ast.literal_eval(re.search(r"to_vehicle = (\[.*\])\)", warning)[1]))  # pyrefly: ignore
        assert np.allclose(rows, recording.sweeps[0].to_vehicle @ rigid(about_z(-5)), atol=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [(None, None), (beside(0.6), r"roof sits -0\.[4-7]\d m further along its y axis|right sits -0\.[4-7]\d m")],
)
def test_noisy_pictures_name_small_faults(
    recording: Recording, brief: Recording, monkeypatch: pytest.MonkeyPatch, change: Change | None, said: str | None
) -> None:
    """Contrast then never agrees well."""
    noise, read = np.random.default_rng(0), lidar_checks.read_image

    def noisy(path: Path) -> np.ndarray:
        clean = read(path)
        return (clean + noise.normal(0, 50, clean.shape)).clip(0, 255).astype(np.uint8)

    monkeypatch.setattr(lidar_checks, "read_image", noisy)
    found = checked(brief if change is None else change(recording))
    assert len(found.warnings) == (said is not None)
    assert said is None or re.search(said, found.warnings[0]), found.warnings
    assert said is not None or found.figures[0].correlation < 0.85


@pytest.mark.parametrize(
    ("by_contrast", "by_edges", "by_sweeps", "clear"),
    [(0.3, 0.05, 0.0, True), (0.1, 0.05, 0.5, True), (0.1, 0.05, 0.0, False), (0.1, 0.0, 0.5, False)],
)
def test_a_small_fault_is_told_by_contrast_and_edges_or_with_sweeps(
    by_contrast: float, by_edges: float, by_sweeps: float, clear: bool
) -> None:
    gains = by_contrast, by_edges, by_sweeps
    reading = Reading(both=True, clear=0.2)
    assert lidar_checks._Candidate(reading, "roof", (), np.eye(4), 1.0, gains, lack=0.1, still=0.5).clear is clear


def test_point_times_that_count_backwards_are_named(brief: Recording) -> None:
    def backwards(sweep: Sweep) -> Sweep:
        assert sweep.offset_s is not None
        return replace(sweep, offset_s=sweep.offset_s.max() + sweep.offset_s.min() - sweep.offset_s)

    (warning,) = checked(with_sweeps(backwards)(brief)).warnings
    assert "the point times of roof count backwards" in warning


def test_what_tells_nothing_is_not_judged(recording: Recording) -> None:
    assert recording.trajectory is not None
    assert checked(replace(recording, sweeps=())) == LidarCheck((), ())
    first = replace(recording, pictures=recording.pictures[:1])
    assert checked(first) == LidarCheck((), ())


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_columns_of_a_file_are_told(tmp_path: Path, recording: Recording, count: int) -> None:
    points = recording.sweeps[0].read()
    rng = np.random.default_rng(0)
    more = np.stack((points.reflectance, rng.integers(0, 32, len(points.reflectance)), 0 * points.reflectance), -1)
    columns = np.concatenate((points.points_m.numpy(), more), 1)[:, :count]
    path = tmp_path / "scan.bin"
    columns[rng.permutation(len(columns))].astype("<f4").tofile(path)
    assert columns_told(path) == count


def test_the_real_drive(real_data: Path) -> None:
    recording = read_rig_recording(RigOptions(root=real_data / "kitti360_drive", output=Path("unused")))
    found = checked(recording)
    assert found.warnings == () and found.figures[0].correlation > 0.9
    assert found.figures[0].ratio == pytest.approx(1, abs=0.05)
    sweeps = []
    for one in recording.sweeps:
        assert one.timing is not None
        sweeps.append(replace(one, timing=replace(one.timing, clockwise=False)))
    (warning,) = checked(replace(recording, sweeps=tuple(sweeps))).warnings
    assert "roof turns the other way: change its direction" in warning


# ---- depth maps --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("factor", "kind", "said"),
    [
        (1.0, "distance", None),
        (1000 / 256, "distance", "multiply metres_per_count by 0.2"),
        (1.0, "z_depth", "hold distance: set kind"),
    ],
)
def test_depth_maps_are_held_against_the_pictures(brief: Recording, factor: float, kind: str, said: str | None) -> None:
    pictures = [
        replace(one, depth=DepthFile(one.truth_distance, factor / 256, kind))  # pyrefly: ignore[bad-argument-type]
        for one in brief.pictures
    ]
    found = checked(replace(brief, pictures=tuple(pictures), sweeps=()))
    assert len(found.warnings) == (said is not None)
    assert said is None or said in found.warnings[0]


def test_a_largest_value_that_stands_for_none_is_noticed(recording: Recording, tmp_path: Path) -> None:
    pictures = []
    for one in recording.pictures:
        assert one.truth_distance is not None
        metres = read_distance_png(one.truth_distance)
        path = tmp_path / one.truth_distance.name
        cv2.imwrite(str(path), np.where((metres > 0) & (metres < 65), metres * 1000, 65535).astype(np.uint16))
        pictures.append(replace(one, depth=DepthFile(path, 0.001, "distance")))
    (warning,) = checked(replace(recording, pictures=tuple(pictures), sweeps=())).warnings
    assert "have one value, 65.5" in warning and "write 0 there" in warning


# ---- poses -------------------------------------------------------------------------------------------------------
def with_path(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    path = recording.trajectory
    assert path is not None
    return replace(recording, trajectory=Trajectory(path.times_s, change(path.vehicle_to_world.copy())))


def placed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    def changed(poses: np.ndarray) -> np.ndarray:
        poses[:, :3, 3] = change(poses[:, :3, 3])
        return poses

    return changed


def of_path(recording: Recording) -> list[str]:
    (camera,) = recording.cameras
    assert camera.ego_mask is not None
    said, _ = path_warnings(recording, {camera.name: lens_circle(camera.camera, 95.0) & read_mask(camera.ego_mask)})
    return said


def w_first(poses: np.ndarray) -> np.ndarray:
    given = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    poses[:, :3, :3] = Rotation.from_quat(given[:, [3, 0, 1, 2]]).as_matrix()
    return poses


def degrees(places: np.ndarray) -> np.ndarray:
    return places / [73e3, 111e3, 1] + [8.4, 49, 0]


def jump(places: np.ndarray) -> np.ndarray:
    return places + 20 * (np.arange(len(places)) > len(places) // 2)[:, None]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda poses: poses, None),
        (placed(lambda places: places * 1000), "in millimetres: metres_per_unit = 0.001"),
        (placed(degrees), "degrees of longitude and latitude"),
        (placed(lambda places: places * 0), "never moves"),
        (placed(jump), "The given path breaks between"),
        (w_first, "the poses' quaternions begin with w"),
    ],
)
def test_poses_no_vehicle_has_are_named(
    recording: Recording, change: Callable[[np.ndarray], np.ndarray], said: str | None
) -> None:
    found = of_path(with_path(recording, change))
    assert len(found) == (said is not None), found
    assert said is None or said in found[0]


def test_poses_of_a_sensor_are_named(recording: Recording) -> None:
    """And a mounting in millimetres."""
    (camera,) = recording.cameras
    (warning,) = of_path(with_path(recording, lambda poses: poses @ camera.to_vehicle))
    assert "on its side" in warning and 'the poses are those of right: poses.of = "right"' in warning
    to_vehicle = camera.to_vehicle.copy()
    to_vehicle[:3, 3] *= 1000
    (warning,) = of_path(replace(recording, cameras=(replace(camera, to_vehicle=to_vehicle),)))
    assert "to_vehicle of right puts it" in warning and "millimetres" in warning


# ---- masks -------------------------------------------------------------------------------------------------------
def test_given_masks_are_held_against_the_pictures(whole: Recording, tmp_path: Path) -> None:
    lenses = {camera.name: lens_circle(camera.camera, 95.0) for camera in whole.cameras}
    assert mask_warnings(whole, lenses) == []
    recording = only(whole, "right")
    (camera,) = recording.cameras
    assert camera.ego_mask is not None
    keep, path = read_mask(camera.ego_mask), tmp_path / "mask.png"

    def said(mask: np.ndarray) -> str:
        write_mask(path, mask)
        (warning,) = mask_warnings(replace(recording, cameras=(replace(camera, ego_mask=path),)), lenses)
        return warning

    assert "Is it inverted?" in said(~keep)
    keep[: int(0.7 * len(keep))] = False
    assert "of the lens" in said(keep)


# ==== what `process` says of them =================================================================================
@pytest.fixture
def mine(drive: Path, tmp_path: Path) -> Path:
    """A copy without what only rendered drives have."""
    root = Path(shutil.copytree(drive, tmp_path / "drive", ignore=shutil.ignore_patterns("truth", "mono")))
    edit(root, lambda text: re.sub(r"(?m)^(truth_|mono).*\n", "", text))
    return root


def edit(root: Path, change: Callable[[str], str]) -> None:
    (root / "rig.toml").write_text(change((root / "rig.toml").read_text()))


def run(root: Path, **changes) -> tuple[ProcessReport, str]:
    given: dict[str, Any] = {"root": root, "output": root.parent / "scene", "frames": 7, "sweeps": 1}
    given |= {"holdout_every": 4, "refine_poses": False}
    console = Console(width=10_000, force_terminal=False)
    with console.capture() as said:
        report = convert(RigOptions(**{**given, **changes}), console)
    return report, said.get()


# ---- broken pictures ---------------------------------------------------------------------------------------------
def test_a_cut_jpeg_is_left_out_and_named(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
    for path in sorted((mine / "images/front").iterdir()):
        cv2.imwrite(str(path.with_suffix(".jpg")), read_image(path)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        path.unlink()
    broken = mine / "images/front/000002.jpg"
    broken.write_bytes(broken.read_bytes()[:2000])
    assert cv2.imread(str(broken)) is not None, "OpenCV makes a picture of it"
    report, said = run(mine, cameras=("front",))
    assert [item.key for item in report.left_out] == ["front, frame 2"]
    assert re.search(r"Left out: front, frame 2\. .*000002\.jpg: cannot be decoded .*2000 bytes; truncated", said)
    frames = read_json(report.scene / "transforms.json")["frames"]
    assert [frame["frame"] for frame in frames] == [0, 1, 3, 4, 5, 6]
    assert not (report.scene / "images/front/0000000002.png").exists()
    with pytest.raises(InputError, match=r"000002\.jpg: cannot be decoded"):
        run(mine, output=mine.parent / "strict", strict=True, downscale=2, cameras=("front",))


# ---- when it is checked ------------------------------------------------------------------------------------------
def test_the_vehicle_is_masked_before_lidar_is_held_against_pictures(tmp_path: Path) -> None:
    synthesize_drive(SynthesizeOptions(tmp_path / "drive", "turn", frames=12, size=160))
    options = Kitti360Options(
        root=tmp_path / "drive", output=tmp_path / "scene", sequence=SEQUENCE, strict=True, motion=False
    )
    report = convert(replace(options, estimate_depth=False, refine_poses=False), Console(quiet=True))
    assert report.warnings == () and (report.scene / "ego_masks/image_02.png").is_file()


def test_lidar_is_checked_again_if_files_are_newer(mine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Masks that are found are not what was given: they may hide most of a lens."""
    says = LidarCheck((), ("LiDAR is turned.",))
    cameras, rim = ("right",), np.hypot(*(np.indices((128, 128)) - 63.5)) < 30
    monkeypatch.setattr("edge_depth_nerf.process.vehicle.dark_rim", lambda _: rim)
    edit(mine, lambda text: re.sub(r"(?m)^ego_mask.*\n", "", text))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(build, "check_lidar", lambda *_: signal.raise_signal(signal.SIGINT))
        run(mine, cameras=cameras, downscale=4)
    monkeypatch.setattr(build, "check_lidar", lambda *_: says)
    with pytest.raises(InputError, match=r"^LiDAR is turned\. Without --strict"):
        run(mine, strict=True, cameras=cameras)
    # nothing is left of it that would bind the corrected drive
    report, said = run(mine, cameras=cameras, downscale=2)
    assert report.warnings == says.warnings and said.count("LiDAR is turned.") == 2
    says = LidarCheck((), ())
    assert run(mine, cameras=cameras, downscale=2)[0].warnings == ("LiDAR is turned.",)
    with pytest.raises(InputError, match=r"^LiDAR is turned\. Without --strict"):
        run(mine, strict=True, cameras=cameras, downscale=2)
    next((mine / "lidar").iterdir()).touch()
    assert run(mine, cameras=cameras, downscale=2)[0].warnings == ()
    assert read_json(report.scene / "checks.json")["warnings"] == []


# ---- what is wrong with a recording ------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def seven(drive: Path) -> Recording:
    """Frames of all cameras."""
    return read_rig_recording(RigOptions(root=drive, output=drive.parent / "unused", frames=7))


def test_a_camera_that_is_never_held_out_is_named(seven: Recording) -> None:
    """As of two that take turns, when every 8th moment is always one of the first."""
    turns = [
        replace(picture, frame=2 * picture.frame + (picture.camera == "left"))
        for picture in seven.pictures
        if picture.camera != "front"
    ]
    alternating = replace(seven, pictures=tuple(turns))
    (notice,) = _never_held_out(alternating, {4, 12}, 4)
    assert notice.startswith("No picture of left is held out") and "--holdout-every 5" in notice
    assert _never_held_out(alternating, {4, 9}, 4) == _never_held_out(seven, {4}, 4) == []
    assert _never_held_out(alternating, set(), 4) == []


def test_a_scanner_may_hang_head_down(seven: Recording) -> None:
    """A path that is found is upright as the cameras are."""
    trajectory = seven.trajectory
    assert trajectory is not None
    sweeps = [replace(sweep, to_vehicle=sweep.to_vehicle @ np.diag([1.0, -1.0, -1.0, 1.0])) for sweep in seven.sweeps]
    turned = upright(replace(seven, sweeps=tuple(sweeps)), trajectory)
    assert turned.vehicle_to_world == pytest.approx(upright(seven, trajectory).vehicle_to_world)


@pytest.mark.parametrize("strict", [False, True])
def test_damaged_masks_and_scans_do_not_stop_what_looks_for_features(
    seven: Recording, tmp_path: Path, strict: bool
) -> None:
    """They are reported when their maps are made."""
    damaged = tmp_path / "mask.png"
    damaged.write_bytes(b"no PNG")
    options = RigOptions(root=tmp_path, output=tmp_path / "scene", strict=strict)
    masks = FeatureMasks(seven, options, {camera.name: 1.5 for camera in seven.cameras})
    picture = seven.pictures[0]
    assert masks.of(picture).any()
    if strict:
        with pytest.raises(InputError, match=r"mask\.png"):
            masks.of(replace(picture, mask=damaged))
    else:
        assert not masks.of(replace(picture, mask=damaged)).any()

    def unreadable() -> Sweep:
        raise InputError("none of its points can be used")

    assert _scan(replace(seven.sweeps[0], read=unreadable), seven.trajectory) is None
    assert _scan(seven.sweeps[0], seven.trajectory) is not None


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
    short = {"frames": 5, "cameras": ("left",)}
    with pytest.raises(InputError, match=r"to_vehicle of left is inverted.*Without --strict"):
        run(mine, strict=True, **short)
    assert not (mine.parent / "scene/transforms.json").exists()
    report, said = run(mine, **short)
    (warning,) = report.warnings
    assert "to_vehicle of left is inverted" in warning and warning in said
    # a scene that is done is not looked at again, and what was found is said again
    again, said = run(mine, **short)
    assert again.written == 0 and again.warnings == report.warnings and warning in said and len(found) == 2
    told = [one for one in find(read_scene(report.scene), []) if one.kind == "recording"]
    assert [one.text.startswith(warning) for one in told] == [True]


# ---- the vehicle -------------------------------------------------------------------------------------------------
def test_the_vehicle_is_found_in_few_pictures_with_lidars_help(mine: Path) -> None:
    edit(mine, lambda text: re.sub(r"ego_mask = .*\n", "", text))
    options = RigOptions(root=mine, output=mine.parent / "scene", frames=7, cameras=("right",), theta_max_deg=110.0)
    recording = read_rig_recording(options)
    (notice,) = find_vehicle(recording, recording.pictures, options, Console(quiet=True))[1]
    assert notice.startswith("right: the vehicle was detected")
    true, kept = read_mask(mine / "masks/right.png"), read_mask(options.output / "ego_masks/right.png")
    lens = lens_circle(recording.cameras[0].camera, 110.0)
    vehicle, hidden = lens & ~true, lens & ~kept
    assert (vehicle & hidden).sum() > 0.93 * (vehicle | hidden).sum()


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
    report, said = run(mine, motion=motion, cameras=("left",))
    (notice,) = [one for one in report.notices if "neither LiDAR nor depth maps" in one]
    assert words in notice and notice in said


# ---- exposure ----------------------------------------------------------------------------------------------------
def test_pictures_of_any_exposure_are_taken(mine: Path) -> None:
    """Black, saturated, and of four times the exposure from one picture to the next: no crash, no NaN, no warning."""
    for number, path in enumerate(sorted((mine / "images/left").iterdir())[:7]):
        picture = read_image(path).astype(float) * (0.0, 1.0, 0.25, 1.0, 4.0, 1000.0, 1.0)[number]
        write_png(path, picture.clip(0, 255).astype(np.uint8))
    edit(mine, lambda text: re.sub(r"ego_mask = .*\n", "", text))
    with np.errstate(invalid="raise", divide="raise", over="raise"):
        report, _ = run(mine, cameras=("left",), refine_poses=True)
    assert report.training + report.held_out == 7 and not report.left_out
    assert not any("to_vehicle inverted" in one or "do not lie" in one for one in report.notices)
    assert read_mask(report.scene / "masks/left.png").mean() > 0.2
    assert (read_distance_png(report.scene / "lidar/left/0000000000.png") > 0).any()
