"""Plots of a comparison: PSNR and AbsRel against steps and seconds, errors by angle and by distance.

Each is drawn twice, on white and for a dark page, as SVG. A file has a column for each drive; on the page each drive
has a plot of its own, which fits a phone.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from edge_depth_nerf.base.files import write_bytes
from edge_depth_nerf.base.pictures import add_legend_below
from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.tables import CLOCKS, clock_metric, curve_metric
from edge_depth_nerf.report.build import Plot

STYLES: dict[MethodName, tuple[str, str, str, str]] = {
    # on white, on dark, line, marker: rivals grey and dashed, ours in colours; also told apart without colours
    "nerfacto": ("#888888", "#9aa3ad", "--", "o"),
    "nerfacto-embedding": ("#b5b5b5", "#6f7780", ":", "x"),
    "urban-nerf": ("#b08030", "#d9a94a", "--", "s"),
    "urban-nerf-los": ("#7a5195", "#b493cc", "--", "d"),
    "ds-nerf": ("#444444", "#d5dae0", "--", "^"),
    "edge-lidar": ("#2a9d8f", "#3cc4b3", ":", "v"),
    "edge-mono": ("#8ab17d", "#a9d39a", ":", "D"),
    "edge-gaussian": ("#9b5de5", "#bb92f5", "-.", "P"),
    "edge-paper": ("#3a86ff", "#70a9ff", "-.", "X"),
    "edge-sharp": ("#e07a1f", "#ffae57", "-", "^"),
    "edge": ("#d62828", "#ff625c", "-", "o"),
}
BINS = {"by_angle_deg": "angle from the optical axis, degrees", "by_distance_m": "distance, m"}
SCANS = "scan_within"
DISTANCE_ERRORS = ("truth_abs_rel", "lidar_abs_rel")
"""Of a curve's points: the better one first."""
_INK = {False: "#1b2026", True: "#d5dae0"}
_PAPER = {False: "#ffffff", True: "#161b22"}

Line = tuple[Sequence[float], Sequence[float]]
"""x and y."""
Lines = Mapping[str, Mapping[MethodName, Sequence[Line | None]]]


def style_of(method: MethodName) -> tuple[str, str, str, str]:
    """Colour on white, on dark, line and marker; of those without their own by loss, extras and prior."""
    if method in STYLES:
        return STYLES[method]
    made = METHODS[method]
    assert made.prior is not None
    of_loss = f"edge-{made.prior}" if made.variant else "nerfacto" if made.loss == "none" else made.loss
    marker = {"lidar": "v", "mono": "<", "gaussian": ">", "integrated": "D"}[made.prior]
    return (*STYLES[of_loss][:2], "-" if made.extras else "--", marker)


def _logarithmic(axis: Axes, which: Literal["x", "y"]) -> None:
    """Let an axis be logarithmic, with plain numbers at 1, 2, 5, 10 and so on; errors have some more."""
    axis.set(**{f"{which}scale": "log"})
    scale = axis.xaxis if which == "x" else axis.yaxis
    errors = LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0), numticks=20)
    scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if which == "x" else errors)
    scale.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    scale.set_minor_formatter(NullFormatter())


def plot_lines(
    title: str, lines: Lines, label: str, rows: Sequence[tuple[str, str]], logarithmic_x: bool = True
) -> Plot:
    """Plot the lines of each method, a column for each drive and a row of axes for each figure.

    Args:
        title: what the plot shows.
        lines: by drive and method, one for each row; None: there is none.
        label: what is drawn to the right, with its unit.
        rows: name of a figure and its label; errors are drawn logarithmically.
        logarithmic_x: whether equal ratios are equally far apart.
    """

    def draw(dark: bool) -> bytes:
        # no pyplot: it would look for a display
        figure = Figure(figsize=(4.8 * len(lines), 3.2 * len(rows) + 0.3), layout="constrained")
        axes, handles = figure.subplots(len(rows), len(lines), squeeze=False), {}
        for column, (scene, methods) in enumerate(lines.items()):
            # a drive may be called $x$
            axes[0, column].set_title(scene, parse_math=False)
            axes[-1, column].set_xlabel(label)
            for row, (name, words) in enumerate(rows):
                axis: Axes = axes[row, column]
                axis.grid(alpha=0.3)
                axis.set_ylabel("" if column else words)
                for method, line in ((method, of_rows[row]) for method, of_rows in methods.items()):
                    if line is None:
                        continue
                    on_white, on_dark, pattern, symbol = style_of(method)
                    (handles[METHODS[method].title],) = axis.plot(
                        *line,
                        color=on_dark if dark else on_white,
                        linestyle=pattern,
                        marker=symbol,
                        markersize=4,
                        linewidth=2.2 if method == "edge" else 1.4,
                        zorder=3 if method == "edge" else 2,
                    )
                if name.endswith("abs_rel"):
                    _logarithmic(axis, "y")
                if logarithmic_x:
                    _logarithmic(axis, "x")
        add_legend_below(figure, list(handles.values()), list(handles), "outside lower center")
        content = io.BytesIO()
        # the same bytes for the same figures
        figure.savefig(content, format="svg", metadata={"Date": None})
        return content.getvalue()

    drawn = {}
    for dark in (False, True):
        inks = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
        papers = ("figure.facecolor", "axes.facecolor", "savefig.facecolor")
        colours: dict[Any, Any] = {**dict.fromkeys(inks, _INK[dark]), **dict.fromkeys(papers, _PAPER[dark])}
        # letters as letters: a third of the bytes that they take as outlines
        with matplotlib.rc_context({**colours, "svg.hashsalt": title, "svg.fonttype": "none"}):
            drawn[dark] = draw(dark)
    return Plot(title, light=drawn[False], dark=drawn[True])


def _lines(
    results: Results,
    scenes: Sequence[str],
    rows: Sequence[tuple[str, str]],
    line: Callable[[Sequence[RunResult], str], Line | None],
) -> Lines:
    """The lines of all methods: `line` makes one of a method's runs on a drive and the name of a figure."""
    found: dict[str, dict[MethodName, list[Line | None]]] = {}
    for scene in scenes:
        of_scene = [run for run in results.runs if run.scene == scene]
        runs_of = {method: [run for run in of_scene if run.method == method] for method in results.methods()}
        found[scene] = {method: [line(runs, name) for name, _ in rows] for method, runs in runs_of.items() if runs}
    return found


def _psnr_name(results: Results) -> str:
    return "masked PSNR" if curve_metric(results) == "psnr" else "PSNR to clean"


def _curves(results: Results, scenes: Sequence[str], title: str, key: str, label: str) -> Plot:
    """Plot how far held-out and trained-on pixels are right in the course of the training, a column for each drive."""
    psnr = curve_metric(results)
    said = _psnr_name(results)
    names = {psnr: f"{said} of held-out pixels, dB", f"trained_{psnr}": f"{said} of trained-on pixels, dB"}
    names |= dict.fromkeys(DISTANCE_ERRORS, "AbsRel of held-out pixels")
    known = [name for name in names if all(name in run.curve[-1] for run in results.runs)]
    rows = [(name, names[name]) for name in known if DISTANCE_ERRORS[0] not in known or name != DISTANCE_ERRORS[1]]

    def line(runs: Sequence[RunResult], name: str) -> Line:
        x, y = (np.mean([[point[each] for point in run.curve] for run in runs], axis=0) for each in (key, name))
        return x.tolist(), y.tolist()

    return plot_lines(title, _lines(results, scenes, rows, line), label, rows)


def _binned(results: Results, scenes: Sequence[str], title: str, key: str) -> Plot:
    """Plot errors in bins; all runs of a drive have the same."""

    def line(runs: Sequence[RunResult], name: str) -> Line | None:
        bins = [[entry for entry in run.content.get(key, []) if name in entry] for run in runs]
        x = [(entry["low"] + entry["high"]) / 2 for entry in bins[0]]
        return (x, np.mean([[entry[name] for entry in one] for one in bins], axis=0).tolist()) if x else None

    rows = [("psnr", f"{_psnr_name(results)}, dB"), ("abs_rel", "AbsRel")]
    return plot_lines(title, _lines(results, scenes, rows, line), BINS[key], rows, key == "by_distance_m")


def _of_scans(results: Results, scenes: Sequence[str], title: str) -> Plot:
    """Plot the share of a held-out scan's rays over the error that they have at most."""

    def line(runs: Sequence[RunResult], name: str) -> Line | None:
        of_runs = [run.content[SCANS] for run in runs if SCANS in run.content]
        if not of_runs:
            return None
        shares = np.mean([[100 * entry[name] for entry in each] for each in of_runs], axis=0)
        return [entry["error_m"] for entry in of_runs[0]], shares.tolist()

    rows = [("share", "share of the rays, %")]
    return plot_lines(title, _lines(results, scenes, rows, line), "largest error of the distance, m", rows)


def draw_plots(output: Path, results: Results) -> list[Plot]:
    """Draw psnr_by_steps, psnr_by_seconds, error_by_angle, error_by_distance and, of held-out scans, error_of_scans.

    Returns:
        For the page: each plot of each drive.
    """
    clock, scenes = clock_metric(results), results.scenes()
    by_time = partial(_curves, key=clock, label=f"{CLOCKS[clock].lower()} of training")
    kinds: list[tuple[str, str, Callable[[Results, Sequence[str], str], Plot]]] = [
        ("psnr_by_steps", "Training curves by steps", partial(_curves, key="step", label="steps")),
        ("psnr_by_seconds", "Training curves by time", by_time),
        ("error_by_angle", "Errors by the angle from the optical axis", partial(_binned, key="by_angle_deg")),
        ("error_by_distance", "Errors by distance", partial(_binned, key="by_distance_m")),
    ]
    if any(SCANS in run.content for run in results.runs):
        kinds.append(("error_of_scans", "Errors of held-out scans", _of_scans))
    for_the_page = []
    for name, title, plot in kinds:
        of_all = plot(results, scenes, title)
        write_bytes(output / f"{name}.svg", of_all.light)
        alone = [plot(results, [scene], f"{title}: {scene}") for scene in scenes] if len(scenes) > 1 else [of_all]
        for_the_page += alone
    return for_the_page
