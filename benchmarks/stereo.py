"""How right distances from motion are, against the truth of rendered drives or the LiDAR of real ones.

    edge-depth-nerf synthesize --scene street --frames 24 --seed 11 --output outputs/raw/street
    edge-depth-nerf process kitti360 --root outputs/raw/street --sequence 2013_05_28_drive_0000_sync \\
        --no-estimate-depth --output outputs/street
    python benchmarks/stereo.py outputs/street --output outputs/stereo

Sweeps are kept in the output folder, so that an interrupted run goes on where it stopped. Parallax is that of the true
point, in the neighbour that tells most; enough is 4 px. Above: of pixels above LiDAR's field, the highest elevation
that a thousandth of its returns has. `inside` leaves out pixels within 2 px of a jump of the true distance by a tenth,
where a pixel shows two things. A second table gives the share of kept distances that are right to 10 %, and their
median error, by confidence and by the parallax that was found. Each scene gets a sheet of four of its pictures: RGB,
truth, distance, error (blue 0, red 30 % and more).

Of scenes that `process` has finished, with LiDAR, monocular maps and maps from motion, the default prior of the
training pictures is judged too, with motion and without: what share of the pixels has one, how wrong it is in LiDAR's
field and beyond it, and how many errors are within one and two sigma; beyond it also by whether a pixel has a distance
from motion. The share of the sky that has a prior is printed too, which is to be none. --only-prior judges the prior
alone.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.files import write_png
from edge_depth_nerf.method.integration import INTEGRATED
from edge_depth_nerf.method.prior import PriorOptions, make_prior, view_of
from edge_depth_nerf.mono.calibration import find_trust
from edge_depth_nerf.process.motion import SweepStore
from edge_depth_nerf.process.motion import scene_view as view
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.stereo import sphere_sweep
from edge_depth_nerf.stereo.motion import Motion
from edge_depth_nerf.stereo.sweep import Geometry, Swept, rays_of
from edge_depth_nerf.stereo.views import View, working_factor

ENOUGH_PX = 4.0
NEAREST_SHOWN_M, FARTHEST_SHOWN_M = 1.0, 80.0
WORST_SHOWN = 0.3
COLUMNS = ("drive", "pixels", "judged", "kept", "of enough", "AbsRel", "median", "< 5 %", "> 20 %", "s a picture")
CONFIDENCES = (0.7, 0.8, 0.9, 0.95, 1.01)
PARALLAXES_PX = (2, 4, 8, 16, 32, 64, 1e4)
PRIOR_COLUMNS = ("drive", "prior", "pixels", "have one", "AbsRel", "median", "1 sigma", "2 sigma")


def parallax_px(seen: View, neighbours: list[View], distance_m: NDArray[np.float32]) -> NDArray[np.float32]:
    geometry, angle = Geometry.of(seen, neighbours), np.empty_like(distance_m)
    inverse = np.where(distance_m > 0, 1 / np.where(distance_m > 0, distance_m, 1), 0).astype(np.float32)
    sphere_sweep.parallax(rays_of(seen), inverse, geometry.pictures, *geometry.transforms, angle)
    return angle * np.float32(seen.focal_px)


def beside_jumps(distance_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(distance_m > 0, distance_m, 1e3).astype(np.float32)
    jumps = cv2.dilate(far, kernel) > 1.1 * cv2.erode(far, kernel)
    return cv2.dilate(jumps.astype(np.uint8), kernel) > 0


def coloured(values: NDArray, where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    colours = matplotlib.colormaps["turbo"](np.clip(values, 0, 1))[..., :3]
    return np.where(where[..., None], 255 * colours, 0).astype(np.uint8)


def panel(rgb: NDArray, truth_m: NDArray, found_m: NDArray, used: NDArray[np.bool_]) -> NDArray[np.uint8]:
    def depth(metres: NDArray) -> NDArray[np.uint8]:
        nearness = np.log(np.clip(metres, NEAREST_SHOWN_M, FARTHEST_SHOWN_M) / NEAREST_SHOWN_M)
        return coloured(1 - nearness / np.log(FARTHEST_SHOWN_M / NEAREST_SHOWN_M), used & (metres > 0))

    both = used & (truth_m > 0) & (found_m > 0)
    error = np.abs(found_m - truth_m) / np.where(both, truth_m, 1) / WORST_SHOWN
    return np.concatenate([rgb, depth(truth_m), depth(found_m), coloured(error, both)], 1)


def judge(scene_path: Path, output: Path, every: int) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
    scene = read_scene(scene_path)
    pictures = [picture for picture in scene.pictures if not picture.held_out]
    positions = np.stack([picture.position_m for picture in pictures])
    motion = Motion(positions, [picture.camera for picture in pictures], lambda index: view(scene, pictures[index]))
    store = SweepStore(output / "sweeps" / scene.folder.name, scene, pictures, motion)
    seconds: list[float] = []

    def sweep(index: int) -> Swept:
        begin = time.process_time()
        if store.make(index):
            seconds.append(time.process_time() - begin)
        return store(index)

    rows = []
    panels = []
    layer = "truth_distance" if scene.has("truth_distance") else "lidar"
    judged = range(0, len(pictures), every)
    for index in judged:
        picture = pictures[index]
        for neighbour in (index, *motion.neighbours(index)):
            sweep(neighbour)
        found = motion.confirm(index, sweep)
        seen = view(scene, picture)
        truth_m = scene.distance_m(picture, layer)
        assert truth_m is not None
        # nearest: where LiDAR has a return it stays one
        factor = working_factor(picture.lens)
        truth_m = np.ascontiguousarray(truth_m[factor // 2 :: factor, factor // 2 :: factor])
        truth_m = truth_m[: found.distance_m.shape[0], : found.distance_m.shape[1]]
        truth_m = np.where(seen.used, truth_m, np.float32(0))
        neighbours = [view(scene, pictures[other]) for other in motion.neighbours(index)]
        enough = parallax_px(seen, neighbours, truth_m) >= ENOUGH_PX if neighbours else np.zeros(truth_m.shape, bool)
        lidar_m = scene.lidar_m(picture)[factor // 2 :: factor, factor // 2 :: factor]
        lidar_m = lidar_m[: truth_m.shape[0], : truth_m.shape[1]]
        sine = seen.rays.directions @ picture.up_in_camera.astype(np.float32)
        above = sine > (np.quantile(sine[lidar_m > 0], 0.999) if (lidar_m > 0).any() else 1.0)
        rows.append(
            np.stack(
                [
                    each[truth_m > 0].astype(np.float32)
                    for each in (
                        *(truth_m, found.distance_m, found.confidence, found.parallax_px),
                        *(enough, above, beside_jumps(truth_m)),
                    )
                ],
                -1,
            )
        )
        if index in list(judged)[:: max(1, len(judged) // 4)][:4]:
            rgb = cv2.resize(scene.rgb(picture), truth_m.shape[::-1], interpolation=cv2.INTER_AREA)
            panels.append(panel(rgb, truth_m, found.distance_m, seen.used))
    sheet = np.concatenate(panels, 0)
    write_png(output / f"{scene.folder.name}.png", sheet)
    truth, distance, confidence, parallax, enough, above, edge = np.concatenate(rows).T
    spent = f"{np.mean(seconds):.1f}" if seconds else "-"
    parts = {"all": truth > 0, "inside": edge == 0, "above": above > 0}
    if layer == "lidar":
        parts = {"LiDAR": truth > 0}
    table = []
    for name, where in parts.items():
        if not where.any():
            continue
        kept = where & (distance > 0)
        error = np.abs(distance - truth)[kept] / truth[kept]
        error = error if len(error) else np.full(1, np.nan)
        of_enough = (kept & (enough > 0)).sum() / max(1, (where & (enough > 0)).sum())
        table.append(
            (
                *(scene.folder.name, name, f"{where.sum():,}", f"{kept.sum() / where.sum():.0%}", f"{of_enough:.0%}"),
                *(f"{error.mean():.3f}", f"{np.median(error):.4f}"),
                *(f"{(error < 0.05).mean():.1%}", f"{(error > 0.2).mean():.1%}", spent),
            )
        )
    error = np.abs(distance - truth) / truth
    bins = []
    for what, values, edges in (("confidence", confidence, CONFIDENCES), ("parallax, px", parallax, PARALLAXES_PX)):
        for low, high in pairwise(edges):
            where = (distance > 0) & (values >= low) & (values < high)
            if where.any():
                right, median = (error[where] < 0.1).mean(), np.median(error[where])
                bins.append(
                    (scene.folder.name, what, f"{low:g}-{high:g}", f"{where.sum():,}", f"{right:.1%}", f"{median:.4f}")
                )
    return table, bins


def prior_pixels(scene: SceneFolder, options: PriorOptions, every: int = 1) -> NDArray[np.float64]:
    """Each used pixel of the training pictures: the true distance (0: none is known, or it is sky), the prior's and its
    sigma (metres), whether it lies outside LiDAR's field, and whether motion has a distance there; 5×N."""
    trust, rows = find_trust(scene, options), []
    layer = true_layer(scene)
    for picture in [picture for picture in scene.pictures if not picture.held_out][::every]:
        maps, view_angles = scene.maps(picture), view_of(picture.lens, picture.up_in_camera)
        prior = make_prior(maps.distances_m, maps.usable, INTEGRATED, options, trust, view_angles)
        truth = maps.distances_m[layer]
        outside = ~trust.in_field(view_angles.elevation_rad)
        matched = maps.distances_m.get("motion", np.zeros_like(truth)) > 0
        of_pixels = (truth, prior.distance_m, prior.sigma_m, outside, matched)
        rows.append(np.stack([each[maps.usable] for each in of_pixels], -1))
    return np.concatenate(rows).T


def true_layer(scene: SceneFolder) -> str:
    return "truth_distance" if scene.has("truth_distance") else "beams"


@dataclass(frozen=True)
class PriorFigures:
    """How good a prior is on some pixels: shares of 0-1."""

    have_one: float
    abs_rel: float
    median: float
    within_1: float
    """Of the priors, how many have an error of one sigma at most."""
    within_2: float


def prior_figures(pixels: NDArray[np.float64]) -> PriorFigures | None:
    """Of those pixels that `prior_pixels` gives whose truth is known; None if none has a prior."""
    pixels = pixels[:, pixels[0] > 0]
    truth, distance, sigma, *_ = pixels[:, pixels[1] > 0]
    if not len(truth):
        return None
    error = np.abs(distance - truth)
    within = [float((error <= times * sigma).mean()) for times in (1, 2)]
    relative = error / truth
    return PriorFigures(len(truth) / pixels.shape[1], float(relative.mean()), float(np.median(relative)), *within)


def judge_prior(scene_path: Path, every: int) -> list[tuple[str, ...]]:
    scene = read_scene(scene_path)
    if not all(scene.has(name) for name in ("lidar", "mono", "motion", true_layer(scene))):
        return []
    table = []
    for motion in (False, True):
        pixels = prior_pixels(scene, PriorOptions(motion=motion), every)
        truth, distance, _, outside, matched = pixels
        source = "with motion" if motion else "without"
        if true_layer(scene) == "truth_distance" and (truth == 0).any():
            share = (distance[truth == 0] > 0).mean()
            table.append((scene.folder.name, source, "sky", f"{share:.1%}", *4 * "-"))
        for name, where in {
            "all": truth > 0,
            "in the field": outside == 0,
            "beyond": outside > 0,
            "beyond, matched": (outside > 0) & (matched > 0),
            "beyond, not matched": (outside > 0) & (matched == 0),
        }.items():
            if found := prior_figures(pixels[:, where]):
                table.append(
                    (
                        *(scene.folder.name, source, name),
                        *(f"{found.have_one:.0%}", f"{found.abs_rel:.4f}", f"{found.median:.4f}"),
                        *(f"{found.within_1:.1%}", f"{found.within_2:.1%}"),
                    )
                )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="scene folders written by `process`")
    parser.add_argument("--output", type=Path, default=Path("outputs/stereo"), help="sweeps, tables and pictures")
    parser.add_argument("--every", type=int, default=1, help="judge every so many-th training picture")
    parser.add_argument("--only-prior", action="store_true", help="judge the prior alone, which takes seconds")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console = Console(width=120)
    table = Table(*COLUMNS, title="Distances from motion")
    bins = Table("drive", "by", "from - to", "pixels", "right to 10 %", "median", title="What is kept")
    for scene in [] if arguments.only_prior else arguments.scenes:
        of_scene, by_bins = judge(scene, arguments.output, arguments.every)
        for row in of_scene:
            table.add_row(*row)
        for row in by_bins:
            bins.add_row(*row)
    if not arguments.only_prior:
        console.print(table, bins)
    priors = Table(*PRIOR_COLUMNS, title="The default prior of training pictures")
    for scene in arguments.scenes:
        for row in judge_prior(scene, arguments.every):
            priors.add_row(*row)
    console.print(priors)
    arguments.output.mkdir(parents=True, exist_ok=True)
    with (arguments.output / "table.txt").open("w") as file:
        Console(file=file, width=120).print(table, bins, priors)


if __name__ == "__main__":
    main()
