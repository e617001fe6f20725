"""A real drive as a benchmark: every method trained on it with several seeds, and what λ does to each.

    python -m benchmarks.quality.real_drive --real REAL --output outputs/real_drive
    make real REAL=REAL

REAL holds kitti360_drive, a recording that `process rig` reads (docs/real_drive.md says which). It is processed at full
and at half size: every sixth frame is held out with its LiDAR, and a tenth of the LiDAR's beams is held out of all
sweeps. λ and σ are those that a search on a rendered drive found (tuned.json), for all methods alike; nothing is chosen
on this drive. Then the rival with the best PSNR is trained once more, for as many steps as ours' processor seconds
allow, its learning rates falling over these. Then, with the first seed, methods that differ from each other in prior,
loss or extras alone. Last, each method with a depth loss is trained with other λ, one seed,
half size: the curves. Writes table.md, table.json, lambda.svg and views_SCENE.png. Stopped at any moment, the same
command goes on.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import TUNED, ours
from edge_depth_nerf.base.files import read_image, read_json, write_json, write_png, write_text
from edge_depth_nerf.base.pictures import DISTANCE, colour_bar, lay_out, panel
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.methods import EXTRAS_TITLES, GRID, LOSS_TITLES, METHODS, PRIOR_TITLES
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.specification import VIEWS

TABLE: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf", "edge-paper", "edge")
RIVALS: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf")
CELLS: dict[MethodName, MethodName | None] = {
    "nerfacto-integrated-extras": None,
    "ds-nerf-integrated": "ds-nerf",
    "ds-nerf-extras": "ds-nerf",
    "ds-nerf-integrated-extras": "ds-nerf",
    "edge-plain": "edge",
    "edge-lidar": "edge-lidar",
}
"""Cells of the grid that tell prior, loss and extras apart, and whose λ and σ each takes: those of its loss."""
WITH_LAMBDA: tuple[MethodName, ...] = ("urban-nerf", "ds-nerf", "edge")
LAMBDAS = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1)
SIZES = {"half": 2, "full": 1}
HOLDOUT = ("--holdout-every", "6", "--holdout-beams", "10")


SHOWN = ("img", "distance")
"""Judged views that are drawn."""


@dataclass(frozen=True)
class Column:
    """A figure of the table."""

    title: str
    metric: str
    form: str
    more_is_better: bool


COLUMNS = (
    Column("PSNR", "masked_psnr", ".2f", True),
    Column("fitted PSNR", "affine_masked_psnr", ".2f", True),
    Column("SSIM", "masked_ssim", ".3f", True),
    Column("AbsRel", "lidar_abs_rel", ".4f", False),
    Column("RMSE, m", "lidar_rmse_m", ".2f", False),
    Column("δ", "lidar_delta_1_25", ".3f", True),
    Column("beams' AbsRel", "beams_abs_rel", ".4f", False),
)
OVER_LAMBDA = (COLUMNS[0], COLUMNS[3])
"""Picture and depth."""


def write_tuned(path: Path, others: Mapping[MethodName, MethodName | None], **changes: float) -> Path:
    """Write λ and σ of methods: those that others were tuned to, but for the changes."""
    methods = read_json(TUNED)["methods"]
    write_json(path, {"methods": {name: methods[other] | changes for name, other in others.items() if other}})
    return path


def values(runs: Sequence[RunResult], metric: str) -> list[float]:
    """A figure of each run that has it."""
    return [run.figures[metric] for run in runs if metric in run.figures]


def heading(columns: Sequence[Column]) -> Iterator[str]:
    """The first lines of a table, as Markdown."""
    yield "| " + " | ".join(["method", *(column.title for column in columns), "steps", "processor seconds"]) + " |"
    yield "|---" * (len(columns) + 3) + "|"


def row(title: str, found: Sequence[RunResult], columns: Sequence[Column]) -> str:
    """One method of a table, as Markdown: mean and standard deviation of its seeds."""
    cells = [title]
    for column in columns:
        each = values(found, column.metric)
        spread = f" ± {statistics.stdev(each):{column.form}}" if len(each) > 1 else ""
        cells.append(f"{statistics.mean(each):{column.form}}{spread}" if each else "–")
    seconds = f"{statistics.mean(values(found, 'cpu_seconds')):.0f}"
    return "| " + " | ".join([*cells, f"{last_step(found):,}", seconds]) + " |"


def table(results: Results, scene: str, columns: Sequence[Column]) -> Iterator[str]:
    """All methods on a scene, as Markdown."""
    yield from heading(columns)
    for method in TABLE:
        if found := of(results, scene, method):
            yield row(METHODS[method].title, found, columns)


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


def margins(results: Results, scene: str) -> Iterator[str]:
    """Ours against the best rival of each figure, seed by seed."""
    for column in COLUMNS:
        sign = 1 if column.more_is_better else -1
        leads = []
        for seed in results.seeds():
            run = {method: results.run(scene, method, seed) for method in TABLE}
            found = {
                name: each.figures[column.metric]
                for name, each in run.items()
                if each and column.metric in each.figures
            }
            rivals = [value for name, value in found.items() if name in RIVALS]
            if "edge" in found and rivals:
                leads.append(sign * (found["edge"] - (max(rivals) if sign > 0 else min(rivals))))
        if leads:
            ahead = sum(lead > 0 for lead in leads)
            mean = f"{statistics.mean(leads):+{column.form}}"
            yield f"* {column.title}: {mean} on average, ahead with {ahead} of {len(leads)} seeds."


def cells_table(results: Results, cells: Results, scene: str) -> Iterator[str]:
    """Methods that differ in prior, loss or extras alone, all with the first seed, as Markdown."""
    yield from heading(COLUMNS)
    for cell, method in sorted(GRID.items(), key=lambda item: (item[0].extras, item[0].prior or "", item[0].loss)):
        run = (cells if method in CELLS else results).run(scene, method, results.seeds()[0])
        if run is not None:
            prior = [PRIOR_TITLES[cell.prior]] if cell.prior else []
            yield row(", ".join([LOSS_TITLES[cell.loss], *prior, EXTRAS_TITLES[cell.extras]]), [run], COLUMNS)


def lambda_table(curves: Sequence[RunResult]) -> Iterator[str]:
    """PSNR and AbsRel of each method by λ, as Markdown."""
    methods: list[MethodName] = [method for method in WITH_LAMBDA if any(run.method == method for run in curves)]
    yield "| λ | " + " | ".join(METHODS[method].title for method in methods) + " |"
    yield "|---" * (len(methods) + 1) + "|"
    for weight in sorted({run.content["lambda"] for run in curves}):
        cells = [f"{weight:g}"]
        for method in methods:
            found = [run.figures for run in curves if run.method == method and run.content["lambda"] == weight]
            each_seed = [", ".join(f"{figures[each.metric]:{each.form}}" for each in OVER_LAMBDA) for figures in found]
            cells.append("; ".join(each_seed) or "–")
        yield "| " + " | ".join(cells) + " |"


def page(results: Results, longer: Mapping[str, Results], cells: Results, curves: Sequence[RunResult] = ()) -> str:
    """All tables, as Markdown.

    Args:
        results: of as many steps each.
        longer: of the best rival in ours' seconds, by size.
        cells: of `CELLS`.
        curves: with other λ.
    """
    parts = ["# A real drive, by all methods"]
    for scene in results.scenes():
        parts += ["", f"## {scene}", "", *table(results, scene, COLUMNS)]
        parts += ["", f"## Ours against the best rival after as many steps: {scene}", "", *margins(results, scene)]
        size = scene.removeprefix("kitti360_")
        if size in longer:
            runs = longer[size].runs
            parts += ["", f"## The best rival after as many processor seconds as ours: {scene}", "", *heading(COLUMNS)]
            parts.append(row(METHODS[runs[0].method].title, runs, COLUMNS))
        if scene in cells.scenes():
            parts += ["", f"## One change at a time: {scene}", "", *cells_table(results, cells, scene)]
    if curves:
        parts += ["", f"## PSNR and AbsRel over λ: {curves[0].scene}", "", *lambda_table(curves)]
    return "\n".join([*parts, ""])


def draw_lambdas(curves: Sequence[RunResult], path: Path) -> None:
    """Draw picture and depth over λ."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for axis, column in zip(axes, OVER_LAMBDA, strict=True):
        for method in WITH_LAMBDA:
            points = sorted(
                (run.content["lambda"], run.figures[column.metric]) for run in curves if run.method == method
            )
            if not points:
                continue
            axis.plot(*zip(*points, strict=True), marker="o", label=METHODS[method].title)
        axis.set(xscale="log", xlabel="λ", ylabel=column.title)
        axis.grid(alpha=0.3)
    axes[1].set_yscale("log")
    axes[0].legend()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def draw_views(results: Results, scene: str, path: Path) -> None:
    """One held-out picture and its distances as nerfacto, DS-NeRF's loss and ours render them."""
    panels: list[NDArray[np.uint8]] = []
    for method in ("nerfacto", "ds-nerf", "edge"):
        run = results.run(scene, method, results.seeds()[0])
        if run is None:
            return
        beside_truth, distance = (read_image(run.folder / VIEWS / f"eval_{name}_0001.png") for name in SHOWN)
        title, width = METHODS[method].title, beside_truth.shape[1] // 2
        panels.append(panel(beside_truth[:, width:], title))
        panels.append(panel(distance, f"{title}: distance", colour_bar(DISTANCE, width)))
    write_png(path, lay_out(panels, 2, ["A held-out picture, rendered"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, required=True, help="the folder that holds kitti360_drive")
    parser.add_argument("--output", type=Path, default=Path("outputs/real_drive"))
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, help="of each training; the preset's, if not set")
    parser.add_argument(
        "--lambdas", nargs="*", type=float, default=list(LAMBDAS), help="of the curves; none: no curves"
    )
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
    parser.add_argument("--curve-steps", type=int, help="of the curves' trainings; the table's, if not set")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    drive = options.real / "kitti360_drive"
    if not drive.is_dir():
        sys.exit(
            f"{drive}: no such folder; the real drive is not part of the project. docs/real_drive.md says what it is."
        )
    steps = ("--steps", options.steps) if options.steps else ()
    curve_steps = ("--steps", options.curve_steps) if options.curve_steps else steps
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
    of_cells = read_results(cells / RUNS)
    write_text(options.output / "table.md", page(results, evaluated, of_cells))
    for scene in results.scenes():
        draw_views(results, scene, options.output / f"views_{scene}.png")
    write_json(options.output / "table.json", results.rows())

    curves: list[RunResult] = []
    for weight in options.lambdas:
        folder = options.output / f"lambda_{weight:g}"
        given = write_tuned(
            options.output / f"lambda_{weight:g}.json", {name: name for name in WITH_LAMBDA}, **{"lambda": weight}
        )
        scene = scenes.get("half", next(iter(scenes.values())))
        common = ("--tuned", given, "--output", folder, *jobs, *curve_steps)
        ours("compare", scene, "--methods", *WITH_LAMBDA, *common)
        curves += read_results(folder / RUNS).runs
        draw_lambdas(curves, options.output / "lambda.svg")
        write_text(options.output / "table.md", page(results, evaluated, of_cells, curves))


if __name__ == "__main__":
    main()
