"""Plots of a comparison: PSNR and AbsRel against steps and seconds, errors by angle and by distance.

Each is drawn twice, on white and for a dark page, as SVG. A file has a column for each drive; on the page each drive
has a plot of its own, which fits a phone.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.artist import Artist
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
    "edge": ("#d62828", "#ff625c", "-", "o"),
}
BINS = {"by_angle_deg": "angle from the optical axis, degrees", "by_distance_m": "distance, m"}
PSNR_LABEL = "PSNR, dB"
DISTANCE_ERRORS = ("truth_abs_rel", "lidar_abs_rel")
"""Of a curve's points: the better one first."""
_INK = {False: "#1b2026", True: "#d5dae0"}
_PAPER = {False: "#ffffff", True: "#161b22"}

Bins = Sequence[Mapping[str, float]]
"""As `BinnedErrors.compute` gives them."""
Line = tuple[Sequence[float], Sequence[float]]
"""x and y."""


def _axes(titles: Sequence[str], rows: int) -> tuple[Figure, np.ndarray]:
    # no pyplot: it would look for a display
    figure = Figure(figsize=(4.8 * len(titles), 3.2 * rows + 0.3), layout="constrained")
    axes = figure.subplots(rows, len(titles), squeeze=False)
    for axis, title in zip(axes[0], titles, strict=True):
        # a drive may be called $x$
        axis.set_title(title, parse_math=False)
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    return figure, axes


def _labelled(axis: Axes) -> list[tuple[str, Artist]]:
    handles, labels = axis.get_legend_handles_labels()
    return list(zip(labels, handles, strict=True))


def _logarithmic(axis: Axes) -> None:
    """Let x be logarithmic, with plain numbers at 1, 2, 5, 10 and so on."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _logarithmic_errors(axis: Axes) -> None:
    """Let y be logarithmic, with plain numbers."""
    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0, 7.0), numticks=20))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.yaxis.set_minor_formatter(NullFormatter())


def _finished(figure: Figure, axes: np.ndarray) -> bytes:
    handles = dict(pair for axis in axes.flat for pair in _labelled(axis))
    add_legend_below(figure, list(handles.values()), list(handles), "outside lower center")
    content = io.BytesIO()
    # the same bytes for the same figures
    figure.savefig(content, format="svg", metadata={"Date": None})
    return content.getvalue()


def _twice(title: str, draw: Callable[[bool], bytes]) -> Plot:
    drawn = {}
    for dark in (False, True):
        ink = dict.fromkeys(
            ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), _INK[dark]
        )
        paper = dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), _PAPER[dark])
        # letters as letters: a third of the bytes that they take as outlines
        with matplotlib.rc_context({**ink, **paper, "svg.hashsalt": title, "svg.fonttype": "none"}):
            drawn[dark] = draw(dark)
    return Plot(title, light=drawn[False], dark=drawn[True])


def style_of(method: MethodName) -> tuple[str, str, str, str]:
    """Colour on white, on dark, line and marker; of those without their own by loss, extras and prior."""
    if method in STYLES:
        return STYLES[method]
    made = METHODS[method]
    assert made.prior is not None
    of_loss = f"edge-{made.prior}" if made.variant else "nerfacto" if made.loss == "none" else made.loss
    marker = {"lidar": "v", "mono": "<", "gaussian": ">", "integrated": "D"}[made.prior]
    return (*STYLES[of_loss][:2], "-" if made.extras else "--", marker)


def _draw(axis: Axes, method: MethodName, line: Line, dark: bool) -> None:
    on_white, on_dark, pattern, symbol = style_of(method)
    axis.plot(
        *line,
        color=on_dark if dark else on_white,
        linestyle=pattern,
        marker=symbol,
        markersize=4,
        linewidth=2.2 if method == "edge" else 1.4,
        label=METHODS[method].title,
        zorder=3 if method == "edge" else 2,
    )


def _runs(results: Results, scene: str) -> dict[MethodName, list[RunResult]]:
    """The runs of a drive, by method."""
    found: dict[MethodName, list[RunResult]] = {}
    for name in results.methods():
        runs = [run for run in results.runs if run.scene == scene and run.method == name]
        if runs:
            found[name] = runs
    return found


def _curves(results: Results, scenes: Sequence[str], title: str, key: str, label: str) -> Plot:
    """Plot how far held-out and trained-on pixels are right in the course of the training, a column for each drive."""
    rows = [(curve_metric(results), "PSNR of held-out pixels, dB")]
    # runs of versions before 0.1 have none
    if all(f"trained_{rows[0][0]}" in run.curve[-1] for run in results.runs):
        rows.append((f"trained_{rows[0][0]}", "PSNR of trained-on pixels, dB"))
    known = (name for name in DISTANCE_ERRORS if all(name in run.curve[-1] for run in results.runs))
    rows += [(name, "AbsRel of held-out pixels") for name in [*known][:1]]

    def draw(dark: bool) -> bytes:
        figure, axes = _axes(scenes, len(rows))
        for column, scene in enumerate(scenes):
            for method, runs in _runs(results, scene).items():
                for row, (name, _) in enumerate(rows):
                    values = ([[point[one] for point in run.curve] for run in runs] for one in (key, name))
                    x, y = (np.mean(of_runs, axis=0).tolist() for of_runs in values)
                    _draw(axes[row, column], method, (x, y), dark)
            axes[-1, column].set_xlabel(label)
        for axis in axes.flat:
            _logarithmic(axis)
        for row, (name, words) in enumerate(rows):
            axes[row, 0].set_ylabel(words)
            if name in DISTANCE_ERRORS:
                for axis in axes[row]:
                    _logarithmic_errors(axis)
        return _finished(figure, axes)

    return _twice(title, draw)


def plot_bins(
    title: str,
    bins: Mapping[str, Mapping[MethodName, Sequence[Bins]]],
    label: str,
    rows: Sequence[tuple[str, str]],
    logarithmic_x: bool,
) -> Plot:
    """Plot binned errors, a column for each drive.

    Args:
        title: what the plot shows.
        bins: by drive and method, those of each run; all runs of a drive have the same.
        label: what is binned, with its unit.
        rows: name of a figure and its label, for each row of axes; abs_rel is drawn logarithmically.
        logarithmic_x: whether equal ratios are equally far apart.

    """

    def draw(dark: bool) -> bytes:
        figure, axes = _axes(list(bins), len(rows))
        for column, methods in enumerate(bins.values()):
            for row, (name, _) in enumerate(rows):
                for method, of_runs in methods.items():
                    kept = [[entry for entry in one if name in entry] for one in of_runs]
                    if kept[0]:
                        x = [(entry["low"] + entry["high"]) / 2 for entry in kept[0]]
                        y = np.mean([[entry[name] for entry in one] for one in kept], axis=0)
                        _draw(axes[row, column], method, (x, y.tolist()), dark)
                if name == "abs_rel":
                    _logarithmic_errors(axes[row, column])
                if logarithmic_x:
                    _logarithmic(axes[row, column])
            axes[-1, column].set_xlabel(label)
        for row, (_, words) in enumerate(rows):
            axes[row, 0].set_ylabel(words)
        return _finished(figure, axes)

    return _twice(title, draw)


def _binned(results: Results, scenes: Sequence[str], title: str, key: str) -> Plot:
    bins: dict[str, dict[MethodName, list[Bins]]] = {}
    for scene in scenes:
        runs_of = _runs(results, scene)
        bins[scene] = {method: [run.content.get(key, []) for run in runs] for method, runs in runs_of.items()}
    return plot_bins(
        title, bins, BINS[key], [("psnr", PSNR_LABEL), ("abs_rel", "AbsRel")], logarithmic_x=key == "by_distance_m"
    )


def draw_plots(output: Path, results: Results) -> list[Plot]:
    """Draw psnr_by_steps, psnr_by_seconds, error_by_angle and error_by_distance.

    Returns:
        For the page: each plot of each drive.

    """
    clock, scenes = clock_metric(results), results.scenes()
    kinds: dict[str, Callable[[Sequence[str], str], Plot]] = {
        "psnr_by_steps": lambda of, more: _curves(results, of, f"Training curves by steps{more}", "step", "steps"),
        "psnr_by_seconds": lambda of, more: _curves(
            results, of, f"Training curves by time{more}", clock, f"{CLOCKS[clock].lower()} of training"
        ),
        "error_by_angle": lambda of, more: _binned(
            results, of, f"Errors by the angle from the optical axis{more}", "by_angle_deg"
        ),
        "error_by_distance": lambda of, more: _binned(results, of, f"Errors by distance{more}", "by_distance_m"),
    }
    for_the_page = []
    for name, plot in kinds.items():
        write_bytes(output / f"{name}.svg", plot(scenes, "").light)
        for_the_page += [plot([scene], f": {scene}" if len(scenes) > 1 else "") for scene in scenes]
    return for_the_page
