"""Looking at a scene: its figures against independent numbers, its warnings, its pictures pixel by pixel."""

import io
import math
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from scenes import pinhole, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    read_distance_png,
    read_image,
    read_json,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.base.pictures import (
    DISTANCE,
    NO_VALUE_RGB,
    RELATIVE_ERROR,
    SIGMA,
    colour_bar,
    colour_distance,
    draw_points,
    drawn,
    legend,
    resize,
    text_bar,
    tinted,
)
from edge_depth_nerf.inspecting import figures
from edge_depth_nerf.inspecting.command import inspect_scene
from edge_depth_nerf.inspecting.figures import map_figures, measure, measured_frames
from edge_depth_nerf.inspecting.findings import Finding, find, limited
from edge_depth_nerf.inspecting.options import InspectOptions
from edge_depth_nerf.inspecting.pose_check import BAD_MEDIAN_PX, check_poses
from edge_depth_nerf.inspecting.sheets import draw_sheet
from edge_depth_nerf.inspecting.shown_prior import ShownScene
from edge_depth_nerf.inspecting.top_view import GAP, GREYS, HELD_OUT, PATH, TRAINING, pose_check_figure, top_view
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.method.prior import default_source
from edge_depth_nerf.poses.matches import EpipolarAgreement
from edge_depth_nerf.poses.path_agreement import compare_paths, write_agreement
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene

pytestmark = pytest.mark.slow


def look(scene: Path, output: Path | None, **options: Any) -> dict[str, Any]:
    return inspect_scene(InspectOptions(scene, output, **{"size": 64, **options}), Console(quiet=True))


def sheet_of_first(folder: Path, width_px: int) -> np.ndarray:
    """The sheet of a scene's first picture, without a look at the others."""
    scene = read_scene(folder)
    maps = ShownScene(scene).maps(scene.pictures[0])
    return draw_sheet(scene, measure(scene.pictures[0], maps), maps, width_px)


def warnings_of(scene: Path) -> list[Finding]:
    """What a look finds, without its pictures."""
    found = read_scene(scene)
    shown = ShownScene(found)
    return find(found, [measure(picture, shown.maps(picture)) for picture in found.pictures])


# ---- the sample drive ------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sample(sample_drive, tmp_path_factory):
    output = tmp_path_factory.mktemp("inspection") / "out"

    def files() -> list[Path]:
        return sorted(sample_drive.rglob("*"))

    before = files()
    console = Console(record=True, width=100, file=io.StringIO())
    summary = inspect_scene(InspectOptions(sample_drive, output, frames=2, size=64), console)
    assert files() == before  # a look changes nothing
    return summary, output, console.export_text()


def frames_of(scene: Path, camera: str) -> list[dict[str, Any]]:
    frames = read_json(scene / "transforms.json")["frames"]
    return sorted((frame for frame in frames if frame["camera"] == camera), key=lambda frame: frame["frame"])


def test_what_is_returned_is_what_is_written(sample):
    summary, output, _ = sample
    assert read_json(output / "summary.json") == summary
    assert len(summary["sheets"]) == 4
    for name in (*summary["sheets"], "top_view.png"):
        assert read_image(output / name).std() > 10
    assert summary["warnings"] == []
    # its poses agree with its pictures
    assert summary["epipolar"]["median_px"] < 0.3
    for camera in summary["cameras"].values():
        assert camera["epipolar"]["median_px"] < 0.3
        # pictures of 128 px have few features
        assert 8 <= camera["epipolar"]["steps"] <= 11
    assert len(summary["steps"]) == summary["epipolar"]["steps"]
    assert read_image(output / "poses.png").std() > 10


def test_a_pose_that_is_off_is_named(sample_drive, tmp_path):
    """One frame turned by 3°: 2 px at this size."""
    shutil.copytree(sample_drive, tmp_path / "drive", ignore=shutil.ignore_patterns(".cache"))
    turned = frames_of(sample_drive, "image_02")[6]["frame"]
    cosine, sine = math.cos(math.radians(3)), math.sin(math.radians(3))

    def mend(meta):
        for frame in meta["frames"]:
            if frame["frame"] == turned and frame["camera"] == "image_02":
                pose = np.array(frame["transform_matrix"])
                pose[:3, :3] = pose[:3, :3] @ [[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]
                frame["transform_matrix"] = pose.tolist()

    change(tmp_path / "drive", mend)
    scene = read_scene(tmp_path / "drive")
    (warning,) = [one for one in find(scene, [], check_poses(scene, Console(quiet=True))) if one.kind == "poses"]
    assert warning.cameras == ("image_02",)
    assert turned in warning.frames
    assert "--refine-poses" in warning.text


def agreements(medians_px: Sequence[float]) -> list[EpipolarAgreement]:
    return [EpipolarAgreement("left", n, n + 1, median_px) for n, median_px in enumerate(medians_px)]


@pytest.mark.parametrize(
    ("medians_px", "refined", "frames", "words"),
    [
        ([0.6] * 9 + [math.nan], False, (), "are 0.60 px from their epipolar lines (median"),
        ([0.2] * 9 + [1.3], False, (9, 10), "From frame 9 to 10 of left features are 1.3 px"),
        ([0.2] * 8 + [2.0, 1.3], False, (8, 9, 10), "and at 1 more steps"),
        ([0.6] * 9, True, (), "find new poses with --poses lidar or --poses colmap, and check the lens"),
    ],
)
def test_poses_that_disagree_with_the_pictures(drive, medians_px, refined, frames, words):
    # asked for, but not done without pycolmap
    change(drive, lambda meta: meta.update(source={"kind": "rig", "refine_poses": True}))
    if refined:
        write_json(drive / "refined_poses.json", {})
    (warning,) = find(read_scene(drive), [], agreements(medians_px))
    assert (warning.kind, warning.cameras, warning.frames) == ("poses", ("left",), frames)
    assert words in warning.text
    assert ("process the drive with --refine-poses" in warning.text) is not refined


def test_poses_that_agree_give_no_warning_and_are_drawn_where_they_are(drive):
    scene = read_scene(drive)
    assert find(scene, [], agreements([0.2, 0.3, 0.9, math.nan])) == []
    assert find(scene, [], agreements([math.nan] * 5)) == []
    (line, limit) = pose_check_figure(scene, agreements([0.2, math.nan, 0.6])).axes[0].lines
    assert np.asarray(line.get_xydata()).tolist() == [[0.5, 0.2], [2.5, 0.6]]
    assert line.get_label() == "left"
    assert np.asarray(limit.get_ydata())[0] == BAD_MEDIAN_PX


def test_its_counts(sample, sample_drive):
    summary, _, said = sample
    assert (summary["pictures"], summary["moments"], summary["training"], summary["held_out"]) == (24, 12, 22, 2)
    header = (sample_drive / "points.ply").read_bytes()[:200].decode("latin1")
    assert summary["points"] == int(header.split("element vertex ")[1].split()[0])
    recorded = read_json(sample_drive / "transforms.json")["camera_fits"]
    for name, camera in summary["cameras"].items():
        assert camera["fit_rms_px"] == recorded[name]["rms_px"]
        assert camera["fit_max_px"] == recorded[name]["max_px"]
        assert camera["angle_limit_deg"] == 95.0
        assert camera["size_px"] == [128, 128]
        assert (camera["model"], camera["original_model"]) == ("KANNALA_BRANDT", "MEI")
    for words in ("22 for training, 2 held out", "8.9 m (image_02)", "KANNALA_BRANDT for MEI", "128×128"):
        assert words in said
    assert "measured on all pictures" in said and "Error of the monocular maps" in said


@pytest.mark.parametrize("camera", ["image_02", "image_03"])
def test_its_maps(sample, sample_drive, camera):
    """Everything counted again with OpenCV, from the files."""
    coverages, monos, used, ratios, lidars, errors = [], [], [], [], [], []
    for frame in frames_of(sample_drive, camera):
        lidar, mono = (
            cv2.imread(str(sample_drive / frame[f"{layer}_file_path"]), cv2.IMREAD_UNCHANGED) / 256
            for layer in ("lidar", "mono")
        )
        mask = cv2.imread(str(sample_drive / frame["mask_path"]), cv2.IMREAD_GRAYSCALE) > 0
        coverages.append(((lidar > 0) & mask).sum() / mask.sum())
        monos.append(((mono > 0) & mask).sum() / mask.sum())
        used.append(mask.mean())
        both = (lidar > 0) & (mono > 0) & mask
        ratios.append(mono[both] / lidar[both])
        errors.append(np.abs(mono[both] - lidar[both]) / lidar[both])
        lidars.append(lidar[mask & (lidar > 0)])
    found = sample[0]["cameras"][camera]
    # pixels on the very rim of the lens circle may fall on either side
    expected = {"mean": np.mean(coverages), "min": min(coverages), "max": max(coverages)}
    assert found["lidar_coverage"] == pytest.approx(expected, rel=2e-3)
    assert found["used_share"]["mean"] == pytest.approx(np.mean(used), rel=2e-3)
    assert found["mono_over_lidar_median"] == pytest.approx(np.median(np.concatenate(ratios)), rel=1e-3)
    assert found["mono_against_lidar_abs_rel"] == pytest.approx(np.mean(np.concatenate(errors)), rel=5e-3)
    low, median, high = np.quantile(np.concatenate(lidars), (0.05, 0.5, 0.95))
    quantiles = found["lidar_distance_m"]
    assert [quantiles["p5"], quantiles["median"], quantiles["p95"]] == pytest.approx([low, median, high], rel=1e-3)
    # the sky has no monocular distance and no return, and so no prior
    assert 0.4 < min(monos) and max(monos) < 0.9
    assert found["mono_coverage"]["mean"] == pytest.approx(np.mean(monos), rel=2e-3)
    # maps that were made elsewhere count beyond LiDAR's field, too
    assert read_json(sample_drive / "transforms.json")["source"]["mono_trained_on"] == "elsewhere"
    assert found["prior_share"]["mean"] == pytest.approx(np.mean(monos), abs=0.005)
    assert found["no_prior_share"] == pytest.approx(1 - found["prior_share"]["mean"], abs=1e-3)
    assert 0.01 < found["prior_against_truth_abs_rel"] < 0.2
    assert 0.05 <= found["sigma_median_m"] < 5


def test_a_sheet_shows_the_maps(sample, sample_drive):
    """The picture is where it should be, and the truth beside it has the truth's colours."""
    sheet = read_image(sample[1] / "image_02_0000000003.png")
    # three rows of three panels of 64 px, the last of them empty, under two lines
    assert sheet.shape == (2 * 28 + 3 * (64 + 70 + 14), 3 * (64 + 14), 3)
    top, left = 2 * 28 + 7 + 30, 7
    picture = cv2.resize(
        read_image(sample_drive / "images/image_02/0000000003.png"), (64, 64), interpolation=cv2.INTER_AREA
    )
    assert (sheet[top : top + 64, left : left + 64] == picture).all()
    truth = read_distance_png(sample_drive / "truth/image_02/distance/0000000003.png")
    mask = cv2.imread(str(sample_drive / "masks/image_02.png"), cv2.IMREAD_GRAYSCALE) > 0
    below = top + 2 * (64 + 70 + 14)
    shown = sheet[below : below + 64, left : left + 64]
    expected = colour_distance(truth, mask)
    candidates = [expected[row::2, column::2] for row in (0, 1) for column in (0, 1)]
    assert max((shown == candidate).all(-1).mean() for candidate in candidates) > 0.99


# ---- small drives with one fault each --------------------------------------------------------------------------
SIZE = (16, 12)


def write_drive(folder: Path, numbers: int = 12, cameras: tuple[str, ...] = ("left",)) -> Path:
    """A straight drive along x, a step of 0.5 m every 0.1 s, whose every figure is known.

    The mask hides the lower two of twelve rows; every other usable pixel has a return at 8 m; mono says 8.4 m but for
    the upper three rows, the sky.
    """
    mask = np.ones(SIZE[::-1], bool)
    mask[-2:] = False
    lidar = np.where(mask & (np.indices(mask.shape).sum(0) % 2 == 0), 8.0, 0.0)
    mono = np.full(mask.shape, 8.4)
    mono[:3] = 0
    frames = []
    for camera in cameras:
        write_mask(folder / f"masks/{camera}.png", mask)
        for number in range(numbers):
            file = f"{camera}/{number:010d}.png"
            write_png(folder / "images" / file, np.full((*mask.shape, 3), 100, np.uint8))
            write_distance_png(folder / "lidar" / file, lidar)
            write_distance_png(folder / "mono" / file, mono)
            pose = np.eye(4)
            pose[:3, 3] = 0.5 * number, 1.0 * cameras.index(camera), 0
            maps = {f"{layer}_file_path": f"{layer}/{file}" for layer in ("lidar", "mono")}
            frame = {"file_path": f"images/{file}", "transform_matrix": pose.tolist(), **maps}
            frame |= {"mask_path": f"masks/{camera}.png", "camera": camera, "frame": number}
            frames.append({**frame, "timestamp_s": 50.0 + 0.1 * number})
    names = {held: [f["file_path"] for f in frames if (f["frame"] % 8 == 4) == held] for held in (False, True)}
    (folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "1.0 3.0 0.0\n4.0 -2.0 1.0\n"
    )
    meta: dict[str, Any] = {"camera_model": "PINHOLE", "w": SIZE[0], "h": SIZE[1]}
    meta |= {"fl_x": 8.0, "fl_y": 8.0, "cx": 8.0, "cy": 6.0}
    meta["camera_fits"] = {camera: {"rms_px": 0.01, "max_px": 0.03, "theta_max_deg": 90.0} for camera in cameras}
    meta |= {"train_filenames": names[False], "val_filenames": names[True], "test_filenames": names[True]}
    write_json(folder / "transforms.json", {**meta, "frames": frames, "ply_file_path": "points.ply"})
    return folder


def change(folder: Path, mend: Callable[[dict[str, Any]], None]) -> None:
    meta = read_json(folder / "transforms.json")
    mend(meta)
    write_json(folder / "transforms.json", meta)


@pytest.fixture
def drive(tmp_path) -> Path:
    return write_drive(tmp_path / "drive")


def test_a_drive_without_fault(drive):
    summary = look(drive, None, frames=1)
    assert read_json(drive.parent / "drive_inspection/summary.json") == summary
    assert not (drive / "summary.json").exists() and summary["warnings"] == []
    camera = summary["cameras"]["left"]
    path = {"camera": "left", "length_m": 5.5, "spacing_median_m": 0.5, "spacing_max_m": 0.5, "duration_s": 1.1}
    assert summary["path"] == {**path, "speed_mean_mps": 5.0, "speed_max_mps": 5.0}
    assert camera["lidar_coverage"] == {"mean": 0.5, "min": 0.5, "max": 0.5}
    assert camera["mono_coverage"]["mean"] == camera["prior_share"]["mean"] == pytest.approx(0.7)
    assert camera["no_prior_share"] == pytest.approx(0.3)
    assert camera["used_share"]["mean"] == pytest.approx(10 / 12, rel=1e-5)
    assert camera["hidden_share_of_lens"]["mean"] == pytest.approx(2 / 12, rel=1e-5)
    assert camera["mono_over_lidar_median"] == pytest.approx(8.4 / 8, rel=1e-3)
    assert camera["mono_against_lidar_abs_rel"] == pytest.approx(0.05, rel=1e-2)
    assert camera["lidar_distance_m"] == {"p5": 8.0, "median": 8.0, "p95": 8.0}
    assert summary["frames"][0]["brightness"] == 100


def shift_from(number: int, metres: float):
    def mend(meta):
        for frame in meta["frames"]:
            if frame["frame"] >= number:
                frame["transform_matrix"][0][3] += metres

    return mend


def turn_from(number: int, degrees: float):
    def mend(meta):
        cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        for frame in meta["frames"]:
            if frame["frame"] >= number:
                frame["transform_matrix"][0][:2] = [cosine, -sine]
                frame["transform_matrix"][1][:2] = [sine, cosine]

    return mend


def all_in(meta):
    names = [frame["file_path"] for frame in meta["frames"]]
    meta.update(train_filenames=names, test_filenames=names, val_filenames=names)


def without(*keys: str):
    def mend(meta):
        for entry in (meta, *meta["frames"]):
            for key in keys:
                entry.pop(key, None)

    return mend


def of_motion_alone(meta):
    for frame in meta["frames"]:
        frame["motion_file_path"] = frame.pop("mono_file_path")
        del frame["lidar_file_path"]


POSES_AND_LISTS = [
    (shift_from(5, 4.8), "gap", ("left",), (4, 5), "Frames 4 and 5 are 5.3 m apart, 11 times the usual 0.5 m"),
    (turn_from(9, 30), "turn", ("left",), (8, 9), "From frame 8 to 9 the camera turns by 30 degrees"),
    (lambda meta: meta["frames"][7].update(timestamp_s=50.6), "timestamps", ("left",), (7,), "not increase at frame 7"),
    (lambda meta: meta["camera_fits"]["left"].update(rms_px=0.2), "fit", ("left",), (), "0.20 px rms"),
    (all_in, "no_held_out", (), (), "--holdout-every"),
    (without("train_filenames", "val_filenames", "test_filenames"), "no_split", (), (), "every eighth"),
    (without("lidar_file_path"), "no_lidar", (), (), "no LiDAR"),
    (without("mono_file_path"), "no_mono", (), (), "--mono"),
    (without("mono_file_path", "lidar_file_path", "frame"), "no_prior", (), (), "plain nerfacto"),
    (of_motion_alone, "no_prior", (), (), "distances from motion alone"),
    (without("mask_path"), "no_mask", (), (), "--ego-mask"),
    (without("ply_file_path"), "no_points", (), (), "ply_file_path"),
    (lambda meta: meta["frames"][3].pop("mono_file_path"), "incomplete", (), (), "mono_file_path is given for 11 of"),
]


@pytest.mark.parametrize(("mend", "kind", "cameras", "frames", "words"), POSES_AND_LISTS, ids=lambda v: str(v)[:12])
def test_each_fault_gives_its_warning_alone(drive, mend, kind, cameras, frames, words):
    change(drive, mend)
    (warning,) = warnings_of(drive)
    assert (warning.kind, warning.cameras, warning.frames) == (kind, cameras, frames)
    assert words in warning.text


@pytest.mark.parametrize("mend", [shift_from(5, 4.4), turn_from(9, 15)], ids=["9.8 times", "a bend"])
def test_what_is_usual_gives_none(drive, mend):
    change(drive, mend)
    assert find(read_scene(drive), []) == []


def test_a_vehicle_that_stands_is_no_measure_of_gaps(drive):
    """Most of the drive at a red light, a millimetre a frame: driving on is not a gap."""

    def mend(meta):
        for frame in meta["frames"]:
            frame["transform_matrix"][0][3] = 0.001 * frame["frame"] + 0.5 * max(frame["frame"] - 8, 0)

    change(drive, mend)
    assert find(read_scene(drive), []) == []


def test_two_cameras_share_a_gap(tmp_path):
    scene = write_drive(tmp_path / "drive", cameras=("left", "right"))
    change(scene, shift_from(5, 7))
    (gap,) = find(read_scene(scene), [])
    assert gap.cameras == ("left", "right")


def rewrite(folder: Path, layer: str, numbers: tuple[int, ...], alter: Callable[[np.ndarray], np.ndarray]) -> None:
    for number in numbers:
        path = folder / layer / "left" / f"{number:010d}.png"
        if layer == "images":
            write_png(path, alter(read_image(path)))
        else:
            write_distance_png(path, alter(read_distance_png(path)))


def sparse(lidar):
    lidar[:, 2:] = 0
    return lidar


EVERY = tuple(range(12))
CONTENTS = [
    ("lidar", (6,), sparse, "lidar", (6,), "frame 6 of left; 50.00% is usual for training"),
    ("images", (2, 3), lambda picture: picture // 3, "dark", (2, 3), "frames 2, 3 of left is dark: mean grey 33"),
    ("images", (8,), lambda picture: picture * 2 + 30, "bright", (8,), "frame 8 of left is bright"),
    ("mono", EVERY, lambda mono: mono * 1.5, "mono_scale", (), "1.57 times LiDAR's in left"),
    ("mono", EVERY, lambda mono: mono * np.resize([0.6, 1, 1.6], mono.shape), "mono_shape", (), "by 40% in left"),
    ("mono", (1,), lambda mono: mono / 2, "mono_scale", (1,), "0.52 times LiDAR's in frame 1 of left"),
    ("lidar", EVERY, np.zeros_like, "lidar", (), "maps of left are empty"),
]


@pytest.mark.parametrize(("layer", "numbers", "alter", "kind", "frames", "words"), CONTENTS, ids=lambda v: str(v)[:12])
def test_maps_out_of_the_ordinary(drive, layer, numbers, alter, kind, frames, words):
    rewrite(drive, layer, numbers, alter)
    (warning,) = warnings_of(drive)
    assert (warning.kind, warning.frames) == (kind, frames)
    assert words in warning.text


def test_held_out_pictures_have_less_lidar_than_others(drive):
    """Their maps are of their own sweep alone: few points there are no fault, unless other held-out ones have more."""
    held_out = tuple(picture.frame for picture in read_scene(drive).pictures if picture.held_out)
    assert 0 < len(held_out) < 6
    rewrite(drive, "lidar", held_out, sparse)
    assert warnings_of(drive) == []
    meta = read_json(drive / "transforms.json")
    names = [frame["file_path"] for frame in meta["frames"]]
    split = {"train_filenames": names[:6], "val_filenames": names[6:], "test_filenames": names[6:]}
    change(drive, lambda meta: meta.update(split))
    rewrite(drive, "lidar", (8,), sparse)
    (warning,) = [each for each in warnings_of(drive) if "held-out pictures" in each.text]
    assert 8 in warning.frames


def test_an_inverted_mask(drive):
    mask = np.zeros(SIZE[::-1], bool)
    mask[-2:] = True
    write_mask(drive / "masks/left.png", mask)
    for number in range(12):
        write_distance_png(drive / f"lidar/left/{number:010d}.png", np.where(mask, 8.0, 0))
    (warning,) = warnings_of(drive)
    assert warning.kind == "mask" and "hides 83% of the lens" in warning.text


def test_of_many_warnings_of_a_kind_some_are_printed():
    findings = [Finding("gap", f"gap {number}") for number in range(8)] + [Finding("fit", "a fit")]
    lines = limited(findings)
    assert lines[:6] == ["gap 0", "gap 1", "gap 2", "gap 3", "gap 4", "a fit"]
    assert lines[6] == "3 more of the kind 'gap' are in summary.json."


# ---- what is measured and shown --------------------------------------------------------------------------------
@pytest.mark.parametrize(("numbers", "cameras", "measured"), [(200, 1, 64), (100, 2, 32), (12, 2, 12)])
def test_long_drives_are_sampled_evenly(tmp_path, numbers, cameras, measured):
    scene = read_scene(write_drive(tmp_path / "drive", numbers, ("left", "right")[:cameras]))
    chosen, shown = measured_frames(scene, 4)
    assert len(chosen) == measured
    assert chosen[0] == 0 and chosen[-1] == numbers - 1
    steps = np.diff(chosen)
    assert steps.max() - steps.min() <= 1
    assert len(shown) == 4 and set(shown) <= set(chosen)
    assert np.allclose(shown, numbers * np.array([1, 3, 5, 7]) / 8, atol=0.03 * numbers + 1)


def test_a_second_look_says_that_it_is_of_a_sample_and_leaves_no_sheets_of_the_first(tmp_path, monkeypatch):
    drive, output = write_drive(tmp_path / "drive", 3), tmp_path / "out"
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        stopped.setattr("edge_depth_nerf.inspecting.command.check_poses", Mock(side_effect=KeyboardInterrupt))
        look(drive, output, frames=50)
    assert len([*output.glob("left_*.png")]) == 3
    for name in ("notes.png", "poses.png"):
        (output / name).write_bytes(b"mine, or of poses that are not checked any more")
    monkeypatch.setattr(figures, "MEASURED_PICTURES", 2)
    summary = look(drive, output, frames=1)
    assert summary["measured"] == "measured on 2 of the 3 pictures, evenly over the drive"
    assert summary["maps"]["measured_pictures"] == len(summary["frames"]) == 2 and len(summary["sheets"]) == 1
    assert {path.name for path in output.iterdir()} == {*summary["sheets"], "top_view.png", "summary.json", "notes.png"}


def test_a_slow_camera_is_in_no_sample_and_each_has_sheets_of_its_own(tmp_path, monkeypatch):
    drive = write_drive(tmp_path / "drive", 5)

    def three_cameras(meta, numbers=(0, 0)):
        for frame, camera, number in ((1, "\u5f8c 2", numbers[0]), (2, "\u5f8c_2", numbers[1])):
            meta["frames"][frame] |= {"camera": camera, "frame": number}

    change(drive, three_cameras)
    sheets = look(drive, tmp_path / "out", frames=50)["sheets"]
    assert len({*sheets}) == len([*(tmp_path / "out").glob("*_0*.png")]) == 5
    change(drive, lambda meta: three_cameras(meta, (1, 2)))
    monkeypatch.setattr(figures, "MEASURED_PICTURES", 2)
    cameras = look(drive, tmp_path / "out", frames=1)["cameras"]
    assert [camera["prior_share"] is None for camera in cameras.values()] == [False, True, True]


@pytest.mark.parametrize(
    ("missing", "panels"),
    [
        ((), 6),
        (("mono_file_path",), 5),
        (("lidar_file_path",), 5),
        (("lidar_file_path", "mono_file_path"), 2),
        (("lidar_file_path", "mono_file_path", "mask_path"), 1),
    ],
)
def test_panels_of_what_is_missing_are_left_out(drive, missing, panels):
    change(drive, without(*missing))
    columns, rows = min(panels, 3), -(-panels // 3)
    assert sheet_of_first(drive, 200).shape == (2 * 28 + rows * (150 + 70 + 14), columns * (200 + 14), 3)


def test_distances_from_motion_have_a_panel(drive):
    before = sheet_of_first(drive, 200)
    pictures = read_scene(drive).pictures
    maps = ((each.name, np.full((each.lens.height, each.lens.width), 5, np.float32)) for each in pictures)
    write_maps(drive, "motion", maps, {"kind": "for a test"})
    after, scene = sheet_of_first(drive, 200), ShownScene(read_scene(drive))
    picture = scene.scene.pictures[0]
    assert map_figures([measure(picture, scene.maps(picture))])["motion_coverage"]["mean"] == 1
    # six panels in three columns; two more, motion and what the prior comes from, in a row of their own
    assert before.shape[1] == after.shape[1] == 3 * (200 + 14)
    row = after[-(150 + 70) :]
    assert after.shape[0] == before.shape[0] + 150 + 70 + 14 and not (row[:, 214:414] == 255).all()
    assert (row[:, 435:] == 255).all()


def test_a_sheet_and_a_view_from_above_are_as_wide_as_a_window(drive, tmp_path):
    """Wider ones would be shrunk, and their letters with them."""
    low = write_scene(tmp_path / "low", [pinhole(64, 28)], frames=1)
    spread_out = [replace(each, position_m=each.position_m * 50) for each in read_scene(drive).pictures]
    figure = top_view(replace(read_scene(drive), pictures=tuple(spread_out)), None, [], [])
    assert 1100 < drawn(figure).shape[1] < 1280
    for scene in (drive, low):
        assert sheet_of_first(scene, InspectOptions(scene).size).shape[1] == 3 * (410 + 14)


def test_the_sheet_says_what_a_prior_comes_from(drive):
    """Without a calibration each estimate counts where it is."""
    scene = read_scene(drive)
    before = ShownScene(scene).maps(scene.pictures[0])
    motion_m = np.zeros_like(before.usable, np.float32)
    motion_m[:, : motion_m.shape[1] // 2] = 5
    write_maps(drive, "motion", ((each.name, motion_m) for each in scene.pictures), {"kind": "for a test"})
    scene = read_scene(drive)
    shown = ShownScene(scene).maps(scene.pictures[0])
    assert before.origin is not None and shown.origin is not None and shown.prior is not None
    assert shown.lidar_m is not None and shown.mono_m is not None
    has_prior, lidar, mono, moved = (
        each > 0 for each in (shown.prior.distance_m, shown.lidar_m, shown.mono_m, motion_m)
    )
    expected = [lidar, ~lidar & mono & ~moved, ~lidar & mono & moved, ~lidar & ~mono & moved]
    for i, where in enumerate(expected):
        np.testing.assert_array_equal(shown.origin == i, where & has_prior, err_msg=str(i))
    assert np.isin([0, 1, 2, 3], shown.origin).all() and {*np.unique(before.origin)} == {-1, 0, 1}
    np.testing.assert_array_equal(shown.origin == -1, ~has_prior)


# ---- other people's scenes -------------------------------------------------------------------------------------
def test_z_depth_of_a_pinhole_scene_becomes_distance(tmp_path):
    scene = write_scene(tmp_path / "scene", [pinhole()], 2, False, False, mask=False, truth=False, split=False)
    meta = read_json(scene / "transforms.json")
    del meta["depth_unit_scale_factor"]
    depth_mm = np.full((28, 32), 5000, np.uint16)
    (scene / "depth").mkdir()
    # once as nerfstudio's PNG in millimetres, once as an array
    cv2.imwrite(str(scene / "depth/1.png"), depth_mm)
    np.save(scene / "depth/0.npy", depth_mm[..., None])
    for frame, name in zip(meta["frames"], ("0.npy", "1.png"), strict=True):
        frame |= {"depth_file_path": f"depth/{name}", "k1": 0.0}
    write_json(scene / "transforms.json", meta)
    inspected = read_scene(scene)
    x = (np.arange(32) + 0.5 - 16) / 20.0
    y = (np.arange(28)[:, None] + 0.5 - 14) / 20.5
    expected = 5 * np.sqrt(x**2 + y**2 + 1)
    for picture in inspected.pictures:
        maps = inspected.maps(picture)
        assert maps.lidar_m is not None and np.allclose(maps.lidar_m, expected, rtol=1e-4)
        assert default_source(picture.files) == "lidar"
    summary = look(scene, tmp_path / "out", frames=1)
    assert not summary["lengths_are_metres"]
    assert summary["held_out"] is None
    assert summary["maps"]["lidar_coverage"]["mean"] == 1.0
    assert {warning["kind"] for warning in summary["warnings"]} == {"no_mono", "no_mask", "no_points", "no_split"}


def test_cameras_and_frames_without_names(drive):
    """Cameras are then told by the folders of their pictures, frames by the order of the names."""
    change(drive, without("camera", "frame"))
    pictures = read_scene(drive / "transforms.json").pictures
    assert {picture.camera for picture in pictures} == {"images/left"}
    assert [picture.frame for picture in pictures] == list(range(12))


# ---- bad input -------------------------------------------------------------------------------------------------
SPOILT: dict[str, Callable[[Path], Any]] = {
    "process": shutil.rmtree,
    "not valid JSON": lambda drive: cut(drive / "transforms.json"),
    "no list of frames": lambda drive: change(drive, lambda meta: meta.update(frames=[])),
    "0000000003.png: no such file": lambda drive: (drive / "images/left/0000000003.png").unlink(),
    "points.ply: no such file": lambda drive: (drive / "points.ply").unlink(),
    "cannot be read as a PLY": lambda drive: cut(drive / "points.ply"),
    "EQUIRECTANGULAR": lambda drive: change(drive, lambda meta: meta.update(camera_model="EQUIRECTANGULAR")),
    "fl_x is None": lambda drive: change(drive, without("fl_x")),
    "transform_matrix": lambda drive: change(drive, lambda meta: meta["frames"][2].update(transform_matrix=[[1, 2]])),
    "9×9": lambda drive: write_png(drive / "images/left/0000000000.png", np.zeros((9, 9, 3), np.uint8)),
    "1000000000×1000000000": lambda drive: change(drive, lambda meta: meta.update(w=10**9, h=10**9)),
    "cannot be decoded": lambda drive: (drive / "mono/left/0000000000.png").write_bytes(b"no picture"),
    "timestamp_s is 'noon'": lambda drive: change(drive, lambda meta: meta["frames"][1].update(timestamp_s="noon")),
}
"""What makes a scene unusable, by what the error says."""


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: -min(200, path.stat().st_size // 3)])


@pytest.mark.parametrize("words", SPOILT)
def test_a_scene_that_cannot_be_read(drive, tmp_path, words):
    SPOILT[words](drive)
    with pytest.raises((InputError, FileNotFoundError)) as raised:
        look(drive, tmp_path / "out")
    assert words in str(raised.value) and str(drive) in str(raised.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [({"frames": 0}, "--frames 0"), ({"size": 9}, "--size 9"), ({"output": "points.ply"}, "is a file")],
)
def test_options_that_cannot_be_used(drive, options, words):
    with pytest.raises(InputError, match=words):
        look(drive, **{"output": drive / options.pop("output", "out"), **options})


# ---- drawing ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("map_size", "size"), [(128, 640), (128, 128), (1400, 700), (350, 640)])
def test_points_are_drawn_where_they_are(map_size, size):
    """Lone returns become discs around their own pixel's centre, in their own colour."""
    pixels = [(map_size // 8, map_size // 3), (map_size // 2, map_size - 10), (map_size - 12, 11)]
    distance = np.zeros((map_size, map_size), np.float32)
    for number, (row, column) in enumerate(pixels):
        distance[row, column] = (2.0, 11.0, 40.0)[number]
    picture = np.full((map_size, map_size, 3), 200, np.uint8)
    drawn = draw_points(picture, distance, (size, size))
    blank = draw_points(picture, np.zeros_like(distance), (size, size))
    assert drawn.shape == (size, size, 3)
    for row, column in pixels:
        colour = colour_distance(distance[row : row + 1, column : column + 1])[0, 0]
        ys, xs = np.nonzero((drawn == colour).all(-1))
        assert 5 <= len(ys) <= (0.02 * size) ** 2 + 30
        scale = size / map_size
        assert abs(ys.mean() + 0.5 - (row + 0.5) * scale) <= 0.5
        assert abs(xs.mean() + 0.5 - (column + 0.5) * scale) <= 0.5
        drawn[ys, xs] = blank[ys, xs]
    assert (drawn == blank).all()  # and nothing else


@pytest.mark.parametrize("map_size", [128, 350, 1400])
def test_dense_points_leave_the_picture_to_be_seen(map_size):
    picture = np.zeros((map_size, map_size, 3), np.uint8)
    distance = np.full((map_size, map_size), 5.0, np.float32)
    covered = (draw_points(picture, distance, (640, 640)) == colour_distance(distance)[0, 0]).all(-1).mean()
    assert 0.15 < covered < 0.6


def test_scales():
    for scale in (DISTANCE, SIGMA, RELATIVE_ERROR):
        values = np.array([[scale.low, scale.high, scale.low - 1e3, scale.high + 1e3]])
        colours = scale.coloured(values, np.ones(values.shape, bool))
        assert (colours[0, 2] == colours[0, 0]).all() and (colours[0, 3] == colours[0, 1]).all()
        assert (colours[0, 0] != colours[0, 1]).any()
        assert tuple(scale.coloured(values, np.zeros(values.shape, bool))[0, 0]) == NO_VALUE_RGB
    # √(1·60) m is half way, as 0 % is
    assert DISTANCE.position(np.array([60**0.5]))[0] == pytest.approx(0.5)
    assert RELATIVE_ERROR.position(np.array([0.0]))[0] == pytest.approx(0.5)
    assert np.ptp(RELATIVE_ERROR.coloured(np.zeros((1, 1)), np.ones((1, 1), bool)).astype(int)) < 5  # neutral


@pytest.mark.parametrize(("width", "ticks"), [(640, DISTANCE.ticks), (100, (1.0, 60.0))])
def test_a_legend_has_its_ticks_where_their_colours_are(width, ticks):
    bar = colour_bar(DISTANCE, width)
    assert bar.shape == (40, width, 3)
    coloured = np.nonzero(np.ptp(bar[10].astype(int), axis=-1) > 20)[0]
    # below the colours: the ticks, whose lines may share two columns
    dark = np.nonzero((bar[20, : coloured[-1] + 3] < 200).all(-1))[0]
    places = [group.mean() for group in np.split(dark, np.nonzero(np.diff(dark) > 2)[0] + 1)]
    low, high = coloured[0], coloured[-1] + 1
    expected = [low + (high - low) * np.log(tick) / np.log(60) for tick in ticks]
    assert np.array(places) + 0.5 == pytest.approx(expected, abs=1.5)
    for place, tick in zip(places, ticks, strict=True):
        at = int(np.clip(round(place), low, high - 1))
        steps = np.abs(DISTANCE.colours.astype(int) - bar[10, at]).sum(-1)
        assert steps.argmin() == pytest.approx(255 * np.log(tick) / np.log(60), abs=256 * 2 / (high - low) + 1)
    assert (bar[20, coloured[-1] + 3 :] == NO_VALUE_RGB).all(-1).any()


def test_a_legend_of_colours():
    drawn_legend = legend([("hidden", (205, 50, 60)), ("used, without prior", (60, 110, 230))], 640)
    first, second = ((drawn_legend == colour).all(-1).any(0).nonzero()[0] for colour in ((205, 50, 60), (60, 110, 230)))
    assert len(first) > 10 and len(second) > 10 and first.max() < second.min()


def test_drawings_of_several_threads_are_the_same():
    widths = [300 + 20 * number for number in range(8)] * 2
    expected = {width: colour_bar(SIGMA, width) for width in widths}
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda width: colour_bar(SIGMA, width), widths))
    assert all((one == expected[width]).all() for one, width in zip(found, widths, strict=True))


def test_maps_keep_their_values_when_they_shrink():
    distance = np.where(np.indices((40, 40))[1] < 20, 2.0, 50.0).astype(np.float32)
    assert set(np.unique(resize(distance, (13, 13)))) == {2.0, 50.0}
    assert resize(distance > 10, (13, 13)).dtype == np.bool_


def test_tints():
    picture = np.full((24, 24, 3), 100, np.uint8)
    where = np.zeros((24, 24), bool)
    where[:12] = True
    plain = tinted(picture, where, (200, 0, 0))
    assert (plain[12:] == 100).all() and (plain[:12] == (150, 50, 50)).all()
    hatched = tinted(picture, where, (0, 0, 200), hatched=True)
    assert (hatched[:12] == (0, 0, 200)).all(-1).mean() == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("text", ["a long title for a small place, σ in m, 90° ü", "$a$_{b", ""])
def test_text_that_is_too_long_becomes_smaller(text):
    bar = text_bar(text, 100)
    assert bar.shape == (30, 100, 3)
    columns = np.nonzero((bar != 255).any((0, 2)))[0]
    assert bool(len(columns)) == bool(text)
    assert not text or (columns.min() >= 1 and columns.max() < 99)


picture_of = cache(drawn)


def near(figure: Figure, x_m: float, y_m: float) -> set[str]:
    """Colours within a pixel of a place of the map."""
    picture = picture_of(figure)
    x, from_below = figure.axes[0].transData.transform((x_m, y_m))
    row, column = int(len(picture) - from_below), int(x)
    return {
        "#{:02x}{:02x}{:02x}".format(*one) for one in picture[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3)
    }


def test_the_top_view_is_to_scale(drive):
    """Dots at their places by the axes' numbers; the higher point is darker."""
    scene = read_scene(drive)
    figure = top_view(scene, scene.points_m(), [], shown=[])
    picture_of(figure)
    axes = figure.axes[0]
    (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
    assert x1 - x0 == pytest.approx(y1 - y0, rel=1e-6) and x1 - x0 > 20
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x, m", "y, m")
    assert TRAINING in near(figure, 0.0, 0.0) and TRAINING in near(figure, 5.5, 0.0)
    assert HELD_OUT in near(figure, 2.0, 0.0) and HELD_OUT not in near(figure, 2.5, 0.0)
    assert GREYS[0] in near(figure, 1.0, 3.0) and GREYS[-1] in near(figure, 4.0, -2.0)
    assert near(figure, 1.0, -3.0) == near(figure, 4.0, 2.0) == {"#ffffff"}
    words = {text.get_text() for text in figure.legends[0].get_texts()}
    assert words == {"points, higher ones darker", "view of left", "travel", "training", "held out"}
    figure = top_view(scene, None, [], shown=[1, 9])
    assert [text.get_text() for text in figure.axes[0].texts] == ["1", "9"]
    assert "frame with a sheet" in {text.get_text() for text in figure.legends[0].get_texts()}


def test_the_legend_of_six_cameras_is_whole(drive):
    """Of a drive to the north, whose map is narrow."""
    scene = read_scene(drive)
    cameras = [f"images/CAM_{place}" for place in ("FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK", "BACK_LEFT", "B" * 40)]
    pictures = [
        replace(picture, camera=camera, position_m=5 * picture.position_m[[1, 0, 2]])
        for camera in cameras
        for picture in scene.pictures
    ]
    figure = top_view(replace(scene, pictures=tuple(pictures)), None, [], [])
    drawn(figure)
    (legend,), axes = figure.legends, figure.axes[0]
    assert len(legend.get_texts()) == 6 + 3
    box, map_box = legend.get_window_extent(), axes.get_tightbbox()
    assert map_box is not None
    assert 0 <= box.x0 and box.x1 <= figure.bbox.width and 0 <= box.y0 and box.y1 < map_box.y0
    (x0, y0), (x1, y1) = axes.transData.transform([(0, 0), (1, 1)])
    assert x1 - x0 == pytest.approx(y1 - y0, rel=1e-6)


def test_the_top_view_marks_gaps(drive):
    """From 2 m to 9.5 m of a path from 0 to 12.5 m."""
    change(drive, shift_from(5, 7))
    scene = read_scene(drive)
    figure, without_findings = (top_view(scene, None, found, []) for found in (find(scene, []), []))
    assert [text.get_text() for text in figure.axes[0].texts] == ["7.5 m"]
    for x_m in (3.0, 9.0):
        assert GAP in near(figure, x_m, 0.0)
        assert PATH in near(without_findings, x_m, 0.0)
    for x_m in (1.75, 9.75):
        assert GAP not in near(figure, x_m, 0.0)


def test_how_far_another_path_lies(tmp_path):
    drive = write_drive(tmp_path / "drive", 1)  # a path without length
    summary = look(drive, tmp_path / "out")
    assert summary["paths_agree"] is None and summary["path"]["length_m"] == 0 and summary["moments"] == 1
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = np.arange(4)
    path = Trajectory(np.arange(4.0), poses)
    found = compare_paths(path, path)
    assert found is not None
    write_agreement(drive, found, path)
    console = Console(file=io.StringIO(), width=120)
    summary = inspect_scene(InspectOptions(drive, tmp_path / "out", size=64), console)
    assert summary["paths_agree"]["length_m"] == 3
    assert isinstance(console.file, io.StringIO)
    assert "0.00 m away (mean), 0.00 m at most, over 3.0 m" in console.file.getvalue()
