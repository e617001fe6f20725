"""Anyone's recording, described by a rig file, as a recording to make a scene of. docs/rig.md is its manual.

Files of a sensor are taken in the order of their names, numbers in them counting as numbers, and get their times as the
rig file says. Pictures of different cameras less than half a picture interval apart form a frame; frames are numbered
from 0 in order of time. A scan belongs to the nearest frame, if that is at most half a turn away.
"""

from __future__ import annotations

import re
import statistics
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64

from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.base.files import DISTANCE_STEPS_PER_METRE, IMAGE_SUFFIXES, as_people_count, largest_of_16_bits
from edge_depth_nerf.cameras.transforms import Transform, rigid
from edge_depth_nerf.lidar import Sweep, transform_points
from edge_depth_nerf.lidar.scans import SCAN_SUFFIXES, check_scan, read_scan
from edge_depth_nerf.lidar.sweeps import usable_points
from edge_depth_nerf.lidar.trajectory import MAX_POSE_GAP_S, Trajectory
from edge_depth_nerf.process.options import JbnuDepth360Options, KittiOptions, RigOptions
from edge_depth_nerf.process.poses import read_kitti, read_nerfstudio, read_times, read_tum
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import DepthFile, RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.process.rig_file import Clock, Rig, RigCamera, RigLidar, RigPoses, read_rig
from edge_depth_nerf.scene.checks import Tolerance, check_picture_size, check_size, require_folder
from edge_depth_nerf.scene.writer import Skipped, summarise

_LOOKED_AT = 5
"""So many of a camera's pictures tell how many bits are used, and so many scans whether any can be read."""
_RIG_FILES = ("rig.toml", "rig.json")
_Options = RigOptions | JbnuDepth360Options | KittiOptions
_MOST_LATE_S = 60.0
"""A scan's points are measured within this time of the scan's own; beyond, their unit or their clock is another."""


@dataclass(frozen=True)
class _Timed:
    """A file of a sensor."""

    path: Path
    time_s: float


@dataclass(frozen=True)
class Numbered:
    """What a data set tells of its frames by their numbers, instead of in files that a rig file names."""

    times_s: Sequence[float]
    """Of frame 0, 1 and so on; the last number in a file's name is its frame."""
    path: Trajectory | None
    """The vehicle's; None if poses are still to be found."""


@dataclass(frozen=True)
class _Scans:
    """The scans of a scanner, in order of time."""

    lidar: RigLidar
    files: list[_Timed]

    @cached_property
    def midpoints_s(self) -> np.ndarray:
        """The middle of each one's turn."""
        return np.array([item.time_s for item in self.files]) + self.lidar.to_middle_s

    @cached_property
    def turn_s(self) -> float:
        """How long a turn takes."""
        return self.lidar.turn_s or min(_interval([item.time_s for item in self.files]), 1.0)

    def nearest(self, time_s: float) -> tuple[int, float]:
        """The scan whose middle is nearest to a time, and how far it is."""
        apart = np.abs(self.midpoints_s - time_s)
        return int(apart.argmin()), float(apart.min())


def read_rig_recording(options: RigOptions) -> Recording:
    """Find and check what the scene of a recording is made of.

    Raises:
        FileNotFoundError: a folder or file of the recording is missing.
        InputError: an option or a file of the recording cannot be used.
    """
    require_folder(options.root, "--root takes the recording's folder")
    there = [options.root / name for name in _RIG_FILES if (options.root / name).is_file()]
    if options.rig is None and len(there) != 1:
        found = " and ".join(path.name for path in there) or "neither"
        raise InputError(
            f"{options.root}: expected {' or '.join(_RIG_FILES)} in it, found {found}. Write one (docs/rig.md shows "
            "how), or name it with --rig."
        )
    rig = read_rig(options.rig or there[0], options.root)
    return recording_of_rig(rig, options, "rig")


def recording_of_rig(rig: Rig, options: _Options, kind: str, numbered: Numbered | None = None) -> Recording:
    """Find and check the files that a rig file describes.

    Args:
        rig: what the file says.
        options: root, the recording's folder; which cameras and frames.
        kind: what the scene says that it is made of.
        numbered: times and path of a data set that has them by the frames' numbers.

    Raises:
        FileNotFoundError: a folder or file of the recording is missing.
        InputError: an option or a file of the recording cannot be used.
    """
    root, cameras = options.root, _chosen(rig, options.cameras)
    files = {camera.name: _timed(_files(root, camera.images, IMAGE_SUFFIXES), camera, numbered) for camera in cameras}
    path, camera_poses, doubled = numbered.path if numbered else None, {}, []
    if options.poses == "recorded" and numbered is None:
        if rig.poses is None:
            raise InputError(
                f"{rig.path}: has no table [poses]. Give poses (docs/rig.md), or compute them: --poses lidar, "
                "--poses colmap."
            )
        path, camera_poses, doubled = _path(rig, rig.poses, cameras, files)
    scans = [_Scans(lidar, _timed(_files(root, lidar.scans, SCAN_SUFFIXES), lidar, numbered)) for lidar in rig.lidars]
    _check_clocks(rig, files, scans, path)

    kept, skipped = _usable(_frames(files), options, path, camera_poses, scans)
    if not kept:
        raise InputError(f"{root}: none of the chosen frames can be used: {summarise(skipped)}.")

    by_name = {camera.name: camera for camera in cameras}
    companions = _Companions(rig.path, cameras, options)
    tolerance = Tolerance(options.strict, sum(map(len, kept.values())))
    recorded = []
    for frame, pictures in sorted(kept.items()):
        for name, picture in sorted(pictures.items()):
            with tolerance.of(frame, name):
                recorded.append(companions.picture(by_name[name], frame, picture, camera_poses.get(picture.path)))
    for camera in cameras:
        _check_bits([picture.path for picture in recorded if picture.camera == camera.name], camera.name)
    frame_times_s = {frame: _time(pictures) for frame, pictures in kept.items()}
    sweeps = _sweeps(scans, frame_times_s, path, options.sweeps, tolerance)
    for camera in cameras:
        if camera.ego_mask:
            check_picture_size(camera.ego_mask, camera.camera)
    return Recording(
        cameras=tuple(RecordedCamera(c.name, c.camera, c.to_vehicle, c.ego_mask) for c in cameras),
        pictures=tuple(recorded),
        sweeps=tuple(sweeps),
        trajectory=path,
        source={"kind": kind, "root": root.resolve().name, "cameras": list(options.cameras)},
        whole_inputs=_whole_inputs(rig, cameras, with_poses=path is not None),
        skipped=tuple(skipped),
        left_out=tolerance.left_out,
        notices=(
            *_doubled(rig.poses, doubled),
            *(
                f"{lidar.name}: neither turn_s with direction nor point_times is given; all its points get one time."
                for lidar in rig.lidars
                if lidar.timing is None and lidar.format.times is None and lidar.corrected_to is None
            ),
            *(_turned_notice(name, counts) for name, counts in companions.turned.items()),
        ),
    )


def _doubled(poses: RigPoses | None, lines: Sequence[int]) -> list[str]:
    """Say which lines of a file of poses are left out."""
    if poses is None or not lines:
        return []
    some = ", ".join(map(str, lines[:5])) + (" …" if len(lines) > 5 else "")
    return [f"{poses.file}: {len(lines)} poses are left out, each of the time of the line before (line {some})."]


def _turned_notice(camera: str, orientations: Counter[int]) -> str:
    found = ", ".join(f"{orientation} in {count}" for orientation, count in sorted(orientations.items()))
    return (
        f"{camera}: pictures have an EXIF orientation ({found} of them), which turns none of them here, as in "
        "nerfstudio and COLMAP. OpenCV's imread turns them: if this camera was calibrated so, turn the files "
        "themselves, as `mogrify -auto-orient` does."
    )


def _check_bits(pictures: list[Path], camera: str) -> None:
    """Refuse pictures of 10, 12 or 14 bits that lie at the lower end of 16.

    Raises:
        InputError: none of some pictures uses the upper bits.
    """
    looked_at = pictures[:: max(1, len(pictures) // _LOOKED_AT)] if pictures else []
    largest = 0
    for path in looked_at:
        if path.suffix.lower() not in (".png", ".tif", ".tiff"):
            return
        found = read_if_whole(partial(largest_of_16_bits, path))
        if found is None:
            return
        largest = max(largest, found)
    bits = next(bits for bits in (10, 12, 14, 16) if largest < 1 << bits)
    if 0 < largest and bits < 16:
        raise InputError(
            f"{looked_at[0]}: 16-bit pictures of {camera}, but the largest value of {len(looked_at)} of them is "
            f"{largest}: {bits} bits at the lower end, so that they would be {1 << (16 - bits)} times too dark. "
            f"Stretch them, as `mogrify -evaluate multiply {1 << (16 - bits)}` does, or write 8 bits."
        )


def _whole_inputs(rig: Rig, cameras: Sequence[RigCamera], *, with_poses: bool) -> tuple[Path, ...]:
    """The files whose bytes decide about the scene: the rig file, poses, times."""
    poses = [rig.poses] if rig.poses and with_poses else []
    times = [clock.times_file for clock in (*cameras, *rig.lidars, *poses)]
    lenses = [camera.calibration.file for camera in cameras if camera.calibration]
    return (rig.path, *(found.file for found in poses), *(path for path in times if path is not None), *lenses)


def _chosen(rig: Rig, names: Sequence[str]) -> list[RigCamera]:
    known = {camera.name: camera for camera in rig.cameras}
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--cameras {unknown[0]}: {rig.path} has no such camera, only {', '.join(known)}.")
    return [known[name] for name in dict.fromkeys(names)] if names else list(rig.cameras)


# ---- files and their times -------------------------------------------------------------------------------------


def _files(root: Path, given: str, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of a folder, or those that a pattern names, in the order of their names."""
    path, parts = root / given, Path(given).parts
    # a folder may be called "left [raw]"
    there = next((number for number in range(len(parts)) if not root.joinpath(*parts[: number + 1]).exists()), 0)
    wild = [number for number, part in enumerate(parts) if number >= there and any(sign in part for sign in "*?[")]
    if wild and not path.is_dir():
        folder = root.joinpath(*parts[: wild[0]])
        try:
            found = [file for file in folder.glob(str(Path(*parts[wild[0] :]))) if file.is_file()]
            # as a shell's *, which leaves out what macOS puts beside each file
            found = [file for file in found if not file.name.startswith(".") or parts[-1].startswith(".")]
        except ValueError as error:
            raise InputError(f"{path}: is not a valid pattern of files ({error}); it is in the rig file.") from None
        what = "no file has such a name"
    elif path.is_dir():
        present = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
        found = [file for file in present if file.suffix.lower() in suffixes]
        if not found and present:
            raise InputError(
                f"{path}: files of unknown format, such as {sorted(present)[0].name}; expected {', '.join(suffixes)}."
            )
        what = "nothing in it"
    else:
        raise FileNotFoundError(f"{path}: no such folder; it is named in the rig file.")
    if not found:
        raise FileNotFoundError(f"{path}: {what}; expected {', '.join(suffixes)} files.")
    return sorted(found, key=lambda file: [as_people_count(Path(part)) for part in file.parts])


def _by_stem(files: list[Path], where: str) -> dict[str, Path]:
    """Files by their names without ending."""
    found = {path.stem: path for path in files}
    if len(found) < len(files):
        twice = next(path for path in files if found[path.stem] != path)
        raise InputError(f"{where}: {twice} and {found[twice.stem]} have one name. Give files of different names.")
    return found


def _number_in(path: Path) -> float:
    numbers = re.findall(r"[0-9]+(?:\.[0-9]+)?", path.stem)
    if not numbers:
        raise InputError(
            f"{path}: no number in its name, but the rig file says that its time is there. Give a times_file."
        )
    return float(numbers[-1])


def _time_in(path: Path) -> float:
    if re.search(r"(?<![0-9])[0-9]{9,10}[^0-9.][0-9]{9}$", path.stem):
        raise InputError(
            f"{path}: its name seems to have seconds and nanoseconds apart, of which the last number alone would be "
            "the time. Rename the files to SECONDS.NANOSECONDS, or give a times_file."
        )
    return _number_in(path)


def _timed(files: list[Path], clock: Clock, numbered: Numbered | None) -> list[_Timed]:
    """Files with their times, in the order of time."""
    if numbered is not None:
        times_s = [_time_of_frame(path, clock, numbered) for path in files]
    elif clock.times_file is not None:
        times_s = clock.seconds(_times_of_file(clock.times_file, files, clock.time_unit))
    else:
        times_s = clock.seconds([_time_in(path) for path in files])
    timed = sorted(map(_Timed, files, times_s), key=lambda item: item.time_s)
    for before, after in pairwise(timed):
        if before.time_s == after.time_s:
            raise InputError(
                f"{after.path} and {before.path.name} have the same time, {after.time_s:.6f} s; correct the times."
            )
    return timed


def _time_of_frame(path: Path, clock: Clock, numbered: Numbered) -> float:
    frame = int(_number_in(path))
    if frame >= len(numbered.times_s):
        raise InputError(
            f"{clock.times_file}: ends after line {len(numbered.times_s)}, but {path} needs line {frame + 1}. The file "
            "is truncated; copy it again from the data set."
        )
    return numbered.times_s[frame]


def _times_of_file(path: Path, files: list[Path], unit: str) -> list[float]:
    lines = read_times(path, unit)
    if lines and lines[0][0] is not None:
        by_name: dict[str, float] = {}
        for name, time in lines:
            # other tools write the folder as well, as in rgb/000001.png
            last = Path(str(name)).name
            if by_name.setdefault(last, time) != time:
                raise InputError(f"{path}: has two times for {last}, {by_name[last]:f} and {time:f}. Remove one.")
        found = [by_name.get(file.name, by_name.get(file.stem)) for file in files]
        for file, time in zip(files, found, strict=True):
            if time is None:
                raise InputError(f"{path}: has no time for {file.name}. Add a line, or remove the file.")
        return [time for time in found if time is not None]
    if len(lines) != len(files):
        raise InputError(
            f"{path}: {len(lines)} times, but {files[0].parent} has {len(files)} files. Expected one line for each, in "
            "the order of their names; or write lines 'NAME TIME'."
        )
    return [time for _, time in lines]


# ---- frames ----------------------------------------------------------------------------------------------------


def _time(pictures: dict[str, _Timed]) -> float:
    """When a frame was taken: the middle of its pictures' times."""
    times = [picture.time_s for picture in pictures.values()]
    return (min(times) + max(times)) / 2


def _interval(times: list[float]) -> float:
    """The usual time from one to the next; infinite for a single one."""
    return statistics.median(np.diff(times).tolist()) if len(times) > 1 else float("inf")


def _frames(files: dict[str, list[_Timed]]) -> list[dict[str, _Timed]]:
    """Pictures that belong together, by camera, in order of time."""
    interval = min(_interval([item.time_s for item in timed]) for timed in files.values())
    every = sorted(((item, name) for name, timed in files.items() for item in timed), key=lambda pair: pair[0].time_s)
    frames: list[dict[str, _Timed]] = []
    begun = -float("inf")
    for item, name in every:
        if not frames or name in frames[-1] or item.time_s - begun >= interval / 2:
            frames.append({})
            begun = item.time_s
        frames[-1][name] = item
    return frames


def _usable(
    frames: list[dict[str, _Timed]],
    options: _Options,
    path: Trajectory | None,
    camera_poses: dict[Path, Transform],
    scans: Sequence[_Scans],
) -> tuple[dict[int, dict[str, _Timed]], list[Skipped]]:
    """The requested frames, by number, without frames and pictures that cannot be used; and the latter."""
    kept: dict[int, dict[str, _Timed]] = {}
    skipped: list[Skipped] = []
    slack_s = 0.0 if path is None else min(0.1, 0.5 * _interval(path.times_s.tolist()))
    for frame in options.chosen_frames(len(frames) - 1, "the recording has frames 0"):
        pictures = frames[frame]
        if reason := _unusable(pictures, path, slack_s, scans):
            skipped.append(Skipped(frame, None, reason))
            continue
        lacking = [name for name, picture in pictures.items() if camera_poses and picture.path not in camera_poses]
        skipped += [Skipped(frame, name, "no pose") for name in lacking]
        if len(lacking) < len(pictures):
            kept[frame] = {name: picture for name, picture in pictures.items() if name not in lacking}
    return kept, skipped


def _unusable(
    pictures: dict[str, _Timed], path: Trajectory | None, slack_s: float, scans: Sequence[_Scans]
) -> str | None:
    """Why a frame cannot be used, if it cannot; it may be `slack_s` before the first pose or after the last."""
    time_s = _time(pictures)
    if path is not None:
        if path.outside_s(time_s) > slack_s:
            return "before the first or after the last pose"
        if path.outside_s(time_s) == 0 and path.gap_s(time_s) > MAX_POSE_GAP_S:
            return f"no pose within {MAX_POSE_GAP_S:g} s"
    if scans and all(scanner.nearest(time_s)[1] > scanner.turn_s for scanner in scans):
        return "no scan"
    return None


# ---- poses -----------------------------------------------------------------------------------------------------


def _path(
    rig: Rig, poses: RigPoses, cameras: Sequence[RigCamera], files: dict[str, list[_Timed]]
) -> tuple[Trajectory, dict[Path, Transform], list[int]]:
    """The vehicle's path; each picture's own pose, where the file has these; and the lines that are left out."""
    of_pictures: dict[Path, Transform] = {}
    doubled: list[int] = []
    if poses.format == "nerfstudio":
        times, sensor_to_world, to_vehicle, of_pictures = _picture_poses(poses, cameras, files)
    else:
        sensors = {sensor.name: sensor.to_vehicle for sensor in (*rig.cameras, *rig.lidars)}
        to_vehicle = sensors.get(poses.of, np.eye(4))
        times, sensor_to_world, doubled = _pose_list(poses)
    if len(times) < 2:
        raise InputError(
            f"{poses.file}: {len(times)} pose{'' if len(times) == 1 else 's'}, expected at least two, for the "
            "vehicle's motion."
        )
    upright = upright_world(poses.up)

    def in_metres(pose: Float64[np.ndarray, "*poses 4 4"]) -> Float64[np.ndarray, "*poses 4 4"]:
        moved = pose.copy()
        moved[..., :3, 3] *= poses.metres_per_unit
        return upright @ moved

    vehicle_to_world = in_metres(sensor_to_world) @ np.linalg.inv(to_vehicle)
    with found_in(str(poses.file)):
        path = Trajectory(times, vehicle_to_world)
    return path, {file: in_metres(pose) for file, pose in of_pictures.items()}, doubled


def _pose_list(poses: RigPoses) -> tuple[np.ndarray, np.ndarray, list[int]]:
    if poses.format == "tum":
        return read_tum(poses.file)
    matrices, times_file = read_kitti(poses.file), poses.times_file
    if poses.times_from_names:
        raise InputError(f"{poses.file}: KITTI's poses have no names; give poses.times_file or poses.rate_hz.")
    counts: Sequence[float] = range(len(matrices))
    if times_file is not None:
        counts = [time for _, time in read_times(times_file, poses.time_unit)]
    if len(counts) != len(matrices):
        raise InputError(f"{times_file}: {len(counts)} times for the {len(matrices)} poses of {poses.file.name}.")
    return np.array(poses.seconds(counts), np.float64), matrices, []


def _picture_poses(
    poses: RigPoses, cameras: Sequence[RigCamera], files: dict[str, list[_Timed]]
) -> tuple[np.ndarray, np.ndarray, Transform, dict[Path, Transform]]:
    """Poses of pictures by their names; the camera that has most of them gives the vehicle's path."""
    given = read_nerfstudio(poses.file)
    by_ending: dict[tuple[str, ...], list[Path]] = defaultdict(list)
    for picture in (item.path for timed in files.values() for item in timed):
        parts = picture.with_suffix("").absolute().parts
        for count in range(1, len(parts) + 1):
            by_ending[parts[-count:]].append(picture)
    found: dict[Path, Transform] = {}
    for name, pose in given.items():
        parts = Path(name).parts
        # the picture that has most of its path in common
        endings = (by_ending.get(parts[-count:], []) for count in range(len(parts), 0, -1))
        pictures = next((pictures for pictures in endings if pictures), [])
        if len(pictures) > 1:
            raise InputError(
                f"{poses.file}: {name} fits {pictures[0]} and {pictures[1]}. Write more of the folders into its "
                "file_path, as in front/000001.png."
            )
        if pictures and pictures[0] in found:
            raise InputError(
                f"{poses.file}: {name} is a second pose of {pictures[0]}. Write more of the folders into it."
            )
        if pictures:
            found[pictures[0]] = pose
    if not found:
        raise InputError(
            f"{poses.file}: none of its {len(given)} frames, such as {next(iter(given))}, is a picture of this rig, "
            f"such as {next(iter(files.values()))[0].path}. Their names must agree."
        )
    best = max(cameras, key=lambda camera: sum(item.path in found for item in files[camera.name]))
    posed = [item for item in files[best.name] if item.path in found]
    times = np.array([item.time_s for item in posed])
    return times, np.stack([found[item.path] for item in posed]), best.to_vehicle, found


def upright_world(up: str) -> Transform:
    """The turn of the world that makes its upward axis z; axes are exchanged, nothing more."""
    axes, axis = np.eye(3), "xyz".index(up[-1])
    upward, forward = axes[axis] * (-1.0 if up.startswith("-") else 1.0), axes[(axis + 1) % 3]
    return rigid(np.stack((forward, np.cross(upward, forward), upward)))


def _check_clocks(rig: Rig, files: dict[str, list[_Timed]], scans: Sequence[_Scans], path: Trajectory | None) -> None:
    """Whether the sensors' times are of one clock, as far as that shows."""
    sensors = files | {scanner.lidar.name: scanner.files for scanner in scans}
    ranges = {name: (timed[0].time_s, timed[-1].time_s) for name, timed in sensors.items()}
    if path is not None:
        ranges["the poses"] = (float(path.times_s[0]), float(path.times_s[-1]))
    reference, slack_s = next(iter(files)), 0.5
    first, last = ranges[reference]
    for name, (start, end) in ranges.items():
        if start > last + slack_s or end < first - slack_s:
            raise InputError(
                f"{rig.path}: the times of {reference} and {name} do not overlap: {reference} has {first:.3f} to "
                f"{last:.3f} s, {name} {start:.3f} to {end:.3f} s. Are they of one clock and one unit? time_unit and "
                "time_offset_s bring them together."
            )


def _sweeps(
    scans: Sequence[_Scans], frame_times_s: dict[int, float], path: Trajectory | None, reach: int, tolerance: Tolerance
) -> list[RecordedSweep]:
    """The scans that the chosen frames can use, checked by their headers, each with the frame it belongs to."""
    frames, times_s = np.array(list(frame_times_s)), np.array(list(frame_times_s.values()))
    found = []
    for scanner in scans:
        lidar = scanner.lidar
        absolute = lidar.format.times is not None and lidar.format.times.absolute
        # around each frame's scan, those that are accumulated, and those that tell what moved in them
        margin = 2 * reach + 1
        first = max(0, scanner.nearest(float(times_s.min()))[0] - margin)
        last = scanner.nearest(float(times_s.max()))[0] + margin
        for item, middle_s in list(zip(scanner.files, scanner.midpoints_s.tolist(), strict=True))[first : last + 1]:
            if path is not None and path.outside_s(middle_s) > scanner.turn_s:
                continue
            apart = np.abs(times_s - middle_s)
            belongs = apart.min() <= scanner.turn_s / 2 * (1 + 1e-6)
            frame = int(frames[apart.argmin()]) if belongs else None
            try:
                check_scan(item.path, lidar.format)
            except (InputError, FileNotFoundError) as error:
                tolerance.add(frame, lidar.name, error)
                continue
            # points' times of the scanner's own clock are off as its scans' are
            counted_from_s = middle_s - lidar.time_offset_s if absolute else lidar.to_middle_s
            found.append(
                RecordedSweep(
                    path=item.path,
                    time_s=item.time_s + lidar.to_pose_s,
                    frame=frame,
                    scanner=lidar.name,
                    to_vehicle=lidar.to_vehicle,
                    read=partial(_read, item.path, lidar, counted_from_s),
                    timing=lidar.timing,
                    columns=len(lidar.columns) if lidar.dtype == "float32" and item.path.suffix == ".bin" else None,
                )
            )
        _check_some([sweep for sweep in found if sweep.scanner == lidar.name])
    return found


def _check_some(sweeps: list[RecordedSweep]) -> None:
    """Read some scans of a scanner: what is wrong with all of them is an error before anything long begins.

    Raises:
        InputError: the fault of the first, if none can be read.
    """
    faults = []
    for sweep in sweeps[:: max(1, len(sweeps) // _LOOKED_AT)]:
        try:
            sweep.read()
            return
        except (InputError, FileNotFoundError) as error:
            faults.append(error)
    if faults:
        raise faults[0]


def _read(path: Path, lidar: RigLidar, counted_from_s: float) -> Sweep:
    """Read a scan, in the scanner's frame."""
    sweep = read_scan(path, lidar.format, counted_from_s)
    if sweep.offset_s is not None and abs(late_s := float(sweep.offset_s.median())) > _MOST_LATE_S:
        raise InputError(
            f"{path}: its points' times are {late_s:.6g} s from the scan's own (median). Correct unit or counted_from "
            f"of lidars.{lidar.name}.point_times in the rig file."
        )
    if lidar.points_in == "scanner":
        return sweep
    to_scanner = torch.from_numpy(np.linalg.inv(lidar.to_vehicle))
    # echoes that are missing lie at the scanner's own place
    again = usable_points(path, transform_points(to_scanner, sweep.points_m), sweep.reflectance, sweep.offset_s)
    return replace(again, not_finite=sweep.not_finite, out_of_range=sweep.out_of_range + again.out_of_range)


# ---- what comes with the pictures ------------------------------------------------------------------------------


class _Companions:
    """Finds the maps that come with pictures, and checks them by their headers.

    They have the name of the picture's file where the rig file names a folder, and the frame's number where an option
    does.
    """

    def __init__(self, rig: Path, cameras: Sequence[RigCamera], options: _Options) -> None:
        self._options = options
        self.turned: dict[str, Counter[int]] = defaultdict(Counter)
        """How many of each camera's pictures have which EXIF orientation, beside those that stand upright."""
        for key in ("depth", "truth_distance", "truth_rgb", *(() if options.mono else ("mono",))):
            lacking = [camera.name for camera in cameras if getattr(camera, key) is None]
            if 0 < len(lacking) < len(cameras):
                raise InputError(
                    f"{rig}: cameras.{lacking[0]}.{key} is missing; give it for every camera that is used, or for none."
                )
        self._found = {
            (camera.name, what): _by_stem(
                _files(options.root, given, IMAGE_SUFFIXES if what == "masks" else (".png",)),  # pyrefly: ignore
                f"{rig}: cameras.{camera.name}.{what}",
            )
            for camera in cameras
            for what, given in (
                *((key, getattr(camera, key)) for key in ("masks", "mono", "truth_distance", "truth_rgb")),
                ("depth.files", camera.depth and camera.depth.files),
            )
            if given is not None
        }

    def picture(
        self, camera: RigCamera, frame: int, picture: _Timed, camera_to_world: Transform | None
    ) -> RecordedPicture:
        """A picture with all that comes with it."""
        orientation = check_picture_size(picture.path, camera.camera)
        if orientation != 1:
            self.turned[camera.name][orientation] += 1
        # an option goes before what the rig file names
        mask = self._options.map_of(camera.name, frame, "frame_masks") or self._by_name(camera, "masks", picture.path)
        mono = self._options.map_of(camera.name, frame, "mono") or self._by_name(camera, "mono", picture.path)
        depth = self._by_name(camera, "depth.files", picture.path)
        truth_distance = self._by_name(camera, "truth_distance", picture.path)
        truth_rgb = self._by_name(camera, "truth_rgb", picture.path)
        steps = 1 / DISTANCE_STEPS_PER_METRE
        depth_file = depth and camera.depth and DepthFile(depth, camera.depth.metres_per_count, camera.depth.kind)
        depth_steps = depth_file.metres_per_count if depth_file else steps
        for path, metres in ((mono, steps), (depth, depth_steps), (truth_distance, steps)):
            if path is not None and not check_size(path, camera.camera).is_distance:
                raise InputError(
                    f"{path}: expected a 16-bit grey PNG, {metres:g} m a count. Other kinds have lost the distance; "
                    "export the map again."
                )
        for path in (mask, truth_rgb):
            if path is not None:
                check_picture_size(path, camera.camera)
        return RecordedPicture(
            camera=camera.name,
            frame=frame,
            path=picture.path,
            time_s=picture.time_s,
            camera_to_world=camera_to_world,
            timestamp_s=picture.time_s,
            depth=depth_file,  # pyrefly: ignore[bad-argument-type]
            mask=mask,
            mono=mono,
            truth_distance=truth_distance,
            truth_rgb=truth_rgb,
        )

    def _by_name(self, camera: RigCamera, what: str, picture: Path) -> Path | None:
        files = self._found.get((camera.name, what))
        if files is None:
            return None
        if picture.stem not in files:
            folder = next(iter(files.values())).parent
            raise FileNotFoundError(
                f"{folder / picture.stem}.png: no such file; cameras.{camera.name}.{what} needs one for every picture "
                "taken, of the picture's name."
            )
        return files[picture.stem]
