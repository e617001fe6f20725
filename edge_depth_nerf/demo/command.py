"""`edge-depth-nerf demo`: the whole way once, from a raw drive to compared figures and pictures.

Each stage is a command that a user would give, `synthesize`, `process` and `compare`, and what it leaves under the
output folder is not done again.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from edge_depth_nerf.base.console import say, told
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, read_json, write_bytes, write_json
from edge_depth_nerf.compare.command import RUNS, finished_runs, picture_name, read_comparison, write_comparison
from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.options import CompareOptions
from edge_depth_nerf.compare.specification import FIGURES
from edge_depth_nerf.compare.tables import make_tables
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.jobs.runs import command_line, viewer_command
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.report.build import Commands, Facts, Report, write_report
from edge_depth_nerf.report.tables import show_tables
from edge_depth_nerf.report.views import REPORT
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

COMPARED: tuple[MethodName, ...] = ("nerfacto", "edge")
"""They differ in the depth loss and in what comes with it, the source of depth; nerfacto uses none."""
RECORD, RESULTS, SECONDS, PICTURE = "demo.json", "results.json", "seconds.json", "comparison.png"


@dataclass(frozen=True)
class Stages:
    """The options of each stage."""

    synthesis: SynthesizeOptions
    processing: Kitti360Options
    comparison: CompareOptions

    def commands(self) -> list[str]:
        """The commands that do the same, one after another."""
        return [
            command_line(["edge-depth-nerf", "synthesize"], self.synthesis),
            command_line(["edge-depth-nerf", "process", "kitti360"], self.processing),
            command_line(["edge-depth-nerf", "compare"], self.comparison),
        ]


def stages_of(options: DemoOptions) -> Stages:
    """Settle what each stage of a demo does."""
    drive, scene = options.output / "drive", options.output / "scenes" / options.scene
    synthesis = SynthesizeOptions(output=drive, scene=options.scene, frames=options.frames, size=options.size)
    return Stages(
        synthesis,
        Kitti360Options(root=drive, sequence=synthesis.sequence, output=scene),
        CompareOptions(
            scenes=(scene,),
            output=options.output / "comparison",
            methods=COMPARED,
            steps=options.steps,
            # side by side, each on its share of the cores: two threads do not make one training twice as fast
            jobs=len(COMPARED),
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
    output, stages = options.output, stages_of(options)
    check_is_folder(output)
    # before the first stage takes its minute
    for stage in (stages.synthesis, stages.processing, stages.comparison):
        stage.check()
    recorded = {key: value for key, value in asdict(options).items() if key != "output"}
    record = output / RECORD
    if record.is_file() and read_json(record) != recorded:
        raise InputError(
            f"{record}: this folder contains a demo with other options ({read_json(record)}). "
            "Choose another --output, or remove the folder."
        )
    finished, compared = output / RESULTS, stages.comparison.output
    if record.is_file() and finished.is_file() and any(compared.glob(f"{RUNS}/*/*/{FIGURES}")):
        results = read_json(finished)
        show_tables(make_tables(read_comparison(compared)), console)
    else:
        write_json(record, recorded)
        results = _make(options, stages, recorded, console)
        write_json(finished, results)
    say(console, f"Open in a browser: {output / REPORT}")
    say(console, f"Picture: {output / PICTURE}; figures: {finished}; tables: {compared / 'tables.md'}")
    say(console, "View the trained scenes:")
    for command in results["viewer_commands"]:
        say(console, f"  {command}")
    return results


def _make(options: DemoOptions, stages: Stages, recorded: dict[str, Any], console: Console) -> dict[str, Any]:
    """Do all stages, show their tables, and write the page and the picture; give what results.json holds."""
    output, compared = options.output, stages.comparison.output
    clock = _Clock(output / SECONDS)
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
        if run.method in COMPARED and (run.scene, run.seed) == (options.scene, 0)
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
    write_report(output / REPORT, _page(page, results))
    write_bytes(output / PICTURE, (compared / picture_name(options.scene)).read_bytes())
    return results


def _page(page: Report, results: dict[str, Any]) -> Report:
    """The comparison's page, with what the stages before it did."""
    options = results["options"]
    return replace(
        page,
        title=f"Demo: nerfacto and ours on a rendered {options['scene']}",
        lead="The same model trained twice on one drive: without depth, and with "
        "the edge loss on integrated LiDAR and monocular depth. The drive: {scene}, {frames} frames, {size} px, "
        "{steps} steps each.".format(**options),
        facts=[
            Facts("Demo", {name.replace("_", " ").capitalize(): str(value) for name, value in options.items()}),
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
