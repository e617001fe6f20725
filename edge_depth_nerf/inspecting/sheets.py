"""Draws a sheet of one picture: the picture and its maps side by side, each with its legend."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.pictures import (
    DISTANCE,
    RELATIVE_ERROR,
    SIGMA,
    Colour,
    ColourScale,
    colour_bar,
    draw_points,
    is_distance,
    lay_out,
    legend,
    panel,
    resize,
    tinted,
)
from edge_depth_nerf.inspecting.figures import PictureFigures
from edge_depth_nerf.inspecting.shown_prior import ORIGINS, ShownMaps
from edge_depth_nerf.scene.reader import SceneFolder

HIDDEN_RGB = (205, 50, 60)
"""Tint of pixels that the mask hides."""
NO_PRIOR_RGB = (60, 110, 230)
"""Tint, hatched, of usable pixels without a prior."""

ORIGIN_RGB: tuple[Colour, ...] = ((20, 20, 20), (150, 150, 150), (240, 170, 40), (220, 60, 40))
"""Colour of each of `ORIGINS`."""


def draw_sheet(scene: SceneFolder, figures: PictureFigures, maps: ShownMaps, width_px: int) -> NDArray[np.uint8]:
    """Draw the sheet of one picture in three columns of this width, or two as wide together if the picture is low.

    Panels of missing maps are left out.
    """
    height, width = maps.usable.shape
    columns, shown_px = (3, width_px) if width < 2 * height else (2, (3 * width_px + 14) // 2)
    size = (shown_px, max(round(height * shown_px / width), 1))

    def coloured(title: str, values: NDArray, shown: NDArray[np.bool_], colours: ColourScale) -> NDArray[np.uint8]:
        picture = colours.coloured(resize(values, size), resize(shown, size))
        return panel(picture, title, colour_bar(colours, size[0]))

    def distance(title: str, distance_m: NDArray) -> NDArray[np.uint8]:
        return coloured(title, distance_m, is_distance(distance_m) & maps.usable, DISTANCE)

    panels = [panel(resize(maps.rgb, size), "picture")]
    if maps.lidar_m is not None:
        over = draw_points(maps.rgb, maps.lidar_m, size)
        panels.append(panel(over, "LiDAR over the picture", colour_bar(DISTANCE, size[0])))
    if maps.mono_m is not None:
        panels.append(distance("monocular distance", maps.mono_m))
    if (motion_m := maps.distances_m.get("motion")) is not None:
        none = " (held out: none)" if figures.picture.held_out else ""
        panels.append(distance(f"distance from motion{none}", motion_m))
    if maps.prior is not None:
        panels.append(distance(f"prior ({maps.source})", maps.prior.distance_m))
        has_prior = is_distance(maps.prior.distance_m)
        panels.append(coloured("sigma of the prior", maps.prior.sigma_m, has_prior, SIGMA))
        if motion_m is not None and maps.origin is not None:
            panels.append(_origin_panel(maps.origin, size))
    if "mask" in figures.picture.files or maps.prior is not None:
        panels.append(_mask_panel(maps, size))
    if maps.truth_m is not None:
        panels.append(distance("true distance", maps.truth_m))
        if maps.prior is not None:
            both = is_distance(maps.prior.distance_m) & is_distance(maps.truth_m)
            error = 100 * (maps.prior.distance_m / np.where(both, maps.truth_m, 1) - 1)
            panels.append(coloured("prior / ground truth", error, both, RELATIVE_ERROR))
    return lay_out(panels, min(len(panels), columns), _heading(scene, figures))


def _mask_panel(maps: ShownMaps, size: tuple[int, int]) -> NDArray[np.uint8]:
    picture = tinted(resize(maps.rgb, size), resize(~maps.usable, size), HIDDEN_RGB)
    names: list[tuple[str, Colour]] = [("hidden", HIDDEN_RGB)]
    if maps.prior is not None:
        without = maps.usable & ~is_distance(maps.prior.distance_m)
        picture = tinted(picture, resize(without, size), NO_PRIOR_RGB, hatched=True)
        names.append(("used, without prior", NO_PRIOR_RGB))
    return panel(picture, "mask", legend(names, size[0]))


def _origin_panel(origin: NDArray[np.int8], size: tuple[int, int]) -> NDArray[np.uint8]:
    colours = np.array([*ORIGIN_RGB, (255, 255, 255)], np.uint8)
    found = np.count_nonzero(origin >= 0)
    names = [
        (f"{name} {np.count_nonzero(origin == i) / max(found, 1):.0%}", ORIGIN_RGB[i]) for i, name in enumerate(ORIGINS)
    ]
    return panel(colours[resize(origin, size)], "source of the prior", legend(names, size[0]))


def _heading(scene: SceneFolder, figures: PictureFigures) -> list[str]:
    picture = figures.picture
    split = ("held out" if picture.held_out else "training") if scene.split_known else "no split given"
    facts = [f"uses {figures.used_share:.0%} of the picture"]
    if figures.lidar_coverage is not None:
        facts.append(f"LiDAR on {figures.lidar_coverage:.1%} of that")
    if len(figures.mono_over_lidar):
        error = np.abs(figures.mono_over_lidar - 1).mean()
        facts.append(f"mono / LiDAR {np.median(figures.mono_over_lidar):.2f} (median), AbsRel {error:.2f}")
    if figures.prior_share is not None:
        facts.append(f"prior on {figures.prior_share:.0%}")
    if len(figures.sigma_m):
        facts.append(f"sigma {np.median(figures.sigma_m):.2g} m (median)")
    if len(figures.prior_over_truth):
        facts.append(f"prior / ground truth: AbsRel {np.abs(figures.prior_over_truth - 1).mean():.3f}")
    return [
        f"{picture.camera}, frame {picture.frame} ({split})",
        f"{picture.lens.width}×{picture.lens.height} px; " + "; ".join(facts),
    ]
