"""What the layouts share that a synthetic drive can be written in: a scene, the sensors in it, and what they record.

A layout says which sensors the vehicle carries, where each of their files lies, and what else a converter wants
beside them. Rendering, and the order in which files are written, is the same for all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from edge_depth_nerf.base.files import write_bytes, write_distance_png, write_mask, write_png
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.synthetic.lidar import HDL_64E, Scanner, Sweep, sweep
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.render import LENS_THETA_DEG, FisheyeCamera, World, own_car_world
from edge_depth_nerf.synthetic.rig import POSE_HEIGHT_M
from edge_depth_nerf.synthetic.scenes import build_scene

WORLD_ORIGIN_M = np.array([1200.0, 3700.0, 115.0])
"""Where the scene's origin lies in the world of the written poses."""

FIRST_NS = 1_369_730_762_123_456_789
"""Time of frame 0 in files that count nanoseconds."""

PICTURE_NOISE = 2.0 / 255
"""Standard deviation of the sensor's noise, in picture values of 0-1."""

VEHICLE_TO_POSE = np.diag([1.0, -1.0, -1.0, 1.0])
"""From the vehicle as rigs have it (x forward, y left, z up) to the pose (x forward, y right, z down)."""

_EXPOSURE_DRIFT = 0.10
_BLACK_LEVEL = 2.0 / 255

SCALE_ERROR = 0.10
"""Standard deviation of the logarithm of the scale error, over pixels and frames."""

_BLUR_SHARE = 0.004
_SKY_M = 70.0
_KEYFRAME_INTERVAL = 10
_GRID = 5
# a whole frame's error, the part that stays with the camera, and the part that comes and goes
_PARTS = (0.5, 0.5, 0.7071)


@dataclass(frozen=True)
class MountedCamera:
    """A camera on the vehicle."""

    camera: Camera
    """At the size of its pictures."""
    to_pose: NDArray[np.float64]
    """4×4, from its frame to the pose's (x forward, y right, z down)."""
    lens_theta_deg: float = LENS_THETA_DEG
    """Half of the lens's field of view."""
    delay_s: float = 0.0
    """How long after the frame's time it fires."""


def held_out(frame: int) -> bool:
    """Whether a frame is for evaluation, not for training."""
    return frame % 8 == 4


class DriveLayout(ABC):
    """A drive in one of the layouts. Before `build` it knows its files alone."""

    scanner: Scanner = HDL_64E
    last_file: Path
    """What `write_once` writes last: where it is, the others are."""

    def __init__(
        self, options: SynthesizeOptions, cameras: Mapping[str, MountedCamera], paths: Mapping[str, str]
    ) -> None:
        """Lay out a drive that is seen by these cameras.

        `paths` says where the files of a frame lie, by what they hold. With {name}, the camera's: `picture`, `mono`,
        `truth_distance`, `truth_rgb`, and `moving_mask`, where a picture shows nothing that moves; and of held-out
        frames ground truth as seen from so many metres to the car's left, `shifted_1_distance` and so on. Without:
        `scan`, and `true_points`, the same without noise, moved to the frame's time.
        """
        self.options, self.root, self.cameras = options, options.output, cameras
        still = options.scene != "traffic"
        self._paths = {kind: path for kind, path in paths.items() if not (still and kind == "moving_mask")}

    def build(self) -> None:
        """Build the scene, and what each camera sees of the own car."""
        model, seed = build_scene(self.options), self.options.seed
        self.drive, self._world = model.drive, World(model, seed)
        own_car = own_car_world(model, seed)
        # that world has z up, its origin on the road below the pose's
        pose_to_ground = VEHICLE_TO_POSE.copy()
        pose_to_ground[2, 3] = POSE_HEIGHT_M
        self.views = {
            name: FisheyeCamera(mounted.camera, own_car, pose_to_ground @ mounted.to_pose, mounted.lens_theta_deg)
            for name, mounted in self.cameras.items()
        }

    def files(self, frame: int, name: str | None) -> dict[str, Path]:
        """All files of a frame's picture by the camera `name`, or of its scan, by what they hold."""
        given = {"frame": frame, "name": name, "sequence": self.options.sequence}
        given["start_ns"] = FIRST_NS + round((frame - 0.5) * FRAME_INTERVAL_S * 1e9)
        return {
            kind: self.root / path.format(**given)
            for kind, path in self._paths.items()
            if ("{name}" in path) == (name is not None) and (held_out(frame) or not kind.startswith("shifted"))
        }

    def scan_bytes(self, taken: Sweep) -> bytes:
        """A scan in the layout's own format: float32 x, y, z, reflectance."""
        return taken.raw.astype("<f4").tobytes()

    @abstractmethod
    def write_once(self) -> None:
        """Write what does not belong to one frame: calibration, times, poses, masks."""

    def camera_pose(self, name: str, time_s: float, to_the_left_m: float = 0.0) -> NDArray[np.float64]:
        """Camera to scene, 4×4, with the whole car moved to its left."""
        sideways = rigid(np.eye(3), (0.0, -to_the_left_m, 0.0))
        return self.drive.pose_to_world(np.array([time_s]))[0] @ sideways @ self.cameras[name].to_pose

    def write(self, frame: int, name: str | None) -> None:
        """Render and write a frame's picture by the camera `name` and its maps, or its scan."""
        files, seed, world = self.files(frame, name), self.options.seed, self._world
        if name is None:
            rng = np.random.default_rng([seed, 20, frame])
            swept = sweep(world, self.drive, frame * FRAME_INTERVAL_S, rng, self.scanner)
            write_bytes(files["scan"], self.scan_bytes(swept))
            if "true_points" in files:
                write_bytes(files["true_points"], swept.deskewed.astype("<f4").tobytes())
            return
        number, camera = list(self.cameras).index(name), self.views[name]
        time_s = frame * FRAME_INTERVAL_S + self.cameras[name].delay_s
        for metres in self.options.shifts_m:
            if f"shifted_{metres:g}_rgb" in files:
                view = camera.view(world, self.camera_pose(name, time_s, metres), time_s, with_own_car=False)
                write_png(files[f"shifted_{metres:g}_rgb"], _to_bytes(world.to_picture(view.radiance)))
                write_distance_png(files[f"shifted_{metres:g}_distance"], view.distance_m)
        view = camera.view(world, self.camera_pose(name, time_s), time_s)
        write_distance_png(files["truth_distance"], view.distance_m)
        write_png(files["truth_rgb"], _to_bytes(world.to_picture(view.radiance)))
        if "moving_mask" in files:
            write_mask(files["moving_mask"], ~view.moving)
        estimate = simulated_estimate(view.distance_m, camera.own_distance_m, camera.lens, frame, seed, number)
        write_distance_png(files["mono"], estimate)
        # as the camera's sensor gives it, with exposure drift and noise
        taken = world.to_picture(view.radiance, _gain(seed, number, frame))
        rng = np.random.default_rng([seed, 31, number, frame])
        noise = rng.standard_normal(taken.shape, np.float32) * np.float32(PICTURE_NOISE)
        write_png(files["picture"], _to_bytes(np.maximum(taken, _BLACK_LEVEL) + noise))


def _gain(seed: int, camera: int, frame: int) -> float:
    """The exposure's smooth drift: two slow waves, within ±10 %."""
    rng = np.random.default_rng([seed, 30, camera])
    phases, periods = rng.uniform(0, 2 * np.pi, 2), rng.uniform((4.0, 1.7), (7.0, 2.9))
    time_s = frame * FRAME_INTERVAL_S
    waves = np.sin(2 * np.pi * time_s / periods + phases) * (0.7, 0.3)
    return float(1 + _EXPOSURE_DRIFT * waves.sum())


def _to_bytes(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Picture values of 0-1 as bytes."""
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)


# ---- a stand-in for a network's estimate -----------------------------------------------------------------------------


def _smooth_field(rng: Generator, height: int, width: int) -> NDArray[np.float32]:
    """Smooth noise of unit variance at the knots."""
    knots = rng.standard_normal((_GRID, _GRID)).astype(np.float32)
    return np.asarray(cv2.resize(knots, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def simulated_estimate(
    distance_m: NDArray[np.float32],
    own_car_m: NDArray[np.float32],
    lens: NDArray[np.bool_],
    frame: int,
    seed: int,
    camera: int,
) -> NDArray[np.float32]:
    """Turn a true distance map, H×W, into an estimate with a depth network's faults; 0 outside the lens.

    The faults: a scale error of some 10 % that varies smoothly over the picture and from frame to frame; edges blurred
    over a few pixels, so that thin things fade into what is behind; a sky at a finite distance. A network sees the own
    car as well, whose distances are `own_car_m`.
    """
    height, width = distance_m.shape
    whole = np.where(distance_m > 0, distance_m, own_car_m)
    log = np.log(np.where(whole > 0, np.minimum(whole, 250.0), _SKY_M)).astype(np.float32)
    # the blur must not draw in what lies outside the lens: normalised by the blurred lens
    sigma = max(0.6, _BLUR_SHARE * width)
    weight = cv2.GaussianBlur(lens.astype(np.float32), (0, 0), sigma)
    log = cv2.GaussianBlur(np.where(lens, log, 0), (0, 0), sigma) / np.maximum(weight, 1e-6)

    def fields(number: int) -> tuple[float, NDArray[np.float32]]:
        rng = np.random.default_rng([seed, 40, camera, number])
        return float(rng.standard_normal()), _smooth_field(rng, height, width)

    position = frame / _KEYFRAME_INTERVAL
    first = int(position)
    # both weights on a circle, so that the variance stays the same in between
    angle = (position - first) * np.pi / 2
    (scale_a, field_a), (scale_b, field_b) = fields(first), fields(first + 1)
    scale = np.cos(angle) * scale_a + np.sin(angle) * scale_b
    changing = np.cos(angle) * field_a + np.sin(angle) * field_b
    lasting = _smooth_field(np.random.default_rng([seed, 41, camera]), height, width)
    error = _PARTS[0] * scale + _PARTS[1] * lasting + _PARTS[2] * changing
    return np.where(lens, np.exp(log + SCALE_ERROR * error), 0).astype(np.float32)
