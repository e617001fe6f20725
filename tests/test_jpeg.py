"""JPEGs of which a part is missing are told from whole ones, of whatever kind these are."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.base.jpeg import jpeg_fault

PICTURE = np.kron(np.random.default_rng(0).integers(0, 255, (30, 40, 3)), np.ones((4, 4, 1))).astype(np.uint8)


def by_opencv(*options: int) -> bytes:
    return cv2.imencode(".jpg", PICTURE, options)[1].tobytes()


def by_pillow(**options) -> bytes:
    file = io.BytesIO()
    Image.fromarray(PICTURE).save(file, "JPEG", **options)
    return file.getvalue()


def filled_up(jpeg: bytes) -> bytes:
    """With fill bytes before a marker, as T.81 allows."""
    return jpeg[:2] + b"\xff\xff" + jpeg[2:]


WHOLE = {
    "baseline": by_opencv(),
    "progressive": by_opencv(cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "restart markers": by_opencv(cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
    "comment, no subsampling, best quality": by_pillow(quality=100, subsampling=0, comment=b"\xff\xd9 is its end"),
    "grey": cv2.imencode(".jpg", PICTURE[..., 0])[1].tobytes(),
    "black": cv2.imencode(".jpg", np.zeros_like(PICTURE))[1].tobytes(),
    "fill bytes": filled_up(by_opencv()),
    "a preview behind": by_opencv() + by_opencv()[:500],
    "padded": by_opencv() + bytes(4096),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_whole_jpegs_pass(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "whole.jpg"
    path.write_bytes(WHOLE[kind])
    assert jpeg_fault(WHOLE[kind]) is None
    assert np.array_equal(read_image(path), cv2.imread(str(path))[..., ::-1])


@pytest.mark.parametrize("kind", [kind for kind in WHOLE if kind not in ("a preview behind", "padded")])
def test_a_cut_is_noticed_wherever_it_is(kind: str) -> None:
    whole = WHOLE[kind]
    lengths = [*range(3, len(whole) - 8, 97), *range(len(whole) - 8, len(whole))]
    assert [length for length in lengths if jpeg_fault(whole[:length]) is None] == []
    # filled up with zeros, but for the last byte
    assert [length for length in lengths[:-1] if jpeg_fault(whole[:length].ljust(len(whole), b"\0")) is None] == []


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg", ".JPG", ".png"])
def test_a_cut_jpeg_is_named_whatever_its_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(by_opencv()[:2000])
    # OpenCV says nothing
    assert cv2.imread(str(path)) is not None
    with pytest.raises(InputError, match=rf"cut\{suffix}: cannot be decoded .*2000 bytes; truncated"):
        read_image(path)


def test_what_overwrites_a_part_is_noticed() -> None:
    whole = by_opencv()
    middle = len(whole) // 2
    assert jpeg_fault(whole[:middle] + b"\xff\x17" + whole[middle + 2 :]) == f"damaged at byte {middle}"
    assert jpeg_fault(b"\xff\xd8\xff\xd9") == "without a picture"


def test_a_tiff_with_a_strip_that_cannot_be_unpacked(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 255, (200, 200, 3)).astype(np.uint8)
    whole = cv2.imencode(".tif", noise)[1].tobytes()
    (tmp_path / "whole.tif").write_bytes(whole)
    assert np.array_equal(read_image(tmp_path / "whole.tif"), noise[..., ::-1])
    (tmp_path / "hole.tif").write_bytes(whole[:30000] + bytes(4096) + whole[34096:])
    assert cv2.imread(str(tmp_path / "hole.tif")) is not None
    with pytest.raises(InputError, match=r"hole\.tif: cannot be decoded .*damaged"):
        read_image(tmp_path / "hole.tif")
