"""nerfacto with a loss on the distance prior, in metres, evaluated inside the mask.

Host-facing: formulas stand in `method`. Lengths in scene units are turned into metres with the `metres_per_unit` of
the dataset's metadata, so that near, far, sigma and the loss weight mean the same in every scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeGuard

import torch
import tyro
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components import renderers
from nerfstudio.model_components.scene_colliders import NearFarCollider
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from edge_depth_nerf.base.errors import require
from edge_depth_nerf.base.pictures import DISTANCE, SIGMA, colour_distance
from edge_depth_nerf.kernels.allocator import keep_freed_memory
from edge_depth_nerf.kernels.openmp import let_idle_threads_sleep
from edge_depth_nerf.kernels.rendering import Rendered
from edge_depth_nerf.kernels.threads import take_all_threads
from edge_depth_nerf.plugin.colours import coloured
from edge_depth_nerf.plugin.compat import lpips_not_built, total_steps, without_undefined_ray
from edge_depth_nerf.plugin.detail import TrainingDetail
from edge_depth_nerf.plugin.evaluation import LpipsAtFirstUse, Psnr, ViewEvaluation
from edge_depth_nerf.plugin.exposure import Exposure, exposure_model
from edge_depth_nerf.plugin.fused.build import compiled_before, fused_forms
from edge_depth_nerf.plugin.fused.fields import CubeContraction, FusedNerfactoField
from edge_depth_nerf.plugin.fused.hash_grid import sum_tables_later
from edge_depth_nerf.plugin.fused.ray_samplers import in_a_row
from edge_depth_nerf.plugin.pose_refinement import (
    FRAMES,
    PoseRefiner,
    PoseRefinerConfig,
    without_gradient_to_positions,
)
from edge_depth_nerf.plugin.ray_table import ViewRays
from edge_depth_nerf.plugin.renderers import (
    INFINITELY_FAR,
    DepthMoments,
    MedianDepth,
    NoBackground,
    background_of,
    depths,
    points_on,
    render,
    with_sky,
)
from edge_depth_nerf.plugin.schedules import USUAL_STEPS, follow_training, proposals_in_steps
from edge_depth_nerf.plugin.step_losses import (
    DepthLossName,
    LossOptions,
    Planes,
    Step,
    StepLoss,
    distortion_of,
    draw_surface_m,
    interlevel_of,
    step_losses_of,
)

LARGEST_NEAR_PLANE_M = 0.5
"""A near plane beyond this cuts off road and car beside the camera."""


@dataclass
class ModelOptions:
    """Our options; dataclasses put fields of the last base first, and so does the help."""

    near_m: float = 0.2
    """Where sampling starts along the ray, metres (replaces near_plane)."""
    far_m: float = 1000.0
    """Where sampling ends along the ray, metres (replaces far_plane)."""
    depth_loss: DepthLossName = "edge"
    """The loss on the prior: Eq. 4, DS-NeRF's, UrbanNeRF's as in nerfstudio or as published (-los), a registered one,
    or none (plain nerfacto)."""
    losses: LossOptions = field(default_factory=LossOptions)
    """Options of these losses, by their names."""
    depth_loss_mult: float = 0.01
    """Weight λ of the loss on the prior. 0: the prior is used for surface and sky only."""
    depth_loss_levels: tyro.conf.Suppress[Literal["all", "final"]] = "all"
    """Whether the loss applies to the samples of the proposal networks too, or only to the final ones."""
    depth_loss_final: tyro.conf.Suppress[float] = 0.01
    """The share of λ that is left at the end of the training; until then λ decreases exponentially. Early, the prior
    shapes the scene; late, its errors at outlines would hold the pictures back. 1: λ is constant."""
    depth_loss_sharp: float = 0.0
    """Pixels whose σ̂ is at most this share of their distance, plus 2 cm, keep the whole λ, which decreases for others.
    0.02 keeps it where LiDAR measured: better distances, slightly worse pictures."""
    sky_loss_mult: tyro.conf.Suppress[float] = 0.01
    """With a depth loss: weight of the penalty on density along rays into the sky (their accumulated weight). 0: no
    penalty."""
    sky_background: tyro.conf.Suppress[bool] = True
    """With a depth loss: the field at infinity, where the sky is, colours light that no sample stops. False: the last
    sample does, as in nerfacto, wherever it lies."""
    surface_loss_mult: tyro.conf.Suppress[float] = 1.0
    """With a depth loss: weight of the colour error of the field at the prior's distance, for the datamanager's
    `surface_rays_per_batch` additional pixels, with one sample each."""
    surface_loss_final: tyro.conf.Suppress[float] = 1.0
    """The share of that weight that is left at the end of the training, as `depth_loss_final` is of λ."""
    exposure: Exposure = "gain"
    """Exposure and white balance. gain: a factor per colour and training picture. embedding: nerfacto's appearance
    embedding. none: not modelled."""
    detail: bool = False
    """Add detail of the training pictures to rendered views, which then take longer; training stays the same
    (docs/method.md)."""

    @property
    def has_sky(self) -> bool:
        """Whether the sky is behind what samples stop."""
        return self.depth_loss != "none" and self.sky_background

    def check(self) -> None:
        """Raise an InputError if an option is out of its range."""
        near_m, far_m = self.near_m, self.far_m
        planes = f"--pipeline.model.near-m {near_m:g} and --pipeline.model.far-m {far_m:g}"
        require(0 <= near_m < far_m < math.inf, planes, "0 or more metres, and more than that")
        for name in ("depth_loss_mult", "depth_loss_sharp", "sky_loss_mult", "surface_loss_mult"):
            value = getattr(self, name)
            require(0 <= value < math.inf, f"--pipeline.model.{name.replace('_', '-')} {value:g}", "0 or more")


@dataclass
class EdgeDepthNerfModelConfig(NerfactoModelConfig, ModelOptions):
    """nerfacto supervised by a distance prior."""

    _target: type = field(default_factory=lambda: EdgeDepthNerfModel)
    """Target class to instantiate."""
    camera_optimizer: CameraOptimizerConfig = field(default_factory=PoseRefinerConfig)
    """Poses that training refines."""
    proposal_warmup: float = 1 / 6  # pyrefly: ignore
    """How long the proposal networks are trained less and less often: below 1 a share of the training, else steps."""
    proposal_weights_anneal_max_num_iters: float = 1 / 30  # pyrefly: ignore
    """How long the proposals' weights count less than later: below 1 a share of the training, else steps."""
    implementation: Literal["fused", "torch"] = "fused"  # pyrefly: ignore
    """fused: our kernels. torch: nerfstudio's code, with the same results and checkpoints, but many times slower on a
    CPU."""


class EdgeDepthNerfModel(NerfactoModel):
    """nerfacto supervised by a distance prior."""

    config: EdgeDepthNerfModelConfig
    density_fns: list[Any]

    def populate_modules(self) -> None:
        """Build nerfacto with near and far planes in metres, and what it lacks.

        Raises:
            InputError: the loss on the prior is not registered, or the exposure is one of an earlier version.
        """
        metadata = self.kwargs.get("metadata") or {}
        self.metres_per_unit: float = metadata.get("metres_per_unit", 1.0)
        self.planes = Planes(self.config.near_m, self.config.far_m, self.metres_per_unit)
        step_losses_of(self.config)  # refuses a loss that there is not
        exposure = exposure_model(self.config.exposure, self.num_train_data)
        self._settle()
        with lpips_not_built(), fused_forms() if self.fused else nullcontext():
            super().populate_modules()
        if self.fused:
            self._prepare_fused_forms()
        if self.config.camera_optimizer.mode != "off":
            self._refine_poses(metadata)
        if not self.config.disable_scene_contraction:
            for network in (self.field, *self.proposal_networks):
                network.spatial_distortion = CubeContraction(order=float("inf"))
        self._set_renderers()
        self.exposure, self.lpips, self.psnr = exposure, LpipsAtFirstUse(), Psnr()
        self._step, self._training_steps = 0, USUAL_STEPS
        self.scheduled_weights: tuple[Tensor, Tensor] | None = None
        """`weights_now` where they are tensors, which can change without the host."""
        self.detail: TrainingDetail | None = None
        """Of the training pictures; the pipeline sets it."""
        self._view_rays, self.evaluation = ViewRays(), ViewEvaluation()

    def _settle(self) -> None:
        """Decide what computes, and turn our options into nerfacto's."""
        if self.config.near_m > LARGEST_NEAR_PLANE_M:
            CONSOLE.print(
                f"[bold yellow]The near plane is at {self.config.near_m:g} m: nothing nearer to a camera is "
                "rendered. Set --pipeline.model.near-m 0.2 if you did not intend this."
            )
        device_type = torch.device(self.kwargs.get("device", "cpu")).type
        if device_type == "cpu":
            keep_freed_memory()
            let_idle_threads_sleep()
        self.fused = self.config.implementation == "fused"
        if self.fused and device_type == "cpu" and not compiled_before():
            CONSOLE.print("Compiling kernels for the first steps. This takes about a minute, once on this machine.")
        # nerfstudio knows this one, and its parts are replaced
        self.config = replace(self.config, implementation="torch")
        if self.config.exposure != "embedding":
            self.config.use_appearance_embedding = False
        self._has_sky = self.config.has_sky
        if self._has_sky:
            # nothing is added to what samples stop; the sky's colour is the field's
            self.config.background_color = "black"

    def _prepare_fused_forms(self) -> None:
        """Tell our forms what nobody asks of them."""
        if not self.config.predict_normals:
            # normals differentiate by the positions alone, which would add to the tables' gradients, too
            sum_tables_later(self)
        assert isinstance(self.field, FusedNerfactoField)
        # nerfacto's field prepares a gradient to the positions at every step, for normals or poses
        self.field.follows_positions = self.config.predict_normals or self.config.camera_optimizer.mode != "off"

    def _refine_poses(self, metadata: dict[str, Any]) -> None:
        """Let poses be learned from what the field shows, not from where the proposals put their samples."""
        if isinstance(self.camera_optimizer, PoseRefiner):
            self.camera_optimizer.settle(metadata[FRAMES], self.metres_per_unit)
        self.density_fns = [without_gradient_to_positions(density_fn) for density_fn in self.density_fns]

    def _set_renderers(self) -> None:
        """Set nerfacto's renderers and planes to ours."""
        if self._has_sky:
            self.renderer_rgb = NoBackground()
        self.renderer_depth = MedianDepth()
        self.renderer_expected_depth = DepthMoments()
        # the near plane is not reset at evaluation: nothing was trained in front of it
        near, far = (distance_m / self.metres_per_unit for distance_m in (self.config.near_m, self.config.far_m))
        self.collider = NearFarCollider(near_plane=near, far_plane=far, reset_near_plane=False)

    @property
    def step_losses(self) -> dict[str, StepLoss]:
        """The losses of a training step beside nerfacto's, by their names; options may change meanwhile."""
        return step_losses_of(self.config)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Nerfacto's callbacks, and one that tells the step. All schedules then end with the training."""
        trainer, optimizers = training_callback_attributes.trainer, training_callback_attributes.optimizers
        if trainer is not None and optimizers is not None:
            self._training_steps = total_steps(trainer)
            follow_training(optimizers, self._training_steps)
        proposals_in_steps(self.config, self._training_steps)

        def remember(step: int) -> None:
            self._step = step

        return [
            *super().get_training_callbacks(training_callback_attributes),
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], remember, update_every_num_iters=1),
        ]

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Nerfacto's parameters; the pictures' gains go with the fields."""
        groups = super().get_param_groups()
        if self.exposure is not None:
            groups["fields"].extend(self.exposure.parameters())
        return groups

    def forward(self, ray_bundle: RayBundle, batch: dict[str, Any] | None = None) -> dict[str, Any]:
        """Outputs of a batch of rays.

        Args:
            ray_bundle: the rays.
            batch: in training what the datamanager serves beside them; of its surface pixels, where it has any, the
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
        # nerfstudio's crops and exporters set a background of their own
        sky = self._has_sky and not bounded and renderers.BACKGROUND_COLOR_OVERRIDE is None
        if isinstance(self.renderer_rgb, NoBackground):
            self.renderer_rgb.shows_last_sample = bounded
        if self.config.predict_normals:
            outputs, surface_rgb = self._with_normals(ray_bundle, batch, sky)
        else:
            outputs, surface_rgb = self._rendered(ray_bundle, batch, sky)
        if self._has_surface(batch):
            bundles = [ray_bundle, batch["surface_rays"]]
            outputs["rgb"], outputs["surface_rgb"] = self._exposed([outputs["rgb"], surface_rgb], bundles)
        else:
            (outputs["rgb"],) = self._exposed([outputs["rgb"]], [ray_bundle])
        if not self.training:
            outputs["expected_depth"], std = outputs["expected_depth"].split(1, dim=-1)
            outputs["distance"] = outputs["depth"] * self.metres_per_unit
            outputs["distance_uncertainty"] = std * self.metres_per_unit
        return {name: value for name, value in outputs.items() if value is not None}

    def _rendered(self, rays: RayBundle, batch: dict[str, Any] | None, sky: bool) -> tuple[dict[str, Any], Tensor]:
        """Nerfacto's outputs with the sky, and the colours of surface pixels, [pixels, 3]."""
        if self.training:
            self.camera_optimizer.apply_to_raybundle(rays)
        samples, weights_list, samples_list = self.proposal_sampler(rays, density_fns=self.density_fns)
        points = self._points(rays, batch, sky)
        background = background_of(self.config.background_color, self._has_sky, sky)
        of_nerfacto = self.renderer_rgb, self.renderer_accumulation, self.config.use_gradient_scaling
        rendered = render(self.field, samples, points, background, *of_nerfacto)
        weights_list, samples_list = [*weights_list, rendered.weights[..., None]], [*samples_list, samples]
        outputs: dict[str, Any] = {"rgb": rendered.rgb, "accumulation": rendered.accumulation}
        outputs |= depths(weights_list, samples_list, self.renderer_depth, self.renderer_expected_depth)
        if self.training:
            outputs |= {"weights_list": weights_list, "ray_samples_list": samples_list}
        return outputs, rendered.point_rgb

    def _with_normals(self, rays: RayBundle, batch: dict[str, Any] | None, sky: bool) -> tuple[dict[str, Any], Tensor]:
        """The same by nerfacto's own function, which renders normals, too."""
        outputs = super().get_outputs(rays)
        points = self._points(rays, batch, sky)
        point_rgb = rays.origins[:0] if points is None else self.field.forward(points)[FieldHeadNames.RGB][:, 0]
        rendered = Rendered(outputs["rgb"], outputs["accumulation"], rays.origins[:, :0], point_rgb)
        rendered = with_sky(rendered) if sky else rendered
        return {**outputs, "rgb": rendered.rgb}, rendered.point_rgb

    def _has_surface(self, batch: dict[str, Any] | None) -> TypeGuard[dict[str, Any]]:
        """Whether there are surface pixels, whose colour at their surface is compared."""
        return self.training and self.config.surface_loss_mult > 0 and batch is not None and "surface_rays" in batch

    def _points(self, rays: RayBundle, batch: dict[str, Any] | None, sky: bool) -> RaySamples | None:
        """Where the field is asked for colours beside the samples: the sky behind each ray, then the surfaces."""
        bundles, distances = [], []
        if sky:
            bundles.append(rays)
            distances.append(rays.origins.new_full((len(rays),), INFINITELY_FAR))
        if self._has_surface(batch):
            self.camera_optimizer.apply_to_raybundle(batch["surface_rays"])
            bundles.append(batch["surface_rays"])
            distance = draw_surface_m(batch, self.planes) / self.metres_per_unit
            distances.append(distance.masked_fill(batch["surface_sky"][:, 0], INFINITELY_FAR))
        return points_on(bundles, distances, self.fused) if bundles else None

    def _exposed(self, colours: list[Tensor], bundles: list[RayBundle]) -> Sequence[Tensor]:
        """Colours of several bundles, each [rays, 3], as the training pictures that the rays are from have them.

        At evaluation they are unchanged.
        """
        if not self.training or self.exposure is None:
            return colours
        pictures = in_a_row([rays.camera_indices[:, 0] for rays in bundles if rays.camera_indices is not None])
        return self.exposure(torch.cat(colours), pictures).split([len(each) for each in colours])

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

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """Nerfacto's metrics and, in training, the share of rays with a prior."""
        if self.training and self.fused:
            image = self.renderer_rgb.blend_background(batch["image"].to(self.device))
            metrics = {"psnr": self.psnr(outputs["rgb"], image), "distortion": distortion_of(outputs)}
            self.camera_optimizer.get_metrics_dict(metrics)
        else:
            metrics = super().get_metrics_dict(outputs, batch)
        if self.training and self.config.depth_loss != "none":
            metrics["share_with_prior"] = self.planes.hold(batch["prior_distance_m"]).mean(dtype=torch.float32)
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Nerfacto's losses and ours: L_color + λ·L_edge, sky and surfaces."""
        if self.training and self.fused and metrics_dict is not None and not self.config.predict_normals:
            losses = self._nerfacto_losses(outputs, batch, metrics_dict)
        else:
            losses = super().get_loss_dict(outputs, batch, metrics_dict)
        if self.training:
            step = Step(outputs, batch, self.planes, self._share_done(), *self.weights_now())
            left_out = () if "surface_rgb" in outputs else ("surface_loss",)
            losses |= {name: loss(step) for name, loss in self.step_losses.items() if name not in left_out}
        return losses

    def _nerfacto_losses(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics: dict[str, Any]
    ) -> dict[str, Tensor]:
        """Nerfacto's losses without normals, in fewer passes."""
        rendered, image = self.renderer_rgb.blend_background_for_loss_computation(
            outputs["rgb"], outputs["accumulation"], batch["image"].to(self.device)
        )
        losses = {
            "rgb_loss": self.rgb_loss(image, rendered),
            "interlevel_loss": self.config.interlevel_loss_mult * interlevel_of(outputs),
            "distortion_loss": self.config.distortion_loss_mult * metrics["distortion"],
        }
        self.camera_optimizer.get_loss_dict(losses)
        return losses

    def weights_now(self) -> tuple[float | Tensor, float | Tensor]:
        """λ and the weight of surface pixels, at this step."""
        if self.scheduled_weights is not None:
            return self.scheduled_weights
        config, done = self.config, self._share_done()
        surface = config.surface_loss_mult * config.surface_loss_final**done
        return config.depth_loss_mult * config.depth_loss_final**done, surface

    def _share_done(self) -> float:
        """The share of the training that is behind; of `USUAL_STEPS` if no trainer states them."""
        return min(1.0, self._step / max(1, self._training_steps))

    @torch.no_grad()
    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Nerfacto's metrics over the full frame, ours inside the mask, and depth errors.

        Returns:
            psnr, ssim and, given weights, lpips over the full frame; masked_* inside the mask; truth_masked_*
            against the picture without noise where it is known. The pictures hold `distance`, the median distance
            in metric colours, besides nerfacto's. The errors of the median distance (1-60 m) against LiDAR and
            truth, where there are any, are in `evaluation.pooled`: a view without them has no figure of its own.
        """
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        if (lpips := self.lpips.load(self.device)) is None:
            del metrics["lpips"]
        distance_m = outputs["depth"][..., 0] * self.metres_per_unit
        metrics |= self.evaluation.of_view(outputs["rgb"].clamp(0, 1), distance_m, batch, lpips)
        coloured_distance = colour_distance(distance_m.cpu().numpy(), batch["mask"][..., 0].cpu().numpy())
        images["distance"] = torch.from_numpy(coloured_distance).float() / 255
        return metrics, images
