"""Which edges of a picture, or of a map of distances, a rendered view shows: what PSNR hides.

PSNR hardly falls when a view is blurred, or when all of it is a pixel aside. Edges are then gone, or elsewhere. An edge
counts as found if the rendered view has one of the same direction within `PLACE_PX`.

Pictures are `[h, w, 3]` in 0 to 1, masks `[h, w]` (True = evaluate the pixel), distances `[h, w]` in metres along the
ray, 0 = none. What lies outside the mask never counts, be it NaN.
"""

from __future__ import annotations

import math
from itertools import product

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float64
from torch import Tensor

from edge_depth_nerf.method.metrics import EVALUATED_RANGE_M

PLACE_PX = 2
"""An edge is found if it is at most so far away."""
LARGEST_TURN_DEG = 30.0
"""And if it rises in the same direction, within this angle."""
LEAST_SLOPE = 0.03
"""An edge of the true picture changes by so much a pixel, of 1; in the rendered view half of it is enough."""
BLUR_PX, BLUR_RADIUS_PX = 1.0, 3
"""Standard deviation and radius of the Gaussian under which slopes are taken."""
LEAST_RATIO = 1.5
"""At a depth edge distances differ by this factor; in the rendered view its square root is enough."""
MOST_APART_PX = 3
"""LiDAR points of a row that are further apart do not say where the edge is."""
RIM_PX = BLUR_RADIUS_PX + 2 + PLACE_PX
"""All pixels that decide whether an edge is found are within this distance of it, along rows and columns."""


def _moved(values: Tensor, down: int, right: int) -> Tensor:
    """Give each pixel the value from so many rows below and columns to the right; 0, False beyond the picture."""
    most = max(abs(down), abs(right))
    height, width = values.shape[-2:]
    padded = F.pad(values, (most,) * 4)
    return padded[..., most + down : most + down + height, most + right : most + right + width]


def slopes(picture: Tensor, mask: Bool[Tensor, "h w"]) -> Float64[Tensor, "2 h w"]:
    """Give the change of brightness, the mean of the colours, a pixel to the right and a pixel down, after the blur."""
    brightness = torch.where(mask, picture.double().mean(dim=-1), 0)[None, None]
    at = torch.arange(-BLUR_RADIUS_PX, BLUR_RADIUS_PX + 1, dtype=torch.float64, device=picture.device)
    weights = torch.exp(-0.5 * (at / BLUR_PX).square())
    weights = weights / weights.sum()
    across = F.conv2d(brightness, weights[None, None, None], padding=(0, BLUR_RADIUS_PX))
    blurred = F.conv2d(across, weights[None, None, :, None], padding=(BLUR_RADIUS_PX, 0))[0, 0]
    right = _moved(blurred, 0, 1) - _moved(blurred, 0, -1)
    down = _moved(blurred, 1, 0) - _moved(blurred, -1, 0)
    return torch.stack([right, down]) / 2


def _ridges(slope: Float64[Tensor, "2 h w"], least: float) -> Bool[Tensor, "h w"]:
    """Say where brightness changes by `least` or more, and more than on both sides of the edge."""
    steepness = slope.norm(dim=0)
    # to the neighbour in one of eight directions
    eighth = torch.round(torch.atan2(slope[1], slope[0]) / (math.pi / 4)).long() % 4
    ridge = steepness >= least
    for number, (down, right) in enumerate(((0, 1), (1, 1), (1, 0), (1, -1))):
        before, after = _moved(steepness, -down, -right), _moved(steepness, down, right)
        ridge &= (eighth != number) | ((steepness > before) & (steepness >= after))
    return ridge


def picture_edges_found(pred: Tensor, target: Tensor, mask: Bool[Tensor, "h w"]) -> tuple[int, int]:
    """Count the edges of a true picture that a rendered one has, too.

    Args:
        pred: rendered colours, [h, w, 3].
        target: true colours, [h, w, 3].
        mask: True = evaluate; edges nearer than `RIM_PX` to its rim are not counted.

    Returns:
        How many pixels of edges are found, and how many there are.
    """
    true_slope, slope = slopes(target, mask), slopes(pred, mask)
    inner = F.max_pool2d(F.pad((~mask).double()[None], (RIM_PX,) * 4, value=1.0), 2 * RIM_PX + 1, stride=1)[0] == 0
    edge, rendered = _ridges(true_slope, LEAST_SLOPE) & inner, _ridges(slope, LEAST_SLOPE / 2)
    direction = slope / slope.norm(dim=0).clamp(min=1e-12) * rendered
    true_direction = true_slope / true_slope.norm(dim=0).clamp(min=1e-12)
    found, least = torch.zeros_like(edge), math.cos(math.radians(LARGEST_TURN_DEG))
    for down, right in product(range(-PLACE_PX, PLACE_PX + 1), repeat=2):
        if math.hypot(down, right) <= PLACE_PX:
            found |= (_moved(direction, down, right) * true_direction).sum(dim=0) >= least
    return int((found & edge).sum()), int(edge.sum())


def depth_edges_found(pred_m: Tensor, true_m: Tensor, mask: Bool[Tensor, "h w"]) -> tuple[int, int]:
    """Count the depth edges of a dense or sparse map that a rendered one has, too.

    A depth edge is between two neighbouring values of a row, at most `MOST_APART_PX` apart, one of which is
    `LEAST_RATIO` times the other. (Along a column the road itself recedes so fast in small pictures.) It is found if
    the rendered map, within `PLACE_PX`, changes in the same direction by half as much, in the logarithm, between the
    pixels just before and just after.

    Args:
        pred_m: rendered distances, [h, w].
        true_m: true ones, 0 = none; counted from 1 to 60 m.
        mask: True = evaluate.

    Returns:
        How many edges are found, and how many there are.
    """
    known = mask & (true_m >= EVALUATED_RANGE_M[0]) & (true_m <= EVALUATED_RANGE_M[1])
    true = torch.where(known, true_m, 1).double().log()
    rendered = torch.where(mask, pred_m, math.nan).double().log()
    found = edges = 0
    for apart in range(1, MOST_APART_PX + 1):
        # from the pixel before the edge's first value to the one after its second
        width = true.shape[1] - apart - 2
        if width < 1:
            break
        first, second = slice(1, 1 + width), slice(1 + apart, 1 + apart + width)
        jump = true[:, second] - true[:, first]
        edge = known[:, first] & known[:, second] & (jump.abs() >= math.log(LEAST_RATIO))
        for between in range(1, apart):
            edge &= ~known[:, 1 + between : 1 + between + width]
        change = rendered[:, 2 + apart :] - rendered[:, :width]
        for sign in (1.0, -1.0):
            there = torch.where(change.isfinite(), sign * change, -math.inf)
            # a change between the two may be a pixel aside in itself
            window = (2 * PLACE_PX + 1, 2 * PLACE_PX - 1)
            most = F.max_pool2d(there[None], window, stride=1, padding=(PLACE_PX, PLACE_PX - 1))[0]
            of_sign = edge & (sign * jump > 0)
            found += int((of_sign & (most >= jump.abs() / 2)).sum())
            edges += int(of_sign.sum())
    return found, edges


class EdgeRecall:
    """The share of edges that rendered views show, pooled over all views given."""

    def __init__(self) -> None:
        self._counts: dict[str, list[int]] = {}

    def update(self, name: str, found: tuple[int, int]) -> None:
        """Add a view's edges of a kind: how many are found, and how many there are."""
        counts = self._counts.setdefault(name, [0, 0])
        counts[0] += found[0]
        counts[1] += found[1]

    def compute(self) -> dict[str, float]:
        """Give the share of each kind, 0 to 1, under its name; of kinds that have edges."""
        return {name: found / there for name, (found, there) in self._counts.items() if there}
