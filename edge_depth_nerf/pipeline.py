"""Holds model and DataManager together, and pools depth errors over the pixels of all held-out views.

nerfstudio would average depth errors over pictures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from edge_depth_nerf.datamanager import FisheyeDepthDataManager, FisheyeDepthDataManagerConfig
from edge_depth_nerf.entry import say_errors_plainly
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.model import EdgeDepthNerfModel, EdgeDepthNerfModelConfig
from edge_depth_nerf.viewer import DrivePanel


@dataclass
class EdgeDepthPipelineConfig(VanillaPipelineConfig):
    """nerfstudio's pipeline with pooled depth errors."""

    _target: type = field(default_factory=lambda: EdgeDepthPipeline)
    """Target class to instantiate."""

    def setup(self, **kwargs: Any) -> Any:
        """Build the pipeline; from here on nerfstudio's commands say our errors without a traceback."""
        say_errors_plainly()
        return super().setup(**kwargs)


class EdgeDepthPipeline(VanillaPipeline):
    """nerfstudio's pipeline with pooled depth errors."""

    def __init__(self, config: EdgeDepthPipelineConfig, device: str | torch.device, *args: Any, **kwargs: Any) -> None:
        """Build both parts; a model gets neither a prior nor further pixels that it would not use.

        Raises:
            InputError: the model has a depth loss, but no training pixel has a prior.
        """
        model, data = config.model, config.datamanager
        assert isinstance(model, EdgeDepthNerfModelConfig) and isinstance(data, FisheyeDepthDataManagerConfig)
        if model.depth_loss == "none":
            config = replace(config, datamanager=replace(data, depth_source="none"))
        elif model.depth_loss != "edge" or model.surface_loss_mult == 0:
            config = replace(config, datamanager=replace(data, surface_rays_per_batch=0))
        super().__init__(config, str(device), *args, **kwargs)
        manager = self.datamanager
        assert isinstance(manager, FisheyeDepthDataManager)
        sampler = manager.train_pixel_sampler
        if model.depth_loss != "none" and sampler is not None and sampler.table.share_with_prior == 0:
            raise InputError(
                f"{manager.get_datapath()}: no training pixel has a depth prior, so nothing for the depth loss "
                f"{model.depth_loss!r}. Process the drive with LiDAR, or make monocular maps by "
                "`edge-depth-nerf estimate-depth`, or train without a prior by "
                "--pipeline.model.depth-loss none."
            )
        self.drive = DrivePanel(manager)

    def get_eval_image_metrics_and_images(self, step: int) -> tuple[dict[str, Any], dict[str, Any]]:
        """Figures and pictures of one held-out view."""
        model = self.model
        assert isinstance(model, EdgeDepthNerfModel)
        model.reset_depth_errors()
        metrics, images = super().get_eval_image_metrics_and_images(step)
        return {**metrics, **model.pooled_depth_errors()}, images

    def get_average_image_metrics(
        self,
        data_loader: Any,
        image_prefix: str,
        step: int | None = None,
        output_path: Path | None = None,
        get_std: bool = False,
    ) -> dict[str, Any]:
        """Nerfstudio's averages over pictures; AbsRel, RMSE and δ are over all their pixels together."""
        model = self.model
        assert isinstance(model, EdgeDepthNerfModel)
        model.reset_depth_errors()
        metrics = super().get_average_image_metrics(data_loader, image_prefix, step, output_path, get_std)
        pooled = model.pooled_depth_errors()
        # a spread over pictures says nothing of a pooled figure, and of a single picture it is NaN
        spreads = {f"{name}_std" for name in pooled}
        kept = {name: value for name, value in metrics.items() if name not in spreads and math.isfinite(value)}
        return {**kept, **pooled}
