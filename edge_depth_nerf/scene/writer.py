"""The scene folder, and the one writer of it.

    transforms.json                       nerfstudio's format, with this project's keys beside it; written last
    process.json                          what the scene is made of; written first
    points.ply                            LiDAR of the training frames, coloured, thinned
    images/image_02/0000000123.png        picture
    masks/image_02.png                    what of this camera's pictures is used, 255 = use (lens circle, vehicle)
    masks/image_02/0000000123.png         the same for one frame, where frames have masks of their own
    lidar/image_02/0000000123.png         LiDAR distance map
    mono/image_02/0000000123.png          monocular distance map
    truth/image_02/{distance,rgb}/…       what is really there, in synthetic drives, for evaluation alone
    sweeps/roof/0000000123.npz            a scanner's own rays, see `scene.sweeps`
    truth/image_02/shifted_1m/{distance,rgb}/…   the same from beside the path

Distances are metres along the ray, in 16-bit PNGs of 1/256 m, 0 = none. In memory, poses are camera-to-world with
OpenCV's camera axes, metres, in the recording's own world; in transforms.json they have OpenGL's axes, and the
world is shifted by `world_offset_m`, whole metres near the mean camera: world = scene + world_offset_m.

A run that was interrupted continues: whole files are kept, unless what they are made from is newer.
"""

from __future__ import annotations

import functools
import math
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import run_jobs
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    DISTANCE_STEPS_PER_METRE,
    check_is_folder,
    read_distance_png,
    read_image,
    read_json,
    remove_leftovers,
    write_bytes,
    write_distance_png,
    write_json,
    write_mask,
    write_png,
)
from edge_depth_nerf.base.png import read_png_bytes, read_png_header
from edge_depth_nerf.cameras import Camera, CameraFit, KannalaBrandt, Pinhole, fit_kannala_brandt, host_residual
from edge_depth_nerf.cameras.transforms import Transform, check_rigid, opencv_to_opengl
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.scene.checks import LeftOut, Tolerance
from edge_depth_nerf.scene.format import (
    DEPTH_KEY,
    DISTORTION,
    LAYERS,
    POINTS,
    TRANSFORMS,
    later_layers,
    read_transforms,
)
from edge_depth_nerf.scene.points import PointCloud, merge_parts, write_part
from edge_depth_nerf.scene.sweeps import SCANNERS, SceneScanner

RECORD = "process.json"
LEFT_OUT = "left_out.json"
"""Pictures of the drive that are not in the scene, because one of their files is broken: what is wrong with each."""
WHOLE, INPUTS, INCOMPLETE = "whole_sha256", "inputs_sha256", "some_left_out"
"""Keys of the record: of the files that describe the whole drive, of these with the sizes of all others, and whether
some of those cannot be used."""
CLOUD = "cloud"
"""The layer that becomes points.ply."""

MAX_FIT_RMS_PX = 0.5
"""A camera whose replacement is off by more than this cannot be used."""
_PARTIAL = ".partial"
_BEFORE = ".transforms.before.json"
"""The scene's transforms.json while its maps are being replaced; a run that is stopped leaves it to the next one."""

DistanceMap = Path | NDArray[np.float32] | NDArray[np.float64]
Picture = Path | NDArray[np.uint8]


@dataclass(frozen=True)
class FrameContent:
    """The maps of one frame, at the scene's size: arrays, or files, which are copied unchanged.

    Distances are metres, 0 = none.
    """

    image: Picture
    """H×W×3 RGB."""
    mask: NDArray[np.bool_] | None = None
    """This frame's own mask, True = use; the camera's mask is applied as well."""
    lidar: NDArray[np.float32] | NDArray[np.float64] | None = None
    """What the mask hides is removed."""
    mono: DistanceMap | None = None
    beams: DistanceMap | None = None
    """Of the LiDAR beams that no training sees."""
    truth_distance: DistanceMap | None = None
    truth_rgb: Picture | None = None
    """The picture without noise."""
    cloud: PointCloud | None = None
    """Points for points.ply; of training frames only; those that the mask hides are left out."""


@dataclass(frozen=True)
class SceneCamera:
    """A camera of the scene."""

    name: str
    """Such as image_02; the name of its folders."""
    original: Camera
    """The calibrated camera, at the scene's size."""
    mask: NDArray[np.bool_] | None = None
    """What of its pictures may be used, True = use; the lens circle is applied as well."""


@dataclass(frozen=True)
class SceneFrame:
    """One picture of one camera."""

    camera: str
    frame: int
    camera_to_world: Transform
    """OpenCV's camera axes, the recording's world, metres."""
    content: FrameContent | Callable[[], FrameContent]
    """Its maps, or what loads them when their turn comes; called from several threads at once."""
    timestamp_s: float | None = None
    """Seconds of the recording's own clock."""
    held_out: bool = False
    """Whether it is kept from training. All cameras of a frame should agree."""
    inputs: tuple[Path, ...] = ()
    """Files that a loaded content comes from: if one is newer than what was written, it is written again."""

    @property
    def key(self) -> str:
        """What names it in files: camera and number."""
        return f"{self.camera}/{self.frame:010d}"


@dataclass(frozen=True)
class ShiftedView:
    """A true view from beside the path; fields as of a `SceneFrame`."""

    metres: float
    """How far from the path."""
    camera: str
    frame: int
    camera_to_world: Transform
    content: Callable[[], tuple[Picture, DistanceMap]]
    """Loads the picture and the true distance."""
    inputs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """Something that was asked for and cannot be taken."""

    frame: int
    camera: str | None
    """The camera, or None for all."""
    reason: str


@dataclass(frozen=True)
class ProcessReport:
    """What a converter did."""

    scene: Path
    training: int
    held_out: int
    written: int
    """Pictures whose files were written now; the others were there already."""
    fits: dict[str, CameraFit]
    """How far nerfstudio's rays of each camera are off, in pixels."""
    mask_share: dict[str, float]
    """Which part of each camera's pictures is used, 0 to 1."""
    skipped: tuple[Skipped, ...] = ()
    """Frames that were asked for and that the drive does not have."""
    left_out: tuple[LeftOut, ...] = ()
    """What is broken or missing, and so not in the scene."""
    notices: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    """What seems to be wrong with the recording."""


def summarise(skipped: Iterable[Skipped]) -> str:
    """Group frames left out by the reason: "no pose: 0, 7-9"."""
    groups: dict[str, list[int]] = {}
    for item in skipped:
        reason = item.reason if item.camera is None else f"{item.reason} of {item.camera}"
        groups.setdefault(reason, []).append(item.frame)
    return "; ".join(f"{reason}: {ranges(frames)}" for reason, frames in groups.items())


def ranges(frames: Sequence[int]) -> str:
    """Shorten numbers in order: "0, 7-9"."""
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = frame
        else:
            runs.append([frame, frame])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs)


def best_holdout(count: int) -> int:
    """Give the `holdout_every` that holds out one of `count` frames or more: 8, or less for very short drives.

    Of a single frame nothing can be held out.
    """
    return max(2, min(8, 2 * count - 1))


def held_out_frames(count: int, holdout_every: int) -> list[bool]:
    """Decide which of `count` frames, in order, are held out: the middle one of every `holdout_every`; 0 = none."""
    return [holdout_every > 0 and index % holdout_every == holdout_every // 2 for index in range(count)]


def write_scene(
    output: Path,
    cameras: Sequence[SceneCamera],
    frames: Sequence[SceneFrame],
    *,
    layers: Collection[str],
    source: Mapping[str, Any],
    theta_max_deg: float = 95.0,
    shifted: Sequence[ShiftedView] = (),
    scanners: Sequence[SceneScanner] = (),
    strict: bool = True,
    console: Console | None = None,
) -> ProcessReport:
    """Write a scene folder, or continue one.

    Args:
        output: the folder; new, empty, or begun from the same `source`.
        cameras: the cameras, of any models. A scene has one of nerfstudio's: OPENCV if all are pinholes, else
            OPENCV_FISHEYE, with a fitted camera in the place of each MEI and pinhole.
        frames: the pictures, in any order.
        layers: which of `LAYERS` every frame's content holds; "cloud" for points.ply.
        source: what the scene is made of, as JSON; decides whether a folder that exists is the same scene.
        theta_max_deg: rays further from the axis are masked out; less, where a camera's own range ends before.
        shifted: true views from beside the path.
        scanners: whose rays are in the folder already.
        strict: a frame whose content cannot be read is an error; otherwise it is left out, up to a tenth of them.
        console: where progress is shown.

    Raises:
        InputError: the cameras, frames or maps cannot make a scene, or the folder holds something else.
    """
    console = console or Console()
    by_name = {camera.name: camera for camera in cameras}
    frames = sorted(frames, key=lambda frame: (frame.camera, frame.frame))
    _check(by_name, cameras, frames, shifted, layers, theta_max_deg)
    fits = _fits(cameras, theta_max_deg)
    masks = {camera.name: _camera_mask(camera, theta_max_deg) for camera in cameras}
    offset = world_offset_m(frames)

    open_scene(output, source)
    for name, mask in masks.items():
        write_mask(output / f"masks/{name}.png", mask)
    tolerance = Tolerance(strict, len(frames))
    # what an earlier run left out is left out again, as long as none of its files has changed
    broken = _broken_before(output, frames)
    for frame in frames:
        if frame.key in broken:
            tolerance.add(frame.frame, frame.camera, InputError(broken[frame.key]))
    frames = [frame for frame in frames if frame.key not in broken]
    later, work, notices = _kept_later_maps(output, frames, shifted, layers)
    jobs = [
        # the cameras of a frame one after another: they share its sweeps
        *(
            partial(_try_frame, tolerance, output, frame, masks[frame.camera], layers, offset)
            for frame in sorted(work.frames, key=lambda frame: (frame.frame, frame.camera))
        ),
        *(partial(_write_shifted, output, view, by_name[view.camera].original) for view in work.shifted),
    ]
    if jobs:
        # a reader is not to find a scene whose maps are being replaced
        if (output / TRANSFORMS).is_file():
            (output / TRANSFORMS).replace(output / _BEFORE)
        run_jobs(jobs, "Writing the scene", console)
    left_out = {(item.camera, item.frame) for item in tolerance.left_out}
    frames = [frame for frame in frames if (frame.camera, frame.frame) not in left_out]
    _check_split(frames)
    if work.cloud and not merge_parts(
        [output / _cloud_path(frame) for frame in frames if not frame.held_out], output / POINTS
    ):
        raise InputError(
            f"{output}: no LiDAR point lies in any training picture. Check the calibration from the scanner to "
            "the cameras, and the masks (255 = use the pixel)."
        )
    content = _transforms(cameras, fits, frames, shifted, layers, offset, theta_max_deg, source)
    if scanners:
        content[SCANNERS] = {scanner.name: scanner.entry(output) for scanner in scanners}
    for name, (entry, files) in later.items():
        content[name] = entry
        for frame in content["frames"]:
            frame[LAYERS[name].key] = files[frame["file_path"]]
    _keep_left_out(output, tolerance)
    write_json(output / TRANSFORMS, content)
    (output / _BEFORE).unlink(missing_ok=True)
    shutil.rmtree(output / _PARTIAL, ignore_errors=True)

    held_out = sum(frame.held_out for frame in frames)
    return ProcessReport(
        scene=output,
        training=len(frames) - held_out,
        held_out=held_out,
        written=len(work.frames),
        fits=fits,
        mask_share={name: float(mask.mean()) for name, mask in masks.items()},
        left_out=tolerance.left_out,
        notices=tuple(notices),
    )


def world_offset_m(frames: Sequence[SceneFrame]) -> Float64[np.ndarray, "3"]:
    """Give the scene's origin in the recording's world: whole metres near the mean camera."""
    # adding zero turns -0.0 into 0.0
    return np.round(np.mean([frame.camera_to_world[:3, 3] for frame in frames], axis=0)) + 0.0


def _keep_left_out(output: Path, tolerance: Tolerance) -> None:
    """Write down what is left out and why, for the next run."""
    path = output / LEFT_OUT
    if not tolerance.left_out:
        path.unlink(missing_ok=True)
        return
    faults = {f"{item.camera}/{item.frame:010d}": item.fault for item in tolerance.left_out}
    if not path.is_file() or read_json(path) != faults:
        write_json(path, faults)


# ---- checks ----------------------------------------------------------------------------------------------------


def _check(
    by_name: dict[str, SceneCamera],
    cameras: Sequence[SceneCamera],
    frames: Sequence[SceneFrame],
    shifted: Sequence[ShiftedView],
    layers: Collection[str],
    theta_max_deg: float,
) -> None:
    if not 0 < theta_max_deg <= 180:
        raise InputError(f"theta_max_deg is {theta_max_deg}; expected degrees from the axis, above 0, up to 180.")
    if unknown := set(layers) - {*LAYERS, CLOUD}:
        raise InputError(f"unknown layers {sorted(unknown)}; expected some of {', '.join((*LAYERS, CLOUD))}.")
    _check_split(frames)
    if len(by_name) != len(cameras):
        raise InputError(f"two cameras have one name: {', '.join(camera.name for camera in cameras)}.")
    for name in by_name:
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise InputError(f"camera {name!r}: expected a name of letters, digits, _ and -; it becomes a folder.")
    for camera in cameras:
        if camera.mask is not None:
            size = (camera.original.height, camera.original.width)
            _check_size(f"the mask of camera {camera.name}", camera.mask.shape, size)
    for item in (*frames, *shifted):
        where = f"frame {item.frame} of {item.camera}"
        if item.camera not in by_name:
            raise InputError(f"{where}: no such camera; there are {', '.join(by_name)}.")
        check_rigid(item.camera_to_world, f"{where}: camera_to_world")
    twice = [key for key, count in Counter((frame.camera, frame.frame) for frame in frames).items() if count > 1]
    if twice:
        raise InputError(f"frame {twice[0][1]} of {twice[0][0]} is given twice.")


def _check_split(frames: Sequence[SceneFrame]) -> None:
    if not frames:
        raise InputError("no frames to make a scene of.")
    if all(frame.held_out for frame in frames):
        raise InputError("all frames are held out; no frame is left for training.")


def _check_size(what: str, found: tuple[int, ...], expected: tuple[int, int]) -> None:
    if found != expected:
        raise InputError(
            f"{what}: {'×'.join(map(str, reversed(found[:2])))} pixels, expected {expected[1]}×{expected[0]} as its "
            "camera has. Make it in the size of the pictures."
        )


def open_scene(output: Path, source: Mapping[str, Any]) -> None:
    """Begin the folder, or make sure that it was begun from the same things.

    Raises:
        InputError: it holds something else, or cannot be written.
    """
    record = {"made_by": f"edge-depth-nerf {__version__}", **source}
    path = output / RECORD
    check_is_folder(output)
    remove_leftovers(output)
    if path.is_file():
        there = read_json(path)
        there = there if isinstance(there, dict) else {}
        differing = [key for key in dict.fromkeys((*record, *there)) if there.get(key) != record.get(key)]
        if WHOLE not in there:
            # as a version before wrote it
            differing = [key for key in differing if key not in (WHOLE, INCOMPLETE)]
        some_left_out = there.get(INCOMPLETE) is True or (output / LEFT_OUT).is_file()
        # what was left out may have been repaired; which pictures that concerns, their own files tell
        repaired = WHOLE in there and some_left_out and {*differing} <= {INPUTS, INCOMPLETE}
        # a run that failed before it wrote anything does not bind the next one
        begun = any(entry.name != RECORD for entry in output.iterdir())
        if differing and begun and not repaired:
            key = differing[0]
            others = f" (also: {', '.join(differing[1:])})" if differing[1:] else ""
            raise InputError(
                f"{output}: contains another scene: {key} is {there.get(key)!r} there, {record.get(key)!r} "
                f"now{others}. Give another --output, or delete that folder first."
            )
        if there != record:
            write_json(path, record)
        return
    if output.is_dir() and (foreign := sorted(entry.name for entry in output.iterdir())):
        raise InputError(
            f"{output}: holds {', '.join(foreign[:5])}{' …' if len(foreign) > 5 else ''} and no {RECORD}: this "
            "command did not create it. Give another --output, or empty that folder first."
        )
    try:
        output.mkdir(parents=True, exist_ok=True)
        write_json(path, record)
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror}). Give another --output.") from error


# ---- cameras ---------------------------------------------------------------------------------------------------


def check_cameras(cameras: Sequence[SceneCamera], theta_max_deg: float) -> None:
    """Check that a scene can have these cameras and masks, before anything is written.

    Raises:
        InputError: nerfstudio has no camera that is near enough to one, or its mask hides everything.
    """
    _fits(cameras, theta_max_deg)
    for camera in cameras:
        _camera_mask(camera, theta_max_deg)


def _fits(cameras: Sequence[SceneCamera], theta_max_deg: float) -> dict[str, CameraFit]:
    """Find the cameras that nerfstudio knows, and how far they are from the originals."""
    fisheye = any(not isinstance(camera.original, Pinhole) for camera in cameras)
    return {camera.name: _scene_camera(camera, math.radians(theta_max_deg), fisheye) for camera in cameras}


def _scene_camera(camera: SceneCamera, theta_max_rad: float, fisheye: bool) -> CameraFit:
    """Find the camera that takes the place of one, as an OPENCV_FISHEYE camera or an OPENCV camera."""
    original = camera.original
    try:
        fit, wrong_rad = _replaced(original, theta_max_rad, fisheye)
    except InputError as error:
        fault = str(error)
    else:
        if fit.rms_px <= MAX_FIT_RMS_PX:
            return fit
        off = f"by {fit.rms_px:.2f} px rms up to {math.degrees(fit.theta_max_rad):.0f}°"
        if math.isinf(fit.rms_px):
            off = f"without bound from {math.degrees(wrong_rad):.1f}° on, where nerfstudio's iteration diverges"
        fault = (
            f"nerfstudio's {'fisheye' if fisheye else 'pinhole'} camera differs from this {original.model} camera {off}"
        )
    remedy = "Check its calibration."
    if (usable_deg := _usable_deg(original, theta_max_rad, fisheye)) is not None:
        remedy = f"Use --theta-max-deg {usable_deg}, up to which it fits."
        if isinstance(original, Pinhole) and fisheye:
            remedy += (
                " Or limit only this camera, with theta_max_deg in a rig file. Or make a scene of the pinhole "
                "cameras only, where they stay unchanged."
            )
    raise InputError(
        f"camera {camera.name}: {fault.rstrip('.')}; at most {MAX_FIT_RMS_PX} px rms can be used. {remedy}"
    )


@functools.lru_cache(maxsize=64)
def _replaced(original: Camera, theta_max_rad: float, fisheye: bool) -> tuple[CameraFit, float]:
    """Find the camera for nerfstudio, the residual of its rays, and the angle where one is wrong."""
    limit_rad = min(theta_max_rad, original.theta_max_rad)
    if isinstance(original, KannalaBrandt):
        replacement = _off_pixel_centre(original)
    elif isinstance(original, Pinhole) and not fisheye:
        replacement = original
    else:
        replacement = _off_pixel_centre(_rounded(fit_kannala_brandt(original, limit_rad).camera))
    return host_residual(original, replacement, limit_rad)


def _usable_deg(original: Camera, theta_max_rad: float, fisheye: bool) -> int | None:
    """The largest multiple of 5° up to which the camera can be used; None = not even to 20°."""
    limit_deg = math.degrees(min(theta_max_rad, original.theta_max_rad))
    for angle_deg in range(math.ceil(limit_deg / 5) * 5 - 5, 15, -5):
        try:
            if _replaced(original, math.radians(angle_deg), fisheye)[0].rms_px <= MAX_FIT_RMS_PX:
                return angle_deg
        except InputError:
            continue
    return None


def _rounded(camera: KannalaBrandt | Pinhole) -> KannalaBrandt:
    """Keep nine digits: the last ones of a fit depend on how its sums were shared among threads."""
    assert isinstance(camera, KannalaBrandt)
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")
    rounded: dict[str, Any] = {name: float(f"{getattr(camera, name):.9g}") for name in names}
    return replace(camera, **rounded)


def _off_pixel_centre(camera: KannalaBrandt) -> KannalaBrandt:
    """Move the principal point off a pixel's centre: nerfstudio's fisheye ray is 0/0 exactly there."""
    if all(abs(place - 0.5 - round(place - 0.5)) < 5e-4 for place in (camera.cx, camera.cy)):
        return replace(camera, cx=round(camera.cx - 0.5) + 0.501)
    return camera


def _camera_mask(camera: SceneCamera, theta_max_deg: float) -> NDArray[np.bool_]:
    """Lens circle and the camera's own mask."""
    mask = lens_circle(camera.original, theta_max_deg)
    if camera.mask is not None:
        mask &= camera.mask
    if not mask.any():
        raise InputError(
            f"the mask of camera {camera.name} leaves no pixel within {theta_max_deg:g}° of the axis. In mask files "
            "255 = use the pixel, 0 = ignore it: is it inverted?"
        )
    return mask


# ---- the files of a frame --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Work:
    frames: list[SceneFrame]
    shifted: list[ShiftedView]
    cloud: bool


def _file(folder: str, camera: str, frame: int) -> str:
    return f"{folder.format(camera=camera)}/{frame:010d}.png"


def _frame_files(frame: SceneFrame, layers: Collection[str]) -> dict[str, str]:
    """Paths in the scene of the frame's maps, by layer."""
    return {
        name: _file(layer.folder, frame.camera, frame.frame)
        for name, layer in LAYERS.items()
        if name == "image" or name in layers
    }


def _shifted_files(view: ShiftedView) -> tuple[str, str]:
    folder = f"truth/{{camera}}/shifted_{view.metres:g}m"
    return (_file(f"{folder}/rgb", view.camera, view.frame), _file(f"{folder}/distance", view.camera, view.frame))


def _cloud_path(frame: SceneFrame) -> str:
    return f"{_PARTIAL}/{frame.camera}/{frame.frame:010d}.npz"


def _modified_ns(path: Path, or_copied: bool = False) -> int:
    try:
        found = path.stat()
    except FileNotFoundError:
        return 0
    return max(found.st_mtime_ns, found.st_ctime_ns) if or_copied else found.st_mtime_ns


def _broken_before(output: Path, frames: Sequence[SceneFrame]) -> dict[str, str]:
    """Which frames an earlier run left out, and why, as far as none of their files has changed since."""
    path = output / LEFT_OUT
    if not path.is_file():
        return {}
    found, written_ns = read_json(path), _modified_ns(path)
    return {
        frame.key: str(found[frame.key])
        for frame in frames
        if isinstance(found, dict)
        and frame.key in found
        # a copy may keep the date of its content, but not that of its file
        and max((_modified_ns(file, or_copied=True) for file in frame.inputs), default=0) < written_ns
    }


def _pending(
    output: Path, frames: Sequence[SceneFrame], shifted: Sequence[ShiftedView], layers: Collection[str]
) -> _Work:
    """Find what is missing, or older than what it is made from."""

    def fresh(files: Collection[str], inputs: tuple[Path, ...]) -> bool:
        newest = max((_modified_ns(path) for path in inputs), default=0)
        return all(_modified_ns(output / file) > newest for file in files)

    def is_stale(frame: SceneFrame, with_cloud: bool) -> bool:
        files = [*_frame_files(frame, layers).values(), *([_cloud_path(frame)] if with_cloud else [])]
        # content given in memory has no date
        return not (callable(frame.content) and fresh(files, frame.inputs))

    training = [frame for frame in frames if not frame.held_out]
    training_inputs = tuple(path for frame in training for path in frame.inputs)
    cloud = CLOUD in layers and (
        not fresh([POINTS], training_inputs) or any(is_stale(frame, with_cloud=False) for frame in training)
    )
    stale = [frame for frame in frames if is_stale(frame, with_cloud=cloud and not frame.held_out)]
    return _Work(stale, [view for view in shifted if not fresh(_shifted_files(view), view.inputs)], cloud)


def _try_frame(
    tolerance: Tolerance,
    output: Path,
    frame: SceneFrame,
    camera_mask: NDArray[np.bool_],
    layers: Collection[str],
    offset: Float64[np.ndarray, "3"],
) -> None:
    """Write a frame, or leave it out, without any file of it."""
    try:
        _write_frame(output, frame, camera_mask, layers, offset)
    except (InputError, FileNotFoundError) as error:
        tolerance.add(frame.frame, frame.camera, error)
        for file in (*_frame_files(frame, layers).values(), _cloud_path(frame)):
            (output / file).unlink(missing_ok=True)


def _write_frame(
    output: Path,
    frame: SceneFrame,
    camera_mask: NDArray[np.bool_],
    layers: Collection[str],
    offset: Float64[np.ndarray, "3"],
) -> None:
    content = frame.content() if callable(frame.content) else frame.content
    where = f"frame {frame.frame} of {frame.camera}"
    files = {layer: output / file for layer, file in _frame_files(frame, layers).items()}
    size = (camera_mask.shape[0], camera_mask.shape[1])
    for layer in files:
        if getattr(content, layer) is None:
            raise InputError(
                f"{where}: has no {layer}, but every other frame of this scene has one. Give it for all or none."
            )

    mask, words = camera_mask, {layer: f"{where}: its {LAYERS[layer].words.removesuffix('s')}" for layer in files}
    if "mask" in files and content.mask is not None:
        _check_size(words["mask"], content.mask.shape, size)
        mask = camera_mask & content.mask
        write_mask(files["mask"], mask)
    if "lidar" in files and content.lidar is not None:
        _check_size(words["lidar"], content.lidar.shape, size)
        write_distance_png(files["lidar"], np.where(mask, content.lidar, 0.0))
    for layer in (layer for layer in files if layer not in ("mask", "lidar")):
        is_distance = LAYERS[layer].kind == "distance"
        _write_map(files[layer], getattr(content, layer), size, words[layer], distance=is_distance)
    if CLOUD in layers and not frame.held_out:
        if content.cloud is None:
            raise InputError(f"{where}: has no cloud, but every other training frame of this scene has one.")
        write_part(output / _cloud_path(frame), content.cloud, mask, offset)


def _write_shifted(output: Path, view: ShiftedView, camera: Camera) -> None:
    picture, distance = view.content()
    where = f"frame {view.frame} of {view.camera}, shifted by {view.metres:g} m"
    size = (camera.height, camera.width)
    picture_file, distance_file = _shifted_files(view)
    _write_map(output / picture_file, picture, size, where, distance=False)
    _write_map(output / distance_file, distance, size, where, distance=True)


def _write_map(path: Path, content: Picture | DistanceMap, size: tuple[int, int], what: str, *, distance: bool) -> None:
    """Write a picture or a distance map; a file that is as it must be is copied unchanged."""
    if isinstance(content, Path):
        what = f"{what} {content}"
        if distance or content.suffix.lower() == ".png":
            header = read_png_header(content)
            if (header.height, header.width) == size and (header.is_distance if distance else header.is_picture):
                write_bytes(path, read_png_bytes(content))
                return
        content = read_distance_png(content) if distance else read_image(content)
    _check_size(what, content.shape[:2], size)
    (write_distance_png if distance else write_png)(path, content)


# ---- transforms.json -------------------------------------------------------------------------------------------


def _kept_later_maps(
    output: Path, frames: Sequence[SceneFrame], shifted: Sequence[ShiftedView], layers: Collection[str]
) -> tuple[dict[str, tuple[Any, dict[str, str]]], _Work, list[str]]:
    """Find which maps that were put in since the scene was written still fit the pictures, and what is to be written.

    Of the maps, by layer, it gives where they come from, and the file of each picture's.
    """
    work, notices, kept = _pending(output, frames, shifted, layers), [], {}
    path = output / TRANSFORMS
    fresh = path.is_file() and not (work.frames or work.shifted)
    if not path.is_file():
        path = output / _BEFORE
    there = read_transforms(path) if path.is_file() else {}
    for name in filter(later_layers().__contains__, there):
        files = {frame["file_path"]: frame.get(LAYERS[name].key) for frame in there["frames"]}
        needed = [files.get(_frame_files(frame, ())["image"]) for frame in frames]
        if fresh and all(file is not None and (output / file).is_file() for file in needed):
            kept[name] = there[name], files
            continue
        remedy = "Add them again."
        if name == "mono":
            remedy = "Those of the drive's own network are made again. Add others again with `edge-depth-nerf "
            remedy += "estimate-depth`."
        elif name.startswith("motion"):
            remedy = "They are made again, unless --no-motion is given."
        of_what = "estimated monocular maps" if name == "mono" else f"{LAYERS[name].words} put in later"
        notices.append(
            f"The {of_what} of this scene are removed: one is missing, or pictures or masks are new. {remedy}"
        )
        if name in layers and path.name == TRANSFORMS:
            # in their places belong the drive's, some of which a run that was stopped may have written since
            for frame in frames:
                (output / _frame_files(frame, layers)[name]).unlink(missing_ok=True)
            work = _pending(output, frames, shifted, layers)
    return kept, work, notices


def _transforms(
    cameras: Sequence[SceneCamera],
    fits: Mapping[str, CameraFit],
    frames: Sequence[SceneFrame],
    shifted: Sequence[ShiftedView],
    layers: Collection[str],
    offset: Float64[np.ndarray, "3"],
    theta_max_deg: float,
    source: Mapping[str, Any],
) -> dict[str, Any]:
    any_fisheye = any(isinstance(fit.camera, KannalaBrandt) for fit in fits.values())
    images = {held_out: [_frame_files(f, ())["image"] for f in frames if f.held_out == held_out] for held_out in (0, 1)}
    evaluation = images[True] or images[False]
    content: dict[str, Any] = {
        "camera_model": "OPENCV_FISHEYE" if any_fisheye else "OPENCV",
        "depth_unit_scale_factor": 1 / DISTANCE_STEPS_PER_METRE,
        "theta_max_deg": theta_max_deg,
        "world_offset_m": offset.tolist(),
        "source": {"made_by": f"edge-depth-nerf {__version__}", **source},
        "original_cameras": {camera.name: camera.original.to_dict() for camera in cameras},
        "camera_fits": {
            name: {
                "rms_px": round(fit.rms_px, 6),
                "max_px": round(fit.max_px, 6),
                "theta_max_deg": math.degrees(fit.theta_max_rad),
            }
            for name, fit in fits.items()
        },
        "frames": [_frame_entry(frame, fits[frame.camera].camera, layers, offset) for frame in frames],
        "train_filenames": images[False],
        "val_filenames": evaluation,
        "test_filenames": evaluation,
    }
    if CLOUD in layers:
        content["ply_file_path"] = POINTS
    if shifted:
        content["shifted_views"] = defaultdict(list)
        for item in sorted(shifted, key=lambda item: (item.metres, item.camera, item.frame)):
            content["shifted_views"][f"{item.metres:g}"].append(_shifted_entry(item, offset))
    return content


def _matrix(camera_to_world: Transform, offset: Float64[np.ndarray, "3"]) -> list[list[float]]:
    """A pose as transforms.json has it: OpenGL's camera axes, the scene's origin."""
    moved = camera_to_world.copy()
    moved[:3, 3] -= offset
    return opencv_to_opengl(moved).tolist()


def _frame_entry(
    frame: SceneFrame, camera: KannalaBrandt | Pinhole, layers: Collection[str], offset: Float64[np.ndarray, "3"]
) -> dict[str, Any]:
    files = _frame_files(frame, layers)
    found: dict[str, Any] = {
        "file_path": files["image"],
        "transform_matrix": _matrix(frame.camera_to_world, offset),
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        **{name: getattr(camera, name) for name in ("cx", "cy", *DISTORTION)},
        "mask_path": f"masks/{frame.camera}.png",
    }
    found |= {LAYERS[layer].key: file for layer, file in files.items() if layer != "image"}
    if "lidar" in layers:
        found[DEPTH_KEY] = files["lidar"]
    found |= {"camera": frame.camera, "frame": frame.frame}
    if frame.timestamp_s is not None:
        found["timestamp_s"] = frame.timestamp_s
    return found


def _shifted_entry(view: ShiftedView, offset: Float64[np.ndarray, "3"]) -> dict[str, Any]:
    picture, distance = _shifted_files(view)
    return {
        "camera": view.camera,
        "frame": view.frame,
        "transform_matrix": _matrix(view.camera_to_world, offset),
        LAYERS["truth_rgb"].key: picture,
        LAYERS["truth_distance"].key: distance,
    }
