"""Training steps and rendering beside nerfstudio's own classes, in one run.

    python -m benchmarks.speed.turns [--scene data/sample_drive] [--preset lite full] [--rounds 5] [--steps 10]
                                     [--json FILE] [--beside CHECKOUT]

Trainers with the same sizes (levels, table, samples, rays, chunk; pose refinement off) on the same scene: nerfstudio's
nerfacto with its own DataManager and its torch implementation, and ours; if asked for, ours without CUDA graphs, too.
(nerfstudio's nerfacto would read ahead in other processes, which two cores do not have; VanillaDataManager, its other
one, is used.) Each round, every trainer makes the same number of whole training iterations (batch, forward, losses,
backward, optimisers, schedulers) in turn, at steps spread over the whole schedule, since proposal networks are trained
less often later. A held-out view, or as many of its rows as `--view-rays` allows, is rendered by each in turn, too.
Ratios are taken within a round: what else the machine does hits all of them. Median and range over the rounds. Each
trainer has a process of its own, which sleeps while it is another's turn. With `--beside` one more is the code of
another checkout (`git worktree add`), with the configuration of this one: whether a change made a step faster or slower
is read in one run.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import json
import multiprocessing
import os
import platform
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.nerfacto import NerfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.table import Table

import edge_depth_nerf
from benchmarks.speed.report import ratios
from edge_depth_nerf.plugin import config as ours
from edge_depth_nerf.plugin.compat import lpips_not_built

PRESETS: dict[str, Any] = {"lite": ours.edge_depth_nerf_lite, "full": ours.edge_depth_nerf}
EAGER = "ours, without CUDA graphs"
BESIDE = "ours, other checkout"
REFERENCE = "nerfacto"
ON_EVERY_MACHINE = (REFERENCE, "ours")
WARM_UPS = 50
"""So many steps are made on a GPU before any is timed."""
KINDS_OF_STEPS = 2
"""Those that train the proposal networks, and those that do not: a CUDA graph of each is recorded."""


class Runner:
    """A trainer in this process."""

    def __init__(self, config: TrainerConfig, folder: Path, seed: int = 0) -> None:
        config.machine.device_type = "cuda" if torch.cuda.is_available() else "cpu"
        config.machine.seed = seed
        config.vis = "tensorboard"
        config.output_dir = folder
        config.experiment_name, config.timestamp = "speed", "run"
        config.logging.local_writer.enable = False
        torch.manual_seed(seed)
        with lpips_not_built():
            self.trainer = config.setup(local_rank=0, world_size=1)
            self.trainer.setup(test_mode="val")
        self.trainer.pipeline.train()
        # ours evaluates now and then, to say where it is
        self.trainer.tell = lambda *_: None

    def iterate(self, steps: Sequence[int]) -> float:
        """Seconds of some iterations as nerfstudio's trainer makes them."""
        return seconds(lambda: [self._iterate(step) for step in steps])

    def _iterate(self, step: int) -> None:
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        self.trainer.train_iteration(step)
        for callback in self.trainer.callbacks:
            callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)

    def graphs(self, _: None) -> int | None:
        """How many CUDA graphs its steps are replayed from; None where none are asked for, or there is no GPU."""
        if not getattr(self.trainer.config, "cuda_graphs", False) or not torch.cuda.is_available():
            return None
        graphs: Any = self.trainer.graphs
        return 0 if graphs is None else graphs.recorded

    def render(self, most_rays: int) -> tuple[float, tuple[int, int]]:
        """Seconds of rendering rows from the middle of the first held-out view, and their height and width."""
        pipeline: Any = self.trainer.pipeline
        pipeline.eval()
        camera = pipeline.datamanager.eval_dataset.cameras[0:1].to(pipeline.device)
        coords = camera.get_image_coords()
        height, width = coords.shape[:2]
        rows = min(height, max(1, most_rays // width))
        first = (height - rows) // 2
        indices = torch.zeros(rows, width, 1, dtype=torch.long, device=camera.device)

        def work() -> None:
            rays = camera.generate_rays(indices, coords[first : first + rows].to(camera.device))
            pipeline.model.get_outputs_for_camera_ray_bundle(rays)

        with torch.no_grad():
            taken = seconds(work)
        pipeline.train()
        return taken, (rows, width)


def serve(pipe: Connection, config: TrainerConfig, checkout: Path | None) -> None:
    """A contestant's process: it does what it is asked, one thing after the other."""
    warnings.simplefilter("ignore")
    if checkout is not None and not Path(edge_depth_nerf.__file__).resolve().is_relative_to(checkout):
        sys.exit(f"{checkout}: expected its edge_depth_nerf to be imported, found {edge_depth_nerf.__file__}.")
    with tempfile.TemporaryDirectory() as folder:
        runner = Runner(config, Path(folder))
        pipe.send("ready")
        while (request := pipe.recv()) is not None:
            name, argument = request
            pipe.send(getattr(runner, name)(argument))


class Contestant:
    """A trainer in a process of its own, of this or another checkout, and the seconds it took in each round."""

    def __init__(self, config: TrainerConfig, checkout: Path | None = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=serve, args=(other, config, checkout), daemon=True)
        paths, self._package = list(sys.path), tempfile.TemporaryDirectory()
        if checkout is not None:
            # a spawned process imports from where its parent does; the benchmarks there are not meant
            Path(self._package.name, "edge_depth_nerf").symlink_to(checkout / "edge_depth_nerf")
            sys.path.insert(0, self._package.name)
        self._process.start()
        sys.path[:] = paths
        other.close()
        self.step_s: list[float] = []
        self.render_s: list[float] = []
        self.rendered_px = (0, 0)

    def wait(self) -> None:
        """Until it is ready."""
        self._pipe.recv()

    def ask(self, name: str, argument: Any) -> Any:
        """Let it do one thing."""
        self._pipe.send((name, argument))
        return self._pipe.recv()

    def stop(self) -> None:
        """End its process."""
        self._pipe.send(None)
        self._process.join()
        self._package.cleanup()


def configurations(
    preset: str, scene: Path, names: Sequence[str], change: Callable[[Any], None] = lambda _: None
) -> dict[str, Any]:
    """The contestants' configurations; `change` is made to what all of them get."""
    base: Any = copy.deepcopy(PRESETS[preset].config)
    base.pipeline.datamanager.dataparser.data = scene
    base.pipeline.datamanager.data = scene
    change(base)
    found = {}
    for name in names:
        if name != REFERENCE:
            found[name] = copy.deepcopy(base)
            found[name].cuda_graphs = name != EAGER
            continue
        config: Any = copy.deepcopy(method_configs["depth-nerfacto"])
        shared = {
            field.name: copy.deepcopy(getattr(base.pipeline.model, field.name))
            for field in dataclasses.fields(NerfactoModelConfig)
            if field.name not in ("_target", "implementation")
        }
        config.pipeline.model = NerfactoModelConfig(**shared, implementation="torch")
        data = config.pipeline.datamanager
        data.dataparser = NerfstudioDataParserConfig(data=scene, depth_unit_scale_factor=1 / 256)
        data._target = VanillaDataManager[InputDataset]
        data.train_num_rays_per_batch = base.pipeline.datamanager.train_num_rays_per_batch
        config.mixed_precision = base.mixed_precision
        config.max_num_iterations = base.max_num_iterations
        found[name] = config
    return found


def seconds(work: Callable[[], Any]) -> float:
    """Wall time, with what the GPU still does."""
    started = time.perf_counter()
    work()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter() - started


def race(
    configs: dict[str, Any],
    rounds: int,
    steps: int,
    view_rays: int = 0,
    beside: Path | None = None,
    firsts: Sequence[int] | None = None,
) -> dict[str, Any]:
    """Let trainers of these configurations take turns.

    On a GPU the allocator and what is compiled settle in tens of steps; on a CPU three are enough. `firsts` are the
    schedule's steps that rounds begin with; without it the steps of all rounds are spread over the schedule.

    Returns:
        Of each: rays_per_second (median), and seconds of a step and of the rows of a view in each round.
    """
    some = next(iter(configs.values()))
    rays, schedule = some.pipeline.datamanager.train_num_rays_per_batch, some.max_num_iterations
    spread = [round((number + 0.5) * schedule / (rounds * steps)) for number in range(rounds * steps)]
    if firsts is not None:
        spread = [first + number for first in firsts for number in range(steps)]
    contestants = {
        name: Contestant(config, beside.resolve() if name == BESIDE and beside else None)
        for name, config in configs.items()
    }
    for name, contestant in contestants.items():  # what the first writes into the cache the others wait for
        CONSOLE.print(f"Building {name}")
        contestant.wait()
    for contestant in contestants.values():  # kernels are compiled, memory is there
        contestant.ask("iterate", range(WARM_UPS if torch.cuda.is_available() else 3))
    order = list(contestants.values())
    for number in range(rounds):
        chosen = spread[number * steps : (number + 1) * steps]
        for contestant in order:
            contestant.step_s.append(contestant.ask("iterate", chosen) / steps)
        for contestant in order if view_rays else ():
            taken, contestant.rendered_px = contestant.ask("render", view_rays)
            contestant.render_s.append(taken)
        order.reverse()  # whose turn follows that of a larger one is slower: equal code by a tenth
        CONSOLE.print(f"Round {number + 1} of {rounds}")
    graphs = {name: contestant.ask("graphs", None) for name, contestant in contestants.items()}
    for contestant in contestants.values():
        contestant.stop()
    return {
        name: {
            "rays_per_second": rays / statistics.median(contestant.step_s),
            "step_s": contestant.step_s,
            "graphs": graphs[name],
            "rendered_px": contestant.rendered_px,
            "render_s": contestant.render_s,
        }
        for name, contestant in contestants.items()
    }


def machine() -> dict[str, Any]:
    """What a result depends on."""
    processor = platform.processor() or platform.machine()
    about = Path("/proc/cpuinfo")
    if about.is_file():
        models = [line.split(":")[1].strip() for line in about.read_text().splitlines() if "model name" in line]
        processor = models[0] if models else processor
    return {
        "processor": processor,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def sizes_of(preset: str) -> dict[str, Any]:
    """What a step's time of a preset depends on, from its configuration."""
    config: Any = PRESETS[preset].config
    data, model = config.pipeline.datamanager, config.pipeline.model
    names = ("num_levels", "log2_hashmap_size", "features_per_level", "max_res", "hidden_dim", "hidden_dim_color")
    return {
        "rays": data.train_num_rays_per_batch,
        "surface_rays": data.surface_rays_per_batch,
        **{name: getattr(model, name) for name in names},
        "samples": model.num_nerf_samples_per_ray,
        "proposal_samples": list(model.num_proposal_samples_per_ray),
        "proposal_networks": [dict(network) for network in model.proposal_net_args_list],
    }


def spread_of(values: Sequence[float], form: str) -> str:
    """Median and range; a dash where there are none."""
    if not values:
        return "–"
    return f"{statistics.median(values):{form}} ({min(values):{form}}-{max(values):{form}})"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=Path("data/sample_drive"))
    parser.add_argument("--preset", nargs="+", default=["lite"], choices=list(PRESETS))
    choices = [*ON_EVERY_MACHINE, EAGER]
    parser.add_argument("--contestants", nargs="+", default=ON_EVERY_MACHINE, choices=choices)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=10)
    parser.add_argument("--view-rays", type=int, default=1 << 16, help="at most so many are rendered; 0 for none")
    parser.add_argument("--beside", type=Path, metavar="CHECKOUT", help="compare with the code there, too")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results: dict[str, Any] = {"machine": machine()}
    names: list[str] = list(dict.fromkeys([REFERENCE, *options.contestants, *([BESIDE] if options.beside else [])]))
    for preset in options.preset:
        configs = configurations(preset, options.scene, names)
        results[preset] = race(configs, options.rounds, options.steps, options.view_rays, beside=options.beside)
        table = Table(
            "", "rays/s", "s a step", "× nerfacto", "s a view", "× nerfacto", title=f"{preset}, {options.scene}"
        )
        host = results[preset][REFERENCE]
        for name, found in results[preset].items():
            table.add_row(
                name,
                f"{found['rays_per_second']:,.0f}",
                spread_of(found["step_s"], ".3f"),
                spread_of(ratios(host["step_s"], found["step_s"]), ".2f"),
                spread_of(found["render_s"], ".2f"),
                spread_of(ratios(host["render_s"], found["render_s"]), ".2f"),
            )
        CONSOLE.print(table)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
