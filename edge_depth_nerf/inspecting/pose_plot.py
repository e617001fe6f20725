"""Plots the poses' errors along the drive: distances of features from their epipolar lines, step by step."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from edge_depth_nerf.inspecting.pose_check import BAD_MEDIAN_PX, known_steps
from edge_depth_nerf.inspecting.top_view import GAP, VIEWS
from edge_depth_nerf.poses.matches import EpipolarAgreement
from edge_depth_nerf.scene.reader import SceneFolder

_SIZE_INCHES, _DPI = (10.0, 3.6), 100


def pose_check_figure(scene: SceneFolder, agreements: Sequence[EpipolarAgreement]) -> Figure:
    """Draw the medians along the drive, a line for each camera."""
    figure = Figure(_SIZE_INCHES, dpi=_DPI, layout="constrained")
    axes = figure.add_subplot()
    for number, name in enumerate(scene.cameras()):
        known = known_steps(agreements, name)
        middles = [(one.first + one.second) / 2 for one in known]
        medians = [one.median_px for one in known]
        colour = VIEWS[number % len(VIEWS)]
        axes.plot(middles, medians, "o-", markersize=3.5, linewidth=1, color=colour, label=name)
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
