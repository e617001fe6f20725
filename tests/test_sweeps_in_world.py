"""De-skewing, hidden points, free space and the sweeps around a picture, on scenes whose answer is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from data_sets import beams
from torch import Tensor

from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.lidar import Sweep, SweepTiming, project_points
from edge_depth_nerf.lidar.free_space import FreeSpace
from edge_depth_nerf.lidar.sweeps import first_in_voxel
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.lidar.world import above_field, sweep_in_world
from edge_depth_nerf.process import sweep_store
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import RecordedSweep, Recording
from edge_depth_nerf.process.sweep_store import SweepStore, _Gathered, _Shared

FISHEYE = MEI(700, 700, 668.0, 668.0, 350.5, 349.0, 2.2134, 0.0168, 1.6549, 4e-4, 4e-4)


def as_sweep(points: np.ndarray, offset_s: Tensor | None = None) -> Sweep:
    tensor = torch.from_numpy(np.asarray(points, np.float64))
    return Sweep(tensor, torch.full((len(tensor),), 0.5, dtype=torch.float64), 0, 0, offset_s)


def straight(speed_m_s: float, seconds: int = 20) -> Trajectory:
    """Along the world's x axis, ten poses a second."""
    times = np.arange(-10, 10 * seconds) / 10
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = speed_m_s * times
    return Trajectory(times, poses)


def measured_wall(speed_m_s: float, clockwise: bool, reference_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall at y = 10 m, measured by a scanner on the way: raw points, and where they really are."""
    azimuth = np.radians(np.linspace(20, 160, 400))
    turns = (azimuth - reference_rad + np.pi) % (2 * np.pi) / (2 * np.pi) - 0.5
    time_s = turns * (-0.1 if clockwise else 0.1)
    raw = np.stack((10 / np.tan(azimuth), np.full_like(azimuth, 10.0), np.linspace(-1, 1, 400)), -1)
    return raw, raw + speed_m_s * time_s[:, None] * [1, 0, 0]


@pytest.mark.parametrize(("clockwise", "reference_rad"), [(True, 0.0), (False, np.pi), (True, -1.2)])
def test_points_go_where_they_were_measured(clockwise: bool, reference_rad: float) -> None:
    raw, true = measured_wall(10.0, clockwise, reference_rad)
    timing = SweepTiming(0.1, clockwise, reference_rad)
    path = straight(10.0)
    found = sweep_in_world(as_sweep(raw), 5.0, np.eye(4), path, timing)
    np.testing.assert_allclose(found.points_m.numpy(), true + np.array([50, 0, 0]), atol=1e-9)
    skewed = sweep_in_world(as_sweep(raw), 5.0, np.eye(4), path, timing, deskew=False)
    np.testing.assert_allclose(skewed.points_m.numpy(), raw + np.array([50, 0, 0]), atol=1e-9)
    assert np.abs(true - raw).max() > 0.1


def test_times_from_the_file_come_before_the_azimuth_and_the_scanners_place_counts() -> None:
    raw = np.array([[10.0, 0, 0], [10.0, 1, 0]])
    sweep = as_sweep(raw, torch.tensor([0.02, -0.03], dtype=torch.float64))
    found = sweep_in_world(sweep, 1.0, np.eye(4), straight(10.0), SweepTiming(0.1))
    np.testing.assert_allclose(found.points_m[:, 0].numpy(), [20.2, 19.7], atol=1e-9)
    # and the scanner sits where it sits
    scanner_to_vehicle = np.eye(4)
    scanner_to_vehicle[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    scanner_to_vehicle[:3, 3] = [1, 2, 3]
    found = sweep_in_world(as_sweep(np.array([[4.0, 0, 0]])), 0.0, scanner_to_vehicle, straight(0.0), None)
    np.testing.assert_allclose(found.points_m.numpy(), [[1, 6, 3]], atol=1e-12)
    np.testing.assert_allclose(found.world_to_scanner @ [1, 6, 3, 1], [4, 0, 0, 1], atol=1e-12)


def grid_on_plane(height: int, width: int, spacing_m: float, place: np.ndarray, across: np.ndarray, up: np.ndarray):
    a, b = np.meshgrid(np.arange(width) - width / 2, np.arange(height) - height / 2)
    return place + spacing_m * (a.reshape(-1, 1) * across + b.reshape(-1, 1) * up)


@pytest.mark.parametrize("theta_deg", [0.0, 80.0, 100.0])
@pytest.mark.parametrize("camera", [FISHEYE, KannalaBrandt(700, 700, 215.0, 215.0, 350.0, 350.0, 0.0, 0.0, 0.0, 0.0)])
def test_a_near_surface_hides_what_is_behind_also_beyond_90_degrees(camera: Camera, theta_deg: float) -> None:
    theta = np.radians(theta_deg)
    ahead = np.array([np.sin(theta), 0.0, np.cos(theta)])
    across, up = np.array([np.cos(theta), 0, -np.sin(theta)]), np.array([0.0, 1.0, 0.0])
    # the near one's points lie four pixels apart: most of what is behind falls between them
    near = grid_on_plane(20, 20, 0.08, 4 * ahead, across, up)
    far = grid_on_plane(160, 160, 0.1, 20 * ahead, across, up)
    points = torch.from_numpy(np.concatenate((near, far)))
    spacing = torch.cat((torch.full((len(near),), 0.09), torch.full((len(far),), 0.11)))
    raw = project_points(points, camera)
    clear = project_points(points, camera, spacing_m=spacing)
    # what the near rectangle covers, as seen from the camera
    at_near = far @ np.stack((across, up), -1) * 4 / (far @ ahead)[:, None]
    covered = (np.abs(at_near) < 0.72).all(-1)
    outside = (np.abs(at_near) > 0.95).any(-1)

    def kept(found: Tensor) -> np.ndarray:
        chosen = np.zeros(len(points), bool)
        chosen[found[found >= 0].numpy()] = True
        return chosen[len(near) :]

    assert kept(raw.point_index)[covered].sum() > 100, "the test must have something to hide"
    assert not kept(clear.point_index)[covered].any()
    assert (kept(clear.point_index) == kept(raw.point_index))[outside].all()
    assert (clear.distance_m[raw.distance_m < 5] == raw.distance_m[raw.distance_m < 5]).all()


def test_a_road_does_not_hide_itself() -> None:
    """A car's camera, 2 m above the road, looks sideways; the scanner's rings are far apart."""
    azimuth = np.radians(np.arange(0, 360, 0.2))
    elevation = np.radians(np.linspace(-24.8, -3.5, 51))
    range_m = 1.75 / -np.sin(elevation)
    x = (range_m * np.cos(elevation))[:, None] * np.cos(azimuth)
    z = (range_m * np.cos(elevation))[:, None] * np.sin(azimuth)
    # camera frame: y down; 0.25 m above the scanner and half a metre beside it
    road = np.stack((x + 0.5, np.full_like(x, 2.0), z), -1).reshape(-1, 3)
    spacing = torch.from_numpy(np.repeat(range_m, len(azimuth)) * 0.0073)
    points = torch.from_numpy(road)
    raw = project_points(points, FISHEYE).point_index >= 0
    clear = project_points(points, FISHEYE, spacing_m=spacing).point_index >= 0
    assert raw.sum() > 15_000
    assert clear.sum() > 0.97 * raw.sum()


def test_points_that_only_hide_are_never_chosen() -> None:
    camera = Pinhole(100, 100, 100.0, 100.0, 50.0, 50.0)
    points = torch.tensor([[0.0, 0.0, 2.0], [0.01, 0.01, 20.0], [4.0, 0.0, 20.0]])
    spacing = torch.tensor([0.1, 0.1, 0.1])
    hides = torch.tensor([True, False, False])
    found = project_points(points, camera, spacing_m=spacing, only_hides=hides)
    assert found.point_index[found.point_index >= 0].tolist() == [2]


def test_of_one_surface_the_newest_point_wins() -> None:
    camera = Pinhole(100, 100, 100.0, 100.0, 50.0, 50.0)
    points = torch.tensor([[0.01, 0.01, 10.0], [0.045, 0.045, 10.2], [0.05, 0.05, 30.0]])
    newest_off_centre = project_points(points, camera, age_s=torch.tensor([0.0, 0.3, 0.0]))
    assert newest_off_centre.point_index.max() == 0
    other = project_points(points, camera, age_s=torch.tensor([0.3, 0.1, 0.0]))
    assert other.point_index.max() == 1, "the newest of all lies behind"


def test_what_reaches_the_edge_of_the_field_goes_on_above_it() -> None:
    azimuth = np.radians(np.arange(-20, 20, 0.2))
    elevation = np.radians(np.linspace(-20, 2, 50))
    rays = beams(*np.meshgrid(azimuth, elevation))
    tree = rays * (3 / rays[:, :1])
    sweep = sweep_in_world(as_sweep(tree), 0.0, np.eye(4), straight(0.0), None)
    points, spacing = above_field(sweep, np.array([0.0, 0.5, 0.4]))
    top = 3 * np.tan(np.radians(2))
    np.testing.assert_allclose(points[:, 0].numpy(), 3, atol=1e-9)
    assert points[:, 2].min() > top and points[:, 2].max() == pytest.approx(top + 0.4, abs=0.02)
    assert (spacing > 0.4 / 6).all()
    assert len(above_field(sweep, np.array([0.0, 0.5, -0.1]))[0]) == 0


def circle(range_m: float, rings: int = 40) -> np.ndarray:
    return range_m * beams(*np.meshgrid(np.radians(np.arange(0, 360, 0.2)), np.radians(np.linspace(-20, 2, rings))))


def test_sees_through_what_is_gone_and_not_through_what_is_there() -> None:
    sweep = sweep_in_world(as_sweep(circle(20.0)), 0.0, np.eye(4), straight(0.0), None)
    free = FreeSpace.of(sweep)
    rng = np.random.default_rng(0)
    rays = circle(1.0)[rng.integers(0, 72000, 1000)]
    at = {range_m: free.observed(torch.from_numpy(rays * range_m))[0].float().mean() for range_m in (5, 18, 20, 25)}
    assert at[5] > 0.99 and at[18] > 0.99
    assert at[20] == 0 and at[25] == 0
    # above and below the field nothing is known
    assert not free.observed(torch.tensor([[5.0, 0, 3.0], [5.0, 0, -4.0]], dtype=torch.float64))[0].any()


def test_the_edge_of_a_thing_is_not_seen_through() -> None:
    """Beside a pole the beams go on to the wall; the pole's own points must stay, a cell off as well."""
    points = circle(20.0)
    pole = np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(1.0)
    points[pole] *= 0.5
    free = FreeSpace.of(sweep_in_world(as_sweep(points), 0.0, np.eye(4), straight(0.0), None))
    shifted = points[pole] + [0, 0.05, 0]
    assert not free.observed(torch.from_numpy(shifted))[0].any()


def stored(worlds: dict[int, np.ndarray], speed_m_s: float = 0.0, interval_s: float = 0.1) -> list[RecordedSweep]:
    sweeps = []
    for frame, world in worlds.items():
        raw = world - [speed_m_s * frame * interval_s, 0, 0]
        where = (Path(f"{frame}.bin"), frame * interval_s, frame, "top", np.eye(4))
        sweeps.append(RecordedSweep(*where, read=lambda raw=raw: as_sweep(raw), timing=None))
    return sweeps


def store(sweeps: list[RecordedSweep], reach: int, held_out: set[int], path: Trajectory | None = None) -> SweepStore:
    recording = Recording((), (), tuple(sweeps), path or straight(0.0), {})
    return SweepStore(recording, ProcessOptions(output=Path("scene"), sweeps=reach, strict=True), held_out)


AT_ORIGIN = np.eye(4)
BELOW = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -1], [0, 0, 0, 1]])


def test_training_never_gets_a_sweep_that_is_held_out() -> None:
    sweeps = stored({frame: circle(20.0 + frame) for frame in range(24)})
    held_out = {4, 12, 20}
    for reach in (0, 3):
        found = store(sweeps, reach, held_out)
        for frame in range(24):
            used = {sweep.frame for sweep in found.used(frame, frame * 0.1)}
            if frame in held_out:
                assert used == {frame}
            else:
                expected = {other for other in range(frame - reach, frame + reach + 1) if 0 <= other < 24}
                assert used == expected - held_out


def test_a_passing_car_leaves_no_trail_but_stays_where_it_is() -> None:
    """A box of points drives through an otherwise still world, 1.2 m a frame.

    Sweeps whose poses are of their end are later than the picture that they belong to, by more than half a turn even.
    """
    wall = circle(20.0)
    box = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 9), [0.0], np.linspace(-0.5, 0.2, 8)), -1).reshape(-1, 3)
    worlds, cars = {}, {}
    for frame in range(7):
        car = box + np.array([1.2 * (frame - 3), 8.0, 0])
        bearing, at = (np.arctan2(p[:, 1], p[:, 0]) for p in (wall, car))
        hidden = (bearing > at.min()) & (bearing < at.max()) & (wall[:, 2] < 0.6)
        worlds[frame], cars[frame] = np.concatenate((wall[~hidden], car)), car
    sweeps = store(stored(worlds), 3, set())
    for late_s in (0.0, 0.06):
        found = sweeps.around(3, 0.3 - late_s, BELOW)
        near = found.points_m.norm(dim=-1) < 15
        own = (found.age_s[near] - late_s).abs() < 1e-3
        assert own.sum() == len(box), "its own moment's car is there"
        assert (~own).sum() <= 0.02 * 6 * len(box), "what is left of the six other moments' cars"
        assert len(found.points_m) > 6 * 0.9 * len(wall), "the wall stays"
        assert not found.moved[~near].any()
    # what lasts, over all pictures: next to nothing of seven cars
    around = [sweeps.around(frame, frame * 0.1, BELOW) for frame in range(7)]
    trails = sum(int((~each.moved & (each.points_m.norm(dim=-1) < 15)).sum()) for each in around)
    assert trails <= 0.05 * sum(min(frame + 3, 6) - max(frame - 3, 0) + 1 for frame in range(7)) * len(box)


def test_points_above_the_own_sweeps_field_are_left_out() -> None:
    low, high = circle(20.0), circle(20.0) + np.array([0, 0, 3.0])
    found = store(stored({0: low, 1: high}), 1, set()).around(0, 0.0, BELOW)
    others = found.points_m[found.age_s > 0]
    assert len(others) > 0
    assert (torch.asin(others[:, 2] / others.norm(dim=-1)) <= np.radians(2) + 1e-6).all()


def test_the_nearest_sweep_serves_a_picture_without_its_own() -> None:
    sweeps = [replace(sweep, frame=None) for sweep in stored({0: circle(20.0), 1: circle(21.0)})]
    found = store(sweeps, 0, set())
    assert [sweep.time_s for sweep in found.used(7, 0.07)] == [0.1]
    assert found.used(7, 0.35) == []
    empty = found.around(7, 0.35, AT_ORIGIN)
    assert empty.points_m.shape == (0, 3)


def test_sweeps_in_a_gap_of_the_poses_are_not_used() -> None:
    sweeps = stored({frame: circle(20.0) for frame in range(40)})
    times = np.array([0.0, 0.1, 0.2, 0.3, 2.5, 2.6, 3.9])
    path = Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1)))
    used = {sweep.frame for sweep in store(sweeps, 5, set(), path).used(3, 0.3)}
    assert used == {0, 1, 2, 3}


def test_memory_is_bounded_and_the_newest_points_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_store, "MAX_POINTS", 5000)
    gathered = _Gathered(np.array([4e6, 5e5, 100.0]))
    rng = np.random.default_rng(0)
    centre = torch.tensor([4e6, 5e5, 100.0], dtype=torch.float64)
    for age in range(8):
        points = torch.from_numpy(rng.uniform(-2, 2, (3000, 3))) + centre
        gathered.add(points, torch.full((3000,), 0.1), torch.zeros(3000, dtype=torch.bool), age / 10)
        assert sum(len(part[0]) for part in gathered._parts) <= 5000
    found = gathered.together()
    cells = torch.floor((found.points_m - centre) / 0.05).long()
    assert len(torch.unique(cells, dim=0)) == len(cells)
    assert (found.age_s == 0).sum() > (found.age_s > 0.6).sum()


def test_thinned_points_hide_as_much_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    near = grid_on_plane(300, 300, 0.01, np.array([0, 0, 2.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    far = grid_on_plane(150, 150, 0.1, np.array([0, 0, 20.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]))
    monkeypatch.setattr(sweep_store, "MAX_POINTS", 60_000)
    gathered = _Gathered(np.zeros(3))
    for points, spacing in ((near, 0.014), (far, 0.14)):
        moved = torch.zeros(len(points), dtype=torch.bool)
        gathered.add(torch.from_numpy(points), torch.full((len(points),), spacing), moved, 0.0)
    found = gathered.together()
    assert len(found.points_m) < 60_000
    seen = project_points(found.points_m, FISHEYE, spacing_m=found.spacing_m)
    shown = found.points_m[seen.point_index[seen.point_index >= 0]]
    assert (shown[:, 2] < 3).sum() > 500
    covered = (shown[:, :2] * (2 / shown[:, 2:])).abs().amax(-1) < 1.3
    assert not (covered & (shown[:, 2] > 3)).any()


def test_a_stray_point_is_not_the_edge_of_the_field() -> None:
    clean = sweep_in_world(as_sweep(circle(20.0)), 0.0, np.eye(4), straight(0.0), None)
    # 40 beams over 22°, 0.2° between firings: the wider of the two gaps is 0.56°
    assert clean.spacing_m.unique().numel() <= 3
    assert np.degrees(float(clean.spacing_m[0]) / 20) == pytest.approx(0.5, abs=0.1)
    stray = np.concatenate((circle(20.0), [[5.0, 0, 3.0], [5.0, 0, -4.0]]))
    found = sweep_in_world(as_sweep(stray), 0.0, np.eye(4), straight(0.0), None)
    np.testing.assert_allclose(found.elevation_rad, clean.elevation_rad, atol=1e-3)
    assert found.spacing_rad == pytest.approx(clean.spacing_rad, rel=0.01)


def test_nothing_only_hides_unless_asked() -> None:
    above = np.eye(4)
    above[2, 3] = 0.4
    sweeps = store(stored({0: circle(20.0)}), 0, set())
    assert sweeps.around(0, 0.0, above).only_hides.any()
    assert not sweeps.around(0, 0.0, above, hide=False).only_hides.any()


def test_first_of_each_cube_in_order() -> None:
    points = np.array([[0.01, 0, 0], [0.04, 0, 0], [0.06, 0, 0], [-0.01, 0, 0], [0.02, 0.01, 0]])
    assert first_in_voxel(points, 0.05).tolist() == [0, 2, 3]


def test_threads_share_what_one_of_them_makes() -> None:
    from concurrent.futures import ThreadPoolExecutor
    from time import sleep

    made: list[int] = []

    def make(key: int) -> int:
        made.append(key)
        sleep(0.02)
        return 10 * key

    shared: _Shared[int] = _Shared(make, 3)
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(shared.get, [1, 1, 1, 2, 2, 1])) == [10, 10, 10, 20, 20, 10]
    assert sorted(made) == [1, 2]
    for key in (3, 4, 5, 1):
        shared.get(key)
    assert made.count(1) == 2, "the oldest was forgotten"
