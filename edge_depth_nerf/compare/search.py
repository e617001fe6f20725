"""The search of λ and σ: what came out of each pair, and the best of each method.

Of several drives the mean counts.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, write_rows
from edge_depth_nerf.compare.tables import curve_metric

TUNED = "tuned.json"


@dataclass(frozen=True)
class Grid:
    """What came out for a method: PSNR, dB, mean over the drives and seeds, by λ and σ."""

    method: MethodName
    lambdas: list[float]
    sigmas: list[float | str]
    psnr: dict[tuple[float, float | str], float]
    seeds: tuple[int, ...] = (0,)
    """The same for each λ and σ."""

    @property
    def best(self) -> tuple[float, float | str]:
        """λ and σ of the largest PSNR."""
        return max(self.psnr, key=lambda pair: self.psnr[pair])

    @property
    def at_the_edge(self) -> list[str]:
        """Which of the two is best at an end of what was tried: more may be beyond."""
        weight, sigma = self.best
        numbers = [entry for entry in self.sigmas if entry != "own"]
        found = ["λ"] if weight in (self.lambdas[0], self.lambdas[-1]) else []
        return found + (["σ"] if sigma in (numbers[:1] + numbers[-1:]) else [])


def grids(results: Results) -> list[Grid]:
    """What the runs of a search found, by method."""
    name = f"pixels_{curve_metric(results)}"
    found = []
    for method in results.methods():
        runs = [run for run in results.runs if run.method == method]
        figures: dict[tuple[float, float | str], dict[tuple[str, int], float]] = {}
        for run in runs:
            pair = (run.specification["weight"], run.specification["sigma_m"])
            figures.setdefault(pair, {})[run.scene, run.seed] = run.figures[name]
        seeds, psnr = _means(figures)
        sigmas = {sigma for _, sigma in psnr}
        found.append(
            Grid(
                method,
                sorted({weight for weight, _ in psnr}),
                [*sorted(sigma for sigma in sigmas if sigma != "own"), *(["own"] if "own" in sigmas else [])],
                psnr,
                seeds,
            )
        )
    return found


def _means(
    figures: Mapping[tuple[float, float | str], Mapping[tuple[str, int], float]],
) -> tuple[tuple[int, ...], dict[tuple[float, float | str], float]]:
    """Means over the same drives and seeds, and these seeds, of PSNR by λ and σ, then drive and seed.

    What lacks a drive, as in a search that is not finished, is no mean. Of several seeds count those that most λ and σ
    have.
    """
    runs = {
        (seed, pair): {drive for drive, of in by_run if of == seed}
        for pair, by_run in figures.items()
        for _, seed in by_run
    }
    drives = max(runs.values(), key=len)
    complete: dict[int, set[tuple[float, float | str]]] = {}
    for (seed, pair), there in runs.items():
        if there >= drives:
            complete.setdefault(seed, set()).add(pair)
    first = max(complete, key=lambda seed: (len(complete[seed]), -seed))
    seeds = tuple(sorted(seed for seed, pairs in complete.items() if pairs >= complete[first]))
    means = {
        pair: statistics.fmean(figures[pair][drive, seed] for drive in sorted(drives) for seed in seeds)
        for pair in figures
        if pair in complete[first]
    }
    return seeds, means


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
    parts = [
        "# Search of λ and σ",
        f"{', '.join(results.scenes())}, {seeds_in_words(found)}, preset {content['preset']}, {content['steps']} steps "
        f"each; PSNR in dB of random held-out pixels inside the mask{against}.",
    ]
    for grid in found:
        parts.append(f"## {METHODS[grid.method].title}")
        lines = ["| λ | " + " | ".join(_heading(sigma) for sigma in grid.sigmas) + " |"]
        lines.append("|---|" + "---|" * len(grid.sigmas))
        lines += ["| " + " | ".join(_cells(grid, weight, "**")) + " |" for weight in grid.lambdas]
        parts.append("\n".join(lines))
        if grid.at_the_edge:
            parts.append(_advice(grid))
    write_text(output / "search.md", "\n\n".join(parts) + "\n")
    write_rows(output, results)


def _heading(sigma: float | str) -> str:
    return "σ its own" if sigma == "own" else f"σ {sigma:g} m"


def _cells(grid: Grid, weight: float, mark: str) -> list[str]:
    cells = [f"{weight:g}"]
    for sigma in grid.sigmas:
        value = grid.psnr.get((weight, sigma))
        best = mark if (weight, sigma) == grid.best else ""
        cells.append("–" if value is None else f"{best}{value:.2f}{best}")
    return cells


def _advice(grid: Grid) -> str:
    best = " and ".join(grid.at_the_edge)
    return f"The best {best} is at an end of the range. Add values with the same command."


def show_search(output: Path, results: Results, console: Console) -> None:
    """Print the tables and what to do with them."""
    for grid in grids(results):
        table = Table("λ", *(_heading(sigma) for sigma in grid.sigmas), title=METHODS[grid.method].title)
        for weight in grid.lambdas:
            table.add_row(*_cells(grid, weight, "*"))
        console.print(table)
        if grid.at_the_edge:
            say(console, _advice(grid))
    say(console, f"The best of each: {output / TUNED}; `edge-depth-nerf compare … --tuned {output / TUNED}` uses it.")
