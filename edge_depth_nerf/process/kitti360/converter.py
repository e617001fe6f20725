"""A KITTI-360 drive, real or synthesised, as a recording.

Read from the data set's folder, for each frame number f:

    calibration/{image_02.yaml,image_03.yaml,calib_cam_to_pose.txt,calib_cam_to_velo.txt}
    data_2d_raw/SEQUENCE/image_02/data_rgb/f.png     and image_02/timestamps.txt, if it is there
    data_2d_semantics/train/SEQUENCE/image_02/semantic/f.png    label ids, where there are any
    data_3d_raw/SEQUENCE/velodyne_points/data/f.bin
    data_poses/SEQUENCE/poses.txt
    truth/SEQUENCE/…                                 what only synthesised drives have

Frames: scanner → vehicle by inv(cam_0→velo) and cam_0→pose; camera → vehicle by cam→pose. cam0_to_world.txt is of the
rectified camera 0 and not used. The cameras fire when the laser faces forward, so frame f's picture and sweep share
their time; the scanner turns clockwise, once a frame. Everything is checked by sizes and headers.
"""

from __future__ import annotations

import re
import statistics
from functools import partial
from pathlib import Path

import numpy as np

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.lidar import SweepTiming, check_sweep_size, read_sweep
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.kitti360.calibration import Kitti360Rig, read_poses, read_rig
from edge_depth_nerf.process.kitti360.drive import Kitti360Drive
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.process.poses import transform_of_rows
from edge_depth_nerf.process.reading import load_distance, load_picture
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.scene.checks import Tolerance, check_distance, check_size
from edge_depth_nerf.scene.writer import DistanceMap, Picture, ShiftedView

SCANNER = "velodyne"
"""Name of the scanner."""
FRAME_INTERVAL_S = 0.1
"""Between frames, and of one turn of the scanner, where the drive brings no timestamps."""


def read_kitti360(options: Kitti360Options) -> Recording:
    """Find and check what a drive's scene is made of.

    Raises:
        FileNotFoundError: a folder or file of the drive is missing.
        InputError: an option or a file of the drive cannot be used.

    """
    drive = Kitti360Drive(options)
    rig = read_rig(drive.calibration, options.cameras)
    poses = read_poses(drive.poses) if options.poses == "recorded" else None
    kept, skipped = drive.select(poses)
    tolerance = Tolerance(options.strict, len(kept))
    # a picture's sweeps are checked against those around them, as far again; a path is followed without gaps
    near = partial(_near, reach=2 * options.sweeps, between=options.poses != "recorded")
    numbers = near(np.array(sorted(drive.sweep_numbers())), np.array(sorted({frame for _, frame in kept})))
    whole = set()
    for number in numbers.tolist():
        with tolerance.of(number, SCANNER):
            check_sweep_size(drive.sweep_file(number))
            whole.add(number)
    # a moment needs a sweep of its own
    kept = [(name, frame) for name, frame in kept if frame in whole]
    if not kept:
        raise InputError(f"{tolerance.left_out[0].fault} No other frame is chosen: choose more by --frames.")
    files = drive.check_files(rig, kept, tolerance)
    moments = sorted({frame for _, frame in kept})
    stamps = {name: drive.read_timestamps(name, moments) for name in options.cameras}
    clock = _Clock(next((times for times in stamps.values() if times), []))

    pictures = tuple(
        RecordedPicture(
            camera=name,
            frame=frame,
            time_s=clock.time_s(frame),
            camera_to_world=None if poses is None else poses[frame] @ rig.camera_to_pose[name],
            timestamp_s=stamps[name][frame] if stamps[name] else None,
            **vars(found),
        )
        for (name, frame), found in files.items()
    )
    timing = SweepTiming(clock.interval_s)
    sweeps = [
        RecordedSweep(
            path=drive.sweep_file(number),
            time_s=clock.time_s(number),
            frame=number,
            scanner=SCANNER,
            to_vehicle=rig.velo_to_pose,
            read=partial(read_sweep, drive.sweep_file(number)),
            timing=timing,
        )
        for number in near(np.array(sorted(whole)), np.array(moments)).tolist()
    ]
    return Recording(
        cameras=tuple(RecordedCamera(name, rig.cameras[name], rig.camera_to_pose[name]) for name in options.cameras),
        pictures=pictures,
        sweeps=tuple(sweeps),
        trajectory=None if poses is None else _trajectory(poses, clock, drive.poses),
        source={
            "kind": "kitti360",
            "root": options.root.resolve().name,
            "sequence": options.sequence,
            "cameras": list(options.cameras),
        },
        whole_inputs=(
            drive.calibration / "calib_cam_to_pose.txt",
            drive.calibration / "calib_cam_to_velo.txt",
            *([] if poses is None else [drive.poses]),
            *(drive.calibration / f"{name}.yaml" for name in options.cameras),
        ),
        skipped=tuple(skipped),
        left_out=tolerance.left_out,
        notices=tuple(
            f"{drive.timestamps_file(name)}: no such file; the frames of {name} have no timestamp_s."
            for name, times in stamps.items()
            if not times
        ),
        shifted=tuple(_shifted_views(drive, rig, set(files))),
    )


class _Clock:
    """When frames were taken, from the first one of the drive on."""

    def __init__(self, times_s: list[float]) -> None:
        self._times_s = times_s
        steps = np.diff(times_s).tolist()
        self.interval_s = statistics.median(steps) if steps else FRAME_INTERVAL_S

    def time_s(self, frame: int) -> float:
        """The time of a frame; beyond the timestamps, at their usual interval."""
        if not self._times_s:
            return frame * self.interval_s
        last = len(self._times_s) - 1
        return self._times_s[min(frame, last)] - self._times_s[0] + max(frame - last, 0) * self.interval_s


def _trajectory(poses: dict[int, np.ndarray], clock: _Clock, path: Path) -> Trajectory:
    frames = sorted(poses)
    times_s = np.array([clock.time_s(frame) for frame in frames])
    try:
        return Trajectory(times_s, np.stack([poses[frame] for frame in frames]))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _near(numbers: np.ndarray, moments: np.ndarray, reach: int, between: bool) -> np.ndarray:
    """Those numbers that are at most so far from a frame, or also all between the first frame and the last."""
    after = np.searchsorted(moments, numbers).clip(max=len(moments) - 1)
    before = (after - 1).clip(min=0)
    apart = np.minimum(np.abs(moments[after] - numbers), np.abs(moments[before] - numbers))
    inside = (numbers >= moments[0]) & (numbers <= moments[-1])
    return numbers[(apart <= reach) | (inside & between)]


def _shifted_views(drive: Kitti360Drive, rig: Kitti360Rig, taken: set[tuple[str, int]]) -> list[ShiftedView]:
    """Find the true views beside the path, of the frames taken."""
    path = drive.truth / "shifted.json"
    if not path.is_file():
        return []
    try:
        poses = {
            (metres, name, int(frame)): matrix
            for metres, cameras in read_json(path).items()
            for name, frames in cameras.items()
            for frame, matrix in frames.items()
        }
    except (AttributeError, ValueError):
        raise InputError(f"{path}: expected poses by metres, camera and frame. Synthesise the drive again.") from None
    views = []
    for (metres, name, frame), matrix in poses.items():
        if (name, frame) not in taken:
            continue
        where = f"{path}: {metres} m, {name}, frame {frame}"
        # they become the name of a folder
        if not re.fullmatch(r"-?[0-9]{1,3}", metres):
            raise InputError(f"{where}: expected a whole number of metres. Synthesise the drive again.")
        camera_to_world = transform_of_rows(matrix, where)
        folder = drive.truth / name / f"shifted_{metres}m"
        picture, distance = (folder / kind / f"{frame:010d}.png" for kind in ("rgb", "distance"))
        check_size(picture, rig.cameras[name])
        check_distance(distance, rig.cameras[name])
        views.append(
            ShiftedView(
                metres=int(metres),
                camera=name,
                frame=frame,
                camera_to_world=camera_to_world,
                content=partial(_load_shifted, picture, distance, drive.options.downscale),
                inputs=(picture, distance),
            )
        )
    return views


def _load_shifted(picture: Path, distance: Path, factor: int) -> tuple[Picture, DistanceMap]:
    return load_picture(picture, factor), load_distance(distance, factor)
