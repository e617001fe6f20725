"""Small models for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox

from edge_depth_nerf.plugin.model import EdgeDepthNerfModel


def shrink(model: Any, num_levels: int, log2_hashmap_size: int) -> None:
    """Make a configuration's hash tables small, its proposal networks' too: with Adam's moments these are 30 MB."""
    model.num_levels, model.log2_hashmap_size = num_levels, log2_hashmap_size
    model.proposal_net_args_list = [
        {**each, "log2_hashmap_size": min(log2_hashmap_size, each["log2_hashmap_size"])}
        for each in model.proposal_net_args_list
    ]


def build(**options) -> EdgeDepthNerfModel:
    """edge-depth-nerf-lite's model with other options, on the CPU; `poses`: how cameras are refined."""
    torch.manual_seed(0)
    config = all_methods["edge-depth-nerf-lite"].pipeline.model
    camera_optimizer = replace(config.camera_optimizer, mode=options.pop("poses", "off"))
    config = replace(config, camera_optimizer=camera_optimizer, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return config.setup(scene_box=box, num_train_data=3, metadata={"metres_per_unit": 20.0}, device="cpu")
