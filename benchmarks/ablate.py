"""What an option does to a short training: held-out PSNR and depth errors of variants, one after the other.

    python benchmarks/ablate.py SCENE --steps 400 \
        "pipeline.model.depth_loss=none" "pipeline.model.depth_loss_mult=0.001" "pipeline.model.depth_loss_mult=0.01"

Each variant is one or more overrides of edge-depth-nerf-lite, joined by commas ("" for none). Every variant starts from
the same seeds and is judged on the same 3,000 random pixels inside the mask of every held-out view, which is much
faster than whole views and within some hundredths of a dB of them. With several `--seeds`, what a variant differs by
from the first one is given as mean and range over pairs of the same seed. `--json FILE` keeps each training's figures,
and takes up from there. Use a drive of its own for choosing options: not the one that a table is made of.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pages
import run
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from rich.console import Console
from rich.table import Table
from torch import Tensor

from edge_depth_nerf.base.files import read_json, write_json, write_text
from edge_depth_nerf.compare.judging import PIXELS_PER_VIEW, choose_pixels, judge_pixels
from edge_depth_nerf.plugin.config import apply_overrides


def parse(variant: str) -> dict[str, Any]:
    overrides = {}
    for part in filter(None, variant.split(",")):
        name, _, value = part.partition("=")
        try:
            overrides[name] = json.loads(value)
        except json.JSONDecodeError:
            overrides[name] = value
    return overrides


def train(
    scene: Path,
    overrides: dict[str, Any],
    steps: int,
    seed: int,
    change: Callable[[Any], None] | None = None,
) -> dict[str, float]:
    config = deepcopy(all_methods["edge-depth-nerf-lite"])
    apply_overrides(config, overrides, "command line")
    config.pipeline.datamanager.data = scene
    torch.manual_seed(seed)
    pipeline: Any = config.pipeline.setup(device="cpu", test_mode="val")
    if change is not None:
        change(pipeline)
    optimisers = Optimizers(deepcopy(config.optimizers), pipeline.get_param_groups())
    attributes = TrainingCallbackAttributes(optimizers=optimisers, grad_scaler=None, pipeline=pipeline, trainer=None)
    callbacks = pipeline.get_training_callbacks(attributes)
    dataset = pipeline.datamanager.eval_dataset
    pixels = choose_pixels(dataset, most=PIXELS_PER_VIEW * len(dataset))

    pipeline.train()
    started = time.monotonic()
    for step in range(steps):
        for callback in callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        optimisers.zero_grad_all()
        _, losses, _ = pipeline.get_train_loss_dict(step)
        torch.stack(list(losses.values())).sum().backward()
        optimisers.optimizer_step_all()
        optimisers.scheduler_step_all(step)
        for callback in callbacks:
            callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    seconds = (time.monotonic() - started) / steps
    return {"seconds a step": seconds, **judge_pixels(pipeline, pixels)}


def against_truth(figures: dict[str, float]) -> dict[str, float]:
    """PSNR and AbsRel of a training against the truth; against pictures and LiDAR where it is not known."""
    if "truth_psnr" in figures:
        return {"psnr": figures["truth_psnr"], "abs_rel": figures["truth_abs_rel"]}
    return {"psnr": figures["psnr"], "abs_rel": figures["lidar_abs_rel"]}


def begun(path: Path, steps: int) -> dict[str, Any]:
    """Figures of scenes that a file keeps of this commit and of as many steps; else none."""
    results: dict[str, Any] = read_json(path) if path.is_file() else {}
    if results.get("commit") == run.commit() and results.get("steps") == steps:
        return results
    return {"commit": run.commit(), "steps": steps, "scenes": {}}


def scene_by_scene(
    description: str | None,
    kept: Path,
    part: str,
    table: Callable[[dict[str, Any]], str],
    measure: Callable[[Path, dict[str, Any], Callable[[], None]], None],
) -> None:
    """Run a benchmark that measures scene after scene: its options, the file that keeps its figures, table and page.

    Args:
        description: of the command.
        kept: the file, unless `--json` names another one.
        part: of the page.
        table: of the figures, as Markdown.
        measure: adds to the figures what they lack of a scene, and calls its last argument to keep them.

    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--json", type=Path, default=kept)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    results = begun(options.json, options.steps)
    for scene in options.scenes:
        measure(scene, results, partial(write_json, options.json, results))
    Console(width=200).print(table(results), markup=False)
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        write_text(options.page, pages.with_part(text, part, table(results)))


def of_trained(
    look: Callable[[Any], dict[str, Any] | Iterable[tuple[str, Any]]],
    scene: Path,
    results: dict[str, Any],
    keep: Callable[[], None],
) -> None:
    """Add what `look` finds with a trained pipeline of ours to the figures of a scene, if it has none."""
    steps, found, kept = results["steps"], of_scene(results, scene), []
    if not found:
        train(scene, falling_over(steps), steps, 0, kept.append)
        found.update(look(kept[0]))
        keep()


def blocks_of(cameras: Cameras, side_px: int) -> tuple[int, int, int]:
    """How many square blocks there are of all pictures: pictures, rows, columns."""
    rows, columns = (int(each.max()) // side_px + 1 for each in (cameras.height, cameras.width))
    return len(cameras), rows, columns


def block_of(indices: Tensor, side_px: int) -> tuple[Tensor, Tensor, Tensor]:
    """In which block pixels lie, by picture, row and column, [n, 3]."""
    return indices[:, 0], indices[:, 1] // side_px, indices[:, 2] // side_px


def table_of_scenes(corner: str, scenes: Iterable[str], rows: dict[str, list[str]]) -> str:
    """A column for each scene, as Markdown.

    Args:
        corner: what stands in the cells.
        scenes: their names.
        rows: the cells of each.

    """
    head = [corner, *scenes]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    return "\n".join([*lines, *(f"| {name} | {' | '.join(cells)} |" for name, cells in rows.items())])


def of_scene(results: dict[str, Any], scene: Path) -> dict[str, Any]:
    """The figures of a scene, to add to."""
    return results["scenes"].setdefault(scene.resolve().name, {})


def falling_over(steps: int) -> dict[str, int]:
    """Overrides by which the learning rates fall over so many steps."""
    return {f"optimizers.{name}.scheduler.max_steps": steps for name in ("fields", "proposal_networks")}


def key_of(options: argparse.Namespace, variant: str, seed: int) -> str:
    return f"{options.scene.resolve().name}, {options.steps} steps, seed {seed}: {variant or '(defaults)'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    done: dict[str, dict[str, float]] = {}
    if options.json and options.json.is_file():
        done = read_json(options.json)
    console = Console(width=200)
    for seed in options.seeds:
        for variant in options.variants:
            key = key_of(options, variant, seed)
            if key not in done:
                done[key] = train(options.scene, parse(variant), options.steps, seed)
                if options.json:
                    write_json(options.json, done)
            console.print(key, {name: round(value, 4) for name, value in done[key].items()})
    by_variant = [[done[key_of(options, variant, seed)] for seed in options.seeds] for variant in options.variants]
    names = list(by_variant[0][0])
    seeds = ", ".join(map(str, options.seeds))
    table = Table("variant", *names, title=f"{options.scene.name}, {options.steps} steps, seeds {seeds}")
    for variant, found in zip(options.variants, by_variant, strict=True):
        table.add_row(variant or "(defaults)", *(f"{np.mean([each[name] for each in found]):.4g}" for name in names))
        if len(options.seeds) > 1 and found is not by_variant[0]:
            pairs = list(zip(found, by_variant[0], strict=True))
            differences = [[each[name] - first[name] for each, first in pairs] for name in names]
            table.add_row(
                "  less the first",
                *(f"{np.mean(each):+.3g} ({min(each):+.3g} to {max(each):+.3g})" for each in differences),
            )
    console.print(table)


if __name__ == "__main__":
    main()
