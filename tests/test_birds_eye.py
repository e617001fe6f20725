"""The road from above: rendered of a yard whose every distance is known in closed form."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import ROOM, SEQUENCE, RoomDrive, write_room_drive
from PIL import Image
from rich.console import Console
from scenes import write_scene
from trainings import trainer_of, write_config

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.films import birds_eye, scanning
from edge_depth_nerf.films.birds_eye import render_birds_eye
from edge_depth_nerf.films.ground_plan import GroundPlan, driven_path
from edge_depth_nerf.films.options import BirdsEyeOptions
from edge_depth_nerf.plugin.scanning import Caster, SceneToModel
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import Kitti360Options

QUIET = Console(quiet=True)
FLOOR_M, ROOF_M, BOX_M = 115.0, 118.4, 116.0
"""Heights in the drive's world, whose cameras are 2.07 m above the floor; the roof covers what lies east of x."""
ROOF_FROM_M = 1003.0
BOX = np.array([[1001.0, 3803.0, FLOOR_M], [1003.0, 3804.0, BOX_M]])
EMPTY = np.array([[1004.0, 3796.5], [1005.0, 3798.0]])
"""There the field shows nothing."""
SIDE_M = 0.125


def to_box(origin: np.ndarray, rays: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Distance along unit rays to a box that they come from outside of; infinite where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (box[0] - origin) / rays, (box[1] - origin) / rays
    enter, leave = np.fmin(low, high).max(-1), np.fmax(low, high).min(-1)
    return np.where((enter <= leave) & (enter > 1e-9), enter, np.inf)


def to_yard(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance along unit rays to the first thing in the yard."""
    roof = np.array([[ROOF_FROM_M, 3700.0, ROOF_M], [1100.0, 3900.0, ROOF_M + 0.3]])
    floor = np.array([[900.0, 3700.0, FLOOR_M - 0.5], [1100.0, 3900.0, FLOOR_M]])
    walls = [np.array([[900.0, ROOM[1, 1], FLOOR_M], [1100.0, 3900.0, 125.0]])]
    return np.min([to_box(origin, rays, box) for box in (roof, floor, BOX, *walls)], axis=0)


def colours_at(place: np.ndarray) -> np.ndarray:
    """A colour that tells where in the world it is, to some centimetres."""
    return np.stack([place[..., 0] % 7 / 7, place[..., 1] % 7 / 7, np.full(place.shape[:-1], 0.25)], -1)


class YardModel:
    """Renders the yard exactly, in the model's coordinates; rays that end early meet what lies before their end."""

    device = torch.device("cpu")

    def __init__(self, place: SceneToModel, world_offset_m: np.ndarray) -> None:
        self.place, self.world_offset_m = place, world_offset_m

    def get_outputs_for_camera_ray_bundle(self, rays: Any) -> dict[str, torch.Tensor]:
        place = self.place
        assert rays.origins.numel() > 0, "nerfstudio gives no outputs then"
        origins, directions = rays.origins.double().numpy(), rays.directions.double().numpy() @ place.rotation
        world = (origins / place.units_per_metre - place.shift_m) @ place.rotation + self.world_offset_m
        distance = to_yard(world, directions)
        hits = world + directions * np.where(np.isfinite(distance), distance, 0)[..., None]
        hit = np.isfinite(distance) & ~((hits[..., :2] > EMPTY[0]) & (hits[..., :2] < EMPTY[1])).all(-1)
        if rays.fars is not None:
            assert (rays.nears == 0).all()
            hit &= distance * place.units_per_metre <= rays.fars[..., 0].numpy()
        depth = torch.from_numpy(np.where(hit, distance, 1e3) * place.units_per_metre)[..., None].float()
        accumulation = torch.from_numpy(hit[..., None]).float()
        return {"depth": depth, "accumulation": accumulation, "rgb": torch.from_numpy(colours_at(hits)).float()}


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=9, size=64)


@pytest.fixture(scope="module")
def scene(drive) -> Path:
    output = drive.root.parent / "scene"
    fast: dict[str, Any] = {"find_ego": False, "refine_poses": False, "motion": False}
    convert(Kitti360Options(root=drive.root, sequence=SEQUENCE, output=output, sweeps=0, **fast), QUIET)
    return output


@pytest.fixture(scope="module")
def of_the_yard(scene) -> Iterator[None]:
    """Whatever is trained, its model is the yard."""
    offset_m = np.array(read_json(scene / "transforms.json")["world_offset_m"])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(birds_eye, "load_model", lambda *_: None)
        patch.setattr(birds_eye, "Caster", lambda _, place: Caster(YardModel(place, offset_m), place))
        # the yard has no networks: lengths are its outputs, too
        patch.setattr(Caster, "_lengths", lambda caster, rays: caster._model.get_outputs_for_camera_ray_bundle(rays))
        yield


def test_a_training_that_was_moved_is_loaded_from_anywhere(tmp_path, monkeypatch):
    """Its config.yml has a path relative to where it was trained."""
    scene = write_scene(tmp_path / "scene", frames=3)
    monkeypatch.chdir(tmp_path)
    trainer = trainer_of(scene, tmp_path / "runs")
    trainer.config.output_dir = Path("runs")
    trainer.config.save_config()
    trainer.save_checkpoint(3)
    run = Path(shutil.copytree(trainer.base_dir, tmp_path / "moved"))
    # nerfstudio's writer, which later tests have in this process, too, still writes beside them
    shutil.rmtree(trainer.base_dir / "nerfstudio_models")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    loaded = scanning.load_model(Path("../moved/config.yml"), scene)
    expected = trainer.pipeline.model.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in loaded.state_dict().items())
    (run / "nerfstudio_models/step-000000003.ckpt").write_bytes(b"half")
    with pytest.raises(InputError, match="nerfstudio_models: has no whole checkpoint"):
        scanning.check_checkpoint(Path("../moved/config.yml"))


@pytest.fixture
def trained(scene, of_the_yard, tmp_path) -> Path:
    """The config.yml of a training."""
    return write_config(tmp_path / "run/config.yml", scene)


def render(config: Path, **options: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours with transparency, heights, and the places of pixels by the world file."""
    given: dict[str, Any] = {"metres_per_pixel": SIDE_M, "margin_m": 6.0}
    output = render_birds_eye(BirdsEyeOptions(config, **given | options), QUIET)
    colours = np.asarray(Image.open(output / "road.png"))
    heights = np.asarray(Image.open(output / "height.tif"))
    assert (output / "road.pgw").read_text() == (output / "height.tfw").read_text()
    a, d, b, e, c, f = map(float, (output / "road.pgw").read_text().split())
    row, column = np.indices(heights.shape)
    return colours, heights, np.stack([a * column + b * row + c, d * column + e * row + f], -1)


@pytest.fixture(scope="module")
def road(scene, of_the_yard, tmp_path_factory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return render(write_config(tmp_path_factory.mktemp("road") / "config.yml", scene))


def seen_by_a_camera(drive: RoomDrive, points: np.ndarray) -> np.ndarray:
    """Whether a training camera sees points, with a straight line to each: of the lens only its angle is asked."""
    seen = np.zeros(len(points), bool)
    for frame in (frame for frame in drive.frames if frame % 8 != 4):
        for name in ("image_02", "image_03"):
            pose = drive.camera_to_world(name, frame)
            ahead = points - pose[:3, 3]
            away = np.linalg.norm(ahead, axis=1)
            rays = ahead / away[:, None]
            seen |= (to_yard(pose[:3, 3], rays) > away - 1e-3) & (rays @ pose[:3, 2] > np.cos(np.radians(95)))
    return seen


def test_pixels_are_where_the_world_file_says_and_as_high_as_the_yard(road):
    colours, heights, place = road
    shown = colours[..., 3] == 255
    np.testing.assert_array_equal(shown, np.isfinite(heights))
    assert set(np.unique(colours[..., 3])) == {0, 255} and 0.3 < shown.mean() < 0.9
    inner = ((place > BOX[0, :2]) & (place < BOX[1, :2])).all(-1)
    np.testing.assert_allclose(heights[shown], np.where(inner, BOX_M, FLOOR_M)[shown], atol=2e-3)
    assert (shown & inner).sum() > 0.9 * inner.sum()
    # the colour tells the place: north is up, and a pixel's centre is meant
    np.testing.assert_allclose(colours[shown][:, :3] / 255, colours_at(place[shown]), atol=0.5 / 255 + 1e-3)
    assert colours.shape[:2] == tuple(np.round(np.ptp(place, axis=(0, 1))[::-1] / SIDE_M).astype(int) + 1)


def test_what_nothing_shows_is_transparent(drive, road):
    colours, _, place = road
    shown = colours[..., 3] == 255
    path = [[drive.camera_to_world(name, frame)[:2, 3] for frame in (0, 8)] for name in ("image_02", "image_03")]
    first, last = np.mean(path, axis=0)
    dense = np.linspace(first, last, 200)
    away = np.linalg.norm(place[:, :, None] - dense, axis=-1).min(-1)
    assert not shown[away > 6.3].any()
    assert not shown[((place > EMPTY[0]) & (place < EMPTY[1])).all(-1)].any()
    # inside the northern wall, where rays begin
    assert not shown[place[..., 1] > ROOM[1, 1]].any()
    near = (away < 5.7) & (place[..., 1] < ROOM[1, 1] - 0.1) & ~((place > EMPTY[0]) & (place < EMPTY[1])).all(-1)
    height = np.where(((place > BOX[0, :2]) & (place < BOX[1, :2])).all(-1), BOX_M, FLOOR_M)
    points = np.concatenate([place, height[..., None]], -1)[near]
    truly = seen_by_a_camera(drive, points)
    # the box hides some of the floor; at the edges of its shadow, distances agree by chance
    assert 30 < (~truly).sum() < 0.5 * len(truly)
    assert (shown[near] == truly).mean() > 0.97 and shown[near][~truly].mean() < 0.25


def test_what_is_above_the_cut_is_not_in_the_picture(road, trained, tmp_path):
    _, below, place = road
    under_roof = np.isfinite(below) & (place[..., 0] > ROOF_FROM_M + 0.1)
    assert under_roof.sum() > 1000 and below[under_roof].max() < BOX_M
    # rays that begin above the roof meet it; cameras see its lower side alone, 0.3 m below: near enough
    _, above, _ = render(trained, above_m=3.0, output=tmp_path / "above")
    shown = np.isfinite(above) & (place[..., 0] > ROOF_FROM_M + 0.1)
    assert shown.any()
    np.testing.assert_allclose(above[shown], ROOF_M + 0.3, atol=2e-3)
    # 1.2 m below the cameras, which is below the top of the box
    _, low, _ = render(trained, above_m=-1.2, output=tmp_path / "low")
    assert np.nanmax(low) < FLOOR_M + 2e-3


def test_an_interrupted_run_goes_on(trained, monkeypatch):
    made = []
    whole = birds_eye.render_tile

    def until_the_third(*given: Any) -> Any:
        made.append(given[1])
        if len(made) == 3:
            raise KeyboardInterrupt
        return whole(*given)

    # so small that some tiles within reach have no pixel near the path
    monkeypatch.setattr(birds_eye, "TILE_PX", 16)
    monkeypatch.setattr("edge_depth_nerf.films.ground_plan.TILE_PX", 16)
    monkeypatch.setattr(birds_eye, "render_tile", until_the_third)
    narrow = {"margin_m": 2.0}
    with pytest.raises(KeyboardInterrupt):
        render(trained, **narrow)
    tiles = sorted((trained.parent / "birds_eye/tiles").iterdir())
    assert len(tiles) == 2
    monkeypatch.setattr(birds_eye, "render_tile", lambda *given: made.append(given[1]) or whole(*given))
    colours, heights, _ = render(trained, **narrow)
    # the one that was interrupted is begun again, the two before are not
    assert len(made) == 1 + len({(tile.row, tile.column) for tile in made})
    other = render(trained, output=trained.parent / "at_once", **narrow)
    np.testing.assert_array_equal(colours, other[0])
    np.testing.assert_array_equal(heights, other[1])
    # a finished picture is kept, and its parts are gone
    count, changed = len(made), (trained.parent / "birds_eye/road.png").stat().st_mtime_ns
    render(trained, **narrow)
    assert len(made) == count and (trained.parent / "birds_eye/road.png").stat().st_mtime_ns == changed
    assert sorted(path.name for path in (trained.parent / "birds_eye").iterdir()) == [
        *("birds_eye.json", "height.tfw", "height.tif", "road.pgw", "road.png"),
    ]
    with pytest.raises(InputError, match=r"holds other pictures \(margin_m differs"):
        render(trained, margin_m=3.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"metres_per_pixel": 0.0}, "--metres-per-pixel 0.0: expected 0.005 to 10 metres"),
        ({"margin_m": float("nan")}, "--margin-m nan"),
        ({"above_m": 99.0}, "--above-m 99.0: expected -5 to 50"),
        ({"metres_per_pixel": 0.005, "margin_m": 200.0}, "more than 100 million. Use larger pixels"),
    ],
)
def test_options_that_cannot_be_used(trained, options, message):
    with pytest.raises(InputError, match=message):
        render(trained, **options)
    assert not (trained.parent / "birds_eye").exists()


def test_a_folder_with_something_else_is_refused(trained, tmp_path):
    write_json(tmp_path / "mine/notes.json", {})
    with pytest.raises(InputError, match="mine: holds something else"):
        render(trained, output=tmp_path / "mine")


def test_a_scene_on_its_side_is_refused(trained, tmp_path):
    meta = read_json((scene := write_scene(tmp_path / "side")) / "transforms.json")
    for frame in meta["frames"]:
        # the cameras look down, with their upper side along y
        place = np.array(frame["transform_matrix"])[:3, 3:]
        frame["transform_matrix"] = [*np.hstack([np.eye(3), place]).tolist(), [0, 0, 0, 1]]
    write_json(scene / "transforms.json", meta)
    with pytest.raises(InputError, match="z is not up in this scene"):
        render_birds_eye(BirdsEyeOptions(write_config(tmp_path / "side.yml", scene)), QUIET)


def test_the_path_is_filled_between_frames_but_not_across_gaps():
    positions = np.array([[0, -1, 2.0], [0, 1, 2.2], [4, -1, 3.0], [4, 1, 3.2], [104, 0, 3.0]])
    path = driven_path([0, 0, 1, 1, 2], positions)
    np.testing.assert_allclose(path[0], [0, 0, 2.2])
    np.testing.assert_allclose(path[-2:], [[4, 0, 3.2], [104, 0, 3.0]])
    steps = np.linalg.norm(np.diff(path[:-1], axis=0), axis=1)
    assert steps.max() <= 0.5 and steps.sum() == pytest.approx(np.hypot(4, 1))
    plan = GroundPlan(path, 0.5, 3.0)
    assert (plan.width, plan.height) == (220, 12)
    covered = np.zeros((plan.height, plan.width), bool)
    for tile in plan.tiles():
        covered[tile.slices] |= plan.of_tile(tile)[2]
    row, column = np.indices(covered.shape) + 0.5
    place = np.stack([-3 + column * 0.5, 3 - row * 0.5], -1)
    near = np.linalg.norm(place[:, :, None] - path[:, :2], axis=-1).min(-1) <= 3
    np.testing.assert_array_equal(covered, near)
