"""How true the road from above is: heights and colours of `birds-eye` against those of the rendered drive.

    edge-depth-nerf synthesize --output drives/street --frames 24 --size 256 --seed 3 --shifts-m 0.5 1 2 3
    edge-depth-nerf process kitti360 --root drives/street --sequence 2013_05_28_drive_0000_sync --no-motion \\
        --mono drives/street/simulated_mono/2013_05_28_drive_0000_sync --output scenes/street
    edge-depth-nerf compare scenes/street --methods nerfacto edge --steps 1000 --output comparison
    edge-depth-nerf birds-eye --load-config comparison/runs/street/edge_seed-0/edge-depth-nerf-lite/run/config.yml \\
        --output eye
    python -m benchmarks.quality.birds_eye drives/street eye

The ground is where the true height is within 3 cm of 0; the rest is kerbs, cars and hedges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import KDTree

from edge_depth_nerf.base.files import read_json
from edge_depth_nerf.films.birds_eye import HEIGHT, PICTURE
from edge_depth_nerf.synthetic.layout import WORLD_ORIGIN_M
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.render import World
from edge_depth_nerf.synthetic.scenes import build_scene

FLAT_M = 0.03
START_M = 2.5
"""Rays begin so far above the road, as with the default --above-m."""
RINGS_M = ((0.0, 3.0), (3.0, 6.0), (6.0, 10.0))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path, help="what synthesize wrote")
    parser.add_argument("eye", type=Path, help="what birds-eye wrote")
    given = parser.parse_args()
    said = read_json(given.drive / "drive.json")["options"]
    known = {name: said[name] for name in ("scene", "frames", "size", "seed")}
    options = SynthesizeOptions(given.drive, **known)
    colours = np.asarray(Image.open(given.eye / PICTURE)).astype(np.float64) / 255
    heights_m = np.asarray(Image.open(given.eye / HEIGHT)).astype(np.float64)
    side, _, _, _, west, north = map(float, (given.eye / "road.pgw").read_text().split())
    row, column = np.nonzero(colours[..., 3])
    place = np.stack([west + side * column, north - side * row], -1) - WORLD_ORIGIN_M[:2]
    world = World(build_scene(options), options.seed)
    origins = np.concatenate([place, np.full((len(place), 1), START_M)], axis=1).astype(np.float32)
    down = np.tile(np.array([0, 0, -1], np.float32), (len(place), 1))
    hits = world.trace(origins, down, 0.0)
    true_m = START_M - np.asarray(hits.distance_m, np.float64)
    error_m = heights_m[row, column] - WORLD_ORIGIN_M[2] - true_m
    path = np.loadtxt(given.drive / "data_poses" / options.sequence / "poses.txt")[:, [4, 8]] - WORLD_ORIGIN_M[:2]
    away_m = KDTree(path).query(place)[0]
    flat = np.abs(true_m) < FLAT_M
    print("| | median | median of the size | 95 % | within 10 cm |\n|---|---|---|---|---|")
    for name, chosen in (
        *((f"ground, {low:g}-{high:g} m beside", flat & (away_m >= low) & (away_m < high)) for low, high in RINGS_M),
        ("kerbs, cars, hedges", ~flat & np.isfinite(error_m)),
    ):
        size_m = np.abs(error_m[chosen])
        median_m, size_median_m, most_m = np.median(error_m[chosen]), np.median(size_m), np.quantile(size_m, 0.95)
        cells = [f"{100 * median_m:+.1f} cm", f"{100 * size_median_m:.1f} cm", f"{100 * most_m:.1f} cm"]
        cells.append(f"{(size_m < 0.1).mean():.0%}")
        print(f"| {name} | {' | '.join(cells)} |")
    true = np.clip(world.to_picture(world.radiance(origins, down, hits, 0.0, side / START_M)), 0, 1)
    squared = np.square(true - colours[row, column, :3]).mean()
    print(f"\n{flat.size / heights_m.size:.0%} shown; PSNR {-10 * np.log10(squared):.2f} dB")


if __name__ == "__main__":
    main()
