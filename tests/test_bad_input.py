"""Every reader on files that are spoilt in thousands of ways: only our own errors, at once, and little memory.

The suite throws `BAD_INPUTS` at each reader, 40 by default; `make fuzz` throws a thousand, and a hundred thousand at
each of our own parsers through a coverage-guided fuzzer (tests/fuzz_parsers.py).
"""

import json
import os
import re
import struct
import sys
import time
import warnings
import zlib
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import torch
from bad_input import READERS, describe, named, npy, npz, pcd, spoilt
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from edge_depth_nerf.base.errors import LONGEST_MESSAGE, InputError
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.mono.network import load_network, write_tensors
from edge_depth_nerf.process.colmap.models import sum_of_files
from edge_depth_nerf.process.rig import _files, _number_in

INPUTS = int(os.environ.get("BAD_INPUTS", "40"))
MOST_SECONDS = 1.0
"""Of the processor, for one input."""
MOST_BYTES = 1 << 30
OUR_ERRORS = (InputError, FileNotFoundError)

fuzzed = settings(
    max_examples=INPUTS,
    deadline=None,
    derandomize=INPUTS <= 100,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@pytest.fixture(autouse=True, scope="module")
def bounded_memory():
    """Let this process take a gigabyte more than it has, and no more."""
    if not sys.platform.startswith("linux"):
        yield
        return
    import resource  # Windows has none

    before = resource.getrlimit(resource.RLIMIT_DATA)
    pages = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (int(pages.split()[1]) * 1024 + MOST_BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_DATA, before)


def throw(read, path: Path) -> None:
    seconds = seconds_of(read, path)
    if seconds >= MOST_SECONDS:
        # what takes long takes long again; a busy machine, or the collection of garbage, does not
        seconds = min(seconds, seconds_of(read, path))
    assert seconds < MOST_SECONDS, f"{seconds:.1f} s; {describe(path)}"


def seconds_of(read, path: Path) -> float:
    started = time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(path)
    except OUR_ERRORS as error:
        assert len(str(error)) <= LONGEST_MESSAGE + 200 and "\x1b" not in str(error)
    except BaseException as error:
        raise AssertionError(f"{type(error).__name__}: {error}; {describe(path)}") from error
    return time.process_time() - started


@pytest.fixture(scope="module", params=READERS)
def valid(request, tmp_path_factory):
    reader = READERS[request.param]
    path = reader.make(tmp_path_factory.mktemp(request.param.replace(" ", "_")))
    reader.read(path)
    return reader, path, path.read_bytes()


def test_spoilt_files(valid):
    reader, path, whole = valid

    @fuzzed
    @given(st.integers(0, 2**64 - 1))
    def throw_all(seed: int) -> None:
        path.write_bytes(spoilt(whole, reader.kind, Random(seed)))
        throw(reader.read, path)

    try:
        throw_all()
    finally:
        path.write_bytes(whole)


def png_of(width: int, height: int) -> bytes:
    block = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    head = struct.pack(">I", 13) + block + struct.pack(">I", zlib.crc32(block))
    return b"\x89PNG\r\n\x1a\n" + head + b"\0\0\0\0IEND\xaeB`\x82"


FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "w": 9, "h": 9, "fl_x": 9, "fl_y": 9}


def frame(**changes: Any) -> str:
    return json.dumps({"frames": [{**FRAME, "cx": 4, "cy": 4, **changes}]})


LONG_COUNTS = re.sub(rb"(WIDTH|HEIGHT) \d+", rb"\1 " + b"9" * 4000, pcd("binary").replace(b"POINTS 24\n", b""))
FOUND: dict[str, tuple[str, str, str | bytes, str]] = {
    "a picture without a name": ("poses of nerfstudio", "a.json", frame(file_path="."), "has no file_path"),
    # a quarter of a megabyte took all memory of the machine
    "a key of many parts": ("rig toml", "a.toml", "a" + ".a" * 100_000 + " = 1", "not valid TOML .*dots"),
    "a TOML of depth": ("rig toml", "a.toml", "a = " + "[" * 100_000, "not valid TOML"),
    "a JSON of depth": ("json", "a.json", "[" * 100_000, "not valid JSON"),
    "a number of many digits": ("json", "a.json", "9" * 5000, "not valid JSON"),
    "a number beyond float": ("scene", "transforms.json", frame(fl_x=10**400), "fl_x is a whole number of more than a"),
    "a pose beyond float": ("scene", "transforms.json", frame(transform_matrix=[[10**400] * 4] * 4), "4×4 finite"),
    "a lens beyond float32": ("scene", "transforms.json", frame(k1=1e308), "k1 is 1e\\+308"),
    "a huge camera": ("scene", "transforms.json", frame(w=60_000, h=60_000), "60000×60000 pixels"),
    "a huge picture": ("picture", "a.png", png_of(60_000, 60_000), "cannot be decoded|60000×60000 pixels"),
    "a large picture": ("picture", "a.png", png_of(9000, 9000), "9000×9000 pixels; expected .* at most"),
    "a huge copied picture": ("picture copied", "a.png", png_of(60_000, 60_000), "60000×60000 pixels"),
    "a huge mask": ("mask", "a.png", png_of(2**31 - 1, 1), "cannot be decoded|pixels"),
    "a bomb": ("arrays npz", "a.npz", npz(distance_m=np.zeros(10**7, np.float32)), "at most 768 bytes"),
    "objects in an archive": ("arrays npz", "a.npz", npz(distance_m=np.array([{}], object)), "an array of object"),
    "a header of depth": ("array npy", "a.npy", npy(np.ones(3)).replace(b"False", b"-" * 40 + b"1"), "as an array"),
    "an array beyond the file": ("array npy", "a.npy", npy(np.ones(3)).replace(b"(3,)", b"(9**9,)"), "as an array"),
    "a count that cannot be printed": (
        "scan pcd binary",
        "a.pcd",
        LONG_COUNTS,
        "whole number of more than a hundred digits points",
    ),
    "points that unpack to gigabytes": (
        "scan pcd compressed",
        "a.pcd",
        pcd("binary_compressed").replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 40000000"),
        "compressed bytes",
    ),
    "a fraction with an exponent": ("kitti timestamps", "a.txt", "2013-05-28 08:46:02.1e400", "is not a finite number"),
    "a shift beyond the earth": ("kitti cam to velo", "a.txt", "1 0 0 1e300 0 1 0 0 0 0 1 0", "shifts by 1e\\+300 m"),
    "a line without end": ("tum", "a.txt", "1 " * 100_000, "line 1: longer than"),
    "another encoding": ("kitti poses", "a.txt", "0 1 0 0".encode("utf-16"), "not a text file"),
    "orders to a terminal": ("kitti cam to velo", "a.txt", "\x1b[2J 1 2", "x1b"),
    "an error of a megabyte": ("poses of nerfstudio", "a.json", frame(transform_matrix=[1] * 10**5), "list of 100000"),
    "a tuned weight beyond float": (
        "tuned",
        "a.json",
        '{"methods": {"ds-nerf": {"lambda": %s, "sigma_m": 1}}}' % ("9" * 400),
        "ds-nerf: found",
    ),
    "a run of a list for a method": (
        "figures",
        "s/r/figures.json",
        '{"run": {"scene": "s", "preset": "lite", "method": ["x"], "seed": 0}, "named": [], "configuration": {}, '
        '"figures": {}, "curve": [], "steps": 1}',
        "is not a run of this version",
    ),
    "figures that are none": ("figures", "s/r/figures.json", "[]", "does not contain a JSON object"),
    "aliases that multiply": ("kitti yaml", "a.yaml", "a: &a [x]\n" + "b: [*a,*a]\n" * 9, "occurs twice|without"),
}
"""What fuzzing and reading the code found, each mended: reader, name of the file, content, message."""


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found(name, tmp_path, tmp_path_factory):
    reader, file, content, message = FOUND[name]
    path = tmp_path / file
    path.parent.mkdir(parents=True, exist_ok=True)
    # a valid one first, for the imports
    READERS[reader].read(READERS[reader].make(tmp_path_factory.mktemp("valid")))
    named(file, content)(tmp_path)
    throw(READERS[reader].read, path)
    with pytest.raises(InputError, match=message) as raised:
        READERS[reader].read(path)
    assert len(str(raised.value)) < 2000


def test_a_network_far_larger_than_its_file(tmp_path):
    settings_of_it = {"channels": [1024] * 8, "working_px": 4096, "camera_height_m": 1.5, "room_radius_m": 20.0}
    write_tensors(tmp_path / "a.safetensors", {"weight": torch.ones(1)}, {"settings": settings_of_it})
    throw(load_network, tmp_path / "a.safetensors")
    with pytest.raises(InputError, match="not those of the network"):
        load_network(tmp_path / "a.safetensors")


def test_digits_that_are_no_numbers(tmp_path):
    for name in ("12²34.png", "١٢.png", "7.png"):
        (tmp_path / name).write_bytes(b"")
    assert len(_files(tmp_path, "*.png", (".png",))) == 3
    with pytest.raises(InputError, match="no number in its name"):
        _number_in(tmp_path / "١٢.png")


def test_a_damaged_model_of_colmaps_is_told_from_a_whole_one(tmp_path):
    """COLMAP's own reader ends the process at one."""
    for name in ("cameras.bin", "images.bin"):
        (tmp_path / name).write_bytes(bytes(range(99)))
    whole = sum_of_files(tmp_path)
    assert sum_of_files(tmp_path) == whole
    rng, path = Random(0), tmp_path / "images.bin"
    content = path.read_bytes()
    for _ in range(INPUTS):
        path.write_bytes(changed := spoilt(content, "binary", rng))
        assert (sum_of_files(tmp_path) == whole) == (changed == content)
    path.rename(tmp_path / "moved.bin")
    assert sum_of_files(tmp_path) != whole


def test_a_camera_of_too_many_pixels():
    with pytest.raises(InputError, match="60000×60000 pixels; expected at least one"):
        Pinhole(60_000, 60_000, 1.0, 1.0, 1.0, 1.0)
