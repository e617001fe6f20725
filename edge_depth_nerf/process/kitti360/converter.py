"""A KITTI-360 drive, real or synthesised, as a recording.

Read from the data set's folder, for each frame number f:

    calibration/{image_02.yaml,image_03.yaml,calib_cam_to_pose.txt,calib_cam_to_velo.txt}
    data_2d_raw/SEQUENCE/image_02/data_rgb/f.png     and image_02/timestamps.txt, if it is there
    data_3d_raw/SEQUENCE/velodyne_points/data/f.bin
    data_poses/SEQUENCE/poses.txt
    truth/SEQUENCE/…                                 what only synthesised drives have

Frames: scanner → vehicle by inv(cam_0→velo) and cam_0→pose; camera → vehicle by cam→pose. cam0_to_world.txt is of the
rectified camera 0 and not used. The cameras fire when the laser faces forward, so frame f's picture and sweep share
their time; the scanner turns clockwise, once a frame. Files are checked by their sizes and headers alone, so that a
drive of thousands of frames takes seconds.
"""

from __future__ import annotations

import re
import statistics
from collections.abc import Collection, Iterable
from functools import partial
from pathlib import Path

import numpy as np

from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.lidar import SweepTiming
from edge_depth_nerf.lidar.scans import ScanFormat, check_scan, read_scan
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.kitti360.calibration import read_poses, read_rig
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.process.poses import read_frame_times, transform_of_rows
from edge_depth_nerf.process.reading import load_distance, load_picture
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.scene.checks import Tolerance, check_distance, check_size, require_folder
from edge_depth_nerf.scene.writer import DistanceMap, Picture, ShiftedView, Skipped, summarise

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
    cameras, velo_to_pose = read_rig(drive.calibration, options.cameras)
    poses = read_poses(drive.poses) if options.poses == "recorded" else None
    kept, skipped = drive.select(poses)
    tolerance = Tolerance(options.strict, len(kept))
    # a picture's sweeps are checked against those around them, as far again; a path is followed without gaps
    near = partial(_near, reach=2 * options.sweeps, between=options.poses != "recorded")
    numbers = near(np.array(sorted(_numbered(drive.sweeps, ".bin"))), np.array(sorted({frame for _, frame in kept})))
    whole = set()
    for number in numbers.tolist():
        with tolerance.of(number, SCANNER):
            check_scan(drive.sweep_file(number), ScanFormat())
            whole.add(number)
    # a frame needs a sweep of its own
    kept = [(name, frame) for name, frame in kept if frame in whole]
    if not kept:
        raise InputError(f"{tolerance.left_out[0].fault} No other frame is chosen: choose more by --frames.")
    frames = sorted({frame for _, frame in kept})
    stamps = {name: drive.read_timestamps(name, frames) for name in options.cameras}
    clock = _Clock(next((times for times in stamps.values() if times), []))
    pictures = []
    for name, frame in kept:
        pose = None if poses is None else poses[frame] @ cameras[name].to_vehicle
        stamp = stamps[name][frame] if stamps[name] else None
        with tolerance.of(frame, name):
            picture = drive.picture(cameras[name], frame)
            pictures.append(picture(time_s=clock.time_s(frame), camera_to_world=pose, timestamp_s=stamp))
    timing = SweepTiming(clock.interval_s)
    sweeps = [
        RecordedSweep(
            path=drive.sweep_file(number),
            time_s=clock.time_s(number),
            frame=number,
            scanner=SCANNER,
            to_vehicle=velo_to_pose,
            read=partial(read_scan, drive.sweep_file(number), ScanFormat()),
            timing=timing,
        )
        for number in near(np.array(sorted(whole)), np.array(frames)).tolist()
    ]
    return Recording(
        cameras=tuple(cameras.values()),
        pictures=tuple(pictures),
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
        shifted=tuple(_shifted_views(drive, cameras, {(picture.camera, picture.frame) for picture in pictures})),
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
    with found_in(str(path)):
        return Trajectory(times_s, np.stack([poses[frame] for frame in frames]))


def _near(numbers: np.ndarray, frames: np.ndarray, reach: int, between: bool) -> np.ndarray:
    """Those numbers that are at most so far from a frame, or also all between the first frame and the last."""
    after = np.searchsorted(frames, numbers).clip(max=len(frames) - 1)
    before = (after - 1).clip(min=0)
    apart = np.minimum(np.abs(frames[after] - numbers), np.abs(frames[before] - numbers))
    inside = (numbers >= frames[0]) & (numbers <= frames[-1])
    return numbers[(apart <= reach) | (inside & between)]


def _shifted_views(
    drive: Kitti360Drive, cameras: dict[str, RecordedCamera], taken: set[tuple[str, int]]
) -> list[ShiftedView]:
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
        if not re.fullmatch(r"-?[0-9]{1,3}(\.[0-9]{1,2})?", metres):
            raise InputError(f"{where}: expected a number of metres. Synthesise the drive again.")
        camera_to_world = transform_of_rows(matrix, where)
        folder = drive.truth / name / f"shifted_{metres}m"
        picture, distance = (folder / kind / f"{frame:010d}.png" for kind in ("rgb", "distance"))
        check_size(picture, cameras[name].camera)
        check_distance(distance, cameras[name].camera)
        views.append(
            ShiftedView(
                metres=float(metres),
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


class Kitti360Drive:
    """The drive that some options name, on disk: which of its frames are complete, and checks of its files.

    Raises:
        FileNotFoundError: a folder is missing.
        InputError: other cameras than the fisheyes are asked for.
    """

    def __init__(self, options: Kitti360Options) -> None:
        names = options.cameras
        if not (len(set(names)) == len(names) > 0 and set(names) <= {"image_02", "image_03"}):
            raise InputError(f"--cameras {' '.join(names)}: expected image_02, image_03 or both.")
        root, sequence = options.root, options.sequence
        self.options = options
        self.calibration = root / "calibration"
        self.poses = root / "data_poses" / sequence / "poses.txt"
        self.sweeps = root / "data_3d_raw" / sequence / "velodyne_points" / "data"
        self.images = root / "data_2d_raw" / sequence
        self.truth = root / "truth" / sequence
        self.has_truth = self.truth.is_dir()

        require_folder(root, "--root takes the data set's folder, which holds calibration, data_2d_raw and so on")
        of_sequence = ["data_2d_raw", "data_3d_raw", *(["data_poses"] if options.poses == "recorded" else [])]
        for folder in ("calibration", *of_sequence):
            require_folder(root / folder, f"--root {root} is not the data set's folder, or a download is missing")
        for folder in of_sequence:
            require_folder(root / folder / sequence, "--sequence needs one of these names")
        for name in options.cameras:
            require_folder(self.image_folder(name), f"the pictures of {name} belong there; or leave out that camera")
        require_folder(self.sweeps, "the LiDAR sweeps belong there")
        for option, folder in (("--mono", options.mono), ("--frame-masks", options.frame_masks)):
            if folder is not None:
                for name in options.cameras:
                    require_folder(folder / name, f"{option} needs a folder with one folder per camera")

    def image_folder(self, camera: str) -> Path:
        """Where the pictures of a camera lie."""
        return self.images / camera / "data_rgb"

    def timestamps_file(self, camera: str) -> Path:
        """Where the times of a camera's pictures are, if anywhere."""
        return self.images / camera / "timestamps.txt"

    def select(self, posed: Collection[int] | None) -> tuple[list[tuple[str, int]], list[Skipped]]:
        """Choose the pictures (camera, frame) that have all they need, in order of frames.

        `posed` are frames that have a pose; None = poses are still to be found.

        Raises:
            InputError: the options reach beyond the drive, or nothing that they ask for is complete.
        """
        options = self.options
        images = {name: _numbered(self.image_folder(name), ".png") for name in options.cameras}
        sweeps = _numbered(self.sweeps, ".bin")
        present = set().union(*images.values())
        if not present:
            folders = ", ".join(str(self.image_folder(name)) for name in options.cameras)
            raise InputError(f"{folders}: no pictures with names like 0000000123.png in it.")
        there = f"the pictures of {options.sequence} are of frames {min(present)}"
        frames = options.chosen_frames(max(present), there)
        kept, skipped = [], []
        for frame in frames:
            if posed is not None and frame not in posed:
                skipped.append(Skipped(frame, None, "no pose"))
            elif frame not in sweeps:
                skipped.append(Skipped(frame, None, "no sweep"))
            else:
                kept += [(name, frame) for name in options.cameras if frame in images[name]]
                skipped += [Skipped(frame, name, "no picture") for name in options.cameras if frame not in images[name]]
        if not kept:

            def extent(frames: Collection[int]) -> str:
                return f"of frames {min(frames)} to {max(frames)}" if frames else "of no frame"

            has_poses = "" if posed is None else f"{self.poses} has poses {extent(posed)}, "
            raise InputError(
                f"none of frames {options.first} to {frames.stop - 1} can be used: {summarise(skipped)}. {has_poses}"
                f"{self.sweeps} has sweeps {extent(sweeps)}."
            )
        return kept, skipped

    def sweep_file(self, frame: int) -> Path:
        """The sweep of a frame."""
        return self.sweeps / f"{frame:010d}.bin"

    def picture(self, recorded: RecordedCamera, frame: int) -> partial[RecordedPicture]:
        """Find a picture and what its maps are made from, and check sizes and headers; time and pose are not set.

        Raises:
            FileNotFoundError: a mask, monocular or true map is missing.
            InputError: a file is truncated, or not of its camera's size or kind.
        """
        name, camera, file = recorded.name, recorded.camera, f"{frame:010d}.png"
        truth_distance, truth_rgb = (
            self.truth / name / kind / file if self.has_truth else None for kind in ("distance", "rgb")
        )
        check_size(self.image_folder(name) / file, camera)
        mono, mask = self.options.map_of(name, frame, "mono"), self.options.map_of(name, frame, "frame_masks")
        for path in (truth_distance, truth_rgb):
            if path is not None and not path.is_file():
                raise FileNotFoundError(
                    f"{path}: no such file; the drive's ground truth is incomplete. Synthesise the drive again, or "
                    f"move {self.truth} away to continue without it."
                )
        for path in (mask, truth_rgb):
            if path is not None:
                check_size(path, camera)
        for path in (mono, truth_distance):
            if path is not None:
                check_distance(path, camera)
        return partial(
            RecordedPicture,
            camera=name,
            frame=frame,
            path=self.image_folder(name) / file,
            mask=mask,
            mono=mono,
            truth_distance=truth_distance,
            truth_rgb=truth_rgb,
        )

    def read_timestamps(self, camera: str, frames: Iterable[int]) -> list[float]:
        """Read the times of a camera's frames from 0 on, seconds since 1970; empty where the drive has no such file.

        Raises:
            InputError: a line is not a time, or one of the `frames` has no line.
        """
        path = self.timestamps_file(camera)
        if not path.is_file():
            return []
        times = read_frame_times(path, ", or move it away: frames then count as 0.1 s apart")
        if missing := [frame for frame in frames if frame >= len(times)]:
            raise InputError(
                f"{path}: ends after line {len(times)}, but frame {missing[0]} needs line {missing[0] + 1}. The file "
                "is truncated; copy it again from the data set."
            )
        return times


def _numbered(folder: Path, suffix: str) -> set[int]:
    return {int(entry.stem) for entry in folder.glob(f"*{suffix}") if re.fullmatch(r"\d{10}", entry.stem)}
