"""Whether given poses are those of a vehicle: units, speed, what is up, and the order of their numbers.

A vehicle goes where it points: the directions in which it moves, in its own frame, lie on one axis. The *course* is
the share of them that does: the largest eigenvalue of their mean outer product, 1 at best, 1/3 for any directions. On
rendered and real drives it is 0.98 and more; a quaternion read in another order, or a mirrored axis, gives 0.5 to 0.8
in a bend. Straight on it says nothing, but the cameras' upward axes do: upright, they lie within 30° of the world's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.readings import of_path, of_sensors
from edge_depth_nerf.process.recording import RecordedPicture, Recording

_FARTHEST_M = 50.0
"""No sensor sits so far from its vehicle's frame."""
_SLOWEST_M_S, _FASTEST_M_S = 0.3, 100.0
"""No road vehicle is faster; slower than the first, and faster than half of the second, no reading is likely."""
_STANDS_M = 0.5
"""A vehicle that stays within so much of where it begins does not drive."""
_ALIKE = 0.6
"""Pictures of one place have contrasts that correlate by more."""
_STEP_M = 0.5
"""Directions are taken over steps of so much."""
_LEAST_COURSE, _LEAST_UPRIGHT = 0.85, 0.5
"""Below, something is wrong; the second is the cosine of the angle between the world's and the sensors' upward axes."""
_GOOD_COURSE, _GOOD_UPRIGHT = 0.95, 0.8
"""From here on another reading fits."""
_LOOKED_AT = 2000
"""Of longer paths, so many poses."""


def path_warnings(recording: Recording, usable: Mapping[str, Bool[np.ndarray, "h w"]]) -> tuple[list[str], bool]:
    """Say what of the given poses and mountings no vehicle has, with the likely cause.

    Args:
        recording: with the vehicle's path.
        usable: of each camera at its pictures' size, True within the lens.

    Returns:
        Sentences, and whether lengths are so wrong that nothing else can be told.
    """
    assert recording.trajectory is not None
    found = []
    for name, to_vehicle in _mountings(recording):
        far_m = float(np.linalg.norm(to_vehicle[:3, 3]))
        if far_m > _FARTHEST_M:
            likely = f" Are they millimetres? {far_m / 1000:.2f} m would fit." if far_m / 1000 < _FARTHEST_M else ""
            found.append(f"to_vehicle of {name} puts it {far_m:.0f} m from the vehicle; expected metres.{likely}")
    path = _looked_at(recording)
    places = path.vehicle_to_world[:, :3, 3]
    reach_m = float(np.linalg.norm(places - places[0], axis=-1).max())
    # a drive of a few frames may be short, and yet moves
    if reach_m < min(_STANDS_M, _SLOWEST_M_S * float(path.times_s[-1] - path.times_s[0])):
        return [*found, _stands(recording, path, reach_m, usable)], True
    misread = _misread(recording, path)
    return [*found, *(misread or _broken(path))], bool(found) or _speed(path) > _FASTEST_M_S


def _mountings(recording: Recording) -> list[tuple[str, Transform]]:
    """The scanners and the cameras, with their transforms to the vehicle."""
    scanners = {sweep.scanner: sweep.to_vehicle for sweep in recording.sweeps}
    return [*scanners.items(), *((camera.name, camera.to_vehicle) for camera in recording.cameras)]


def _speed(path: Trajectory) -> float:
    """The median."""
    shifts = np.linalg.norm(np.diff(path.vehicle_to_world[:, :3, 3], axis=0), axis=-1)
    return float(np.median(shifts / np.diff(path.times_s)))


def _looked_at(recording: Recording) -> Trajectory:
    """The path while pictures are taken."""
    path = recording.trajectory
    assert path is not None
    taken = np.array([picture.time_s for picture in recording.pictures])
    within = np.flatnonzero((path.times_s >= taken.min() - 0.5) & (path.times_s <= taken.max() + 0.5))
    if len(within) < 2:
        return path
    index = within[spread_over(len(within), _LOOKED_AT)]
    return Trajectory(path.times_s[index], path.vehicle_to_world[index])


def _stands(
    recording: Recording, path: Trajectory, reach_m: float, usable: Mapping[str, Bool[np.ndarray, "h w"]]
) -> str:
    said = f"By the poses the vehicle never moves: it stays within {reach_m:.3f} m of its start"
    camera = recording.cameras[0].name
    pictures = [picture for picture in recording.pictures if picture.camera == camera]
    if _alike(pictures[0], pictures[len(pictures) // 2], usable[camera]):
        return f"{said}. Pictures from one place give no distances; use frames of a stretch where it drives."
    x, y = np.abs(path.vehicle_to_world[0, :2, 3])
    degrees = reach_m > 0 and max(x, y) > 0.01 and x <= 180 and y <= 180
    likely = "Are the positions degrees of longitude and latitude? Give metres" if degrees else "Check their file"
    return f"{said}, but the pictures change. {likely}, or compute the poses: --poses lidar, --poses colmap."


def _alike(first: RecordedPicture, second: RecordedPicture, usable: Bool[np.ndarray, "h w"]) -> bool:
    """Whether two pictures show the same at the same place."""
    read = [read_if_whole(partial(read_image, one.path)) for one in (first, second)]
    if read[0] is None or read[1] is None:
        return False
    grey = [cv2.cvtColor(one, cv2.COLOR_RGB2GRAY).astype(np.float32) for one in (read[0], read[1])]
    small = [cv2.resize(one, (96, 96), interpolation=cv2.INTER_AREA) for one in grey]
    inner = cv2.resize(usable.astype(np.uint8), (96, 96), interpolation=cv2.INTER_NEAREST)
    inner = cv2.erode(inner, np.ones((9, 9))) > 0
    fine = [(one - cv2.GaussianBlur(one, (0, 0), 3.0))[inner] for one in small]
    return bool(np.corrcoef(fine[0], fine[1])[0, 1] > _ALIKE)


def _misread(recording: Recording, path: Trajectory) -> list[str]:
    """Whether the vehicle is upright, and drives where it points, not too fast; else which reading makes it so."""
    course, upright, speed = _course(path), _upright(recording, path), _speed(path)
    faults = [f"drives at {speed:.0f} m/s (median)"] if speed > _FASTEST_M_S else []
    faults += [f"moves along one axis of its own frame for {course:.0%} only"] if course < _LEAST_COURSE else []
    if upright < _LEAST_UPRIGHT:
        degrees = math.degrees(math.acos(np.clip(upright, -1, 1)))
        faults.append(f"lies on its side or its roof: its sensors' upward axes are {degrees:.0f}° from z")
    if not faults:
        return []
    fits = []
    for reading in (*of_sensors(_mountings(recording)), *of_path()):
        assert reading.path is not None
        other = reading.path(path)
        plausible = _SLOWEST_M_S <= _speed(other) <= _FASTEST_M_S / 2 and _course(other) >= _GOOD_COURSE
        if plausible and _upright(recording, other) >= _GOOD_UPRIGHT:
            fits.append(reading.said)
    remedy = "Check the order of the quaternions (x y z w), poses.up, poses.of, and the units."
    if fits:
        remedy = f"It does not if {', or if '.join(fits[:3])}."
    return [f"By the poses the vehicle {' and '.join(faults)}. {remedy}"]


def _course(path: Trajectory) -> float:
    """The share of the vehicle's motion that is along one axis of its frame; 1 if it does not get far."""
    places, steps, last = path.vehicle_to_world[:, :3, 3], [], 0
    for index in range(1, len(places)):
        shift = places[index] - places[last]
        if np.linalg.norm(shift) >= _STEP_M:
            steps.append(path.vehicle_to_world[(last + index) // 2, :3, :3].T @ shift / np.linalg.norm(shift))
            last = index
    return float(np.linalg.eigvalsh(np.mean([np.outer(step, step) for step in steps], 0))[-1]) if steps else 1.0


def _upright(recording: Recording, path: Trajectory) -> float:
    """Cosine of the angle between the world's z and the cameras' or the scanners' upward axes, whichever is less."""
    cameras = -np.sum([camera.to_vehicle[:3, 1] for camera in recording.cameras], axis=0)
    scanners = [sweep.to_vehicle[:3, 2] for sweep in recording.sweeps[:1]]
    return max(_mean_cosine(path, up) for up in (cameras, *scanners))


def _mean_cosine(path: Trajectory, up: Float64[np.ndarray, "3"]) -> float:
    length = float(np.linalg.norm(up))
    return float((path.vehicle_to_world[:, 2, :3] @ up).mean() / length) if length > 0.3 else 1.0


def _broken(path: Trajectory) -> list[str]:
    found = find_break(path)
    if found is None:
        return []
    first, last = path.times_s[[found.first, found.last]]
    return [
        f"The given path breaks between {first:.2f} and {last:.2f} s: {found.what}. Leave out the wrong poses or these "
        "frames, check the poses' times, or compute the path: --poses lidar, --poses colmap."
    ]
