"""The fused forms of nerfacto's parts against nerfstudio's own: fields, samples, losses, rays, whole training steps."""

from __future__ import annotations

from dataclasses import replace

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox

from edge_depth_nerf.model import EdgeDepthNerfModel


def bundle(count: int = 40, seed: int = 1) -> RayBundle:
    generator = torch.Generator().manual_seed(seed)
    return RayBundle(
        origins=torch.rand(count, 3, generator=generator) - 0.5,
        directions=torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1),
        pixel_area=torch.full((count, 1), 1e-4),
        camera_indices=torch.arange(count)[:, None] % 3,
        nears=torch.full((count, 1), 0.01),
        fars=torch.full((count, 1), 50.0),
    )


def build(**options) -> EdgeDepthNerfModel:
    torch.manual_seed(0)
    config = all_methods["edge-depth-nerf-lite"].pipeline.model
    camera_optimizer = replace(config.camera_optimizer, mode=options.pop("poses", "off"))
    config = replace(config, camera_optimizer=camera_optimizer, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return config.setup(scene_box=box, num_train_data=3, metadata={"metres_per_unit": 20.0}, device="cpu")


def test_training_renders_no_depth_that_nobody_reads():
    for loss, expected in (("edge", set()), ("urban-nerf", {"expected_depth"})):
        model = build(depth_loss=loss).train()
        outputs = model(bundle())
        assert {name for name in outputs if "depth" in name} == expected
