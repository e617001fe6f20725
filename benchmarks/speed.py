"""Training steps and rendering beside nerfstudio's own classes, in one run.

    python benchmarks/speed.py [--scene data/sample_drive] [--preset lite full] [--rounds 5] [--steps 10] [--json FILE]

Four trainers with the same sizes (levels, table, samples, rays, chunk; pose refinement off) on the same scene:
nerfstudio's nerfacto and depth-nerfacto with its own DataManager and its torch implementation, and ours with the torch
implementation and with the one that `auto` takes. (nerfstudio's nerfacto would read ahead in other processes, which
two cores do not have; VanillaDataManager, its other one, is used for both.) Each round, every trainer makes the same
number of whole training iterations (batch, forward, losses, backward, optimisers, schedulers) in turn, at steps spread
over the whole schedule, since proposal networks are trained less often later. A held-out picture is rendered by each
in turn, too. Ratios are taken within a round: what else the machine does hits all of them. Median and range over the
rounds.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.models.depth_nerfacto import DepthNerfactoModelConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

from edge_depth_nerf import config as ours
from edge_depth_nerf.compat import lpips_not_built

PRESETS: dict[str, Any] = {"lite": ours.edge_depth_nerf_lite, "full": ours.edge_depth_nerf}
REFERENCE = "nerfacto"


@dataclass
class Contestant:
    """A trainer, and the seconds it took in each round."""

    trainer: Trainer
    step_s: list[float] = dataclasses.field(default_factory=list)
    render_s: list[float] = dataclasses.field(default_factory=list)

    def iterate(self, step: int) -> None:
        """One iteration as nerfstudio's trainer makes it."""
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        self.trainer.train_iteration(step)
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)


def configurations(preset: str, scene: Path) -> dict[str, Any]:
    """The contestants' configurations."""
    base: Any = copy.deepcopy(PRESETS[preset].config)
    base.pipeline.datamanager.dataparser.data = scene
    base.pipeline.datamanager.data = scene
    found = {}
    for name, kind in (("nerfacto", NerfactoModelConfig), ("depth-nerfacto", DepthNerfactoModelConfig)):
        config: Any = copy.deepcopy(method_configs["depth-nerfacto"])
        shared = {
            field.name: copy.deepcopy(getattr(base.pipeline.model, field.name))
            for field in dataclasses.fields(NerfactoModelConfig)
            if field.name not in ("_target", "implementation")
        }
        config.pipeline.model = kind(**shared, implementation="torch")
        data = config.pipeline.datamanager
        data.dataparser = NerfstudioDataParserConfig(data=scene, depth_unit_scale_factor=1 / 256)
        if kind is NerfactoModelConfig:
            data._target = VanillaDataManager[InputDataset]
        data.train_num_rays_per_batch = base.pipeline.datamanager.train_num_rays_per_batch
        config.mixed_precision = base.mixed_precision
        config.max_num_iterations = base.max_num_iterations
        found[name] = config
    for name, implementation in (("ours, torch", "torch"), ("ours", "auto")):
        config = copy.deepcopy(base)
        config.pipeline.model.implementation = implementation
        found[name] = config
    return found


def build(config: TrainerConfig, folder: Path) -> Trainer:
    """A trainer that is ready."""
    config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
    config.machine.seed = 0
    config.vis = "tensorboard"
    config.output_dir = folder
    config.experiment_name, config.timestamp = "speed", "run"
    config.logging.local_writer.enable = False
    torch.manual_seed(0)
    with lpips_not_built():
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup(test_mode="val")
    trainer.pipeline.train()
    return trainer


def seconds(work: Callable[[], Any]) -> float:
    """Wall time, with what the GPU still does."""
    started = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - started


def measure(preset: str, scene: Path, rounds: int, steps: int) -> dict[str, Any]:
    """Run all contestants of a preset."""
    with ExitStack() as stack:
        contestants = {}
        for name, config in configurations(preset, scene).items():
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            CONSOLE.print(f"Building {name} ({preset})")
            contestants[name] = Contestant(build(config, folder))
        schedule = PRESETS[preset].config.max_num_iterations
        spread = [round((number + 0.5) * schedule / (rounds * steps)) for number in range(rounds * steps)]
        for contestant in contestants.values():  # kernels are compiled, memory is there
            for step in range(3):
                contestant.iterate(step)
        for number in range(rounds):
            chosen = spread[number * steps : (number + 1) * steps]
            for contestant in contestants.values():
                whole_s = seconds(lambda c=contestant, s=chosen: [c.iterate(step) for step in s])
                contestant.step_s.append(whole_s / steps)
            for contestant in contestants.values():
                pipeline = contestant.trainer.pipeline
                pipeline.eval()
                camera = pipeline.datamanager.eval_dataset.cameras[0:1].to(pipeline.device)
                with torch.no_grad():
                    contestant.render_s.append(seconds(lambda p=pipeline, c=camera: p.model.get_outputs_for_camera(c)))
                pipeline.train()
            CONSOLE.print(f"{preset}: round {number + 1} of {rounds}")
    rays = PRESETS[preset].config.pipeline.datamanager.train_num_rays_per_batch
    reference = contestants[REFERENCE]
    return {
        name: {
            "rays_per_second": rays / statistics.median(contestant.step_s),
            "step_s": contestant.step_s,
            "step_ratio": [a / b for a, b in zip(reference.step_s, contestant.step_s, strict=True)],
            "render_s": contestant.render_s,
            "render_ratio": [a / b for a, b in zip(reference.render_s, contestant.render_s, strict=True)],
        }
        for name, contestant in contestants.items()
    }


def spread_of(values: list[float], form: str) -> str:
    """Median and range."""
    return f"{statistics.median(values):{form}} ({min(values):{form}}-{max(values):{form}})"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=Path("data/sample_drive"))
    parser.add_argument("--preset", nargs="+", default=["lite"], choices=list(PRESETS))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results: dict[str, Any] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
            "torch": torch.__version__,
        }
    }
    for preset in options.preset:
        results[preset] = measure(preset, options.scene, options.rounds, options.steps)
        table = Table(
            "", "rays/s", "s a step", "× nerfacto", "s a view", "× nerfacto", title=f"{preset}, {options.scene}"
        )
        for name, found in results[preset].items():
            table.add_row(
                name,
                f"{found['rays_per_second']:,.0f}",
                spread_of(found["step_s"], ".3f"),
                spread_of(found["step_ratio"], ".2f"),
                spread_of(found["render_s"], ".2f"),
                spread_of(found["render_ratio"], ".2f"),
            )
        CONSOLE.print(table)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
