"""The sweeps around each picture, in the world: read once, kept while they are needed.

A picture of frame f gets the sweep of its own frame and, of the same scanner, up to K sweeps before and after. A
training picture never gets anything from the sweep of a held-out frame, not even the evidence that a point has moved. A
held-out picture gets only the sweep of its own frame.

Two kinds of points are left out of the sweeps of other frames. Points that another sweep saw through are left out, so
that a passing car leaves no trail. Points above the field of the picture's own sweep are left out, because nothing
nearer that hides them could have been measured there.
"""

from __future__ import annotations

import statistics
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar import transform_points
from edge_depth_nerf.lidar.free_space import FreeSpace
from edge_depth_nerf.lidar.sweeps import Sweep, first_in_voxel, without_beams
from edge_depth_nerf.lidar.trajectory import MAX_POSE_GAP_S, Trajectory
from edge_depth_nerf.lidar.world import WorldSweep, above_field, sweep_in_world
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedSweep, Recording

VOXEL_M = 0.05
"""Beyond `MAX_POINTS` the points around a picture are thinned to one of each cube of this size, nearest in time
first; cubes grow where they would still be too many."""
MAX_POINTS = 2_000_000
"""So many points at most are kept around a picture."""
_DIAGONAL = 1.4
"""Neighbours of thinned points are up to so many cubes apart, across."""
_TURN_S = 0.1
"""A turn of a scanner of which nothing is known."""

Value = TypeVar("Value")


class _Shared(Generic[Value]):
    """Remembers what was made last; several threads that want the same thing wait for one to make it."""

    def __init__(self, make: Callable[[int], Value], size: int) -> None:
        self._make, self._size = make, size
        self._lock = threading.Lock()
        self._made: OrderedDict[int, Future[Value]] = OrderedDict()

    def get(self, key: int) -> Value:
        with self._lock:
            mine = key not in self._made
            future = self._made.setdefault(key, Future())
            self._made.move_to_end(key)
            while len(self._made) > self._size:
                self._made.popitem(last=False)
        if mine:
            try:
                future.set_result(self._make(key))
            except BaseException as error:
                future.set_exception(error)
        return future.result()


@dataclass(frozen=True)
class _Loaded:
    world: WorldSweep
    beams: WorldSweep | None
    """What is held out of it."""
    free_space: FreeSpace | None


@dataclass(frozen=True)
class Surroundings:
    """What the scanners know around a picture."""

    points_m: Float[Tensor, "points 3"]
    """World, float64."""
    spacing_m: Float[Tensor, "points"]
    """How wide a patch of surface each point stands for."""
    age_s: Float[Tensor, "points"]
    """How far in time from the picture its sweep is."""
    only_hides: Bool[Tensor, "points"]
    """Points that were not measured: they hide others and are not to be chosen."""
    moved: Bool[Tensor, "points"]
    """Points of the picture's own sweep that others saw through: there at its time, and no part of what lasts."""


class Scanner:
    """The sweeps of one scanner, in order of time."""

    def __init__(
        self,
        sweeps: Sequence[RecordedSweep],
        trajectory: Trajectory,
        options: ProcessOptions,
        held_out: Collection[int],
    ) -> None:
        self._trajectory, self._options = trajectory, options
        self.left_out: dict[Path, tuple[int, int]] = {}
        """Of each sweep that was read, how many points were not finite, and how many out of range."""
        self.sweeps = sorted(sweeps, key=lambda sweep: sweep.time_s)
        self.times_s = np.array([sweep.time_s for sweep in self.sweeps])
        self._of_frame: dict[int | None, list[int]] = {}
        for index, sweep in enumerate(self.sweeps):
            self._of_frame.setdefault(sweep.frame, []).append(index)
        timing, intervals = self.sweeps[0].timing, np.diff(self.times_s).tolist()
        turn_s = timing.turn_s if timing else min(statistics.median(intervals), _TURN_S) if intervals else _TURN_S
        self.half_turn_s = turn_s / 2
        self.trains = [sweep.frame not in held_out for sweep in self.sweeps]
        self.bridged = [
            trajectory.gap_s(time) <= MAX_POSE_GAP_S or 0 < trajectory.outside_s(time) <= self.half_turn_s
            for time in self.times_s.tolist()
        ]
        # of two pictures in work at once, each with its window and what its window's sweeps are checked against
        window = 4 * options.sweeps + 4
        self._loaded: _Shared[_Loaded] = _Shared(self._load, window)
        self.moved = _Shared(self._seen_through, window).get
        """Gives which points of a sweep another sweep, that training may see, saw through."""

    def _load(self, index: int) -> _Loaded:
        recorded = self.sweeps[index]
        sweep = recorded.read()
        self.left_out[recorded.path] = sweep.not_finite, sweep.out_of_range
        beams = None
        if self._options.holdout_beams:
            sweep, held_out = without_beams(sweep, self._options.holdout_beams)
            beams = self._in_world(held_out, recorded) if len(held_out.points_m) else None
        world = self._in_world(sweep, recorded)
        return _Loaded(world, beams, FreeSpace.of(world) if self._options.sweeps else None)

    def _in_world(self, sweep: Sweep, recorded: RecordedSweep) -> WorldSweep:
        deskew = not self._options.raw_lidar
        return sweep_in_world(
            sweep, recorded.time_s, recorded.to_vehicle, self._trajectory, recorded.timing, deskew=deskew
        )

    def beams(self, index: int) -> WorldSweep | None:
        """What of a sweep is held out of everything."""
        return self._loaded.get(index).beams

    def around(self, index: int) -> list[int]:
        """The sweeps near another that training may see, without it."""
        reach = self._options.sweeps
        window = range(max(index - reach, 0), min(index + reach + 1, len(self.sweeps)))
        return [i for i in window if i != index and self.trains[i] and self.bridged[i]]

    def readable(self, index: int) -> bool:
        """Whether a sweep can be read; under `strict` one that cannot is an error."""
        return read_if_whole(partial(self._loaded.get, index), strict=self._options.strict) is not None

    def _seen_through(self, index: int) -> Bool[Tensor, "points"]:
        """Which points of a sweep another one saw through."""
        world = self._loaded.get(index).world
        passed = torch.zeros(len(world.points_m), dtype=torch.bool)
        for other in filter(self.readable, self.around(index)):
            free_space = self._loaded.get(other).free_space
            assert free_space is not None
            passed |= free_space.observed(world.points_m)[0]
        return passed

    def own(self, frame: int, time_s: float) -> int | None:
        """The sweep of a picture's frame: the one that belongs to it, else the nearest in time, within a turn."""
        if of_frame := self._of_frame.get(frame):
            return min(of_frame, key=lambda index: abs(self.times_s[index] - time_s))
        after = int(np.searchsorted(self.times_s, time_s))
        around = range(max(after - 1, 0), min(after + 1, len(self.sweeps)))
        nearest = min(around, key=lambda index: abs(self.times_s[index] - time_s))
        return nearest if abs(self.times_s[nearest] - time_s) <= 2 * self.half_turn_s else None

    def is_own(self, index: int, frame: int, time_s: float) -> bool:
        """Whether a sweep shows what a picture shows: it belongs to its frame, or was taken within half a turn.

        The time of a sweep is that of its poses, which may be its end.
        """
        return self.sweeps[index].frame == frame or bool(abs(self.times_s[index] - time_s) <= self.half_turn_s)

    def whole(self, index: int) -> WorldSweep:
        """A sweep with all its points."""
        return self._loaded.get(index).world


class SweepStore:
    """All sweeps of a recording that has a trajectory.

    Args:
        recording: with sweeps of any number of scanners.
        options: sweeps, raw_lidar, holdout_beams; under strict a sweep that cannot be read is an error for all
            pictures, else only for those of its own frame.
        held_out: numbers of the frames that training must not see.
    """

    def __init__(self, recording: Recording, options: ProcessOptions, held_out: Collection[int]) -> None:
        assert recording.trajectory is not None
        self._held_out = frozenset(held_out)
        by_scanner: dict[str, list[RecordedSweep]] = {}
        for sweep in recording.sweeps:
            by_scanner.setdefault(sweep.scanner, []).append(sweep)
        self.scanners = [Scanner(found, recording.trajectory, options, self._held_out) for found in by_scanner.values()]

    def notices(self) -> list[str]:
        """What was left out of the sweeps that were read."""
        left_out = [counts for scanner in self.scanners for counts in scanner.left_out.values()]
        not_finite, out_of_range = np.sum([*left_out, (0, 0)], axis=0)
        found = {"NaN or infinite": not_finite, "zero, nearer than 0.5 m or beyond 255 m": out_of_range}
        return [
            f"{count} LiDAR points were left out of {len(left_out)} sweeps: {why}."
            for why, count in found.items()
            if count
        ]

    def used(self, frame: int, time_s: float) -> list[RecordedSweep]:
        """The sweeps whose points a picture may get."""
        return [scanner.sweeps[index] for scanner in self.scanners for index in self._window(scanner, frame, time_s)]

    def _window(self, scanner: Scanner, frame: int, time_s: float) -> list[int]:
        """A picture's sweeps of one scanner, nearest in time first."""
        own = scanner.own(frame, time_s)
        if own is None:
            return []
        if frame in self._held_out:
            return [own] if scanner.sweeps[own].frame == frame else []
        window = [own] if scanner.trains[own] else []
        return window + sorted(scanner.around(own), key=lambda index: abs(scanner.times_s[index] - time_s))

    def beams(self, frame: int, time_s: float) -> Float[Tensor, "points 3"]:
        """What is held out of the sweeps of a picture's own frame, in the world, float64."""
        found = [torch.empty(0, 3, dtype=torch.float64)]
        for scanner in self.scanners:
            own = scanner.own(frame, time_s)
            beams = None if own is None else scanner.beams(own)
            if own is not None and beams is not None and scanner.is_own(own, frame, time_s):
                found.append(beams.points_m)
        return torch.cat(found)

    def around(self, frame: int, time_s: float, viewpoint_in_world: Transform, *, hide: bool = True) -> Surroundings:
        """Gather the points around a picture at a pose, camera to world; `hide` adds those that only hide others."""
        found = _Gathered(viewpoint_in_world[:3, 3])
        for scanner in self.scanners:
            window = self._window(scanner, frame, time_s)
            window = [*window[:1], *filter(scanner.readable, window[1:])]
            for rank, index in enumerate(window):
                age_s = abs(float(scanner.times_s[index]) - time_s)
                sweep = scanner.whole(index)
                if rank == 0 and scanner.is_own(index, frame, time_s):
                    # a picture that is held out has no others around it, and nothing lasting is made of it
                    moved = torch.zeros(len(sweep.points_m), dtype=torch.bool)
                    if len(window) > 1:
                        moved = scanner.moved(index)
                    found.add(sweep.points_m, sweep.spacing_m, moved, age_s)
                    if hide:
                        found.hide(*above_field(sweep, viewpoint_in_world[:3, 3]))
                else:
                    first, still = scanner.whole(window[0]), ~scanner.moved(index)
                    points_m, spacing_m = sweep.points_m[still], sweep.spacing_m[still]
                    low = elevation_rad(points_m, first) <= first.elevation_rad[1]
                    found.add(points_m[low], spacing_m[low], torch.zeros_like(low[low]), age_s)
        return found.together()


def elevation_rad(points_m: Float[Tensor, "points 3"], sweep: WorldSweep) -> Float[Tensor, "points"]:
    """Elevation of points as a sweep's scanner sees them."""
    x, y, z = transform_points(torch.from_numpy(sweep.world_to_scanner), points_m).unbind(-1)
    return torch.atan2(z, torch.hypot(x, y))


class _Gathered:
    """Collects points, nearest in time first, and thins them when they become too many."""

    def __init__(self, centre_m: np.ndarray) -> None:
        self._centre = torch.from_numpy(centre_m)
        nothing = torch.empty(0)
        self._parts = [(torch.empty(0, 3, dtype=torch.float64), nothing, nothing.bool(), nothing)]
        self._hiding: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
        self._voxel_m = VOXEL_M

    def add(self, points_m: Tensor, spacing_m: Tensor, moved: Tensor, age_s: float) -> None:
        self._parts.append((points_m, spacing_m, moved, torch.full_like(spacing_m, age_s)))
        while sum(len(part[0]) for part in self._parts) > MAX_POINTS:
            points, spacing, moved, age = (torch.cat(values) for values in zip(*self._parts, strict=True))
            kept = torch.from_numpy(first_in_voxel((points - self._centre).numpy(), self._voxel_m))
            # points further apart stand for wider patches: they are to hide as much as before
            wide = spacing[kept].clamp(min=_DIAGONAL * self._voxel_m)
            self._parts = [(points[kept], wide, moved[kept], age[kept])]
            self._voxel_m *= 1.2

    def hide(self, points_m: Tensor, spacing_m: Tensor) -> None:
        nothing = torch.zeros_like(spacing_m)
        self._hiding.append((points_m, spacing_m, nothing.bool(), nothing))

    def together(self) -> Surroundings:
        parts = zip(*self._parts, *self._hiding, strict=True)
        points, spacing, moved, age = (torch.cat(values) for values in parts)
        only_hides = torch.arange(len(points)) >= sum(len(part[0]) for part in self._parts)
        return Surroundings(points, spacing, age, only_hides, moved)
