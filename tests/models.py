"""Small models for tests."""

from __future__ import annotations

from dataclasses import replace

import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox

from edge_depth_nerf.plugin.model import EdgeDepthNerfModel


def build(**options) -> EdgeDepthNerfModel:
    """edge-depth-nerf-lite's model with other options, on the CPU; `poses`: how cameras are refined."""
    torch.manual_seed(0)
    config = all_methods["edge-depth-nerf-lite"].pipeline.model
    camera_optimizer = replace(config.camera_optimizer, mode=options.pop("poses", "off"))
    config = replace(config, camera_optimizer=camera_optimizer, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return config.setup(scene_box=box, num_train_data=3, metadata={"metres_per_unit": 20.0}, device="cpu")
