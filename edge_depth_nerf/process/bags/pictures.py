"""Pictures of ROS messages: sensor_msgs/Image in any of its encodings, and sensor_msgs/CompressedImage.

JPEG and PNG are written unchanged. All else becomes an 8-bit PNG, RGB or grey. ROS names a Bayer pattern by its first
two rows, from the upper left: rggb has red first.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.bounds import check_pixels
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_bytes, write_png
from edge_depth_nerf.base.jpeg import is_jpeg

# OpenCV names a pattern by the second row's second and third pixel
_PATTERNS = {
    **{"rggb": cv2.COLOR_BayerBG2RGB, "bggr": cv2.COLOR_BayerRG2RGB},
    **{"gbrg": cv2.COLOR_BayerGR2RGB, "grbg": cv2.COLOR_BayerGB2RGB},
}
_BAYER = {f"bayer_{pattern}{bits}": (code, bits) for pattern, code in _PATTERNS.items() for bits in (8, 16)}
"""OpenCV's code and the bits of each encoding."""
_CHANNELS: dict[str, tuple[int, int, list[int]]] = {
    **{"mono8": (1, 8, [0]), "8UC1": (1, 8, [0]), "mono16": (1, 16, [0])},
    **{"rgb8": (3, 8, [0, 1, 2]), "bgr8": (3, 8, [2, 1, 0]), "8UC3": (3, 8, [2, 1, 0])},
    **{"rgba8": (4, 8, [0, 1, 2]), "bgra8": (4, 8, [2, 1, 0]), "8UC4": (4, 8, [2, 1, 0])},
    **{"rgb16": (3, 16, [0, 1, 2]), "bgr16": (3, 16, [2, 1, 0])},
    **{"rgba16": (4, 16, [0, 1, 2]), "bgra16": (4, 16, [2, 1, 0])},
}
"""Channels, bits of each, and where red, green and blue are."""
_YUV = {
    **{"yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY},
    **{"yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2, "yuyv": cv2.COLOR_YUV2RGB_YUY2},
}
_PLANES = {"nv12": cv2.COLOR_YUV2RGB_NV12, "nv21": cv2.COLOR_YUV2RGB_NV21}
_DEPTH = ("16UC1", "32FC1")
_PNG = b"\x89PNG\r\n\x1a\n"


def why_no_picture(message: Any) -> str | None:
    """Why messages of this kind are no pictures of a camera; None if they are."""
    if not hasattr(message, "encoding"):
        head = bytes(message.data[:8])
        if "compressedDepth" in message.format:
            return "depth pictures, which are not unpacked"
        if not (is_jpeg(head) or head == _PNG):
            return f"compressed as {message.format or 'something unknown'}, which is neither JPEG nor PNG"
        return None
    encoding = message.encoding
    if encoding in _DEPTH:
        return "depth pictures, which are not unpacked"
    if encoding in (*_CHANNELS, *_YUV, *_PLANES, *_BAYER):
        return None
    return f"of encoding {encoding or '(empty)'}, which is not known"


def bits_used(message: Any) -> int:
    """How many bits the brightest pixel of a picture needs: 8, 10, 12, 14 or 16; 8 if it is broken."""
    brightest = 0
    with suppress(InputError):
        brightest = int(_samples(message).max(initial=0)) if _depth(message) == 16 else 0
    return next(bits for bits in (8, 10, 12, 14, 16) if brightest < 1 << bits)


def _depth(message: Any) -> int:
    encoding = getattr(message, "encoding", "")
    return _BAYER.get(encoding, _CHANNELS.get(encoding, (1, 8)))[1]


def _samples(message: Any) -> NDArray[np.unsignedinteger]:
    """The numbers of a raw picture, H×(W·channels); rows may end with padding."""
    height, width, step = message.height, message.width, message.step
    check_pixels(width, height, "a picture")
    channels = 2 if message.encoding in _YUV else _CHANNELS.get(message.encoding, (1, 8, []))[0]
    kind = np.dtype(np.uint8)
    if _depth(message) == 16:
        kind = np.dtype(">u2" if message.is_bigendian else "<u2")
    rows = height * 3 // 2 if message.encoding in _PLANES else height
    needed = width * channels * kind.itemsize
    if step < needed or len(message.data) < rows * step:
        raise InputError(
            f"{len(message.data)} bytes with a step of {step} cannot hold {width}×{height} pixels of {message.encoding}"
        )
    table = np.frombuffer(bytes(message.data), np.uint8, rows * step).reshape(rows, step)
    return np.ascontiguousarray(table[:, :needed]).view(kind)


def _converted(samples: NDArray, code: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(samples, code), np.uint8)


def decode(message: Any, bits: int) -> NDArray[np.uint8]:
    """A raw picture as H×W×3 RGB or H×W grey; `bits` of 16-bit ones are used.

    Raises:
        InputError: it is broken.
    """
    samples, encoding = _samples(message), message.encoding
    if _depth(message) == 16:
        samples = np.minimum(samples.astype(np.uint32) >> (bits - 8), 255).astype(np.uint8)
    if encoding in _BAYER:
        return _converted(samples, _BAYER[encoding][0])
    if encoding in _YUV:
        return _converted(samples.reshape(message.height, message.width, 2), _YUV[encoding])
    if encoding in _PLANES:
        return _converted(samples, _PLANES[encoding])
    channels, _, order = _CHANNELS[encoding]
    pixels = samples.reshape(message.height, message.width, channels)[..., order]
    return pixels[..., 0] if channels == 1 else np.ascontiguousarray(pixels)


def file_of(message: Any, bits: int) -> tuple[str, Callable[[Path], None]]:
    """The suffix of a picture's file, and what writes it."""
    if hasattr(message, "encoding"):
        return ".png", lambda path: write_png(path, decode(message, bits))
    pattern = message.format.split(";")[0].strip()
    content = message.data.tobytes()
    if pattern in _BAYER:
        return ".png", lambda path: write_png(path, _developed(content, _BAYER[pattern][0]))
    return ".jpg" if is_jpeg(content) else ".png", lambda path: write_bytes(path, _checked(content))


def _checked(content: bytes) -> bytes:
    if not (is_jpeg(content) or content.startswith(_PNG)):
        raise InputError(f"{len(content)} bytes that are neither JPEG nor PNG")
    return content


def _developed(content: bytes, code: int) -> NDArray[np.uint8]:
    """A compressed Bayer mosaic in colours."""
    return _converted(_decoded(content, cv2.IMREAD_GRAYSCALE), code)


def _decoded(content: bytes, how: int) -> NDArray:
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), how)
    if picture is None:
        raise InputError(f"{len(content)} bytes that cannot be decoded as a picture")
    return picture


def size_of(message: Any) -> tuple[int, int]:
    """Width and height of a picture.

    Raises:
        InputError: a compressed one that cannot be decoded.
    """
    if hasattr(message, "encoding"):
        return message.width, message.height
    picture = _decoded(message.data.tobytes(), cv2.IMREAD_UNCHANGED)
    return picture.shape[1], picture.shape[0]
