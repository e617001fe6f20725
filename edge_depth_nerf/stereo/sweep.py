"""The sphere sweep: distances of one picture from its neighbours, on original fisheye pictures.

Hypotheses are inverse distances along the picture's own rays, so that each is a sphere about its camera. Under each one
the neighbours are seen from the picture, and the correlation of small windows, which exposure does not change, says how
well they fit; of the neighbours that see a point the better half counts, as something may hide it from the others. The
costs are aggregated along eight paths over the picture (Hirschmüller, *Stereo processing by semiglobal matching and
mutual information*, PAMI 2008), the best hypothesis is taken, and the parabola through its costs gives what lies
between.

No rectification: it knows of rays alone, and holds beyond 90°.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from numpy.typing import NDArray

from edge_depth_nerf.cameras.projection_series import projection_series
from edge_depth_nerf.stereo.views import View

NEAREST_M = 0.4
"""The sweep does not search nearer than this."""
STEP_PX = 1.0
"""Hypotheses lie so far apart in the neighbour where they do most, for most pixels."""
STEP_SHARE = 0.04
"""But near by no closer than by this share of the distance."""
_MOST_HYPOTHESES = 192
_PIXELS_QUANTILE = 0.9
_TRIED_STEP_PX = 16
_TRIED_INVERSES = 97
NOISE_LEVELS = 1.0
"""Standard deviation of the pictures' noise, grey levels: weaker texture counts for less."""
_SMALL_PENALTY = 0.015
"""For one hypothesis from a pixel to the next, as a cost."""
_LARGE_PENALTY = 1.0
"""For more."""
_EDGE_LEVELS = 30.0
"""The change of brightness that halves it."""
_APART = 3
"""The next best hypothesis is searched for farther than this from the best."""


@dataclass(frozen=True, eq=False)
class Swept:
    """What the neighbours say of a picture; H×W each."""

    inverse_per_m: Float32[np.ndarray, "h w"]
    """Inverse distance along the ray; 0 where there is none, or infinity."""
    correlation: Float32[np.ndarray, "h w"]
    """Mean correlation of the better half of the neighbours, 0 to 1."""
    margin: Float32[np.ndarray, "h w"]
    """By how much the next best hypothesis costs more, 0 to 1 and some."""
    parallax_px: Float32[np.ndarray, "h w"]
    """Angle between the point and the infinity behind it, in the neighbour that tells most, in pixels of the picture's
    middle; 0 where nobody sees it."""


def geometry_of(
    view: View, neighbours: Sequence[View]
) -> tuple[Float32[np.ndarray, "n h w"], tuple[NDArray[np.float32], ...]]:
    """The neighbours as the compiled loops want them: their pictures, and all that projects the view's points.

    That is: n×3×3 from the view's axes to the neighbours', n×3 the view's centre in these (metres), and n×2×length and
    n×8 the factors and numbers of their projection series.
    """
    size = tuple(max(each.grey.shape[axis] for each in neighbours) for axis in (0, 1))
    relative = np.stack([np.linalg.inv(each.camera_to_world) @ view.camera_to_world for each in neighbours])
    relative = relative.astype(np.float32)
    series = [projection_series(each.camera, each.theta_max_rad) for each in neighbours]
    length = max(each.factors.shape[1] for each in series)
    # the highest powers come first
    factors = [np.pad(each.factors, ((0, 0), (length - each.factors.shape[1], 0))) for each in series]
    turns, shifts = np.ascontiguousarray(relative[:, :3, :3]), np.ascontiguousarray(relative[:, :3, 3])
    pictures = np.stack([padded(each.grey, size, np.nan) for each in neighbours])
    return pictures, (turns, shifts, np.stack(factors), np.stack([each.numbers for each in series]))


def padded(values: Float32[np.ndarray, "h w"], size: tuple[int, ...], by: float) -> Float32[np.ndarray, "H W"]:
    """Make a map larger, below and at the right."""
    missing = [(0, whole - part) for whole, part in zip(size, values.shape, strict=True)]
    return np.pad(values, missing, constant_values=by)


def rays_of(view: View) -> Float32[np.ndarray, "3 h w"]:
    """Its rays as the compiled loops want them."""
    return np.ascontiguousarray(np.moveaxis(view.rays.directions, -1, 0))


def sweep_view(view: View, neighbours: Sequence[View]) -> Swept:
    """Find a picture's distances by its neighbours; all is 0 without any, or where they hardly tell anything."""
    nothing = Swept(*(np.zeros(view.grey.shape, np.float32) for _ in range(4)))
    if not neighbours:
        return nothing
    inverses_per_m = hypotheses(view, neighbours)
    if len(inverses_per_m) < 3:
        return nothing
    # imported here, because Numba takes half a second to load
    from edge_depth_nerf.stereo import sphere_sweep

    height, width = view.grey.shape
    (pictures, transforms), directions = geometry_of(view, neighbours), rays_of(view)
    cost = np.empty((height, len(inverses_per_m), width), np.float32)
    sphere_sweep.sweep(
        *(view.grey, pictures, directions, _spans(view), *transforms),
        *(inverses_per_m, np.float32(NOISE_LEVELS**2), cost),
    )
    total = np.empty((height, width, len(inverses_per_m)), np.float32)
    penalties = (np.float32(each) for each in (_SMALL_PENALTY, _LARGE_PENALTY, _EDGE_LEVELS))
    sphere_sweep.aggregate(cost, view.grey, *penalties, total)
    found = Swept(*(np.empty((height, width), np.float32) for _ in range(4)))
    sphere_sweep.choose(
        *(total, cost, view.grey, inverses_per_m, _APART), *(found.inverse_per_m, found.correlation, found.margin)
    )
    angle = found.parallax_px
    sphere_sweep.parallax(directions, found.inverse_per_m, pictures, *transforms, angle)
    angle *= np.float32(view.focal_px)
    return found


def hypotheses(view: View, neighbours: Sequence[View]) -> Float32[np.ndarray, "hypotheses"]:
    """Inverse distances to try, ascending from infinity, 1/m.

    From one to the next points move by `STEP_PX` in the neighbour in which they move most, or by less, for most of the
    picture; but near by not closer together than `STEP_SHARE`, as neighbours less far away measure it well enough. Too
    few to choose from where nothing moves.
    """
    tried = (slice(_TRIED_STEP_PX // 2, None, _TRIED_STEP_PX),) * 2
    directions = view.rays.directions[tried][view.used[tried]].astype(np.float64)
    inverses = np.concatenate([[0.0], np.geomspace(1e-3, 1 / NEAREST_M, _TRIED_INVERSES - 1)])
    if not len(directions):
        return inverses[:1].astype(np.float32)
    fastest = np.zeros((len(inverses) - 1, len(directions)))
    for neighbour in neighbours:
        relative = np.linalg.inv(neighbour.camera_to_world) @ view.camera_to_world
        # infinity to NEAREST_M, as directions from the neighbour
        there = directions @ relative[:3, :3].T + inverses[:, None, None] * relative[:3, 3]
        there /= np.linalg.norm(there, axis=-1, keepdims=True)
        pixels, valid = neighbour.camera.project(torch.from_numpy(there))
        seen = (valid & neighbour.camera.inside(pixels)).numpy()
        steps = neighbour.focal_px * np.linalg.norm(np.diff(there, axis=0), axis=-1)
        fastest = np.maximum(fastest, np.where(seen[1:] & seen[:-1], steps, 0.0))
    needed = np.quantile(fastest, _PIXELS_QUANTILE, axis=1) / STEP_PX
    enough = np.concatenate([[np.inf], np.diff(np.log(inverses[1:]))]) / STEP_SHARE
    reached = np.concatenate([[0.0], np.cumsum(np.minimum(needed, enough))])
    count = min(int(np.ceil(reached[-1])) + 1, _MOST_HYPOTHESES)
    return np.interp(np.linspace(0.0, reached[-1], count), reached, inverses).astype(np.float32)


def _spans(view: View) -> NDArray[np.int64]:
    """First column of each row that is used, and the one after the last."""
    used = view.used
    some = used.any(1)
    return np.stack([np.where(some, used.argmax(1), 0), np.where(some, used.shape[1] - used[:, ::-1].argmax(1), 0)], -1)
