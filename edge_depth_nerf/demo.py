"""`edge-depth-nerf demo`: the whole way once, from a raw drive to compared figures and pictures.

Each stage is the command a user would give (`edge-depth-nerf …`, `ns-train`, `ns-eval`), and what it leaves under
the output folder is not done again. The two models differ in the depth loss alone.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from edge_depth_nerf.demo_options import DemoOptions
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_json, write_json, write_png
from edge_depth_nerf.pictures import side_by_side
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.runs import LoggedCommands, compared_views, progress_bars, step_of_line, steps_done, viewer_command
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

METHOD = "edge-depth-nerf-lite"
RUNS = {"nerfacto": "none", "ours": "edge"}
"""Name of the run: its depth loss. nerfacto is our model without one, so near plane, scale, sampler, mask and
initial density are the same."""
TABLE_COLUMNS = {
    "masked_psnr": ("masked PSNR ↑", ".2f"),
    "masked_ssim": ("masked SSIM ↑", ".3f"),
    "truth_masked_psnr": ("PSNR to clean ↑", ".2f"),
    "lidar_abs_rel": ("AbsRel LiDAR ↓", ".3f"),
    "truth_abs_rel": ("AbsRel truth ↓", ".3f"),
    "truth_delta_1_25": ("δ<1.25 truth ↑", ".3f"),
}
CAPTION = (
    "PSNR (dB) and SSIM inside the mask; clean: the picture without noise and exposure drift; "
    "AbsRel and δ of the rendered median distance, 1-60 m"
)
VIEWS = 3
PICTURE = "comparison.png"


def run_demo(options: DemoOptions, console: Console | None = None) -> dict[str, Any]:
    """Run or finish the demo.

    Returns:
        What results.json holds: options, versions, figures of each run, seconds of each stage, commands.

    Raises:
        InputError: the output folder holds a demo of other options, or a stage failed (its log is named).

    """
    console = console or Console()
    output = options.output
    recorded = {key: value for key, value in asdict(options).items() if key != "output"}
    record = output / "demo.json"
    if record.is_file() and read_json(record) != recorded:
        raise InputError(
            f"{record}: this folder holds a demo of other options ({read_json(record)}). "
            "Choose another --output, or remove the folder."
        )
    finished = output / "results.json"
    if record.is_file() and finished.is_file():
        results = read_json(finished)
        _show(results, output, console)
        return results
    write_json(record, recorded)
    clock = _Clock(output / "seconds.json")

    drive = output / "drive"
    synthesis = SynthesizeOptions(
        output=drive, scene=options.scene, frames=options.frames, size=options.size, seed=options.seed
    )
    scene = output / "scene"
    processing = Kitti360Options(
        root=drive,
        sequence=synthesis.sequence,
        output=scene,
        mono_seconds=options.mono_seconds,
    )
    with clock.stage("synthesize"):
        synthesize_drive(synthesis)
    with clock.stage("process"):
        process(processing)

    runs = [_Run(name, scene, output / "runs", options) for name in RUNS]
    # side by side, each on its share of the cores: two threads do not make one training twice as fast
    with progress_bars(console) as progress, ThreadPoolExecutor(len(runs)) as pool:
        for stage in (_Run.train, _Run.evaluate):
            with clock.stage(stage.__name__):
                try:
                    list(pool.map(partial(stage, progress=progress), runs))
                except BaseException:
                    for run in runs:
                        run.stop()
                    raise
    figures = {run.name: run.figures() for run in runs}
    commands = [run.viewer_command for run in runs]

    write_png(output / PICTURE, _comparison(scene, output / "runs"))
    results = {
        "options": recorded,
        "versions": {name: version(name) for name in ("edge-depth-nerf", "nerfstudio", "torch", "numpy")}
        | {"python": platform.python_version()},
        "cores": os.cpu_count(),
        "figures": figures,
        "seconds": clock.seconds,
        "viewer_commands": commands,
    }
    write_json(finished, results)
    _show(results, output, console)
    return results


def _show(results: dict[str, Any], output: Path, console: Console) -> None:
    options, figures = results["options"], results["figures"]
    title = "{scene}, {frames} moments, {size} px, {steps} steps each".format(**options)
    table = Table(
        "held-out views",
        title=title,
        caption=CAPTION,
    )
    for heading, _ in TABLE_COLUMNS.values():
        table.add_column(heading, justify="right")
    for name, figure in figures.items():
        cells = [format(figure[key], form) if key in figure else "–" for key, (_, form) in TABLE_COLUMNS.items()]
        table.add_row(name, *cells)
    console.print(table)
    if "masked_lpips" not in figures["ours"]:
        console.print("LPIPS is left out: its weights are not on this machine (nothing is downloaded).")
    console.print(
        f"Picture: {output / PICTURE}\nFigures: {output / 'results.json'}\nTo look around in what was trained:"
    )
    for command in results["viewer_commands"]:
        console.print(f"  {command}", soft_wrap=True)


class _Clock:
    """Seconds of each stage, kept in a file, so that those of an interrupted call count, too."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seconds: dict[str, float] = read_json(path) if path.is_file() else {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        started = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] = round(self.seconds.get(name, 0.0) + time.monotonic() - started, 1)
            write_json(self.path, self.seconds)


class _Run:
    """One training with its evaluation: nerfstudio's own commands, their output in log files."""

    def __init__(self, name: str, scene: Path, runs: Path, options: DemoOptions) -> None:
        self.name, self.options, self.runs = name, options, runs
        self.scene = scene
        self.folder = runs / name / METHOD / "run"
        self.checkpoints = self.folder / "nerfstudio_models"
        self.config = self.folder / "config.yml"
        self.metrics = runs / name / "metrics.json"
        self.viewer_command = viewer_command(self.config)
        self._commands = LoggedCommands()
        self.stop = self._commands.stop

    def train(self, progress: Progress) -> None:
        done = steps_done(self.checkpoints)
        remaining = self.options.steps - done
        if remaining <= 0:
            return
        arguments = [
            *("ns-train", METHOD, "--data", self.scene, "--output-dir", self.runs),
            *("--experiment-name", self.name, "--timestamp", "run", "--vis", "tensorboard"),
            *("--max-num-iterations", remaining, "--machine.seed", self.options.seed),
            *("--logging.local-writer.max-log-size", 0, "--pipeline.model.depth-loss", RUNS[self.name]),
            *(["--load-dir", self.checkpoints] if done else []),
        ]
        self._call("train", arguments, progress, f"Training {self.name}", total=self.options.steps)

    def evaluate(self, progress: Progress) -> None:
        if self.metrics.is_file():
            return
        unfinished = self.metrics.with_name("unfinished.json")
        arguments = [
            *("ns-eval", "--load-config", self.config, "--output-path", unfinished),
            *("--render-output-path", self.runs / self.name / "views"),
        ]
        self._call("evaluate", arguments, progress, f"Judging {self.name}", total=None)
        unfinished.rename(self.metrics)

    def figures(self) -> dict[str, float]:
        return read_json(self.metrics)["results"]

    def _call(self, stage: str, arguments: list[Any], progress: Progress, title: str, total: int | None) -> None:
        program, *rest = (str(argument) for argument in arguments)
        task = progress.add_task(title, total=total)

        def on_line(line: str) -> None:
            step = step_of_line(line)
            if step is not None and total:
                progress.update(task, completed=step)

        self._commands.call(
            [Path(sys.executable).with_name(program), *rest],
            self.runs / self.name / f"{stage}.log",
            max(1, (os.cpu_count() or 1) // len(RUNS)),
            on_line,
        )
        progress.update(task, total=total or 1, completed=total or 1)


def _comparison(scene: Path, runs: Path) -> np.ndarray:
    """Truth, nerfacto and ours, colours and distance, for some held-out views."""
    views = compared_views(scene, {name: runs / name / "views" for name in RUNS}, VIEWS)
    names = ["truth", *RUNS]
    rows = [[*colours, *distances] for colours, distances in views]
    return side_by_side(rows, [*names, *(f"{name}: distance" for name in names)])
