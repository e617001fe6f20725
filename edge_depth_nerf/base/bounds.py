"""What a file from outside may hold: sizes are bounded before anything is allocated, paths stay in their folder.

Light: neither torch nor nerfstudio is imported. Every bound lies well above what real drives have, and low enough that
no file takes more than a gigabyte of memory to be read or refused.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from edge_depth_nerf.base.errors import InputError

MAX_PIXELS = 1 << 26
"""No picture, mask or map has more (8192×8192)."""
MAX_PICTURE_BYTES = 1 << 28
"""No picture's file is larger."""
MAX_TEXT_BYTES = 1 << 28
"""No text file that is read line by line is larger: poses of an hour at 500 a second."""
MAX_LINES = 2_000_000
"""No text file has more lines with something in them."""
MAX_LINE_CHARACTERS = 1 << 16
"""No line of a text file is longer."""
MAX_JSON_BYTES = 100_000_000
"""No JSON file is larger: transforms.json of 40,000 pictures."""
MAX_JSON_VALUES = 8_000_000
"""No JSON file holds more numbers, texts, lists and objects; each needs up to a hundred bytes of memory."""
MAX_LENGTH_M = 1e8
"""No length is larger: coordinates of the whole earth still pass."""
MAX_TIME_S = 1e11
"""No time is further from 0, in seconds: three thousand years."""
_MAX_NAME_BYTES = 255
"""File systems take no longer names."""


def path_inside(folder: Path, name: object, where: str) -> Path:
    """Resolve a path that a file gives relative to `folder`, which it may not lead out of; errors name `where`.

    Links in the folder are followed: the folder's owner put them there, not the file.

    Raises:
        InputError: it is no text, absolute, leads out of the folder, or is no path at all.
    """
    if isinstance(name, str) and name and "\0" not in name:
        # no Path: a long drive's transforms.json has hundreds of thousands of names
        inner = os.path.normpath(name)
        try:
            longest = max(len(os.fsencode(part)) for part in name.replace(os.altsep or os.sep, os.sep).split(os.sep))
        except UnicodeEncodeError:
            longest = _MAX_NAME_BYTES + 1
        leaves = os.path.isabs(inner) or bool(os.path.splitdrive(inner)[0]) or inner.split(os.sep)[0] == os.pardir
        if not leaves and longest <= _MAX_NAME_BYTES:
            return folder / name
    raise InputError(
        f"{where} is {shown(name)}, expected the path of a file in {folder}, relative to it and not leading out of it. "
        "Move the file there, or put a link to it there, and name that."
    )


def check_pixels(width: int, height: int, where: str) -> None:
    """Check that a picture of this size may be read.

    Raises:
        InputError: it has more than `MAX_PIXELS`, or none; names `where`.
    """
    if not (width >= 1 and height >= 1 and width * height <= MAX_PIXELS):
        raise InputError(
            f"{where}: {width}×{height} pixels; expected at least one, and at most {MAX_PIXELS} in all. The file is "
            "damaged, or no picture of a drive."
        )


def check_bytes(path: Path, most: int) -> int:
    """Check a file's size before it is read; give it.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it has more than `most` bytes.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    size = path.stat().st_size
    if size > most:
        raise InputError(f"{path}: {size} bytes, expected at most {most}. It is damaged, or another kind of file.")
    return size


def read_text(path: Path, most_bytes: int) -> str:
    """Read a file of UTF-8 text, without the mark that some editors put before it.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is larger than `most_bytes`, or no text.
    """
    check_bytes(path, most_bytes)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error}). Copy or make the file again.") from None


def text_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with something in them, counted from 1, without space around them; one at a time in memory.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: too large, too many or too long lines, or no text.
    """
    check_bytes(path, MAX_TEXT_BYTES)
    found = 0
    with path.open(encoding="utf-8-sig") as file:
        number = 0
        while True:
            number += 1
            try:
                line = file.readline(MAX_LINE_CHARACTERS)
            except UnicodeDecodeError as error:
                raise InputError(f"{path}: not a text file ({error}). Copy or make the file again.") from None
            if not line:
                return
            if len(line) == MAX_LINE_CHARACTERS:
                raise InputError(
                    f"{path}, line {number}: longer than {MAX_LINE_CHARACTERS} characters. It is damaged, or another "
                    "kind of file."
                )
            if stripped := line.strip():
                found += 1
                if found > MAX_LINES:
                    raise InputError(f"{path}: more than {MAX_LINES} lines. Split the recording.")
                yield number, stripped


def finite(value: Any) -> float | None:
    """A number of a JSON or TOML file as a float; None if it is none, not finite, or too large for one."""
    # True is a number to Python only, and a whole number may be larger than any float
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def shown(value: object, most: int = 120) -> str:
    """What a file holds, for an error message: cut short, whatever it is."""
    if isinstance(value, int) and abs(value) >= 10**most:
        return "a whole number of more than a hundred digits"
    if isinstance(value, (list, tuple)) and len(value) > most:
        return f"a list of {len(value)}"
    if isinstance(value, dict) and len(value) > most:
        return f"a table of {len(value)}"
    try:
        text = repr(value[: 2 * most] if isinstance(value, str) else value)
    except (RecursionError, ValueError):
        return f"a {type(value).__name__}"
    return text if len(text) <= most else f"{text[:most]} …"
