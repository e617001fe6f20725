"""What the LiDAR of other frames shows of a picture, above its own returns."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import frame_entry

from edge_depth_nerf.base.files import write_distance_png, write_json, write_png
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.mono import far_seen
from edge_depth_nerf.mono.examples import load_examples
from edge_depth_nerf.mono.far_seen import field_deg, seen_above, static_cloud
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

pytestmark = pytest.mark.slow

LENS = KannalaBrandt(240, 200, 80.0, 80.0, 121.0, 101.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
EYE_M, WALL_M, FIELD_DEG = 1.5, 20.0, 2.0
POSITIONS_M = (0.0, 3.0, 6.0, 9.0, 12.0, 14.0)
"""Of the cameras on their way to the wall, along y."""


def rays() -> np.ndarray:
    """In the world; the cameras look along y."""
    directions = torch.nan_to_num(LENS.unproject(LENS.pixel_centres())[0]).numpy()
    return directions @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).T


def elevation_deg() -> np.ndarray:
    return np.degrees(np.arcsin(np.clip(rays()[..., 2], -1, 1)))


def distance_to(wall_y_m: float, half_width_m: float = np.inf) -> np.ndarray:
    """To an upright wall across the way, from a camera so far before it; infinite beside it."""
    world = rays()
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = wall_y_m / world[..., 1]
        hit = (world[..., 1] > 1e-3) & (np.abs(world[..., 0]) * distance <= half_width_m)
    return np.where(hit, distance, np.inf)


def truth_m(position_m: float) -> np.ndarray:
    """Distance to the ground and to a wall 20 m high."""
    world = rays()
    ground = np.where(world[..., 2] < -1e-3, EYE_M / np.maximum(-world[..., 2], 1e-9), np.inf)
    return np.minimum(ground, distance_to(WALL_M - position_m))


def write_drive(folder: Path, extra_m: dict[int, np.ndarray] | None = None, top_deg: float = FIELD_DEG) -> SceneFolder:
    """Write a drive towards a wall; `extra_m` are distances of things that one picture alone has before it."""
    entries = []
    for index, position in enumerate(POSITIONS_M):
        distance = np.minimum(truth_m(position), (extra_m or {}).get(index, np.inf))
        within = (elevation_deg() < top_deg) & (elevation_deg() > -30) & (distance < 60)
        name = f"{index:04d}.png"
        write_png(folder / "images" / name, np.full((LENS.height, LENS.width, 3), 90, np.uint8))
        write_distance_png(folder / "lidar" / name, np.where(within, distance, 0))
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        pose[:3, 3] = [0.0, position, EYE_M]
        lidar = {"lidar_file_path": f"lidar/{name}", "depth_file_path": f"lidar/{name}"}
        entries.append({**frame_entry(LENS, pose, name), "camera": "front", "frame": index, **lidar})
    names = [entry["file_path"] for entry in entries]
    meta = {"camera_model": "OPENCV_FISHEYE", "depth_unit_scale_factor": 1 / 256, "theta_max_deg": 85.0}
    split = {"train_filenames": names, "val_filenames": [], "test_filenames": []}
    write_json(folder / "transforms.json", {**meta, **split, "frames": entries})
    return read_scene(folder)


@pytest.fixture(scope="module")
def towards(tmp_path_factory) -> SceneFolder:
    """The drive with nothing extra; it is only read."""
    return write_drive(tmp_path_factory.mktemp("towards"))


@pytest.fixture(scope="module")
def low(tmp_path_factory) -> SceneFolder:
    """The field ends at the horizon: from far away even the ground lies hardly below it."""
    return write_drive(tmp_path_factory.mktemp("low"), top_deg=0.0)


def shown(scene: SceneFolder, index: int) -> np.ndarray:
    cloud = static_cloud(scene, scene.pictures)
    return seen_above(cloud, scene, scene.pictures[index], (LENS.width, LENS.height))


def test_a_wall_is_known_as_high_as_it_was_seen_from_afar(towards):
    found = shown(towards, 5)
    # from the start, 20 m away, LiDAR reaches 1.5 m + 20 m · tan 2° = 2.2 m; from 6 m away that is 6.6° up
    ahead = (np.abs(rays()[..., 0]) < 0.1) & (rays()[..., 1] > 0)
    newly = ahead & (elevation_deg() > FIELD_DEG + 0.5) & (elevation_deg() < 5.5)
    assert newly.sum() > 30
    # a pixel at 20 m is more than three wide from 6 m away
    assert (found[newly] > 0).mean() > 0.3
    np.testing.assert_allclose(found[newly & (found > 0)], truth_m(14.0)[newly & (found > 0)], rtol=0.02)
    assert not found[elevation_deg() > 9].any()
    assert not found[elevation_deg() < FIELD_DEG - 1].any()


@pytest.mark.parametrize("pictures", [0, 1, None])
def test_the_first_picture_learns_nothing_from_nearer_ones(towards, pictures):
    cloud = static_cloud(towards, towards.pictures[:pictures])
    assert (seen_above(cloud, towards, towards.pictures[0], (LENS.width, LENS.height)) > 0).mean() < 0.005


def test_what_stands_before_the_picture_hides_the_wall_above_it_as_well(tmp_path):
    # a house corner 3 m ahead that no other picture has, 2 m wide, taller than LiDAR reaches
    before = write_drive(tmp_path, {5: distance_to(3.0, half_width_m=1.0)})
    found = shown(before, 5)
    above = (elevation_deg() > FIELD_DEG + 0.5) & (elevation_deg() < 5.5) & (rays()[..., 1] > 0)
    sideways_deg = np.degrees(np.abs(np.arctan2(rays()[..., 0], rays()[..., 1])))
    assert not found[above & (sideways_deg < 18)].any()
    assert (found[above & (sideways_deg > 22) & (sideways_deg < 40)] > 0).mean() > 0.3


def test_what_other_pictures_see_through_has_moved(tmp_path, monkeypatch):
    # a lorry 8 m before the fourth picture, where the three before see the wall; it would stand 5 m before the fifth,
    # up to 3.2° above the horizon
    scene = write_drive(tmp_path, {3: distance_to(8.0, half_width_m=1.5)})
    found = shown(scene, 4)
    assert (found > 0).any()
    assert not (found[found > 0] < 7).any()
    monkeypatch.setattr(far_seen, "_votes", lambda picture, points_m, lidar_m: np.zeros(len(points_m), np.int32))
    assert (lorry := shown(scene, 4))[lorry > 0].min() < 5.5


def test_own_points_come_first_in_examples(towards):
    heights = [{"front": EYE_M}]
    alone = load_examples([towards], [towards.pictures[:2]], heights, 60, 4)
    seven = [lambda picture, size: np.full(size[::-1], 7.0, "f4")]
    both = load_examples([towards], [towards.pictures[:2]], heights, 60, 4, far_seen=seven)
    has = alone.lidar_m > 0
    assert 0.1 < has.mean() < 0.9
    np.testing.assert_array_equal(both.lidar_m[has], alone.lidar_m[has])
    assert (both.lidar_m[~has & both.usable] == 7.0).all()
    assert not both.lidar_m[~both.usable].any()


# ---- long drives -----------------------------------------------------------------------------------------------
def copies(scene: SceneFolder, count: int, apart_m: float = 300.0) -> list[ScenePicture]:
    """The drive again and again, one behind the other along x, diagonally into negative coordinates."""
    return [
        dataclasses.replace(picture, position_m=picture.position_m + number * np.array([apart_m, -apart_m, 0.0]))
        for number in range(count)
        for picture in scene.pictures
    ]


def rows(points_m: np.ndarray) -> np.ndarray:
    return points_m[np.lexsort(points_m.T)]


def test_a_drive_far_away_changes_nothing(low):
    alone, both = static_cloud(low, low.pictures), static_cloud(low, copies(low, 2))
    here = both.points_m[:, 0] < 150
    assert len(alone.points_m) > 50
    np.testing.assert_array_equal(rows(both.points_m[here]), rows(alone.points_m))
    assert len(alone.spacing_m) == here.sum() == (~here).sum()
    size = (LENS.width, LENS.height)
    for picture in low.pictures:
        of_both, of_one = (seen_above(cloud, low, picture, size) for cloud in (both, alone))
        np.testing.assert_array_equal(of_both, of_one, strict=True)


def test_the_work_grows_with_the_length_of_the_drive(low, monkeypatch):
    looked_at = {"_is_above": 0, "_votes": 0, "first_in_voxel": 0}

    def counted(name: str, points_at: int):
        whole = getattr(far_seen, name)

        def call(*arguments):
            looked_at[name] += len(arguments[points_at])
            return whole(*arguments)

        monkeypatch.setattr(far_seen, name, call)

    for name, points_at in (("_is_above", 1), ("_votes", 1), ("first_in_voxel", 0)):
        counted(name, points_at)
    # one or two drives fill it
    monkeypatch.setattr(far_seen, "_MERGE_AT", 40_000)
    costs = []
    for count in (2, 8):
        looked_at.update(dict.fromkeys(looked_at, 0))
        cloud = static_cloud(low, copies(low, count))
        seen_above(cloud, low, low.pictures[0], (60, 50))
        costs.append(dict(looked_at))
    assert all(costs[0].values())
    for name in ("_is_above", "_votes"):
        assert costs[1][name] < 4.4 * costs[0][name], (name, costs)
    # what is thinned again each time is at most as much as what came since
    measured = sum(int((far_seen._own(low, picture)[1] > 0).sum()) for picture in low.pictures)
    assert 8 * measured <= costs[1]["first_in_voxel"] < 2.5 * 8 * measured, (measured, costs)


def test_near_points_are_those_within_reach(monkeypatch):
    rng = np.random.default_rng(0)
    points = rng.uniform(-150, 150, (4000, 3))
    cloud = far_seen._tiled(points, np.arange(4000, dtype=np.float32))
    # each keeps its own spacing
    np.testing.assert_array_equal(points[cloud.spacing_m.astype(int)], cloud.points_m)
    for place in ([0.0, 0.0, 0.0], [-71.3, 12.5, 40.0], [149.0, -149.0, 0.0], [900.0, 0.0, 0.0]):
        picture = ScenePicture("a", "a", 0, LENS, np.array(place), np.eye(3), False, None, {})
        expected = np.hypot(*(points[:, :2] - place[:2]).T) <= 86
        np.testing.assert_array_equal(rows(cloud.points_m[cloud.near(picture)]), rows(points[expected]))


def test_the_field_is_where_the_points_are(tmp_path):
    scene = write_drive(tmp_path, top_deg=-3.0)
    up = [elevation_deg()[far_seen._own(scene, picture)[1] > 0] for picture in scene.pictures]
    expected = np.quantile(np.concatenate(up), [0.001, 0.999])
    assert field_deg(scene, scene.pictures) == pytest.approx(expected, abs=0.05)
    assert field_deg(scene, []) is None


@pytest.mark.parametrize("pictures", [0, 1])
def test_one_picture_or_none_knows_nothing_more(tmp_path, pictures):
    scene = write_drive(tmp_path)
    cloud = static_cloud(scene, scene.pictures[:pictures])
    found = seen_above(cloud, scene, scene.pictures[0], (LENS.width, LENS.height))
    assert (found > 0).mean() < 0.005
