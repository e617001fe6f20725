"""From encoded positions to pixels on the CPU, in one pass over shares of the rays.

Of each sample the networks give four numbers: one for the density, three for the colour. The density is
d = scale exp(first) inside the scene and 0 outside, and the weights are w_k = (1 - exp(-d_k δ_k)) exp(-Σ_j<k d_j δ_j).
The colours c_k are the sigmoid of the other numbers. A pixel is Σ w_k c_k, plus (1 - Σ w_k) times its background.
A thread takes a tile of its rays' points through both networks at once. A second pass gives the gradient and computes
densities, colours and layers again: both are faster than writing to memory and reading.

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
from edge_depth_nerf.kernels.network_numba import Arrays, Slopes, writes_forward
from edge_depth_nerf.kernels.rendering import Background, Networks, Rendered
from edge_depth_nerf.kernels.threads import in_parts

ZERO, ONE = np.float32(0), np.float32(1)
STEEPEST = 15.0
"""nerfstudio's: the gradient of exp(x) is taken at an x of this at most."""
LAST_SAMPLE, POINT = int(Background.LAST_SAMPLE), int(Background.POINT)
LEAST_SHARE = 1 << 11
"""A thread gets at least so many points."""


class _Given(NamedTuple):
    """What is rendered, flat."""

    values: Any
    inside: Any
    deltas: Any
    scale: np.float32
    background: int
    rays: int
    samples: int
    single: int
    """Points that are no samples."""


class _Gradients(NamedTuple):
    """Of what was rendered, flat and empty where there is none."""

    rgb: Any
    accumulation: Any
    weights: Any
    point_rgb: Any


@compiled(error_model="numpy")
@no_type_check
def _sigmoid(x):
    return ONE / (ONE + np.exp(-x))


@compiled()
@no_type_check
def _sum_depths(before, inside, delta, scale, densities, depths, reached):
    """Write densities and optical depths of a ray's samples, and the sums of the depths in front of each."""
    for k in range(len(depths)):
        densities[k] = scale * np.exp(before[k]) * inside[k]
        depths[k] = delta[k] * densities[k]
    running = 0.0
    for k in range(len(depths)):
        reached[k] = np.float32(running)
        running += depths[k]


@compiled()
@no_type_check
def _own_points(given, first, last):
    """Give where the points begin that are no background, and which of them a part of the rays takes."""
    begin = given.rays * given.samples + (given.rays if given.background == POINT else 0)
    count = given.rays * given.samples + given.single - begin
    return begin, count * first // given.rays, count * last // given.rays


@compiled(error_model="numpy")
@no_type_check
def _render(given, rgb, accumulation, weights, point_rgb, first, last):
    values, rays, samples, background = given.values, given.rays, given.samples, given.background
    points, begin_of_single = rays * samples + given.single, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    for ray in range(first, last):
        begin = ray * samples
        weight = weights[begin:]
        _sum_depths(values[begin:], given.inside[begin:], given.deltas[begin:], given.scale, densities, depths, reached)
        for k in range(samples):
            found = (ONE - np.exp(-depths[k])) * np.exp(-reached[k])
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
            if background == LAST_SAMPLE:
                total += (1 - hit) * _sigmoid(of_ray[samples - 1])
            elif background == POINT:
                total += (1 - hit) * _sigmoid(plane[begin_of_single + ray])
            rgb[3 * ray + c] = total
    begin, from_point, to_point = _own_points(given, first, last)
    for c in range(3):
        plane = values[(c + 1) * points + begin :]
        for k in range(from_point, to_point):
            point_rgb[3 * k + c] = _sigmoid(plane[k])


@compiled(error_model="numpy")
@no_type_check
def _all_gradients(given, point_rgb, gradients, to_values, steepest, first, last):
    values, rays, samples, background = given.values, given.rays, given.samples, given.background
    points, begin_of_single = rays * samples + given.single, rays * samples
    densities, depths, reached = (np.empty(samples, np.float32), np.empty(samples, np.float32),
                                  np.empty(samples, np.float32))  # fmt: skip
    weight, of_weight = np.empty(samples, np.float32), np.empty(samples, np.float32)
    most, least = given.scale * np.exp(steepest), given.scale * np.exp(-steepest)
    for ray in range(first, last):
        begin = ray * samples
        before, within, delta = values[begin:], given.inside[begin:], given.deltas[begin:]
        into = to_values[begin:]
        _sum_depths(before, within, delta, given.scale, densities, depths, reached)
        hit = 0.0
        for k in range(samples):
            depths[k], reached[k] = np.exp(-depths[k]), np.exp(-reached[k])
            weight[k] = (ONE - depths[k]) * reached[k]
            hit += weight[k] if weight[k] == weight[k] else ZERO
        left = np.float32(1 - hit)
        to_hit = gradients.accumulation[ray] if len(gradients.accumulation) else ZERO
        for k in range(samples):
            of_weight[k] = gradients.weights[begin + k] if len(gradients.weights) else ZERO
        for c in range(3):
            g = gradients.rgb[3 * ray + c] if len(gradients.rgb) else ZERO
            plane, to_plane = values[(c + 1) * points :], to_values[(c + 1) * points :]
            of_ray, into_ray = plane[begin:], to_plane[begin:]
            for k in range(samples):
                colour = _sigmoid(of_ray[k])
                of_weight[k] += g * colour
                own = weight[k] if weight[k] == weight[k] else ZERO
                into_ray[k] = g * own * colour * (ONE - colour)
            if background == LAST_SAMPLE:
                colour = _sigmoid(of_ray[samples - 1])
                into_ray[samples - 1] += g * left * colour * (ONE - colour)
                to_hit -= g * colour
            elif background == POINT:
                colour = _sigmoid(plane[begin_of_single + ray])
                to_plane[begin_of_single + ray] = g * left * colour * (ONE - colour)
                to_hit -= g * colour
        if background == POINT:
            to_values[begin_of_single + ray] = ZERO
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
    begin, from_point, to_point = _own_points(given, first, last)
    for k in range(from_point, to_point):
        # single points have no density
        to_values[begin + k] = ZERO
        for c in range(3):
            g, colour = gradients.point_rgb[3 * k + c] if len(gradients.point_rgb) else ZERO, point_rgb[3 * k + c]
            to_values[(c + 1) * points + begin + k] = g * colour * (ONE - colour)


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
    background = [(first, last)] if given.background == POINT else []
    begin, from_point, to_point = _own_points(given, first, last)
    return [*background, (begin - part.begin + from_point, begin - part.begin + to_point)]


class _Pass(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        of_rays: Tensor,
        by_ray: Tensor,
        joint: int,
        more: tuple[Tensor, Tensor, float, Background],
        *parameters: Tensor,
    ) -> tuple[Tensor, ...]:
        inside, deltas, scale, background = more
        (rays, samples), points = deltas.shape, len(x)
        single = points - rays * samples
        own = single - (rays if background == Background.POINT else 0)
        rendered = torch.empty(rays, 3), torch.empty(rays, 1), torch.empty(rays, samples), torch.empty(own, 3)
        values = flat(torch.empty(4, points))
        given = _Given(values, flat(inside), flat(deltas), np.float32(scale), int(background), rays, samples, single)
        parts = _parts(x, of_rays, deltas.shape, joint, by_ray, parameters, ctx.needs_input_grad[1])
        networks = [(part, writes_forward(part.net, values[part.begin :], points)) for part in parts]
        arrays = given, *(flat(each) for each in rendered)

        def work(first: int, last: int) -> None:
            for part, apply in networks:
                for stretch in _stretches(part, given, first, last):
                    apply(*stretch)
            _render(*arrays, first, last)

        in_parts(work, rays, _least_rays(given))
        ctx.given, ctx.parts, ctx.joint = given, parts, joint
        ctx.set_materialize_grads(False)
        # finds out if they were changed since
        ctx.save_for_backward(rendered[3], x, of_rays, by_ray, *parameters)
        return rendered

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        point_rgb, x, of_rays, by_ray, *parameters = ctx.saved_tensors
        given = ctx.given
        points = len(x)
        to_rendered = _Gradients(*(np.empty(0, np.float32) if each is None else flat(each) for each in gradients))
        to_values = flat(torch.empty(4, points))
        arrays = given, flat(point_rgb), to_rendered, to_values, np.float32(STEEPEST)
        # input after input in memory, as the hash grid's backward wants it
        to_x = x.new_empty(x.shape[::-1] if ctx.needs_input_grad[0] else (0, 0))
        slopes = [Slopes(part.net, to_values[part.begin :], points, flat(to_x)[part.begin :]) for part in ctx.parts]
        sums: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}

        def work(first: int, last: int) -> None:
            sums[first] = [each.nothing() for each in slopes]
            _all_gradients(*arrays, first, last)
            for part, of_part, own in zip(ctx.parts, slopes, sums[first], strict=True):
                for stretch in _stretches(part, given, first, last):
                    of_part.add(own, *stretch)

        in_parts(work, given.rays, _least_rays(given))
        # in the order of the rays, whichever thread was ready first: always the same sum
        every = zip(slopes, zip(*(sums[first] for first in sorted(sums)), strict=True), strict=True)
        totals = [of_part.total(own) for of_part, own in every]
        to_rays, to_parameters = _to_networks(ctx, totals, of_rays, by_ray, parameters)
        return (
            to_x.t() if ctx.needs_input_grad[0] else None,
            to_rays,
            to_parameters[0],
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
    """Say how many rays a thread gets at least."""
    return max(1, LEAST_SHARE * given.rays // (given.rays * given.samples + given.single))


def render(
    x: Float[Tensor, "points in"],
    of_rays: Float[Tensor, "rays_and_single_points shared"],
    networks: Networks,
    inside: Float[Tensor, "points"],
    deltas: Float[Tensor, "rays samples"],
    scale: float,
    background: Background,
) -> Rendered:
    """Render pixels from encoded positions of the samples of rays, and of single points after them.

    Args:
        x: float32. First come all samples, ray by ray, then any single points; with `Background.POINT` those of the
            rays come before others.
        of_rays: what the second network gets beside the first one's outputs: for each ray, then each single point.
        networks: from encoded positions to density and colour; the density is `scale` times e to the power of the
            first output, the colour the sigmoid of the second one's outputs.
        inside: 1 where a point is inside the scene, else 0.
        deltas: the samples' lengths; one ray at least.
        scale: the density of an output of 0.
        background: what colours light that no sample stops.

    Returns:
        Weights that are not a number are 0, as in nerfstudio. Differentiable once, by x, of_rays and the networks.
    """
    layers, biases = ([*networks.first[k], *networks.second[k]] for k in range(2))
    parameters = [each for pair in zip(layers, biases, strict=True) for each in pair]
    more = inside, deltas, scale, background
    x, of_rays, joint = x.contiguous(), of_rays.contiguous(), len(networks.first[0])
    rendered = _Pass.apply(x, of_rays, networks.by_ray, joint, more, *parameters)
    assert isinstance(rendered, tuple)
    return Rendered(*rendered)
