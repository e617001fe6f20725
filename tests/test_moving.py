"""Moving things: found in sweeps of small analytic worlds, grown in pictures, and on a synthetic drive."""

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from data_sets import beams
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, read_mask, write_mask
from edge_depth_nerf.lidar import Sweep
from edge_depth_nerf.lidar.free_space import FreeSpace
from edge_depth_nerf.lidar.moving import Ground, Lowest, Thing, followed, loose_points, nearby, one_stretch
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.lidar.world import WorldSweep, sweep_in_world
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.masks.moving import clearest_edge, grow_moving
from edge_depth_nerf.process import build
from edge_depth_nerf.process.converters import convert, read_drive
from edge_depth_nerf.process.lidar_checks import LidarCheck
from edge_depth_nerf.process.moving import MOVING_MASKS, find_moving, moving_mask_path
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.vehicle import vehicle_masks
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

GROUND_M, WALL_M = -1.7, 30.0
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Two corners."""
PARKED: Box = ((6.0, -6.0, GROUND_M), (10.0, -4.2, -0.3))


def scanned(boxes: list[Box], origin: np.ndarray) -> np.ndarray:
    """Returns of a scanner over a level ground inside a round wall, with boxes in it; in the world."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.6)), np.radians(np.linspace(-24, 3, 40)))
    rays = beams(azimuth, elevation)
    flat = np.linalg.norm(rays[:, :2], axis=1)
    along = (rays[:, :2] @ origin[:2]) / flat
    wall = (-along + np.sqrt(along**2 + WALL_M**2 - origin[:2] @ origin[:2])) / flat
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(rays[:, 2] < 0, (GROUND_M - origin[2]) / rays[:, 2], np.inf)
        range_m = np.minimum(wall, ground)
        for low, high in boxes:
            to_low, to_high = (np.array(low) - origin) / rays, (np.array(high) - origin) / rays
            enters, leaves = np.minimum(to_low, to_high).max(1), np.maximum(to_low, to_high).min(1)
            range_m = np.where((enters > 0) & (enters < leaves), np.minimum(range_m, enters), range_m)
    return origin + rays * range_m[:, None]


def car(x: float, y: float = 3.0) -> Box:
    return ((x - 2, y - 0.9, GROUND_M + 0.2), (x + 2, y + 0.9, -0.2))


def sweeps_of(
    boxes_at: Callable[[float], list[Box]], count: int = 20, off: Callable[[int], np.ndarray] | None = None
) -> list[WorldSweep]:
    """Sweeps from a scanner that drives along x at 4 m/s; `off` is how far its written poses are off."""
    found = []
    for number in range(count):
        time_s = 0.1 * number
        origin = np.array([4 * time_s - 4, 0.0, 0.0])
        points = scanned(boxes_at(time_s), origin) - origin
        noise = np.random.default_rng(number).normal(0, 0.02, (len(points), 1))
        points += noise * points / np.linalg.norm(points, axis=1, keepdims=True)
        pose = np.eye(4)
        pose[:3, 3] = origin
        if off is not None:
            pose = pose @ off(number)
        sweep = Sweep(torch.from_numpy(points), torch.zeros(len(points)), 0, 0)
        path = Trajectory(np.array([time_s - 1, time_s, time_s + 1]), np.stack([pose] * 3))
        found.append(sweep_in_world(sweep, time_s, np.eye(4), path, None))
    return found


def found_in(sweeps: list[WorldSweep]) -> dict[int, list[Thing]]:
    ground = Ground([Lowest.of(sweep.points_m.numpy()) for sweep in sweeps])
    free = [(0.1 * number, FreeSpace.of(sweep)) for number, sweep in enumerate(sweeps)]
    centres = np.array([np.linalg.inv(sweep.world_to_scanner)[:3, 3] for sweep in sweeps])
    loose = {}
    for number, sweep in enumerate(sweeps):
        others = [free[other] for other in nearby(number, centres, [True] * len(sweeps))]
        loose[number] = loose_points(sweep, 0.1 * number, ground, others)
    return followed(loose)


def share_found(sweep: WorldSweep, things: list[Thing], box: Box) -> float:
    """Share of a box's returns, those near the ground left out, that were found."""
    low, high = np.array(box[0]) - 0.1, np.array(box[1]) + 0.1
    points = sweep.points_m.numpy()
    on_box = np.all((points > low) & (points < high), axis=1) & (points[:, 2] > GROUND_M + 0.35)
    rows = np.concatenate([np.zeros(0, np.int64), *(thing.rows for thing in things)])
    assert on_box.any()
    return float(np.isin(np.flatnonzero(on_box), rows).mean())


# ---- in sweeps -------------------------------------------------------------------------------------------------
def test_one_stretch_of_presence_counts_and_a_mixture_does_not() -> None:
    columns = {
        "gone, there, gone": ("through through met met through through", 4),
        "there from the beginning": ("met met met met through through", 2),
        "always there": ("met met met met met met", 0),
        "hits and passes mixed": ("met through met through met through", None),
        "never known": ("- - - - - -", 0),
    }
    words = np.array([column.split() for column, _ in columns.values()]).T
    # the sweep itself lies between the third and the fourth of the others
    score = dict(zip(columns, one_stretch(words == "through", words == "met", 3), strict=True))
    for name, (_, expected) in columns.items():
        assert score[name] == expected if expected is not None else score[name] < 2, name


def test_a_car_that_passes_is_found_in_every_sweep_and_what_is_parked_is_not() -> None:
    sweeps = sweeps_of(lambda time_s: [PARKED, car(14 - 9 * time_s)])
    found = found_in(sweeps)
    for number, sweep in enumerate(sweeps):
        assert share_found(sweep, found[number], car(14 - 0.9 * number)) > 0.85, number
        assert share_found(sweep, found[number], PARKED) == 0, number
    # of the middle of what is seen of it, which is not always the same part
    speeds = [thing.velocity_m_s for things in found.values() for thing in things]
    np.testing.assert_allclose(np.median(speeds, axis=0), (-9, 0), atol=1.35)


def test_a_car_that_stands_for_a_while_is_found_while_it_stands() -> None:
    def place(time_s: float) -> float:
        return 12 - 8 * (min(time_s, 0.6) + max(time_s - 1.4, 0))

    sweeps = sweeps_of(lambda time_s: [PARKED, car(place(time_s))])
    found = found_in(sweeps)
    shares = [share_found(sweep, found[number], car(place(0.1 * number))) for number, sweep in enumerate(sweeps)]
    assert min(shares) > 0.8, shares
    assert all(share_found(sweep, found[number], PARKED) == 0 for number, sweep in enumerate(sweeps))


def test_a_car_ahead_is_followed_to_the_end_of_the_drive() -> None:
    """Nobody sees through its last places: it hides them until then, and there is no later sweep."""
    sweeps = sweeps_of(lambda time_s: [car(5 + 5 * time_s, 0.0)])
    found = found_in(sweeps)
    for number in (10, 17, 19):
        assert share_found(sweeps[number], found[number], car(5 + 0.5 * number, 0.0)) > 0.7, number


def test_poses_that_are_off_make_nothing_move() -> None:
    def off(number: int) -> np.ndarray:
        rng = np.random.default_rng(100 + number)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, np.radians(0.1), 3)).as_matrix()
        pose[:3, 3] = rng.normal(0, 0.03, 3)
        return pose

    pole: Box = ((9.0, 2.0, GROUND_M), (9.15, 2.15, 2.0))
    found = found_in(sweeps_of(lambda _: [PARKED, pole], off=off))
    assert not any(found.values())


def test_a_sweep_is_evaluated_by_those_near_by_and_by_the_whole_drive() -> None:
    centres = np.column_stack((np.arange(200) * 0.5, np.zeros(200), np.zeros(200)))
    may = np.arange(200) % 8 != 4
    chosen = nearby(100, centres, may.tolist())
    assert len(chosen) == 40 and 100 not in chosen and all(may[chosen])
    assert {97, 98, 99, 101, 102, 103} <= set(chosen)
    assert min(chosen) < 10 and max(chosen) >= 190
    assert nearby(0, np.zeros((1, 3)), [True]) == []


# ---- in a picture ----------------------------------------------------------------------------------------------
def test_points_grow_to_the_outline_that_the_picture_shows() -> None:
    rng = np.random.default_rng(0)
    true = np.zeros((120, 160), bool)
    true[40:80, 50:110] = True
    picture = np.where(true[..., None], (170, 60, 50), (90, 95, 100)) + rng.normal(0, 4, (120, 160, 3))
    picture = np.clip(picture, 0, 255).astype(np.uint8)
    row, column = np.mgrid[43:77:6, 53:107:4]
    lidar_points = np.stack((column.ravel(), row.ravel()), -1) + 0.5
    still = np.zeros_like(true)
    still[2::6, 2::4] = True
    still &= ~true
    found = grow_moving(picture, lidar_points, np.full(len(lidar_points), 6.0), still)
    assert (found & true).sum() / true.sum() > 0.99
    assert (found & ~true).sum() / true.sum() < 0.15
    none = grow_moving(picture, np.zeros((0, 2)), np.zeros(0), still)
    assert not none.any()


def test_a_roof_above_the_field_is_where_the_picture_has_an_edge() -> None:
    bus = np.zeros((120, 160), bool)
    bus[30:90, 50:110] = True
    picture = np.where(bus[..., None], (30, 60, 150), (150, 120, 110)).astype(np.uint8)
    # a brighter edge that is not as long: the sky beside a house
    picture[:15, 80:] = 250
    heights = list(range(60, 5, -3))
    lines = [np.stack((np.arange(52.0, 108.0), np.full(56, y)), -1) for y in heights]
    found = clearest_edge(picture, lines)
    assert found is not None and abs(heights[found] - 30) <= 1
    assert clearest_edge(np.full_like(picture, 90), lines) is None
    assert clearest_edge(picture, [line[:2] for line in lines]) is None


# ---- on a drive ------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("traffic") / "drive"
    made = SynthesizeOptions(root, "traffic", frames=14, size=128, layout="rig", seed=1)
    return synthesize_drive(made)


def options(root: Path, output: Path, **more: object) -> RigOptions:
    given = {"find_moving": True, "refine_poses": False, "sweeps": 0, **more}
    return RigOptions(root=root, output=output, **given)  # pyrefly: ignore[bad-argument-type]


@pytest.fixture(scope="module", autouse=True)
def lidar_is_not_checked():
    """It takes longer than the rest, and is of test_wrong_recordings.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
        yield


@pytest.fixture(scope="module")
def processed(drive: Path) -> Path:
    """Its scene, where frames 4 and 12 are held out."""
    report = convert(options(drive, drive.parent / "scene"))
    assert any(MOVING_MASKS in notice for notice in report.notices)
    return report.scene


def found_again(recording: Recording, wanted: RigOptions) -> Recording:
    return find_moving(recording, wanted, {4, 12}, vehicle_masks(recording), Console(quiet=True))[0]


@pytest.mark.slow
def test_what_moves_in_a_drive_is_masked_and_masks_can_be_corrected(
    drive: Path, processed: Path, tmp_path: Path
) -> None:
    shutil.copytree(processed, tmp_path / "scene")
    recording = read_drive(options(drive, tmp_path / "scene"))
    counts = np.zeros(4)
    for picture in recording.pictures:
        camera = next(camera for camera in recording.cameras if camera.name == picture.camera)
        assert camera.ego_mask is not None
        usable = lens_circle(camera.camera, 95.0) & read_mask(camera.ego_mask)
        true = usable & ~read_mask(drive / "truth" / picture.camera / "moving_masks" / picture.path.name)
        mask = tmp_path / f"scene/{MOVING_MASKS}/{picture.camera}/{picture.frame:010d}.png"
        found = usable & ~read_mask(mask)
        counts += ((found & true).sum(), true.sum(), (found & ~true).sum(), (usable & ~true).sum())
    assert counts[1] > 1000
    # in so short a drive a thing that stands is not seen gone from all of its place
    assert counts[0] / counts[1] > 0.85
    # a pixel about each outline is much in pictures of 128
    assert counts[2] / counts[3] < 0.025

    frames = read_json(tmp_path / "scene/transforms.json")["frames"]
    name = "left/0000000003.png"
    corrected = np.ones((128, 128), bool)
    corrected[60:70, 60:70] = False
    write_mask(tmp_path / "scene" / MOVING_MASKS / name, corrected)
    convert(options(drive, tmp_path / "scene"))
    assert not read_mask(tmp_path / "scene/masks" / name)[60:70, 60:70].any()
    assert all("mask_path" in frame for frame in frames)

    # a sweep that was repaired: what was found is found again, what was corrected stays
    masks = sorted((tmp_path / "scene" / MOVING_MASKS).rglob("*.png"))
    before = {path: path.stat().st_mtime_ns for path in masks}
    recording.sweeps[3].path.touch()
    found_again(recording, options(drive, tmp_path / "scene"))
    stayed = [path for path in masks if path.stat().st_mtime_ns == before[path]]
    assert stayed == [tmp_path / "scene" / MOVING_MASKS / name] and len(masks) > 20


@pytest.mark.slow
def test_training_pictures_know_nothing_of_sweeps_that_are_held_out(
    drive: Path, processed: Path, tmp_path: Path
) -> None:
    """And a picture that is damaged gets no mask."""
    root = Path(shutil.copytree(drive, tmp_path / "drive"))
    wanted = options(root, tmp_path / "without", cameras=("left",))
    recording = read_drive(wanted)
    kept = tuple(sweep for sweep in recording.sweeps if sweep.frame not in (4, 12))
    assert len(kept) < len(recording.sweeps)
    recording = dataclasses.replace(recording, sweeps=kept)
    training = [picture for picture in recording.pictures if picture.frame not in (4, 12)]
    damaged = next(picture for picture in training if not read_mask(moving_mask_path(processed, picture)).all())
    content = bytearray(damaged.path.read_bytes())
    content[len(content) // 2] ^= 0x5A
    damaged.path.write_bytes(content)
    masks = []
    for picture in found_again(recording, wanted).pictures:
        with_them = moving_mask_path(processed, picture)
        if picture.path == damaged.path:
            assert picture.moving_mask is None
        elif picture.frame not in (4, 12):
            assert picture.moving_mask is not None and picture.moving_mask != with_them
            masks.append((read_mask(with_them), read_mask(picture.moving_mask)))
    assert sum((~mask).sum() for mask, _ in masks) > 100
    assert len(masks) == len(training) - 1 and all(np.array_equal(*each) for each in masks)
    with pytest.raises(InputError, match=damaged.path.name):
        found_again(recording, dataclasses.replace(wanted, strict=True))


@pytest.mark.slow
def test_without_sweeps_nothing_can_be_found(drive: Path, tmp_path: Path) -> None:
    wanted = options(drive, tmp_path)
    recording = dataclasses.replace(read_drive(wanted), sweeps=())
    with pytest.raises(InputError, match="--find-moving: the drive has no LiDAR sweeps"):
        find_moving(recording, wanted, set(), {}, Console(quiet=True))
