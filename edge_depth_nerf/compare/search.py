"""The search of λ and σ: what came out of each pair, and the best of each method.

Of several drives the mean counts.
"""

from __future__ import annotations

import statistics
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
    """What came out for a method: PSNR, dB, mean over the drives, by λ and σ."""

    method: MethodName
    lambdas: list[float]
    sigmas: list[float | str]
    psnr: dict[tuple[float, float | str], float]

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
        figures: dict[tuple[float, float | str], dict[str, float]] = {}
        for run in runs:
            pair = (run.specification["weight"], run.specification["sigma_m"])
            figures.setdefault(pair, {})[run.scene] = run.figures[name]
        drives = max(len(by_drive) for by_drive in figures.values())
        # one that not all drives have, as of a search that goes on, is no mean
        psnr = {
            pair: statistics.fmean(by_drive.values()) for pair, by_drive in figures.items() if len(by_drive) == drives
        }
        sigmas = {sigma for _, sigma in psnr}
        found.append(
            Grid(
                method,
                sorted({weight for weight, _ in psnr}),
                [*sorted(sigma for sigma in sigmas if sigma != "own"), *(["own"] if "own" in sigmas else [])],
                psnr,
            )
        )
    return found


def write_search(output: Path, results: Results) -> None:
    """Write tuned.json for `--tuned`, search.md, and the tidy rows."""
    run = results.runs[0]
    found = grids(results)
    content: dict[str, Any] = {
        "scenes": sorted({each.specification["scene"] for each in results.runs}),
        "seed": run.seed,
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
        f"{', '.join(results.scenes())}, seed {run.seed}, preset {content['preset']}, {content['steps']} steps each; "
        f"PSNR in dB of random held-out pixels inside the mask{against}.",
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
