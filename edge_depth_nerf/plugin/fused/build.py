"""How nerfacto's constructor comes to build our forms of its parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from nerfstudio.field_components import mlp
from nerfstudio.fields import density_fields, nerfacto_field
from nerfstudio.models import nerfacto
from nerfstudio.utils.rich_utils import CONSOLE

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.kernels.preparation import Preparation
from edge_depth_nerf.method.losses import step_kernels
from edge_depth_nerf.plugin.fused.fields import FusedDensityField, FusedMLP, FusedNerfactoField
from edge_depth_nerf.plugin.fused.hash_grid import FusedHashEncoding
from edge_depth_nerf.plugin.fused.ray_samplers import FusedProposalSampler

FORMS: list[tuple[Any, dict[str, type]]] = [
    (
        nerfacto,
        {
            "NerfactoField": FusedNerfactoField,
            "HashMLPDensityField": FusedDensityField,
            "ProposalNetworkSampler": FusedProposalSampler,
        },
    ),
    (nerfacto_field, {"MLP": FusedMLP}),
    (density_fields, {"HashEncoding": FusedHashEncoding, "MLP": FusedMLP}),
    (mlp, {"HashEncoding": FusedHashEncoding, "MLP": FusedMLP}),
]
"""Names of nerfstudio's modules, and what takes their place."""

LOOK_S = 0.1
"""So often the count is read."""


@contextmanager
def fused_forms() -> Iterator[None]:
    """Let nerfstudio's constructors build our forms for the duration.

    They look their parts up by names of their modules, so each is built by its own constructor, with the parameters
    that nerfstudio would draw.
    """
    before = [(module, {name: getattr(module, name) for name in forms}) for module, forms in FORMS]
    try:
        for module, forms in FORMS:
            vars(module).update(forms)
        yield
    finally:
        for module, names in before:
            vars(module).update(names)


def compiled_before() -> bool:
    """Whether the kernels of a training on the CPU lie compiled on disk; otherwise their first calls take long."""
    # each tells its folder; Numba takes half a second to load
    from edge_depth_nerf.kernels import (  # noqa: F401
        compiled,
        contraction_numba,
        hash_grid_numba,
        network_numba,
        ray_numba,
        rendering_numba,
        table_adam_numba,
    )
    from edge_depth_nerf.method import edge_loss_numba, integration_numba  # noqa: F401

    return compiled.all_on_disk()


@contextmanager
def kernels_prepared(device: torch.device | str) -> Iterator[None]:
    """Compile and try out a GPU's kernels while the block runs, and then wait for them; nothing on the CPU.

    Where they have to be compiled, a line counts them.
    """
    if torch.device(device).type != "cuda":
        yield
        return
    preparation = Preparation(step_kernels(), torch.device(device))
    try:
        yield
    except BaseException:
        preparation.give_up()
        raise
    while not preparation.compiles:
        if preparation.wait(LOOK_S):
            return
    with progress_bars(CONSOLE, counted=True) as bars:
        task = bars.add_task("Compiling for this GPU, once:", total=preparation.total)
        while not preparation.wait(LOOK_S):
            bars.update(task, completed=preparation.done)
        bars.update(task, completed=preparation.total)
