"""From a field's numbers to pixels on the CPU, in one pass over the rays: densities, weights, colours, what is behind.

Of each sample a network gives four numbers: one for the density, three for the colour. The density is
d = scale exp(first) inside the scene and 0 outside, and the weights are w_k = (1 - exp(-d_k δ_k)) exp(-Σ_j<k d_j δ_j).
The colours c_k are the sigmoid of the other numbers. A pixel is Σ w_k c_k, plus (1 - Σ w_k) times what is behind.
The gradient comes from a second pass, which computes everything again: that is faster than to write it to memory and
read it.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.exponential_numba import exp
from edge_depth_nerf.kernels.pointwise_numba import STEEPEST
from edge_depth_nerf.kernels.rendering import Behind, Rendered
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE = np.float32(0), np.float32(1)
LAST_SAMPLE, SINGLE_POINT = int(Behind.LAST_SAMPLE), int(Behind.SINGLE_POINT)
LEAST_SHARE = 1 << 13
"""A thread gets at least so many points."""


@compiled(error_model="numpy")
@no_type_check
def _sigmoid(x):
    return ONE / (ONE + exp(-x))


@compiled()
@no_type_check
def _sum_depths(before, inside, delta, scale, densities, depths, reached):
    """Write densities and optical depths of a ray's samples, and the sums of the depths in front of each."""
    for k in range(len(depths)):
        densities[k] = scale * exp(before[k]) * inside[k]
        depths[k] = delta[k] * densities[k]
    running = 0.0
    for k in range(len(depths)):
        reached[k] = np.float32(running)
        running += depths[k]


@compiled(error_model="numpy")
@no_type_check
def _render(
    values, inside, deltas, scale, behind, rgb, accumulation, weights, further, rays, samples, singles, first, last
):
    points, begin_of_singles = rays * samples + singles, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    for ray in range(first, last):
        begin = ray * samples
        weight = weights[begin:]
        _sum_depths(values[begin:], inside[begin:], deltas[begin:], scale, densities, depths, reached)
        for k in range(samples):
            found = (ONE - exp(-depths[k])) * exp(-reached[k])
            # as nerfstudio: what is not a number weighs nothing
            weight[k] = found if found == found else ZERO
        hit = 0.0
        for k in range(samples):
            hit += weight[k]
        accumulation[ray] = hit
        for c in range(3):
            plane = values[(c + 1) * points :]
            of_ray = plane[begin:]
            for k in range(samples):
                depths[k] = _sigmoid(of_ray[k]) * weight[k]
            total = 0.0
            for k in range(samples):
                total += depths[k]
            if behind == LAST_SAMPLE:
                total += (1 - hit) * _sigmoid(of_ray[samples - 1])
            elif behind == SINGLE_POINT:
                total += (1 - hit) * _sigmoid(plane[begin_of_singles + ray])
            rgb[3 * ray + c] = total
    # each part takes its share of the points that are not behind a ray
    begin_of_further = begin_of_singles + (rays if behind == SINGLE_POINT else 0)
    count = points - begin_of_further
    from_point, to_point = count * first // rays, count * last // rays
    for c in range(3):
        plane = values[(c + 1) * points + begin_of_further :]
        for k in range(from_point, to_point):
            further[3 * k + c] = _sigmoid(plane[k])


@compiled(error_model="numpy")
@no_type_check
def _gradients(
    values, inside, deltas, scale, behind, to_rgb, to_accumulation, to_weights, to_further, to_values, rays, samples,
    singles, steepest, first, last,
):  # fmt: skip
    points, begin_of_singles = rays * samples + singles, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    weight, of_weight = np.empty(samples, np.float32), np.empty(samples, np.float32)
    most, least = scale * exp(steepest), scale * exp(-steepest)
    for ray in range(first, last):
        begin = ray * samples
        before, within, delta, into = values[begin:], inside[begin:], deltas[begin:], to_values[begin:]
        _sum_depths(before, within, delta, scale, densities, depths, reached)
        given = to_weights[begin:]
        hit = 0.0
        for k in range(samples):
            depths[k], reached[k] = exp(-depths[k]), exp(-reached[k])
            weight[k] = (ONE - depths[k]) * reached[k]
            hit += weight[k] if weight[k] == weight[k] else ZERO
        left = np.float32(1 - hit)
        to_hit = to_accumulation[ray]
        for c in range(3):
            g = to_rgb[3 * ray + c]
            if behind == LAST_SAMPLE:
                to_hit -= g * _sigmoid(values[(c + 1) * points + begin + samples - 1])
            elif behind == SINGLE_POINT:
                to_hit -= g * _sigmoid(values[(c + 1) * points + begin_of_singles + ray])
        for k in range(samples):
            of_weight[k] = given[k] + to_hit
        for c in range(3):
            g = to_rgb[3 * ray + c]
            plane, to_plane = values[(c + 1) * points :], to_values[(c + 1) * points :]
            of_ray, into_ray = plane[begin:], to_plane[begin:]
            for k in range(samples):
                colour = _sigmoid(of_ray[k])
                of_weight[k] += g * colour
                own = weight[k] if weight[k] == weight[k] else ZERO
                into_ray[k] = g * own * colour * (ONE - colour)
            if behind == LAST_SAMPLE:
                colour = _sigmoid(of_ray[samples - 1])
                into_ray[samples - 1] += g * left * colour * (ONE - colour)
            elif behind == SINGLE_POINT:
                colour = _sigmoid(plane[begin_of_singles + ray])
                to_plane[begin_of_singles + ray] = g * left * colour * (ONE - colour)
        # Σ_j>k g_j w_j, of what lies behind each sample; 0 times what is not a number is none: a broken training shows
        after = 0.0
        for k in range(samples - 1, -1, -1):
            g = of_weight[k] if weight[k] == weight[k] else ZERO
            to_density = delta[k] * (g * depths[k] * reached[k] - np.float32(after))
            after += g * weight[k]
            # the densities themselves, but for those whose slope is limited, as by nerfstudio's `trunc_exp`
            slope = most * within[k] if before[k] > steepest else densities[k]
            slope = least * within[k] if before[k] < -steepest else slope
            into[k] = to_density * slope
    begin_of_further = begin_of_singles + (rays if behind == SINGLE_POINT else 0)
    count = points - begin_of_further
    from_point, to_point = count * first // rays, count * last // rays
    for c in range(3):
        plane, to_plane = (
            values[(c + 1) * points + begin_of_further :],
            to_values[(c + 1) * points + begin_of_further :],
        )
        for k in range(from_point, to_point):
            colour = _sigmoid(plane[k])
            to_plane[k] = to_further[3 * k + c] * colour * (ONE - colour)
    # single points have no density
    first_single, last_single = begin_of_singles + singles * first // rays, begin_of_singles + singles * last // rays
    for k in range(first_single, last_single):
        to_values[k] = ZERO


class _Rendering(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, inside: Tensor, deltas: Tensor, scale: float, behind: Behind
    ) -> tuple[Tensor, ...]:
        rays, samples = deltas.shape
        singles = values.shape[1] - rays * samples
        further = singles - (rays if behind == Behind.SINGLE_POINT else 0)
        rendered = Rendered(
            torch.empty(rays, 3), torch.empty(rays, 1), torch.empty(rays, samples), torch.empty(further, 3)
        )
        ctx.given = flat(values), flat(inside), flat(deltas), np.float32(scale), int(behind)
        ctx.counts = rays, samples, singles
        arrays = *ctx.given, *(flat(each) for each in rendered), *ctx.counts
        in_parts(lambda first, last: _render(*arrays, first, last), rays, _least_rays(ctx.counts))
        # finds out if it was changed since
        ctx.save_for_backward(values)
        return rendered

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        (values,) = ctx.saved_tensors
        rays, samples, singles = ctx.counts
        to_values = torch.empty(values.shape)
        arrays = *ctx.given, *(flat(each) for each in gradients), flat(to_values), rays, samples, singles
        steepest = np.float32(STEEPEST)
        in_parts(lambda first, last: _gradients(*arrays, steepest, first, last), rays, _least_rays(ctx.counts))
        return to_values, None, None, None, None


def _least_rays(counts: tuple[int, int, int]) -> int:
    """How many rays a thread gets at least, of so many rays, samples a ray and single points."""
    rays, samples, singles = counts
    return max(1, LEAST_SHARE * rays // (rays * samples + singles))


def render(
    values: Float[Tensor, "4 points"],
    inside: Float[Tensor, "points"],
    deltas: Float[Tensor, "rays samples"],
    scale: float,
    behind: Behind,
) -> Rendered:
    """Render pixels from what networks give for the samples of rays, and for single points after them.

    Args:
        values: for the density and for red, green and blue; contiguous float32. Differentiable once, by them alone.
            First come all samples, ray by ray, then any single points; with `Behind.SINGLE_POINT` those of the rays
            come before others.
        inside: 1 where a point is inside the scene, else 0.
        deltas: the samples' lengths; one ray at least.
        scale: the density of a value of 0.
        behind: what colours light that no sample stops.

    Returns:
        Weights that are not a number are 0, as in nerfstudio.

    """
    return Rendered(*_Rendering.apply(values, inside, deltas, scale, behind))  # pyright: ignore[reportGeneralTypeIssues]
