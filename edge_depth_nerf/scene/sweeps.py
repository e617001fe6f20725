"""The scanners' own rays in a scene: one file a sweep, `sweeps/SCANNER/0000000123.npz`, listed in transforms.json.

A ray is where the scanner was when it measured, the direction, and how far it measured; nothing is moved to a picture's
viewpoint, hidden or rounded. Lengths are metres in the scene's world. A sweep's number is its place among the scanner's
sweeps, in order of time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int16

from edge_depth_nerf.base.bounds import path_inside, shown
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_npz, write_atomically
from edge_depth_nerf.cameras.transforms import Transform, check_rigid
from edge_depth_nerf.lidar.sweeps import MAX_POINTS, SweepTiming
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.scene.format import number_of, pose_of

SCANNERS = "scanners"
"""Key of transforms.json: sweeps by the names of their scanners."""
UNKNOWN_RING = -1
_FORMS = {"f": np.float32, "i": np.int16}


@dataclass(frozen=True, eq=False)
class SweepRays:
    """The measurements of one sweep, in the order of its file; those that gave no usable point are not among them."""

    origin_m: Float32[np.ndarray, "rays 3"]
    """Where the scanner was, in the scene."""
    direction: Float32[np.ndarray, "rays 3"]
    """Unit vectors, in the scene."""
    distance_m: Float32[np.ndarray, "rays"]
    offset_s: Float32[np.ndarray, "rays"]
    """When, counted from the sweep's own time."""
    intensity: Float32[np.ndarray, "rays"]
    """As recorded; 0 where the scanner gives none."""
    ring: Int16[np.ndarray, "rays"]
    """From the scanner's highest, 0, to its lowest, in each sweep alike; -1 where rings cannot be told apart."""
    of_beam: Int16[np.ndarray, "rays"]
    """1: of a beam that is held out of everything (`--holdout-beams`)."""

    @property
    def held_out(self) -> Bool[np.ndarray, "rays"]:
        """Which rays are held out although their sweep is for training."""
        return self.of_beam > 0

    @property
    def points_m(self) -> Float64[np.ndarray, "rays 3"]:
        """What was measured, in the scene."""
        return self.origin_m.astype(np.float64) + self.direction.astype(np.float64) * self.distance_m[:, None]


@dataclass(frozen=True, eq=False)
class SceneSweep:
    """A sweep of a scene."""

    path: Path
    scanner: str
    frame: int | None
    """Number of the frame it belongs to; None: between the scene's frames."""
    time_s: float
    """Its own time, on the clock of the recording."""
    held_out: bool
    """Whether it is kept from training."""
    scanner_to_scene: Transform
    """At its own time. The scanner's axes: x forward, y left, z up, as recorded."""

    def entry(self, folder: Path) -> dict[str, Any]:
        """Describe it for transforms.json, in a scene's folder."""
        return {
            "file_path": str(self.path.relative_to(folder)),
            "frame": self.frame,
            "timestamp_s": self.time_s,
            "held_out": self.held_out,
            "transform_matrix": self.scanner_to_scene.tolist(),
        }

    def read(self) -> SweepRays:
        """Read its rays.

        Raises:
            FileNotFoundError: there is no such file.
            InputError: the file is broken.
        """
        names = [entry.name for entry in fields(SweepRays)]
        found = read_npz(self.path, names, MAX_POINTS * 12)
        count = len(found["distance_m"])
        for name, array in found.items():
            shape = (count, 3) if name in ("origin_m", "direction") else (count,)
            if array.shape != shape or array.dtype != _FORMS["i" if name in ("ring", "of_beam") else "f"]:
                raise InputError(
                    f"{self.path}: {name} is {array.dtype} of shape {array.shape}, expected one number a ray. Delete "
                    "the file and process the drive again."
                )
            if not np.isfinite(array).all():
                raise InputError(f"{self.path}: {name} is not finite. Delete the file and process the drive again.")
        return SweepRays(**found)


@dataclass(frozen=True, eq=False)
class SceneScanner:
    """A scanner of a scene, with its sweeps in order of time."""

    name: str
    sweeps: tuple[SceneSweep, ...]
    timing: SweepTiming | None
    """When each azimuth is measured; None: the recording does not say."""

    @property
    def trajectory(self) -> Trajectory:
        """Where the scanner was, from its sweeps' poses; at least two are needed."""
        times_s = np.array([sweep.time_s for sweep in self.sweeps])
        return Trajectory(times_s, np.stack([sweep.scanner_to_scene for sweep in self.sweeps]))

    def entry(self, folder: Path) -> dict[str, Any]:
        """Describe it for transforms.json, in a scene's folder."""
        timing = None if self.timing is None else asdict(self.timing)
        return {"timing": timing, "sweeps": [sweep.entry(folder) for sweep in self.sweeps]}


def write_rays(path: Path, rays: SweepRays) -> None:
    """Write a sweep's rays, compressed, atomically."""
    arrays = {entry.name: getattr(rays, entry.name) for entry in fields(SweepRays)}
    write_atomically(path, lambda temporary: np.savez_compressed(temporary, **arrays))


def scanners_of(meta: Mapping[str, Any], path: Path) -> dict[str, SceneScanner]:
    """Give the scanners that a transforms.json names; none where it was written without.

    Args:
        meta: its content.
        path: of the file.

    Raises:
        InputError: an entry is broken.
    """
    given = meta.get(SCANNERS, {})
    if not isinstance(given, dict):
        raise InputError(f"{path}: {SCANNERS} is {shown(given)}, expected names. Process the drive again.")
    found = {}
    for name, entry in given.items():
        where = f"{path}: {SCANNERS}.{name}"
        sweeps = entry.get("sweeps") if isinstance(entry, dict) else None
        if not isinstance(sweeps, list) or not all(isinstance(sweep, dict) for sweep in sweeps):
            raise InputError(f"{where} has no list of sweeps. Process the drive again.")
        found[name] = SceneScanner(
            name,
            tuple(_sweep(sweep, name, path, f"{where}, sweep {number}") for number, sweep in enumerate(sweeps)),
            _timing(entry.get("timing"), where),
        )
        if not (np.diff([sweep.time_s for sweep in found[name].sweeps]) > 0).all():
            raise InputError(f"{where}: the times of its sweeps do not increase. Process the drive again.")
    return found


def _sweep(entry: Mapping[str, Any], scanner: str, path: Path, where: str) -> SceneSweep:
    frame = entry.get("frame")
    pose = pose_of(entry, where)
    check_rigid(pose, where)
    return SceneSweep(
        path=path_inside(path.parent, entry.get("file_path"), f"{where}: file_path"),
        scanner=scanner,
        frame=frame if isinstance(frame, int) else None,
        time_s=number_of(entry.get("timestamp_s"), f"{where}: timestamp_s"),
        held_out=entry.get("held_out") is True,
        scanner_to_scene=pose,
    )


def _timing(entry: object, where: str) -> SweepTiming | None:
    if not isinstance(entry, dict):
        return None
    turn_s, reference = (number_of(entry.get(key), f"{where}: {key}") for key in ("turn_s", "reference_azimuth_rad"))
    return SweepTiming(turn_s, entry.get("clockwise") is True, reference)
