"""A drive's calibration: how well its monocular maps fit LiDAR, and how wrong its priors are.

It is made only from training frames. In each frame some LiDAR points are held out, the prior is made of the rest, and
compared with the held-out points: whole blocks of 64 px (of 1400), single points, and in every second frame LiDAR's
lowest and highest rows, beyond which a prior is extrapolated. Above a frame's own LiDAR points the prior is compared
with what the points of the other frames show there. The weight of distances from motion beside the monocular maps
follows from the errors of both at the held-out points. The result is kept beside the scene's maps.

Beyond LiDAR's field there is nothing but motion to compare with. Motion's own error is measured in the field, where
LiDAR is, as a function of what is known of it: a prior is made of motion alone and compared with the LiDAR points. The
monocular map's error is measured beyond the field, on distances from motion in places that neither the network nor the
prior saw (`mono.motion_seen`). It is used where motion has none, at outlines and far ahead, where a network is worse
than elsewhere: by how much is measured in the field, at LiDAR points with and without a distance from motion.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.checked_cache import keep_last, used
from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import sha256_of
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.method.alignment import LEAST_POINTS, Fit, align, both, fit_logs
from edge_depth_nerf.method.error_model import (
    FIELD_MARGIN_DEG,
    LEAST_EVALUATED,
    MOTION_KNOTS,
    BeyondField,
    Calibration,
    ErrorModel,
    Features,
    FrameAlignment,
    MotionCalibration,
    error_of_lidar_points,
    fit_error_model,
    motion_features,
    pixel_features,
    read_calibration,
)
from edge_depth_nerf.method.integration import INTEGRATED, weight_of_errors
from edge_depth_nerf.method.prior import (
    BESIDE_MOTION,
    CACHE_VERSION,
    MotionMap,
    PriorOptions,
    RayAngles,
    around_or_nothing,
    beyond_features,
    confirmed,
    integrate_frame,
    motion_sigma,
    ray_angles,
)
from edge_depth_nerf.mono.far_seen import ELEVATION_QUANTILES, seen_above, static_cloud
from edge_depth_nerf.mono.motion_seen import left_out_pixels
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

KEPT_CALIBRATIONS = 16
"""So many calibrations are kept of a scene beside its own, those used last."""
MOST_FRAMES = 100
"""Of longer drives so many training pictures are used, evenly spread."""
HELD_OUT_BLOCK_SHARE = 64 / 1400
"""Side of the blocks that are left out, as a share of the picture's width."""
HELD_OUT_PART = 0.1
"""So much of the blocks, and of the single LiDAR points, is held out."""
HELD_OUT_ROWS = (0.1, 0.95)
"""In every second frame LiDAR points below and above these quantiles of their elevation are held out."""
_BEYOND_VERSION = 2
"""Part of the key of calibrations with motion: raised when they measure otherwise beyond LiDAR's field."""
REACH_QUANTILE = 0.95
"""Of how far left-out distances from motion lie from the nearest that is known: beyond, nothing is measured."""
_EVALUATED_A_FRAME = 5_000
_FOR_THE_DRIVE_A_FRAME = 2_000
"""So many LiDAR points of a frame are used; more tell nothing new."""


@dataclasses.dataclass(frozen=True)
class Errors:
    """Errors at some pixels, and these pixels' features."""

    features: dict[str, NDArray[np.float32]]
    """See `error_model.pixel_features`; n each."""
    relative: NDArray[np.float32]
    """|d̃ - d| / d̃."""

    @staticmethod
    def of(
        features: Features, pixels: tuple[NDArray, ...], found_m: NDArray[np.float32], true_m: NDArray[np.float32]
    ) -> Errors:
        """Errors of a map at chosen pixels."""
        chosen = {name: values[pixels] for name, values in features.items()}
        return Errors(chosen, np.abs(found_m[pixels] - true_m[pixels]) / found_m[pixels])

    @staticmethod
    def together(every: Sequence[Errors]) -> Errors:
        """Those of several frames."""
        names = every[0].features
        features = {name: np.concatenate([each.features[name] for each in every]) for name in names}
        return Errors(features, np.concatenate([each.relative for each in every]))

    def where(self, which: NDArray[np.bool_]) -> Errors:
        """Some of them."""
        return Errors({name: values[which] for name, values in self.features.items()}, self.relative[which])

    def model(self) -> ErrorModel | None:
        """Fit a model to them."""
        return fit_error_model(self.features, self.relative)


@dataclasses.dataclass(frozen=True)
class MeasuredBeyond:
    """One training frame's part in `BeyondField`."""

    motion: Errors
    """Of a prior made of motion alone, at pixels with a LiDAR point."""
    network: Errors
    """Of a prior made without a distance from motion that was left out, beyond LiDAR's field."""
    field: Errors
    """Of a prior made without motion, at held-out LiDAR points."""
    field_matched: NDArray[np.bool_]
    """Which of these motion has a distance of."""
    elevation_rad: NDArray[np.float32]
    """Of all distances from motion, above the horizon."""


@dataclasses.dataclass(frozen=True)
class MeasuredFrame:
    """One training frame's part in the calibration."""

    alignment: FrameAlignment
    """How well its map was fitted."""
    errors: Errors
    """At held-out LiDAR points, and at pixels that other frames' points show."""
    at_points: Errors
    """Of the LiDAR points of pixels that keep theirs, against their neighbours."""
    elevation_rad: NDArray[np.float32]
    """Of all LiDAR points, above the horizon."""
    from_motion: NDArray[np.bool_]
    """Whether motion has a part in each of the pixels of `errors`."""
    beyond: MeasuredBeyond | None = None
    """Where LiDAR does not reach; None without motion."""


def held_out_points(
    lidar_points: NDArray[np.bool_], elevation_rad: NDArray[np.float32], number: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which of a frame's LiDAR points (H×W) to hold out, and which of these lie in whole blocks.

    The elevation is that of each ray (H×W); the frame's number in the calibration seeds the choice.
    """
    rng = np.random.default_rng([7, number])
    height, width = lidar_points.shape
    side = max(4, round(HELD_OUT_BLOCK_SHARE * width))
    chosen = rng.random((height // side + 1, width // side + 1)) < HELD_OUT_PART
    in_blocks = np.kron(chosen, np.ones((side, side), bool))[:height, :width] & lidar_points
    left_out = in_blocks | ((rng.random(lidar_points.shape) < HELD_OUT_PART) & lidar_points)
    if number % 2 and lidar_points.any():
        low, high = np.quantile(elevation_rad[lidar_points], HELD_OUT_ROWS)
        left_out |= lidar_points & ((elevation_rad < low) | (elevation_rad > high))
    return left_out, in_blocks


def calibrate_scene(scene: Path, console: Console | None = None) -> Calibration:
    """Measure a scene's alignment and errors from its training frames, and keep the result as SCENE/mono_trust.json.

    Raises:
        FileNotFoundError: no scene there.
        InputError: the scene has no LiDAR or no monocular maps, or one of its files is broken.
    """
    read = read_scene(scene)
    calibration = _calibrate(read, _chosen(read), INTEGRATED, PriorOptions(), console)
    calibration.write(read.folder / CALIBRATION_FILE)
    return calibration


def saved_calibration(
    scene: SceneFolder,
    options: PriorOptions,
    cache: Path | None = None,
    training_images: Collection[Path] | None = None,
    depth_source: str = INTEGRATED,
) -> Calibration | None:
    """The scene's calibration, if there is one made of the present files and for these options."""
    made_of = _made_of(scene, _chosen(scene, training_images), depth_source, options)
    for path in (scene.folder / CALIBRATION_FILE, _cached(scene, cache, made_of)):
        try:
            calibration = read_calibration(path)
        except (OSError, InputError):
            continue
        if calibration.made_of == made_of:
            if path.name != CALIBRATION_FILE:
                used(path)
            return calibration
    return None


def find_calibration(
    scene: SceneFolder,
    options: PriorOptions,
    cache: Path | None = None,
    training_images: Collection[Path] | None = None,
    console: Console | None = None,
    depth_source: str = INTEGRATED,
    device: torch.device | str = "cpu",
) -> Calibration:
    """The scene's calibration for these options; made now and kept in SCENE/.cache, or in `cache`, where there is none.

    `training_images` are the pictures that are trained on, where the scene does not say so itself; `depth_source` is
    what the prior is made of: integrated, or mono alone; `device` is what integrates.

    Raises:
        InputError: as `calibrate_scene`.
    """
    if (calibration := saved_calibration(scene, options, cache, training_images, depth_source)) is not None:
        return calibration
    calibration = _calibrate(scene, _chosen(scene, training_images), depth_source, options, console, device)
    path = _cached(scene, cache, calibration.made_of)
    # a scene that cannot be written has it made anew each time
    with suppress(OSError):
        calibration.write(path)
        keep_last(path.parent, "mono_trust_*.json", KEPT_CALIBRATIONS)
    return calibration


def field_of_source(scene: SceneFolder) -> Calibration | None:
    """What is known of a scene without LiDAR: how far up and down the maps' network was taught by LiDAR elsewhere.

    A calibration without errors, or None where the maps' source says nothing about its field.
    """
    source = scene.meta.get("mono")
    source = source if isinstance(source, dict) else {}
    field_deg = source.get("field_deg")
    if not isinstance(field_deg, list) or len(field_deg) != 2 or source.get("trained_on") == "elsewhere":
        return None
    low, high = (float(np.radians(value)) for value in field_deg)
    return Calibration("", None, None, (low, high), everywhere=False, drive_fit=None)


def _cached(scene: SceneFolder, cache: Path | None, made_of: str) -> Path:
    return (cache or scene.folder / ".cache") / f"mono_trust_{made_of}.json"


def _chosen(scene: SceneFolder, training_images: Collection[Path] | None = None) -> list[ScenePicture]:
    if training_images is None:
        training = [picture for picture in scene.pictures if not picture.held_out]
    else:
        images = {path.resolve() for path in training_images}
        training = [picture for picture in scene.pictures if picture.files["image"].resolve() in images]
    return [training[index] for index in spread_over(len(training), MOST_FRAMES)]


def _made_of(scene: SceneFolder, pictures: Sequence[ScenePicture], depth_source: str, options: PriorOptions) -> str:
    """Key of the options, of the geometry, and of what is in the files of the pictures that are measured."""
    relevant = {"depth_source": depth_source, **dataclasses.asdict(options)}
    del relevant["sigma_mode"], relevant["sigma_constant_m"]
    with_motion = _with_motion(scene, depth_source, options)
    if with_motion:
        relevant["beyond"] = _BEYOND_VERSION
    else:
        del relevant["motion"]
    units = [scene.lidar_metres_per_count, scene.lidar_is_z_depth, round(scene.theta_max_rad, 9)]
    digest = hashlib.sha256(
        json.dumps([CACHE_VERSION, relevant, maps_trained_on(scene.meta), units], sort_keys=True).encode()
    )
    content = functools.cache(sha256_of)
    for picture in pictures:
        pose = picture.rotation.round(9).tolist(), picture.position_m.round(6).tolist()
        digest.update(repr((picture.name, picture.lens, pose)).encode())
        for layer in ("lidar", "mono", "mask", *(["motion", *BESIDE_MOTION] if with_motion else [])):
            path = picture.files.get(layer)
            digest.update(layer.encode() + (b"" if path is None else bytes.fromhex(content(path))))
    return digest.hexdigest()[:16]


def _with_motion(scene: SceneFolder, depth_source: str, options: PriorOptions) -> bool:
    return options.motion and depth_source == INTEGRATED and scene.has("motion")


def maps_trained_on(meta: Mapping[str, Any]) -> str:
    """Where the source of a scene's monocular maps was trained: as transforms.json states it, or in the scene."""
    later, drive = meta.get("mono"), meta.get("source")
    if isinstance(later, dict):
        found = later.get("trained_on")
    else:
        found = drive.get("mono_trained_on") if isinstance(drive, dict) else None
    return "elsewhere" if found == "elsewhere" else "scene"


def _calibrate(
    scene: SceneFolder,
    pictures: Sequence[ScenePicture],
    depth_source: str,
    options: PriorOptions,
    console: Console | None,
    device: torch.device | str = "cpu",
) -> Calibration:
    missing = [word for layer, word in (("lidar", "LiDAR"), ("mono", "monocular")) if not scene.has(layer)]
    if missing:
        raise InputError(
            f"{scene.path}: has no {' and no '.join(missing)} distance maps, so the error of the monocular maps "
            "cannot be measured. Process the drive with its sweeps, and make monocular maps with "
            "`edge-depth-nerf estimate-depth`."
        )
    measurable = [p for p in pictures if "lidar" in p.files and "mono" in p.files]
    if not measurable:
        raise InputError(
            f"{scene.path}: no training picture has both a LiDAR and a monocular map, so the prior's error cannot be "
            "measured. Process the drive again."
        )

    with_motion = _with_motion(scene, depth_source, options)
    errors: tuple[float, float] | None = None
    field_rad = (0.0, 0.0)

    def measure(numbered: tuple[int, ScenePicture]) -> MeasuredFrame:
        number, picture = numbered
        maps = scene.maps(picture)
        assert maps.lidar_m is not None and maps.mono_m is not None
        view = ray_angles(picture.lens, picture.up_in_camera)
        motion_m, motion = maps.distances_m.get("motion"), None
        if errors is not None and motion_m is not None:
            around_m = around_or_nothing(motion_m, maps.distances_m.get("motion_around"))
            beyond = ~_within(field_rad, view)
            motion = MotionMap(motion_m, weight_of_errors(*errors), np.ones_like(maps.usable), beyond, around_m)
        far_seen_m = seen_above(cloud, scene, picture, (picture.lens.width, picture.lens.height))
        given = number, maps.lidar_m, maps.mono_m, maps.usable, view, options, drive_fit
        measured = measure_frame(picture.name, *given, far_seen_m, depth_source, motion=motion, device=device)
        if motion is None:
            return measured
        left_out = left_out_pixels(scene, picture, motion.distance_m)
        sigma_m = motion_sigma(motion.distance_m, maps.distances_m.get("motion_sigma"))
        measured_beyond = measure_beyond(*given, motion, sigma_m, left_out, device)
        return dataclasses.replace(measured, beyond=measured_beyond)

    bars = progress_bars(console or Console(quiet=True), transient=True)
    with bars as progress, ThreadPoolExecutor(2) as pool:
        task = progress.add_task("Measuring the prior's error…", total=(5 + with_motion) * len(measurable))

        def counted(work: Callable[[tuple[int, ScenePicture]], Any]) -> Iterator[Any]:
            for found in pool.map(work, enumerate(measurable)):
                progress.advance(task)
                yield found

        cloud = static_cloud(scene, measurable, lambda: progress.advance(task))
        drive_fit = fit_of_drive([*counted(partial(_points_of_drive, scene))], options, depth_source)
        if with_motion:
            of_both, elevations_rad = zip(*counted(partial(_errors_of_both, scene, options, drive_fit)), strict=True)
            errors, field_rad = _motion_errors(of_both), _field_rad(elevations_rad)
        frames = list(counted(measure))
    made_of = _made_of(scene, pictures, depth_source, options)
    return combine(frames, made_of, maps_trained_on(scene.meta) == "elsewhere", drive_fit, errors)


def _points_of_drive(scene: SceneFolder, numbered: tuple[int, ScenePicture]) -> NDArray[np.float32]:
    number, picture = numbered
    maps = scene.maps(picture)
    assert maps.lidar_m is not None and maps.mono_m is not None
    return points_of_both(number, maps.lidar_m, maps.mono_m, maps.usable)


def points_of_both(
    number: int, lidar_m: NDArray[np.float32], mono_m: NDArray[np.float32], usable: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """2×N: a frame's LiDAR and monocular distances where it has both, for the drive's fit."""
    some = _some(both(lidar_m, mono_m, usable), _FOR_THE_DRIVE_A_FRAME, np.random.default_rng([11, number]))
    return np.stack([lidar_m[some], mono_m[some]])


def fit_of_drive(
    of_frames: Sequence[NDArray[np.float32]], options: PriorOptions, depth_source: str = INTEGRATED
) -> Fit | None:
    """Fit monocular maps to LiDAR by the points of all frames, as `points_of_both` gives them.

    None of too few, and where maps are not aligned.
    """
    found = np.concatenate(of_frames, 1)
    aligned = options.align != "none" and depth_source == INTEGRATED
    return fit_logs(*found) if aligned and found.shape[1] >= LEAST_POINTS else None


def _within(field_rad: tuple[float, float], view: RayAngles) -> NDArray[np.bool_]:
    """Rays in LiDAR's field, within its margin: as `Calibration.in_field`."""
    return Calibration("", None, None, field_rad, everywhere=False, drive_fit=None).in_field(view.elevation_rad)


def _field_rad(elevations_rad: Sequence[NDArray[np.float32]]) -> tuple[float, float]:
    """LiDAR's field by the elevations of all LiDAR points."""
    every = np.concatenate(elevations_rad)
    low, high = np.quantile(every, ELEVATION_QUANTILES) if len(every) else (0.0, 0.0)
    return float(low), float(high)


def _errors_of_both(
    scene: SceneFolder, options: PriorOptions, drive_fit: Fit | None, numbered: tuple[int, ScenePicture]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """2×N: relative errors of motion and of the monocular map, at LiDAR points held out of the latter's alignment.

    And the elevation of every LiDAR point.
    """
    number, picture = numbered
    maps = scene.maps(picture)
    motion_m = maps.distances_m.get("motion")
    if maps.lidar_m is None or maps.mono_m is None or motion_m is None:
        return np.empty((2, 0), np.float32), np.empty(0, np.float32)
    elevation_rad = ray_angles(picture.lens, picture.up_in_camera).elevation_rad
    left_out, _ = held_out_points(both(maps.lidar_m, maps.mono_m, maps.usable), elevation_rad, number)
    kept_m = np.where(left_out, np.float32(0), maps.lidar_m)
    aligned = align(kept_m, maps.mono_m, maps.usable, options.align, drive_fit).mono_m
    evaluated = _some(left_out & (motion_m > 0) & (aligned > 0), _EVALUATED_A_FRAME, np.random.default_rng([9, number]))
    true_m = maps.lidar_m[evaluated]
    errors = np.stack([np.abs(found[evaluated] - true_m) / true_m for found in (motion_m, aligned)])
    return errors, elevation_rad[maps.usable & (maps.lidar_m > 0)]  # pyrefly: ignore[bad-return]


def _motion_errors(of_frames: Sequence[NDArray[np.float32]]) -> tuple[float, float] | None:
    """Relative errors of motion and of the monocular maps over all frames: half of what 95 % are within.

    None where too little was evaluated.
    """
    found = np.concatenate(of_frames, 1)
    if found.shape[1] < LEAST_EVALUATED:
        return None
    motion, mono = np.quantile(found, 0.95, axis=1) / 2
    return float(motion), float(mono)


def measure_frame(
    name: str,
    number: int,
    lidar_m: NDArray[np.float32],
    mono_m: NDArray[np.float32],
    usable: NDArray[np.bool_],
    view: RayAngles,
    options: PriorOptions,
    drive_fit: Fit | None = None,
    far_seen_m: NDArray[np.float32] | None = None,
    depth_source: str = INTEGRATED,
    motion: MotionMap | None = None,
    device: torch.device | str = "cpu",
) -> MeasuredFrame:
    """Hold out some of a frame's LiDAR points, make its prior of the rest, and compare.

    Maps are H×W: distances as they came, 0 = none; `usable` is True where the picture may be used. `drive_fit` is
    what frames with few LiDAR points take, here as in the prior. `far_seen_m` is what the LiDAR points of other frames
    show above this one's. The frame's number in the calibration decides what is left out.

    Raises:
        InputError: the maps differ in size.
    """
    lidar_points = both(lidar_m, mono_m, usable)
    rng = np.random.default_rng([8, number])
    left_out, in_blocks = held_out_points(lidar_points, view.elevation_rad, number)
    kept_m = np.where(left_out, np.float32(0), lidar_m)
    # a source alone is not aligned, in the prior either
    mode = "none" if depth_source == "mono" else options.align
    aligned = align(kept_m, mono_m, usable, mode, drive_fit)
    frame = integrate_frame(kept_m, mono_m, usable, depth_source, options, drive_fit, motion, device)
    features = pixel_features(frame.distance_m, frame.spread_m, frame.mono_m, frame.lidar_points, view.theta_rad)
    measured_m, measured = lidar_m, left_out
    if far_seen_m is not None and lidar_points.any():
        highest = np.quantile(view.elevation_rad[lidar_points], ELEVATION_QUANTILES[1]) + np.radians(FIELD_MARGIN_DEG)
        far_seen = usable & (far_seen_m > 0) & ~lidar_points & (view.elevation_rad <= highest)
        measured_m, measured = np.where(far_seen, far_seen_m, lidar_m), left_out | far_seen
    evaluated = _some(measured & (frame.distance_m > 0), _EVALUATED_A_FRAME, rng)
    # of a prior that keeps its points; where none is kept (mono alone), or all are averaged, there is no such pixel
    found, error_by_neighbours = error_of_lidar_points(lidar_m, frame.lidar_points)
    kept = _some(found & options.integration.keep_returns, _EVALUATED_A_FRAME, rng)

    def error(estimate_m: NDArray[np.float32]) -> float | None:
        if not in_blocks.any():
            return None
        return float(np.mean(np.abs(estimate_m[in_blocks] - lidar_m[in_blocks]) / lidar_m[in_blocks]))

    count = int(lidar_points.sum())
    # near the least number those left out decide whose fit it is; the prior has all of them
    fitted = aligned if count >= 2 * LEAST_POINTS else align(lidar_m, mono_m, usable, mode, drive_fit)
    return MeasuredFrame(
        FrameAlignment(name, count, fitted.fit_of, fitted.fit, error(mono_m), error(aligned.mono_m)),
        Errors.of(features, evaluated, frame.distance_m, measured_m),
        Errors({feature: values[kept] for feature, values in features.items()}, error_by_neighbours[kept]),
        view.elevation_rad[usable & (lidar_m > 0)],
        frame.from_motion[evaluated],
    )


def measure_beyond(
    number: int,
    lidar_m: NDArray[np.float32],
    mono_m: NDArray[np.float32],
    usable: NDArray[np.bool_],
    view: RayAngles,
    options: PriorOptions,
    drive_fit: Fit | None,
    motion: MotionMap,
    motion_sigma_m: NDArray[np.float32],
    left_out: NDArray[np.bool_],
    device: torch.device | str = "cpu",
) -> MeasuredBeyond:
    """Measure a frame's prior in the form used where LiDAR does not reach: from motion alone, and from the network.

    Maps are as in `measure_frame`. Distances from motion count alone beyond LiDAR's field; `motion_sigma_m` is their
    standard deviation by parallax and confidence. Where they are `left_out`, the network was not taught; neighbours
    confirm them nevertheless: that is how it is where the prior is used.
    """
    rng = np.random.default_rng([10, number])
    none = np.zeros_like(lidar_m)
    nowhere, everywhere = np.zeros_like(usable), np.ones_like(usable)
    by_motion = dataclasses.replace(motion, mono_counts=nowhere, alone=everywhere, around_m=None)
    given = {"mask": usable, "depth_source": INTEGRATED, "options": options, "drive_fit": drive_fit}
    integrate = partial(integrate_frame, **given, device=device)
    frame = integrate(none, none, motion=by_motion)
    features = pixel_features(frame.distance_m, frame.spread_m, frame.mono_m, frame.lidar_points, view.theta_rad)
    of_motion = motion_features(features, motion.distance_m, motion_sigma_m, view.elevation_rad)
    evaluated = _some(usable & (lidar_m > 0) & frame.from_motion, _EVALUATED_A_FRAME, rng)

    seen = dataclasses.replace(motion, distance_m=np.where(left_out, np.float32(0), motion.distance_m))
    network = integrate(lidar_m, mono_m, motion=seen)
    held_out = _some(usable & left_out & motion.alone & (network.distance_m > 0), _EVALUATED_A_FRAME, rng)

    # as in `measure_frame`, but of two sources
    fewer, _ = held_out_points(both(lidar_m, mono_m, usable), view.elevation_rad, number)
    of_two = integrate(np.where(fewer, np.float32(0), lidar_m), mono_m)
    of_field = pixel_features(of_two.distance_m, of_two.spread_m, of_two.mono_m, of_two.lidar_points, view.theta_rad)
    found = fewer & (of_two.distance_m > 0)
    if motion.around_m is not None:
        # beyond, no other is used
        found &= confirmed(of_two.mono_m, motion.around_m)
    tried = _some(found, _EVALUATED_A_FRAME, rng)
    return MeasuredBeyond(
        Errors.of(of_motion, evaluated, frame.distance_m, lidar_m),
        Errors.of(beyond_features(network, view), held_out, network.distance_m, motion.distance_m),
        Errors.of(of_field, tried, of_two.distance_m, lidar_m),
        motion.distance_m[tried] > 0,
        view.elevation_rad[usable & (motion.distance_m > 0)],
    )


def _some(pixels: NDArray[np.bool_], most: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], ...]:
    """Rows and columns of True pixels, at most so many, drawn evenly."""
    where = np.flatnonzero(pixels)
    if len(where) > most:
        where = rng.choice(where, most, replace=False)
    return np.unravel_index(where, pixels.shape)


def combine(
    frames: Sequence[MeasuredFrame],
    made_of: str,
    everywhere: bool,
    drive_fit: Fit | None = None,
    motion_errors: tuple[float, float] | None = None,
) -> Calibration:
    """Put the measurements of a drive's frames, at least one, together.

    The key `made_of` is kept in the result; `everywhere` says whether the monocular maps are to be trusted beyond
    LiDAR's field of elevation; `drive_fit` is that of `fit_of_drive`. `motion_errors` are the errors of motion and of
    these maps by which motion took part in the frames' priors.
    """
    errors = Errors.together([frame.errors for frame in frames])
    motion = None
    if motion_errors is not None:
        from_motion = np.concatenate([frame.from_motion for frame in frames])
        model = errors.where(from_motion).model()
        # of few pixels without motion nothing would be known
        if np.count_nonzero(~from_motion) >= LEAST_EVALUATED:
            errors = errors.where(~from_motion)
        if model is not None:
            beyond = _combine_beyond([frame.beyond for frame in frames if frame.beyond is not None])
            motion = MotionCalibration(weight_of_errors(*motion_errors), *motion_errors, model, beyond)
    return Calibration(
        made_of=made_of,
        error_model=errors.model(),
        return_model=Errors.together([frame.at_points for frame in frames]).model(),
        field_rad=_field_rad([frame.elevation_rad for frame in frames]),
        everywhere=everywhere,
        drive_fit=drive_fit,
        frames=tuple(frame.alignment for frame in frames),
        motion=motion,
    )


def _combine_beyond(frames: Sequence[MeasuredBeyond]) -> BeyondField | None:
    """Put the frames' measurements beyond LiDAR's field together; None without any."""
    if not frames:
        return None
    motion, network, field = (
        Errors.together([getattr(frame, name) for frame in frames]) for name in ("motion", "network", "field")
    )
    motion_model = fit_error_model(motion.features, motion.relative, MOTION_KNOTS, middle=True)
    network_model = network.model()
    reach_px = 0.0
    if network_model is not None:
        reach_px = float(np.quantile(network.features["nearest_px"], REACH_QUANTILE))
        worse = _unmatched_factor(field, np.concatenate([frame.field_matched for frame in frames]))
        network_model = dataclasses.replace(network_model, log_base=network_model.log_base + np.log(worse))
    return BeyondField(motion_model, network_model, _field_rad([frame.elevation_rad for frame in frames]), reach_px)


def _unmatched_factor(errors: Errors, matched: NDArray[np.bool_]) -> float:
    """How much more a prior without motion is wrong where motion has no distance, all other features alike; 1 or more.

    Not known for few: 1.
    """
    model, unmatched = errors.where(matched).model(), errors.where(~matched)
    if model is None or len(unmatched.relative) < LEAST_EVALUATED:
        return 1.0
    sigma = np.exp(model.log_sigma(unmatched.features))
    return max(1.0, float(np.quantile(unmatched.relative / sigma, 0.95)) / 2)
