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

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.console import in_turn
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    open_folder,
    read_json_object,
    remove_leftovers,
    write_json,
    write_mask,
    write_text,
)
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.synthetic import rig
from edge_depth_nerf.synthetic.layout import WORLD_ORIGIN_M, DriveLayout, MountedCamera, held_out
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.rig_drive import RIG_FILE_LAYOUTS

VERSION = 1
"""Version of what is synthesised: drives of different versions do not mix in one folder."""

_MANIFEST = "drive.json"
_FIRST_TIME = np.datetime64("2013-05-28T08:46:02.123456789")

_log = logging.getLogger(__name__)


_ONCE_ONLY: dict[str, Any] = {"layout": "kitti-360", "shifts_m": [1.0, 2.0]}
"""What is not written into a drive's options: there was no other choice once."""


def _manifest(options: SynthesizeOptions) -> dict[str, Any]:
    fields: dict[str, Any] = {name: getattr(options, name) for name in ("scene", "frames", "size", "seed")}
    fields["moving"] = 0  # drives could have more cars once
    given = {"shifts_m": [float(shift_m) for shift_m in options.shifts_m], "layout": options.layout}
    fields |= {name: value for name, value in given.items() if _ONCE_ONLY[name] != value}
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
    path = folder / _MANIFEST
    if path.is_file() and (there := read_json_object(path)) != manifest:
        old, new = ({**_ONCE_ONLY, **found.get("options", {})} for found in (there, manifest))
        changed = [
            f"{name} is {old.get(name)!r} there and {new.get(name)!r} here"
            for name in {**new, **old}
            if old.get(name) != new.get(name)
        ]
        raise InputError(
            f"{folder}: contains a drive with other options ({'; '.join(changed) or 'made by another version'}). "
            "Choose another --output, or the same options to continue it."
        )
    open_folder(folder, path, manifest, "drives")
    remove_leftovers(folder)


def _row(frame: int, matrix: NDArray[np.float64]) -> str:
    return " ".join([str(frame), *(f"{value:.10f}" for value in matrix.reshape(-1))]) + "\n"


class _Kitti360(DriveLayout):
    """The layout `kitti-360`."""

    def __init__(self, options: SynthesizeOptions) -> None:
        mounted = {
            name: MountedCamera(rig.camera(name, options.size), rig.CAMERA_TO_POSE[name]) for name in rig.CAMERAS
        }
        truth = "truth/{sequence}/{name}"
        paths = {
            "picture": "data_2d_raw/{sequence}/{name}/data_rgb/{frame:010d}.png",
            "mono": "simulated_mono/{sequence}/{name}/{frame:010d}.png",
            "truth_distance": truth + "/distance/{frame:010d}.png",
            "truth_rgb": truth + "/rgb/{frame:010d}.png",
            "moving_mask": "truth/{sequence}/moving_masks/{name}/{frame:010d}.png",
            "scan": "data_3d_raw/{sequence}/velodyne_points/data/{frame:010d}.bin",
            "true_points": "truth/{sequence}/points/{frame:010d}.bin",
        }
        for shift_m in options.shifts_m:
            for kind in ("rgb", "distance"):
                paths[f"shifted_{shift_m:g}_{kind}"] = f"{truth}/shifted_{shift_m:g}m/{kind}/{{frame:010d}}.png"
        super().__init__(options, mounted, paths)
        self.last_file = self.root / "truth" / options.sequence / "shifted.json"

    def write_once(self) -> None:
        root, sequence, frames = self.root, self.options.sequence, range(self.options.frames)
        rig.write_calibration(root / "calibration", self.options.size)
        times = _FIRST_TIME + np.array(frames) * np.timedelta64(round(FRAME_INTERVAL_S * 1e9), "ns")
        pictures, scans = root / "data_2d_raw" / sequence, root / "data_3d_raw" / sequence
        for folder in (*(pictures / name for name in self.cameras), scans / "velodyne_points"):
            write_text(folder / "timestamps.txt", "".join(f"{time}\n" for time in times).replace("T", " "))
        to_world = rigid(np.eye(3), WORLD_ORIGIN_M)
        poses = to_world @ self.drive.pose_to_world(np.array(frames) * FRAME_INTERVAL_S)
        folder = root / "data_poses" / sequence
        write_text(folder / "poses.txt", "".join(_row(frame, poses[frame][:3]) for frame in frames))
        cam0 = rig.CAMERA_TO_POSE["image_00"]
        write_text(folder / "cam0_to_world.txt", "".join(_row(frame, poses[frame] @ cam0) for frame in frames))
        for name, camera in self.views.items():
            masks = {"_lens": camera.lens, "_ego": ~camera.own_car, "": camera.lens & ~camera.own_car}
            for kind, mask in masks.items():
                write_mask(root / "truth" / "masks" / f"{name}{kind}.png", mask)
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
    # of each frame its scan, then its pictures
    jobs = [(frame, name) for frame in range(options.frames) for name in (None, *drive.cameras)]
    missing = [job for job in jobs if not all(path.is_file() for path in drive.files(*job).values())]
    if not missing and drive.last_file.is_file():
        _log.info("%s: complete", options.output)
        return options.output
    with Console().status(f"Building the {options.scene} …"):
        drive.build()
        drive.write_once()
    for job in in_turn(missing, f"{options.scene}: pictures and sweeps", Console()):
        drive.write(*job)
    return options.output
