"""How true the cloud of `export` is: its points against the true surfaces of the sample drive.

    python -m benchmarks.quality.cloud

A point's error is its distance from the nearest of the planes at the five nearest pixels of ground truth.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from scipy.spatial import KDTree

from edge_depth_nerf.export.cloud import normals_of
from edge_depth_nerf.export.command import export_scene
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.scene.reader import SceneFolder, read_scene

SCENE = Path(__file__).parents[2] / "data/sample_drive"
MOST_ERRORS = (0.03, 0.05, 0.1)
FARTHEST_M = 80.0


def surfaces(scene: SceneFolder) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of the ground truth of all pictures, in the recording's world."""
    points, normals = [], []
    for picture in scene.pictures:
        distance_m, rays = scene.distance_m(picture, "truth_distance"), scene.rays(picture)
        assert distance_m is not None
        row, column = np.nonzero(rays.within & (distance_m > 0) & (distance_m < FARTHEST_M))
        pose = picture.pose
        in_camera = rays.directions[row, column] * distance_m[row, column, None]
        points.append(in_camera @ pose[:3, :3].T + pose[:3, 3])
        found = normals_of(distance_m.astype(np.float64), rays.directions, row, column, 3)
        normals.append(found @ pose[:3, :3].T)
    return np.concatenate(points) + scene.world_offset_m, np.concatenate(normals)


def main() -> None:
    scene = read_scene(SCENE)
    points, normals = surfaces(scene)
    tree = KDTree(points)
    print("| `--most-error` | points | median | 95 % are within |\n|---|---|---|---|")
    for most in MOST_ERRORS:
        with tempfile.TemporaryDirectory() as folder:
            options = ExportOptions(SCENE, form="points", most_error=most, output=Path(folder) / "cloud")
            cloud, _ = read_cloud(export_scene(options, Console(quiet=True)) / "points.ply")
        near = tree.query(cloud, 5)[1]
        off = np.abs(((cloud[:, None] - points[near]) * normals[near]).sum(-1)).min(1)
        print(f"| {most:g} | {len(cloud):,} | {100 * np.median(off):.1f} cm | {100 * np.quantile(off, 0.95):.0f} cm |")


if __name__ == "__main__":
    main()
