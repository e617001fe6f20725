"""Weights of a proposal network along rays on the CPU, in one call for all stages of a share of the rays.

Positions of the samples, contraction, hash grid, network, densities and weights are the functions that compute them by
themselves, too. But threads are woken once, not six times, and torch sees nothing in between.

Importing this module imports Numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.contraction_numba import contract_points
from edge_depth_nerf.kernels.hash_grid_numba import encode_points
from edge_depth_nerf.kernels.network_numba import Arrays, apply_to_points
from edge_depth_nerf.kernels.pointwise_numba import find_densities, find_middles, flat_rows
from edge_depth_nerf.kernels.ray_numba import find_weights
from edge_depth_nerf.kernels.threads import in_parts

LEAST_SHARE = 1 << 11
"""A thread gets at least so many samples."""


class _Rays(NamedTuple):
    """Flat; rows of matrices lie `..._stride` numbers apart."""

    origins: Any
    origin_stride: int
    directions: Any
    direction_stride: int
    starts: Any
    start_stride: int
    ends: Any
    end_stride: int
    deltas: Any


class _Between(NamedTuple):
    """What one stage writes and the next one reads."""

    positions: Any
    axes: Any
    inside: Any
    encoded: Any
    before: Any
    densities: Any


@compiled()
@no_type_check
def _weigh(rays, between, table, features, scalings, network, scale, weights, samples, first, last):
    positions, axes, inside, encoded, before, densities = between
    begin, end = first * samples, last * samples
    origins, origin_stride, directions, direction_stride, starts, start_stride, ends, end_stride, deltas = rays
    find_middles(
        origins, origin_stride, directions, direction_stride, starts, start_stride, ends, end_stride,
        positions.ravel(), samples, first, last,
    )  # fmt: skip
    contract_points(positions, axes, inside, begin, end)
    encode_points(axes, table, features, scalings, encoded, begin, end)
    ins, down, begins, biases, shared, more, group = network
    apply_to_points(encoded.ravel(), ins, 0, 0, down, begins, biases, shared, more, group, before, 1, 0, begin, end)
    find_densities(before, 1, inside, densities, scale, begin, end)
    find_weights(densities, deltas, weights, samples, first, last)


def weigh(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    starts: Float[Tensor, "rays samples"],
    ends: Float[Tensor, "rays samples"],
    deltas: Float[Tensor, "rays samples"],
    grid: tuple[Float[Tensor, "rows features"], Float[Tensor, "levels"]],
    network: tuple[Sequence[Tensor], Sequence[Tensor]],
    scale: float,
) -> Float[Tensor, "rays samples"]:
    """Compute rendering weights by the density of a small network behind a hash grid; float32, without any gradient.

    Args:
        origins: of the rays, scene units.
        directions: likewise.
        starts: distances of the samples along their rays, scene units.
        ends: likewise.
        deltas: the samples' lengths.
        grid: table and scalings of the hash grid, as in `hash_grid`.
        network: weights and biases of its layers; it gives one number.
        scale: the density where that is 0.

    """
    rays, samples = starts.shape
    points, (table, scalings), (layers, biases) = rays * samples, grid, network
    features = table.shape[1]
    encoded, weights = torch.empty(points, len(scalings) * features), torch.empty(rays, samples)
    net = Arrays(encoded, layers, [bias.view(1, -1) for bias in biases])
    _, ins, _, _, down, begins = net.arrays
    matrices: list[Any] = [each for matrix in (origins, directions, starts, ends) for each in flat_rows(matrix)]
    given = _Rays(*matrices, deltas=flat(deltas))
    numbers = [torch.empty(points) for _ in range(3)]
    between = _Between(
        positions=torch.empty(points, 3).numpy(),
        axes=torch.empty(3, points).numpy(),
        inside=numbers[0].numpy(),
        encoded=encoded.numpy(),
        before=numbers[1].numpy(),
        densities=numbers[2].numpy(),
    )
    arrays = (
        given, between, flat(table), (0,) * features, scalings.numpy(), (ins, down, begins, *net.of_groups),
        np.float32(scale), flat(weights), samples,
    )  # fmt: skip
    in_parts(lambda first, last: _weigh(*arrays, first, last), rays, max(1, LEAST_SHARE // samples))
    return weights
