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
from edge_depth_nerf.process.bags.pictures import file_of
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
        self._poses = Poses()
        self._child = ""
        """The frame that the poses are of."""
        self._world = ""
        """The frame that they are in."""
        self._moving: dict[Edge, Poses] = defaultdict(Poses)
        self._fixes: list[tuple[float, float, float, float]] = []
        self._turns = Poses()
        self._frames = {"antenna": "", "imu": ""}
        self._stamps: dict[str, set[int]] = defaultdict(set)
        """Of pictures and scans, by topic."""
        self._twice: dict[str, int] = defaultdict(int)
        self._unstamped: dict[str, int] = defaultdict(int)
        self._broken: dict[str, list[str]] = defaultdict(list)
        self._pending: deque[tuple[str, Future[None]]] = deque()

    def write(self) -> None:
        """Read the bag and write the recording."""
        found = self._found
        special = {TF: self._take_tf, FIX: self._take_fix, IMU: self._take_imu}
        takers: dict[str, Callable[[int, Any], None]] = {}
        for topic in (*(topic for topic in self._bag.topics if topic.type == TF), *found.poses):
            takers[topic.name] = special.get(topic.type, self._take_pose)
        takers |= {camera.topic.name: partial(self._take_picture, camera) for camera in found.cameras}
        takers |= {scanner.topic.name: partial(self._take_scan, scanner) for scanner in found.scanners}
        start_ns, end_ns = window(self._bag, self._options)
        threads = min(os.cpu_count() or 1, _MAX_THREADS)
        with progress_bars(self._console) as progress, ThreadPoolExecutor(threads) as self._pool:
            task = progress.add_task(f"Unpacking {self._bag.path.name}", total=(end_ns - start_ns) / 1e9)
            try:
                for topic, recorded_ns, message in self._bag.messages(takers, start_ns, end_ns):
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

    def _take_pose(self, stamp_ns: int, message: Any) -> None:
        self._world = name_of(message.header.frame_id)
        self._child = name_of(getattr(message, "child_frame_id", ""))
        if hasattr(message, "transform"):
            self._poses.add(stamp_ns, message.transform.translation, message.transform.rotation)
            return
        pose = getattr(message.pose, "pose", message.pose)
        self._poses.add(stamp_ns, pose.position, pose.orientation)

    def _take_fix(self, stamp_ns: int, message: Any) -> None:
        numbers = (stamp_ns / 1e9, message.latitude, message.longitude, message.altitude)
        self._frames["antenna"] = name_of(message.header.frame_id)
        if message.status.status >= 0 and np.isfinite(numbers).all():
            self._fixes.append(numbers)
        else:
            self._poses.broken += 1

    def _take_imu(self, stamp_ns: int, message: Any) -> None:
        self._frames["imu"] = name_of(message.header.frame_id)
        # -1 in the first place says that there is no orientation
        if message.orientation_covariance[0] != -1:
            # only the orientation counts
            self._turns.add(stamp_ns, message.angular_velocity, message.orientation)

    # ---- what describes them -----------------------------------------------------------------------------------

    def _describe(self) -> None:
        fixed, moving = dict(self._found.mountings), {}
        for edge, poses in self._moving.items():
            if poses.is_constant:
                fixed[edge] = matrices(poses.table)[0]
            else:
                moving[edge] = poses
        vehicle = self._vehicle(fixed, moving)
        said = self._write_poses(vehicle, fixed, moving)
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
                to_vehicle = to_vehicle.copy()
                to_vehicle[:3, :3] = to_vehicle[:3, :3] @ camera.lens.rotation.T
            cameras.append((camera, to_vehicle))
        scanners = [(scanner, mounting(fixed, scanner.frame, vehicle)) for scanner in self._found.scanners]
        write_text(self._output / _RIG, rig_text(self._bag.path.name, vehicle, cameras, scanners, said))

    def _vehicle(self, fixed: dict[Edge, Transform], moving: dict[Edge, Poses]) -> str:
        """The frame that all is mounted on."""
        known = {frame for edge in (*fixed, *moving) for frame in edge}
        named = [frame for frame in VEHICLE_FRAMES if frame in known]
        mounted = [sensor.frame for sensor in (*self._found.scanners, *self._found.cameras)]
        return next(filter(None, (self._options.vehicle, self._child, *named, *mounted)), "vehicle")

    def _write_poses(self, vehicle: str, fixed: dict[Edge, Transform], moving: dict[Edge, Poses]) -> str | None:
        """Write the poses of the vehicle; say what they are, None without any."""
        found = self._found
        if not found.poses:
            return None
        topic, times_s, poses, said = found.poses[0], np.empty(0), np.empty((0, 4, 4)), ""
        if topic.type == TF:
            path = path_of(moving, fixed, vehicle)
            if path is not None:
                times_s, poses, world = path
                said = f"poses of {vehicle} in {world}, by {topic.name}"
        elif topic.type == FIX:
            places, turns = np.array(self._fixes).reshape(-1, 4), self._turns.table
            places = places[np.unique(places[:, 0], return_index=True)[1]]
            mounted = [mounting(fixed, self._frames[each], vehicle) for each in ("antenna", "imu")]
            antenna, imu = (np.eye(4) if each is None else each for each in mounted)
            if len(turns) > 1:
                times_s, poses = by_satellite(places, np.delete(turns, (1, 2, 3), axis=1), antenna, imu)
            unknown = [name for name, each in zip(self._frames.values(), mounted, strict=True) if each is None]
            lacking = f"; {' and '.join(unknown)} taken to be {vehicle}, as their mountings are not known" * bool(
                unknown
            )
            said = f"poses of {vehicle}, east, north and up, by {topic.name} and {found.poses[1].name}{lacking}"
        else:
            table = self._poses.table
            times_s, poses = table[:, 0], matrices(table)
            of = self._child or f"{vehicle} (the topic does not name it)"
            said = f"poses of {of} in {self._world or 'a frame without name'}, by {topic.name}"
            onward = mounting(fixed, vehicle, self._child) if self._child else np.eye(4)
            if onward is None:
                raise InputError(
                    f"--vehicle {vehicle}: the poses of {topic.name} are of {self._child}, and no mounting leads there."
                )
            poses = poses @ onward if len(poses) else poses
        if broken := self._poses.broken + self._turns.broken:
            say(self._console, f"{topic.name}: left out {broken} messages without a pose.", "yellow")
        if len(times_s) < 2:
            say(
                self._console,
                f"{topic.name}: has {len(times_s)} poses; at least two are needed. None are written.",
                "yellow",
            )
            return None
        write_text(self._output / _POSES, tum_text(times_s, poses))
        return said


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
