"""Small scene folders with a known truth: cameras inside a ball of 6 m with a coloured wall; the sample drive."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from balls import RADIUS_M
from balls import pose as turned

from edge_depth_nerf.base.files import read_json, write_distance_png, write_json, write_mask, write_png
from edge_depth_nerf.cameras import Camera, KannalaBrandt, Pinhole

SAMPLE_DRIVE = Path(__file__).resolve().parents[1] / "data" / "sample_drive"
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV camera axes to OpenGL's


def copy_sample_drive(folder: Path) -> Path:
    """Copy data/sample_drive as the repository has it: without the `.cache` of those who trained on it."""
    return Path(shutil.copytree(SAMPLE_DRIVE, folder, ignore=shutil.ignore_patterns(".cache")))


def tree(folder: Path) -> dict[str, bytes]:
    """Contents of a folder's files by their names."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@contextmanager
def transforms(scene: Path) -> Iterator[dict[str, Any]]:
    """What transforms.json says, to be changed."""
    meta = read_json(scene / "transforms.json")
    yield meta
    write_json(scene / "transforms.json", meta)


def fisheye(width: int = 32, height: int = 28) -> KannalaBrandt:
    return KannalaBrandt(width, height, 9.0, 9.1, width / 2 + 0.3, height / 2 - 0.2, 0.02, -0.004, 0.0, 0.0, 1e-3, 2e-3)


def pinhole(width: int = 32, height: int = 28) -> Pinhole:
    return Pinhole(width, height, 20.0, 20.5, width / 2, height / 2, 0.01, 0.0, 0.0, 0.0)


def view(camera: Camera, camera_to_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (H×W×3 uint8), distance (H×W, metres) and z of the rays (H×W) inside the ball."""
    directions, valid = camera.unproject(camera.pixel_centres())
    rays = torch.nan_to_num(directions).numpy() @ camera_to_world[:3, :3].T
    origin = camera_to_world[:3, 3]
    along = rays @ origin
    distance = -along + np.sqrt(along**2 + RADIUS_M**2 - origin @ origin)  # pyrefly: ignore[unsupported-operation]
    wall = (origin + distance[..., None] * rays) / RADIUS_M
    colours = 127 + 120 * np.sin(wall * np.array([3.0, 4.0, 5.0]) + np.array([0.0, 1.0, 2.0]))
    known = valid.numpy()
    z = np.where(known, torch.nan_to_num(directions[..., 2]).numpy(), 0)
    return (colours * known[..., None]).astype(np.uint8), np.where(known, distance, 0), z


def frame_entry(camera: Camera, camera_to_world: np.ndarray, name: str) -> dict[str, Any]:
    """What transforms.json says of images/NAME; the pose is OpenCV's."""
    return {
        "file_path": f"images/{name}",
        "transform_matrix": (camera_to_world @ FLIP).tolist(),
        **{"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy},
        **{"w": camera.width, "h": camera.height},
        **{key: value for key, value in camera.to_dict().items() if key in ("k1", "k2", "k3", "k4", "p1", "p2")},
    }


def write_scene(
    folder: Path,
    cameras: list[Camera] | None = None,
    frames: int = 9,
    lidar: bool = True,
    mono: bool = True,
    mask: bool = True,
    truth: bool = True,
    split: bool = True,
    **extra: Any,
) -> Path:
    """Write a scene of this project's format; frame i uses camera i % len(cameras)."""
    cameras = cameras or [fisheye()]
    rng = np.random.default_rng(0)
    entries = []
    for index in range(frames):
        camera = cameras[index % len(cameras)]
        pose = turned(0.2 * index, 0.1 * np.sin(index), 0.05 * index, 0.7 * index)
        colours, distance, _ = view(camera, pose)
        name = f"{index:04d}.png"
        write_png(folder / "images" / name, colours)
        entry = frame_entry(camera, pose, name)
        if mask:
            keep = np.ones(distance.shape, bool)
            keep[-5:] = False
            write_mask(folder / f"masks/{camera.width}.png", keep)
            entry["mask_path"] = f"masks/{camera.width}.png"
        if lidar:
            lidar_points = distance * (rng.random(distance.shape) < 0.3)
            write_distance_png(folder / "lidar" / name, lidar_points)
            entry["lidar_file_path"] = entry["depth_file_path"] = f"lidar/{name}"
        if mono:
            write_distance_png(folder / "mono" / name, distance * 1.1)
            entry["mono_file_path"] = f"mono/{name}"
        if truth:
            write_distance_png(folder / "truth/distance" / name, distance)
            write_png(folder / "truth/rgb" / name, colours)
            entry["truth_distance_file_path"] = f"truth/distance/{name}"
            entry["truth_rgb_file_path"] = f"truth/rgb/{name}"
        entries.append(entry)
    is_fisheye = isinstance(cameras[0], KannalaBrandt)
    meta = {"camera_model": "OPENCV_FISHEYE" if is_fisheye else "OPENCV", "frames": entries}
    if split:
        names = [entry["file_path"] for entry in entries]
        held_out = [name for i, name in enumerate(names) if i % 8 == 4] or names[:1]
        meta["train_filenames"] = [name for name in names if name not in held_out] or names
        meta["val_filenames"] = meta["test_filenames"] = held_out
    write_json(folder / "transforms.json", {**meta, "depth_unit_scale_factor": 1 / 256, **extra})
    return folder
