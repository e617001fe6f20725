"""Masks: the lens circle, the vehicle, moving things, the sky; on small analytic worlds, a drive, and real data."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.cameras import MEI, Pinhole
from edge_depth_nerf.masks import ego, lens, sky
from edge_depth_nerf.process.kitti360.calibration import read_cam_to_pose, read_mei_camera

SIZE = 240
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]


def iou(found: Mask, true: Mask) -> float:
    return float((found & true).sum() / (found | true).sum())


def pixels(height: int = SIZE, width: int = SIZE) -> tuple[NDArray, NDArray]:
    y, x = np.mgrid[:height, :width] + 0.5
    return x, y


def as_picture(grey: NDArray, seed: int, noise: float = 2.0) -> Picture:
    rng = np.random.default_rng(seed)
    return np.clip(np.rint(grey[..., None] + noise * rng.standard_normal((*grey.shape, 3))), 0, 255).astype(np.uint8)


# ---- dark rim --------------------------------------------------------------------------------------------------
def lens_picture(
    radius: tuple[float, float], centre: tuple[float, float], seed: int, level: float = 130.0, shape: str = "round"
) -> Picture:
    """Texture inside an ellipse, which fades within 4 pixels to black with a little glare."""
    x, y = pixels()
    texture = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=(SIZE, SIZE)), (0, 0), 6)
    texture = level * (1 + 0.4 * texture / texture.std())
    u, v = np.abs(x - centre[0]) / radius[0], np.abs(y - centre[1]) / radius[1]
    off = np.hypot(u, v) if shape == "round" else np.maximum(u, v)
    light = np.clip(0.5 + (1 - off) * radius[0] / 4, 0, 1)
    return as_picture(np.clip(texture, 20, None) * light + 8, seed)


@pytest.mark.parametrize(
    ("radius", "centre"),
    [
        ((110.0, 110.0), (120.0, 120.0)),
        # off the middle, no circle
        ((104.0, 98.0), (128.0, 115.0)),
        # cut off at the top, bottom and left
        ((125.0, 125.0), (110.0, 120.0)),
    ],
)
def test_dark_rim_is_found(radius: tuple[float, float], centre: tuple[float, float]) -> None:
    x, y = pixels()
    true = np.hypot((x - centre[0]) / radius[0], (y - centre[1]) / radius[1]) <= 1
    pictures = [lens_picture(radius, centre, seed) for seed in range(3)]
    # a smear across, and an object as dark as the rim at its edge
    pictures[1][100:103] = 255
    for picture in pictures:
        picture[180:, 90:150] = np.minimum(picture[180:, 90:150], 9)
    found = lens.dark_rim(pictures)
    assert found is not None
    assert iou(found, true) > 0.985


def test_pictures_without_dark_rim_have_none() -> None:
    x, y = pixels()
    full = as_picture(np.full((SIZE, SIZE), 120.0), 0, noise=30)
    vignette = as_picture(200 * np.exp(-((np.hypot(x - 120, y - 120) / 150) ** 2)), 1)
    night = as_picture(np.full((SIZE, SIZE), 6.0), 2)
    # lamps by night
    night[(np.hypot(x - 60, y - 80) < 12) | (np.hypot(x - 200, y - 100) < 20)] = 250
    small_mouth = lens_picture((50.0, 50.0), (120.0, 120.0), 3)
    square_mouth = lens_picture((90.0, 80.0), (120.0, 130.0), 4, shape="square")
    too_dark = lens_picture((105.0, 105.0), (120.0, 120.0), 5, level=20.0)
    for picture in (full, vignette, night, small_mouth, square_mouth, too_dark):
        assert lens.dark_rim([picture]) is None
    # a round mouth of a tunnel, which has been left in the next picture
    mouth = lens_picture((90.0, 90.0), (120.0, 120.0), 6)
    assert lens.dark_rim([mouth]) is not None
    assert lens.dark_rim([mouth, full]) is None
    assert lens.dark_rim([]) is None


def test_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="different sizes"):
        lens.dark_rim([np.zeros((40, 40, 3), np.uint8), np.zeros((40, 41, 3), np.uint8)])
    with pytest.raises(ValueError, match="lens mask"):
        ego.find_ego([lambda: np.zeros((SIZE, SIZE + 1, 3), np.uint8)], lens_disc())


# ---- the vehicle -----------------------------------------------------------------------------------------------
def lens_disc() -> Mask:
    x, y = pixels()
    return np.hypot(x - SIZE / 2, y - SIZE / 2) < 112


def vehicle_shape() -> Mask:
    """A bonnet at the bottom, and a round thing on it."""
    x, y = pixels()
    return (y > 175 + 0.002 * (x - 120) ** 2) | (np.hypot(x - 80, y - 172) < 14)


class SlidingWorld:
    """Texture that slides sideways under a sky that does not change: faint below, strong at the horizon."""

    def __init__(self, vehicle: Mask | None) -> None:
        rng = np.random.default_rng(7)
        texture = cv2.GaussianBlur(rng.normal(size=(SIZE, 4 * SIZE)), (0, 0), 1.5)
        y = np.arange(SIZE)[:, None]
        strength = np.where(y < 80, 0.0, np.where(y < 130, 35.0, 7.0))
        self.world = np.where(y < 80, 254.0, 90.0) + strength * texture / texture.std()
        self.vehicle = np.zeros((SIZE, SIZE), bool) if vehicle is None else vehicle
        x, y = pixels()
        # bright paint with shading and a dark part
        self.paint = 190 - 0.3 * x
        self.paint[(x > 150) & (x < 175)] = 25
        self.lens = lens_disc()

    def picture(self, place_px: int, seed: int, light: float = 0.0) -> Picture:
        """Exposure drifts by 10 %; light makes one side of the vehicle brighter."""
        x, _ = pixels()
        seen = np.roll(self.world, place_px, 1)[:, :SIZE]
        seen = np.where(self.vehicle, self.paint * (1 + light * (x - 120) / 120), seen)
        return as_picture(np.where(self.lens, seen * (1 + 0.1 * np.sin(seed / 4)), 4), seed)

    def drive(self, count: int, step_px: int = 11) -> list[Picture]:
        return [self.picture(step_px * k, k, 0.1 * np.sin(k / 3)) for k in range(count)]


@pytest.mark.parametrize("count", [12, 24])
def test_the_vehicle_is_found_and_nothing_else(count: int) -> None:
    world = SlidingWorld(vehicle_shape())
    found = ego.find_ego(world.drive(count), world.lens)
    assert isinstance(found, ego.EgoMask)
    true = vehicle_shape() & world.lens
    assert iou(~found.keep & world.lens, true) > 0.95
    assert found.keep[:150][world.lens[:150]].all(), "the sky that never changes is not the vehicle"
    assert found.share == pytest.approx(true.sum() / world.lens.sum(), rel=0.05)
    assert found.certainty > 0.9
    assert found.pictures == count
    # outside the lens the nearest pixel inside decides
    assert not found.keep[-1, SIZE // 2]
    assert found.keep[0, 0]


def test_holes_are_filled_and_islands_dropped() -> None:
    world = SlidingWorld(vehicle_shape())
    x, y = pixels()
    lamp, dirt = np.hypot(x - 120, y - 205) < 6, np.hypot(x - 140, y - 110) < 9
    pictures = world.drive(20)
    for number, picture in enumerate(pictures):
        picture[lamp] = 240 if number % 2 else 60
        picture[dirt] = 30
    found = ego.find_ego(pictures, world.lens)
    assert isinstance(found, ego.EgoMask)
    assert not found.keep[lamp].any()
    assert found.keep[dirt].all()
    assert iou(~found.keep & world.lens, vehicle_shape() & world.lens) > 0.95


def test_white_paint_in_the_sun_is_of_the_vehicle() -> None:
    x, y = pixels()
    mirror = np.hypot(x - 82, y - 152) < 10
    world = SlidingWorld(vehicle_shape() | mirror)
    # the sun leaves the mirror white, whatever the exposure; far from the vehicle something else is
    lamp = np.hypot(x - 200, y - 125) < 4
    world.paint[mirror] = 400
    pictures = world.drive(20)
    for picture in pictures:
        picture[lamp] = 255
    found = ego.find_ego(pictures, world.lens)
    assert isinstance(found, ego.EgoMask)
    assert (~found.keep)[mirror].mean() > 0.99
    assert found.keep[lamp].all()
    assert found.keep[:140][world.lens[:140]].all(), "the sky is white as well"


def test_why_no_vehicle_is_found() -> None:
    world = SlidingWorld(vehicle_shape())
    few = ego.find_ego(world.drive(ego.MIN_PICTURES - 1), world.lens)
    assert isinstance(few, ego.NoEgo)
    assert "too few" in few.reason and not few.could_tell
    standing = ego.find_ego([world.picture(0, k) for k in range(16)], world.lens)
    assert isinstance(standing, ego.NoEgo)
    assert "stands" in standing.reason and not standing.could_tell
    bare = SlidingWorld(None)
    none = ego.find_ego(bare.drive(16), bare.lens)
    assert isinstance(none, ego.NoEgo) and none.could_tell
    assert ego.find_ego([], np.zeros((SIZE, SIZE), bool)) == ego.NoEgo("The lens mask leaves no pixel.", False)


def test_pictures_of_one_colour_are_no_vehicle() -> None:
    """Black, grey, white, or of another exposure each: nothing is found, and nothing fails."""
    for levels in ([0] * 12, [90] * 12, [255] * 12, [0, 60, 255] * 4):
        pictures = [np.full((SIZE, SIZE, 3), level, np.uint8) for level in levels]
        found = ego.find_ego(pictures, lens_disc())
        assert isinstance(found, ego.NoEgo)
    # flat but for a corner, where sums of squares lose their last digits
    pictures = [as_picture(np.full((SIZE, SIZE), 100.0), 0, noise=0) for _ in range(12)]
    for number, picture in enumerate(pictures):
        picture[:60, :60] = 40 + 15 * number
        picture[60:120:2] = 30 + 15 * number
    assert ego.find_ego(pictures, lens_disc()) is not None


@pytest.mark.parametrize("first_row", [130, vehicle_shape().any(1).argmax() + 20])
def test_road_without_texture_is_not_taken_for_the_vehicle(first_row: int) -> None:
    """What is near may pass too fast to show texture: it stays the same, and what lies beyond clearly changes."""
    bare = SlidingWorld(None)
    bare.world[first_row:] = 90
    found = ego.find_ego(bare.drive(16), bare.lens)
    assert isinstance(found, ego.NoEgo)
    assert "smooth road" in found.reason


@pytest.mark.parametrize("textured", [True, False])
def test_paint_like_the_road_is_told_from_it_by_its_own_texture(textured: bool) -> None:
    """As bright as the road, so that there is no edge between them; without any texture nothing tells them apart."""
    world = SlidingWorld(vehicle_shape())
    rng = np.random.default_rng(3)
    texture = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), 1.5)
    world.paint = 90 + (3.0 if textured else 0.0) * texture / texture.std()
    found = ego.find_ego([world.picture(11 * number, number) for number in range(24)], world.lens)
    if textured:
        assert isinstance(found, ego.EgoMask)
        assert iou(~found.keep & world.lens, vehicle_shape() & world.lens) > 0.95
        assert found.certainty > 0.9
    else:
        assert isinstance(found, ego.NoEgo)
        assert "no clear outline" in found.reason


def test_a_stop_does_not_count() -> None:
    world = SlidingWorld(vehicle_shape())
    stop = [world.picture(0, k) for k in range(20)]
    found = ego.find_ego(stop + world.drive(20)[1:], world.lens)
    assert isinstance(found, ego.EgoMask)
    assert found.pictures == 20
    assert iou(~found.keep & world.lens, vehicle_shape() & world.lens) > 0.95


def test_pictures_of_a_long_drive_are_thinned_out() -> None:
    world = SlidingWorld(vehicle_shape())
    loaded = []

    def loader(number: int) -> Callable[[], Picture]:
        def load() -> Picture:
            loaded.append(number)
            return world.picture(11 * number, number)

        return load

    found = ego.find_ego([loader(number) for number in range(300)], world.lens)
    assert isinstance(found, ego.EgoMask)
    assert ego.MAX_PICTURES / 2 <= found.pictures < ego.MAX_PICTURES
    assert len(loaded) < 200
    assert loaded[-1] > 290, "the end of the drive was looked at as well"


# ---- sky -------------------------------------------------------------------------------------------------------
FOCAL_PX = 100.0
CAMERA = Pinhole(SIZE, SIZE, FOCAL_PX, FOCAL_PX, SIZE / 2, SIZE / 2)
UP = np.array([0.0, -1.0, 0.0])
"""Of a level camera."""
USE = np.ones((SIZE, SIZE), bool)
NO_LIDAR = np.zeros((SIZE, SIZE), np.float32)


def outdoors() -> tuple[Picture, Mask]:
    """Blue and white sky down to the horizon, dark ground, a grey house as high as 27°; second, where there is sky."""
    x, y = pixels()
    blue = 200 + 20 * np.sin(x / 40)
    rgb = np.stack((blue - 50 + 0.3 * y, blue - 20 + 0.15 * y, blue), -1)
    house = (np.abs(x - 60) < 25) & (y > 70)
    rgb[house] = 135
    rgb[y > SIZE / 2] = 80
    noise = np.random.default_rng(0).normal(0, 2, rgb.shape)
    return np.clip(rgb + noise, 0, 255).astype(np.uint8), ~house & (y < SIZE / 2)


def test_sky_ends_at_the_horizon_though_the_ground_is_as_bright() -> None:
    found = sky.find_sky(as_picture(np.full((SIZE, SIZE), 230.0), 0), USE, UP, CAMERA, NO_LIDAR)
    _, y = pixels()
    elevation_deg = np.degrees(np.arctan2(SIZE / 2 - y, np.hypot(FOCAL_PX, pixels()[0] - SIZE / 2)))
    assert found[elevation_deg > 2].all()
    assert not found[elevation_deg < 0].any()


def test_up_decides_where_the_horizon_is() -> None:
    picture, true = outdoors()
    turned = np.ascontiguousarray(np.rot90(picture, -1))
    found = sky.find_sky(turned, USE, np.array([1.0, 0.0, 0.0]), CAMERA, NO_LIDAR)
    assert found.sum() > 0.9 * true.sum()
    assert not (found & ~np.rot90(true, -1)).any()
    # upside down: the bright half is ground
    assert not sky.find_sky(picture, USE, -UP, CAMERA, NO_LIDAR).any()


def test_what_is_known_to_be_near_is_not_sky() -> None:
    picture, true = outdoors()
    x, y = pixels()
    crown = (np.hypot(x - 170, y - 40) < 20) & true
    mono = np.where(crown, 5.0, np.where(true, 70.0, 15.0)).astype(np.float32)
    lidar_points = NO_LIDAR.copy()
    lidar_points[20, 100] = 60.0
    found = sky.find_sky(picture, USE, UP, CAMERA, lidar_points, mono)
    assert not found[crown].any()
    assert not found[19:22, 100].any()
    assert not found[20, 99:102].any()
    assert (
        found[true & (np.hypot(x - 170, y - 40) > 24) & (np.hypot(x - 100.5, y - 20.5) > 6) & (y < 110)].mean() > 0.97
    )
    masked = USE.copy()
    masked[:, 120:] = False
    assert not sky.find_sky(picture, masked, UP, CAMERA, NO_LIDAR)[:, 120:].any()


def test_ceilings_are_not_sky() -> None:
    _, y = pixels()
    # a beam with light on it in a dark place
    beam = as_picture(np.where(np.abs(y - 50) < 15, 125.0, 75.0), 0)
    assert not sky.find_sky(beam, USE, UP, CAMERA, NO_LIDAR).any()
    room = as_picture(np.where(y < SIZE / 2, 185.0, 150.0), 0)
    assert not sky.find_sky(room, USE, UP, CAMERA, NO_LIDAR).any()
    white = as_picture(np.where(y < SIZE / 2, 230.0, 90.0), 0)
    distance = np.where(y < SIZE / 2, 2.0 / np.maximum(np.sin(np.arctan2(SIZE / 2 - y, FOCAL_PX)), 1e-3), 3.0)
    near = np.minimum(distance, 250).astype(np.float32)
    assert not sky.find_sky(white, USE, UP, CAMERA, NO_LIDAR, near).any()


def test_incomplete_blocks_of_large_pictures() -> None:
    picture, true = outdoors()
    size = 5 * SIZE + 1
    large = cv2.resize(picture, (size, size), interpolation=cv2.INTER_NEAREST)
    larger_true = cv2.resize(true.astype(np.uint8), (size, size), interpolation=cv2.INTER_NEAREST).astype(bool)
    camera = Pinhole(size, size, 5 * FOCAL_PX, 5 * FOCAL_PX, 2.5 * SIZE, 2.5 * SIZE)
    found = sky.find_sky(large, np.ones((size, size), bool), UP, camera, np.zeros((size, size), np.float32))
    assert found.shape == (size, size)
    assert iou(found, larger_true) > 0.93


# ---- a drive, and the real frame -------------------------------------------------------------------------------
@pytest.mark.parametrize("name", ["image_02", "image_03"])
def test_masks_of_the_sample_drive(sample_drive: Path, name: str) -> None:
    meta = read_json(sample_drive / "transforms.json")
    frames = [frame for frame in meta["frames"] if frame["camera"] == name]
    parameters = meta["original_cameras"][name]
    assert parameters.pop("model") == "MEI"
    camera = MEI(**parameters)
    circle, used = lens.lens_circle(camera, meta["theta_max_deg"]), read_mask(sample_drive / f"masks/{name}.png")
    rim = lens.dark_rim(read_image(sample_drive / frame["file_path"]) for frame in frames[::4])
    assert rim is not None
    assert iou(rim, lens.lens_circle(camera, 98.0)) > 0.97
    found = ego.find_ego([partial(read_image, sample_drive / frame["file_path"]) for frame in frames], circle)
    assert isinstance(found, ego.EgoMask)
    assert found.certainty > 0.8
    assert iou(circle & ~found.keep, circle & ~used) > 0.95

    for frame in frames[::5]:
        # the camera's axes are OpenGL's, the world's z points up
        up = np.array(frame["transform_matrix"])[2, :3] * (1, -1, -1)
        truth = read_distance_png(sample_drive / frame["truth_distance_file_path"])
        lidar_points, mono = (
            read_distance_png(sample_drive / frame[f"{kind}_file_path"]) for kind in ("lidar", "mono")
        )
        found_sky = sky.find_sky(read_image(sample_drive / frame["file_path"]), used, up, camera, lidar_points, mono)
        true = used & (truth == 0)
        assert (found_sky & true).sum() > 0.95 * true.sum()
        assert (found_sky & (truth > 0) & (truth < 80)).sum() < 0.02 * found_sky.sum()


def test_the_real_frame(real_data: Path) -> None:
    folder = real_data / "kitti360_fisheye_frame"
    picture, hidden = read_image(folder / "kitti360_rgb.png"), np.load(folder / "mask_left_fisheye.npy")
    model = read_mei_camera(real_data / "kitti360_calibration/image_02.yaml")
    rim = lens.dark_rim([picture])
    assert rim is not None
    # half of the light is lost near 99°
    assert iou(rim, lens.lens_circle(model, 99.0)) > 0.98
    # at the bottom the real mask hides all that the lens does not show
    assert hidden[1000:][~rim[1000:]].all()
    circle = lens.lens_circle(model, 95.0)
    up = read_cam_to_pose(real_data / "kitti360_calibration/calib_cam_to_pose.txt")["image_02"][:3, :3].T @ (0, 0, -1.0)
    lidar_points = read_distance_png(folder / "kitti360_depth.png")
    found = sky.find_sky(picture, circle & ~hidden, up, model, lidar_points)
    assert found[:440][circle[:440]].mean() > 0.8
    assert not found[700:].any()
    assert not found[lidar_points > 0].any()
    for path in (real_data / "kitti360_stereo").glob("*.png"):
        assert lens.dark_rim([read_image(path)]) is None


@pytest.mark.parametrize(
    ("columns", "kept"), [((10, 90), True), ((0, 20), True), ((80, 100), True), ((40, 60), False), ((15, 40), False)]
)
def test_a_vehicle_touches_the_lower_rim_broadly_or_a_corner(columns: tuple[int, int], kept: bool) -> None:
    """Strips of lane that stay alike in a few pictures end in the middle of the lower edge."""
    lens, vehicle = np.ones((60, 100), bool), np.zeros((60, 100), bool)
    vehicle[40:, slice(*columns)] = True
    assert ego._at_vehicles_place(vehicle, lens).any() == kept


def test_sky_is_found_above_the_horizon() -> None:
    picture, true = outdoors()
    found = sky.find_sky(picture, USE, UP, CAMERA, NO_LIDAR)
    assert not (found & ~true).any()
    _, y = pixels()
    # the lowest degree is left out
    assert found[true & (y < SIZE / 2 - FOCAL_PX * np.tan(np.radians(2.0)))].mean() > 0.97
