"""The functions that have compiled forms, and the table of a GPU's kernels.

Modules of Numba and of Triton are imported when one of their functions is asked for, as each takes half a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels.back_ends import Example, Function, GpuForm
from edge_depth_nerf.kernels.hash_grid import hash_grid


def _numba() -> SimpleNamespace:
    """Import the modules of the CPU."""
    from edge_depth_nerf.kernels import contraction_numba, hash_grid_numba, ray_numba

    return SimpleNamespace(contraction=contraction_numba, hash_grid=hash_grid_numba, ray=ray_numba)


def _triton() -> SimpleNamespace:
    """Import the modules of a GPU."""
    from edge_depth_nerf.kernels import hash_grid_triton, pointwise_triton, ray_triton

    return SimpleNamespace(hash_grid=hash_grid_triton, pointwise=pointwise_triton, ray=ray_triton)


PROPOSALS, SAMPLES = (256, 96), 48
"""Samples of a ray on each level of the full preset."""
LEVELS = (16, 5)
"""Levels of the hash grids of its field and its proposal networks, of two features each."""


class Sizes(NamedTuple):
    """Of a set of examples."""

    rays: int
    points: int
    samples: Sequence[int]
    """Of a ray, level after level; the last ones are the field's."""
    weighted: Sequence[int]
    """Of a ray whose densities become weights."""
    levels: Sequence[int]
    """Of hash grids."""
    dtypes: Sequence[torch.dtype]
    """Under autocast networks give half precision, and get it."""
    in_a_step: bool


ODD = Sizes(7, 151, (43, 28), (43,), (3,), (torch.float32, torch.float16), in_a_step=False)
"""A few hundred numbers, of no round sizes."""
STEP = Sizes(16, 128, (*PROPOSALS, SAMPLES), (*PROPOSALS, SAMPLES), LEVELS, (torch.float16,), in_a_step=True)
"""As a step has them, of few rays: 16 divides them, as it divides a step's numbers of rays and of points."""


def spread(device: torch.device, *shape: int, seed: int = 2) -> Tensor:
    """Give float32 numbers that are spread over 0..1, everywhere the same ones: multiples of a root, modulo 1."""
    numbers = torch.arange(1, math.prod(shape) + 1, device=device, dtype=torch.float64)
    return (numbers * math.sqrt(seed) % 1).float().view(shape)


def _histogram(device: torch.device, rays: int, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """Edges in 0..1 and weights that add up to 1, most of them small."""
    edges = spread(device, rays, samples + 1, seed=seed).sort(dim=1)[0]
    weights = spread(device, rays, samples, seed=seed + 1) ** 4
    return edges, weights / weights.sum(1, keepdim=True)


def _positions(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    return [{"positions": 8 * spread(device, sizes.points, 3) - 4}]


def _places(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    nears, fars = (low + length * spread(device, sizes.rays, 1) for low, length in ((0.01, 0.3), (2, 30)))
    # where samples begin is a view of all edges
    edges = spread(device, sizes.rays, sizes.samples[-1] + 2).sort(dim=1)[0]
    return [{"places": edges[:, :-1], "nears": nears, "fars": fars}]


def _directions(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    directions = torch.nn.functional.normalize(2 * spread(device, 10 * sizes.rays, 3) - 1, dim=1)
    return [{"directions": directions, "dtype": dtype} for dtype in sizes.dtypes]


def _wanted(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    made = []
    for samples, following in pairwise(sizes.samples):
        edges, weights = _histogram(device, sizes.rays, samples, 2)
        wanted = spread(device, sizes.rays, following + 1, seed=5).sort(dim=1)[0]
        made.append({"weights": weights, "edges": edges, "wanted": wanted, "padding": 0.01, "least": 1e-5})
    return made


def _proposals(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    edges, weights = _histogram(device, sizes.rays, sizes.samples[-1], 2)
    made = []
    for samples in sizes.samples[:-1]:
        outer_edges, outer = _histogram(device, sizes.rays, samples, 6)
        given = {"edges": edges, "weights": weights, "outer_edges": outer_edges}
        # proposal networks rest in most steps
        made += [{**given, "outer_weights": outer}] if sizes.in_a_step else []
        made.append({**given, "outer_weights": outer.clone().requires_grad_()})
    return made


def _samples(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    edges, weights = _histogram(device, sizes.rays, sizes.samples[-1], 2)
    return [{"edges": edges, "weights": weights.requires_grad_()}]


def _outputs(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    outputs = [(8 * spread(device, sizes.points) - 4).to(dtype) for dtype in sizes.dtypes]
    # the field's network gives colours' features beside the density
    outputs += [each[:, None].repeat(1, 16)[:, 0] for each in outputs if sizes.in_a_step]
    inside = (spread(device, sizes.points, seed=3) < 0.7).float()
    return [{"before": each.requires_grad_(), "inside": inside, "scale": 0.01} for each in outputs]


def _optical(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    return [
        {
            "densities": (20 * spread(device, sizes.rays, samples) ** 4).requires_grad_(),
            "deltas": spread(device, sizes.rays, samples, seed=3),
        }
        for samples in sizes.weighted
    ]


def _points(device: torch.device, sizes: Sizes) -> Sequence[Example]:
    made = []
    for levels in sizes.levels:
        scalings = 4 * 1.4 ** torch.arange(levels, device=device)
        table = (2 * spread(device, levels << 8, 2) - 1).requires_grad_()
        # in a step nobody asks for the gradient to positions
        positions = spread(device, sizes.points, 3).requires_grad_(not sizes.in_a_step)
        given = {"positions": positions, "scalings": scalings, "table": table}
        made += [{**given, "dtype": dtype} for dtype in sizes.dtypes]
    return made


MOST = 2048
"""So many samples of a ray stay on a GPU's chip."""


def on_gpu(
    title: str,
    load: Callable[[], Callable[..., Any]],
    formula: Callable[..., Any],
    examples: Callable[[torch.device, Sizes], Sequence[Example]],
    tolerance: float,
    most_columns: int | None = None,
) -> GpuForm:
    """Make a kernel of Triton that is tried out on a function's examples of both sizes."""

    def of_size(usual: Sizes) -> Callable[[torch.device], Sequence[Example]]:
        def made(device: torch.device, sizes: Sizes = usual) -> Sequence[Example]:
            return examples(device, sizes)

        return made

    return GpuForm(title, load, formula, of_size(ODD), tolerance, most_columns, of_size(STEP))


HASH_GRID = Function(
    lambda: partial(hash_grid, work=_numba().hash_grid),
    on_gpu(
        "hash grid", lambda: partial(hash_grid, work=_triton().hash_grid), formulas.hash_grid, _points, tolerance=2e-5
    ),
)
CONTRACT = Function(
    lambda: _numba().contraction.contract,
    on_gpu("contraction", lambda: _triton().pointwise.contract, formulas.contract, _positions, 1e-5),
    follows=False,
)
DISTANCES = Function(
    on_gpu=on_gpu("distances", lambda: _triton().pointwise.distances, formulas.distances, _places, 1e-4),
    follows=False,
)
HARMONICS = Function(
    on_gpu=on_gpu("directions", lambda: _triton().pointwise.harmonics, formulas.harmonics, _directions, 1e-5),
    follows=False,
)
SAMPLE_PDF = Function(
    lambda: _numba().ray.sample_pdf,
    on_gpu("placing of samples", lambda: _triton().ray.sample_pdf, formulas.sample_pdf, _wanted, 1e-4, MOST),
)
INTERLEVEL_LOSS = Function(
    lambda: _numba().ray.interlevel_loss,
    on_gpu("proposal loss", lambda: _triton().ray.interlevel_loss, formulas.interlevel_loss, _proposals, 1e-4, MOST),
)
DISTORTION_LOSS = Function(
    on_gpu=on_gpu(
        "distortion loss", lambda: _triton().ray.distortion_loss, formulas.distortion_loss, _samples, 1e-4, MOST
    ),
)
DENSITY = Function(
    on_gpu=on_gpu("density", lambda: _triton().pointwise.density, formulas.density, _outputs, 1e-5),
)
WEIGHTS = Function(
    on_gpu=on_gpu(
        "weights", lambda: _triton().ray.weights_from_densities, formulas.weights_from_densities, _optical, 1e-5, MOST
    ),
)


def gpu_forms() -> list[GpuForm]:
    """List the kernels of a GPU that are functions of this module."""
    return [each.on_gpu for each in globals().values() if isinstance(each, Function) and each.on_gpu is not None]
