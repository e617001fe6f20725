"""The methods that nerfstudio registers, made from nerfstudio_method.toml.

Every ns-* command imports this module. Nothing of the host is changed by that: what a command needs for our methods is
set up when one of them is (`EdgeDepthPipelineConfig.setup`, `EdgeDepthTrainerConfig.save_config`).

An override is a dotted name in the configuration and a value. Names and types are checked against the configuration
itself; one error reports all that is wrong.
"""

from __future__ import annotations

import difflib
import sys
from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import resources
from typing import Any

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.plugins.types import MethodSpecification

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.kernels.table_adam import TableAdam
from edge_depth_nerf.plugin.compat import know_modules_of_importer
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.model import EdgeDepthNerfModelConfig
from edge_depth_nerf.plugin.pipeline import EdgeDepthPipelineConfig
from edge_depth_nerf.plugin.schedules import TrainingScheduleConfig
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainerConfig

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyrefly: ignore[missing-import]


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over each tensor, on the CPU and on CUDA: the same steps, half the time."""

    _target: type = TableAdam
    """Target class to instantiate."""
    fused: bool = True
    """torch's fused form; without it, its default."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay a step of the gradients' running mean, and of that of their squares."""

    def setup(self, params: Any) -> torch.optim.Optimizer:
        """Make the optimiser; nerfstudio clips whole gradients, which hash tables then have."""
        optimizer = super().setup(params)
        if isinstance(optimizer, TableAdam) and self.max_norm is not None:
            optimizer.want_whole_gradients()
        return optimizer


METHOD_FILE = "nerfstudio_method.toml"
RAYS_AT_ONCE = {"cpu": 8192, "cuda": 49_152}
"""Of a view. A CPU has them in its caches; for a GPU the host launches as many kernels for few as for many."""


def read_method_file() -> dict[str, Any]:
    """Read the shipped nerfstudio_method.toml as nested dictionaries."""
    return tomllib.loads((resources.files("edge_depth_nerf") / METHOD_FILE).read_text(encoding="utf-8"))


def base_config(method_name: str) -> TrainerConfig:
    """Give what all methods share: Adam over the training, fixed poses, a viewer that listens on this machine only."""

    def optimiser(warmup: float = 0.0) -> dict[str, Any]:
        scheduler = TrainingScheduleConfig(lr_final=1e-4, warmup_steps=warmup)
        return {"optimizer": FusedAdamConfig(lr=1e-2, eps=1e-15), "scheduler": scheduler}

    # nerfstudio's default is cuda, also where there is none
    device_type = "cuda" if torch.cuda.is_available() else "cpu"
    model = EdgeDepthNerfModelConfig(eval_num_rays_per_chunk=RAYS_AT_ONCE[device_type])
    return EdgeDepthTrainerConfig(
        method_name=method_name,
        machine=MachineConfig(device_type=device_type),
        pipeline=EdgeDepthPipelineConfig(datamanager=FisheyeDepthDataManagerConfig(), model=model),
        optimizers={"proposal_networks": optimiser(), "fields": optimiser(), "camera_opt": optimiser(warmup=0.1)},
        viewer=ViewerConfig(num_rays_per_chunk=model.eval_num_rays_per_chunk, websocket_host="127.0.0.1"),
        vis="viewer",
        # the trainer says where it is, in lines that a file can hold
        logging=LoggingConfig(local_writer=LocalWriterConfig(enable=False), profiler="none"),
    )


def _children(node: Any) -> list[str]:
    if isinstance(node, dict):
        return list(node)
    return [entry.name for entry in fields(node)] if is_dataclass(node) else []


def _set(nodes: list[Any], parts: list[str], value: Any) -> None:
    """Set the last of `parts` in the last node; a node that cannot change is replaced in the one that holds it."""
    for node, part in zip(reversed(nodes), reversed(parts), strict=True):
        if isinstance(node, dict):
            node[part] = value
            return
        if not type(node).__dataclass_params__.frozen:
            setattr(node, part, value)
            return
        value = replace(node, **{part: value})


def apply_overrides(config: Any, overrides: dict[str, Any], where: str) -> None:
    """Set dotted names in a configuration, in place.

    Raises:
        InputError: names that do not exist or values of another type, all of them in one message.
    """
    problems = []
    for name, value in overrides.items():
        nodes = [config]
        for part in name.split("."):
            children = _children(nodes[-1])
            if part not in children:
                near = difflib.get_close_matches(part, children, 1)
                problems.append(f"{name}: there is no {part!r}" + (f" (did you mean {near[0]!r}?)" if near else ""))
                break
            nodes.append(nodes[-1][part] if isinstance(nodes[-1], dict) else getattr(nodes[-1], part))
        else:
            before = nodes.pop()
            if isinstance(before, tuple) and isinstance(value, list):
                value = tuple(value)
            if isinstance(before, float) and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if before is not None and type(value) is not type(before):
                problems.append(f"{name}: expected {type(before).__name__}, found {value!r}")
            else:
                _set(nodes, name.split("."), value)
    if problems:
        raise InputError(f"{where}: " + "; ".join(problems))


def make_specifications(declared: dict[str, Any]) -> dict[str, MethodSpecification]:
    """Turn the declarations of a method file into nerfstudio's specifications.

    Raises:
        InputError: an unknown preset, name or type; the message says where.
    """
    constants = {name: entry["value"] for name, entry in declared["constants"].items()}
    specifications = {}
    for name, method in declared["methods"].items():
        preset = method["preset"]
        if preset not in declared["presets"]:
            raise InputError(
                f"{METHOD_FILE}: method {name!r} names the preset {preset!r}; "
                f"there are {', '.join(declared['presets'])}."
            )
        config = base_config(name)
        apply_overrides(config, constants, f"{METHOD_FILE}, [constants]")
        apply_overrides(config, declared["presets"][preset], f"{METHOD_FILE}, [presets.{preset}]")
        specifications[name] = MethodSpecification(config=config, description=method["description"])
    return specifications


know_modules_of_importer()
_specifications = make_specifications(read_method_file())

edge_depth_nerf = _specifications["edge-depth-nerf"]
edge_depth_nerf_lite = _specifications["edge-depth-nerf-lite"]
edge_depth_nerf_paper = _specifications["edge-depth-nerf-paper"]
