"""Things that move, found in sweeps: what was there for one stretch of a drive, and gone before or after.

1. *Checked.* Each LiDAR point above the ground is checked against all sweeps near by, of any time of the drive: they
   see through its place, or meet something there. At a moving thing's place, sweeps meet nothing at first, then the
   thing for one stretch, then nothing again. At a still thing's place, hits and passes are mixed, above all in a crown
   of leaves.
2. *Gathered.* Points that moved are joined to things. Unknown points beside them are added, such as those of a car's
   roof with only sky behind it.
3. *Followed.* A thing of one sweep is the thing of the next that lies where its speed takes it. Where the evidence
   ends, as at the end of a drive, the thing is searched for at the place that its speed predicts. Things that stay
   where they are, or are seen in few sweeps, are dropped.

Positions are metres in the world, z up; times are seconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix, csr_matrix, identity
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from edge_depth_nerf.lidar.free_space import FreeSpace
from edge_depth_nerf.lidar.world import WorldSweep

FARTHEST_M = 60.0
"""LiDAR points beyond this are not checked: beams are too far apart there."""
_ABOVE_GROUND_M = 0.3
"""What lies lower is ground, or the foot of something."""
_GROUND_CELL_M = 1.0
_GROUND_RANK = 3
"""The so many-th lowest LiDAR point of a cell is its ground: strays lie below it."""

_MIN_SCORE = 2.0
"""A LiDAR point moved if, outside one stretch, so many more sweeps saw through its place than met something there."""
_HELD_MET = 3
"""A place where so many sweeps met something, and no stretch explains it, seems to hold still."""
_LASTING_MET, _LASTING_S = 2, 1.0
"""It certainly holds still if so many of them are this far off in time: a moving thing hides its own place for as long
as it takes to leave it."""
_VOTE_M = 0.5
"""Neighbours within this have a say."""
_MIN_VOTES = 3
_JOIN_M = 0.4
"""Unknown points within this of what moved belong to it."""
_JOIN_ROUNDS = 3
_APART_M = 0.9
"""What lies further apart is two things."""
_MIN_POINTS = 5

_GATE_M, _GATE_M_S, _GATE_CHANGE_M_S = 0.7, 14.0, 5.0
"""How far a thing may lie from where it is expected in the next sweep: by this, and with time by the speed that one may
have that was not seen before, and by that which one may gain."""
_MIN_SWEEPS = 3
_MIN_WAY_M = 0.8
"""What is seen in fewer sweeps, or goes less far, is not believed."""
_SPEED_SWEEPS = 2
"""A speed is worked out over so many sweeps to each side."""
_COASTED = 8
"""A thing is followed for so many sweeps without evidence."""
_COAST_SHARE = 0.3
"""This share of the expected LiDAR points must be there."""


# ---- the ground ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lowest:
    """The lowest LiDAR points of a sweep, by cells of the ground plan."""

    cells: Int[np.ndarray, "cells 2"]
    height_m: Float[np.ndarray, "cells"]

    @staticmethod
    def of(points_m: Float[np.ndarray, "points 3"]) -> Lowest:
        """Take the `_GROUND_RANK`-th lowest of each cell; cells with fewer points say nothing."""
        cells, height_m, first, count = _by_cell(_cell_of(points_m), points_m[:, 2])
        enough = count >= _GROUND_RANK
        chosen = first[enough] + _GROUND_RANK - 1
        return Lowest(cells[chosen], height_m[chosen])


class Ground:
    """Height of the ground by place, from all sweeps: a thing that stands somewhere for a while is not the ground."""

    def __init__(self, found: Sequence[Lowest]) -> None:
        self._height: dict[tuple[int, int], float] = {}
        if found:
            all_cells = np.concatenate([lowest.cells for lowest in found])
            all_m = np.concatenate([lowest.height_m for lowest in found])
            cells, height_m, first, count = _by_cell(all_cells, all_m)
            # the lowest fifth: a car stood there in some of the sweeps, a stray lay below in one
            chosen = first + count // 5
            self._height = {
                (x, y): z for (x, y), z in zip(cells[chosen].tolist(), height_m[chosen].tolist(), strict=True)
            }

    def above_m(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points"]:
        """How far points lie above the lowest ground of their cell and those around it; 0 where none is known."""
        cells, of_point = np.unique(_cell_of(points_m), axis=0, return_inverse=True)
        steps, height = (-1, 0, 1), self._height
        ground = [min(height.get((x + i, y + j), np.inf) for i in steps for j in steps) for x, y in cells.tolist()]
        lowest = np.array(ground)[of_point.reshape(-1)] if ground else np.zeros(0)
        return np.where(np.isfinite(lowest), points_m[:, 2] - lowest, 0.0)


def _cell_of(points_m: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, "points 2"]:
    return np.floor(points_m[:, :2] / _GROUND_CELL_M).astype(np.int64)


def _by_cell(
    cells: Int[np.ndarray, "n 2"], height_m: Float[np.ndarray, "n"]
) -> tuple[Int[np.ndarray, "n 2"], Float[np.ndarray, "n"], Int[np.ndarray, "cells"], Int[np.ndarray, "cells"]]:
    """Sort by cell and height; third and fourth, where each cell begins and how many it has."""
    order = np.lexsort((height_m, cells[:, 1], cells[:, 0]))
    cells, height_m = cells[order], height_m[order]
    first = np.flatnonzero(np.r_[True, np.any(np.diff(cells, axis=0) != 0, axis=1)][: len(cells)])
    return cells, height_m, first, np.diff(np.r_[first, len(cells)])


# ---- points that move ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Loose:
    """LiDAR points of a sweep that stand above the ground and are not known to hold still."""

    time_s: float
    """The sweep's own time."""
    rows: Int[np.ndarray, "n"]
    """Which points of the sweep they are."""
    points_m: Float[np.ndarray, "n 3"]
    """World."""
    moved: Bool[np.ndarray, "n"]
    """Whether the evidence says that they move; the others are unknown."""
    held: Bool[np.ndarray, "n"]
    """Whether they seem to hold still, though not for long: they may be of a thing that is expected there."""


def one_stretch(
    seen_through: Bool[np.ndarray, "sweeps n"], met: Bool[np.ndarray, "sweeps n"], own: int
) -> Float[np.ndarray, "n"]:
    """How well one stretch of presence explains what sweeps of other times saw at the places of a sweep's points.

    Outside the stretch, a sweep that saw through counts for it, and one that met something counts against it. Within
    the stretch, one that saw through counts against it. The best stretch that contains the sweep's own time is taken.

    Args:
        seen_through: by each of the others, in order of time.
        met: likewise.
        own: how many of them come before the sweep.

    Returns:
        Sweeps for it less sweeps against it.
    """
    score = np.zeros(seen_through.shape[1])
    for side in (slice(None, own), slice(None, own - 1 if own else None, -1)):
        # from the drive's end inwards
        through = seen_through[side].astype(np.float32)
        if not len(through):
            continue
        gain = np.cumsum(2 * through - met[side], axis=0)
        score += np.maximum(gain.max(0), 0) - through.sum(0)
    return score


def loose_points(sweep: WorldSweep, time_s: float, ground: Ground, others: Sequence[tuple[float, FreeSpace]]) -> Loose:
    """Find the LiDAR points of a sweep that moved, and those of which nothing is known.

    `others` are times and free space of sweeps near by, in order of time, without this one.
    """
    in_reach = sweep.points_m - torch.from_numpy(np.linalg.inv(sweep.world_to_scanner)[:3, 3])
    near = in_reach.norm(dim=-1) < FARTHEST_M
    rows = torch.nonzero(near).squeeze(-1).numpy()
    points = sweep.points_m[near].numpy()
    standing = ground.above_m(points) > _ABOVE_GROUND_M
    rows, points = rows[standing], points[standing]
    seen_through = np.zeros((len(others), len(points)), bool)
    met = np.zeros_like(seen_through)
    for number, (_, free_space) in enumerate(others):
        passed, ended = free_space.observed(torch.from_numpy(points))
        seen_through[number], met[number] = passed.numpy(), ended.numpy()
    times_s = np.array([other_s for other_s, _ in others])
    score = one_stretch(seen_through, met, int(np.searchsorted(times_s, time_s)))
    moved = score >= _MIN_SCORE
    held = ~moved & (met.sum(0) >= _HELD_MET) & (score <= 0)
    lasting = held & (met[np.abs(times_s - time_s) >= _LASTING_S].sum(0) >= _LASTING_MET)
    if len(points):
        moved = _outvoted(points, moved, held)
    kept = ~lasting
    return Loose(time_s, rows[kept], points[kept], moved[kept], held[kept])


def _outvoted(
    points_m: Float[np.ndarray, "n 3"], moved: Bool[np.ndarray, "n"], held: Bool[np.ndarray, "n"]
) -> Bool[np.ndarray, "n"]:
    """Drop what moved alone, or amid what holds still."""
    cells, of_point = _cells_of(points_m, _VOTE_M)
    near = _neighbours(cells, 1.8)
    votes = np.stack([np.bincount(of_point, weights=which, minlength=len(cells)) for which in (moved, held)], -1)
    for_it, against = (near @ votes).T
    return moved & ((for_it >= _MIN_VOTES) & (for_it > against))[of_point]


def _cells_of(
    points_m: Float[np.ndarray, "n 3"], cell_m: float
) -> tuple[Int[np.ndarray, "cells 3"], Int[np.ndarray, "n"]]:
    """The cubes that points lie in, and which of them each is in."""
    cells, of_point = np.unique(np.floor(points_m / cell_m).astype(np.int64), axis=0, return_inverse=True)
    return cells, of_point.reshape(-1)


def _neighbours(cells: Int[np.ndarray, "cells 3"], reach: float) -> csr_matrix:
    """Which cubes lie within `reach` of each other, counted in cubes; each one does of itself."""
    pairs = KDTree(cells).query_pairs(reach, output_type="ndarray")
    once = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(cells), len(cells))).tocsr()
    return (once + once.T + identity(len(cells), format="csr")).tocsr()


# ---- things of a sweep -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Thing:
    """LiDAR points of one sweep that move together; fields as of `Loose`."""

    time_s: float
    rows: Int[np.ndarray, "n"]
    points_m: Float[np.ndarray, "n 3"]
    velocity_m_s: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))
    """Along the world's x and y."""

    @cached_property
    def centre_m(self) -> Float[np.ndarray, "2"]:
        """Middle of its extent, x and y."""
        low, high = np.quantile(self.points_m[:, :2], (0.05, 0.95), axis=0)
        return (low + high) / 2


def things_of(loose: Loose) -> list[Thing]:
    """Gather what hangs together, with the unknown points beside it."""
    if not loose.moved.any():
        return []
    chosen = loose.moved.copy()
    for _ in range(_JOIN_ROUNDS):
        open_ = np.flatnonzero(~chosen & ~loose.held)
        if not len(open_):
            break
        away_m, _ = KDTree(loose.points_m[chosen]).query(loose.points_m[open_], distance_upper_bound=_JOIN_M)
        chosen[open_[np.isfinite(away_m)]] = True
    members = np.flatnonzero(chosen)
    label = _connected(loose.points_m[members], _APART_M)
    found = [members[label == number] for number in range(label.max() + 1)]
    return [
        Thing(loose.time_s, loose.rows[group], loose.points_m[group])
        for group in found
        if loose.moved[group].sum() >= _MIN_POINTS
    ]


def _connected(points_m: Float[np.ndarray, "n 3"], apart_m: float) -> Int[np.ndarray, "n"]:
    """Number what hangs together by steps of about `apart_m`."""
    cells, of_point = _cells_of(points_m, apart_m / 3)
    return connected_components(_neighbours(cells, 3.0), directed=False)[1][of_point]


# ---- things over time ------------------------------------------------------------------------------------------


def followed(loose: Mapping[int, Loose]) -> dict[int, list[Thing]]:
    """Find the things that move in a scanner's sweeps, given by their numbers in order of time, with their speeds."""
    numbers = list(loose)
    found = [things_of(loose[number]) for number in numbers]
    tracks = [_with_speeds(track) for track in _linked(found) if _believed(track)]
    ordered = [loose[number] for number in numbers]
    result: dict[int, list[Thing]] = {number: [] for number in numbers}
    for track in tracks:
        for place, thing in _coasted(track, ordered).items():
            result[numbers[place]].append(thing)
    return result


def _linked(found: Sequence[Sequence[Thing]]) -> list[dict[int, Thing]]:
    """Chain the things of sweeps that follow one another; by place in the sequence."""
    tracks: list[dict[int, Thing]] = []
    open_: list[dict[int, Thing]] = []
    for place, things in enumerate(found):
        cost = _cost(open_, things)
        rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e6))
        taken = {column: row for row, column in zip(rows, columns, strict=True) if np.isfinite(cost[row, column])}
        for column, thing in enumerate(things):
            if column in taken:
                open_[taken[column]][place] = thing
            else:
                track = {place: thing}
                tracks.append(track)
                open_.append(track)
        open_ = [track for track in open_ if place - max(track) < 3]
    return tracks


def _cost(tracks: Sequence[Mapping[int, Thing]], things: Sequence[Thing]) -> Float[np.ndarray, "tracks things"]:
    """How far things lie from where tracks lead; infinite where that is too far."""
    if not tracks or not things:
        return np.full((len(tracks), len(things)), np.inf)
    step_s = np.array([things[0].time_s - track[max(track)].time_s for track in tracks])
    last = np.array([track[max(track)].centre_m for track in tracks])
    speed = np.array([_latest_speed(track) for track in tracks])
    fresh = np.array([len(track) == 1 for track in tracks])
    centres = np.array([thing.centre_m for thing in things])
    off_m = np.linalg.norm(centres - (last + step_s[:, None] * speed)[:, None], axis=-1)
    gate_m = _GATE_M + step_s * np.where(fresh, _GATE_M_S, _GATE_CHANGE_M_S)
    return np.where(off_m < gate_m[:, None], off_m, np.inf)


def _latest_speed(track: Mapping[int, Thing]) -> Float[np.ndarray, "2"]:
    places = sorted(track)[-3:]
    if len(places) < 2:
        return np.zeros(2)
    first, last = track[places[0]], track[places[-1]]
    return (last.centre_m - first.centre_m) / (last.time_s - first.time_s)


def _believed(track: Mapping[int, Thing]) -> bool:
    centres = np.array([thing.centre_m for _, thing in sorted(track.items())])
    return len(track) >= _MIN_SWEEPS and float(np.linalg.norm(centres - centres[0], axis=1).max()) >= _MIN_WAY_M


def _with_speeds(track: Mapping[int, Thing]) -> dict[int, Thing]:
    """Work out each thing's speed from those of the sweeps around it."""
    places = sorted(track)
    result = {}
    for at, place in enumerate(places):
        around = [track[p] for p in places[max(at - _SPEED_SWEEPS, 0) : at + _SPEED_SWEEPS + 1]]
        times = np.array([thing.time_s for thing in around])
        centres = np.array([thing.centre_m for thing in around])
        times = times - times.mean()
        speed = (times[:, None] * (centres - centres.mean(0))).sum(0) / (times**2).sum()
        result[place] = replace(track[place], velocity_m_s=speed)
    return result


def _coasted(track: Mapping[int, Thing], ordered: Sequence[Loose]) -> dict[int, Thing]:
    """Follow a thing into gaps, and beyond the first and the last sweep where it was found."""
    result = dict(track)
    for step in (1, -1):
        for place in sorted(track, reverse=step < 0):
            at, since = place + step, 1
            while 0 <= at < len(ordered) and at not in result and since <= _COASTED:
                # as it was when it was seen: what lies beside it must not creep in from sweep to sweep
                here = expected_at(track[place], ordered[at])
                if here is None:
                    break
                result[at] = here
                at, since = at + step, since + 1
    return result


def expected_at(thing: Thing, loose: Loose) -> Thing | None:
    """Search for a thing where its speed takes it, in a sweep of another time."""
    shift = np.r_[(loose.time_s - thing.time_s) * thing.velocity_m_s, 0.0]
    expected = thing.points_m + shift
    low, high = expected.min(0) - _JOIN_M, expected.max(0) + _JOIN_M
    near = np.flatnonzero(np.all((loose.points_m > low) & (loose.points_m < high), axis=1))
    if not len(near):
        return None
    away_m, _ = KDTree(expected).query(loose.points_m[near], distance_upper_bound=_JOIN_M)
    near = near[np.isfinite(away_m)]
    enough = max(_COAST_SHARE * len(expected), _MIN_POINTS)
    members = near[~loose.held[near]]
    if len(members) < enough:
        members = near
    if len(members) < enough:
        return None
    return Thing(loose.time_s, loose.rows[members], loose.points_m[members], thing.velocity_m_s)


def nearby(number: int, centres_m: Float[np.ndarray, "sweeps 3"], may: Sequence[bool], most: int = 40) -> list[int]:
    """Choose the sweeps that check one: those taken near by, those nearest in time first, the rest spread."""
    away_m = np.linalg.norm(centres_m - centres_m[number], axis=1)
    possible = [
        other for other in range(len(centres_m)) if other != number and may[other] and away_m[other] < FARTHEST_M
    ]
    possible.sort(key=lambda other: abs(other - number))
    next_, rest = possible[: most // 4], possible[most // 4 :]
    if len(rest) > most - len(next_):
        rest = [rest[index] for index in np.linspace(0, len(rest) - 1, most - len(next_)).astype(int)]
    return sorted({*next_, *rest})
