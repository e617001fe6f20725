"""A coloured cloud with normals, of the priors of all training pictures.

Of each picture the surest point of each cube is taken. A point stays if the priors of neighbouring pictures confirm it,
and no more of them see through it. Points of one cube are averaged by their certainty. Lengths are the scene's metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from numpy.lib.recfunctions import unstructured_to_structured
from numpy.typing import NDArray
from scipy.spatial import KDTree

from edge_depth_nerf.base.files import read_npz, write_atomically
from edge_depth_nerf.export.priors import Priors
from edge_depth_nerf.lidar.sweeps import first_in_voxel, voxel_keys
from edge_depth_nerf.scene.reader import ScenePicture

NEIGHBOURS = 8
LEAST_BASELINE_M, MOST_BASELINE_M = 0.2, 30.0
"""Neighbours are so far away: nearer ones see nothing else, and further ones little of the same."""
LEAST_AGREEMENT = -0.5
"""Cosine between the axes of two pictures; below it they hardly share a view."""
LEAST_ERROR_M = 0.1
"""A standard deviation of less is never too much."""
SIGMAS = 0.5
"""Distances agree if they differ by at most so many standard deviations. Pictures share most of their error."""
WINDOW_PX = 7
"""Normals are fitted to so many pixels."""
FLATTEST = 0.03
"""Cosine between normal and ray. Surfaces that are seen at a flatter angle are mostly the edges of things."""
MERGE_AT = 2_000_000
"""So many points are collected before they are averaged."""
MOST_MEANWHILE = 4
"""Cubes grow if there are so many times the points that are wanted; bounds the memory for long drives."""
_MAX_PART_BYTES = 1 << 28


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points with what is known of each."""

    points_m: Float64[np.ndarray, "points 3"]
    colours: Float64[np.ndarray, "points 3"]
    """RGB, 0 to 255."""
    normals: Float64[np.ndarray, "points 3"]
    """Unit vectors, towards the cameras."""
    sigma_m: Float64[np.ndarray, "points"]
    """Standard deviation of the distance."""

    def chosen(self, index: NDArray) -> Cloud:
        """Give some of the points."""
        return Cloud(*(getattr(self, field.name)[index] for field in fields(self)))


def neighbours_of(picture: ScenePicture, others: Sequence[ScenePicture]) -> list[ScenePicture]:
    """Choose the nearest pictures that may see the same from elsewhere."""
    away_m = {other.name: float(np.linalg.norm(other.position_m - picture.position_m)) for other in others}
    near = [
        other
        for other in others
        if LEAST_BASELINE_M <= away_m[other.name] <= MOST_BASELINE_M
        and other.looks_along @ picture.looks_along >= LEAST_AGREEMENT
    ]
    return sorted(near, key=lambda other: (away_m[other.name], other.name))[:NEIGHBOURS]


def part_of(
    priors: Priors, picture: ScenePicture, others: Sequence[ScenePicture], voxel_m: float, most_error: float
) -> Cloud:
    """Give the points of one picture that its neighbours confirm, at most one in each cube."""
    scene, prior = priors.scene, priors.read(picture)
    found = scene.rays(picture)
    distance_m, sigma_m = prior.distance_m.astype(np.float64), prior.sigma_m.astype(np.float64)
    usable = found.within & (distance_m > 0) & (sigma_m > 0)
    usable &= sigma_m <= np.maximum(most_error * distance_m, LEAST_ERROR_M)
    row, column = np.nonzero(usable)
    surest = np.argsort(sigma_m[row, column] / distance_m[row, column], kind="stable")
    row, column = row[surest], column[surest]
    pose = picture.pose
    outward = found.directions[row, column].astype(np.float64)
    points_m = (outward * distance_m[row, column, None]) @ pose[:3, :3].T + pose[:3, 3]
    first = first_in_voxel(points_m, voxel_m)
    row, column, outward, points_m = row[first], column[first], outward[first], points_m[first]

    normals = normals_of(distance_m, found.directions, row, column, WINDOW_PX)
    seen = np.abs(np.sum(normals * outward, 1)) >= FLATTEST
    near = neighbours_of(picture, others)
    if near:
        seen &= _confirmed(priors, near, points_m, sigma_m[row, column])
    colours = scene.rgb(picture)[row, column].astype(np.float64)
    return Cloud(points_m, colours, normals @ pose[:3, :3].T, sigma_m[row, column]).chosen(seen)


def normals_of(
    distance_m: Float64[np.ndarray, "h w"],
    directions: Float32[np.ndarray, "h w 3"],
    row: NDArray,
    column: NDArray,
    window_px: int,
) -> Float64[np.ndarray, "points 3"]:
    """Fit planes to a map around some of its pixels; unit normals towards the camera, in its frame.

    On the plane n·x = c a ray u ends at distance d where n·u / c = 1 / d, so least squares of 1 / d over u give n / c.
    """
    known = (distance_m > 0).astype(np.float64)
    inverse = np.where(distance_m > 0, 1 / np.where(distance_m > 0, distance_m, 1), 0)
    u = directions.astype(np.float64)

    def summed(values: NDArray) -> NDArray:
        size = (window_px, window_px)
        return cv2.boxFilter(values, -1, size, normalize=False, borderType=cv2.BORDER_CONSTANT)[row, column]

    matrix, right = np.empty((len(row), 3, 3)), np.empty((len(row), 3))
    for i in range(3):
        right[:, i] = summed(u[..., i] * inverse)
        for j in range(i, 3):
            matrix[:, i, j] = matrix[:, j, i] = summed(known * u[..., i] * u[..., j])
    # a lone pixel has no slope: its surface is taken to face the camera
    matrix += 1e-9 * np.eye(3) * np.maximum(np.trace(matrix, axis1=1, axis2=2), 1e-9)[:, None, None]
    outward = np.linalg.solve(matrix, right[..., None])[..., 0]
    return -outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)


def _confirmed(
    priors: Priors, near: Sequence[ScenePicture], points_m: Float64[np.ndarray, "points 3"], sigma_m: NDArray
) -> Bool[np.ndarray, "points"]:
    """Say which points some neighbours have as well, and no more of them see through."""
    agree, against = np.zeros(len(points_m), int), np.zeros(len(points_m), int)
    for neighbour in near:
        prior = priors.read(neighbour)
        seen, row, column = neighbour.pixels_of(points_m)
        range_m = np.linalg.norm(points_m[seen] - neighbour.position_m, axis=1)
        nearest_m, furthest_m = _around(prior.distance_m)
        nearest_m, furthest_m = nearest_m[row, column], furthest_m[row, column]
        known = prior.distance_m[row, column] > 0
        error_m = SIGMAS * np.hypot(sigma_m[seen], prior.sigma_m[row, column])
        beyond = known & (nearest_m > range_m + error_m)
        against[seen[beyond]] += 1
        agree[seen[known & ~beyond & (furthest_m >= range_m - error_m)]] += 1
    return (agree > 0) & (agree >= against)


def _around(distance_m: Float32[np.ndarray, "h w"]) -> tuple[NDArray, NDArray]:
    """Give the nearest and the furthest distance at a pixel and the eight beside it; 0 counts as none."""
    square = np.ones((3, 3), np.uint8)
    nearest = cv2.erode(np.where(distance_m > 0, distance_m, np.float32(np.inf)), square)
    return nearest, cv2.dilate(distance_m, square)


# ---- parts, and their sum --------------------------------------------------------------------------------------


def write_part(path: Path, part: Cloud) -> None:
    """Write the points of one picture, atomically."""
    arrays = {field.name: getattr(part, field.name).astype(np.float32) for field in fields(part)}
    arrays["colours"] = part.colours.astype(np.uint8)
    # float32 has 0.1 mm a kilometre from the scene's origin
    write_atomically(path, lambda temporary: np.savez(temporary, **arrays))


def merge_parts(paths: Sequence[Path], voxel_m: float, most_points: int) -> Cloud:
    """Average the points of all pictures in each cube; cubes grow until there are at most `most_points`."""
    names = tuple(field.name for field in fields(Cloud))
    rows, keys = np.empty((0, 11)), np.empty(0, np.int64)
    waiting: list[NDArray] = []
    for number, path in enumerate(paths):
        part = Cloud(*(array.astype(np.float64) for array in read_npz(path, names, _MAX_PART_BYTES).values()))
        weight = 1 / part.sigma_m[:, None] ** 2
        # weight, number of points, and weighted sums of place, colour and normal
        sums = (weight, np.ones_like(weight), weight * part.points_m, weight * part.colours, weight * part.normals)
        waiting.append(np.hstack(sums))
        is_last = number == len(paths) - 1
        if sum(map(len, waiting)) > MERGE_AT or is_last:
            rows = np.concatenate([rows, *waiting])
            keys = np.concatenate([keys, *(voxel_keys(each[:, 2:5] / each[:, :1], voxel_m) for each in waiting)])
            rows, keys = _summed(rows, keys)
            waiting = []
            while len(rows) > (most_points if is_last else MOST_MEANWHILE * most_points):
                voxel_m *= 1.2
                rows, keys = _summed(rows, voxel_keys(rows[:, 2:5] / rows[:, :1], voxel_m))
    weight = rows[:, :1]
    normals = rows[:, 8:11] / np.maximum(np.linalg.norm(rows[:, 8:11], axis=1, keepdims=True), 1e-12)
    return Cloud(rows[:, 2:5] / weight, rows[:, 5:8] / weight, normals, np.sqrt(rows[:, 1] / rows[:, 0]))


def _summed(rows: NDArray[np.float64], keys: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Add up rows of one cube."""
    unique, place = np.unique(keys, return_inverse=True)
    columns = [np.bincount(place, weights=rows[:, number], minlength=len(unique)) for number in range(rows.shape[1])]
    return np.stack(columns, 1).astype(np.float64), unique


def figures_of(cloud: Cloud, lidar_m: Float[np.ndarray, "lidar 3"] | None) -> dict[str, Any]:
    """Give the number of points and their median standard deviation; and how far LiDAR's points are from the cloud.

    That is the median distance from the plane of the nearest point. LiDAR is part of the prior, so it tells whether
    the two lie in one place, not how true the cloud is.
    """
    found: dict[str, Any] = {"points": len(cloud.points_m), "median_sigma_m": round(float(np.median(cloud.sigma_m)), 4)}
    if lidar_m is not None and len(lidar_m):
        nearest = KDTree(cloud.points_m).query(lidar_m)[1]
        off_m = np.abs(((lidar_m - cloud.points_m[nearest]) * cloud.normals[nearest]).sum(1))
        found["lidar_median_off_m"] = round(float(np.median(off_m)), 4)
    off = f", {100 * found['lidar_median_off_m']:.1f} cm from LiDAR's (median)" if "lidar_median_off_m" in found else ""
    return {**found, "text": f"{found['points']:,} points{off}"}


def cloud_rows(cloud: Cloud, offset_m: Float[np.ndarray, "3"], number: str = "<f4") -> NDArray:
    """Give rows for a PLY file: place plus an offset, normal, colour, sigma."""
    kinds = [(axis, number) for axis in "xyz"] + [(f"n{axis}", "<f4") for axis in "xyz"]
    kinds += [(name, "u1") for name in ("red", "green", "blue")] + [("sigma", "<f4")]
    columns = np.hstack((cloud.points_m + offset_m, cloud.normals, rgb_of(cloud), cloud.sigma_m[:, None]))
    return unstructured_to_structured(columns, np.dtype(kinds))


def rgb_of(cloud: Cloud) -> UInt8[np.ndarray, "points 3"]:
    """Give the colours as bytes."""
    return np.rint(cloud.colours).astype(np.uint8)
