"""`edge-depth-nerf demo`: the whole way once, from a raw drive to compared figures and pictures.

Each stage is the command a user would give (`edge-depth-nerf …`, `ns-train`, `ns-eval`), and what it leaves under
the output folder is not done again. The two models differ in the depth loss alone.
"""

from __future__ import annotations

import os
import platform
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
import torch
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, read_json, read_json_object, write_json, write_png
from edge_depth_nerf.base.pictures import DISTANCE, distance_of_colours, side_by_side, with_colour_bar
from edge_depth_nerf.compare.figures import BinnedErrors
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.plots import PSNR_LABEL, Bins, plot_bins
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.jobs.runs import (
    LoggedCommands,
    command_line,
    files_counted,
    host_program,
    logged_commands,
    step_of_line,
    steps_done,
    viewer_command,
)
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.report.build import Commands, Facts, Plot, Report, write_report
from edge_depth_nerf.report.compared_views import compared_views, held_out_frames
from edge_depth_nerf.report.tables import Cell, MadeTable, Metric, Row, mark_best
from edge_depth_nerf.report.views import REPORT, make_drives
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

METHOD = "edge-depth-nerf-lite"
RUNS = {"nerfacto": "none", "ours": "edge"}
"""Name of the run: its depth loss. nerfacto is our model without one, so near plane, scale, sampler, mask and
initial density are the same."""
METHODS: dict[str, MethodName] = {"nerfacto": "nerfacto", "ours": "edge"}
"""What `compare` calls them; plots draw them alike."""
COLUMNS = (
    Metric("masked_psnr", "masked PSNR ↑", ".2f"),
    Metric("masked_ssim", "masked SSIM ↑", ".3f"),
    Metric("truth_masked_psnr", "PSNR to clean ↑", ".2f"),
    Metric("lidar_abs_rel", "AbsRel LiDAR ↓", ".3f", -1),
    Metric("truth_abs_rel", "AbsRel truth ↓", ".3f", -1),
    Metric("truth_delta_1_25", "δ<1.25 truth ↑", ".3f"),
)
CAPTION = (
    "PSNR (dB) and SSIM inside the mask; clean: the picture without noise and exposure drift; "
    "AbsRel and δ of the rendered median distance, 1-60 m."
)
VIEWS = 3
PICTURE = "comparison.png"
SHOWN_EDGES_M = (2.0, 4.0, 7.0, 12.0, 20.0, 35.0, 48.0)
"""Bins of the true distance. Rendered ones are read from the saved pictures' colours, which end at 60 m: up to 48 m,
whatever is farther is wrong by more than a quarter anyway."""


def run_demo(options: DemoOptions, console: Console | None = None) -> dict[str, Any]:
    """Run or finish the demo.

    Returns:
        What results.json holds: options, versions, figures of each run, seconds of each stage, commands.

    Raises:
        InputError: the output folder holds a demo of other options, or a stage failed (its log is named).

    """
    console = console or Console()
    output = options.output
    check_is_folder(output)
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
    viewer_commands = [run.viewer_command for run in runs]

    write_png(output / PICTURE, _comparison(scene, output / "runs"))
    results = {
        "options": recorded,
        "versions": {name: version(name) for name in ("edge-depth-nerf", "nerfstudio", "torch", "numpy")}
        | {"python": platform.python_version()},
        "cores": os.cpu_count(),
        "figures": figures,
        "seconds": clock.seconds,
        "commands": [
            command_line(["edge-depth-nerf", "demo"], options),
            command_line(["edge-depth-nerf", "synthesize"], synthesis),
            command_line(["edge-depth-nerf", "process", "kitti360"], processing),
            *(line for run in runs for log in run.logs for line in logged_commands(log)),
        ],
        "viewer_commands": viewer_commands,
    }
    write_report(output / REPORT, _report(results, output, console))
    write_json(finished, results)
    _show(results, output, console)
    return results


def _table(results: dict[str, Any]) -> MadeTable:
    rows = [
        Row(name, [Cell(figure.get(metric.name), form=metric.form) for metric in COLUMNS])
        for name, figure in results["figures"].items()
    ]
    mark_best(rows, [metric.best for metric in COLUMNS])
    notes = [CAPTION]
    if "masked_lpips" not in results["figures"]["ours"]:
        notes.append("LPIPS is left out: its weights are not on this machine (nothing is downloaded).")
    return MadeTable("", "Held-out views", [("", [metric.heading for metric in COLUMNS])], rows, notes)


def _setting(results: dict[str, Any]) -> str:
    return "{scene}, {frames} moments, {size} px, {steps} steps each".format(**results["options"])


def _show(results: dict[str, Any], output: Path, console: Console) -> None:
    made = _table(results)
    table = Table("held-out views", title=_setting(results), caption=made.notes[0])
    for _, heading in made.headings():
        table.add_column(heading, justify="right")
    for row in made.rows:
        table.add_row(row.title, *(cell.text() for cell in row.cells))
    console.print(table)
    for note in made.notes[1:]:
        console.print(note)
    console.print(
        f"To look at, in a browser: {output / REPORT}\nPicture: {output / PICTURE}\n"
        f"Figures: {output / 'results.json'}\nTo look around in what was trained:"
    )
    for command in results["viewer_commands"]:
        console.print(f"  {command}", soft_wrap=True)


def _report(results: dict[str, Any], output: Path, console: Console) -> Report:
    """What the page shows."""
    scene, options = output / "scene", results["options"]
    views_of = {name: output / "runs" / name / "views" for name in RUNS}
    return Report(
        title=f"Demo: nerfacto and ours on a rendered {options['scene']}",
        lead="The same model trained twice on one drive, without depth and with the edge loss on LiDAR and monocular "
        f"depth integrated: {_setting(results)}.",
        methods=list(RUNS),
        drives=make_drives({options["scene"]: (scene, views_of)}, console),
        tables=[_table(results)],
        plots=_plots(scene, views_of, options["scene"], console),
        facts=[
            Facts("Options", {name.replace("_", " ").capitalize(): str(value) for name, value in options.items()}),
            Facts("Versions", results["versions"]),
            Facts(
                "Seconds of each stage",
                {name.capitalize(): str(seconds) for name, seconds in results["seconds"].items()}
                | {"Cores of the machine": str(results["cores"])},
            ),
        ],
        commands=[
            Commands("What made this: the first alone, or the others one after another", results["commands"]),
            Commands("To look around in what was trained", results["viewer_commands"]),
        ],
    )


def _plots(scene: Path, views_of: dict[str, Path], title: str, console: Console) -> list[Plot]:
    """Figures by the true distance, over all held-out views."""
    binned = {name: BinnedErrors(SHOWN_EDGES_M) for name in RUNS}
    with console.status("Errors by distance …"):
        for view in compared_views(scene, views_of):
            target = view.rgb if view.clean_rgb is None else view.clean_rgb
            mask, true_m = torch.from_numpy(view.mask), torch.from_numpy(view.distance_m)
            for name, bins in binned.items():
                pred, clean = (torch.from_numpy(rgb).float() / 255 for rgb in (view.colours[name], target))
                seen_m = torch.from_numpy(distance_of_colours(view.distances[name]))
                bins.update(true_m, mask, pred, clean, seen_m, true_m)
    found: dict[MethodName, list[Bins]] = {METHODS[name]: [bins.compute()] for name, bins in binned.items()}
    titles = {"psnr": ("PSNR by true distance", PSNR_LABEL), "delta_1_25": ("δ<1.25 by true distance", "δ<1.25")}
    return [
        plot_bins(words, {title: found}, "distance, m", [(name, label)], logarithmic_x=True)
        for name, (words, label) in titles.items()
    ]


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
        self.logs = [runs / name / f"{stage}.log" for stage in ("train", "evaluate")]
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
        if self._judged():
            return
        views = self.runs / self.name / "views"
        arguments = [
            *("ns-eval", "--load-config", self.config, "--output-path", self.metrics),
            *("--render-output-path", views),
        ]
        count = len(held_out_frames(self.scene))
        self._call("evaluate", arguments, progress, f"Judging {self.name}", count, views)

    def _judged(self) -> bool:
        """Whether the figures are there as a whole: a killed ns-eval may have written half of them."""
        try:
            read_json_object(self.metrics, "results")
        except (InputError, OSError):
            return False
        return True

    def figures(self) -> dict[str, float]:
        return read_json(self.metrics)["results"]

    def _call(
        self, stage: str, arguments: list[Any], progress: Progress, title: str, total: int, views: Path | None = None
    ) -> None:
        program, *rest = (str(argument) for argument in arguments)
        task = progress.add_task(title, total=total)

        def on_line(line: str) -> None:
            step = step_of_line(line)
            if step is not None:
                progress.update(task, completed=step)

        # ns-eval says nothing on its way, but writes a picture of each view
        with files_counted(views, "eval_img_*.png", lambda done: progress.update(task, completed=done)):
            self._commands.call(
                [host_program(program), *rest],
                self.runs / self.name / f"{stage}.log",
                max(1, (os.cpu_count() or 1) // len(RUNS)),
                on_line,
            )
        progress.update(task, completed=total)


def _comparison(scene: Path, runs: Path) -> np.ndarray:
    """Truth, nerfacto and ours, colours and distance, for some held-out views."""
    views = compared_views(scene, {name: runs / name / "views" for name in RUNS}, VIEWS)
    names = ["truth", *RUNS]
    rows = [[*colours, *distances] for colours, distances in (view.rows() for view in views)]
    return with_colour_bar(side_by_side(rows, [*names, *(f"{name}: distance" for name in names)]), DISTANCE)
