"""Masks of what moves, found by LiDAR: `moving_masks/CAMERA/0000000123.png` in the scene, 255 = use the pixel.

They have the size of the raw pictures, so that the folder can be given as --frame-masks. A mask that was corrected
stays unchanged; others are made again if a sweep is newer. Masks of training pictures use nothing from the sweeps of
held-out frames. A held-out picture gets a mask from its own sweep: it decides which pixels are evaluated.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import NDArray
from rich.console import Console
from scipy.spatial import KDTree

from edge_depth_nerf.base.console import run_jobs
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import is_newer, read_image, read_mask, sha256_of, write_mask, write_text
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.lidar.free_space import FreeSpace
from edge_depth_nerf.lidar.moving import (
    Ground,
    Loose,
    Lowest,
    Thing,
    expected_at,
    followed,
    loose_points,
    nearby,
    things_of,
)
from edge_depth_nerf.lidar.world import WorldSweep
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.masks.moving import clearest_edge, grow_moving
from edge_depth_nerf.masks.regions import enlarge, working_factor
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import downscale_image, downscale_mask, read_if_whole
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.process.sweep_store import Scanner, SweepStore, elevation_rad

MOVING_MASKS = "moving_masks"
"""Folder of the scene with the masks of what moves."""

_FOOT_M = (0.06, 0.3)
"""LiDAR points between these heights above the ground are left out of the search for things; they are feet and
wheels."""
_FOOT_AWAY_M = 0.25
"""Of those, the ones within this of a thing, across the ground, are its own."""
_BODY_ENDS_M = 0.25
"""What the scanner's lowest beams meet goes on down to this above the ground."""
_EDGE_RAD = 0.015
"""LiDAR points within this of the highest or lowest direction are at the edge of the scanner's field."""
_TALLEST_M = 3.5
"""Above the scanner's field a thing is searched for up to this height above the ground: that of a bus."""
_LONG_M = 2.5
"""Only what is longer than this may be higher than the field: people are not."""
_STEP_M = 0.1


def moving_mask_path(scene: Path, picture: RecordedPicture) -> Path:
    """Where a picture's mask lies."""
    return scene / MOVING_MASKS / picture.camera / f"{picture.frame:010d}.png"


def find_moving(
    recording: Recording,
    options: ProcessOptions,
    held_out: set[int],
    ego: Mapping[str, NDArray[np.bool_]],
    console: Console,
) -> tuple[Recording, list[str]]:
    """Find what moves, write the masks that are missing or out of date, and give them to the recording's pictures.

    The recording has a trajectory. `held_out` are numbers of the frames that training must not see, `ego` the vehicle's
    masks by camera, in the size of the raw pictures.

    Returns:
        The recording, and what the user should know.

    Raises:
        InputError: there are no sweeps.
    """
    if not recording.sweeps:
        raise InputError(
            "--find-moving: the drive has no LiDAR sweeps, which it needs. Leave it out, or give masks with "
            "--frame-masks."
        )
    paths = [moving_mask_path(options.output, picture) for picture in recording.pictures]
    sweeps = [sweep.path for sweep in recording.sweeps if sweep.path.exists()]
    newest = sorted(sweeps, key=lambda path: path.stat().st_mtime_ns)[-1:]
    given = zip(paths, recording.pictures, strict=True)
    missing = [each for each in given if not (is_newer(each[0], newest) or _was_corrected(each[0]))]
    if missing:
        store = SweepStore(recording, options, held_out)
        found = [_ScannersThings(scanner, held_out, console) for scanner in store.scanners]
        jobs = [partial(_write_mask, path, recording, picture, found, ego, options) for path, picture in missing]
        run_jobs(jobs, "Masking what moves", console)
    made = [path if path.is_file() else None for path in paths]
    pictures = [replace(picture, moving_mask=mask) for picture, mask in zip(recording.pictures, made, strict=True)]
    shares = [1 - float(read_mask(path).mean()) for path in made if path is not None]
    notice = (
        f"Moving objects were found in {sum(share > 0 for share in shares)} of {len(shares)} pictures and hide "
        f"{np.mean(shares):.1%} of them. Look at {options.output / MOVING_MASKS}: correct them there and process "
        "the drive again."
    )
    return replace(recording, pictures=tuple(pictures)), [notice]


def _as_found(mask: Path) -> Path:
    """The file with a mask's SHA-256 when it was found."""
    return mask.parents[2] / ".cache" / MOVING_MASKS / mask.parent.name / f"{mask.stem}.sha256"


def _was_corrected(mask: Path) -> bool:
    """Whether there is a mask, and it is not the one that was found."""
    found = _as_found(mask)
    return mask.is_file() and not (found.is_file() and found.read_text(encoding="utf-8") == sha256_of(mask))


class _ScannersThings:
    """What moves in the sweeps of one scanner."""

    def __init__(self, scanner: Scanner, held_out: set[int], console: Console) -> None:
        self.scanner, self._held_out = scanner, held_out
        usable = [index for index in range(len(scanner.sweeps)) if scanner.bridged[index] and scanner.readable(index)]
        self._trained = [index for index in usable if scanner.trains[index]]
        looked = run_jobs([partial(self._look, index) for index in usable], "Reading sweeps", console)
        free_spaces = {index: free_space for index, (free_space, _) in zip(usable, looked, strict=True)}
        self.ground = Ground([low for index, (_, low) in zip(usable, looked, strict=True) if scanner.trains[index]])
        centres_m = np.array([np.linalg.inv(free_spaces[i].world_to_scanner.numpy())[:3, 3] for i in usable])
        trains = [scanner.trains[index] for index in usable]

        def evaluate(place: int) -> Loose:
            others = [usable[other] for other in nearby(place, centres_m, trains)]
            time_s, sweep = scanner.times_s[usable[place]], scanner.whole(usable[place])
            seen_by = [(float(scanner.times_s[other]), free_spaces[other]) for other in others]
            return loose_points(sweep, float(time_s), self.ground, seen_by)

        jobs = [partial(evaluate, place) for place in range(len(usable))]
        loose = dict(zip(usable, run_jobs(jobs, "Finding what moves", console), strict=True))
        self._things = followed({index: loose[index] for index in self._trained})
        for index in usable:
            if not scanner.trains[index]:
                self._things[index] = self._of_held_out(index, loose[index])

    def _look(self, index: int) -> tuple[FreeSpace, Lowest]:
        """A sweep's free space, and what it says of the ground."""
        sweep = self.scanner.whole(index)
        below = sweep.points_m[:, 2] < float(np.linalg.inv(sweep.world_to_scanner)[2, 3])
        return FreeSpace.of(sweep), Lowest.of(sweep.points_m[below].numpy())

    def _of_held_out(self, index: int, loose: Loose) -> list[Thing]:
        """What moves in a sweep that is held out: found by itself, or expected there by the sweeps around it."""
        around = [other for other in self._trained if other < index][-1:]
        around += [other for other in self._trained if other > index][:1]
        expected = [expected_at(thing, loose) for other in around for thing in self._things[other]]
        expected = [thing for thing in expected if thing is not None]
        return [*expected, *_not_alone(things_of(loose), expected)]

    def seen_from(self, frame: int, time_s: float) -> tuple[WorldSweep, list[Thing], int] | None:
        """The sweep of a picture's frame and what moves in it; None without one that the picture may use."""
        index = self.scanner.own(frame, time_s)
        if index is None or index not in self._things:
            return None
        may = self.scanner.sweeps[index].frame == frame if frame in self._held_out else self.scanner.trains[index]
        return (self.scanner.whole(index), self._things[index], index) if may else None


def _not_alone(things: Sequence[Thing], expected: Sequence[Thing]) -> list[Thing]:
    """Those that share LiDAR points with what was expected: their speed is known."""
    pairs = [(thing, next((o for o in expected if np.isin(thing.rows, o.rows).any()), None)) for thing in things]
    return [replace(thing, velocity_m_s=other.velocity_m_s) for thing, other in pairs if other is not None]


# ---- in a picture ----------------------------------------------------------------------------------------------


Points = Float64[np.ndarray, "n 4"]
"""What a scanner says something of at a picture's time: x, y, z, and how far apart such points are, metres."""


def _raised(points: Points, by_m: float) -> Points:
    """The same higher up, in steps that are no wider than the points are apart."""
    return np.column_stack((points[:, :2], points[:, 2] + by_m, np.maximum(points[:, 3], _STEP_M)))


def _write_mask(
    path: Path,
    recording: Recording,
    picture: RecordedPicture,
    found: Sequence[_ScannersThings],
    ego: Mapping[str, NDArray[np.bool_]],
    options: ProcessOptions,
) -> None:
    """Find what moves in one picture, and write its mask; none for a picture that cannot be read, unless strict."""
    full = next(camera.camera for camera in recording.cameras if camera.name == picture.camera)
    moving = np.zeros((full.height, full.width), bool)
    for things in found:
        seen = things.seen_from(picture.frame, picture.time_s)
        if seen is not None and seen[1]:
            factor = working_factor(moving.shape)
            camera = full.downscaled(factor)
            usable = lens_circle(camera, options.theta_max_deg)
            if picture.camera in ego:
                usable &= downscale_mask(ego[picture.camera], factor)
            image = read_if_whole(partial(read_image, picture.path), strict=options.strict)
            if image is None:
                # once it is mended, it gets a mask
                return
            image = downscale_image(image, factor)
            grown = _moving_pixels(image, camera, usable, recording.pose(picture), picture.time_s, things, seen)
            moving |= enlarge(grown, factor, (full.height, full.width))
    write_mask(path, ~moving)
    write_text(_as_found(path), sha256_of(path))


def _moving_pixels(
    image: NDArray[np.uint8],
    camera: Camera,
    usable: NDArray[np.bool_],
    camera_to_world: NDArray[np.float64],
    time_s: float,
    scanner: _ScannersThings,
    seen: tuple[WorldSweep, list[Thing], int],
) -> NDArray[np.bool_]:
    """What of a picture shows a thing that moves."""
    sweep, things, index = seen
    late_s = time_s - float(scanner.scanner.times_s[index])
    world_to_camera = np.linalg.inv(camera_to_world)
    moving, cut_off, taken = _at_time(sweep, things, late_s, scanner.ground)
    for highest in cut_off:
        lines = [highest[up] for up in _heights(scanner.ground.above_m(highest[:, :3]))]
        steps = [_raised(line, (number + 1) * _STEP_M) for number, line in enumerate(lines)]
        roof = clearest_edge(image, [_pixels(_in_camera(world_to_camera, step), step, camera)[0] for step in steps])
        moving = np.concatenate([moving, *steps[: 0 if roof is None else roof + 1]])
    every = np.concatenate([moving, np.delete(_points_of(sweep), taken, axis=0)])
    in_camera = _in_camera(world_to_camera, every)
    spacing_m = torch.from_numpy(every[:, 3]).float()
    chosen = project_points(in_camera.float(), camera, spacing_m=spacing_m).point_index.numpy()
    shown = chosen[(chosen >= 0) & (chosen < len(moving))]
    points_px, reach_px = _pixels(in_camera[shown], every[shown], camera)
    holds_still = ~usable | (chosen >= len(moving))
    return grow_moving(image, points_px, reach_px, holds_still) & usable


def _heights(height_m: NDArray[np.float64]) -> Iterator[NDArray[np.bool_]]:
    """Which points can be raised by one, two, three steps and so on, that lie so far above the ground."""
    lowest_m = float(height_m.min(initial=_TALLEST_M))
    for step_m in np.arange(_STEP_M, _TALLEST_M - lowest_m, _STEP_M):
        yield height_m + step_m < _TALLEST_M


def _points_of(sweep: WorldSweep) -> Points:
    return np.column_stack((sweep.points_m.numpy(), sweep.spacing_m.numpy()))


def _at_time(
    sweep: WorldSweep, things: Sequence[Thing], late_s: float, ground: Ground
) -> tuple[Points, list[Points], NDArray[np.int64]]:
    """Where things are some time after a sweep's time.

    Returns:
        Their points; of each long thing those at the upper edge of the scanner's field; rows of their LiDAR points.
    """
    moving, cut_off, rows, whole = [np.zeros((0, 4))], [], [np.zeros(0, np.int64)], _points_of(sweep)
    for thing in things:
        of_thing = np.concatenate((thing.rows, _feet(sweep, thing, ground)))
        points = whole[of_thing]
        points[:, :2] += (late_s - sweep.offset_s.numpy()[of_thing])[:, None] * thing.velocity_m_s
        elevation = elevation_rad(sweep.points_m[of_thing], sweep).numpy()
        rows.append(of_thing)
        moving.append(points)
        # below the scanner's field the thing goes on
        lowest = points[elevation < sweep.elevation_rad[0] + _EDGE_RAD]
        height = ground.above_m(lowest[:, :3])
        for step_m in np.arange(_STEP_M, float(height.max(initial=0)) - _BODY_ENDS_M, _STEP_M):
            moving.append(_raised(lowest[height - step_m > _BODY_ENDS_M], -step_m))
        if np.ptp(thing.points_m[:, :2], axis=0).max() > _LONG_M:
            cut_off.append(points[elevation > sweep.elevation_rad[1] - _EDGE_RAD])
    return np.concatenate(moving), cut_off, np.concatenate(rows)


def _feet(sweep: WorldSweep, thing: Thing, ground: Ground) -> NDArray[np.int64]:
    """Rows of the LiDAR points just above the ground that are a thing's."""
    points = sweep.points_m.numpy()
    low, high = thing.points_m.min(0) - _FOOT_AWAY_M, thing.points_m.max(0) + _FOOT_AWAY_M
    near = np.flatnonzero(np.all((points[:, :2] > low[:2]) & (points[:, :2] < high[:2]), axis=1))
    height = ground.above_m(points[near])
    near = near[(height > _FOOT_M[0]) & (height <= _FOOT_M[1])]
    away_m, _ = KDTree(thing.points_m[:, :2]).query(points[near, :2], distance_upper_bound=_FOOT_AWAY_M)
    return near[np.isfinite(away_m)]


def _in_camera(world_to_camera: NDArray[np.float64], points: Points) -> torch.Tensor:
    return transform_points(torch.from_numpy(world_to_camera), torch.from_numpy(points[:, :3]))


def _pixels(
    points_in_camera: torch.Tensor, points: Points, camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where points are seen, and how many pixels their spacing is; those out of view are left out."""
    across = torch.linalg.cross(points_in_camera, points_in_camera.roll(1, dims=-1))
    across = across / across.norm(dim=-1, keepdim=True).clamp(min=1e-9)
    pixels, valid = camera.project(points_in_camera)
    beside, valid_beside = camera.project(points_in_camera + across * torch.from_numpy(points[:, 3:]))
    seen = valid & valid_beside & camera.inside(pixels)
    return pixels[seen].numpy(), (beside - pixels)[seen].norm(dim=-1).numpy()
