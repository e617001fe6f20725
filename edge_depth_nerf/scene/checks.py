"""Checks of files by their headers and sizes, before the work begins."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import picture_head, read_mask
from edge_depth_nerf.base.png import PngHeader, read_png_header
from edge_depth_nerf.cameras import Camera


def check_size(path: Path, camera: Camera) -> PngHeader:
    """Check that a PNG is whole, as far as its ends tell, and has its camera's size.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not.
    """
    header = read_png_header(path)
    if (header.width, header.height) != (camera.width, camera.height):
        raise InputError(size_error(path, header.width, header.height, camera))
    return header


def check_picture_size(path: Path, camera: Camera) -> int:
    """Check by its header that a picture or mask of any format has its camera's size; give its EXIF orientation.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it has not, or cannot be read.
    """
    if path.suffix.lower() == ".png":
        read_png_header(path)
    head = picture_head(path)
    if (head.width, head.height) != (camera.width, camera.height):
        turned = head.orientation > 4 and (head.height, head.width) == (camera.width, camera.height)
        remedy = (
            f" Its EXIF orientation {head.orientation} would turn it to that size, but turns no picture here: turn the "
            "files themselves, as `mogrify -auto-orient` does."
        )
        raise InputError(size_error(path, head.width, head.height, camera) + (remedy if turned else ""))
    return head.orientation


def check_distance(path: Path, camera: Camera) -> None:
    """Check the same of a distance map.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is not, or not a distance map.
    """
    header = check_size(path, camera)
    if not header.is_distance:
        raise InputError(
            f"{path}: {header.bit_depth}-bit {header.colour}, expected a 16-bit grey PNG in units of 1/256 m. "
            "Other kinds have lost the distance; export the map again."
        )


def read_camera_mask(path: Path, camera: Camera) -> NDArray[np.bool_]:
    """Read a mask of a camera's pictures, True = use.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: broken, or not of the camera's size.
    """
    mask = read_mask(path)
    if mask.shape != (camera.height, camera.width):
        raise InputError(size_error(path, mask.shape[1], mask.shape[0], camera))
    return mask


def size_error(path: Path, width: int, height: int, camera: Camera) -> str:
    """Say that a file is not of its camera's size."""
    return (
        f"{path}: {width}×{height} pixels, but its camera's calibration says {camera.width}×{camera.height}. Pictures, "
        "masks and maps must have the size of the raw pictures; --downscale then reduces them together."
    )


def require_folder(folder: Path, remedy: str) -> None:
    """Check that a folder is there.

    Raises:
        FileNotFoundError: it is not; with what is there instead, and the remedy.
    """
    if folder.is_dir():
        return
    parent = next(each for each in folder.parents if each.is_dir())
    there = sorted(entry.name for entry in parent.iterdir())
    listed = f"{', '.join(there[:12])}{' …' if len(there) > 12 else ''}" if there else "nothing"
    what = "is not a folder" if folder.exists() else "no such folder"
    raise FileNotFoundError(f"{folder}: {what}; {parent.resolve()} holds {listed}. {remedy[0].upper()}{remedy[1:]}.")


MOST_LEFT_OUT = 0.1
"""A drive may have so many broken or missing files, as a share of its pictures; one in any case. More are a mistake."""


@dataclass(frozen=True)
class LeftOut:
    """A picture or a sweep that cannot be used."""

    frame: int | None
    """Number of its frame; None = between the chosen frames."""
    camera: str
    """Name of the camera, or of the scanner."""
    fault: str
    """What is wrong, with the file's name."""

    @property
    def key(self) -> str:
        """Which one, for people: "image_02, frame 7"."""
        return self.camera if self.frame is None else f"{self.camera}, frame {self.frame}"


class Tolerance:
    """Collects what cannot be used and is left out; several threads may find it.

    Args:
        strict: nothing may be left out.
        pictures: how many there are in all.
    """

    def __init__(self, strict: bool, pictures: int) -> None:
        self.strict = strict
        self._most = 0 if strict else max(1, int(MOST_LEFT_OUT * pictures))
        self._lock = threading.Lock()
        self._found: dict[tuple[int | None, str, str], LeftOut] = {}

    @property
    def left_out(self) -> tuple[LeftOut, ...]:
        """What was found, in order of cameras and frames."""
        return tuple(
            sorted(self._found.values(), key=lambda item: (item.camera, -1 if item.frame is None else item.frame))
        )

    def add(self, frame: int | None, camera: str, error: InputError | FileNotFoundError) -> None:
        """Leave something out.

        Raises:
            InputError, FileNotFoundError: `error`, where nothing more can be left out.
        """
        with self._lock:
            if self.strict:
                raise error
            self._found[frame, camera, str(error)] = LeftOut(frame, camera, str(error))
            if len(self._found) > self._most:
                raise InputError(
                    f"{error} {len(self._found)} of this drive's files cannot be used; at most {self._most} may be "
                    "left out."
                ) from error

    @contextmanager
    def of(self, frame: int | None, camera: str) -> Iterator[None]:
        """Leave out what cannot be read here."""
        try:
            yield
        except (InputError, FileNotFoundError) as error:
            self.add(frame, camera, error)
