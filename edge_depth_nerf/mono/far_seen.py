"""What LiDAR saw from elsewhere: the points of other frames, as a picture sees them above its own LiDAR's reach.

A scanner's field ends some degrees above the horizon, a fisheye's does not. But what stands high up before a picture
was in the scanner's field when the vehicle was farther away. So the LiDAR points of all training frames are put
together in the world, what moved is removed, and the rest is projected into each picture, only above its own points:
within their field these are denser, and what they do not show is mostly hidden.

A picture is concerned with points within `REACH_M` of it alone. They are found by squares of the ground plane, so that
the work grows with the length of the drive.

Lengths are metres, distances along the ray, 0 = none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from numpy.typing import NDArray

from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.lidar.projection import project_points
from edge_depth_nerf.lidar.sweeps import first_in_voxel
from edge_depth_nerf.mono.examples import scaled_lens
from edge_depth_nerf.mono.motion_seen import to_world
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

VOXEL_M = 0.05
"""The cloud holds one point of each cube of this size."""
SPACING_RAD = 0.0075
"""How far apart LiDAR points lie, seen from where they were measured: 0.43°, that of a scanner of 64 beams."""
FIELD_QUANTILE = 0.99
"""Above this quantile of its own LiDAR points' elevation a picture has next to none of its own."""
REACH_M = 86.0
"""Horizontally: what is evaluated ends at 60 m; and farther off than this the ground, too, is so little below a camera
1.7 m up that `_BELOW_SINE` lets it through."""
ELEVATION_QUANTILES = (0.001, 0.999)
"""Between these quantiles of its points' elevations lies a scanner's field, except for strays."""
_ELEVATION_STEP_DEG = 0.01
_BELOW_SINE = 0.02
"""Points so little below hide what is above."""
_AZIMUTHS = 360
_MERGE_AT = 4_000_000
"""So many points are collected before they are thinned, and then twice as many as were left."""
_TILE_M = 20.0
_TILE_BITS = 32
"""Bits of a tile's number along y."""
_SAME, _SAME_M = 1.05, 0.3
"""What differs in distance by less than this ratio or by less than this length may be one thing."""


@dataclass(frozen=True)
class Cloud:
    """Points in the scene's world, in the order of the tiles of the ground plane that they lie in."""

    points_m: Float64[np.ndarray, "points 3"]
    spacing_m: Float32[np.ndarray, "points"]
    """How wide a patch of surface each stands for."""
    tile: Int64[np.ndarray, "points"]
    """Number of each one's tile, ascending."""

    def part(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Cloud:
        """Some of the points; indices are to ascend."""
        return Cloud(self.points_m[which], self.spacing_m[which], self.tile[which])

    def near(self, picture: ScenePicture) -> NDArray[np.intp]:
        """Indices of the points within reach of a picture, ascending."""
        first, last = (_tile_of(picture.position_m[:2] + side) for side in (-REACH_M, REACH_M))
        columns = np.arange(first[0], last[0] + 1)
        # those of one x and neighbouring y lie together
        starts = np.searchsorted(self.tile, _tile_number(columns, first[1]), "left")
        ends = np.searchsorted(self.tile, _tile_number(columns, last[1]), "right")
        around = np.concatenate([np.arange(start, end) for start, end in zip(starts, ends, strict=True)])
        off_m = self.points_m[around, :2] - picture.position_m[:2]
        return around[off_m[:, 0] ** 2 + off_m[:, 1] ** 2 <= REACH_M**2]


def static_cloud(
    scene: SceneFolder, pictures: Sequence[ScenePicture], advance: Callable[[], None] = lambda: None
) -> Cloud:
    """Put the LiDAR points of some pictures together, if they are above any of these pictures' own.

    What more of the pictures see through than see has moved, and is left out; `advance` is called thrice a picture.

    Raises:
        InputError: a file cannot be decoded, or has another size than its camera.
    """
    tops = []
    for picture in pictures:
        tops.append(_field(scene, picture)[0])
        advance()
    points, spacings = [np.empty((0, 3))], [np.empty(0, np.float32)]
    collected, thinned = 0, 0
    for number, picture in enumerate(pictures):
        rays, lidar_m = _own(scene, picture)
        seen = lidar_m > 0
        points.append(to_world(picture, rays[seen] * lidar_m[seen, None]))
        spacings.append((SPACING_RAD * lidar_m[seen]).astype(np.float32))
        collected += int(seen.sum())
        # one that thins as soon as it is full would soon thin at every picture
        if number == len(pictures) - 1 or collected > max(_MERGE_AT, 2 * thinned):
            points_m, spacing_m = np.concatenate(points), np.concatenate(spacings)
            # those that were kept before come first, and stay
            kept = first_in_voxel(points_m, VOXEL_M)[thinned:]
            new = _tiled(points_m[kept], spacing_m[kept])
            new = new.part(_above_any(pictures, tops, new))
            points = [np.concatenate((points_m[:thinned], new.points_m))]
            spacings = [np.concatenate((spacing_m[:thinned], new.spacing_m))]
            collected = thinned = len(points[0])
        advance()
    cloud = _tiled(points[0], spacings[0])
    votes = np.zeros(len(cloud.points_m), np.int32)
    for picture in pictures:
        near = cloud.near(picture)
        votes[near] += _votes(picture, cloud.points_m[near], _own(scene, picture)[1])
        advance()
    return cloud.part(votes >= 0)


def seen_above(
    cloud: Cloud, scene: SceneFolder, picture: ScenePicture, size: tuple[int, int]
) -> Float32[np.ndarray, "h w"]:
    """Project what a cloud has within reach into a picture, above its own points, without what is or may be hidden.

    The picture has LiDAR; the size of the map is width and height.
    """
    top_sine, reach_m = _field(scene, picture)
    near = cloud.part(cloud.near(picture))
    high = near.part(_is_above(picture, near.points_m, top_sine))
    in_camera = torch.from_numpy((high.points_m - picture.position_m) @ picture.pose[:3, :3])
    lens = scaled_lens(picture.lens, size)
    projected = project_points(in_camera, lens, spacing_m=torch.from_numpy(high.spacing_m))
    distance_m = projected.distance_m.float().numpy()
    found = rays(lens, scene.theta_max_rad)
    sine = found.directions @ picture.up_in_camera.astype(np.float32)
    visible = _level_m(distance_m, sine) <= reach_m[_azimuth(picture, found.directions)]
    return np.where(found.within & (sine > top_sine) & visible, distance_m, np.float32(0))


def field_deg(
    scene: SceneFolder, pictures: Sequence[ScenePicture], advance: Callable[[], None] = lambda: None
) -> tuple[float, float] | None:
    """Elevations between which nearly all of some pictures' own LiDAR points lie, within the masks.

    Degrees above the world's horizon, to 0.01°: the `ELEVATION_QUANTILES`; None without LiDAR points. `advance` is
    called after each picture.

    Raises:
        InputError: a file cannot be decoded, or has another size than its camera.
    """
    edges = np.arange(-9000, 9001) * _ELEVATION_STEP_DEG
    counts = np.zeros(len(edges) - 1, np.int64)
    for picture in pictures:
        rays, lidar_m = _own(scene, picture)
        sine = rays[lidar_m > 0] @ picture.up_in_camera.astype(np.float32)
        counts += np.histogram(np.degrees(np.arcsin(np.clip(sine, -1, 1))), edges)[0]
        advance()
    if not counts.any():
        return None
    share = np.cumsum(counts) / counts.sum()
    low, high = (int(np.searchsorted(share, quantile)) for quantile in ELEVATION_QUANTILES)
    # the field is not to come out narrower than it is
    return round(float(edges[low]), 2), round(float(edges[high + 1]), 2)


def _field(scene: SceneFolder, picture: ScenePicture) -> tuple[float, Float32[np.ndarray, "azimuths"]]:
    """What a picture's own LiDAR points reach: the sine of their highest elevation, except for a few; 1 without any.

    And how far off, horizontally, the picture can see above them, by azimuth. The thing that a LiDAR point at the upper
    edge belongs to may continue above it, as a house does, and hide what is behind.
    """
    rays, lidar_m = _own(scene, picture)
    rays, lidar_m = rays[lidar_m > 0], lidar_m[lidar_m > 0]
    if not len(lidar_m):
        return 1.0, np.zeros(_AZIMUTHS, np.float32)
    sine, azimuth = rays @ picture.up_in_camera.astype(np.float32), _azimuth(picture, rays)
    highest_m = np.full(_AZIMUTHS, np.inf, np.float32)
    # of several values for one azimuth the last one stays
    upward = np.argsort(sine, kind="stable")
    highest_m[azimuth[upward]] = _level_m(lidar_m, sine)[upward]
    nearest_m = np.minimum(np.minimum(np.roll(highest_m, 1), np.roll(highest_m, -1)), highest_m)
    return float(np.quantile(sine, FIELD_QUANTILE)), (_SAME * nearest_m + _SAME_M).astype(np.float32)


def _level_m(distance_m: NDArray[np.float32], sine: NDArray[np.float32]) -> NDArray[np.float32]:
    """Horizontal distance."""
    return distance_m * np.sqrt(np.maximum(1 - sine**2, 0))


def _azimuth(picture: ScenePicture, rays: Float32[np.ndarray, "*shape 3"]) -> NDArray[np.intp]:
    """Which of the azimuths rays in the camera's frame have in the world."""
    world = rays @ picture.pose[:3, :3].T
    turn = np.arctan2(world[..., 1], world[..., 0]) / (2 * np.pi) + 0.5
    return (turn * _AZIMUTHS).astype(np.intp) % _AZIMUTHS


def _is_above(picture: ScenePicture, points_m: Float64[np.ndarray, "n 3"], top_sine: float) -> Bool[np.ndarray, "n"]:
    """Whether points lie above a picture's own LiDAR points, or so little below that they hide what does."""
    from_camera = points_m - picture.position_m
    return from_camera[:, 2] > (top_sine - _BELOW_SINE) * np.linalg.norm(from_camera, axis=1)


def _above_any(pictures: Sequence[ScenePicture], tops: Sequence[float], cloud: Cloud) -> Bool[np.ndarray, "points"]:
    above = np.zeros(len(cloud.points_m), bool)
    for picture, top_sine in zip(pictures, tops, strict=True):
        near = cloud.near(picture)
        near = near[~above[near]]
        above[near] = _is_above(picture, cloud.points_m[near], top_sine)
    return above


def _tiled(points_m: Float64[np.ndarray, "points 3"], spacing_m: Float32[np.ndarray, "points"]) -> Cloud:
    """Put points in the order of their tiles; those of one tile keep theirs."""
    x, y = _tile_of(points_m[:, :2]).T
    tile = _tile_number(x, y)
    order = np.argsort(tile, kind="stable")
    return Cloud(points_m[order], spacing_m[order], tile[order])


def _tile_of(place_m: Float64[np.ndarray, "*places 2"]) -> Int64[np.ndarray, "*places 2"]:
    """Number of a place's tile along x and along y."""
    return np.floor(place_m / _TILE_M).astype(np.int64)


def _tile_number(x: Int64[np.ndarray, "n"], y: Int64[np.ndarray, "n"] | np.int64) -> Int64[np.ndarray, "n"]:
    return (x << _TILE_BITS) + y


def _own(scene: SceneFolder, picture: ScenePicture) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """A picture's rays, and its LiDAR map within the mask, at its own size."""
    lidar_m = np.where(scene.usable(picture), scene.lidar_m(picture), np.float32(0))
    return scene.rays(picture).directions, lidar_m


def _votes(
    picture: ScenePicture, points_m: Float64[np.ndarray, "n 3"], lidar_m: Float32[np.ndarray, "h w"]
) -> Int32[np.ndarray, "n"]:
    """1 for each point that the picture's own LiDAR points confirm, -1 for each that they saw through, else 0."""
    in_camera = torch.from_numpy((points_m - picture.position_m) @ picture.pose[:3, :3])
    pixels, valid = picture.lens.project(in_camera)
    seen = (valid & picture.lens.inside(pixels)).numpy()
    column, row = pixels[torch.from_numpy(seen)].long().unbind(-1)
    measured_m = lidar_m[row.numpy(), column.numpy()]
    distance_m = in_camera[torch.from_numpy(seen)].norm(dim=-1).numpy()
    beyond = (measured_m > distance_m * _SAME) & (measured_m > distance_m + _SAME_M)
    hides = (distance_m > measured_m * _SAME) & (distance_m > measured_m + _SAME_M)
    votes = np.zeros(len(points_m), np.int32)
    votes[seen] = np.where(measured_m == 0, 0, np.where(beyond, -1, np.where(hides, 0, 1)))
    return votes
