"""nerfstudio's placing of samples along rays, and their weights: each in one pass, without a copy from the host.

Host-facing; the numbers are nerfstudio's to float32's noise, from the same random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import cache
from typing import Any

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import PDFSampler, ProposalNetworkSampler, UniformLinDispPiecewiseSampler
from torch import Tensor

from edge_depth_nerf.kernels.functions import DISTANCES, SAMPLE_PDF, WEIGHTS
from edge_depth_nerf.plugin.fused.noise import uniform


class FirstSampler(UniformLinDispPiecewiseSampler):
    """nerfstudio's first sampler, which makes its constants again in each step and copies them from the host."""

    def __init__(self, single_jitter: bool) -> None:
        super().__init__(single_jitter=single_jitter)
        self._intervals: dict[tuple[int, torch.device], tuple[Tensor, Tensor]] = {}

    def generate_ray_samples(self, ray_bundle: RayBundle | None = None, num_samples: int | None = None) -> RaySamples:
        """Place samples, in training anywhere within their intervals."""
        assert ray_bundle is not None
        count = num_samples or self.num_samples
        if not count:
            return super().generate_ray_samples(ray_bundle, num_samples)
        assert ray_bundle.nears is not None and ray_bundle.fars is not None
        device = ray_bundle.origins.device
        lower, lengths = self._between(count, device)
        nears, fars = ray_bundle.nears, ray_bundle.fars
        if self.train_stratified and self.training:
            drawn = uniform(len(ray_bundle), 1 if self.single_jitter else count + 1, device)
            edges = torch.addcmul(lower, lengths, drawn)
        else:
            edges = torch.linspace(0, 1, count + 1, device=device).expand(len(ray_bundle), -1)

        @cache
        def bounds() -> tuple[Tensor, Tensor]:
            return self.spacing_fn(nears), self.spacing_fn(fars)

        def to_euclidean(places: Tensor) -> Tensor:
            compute = DISTANCES.compiled_for(places, nears, fars) if places.ndim == 2 else None
            if compute is not None and len(places) == len(nears):
                return compute(places, nears, fars)
            return self.spacing_fn_inv(torch.lerp(*bounds(), places))

        return _samples_between(ray_bundle, edges, to_euclidean)

    def _between(self, count: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Give where each edge may lie: the middle before its even place, and how far it is to the middle after it."""
        key = count, device
        if key not in self._intervals:
            even = torch.linspace(0, 1, count + 1)
            midpoints = (even[1:] + even[:-1]) / 2
            lower, upper = torch.cat([even[:1], midpoints]), torch.cat([midpoints, even[-1:]])
            self._intervals[key] = lower[None].to(device), (upper - lower)[None].to(device)
        return self._intervals[key]


class FusedPDFSampler(PDFSampler):
    """nerfstudio's `PDFSampler(include_original=False)`; devices without kernels are left to nerfstudio."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._even: dict[tuple[int, torch.device], Tensor] = {}

    def generate_ray_samples(
        self,
        ray_bundle: RayBundle | None = None,
        ray_samples: RaySamples | None = None,
        weights: Tensor | None = None,
        num_samples: int | None = None,
        eps: float = 1e-5,
    ) -> RaySamples:
        """Place samples by the weights of earlier ones."""
        assert ray_bundle is not None and ray_samples is not None and weights is not None
        count = num_samples or self.num_samples
        place = None if self.include_original or weights.ndim != 3 else SAMPLE_PDF.compiled_for(weights[..., 0])
        if place is None or not count:
            return super().generate_ray_samples(ray_bundle, ray_samples, weights, num_samples, eps)
        places, device = count + 1, weights.device
        if (places, device) not in self._even:
            self._even[places, device] = torch.linspace(0, 1 - 1 / places, places, device=device)
        wanted = self._even[places, device].expand(len(weights), -1)
        if self.train_stratified and self.training:
            drawn = uniform(len(weights), 1 if self.single_jitter else places, device)
            wanted = torch.add(wanted, drawn, alpha=1 / places)
        else:
            wanted = wanted + 1 / (2 * places)
        placed = place(weights[..., 0].float(), edges_of(ray_samples), wanted, self.histogram_padding, eps)
        assert ray_samples.spacing_to_euclidean_fn is not None
        return _samples_between(ray_bundle, placed, ray_samples.spacing_to_euclidean_fn)


def _samples_between(
    rays: RayBundle, edges: Float[Tensor, "rays edges"], to_euclidean: Callable[[Tensor], Tensor]
) -> RaySamples:
    """Make samples between edges in the spacing of 0..1, which a function turns into distances."""
    distances, edges = to_euclidean(edges)[..., None], edges[..., None]
    return samples_along(
        rays,
        distances[:, :-1],
        distances[:, 1:],
        spacing_starts=edges[:, :-1],
        spacing_ends=edges[:, 1:],
        spacing_to_euclidean_fn=to_euclidean,
    )


class FusedProposalSampler(ProposalNetworkSampler):
    """nerfstudio's sampler with the samplers above."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        pdf = self.pdf_sampler
        self.pdf_sampler = FusedPDFSampler(include_original=pdf.include_original, single_jitter=pdf.single_jitter)
        if isinstance(self.initial_sampler, UniformLinDispPiecewiseSampler):
            self.initial_sampler = FirstSampler(single_jitter=self.initial_sampler.single_jitter)


def edges_of(samples: RaySamples) -> Tensor:
    """Give where a ray's samples begin and the last one ends, in the spacing of 0..1, [rays, samples + 1]."""
    return edges_between(samples.spacing_starts, samples.spacing_ends)


def edges_between(starts: Any, ends: Any) -> Tensor:
    """Give where samples begin and the last one ends, [rays, samples + 1]; of [rays, samples, 1] each."""
    rays, count = starts.shape[:2]
    step = starts.stride(1)
    if (
        starts.untyped_storage()._cdata == ends.untyped_storage()._cdata
        and starts.stride() == ends.stride()
        and ends.storage_offset() == starts.storage_offset() + step
    ):
        # both are views of the edges
        return starts.as_strided((rays, count + 1), (starts.stride(0), step))
    return torch.cat([starts[..., 0], ends[..., -1:, 0]], dim=-1)


class FusedRaySamples(RaySamples):
    """nerfstudio's `RaySamples`; weights come from one kernel."""

    def get_weights(self, densities: Float[Tensor, "*batch samples 1"]) -> Float[Tensor, "*batch samples 1"]:
        """Rendering weights of the samples."""
        deltas = self.deltas
        if deltas is None or deltas.requires_grad or deltas.shape != densities.shape or densities.ndim != 3:
            return super().get_weights(densities)
        # squeezed, not indexed: backward of an index fills zeros and copies
        densities_of_rays, deltas_of_rays = densities.squeeze(-1), deltas.squeeze(-1)
        compute = WEIGHTS.compiled_for(densities_of_rays, deltas_of_rays)
        if compute is None:
            return super().get_weights(densities)
        return compute(densities_of_rays, deltas_of_rays)[..., None]


class FusedFrustums(Frustums):
    """nerfstudio's `Frustums`; positions take two passes."""

    def get_positions(self) -> Float[Tensor, "*batch 3"]:
        """Give the positions in the middle of the samples."""
        if self.offsets is not None:
            return super().get_positions()
        middles = self.starts if self.starts is self.ends else torch.lerp(self.starts, self.ends, 0.5)
        return torch.addcmul(self.origins, self.directions, middles)


def in_a_row(parts: Sequence[Tensor]) -> Tensor:
    """Join tensors of one form along their first axis; without a copy where they lie so, as parts of a batch do."""
    first, at, rows = parts[0], parts[0].storage_offset(), 0
    for part in parts:
        follows = part.untyped_storage()._cdata == first.untyped_storage()._cdata and part.storage_offset() == at
        if not follows or part.stride() != first.stride() or part.requires_grad:
            return torch.cat([*parts])
        at, rows = at + len(part) * part.stride(0), rows + len(part)
    return first.as_strided((rows, *first.shape[1:]), first.stride())


def _whole(kind: type[Any], shape: tuple[int, ...], **values: Any) -> Any:
    """Make one of nerfstudio's tensor dataclasses of fields that have its shape already.

    Its own constructor looks up the common shape of all fields and brings them there.
    """
    made = object.__new__(kind)
    for field in fields(kind):
        object.__setattr__(made, field.name, values.get(field.name))
    object.__setattr__(made, "_shape", torch.Size(shape))
    return made


def rays_of(
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    pixel_area: Float[Tensor, "rays 1"],
    camera_indices: Int[Tensor, "rays 1"] | None,
    metadata: dict[str, Any] | None = None,
) -> RayBundle:
    """Make rays of fields of one shape, as nerfstudio's constructor does without looking it up."""
    given = {"origins": origins, "directions": directions, "pixel_area": pixel_area, "camera_indices": camera_indices}
    return _whole(RayBundle, (len(origins),), **given, metadata=metadata or {})


def samples_along(
    rays: RayBundle, starts: Float[Tensor, "*rays samples 1"], ends: Float[Tensor, "*rays samples 1"], **more: Any
) -> RaySamples:
    """Make samples in the fused form, as `RayBundle.get_ray_samples` makes nerfstudio's.

    nerfstudio looks up the common shape of all fields and brings them there, twice: half a millisecond.

    Args:
        rays: a row of rays; of any other shape the samples are nerfstudio's.
        starts: distances along the rays, scene units.
        ends: likewise.
        more: other fields of the samples, of their shape.
    """
    if rays.origins.ndim != 2 or any(isinstance(each, dict) for each in rays.metadata.values()):
        return rays.get_ray_samples(bin_starts=starts, bin_ends=ends, **more)
    shape = len(rays), starts.shape[1]

    def of_rays(values: Tensor) -> Tensor:
        return values[:, None].expand(*shape, values.shape[-1])

    frustums = _whole(
        FusedFrustums,
        shape,
        origins=of_rays(rays.origins),
        directions=of_rays(rays.directions),
        starts=starts,
        ends=ends,
        pixel_area=of_rays(rays.pixel_area),
    )
    return _whole(
        FusedRaySamples,
        shape,
        frustums=frustums,
        camera_indices=None if rays.camera_indices is None else of_rays(rays.camera_indices),
        deltas=ends - starts,
        # a number, such as a camera's, stays
        metadata={name: of_rays(each) if isinstance(each, Tensor) else each for name, each in rays.metadata.items()},
        times=None if rays.times is None else of_rays(rays.times),
        **more,
    )
