"""Scans of any recorder: every format gives the same points, and broken files are named."""

import math
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pytest
from pyarrow import feather

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.scans import MAX_POINTS, PointTimes, ScanFormat, check_scan, read_scan

POINTS = np.array([[1.5, -2.25, 0.5], [-8.0, 3.0, -1.75], [40.0, 0.125, 2.0]])
INTENSITY = np.array([0.25, 0.5, 1.0])
COUNTS = np.array([0, 40_000_000, 99_000_000])
"""Nanoseconds from the scan's timestamp."""
TIMED = ScanFormat(times=PointTimes("t", 1e-9))
RECORD = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("t", "<u4")]


def records(record: list[tuple[str, str]] = RECORD) -> np.ndarray:
    table = np.zeros(len(POINTS), record)
    for axis, name in enumerate("xyz"):
        table[name] = POINTS[:, axis]
    table["intensity"], table["t"] = INTENSITY, COUNTS
    return table


def pcd(path: Path, data: str, content: bytes, fields: str = "x y z intensity t", points: int = 3) -> Path:
    count = len(fields.split())
    path.write_bytes(
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {' '.join('4' * count)}\nTYPE F F F F U\n"
        f"COUNT {' '.join('1' * count)}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\n"
        f"DATA {data}\n".encode()
        + content
    )
    return path


def ply(path: Path, encoding: str, content: bytes, count: int = 3) -> Path:
    path.write_bytes(
        f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {count}\nproperty float x\nproperty float y\n"
        "property float z\nproperty float intensity\nproperty uint t\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n".encode()
        + content
    )
    return path


def lines() -> bytes:
    return "".join(f"{x} {y} {z} {i} {t}\n" for (x, y, z), i, t in zip(POINTS, INTENSITY, COUNTS, strict=True)).encode()


def lzf_literals(content: bytes) -> bytes:
    parts = [content[start : start + 32] for start in range(0, len(content), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


def write_bin(folder: Path) -> tuple[Path, ScanFormat]:
    path = folder / "a.bin"
    path.write_bytes(np.column_stack((POINTS, INTENSITY, COUNTS / 1e9)).astype("<f8").tobytes())
    columns = ("x", "y", "z", "intensity", "seconds")
    return path, ScanFormat(columns=columns, dtype="float64", times=PointTimes("seconds"))


def write_npy(folder: Path) -> tuple[Path, ScanFormat]:
    np.save(folder / "a.npy", np.asfortranarray(np.column_stack((COUNTS, POINTS, INTENSITY))))
    return folder / "a.npy", replace(TIMED, columns=("t", "x", "y", "z", "intensity"))


def write_structured_npy(folder: Path) -> tuple[Path, ScanFormat]:
    table = records()
    table.dtype.names = ("X", "Y", "Z", "i", "t")
    np.save(folder / "a.npy", table)
    return folder / "a.npy", replace(TIMED, names={"x": "X", "y": "Y", "z": "Z", "intensity": "i"})


def write_npz(folder: Path) -> tuple[Path, ScanFormat]:
    columns = np.column_stack((POINTS, INTENSITY, COUNTS)).astype(np.float64)
    np.savez_compressed(folder / "a.npz", data=columns, rings=np.zeros(3))
    return folder / "a.npz", replace(TIMED, columns=("x", "y", "z", "intensity", "t"), array="data")


def write_lone_npz(folder: Path) -> tuple[Path, ScanFormat]:
    np.savez(folder / "a.npz", np.column_stack((POINTS, INTENSITY, COUNTS)))
    return folder / "a.npz", replace(TIMED, columns=("x", "y", "z", "intensity", "t"))


def write_feather(folder: Path) -> tuple[Path, ScanFormat]:
    columns = {name: records()[name] for name in ("x", "y", "z", "intensity", "t")}
    table = pyarrow.table({**columns, "laser": ["a", "b", "c"]})
    feather.write_feather(table, str(folder / "a.feather"), compression="lz4")
    return folder / "a.feather", TIMED


def write_las(folder: Path, suffix: str = ".las") -> tuple[Path, ScanFormat]:
    laspy = pytest.importorskip("laspy", reason="laspy is missing, which reads .las and .laz")
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = np.full(3, 1 / 1024), np.zeros(3)
    header.add_extra_dim(laspy.ExtraBytesParams("strength", "f4"))
    las = laspy.LasData(header)
    las.x, las.y, las.z = POINTS.T
    las.strength, las.gps_time = INTENSITY, COUNTS / 1e9
    las.write(folder / f"a{suffix}")
    return folder / f"a{suffix}", ScanFormat(names={"intensity": "strength"}, times=PointTimes("gps_time"))


def padded_pcd(path: Path, padding: tuple[int, int], record: list[tuple[str, str]]) -> tuple[Path, ScanFormat]:
    """Padding under the name _, of `padding` values in two places."""
    one, two = padding
    header = f"VERSION .7\nFIELDS x y z _ intensity _ t\nSIZE 4 4 4 1 4 1 4\nCOUNT 1 1 1 {one} 1 {two} 1\n"
    header += "TYPE F F F U F U U\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary\n"
    path.write_bytes(header.encode() + records(record).tobytes())
    return path, TIMED


def write_empty_padding_pcd(folder: Path) -> tuple[Path, ScanFormat]:
    """What pcl_ros writes of clouds of Ouster, RoboSense and Velodyne: padding of no bytes."""
    return padded_pcd(folder / "a.pcd", (0, 0), RECORD)


def write_compressed_pcd(folder: Path) -> tuple[Path, ScanFormat]:
    content = b"".join(records()[name].tobytes() for name in ("x", "y", "z", "intensity", "t"))
    packed = lzf_literals(content)
    return pcd(folder / "a.pcd", "binary_compressed", struct.pack("<II", len(packed), len(content)) + packed), TIMED


def write_padded_pcd(folder: Path) -> tuple[Path, ScanFormat]:
    """What PCL writes of PointXYZI: padding under the name _, which takes several values."""
    return padded_pcd(folder / "a.pcd", (4, 0), [*RECORD[:3], ("pad", "V4"), *RECORD[3:]])


def of(form: Callable[..., Path], name: str, encoding: str, content: bytes) -> Any:
    return pytest.param(lambda folder: (form(folder / name, encoding, content), TIMED), id=f"{name[2:]} {encoding}")


@pytest.mark.parametrize(
    "write",
    [
        write_bin,
        write_npy,
        write_structured_npy,
        write_npz,
        write_lone_npz,
        write_feather,
        of(ply, "a.ply", "ascii", lines()),
        of(ply, "a.ply", "binary_little_endian", records().tobytes()),
        of(ply, "a.PLY", "binary_big_endian", records([(name, ">" + kind[1:]) for name, kind in RECORD]).tobytes()),
        of(pcd, "a.pcd", "ascii", lines()),
        of(pcd, "a.pcd", "binary", records().tobytes()),
        write_compressed_pcd,
        write_padded_pcd,
        write_empty_padding_pcd,
        write_las,
        pytest.param(partial(write_las, suffix=".laz"), id="write_laz"),
    ],
)
def test_every_format_gives_the_same_points(tmp_path: Path, write) -> None:
    path, scan = write(tmp_path)
    check_scan(path, scan)
    found = read_scan(path, scan)
    assert found.points_m.tolist() == POINTS.tolist()
    assert found.reflectance.tolist() == INTENSITY.tolist()
    assert found.offset_s is not None
    assert found.offset_s.tolist() == pytest.approx([0.0, 0.04, 0.099], abs=1e-12)
    # without times, and counted from another moment
    assert read_scan(path, replace(scan, times=None)).offset_s is None
    later = read_scan(path, scan, 0.05).offset_s
    assert later is not None and later.tolist() == pytest.approx([-0.05, -0.01, 0.049], abs=1e-12)


def test_an_archive_says_what_it_lacks(tmp_path: Path) -> None:
    path, scan = write_npz(tmp_path)
    for wrong, message in (
        (replace(scan, array="points"), r"a\.npz: no array 'points'; it holds \['data', 'rings'\].*as array = 'data'"),
        (replace(scan, array=None), r"a\.npz: 2 arrays"),
        (replace(scan, array="rings"), r"shape \(3,\); expected points × 5 numbers"),
        (replace(scan, columns=("x", "y", "z")), r"shape \(3, 5\); expected points × 3 numbers"),
    ):
        with pytest.raises(InputError, match=message):
            check_scan(path, wrong)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"a\.npz: cannot be read as \.npz"):
        check_scan(path, scan)
    damaged, _ = write_npz(tmp_path)
    content = bytearray(damaged.read_bytes())
    content[120] ^= 0xFF
    damaged.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.npz"):
        read_scan(damaged, scan)


@pytest.mark.parametrize(
    ("name", "package", "command"),
    [("a.feather", "pyarrow", r"pip install 'pyarrow<26'"), ("a.laz", "laspy", r"pip install '\.\[las\]'")],
)
def test_some_formats_want_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name, package, command) -> None:
    (tmp_path / name).write_bytes(b"ARROW1 and so on" if package == "pyarrow" else b"LASF")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"{name}: .* {package}, which is not installed\. Run `{command}`"):
        check_scan(tmp_path / name, ScanFormat())


def test_broken_tables_are_named(tmp_path: Path) -> None:
    path, scan = write_feather(tmp_path)
    whole = path.read_bytes()
    for spoilt in (whole[: len(whole) // 2], b"ARROW1" + bytes(200), bytes(50)):
        path.write_bytes(spoilt)
        with pytest.raises(InputError, match=r"a\.feather: cannot be read as \.feather"):
            check_scan(path, scan)
    path.write_bytes(whole)
    with pytest.raises(InputError, match=r"a\.feather: has no column X"):
        check_scan(path, replace(scan, names={"x": "X"}))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_broken_las_is_named(tmp_path: Path, suffix: str) -> None:
    path, scan = write_las(tmp_path, suffix)
    whole = path.read_bytes()
    for length in (20, 240, len(whole) - 3):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=rf"{path.name}: .*(cannot be read as|truncated)"):
            read_scan(path, scan)


def test_times_that_their_type_has_rounded_away(tmp_path: Path) -> None:
    """Seconds since 1970 in float32 step by 128 s; those of a turn are kept, and so are those since power-on."""
    scan = ScanFormat(("x", "y", "z", "intensity", "t"), times=PointTimes("t", absolute=True))

    def read_at(begun_s: float) -> Any:
        columns = np.column_stack((POINTS, INTENSITY, begun_s + COUNTS / 1e9)).astype(np.float32)
        np.save(tmp_path / "a.npy", columns)
        return read_scan(tmp_path / "a.npy", scan, begun_s).offset_s

    assert read_at(3600.0) is not None
    with pytest.raises(InputError, match=r"times \(t, float32\).*steps of 128 s: they are rounded away.*leave out"):
        read_at(1_369_730_762.0)


def test_times_on_the_clock_keep_their_digits(tmp_path: Path) -> None:
    start_ns = 1_369_730_762_123_456_789
    table = np.zeros(2, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("stamp", "u8")])
    table["x"], table["stamp"] = 5.0, [start_ns, start_ns + 50_000_000]
    np.save(tmp_path / "a.npy", table)
    scan = ScanFormat(times=PointTimes("stamp", 1e-9, absolute=True))
    found = read_scan(tmp_path / "a.npy", scan, start_ns / 1e9)
    assert found.offset_s is not None
    assert found.offset_s.tolist() == pytest.approx([0, 0.05], abs=1e-6)
    assert found.reflectance.tolist() == [0, 0]  # there is no intensity


def test_what_is_no_point_is_left_out_and_counted(tmp_path: Path) -> None:
    nan = math.nan
    rows = np.array(
        [[nan, 0, 0, 1], [0, 0, 0, 1], [0.1, 0.2, 0, 1], [3, 4, 0, 0.5], [0, 999, 0, 1], [1, math.inf, 0, 1]]
    )
    np.save(tmp_path / "a.npy", rows)
    found = read_scan(tmp_path / "a.npy", ScanFormat())
    assert found.points_m.tolist() == [[3, 4, 0]] and found.reflectance.tolist() == [0.5]
    assert (found.not_finite, found.out_of_range) == (2, 3)


def named(folder: Path, name: str, content: bytes) -> Path:
    (folder / name).write_bytes(content)
    return folder / name


def saved(path: Path, array: np.ndarray) -> Path:
    np.save(path, array, allow_pickle=array.dtype == object)
    return path


BROKEN = {
    "unknown format": (lambda f: named(f, "a.e57", b"ASTM"), r"a\.e57: a scan of unknown format \.e57.*\.bin, \.npy"),
    "empty file": (lambda f: named(f, "a.bin", b""), r"a\.bin: an empty file"),
    "cut .bin": (lambda f: named(f, "a.bin", bytes(18)), r"a\.bin: 18 bytes, expected a multiple of 16"),
    "all NaN": (lambda f: saved(f / "a.npy", np.full((4, 4), np.nan)), r"a\.npy: none of its 4 points.*4 are NaN"),
    "no points": (lambda f: saved(f / "a.npy", np.zeros((0, 4))), r"a\.npy: a scan without points"),
    "other columns": (lambda f: saved(f / "a.npy", np.zeros((9, 5))), r"shape \(9, 5\).*points × 4"),
    "pickled": (lambda f: saved(f / "a.npy", np.array([{}, None])), r"a\.npy: cannot be read as"),
    "no column": (lambda f: saved(f / "a.npy", records()[["x", "y", "t"]]), r"has no column z, only x, y, t"),
    "cut .npy": (
        lambda f: named(f, "b.npy", saved(f / "a.npy", np.ones((9, 4))).read_bytes()[:-8]),
        r"b\.npy: 408 bytes, but its header declares 416: truncated",
    ),
    "no ply": (lambda f: named(f, "a.ply", b"solid\n"), r"a\.ply: does not begin with 'ply'"),
    "ply of faces": (
        lambda f: named(f, "a.ply", b"ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nend_header\n"),
        "the first element must be vertex, without lists; found face",
    ),
    "ply without end": (lambda f: named(f, "a.ply", b"ply\nformat ascii 1.0\n" * 3), "the header has no end"),
    "ply of an unknown type": (
        lambda f: named(f, "a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n1\n"),
        "the header's line 'property half x' cannot be read",
    ),
    "cut ply": (lambda f: ply(f / "a.ply", "binary_little_endian", records().tobytes()[:-1]), "the file is truncated"),
    "cut ascii ply": (lambda f: ply(f / "a.ply", "ascii", lines()[:-60]), "lines of points|cannot"),
    "ply of words": (lambda f: ply(f / "a.ply", "ascii", b"one two three four five\n" * 3), "a line of its points"),
    "huge promise": (
        lambda f: ply(f / "a.ply", "binary_little_endian", b"", MAX_POINTS + 1),
        "5000001 points, expected at most 5000000",
    ),
    "big promise": (lambda f: ply(f / "a.ply", "ascii", lines(), MAX_POINTS), "cannot hold the declared 5000000 lines"),
    "negative": (lambda f: pcd(f / "a.pcd", "binary", b"", points=-3), "negative count"),
    "pcd without z": (lambda f: pcd(f / "a.pcd", "ascii", lines(), "x y h intensity t"), "has no column z"),
    "pcd of another kind": (lambda f: pcd(f / "a.pcd", "binary_zstd", lines()), "header cannot be read.*binary_zstd"),
    "cut pcd": (lambda f: pcd(f / "a.pcd", "binary", records().tobytes()[:-20]), "the file is truncated"),
    "compressed to another size": (
        lambda f: pcd(f / "a.pcd", "binary_compressed", struct.pack("<II", 3, 99) + b"\0a"),
        "2 compressed bytes for 99",
    ),
    "damaged": (
        lambda f: pcd(f / "a.pcd", "binary_compressed", struct.pack("<II", 3, 60) + b"\xe0\x00\x00"),
        "its compressed points are damaged",
    ),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_scan_is_named(tmp_path: Path, name: str) -> None:
    make, message = BROKEN[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as error:
        read_scan(path, ScanFormat())
    assert str(error.value).startswith(str(path))


def test_what_a_header_tells_is_found_without_reading_the_points(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="truncated"):
        check_scan(pcd(tmp_path / "a.pcd", "binary", records().tobytes()[:-20]), ScanFormat())
    with pytest.raises(InputError, match="has no column t, only x, y, z, intensity"):
        check_scan(named(tmp_path, "a.bin", bytes(32)), TIMED)
    with pytest.raises(FileNotFoundError, match=r"b\.ply"):
        check_scan(tmp_path / "b.ply", TIMED)
    check_scan(saved(tmp_path / "a.npy", np.full((4, 4), np.nan)), ScanFormat())


def test_compressed_points_with_references(tmp_path: Path) -> None:
    """Three times three floats of bytes 0x40: one literal, and 7 + 26 + 2 = 35 bytes from one byte back."""
    packed = b"\x00@" + bytes([7 << 5, 26, 0])
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nDATA binary_compressed\n"
    path = named(tmp_path, "a.pcd", header.encode() + struct.pack("<II", len(packed), 36) + packed)
    (value,) = struct.unpack("<f", b"@@@@")
    assert read_scan(path, ScanFormat()).points_m.tolist() == [[value] * 3] * 3
    # shorter, or leading before the beginning
    for spoilt in (packed[:2], packed[:4], b"\x00@" + bytes([7 << 5, 25, 0]), b"\x00@" + bytes([7 << 5, 26, 1])):
        named(tmp_path, "a.pcd", header.encode() + struct.pack("<II", len(spoilt), 36) + spoilt)
        with pytest.raises(InputError, match=r"a\.pcd: its compressed points are damaged"):
            read_scan(path, ScanFormat())
