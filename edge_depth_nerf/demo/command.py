"""`edge-depth-nerf demo`: the whole way once, from a raw drive to compared figures and pictures.

Each stage is a command that a user would give, `synthesize` (unless the drive is a recording), `process` and `compare`,
and what it leaves under the output folder is not done again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from edge_depth_nerf.base.console import say, told
from edge_depth_nerf.base.errors import InputError, require
from edge_depth_nerf.base.files import check_is_folder, read_json, write_bytes, write_json
from edge_depth_nerf.compare.command import RUNS, finished_runs, picture_name, read_comparison, write_comparison
from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.compare.specification import FIGURES
from edge_depth_nerf.compare.tables import make_tables
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.demo.recording import options_of
from edge_depth_nerf.jobs.runs import command_line, viewer_command
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.converters import name_of
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions
from edge_depth_nerf.report.build import Commands, Facts, Report, write_report
from edge_depth_nerf.report.tables import show_tables
from edge_depth_nerf.report.views import REPORT
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

COMPARED: tuple[MethodName, ...] = ("nerfacto", "edge")
"""They differ in the depth loss and in what comes with it, the source of depth; nerfacto uses none."""
RECORD, RESULTS, SECONDS, PICTURE = "demo.json", "results.json", "seconds.json", "comparison.png"
RENDERED_FRAMES, RECORDED_FRAMES = 40, 30
"""Frames of a drive where none are asked for."""
WHAT_TO_LOOK_AT = (
    "The first picture is one that no model was trained on: drag the slider between nerfacto's distances (left) and "
    "ours (right).",
    "Then choose Distance error: too near is blue, too far is red.",
    "In the tables below, the best figure of each column is bold.",
)


@dataclass(frozen=True)
class Stages:
    """The options of each stage."""

    synthesis: SynthesizeOptions | None
    """None: the drive is a recording."""
    processing: ProcessOptions
    comparison: CompareOptions

    def commands(self) -> list[str]:
        """The commands that do the same, one after another."""
        synthesis = [] if self.synthesis is None else [command_line(["edge-depth-nerf", "synthesize"], self.synthesis)]
        return [
            *synthesis,
            command_line(["edge-depth-nerf", "process", name_of(self.processing)], self.processing),
            command_line(["edge-depth-nerf", "compare"], self.comparison),
        ]


def stages_of(options: DemoOptions) -> Stages:
    """Settle what each stage of a demo does; a recording is checked.

    Raises:
        FileNotFoundError: the recording, or a file of it, is missing.
        InputError: an option or the recording cannot be used.
    """
    drive, scene, frames = options.folder / "drive", options.folder / "scenes" / options.scene_name, options.frames
    if options.real is None:
        frames = RENDERED_FRAMES if frames is None else frames
        synthesis = SynthesizeOptions(output=drive, scene=options.scene, frames=frames, size=options.size)
        processing = Kitti360Options(root=drive, sequence=synthesis.sequence, output=scene)
    else:
        unused = [name for name in ("scene", "size") if getattr(options, name) != getattr(DemoOptions, name)]
        if unused:
            raise InputError(f"--{unused[0]} is of rendered drives: leave it out with --real.")
        require(frames is None or frames > 0, f"--frames {frames}", "1 or more")
        synthesis = None
        processing = options_of(options.real, scene, RECORDED_FRAMES if frames is None else frames)
    return Stages(
        synthesis,
        processing,
        CompareOptions(
            scenes=(scene,),
            output=options.folder / "comparison",
            methods=COMPARED,
            steps=options.steps,
            # side by side, each on its share of the cores: two threads do not make one training twice as fast
            jobs=1 if torch.cuda.is_available() else len(COMPARED),
        ),
    )


def run_demo(options: DemoOptions, console: Console | None = None) -> dict[str, Any]:
    """Run or finish the demo.

    Returns:
        What results.json holds: options, versions, figures of each run, seconds of each stage, commands.

    Raises:
        InputError: the output folder holds a demo of other options, or a training failed (its log is named).
    """
    console = console or Console()
    output = options.folder
    check_is_folder(output)
    # before the first stage takes its minute
    stages = stages_of(options)
    for stage in (stages.synthesis, stages.processing, stages.comparison):
        if stage is not None:
            stage.check()
    unused = {"output", "real"} if options.real is None else {"output", "scene", "size"}
    given = {**asdict(options), "real": options.real and str(options.real.resolve())}
    recorded = {name: value for name, value in given.items() if name not in unused and value is not None}
    record = output / RECORD
    if record.is_file() and read_json(record) != recorded:
        raise InputError(
            f"{record}: this folder contains a demo with other options ({read_json(record)}). "
            "Choose another --output, or remove the folder."
        )
    finished, compared = output / RESULTS, stages.comparison.output
    shown = (finished, output / REPORT, output / PICTURE)
    is_finished = record.is_file() and all(map(Path.is_file, shown)) and any(compared.glob(f"{RUNS}/*/*/{FIGURES}"))
    # a recording may be another one by now
    if is_finished and options.real is None:
        results = read_json(finished)
        show_tables(make_tables(read_comparison(compared)), console)
    else:
        write_json(record, recorded)
        results = _make(options, stages, recorded, console)
        write_json(finished, results)
    say(console, f"Picture: {output / PICTURE}; figures: {finished}; tables: {compared / 'tables.md'}")
    say(console, "View the trained scenes:")
    for command in results["viewer_commands"]:
        say(console, f"  {command}")
    say(console, f"Open in a browser: {(output / REPORT).resolve().as_uri()}")
    for sentence in WHAT_TO_LOOK_AT:
        say(console, f"  {sentence}")
    return results


def _make(options: DemoOptions, stages: Stages, recorded: dict[str, Any], console: Console) -> dict[str, Any]:
    """Do all stages, show their tables, and write the page and the picture; give what results.json holds."""
    output, compared = options.folder, stages.comparison.output
    clock = _Clock(output / SECONDS, (output / RESULTS).is_file())
    if stages.synthesis is not None:
        with clock.stage("synthesize"), told(console, "Synthesize"):
            synthesize_drive(stages.synthesis)
    with clock.stage("process"), told(console, "Process"):
        process(stages.processing, console)
    with (
        clock.stage("compare"),
        told(console, "Compare"),
        finished_runs(stages.comparison, console) as comparison,
    ):
        page = write_comparison(compared, comparison, console)
    show_tables(page.tables, console)
    # the folder may hold more: who liked it compares further methods there
    runs = {
        METHODS[run.method].title: run
        for run in comparison.runs
        if run.method in COMPARED and (run.scene, run.seed) == (options.scene_name, 0)
    }
    results = {
        "options": recorded,
        "versions": comparison.versions,
        "cores": comparison.cores,
        "figures": {title: run.figures for title, run in runs.items()},
        "seconds": clock.seconds,
        "commands": [command_line(["edge-depth-nerf", "demo"], options), *stages.commands()],
        "viewer_commands": [viewer_command(run.config) for run in runs.values() if run.config],
    }
    write_report(output / REPORT, _page(page, options, results))
    write_bytes(output / PICTURE, (compared / picture_name(options.scene_name)).read_bytes())
    return results


def _page(page: Report, options: DemoOptions, results: dict[str, Any]) -> Report:
    """The comparison's page, with what the stages before it did."""
    rendered = "" if options.real else "a rendered "
    return replace(
        page,
        title=f"Demo: nerfacto and ours on {rendered}{options.scene_name}",
        lead="The same model was trained twice on one drive, for {steps} steps each: without depth, and with the edge "
        "loss on integrated LiDAR and monocular depth.".format(**results["options"]),
        facts=[
            Facts("Demo", {name.capitalize(): str(value) for name, value in results["options"].items()}),
            *page.facts,
            Facts(
                "Seconds of each stage",
                {name.capitalize(): str(seconds) for name, seconds in results["seconds"].items()},
            ),
        ],
        commands=[
            Commands("Commands that produce this: the first one alone, or the others in order", results["commands"]),
            Commands("View the trained scenes", results["viewer_commands"]),
        ],
    )


class _Clock:
    """Seconds of each stage, kept in a file, so that those of an interrupted call count, too; a finished one's stay."""

    def __init__(self, path: Path, is_finished: bool) -> None:
        self.path, self.is_finished = path, is_finished
        self.seconds: dict[str, float] = read_json(path) if path.is_file() else {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        started = time.monotonic()
        try:
            yield
        finally:
            if not self.is_finished:
                self.seconds[name] = round(self.seconds.get(name, 0.0) + time.monotonic() - started, 1)
                write_json(self.path, self.seconds)
