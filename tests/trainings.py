"""Short trainings in this process, on the CPU."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from models import shrink
from nerfstudio.configs.method_configs import all_methods

from edge_depth_nerf.plugin.config import edge_depth_nerf_lite
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer


def write_config(config: Path, scene: Path) -> Path:
    """Write the config.yml of a training on a scene, with 10 m in a unit, and a checkpoint that holds nothing."""
    settings = edge_depth_nerf_lite.config
    parser = FisheyeDepthDataParserConfig(metres_per_unit=10.0)
    datamanager = replace(settings.pipeline.datamanager, dataparser=parser, data=scene)  # pyrefly: ignore
    (config.parent / "nerfstudio_models").mkdir(parents=True, exist_ok=True)
    torch.save({}, config.parent / "nerfstudio_models" / "step-000000009.ckpt")
    config.write_text(yaml.dump(replace(settings, pipeline=replace(settings.pipeline, datamanager=datamanager))))
    return config


def trainer_of(scene: Path, output: Path, rank: int = 0, world_size: int = 1, **changes: Any) -> EdgeDepthTrainer:
    """edge-depth-nerf-lite, small, set up; `model__x`, `losses__x`, `data__x` and `parser__x` go to these parts."""
    config = copy.deepcopy(all_methods["edge-depth-nerf-lite"])
    config.output_dir, config.experiment_name, config.timestamp = output, "small", "run"
    config.vis, config.data = "tensorboard", scene
    config.logging.local_writer.enable = False
    pipeline = config.pipeline
    pipeline.datamanager.dataparser.data = scene
    pipeline.datamanager.train_num_rays_per_batch = 64
    shrink(pipeline.model, 4, 12)
    parts = {"model": pipeline.model, "data": pipeline.datamanager, "parser": pipeline.datamanager.dataparser}
    parts["losses"] = pipeline.model.losses
    for name, value in changes.items():
        part, _, field = name.rpartition("__")
        node = parts[part] if part else config
        assert hasattr(node, field), name
        setattr(node, field, value)
    torch.manual_seed(rank)  # as nerfstudio's own processes
    trainer = config.setup(local_rank=rank, world_size=world_size)
    assert isinstance(trainer, EdgeDepthTrainer)
    trainer.setup()
    return trainer


def train(scene: Path, output: Path, steps: int) -> tuple[Any, list[float]]:
    """Train on 256 rays a step: the pipeline, and the loss of the colours in each step."""
    options = {"data__train_num_rays_per_batch": 256, "model__log2_hashmap_size": 14}
    trainer = trainer_of(scene, output, **options)
    return trainer.pipeline, [float(trainer.train_iteration(step)[1]["rgb_loss"].detach()) for step in range(steps)]
