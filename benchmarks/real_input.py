"""What real input gives: trains on the real KITTI-360 excerpts beside the checkout, with the prior and without.

    python benchmarks/real_input.py --real ../shared/real --output outputs/real_input --steps 300

Of the fisheye frame, blocks of LiDAR are held out; of the five stereo pairs, each pair in turn. Prints a table, with
the mean over the pairs, and leaves rendered views and figures under the output folder. A scene, run or figure that is
there is not made again. The table is also written, as Markdown, to table.md there.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from commands import command  # noqa: E402
from real_scenes import fisheye_frame_scene, stereo_scene  # noqa: E402  # pyright: ignore[reportMissingImports]

from edge_depth_nerf.base.files import read_json, write_text  # noqa: E402

METHOD = "edge-depth-nerf-lite"
SCENES = {
    "fisheye frame": [("", fisheye_frame_scene)],
    "stereo pairs": [(f" without {frame}", partial(stereo_scene, held_out=frame)) for frame in range(700, 705)],
}
LOSSES = {"nerfacto": "none", "ours": "edge"}
COLUMNS = ("masked_psnr", "masked_ssim", "lidar_abs_rel", "lidar_rmse_m", "lidar_delta_1_25")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=ROOT.parent / "shared" / "real")
    parser.add_argument("--output", type=Path, default=Path("outputs/real_input"))
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    if not options.real.is_dir():
        sys.exit(f"{options.real}: no such folder; the real excerpts are not part of the project.")

    names = ("scene", "method", *COLUMNS)
    rows: list[tuple[str, ...]] = []
    for title, scenes in SCENES.items():
        found: dict[str, list[dict[str, float]]] = {name: [] for name in LOSSES}
        for held_out, make in scenes:
            folder = options.output / f"{title}{held_out}".replace(" ", "_")
            scene = folder / "scene"
            if not (scene / "transforms.json").is_file():
                make(options.real, scene)
            for name, loss in LOSSES.items():
                results = figures_of(scene, folder, name, loss, options.steps)
                found[name].append(results)
                rows.append((f"{title}{held_out}", name, *map(shown, (results.get(key) for key in COLUMNS))))
        for name, results in found.items() if len(scenes) > 1 else ():
            means = [float(np.mean([each[key] for each in results])) if key in results[0] else None for key in COLUMNS]
            rows.append((f"{title}, mean", name, *map(shown, means)))
    table = Table(*names, title=f"{options.steps} steps, held-out LiDAR blocks or pictures")
    for row in rows:
        table.add_row(*row)
    Console(width=120).print(table)
    lines = ["| " + " | ".join(row) + " |" for row in (names, ("---",) * len(names), *rows)]
    write_text(options.output / "table.md", "\n".join([*lines, ""]))


def figures_of(scene: Path, folder: Path, name: str, loss: str, steps: int) -> dict[str, float]:
    """Train and judge, unless it is done."""
    figures = folder / name / "figures.json"
    config = folder / name / METHOD / "run" / "config.yml"
    if not figures.is_file():
        command(
            *("ns-train", METHOD, "--data", scene, "--output-dir", folder, "--experiment-name", name),
            *("--timestamp", "run", "--vis", "tensorboard", "--max-num-iterations", steps),
            *("--pipeline.model.depth-loss", loss),
        )
        views = figures.with_name("views")
        command("ns-eval", "--load-config", config, "--output-path", figures, "--render-output-path", views)
    return read_json(figures)["results"]


def shown(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
