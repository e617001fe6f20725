"""The report's pictures of held-out views: colours, distances, and the errors of both.

Rendered distances are read from the colours of saved pictures, which end at 60 m. Errors are therefore shown only where
the true distance is 2 to 40 m. There, a distance beyond the colours' range has an error beyond the error scale, too.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.base.console import run_jobs, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import encoded
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.base.pictures import (
    COLOUR_ERROR,
    DISTANCE,
    NO_VALUE_RGB,
    RELATIVE_ERROR,
    ColourScale,
    distance_of_colours,
    is_distance,
    resize,
)
from edge_depth_nerf.masks.regions import from_nearest
from edge_depth_nerf.report.compared_views import ComparedView, compared_view, held_out_frames
from edge_depth_nerf.report.points import MOST_POINTS, show_points
from edge_depth_nerf.report.tables import Metric
from edge_depth_nerf.scene.reader import read_scene

REPORT = "report.html"
MOST_PICTURES = 1000
"""Most pictures of a page, over all drives and methods. With more, some held-out views are left out."""
MOST_WIDTH_PX = 640
PICTURES_BYTES = 16_000_000
"""Size of all encoded pictures. As text in the page they take a third more."""
WEBP_QUALITIES = ((1.0, 85), (1.0, 70), (1.0, 50), (0.7, 50), (0.5, 50), (0.5, 30), (0.35, 30))
"""Share of the size, and quality. The first that makes a picture small enough is used, else the last."""
ERROR_RANGE_M = (2.0, 40.0)
"""Range of true distances in which errors are shown."""
VIEW_METRICS = (
    Metric("masked_psnr", "masked PSNR ↑", ".2f"),
    Metric("masked_ssim", "SSIM ↑", ".3f"),
    Metric("masked_flip", "FLIP ↓", ".3f", -1),
    Metric("delta_1_25", "δ<1.25 ↑", ".3f"),
)
"""Figures of a view; those of pictures and distances have the same ranges as in the tables."""
SPREAD_PX = 1.6
"""Radius of a LiDAR point in a picture."""
DIMMED = 0.35
"""Brightness of the true picture outside the mask."""


@dataclass(frozen=True)
class KindShown:
    """A kind of picture."""

    key: str
    title: str
    explanation: str
    scale: ColourScale | None = None
    """The meaning of its colours."""


KINDS = (
    KindShown("colour", "Colour", "The rendered picture, inside the mask."),
    KindShown("distance", "Distance", "Rendered median distance along the ray.", DISTANCE),
    KindShown(
        "colour-error",
        "Colour error",
        "Mean difference of red, green and blue from the ground truth, in percent of the whole range.",
        COLOUR_ERROR,
    ),
    KindShown(
        "distance-error",
        "Distance error",
        "Rendered against true distance, for true ones of {:g} to {:g} m. Too near is blue, too far is red.".format(
            *ERROR_RANGE_M
        ),
        RELATIVE_ERROR,
    ),
)


@dataclass(frozen=True)
class ShownView:
    """A held-out view with encoded pictures (WebP)."""

    title: str
    width: int
    height: int
    truth: dict[str, bytes]
    """Colours, and distances if any are known."""
    rendered: dict[str, dict[str, bytes]]
    """All kinds of pictures, by method."""
    figures: dict[str, dict[str, str]]
    """Figures of this view by name, by method."""


@dataclass(frozen=True)
class ShownDrive:
    """The pictures of a drive."""

    title: str
    views: Sequence[ShownView]
    note: str
    """Which views these are, and what their ground truth is."""
    points: dict[str, Any] | None = None
    """What `show_points` gives."""


def views_of_a_drive(runs: int) -> int:
    """Return the largest number of views per drive, from the number of runs over all drives."""
    return max(MOST_PICTURES // (len(KINDS) * max(runs, 1)), 1)


def make_drives(drives: Mapping[str, tuple[Path, Mapping[str, Path]]], console: Console) -> list[ShownDrive]:
    """Make the pictures of all drives.

    `drives` gives by title the scene folder, and the folders of rendered views by method.
    """
    runs = sum(len(views_of) for _, views_of in drives.values())
    most = views_of_a_drive(runs)
    frames = {title: held_out_frames(scene) for title, (scene, _) in drives.items()}
    chosen = {title: spread_over(len(found), most) for title, found in frames.items()}
    pictures = len(KINDS) * sum(len(chosen[title]) * (len(views_of) + 1) for title, (_, views_of) in drives.items())

    def make(title: str, index: int) -> ShownView:
        scene, views_of = drives[title]
        return show_view(compared_view(scene, frames[title][index], index, views_of), PICTURES_BYTES // pictures)

    jobs = [partial(make, title, index) for title in drives for index in chosen[title]]
    made = iter(run_jobs(jobs, f"Pictures for {REPORT}", console))
    return [
        ShownDrive(
            title,
            [next(made) for _ in chosen[title]],
            " ".join([*_warnings(scene), _note(frames[title], len(chosen[title]))]),
            _points(scene, MOST_POINTS // len(drives), console),
        )
        for title, (scene, _) in drives.items()
    ]


def _points(scene: Path, most: int, console: Console) -> dict[str, Any] | None:
    """Return the drive's points. If they cannot be read, the page only lacks its view in 3D."""
    try:
        return show_points(read_scene(scene), most)
    except (InputError, OSError) as error:
        say(console, f"{REPORT} does not show the points of this drive. {error}", "yellow")
        return None


def _warnings(scene: Path) -> list[str]:
    """Return what `process` found wrong with the recording."""
    return [f"Warning of `process`: {each}" for each in read_scene(scene).checks().get("warnings", ())]


def _note(frames: Sequence[Mapping[str, object]], shown: int) -> str:
    """Return a text on which views are shown, and what their ground truth is."""
    known = {key for frame in frames for key in frame}
    parts = [
        f"All {shown} held-out views."
        if shown == len(frames)
        else f"{shown} of {len(frames)} held-out views, spread over the drive."
    ]
    if "truth_rgb_file_path" in known:
        parts.append("The ground truth is the picture without noise and exposure drift.")
    if "truth_distance_file_path" in known:
        parts.append("The true distances are the renderer's.")
    elif "lidar_file_path" in known:
        parts.append("The true distances are LiDAR points, drawn larger.")
    return " ".join(
        [*parts, "Pixels outside the mask (lens, vehicle) are not evaluated; they are dark in the ground truth."]
    )


def show_view(view: ComparedView, allowance: int) -> ShownView:
    """Make the pictures and figures of a view."""
    height, width = view.mask.shape
    shown = min(width, MOST_WIDTH_PX)
    size = (shown, max(round(height * shown / width), 1))
    sparse = view.distance_key == "lidar_file_path"
    target = view.rgb if view.clean_rgb is None else view.clean_rgb
    usual = is_distance(view.distance_m) & view.mask
    compared = usual & (view.distance_m >= ERROR_RANGE_M[0]) & (view.distance_m <= ERROR_RANGE_M[1])
    radius = SPREAD_PX * width / shown if sparse else 0.0

    def picture(pixels: NDArray[np.uint8]) -> bytes:
        return encode(resize(pixels, size) if shown < width else pixels, allowance)

    def map_of(values: NDArray[np.float32], known: NDArray[np.bool_], scale: ColourScale, radius: float = 0.0) -> bytes:
        values, known = spread(values, known, radius)
        if shown < width:
            values, known = resize(values, size), resize(known, size)
        return encode(scale.coloured(values, known), allowance)

    dimmed = np.where(view.mask[..., None], target, target * DIMMED).astype(np.uint8)
    truth: dict[str, bytes] = {"colour": picture(dimmed)}
    if view.distance_key is not None:
        truth["distance"] = map_of(view.distance_m, usual, DISTANCE, radius)
    rendered: dict[str, dict[str, bytes]] = {}
    for name, colours in view.colours.items():
        error = colours.astype(np.float32) - target
        distance_m = distance_of_colours(view.distances[name])
        rendered[name] = {
            "colour": picture(colours),
            "distance": map_of(distance_m, is_distance(distance_m), DISTANCE),
            "colour-error": map_of(np.abs(error).mean(-1) / 2.55, view.mask, COLOUR_ERROR),
        }
        if compared.any():
            ratio = np.where(compared, distance_m / np.where(compared, view.distance_m, 1), 1).astype(np.float32)
            rendered[name]["distance-error"] = map_of(100 * (ratio - 1), compared, RELATIVE_ERROR, radius)
    return ShownView(view.name, *size, truth, rendered, _figures(view))


def _figures(view: ComparedView) -> dict[str, dict[str, str]]:
    """Return the figures of a view that all methods have, by method; against ground truth if it is known."""
    shown: dict[str, dict[str, str]] = {name: {} for name in view.figures}
    for metric in VIEW_METRICS:
        for name in (f"truth_{metric.name}", metric.name, f"lidar_{metric.name}"):
            if all(name in found for found in view.figures.values()):
                for method, found in view.figures.items():
                    heading = "PSNR to clean ↑" if name == "truth_masked_psnr" else metric.heading
                    shown[method][heading] = f"{found[name]:{metric.form}}"
                break
    return shown


def spread(
    values: NDArray[np.float32], known: NDArray[np.bool_], radius: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Give pixels within `radius` px of known ones the nearest value, so that single pixels are visible.

    Second, where values are known now; a radius of 0 changes nothing.
    """
    if radius <= 0 or not known.any():
        return values, known
    nearest, away_px = from_nearest(values, known)
    return nearest, away_px <= radius


def encode(pixels: NDArray[np.uint8], allowance: int) -> bytes:
    """Encode H×W×3 RGB as WebP. Reduce quality and size if it would exceed `allowance` bytes."""
    content = b""
    for share, quality in WEBP_QUALITIES:
        size = (max(round(pixels.shape[1] * share), 1), max(round(pixels.shape[0] * share), 1))
        smaller = pixels if share == 1 else resize(pixels, size)
        content = encoded(".webp", smaller, [cv2.IMWRITE_WEBP_QUALITY, quality])
        if len(content) <= allowance:
            break
    return content


def data_uri(content: bytes, media_type: str) -> str:
    """Return bytes as a data URI."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"


def legend(scale: ColourScale) -> dict[str, object]:
    """Return the data of a scale's legend: a bar of its colours, ticks, and the colour of missing values."""
    places = scale.position(np.array(scale.ticks, float))
    return {
        "bar": data_uri(encoded(".png", scale.colours[None]), "image/png"),
        "ticks": [[round(float(place), 4), f"{tick:g}"] for place, tick in zip(places, scale.ticks, strict=True)],
        "unit": scale.unit,
        "none": "#{:02x}{:02x}{:02x}".format(*NO_VALUE_RGB),
    }
