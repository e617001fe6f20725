"""Scans of ROS messages: sensor_msgs/PointCloud2, and the CustomMsg of Livox's drivers.

Drivers write the time of each point as `t`, `time`, `timestamp` or `offset_time`, in seconds or parts of them, counted
from the scan's stamp or from 1970, and no message tells which. The values do: a scan takes about as long as the time
from one to the next, and the units lie a factor of a thousand apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.sweeps import MAX_POINTS

TIME_FIELDS = ("t", "time", "timestamp", "timestamps", "offset_time", "time_stamp", "time_offset")
"""What fields with a point's time are called."""
INTENSITY_FIELDS = ("intensity", "intensities", "reflectivity", "reflectance", "i")
"""What fields with its brightness are called."""
USUAL_TURN_S = 0.1
"""From one scan to the next, where there is only one."""
_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy's names of the types of PointField."""
_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_SHORTEST, _LONGEST = 0.05, 1.6
"""A scan takes between these shares of the time from one to the next."""
_STEPS = 50
"""So many different times a scan has at least, or it has none."""


@dataclass(frozen=True)
class PointTimes:
    """What the values of the points' times mean."""

    field: str
    unit: str
    counted_from: str
    """stamp: the scan's; 1970: the clock of the stamps; first: another clock, so they count from the first point."""


def fields_of(message: Any) -> dict[str, Any]:
    """The fields of a PointCloud2 by what they mean: x, y, z, and intensity and time if it has them."""
    fields = {field.name: field for field in message.fields if field.datatype in _KINDS}
    names = {"x": ("x",), "y": ("y",), "z": ("z",), "intensity": INTENSITY_FIELDS, "time": TIME_FIELDS}
    found = {key: next((fields[name] for name in given if name in fields), None) for key, given in names.items()}
    return {key: field for key, field in found.items() if field is not None}


def columns_of(message: Any) -> dict[str, NDArray]:
    """x, y, z of a scan, with `intensity` and `time` where it has them, one value a point.

    Raises:
        InputError: it has no coordinates, or fewer bytes than its header says.
    """
    if not hasattr(message, "point_step"):
        return _livox_columns(message)
    fields = fields_of(message)
    if not fields.keys() >= {*"xyz"}:
        raise InputError("has no fields x, y and z")
    order = ">" if message.is_bigendian else "<"
    record = {
        "names": [*fields],
        "formats": [f"{order}{_KINDS[field.datatype]}" for field in fields.values()],
        "offsets": [field.offset for field in fields.values()],
        "itemsize": message.point_step,
    }
    try:
        kind = np.dtype(record)
    except ValueError as error:
        raise InputError(f"its fields do not fit into {message.point_step} bytes a point ({error})") from None
    width, height, step = message.width, message.height, message.row_step
    row = width * message.point_step
    if height == 1 or step < row:
        step = row
    count = width * height
    if count > MAX_POINTS or step * (height - 1) + row > len(message.data):
        raise InputError(f"{len(message.data)} bytes cannot hold {height} rows of {width} points")
    content = np.frombuffer(bytes(message.data), np.uint8)
    rows = [content[line * step : line * step + row].view(kind) for line in range(height)]
    points = np.concatenate(rows) if len(rows) > 1 else rows[0]
    return {name: points[name] for name in fields}


def _livox_columns(message: Any) -> dict[str, NDArray]:
    points = message.points
    kinds = {"x": np.float32, "y": np.float32, "z": np.float32, "reflectivity": np.float32, "offset_time": np.int64}
    found = {
        name: np.fromiter((getattr(point, name) for point in points), kind, len(points)) for name, kind in kinds.items()
    }
    return {**{axis: found[axis] for axis in "xyz"}, "intensity": found["reflectivity"], "time": found["offset_time"]}


def time_field(message: Any) -> str | None:
    """The field with the points' times, if there is one."""
    if not hasattr(message, "point_step"):
        return "offset_time"
    field = fields_of(message).get("time")
    return field and field.name


def find_times(
    samples: Sequence[tuple[int, NDArray]], field: str, interval_s: float | None
) -> tuple[PointTimes | None, str]:
    """Find out what the times of some scans mean.

    Args:
        samples: stamps (ns) and times, as the field has them, of points that were measured.
        field: its name.
        interval_s: from one scan to the next, if that is known.

    Returns:
        What they mean, None if they tell nothing; and what the user should know.
    """
    turn_s = interval_s or USUAL_TURN_S
    spans = [float(times.max()) - float(times.min()) for _, times in samples if len(times)]
    distinct = [len(np.unique(times)) for _, times in samples if len(times)]
    if not spans or max(spans) == 0 or max(distinct) < _STEPS:
        several = f"only {max(distinct, default=0)} different values in a scan"
        reason = several if samples and samples[0][1].dtype != np.float32 else f"{several}, as float32"
        return None, f"the field {field} has {reason}, which cannot be times of its points."
    span = float(np.median(spans))
    fitting = [unit for unit, scale in _UNITS.items() if _SHORTEST * turn_s <= span * scale <= _LONGEST * turn_s]
    if not fitting:
        return None, (f"the field {field} spans {span:g} in a scan, which is {turn_s:.3g} s in no unit from s to ns.")
    scale = _UNITS[fitting[0]]
    from_zero = [abs(float(np.median(times)) * scale) for _, times in samples if len(times)]
    if max(from_zero) <= 2 * turn_s:
        return PointTimes(field, fitting[0], "stamp"), ""
    from_1970 = [abs(_counted(times, stamp_ns, scale)).max() for stamp_ns, times in samples if len(times)]
    if max(from_1970) <= 2 * turn_s:
        return PointTimes(field, fitting[0], "1970"), ""
    return PointTimes(field, fitting[0], "first"), (
        f"the field {field} is of another clock than the scans' stamps; the first point is taken to have the stamp."
    )


def _counted(times: NDArray, stamp_ns: int, scale: float) -> Float64[np.ndarray, "points"]:
    """Times of the stamps' clock, counted from a stamp, seconds."""
    if times.dtype.kind in "iu":
        # whole numbers of nanoseconds are more exact than float64
        counts = round(stamp_ns / (scale * 1e9))
        return (times.astype(np.int64) - counts).astype(np.float64) * scale
    return times.astype(np.float64) * scale - stamp_ns / 1e9


def offsets_s(columns: dict[str, NDArray], times: PointTimes, stamp_ns: int) -> Float64[np.ndarray, "points"]:
    """When each point was measured, counted from the scan's stamp, seconds."""
    scale, values = _UNITS[times.unit], columns["time"]
    if times.counted_from == "1970":
        return _counted(values, stamp_ns, scale)
    if times.counted_from == "first":
        return (values - values[measured(columns)].min()).astype(np.float64) * scale
    return values.astype(np.float64) * scale


def measured(columns: dict[str, NDArray]) -> NDArray[np.bool_]:
    """Which points are an echo: drivers fill the others with NaN or zeros."""
    points = np.stack([columns[axis].astype(np.float32) for axis in "xyz"], -1)
    return np.isfinite(points).all(-1) & (points != 0).any(-1)


def table_of(columns: dict[str, NDArray], seconds: Float64[np.ndarray, "points"] | None) -> NDArray:
    """The points as the recording's files have them: x, y, z, intensity, and t, seconds from the stamp."""
    kinds = [(name, "<f4") for name in ("x", "y", "z", "intensity", *(["t"] if seconds is not None else []))]
    kept = measured(columns)
    table = np.zeros(int(kept.sum()), kinds)
    for name in ("x", "y", "z", "intensity"):
        if name in columns:
            table[name] = columns[name][kept]
    if seconds is not None:
        table["t"] = seconds[kept]
    return table
