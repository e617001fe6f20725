"""How near LiDAR odometry comes to the poses that a drive has.

    edge-depth-nerf synthesize --output outputs/street --scene street
    edge-depth-nerf synthesize --output outputs/turn --scene turn --layout rig
    python benchmarks/odometry.py outputs/street outputs/turn

The path is laid on the true one by its first pose, as a vehicle that knows only where it began: the error of its end
and the largest one, as shares of the path's length; errors of the steps from one sweep to the next.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.lidar_poses import check_sweeps, path_of
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions, RigOptions

COLUMNS = ("drive", "sweeps", "path m", "end %", "most %", "step mm", "most", "step °", "most", "s a sweep")


def options_of(drive: Path) -> ProcessOptions:
    poses = list((drive / "data_poses").glob("*/poses.txt"))
    if not poses:
        return RigOptions(root=drive, output=drive / "none")
    return Kitti360Options(root=drive, sequence=poses[0].parent.name, output=drive / "none")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, help="folders written by `synthesize`, KITTI-360's, or a rig's")
    parser.add_argument("--sweeps", type=int, help="only so many sweeps of each")
    arguments = parser.parse_args()
    console = Console(width=120)
    table = Table(*COLUMNS, title="LiDAR odometry against the drive's poses")
    for drive in arguments.drives:
        recording = read_drive(options_of(drive))
        assert recording.trajectory is not None
        sweeps = check_sweeps(recording)[: arguments.sweeps]
        start = time.perf_counter()
        found = path_of(sweeps, console)
        seconds = time.perf_counter() - start
        true, poses = recording.trajectory.at(found.times_s), found.vehicle_to_world
        laid = true[0] @ np.linalg.inv(poses[0]) @ poses
        apart = np.linalg.norm((laid - true)[:, :3, 3], axis=-1)
        steps, expected = (np.linalg.inv(path[:-1]) @ path[1:] for path in (laid, true))
        wrong = np.linalg.inv(expected) @ steps
        step_mm = 1000 * np.linalg.norm(wrong[:, :3, 3], axis=-1)
        step_deg = np.degrees(Rotation.from_matrix(wrong[:, :3, :3]).magnitude())
        length_m = np.linalg.norm(expected[:, :3, 3], axis=-1).sum()
        table.add_row(
            *(drive.name, str(len(sweeps)), f"{length_m:.1f}"),
            *(f"{100 * apart[-1] / length_m:.2f}", f"{100 * apart.max() / length_m:.2f}"),
            *(f"{step_mm.mean():.0f}", f"{step_mm.max():.0f}", f"{step_deg.mean():.3f}", f"{step_deg.max():.3f}"),
            f"{seconds / len(sweeps):.2f}",
        )
    console.print(table)


if __name__ == "__main__":
    main()
