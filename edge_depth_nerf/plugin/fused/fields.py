"""nerfacto's field and proposal networks with their arithmetic fused.

Host-facing. Parameters, their names and initial values stay nerfstudio's, and results are nerfstudio's to float32's
noise. nerfstudio computes what no fused form covers: a gradient to the positions (for normals or poses), transients,
semantics, and positions in a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.field_components.activations import trunc_exp
from nerfstudio.field_components.encodings import SHEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.fields.base_field import get_normalized_directions
from nerfstudio.fields.density_fields import HashMLPDensityField
from nerfstudio.fields.nerfacto_field import NerfactoField
from torch import Tensor, nn

from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels.back_ends import made_by_autocast
from edge_depth_nerf.kernels.functions import CONTRACT, DENSITY, HARMONICS
from edge_depth_nerf.kernels.network import network
from edge_depth_nerf.kernels.products import field
from edge_depth_nerf.kernels.rendering import Background, Networks, Rendered


class CubeContraction(SceneContraction):
    """nerfacto's contraction into a cube: the same numbers.

    On the CPU torch's infinity norm of three numbers takes 30 times as long as their largest.
    """

    def forward(self, positions: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs 3"]:
        """Contract positions in scene units to -2..2."""
        return formulas.cube(positions)


def _in_parts(x: Tensor) -> bool:
    """Say whether `network` takes these inputs in tiles."""
    return x.device.type == "cpu" and x.dtype == torch.float32 and not torch.is_autocast_enabled("cpu")


def _one_a_ray(directions: Tensor) -> bool:
    """Say whether all samples of a ray have one direction."""
    return directions.ndim == 3 and (directions.shape[1] == 1 or directions.stride(1) == 0)


def _parameters(mlp: MLP) -> tuple[list[Any], list[Any]]:
    """Weights and biases, layer by layer."""
    return [layer.weight for layer in mlp.layers], [layer.bias for layer in mlp.layers]


class FusedMLP(MLP):
    """nerfstudio's `MLP(implementation="torch")`; with ReLU, in parts that stay in the CPU's cache, or few kernels."""

    @property
    def is_plain(self) -> bool:
        """Say whether it consists of torch's layers with ReLU between them."""
        return self.tcnn_encoding is None and not self.skip_connections and isinstance(self.activation, nn.ReLU)

    def forward(self, in_tensor: Float[Tensor, "*bs in_dim"]) -> Float[Tensor, "*bs out_dim"]:
        """Apply the network."""
        serves = in_tensor.device.type == "cuda" or _in_parts(in_tensor)
        if in_tensor.numel() == 0 or not (self.is_plain and serves):
            return super().forward(in_tensor)
        flat = in_tensor.reshape(-1, in_tensor.shape[-1])
        result = network(flat, *_parameters(self)).view(*in_tensor.shape[:-1], -1)
        return result if self.out_activation is None else self.out_activation(result)


def _unit_cube(positions: Float[Tensor, "*bs 3"]) -> tuple[Tensor, Tensor]:
    """Map positions in scene units to 0..1, flat; also give 1 for those strictly inside, else 0, [*bs, 1]."""
    flat = positions.reshape(-1, 3)
    plain = flat.dtype == torch.float32 and not flat.requires_grad
    places, inside = ((CONTRACT.on(flat.device) if plain else None) or formulas.contract)(flat)
    return places, inside.view(*positions.shape[:-1], 1)


def _densities(before: Float[Tensor, "*bs 1"], inside: Float[Tensor, "*bs 1"], scale: float) -> Float[Tensor, "*bs 1"]:
    """Compute densities from a network's outputs; 0 where a point is not inside."""
    # what autocast has made of them is read as it is
    plain = before.dtype == made_by_autocast(before.device) and inside.dtype == torch.float32
    compute = DENSITY.on(before.device) if plain else None
    if compute is None:
        return scale * trunc_exp(before.to(inside)) * inside
    return compute(before.reshape(-1), inside.reshape(-1), scale).view(inside.shape)


class FusedDensityField(HashMLPDensityField):
    """nerfstudio's proposal network."""

    def density_fn(self, positions: Float[Tensor, "*bs 3"], times: Tensor | None = None) -> Float[Tensor, "*bs 1"]:
        """Compute the density at positions in scene units."""
        if not isinstance(self.spatial_distortion, CubeContraction) or self.use_linear or positions.requires_grad:
            return super().density_fn(positions, times)
        places, inside = _unit_cube(positions)
        before = self.mlp_base(places).view(*positions.shape[:-1], 1)
        return _densities(before, inside, self.average_init_density)


class FusedNerfactoField(NerfactoField):
    """nerfacto's field; what the samples of a ray share is computed once a ray."""

    follows_positions: bool = True
    """False: no gradient to the positions in training, where nobody asks for it but nerfstudio's form prepares it."""

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Compute density and features of samples."""
        follows = torch.is_grad_enabled() and (self.follows_positions or not self.training)
        if follows or not isinstance(self.spatial_distortion, CubeContraction):
            return super().get_density(ray_samples)
        positions = ray_samples.frustums.get_positions()
        places, inside = _unit_cube(positions)
        before, embedding = self.mlp_base(places).view(*positions.shape[:-1], -1).split([1, self.geo_feat_dim], dim=-1)
        return _densities(before, inside, self.average_init_density), embedding

    def forward_together(self, parts: Sequence[RaySamples]) -> list[dict[FieldHeadNames, Tensor]]:
        """Evaluate several sets of samples; on a GPU in one pass through the hash grid and both networks.

        Passes of their own would each fill a gradient of the size of the table, and these would be added.

        Args:
            parts: samples of any shapes, each [rays, samples].

        Returns:
            What `forward` gives for each, without normals; densities of the first alone.
        """
        if parts[0].frustums.origins.device.type != "cuda" or not self._is_plain(parts):
            return [self.forward(samples) for samples in parts]
        places, inside = _unit_cube(torch.cat([samples.frustums.get_positions().reshape(-1, 3) for samples in parts]))
        encoding, first = self.mlp_base.model
        assert isinstance(first, FusedMLP)
        runs = [(len(part), part.frustums.shape[1]) for part in parts]
        width, dtype = self.direction_encoding.get_out_dim(), made_by_autocast(places.device)
        networks = _parameters(first), _parameters(self.mlp_head)
        before, colours = field(encoding(places), self._of_rays(parts), runs, *networks, width, dtype)
        of_parts = colours.split([rays * number for rays, number in runs])
        results = [
            {FieldHeadNames.RGB: each.view(*run, 3).to(part.frustums.directions)}
            for each, run, part in zip(of_parts, runs, parts, strict=True)
        ]
        densities = _densities(
            before.view(*runs[0], 1), inside[: len(before)].view(*runs[0], 1), self.average_init_density
        )
        return [{FieldHeadNames.DENSITY: densities, **results[0]}, *results[1:]]

    def render(self, samples: RaySamples, points: RaySamples | None, background: Background) -> Rendered:
        """Render pixels on the CPU in one pass: from encoded positions through both networks, and along the rays.

        Args:
            samples: of the rays, [rays, samples]; `may_render` says whether this form serves them.
            points: single points, [points, 1]; with `Background.POINT` those behind the rays come first.
            background: what colours light that no sample stops.

        Returns:
            What `forward_together`, weights and nerfstudio's renderer give.
        """
        from edge_depth_nerf.kernels.rendering_numba import render

        parts = [samples, *([] if points is None else [points])]
        positions = torch.cat([each.frustums.get_positions().reshape(-1, 3) for each in parts])
        places, inside = _unit_cube(positions)
        encoding, first = self.mlp_base.model
        assert isinstance(first, FusedMLP)
        weights, biases = _parameters(self.mlp_head)
        widths = [self.direction_encoding.get_out_dim(), self.geo_feat_dim, self.appearance_embedding_dim]
        of_direction, of_features, of_appearance = torch.split(weights[0], widths, dim=1)
        by_ray = of_direction
        if self.embedding_appearance is not None:
            by_ray = torch.cat([of_direction, of_appearance], dim=1)
        networks = Networks(_parameters(first), ([of_features, *weights[1:]], biases), by_ray)
        rays, count = samples.frustums.shape
        deltas: Any = samples.deltas
        pixels = deltas.view(rays, count), self.average_init_density, background
        return render(encoding(places), self._of_rays(parts), networks, inside[:, 0], *pixels)

    def may_render(self, samples: RaySamples, points: RaySamples | None) -> bool:
        """Say whether `render` serves this field and these samples."""
        parts, deltas = [samples, *([] if points is None else [points])], samples.deltas
        if deltas is None or deltas.numel() == 0 or deltas.requires_grad or not self._is_plain(parts):
            return False
        return _in_parts(samples.frustums.origins) and self.mlp_base.model[0].hash_table.dtype == torch.float32

    def _is_plain(self, parts: Sequence[RaySamples]) -> bool:
        """Say whether two plain networks behind a contraction are all of this field that these samples ask for."""
        more_heads = self.use_transient_embedding or self.use_semantics or self.use_pred_normals
        if more_heads or not isinstance(self.spatial_distortion, CubeContraction):
            return False
        _, first = self.mlp_base.model
        if not all(isinstance(each, FusedMLP) and each.is_plain for each in (first, self.mlp_head)):
            return False
        plain = first.out_activation is None and isinstance(self.mlp_head.out_activation, nn.Sigmoid)
        cameras = self.embedding_appearance is None or all(each.camera_indices is not None for each in parts)
        return plain and cameras and all(_one_a_ray(each.frustums.directions) for each in parts)

    def _of_rays(self, parts: Sequence[RaySamples]) -> Float[Tensor, "rays shared"]:
        """Give what the samples of a ray share: its encoded direction, and its picture's appearance if there is one."""
        encoded = self._encoded(torch.cat([each.frustums.directions[:, 0] for each in parts]))
        return encoded if self.embedding_appearance is None else torch.cat([encoded, self._appearance(parts)], dim=1)

    def _appearance(self, parts: Sequence[RaySamples]) -> Tensor:
        """Give the appearance of each ray's picture; at evaluation the mean of all, or none, as nerfstudio has it."""
        assert self.embedding_appearance is not None
        if self.training:
            return self.embedding_appearance(torch.cat([each.camera_indices[:, 0, 0] for each in parts]))  # pyrefly: ignore
        mean = self.embedding_appearance.mean(dim=0)
        shown = mean if self.use_average_appearance_embedding else torch.zeros_like(mean)
        return shown.expand(sum(len(each) for each in parts), -1)

    def _encoded(self, directions: Float[Tensor, "rays 3"]) -> Float[Tensor, "rays encoded"]:
        """Encode directions in nerfstudio's spherical harmonics, without a gradient."""
        encoding = self.direction_encoding
        plain = isinstance(encoding, SHEncoding) and encoding.get_out_dim() == formulas.HARMONICS
        compute = HARMONICS.compiled_for(directions.detach()) if plain else None
        if compute is None:
            return encoding(get_normalized_directions(directions))
        return compute(directions, made_by_autocast(directions.device))
