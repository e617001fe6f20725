"""Figures beyond the metrics of every evaluation: after a colour fit, and binned. Pure.

Pictures are `[h, w, 3]` in 0 to 1, masks `[h, w]` (True = evaluate the pixel), distances `[h, w]` metres along the ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.method.metrics import LEAST_SQUARED_ERROR, DepthErrors

ANGLE_EDGES_DEG = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 100.0, 120.0)
"""Bins of the angle from the optical axis."""
DISTANCE_EDGES_M = (1.0, 2.0, 4.0, 7.0, 12.0, 20.0, 35.0, 60.0)
"""Bins of the true distance."""


def affine_fitted(
    pred: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Give a picture the colours of another as far as one affine map of colours can (least squares in the mask).

    A held-out picture's exposure is nothing that the other pictures tell; what is left after the fit is structure.

    Returns:
        pred under the 3×4 map that brings it nearest to target, clamped to 0..1.
    """

    def with_one(colours: Tensor) -> Tensor:
        return torch.cat([colours, torch.ones_like(colours[..., :1])], dim=-1).double().cpu()

    # the CPU's solver also takes pictures of one colour
    solution = torch.linalg.lstsq(with_one(pred[mask]), target[mask].double().cpu(), driver="gelsd").solution
    return (with_one(pred) @ solution).clamp(0, 1).to(pred)


class BinnedErrors:
    """Errors of colour and distance in bins of some quantity, pooled over the pixels of all pictures given."""

    def __init__(self, edges: Sequence[float]) -> None:
        self._bins = [*pairwise(edges)]
        self._distances = [DepthErrors() for _ in self._bins]
        self._pixels, self._squared = [0] * len(self._bins), [0.0] * len(self._bins)

    def update(
        self,
        values: Float[Tensor, "h w"],
        mask: Bool[Tensor, "h w"],
        pred: Float[Tensor, "h w 3"],
        target: Float[Tensor, "h w 3"],
        pred_m: Float[Tensor, "h w"],
        true_m: Float[Tensor, "h w"] | None = None,
    ) -> None:
        """Add a picture.

        Args:
            values: the quantity at each pixel; outside all bins or not finite = not counted.
            mask: True = evaluate.
            pred: rendered colours.
            target: true colours.
            pred_m: rendered distance, metres.
            true_m: true distance, metres; counted from 1 to 60 m, the range of all distance errors.
        """
        squared, values = (pred.double() - target.double()).square().mean(dim=-1), values.double()
        for number, (low, high) in enumerate(self._bins):
            counted = mask & (values >= low) & (values < high)
            self._pixels[number] += int(counted.sum())
            self._squared[number] += float(squared[counted].sum())
            if true_m is not None:
                self._distances[number].update(pred_m, true_m, counted)

    def compute(self) -> list[dict[str, float]]:
        """The bins that have pixels: low, high, pixels, psnr (dB); where distances are known the errors of these."""
        found = []
        for number, (low, high) in enumerate(self._bins):
            if pixels := self._pixels[number]:
                psnr = -10 * math.log10(max(self._squared[number] / pixels, LEAST_SQUARED_ERROR))
                errors = self._distances[number].compute("")
                found.append({**errors, "low": low, "high": high, "pixels": float(pixels), "psnr": psnr})
        return found
