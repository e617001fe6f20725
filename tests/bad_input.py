"""Valid files of every kind that is read, how each is read, and how they are spoilt. For tests and fuzzers."""

import io
import json
import re
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
from drives import CAM0_TO_VELO, CAM_TO_POSE, MeiTwin
from PIL import Image
from scenes import SAMPLE_DRIVE, write_scene

from edge_depth_nerf.base.files import (
    read_distance_png,
    read_image,
    read_json,
    read_mask,
    read_npy,
    read_npz,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.base.png import read_png_bytes
from edge_depth_nerf.cameras.calibration_file import parse_toml, read_lens
from edge_depth_nerf.compare.command import read_tuned
from edge_depth_nerf.compare.results import check_fair, read_results
from edge_depth_nerf.compare.specification import RunSpecification
from edge_depth_nerf.lidar.scans import ScanFormat, check_scan, read_cloud, read_scan
from edge_depth_nerf.method.error_model import read_calibration
from edge_depth_nerf.mono.files import read_maps
from edge_depth_nerf.mono.network import DepthNetwork, NetworkSettings, load_network, save_network
from edge_depth_nerf.process.kitti360.calibration import (
    read_cam_to_pose,
    read_cam_to_velo,
    read_mei_camera,
    read_poses,
)
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.poses import read_frame_times, read_kitti, read_nerfstudio, read_times, read_tum
from edge_depth_nerf.process.rig import read_rig_recording
from edge_depth_nerf.process.rig_file import read_rig
from edge_depth_nerf.scene.reader import read_scene

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"
RIG = """
[poses]
file = "poses.txt"
format = "tum"
[cameras.left]
images = "images"
times_file = "times.txt"
model = "kannala-brandt"
width = 16
height = 12
fx = 6.5
fy = 6.5
cx = 8.0
cy = 6.0
k1 = -0.01
masks = "masks"
to_vehicle = [[1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
[lidars.roof]
scans = "lidar/*.bin"
rate_hz = 10
turn_s = 0.1
timestamp = "middle"
direction = "clockwise"
to_vehicle = {translation = [0.8, 0.02, 0.84], quaternion = [0.0, 0.0, 0.0, 1.0]}
"""


@dataclass(frozen=True)
class Reader:
    """A kind of file."""

    make: Callable[[Path], Path]
    """Writes a valid one, with what it needs, into a folder."""
    read: Callable[[Path], Any]
    """What the package does with it."""
    kind: str = "text"
    """text, json, png, npy or binary: which faults suit it."""


def named(name: str, content: str | bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def points() -> np.ndarray:
    return np.random.default_rng(0).uniform(1, 40, (24, 4)).astype("<f4")


def ply(encoding: str) -> bytes:
    table = points()
    head = f"ply\nformat {encoding} 1.0\nelement vertex {len(table)}\n"
    head += "".join(f"property float {name}\n" for name in ("x", "y", "z", "intensity")) + "end_header\n"
    body = table.tobytes() if encoding != "ascii" else "\n".join(" ".join(map(str, row)) for row in table).encode()
    return head.encode() + body


def pcd(data: str) -> bytes:
    table = points()
    count = len(table)
    head = f"VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\n"
    head += f"POINTS {count}\nDATA {data}\n"
    if data == "ascii":
        return head.encode() + "\n".join(" ".join(map(str, row)) for row in table).encode()
    if data == "binary":
        return head.encode() + table.tobytes()
    whole = table.T.tobytes()
    packed = b"".join(bytes([len(part) - 1]) + part for part in (whole[i : i + 32] for i in range(0, len(whole), 32)))
    return head.encode() + struct.pack("<II", len(packed), len(whole)) + packed


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)  # pyrefly: ignore
    return file.getvalue()


def picture(write: Callable[[Path, Any], None], pixels: np.ndarray) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write(folder / "a.png", pixels)
        return folder / "a.png"

    return make


def jpeg(suffix: str) -> bytes:
    return cv2.imencode(suffix, np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3))[1].tobytes()


def by_pillow(kind: str) -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)).save(file, kind)
    return file.getvalue()


def scene(folder: Path) -> Path:
    return write_scene(folder, frames=2, ply_file_path=None) / "transforms.json"


def read_whole_scene(path: Path) -> None:
    found = read_scene(path)
    for each in found.pictures:
        found.maps(each)
    found.points_m()


def recording(folder: Path) -> Path:
    """A whole small recording; its rig file is what is spoilt."""
    for number in range(4):
        write_png(folder / f"images/{number:06d}.png", np.zeros((12, 16, 3), np.uint8))
        write_mask(folder / f"masks/{number:06d}.png", np.ones((12, 16), bool))
        (folder / "lidar").mkdir(exist_ok=True)
        (folder / f"lidar/{number:06d}.bin").write_bytes(points().tobytes())
    (folder / "times.txt").write_text("0.0\n0.1\n0.2\n0.3\n")
    (folder / "poses.txt").write_text("".join(f"{t / 10} {t} 0 0 0 0 0 1\n" for t in range(-1, 6)))
    return named("rig.toml", RIG)(folder)


def read_recording(path: Path) -> None:
    read_rig_recording(RigOptions(root=path.parent, rig=path, output=path.parent / "scene"))


def weights(folder: Path) -> Path:
    save_network(folder / "a.safetensors", DepthNetwork(NetworkSettings((8, 8), 32, 1.5, 20.0)), {"preset": "none"})
    return folder / "a.safetensors"


def figures(folder: Path) -> Path:
    run = asdict(RunSpecification("scene", "0" * 64, "lite", "edge", 0, None))
    content = {"run": run, "named": ["pipeline.model.depth_loss"], "configuration": {"a": 1}, "steps": 10}
    content |= {"figures": {"psnr": 20.0}, "curve": [{"step": 10.0, "psnr": 20.0}]}
    write_json(folder / "scene/edge_seed-0/figures.json", content)
    return folder / "scene/edge_seed-0/figures.json"


def read_figures(path: Path) -> None:
    results = read_results(path.parents[2])
    check_fair(results)
    results.rows()


def tables(path: Path) -> None:
    read_rig(path, path.parent)


POSES = "".join(f"{number} {IDENTITY}\n" for number in range(0, 40, 3))
TIMES = "".join(f"2013-05-28 08:46:{second:02d}.123456789\n" for second in range(12))
TUM = "# time x y z qx qy qz qw\n" + "".join(f"{t} {t} 2 3 0 0 0 1\n" for t in range(12))
FRAMES = {"frames": [{"file_path": f"front/{n}.png", "transform_matrix": np.eye(4).tolist()} for n in range(4)]}

CAMCHAIN = """cam0:
  camera_model: omni
  intrinsics: [1.2, 6.5, 6.25, 8.0, 6.0]
  distortion_model: radtan
  distortion_coeffs: [-0.1, 0.01, 0.001, 0.002]
  T_cam_imu:
  - [1.0, 0.0, 0.0, 0.1]
  resolution: [16, 12]
"""
SPHERE = {"camera_type": "ucm", "intrinsics": {"fx": 6.5, "fy": 6.5, "cx": 8.0, "cy": 6.0, "alpha": 0.5}}
BASALT = {"value0": {"intrinsics": [SPHERE], "resolution": [[16, 12]]}}
OCAM = "#polynomial\n\n3 -3.2 0.0 0.045\n\n#inverse\n\n2 1 2\n\n5.6 7.7\n\n0.999 2e-3 -1e-3\n\n12 16\n"

OURS: dict[str, Reader] = {
    "kitti yaml": Reader(named("image_02.yaml", MeiTwin.kitti360("image_02", 1400).yaml("image_02")), read_mei_camera),
    "kitti cam to pose": Reader(
        named("a.txt", "".join(f"{name}: {numbers}\n" for name, numbers in CAM_TO_POSE.items())), read_cam_to_pose
    ),
    "kitti cam to velo": Reader(named("a.txt", CAM0_TO_VELO + "\n"), read_cam_to_velo),
    "kitti poses": Reader(named("a.txt", POSES), read_poses),
    "kitti timestamps": Reader(named("a.txt", TIMES), read_frame_times),
    "tum": Reader(named("a.txt", TUM), read_tum),
    "poses of 12 numbers": Reader(named("a.txt", f"{IDENTITY}\n" * 5), read_kitti),
    "poses of nerfstudio": Reader(named("a.json", json.dumps(FRAMES)), read_nerfstudio, "json"),
    "times": Reader(named("a.txt", "".join(f"a{n}.png {n}.5\n" for n in range(9))), read_times),
    "rig toml": Reader(named("rig.toml", RIG), tables),
    "calibration of kalibr": Reader(named("a.yaml", CAMCHAIN), read_lens),
    "calibration of basalt": Reader(named("a.json", json.dumps(BASALT)), read_lens, "json"),
    "calibration of ocam": Reader(named("a.txt", OCAM), read_lens),
    "calibration of a rig": Reader(named("rig.toml", RIG), read_lens),
    "rig json": Reader(named("rig.json", json.dumps(parse_toml(RIG))), tables, "json"),
}
"""Parsers that are written out in this project: those of the coverage-guided fuzzer."""

READERS: dict[str, Reader] = {
    **OURS,
    "recording": Reader(recording, read_recording),
    "scan bin": Reader(named("a.bin", points().tobytes()), lambda path: scan(path), "binary"),
    "scan npy": Reader(named("a.npy", npy(points())), lambda path: scan(path), "npy"),
    "scan npz": Reader(named("a.npz", npz(data=points())), lambda path: scan(path), "binary"),
    "scan ply ascii": Reader(named("a.ply", ply("ascii")), lambda path: scan(path)),
    "scan ply binary": Reader(named("a.ply", ply("binary_little_endian")), lambda path: scan(path), "binary"),
    "scan pcd ascii": Reader(named("a.pcd", pcd("ascii")), lambda path: scan(path)),
    "scan pcd binary": Reader(named("a.pcd", pcd("binary")), lambda path: scan(path), "binary"),
    "scan pcd compressed": Reader(named("a.pcd", pcd("binary_compressed")), lambda path: scan(path), "binary"),
    "cloud": Reader(named("a.ply", ply("binary_big_endian")), read_cloud, "binary"),
    "picture": Reader(picture(write_png, np.zeros((12, 16, 3), np.uint8)), read_image, "png"),
    "picture jpg": Reader(named("a.jpg", jpeg(".jpg")), read_image, "binary"),
    "picture bmp": Reader(named("a.bmp", jpeg(".bmp")), read_image, "binary"),
    "picture tif": Reader(named("a.tif", jpeg(".tif")), read_image, "binary"),
    "picture webp": Reader(named("a.webp", by_pillow("WEBP")), read_image, "binary"),
    "picture avif": Reader(named("a.avif", by_pillow("AVIF")), read_image, "binary"),
    "picture copied": Reader(picture(write_png, np.zeros((12, 16, 3), np.uint8)), read_png_bytes, "png"),
    "mask": Reader(picture(write_mask, np.ones((12, 16), bool)), read_mask, "png"),
    "distance": Reader(picture(write_distance_png, np.full((12, 16), 9.0)), read_distance_png, "png"),
    "map npy": Reader(named("a.npy", npy(np.ones((12, 16), np.float32))), lambda path: read_maps([path], 1.0), "npy"),
    "array npy": Reader(named("a.npy", npy(np.ones((12, 16), np.uint16))), read_npy, "npy"),
    "arrays npz": Reader(
        named("a.npz", npz(distance_m=np.ones((12, 16), np.float32))),
        lambda path: read_npz(path, ("distance_m",), 4 * 12 * 16),
        "npy",
    ),
    "json": Reader(named("a.json", json.dumps(FRAMES)), read_json, "json"),
    "scene": Reader(scene, read_whole_scene, "json"),
    "trust": Reader(
        lambda folder: Path(shutil.copy(SAMPLE_DRIVE / "mono_trust.json", folder)), read_calibration, "json"
    ),
    "weights": Reader(weights, load_network, "binary"),
    "tuned": Reader(
        named("a.json", json.dumps({"methods": {"ds-nerf": {"lambda": 0.01, "sigma_m": 0.5}}})), read_tuned, "json"
    ),
    "figures": Reader(figures, read_figures, "json"),
}
"""All that is read without nerfstudio."""


def scan(path: Path) -> None:
    check_scan(path, ScanFormat())
    read_scan(path, ScanFormat())


WORDS = (
    *("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", "9" * 400, "9" * 5000, "0x10", "1_0", "true"),
    *("²", "١", "\x00", "\u202e", "\x1b[2J", "\ud7ff", "../../etc/passwd", "/etc/passwd", "~", "**", "[", ""),
    "a" * 300,
    *("&a [*a,*a]", "*a", "!!python/object/apply:os.system ['true']", "<<: *a", "%s%n", "[" * 3000, "{" * 3000, "'''"),
    *("element vertex 99999999999", "COUNT 1000000000 1 1 1", "SIZE 4 4 4 99", "POINTS -1", "a.b.c.d = 1", "[[", "}}"),
)
VALUES: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1e308, -1e308, 10**400, 2**31, 2**63, 0.5, float("nan"), float("inf"), "", "x", "²"),
    *("../x", "/etc/passwd", "a\0b", "\udc80", "x" * 300, [], {}, [[]], [None], [[1, 2], [3]], {"a": {}}, ["x", 1]),
    *([[float("nan")] * 4] * 4, [["1"] * 4] * 4, [1e300] * 6, "images/../../x"),
)
SIZES = (0, 1, 2**7, 2**15, 60000, 2**16 - 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1)


def spoilt(content: bytes, kind: str, rng: Random) -> bytes:
    """A valid file with one to three faults."""
    for _ in range(rng.randint(1, 3)):
        faults: list[Callable[[bytes, Random], bytes]] = [_bytes, _cut, _doubled, _recoded]
        if kind in ("text", "json"):
            faults += [_word, _word, _lines]
        faults += {"json": [_json] * 6, "png": [_png] * 4, "npy": [_npy] * 4}.get(kind, [])
        if kind in ("binary", "npy", "png"):
            faults += [_number, _number, _word]
        content = rng.choice(faults)(content, rng)
    return content


def _bytes(content: bytes, rng: Random) -> bytes:
    made = bytearray(content or b"\0")
    for _ in range(rng.randint(1, 8)):
        made[rng.randrange(len(made))] = rng.choice((0, 0xFF, 0x80, 0x0A, 0x20, rng.randrange(256)))
    return bytes(made)


def _cut(content: bytes, rng: Random) -> bytes:
    start = rng.randint(0, len(content))
    return content[:start] + content[start + rng.choice((1, 8, 64, len(content))) :]


def _doubled(content: bytes, rng: Random) -> bytes:
    start, count = rng.randint(0, len(content)), rng.choice((1, 16, 200))
    return content[:start] + content[start : start + count] * rng.choice((2, 3, 100)) + content[start:]


def _recoded(content: bytes, rng: Random) -> bytes:
    if rng.random() < 0.7:
        return content
    text = content.decode("latin-1")
    return rng.choice((text.encode("utf-16"), text.encode("utf-8-sig"), b"\xff" + content, content + b"\0" * 4096))


def _word(content: bytes, rng: Random) -> bytes:
    words = list(re.finditer(rb"[^\s,:=\[\]{}\"]+", content[:100_000]))
    hostile = rng.choice(WORDS).encode("utf-8", "surrogatepass")
    if not words:
        return hostile
    found = rng.choice(words)
    return content[: found.start()] + hostile + content[found.end() :]


def _lines(content: bytes, rng: Random) -> bytes:
    lines = content.split(b"\n")
    index = rng.randrange(len(lines))
    made: list[list[bytes]] = [[], [lines[index]] * 3, [lines[index] * 50], [rng.choice(WORDS).encode()]]
    return b"\n".join((*lines[:index], *rng.choice(made), *lines[index + 1 :]))


def _json(content: bytes, rng: Random) -> bytes:
    try:
        whole = json.loads(content)
    except (ValueError, RecursionError):
        return content
    node, steps = whole, rng.randint(0, 7)
    for _ in range(steps):
        if not isinstance(node, (dict, list)) or not node:
            break
        key: Any = rng.choice(list(node)) if isinstance(node, dict) else rng.randrange(len(node))
        if not isinstance(node[key], (dict, list)) or not node[key] or rng.random() < 0.2:
            if rng.random() < 0.15:
                del node[key]
            else:
                node[key] = rng.choice(VALUES)
            break
        node = node[key]
    return json.dumps(whole).encode()


def _png(content: bytes, rng: Random) -> bytes:
    """Another header, with its checksum; or another block."""
    if len(content) < 33:
        return content
    head = list(struct.unpack(">IIBBBBB", content[16:29]))
    place = rng.randrange(7)
    head[place] = rng.choice(SIZES) if place < 2 else rng.randrange(256) if rng.random() < 0.3 else rng.randrange(17)
    block = b"IHDR" + struct.pack(">IIBBBBB", *head)
    made = content[:12] + block + struct.pack(">I", zlib.crc32(block)) + content[33:]
    if rng.random() < 0.3:
        extra = rng.choice((b"tRNS", b"PLTE", b"iCCP", b"zTXt", b"IDAT", b"acTL")) + rng.randbytes(rng.randrange(40))
        made = made[:33] + struct.pack(">I", len(extra) - 4) + extra + struct.pack(">I", zlib.crc32(extra)) + made[33:]
    return made


def _npy(content: bytes, rng: Random) -> bytes:
    """Another shape, type or order in an array's header."""
    shapes = (b"(99999999999,)", b"(-1, 16)", b"()", b"(True, 2)", b"(2**40,)", b"(0, 9)")
    kinds = (b"'|O'", b"'<f2'", b"'<M8[s]'", b"'|V99999999'", b"[('x','<f4')]", b"'<f4,<i8'")
    swaps = (
        (rb"\(\d+, ?\d*\)", rng.choice(shapes)),
        (rb"'[<|]\w\d+'", rng.choice(kinds)),
        (rb"False", rng.choice((b"True", b"0", b"open('x')", b"(" * 400, b"-" * 4000 + b"1"))),
        (rb"\{", rng.choice((b"{{", b"", b"{'shape': (1,),"))),
    )
    pattern, replacement = rng.choice(swaps)
    return re.sub(pattern, lambda _: replacement, content, count=1)


def _number(content: bytes, rng: Random) -> bytes:
    """A hostile number where a size may stand."""
    if len(content) < 9:
        return content
    start = rng.randrange(min(len(content) - 8, 4096))
    size = rng.choice(("<H", ">H", "<I", ">I", "<Q"))
    value = rng.choice(SIZES) & ((1 << (8 * struct.calcsize(size))) - 1)
    number = struct.pack(size, value if rng.random() < 0.8 else (1 << (8 * struct.calcsize(size))) - 1)
    return content[:start] + number + content[start + len(number) :]


def describe(path: Path) -> str:
    """For messages of failures."""
    return f"{path.name}: {path.read_bytes()[:400]!r}"
