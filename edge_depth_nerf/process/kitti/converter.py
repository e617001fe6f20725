"""A drive of KITTI's raw data (synced and rectified), or a sequence of its odometry benchmark, as a recording.

Read from the data set's folder, for each frame number f (k = 0 to 3; DAY = 2011_09_26, DRIVE = DAY_drive_0005_sync):

    DAY/calib_cam_to_cam.txt, calib_velo_to_cam.txt, calib_imu_to_velo.txt
    DAY/DRIVE/image_0k/data/f.png                  ten digits
    DAY/DRIVE/velodyne_points/data/f.bin           and timestamps.txt: a time for each frame
    DAY/DRIVE/oxts/data/f.txt                      GPS and IMU

    sequences/NN/image_k/f.png                     six digits; calib.txt, times.txt
    sequences/NN/velodyne/f.bin
    poses/NN.txt                                   of camera 0, a line for each frame

All of it becomes the description of a rig, and the rest is as for any rig. The vehicle's frame is the IMU's, or in the
odometry benchmark that of the rectified camera 0, whose world has y down.

Everything of a frame gets one time, that of the scanner facing forward (velodyne_points/timestamps.txt), because it
triggers the cameras then. image_0k/timestamps.txt are some 10 ms later and not used. That time is the middle of the
scanner's turn, which begins behind the vehicle and goes clockwise; the next turn begins where it ends. The points of a
file are sorted, so their order does not tell the direction. The odometry benchmark's sweeps are corrected for the
vehicle's motion already.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.base.files import picture_head
from edge_depth_nerf.cameras.transforms import Transform, check_rigid, rigid
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.kitti.calibration import matrix_of, read_oxts, read_projection, read_rigid, read_values
from edge_depth_nerf.process.options import KittiOptions
from edge_depth_nerf.process.poses import read_frame_times, transform_of_rows
from edge_depth_nerf.process.poses import read_kitti as read_kitti_poses
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.rig import Numbered, recording_of_rig, upright_world
from edge_depth_nerf.process.rig_file import rig_of
from edge_depth_nerf.scene.checks import require_folder

SCANNER = "velodyne"
"""Name of the scanner."""
CAMERAS = ("image_00", "image_01", "image_02", "image_03")
"""Names of the cameras."""


@dataclass(frozen=True)
class _Layout:
    """What a drive's files say, whichever layout they have."""

    calibration: tuple[Path, ...]
    """Files whose bytes decide about the scene."""
    times_file: Path
    times_s: Sequence[float]
    lenses: dict[str, tuple[dict[str, float], Transform]]
    """Of the cameras: their numbers, and from their frames to the rectified camera 0."""
    sizes: dict[str, list[int]]
    """Width and height of their pictures, where the calibration has them."""
    folders: dict[str, Path]
    """Of the cameras' pictures."""
    scans: Path
    """Folder of the scanner's files."""
    velodyne_to_camera_0: Transform
    """To the rectified camera 0."""
    camera_0_to_vehicle: Transform
    """From the rectified camera 0."""
    scanner: dict[str, Any]
    """What is known of the scanner's turn."""
    poses_file: Path
    """Or their folder."""
    poses: Callable[[], dict[int, Transform]]
    """Reads the vehicle's poses, to a world with z up, by frames."""


def read_kitti(options: KittiOptions) -> Recording:
    """Find and check what the scene of a drive is made of.

    Raises:
        FileNotFoundError: a folder or file of the drive is missing.
        InputError: an option or a file of the drive cannot be used.
    """
    names = options.cameras
    if not (len(set(names)) == len(names) > 0 and set(names) <= set(CAMERAS)):
        raise InputError(f"--cameras {' '.join(names)}: expected some of {', '.join(CAMERAS)}.")
    require_folder(options.root, "--root takes the data set's folder")
    if re.fullmatch(r"[0-9]{2}", options.sequence):
        layout = _odometry(options)
    elif re.fullmatch(r"[0-9]{4}_[0-9]{2}_[0-9]{2}_drive_[0-9]{4}_sync", options.sequence):
        layout = _raw(options)
    else:
        unsynced = "Download the synced and rectified one. " if options.sequence.endswith("_extract") else ""
        raise InputError(
            f"--sequence {options.sequence}: expected a drive of the raw data such as 2011_09_26_drive_0005_sync, or a "
            f"sequence of the odometry benchmark such as 07. {unsynced}".rstrip()
        )
    path, pose_files = None, []
    if options.poses == "recorded":
        path = _path(layout)
        pose_files = [layout.poses_file] if layout.poses_file.is_file() else sorted(layout.poses_file.glob("*.txt"))
    rig = rig_of(_description(layout, options), layout.calibration[0], options.root)
    recording = recording_of_rig(rig, options, "kitti", Numbered(layout.times_s, path))
    return replace(
        recording,
        source={**recording.source, "sequence": options.sequence},
        whole_inputs=(*layout.calibration, layout.times_file, *pose_files),
    )


def _description(layout: _Layout, options: KittiOptions) -> dict[str, Any]:
    """The tables of a rig file that say the same."""
    times_file = str(layout.times_file.relative_to(options.root))

    def mounted(to_camera_0: Transform) -> list[list[float]]:
        return (layout.camera_0_to_vehicle @ to_camera_0).tolist()

    cameras = {}
    for name, (lens, to_camera_0) in layout.lenses.items():
        first = min(layout.folders[name].glob("*.png"), default=None)
        if first is None:
            raise FileNotFoundError(f"{layout.folders[name]}: no .png; the pictures of {name} belong there.")
        width, height, *_ = picture_head(first)
        # it differs from day to day
        if layout.sizes and (size := layout.sizes[name]) != [width, height]:
            raise InputError(
                f"{layout.calibration[0]}: S_rect_{name[-2:]} is {'×'.join(map(str, size)) or 'missing'}, but {first} "
                f"has {width}×{height} pixels. The calibration is of another day, or the pictures were resized."
            )
        cameras[name] = {
            **{"images": str(layout.folders[name].relative_to(options.root)), "times_file": times_file},
            **{"model": "pinhole", "width": width, "height": height, **lens, "to_vehicle": mounted(to_camera_0)},
        }
    scanner = {
        **{"scans": str(layout.scans.relative_to(options.root) / "*.bin"), "times_file": times_file},
        **{"to_vehicle": mounted(layout.velodyne_to_camera_0), **layout.scanner},
    }
    return {"cameras": cameras, "lidars": {SCANNER: scanner}}


def _path(layout: _Layout) -> Trajectory:
    poses = layout.poses()
    frames, lines = sorted(poses), len(layout.times_s)
    if frames and frames[-1] >= lines:
        raise InputError(
            f"{layout.times_file}: ends after line {lines}, but {layout.poses_file} has a pose of frame {frames[-1]}, "
            f"which needs line {frames[-1] + 1}. The file is truncated; copy it again from the data set."
        )
    with found_in(str(layout.poses_file)):
        return Trajectory(
            np.array([layout.times_s[frame] for frame in frames], np.float64),
            np.array([poses[frame] for frame in frames], np.float64).reshape(-1, 4, 4),
        )


def _raw(options: KittiOptions) -> _Layout:
    """What a drive of the raw data says."""
    day = options.root / options.sequence[:10]
    drive = day / options.sequence
    require_folder(day, f"--root {options.root} is not the data set's folder, or the drive is not downloaded")
    require_folder(drive, "--sequence needs one of these names")
    folders = {name: drive / name / "data" for name in options.cameras}
    for name, folder in folders.items():
        require_folder(folder, f"the pictures of {name} belong there; or leave out that camera")
    lenses_file, velo_file, imu_file = (
        day / f"calib_{between}.txt" for between in ("cam_to_cam", "velo_to_cam", "imu_to_velo")
    )
    values = read_values(lenses_file)
    lenses = {name: read_projection(values, f"P_rect_{name[-2:]}", lenses_file) for name in options.cameras}
    # from camera 0 to the rectified camera 0
    turn = rigid(matrix_of(values, "R_rect_00", (3, 3), lenses_file))
    check_rigid(turn, f"{lenses_file}: R_rect_00")
    velodyne_to_camera_0 = turn @ read_rigid(velo_file)
    scans = drive / "velodyne_points"
    times_file = scans / "timestamps.txt"
    times_s = read_frame_times(times_file)
    turn_s = statistics.median(np.diff(times_s).tolist()) if len(times_s) > 1 else 0.1
    return _Layout(
        calibration=(lenses_file, velo_file, imu_file),
        times_file=times_file,
        times_s=times_s,
        lenses=lenses,
        sizes={name: values.get(f"S_rect_{name[-2:]}", np.zeros(0)).astype(int).tolist() for name in options.cameras},
        folders=folders,
        scans=scans / "data",
        velodyne_to_camera_0=velodyne_to_camera_0,
        camera_0_to_vehicle=np.linalg.inv(velodyne_to_camera_0 @ read_rigid(imu_file)),
        scanner={"turn_s": turn_s, "timestamp": "middle", "direction": "clockwise", "start_azimuth_deg": 180},
        poses_file=drive / "oxts" / "data",
        poses=lambda: read_oxts(drive / "oxts" / "data"),
    )


def _odometry(options: KittiOptions) -> _Layout:
    """What a sequence of the odometry benchmark says."""
    root = options.root
    sequence = root / "sequences" / options.sequence
    require_folder(root / "sequences", f"--root {root} is not the folder of the odometry benchmark (named dataset)")
    require_folder(sequence, "--sequence needs one of these names")
    folders = {name: sequence / f"image_{name[-1]}" for name in options.cameras}
    for name, folder in folders.items():
        require_folder(folder, f"the pictures of {name} belong there; or leave out that camera")
    calibration, times_file = sequence / "calib.txt", sequence / "times.txt"
    poses_file = root / "poses" / f"{options.sequence}.txt"
    values = read_values(calibration)
    upright = upright_world("-y")

    def poses() -> dict[int, Transform]:
        if not poses_file.is_file():
            raise FileNotFoundError(
                f"{poses_file}: no such file; sequences from 11 on have none. Copy it, or compute poses: --poses lidar."
            )
        return {frame: upright @ pose for frame, pose in enumerate(read_kitti_poses(poses_file))}

    return _Layout(
        calibration=(calibration,),
        times_file=times_file,
        times_s=read_frame_times(times_file),
        lenses={name: read_projection(values, f"P{name[-1]}", calibration) for name in options.cameras},
        sizes={},
        folders=folders,
        scans=sequence / "velodyne",
        velodyne_to_camera_0=transform_of_rows(matrix_of(values, "Tr", (3, 4), calibration), f"{calibration}: Tr"),
        camera_0_to_vehicle=np.eye(4),
        scanner={"corrected_to": "timestamp"},
        poses_file=poses_file,
        poses=poses,
    )
