"""Draw docs/export_cloud.jpg: the LiDAR points of the sample drive, and the cloud that `export` makes of its prior."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from edge_depth_nerf.export.command import export_scene
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.scene.reader import read_scene

SCENE = Path(__file__).parents[1] / "data/sample_drive"
PICTURE = Path(__file__).with_name("export_cloud.jpg")
WIDTH, HEIGHT, FOCAL_PX = 700, 420, 420.0
ABOVE_M, BACK_M, DOWN_RAD = 9.0, 14.0, 0.42
LEAST_M, POINT_M = 2.0, 0.11
BACKGROUND = 250


def drawn(points_m: NDArray, colours: NDArray, along: NDArray, middle_m: NDArray) -> NDArray[np.uint8]:
    """Draw points as squares, the farthest first, seen from above and behind the middle of the drive."""
    right, up = np.array([along[1], -along[0], 0.0]), np.array([0.0, 0.0, 1.0])
    forward = np.cos(DOWN_RAD) * along - np.sin(DOWN_RAD) * up
    axes = np.stack((right, np.cross(forward, right), forward))
    seen = (points_m - middle_m + BACK_M * along - ABOVE_M * up) @ axes.T
    near = seen[:, 2] > LEAST_M
    seen, colours = seen[near], colours[near]
    picture = np.full((HEIGHT, WIDTH, 3), BACKGROUND, np.uint8)
    for (x, y, z), colour in ((seen[at], colours[at]) for at in np.argsort(-seen[:, 2])):
        size = max(1, round(FOCAL_PX * POINT_M / z))
        column, row = int(WIDTH / 2 + FOCAL_PX * x / z), int(HEIGHT / 2 + FOCAL_PX * y / z)
        picture[max(row, 0) : max(row + size, 0), max(column, 0) : max(column + size, 0)] = colour
    return picture


def main() -> None:
    """Draw both clouds side by side."""
    scene = read_scene(SCENE)
    places = np.stack([picture.position_m for picture in next(iter(scene.cameras().values()))])
    along = (places[-1] - places[0]) * [1, 1, 0]
    lidar = scene.cloud()
    assert lidar is not None
    with tempfile.TemporaryDirectory() as folder:
        output = export_scene(ExportOptions(SCENE, output=Path(folder) / "out"), Console(quiet=True))
        prior = read_cloud(output / "points.ply")
    pictures = [
        drawn(points_m, colours, along / np.linalg.norm(along), places.mean(0))
        for points_m, colours in (lidar, prior)
        if colours is not None
    ]
    gap = np.full((HEIGHT, 8, 3), 255, np.uint8)
    cv2.imwrite(str(PICTURE), np.hstack((pictures[0], gap, pictures[1]))[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
