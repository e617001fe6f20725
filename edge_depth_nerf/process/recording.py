"""A recorded drive as every converter hands it on: sensors, pictures, sweeps, the vehicle's path.

Each converter (kitti360, jbnu_depth360, rig) reads its own layout into a `Recording`, checking every file by size and
header; `build.process_recording` makes the scene folder of it. Frames: camera (x right, y down, z forward), scanner and
vehicle as the recording has them, world with z up. Transforms are 4×4, metres, named a_to_b. Times are seconds of one
clock for pictures, sweeps and poses. A frame is what all cameras see at once; its number is `frame`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar import Sweep, SweepTiming
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.scene.checks import LeftOut
from edge_depth_nerf.scene.writer import ShiftedView, Skipped


@dataclass(frozen=True)
class DepthFile:
    """A dense or sparse map from another sensor, instead of LiDAR."""

    path: Path
    """16-bit PNG, 0 = none."""
    metres_per_count: float
    """What one count of the file stands for."""
    kind: Literal["distance", "z_depth"]
    """Along the ray, or along the optical axis."""


@dataclass(frozen=True)
class RecordedCamera:
    """A camera on the vehicle."""

    name: str
    """Letters, digits, _ and -: it becomes a folder."""
    camera: Camera
    """At the size of its pictures."""
    to_vehicle: Transform
    """From the camera's frame to the vehicle's."""
    ego_mask: Path | None = None
    """What of its pictures is never used, 255 = use; None = not given."""


@dataclass(frozen=True)
class RecordedPicture:
    """A picture and the maps that come with it, all at the camera's size."""

    camera: str
    """Name of its camera."""
    frame: int
    """Number of its frame; the pictures of one frame are held out together."""
    path: Path
    """8-bit picture."""
    time_s: float
    """When it was taken."""
    camera_to_world: Transform | None = None
    """Where it was taken; None = from the vehicle's path at its time."""
    timestamp_s: float | None = None
    """Seconds of the recording's own clock (KITTI-360's: since 1970) for transforms.json; None = not known."""
    depth: DepthFile | None = None
    """A depth map instead of sweeps."""
    mask: Path | None = None
    """This picture's own mask, 255 = use."""
    moving_mask: Path | None = None
    """The mask found of what moves in this picture, 255 = use; beside the given mask."""
    mono: Path | None = None
    """Monocular distance, 16-bit PNG of 1/256 m along the ray."""
    truth_distance: Path | None = None
    """True distance, likewise."""
    truth_rgb: Path | None = None
    """The picture without noise."""

    @property
    def inputs(self) -> tuple[Path, ...]:
        """All files there are."""
        found = [self.path, self.mask, self.moving_mask, self.mono]
        found += [self.truth_distance, self.truth_rgb, None if self.depth is None else self.depth.path]
        return tuple(path for path in found if path is not None)


@dataclass(frozen=True)
class RecordedSweep:
    """One scan of a LiDAR."""

    path: Path
    """Its file."""
    time_s: float
    """The time that its points' times are counted from."""
    frame: int | None
    """Number of the frame it belongs to (held out with it); None = between the chosen frames."""
    scanner: str
    """Name of the scanner: the sweeps before and after are of the same one."""
    to_vehicle: Transform
    """From the scanner's frame to the vehicle's."""
    read: Callable[[], Sweep]
    """Reads it; called from several threads at once."""
    timing: SweepTiming | None = None
    """When each azimuth was measured; not used where the file says each point's time; None = all at once."""
    columns: int | None = None
    """How many float32 columns its .bin file is read with; None = its file says it."""


@dataclass(frozen=True)
class Recording:
    """A drive, checked, not yet read."""

    cameras: tuple[RecordedCamera, ...]
    pictures: tuple[RecordedPicture, ...]
    """Those that are to be in the scene, in order of frames."""
    sweeps: tuple[RecordedSweep, ...]
    """All that may be used, those around the pictures' frames included; empty with depth maps instead."""
    trajectory: Trajectory | None
    """None if poses are still to be found."""
    source: dict[str, Any]
    """What the scene is made of, as JSON, without paths of the machine: kind and the options of the converter."""
    whole_inputs: tuple[Path, ...] = ()
    """Small files that belong to the whole drive (calibration, poses): their bytes are part of its fingerprint."""
    skipped: tuple[Skipped, ...] = ()
    """What was asked for and cannot be taken."""
    left_out: tuple[LeftOut, ...] = ()
    """What is broken or missing, and so not in here."""
    notices: tuple[str, ...] = ()
    """What the user should know."""
    shifted: tuple[ShiftedView, ...] = ()
    """True views from beside the path, of synthetic drives."""

    def pose(self, picture: RecordedPicture) -> Transform:
        """Where a picture was taken, camera to world: its own pose, or from the vehicle's at its time.

        The recording needs a path.
        """
        if picture.camera_to_world is not None:
            return picture.camera_to_world
        assert self.trajectory is not None
        to_vehicle = next(camera.to_vehicle for camera in self.cameras if camera.name == picture.camera)
        return self.trajectory.at(np.array([picture.time_s]))[0] @ to_vehicle
