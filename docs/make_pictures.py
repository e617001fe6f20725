"""Draw the pictures of docs/method.md from the sample drive (`python docs/make_pictures.py`).

All numbers in them are computed by the package's own functions.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import write_atomically, write_png
from edge_depth_nerf.base.pictures import (
    DISTANCE,
    SIGMA,
    ColourScale,
    colour_bar,
    colour_distance,
    draw_points,
    is_distance,
    lay_out,
    panel,
    resize,
    text_bar,
)
from edge_depth_nerf.inspecting.shown_prior import ShownMaps, ShownScene
from edge_depth_nerf.method.alignment import align
from edge_depth_nerf.method.integration import IntegrationOptions, integrate_depth
from edge_depth_nerf.method.losses import edge_loss
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.reader import PictureMaps, read_scene

ROOT = Path(__file__).resolve().parents[1]
SAMPLE = ROOT / "data" / "sample_drive"
FRAME, CAMERA = 6, "image_02"
"""The picture that is shown, one of those trained on."""
PANEL_PX = 360
CELL_PX = 32
"""Side of a pixel in the kernel's panels."""
FIGURE_SIZE_IN = (8.0, 3.2)
SOFTNESS_M = 0.25
"""Over about so much of a ray a trained surface is met."""


def read_sample(folder: Path) -> ShownScene:
    """Read the sample drive as the repository has it, copied to a folder without the `.cache` that trainings leave.

    Raises:
        InputError: its calibration was made by other rules, or of other maps.
    """
    copied = shutil.copytree(SAMPLE, folder / SAMPLE.name, ignore=shutil.ignore_patterns(".cache"))
    scene = ShownScene(read_scene(Path(copied)))
    if scene.calibration is None:
        raise InputError(
            f"{SAMPLE / CALIBRATION_FILE}: was not made of the maps beside it by today's rules, so the pictures would "
            "show a prior without its calibration. Make the sample drive anew (data/README.md)."
        )
    return scene


def draw_maps(scene: ShownScene, maps: ShownMaps) -> NDArray[np.uint8]:
    """Picture, LiDAR, monocular distance as it comes and aligned, prior, its sigma."""
    assert maps.lidar_m is not None and maps.mono_m is not None and maps.prior is not None
    height, width = maps.usable.shape
    size = (PANEL_PX, round(PANEL_PX * height / width))

    def coloured(title: str, values: NDArray, colours: ColourScale) -> NDArray[np.uint8]:
        shown = is_distance(values) & maps.usable
        return panel(colours.coloured(resize(values, size), resize(shown, size)), title, colour_bar(colours, size[0]))

    lidar = draw_points(maps.rgb, np.where(maps.usable, maps.lidar_m, 0), size)
    panels = [
        panel(resize(maps.rgb, size), "picture"),
        panel(lidar, "LiDAR over the picture", colour_bar(DISTANCE, size[0])),
        coloured("monocular distance as it comes", maps.mono_m, DISTANCE),
        coloured("the same, fitted to LiDAR", aligned(scene, maps), DISTANCE),
        coloured("integrated prior", maps.prior.distance_m, DISTANCE),
        coloured("sigma of the prior", np.where(maps.prior.distance_m > 0, maps.prior.sigma_m, 0), SIGMA),
    ]
    return lay_out(panels, 3, [])


def aligned(scene: ShownScene, maps: PictureMaps) -> NDArray[np.float32]:
    """The monocular map after alignment, as the prior has it."""
    assert maps.lidar_m is not None and maps.mono_m is not None
    calibration = scene.calibration
    return align(maps.lidar_m, maps.mono_m, maps.usable, "local", calibration.drive_fit if calibration else None).mono_m


def find_edge(mono_m: NDArray[np.float32], maps: PictureMaps, radius: int) -> tuple[int, int]:
    """The pixel, without a return, in whose window two surfaces share the returns most evenly and lie far apart."""
    assert maps.lidar_m is not None and maps.truth_m is not None
    known = is_distance(mono_m) & maps.usable & is_distance(maps.truth_m)
    lidar_points = is_distance(maps.lidar_m) & maps.usable
    best, found = 0.0, (0, 0)
    height, width = known.shape
    for i in range(radius, height - radius):
        for j in range(radius, width - radius):
            window = slice(i - radius, i + radius + 1), slice(j - radius, j + radius + 1)
            if lidar_points[i, j] or not known[window].all() or not 4 <= maps.truth_m[i, j] <= 20:
                continue
            ratio = np.log(mono_m[window] / maps.truth_m[i, j])
            near, far = np.abs(ratio) < 0.1, ratio > 0.4
            score = min((near & lidar_points[window]).sum(), (far & lidar_points[window]).sum()) * min(
                near.mean(), far.mean()
            )
            # the monocular map has to be right at the pixel itself
            if near[radius, radius] and score > best:
                best, found = float(score), (i, j)
    assert best > 0, "no pixel lies at an edge"
    return found


def draw_kernel(scene: ShownScene, maps: PictureMaps) -> tuple[NDArray[np.uint8], dict[str, float]]:
    """What one pixel beside an edge averages, without and with the kernel's depth factor (Eq. 7)."""
    lidar_m, truth_m = maps.lidar_m, maps.truth_m
    assert lidar_m is not None and truth_m is not None
    options = IntegrationOptions()
    radius = options.kernel_size // 2
    mono_m = aligned(scene, maps)
    i, j = find_edge(mono_m, maps, radius)
    window = slice(i - radius, i + radius + 1), slice(j - radius, j + radius + 1)
    side = options.kernel_size * CELL_PX

    lidar, mono, usable = (torch.from_numpy(each) for each in (lidar_m, mono_m, maps.usable))
    integrated = {
        kind: float(integrate_depth(lidar, mono, usable, dataclasses.replace(options, kernel=kind)).distance_m[i, j])
        for kind in ("spatial-gaussian", "edge-aware")
    }
    k, l = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    spatial = np.exp(-(k**2 + l**2) / (2 * options.sigma_space_px**2))
    depth = np.exp(-((mono_m[i, j] - mono_m[window]) ** 2) / (2 * options.sigma_depth_m**2))

    def enlarged(values: NDArray) -> NDArray:
        return np.kron(values, np.ones((CELL_PX, CELL_PX, *([1] * (values.ndim - 2))), values.dtype))

    def marked(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rings at returns, a frame around the pixel itself."""
        drawn = np.ascontiguousarray(cells)
        for row, column in np.argwhere(is_distance(lidar_m[window])):
            at = (int((column + 0.5) * CELL_PX), int((row + 0.5) * CELL_PX))
            cv2.circle(drawn, at, CELL_PX // 4, (255, 255, 255), 2, cv2.LINE_AA)
            cv2.circle(drawn, at, CELL_PX // 4 + 2, (30, 30, 30), 1, cv2.LINE_AA)
        corner = radius * CELL_PX
        cv2.rectangle(drawn, (corner, corner), (corner + CELL_PX, corner + CELL_PX), (255, 255, 255), 2)
        return drawn

    def weights(values: NDArray, title: str, kind: str) -> NDArray[np.uint8]:
        grey = np.repeat(np.rint(enlarged(values) * 255).astype(np.uint8)[..., None], 3, axis=-1)
        return panel(marked(grey), title, text_bar(f"their average: {integrated[kind]:.2f} m", side, 40))

    truth = text_bar(f"truth in the framed pixel: {truth_m[i, j]:.2f} m", side, 40)
    shown = np.where(is_distance(lidar_m[window]), lidar_m[window], mono_m[window])
    panels = [
        panel(marked(colour_distance(enlarged(shown))), "distance (rings: LiDAR)", truth),
        weights(spatial, "weights without depth factor", "spatial-gaussian"),
        weights(spatial * depth, "edge-aware weights (Eq. 7)", "edge-aware"),
    ]
    return lay_out(panels, 3, []), {**integrated, "truth": float(truth_m[i, j])}


def surface_weights(edges_m: NDArray, surface_m: float, softness_m: float) -> NDArray:
    """How much of a ray ends in each sample, if a surface of some softness is met at a distance."""
    passed = 1 / (1 + np.exp((edges_m - surface_m) / softness_m))
    return passed[:-1] - passed[1:]


def losses(edges_m: NDArray, surfaces_m: NDArray, prior_m: float, sigma_m: float) -> NDArray:
    """The edge loss of rays that meet their surface at different distances."""
    edges, prior = torch.from_numpy(edges_m)[None], torch.tensor([prior_m], dtype=torch.float64)
    found = []
    for surface_m in surfaces_m:
        weights = torch.from_numpy(surface_weights(edges_m, surface_m, SOFTNESS_M))[None]
        given = weights, edges[:, :-1], edges[:, 1:], prior, torch.full_like(prior, sigma_m)
        (loss,) = edge_loss(*given, gaussian="interval", divide_by_norm=True)
        found.append(float(loss))
    return np.array(found)


def draw_ray(path: Path) -> None:
    """Along one ray: where it ends before and after training, the prior, and the loss over the surface's distance."""
    prior_m, sigma_m = 8.0, 0.6
    edges_m = np.geomspace(2, 20, 57)
    midpoints_m = (edges_m[:-1] + edges_m[1:]) / 2
    figure = Figure(figsize=FIGURE_SIZE_IN, layout="constrained")
    left, right = figure.subplots(1, 2)
    target = np.exp(-((midpoints_m - prior_m) ** 2) / (2 * sigma_m**2))
    left.fill_between(midpoints_m, target, color="#f2c36b", alpha=0.6, label="prior: 8 m, σ̂ = 0.6 m")
    for surface_m, softness_m, colour, name in (
        (11.0, 1.2, "#8a8a8a", "a ray early in training"),
        (8.0, SOFTNESS_M, "#2458a6", "the same ray later"),
    ):
        weights = surface_weights(edges_m, surface_m, softness_m)
        density = weights / np.diff(edges_m)
        left.stairs(density / density.max(), edges_m, color=colour, label=name)
    left.set(xlabel="distance along the ray, m", ylabel="of its largest value", xlim=(2, 20), ylim=(0, 1.35))
    left.legend(frameon=False, fontsize=8, loc="upper right")
    surfaces_m = np.linspace(4, 14, 201)
    for width_m, colour in ((0.2, "#9c2f2f"), (0.6, "#d08a20"), (2.0, "#3f7f4f")):
        right.plot(surfaces_m, losses(edges_m, surfaces_m, prior_m, width_m), color=colour, label=f"σ̂ = {width_m:g} m")
    right.axvline(prior_m, color="#8a8a8a", linewidth=0.8)
    right.set(xlabel="distance of the surface, m", ylabel="edge loss", xlim=(4, 14))
    right.legend(frameon=False, fontsize=8)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    write_atomically(path, lambda unfinished: figure.savefig(unfinished, format="svg", metadata={"Date": None}))


def make_pictures(output: Path) -> dict[str, float]:
    """Write all pictures; gives the distances that the kernel's picture names, metres.

    Raises:
        InputError: the sample drive's calibration is not that of its maps.
    """
    with tempfile.TemporaryDirectory() as folder:
        scene = read_sample(Path(folder))
        picture = next(each for each in scene.scene.pictures if each.frame == FRAME and each.camera == CAMERA)
        maps = scene.maps(picture)
        write_png(output / "method_maps.png", draw_maps(scene, maps))
        kernel, figures = draw_kernel(scene, maps)
    write_png(output / "method_kernel.png", kernel)
    # without the salt every run would name the parts of the drawing anew
    with rc_context({"svg.hashsalt": "edge-depth-nerf", "font.size": 9}):
        draw_ray(output / "method_ray.svg")
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Draw the pictures of docs/method.md.")
    parser.add_argument("--output", type=Path, default=ROOT / "docs", help="folder to write them to")
    print(make_pictures(parser.parse_args().output))
