"""Writing a synthetic drive in KITTI-360's raw layout, with the truth beside it.

Under the output folder, with SEQ the sequence, k = 2 (left), 3 (right) and ten-digit frame numbers:

    drive.json                                    the options, written first; marks the folder as a drive
    calibration/                                  KITTI-360's files, MEI scaled to the picture size
    data_2d_raw/SEQ/image_0k/data_rgb/*.png       pictures with exposure drift and noise; timestamps.txt
    data_3d_raw/SEQ/velodyne_points/data/*.bin    float32 x, y, z, reflectance, raw; timestamps.txt
    data_poses/SEQ/poses.txt, cam0_to_world.txt   vehicle and camera 0 to world (camera 0 as if it were rectified)
    truth/masks/image_0k{_lens,_ego,}.png         255 = keep: inside the lens, not the own car, both
    truth/SEQ/image_0k/distance/*.png             metres along the ray in 1/256 m; 0 = sky, own car, outside the lens
    truth/SEQ/image_0k/rgb/*.png                  pictures without exposure drift and noise
    truth/SEQ/points/*.bin                        the sweep without noise, moved to the frame's moment
    truth/SEQ/shifted.json                        camera-to-world poses 1 m and 2 m to the car's left, held-out frames
    truth/SEQ/image_0k/shifted_{1,2}m/{rgb,distance}/*.png   what is seen there, without the own car
    truth/SEQ/moving_masks/image_0k/*.png         255 = keep: not a car that drives; only with driving cars
    simulated_mono/SEQ/image_0k/*.png             made from the truth with a network's faults; no network's estimate

Frame i is held out if i % 8 == 4. World coordinates are metres, z up, with an origin far away, as KITTI-360's are.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    check_is_folder,
    read_json,
    write_bytes,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
    write_text,
)
from edge_depth_nerf.synthetic import rig
from edge_depth_nerf.synthetic.lidar import sweep
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.render import FisheyeCamera, View, World, own_car_world
from edge_depth_nerf.synthetic.scenes import build_scene
from edge_depth_nerf.synthetic.simulated_mono import simulated_estimate

VERSION = 1
"""Version of what is synthesised: drives of different versions do not mix in one folder."""

WORLD_ORIGIN_M = np.array([1200.0, 3700.0, 115.0])
"""Where the scene's origin lies in the world of the written poses."""

SHIFTS_M = (1, 2)
"""How far the held-out views are moved to the car's left."""

PICTURE_NOISE = 2.0 / 255
"""Standard deviation of the sensor's noise, in picture values of 0-1."""

_EXPOSURE_DRIFT = 0.10
_BLACK_LEVEL = 2.0 / 255
_MANIFEST = "drive.json"
_FIRST_MOMENT = datetime(2013, 5, 28, 8, 46, 2)
_FIRST_NANOSECONDS = 123_456_789

Job = tuple[int, str | None]
"""A frame, and a camera; None = its sweep."""

_log = logging.getLogger(__name__)


def held_out(frame: int) -> bool:
    """Whether a frame is for judging, not for training."""
    return frame % 8 == 4


@dataclass(frozen=True)
class _Paths:
    """Where things lie in a drive."""

    root: Path
    sequence: str

    def shifted(self) -> Path:
        return self.root / "truth" / self.sequence / "shifted.json"

    def timestamps(self) -> list[Path]:
        folders = [self.root / "data_2d_raw" / self.sequence / name for name in rig.CAMERAS]
        folders.append(self.root / "data_3d_raw" / self.sequence / "velodyne_points")
        return [folder / "timestamps.txt" for folder in folders]

    def picture(self, camera: str, frame: int) -> Path:
        return self.root / "data_2d_raw" / self.sequence / camera / "data_rgb" / f"{frame:010d}.png"

    def sweep(self, frame: int) -> Path:
        return self.root / "data_3d_raw" / self.sequence / "velodyne_points" / "data" / f"{frame:010d}.bin"

    def points(self, frame: int) -> Path:
        return self.root / "truth" / self.sequence / "points" / f"{frame:010d}.bin"

    def truth(self, camera: str, kind: str, frame: int) -> Path:
        return self.root / "truth" / self.sequence / camera / kind / f"{frame:010d}.png"

    def moving_mask(self, camera: str, frame: int) -> Path:
        return self.root / "truth" / self.sequence / "moving_masks" / camera / f"{frame:010d}.png"

    def mono(self, camera: str, frame: int) -> Path:
        return self.root / "simulated_mono" / self.sequence / camera / f"{frame:010d}.png"

    def of_sweep(self, frame: int) -> list[Path]:
        return [self.sweep(frame), self.points(frame)]

    def of_camera(self, camera: str, frame: int, with_moving_mask: bool) -> list[Path]:
        files = [self.picture(camera, frame), self.mono(camera, frame)]
        files += [self.truth(camera, kind, frame) for kind in ("distance", "rgb")]
        if with_moving_mask:
            files.append(self.moving_mask(camera, frame))
        if held_out(frame):
            files += [
                self.truth(camera, f"shifted_{shift}m/{kind}", frame)
                for shift in SHIFTS_M
                for kind in ("rgb", "distance")
            ]
        return files


def _manifest(options: SynthesizeOptions) -> dict[str, Any]:
    fields = dataclasses.asdict(options)
    del fields["output"]
    if options.layout == "kitti-360":
        # as when there was no other
        del fields["layout"]
    fields["speed_m_s"] = options.mean_speed_m_s
    return {
        "kind": "synthetic drive",
        "version": VERSION,
        "options": fields,
        "note": "Ray-traced, not recorded. simulated_mono/ is made from the true distances with a depth network's "
        "faults; it is no network's estimate.",
    }


def _open_folder(options: SynthesizeOptions) -> None:
    """Take the output folder: new, empty, or a drive of the same options.

    Raises:
        InputError: it holds something else.

    """
    folder, manifest = options.output, _manifest(options)
    check_is_folder(folder)
    path = folder / _MANIFEST
    if path.is_file():
        there = read_json(path)
        if there != manifest:
            given = there.get("options", {}) if isinstance(there, dict) else {}
            # this layout is not written down
            old, new = ({"layout": "kitti-360", **options} for options in (given, manifest["options"]))
            changed = [
                f"{name} is {old.get(name)!r} there and {new.get(name)!r} here"
                for name in dict.fromkeys((*new, *old))
                if old.get(name) != new.get(name)
            ]
            raise InputError(
                f"{folder}: holds a drive of other options ({'; '.join(changed) or 'made by another version'}). "
                "Choose another --output, or the same options to continue it."
            )
        # what an interrupted run was about to write
        for left_over in folder.rglob(".*"):
            if left_over.suffix in (".png", ".bin", ".pcd", ".txt", ".json", ".yaml", ".toml"):
                left_over.unlink()
    elif folder.is_dir() and any(folder.iterdir()):
        names = sorted(entry.name for entry in folder.iterdir())
        raise InputError(
            f"{folder}: holds something that is not a synthetic drive ({', '.join(names[:5])}"
            f"{', ...' if len(names) > 5 else ''}). Choose a new or empty folder as --output."
        )
    write_json(path, manifest)


def _timestamps(frames: int) -> str:
    lines = []
    for frame in range(frames):
        nanoseconds = _FIRST_NANOSECONDS + frame * round(FRAME_INTERVAL_S * 1e9)
        moment = _FIRST_MOMENT + timedelta(seconds=nanoseconds // 10**9)
        lines.append(f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds % 10**9:09d}\n")
    return "".join(lines)


def _row(frame: int, matrix: NDArray[np.float64]) -> str:
    return " ".join([str(frame), *(f"{value:.10f}" for value in matrix.reshape(-1))]) + "\n"


class _Synthesis:
    """A scene, the cameras, and what a frame of them is made of."""

    def __init__(self, options: SynthesizeOptions) -> None:
        self.options = options
        self.paths = _Paths(options.output, options.sequence)
        self._model = build_scene(options)
        self._world = World(self._model, options.seed)
        own_car = own_car_world(self._model, options.seed)
        # that world has z up, its origin on the road below the pose's
        pose_to_ground = np.diag([1.0, -1.0, -1.0, 1.0])
        pose_to_ground[2, 3] = rig.POSE_HEIGHT_M
        self.cameras = {
            name: FisheyeCamera(rig.camera(name, options.size), own_car, pose_to_ground @ rig.CAMERA_TO_POSE[name])
            for name in rig.CAMERAS
        }

    def pose(self, frame: int) -> NDArray[np.float64]:
        """Vehicle to scene, 4×4."""
        return self._model.drive.pose_to_world(np.array([frame * FRAME_INTERVAL_S]))[0]

    def _camera_pose(self, camera: str, frame: int, to_the_left_m: int = 0) -> NDArray[np.float64]:
        """Camera to scene, 4×4, with the whole car moved to its left."""
        sideways = np.eye(4)
        sideways[1, 3] = -to_the_left_m
        return self.pose(frame) @ sideways @ rig.CAMERA_TO_POSE[camera]

    def write_once(self) -> None:
        """Calibration, timestamps, poses, masks: what does not belong to one frame."""
        root, frames = self.options.output, range(self.options.frames)
        rig.write_calibration(root / "calibration", self.options.size)
        for path in self.paths.timestamps():
            write_text(path, _timestamps(self.options.frames))
        to_world = np.eye(4)
        to_world[:3, 3] = WORLD_ORIGIN_M
        poses = [to_world @ self.pose(frame) for frame in frames]
        folder = root / "data_poses" / self.options.sequence
        write_text(folder / "poses.txt", "".join(_row(frame, poses[frame][:3]) for frame in frames))
        cam0 = rig.CAMERA_TO_POSE["image_00"]
        write_text(folder / "cam0_to_world.txt", "".join(_row(frame, poses[frame] @ cam0) for frame in frames))
        for name, camera in self.cameras.items():
            write_mask(root / "truth" / "masks" / f"{name}_lens.png", camera.lens)
            write_mask(root / "truth" / "masks" / f"{name}_ego.png", ~camera.own_car)
            write_mask(root / "truth" / "masks" / f"{name}.png", camera.lens & ~camera.own_car)
        shifted = {
            str(shift): {
                name: {
                    str(frame): (to_world @ self._camera_pose(name, frame, shift)).tolist()
                    for frame in frames
                    if held_out(frame)
                }
                for name in rig.CAMERAS
            }
            for shift in SHIFTS_M
        }
        # last: where it is, the others are
        write_json(self.paths.shifted(), shifted)

    def write_sweep(self, frame: int) -> None:
        rng = np.random.default_rng([self.options.seed, 20, frame])
        taken = sweep(self._world, self._model.drive, frame * FRAME_INTERVAL_S, rng)
        write_bytes(self.paths.sweep(frame), taken.raw.astype("<f4").tobytes())
        write_bytes(self.paths.points(frame), taken.deskewed.astype("<f4").tobytes())

    def write_pictures(self, name: str, frame: int) -> None:
        number, camera, time_s = rig.CAMERAS.index(name), self.cameras[name], frame * FRAME_INTERVAL_S
        for shift in SHIFTS_M if held_out(frame) else ():
            pose = self._camera_pose(name, frame, shift)
            view = camera.view(self._world, pose, time_s, with_own_car=False)
            clean = self._world.to_picture(view.radiance)
            write_png(self.paths.truth(name, f"shifted_{shift}m/rgb", frame), to_bytes(clean))
            write_distance_png(self.paths.truth(name, f"shifted_{shift}m/distance", frame), view.distance_m)
        view = camera.view(self._world, self._camera_pose(name, frame), time_s)
        write_distance_png(self.paths.truth(name, "distance", frame), view.distance_m)
        write_png(self.paths.truth(name, "rgb", frame), to_bytes(self._world.to_picture(view.radiance)))
        if self.options.moving:
            write_mask(self.paths.moving_mask(name, frame), ~view.moving)
        estimate = simulated_estimate(
            view.distance_m, camera.own_distance_m, camera.lens, frame, self.options.seed, number
        )
        write_distance_png(self.paths.mono(name, frame), estimate)
        picture = take_picture(self._world, view, self.options.seed, number, frame)
        write_png(self.paths.picture(name, frame), picture)


def take_picture(world: World, view: View, seed: int, camera: int, frame: int) -> NDArray[np.uint8]:
    """A view as the camera's sensor gives it: H×W×3, with exposure drift and noise."""
    rng = np.random.default_rng([seed, 31, camera, frame])
    picture = world.to_picture(view.radiance, _gain(seed, camera, frame))
    noise = rng.standard_normal(picture.shape, np.float32) * np.float32(PICTURE_NOISE)
    return to_bytes(np.maximum(picture, _BLACK_LEVEL) + noise)


def _gain(seed: int, camera: int, frame: int) -> float:
    """The exposure's smooth drift: two slow waves, within ±10 %."""
    rng = np.random.default_rng([seed, 30, camera])
    phases, periods = rng.uniform(0, 2 * np.pi, 2), rng.uniform((4.0, 1.7), (7.0, 2.9))
    time_s = frame * FRAME_INTERVAL_S
    waves = np.sin(2 * np.pi * time_s / periods + phases) * (0.7, 0.3)
    return float(1 + _EXPOSURE_DRIFT * waves.sum())


def to_bytes(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Picture values of 0-1 as bytes."""
    return np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)


def synthesize_drive(options: SynthesizeOptions) -> Path:
    """Synthesise a drive; a run that was interrupted is continued, file by file.

    The same options give the same bytes, whether at once or continued.

    Returns:
        The output folder: the root for `process kitti360`, or for the converter of the layout.

    Raises:
        InputError: an option is out of range, or the output folder holds something else.

    """
    options.check()
    _open_folder(options)
    if options.layout != "kitti-360":
        from edge_depth_nerf.synthetic.rig_drive import synthesize_rig_drive

        synthesize_rig_drive(options)
        return options.output
    paths = _Paths(options.output, options.sequence)

    def lacks(files: list[Path]) -> bool:
        return not all(path.is_file() for path in files)

    missing: list[Job] = []
    for frame in range(options.frames):
        if lacks(paths.of_sweep(frame)):
            missing.append((frame, None))
        for camera in rig.CAMERAS:
            if lacks(paths.of_camera(camera, frame, options.moving > 0)):
                missing.append((frame, camera))
    if not missing and paths.shifted().is_file():
        _log.info("%s: complete", options.output)
        return options.output
    with Console().status(f"Building the {options.scene} …"):
        synthesis = _Synthesis(options)
        synthesis.write_once()
    for frame, camera in shown(missing, options):
        if camera is None:
            synthesis.write_sweep(frame)
        else:
            synthesis.write_pictures(camera, frame)
    return options.output


def shown(missing: list[Job], options: SynthesizeOptions) -> Iterator[Job]:
    """Go through what is to be made, and show how far it is."""
    with progress_bars(Console(), counted=True) as progress:
        task = progress.add_task(f"{options.scene}: pictures and sweeps", total=len(missing))
        for job in missing:
            yield job
            progress.advance(task)
