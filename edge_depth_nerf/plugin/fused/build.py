"""How nerfacto's constructor comes to build our forms of its parts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from nerfstudio.field_components import mlp
from nerfstudio.fields import density_fields, nerfacto_field
from nerfstudio.models import nerfacto

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
        pointwise_numba,
        ray_numba,
        rendering_numba,
        table_adam_numba,
    )
    from edge_depth_nerf.method import edge_loss_numba, integration_numba  # noqa: F401
    from edge_depth_nerf.plugin import pixel_records_numba, table_rays_numba  # noqa: F401

    return compiled.all_on_disk()
