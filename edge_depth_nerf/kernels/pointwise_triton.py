"""What nerfacto computes number by number on a GPU, each in one kernel: torch needs four to seventy.

Distances of places in 0..1, positions in the unit cube, densities, and directions in spherical harmonics. All
arithmetic is float32. With TRITON_INTERPRET=1 set before the import the kernels run on CPU tensors.
"""

from __future__ import annotations

from typing import Any, no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.formulas import HARMONICS
from edge_depth_nerf.kernels.triton_launch import launch, rows_of

NUMBERS = 256
"""Numbers that one program works on."""
STEEPEST = tl.constexpr(15.0)
"""nerfstudio's: the gradient of exp(x) is taken at an x of this at most."""


@triton.jit
@no_type_check  # the tests' type checker would wrap what Triton has to read
def _spacing(distance):
    """Give the place in the sampler's spacing of a distance in scene units."""
    return tl.where(distance < 1, distance / 2, 1 - tl.div_rn(1.0, 2 * distance))


@triton.jit
@no_type_check
def _distance_kernel(places, nears, fars, distances, numbers, stride, columns, NUMBERS: tl.constexpr):
    number = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    inside = number < numbers
    ray = number // columns
    place = tl.load(places + ray * stride + number % columns, inside, 0.0)
    near, far = _spacing(tl.load(nears + ray, inside, 1.0)), _spacing(tl.load(fars + ray, inside, 1.0))
    # torch's way of going from one to the other
    x = tl.where(tl.abs(place) < 0.5, near + place * (far - near), far - (far - near) * (1 - place))
    tl.store(distances + number, tl.where(x < 0.5, 2 * x, tl.div_rn(1.0, 2 - 2 * x)), inside)


def distances(
    places: Float[Tensor, "rays places"], nears: Float[Tensor, "rays 1"], fars: Float[Tensor, "rays 1"]
) -> Float[Tensor, "rays places"]:
    """Give distances along rays, in scene units, of places from 0, the near plane, to 1, the far one; no gradient.

    The spacing is that of nerfstudio's piecewise sampler: even up to 1, even in the inverse of the distance from there.
    """
    nears, fars = nears.detach().contiguous(), fars.detach().contiguous()
    places, stride = rows_of(places)
    found = torch.empty(places.shape, device=places.device)
    programs = triton.cdiv(places.numel(), NUMBERS)
    arguments = places, nears, fars, found, places.numel(), stride, places.shape[1]
    launch(_distance_kernel, (programs,), *arguments, NUMBERS=NUMBERS)
    return found


@triton.jit
@no_type_check
def _contract_kernel(positions, places, inside, points, NUMBERS: tl.constexpr):
    point = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    given = point < points
    x = tl.load(positions + 3 * point, given, 0.0)
    y = tl.load(positions + 3 * point + 1, given, 0.0)
    z = tl.load(positions + 3 * point + 2, given, 0.0)
    norm = tl.maximum(tl.maximum(tl.abs(x), tl.abs(y)), tl.abs(z))
    far = norm >= 1
    size = tl.where(far, norm, 1.0)
    factor = 2 - tl.div_rn(1.0, size)
    # what is no number is not inside
    x = (tl.where(far, factor * tl.div_rn(x, size), x) + 2) / 4
    y = (tl.where(far, factor * tl.div_rn(y, size), y) + 2) / 4
    z = (tl.where(far, factor * tl.div_rn(z, size), z) + 2) / 4
    within = (x > 0) & (y > 0) & (z > 0) & (x < 1) & (y < 1) & (z < 1)
    tl.store(places + 3 * point, tl.where(within, x, x * 0), given)
    tl.store(places + 3 * point + 1, tl.where(within, y, y * 0), given)
    tl.store(places + 3 * point + 2, tl.where(within, z, z * 0), given)
    tl.store(inside + point, tl.where(within, 1.0, 0.0), given)


def contract(positions: Float[Tensor, "points 3"]) -> tuple[Float[Tensor, "points 3"], Float[Tensor, "points"]]:
    """Contract positions, float32, without a gradient.

    Returns:
        The positions in 0..1; 1 where a point is inside, else 0.
    """
    positions = positions.detach().contiguous()
    places, inside = torch.empty_like(positions), positions.new_empty(len(positions))
    programs = triton.cdiv(len(positions), NUMBERS)
    launch(_contract_kernel, (programs,), positions, places, inside, len(positions), NUMBERS=NUMBERS)
    return places, inside


@triton.jit
@no_type_check
def _density_kernel(before, inside, densities, numbers, stride, scale, NUMBERS: tl.constexpr):
    number = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    given = number < numbers
    x = tl.load(before + number * stride, given, 0.0).to(tl.float32)
    tl.store(densities + number, scale * tl.exp(x) * tl.load(inside + number, given, 0.0), given)


@triton.jit
@no_type_check
def _before_gradient_kernel(before, inside, gradient, to_before, numbers, stride, scale, NUMBERS: tl.constexpr):
    number = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    given = number < numbers
    x = tl.load(before + number * stride, given, 0.0).to(tl.float32)
    # what is no number stays none
    x = tl.where(x > STEEPEST, STEEPEST, tl.where(x < -STEEPEST, -STEEPEST, x))
    g = tl.load(gradient + number, given, 0.0) * tl.load(inside + number, given, 0.0)
    tl.store(to_before + number, (g * scale * tl.exp(x)).to(to_before.dtype.element_ty), given)


class _Density(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, before: Tensor, inside: Tensor, scale: float) -> Tensor:
        before, inside = before.detach(), inside.detach().contiguous()
        densities = torch.empty(len(before), device=before.device)
        programs = triton.cdiv(len(before), NUMBERS)
        arguments = before, inside, densities, len(before), before.stride(0), scale
        launch(_density_kernel, (programs,), *arguments, NUMBERS=NUMBERS)
        if ctx.needs_input_grad[0]:
            ctx.save_for_backward(before, inside)
            ctx.scale = scale
        return densities

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        before, inside = ctx.saved_tensors
        to_before = torch.empty(before.shape, dtype=before.dtype, device=before.device)
        programs = triton.cdiv(len(before), NUMBERS)
        arguments = before, inside, gradients[0].contiguous(), to_before, len(before), before.stride(0), ctx.scale
        launch(_before_gradient_kernel, (programs,), *arguments, NUMBERS=NUMBERS)
        return to_before, None, None


def density(before: Float[Tensor, "points"], inside: Float[Tensor, "points"], scale: float) -> Float[Tensor, "points"]:
    """Compute densities, scale · exp(before) inside the scene and 0 outside; the gradient as nerfstudio's `trunc_exp`.

    A network's outputs, `before`, are half precision or float32, of any stride; differentiable once, by them alone.
    `inside` is 1 or 0, and float32 as the result.
    """
    found = _Density.apply(before, inside, scale)
    assert isinstance(found, Tensor)
    return found


@triton.jit
@no_type_check
def _harmonics_kernel(directions, encoded, rays, stride, NUMBERS: tl.constexpr):
    ray = tl.program_id(0).to(tl.int64) * NUMBERS + tl.arange(0, NUMBERS)
    inside = ray < rays
    # nerfacto encodes directions that it has moved to 0..1
    x = (tl.load(directions + ray * stride, inside, 0.0) + 1) / 2
    y = (tl.load(directions + ray * stride + 1, inside, 0.0) + 1) / 2
    z = (tl.load(directions + ray * stride + 2, inside, 0.0) + 1) / 2
    xx, yy, zz = x * x, y * y, z * z
    kind = encoded.dtype.element_ty
    row = encoded + ray * 16
    # the real harmonics Y_lm, l from 0 to 3, m from -l to l; each first factor is the constant of its norm
    tl.store(row, tl.full(x.shape, 0.28209479177387814, tl.float32).to(kind), inside)
    tl.store(row + 1, (0.4886025119029199 * y).to(kind), inside)
    tl.store(row + 2, (0.4886025119029199 * z).to(kind), inside)
    tl.store(row + 3, (0.4886025119029199 * x).to(kind), inside)
    tl.store(row + 4, (1.0925484305920792 * x * y).to(kind), inside)
    tl.store(row + 5, (1.0925484305920792 * y * z).to(kind), inside)
    tl.store(row + 6, (0.31539156525252005 * (3 * zz - 1)).to(kind), inside)
    tl.store(row + 7, (1.0925484305920792 * x * z).to(kind), inside)
    tl.store(row + 8, (0.5462742152960396 * (xx - yy)).to(kind), inside)
    tl.store(row + 9, (0.5900435899266435 * y * (3 * xx - yy)).to(kind), inside)
    tl.store(row + 10, (2.890611442640554 * x * y * z).to(kind), inside)
    tl.store(row + 11, (0.4570457994644658 * y * (5 * zz - 1)).to(kind), inside)
    tl.store(row + 12, (0.3731763325901154 * z * (5 * zz - 3)).to(kind), inside)
    tl.store(row + 13, (0.4570457994644658 * x * (5 * zz - 1)).to(kind), inside)
    tl.store(row + 14, (1.445305721320277 * z * (xx - yy)).to(kind), inside)
    tl.store(row + 15, (0.5900435899266435 * x * (xx - 3 * yy)).to(kind), inside)


def harmonics(directions: Float[Tensor, "rays 3"], dtype: torch.dtype) -> Float[Tensor, "rays 16"]:
    """Encode unit vectors as nerfacto does, by the spherical harmonics of four degrees of (d + 1) / 2; no gradient."""
    directions, stride = rows_of(directions)
    encoded = torch.empty(len(directions), HARMONICS, dtype=dtype, device=directions.device)
    programs = triton.cdiv(len(directions), NUMBERS)
    launch(_harmonics_kernel, (programs,), directions, encoded, len(directions), stride, NUMBERS=NUMBERS)
    return encoded
