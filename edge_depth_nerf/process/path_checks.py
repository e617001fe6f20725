"""Whether given poses are those of a vehicle: units, speed, what is up, and the order of their numbers.

A vehicle goes where it points: the directions in which it moves, in its own frame, lie on one axis. The *course* is
the share of them that does: the largest eigenvalue of their mean outer product, 1 at best, 1/3 for any directions. On
rendered and real drives it is 0.98 and more; a quaternion read in another order, or a mirrored axis, gives 0.5 to 0.8
in a bend. Straight on it says nothing, but the cameras' upward axes do: upright, they lie within 30° of the world's.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Float64

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.poses.breaks import find_break
from edge_depth_nerf.process.readings import UNITS, Reading, of_path
from edge_depth_nerf.process.recording import RecordedPicture, Recording

_FARTHEST_M = 50.0
"""No sensor sits so far from its vehicle's frame."""
_FASTEST_M_S = 100.0
"""No road vehicle is faster."""
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


def path_warnings(recording: Recording) -> list[str]:
    """Say what of the given poses and mountings no vehicle has, with the likely cause."""
    assert recording.trajectory is not None
    mountings = [(camera.name, camera.to_vehicle) for camera in recording.cameras]
    mountings += {sweep.scanner: sweep.to_vehicle for sweep in recording.sweeps}.items()
    found = []
    for name, to_vehicle in mountings:
        far_m = float(np.linalg.norm(to_vehicle[:3, 3]))
        if far_m > _FARTHEST_M:
            likely = f" Are they millimetres? {far_m / 1000:.2f} m would fit." if far_m / 1000 < _FARTHEST_M else ""
            found.append(
                f"{name} is {far_m:.0f} m from the vehicle's frame by its to_vehicle; expected metres.{likely}"
            )
    path = _looked_at(recording)
    places = path.vehicle_to_world[:, :3, 3]
    speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) / np.diff(path.times_s)
    reach_m = float(np.linalg.norm(places - places[0], axis=-1).max())
    if np.median(speed) > _FASTEST_M_S:
        return [*found, _too_fast(float(np.median(speed)))]
    if reach_m < _STANDS_M:
        return [*found, _stands(recording, path, reach_m)]
    return found + (_misread(recording, path) or _broken(path))


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


def _too_fast(speed: float) -> str:
    fit = [unit for unit, metres in UNITS.items() if 1 <= speed * metres <= _FASTEST_M_S / 2]
    likely = "check metres_per_unit and the times"
    if fit:
        likely = f"are they in {fit[0]}? metres_per_unit = {UNITS[fit[0]]:g}"
    return f"By the poses the vehicle drives at {speed:.0f} m/s (median), faster than any: {likely}."


def _stands(recording: Recording, path: Trajectory, reach_m: float) -> str:
    said = f"By the poses the vehicle never moves: it stays within {reach_m:.3f} m of its start"
    camera = recording.cameras[0].name
    pictures = [picture for picture in recording.pictures if picture.camera == camera]
    if _alike(pictures[0], pictures[len(pictures) // 2]):
        return f"{said}. Pictures from one place give no distances; use frames of a stretch where it drives."
    x, y = np.abs(path.vehicle_to_world[0, :2, 3])
    degrees = reach_m > 0 and max(x, y) > 0.01 and x <= 180 and y <= 180
    likely = "Are the positions degrees of longitude and latitude? Give metres" if degrees else "Check their file"
    return f"{said}, but the pictures change. {likely}, or compute the poses: --poses lidar, --poses colmap."


def _alike(first: RecordedPicture, second: RecordedPicture) -> bool:
    """Whether two pictures show the same at the same place."""
    grey = [cv2.cvtColor(read_image(one.path), cv2.COLOR_RGB2GRAY).astype(np.float32) for one in (first, second)]
    small = [cv2.resize(one, (64, 64), interpolation=cv2.INTER_AREA) for one in grey]
    fine = [one - cv2.GaussianBlur(one, (0, 0), 4.0) for one in small]
    return bool(np.corrcoef(fine[0].ravel(), fine[1].ravel())[0, 1] > _ALIKE)


def _misread(recording: Recording, path: Trajectory) -> list[str]:
    """Whether the vehicle is upright and goes where it points; which reading of the poses makes it so."""
    course, upright = _course(path), _upright(recording, path)
    if course >= _LEAST_COURSE and upright >= _LEAST_UPRIGHT:
        return []
    fits: list[tuple[float, Reading]] = []
    for reading in of_path():
        assert reading.path is not None
        other = reading.path(path)
        measured = _course(other), _upright(recording, other)
        if measured[0] >= max(_GOOD_COURSE, course - 0.01) and measured[1] >= _GOOD_UPRIGHT:
            fits.append((sum(measured), reading))
    best = max(fits, key=lambda one: round(one[0], 2), default=None)
    faults = [f"only {course:.0%} of its motion is along one axis of its own frame"] if course < _LEAST_COURSE else []
    if upright < _LEAST_UPRIGHT:
        faults.append(f"its sensors' upward axes are {math.degrees(math.acos(np.clip(upright, -1, 1))):.0f}° from z")
    remedy = (
        f"That is right if {best[1].said}."
        if best
        else "Check the order of the quaternions (x y z w), poses.up, poses.of and the axes."
    )
    return [f"By the poses the vehicle does not move like one: {' and '.join(faults)}. {remedy}"]


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
