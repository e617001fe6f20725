"""Monocular maps from any other tool, by file: .npy or 16-bit .png, one for each picture of a scene, or each view."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import DISTANCE_STEPS_PER_METRE, load_npy, read_array_header, read_distance_png
from edge_depth_nerf.base.png import read_png_header
from edge_depth_nerf.cameras.rays import LEAST_COSINE
from edge_depth_nerf.mono.options import Along
from edge_depth_nerf.mono.relative import Kind, Layer
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture


def find_maps(
    scene: SceneFolder, folder: Path, kind: Kind, along: Along, metres_per_count: float | None
) -> Callable[[ScenePicture], list[Layer]]:
    """Find a map for every picture of a scene, and check all by their headers.

    The folder holds CAMERA/FRAME.npy or .png, with the names of the scene's cameras and pictures.

    Returns:
        What reads a picture's map, and raises as `read_maps`.

    Raises:
        FileNotFoundError: the folder or a map is not there.
        InputError: a map is of another size than its picture, or of a kind that is not read.
    """
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder}: no such folder. --maps takes the folder that holds CAMERA/FRAME.npy or .png."
        )
    found = {}
    for picture in scene.pictures:
        camera = [part for part in Path(picture.camera).parts if part not in ("..", "/")]
        stem = folder.joinpath(*camera, Path(picture.name).stem)
        found[picture.name] = find_map(stem, picture.name, (picture.lens.width, picture.lens.height))
    metres = count_m(folder, found.values(), kind, metres_per_count)

    def layer(picture: ScenePicture) -> list[Layer]:
        (values,) = read_maps([found[picture.name]], metres)
        cosine = np.ones(values.shape, np.float32) if along == "ray" else scene.rays(picture).cos_theta
        whole = slice(0, picture.lens.height), slice(0, picture.lens.width)
        return [Layer(whole, values, cosine, (cosine >= LEAST_COSINE).astype(np.float32))]

    return layer


def count_m(folder: Path, paths: Iterable[Path], kind: Kind, metres_per_count: float | None) -> float:
    """Say how many metres a count of PNGs is, which has to be given for metric ones alone.

    Raises:
        InputError: it is missing, or given without need.
    """
    has_png = any(path.suffix == ".png" for path in paths)
    if has_png and kind == "metric" and metres_per_count is None:
        raise InputError(
            f"{folder}: contains PNGs, whose unit is unknown. Give --metres-per-count, such as 0.00390625 (1/256 m, "
            "as in this project and KITTI) or 0.001."
        )
    if not has_png and metres_per_count is not None:
        raise InputError(
            f"--metres-per-count {metres_per_count:g}: is for PNGs, but {folder} contains .npy files, which are in "
            "metres."
        )
    return metres_per_count or 1 / DISTANCE_STEPS_PER_METRE


def find_map(stem: Path, picture: str, size: tuple[int, int]) -> Path:
    """Find the map of a picture, .npy or .png behind `stem`, and check by its header that it has the size.

    Raises:
        FileNotFoundError: it is not there.
        InputError: it is of another width or height, or of a kind that is not read.
    """
    choices = [stem.with_name(f"{stem.name}{suffix}") for suffix in (".npy", ".png")]
    there = [path for path in choices if path.is_file()]
    if not there:
        raise FileNotFoundError(
            f"{choices[0]}: no such file, nor {choices[1].name}. --maps needs a map for every picture, "
            "under its name; those of a scene in folders of their cameras."
        )
    if len(there) > 1:
        raise InputError(f"{there[0]}: {there[1].name} exists as well. Keep one map for each picture.")
    if there[0].suffix == ".npy":
        height, width = npy_shape(there[0])
    else:
        header = read_png_header(there[0])
        if not header.is_distance:
            raise InputError(
                f"{there[0]}: {header.bit_depth}-bit {header.colour}, expected a 16-bit grey PNG. Other kinds have "
                "lost the distance; export the map again, best as .npy."
            )
        height, width = header.height, header.width
    if (width, height) != size:
        raise InputError(
            f"{there[0]}: is {width}×{height} (width × height), its picture {picture} {size[0]}×{size[1]}. A map needs "
            "a value for every pixel: make it in the picture's own size."
        )
    return there[0]


def read_maps(paths: Sequence[Path], metres_per_count: float) -> list[NDArray[np.float32]]:
    """Read the maps of a picture, H×W each; NaN where there is no positive, finite number.

    Raises:
        InputError: one cannot be read, or none holds a positive number.
    """
    maps = []
    for path in paths:
        if path.suffix == ".npy":
            shape = npy_shape(path)
            # beyond float32's range is infinity, which is no distance
            with np.errstate(over="ignore"):
                values = load_npy(path).reshape(shape).astype(np.float32)
        else:
            values = read_distance_png(path, metres_per_count)
        maps.append(np.where(np.isfinite(values) & (values > 0), values, np.float32(np.nan)))
    if all(np.isnan(each).all() for each in maps):
        others = ", and so do those of the picture's other views" if len(paths) > 1 else ""
        raise InputError(
            f"{paths[0]}: contains no positive number, only zeros, negative numbers, NaN or infinity{others}. "
            "Make it again, or leave its picture out."
        )
    return maps


def npy_shape(path: Path) -> tuple[int, int]:
    """Height and width of the map in a .npy file, from its header, which is held against the file's size.

    Raises:
        InputError: not a .npy file, truncated, or not one map of floating-point numbers.
    """
    broken = "Save the map with numpy.save, as H×W floating-point numbers."
    with path.open("rb") as file:
        shape, _, kind = read_array_header(file, str(path))
        start, size = file.tell(), file.seek(0, 2)
    if kind.kind != "f":
        raise InputError(f"{path}: holds {kind}, expected float16, float32 or float64. {broken}")
    sides = [side for side in shape if side != 1] if len(shape) > 2 else list(shape)
    if len(sides) != 2 or min(sides) < 1:
        raise InputError(f"{path}: its shape is {shape}, expected height × width. {broken}")
    if size - start < math.prod(shape) * kind.itemsize:
        raise InputError(
            f"{path}: truncated: {size - start} bytes of numbers for a shape of {shape} of {kind}. Copy or make the "
            "file again."
        )
    return sides[0], sides[1]
