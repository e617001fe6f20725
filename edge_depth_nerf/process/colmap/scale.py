"""From COLMAP's models to the vehicle's path in metres: scale from LiDAR, and models joined by the rig.

A model gives the vehicle's pose wherever one of its pictures is registered, because the rig defines where the cameras
sit on the vehicle. So models with common frames can be aligned, even if their cameras share no view. The unit of a
model is found where LiDAR sees the model's points: it is the median of LiDAR's distance over the model's, over all
features with LiDAR points right beside them.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float64
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.lidar import transform_points
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.lidar.world import sweep_in_world
from edge_depth_nerf.process.colmap.models import ColmapModel
from edge_depth_nerf.process.reading import read_depth, read_if_whole
from edge_depth_nerf.process.recording import RecordedPicture, RecordedSweep, Recording

MIN_PAIRS = 30
"""Fewer features than this with LiDAR beside them give no scale."""
MIN_COMMON_FRAMES = 3
"""Models with fewer frames in common are not joined."""

_WINDOW_PAIRS = 100
"""A window along the path is as long as it takes for so many features with LiDAR."""
_STEADY = 1.15
"""The scale is broken where windows differ by more than this factor, and what their spread explains."""
_DOUBTS = 3.0
"""So many standard errors of both windows are explained."""
_MOST_FRAMES = 40
"""LiDAR of at most so many frames, spread over the drive, is used."""
_WINDOW_RAD = math.radians(0.4)
"""LiDAR points this near to a feature's ray count; the rings of a 64-beam scanner are 0.42° apart."""
_AGREE = 0.03
"""LiDAR points in the window that differ by more than this share see an edge, or past it."""
_NEIGHBOURS = 8
_ROUNDS = 4
_SETTLED = 5e-4
"""The scale is refined, because points are de-skewed by the path in metres: so often, or until it changes by less."""


@dataclass(frozen=True)
class ScaleBreak:
    """Where a reconstruction changes its scale."""

    first: int
    """Number of the last frame before the place where it changes most."""
    last: int
    """Number of the first frame after it."""
    before: float
    """Metres per unit before it."""
    after: float
    """Metres per unit after it."""
    smallest: float
    """The smallest of all windows along the path."""
    largest: float
    """The largest."""


@dataclass(frozen=True)
class Scale:
    """How LiDAR's distances compare with a reconstruction's."""

    ratio: float
    """Median of LiDAR's distance over the reconstruction's."""
    spread: float
    """Half the interquartile range of the ratios, as a share of the median."""
    pairs: int
    """How many features had LiDAR beside them."""
    broken: ScaleBreak | None = None
    """Where it is not the same along the path."""


@dataclass(frozen=True)
class MetricPath:
    """The vehicle's path in metres, in the world of the first model."""

    vehicle_poses: dict[int, Transform]
    """Vehicle to world, by number of frame."""
    trajectory: Trajectory
    """The same over time."""
    members: tuple[ColmapModel, ...]
    """The models it was made of."""
    scales: tuple[float, ...]
    """Metres per unit of each of them."""
    disagreement_m: float
    """Median distance of where the cameras of one frame put the vehicle, from their mean; NaN for one camera."""


def frame_times(recording: Recording) -> dict[int, float]:
    """When each frame was taken: the median of its pictures' times."""
    times = defaultdict(list)
    for picture in recording.pictures:
        times[picture.frame].append(picture.time_s)
    return {frame: float(np.median(found)) for frame, found in sorted(times.items())}


def join_models(recording: Recording, models: Sequence[ColmapModel], scales: ArrayLike) -> MetricPath:
    """Lay the models over one another and average where they put the vehicle.

    The model with the most frames comes first. `scales` are metres per unit of each; those of joined models are made to
    agree with the first's.

    Raises:
        InputError: the first model has fewer than two frames.
    """
    times = frame_times(recording)
    scales = np.array(scales, np.float64)
    found = _vehicle_poses(recording, models[0], scales[0], times)
    members, waiting = [0], list(range(1, len(models)))
    while waiting:
        # the one with the most in common goes next
        common = {i: found.keys() & _vehicle_poses(recording, models[i], scales[i], times).keys() for i in waiting}
        best = max(waiting, key=lambda i: len(common[i]))
        if len(common[best]) < MIN_COMMON_FRAMES:
            break
        target = {frame: _mean_pose(found[frame]) for frame in sorted(common[best])}
        # the rig's lever arms are in metres whatever the scale, so the poses depend on it a little beyond a factor
        for _ in range(2):
            poses = _vehicle_poses(recording, models[best], scales[best], times)
            factor, alignment = _similarity({frame: _mean_pose(poses[frame]) for frame in target}, target)
            scales[best] *= factor
        poses = _vehicle_poses(recording, models[best], scales[best], times)
        _, alignment = _similarity({frame: _mean_pose(poses[frame]) for frame in target}, target, factor=1.0)
        for frame, several in poses.items():
            found.setdefault(frame, []).extend(alignment @ pose for pose in several)
        members.append(best)
        waiting.remove(best)
    frames = sorted(found)
    vehicle_poses = {frame: _mean_pose(found[frame]) for frame in frames}
    apart = [
        float(np.linalg.norm(pose[:3, 3] - vehicle_poses[frame][:3, 3]))
        for frame in frames
        for pose in found[frame]
        if len(found[frame]) > 1
    ]
    return MetricPath(
        vehicle_poses=vehicle_poses,
        trajectory=Trajectory(np.array([times[f] for f in frames]), np.stack([vehicle_poses[f] for f in frames])),
        members=tuple(models[i] for i in members),
        scales=tuple(float(scales[i]) for i in members),
        disagreement_m=float(np.median(apart)) if apart else math.nan,
    )


def _vehicle_poses(
    recording: Recording, model: ColmapModel, scale: float, times: Mapping[int, float]
) -> dict[int, list[Transform]]:
    """Where each camera of a model puts the vehicle at the frames it is registered at, in metres."""
    found = defaultdict(list)
    for camera in recording.cameras:
        indices = [i for i in model.camera_to_model if recording.pictures[i].camera == camera.name]
        indices.sort(key=lambda i: recording.pictures[i].time_s)
        if len(indices) < 2:
            continue
        poses = np.stack([model.camera_to_model[i] for i in indices])
        poses[:, :3, 3] *= scale
        path = Trajectory(
            np.array([recording.pictures[i].time_s for i in indices]), poses @ np.linalg.inv(camera.to_vehicle)
        )
        frames = [recording.pictures[i].frame for i in indices]
        for frame, pose in zip(frames, path.at(np.array([times[frame] for frame in frames])), strict=True):
            found[frame].append(pose)
    return dict(found)


def _mean_pose(poses: Sequence[Transform]) -> Transform:
    if len(poses) == 1:
        return poses[0]
    turn = Rotation.from_matrix([pose[:3, :3] for pose in poses]).mean().as_matrix()
    return rigid(turn, np.mean([pose[:3, 3] for pose in poses], axis=0))


def _similarity(
    moved: Mapping[int, Transform], target: Mapping[int, Transform], factor: float | None = None
) -> tuple[float, Transform]:
    """The factor (unless given) and the rigid transform that take some poses to others of the same frames.

    The turn is the mean of the poses' own, so that a straight path is no special case.
    """
    turn = Rotation.from_matrix([target[f][:3, :3] @ moved[f][:3, :3].T for f in target]).mean().as_matrix()
    source = np.stack([moved[f][:3, 3] for f in target]) @ turn.T
    goal = np.stack([target[f][:3, 3] for f in target])
    centred, centred_goal = source - source.mean(0), goal - goal.mean(0)
    extent = float((centred**2).sum())
    if factor is None:
        factor = float((centred * centred_goal).sum()) / extent if extent > 0 else 1.0
    return factor, rigid(turn, goal.mean(0) - factor * source.mean(0))


def metric_path(recording: Recording, models: Sequence[ColmapModel]) -> tuple[MetricPath, Scale]:
    """Find the scale from LiDAR, or from the depth maps instead, and the path in metres.

    Returns:
        The path; and the scale as metres per unit of the first model, with its spread.

    Raises:
        InputError: too few features have LiDAR beside them.
    """
    # as if each sweep were taken all at once, for a first scale of each model alone
    first = [_together(_ratios(recording, [model], [1.0], None)) for model in models]
    usable = [i for i, ratios in enumerate(first) if len(ratios) >= MIN_PAIRS]
    if not usable:
        raise _too_few(max(map(len, first), default=0), recording)
    path = join_models(recording, [models[i] for i in usable], [float(np.median(first[i])) for i in usable])
    along: dict[int, np.ndarray] = {}
    ratios, change = np.ones(0), 1.0
    for _ in range(_ROUNDS):
        along = _ratios(recording, path.members, path.scales, path.trajectory)
        ratios = _together(along)
        if len(ratios) < MIN_PAIRS:
            raise _too_few(len(ratios), recording)
        change = float(np.median(ratios))
        path = join_models(recording, path.members, change * np.array(path.scales))
        if abs(change - 1) < _SETTLED:
            break
    low, middle, high = np.percentile(ratios, (25, 50, 75))
    metres = path.scales[0] / change
    return path, Scale(
        path.scales[0],
        float((high - low) / (2 * middle)),
        len(ratios),
        find_scale_break({frame: metres * found for frame, found in along.items()}),
    )


def find_scale_break(along: Mapping[int, Float64[np.ndarray, "_"]]) -> ScaleBreak | None:
    """Find where LiDAR's distances over the reconstruction's, by number of frame in order, change along the path.

    Returns:
        Where it changes most, if it is nowhere near one scale; None if it is, or too few frames have LiDAR.
    """
    frames = [frame for frame, found in along.items() if len(found)]
    counts = np.cumsum([0] + [len(along[frame]) for frame in frames])
    ratios = np.concatenate([along[frame] for frame in frames]) if frames else np.ones(0)
    if counts[-1] < 2 * _WINDOW_PAIRS:
        return None
    changes = []
    for boundary in range(1, len(frames)):
        start = int(np.searchsorted(counts, counts[boundary] - _WINDOW_PAIRS, side="right")) - 1
        end = int(np.searchsorted(counts, counts[boundary] + _WINDOW_PAIRS))
        if start < 0 or end > len(frames):
            continue
        before, after = ratios[counts[start] : counts[boundary]], ratios[counts[boundary] : counts[end]]
        changes.append((start, boundary, end, _window(before), _window(after)))
    if not changes:
        return None
    windows = [window for change in changes for window in change[3:]]
    smallest, largest = min(windows), max(windows)
    if largest[0] / smallest[0] < _STEADY + _DOUBTS * (smallest[1] + largest[1]):
        return None
    start, boundary, end, before, after = max(changes, key=lambda change: abs(math.log(change[4][0] / change[3][0])))
    return ScaleBreak(frames[boundary - 1], frames[boundary], before[0], after[0], smallest[0], largest[0])


def _window(ratios: Float64[np.ndarray, "pairs"]) -> tuple[float, float]:
    """A window's scale, and the standard error of it as a share: that of a median, from the quartiles."""
    low, middle, high = np.percentile(ratios, (25, 50, 75))
    return float(middle), float(0.93 * (high - low) / middle / math.sqrt(len(ratios)))


def _together(along: Mapping[int, Float64[np.ndarray, "_"]]) -> Float64[np.ndarray, "pairs"]:
    return np.concatenate([np.ones(0), *along.values()])


def _too_few(pairs: int, recording: Recording) -> InputError:
    source = "a depth map's value" if not recording.sweeps else "a LiDAR point"
    return InputError(
        f"--poses colmap: only {pairs} of COLMAP's points have {source} next to them, expected {MIN_PAIRS} or more: "
        "the scale cannot be computed. Use more frames, or frames whose sweeps and pictures overlap, and "
        "check that the calibration of LiDAR and cameras belongs to this recording."
    )


def _ratios(
    recording: Recording, models: Sequence[ColmapModel], scales: Sequence[float], trajectory: Trajectory | None
) -> dict[int, Float64[np.ndarray, "_"]]:
    """LiDAR's distance over the models' scaled ones, by number of frame, for every feature with LiDAR points beside it.

    Sweeps are de-skewed by the vehicle's path in metres; None = as if each were taken at once, at the picture's time.
    """
    registered: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for number, model in enumerate(models):
        for index in model.views:
            registered[recording.pictures[index].frame].append((number, index))
    vehicle_poses = sorted(registered)
    frames = [vehicle_poses[index] for index in spread_over(len(vehicle_poses), _MOST_FRAMES)]
    sweeps: dict[int, list[RecordedSweep]] = defaultdict(list)
    for sweep in recording.sweeps:
        if sweep.frame is not None:
            sweeps[sweep.frame].append(sweep)
    along = {}
    for frame in frames:
        found = [np.ones(0)]
        scans = [scan for sweep in sweeps[frame] if (scan := _scan(sweep, trajectory)) is not None]
        for number, index in sorted(registered[frame]):
            picture = recording.pictures[index]
            points_m = _points_in_camera(recording, picture, scans, trajectory)
            view = models[number].views[index]
            lidar = _beside(view.rays, points_m)
            fine = np.isfinite(lidar)
            found.append(lidar[fine] / (scales[number] * view.distance[fine]))
        along[frame] = np.concatenate(found)
    return along


def _scan(sweep: RecordedSweep, trajectory: Trajectory | None) -> Float64[np.ndarray, "points 3"] | None:
    """A sweep's points in the world, each by the vehicle's pose at its time; without a path, in the vehicle's frame.

    None for one that cannot be read.
    """
    read = read_if_whole(sweep.read)
    if read is None:
        return None
    if trajectory is None:
        return transform_points(torch.from_numpy(sweep.to_vehicle), read.points_m).numpy()
    return sweep_in_world(read, sweep.time_s, sweep.to_vehicle, trajectory, sweep.timing).points_m.numpy()


def _points_in_camera(
    recording: Recording,
    picture: RecordedPicture,
    scans: Sequence[Float64[np.ndarray, "_ 3"]],
    trajectory: Trajectory | None,
) -> Float64[np.ndarray, "points 3"]:
    camera = next(camera for camera in recording.cameras if camera.name == picture.camera)
    if not scans:
        return _depth_points(picture, camera.camera)
    to_camera = np.linalg.inv(camera.to_vehicle)
    if trajectory is not None:
        to_camera = to_camera @ np.linalg.inv(trajectory.at(np.array([picture.time_s]))[0])
    return np.concatenate(scans) @ to_camera[:3, :3].T + to_camera[:3, 3]


def _depth_points(picture: RecordedPicture, camera: Camera) -> Float64[np.ndarray, "values 3"]:
    """The points of a depth map in the camera's frame."""
    distance = read_if_whole(partial(read_depth, picture.depth, camera)) if picture.depth else None
    if distance is None:
        return np.zeros((0, 3))
    of_pixels = rays(camera)
    return (of_pixels.directions * distance.astype(np.float64)[..., None])[of_pixels.within & (distance > 0)]


def _beside(
    rays: Float64[np.ndarray, "features 3"], points_m: Float64[np.ndarray, "points 3"]
) -> Float64[np.ndarray, "features"]:
    """LiDAR's distance along some rays, from the LiDAR points beside each; NaN where there are none that agree."""
    distance = np.linalg.norm(points_m, axis=-1)
    away = distance > 0
    points_m, distance = points_m[away], distance[away]
    if len(points_m) < 2 or not len(rays):
        return np.full(len(rays), np.nan)
    # the tree is asked a few hundred times, so it pays to build it fast
    tree = KDTree(points_m / distance[:, None], compact_nodes=False, balanced_tree=False)
    apart, index = tree.query(rays, _NEIGHBOURS, distance_upper_bound=_WINDOW_RAD)
    near = np.isfinite(apart)
    values = np.where(near, distance[np.where(near, index, 0)], np.nan)
    with np.errstate(invalid="ignore"):
        weight = np.where(near, 1 / (apart + 0.1 * _WINDOW_RAD), 0.0)
    mean = np.where(near, weight * values, 0).sum(-1) / np.maximum(weight.sum(-1), 1e-12)
    low, high = np.where(near, values, np.inf).min(-1), np.where(near, values, -np.inf).max(-1)
    return np.where((near.sum(-1) >= 2) & (high - low <= _AGREE * low), mean, np.nan)
