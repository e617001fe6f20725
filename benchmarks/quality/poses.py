"""How near poses that `process` finds come to the truth of synthetic drives: COLMAP's and LiDAR odometry's.

    edge-depth-nerf synthesize --output outputs/street --scene street
    python -m benchmarks.quality.poses odometry outputs/street outputs/turn
    python -m benchmarks.quality.poses colmap outputs/street --frames 12

odometry   The path is laid on the true one by its first pose, as for a vehicle that knows only where it began. The
           table has the errors of the end and the largest one, as shares of the path, and those of single steps.
colmap     Errors of the camera centres after a similarity to the true ones (Umeyama, PAMI 1991), as a share of the
           path; the error of the scale is that of the unchanged poses. The ego mask is not given.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from edge_depth_nerf.process.colmap.poses import colmap_poses
from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.lidar_poses import check_sweeps, path_of
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions, RigOptions

COLUMNS = {
    "odometry": ("sweeps", "path m", "end %", "most %", "step mm", "most", "step °", "most", "s a sweep"),
    "colmap": ("pictures", "registered", "path m", "centres max %", "median %", "scale error %", "spread %", "s"),
}
Row = tuple[str, ...]
Poses = NDArray[np.float64]


def options_of(drive: Path, output: Path, frames: int | None) -> ProcessOptions:
    """Recognise the layout of a drive."""
    if (drive / "data_poses").is_dir():
        sequence = next((drive / "data_poses").iterdir()).name
        return Kitti360Options(root=drive, sequence=sequence, output=output, frames=frames)
    return RigOptions(root=drive, output=output, frames=frames)


def steps(path: Poses) -> Poses:
    """The motion from each pose to the next."""
    return np.linalg.inv(path[:-1]) @ path[1:]


def off(found: Poses, true: Poses) -> tuple[NDArray, NDArray]:
    """Metres and degrees by which the steps of a path are wrong."""
    wrong = np.linalg.inv(steps(true)) @ steps(found)
    return np.linalg.norm(wrong[:, :3, 3], axis=-1), np.degrees(Rotation.from_matrix(wrong[:, :3, :3]).magnitude())


def turned_over(points: NDArray, true: NDArray) -> tuple[NDArray, NDArray]:
    """Both without their mean, and the first turned over the second."""
    points, true = points - points.mean(0), true - true.mean(0)
    return Rotation.align_vectors(true, points)[0].apply(points), true


def length_m(path: Poses) -> float:
    """How long a path is."""
    return float(np.linalg.norm(steps(path)[:, :3, 3], axis=-1).sum())


def odometry(options: ProcessOptions, console: Console) -> Iterator[Row]:
    recording = read_drive(options)
    assert recording.trajectory is not None
    sweeps = check_sweeps(recording)
    start = time.perf_counter()
    found = path_of(sweeps, console)
    seconds = time.perf_counter() - start
    true = recording.trajectory.at(found.times_s)
    laid = true[0] @ np.linalg.inv(found.vehicle_to_world[0]) @ found.vehicle_to_world
    share = 100 * np.linalg.norm((laid - true)[:, :3, 3], axis=-1) / length_m(true)
    shift_m, turn_deg = off(laid, true)
    yield (
        *(str(len(sweeps)), f"{length_m(true):.1f}", f"{share[-1]:.2f}", f"{share.max():.2f}"),
        *(f"{1000 * shift_m.mean():.0f}", f"{1000 * shift_m.max():.0f}"),
        *(f"{turn_deg.mean():.3f}", f"{turn_deg.max():.3f}", f"{seconds / len(sweeps):.2f}"),
    )


def colmap(options: ProcessOptions, console: Console) -> Iterator[Row]:
    by_colmap = dataclasses.replace(options, poses="colmap")
    truth, recording = read_drive(options), read_drive(by_colmap)
    start = time.perf_counter()
    found = colmap_poses(recording, by_colmap, console)
    seconds = time.perf_counter() - start
    true = {(p.camera, p.frame): truth.pose(p) for p in truth.pictures}
    centres, goal = turned_over(
        np.stack([found.pose(p)[:3, 3] for p in found.pictures]),
        np.stack([true[p.camera, p.frame][:3, 3] for p in found.pictures]),
    )
    scale = (centres * goal).sum() / (centres**2).sum()
    path_m = length_m(np.stack([truth.pose(p) for p in truth.pictures if p.camera == truth.cameras[0].name]))
    share = 100 * np.linalg.norm(scale * centres - goal, axis=-1) / path_m
    spread = next(notice for notice in found.notices if "spread" in notice).split("spread ")[1].split(" %")[0]
    yield (
        *(str(len(recording.pictures)), str(len(found.pictures)), f"{path_m:.1f}", f"{share.max():.3f}"),
        *(f"{np.median(share):.3f}", f"{100 * (1 / scale - 1):+.3f}", spread, f"{seconds:.0f}"),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=COLUMNS)
    parser.add_argument("drives", nargs="+", type=Path, help="folders written by `edge-depth-nerf synthesize`")
    parser.add_argument("--frames", type=int, help="only so many frames of each")
    arguments = parser.parse_args()
    console = Console(width=160)
    table = Table("drive", *COLUMNS[arguments.what], title=f"Poses against the truth: {arguments.what}")
    evaluate = {"odometry": odometry, "colmap": colmap}[arguments.what]
    for drive in arguments.drives:
        with tempfile.TemporaryDirectory() as folder:
            for row in evaluate(options_of(drive, Path(folder) / "scene", arguments.frames), console):
                table.add_row(drive.name, *row)
    console.print(table)


if __name__ == "__main__":
    main()
