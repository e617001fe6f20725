"""Plots of a comparison: PSNR against steps and seconds, errors by angle and by distance.

Each is drawn twice, on white and for a dark page, as SVG.
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
from edge_depth_nerf.compare.methods import METHODS, Loss
from edge_depth_nerf.compare.options import MethodName
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
LOSS_STYLES: dict[Loss, tuple[str, str]] = {
    "none": ("#888888", "#9aa3ad"),
    "urban-nerf": ("#b08030", "#d9a94a"),
    "urban-nerf-los": ("#7a5195", "#b493cc"),
    "ds-nerf": ("#444444", "#d5dae0"),
    "edge": ("#d62828", "#ff625c"),
}
"""On white, on dark: of the methods that the grid alone has."""
BINS = {"by_angle_deg": "angle from the optical axis, degrees", "by_distance_m": "distance, m"}
PSNR_LABEL = "PSNR, dB"
_INK = {False: "#1b2026", True: "#d5dae0"}
_PAPER = {False: "#ffffff", True: "#161b22"}

Bins = Sequence[Mapping[str, float]]
"""As `BinnedErrors.compute` gives them."""
Line = tuple[Sequence[float], Sequence[float]]
"""x and y."""


def _axes(titles: Sequence[str], rows: int) -> tuple[Figure, np.ndarray]:
    # no pyplot: it would look for a display
    figure = Figure(figsize=(max(6.0, 4.6 * len(titles)), 3.6 * rows + 0.9), layout="constrained")
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


def _finished(figure: Figure, axes: np.ndarray) -> bytes:
    handles = dict(pair for axis in axes.flat for pair in _labelled(axis))
    columns = 3 if axes.shape[1] == 1 else 4
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns, frameon=False)
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
        with matplotlib.rc_context({**ink, **paper, "svg.hashsalt": title}):
            drawn[dark] = draw(dark)
    return Plot(title, light=drawn[False], dark=drawn[True])


def style_of(method: MethodName) -> tuple[str, str, str, str]:
    """Colour on white, on dark, line and marker; of the grid's cells by loss, extras and prior."""
    cell = METHODS[method].cell
    if method in STYLES or cell is None:
        return STYLES[method]
    return *LOSS_STYLES[cell.loss], "-" if cell.extras else "--", "D" if cell.prior == "integrated" else "v"


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


def _curves(results: Results, title: str, key: str, label: str) -> Plot:
    name = curve_metric(results)

    def draw(dark: bool) -> bytes:
        figure, axes = _axes(results.scenes(), 1)
        for axis, scene in zip(axes[0], results.scenes(), strict=True):
            for method, runs in _runs(results, scene).items():
                x, y = (np.mean([[point[one] for point in run.curve] for run in runs], axis=0) for one in (key, name))
                _draw(axis, method, (x.tolist(), y.tolist()), dark)
            axis.set_xlabel(label)
            _logarithmic(axis)
        axes[0, 0].set_ylabel("PSNR of held-out pixels, dB")
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
                    axes[row, column].set_yscale("log")
                if logarithmic_x:
                    _logarithmic(axes[row, column])
            axes[-1, column].set_xlabel(label)
        for row, (_, words) in enumerate(rows):
            axes[row, 0].set_ylabel(words)
        return _finished(figure, axes)

    return _twice(title, draw)


def _binned(results: Results, title: str, key: str) -> Plot:
    bins: dict[str, dict[MethodName, list[Bins]]] = {}
    for scene in results.scenes():
        runs_of = _runs(results, scene)
        bins[scene] = {method: [run.content.get(key, []) for run in runs] for method, runs in runs_of.items()}
    return plot_bins(
        title, bins, BINS[key], [("psnr", PSNR_LABEL), ("abs_rel", "AbsRel")], logarithmic_x=key == "by_distance_m"
    )


def draw_plots(output: Path, results: Results) -> list[Plot]:
    """Draw psnr_by_steps, psnr_by_seconds, error_by_angle and error_by_distance, a column for each drive."""
    clock = clock_metric(results)
    plots = {
        "psnr_by_steps": _curves(results, "PSNR by steps", "step", "steps"),
        "psnr_by_seconds": _curves(results, "PSNR by time", clock, f"{CLOCKS[clock].lower()} of training"),
        "error_by_angle": _binned(results, "Errors by the angle from the optical axis", "by_angle_deg"),
        "error_by_distance": _binned(results, "Errors by distance", "by_distance_m"),
    }
    for name, plot in plots.items():
        write_bytes(output / f"{name}.svg", plot.light)
    return list(plots.values())
