"""What a bag's topics would be taken for: cameras, scanners, calibration, mountings, poses.

A few messages of each topic are read. Topics of one camera (raw, compressed, rectified) differ in the last parts of
their names; clouds of one scanner have one frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.process.bags import scans
from edge_depth_nerf.process.bags.bag import LIVOX, Bag, Topic
from edge_depth_nerf.process.bags.frames import Edge, Poses, matrices, name_of
from edge_depth_nerf.process.bags.lenses import Lens, lens_of
from edge_depth_nerf.process.bags.options import UnpackOptions
from edge_depth_nerf.process.bags.pictures import bits_used, size_of, why_no_picture

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CLOUD, INFO, TF = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
FIX, IMU = "sensor_msgs/msg/NavSatFix", "sensor_msgs/msg/Imu"
POSES = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)
"""Types with a pose each, the first ones first."""
PACKETS = ("velodyne_msgs/msg/VelodyneScan", "ouster_sensor_msgs/msg/PacketMsg", "ouster_ros/msg/PacketMsg")
"""What a scanner sends, before its driver makes points of it."""
_GENERIC = {
    *("image", "image_raw", "image_color", "image_mono", "image_rect", "image_rect_color", "image_rect_raw"),
    *("compressed", "color", "rgb", "raw", "rectified", "points", "points_raw", "pointcloud", "point_cloud", "cloud"),
}
"""Parts of topics that name no sensor."""
_PEEKED = 6
"""So many scans and pictures are read to see what they are."""
_SPREAD = 16
"""So many pictures, of all the time taken, tell how many of their bits are used: the first ones may be of a garage."""


@dataclass(frozen=True)
class FoundCamera:
    """A camera's topic."""

    topic: Topic
    name: str
    """Its table in rig.toml, and its folder."""
    frame: str
    width: int
    height: int
    bits: int
    """How many bits of 16-bit pictures are used."""
    lens: Lens | str
    """Or why there is none."""


@dataclass(frozen=True)
class FoundScanner:
    """A scanner's topic."""

    topic: Topic
    name: str
    """Its table in rig.toml, and its folder."""
    frame: str
    times: scans.PointTimes | None
    turn_s: float
    timestamp: str
    """Which part of the turn the stamps refer to; empty if points have no times."""
    note: str
    """What the user should know of the points' times."""


@dataclass
class Survey:
    """What a bag is taken for."""

    cameras: list[FoundCamera] = field(default_factory=list)
    scanners: list[FoundScanner] = field(default_factory=list)
    mountings: dict[Edge, Transform] = field(default_factory=dict)
    """Of /tf_static."""
    poses: list[tuple[Topic, ...]] = field(default_factory=list)
    """Sources, the first ones first: poses, /tf, or fixes with an IMU."""
    taken: dict[str, str] = field(default_factory=dict)
    """By topic: what it is taken for, or why it is not."""


def stamp_of(message: Any, recorded_ns: int) -> int:
    """When a message was measured, ns; when it was recorded, if it has no stamp."""
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec or recorded_ns


def window(bag: Bag, options: UnpackOptions) -> tuple[int, int]:
    """The times of recording that are taken, ns."""
    start = bag.start_ns + round(options.start_s * 1e9)
    end = bag.end_ns if options.seconds is None else start + round(options.seconds * 1e9)
    if start >= bag.end_ns:
        raise InputError(
            f"--start-s {options.start_s:g}: {bag.path} ends {(bag.end_ns - bag.start_ns) / 1e9:.2f} s after its start."
        )
    return start, min(end, bag.end_ns)


def look_at(bag: Bag, options: UnpackOptions) -> Survey:
    """Find out what a bag's topics would be taken for.

    Raises:
        InputError: an option names a topic that there is not, or one that cannot be read.
    """
    _check_topics(bag, options)
    found = Survey()
    by_type: dict[str, list[Topic]] = {}
    for topic in bag.topics:
        if topic.messages and topic.readable:
            by_type.setdefault(topic.type, []).append(topic)
    for topic in bag.topics:
        found.taken[topic.name] = _default(topic)
    _find_cameras(bag, options, found, by_type)
    _find_scanners(bag, options, found, by_type)
    _find_mountings(bag, found, by_type)
    _find_poses(options, found, by_type)
    return found


def _check_topics(bag: Bag, options: UnpackOptions) -> None:
    known = {topic.name: topic for topic in bag.topics}
    asked = [("--topics", name) for name in options.topics] + [("--poses", options.poses)] * bool(options.poses)
    for option, name in asked:
        if name not in known:
            raise InputError(f"{option} {name}: {bag.path} has no such topic; --list shows those that it has.")
        if not known[name].readable:
            raise InputError(f"{option} {name}: messages of type {known[name].type} cannot be read.")


def _default(topic: Topic) -> str:
    if not topic.messages:
        return "nothing: without messages"
    if topic.type in PACKETS:
        return "nothing: packets of a scanner; play the bag through its driver, and record its points"
    return "nothing" if topic.readable else "nothing: of a type that is not known"


def _peek(bag: Bag, options: UnpackOptions, topic: Topic) -> list[tuple[int, Any]]:
    messages = bag.messages([topic.name], *window(bag, options))
    return [(stamp_of(message, recorded), message) for _, recorded, message in islice(messages, _PEEKED)]


# ---- cameras ---------------------------------------------------------------------------------------------------


def _key(topic: str) -> tuple[str, ...]:
    """What names the sensor in a topic."""
    return tuple(part for part in topic.split("/") if part and part not in _GENERIC)


def _named(topics: Sequence[Topic], used: set[str]) -> Iterator[tuple[Topic, str]]:
    """Topics with short names for their sensors, all different."""
    keys = [_key(topic.name) or tuple(part for part in topic.name.split("/") if part) for topic in topics]
    last = [key[-1] for key in keys]
    for topic, key in zip(topics, keys, strict=True):
        name = key[-1] if last.count(key[-1]) == 1 and key[-1] not in used else "_".join(key)
        name = re.sub(r"[^A-Za-z0-9_-]", "_", name).lstrip("-") or "sensor"
        name = f"{name}_sensor" if name == "vehicle" else name
        free = name
        while free in used:
            free = f"{name}_{sum(each.startswith(name) for each in used) + 1}"
        used.add(free)
        yield topic, free


def _find_cameras(bag: Bag, options: UnpackOptions, found: Survey, by_type: dict[str, list[Topic]]) -> None:
    """Find the cameras and their calibration."""
    infos = [(topic, next(bag.messages([topic.name]))[2]) for topic in by_type.get(INFO, [])]
    peeked: dict[str, list[tuple[int, Any]]] = {}
    groups: dict[tuple[str, ...], list[Topic]] = {}
    for topic in (*by_type.get(IMAGE, []), *by_type.get(COMPRESSED, [])):
        if options.topics and topic.name not in options.topics:
            continue
        messages = _peek(bag, options, topic)
        reason = why_no_picture(messages[0][1]) if messages else "without messages in the time taken"
        if reason is not None:
            found.taken[topic.name] = f"nothing: {reason}"
            continue
        peeked[topic.name] = messages
        key = (topic.name,) if options.topics else _key(topic.name)
        groups.setdefault(key, []).append(topic)
    chosen = []
    for group in groups.values():
        best = min(group, key=lambda topic: (_rectified(topic), "mono" in topic.name, topic.type == COMPRESSED))
        chosen.append(best)
        for other in group:
            if other != best:
                found.taken[other.name] = f"nothing: the same camera as {best.name}; --topics chooses"
    used: dict[str, list[str]] = {topic.name: [] for topic, _ in infos}
    frames = {topic: name_of(peeked[topic.name][0][1].header.frame_id) for topic in chosen}
    for topic, name in _named(chosen, set()):
        first = peeked[topic.name][0][1]
        try:
            width, height = size_of(first)
        except InputError as error:
            raise InputError(f"{bag.path}: the first picture of {topic.name} has {error}.") from None
        frame = frames[topic]
        info = _info_of(topic.name, frame, infos)
        lens: Lens | str = "the bag has no CameraInfo for it"
        if info is not None:
            used[info[0].name].append(name)
            shares_frame = list(frames.values()).count(frame) > 1
            lens = lens_of(info[1], width, height, _rectified(topic), shares_frame)
        bits = _bits_of(bag, options, topic)
        found.cameras.append(FoundCamera(topic, name, frame, width, height, bits, lens))
        found.taken[topic.name] = f"pictures of {name}"
    for info_topic, names in used.items():
        found.taken[info_topic] = f"calibration of {', '.join(names)}" if names else "calibration, of no camera taken"


def _rectified(topic: Topic) -> bool:
    return re.search(r"(?<![a-z])rect(ified)?(?![a-z])", topic.name.lower()) is not None


def _bits_of(bag: Bag, options: UnpackOptions, topic: Topic) -> int:
    """How many bits of a topic's pictures are used."""
    if topic.type != IMAGE:
        return 8
    start_ns, end_ns = window(bag, options)
    times = (start_ns + (end_ns - start_ns) * number // _SPREAD for number in range(_SPREAD))
    firsts = (next(bag.messages([topic.name], time_ns, end_ns), None) for time_ns in times)
    return max((bits_used(each[2]) for each in firsts if each is not None), default=8)


def _info_of(topic: str, frame: str, infos: list[tuple[Topic, Any]]) -> tuple[Topic, Any] | None:
    """The CameraInfo beside a topic of pictures, or above it, or else the only one of its frame."""
    by_name = {info.name: (info, message) for info, message in infos}
    parts = Path(topic).parts
    for count in range(len(parts), 1, -1):
        beside = f"{Path(*parts[:count])!s}/camera_info"
        if beside in by_name:
            return by_name[beside]
    same = [pair for pair in by_name.values() if name_of(pair[1].header.frame_id) == frame]
    return same[0] if len(same) == 1 and frame else None


# ---- scanners --------------------------------------------------------------------------------------------------


def _find_scanners(bag: Bag, options: UnpackOptions, found: Survey, by_type: dict[str, list[Topic]]) -> None:
    candidates: list[tuple[Topic, list[tuple[int, Any]]]] = []
    livox = [topic for type_, topics in by_type.items() if type_.endswith(LIVOX) for topic in topics]
    for topic in (*by_type.get(CLOUD, []), *livox):
        if options.topics and topic.name not in options.topics:
            continue
        messages = _peek(bag, options, topic)
        if len(messages) < 2 and not options.topics:
            found.taken[topic.name] = "nothing: a single cloud, not scans"
        elif topic.type == CLOUD and messages and not {*"xyz"} <= scans.fields_of(messages[0][1]).keys():
            found.taken[topic.name] = "nothing: clouds without fields x, y and z"
        elif messages:
            candidates.append((topic, messages))
    frames: dict[str, list[tuple[Topic, list[tuple[int, Any]]]]] = {}
    for topic, messages in candidates:
        key = topic.name if options.topics else name_of(messages[0][1].header.frame_id)
        frames.setdefault(key, []).append((topic, messages))
    chosen = {}
    for group in frames.values():
        best = max(group, key=lambda each: (scans.time_field(each[1][0][1]) is not None, _bytes(each[1][0][1])))
        chosen[best[0]] = best[1]
        for topic, _ in group:
            if topic != best[0]:
                found.taken[topic.name] = f"nothing: the same scanner as {best[0].name}; --topics chooses"
    used = {camera.name for camera in found.cameras}
    for topic, name in _named(list(chosen), used):
        found.scanners.append(_scanner(bag, topic, name, chosen[topic]))
        found.taken[topic.name] = f"scans of {name}"


def _bytes(message: Any) -> int:
    return len(message.data) if hasattr(message, "data") else len(message.points)


def _scanner(bag: Bag, topic: Topic, name: str, messages: list[tuple[int, Any]]) -> FoundScanner:
    stamps = [stamp for stamp, _ in messages]
    interval_s = float(np.median(np.diff(stamps))) / 1e9 if len(stamps) > 1 else None
    turn_s = interval_s or scans.USUAL_TURN_S
    first = messages[0][1]
    frame, field_name = name_of(first.header.frame_id), scans.time_field(first)
    times, timestamp, note = None, "", "its points have no times."
    if field_name is not None:
        try:
            columns = [(stamp, scans.columns_of(message)) for stamp, message in messages]
        except InputError as error:
            raise InputError(f"{bag.path}: a scan of {topic.name} cannot be read: {error}.") from None
        samples = [(stamp, each["time"][scans.measured(each)]) for stamp, each in columns]
        times, note = scans.find_times(samples, field_name, interval_s)
        if times is not None:
            seconds = [scans.offsets_s(each, times, stamp)[scans.measured(each)] for stamp, each in columns]
            middle = float(np.median([(each.min() + each.max()) / 2 for each in seconds if len(each)])) / turn_s
            timestamp = "start" if middle > 0.25 else "end" if middle < -0.25 else "middle"
    return FoundScanner(topic, name, frame, times, turn_s, timestamp, note)


# ---- mountings and poses ---------------------------------------------------------------------------------------


def _find_mountings(bag: Bag, found: Survey, by_type: dict[str, list[Topic]]) -> None:
    fixed: dict[Edge, Poses] = {}
    for topic in by_type.get(TF, []):
        if not topic.name.endswith("tf_static"):
            found.taken[topic.name] = "mountings, where nothing moves"
            continue
        found.taken[topic.name] = "mountings"
        for _, _, message in bag.messages([topic.name]):
            for each in message.transforms:
                edge = name_of(each.header.frame_id), name_of(each.child_frame_id)
                fixed[edge] = Poses()
                fixed[edge].add(0, each.transform.translation, each.transform.rotation)
    found.mountings = {edge: matrices(poses.table)[0] for edge, poses in fixed.items() if len(poses.table)}


def _find_poses(options: UnpackOptions, found: Survey, by_type: dict[str, list[Topic]]) -> None:
    """Choose where the poses come from."""
    tf = [topic for topic in by_type.get(TF, []) if not topic.name.endswith("tf_static")]
    imus = sorted(by_type.get(IMU, []), key=lambda topic: -topic.messages)
    sources: list[tuple[Topic, ...]] = []
    for type_ in POSES:
        sources += [(topic,) for topic in sorted(by_type.get(type_, []), key=lambda topic: -topic.messages)]
    sources += [(topic,) for topic in tf]
    sources += [(topic, imus[0]) for topic in by_type.get(FIX, []) if imus]
    sources = [each for each in sources if options.poses in (None, each[0].name) and each[0].messages > 1]
    if options.poses is not None and not sources:
        raise InputError(
            f"--poses {options.poses}: expected a topic with poses: Odometry, PoseStamped, /tf, or NavSatFix."
        )
    for topic in by_type.get(FIX, []):
        if not imus:
            found.taken[topic.name] = "nothing: fixes have no orientation, and there is no Imu"
    found.poses = sources
    for source in sources:
        role = "poses" if source is sources[0] else f"poses, if {sources[0][0].name} has none; --poses chooses"
        for topic in source:
            # the same Imu for all fixes
            if not found.taken[topic.name].startswith("poses"):
                found.taken[topic.name] = f"{role}, {found.taken[topic.name]}" if topic.type == TF else role
