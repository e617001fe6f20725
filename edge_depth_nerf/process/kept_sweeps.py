"""Keeps the scanners' own rays beside the pictures: each measurement where and when it was made (`scene.sweeps`)."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Collection
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.console import run_jobs
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.lidar.patterns import elevations_of, place_among, rings_of
from edge_depth_nerf.lidar.sweeps import Sweep, held_out_beams
from edge_depth_nerf.lidar.trajectory import MAX_POSE_GAP_S, Trajectory
from edge_depth_nerf.lidar.world import offsets_s
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedSweep, Recording
from edge_depth_nerf.scene.sweeps import UNKNOWN_RING, SceneScanner, SceneSweep, SweepRays, write_rays

FOLDER, MADE_OF = "sweeps", "made_of.sha256"
_VERSION = 2
"""Of what is written; raised when it changes."""
_LOOKED_AT = 16
"""So many sweeps, spread over the drive, tell how many beams a scanner has."""


def keep_sweeps(
    recording: Recording,
    options: ProcessOptions,
    held_out: Collection[int],
    offset_m: Float64[np.ndarray, "3"],
    console: Console,
) -> list[SceneScanner]:
    """Write the rays of the sweeps between the first picture and the last, those that are missing or out of date.

    All are written again if the sweeps or their poses are others than those of an earlier run.

    Args:
        recording: with a trajectory.
        options: where to; raw_lidar takes all points of a sweep as measured at once; holdout_beams marks rays.
        held_out: numbers of the frames that are kept from training.
        offset_m: the scene's origin in the recording's world.
        console: where progress is shown.

    Returns:
        The scanners with what was written; without sweeps that cannot be read.
    """
    assert recording.trajectory is not None
    times_s = [picture.time_s for picture in recording.pictures]
    by_scanner: dict[str, list[RecordedSweep]] = {}
    for sweep in sorted(recording.sweeps, key=lambda sweep: sweep.time_s):
        near = sweep.frame is not None or min(times_s) <= sweep.time_s <= max(times_s)
        if near and recording.trajectory.gap_s(sweep.time_s) <= MAX_POSE_GAP_S:
            by_scanner.setdefault(sweep.scanner, []).append(sweep)
    jobs, scanners = [], []
    for name, sweeps in by_scanner.items():
        poses = recording.trajectory.at(np.array([sweep.time_s for sweep in sweeps]))
        kept = []
        for number, (sweep, vehicle_to_world) in enumerate(zip(sweeps, poses, strict=True)):
            pose = vehicle_to_world @ sweep.to_vehicle
            pose[:3, 3] -= offset_m
            path = options.output / FOLDER / name / f"{number:010d}.npz"
            kept.append(SceneSweep(path, name, sweep.frame, sweep.time_s, sweep.frame in held_out, pose))
        scanners.append(SceneScanner(name, tuple(kept), sweeps[0].timing))
        _remove_those_of_others(scanners[-1], sweeps, options)
        missing = [
            (recorded, one.path)
            for recorded, one in zip(sweeps, kept, strict=True)
            if not (one.path.is_file() and one.path.stat().st_mtime_ns > recorded.path.stat().st_mtime_ns)
        ]
        beams = _beams(sweeps) if missing else None
        for recorded, path in missing:
            write = partial(_write, path, recorded, recording.trajectory, offset_m, options, beams)
            jobs.append(partial(read_if_whole, write, strict=options.strict))
    if jobs:
        run_jobs(jobs, "Keeping the scanners' rays", console)
    found = [
        SceneScanner(scanner.name, tuple(sweep for sweep in scanner.sweeps if sweep.path.is_file()), scanner.timing)
        for scanner in scanners
    ]
    return [scanner for scanner in found if scanner.sweeps]


def _remove_those_of_others(scanner: SceneScanner, recorded: list[RecordedSweep], options: ProcessOptions) -> None:
    """Remove a scanner's rays if they were made of other sweeps, or with other poses or options."""
    made_of: list[object] = [_VERSION, scanner.timing, options.raw_lidar, options.holdout_beams]
    for sweep, one in zip(recorded, scanner.sweeps, strict=True):
        made_of.append((sweep.path.name, sweep.time_s, one.scanner_to_scene.tolist()))
    digest = hashlib.sha256(repr(made_of).encode()).hexdigest()
    folder = scanner.sweeps[0].path.parent
    stated = folder / MADE_OF
    if not stated.is_file() or stated.read_text(encoding="utf-8") != digest:
        shutil.rmtree(folder, ignore_errors=True)
        write_text(stated, digest)


def _beams(sweeps: list[RecordedSweep]) -> NDArray[np.float64] | None:
    """Elevations of a scanner's beams, by the sweep that has most of them; None if none can be told apart."""
    found: list[NDArray[np.float64]] = []
    for number in spread_over(len(sweeps), _LOOKED_AT):
        sweep = read_if_whole(sweeps[number].read)
        with suppress(InputError):
            if sweep is not None:
                points_m = sweep.points_m.numpy()
                found.append(elevations_of(points_m, rings_of(points_m, "")))
    return max(found, key=len, default=None)


def _write(
    path: Path,
    recorded: RecordedSweep,
    trajectory: Trajectory,
    offset_m: NDArray,
    options: ProcessOptions,
    elevations: NDArray[np.float64] | None,
) -> bool:
    path.unlink(missing_ok=True)
    write_rays(path, rays_of(recorded.read(), recorded, trajectory, offset_m, options, elevations))
    return True


def rays_of(
    sweep: Sweep,
    recorded: RecordedSweep,
    trajectory: Trajectory,
    offset_m: NDArray,
    options: ProcessOptions,
    elevations: NDArray[np.float64] | None,
) -> SweepRays:
    """Give a sweep's measurements as rays in the scene, whose origin is at `offset_m` in the recording's world.

    `elevations`: of all beams of the scanner, which number the rings of the sweep; None: not known.
    """
    offset_s = offsets_s(sweep, recorded.timing, deskew=not options.raw_lidar)
    in_vehicle = torch.from_numpy(recorded.to_vehicle)
    mounted = in_vehicle[:3, 3].expand(len(sweep.points_m), 3)
    points = sweep.points_m @ in_vehicle[:3, :3].T + in_vehicle[:3, 3]
    origin, there = (
        trajectory.to_world(each, recorded.time_s + offset_s).numpy() - offset_m for each in (mounted, points)
    )
    along = there - origin
    distance = np.linalg.norm(along, axis=1)
    ring = np.full(len(distance), UNKNOWN_RING)
    with suppress(InputError):
        of_sweep = rings_of(points_m := sweep.points_m.numpy(), str(recorded.path))
        place = None if elevations is None else place_among(elevations_of(points_m, of_sweep), elevations)
        ring = ring if place is None else of_sweep + place
    beams = np.zeros(len(distance), np.int16)
    if options.holdout_beams:
        beams = held_out_beams(sweep, options.holdout_beams).numpy().astype(np.int16)
    return SweepRays(
        origin_m=origin.astype(np.float32),
        direction=(along / distance[:, None]).astype(np.float32),
        distance_m=distance.astype(np.float32),
        offset_s=offset_s.numpy().astype(np.float32),
        intensity=sweep.reflectance.numpy().astype(np.float32),
        ring=ring.astype(np.int16),
        of_beam=beams,
    )
