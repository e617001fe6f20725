"""Exports of a room whose every distance is known in closed form; COLMAP, nerfstudio and Open3D read them back."""

import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from balls import RADIUS_M
from drives import ROOM, SEQUENCE, WALL_COLOURS, RoomDrive, wall_distance, write_room_drive
from rich.console import Console
from scenes import pinhole, transforms, tree
from scenes import write_scene as write_ball_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask, write_distance_png
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.export import command
from edge_depth_nerf.export.cloud import Cloud, figures_of, part_of
from edge_depth_nerf.export.command import export_scene
from edge_depth_nerf.export.cuts import cuts_of
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.export.pictures import ViewWriter
from edge_depth_nerf.export.priors import Priors
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import read_scene

pytestmark = pytest.mark.slow

QUIET = Console(quiet=True)
GENEROUS: dict[str, Any] = {"most_error": 0.5, "voxel_m": 0.25}
"""Without a calibration monocular maps have a standard deviation of a tenth."""


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=8, size=96, truth=True, beams=6000)


@pytest.fixture(scope="module")
def scene(room) -> Path:
    """The room's scene with exact monocular maps alone: a LiDAR point may lie anywhere in its pixel."""
    output, mono = room.root.parent / "scene", room.root.parent / "mono"
    for name in ("image_02", "image_03"):
        shutil.copytree(room.root / f"truth/{SEQUENCE}/{name}/distance", mono / name)
    options = Kitti360Options(root=room.root, sequence=SEQUENCE, output=output, mono=mono, sky=False, holdout_every=4)
    convert(options, QUIET)
    (output / "mono_trust.json").unlink(missing_ok=True)
    with transforms(output) as meta:
        for frame in meta["frames"]:
            del frame["lidar_file_path"], frame["depth_file_path"]
    return output


def export(scene: Path, output: Path, **options: Any) -> Path:
    return export_scene(ExportOptions(scene, output=output, **GENEROUS | options), QUIET)


def offset_m(scene: Path) -> np.ndarray:
    return np.array(read_json(scene / "transforms.json")["world_offset_m"])


def off_the_wall(points_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far points of the world are from the nearest wall of the room, that wall's inward normal and its colour."""
    away = np.abs(points_m[:, None, :] - ROOM)  # point, side, axis
    wall = away.reshape(len(points_m), 6).argmin(1)
    side, axis = wall // 3, wall % 3
    normal = np.zeros_like(points_m)
    normal[np.arange(len(points_m)), axis] = 1 - 2 * side
    return away.reshape(len(points_m), 6).min(1), normal, WALL_COLOURS[side, axis]


@pytest.fixture(scope="module")
def exported(scene) -> Callable[[str], Path]:
    """A folder for nerfstudio, of fisheyes or of three pinhole views of each."""
    return cache(lambda views: export(scene, scene.parent / f"nerfstudio_{views}", views=views, cuts=3))


# ---- the cloud -------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def cloud(scene) -> Path:
    return export(scene, scene.parent / "points", form="points") / "points.ply"


def test_points_lie_on_the_walls_and_their_normals_point_into_the_room(cloud):
    open3d = pytest.importorskip("open3d")
    read = open3d.io.read_point_cloud(str(cloud))
    points, normals, colours = (np.asarray(each) for each in (read.points, read.normals, read.colors))
    assert len(points) > 3000
    away, normal, colour = off_the_wall(points)
    # a pixel of 96 is as wide as 3 cm at 1 m, and maps have steps of 4 mm
    assert np.median(away) < 0.01 and np.percentile(away, 95) < 0.06 and away.max() < 0.5
    along = np.sum(normals * normal, 1)
    # they are fitted to 7 × 7 pixels, which is much of a picture of 96, and round at the edges of walls
    assert np.median(along) > 0.995 and np.percentile(along, 10) > 0.85 and (along > 0).mean() > 0.99
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-4)
    assert (np.abs(255 * colours - colour).max(1) < 3).mean() > 0.9
    # the walls that cameras see are all there
    assert (np.ptp(points, axis=0) > 0.9 * (ROOM[1] - ROOM[0])).sum() >= 2


def test_figures_of_the_cloud_are_written(cloud):
    points, _ = read_cloud(cloud)
    found = read_json(cloud.with_name("export_figures.json"))
    assert found["points"] == len(points) and found["text"].startswith(f"{len(points):,} points")
    assert 0 < found["lidar_median_off_m"] < 0.02


def test_lidar_beside_a_wall_is_off_by_its_distance(tmp_path):
    rng = np.random.default_rng(0)
    points = np.stack((rng.uniform(0, 4, 900), rng.uniform(0, 4, 900), np.zeros(900)), 1)
    flat = Cloud(points, np.zeros_like(points), np.tile([0.0, 0, 1], (900, 1)), np.full(900, 0.05))
    lidar = np.stack((rng.uniform(0, 4, 200), rng.uniform(0, 4, 200), rng.choice([-0.03, 0.03], 200)), 1)
    found = figures_of(flat, lidar)
    expected = {"points": 900, "median_sigma_m": 0.05, "lidar_median_off_m": 0.03}
    assert found == {**expected, "text": "900 points, 3.0 cm from LiDAR's (median)"}
    assert figures_of(flat, None)["text"] == "900 points"


def test_points_are_thinned_in_world_metres(scene, cloud, tmp_path):
    points, colours = read_cloud(cloud)
    cubes = np.unique(np.floor((points - offset_m(scene)) / 0.25), axis=0)
    # an average may be rounded across a border
    assert len(cubes) > 0.99 * len(points) and colours is not None
    fewer, _ = read_cloud(export(scene, tmp_path / "few", form="points", most_points=500) / "points.ply")
    assert 150 < len(fewer) <= 500 and np.median(off_the_wall(fewer)[0]) < 0.02


def test_what_other_pictures_see_through_is_no_point(scene, tmp_path):
    folder = read_scene(scene)
    priors = Priors(folder, tmp_path)
    training = [picture for picture in folder.pictures if not picture.held_out]
    for picture in training:
        priors.make(picture)
    picture = training[2]
    path = next(tmp_path.glob(f"{priors.stems[picture.name]}_distance.png"))
    right_m = read_distance_png(path)
    wrong_m = right_m.copy()
    block = (slice(30, 60), slice(30, 60))
    wrong_m[block] *= 0.5
    write_distance_png(path, wrong_m)
    found = part_of(priors, picture, training, 0.05, 0.5)
    away, _, _ = off_the_wall(found.points_m + offset_m(scene))
    # where no other picture looks, nothing can be said
    assert (right_m[block] > 0).sum() > 500 and (away > 0.5).sum() < 60
    alone = part_of(priors, picture, [picture], 0.05, 0.5)
    assert (off_the_wall(alone.points_m + offset_m(scene))[0] > 0.5).sum() > 200


def test_held_out_pictures_have_no_part_in_the_cloud(scene, cloud, tmp_path):
    changed = tmp_path / "scene"
    shutil.copytree(scene, changed)
    meta = read_json(changed / "transforms.json")
    for frame in meta["frames"]:
        if frame["file_path"] in meta["val_filenames"]:
            write_distance_png(changed / frame["mono_file_path"], np.full((96, 96), 1.0))
    again = export(changed, tmp_path / "points", form="points") / "points.ply"
    assert again.read_bytes() == cloud.read_bytes()


# ---- colmap ----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module", params=["fisheye", "pinhole"])
def model(request, scene) -> Iterator[tuple[Path, Any]]:
    """An exported COLMAP model, read by COLMAP."""
    pycolmap = pytest.importorskip("pycolmap")
    output = export(scene, scene.parent / f"colmap_{request.param}", form="colmap", views=request.param)
    yield output, pycolmap.Reconstruction(output / "sparse/0")


def to_camera(image: Any, points: np.ndarray) -> np.ndarray:
    pose = image.cam_from_world().matrix()
    return points @ pose[:, :3].T + pose[:, 3]


def test_colmap_finds_walls_where_the_pictures_show_them(scene, model):
    output, read = model
    kinds = {camera.model_name for camera in read.cameras.values()}
    is_fisheye = kinds == {"OPENCV_FISHEYE"}
    assert is_fisheye or kinds == {"PINHOLE"}
    assert len(read.images) == 16 * (1 if is_fisheye else 5)
    assert sorted(path.name for path in (output / "images").iterdir()) == sorted(i.name for i in read.images.values())
    rng = np.random.default_rng(0)
    walls = rng.uniform(ROOM[0], ROOM[1], (40_000, 3))
    axis, side = rng.integers(3, size=len(walls)), rng.integers(2, size=len(walls))
    walls[np.arange(len(walls)), axis] = ROOM[side, axis]
    compared, shown = 0, []
    for image in read.images.values():
        camera = read.cameras[image.camera_id]
        in_camera = to_camera(image, walls - offset_m(scene))
        pixels = camera.img_from_cam(in_camera)
        known = np.isfinite(pixels).all(1) & (in_camera[:, 2] > 0.1) & (pixels >= 1).all(1)
        known &= (pixels < np.array([camera.width, camera.height]) - 1).all(1)
        column, row = np.floor(pixels[known]).astype(int).T
        picture, mask = read_image(output / "images" / image.name), read_mask(output / f"masks/{image.name}.png")
        used = mask[row, column]
        # away from edges of walls, where pixels are mixtures
        same = (np.abs(picture[row, column].astype(int) - WALL_COLOURS[side[known], axis[known]]).max(1) <= 3)[used]
        compared += len(same)
        shown.append(same.mean() if len(same) else 1.0)
    assert compared > 50_000 and np.mean(shown) > 0.85


def test_depths_are_those_of_rays_that_colmap_casts(scene, model):
    output, read = model
    images = list(read.images.values())[::3]
    assert images
    for image in images:
        camera, pose = read.cameras[image.camera_id], image.cam_from_world().matrix()
        depth_m = read_distance_png(output / f"depths/{Path(image.name).stem}.png", 1e-3)
        row, column = np.nonzero(depth_m)
        plane = camera.cam_from_img(np.stack((column, row), 1) + 0.5)
        rays = np.hstack((plane, np.ones((len(plane), 1)))) @ pose[:, :3]
        lengths = np.linalg.norm(rays, axis=1)
        centre = offset_m(scene) - pose[:, :3].T @ pose[:, 3]
        true_m, _ = wall_distance(centre, rays / lengths[:, None])
        # z-depth in pinholes, distance in fisheyes
        true_m = true_m / lengths if camera.model_name == "PINHOLE" else true_m
        error = np.abs(depth_m[row, column] / true_m - 1)
        # the rest lies at the edges of walls
        assert len(row) > 0.4 * depth_m.size and (np.percentile(error, (50, 90)) < [0.002, 0.02]).all()
        sigma_m = read_distance_png(output / f"sigmas/{Path(image.name).stem}.png", 1e-3)[row, column]
        np.testing.assert_allclose(sigma_m, 0.1 * depth_m[row, column], rtol=0.15, atol=0.02)


@pytest.mark.parametrize("views", ["fisheye", "pinhole"])
def test_colmap_has_the_same_rays_and_they_end_at_the_same_colours(views, tmp_path):
    """A ball with smooth colours: pictures lie where COLMAP's cameras say. OpenCV draws them in steps of 1/32 pixel."""
    pycolmap = pytest.importorskip("pycolmap")
    lens = KannalaBrandt(160, 140, 45.0, 45.5, 80.3, 69.8, 0.02, -0.004, 0.0, 0.0, 1e-3, 2e-3)
    scene = write_ball_scene(tmp_path / "scene", [lens], frames=4, lidar=False, theta_max_deg=80.0)
    output = export(scene, tmp_path / "out", form="colmap", views=views, fov_deg=70.0)
    read, folder = pycolmap.Reconstruction(output / "sparse/0"), read_scene(scene)
    assert len(read.images) >= len(folder.pictures) > 0
    for image in read.images.values():
        camera, pose = read.cameras[image.camera_id], image.cam_from_world().matrix()
        (picture,) = [each for each in folder.pictures if image.name.startswith(Path(each.name).stem)]
        ours = next(cut.lens for cut in cuts_of(lens, folder.theta_max_rad, "colmap", views, 5, 70.0))
        mask = read_mask(output / f"masks/{image.name}.png")
        pixels = np.argwhere(mask)[:, ::-1] + 0.5
        rays, valid = ours.unproject(torch.from_numpy(pixels))
        assert valid.all() and mask.mean() > 0.25
        np.testing.assert_allclose(camera.img_from_cam(rays.numpy()), pixels, atol=1e-3)
        np.testing.assert_allclose(-pose[:, :3].T @ pose[:, 3], picture.position_m, atol=1e-9)
        around = [in_ball(camera, pose, pixels + step) for step in ((0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5))]
        slopes = np.stack((around[1] - around[2], around[3] - around[4]), -1)
        off = at(read_image(output / "images" / image.name), pixels).astype(float) + 0.5 - around[0]
        shift_px = np.linalg.lstsq(slopes.reshape(-1, 2), off.reshape(-1), rcond=None)[0]
        assert np.abs(shift_px).max() < 0.02 and np.abs(off).mean() < 1.0 and np.abs(slopes).mean() > 2


def in_ball(camera: Any, pose: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The colours of the ball where COLMAP's rays of pixels end."""
    plane = camera.cam_from_img(pixels)
    rays = np.hstack((plane, np.ones((len(plane), 1)))) @ pose[:, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = -pose[:, :3].T @ pose[:, 3]
    along = rays @ origin
    wall = origin + (-along + np.sqrt(along**2 + RADIUS_M**2 - origin @ origin))[:, None] * rays
    return 127 + 120 * np.sin(wall / RADIUS_M * [3.0, 4.0, 5.0] + [0.0, 1.0, 2.0])


def at(picture: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    column, row = np.floor(pixels).astype(int).T
    return picture[row, column]


def test_tracks_are_where_colmap_projects_their_points(scene, model):
    _, read = model
    assert len(read.points3D) > 3000
    lengths = [point.track.length() for point in read.points3D.values()]
    assert np.mean([length for length in lengths if length]) > 3
    assert sum(lengths) == sum(image.num_points3D for image in read.images.values())
    places = {number: point.xyz for number, point in read.points3D.items()}
    away, _, _ = off_the_wall(np.array(list(places.values())) + offset_m(scene))
    assert np.percentile(away, 95) < 0.06
    for image in read.images.values():
        seen = image.get_observation_points2D()
        points = np.array([places[each.point3D_id] for each in seen])
        pixels = read.cameras[image.camera_id].img_from_cam(to_camera(image, points))
        np.testing.assert_allclose(pixels, [each.xy for each in seen], atol=1e-3)


def test_held_out_pictures_are_listed(model):
    output, read = model
    held_out = (output / "sparse/0/test.txt").read_text().splitlines()
    assert set(held_out) < {image.name for image in read.images.values()}
    assert len(held_out) == len(read.images) // 4


def test_training_pictures_alone(scene, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    without = export(scene, tmp_path / "training", form="colmap", views="pinhole", cuts=1, pictures="training")
    names = {image.name for image in pycolmap.Reconstruction(without / "sparse/0").images.values()}
    assert len(names) == 12 and not (without / "sparse/0/test.txt").exists()


@pytest.mark.parametrize(("theta_max_deg", "fov_deg"), [(95.0, 90.0), (95.0, 60.0), (70.0, 90.0)])
def test_views_leave_no_gap_and_stay_within_the_lens(theta_max_deg, fov_deg):
    lens = KannalaBrandt(200, 200, 56.0, 56.0, 100.4, 99.3, -0.01, 0.01, -0.0025, 0.0)
    limit = np.radians(theta_max_deg)
    cuts = cuts_of(lens, limit, "nerfstudio", "pinhole", 5, fov_deg)
    assert [cut.name for cut in cuts] == ["_front", "_left", "_right", "_up", "_down"]
    # directions to the left, right, up and down, x right and y down
    for name, axis in (("_left", [-1, 0]), ("_right", [1, 0]), ("_up", [0, -1]), ("_down", [0, 1])):
        theta = np.linspace(0, min(limit, 1.4 * np.radians(fov_deg)), 200)[:-2]
        line = np.stack((*(np.sin(theta) * side for side in axis), np.cos(theta)), 1)
        seen = np.zeros(len(theta), bool)
        for cut in (each for each in cuts if each.name in ("_front", name)):
            pixels, valid = cut.lens.project(torch.from_numpy(line @ cut.view_to_camera))
            seen |= (valid & cut.lens.inside(pixels)).numpy()
        assert seen.all()
    whole = np.ones((200, 200), bool)
    assert all(cut.mask(whole).mean() > 0.99 for cut in cuts[:3])
    assert all(abs(cut.lens.width / 2 / cut.lens.fx / np.tan(np.radians(fov_deg / 2)) - 1) < 0.02 for cut in cuts)
    narrow = cuts_of(
        KannalaBrandt(200, 80, 56.0, 56.0, 100.4, 40.0, 0.0, 0.0, 0.0, 0.0), limit, "nerfstudio", "pinhole", 5, 90.0
    )
    assert [cut.name for cut in narrow] == ["_front", "_left", "_right"] and narrow[0].lens.height < narrow[
        0
    ].lens.width


# ---- nerfstudio ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("views", "files"), [("fisheye", "png"), ("pinhole", "png"), ("fisheye", "npy")])
def test_depth_nerfacto_reads_true_depth_by_default(scene, exported, views, files, tmp_path):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
    from nerfstudio.data.datasets.depth_dataset import DepthDataset

    output = exported(views) if files == "png" else export(scene, tmp_path / "out", views=views, depth_files=files)
    parser = NerfstudioDataParserConfig(data=output, load_3D_points=True).setup()
    count = 1 if views == "fisheye" else 3
    for split, pictures in (("train", 12), ("val", 4)):
        outputs = parser.get_dataparser_outputs(split)
        dataset = DepthDataset(outputs)
        assert len(dataset) == pictures * count
        scale, meta = outputs.dataparser_scale, read_json(output / "transforms.json")
        for index in range(0, len(dataset), 5):
            data = dataset.get_data(index)
            depth = dataset.get_metadata(data)["depth_image"][..., 0].numpy() / scale
            bundle = outputs.cameras.generate_rays(index)
            # nerfstudio's own rays, back in the scene, end at the walls
            back = np.linalg.inv(np.vstack((outputs.dataparser_transform.numpy(), [0, 0, 0, 1])))
            origin = bundle.origins.numpy() / scale @ back[:3, :3].T + back[:3, 3] + offset_m(scene)
            direction = bundle.directions.numpy() @ back[:3, :3].T
            true_m, _ = wall_distance(origin, direction / np.linalg.norm(direction, axis=-1, keepdims=True))
            true_m = true_m / bundle.metadata["directions_norm"][..., 0].numpy()
            known = data["mask"][..., 0].numpy() & (depth > 0)
            error = (depth / true_m - 1)[known]
            assert known.mean() > 0.4 and (np.percentile(np.abs(error), (50, 90)) < [0.002, 0.02]).all()
        assert len(outputs.metadata["points3D_xyz"]) > 3000
    frame = meta["frames"][0]
    sigma = output / frame["depth_sigma_file_path"]
    sigma_m = np.load(sigma) / 1e3 if files == "npy" else read_distance_png(sigma, 1e-3)
    depth = np.load(output / frame["depth_file_path"]) / 1e3 if files == "npy" else None
    assert sigma_m.max() > 0.02 and (depth is None or ((depth > 0) == (sigma_m > 0)).all())


@pytest.mark.parametrize("views", ["fisheye", "pinhole"])
def test_our_own_reader_takes_the_depth_for_distance(scene, exported, views):
    again = read_scene(exported(views))
    names = ("",) if views == "fisheye" else ("_front", "_left", "_right")
    assert {picture.camera for picture in again.pictures} == {f"image_0{n}{name}" for n in (2, 3) for name in names}
    for picture in again.pictures:
        distance_m = again.lidar_m(picture)
        world = again.rays(picture).directions.astype(float) * [1, -1, -1] @ picture.rotation.T
        true_m, _ = wall_distance(picture.position_m + offset_m(scene), np.where(world == 0, 1e-9, world))
        error = (distance_m / true_m - 1)[distance_m > 0]
        assert (np.percentile(np.abs(error), (50, 90)) < [0.002, 0.02]).all()
    assert len(again.pictures) == 16 * len(names)
    assert sum(picture.held_out for picture in again.pictures) == 4 * len(names)


def test_pinhole_pictures_lose_their_distortion(tmp_path):
    scene = write_ball_scene(tmp_path / "scene", [pinhole()])
    meta = read_json(export(scene, tmp_path / "out", views="pinhole", voxel_m=0.5) / "transforms.json")
    assert meta["camera_model"] == "OPENCV" and all(frame["k1"] == 0 for frame in meta["frames"])
    same = export(scene, tmp_path / "same", voxel_m=0.5)
    assert (same / "images/0000.png").read_bytes() == (scene / "images/0000.png").read_bytes()
    assert read_json(same / "transforms.json")["frames"][0]["k1"] == pinhole().k1


def test_what_millimetres_cannot_hold_is_reported(tmp_path, capsys):
    scene = write_ball_scene(tmp_path / "scene", mono=False)
    for path in (scene / "lidar").iterdir():
        write_distance_png(path, 20 * read_distance_png(path))
    options = ExportOptions(scene, output=tmp_path / "out")
    export_scene(options, Console(width=200))
    said = " ".join(capsys.readouterr().out.split())
    assert "further away than 65.5 m" in said and "--depth-files npy" in said
    depth_m = [read_distance_png(path, 1e-3) for path in (tmp_path / "out/depths").iterdir()]
    assert max(each.max() for each in depth_m) < 65.6
    export_scene(ExportOptions(scene, output=tmp_path / "npy", depth_files="npy"), QUIET)
    assert max(np.load(path).max() for path in (tmp_path / "npy/depths").iterdir()) > 100_000


# ---- runs that end early, and what cannot be used --------------------------------------------------------------
@pytest.mark.parametrize("form", ["nerfstudio", "colmap"])
def test_an_interrupted_run_continues(scene, exported, form, tmp_path, monkeypatch):
    options = {"form": form, "cuts": 3}
    whole = exported("fisheye") if form == "nerfstudio" else export(scene, tmp_path / "whole", **options)
    written: list[str] = []
    real = ViewWriter.write

    def write(writer: ViewWriter, views: Any) -> Any:
        if len(written) == 5:
            raise KeyboardInterrupt
        written.append(views[0].stem)
        return real(writer, views)

    monkeypatch.setattr(ViewWriter, "write", write)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    with pytest.raises(KeyboardInterrupt):
        export(scene, tmp_path / "out", **options)
    assert not (tmp_path / "out" / command.LAST[form]).exists()
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*.png")}
    monkeypatch.setattr(Priors, "make", None)  # all are made
    written.append("one more, and none stops it")
    export(scene, tmp_path / "out", **options)
    assert len(set(written)) == 17 and len(written) == 17
    kept = [path for path in times if path.exists()]
    assert len(kept) >= 20 and all(path.stat().st_mtime_ns == times[path] for path in kept)
    assert tree(tmp_path / "out") == tree(whole)
    # complete: nothing is done again
    monkeypatch.setattr(ViewWriter, "write", None)
    export(scene, tmp_path / "out", **options)


def test_other_options_or_another_state_of_the_scene_are_another_export(tmp_path):
    scene = write_ball_scene(tmp_path / "scene")
    output = export(scene, tmp_path / "out")
    with pytest.raises(InputError, match=r"holds other exports .views differs.. Give another --output"):
        export(scene, output, views="pinhole")
    os.utime(scene / "mono/0000.png", ns=(1, 1))
    with pytest.raises(InputError, match=r"holds other exports .files_of_the_scene differs"):
        export(scene, output)


def test_a_folder_with_something_else_is_refused(scene, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"mine: holds something else \(\S+\)\. Give another --output"):
        export(scene, tmp_path / "mine")
    with pytest.raises(InputError, match=r"notes\.txt: is a file"):
        export(scene, tmp_path / "mine/notes.txt")
    # nor into the scene itself
    with pytest.raises(InputError, match="holds something else"):
        export(scene, scene)


@pytest.mark.parametrize(
    ("of_scene", "options", "message"),
    [
        ({"lidar": False, "mono": False}, {}, r"so there is no prior to export. .*estimate-depth. adds"),
        ({"lidar": False}, {"most_error": 0.01}, r"the cloud is empty\. Give a larger --most-error"),
        ({"train_filenames": []}, {}, "has no training picture"),
    ],
)
def test_scenes_that_cannot_be_used(tmp_path, of_scene, options, message):
    scene = write_ball_scene(tmp_path / "scene", **of_scene)
    if "train_filenames" in of_scene:
        with transforms(scene) as meta:
            meta["val_filenames"] = meta["test_filenames"] = [frame["file_path"] for frame in meta["frames"]]
    with pytest.raises(InputError, match=message):
        export(scene, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists() or options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fov_deg": 170.0}, "--fov-deg 170.0: expected 20 to 120"),
        ({"voxel_m": 0.0}, "--voxel-m 0.0"),
        ({"most_error": float("nan")}, "--most-error nan"),
        ({"most_points": 0}, "--most-points 0"),
    ],
)
def test_options_that_cannot_be_used(scene, tmp_path, options, message):
    with pytest.raises(InputError, match=message):
        export(scene, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_pictures_of_one_name_in_two_folders_keep_their_own_files(tmp_path):
    scene = write_ball_scene(tmp_path / "scene", frames=4)
    with transforms(scene) as meta:
        for number, frame in enumerate(meta["frames"]):
            other = f"images/a_b/{number}.png" if number % 2 else f"images/a/b_{number - number % 2 + 1}.png"
            (scene / other).parent.mkdir(exist_ok=True)
            shutil.move(scene / frame["file_path"], scene / other)
            frame["file_path"] = other
        for key in ("train_filenames", "val_filenames", "test_filenames"):
            meta.pop(key)
    meta = read_json(export(scene, tmp_path / "out", voxel_m=0.5) / "transforms.json")
    assert len({frame["file_path"] for frame in meta["frames"]}) == 4 and "train_filenames" not in meta
    shown = [cv2.imread(str(tmp_path / "out" / frame["file_path"])) for frame in meta["frames"]]
    assert all((first != second).any() for first, second in pairwise(shown))
