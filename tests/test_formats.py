"""Recordings as other people's tools write them: pictures, calibrations, times and scans, each with its right value."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bad_input import recording
from PIL import Image

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import picture_head, read_image, read_mask, write_png
from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole, fit_kannala_brandt
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
    best: dict[str, dict[str, Any]] = {".jpg": {"quality": 97, "subsampling": 0}, ".webp": {"lossless": True}}
    Image.fromarray(pixels).save(path, exif=exif.tobytes(), **best.get(path.suffix, {}))
    return path


def test_the_head_of_a_png_decodes_no_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    turned = with_orientation(tmp_path / "turned.png", smooth(), 6)
    plain = tmp_path / "plain.png"
    Image.fromarray(smooth()).save(plain)
    content = turned.read_bytes()
    begin = content.index(b"eXIf") - 4
    chunk = content[begin : begin + 12 + int.from_bytes(content[begin : begin + 4], "big")]
    behind = tmp_path / "behind.png"
    behind.write_bytes(content.replace(chunk, b"")[:-12] + chunk + content[-12:])
    assert picture_head(behind).orientation == 6
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda _: pytest.fail("decoded"))
    assert [picture_head(path).orientation for path in (plain, turned)] == [1, 6]


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


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
@pytest.mark.parametrize("orientation", [1, 6])
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
    assert "left: pictures have an EXIF orientation (6 in 4 of them), which turns none of them here" in notice


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


@pytest.mark.parametrize(("bits", "factor"), [(10, 64), (14, 4), (16, None)])
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


OF_SIZE = "width = 16\nheight = 12\nfx = 6.5\nfy = 6.5\ncx = 8.0\ncy = 6.0\nk1 = -0.01\n"
LENS = f'model = "kannala-brandt"\n{OF_SIZE}'
CAMCHAIN = """cam0:
  cam_overlaps: [1]
  camera_model: {model}
  distortion_coeffs: {coefficients}
  distortion_model: {distortion}
  intrinsics: {intrinsics}
  resolution: [16, 12]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: -0.02
  T_cam_imu:
  - [0.0, -1.0, 0.0, 0.1]
  - [1.0, 0.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
"""


def calibrated(file: str, camera: str | None = None) -> str:
    return f'calibration = {{file = "{file}"' + (f', camera = "{camera}"}}\n' if camera else "}\n")


def lens_of(root: Path, lens: str) -> Camera:
    edit(root, (LENS, lens))
    (camera,) = read(root).cameras
    return camera.camera


def rays_beyond_the_front() -> np.ndarray:
    theta, phi = np.radians(np.linspace(1, 100, 34))[:, None], np.linspace(0, 6.2, 17)
    return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi), -1)


def double_sphere(rays: np.ndarray, fx: float, fy: float, cx: float, cy: float, xi: float, alpha: float) -> np.ndarray:
    """As the paper writes it (Usenko et al., eq. 40-42)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    d1 = np.sqrt(x**2 + y**2 + z**2)
    d2 = np.sqrt(x**2 + y**2 + (xi * d1 + z) ** 2)
    below = alpha * d2 + (1 - alpha) * (xi * d1 + z)
    return np.stack((fx * x / below + cx, fy * y / below + cy), -1)


def extended_unified(
    rays: np.ndarray, fx: float, fy: float, cx: float, cy: float, alpha: float, beta: float
) -> np.ndarray:
    """As the paper writes it (Khomutenko et al., eq. 4)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    below = alpha * np.sqrt(beta * (x**2 + y**2) + z**2) + (1 - alpha) * z
    return np.stack((fx * x / below + cx, fy * y / below + cy), -1)


SPHERE = {"fx": 3.5, "fy": 3.25, "cx": 8.0, "cy": 6.0, "xi": -0.18, "alpha": 0.59}
UNIFIED = {"fx": 3.5, "fy": 3.25, "cx": 8.0, "cy": 6.0, "alpha": 0.6, "beta": 1.1}
OF_SPHERE, OF_UNIFIED = [-0.18, 0.59, 3.5, 3.25, 8.0, 6.0], [0.6, 1.1, 3.5, 3.25, 8.0, 6.0]
"""As Kalibr orders them."""


def basalt(kind: str, numbers: dict[str, float]) -> str:
    lens = {"camera_type": kind, "intrinsics": numbers}
    return json.dumps({"value0": {"T_imu_cam": [{}], "intrinsics": [lens], "resolution": [[16, 12]]}})


def toml(model: str, numbers: dict[str, float]) -> str:
    keys = "".join(f"{key} = {value}\n" for key, value in numbers.items())
    return f'model = "{model}"\nwidth = 16\nheight = 12\n{keys}'


def camchain(model: str, distortion: str, intrinsics: list[float], coefficients: list[float]) -> str:
    return CAMCHAIN.format(model=model, distortion=distortion, intrinsics=intrinsics, coefficients=coefficients)


@pytest.mark.parametrize(
    ("lens", "file", "content", "formula", "numbers"),
    [
        (toml("double-sphere", SPHERE), None, "", double_sphere, SPHERE),
        (toml("eucm", UNIFIED), None, "", extended_unified, UNIFIED),
        ("", "camchain.yaml", camchain("ds", "none", OF_SPHERE, []), double_sphere, SPHERE),
        ("", "camchain.yaml", camchain("eucm", "none", OF_UNIFIED, []), extended_unified, UNIFIED),
        ("", "calibration.json", basalt("ds", SPHERE), double_sphere, SPHERE),
        ("", "calibration.json", basalt("eucm", UNIFIED), extended_unified, UNIFIED),
    ],
)
def test_rays_of_spheres_are_those_of_the_papers(
    mine: Path, lens: str, file: str, content: str, formula, numbers
) -> None:
    if file:
        (mine / file).write_text(content)
        lens = calibrated(file)
    camera = lens_of(mine, lens)
    wanted = rays_beyond_the_front()
    pixels, seen = camera.project(torch.from_numpy(wanted))
    assert seen.all() and pixels.numpy() - 0.5 == pytest.approx(formula(wanted, **numbers), abs=1e-9)
    found, valid = camera.unproject(pixels)
    assert valid.all() and found.numpy() == pytest.approx(wanted, abs=1e-6)


def test_coefficients_without_their_model_are_not_passed_over(mine: Path) -> None:
    text = camchain("pinhole", "none", OPENCV, EQUIDISTANT)
    (mine / "camchain.yaml").write_text(text.replace("  distortion_model: none\n", ""))
    with pytest.raises(InputError, match=r"cam0\.distortion_coeffs is \[-0\.01.*expected 0 numbers"):
        lens_of(mine, calibrated("camchain.yaml"))
    # zeros say that there is none
    edit(mine, (calibrated("camchain.yaml"), LENS))
    (mine / "camchain.yaml").write_text(camchain("pinhole", "none", OPENCV, [0.0] * 4))
    assert isinstance(lens_of(mine, calibrated("camchain.yaml")), Pinhole)


def test_a_lens_keeps_its_limit_in_a_rig_file(mine: Path) -> None:
    (mine / "lens.toml").write_text(f"{LENS}theta_max_deg = 60\n")
    assert lens_of(mine, calibrated("lens.toml")).theta_limit_rad == pytest.approx(np.radians(60))


OPENCV, CENTRED = [6.5, 6.25, 8.0, 6.0], (6.5, 6.25, 8.5, 6.5)
RADTAN, EQUIDISTANT = [-0.1, 0.01, 1e-3, 2e-3], [-0.01, 0.02, 0.0, 0.0]


@pytest.mark.parametrize(
    ("model", "distortion", "intrinsics", "coefficients", "expected"),
    [
        ("pinhole", "radtan", OPENCV, RADTAN, Pinhole(16, 12, *CENTRED, *RADTAN)),
        ("pinhole", "equidistant", OPENCV, EQUIDISTANT, KannalaBrandt(16, 12, *CENTRED, *EQUIDISTANT)),
        ("omni", "radtan", [1.2, *OPENCV], RADTAN, MEI(16, 12, *CENTRED, 1.2, *RADTAN)),
    ],
)
def test_a_camchain_gives_the_lens(mine: Path, model, distortion, intrinsics, coefficients, expected) -> None:
    content = camchain(model, distortion, intrinsics, coefficients)
    second = content.replace("cam0:", "cam1:").replace("6.25", "5.25")
    (mine / "camchain.yaml").write_text(content + second)
    assert lens_of(mine, 'calibration = {file = "camchain.yaml", camera = "cam0"}\n') == expected


@pytest.mark.parametrize("name", ["opencv_fisheye", "equidistant"])
def test_other_names_of_kannala_brandt(mine: Path, name: str) -> None:
    assert lens_of(mine, f'model = "{name}"\n{OF_SIZE}') == KannalaBrandt(
        16, 12, 6.5, 6.5, 8.5, 6.5, -0.01, 0.0, 0.0, 0.0
    )


def ocam_rays(pixels: np.ndarray, polynomial: list[float], centre: tuple, affine: tuple) -> np.ndarray:
    """cam2world of OCamCalib's C code; pixels are (row, column) from 0; turned to x right, y down, z forward."""
    (c, d, e), (xc, yc) = affine, centre
    row, column = pixels[..., 0] - xc, pixels[..., 1] - yc
    xp, yp = (row - d * column) / (c - d * e), (-e * row + c * column) / (c - d * e)
    zp = sum(value * np.hypot(xp, yp) ** power for power, value in enumerate(polynomial))
    rays = np.stack((yp, xp, -zp), -1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def test_rays_of_ocamcalib_are_those_of_its_own_code(mine: Path) -> None:
    polynomial, centre, affine = [-3.2, 0.0, 0.045, -2e-4, 3e-5], (5.6, 7.7), (0.999, 2e-3, -1e-3)
    (mine / "calib_results.txt").write_text(
        "#polynomial coefficients for the DIRECT mapping function\n\n"
        f"5 {' '.join(map(str, polynomial))}\n\n#inverse mapping function\n\n3 1.0 2.0 3.0\n\n"
        f'#center: "row" and "column"\n\n{centre[0]} {centre[1]}\n\n#affine parameters "c", "d", "e"\n\n'
        f'{" ".join(map(str, affine))}\n\n#image size: "height" and "width"\n\n12 16\n'
    )
    camera = lens_of(mine, 'calibration = {file = "calib_results.txt"}\n')
    rows, columns = np.meshgrid(np.arange(12.0), np.arange(16.0), indexing="ij")
    expected = ocam_rays(np.stack((rows, columns), -1), polynomial, centre, affine)
    found, valid = camera.unproject(camera.pixel_centres())
    assert valid.all() and found.numpy() == pytest.approx(expected, abs=1e-6)
    pixels, seen = camera.project(torch.from_numpy(expected))
    assert seen.all() and pixels.numpy() == pytest.approx(camera.pixel_centres().numpy(), abs=1e-6)
    # what nerfstudio is given is a fit, and its error is known
    fit = fit_kannala_brandt(camera, math.radians(95))
    assert fit.rms_px < 0.05


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        (f'model = "pinhole"\n{OF_SIZE}k5 = 0.1\n', r"left\.k5: unknown key.*CALIB_RATIONAL_MODEL, or undistort"),
        (f'model = "pinhole"\n{OF_SIZE}k4 = 0.1\n', r"k4: unknown key; a camera of model pinhole.*cv2\.undistort"),
        (f'model = "rational"\n{OF_SIZE}', r"cameras\.left\.model is 'rational': k4, k5 and k6 belong to .* calibrate"),
        (f'model = "ds"\n{OF_SIZE}xi = 0.1\n', r"cameras\.left\.k1: unknown key; a camera of model ds has xi, alpha"),
        (f'model = "eucm"\n{OF_SIZE}alpha = 0.5\n'.replace("k1 = -0.01\n", ""), r"cameras\.left\.beta is missing"),
        (calibrated("two.yaml"), r"left\.calibration: .*two\.yaml: 2 cameras; it has cam0, cam1\. Name one"),
        (calibrated("two.yaml", "cam2"), r"two\.yaml: no camera 'cam2'; it has cam0, cam1"),
        (calibrated("two.yaml", "cam1"), r"cam1: the model 'pinhole-fov' is not known; expected"),
        (calibrated("two.yaml", "cam0") + "fx = 3.0\n", r"left\.fx: the calibration file describes the"),
        (calibrated("lens.ini"), r"lens\.ini: expected Kalibr's camchain \(\.yaml\), Basalt's .*OCamCalib"),
        ('calibration = {file = "times.txt"}\n', r"times\.txt: expected OCamCalib's calib_results\.txt"),
        ('calibration = {file = "none.yaml"}\n', r"none\.yaml: no such file"),
        ('calibration = {file = "opencv.yaml"}\n', r"opencv\.yaml: (not valid YAML|has no camera; expected Kalibr's)"),
    ],
)
def test_other_lenses_are_named(mine: Path, lens: str, message: str) -> None:
    content = camchain("pinhole", "fov", OPENCV, [0.9])
    (mine / "two.yaml").write_text(content + content.replace("cam0:", "cam1:"))
    (mine / "opencv.yaml").write_text("%YAML:1.0\n---\nmodel_type: MEI\n")
    edit(mine, (LENS, lens))
    with pytest.raises((InputError, FileNotFoundError), match=message):
        read(mine)
