"""ROS bags in each of their forms, of the hall in data_sets.py: what drivers would publish there."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import data_sets
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

Form = Literal["bag", "db3", "mcap"]
FORMS: tuple[Form, ...] = ("bag", "db3", "mcap")
FIRST_NS = 1_700_000_000_123_456_789
"""The stamps' own clock; messages are recorded some milliseconds later."""
LATE_NS = 7_000_000
KINDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@dataclass(frozen=True)
class Said:
    """A message before it has a form: its type and fields, nested ones as dictionaries."""

    topic: str
    type: str
    seconds: float
    fields: dict[str, Any]


class Maker:
    """Builds messages of a form from dictionaries."""

    def __init__(self, form: Form) -> None:
        self.is_ros1 = form == "bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.is_ros1 else Stores.ROS2_HUMBLE)
        if self.is_ros1:
            definition = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))

    def make(self, type_: str, fields: dict[str, Any]) -> Any:
        """What is not given is zero, or empty; ROS 1 writes K where ROS 2 writes k."""
        made = {}
        for name, (kind, detail) in self.store.fielddefs[type_][1]:
            given = fields.get(name, fields.get(name.lower()))
            made[name] = self._value(kind.name, detail, given)
        return self.store.types[type_](**made)

    def _value(self, kind: str, detail: Any, given: Any) -> Any:
        if kind == "NAME":
            return self.make(detail, given or {})
        if kind == "BASE":
            empty: Any = "" if detail[0] == "string" else 0.0 if detail[0].startswith("float") else 0
            return empty if given is None else given
        (inner, inner_detail), length = detail
        if inner.name == "NAME":
            return [self.make(inner_detail, each) for each in given or ()]
        dtype = {"octet": np.uint8, "byte": np.uint8, "char": np.uint8, "bool": np.bool_}.get(
            inner_detail[0], inner_detail[0]
        )
        return np.zeros(length, dtype) if given is None else np.asarray(given, dtype)


def write_bag(path: Path, form: Form, said: Sequence[Said], types: dict[str, str] | None = None) -> Path:
    """Write messages in order of time; give what `unpack` is given. `types` are definitions of further ones."""
    maker = Maker(form)
    for name, definition in (types or {}).items():
        maker.store.register(get_types_from_msg(definition, name))
    target = path / "drive.bag" if form == "bag" else path / f"drive_{form}"
    path.mkdir(parents=True, exist_ok=True)
    if form == "bag":
        writer: Any = Writer1(target)
        writer.set_compression(Writer1.CompressionFormat.LZ4)
    else:
        plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(target, version=9, storage_plugin=plugin)
    with writer:
        connections: dict[str, Any] = {}
        for each in sorted(said, key=lambda each: each.seconds):
            if each.topic not in connections:
                connections[each.topic] = writer.add_connection(each.topic, each.type, typestore=maker.store)
            message = maker.make(each.type, each.fields)
            serialize = maker.store.serialize_ros1 if form == "bag" else maker.store.serialize_cdr
            writer.write(connections[each.topic], stamp_ns(each.seconds) + LATE_NS, serialize(message, each.type))
    return target


def stamp_ns(seconds: float) -> int:
    return FIRST_NS + round(seconds * 1e9)


def header(seconds: float, frame: str) -> dict[str, Any]:
    whole, rest = divmod(stamp_ns(seconds), 10**9)
    return {"stamp": {"sec": whole, "nanosec": rest}, "frame_id": frame}


def xyz(place: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, place), strict=True))


def xyzw(turn: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, Rotation.from_matrix(turn).as_quat()), strict=True))


def transform(seconds: float, parent: str, child: str, pose: NDArray) -> dict[str, Any]:
    moved = {"translation": xyz(pose[:3, 3]), "rotation": xyzw(pose[:3, :3])}
    return {"header": header(seconds, parent), "child_frame_id": child, "transform": moved}


def frame_of(name: str) -> str:
    return {"scanner": "lidar_link"}.get(name, f"{name}_optical_frame")


def image(name: str, number: int, picture: NDArray[np.uint8], compressed: bool) -> Said:
    seconds = data_sets.camera_time(name, number)
    head = header(seconds, frame_of(name))
    if compressed:
        ok, content = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert ok
        fields = {"header": head, "format": "rgb8; jpeg compressed bgr8", "data": content.ravel()}
        return Said(f"/{name}/image_raw/compressed", "sensor_msgs/msg/CompressedImage", seconds, fields)
    height, width = picture.shape[:2]
    # drivers pad rows
    padded = np.pad(picture.reshape(height, width * 3), ((0, 0), (0, 5)))
    fields = {"header": head, "height": height, "width": width, "encoding": "rgb8", "step": width * 3 + 5}
    return Said(f"/{name}/image_raw", "sensor_msgs/msg/Image", seconds, {**fields, "data": padded.ravel()})


def camera_info(name: str, seconds: float, **changes: Any) -> Said:
    focal, (cx, cy) = data_sets.FOCAL, data_sets.CENTRE
    fields = {
        **{"header": header(seconds, frame_of(name)), "height": data_sets.HEIGHT, "width": data_sets.WIDTH},
        **{"distortion_model": "plumb_bob", "d": [0.0] * 5, "k": [focal, 0, cx, 0, focal, cy, 0, 0, 1]},
        **{"r": np.eye(3).ravel(), "p": [focal, 0, cx, 0, 0, focal, cy, 0, 0, 0, 1, 0]},
    }
    return Said(f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", seconds, {**fields, **changes})


def cloud(
    seconds: float, points: NDArray, times: NDArray | None, field: str = "t", topic: str = "/lidar/points"
) -> Said:
    """A PointCloud2 with padding between its fields, and a point without echo."""
    kinds = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "f4")]
    if times is not None:
        kinds.append((field, times.dtype.str[1:]))
    offsets, place = [], 0
    for _, kind in kinds:
        offsets.append(place)
        place += np.dtype(kind).itemsize + 4
    record = np.dtype(
        {
            "names": [name for name, _ in kinds],
            "formats": [f"<{kind}" for _, kind in kinds],
            "offsets": offsets,
            "itemsize": place,
        }
    )
    table = np.zeros(len(points) + 1, record)
    for axis, column in zip("xyz", points.T, strict=True):
        table[axis][:-1] = column
        table[axis][-1] = np.nan
    table["intensity"] = 7
    if times is not None:
        table[field][:-1] = times
    fields = [
        {"name": name, "offset": offset, "datatype": KINDS[kind], "count": 1}
        for (name, kind), offset in zip(kinds, offsets, strict=True)
    ]
    content = {
        **{"header": header(seconds, frame_of("scanner")), "height": 1, "width": len(table), "fields": fields},
        **{"point_step": place, "row_step": place * len(table), "is_dense": False},
        "data": np.frombuffer(table.tobytes(), np.uint8),
    }
    return Said(topic, "sensor_msgs/msg/PointCloud2", seconds, content)


def mountings() -> Said:
    """Cameras on a bar, and the scanner on a mast: chains that go up and down."""
    bar = data_sets.rigid(Rotation.from_euler("z", 20, degrees=True), [1.0, 0.0, 1.2])
    sent = [
        transform(0, "base_link", "bar", bar),
        transform(0, "base_link", "lidar_link", data_sets.to_vehicle("scanner")),
    ]
    for name in data_sets.CAMERAS:
        sent.append(transform(0, "bar", frame_of(name), np.linalg.inv(bar) @ data_sets.to_vehicle(name)))
    return Said("/tf_static", "tf2_msgs/msg/TFMessage", 0.0, {"transforms": sent})


def world(seconds: float) -> NDArray:
    pose = data_sets.vehicle(seconds)
    pose[:3, 3] += data_sets.OFF
    return pose


def odometry(seconds: float) -> Said:
    pose = world(seconds)
    fields = {"pose": {"pose": {"position": xyz(pose[:3, 3]), "orientation": xyzw(pose[:3, :3])}}}
    fields |= {"header": header(seconds, "map"), "child_frame_id": "base_link"}
    return Said("/odometry", "nav_msgs/msg/Odometry", seconds, fields)


def hall(poses: bool = True, calibrated: bool = True, mounted: bool = True, timed: bool = True) -> Iterator[Said]:
    """A whole drive: one raw and one compressed camera, a turning scanner, odometry at 50 Hz, messages of no use."""
    if mounted:
        yield mountings()
    for number in range(data_sets.FRAMES):
        for name in data_sets.CAMERAS:
            yield image(name, number, data_sets.picture(name, number), compressed=name == "side")
            if calibrated:
                yield camera_info(name, data_sets.camera_time(name, number))
        start_s = number * data_sets.INTERVAL_S - 0.05
        points, offsets = data_sets.turn(start_s)
        yield cloud(start_s, points, (offsets * 1e9).astype(np.uint32) if timed else None)
        yield Said("/rosout", "std_msgs/msg/String", start_s, {"data": "all is well"})
    if poses:
        for step in range(-10, 40):
            yield odometry(step * 0.02)
