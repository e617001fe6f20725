"""Files that can be made again: they end with a version and a checksum, stay few, and are safe to share.

A file that was cut, changed or written by another version counts as missing and is made again. The checksum stands
behind the content, so that NumPy maps the file into memory as if it were not there. Several processes may read, write
and clean one folder at once: files appear whole, and a removed file stays readable for processes that have opened it.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import IO

from edge_depth_nerf.base.files import remove_leftovers, write_atomically

_SEAL = struct.Struct("<8sII")
"""A mark, the version of the content, CRC-32 of all before."""
_MARK = b"edncache"
_CHUNK_BYTES = 1 << 22


class _Summed:
    """A binary file that adds up the checksum of what is written to it."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.crc = 0

    def write(self, content: bytes | memoryview) -> int:
        self.crc = zlib.crc32(content, self.crc)
        return self._file.write(content)


def write_checked(path: Path, version: int, write: Callable[[_Summed], object]) -> None:
    """Let `write` write a file from its beginning to its end, and seal it; atomically.

    Raises:
        OSError: it cannot be written.
    """

    def sealed(temporary: Path) -> None:
        with temporary.open("wb") as file:
            summed = _Summed(file)
            write(summed)
            file.write(_SEAL.pack(_MARK, version, summed.crc))

    write_atomically(path, sealed)


def is_whole(path: Path, version: int) -> bool:
    """Whether a file exists, is of this version and is unchanged; reads all of it, about 1 GB a second."""
    try:
        with path.open("rb") as file:
            left = os.fstat(file.fileno()).st_size - _SEAL.size
            crc = 0
            while left > 0:
                chunk = file.read(min(left, _CHUNK_BYTES))
                if not chunk:
                    return False
                crc = zlib.crc32(chunk, crc)
                left -= len(chunk)
            return left == 0 and file.read() == _SEAL.pack(_MARK, version, crc)
    except OSError:
        return False


def content_of(path: Path, version: int) -> bytes | None:
    """What was written to a small file, if it is whole and of this version."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    content, seal = stored[: -_SEAL.size], stored[-_SEAL.size :]
    return content if seal == _SEAL.pack(_MARK, version, zlib.crc32(content)) else None


def used(path: Path) -> None:
    """Note that a file was used now, for `keep_last`."""
    try:
        os.utime(path)
    except OSError:
        pass  # read-only, or removed by another process


def keep_last(folder: Path, pattern: str, count: int) -> None:
    """Of the files that fit a pattern keep those used last, and remove what killed processes left unfinished."""

    def date(path: Path) -> int:
        try:
            return path.stat().st_mtime_ns
        except OSError:
            return 0

    # names that begin with a dot are files that another process is writing
    files = sorted((path for path in folder.glob(pattern) if not path.name.startswith(".")), key=date)
    for path in files[: max(len(files) - count, 0)]:
        try:
            path.unlink()
        except OSError:
            pass  # another process was faster, or the folder cannot be written
    remove_leftovers(folder)
