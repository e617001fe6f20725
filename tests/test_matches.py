"""Features matched between pictures, and their distances to epipolar curves: against curves drawn point by point."""

import math

import cv2
import numpy as np
import pytest
import torch
from alignment import pose
from lenses import FISHEYE

from edge_depth_nerf.cameras import Camera, Pinhole
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.poses.matches import (
    LARGEST_SIDE_PX,
    Features,
    Matches,
    PosedPicture,
    Sights,
    along_drive,
    epipolar_distance_px,
    find_features,
    match_features,
    match_pictures,
    sights_of,
)

PINHOLE = Pinhole(640, 480, 400.0, 405.0, 318.0, 243.0, -0.05, 0.01, 1e-3, -5e-4)
LENSES = [pytest.param(FISHEYE, id="fisheye"), pytest.param(PINHOLE, id="pinhole")]


def seen(lens: Camera, points_m: np.ndarray, camera_to_world: np.ndarray) -> np.ndarray:
    """Pixels of points in the world, NaN where the lens has none."""
    in_camera = (points_m - camera_to_world[:3, 3]) @ camera_to_world[:3, :3]
    return lens.project(torch.from_numpy(in_camera))[0].numpy()


def matches_of(
    lens: Camera, first: np.ndarray, second: np.ndarray, rng: np.random.Generator, sideways: float = 1.0
) -> Matches:
    away = rng.normal(size=(400, 3))
    away[:, :2] *= sideways
    away[:, 2] = np.abs(away[:, 2]) + 0.5
    points_m = away / np.linalg.norm(away, axis=-1, keepdims=True) * rng.uniform(3, 30, (400, 1))
    both = np.stack([seen(lens, points_m, first), seen(lens, points_m, second)])
    both = both[:, np.isfinite(both).all((0, 2))]
    (in_first, _), (in_second, _) = sights_of(lens, both[0]), sights_of(lens, both[1])
    index = np.arange(both.shape[1])
    return Matches(0, 1, np.stack((index, index), -1), in_first, in_second)


@pytest.mark.parametrize("lens", LENSES)
def test_true_poses_have_no_distance(lens: Camera) -> None:
    first, second = pose((3, -5, 2), (1, 2, 0.3)), pose((1, 4, -3), (1.4, 1.8, 1.2))
    matches = matches_of(lens, first, second, np.random.default_rng(1))
    distances = epipolar_distance_px(matches, first, second)
    known = np.isfinite(distances)
    assert known.sum() > 100
    assert distances[known].max() < 1e-6


@pytest.mark.parametrize("lens", LENSES)
def test_distance_is_that_to_the_curve_as_it_is_drawn(lens: Camera) -> None:
    first, second = pose((0, 0, 0), (0, 0, 0)), pose((1, 2, 1), (0.5, 0.1, 0.7))
    matches = matches_of(lens, first, second, np.random.default_rng(2))
    wrong = second @ pose((0.15, -0.1, 0.1), (0, 0, 0))
    distances = epipolar_distance_px(matches, first, wrong)

    def to_curve(here: np.ndarray, there: np.ndarray, of: Sights, sights: Sights, n: int) -> float:
        """Smallest distance of a feature from the picture of the other's ray, point by point."""
        along = of.rays[n] @ there[:3, :3].T
        depths = np.geomspace(0.3, 3000, 4001)
        for _ in range(2):
            drawn = seen(lens, there[:3, 3] + depths[:, None] * along, here)
            apart = np.linalg.norm(drawn - sights.pixels[n], axis=-1)
            nearest = int(np.nanargmin(apart))
            # the curve ends at the epipole and at infinity, where the plane goes on
            if nearest in np.flatnonzero(np.isfinite(apart))[[0, -1]]:
                return math.nan
            depths = np.linspace(depths[nearest - 1], depths[nearest + 1], 1001)
        return float(apart[nearest])

    checked = 0
    for n in np.flatnonzero(np.isfinite(distances))[:60]:
        expected = (
            to_curve(first, wrong, matches.in_second, matches.in_first, n)
            + to_curve(wrong, first, matches.in_first, matches.in_second, n)
        ) / 2
        if np.isfinite(expected):
            assert distances[n] == pytest.approx(expected, rel=0.02, abs=0.01)
            checked += 1
    assert checked > 30


def test_poses_that_say_nothing_give_no_distance() -> None:
    first, second = pose((0, 0, 0), (0, 0, 0)), pose((0, 0, 0), (0, 0, 1))
    matches = matches_of(PINHOLE, first, second, np.random.default_rng(3), sideways=0.05)
    near_axis = matches.in_first.rays[:, 2] > math.cos(math.radians(2))
    assert near_axis.any()
    assert np.isnan(epipolar_distance_px(matches, first, second)[near_axis]).all()
    assert np.isnan(epipolar_distance_px(matches, first, pose((0, 0, 0), (0, 0, 0.01)))).all()


def wall(camera_to_world: np.ndarray, lens: Camera) -> np.ndarray:
    """A picture of a wall with a random pattern, three metres high steps of it at two depths."""
    noise = np.random.default_rng(4).uniform(0, 255, (60, 160)).astype(np.float32)
    texture = cv2.resize(noise, (1600, 600), interpolation=cv2.INTER_CUBIC).clip(0, 255)
    of_pixels = rays(lens)
    along = of_pixels.directions @ camera_to_world[:3, :3].T
    start = camera_to_world[:3, 3]
    picture = np.zeros(along.shape[:2], np.float32)
    for depth_m, rows in ((8.0, (along[..., 1] < 0.0)), (12.0, (along[..., 1] >= 0.0))):
        point = (
            start + along * ((depth_m - start[2]) / np.where(along[..., 2] > 0.05, along[..., 2], np.inf))[..., None]
        )
        x, y = (point[..., 0] + 16) * 50 - 0.5, (point[..., 1] + 6) * 50 - 0.5
        drawn = cv2.remap(texture, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
        picture = np.where(rows & of_pixels.within, drawn, picture)
    return np.repeat(picture.clip(0, 255).astype(np.uint8)[..., None], 3, -1)


def pictures(poses: list[np.ndarray], lens: Camera = PINHOLE) -> list[PosedPicture]:
    return [PosedPicture("front", 10 + n, lens, at, lambda at=at: wall(at, lens)) for n, at in enumerate(poses)]


@pytest.mark.slow
def test_along_a_drive_right_poses_are_told_from_wrong_ones() -> None:
    poses = [pose((0, 1.5 * n, 0), (0.4 * n, 0, 0)) for n in range(3)]
    right = along_drive(pictures(poses))
    assert [(a.camera, a.first, a.second) for a in right] == [("front", 10, 11), ("front", 11, 12)]
    for found in right:
        assert found.median_px < 0.2
    wrong = [*poses[:2], poses[2] @ pose((0.5, 0, 0), (0, 0, 0))]
    given = pictures(poses)
    placed = [PosedPicture(p.camera, p.frame, p.lens, at, p.read_rgb) for p, at in zip(given, wrong, strict=True)]
    first, second = along_drive(placed)
    assert first.median_px < 0.2
    # half a degree is 3.5 px here, most of it across the curves
    assert second.median_px > 1.5


@pytest.mark.slow
def test_masks_and_sizes() -> None:
    lens = Pinhole(1600, 800, 1000.0, 1000.0, 800.0, 400.0)
    assert lens.width > LARGEST_SIDE_PX
    usable = np.zeros((800, 1600), bool)
    usable[200:700, 200:1300] = True
    at = pose((0, 0, 0), (0, 0, 0))
    drawn = wall(at, lens)
    found = find_features(PosedPicture("front", 0, lens, at, lambda: drawn, lambda: usable), 500)
    assert 100 < len(found.sights) <= 500
    x, y = found.sights.pixels.T
    assert x.min() >= 200 and x.max() <= 1300 and y.min() >= 200 and y.max() <= 700
    # features of the picture made smaller lie where those of the whole one do
    detector = cv2.SIFT_create(500, enable_precise_upscale=True)  # pyrefly: ignore[missing-attribute]
    whole = detector.detect(drawn[..., 0], None)
    places = np.array([point.pt for point in whole]) + 0.5
    apart = np.linalg.norm(places[:, None] - found.sights.pixels, axis=-1)
    near = apart.min(0) < 2
    assert near.sum() > 50
    offset = found.sights.pixels[near] - places[apart[:, near].argmin(0)]
    assert np.abs(np.median(offset, axis=0)).max() < 0.15


def test_nothing_to_see_gives_nothing() -> None:
    black = np.zeros((480, 640, 3), np.uint8)
    given = [PosedPicture("a", n, PINHOLE, pose((0, 0, 0), (n, 0, 0)), lambda: black) for n in range(3)]
    found = along_drive(given)
    assert len(found) == 2 and all(math.isnan(a.median_px) for a in found)
    standing = [PosedPicture("a", n, PINHOLE, pose((0, 0, 0), (0, 0, 0)), lambda: black) for n in range(3)]
    assert along_drive(standing) == []


def test_matches_are_mutual_and_clear() -> None:
    rng = np.random.default_rng(5)
    descriptors = np.abs(rng.normal(size=(50, 128)))
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
    sights, _ = sights_of(PINHOLE, rng.uniform(50, 400, (50, 2)))
    order = rng.permutation(50)
    first = Features(sights, descriptors.astype(np.float32))
    second = Features(sights[order], (descriptors[order]).astype(np.float32))
    found = match_features(first, second)
    assert len(found) == 50
    assert (order[found[:, 1]] == found[:, 0]).all()
    # two of the second that look the same are not told apart, nor by what rounding leaves between them
    for scale in (1, 1 - 1e-6, 1 + 1e-6):
        twin = np.float32(scale) * second.descriptors[:1]
        twins = Features(sights, np.concatenate((second.descriptors[:49], twin)))
        assert not (match_features(first, twins)[:, 0] == order[0]).any()


@pytest.mark.slow
def test_each_picture_is_read_once() -> None:
    read = []

    def reader(n: int, at: np.ndarray) -> np.ndarray:
        read.append(n)
        return wall(at, PINHOLE)

    poses = [pose((0, 0, 0), (0.3 * n, 0, 0)) for n in range(4)]
    given = [PosedPicture("a", n, PINHOLE, at, lambda n=n, at=at: reader(n, at)) for n, at in enumerate(poses)]
    assert len(list(match_pictures(given, [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]))) == 5
    assert sorted(read) == [0, 1, 2, 3]
