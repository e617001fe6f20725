"""`edge-depth-nerf grid`: what prior, loss and extras are worth, each with all else equal, and the whole.

A figure is a difference of two cells that differ in one of the three alone; over seeds and drives as in the tables.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from itertools import product
from typing import Any

from rich.console import Console

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import check_is_folder, write_text
from edge_depth_nerf.compare.command import check_scene, compare
from edge_depth_nerf.compare.methods import (
    EXTRAS_TITLES,
    GRID,
    LOSS_TITLES,
    METHODS,
    PRIOR_TITLES,
    Loss,
    Method,
    MethodName,
    PriorName,
)
from edge_depth_nerf.compare.options import CompareOptions, GridOptions, SearchOptions, TrainingOptions
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.search import TUNED, Grid, grids, search, seeds_in_words
from edge_depth_nerf.compare.tables import cell_of, compared, introduction, means_over, psnr_metric
from edge_depth_nerf.report.tables import Cell, MadeTable, Metric, Row, mark_best, page_of_tables, show_tables

SEARCH, COMPARISON = "search", "comparison"
GRID_PAGE = "grid.md"
"""The two folders of a grid, and its page."""
BEST_WITHOUT_EXTRAS, BEST_OF_ALL = "the best rival without extras", "the best rival of all"
NOTE = "dB: the gain in PSNR. AbsRel ×: AbsRel divided by the other's; below 1 is better."


def grid(options: GridOptions, console: Console | None = None) -> Results:
    """Search λ and σ of each cell on the tuning drives, compare the cells with what was found, and say what came out.

    Returns:
        The comparison. Search and comparison are those of the other commands, in two folders of the output folder.

    Raises:
        InputError: options, scenes or the output folder cannot be used, or a run failed (its log is named).
    """
    console = console or Console()
    options.check()
    check_is_folder(options.output)
    cells = options.methods or tuple(GRID.values())
    folder, comparison = options.output / SEARCH, options.output / COMPARISON
    if options.output.is_dir() and any(options.output.iterdir()) and not folder.is_dir():
        raise InputError(f"{options.output}: contains other files. Choose a new or empty folder for --output.")
    # what is to be evaluated is looked at before a search of hours
    for scene in options.scenes:
        check_scene(scene, cells, options.preset)
    shared: dict[str, Any] = {each.name: getattr(options, each.name) for each in fields(TrainingOptions)}
    tuning: dict[str, Any] = {"scenes": options.tuning, "output": folder, "seeds": options.seeds[:1]}
    tuning["methods"] = tuple(name for name in cells if METHODS[name].loss != "none")
    asked = SearchOptions(lambdas=options.lambdas, sigmas_m=options.sigmas_m, **shared | tuning)
    searched = search(asked, console)
    shared |= {"output": comparison, "methods": cells}
    results = compare(CompareOptions(tuned=folder / TUNED, **shared), console)
    tables = grid_tables(results, grids(searched))
    write_text(options.output / GRID_PAGE, page_of_tables("Grid", grid_lines(results, searched), tables))
    show_tables(tables, console)
    say(console, f"What prior, loss, extras and the whole are worth: {options.output / GRID_PAGE}")
    return results


class _Cells:
    """The cells that were trained, and how two of them compare."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.names = {cell: name for cell, name in GRID.items() if name in results.methods()}
        self.columns = means_over(results.scenes())
        truth = all("truth_abs_rel" in run.figures for run in results.runs)
        self.psnr = psnr_metric(results)
        self.abs_rel = Metric("truth_abs_rel" if truth else "lidar_abs_rel", "AbsRel ↓", ".3f", -1)

    def name(self, loss: Loss, prior: PriorName, extras: bool) -> MethodName | None:
        """The method of a cell; without a loss and extras there is one for both priors."""
        return self.names.get(Method(loss, None if loss == "none" and not extras else prior, extras))

    def mean_psnr(self, name: MethodName) -> float:
        """Mean over drives and seeds, dB; minus infinity without a whole row."""
        found = cell_of(self.results, self.results.scenes(), name, self.psnr).mean
        return float("-inf") if found is None else found

    def row(self, title: str, one: MethodName, other: MethodName) -> Row:
        """By how much one is ahead of another, over the seeds that both have."""
        pairs = product([scenes for _, scenes in self.columns], (self.psnr, self.abs_rel))
        return Row(title, [compared(self.results, scenes, one, other, metric) for scenes, metric in pairs])

    def table(self, label: str, title: str, rows: list[Row]) -> MadeTable:
        """A table of such rows."""
        groups = [(name, ["dB", "AbsRel ×"]) for name, _ in self.columns]
        return MadeTable(label, title, groups, rows, [NOTE])


def _with_mean(rows: list[Row], title: str = "mean") -> list[Row]:
    """Rows, and their mean where there are several."""
    if len(rows) < 2:
        return rows
    figures = []
    for place, figure in enumerate(rows[0].cells):
        values = [mean for row in rows if (mean := row.cells[place].mean) is not None]
        figures.append(Cell(statistics.fmean(values) if values else None, form=figure.form))
    return [*rows, Row(title, figures)]


Named = tuple[str, MethodName | None, MethodName | None]
"""A row's title, and the two methods that it compares, where they are there."""


def _rows(cells: _Cells, pairs: Iterable[Named]) -> list[Row]:
    """A row for each pair of which both are there, and the mean of all."""
    return _with_mean([cells.row(title, one, other) for title, one, other in pairs if one and other and one != other])


def _prior_pairs(cells: _Cells) -> Iterator[Named]:
    for loss, extras in product(LOSS_TITLES, EXTRAS_TITLES):
        title = f"{LOSS_TITLES[loss]}, {EXTRAS_TITLES[extras]}"
        yield title, cells.name(loss, "integrated", extras), cells.name(loss, "lidar", extras)


def _extras_pairs(cells: _Cells) -> Iterator[Named]:
    for loss, prior in product(LOSS_TITLES, PRIOR_TITLES):
        title = f"{LOSS_TITLES[loss]}, {PRIOR_TITLES[prior]}"
        yield title, cells.name(loss, prior, True), cells.name(loss, prior, False)


def _loss_rows(cells: _Cells) -> list[Row]:
    over_none, over_best = [], []
    for prior, extras in product(PRIOR_TITLES, EXTRAS_TITLES):
        named = {LOSS_TITLES[loss]: cells.name(loss, prior, extras) for loss in LOSS_TITLES}
        found = {title: name for title, name in named.items() if name is not None}
        without, edge = found.pop(LOSS_TITLES["none"], None), named[LOSS_TITLES["edge"]]
        where = f"{PRIOR_TITLES[prior]}, {EXTRAS_TITLES[extras]}"
        if without is not None:
            over_none += [cells.row(f"{where}: {title} over none", name, without) for title, name in found.items()]
        others = {title: name for title, name in found.items() if name != edge}
        if edge is not None and others:
            best = max(others, key=lambda title: cells.mean_psnr(others[title]))
            over_best.append(cells.row(f"{where}: edge loss over {best}, the best other", edge, others[best]))
    return [*over_none, *_with_mean(over_best, "mean of the edge loss over the best other")]


def best_rivals(results: Results) -> dict[str, MethodName]:
    """nerfacto, and of all cells with another loss than the edge loss those of the best mean PSNR, by what they are."""
    cells = _Cells(results)
    rivals = [(cell, name) for cell, name in cells.names.items() if cell.loss != "edge"]
    candidates: dict[str, list[MethodName]] = {
        "nerfacto": [name for _, name in rivals if name == "nerfacto"],
        BEST_WITHOUT_EXTRAS: [name for cell, name in rivals if not cell.extras],
        BEST_OF_ALL: [name for _, name in rivals],
    }
    return {words: max(names, key=cells.mean_psnr) for words, names in candidates.items() if names}


def _whole_rows(cells: _Cells) -> list[Row]:
    if (whole := cells.name("edge", "integrated", True)) is None:
        return []
    rivals = {words: (name, f", {_in_words(METHODS[name])}") for words, name in best_rivals(cells.results).items()}
    rivals |= {words: (name, "") for words, (name, _) in rivals.items() if words == "nerfacto"}
    return [cells.row(f"over {words}{named}", whole, name) for words, (name, named) in rivals.items()]


def _in_words(cell: Method) -> str:
    of_prior = [PRIOR_TITLES[cell.prior]] if cell.prior else []
    return ", ".join([LOSS_TITLES[cell.loss], *of_prior, EXTRAS_TITLES[cell.extras]])


def _cells_table(cells: _Cells, searches: Sequence[Grid]) -> MadeTable:
    """Every cell's own figures, with what it was trained with and how many settings were tried for it."""
    search_of = {grid.method: grid for grid in searches}
    metrics = [(scenes, metric) for _, scenes in cells.columns for metric in (cells.psnr, cells.abs_rel)]
    rows = []
    for cell, name in cells.names.items():
        figures = [cell_of(cells.results, scenes, name, metric) for scenes, metric in metrics]
        words = ["–", "–", "–"]
        if name in search_of:
            found = search_of[name]
            weight, sigma = found.best
            words = [f"{weight:g}", sigma if isinstance(sigma, str) else f"{sigma:g}", str(len(found.psnr))]
            marks = ["*" if each in found.at_the_edge else "" for each in ("λ", "σ", "tried")]
            words = [f"{word}{mark}" for word, mark in zip(words, marks, strict=True)]
        rows.append(Row(_in_words(cell), [*figures, *(Cell(None, words=word) for word in words)]))
    mark_best(rows, [*(metric.best for _, metric in metrics), 0, 0, 0])
    groups = [(name, [cells.psnr.heading, cells.abs_rel.heading]) for name, _ in cells.columns]
    notes = ["σ in metres. * at an end of the range: values beyond may be better."]
    if len({len(grid.psnr) for grid in searches}) > 1:
        notes.append("The searches have different sizes, so this comparison of cells is not fair.")
    return MadeTable("G5", "All cells", [*groups, ("", ["λ", "σ", "tried"])], rows, notes)


def grid_tables(results: Results, searches: Sequence[Grid]) -> list[MadeTable]:
    """Make the tables of a grid: prior, loss, extras, the whole, and all cells; those that there are cells for."""
    cells = _Cells(results)
    made = [
        cells.table("G1", "What the prior is worth: integrated over LiDAR", _rows(cells, _prior_pairs(cells))),
        cells.table("G2", "What the loss is worth", _loss_rows(cells)),
        cells.table("G3", "What the extras are worth: with them over without", _rows(cells, _extras_pairs(cells))),
        cells.table("G4", "What the whole is worth: edge loss, integrated, with extras", _whole_rows(cells)),
    ]
    return [*(table for table in made if table.rows), _cells_table(cells, searches)]


def grid_lines(results: Results, searched: Results) -> list[str]:
    """What was trained and how, in lines."""
    run = searched.runs[0]
    return [
        *introduction(results),
        f"λ and σ of each cell: the best mean PSNR of random held-out pixels on {' and '.join(searched.scenes())}, "
        f"which no table uses; {seeds_in_words(grids(searched))}, {run.content['steps']} steps each.",
        "Extras: colours at the surface, a sky loss, a sky colour at infinity, a decreasing λ. Monocular maps show "
        "where the sky is, so there is no sky loss with LiDAR alone.",
    ]
