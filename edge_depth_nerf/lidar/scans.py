"""Reading LiDAR scans of any recorder: .bin, .npy, .npz, .ply, .pcd, .las, .laz and .feather files.

    .bin    values one after another, little-endian; their columns and type are declared
    .npy    a structured array, or points × columns, whose columns are declared
    .npz    the same, one of its arrays
    .feather    a table of Arrow's with named columns; read by pyarrow, which is not among this project's dependencies
    .las, .laz    with the names of the format's dimensions, x, y, z scaled; read by laspy, an extra of this project
    .ply    the element `vertex`; ascii, binary_little_endian, binary_big_endian
    .pcd    ascii, binary, binary_compressed

Coordinates are metres in the scanner's frame, as recorded. Headers are not trusted: what they promise is compared
with the file's size before anything is allocated. A time for each point, where the file holds one, makes `offset_s`.

Headers of .ply and .pcd are read here. plyfile reads all elements to get at one (300,000 faces: 4 s), allocates what
the header promises before it reads text, takes minutes to refuse a header of 100 MB, and is under the GPL. pypcd4
expands COUNT 30000000 to as many columns (8 GB, minutes), hands out fewer points than promised without a word, and
refuses text with two spaces or a tab between values.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

import lzf
import numpy as np
import torch
from jaxtyping import Float64, Shaped, UInt8

from edge_depth_nerf.base.bounds import check_bytes, shown
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import load_npy, read_array_header, read_npz
from edge_depth_nerf.lidar.sweeps import MAX_POINTS, Sweep, usable_points

Encoding = Literal["records", "text", "lzf", "matrix", "archive", "table", "las"]

SCAN_SUFFIXES = (".bin", ".npy", ".npz", ".ply", ".pcd", ".las", ".laz", ".feather")
"""The formats that can be read."""
MAX_CLOUD_POINTS = 10_000_000
"""No point cloud of a scene has more."""
_MAX_BYTES = 1 << 30
"""No file is larger: points of a hundred bytes. They are mapped into memory, not read."""
_MAX_TEXT_BYTES = 1 << 27
"""No file of text is larger, nor are compressed points when they are unpacked."""
_MAX_LZF_RATIO = 100
"""LZF makes at most 264 bytes of three."""
_MAX_HEADER_BYTES = 1 << 16
_LOOKED_AT = 200_000
"""So many values of a file tell its columns."""
_COARSEST_S = 5e-3
"""Times of points in larger steps say nothing within a turn."""
_AGAIN = "Copy or export the file again, or delete it so that its frame is skipped."

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}
_ARROW_TYPES = {
    **{"halffloat": "f2", "float": "f4", "double": "f8"},
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
}
_LIBRARIES = {".feather": ("pyarrow", "'pyarrow<26'"), **dict.fromkeys((".las", ".laz"), ("laspy", "'.[las]'"))}
"""What reads some formats, and how pip installs it."""
_PLY_ENCODINGS: dict[str, tuple[Encoding, str]] = {
    "ascii": ("text", "<"),
    "binary_little_endian": ("records", "<"),
    "binary_big_endian": ("records", ">"),
}


@dataclass(frozen=True)
class PointTimes:
    """How a file tells when each of its points was measured."""

    column: str
    seconds_per_count: float = 1.0
    """What one count of it stands for."""
    absolute: bool = False
    """Whether it counts on the recording's clock, instead of from the scan's timestamp."""


@dataclass(frozen=True)
class ScanFormat:
    """What is to be known of a scanner's files beside what they say themselves."""

    columns: tuple[str, ...] = ("x", "y", "z", "intensity")
    """Names of the columns of .bin files and of .npy files without names. x, y, z are needed."""
    dtype: Literal["float32", "float64"] = "float32"
    """Type of the values in .bin files."""
    array: str | None = None
    """Name of the points' array in .npz files; None: the only one there is."""
    names: Mapping[str, str] = field(default_factory=dict)
    """What x, y, z, intensity are called in the files, where they are called something else."""
    times: PointTimes | None = None
    """Where each point's time is, if anywhere."""
    metres_per_unit: float = 1.0
    """Of the coordinates."""

    def name(self, quantity: str) -> str:
        """What x, y, z or intensity is called in the files."""
        return self.names.get(quantity, quantity)

    @property
    def needed(self) -> tuple[str, ...]:
        """Columns without which a file cannot be used."""
        return (*(self.name(axis) for axis in "xyz"), *([] if self.times is None else [self.times.column]))


@dataclass(frozen=True)
class _Header:
    """What a file says of its points."""

    record: np.dtype
    """One point, field by field."""
    count: int
    encoding: Encoding
    """Records one after another, lines of text, PCD's compressed columns, an array of NumPy's, one in an archive, a
    table of Arrow's, or LAS."""
    offset: int = 0
    """Where the points begin, in bytes."""
    array: str = ""
    """Name of the points' array in an archive."""


def read_scan(path: Path, scan: ScanFormat, time_s: float = 0.0) -> Sweep:
    """Read a scan and leave out what is not a measured point.

    `offset_s` is counted from `time_s`, the scan's own time on the clock of its points' times.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: of an unknown format, broken, without a column needed, or without a single usable point.
    """
    header = check_scan(path, scan)
    columns = _read_columns(path, header, [*scan.needed, scan.name("intensity")], scan)
    points_m = np.stack([columns[scan.name(axis)] for axis in "xyz"], -1) * scan.metres_per_unit
    intensity = columns.get(scan.name("intensity"), np.zeros(len(points_m)))
    offset_s = None
    if scan.times is not None:
        _check_steps(path, header, columns[scan.times.column], scan.times)
        offset_s = torch.from_numpy(columns[scan.times.column] * scan.times.seconds_per_count - time_s)
    return usable_points(path, torch.from_numpy(points_m), torch.from_numpy(intensity), offset_s)


def columns_told(path: Path) -> int:
    """How many float32 columns a .bin file seems to have, 3 to 8: values of one column are alike in size."""
    values = np.nan_to_num(np.fromfile(path, "<f4", _LOOKED_AT))
    size = np.log(np.abs(np.clip(values, -1e6, 1e6)) + 0.01)
    size -= size.mean()
    alike = {count: float((size[count:] * size[:-count]).mean()) for count in range(3, 9)}
    return min(count for count in alike if alike[count] >= 0.9 * max(alike.values()))


def _check_steps(path: Path, header: _Header, counts: np.ndarray, times: PointTimes) -> None:
    """Refuse times that their type has rounded away."""
    kind = header.record[times.column].base
    if kind.kind != "f" or header.encoding == "text" or not np.isfinite(counts).any():
        return
    largest = np.abs(counts[np.isfinite(counts)]).max()
    step_s = float(np.spacing(largest.astype(kind))) * times.seconds_per_count
    if step_s > _COARSEST_S:
        raise InputError(
            f"{path}: the points' times ({times.column}, {kind.name}) are as large as {largest:.6g}, where this type "
            f"counts in steps of {step_s:.3g} s: they are rounded away. Record them as float64 or as whole numbers, or "
            "leave out point_times and give turn_s with direction."
        )


def read_cloud(path: Path) -> tuple[Float64[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"] | None]:
    """Read the vertices of a .ply file unchanged, and their colours (RGB) where it has any.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: another format, broken, or of more than `MAX_CLOUD_POINTS`.
    """
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: a point cloud of unknown format; expected .ply.")
    scan, colours = ScanFormat(), ("red", "green", "blue")
    columns = _read_columns(path, check_scan(path, scan, MAX_CLOUD_POINTS), [*scan.needed, *colours], scan)
    points = np.stack([columns[axis] for axis in "xyz"], -1)
    if not all(name in columns for name in colours):
        return points, None
    return points, np.stack([columns[name] for name in colours], -1).clip(0, 255).astype(np.uint8)


# ---- headers ---------------------------------------------------------------------------------------------------


def check_scan(path: Path, scan: ScanFormat, most: int = MAX_POINTS) -> _Header:
    """Check by its header and size that a file is whole and has the columns needed, and at most so many points.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: of an unknown format, truncated, without points or without a column.
    """
    size = check_bytes(path, _MAX_BYTES)
    readers = {
        **{".bin": _bin_header, ".npy": _npy_header, ".npz": _npz_header},
        **{".ply": _ply_header, ".pcd": _pcd_header, ".feather": _feather_header},
        **dict.fromkeys((".las", ".laz"), _las_header),
    }
    suffix = path.suffix.lower()
    if suffix not in readers:
        raise InputError(
            f"{path}: a scan of unknown format {suffix or '(no suffix)'}; expected one of {', '.join(SCAN_SUFFIXES)}."
        )
    if size == 0:
        raise InputError(f"{path}: an empty file, expected a scan. {_AGAIN}")
    header = readers[suffix](path, size, scan)
    names = header.record.names or ()
    if missing := [name for name in scan.needed if name not in names]:
        raise InputError(
            f"{path}: has no column {', '.join(missing)}, only {', '.join(names)}. Name the columns of x, y, z, "
            "intensity and time in the rig file."
        )
    if header.count == 0:
        raise InputError(f"{path}: a scan without points. {_AGAIN}")
    if header.count > most:
        raise InputError(
            f"{path}: {shown(header.count)} points, expected at most {most}: one scan per file, not a whole map."
        )
    if header.encoding == "text" and size > _MAX_TEXT_BYTES:
        raise InputError(f"{path}: {size} bytes of text, expected at most {_MAX_TEXT_BYTES}. Export it as binary.")
    if header.encoding == "records" and header.offset + header.count * header.record.itemsize > size:
        raise InputError(
            f"{path}: {size} bytes, but {header.count} points of {header.record.itemsize} bytes from byte "
            f"{header.offset} on are declared: the file is truncated. {_AGAIN}"
        )
    # a value and a line end, or space, take two bytes at least
    if header.encoding == "text" and header.offset + header.count * 2 * len(names) - 1 > size:
        raise InputError(f"{path}: {size} bytes cannot hold the declared {header.count} lines. {_AGAIN}")
    return header


@contextmanager
def _faults_named(path: Path) -> Iterator[None]:
    """Make an InputError of whatever a library raises at a file, and of a library that is missing."""
    try:
        yield
    except InputError:
        raise
    except ImportError:
        library, install = _LIBRARIES[path.suffix.lower()]
        raise InputError(
            f"{path}: reading {path.suffix} scans needs {library}, which is not installed. Run `pip install "
            f"{install}`, or convert the scans to .npz."
        ) from None
    except Exception as error:  # their readers raise whatever they meet
        first_line = str(error).split("\n")[0]
        raise InputError(f"{path}: cannot be read as {path.suffix} ({first_line}). {_AGAIN}") from None


def _bin_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    record = np.dtype([(name, np.dtype(scan.dtype).newbyteorder("<")) for name in scan.columns])
    if size % record.itemsize:
        raise InputError(
            f"{path}: {size} bytes, expected a multiple of {record.itemsize} ({', '.join(scan.columns)} as "
            f"{scan.dtype}). The file is truncated, or has other columns (a rig file states them). {_AGAIN}"
        )
    return _Header(record, size // record.itemsize, "records")


def _npy_array(path: Path) -> np.ndarray:
    with path.open("rb") as file:
        shape, _, kind = read_array_header(file, str(path))
        promised, size = file.tell() + math.prod(shape) * kind.itemsize, file.seek(0, 2)
    if promised > size:
        raise InputError(f"{path}: {size} bytes, but its header declares {shown(promised)}: truncated. {_AGAIN}")
    with _faults_named(path):
        # mapped: nothing is allocated
        return load_npy(path, "r")


def _npy_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    array = _npy_array(path)
    return _array_header(path, array.shape, array.dtype, scan, "matrix")


def _array_header(path: Path, shape: tuple[int, ...], kind: np.dtype, scan: ScanFormat, encoding: Encoding) -> _Header:
    if kind.names and encoding == "matrix":
        if len(shape) == 1:
            return _Header(kind, shape[0], encoding)
    elif len(shape) == 2 and shape[1] == len(scan.columns) and kind.kind in "fiu":
        return _Header(np.dtype([(name, kind) for name in scan.columns]), shape[0], encoding)
    structured = "a structured array, or " if encoding == "matrix" else ""
    raise InputError(
        f"{path}: an array of {kind} and shape {shape}; expected {structured}points × {len(scan.columns)} numbers "
        f"({', '.join(scan.columns)}). State its columns in the rig file."
    )


def _npz_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    with _faults_named(path), zipfile.ZipFile(path) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        wanted = [scan.array] if scan.array is not None else names
        if len(wanted) != 1 or wanted[0] not in names:
            asked = f"no array {scan.array!r}" if scan.array is not None else f"{len(names)} arrays"
            raise InputError(
                f"{path}: {asked}; it holds {shown(names)}. Name the array with the points in the rig file, as "
                "array = 'data'."
            )
        with archive.open(f"{wanted[0]}.npy") as member:
            shape, _, kind = read_array_header(member, f"{path}: {wanted[0]}")
    return replace(_array_header(path, shape, kind, scan, "archive"), array=wanted[0])


def _feather_table(path: Path, columns: list[str] | None = None) -> Any:
    """Open a table, its columns mapped into memory; compressed ones are unpacked when they are asked for."""
    with _faults_named(path):
        from pyarrow import feather

        return feather.read_table(path, columns=columns, memory_map=True)


def _feather_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    table = _feather_table(path)
    # text, lists and the like are no numbers
    fields = [(field.name, _ARROW_TYPES.get(str(field.type), "O")) for field in table.schema]
    return _Header(_record(path, fields), table.num_rows, "table")


def _las_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    with _faults_named(path):
        import laspy

        with laspy.open(path) as reader:
            head = reader.header
    names = [name for name in head.point_format.dimension_names if name not in ("X", "Y", "Z")]
    end = head.offset_to_point_data + head.point_count * head.point_format.size
    if not head.are_points_compressed and end > size:
        raise InputError(
            f"{path}: {size} bytes, but its header declares {head.point_count} points, {end} bytes: truncated. {_AGAIN}"
        )
    return _Header(_record(path, [(name, "f8") for name in (*"xyz", *names)]), head.point_count, "las")


def _header_lines(path: Path, file: BinaryIO, last: str) -> list[list[str]]:
    """The words of the header's lines, up to the one that begins with `last`."""
    lines: list[list[str]] = []
    while file.tell() < _MAX_HEADER_BYTES and (line := file.readline(_MAX_HEADER_BYTES)):
        lines.append(line.decode("latin-1").split())
        if lines[-1][:1] == [last]:
            return lines
    raise InputError(f"{path}: the header has no end (a line {last!r} is expected). {_AGAIN}")


def _ply_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    with path.open("rb") as file:
        if file.readline(8).strip() != b"ply":
            raise InputError(f"{path}: does not begin with 'ply'. {_AGAIN}")
        lines = _header_lines(path, file, "end_header")
        offset = file.tell()
    encoding, order = "text", "<"
    # name, count, fields, whether it has lists
    elements: list[tuple[str, int, list[tuple[str, str]], bool]] = []
    for line in lines:
        try:
            if line[:1] == ["format"]:
                encoding, order = _PLY_ENCODINGS[line[1]]
            elif line[:1] == ["element"]:
                elements.append((line[1], int(line[2]), [], False))
            elif line[:2] == ["property", "list"]:
                elements[-1] = (*elements[-1][:3], True)
            elif line[:1] == ["property"]:
                elements[-1][2].append((line[2], order + _PLY_TYPES[line[1]]))
        except (IndexError, KeyError, ValueError):
            raise InputError(f"{path}: the header's line {' '.join(line)!r} cannot be read. {_AGAIN}") from None
    if not elements or elements[0][0] != "vertex" or elements[0][3] or elements[0][1] < 0:
        found = ", ".join(element[0] for element in elements) or "none"
        raise InputError(f"{path}: the first element must be vertex, without lists; found {found}. {_AGAIN}")
    _, count, fields, _ = elements[0]
    return _Header(_record(path, fields), count, encoding, offset)


def _pcd_header(path: Path, size: int, scan: ScanFormat) -> _Header:
    with path.open("rb") as file:
        lines = _header_lines(path, file, "DATA")
        offset = file.tell()
    words = {line[0]: line[1:] for line in lines if line and not line[0].startswith("#")}
    fields: list[tuple[str, str, tuple[int]] | tuple[str, str]] = []
    try:
        counts = [int(word) for word in words.get("COUNT", ["1"] * len(words["FIELDS"]))]
        described = zip(words["FIELDS"], words["TYPE"], words["SIZE"], counts, strict=True)
        for number, (name, kind, width, count) in enumerate(described):
            # PCL calls padding "_", several times over
            unique = f"{name}{number}" if name == "_" else name
            code = "<" + {"F": "f", "I": "i", "U": "u"}[kind] + width
            if count == 0:
                # padding of no bytes, as pcl_ros writes
                continue
            fields.append((unique, code) if count == 1 else (unique, code, (count,)))
        points = int(words["POINTS"][0]) if "POINTS" in words else int(words["WIDTH"][0]) * int(words["HEIGHT"][0])
        encodings: dict[str, Encoding] = {"ascii": "text", "binary": "records", "binary_compressed": "lzf"}
        encoding = encodings[words["DATA"][0]]
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{path}: the header cannot be read ({error!r}). {_AGAIN}") from None
    if points < 0 or any(count < 0 for count in counts):
        raise InputError(f"{path}: the header has a negative count. {_AGAIN}")
    return _Header(_record(path, fields), points, encoding, offset)


def _record(path: Path, fields: list) -> np.dtype:
    try:
        return np.dtype(fields)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: the header's fields cannot be read ({error}). {_AGAIN}") from None


# ---- points ----------------------------------------------------------------------------------------------------


def _read_columns(
    path: Path, header: _Header, wanted: Sequence[str], scan: ScanFormat
) -> dict[str, Shaped[np.ndarray, "points"]]:
    """The columns wanted that there are, as float64."""
    names = [name for name in header.record.names or () if name in wanted]
    if header.encoding in ("matrix", "archive"):
        of_archive = header.encoding == "archive"
        array = read_npz(path, [header.array], _MAX_TEXT_BYTES)[header.array] if of_archive else _npy_array(path)
        picked = {name: array[name] if array.dtype.names else array[:, scan.columns.index(name)] for name in names}
    elif header.encoding == "table":
        table = _feather_table(path, names)
        picked = {name: table[name].to_numpy() for name in names}
    elif header.encoding == "las":
        with _faults_named(path):
            import laspy

            points = laspy.read(path)
            picked = {name: np.asarray(points[name]) for name in names}
    elif header.encoding == "text":
        picked = _text_columns(path, header, names)
    elif header.encoding == "lzf":
        picked = _compressed_columns(path, header, names)
    else:
        records = np.memmap(path, header.record, "r", header.offset, (header.count,))
        picked = {name: records[name] for name in names}
    for name, column in picked.items():
        if column.ndim != 1 or column.dtype.kind not in "fiu":
            raise InputError(
                f"{path}: column {name} holds no single numbers ({column.dtype}, {column.shape}). {_AGAIN}"
            )
    return {name: np.array(column, np.float64) for name, column in picked.items()}


def _text_columns(path: Path, header: _Header, names: list[str]) -> dict[str, np.ndarray]:
    position, places = 0, {}
    for name in header.record.names or ():
        places[name] = position
        position += int(np.prod(header.record[name].shape, dtype=int))
    with path.open("rb") as file:
        file.seek(header.offset)
        try:
            values = np.loadtxt(
                file, np.float64, usecols=[places[name] for name in names], max_rows=header.count, ndmin=2
            )
        except ValueError as error:
            raise InputError(f"{path}: a line of its points cannot be read ({error}). {_AGAIN}") from None
    if len(values) != header.count:
        raise InputError(f"{path}: {len(values)} lines of points, but {header.count} are declared: truncated. {_AGAIN}")
    return {name: values[:, number] for number, name in enumerate(names)}


def _compressed_columns(path: Path, header: _Header, names: list[str]) -> dict[str, np.ndarray]:
    """PCD's binary_compressed: two sizes, then all of the first field, all of the second, and so on, in LZF."""
    expected = header.count * header.record.itemsize
    with path.open("rb") as file:
        file.seek(header.offset)
        sizes = file.read(8)
        compressed = file.read()
    if len(sizes) < 8:
        raise InputError(f"{path}: truncated. {_AGAIN}")
    packed, unpacked = struct.unpack("<II", sizes)
    too_large = expected > min(_MAX_TEXT_BYTES, _MAX_LZF_RATIO * len(compressed))
    if packed > len(compressed) or unpacked != expected or too_large:
        raise InputError(
            f"{path}: {len(compressed)} compressed bytes for {unpacked} bytes of points, expected {packed} for "
            f"{expected}. {_AGAIN}"
        )
    try:
        content = lzf.decompress(compressed[:packed], unpacked)
    except ValueError:
        content = None
    if content is None or len(content) != unpacked:
        raise InputError(f"{path}: its compressed points are damaged. {_AGAIN}")
    fields = [(name, header.record[name]) for name in header.record.names or ()]
    whole = np.frombuffer(content, [(name, kind.base, (header.count, *kind.shape)) for name, kind in fields])[0]
    return {name: whole[name] for name in names}
