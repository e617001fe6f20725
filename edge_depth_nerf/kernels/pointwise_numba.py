"""What nerfacto computes number by number on the CPU, each in one pass: torch needs four to seventy.

Where samples lie, their distances from places in 0..1, and directions in spherical harmonics; float32. Importing this
module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled
from edge_depth_nerf.kernels.threads import in_parts

HARMONICS = 16
"""Spherical harmonics of four degrees."""
LEAST_SHARE = 1 << 16
"""A thread gets at least so many numbers."""
HALF, ONE, TWO = np.float32(0.5), np.float32(1), np.float32(2)


def flat_rows(matrix: Float[Tensor, "rows columns"]) -> tuple[np.ndarray, int]:
    """Give a matrix as a flat array, and how many numbers lie from one row's begin to the next one's.

    Where samples begin is a view of all edges, which need not be copied.
    """
    matrix = matrix.detach()
    rows, columns = matrix.shape
    if matrix.numel() == 0:
        return np.empty(0, np.float32), columns
    if columns > 1 and matrix.stride(1) != 1:
        matrix = matrix.contiguous()
    stride = matrix.stride(0)
    return matrix.as_strided(((rows - 1) * stride + columns,), (1,)).numpy(), stride


@compiled()
@no_type_check
def _spacing(distance):
    """Give the place in the sampler's spacing of a distance in scene units."""
    return distance / TWO if distance < ONE else ONE - ONE / (TWO * distance)


@compiled(error_model="numpy")
@no_type_check
def _distances(places, stride, nears, fars, found, columns, first, last):
    for ray in range(first, last):
        near, far = _spacing(nears[ray]), _spacing(fars[ray])
        of_ray, into = places[ray * stride :], found[ray * columns :]
        for k in range(columns):
            place = of_ray[k]
            # torch's way of going from one to the other
            upper = far - (far - near) * (ONE - place)
            x = near + place * (far - near) if abs(place) < HALF else upper
            into[k] = TWO * x if x < HALF else ONE / (TWO - TWO * x)


def distances(
    places: Float[Tensor, "rays places"], nears: Float[Tensor, "rays 1"], fars: Float[Tensor, "rays 1"]
) -> Float[Tensor, "rays places"]:
    """Give distances along rays, in scene units, of places from 0, the near plane, to 1, the far one; no gradient.

    The spacing is that of nerfstudio's piecewise sampler: even up to 1, even in the inverse of the distance from there.
    """
    rays, columns = places.shape
    found = torch.empty(rays, columns)
    planes = (each.detach().contiguous().view(-1).numpy() for each in (nears, fars))
    arrays = *flat_rows(places), *planes, found.view(-1).numpy(), columns
    in_parts(lambda first, last: _distances(*arrays, first, last), rays, LEAST_SHARE // max(1, columns))
    return found


@compiled()
@no_type_check
def find_midpoints(
    origins, origin_stride, directions, direction_stride, starts, start_stride, ends, end_stride, positions, columns,
    first, last,
):  # fmt: skip
    """Write the positions of the samples of some rays; calls for different ones may run at once."""
    for ray in range(first, last):
        origin, direction = origins[ray * origin_stride :], directions[ray * direction_stride :]
        x, y, z = origin[0], origin[1], origin[2]
        to_x, to_y, to_z = direction[0], direction[1], direction[2]
        start, end, into = starts[ray * start_stride :], ends[ray * end_stride :], positions[3 * ray * columns :]
        for k in range(columns):
            both = start[k] + end[k]
            into[3 * k] = x + to_x * both / TWO
            into[3 * k + 1] = y + to_y * both / TWO
            into[3 * k + 2] = z + to_z * both / TWO


def midpoints(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    starts: Float[Tensor, "rays samples"],
    ends: Float[Tensor, "rays samples"],
) -> Float[Tensor, "rays samples 3"]:
    """Give the positions in the middle of samples, without a gradient."""
    rays, columns = starts.shape
    positions = torch.empty(rays, columns, 3)
    matrices = [each for matrix in (origins, directions, starts, ends) for each in flat_rows(matrix)]
    arrays = *matrices, positions.view(-1).numpy(), columns
    in_parts(lambda first, last: find_midpoints(*arrays, first, last), rays, LEAST_SHARE // max(1, columns))
    return positions


@compiled()
@no_type_check
def _harmonics(directions, stride, encoded, first, last):
    for ray in range(first, last):
        direction, row = directions[ray * stride :], encoded[HARMONICS * ray :]
        # nerfacto encodes directions that it has moved to 0..1
        x, y, z = (direction[0] + ONE) / TWO, (direction[1] + ONE) / TWO, (direction[2] + ONE) / TWO
        xx, yy, zz = x * x, y * y, z * z
        # the real harmonics Y_lm, l from 0 to 3, m from -l to l; each first factor is the constant of its norm
        row[0] = 0.28209479177387814
        row[1] = 0.4886025119029199 * y
        row[2] = 0.4886025119029199 * z
        row[3] = 0.4886025119029199 * x
        row[4] = 1.0925484305920792 * x * y
        row[5] = 1.0925484305920792 * y * z
        row[6] = 0.31539156525252005 * (3 * zz - 1)
        row[7] = 1.0925484305920792 * x * z
        row[8] = 0.5462742152960396 * (xx - yy)
        row[9] = 0.5900435899266435 * y * (3 * xx - yy)
        row[10] = 2.890611442640554 * x * y * z
        row[11] = 0.4570457994644658 * y * (5 * zz - 1)
        row[12] = 0.3731763325901154 * z * (5 * zz - 3)
        row[13] = 0.4570457994644658 * x * (5 * zz - 1)
        row[14] = 1.445305721320277 * z * (xx - yy)
        row[15] = 0.5900435899266435 * x * (xx - 3 * yy)


def harmonics(directions: Float[Tensor, "rays 3"], dtype: torch.dtype) -> Float[Tensor, "rays 16"]:
    """Encode directions as nerfacto does, by the spherical harmonics of four degrees of (d + 1) / 2; no gradient.

    Args:
        directions: of length 1.
        dtype: of what is given.
    """
    encoded = torch.empty(len(directions), HARMONICS)
    arrays = *flat_rows(directions), encoded.view(-1).numpy()
    in_parts(lambda first, last: _harmonics(*arrays, first, last), len(directions), LEAST_SHARE // HARMONICS)
    return encoded.to(dtype)
