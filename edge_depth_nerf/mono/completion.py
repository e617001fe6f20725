"""A rival of the integration: LiDAR completed along the picture's colours, with standard deviations as confidence.

What is carried over the picture is not distance (smoothing it would turn every slanted surface into steps) but mono's
error e = log(d / d̂), known at a return and believed to be 0 elsewhere:

    e  = smooth(Σ c · e) / smooth(Σ c),   d̃ = d̂ · exp(e)

smooth is the fast global smoother of Min et al., Fast Global Image Smoothing Based on Weighted Least Squares (2014),
guided by the picture; c is the inverse variance of what is known of e at a pixel. It is in OpenCV's contrib modules,
as is the fast bilateral solver of Barron and Poole, which would do the same but asks for an OpenCV built with Eigen;
the wheels on PyPI are not.

Only benchmarks use it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from edge_depth_nerf.base.errors import InputError


@dataclass(frozen=True)
class CompletionOptions:
    """How far a return reaches. The defaults measured best of a coarse grid, on drives of the generator."""

    smoothness: float = 100.0
    """Weight of neighbouring pixels' agreement (λ of the fast global smoother)."""
    sigma_colour: float = 3.0
    """Difference in colour, of 255, across which the agreement falls to 1 / e."""
    lidar_sigma_m: float = 0.05
    """Standard deviation of a return, metres; also the least that a monocular value may claim."""
    correlated_pixels: float = 1000.0
    """Mono's errors are smooth: so many pixels that say the same count as one."""


def available() -> bool:
    """Whether this OpenCV has what `complete` needs."""
    return hasattr(cv2, "ximgproc") and hasattr(cv2.ximgproc, "createFastGlobalSmootherFilter")


def complete(
    picture: UInt8[np.ndarray, "h w 3"],
    lidar_m: Float[np.ndarray, "h w"],
    mono_m: Float[np.ndarray, "h w"],
    mono_sigma_m: Float[np.ndarray, "h w"],
    valid: Bool[np.ndarray, "h w"],
    options: CompletionOptions | None = None,
) -> Float[np.ndarray, "h w"]:
    """Correct a monocular map by the returns, along the colours of the picture.

    Args:
        picture: 8 bits, three channels in any order.
        lidar_m: metres along the ray, 0 = no return.
        mono_m: the same for the estimate; what is not finite and positive is none.
        mono_sigma_m: its standard deviation, metres; read where there is an estimate.
        valid: True where the pixel may be used.
        options: how far a return reaches.

    Returns:
        float32 metres along the ray; 0 outside `valid` and where there is no estimate.

    Raises:
        InputError: the maps differ in size, a standard deviation is not a number, or this OpenCV has no contrib
            modules.

    """
    options = options or CompletionOptions()
    if not available():
        raise InputError(
            f"The completion needs OpenCV's contrib modules (cv2.ximgproc), and the OpenCV {cv2.__version__} that is "
            "installed lacks them, as when several of its wheels overwrite each other. Install the one that has them "
            "last: pip install --force-reinstall --no-deps opencv-contrib-python-headless"
        )
    shapes = {"picture": picture.shape[:2], "lidar_m": lidar_m.shape, "mono_m": mono_m.shape}
    shapes |= {"mono_sigma_m": mono_sigma_m.shape, "valid": valid.shape}
    if len(set(shapes.values())) > 1:
        found = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise InputError(f"complete: found {found}; expected one height and width.")
    usable = valid & np.isfinite(mono_m) & (mono_m > 0)
    returns = usable & np.isfinite(lidar_m) & (lidar_m > 0)
    if not np.isfinite(mono_sigma_m[usable]).all():
        raise InputError("complete: mono_sigma_m has values that are not finite where mono_m has a distance.")
    mono = np.where(usable, mono_m, 1).astype(np.float32)
    distance = np.where(returns, lidar_m, mono).astype(np.float32)
    error = np.log(distance / mono)
    sigma_m = np.maximum(np.where(usable, mono_sigma_m, 1), options.lidar_sigma_m)
    sigma_m = np.where(returns, options.lidar_sigma_m, sigma_m * np.sqrt(options.correlated_pixels))
    # relative to a return at 10 m: single precision is all the filter knows
    confidence = np.where(usable, (options.lidar_sigma_m / 10 * distance / sigma_m) ** 2, 0).astype(np.float32)

    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(
        np.ascontiguousarray(picture), options.smoothness, options.sigma_colour
    )
    weight = smoother.filter(confidence)
    exists = usable & (weight > 0)
    smooth_error = np.where(exists, smoother.filter(confidence * error), 0) / np.where(exists, weight, 1)
    return np.where(usable, mono * np.exp(smooth_error), 0).astype(np.float32)
