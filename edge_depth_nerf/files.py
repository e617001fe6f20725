"""Reading and writing files: atomically, with errors that name the file.

Distance maps on disk are 16-bit PNGs in units of 1/256 m (0 = no value, 256 m range, 4 mm steps).
Masks on disk are 8-bit PNGs: 255 = use the pixel, 0 = ignore it. Pictures are RGB in memory.
"""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.errors import InputError

DISTANCE_STEPS_PER_METRE = 256
"""A distance PNG counts in 1/256 m."""


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it into place.

    A reader sees the old file or the whole new one, never a part of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # two threads may write one file
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{threading.get_native_id()}{path.suffix}")
    try:
        write(temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes atomically."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)

    write_atomically(path, write)


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, content.encode())


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, indented; NaN and infinity are refused."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; a broken file is named with the line of its fault.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not JSON.

    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error}). Mend or re-create the file.") from error


def write_png(path: Path, image: NDArray) -> None:
    """Write H×W×3 uint8 RGB, H×W uint8 or H×W uint16 as PNG, atomically."""
    pixels = image[..., ::-1] if image.ndim == 3 else image
    ok, encoded = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 4])
    if not ok:
        raise RuntimeError(f"{path}: PNG encoding failed for {image.dtype} {image.shape}")
    write_bytes(path, encoded.tobytes())


def _decode(path: Path, flags: int) -> NDArray:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    content = np.fromfile(path, np.uint8)
    image = cv2.imdecode(content, flags) if content.size else None
    # libpng fills what a truncated file lacks with zeros, so the end mark is looked for as well
    if image is None or (path.suffix.lower() == ".png" and b"IEND" not in content[-16:].tobytes()):
        raise InputError(
            f"{path}: cannot be decoded as a picture ({content.size} bytes; truncated or not a picture). "
            "Copy or make the file again."
        )
    return image


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a picture as H×W×3 uint8 RGB.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: truncated or not a picture.

    """
    return np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR)[..., ::-1])


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask as H×W bool, True = use the pixel (any value but 0).

    Raises:
        FileNotFoundError: there is no such file.
        InputError: truncated or not a picture.

    """
    return _decode(path, cv2.IMREAD_GRAYSCALE) > 0


def write_mask(path: Path, mask: NDArray[np.bool_]) -> None:
    """Write an H×W mask, True = use the pixel, as 255."""
    write_png(path, mask.astype(np.uint8) * 255)


def write_distance_png(path: Path, distance_m: NDArray) -> None:
    """Write H×W metres as a 16-bit PNG of 1/256 m.

    What is not finite, not positive or beyond the 255.996 m range is written as 0 (no value); what is
    positive but below half a step is written as one step, so that it stays a value.
    """
    usable = np.isfinite(distance_m) & (distance_m > 0)
    steps = np.where(usable, distance_m, 0.0).astype(np.float64) * DISTANCE_STEPS_PER_METRE
    steps = np.where(usable, np.maximum(np.rint(steps), 1), 0)
    write_png(path, np.where(steps > 65535, 0, steps).astype(np.uint16))


def read_distance_png(path: Path, metres_per_step: float = 1 / DISTANCE_STEPS_PER_METRE) -> NDArray[np.float32]:
    """Read a 16-bit distance PNG as H×W float32 metres, 0 = no value.

    `metres_per_step` is 1/256 m in this project's own files; other people's scenes declare theirs.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: truncated, or not a 16-bit single-channel PNG.

    """
    image = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(
            f"{path}: expected a 16-bit single-channel PNG in units of 1/256 m, found "
            f"{image.dtype} {image.shape}. 8-bit or colour maps have lost the distance; export the map again."
        )
    return image.astype(np.float32) * np.float32(metres_per_step)
