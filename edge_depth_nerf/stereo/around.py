"""What a picture's neighbours know of the places that it sees itself: their distances, projected into it.

Where a picture has no distance of its own, that may have two reasons. Matching failed here, but others matched the
same surface; or the picture sees something that nobody ever matched, such as a beam that is too near, in front of a
ceiling. These maps tell one from the other (`method.prior`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32

from edge_depth_nerf.lidar.projection import project_points
from edge_depth_nerf.stereo.views import View

SPACING_PX = 1.5
"""Each point stands for a patch as wide as so many pixels of the neighbour's picture: about a pixel's diagonal."""


def seen_around(
    view: View, neighbours: Sequence[View], theirs: Sequence[Float32[np.ndarray, "_ _"]]
) -> Float32[np.ndarray, "h w"]:
    """Project the neighbours' distances into a picture: the median of those that fall into a pixel.

    Args:
        view: the picture.
        neighbours: those it is compared with.
        theirs: their distances from motion, metres, 0 = none.

    Returns:
        Metres along the picture's own rays, 0 where no neighbour shows anything.

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
