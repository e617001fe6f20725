"""Poses by LiDAR odometry: the vehicle's path from the sweeps of one scanner.

Of several scanners, the one with the most LiDAR points in all is followed; the others are placed by its path. Every
sweep of the stretch is used, those between the chosen frames included.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import statistics
from collections import defaultdict
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float64
from rich.console import Console
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import file_stamp, read_json, write_json
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.lidar import transform_points
from edge_depth_nerf.lidar.trajectory import MAX_POSE_GAP_S, Trajectory
from edge_depth_nerf.lidar.world import offsets_s
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.poses.odometry import MIN_SWEEPS, RANGE_M, TimedSweep, import_kiss_icp, odometry, steps_of
from edge_depth_nerf.process.found_path import path_length_m, upright, with_path
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedPicture, RecordedSweep, Recording

_MIN_WAY_M = 1.0
"""A vehicle that stays within so much of where it begins has no path."""
_TURNED_RAD = math.radians(20)
_LOOKED_AT = 5
"""The number of a scanner's LiDAR points is counted in so many of its sweeps."""
_FEW_POINTS = 5000
"""Fewer a sweep say too little of the vehicle's roll and pitch; a scanner of 16 rings has some 25,000."""


def lidar_poses(recording: Recording, options: ProcessOptions, console: Console) -> Recording:
    """Find the poses of a recording's pictures by LiDAR odometry, from its sweeps and its rig alone.

    The path is kept in the scene for the next run.

    Returns:
        The recording with the vehicle's path, and with the pictures that were taken between its sweeps, or within
        half a turn of them; the others are listed in `skipped`. A notice says how long the path is.

    Raises:
        InputError: KISS-ICP is not installed, there are too few sweeps or a gap between them, a sweep cannot be
            read, the vehicle stands or turns on the spot, or the path is none of a vehicle.
    """
    sweeps = check_sweeps(recording)
    trajectory = upright(recording, _followed(sweeps, options, console))
    _check_path(trajectory)
    slack_s = statistics.median(np.diff(trajectory.times_s).tolist())

    def lacking(picture: RecordedPicture) -> str | None:
        return "no sweep near it in time" if trajectory.outside_s(picture.time_s) > slack_s else None

    posed = with_path(recording, trajectory, lacking)
    if not posed.pictures:
        raise InputError(
            f"--poses lidar: none of the {len(recording.pictures)} pictures was taken between the sweeps of "
            f"{sweeps[0].scanner}. Check the times of pictures and sweeps"
        )
    return dataclasses.replace(posed, notices=(*posed.notices, *_notices(sweeps, trajectory)))


def _followed(sweeps: Sequence[RecordedSweep], options: ProcessOptions, console: Console) -> Trajectory:
    """The path of these sweeps, without --strict of those that can be read; it may be that of an earlier run."""
    what = [[*file_stamp(s.path), s.time_s, s.to_vehicle.tolist(), s.columns, repr(s.timing)] for s in sweeps]
    digest = hashlib.sha256(json.dumps([import_kiss_icp().__version__, options.strict, what]).encode()).hexdigest()
    path = options.output / ".cache" / "odometry.json"
    found = read_json(path) if path.is_file() else {}
    if found.get("digest") == digest:
        return Trajectory(np.array(found["times_s"]), np.array(found["vehicle_to_world"]))
    whole = [sweep for sweep in sweeps if options.strict or read_if_whole(sweep.read) is not None]
    followed = path_of(whole, console)
    arrays = {"times_s": followed.times_s.tolist(), "vehicle_to_world": followed.vehicle_to_world.tolist()}
    write_json(path, {"digest": digest, **arrays})
    return followed


def check_sweeps(recording: Recording) -> list[RecordedSweep]:
    """Check what can be checked before the long work; give the sweeps that are followed, in order of time.

    Raises:
        InputError: KISS-ICP is missing, there are no sweeps, too few, too thin ones, or a gap between them.
    """
    import_kiss_icp()
    if not recording.sweeps:
        maps = any(picture.depth for picture in recording.pictures)
        found = "depth maps instead of LiDAR sweeps" if maps else "no LiDAR sweeps"
        raise InputError(
            f"--poses lidar: the recording has {found}; the path is computed from sweeps. Give scans ([lidars] in a "
            "rig file), or compute the path from the pictures (--poses colmap)."
        )
    scanners: dict[str, list[RecordedSweep]] = defaultdict(list)
    for sweep in recording.sweeps:
        scanners[sweep.scanner].append(sweep)
    usual = {name: _usual_points(sweeps) for name, sweeps in scanners.items()}
    name = max(scanners, key=lambda name: usual[name] * len(scanners[name]))
    sweeps = sorted(scanners[name], key=lambda sweep: sweep.time_s)
    if len(sweeps) < MIN_SWEEPS:
        raise InputError(
            f"--poses lidar: {len(sweeps)} sweep{'' if len(sweeps) == 1 else 's'} of {name}, expected {MIN_SWEEPS} "
            "or more consecutive ones: the path is computed from their overlap. Take more frames "
            "(--frames), or compute the path from the pictures (--poses colmap)."
        )
    if usual[name] < _FEW_POINTS:
        raise InputError(
            f"--poses lidar: {sweeps[0].path.parent}: {usual[name]:.0f} points a sweep (median), expected "
            f"{_FEW_POINTS} or more: roll and pitch cannot be computed from fewer. Use --poses colmap."
        )
    times = np.array([sweep.time_s for sweep in sweeps])
    widest = int(np.diff(times).argmax())
    if times[widest + 1] - times[widest] > MAX_POSE_GAP_S:
        raise InputError(
            f"--poses lidar: no sweep for {times[widest + 1] - times[widest]:.1f} s after {sweeps[widest].path}; "
            f"sweeps more than {MAX_POSE_GAP_S:g} s apart overlap too little. Use only the frames before or after "
            "(--first, --frames), or compute the path from the pictures (--poses colmap)."
        )
    return sweeps


def path_of(sweeps: Sequence[RecordedSweep], console: Console) -> Trajectory:
    """The vehicle's path in the frame of its first pose; shows progress.

    Raises:
        InputError: there are too few sweeps, or one cannot be read.
    """
    timed = [TimedSweep(sweep.time_s, partial(_read, sweep)) for sweep in sweeps]
    with progress_bars(console, counted=True) as progress:
        task = progress.add_task("Following the LiDAR", total=steps_of(len(sweeps)))
        return odometry(timed, lambda: progress.advance(task))


def _read(sweep: RecordedSweep) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n"]]:
    """The points of a sweep that are used, in the vehicle's frame, and when each was measured."""
    read = sweep.read()
    offset_s = offsets_s(read, sweep.timing, deskew=True)
    range_m = read.points_m.norm(dim=-1)
    used = (range_m >= RANGE_M[0]) & (range_m <= RANGE_M[1])
    in_vehicle = transform_points(torch.from_numpy(sweep.to_vehicle), read.points_m[used])
    return in_vehicle.double().numpy(), offset_s[used].double().numpy()


def _usual_points(sweeps: Sequence[RecordedSweep]) -> float:
    some = [sweeps[index] for index in spread_over(len(sweeps), _LOOKED_AT)]
    read = [len(sweep.points_m) for one in some if (sweep := read_if_whole(one.read)) is not None]
    return float(statistics.median(read or [0]))


def _check_path(trajectory: Trajectory) -> None:
    """Raise an InputError unless the path is that of a vehicle that drives."""
    poses = trajectory.vehicle_to_world
    reach_m = float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=-1).max())
    turned = float(Rotation.from_matrix(poses[0, :3, :3].T @ poses[:, :3, :3]).magnitude().max())
    if reach_m < _MIN_WAY_M:
        what = f"turns on the spot, by {math.degrees(turned):.0f}°" if turned > _TURNED_RAD else "stands still"
        raise InputError(
            f"--poses lidar: the vehicle {what}: it stays within {reach_m:.2f} m of its start. Pictures from one "
            "place cannot give distances. Use frames of a stretch where it drives (--first, --frames)."
        )
    if found := find_break(trajectory):
        first, last = trajectory.times_s[[found.first, found.last]]
        raise InputError(
            f"--poses lidar: the path breaks between {first:.2f} and {last:.2f} s: {found.what}. The surroundings "
            "have too little structure there (an open field, a tunnel, a scanner with few rings), or the "
            "sweeps' times are wrong. Check turn_s, direction and times, use only the frames before or "
            "after, or use --poses colmap."
        )


def _notices(sweeps: Sequence[RecordedSweep], trajectory: Trajectory) -> list[str]:
    speed = np.linalg.norm(np.diff(trajectory.vehicle_to_world[:, :3, 3], axis=0), axis=-1) / np.diff(
        trajectory.times_s
    )
    notices = [
        f"LiDAR odometry followed {len(trajectory.times_s)} sweeps of {sweeps[0].scanner}: the path is "
        f"{path_length_m(trajectory):.1f} m long, at {np.median(speed):.1f} m/s (median), {speed.max():.1f} at most."
    ]
    first = read_if_whole(sweeps[0].read)
    if sweeps[0].timing is None and first is not None and first.offset_s is None:
        notices.append(
            f"The sweeps of {sweeps[0].scanner} have no times, so they count as already corrected for the vehicle's "
            "motion. If they are raw, give turn_s and direction, or point_times."
        )
    return notices
