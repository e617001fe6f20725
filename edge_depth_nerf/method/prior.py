"""The depth prior of a frame: aligned, integrated once, kept on disk.

Maps are H×W metres along the ray, 0 = no prior. A cached prior carries a key of everything it was made of (the maps,
the mask, the options, the calibration, the version of this format); a file that is not whole or does not fit is made
again.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from numpy.typing import NDArray

from edge_depth_nerf.base.checked_cache import content_of, keep_last, used, write_checked
from edge_depth_nerf.base.files import load_archive
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.masks.sky import regions_like_sky
from edge_depth_nerf.method.alignment import Align, Fit, align
from edge_depth_nerf.method.error_model import Calibration, motion_features, pixel_features
from edge_depth_nerf.method.integration import (
    INTEGRATED,
    MONO_RELATIVE_ERROR,
    MOTION_RELATIVE_ERROR,
    IntegrationOptions,
    check_choice,
    check_number,
    combined_sigma_m,
    join_estimates,
    select_prior,
    weight_of_errors,
)

CACHE_VERSION = 8
"""Part of every key: raised whenever the same inputs give another prior."""

KEPT_SETS = 4
"""So many priors of each training picture are kept, those used last: of so many settings of the integration."""

FARTHEST_M = 200.0
"""A monocular distance beyond means "far": under calibrated sigma there is no prior."""

LOWEST_SKY_DEG = 2.0
"""Nearer to the horizon a missing monocular distance may be the end of the world's hills as well as sky."""

SAME_SHARE = 0.1
"""A monocular distance and one that neighbours show are the same if they differ by at most this share of it."""

BESIDE_MOTION = ("motion_sigma", "motion_around")
"""The layers that are read with distances from motion, where a scene has them."""

CALIBRATED = (INTEGRATED, "mono")
"""The sources whose error is measured against held-out LiDAR points."""


def default_source(sources: Container[str]) -> str | None:
    """Choose what a prior is made of: LiDAR and monocular maps, or what there is of them."""
    if "lidar" in sources:
        return INTEGRATED if "mono" in sources else "lidar"
    return next((source for source in ("mono", "motion") if source in sources), None)


PriorSigma = Literal["calibrated", "constant", "combined"]


@dataclass(frozen=True)
class PriorOptions:
    """How LiDAR and monocular distance become a prior.

    Raises:
        InputError: a field is not one of its choices, or out of its range.
    """

    align: Align = "local"
    """How the monocular map is fitted to the frame's LiDAR before both are integrated. Without LiDAR it is not
    changed."""
    sigma_mode: PriorSigma = "calibrated"
    """calibrated: from the errors of the drive's training frames at left-out LiDAR points (see `error_model`),
    with no prior where the error is unknown; combined if there is no calibration. combined: see
    `integration.combined_sigma_m`. constant: sigma_constant_m."""
    sigma_constant_m: float = 1.0
    """The standard deviation under sigma_mode constant, metres."""
    motion: bool = True
    """Whether the prior also uses distances from motion, if the scene has them. With sigma_mode calibrated, they are
    used only if their error could be measured."""
    integration: IntegrationOptions = field(
        default_factory=lambda: IntegrationOptions(
            normalise="residual", keep_returns=True, sigma_depth_growth_per_m=0.005
        )
    )
    """Eq. 5-7 and their variants; the default is what measured best."""

    def __post_init__(self) -> None:
        check_choice("align", self.align, Align)
        check_choice("sigma_mode", self.sigma_mode, PriorSigma)
        check_number("sigma_constant_m", self.sigma_constant_m, 1e-3)

    def wants_calibration(self, depth_source: str) -> bool:
        """Say whether a calibration of the drive has a part in the prior made of a source."""
        calibrated = self.sigma_mode == "calibrated" and depth_source in CALIBRATED
        return calibrated or (self.align != "none" and depth_source == INTEGRATED)


Maps = Mapping[str, NDArray[np.float32] | None]
"""H×W distance along the ray by source, metres, 0 = none; None as if the source were missing."""


@dataclass(frozen=True)
class Prior:
    """Distance prior and its standard deviation, both H×W float32 metres; 0 = no prior."""

    distance_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]


@dataclass(frozen=True)
class RayAngles:
    """Where the rays of a picture point."""

    theta_rad: Float32[np.ndarray, "h w"]
    """Angle from the optical axis; pi where there is no ray."""
    elevation_rad: Float32[np.ndarray, "h w"]
    """Angle above the world's horizon; -pi/2 where there is no ray."""


def ray_angles(camera: Camera, up_in_camera: Float[np.ndarray, "3"]) -> RayAngles:
    """Compute the angles of a picture's rays; `up_in_camera` is the world's upward unit vector in its OpenCV axes."""
    found = rays(camera)
    elevation = np.arcsin(np.clip(found.directions @ up_in_camera.astype(np.float32), -1, 1))
    theta = np.arccos(np.clip(found.cos_theta, -1, 1))
    none = ~found.within
    theta[none], elevation[none] = np.pi, -np.pi / 2
    return RayAngles(theta, elevation)


def sky_of(
    mono_m: Float[np.ndarray, "h w"],
    lidar_m: Float[np.ndarray, "h w"] | None,
    view: RayAngles,
    picture: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Find the sky: bright, above the horizon, without a monocular distance or a LiDAR point.

    `process` and `estimate-depth` take the sky out of the maps; maps of one's own may lack a distance elsewhere, too.
    """
    sky = mask & ~(np.nan_to_num(mono_m) > 0) & (view.elevation_rad > math.radians(LOWEST_SKY_DEG))
    if lidar_m is not None:
        sky &= ~(np.nan_to_num(lidar_m) > 0)
    # where there is no ray the elevation is -pi/2, but the mask says so
    return regions_like_sky(picture, sky, mask & (view.elevation_rad < 0))


@dataclass(frozen=True)
class IntegratedFrame:
    """A prior with what its error depends on; H×W each, 0 = none."""

    distance_m: NDArray[np.float32]
    spread_m: NDArray[np.float32]
    """Of what was averaged, also where a LiDAR point was kept."""
    mono_m: NDArray[np.float32]
    """The aligned monocular map, with what motion adds to it."""
    lidar_points: NDArray[np.bool_]
    """The LiDAR points that entered."""
    from_motion: NDArray[np.bool_]
    """Where motion has a part, except at LiDAR points."""


@dataclass(frozen=True)
class MotionMap:
    """Distances from motion, and how they share the estimate's part with the monocular ones."""

    distance_m: NDArray[np.float32]
    """H×W, 0 = none."""
    weight: float
    """ρ of `integration.join_estimates`."""
    mono_counts: NDArray[np.bool_]
    """H×W, True where the monocular map may be trusted: beyond, there is a prior from motion alone."""
    alone: NDArray[np.bool_]
    """H×W, True where motion counts alone if it has a distance: beyond LiDAR's field. There the monocular map is fitted
    to it, as to LiDAR points in the field."""
    around_m: NDArray[np.float32] | None = None
    """H×W, what the neighbours' distances show at the picture's pixels, 0 = nothing. Beyond LiDAR's field a monocular
    distance counts only where this confirms it. None: it needs no confirmation."""


def integrate_frame(
    lidar_m: NDArray[np.float32],
    mono_m: NDArray[np.float32],
    mask: NDArray[np.bool_],
    depth_source: str,
    options: PriorOptions,
    drive_fit: Fit | None = None,
    motion: MotionMap | None = None,
    device: torch.device | str = "cpu",
) -> IntegratedFrame:
    """Align and integrate a frame under a calibration: the prior whose error `Calibration` describes.

    Args:
        lidar_m: H×W LiDAR distance, 0 = no LiDAR point.
        mono_m: H×W monocular distance, 0 = none.
        mask: H×W, True where the picture may be used.
        depth_source: integrated, or mono alone.
        options: what is made of them.
        drive_fit: that of `Calibration`, for a frame with few LiDAR points.
        motion: what is known from motion; for the integrated source.
        device: what integrates.

    Raises:
        InputError: the maps differ in size.
    """
    anywhere, mask = mask, mask & ~(mono_m > FARTHEST_M)
    # where the monocular map means "far" a LiDAR point counts beside motion, as where it says nothing
    lidar_points = (mask if motion is None else anywhere) & np.isfinite(lidar_m) & (lidar_m > 0)
    if depth_source == "mono":
        lidar_points = np.zeros_like(mask)
    else:
        fitted_to_m = lidar_m if motion is None else _measured(lidar_m, motion)
        mono_m = align(fitted_to_m, mono_m, mask, options.align, drive_fit).mono_m
    from_motion = np.zeros_like(mask)
    if motion is not None:
        from_motion = anywhere & (motion.distance_m > 0) & ~lidar_points
        mono_counts = mask & motion.mono_counts & ~(motion.alone & (motion.distance_m > 0))
        if motion.around_m is not None:
            mono_counts &= ~motion.alone | confirmed(mono_m, motion.around_m)
        mono_m = join_estimates(np.where(mono_counts, mono_m, np.float32(0)), motion.distance_m, motion.weight)
        mask = anywhere
    # the spread is wanted at LiDAR points, too, so they are kept afterwards
    integration = dataclasses.replace(options.integration, keep_returns=False)

    def integrated(lidar_m: NDArray[np.float32], mono_m: NDArray[np.float32]) -> tuple[NDArray, NDArray]:
        lidar, mono, valid = (torch.from_numpy(pixels) for pixels in (lidar_m, mono_m, mask))
        found = select_prior(depth_source, {"lidar": lidar, "mono": mono}, valid, integration, device)
        return found.distance_m.float().numpy(), found.spread_m.float().numpy()

    distance, spread = integrated(lidar_m, mono_m)
    if motion is not None and (alone := motion.alone & from_motion).any():
        # a monocular map that is worse takes no part in the windows of these pixels, either
        by_motion = integrated(np.zeros_like(mono_m), np.where(motion.alone, motion.distance_m, np.float32(0)))
        distance, spread = (np.where(alone, *both) for both in zip(by_motion, (distance, spread), strict=True))
    lidar_points &= distance > 0
    if options.integration.keep_returns:
        distance = np.where(lidar_points, lidar_m, distance)
    known = np.where(np.isfinite(mono_m), mono_m, 0)
    return IntegratedFrame(distance, spread, known, lidar_points, from_motion)


def confirmed(mono_m: NDArray[np.float32], around_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Find where neighbouring pictures show the same distance, at a pixel or at one of the eight beside it.

    H×W each, 0 = none: the aligned monocular map, and what the neighbours' distances from motion show.
    """
    height, width = mono_m.shape
    padded = np.pad(around_m, 1)
    shifted = (padded[row : row + height, column : column + width] for row in range(3) for column in range(3))
    same = [(seen_m > 0) & (np.abs(seen_m - mono_m) <= SAME_SHARE * mono_m) for seen_m in shifted]
    return np.logical_or.reduce(same)


def _measured(lidar_m: NDArray[np.float32], motion: MotionMap) -> NDArray[np.float32]:
    """Give what a monocular map is fitted to: LiDAR, and beyond its field motion."""
    return np.where(np.nan_to_num(lidar_m) > 0, lidar_m, np.where(motion.alone, motion.distance_m, np.float32(0)))


def sigma_of(
    frame: IntegratedFrame,
    calibration: Calibration,
    view: RayAngles,
    motion: MotionMap | None,
    motion_sigma_m: NDArray[np.float32],
) -> NDArray[np.float32]:
    """σ̂ of a frame's prior, metres: by the model of LiDAR's field in it, by those of `BeyondField` beyond."""
    features = pixel_features(frame.distance_m, frame.spread_m, frame.mono_m, frame.lidar_points, view.theta_rad)
    sigma_m = calibration.sigma_m(features, frame.from_motion)
    beyond = calibration.motion.beyond if calibration.motion is not None else None
    if motion is None or beyond is None:
        return sigma_m
    outside = motion.alone & ~frame.lidar_points
    if beyond.network_model is not None:
        beyond.network_model.put(sigma_m, outside & ~frame.from_motion, beyond_features(frame, view))
    if beyond.motion_model is not None:
        of_motion = motion_features(features, motion.distance_m, motion_sigma_m, view.elevation_rad)
        beyond.motion_model.put(sigma_m, outside & frame.from_motion, of_motion)
    return sigma_m


def beyond_features(frame: IntegratedFrame, view: RayAngles) -> dict[str, NDArray[np.float32]]:
    """Compute features beyond LiDAR's field, where the nearest known pixel may be one from motion."""
    known = frame.lidar_points | frame.from_motion
    return pixel_features(frame.distance_m, frame.spread_m, frame.mono_m, known, view.theta_rad)


def motion_map(
    motion_m: NDArray[np.float32],
    calibration: Calibration,
    view: RayAngles,
    lidar_m: NDArray[np.float32] | None,
    around_m: NDArray[np.float32] | None = None,
) -> MotionMap:
    """Say how a picture's distances from motion take part under a calibration that measured them.

    Args:
        motion_m: H×W, 0 = none.
        calibration: the drive's calibration, with what it says of motion.
        view: of the picture.
        lidar_m: its LiDAR, 0 = no LiDAR point; None without.
        around_m: what the neighbours' distances from motion show, 0 = nothing; None where that is not known.
    """
    assert calibration.motion is not None
    in_field, beyond = calibration.in_field(view.elevation_rad), calibration.motion.beyond
    if beyond is None:
        counts = np.full_like(in_field, True) if calibration.everywhere else in_field
        return MotionMap(motion_m, calibration.motion.weight, counts, np.zeros_like(in_field))
    if beyond.motion_model is None:
        motion_m = np.where(in_field, motion_m, np.float32(0))
    known = motion_m > 0 if lidar_m is None else (motion_m > 0) | (np.nan_to_num(lidar_m) > 0)
    counts = in_field | calibration.everywhere | beyond.network_reaches(view.elevation_rad, known)
    if calibration.everywhere:
        return MotionMap(motion_m, calibration.motion.weight, counts, ~in_field)
    return MotionMap(motion_m, calibration.motion.weight, counts, ~in_field, around_or_nothing(motion_m, around_m))


def around_or_nothing(motion_m: NDArray[np.float32], around_m: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Give what neighbours show, or nothing for scenes without."""
    return np.zeros_like(motion_m) if around_m is None else around_m


def motion_sigma(motion_m: NDArray[np.float32], sigma_m: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """Give the standard deviation of distances from motion: as it came, or a usual share of the distance."""
    usual_m = np.float32(MOTION_RELATIVE_ERROR) * motion_m
    return usual_m if sigma_m is None else np.where(sigma_m > 0, sigma_m, usual_m)


def make_prior(
    maps: Maps,
    mask: NDArray[np.bool_],
    depth_source: str,
    options: PriorOptions,
    calibration: Calibration | None = None,
    view: RayAngles | None = None,
    device: torch.device | str = "cpu",
) -> Prior:
    """Align a frame's monocular map, integrate (Eq. 5-7), and say how far each pixel is trusted.

    Args:
        maps: H×W distance by source, 0 = none.
        mask: H×W, True where the picture may be used.
        depth_source: integrated (LiDAR and mono, and motion where it is given), or the name of a source.
        options: what is made of them.
        calibration: the drive's calibration; used for the drive's fit, and under sigma_mode calibrated.
        view: of the picture; under sigma_mode calibrated a calibration wants it.
        device: what integrates.

    Raises:
        InputError: there is no map of a source that is needed, or the maps differ in size.
    """
    lidar_m, mono_m = maps.get("lidar"), maps.get("mono")
    motion_m = maps.get("motion") if options.motion and depth_source == INTEGRATED else None
    if (
        options.sigma_mode == "calibrated"
        and depth_source in CALIBRATED
        and calibration is not None
        and mono_m is not None
    ):
        assert view is not None
        motion, motion_sigma_m = None, np.zeros(mask.shape, np.float32)
        if motion_m is not None and calibration.motion is not None:
            motion = motion_map(motion_m, calibration, view, lidar_m, maps.get("motion_around"))
            motion_sigma_m = motion_sigma(motion_m, maps.get("motion_sigma"))
        else:
            mask = mask if calibration.everywhere else mask & calibration.in_field(view.elevation_rad)
        if calibration.error_model is not None and (lidar_m is not None or depth_source == "mono"):
            lidar_m = np.zeros_like(mono_m) if lidar_m is None else lidar_m
            frame = integrate_frame(lidar_m, mono_m, mask, depth_source, options, calibration.drive_fit, motion, device)
            sigma = sigma_of(frame, calibration, view, motion, motion_sigma_m)
            return Prior(frame.distance_m, np.where(frame.distance_m > 0, sigma, np.float32(0)))
        # what could not be measured takes no part
        motion_m = None
    if depth_source == INTEGRATED and lidar_m is not None and mono_m is not None:
        aligned = align(lidar_m, mono_m, mask, options.align, calibration.drive_fit if calibration else None).mono_m
        if motion_m is not None:
            weight = weight_of_errors(MOTION_RELATIVE_ERROR, MONO_RELATIVE_ERROR)
            aligned = join_estimates(aligned, motion_m, weight)
        maps = {**maps, "mono": aligned}
    of_source = {name: torch.from_numpy(pixels) for name, pixels in maps.items() if pixels is not None}
    integrated = select_prior(depth_source, of_source, torch.from_numpy(mask), options.integration, device)
    distance_m = integrated.distance_m.float().numpy()
    if options.sigma_mode == "constant":
        return Prior(distance_m, np.where(distance_m > 0, np.float32(options.sigma_constant_m), np.float32(0)))
    # beside LiDAR any source is an estimate, whose error grows with the distance
    estimate = of_source["mono" if depth_source == INTEGRATED else depth_source]
    return Prior(distance_m, combined_sigma_m(integrated, estimate).float().numpy())


class PriorCache:
    """Priors on disk, one file each, found by what they were made of.

    A folder that cannot be written (a read-only scene) is not an error: the prior is then made each time.
    """

    def __init__(
        self,
        folder: Path,
        depth_source: str,
        options: PriorOptions,
        calibration: Calibration | None = None,
        device: torch.device | str = "cpu",
    ):
        self.folder, self.depth_source, self.options, self.calibration = folder, depth_source, options, calibration
        self._device = device
        described = {
            "version": CACHE_VERSION,
            "depth_source": depth_source,
            **dataclasses.asdict(options),
            "trust": None if calibration is None else calibration.to_dict(),
        }
        self._options_key = json.dumps(described, sort_keys=True).encode()

    def prior(self, maps: Maps, mask: NDArray[np.bool_], view: RayAngles | None = None) -> Prior:
        """Do as `make_prior`, or read the prior from the cache."""
        angles = (view.theta_rad, view.elevation_rad) if view is not None else ()
        of_sources = [pixels for _, pixels in sorted(maps.items())]
        path = self.folder / f"{self._key(*of_sources, mask, *angles)}.npz"
        cached = _read(path, mask.shape)
        if cached is not None:
            return cached
        prior = make_prior(maps, mask, self.depth_source, self.options, self.calibration, view, self._device)

        archive = io.BytesIO()
        np.savez_compressed(archive, distance_m=prior.distance_m, sigma_m=prior.sigma_m)
        try:
            write_checked(path, CACHE_VERSION, lambda file: file.write(archive.getbuffer()))
        except OSError:
            pass
        return prior

    @property
    def layers(self) -> tuple[str, ...]:
        """List the layers that are read: the source's own, and those that show where the sky is."""
        if self.depth_source == INTEGRATED and self.options.motion:
            return ("lidar", "mono", "motion", *BESIDE_MOTION)
        return ("lidar", "mono") if self.depth_source in CALIBRATED else (self.depth_source,)

    def remove_old(self, pictures: int) -> None:
        """Keep the last `KEPT_SETS` priors of so many pictures."""
        keep_last(self.folder, "*.npz", KEPT_SETS * pictures)

    def _key(self, *maps: NDArray | None) -> str:
        digest = hashlib.sha256(self._options_key)
        for pixels in maps:
            digest.update(b"none" if pixels is None else f"{pixels.dtype}{pixels.shape}".encode())
            digest.update(b"" if pixels is None else np.ascontiguousarray(pixels).tobytes())
        return digest.hexdigest()[:32]


def _read(path: Path, shape: tuple[int, ...]) -> Prior | None:
    content = content_of(path, CACHE_VERSION)
    if content is None:
        return None
    archive = load_archive(content)
    prior = Prior(archive["distance_m"], archive["sigma_m"])
    if any(m.shape != shape or m.dtype != np.float32 for m in (prior.distance_m, prior.sigma_m)):
        return None
    used(path)
    return prior
