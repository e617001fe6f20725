"""How far a prior is trusted: its error at LiDAR points that it was not made of, as a function of a pixel's features.

Pure. The relative error |d̃ - d| / d̃ is described by a product of factors, one for each feature of the pixel, each a
curve through its values at a few knots:

distance_m    d̃
theta_deg     angle of the ray from the optical axis
nearest_px    distance in the picture from the nearest LiDAR point that the prior was made of; 0 at a point
spread        spread of what Eq. 5 averaged, as a part of d̃
step          largest less least log of the aligned monocular map over 3×3 pixels: an edge is near

σ̂ = d̃ · base · Π factor. The factors are fitted in turn so that in every bin around a knot 95 % of the errors are
within 2 σ̂. (Errors have heavy tails: with 68 % within 1 σ̂ instead, fewer than 90 % are within 2.)

One such model is of pixels without a LiDAR point, from held-out points. Another is of pixels that keep theirs: no point
is held out there, but points can be compared with their neighbours.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from edge_depth_nerf.base.bounds import shown
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.method.alignment import Fit

KNOTS: dict[str, tuple[float, ...]] = {
    "distance_m": (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0),
    "theta_deg": (0.0, 30.0, 60.0, 90.0),
    "nearest_px": (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
    "spread": (0.001, 0.003, 0.01, 0.03, 0.1, 0.3),
    "step": (0.003, 0.01, 0.03, 0.1, 0.3, 1.0),
}
"""Where each feature's factor is kept; between them it is interpolated, beyond them it stays."""
MOTION_KNOTS: dict[str, tuple[float, ...]] = {
    "elevation_deg": (-60.0, -40.0, -25.0, -10.0),
    "by_matching": (0.02, 0.03, 0.04, 0.06, 0.08, 0.12),
    "rim_px": (0.0, 1.0, 2.0, 4.0, 8.0),
    "spread": KNOTS["spread"],
    "step": KNOTS["step"],
}
"""The same of a prior that motion alone gives. Distance is not among them: what is near in LiDAR's field is mostly
road, which matches far better than the crown of a tree at the same distance above it. Elevation tells one from the
other: above its last knot most things stand upright, in the field and beyond."""
_ALL_KNOTS = {**KNOTS, **MOTION_KNOTS}
_LOGARITHMIC = ("distance_m", "spread", "step", "by_matching")
RIM_STEP = 0.1
"""Neighbours in a map from motion whose logarithms differ by more are of two surfaces."""

LEAST_EVALUATED = 300
"""With fewer errors there is no error model."""
LEAST_IN_BIN = 100
"""A bin with fewer takes its neighbours' factor."""
LEAST_SIGMA_M = 0.02
"""About LiDAR's own noise."""
FIELD_MARGIN_DEG = 3.0
"""LiDAR's field of elevation counts as so much wider, up and down."""
_VERSION = 1
_MAX_NUMBER = 1e3

Features = Mapping[str, NDArray[np.float32]]
"""Arrays of one shape under the names of KNOTS."""


def pixel_features(
    distance_m: Float[np.ndarray, "h w"],
    spread_m: Float[np.ndarray, "h w"],
    mono_m: Float[np.ndarray, "h w"],
    lidar_points: Bool[np.ndarray, "h w"],
    theta_rad: Float[np.ndarray, "h w"],
) -> dict[str, NDArray[np.float32]]:
    """Compute the features of every pixel of a prior, H×W each; where there is no prior they mean nothing.

    Args:
        distance_m: d̃, 0 = none.
        spread_m: of what was averaged into it, whether or not a LiDAR point was kept.
        mono_m: the aligned monocular map, 0 = none.
        lidar_points: the LiDAR points that the prior was made of.
        theta_rad: angle of each ray from the optical axis.
    """
    kernel = np.ones((3, 3), np.uint8)
    known = mono_m > 0
    logs = np.log(np.where(known, mono_m, 1)).astype(np.float32)
    highest = cv2.dilate(np.where(known, logs, np.float32(-1e3)), kernel)
    lowest = cv2.erode(np.where(known, logs, np.float32(1e3)), kernel)
    return {
        "distance_m": distance_m,
        "theta_deg": np.degrees(theta_rad).astype(np.float32),
        "nearest_px": np.asarray(cv2.distanceTransform((~lidar_points).astype(np.uint8), cv2.DIST_L2, 5), np.float32),
        "spread": spread_m / np.maximum(distance_m, 1e-3),  # pyrefly: ignore[bad-assignment]
        "step": np.maximum(highest - lowest, 0),
    }


def motion_features(
    features: Features,
    motion_m: Float[np.ndarray, "h w"],
    sigma_m: Float[np.ndarray, "h w"],
    elevation_rad: Float[np.ndarray, "h w"],
) -> dict[str, NDArray[np.float32]]:
    """Compute the features of pixels whose prior is from motion alone, H×W each.

    elevation_deg angle of the ray above the horizon
    by_matching   the distance's standard deviation by parallax and confidence, as a part of it
    rim_px        pixels to the nearest jump of the map, or to the nearest pixel without distance: matching by windows
                  puts outlines some pixels off

    Args:
        features: from `pixel_features`.
        motion_m: distances from motion, 0 = none.
        sigma_m: their standard deviation.
        elevation_rad: of each ray.
    """
    known = (motion_m > 0).astype(np.uint8)
    logs = np.log(np.where(motion_m > 0, motion_m, 1)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    jump = np.asarray(cv2.dilate(logs, kernel) - cv2.erode(logs, kernel))
    whole = (np.asarray(cv2.erode(known, kernel, borderValue=(1,))) > 0) & (jump < RIM_STEP)
    return {
        # distance is no factor, but σ̂ is a share of it
        **{name: features[name] for name in ("distance_m", "spread", "step")},
        "elevation_deg": np.degrees(elevation_rad).astype(np.float32),
        "by_matching": sigma_m / np.maximum(motion_m, np.float32(1e-3)),  # pyrefly: ignore[bad-assignment]
        "rim_px": np.asarray(cv2.distanceTransform(whole.astype(np.uint8), cv2.DIST_L2, 5), np.float32),
    }


def _scaled(name: str, values: NDArray) -> NDArray:
    return np.log(np.maximum(values, 1e-6)) if name in _LOGARITHMIC else np.asarray(values)


@dataclass(frozen=True)
class ErrorModel:
    """Relative standard deviation of a prior by the features of a pixel."""

    log_base: float
    log_factors: dict[str, list[float]]
    """For each feature one number a knot."""

    def log_sigma(self, features: Features) -> NDArray[np.float64]:
        """Give the logarithm of σ̂ / d̃."""
        total = np.float64(self.log_base)
        for name, factors in self.log_factors.items():
            total = total + np.interp(_scaled(name, features[name]), _scaled(name, np.array(_ALL_KNOTS[name])), factors)
        return np.asarray(total)

    def sigma_m(self, features: Features) -> NDArray[np.float32]:
        """Give σ̂, metres."""
        sigma = features["distance_m"] * np.exp(self.log_sigma(features))
        return np.maximum(sigma, LEAST_SIGMA_M).astype(np.float32)

    def put(self, sigma_m: NDArray[np.float32], where: NDArray[np.bool_], features: Features) -> None:
        """Write σ̂ of some pixels, metres, into that of all."""
        sigma_m[where] = self.sigma_m({name: values[where] for name, values in features.items()})


def _log_scale(scaled_error: NDArray) -> float:
    """Give the logarithm of half of what 95 % of the errors are within."""
    return float(np.log(max(float(np.quantile(scaled_error, 0.95)) / 2, 1e-6)))


def _log_middle_scale(scaled_error: NDArray) -> float:
    """Average that with the logarithm of what 68.3 % are within: between one sigma and two."""
    return 0.5 * (_log_scale(scaled_error) + float(np.log(max(float(np.quantile(scaled_error, 0.683)), 1e-6))))


def fit_error_model(
    features: Features,
    relative_error: Float[np.ndarray, "n"],
    knots_of: Mapping[str, tuple[float, ...]] = KNOTS,
    middle: bool = False,
) -> ErrorModel | None:
    """Fit the factors to errors; None for fewer than LEAST_EVALUATED.

    Without any pixel at a LiDAR point the factor there is that of the next pixel over √2: a held-out error consists of
    two, that of the prior and that of the held-out point, and at a point only the latter is left.

    Args:
        features: of the pixels, n each.
        relative_error: |d̃ - d| / d̃.
        knots_of: which features, and where their factors are kept.
        middle: fit one sigma and two alike, where tails are so heavy that 95 % within two would leave too many within
            one.
    """
    if len(relative_error) < LEAST_EVALUATED:
        return None
    bins = {}
    for name, knots in knots_of.items():
        scaled = _scaled(name, np.array(knots))
        bins[name] = np.searchsorted((scaled[1:] + scaled[:-1]) / 2, _scaled(name, features[name]))
    log_scale = _log_middle_scale if middle else _log_scale
    log_base = log_scale(relative_error)
    log_factors = {name: np.zeros(len(knots)) for name, knots in knots_of.items()}

    def log_sigma() -> NDArray[np.float64]:
        return ErrorModel(log_base, {name: list(f) for name, f in log_factors.items()}).log_sigma(features)

    for _ in range(5):
        for name, factors in log_factors.items():
            scaled_error = relative_error / np.exp(log_sigma())
            found = {
                knot: log_scale(scaled_error[bins[name] == knot])
                for knot in range(len(factors))
                if np.count_nonzero(bins[name] == knot) >= LEAST_IN_BIN
            }
            if found:
                factors += np.interp(np.arange(len(factors)), list(found), list(found.values()))
        log_base += log_scale(relative_error / np.exp(log_sigma()))
    if "nearest_px" in bins and not (bins["nearest_px"] == 0).any():
        log_factors["nearest_px"][0] = log_factors["nearest_px"][1] - 0.5 * np.log(2)
    return ErrorModel(log_base, {name: factors.tolist() for name, factors in log_factors.items()})


def error_of_lidar_points(
    lidar_m: Float[np.ndarray, "h w"], lidar_points: Bool[np.ndarray, "h w"]
) -> tuple[Bool[np.ndarray, "h w"], NDArray[np.float32]]:
    """Measure how far LiDAR points lie from a line through their two neighbours, the worse of row and column.

    On a plane inverse distance is linear in the picture, nearly so for a fisheye over three pixels. What is left is the
    noise of three LiDAR points, that of one after division by √1.5, with what poses, sweeps of other frames and edges
    add.

    Returns:
        Which LiDAR points have neighbours, and their relative errors (0 elsewhere).
    """
    inverse = np.where(lidar_points, 1 / np.where(lidar_points, lidar_m, 1), 0).astype(np.float32)
    padded = np.pad(inverse, 1)
    found = np.zeros(lidar_points.shape, bool)
    error = np.zeros(lidar_points.shape, np.float32)
    for before, after in ((padded[1:-1, :-2], padded[1:-1, 2:]), (padded[:-2, 1:-1], padded[2:, 1:-1])):
        has = lidar_points & (before > 0) & (after > 0)
        off = np.abs(inverse - (before + after) / 2) * lidar_m / np.sqrt(1.5)
        error = np.where(has, np.maximum(error, off), error).astype(np.float32)
        found |= has
    return found, error


@dataclass(frozen=True)
class FrameAlignment:
    """How well one training frame's monocular map was fitted to its LiDAR."""

    frame: str
    """Its file_path."""
    returns: int
    """Pixels with LiDAR and mono."""
    fit_of: str
    """none, frame or drive: see `alignment.Aligned`."""
    fit: Fit
    """The picture's curve."""
    held_out_before: float | None
    """Mean relative error of the map as it came, at LiDAR points held out of the alignment; None if none was."""
    held_out_after: float | None
    """The same of the aligned map."""


@dataclass(frozen=True)
class BeyondField:
    """What is known of the prior where LiDAR does not reach. What is None could not be measured: no prior there."""

    motion_model: ErrorModel | None
    """Of pixels whose distance is from motion alone: measured against LiDAR where both are (`MOTION_KNOTS`)."""
    network_model: ErrorModel | None
    """Of pixels without one, whose distance is the monocular map's: measured on distances from motion that neither
    the network nor the prior saw."""
    reach_rad: tuple[float, float]
    """Elevations between which these were: least and largest."""
    reach_px: float
    """How far at most they were from the nearest pixel with a LiDAR point or a distance from motion."""

    def network_reaches(
        self, elevation_rad: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"]
    ) -> Bool[np.ndarray, "h w"]:
        """Find where the monocular map's error is known.

        `known` are pixels with a LiDAR point or a distance from motion.
        """
        if self.network_model is None:
            return np.zeros(elevation_rad.shape, bool)
        near = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, 5) <= self.reach_px
        return near & (elevation_rad >= self.reach_rad[0]) & (elevation_rad <= self.reach_rad[1])


@dataclass(frozen=True)
class MotionCalibration:
    """What a drive's training frames say about its distances from motion."""

    weight: float
    """ρ of `integration.join_estimates`, by the measured errors of both."""
    relative_error: float
    """Half of what 95 % of motion's relative errors are within."""
    mono_relative_error: float
    """The same of the aligned monocular maps, where motion has a distance, too."""
    error_model: ErrorModel
    """Of the prior's pixels without a LiDAR point that motion has a part in, in LiDAR's field."""
    beyond: BeyondField | None = None
    """None in calibrations of before."""


@dataclass(frozen=True)
class Calibration:
    """What a drive's training frames say about its prior."""

    made_of: str
    """Key of the files and options it was made from."""
    error_model: ErrorModel | None
    """Of pixels without a LiDAR point; None where too few points could be held out."""
    return_model: ErrorModel | None
    """Of pixels that keep their LiDAR point; None where error_model states it, too."""
    field_rad: tuple[float, float]
    """Elevations above the horizon that LiDAR reached, least and largest."""
    everywhere: bool
    """Whether the source of the monocular maps was trained elsewhere: then there is a prior beyond LiDAR's field, too,
    of a sigma that nothing there was measured by."""
    drive_fit: Fit | None
    """Curve of all frames together, for those with few LiDAR points."""
    frames: tuple[FrameAlignment, ...] = field(default=())
    """The training frames it was made from."""
    motion: MotionCalibration | None = None
    """Of distances from motion; None where the scene has none, or too few to measure: then they take no part."""

    def in_field(self, elevation_rad: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
        """Say whether each ray points where LiDAR reaches, within the margin."""
        margin = np.radians(FIELD_MARGIN_DEG)
        return (elevation_rad >= self.field_rad[0] - margin) & (elevation_rad <= self.field_rad[1] + margin)

    def sigma_m(self, features: Features, from_motion: Bool[np.ndarray, "*shape"] | None = None) -> NDArray[np.float32]:
        """Give σ̂, metres, by the models; there must be an error_model.

        Args:
            features: of pixels.
            from_motion: whether motion has a part in each.
        """
        assert self.error_model is not None
        sigma = self.error_model.sigma_m(features)
        if self.motion is not None and from_motion is not None:
            self.motion.error_model.put(sigma, from_motion, features)
        if self.return_model is not None:
            self.return_model.put(sigma, features["nearest_px"] == 0, features)
        return sigma

    def headline(self) -> str:
        """Say the most important of it in a line."""
        return f"{next(iter(self.sentences()), 'The prior is calibrated.')} `edge-depth-nerf inspect` tells more."

    def sentences(self) -> list[str]:
        """Sum up the calibration for the user, the most important first."""
        evaluated = [f for f in self.frames if f.held_out_before is not None and f.held_out_after is not None]
        parts = []
        if evaluated:
            before, after = (
                np.median([getattr(f, name) for f in evaluated]) for name in ("held_out_before", "held_out_after")
            )
            parts.append(
                f"Error of the monocular maps, at LiDAR points left out of their alignment: {before:.1%} before it, "
                f"{after:.1%} after it (mean relative error, median of {len(evaluated)} training pictures)."
            )
        poor = [f.frame for f in self.frames if f.fit_of == "drive"]
        if poor:
            parts.append(
                f"{len(poor)} maps have too few LiDAR points for an alignment of their own and use that of the whole "
                f"drive: {', '.join(poor[:3])}{' …' if len(poor) > 3 else '.'}"
            )
        if self.motion is not None:
            parts.append(
                f"95 % of the distances from motion are within {2 * self.motion.relative_error:.1%} of LiDAR's, and "
                f"95 % of the monocular distances there within {2 * self.motion.mono_relative_error:.1%}. Where both "
                f"are known, motion has {self.motion.weight:.0%} of the weight."
            )
        if self.error_model is None:
            parts.append("LiDAR points are too few to measure the prior's error: sigma is that of sigma_mode combined.")
        if not self.everywhere:
            low, high = np.degrees(self.field_rad)
            parts.append(
                f"The prior covers elevations from {low - FIELD_MARGIN_DEG:.0f}° to {high + FIELD_MARGIN_DEG:.0f}°, "
                f"where LiDAR measured.{self._beyond_said()}"
            )
        return parts

    def _beyond_said(self) -> str:
        """Say where else there is a prior."""
        if self.motion is None:
            return ""
        beyond = self.motion.beyond
        if beyond is None or beyond.network_model is None:
            return " Beyond, it covers pixels with a distance from motion."
        low, high = np.degrees(beyond.reach_rad)
        return (
            " Beyond, it covers pixels with a distance from motion, and pixels near these from "
            f"{low:.0f}° to {high:.0f}°, where the network learned from motion."
        )

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        content = {"version": _VERSION, **asdict(self)}
        if self.motion is None:
            del content["motion"]
        return content

    def write(self, path: Path) -> None:
        """Write JSON with its checksum, atomically."""
        content = self.to_dict()
        write_json(path, {**content, "sha256": _checksum(content)})


def _checksum(content: dict[str, Any]) -> str:
    """Hash what a file holds beside its checksum."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_calibration(path: Path) -> Calibration:
    """Read what `Calibration.write` wrote.

    Raises:
        FileNotFoundError: no such file.
        InputError: the file is no calibration of this version.
    """
    from pydantic import TypeAdapter, ValidationError  # takes 0.14 s

    content = read_json(path)
    try:
        if content["version"] != _VERSION:
            raise ValueError(f"version {content['version']}")
        # files of before have none
        if content.get("sha256") not in (None, _checksum({k: v for k, v in content.items() if k != "sha256"})):
            raise ValueError("its checksum does not fit")
        calibration = TypeAdapter(Calibration).validate_json(json.dumps(content), strict=True)
        _check(calibration)
        return calibration
    except ValidationError as error:
        first = error.errors()[0]
        problem = f"{'.'.join(map(str, first['loc']))} is {shown(first['input'])}: {first['msg']}"
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        problem = repr(error)
    raise InputError(
        f"{path}: is not a calibration of this version ({problem}). Delete it: it is then made again from the "
        "scene's maps."
    )


def _check(calibration: Calibration) -> None:
    """Check what the types of a calibration do not say.

    Raises:
        ValueError: a number is not finite or not of moderate size (logarithms, angles, exponents and relative errors
            are kept), or a model has other features.
    """
    for number in _floats(asdict(calibration)):
        if not abs(number) <= _MAX_NUMBER:
            raise ValueError(f"{shown(number)} for a number")
    models = [(calibration.error_model, KNOTS), (calibration.return_model, KNOTS)]
    if calibration.motion is not None:
        if not 0 <= calibration.motion.weight <= 1:
            raise ValueError(f"{calibration.motion.weight} for a weight")
        models.append((calibration.motion.error_model, KNOTS))
        if calibration.motion.beyond is not None:
            beyond = calibration.motion.beyond
            models += [(beyond.motion_model, MOTION_KNOTS), (beyond.network_model, KNOTS)]
    for model, knots in models:
        if model and {n: len(f) for n, f in model.log_factors.items()} != {n: len(k) for n, k in knots.items()}:
            raise ValueError("other features")


def _floats(content: Any) -> Iterator[float]:
    if isinstance(content, float):
        yield content
    elif isinstance(content, (dict, list, tuple)):
        for each in content.values() if isinstance(content, dict) else content:
            yield from _floats(each)
