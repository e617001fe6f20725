"""The file that describes a rig: rig.toml or rig.json. docs/rig.md says what each key means.

It is read strictly: a key that is missing, unknown or of another kind is an error that names the file and the key,
as in `rig.toml: cameras.front.fx`. Paths in it count from the recording's folder and stay in it. Nothing else is read
here. The classes are the tables of the file, held against their types by pydantic; what their validators raise is what
stands behind the name of the key.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    WrapValidator,
    field_validator,
    model_validator,
)
from pydantic.fields import FieldInfo

from edge_depth_nerf.base.bounds import MAX_TIME_S, path_inside, read_text, shown
from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.calibration_file import LENS, LENS_NUMBERS, RATIONAL, lens_of, parse_toml, read_lens
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar.scans import PointTimes, ScanFormat
from edge_depth_nerf.lidar.sweeps import SweepTiming
from edge_depth_nerf.process.poses import pose_of_quaternion, transform_of_rows

VEHICLE = "vehicle"
"""The frame that every sensor's transform leads to."""
MAX_SIDE_PX = 20_000
"""No picture is larger."""
MAX_RIG_BYTES = 1 << 18
"""No rig file is larger: a thousand sensors."""
TODO = "TODO"
"""A text that begins so stands for a value that is not known yet; what follows says what it is."""
_TODO_LINE = re.compile(rf"""\s*([\w.-]+)\s*=\s*["']{TODO}:?\s*(.*?)["']\s*(#.*)?""")
_TABLE_LINE = re.compile(r"\s*\[([^\[\]]+)\]\s*(#.*)?")
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_NAME = r"[A-Za-z0-9_][A-Za-z0-9_-]*"


def _inside(value: object, info: Any) -> Path:
    return path_inside(info.context["root"], value, "")


def _sensor_name(name: str) -> str:
    if not re.fullmatch(_NAME, name) or name == VEHICLE:
        raise InputError(f": a sensor's name is letters, digits, _ and -, and not {VEHICLE!r}; it becomes a folder.")
    return name


def _different(names: list[str]) -> list[str]:
    if not names or len(set(names)) != len(names):
        raise InputError(f" is {shown(names)}, expected different names, such as ['x', 'y', 'z', 'intensity'].")
    return names


def _transform(value: object, read: Callable[[Any], Any]) -> Transform:
    if not isinstance(value, dict):
        return transform_of_rows(value, "")
    pose: _Pose = read(value)
    return pose_of_quaternion(pose.translation, pose.quaternion, "")


Number = Annotated[float, Field(ge=-MAX_TIME_S, le=MAX_TIME_S, description=f"a number, at most {MAX_TIME_S:g}")]
Positive = Annotated[float, Field(gt=0, le=MAX_TIME_S, description=f"a number above 0, at most {MAX_TIME_S:g}")]
Scale = Annotated[float, Field(gt=1e-12, le=1e6, description="a number above 1e-12, at most 1e+06")]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX, description=f"a whole number from 1 to {MAX_SIDE_PX}")]
Text = Annotated[str, Field(min_length=1, description="a name")]
File = Annotated[Path, BeforeValidator(_inside), Field(description="a file in the recording's folder")]
Files = Annotated[
    str,
    BeforeValidator(lambda value, info: _inside(value, info) and value),
    Field(description="a folder, or a pattern such as 'front/*.png'"),
]
"""In the recording's folder."""
SensorName = Annotated[str, AfterValidator(_sensor_name)]
Unit = Literal["s", "ms", "us", "ns"]


class _Table(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False, frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, values: Any) -> Any:
        """Look for missing and unknown keys, and say which is meant."""
        if not isinstance(values, dict):
            raise InputError(f" is {shown(values)}, expected a table.")
        needed = cls._needed(values)
        for name, field in cls.model_fields.items():
            if name in needed and values.get(name) is None:
                close = difflib.get_close_matches(name, values.keys() - cls.model_fields.keys(), 1, 0.75)
                slip = f" There is {close[0]}: is {name} meant?" if close else ""
                raise InputError(f".{name} is missing; expected {_expected(field)}.{slip}")
        for name in values:
            if name not in cls.model_fields:
                close = difflib.get_close_matches(name, cls.model_fields, 1, 0.6)
                slip = f" Is {close[0]} meant?" if close else ""
                hint = f" {RATIONAL}." if name in ("k5", "k6") and "k4" in cls.model_fields else ""
                raise InputError(f".{name}: unknown key;{slip} known are {', '.join(cls.model_fields)}.{hint}")
        return values

    @classmethod
    def _needed(cls, values: dict[str, Any]) -> set[str]:
        """The keys without which it says too little."""
        return {name for name, field in cls.model_fields.items() if field.is_required()}

    @field_validator("*", mode="wrap")
    @classmethod
    def _check_value(cls, value: Any, read: Callable[[Any], Any], info: Any) -> Any:
        """Say in our words what is expected."""
        try:
            return read(value)
        except ValidationError as error:
            first = error.errors()[0]
            if first["loc"] or "error" in first.get("ctx", {}):
                raise
            ours = _expected(cls.model_fields[str(info.field_name)])
            expected = ours or first["msg"].removeprefix("Input should be ")
            raise InputError(f" is {shown(value)}, expected {expected}.") from None


def _expected(field: FieldInfo) -> str | None:
    """What a value is, in words."""
    kinds = [field.annotation, *get_args(field.annotation)]
    for kind in kinds:
        if choices := [one for one in get_args(kind) if isinstance(one, str)]:
            return f"one of {', '.join(map(repr, choices))}"
    metadata = [meta for kind in kinds for meta in getattr(kind, "__metadata__", ()) if isinstance(meta, FieldInfo)]
    return field.description or next((meta.description for meta in metadata), None)


class _Pose(_Table):
    translation: Annotated[list[Number], Field(min_length=3, max_length=3, description="3 numbers")]
    quaternion: Annotated[list[Number], Field(min_length=4, max_length=4, description="4 numbers")]


if TYPE_CHECKING:
    ToVehicle = Transform
else:
    _FORMS = "4 rows of 4 numbers, or {translation = [x, y, z], quaternion = [qx, qy, qz, qw]}"
    ToVehicle = Annotated[_Pose, WrapValidator(_transform), Field(description=_FORMS)]


class Clock(_Table):
    """How the files of a sensor tell their times; one of the first three is set."""

    times_file: File | None = None
    """A text file with a time for each file."""
    times_from_names: Literal[True] | None = None
    """The last number in a file's name is its time."""
    rate_hz: Positive | None = None
    """The last number in a file's name, divided by this, is its time in seconds."""
    time_unit: Unit = "s"
    time_offset_s: Number = 0.0
    """Added to each time, to bring it to the clock of the poses."""

    def check_clock(self) -> None:
        """Raise an InputError unless times are told in one way."""
        keys = ("times_file", "times_from_names", "rate_hz")
        given = [name for name in keys if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none"
            raise InputError(f".times_file: expected one of {', '.join(keys)}, found {found}: each file needs a time.")

    def seconds(self, counts: Sequence[float]) -> list[float]:
        """Times of the poses' clock, in seconds, of the numbers in files or names."""
        scale = 1 / self.rate_hz if self.rate_hz else _SECONDS[self.time_unit]
        return [count * scale + self.time_offset_s for count in counts]


class _Sensor(Clock):
    _name: str = PrivateAttr("")

    @property
    def name(self) -> str:
        """Its table's; becomes a folder."""
        return self._name


class DepthMaps(_Table):
    """Depth maps that come with a camera's pictures, instead of LiDAR."""

    files: Files
    kind: Literal["z_depth", "distance"]
    """Along the optical axis, or along the ray."""
    metres_per_count: Scale


class CalibrationFile(_Table):
    """A calibration tool's file, instead of a lens's numbers."""

    file: File
    camera: Text = ""
    """Which of its cameras, where there are several."""


class RigCamera(_Sensor):
    """A camera of the rig."""

    calibration: CalibrationFile | None = None
    """Takes the place of `LENS` and `LENS_NUMBERS`."""
    model: (
        Literal["mei", "kannala-brandt", "opencv_fisheye", "equidistant", "pinhole", "double-sphere", "ds", "eucm"]
        | None
    ) = None
    width: Side | None = None
    height: Side | None = None
    fx: Positive | None = None
    fy: Positive | None = None
    cx: Number | None = None
    cy: Number | None = None
    pixel_centre: float = 0
    xi: Number | None = None
    alpha: Number | None = None
    beta: Number | None = None
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    theta_max_deg: Positive = 180.0
    to_vehicle: ToVehicle
    """From its frame to the vehicle's."""
    images: Files
    ego_mask: File | None = None
    """What of its pictures is never used."""
    masks: Files | None = None
    mono: Files | None = None
    truth_distance: Files | None = None
    truth_rgb: Files | None = None
    depth: DepthMaps | None = None

    @field_validator("model", mode="before")
    @classmethod
    def _check_model(cls, value: Any) -> Any:
        if value in ("rational", "rational_polynomial"):
            raise InputError(f" is {value!r}: {RATIONAL}.")
        return value

    @classmethod
    def _needed(cls, values: dict[str, Any]) -> set[str]:
        return super()._needed(values) | ({*LENS} if values.get("calibration") is None else set())

    @cached_property
    def camera(self) -> Camera:
        """Its model, pixel centres at +0.5."""
        if self.calibration:
            camera = self._calibrated()
        else:
            keys = self.model_fields_set & {*LENS, *LENS_NUMBERS, "pixel_centre"}
            camera = lens_of({key: getattr(self, key) for key in keys})
        limit_rad = min(math.radians(self.theta_max_deg), camera.theta_limit_rad)
        return replace(camera, theta_limit_rad=limit_rad)

    def _calibrated(self) -> Camera:
        assert self.calibration is not None
        if twice := self.model_fields_set & {*LENS, *LENS_NUMBERS, "pixel_centre"}:
            raise InputError(f".{min(twice)}: the calibration file describes the lens; remove one of them.")
        with found_in(".calibration"):
            return read_lens(self.calibration.file, self.calibration.camera)

    @model_validator(mode="after")
    def _check(self) -> RigCamera:
        self.check_clock()
        assert self.camera
        return self


class _Names(_Table):
    x: Text = "x"
    y: Text = "y"
    z: Text = "z"
    intensity: Text = "intensity"


class _PointTimes(_Table):
    column: Text
    unit: Unit = "s"
    counted_from: Literal["timestamp", "clock"]


class RigLidar(_Sensor):
    """A scanner of the rig."""

    to_vehicle: ToVehicle
    """From its frame to the vehicle's."""
    scans: Files
    columns: Annotated[list[Text], AfterValidator(_different)] = list(ScanFormat().columns)
    dtype: Literal["float32", "float64"] = "float32"
    array: Text | None = None
    """Name of the points' array in .npz files."""
    names: _Names = _Names()
    metres_per_unit: Scale = 1.0
    """Of its points' coordinates."""
    points_in: Literal["scanner", "vehicle"] = "scanner"
    """The frame of its points."""
    corrected_to: Literal["timestamp", "start", "middle", "end"] | None = None
    """The time of the vehicle's pose that the points were corrected to; None = they are uncorrected."""
    point_times: _PointTimes | None = None
    turn_s: Annotated[float, Field(gt=1e-9, le=1e5, description="a number above 1e-09, at most 100000")] | None = None
    """How long a scan takes; None = from one to the next."""
    timestamp: Literal["start", "middle", "end"] | None = None
    direction: Literal["clockwise", "counter-clockwise"] | None = None
    start_azimuth_deg: Number = 180.0

    @cached_property
    def format(self) -> ScanFormat:
        """What its columns mean."""
        times = self.point_times
        return ScanFormat(
            columns=tuple(self.columns),
            dtype=self.dtype,
            array=self.array,
            names=self.names.model_dump(),
            metres_per_unit=self.metres_per_unit,
            times=PointTimes(times.column, _SECONDS[times.unit], times.counted_from == "clock") if times else None,
        )

    @property
    def to_middle_s(self) -> float:
        """From a scan's timestamp to its middle."""
        return {"start": 0.5, "end": -0.5}.get(self.timestamp or "middle", 0.0) * (self.turn_s or 0.0)

    @property
    def to_pose_s(self) -> float:
        """From a scan's timestamp to the time of the pose that its points belong to: its middle, or another one."""
        if self.corrected_to == "timestamp":
            return 0.0
        return self.to_middle_s + {"start": -0.5, "end": 0.5}.get(self.corrected_to or "", 0.0) * (self.turn_s or 0.0)

    @cached_property
    def timing(self) -> SweepTiming | None:
        """When each azimuth is measured, counted from the middle; None = unknown, or points have times."""
        if self.turn_s is None or self.direction is None:
            return None
        # in the middle of a turn the scanner looks away from where it begins
        reference_rad = math.remainder(math.radians(self.start_azimuth_deg + 180.0), 2 * math.pi)
        return SweepTiming(self.turn_s, self.direction == "clockwise", reference_rad)

    @model_validator(mode="after")
    def _check(self) -> RigLidar:
        self.check_clock()
        without_turn = sorted({"direction", "start_azimuth_deg", "timestamp"} & self.model_fields_set)
        if self.turn_s is None and without_turn:
            raise InputError(f".turn_s is missing; {without_turn[-1]} needs it.")
        if self.turn_s is not None and self.timestamp is None:
            raise InputError(".timestamp is missing; expected one of 'start', 'middle', 'end'.")
        if self.corrected_to is not None:
            if wrong := sorted({"direction", "start_azimuth_deg", "point_times"} & self.model_fields_set):
                raise InputError(
                    f".{wrong[0]}: points that are corrected already (corrected_to) need no times; remove one."
                )
            if self.corrected_to != "timestamp" and self.turn_s is None:
                raise InputError(f".turn_s is missing; corrected_to = {self.corrected_to!r} needs it.")
        if self.timing is not None and self.point_times is not None:
            raise InputError(".direction: points with times of their own (point_times) need no direction; remove one.")
        return self


class RigPoses(Clock):
    """Where the poses come from; KITTI's have a clock."""

    file: File
    format: Literal["tum", "kitti", "nerfstudio"]
    of: Text = VEHICLE
    """Whose poses they are: the vehicle's, or a sensor's."""
    metres_per_unit: Scale = 1.0
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    """Which axis of their world points up."""

    @model_validator(mode="after")
    def _check(self) -> RigPoses:
        if self.format == "kitti":
            self.check_clock()
        elif clock := self.model_fields_set & Clock.model_fields.keys():
            raise InputError(f".{min(clock)}: unknown key; poses of format {self.format} bring their times.")
        return self


class _Whole(_Table):
    cameras: dict[SensorName, RigCamera] = Field({}, description="tables [cameras.NAME]")
    lidars: dict[SensorName, RigLidar] = Field({}, description="tables [lidars.NAME]")
    poses: RigPoses | None = None


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
    parse, syntax = (json.loads, "JSON") if path.suffix.lower() == ".json" else (parse_toml, "TOML")
    text = read_text(path, MAX_RIG_BYTES)
    if syntax == "TOML":
        _check_todo(text, path)
    try:
        content = parse(text)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: not valid {syntax} ({error}). Repair the file; docs/rig.md has an example."
        ) from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected tables [cameras.NAME], [lidars.NAME] and [poses].")
    if prepare is not None:
        prepare(content)
    return rig_of(content, path, root)


def rig_of(content: dict[str, Any], path: Path, root: Path) -> Rig:
    """Check the tables of a rig file, or those that a data set's own calibration makes; errors name `path`.

    Raises:
        InputError: a key is missing, unknown or wrong.
    """
    try:
        return _rig(_Whole.model_validate(content, context={"root": root}), path)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"] if part != "[key]")
        said = first.get("ctx", {}).get("error") or f" is {shown(first['input'])}: {first['msg']}."
        raise InputError(f"{path}: {f'{key}{said}'.removeprefix('.')}") from None


def _check_todo(text: str, path: Path) -> None:
    """Refuse values that are still to be filled in, by their lines."""
    table, found = "", []
    for number, line in enumerate(text.splitlines(), 1):
        if heading := _TABLE_LINE.fullmatch(line):
            table = f"{heading[1].strip()}."
        elif todo := _TODO_LINE.fullmatch(line):
            found.append((number, f"{table}{todo[1]}", todo[2]))
    if not found:
        return
    number, key, what = found[0]
    others = ", ".join(str(number) for number, _, _ in found[1:20])
    more = f" {TODO} stands in lines {others}, too." if others else ""
    raise InputError(
        f"{path}, line {number}: {key} is a {TODO}; write there what it asks for: {what or 'a value'}.{more}"
    )


def _rig(whole: _Whole, path: Path) -> Rig:
    for sensors in (whole.cameras, whole.lidars):
        for name, sensor in sensors.items():
            sensor._name = name
    cameras, lidars, poses = tuple(whole.cameras.values()), tuple(whole.lidars.values()), whole.poses
    names = [sensor.name for sensor in (*cameras, *lidars)]
    if poses and poses.of not in (VEHICLE, *names):
        known = ", ".join(map(repr, (VEHICLE, *names)))
        raise InputError(f"{path}: poses.of is {shown(poses.of)}, expected one of {known}.")
    if not cameras:
        raise InputError(f"{path}: has no camera; expected a table [cameras.NAME] for each (docs/rig.md).")
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{path}: {min(twice)} is the name of both a camera and a scanner; use different names.")
    if lidars and (both := [camera.name for camera in cameras if camera.depth]):
        raise InputError(
            f"{path}: cameras.{both[0]}.depth and [lidars.{lidars[0].name}]: depth maps take the place of LiDAR; give "
            "one of them, not both."
        )
    return Rig(path, cameras, lidars, poses)
