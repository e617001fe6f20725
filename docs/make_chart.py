"""Draw the charts of docs/results.md and docs/real_drive.md from their own tables: `python docs/make_chart.py`.

Run it after `benchmarks.pages` has written new tables.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_atomically

DOCS = Path(__file__).resolve().parent


@dataclass(frozen=True)
class Chart:
    """A picture of a page's tables."""

    page: str
    file: str
    tables: Mapping[str, str]
    """Generated tables of the page, and what is added to the titles of their rows."""
    psnr_db: tuple[float, float]
    """Ends of the axis."""
    abs_rel: tuple[float, float]


CHARTS = (
    Chart("results.md", "results_unseen.svg", {"unseen: geometry": ""}, (29.5, 32), (0.01, 1)),
    Chart(
        "real_drive.md",
        "results_real.svg",
        {"real: table": "", "real: seconds": ", as many seconds as ours"},
        (19, 22),
        (0.008, 1),
    ),
)
SIZE_IN = (8.4, 3.2)
OURS, RIVALS = "#2458a6", "#5f6b77"


@dataclass(frozen=True)
class Result:
    """A method's mean and standard deviation over seeds."""

    title: str
    psnr_db: float
    psnr_spread_db: float
    abs_rel: float
    abs_rel_spread: float


def results(chart: Chart, page: str) -> list[Result]:
    """Read the methods' figures from the page's tables.

    Raises:
        InputError: a table has no rows.
    """
    found: list[Result] = []
    for mark, added in chart.tables.items():
        _, _, after = page.partition(f"<!-- {mark} -->")
        lines = [line for line in after.partition("<!-- end -->")[0].splitlines() if line.startswith("|")]
        rows = [[cell.strip(" *") for cell in line.strip("|").split("|")] for line in lines]
        if len(rows) < 3:
            raise InputError(
                f"{chart.page}: the table under <!-- {mark} --> has no rows. Write it with python -m benchmarks.pages."
            )
        # a table of `compare` has an arrow that says which way is better
        columns = [[heading.split(" ")[0] for heading in rows[0]].index(name) for name in ("PSNR", "AbsRel")]
        for row in rows[2:]:
            psnr, abs_rel = (re.split(" ± ", row[column]) for column in columns)
            found.append(Result(row[0] + added, *map(float, psnr), *map(float, abs_rel)))
    return sorted(found, key=lambda each: each.psnr_db)


def draw(chart: Chart, found: list[Result], path: Path) -> None:
    """Draw PSNR and AbsRel of each method side by side."""
    # text stays text, and the same results give the same file
    with rc_context({"svg.hashsalt": "edge-depth-nerf", "svg.fonttype": "none", "font.size": 9}):
        figure = Figure(SIZE_IN, layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for one in found:
            style = {"fmt": "o", "markersize": 6, "capsize": 2, "color": OURS if one.title == "ours" else RIVALS}
            left.errorbar(one.psnr_db, one.title, xerr=one.psnr_spread_db, **style)
            right.errorbar(one.abs_rel, one.title, xerr=one.abs_rel_spread, **style)
            for axes, value, text in (
                (left, one.psnr_db, f"{one.psnr_db:.2f}"),
                (right, one.abs_rel, f"{one.abs_rel:.{3 if one.abs_rel >= 0.02 else 4}f}"),
            ):
                axes.annotate(text, (value, one.title), (0, 6), textcoords="offset points", ha="center")
        left.set(xlim=chart.psnr_db, ylim=(-0.5, len(found) - 0.2), xlabel="PSNR, dB (higher is better)")
        right.set(xscale="log", xlim=chart.abs_rel, xlabel="AbsRel, log scale (lower is better)")
        for axes in (left, right):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", alpha=0.3)
        write_atomically(path, lambda unfinished: figure.savefig(unfinished, format="svg", metadata={"Date": None}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the charts of docs/results.md and docs/real_drive.md.")
    parser.add_argument("--output", type=Path, default=DOCS, help="folder to write them to")
    folder = parser.parse_args().output
    for each in CHARTS:
        draw(each, results(each, (DOCS / each.page).read_text(encoding="utf-8")), folder / each.file)
