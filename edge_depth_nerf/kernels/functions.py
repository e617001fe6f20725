"""The functions that have compiled forms, and the table of a GPU's kernels.

Modules of Numba and of Triton are imported when one of their functions is asked for, as each takes half a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import torch
from torch import Tensor

from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels.back_ends import Example, Function, GpuForm
from edge_depth_nerf.kernels.hash_grid import hash_grid


def _numba() -> SimpleNamespace:
    """Import the modules of the CPU."""
    from edge_depth_nerf.kernels import contraction_numba, hash_grid_numba, pointwise_numba, ray_numba

    return SimpleNamespace(
        contraction=contraction_numba, hash_grid=hash_grid_numba, pointwise=pointwise_numba, ray=ray_numba
    )


def _triton() -> SimpleNamespace:
    """Import the modules of a GPU."""
    from edge_depth_nerf.kernels import hash_grid_triton, pointwise_triton, ray_triton

    return SimpleNamespace(hash_grid=hash_grid_triton, pointwise=pointwise_triton, ray=ray_triton)


def spread(device: torch.device, *shape: int, seed: int = 2) -> Tensor:
    """Give float32 numbers that are spread over 0..1, everywhere the same ones: multiples of a root, modulo 1."""
    numbers = torch.arange(1, math.prod(shape) + 1, device=device, dtype=torch.float64)
    return (numbers * math.sqrt(seed) % 1).float().view(shape)


def _histogram(device: torch.device, rays: int, samples: int, seed: int) -> tuple[Tensor, Tensor]:
    """Edges in 0..1 and weights that add up to 1, most of them small."""
    edges = spread(device, rays, samples + 1, seed=seed).sort(dim=1)[0]
    weights = spread(device, rays, samples, seed=seed + 1) ** 4
    return edges, weights / weights.sum(1, keepdim=True)


def _positions(device: torch.device) -> Sequence[Example]:
    return [{"positions": 8 * spread(device, 151, 3) - 4}]


def _places(device: torch.device) -> Sequence[Example]:
    nears, fars = (low + length * spread(device, 7, 1) for low, length in ((0.01, 0.3), (2, 30)))
    # where samples begin is a view of all edges
    return [{"places": spread(device, 7, 38).sort(dim=1)[0][:, :-1], "nears": nears, "fars": fars}]


def _directions(device: torch.device) -> Sequence[Example]:
    directions = torch.nn.functional.normalize(2 * spread(device, 67, 3) - 1, dim=1)
    return [{"directions": directions, "dtype": dtype} for dtype in (torch.float32, torch.float16)]


def _wanted(device: torch.device) -> Sequence[Example]:
    edges, weights = _histogram(device, 7, 43, 2)
    wanted = spread(device, 7, 29, seed=5).sort(dim=1)[0]
    return [{"weights": weights, "edges": edges, "wanted": wanted, "padding": 0.01, "least": 1e-5}]


def _proposals(device: torch.device) -> Sequence[Example]:
    (edges, weights), (outer_edges, outer) = _histogram(device, 7, 29, 2), _histogram(device, 7, 43, 6)
    given = {"edges": edges, "weights": weights, "outer_edges": outer_edges}
    return [{**given, "outer_weights": outer.requires_grad_()}]


def _samples(device: torch.device) -> Sequence[Example]:
    edges, weights = _histogram(device, 7, 43, 2)
    return [{"edges": edges, "weights": weights.requires_grad_()}]


def _outputs(device: torch.device) -> Sequence[Example]:
    # a network's, under autocast in half precision
    outputs = ((8 * spread(device, 151) - 4).to(dtype) for dtype in (torch.float32, torch.float16))
    inside = (spread(device, 151, seed=3) < 0.7).float()
    return [{"before": each.requires_grad_(), "inside": inside, "scale": 0.01} for each in outputs]


def _optical(device: torch.device) -> Sequence[Example]:
    densities = 20 * spread(device, 7, 43) ** 4
    return [{"densities": densities.requires_grad_(), "deltas": spread(device, 7, 43, seed=3)}]


def _points(device: torch.device) -> Sequence[Example]:
    scalings = torch.tensor([4.0, 23.0, 64.0], device=device)
    points = {"positions": spread(device, 151, 3).requires_grad_(), "scalings": scalings}
    table = (2 * spread(device, 3 << 8, 2) - 1).requires_grad_()
    # under autocast it is given in half precision
    return [{**points, "table": table, "dtype": dtype} for dtype in (torch.float32, torch.float16)]


FEW_RAYS, FEW_POINTS = 16, 128
"""Of examples as a step has them: 16 divides them, as it divides a step's numbers of rays and of points."""
PROPOSALS, SAMPLES = (256, 96), 48
"""Samples of a ray on each level of the full preset."""
LEVELS = (16, 5)
"""Levels of the hash grids of its field and its proposal networks, of two features each."""


def _step_positions(device: torch.device) -> Sequence[Example]:
    return [{"positions": 8 * spread(device, FEW_POINTS, 3) - 4}]


def _step_places(device: torch.device) -> Sequence[Example]:
    nears, fars = (low + length * spread(device, FEW_RAYS, 1) for low, length in ((0.01, 0.3), (2, 30)))
    return [{"places": spread(device, FEW_RAYS, SAMPLES + 1).sort(dim=1)[0], "nears": nears, "fars": fars}]


def _step_directions(device: torch.device) -> Sequence[Example]:
    directions = torch.nn.functional.normalize(2 * spread(device, FEW_RAYS, 3) - 1, dim=1)
    return [{"directions": directions, "dtype": torch.float16}]


def _step_wanted(device: torch.device) -> Sequence[Example]:
    made = []
    for samples, following in pairwise((*PROPOSALS, SAMPLES)):
        edges, weights = _histogram(device, FEW_RAYS, samples, 2)
        wanted = spread(device, FEW_RAYS, following + 1, seed=5).sort(dim=1)[0]
        made.append({"weights": weights, "edges": edges, "wanted": wanted, "padding": 0.01, "least": 1e-5})
    return made


def _step_proposals(device: torch.device) -> Sequence[Example]:
    edges, weights = _histogram(device, FEW_RAYS, SAMPLES, 2)
    made = []
    for samples in PROPOSALS:
        outer_edges, outer = _histogram(device, FEW_RAYS, samples, 6)
        given = {"edges": edges, "weights": weights, "outer_edges": outer_edges}
        # proposal networks rest in most steps
        made += [{**given, "outer_weights": outer}, {**given, "outer_weights": outer.clone().requires_grad_()}]
    return made


def _step_samples(device: torch.device) -> Sequence[Example]:
    edges, weights = _histogram(device, FEW_RAYS, SAMPLES, 2)
    return [{"edges": edges, "weights": weights.requires_grad_()}]


def _step_outputs(device: torch.device) -> Sequence[Example]:
    before = spread(device, FEW_POINTS).half().requires_grad_()
    return [{"before": before, "inside": torch.ones(FEW_POINTS, device=device), "scale": 0.01}]


def _step_optical(device: torch.device) -> Sequence[Example]:
    return [
        {
            "densities": (20 * spread(device, FEW_RAYS, samples) ** 4).requires_grad_(),
            "deltas": spread(device, FEW_RAYS, samples, seed=3),
        }
        for samples in (*PROPOSALS, SAMPLES)
    ]


def _step_points(device: torch.device) -> Sequence[Example]:
    made = []
    for levels in LEVELS:
        scalings = 4 * 1.4 ** torch.arange(levels, device=device)
        table = (2 * spread(device, levels << 8, 2) - 1).requires_grad_()
        points = {"positions": spread(device, FEW_POINTS, 3), "scalings": scalings}
        made.append({**points, "table": table, "dtype": torch.float16})
    return made


MOST = 2048
"""So many samples of a ray stay on a GPU's chip."""

HASH_GRID = Function(
    lambda: partial(hash_grid, work=_numba().hash_grid),
    GpuForm(
        "hash grid",
        lambda: partial(hash_grid, work=_triton().hash_grid),
        formulas.hash_grid,
        _points,
        tolerance=2e-5,
        in_a_step=_step_points,
    ),
)
CONTRACT = Function(
    lambda: _numba().contraction.contract,
    GpuForm(
        "contraction",
        lambda: _triton().pointwise.contract,
        formulas.contract,
        _positions,
        tolerance=1e-5,
        in_a_step=_step_positions,
    ),
    follows=False,
)
DISTANCES = Function(
    lambda: _numba().pointwise.distances,
    GpuForm(
        "distances",
        lambda: _triton().pointwise.distances,
        formulas.distances,
        _places,
        tolerance=1e-4,
        in_a_step=_step_places,
    ),
    follows=False,
)
HARMONICS = Function(
    lambda: _numba().pointwise.harmonics,
    GpuForm(
        "directions",
        lambda: _triton().pointwise.harmonics,
        formulas.harmonics,
        _directions,
        tolerance=1e-5,
        in_a_step=_step_directions,
    ),
    follows=False,
)
SAMPLE_PDF = Function(
    lambda: _numba().ray.sample_pdf,
    GpuForm(
        "placing of samples", lambda: _triton().ray.sample_pdf, formulas.sample_pdf, _wanted, 1e-4, MOST, _step_wanted
    ),
)
INTERLEVEL_LOSS = Function(
    lambda: _numba().ray.interlevel_loss,
    GpuForm(
        "proposal loss",
        lambda: _triton().ray.interlevel_loss,
        formulas.interlevel_loss,
        _proposals,
        1e-4,
        MOST,
        _step_proposals,
    ),
)
DISTORTION_LOSS = Function(
    lambda: _numba().ray.distortion_loss,
    GpuForm(
        "distortion loss",
        lambda: _triton().ray.distortion_loss,
        formulas.distortion_loss,
        _samples,
        1e-4,
        MOST,
        _step_samples,
    ),
)
POSITIONS = Function(lambda: _numba().pointwise.midpoints, follows=False)
DENSITY = Function(
    lambda: _numba().pointwise.density,
    GpuForm("density", lambda: _triton().pointwise.density, formulas.density, _outputs, 1e-5, None, _step_outputs),
)
WEIGHTS = Function(
    lambda: _numba().ray.weights_from_densities,
    GpuForm(
        "weights",
        lambda: _triton().ray.weights_from_densities,
        formulas.weights_from_densities,
        _optical,
        1e-5,
        MOST,
        _step_optical,
    ),
)


def gpu_forms() -> list[GpuForm]:
    """List the kernels of a GPU that are functions of this module."""
    return [each.on_gpu for each in globals().values() if isinstance(each, Function) and each.on_gpu is not None]
