"""Real drives as a benchmark: every method trained on each with several seeds.

    python -m benchmarks.quality.real_drive REAL/kitti360_drive@2 kitti_0005 --output outputs/real_drive
    make real REAL="REAL/kitti360_drive@2 kitti_0005"

Each argument is a recording that `process rig` reads (docs/results.md says which), @2: at half size. It is processed
with every sixth frame held out with its LiDAR, and a tenth of the LiDAR's beams held out of all sweeps. λ and σ are
those that a search on a rendered drive found (tuned.json), for all methods alike.
Then the rival without our prior that has the best PSNR is trained once more on each drive, for as many steps as ours'
processor seconds allow, its learning rates falling over these. Then, with the first seed and drive, methods that differ
from ours in extras or prior alone. Writes table.md, table.json and views_SCENE.png. To resume a stopped run, start the
same command again.
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
from benchmarks.quality.unseen import title_of, with_spread
from edge_depth_nerf.base.files import read_json, write_json, write_png, write_text
from edge_depth_nerf.base.pictures import DISTANCE, colour_bar, draw_points, lay_out, panel
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.specification import VIEWS
from edge_depth_nerf.report.compared_views import compared_view, held_out_frames

RIVALS: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf")
WITH_PRIOR: MethodName = "ds-nerf-integrated-extras"
TABLE: tuple[MethodName, ...] = (*RIVALS, WITH_PRIOR, "edge-paper", "edge", "edge-sharp")
CELLS: tuple[MethodName, ...] = ("edge-plain", "edge-lidar")
"""Methods that differ from ours in extras or prior alone."""
TUNED_AS: dict[MethodName, MethodName] = {WITH_PRIOR: "ds-nerf", "edge-plain": "edge", "edge-sharp": "edge"}
"""Whose λ and σ a method takes that the search did not have: those of its loss."""
SIZES = {1: "full", 2: "half"}
HOLDOUT = ("--holdout-every", "6", "--holdout-beams", "10")
SHOWN = 1
"""Number of the held-out picture that is drawn."""


@dataclass(frozen=True)
class Column:
    """A figure of the table."""

    title: str
    metric: str
    form: str
    factor: float = 1
    """From the figure's unit to the column's."""


COLUMNS = (
    Column("masked PSNR", "masked_psnr", ".2f"),
    Column("SSIM", "masked_ssim", ".3f"),
    Column("AbsRel", "lidar_abs_rel", ".3f"),
    Column("δ", "lidar_delta_1_25", ".3f"),
)
SCANS = (
    Column("median, cm", "scan_median_m", ".1f", 100),
    Column("within 30 cm, %", "scan_within_30_cm", ".1f", 100),
    Column("AbsRel", "scan_abs_rel", ".3f"),
    Column("foliage: AbsRel", "scan_foliage_abs_rel", ".3f"),
)
"""Of the rays of held-out sweeps."""


@dataclass(frozen=True)
class Drive:
    """A recording at a size."""

    folder: Path
    downscale: int

    @classmethod
    def named(cls, text: str) -> Drive:
        """Read FOLDER or FOLDER@DOWNSCALE."""
        folder, _, downscale = text.partition("@")
        return cls(Path(folder), int(downscale or 1))

    @property
    def name(self) -> str:
        """Of its scene: kitti360_half for kitti360_drive at half size."""
        return f"{self.folder.name.removesuffix('_drive')}_{SIZES.get(self.downscale, self.downscale)}"


def write_tuned(path: Path) -> Path:
    """Write λ and σ of all methods."""
    methods = read_json(TUNED)["methods"]
    write_json(path, {"methods": methods | {name: methods[other] for name, other in TUNED_AS.items()}})
    return path


def values(runs: Sequence[RunResult], metric: str) -> list[float]:
    """A figure of each run that has it."""
    return [run.figures[metric] for run in runs if metric in run.figures]


def row(title: str, found: Sequence[RunResult], *, timed: bool, columns: Sequence[Column] = COLUMNS) -> str:
    """One method of a table, as Markdown: mean and standard deviation of its seeds."""
    cells = [title]
    for column in columns:
        each = [column.factor * value for value in values(found, column.metric)]
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
            yield row(title_of(method), found, timed=longer is not None)


def scans_table(results: Results, scene: str) -> Iterator[str]:
    """All methods along the rays of a scene's held-out sweeps, as Markdown; nothing if no run was judged by them."""
    if not any(values([run], SCANS[0].metric) for run in results.runs if run.scene == scene):
        return
    yield "| " + " | ".join(["method", *(column.title for column in SCANS)]) + " |"
    yield "|---" * (len(SCANS) + 1) + "|"
    for method in TABLE:
        if found := of(results, scene, method):
            yield row(title_of(method), found, timed=False, columns=SCANS)


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
        longer: of the best rival in ours' seconds, by scene.
    """
    parts = ["# Real drives, by all methods"]
    for scene in results.scenes():
        parts += ["", f"## {scene}", "", *table(results, scene, longer.get(scene))]
        if scans := [*scans_table(results, scene)]:
            parts += ["", f"## {scene}: held-out scans", "", *scans]
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
    parser.add_argument("drives", type=Drive.named, nargs="+", metavar="FOLDER[@DOWNSCALE]", help="recordings")
    parser.add_argument("--output", type=Path, default=Path("outputs/real_drive"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, help="of each training; the preset's, if not set")
    parser.add_argument(
        "--equal-seconds",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="the best rival in ours' seconds",
    )
    parser.add_argument(
        "--cells", action=argparse.BooleanOptionalAction, default=True, help="methods that differ in one thing alone"
    )
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    for drive in options.drives:
        if not drive.folder.is_dir():
            sys.exit(
                f"{drive.folder}: no such folder; real drives are not part of the project. docs/results.md says which."
            )
    tuned = write_tuned(options.output / "tuned.json")
    common = ("--tuned", tuned, "--jobs", options.jobs)
    steps = ("--steps", options.steps) if options.steps else ()
    compared = {drive.name: options.output / "compared" / drive.name for drive in options.drives}
    scenes = {drive.name: options.output / drive.name for drive in options.drives}
    for drive in options.drives:
        given = ("--root", drive.folder, "--output", scenes[drive.name], "--downscale", drive.downscale)
        ours("process", "rig", *given, *HOLDOUT)
    for seed in options.seeds:
        # a seed is whole before the next begins: a stopped benchmark has a table of those it has
        for name, scene in scenes.items():
            given = ("--seeds", seed, "--methods", *TABLE, "--output", compared[name])
            ours("compare", scene, *given, *common, *steps)
    results = Results([run for path in compared.values() for run in read_results(path / RUNS).runs])
    longer: dict[str, Path] = {}
    for name, scene in scenes.items():
        if options.equal_seconds and (best := best_rival(results, name)):
            rival, length = best
            longer[name] = options.output / "equal_seconds" / f"{name}_{rival}_{length}"
            given = ("--seeds", *options.seeds, "--methods", rival, "--output", longer[name])
            ours("compare", scene, *given, *common, "--steps", length)
    evaluated = {name: read_results(path / RUNS) for name, path in longer.items()}
    if options.cells:
        first, output = next(iter(scenes.values())), options.output / "cells"
        given = ("--seeds", options.seeds[0], "--methods", *CELLS, "--output", output)
        ours("compare", first, *given, *common, *steps)
    write_text(options.output / "table.md", page(results, evaluated))
    for scene in results.scenes():
        draw_views(results, scene, options.output / f"views_{scene}.png")
    write_json(options.output / "table.json", results.rows())


if __name__ == "__main__":
    main()
