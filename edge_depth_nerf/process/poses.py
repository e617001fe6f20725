"""Poses and times in the formats that people have: TUM, KITTI, nerfstudio; and the text files behind them.

Transforms are 4×4, metres, sensor to world; nerfstudio's are turned from OpenGL's camera axes to OpenCV's. Each error
names the file and the line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime, timezone
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.bounds import MAX_LENGTH_M, MAX_TIME_S, shown, text_lines
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.cameras.transforms import Transform, check_rigid, rigid

QUATERNION_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1; four written digits still pass."""
SAME_POSE_M, SAME_POSE_DEG = 0.02, 0.2
"""Poses of one time that differ by no more are one; the first counts."""
_HEADING = re.compile(r"[\"'A-Za-z_\[\]().:/-]+")
"""What a column may be called in a first line that is no data."""

DOUBLED_SHARE, FEW_POSES = 0.01, 10
"""Of so many lines the time may be that of the line before; of one in any case, if there are not fewer poses."""


def read_tum(path: Path) -> tuple[Float64[np.ndarray, "poses"], Float64[np.ndarray, "poses 4 4"], list[int]]:
    """Read TUM's format: lines "time x y z qx qy qz qw"; seconds, metres, a unit quaternion.

    A pose of the same time as the one before is left out; of those that differ from it, a few are, as the rounding of
    times makes them.

    Returns:
        Times, increasing, poses, and the numbers of the lines that were left out and differ.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is not such a pose, or the times do not increase.
    """
    lines, rows = [], []
    for line, values in _number_lines(path):
        if len(values) != 8:
            of_euroc = " as EuRoC's ground truth has (nanoseconds, and qw first)" if len(values) == 17 else ""
            raise InputError(
                f"{path}, line {line}: {len(values)} numbers{of_euroc}, expected 8 (time x y z qx qy qz qw, TUM's "
                "format, in seconds). Check poses.format in the rig file, or write the file in that form."
            )
        if abs(values[0]) > MAX_TIME_S:
            raise InputError(f"{path}, line {line}: its time {values[0]:g} is no time in seconds.")
        lines.append(line)
        rows.append(values)
    table = np.array(rows, np.float64).reshape(-1, 8)
    turned = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1) <= QUATERNION_TOLERANCE
    for index in np.flatnonzero(~turned | (np.abs(table[:, 1:4]) > MAX_LENGTH_M).any(axis=1))[:1]:
        # it says what is wrong
        pose_of_quaternion(rows[index][1:4], rows[index][4:], f"{path}, line {lines[index]}")
    poses = rigid(Rotation.from_quat(table[:, 4:]).as_matrix(), table[:, 1:4]) if rows else np.empty((0, 4, 4))
    kept, doubled = [0] * bool(rows), []
    for index, (before_s, time_s) in enumerate(pairwise(table[:, 0].tolist()), 1):
        if time_s > before_s:
            kept.append(index)
        # sensors that were read at once bring the vehicle's pose each
        elif not (time_s == before_s and _same(poses[index], poses[kept[-1]])):
            said = (
                f"{path}, line {lines[index]}: its time {time_s:.6f} is not after {before_s:.6f} of the line before. "
                f"Sort them by time; poses of one time must agree within {100 * SAME_POSE_M:g} cm and "
                f"{SAME_POSE_DEG:g}°."
            )
            if time_s < before_s:
                raise InputError(said)
            doubled.append((lines[index], said))
    if len(doubled) > max(DOUBLED_SHARE * len(kept), len(kept) >= FEW_POSES):
        raise InputError(doubled[0][1])
    return table[kept, 0], poses[kept], [line for line, _ in doubled]


def tum_text(times_s: Float64[np.ndarray, "poses"], poses: Float64[np.ndarray, "poses 4 4"]) -> str:
    """Poses, at least one, in TUM's format."""
    rows = np.column_stack((times_s, poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()))
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def _same(pose: Transform, other: Transform) -> bool:
    turn_deg = np.degrees(Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3]).magnitude())
    return bool(np.linalg.norm(pose[:3, 3] - other[:3, 3]) <= SAME_POSE_M and turn_deg <= SAME_POSE_DEG)


def read_kitti(path: Path) -> Float64[np.ndarray, "poses 4 4"]:
    """Read KITTI's format: lines of 12 numbers, the upper 3×4 of each pose, row by row. Times are elsewhere.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is not such a pose.
    """
    poses = []
    for line, values in _number_lines(path):
        of_tum = " as TUM's format has" if len(values) == 8 else ""
        if len(values) != 12:
            raise InputError(
                f"{path}, line {line}: {len(values)} numbers{of_tum}, expected 12 (a 3×4 matrix row by row, KITTI's "
                "format). Check poses.format in the rig file."
            )
        poses.append(transform_of_rows(np.reshape(values, (3, 4)), f"{path}, line {line}"))
    return np.array(poses, np.float64).reshape(-1, 4, 4)


def read_nerfstudio(path: Path) -> dict[str, Transform]:
    """Read the frames of a nerfstudio transforms.json.

    Returns:
        Camera-to-world poses with OpenCV's camera axes, by file_path without its suffix, as written there.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: no frames, or a frame without name or pose.
    """
    content = read_json(path)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: has no list of frames; expected nerfstudio's transforms.json.")
    poses = {}
    for number, frame in enumerate(frames):
        where = f"{path}: frames[{number}]"
        named = isinstance(frame, dict) and isinstance(frame.get("file_path"), str) and Path(frame["file_path"]).name
        if not named:
            raise InputError(f"{where} has no file_path; expected nerfstudio's transforms.json.")
        pose = transform_of_rows(frame.get("transform_matrix"), f"{where}.transform_matrix")
        name = str(Path(frame["file_path"]).with_suffix(""))
        if name in poses:
            raise InputError(f"{where}: {frame['file_path']} has a pose already; expected one for each picture.")
        # OpenGL's camera has y up and z backwards
        poses[name] = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
    return poses


def read_times(path: Path, unit: str = "s") -> list[tuple[str | None, float]]:
    """Read a time a line: "TIME", "NAME TIME", or "TIME NAME" where the name is no number.

    Dates, as in KITTI's timestamps.txt, are read as UTC. A first line of names alone is passed over.

    Args:
        path: the file.
        unit: what the rig file says that its numbers count, for the check that dates come without one.

    Returns:
        Names, None where there are none, and times in the file's unit; dates as seconds since 1970.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is something else, or lines have different forms.
    """
    found: list[tuple[str | None, float]] = []
    first = ""
    for line, words in _lines(path):
        form, name, time = _time_of_line(words, first, f"{path}, line {line}")
        if form == "date" and unit != "s":
            raise InputError(
                f"{path}, line {line}: the time is a date, but time_unit is {unit!r}. Dates need no unit: leave out "
                "time_unit."
            )
        first = first or form
        if form != first:
            raise InputError(
                f"{path}, line {line}: some lines have a file's name and some have none, or have it elsewhere ({form}, "
                f"after {first}); use one form for all lines."
            )
        found.append((name, time))
    return found


def read_frame_times(path: Path, otherwise: str = "") -> list[float]:
    """Read the times of a data set's frames, a line each; `otherwise`: what else to do than to copy the file again.

    The line of a lost frame is empty, as in some of KITTI's drives. It gets a time between its neighbours'; before the
    first one, the usual interval counts.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: a line is no time, or not after the one before.
    """
    times_s = [time for _, time in read_times(path)]
    for line, (before, time) in enumerate(pairwise(times_s), 2):
        if not time > before:
            raise InputError(
                f"{path}, line {line}: not after the line before. Copy the file again from the data set{otherwise}."
            )
    lines = [line for line, _ in _lines(path)]
    if not lines or lines[-1] == len(lines):
        return times_s
    every = np.arange(1, lines[-1] + 1)
    interval_s = float(np.median(np.diff(times_s) / np.diff(lines))) if len(lines) > 1 else 0.0
    return (np.interp(every, lines, times_s) + interval_s * np.minimum(every - lines[0], 0)).tolist()


def _time_of_line(words: list[str], first: str, where: str) -> tuple[str, str | None, float]:
    """The form of a line, and its name and time; `first`: that of the first line, if this is another."""
    text = " ".join(words)
    if (dated := seconds_of_date(text)) is not None:
        return "date", None, dated
    if first == "date":
        raise InputError(
            f"{where}: {shown(text)} is not a time like 2013-05-28 08:46:02.123456789, as the lines before it. Copy "
            "the file again."
        )
    if len(words) > 2:
        raise InputError(
            f"{where}: {len(words)} words, expected a time, a file's name and a time, a time and a file's name, or a "
            "date as 2013-05-28 08:46:02.123456789."
        )
    if len(words) == 1:
        return "TIME", None, finite_number(words[0], where)
    if not _is_number(words[1]) and _is_number(words[0]):
        return "TIME NAME", words[1], finite_number(words[0], where)
    return "NAME TIME", words[0], finite_number(words[1], where)


def seconds_of_date(text: str) -> float | None:
    """Seconds since 1970 of a date like 2013-05-28 08:46:02.123456789, read as UTC, to some 0.2 µs; else None."""
    # datetime stops at microseconds
    whole, _, fraction = text.removesuffix("Z").partition(".")
    if not re.fullmatch(r"[0-9]*", fraction):
        return None
    try:
        stamp = datetime.strptime(whole.replace("T", " "), "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
    except ValueError:
        return None
    return stamp.timestamp() + float(f"0.{fraction or 0}")


def pose_of_quaternion(translation: list[float], quaternion: list[float], where: str) -> Transform:
    """Make a transform of x, y, z and qx, qy, qz, qw.

    Raises:
        InputError: the quaternion's length is not 1; names `where`.
    """
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1) <= QUATERNION_TOLERANCE:
        raise InputError(
            f"{where}: the quaternion {' '.join(f'{value:g}' for value in quaternion)} has the length {length:.4g}, so "
            "it is not a rotation; expected qx qy qz qw (w last) of length 1."
        )
    pose = rigid(Rotation.from_quat(quaternion).as_matrix(), translation)
    check_rigid(pose, where)
    return pose


def transform_of_rows(rows: object, where: str) -> Transform:
    """Make a transform of four rows of four numbers (or three: the last is 0 0 0 1).

    Raises:
        InputError: they are something else, or no rotation and translation; names `where`.
    """
    try:
        values = np.array(rows, np.float64)
    except (TypeError, ValueError, OverflowError):
        values = np.empty(0)
    if values.shape not in ((4, 4), (3, 4)) or not np.isfinite(values).all():
        raise InputError(
            f"{where}: expected 4 rows of 4 numbers, a rotation and a translation in metres; found {shown(rows)}."
        )
    pose = np.eye(4)
    pose[: len(values)] = values
    check_rigid(pose, where)
    return pose


def _lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Lines with something in them, counted from 1, as words; what follows # and a first line of names are left out."""
    begun = False
    for number, line in text_lines(path):
        fields = line.partition("#")[0].split(",")
        if words := " ".join(fields).split():
            if begun or not all(_HEADING.fullmatch(word) and not _is_number(word) for word in words):
                # a name between commas may have spaces
                alone = len(words) <= 2 or len(fields) == 1
                yield number, words if alone else [word for field in fields for word in _words(field)]
            begun = True


def _words(field: str) -> list[str]:
    words = field.split()
    return words if all(map(_is_number, words)) or seconds_of_date(field.strip()) is not None else [field.strip()]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def finite_number(word: str, where: str, remedy: str = "") -> float:
    """Read a number.

    Raises:
        InputError: it is none, or infinite; names `where`, and the remedy.
    """
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if np.isfinite(value):
        return value
    if not remedy and re.search(r"\d:\d", word):
        remedy = "Write times as seconds: a date becomes seconds since 1970, a time of day seconds since midnight."
    raise InputError(f"{where}: {shown(word)} is not a finite number. {remedy}".rstrip())


def _number_lines(path: Path) -> Iterator[tuple[int, list[float]]]:
    for number, words in _lines(path):
        yield number, [finite_number(word, f"{path}, line {number}") for word in words]
