"""Figures beyond the metrics of every evaluation: after a colour fit, and binned. Pure.

Pictures are `[h, w, 3]` in 0 to 1, masks `[h, w]` (True = evaluate the pixel), distances `[h, w]` metres along the ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.method.metrics import EVALUATED_RANGE_M, LEAST_SQUARED_ERROR

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
        self.edges = torch.tensor(edges, dtype=torch.float64)
        self._sums: dict[str, Tensor] = {}

    def _add(self, name: str, where: Tensor, values: Tensor | None = None) -> None:
        found = torch.bincount(where, None if values is None else values.double(), minlength=len(self.edges) - 1)
        self._sums[name] = self._sums.get(name, 0) + found.double()

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
        values = values.double()
        counted = mask & (values >= self.edges[0]) & (values < self.edges[-1])
        where = torch.bucketize(values[counted], self.edges, right=True) - 1
        self._add("pixels", where)
        self._add("squared", where, (pred[counted].double() - target[counted].double()).square().mean(dim=-1))
        if true_m is None:
            return
        true = true_m[counted].double()
        known = (true >= EVALUATED_RANGE_M[0]) & (true <= EVALUATED_RANGE_M[1])
        pred_there, true, where = pred_m[counted].double()[known], true[known], where[known]
        self._add("with distance", where)
        self._add("abs_rel", where, (pred_there - true).abs() / true)
        self._add("delta_1_25", where, (pred_there < 1.25 * true) & (true < 1.25 * pred_there))

    def compute(self) -> list[dict[str, float]]:
        """The bins that have pixels: low, high, pixels, psnr (dB); where distances are known abs_rel, delta_1_25."""
        found = []
        for index in self._sums.get("pixels", torch.zeros(0)).nonzero()[:, 0].tolist():
            sums = {name: float(values[index]) for name, values in self._sums.items()}
            mean = max(sums["squared"] / sums["pixels"], LEAST_SQUARED_ERROR)
            figures = {"low": float(self.edges[index]), "high": float(self.edges[index + 1])}
            figures |= {"pixels": sums["pixels"], "psnr": -10 * math.log10(mean)}
            if known := sums.get("with distance", 0):
                figures |= {name: sums[name] / known for name in ("abs_rel", "delta_1_25")}
            found.append(figures)
        return found
