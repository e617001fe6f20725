"""A real drive as a benchmark: every method trained on it with several seeds.

    python -m benchmarks.quality.real_drive --real REAL --output outputs/real_drive
    make real REAL=REAL

REAL holds kitti360_drive, a recording that `process rig` reads (docs/results.md says which). It is processed at full
and at half size: every sixth frame is held out with its LiDAR, and a tenth of the LiDAR's beams is held out of all
sweeps. λ and σ are those that a search on a rendered drive found (tuned.json), for all methods alike; nothing is chosen
on this drive. Then the rival with the best PSNR is trained once more, for as many steps as ours' processor seconds
allow, its learning rates falling over these. Then, with the first seed, methods that differ from ours in prior, loss or
extras alone. Writes table.md, table.json and views_SCENE.png. To resume a stopped run, start the same command again.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.commands import TUNED, ours
from benchmarks.quality.unseen import with_spread
from edge_depth_nerf.base.files import read_json, write_json, write_png, write_text
from edge_depth_nerf.base.pictures import DISTANCE, colour_bar, draw_points, lay_out, panel
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.specification import VIEWS
from edge_depth_nerf.report.compared_views import compared_view, held_out_frames

TABLE: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf", "edge-paper", "edge")
RIVALS: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf")
CELLS: dict[MethodName, MethodName] = {
    "ds-nerf-integrated-extras": "ds-nerf",
    "edge-plain": "edge",
    "edge-lidar": "edge-lidar",
}
"""Methods that differ from ours in loss, extras or prior alone, and whose λ and σ each takes: those of its loss."""
SIZES = {"half": 2, "full": 1}
HOLDOUT = ("--holdout-every", "6", "--holdout-beams", "10")
SHOWN = 1
"""Number of the held-out picture that is drawn."""


@dataclass(frozen=True)
class Column:
    """A figure of the table."""

    title: str
    metric: str
    form: str


COLUMNS = (
    Column("masked PSNR", "masked_psnr", ".2f"),
    Column("SSIM", "masked_ssim", ".3f"),
    Column("AbsRel", "lidar_abs_rel", ".3f"),
    Column("δ", "lidar_delta_1_25", ".3f"),
)


def write_tuned(path: Path, others: Mapping[MethodName, MethodName]) -> Path:
    """Write λ and σ of methods: those that others were tuned to."""
    methods = read_json(TUNED)["methods"]
    write_json(path, {"methods": {name: methods[other] for name, other in others.items()}})
    return path


def values(runs: Sequence[RunResult], metric: str) -> list[float]:
    """A figure of each run that has it."""
    return [run.figures[metric] for run in runs if metric in run.figures]


def row(title: str, found: Sequence[RunResult], *, timed: bool) -> str:
    """One method of a table, as Markdown: mean and standard deviation of its seeds."""
    cells = [title]
    for column in COLUMNS:
        each = values(found, column.metric)
        cells.append(with_spread(each, column.form) if each else "–")
    cells += [f"{statistics.mean(values(found, 'cpu_seconds')):.0f}"] if timed else []
    return "| " + " | ".join(cells) + " |"


def table(results: Results, scene: str, longer: Results | None = None) -> Iterator[str]:
    """All methods on a scene, as Markdown.

    Args:
        results: of as many steps each.
        scene: its name.
        longer: the best rival in ours' processor seconds. Without it, the table has no seconds.
    """
    headings = ["method", *(column.title for column in COLUMNS), *(["processor seconds"] if longer else [])]
    yield "| " + " | ".join(headings) + " |"
    yield "|---" * len(headings) + "|"
    for method in TABLE:
        if method == "edge" and longer:
            yield row(f"{METHODS[longer.runs[0].method].title}, as many seconds as ours", longer.runs, timed=True)
        if found := of(results, scene, method):
            yield row(METHODS[method].title, found, timed=longer is not None)


def of(results: Results, scene: str, method: MethodName) -> list[RunResult]:
    """The runs of a method on a scene."""
    return [run for run in results.runs if run.scene == scene and run.method == method]


def last_step(runs: Sequence[RunResult]) -> int:
    """How many steps the runs had."""
    return int(runs[0].curve[-1]["step"])


def best_rival(results: Results, scene: str) -> tuple[MethodName, int] | None:
    """The rival of the best PSNR, and how many steps it does in ours' processor seconds; None without runs."""
    ours = of(results, scene, "edge")
    found: dict[MethodName, list[RunResult]] = {rival: runs for rival in RIVALS if (runs := of(results, scene, rival))}
    if not ours or not found:
        return None
    rival = max(found, key=lambda name: statistics.mean(values(found[name], COLUMNS[0].metric)))
    ratio = statistics.mean(values(ours, "cpu_seconds")) / statistics.mean(values(found[rival], "cpu_seconds"))
    return rival, 10 * round(last_step(found[rival]) * ratio / 10)


def page(results: Results, longer: Mapping[str, Results]) -> str:
    """All tables, as Markdown.

    Args:
        results: of as many steps each.
        longer: of the best rival in ours' seconds, by size.
    """
    parts = ["# A real drive, by all methods"]
    for scene in results.scenes():
        parts += ["", f"## {scene}", "", *table(results, scene, longer.get(scene.removeprefix("kitti360_")))]
    return "\n".join([*parts, ""])


def draw_views(results: Results, scene: str, path: Path) -> None:
    """One held-out picture and its LiDAR distances, then as nerfacto, DS-NeRF's loss and ours render both."""
    runs = {method: results.run(scene, method, results.seeds()[0]) for method in ("nerfacto", "ds-nerf", "edge")}
    views_of = {METHODS[name].title: run.folder / VIEWS for name, run in runs.items() if run is not None}
    if len(views_of) < len(runs):
        return
    folder = Path(next(run for run in runs.values() if run is not None).specification["scene"])
    view = compared_view(folder, held_out_frames(folder)[SHOWN], SHOWN, views_of)
    height, width = view.mask.shape
    points = draw_points(view.rgb, np.where(view.mask, view.distance_m, 0), (width, height))
    bar = colour_bar(DISTANCE, width)
    panels = [panel(view.rgb, "recorded"), panel(points, "recorded: LiDAR distance", bar)]
    for title, colours in view.colours.items():
        panels += [panel(colours, title), panel(view.distances[title], f"{title}: distance", bar)]
    write_png(path, lay_out(panels, 2, ["A held-out picture, recorded and rendered"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, required=True, help="the folder that holds kitti360_drive")
    parser.add_argument("--output", type=Path, default=Path("outputs/real_drive"))
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, help="of each training; the preset's, if not set")
    parser.add_argument(
        "--equal-seconds",
        nargs="*",
        choices=SIZES,
        default=["half"],
        help="sizes: the best rival in ours' seconds",
    )
    parser.add_argument(
        "--cells", action=argparse.BooleanOptionalAction, default=True, help="methods that differ in one thing alone"
    )
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    drive = options.real / "kitti360_drive"
    if not drive.is_dir():
        sys.exit(
            f"{drive}: no such folder; the real drive is not part of the project. docs/results.md says what it is."
        )
    steps = ("--steps", options.steps) if options.steps else ()
    jobs = ("--jobs", options.jobs)
    compared = options.output / "compared"
    scenes = {size: options.output / f"kitti360_{size}" for size in options.sizes}
    for size, scene in scenes.items():
        ours("process", "rig", "--root", drive, "--output", scene, "--downscale", SIZES[size], *HOLDOUT)
    for seed in options.seeds:
        # a seed is whole before the next begins: a stopped benchmark has a table of those it has
        common = ("--methods", *TABLE, "--tuned", TUNED, "--output", compared, *jobs, *steps)
        ours("compare", *scenes.values(), "--seeds", seed, *common)
    results = read_results(compared / RUNS)
    longer: dict[str, Path] = {}
    for size in options.equal_seconds:
        if size in scenes and (best := best_rival(results, scenes[size].name)):
            rival, length = best
            common = ("--methods", rival, "--tuned", TUNED, "--steps", length, *jobs)
            longer[size] = options.output / "equal_seconds" / f"{size}_{rival}_{length}"
            ours("compare", scenes[size], "--seeds", *options.seeds, *common, "--output", longer[size])
    evaluated = {size: read_results(path / RUNS) for size, path in longer.items()}
    cells = options.output / "cells"
    if options.cells:
        scene = scenes.get("half", next(iter(scenes.values())))
        given = write_tuned(options.output / "cells.json", CELLS)
        common = ("--tuned", given, "--output", cells, *jobs, *steps)
        ours("compare", scene, "--methods", *CELLS, "--seeds", options.seeds[0], *common)
    write_text(options.output / "table.md", page(results, evaluated))
    for scene in results.scenes():
        draw_views(results, scene, options.output / f"views_{scene}.png")
    write_json(options.output / "table.json", results.rows())


if __name__ == "__main__":
    main()
