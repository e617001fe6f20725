"""From encoded positions to pixels and their losses on the CPU, in one pass over shares of the rays.

Of each sample the networks give four numbers: one for the density, three for the colour. The density is
d = scale exp(first) inside the scene and 0 outside, and the weights are w_k = (1 - exp(-d_k δ_k)) exp(-Σ_j<k d_j δ_j).
The colours c_k are the sigmoid of the other numbers. A pixel is Σ w_k c_k, plus (1 - Σ w_k) times what is behind, times
the gain of its picture. In training the same pass holds colours and weights against what the batch tells of them.
The gradient comes from a second pass, along the rays and back through the networks, which computes densities, colours
and layers again: that is faster than to write them to memory and read them. What a weight would change Eq. 4 and the
distortion loss by is kept from the first pass. A tile of points passes all layers of both networks, so that what stands
between them is never in memory; a thread takes the points of its rays through all of it.

Pure. Importing this module imports Numba.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from edge_depth_nerf.kernels.compiled import compiled, flat
from edge_depth_nerf.kernels.edge_loss_numba import edge_loss_of_ray, has_prior
from edge_depth_nerf.kernels.exponential_numba import exp
from edge_depth_nerf.kernels.network_numba import Arrays, Slopes, writes_forward
from edge_depth_nerf.kernels.pointwise_numba import STEEPEST, flat_rows
from edge_depth_nerf.kernels.ray_numba import distortion_of_ray
from edge_depth_nerf.kernels.rendering import Behind, Losses, Networks, Rendered, Supervision
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE = np.float32(0), np.float32(1)
LAST_SAMPLE, SINGLE_POINT = int(Behind.LAST_SAMPLE), int(Behind.SINGLE_POINT)
LEAST_SHARE = 1 << 11
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
        # single points have no density
        to_values[begin + k] = ZERO
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
        if behind == SINGLE_POINT:
            to_values[begin_of_singles + ray] = ZERO
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


class _Part(NamedTuple):
    """Points that pass the networks in one way: all samples, or all single points."""

    net: Arrays
    begin: int
    """The first one, among all points."""
    rows: slice
    """Where the second network's further inputs stand."""
    joins: bool
    """Whether each point has such inputs of its own; else they are multiplied once a ray."""


def _parts(
    x: Tensor,
    of_rays: Tensor,
    shape: torch.Size,
    joint: int,
    by_ray: Tensor,
    parameters: Sequence[Tensor],
    follow: bool,
) -> list[_Part]:
    """Arrange the networks for samples, then for single points if there are some.

    Args:
        x: encoded positions, [points, in].
        of_rays: further inputs of the second network, for each ray and then each single point.
        shape: rays and samples a ray.
        joint: the second network's first layer.
        by_ray: its weights for the further inputs.
        parameters: weights and biases of both networks, in turns.
        follow: whether a gradient to the further inputs is asked for.

    """
    weights, biases = list(parameters[::2]), [bias.view(1, -1) for bias in parameters[1::2]]
    rays, points = shape[0], shape.numel()
    no_density = by_ray.new_zeros(len(by_ray), 1)
    found = []
    for given, begin, rows in ((x[:points], 0, slice(rays)), (x[points:], points, slice(rays, len(of_rays)))):
        shared = of_rays[rows]
        if len(given) == 0:
            continue
        joins = len(given) == len(shared) and not follow
        columns = [no_density, weights[joint], *([by_ray] if joins else [])]
        bias = biases[joint] if joins else torch.addmm(biases[joint], shared, by_ray.t())
        net = Arrays(
            given,
            [*weights[:joint], torch.cat(columns, dim=1), *weights[joint + 1 :]],
            [*biases[:joint], bias, *biases[joint + 1 :]],
            joint,
            shared if joins else None,
        )
        found.append(_Part(net, begin, rows, joins))
    return found


def _stretches(part: _Part, given: _Given, first: int, last: int) -> list[tuple[int, int]]:
    """Give which points of a part belong to rays from `first` to `last`."""
    if part.begin == 0:
        return [(first * given.samples, last * given.samples)]
    behind = [(first, last)] if given.behind == SINGLE_POINT else []
    begin, from_point, to_point = _further(given, first, last)
    return [*behind, (begin - part.begin + from_point, begin - part.begin + to_point)]


class _Pass(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        of_rays: Tensor,
        by_ray: Tensor,
        gains: Tensor | None,
        joint: int,
        more: tuple[Tensor, Tensor, float, Behind, Supervision | None],
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        inside, deltas, scale, behind, supervision = more
        (rays, samples), points = deltas.shape, len(x)
        singles = points - rays * samples
        further = singles - (rays if behind == Behind.SINGLE_POINT else 0)
        rendered = torch.empty(rays, 3), torch.empty(rays, 1), torch.empty(rays, samples), torch.empty(further, 3)
        slopes = [np.zeros(0 if supervision is None else deltas.numel(), np.float32) for _ in range(2)]
        values = flat(torch.empty(4, points))
        given = _Given(values, flat(inside), flat(deltas), np.float32(scale), int(behind), rays, samples, singles)
        told = _for_kernels(supervision)
        parts = _parts(x, of_rays, deltas.shape, joint, by_ray, parameters, ctx.needs_input_grad[1])
        networks = [(part, writes_forward(part.net, values[part.begin :], points)) for part in parts]
        arrays = given, told, *(flat(each) for each in rendered), *slopes
        sums: dict[int, tuple[float | int, ...]] = {}

        def work(first: int, last: int) -> None:
            for part, apply in networks:
                for stretch in _stretches(part, given, first, last):
                    apply(*stretch)
            sums[first] = _render(*arrays, first, last)

        in_parts(work, rays, _least_rays(given))
        ctx.given, ctx.told, ctx.slopes, ctx.parts, ctx.joint = given, told, slopes, parts, joint
        ctx.set_materialize_grads(False)
        # finds out if they were changed since
        ctx.save_for_backward(rendered[0], rendered[3], x, of_rays, by_ray, *parameters)
        if supervision is None:
            return rendered
        total = _sum_of(sums)
        ctx.over = 3 * rays, 3 * max(1, further), max(1, total.priors), rays, max(1, total.skies)
        losses = (torch.tensor(each / over, dtype=torch.float32) for each, over in zip(total, ctx.over, strict=False))
        return *rendered, *losses

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        rgb, further, x, of_rays, by_ray, *parameters = ctx.saved_tensors
        given, told = ctx.given, ctx.told
        points = len(x)
        to_rendered = [np.empty(0, np.float32) if each is None else flat(each) for each in gradients[:4]]
        to_losses = [ZERO] * 5
        if told.is_there:
            # a squared error has the slope of twice the error
            factors = 2, 2, 1, 1, 1
            to_losses = [
                ZERO if each is None else np.float32(factor * float(each) / over)
                for each, factor, over in zip(gradients[4:], factors, ctx.over, strict=True)
            ]
        to_values = flat(torch.empty(4, points))
        arrays = given, told, flat(rgb), flat(further), *ctx.slopes, _Gradients(*to_rendered, *to_losses), to_values
        steepest = np.float32(STEEPEST)
        # input after input in memory, as the hash grid's backward wants it
        to_x = x.new_empty(x.shape[::-1] if ctx.needs_input_grad[0] else (0, 0))
        slopes = [Slopes(part.net, to_values[part.begin :], points, flat(to_x)[part.begin :]) for part in ctx.parts]
        to_gains: dict[int, np.ndarray] = {}
        sums: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}

        def work(first: int, last: int) -> None:
            to_gains[first], sums[first] = np.zeros(len(told.gains)), [each.nothing() for each in slopes]
            _all_gradients(*arrays, to_gains[first], steepest, first, last)
            for part, of_part, own in zip(ctx.parts, slopes, sums[first], strict=True):
                for stretch in _stretches(part, given, first, last):
                    of_part.add(own, *stretch)

        in_parts(work, given.rays, _least_rays(given))
        order = sorted(sums)
        every = zip(slopes, zip(*(sums[first] for first in order), strict=True), strict=True)
        totals = [of_part.total(own) for of_part, own in every]
        to_rays, to_parameters = _to_networks(ctx, totals, of_rays, by_ray, parameters)
        of_gains = None
        if told.is_there and ctx.needs_input_grad[3]:
            of_gains = torch.from_numpy(sum(to_gains[first] for first in order)).to(torch.float32).view(-1, 3)
        return (
            to_x.t() if ctx.needs_input_grad[0] else None,
            to_rays,
            to_parameters[0],
            of_gains,
            None,
            None,
            *to_parameters[1:],
        )


def _to_networks(
    ctx: Any,
    totals: Sequence[tuple[list[np.ndarray], list[np.ndarray]]],
    of_rays: Tensor,
    by_ray: Tensor,
    parameters: Sequence[Tensor],
) -> tuple[Tensor | None, list[Tensor]]:
    """Give the gradient to the second network's further inputs, and those to its weights for them and all others."""
    joint, width = ctx.joint, parameters[2 * ctx.joint].shape[1]
    to_rays = torch.zeros_like(of_rays) if ctx.needs_input_grad[1] else None
    # of all parts; in numpy, which needs fewer calls for small matrices
    found: list[np.ndarray] = []
    for part, (to_weights, to_biases) in zip(ctx.parts, totals, strict=True):
        of_joint, to_shared = to_weights[joint], to_biases[joint]
        to_by_ray = of_joint[:, 1 + width :]
        if not part.joins:
            # torch's products: numpy's would wake threads of their own
            of_shared = torch.from_numpy(to_shared)
            to_by_ray, to_biases[joint] = (of_shared.t() @ of_rays[part.rows]).numpy(), to_shared.sum(axis=0)
            if to_rays is not None:
                to_rays[part.rows] = of_shared @ by_ray
        to_weights[joint] = of_joint[:, 1 : 1 + width]
        every = [to_by_ray, *(each for pair in zip(to_weights, to_biases, strict=True) for each in pair)]
        found = [total + each for total, each in zip(found, every, strict=True)] if found else every
    return to_rays, [
        torch.from_numpy(np.ascontiguousarray(each)).view(parameter.shape)
        for each, parameter in zip(found, (by_ray, *parameters), strict=True)
    ]


def _least_rays(given: _Given) -> int:
    """How many rays a thread gets at least."""
    return max(1, LEAST_SHARE * given.rays // (given.rays * given.samples + given.singles))


def render(
    x: Float[Tensor, "points in"],
    of_rays: Float[Tensor, "rays_and_singles shared"],
    networks: Networks,
    inside: Float[Tensor, "points"],
    deltas: Float[Tensor, "rays samples"],
    scale: float,
    behind: Behind,
    supervision: Supervision | None = None,
) -> Rendered:
    """Render pixels from encoded positions of the samples of rays, and of single points after them.

    Args:
        x: float32. First come all samples, ray by ray, then any single points; with `Behind.SINGLE_POINT` those of the
            rays come before others.
        of_rays: what the second network gets beside the first one's outputs: for each ray, then each single point.
        networks: from encoded positions to density and colour; the density is `scale` times e to the power of the
            first output, the colour the sigmoid of the second one's outputs.
        inside: 1 where a point is inside the scene, else 0.
        deltas: the samples' lengths; one ray at least.
        scale: the density of an output of 0.
        behind: what colours light that no sample stops.
        supervision: what a batch tells of the pixels.

    Returns:
        Weights that are not a number are 0, as in nerfstudio. Differentiable once, by x, of_rays, the networks and the
        gains.

    """
    layers, biases = ([*networks.first[k], *networks.second[k]] for k in range(2))
    parameters = [each for pair in zip(layers, biases, strict=True) for each in pair]
    gains = None if supervision is None else supervision.gains
    more = inside, deltas, scale, behind, supervision
    x, of_rays, joint = x.contiguous(), of_rays.contiguous(), len(networks.first[0])
    found = _Pass.apply(x, of_rays, networks.by_ray, gains, joint, more, *parameters)
    assert isinstance(found, tuple)
    rgb, accumulation, weights, further, *losses = found
    return Rendered(rgb, accumulation, weights, further, Losses(*losses) if losses else None)
