"""What real input gives: trains on the real KITTI-360 excerpts beside the checkout, with the prior and without.

    python benchmarks/real_input.py --real ../shared/real --output outputs/real_input --steps 300

Prints a table and leaves rendered views and figures under the output folder. A scene, run or figure that is there is
not made again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from real_scenes import fisheye_frame_scene, stereo_scene  # noqa: E402  # pyright: ignore[reportMissingImports]

from edge_depth_nerf.files import read_json  # noqa: E402

METHOD = "edge-depth-nerf-lite"
SCENES = {"fisheye frame": fisheye_frame_scene, "stereo drive": stereo_scene}
LOSSES = {"nerfacto": "none", "ours": "edge"}
COLUMNS = ("masked_psnr", "masked_ssim", "lidar_abs_rel", "lidar_rmse_m", "lidar_delta_1_25")


def command(name: str, *arguments: object) -> None:
    words = [str(Path(sys.executable).with_name(name)), *map(str, arguments)]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        sys.exit(f"{name} failed:\n{done.stdout[-3000:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--real", type=Path, default=ROOT.parent / "shared" / "real")
    parser.add_argument("--output", type=Path, default=Path("outputs/real_input"))
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    if not options.real.is_dir():
        sys.exit(f"{options.real}: no such folder; the real excerpts are not part of the project.")

    table = Table("scene", "method", *COLUMNS, title=f"{options.steps} steps, held-out LiDAR blocks or pictures")
    for title, make in SCENES.items():
        folder = options.output / title.replace(" ", "_")
        scene = make(options.real, folder / "scene")
        for name, loss in LOSSES.items():
            figures = folder / name / "figures.json"
            config = folder / name / METHOD / "run" / "config.yml"
            if not figures.is_file():
                command(
                    *("ns-train", METHOD, "--data", scene, "--output-dir", folder, "--experiment-name", name),
                    *("--timestamp", "run", "--vis", "tensorboard", "--max-num-iterations", options.steps),
                    *("--pipeline.model.depth-loss", loss),
                )
                views = figures.with_name("views")
                command("ns-eval", "--load-config", config, "--output-path", figures, "--render-output-path", views)
            results = read_json(figures)["results"]
            table.add_row(title, name, *(f"{results[key]:.3f}" if key in results else "–" for key in COLUMNS))
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
