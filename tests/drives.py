"""A tiny raw drive in KITTI-360's layout whose every distance is known in closed form: a car in an empty room.

The room is a box along the world's axes, so a ray from inside it ends at the nearest of six planes. The cameras are
the MEI model written out here in NumPy with KITTI-360's integer pixel centres (u0, v0); nothing of the package's
cameras, projection or conventions is used, so that a mistake there cannot cancel out.
"""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_depth_nerf.base.files import write_distance_png, write_json, write_mask, write_png
from edge_depth_nerf.synthetic import render
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

SEQUENCE = "2013_05_28_drive_0000_sync"
FULL_SIZE = 1400

# KITTI-360's numbers: xi, k1, k2, p1, p2, gamma1, gamma2, u0, v0
MEI_NUMBERS = {
    "image_02": (
        *(2.2134047507854890, 1.6798235660113681e-02, 1.6548773243373522, 4.2223943394772046e-04),
        *(4.2462134260997584e-04, 1.3363220825849971e03, 1.3357883350012958e03, 7.1694323510126321e02),
        7.0576498308221585e02,
    ),
    "image_03": (
        *(2.5535139132482758, 4.9370396274089505e-02, 4.5068455478645308, 1.3477698472982495e-03),
        *(-7.0340482615055284e-04, 1.4854388981875156e03, 1.4849477411748708e03, 6.9888316784030962e02),
        6.9814541887723055e02,
    ),
}
CAM_TO_POSE = {
    "image_00": "0.0371783278 -0.0986182135 0.9944306009 1.5752681039 0.9992675562 -0.0053553387 -0.0378902567 "
    "0.0043914093 0.0090621821 0.9951109327 0.0983468786 -0.6500000000",
    "image_02": "0.9995185086 0.0041276589 -0.0307524527 0.7264036936 -0.0307926666 0.0100608424 -0.9994751579 "
    "-0.1499658517 -0.0038160970 0.9999408692 0.0101830998 -1.0686400091",
    "image_03": "-0.9996821702 0.0005703407 -0.0252038325 0.7016842127 -0.0252033830 0.0007820814 0.9996820384 "
    "0.7463650950 0.0005898709 0.9999995315 -0.0007674583 -1.0751978255",
}
CAM0_TO_VELO = (
    "0.04307104361 -0.08829286498 0.995162929 0.8043914418 -0.999004371 0.007784614041 0.04392796942 0.2993489574 "
    "-0.01162548558 -0.9960641394 -0.08786966659 -0.1770225824"
)

ROOM = np.array([[988.0, 3794.0, 115.0], [1030.0, 3808.0, 121.0]])
"""Two corners in the drive's world, which lies far from its origin as KITTI-360's does."""
WALL_COLOURS = np.array(
    [[[200, 40, 40], [40, 200, 40], [40, 40, 200]], [[200, 200, 40], [40, 200, 200], [200, 40, 200]]], np.uint8
)
"""Of the plane at ROOM[side, axis]."""


def matrix(numbers: str) -> NDArray:
    return np.vstack((np.array(numbers.split(), float).reshape(3, 4), (0, 0, 0, 1)))


@dataclass(frozen=True)
class MeiTwin:
    """The MEI camera as KITTI-360 defines it, integer pixel centres."""

    size: int
    xi: float
    k1: float
    k2: float
    p1: float
    p2: float
    gamma1: float
    gamma2: float
    u0: float
    v0: float

    @classmethod
    def kitti360(cls, name: str, size: int) -> "MeiTwin":
        xi, k1, k2, p1, p2, gamma1, gamma2, u0, v0 = MEI_NUMBERS[name]
        s = size / FULL_SIZE
        # of pixels counted from their centres: the picture's border is at -0.5
        return cls(size, xi, k1, k2, p1, p2, gamma1 * s, gamma2 * s, (u0 + 0.5) * s - 0.5, (v0 + 0.5) * s - 0.5)

    def yaml(self, name: str, space: str = " ") -> str:
        s = space
        return (
            f"%YAML:1.0\n---\nmodel_type:{s}MEI\ncamera_name:{s}{name}\nimage_width:{s}{self.size}\n"
            f"image_height:{s}{self.size}\nmirror_parameters:\n   xi:{s}{self.xi!r}\n"
            f"distortion_parameters:\n   k1:{s}{self.k1!r}\n   k2:{s}{self.k2!r}\n   p1:{s}{self.p1!r}\n"
            f"   p2:{s}{self.p2!r}\nprojection_parameters:\n   gamma1:{s}{self.gamma1!r}\n"
            f"   gamma2:{s}{self.gamma2!r}\n   u0:{s}{self.u0!r}\n   v0:{s}{self.v0!r}\n"
        )

    def _distort(self, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
        r2 = x * x + y * y
        radial = 1 + self.k1 * r2 + self.k2 * r2 * r2
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def project(self, points: NDArray) -> NDArray:
        """Points to (u, v), integer pixel centres."""
        unit = points / np.linalg.norm(points, axis=-1, keepdims=True)
        z = unit[..., 2] + self.xi
        x, y = self._distort(unit[..., 0] / z, unit[..., 1] / z)
        return np.stack((self.gamma1 * x + self.u0, self.gamma2 * y + self.v0), -1)

    def rays(self, pixels: NDArray) -> tuple[NDArray, NDArray]:
        """(u, v), integer pixel centres, to unit rays and θ; NaN outside the model's range."""
        xd, yd = (pixels[..., 0] - self.u0) / self.gamma1, (pixels[..., 1] - self.v0) / self.gamma2
        x, y = xd, yd
        for _ in range(200):
            dx, dy = self._distort(x, y)
            x, y = x + 0.7 * (xd - dx), y + 0.7 * (yd - dy)
        r2 = x * x + y * y
        with np.errstate(invalid="ignore"):
            eta = (self.xi + np.sqrt(1 + (1 - self.xi**2) * r2)) / (1 + r2)
        rays = np.stack((eta * x, eta * y, eta - self.xi), -1)
        return rays, np.arccos(np.clip(rays[..., 2], -1, 1))


def wall_distance(origin: NDArray, rays: NDArray) -> tuple[NDArray, NDArray]:
    """Distance from `origin` along unit rays to the room's walls, and the walls' colours."""
    with np.errstate(divide="ignore"):
        along = (np.where(rays > 0, ROOM[1], ROOM[0]) - origin) / rays
    along = np.where(rays == 0, np.inf, along)
    axis = np.nanargmin(np.where(np.isfinite(along), along, np.inf), axis=-1)
    distance = np.take_along_axis(along, axis[..., None], -1)[..., 0]
    side = (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0).astype(int)
    return distance, WALL_COLOURS[side, axis]


@dataclass(frozen=True)
class RoomDrive:
    """Where the drive lies, and what is true of it."""

    root: Path
    size: int
    frames: tuple[int, ...]
    poses: dict[int, NDArray]
    points_m: dict[int, NDArray] = field(default_factory=dict)
    """Points of each sweep in the scanner's frame at the frame's time; the files hold them `as_measured`."""

    def camera(self, name: str) -> MeiTwin:
        return MeiTwin.kitti360(name, self.size)

    def camera_to_world(self, name: str, frame: int) -> NDArray:
        return self.poses[frame] @ matrix(CAM_TO_POSE[name])

    def velo_to_world(self, frame: float) -> NDArray:
        """Where the scanner is, also between frames."""
        return pose(frame) @ matrix(CAM_TO_POSE["image_00"]) @ np.linalg.inv(matrix(CAM0_TO_VELO))

    def as_measured(self, points: NDArray, frame: int) -> NDArray:
        """Points of the scanner's frame at the frame's time, as the turning scanner measures them on the way.

        It turns clockwise, once a frame, and faces forward at the frame's time.
        """
        to_world = self.velo_to_world(frame)
        world = points @ to_world[:3, :3].T + to_world[:3, 3]
        measured = points
        for _ in range(30):
            turns = -np.arctan2(measured[:, 1], measured[:, 0]) / (2 * np.pi)
            # the drive is straight: the scanner only shifts, by so much a frame
            per_frame = self.velo_to_world(1)[:3, 3] - self.velo_to_world(0)[:3, 3]
            moved = world - (to_world[:3, 3] + turns[:, None] * per_frame)
            measured = moved @ to_world[:3, :3]
        return measured

    def see(self, name: str, frame: int, pixels: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """True distance, colour and θ at (u, v), integer pixel centres."""
        camera_to_world = self.camera_to_world(name, frame)
        rays, theta = self.camera(name).rays(pixels)
        distance, colours = wall_distance(camera_to_world[:3, 3], rays @ camera_to_world[:3, :3].T)
        return distance, colours, theta

    def grid(self) -> NDArray:
        return np.stack(np.meshgrid(np.arange(self.size), np.arange(self.size)), -1).astype(float)

    def image(self, name: str, frame: int) -> Path:
        return self.root / f"data_2d_raw/{SEQUENCE}/{name}/data_rgb/{frame:010d}.png"

    def sweep(self, frame: int) -> Path:
        return self.root / f"data_3d_raw/{SEQUENCE}/velodyne_points/data/{frame:010d}.bin"

    def poses_file(self) -> Path:
        return self.root / f"data_poses/{SEQUENCE}/poses.txt"


def pose(frame: float, yaw_rad: float = 0.4) -> NDArray:
    """Vehicle to world: 0.5 m a frame, x forward, y right, z down."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    found = np.eye(4)
    found[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
    found[:3, 3] = np.array([1000.25, 3799.5, 116.0]) + 0.5 * frame * turn[:, 0]
    return found


def write_points(path: Path, points: NDArray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = np.zeros((len(points), 4), "<f4")
    rows[:, :3] = points
    rows[:, 3] = 0.5
    path.write_bytes(rows.tobytes())


def write_room_drive(
    root: Path,
    frames: int = 9,
    size: int = 70,
    cameras: tuple[str, ...] = ("image_02", "image_03"),
    aim: str | None = None,
    truth: bool = False,
    beams: int = 3000,
    seed: int = 0,
) -> RoomDrive:
    """Write the drive.

    Args:
        root: the folder, to be.
        frames: how many, from 0.
        size: width and height of the pictures.
        cameras: which.
        aim: instead of evenly around the scanner, let each return lie somewhere in its own pixel of this camera.
        truth: also write the truth, and shifted views of frame 4.
        beams: returns of a sweep.
        seed: of the directions.
    """
    rng = np.random.default_rng(seed)
    drive = RoomDrive(root, size, tuple(range(frames)), {frame: pose(frame) for frame in range(frames)})
    calibration = root / "calibration"
    calibration.mkdir(parents=True)
    for name in ("image_02", "image_03"):
        (calibration / f"{name}.yaml").write_text(drive.camera(name).yaml(name))
    (calibration / "calib_cam_to_pose.txt").write_text("".join(f"{k}: {v}\n" for k, v in CAM_TO_POSE.items()))
    (calibration / "calib_cam_to_velo.txt").write_text(CAM0_TO_VELO + "\n")

    drive.poses_file().parent.mkdir(parents=True)
    drive.poses_file().write_text(
        "".join(f"{f} " + " ".join(f"{x!r}" for x in p[:3].ravel().tolist()) + "\n" for f, p in drive.poses.items())
    )
    times = "".join(f"2013-05-28 08:46:0{frame // 10}.{frame % 10}23456789\n" for frame in drive.frames)
    for name in cameras:
        (root / f"data_2d_raw/{SEQUENCE}/{name}/data_rgb").mkdir(parents=True)
        (root / f"data_2d_raw/{SEQUENCE}/{name}/timestamps.txt").write_text(times)

    for frame in drive.frames:
        for name in cameras:
            distance, colours, theta = drive.see(name, frame, drive.grid())
            lens = theta < np.radians(100)
            write_png(drive.image(name, frame), np.where(lens[..., None], colours, 0).astype(np.uint8))
            if truth:
                folder = root / f"truth/{SEQUENCE}/{name}"
                write_distance_png(folder / f"distance/{frame:010d}.png", np.where(lens, distance, 0))
                write_png(folder / f"rgb/{frame:010d}.png", np.where(lens[..., None], colours, 0).astype(np.uint8))
        if aim is None:
            rays = rng.normal(size=(beams, 3))
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            velo_to_world = drive.velo_to_world(frame)
            distance, _ = wall_distance(velo_to_world[:3, 3], rays @ velo_to_world[:3, :3].T)
            points = rays * distance[:, None]
        else:
            points = aimed_points(drive, aim, frame, rng)[0]
        drive.points_m[frame] = points
        write_points(drive.sweep(frame), drive.as_measured(points, frame))
    if truth:
        _write_shifted(drive, cameras)
    return drive


def aimed_points(drive: RoomDrive, name: str, frame: int, rng: np.random.Generator) -> tuple[NDArray, NDArray, NDArray]:
    """A return somewhere in each of some pixels: points in the scanner's frame, the pixels (u, v), the distances."""
    pixels = drive.grid().reshape(-1, 2)
    pixels = pixels[rng.random(len(pixels)) < 0.3]
    pixels = pixels[drive.camera(name).rays(pixels)[1] < np.radians(93)]
    where = pixels + rng.uniform(-0.45, 0.45, pixels.shape)
    distance, _, _ = drive.see(name, frame, where)
    rays, _ = drive.camera(name).rays(where)
    camera_to_world = drive.camera_to_world(name, frame)
    world = camera_to_world[:3, 3] + distance[:, None] * rays @ camera_to_world[:3, :3].T
    world_to_velo = np.linalg.inv(drive.velo_to_world(frame))
    return world @ world_to_velo[:3, :3].T + world_to_velo[:3, 3], pixels.astype(int), distance


def _write_shifted(drive: RoomDrive, cameras: tuple[str, ...]) -> None:
    poses: dict[str, dict[str, dict[str, list]]] = {}
    for metres in (1, 2):
        for name in cameras:
            camera_to_world = drive.camera_to_world(name, 4)
            camera_to_world[:3, 3] += metres * drive.poses[4][:3, 1]
            poses.setdefault(str(metres), {})[name] = {"4": camera_to_world.tolist()}
            rays, _ = drive.camera(name).rays(drive.grid())
            distance, colours = wall_distance(camera_to_world[:3, 3], rays @ camera_to_world[:3, :3].T)
            folder = drive.root / f"truth/{SEQUENCE}/{name}/shifted_{metres}m"
            write_distance_png(folder / "distance/0000000004.png", distance)
            write_png(folder / "rgb/0000000004.png", colours)
    write_json(drive.root / f"truth/{SEQUENCE}/shifted.json", poses)


def synthesize_coarsely(options: SynthesizeOptions) -> Path:
    """Render a drive with one ray a pixel instead of four, which is enough where only distances are looked at."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(render, "_SUBSAMPLES", ((0.0, 0.0),))
        return synthesize_drive(options)


def without_lidar_check(monkeypatch: Any) -> None:
    """Let no converter hold LiDAR against the pictures, which takes long and is tested in test_process_warnings.py."""
    from edge_depth_nerf.process import build, lidar_checks

    monkeypatch.setattr(build, "check_lidar", lambda *_: lidar_checks.LidarCheck((), ()))


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-3])


Change = bytes | tuple[str, str] | Callable[[Path], object] | None


def spoil(root: Path, pattern: str, change: Change) -> None:
    """Remove what a pattern names (None), write bytes to it, replace a regex in it once, or call a function with it."""
    for path in sorted(root.glob(pattern)) or [root / pattern]:
        if change is None:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        elif isinstance(change, bytes):
            path.write_bytes(change)
        elif isinstance(change, tuple):
            text, count = re.subn(change[0], change[1], path.read_text(), count=1)
            assert count, change
            path.write_text(text)
        else:
            change(path)


def write_mono(folder: Path, drive: RoomDrive, distance_m: Callable[[str, int], float] | float) -> Path:
    """Monocular maps of the same distance in all pixels, or of one for each camera and frame."""
    for name in ("image_02", "image_03"):
        for frame in drive.frames:
            value = distance_m(name, frame) if callable(distance_m) else distance_m
            write_distance_png(folder / f"{name}/{frame:010d}.png", np.full((drive.size, drive.size), value))
    return folder


def write_masks(folder: Path, drive: RoomDrive, cameras: tuple[str, ...] = ("image_02", "image_03")) -> Path:
    """Ego masks that hide the lower fifth of the picture."""
    for name in cameras:
        keep = np.ones((drive.size, drive.size), bool)
        keep[drive.size * 4 // 5 :] = False
        write_mask(folder / f"{name}.png", keep)
    return folder
