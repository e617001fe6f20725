"""Maps of an unknown scale made metric: z = p or z = 1 / p, with p = scale · value + shift.

Pure. A map is of one of three kinds:

metric      p is z in metres; at most a factor is wrong
relative    depth up to scale and shift
inverse     one over depth (disparity) up to scale and shift

distance = z / cosine, the cosine of the ray to the axis that z counts along; 1 for maps of distance along the ray. Each
view of a picture has its own scale and shift. They are found together: views that see the same pixel shall have the
same distance there, and LiDAR's distance at LiDAR points. Errors are differences of log distance, so that near and far
count alike. The Gauss-Newton method minimises their sum, with weights that leave outliers out, from a start by linear
equations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Literal

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from edge_depth_nerf.method.alignment import robust_weights

Kind = Literal["metric", "relative", "inverse"]

ANCHOR_WEIGHT = 0.1
"""What views say already counts so much, where there is no LiDAR; that they agree counts 1."""
WRONG_WAY = -0.5
"""A rank correlation to LiDAR below this: the map runs against its given kind."""
_LINEAR_ROUNDS = 5
_ROUNDS = 8
_robust = partial(robust_weights, least_spread=1e-4)
_LONGEST_STEP = 0.5
"""Of log distance, in the middle of the pixels."""


@dataclass(frozen=True)
class Line:
    """p = scale · value + shift."""

    scale: float = 1.0
    shift: float = 0.0

    def distance_m(
        self, values: Float[np.ndarray, "*shape"], cosine: Float[np.ndarray, "*shape"] | float, kind: Kind
    ) -> Float[np.ndarray, "*shape"]:
        """Metres along the ray; 0 where the value is not finite or p is not positive."""
        p = np.where(np.isfinite(values), values, 0) * self.scale + self.shift
        known = np.isfinite(values) & (p > 0) & (np.asarray(cosine) > 0)
        divisor = np.where(known, cosine * p if kind == "inverse" else cosine, 1)
        return np.where(known, (1.0 if kind == "inverse" else p) / divisor, 0).astype(np.float32)


@dataclass(frozen=True)
class Samples:
    """What the views of a picture say at some of its pixels."""

    values: Float[np.ndarray, "views pixels"]
    """NaN where a view does not see the pixel, or says nothing."""
    cosine: Float[np.ndarray, "views pixels"]
    weight: Float[np.ndarray, "views pixels"]
    """How well a view sees the pixel, more than 0 where it does."""
    lidar_m: Float[np.ndarray, "pixels"]
    """Distance, 0 = no LiDAR point."""

    @staticmethod
    def joined(parts: Sequence[Samples]) -> Samples:
        """Those of several pictures with the same views."""
        names = [field.name for field in fields(Samples)]
        return Samples(**{name: np.concatenate([getattr(part, name) for part in parts], -1) for name in names})

    @property
    def lidar_points(self) -> int:
        """How many LiDAR points some view has a value for."""
        return int((self.seen.any(0) & (self.lidar_m > 0)).sum())

    @property
    def seen(self) -> Bool[np.ndarray, "views pixels"]:
        """Where a view says something."""
        return np.isfinite(self.values) & (self.weight > 0)


@dataclass(frozen=True)
class Layer:
    """What one view says, in the part of the picture that it sees."""

    box: tuple[slice, slice]
    """Rows and columns of the picture."""
    values: Float[np.ndarray, "rows columns"]
    """NaN = none."""
    cosine: Float[np.ndarray, "rows columns"]
    weight: Float[np.ndarray, "rows columns"]
    """0 where it sees nothing."""

    def at(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> Float[np.ndarray, "3 n"]:
        """Values, cosines and weights at some pixels of the picture; NaN, 1 and 0 outside the box."""
        found = np.tile(np.array([[np.nan], [1.0], [0.0]]), len(row))
        rows, columns = self.box
        inside = (row >= rows.start) & (row < rows.stop) & (column >= columns.start) & (column < columns.stop)
        place = row[inside] - rows.start, column[inside] - columns.start
        found[:, inside] = [each[place] for each in (self.values, self.cosine, self.weight)]
        return found


def take_samples(
    layers: Sequence[Layer], lidar_m: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"], most: int
) -> Samples:
    """Read a picture's layers at LiDAR points, and at other usable pixels: at most so many of each, drawn evenly."""
    rng = np.random.default_rng(0)
    chosen = []
    for pixels in (usable & (lidar_m > 0), usable & (lidar_m == 0)):
        where = np.flatnonzero(pixels)
        chosen.append(where if len(where) <= most else rng.choice(where, most, replace=False))
    row, column = np.unravel_index(np.concatenate(chosen), usable.shape)
    values, cosine, weight = np.stack([layer.at(row, column) for layer in layers], 1)
    return Samples(values, cosine, weight, lidar_m[row, column])


def blend(
    layers: Sequence[Layer], lines: Sequence[Line], kind: Kind, shape: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """Put the layers together: the weighted mean of log distance, as metres along the ray, 0 = none."""
    total, logs = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for layer, line in zip(layers, lines, strict=True):
        metres = line.distance_m(layer.values, layer.cosine, kind)
        weight = np.where(metres > 0, layer.weight, 0)
        total[layer.box] += weight
        logs[layer.box] += weight * np.log(np.where(metres > 0, metres, 1))
    return np.where(total > 0, np.exp(logs / np.where(total > 0, total, 1)), 0).astype(np.float32)


def fit_lines(samples: Samples, kind: Kind, start: Sequence[Line] | None = None) -> list[Line]:
    """Find scale and shift of each view; metric maps keep a shift of 0.

    With a start, the views keep to these lines instead of to LiDAR, of which nothing is taken then. Without a start
    and LiDAR they agree up to one scale for all. A view that nothing is known of, neither by LiDAR nor by its
    neighbours, gets 0 and 0: no value.
    """
    problem = _Problem(samples, kind, start)
    theta = problem.linear() if start is None else problem.of_lines(start)
    # against LiDAR first absolute errors, which outliers cannot move far, then squares without the outliers
    for weights_of_targets in (*[_absolute] * _ROUNDS, *[_robust] * _ROUNDS):
        theta = problem.step(theta, weights_of_targets)
    return problem.lines(theta)


def rank_correlation(values: Float[np.ndarray, "n"], others: Float[np.ndarray, "n"]) -> float:
    """Spearman's; 0 where either is constant."""
    ranks = np.stack([scipy.stats.rankdata(each) for each in (values, others)])
    return float(np.corrcoef(ranks)[0, 1]) if np.ptp(ranks, 1).min() > 0 else 0.0


class _Problem:
    """The equations of one picture. θ holds two numbers a view: p = θ · basis.

    The basis is (1, value about its median in units of its spread), for metric maps (value, 0).
    """

    def __init__(self, samples: Samples, kind: Kind, start: Sequence[Line] | None):
        self.sign = -1.0 if kind == "inverse" else 1.0
        self.views = len(samples.values)
        seen = samples.seen
        if kind == "metric":
            seen = seen & (samples.values > 0)
        self.centre, self.spread = np.zeros(self.views), np.ones(self.views)
        for view in range(self.views):
            if kind != "metric" and seen[view].any():
                low, middle, high = np.quantile(samples.values[view][seen[view]].astype(np.float64), (0.1, 0.5, 0.9))
                self.centre[view] = middle
                self.spread[view] = max(high - low, 1e-3 * abs(middle), 1e-30)
        self.metric = kind == "metric"
        values = np.where(seen, samples.values, 0).astype(np.float64)
        scaled = (values - self.centre[:, None]) / self.spread[:, None]
        ones = np.ones_like(values)
        self.basis = np.stack([values, 0 * ones] if self.metric else [ones, scaled], -1)
        # log d = sign · log p - log cosine
        self.log_cosine = np.log(np.where(seen, samples.cosine, 1))
        first, second = np.triu_indices(self.views, 1)
        pair, pixel = np.nonzero(seen[first] & seen[second])
        self.pair = first[pair], second[pair], pixel
        self.pair_weight = _share(samples.weight[first[pair], pixel] * samples.weight[second[pair], pixel], 1.0)
        wanted = seen & (samples.lidar_m > 0) if start is None else seen
        self.target = np.nonzero(wanted)
        view, pixel = self.target
        if start is None:
            self.log_target = np.log(samples.lidar_m[pixel].astype(np.float64))
        else:
            theta = self.of_lines(start)
            said = (self.basis * theta[:, None]).sum(-1)
            fine = said[view, pixel] > 0
            self.target = view, pixel = view[fine], pixel[fine]
            self.log_target = self.sign * np.log(said[view, pixel]) - self.log_cosine[view, pixel]
        self.target_weight = _share(samples.weight[view, pixel], 1.0 if start is None else ANCHOR_WEIGHT)

    def of_lines(self, lines: Sequence[Line]) -> NDArray[np.float64]:
        """Parameters of lines."""
        scale, shift = np.array([(line.scale, line.shift) for line in lines]).T
        if self.metric:
            return np.stack([scale, np.zeros_like(scale)], 1)
        return np.stack([scale * self.centre + shift, scale * self.spread], 1)

    def lines(self, theta: NDArray[np.float64]) -> list[Line]:
        """Lines of parameters."""
        if self.metric:
            return [Line(float(scale), 0.0) for scale, _ in theta]
        scale = theta[:, 1] / self.spread
        return [Line(float(s), float(a - s * c)) for s, a, c in zip(scale, theta[:, 0], self.centre, strict=True)]

    def linear(self) -> NDArray[np.float64]:
        """A start, from equations in distance (or its inverse), each divided by how large it is."""
        view, pixel = self.target
        first, second, shared = self.pair
        # p · factor is the distance or its inverse
        factor = np.exp(-self.sign * self.log_cosine)
        wanted = np.exp(self.sign * self.log_target)
        alone = not len(pixel)
        least, usual, most = (0.01, 1.0, 100.0) if alone else np.quantile(wanted, (0.05, 0.5, 0.95))
        pair_size = np.full(len(shared), usual)
        target_robust, pair_robust = np.ones(len(pixel)), np.ones(len(shared))
        theta = np.zeros((self.views, 2))
        of_first = self._rows(first, self.basis[first, shared] * factor[first, shared][:, None])
        of_second = self._rows(second, self.basis[second, shared] * factor[second, shared][:, None])
        for _ in range(_LINEAR_ROUNDS):
            if alone:
                # nothing tells the scale: the mean of what views share is 1
                targets, weight = (of_first + of_second).mean(0, keepdims=True) / 2, np.ones(1)
            else:
                targets = self._rows(view, self.basis[view, pixel] * (factor[view, pixel] / wanted)[:, None])
                weight = self.target_weight * target_robust
            matrix = np.concatenate([targets, (of_first - of_second) / pair_size[:, None]])
            right = np.concatenate([np.ones(len(targets)), np.zeros(len(shared))])
            weight = np.concatenate([weight, self.pair_weight * pair_robust])
            theta = _solve(matrix, right, weight, damping=1e-9).reshape(-1, 2)
            said = (self.basis * theta[:, None]).sum(-1) * factor
            pair_size = np.clip((said[first, shared] + said[second, shared]) / 2, least, most)
            target_robust = _absolute(said[view, pixel] / wanted - 1)
            pair_robust = _robust((said[first, shared] - said[second, shared]) / pair_size)
        return self._rising(theta)

    def step(
        self, theta: NDArray[np.float64], weights_of_targets: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    ) -> NDArray[np.float64]:
        """One step of Gauss and Newton's method in log distance."""
        view, pixel = self.target
        first, second, shared = self.pair
        p = (self.basis * theta[:, None]).sum(-1)
        fine = p > 0
        p = np.where(fine, p, 1)
        log_m = self.sign * np.log(p) - self.log_cosine
        slope = self.sign * self.basis / p[..., None]
        # what has no distance cannot be compared
        use_target, use_pair = fine[view, pixel], fine[first, shared] & fine[second, shared]
        view, pixel = view[use_target], pixel[use_target]
        first, second, shared = first[use_pair], second[use_pair], shared[use_pair]
        off_target = log_m[view, pixel] - self.log_target[use_target]
        off_pair = log_m[first, shared] - log_m[second, shared]
        targets = self._rows(view, slope[view, pixel])
        pairs = self._rows(first, slope[first, shared]) - self._rows(second, slope[second, shared])
        of_targets = self.target_weight[use_target] * weights_of_targets(off_target)
        weight = np.concatenate([of_targets, self.pair_weight[use_pair] * _robust(off_pair)])
        matrix, right = np.concatenate([targets, pairs]), -np.concatenate([off_target, off_pair])
        change = _solve(matrix, right, weight, damping=1e-6).reshape(-1, 2)
        changed = np.abs((slope * change[:, None]).sum(-1)[fine])
        longest = float(np.median(changed)) if changed.size else 0.0
        return self._rising(theta + change * min(1.0, _LONGEST_STEP / max(longest, 1e-12)))

    def _rising(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """No map runs backwards: over a flat wall noise would have it so."""
        return np.stack([theta[:, 0], np.maximum(theta[:, 1], 0)], 1)

    def _rows(self, view: NDArray[np.intp], of_view: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.zeros((len(view), self.views, 2))
        rows[np.arange(len(view)), view] = of_view
        return rows.reshape(len(view), 2 * self.views)


def _share(weight: NDArray, total: float) -> NDArray[np.float64]:
    return weight.astype(np.float64) * (total / max(float(weight.sum()), 1e-12))


def _absolute(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weights that make a square the absolute residual."""
    if not residual.size:
        return np.ones(0)
    size = np.abs(residual)
    middle = max(float(np.median(size)), 1e-4)
    return middle / np.maximum(size, 0.1 * middle)


def _solve(matrix: NDArray, right: NDArray, weight: NDArray, damping: float) -> NDArray[np.float64]:
    """Weighted least squares; what no equation holds stays 0."""
    normal = matrix.T @ (matrix * weight[:, None])
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    held = normal / np.outer(scale, scale) + damping * np.eye(len(normal))
    return np.linalg.solve(held, matrix.T @ (weight * right) / scale) / scale
