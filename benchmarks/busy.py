"""A training step of edge-depth-nerf-lite on a still machine and beside other work, idle threads asleep or turning.

    python benchmarks/busy.py SCENE [--steps 100] [--busy 0 1 2]

Each figure is `ns-train`'s own mean over the steps, of a process of its own; compiling is done before. Beside it run so
many processes that do nothing but count. Threads that turn are what GNU's OpenMP does by itself
(`GOMP_SPINCOUNT=300000`, its default); see edge_depth_nerf/openmp.py.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

WAYS = {"asleep": {}, "turning": {"GOMP_SPINCOUNT": "300000"}}


def step_ms(scene: Path, steps: int, environment: dict[str, str]) -> float:
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(str(Path(sys.executable).with_name("ns-train")), "edge-depth-nerf-lite", "--data", str(scene)),
            *("--output-dir", folder, "--max-num-iterations", str(steps), "--vis", "tensorboard"),
        ]
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_"))}
        done = subprocess.run(
            command, env=kept | environment | {"NO_COLOR": "1"}, capture_output=True, text=True, check=False
        )
    found = re.search(r"Trainer\.train_iteration: ([\d.]+)", done.stdout)
    if done.returncode or found is None:
        sys.exit(f"{command[0]} failed:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return 1000 * float(found[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--busy", type=int, nargs="+", default=[0, 1, 2])
    options = parser.parse_args()
    step_ms(options.scene, 5, {})  # compiles, and fills the caches
    table = Table("beside it", *(f"idle threads {way}" for way in WAYS), title=f"a step, ms, {os.cpu_count()} cores")
    for count in options.busy:
        others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
        try:
            found = [step_ms(options.scene, options.steps, environment) for environment in WAYS.values()]
        finally:
            for other in others:
                other.kill()
        table.add_row(f"{count} busy processes", *(f"{value:.0f}" for value in found))
    Console().print(table)


if __name__ == "__main__":
    main()
