"""From a field's numbers to pixels and their losses on the CPU, in one pass over the rays.

Of each sample a network gives four numbers: one for the density, three for the colour. The density is
d = scale exp(first) inside the scene and 0 outside, and the weights are w_k = (1 - exp(-d_k δ_k)) exp(-Σ_j<k d_j δ_j).
The colours c_k are the sigmoid of the other numbers. A pixel is Σ w_k c_k, plus (1 - Σ w_k) times what is behind, times
the gain of its picture. In training the same pass holds colours and weights against what the batch tells of them.
The gradient comes from a second pass, which computes densities and colours again: that is faster than to write them to
memory and read them. What a weight would change Eq. 4 and the distortion loss by is kept from the first pass.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.edge_loss_numba import edge_loss_of_ray, has_prior
from edge_depth_nerf.kernels.exponential_numba import exp
from edge_depth_nerf.kernels.pointwise_numba import STEEPEST, flat_rows
from edge_depth_nerf.kernels.ray_numba import distortion_of_ray
from edge_depth_nerf.kernels.rendering import Behind, Losses, Rendered, Supervision
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE = np.float32(0), np.float32(1)
LAST_SAMPLE, SINGLE_POINT = int(Behind.LAST_SAMPLE), int(Behind.SINGLE_POINT)
LEAST_SHARE = 1 << 13
"""A thread gets at least so many points."""


class _Given(NamedTuple):
    """What is rendered, flat."""

    values: Any
    inside: Any
    deltas: Any
    scale: np.float32
    behind: int
    rays: int
    samples: int
    singles: int


class _Told(NamedTuple):
    """`Supervision` for the kernels, flat; rows of matrices lie `..._stride` numbers apart."""

    is_there: bool
    image: Any
    counts: Any
    gains: Any
    pictures: Any
    edges: Any
    edge_stride: int
    starts: Any
    start_stride: int
    ends: Any
    end_stride: int
    prior: Any
    sigma: Any
    sky: Any
    metres_per_unit: np.float32
    eps: np.float32
    narrow: np.float32
    interval: bool
    norm: bool


class _Gradients(NamedTuple):
    """Of what was rendered, flat and empty where there is none; of each loss by one ray, pixel or colour."""

    rgb: Any
    accumulation: Any
    weights: Any
    further: Any
    colour: Any
    surface: Any
    edge: Any
    distortion: Any
    sky: Any


class _Sums(NamedTuple):
    """Over rays or pixels: losses, and how many have a prior or the sky."""

    colour: float
    surface: float
    edge: float
    distortion: float
    sky: float
    priors: int
    skies: int


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


@compiled()
@no_type_check
def _further(given, first, last):
    """Give where the points begin that are not behind a ray, and which of them a part of the rays takes."""
    begin = given.rays * given.samples + (given.rays if given.behind == SINGLE_POINT else 0)
    count = given.rays * given.samples + given.singles - begin
    return begin, count * first // given.rays, count * last // given.rays


@compiled(error_model="numpy")
@no_type_check
def _render_further(given, told, further, first, last):
    """Write the colours of the points that are not behind a ray; give the sum of their loss."""
    rays, points = given.rays, given.rays * given.samples + given.singles
    begin, from_point, to_point = _further(given, first, last)
    for c in range(3):
        plane = given.values[(c + 1) * points + begin :]
        for k in range(from_point, to_point):
            further[3 * k + c] = _sigmoid(plane[k])
    loss = 0.0
    if told.is_there:
        for k in range(from_point, to_point):
            gains = told.gains[3 * told.pictures[rays + k] :]
            for c in range(3):
                further[3 * k + c] *= gains[c]
                if told.counts[k]:
                    off = further[3 * k + c] - told.image[3 * (rays + k) + c]
                    loss += off * off
    return loss


@compiled(error_model="numpy")
@no_type_check
def _render(given, told, rgb, accumulation, weights, further, edge_slopes, distortion_slopes, first, last):
    values, rays, samples, behind = given.values, given.rays, given.samples, given.behind
    points, begin_of_singles = rays * samples + given.singles, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    before = np.empty(samples, np.float64)
    of_colour, of_edge, of_distortion, of_sky, priors, skies = 0.0, 0.0, 0.0, 0.0, 0, 0
    for ray in range(first, last):
        begin = ray * samples
        weight = weights[begin:]
        _sum_depths(values[begin:], given.inside[begin:], given.deltas[begin:], given.scale, densities, depths, reached)
        for k in range(samples):
            found = (ONE - exp(-depths[k])) * exp(-reached[k])
            # as nerfstudio: what is not a number weighs nothing
            weight[k] = found if found == found else ZERO
        hit = 0.0
        for k in range(samples):
            hit += weight[k]
        accumulation[ray] = hit
        if told.is_there:
            of_distortion += distortion_of_ray(
                told.edges[ray * told.edge_stride :], weight, distortion_slopes[begin:], before, samples, True
            )
            if has_prior(told.prior[ray], told.sigma[ray]):
                priors += 1
                of_edge += edge_loss_of_ray(
                    weight, told.starts[ray * told.start_stride :], told.ends[ray * told.end_stride :],
                    told.prior[ray], told.sigma[ray], edge_slopes[begin:], samples,
                    told.metres_per_unit, told.eps, told.narrow, told.interval, told.norm, True,
                )  # fmt: skip
            if told.sky[ray]:
                skies += 1
                of_sky += hit
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
            if told.is_there:
                total *= told.gains[3 * told.pictures[ray] + c]
                off = total - told.image[3 * ray + c]
                of_colour += off * off
            rgb[3 * ray + c] = total
    of_surface = _render_further(given, told, further, first, last)
    return of_colour, of_surface, of_edge, of_distortion, of_sky, priors, skies


@compiled(error_model="numpy")
@no_type_check
def _further_gradients(given, told, further, gradients, to_values, to_gains, first, last):
    rays, points = given.rays, given.rays * given.samples + given.singles
    begin, from_point, to_point = _further(given, first, last)
    for k in range(from_point, to_point):
        for c in range(3):
            g, gain = gradients.further[3 * k + c] if len(gradients.further) else ZERO, ONE
            if told.is_there:
                picture = 3 * told.pictures[rays + k] + c
                gain = told.gains[picture]
                if told.counts[k]:
                    g += gradients.surface * (further[3 * k + c] - told.image[3 * (rays + k) + c])
                to_gains[picture] += g * further[3 * k + c] / gain
            # the sigmoid's slope by its value, c (1 - c) with c = further / gain
            to_values[(c + 1) * points + begin + k] = g * further[3 * k + c] * (ONE - further[3 * k + c] / gain)


@compiled(error_model="numpy")
@no_type_check
def _all_gradients(
    given, told, rgb, further, edge_slopes, distortion_slopes, gradients, to_values, to_gains, steepest, first, last
):
    values, rays, samples, behind = given.values, given.rays, given.samples, given.behind
    points, begin_of_singles = rays * samples + given.singles, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    weight, of_weight = np.empty(samples, np.float32), np.empty(samples, np.float32)
    most, least = given.scale * exp(steepest), given.scale * exp(-steepest)
    for ray in range(first, last):
        begin = ray * samples
        before, within, delta = values[begin:], given.inside[begin:], given.deltas[begin:]
        into = to_values[begin:]
        _sum_depths(before, within, delta, given.scale, densities, depths, reached)
        hit = 0.0
        for k in range(samples):
            depths[k], reached[k] = exp(-depths[k]), exp(-reached[k])
            weight[k] = (ONE - depths[k]) * reached[k]
            hit += weight[k] if weight[k] == weight[k] else ZERO
        left = np.float32(1 - hit)
        to_hit = gradients.accumulation[ray] if len(gradients.accumulation) else ZERO
        if told.is_there and told.sky[ray]:
            to_hit += gradients.sky
        for k in range(samples):
            of_weight[k] = gradients.weights[begin + k] if len(gradients.weights) else ZERO
        if told.is_there:
            edge_slope, distortion_slope = edge_slopes[begin:], distortion_slopes[begin:]
            for k in range(samples):
                of_weight[k] += gradients.edge * edge_slope[k] + gradients.distortion * distortion_slope[k]
        for c in range(3):
            g = gradients.rgb[3 * ray + c] if len(gradients.rgb) else ZERO
            if told.is_there:
                picture = 3 * told.pictures[ray] + c
                g += gradients.colour * (rgb[3 * ray + c] - told.image[3 * ray + c])
                to_gains[picture] += g * rgb[3 * ray + c] / told.gains[picture]
                g *= told.gains[picture]
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
                to_hit -= g * colour
            elif behind == SINGLE_POINT:
                colour = _sigmoid(plane[begin_of_singles + ray])
                to_plane[begin_of_singles + ray] = g * left * colour * (ONE - colour)
                to_hit -= g * colour
        # Σ_j>k g_j w_j, of what lies behind each sample; 0 times what is not a number is none: a broken training shows
        after = 0.0
        for k in range(samples - 1, -1, -1):
            g = of_weight[k] + to_hit if weight[k] == weight[k] else ZERO
            to_density = delta[k] * (g * depths[k] * reached[k] - np.float32(after))
            after += g * weight[k]
            # the densities themselves, but for those whose slope is limited, as by nerfstudio's `trunc_exp`
            slope = most * within[k] if before[k] > steepest else densities[k]
            slope = least * within[k] if before[k] < -steepest else slope
            into[k] = to_density * slope
    _further_gradients(given, told, further, gradients, to_values, to_gains, first, last)
    # single points have no density
    singles = given.singles
    first_single, last_single = begin_of_singles + singles * first // rays, begin_of_singles + singles * last // rays
    for k in range(first_single, last_single):
        to_values[k] = ZERO


def _nothing() -> Supervision:
    """Give supervision that tells nothing."""
    numbers, truths, matrix = torch.empty(0), torch.empty(0, dtype=torch.bool), torch.empty(0, 0)
    return Supervision(
        image=torch.empty(0, 3),
        counts=truths,
        gains=torch.empty(0, 3),
        pictures=torch.empty(0, dtype=torch.int64),
        edges=matrix,
        starts=matrix,
        ends=matrix,
        prior_m=numbers,
        sigma_m=numbers,
        sky=truths,
        metres_per_unit=1.0,
        interval=False,
        divide_by_norm=False,
        eps=0.0,
        narrow=0.0,
    )


def _for_kernels(supervision: Supervision | None) -> _Told:
    """Give arrays of what is told, empty ones if nothing is."""
    told = _nothing() if supervision is None else supervision
    (edges, edge_stride), (starts, start_stride), (ends, end_stride) = map(
        flat_rows, (told.edges, told.starts, told.ends)
    )
    return _Told(
        is_there=supervision is not None,
        image=flat(told.image),
        counts=flat(told.counts),
        gains=flat(told.gains),
        pictures=flat(told.pictures),
        edges=edges,
        edge_stride=edge_stride,
        starts=starts,
        start_stride=start_stride,
        ends=ends,
        end_stride=end_stride,
        prior=flat(told.prior_m),
        sigma=flat(told.sigma_m),
        sky=flat(told.sky),
        metres_per_unit=np.float32(told.metres_per_unit),
        eps=np.float32(told.eps),
        narrow=np.float32(told.narrow),
        interval=told.interval,
        norm=told.divide_by_norm,
    )


def _sum_of(parts: dict[int, tuple[float | int, ...]]) -> _Sums:
    """Sum up what the parts gave, in the order of the rays, whichever thread was ready first: always the same sum."""
    return _Sums(*(sum(numbers) for numbers in zip(*(parts[first] for first in sorted(parts)), strict=True)))


class _Rendering(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        values: Tensor,
        gains: Tensor | None,
        inside: Tensor,
        deltas: Tensor,
        scale: float,
        behind: Behind,
        supervision: Supervision | None,
    ) -> tuple[Tensor, ...]:
        rays, samples = deltas.shape
        singles = values.shape[1] - rays * samples
        further = singles - (rays if behind == Behind.SINGLE_POINT else 0)
        rendered = torch.empty(rays, 3), torch.empty(rays, 1), torch.empty(rays, samples), torch.empty(further, 3)
        slopes = [np.zeros(0 if supervision is None else deltas.numel(), np.float32) for _ in range(2)]
        given = _Given(flat(values), flat(inside), flat(deltas), np.float32(scale), int(behind), rays, samples, singles)
        told = _for_kernels(supervision)
        arrays = given, told, *(flat(each) for each in rendered), *slopes
        parts: dict[int, tuple[float | int, ...]] = {}

        def work(first: int, last: int) -> None:
            parts[first] = _render(*arrays, first, last)

        in_parts(work, rays, _least_rays(given))
        ctx.given, ctx.told, ctx.slopes = given, told, slopes
        ctx.set_materialize_grads(False)
        # finds out if they were changed since
        ctx.save_for_backward(values, rendered[0], rendered[3])
        if supervision is None:
            return rendered
        sums = _sum_of(parts)
        ctx.over = 3 * rays, 3 * max(1, further), max(1, sums.priors), rays, max(1, sums.skies)
        losses = (torch.tensor(each / over, dtype=torch.float32) for each, over in zip(sums[:5], ctx.over, strict=True))
        return *rendered, *losses

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        values, rgb, further = ctx.saved_tensors
        given, told = ctx.given, ctx.told
        to_values = torch.empty(values.shape)
        to_rendered = [np.empty(0, np.float32) if each is None else flat(each) for each in gradients[:4]]
        to_losses = [ZERO] * 5
        if told.is_there:
            # a squared error has the slope of twice the error
            factors = 2, 2, 1, 1, 1
            to_losses = [
                ZERO if each is None else np.float32(factor * float(each) / over)
                for each, factor, over in zip(gradients[4:], factors, ctx.over, strict=True)
            ]
        arrays = (
            given,
            told,
            flat(rgb),
            flat(further),
            *ctx.slopes,
            _Gradients(*to_rendered, *to_losses),
            flat(to_values),
        )
        steepest = np.float32(STEEPEST)
        to_gains: dict[int, np.ndarray] = {}

        def work(first: int, last: int) -> None:
            to_gains[first] = np.zeros(len(told.gains))
            _all_gradients(*arrays, to_gains[first], steepest, first, last)

        in_parts(work, given.rays, _least_rays(given))
        of_gains = None
        if told.is_there and ctx.needs_input_grad[1]:
            every = sum(to_gains[first] for first in sorted(to_gains))
            of_gains = torch.from_numpy(every).to(torch.float32).view(-1, 3)
        return to_values, of_gains, None, None, None, None, None


def _least_rays(given: _Given) -> int:
    """How many rays a thread gets at least."""
    return max(1, LEAST_SHARE * given.rays // (given.rays * given.samples + given.singles))


def render(
    values: Float[Tensor, "4 points"],
    inside: Float[Tensor, "points"],
    deltas: Float[Tensor, "rays samples"],
    scale: float,
    behind: Behind,
    supervision: Supervision | None = None,
) -> Rendered:
    """Render pixels from what networks give for the samples of rays, and for single points after them.

    Args:
        values: for the density and for red, green and blue; contiguous float32. Differentiable once.
            First come all samples, ray by ray, then any single points; with `Behind.SINGLE_POINT` those of the rays
            come before others.
        inside: 1 where a point is inside the scene, else 0.
        deltas: the samples' lengths; one ray at least.
        scale: the density of a value of 0.
        behind: what colours light that no sample stops.
        supervision: what a batch tells of the pixels. Differentiable once by its gains, and by nothing else.

    Returns:
        Weights that are not a number are 0, as in nerfstudio.

    """
    gains = None if supervision is None else supervision.gains
    found = _Rendering.apply(values, gains, inside, deltas, scale, behind, supervision)
    assert isinstance(found, tuple)
    rgb, accumulation, weights, further, *losses = found
    return Rendered(rgb, accumulation, weights, further, Losses(*losses) if losses else None)
