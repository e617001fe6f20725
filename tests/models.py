"""Small models for tests, and what they are trained with."""

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
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


def build(small: bool = True, **options) -> EdgeDepthNerfModel:
    """edge-depth-nerf-lite's model, with small tables; `poses`: how cameras are refined, `device`: where it will be."""
    torch.manual_seed(0)
    config, device = deepcopy(all_methods["edge-depth-nerf-lite"].pipeline.model), options.pop("device", "cpu")
    if small:
        shrink(config, config.num_levels, 12)
    camera_optimizer = replace(config.camera_optimizer, mode=options.pop("poses", "off"))
    config = replace(config, camera_optimizer=camera_optimizer, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return config.setup(
        scene_box=box, num_train_data=3, metadata={"metres_per_unit": 20.0, "frames": [0, 1, 2]}, device=device
    )


def pipeline_config(scene: Path, poses: str = "off", **model: Any) -> Any:
    """edge-depth-nerf-lite's pipeline of a scene, small, with other options of the model."""
    config = deepcopy(all_methods["edge-depth-nerf-lite"].pipeline)
    config.datamanager.data = scene
    shrink(config.model, 2, 8)
    config.model.camera_optimizer.mode = poses
    for name, value in model.items():
        setattr(config.model, name, value)
    return config


def pipeline_of(scene: Path, test_mode: str = "val", **options: Any) -> Any:
    """The same, set up."""
    return pipeline_config(scene, **options).setup(device="cpu", test_mode=test_mode)


def bundle(count: int = 40, seed: int = 1, planes: bool = False) -> RayBundle:
    """Rays of three pictures, with near and far planes of their own or without."""
    generator = torch.Generator().manual_seed(seed)
    return RayBundle(
        origins=torch.rand(count, 3, generator=generator) - 0.5,
        directions=torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1),
        pixel_area=torch.full((count, 1), 1e-4),
        camera_indices=torch.arange(count)[:, None] % 3,
        nears=torch.full((count, 1), 0.01) if planes else None,
        fars=torch.full((count, 1), 50.0) if planes else None,
    )


def supervision(count: int, seed: int) -> dict[str, torch.Tensor]:
    """What a batch holds beside its rays; a quarter of them without a prior, a seventh of sky."""
    generator = torch.Generator().manual_seed(seed)
    prior = 3 + 10 * torch.rand(count, 1, generator=generator)
    prior[::4] = 0
    return {
        "image": torch.rand(count, 3, generator=generator),
        "prior_distance_m": prior,
        "prior_sigma_m": 0.1 * prior + 0.01,
        "sky": (torch.arange(count) % 7 == 0)[:, None],
    }


def surface(count: int = 6) -> dict[str, Any]:
    """What a batch holds of further pixels, the last two of them sky."""
    generator = torch.Generator().manual_seed(4)
    sky = (torch.arange(count) >= count - 2)[:, None]
    distance = torch.where(sky, 0.0, 4 + torch.rand(count, 1, generator=generator))
    return {
        "surface_rays": bundle(count),
        "surface_image": torch.rand(count, 3, generator=generator),
        "surface_distance_m": distance,
        "surface_sigma_m": torch.where(sky, 0.0, 1e-6),
        "surface_sky": sky,
    }


def layers(*widths: int) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Weights and biases of a network that follows gradients."""
    shapes = list(zip(widths[1:], widths, strict=False))
    return [torch.randn(s, requires_grad=True) for s in shapes], [torch.randn(s[0], requires_grad=True) for s in shapes]
