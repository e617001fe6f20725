"""What the paper's four tables compare, and what it does not: geometry, views beside the path, time, λ and σ.

A cell is a mean over seeds with its sample standard deviation; an average over drives is taken for each seed first.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import sub, truediv
from pathlib import Path
from typing import Any

import numpy as np

from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.specification import OF_A_RUN
from edge_depth_nerf.report.tables import Cell, MadeTable, Metric, Row, mark_best, mean_and_spread

PAPER_AHEAD_DB: dict[str, dict[MethodName, float]] = {
    "1": {"nerfacto": 0.65, "ds-nerf": 0.44},
    "2": {"nerfacto": 0.12, "ds-nerf": 0.04},
}
"""By how much the published method is ahead of a row, by the paper's Tables 1 and 2, dB of PSNR."""
MAPS = {"scene": "of a network trained on the drive", "elsewhere": "made elsewhere"}
"""What made monocular maps, by where that was trained."""
KITTI360, JBNU = "kitti360", "jbnu-depth360"
"""The kinds of source whose drives are in the paper's Tables 1 and 2; all others come to the first table."""

AVERAGES = (
    "The paper's averages do not follow from its rows. The differences shown are those that it states for its averages."
)
TEXT = "Some figures of the paper differ between its text and its tables."
INTEGRATED = "In the paper the integrated depth is ahead of both sources."
EDGE_AWARE = "In the paper the edge-aware kernel is ahead."
SAME_ROW = (
    "The paper's row of LiDAR alone (its Table 3) is its row of DS-NeRF (its Table 1), which has another loss. Here "
    "both are trained, and these rows differ only in the source of depth."
)


PSNR = Metric("masked_psnr", "masked PSNR ↑", ".2f")
TRUE_PSNR = Metric("truth_masked_psnr", "PSNR to clean ↑", ".2f")


def means_over(scenes: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Each drive alone and, of several, their average: a title and the drives."""
    return [*((scene, [scene]) for scene in scenes), *([("average", [*scenes])] if len(scenes) > 1 else [])]


def _per_seed(results: Results, scenes: Sequence[str], method: MethodName, metric: Metric) -> dict[int, float]:
    """Mean over drives of a figure, for each seed that all drives have it for."""
    found = {}
    for seed in results.seeds():
        runs = [results.run(scene, method, seed) for scene in scenes]
        values = [None if run is None else run.figures.get(metric.name) for run in runs]
        if all(entry is not None for entry in values):
            found[seed] = statistics.fmean(entry for entry in values if entry is not None)
    return found


def cell_of(results: Results, scenes: Sequence[str], method: MethodName, metric: Metric) -> Cell:
    """A method's figure, as a mean over drives and seeds."""
    found = list(_per_seed(results, scenes, method, metric).values())
    return Cell(None, words="never") if math.inf in found else Cell(*mean_and_spread(found), form=metric.form)


def compared(results: Results, scenes: Sequence[str], one: MethodName, other: MethodName, metric: Metric) -> Cell:
    """By how much one is ahead, or where less is better its share of the other's, over the seeds that both have."""
    ours, theirs = (_per_seed(results, scenes, name, metric) for name in (one, other))
    compare, form = (sub, "+.2f") if metric.best > 0 else (truediv, ".2f")
    return Cell(*mean_and_spread([compare(ours[seed], theirs[seed]) for seed in ours if seed in theirs]), form=form)


def psnr_metric(results: Results) -> Metric:
    """PSNR against ground truth where all drives have it, else against the pictures."""
    return TRUE_PSNR if all(TRUE_PSNR.name in run.figures for run in results.runs) else PSNR


def _quality_table(
    results: Results,
    title: str,
    scenes: list[str],
    methods: Sequence[MethodName],
    published: Mapping[MethodName, float],
) -> MadeTable:
    """PSNR, SSIM, FLIP and, where the weights were there, LPIPS, all inside the mask."""
    truth = "truth_" if psnr_metric(results) is TRUE_PSNR else ""
    metrics = [
        psnr_metric(results),
        Metric(f"{truth}masked_ssim", "SSIM ↑", ".3f"),
        Metric(f"{truth}masked_flip", "FLIP ↓", ".3f", -1),
        Metric(f"{truth}masked_lpips", "LPIPS ↓", ".3f", -1),
    ]
    metrics = [metric for metric in metrics if metric.name in results.figure_names()]
    columns = means_over(scenes)
    groups = [(name, [metric.heading for metric in metrics]) for name, _ in columns]
    rows = []
    for method in methods:
        cells = [cell_of(results, chosen, method, metric) for _, chosen in columns for metric in metrics]
        if "edge" in methods:
            cells.append(Cell(None) if method == "edge" else compared(results, scenes, "edge", method, metrics[0]))
            cells += [Cell(published.get(method), form="+.2f")] if published else []
        rows.append(Row(METHODS[method].title, cells))
    if "edge" in methods:
        groups.append(("ours ahead", ["dB", "paper, dB"] if published else ["dB"]))
    better = [metric.best for _ in columns for metric in metrics]
    mark_best(rows, better + [0] * (len(rows[0].cells) - len(better)))
    return MadeTable("", title, groups, rows, [AVERAGES, TEXT] if published else [])


def psnr_at(curve: Sequence[dict[str, float]], seconds: float, name: str, clock: str) -> float:
    """PSNR of a curve at a time, between its points in a straight line; before the first it is that of the first."""
    return float(np.interp(seconds, [point[clock] for point in curve], [point[name] for point in curve]))


def steps_to(curve: Sequence[dict[str, float]], psnr: float, name: str) -> float:
    """Steps after which a curve first reaches a PSNR; infinity if it never does."""
    reached = next((number for number, point in enumerate(curve) if point[name] >= psnr), None)
    if reached is None:
        return math.inf
    around = curve[max(reached - 1, 0) : reached + 1]
    return float(np.interp(psnr, [point[name] for point in around], [point["step"] for point in around]))


def curve_metric(results: Results) -> str:
    """The PSNR of the random pixels that all curves have: against ground truth, if it is known."""
    return "truth_psnr" if all("truth_psnr" in run.curve[-1] for run in results.runs) else "psnr"


CLOCKS = {"seconds": "Seconds", "cpu_seconds": "Processor seconds"}


def clock_metric(results: Results) -> str:
    """What time is counted in: on the CPU its own time, which other work on the machine does not change."""
    on_cpu = all(run.content["device"] == "cpu" for run in results.runs)
    return "cpu_seconds" if on_cpu else "seconds"


def _table(
    results: Results, title: str, scenes: Sequence[str], groups: Mapping[str, Sequence[Metric]], note: str
) -> MadeTable:
    """A row for each method, and groups of columns, as far as any run has their figures."""
    names = results.figure_names()
    there = {group: [metric for metric in metrics if metric.name in names] for group, metrics in groups.items()}
    every = [metric for metrics in there.values() for metric in metrics]
    rows = [
        Row(METHODS[method].title, [cell_of(results, scenes, method, metric) for metric in every])
        for method in results.methods()
    ]
    mark_best(rows, [metric.best for metric in every])
    headings = [(group, [metric.heading for metric in metrics]) for group, metrics in there.items() if metrics]
    return MadeTable("", title, headings, rows, [note])


def _geometry_table(results: Results, where: str, scenes: Sequence[str]) -> MadeTable:
    """Pictures after a colour fit, distances, and views beside the path."""
    truth = "truth_" if psnr_metric(results) is TRUE_PSNR else ""
    reference, known = ("truth", "the ground truth") if truth else ("lidar", "the held-out LiDAR")
    metrics = [
        psnr_metric(results),
        Metric(f"{truth}affine_masked_psnr", "fitted ↑", ".2f"),
        *([PSNR] if truth else []),
        Metric(f"detail_{truth}masked_psnr", "with detail ↑", ".2f"),
        Metric(f"{reference}_abs_rel", "AbsRel ↓", ".3f", -1),
        Metric(f"{reference}_rmse_m", "RMSE m ↓", ".2f", -1),
        Metric(f"{reference}_delta_1_25", "δ<1.25 ↑", ".3f"),
        Metric("shifted_1m_masked_psnr", "1 m beside ↑", ".2f"),
        Metric("shifted_2m_masked_psnr", "2 m beside ↑", ".2f"),
        Metric("detail_shifted_1m_masked_psnr", "1 m beside, with detail ↑", ".2f"),
    ]
    notes = {
        "fitted": "Fitted: PSNR after an affine fit of each view's colours.",
        PSNR.heading: "Masked PSNR: against the recorded picture.",
        TRUE_PSNR.heading: "PSNR to clean: against the picture without noise and exposure drift.",
        "AbsRel": f"AbsRel, RMSE, δ: rendered median distance against {known}, 1-60 m, over all pixels together, "
        "without sky.",
        "detail": "With detail: PSNR with what training pictures show beyond their own renderings.",
        "beside": "Beside: PSNR of views moved sideways.",
    }
    headings = " ".join(metric.heading for metric in metrics if metric.name in results.figure_names())
    note = " ".join(text for word, text in notes.items() if word in headings)
    return _table(results, f"Pictures and geometry, {where}", scenes, {"": metrics}, note)


def _edges_table(results: Results, where: str, scenes: Sequence[str]) -> MadeTable:
    """Edges beside PSNR: on the path, beside it, and of cameras that are held out."""
    truth = "truth_" if psnr_metric(results) is TRUE_PSNR else ""
    depth_edges = f"{'truth' if truth else 'lidar'}_depth_edge_recall"
    shifts = {name.split("_")[1] for name in results.figure_names() if name.startswith("shifted_")}
    groups = {}
    for title, form, on_path, beside in (
        (psnr_metric(results).heading, ".2f", f"{truth}masked_psnr", "masked_psnr"),
        ("edges ↑", ".3f", f"{truth}edge_recall", "edge_recall"),
        ("depth edges ↑", ".3f", depth_edges, "truth_depth_edge_recall"),
    ):
        further = (Metric(f"shifted_{shift}_{beside}", f"{shift[:-1]} m", form) for shift in shifts)
        groups[title] = [Metric(on_path, "0 m", form), *sorted(further, key=lambda metric: float(metric.heading[:-2]))]
    groups["held-out cameras"] = [
        Metric(f"camera_{truth}affine_masked_psnr", "PSNR, fitted ↑", ".2f"),
        Metric(f"camera_{truth}edge_recall", "edges ↑", ".3f"),
        Metric(f"camera_{depth_edges}", "depth edges ↑", ".3f"),
    ]
    note = (
        "Metres to the left of the path. Edges: the share of the picture's edges that the view has within two pixels, "
        f"in the same direction. Depth edges: the same of {'the ground truth' if truth else 'the held-out LiDAR'}."
    )
    made = _table(results, f"Edges, and views beside the path, {where}", scenes, groups, note)
    if made.groups[-1][0] == "held-out cameras":
        made.notes += ["Held-out cameras: training saw no picture of them; PSNR is after the colour fit."]
    return made


def _scans_table(results: Results, where: str, scenes: Sequence[str]) -> MadeTable:
    """Rendered distances along the rays of held-out sweeps."""
    metrics = [
        Metric("scan_median_m", "median m ↓", ".3f", -1),
        Metric("scan_within_10_cm", "within 10 cm ↑", ".1%"),
        Metric("scan_within_30_cm", "within 30 cm ↑", ".1%"),
        Metric("scan_abs_rel", "AbsRel ↓", ".3f", -1),
        Metric("scan_far_25", "25 % too far ↓", ".1%", -1),
        Metric("scan_short_25", "25 % too short ↓", ".1%", -1),
        Metric("scan_foliage_abs_rel", "foliage: AbsRel ↓", ".3f", -1),
        Metric("scan_foliage_far_25", "foliage: 25 % too far ↓", ".1%", -1),
    ]
    note = (
        "Errors of the rendered median distance along the scanner's own rays, 1-60 m, that end inside a held-out "
        "picture. Foliage: rays whose neighbours' lengths scatter by 2 % or more; fences and outlines, too."
    )
    return _table(results, f"Held-out scans, {where}", scenes, {"": metrics}, note)


def _time_table(results: Results, where: str, scenes: Sequence[str]) -> MadeTable:
    """Seconds, and the PSNR that they bring."""
    name, clock = curve_metric(results), clock_metric(results)

    def timed(run: RunResult) -> RunResult:
        last = run.curve[-1]
        figures = {"of a step": last[clock] / run.content["steps"], "of all": last[clock], "final": last[name]}
        if ours := results.run(run.scene, "edge", run.seed):
            figures["at ours"] = psnr_at(run.curve, ours.curve[-1][clock], name, clock)
        if base := results.run(run.scene, "nerfacto", run.seed):
            # one run that never gets there leaves no mean
            figures["to nerfacto"] = steps_to(run.curve, base.curve[-1][name], name)
        return replace(run, content={"figures": figures})

    metrics = [
        Metric("of a step", "s per step", ".3f", 0),
        Metric("of all", "seconds", ".0f", 0),
        Metric("at ours", "PSNR at our seconds ↑", ".2f"),
        Metric("final", "final PSNR ↑", ".2f"),
        Metric("to nerfacto", "steps to nerfacto's final PSNR ↓", ".0f", -1),
    ]
    note = (
        f"{CLOCKS[clock]} of training, without evaluation, saving and making priors. PSNR is of random held-out "
        "pixels. A method that ends before ours keeps its last PSNR."
    )
    return _table(Results([*map(timed, results.runs)]), f"Time, {where}", scenes, {"": metrics}, note)


def listed(found: Any) -> list[str]:
    """What a file has as one, as several, or not at all."""
    return [] if found is None else [str(each) for each in (found if isinstance(found, list) else [found])]


def _settings_table(results: Results) -> MadeTable:
    def words(method: MethodName, name: str) -> str:
        values = {run.content[name] for run in results.runs if run.method == method}
        texts = ("–" if each is None else each if isinstance(each, str) else f"{each:g}" for each in values)
        return ", ".join(sorted(texts))

    rows = []
    for method in results.methods():
        found = any(run.method == method and run.specification.get("weight") is not None for run in results.runs)
        searched = "–" if METHODS[method].loss == "none" else "searched" if found else "default"
        texts = (words(method, "lambda"), words(method, "sigma"), searched)
        rows.append(Row(METHODS[method].title, [Cell(None, words=text) for text in texts]))
    notes = ["σ in metres, or the mode that gives the prior's own σ at each pixel."]
    if drives := listed(results.options.get("tuned_on")):
        notes.append(f"Searched on {' and '.join(Path(drive).name for drive in drives)}.")
        if {run.specification["scene"] for run in results.runs}.intersection(drives):
            notes.append("These tables include a drive of the search: its figures flatter the searched values.")
    return MadeTable("", "λ and σ", [("", ["λ", "σ", "from"])], rows, notes)


def fields_table(results: Results) -> MadeTable:
    """Each field of the trained configurations in which a method differs from another, and what each method has there.

    It is made from what was trained, not from what the methods name. A run's own seed, scene and folder are left out.
    """
    runs = [next(run for run in results.runs if run.method == name) for name in results.methods()]
    configurations = [run.content["configuration"] for run in runs]
    rows = [
        Row(name, [Cell(None, words=str(each.get(name, "–")).strip("'")) for each in configurations])
        for name in sorted({name for each in configurations for name in each} - {*OF_A_RUN})
        if len({each.get(name) for each in configurations}) > 1
    ]
    headings = [METHODS[run.method].title for run in runs]
    note = "From the trained configurations. All other fields are equal."
    return MadeTable("", "Fields in which the methods differ", [("", headings)], rows, [note], on_terminal=False)


def make_tables(results: Results) -> list[MadeTable]:
    """Make the tables that the runs are enough for, numbered from 1; those for a terminal come first."""
    kinds, everywhere = {run.scene: run.content.get("source") for run in results.runs}, results.scenes()
    of_jbnu = [scene for scene in everywhere if kinds[scene] == JBNU]
    # each loss with each prior and extras that was trained; the last two have ours with one thing changed
    of_other_losses = [name for name, method in METHODS.items() if method.loss != "edge" and not method.variant]
    rivals = ["nerfacto-embedding", *of_other_losses, "edge-paper", "edge", "edge-sharp"]
    of_the_paper = ", drives of KITTI-360's kind" if {*kinds.values()} <= {KITTI360, JBNU} else ""
    wanted = [
        ("1", f"Rivals{of_the_paper}", [scene for scene in everywhere if scene not in of_jbnu], rivals, []),
        ("2", "Rivals, drives of JBNU-Depth360", of_jbnu, rivals, []),
        ("3", "Source of depth", everywhere, ["edge-lidar", "edge-mono", "edge"], [INTEGRATED, SAME_ROW]),
        ("4", "Kernel of the integration", everywhere, ["edge-gaussian", "edge"], [EDGE_AWARE]),
    ]
    for number, title, _, names, notes in wanted[2:]:
        literal = [name.replace("edge", "edge-paper", 1) for name in names]
        wanted.append((number, f"{title}, the published method", everywhere, literal, notes[:1]))
    with_paper = results.options.get("preset") == "paper"
    tables = []
    for number, title, scenes, names, notes in wanted:
        there = {run.method for run in results.runs if run.scene in scenes}
        methods = [name for name in names if name in there]
        if len(methods) > 1:
            published = PAPER_AHEAD_DB.get(number, {}) if with_paper else {}
            full_title = f"{title} (the paper's Table {number})" if with_paper else title
            made = _quality_table(results, full_title, scenes, methods, published)
            made.notes += notes if with_paper else []
            tables.append(made)
    # the average stands for its drives, which the page folds away
    *drives, first = means_over(everywhere)
    figures = results.figure_names()
    wide = [_edges_table] * any(name.endswith("edge_recall") for name in figures)
    wide += [_scans_table] * ("scan_median_m" in figures)
    for where, scenes in (first, *drives):
        for make in (_geometry_table, _time_table, *wide):
            # of many columns a terminal shows nothing
            fits = where == first[0] and make not in wide
            tables.append(replace(make(results, where, scenes), on_terminal=fits))
    tables = sorted([*tables, _settings_table(results)], key=lambda made: not made.on_terminal)
    return [replace(made, label=str(number)) for number, made in enumerate(tables, 1)]


def verdict(results: Results) -> str:
    """Say in a sentence what ours has over nerfacto, as means over drives and seeds; empty without both of them."""
    scenes = results.scenes()
    ahead_db = compared(results, scenes, "edge", "nerfacto", psnr_metric(results)).mean
    if ahead_db is None:
        return ""
    word = "better" if ahead_db >= 0 else "worse"
    text = f"Ours renders held-out pictures {abs(ahead_db):.1f} dB {word} than nerfacto (PSNR, a measure of quality)"
    for reference in ("truth", "lidar"):
        error = Metric(f"{reference}_abs_rel", "AbsRel", ".3f")
        ours, theirs = (cell_of(results, scenes, method, error).mean for method in ("edge", "nerfacto"))
        if ours is not None and theirs is not None:
            return f"{text}; its distances are wrong by {ours:.1%} on average, nerfacto's by {theirs:.1%}."
    return f"{text}."


def introduction(results: Results) -> list[str]:
    """What was compared and how, in lines."""
    steps = sorted({run.content["steps"] for run in results.runs})
    seeds = [
        f"{METHODS[name].title} {', '.join(str(seed) for seed in results.seeds() if results.has(name, seed))}"
        for name in results.methods()
    ]
    clean = psnr_metric(results) is TRUE_PSNR
    against = "the picture without noise and exposure drift (to clean)" if clean else "the recorded picture"
    lines = [
        f"Preset {results.options.get('preset')}, {' and '.join(map(str, steps))} steps per run; drives "
        f"{', '.join(results.scenes())}.",
        "Seeds: " + "; ".join(seeds) + ".",
        f"Means over held-out views, PSNR in dB, inside the mask, against {against}; ± the standard deviation over "
        "seeds. Bold: the best of a column.",
        "Versions: " + ", ".join(f"{name} {number}" for name, number in results.versions.items()) + ".",
    ]
    if any(name.endswith("masked_flip") for name in results.figure_names()):
        lines.append("FLIP: the difference that a viewer sees, 0 (none) to 1.")
    if not any(name.endswith("lpips") for name in results.figure_names()):
        lines.append("LPIPS is missing: its weights were not on this machine.")
    maps = []
    for trained_on, title in MAPS.items():
        scenes = sorted({run.scene for run in results.runs if run.content.get("mono_trained_on") == trained_on})
        maps += [f"{title} ({', '.join(scenes)})"] if scenes else []
    lines += [f"Monocular maps: {'; '.join(maps)}."] if maps else []
    departures = sorted({text for run in results.runs for text in run.content.get("departures", [])})
    if departures:
        lines.append("Departures from the paper: " + "; ".join(departures) + ".")
    return lines
