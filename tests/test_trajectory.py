"""The vehicle's path between its poses, against matrix exponentials."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.trajectory import Trajectory

TIMES = np.array([10.0, 11.0, 11.5, 14.0])


def random_poses(seed: int, turn_rad: float = 0.7) -> np.ndarray:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (len(TIMES), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(len(TIMES), 3)) * turn_rad).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(len(TIMES), 3)) * 5 + (1200.0, 3700.0, 115.0)
    return poses


def geodesic(poses: np.ndarray, time_s: float) -> np.ndarray:
    """T0·exp(s·log(T0⁻¹·T1)), by the general matrix functions."""
    first = int(np.clip(np.searchsorted(TIMES, time_s, side="right") - 1, 0, len(TIMES) - 2))
    along = (time_s - TIMES[first]) / (TIMES[first + 1] - TIMES[first])
    motion = logm(np.linalg.inv(poses[first]) @ poses[first + 1])
    return poses[first] @ expm(along * np.real(motion))


@pytest.mark.parametrize("turn_rad", [0.7, 1e-4, 1e-9, 0.0])
def test_between_poses_the_motion_is_a_screw(turn_rad: float) -> None:
    poses, times_s = random_poses(1, turn_rad), np.array([9.8, 10.0, 10.4, 11.2, 11.5, 13.0, 14.0, 14.3])
    found = Trajectory(TIMES, poses).at(times_s)
    np.testing.assert_allclose(found, [geodesic(poses, time_s) for time_s in times_s.tolist()], atol=2e-9)
    turn = found[:, :3, :3]
    np.testing.assert_allclose(turn @ np.swapaxes(turn, 1, 2), np.tile(np.eye(3), (8, 1, 1)), atol=1e-9)


def test_times_may_be_a_column_of_a_table(recwarn: pytest.WarningsRecorder) -> None:
    poses, times_s = random_poses(1), torch.tensor([10.4, 13.0])
    torch.set_warn_always(True)
    try:
        found = Trajectory(np.column_stack((TIMES, TIMES))[:, 0], poses).to_world(torch.ones(2, 3), times_s)
    finally:
        torch.set_warn_always(False)
    assert torch.equal(found, Trajectory(TIMES, poses).to_world(torch.ones(2, 3), times_s)) and not recwarn.list


def test_given_poses_come_back_exactly() -> None:
    poses = random_poses(2)
    assert np.array_equal(Trajectory(TIMES, poses).at(TIMES), poses)


def test_each_point_moves_by_the_pose_of_its_own_time() -> None:
    poses = random_poses(3)
    rng = np.random.default_rng(4)
    points, times = rng.normal(size=(200, 3)) * 30, rng.uniform(9.9, 14.1, 200)
    found = Trajectory(TIMES, poses).to_world(torch.from_numpy(points), torch.from_numpy(times))
    expected = [(geodesic(poses, time) @ [*point, 1])[:3] for point, time in zip(points, times.tolist(), strict=True)]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)


def test_a_missing_pose_of_an_even_turn_is_bridged_exactly() -> None:
    """A car on a circle: leaving out a pose changes nothing. Straight lines between poses would cut the corner."""
    times = np.arange(5.0)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 0.3 * times[:, None]).as_matrix()
    poses[:, :3, 3] = 10 * np.stack((np.sin(0.3 * times), 1 - np.cos(0.3 * times), 0 * times), -1)
    kept = [0, 1, 4]
    found = Trajectory(times[kept], poses[kept]).at(np.array([2.0, 3.0]))
    np.testing.assert_allclose(found, poses[2:4], atol=1e-9)
    chord = (poses[1, :3, 3] * 2 + poses[4, :3, 3]) / 3
    assert np.linalg.norm(chord - poses[2, :3, 3]) > 0.5


def test_gaps_and_ends() -> None:
    path = Trajectory(TIMES, random_poses(5))
    assert path.gap_s(11.5) == 0
    assert path.gap_s(12.0) == 2.5
    assert path.gap_s(9.0) == path.gap_s(14.5) == float("inf")
    assert path.outside_s(12.0) == 0
    assert path.outside_s(9.75) == 0.25 and path.outside_s(14.5) == 0.5


def test_one_pose_is_no_path_and_times_must_increase() -> None:
    with pytest.raises(InputError, match="at least two poses for the vehicle's motion, found 1"):
        Trajectory(TIMES[:1], random_poses(6)[:1])
    with pytest.raises(InputError, match=r"must increase, but pose 3 is of 11\.0"):
        Trajectory(np.array([10.0, 11.0, 11.0, 12.0]), random_poses(7))
