"""The scanners' own rays in a scene, and scans rendered of it: a room whose every distance is known in closed form."""

import math
import shutil
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from drives import SEQUENCE, RoomDrive, cut, pose, wall_distance, write_points, write_room_drive
from PIL import Image
from rich.console import Console
from trainings import write_config

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.base.pictures import NO_VALUE_RGB
from edge_depth_nerf.films import scan_command
from edge_depth_nerf.films.intensities import Intensities
from edge_depth_nerf.films.options import RenderLidarOptions
from edge_depth_nerf.films.scan_command import render_lidar
from edge_depth_nerf.films.scan_film import SIZE_PX, draw_scan
from edge_depth_nerf.films.scanning import RayDrop, came_back, recorded_pattern
from edge_depth_nerf.lidar.patterns import ScanPattern
from edge_depth_nerf.lidar.roughness import roughness
from edge_depth_nerf.lidar.scans import PointTimes, ScanFormat, read_scan
from edge_depth_nerf.plugin import viewer
from edge_depth_nerf.plugin.scanning import FOLIAGE, Caster, HeldOutRays, SceneToModel, evaluate_scans
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.scene.sweeps import SceneScanner, SceneSweep, SweepRays, scanners_of

QUIET = Console(quiet=True)
PATTERN = ScanPattern("test", np.radians(np.linspace(15.0, -25.0, 12)), 240, 100.0)
LOST_M = 18.0
"""The scanner loses what is further away."""
FRAMES = 9


def measure(drive: RoomDrive, frame: int) -> np.ndarray:
    """What the turning scanner measures, ring by ring, each firing from where the scanner is at its time."""
    to_world = np.stack([drive.velo_to_world(frame + offset / 0.1) for offset in PATTERN.offset_s])
    rays = np.einsum("fij,rfj->rfi", to_world[:, :3, :3], PATTERN.directions)
    distance, _ = wall_distance(np.broadcast_to(to_world[None, :, :3, 3], rays.shape), rays)
    points = (PATTERN.directions * distance[..., None]).reshape(-1, 3)
    return points[distance.reshape(-1) <= LOST_M]


def process(drive: RoomDrive, output: Path, **options: Any) -> SceneScanner:
    given: dict[str, Any] = {"root": drive.root, "sequence": SEQUENCE, "output": output, "sweeps": 0}
    given |= {"holdout_every": 4, "find_ego": False, "refine_poses": False, "motion": False}
    convert(Kitti360Options(**given | options), QUIET)
    scene = read_scene(output)
    return scanners_of(scene.meta, scene.path)["velodyne"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> RoomDrive:
    room = write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=FRAMES, size=32)
    for frame in room.frames:
        write_points(room.sweep(frame), measure(room, frame))
    return room


@pytest.fixture(scope="module")
def scanner(drive) -> SceneScanner:
    return process(drive, drive.root.parent / "scene", holdout_beams=5)


def offset_m(scanner: SceneScanner) -> np.ndarray:
    return np.array(read_json(scanner.sweeps[0].path.parents[2] / "transforms.json")["world_offset_m"])


# ---- rays in the scene -----------------------------------------------------------------------------------------
def test_rays_are_where_and_when_the_scanner_measured(drive, scanner):
    assert len(scanner.sweeps) == FRAMES and [sweep.frame for sweep in scanner.sweeps] == list(drive.frames)
    assert [sweep.held_out for sweep in scanner.sweeps] == [frame % 4 == 2 for frame in drive.frames]
    for sweep in scanner.sweeps:
        rays = sweep.read()
        np.testing.assert_allclose(
            sweep.scanner_to_scene[:3, 3] + offset_m(scanner), drive.velo_to_world(sweep.frame)[:3, 3], atol=1e-6
        )
        there = np.stack([drive.velo_to_world(sweep.frame + offset / 0.1)[:3, 3] for offset in rays.offset_s])
        np.testing.assert_allclose(rays.origin_m + offset_m(scanner), there, atol=1e-4)
        distance, _ = wall_distance(rays.origin_m + offset_m(scanner), rays.direction.astype(np.float64))
        np.testing.assert_allclose(rays.distance_m, distance, atol=2e-3)
        assert np.ptp(rays.offset_s) > 0.09 and (rays.intensity == 0.5).all()
        assert rays.ring.min() == 0 and rays.ring.max() == len(PATTERN.elevation_rad) - 1
        # some beams of every sweep are held out, and none of these points is in a map
        assert 0.05 < rays.held_out.mean() < 0.4


def test_raw_lidar_takes_a_turn_as_one_moment(drive, tmp_path):
    rays = process(drive, tmp_path / "scene", raw_lidar=True).sweeps[3].read()
    assert (rays.offset_s == 0).all() and np.ptp(rays.origin_m, axis=0).max() == 0 and not rays.held_out.any()


def test_what_is_there_stays_and_what_changed_is_written_again(drive, scanner, tmp_path):
    scene, output = scanner.sweeps[0].path.parents[2], tmp_path / "scene"
    shutil.copytree(scene, output)
    times = {sweep.path.name: sweep.path.stat().st_mtime_ns for sweep in scanner.sweeps}
    (output / scanner.sweeps[5].path.relative_to(scene)).unlink()
    drive.sweep(7).touch()
    again = process(drive, output, holdout_beams=5)
    written = [sweep.frame for sweep in again.sweeps if sweep.path.stat().st_mtime_ns != times[sweep.path.name]]
    assert written == [5, 7]


def test_a_ring_has_one_number_in_every_sweep(tmp_path):
    """Upper beams have no return where the sky is open; another sweep's rings cannot be told apart."""
    room = write_room_drive(tmp_path / "drive", frames=5, size=32)
    for frame in room.frames:
        points = measure(room, frame)
        upward = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        write_points(room.sweep(frame), points[upward < 2] if frame == 3 else points)
    anywhere = np.random.default_rng(0).normal(size=(2000, 3))
    write_points(room.sweep(4), 10 * anywhere / np.linalg.norm(anywhere, axis=1, keepdims=True))
    found = process(room, tmp_path / "scene")
    rings = [np.unique(sweep.read().ring).tolist() for sweep in found.sweeps]
    assert rings == [[*range(12)]] * 3 + [[*range(4, 12)], [-1]]
    pattern = recorded_pattern(found)
    assert pattern is not None
    np.testing.assert_allclose(pattern.elevation_rad, PATTERN.elevation_rad, atol=2e-3)
    # of the rays that the lost beams cast none came back, and of the others all
    open_sky = found.sweeps[3]
    back = came_back(open_sky, open_sky.read(), pattern, found.trajectory)
    assert not back[:4].any() and back[4:].mean() > 0.9


def test_a_broken_sweep_is_left_out(tmp_path):
    room = write_room_drive(tmp_path / "drive", frames=4, size=32)
    cut(room.sweep(2))
    found = process(room, tmp_path / "scene", holdout_every=2)
    assert [sweep.frame for sweep in found.sweeps] == [0, 1, 3]
    # of points in all directions no rings are known, which is no fault
    assert (found.sweeps[0].read().ring == -1).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda entry: entry.update(file_path="../x.npz"), "file_path is '../x.npz', expected the path"),
        (lambda entry: entry.update(timestamp_s="now"), "timestamp_s is 'now', expected a number"),
        (lambda entry: entry.update(transform_matrix=[[2, 0, 0, 0]] * 4), "not a rotation"),
        (lambda entry: entry.update(timestamp_s=-1e9), "do not increase"),
    ],
)
def test_entries_that_are_none(scanner, change, message):
    path = scanner.sweeps[0].path.parents[2] / "transforms.json"
    meta = read_json(path)
    change(meta["scanners"]["velodyne"]["sweeps"][4])
    with pytest.raises(InputError, match=message):
        scanners_of(meta, path)


def test_a_broken_file_of_rays_is_named(scanner, tmp_path):
    path = tmp_path / "0000000000.npz"
    path.write_bytes(scanner.sweeps[0].path.read_bytes()[:-500])
    with pytest.raises(InputError, match=r"0000000000\.npz"):
        replace(scanner.sweeps[0], path=path).read()
    arrays = dict(np.load(scanner.sweeps[0].path))
    np.savez(path, **arrays | {"distance_m": arrays["distance_m"] * np.nan})
    with pytest.raises(InputError, match="distance_m is not finite"):
        replace(scanner.sweeps[0], path=path).read()


# ---- rendered scans --------------------------------------------------------------------------------------------
class RoomModel:
    """Renders the room exactly, in the model's coordinates, but for what is said to be wrong."""

    device = torch.device("cpu")

    def __init__(self, place: SceneToModel, world_offset_m: np.ndarray, off_m: float = 0.0) -> None:
        self.place, self.world_offset_m, self.off_m = place, world_offset_m, off_m
        self.cast = 0

    def get_outputs_for_camera_ray_bundle(self, rays: Any) -> dict[str, torch.Tensor]:
        place, self.cast = self.place, self.cast + len(rays.origins.reshape(-1, 3))
        origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy()
        np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-6)
        world = (origins / place.units_per_metre - place.shift_m) @ place.rotation + self.world_offset_m
        distance, _ = wall_distance(world, directions @ place.rotation)
        depth = torch.from_numpy((distance + self.off_m) * place.units_per_metre)[..., None]
        ones = torch.ones_like(depth).float()
        return {"depth": depth.float(), "accumulation": ones, "rgb": 0.2 * ones.expand(*ones.shape[:-1], 3)}


@pytest.fixture(scope="module", autouse=True)
def the_room_has_no_networks() -> Iterator[None]:
    """Lengths are its outputs; test_rendering.py tries those of a field."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Caster, "_lengths", lambda caster, rays: caster._model.get_outputs_for_camera_ray_bundle(rays))
        yield


@pytest.fixture
def trained(scanner, tmp_path, monkeypatch) -> Path:
    """The config.yml of a training with 10 m in a unit, whose model is the room."""
    config = write_config(tmp_path / "run/config.yml", scanner.sweeps[0].path.parents[2])

    def caster(model: Any, place: SceneToModel) -> Caster:
        return Caster(RoomModel(place, offset_m(scanner), off_m=model), place)

    monkeypatch.setattr(scan_command, "load_model", lambda *_: 0.0)
    monkeypatch.setattr(scan_command, "Caster", caster)
    return config


TIMED = ScanFormat(times=PointTimes("time"))


def test_scans_along_the_recorded_path_are_those_that_were_recorded(drive, trained):
    output = render_lidar(RenderLidarOptions(trained), QUIET)
    for frame in drive.frames:
        scan = read_scan(output / f"{frame:010d}.ply", TIMED)
        assert scan.offset_s is not None
        points_m, offset_s = scan.points_m.numpy(), scan.offset_s.numpy()
        # each point is the wall's, seen from where the scanner was at the point's own time
        there = np.stack([drive.velo_to_world(frame + offset / 0.1) for offset in offset_s])
        world = np.einsum("nij,nj->ni", there[:, :3, :3], points_m)
        distance, _ = wall_distance(there[:, :3, 3], world / np.linalg.norm(world, axis=1)[:, None])
        np.testing.assert_allclose(np.linalg.norm(points_m, axis=1), distance, atol=5e-3)
        assert (np.diff(offset_s) >= 0).all() and np.ptp(offset_s) > 0.09
        # what the drive's scanner loses is lost here, too
        assert distance.max() < LOST_M + 0.5
        assert len(points_m) == pytest.approx(len(measure(drive, frame)), rel=0.03)
    figures = read_json(output / "figures.json")
    assert figures.keys() == {"sweeps", "beams", "sweeps_in_pictures", "beams_in_pictures"}
    assert all(found["median_m"] < 2e-3 and found["within_10_cm"] == 1 for found in figures.values())
    assert 0 < figures["sweeps_in_pictures"]["rays"] < figures["sweeps"]["rays"]
    assert figures["sweeps"]["drop_f1"] > 0.9 and figures["sweeps"]["chamfer_m"] < 0.1
    lines = [line.split() for line in (output / "poses.txt").read_text().splitlines()[1:]]
    np.testing.assert_allclose(
        np.array(lines, float)[:, 1:4], [drive.velo_to_world(frame)[:3, 3] for frame in drive.frames], atol=1e-6
    )


def test_figures_say_how_far_a_model_is_off(trained, monkeypatch):
    monkeypatch.setattr(scan_command, "load_model", lambda *_: 0.2)
    output = render_lidar(RenderLidarOptions(trained, every=9), QUIET)
    found = read_json(output / "figures.json")["sweeps"]
    assert found["median_m"] == pytest.approx(0.2, abs=2e-3) and found["p95_m"] == pytest.approx(0.2, abs=2e-3)
    assert found["within_10_cm"] == 0 and found["within_30_cm"] == 1


def as_trained(scanner: SceneScanner) -> tuple[SceneFolder, Any, SceneToModel]:
    """The scene, a training's data set of it, and the place of the scene in the model: 10 m in a unit."""
    scene = read_scene(scanner.sweeps[0].path.parents[2])
    outputs = SimpleNamespace(dataparser_transform=torch.eye(4)[:3], dataparser_scale=0.1)
    return scene, SimpleNamespace(_dataparser_outputs=outputs, scene=scene), SceneToModel.of(outputs, scene.meta)


def test_a_training_is_held_against_what_a_camera_could_see_of_held_out_sweeps(scanner):
    scene, dataset, place = as_trained(scanner)
    model = RoomModel(place, offset_m(scanner), off_m=0.9)
    pipeline = SimpleNamespace(model=model, datamanager=SimpleNamespace(train_dataset=dataset))
    rays_ = HeldOutRays.of(scene)
    assert rays_ is not None
    figures, kept = evaluate_scans(pipeline, rays_)
    parts, within = kept["scan_parts"], kept["scan_within"]
    asked = []
    for sweep in (each for each in scanner.sweeps if each.held_out):
        rays, seen = sweep.read(), np.zeros(0)
        for picture in (each for each in scene.pictures if each.frame == sweep.frame):
            ahead = torch.from_numpy((rays.points_m - picture.position_m) @ picture.rotation * [1, -1, -1])
            pixels, valid = picture.lens.project(ahead)
            inside = ((pixels >= 0) & (pixels < 32)).all(1).numpy() & valid.numpy()
            rows, columns = np.where(inside[:, None], pixels.numpy()[:, ::-1], 0).astype(int).T
            seen = np.append(seen, np.flatnonzero(inside & scene.usable(picture)[rows, columns]))
        asked.append(rays.distance_m[np.unique(seen).astype(int)])
    lengths = np.concatenate(asked)
    assert figures["scan_rays"] == len(lengths) == model.cast > 500
    assert figures["scan_median_m"] == pytest.approx(0.9, abs=2e-3) and figures["scan_short_10"] == 0
    assert figures["scan_far_25"] == (lengths < 0.9 / 0.25).mean() and figures["scan_far_10"] == (lengths < 9).mean()
    assert figures["scan_abs_rel"] == pytest.approx((0.9 / lengths).mean(), abs=1e-3)
    assert [entry["share"] for entry in within] == [float(entry["error_m"] > 0.9) for entry in within]
    # each ray is in one part of each kind, and the nearest are the furthest off
    by = {name: [part for part in parts if part["by"] == name] for name in ("distance_m", "elevation_deg", "roughness")}
    assert [sum(part["rays"] for part in each) for each in by.values()] == [len(lengths)] * 3
    assert by["distance_m"][0]["abs_rel"] > by["distance_m"][1]["abs_rel"] > 0.9 / 20


def test_the_viewer_shows_a_held_out_sweep_as_the_model_renders_it(scanner, monkeypatch):
    _, dataset, place = as_trained(scanner)
    pipeline = SimpleNamespace(model=RoomModel(place, offset_m(scanner), off_m=0.3))
    layers = SimpleNamespace(
        manager=SimpleNamespace(train_dataset=dataset), viewer=SimpleNamespace(pipeline=pipeline, train_lock=None)
    )
    monkeypatch.setattr(viewer, "evaluated", lambda _: nullcontext())
    cloud = viewer.DriveLayers._scan(cast(viewer.DriveLayers, layers))
    held_out = [sweep for sweep in scanner.sweeps if sweep.held_out]
    rays = held_out[len(held_out) // 2].read()
    expected = place.points(rays.origin_m + rays.direction * (rays.distance_m[:, None] + 0.3))
    np.testing.assert_allclose(cloud.points, expected, atol=1e-3)
    np.testing.assert_allclose(np.asarray(cloud.sigma_m), 0.3, atol=5e-3)


def test_rays_of_held_out_sweeps_alone_are_read_and_a_missing_file_is_named(scanner, tmp_path, monkeypatch):
    folder = shutil.copytree(scanner.sweeps[0].path.parents[2], tmp_path / "scene")
    scene, read = read_scene(folder), []
    monkeypatch.setattr(SceneSweep, "read", lambda self, whole=SceneSweep.read: read.append(self) or whole(self))
    rays = HeldOutRays.of(scene)
    assert rays is not None and len(rays.distance_m) and read and all(sweep.held_out for sweep in read)
    # a camera that is held out as a whole asks for nothing
    monkeypatch.setattr(SceneFolder, "held_out_cameras", lambda self: {*self.cameras()})
    assert HeldOutRays.of(scene) is None
    read[0].path.unlink()
    with pytest.raises(FileNotFoundError, match=read[0].path.name):
        HeldOutRays.of(scene)


def test_leaves_are_told_from_walls():
    angle = np.linspace(-1.2, 1.2, 400)
    wall_m = 4 / np.cos(angle)
    leaves_m = wall_m * np.random.default_rng(0).uniform(0.8, 1, 400)
    ring, offset_s = np.arange(3).repeat(400), np.tile(np.linspace(0, 0.1, 400), 3)
    lengths, order = np.concatenate([wall_m, leaves_m, wall_m]), np.random.default_rng(1).permutation(1200)
    found = roughness(lengths, ring, offset_s).reshape(3, 400)
    assert (found[[0, 2]] < 1e-3).all() and (found[1] > FOLIAGE).mean() > 0.98
    mixed = roughness(lengths[order], ring[order], offset_s[order])
    np.testing.assert_allclose(mixed, found.reshape(-1)[order], atol=1e-12)
    assert np.isnan(roughness(wall_m, np.full(400, -1), offset_s[:400])).all()


@pytest.mark.parametrize("form", ["ply", "pcd", "bin"])
def test_files_hold_places_times_and_rings(trained, form):
    output = render_lidar(RenderLidarOptions(trained, sensor="vlp-16", form=form, every=9), QUIET)
    path = output / f"{0:010d}.{form}"
    scan = read_scan(path, ScanFormat() if form == "bin" else TIMED)
    points_m = scan.points_m.numpy()
    elevation = np.degrees(np.arcsin(points_m[:, 2] / np.linalg.norm(points_m, axis=1)))
    np.testing.assert_allclose(elevation, np.round((elevation - 15) / 2) * 2 + 15, atol=1e-3)
    if form != "bin":
        ring = read_scan(path, ScanFormat(times=PointTimes("ring"))).offset_s
        assert ring is not None and scan.offset_s is not None
        np.testing.assert_allclose(15 - 2 * ring.numpy(), elevation, atol=1e-3)


def stripes(points_m: np.ndarray) -> np.ndarray:
    """Intensities of 10 and 40 in stripes of two metres along the scene's x."""
    return np.where(points_m[:, 0] % 4 < 2, 10.0, 40.0)


def test_scans_are_as_bright_as_training_sweeps_found_their_places(scanner, trained, monkeypatch):
    def bright(sweep: SceneSweep, read: Any = SceneSweep.read) -> SweepRays:
        rays = read(sweep)
        return replace(rays, intensity=stripes(rays.points_m).astype(np.float32))

    asked = []

    def listed(sweep: SceneSweep) -> Any:
        asked.append(sweep)
        return bright(sweep)

    sweeps = [SimpleNamespace(held_out=each.held_out, read=partial(listed, each)) for each in scanner.sweeps]
    found = Intensities.learned(cast(SceneScanner, SimpleNamespace(sweeps=sweeps)))
    assert found is not None and asked and not any(sweep.held_out for sweep in asked)
    assert Intensities.learned(scanner) is None  # all are 0.5
    monkeypatch.setattr(scan_command.Intensities, "learned", lambda _: found)
    monkeypatch.setattr(SceneSweep, "read", bright)
    first = scanner.sweeps[0].scanner_to_scene
    for form in ("ply", "pcd", "bin"):
        output = render_lidar(RenderLidarOptions(trained, form=form, every=9, output=trained.parent / form), QUIET)
        path = output / f"{0:010d}.{form}"
        if form == "bin":
            got = np.fromfile(path, "<f4").reshape(-1, 4)[:, 3]
        else:
            got = np.asarray(read_scan(path, ScanFormat(times=PointTimes("intensity"))).offset_s)
        points_m = read_scan(path, ScanFormat()).points_m.numpy()
        # nearly where the scan stands in the scene: the vehicle moves a decimetre
        expected = stripes(points_m @ first[:3, :3].T + first[:3, 3])
        assert (np.abs(got - expected) < 8).mean() > 0.85 and np.std(expected) > 10
    error = read_json(trained.parent / "ply/figures.json")["sweeps_in_pictures"]["intensity_error"]
    assert 0 < error < 0.2


def test_each_beam_is_as_bright_as_it_measures_at_its_range():
    """Two beams with other gains, and half of everything beyond 8 m, at a wall of two materials."""
    rng = np.random.default_rng(0)
    points_m = rng.uniform((2, -1, 0), (30, 1, 3), (40_000, 3))
    ring, distance_m = rng.integers(2, size=40_000), np.linalg.norm(points_m, axis=1)

    def measured(points_m: np.ndarray, ring: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
        return (
            np.where(points_m[:, 1] > 0, 10.0, 30.0) * np.where(ring == 0, 1.0, 3.0) * np.where(distance_m > 8, 0.5, 1)
        )

    found = Intensities(points_m, measured(points_m, ring, distance_m), ring, distance_m)
    there = points_m[np.abs(points_m[:, 1]) > 0.3][:1000] + 0.02
    away_m = np.linalg.norm(there, axis=1)
    for one in (0, 1):
        of = np.full(1000, one)
        off = found.at(there, of, away_m) / measured(there, of, away_m) - 1
        assert np.median(np.abs(off)) < 0.02 and np.quantile(np.abs(off), 0.95) < 0.1
    # another scanner's: between the two
    between = found.at(there, np.full(1000, -1), away_m) / measured(there, np.zeros(1000), away_m)
    assert 0.8 < between.min() and between.max() < 3 and 1.3 < between.mean() < 2.2
    # a scanner whose rings cannot be told apart
    ringless = Intensities(points_m, measured(points_m, 0 * ring, distance_m), 0 * ring - 1, distance_m)
    off = ringless.at(there, np.full(1000, -1), away_m) / measured(there, np.zeros(1000), away_m) - 1
    assert np.median(np.abs(off)) < 0.02


def test_a_film_shows_each_scan(trained):
    output = render_lidar(RenderLidarOptions(trained, film=True, every=2), QUIET)
    with Image.open(output / "scans.webp") as film:
        assert (film.n_frames, film.size) == (5, SIZE_PX)
        film.seek(3)
        shown = np.asarray(film.convert("RGB"))
    drawn = draw_scan(read_scan(output / f"{6:010d}.ply", ScanFormat()).points_m.numpy())
    seen, expected = ((np.abs(each.astype(int) - NO_VALUE_RGB) > 25).any(2) for each in (shown, drawn))
    assert (seen & expected).sum() > 0.7 * expected.sum() > 0.7 * 1000
    assert (seen & expected[:, ::-1]).sum() < 0.4 * expected.sum()


@pytest.mark.parametrize("form", ["ply", "pcd", "bin"])
def test_a_film_has_an_empty_picture_where_no_ray_came_back(trained, monkeypatch, form):
    monkeypatch.setattr(RayDrop, "kept", lambda _, cast, reach_m: np.zeros(cast.hit.shape, bool))
    output = render_lidar(RenderLidarOptions(trained, every=9, film=True, form=form), QUIET)
    with Image.open(output / "scans.webp") as film:
        assert np.abs(np.asarray(film.convert("RGB")).astype(int) - NO_VALUE_RGB).max() < 4
    assert read_json(output / "figures.json")["sweeps"]["median_m"] < 2e-3
    # a broken scan is no empty one
    broken = next(output.glob(f"*.{form}"))
    broken.write_bytes(b"broken")
    with pytest.raises(InputError, match=broken.name):
        render_lidar(RenderLidarOptions(trained, every=9, film=True, form=form), QUIET)


def test_points_are_drawn_from_behind_and_above():
    ahead = np.array([[20.0, 0.0, -1.0], [20.0, 5.0, -1.0], [60.0, 0.0, -1.0], [-15.0, 0.0, 0.0]])
    rows, columns = np.nonzero((draw_scan(ahead) != NO_VALUE_RGB).any(2))
    middle, left = SIZE_PX[0] // 2, columns.min()
    # what is farther is higher, what is behind the camera is not drawn
    assert len(rows) == 3 * 4 and left < middle and (columns == middle).sum() == 2 * 2
    assert rows[columns == middle].min() < rows[columns == left].min() == rows[columns == middle].max() - 1


def test_a_lane_shift_is_as_far_as_it_was_asked_for(drive, trained):
    output = render_lidar(RenderLidarOptions(trained, path="lane-shift", shift_m=1.5), QUIET)
    lines = np.array([line.split() for line in (output / "poses.txt").read_text().splitlines()[1:]], float)
    recorded = np.array([drive.velo_to_world(frame)[:3, 3] for frame in drive.frames])
    # the vehicle's y is right
    left = -(lines[:, 1:4] - recorded) @ pose(0)[:3, 1]
    assert left[0] == pytest.approx(0, abs=1e-6) and left[4] == pytest.approx(1.5, abs=1e-3)


def test_the_pattern_of_a_file_and_a_path_of_ones_own(drive, trained, tmp_path, capsys):
    (tmp_path / "path.txt").write_text(
        "0 1000 3800 117 0 0 0 1\n0.1 1000.5 3800 117 0 0 0 1\n0.2 1040 3800 117 0 0 0 1\n"
    )
    options = RenderLidarOptions(trained, sensor=str(drive.sweep(0)), path=str(tmp_path / "path.txt"))
    output = render_lidar(options, Console(width=200))
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "1 of 3 poses of the path are more than 10 m from the drive, the furthest 3" in said and "12 × 240 rays" in said
    )
    assert len(list(output.glob("*.ply"))) == 3


def test_an_interrupted_run_goes_on(trained):
    output = render_lidar(RenderLidarOptions(trained, every=3), QUIET)
    times = {path: path.stat().st_mtime_ns for path in output.glob("*.ply")}
    assert len(times) == 3
    (output / f"{3:010d}.ply").unlink()
    assert render_lidar(RenderLidarOptions(trained, every=3), QUIET) == output
    assert [path.name for path in sorted(times) if path.stat().st_mtime_ns != times[path]] == [f"{3:010d}.ply"]
    with pytest.raises(InputError, match="holds other scans"):
        render_lidar(RenderLidarOptions(trained, every=3, sensor="vlp-16"), QUIET)


def test_scans_of_another_path_or_training_are_not_kept(trained, tmp_path, monkeypatch):
    path = tmp_path / "path.txt"
    options = RenderLidarOptions(trained, sensor="vlp-16", path=str(path))
    path.write_text("0 1000 3800 117 0 0 0 1\n0.1 1000.5 3800 117 0 0 0 1\n")
    before = (render_lidar(options, QUIET) / "0000000000.ply").read_bytes()
    with monkeypatch.context() as patch:
        patch.chdir(trained.parent)
        # the same file from another folder
        assert render_lidar(replace(options, load_config=Path(trained.name)), QUIET) == Path("scans")
    path.write_text("0 1000 3801 117 0 0 0 1\n0.1 1000.5 3801 117 0 0 0 1\n")
    with pytest.raises(InputError, match="holds other scans"):
        render_lidar(options, QUIET)
    assert (render_lidar(replace(options, output=tmp_path / "moved"), QUIET) / "0000000000.ply").read_bytes() != before
    torch.save({}, trained.parent / "nerfstudio_models/step-000000019.ckpt")
    with pytest.raises(InputError, match="holds other scans"):
        render_lidar(replace(options, output=tmp_path / "moved"), QUIET)


def test_what_is_missing_is_named_before_anything_is_rendered(trained, scanner, monkeypatch):
    monkeypatch.setattr(scan_command, "load_model", None)
    lost = replace(scanner.sweeps[2], path=scanner.sweeps[2].path.with_name("lost.npz"))
    few = replace(scanner, sweeps=(*scanner.sweeps[:2], lost, *scanner.sweeps[3:]))
    with monkeypatch.context() as patch, pytest.raises(FileNotFoundError, match=r"lost\.npz: no such file"):
        patch.setattr(scan_command, "scanners_of", lambda *_: {"velodyne": few})
        patch.setattr(scan_command, "recorded_pattern", lambda _: PATTERN)
        render_lidar(RenderLidarOptions(trained), QUIET)
    shutil.rmtree(trained.parent / "nerfstudio_models")
    with pytest.raises(InputError, match="nerfstudio_models: has no whole checkpoint"):
        render_lidar(RenderLidarOptions(trained), QUIET)
    assert not (trained.parent / "scans").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sensor": "hdl-23"}, "--sensor hdl-23: neither a scanner .recorded, hdl-64, vlp-16, os1-128. nor a file"),
        ({"path": "nowhere.txt"}, "--path nowhere.txt: neither recorded nor lane-shift, nor a file"),
        ({"scanner": "front"}, "--scanner front: .* has no such scanner; it has velodyne"),
        ({"shift_m": math.nan}, "--shift-m nan"),
        ({"every": 0}, "--every 0"),
    ],
)
def test_options_that_cannot_be_used(trained, options, message):
    with pytest.raises(InputError, match=message):
        render_lidar(RenderLidarOptions(trained, **options), QUIET)
    assert not (trained.parent / "scans").exists()


def test_a_folder_with_something_else_is_refused(trained, tmp_path):
    write_json(tmp_path / "mine/notes.json", {})
    with pytest.raises(InputError, match="mine: holds something else"):
        render_lidar(RenderLidarOptions(trained, output=tmp_path / "mine"), QUIET)


def test_a_scene_without_sweeps_says_what_to_do(trained, scanner, monkeypatch):
    monkeypatch.setattr(scan_command, "scanners_of", lambda *_: {})
    with pytest.raises(InputError, match="keeps no sweeps of a scanner, so --sensor recorded is unknown"):
        render_lidar(RenderLidarOptions(trained), QUIET)
