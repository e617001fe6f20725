"""Plots of a comparison: PSNR against steps and seconds, errors by angle and by distance."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.tables import CLOCKS, clock_metric, curve_metric
from edge_depth_nerf.files import write_bytes

STYLES = {
    # rivals grey to black and dashed, ours in colours; also told apart without colours
    "nerfacto": ("#888888", "--", "o"),
    "urban-nerf": ("#b08030", "--", "s"),
    "ds-nerf": ("#444444", "--", "^"),
    "edge-lidar": ("#2a9d8f", ":", "v"),
    "edge-mono": ("#8ab17d", ":", "D"),
    "edge-gaussian": ("#9b5de5", "-.", "P"),
    "edge-paper": ("#3a86ff", "-.", "X"),
    "edge": ("#d62828", "-", "o"),
}
BINS = {"by_angle_deg": "angle from the optical axis, degrees", "by_distance_m": "distance, m"}


def _axes(scenes: Sequence[str], rows: int) -> tuple[Figure, np.ndarray]:
    # no pyplot: it would look for a display
    figure = Figure(figsize=(max(6.0, 4.6 * len(scenes)), 3.6 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, len(scenes), squeeze=False)
    for axis, scene in zip(axes[0], scenes, strict=True):
        axis.set_title(scene)
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


def _finish(figure: Figure, axes: np.ndarray, path: Path) -> None:
    handles = dict(pair for axis in axes.flat for pair in _labelled(axis))
    columns = 3 if axes.shape[1] == 1 else 4
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=columns, frameon=False)
    content = io.BytesIO()
    figure.savefig(content, format=path.suffix[1:], dpi=110)
    write_bytes(path, content.getvalue())


def _draw(axis: Axes, runs: Sequence[RunResult], x: Sequence[float], y: Sequence[float], marker: bool = True) -> None:
    method = runs[0].method
    colour, line, symbol = STYLES[method]
    axis.plot(
        x,
        y,
        color=colour,
        linestyle=line,
        marker=symbol if marker else None,
        markersize=4,
        linewidth=2.2 if method == "edge" else 1.4,
        label=METHODS[method].title,
        zorder=3 if method == "edge" else 2,
    )


def _runs(results: Results, scene: str) -> list[list[RunResult]]:
    """The runs of a drive, by method."""
    found = [[run for run in results.runs if run.scene == scene and run.method == name] for name in results.methods()]
    return [runs for runs in found if runs]


def _curves(results: Results, path: Path, key: str, label: str) -> None:
    name = curve_metric(results)
    figure, axes = _axes(results.scenes(), 1)
    for axis, scene in zip(axes[0], results.scenes(), strict=True):
        for runs in _runs(results, scene):
            x = np.mean([[point[key] for point in run.curve] for run in runs], axis=0)
            y = np.mean([[point[name] for point in run.curve] for run in runs], axis=0)
            _draw(axis, runs, x.tolist(), y.tolist())
        axis.set_xlabel(label)
        _logarithmic(axis)
    axes[0, 0].set_ylabel("PSNR of held-out pixels, dB")
    _finish(figure, axes, path)


def _binned(results: Results, path: Path, key: str) -> None:
    figure, axes = _axes(results.scenes(), 2)
    for column, scene in enumerate(results.scenes()):
        for runs in _runs(results, scene):
            for row, figure_name in enumerate(("psnr", "abs_rel")):
                # all runs of a drive have the same bins
                bins = [[entry for entry in run.content.get(key, []) if figure_name in entry] for run in runs]
                if not bins[0]:
                    continue
                x = [(entry["low"] + entry["high"]) / 2 for entry in bins[0]]
                y = np.mean([[entry[figure_name] for entry in one] for one in bins], axis=0)
                _draw(axes[row, column], runs, x, y.tolist())
        axes[1, column].set_yscale("log")
        axes[1, column].set_xlabel(BINS[key])
        if key == "by_distance_m":
            for axis in axes[:, column]:
                _logarithmic(axis)
    axes[0, 0].set_ylabel("PSNR, dB")
    axes[1, 0].set_ylabel("AbsRel")
    _finish(figure, axes, path)


def draw_plots(output: Path, results: Results) -> None:
    """Draw psnr_by_steps, psnr_by_seconds, error_by_angle and error_by_distance, a column for each drive."""
    _curves(results, output / "psnr_by_steps.png", "step", "steps")
    clock = clock_metric(results)
    _curves(results, output / "psnr_by_seconds.png", clock, f"{CLOCKS[clock].lower()} of training")
    _binned(results, output / "error_by_angle.png", "by_angle_deg")
    _binned(results, output / "error_by_distance.png", "by_distance_m")
