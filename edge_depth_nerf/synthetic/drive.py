"""Writing a synthetic drive in KITTI-360's raw layout, with the ground truth beside it.

Under the output folder, with SEQ the sequence, k = 2 (left), 3 (right) and ten-digit frame numbers:

    drive.json                                    the options, written first; marks the folder as a drive
    calibration/                                  KITTI-360's files, MEI scaled to the picture size
    data_2d_raw/SEQ/image_0k/data_rgb/*.png       pictures with exposure drift and noise; timestamps.txt
    data_3d_raw/SEQ/velodyne_points/data/*.bin    float32 x, y, z, reflectance, raw; timestamps.txt
    data_poses/SEQ/poses.txt, cam0_to_world.txt   vehicle and camera 0 to world (camera 0 as if it were rectified)
    truth/masks/image_0k{_lens,_ego,}.png         255 = keep: inside the lens, not the own car, both
    truth/SEQ/image_0k/distance/*.png             metres along the ray in 1/256 m; 0 = sky, own car, outside the lens
    truth/SEQ/image_0k/rgb/*.png                  pictures without exposure drift and noise
    truth/SEQ/points/*.bin                        the sweep without noise, moved to the frame's time
    truth/SEQ/shifted.json                        camera-to-world poses 1 m and 2 m to the car's left, held-out frames
    truth/SEQ/image_0k/shifted_{1,2}m/{rgb,distance}/*.png   what is seen there, without the own car
    truth/SEQ/moving_masks/image_0k/*.png         255 = keep: nothing that moves; only where something does
    simulated_mono/SEQ/image_0k/*.png             made from the truth with a network's faults; no network's estimate

Frame i is held out if i % 8 == 4. World coordinates are metres, z up, with an origin far away, as KITTI-360's are.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, read_json, write_json, write_mask, write_text
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.synthetic import rig
from edge_depth_nerf.synthetic.layout import WORLD_ORIGIN_M, DriveLayout, MountedCamera
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.rig_drive import RIG_FILE_LAYOUTS

VERSION = 1
"""Version of what is synthesised: drives of different versions do not mix in one folder."""

_MANIFEST = "drive.json"
_FIRST_TIME = datetime(2013, 5, 28, 8, 46, 2)
_FIRST_NANOSECONDS = 123_456_789

Job = tuple[int, str | None]
"""A frame, and a camera; None = its sweep."""

_log = logging.getLogger(__name__)


def held_out(frame: int) -> bool:
    """Whether a frame is for evaluation, not for training."""
    return frame % 8 == 4


_ONCE_ONLY: dict[str, Any] = {"layout": "kitti-360", "shifts_m": [1.0, 2.0]}
"""What is not written into a drive's options: there was no other choice once."""


def _manifest(options: SynthesizeOptions) -> dict[str, Any]:
    fields: dict[str, Any] = dataclasses.asdict(options)
    del fields["output"]
    fields["shifts_m"] = [float(shift_m) for shift_m in options.shifts_m]
    fields = {name: value for name, value in fields.items() if _ONCE_ONLY.get(name) != value}
    fields |= {"speed_m_s": options.mean_speed_m_s, "sequence": options.sequence}
    return {
        "kind": "synthetic drive",
        "version": VERSION,
        "options": fields,
        "note": "Ray-traced, not recorded. simulated_mono/ is made from the true "
        "distances with a depth network's typical errors; it is not a network's estimate.",
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
            old, new = ({**_ONCE_ONLY, **options} for options in (given, manifest["options"]))
            changed = [
                f"{name} is {old.get(name)!r} there and {new.get(name)!r} here"
                for name in dict.fromkeys((*new, *old))
                if old.get(name) != new.get(name)
            ]
            raise InputError(
                f"{folder}: contains a drive with other options ({'; '.join(changed) or 'made by another version'}). "
                "Choose another --output, or the same options to continue it."
            )
        # what an interrupted run was about to write
        for left_over in folder.rglob(".*"):
            if left_over.suffix in (".png", ".bin", ".pcd", ".txt", ".json", ".yaml", ".toml"):
                left_over.unlink()
    elif folder.is_dir() and any(folder.iterdir()):
        names = sorted(entry.name for entry in folder.iterdir())
        raise InputError(
            f"{folder}: contains something that is not a synthetic drive ({', '.join(names[:5])}"
            f"{', ...' if len(names) > 5 else ''}). Choose a new or empty folder as --output."
        )
    write_json(path, manifest)


def _timestamps(frames: int) -> str:
    lines = []
    for frame in range(frames):
        nanoseconds = _FIRST_NANOSECONDS + frame * round(FRAME_INTERVAL_S * 1e9)
        stamp = _FIRST_TIME + timedelta(seconds=nanoseconds // 10**9)
        lines.append(f"{stamp:%Y-%m-%d %H:%M:%S}.{nanoseconds % 10**9:09d}\n")
    return "".join(lines)


def _row(frame: int, matrix: NDArray[np.float64]) -> str:
    return " ".join([str(frame), *(f"{value:.10f}" for value in matrix.reshape(-1))]) + "\n"


class _Kitti360(DriveLayout):
    """The layout `kitti-360`."""

    def __init__(self, options: SynthesizeOptions) -> None:
        mounted = {
            name: MountedCamera(rig.camera(name, options.size), rig.CAMERA_TO_POSE[name]) for name in rig.CAMERAS
        }
        super().__init__(options, mounted)
        self._pictures = self.root / "data_2d_raw" / options.sequence
        self._scans = self.root / "data_3d_raw" / options.sequence / "velodyne_points"
        self._truth = self.root / "truth" / options.sequence
        self.last_file = self._truth / "shifted.json"

    def picture(self, name: str, frame: int) -> Path:
        return self._pictures / name / "data_rgb" / f"{frame:010d}.png"

    def scan(self, frame: int) -> Path:
        return self._scans / "data" / f"{frame:010d}.bin"

    def map(self, kind: str, name: str, frame: int) -> Path:
        mono = self.root / "simulated_mono" / self.options.sequence / name
        folder = mono if kind == "mono" else self._truth / name / kind.removeprefix("truth_")
        return folder / f"{frame:010d}.png"

    def true_points(self, frame: int) -> Path:
        return self._truth / "points" / f"{frame:010d}.bin"

    def moving_mask(self, name: str, frame: int) -> Path | None:
        return self._truth / "moving_masks" / name / f"{frame:010d}.png" if self.options.has_movers else None

    def shifted(self, name: str, frame: int) -> dict[float, tuple[Path, Path]]:
        shifts_m = self.options.shifts_m if held_out(frame) else ()
        folders = {metres: self._truth / name / f"shifted_{metres:g}m" for metres in shifts_m}
        file = f"{frame:010d}.png"
        return {metres: (folder / "rgb" / file, folder / "distance" / file) for metres, folder in folders.items()}

    def write_once(self) -> None:
        frames = range(self.options.frames)
        rig.write_calibration(self.root / "calibration", self.options.size)
        for folder in (*(self._pictures / name for name in self.cameras), self._scans):
            write_text(folder / "timestamps.txt", _timestamps(self.options.frames))
        to_world = rigid(np.eye(3), WORLD_ORIGIN_M)
        poses = to_world @ self.drive.pose_to_world(np.array(frames) * FRAME_INTERVAL_S)
        folder = self.root / "data_poses" / self.options.sequence
        write_text(folder / "poses.txt", "".join(_row(frame, poses[frame][:3]) for frame in frames))
        cam0 = rig.CAMERA_TO_POSE["image_00"]
        write_text(folder / "cam0_to_world.txt", "".join(_row(frame, poses[frame] @ cam0) for frame in frames))
        for name, camera in self.views.items():
            masks = {"_lens": camera.lens, "_ego": ~camera.own_car, "": camera.lens & ~camera.own_car}
            for kind, mask in masks.items():
                write_mask(self.root / "truth" / "masks" / f"{name}{kind}.png", mask)
        shifted = {
            f"{metres:g}": {
                name: {
                    str(frame): (to_world @ self.camera_pose(name, frame * FRAME_INTERVAL_S, metres)).tolist()
                    for frame in frames
                    if held_out(frame)
                }
                for name in self.cameras
            }
            for metres in self.options.shifts_m
        }
        write_json(self.last_file, shifted)


def synthesize_drive(options: SynthesizeOptions) -> Path:
    """Synthesise a drive, and give its folder; a run that was interrupted is continued, file by file.

    The same options give the same bytes, whether at once or continued.

    Raises:
        InputError: an option is out of range, or the output folder holds something else.
    """
    options.check()
    _open_folder(options)
    drive = {"kitti-360": _Kitti360, **RIG_FILE_LAYOUTS}[options.layout](options)
    jobs: list[Job] = [(frame, name) for frame in range(options.frames) for name in (None, *drive.cameras)]
    missing = [job for job in jobs if not all(path.is_file() for path in drive.files(*job))]
    if not missing and drive.last_file.is_file():
        _log.info("%s: complete", options.output)
        return options.output
    with Console().status(f"Building the {options.scene} …"):
        drive.build()
        drive.write_once()
    for job in shown(missing, options):
        drive.write(*job)
    return options.output


def shown(missing: list[Job], options: SynthesizeOptions) -> Iterator[Job]:
    """Go through what is to be made, and show how far it is."""
    with progress_bars(Console(), counted=True) as progress:
        task = progress.add_task(f"{options.scene}: pictures and sweeps", total=len(missing))
        for job in missing:
            yield job
            progress.advance(task)
