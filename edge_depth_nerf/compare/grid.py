"""`edge-depth-nerf grid`: what prior, loss and extras are worth, each with all else equal, and the whole.

A figure is a difference of two cells that differ in one of the three alone; over seeds and drives as in the tables.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

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
from edge_depth_nerf.compare.options import CompareOptions, GridOptions, SearchOptions
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.search import TUNED, Grid, grids, search, seeds_in_words
from edge_depth_nerf.compare.tables import introduction, means_over, per_seed, psnr_metric
from edge_depth_nerf.report.tables import (
    Cell,
    MadeTable,
    Metric,
    Row,
    mark_best,
    mean_and_spread,
    page_of_tables,
    show_tables,
)
from edge_depth_nerf.scene.format import read_transforms

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
    searched = search(
        SearchOptions(
            scenes=options.tuning,
            output=folder,
            methods=tuple(name for name in cells if METHODS[name].loss != "none"),
            steps=options.search_steps or options.steps,
            seeds=options.seeds[:1],
            preset=options.preset,
            jobs=options.jobs,
            cluster=options.cluster,
            lambdas=options.lambdas,
            sigmas_m=options.sigmas_m,
        ),
        console,
    )
    results = compare(
        CompareOptions(
            scenes=options.scenes,
            output=comparison,
            methods=cells,
            steps=options.steps,
            seeds=options.seeds,
            preset=options.preset,
            jobs=options.jobs,
            cluster=options.cluster,
            tuned=folder / TUNED,
        ),
        console,
    )
    tables = grid_tables(results, grids(searched))
    write_text(options.output / GRID_PAGE, page_of_tables("Grid", grid_lines(results, searched), tables))
    show_tables(tables, console)
    say(console, f"What prior, loss, extras and the whole are worth: {options.output / GRID_PAGE}")
    return results


class _Cells:
    """The cells that were trained, and how two of them compare."""

    def __init__(self, results: Results) -> None:
        self.results = results
        there = results.methods()
        self.names: dict[Method, MethodName] = {cell: name for cell, name in GRID.items() if name in there}
        self.columns = means_over(results.scenes())
        truth = all("truth_abs_rel" in run.figures for run in results.runs)
        self.psnr = psnr_metric(results)
        self.abs_rel = Metric("truth_abs_rel" if truth else "lidar_abs_rel", "AbsRel ↓", ".3f", -1)

    def name(self, loss: Loss, prior: PriorName, extras: bool) -> MethodName | None:
        """The method of a cell; without a loss and extras there is one for both priors."""
        return self.names.get(Method(loss, None if loss == "none" and not extras else prior, extras))

    def by_seed(self, scenes: Sequence[str], name: MethodName, metric: Metric) -> dict[int, float]:
        """Means over drives."""
        return per_seed(self.results, scenes, name, lambda run: run.figures.get(metric.name))

    def mean_psnr(self, name: MethodName) -> float:
        """Mean over drives and seeds, dB; minus infinity without a whole row."""
        found = self.by_seed(self.results.scenes(), name, self.psnr)
        return statistics.fmean(found.values()) if found else float("-inf")

    def row(self, title: str, one: MethodName, other: MethodName) -> Row:
        """By how much one is ahead of another, over the seeds that both have."""
        figures = []
        for _, scenes in self.columns:
            ours, theirs = (self.by_seed(scenes, name, self.psnr) for name in (one, other))
            found = mean_and_spread([ours[seed] - theirs[seed] for seed in ours if seed in theirs])
            figures.append(Cell(*found, form="+.2f"))
            ours, theirs = (self.by_seed(scenes, name, self.abs_rel) for name in (one, other))
            figures.append(Cell(*mean_and_spread([ours[seed] / theirs[seed] for seed in ours if seed in theirs])))
        return Row(title, figures)

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


def _prior_rows(cells: _Cells) -> list[Row]:
    rows = []
    for loss, title in LOSS_TITLES.items():
        for extras, words in EXTRAS_TITLES.items():
            one, other = cells.name(loss, "integrated", extras), cells.name(loss, "lidar", extras)
            if one is not None and other is not None and one != other:
                rows.append(cells.row(f"{title}, {words}", one, other))
    return _with_mean(rows)


def _loss_rows(cells: _Cells) -> list[Row]:
    over_none, over_best = [], []
    for prior, of_prior in PRIOR_TITLES.items():
        for extras, words in EXTRAS_TITLES.items():
            found: dict[Loss, MethodName] = {
                loss: name for loss in LOSS_TITLES if (name := cells.name(loss, prior, extras)) is not None
            }
            without, edge = found.pop("none", None), found.get("edge")
            where = f"{of_prior}, {words}"
            if without is not None:
                over_none += [
                    cells.row(f"{where}: {LOSS_TITLES[loss]} over none", name, without) for loss, name in found.items()
                ]
            others: dict[Loss, MethodName] = {loss: name for loss, name in found.items() if loss != "edge"}
            if edge is not None and others:
                best = max(others, key=lambda loss: cells.mean_psnr(others[loss]))
                title = f"{where}: edge loss over {LOSS_TITLES[best]}, the best other"
                over_best.append(cells.row(title, edge, others[best]))
    return [*over_none, *_with_mean(over_best, "mean of the edge loss over the best other")]


def _extras_rows(cells: _Cells) -> list[Row]:
    rows = []
    for loss, title in LOSS_TITLES.items():
        for prior, of_prior in PRIOR_TITLES.items():
            one, other = cells.name(loss, prior, True), cells.name(loss, prior, False)
            if one is not None and other is not None:
                rows.append(cells.row(f"{title}, {of_prior}", one, other))
    return _with_mean(rows)


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
    whole = cells.name("edge", "integrated", True)
    if whole is None:
        return []
    rows = []
    for words, best in best_rivals(cells.results).items():
        named = "" if words == "nerfacto" else f", {_in_words(METHODS[best])}"
        rows.append(cells.row(f"over {words}{named}", whole, best))
    return rows


def _in_words(cell: Method) -> str:
    of_prior = [PRIOR_TITLES[cell.prior]] if cell.prior else []
    return ", ".join([LOSS_TITLES[cell.loss], *of_prior, EXTRAS_TITLES[cell.extras]])


def _cells_table(cells: _Cells, searches: Sequence[Grid]) -> MadeTable:
    """Every cell's own figures, with what it was trained with and how many settings were tried for it."""
    search_of = {grid.method: grid for grid in searches}
    metrics = [(scenes, metric) for _, scenes in cells.columns for metric in (cells.psnr, cells.abs_rel)]
    rows = []
    for cell, name in cells.names.items():
        figures = [
            Cell(*mean_and_spread(list(cells.by_seed(scenes, name, metric).values())), form=metric.form)
            for scenes, metric in metrics
        ]
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
        cells.table("G1", "What the prior is worth: integrated over LiDAR", _prior_rows(cells)),
        cells.table("G2", "What the loss is worth", _loss_rows(cells)),
        cells.table("G3", "What the extras are worth: with them over without", _extras_rows(cells)),
        cells.table("G4", "What the whole is worth: edge loss, integrated, with extras", _whole_rows(cells)),
    ]
    return [*(table for table in made if table.rows), _cells_table(cells, searches)]


def _sweeps_lines(scenes: Mapping[str, Path]) -> list[str]:
    """How many sweeps the LiDAR maps are of, where the scenes say that."""
    found = {name: read_transforms(folder / "transforms.json").get("source") for name, folder in scenes.items()}
    words = [
        f"{2 * source['sweeps'] + 1} sweeps in each map of {name}"
        for name, source in found.items()
        if isinstance(source, dict) and isinstance(source.get("sweeps"), int)
    ]
    return [f"LiDAR: {', '.join(words)}."] if words else []


def grid_lines(results: Results, searched: Results) -> list[str]:
    """What was trained and how, in lines."""
    run = searched.runs[0]
    return [
        *introduction(results),
        *_sweeps_lines({run.scene: Path(run.specification["scene"]) for run in results.runs}),
        f"λ and σ of each cell: the best mean PSNR of random held-out pixels on {' and '.join(searched.scenes())}, "
        f"which no table uses; {seeds_in_words(grids(searched))}, {run.content['steps']} steps each.",
        "Extras: colours at the surface, a sky loss, a sky colour at infinity, a decreasing λ. Monocular maps show "
        "where the sky is, so there is no sky loss with LiDAR alone.",
    ]
