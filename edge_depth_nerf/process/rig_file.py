"""The file that describes a rig: rig.toml or rig.json. docs/rig.md says what each key means.

It is read strictly: a key that is missing, unknown or of another kind is an error that names the file and the key,
as in `rig.toml: cameras.front.fx`. Paths in it count from the recording's folder and stay in it. Nothing else is read
here.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from edge_depth_nerf.base.bounds import MAX_TIME_S, finite, path_inside, read_text, shown
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar.scans import PointTimes, ScanFormat
from edge_depth_nerf.lidar.sweeps import SweepTiming
from edge_depth_nerf.process.poses import pose_of_quaternion, transform_of_rows

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

VEHICLE = "vehicle"
"""The frame that every sensor's transform leads to."""
MAX_SIDE_PX = 20_000
"""No picture is larger."""
MAX_RIG_BYTES = 1 << 18
"""No rig file is larger: a thousand sensors."""
_MAX_DOTS = 1000
"""No line of TOML has more: the parser's time and memory grow with the square of a key's parts."""
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"


@dataclass(frozen=True)
class Clock:
    """How the files of a sensor tell their times; one of the first three is set."""

    file: Path | None
    """A text file with a time for each file."""
    from_names: bool
    """The last number in a file's name is its time."""
    rate_hz: float | None
    """The last number in a file's name, divided by this, is its time in seconds."""
    seconds_per_count: float
    """What one count of a time is."""
    offset_s: float
    """Added to each time, to bring it to the clock of the poses."""


@dataclass(frozen=True)
class DepthMaps:
    """Depth maps that come with a camera's pictures, in place of LiDAR."""

    files: str
    """Folder, or pattern."""
    kind: Literal["distance", "z_depth"]
    """Along the ray, or along the optical axis."""
    metres_per_count: float
    """What one count of a file is."""


@dataclass(frozen=True)
class RigCamera:
    """A camera of the rig."""

    name: str
    """Its name; becomes a folder."""
    camera: Camera
    """Its model, pixel centres at +0.5."""
    to_vehicle: Transform
    """From its frame to the vehicle's."""
    images: str
    """Folder, or pattern, of its pictures."""
    clock: Clock
    """When they were taken."""
    ego_mask: Path | None
    """What of its pictures is never used."""
    masks: str | None
    """Folder or pattern of masks of single pictures."""
    mono: str | None
    """Folder or pattern of monocular distance maps."""
    truth_distance: str | None
    """Folder or pattern of true distance maps, which rendered recordings have."""
    truth_rgb: str | None
    """Folder or pattern of pictures without noise and exposure drift, which rendered recordings have."""
    depth: DepthMaps | None
    """Depth maps in place of LiDAR."""


@dataclass(frozen=True)
class RigLidar:
    """A scanner of the rig."""

    name: str
    """Its name."""
    to_vehicle: Transform
    """From its frame to the vehicle's."""
    scans: str
    """Folder, or pattern, of its scans."""
    format: ScanFormat
    """What their columns mean."""
    clock: Clock
    """When they were taken."""
    turn_s: float | None
    """How long a scan takes; None = from one to the next."""
    to_middle_s: float
    """From a scan's timestamp to its middle."""
    timing: SweepTiming | None
    """When each azimuth is measured, counted from the middle; None = unknown, or points have times."""


@dataclass(frozen=True)
class RigPoses:
    """Where the poses come from."""

    file: Path
    """The file."""
    format: Literal["tum", "kitti", "nerfstudio"]
    """Its format."""
    of: str
    """Whose poses they are: the vehicle's, or a sensor's."""
    clock: Clock | None
    """When they were taken, in KITTI's format."""
    metres_per_unit: float
    """What one unit of their positions is."""
    up: str
    """Which axis of their world points up."""


@dataclass(frozen=True)
class Rig:
    """All that a rig file says."""

    path: Path
    """The file."""
    cameras: tuple[RigCamera, ...]
    lidars: tuple[RigLidar, ...]
    poses: RigPoses | None


def read_rig(path: Path, root: Path, prepare: Callable[[dict[str, Any]], None] | None = None) -> Rig:
    """Read a rig file.

    Args:
        path: the file, TOML or JSON by its suffix.
        root: the folder that its paths count from.
        prepare: fills in what a data set is known to have, before the file is checked.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not TOML or JSON; a key is missing, unknown or wrong.

    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; it describes the cameras and scanners (docs/rig.md).")
    parse, suffixes = (json.loads, "JSON") if path.suffix.lower() == ".json" else (_parse_toml, "TOML")
    try:
        content = parse(read_text(path, MAX_RIG_BYTES))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not valid {suffixes} ({error}). Mend the file; docs/rig.md has an example."
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected tables [cameras.NAME], [lidars.NAME] and [poses].")
    if prepare is not None:
        prepare(content)
    return _rig(_Table(content, path, ""), root)


def _parse_toml(text: str) -> dict[str, Any]:
    if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
        raise ValueError(f"a line with more than {_MAX_DOTS} dots")
    return tomllib.loads(text)


class _Table:
    """A table of the file; each key is taken once, and what is left over at the end is an error."""

    def __init__(self, values: Mapping[str, Any], path: Path, prefix: str) -> None:
        self._values, self._path, self._prefix = dict(values), path, prefix
        self._known: list[str] = []

    def where(self, key: str) -> str:
        return f"{self._path}: {self._prefix}{key}"

    def wrong(self, key: str, found: object, expected: str) -> InputError:
        return InputError(f"{self.where(key)} is {shown(found)}, expected {expected}.")

    def has(self, key: str) -> bool:
        self._known.append(key)
        return key in self._values

    def take(self, key: str, expected: str) -> Any:
        """The value of a key that must be there."""
        self._known.append(key)
        if key not in self._values:
            raise InputError(f"{self.where(key)} is missing; expected {expected}.{self.slip_for(key)}")
        return self._values.pop(key)

    def slip_for(self, *keys: str) -> str:
        """A question about a key that is there, if it looks like one of those that are missing."""
        for key in keys:
            for found in difflib.get_close_matches(key, self._values, 1, 0.75):
                return f" There is {found}: is {key} meant?"
        return ""

    def number(
        self, key: str, default: float | None = None, above: float = -math.inf, most: float = MAX_TIME_S
    ) -> float:
        expected = "a number" + (f" above {above:g}" if above > -math.inf else "") + f", at most {most:g}"
        if default is not None and not self.has(key):
            return default
        given = self.take(key, expected)
        value = finite(given)
        if value is None or value <= above or abs(value) > most:
            raise self.wrong(key, given, expected)
        return value

    def whole(self, key: str, low: int, high: int) -> int:
        expected = f"a whole number from {low} to {high}"
        value = self.take(key, expected)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.wrong(key, value, expected)
        return value

    def text(self, key: str, expected: str) -> str:
        value = self.take(key, expected)
        if not isinstance(value, str) or not value:
            raise self.wrong(key, value, expected)
        return value

    def optional_text(self, key: str, expected: str) -> str | None:
        return self.text(key, expected) if self.has(key) else None

    def choice(self, key: str, choices: tuple[Any, ...], default: Any = None) -> Any:
        expected = f"one of {', '.join(map(repr, choices))}"
        if default is not None and not self.has(key):
            return default
        value = self.take(key, expected)
        # 1 equals True to Python only
        if not any(value == choice and isinstance(value, bool) == isinstance(choice, bool) for choice in choices):
            raise self.wrong(key, value, expected)
        return value

    def texts(self, key: str, default: tuple[str, ...]) -> tuple[str, ...]:
        if not self.has(key):
            return default
        expected = "a list of different names, such as ['x', 'y', 'z', 'intensity']"
        value = self.take(key, expected)
        if not isinstance(value, list) or not all(isinstance(item, str) and item for item in value):
            raise self.wrong(key, value, expected)
        if not value or len(set(value)) != len(value):
            raise self.wrong(key, value, expected)
        return tuple(value)

    def table(self, key: str, expected: str) -> _Table:
        value = self.take(key, expected)
        if not isinstance(value, dict):
            raise self.wrong(key, value, expected)
        return _Table(value, self._path, f"{self._prefix}{key}.")

    def tables(self, key: str) -> dict[str, _Table]:
        """Tables by their names; none if there is no such key."""
        if not self.has(key):
            return {}
        inner = self.table(key, f"tables [{key}.NAME]")
        for name in inner._values:
            if not re.fullmatch(_NAME, name) or name == VEHICLE:
                raise InputError(
                    f"{inner.where(name)}: a sensor's name is letters, digits, _ and -, and not {VEHICLE!r}; it "
                    "becomes a folder."
                )
        return {name: inner.table(name, f"a table [{key}.{name}]") for name in list(inner._values)}

    def finish(self) -> None:
        """Every key that is left is one that nobody knows."""
        for key in self._values:
            similar = difflib.get_close_matches(key, self._known, 1, 0.6)
            hint = f" Is {similar[0]} meant?" if similar else ""
            raise InputError(
                f"{self.where(key)}: unknown key;{hint} known are {', '.join(dict.fromkeys(self._known))}."
            )


def _rig(table: _Table, root: Path) -> Rig:
    cameras = tuple(_camera(inner, name, root) for name, inner in table.tables("cameras").items())
    lidars = tuple(_lidar(inner, name, root) for name, inner in table.tables("lidars").items())
    names = [sensor.name for sensor in (*cameras, *lidars)]
    poses = _poses(table.table("poses", "a table [poses]"), root, names) if table.has("poses") else None
    table.finish()
    path = Path(table.where("").removesuffix(": "))
    if not cameras:
        raise InputError(f"{path}: has no camera; expected a table [cameras.NAME] for each (docs/rig.md).")
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{path}: {min(twice)} is the name of a camera and of a scanner; give them different names.")
    if lidars and (both := [camera.name for camera in cameras if camera.depth]):
        raise InputError(
            f"{path}: cameras.{both[0]}.depth and [lidars.{lidars[0].name}]: depth maps take the place of LiDAR; give "
            "one or the other."
        )
    with_depth = [camera.name for camera in cameras if camera.depth]
    if with_depth and len(with_depth) < len(cameras):
        lacking = next(camera.name for camera in cameras if not camera.depth)
        raise InputError(f"{path}: cameras.{lacking}.depth is missing; give depth maps for every camera or for none.")
    return Rig(path, cameras, lidars, poses)


_MODEL_KEYS = {
    "mei": ("xi", "k1", "k2", "p1", "p2"),
    "kannala-brandt": ("k1", "k2", "k3", "k4"),
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
}
"""Models, and what they have beside focal lengths and principal point; 0 if it is left out, but for ξ."""


def _camera(table: _Table, name: str, root: Path) -> RigCamera:
    found = RigCamera(
        name=name,
        camera=_model(table),
        to_vehicle=_to_vehicle(table),
        images=_files(table, "images", "the folder of its pictures, or a pattern such as 'front/*.png'", root),
        clock=_clock(table, root),
        ego_mask=_path(table, "ego_mask", "a PNG, 255 = use the pixel", root),
        masks=_optional_files(table, "masks", "the folder of its pictures' masks", root),
        mono=_optional_files(table, "mono", "the folder of its monocular distance maps", root),
        truth_distance=_optional_files(table, "truth_distance", "the folder of its true distance maps", root),
        truth_rgb=_optional_files(table, "truth_rgb", "the folder of its pictures without noise", root),
        depth=_depth(table, root) if table.has("depth") else None,
    )
    table.finish()
    return found


def _model(table: _Table) -> Camera:
    model = table.choice("model", tuple(_MODEL_KEYS))
    width, height = (table.whole(key, 1, MAX_SIDE_PX) for key in ("width", "height"))
    fx, fy = (table.number(key, above=0.0) for key in ("fx", "fy"))
    cx, cy = (table.number(key) for key in ("cx", "cy"))
    centre = table.choice("pixel_centre", (0, 0.5, 1), default=0)
    for key, value, size in (("cx", cx, width), ("cy", cy, height)):
        if not 0 < value < size:
            raise table.wrong(key, value, f"a pixel within the picture, 0 to {size}")
    rest = {key: table.number(key, None if key == "xi" else 0.0) for key in _MODEL_KEYS[model]}
    limit_rad = math.radians(table.number("theta_max_deg", 180.0, above=0.0))
    common = (width, height, fx, fy, cx + 0.5 - centre, cy + 0.5 - centre)
    kinds: dict[str, Any] = {"mei": MEI, "kannala-brandt": KannalaBrandt, "pinhole": Pinhole}
    try:
        return kinds[model](*common, **rest, theta_limit_rad=min(limit_rad, math.pi))
    except InputError as error:
        raise InputError(f"{table.where('model')}: {error}") from None


def _to_vehicle(table: _Table) -> Transform:
    expected = "4 rows of 4 numbers, or {translation = [x, y, z], quaternion = [qx, qy, qz, qw]}"
    where = table.where("to_vehicle")
    value = table.take("to_vehicle", expected)
    if not isinstance(value, dict):
        return transform_of_rows(value, where)
    inner = _Table(value, table._path, f"{table._prefix}to_vehicle.")
    numbers = []
    for key, count in (("translation", 3), ("quaternion", 4)):
        given = inner.take(key, f"{count} numbers")
        values = [finite(item) for item in given] if isinstance(given, list) else []
        usable = [value for value in values if value is not None]
        if not len(values) == len(usable) == count:
            raise inner.wrong(key, given, f"{count} numbers")
        numbers.append(usable)
    inner.finish()
    return pose_of_quaternion(numbers[0], numbers[1], where)


def _path(table: _Table, key: str, expected: str, root: Path) -> Path | None:
    given = table.optional_text(key, expected)
    return None if given is None else path_inside(root, given, table.where(key))


def _files(table: _Table, key: str, expected: str, root: Path) -> str:
    """A folder or a pattern, which stays in the recording's folder."""
    given = table.text(key, expected)
    path_inside(root, given, table.where(key))
    return given


def _optional_files(table: _Table, key: str, expected: str, root: Path) -> str | None:
    return _files(table, key, expected, root) if table.has(key) else None


def _clock(table: _Table, root: Path) -> Clock:
    keys = ("times_file", "times_from_names", "rate_hz")
    given = [key for key in keys if table.has(key)]
    if len(given) != 1:
        found = " and ".join(given) if given else "none"
        raise InputError(
            f"{table.where('times_file')}: expected one of {', '.join(keys)}, found {found}: each file needs a time."
            f"{'' if given else table.slip_for(*keys)}"
        )
    if table.has("times_from_names"):
        table.choice("times_from_names", (True,))
    clock = Clock(
        file=_path(table, "times_file", "a text file with a time for each file", root),
        from_names=given == ["times_from_names"],
        rate_hz=table.number("rate_hz", above=1e-9) if table.has("rate_hz") else None,
        seconds_per_count=_SECONDS[table.choice("time_unit", tuple(_SECONDS), "s")],
        offset_s=table.number("time_offset_s", 0.0),
    )
    return clock


def _depth(table: _Table, root: Path) -> DepthMaps:
    inner = table.table("depth", "{files = 'depth/front', kind = 'z_depth', metres_per_count = 0.001}")
    found = DepthMaps(
        files=_files(inner, "files", "the folder of the maps", root),
        kind=inner.choice("kind", ("z_depth", "distance")),
        metres_per_count=inner.number("metres_per_count", above=1e-12, most=1e6),
    )
    inner.finish()
    return found


def _lidar(table: _Table, name: str, root: Path) -> RigLidar:
    scans = _files(table, "scans", "the folder of its scans, or a pattern such as 'lidar/*.bin'", root)
    names = {}
    if table.has("names"):
        inner = table.table("names", "a table such as {x = 'X', intensity = 'i'}")
        for quantity in ("x", "y", "z", "intensity"):
            if (called := inner.optional_text(quantity, "a column's name")) is not None:
                names[quantity] = called
        inner.finish()
    scan = ScanFormat(
        columns=table.texts("columns", ScanFormat().columns),
        dtype=table.choice("dtype", ("float32", "float64"), "float32"),
        names=names,
        times=_point_times(table),
    )
    turn_s, to_middle_s, timing = _timing(table)
    if timing is not None and scan.times is not None:
        where = table.where("direction")
        raise InputError(f"{where}: points with times of their own (point_times) need no direction; take one away.")
    found = RigLidar(
        name=name,
        to_vehicle=_to_vehicle(table),
        scans=scans,
        format=scan,
        clock=_clock(table, root),
        turn_s=turn_s,
        to_middle_s=to_middle_s,
        timing=timing,
    )
    table.finish()
    return found


def _point_times(table: _Table) -> PointTimes | None:
    if not table.has("point_times"):
        return None
    inner = table.table("point_times", "{column = 't', unit = 'ns', counted_from = 'timestamp'}")
    found = PointTimes(
        column=inner.text("column", "a column's name"),
        seconds_per_count=_SECONDS[inner.choice("unit", tuple(_SECONDS), "s")],
        absolute=inner.choice("counted_from", ("timestamp", "clock")) == "clock",
    )
    inner.finish()
    return found


def _timing(table: _Table) -> tuple[float | None, float, SweepTiming | None]:
    """How long a turn takes, how long after a scan's timestamp its middle is, and when each azimuth is measured."""
    turns = table.has("direction")
    for key in ("direction", "start_azimuth_deg", "timestamp"):
        if table.has(key) and not table.has("turn_s"):
            raise InputError(f"{table.where('turn_s')} is missing; {key} says nothing without it.")
    if not table.has("turn_s"):
        return None, 0.0, None
    turn_s = table.number("turn_s", above=1e-9, most=1e5)
    moment = table.choice("timestamp", ("start", "middle", "end"))
    to_middle_s = {"start": turn_s / 2, "middle": 0.0, "end": -turn_s / 2}[moment]
    if not turns:
        return turn_s, to_middle_s, None
    clockwise = table.choice("direction", ("clockwise", "counter-clockwise")) == "clockwise"
    # in the middle of a turn the scanner looks away from where it begins
    reference_rad = math.radians(table.number("start_azimuth_deg", 180.0) + 180.0)
    return turn_s, to_middle_s, SweepTiming(turn_s, clockwise, math.remainder(reference_rad, 2 * math.pi))


def _poses(table: _Table, root: Path, sensors: list[str]) -> RigPoses:
    expected = "the file of the poses"
    file = path_inside(root, table.text("file", expected), table.where("file"))
    kind = table.choice("format", ("tum", "kitti", "nerfstudio"))
    clock = _clock(table, root) if kind == "kitti" else None
    found = RigPoses(
        file=file,
        format=kind,
        of=VEHICLE if kind == "nerfstudio" else table.choice("of", (VEHICLE, *sensors), VEHICLE),
        clock=clock,
        metres_per_unit=table.number("metres_per_unit", 1.0, above=1e-12, most=1e6),
        up=table.choice("up", ("x", "y", "z", "-x", "-y", "-z"), "z"),
    )
    table.finish()
    return found
