"""nerfacto with the edge loss, in metres, judged inside the mask.

Host-facing: formulas stand in `losses` and `metrics`. Lengths in scene units are turned into metres with the
`metres_per_unit` of the dataset's metadata, so that near, far, sigma and the loss weight mean the same in every
scene.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypeGuard

import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components import renderers
from nerfstudio.model_components.losses import (
    ds_nerf_depth_loss,
    scale_gradients_by_distance_squared,
    urban_radiance_field_depth_loss,
)
from nerfstudio.model_components.ray_samplers import UniformLinDispPiecewiseSampler
from nerfstudio.model_components.renderers import DepthRenderer, RGBRenderer
from nerfstudio.model_components.scene_colliders import NearFarCollider
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from nerfstudio.utils.external import TCNN_EXISTS
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.pictures import DISTANCE, SIGMA, colour_distance
from edge_depth_nerf.kernels.allocator import keep_freed_memory
from edge_depth_nerf.kernels.fields import CubeContraction, FusedNerfactoField, use_fused_fields
from edge_depth_nerf.kernels.nerfacto_losses import distortion_loss, proposal_loss
from edge_depth_nerf.kernels.openmp import let_idle_threads_sleep
from edge_depth_nerf.kernels.ray_samplers import (
    FirstSampler,
    FusedPDFSampler,
    edges_of,
    rays_of,
    samples_along,
    use_fused_proposals,
    use_fused_samples,
)
from edge_depth_nerf.kernels.rendering import Behind, Losses, Rendered, Supervision
from edge_depth_nerf.kernels.threads import take_all_threads
from edge_depth_nerf.method.losses import (
    EPS,
    NARROW,
    URBAN_TERMS,
    UrbanTerms,
    edge_losses,
    sky_loss,
    urban_nerf_loss,
)
from edge_depth_nerf.method.metrics import DepthErrors, load_lpips, masked_lpips, masked_psnr, masked_ssim
from edge_depth_nerf.method.uncertainty import termination_std
from edge_depth_nerf.plugin.colours import coloured
from edge_depth_nerf.plugin.compat import lpips_not_built, total_steps, without_undefined_ray
from edge_depth_nerf.plugin.detail import TrainingDetail
from edge_depth_nerf.plugin.exposure import KINDS, Gains
from edge_depth_nerf.plugin.pose_refinement import MOMENTS, PoseRefiner, PoseRefinerConfig
from edge_depth_nerf.plugin.ray_table import PLACE, ViewRays

LARGEST_NEAR_PLANE_M = 0.5
"""A near plane beyond this cuts off road and car beside the camera."""


@dataclass
class EdgeDepthNerfModelConfig(NerfactoModelConfig):
    """nerfacto supervised by a distance prior."""

    _target: type = field(default_factory=lambda: EdgeDepthNerfModel)
    """Target class to instantiate."""
    near_m: float = 0.2
    """Where sampling starts along the ray, metres (replaces near_plane)."""
    far_m: float = 1000.0
    """Where sampling ends along the ray, metres (replaces far_plane)."""
    depth_loss: Literal["edge", "ds-nerf", "urban-nerf", "urban-nerf-los", "none"] = "edge"
    """The loss on the distance prior: Eq. 4, nerfstudio's DS-NeRF or UrbanNeRF loss, UrbanNeRF's as its authors publish
    it (line of sight with a narrowing σ, and separate weights), or none (plain nerfacto)."""
    depth_loss_mult: float = 0.01
    """Weight λ of the loss on the distance prior (not published; how it was chosen: docs/ablation.md). 0: the prior is
    used for surface and sky only."""
    depth_sigma: float = 0.5
    """Standard deviation of the DS-NeRF and UrbanNeRF losses, metres; with urban-nerf-los its value at the end of
    training. (Eq. 4 uses the prior's own.)"""
    urban: UrbanTerms = URBAN_TERMS
    """With urban-nerf-los: what its terms weigh, and how its σ narrows."""
    depth_loss_levels: Literal["all", "final"] = "all"
    """Whether the loss applies to the samples of the proposal networks too, or only to the final ones."""
    depth_loss_final: float = 0.01
    """The share of λ that is left after `depth_loss_steps`; until then λ decreases exponentially. Early, the prior
    shapes the scene; late, its errors at outlines would hold the pictures back. 1: λ is constant."""
    depth_loss_steps: int | None = None
    """Steps over which λ decreases, and σ with urban-nerf-los. None: those of the whole training, or 30,000 if no
    trainer states them."""
    sky_loss_mult: float = 0.01
    """With a depth loss: weight of the penalty on density along rays into the sky (their accumulated weight). 0: no
    penalty."""
    sky_background: bool = True
    """With a depth loss: the field at infinity, where the sky is, colours light that no sample stops. False: the last
    sample does, as in nerfacto, wherever it lies."""
    surface_loss_mult: float = 1.0
    """With a depth loss: weight of the colour error of the field at the prior's distance, for the datamanager's
    `surface_rays_per_batch` additional pixels, with one sample each."""
    exposure: Literal["gain", "affine", "grid", "embedding", "none"] = "gain"
    """How a camera's drifting exposure and white balance are modelled. gain: a factor per colour and training picture;
    their geometric mean is 1, and views are rendered with it. affine: a 3×4 map of colours for each picture; grid: a
    bilateral grid of such maps, for vignetting too; their mean is the identity. embedding: nerfacto's appearance
    embedding; views use the mean of all pictures, which does not give their mean colour. none: not modelled."""
    camera_optimizer: CameraOptimizerConfig = field(default_factory=PoseRefinerConfig)
    """Poses that training refines."""
    exposure_mult: float = 0.1
    """With exposure affine or grid: weight of the penalty on maps that differ from the identity or vary."""
    edge_gaussian: Literal["point", "interval"] = "interval"
    """How Eq. 4 weighs a sample: by the Gaussian's value at its middle times its length, or by the Gaussian's mass
    over its interval."""
    edge_divide_by_norm: bool = True
    """Divide Eq. 4's Gaussian by σ̂·√(2π), so that a wide one does not pull harder than a narrow one."""
    detail: bool = False
    """Add to rendered views what the training pictures that see most of them show beyond their own renderings. A view
    from a new place then takes longer: up to eight training pictures are rendered first. Training stays the same."""
    implementation: Literal["auto", "fused", "tcnn", "torch"] = "auto"  # pyright: ignore[reportIncompatibleVariableOverride]
    """What computes fields, samples and losses. fused: our own kernels (Numba on the CPU; on CUDA Triton for hash
    grids, samples along rays, densities, directions and the edge loss). torch: nerfstudio's code, with the same
    results and checkpoints as fused, but many times slower on a CPU. tcnn: tiny-cuda-nn, whose checkpoints differ.
    auto: tcnn on a GPU if it is installed, otherwise fused; config.yml keeps which it was."""


Implementation = Literal["fused", "tcnn", "torch"]


def settled(implementation: Literal["auto", "fused", "tcnn", "torch"], device_type: str) -> Implementation:
    """Give what `auto` stands for on a device, and any other value unchanged.

    Raises:
        InputError: tiny-cuda-nn is asked for and is not installed, or serves no such device.

    """
    there = TCNN_EXISTS and device_type == "cuda"
    if implementation == "tcnn" and not there:
        raise InputError(
            "--pipeline.model.implementation tcnn needs a GPU and tiny-cuda-nn; here "
            f"{'there is no GPU' if TCNN_EXISTS else 'tiny-cuda-nn is not installed'}. If a training used it, its "
            "checkpoints need it too. For a new training, use --pipeline.model.implementation fused."
        )
    if implementation == "auto":
        return "tcnn" if there else "fused"
    return implementation


LEAST_DISTANCE_M = 1e-6
"""What is nearer is no distance: without a prior it is 0."""
INFINITELY_FAR = 1e4
"""Scene units: so far that the place in the contracted scene is the direction alone."""
BEHIND = {"last_sample": Behind.LAST_SAMPLE, "black": Behind.NOTHING, "random": Behind.NOTHING}
"""What the model's backgrounds add to a rendered pixel; a random one is added where losses are computed."""
LEAST_HIT = 0.05
"""Rays that stop less than this share of their light count as hitting nothing."""


class NothingBehind(RGBRenderer):
    """nerfstudio's colours before black, of which it would copy a pixel for each ray to a GPU and add nothing."""

    def __init__(self) -> None:
        super().__init__(background_color="black")
        self.shows_last_sample = False
        """Behind rays that end before the far plane lies what their last sample shows, as in nerfacto."""

    def forward(self, rgb: Tensor, weights: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """Give the colours, [rays, 3]."""
        if self.training and not args and not kwargs and not self.shows_last_sample:
            # nerfstudio also sums up the weights, for the background
            return (weights * rgb).sum(dim=-2)
        # random: its word for a background that is added later
        behind = "last_sample" if self.shows_last_sample else "random"
        return super().forward(rgb, weights, *args, **{**kwargs, "background_color": behind})


class DepthInEvaluation(DepthRenderer):
    """nerfstudio's depth, of that share of a ray that hits something; nothing in training, where nobody reads it.

    At an outline a pixel is half sky, half house: the house's distance is its distance.
    """

    def forward(self, weights: Tensor, ray_samples: RaySamples, *args: Any, **kwargs: Any) -> Any:
        """Give the depth, [rays, 1]; in training None."""
        if self.training:
            return None
        hit = weights.sum(dim=-2, keepdim=True)
        weights = torch.where(hit > LEAST_HIT, weights / hit.clamp(min=LEAST_HIT), weights)
        return super().forward(weights, ray_samples, *args, **kwargs)


class DepthMoments(DepthRenderer):
    """nerfstudio's expected depth; in evaluation the standard deviation beside it, and in training None unless read."""

    def __init__(self, in_training: bool) -> None:
        super().__init__(method="expected")
        self.in_training = in_training

    def forward(self, weights: Tensor, ray_samples: RaySamples, *args: Any, **kwargs: Any) -> Any:
        """Give [rays, 2]; in training the expected depth alone, [rays, 1], or None."""
        if self.training and not self.in_training:
            return None
        expected = super().forward(weights, ray_samples, *args, **kwargs)
        if self.training:
            return expected
        starts, ends = ray_samples.frustums.starts[..., 0], ray_samples.frustums.ends[..., 0]
        return torch.cat([expected, termination_std(weights[..., 0], starts, ends)[..., None]], dim=-1)


class Psnr(torch.nn.Module):
    """torchmetrics' PSNR of values in 0..1, without the state that it keeps over batches."""

    def forward(self, image: Tensor, other: Tensor) -> Tensor:
        """PSNR of two pictures, dB."""
        return -10 * torch.log10(torch.nn.functional.mse_loss(image.detach(), other))


class LpipsAtFirstUse:
    """LPIPS as nerfacto calls it, kept outside the module tree and so outside checkpoints.

    Without AlexNet's weights on disk it reports this once and gives NaN, which the model leaves out of its figures.
    """

    def __init__(self) -> None:
        self._loaded = False
        self.network: torch.nn.Module | None = None

    def load(self, device: torch.device) -> torch.nn.Module | None:
        """The network on `device`, or None where its weights are missing."""
        if not self._loaded:
            self._loaded = True
            self.network = load_lpips()
        return None if self.network is None else self.network.to(device)

    def __call__(self, image: Tensor, other: Tensor) -> Tensor:
        """LPIPS of two pictures (1×3×H×W in 0..1), NaN without weights."""
        network = self.load(image.device)
        return image.new_tensor(float("nan")) if network is None else network(image, other.clamp(0, 1))


def _density_at(density_fn: Callable[..., Tensor], positions: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """A proposal network's density, without a gradient to the positions."""
    return density_fn(positions.detach(), *args, **kwargs)


def _supervised(outputs: dict[str, Any], batch: dict[str, Any]) -> Losses | None:
    """Give the losses of a batch that were computed with the outputs; None without any, or of another batch."""
    of_batch, losses = outputs.get("supervised", (None, None))
    return losses if of_batch is batch else None


class EdgeDepthNerfModel(NerfactoModel):
    """nerfacto supervised by a distance prior."""

    config: EdgeDepthNerfModelConfig
    density_fns: list[Any]

    def populate_modules(self) -> None:
        """Build nerfacto with near and far planes in metres."""
        metadata = self.kwargs.get("metadata") or {}
        self.metres_per_unit: float = metadata.get("metres_per_unit", 1.0)
        if self.config.near_m > LARGEST_NEAR_PLANE_M:
            CONSOLE.print(
                f"[bold yellow]The near plane is at {self.config.near_m:g} m: nothing nearer to a camera is "
                "rendered. Set --pipeline.model.near-m 0.2 if you did not intend this."
            )
        device_type = torch.device(self.kwargs.get("device", "cpu")).type
        implementation = settled(self.config.implementation, device_type)
        if device_type == "cpu":
            keep_freed_memory()
            let_idle_threads_sleep()
        # nerfstudio knows two of them; the model's own configuration says which was built
        self.config = replace(self.config, implementation="tcnn" if implementation == "tcnn" else "torch")
        self.fused = implementation == "fused"
        if self.config.exposure != "embedding":
            self.config.use_appearance_embedding = False
        self._has_sky = self.config.depth_loss != "none" and self.config.sky_background
        if self._has_sky:
            # nothing is added to what samples stop; `get_outputs` adds the colour at infinity
            self.config.background_color = "black"
        with lpips_not_built():
            super().populate_modules()
        if implementation == "fused":
            if device_type == "cpu":
                from edge_depth_nerf.kernels.compiled import (
                    compiled_before,  # imports Numba, which other commands do without
                )

                if not compiled_before():
                    CONSOLE.print(
                        "Compiling kernels for the first steps. This takes about a minute, once on this machine."
                    )
            # normals differentiate by the positions alone, which would add to the tables' gradients, too
            use_fused_fields(self, sum_later=not self.config.predict_normals)
            if isinstance(self.proposal_sampler.initial_sampler, UniformLinDispPiecewiseSampler):
                jitter = self.proposal_sampler.initial_sampler.single_jitter
                self.proposal_sampler.initial_sampler = FirstSampler(single_jitter=jitter)
            # bound before the networks were of the fused class
            networks: list[Any] = [density_fn.__self__ for density_fn in self.density_fns]
            self.density_fns = [network.density_fn for network in networks]
            use_fused_proposals(self.proposal_sampler, networks)
            pdf = self.proposal_sampler.pdf_sampler
            self.proposal_sampler.pdf_sampler = FusedPDFSampler(
                include_original=pdf.include_original, single_jitter=pdf.single_jitter
            )
            for sampler in (self.proposal_sampler.initial_sampler, self.proposal_sampler.pdf_sampler):
                use_fused_samples(sampler)
            # nerfacto's field prepares a gradient to the positions at every step, for normals or poses
            if isinstance(self.field, FusedNerfactoField):
                poses = self.config.camera_optimizer.mode != "off"
                self.field.follows_positions = self.config.predict_normals or poses
        if self.config.camera_optimizer.mode != "off":
            self._refine_poses(metadata)
        if not self.config.disable_scene_contraction:
            for network in (self.field, *self.proposal_networks):
                network.spatial_distortion = CubeContraction(order=float("inf"))
        if self._has_sky:
            self.renderer_rgb = NothingBehind()
        self.lpips = LpipsAtFirstUse()
        self.psnr = Psnr()
        self.renderer_depth = DepthInEvaluation(method="median")
        self.renderer_expected_depth = DepthMoments(in_training=self.config.depth_loss == "urban-nerf")
        # the near plane is not reset at evaluation: nothing was trained in front of it
        self.collider = NearFarCollider(
            near_plane=self.config.near_m / self.metres_per_unit,
            far_plane=self.config.far_m / self.metres_per_unit,
            reset_near_plane=False,
        )
        maps = KINDS.get(self.config.exposure)
        self.exposure = None if maps is None else maps(self.num_train_data)
        self._step = 0
        self._training_steps = 30_000
        self._scheduled_weight: Tensor | None = None
        self.detail: TrainingDetail | None = None
        """Of the training pictures; the pipeline sets it."""
        self._view_rays = ViewRays()
        self.reset_depth_errors()

    def _refine_poses(self, metadata: dict[str, Any]) -> None:
        """Let poses be learned from what the field shows, not from where the proposals put their samples."""
        if isinstance(self.camera_optimizer, PoseRefiner):
            moments = metadata.get(MOMENTS, list(range(self.num_train_data)))
            self.camera_optimizer.settle(moments, self.metres_per_unit)
        self.density_fns = [partial(_density_at, density_fn) for density_fn in self.density_fns]

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Nerfacto's callbacks, and one that tells the step."""
        trainer = training_callback_attributes.trainer
        if trainer is not None:
            self._training_steps = total_steps(trainer)

        def remember(step: int) -> None:
            self._step = step

        return [
            *super().get_training_callbacks(training_callback_attributes),
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], remember, update_every_num_iters=1),
        ]

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Nerfacto's parameters; the pictures' maps of colours go with the fields."""
        groups = super().get_param_groups()
        if self.exposure is not None:
            groups["fields"].extend(self.exposure.parameters())
        return groups

    def _exposed(self, colours: list[Tensor], bundles: list[RayBundle]) -> Sequence[Tensor]:
        """Colours of several bundles, each [rays, 3], as the training pictures that the rays are from have them.

        At evaluation they are unchanged.
        """
        if not self.training or self.exposure is None:
            return colours
        pictures = torch.cat([rays.camera_indices[:, 0] for rays in bundles if rays.camera_indices is not None])
        places = [rays.metadata[PLACE] for rays in bundles if PLACE in rays.metadata]
        exposed = self.exposure(torch.cat(colours), pictures, torch.cat(places) if places else None)
        return exposed.split([len(each) for each in colours])

    def forward(self, ray_bundle: RayBundle, batch: dict[str, Any] | None = None) -> dict[str, Any]:
        """Outputs of a batch of rays.

        Args:
            ray_bundle: the rays.
            batch: in training what the datamanager serves beside them; of its further pixels, where it has any, the
                outputs hold the colours that the field has at their surfaces, `surface_rgb`.

        """
        bounded = ray_bundle.fars is not None
        if self.collider is not None:
            # a copy: else the caller's own rays would be bounded the next time
            ray_bundle = self.collider(copy(ray_bundle))
        return self.get_outputs(ray_bundle, batch, bounded)

    def get_outputs(
        self, ray_bundle: RayBundle, batch: dict[str, Any] | None = None, bounded: bool = False
    ) -> dict[str, Any]:
        """Nerfacto's outputs and the sky; in training without the depths that no loss reads.

        The sky is behind rays up to the far plane, not behind those that end earlier (`bounded`): at the edge of a
        crop, or behind a mesh's surface when its texture is rendered.

        In evaluation also, in metres, the median `distance` and `distance_uncertainty`, the standard deviation of where
        the ray ends. (nerfstudio divides outputs with "depth" in their name by the scene's scale; these have none.)
        """
        outputs, further = self._rendered(ray_bundle, batch, bounded)
        if "supervised" in outputs:
            # the colours are those of the pictures already
            if self._has_surface(batch):
                outputs["surface_rgb"] = further
        elif self._has_surface(batch):
            bundles = [ray_bundle, batch["surface_rays"]]
            outputs["rgb"], outputs["surface_rgb"] = self._exposed([outputs["rgb"], further], bundles)
        else:
            (outputs["rgb"],) = self._exposed([outputs["rgb"]], [ray_bundle])
        if not self.training:
            outputs["expected_depth"], std = outputs["expected_depth"].split(1, dim=-1)
            outputs["distance"] = outputs["depth"] * self.metres_per_unit
            outputs["distance_uncertainty"] = std * self.metres_per_unit
        return {name: value for name, value in outputs.items() if value is not None}

    def _has_surface(self, batch: dict[str, Any] | None) -> TypeGuard[dict[str, Any]]:
        """Whether there are further pixels whose colour at their surface is compared."""
        return self.training and self.config.surface_loss_mult > 0 and batch is not None and "surface_rays" in batch

    def _places(self, rays: RayBundle, batch: dict[str, Any] | None, sky: bool) -> RaySamples | None:
        """Where the field is asked for colours beside the samples: the sky behind each ray, then the surfaces."""
        bundles, distances = [], []
        if sky:
            bundles.append(rays)
            distances.append(rays.origins.new_full((len(rays),), INFINITELY_FAR))
        if self._has_surface(batch):
            self.camera_optimizer.apply_to_raybundle(batch["surface_rays"])
            bundles.append(batch["surface_rays"])
            distance = self._surface_drawn(batch) / self.metres_per_unit
            distances.append(torch.where(batch["surface_sky"][:, 0], INFINITELY_FAR, distance))
        if not bundles:
            return None
        origins, directions, areas, pictures = (
            torch.cat([getattr(bundle, name) for bundle in bundles])
            for name in ("origins", "directions", "pixel_area", "camera_indices")
        )
        every = rays_of(origins, directions, areas, pictures)
        at = torch.cat(distances)[:, None, None]
        along = samples_along if self.fused else RayBundle.get_ray_samples
        return along(every, at, at)

    def _fields(self, parts: list[RaySamples]) -> list[dict[FieldHeadNames, Tensor]]:
        """The field at several sets of samples."""
        if isinstance(self.field, FusedNerfactoField):
            return self.field.forward_together(parts)
        return [self.field.forward(samples) for samples in parts]

    def _rendered(self, rays: RayBundle, batch: dict[str, Any] | None, bounded: bool) -> tuple[dict[str, Any], Tensor]:
        """Nerfacto's outputs with the sky, and the field's colours at the surfaces of further pixels, [pixels, 3]."""
        # nerfstudio's crops and exporters set a background of their own
        sky = self._has_sky and not bounded and renderers.BACKGROUND_COLOR_OVERRIDE is None
        if isinstance(self.renderer_rgb, NothingBehind):
            self.renderer_rgb.shows_last_sample = bounded
        if self.config.predict_normals:
            outputs = super().get_outputs(rays)
            places = self._places(rays, batch, sky)
            further = rays.origins[:0] if places is None else self.field.forward(places)[FieldHeadNames.RGB][:, 0]
            return self._before_sky(outputs, further, sky)
        if self.training:
            self.camera_optimizer.apply_to_raybundle(rays)
        samples, weights_list, samples_list = self.proposal_sampler(rays, density_fns=self.density_fns)
        places = self._places(rays, batch, sky)
        rendered = self._rendered_at_once(rays, samples, places, sky, batch)
        if rendered is None:
            found, *others = self._fields([samples, *([] if places is None else [places])])
            if self.config.use_gradient_scaling:
                found = scale_gradients_by_distance_squared(found, samples)
            weights = samples.get_weights(found[FieldHeadNames.DENSITY])
            outputs: dict[str, Any] = {
                "rgb": self.renderer_rgb(rgb=found[FieldHeadNames.RGB], weights=weights),
                "accumulation": self.renderer_accumulation(weights=weights),
            }
            further = others[0][FieldHeadNames.RGB].squeeze(1) if others else rays.origins[:0]
            outputs, further = self._before_sky(outputs, further, sky)
        else:
            rgb, accumulation, weights, further, losses = rendered
            # nerfstudio's, at evaluation
            rgb = rgb if self.training else torch.nan_to_num(rgb).clamp(0, 1)
            outputs, weights = {"rgb": rgb, "accumulation": accumulation}, weights[..., None]
            if losses is not None:
                outputs["supervised"] = batch, losses
        weights_list.append(weights)
        samples_list.append(samples)
        outputs |= self._depths(weights_list, samples_list)
        if self.training:
            outputs |= {"weights_list": weights_list, "ray_samples_list": samples_list}
        return outputs, further

    def _rendered_at_once(
        self, rays: RayBundle, samples: RaySamples, places: RaySamples | None, sky: bool, batch: dict[str, Any] | None
    ) -> Rendered | None:
        """What the fused field renders on the CPU, with the losses of a batch; None where it does not serve."""
        if self.config.use_gradient_scaling or renderers.BACKGROUND_COLOR_OVERRIDE is not None:
            return None
        if self._has_sky:
            behind = Behind.SINGLE_POINT if sky else Behind.LAST_SAMPLE
        else:
            behind = BEHIND.get(str(self.config.background_color))
        field = self.field
        if behind is None or not isinstance(field, FusedNerfactoField) or not field.may_render(samples, places):
            return None
        return field.render(samples, places, behind, self._supervision(rays, samples, batch))

    def _supervision(self, rays: RayBundle, samples: RaySamples, batch: dict[str, Any] | None) -> Supervision | None:
        """What a training batch tells of its pixels; None where their losses are computed by themselves.

        Maps of colours other than a factor, and random colours behind a ray, are for these.
        """
        if not self.training or batch is None or "image" not in batch or rays.camera_indices is None:
            return None
        if not isinstance(self.exposure, Gains | None) or self.config.background_color == "random":
            return None
        images, bundles, counts = [batch["image"]], [rays], rays.origins.new_empty(0, dtype=torch.bool)
        if self._has_surface(batch):
            images.append(batch["surface_image"])
            bundles.append(batch["surface_rays"])
            counts = self._surface_counts(batch)
        if images[0].shape[-1] != 3 or images[0].dtype != torch.float32:
            return None
        gains = torch.ones(self.num_train_data, 3) if self.exposure is None else self.exposure.gains
        pictures: list[Any] = [bundle.camera_indices for bundle in bundles]
        with_prior = self.config.depth_loss == "edge" and self.config.depth_loss_mult > 0
        count = len(rays)
        return Supervision(
            image=torch.cat(images),
            counts=counts,
            gains=gains,
            pictures=torch.cat(pictures)[:, 0],
            edges=edges_of(samples),
            starts=samples.frustums.starts[..., 0],
            ends=samples.frustums.ends[..., 0],
            prior_m=self._met_prior(batch)[:, 0] if with_prior else torch.zeros(count),
            sigma_m=batch["prior_sigma_m"][:, 0] if with_prior else torch.zeros(count),
            sky=batch["sky"][:, 0] if self._has_sky_loss() else torch.zeros(count, dtype=torch.bool),
            metres_per_unit=self.metres_per_unit,
            interval=self.config.edge_gaussian == "interval",
            divide_by_norm=self.config.edge_divide_by_norm,
            eps=EPS,
            narrow=NARROW,
        )

    def _before_sky(self, outputs: dict[str, Any], further: Tensor, sky: bool) -> tuple[dict[str, Any], Tensor]:
        """Add the sky, whose colours come first among those at `_places`, behind what the samples stop."""
        if not sky:
            return outputs, further
        behind, further = further.split([len(outputs["rgb"]), len(further) - len(outputs["rgb"])])
        return {**outputs, "rgb": torch.addcmul(outputs["rgb"], 1 - outputs["accumulation"], behind)}, further

    def _depths(self, weights_list: list[Tensor], samples_list: list[RaySamples]) -> dict[str, Any]:
        """Nerfacto's depths, of the final samples and of those of the proposal networks."""
        with torch.no_grad():
            *before, depth = (
                self.renderer_depth(weights=weights, ray_samples=samples)
                for weights, samples in zip(weights_list, samples_list, strict=True)
            )
        expected = self.renderer_expected_depth(weights=weights_list[-1], ray_samples=samples_list[-1])
        named = {f"prop_depth_{number}": each for number, each in enumerate(before)}
        return {"depth": depth, "expected_depth": expected, **named}

    def rays_of_view(self, camera: Cameras, obb_box: OrientedBox | None = None) -> RayBundle:
        """Rays of a whole view, [height, width]; with a box, they begin and end at it."""
        camera = without_undefined_ray(camera)
        if obb_box is not None or self.device.type != "cpu":
            return camera.generate_rays(camera_indices=0, keep_shape=True, obb_box=obb_box)
        return self._view_rays.of(camera)

    @torch.no_grad()
    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Outputs of a whole view; distance and uncertainty also in colours that always mean the same metres."""
        take_all_threads()
        outputs = self.get_outputs_for_camera_ray_bundle(self.rays_of_view(camera, obb_box))
        for name, scale in (("distance", DISTANCE), ("distance_uncertainty", SIGMA)):
            outputs[f"{name}_coloured"] = coloured(outputs[name][..., 0], scale)
        return outputs

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> dict[str, Tensor]:
        """Outputs of a whole view, with the detail of training pictures if it is asked for.

        Where a part is cut out (the viewer's crop, `ns-render`'s), which sets a background, there is no detail.
        """
        outputs = super().get_outputs_for_camera_ray_bundle(camera_ray_bundle)
        if self.training or self.detail is None or not self.detail.is_shown:
            return outputs
        if renderers.BACKGROUND_COLOR_OVERRIDE is None:
            detail = self.detail.of_view(camera_ray_bundle, outputs["depth"])
            outputs["rgb"] = (outputs["rgb"] + detail).clamp(0, 1)
        return outputs

    def rendered_alone(self, camera: Cameras) -> dict[str, Tensor]:
        """Outputs of a whole view without detail."""
        return super().get_outputs_for_camera_ray_bundle(self.rays_of_view(camera))

    @contextmanager
    def with_appearance_of(self, picture: int) -> Iterator[None]:
        """With nerfacto's appearance embedding, render as a training picture looks; else nothing changes."""
        embedding: Any = self.field.embedding_appearance
        if embedding is None:
            yield
            return
        averages = self.field.use_average_appearance_embedding
        try:
            # what both forms of the field ask for at evaluation
            embedding.mean = lambda dim: embedding.embedding.weight[picture]
            self.field.use_average_appearance_embedding = True
            yield
        finally:
            vars(embedding).pop("mean", None)
            self.field.use_average_appearance_embedding = averages

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """Nerfacto's metrics and, in training, the share of rays with a prior."""
        if self.training and self.fused:
            supervised = _supervised(outputs, batch)
            if supervised is not None:
                psnr, distortion = -10 * torch.log10(supervised.colour.detach()), supervised.distortion
            else:
                image = self.renderer_rgb.blend_background(batch["image"].to(self.device))
                psnr = self.psnr(outputs["rgb"], image)
                distortion = distortion_loss(
                    edges_of(outputs["ray_samples_list"][-1]), outputs["weights_list"][-1].squeeze(-1)
                )
            metrics = {"psnr": psnr, "distortion": distortion}
            self.camera_optimizer.get_metrics_dict(metrics)
        else:
            metrics = super().get_metrics_dict(outputs, batch)
        if self.training and self.config.depth_loss != "none":
            metrics["share_with_prior"] = self._can_be_met(batch["prior_distance_m"]).float().mean()
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Nerfacto's losses and the one on the distance prior: L_color + λ·L_edge."""
        if self.training and self.fused and metrics_dict is not None and not self.config.predict_normals:
            losses = self._nerfacto_losses(outputs, batch, metrics_dict)
        else:
            losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training and self.config.depth_loss != "none" and self.config.depth_loss_mult > 0:
            name = "edge_loss" if self.config.depth_loss == "edge" else "depth_loss"
            losses[name] = self._depth_weight() * self._depth_losses(outputs, batch)
        if self.training and self.config.depth_loss != "none":
            losses |= self._sky_and_surface_losses(outputs, batch)
        if self.training and self.config.exposure in ("affine", "grid") and self.exposure is not None:
            losses["exposure_loss"] = self.config.exposure_mult * self.exposure.unevenness()
        return losses

    def _can_be_met(self, prior_m: Float[Tensor, "*rays"]) -> Bool[Tensor, "*rays"]:
        """Where a prior lies between the planes; without one it is 0, in front of the near plane.

        No sample lies elsewhere: such a prior would draw all weight to the first sample or to the last.
        """
        nearest_m = max(self.config.near_m, LEAST_DISTANCE_M)
        return (prior_m >= nearest_m) & (prior_m <= self.config.far_m)

    def _met_prior(self, batch: dict[str, Any]) -> Float[Tensor, "rays 1"]:
        """The prior between the planes, metres; 0 where there is none."""
        prior_m = batch["prior_distance_m"].to(self.device, torch.float32)
        return torch.where(self._can_be_met(prior_m), prior_m, 0)

    def schedule(self) -> tuple[float, float]:
        """What differs between steps: λ, and the exponent by which the sampler's weights are annealed."""
        return float(self._depth_weight()), float(self.proposal_sampler._anneal)

    @contextmanager
    def scheduled_by(self, numbers: Float[Tensor, "2"]) -> Iterator[None]:
        """Take what `schedule` gives from a tensor, where it can change without the host."""
        sampler: Any = self.proposal_sampler
        before = sampler._anneal
        self._scheduled_weight, sampler._anneal = numbers[0], numbers[1]
        try:
            yield
        finally:
            self._scheduled_weight, sampler._anneal = None, before

    def updates_proposals(self) -> bool:
        """Whether the next step trains the proposal networks, as nerfstudio's sampler decides it."""
        sampler = self.proposal_sampler
        return sampler._steps_since_update > sampler.update_sched(sampler._step) or sampler._step < 10

    def _depth_weight(self) -> float | Tensor:
        """λ at this step."""
        if self._scheduled_weight is not None:
            return self._scheduled_weight
        return self.config.depth_loss_mult * self.config.depth_loss_final ** self._share_done()

    def _share_done(self) -> float:
        """The share of `depth_loss_steps` that is behind."""
        steps = self._training_steps if self.config.depth_loss_steps is None else self.config.depth_loss_steps
        return min(1.0, self._step / max(1, steps))

    def _has_sky_loss(self) -> bool:
        return self.config.depth_loss != "none" and self.config.sky_loss_mult > 0

    def _sky_and_surface_losses(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        losses, supervised = {}, _supervised(outputs, batch)
        if self._has_sky_loss():
            sky = batch["sky"][:, 0].to(self.device)
            levels = [weights.squeeze(-1) for weights in outputs["weights_list"]]
            others = levels if supervised is None else levels[:-1]
            # of all their weights in one row
            hit = [sky_loss(torch.cat(others, dim=1), sky)] if others else []
            hit += [] if supervised is None else [supervised.sky]
            # the mean over the levels
            losses["sky_loss"] = self.config.sky_loss_mult / len(levels) * sum(hit[1:], hit[0])
        if "surface_rgb" in outputs:
            weight: Any = self.config.surface_loss_mult
            if "surface_counts" in batch:
                counts = batch["surface_counts"][:, 0]
                weight = weight * (len(counts) / counts.sum().clamp(min=1))
            if supervised is not None:
                error = supervised.surface
            else:
                # no error of others; choosing pixels would make a GPU wait
                counts, image = self._surface_counts(batch), batch["surface_image"]
                error = self.rgb_loss(image, torch.where(counts[:, None], outputs["surface_rgb"], image))
            losses["surface_loss"] = weight * error
        return losses

    def _surface_counts(self, batch: dict[str, Any]) -> Bool[Tensor, "pixels"]:
        """Which further pixels have a surface between the planes, or are sky, and are of use."""
        counts = batch["surface_sky"][:, 0] | self._can_be_met(batch["surface_distance_m"][:, 0])
        return counts & batch["surface_counts"][:, 0] if "surface_counts" in batch else counts

    def _surface_drawn(self, batch: dict[str, Any]) -> Float[Tensor, "rays"]:
        """Draw where the surface of each further pixel is: any place within what its prior leaves open, in metres.

        Nothing is rendered in front of the near plane or behind the far one: what is drawn there is mirrored at the
        prior, to its other side.
        """
        distance_m, sigma_m = batch["surface_distance_m"][:, 0], batch["surface_sigma_m"][:, 0]
        off_m = sigma_m * torch.randn_like(sigma_m)
        drawn_m = distance_m + off_m
        beyond = drawn_m != drawn_m.clamp(self.config.near_m, self.config.far_m)
        return torch.where(beyond, distance_m - off_m, drawn_m).clamp(self.config.near_m, self.config.far_m)

    def _nerfacto_losses(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics: dict[str, Any]
    ) -> dict[str, Tensor]:
        """Nerfacto's losses without normals, in fewer passes."""
        supervised = _supervised(outputs, batch)
        if supervised is not None:
            of_colour = supervised.colour
        else:
            rendered, image = self.renderer_rgb.blend_background_for_loss_computation(
                outputs["rgb"], outputs["accumulation"], batch["image"].to(self.device)
            )
            of_colour = self.rgb_loss(image, rendered)
        *proposals, final = (
            (edges_of(samples), weights.squeeze(-1))
            for samples, weights in zip(outputs["ray_samples_list"], outputs["weights_list"], strict=True)
        )
        bounds = [proposal_loss(final[0], final[1].detach(), *proposal) for proposal in proposals]
        losses = {
            "rgb_loss": of_colour,
            "interlevel_loss": self.config.interlevel_loss_mult * sum(bounds[1:], bounds[0]),
            "distortion_loss": self.config.distortion_loss_mult * metrics["distortion"],
        }
        self.camera_optimizer.get_loss_dict(losses)
        return losses

    def _depth_losses(self, outputs: dict[str, Any], batch: dict[str, Any]) -> Float[Tensor, ""]:
        """The loss on the distance prior, mean over the levels of samples.

        While the proposal networks rest their levels would only add a number; the final samples' share stays the same.
        nerfstudio's form of UrbanNeRF's loss holds the final samples' expected distance in every level: all stay.
        """
        levels = list(zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True))
        if self.config.depth_loss_levels == "final":
            levels = levels[-1:]
        every = self.config.depth_loss == "urban-nerf"
        learning = [level for level in levels if every or level[0].requires_grad] or levels
        if self.config.depth_loss == "edge":
            supervised = _supervised(outputs, batch)
            if supervised is None:
                return self._edge_losses(learning, batch).sum() / len(levels)
            *learning, _ = learning
            others = self._edge_losses(learning, batch).sum() if learning else 0.0
            return (supervised.edge + others) / len(levels)
        else:
            per_level = torch.stack([self._depth_loss(*level, outputs, batch) for level in learning])
        return per_level.sum() / len(levels)

    def _edge_losses(self, levels: list[tuple[Tensor, RaySamples]], batch: dict[str, Any]) -> Float[Tensor, "levels"]:
        prior_m = self._met_prior(batch)
        return edge_losses(
            [
                (weights.squeeze(-1), samples.frustums.starts[..., 0], samples.frustums.ends[..., 0])
                for weights, samples in levels
            ],
            prior_m[..., 0],
            batch["prior_sigma_m"].to(prior_m)[..., 0],
            metres_per_unit=self.metres_per_unit,
            gaussian=self.config.edge_gaussian,
            divide_by_norm=self.config.edge_divide_by_norm,
        )

    def _depth_loss(
        self,
        weights: Float[Tensor, "rays samples 1"],
        samples: RaySamples,
        outputs: dict[str, Any],
        batch: dict[str, Any],
    ) -> Float[Tensor, ""]:
        starts_m = samples.frustums.starts * self.metres_per_unit
        ends_m = samples.frustums.ends * self.metres_per_unit
        prior_m = self._met_prior(batch)
        if self.config.depth_loss == "urban-nerf-los":
            narrowed_m = self.config.urban.sigma_m(self.config.depth_sigma, self._share_done())
            return urban_nerf_loss(
                weights.squeeze(-1), starts_m[..., 0], ends_m[..., 0], prior_m[..., 0], narrowed_m, self.config.urban
            )
        middles_m = (starts_m + ends_m) / 2
        # filled, not copied: a GPU would wait for that
        sigma_m = weights.new_full((1,), self.config.depth_sigma)
        if self.config.depth_loss == "ds-nerf":
            # nerfstudio divides by 2σ where a Gaussian has 2σ², so what it calls sigma is a variance
            return ds_nerf_depth_loss(weights, prior_m, middles_m, ends_m - starts_m, sigma_m.square())
        expected_m = outputs["expected_depth"] * self.metres_per_unit
        return urban_radiance_field_depth_loss(weights, prior_m, expected_m, middles_m, sigma_m)

    def reset_depth_errors(self) -> None:
        """Start pooling depth errors again."""
        self._depth_errors = {"lidar": DepthErrors(), "truth": DepthErrors()}

    def pooled_depth_errors(self) -> dict[str, float]:
        """Depth errors over all pixels judged since the last reset."""
        return {
            key: value
            for name, errors in self._depth_errors.items()
            for key, value in errors.compute(f"{name}_").items()
        }

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Nerfacto's metrics over the full frame, ours inside the mask, and depth errors.

        Returns:
            psnr, ssim and, given weights, lpips over the full frame; masked_* inside the mask; truth_masked_*
            against the picture without noise where it is known. The pictures hold `distance`, the median distance
            in metric colours, besides nerfacto's. The errors of the median distance (1-60 m) against LiDAR and
            truth, where there are any, are in `pooled_depth_errors`: a view without them has no figure of its own.

        """
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        lpips = self.lpips.load(self.device)
        if lpips is None:
            del metrics["lpips"]
        predicted = outputs["rgb"].clamp(0, 1)
        mask = batch["mask"][..., 0].to(predicted.device)
        for prefix, key in (("", "image"), ("truth_", "truth_rgb")):
            if key in batch:
                target = batch[key][..., :3].to(predicted)
                metrics[f"{prefix}masked_psnr"] = float(masked_psnr(predicted, target, mask))
                metrics[f"{prefix}masked_ssim"] = float(masked_ssim(predicted, target, mask))
                if lpips is not None:
                    metrics[f"{prefix}masked_lpips"] = float(masked_lpips(predicted, target, mask, lpips))
        distance_m = outputs["depth"][..., 0] * self.metres_per_unit
        for name, errors in self._depth_errors.items():
            if f"{name}_distance_m" in batch:
                true_m = batch[f"{name}_distance_m"][..., 0].to(distance_m)
                errors.update(distance_m, true_m, mask)
        coloured = colour_distance(distance_m.cpu().numpy(), mask.cpu().numpy())
        images["distance"] = torch.from_numpy(coloured).float() / 255
        return metrics, images
