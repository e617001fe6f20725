"""How near COLMAP's poses come to the truth of a synthetic drive, and LiDAR's scale to 1.

    edge-depth-nerf synthesize --output outputs/street --scene street
    python benchmarks/colmap.py outputs/street outputs/turn outputs/parking

Errors of the camera centres are what a similarity to the true ones leaves (Umeyama, PAMI 1991), as a share of the
path's length; the error of the scale is that of the poses as they are. The ego mask is not given.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.process.colmap.poses import colmap_poses
from edge_depth_nerf.process.kitti360.calibration import read_poses
from edge_depth_nerf.process.kitti360.converter import read_kitti360
from edge_depth_nerf.process.options import Kitti360Options

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from alignment import umeyama  # pyright: ignore[reportMissingImports]

COLUMNS = ("drive", "pictures", "registered", "path m", "centres max %", "median %", "scale error %", "spread %", "s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, help="folders written by `edge-depth-nerf synthesize`")
    parser.add_argument("--frames", type=int, help="only so many frames of each")
    arguments = parser.parse_args()
    console = Console(width=120)
    table = Table(*COLUMNS, title="Poses by COLMAP against the truth")
    for drive in arguments.drives:
        sequence = next((drive / "data_poses").iterdir()).name
        truth = read_poses(drive / "data_poses" / sequence / "poses.txt")
        with tempfile.TemporaryDirectory() as folder:
            options = Kitti360Options(
                root=drive, sequence=sequence, output=Path(folder) / "scene", frames=arguments.frames, poses="colmap"
            )
            recording = read_kitti360(options)
            start = time.perf_counter()
            found = colmap_poses(recording, options, console)
            seconds = time.perf_counter() - start
        for notice in found.notices:
            console.print(notice)
        to_vehicle = {camera.name: camera.to_vehicle for camera in found.cameras}
        centres = np.stack([p.camera_to_world[:3, 3] for p in found.pictures if p.camera_to_world is not None])
        true = np.stack([(truth[p.frame] @ to_vehicle[p.camera])[:3, 3] for p in found.pictures])
        scale, error_m = umeyama(centres, true)
        path_m = np.linalg.norm(np.diff([truth[f][:3, 3] for f in sorted(truth)][: arguments.frames], axis=0), axis=-1)
        share = 100 * error_m / path_m.sum()
        spread = next(notice for notice in found.notices if "spread" in notice).split("spread ")[1].split(" %")[0]
        table.add_row(
            *(drive.name, str(len(recording.pictures)), str(len(found.pictures)), f"{path_m.sum():.1f}"),
            *(f"{share.max():.3f}", f"{np.median(share):.3f}", f"{100 * (1 / scale - 1):+.3f}", spread),
            f"{seconds:.0f}",
        )
    console.print(table)


if __name__ == "__main__":
    main()
