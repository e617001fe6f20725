"""Pictures of scenes at the network's size, with their rays, masks and LiDAR, held in memory for training.

All pictures stand in arrays of one size: smaller ones lie in the upper left corner, the rest is not usable. Distances
are metres along the ray, 0 = none; masks True = use; rays unit vectors in the camera's frame (x right, y down, z
forward), zeros where a pixel has none.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy.typing import NDArray

from edge_depth_nerf.cameras import KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

FarSeen = Callable[[ScenePicture, tuple[int, int]], NDArray[np.float32]]
"""Gives for a picture, at (width, height), distances along the ray, 0 = none."""
Taught = Callable[[ScenePicture], tuple[NDArray[np.float32], NDArray[np.float32]] | None]
"""Gives for a picture, at its own size, distances along the ray and their weights, 0 = none; or nothing."""
LARGEST_SET_BYTES = 8 << 30
"""More pictures than fit in this are thinned evenly."""
_GROUND_SINE = -math.sin(math.radians(12.0))
"""LiDAR points below this elevation are mostly of the ground."""
_GROUND_QUANTILE = 0.8
"""Of how far LiDAR points lie below the camera: kerbs and parked cars lie less deep, nothing much deeper."""
_MIN_GROUND_POINTS = 100


@dataclass(frozen=True)
class Examples:
    """Pictures to train on or to evaluate on."""

    rgb: UInt8[np.ndarray, "n h w 3"]
    lidar_m: Float32[np.ndarray, "n h w"]
    usable: Bool[np.ndarray, "n h w"]
    rays: Float32[np.ndarray, "lenses h w 3"]
    """Of each lens; pictures of one lens share them."""
    lens: NDArray[np.int64]
    """Which of them, by picture."""
    up_in_camera: Float32[np.ndarray, "n 3"]
    camera_height_m: Float32[np.ndarray, "n"]
    weight: Float32[np.ndarray, "n h w"] | None = None
    """How much each distance of `lidar_m` counts, 0 to 1: those from motion less than LiDAR points. None: all alike."""

    def __len__(self) -> int:
        return len(self.rgb)


def fingerprint(arrays: Mapping[str, np.ndarray | None]) -> str:
    """What tells some arrays with names from others."""
    digest = hashlib.sha256()
    for name, values in arrays.items():
        if values is not None:
            digest.update(f"{name}{values.dtype}{values.shape}".encode())
            digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()[:32]


def working_size(width: int, height: int, working_px: int) -> tuple[int, int]:
    """Width and height at which the network sees a picture: its longer side no longer than `working_px`."""
    longer = max(width, height)
    if longer <= working_px:
        return width, height
    return max(round(width * working_px / longer), 1), max(round(height * working_px / longer), 1)


def network_view(
    scene: SceneFolder, picture: ScenePicture, working_px: int, masked: bool = True
) -> tuple[Float32[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Rays and mask of a picture at the network's size; without its mask all that the lens sees is usable."""
    size = working_size(picture.lens.width, picture.lens.height, working_px)
    found = rays(scaled_lens(picture.lens, size), scene.theta_max_rad)
    usable, mask = found.within, scene.mask(picture) if masked else None
    if mask is not None:
        # a pixel that a masked one is mixed into is masked as well
        usable = usable & (cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999)
    return found.directions, usable


def scaled_lens(lens: KannalaBrandt | Pinhole, size: tuple[int, int]) -> KannalaBrandt | Pinhole:
    """The lens of the same picture scaled to (width, height)."""
    x, y = size[0] / lens.width, size[1] / lens.height
    return dataclasses.replace(
        lens, width=size[0], height=size[1], fx=lens.fx * x, fy=lens.fy * y, cx=lens.cx * x, cy=lens.cy * y
    )


def load_examples(
    scenes: Sequence[SceneFolder],
    chosen: Sequence[Sequence[ScenePicture]],
    heights_m: Sequence[Mapping[str, float]],
    working_px: int,
    multiple_px: int,
    advance: Callable[[], None] = lambda: None,
    far_seen: Sequence[FarSeen] | None = None,
    by_motion: Sequence[Taught | None] | None = None,
) -> Examples:
    """Read the chosen pictures of each scene into memory, with `advance` called after each.

    The heights are those of each scene's cameras above the ground; `working_px` is the longer side at the network, and
    both sides of the arrays are multiples of `multiple_px`. Where a picture has no LiDAR point, `far_seen` gives more
    distances (see `mono.far_seen`), and where there is still none `by_motion` (see `mono.motion_seen`; None for a scene
    without).

    Raises:
        InputError: a file cannot be decoded, or has another size than its camera.
    """
    sizes = [working_size(p.lens.width, p.lens.height, working_px) for pictures in chosen for p in pictures]
    width, height = (-(-max(side) // multiple_px) * multiple_px for side in zip(*sizes, strict=True))
    count = len(sizes)
    rgb = np.zeros((count, height, width, 3), np.uint8)
    lidar_m = np.zeros((count, height, width), np.float32)
    usable = np.zeros((count, height, width), bool)
    weight = np.ones((count, height, width), np.float32) if by_motion and any(by_motion) else None
    ups, heights, lenses = np.zeros((count, 3), np.float32), np.zeros(count, np.float32), np.zeros(count, np.int64)
    rays_of: dict[object, tuple[int, np.ndarray]] = {}
    index = 0
    for number, (scene, pictures, height_m) in enumerate(zip(scenes, chosen, heights_m, strict=True)):
        for picture in pictures:
            directions, used = network_view(scene, picture, working_px)
            rows, columns = used.shape
            part = (index, slice(0, rows), slice(0, columns))
            rgb[part] = small_picture(scene, picture, (columns, rows))
            known_m = reduced(scene.lidar_m(picture), used)
            if far_seen is not None:
                # at twice the size it is told better what is hidden
                twice = working_size(picture.lens.width, picture.lens.height, 2 * working_px)
                known_m = np.where(known_m > 0, known_m, reduced(far_seen[number](picture, twice), used))
            of_motion = by_motion[number] if by_motion is not None else None
            if of_motion is not None and weight is not None and (found := of_motion(picture)) is not None:
                motion_m, of_each = (reduced(values, used) for values in found)
                weight[part] = np.where(known_m > 0, np.float32(1), of_each)
                known_m = np.where(known_m > 0, known_m, motion_m)
            lidar_m[part] = known_m
            usable[part] = used
            key = (picture.lens, scene.theta_max_rad)
            if key not in rays_of:
                padded = np.zeros((height, width, 3), np.float32)
                padded[:rows, :columns] = directions
                rays_of[key] = (len(rays_of), padded)
            lenses[index] = rays_of[key][0]
            ups[index], heights[index] = picture.up_in_camera, height_m[picture.camera]
            index += 1
            advance()
    all_rays = np.stack([padded for _, padded in rays_of.values()])
    return Examples(rgb, lidar_m, usable, all_rays, lenses, ups, heights, weight)


def small_picture(scene: SceneFolder, picture: ScenePicture, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture averaged down to (width, height)."""
    return np.asarray(cv2.resize(scene.rgb(picture), size, interpolation=cv2.INTER_AREA), np.uint8)


def reduced(
    lidar_m: Float32[np.ndarray, "rows columns"], usable: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """A sparse map at the size of a view: of the values in a pixel the one nearest to its centre."""
    full_rows, full_columns = lidar_m.shape
    rows, columns = usable.shape
    row, column = np.nonzero(lidar_m)
    y, x = (row + 0.5) * rows / full_rows, (column + 0.5) * columns / full_columns
    small_row, small_column = y.astype(np.int64), x.astype(np.int64)
    off_centre = np.hypot(y - small_row - 0.5, x - small_column - 0.5)
    farthest_first = np.argsort(-off_centre, kind="stable")
    small = np.zeros((rows, columns), np.float32)
    # of several values for one pixel the last one stays
    small[small_row[farthest_first], small_column[farthest_first]] = lidar_m[row, column][farthest_first]
    small[~usable] = 0
    return small


def camera_height_m(scene: SceneFolder, pictures: Sequence[ScenePicture], working_px: int) -> float | None:
    """Metres of the cameras above the ground, from some pictures' LiDAR points below the horizon; None for too few."""
    depths = []
    for picture in pictures:
        directions, seen = network_view(scene, picture, working_px, masked=False)
        lidar_m = reduced(scene.lidar_m(picture), seen)
        height_sine = directions @ picture.up_in_camera.astype(np.float32)
        below = (lidar_m > 0) & (height_sine < _GROUND_SINE)
        depths.append((-lidar_m * height_sine)[below])
    below_m = np.concatenate(depths) if depths else np.empty(0)
    return float(np.quantile(below_m, _GROUND_QUANTILE)) if below_m.size >= _MIN_GROUND_POINTS else None


def room_radius_m(examples: Examples) -> float:
    """Horizontal metres to the room's wall: the geometric mean over LiDAR points near and above the horizon, or 20."""
    logs = []
    for index in range(len(examples)):
        height_sine = examples.rays[examples.lens[index]] @ examples.up_in_camera[index]
        lidar_m = examples.lidar_m[index]
        level = (lidar_m > 0) & (height_sine > -0.5 * examples.camera_height_m[index] / np.maximum(lidar_m, 1e-6))
        logs.append(np.log((lidar_m * np.sqrt(1 - np.minimum(height_sine**2, 1)))[level]))
    collected = np.concatenate(logs)
    return float(np.exp(collected.mean())) if collected.size else 20.0
