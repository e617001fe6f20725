"""Poses refined by features: points seen exactly, from disturbed poses, must bring the true ones back."""

import dataclasses
import math
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from alignment import pose
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.poses.matches import Matches, PosedPicture, sights_of
from edge_depth_nerf.poses.tracks import Tracks, features_joined, join_matches, reprojection_px, spread, triangulate
from edge_depth_nerf.process.colmap import refine as refining
from edge_depth_nerf.process.colmap.bundle import Shot, Softness, _Bundle, adjust_bundle
from edge_depth_nerf.process.colmap.refine import Refinement, _is_check, refine
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, Recording

PINHOLE = Pinhole(640, 480, 400.0, 405.0, 318.0, 243.0, -0.05, 0.01, 1e-3, -5e-4)
FISHEYE = KannalaBrandt(700, 700, 210.0, 210.0, 350.0, 350.0, -0.01, 0.01, -0.002, -0.0002)
FRAMES = 12


@dataclasses.dataclass
class World:
    """A vehicle (x right, y down, z ahead) on a bend, with cameras on it, among points."""

    lenses: list[Camera]
    to_vehicle: list[np.ndarray]
    path: np.ndarray
    points_m: np.ndarray
    rng: np.random.Generator

    @property
    def shots(self) -> list[tuple[int, int]]:
        """Camera and moment of each picture."""
        return [(camera, frame) for frame in range(len(self.path)) for camera in range(len(self.lenses))]

    def poses(self, path: np.ndarray | None = None) -> np.ndarray:
        path = self.path if path is None else path
        return np.stack([path[frame] @ self.to_vehicle[camera] for camera, frame in self.shots])

    def pixels(self, shot: int) -> np.ndarray:
        """Of all points; NaN where one is not seen."""
        camera, at = self.lenses[self.shots[shot][0]], self.poses()[shot]
        in_camera = (self.points_m - at[:3, 3]) @ at[:3, :3]
        pixels, _ = camera.project(torch.from_numpy(in_camera))
        theta = np.arccos(in_camera[:, 2] / np.linalg.norm(in_camera, axis=-1))
        fine = camera.inside(pixels).numpy() & (theta < math.radians(80))
        return np.where(fine[:, None], pixels.numpy(), np.nan)

    def disturbed(self, metres: float = 0.03, degrees: float = 0.1) -> np.ndarray:
        normal = self.rng.normal
        return np.stack([at @ pose([*normal(0, degrees, 3)], [*normal(0, metres, 3)]) for at in self.path])

    def matches(self, noise_px: float, wrong: float = 0.0) -> list[Matches]:
        """Of each picture with the next ones of its camera; some of the features are of other points."""
        rng = self.rng
        seen = [self.pixels(shot) for shot in range(len(self.shots))]
        seen = [pixels + rng.normal(0, noise_px, pixels.shape) for pixels in seen]
        found = []
        for first, (camera, frame) in enumerate(self.shots):
            for apart in (1, 2, 3, 5):
                if (camera, frame + apart) not in self.shots:
                    continue
                second = self.shots.index((camera, frame + apart))
                both = np.flatnonzero(np.isfinite(seen[first] + seen[second]).all(-1))
                other = both.copy()
                swapped = rng.random(len(both)) < wrong
                other[swapped] = rng.permutation(other[swapped])
                (a, _), (b, _) = (
                    sights_of(self.lenses[camera], seen[shot][which])
                    for shot, which in ((first, both), (second, other))
                )
                found.append(Matches(first, second, np.stack((both, other), -1), a, b))
        return found


def world(seed: int, points: int = 500) -> World:
    rng = np.random.default_rng(seed)
    path = np.stack([pose((0, 2.0 * n, 0), (0.03 * n**2 + 4000, 20, 0.9 * n - 7000)) for n in range(FRAMES)])
    left = np.eye(4)
    left[:3, :3] = Rotation.from_euler("y", -80, degrees=True).as_matrix()
    left[:3, 3] = (-0.6, -0.2, 0.4)
    points_m = rng.uniform((3986, 15, -7004), (4016, 21.5, -6972), (points, 3))
    return World([PINHOLE, FISHEYE], [pose((5, 0, 0), (0.1, -0.3, 1.0)), left], path, points_m, rng)


def step_errors(path: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    off = [
        np.linalg.inv(np.linalg.inv(a) @ b) @ np.linalg.inv(c) @ d
        for a, b, c, d in zip(true, true[1:], path, path[1:], strict=False)
    ]
    turns = [np.linalg.norm(Rotation.from_matrix(one[:3, :3]).as_rotvec()) for one in off]
    return float(np.mean([np.linalg.norm(one[:3, 3]) for one in off])), float(np.degrees(np.mean(turns)))


@pytest.fixture(scope="module")
def exact() -> tuple[World, list[Matches], Tracks, np.ndarray]:
    """A world, matches without noise, the tracks that they join into, and the tracks' points."""
    given = world(1)
    matches = given.matches(0.0)
    tracks = join_matches(matches)
    return given, matches, tracks, triangulate(tracks, given.poses())


@pytest.mark.slow
def test_matches_join_into_one_track_for_each_point(exact) -> None:
    given, matches, tracks, points = exact
    known = np.isfinite(points).all(-1)
    assert known.sum() > 300
    # features are numbered as their points are, but a camera's pictures are matched among themselves alone
    nearest = np.linalg.norm(points[known][:, None] - given.points_m, axis=-1).min(-1)
    assert nearest.max() < 1e-4
    off_px = reprojection_px(tracks, points, given.poses())
    assert np.nanmax(off_px) < 1e-4
    for numbers, found in zip(features_joined(matches), matches, strict=True):
        assert len(numbers) == len(found)


@pytest.mark.slow
def test_reprojection_is_in_pixels(exact) -> None:
    given, _, tracks, points = exact
    moved = given.poses().copy()
    moved[:, :3, 3] += (0.01, -0.01, 0.005)
    off_px = reprojection_px(tracks, points, moved)
    rows = given.rng.choice(np.flatnonzero(np.isfinite(off_px)), 100)
    expected = []
    for row in rows:
        picture = tracks.picture[row]
        at, lens = moved[picture], given.lenses[given.shots[picture][0]]
        in_camera = (points[tracks.track[row]] - at[:3, 3]) @ at[:3, :3]
        pixel = lens.project(torch.from_numpy(in_camera))[0].numpy()
        expected.append(np.linalg.norm(pixel - tracks.sights.pixels[row]))
    assert off_px[rows] == pytest.approx(np.array(expected), rel=0.05, abs=0.01)


def test_a_track_with_two_features_of_a_picture_is_dropped() -> None:
    sights, _ = sights_of(PINHOLE, np.array([[100.0, 100], [200, 100], [300, 100]]))

    def between(first: int, second: int, index: list[list[int]]) -> Matches:
        chosen = np.array(index)
        return Matches(first, second, chosen, sights[chosen[:, 0]], sights[chosen[:, 1]])

    # feature 0 of picture 0 comes to two features of picture 2
    tracks = join_matches([between(0, 1, [[0, 0], [1, 1]]), between(1, 2, [[0, 0], [1, 1]]), between(0, 2, [[0, 2]])])
    assert tracks.count == 1
    assert tracks.picture.tolist() == [0, 1, 2]
    assert tracks.sights.pixels[:, 0].tolist() == [200, 200, 200]


def test_rays_that_hardly_differ_give_no_point() -> None:
    poses = np.stack([pose((0, 0, 0), (0.1 * n, 0, 0)) for n in range(2)])
    points_m = np.array([[0.0, 0, 100], [0, 0, 4]])
    seen = [PINHOLE.project(torch.from_numpy(points_m - at[:3, 3]))[0].numpy() for at in poses]
    index = np.array([[0, 0], [1, 1]])
    tracks = join_matches([Matches(0, 1, index, sights_of(PINHOLE, seen[0])[0], sights_of(PINHOLE, seen[1])[0])])
    points = triangulate(tracks, poses)
    assert np.isnan(points[0]).all()
    np.testing.assert_allclose(points[1], points_m[1], atol=1e-6)


@pytest.mark.slow
def test_few_tracks_are_kept_evenly_and_the_longest_first(exact) -> None:
    tracks = exact[2]
    lengths = np.bincount(tracks.track)
    kept = spread(tracks, 20)
    assert np.bincount(kept.picture).min() >= min(20, np.bincount(tracks.picture).min())
    assert kept.count < tracks.count / 2
    assert np.bincount(kept.track).mean() > lengths.mean()
    assert spread(join_matches([]), 5).count == 0
    assert len(triangulate(join_matches([]), np.zeros((0, 4, 4)))) == 0


@pytest.fixture(scope="module")
def colmap() -> Any:
    return pytest.importorskip("pycolmap")


def shots_of(given: World) -> list[Shot]:
    return [Shot(given.lenses[camera], frame, given.to_vehicle[camera]) for camera, frame in given.shots]


@pytest.mark.slow
def test_disturbed_poses_come_back(colmap: Any) -> None:
    given = world(4)
    matches = given.matches(0.3, wrong=0.1)
    path = given.disturbed()
    found = refine(colmap, shots_of(given), matches, path)
    before_m, before_deg = step_errors(path, given.path)
    after_m, after_deg = step_errors(found.vehicle_to_world, given.path)
    assert before_m > 0.05 and before_deg > 0.2
    assert after_m < 0.1 * before_m
    assert after_deg < 0.1 * before_deg
    assert found.supported.all()
    assert found.checks > 500
    assert found.after_px < 0.35 < 1 < found.before_px
    # the path as a whole stays where it was given
    assert np.linalg.norm((found.vehicle_to_world - path)[:, :3, 3].mean(0)) < 0.02


@pytest.mark.slow
def test_what_evaluates_takes_no_part(colmap: Any) -> None:
    given = world(5, points=250)
    matches = given.matches(0.2)
    path = given.disturbed()
    is_check = [_is_check(groups) for groups in features_joined(matches)]
    assert 0.1 < np.concatenate(is_check).mean() < 0.3

    def displaced(found: Matches, chosen: np.ndarray) -> Matches:
        pixels = found.in_second.pixels + 5.0 * chosen[:, None]
        camera = given.shots[found.second][0]
        return dataclasses.replace(found, in_second=sights_of(given.lenses[camera], pixels)[0])

    usual = refine(colmap, shots_of(given), matches, path)
    off = [displaced(found, chosen) for found, chosen in zip(matches, is_check, strict=True)]
    other = refine(colmap, shots_of(given), off, path)
    np.testing.assert_array_equal(other.vehicle_to_world, usual.vehicle_to_world)
    assert other.after_px > usual.after_px + 1


@pytest.mark.slow
def test_cameras_that_fire_at_other_times_stand_on_the_refined_path(colmap: Any) -> None:
    given = world(14, points=250)
    matches = given.matches(0.2)
    path = given.disturbed()
    true = shots_of(given)
    turns = [pose([*given.rng.normal(0, 0.1, 3)], (0, 0, 0)) for _ in true]
    off = [dataclasses.replace(shot, to_vehicle=turn @ shot.to_vehicle) for turn, shot in zip(turns, true, strict=True)]
    frozen = refine(colmap, off, matches, path)
    found = refine(colmap, off, matches, path, reshoot=lambda *_: true)
    after_deg, frozen_deg = (step_errors(one.vehicle_to_world, given.path)[1] for one in (found, frozen))
    assert after_deg < 0.3 * frozen_deg
    assert found.before_px == frozen.before_px
    assert found.after_px < 0.7 * frozen.after_px


def test_without_features_poses_are_the_given_ones(colmap: Any) -> None:
    given = world(6)
    nothing = join_matches([])
    start = given.disturbed(metres=0.1, degrees=0.5)
    softness = Softness(0.1, math.radians(0.3))
    points = np.zeros((0, 3))
    found = adjust_bundle(colmap, shots_of(given), nothing, points, start, given.path, softness)
    np.testing.assert_allclose(found, given.path, atol=2e-4)


def test_softness_is_in_metres_and_radians(colmap: Any) -> None:
    """A vehicle that is off by one standard deviation costs one, about and along each axis."""
    softness = Softness(0.1, math.radians(0.3))
    model = _Bundle(colmap, [Shot(PINHOLE, 0, np.eye(4))], np.eye(4)[None], np.eye(4)[None], softness)
    model.add_points(join_matches([]), np.zeros((0, 3)))
    squares = []
    for turn_rad, shift_m in ((softness.turn_rad, 0.0), (0.0, softness.position_m)):
        for axis in np.eye(3):
            moved = np.eye(4)
            moved[:3, :3] = Rotation.from_rotvec(turn_rad * axis).as_matrix()
            moved[:3, 3] = shift_m * axis
            model.model.frame(1).rig_from_world = colmap.Rigid3d((model.to_rig @ np.linalg.inv(moved))[:3])
            square = 0.0
            for image in model.model.images.values():
                for seen in image.get_observation_points2D():
                    image_point = image.project_point(model.model.point3D(seen.point3D_id).xyz)
                    square += float(((image_point - seen.xy) ** 2).sum())
            squares.append(square)
    assert squares == pytest.approx([1.0] * 6, rel=0.01)


def recorded(given: World, path: np.ndarray, poses_s: float = 0.1, shutter_s: float = 0.004) -> Recording:
    """A recording of a path; the second camera fires a little later."""
    times_s = poses_s * np.arange(len(path))
    trajectory = Trajectory(times_s, path)
    cameras = tuple(
        RecordedCamera(name, lens, at)
        for name, lens, at in zip(("front", "left"), given.lenses, given.to_vehicle, strict=True)
    )
    pictures = tuple(
        RecordedPicture(cameras[camera].name, 100 + frame, Path("none.png"), times_s[frame] + camera * shutter_s)
        for camera, frame in given.shots
    )
    return Recording(cameras, pictures, (), trajectory, {})


@dataclasses.dataclass
class Refined:
    """Refines recordings whose matches are given."""

    monkeypatch: pytest.MonkeyPatch
    output: Path

    def __call__(self, given: Recording, matches: list[Matches]) -> Recording:
        self.monkeypatch.setattr(refining, "_match", lambda *_: matches)
        return refining.refine_poses(given, ProcessOptions(output=self.output), Console(quiet=True))


@pytest.fixture
def refined(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Refined:
    (tmp_path / "none.png").touch()
    monkeypatch.chdir(tmp_path)
    return Refined(monkeypatch, tmp_path)


def test_interrupted_matching_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    given = world(7)
    matches = given.matches(0.2)
    pairs = [(each.first, each.second) for each in matches]
    matches[4] = matches[4].taken(np.zeros(len(matches[4]), bool))
    nothing = partial(np.zeros, (1, 1, 3), np.uint8)
    posed = [PosedPicture("", 0, given.lenses[camera], np.eye(4), nothing) for camera, _ in given.shots]
    monkeypatch.setattr(refining, "colmap_lenses", lambda *_: {})
    monkeypatch.setattr(refining, "FeatureMasks", lambda *_: None)
    monkeypatch.setattr(refining, "posed_pictures", lambda *_: posed)
    monkeypatch.setattr(refining, "pairs_to_match", lambda *_: pairs)
    monkeypatch.setattr(refining, "_KEPT_TOGETHER", 3)
    asked: list[list[tuple[int, int]]] = []

    def matched(_: Any, left: list[tuple[int, int]], __: int) -> Iterator[Matches]:
        asked.append(left)
        for number, pair in enumerate(left):
            if len(asked) == 1 and number == 7:
                raise KeyboardInterrupt
            yield matches[pairs.index(pair)]

    monkeypatch.setattr(refining, "match_pictures", matched)
    options, quiet = ProcessOptions(output=tmp_path), Console(quiet=True)
    with pytest.raises(KeyboardInterrupt):
        refining._match(recorded(given, given.path), options, quiet, tmp_path / "matches")
    found = refining._match(recorded(given, given.path), options, quiet, tmp_path / "matches")
    assert asked == [pairs, pairs[6:]]
    expected = [each for each in matches if len(each)]
    for one, other in zip(found, expected, strict=True):
        assert (one.first, one.second) == (other.first, other.second)
        np.testing.assert_array_equal(one.index, other.index)
        for seen, true in ((one.in_first, other.in_first), (one.in_second, other.in_second)):
            np.testing.assert_array_equal(seen.pixels, true.pixels)
            np.testing.assert_allclose(seen.rays, true.rays, atol=1e-9)
            np.testing.assert_allclose(seen.ray_per_pixel, true.ray_per_pixel, atol=1e-9)


@pytest.mark.slow
def test_a_recording_moves_as_a_whole(colmap: Any, refined: Refined) -> None:
    given = world(7)
    path = given.disturbed()
    drive = recorded(given, path, shutter_s=0.0)
    moved = refined(drive, given.matches(0.2))
    assert "Poses refined by" in moved.notices[-1]
    assert moved.trajectory is not None
    poses = np.stack([moved.pose(picture) for picture in moved.pictures])
    # path and pictures are one rig
    for (camera, frame), at in zip(given.shots, poses, strict=True):
        on_rig = moved.trajectory.vehicle_to_world[frame] @ given.to_vehicle[camera]
        np.testing.assert_allclose(on_rig, at, atol=1e-6)
    before, after = (step_errors(one, given.path) for one in (path, moved.trajectory.vehicle_to_world))
    assert after[0] < 0.1 * before[0] and after[1] < 0.1 * before[1]
    # what was found is kept for the same inputs
    again = refined(drive, [])
    assert again.trajectory is not None
    np.testing.assert_array_equal(again.trajectory.vehicle_to_world, moved.trajectory.vehicle_to_world)
    assert again.notices == moved.notices
    other = refined(recorded(given, given.path), [])
    assert "only 0 features" in other.notices[-1]


@pytest.mark.slow
def test_true_poses_stay(colmap: Any, refined: Refined) -> None:
    given = world(8, points=250)
    drive = recorded(given, given.path, shutter_s=0.0)
    kept = refined(drive, given.matches(0.3))
    assert "given poses are used unchanged: features agree with them as well" in kept.notices[-1]
    assert kept.trajectory is drive.trajectory
    assert kept.pictures == drive.pictures


@pytest.mark.slow
def test_poses_that_are_far_off_are_not_trusted_to_features(colmap: Any, refined: Refined) -> None:
    given = world(9, points=250)
    refined.monkeypatch.setattr(refining, "FURTHEST_M", 0.02)
    kept = refined(recorded(given, given.disturbed()), given.matches(0.3))
    assert "too far to be trusted" in kept.notices[-1] and "--poses colmap" in kept.notices[-1]


def test_few_features_change_nothing(colmap: Any, refined: Refined) -> None:
    given = world(10, points=6)
    kept = refined(recorded(given, given.disturbed()), given.matches(0.3))
    assert "could be matched for the check" in kept.notices[-1]


@pytest.mark.slow
def test_a_frame_without_features_moves_with_its_neighbours(colmap: Any, refined: Refined) -> None:
    given = world(11, points=250)
    wanted = pose((0, 0.1, 0), (0.05, 0, 0.02))
    path = given.path @ np.linalg.inv(wanted)
    matches = given.matches(0.2)
    dark = 5
    found = Refinement(given.path.copy(), np.arange(FRAMES) != dark, 100, 1.0, 0.1, 1000)
    found.vehicle_to_world[dark] = path[dark]
    refined.monkeypatch.setattr(refining, "refine", lambda *_, **__: found)
    moved = refined(recorded(given, path, shutter_s=0.0), matches)
    assert moved.trajectory is not None
    np.testing.assert_allclose(moved.trajectory.at(np.array([0.1 * dark]))[0], given.path[dark], atol=1e-6)
    # between the frames, too, and beyond them by no more than at their ends
    for time_s in (0.33, -0.5, 2.0):
        before = Trajectory(0.1 * np.arange(FRAMES), path).at(np.array([time_s]))[0]
        after = moved.trajectory.at(np.array([time_s]))[0]
        assert np.linalg.norm((np.linalg.inv(before) @ after)[:3, 3]) < 0.06


def test_pycolmap_missing_is_said_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    given = world(12)
    with pytest.raises(InputError, match=r"--refine-poses: needs COLMAP's Python package.*--no-refine-poses"):
        refining.check_refining(recorded(given, given.path), ProcessOptions(output=Path("none")))
