"""PNG files without decoding them: the header for checks before the work, the whole file for copying.

The header is read here: Pillow does not tell 8 from 16 bits a channel, and its `verify` reads the whole file, which is
too long for all pictures of a drive before the work.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from PIL import Image

from edge_depth_nerf.base.bounds import MAX_PICTURE_BYTES, check_bytes, check_pixels
from edge_depth_nerf.base.errors import InputError

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_END = b"IEND\xaeB`\x82"
"""The last block's name and checksum."""
_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey and alpha", 6: "RGBA"}


@dataclass(frozen=True)
class PngHeader:
    """What a PNG says of itself; sides in pixels, `bit_depth` bits per channel."""

    width: int
    height: int
    bit_depth: int
    colour: str
    """grey, RGB, palette, grey and alpha, RGBA."""

    @property
    def is_picture(self) -> bool:
        """Whether it is the plain kind that every reader takes: 8-bit RGB."""
        return self.bit_depth == 8 and self.colour == "RGB"

    @property
    def is_distance(self) -> bool:
        """Whether it can be a distance map: one channel of 16 bits."""
        return self.bit_depth == 16 and self.colour == "grey"


def _broken(path: Path, why: str) -> InputError:
    return InputError(f"{path}: {why}. Copy or make the file again.")


def read_png_header(path: Path) -> PngHeader:
    """Read the header, and look whether the file's end is there; a few bytes are read.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not a PNG, truncated, or larger than any picture is.
    """
    check_bytes(path, MAX_PICTURE_BYTES)
    with path.open("rb") as file:
        head = file.read(33)
        size = file.seek(0, 2)
        file.seek(max(0, size - 16))
        tail = file.read()
    if head[:8] != _SIGNATURE[: len(head[:8])] or size == 0:
        raise _broken(path, f"not a PNG ({size} bytes)")
    if len(head) < 33 or _END not in tail:
        raise _broken(path, f"truncated: {size} bytes without the end that a PNG has")
    width, height, bit_depth, colour = struct.unpack(">IIBB", head[16:26])
    check_pixels(width, height, str(path))
    return PngHeader(width, height, bit_depth, _COLOUR_TYPES.get(colour, f"colour type {colour}"))


def read_png_bytes(path: Path) -> bytes:
    """Read a whole PNG unchanged; Pillow checks each of its blocks against its checksum.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: not a PNG, truncated, or damaged.
    """
    read_png_header(path)
    content = path.read_bytes()
    try:
        with Image.open(BytesIO(content), formats=["PNG"]) as image:
            image.verify()
    except Exception as error:  # SyntaxError, OSError, ValueError, IndexError, struct.error, by what is damaged
        raise _broken(path, f"damaged ({error})") from None
    return content
