"""What a training step on the CPU consists of, on one thread and on all.

    python -m benchmarks.speed.step_parts SCENE [--rounds 5] [--page docs/speed.md]

Trains `edge-depth-nerf-lite` with its defaults for a few steps, spread over the whole schedule, in a process for each
number of threads. First whole steps are timed; then each part, without those that it contains. Run it on an idle
machine.
Writes benchmarks/speed/step_parts.json and, with `--page`, the table.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from benchmarks.pages import with_part
from benchmarks.speed import run, turns
from edge_depth_nerf.base.files import read_json_object, write_json, write_text
from edge_depth_nerf.kernels import contraction_numba, hash_grid_numba, network_numba, rendering_numba
from edge_depth_nerf.plugin import step_losses
from edge_depth_nerf.plugin.fused import fields, ray_samplers

RESULTS = Path(__file__).with_name("step_parts.json")
PART = "speed: step"
STEPS = 40
"""Timed in a round."""
PARTS = {
    "networks": "networks, forward and backward",
    "hash grid": "hash grid",
    "optimisers": "gradient of its table, and Adam",
    "batch": "pixels of the batch, their rays",
    "samples": "samples: places, positions, weights; rendering",
    "losses": "losses",
    "rest": "all else: autograd, nerfstudio",
}
"""What the table calls the parts."""


class Clock:
    """Seconds of parts in the thread that trains, each without those that it contains."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self._inner: list[float] = []

    def measure(self, holder: Any, name: str, part: str) -> None:
        """Let calls of a function count as a part."""
        function: Callable[..., Any] = getattr(holder, name)

        def measured(*args: Any, **kwargs: Any) -> Any:
            if threading.current_thread().name.startswith("kernels"):
                return function(*args, **kwargs)
            start = time.perf_counter()
            self._inner.append(0.0)
            try:
                return function(*args, **kwargs)
            finally:
                took = time.perf_counter() - start
                self.seconds[part] += took - self._inner.pop()
                if self._inner:
                    self._inner[-1] += took

        setattr(holder, name, measured)

    def measure_step(self, trainer: Any) -> None:
        """Measure the parts of a trainer's steps."""
        pipeline = trainer.pipeline
        model: Any = pipeline.model
        sampler = model.proposal_sampler
        for holder, names, part in (
            (network_numba, ("apply_to_points", "_backward"), "networks"),
            # and waiting for other threads
            (rendering_numba, ("in_parts",), "networks"),
            (hash_grid_numba, ("encode",), "hash grid"),
            (trainer.optimizers, ("optimizer_scaler_step_some", "zero_grad_some"), "optimisers"),
            (pipeline.datamanager, ("next_train",), "batch"),
            (sampler, ("generate_ray_samples",), "samples"),
            (contraction_numba, ("contract",), "samples"),
            (fields, ("_densities",), "samples"),
            (ray_samplers.FusedFrustums, ("get_positions",), "samples"),
            (ray_samplers.FusedRaySamples, ("get_weights",), "samples"),
            (rendering_numba, ("render", "_render", "_all_gradients"), "samples"),
            (model, ("get_loss_dict", "get_metrics_dict"), "losses"),
            (step_losses, ("interlevel_loss", "distortion_loss", "depth_loss", "sky_loss"), "losses"),
            (trainer, ("train_iteration",), "rest"),
        ):
            for name in names:
                self.measure(holder, name, part)


def measured(scene: Path, threads: int, rounds: int) -> dict[str, Any]:
    """Milliseconds of a step and of its parts on so many threads."""
    torch.set_num_threads(threads)
    config = turns.configurations("lite", scene, ["ours"])["ours"]
    spread = [int((k + 0.5) * config.max_num_iterations / STEPS) for k in range(STEPS)]
    with tempfile.TemporaryDirectory() as folder:
        runner = turns.Runner(config, Path(folder))
        runner.iterate(spread)
        whole = [runner.iterate(spread) * 1e3 / STEPS for _ in range(rounds)]
        clock = Clock()
        clock.measure_step(runner.trainer)
        for _ in range(rounds):
            runner.iterate(spread)
    parts = {name: seconds * 1e3 / STEPS / rounds for name, seconds in clock.seconds.items()}
    return {"ms": statistics.median(whole), "range": [min(whole), max(whole)], "parts": parts}


def table(results: dict[str, Any]) -> str:
    """Milliseconds of the parts, as Markdown."""
    by_threads: dict[str, Any] = results["threads"]
    words = [f"{number} thread{'s' if number != '1' else ''}, ms" for number in by_threads]
    lines = ["| | " + " | ".join(words) + " |", "|---|" + "---:|" * len(words)]
    for name, title in PARTS.items():
        lines.append(f"| {title} | " + " | ".join(f"{each['parts'][name]:.1f}" for each in by_threads.values()) + " |")
    lines.append("| **whole step** | " + " | ".join(f"**{each['ms']:.1f}**" for each in by_threads.values()) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    threads = sorted({1, len(os.sched_getaffinity(0))})
    results: dict[str, Any] = {"commit": run.commit(), "machine": turns.machine(), "scene": options.scene.name}
    # one process after the other: a number of threads is for a whole process
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        found = pool.starmap(measured, [(options.scene, number, options.rounds) for number in threads], chunksize=1)
    results["threads"] = {str(number): each for number, each in zip(threads, found, strict=True)}
    write_json(RESULTS, results)
    print(table(results))
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        write_text(options.page, with_part(text, PART, table(read_json_object(RESULTS))))


if __name__ == "__main__":
    main()
