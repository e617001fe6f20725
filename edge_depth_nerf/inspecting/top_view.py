"""The drive from above: points, path, cameras, gaps.

The scene's x runs to the right, its y upwards, its z towards the viewer. Lengths are the scene's, metres in scenes of
this project.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.pictures import INK_RGB, text_width, write_text
from edge_depth_nerf.inspecting.figures import reference_camera
from edge_depth_nerf.inspecting.findings import Finding
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

LARGEST_PX = (1600, 1100)
"""Width and height that the map may take."""
LEAST_PX = 420
"""Each side of the map is at least so long, for the legend's sake."""
MARGIN_M = 12.0
"""What is shown around the path, at least, in scenes whose lengths are metres."""
PATH_RGB, TRAINING_RGB, HELD_OUT_RGB, GAP_RGB = (120, 150, 200), (20, 80, 190), (235, 125, 0), (210, 20, 40)
VIEW_RGBS = ((0, 140, 90), (150, 60, 170), (0, 140, 170), (150, 110, 0), (200, 80, 120), (90, 90, 90))
"""Viewing directions, by camera."""
_STRIP_PX = 84


@dataclass(frozen=True)
class _Map:
    """How the ground lies in the picture."""

    left_m: float
    top_m: float
    px_per_m: float
    width: int
    height: int

    def pixels(self, positions_m: NDArray) -> NDArray[np.int64]:
        """N×2 or N×3 positions to N×2 pixels (x, y)."""
        x = (positions_m[:, 0] - self.left_m) * self.px_per_m
        y = (self.top_m - positions_m[:, 1]) * self.px_per_m
        return np.floor(np.stack((x, y), -1)).astype(np.int64)

    def inside(self, pixels: NDArray[np.int64]) -> NDArray[np.bool_]:
        return ((pixels >= 0) & (pixels < (self.width, self.height))).all(1)


def draw_top_view(
    scene: SceneFolder, points_m: NDArray[np.float64] | None, findings: Sequence[Finding], shown: Sequence[int]
) -> NDArray[np.uint8]:
    """Draw the scene from above.

    Args:
        scene: its poses.
        points_m: N×3 points in the scene; higher ones are drawn darker.
        findings: of these, the gaps are marked.
        shown: moments that have a sheet; they are numbered beside the path.

    """
    ground = _fitting_map(scene)
    canvas = np.full((ground.height, ground.width, 3), 255, np.uint8)
    if points_m is not None:
        _draw_points(canvas, ground, points_m)
    cameras = scene.cameras()
    name = reference_camera(scene)
    path = cameras[name]
    at = {picture.moment: (int(x), int(y)) for picture, (x, y) in zip(path, _positions(ground, path), strict=True)}
    gaps = {finding.frames for finding in findings if finding.kind == "gap"}
    for before, after in pairwise(path):
        between = (before.moment, after.moment)
        ends = at[before.moment], at[after.moment]
        if between not in gaps:
            cv2.line(canvas, *ends, PATH_RGB, 2, cv2.LINE_AA)
            continue
        cv2.line(canvas, *ends, GAP_RGB, 4, cv2.LINE_AA)
        length = np.linalg.norm(after.position_m - before.position_m)
        x, y = np.add(*ends) // 2
        write_text(
            canvas, f"{length:.3g} {_unit(scene)}", (int(x), int(y) - 10), 0.5, align=0.5, colour=GAP_RGB, halo=True
        )
    for number, pictures in enumerate(cameras.values()):
        _draw_views(canvas, ground, pictures, VIEW_RGBS[number % len(VIEW_RGBS)])
    _draw_travel(canvas, [at[picture.moment] for picture in path])
    _draw_dots(canvas, [at[picture.moment] for picture in path if not picture.held_out], 3, TRAINING_RGB)
    _draw_dots(canvas, [at[picture.moment] for picture in path if picture.held_out], 5, HELD_OUT_RGB)
    named = {at[moment]: moment for moment in sorted({*shown} & at.keys())}
    for place in named:
        _draw_ring(canvas, place)
    for x, y in _apart(list(named), 40.0):
        write_text(canvas, str(named[x, y]), (x + 9, y - 9), 0.5, halo=True)
    return np.vstack((_title(scene, name, canvas.shape[1]), canvas, _strip(scene, ground, list(cameras), bool(gaps))))


def _unit(scene: SceneFolder) -> str:
    return "m" if scene.own else "scene units"


def _positions(ground: _Map, pictures: Sequence[ScenePicture]) -> NDArray[np.int64]:
    return ground.pixels(np.array([picture.position_m for picture in pictures]))


def _fitting_map(scene: SceneFolder) -> _Map:
    """Fit the path with a margin into the picture."""
    positions_m = np.array([picture.position_m[:2] for picture in scene.pictures])
    low, high = positions_m.min(0), positions_m.max(0)
    extent = float((high - low).max())
    margin = max(0.1 * extent, MARGIN_M) if scene.own else 0.25 * extent or 1.0
    span = high - low + 2 * margin
    px_per_m = float(min(LARGEST_PX / span))
    width, height = (max(round(side * px_per_m), LEAST_PX) for side in span)
    left_m, top_m = (low + high) / 2 + np.array([-width, height]) / (2 * px_per_m)
    return _Map(float(left_m), float(top_m), px_per_m, width, height)


def _draw_points(canvas: NDArray[np.uint8], ground: _Map, points_m: NDArray[np.float64]) -> None:
    """Grey for points, the darker the higher: the ground stays pale, fronts of houses are lines."""
    pixels = ground.pixels(points_m)
    inside = ground.inside(pixels)
    if not inside.any():
        return
    x, y = pixels[inside].T
    heights_m = points_m[inside, 2].astype(np.float32)
    low, high = np.quantile(heights_m, (0.05, 0.95))
    lowest_first = np.argsort(heights_m, kind="stable")
    nothing_m = -1e9
    highest = np.full(canvas.shape[:2], nothing_m, np.float32)
    highest[y[lowest_first], x[lowest_first]] = heights_m[lowest_first]
    highest = cv2.dilate(highest, np.ones((2, 2), np.uint8))
    seen = highest > nothing_m
    darkness = np.clip((np.where(seen, highest, low) - low) / max(high - low, 1e-6), 0, 1)
    canvas[seen] = np.rint(225 - 115 * darkness[seen])[:, None].astype(np.uint8)


def _draw_views(
    canvas: NDArray[np.uint8], ground: _Map, pictures: Sequence[ScenePicture], colour: tuple[int, int, int]
) -> None:
    """Draw ticks along the optical axes, of pictures that are far enough apart to tell them."""
    by_place = {(int(x), int(y)): one for one, (x, y) in zip(pictures, _positions(ground, pictures), strict=True)}
    for x, y in _apart(list(by_place), 12.0):
        ahead = 18 * by_place[x, y].looks_along
        cv2.line(canvas, (x, y), (x + round(float(ahead[0])), y - round(float(ahead[1]))), colour, 1, cv2.LINE_AA)


def _apart(places: Sequence[tuple[int, int]], least_px: float) -> list[tuple[int, int]]:
    """Keep those places that are so far from the last one kept."""
    kept: list[tuple[int, int]] = []
    for place in places:
        if not kept or math.dist(place, kept[-1]) >= least_px:
            kept.append(place)
    return kept


def _draw_dots(
    canvas: NDArray[np.uint8], places: Sequence[tuple[int, int]], radius: int, colour: tuple[int, int, int]
) -> None:
    """Draw a dot at each place, smaller and fewer where they would touch."""
    gaps = [math.dist(*ends) for ends in pairwise(places)]
    radius = int(np.clip(np.median(gaps) / 3, 1, radius)) if gaps else radius
    for place in _apart(places, 3.0 * radius):
        cv2.circle(canvas, place, radius, colour, -1, cv2.LINE_AA)


def _draw_ring(canvas: NDArray[np.uint8], place: tuple[int, int]) -> None:
    cv2.circle(canvas, place, 7, INK_RGB, 1, cv2.LINE_AA)


def _draw_travel(canvas: NDArray[np.uint8], path: Sequence[tuple[int, int]]) -> None:
    """Draw arrow heads on the path, in the direction of travel, some 90 px apart."""
    travelled = 45.0
    for before, after in pairwise(_apart(path, 10.0)):
        step = np.subtract(after, before)
        length = float(np.linalg.norm(step))
        travelled += length
        if travelled < 90:
            continue
        travelled = 0.0
        along = step / length
        across = np.array([-along[1], along[0]])
        tip = np.add(before, after) / 2 + 9 * along
        corners = np.array([tip, tip - 18 * along + 5 * across, tip - 18 * along - 5 * across])
        cv2.fillPoly(canvas, [np.rint(corners).astype(np.int32)], TRAINING_RGB, cv2.LINE_AA)


def _title(scene: SceneFolder, reference: str, width: int) -> NDArray[np.uint8]:
    bar = np.full((40, width, 3), 255, np.uint8)
    text = f"{scene.path.parent.resolve().name} from above: {len(scene.moments())} moments, path of {reference}"
    write_text(bar, text, (12, 27), 0.7, max_width=width - 24)
    return bar


def _strip(scene: SceneFolder, ground: _Map, cameras: Sequence[str], gaps: bool) -> NDArray[np.uint8]:
    """The legend: axes, scale bar, what the colours mean."""
    strip = np.full((_STRIP_PX, ground.width, 3), 255, np.uint8)
    strip[0] = 200
    # the axes; KITTI-360's world is a Mercator map
    source = scene.meta.get("source")
    mapped = isinstance(source, dict) and source.get("kind") == "kitti360"
    origin = (24, 64)
    for end, label, where in (
        ((64, 64), "x, east" if mapped else "x", (70, 69)),
        ((24, 24), "y, north" if mapped else "y", (36, 28)),
    ):
        cv2.arrowedLine(strip, origin, end, INK_RGB, 2, cv2.LINE_AA, tipLength=0.25)
        write_text(strip, label, where, 0.45)

    length_m = nice_length(0.16 * ground.width / ground.px_per_m)
    left, right = 170, 170 + round(length_m * ground.px_per_m)
    cv2.line(strip, (left, 50), (right, 50), INK_RGB, 2)
    for x in (left, right):
        cv2.line(strip, (x, 44), (x, 56), INK_RGB, 2)
    write_text(strip, f"{length_m:g} {_unit(scene)}", ((left + right) // 2, 36), 0.5, align=0.5)

    x, y = right + 50, 32
    names = [("travel", TRAINING_RGB, "arrow"), ("training" if scene.split_known else "pictures", TRAINING_RGB, "dot")]
    names += [("held out", HELD_OUT_RGB, "dot")] if scene.split_known else []
    names += [("moment with a sheet", INK_RGB, "ring")]
    names += [("gap", GAP_RGB, "line")] if gaps else []
    names += [("points, higher ones darker", (150, 150, 150), "dot")]
    names += [
        (f"view of {name}", VIEW_RGBS[number % len(VIEW_RGBS)], "line")
        for number, name in enumerate(cameras[: len(VIEW_RGBS)])
    ]
    for name, colour, kind in names:
        if x + 30 + text_width(name, 0.5) > ground.width and y < 60:
            x, y = right + 50, 62
        if kind == "dot":
            cv2.circle(strip, (x + 10, y - 5), 5, colour, -1, cv2.LINE_AA)
        elif kind == "arrow":
            cv2.fillPoly(strip, [np.array([(x + 20, y - 5), (x + 2, y), (x + 2, y - 10)])], colour, cv2.LINE_AA)
        elif kind == "ring":
            _draw_ring(strip, (x + 10, y - 5))
        else:
            cv2.line(strip, (x, y - 5), (x + 20, y - 5), colour, 3, cv2.LINE_AA)
        x += 28 + write_text(strip, name, (x + 28, y), 0.5) + 20
    return strip


def nice_length(largest: float) -> float:
    """Give the largest of 1, 2, 5 times a power of ten that is not above `largest`."""
    power = 10.0 ** np.floor(np.log10(largest))
    return float(max(factor * power for factor in (1, 2, 5) if factor * power <= largest * (1 + 1e-9)))
