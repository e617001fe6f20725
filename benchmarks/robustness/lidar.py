"""How far LiDAR in the pictures can be trusted, against the truth of a synthesised drive.

    python -m benchmarks.robustness.lidar --output outputs/lidar

Synthesises a street at KITTI-360's picture size (some ten minutes the first time), then prints

  de-skewing   distance of each LiDAR point from where it truly was, raw and de-skewed;
  projection   of the pixels with a LiDAR point, how many are wrong: more than 5 % outside the true distances of the 3×3
               pixels around; how many of the right ones are kept when what is hidden or has moved is left out.
"""

from __future__ import annotations

import argparse
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from edge_depth_nerf.base.files import read_distance_png, read_mask
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.lidar.scans import ScanFormat, read_scan
from edge_depth_nerf.lidar.world import sweep_in_world
from edge_depth_nerf.process.kitti360.converter import read_kitti360
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.process.sweep_store import SweepStore
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

WRONG = 0.05
HOLDOUT_EVERY = 8


def drive(output: Path, **options: object) -> SynthesizeOptions:
    made = SynthesizeOptions(output=output, **options)  # pyrefly: ignore[bad-argument-type]
    synthesize_drive(made)
    return made


def options(made: SynthesizeOptions, sweeps: int, *, raw_lidar: bool = False) -> Kitti360Options:
    return Kitti360Options(
        root=made.output,
        sequence=made.sequence,
        output=Path("unused"),
        sweeps=sweeps,
        raw_lidar=raw_lidar,
        ego_mask=made.output / "truth" / "masks",
        holdout_every=HOLDOUT_EVERY,
    )


def deskewing(made: SynthesizeOptions) -> Table:
    """Distances from the truth in the scanner's frame of the sweep's moment."""
    found = read_kitti360(options(made, 0))
    assert found.trajectory is not None
    errors: dict[str, list[NDArray]] = {"raw": [], "de-skewed": []}
    for recorded in found.sweeps:
        truth = np.fromfile(made.output / f"truth/{made.sequence}/points/{recorded.path.name}", "<f4").reshape(-1, 4)
        sweep = read_scan(recorded.path, ScanFormat())
        for name, deskew in (("raw", False), ("de-skewed", True)):
            world = sweep_in_world(
                sweep, recorded.time_s, recorded.to_vehicle, found.trajectory, recorded.timing, deskew=deskew
            )
            points = transform_points(torch.from_numpy(world.world_to_scanner), world.points_m).numpy()
            errors[name].append(np.linalg.norm(points - truth[:, :3], axis=-1))
    table = Table("points", "median cm", "95 % cm", "largest cm", title=f"De-skewing ({made.mean_speed_m_s:g} m/s)")
    for name, parts in errors.items():
        every = 100 * np.concatenate(parts)
        table.add_row(name, *(f"{value:.1f}" for value in (*np.quantile(every, (0.5, 0.95)), every.max())))
    return table


def nothing_moved(scanner: Any, index: int) -> torch.Tensor:
    return torch.zeros(len(scanner.whole(index).points_m), dtype=torch.bool)


def right(distance_m: NDArray, truth_m: NDArray) -> NDArray[np.bool_]:
    """Which returns lie within the true distances around, give or take 5 %."""
    around = np.ones((3, 3), np.uint8)
    # 0 = sky: no distance is right there
    nearest = cv2.erode(np.where(truth_m > 0, truth_m, np.float32(1e6)), around)
    farthest = cv2.dilate(np.where(truth_m > 0, truth_m, np.float32(-1)), around)
    return (distance_m > 0) & (distance_m >= nearest * (1 - WRONG)) & (distance_m <= farthest * (1 + WRONG))


KINDS = ("recorded", "de-skewed", "kept")
"""As recorded, all points; each point moved by its own time, all points; without what is hidden or has moved."""


class Counts:
    """Returns of many pictures, by kind."""

    def __init__(self) -> None:
        self.lidar_points, self.right, self.both, self.usable = Counter(), Counter(), 0, 0

    def add(self, maps: dict[str, NDArray], truth: NDArray, mask: NDArray[np.bool_]) -> None:
        good = {kind: right(distance_m, truth) & mask for kind, distance_m in maps.items()}
        self.lidar_points.update({kind: int(((distance_m > 0) & mask).sum()) for kind, distance_m in maps.items()})
        self.right.update({kind: int(where.sum()) for kind, where in good.items()})
        self.both += int((good["de-skewed"] & good["kept"]).sum())
        self.usable += int(mask.sum())

    def row(self) -> tuple[str, ...]:
        return (
            *(f"{1 - self.right[kind] / self.lidar_points[kind]:.2%}" for kind in KINDS),
            f"{self.both / self.right['de-skewed']:.1%}",
            *(f"{self.lidar_points[kind] / self.usable:.1%}" for kind in ("de-skewed", "kept")),
        )


COLUMNS = (*(f"wrong: {kind}" for kind in KINDS), "right ones kept", "cover: all", "kept")


def evaluate(made: SynthesizeOptions, reach: int, every: int) -> dict[str, Counts]:
    """Project the sweeps that training pictures get, and compare the maps with the truth."""
    found = read_kitti360(options(made, reach))
    held_out = {frame for frame in range(made.frames) if frame % HOLDOUT_EVERY == HOLDOUT_EVERY // 2}
    stores = {kind: SweepStore(found, options(made, reach, raw_lidar=kind == "recorded"), held_out) for kind in KINDS}
    for kind, store in stores.items():
        for scanner in store.scanners if kind != "kept" else ():
            scanner.moved = partial(nothing_moved, scanner)
    masks = {recorded.name: read_mask(made.output / f"truth/masks/{recorded.name}.png") for recorded in found.cameras}
    counts = {name: Counts() for name in masks}
    pictures = [p for p in found.pictures if p.frame not in held_out and p.frame % every == 0]
    for picture in track(pictures, f"K = {reach}", transient=True):
        assert picture.truth_distance is not None
        maps = {kind: project(picture, found, stores[kind], everything=kind != "kept") for kind in KINDS}
        counts[picture.camera].add(maps, read_distance_png(picture.truth_distance), masks[picture.camera])
    return counts


def project(picture: RecordedPicture, found: Recording, store: SweepStore, *, everything: bool) -> NDArray:
    camera = next(recorded.camera for recorded in found.cameras if recorded.name == picture.camera)
    assert picture.camera_to_world is not None
    around = store.around(picture.frame, picture.time_s, picture.camera_to_world)
    in_camera = transform_points(torch.from_numpy(np.linalg.inv(picture.camera_to_world)), around.points_m).float()
    if everything:
        return project_points(in_camera[~around.only_hides], camera).distance_m.numpy()
    return project_points(
        in_camera, camera, spacing_m=around.spacing_m, age_s=around.age_s, only_hides=around.only_hides
    ).distance_m.numpy()


def projection(made: SynthesizeOptions) -> Table:
    table = Table("K", "camera", *COLUMNS, title=f"Projection at {made.size}×{made.size} px")
    for reach in (0, 3, 5):
        for name, counts in evaluate(made, reach, 2).items():
            table.add_row(str(reach), name, *counts.row())
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/lidar"))
    parser.add_argument("--size", type=int, default=1400)
    parser.add_argument("--frames", type=int, default=24)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    console = Console(width=120)
    street = drive(arguments.output / "street", scene="street", frames=arguments.frames, size=arguments.size)
    console.print(deskewing(street))
    console.print(projection(street))


if __name__ == "__main__":
    main()
