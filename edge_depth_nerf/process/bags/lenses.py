"""sensor_msgs/CameraInfo as the keys of a camera in rig.toml.

K and D are of the whole picture; `roi` and `binning` say which part of it is published. ROS names its distortions
plumb_bob (k1 k2 p1 p2 k3), rational_polynomial (and k4 k5 k6, thin prisms, tilt) and equidistant, or fisheye. The
rational one has no place in rig.toml: the closest model that has is fitted to it, with its error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.cameras.transforms import Transform, rigid

WORST_FIT_PX = 0.5
"""A model that is farther from the calibration (rms) is not used."""
_PLUMB_BOB = ("plumb_bob", "", "none", "rational_polynomial", "brown_conrady", "radtan")
_EQUIDISTANT = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4")
_GRID = 25
"""Points along each side at which models are compared."""
_LEAST_INVERTED = 0.9
"""A calibration that gives a smaller share of the pixels a ray does not hold for its pictures."""


@dataclass(frozen=True)
class Lens:
    """A camera's model and numbers, by the keys of rig.toml."""

    keys: dict[str, str | int | float]
    to_frame: Transform
    """From its pictures' frame to the camera's frame: another one if they are rectified."""
    note: str = ""
    """What the user should know."""


def _field(info: Any, name: str) -> NDArray[np.float64]:
    """ROS 1 writes K, ROS 2 k."""
    return np.array(getattr(info, name, None) if hasattr(info, name) else getattr(info, name.upper()), np.float64)


def lens_of(info: Any, width: int, height: int, rectified: bool, shares_frame: bool) -> Lens | str:
    """A lens for pictures of this size, or why there is none.

    `shares_frame`: other cameras have the same frame. Of a stereo pair it is the left one's, by ROS, and the fourth
    column of the right one's P says where that is.
    """
    matrix = _field(info, "k").reshape(3, 3)
    rotation, place = np.eye(3), np.zeros(3)
    distortion = _field(info, "d")
    model = info.distortion_model
    if rectified:
        matrix, column = np.split(_field(info, "p").reshape(3, 4), [3], axis=1)
        given = _field(info, "r").reshape(3, 3)
        rotation = given if np.allclose(given @ given.T, np.eye(3), atol=1e-3) else rotation
        distortion, model = np.zeros(0), ""
    if not (np.isfinite(matrix).all() and matrix[0, 0] > 0 and matrix[1, 1] > 0):
        return "its CameraInfo is not calibrated (fx is 0)"
    scale, notes = np.array([1.0, 1.0]), []
    if rectified and shares_frame and np.any(column[:2]):
        place[:2] = -column[:2, 0] / (matrix[0, 0], matrix[1, 1])
        notes += [
            f"{np.linalg.norm(place):.4g} m from the origin of its frame, by P: another camera has this frame, too"
        ]
    shift = np.array([info.roi.x_offset, info.roi.y_offset], np.float64)
    whole = np.array([info.width, info.height], np.float64)
    part = np.array([info.roi.width, info.roi.height], np.float64) if info.roi.width else whole
    binned = part / np.maximum([info.binning_x, info.binning_y], 1)
    size = np.array([width, height], np.float64)
    if (size == whole).all() and not (binned == size).all():
        shift = np.zeros(2)
    elif (np.floor(binned) == size).all():
        scale = 1 / np.maximum([info.binning_x, info.binning_y], 1).astype(np.float64)
    elif part.all() and abs(size[0] * part[1] / (size[1] * part[0]) - 1) < 0.01:
        scale = size / part
        notes += [f"CameraInfo is of {part[0]:g}×{part[1]:g} px and was scaled to the pictures"]
    elif part.all():
        return f"its CameraInfo is of {part[0]:g}×{part[1]:g} px, its pictures of {width}×{height} px"
    to_frame = rigid(rotation.T, rotation.T @ place)
    keys: dict[str, str | int | float] = {
        "model": "pinhole",
        "width": width,
        "height": height,
        "fx": matrix[0, 0] * scale[0],
        "fy": matrix[1, 1] * scale[1],
        # the first pixel's centre is 0 before and after
        "cx": (matrix[0, 2] - shift[0] + 0.5) * scale[0] - 0.5,
        "cy": (matrix[1, 2] - shift[1] + 0.5) * scale[1] - 0.5,
    }
    if model in _EQUIDISTANT:
        keys["model"] = "kannala-brandt"
        keys |= _named(("k1", "k2", "k3", "k4"), distortion[:4])
        return Lens(keys, to_frame, "; ".join(notes))
    if model not in _PLUMB_BOB:
        return f"its distortion model {model!r} is not known"
    if len(distortion) <= 5 or not np.any(distortion[5:]):
        keys |= _named(("k1", "k2", "p1", "p2", "k3"), distortion[:5])
        return Lens(keys, to_frame, "; ".join(notes))
    fitted, rms_px, name = _fitted(keys, distortion)
    if rms_px > WORST_FIT_PX:
        return f"its distortion {model} has no equal here (the best, {name}, is {rms_px:.2f} px off, rms)"
    notes += [f"fitted to {model}, {rms_px:.3f} px rms"]
    return Lens({**keys, **fitted}, to_frame, "; ".join(notes))


def _named(names: tuple[str, ...], values: NDArray) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=False) if value != 0}


def _fitted(keys: dict[str, Any], distortion: NDArray) -> tuple[dict[str, str | int | float], float, str]:
    """Of the models that rig.toml has, the one closest to a distortion of OpenCV's, and its error over the picture."""
    focal = np.array([keys["fx"], keys["fy"]])
    centre = np.array([keys["cx"], keys["cy"]])
    matrix = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    columns, rows = np.meshgrid(np.linspace(0, keys["width"] - 1, _GRID), np.linspace(0, keys["height"] - 1, _GRID))
    pixels = np.stack((columns.ravel(), rows.ravel()), -1)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-10)
    plane = cv2.undistortPointsIter(pixels[:, None], matrix, distortion, np.eye(3), np.eye(3), criteria)[:, 0]
    again, _ = cv2.projectPoints(
        np.column_stack((plane, np.ones(len(plane)))), np.zeros(3), np.zeros(3), matrix, distortion
    )
    whole = np.linalg.norm(again[:, 0] - pixels, axis=-1) < 0.05
    if whole.mean() < _LEAST_INVERTED:
        return {}, np.inf, "none"
    plane, target = plane[whole], (pixels[whole] - centre) / focal
    x, y = plane.T
    squared = x * x + y * y
    radial = [plane * squared[:, None] ** power for power in (1, 2, 3)]
    tangential = [np.stack((2 * x * y, squared + 2 * y * y), -1), np.stack((squared + 2 * x * x, 2 * x * y), -1)]
    theta = np.arctan(np.sqrt(squared))
    unit = plane / np.maximum(np.sqrt(squared), 1e-12)[:, None]
    candidates = {
        "pinhole": (plane, [*radial, *tangential], ("k1", "k2", "k3", "p1", "p2")),
        "kannala-brandt": (
            unit * theta[:, None],
            [unit * theta[:, None] ** power for power in (3, 5, 7, 9)],
            ("k1", "k2", "k3", "k4"),
        ),
    }
    found = []
    for name, (straight, terms, names) in candidates.items():
        # both models are linear in their coefficients
        weighted = np.stack([(term * focal).ravel() for term in terms], -1)
        wanted = ((target - straight) * focal).ravel()
        solved = np.linalg.lstsq(weighted, wanted, rcond=None)[0]
        rms_px = float(np.sqrt(2 * np.mean((weighted @ solved - wanted) ** 2)))
        found.append(({"model": name, **_named(names, solved)}, rms_px, name))
    return min(found, key=lambda each: each[1])
