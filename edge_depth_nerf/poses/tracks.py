"""Tracks: features of several pictures that are one point, and where that point is by the pictures' poses.

Matches are joined into tracks (connected components); a track that names two features of one picture holds a mismatch
and is dropped. A point is where the rays of its track come nearest to each other, in the sense of least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from edge_depth_nerf.poses.matches import Matches, Sights

LEAST_PARALLAX_RAD = np.radians(1.0)
"""Points whose rays differ by less have no distance to speak of."""


@dataclass(frozen=True)
class Tracks:
    """What pictures see of points: a row for each sighting, in order of tracks."""

    track: Int[np.ndarray, "n"]
    """Which point; 0, 1, … without gaps, rising."""
    picture: Int[np.ndarray, "n"]
    sights: Sights

    @property
    def count(self) -> int:
        """How many points there are."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def taken(self, kept: Bool[np.ndarray, "n"]) -> Tracks:
        """Some of the sightings; tracks with fewer than two of them are dropped."""
        lengths = np.bincount(self.track[kept], minlength=self.count)
        kept = kept & (lengths >= 2)[self.track]
        _, numbers = np.unique(self.track[kept], return_inverse=True)
        return Tracks(numbers.astype(np.int64), self.picture[kept], self.sights[kept])


def features_joined(matches: Sequence[Matches]) -> list[Int[np.ndarray, "m"]]:
    """For each of `matches`, the number of the group that each match belongs to, over all pictures.

    Matches that share a feature, directly or through others, have the same number.
    """
    if not any(len(found) for found in matches):
        return [np.zeros(0, np.int64) for _ in matches]
    stride = 1 + max(int(found.index.max()) for found in matches if len(found))
    ends = [
        np.stack((found.first * stride + found.index[:, 0], found.second * stride + found.index[:, 1]), -1)
        for found in matches
    ]
    nodes, edges = np.unique(np.concatenate(ends), return_inverse=True)
    edges = edges.reshape(-1, 2)
    graph = coo_array((np.ones(len(edges), bool), (edges[:, 0], edges[:, 1])), shape=(len(nodes), len(nodes)))
    _, groups = connected_components(graph, directed=False)
    of_matches = groups[edges[:, 0]].astype(np.int64)
    return np.split(of_matches, np.cumsum([len(found) for found in matches])[:-1])


def join_matches(matches: Sequence[Matches]) -> Tracks:
    """Join matches into tracks of two sightings or more."""
    groups = features_joined(matches)
    picture = np.concatenate([np.repeat([found.first, found.second], len(found)) for found in matches] or [[]])
    picture = picture.astype(np.int64)
    feature = np.concatenate([found.index.T.ravel() for found in matches] or [np.zeros(0, np.int64)])
    group = np.concatenate([np.tile(numbers, 2) for numbers in groups] or [np.zeros(0, np.int64)])
    parts = [part for found in matches for part in (found.in_first, found.in_second)]
    # one row for each feature of each picture
    rows, first = np.unique(np.stack((group, picture, feature), -1).reshape(-1, 3), axis=0, return_index=True)
    sights = _stacked(parts)[first]
    same = (np.diff(rows[:, :2], axis=0) == 0).all(-1)
    twice = np.unique(rows[1:][same, 0])
    _, numbers = np.unique(rows[:, 0], return_inverse=True)
    tracks = Tracks(numbers.astype(np.int64), rows[:, 1], sights)
    return tracks.taken(~np.isin(rows[:, 0], twice))


def _stacked(parts: Sequence[Sights]) -> Sights:
    shapes = {"pixels": (0, 2), "rays": (0, 3), "ray_per_pixel": (0, 3, 2)}
    return Sights(*(np.concatenate([np.zeros(s), *(getattr(part, n) for part in parts)]) for n, s in shapes.items()))


def triangulate(
    tracks: Tracks, camera_to_world: Float64[np.ndarray, "pictures 4 4"]
) -> Float64[np.ndarray, "points 3"]:
    """Where the rays of each track come nearest to each other; NaN where they differ by less than 1°.

    Poses are of all pictures, with OpenCV's camera axes.
    """
    poses = camera_to_world[tracks.picture]
    along = np.einsum("nij,nj->ni", poses[:, :3, :3], tracks.sights.rays)
    # the squared distance from a ray has this as its quadratic form
    across = np.eye(3) - along[:, :, None] * along[:, None]
    starts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(tracks.track))]) if len(tracks.track) else []
    if not len(starts):
        return np.zeros((0, 3))
    # near the middle of the path, so that no digits are lost far from the world's origin
    origin = camera_to_world[:, :3, 3].mean(0)
    form = np.add.reduceat(across, starts)
    right = np.add.reduceat(np.einsum("nij,nj->ni", across, poses[:, :3, 3] - origin), starts)
    mean = np.add.reduceat(along, starts)
    mean /= np.maximum(np.linalg.norm(mean, axis=-1, keepdims=True), 1e-12)
    from_mean = np.arccos(np.clip((along * mean[tracks.track]).sum(-1), -1, 1))
    apart = 2 * np.maximum.reduceat(from_mean, starts) >= LEAST_PARALLAX_RAD
    form[~apart] = np.eye(3)
    return np.where(apart[:, None], np.linalg.solve(form, right[..., None])[..., 0] + origin, np.nan)


def reprojection_px(
    tracks: Tracks, points: Float64[np.ndarray, "points 3"], camera_to_world: Float64[np.ndarray, "pictures 4 4"]
) -> Float64[np.ndarray, "n"]:
    """How far each sighting lies from its point's image, to first order, in pixels; NaN without a point or behind."""
    poses = camera_to_world[tracks.picture]
    towards = np.einsum("nji,nj->ni", poses[:, :3, :3], points[tracks.track] - poses[:, :3, 3])
    # a point at the camera's own place has no direction
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)
    ahead = (towards * tracks.sights.rays).sum(-1) > 0
    per_pixel = tracks.sights.ray_per_pixel
    square = np.einsum("nij,nik->njk", per_pixel, per_pixel)
    off = np.einsum("nij,ni->nj", per_pixel, towards - tracks.sights.rays)
    return np.where(ahead, np.linalg.norm(np.linalg.solve(square, off[..., None])[..., 0], axis=-1), np.nan)


def spread(tracks: Tracks, most: int) -> Tracks:
    """Keep the longest tracks, until each picture sees about `most` of them."""
    lengths = np.bincount(tracks.track, minlength=tracks.count)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    seen = np.zeros(int(tracks.picture.max()) + 1 if len(tracks.picture) else 0, np.int64)
    kept = np.zeros(len(tracks.track), bool)
    for number in np.argsort(-lengths, kind="stable"):
        rows = slice(starts[number], starts[number + 1])
        pictures = tracks.picture[rows]
        if (seen[pictures] < most).any():
            seen[pictures] += 1
            kept[rows] = True
    return tracks.taken(kept)
