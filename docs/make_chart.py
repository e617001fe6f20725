"""Draw the chart of docs/results.md from its own table: `python docs/make_chart.py`.

Run it after `benchmarks.pages` has written a new table.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from matplotlib import rc_context
from matplotlib.figure import Figure

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_atomically

DOCS = Path(__file__).resolve().parent
PAGE, TABLE, FILE = DOCS / "results.md", "real: table", "results_real.svg"
"""The page, its generated table, and the chart."""
PSNR_DB, ABS_REL = (19, 22), (0.008, 1)
"""Ends of the axes."""
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


def results(page: str) -> list[Result]:
    """Read the methods' figures from the page's table.

    Raises:
        InputError: the table has no rows.
    """
    _, _, after = page.partition(f"<!-- {TABLE} -->")
    lines = [line for line in after.partition("<!-- end -->")[0].splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    if len(rows) < 3:
        raise InputError(
            f"{PAGE.name}: the table under <!-- {TABLE} --> has no rows. Write it with python -m benchmarks.pages."
        )
    columns = [rows[0].index(name) for name in ("masked PSNR", "AbsRel")]
    # a spread that is 0 as written is left out
    figures = [
        [float(each) for column in columns for each in f"{row[column]} ± 0".split(" ± ")[:2]] for row in rows[2:]
    ]
    found = [Result(row[0], *each) for row, each in zip(rows[2:], figures, strict=True)]
    return sorted(found, key=lambda each: each.psnr_db)


def draw(found: list[Result], path: Path) -> None:
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
                (right, one.abs_rel, f"{one.abs_rel:.3f}"),
            ):
                axes.annotate(text, (value, one.title), (0, 6), textcoords="offset points", ha="center")
        left.set(xlim=PSNR_DB, ylim=(-0.5, len(found) - 0.2), xlabel="PSNR, dB (higher is better)")
        right.set(xscale="log", xlim=ABS_REL, xlabel="AbsRel, log scale (lower is better)")
        for axes in (left, right):
            axes.spines[["top", "right"]].set_visible(False)
            axes.grid(axis="y", alpha=0.3)
        write_atomically(path, lambda unfinished: figure.savefig(unfinished, format="svg", metadata={"Date": None}))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the chart of docs/results.md.")
    parser.add_argument("--output", type=Path, default=DOCS, help="folder to write it to")
    draw(results(PAGE.read_text(encoding="utf-8")), parser.parse_args().output / FILE)
