"""The vehicle's own masks: those that are given, and those that are found in the pictures.

In fewer than `MIN_PICTURES` pictures, what stays the same proves too little: smooth road stays the same, too. Then a
mask is used only if its outline is clear and the drive's LiDAR agrees: a scanner on the roof measures almost no points
on its own vehicle, and many on the road. On rendered drives of five to nine pictures, LiDAR points per pixel are 5 to
10 % of those around on the vehicle, and 21 % and more on road that was mistaken for it. For a front camera, or a
scanner that looks past the bonnet, this check cannot decide.
"""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.lidar import transform_points
from edge_depth_nerf.masks.ego import MIN_PICTURES, EgoMask, NoEgo, find_ego
from edge_depth_nerf.masks.ego_files import ego_mask_path, keep_ego_mask, vehicles_unknown
from edge_depth_nerf.masks.lens import dark_rim, lens_circle
from edge_depth_nerf.masks.regions import eroded
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.reading import read_if_whole
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, Recording
from edge_depth_nerf.scene.checks import read_camera_mask

_PICTURES = 60
"""The vehicle is searched for in so many pictures of a camera, spread over the drive."""
_RIM_PICTURES = 4
"""The lens's dark rim in so many: what stays dark in different places."""
_FEWEST = 5
"""Pictures that it can be found in with LiDAR's help."""
_FEW_CERTAINTY = 0.9
"""Its outline must be so clear then."""
_FEW_POINTS = 0.15
"""And it may have so many LiDAR points a pixel, as a share of what lies around it."""
_LIDAR_PICTURES = 3
"""The LiDAR points of so many pictures are counted."""
_INNER = 0.01
"""So far inside the outline, as a share of the picture's longer side: scanner and camera do not see quite the same."""

_NOT_FOUND = "nothing is masked as the vehicle."
_LOOK = "Check {}; if you correct it there, process the drive again. --no-find-ego hides nothing as the vehicle."
_UNSEEN = (
    "That is right if the camera does not see the vehicle. Otherwise paint the vehicle black in {} and process again."
)
_PAINT = (
    "Visible parts of the vehicle spoil the training: process more of the drive, or give its mask with --ego-mask "
    "(255 = use the pixel, 0 = the vehicle), or paint it black in {} and process again."
)


def with_given_masks(recording: Recording, options: ProcessOptions) -> Recording:
    """Let the option --ego-mask, if it is given, go before the masks that the drive brings."""
    given = options.ego_mask
    if given is None:
        return recording
    cameras = [
        dataclasses.replace(camera, ego_mask=given / f"{camera.name}.png" if given.is_dir() else given)
        for camera in recording.cameras
    ]
    return dataclasses.replace(recording, cameras=tuple(cameras))


def vehicle_masks(recording: Recording) -> dict[str, NDArray[np.bool_]]:
    """Read the masks that the cameras have, True = use the pixel.

    Raises:
        FileNotFoundError: one is not there.
        InputError: broken, or not of its camera's size.
    """
    with_mask = [(recorded, path) for recorded in recording.cameras if (path := recorded.ego_mask) is not None]
    return {recorded.name: read_camera_mask(path, recorded.camera) for recorded, path in with_mask}


def find_vehicle(
    recording: Recording,
    training: Sequence[RecordedPicture],
    options: ProcessOptions,
    console: Console,
) -> tuple[Recording, list[str]]:
    """Find the masks that are not given in the training pictures, and write them into the scene.

    Returns:
        The recording with all masks' files, and what the user should know.
    """
    cameras, notices = [], []
    not_found: dict[str, list[Path]] = defaultdict(list)
    for recorded in recording.cameras:
        if recorded.ego_mask is None:
            path = ego_mask_path(options.output, recorded.name)
            if not path.is_file() or recorded.name in vehicles_unknown(options.output):
                pictures = [picture for picture in training if picture.camera == recorded.name]
                mask, found = _find_mask(recording, recorded, pictures, options, console)
                keep_ego_mask(options.output, recorded.name, mask, isinstance(found, EgoMask) or found.could_tell)
                if isinstance(found, EgoMask):
                    said = f"the vehicle was detected and hides {found.share:.1%} of the lens."
                    notices.append(f"{recorded.name}: {said} {_LOOK.format(path)}")
                elif found.could_tell:
                    notices.append(f"{recorded.name}: {_NOT_FOUND} {found.reason} {_UNSEEN.format(path)}")
                else:
                    not_found[found.reason].append(path)
            recorded = dataclasses.replace(recorded, ego_mask=path)
        cameras.append(recorded)
    for reason, paths in not_found.items():
        names = ", ".join(path.stem for path in paths)
        notices.append(f"{names}: {_NOT_FOUND} {reason} {_PAINT.format(', '.join(map(str, paths)))}")
    return dataclasses.replace(recording, cameras=tuple(cameras)), notices


def _find_mask(
    recording: Recording,
    recorded: RecordedCamera,
    pictures: Sequence[RecordedPicture],
    options: ProcessOptions,
    console: Console,
) -> tuple[NDArray[np.bool_], EgoMask | NoEgo]:
    """Find the vehicle and the lens's dark rim in a camera's pictures, at their own size; and how it went."""
    camera = recorded.camera
    # a camera may have held-out pictures alone, or none
    numbers = np.unique(np.linspace(0, len(pictures) - 1, _PICTURES).astype(int)) if pictures else ()
    spread = [pictures[number] for number in numbers]
    if not options.strict:
        spread = [picture for picture in spread if read_if_whole(partial(read_image, picture.path)) is not None]
    with console.status("Searching for the vehicle in the pictures"):
        rim = dark_rim(read_image(picture.path) for picture in spread[:: max(len(spread) // _RIM_PICTURES, 1)])
        mask = np.ones((camera.height, camera.width), bool) if rim is None else rim
        lens = lens_circle(camera, options.theta_max_deg) & mask
        loaders = [partial(read_image, picture.path) for picture in spread]
        found = find_ego(loaders, lens)
        if isinstance(found, NoEgo) and not found.could_tell and _FEWEST <= len(spread) and recording.sweeps:
            few = find_ego(loaders, lens, fewest=_FEWEST)
            if isinstance(few, EgoMask) and few.pictures < MIN_PICTURES and few.certainty >= _FEW_CERTAINTY:
                points_of_pixels = _points_of_pixels(recording, recorded, spread)
                found = few if _has_few(points_of_pixels, ~few.keep & lens, few.keep & lens) else found
    return (mask & found.keep if isinstance(found, EgoMask) else mask), found


def _points_of_pixels(
    recording: Recording, recorded: RecordedCamera, pictures: Sequence[RecordedPicture]
) -> Float32[np.ndarray, "h w"]:
    """How many LiDAR points of their own frames' sweeps fall into each pixel of some pictures."""
    camera = recorded.camera
    counts = np.zeros((camera.height, camera.width), np.float32)
    frames = [pictures[index].frame for index in np.linspace(0, len(pictures) - 1, _LIDAR_PICTURES).astype(int)]
    for sweep in recording.sweeps:
        read = read_if_whole(sweep.read) if sweep.frame in frames else None
        if read is None:
            continue
        # on the vehicle itself nothing moves
        to_camera = torch.from_numpy(np.linalg.inv(recorded.to_vehicle) @ sweep.to_vehicle)
        pixels, valid = camera.project(transform_points(to_camera, read.points_m).float())
        column, row = pixels[valid & camera.inside(pixels)].floor().long().numpy().T
        np.add.at(counts, (row, column), 1)
    return counts


def _has_few(
    points_of_pixels: Float32[np.ndarray, "h w"], vehicle: Bool[np.ndarray, "h w"], around: Bool[np.ndarray, "h w"]
) -> bool:
    """Whether the vehicle has far fewer LiDAR points a pixel than the lower half of what lies around it."""
    inner = eroded(vehicle, _INNER * max(vehicle.shape))
    rows = np.flatnonzero((vehicle | around).any(1))
    below = around.copy()
    below[: int(rows.mean())] = False
    if not inner.any() or not points_of_pixels[below].any():
        return False
    return bool(points_of_pixels[inner].mean() <= _FEW_POINTS * points_of_pixels[below].mean())
