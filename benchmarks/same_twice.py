"""One seed, several trainings: are their parameters the same, and their figures?

    python benchmarks/same_twice.py SCENE [--steps 300] [--threads 1 1 2 2 4] [--seed 42] [--json FILE]

Each training of edge-depth-nerf-lite has a process of its own on the CPU, with so many threads, and Python's hashes in
another order. Told of each: SHA-256 of all parameters, and masked PSNR over the held-out views; then how far the
figures lie apart. The scene's cache is made by the first one.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def train(scene: Path, steps: int, seed: int) -> dict[str, Any]:
    """Train in this process and judge."""
    import numpy as np
    import torch
    from nerfstudio.configs.method_configs import all_methods

    config: Any = copy.deepcopy(all_methods["edge-depth-nerf-lite"])
    config.machine.device_type, config.vis, config.data = "cpu", "tensorboard", scene
    config.pipeline.datamanager.dataparser.data = scene
    config.max_num_iterations, config.experiment_name, config.timestamp = steps, "same", "run"
    config.logging.local_writer.enable = False
    # as ns-train does
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the generator that the host seeds
    torch.manual_seed(seed)
    with tempfile.TemporaryDirectory() as folder:
        config.output_dir = Path(folder)
        trainer = config.setup()
        trainer.setup(test_mode="test")
        trainer.train()
        digest = hashlib.sha256()
        for name, tensor in sorted(trainer.pipeline.state_dict().items()):
            digest.update(name.encode() + tensor.contiguous().numpy().tobytes())
        figures = trainer.pipeline.get_average_eval_image_metrics()
    return {
        "threads": torch.get_num_threads(),
        "parameters": digest.hexdigest()[:16],
        **{name: figures[name] for name in ("masked_psnr", "masked_ssim", "lidar_abs_rel") if name in figures},
    }


def main() -> None:
    """Train, compare, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 1, 2, 2, 4])
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print("\n" + json.dumps(train(options.scene.resolve(), options.steps, options.seed)))
        return
    rows = []
    for number, threads in enumerate(options.threads):
        command = [sys.executable, __file__, str(options.scene), "--steps", str(options.steps)]
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "PYTHONHASHSEED": str(number)}
        done = subprocess.run(
            [*command, "--seed", str(options.seed), "--only"],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(done.stdout[-3000:] + done.stderr[-3000:])
        rows.append(json.loads(done.stdout.splitlines()[-1]))
        print(json.dumps(rows[-1]), flush=True)
    for threads in sorted({row["threads"] for row in rows}):
        same = [row for row in rows if row["threads"] == threads]
        if len(same) > 1:
            equal = len({row["parameters"] for row in same}) == 1
            print(f"{threads} threads, {len(same)} trainings: parameters {'equal' if equal else 'differ'}")
    figures = [row["masked_psnr"] for row in rows]
    print(f"masked PSNR of all: {max(figures) - min(figures):.4f} dB apart")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
