"""The Kannala-Brandt camera that comes nearest to another camera, and how near nerfstudio's rays come in the end.

nerfstudio knows no MEI; its OPENCV_FISHEYE camera, which is `KannalaBrandt`, takes its place. Ten parameters
are free: fx, fy, cx, cy, k1-k4, p1, p2. The distances minimised, and reported, are those in the picture, in
pixels: for a ray of the source, from its pixel to the one where the fitted camera puts it. The rays are those
of a regular grid of pixels, so every part of the picture within the angle asked for counts by its area.

nerfstudio inverts a camera's distortion by ten undamped Newton steps from the distorted point. That ends at the
right ray for nearly every lens, but goes astray at the rim of some whose polynomial bends sharply there:
`host_residual` makes the same steps and tells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.models import Camera, KannalaBrandt, Pinhole

_FIT_GRID = 150
"""Rays along each side of the grid that is fitted; more change nothing within 1e-3 px."""
_CHECK_GRID = 201
"""Rays along each side of the grid over which the residual is reported; odd against the other."""
_HOST_STEPS = 10
"""Newton steps of nerfstudio's radial_and_tangential_undistort."""
_HOST_SMALLEST_DETERMINANT = 1e-3
"""Below it that function makes no step."""


@dataclass(frozen=True)
class CameraFit:
    """A camera in another one's place, and how far its picture lies from the source's."""

    camera: KannalaBrandt | Pinhole
    """The camera; a fitted one is not valid beyond `theta_max_rad`."""
    rms_px: float
    """Root mean square, over the picture's area, of the distance between the two pixels of a ray."""
    max_px: float
    theta_max_rad: float
    """The angle from the axis up to which the cameras were compared: at most what the picture sees."""


def fit_kannala_brandt(source: Camera, theta_max_rad: float = math.radians(95)) -> CameraFit:
    """Fit a Kannala-Brandt camera, every parameter free, to a camera of any model.

    Args:
        source: the camera to be matched; the size of its picture is kept.
        theta_max_rad: the angle from the axis up to which it is to be matched. The source's own limit and, if
            all of it is nearer to the axis, the picture's corner take its place where they are less.

    Raises:
        InputError: the angle is not positive, the picture sees too little within it, or no such camera with
            a rising polynomial comes near.
    """
    limit = min(theta_max_rad, source.theta_max_rad)
    if not limit > 0:
        raise InputError(f"camera fit: theta_max_rad is {theta_max_rad}, expected more than 0.")
    directions, pixels = _rays(source, limit, _FIT_GRID)
    limit = _seen_limit(directions, limit, _FIT_GRID)
    if len(pixels) < 100:
        raise InputError(
            f"camera fit: only {len(pixels)} of {_FIT_GRID**2} pixels sampled in the picture of "
            f"{source.width}x{source.height} see a ray within {math.degrees(limit):.1f}° of the axis. "
            "Check the camera's focal lengths and principal point."
        )
    # the axis and its surroundings give fx, fy, cx, cy to start from; the distortion starts at none
    near = 1e-3 * limit
    axes = torch.tensor(
        [[0.0, 0.0, 1.0], [math.sin(near), 0.0, math.cos(near)], [0.0, math.sin(near), math.cos(near)]],
        dtype=torch.float64,
    )
    (cx, cy), (right, _), (_, below) = source.project(axes)[0].tolist()
    start = np.array([(right - cx) / near, (below - cy) / near, cx, cy, 0, 0, 0, 0, 0, 0])

    rho = np.linalg.norm(directions[:, :2], axis=1)
    factor = np.divide(np.arctan2(rho, directions[:, 2]), rho, out=np.ones_like(rho), where=rho > 0)
    x, y = (factor[:, None] * directions[:, :2]).T
    square = x * x + y * y
    powers = square ** np.arange(1, 5)[:, None]
    tangential_x = np.stack((2 * x * y, square + 2 * x * x))
    tangential_y = np.stack((square + 2 * y * y, 2 * x * y))

    def distorted(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale = 1 + parameters[4:8] @ powers
        return scale * x + parameters[8:] @ tangential_x, scale * y + parameters[8:] @ tangential_y

    def residual(parameters: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy = parameters[:4]
        u, v = distorted(parameters)
        return np.concatenate((fx * u + cx - pixels[:, 0], fy * v + cy - pixels[:, 1]))

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        fx, fy = parameters[:2]
        u, v = distorted(parameters)
        zero, one = np.zeros_like(x), np.ones_like(x)
        of_x = np.stack((u, zero, one, zero, *(fx * x * powers), *(fx * tangential_x)), -1)
        of_y = np.stack((zero, v, zero, one, *(fy * y * powers), *(fy * tangential_y)), -1)
        return np.concatenate((of_x, of_y))

    # scipy's stub knows `jac` only as the name of a finite-difference scheme
    found = least_squares(residual, start, jacobian, method="lm", x_scale="jac", xtol=1e-14, ftol=1e-14)  # pyrefly: ignore
    camera = KannalaBrandt(source.width, source.height, *found.x.tolist(), theta_limit_rad=limit)

    directions, pixels = _rays(source, limit, _CHECK_GRID)
    fitted, valid = camera.project(torch.from_numpy(directions))
    if not valid.all():
        raise InputError(
            f"camera fit: up to {math.degrees(limit):.1f}° no rising Kannala-Brandt polynomial comes near "
            f"the {source.model} camera (the best one folds at {math.degrees(camera.theta_max_rad):.1f}°). "
            "Fit up to a smaller angle."
        )
    distance = np.linalg.norm(fitted.numpy() - pixels, axis=1)
    return CameraFit(camera, float(np.sqrt(np.mean(distance**2))), float(distance.max()), limit)


def host_residual(
    source: Camera, replacement: KannalaBrandt | Pinhole, theta_max_rad: float
) -> tuple[CameraFit, float]:
    """Measure how far off nerfstudio's rays are, made from the parameters of a camera that takes another's place.

    Args:
        source: the camera that took the pictures.
        replacement: what nerfstudio is given: a fit, or the source itself.
        theta_max_rad: the angle from the axis up to which the rays are used. The last thousandth of the source's own
            range, where its picture folds, is left out.

    Returns:
        The distances between each pixel and the one where the source sees nerfstudio's ray of it; infinite where that
        ray goes astray. Second, the smallest angle from the axis of a ray that is off by half a pixel or more;
        infinite if none is.
    """
    limit = min(theta_max_rad, 0.999 * source.theta_max_rad)
    directions, pixels = _rays(source, limit, _CHECK_GRID)
    limit = _seen_limit(directions, limit, _CHECK_GRID)
    wanted = torch.from_numpy(pixels)
    focal = wanted.new_tensor([replacement.fx, replacement.fy])
    principal = wanted.new_tensor([replacement.cx, replacement.cy])
    plane = replacement._distortion.newton((wanted - principal) / focal, _HOST_STEPS, _HOST_SMALLEST_DETERMINANT)
    # nerfstudio clips a fisheye's angle at 180°
    reached = plane.norm(dim=-1) < (math.pi if isinstance(replacement, KannalaBrandt) else math.inf)
    seen, valid = source.project(replacement._from_plane(torch.where(reached[:, None], plane, 0.0)))
    distance = torch.where(reached & valid, (seen - wanted).norm(dim=-1), math.inf).numpy()
    wrong = _theta(directions)[distance >= 0.5]
    fit = CameraFit(replacement, float(np.sqrt(np.mean(distance**2))), float(distance.max()), limit)
    return fit, float(wrong.min()) if len(wrong) else math.inf


def _theta(directions: np.ndarray) -> np.ndarray:
    return np.arctan2(np.linalg.norm(directions[:, :2], axis=1), directions[:, 2])


def _seen_limit(directions: np.ndarray, limit: float, count: int) -> float:
    """The angle asked for, or less where the picture ends before, and with it what can be said of the camera."""
    return float(_theta(directions).max()) if len(directions) == count**2 else limit


def _rays(camera: Camera, limit: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and pixels of a regular grid over the whole picture, borders included, within `limit`."""
    x = torch.linspace(0.0, camera.width, count, dtype=torch.float64)
    y = torch.linspace(0.0, camera.height, count, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    directions, valid = camera.unproject(pixels)
    # NaN compares as false
    kept = valid & (torch.atan2(directions[:, :2].norm(dim=-1), directions[:, 2]) <= limit)
    return directions[kept].numpy(), pixels[kept].numpy()
