"""`edge-depth-nerf camera-path`: a path file for `ns-render camera-path`, in the trained model's coordinates."""

from __future__ import annotations

import math
import shlex
import shutil
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from rich.console import Console

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_json
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras import KannalaBrandt, Pinhole
from edge_depth_nerf.films.options import LARGEST_PX, CameraPathOptions, FilmCamera
from edge_depth_nerf.films.paths import CameraPath, lane_shift, orbit, replay, up_of
from edge_depth_nerf.films.placed import outside, placed, poses_of
from edge_depth_nerf.films.seen import TrainingViews
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

DEFAULT_RATE_HZ = 10.0
"""Used for scenes without times."""
ORBIT_SECONDS = 6.0
LARGEST_FILM_FRAMES = 100_000
UNSEEN_SHARE = 0.1
"""A message warns of a film of whose rays more than this were never recorded."""
RAY_COLUMNS = 24
"""So many rays across a film's picture are asked for what they show."""
KEYFRAMES = 12
"""Number of keyframes. nerfstudio's viewer draws the path through them when it loads the file."""


@dataclass(frozen=True)
class FilmLens:
    """The film's camera, as nerfstudio's path files describe it."""

    width: int
    height: int
    focal_px: float
    """Pixels per unit of tan(angle) (perspective) or per radian (fisheye). Unused for the whole sphere."""

    @property
    def fov_deg(self) -> float:
        """What path files call fov: nerfstudio computes every focal length as height / 2 / tan(fov / 2)."""
        return math.degrees(2 * math.atan(self.height / 2 / self.focal_px))

    def rays(self, camera: FilmCamera) -> Float64[np.ndarray, "rays 3"]:
        """Unit vectors through evenly spread pixels, in the camera (OpenGL's axes)."""
        rows = max(1, round(RAY_COLUMNS * self.height / self.width))
        v, u = ((np.indices((rows, RAY_COLUMNS)).reshape(2, -1) + 0.5).T / (rows, RAY_COLUMNS) - 0.5).T
        if camera == "equirectangular":
            longitude, latitude = 2 * np.pi * u, -np.pi * v
            ahead = np.cos(latitude)
            return np.stack((ahead * np.sin(longitude), np.sin(latitude), -ahead * np.cos(longitude)), axis=1)
        x, y = u * self.width / self.focal_px, -v * self.height / self.focal_px
        radius = np.maximum(np.hypot(x, y), 1e-9)
        theta = np.arctan(radius) if camera == "perspective" else radius
        rays = np.stack((np.sin(theta) * x / radius, np.sin(theta) * y / radius, -np.cos(theta)), axis=1)
        return rays[theta < np.pi]


def write_camera_path(options: CameraPathOptions, console: Console | None = None) -> Path:
    """Write a path file, and print the command that renders the film.

    Returns:
        The file.

    Raises:
        FileNotFoundError: there is no scene, or no config.yml, at the given path.
        InputError: an option, the scene or the training cannot be used.
    """
    options.check()
    console = console or Console()
    if shutil.which("ffmpeg") is None:
        say(
            console,
            "ns-render needs ffmpeg, which is not installed here. Install it before you render: apt-get install "
            "ffmpeg, or brew install ffmpeg.",
            style="yellow",
        )
    scene, to_model = placed(options, console)

    pictures = _followed(scene, options.follow)
    own = own_lens(scene, pictures[0])
    shown = camera_of(options, own)
    options = replace(options, camera=shown)
    options.check()
    drive = CameraPath(_times_s(pictures), poses_of(pictures), up_of(np.stack([p.rotation for p in scene.pictures])))
    lens = film_lens(own, options)
    fps = options.fps or round(drive.frame_rate_hz, 3)
    frames = _frames(drive, options, fps)
    times_s = np.linspace(drive.times_s[0], drive.times_s[-1], frames)
    forward = options.camera != "fisheye"
    where = f"Along {pictures[0].camera}, {drive.duration_s:.1f} s of the drive"
    if options.kind == "replay":
        poses = replay(drive, times_s, forward)
    elif options.kind == "lane-shift":
        poses = lane_shift(drive, times_s, forward, options.shift_m)
        where += f", up to {abs(options.shift_m):g} m to the {'left' if options.shift_m > 0 else 'right'}"
    else:
        points_m = scene.points_m()
        poses, radius_m = orbit(drive, frames, options.ahead_m, options.radius_m, points_m)
        seen = "the scene has no LiDAR points" if points_m is None else "it keeps clear of the LiDAR points"
        where = f"Around a point {options.ahead_m:g} m ahead of the drive's middle, radius {radius_m:.2f} m ({seen})"

    beside = options.load_config.parent
    output = options.output or beside / "camera_paths" / f"{options.kind}_{options.camera}.json"
    write_json(output, path_file(to_model.poses(poses), lens, options, fps))
    if warning := outside(poses, scene):
        say(console, warning, "yellow")
    rays = lens.rays(shown)
    if shown == "fisheye":
        # everybody expects nothing outside the lens's circle
        rays = rays[-rays[:, 2] > math.cos(scene.theta_max_rad)]
    # lengths of other scenes are no metres
    unseen = TrainingViews(scene).unseen_share(poses, rays) if scene.own else 0.0
    if unseen > UNSEEN_SHARE:
        say(
            console,
            f"{unseen:.0%} of the film's rays show what no training picture nearby has in its field and mask: it was "
            "never recorded, and may be anything. A smaller --fov-deg or another --camera or --kind shows less of it.",
            "yellow",
        )
    say(console, f"{where}: {frames} pictures of {lens.width}×{lens.height}, {frames / fps:.1f} s at {fps:g} a second.")
    say(console, f"Path: {output}\nThe film:")
    config = str(options.load_config)
    command = ("ns-render", "camera-path", "--load-config", config, "--camera-path-filename", str(output))
    say(console, f"  {shlex.join((*command, '--output-path', str(output.with_suffix('.mp4'))))}")
    return output


def own_lens(scene: SceneFolder, picture: ScenePicture) -> KannalaBrandt | Pinhole:
    """A picture's lens; of a pinhole beside fisheyes, for which the scene has a stand-in, the pinhole."""
    original = scene.recorded("original_cameras", picture.camera)
    if isinstance(picture.lens, Pinhole) or original.get("model") != Pinhole.model:
        return picture.lens
    return Pinhole(**{entry.name: original[entry.name] for entry in fields(Pinhole) if entry.name in original})


def film_lens(lens: KannalaBrandt | Pinhole, options: CameraPathOptions) -> FilmLens:
    """Return the film's size and focal length: from the options, or else from the drive's own lens.

    Raises:
        InputError: the computed height is out of range.
    """
    camera, own = camera_of(options, lens), lens.width / lens.height
    wide = own if isinstance(lens, Pinhole) else 16 / 9
    aspect = {"fisheye": own, "perspective": wide, "equirectangular": 2.0}[camera]
    width = options.width or _even(2.0 * lens.height if camera == "equirectangular" else float(lens.width))
    height = _even(width / aspect)
    if max(width, height) > LARGEST_PX:
        raise InputError(f"the film would be {width}×{height} px, more than {LARGEST_PX}. Give a smaller --width.")
    if camera == "equirectangular":
        return FilmLens(width, height, height / 2)
    if camera == "perspective":
        # what a wider lens shows beyond would be stretched
        fov_deg = options.fov_deg or (own_fov_deg(lens) if isinstance(lens, Pinhole) else min(own_fov_deg(lens), 90.0))
        return FilmLens(width, height, width / 2 / math.tan(math.radians(fov_deg) / 2))
    if options.fov_deg is None and isinstance(lens, KannalaBrandt):
        return FilmLens(width, height, lens.fx * width / lens.width)
    return FilmLens(width, height, width / math.radians(options.fov_deg or own_fov_deg(lens)))


def camera_of(options: CameraPathOptions, lens: KannalaBrandt | Pinhole) -> FilmCamera:
    """The kind of the film's camera: as asked for, or that of the drive's lens."""
    return options.camera or ("perspective" if isinstance(lens, Pinhole) else "fisheye")


def own_fov_deg(lens: KannalaBrandt | Pinhole) -> float:
    """Angle of view of the drive's lens across the width, degrees."""
    half = lens.width / 2 / lens.fx
    return math.degrees(2 * min(math.atan(half) if isinstance(lens, Pinhole) else half, lens.theta_max_rad))


def path_file(
    camera_to_model: Float64[np.ndarray, "n 4 4"], lens: FilmLens, options: CameraPathOptions, fps: float
) -> dict[str, Any]:
    """Return the path file's content: the film's poses and lens, and keyframes for nerfstudio's viewer."""
    frames = len(camera_to_model)
    seconds = frames / fps
    view = {"fov": lens.fov_deg, "aspect": lens.width / lens.height}
    keyframes = spread_over(frames, KEYFRAMES)
    return {
        "made_by": f"edge-depth-nerf {__version__}",
        "camera_type": options.camera,
        "render_width": lens.width,
        "render_height": lens.height,
        "fps": fps,
        "seconds": seconds,
        "is_cycle": options.kind == "orbit",
        "smoothness_value": 0.0,
        "default_fov": lens.fov_deg,
        "default_transition_sec": seconds / max(1, len(keyframes) - 1),
        "keyframes": [{"matrix": pose.flatten().tolist(), **view} for pose in camera_to_model[keyframes]],
        "camera_path": [{"camera_to_world": pose.flatten().tolist(), **view} for pose in camera_to_model],
    }


def _even(length: float) -> int:
    return max(2, 2 * round(length / 2))


def _frames(drive: CameraPath, options: CameraPathOptions, fps: float) -> int:
    seconds = options.seconds or (ORBIT_SECONDS if options.kind == "orbit" else None)
    # the film is as long as the drive, with its first and its last picture
    frames = round(drive.duration_s * fps) + 1 if seconds is None else round(seconds * fps)
    if not 2 <= frames <= LARGEST_FILM_FRAMES:
        raise InputError(
            f"the film would have {frames} pictures ({fps:g} a second); expected 2 to {LARGEST_FILM_FRAMES}. "
            "Choose other --seconds or --fps."
        )
    return frames


def _followed(scene: SceneFolder, name: str | None) -> tuple[ScenePicture, ...]:
    cameras = scene.cameras()
    if name is None:
        return next(iter(cameras.values()))
    if name not in cameras:
        raise InputError(f"--follow {name}: {scene.path} has no such camera. It has {', '.join(cameras)}.")
    return cameras[name]


def _times_s(pictures: tuple[ScenePicture, ...]) -> Float64[np.ndarray, "n"]:
    known = [picture.timestamp_s for picture in pictures]
    if any(time is None for time in known):
        return np.array([picture.frame / DEFAULT_RATE_HZ for picture in pictures])
    times_s = np.array(known, dtype=np.float64)
    return times_s - times_s[0]
