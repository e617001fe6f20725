"""`edge-depth-nerf unpack`: from a ROS bag to a recording that `process rig` reads.

Under the output folder:

    unpack.json              the bag and the options, written first; marks the folder
    images/NAME/STAMP.png    pictures, named by their stamps in nanoseconds; JPEG and PNG stay what they are
    lidar/NAME/STAMP.npy     scans: x, y, z, intensity, and t, each point's time in seconds from the stamp
    poses.txt                where the vehicle was, in TUM's format
    rig.toml                 what describes them, written last

A bag is read once, one message at a time. Pictures and scans that are there are not written again, so an interrupted
run is continued.
"""

from __future__ import annotations

import os
from collections import defaultdict, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.console import progress_bars, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import open_folder, remove_leftovers, write_atomically, write_text
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.process.bags import scans
from edge_depth_nerf.process.bags.bag import Bag, Topic
from edge_depth_nerf.process.bags.frames import (
    VEHICLE_FRAMES,
    Edge,
    Poses,
    by_satellite,
    matrices,
    mounting,
    name_of,
    path_of,
)
from edge_depth_nerf.process.bags.lenses import Lens
from edge_depth_nerf.process.bags.options import UnpackOptions
from edge_depth_nerf.process.bags.pictures import bits_used, file_of
from edge_depth_nerf.process.bags.rig_text import rig_text
from edge_depth_nerf.process.bags.survey import (
    FIX,
    IMU,
    TF,
    FoundCamera,
    FoundScanner,
    Survey,
    look_at,
    stamp_of,
    window,
)
from edge_depth_nerf.process.poses import tum_text
from edge_depth_nerf.process.rig_file import TODO

_MANIFEST, _RIG, _POSES = "unpack.json", "rig.toml", "poses.txt"
_MOST_BROKEN = 0.1
"""A topic with a larger share of broken messages is a mistake."""
_UPWARD = 0.9
"""A camera whose axis points up so steeply has a frame with x forward, not an optical one."""
_MAX_THREADS = 8
_LATE_NS = 2_000_000_000
"""Poses that are recorded so much before or after the time taken are read, too."""


def unpack(options: UnpackOptions, console: Console | None = None) -> Path | None:
    """Write a bag as a recording, or continue one; give its folder, None if topics are only listed.

    Raises:
        FileNotFoundError: there is no such bag.
        InputError: an option, the bag or the output folder cannot be used.
    """
    console = console or Console()
    options.check()
    with Bag(options.bag) as bag:
        with console.status("Looking at the topics …"):
            found = look_at(bag, options)
        if options.list:
            _list(bag, found, console)
            return None
        if not found.cameras:
            listed = "; ".join(f"{topic}: {what}" for topic, what in found.taken.items() if "nothing:" in what)
            raise InputError(f"{bag.path}: has no pictures that can be read. {listed or 'It has no topics'}.")
        assert options.output is not None
        with only_writer(options.output, console):
            _open_folder(bag, options)
            if (options.output / _RIG).is_file():
                say(console, f"{options.output}: is complete.")
            else:
                _Unpacking(bag, found, options, console).write()
        return options.output


def todo_lines(recording: Path) -> list[int]:
    """The lines of a recording's rig.toml that are to be filled in."""
    lines = (recording / _RIG).read_text(encoding="utf-8").splitlines()
    return [number for number, line in enumerate(lines, 1) if f'"{TODO}' in line]


def _list(bag: Bag, found: Survey, console: Console) -> None:
    seconds = (bag.end_ns - bag.start_ns) / 1e9 if bag.topics else 0.0
    table = Table(title=f"{bag.path.name}: {seconds:.1f} s", show_edge=False, title_justify="left")
    for heading in ("topic", "type", "messages", "Hz", "taken as"):
        table.add_column(heading, overflow="fold", justify="right" if heading in ("messages", "Hz") else "left")
    for topic in bag.topics:
        rate = f"{topic.rate_hz:.1f}" if topic.rate_hz else ""
        table.add_row(topic.name, topic.type.replace("/msg/", "/"), str(topic.messages), rate, found.taken[topic.name])
    console.print(table)
    for scanner in found.scanners:
        if scanner.times is not None:
            times, counted = scanner.times, {"stamp": "the scan's stamp", "1970": "1970", "first": "the first point"}
            since = f"{times.field}, in {times.unit} from {counted[times.counted_from]}"
            say(console, f"{scanner.name}: points have times: {since}")
        if scanner.note:
            say(console, f"{scanner.name}: {scanner.note}", "yellow")
    for camera in found.cameras:
        if isinstance(camera.lens, str) or camera.lens.note:
            said = camera.lens if isinstance(camera.lens, str) else camera.lens.note
            say(console, f"{camera.name}: {said}", "yellow")


def _open_folder(bag: Bag, options: UnpackOptions) -> None:
    """Take the output folder: new, empty, or of the same bag and options.

    Raises:
        InputError: it holds something else.
    """
    folder = options.output
    assert folder is not None
    given = {key: value for key, value in asdict(options).items() if key not in ("bag", "output", "list")}
    manifest = {
        "kind": "unpacked bag",
        "files": [[path.name, path.stat().st_size] for path in bag.files],
        "options": {key: list(value) if isinstance(value, tuple) else value for key, value in given.items()},
    }
    open_folder(folder, folder / _MANIFEST, manifest, "unpacked bags")
    remove_leftovers(folder)


class _Unpacking:
    """One run through a bag."""

    def __init__(self, bag: Bag, found: Survey, options: UnpackOptions, console: Console) -> None:
        assert options.output is not None
        self._bag, self._found, self._options, self._console = bag, found, options, console
        self._output = options.output
        self._poses: dict[str, Poses] = defaultdict(Poses)
        """By topic; an Imu's have orientations alone, fixes have degrees and metres instead of a position."""
        self._frames: dict[str, tuple[str, str]] = {}
        """By topic: the frame of its messages, and that which their poses are of, if they name one."""
        self._moving: dict[Edge, Poses] = defaultdict(Poses)
        self._stamps: dict[str, set[int]] = defaultdict(set)
        """Of pictures and scans, by topic."""
        self._twice: dict[str, int] = defaultdict(int)
        self._unstamped: dict[str, int] = defaultdict(int)
        self._burnt: dict[str, int] = defaultdict(int)
        """Pictures that use more bits than those looked at before."""
        self._broken: dict[str, list[str]] = defaultdict(list)
        self._pending: deque[tuple[str, Future[None]]] = deque()

    def write(self) -> None:
        """Read the bag and write the recording."""
        found = self._found
        special = {FIX: self._take_fix, IMU: self._take_imu}
        takers: dict[str, Callable[[int, Any], None]] = {}
        for topic in (topic for source in found.poses for topic in source):
            takers[topic.name] = partial(special.get(topic.type, self._take_pose), topic.name)
        takers |= {topic.name: self._take_tf for topic in self._bag.topics if topic.type == TF}
        sensors = {camera.topic.name: partial(self._take_picture, camera) for camera in found.cameras}
        sensors |= {scanner.topic.name: partial(self._take_scan, scanner) for scanner in found.scanners}
        takers |= sensors
        start_ns, end_ns = window(self._bag, self._options)
        threads = min(os.cpu_count() or 1, _MAX_THREADS)
        with progress_bars(self._console) as progress, ThreadPoolExecutor(threads) as self._pool:
            task = progress.add_task(f"Unpacking {self._bag.path.name}", total=(end_ns - start_ns) / 1e9)
            try:
                # poses come late, and those around a picture are needed
                for topic, recorded_ns, message in self._bag.messages(takers, start_ns - _LATE_NS, end_ns + _LATE_NS):
                    if topic in sensors and not start_ns <= recorded_ns < end_ns:
                        continue
                    stamp_ns = recorded_ns
                    if hasattr(message, "header"):
                        stamp_ns = stamp_of(message, recorded_ns)
                        self._unstamped[topic] += not (message.header.stamp.sec or message.header.stamp.nanosec)
                    takers[topic](stamp_ns, message)
                    progress.update(task, completed=(recorded_ns - start_ns) / 1e9)
                    # a message waits for a thread, not in memory
                    self._settle(2 * threads)
                self._settle(0)
                progress.update(task, completed=(end_ns - start_ns) / 1e9)
            except BaseException:
                self._pool.shutdown(wait=True, cancel_futures=True)
                raise
        self._check_broken()
        self._describe()

    # ---- pictures and scans ------------------------------------------------------------------------------------

    def _settle(self, most: int) -> None:
        while len(self._pending) > most:
            topic, future = self._pending.popleft()
            try:
                future.result()
            except InputError as error:
                self._broken[topic].append(str(error))

    def _write(self, topic: Topic, stamp_ns: int, path: Path, write: Callable[[Path], None]) -> None:
        if stamp_ns in self._stamps[topic.name]:
            self._twice[topic.name] += 1
            return
        self._stamps[topic.name].add(stamp_ns)
        if not path.is_file():
            self._pending.append((topic.name, self._pool.submit(write, path)))

    def _take_picture(self, camera: FoundCamera, stamp_ns: int, message: Any) -> None:
        self._burnt[camera.topic.name] += bits_used(message) > camera.bits
        suffix, write = file_of(message, camera.bits)
        self._write(camera.topic, stamp_ns, self._output / "images" / camera.name / f"{stamp_ns}{suffix}", write)

    def _take_scan(self, scanner: FoundScanner, stamp_ns: int, message: Any) -> None:
        path = self._output / "lidar" / scanner.name / f"{stamp_ns}.npy"
        self._write(scanner.topic, stamp_ns, path, partial(_write_scan, message, scanner, stamp_ns))

    def _check_broken(self) -> None:
        for topic, faults in self._broken.items():
            count = len(self._stamps[topic])
            if len(faults) > max(_MOST_BROKEN * count, 1) or len(faults) == count:
                raise InputError(
                    f"{self._bag.path}: {len(faults)} of the {count} messages of {topic} are broken; the first has "
                    f"{faults[0]}. Choose other topics with --topics, or record it again."
                )
            say(self._console, f"{topic}: left out {len(faults)} broken messages; the first has {faults[0]}.", "yellow")
        for topic, count in self._twice.items():
            say(self._console, f"{topic}: left out {count} messages with the stamp of an earlier one.", "yellow")
        for camera in self._found.cameras:
            if count := self._burnt[camera.topic.name]:
                said = f"{camera.topic.name}: {count} pictures are white where they use more than {camera.bits} bits."
                say(self._console, said, "yellow")
        for topic, count in self._unstamped.items():
            if count:
                said = f"{topic}: {count} messages have no stamp; the time of their recording is taken, which is later."
                say(self._console, said, "yellow")

    # ---- poses -------------------------------------------------------------------------------------------------

    def _take_tf(self, _: int, message: Any) -> None:
        for each in message.transforms:
            edge = name_of(each.header.frame_id), name_of(each.child_frame_id)
            if edge not in self._found.mountings:
                self._moving[edge].add(stamp_of(each, 0), each.transform.translation, each.transform.rotation)

    def _take_pose(self, topic: str, stamp_ns: int, message: Any) -> None:
        self._frames[topic] = name_of(message.header.frame_id), name_of(getattr(message, "child_frame_id", ""))
        if hasattr(message, "transform"):
            self._poses[topic].add(stamp_ns, message.transform.translation, message.transform.rotation)
            return
        pose = getattr(message.pose, "pose", message.pose)
        self._poses[topic].add(stamp_ns, pose.position, pose.orientation)

    def _take_fix(self, topic: str, stamp_ns: int, message: Any) -> None:
        self._frames[topic] = name_of(message.header.frame_id), ""
        if message.status.status >= 0:
            self._poses[topic].add_place(stamp_ns, message.latitude, message.longitude, message.altitude)
        else:
            self._poses[topic].broken += 1

    def _take_imu(self, topic: str, stamp_ns: int, message: Any) -> None:
        self._frames[topic] = name_of(message.header.frame_id), ""
        # -1 in the first place says that there is no orientation
        if message.orientation_covariance[0] != -1:
            # only the orientation counts
            self._poses[topic].add(stamp_ns, message.angular_velocity, message.orientation)

    # ---- what describes them -----------------------------------------------------------------------------------

    def _describe(self) -> None:
        fixed, moving = dict(self._found.mountings), {}
        for edge, poses in self._moving.items():
            if poses.is_constant:
                fixed[edge] = matrices(poses.table)[0]
            else:
                moving[edge] = poses
        vehicle, said = self._write_poses(fixed, moving)
        cameras = []
        for camera in self._found.cameras:
            to_vehicle = mounting(fixed, camera.frame, vehicle)
            if to_vehicle is not None and to_vehicle[2, 2] > _UPWARD:
                say(
                    self._console,
                    f"{camera.name}: its axis points up. Its frame {camera.frame} seems to have x forward; turn "
                    f"cameras.{camera.name}.to_vehicle in {_RIG} to x right, y down, z forward.",
                    "yellow",
                )
            if to_vehicle is not None and isinstance(camera.lens, Lens):
                to_vehicle = to_vehicle @ camera.lens.to_frame
            cameras.append((camera, to_vehicle))
        scanners = [(scanner, mounting(fixed, scanner.frame, vehicle)) for scanner in self._found.scanners]
        write_text(self._output / _RIG, rig_text(self._bag.path.name, vehicle, cameras, scanners, said))

    def _vehicle(self, fixed: dict[Edge, Transform], moving: dict[Edge, Poses], child: str = "") -> str:
        """The frame that all is mounted on; `child`: which the poses are of, if they say so."""
        known = {frame for edge in (*fixed, *moving) for frame in edge}
        named = [frame for frame in VEHICLE_FRAMES if frame in known]
        mounted = [sensor.frame for sensor in (*self._found.scanners, *self._found.cameras)]
        return next(filter(None, (self._options.vehicle, child, *named, *mounted)), "vehicle")

    def _write_poses(self, fixed: dict[Edge, Transform], moving: dict[Edge, Poses]) -> tuple[str, str | None]:
        """Write the poses of the first source that has any; give the vehicle's frame, and what they are."""
        for source in self._found.poses:
            name = source[0].name
            vehicle = self._vehicle(fixed, moving, self._frames.get(name, ("", ""))[1])
            times_s, poses, said = self._poses_of(source, vehicle, fixed, moving)
            if broken := sum(self._poses[topic.name].broken for topic in source):
                say(self._console, f"{name}: left out {broken} messages without a pose.", "yellow")
            if len(times_s) > 1:
                write_text(self._output / _POSES, tum_text(times_s, poses))
                return vehicle, said
            found = f"{len(times_s)} poses of {vehicle}"
            say(self._console, f"{name}: has {found}; at least two are needed. None are written.", "yellow")
        return self._vehicle(fixed, moving), None

    def _poses_of(
        self, source: tuple[Topic, ...], vehicle: str, fixed: dict[Edge, Transform], moving: dict[Edge, Poses]
    ) -> tuple[Float64[np.ndarray, "poses"], Float64[np.ndarray, "poses 4 4"], str]:
        """Times (s) and poses of the vehicle by a source, and a word for them."""
        topic = source[0]
        if topic.type == TF:
            times_s, poses, world = path_of(moving, fixed, vehicle) or (np.empty(0), np.empty((0, 4, 4)), "")
            return times_s, poses, f"poses of {vehicle} in {world}, by {topic.name}"
        if topic.type == FIX:
            names = [each.name for each in source]
            places, turns = (self._poses[name].table for name in names)
            mounted = [mounting(fixed, self._frames.get(name, ("", ""))[0], vehicle) for name in names]
            antenna, imu = (np.eye(4) if each is None else each for each in mounted)
            times_s, poses = by_satellite(places[:, :4], np.delete(turns, (1, 2, 3), axis=1), antenna, imu)
            unknown = [name for name, each in zip(("antenna", "imu"), mounted, strict=True) if each is None]
            said = f"poses of {vehicle}, east, north and up, by {' and '.join(names)}"
            if unknown:
                said += f"; {' and '.join(unknown)} taken to be {vehicle}, as their mountings are not known"
            return times_s, poses, said
        table = self._poses[topic.name].table
        world, child = self._frames.get(topic.name, ("", ""))
        onward = mounting(fixed, vehicle, child) if child else np.eye(4)
        if onward is None:
            raise InputError(
                f"--vehicle {vehicle}: the poses of {topic.name} are of {child}, and no mounting leads there."
            )
        of = child or f"{vehicle} (the topic does not name it)"
        poses = matrices(table)
        said = f"poses of {of} in {world or 'a frame without name'}, by {topic.name}"
        return table[:, 0], poses @ onward if len(poses) else poses, said


def _write_scan(message: Any, scanner: FoundScanner, stamp_ns: int, path: Path) -> None:
    columns = scans.columns_of(message)
    seconds = None
    if scanner.times is not None and "time" in columns and scans.measured(columns).any():
        seconds = scans.offsets_s(columns, scanner.times, stamp_ns)
        late_s = float(np.abs(seconds[scans.measured(columns)]).max())
        if late_s > 3 * scanner.turn_s:
            raise InputError(f"points {late_s:.3g} s from its stamp")
    table = scans.table_of(columns, seconds)
    if not len(table):
        raise InputError("no point that was measured")
    write_atomically(path, lambda temporary: np.save(temporary, table))
