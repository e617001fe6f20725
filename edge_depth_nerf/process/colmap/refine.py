"""Poses refined by the pictures: features tracked with the given poses as the start, and a bundle adjusted to both.

The given path, of LiDAR odometry, a file or COLMAP, is held softly (`bundle.Softness`): features decide from step to
step, where they are good to hundredths of a degree; scale and drift, of which they know little, stay the given path's.
All cameras of a frame move with the vehicle as one.

A fifth of the tracks takes no part. By them the path is checked before and after: unless their features come nearer to
their epipolar curves, and nothing has moved further than the given poses can be off, the given path stays.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int
from rich.console import Console

from edge_depth_nerf.base.console import in_turn
from edge_depth_nerf.base.files import (
    file_stamp,
    read_image,
    read_json,
    read_npz,
    sha256_of,
    write_atomically,
    write_json,
)
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.poses.matches import Matches, PosedPicture, epipolar_distance_px, match_pictures, sights_of
from edge_depth_nerf.poses.tracks import Tracks, features_joined, join_matches, reprojection_px, spread, triangulate
from edge_depth_nerf.process.colmap.bundle import Shot, Softness, adjust_bundle
from edge_depth_nerf.process.colmap.models import colmap_lenses, import_pycolmap, pairs_to_match
from edge_depth_nerf.process.colmap.scale import frame_times
from edge_depth_nerf.process.feature_masks import FeatureMasks, posed_pictures
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.scene.format import REFINED_POSES

OPTION = "--refine-poses"
MATCHES = ".cache/matches"
"""Of a scene whose poses are being refined."""
SOFTNESS = Softness(position_m=0.1, turn_rad=math.radians(0.3))
"""How far given poses are usually off."""
FURTHEST_M = 0.5
"""A path that moves further than this from the given one is not taken: five standard deviations."""
FURTHEST_DEG = 1.5
"""Likewise for turns."""
LEAST_GAIN = 0.05
"""The features that took no part must come nearer to their curves by this share; less is chance."""

_VERSION = 3
"""Of what is done with the inputs, and of the file; raised when results change."""
_APART = (1, 2, 3, 5, 8)
"""So many frames lie between the matched pictures of one camera; 1 is the next."""
_ACROSS = (0, 1, 2)
"""Between those of two cameras whose views overlap."""
_KEPT_TOGETHER = 200
"""The matches of so many pairs are kept in one file until the poses are refined."""
_MOST_BYTES = 1 << 28
_MOST_FEATURES = 2500
_MOST_SIGHTS = 700
"""Of a picture, in the bundle."""
_ROUNDS_DEG = (0.6, 0.2, 0.1, 0.1)
"""How far features may lie from where the poses put them, round by round."""
_ROUNDS_LEAST_PX = (3.0, 1.5, 1.0, 1.0)
"""Features are found to some tenths of a pixel, however coarse the picture."""
_LEAST_SIGHTS = 30
"""A frame whose pictures see fewer points moves as the frames around it do."""
_LEAST_CHECKS = 100
"""So many matches that took no part tell whether a path is better."""
_CHECK_SHARE = 5
"""One track of so many takes no part in the bundle."""


@dataclass(frozen=True)
class Refinement:
    """What became of the given poses."""

    vehicle_to_world: Float64[np.ndarray, "frames 4 4"]
    """Of each frame, refined."""
    supported: Bool[np.ndarray, "frames"]
    """Which frames were moved by features; the others move as those around them do."""
    points: int
    """Points in the bundle."""
    before_px: float
    """Median distance to the epipolar curves of features that took no part, with the given poses; 0 without any."""
    after_px: float
    """The same with the refined ones."""
    checks: int
    """How many matches these medians are of."""


def refine_poses(recording: Recording, options: ProcessOptions, console: Console) -> Recording:
    """Move the poses of a recording to where its pictures agree with them, and with each other, best.

    What was found is kept in the scene for the next run.

    Returns:
        The recording with the refined path, pictures' and shifted views' poses moved with it; or unchanged, if that
        would not be better. A notice reports which.

    Raises:
        InputError: pycolmap is missing or too old, the recording has no path; with --strict, a picture is broken.
    """
    pycolmap = import_pycolmap(OPTION)
    trajectory = recording.trajectory
    assert trajectory is not None
    times = frame_times(recording)
    frames, times_s = list(times), np.array(list(times.values()))
    if len(frames) < 2 or not (np.diff(times_s) > 0).all():
        return _kept(recording, "the pictures are not of two or more consecutive frames")
    given = trajectory.at(times_s)
    shots = _shots(recording, frames, given)

    def reshoot(refined: Float64[np.ndarray, "frames 4 4"], supported: Bool[np.ndarray, "frames"]) -> list[Shot]:
        """The pictures on the rig, by the present path."""
        moved, change = _moved(recording, times_s, frames, given, refined, supported)
        return _shots(moved, frames, given @ change)

    digest = _digest(pycolmap.__version__, recording, options, given)
    found = _read_refinement(options.output / REFINED_POSES, digest)
    if found is None:
        store = options.output / MATCHES
        matches = _match(recording, options, console, store / digest[:16])
        with console.status("Refining the poses …"):
            found = refine(pycolmap, shots, matches, given, reshoot=reshoot)
        arrays = {"vehicle_to_world": found.vehicle_to_world.tolist(), "supported": found.supported.tolist()}
        write_json(options.output / REFINED_POSES, {"digest": digest, **vars(found), **arrays})
        shutil.rmtree(store, ignore_errors=True)
    if found.checks < _LEAST_CHECKS:
        return _kept(recording, f"only {found.checks} features could be matched for the check")
    distances = f"{found.before_px:.2f} px before, {found.after_px:.2f} px after"
    if not found.after_px <= (1 - LEAST_GAIN) * found.before_px:
        return _kept(recording, f"features agree with them as well as with the refined ones ({distances})")
    if found.supported.sum() < 2:
        return _kept(recording, "the pictures of too few frames show features")
    refined, change = _moved(recording, times_s, frames, given, found.vehicle_to_world, found.supported)
    cosine = ((np.trace(change[:, :3, :3], axis1=1, axis2=2) - 1) / 2).clip(-1, 1)
    furthest_m = float(np.linalg.norm(change[:, :3, 3], axis=-1).max())
    furthest_deg = float(np.degrees(np.arccos(cosine)).max())
    if furthest_m > FURTHEST_M or furthest_deg > FURTHEST_DEG:
        return _kept(
            recording,
            f"refining would move them by up to {furthest_m:.2f} m and {furthest_deg:.1f}°, too far to be trusted. "
            "If they are wrong by that much, use --poses colmap",
        )
    notice = (
        f"Poses refined by {found.points} points that the pictures share. The poses moved by up to "
        f"{100 * furthest_m:.0f} cm and {furthest_deg:.2f}°. Check with {found.checks} other matches: the median "
        f"distance of features to their epipolar lines is {distances}."
    )
    return dataclasses.replace(refined, notices=(*recording.notices, notice))


def check_refining(recording: Recording, options: ProcessOptions) -> None:
    """Check what can be checked before the long work.

    Raises:
        InputError: pycolmap is missing, or a lens has no counterpart in COLMAP.
    """
    import_pycolmap(OPTION)
    colmap_lenses(recording, options)


def _kept(recording: Recording, why: str) -> Recording:
    return dataclasses.replace(recording, notices=(*recording.notices, f"The given poses are used unchanged: {why}."))


def _digest(
    version: str, recording: Recording, options: ProcessOptions, given: Float64[np.ndarray, "frames 4 4"]
) -> str:
    """Of everything that the refined poses depend on, pictures and masks by size and time of change."""
    cameras = [
        [c.name, c.camera.to_dict(), c.to_vehicle.tolist(), None if c.ego_mask is None else sha256_of(c.ego_mask)]
        for c in recording.cameras
    ]
    pictures = [
        [p.camera, p.frame, recording.pose(p).tolist(), file_stamp(p.path), p.mask and file_stamp(p.mask)]
        for p in recording.pictures
    ]
    rest = [_VERSION, version, given.tolist(), options.theta_max_deg, *options.holdout_cameras]
    return hashlib.sha256(json.dumps([cameras, pictures, rest]).encode()).hexdigest()


def _read_refinement(path: Path, digest: str) -> Refinement | None:
    """What an earlier run found for the same inputs."""
    found = read_json(path) if path.is_file() else None
    if not isinstance(found, dict) or found.get("digest") != digest:
        return None
    del found["digest"]
    for key in ("vehicle_to_world", "supported"):
        found[key] = np.array(found[key])
    return Refinement(**found)


# ---- what the pictures share -----------------------------------------------------------------------------------


def _shots(recording: Recording, frames: Sequence[int], given: Float64[np.ndarray, "frames 4 4"]) -> list[Shot]:
    """The pictures on the rig of their frame: with the vehicle's motion between the frame's time and the picture's."""
    number = {frame: index for index, frame in enumerate(frames)}
    lenses = {camera.name: camera.camera for camera in recording.cameras}
    to_vehicle = np.linalg.inv(given)
    return [
        Shot(lenses[picture.camera], number[picture.frame], to_vehicle[number[picture.frame]] @ recording.pose(picture))
        for picture in recording.pictures
    ]


def _match(recording: Recording, options: ProcessOptions, console: Console, store: Path) -> list[Matches]:
    """Match the pictures that were taken shortly after one another; continue what an earlier run left in `store`."""
    lenses = colmap_lenses(recording, options)
    masks = FeatureMasks(recording, options, {name: lens.theta_max_rad for name, lens in lenses.items()})
    posed = posed_pictures(recording, masks, partial(_read, strict=options.strict))
    pairs = [
        (one, other)
        for one, other in pairs_to_match(recording, lenses, _APART, _ACROSS)
        if not {posed[one].camera, posed[other].camera} & {*options.holdout_cameras}
    ]
    found: list[Matches] = []
    while (block := store / f"{len(found):07d}.npz").is_file():
        found += _read_matches(block, posed)
    left, done = pairs[len(found) :], len(found)
    matching = match_pictures(posed, left, _MOST_FEATURES)
    shown = zip(in_turn(left, "Matching pictures", console, done), matching, strict=False)
    for number, (_, matches) in enumerate(shown, 1):
        found.append(matches)
        if number % _KEPT_TOGETHER == 0:
            _write_matches(store / f"{len(found) - _KEPT_TOGETHER:07d}.npz", found[-_KEPT_TOGETHER:])
    return [matches for matches in found if len(matches)]


def _write_matches(path: Path, found: Sequence[Matches]) -> None:
    pairs = [(each.first, each.second, len(each)) for each in found]
    pixels = [np.hstack([each.in_first.pixels, each.in_second.pixels]) for each in found]
    arrays = {"pairs": np.array(pairs), "index": np.concatenate([each.index for each in found])}
    arrays["pixels"] = np.concatenate(pixels)
    write_atomically(path, lambda temporary: np.savez(temporary, **arrays))


def _read_matches(path: Path, posed: Sequence[PosedPicture]) -> Iterator[Matches]:
    arrays = read_npz(path, ("pairs", "index", "pixels"), _MOST_BYTES)
    ends = arrays["pairs"][:, 2].cumsum()
    for (first, second, count), end in zip(arrays["pairs"].tolist(), ends, strict=True):
        of = slice(end - count, end)
        seen = (
            sights_of(posed[one].lens, arrays["pixels"][of, columns])
            for one, columns in ((first, slice(0, 2)), (second, slice(2, 4)))
        )
        yield Matches(first, second, arrays["index"][of], *(sights for sights, _ in seen))


def _read(picture: RecordedPicture, lens: Camera, strict: bool) -> np.ndarray:
    """A picture; a broken one is black, and is reported when its turn comes."""
    rgb = read_if_whole(partial(read_image, picture.path), strict=strict)
    if rgb is None or rgb.shape[:2] != (lens.height, lens.width):
        return np.zeros((lens.height, lens.width, 3), np.uint8)
    return rgb


# ---- the bundle ------------------------------------------------------------------------------------------------


def _camera_poses(
    shots: Sequence[Shot], vehicle_to_world: Float64[np.ndarray, "frames 4 4"]
) -> Float64[np.ndarray, "pictures 4 4"]:
    return np.stack([vehicle_to_world[shot.frame] @ shot.to_vehicle for shot in shots])


def refine(
    pycolmap: object,
    shots: Sequence[Shot],
    matches: Sequence[Matches],
    given: Float64[np.ndarray, "frames 4 4"],
    reshoot: Callable[[Float64[np.ndarray, "frames 4 4"], Bool[np.ndarray, "frames"]], Sequence[Shot]] | None = None,
) -> Refinement:
    """Refine poses by matched features, and check both by those that take no part.

    Matches count `shots`; `given` is vehicle to world of each frame. `reshoot` makes the pictures on the rig of refined
    poses, and of which frames features moved: cameras that fire at other times than the frame's stand where the path
    has the vehicle then. None = they stay.
    """
    groups = features_joined(matches)
    is_check = [np.asarray(_is_check(numbers)) for numbers in groups]
    checks = [found.taken(chosen) for found, chosen in zip(matches, is_check, strict=True)]
    matches = [found.taken(~chosen) for found, chosen in zip(matches, is_check, strict=True)]
    focal_px = float(np.median([(shot.lens.fx + shot.lens.fy) / 2 for shot in shots]))
    refined, count, given_shots = given, 0, shots
    supported = np.zeros(len(given), bool)
    for limit_deg, least_px in zip(_ROUNDS_DEG, _ROUNDS_LEAST_PX, strict=True):
        limit_px = max(math.radians(limit_deg) * focal_px, least_px)
        tracks, points = _tracks(matches, _camera_poses(shots, refined), limit_px)
        of_frame = np.array([shot.frame for shot in shots])[tracks.picture]
        supported = np.bincount(of_frame, minlength=len(given)) >= _LEAST_SIGHTS
        count = len(points)
        if not supported.any():
            break
        refined = adjust_bundle(pycolmap, shots, tracks, points, refined, given, SOFTNESS)
        if reshoot is not None and supported.sum() > 1:
            shots = reshoot(refined, supported)
    before, after = _median_px(given_shots, checks, given), _median_px(shots, checks, refined)
    return Refinement(refined, supported, count, before[0], after[0], min(before[1], after[1]))


def _is_check(groups: Int[np.ndarray, "m"]) -> Bool[np.ndarray, "m"]:
    """Which matches take no part: all of one group, or none."""
    # a multiplication that scatters, so that neighbours do not go together
    return (groups * 2654435761) % (1 << 32) < (1 << 32) // _CHECK_SHARE


def _median_px(
    shots: Sequence[Shot], checks: Sequence[Matches], vehicle_to_world: Float64[np.ndarray, "frames 4 4"]
) -> tuple[float, int]:
    """Median distance of matched features to their epipolar curves, and of how many."""
    poses = _camera_poses(shots, vehicle_to_world)
    distances = [epipolar_distance_px(found, poses[found.first], poses[found.second]) for found in checks]
    known = np.concatenate([np.zeros(0), *distances])
    known = known[np.isfinite(known)]
    return (float(np.median(known)) if len(known) else 0.0), len(known)


def _tracks(
    matches: Sequence[Matches], camera_to_world: Float64[np.ndarray, "pictures 4 4"], limit_px: float
) -> tuple[Tracks, Float64[np.ndarray, "points 3"]]:
    """Tracks that agree with the poses, and where their points are."""
    near = []
    for found in matches:
        distances = epipolar_distance_px(found, camera_to_world[found.first], camera_to_world[found.second])
        # where there is no curve, the point's image decides
        near.append(found.taken(~(distances > limit_px)))
    tracks = join_matches(near)
    for _ in range(2):
        off_px = reprojection_px(tracks, triangulate(tracks, camera_to_world), camera_to_world)
        tracks = tracks.taken(off_px <= limit_px)
    tracks = spread(tracks, _MOST_SIGHTS)
    points = triangulate(tracks, camera_to_world)
    fine = np.isfinite(points).all(-1)
    return tracks.taken(fine[tracks.track]), points[fine]


# ---- the recording with its new path ---------------------------------------------------------------------------


def _moved(
    recording: Recording,
    times_s: Float64[np.ndarray, "frames"],
    frames: Sequence[int],
    given: Float64[np.ndarray, "frames 4 4"],
    refined: Float64[np.ndarray, "frames 4 4"],
    supported: Bool[np.ndarray, "frames"],
) -> tuple[Recording, Float64[np.ndarray, "frames 4 4"]]:
    """Move the path, and all that lies on it; also how each frame moved, in the vehicle's coordinates.

    A change passes evenly into that of the next frame; before the first frame and after the last it stays. A picture
    with a pose of its own moves with its frame.
    """
    trajectory = recording.trajectory
    assert trajectory is not None
    known_s = times_s[supported]
    changes = Trajectory(known_s, (np.linalg.inv(given) @ refined)[supported])

    def changed_at(at_s: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n 4 4"]:
        return changes.at(at_s.clip(known_s[0], known_s[-1]))

    # the frames' own poses stand in the path, too
    path_s = np.union1d(trajectory.times_s, times_s)
    path_s = path_s[np.concatenate([[True], np.diff(path_s) > 1e-6])]
    path = Trajectory(path_s, trajectory.at(path_s) @ changed_at(path_s))
    change = changed_at(times_s)
    to_new = {frame: new @ np.linalg.inv(old) for frame, old, new in zip(frames, given, given @ change, strict=True)}
    pictures = tuple(
        picture
        if picture.camera_to_world is None
        else dataclasses.replace(picture, camera_to_world=to_new[picture.frame] @ picture.camera_to_world)
        for picture in recording.pictures
    )
    shifted = tuple(
        dataclasses.replace(view, camera_to_world=to_new[view.frame] @ view.camera_to_world)
        for view in recording.shifted
        if view.frame in to_new
    )
    return dataclasses.replace(recording, trajectory=path, pictures=pictures, shifted=shifted), change
