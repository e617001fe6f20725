"""Trains and evaluates one run: `python -m edge_depth_nerf.compare.worker FOLDER`, with a run.json in the folder.

It is a process of its own, so that a run that dies stops no other run. One process does both, because nerfstudio takes
long to start. The process can be killed at any time; it resumes from its last checkpoint.
"""

from __future__ import annotations

import random
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from numba.core.event import Event, Listener, install_listener
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import explain, read_json_object, write_json
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.compare.configuration import configuration, described, setting_of
from edge_depth_nerf.compare.evaluation import (
    COLOURS,
    MOST_TRAINED_PIXELS,
    MOST_TRAINED_VIEWS,
    ViewEvaluator,
    choose_pixels,
    evaluate_beams,
    evaluate_pixels,
    shifted_views,
)
from edge_depth_nerf.compare.protocol import departures
from edge_depth_nerf.compare.specification import FIGURES, PROGRESS, SPECIFICATION, VIEWS, RunSpecification
from edge_depth_nerf.jobs.runs import end_with_parent, steps_done
from edge_depth_nerf.jobs.tasks import WORK
from edge_depth_nerf.mono.calibration import maps_trained_on
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.plugin.scanning import HeldOutRays, evaluate_scans
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer
from edge_depth_nerf.scene.format import LAYERS, read_transforms

CURVE = (0.025, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""When the random pixels are evaluated, as shares of the training."""
STEP_IN_BATCHES = 3
"""A step of training takes about as long as rendering so many batches of its rays."""


class Clock(Listener):
    """Seconds, and those of the processor, of what is measured. Compiling with Numba, as its events tell, stops it."""

    def __init__(self, device: str) -> None:
        """Measure nothing yet; `device` is what is waited for."""
        self._on_gpu = device.startswith("cuda")
        self._since: dict[str, float] | None = None
        self._compiling: list[AbstractContextManager[None]] = []
        self.passed = {"seconds": 0.0, "cpu_seconds": 0.0}
        """Up to the last time that it was stopped."""

    def _now(self) -> dict[str, float]:
        if self._on_gpu:
            torch.cuda.synchronize()
        return {"seconds": time.monotonic(), "cpu_seconds": time.process_time()}

    def start(self) -> None:
        """Go on."""
        self._since = self._now()

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop for something that does not count."""
        since, self._since = self._since, None
        if since is not None:
            now = self._now()
            self.passed = {name: self.passed[name] + now[name] - since[name] for name in now}
        try:
            yield
        finally:
            if since is not None:
                self.start()

    def on_start(self, event: Event) -> None:
        """Stop; within another function's compilation this changes nothing."""
        self._compiling.append(self.stopped())
        self._compiling[-1].__enter__()

    def on_end(self, event: Event) -> None:
        """Go on, if that is what was stopped."""
        self._compiling.pop().__exit__(None, None, None)


class MeasuredTrainer(EdgeDepthTrainer):
    """Counts the seconds of training, and stops the clock while it evaluates the random pixels.

    Measurements are kept with the checkpoints, so that a resumed training continues them.
    """

    def __init__(self, config: Any, progress: Path, total_steps: int) -> None:
        """Train `config`; `progress` is the file that keeps what was measured."""
        super().__init__(config)
        self.progress_path, self.total_steps = progress, total_steps
        self.curve: list[dict[str, float]] = []
        self.times: dict[str, dict[str, float]] = {}
        """The clock at each checkpoint, by steps."""
        self.clock = Clock(self.device)
        self.on_step: Callable[[int], None] = lambda _: None
        self._evaluated_at = {max(1, round(share * total_steps)) for share in CURVE}

    def setup(self, test_mode: Literal["test", "val", "inference"] = "test") -> None:
        """Set up as nerfstudio does, and continue the measurements made before."""
        super().setup(test_mode)
        manager: Any = self.pipeline.datamanager
        self._pixels = choose_pixels(manager.eval_dataset)
        self._trained_on = choose_pixels(manager.train_dataset, most=MOST_TRAINED_PIXELS, most_views=MOST_TRAINED_VIEWS)
        if self._start_step:
            measured = read_json_object(self.progress_path, "times", "curve")
            try:
                self.times = {step: each for step, each in measured["times"].items() if int(step) <= self._start_step}
                self.clock.passed = dict(self.times[str(self._start_step)])
                self.curve = [point for point in measured["curve"] if point["step"] <= self._start_step]
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise InputError(
                    f"{self.progress_path}: does not match the checkpoint of step {self._start_step} ({error!r}). "
                    "Remove the run's folder; the same command then trains it again."
                ) from None
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        self.callbacks.append(TrainingCallback(after, lambda step: self._after_step(step + 1)))

    def train(self) -> None:
        """Train to the end, by the clock."""
        with install_listener("numba:compile", self.clock):
            self.clock.start()
            super().train()

    def save_checkpoint(self, step: int) -> None:
        """Save what was measured, then the model."""
        with self.clock.stopped():
            self.times[str(step + 1)] = dict(self.clock.passed)
            write_json(self.progress_path, {"times": self.times, "curve": self.curve})
            super().save_checkpoint(step)

    def tell(self, step: int, loss: torch.Tensor) -> None:
        """Print nothing: the command's bar shows the share of all work."""

    def _after_step(self, steps: int) -> None:
        if steps in self._evaluated_at:
            with self.clock.stopped():
                figures = evaluate_pixels(self.pipeline, self._pixels)
                trained_on = evaluate_pixels(self.pipeline, self._trained_on, trained_on=True)
                figures |= {f"trained_{name}": value for name, value in trained_on.items() if name in COLOURS}
                self.curve.append({"step": float(steps), **self.clock.passed, **figures})
        self.on_step(steps)


def do_run(folder: Path) -> None:
    """Train and evaluate what a folder's run.json describes and is not done yet; figures.json is written last."""
    path = folder / SPECIFICATION
    try:
        run = RunSpecification(**read_json_object(path))
    except TypeError as error:
        raise InputError(
            f"{path}: is not a run of this version ({error}). Remove its folder; the same command then trains it again."
        ) from None
    config, named = configuration(run, folder)
    resolved = described(config)
    steps = config.max_num_iterations
    random.seed(run.seed)
    np.random.seed(run.seed)  # noqa: NPY002 (nerfstudio draws from the global generator)
    torch.manual_seed(run.seed)
    if not (config.get_base_dir() / "config.yml").is_file():
        config.save_config()
    done = steps_done(config.get_checkpoint_dir())
    if done:
        config.load_dir = config.get_checkpoint_dir()
    # nerfstudio counts the steps that are still to come
    config.max_num_iterations = steps - done
    trainer = MeasuredTrainer(config, folder / PROGRESS, steps)
    trainer.setup()
    dataset: Any = trainer.pipeline.datamanager.eval_dataset
    beside = shifted_views(dataset) if run.whole_views else {}
    # a broken file of a sweep is named before the training
    scan_rays = HeldOutRays.of(dataset.scene) if run.whole_views else None
    views = len(dataset) + sum(map(len, beside.values())) if run.whole_views else 0
    views *= 2 if run.detail else 1
    # nerfstudio prints each step; the bar wants the share of all the work
    rays_of_a_view = int((dataset.cameras.width * dataset.cameras.height).float().mean())
    batches_of_a_view = rays_of_a_view / trainer.pipeline.datamanager.get_train_rays_per_batch()
    whole = STEP_IN_BATCHES * steps + batches_of_a_view * views
    views_done = 0

    def tell(steps_behind: int) -> None:
        share = (STEP_IN_BATCHES * steps_behind + batches_of_a_view * views_done) / whole
        print(f"\n{WORK}{share:.4f}", flush=True)  # noqa: T201

    def on_step(steps_behind: int) -> None:
        if steps_behind % max(1, steps // 200) == 0:
            tell(steps_behind)

    def on_view() -> None:
        nonlocal views_done
        views_done += 1
        tell(steps)

    trainer.on_step = on_step
    if done < steps:
        trainer.train()

    last = trainer.curve[-1]
    figures = {name: last[name] for name in trainer.clock.passed}
    figures |= {f"pixels_{name}": value for name, value in last.items() if name != "step" and name not in figures}
    bins: dict[str, Any] = {}
    if run.whole_views:
        evaluator = ViewEvaluator(trainer.pipeline, on_view)
        found, bins = evaluator.held_out(folder / VIEWS)
        figures |= found | evaluator.shifted(beside) | evaluate_beams(trainer.pipeline)
        if scan_rays is not None:
            with evaluated(trainer.pipeline.model):
                of_scans, parts = evaluate_scans(trainer.pipeline, scan_rays)
            figures, bins = figures | of_scans, bins | parts
        if run.detail:
            figures |= evaluator.with_detail(folder / VIEWS, beside)
    weight, sigma = setting_of(config, run.method)
    meta, layer = read_transforms(Path(run.scene) / "transforms.json"), LAYERS["mono"].key
    write_json(
        folder / FIGURES,
        {
            "run": asdict(run),
            "named": sorted(named),
            "configuration": resolved,
            "lambda": weight,
            "sigma": sigma,
            "steps": steps,
            "device": config.machine.device_type,
            "source": source.get("kind") if isinstance(source := meta.get("source"), dict) else None,
            "mono_trained_on": maps_trained_on(meta) if any(layer in frame for frame in meta["frames"]) else None,
            "departures": departures(meta) if run.preset == "paper" else [],
            "figures": figures,
            "curve": trainer.curve,
            **bins,
        },
    )


def main() -> None:
    """Entry point: errors of input are one paragraph and exit status 2."""
    end_with_parent()
    try:
        folder = Path(sys.argv[1])
        # one whose worker was lost may take a moment to end
        with only_writer(folder, Console()):
            do_run(folder)
    except (InputError, OSError) as error:
        print(f"edge-depth-nerf: {explain(error)}", flush=True)  # noqa: T201
        sys.exit(2)


if __name__ == "__main__":
    main()
