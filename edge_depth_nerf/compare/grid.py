"""What `compare --grid` says: what prior, loss and extras are worth, each with all else equal, and the whole.

A figure is a difference of two cells that differ in one of the three alone; over seeds and drives as in the tables.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from edge_depth_nerf.compare.methods import (
    EXTRAS_TITLES,
    GRID,
    LOSS_TITLES,
    METHODS,
    PRIOR_TITLES,
    Cell,
    Loss,
    PriorName,
)
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.search import Grid, grids, seeds_in_words
from edge_depth_nerf.compare.tables import introduction, per_seed, psnr_metric
from edge_depth_nerf.report.tables import Cell as Figure
from edge_depth_nerf.report.tables import MadeTable, Metric, Row, mark_best, mean_and_spread
from edge_depth_nerf.scene.format import read_transforms

BEST_WITHOUT_EXTRAS, BEST_OF_ALL = "the best rival without extras", "the best rival of all"
NOTE = "dB: the gain in PSNR. AbsRel ×: AbsRel divided by the other's; below 1 is better."


class _Judged:
    """The cells that were trained, and how two of them compare."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.cells: dict[Cell, MethodName] = {cell: name for cell, name in GRID.items() if name in results.methods()}
        scenes = results.scenes()
        self.columns = [*((scene, [scene]) for scene in scenes), *([("average", scenes)] if len(scenes) > 1 else [])]
        truth = all("truth_abs_rel" in run.figures for run in results.runs)
        self.psnr = psnr_metric(results)
        self.abs_rel = Metric("truth_abs_rel" if truth else "lidar_abs_rel", "AbsRel ↓", ".3f", -1)

    def name(self, loss: Loss, prior: PriorName, extras: bool) -> MethodName | None:
        """The method of a cell; without a loss and extras there is one for both priors."""
        return self.cells.get(Cell(loss, None if loss == "none" and not extras else prior, extras))

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
            figures.append(Figure(*mean_and_spread([ours[seed] - theirs[seed] for seed in ours if seed in theirs])))
            ours, theirs = (self.by_seed(scenes, name, self.abs_rel) for name in (one, other))
            figures.append(Figure(*mean_and_spread([ours[seed] / theirs[seed] for seed in ours if seed in theirs])))
        for figure in figures[::2]:
            figure.form = "+.2f"
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
        figures.append(Figure(statistics.fmean(values) if values else None, form=figure.form))
    return [*rows, Row(title, figures)]


def _prior_rows(judged: _Judged) -> list[Row]:
    rows = []
    for loss, title in LOSS_TITLES.items():
        for extras, words in EXTRAS_TITLES.items():
            one, other = judged.name(loss, "integrated", extras), judged.name(loss, "lidar", extras)
            if one is not None and other is not None and one != other:
                rows.append(judged.row(f"{title}, {words}", one, other))
    return _with_mean(rows)


def _loss_rows(judged: _Judged) -> list[Row]:
    over_none, over_best = [], []
    for prior, of_prior in PRIOR_TITLES.items():
        for extras, words in EXTRAS_TITLES.items():
            found: dict[Loss, MethodName] = {
                loss: name for loss in LOSS_TITLES if (name := judged.name(loss, prior, extras)) is not None
            }
            without, edge = found.pop("none", None), found.get("edge")
            where = f"{of_prior}, {words}"
            if without is not None:
                over_none += [
                    judged.row(f"{where}: {LOSS_TITLES[loss]} over none", name, without) for loss, name in found.items()
                ]
            others: dict[Loss, MethodName] = {loss: name for loss, name in found.items() if loss != "edge"}
            if edge is not None and others:
                best = max(others, key=lambda loss: judged.mean_psnr(others[loss]))
                title = f"{where}: edge loss over {LOSS_TITLES[best]}, the best other"
                over_best.append(judged.row(title, edge, others[best]))
    return [*over_none, *_with_mean(over_best, "mean of the edge loss over the best other")]


def _extras_rows(judged: _Judged) -> list[Row]:
    rows = []
    for loss, title in LOSS_TITLES.items():
        for prior, of_prior in PRIOR_TITLES.items():
            one, other = judged.name(loss, prior, True), judged.name(loss, prior, False)
            if one is not None and other is not None:
                rows.append(judged.row(f"{title}, {of_prior}", one, other))
    return _with_mean(rows)


def best_rivals(results: Results) -> dict[str, MethodName]:
    """nerfacto, and of all cells with another loss than the edge loss those of the best mean PSNR, by what they are."""
    return _best_rivals(_Judged(results))


def _best_rivals(judged: _Judged) -> dict[str, MethodName]:
    rivals: list[tuple[Cell, MethodName]] = [(cell, name) for cell, name in judged.cells.items() if cell.loss != "edge"]
    candidates: dict[str, list[MethodName]] = {
        "nerfacto": [name for cell, name in rivals if cell == Cell("none", None, False)],
        BEST_WITHOUT_EXTRAS: [name for cell, name in rivals if not cell.extras],
        BEST_OF_ALL: [name for _, name in rivals],
    }
    return {words: max(names, key=judged.mean_psnr) for words, names in candidates.items() if names}


def _whole_rows(judged: _Judged) -> list[Row]:
    whole = judged.name("edge", "integrated", True)
    if whole is None:
        return []
    rows = []
    for words, best in _best_rivals(judged).items():
        named = "" if words == "nerfacto" else f", {_in_words(best)}"
        rows.append(judged.row(f"over {words}{named}", whole, best))
    return rows


def _in_words(name: MethodName) -> str:
    cell = METHODS[name].cell
    assert cell is not None
    of_prior = "" if cell.prior is None else f", {PRIOR_TITLES[cell.prior]}"
    return f"{LOSS_TITLES[cell.loss]}{of_prior}, {EXTRAS_TITLES[cell.extras]}"


def _cells_table(judged: _Judged, searches: Sequence[Grid]) -> MadeTable:
    """Every cell's own figures, with what it was trained with and how many settings were tried for it."""
    search_of = {grid.method: grid for grid in searches}
    rows = []
    for name in judged.cells.values():
        figures = [
            Figure(*mean_and_spread(list(judged.by_seed(scenes, name, metric).values())), form=metric.form)
            for _, scenes in judged.columns
            for metric in (judged.psnr, judged.abs_rel)
        ]
        search = search_of.get(name)
        if search is None:
            words = ["–", "–", "–"]
        else:
            weight, sigma = search.best
            words = [f"{weight:g}", sigma if isinstance(sigma, str) else f"{sigma:g}", str(len(search.psnr))]
            marks = ["*" if each in search.at_the_edge else "" for each in ("λ", "σ", "tried")]
            words = [f"{word}{mark}" for word, mark in zip(words, marks, strict=True)]
        rows.append(Row(_in_words(name), [*figures, *(Figure(None, words=word) for word in words)]))
    better = [metric.best for _ in judged.columns for metric in (judged.psnr, judged.abs_rel)]
    mark_best(rows, [*better, 0, 0, 0])
    groups = [(name, [judged.psnr.heading, judged.abs_rel.heading]) for name, _ in judged.columns]
    notes = ["σ in metres. * at an end of the range: values beyond may be better."]
    budgets = {len(grid.psnr) for grid in searches}
    if len(budgets) > 1:
        notes.append("The searches have different sizes, so this comparison of cells is not fair.")
    return MadeTable("G5", "All cells", [*groups, ("", ["λ", "σ", "tried"])], rows, notes)


def grid_tables(results: Results, searches: Sequence[Grid]) -> list[MadeTable]:
    """Make the tables of a grid: prior, loss, extras, the whole, and all cells; those that there are cells for."""
    judged = _Judged(results)
    made = [
        judged.table("G1", "What the prior is worth: integrated over LiDAR", _prior_rows(judged)),
        judged.table("G2", "What the loss is worth", _loss_rows(judged)),
        judged.table("G3", "What the extras are worth: with them over without", _extras_rows(judged)),
        judged.table("G4", "What the whole is worth: edge loss, integrated, with extras", _whole_rows(judged)),
    ]
    return [*(table for table in made if table.rows), _cells_table(judged, searches)]


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
