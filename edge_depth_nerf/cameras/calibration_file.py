"""Lenses from files: Kalibr's camchain.yaml, Basalt's calibration.json, OCamCalib's text, and tables of a rig file.

All count pixels from the first one's centre; cameras have centres at +0.5. Transforms in these files are not
read: where a sensor is, the rig file says.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from edge_depth_nerf.base.bounds import finite, read_text, shown
from edge_depth_nerf.base.errors import InputError, found_in, require
from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.cameras.models import MEI, Camera, KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.wide import EUCM, DoubleSphere, OCam

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyrefly: ignore[missing-import]

RATIONAL = (
    "k4, k5 and k6 belong to OpenCV's rational model, which has no place here: calibrate again without "
    "CALIB_RATIONAL_MODEL, or undistort the pictures (cv2.undistort) and give them as a pinhole without distortion"
)
"""What to do with a calibration of that model."""
_MAX_BYTES = 1 << 16
_MAX_DOTS = 1000
"""No line of TOML has more: the parser's time and memory grow with the square of a key's parts."""
_MAX_BRACKETS = 500
"""No camchain has more, and PyYAML's time grows with the square of their depth."""
_RADTAN, _EQUIDISTANT = ("k1", "k2", "p1", "p2"), ("k1", "k2", "k3", "k4")
_PINHOLE = ("fx", "fy", "cx", "cy")
_KALIBR: dict[tuple[str, str], tuple[Any, tuple[str, ...], tuple[str, ...]]] = {
    ("pinhole", "none"): (Pinhole, _PINHOLE, ()),
    ("pinhole", "radtan"): (Pinhole, _PINHOLE, _RADTAN),
    ("pinhole", "equidistant"): (KannalaBrandt, _PINHOLE, _EQUIDISTANT),
    ("omni", "none"): (MEI, ("xi", *_PINHOLE), ()),
    ("omni", "radtan"): (MEI, ("xi", *_PINHOLE), _RADTAN),
    ("ds", "none"): (DoubleSphere, ("xi", "alpha", *_PINHOLE), ()),
    ("eucm", "none"): (EUCM, ("alpha", "beta", *_PINHOLE), ()),
}
"""Kalibr's camera and distortion models: ours, and the order of its numbers."""
_BASALT: dict[str, tuple[Any, tuple[str, ...], dict[str, float]]] = {
    "pinhole": (Pinhole, _PINHOLE, {}),
    "kb4": (KannalaBrandt, (*_PINHOLE, *_EQUIDISTANT), {}),
    "ds": (DoubleSphere, (*_PINHOLE, "xi", "alpha"), {}),
    "eucm": (EUCM, (*_PINHOLE, "alpha", "beta"), {}),
    "ucm": (EUCM, (*_PINHOLE, "alpha"), {"beta": 1.0}),
}
MODELS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "mei": (MEI, ("xi", "k1", "k2", "p1", "p2")),
    **dict.fromkeys(("kannala-brandt", "opencv_fisheye", "equidistant"), (KannalaBrandt, _EQUIDISTANT)),
    "pinhole": (Pinhole, ("k1", "k2", "p1", "p2", "k3")),
    **dict.fromkeys(("double-sphere", "ds"), (DoubleSphere, ("xi", "alpha"))),
    "eucm": (EUCM, ("alpha", "beta")),
}
"""Models, and what they have beside focal lengths and principal point; `OF_MODEL` are needed, others 0 if left out."""
OF_MODEL = ("xi", "alpha", "beta")
LENS_NUMBERS = (*OF_MODEL, "k1", "k2", "k3", "k4", "p1", "p2")
LENS = ("model", "width", "height", *_PINHOLE)
"""What describes a lens in a rig file: these, `LENS_NUMBERS` as its model needs, and `LENS_PLACE`."""
LENS_PLACE = ("pixel_centre", "theta_max_deg")
BESIDE_LENS = (
    *("calibration", "to_vehicle", "images", "ego_mask", "masks", "mono", "truth_distance", "truth_rgb", "depth"),
    *("times_file", "times_from_names", "rate_hz", "time_unit", "time_offset_s"),
)
"""What else a rig file says of a camera."""
_OCAM_COEFFICIENTS = range(1, 8)
_OF_SCALE = (1e-2, 1e6)


def read_lens(path: Path, name: str = "") -> Camera:
    """Read a lens from a calibration file, whose kind its suffix tells: .yaml, .json, .txt, or .toml.

    Args:
        path: the file.
        name: which of its cameras; may be left out where there is one.

    Returns:
        The camera, pixel centres at +0.5.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: another kind of file, broken, without that camera, or with a model that is not known.
    """
    readers = {".yaml": _kalibr, ".yml": _kalibr, ".json": _basalt, ".txt": _ocam, ".toml": _table}
    if path.suffix.lower() not in readers:
        raise InputError(
            f"{path}: expected Kalibr's camchain (.yaml), Basalt's calibration (.json), OCamCalib's calib_results "
            "(.txt) or a rig file (.toml, docs/rig.md), which takes the numbers of any other tool."
        )
    return readers[path.suffix.lower()](path, name)


def _kalibr(path: Path, name: str) -> Camera:
    text = read_text(path, _MAX_BYTES)
    try:
        if text.count("[") + text.count("{") > _MAX_BRACKETS:
            raise ValueError(f"more than {_MAX_BRACKETS} brackets")
        content = yaml.safe_load(text)
    except Exception as error:  # PyYAML raises whatever its constructors meet
        said = " ".join(str(error).split())
        raise InputError(f"{path}: not valid YAML ({said}). Expected Kalibr's camchain.yaml.") from None
    cameras = content if isinstance(content, dict) else {}
    found = {str(key): one for key, one in cameras.items() if isinstance(one, dict) and "camera_model" in one}
    where, camera = _chosen(path, found, name, "Kalibr's camchain.yaml")
    distortion = str(camera.get("distortion_model", "none"))
    kind = (str(camera["camera_model"]), distortion)
    if kind not in _KALIBR:
        known = ", ".join("-".join(one) for one in _KALIBR)
        raise InputError(f"{where}: the model {shown('-'.join(kind))} is not known; expected one of {known}.")
    model, order, of_distortion = _KALIBR[kind]
    given = _numbers(camera.get("intrinsics"), order, f"{where}.intrinsics")
    given |= _numbers(camera.get("distortion_coeffs", []), of_distortion, f"{where}.distortion_coeffs")
    return _camera(model, given, camera.get("resolution"), where)


def _basalt(path: Path, name: str) -> Camera:
    content = read_json(path)
    whole = content.get("value0") if isinstance(content, dict) else None
    cameras = whole.get("intrinsics") if isinstance(whole, dict) else None
    sizes = whole.get("resolution") if isinstance(whole, dict) else None
    if not (isinstance(cameras, list) and isinstance(sizes, list) and len(cameras) == len(sizes)):
        raise InputError(
            f"{path}: expected Basalt's calibration.json: value0 with intrinsics and resolution, a list each."
        )
    named = {
        f"cam{number}": {"of": one, "size": size} for number, (one, size) in enumerate(zip(cameras, sizes, strict=True))
    }
    where, camera = _chosen(path, named, name, "Basalt's calibration.json")
    of = camera["of"] if isinstance(camera["of"], dict) else {}
    kind, values = str(of.get("camera_type")), of.get("intrinsics")
    if kind not in _BASALT or not isinstance(values, dict):
        remedy = f" {RATIONAL[0].upper()}{RATIONAL[1:]}." if kind == "pinhole-radtan8" else ""
        raise InputError(
            f"{where}: the model {shown(kind)} is not known; expected one of {', '.join(_BASALT)}.{remedy}"
        )
    model, order, further = _BASALT[kind]
    given = _numbers([values.get(key) for key in order], order, f"{where}.intrinsics")
    return _camera(model, {**given, **further}, camera["size"], where)


def _ocam(path: Path, name: str) -> Camera:
    """OCamCalib's calib_results.txt; its first axis is down, its second right, and its third looks backwards."""
    lines = [line.split() for line in read_text(path, _MAX_BYTES).splitlines()]
    try:
        numbers = [[float(word) for word in line] for line in lines if line and line[0][0] != "#"]
        (count, *coefficients), _, (row, column), (c, d, e), (height, width) = numbers
        if count != len(coefficients) or not all(math.isfinite(one) for line in numbers for one in line):
            raise ValueError
    except ValueError:
        raise InputError(
            f"{path}: expected OCamCalib's calib_results.txt: the polynomial and its inverse with their numbers of "
            "coefficients, centre (row, column), affine parameters c, d, e, and size (height, width)."
        ) from None
    if name or count not in _OCAM_COEFFICIENTS or not _OF_SCALE[0] < abs(coefficients[0]) < _OF_SCALE[1] or c <= 0:
        raise InputError(
            f"{path}: {count:g} coefficients, the first {coefficients[0] if count else 'missing'}, c = {c}; expected 1 "
            f"to {_OCAM_COEFFICIENTS[-1]}, the first a focal length in pixels, c above 0, and no name: the "
            "file has one camera."
        )
    scale = abs(coefficients[0])
    given = {"fx": scale, "fy": c * scale, "cx": column, "cy": row, "shear_x": e, "shear_y": d / c}
    for power, coefficient in enumerate(coefficients[1:], start=1):
        given[f"b{power}"] = coefficient * scale**power / coefficients[0]
    return _camera(OCam, given, [width, height], str(path))


def parse_toml(text: str) -> dict[str, Any]:
    """Read TOML; raises ValueError or RecursionError."""
    if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
        raise ValueError(f"a line with more than {_MAX_DOTS} dots")
    return tomllib.loads(text)


def _table(path: Path, name: str) -> Camera:
    """The keys of a lens in a rig file's table, or alone."""
    try:
        content = parse_toml(read_text(path, _MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML ({error}). docs/rig.md has an example.") from None
    tables = content.get("cameras", {"camera": content})
    found = {key: one for key, one in tables.items() if isinstance(one, dict)} if isinstance(tables, dict) else {}
    where, lens = _chosen(path, found, name, "the keys of a lens, or tables [cameras.NAME]")
    if lens.get("model") not in [*MODELS]:
        raise InputError(f"{where}: model is {shown(lens.get('model'))}, expected one of {', '.join(MODELS)}.")
    if unknown := [key for key in lens if key not in (*LENS, *LENS_NUMBERS, *LENS_PLACE, *BESIDE_LENS)]:
        hint = f" {RATIONAL}." if unknown[0] in ("k5", "k6") else ""
        raise InputError(f"{where}: {unknown[0]}: unknown key; docs/rig.md has those of a camera.{hint}")
    keys = (*LENS[1:], *(key for key in (*LENS_NUMBERS, *LENS_PLACE) if key in lens))
    given: dict[str, Any] = _numbers([lens.get(key) for key in keys], keys, where)
    if any(given[side] % 1 for side in ("width", "height")):
        raise InputError(f"{where}: width and height are {lens['width']} and {lens['height']}, expected whole numbers.")
    sides = {side: int(given[side]) for side in ("width", "height")}
    limit_deg = given.get("theta_max_deg", 180.0)
    require(limit_deg > 0, f"{where}: theta_max_deg {limit_deg:g}", "more than 0")
    with found_in(where):
        camera = lens_of({**given, **sides, "model": lens["model"]})
    return replace(camera, theta_limit_rad=min(math.radians(limit_deg), math.pi))


def lens_of(given: Mapping[str, Any]) -> Camera:
    """Make the lens that the keys of a rig file describe, pixel centres at +0.5.

    Args:
        given: all of `LENS`, and those of `LENS_NUMBERS` and "pixel_centre" that the file has.

    Raises:
        InputError: a value is out of its range, or the model has other keys.
    """
    for key, side in (("cx", "width"), ("cy", "height")):
        if not 0 < given[key] < given[side]:
            raise InputError(f".{key} is {given[key]}, expected a pixel within the picture, 0 to {given[side]}.")
    centre = given.get("pixel_centre", 0)
    if centre not in (0, 0.5, 1):
        raise InputError(f".pixel_centre is {centre}, expected one of 0, 0.5, 1.")
    model, own = MODELS[given["model"]]
    if wrong := given.keys() & {*LENS_NUMBERS} - {*own}:
        hint = f" {RATIONAL}." if "k4" in wrong and model is Pinhole else ""
        raise InputError(f".{min(wrong)}: unknown key; a camera of model {given['model']} has {', '.join(own)}.{hint}")
    if lacking := [key for key in own if key in OF_MODEL and key not in given]:
        raise InputError(f".{lacking[0]} is missing; expected a number.")
    middle = {key: given[key] + 0.5 - centre for key in ("cx", "cy")}
    kept = {key: given[key] for key in ("width", "height", "fx", "fy")}
    with found_in(".model"):
        return model(**kept, **middle, **{key: given.get(key, 0.0) for key in own})


def _chosen(path: Path, cameras: dict[str, dict[str, Any]], name: str, kind: str) -> tuple[str, dict[str, Any]]:
    """The camera of that name, or the only one, with where it stands."""
    if not cameras:
        raise InputError(f"{path}: has no camera; expected {kind}.")
    if not name and len(cameras) == 1:
        name = next(iter(cameras))
    if name not in cameras:
        asked = f"no camera {name!r}" if name else f"{len(cameras)} cameras"
        raise InputError(
            f"{path}: {asked}; it has {', '.join(cameras)}. Name one: --camera {next(iter(cameras))}, or in a rig "
            f"file calibration = {{file = {path.name!r}, camera = {next(iter(cameras))!r}}}."
        )
    return f"{path}: {name}", cameras[name]


def _numbers(values: Any, names: tuple[str, ...], where: str) -> dict[str, float]:
    found = [finite(value) for value in values] if isinstance(values, list) else []
    given = {name: value for name, value in zip(names, found, strict=False) if value is not None}
    # zeros say that there is no distortion
    if len(given) != len(names) or (len(found) != len(names) and (names or any(found))):
        raise InputError(f"{where} is {shown(values)}, expected {len(names)} numbers: {', '.join(names)}.")
    return given


def _camera(model: Any, given: dict[str, float], size: Any, where: str) -> Camera:
    sides = _numbers(size, ("width", "height"), f"{where}: resolution")
    if any(side % 1 for side in sides.values()):
        raise InputError(f"{where}: resolution is {shown(size)}, expected whole numbers of pixels.")
    # what has no distortion has none of its numbers
    none = {key: 0.0 for key in ("k1", "k2", "p1", "p2") if model is MEI}
    centred = {**none, **given, "cx": given["cx"] + 0.5, "cy": given["cy"] + 0.5}
    with found_in(where):
        return model(width=int(sides["width"]), height=int(sides["height"]), **centred)
