"""How good the own monocular network is on pictures it never saw, and what its training costs.

    python benchmarks/mono.py --output outputs/mono                    # street, parking and turn, 40 moments of 350 px
    python benchmarks/mono.py --output outputs/mono --scenes SCENE …   # copies of scenes with truth

Trains one network per drive on its training pictures, as `edge-depth-nerf estimate-depth` does, and compares the maps
of the held-out pictures with the truth inside the mask up to 60 m: within LiDAR's field of elevation and outside it, at
LiDAR's own pixels, and within 4 px of depth edges in the field. A sheet of pictures of each drive lies beside.
"""

from __future__ import annotations

import argparse
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.files import read_distance_png, read_image, write_png
from edge_depth_nerf.base.pictures import colour_distance, side_by_side
from edge_depth_nerf.mono.estimate import PRESETS, estimate_depth
from edge_depth_nerf.mono.examples import lens_rays, view_of
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.process.kitti360.converter import process_kitti360
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

DRIVES = ("street", "parking", "turn")
FARTHEST_M = 60.0
FIELD_QUANTILES = (0.001, 0.999)
EDGE_RATIO, EDGE_PX = 1.25, 4


def make_scene(output: Path, drive: str, seed: int) -> Path:
    made = SynthesizeOptions(output=output / f"{drive}_drive", scene=drive, frames=40, size=350, seed=seed)  # pyright: ignore[reportArgumentType]
    synthesize_drive(made)
    scene = output / drive
    if not (scene / "transforms.json").is_file():
        process_kitti360(Kitti360Options(root=made.output, sequence=made.sequence, output=scene))
    return scene


def elevation_deg(scene: SceneFolder, picture) -> NDArray:
    rays, _ = lens_rays(picture.lens, scene.theta_max_rad, (picture.lens.width, picture.lens.height))
    return np.degrees(np.arcsin(np.clip(rays @ picture.up_in_camera, -1, 1)))


def field_deg(scene: SceneFolder) -> NDArray:
    """Lowest and highest elevation with LiDAR, over the training pictures."""
    found = [
        elevation_deg(scene, picture)[read_distance_png(picture.files["lidar"]) > 0]
        for picture in scene.pictures[::5]
        if not picture.held_out
    ]
    return np.quantile(np.concatenate(found), FIELD_QUANTILES)


def near_edges(truth_m: NDArray) -> NDArray[np.bool_]:
    """Within some pixels of a jump of the true distance."""
    near = cv2.erode(np.where(truth_m > 0, truth_m, 1e3).astype(np.float32), np.ones((3, 3)))
    far = cv2.dilate(truth_m.astype(np.float32), np.ones((3, 3)))
    jump = (far > EDGE_RATIO * near).astype(np.uint8)
    return cv2.dilate(jump, np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1))) > 0


def judge(scene: SceneFolder) -> dict[str, tuple[float, float, int]]:
    """AbsRel, δ<1.25 and count by region, over the held-out pictures."""
    low, high = field_deg(scene)
    sums: dict[str, NDArray] = {}
    for picture in scene.pictures:
        if not picture.held_out:
            continue
        truth_m, mono_m = (read_distance_png(picture.files[layer]) for layer in ("truth", "mono"))
        lidar_m = read_distance_png(picture.files["lidar"])
        usable = view_of(picture, scene.theta_max_rad, max(truth_m.shape)).usable
        elevation = elevation_deg(scene, picture)
        judged = usable & (truth_m > 0) & (truth_m <= FARTHEST_M)
        in_field = judged & (elevation >= low - 3) & (elevation <= high + 3)
        # where a map says "far beyond" it counts as 200 m
        found_m = np.where(mono_m > 0, mono_m, 200.0)
        true_m = np.where(judged, truth_m, 1.0)
        for name, where in {
            "in the field": in_field,
            "at LiDAR's pixels": judged & (lidar_m > 0),
            "edges in the field": in_field & near_edges(truth_m),
            "outside the field": judged & ~in_field,
        }.items():
            error = (np.abs(found_m - true_m) / true_m)[where]
            good = np.maximum(found_m / true_m, true_m / found_m)[where] < 1.25
            sums[name] = sums.get(name, 0) + np.array([error.sum(), good.sum(), where.sum()])
        sky = usable & ((truth_m == 0) | (truth_m > 150))
        if sky.any():
            sums["sky left out"] = sums.get("sky left out", 0) + np.array([0, (mono_m[sky] == 0).sum(), sky.sum()])
    return {name: (total[0] / total[2], total[1] / total[2], int(total[2])) for name, total in sums.items()}


def sheet(scene: SceneFolder) -> NDArray[np.uint8]:
    held_out = [picture for picture in scene.pictures if picture.held_out]
    rows = []
    for picture in held_out[:: max(len(held_out) // 4, 1)][:4]:
        usable = view_of(picture, scene.theta_max_rad, max(picture.lens.width, picture.lens.height)).usable
        maps = [
            colour_distance(read_distance_png(picture.files[layer]), usable) for layer in ("lidar", "mono", "truth")
        ]
        rows.append([read_image(picture.files["image"]), *maps])
    return side_by_side(rows, ["held out", "LiDAR", "network", "truth"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, nargs="*", default=[])
    parser.add_argument("--preset", choices=list(PRESETS), default="lite")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--train-steps", type=int)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    console = Console()
    scenes = []
    for given in options.scenes:
        scenes.append(options.output / given.name)
        if not scenes[-1].is_dir():
            shutil.copytree(given, scenes[-1])
    scenes = scenes or [make_scene(options.output, drive, options.seed) for drive in DRIVES]

    table = Table("drive", "where", "AbsRel", "δ<1.25", "pixels", title=f"held-out pictures, {options.preset}")
    costs = Table("drive", "steps", "wall s", "CPU s", "threads")
    for folder in scenes:
        wall, cpu = time.monotonic(), time.process_time()
        report = estimate_depth(
            EstimateDepthOptions(
                (folder,),
                preset=options.preset,
                seconds=options.seconds,
                train_steps=options.train_steps,
                seed=options.seed,
            ),
            console,
        )
        wall, cpu = time.monotonic() - wall, time.process_time() - cpu
        steps = report.trained.steps if report.trained else 0
        costs.add_row(folder.name, str(steps), f"{wall:.0f}", f"{cpu:.0f}", str(torch.get_num_threads()))
        scene = read_scene(folder)
        for name, (error, good, count) in judge(scene).items():
            table.add_row(
                folder.name, name, "" if name == "sky left out" else f"{error:.3f}", f"{good:.3f}", str(count)
            )
        write_png(options.output / f"{folder.name}.png", sheet(scene))
    console.print(table)
    console.print(costs)


if __name__ == "__main__":
    main()
