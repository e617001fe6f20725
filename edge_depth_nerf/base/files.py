"""Reading and writing files: atomically, with errors that name the file.

Distance maps on disk are 16-bit PNGs in units of 1/256 m (0 = no value, 256 m range, 4 mm steps).
Masks on disk are 8-bit PNGs: 255 = use the pixel, 0 = ignore it. Pictures are RGB in memory.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import platform
import re
import threading
import time
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.bounds import (
    MAX_JSON_BYTES,
    MAX_JSON_VALUES,
    MAX_PICTURE_BYTES,
    MAX_PIXELS,
    check_bytes,
    check_pixels,
    read_text,
)
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.jpeg import is_jpeg, jpeg_fault

DISTANCE_STEPS_PER_METRE = 256
"""A distance PNG counts in 1/256 m."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".avif")
"""Pictures and masks that are found in a folder."""
_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP", "AVIF")
"""Pillow's names of the pictures that are read."""
_BY_PILLOW = ("WEBP", "AVIF")
_LOSSY = ("JPEG", *_BY_PILLOW)
_EXIF_ORIENTATION = 0x112


FORGOTTEN_AFTER_S = 24 * 3600.0
"""A temporary file that nothing was written to for so long is nobody's any more, whatever its name says."""
_TEMPORARY = re.compile(r"\..+\.(?P<host>[\w.-]*)~(?P<process>\d+)~\d+(\.\w+)?")


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it into place.

    A reader sees the old file or the whole new one, never a part of it.

    Raises:
        OSError: it cannot be written; with the file's name, which the system leaves out for a full disk.
    """
    # two threads, processes or machines may write one file
    writer = f"{platform.node()}~{os.getpid()}~{threading.get_native_id()}"
    temporary = path.with_name(f".{path.stem}.{writer}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, os.strerror(error.errno), str(path)) from error
    finally:
        try:
            temporary.unlink(missing_ok=True)
        except OSError:
            pass  # what went wrong is told by the first error


def remove_leftovers(folder: Path) -> None:
    """Remove what `write_atomically` leaves in a folder and those below when its process is killed.

    Files that another process is still writing stay.
    """
    for path in folder.rglob(".*"):
        named = _TEMPORARY.fullmatch(path.name)
        if named is None:
            continue
        try:
            ended = named["host"] == platform.node() and not _runs(int(named["process"]))
            if ended or time.time() - path.stat().st_mtime > FORGOTTEN_AFTER_S:
                path.unlink()
        except OSError:
            pass  # its writer has just moved it into place, or the folder cannot be written


def _runs(process: int) -> bool:
    """Whether there is a process of this number; on Windows every number counts, as asking would be Ctrl-C there."""
    if os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def explain(error: Exception) -> str:
    """The message for an error that the user can fix: one paragraph, with what to do about a disk or a folder."""
    remedies = {
        errno.ENOSPC: "The disk is full: free some space there, or choose another one",
        errno.EDQUOT: "Your share of the disk is used up: free some space there, or choose another disk",
        errno.EFBIG: "Files may not grow so large there: see `ulimit -f`, or choose another disk",
        errno.EROFS: "The disk is read-only: choose another folder",
        errno.EACCES: "This user has no permission there: check who owns the folder, or choose another one",
        errno.EPERM: "This user has no permission there: check who owns the folder, or choose another one",
    }
    remedy = remedies.get(error.errno or 0) if isinstance(error, OSError) else None
    if not isinstance(error, OSError) or remedy is None:
        return str(error)
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror}. {remedy}; finished work is kept. Run the same command again to resume."


def as_people_count(path: Path) -> list[tuple[int, str]]:
    """What files are sorted by so that the numbers in their names count as numbers."""
    # [0-9]: Unicode has digits that are no numbers to int
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"([0-9]+)", path.name)]


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes atomically."""
    write_atomically(path, lambda temporary: temporary.write_bytes(content))


def sha256_of(path: Path) -> str:
    """SHA-256 of a file that fits into memory, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def is_newer(path: Path, sources: Iterable[Path]) -> bool:
    """Whether a file is there, and none of its sources changed since; sources that are not there count as unchanged."""
    if not path.is_file():
        return False
    written_ns = path.stat().st_mtime_ns
    return all(source.stat().st_mtime_ns <= written_ns for source in sources if source.exists())


def write_text(path: Path, content: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, content.encode())


def file_stamp(path: Path) -> list[Any]:
    """What tells a file from another version of it, wherever its folder lies: names, size and time of change."""
    found = path.stat()
    return [path.parent.name, path.name, found.st_size, found.st_mtime_ns]


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically, indented; NaN and infinity are refused."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read JSON; a broken file is named with the line of its fault.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not JSON, or far too large.
    """
    text = read_text(path, MAX_JSON_BYTES)
    if text.count(",") + text.count("[") + text.count("{") > MAX_JSON_VALUES:
        raise InputError(f"{path}: more than {MAX_JSON_VALUES} values. Split the recording.")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error}). Repair or re-create the file.") from None


def read_json_object(path: Path, *keys: str) -> dict[str, Any]:
    """Read JSON that is to be an object with some keys; what is under them is for the caller to check.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not JSON, no object, or lacks a key.
    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: does not contain a JSON object. Delete or re-create the file.")
    if missing := [key for key in keys if key not in content]:
        raise InputError(f"{path}: has no {missing[0]!r}. Delete or re-create the file.")
    return content


def encoded(suffix: str, image: NDArray, options: Sequence[int] = ()) -> bytes:
    """Encode H×W×3 RGB, H×W×4 RGBA or H×W in the format of a suffix, with OpenCV's options."""
    pixels = np.ascontiguousarray(image)
    if image.ndim == 3:
        pixels = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    ok, content = cv2.imencode(suffix, pixels, options)
    if not ok:
        raise RuntimeError(f"{suffix}: encoding failed for {image.dtype} {image.shape}")
    return content.tobytes()


def write_png(path: Path, image: NDArray) -> None:
    """Write H×W×3 uint8 RGB, H×W uint8 or H×W uint16 as PNG, atomically."""
    write_bytes(path, encoded(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 4]))


class PictureHead(NamedTuple):
    """What a picture's file says before it is decoded."""

    width: int
    height: int
    format: str
    """One of `_FORMATS`."""
    orientation: int
    """Of its EXIF, 1 to 8; 1 = none. Nothing is turned by it."""


def picture_head(path: Path) -> PictureHead:
    """Read a picture's header alone.

    Pixels are used in the file's own order, as by nerfstudio and COLMAP: no EXIF orientation turns them, so that all
    sizes agree. Every reader of TIFF turns its pixels as the file says, and there it counts as the file's own order.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not such a picture, or larger than any picture is.
    """
    from PIL import Image  # not every command reads pictures

    size = check_bytes(path, MAX_PICTURE_BYTES)
    try:
        with Image.open(path, formats=_FORMATS) as image:
            kind, (width, height) = str(image.format), image.size
            check_pixels(width, height, str(path))
            # Pillow decodes all of a PNG to look for EXIF behind the pixels
            decodes = kind == "PNG" and b"eXIf" in path.read_bytes()
            exif = image.getexif() if decodes or kind != "PNG" else Image.Image.getexif(image)
            turned = 1 if kind == "TIFF" else exif.get(_EXIF_ORIENTATION, 1)
    except InputError:
        raise
    except Exception as error:  # Pillow raises whatever its readers meet
        what = str(error) if isinstance(error, Image.DecompressionBombError) else "truncated or not a picture"
        raise InputError(
            f"{path}: cannot be decoded as a picture ({size} bytes; {what}). Copy or make the file again."
        ) from None
    return PictureHead(width, height, kind, turned if turned in range(1, 9) else 1)


def _decode(path: Path, flags: int) -> tuple[NDArray, str]:
    """Decode a picture without turning it, channels in OpenCV's order; and give its format."""
    # decoders allocate what a header promises
    kind = picture_head(path).format
    content = np.fromfile(path, np.uint8)
    fault: str | None = "truncated or not a picture"
    try:
        if kind in _BY_PILLOW:
            image = _by_pillow(content.tobytes(), flags)
        else:
            image = cv2.imdecode(content, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except Exception as error:  # of either, whatever its readers meet
        image, fault = None, str(error).splitlines()[0] if kind in _BY_PILLOW and str(error) else fault
    # libpng fills what a truncated file lacks with zeros, so the end mark is looked for as well
    if image is not None and (path.suffix.lower() != ".png" or b"IEND" in content[-16:].tobytes()):
        fault = _fault_of(path, content.tobytes())
    if image is None or fault is not None:
        raise InputError(
            f"{path}: cannot be decoded as a picture ({content.size} bytes; {fault}). Copy or make the file again."
        )
    return image, kind


def _by_pillow(content: bytes, flags: int) -> NDArray:
    """Decode what OpenCV is often built without, to 8-bit BGR, or BGRA where there is alpha and `flags` keep it."""
    from PIL import Image

    with Image.open(BytesIO(content), formats=_BY_PILLOW) as image:
        has_alpha = flags == cv2.IMREAD_UNCHANGED and "A" in image.getbands()
        pixels = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    return np.concatenate((pixels[..., 2::-1], pixels[..., 3:]), -1)


def _fault_of(path: Path, content: bytes) -> str | None:
    """Find what OpenCV passes over: missing parts of a JPEG, strips of a TIFF that cannot be unpacked."""
    if is_jpeg(content):
        return jpeg_fault(content)
    if content[:4] in (b"II*\0", b"MM\0*"):
        from PIL import Image

        try:
            with Image.open(path, formats=("TIFF",)) as picture:
                picture.load()
        except (OSError, ValueError, SyntaxError) as error:
            return f"damaged ({error})"
    return None


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read a picture as H×W×3 uint8 RGB.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: truncated or not a picture.
    """
    return np.ascontiguousarray(_decode(path, cv2.IMREAD_COLOR)[0][..., ::-1])


def largest_of_16_bits(path: Path) -> int | None:
    """The largest value of a picture with 16 bits a channel; None if it has 8. Raises as `read_image`."""
    pixels, _ = _decode(path, cv2.IMREAD_UNCHANGED)
    return int(pixels.max()) if pixels.dtype == np.uint16 else None


def check_is_folder(output: Path) -> None:
    """Make sure that a folder can be made, or is there.

    Raises:
        InputError: there is a file of that name.
    """
    if output.exists() and not output.is_dir():
        raise InputError(f"{output}: is a file; --output needs a folder.")


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Read a mask as H×W bool, True = use the pixel: any value but 0, and not transparent.

    Lossy formats smear 0 and 255 a little, so that there the half is what counts.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: truncated or not a picture.
    """
    pixels, kind = _decode(path, cv2.IMREAD_UNCHANGED)
    channels = pixels.reshape(*pixels.shape[:2], -1)
    mask = (channels[..., :3] > (127 if kind in _LOSSY else 0)).any(-1)
    return mask & (channels[..., 3] > 0) if channels.shape[2] == 4 else mask


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
    image, _ = _decode(path, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise InputError(
            f"{path}: expected a 16-bit single-channel PNG in units of 1/256 m, found "
            f"{image.dtype} {image.shape}. 8-bit or colour maps have lost the distance; export the map again."
        )
    return image.astype(np.float32) * np.float32(metres_per_step)


ARRAY_ERRORS = (
    ValueError,
    TypeError,
    EOFError,
    OverflowError,
    SyntaxError,
    tokenize.TokenError,
    RecursionError,
    MemoryError,
)
"""What NumPy raises at headers of arrays that hold anything."""


_parsing = threading.Lock()
"""NumPy reads headers by Python's parser, which Python 3.11 before 3.11.8 may use in one thread at a time (its issue
106905)."""


def load_npy(path: Path, mmap_mode: Literal["r"] | None = None) -> NDArray:
    """Load an array as NumPy does, in any thread."""
    with _parsing:
        return np.load(path, mmap_mode=mmap_mode, allow_pickle=False)


def load_archive(content: bytes) -> dict[str, NDArray]:
    """Load all arrays of a .npz archive in memory as NumPy does, in any thread."""
    with _parsing, np.load(BytesIO(content), allow_pickle=False) as archive:
        return dict(archive)


def read_array_header(file: Any, where: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether in Fortran's order, and type of an array in NumPy's format; `file` is then at its numbers.

    Raises:
        InputError: no such header, or of anything but numbers; names `where`.
    """
    try:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        with _parsing:
            shape, fortran, kind = read(file)
    except ARRAY_ERRORS as error:
        said = (str(error).splitlines() or [""])[0]
        raise InputError(f"{where}: cannot be read as an array ({said}). Copy or make the file again.") from None
    if any(isinstance(side, bool) or side < 0 for side in shape):
        raise InputError(f"{where}: cannot be read as an array ({kind}, shape {shape}). Copy or make the file again.")
    return shape, fortran, kind


def read_npy(path: Path) -> NDArray:
    """Read an array of numbers from a .npy file; its header is held against the file's size first.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not such a file, truncated, of other things than numbers, or of more than `MAX_PIXELS` of them.
    """
    size = check_bytes(path, 9 * MAX_PIXELS)
    with path.open("rb") as file:
        return _read_array(file, str(path), min(size, 8 * MAX_PIXELS))


def _read_array(file: Any, where: str, most_bytes: int) -> NDArray:
    """Read an array of numbers in NumPy's format that takes at most `most_bytes`; errors name `where`."""
    shape, fortran, kind = read_array_header(file, where)
    size = math.prod(shape) * kind.itemsize
    content = bytearray(file.read(size) if size <= most_bytes else b"")
    if kind.kind not in "fiu" or len(content) != size:
        raise InputError(
            f"{where}: an array of {kind} and shape {shape}; expected numbers, all that the header promises, in at "
            f"most {most_bytes} bytes. Delete or make the file again."
        )
    return np.frombuffer(content, kind, math.prod(shape)).reshape(shape, order="F" if fortran else "C")


def read_npz(path: Path, names: Iterable[str], most_bytes: int) -> dict[str, NDArray]:
    """Read some arrays of a .npz archive, none of which may take more than `most_bytes` in memory.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: broken, an array is not there, or larger than that.
    """
    check_bytes(path, 4 * most_bytes + (1 << 20))
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for name in names:
                entry = archive.getinfo(f"{name}.npy")
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise ValueError(f"{name} uses an unsupported compression")
                with archive.open(entry) as member:
                    found[name] = _read_array(member, f"{path}: {name}", most_bytes)
    except InputError:
        raise
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: cannot be read as arrays ({error}). Delete or make the file again.") from None
    return found


def pcd_bytes(rows: NDArray) -> bytes:
    """Encode points as a binary PCD file. The fields of `rows` are those of the file, in their order."""
    names = rows.dtype.names or ()
    kinds = [rows.dtype[name] for name in names]
    header = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {' '.join(names)}\n"
        f"SIZE {' '.join(str(kind.itemsize) for kind in kinds)}\nTYPE {' '.join(kind.kind.upper() for kind in kinds)}\n"
        f"COUNT {' '.join('1' for _ in kinds)}\nWIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(rows)}\nDATA binary\n"
    )
    return header.encode() + rows.tobytes()


def open_folder(output: Path, record_path: Path, record: dict[str, Any], what: str) -> None:
    """Begin a folder that one command writes, or continue one with the same record of what it is made of.

    Raises:
        InputError: it has another record, or something else.
    """
    check_is_folder(output)
    if record_path.is_file():
        there = read_json(record_path)
        differing = [key for key in record if not isinstance(there, dict) or there.get(key) != record[key]]
        if differing:
            raise InputError(
                f"{output}: holds other {what} ({differing[0]} differs). Give another --output, or delete that folder."
            )
    elif output.is_dir() and (names := sorted(entry.name for entry in output.iterdir())):
        some = f"{', '.join(names[:5])}{', …' if len(names) > 5 else ''}"
        raise InputError(f"{output}: holds something else ({some}). Give another --output, or empty that folder.")
    else:
        write_json(record_path, record)
