"""Draws the drive from above (points, path, cameras, gaps), and the errors of its poses step by step.

Seen from above, the scene's x runs to the right, its y upwards, its z towards the viewer. Lengths are in the
scene's unit, which is metres in scenes of this project.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from edge_depth_nerf.base.pictures import INK, add_legend_below
from edge_depth_nerf.inspecting.figures import reference_camera
from edge_depth_nerf.inspecting.findings import Finding
from edge_depth_nerf.inspecting.pose_check import BAD_MEDIAN_PX, known_steps
from edge_depth_nerf.poses.matches import EpipolarAgreement
from edge_depth_nerf.scene.reader import SceneFolder

LARGEST_PX = (1160, 900)
"""Of the map. A wider figure would be shrunk to a window, and its letters with it."""
LEAST_PX = 420
"""Least length of each side, so that the legend fits."""
MARGIN_M = 12.0
"""Least margin around the path, in scenes whose lengths are metres."""
PATH, TRAINING, HELD_OUT, GAP = "#7896c8", "#1450be", "#eb7d00", "#d21428"
VIEWS = ("#008c5a", "#963caa", "#008caa", "#966e00", "#c85078", "#5a5a5a")
"""Colours of the viewing directions, by camera."""
GREYS = ("#e1e1e1", "#cacaca", "#b3b3b3", "#9c9c9c", "#858585", "#6e6e6e")
"""Colours of points, from low to high: the ground is pale, and house fronts become lines."""
_AROUND_PX = (80, 110)
"""Space for the axes' numbers and the title."""
_DPI = 100
_ARROW = {"units": "dots", "scale_units": "dots", "scale": 1 / 18}
"""Arrows of 18 px for a length of 1."""


def top_view(
    scene: SceneFolder, points_m: NDArray[np.float64] | None, findings: Sequence[Finding], shown: Sequence[int]
) -> Figure:
    """Draw the scene from above, with axes in its unit.

    Args:
        scene: its poses.
        points_m: N×3 points in the scene; higher ones are drawn darker.
        findings: the gaps among them are marked.
        shown: frames that have a sheet; their numbers are beside the path.
    """
    figure, axes, pixel_m = _empty_map(scene)
    if points_m is not None:
        _add_points(axes, points_m)
    path = scene.cameras()[reference_camera(scene)]
    at_m = {picture.frame: picture.position_m for picture in path}
    path_m = np.array(list(at_m.values()))[:, :2]
    axes.plot(*path_m.T, color=PATH, linewidth=1.5, zorder=0.8)
    gaps = {finding.frames for finding in findings if finding.kind == "gap"}
    for step in pairwise(at_m):
        if step in gaps:
            ends_m = np.array([at_m[frame] for frame in step])
            axes.plot(*ends_m.T[:2], color=GAP, linewidth=3, zorder=0.9)
            _write(axes, f"{np.linalg.norm(np.diff(ends_m, axis=0)):.3g} {_unit(scene)}", ends_m.mean(0)[:2], GAP)
    # viewing directions have no arrow heads, because they are close to each other
    bare = {"width": 1.4, "headwidth": 0, "headlength": 0, "headaxislength": 0}
    for number, (name, pictures) in enumerate(scene.cameras().items()):
        from_m = np.array([picture.position_m[:2] for picture in pictures])
        along = np.array([picture.looks_along[:2] for picture in pictures])
        kept = _apart(from_m, 12 * pixel_m)
        colour = VIEWS[number % len(VIEWS)]
        axes.quiver(*from_m[kept].T, *along[kept].T, color=colour, label=f"view of {name}", **_ARROW, **bare)
    _add_travel(axes, path_m, pixel_m)
    held_out = np.array([picture.held_out for picture in path])
    _add_dots(axes, path_m[~held_out], 6.0, pixel_m, TRAINING, "training" if scene.split_known else "pictures")
    _add_dots(axes, path_m[held_out], 10.0, pixel_m, HELD_OUT, "held out")
    if named := sorted({*shown} & at_m.keys()):
        rings_m = np.array([at_m[frame][:2] for frame in named])
        axes.plot(*rings_m.T, "o", markersize=10, markerfacecolor="none", color=INK, label="frame with a sheet")
        for index in _apart(rings_m, 40 * pixel_m):
            _write(axes, str(named[index]), rings_m[index], INK)
    add_legend_below(figure, *axes.get_legend_handles_labels(), "outside lower left")
    return figure


def _unit(scene: SceneFolder) -> str:
    return "m" if scene.own else "scene units"


def _empty_map(scene: SceneFolder) -> tuple[Figure, Axes, float]:
    """Return axes that the path fits with a margin, and the length of one of their pixels."""
    positions_m = np.array([picture.position_m[:2] for picture in scene.pictures])
    low, high = positions_m.min(0), positions_m.max(0)
    extent = float((high - low).max())
    margin = max(0.1 * extent, MARGIN_M) if scene.own else 0.25 * extent or 1.0
    span = high - low + 2 * margin
    pixel_m = float(max(span / LARGEST_PX))
    sides_px = np.maximum(span / pixel_m, LEAST_PX)
    figure = Figure(tuple((sides_px + _AROUND_PX) / _DPI), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot(aspect="equal")
    left, bottom = (low + high - sides_px * pixel_m) / 2
    right, top = (low + high + sides_px * pixel_m) / 2
    axes.set(xlim=(left, right), ylim=(bottom, top))
    # KITTI-360's world is a Mercator map
    source = scene.meta.get("source")
    mapped = isinstance(source, dict) and source.get("kind") == "kitti360"
    axes.set_xlabel(f"x{' (east)' if mapped else ''}, {_unit(scene)}")
    axes.set_ylabel(f"y{' (north)' if mapped else ''}, {_unit(scene)}")
    name = scene.path.parent.resolve().name
    title = f"{name} from above: {len(scene.frames())} frames, path of {reference_camera(scene)}"
    figure.suptitle(title, parse_math=False)
    return figure, axes, pixel_m


def _write(axes: Axes, text: str, at_m: NDArray[np.float64], colour: str) -> None:
    """Write beside a position, readable on top of lines."""
    rim = [withStroke(linewidth=3, foreground="white")]
    axes.annotate(text, tuple(at_m), (7, 7), textcoords="offset points", color=colour, path_effects=rim)


def _add_points(axes: Axes, points_m: NDArray[np.float64]) -> None:
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    x, y, _ = points_m.T
    seen_m = points_m[(x >= left) & (x <= right) & (y >= bottom) & (y <= top)]
    if not len(seen_m):
        return
    low, high = np.quantile(seen_m[:, 2], (0.05, 0.95))
    levels = np.digitize(seen_m[:, 2], np.linspace(low, high, len(GREYS) + 1)[1:-1])
    for level, grey in enumerate(GREYS):
        x, y, _ = seen_m[levels == level].T
        axes.plot(x, y, "s", markersize=1.44, markeredgewidth=0, color=grey, zorder=0.5)
    axes.plot([], [], "o", color=GREYS[3], label="points, higher ones darker")


def _apart(places_m: NDArray[np.float64], least_m: float) -> list[int]:
    """Return indices of positions that are at least this far from the one kept before."""
    kept: list[int] = []
    for index, place_m in enumerate(places_m):
        if not kept or np.linalg.norm(place_m - places_m[kept[-1]]) >= least_m:
            kept.append(index)
    return kept


def _add_dots(
    axes: Axes, places_m: NDArray[np.float64], largest_px: float, pixel_m: float, colour: str, label: str
) -> None:
    """Draw a dot at each position; smaller and fewer ones where they would touch."""
    if not len(places_m):
        return
    steps_px = np.linalg.norm(np.diff(places_m, axis=0), axis=1) / pixel_m
    size_px = float(np.clip(np.median(steps_px) / 1.5, 2, largest_px)) if len(steps_px) else largest_px
    kept_m = places_m[_apart(places_m, 1.5 * size_px * pixel_m)]
    axes.plot(*kept_m.T, "o", markersize=size_px * 72 / _DPI, markeredgewidth=0, color=colour, label=label)


def _add_travel(axes: Axes, path_m: NDArray[np.float64], pixel_m: float) -> None:
    """Draw arrow heads on the path, in the direction of travel, about 90 px apart."""
    path_m = path_m[_apart(path_m, 10 * pixel_m)]
    steps_m = np.diff(path_m, axis=0)
    lengths_m = np.linalg.norm(steps_m, axis=1)
    passed = np.floor(lengths_m.cumsum() / (90 * pixel_m) + 0.5)
    here = np.diff(passed, prepend=0) > 0
    along, midpoints_m = steps_m[here] / lengths_m[here, None], (path_m[:-1] + steps_m / 2)[here]
    head = {"width": 2, "headwidth": 5, "headlength": 9, "headaxislength": 9, "pivot": "mid"}
    axes.quiver(*midpoints_m.T, *along.T, color=TRAINING, **_ARROW, **head)
    axes.plot([], [], ">", color=TRAINING, label="travel")


def pose_check_figure(scene: SceneFolder, agreements: Sequence[EpipolarAgreement]) -> Figure:
    """Draw the medians along the drive, a line for each camera."""
    figure = Figure((10.0, 3.6), dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    for number, name in enumerate(scene.cameras()):
        known = known_steps(agreements, name)
        midpoints = [(one.first + one.second) / 2 for one in known]
        medians = [one.median_px for one in known]
        colour = VIEWS[number % len(VIEWS)]
        axes.plot(midpoints, medians, "o-", markersize=3.5, linewidth=1, color=colour, label=name)
    axes.axhline(BAD_MEDIAN_PX, color=GAP, linewidth=1, linestyle="--", label=f"above {BAD_MEDIAN_PX} px: warning")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("frame")
    axes.set_ylabel("px (median)")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, ncols=6)
    name = scene.path.parent.resolve().name
    figure.suptitle(
        f"{name}: distance of matched features from their epipolar lines, each frame and the next", parse_math=False
    )
    return figure
