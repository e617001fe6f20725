"""`edge-depth-nerf search`: what came out of each pair of λ and σ, and the best of each method.

Of several drives the mean counts.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare.command import finished_runs
from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.options import SearchOptions
from edge_depth_nerf.compare.results import Results, write_rows
from edge_depth_nerf.compare.tables import curve_metric
from edge_depth_nerf.report.tables import Cell, MadeTable, Row, page_of_tables, show_tables

TUNED = "tuned.json"
Pair = tuple[float, float | str]
"""λ, and σ in metres or own."""


@dataclass(frozen=True)
class Grid:
    """What came out for a method: PSNR, dB, mean over the drives and seeds, by λ and σ."""

    method: MethodName
    lambdas: list[float]
    sigmas: list[float | str]
    psnr: dict[Pair, float]
    seeds: tuple[int, ...] = (0,)
    """The same for each λ and σ."""

    @property
    def best(self) -> Pair:
        """λ and σ of the largest PSNR."""
        return max(self.psnr, key=lambda pair: self.psnr[pair])

    @property
    def at_the_edge(self) -> list[str]:
        """Which of the two is best at an end of what was tried: more may be beyond."""
        weight, sigma = self.best
        numbers = [entry for entry in self.sigmas if entry != "own"]
        found = ["λ"] if weight in (self.lambdas[0], self.lambdas[-1]) else []
        return found + (["σ"] if sigma in (numbers[:1] + numbers[-1:]) else [])

    @property
    def table(self) -> MadeTable:
        """A row for each λ and a column for each σ, with what to do if the best is at an end."""
        rows = [
            Row(
                f"λ {weight:g}",
                [Cell(self.psnr.get((weight, sigma)), best=(weight, sigma) == self.best) for sigma in self.sigmas],
            )
            for weight in self.lambdas
        ]
        headings = ["σ its own" if sigma == "own" else f"σ {sigma:g} m" for sigma in self.sigmas]
        best = " and ".join(self.at_the_edge)
        notes = [f"The best {best} is at an end of the range. Add values with the same command."] if best else []
        return MadeTable("", METHODS[self.method].title, [("", headings)], rows, notes)


def search(options: SearchOptions, console: Console | None = None) -> Results:
    """Run or finish a search; give all that the output folder holds.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).
    """
    console = console or Console()
    with finished_runs(options, console) as results:
        write_search(options.output, results)
        show_tables([grid.table for grid in grids(results)], console)
        tuned = options.output / TUNED
        say(console, f"The best of each: {tuned}; `edge-depth-nerf compare … --tuned {tuned}` uses it.")
    return results


def grids(results: Results) -> list[Grid]:
    """What the runs of a search found, by method."""
    name = f"pixels_{curve_metric(results)}"
    found = []
    for method in results.methods():
        figures: dict[Pair, dict[tuple[str, int], float]] = {}
        for run in (run for run in results.runs if run.method == method):
            pair = (run.specification["weight"], run.specification["sigma_m"])
            figures.setdefault(pair, {})[run.scene, run.seed] = run.figures[name]
        seeds, psnr = _means(figures)
        sigmas = sorted({sigma for _, sigma in psnr}, key=lambda sigma: math.inf if sigma == "own" else float(sigma))
        found.append(Grid(method, sorted({weight for weight, _ in psnr}), sigmas, psnr, seeds))
    return found


def _means(figures: Mapping[Pair, Mapping[tuple[str, int], float]]) -> tuple[tuple[int, ...], dict[Pair, float]]:
    """Means over the same drives and seeds, and these seeds, of PSNR by λ and σ, then drive and seed.

    What lacks a drive, as in a search that is not finished, is no mean. Of several seeds count those that most λ and σ
    have.
    """

    def drives_of(pair: Pair, seed: int) -> set[str]:
        return {drive for drive, each in figures[pair] if each == seed}

    seeds = sorted({seed for by_run in figures.values() for _, seed in by_run})
    drives = max((drives_of(pair, seed) for pair in figures for seed in seeds), key=len)
    complete = {seed: {pair for pair in figures if drives_of(pair, seed) >= drives} for seed in seeds}
    most = max(complete.values(), key=len)
    counted = [seed for seed in seeds if complete[seed] >= most]
    runs = [(drive, seed) for drive in sorted(drives) for seed in counted]
    means = {pair: statistics.fmean(by_run[run] for run in runs) for pair, by_run in figures.items() if pair in most}
    return tuple(counted), means


def seeds_in_words(found: Sequence[Grid]) -> str:
    """The seeds of a search."""
    seeds = sorted({seed for grid in found for seed in grid.seeds})
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def write_search(output: Path, results: Results) -> None:
    """Write tuned.json for `--tuned`, search.md, and the tidy rows."""
    run = results.runs[0]
    found = grids(results)
    content: dict[str, Any] = {
        "scenes": sorted({each.specification["scene"] for each in results.runs}),
        "seed": found[0].seeds[0] if len(found[0].seeds) == 1 else [*found[0].seeds],
        "preset": run.specification["preset"],
        "steps": run.content["steps"],
        "chosen_by": f"pixels_{curve_metric(results)}",
        "methods": {
            grid.method: {"lambda": grid.best[0], "sigma_m": grid.best[1], "psnr": grid.psnr[grid.best]}
            for grid in found
        },
    }
    write_json(output / TUNED, content)
    against = ", against the ground truth" if "truth" in content["chosen_by"] else ""
    against += ", mean over the drives" if len(results.scenes()) > 1 else ""
    line = (
        f"{', '.join(results.scenes())}, {seeds_in_words(found)}, preset {content['preset']}, {content['steps']} steps "
        f"each; PSNR in dB of random held-out pixels inside the mask{against}."
    )
    page = page_of_tables("Search of λ and σ", [line], [grid.table for grid in found])
    write_text(output / "search.md", page)
    write_rows(output, results)
