"""The sky in pictures that see little of it: a front camera's, in any light, with what looks like sky but is none."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.masks.sky import find_sky
from edge_depth_nerf.process.kitti360.calibration import read_cam_to_pose

Mask = NDArray[np.bool_]

WIDTH, HEIGHT, FOCAL_PX = 360, 224, 311.8
CAMERA = Pinhole(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2)
"""60° wide, 20° up: it never sees as high as fisheyes do."""
UP = np.array([0.0, -1.0, 0.0])
ROWS, COLUMNS = np.indices((HEIGHT, WIDTH))
HORIZON = HEIGHT // 2
USE = np.ones((HEIGHT, WIDTH), bool)
NO_LIDAR = np.zeros((HEIGHT, WIDTH), np.float32)
WHITE = (252, 251, 252)


def sky_of_kind(kind: str) -> NDArray[np.float64]:
    share = np.clip(ROWS / HORIZON, 0, 1)[..., None]
    if kind == "blown out":
        return np.full((HEIGHT, WIDTH, 3), 270.0)
    if kind == "overcast":
        return (195 + 20 * share + 6 * np.sin(COLUMNS / 40)[..., None]) * np.ones(3)
    blue = (1 - share) * (110.0, 175.0, 245.0) + share * (200.0, 225.0, 250.0)
    if kind == "clouds":
        cloud = np.clip(np.sin(COLUMNS / 23) * np.sin(ROWS / 17 + COLUMNS / 60), 0, 1)[..., None]
        blue = blue + 0.6 * cloud * ((245.0, 246.0, 250.0) - blue)
    return blue


def foliage() -> NDArray[np.float64]:
    """Leaves and shade, H×W×3."""
    light = np.random.default_rng(3).uniform(10, 110, (HEIGHT, WIDTH, 1))
    return light * (0.7, 1.0, 0.4)


def street(kind: str = "blue") -> tuple[NDArray[np.float64], Mask]:
    """A road between trees under the sky; second, where the sky is."""
    sky = (np.abs(COLUMNS - 180) < 110 - 0.7 * ROWS + 6 * np.sin(ROWS / 5)) & (ROWS < HORIZON - 12)
    colours = np.where(sky[..., None], sky_of_kind(kind), foliage())
    colours[HORIZON:] = 95
    return colours, sky


def taken(colours: NDArray[np.float64]) -> NDArray[np.uint8]:
    """As a sensor gives it."""
    noise = np.random.default_rng(0).normal(0, 2, colours.shape)
    return np.clip(np.rint(colours + noise), 0, 255).astype(np.uint8)


def box(left: int, right: int, top: int, bottom: int) -> Mask:
    return (COLUMNS >= left) & (COLUMNS < right) & (ROWS >= top) & (ROWS < bottom)


def points_of(where: Mask, top: int) -> NDArray[np.float32]:
    """A scanner's returns at 9 m, every third row and second column below a row."""
    grid = (ROWS % 3 == 0) & (COLUMNS % 2 == 0) & (top <= ROWS)
    return np.where(grid & where, 9, 0).astype(np.float32)


def found_in(colours: NDArray[np.float64], lidar_points: NDArray[np.float32] = NO_LIDAR) -> Mask:
    return find_sky(taken(colours), USE, UP, CAMERA, lidar_points)


@pytest.mark.parametrize("kind", ["blue", "clouds", "overcast", "blown out"])
def test_a_front_camera_sees_the_sky(kind: str) -> None:
    colours, sky = street(kind)
    found = found_in(colours)
    assert found[sky].mean() > 0.95
    assert (found & ~sky).sum() < 0.005 * sky.sum()


def test_sky_between_twigs() -> None:
    colours, sky = street()
    rng = np.random.default_rng(1)
    holes = np.zeros_like(sky)
    for row, column in rng.integers((4, 70), (HORIZON - 40, 290), (400, 2)):
        holes[row : row + 3, column : column + 3] = True
    colours[holes] = sky_of_kind("blue")[holes]
    found = found_in(colours)
    near = np.abs(COLUMNS - 180) < 118 - 0.7 * ROWS + 6 * np.sin(ROWS / 5)
    twigs = holes & ~sky & near
    assert twigs.sum() > 100
    assert found[twigs].mean() > 0.3
    assert (found & ~sky & ~holes).sum() < 0.01 * sky.sum()


def test_sky_beside_a_tree_that_parts_it() -> None:
    colours, sky = street("blown out")
    tree = np.abs(COLUMNS - 215) < 9
    colours[tree] = foliage()[tree]
    found = found_in(colours)
    assert found[sky & ~tree & (COLUMNS > 230)].mean() > 0.9
    assert (found & tree).sum() < 0.02 * tree.sum()


@pytest.mark.parametrize("kind", ["blue", "overcast", "blown out"])
def test_a_white_van_below_the_sky(kind: str) -> None:
    colours, sky = street(kind)
    van = box(120, 200, HORIZON - 50, HORIZON + 30)
    colours[box(117, 203, HORIZON - 53, HORIZON + 33)] = 60
    # what stands upright sees half of a grey sky at best, and sends back less
    colours[van] = 185 if kind == "overcast" else WHITE
    for lidar_points in (NO_LIDAR, points_of(van, HORIZON - 10)):
        found = found_in(colours, lidar_points)
        assert not found[van].any()
        assert found[sky & (ROWS < HORIZON - 56)].mean() > 0.9


def test_a_white_lorry_up_to_the_rim() -> None:
    colours, _ = street()
    lorry = box(60, 320, 0, HORIZON + 40)
    colours[lorry] = WHITE
    assert not found_in(colours)[lorry].any()
    assert not found_in(colours, points_of(lorry, HORIZON - 10))[lorry].any()
    # its lower half hidden by a hedge: returns from a strip above it tell
    colours[HORIZON - 25 :] = foliage()[HORIZON - 25 :]
    assert not found_in(colours, points_of(USE, HORIZON - 40))[lorry].any()


def test_a_white_house_beside_the_blue_sky() -> None:
    colours, sky = street()
    house = box(70, 150, 0, HORIZON - 30)
    colours[house] = 255
    colours[HORIZON - 30 :, :150] = foliage()[HORIZON - 30 :, :150]
    found = found_in(colours)
    assert not found[house].any()
    assert found[sky & ~house & (ROWS < HORIZON - 30)].mean() > 0.9


@pytest.mark.parametrize("level", [190, 252])
def test_a_house_front_with_windows(level: int) -> None:
    colours = foliage()
    colours[HORIZON:] = 95
    front = box(40, 330, 0, HORIZON - 20)
    colours[front] = level
    for left in range(60, 310, 50):
        for top in (15, 55):
            colours[box(left, left + 22, top, top + 25)] = 50
            # the sky in the panes
            colours[box(left + 3, left + 19, top + 3, top + 22)] = (150, 195, 245)
    assert not found_in(colours).any()


def test_pictures_without_a_sky() -> None:
    tunnel = np.full((HEIGHT, WIDTH, 3), 40.0)
    tunnel[box(170, 190, HORIZON - 12, HORIZON + 8)] = 250
    bridge = np.where((ROWS < HORIZON - 15)[..., None], 70.0, foliage())
    bridge[box(100, 140, 20, 24)] = 255
    ceiling = np.full((HEIGHT, WIDTH, 3), 165.0)
    ceiling[HORIZON:] = 140
    ceiling[box(120, 240, 26, 32)] = 255
    for colours in (tunnel, bridge, ceiling, np.zeros_like(tunnel), np.full_like(tunnel, 300.0), 0.25 * street()[0]):
        assert not found_in(colours).any()
    down = np.array([0.0, -0.2, -0.98])
    assert not find_sky(taken(street()[0]), USE, down, CAMERA, NO_LIDAR).any()
    assert not find_sky(taken(street()[0]), ~USE, UP, CAMERA, NO_LIDAR).any()


def test_a_monocular_map_keeps_what_is_near() -> None:
    colours, sky = street("overcast")
    assert not find_sky(taken(colours), USE, UP, CAMERA, NO_LIDAR, NO_LIDAR + 8).any()
    found = find_sky(taken(colours), USE, UP, CAMERA, NO_LIDAR, NO_LIDAR + 60)
    assert found[sky].mean() > 0.95


def test_the_real_drive(real_data: Path) -> None:
    folder = real_data / "kitti360_drive"
    up = read_cam_to_pose(folder / "calibration/calib_cam_to_pose.txt")["image_00"][:3, :3].T @ (0, 0, -1.0)
    camera = Pinhole(1408, 376, 552.554261, 552.554261, 682.049453, 238.769549)
    use, none = np.ones((376, 1408), bool), np.zeros((376, 1408), np.float32)
    for number in range(3000, 3030, 7):
        found = find_sky(read_image(folder / f"images/{number:010d}.png"), use, up, camera, none)
        # the sky at the end of the street, and nothing of hedge, road and the dark garden to the right
        assert found[:60, 670:800].mean() > 0.8
        assert not found[175:].any()
        assert not found[:, 960:].any()
    # a blown-out house front on the left
    assert not find_sky(read_image(folder / "images/0000003000.png"), use, up, camera, none)[:, :370].any()
