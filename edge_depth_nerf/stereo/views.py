"""Pictures for the sweep, and which of them are worth comparing with a picture.

A neighbour is worth something where it sees what the picture sees, from somewhere else. That is tried at some pixels
and distances: how many pixels the point moves against the infinity behind it tells how well its distance can be
measured, up to a bound, and beyond some angle things no longer look alike. Neighbours are taken one by one, each the
one that adds most to what those before it give. Those on either side of the picture count apart, as what is hidden from
one side is often seen from the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8

from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import Rays, rays
from edge_depth_nerf.masks.regions import block_mean, whole_blocks

MOST_PIXELS = 200_000
"""Larger pictures are averaged down by a whole factor until they have no more."""
_STEP_PX = 20
"""Every so many-th pixel is tried, in both directions."""
_DISTANCES_M = (1.5, 4.0, 10.0, 25.0)
_ENOUGH_PX = 12.0
"""More than this is worth no more."""
_WIDEST_RAD = 0.7
"""From here on nothing looks alike."""
NEAREST_VIEWS = 32
"""So many views are worth trying: those whose centres lie nearest."""
_SAME_PLACE_M = 0.03
"""Within this distance a camera stands."""
_LEAST_GAIN_PX = 0.05
"""Mean over what is tried, of roots of pixels: a neighbour that adds less is not taken."""


@dataclass(frozen=True, eq=False)
class View:
    """A picture with its lens and its pose."""

    grey: Float32[np.ndarray, "h w"]
    """Grey levels, 0 to 255; NaN where the picture is not used: outside the lens, the vehicle, things that move."""
    camera: Camera
    """The lens, at the picture's size."""
    camera_to_world: Float64[np.ndarray, "4 4"]
    """Pose; camera axes as OpenCV's, metres."""
    theta_max_rad: float = math.pi
    """Angle from the optical axis up to which rays are used."""

    @property
    def rays(self) -> Rays:
        """Of its pixels."""
        return rays(self.camera, self.theta_max_rad)

    @property
    def used(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that take part."""
        return ~np.isnan(self.grey)

    @property
    def focal_px(self) -> float:
        """Pixels per radian on the axis."""
        return math.sqrt(self.camera.fx * self.camera.fy)


def view_of(
    picture: UInt8[np.ndarray, "h w 3"],
    usable: Bool[np.ndarray, "h w"],
    camera: Camera,
    camera_to_world: Float64[np.ndarray, "4 4"],
    theta_max_rad: float = math.pi,
) -> View:
    """Make a view of a picture and its lens, smaller if it has more than `MOST_PIXELS`; all else as of `View`."""
    factor = working_factor(camera)
    small = camera.downscaled(factor)
    grey = block_mean(np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), np.float32), factor)
    used = whole_blocks(usable, factor) & rays(small, theta_max_rad).within
    return View(np.where(used, grey, np.float32(np.nan)), small, camera_to_world, theta_max_rad)


def working_factor(camera: Camera) -> int:
    """By how much pictures of a camera are averaged down."""
    return max(1, math.ceil(math.sqrt(camera.width * camera.height / MOST_PIXELS)))


def nearest_views(positions_m: Float64[np.ndarray, "views 3"], index: int, cameras: Sequence[str]) -> list[int]:
    """Which views to offer to `choose_neighbours`: the `NEAREST_VIEWS` nearest to a view, without itself.

    Of a camera that stands, one view is enough: else a stop of some frames would leave no place for those from where
    things look different.
    """
    of_camera = np.asarray(cameras)
    from_view_m = np.linalg.norm(positions_m - positions_m[index], axis=1)
    left, taken = np.ones(len(positions_m), bool), [index]
    while len(taken) <= NEAREST_VIEWS:
        away_m = np.linalg.norm(positions_m - positions_m[taken[-1]], axis=1)
        left[(of_camera == of_camera[taken[-1]]) & (away_m <= _SAME_PLACE_M)] = False
        if not left.any():
            break
        taken.append(int(np.where(left, from_view_m, np.inf).argmin()))
    return taken[1:]


def choose_neighbours(view: View, others: Sequence[View], most: int = 8) -> list[int]:
    """Which of the views near a view to compare it with: indices, the best first; none where none tells anything."""
    tried = (slice(_STEP_PX // 2, None, _STEP_PX),) * 2
    directions = view.rays.directions[tried][view.used[tried]].astype(np.float64)
    if not (others and len(directions)):
        return []
    worth = np.stack([_worth_px(view, other, directions) for other in others])
    # the side of the picture, along the line on which most views lie
    offsets_m = np.stack([other.camera_to_world[:3, 3] - view.camera_to_world[:3, 3] for other in others])
    side = (offsets_m @ np.linalg.svd(offsets_m, full_matrices=False)[2][0] > 0).astype(np.intp)
    have = np.zeros((2, worth.shape[1]))
    chosen: list[int] = []
    while len(chosen) < min(most, len(others)):
        gains = (np.sqrt(have[side] + worth) - np.sqrt(have[side])).mean(1)
        gains[chosen] = 0.0
        best = int(gains.argmax())
        if gains[best] < _LEAST_GAIN_PX:
            break
        have[side[best]] += worth[best]
        chosen.append(best)
    return chosen


def _worth_px(view: View, other: View, directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "tried"]:
    """Pixels that points on rays move against infinity; less the less alike they look; 0 where they are not seen."""
    points_m = (np.array(_DISTANCES_M)[:, None, None] * directions).reshape(-1, 3)
    relative = np.linalg.inv(other.camera_to_world) @ view.camera_to_world
    there_m = points_m @ relative[:3, :3].T + relative[:3, 3]
    pixels, valid = other.camera.project(torch.from_numpy(there_m))
    seen = (valid & other.camera.inside(pixels)).numpy()
    column, row = torch.nan_to_num(pixels).long().numpy()[seen].T
    seen[seen] = ~np.isnan(other.grey[row, column])
    cosine = (there_m * (points_m @ relative[:3, :3].T)).sum(1)
    angle = np.arccos(np.clip(cosine / np.linalg.norm(there_m, axis=1) / np.linalg.norm(points_m, axis=1), -1, 1))
    alike = np.clip(2 - 2 * angle / _WIDEST_RAD, 0, 1)
    return np.where(seen, np.minimum(other.focal_px * angle, _ENOUGH_PX) * alike, 0.0)
