"""Whole cameras that are held out: nothing of the training sees their pictures, and they are evaluated apart."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import SEQUENCE, RoomDrive, without_lidar_check, write_room_drive
from models import pipeline_of
from rich.console import Console
from scenes import transforms, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image, read_json, write_png
from edge_depth_nerf.compare.evaluation import ViewEvaluator, choose_pixels
from edge_depth_nerf.compare.figures import affine_fitted
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.method.edges import picture_edges_found
from edge_depth_nerf.method.metrics import masked_psnr
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig, check_split
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.process import motion
from edge_depth_nerf.process.colmap import refine as refining
from edge_depth_nerf.process.converters import convert, read_drive
from edge_depth_nerf.process.found_path import with_all_cameras, with_path
from edge_depth_nerf.process.held_out import of_training_cameras
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import read_scene

QUIET = Console(quiet=True)
KEPT, HELD_OUT = "image_02", "image_03"

pytestmark = pytest.mark.slow


def options(drive: RoomDrive, output: Path, **changes: Any) -> Kitti360Options:
    given: dict[str, Any] = {"root": drive.root, "sequence": SEQUENCE, "output": output, "sweeps": 1}
    given |= {"holdout_every": 4, "holdout_cameras": (HELD_OUT,)}
    return Kitti360Options(**given | changes)


def process(drive: RoomDrive, output: Path, **changes: Any) -> Path:
    return convert(options(drive, output, **changes), QUIET).scene


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    without_lidar_check(monkeypatch)


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=6, size=64, truth=True)


@pytest.fixture(scope="module")
def scene(drive) -> Path:
    return process(drive, drive.root.parent / "scene")


def test_the_split_holds_out_the_camera_and_the_frames(scene):
    meta = read_json(scene / "transforms.json")
    split = {frame["file_path"]: (frame["camera"], frame["frame"]) for frame in meta["frames"]}
    assert {split[name] for name in meta["train_filenames"]} == {(KEPT, frame) for frame in (0, 1, 3, 4, 5)}
    held_out = {(HELD_OUT, frame) for frame in range(6)} | {(KEPT, 2)}
    assert {split[name] for name in meta["test_filenames"]} == held_out
    assert meta["val_filenames"] == meta["test_filenames"] and meta["source"]["holdout_cameras"] == [HELD_OUT]
    assert read_scene(scene).held_out_cameras() == {HELD_OUT}


def test_what_a_training_reads_is_the_same_whatever_the_held_out_pictures_show(drive, scene, tmp_path):
    """The camera's pictures are replaced by others: no other file changes, nor does the point cloud."""
    before = {path: path.read_bytes() for path in (drive.root / "data_2d_raw").rglob("*.png")}
    try:
        for path in before:
            if HELD_OUT in path.parts:
                write_png(path, 255 - read_image(path)[::-1])
        other = process(drive, tmp_path / "other")
    finally:
        for path, content in before.items():
            path.write_bytes(content)
    names = [path.relative_to(scene) for path in scene.rglob("*") if path.is_file() and HELD_OUT not in str(path)]
    assert {Path("points.ply"), Path(f"lidar/{KEPT}/0000000001.png"), Path("transforms.json")} <= {*names}
    changing = {Path("process.json"), Path("refined_poses.json"), Path("checks.json")}
    for name in (name for name in names if name not in changing):
        if name == Path("transforms.json"):
            one, two = (read_json(folder / name)["frames"] for folder in (scene, other))
            assert one == two
        else:
            assert (scene / name).read_bytes() == (other / name).read_bytes(), name


def test_the_cloud_is_that_of_a_drive_without_the_camera(drive, scene, tmp_path):
    alone = process(drive, tmp_path / "alone", cameras=(KEPT,), holdout_cameras=())
    both = process(drive, tmp_path / "both", holdout_cameras=())
    world = []
    for folder in (scene, alone, both):
        points, _ = read_cloud(folder / "points.ply")
        world.append(
            {tuple(place) for place in (points + read_json(folder / "transforms.json")["world_offset_m"]).round(3)}
        )
    assert len(world[0] & world[1]) > 0.95 * len(world[0] | world[1]) and len(world[2]) > 1.5 * len(world[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"holdout_cameras": ("image_04",)},
            "--holdout-cameras image_04: there is no such camera. .* image_02, image_03",
        ),
        ({"cameras": (KEPT,)}, "--holdout-cameras image_03: there is no such camera. .* in use are image_02"),
        ({"holdout_cameras": (KEPT, HELD_OUT)}, "image_02 image_03: no camera is left for training"),
    ],
)
def test_cameras_that_cannot_be_held_out(drive, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        process(drive, tmp_path / "scene", **changes)
    assert not (tmp_path / "scene").exists()


def test_with_every_frame_for_training_the_camera_alone_is_evaluated(drive, tmp_path):
    report = convert(options(drive, tmp_path / "scene", holdout_every=0, frames=2, refine_poses=False), QUIET)
    assert (report.training, report.held_out) == (2, 2)
    assert not [notice for notice in report.notices if "held out" in notice]


def test_poses_are_refined_without_its_pictures(drive, tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    seen: list[set[str]] = []

    def matched(posed: Any, pairs: Any, *_: Any) -> list:
        seen.append({posed[index].camera for pair in pairs for index in pair})
        return []

    monkeypatch.setattr(refining, "match_pictures", matched)
    for held_out in ((), (HELD_OUT,)):
        asked = options(drive, tmp_path, holdout_cameras=held_out)
        recording = read_drive(asked)
        given = np.stack([drive.poses[frame] for frame in drive.frames])
        assert refining._match(recording, asked, QUIET, tmp_path / "matches") == []
    assert seen == [{KEPT, HELD_OUT}, {KEPT}]
    digests = {
        refining._digest("1", recording, options(drive, tmp_path, holdout_cameras=names), given)
        for names in ((), (HELD_OUT,))
    }
    assert len(digests) == 2


def test_colmap_finds_poses_without_its_pictures_and_the_rig_places_them(drive, tmp_path):
    asked = options(drive, tmp_path)
    whole = read_drive(asked)
    without = of_training_cameras(whole, asked)
    assert {picture.camera for picture in without.pictures} == {KEPT} == {camera.name for camera in without.cameras}
    # as if frame 3 had found no pose
    assert without.trajectory is not None
    found = with_path(without, without.trajectory, lambda picture: "lost" if picture.frame == 3 else None)
    again = with_all_cameras(found, whole)
    assert {(p.camera, p.frame) for p in again.pictures} == {(c, f) for c in (KEPT, HELD_OUT) for f in (0, 1, 2, 4, 5)}
    assert {(item.camera, item.frame, item.reason) for item in again.skipped} == {
        (c, 3, "lost") for c in (KEPT, HELD_OUT)
    }
    for picture in again.pictures:
        np.testing.assert_allclose(again.pose(picture), drive.camera_to_world(picture.camera, picture.frame), atol=1e-6)


def test_motion_is_found_in_training_pictures_alone(scene, monkeypatch):
    seen = []
    monkeypatch.setattr(motion, "Motion", lambda positions, cameras, _: seen.extend(cameras) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        motion.add_motion(read_scene(scene), QUIET)
    assert seen == [KEPT] * 5


def dataset(scene: Path, split: str) -> FisheyeDepthDataset:
    return FisheyeDepthDataset(FisheyeDepthDataParserConfig(data=scene).setup().get_dataparser_outputs(split=split))


def test_lidar_that_training_saw_evaluates_nothing(scene):
    held_out = dataset(scene, "val")
    assert {held_out.pictures[number].camera for number in held_out.of_held_out_cameras} == {HELD_OUT}
    with_lidar = {
        (each.camera, each.frame) for i, each in enumerate(held_out.pictures) if "lidar_distance_m" in held_out[i]
    }
    assert with_lidar == {(KEPT, 2), (HELD_OUT, 2)}
    assert all("truth_distance_m" in held_out[number] for number in range(len(held_out)))
    trained = dataset(scene, "train")
    assert not trained.of_held_out_cameras and all("lidar_distance_m" in trained[i] for i in range(len(trained)))


def test_a_frame_in_both_lists_is_still_an_error(scene):
    meta, path = read_json(scene / "transforms.json"), scene / "transforms.json"
    check_split(meta, path)
    meta["test_filenames"] = [*meta["test_filenames"], meta["train_filenames"][1]]
    with pytest.raises(InputError, match=r"frame 1 is in train_filenames and in test_filenames"):
        check_split(meta, path)


def with_a_held_out_camera(folder: Path, only: bool = False) -> Path:
    """A scene whose last three pictures are of a camera of their own; with `only` no other picture is held out."""
    scene = write_scene(folder, frames=12)
    with transforms(scene) as meta:
        for number, frame in enumerate(meta["frames"]):
            frame |= {"camera": "right" if number > 8 else "left", "frame": number}
        names = [frame["file_path"] for frame in meta["frames"]]
        held_out = [*([] if only else names[4:5]), *names[9:]]
        meta["train_filenames"] = [name for name in names if name not in held_out]
        meta["val_filenames"] = meta["test_filenames"] = held_out
    return scene


def test_its_views_have_figures_of_their_own(tmp_path):
    pipeline = pipeline_of(with_a_held_out_camera(tmp_path / "scene"))
    data, told = pipeline.datamanager.eval_dataset, []
    figures, bins = ViewEvaluator(pipeline, lambda: told.append(1)).held_out(tmp_path / "views")
    assert len(told) == 4 and len(list((tmp_path / "views").glob("eval_img_*.png"))) == 4
    expected: dict[str, list[float]] = {"": [], "camera_": []}
    edges = {"": np.zeros(2), "camera_": np.zeros(2)}
    with evaluated(pipeline.model):
        for number in range(4):
            item, prefix = data[number], "camera_" if number else ""
            rgb = pipeline.model.get_outputs_for_camera(data.cameras[number : number + 1])["rgb"].clamp(0, 1)
            mask = item["mask"][..., 0]
            fitted = affine_fitted(rgb, item["image"], mask)
            expected[prefix].append(float(masked_psnr(fitted, item["image"], mask)))
            edges[prefix] += picture_edges_found(fitted, item["image"], mask)
    for prefix, values in expected.items():
        assert figures[f"{prefix}affine_masked_psnr"] == pytest.approx(np.mean(values), abs=1e-3)
        assert edges[prefix][1] == 0 or figures[f"{prefix}edge_recall"] == edges[prefix][0] / edges[prefix][1]
    # distances and bins of the others alone
    assert sum(entry["pixels"] for entry in bins["by_angle_deg"]) <= data.mask(0).sum()
    assert {int(view.indices[0, 0]) for view in choose_pixels(data)} == {0}
    assert figures["camera_truth_pixels"] > 2 * figures["truth_pixels"]


def test_where_no_other_view_is_held_out_they_are_the_evaluation(tmp_path):
    pipeline = pipeline_of(with_a_held_out_camera(tmp_path / "scene", only=True))
    told: list[int] = []
    figures, _ = ViewEvaluator(pipeline, lambda: told.append(1)).held_out(tmp_path / "views")
    assert len(told) == 3 and figures["camera_masked_psnr"] == figures["masked_psnr"]
    assert len(choose_pixels(pipeline.datamanager.eval_dataset)) == 3
    assert torch.isfinite(torch.tensor(list(figures.values()))).all()
