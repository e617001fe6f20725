"""Holds model and DataManager together, and pools depth errors over the pixels of all held-out views.

nerfstudio would average depth errors over pictures.
"""

from __future__ import annotations

import math
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.plugin.compat import allow_numpy_scalars_in_checkpoints, ignore_deprecations_of_host
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManager, FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import transforms_path
from edge_depth_nerf.plugin.detail import TrainingDetail
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.plugin.fused.build import kernels_prepared
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel, EdgeDepthNerfModelConfig
from edge_depth_nerf.plugin.plain_errors import say_errors_plainly
from edge_depth_nerf.plugin.viewer import DriveLayers
from edge_depth_nerf.scene.format import depth_sources, layers_of, read_transforms

FARTHEST_UNITS = 1e6
"""nerfstudio's sampler turns a distance x beyond 1 into 1 - 1/(2x): float32 has no such number below 1 from 2^23 on."""
_LOOKED_AT = 10_000
"""So many pixels, in their random order, tell whether the prior's unit can be right."""
STEPS_PER_CHECK = 50
"""On a GPU steps whose loss is not finite are counted, and the count is read once in so many steps."""
MOST_NOT_FINITE = 5
"""So many of them may be: the scaler of mixed precision skips such a step. NaN in a parameter stays, and makes more."""
MOST_NAMED = 5
"""An error names so many pictures."""
SAME_M, SAME_SCALE = 0.05, 1e-3
"""Origins and scales of a scene that differ by no more are the same."""
_FITS = (
    "Load it with the options of its training (config.yml beside its folder has them) and its unchanged scene, or "
    "train again."
)


def _written(numbers: torch.Tensor) -> str:
    return ", ".join(f"{number:.6g}" for number in numbers.tolist())


def _has_depth(data: FisheyeDepthDataManagerConfig) -> bool:
    """Whether any picture of the scene has a map that a prior can be made of."""
    # nerfstudio's commands set the one, and the DataManager moves it to the other
    path = transforms_path(Path(data.data or data.dataparser.data))
    wanted = {*depth_sources()}
    return any(wanted & layers_of(frame) for frame in read_transforms(path)["frames"])


@dataclass
class EdgeDepthPipelineConfig(VanillaPipelineConfig):
    """nerfstudio's pipeline with pooled depth errors."""

    _target: type = field(default_factory=lambda: EdgeDepthPipeline)
    """Target class to instantiate."""

    def setup(self, **kwargs: Any) -> Any:
        """Build the pipeline; from here on nerfstudio's commands load its checkpoints, and print our errors plainly."""
        allow_numpy_scalars_in_checkpoints()
        say_errors_plainly()
        ignore_deprecations_of_host()
        return super().setup(**kwargs)


class NotFiniteError(InputError):
    """A loss became NaN or infinite: by a picture or map, or by options of the training."""


class EdgeDepthPipeline(VanillaPipeline):
    """nerfstudio's pipeline with pooled depth errors."""

    datamanager: FisheyeDepthDataManager  # pyrefly: ignore

    def __init__(self, config: EdgeDepthPipelineConfig, device: str | torch.device, *args: Any, **kwargs: Any) -> None:
        """Build both parts; a model gets neither a prior nor further pixels that it would not use.

        Raises:
            InputError: the model has a depth loss, and the depth maps give no training pixel a prior that it uses; or
                an option is out of its range. A scene without such maps is trained without the loss.
        """
        model, data = config.model, config.datamanager
        assert isinstance(model, EdgeDepthNerfModelConfig) and isinstance(data, FisheyeDepthDataManagerConfig)
        model.check()
        if model.depth_loss != "none" and data.depth_source == "auto" and not _has_depth(data):
            scene = escape(str(data.dataparser.data))
            if kwargs.get("test_mode", "val") == "val":
                CONSOLE.log(
                    f"[yellow]{scene}: the scene has no depth maps (LiDAR, monocular or from motion), so this is "
                    "nerfacto without a depth loss, with our exposure, scale and held-out pictures. `edge-depth-nerf "
                    f"estimate-depth {scene} --hf NETWORK` makes monocular maps (docs/mono.md)."
                )
            model = replace(model, depth_loss="none")
            config = replace(config, model=model)
        if model.depth_loss == "none":
            config = replace(config, datamanager=replace(data, depth_source="none"))
        elif model.surface_loss_mult == 0:
            config = replace(config, datamanager=replace(data, surface_rays_per_batch=0))
        # kernels compile while the prior is integrated
        trains = kwargs.get("test_mode", "val") == "val" and model.implementation == "fused"
        with kernels_prepared(device) if trains else nullcontext():
            super().__init__(config, str(device), *args, **kwargs)
        manager = self.datamanager
        metres_per_unit = manager.train_dataset.metadata["metres_per_unit"]
        if model.far_m / metres_per_unit > FARTHEST_UNITS:
            raise InputError(
                f"{manager.get_datapath()}: the far plane of {model.far_m:g} m is at "
                f"{model.far_m / metres_per_unit:.3g} scene units ({metres_per_unit:.3g} m each); beyond "
                f"{FARTHEST_UNITS:g} float32 cannot distinguish the samples along a ray. Lower "
                "--pipeline.model.far-m, or leave fisheye-depth-data --metres-per-unit at its default."
            )
        sampler = manager.train_pixel_sampler
        if model.depth_loss != "none" and sampler is not None and sampler.table.share_with_prior == 0:
            raise InputError(
                f"{manager.get_datapath()}: no training pixel has a depth prior, which the depth loss needs: "
                f"{model.depth_loss!r}. Process the drive with LiDAR, make monocular maps with `edge-depth-nerf "
                "estimate-depth`, or train without a prior with --pipeline.model.depth-loss none."
            )
        if model.depth_loss != "none" and sampler is not None:
            prior_m = sampler.table.batch(0, _LOOKED_AT).prior_distance_m
            prior_m = prior_m[prior_m > 0]
            if len(prior_m) and not ((prior_m >= model.near_m) & (prior_m <= model.far_m)).any():
                raise InputError(
                    f"{manager.get_datapath()}: no depth prior is between the near plane ({model.near_m:g} m) and the "
                    f"far one ({model.far_m:g} m); their median is {float(prior_m.median()):.3g} m. Check the unit of "
                    "the depth maps: nerfstudio's is 0.001 m. If they are in metres, add `fisheye-depth-data "
                    "--depth-unit-scale-factor 1` to the end of the command."
                )
        assert isinstance(self.model, EdgeDepthNerfModel)
        self.detail = self.model.detail = TrainingDetail(self.model, manager.train_dataset)
        self.model.register_load_state_dict_post_hook(lambda *_: self.detail.forget())
        self.layers = DriveLayers(manager, model.detail)
        self._odd_steps = torch.zeros((), dtype=torch.long, device=device)
        # what a checkpoint's numbers mean nothing without, and what has no size: origin, scale, and cells of the grids
        outputs = manager.train_dataparser_outputs
        grids = [model.base_res, model.max_res, *(each["max_res"] for each in model.proposal_net_args_list)]
        made_with = [*outputs.dataparser_transform[:, 3].tolist(), 1 / outputs.dataparser_scale, *grids]
        self.register_buffer("made_with", torch.tensor(made_with, dtype=torch.float64))

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint as nerfstudio does.

        Raises:
            InputError: it is of tiny-cuda-nn, other options or another scene; nerfstudio would load what fits, and say
                nothing of the rest.
        """
        # tiny-cuda-nn keeps table and network in one parameter
        if not any(key.endswith(".hash_table") for key in loaded_state):
            raise InputError(
                "This checkpoint has no hash tables: it was made with tiny-cuda-nn, which keeps them in another form. "
                "Train again; the fused kernels need no tiny-cuda-nn and are faster."
            )
        here, own = self.model.state_dict(), self.made_with.cpu().clone()
        given = {name.replace("module.", "").removeprefix("_model."): value for name, value in loaded_state.items()}
        odd = [name for name, value in given.items() if name in here and here[name].shape != value.shape]
        if odd:
            raise InputError(f"The checkpoint's {', '.join(odd[:3])} have other sizes than here. {_FITS}")
        made_with = given.get("made_with", own).cpu()  # those of before have none
        same = len(made_with) == len(own) and torch.allclose(made_with[3:], own[3:], rtol=SAME_SCALE, atol=0)
        if not same or (made_with[:3] - own[:3]).norm() > SAME_M:
            found, expected = (
                f"{each[3]:.4g} m a unit, the origin at {_written(-each[:3])} m, grids of {_written(each[4:])} cells"
                for each in (made_with, own)
            )
            raise InputError(f"The checkpoint was made with {found}; here are {expected}. {_FITS}")
        super().load_pipeline(loaded_state, step)
        self.made_with.copy_(own)

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Any], dict[str, Any]]:
        """Outputs, losses and metrics of the next batch, as nerfstudio gives them.

        Raises:
            NotFiniteError: a loss is not finite; before the step is taken. On a GPU, which would have to be waited for,
                such steps are counted, and several end the training.
        """
        self.detail.forget()
        outputs, losses, metrics = self.computed(*self.datamanager.next_train(step))
        total = torch.stack([loss.detach() for loss in losses.values()]).sum()
        if torch.device(self.device).type == "cpu":
            if not bool(total.isfinite()):
                raise NotFiniteError(self._not_finite(step, outputs, losses))
        else:
            self.count_not_finite(total)
            self.look_for_not_finite(step, outputs, losses)
        return outputs, losses, metrics

    def computed(self, rays: RayBundle, batch: dict[str, Any]) -> tuple[dict[str, Any], Any, dict[str, Any]]:
        """Outputs, losses and metrics of a batch."""
        # the wrapped model, where several processes train; nerfstudio gives it the rays alone
        outputs = self._model(rays, batch)
        metrics = self.model.get_metrics_dict(outputs, batch)
        losses: Any = self.model.get_loss_dict(outputs, batch, metrics)
        return outputs, losses, metrics

    def count_not_finite(self, total: torch.Tensor) -> None:
        """Count a step, if the sum of its losses is not finite, where it is."""
        # what is not finite, less itself, is NaN
        self._odd_steps += total - total != 0

    def look_for_not_finite(self, step: int, outputs: dict[str, Any], losses: dict[str, Any]) -> None:
        """Look at the count of such steps, if it is time.

        Raises:
            NotFiniteError: there were several since the last look.
        """
        if step % STEPS_PER_CHECK:
            return
        count = int(self._odd_steps)
        self._odd_steps.zero_()
        if count > MOST_NOT_FINITE:
            odd = not all(math.isfinite(float(loss.detach())) for loss in losses.values())
            found = self._not_finite(step, outputs, losses) if odd else f"Step {step}: all losses are finite."
            raise NotFiniteError(f"{found} In {count} of the last {STEPS_PER_CHECK} steps a loss was not finite.")
        if count:
            CONSOLE.print(
                f"[yellow]In {count} of the last {STEPS_PER_CHECK} steps a loss was not finite; mixed precision skips "
                "them."
            )

    def broken_parameter(self) -> str | None:
        """Name the first parameter that has a number that is not finite; None where there is none."""
        # a sum is not finite if one of its terms is not
        sums = ((name, each.detach().sum(dtype=torch.float64)) for name, each in self.model.named_parameters())
        return next((name for name, total in sums if not torch.isfinite(total)), None)

    def _not_finite(self, step: int, outputs: dict[str, Any], losses: dict[str, Any]) -> str:
        """Say which losses are not finite, and in which pictures, or by which parameter."""
        manager = self.datamanager
        odd = [
            f"{name} is {value}" for name, loss in losses.items() if not math.isfinite(value := float(loss.detach()))
        ]
        if (name := self.broken_parameter()) is not None:
            return (
                f"Step {step}: {', '.join(odd)}, as the parameter {name} is not finite, which an earlier step made it."
            )
        count = len(manager.trained_on)
        rendered = [outputs["rgb"], *(weights.flatten(1) for weights in outputs.get("weights_list", ()))]
        bad = ~torch.cat([torch.isfinite(values) for values in rendered], dim=-1).all(-1)
        some = 0 < int(bad.sum()) < count
        names = manager.pictures_of(bad.nonzero()[:, 0] if some else None)
        rays = f"{int(bad.sum())} of {count} rays are not finite" if some else f"its {count} rays"
        listed = f"{', '.join(names[:MOST_NAMED])}{' …' if len(names) > MOST_NAMED else ''}"
        return (
            f"Step {step}: {', '.join(odd)}; {rays}, from {len(names)} "
            f"pictures: {listed}. Check them with `edge-depth-nerf inspect`. If they are fine, lower the learning "
            "rate or the weights of the losses, or turn mixed precision off (--mixed-precision False)."
        )

    def held_out_psnr(self) -> float:
        """PSNR of the next batch of held-out pixels, dB; it leaves no trace in a training."""
        model: Any = self.model
        with evaluated(model):
            rays, batch = self.datamanager.next_eval(0)
            return float(model.psnr(model(rays)["rgb"].clamp(0, 1), batch["image"]))

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Figures and pictures of one held-out view."""
        model: Any = self.model
        model.evaluation.reset()
        metrics, images = super().get_eval_image_metrics_and_images(step)
        return {**metrics, **model.evaluation.pooled()}, images

    def get_average_image_metrics(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Average figures over pictures as nerfstudio does, but AbsRel, RMSE and δ over all their pixels together."""
        model: Any = self.model
        model.evaluation.reset()
        metrics = super().get_average_image_metrics(*args, **kwargs)
        pooled = model.evaluation.pooled()
        # a spread over pictures says nothing of a pooled figure, and of a single picture it is NaN
        spreads = {f"{name}_std" for name in pooled}
        kept = {name: value for name, value in metrics.items() if name not in spreads and math.isfinite(value)}
        return {**kept, **pooled}
