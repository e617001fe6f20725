"""Which of a picture's distances its neighbours confirm, and how far they can be trusted.

A neighbour has distances of its own, found from other pictures. Where it has the same point, both are right or both
wrong in the same way; where it sees through the point, one is wrong. A distance is kept if several neighbours confirm
it and fewer see through it, if there is enough parallax, and if it is likely to be right (`confidence`). What is kept
is the mean of what agrees.

Where a picture has no distance of its own, that may have two reasons. Matching failed here, but others matched the
same surface; or the picture sees something that nobody ever matched, such as a beam that is too near, in front of a
ceiling. The neighbours' distances, projected into the picture, tell one from the other (`method.prior`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32

from edge_depth_nerf.lidar.projection import project_points
from edge_depth_nerf.masks.regions import larger
from edge_depth_nerf.stereo.sweep import Swept, geometry_of, padded, rays_of
from edge_depth_nerf.stereo.views import View

LEAST_PARALLAX_PX = 2.0
"""Where a point moves less against infinity there is no distance."""
LEAST_CORRELATION = 0.3
LEAST_AGREEING = 2
"""So many neighbours at least confirm a distance."""
LEAST_CONFIDENCE = 0.7
SAME_SHARE, SAME_PX = 0.04, 0.5
"""Inverse distances agree if they differ by less than this share and by this movement together."""
SMALLEST_PX = 12.0
"""Smaller regions of what is left are chance."""
_CONFIDENCE = (-1.0, 3.5, 1.75)
"""Of a logistic function of 1, the root of the margin, and the agreeing neighbours over `_ALL_AGREE`: fitted to the
ground truth of rendered drives, so that it is the share of distances that are right to 10 %."""
_ALL_AGREE = 8
_MATCH_PX = 0.15
"""How exactly a point is found in the neighbours: standard deviation of what is right."""
_LEAST_ERROR = 0.01
"""Of lenses and poses, as a share of the distance."""
_WRONG_ERROR = 0.2
"""Of a distance that is not right, as a share of it."""
SPACING_PX = 1.5
"""Each point stands for a patch as wide as so many pixels of the neighbour's picture: about a pixel's diagonal."""


@dataclass(frozen=True, eq=False)
class MotionDistance:
    """Distances of a picture from motion; H×W each, 0 where there is none."""

    distance_m: Float32[np.ndarray, "h w"]
    """Metres along the ray."""
    confidence: Float32[np.ndarray, "h w"]
    """How likely the distance is right to 10 %, `LEAST_CONFIDENCE` to 1."""
    parallax_px: Float32[np.ndarray, "h w"]
    """How far the point moves against the infinity behind it; see `Swept`."""

    @property
    def sigma_m(self) -> Float32[np.ndarray, "h w"]:
        """Standard deviation by parallax and confidence, metres, 0 where there is none.

        That of a mixture: with the confidence's probability a distance is as exact as its parallax allows, else it is
        wrong. What it amounts to on a drive is measured against LiDAR (`mono.calibration`).
        """
        of_right = (_MATCH_PX / np.maximum(self.parallax_px, LEAST_PARALLAX_PX)) ** 2 + _LEAST_ERROR**2
        variance = self.confidence * of_right + (1 - self.confidence) * _WRONG_ERROR**2
        return (self.distance_m * np.sqrt(variance)).astype(np.float32)


def worth_asking(swept: Swept) -> Bool[np.ndarray, "h w"]:
    """Where a sweep may say something, as yet unconfirmed."""
    return (swept.parallax_px >= LEAST_PARALLAX_PX) & (swept.correlation >= LEAST_CORRELATION)


def confirm(
    view: View, swept: Swept, neighbours: Sequence[View], theirs: Sequence[Float32[np.ndarray, "_ _"]]
) -> MotionDistance:
    """Keep of a view's sweep what the neighbours' own sweeps confirm.

    `theirs` are the inverse distances of the neighbours, 0 where they are not `worth_asking`.
    """
    # imported here, because Numba takes half a second to load
    from edge_depth_nerf.stereo import sphere_sweep

    size = view.grey.shape
    asked = worth_asking(swept)
    if len(neighbours) < LEAST_AGREEING or not asked.any():
        return MotionDistance(*(np.zeros(size, np.float32) for _ in range(3)))
    inverse_per_m = np.where(asked, swept.inverse_per_m, np.float32(0))
    unsure = np.float32(SAME_PX) * inverse_per_m / np.maximum(swept.parallax_px, LEAST_PARALLAX_PX)
    agree, against = np.empty(size, np.uint8), np.empty(size, np.uint8)
    mean = np.empty(size, np.float32)
    largest = tuple(max(each.shape[axis] for each in theirs) for axis in (0, 1))
    sphere_sweep.compare(
        *(rays_of(view), inverse_per_m, unsure, np.stack([padded(each, largest, 0.0) for each in theirs])),
        *geometry_of(view, neighbours)[1],
        *(np.float32(SAME_SHARE), agree, against, mean),
    )
    constant, of_margin, of_agreeing = _CONFIDENCE
    odds = constant + of_margin * np.sqrt(np.maximum(swept.margin, 0))
    odds += of_agreeing * np.minimum(agree, _ALL_AGREE) / _ALL_AGREE
    confidence = (1 / (1 + np.exp(-odds))).astype(np.float32)
    kept = asked & (agree >= LEAST_AGREEING) & (agree > against) & (confidence >= LEAST_CONFIDENCE) & (mean > 0)
    kept = larger(kept, SMALLEST_PX)
    distance_m = np.where(kept, 1 / np.where(kept, mean, 1), 0).astype(np.float32)
    return MotionDistance(distance_m, np.where(kept, confidence, 0), np.where(kept, swept.parallax_px, 0))


def seen_around(
    view: View, neighbours: Sequence[View], theirs: Sequence[Float32[np.ndarray, "_ _"]]
) -> Float32[np.ndarray, "h w"]:
    """Project the neighbours' distances (metres) into a picture: the median of those that fall into a pixel.

    They are metres along the picture's own rays, 0 where no neighbour shows anything.
    """
    found = np.full((len(neighbours), *view.grey.shape), np.nan, np.float32)
    for number, (neighbour, distance_m) in enumerate(zip(neighbours, theirs, strict=True)):
        known = distance_m > 0
        if not known.any():
            continue
        to_view = np.linalg.inv(view.camera_to_world) @ neighbour.camera_to_world
        points_m = neighbour.rays.directions[known].astype(np.float64) * distance_m[known, None]
        points_m = torch.from_numpy(points_m @ to_view[:3, :3].T + to_view[:3, 3])
        spacing_m = torch.from_numpy((SPACING_PX / neighbour.focal_px * distance_m[known]).astype(np.float32))
        projected_m = project_points(points_m, view.camera, spacing_m=spacing_m).distance_m.float().numpy()
        found[number] = np.where(projected_m > 0, projected_m, np.float32(np.nan))
    some = np.isfinite(found).any(0) & view.used
    result = np.zeros(view.grey.shape, np.float32)
    result[some] = np.nanmedian(found[:, some], axis=0)
    return result
