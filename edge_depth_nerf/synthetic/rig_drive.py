"""Writing a synthetic drive as somebody's own rig, or as JBNU-Depth360, with what `process` wants beside it.

The layout `rig`: fisheyes to the left (Kannala-Brandt) and right (MEI) that see to 110° from their axes, a pinhole
with distortion ahead, a scanner whose points have times. Every camera has a clock of its own.

    rig.toml                                what docs/rig.md describes
    poses.txt                               TUM: the vehicle (x forward, y left, z up) to the world, every 0.04 s
    images/{left,right,front}/000000.png    pictures; times_left.txt and so on hold when they were taken
    lidar/1369730762073456789.pcd           scans; the name is the start of the turn in ns, `t` counts ns from it

The layout `jbnu-depth360`: four 183° fisheyes (Kannala-Brandt), a scanner of 32 beams.

    calibration.toml, poses.txt             what docs/rig.md describes; the data set has neither
    image/{front,left,rear,right}/000000.png, bin/000000.bin    (the data set publishes the front camera, in image/)

Both, with c the camera:

    masks/c.png                             255 = keep: inside the lens, not the own car
    mono/c/*.png                            made from the truth with a network's faults; no network's estimate
    truth/c/distance/*.png, truth/c/rgb/*.png    metres along the ray in 1/256 m; pictures without drift and noise
    truth/c/moving_masks/*.png              255 = keep: nothing that moves; in the scene `traffic` alone
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import pcd_bytes, write_mask, write_text
from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.synthetic.layout import FIRST_NS, VEHICLE_TO_POSE, WORLD_ORIGIN_M, DriveLayout, MountedCamera
from edge_depth_nerf.synthetic.lidar import Scanner, Sweep
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SynthesizeOptions

POSE_INTERVAL_S = 0.04
"""Time between the written poses; it does not fit the pictures'."""

_MAPS = {"mono": "mono/{name}", "truth_distance": "truth/{name}/distance", "truth_rgb": "truth/{name}/rgb"}
_MODELS = {MEI: "mei", KannalaBrandt: "kannala-brandt", Pinhole: "pinhole"}


def looking(yaw_deg: float, pitch_deg: float, position_m: tuple[float, float, float]) -> NDArray[np.float64]:
    """Camera to vehicle (x forward, y left, z up), 4×4, turned to the left by `yaw_deg` and down by `pitch_deg`."""
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), -math.sin(pitch)])
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    return rigid(np.stack((right, np.cross(forward, right), forward), -1), position_m)


def _mounted(camera: Camera, to_vehicle: NDArray[np.float64], theta_deg: float, delay_s: float = 0.0) -> MountedCamera:
    return MountedCamera(camera, VEHICLE_TO_POSE @ to_vehicle, theta_deg, delay_s)


def rig_cameras(size: int) -> dict[str, MountedCamera]:
    """The cameras of the layout `rig`; the fisheyes are square, the pinhole is 4:3."""
    centre = (0.507 * size, 0.496 * size)
    left = KannalaBrandt(size, size, 1.0, 1.0, *centre, -0.012, 0.006, -0.0018, 0.00008)
    right = MEI(size, size, 1.0, 1.0, *centre, 1.2, 0.03, 0.02, 3e-4, -2e-4)
    height = round(0.75 * size)
    front = Pinhole(size, height, 0.7 * size, 0.702 * size, 0.503 * size, 0.49 * height, -0.11, 0.03, 4e-4, -3e-4)
    return {
        "left": _mounted(_filled(left, 110.0), looking(88.0, 8.0, (0.73, 0.15, 1.07)), 110.0),
        "right": _mounted(_filled(right, 110.0), looking(-91.0, 6.0, (0.70, -0.75, 1.07)), 110.0, 0.004),
        "front": _mounted(front, looking(1.0, 5.0, (1.58, 0.05, 0.65)), 60.0, 0.012),
    }


def jbnu_cameras(size: int) -> dict[str, MountedCamera]:
    """The cameras of the layout `jbnu-depth360`: 16:9, the lens circle as wide as the picture."""
    height = round(size * 1080 / 1920)
    lens = KannalaBrandt(size, height, 1.0, 1.0, 0.502 * size, 0.497 * height, -0.02, 0.004, -0.0015, 0.0)
    camera = _filled(lens, 91.5)
    places: dict[str, tuple[float, tuple[float, float, float]]] = {
        "front": (0.0, (1.5, 0.0, 0.7)),
        "left": (90.0, (0.5, 0.5, 1.05)),
        "rear": (180.0, (-0.7, 0.0, 1.05)),
        "right": (-90.0, (0.5, -0.5, 1.05)),
    }
    return {name: _mounted(camera, looking(yaw, 4.0, place), 91.5) for name, (yaw, place) in places.items()}


def _filled(camera: Camera, theta_deg: float) -> Camera:
    """The camera with focal lengths that put this angle at 0.49 of the picture's width from the principal point."""
    theta = math.radians(theta_deg)
    ray = torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]], dtype=torch.float64)
    focal = 0.49 * camera.width / (float(camera.project(ray)[0][0, 0]) - camera.cx)
    return replace(camera, fx=focal, fy=1.001 * focal)


class _RigFileLayout(DriveLayout):
    """What the layouts share that bring a rig file."""

    scanner_to_vehicle: NDArray[np.float64]
    first_s = 0.0
    """Time of frame 0."""

    def __init__(
        self, options: SynthesizeOptions, cameras: dict[str, MountedCamera], rig_file: str, pictures: str, scan: str
    ) -> None:
        folders = {"picture": pictures, **_MAPS, "moving_mask": "truth/{name}/moving_masks"}
        paths = {kind: f"{folder}/{{frame:06d}}.png" for kind, folder in folders.items()}
        super().__init__(options, cameras, {**paths, "scan": scan})
        self.last_file = self.root / rig_file

    @abstractmethod
    def description(self) -> str:
        """What the rig file says."""

    def write_once(self) -> None:
        for name, camera in self.views.items():
            write_mask(self.root / "masks" / f"{name}.png", camera.lens & ~camera.own_car)
        end_s = (self.options.frames - 1) * FRAME_INTERVAL_S + 0.2
        times_s = np.arange(-0.2, end_s, POSE_INTERVAL_S)
        lines = []
        for time_s, pose in zip(times_s, self.drive.pose_to_world(times_s) @ VEHICLE_TO_POSE, strict=True):
            position, quaternion = pose[:3, 3] + WORLD_ORIGIN_M, Rotation.from_matrix(pose[:3, :3]).as_quat()
            numbers = " ".join(f"{value:.9f}" for value in (*position, *quaternion))
            lines.append(f"{self.first_s + time_s:.6f} {numbers}\n")
        write_text(self.root / "poses.txt", "# time x y z qx qy qz qw\n" + "".join(lines))
        write_text(self.last_file, self.description())


class _Rig(_RigFileLayout):
    """The layout `rig`."""

    first_s = FIRST_NS / 1e9
    scanner_to_vehicle: NDArray[np.float64] = rigid(
        Rotation.from_euler("z", 3.0, degrees=True).as_matrix(), (0.8, 0.02, 0.84)
    )
    scanner = Scanner.turning(12.0, -26.0, 48, 1200, VEHICLE_TO_POSE @ scanner_to_vehicle)

    def __init__(self, options: SynthesizeOptions) -> None:
        super().__init__(options, rig_cameras(options.size), "rig.toml", "images/{name}", "lidar/{start_ns}.pcd")

    def scan_bytes(self, taken: Sweep) -> bytes:
        record = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]
        start_ns = np.rint((taken.offset_s + FRAME_INTERVAL_S / 2) * 1e9)
        return pcd_bytes(unstructured_to_structured(np.column_stack((taken.raw, start_ns)), np.dtype(record)))

    def write_once(self) -> None:
        for name, mounted in self.cameras.items():
            times_s = [frame * FRAME_INTERVAL_S + mounted.delay_s for frame in range(self.options.frames)]
            lines = "".join(f"{self.first_s + time_s:.6f}\n" for time_s in times_s)
            write_text(self.root / f"times_{name}.txt", lines)
        super().write_once()

    def description(self) -> str:
        text = '[poses]\nfile = "poses.txt"\nformat = "tum"\n'
        for name, mounted in self.cameras.items():
            text += f"\n[cameras.{name}]\n" + _table(
                images=f"images/{name}",
                times_file=f"times_{name}.txt",
                ego_mask=f"masks/{name}.png",
                **_maps(name),
                **_model(mounted.camera),
                to_vehicle=VEHICLE_TO_POSE @ mounted.to_pose,
            )
        text += "\n[lidars.roof]\n" + _table(
            scans="lidar",
            times_from_names=True,
            time_unit="ns",
            point_times={"column": "t", "unit": "ns", "counted_from": "timestamp"},
            turn_s=FRAME_INTERVAL_S,
            timestamp="start",
            to_vehicle={
                "translation": self.scanner_to_vehicle[:3, 3],
                "quaternion": Rotation.from_matrix(self.scanner_to_vehicle[:3, :3]).as_quat(),
            },
        )
        return text


class _JbnuDepth360(_RigFileLayout):
    """The layout `jbnu-depth360`."""

    scanner_to_vehicle: NDArray[np.float64] = rigid(np.eye(3), (0.4, 0.0, 1.2))
    scanner = Scanner.turning(45.0, -45.0, 32, 1024, VEHICLE_TO_POSE @ scanner_to_vehicle)

    def __init__(self, options: SynthesizeOptions) -> None:
        cameras = jbnu_cameras(options.size)
        super().__init__(options, cameras, "calibration.toml", "image/{name}", "bin/{frame:06d}.bin")

    def description(self) -> str:
        text = '[poses]\nfile = "poses.txt"\n'
        for name, mounted in self.cameras.items():
            model = _model(mounted.camera)
            del model["model"]
            text += f"\n[cameras.{name}]\n" + _table(
                **model, ego_mask=f"masks/{name}.png", **_maps(name), to_vehicle=VEHICLE_TO_POSE @ mounted.to_pose
            )
        text += "\n[lidars.ouster]\n" + _table(to_vehicle=self.scanner_to_vehicle)
        return text


def _maps(name: str) -> dict[str, str]:
    """Folders of what comes with a camera's pictures, by its key in a rig file."""
    return {kind: folder.format(name=name) for kind, folder in _MAPS.items()}


def _model(camera: Camera) -> dict[str, Any]:
    """A camera as a rig file describes it, with OpenCV's pixel centres, in which it was calibrated."""
    found = camera.to_dict()
    del found["theta_limit_rad"]
    found |= {"model": _MODELS[type(camera)], "cx": camera.cx - 0.5, "cy": camera.cy - 0.5}  # pyrefly: ignore
    return {key: value for key, value in found.items() if value != 0.0}


def _table(**values: Any) -> str:
    return "".join(f"{key} = {_toml(value)}\n" for key, value in values.items())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, np.ndarray) and value.ndim == 2:
        return "[\n" + "".join(f"    {_toml(row)},\n" for row in value) + "]"
    if isinstance(value, np.ndarray):
        # adding zero turns -0.0 into 0.0
        return "[" + ", ".join(str(number) for number in (np.round(value, 10) + 0.0).tolist()) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else f"{value:.12g}"


RIG_FILE_LAYOUTS: dict[str, Callable[[SynthesizeOptions], DriveLayout]] = {"rig": _Rig, "jbnu-depth360": _JbnuDepth360}
"""The layouts with a rig file."""
