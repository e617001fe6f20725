"""Other ways to read a recording: axes, units, angles, clocks, orders. Each changes one thing and says what to do."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.lidar.trajectory import Trajectory

CLEAR, CLEAR_SMALL = 0.35, 0.2
"""A reading is named from this gain on; angles and times, which change the figures less, from the second on."""
OFF = 1.15
"""A ratio further from 1 than this is reported."""

Change = Callable[[Transform], Transform]


def _same(transform: Transform) -> Transform:
    return transform


@dataclass(frozen=True)
class Reading:
    """Another way to read the recording; the defaults change nothing."""

    said: str = ""
    """What is wrong if it fits, and what to do; {name} stands for the sensor."""
    scanner: Change = _same
    """Another transform from scanner to vehicle for the given one; it may mirror and scale."""
    camera: Change = _same
    """Another one from camera to vehicle."""
    path: Callable[[Trajectory], Trajectory] | None = None
    """Another path for the given one."""
    scans_later_s: float = 0.0
    pictures_later_s: float = 0.0
    point_times: Callable[[np.ndarray], np.ndarray] | None = None
    """Other times of a sweep's points for the given ones, counted from the sweep's own."""
    to_distance: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    """Of depth maps: distances for the given ones, and for the cosines of their rays."""
    scales: bool = False
    """Whether it changes lengths: sweeps that are smaller are less apart, which says nothing."""
    clear: float = CLEAR
    """The gain that it needs."""
    both: bool = False
    """Whether it must fit edges and contrasts, each for itself: a small turn of a camera may fit contrasts alone, in a
    good recording of a car park by 0.6."""
    finer: Callable[[float], Reading] | None = None
    """The same by another amount, where it has one."""
    amount: float = 0.0
    """Of that kind."""
    step: float = 0.0
    """How far from the true amount it may be."""

    @property
    def keeps_scans(self) -> bool:
        """Whether LiDAR's points are in the world where they were as given."""
        timed = self.scans_later_s or self.point_times is not None
        return self.scanner is _same and self.path is None and not timed


def _turned(axis: str, degrees: float) -> Transform:
    return rigid(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())


def _after(change: Transform) -> Change:
    return lambda given: given @ change


def _axes() -> list[tuple[Transform, str]]:
    """All changes of axes, mirrored ones included, and what the given ones are in truth."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            change = rigid(np.eye(3)[list(order)] * np.array(signs)[:, None])
            if not np.array_equal(change, np.eye(4)):
                found.append((change, _axes_said(change[:3, :3])))
    return found


def _axes_said(change: Float64[np.ndarray, "3 3"]) -> str:
    if np.linalg.det(change) < 0:
        return _named(change)
    turn = Rotation.from_matrix(change).as_rotvec(degrees=True)
    axis = int(np.abs(turn).argmax())
    alone = np.abs(turn).sum() < abs(turn[axis]) + 1e-6
    return f"turned by {turn[axis]:.0f}° about its {'xyz'[axis]} axis" if alone else _named(change)


def _named(change: Float64[np.ndarray, "3 3"]) -> str:
    axes = ["xyz"[int(np.abs(row).argmax())] for row in change]
    signs = ["-" if row.sum() < 0 else "" for row in change]
    return f"given in other axes, where ({', '.join(s + a for s, a in zip(signs, axes, strict=True))}) is x, y, z"


UNITS = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "yards": 0.9144}
"""Metres per unit."""
_FACTORS = [0.15 * step for step in range(-20, 21) if step]
"""Logarithms of factors on lengths, a twentieth to twenty."""
_FINER = 0.075
_SAME_UNIT = 0.05
"""A unit is the one that is known if their logarithms differ by less."""
_CLOCKS_S = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
_ANGLES_DEG = (2.0, 5.0)
_OFFSETS_M = (0.5,)
_YAWS_DEG = (-150.0, -120.0, -60.0, -30.0, 30.0, 60.0, 120.0, 150.0)
"""About the upright axis; by quarters it is turned with the axes."""


def _mounting(sensor: str, said: str, change: Change) -> Reading:
    """Another transform from a "scanner" or a "camera" to the vehicle."""
    return Reading(said, scanner=change) if sensor == "scanner" else Reading(said, camera=change)


def turn(sensor: str, axis: str) -> Callable[[float], Reading]:
    """Make readings that turn a "scanner" or a "camera" about an axis of its own, by degrees."""

    def by(degrees: float) -> Reading:
        said = f"{{name}} is turned by {degrees:.1f}° about its {axis} axis"
        return replace(_mounting(sensor, said, _after(_turned(axis, degrees))), finer=by, amount=degrees)

    return by


def shift(sensor: str, axis: str) -> Callable[[float], Reading]:
    """Make readings that move a "scanner" or a "camera" along an axis of its own, by metres."""

    def by(metres: float) -> Reading:
        moved = np.eye(4)
        moved["xyz".index(axis), 3] = metres
        said = f"{{name}} sits {metres:.2f} m further along its {axis} axis"
        return replace(_mounting(sensor, said, _after(moved)), finer=by, amount=metres)

    return by


def _later(sensor: str) -> Callable[[float], Reading]:
    def by(seconds: float) -> Reading:
        said = f"the clock of {{name}} is apart from the others: add {seconds:.2f} to its time_offset_s"
        if sensor == "scanner":
            return Reading(said, scans_later_s=seconds, finer=by, amount=seconds)
        return Reading(said, pictures_later_s=seconds, finer=by, amount=seconds)

    return by


def small(sensor: str) -> list[Reading]:
    """Angles, offsets, and shifts of the clock."""
    amounts = [(turn(sensor, axis), _ANGLES_DEG) for axis in "xyz"] + [(_later(sensor), _CLOCKS_S)]
    amounts += [(shift(sensor, axis), _OFFSETS_M) for axis in "xyz"]
    found = []
    for by, sizes in amounts:
        for size in sizes:
            found += [replace(by(amount), step=size / 2, clear=CLEAR_SMALL, both=True) for amount in (size, -size)]
    return found


def mountings(sensor: str) -> list[Reading]:
    """Large faults of a transform to the vehicle."""
    found = [_mounting(sensor, "to_vehicle of {name} is inverted: give its inverse", np.linalg.inv)]
    for change, said in _axes():
        if sensor == "scanner" or np.linalg.det(change[:3, :3]) > 0:
            remedy = "change its to_vehicle, or its points" if sensor == "scanner" else "change its to_vehicle"
            found.append(_mounting(sensor, f"{{name}} is {said}: {remedy}", _after(change)))
    found += [replace(turn(sensor, "z" if sensor == "scanner" else "y")(angle), step=15.0) for angle in _YAWS_DEG]
    for unit, metres in UNITS.items():
        said = f"the translation in to_vehicle of {{name}} is in {unit}: give metres"
        found.append(_mounting(sensor, said, lambda given, m=metres: rigid(given[:3, :3], given[:3, 3] * m)))
    return found


def _in_unit(logarithm: float) -> Reading:
    """The points' coordinates in a unit of so many metres."""
    metres = math.exp(logarithm)
    near = min(UNITS.items(), key=lambda item: abs(math.log(metres / item[1])))
    known = abs(math.log(metres / near[1])) < _SAME_UNIT
    asked = f"are the points of {{name}} in {near[0]}? " if known else "is their unit not the metre? "
    metres = near[1] if known else metres
    said = f"LiDAR's distances are {1 / metres:.3g} times what the pictures show: {asked}metres_per_unit = {metres:.4g}"
    scaled = np.diag([metres, metres, metres, 1.0])
    return Reading(said, scanner=_after(scaled), scales=True, finer=_in_unit, amount=logarithm, step=_FINER)


def _longer(logarithm: float) -> Reading:
    """Depth maps whose distances are to be longer by a factor."""
    factor = math.exp(logarithm)
    said = (
        f"the depth maps of {{name}} show {1 / factor:.3g} times what the pictures show: multiply metres_per_count by "
        f"{factor:.3g}"
    )
    return Reading(said, to_distance=lambda far, _: far * factor, finer=_longer, amount=logarithm, step=_FINER)


def of_scans() -> list[Reading]:
    """Other units of the points."""
    return [_in_unit(logarithm) for logarithm in _FACTORS]


def of_maps() -> list[Reading]:
    """Other kinds and units of depth maps."""
    return [
        Reading(
            "the depth maps of {name} hold z_depth: set kind", to_distance=lambda far, cosine: far / cosine.clip(0.05)
        ),
        Reading(
            "the depth maps of {name} hold distance: set kind", to_distance=lambda far, cosine: far * cosine.clip(0.05)
        ),
        *(_longer(logarithm) for logarithm in _FACTORS),
    ]


def of_sensors(mountings: Iterable[tuple[str, Transform]]) -> list[Reading]:
    """The poses as those of a camera or a scanner; names of these, and their transforms to the vehicle."""

    def as_of(to_vehicle: Transform) -> Callable[[Trajectory], Trajectory]:
        return lambda path: Trajectory(path.times_s, path.vehicle_to_world @ np.linalg.inv(to_vehicle))

    return [Reading(f'the poses are those of {name}: poses.of = "{name}"', path=as_of(to)) for name, to in mountings]


def of_path() -> list[Reading]:
    """Other readings of the poses."""

    def changed(said: str, change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Reading:
        """`change` takes rotations and positions."""

        def read(path: Trajectory) -> Trajectory:
            poses = path.vehicle_to_world
            return Trajectory(path.times_s, change(poses[:, :3, :3], poses[:, :3, 3]))

        return Reading(said, path=read)

    def other_order(turns: np.ndarray) -> np.ndarray:
        return Rotation.from_quat(Rotation.from_matrix(turns).as_quat()[:, [1, 2, 3, 0]]).as_matrix()

    axes = [(said, change[:3, :3]) for change, said in _axes()]
    units = [(f"in {unit}: metres_per_unit = {metres:g}", np.diag([metres] * 3)) for unit, metres in UNITS.items()]
    return [
        changed("the poses' quaternions begin with w: write qx qy qz qw", lambda t, p: rigid(other_order(t), p)),
        changed("the poses are world to vehicle: give their inverses", lambda t, p: np.linalg.inv(rigid(t, p))),
        changed("the poses' rotations are world to vehicle: transpose them", lambda t, p: rigid(t.swapaxes(1, 2), p)),
        *(
            changed(f"the poses' positions are {said}", lambda t, p, change=change: rigid(t, p @ change.T))
            for said, change in (*axes, *units)
        ),
    ]
