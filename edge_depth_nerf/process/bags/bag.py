"""Reading ROS bags by the library rosbags: topics by the index, messages one at a time.

The definitions of the messages are the library's own, of ROS 1 and ROS 2: what a bag says of them is needed, and read,
only for messages of Livox's scanners. So a bag with unknown types can be read, but for these.
"""

from __future__ import annotations

import heapq
import struct
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge_depth_nerf.base.errors import InputError

LIVOX = "CustomMsg"
"""How the type of Livox's scans ends; its package has two names."""
_SUFFIXES = (".bag", ".mcap", ".db3")
_SAME = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
"""Types with the fields of another one."""
_TFMESSAGE = "geometry_msgs/TransformStamped[] transforms"
"""Of tf2_msgs, which the library does not know of ROS 1."""
_REPAIR = (
    "The bag is truncated or damaged. Copy it again, or repair it with `rosbag reindex` (.bag), `ros2 bag reindex` "
    "(ROS 2) or `mcap recover` (.mcap)."
)


@dataclass(frozen=True)
class Topic:
    """One topic of a bag."""

    name: str
    type: str
    """As ROS 2 writes it, such as sensor_msgs/msg/Image."""
    messages: int
    rate_hz: float
    """Messages by the length of the bag."""
    readable: bool
    """Whether the fields of its messages are known."""


class Bag:
    """A bag that is open; use it in a with statement.

    Raises:
        FileNotFoundError: there is no such bag.
        InputError: it is no bag, truncated, damaged, or rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.interfaces import Connection  # noqa: F401
        except ImportError:
            raise InputError("unpack: needs rosbags, which is not installed. Run `pip install '.[bags]'`.") from None
        self.path = path
        self.files = _files(path)
        """All files of the bag that hold messages."""
        for file in self.files:
            _check_whole(file)
        self._stack = ExitStack()
        # a folder of ROS 2's with its metadata, or each file
        parts = [path] if (path / "metadata.yaml").is_file() else self.files
        self._readers = [self._opened(part) for part in parts]
        self._is_ros1 = _is_ros1(self.files[0])
        connections = [connection for reader in self._readers for connection in reader.connections]
        self._store = self._typestore(connections)
        self.start_ns = min((reader.start_time for reader in self._readers if reader.message_count), default=0)
        """When the first message was recorded."""
        self.end_ns = max((reader.end_time for reader in self._readers if reader.message_count), default=0)
        """Just after the last one."""
        self.topics = self._topics(connections)

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _opened(self, path: Path) -> Any:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2

        try:
            return self._stack.enter_context(Reader1(path) if _is_ros1(path) else Reader2(path))
        except Exception as error:  # the library raises whatever its parsers meet
            self._stack.close()
            if "Profile is not ros2" in str(error):
                raise InputError(f"{path}: is an MCAP file of ROS 1. Give the .bag that it was made from.") from None
            raise InputError(f"{path}: cannot be opened as a ROS bag ({_said(error)}). {_REPAIR}") from None

    def _typestore(self, connections: Collection[Any]) -> Any:
        from rosbags.interfaces import MessageDefinitionFormat
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.LATEST)
        if self._is_ros1:
            store.register(get_types_from_msg(_TFMESSAGE, "tf2_msgs/msg/TFMessage"))
        for connection in connections:
            known = _type_of(connection) in store.fielddefs
            if known or not connection.msgtype.endswith(LIVOX):
                continue
            if connection.msgdef.format == MessageDefinitionFormat.MSG:
                try:
                    types = get_types_from_msg(connection.msgdef.data, _type_of(connection))
                    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
                except Exception:  # noqa: S112  # it stays a topic that cannot be read, and is listed so
                    continue
        return store

    def _topics(self, connections: Collection[Any]) -> list[Topic]:
        seconds = max((self.end_ns - self.start_ns) / 1e9, 1e-9)
        counts: dict[tuple[str, str], int] = {}
        encodings: dict[str, set[str]] = {}
        for connection in connections:
            key = connection.topic, _type_of(connection)
            counts[key] = counts.get(key, 0) + connection.msgcount
            encoding = "ros1" if self._is_ros1 else connection.ext.serialization_format
            encodings.setdefault(connection.topic, set()).add(encoding)
        # a topic with a single message has no rate
        return [
            Topic(
                name,
                type_,
                count,
                (count - 1) / seconds if count > 1 else 0.0,
                type_ in self._store.fielddefs and encodings[name] <= {"ros1", "cdr"},
            )
            for (name, type_), count in sorted(counts.items())
        ]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of recording (ns) and message, in order of time; one message at a time in memory.

        Raises:
            InputError: the bag is damaged there.
        """
        parts = []
        for reader in self._readers:
            chosen = [connection for connection in reader.connections if connection.topic in topics]
            if chosen:
                parts.append(reader.messages(chosen, start_ns, end_ns))
        merged = heapq.merge(*parts, key=lambda item: item[1])
        time_ns = start_ns or self.start_ns
        while True:
            try:
                connection, time_ns, raw = next(merged)
                deserialize = self._store.deserialize_ros1 if self._is_ros1 else self._store.deserialize_cdr
                message = deserialize(raw, _type_of(connection))
            except StopIteration:
                return
            except Exception as error:  # the library raises whatever its parsers meet
                after_s = (time_ns - self.start_ns) / 1e9
                raise InputError(
                    f"{self.path}: cannot be read {after_s:.2f} s after its start ({_said(error)}). {_REPAIR} Or take "
                    "the part before: --seconds."
                ) from None
            yield connection.topic, time_ns, message


def _type_of(connection: Any) -> str:
    parts = connection.msgtype.split("/")
    # older writers leave out the middle part
    name = f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else connection.msgtype
    return _SAME.get(name, name)


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"


def _is_ros1(path: Path) -> bool:
    return path.suffix == ".bag" and path.is_file()


def _files(path: Path) -> list[Path]:
    """The files of a bag."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder; expected a ROS bag (.bag, .mcap, .db3).")
    found = [path]
    if path.is_dir():
        # ROS 2 may compress whole files, and writes so into the metadata
        kinds = (*_SUFFIXES, ".zstd") if (path / "metadata.yaml").is_file() else _SUFFIXES
        found = sorted(entry for entry in path.iterdir() if entry.suffix in kinds)
    if not found or (found == [path] and path.suffix not in _SUFFIXES):
        recording = " A .bag.active is not closed yet: run `rosbag reindex`." if path.suffix == ".active" else ""
        compressed = " Unpack it with zstd first." if path.suffix in (".zst", ".zstd") else ""
        raise InputError(
            f"{path}: is no ROS bag; expected a file {', '.join(_SUFFIXES)}, or a folder with such."
            f"{recording}{compressed}"
        )
    if len({entry.suffix for entry in found}) > 1:
        raise InputError(
            f"{path}: holds bags of different kinds ({found[0].name}, {found[-1].name}). Name one of them."
        )
    return found


def _check_whole(path: Path) -> None:
    """Hold a database's size against what its header says; the other kinds have an index at their end.

    Raises:
        InputError: it is truncated, or a part of it lies elsewhere.
    """
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"{path}: is empty, expected a ROS bag. Copy it again.")
    if path.suffix != ".db3":
        return
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        raise InputError(
            f"{log}: holds messages that are not in the bag yet. Run `sqlite3 {path} 'PRAGMA wal_checkpoint'` first."
        )
    with path.open("rb") as file:
        head = file.read(100)
    if head[:15] != b"SQLite format 3" or len(head) < 100:
        raise InputError(f"{path}: is no SQLite database, which .db3 bags are. {_REPAIR}")
    page_bytes, pages = struct.unpack(">H", head[16:18])[0], struct.unpack(">I", head[28:32])[0]
    expected = pages * (65536 if page_bytes == 1 else page_bytes)
    if size < expected:
        raise InputError(f"{path}: {size} bytes, but its header says {expected}. {_REPAIR}")
