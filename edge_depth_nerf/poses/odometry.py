"""LiDAR odometry: the vehicle's path from the sweeps of a scanner, by KISS-ICP (Vizzo et al., RA-L 2023).

KISS-ICP finds where each sweep lies on a map of those before it. It takes the motion of the last step as the next
one's, to begin the search and to correct the sweep for the motion during its turn. Of the first sweep nothing is
known, and its first steps are wrong by decimetres. So:

1. Some sweeps are gone through forwards, then backwards: the way back ends with the velocity that the drive starts at.
2. All sweeps are gone through with that start.
3. Each sweep is corrected by the path that was found, and laid on a map of its neighbours before *and* after it. This
   leaves no sweep to a sparse map, and evens out what single steps are wrong by.

Poses are those of the sweeps' own times, whatever part of the turn these are: points are corrected here, by their own
times. Frames: vehicle; world, which is the vehicle's frame at the first sweep. Metres, seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar.projection import transform_points
from edge_depth_nerf.lidar.trajectory import Trajectory

INSTALL = "pip install '.[odometry]'"

MIN_SWEEPS = 5
"""Fewer say too little of the velocity that the drive starts at."""
_OLDEST = (1, 2)
RANGE_M = (2.0, 100.0)
"""Nearer to the scanner lies the vehicle itself; further away LiDAR points are too far apart."""
_VOXEL_M = 1.0
"""KISS-ICP's own choice for this reach: of cubes of half the size one point each is kept, of 1.5 of it one is laid."""
_SETTLED = 1e-4
"""A sweep is laid on the map until it moves by less, in metres and radians: KISS-ICP's own choice."""
_SEED_SWEEPS = 15
"""So many sweeps are gone through forwards and backwards."""

_ROUNDS = 2
"""How often each sweep is laid on its neighbours."""
_NEIGHBOURS = 5
"""On so many before and after it."""
_FINE_VOXEL_M = 0.5
_FINE_M = 0.2
"""Of cubes of this size one point each makes the map of the neighbours."""
_FINE_SETTLED = 1e-3
"""A tenth of what single steps are wrong by; less takes half as long again and makes no path better."""
_FINE_SIGMA_M = 0.3
"""Scale of the robust kernel then. By KISS-ICP's own, which looks at how uneven the motion is, it would be larger."""


@dataclass(frozen=True)
class TimedSweep:
    """A sweep that is ready to be read."""

    time_s: float
    """Its own time, which its pose is to be of."""
    read: Callable[[], tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n"]]]
    """Points in the vehicle's frame, as recorded, that are `RANGE_M` from the scanner; and when each was measured,
    counted from the sweep's time."""


def import_kiss_icp() -> Any:
    """KISS-ICP's package, with its parts that are used here.

    Raises:
        InputError: it is not installed, or too old.
    """
    try:
        import kiss_icp
        from kiss_icp import config, mapping, registration, threshold, voxelization  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"--poses lidar: needs KISS-ICP's Python package, which cannot be imported ({error}). Install it with "
            f"`{INSTALL}`, or use other poses (--poses recorded, --poses colmap)."
        ) from error
    if tuple(int(number) for number in kiss_icp.__version__.split(".")[:2]) < _OLDEST:
        raise InputError(
            f"--poses lidar: kiss-icp {kiss_icp.__version__} is too old, expected 1.2 or newer. Install it with "
            f"`{INSTALL}`."
        )
    return kiss_icp


def odometry(sweeps: Sequence[TimedSweep], advance: Callable[[], object] = lambda: None) -> Trajectory:
    """Find the vehicle's poses at the own times of sweeps of one scanner, in order; the first is the identity.

    `advance` is called `steps_of(len(sweeps))` times.

    Raises:
        InputError: KISS-ICP is missing, or there are fewer than five sweeps.
    """
    kiss = import_kiss_icp()
    if len(sweeps) < MIN_SWEEPS:
        raise InputError(
            f"--poses lidar: {len(sweeps)} sweep{'' if len(sweeps) == 1 else 's'}, expected {MIN_SWEEPS} or more "
            "consecutive ones: the path is computed from their overlap. Take more frames, or --poses colmap."
        )
    some = sweeps[:_SEED_SWEEPS]
    start = None
    for way in (some, some[::-1]):
        start = _last_step(way, _follow(kiss, way, start, advance))
    path = Trajectory(np.array([sweep.time_s for sweep in sweeps]), _follow(kiss, sweeps, start, advance))
    for _ in range(_ROUNDS):
        path = _among_neighbours(kiss, sweeps, path, advance)
    first_to_world = path.vehicle_to_world[0]
    return Trajectory(path.times_s, np.linalg.inv(first_to_world) @ path.vehicle_to_world)


def steps_of(sweeps: int) -> int:
    """How often `odometry` says that a sweep is done."""
    return 2 * min(sweeps, _SEED_SWEEPS) + (1 + _ROUNDS) * sweeps


def _parts(kiss: Any, voxel_m: float, settled: float) -> tuple[Callable[[], Any], Any, Any]:
    """What makes a map, what lays a sweep on it until it settles, and what says how far off the sweep may lie."""
    config = kiss.config.KISSConfig()
    config.data.max_range = RANGE_M[1]
    config.mapping.voxel_size = voxel_m
    config.registration.convergence_criterion = settled
    # threads would add numbers up in another order each time
    config.registration.max_num_threads = 1
    lay, threshold = kiss.registration.get_registration(config).align_points_to_map, kiss.threshold
    return partial(kiss.mapping.get_voxel_hash_map, config), lay, threshold.get_threshold_estimator(config)


def _follow(
    kiss: Any, sweeps: Sequence[TimedSweep], start: Trajectory | None, advance: Callable[[], object]
) -> Float64[np.ndarray, "sweeps 4 4"]:
    """Lay each sweep on a map of those before it, in the order given, forwards or backwards in time.

    `start` is the motion that the first sweep is taken in, None = not known; `advance` is called for each sweep.
    """
    new_map, lay, threshold = _parts(kiss, _VOXEL_M, _SETTLED)
    thin = kiss.voxelization.voxel_down_sample
    known, poses = new_map(), [np.eye(4)]
    for index, sweep in enumerate(sweeps):
        motion = start if index < 2 else _last_step(sweeps[:index], poses)
        points = thin(_in_vehicle(sweep, motion), 0.5 * _VOXEL_M)
        if index:
            guess = poses[-1]
            if motion is not None:
                before, now = motion.at(np.array([sweeps[index - 1].time_s, sweep.time_s]))
                guess = guess @ np.linalg.inv(before) @ now
            sigma = threshold.get_threshold()
            poses.append(lay(thin(points, 1.5 * _VOXEL_M), known, guess, 3 * sigma, sigma))
            threshold.update_model_deviation(np.linalg.inv(guess) @ poses[-1])
        known.update(points, poses[-1])
        advance()
    return np.stack(poses)


def _last_step(sweeps: Sequence[TimedSweep], poses: Sequence[Transform] | np.ndarray) -> Trajectory:
    """The motion between the last two sweeps, which may be backwards in time."""
    times, last = np.array([sweep.time_s for sweep in sweeps[-2:]]), np.stack(list(poses[-2:]))
    order = np.argsort(times)
    return Trajectory(times[order], last[order])


def _in_vehicle(sweep: TimedSweep, path: Trajectory | None) -> Float64[np.ndarray, "n 3"]:
    """The points as if measured at the sweep's own time."""
    points, offset_s = sweep.read()
    if path is None or not offset_s.any():
        return points
    world_to_vehicle = np.linalg.inv(path.at(np.array([sweep.time_s]))[0])
    in_world = path.to_world(torch.from_numpy(points), torch.from_numpy(sweep.time_s + offset_s))
    return transform_points(torch.from_numpy(world_to_vehicle), in_world).numpy()


def _among_neighbours(
    kiss: Any, sweeps: Sequence[TimedSweep], path: Trajectory, advance: Callable[[], object]
) -> Trajectory:
    """Correct each sweep by a path, and lay it on a map of its neighbours; those before it have been laid already."""
    new_map, lay, _ = _parts(kiss, _FINE_VOXEL_M, _FINE_SETTLED)
    thin = kiss.voxelization.voxel_down_sample
    poses = path.vehicle_to_world.copy()
    clouds: dict[int, np.ndarray] = {}
    for index in range(len(sweeps)):
        # as many at the ends of the drive, where they lie on one side
        first = max(0, min(index - _NEIGHBOURS, len(sweeps) - 2 * _NEIGHBOURS - 1))
        around = range(first, min(first + 2 * _NEIGHBOURS + 1, len(sweeps)))
        for other in around:
            if other not in clouds:
                clouds[other] = thin(_in_vehicle(sweeps[other], path), _FINE_M)
        clouds.pop(first - 1, None)
        known = new_map()
        # a full cube of the map takes no more points: the nearest in time come first
        for other in sorted(around, key=lambda other: abs(other - index)):
            if other != index:
                known.add_points(clouds[other] @ poses[other, :3, :3].T + poses[other, :3, 3])
        source = thin(clouds[index], _FINE_VOXEL_M)
        poses[index] = lay(source, known, poses[index], 3 * _FINE_SIGMA_M, _FINE_SIGMA_M)
        advance()
    return Trajectory(path.times_s, poses)
