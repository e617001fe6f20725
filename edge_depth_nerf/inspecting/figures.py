"""The figures of a scene: its path, its timing, and the content of its maps.

The path is exact, from all poses. The maps are measured on at most `MEASURED_PICTURES` pictures, spread evenly over the
drive, so a long drive takes no longer than a short one. A few thousand values of each picture are kept for medians.
Shares are 0 to 1. A figure is None if the scene lacks what it needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, SupportsFloat

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.base.pictures import is_distance
from edge_depth_nerf.inspecting.shown_prior import ShownMaps
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

MEASURED_PICTURES = 64
"""The maps of this many pictures are measured, or of more if more are shown."""
KEPT_VALUES = 5000
"""This many values of a map are kept for medians over the drive."""
STANDING_M = 0.05
"""Shorter steps are the jitter of a standing vehicle. The usual spacing is computed from the others."""
COVERAGES = ("lidar_coverage", "mono_coverage", "motion_coverage", "prior_share")
"""Shares of the usable pixels."""


@dataclass(frozen=True)
class PictureFigures:
    """Figures of one picture's maps, and some of their values."""

    picture: ScenePicture
    used_share: float
    """Share of the picture that is inside the lens and the mask."""
    hidden_share: float
    """Share of the lens that the mask hides."""
    brightness: float
    """Mean grey inside the mask, 0 to 255."""
    lidar_coverage: float | None
    """Share of the usable pixels with a LiDAR point."""
    mono_coverage: float | None
    """Share of the usable pixels with a monocular distance."""
    motion_coverage: float | None
    """Share of the usable pixels with a distance from motion."""
    prior_share: float | None
    """Share of the usable pixels with a prior. The others show sky, or are out of reach of all sources."""
    lidar_m: NDArray[np.float32]
    prior_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]
    mono_over_lidar: NDArray[np.float32]
    """Monocular distance over LiDAR's, at some of the pixels that have both."""
    prior_over_truth: NDArray[np.float32]
    """The prior's distance over the true one, at some of the pixels that have both."""

    def to_dict(self) -> dict[str, Any]:
        """Return the picture's figures as JSON."""
        return {
            "file_path": self.picture.name,
            "camera": self.picture.camera,
            "frame": self.picture.frame,
            **{name: _rounded(getattr(self, name)) for name in ("used_share", "brightness", *COVERAGES)},
            "mono_over_lidar_median": _median(self.mono_over_lidar),
        }


def measure(picture: ScenePicture, maps: ShownMaps) -> PictureFigures:
    """Measure one picture."""
    usable = maps.usable
    count = max(int(usable.sum()), 1)

    def at(*distances_m: NDArray[np.float32] | None) -> NDArray[np.bool_]:
        """Usable pixels where all these maps have a value."""
        found = usable
        for distance_m in distances_m:
            found = found & is_distance(distance_m) if distance_m is not None else np.zeros_like(usable)
        return found

    def kept(values: NDArray[np.float32] | None, where: NDArray[np.bool_]) -> NDArray[np.float32]:
        if values is None:
            return np.empty(0, np.float32)
        chosen = values[where]
        return chosen[:: -(-len(chosen) // KEPT_VALUES) or 1]

    def ratio(above: NDArray[np.float32] | None, below: NDArray[np.float32] | None) -> NDArray[np.float32]:
        where = at(above, below)
        return kept(above, where) / kept(below, where)

    def share(distance_m: NDArray[np.float32] | None) -> float | None:
        return None if distance_m is None else float(at(distance_m).sum() / count)

    prior_m, sigma_m = (maps.prior.distance_m, maps.prior.sigma_m) if maps.prior else (None, None)
    grey = cv2.cvtColor(maps.rgb, cv2.COLOR_RGB2GRAY)
    return PictureFigures(
        picture=picture,
        used_share=float(usable.mean()),
        hidden_share=1 - int(usable.sum()) / max(int(maps.lens.sum()), 1),
        brightness=float(grey[usable].mean()) if usable.any() else 0.0,
        lidar_coverage=share(maps.lidar_m),
        mono_coverage=share(maps.mono_m),
        motion_coverage=share(maps.distances_m.get("motion")),
        prior_share=share(prior_m),
        lidar_m=kept(maps.lidar_m, at(maps.lidar_m)),
        prior_m=kept(prior_m, at(prior_m)),
        sigma_m=kept(sigma_m, at(prior_m)),
        mono_over_lidar=ratio(maps.mono_m, maps.lidar_m),
        prior_over_truth=ratio(prior_m, maps.truth_m),
    )


def measured_frames(scene: SceneFolder, shown: int) -> tuple[list[int], list[int]]:
    """Choose the frames to measure, and those of them to show. Both are spread evenly over the drive."""
    frames = scene.frames()
    wanted = max(MEASURED_PICTURES // len(scene.cameras()), shown, 1)
    measured = [frames[index] for index in spread_over(len(frames), wanted)]
    parts = min(shown, len(measured))
    return measured, [measured[(2 * part + 1) * len(measured) // (2 * parts)] for part in range(parts)]


@dataclass(frozen=True)
class Step:
    """The step from one picture of a camera to its next."""

    before: ScenePicture
    after: ScenePicture
    length_m: float
    turn_deg: float
    seconds: float | None
    """Time between the two pictures, if both have a timestamp."""


def steps(pictures: Sequence[ScenePicture]) -> list[Step]:
    """List the steps of one camera; `pictures` are in order of their frames."""
    found = []
    for before, after in pairwise(pictures):
        cosine = (np.trace(before.rotation.T @ after.rotation) - 1) / 2
        timed = before.timestamp_s is not None and after.timestamp_s is not None
        found.append(
            Step(
                before,
                after,
                length_m=float(np.linalg.norm(after.position_m - before.position_m)),
                turn_deg=math.degrees(math.acos(np.clip(cosine, -1, 1))),
                seconds=after.timestamp_s - before.timestamp_s if timed else None,  # pyrefly: ignore
            )
        )
    return found


def usual_length_m(found: Sequence[Step], own: bool) -> float:
    """Return the median length of the steps in which the vehicle moved; 0 if there are none."""
    least_m = STANDING_M if own else 0.0
    moved = [step.length_m for step in found if step.length_m > least_m]
    return float(np.median(moved)) if moved else 0.0


def reference_camera(scene: SceneFolder) -> str:
    """Return the camera whose path represents the vehicle's: the one with the most pictures."""
    cameras = scene.cameras()
    return max(cameras, key=lambda name: len(cameras[name]))


def path_figures(scene: SceneFolder) -> dict[str, Any]:
    """Return length, spacing, duration and speed of the drive as JSON."""
    name = reference_camera(scene)
    pictures = scene.cameras()[name]
    found = steps(pictures)
    length_m = math.fsum(step.length_m for step in found)
    times = [picture.timestamp_s for picture in pictures]
    duration_s = times[-1] - times[0] if times[0] is not None and times[-1] is not None else None
    speeds = [step.length_m / step.seconds for step in found if step.seconds is not None and step.seconds > 0]
    return {
        "camera": name,
        "length_m": _rounded(length_m),
        "spacing_median_m": _rounded(usual_length_m(found, scene.own)),
        "spacing_max_m": _rounded(max((step.length_m for step in found), default=0.0)),
        "duration_s": _rounded(duration_s),
        "speed_mean_mps": _rounded(length_m / duration_s) if duration_s and duration_s > 0 else None,
        "speed_max_mps": _rounded(max(speeds)) if speeds else None,
    }


def map_figures(measured: Sequence[PictureFigures]) -> dict[str, Any]:
    """Return the figures of several pictures together as JSON."""

    def spread(name: str) -> dict[str, Any] | None:
        known = [value for figures in measured if (value := getattr(figures, name)) is not None]
        if not known:
            return None
        return {"mean": _rounded(np.mean(known)), "min": _rounded(min(known)), "max": _rounded(max(known))}

    def pooled(name: str) -> NDArray[np.float32]:
        # a slow camera may have no picture among them
        return np.concatenate([np.empty(0, np.float32), *(getattr(figures, name) for figures in measured)])

    def quantiles(values: NDArray[np.float32]) -> dict[str, Any] | None:
        if not len(values):
            return None
        low, median, high = (_rounded(value) for value in np.quantile(values, (0.05, 0.5, 0.95)))
        return {"p5": low, "median": median, "p95": high}

    def abs_rel(ratios: NDArray[np.float32]) -> float | None:
        return _rounded(np.abs(ratios - 1).mean()) if len(ratios) else None

    mono_over_lidar, prior_over_truth = pooled("mono_over_lidar"), pooled("prior_over_truth")
    prior = spread("prior_share")
    return {
        "measured_pictures": len(measured),
        "used_share": spread("used_share"),
        "hidden_share_of_lens": spread("hidden_share"),
        **{name: spread(name) for name in COVERAGES},
        "no_prior_share": _rounded(1 - prior["mean"]) if prior else None,
        "lidar_distance_m": quantiles(pooled("lidar_m")),
        "prior_distance_m": quantiles(pooled("prior_m")),
        "sigma_median_m": _median(pooled("sigma_m")),
        "mono_over_lidar_median": _median(mono_over_lidar),
        "mono_against_lidar_abs_rel": abs_rel(mono_over_lidar),
        "prior_over_truth_median": _median(prior_over_truth),
        "prior_against_truth_abs_rel": abs_rel(prior_over_truth),
    }


def camera_figures(scene: SceneFolder, name: str, measured: Sequence[PictureFigures]) -> dict[str, Any]:
    """Return the figures of one camera as JSON: its lens, its fit, its maps."""
    pictures = scene.cameras()[name]
    lens = pictures[0].lens
    fit = scene.recorded("camera_fits", name)
    original = scene.recorded("original_cameras", name)
    limits_deg = [math.degrees(lens.theta_max_rad), math.degrees(scene.theta_max_rad), fit.get("theta_max_deg", 180.0)]
    return {
        "pictures": len(pictures),
        "held_out": sum(picture.held_out for picture in pictures),
        "model": lens.model,
        "original_model": original.get("model"),
        "one_lens": all(picture.lens == lens for picture in pictures),
        "size_px": [lens.width, lens.height],
        "angle_limit_deg": _rounded(min(limits_deg)),
        "fit_rms_px": fit.get("rms_px"),
        "fit_max_px": fit.get("max_px"),
        **map_figures([figures for figures in measured if figures.picture.camera == name]),
    }


def _rounded(value: SupportsFloat | None) -> float | None:
    """Keep six digits; further ones differ between machines."""
    return None if value is None else float(f"{float(value):.6g}")


def _median(values: NDArray[np.float32]) -> float | None:
    return _rounded(np.median(values)) if len(values) else None
