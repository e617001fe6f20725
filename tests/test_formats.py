"""Recordings as other people's tools write them: pictures, calibrations, times and scans, each with its right value."""

from pathlib import Path

import numpy as np
import pytest
from bad_input import recording
from PIL import Image

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import picture_head, read_image, read_mask, write_png
from edge_depth_nerf.process.options import RigOptions
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.rig import read_rig_recording


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A recording of four pictures of 16×12 pixels."""
    recording(tmp_path)
    return tmp_path


def read(root: Path) -> Recording:
    return read_rig_recording(RigOptions(root=root, output=root / "scene", strict=True))


def edit(root: Path, *changes: tuple[str, str]) -> None:
    content = (root / "rig.toml").read_text()
    for old, new in changes:
        assert old in content, old
        content = content.replace(old, new)
    (root / "rig.toml").write_text(content)


def smooth(height: int = 12, width: int = 16) -> np.ndarray:
    row, column = np.indices((height, width))
    return np.stack((8 * row + 40, 10 * column + 30, 200 - 5 * row - 4 * column), -1).astype(np.uint8)


def with_orientation(path: Path, pixels: np.ndarray, orientation: int) -> Path:
    exif = Image.Exif()
    exif[0x112] = orientation
    best = {".jpg": {"quality": 97, "subsampling": 0}, ".webp": {"lossless": True}}
    Image.fromarray(pixels).save(path, exif=exif.tobytes(), **best.get(path.suffix, {}))
    return path


# ---- times -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("content", "keys"),
    [
        ("\ufeff" + "0.0\r\n0.1\r\n0.2\r\n0.3", ""),
        ("timestamp\n0.0\n0.1\n0.2\n0.3\n", ""),
        ('"image","time"\n' + "".join(f"{number:06d},{number / 10}\n" for number in range(4)), ""),
        # TUM's rgb.txt and EuRoC's data.csv
        ("# timestamp filename\n" + "".join(f"{number / 10} rgb/{number:06d}.png\n" for number in range(4)), ""),
        (
            "#timestamp [ns],filename\r\n" + "".join(f"{number}00000000,{number:06d}.png\r\n" for number in range(4)),
            'time_unit = "ns"\n',
        ),
        # KITTI's timestamps.txt, and ISO's form
        ("".join(f"2011-09-26 13:02:25.{number}00000000\n" for number in range(4)), "time_offset_s = -1317042145\n"),
        ("".join(f"2011-09-26T13:02:25.{number}Z\n" for number in range(4)), "time_offset_s = -1317042145\n"),
    ],
)
def test_times_as_tools_write_them(mine: Path, content: str, keys: str) -> None:
    (mine / "times.txt").write_bytes(content.encode())
    edit(mine, ('times_file = "times.txt"\n', f'times_file = "times.txt"\n{keys}'))
    assert [picture.time_s for picture in read(mine).pictures] == pytest.approx([0, 0.1, 0.2, 0.3], abs=1e-6)


@pytest.mark.parametrize(
    ("content", "keys", "message"),
    [
        (
            "2011-09-26 13:02:25.1\n",
            'time_unit = "ns"\n',
            "line 1: the time is a date, but time_unit is 'ns'.*leave out",
        ),
        ("0.0 a.png\nb.png 0.1\n", "", r"line 2: some lines .* or have it elsewhere \(NAME TIME, after TIME NAME\)"),
        ("0.0 a.png 7\n", "", "line 1: 3 words, expected a time, a file's name and a time"),
        ("0 a/000000.png\n1 b/000000.png\n", "", "has two times for 000000.png, 0.000000 and 1.000000"),
    ],
)
def test_other_times_are_named(mine: Path, content: str, keys: str, message: str) -> None:
    (mine / "times.txt").write_text(content)
    edit(mine, ('times_file = "times.txt"\n', f'times_file = "times.txt"\n{keys}'))
    with pytest.raises(InputError, match=message):
        read(mine)


def test_a_marked_rig_file_and_poses_with_a_heading(mine: Path) -> None:
    (mine / "rig.toml").write_text("\ufeff" + (mine / "rig.toml").read_text().replace("\n", "\r\n"))
    poses = (mine / "poses.txt").read_text()
    (mine / "poses.txt").write_text("\ufefftimestamp tx ty tz qx qy qz qw\n" + poses)
    assert len(read(mine).pictures) == 4
    (mine / "poses.txt").write_text(
        "".join(f"{line} {line}\n" for line in poses.splitlines()[:4]).replace(" 1\n", " 1 1\n")
    )
    with pytest.raises(InputError, match=r"line 1: 17 numbers as EuRoC's ground truth has .*, expected 8"):
        read(mine)


@pytest.mark.parametrize("given", ["left [raw]", "left [raw]/*.png", "left ?[raw]/0*.png"])
def test_a_folder_with_brackets_in_its_name(mine: Path, given: str) -> None:
    (mine / "images").rename(mine / "left [raw]")
    (mine / "left ?[raw]").symlink_to("left [raw]")
    edit(mine, ('images = "images"', f'images = "{given}"'))
    assert len(read(mine).pictures) == 4


# ---- pictures --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_no_orientation_turns_a_picture(tmp_path: Path, suffix: str, orientation: int) -> None:
    path = with_orientation(tmp_path / f"a{suffix}", smooth(), orientation)
    head = picture_head(path)
    assert (head.width, head.height, head.orientation) == (16, 12, orientation)
    assert read_image(path).astype(int) == pytest.approx(smooth().astype(int), abs=12)


def test_pictures_with_an_orientation_are_said(mine: Path) -> None:
    for path in (mine / "images").iterdir():
        with_orientation(path.with_suffix(".jpg"), smooth(), 6)
        path.unlink()
    (notice,) = read(mine).notices
    assert "left: pictures have an EXIF orientation (6 in 4 of them), and are used as their pixels stand" in notice


def test_a_calibration_of_turned_pictures_is_said(mine: Path) -> None:
    for path in (mine / "images").iterdir():
        with_orientation(path, smooth(16, 12), 6)
    with pytest.raises(InputError, match=r"12×16 pixels, but .* 16×12\..*EXIF orientation 6 .* `mogrify -auto-orient`"):
        read(mine)


@pytest.mark.parametrize("kind", ["webp", "avif"])
def test_other_pictures(mine: Path, kind: str) -> None:
    for path in (mine / "images").iterdir():
        Image.fromarray(smooth()).save(path.with_suffix(f".{kind}"), quality=95)
        path.unlink()
    found = read(mine).pictures
    assert [picture.path.name for picture in found] == [f"{number:06d}.{kind}" for number in range(4)]
    assert read_image(found[0].path).astype(int) == pytest.approx(smooth().astype(int), abs=20)
    content = found[0].path.read_bytes()
    for length in (0, 40, len(content) - 5):
        found[0].path.write_bytes(content[:length])
        with pytest.raises(InputError, match=r"000000\..* cannot be decoded as a picture"):
            read_image(found[0].path)


def test_masks_of_other_kinds(mine: Path) -> None:
    mask = np.zeros((12, 16), bool)
    mask[:, 8:] = True
    grey = mask.astype(np.uint8) * 255
    alpha = np.dstack((np.full((12, 16, 3), 255, np.uint8), grey))
    for number, (suffix, pixels) in enumerate(
        ((".jpg", grey), (".png", mask), (".png", alpha), (".png", (grey / 255).astype(np.uint8)))
    ):
        (mine / f"masks/{number:06d}.png").unlink()
        Image.fromarray(pixels).save(mine / f"masks/{number:06d}{suffix}")
    found = [picture.mask for picture in read(mine).pictures]
    assert found[0] is not None and found[0].suffix == ".jpg"
    for path in found:
        assert path is not None and np.array_equal(read_mask(path), mask)


@pytest.mark.parametrize(("bits", "factor"), [(10, 64), (12, 16), (14, 4), (16, None)])
def test_bits_at_the_lower_end(mine: Path, bits: int, factor: int | None) -> None:
    for path in (mine / "images").iterdir():
        write_png(path, smooth().astype(np.uint16) << (bits - 8))
    if factor is None:
        assert np.array_equal(read_image(read(mine).pictures[0].path), smooth())
        return
    with pytest.raises(
        InputError, match=rf": {bits} bits at the lower .* {factor} times too dark.* multiply {factor}`"
    ):
        read(mine)
