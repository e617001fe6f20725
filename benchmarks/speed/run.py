"""All that this package does faster, measured in one run beside nerfstudio's own classes.

    python -m benchmarks.speed.run [--work outputs/benchmark] [--results FILE] [--parts PART …]

Parts, each of which is kept in the results, with the commit and the machine it is of, as soon as it is there and not
measured again (remove it there, or the file, to have it anew):

    lite, full   training steps and views of the two presets (turns.py)
    frames       first batch and memory over the number of pictures of 350 px
    memory       300 pictures of 1400 px (memory.py)
    preparation  `process` and integration on one core and on all

The drives are made by `edge-depth-nerf synthesize` under `--work` (of 1400 px: some minutes) and stay there. Nothing
else should run: ratios are taken within rounds, but a busy machine widens their range. At the end the tables in
docs/speed.md are written from the results; `--parts` without a value does only that.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from benchmarks.speed import memory, turns
from benchmarks.speed.report import write_tables
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.method.integration import IntegrationOptions, integrate_depth

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PROGRAM = Path(sys.executable).with_name("edge-depth-nerf")
SEQUENCE = "2013_05_28_drive_0000_sync"
SMALL_FRAMES, LARGE_FRAMES = 24, 6
"""Moments of the drive of 350 px and of that of 1400 px; two pictures each."""


def drive(work: Path, size: int, frames: int) -> Path:
    """A raw drive, made if it is not there."""
    folder = work / f"drive{size}"
    subprocess.run(
        [PROGRAM, "synthesize", "--output", folder, "--size", str(size), "--frames", str(frames)], check=True
    )
    return folder


def process_command(raw: Path, scene: Path) -> list[str]:
    return [
        *(str(PROGRAM), "process", "kitti360", "--root", str(raw), "--sequence", SEQUENCE),
        *("--output", str(scene), "--no-estimate-depth", "--mono", str(raw / "simulated_mono" / SEQUENCE)),
    ]


def scene_of(work: Path, size: int, frames: int) -> Path:
    """Its scene, with simulated monocular maps."""
    raw, scene = drive(work, size, frames), work / f"scene{size}"
    if not (scene / "transforms.json").is_file():
        subprocess.run(process_command(raw, scene), check=True)
    return scene


def both_measured(scene: Path) -> dict[str, Any]:
    return {name: memory.measured(which, scene) for name, which in (("nerfacto", "nerfstudio"), ("ours", "ours"))}


def by_frames(work: Path) -> list[dict[str, Any]]:
    """Pictures of 350 px, as many as that."""
    small = scene_of(work, 350, SMALL_FRAMES)
    rows = []
    for frames in (10, 100, 300, 1000):
        with temporary(work) as folder:
            memory.multiplied(small, frames, folder)
            rows.append({"value": frames, "data": both_measured(folder)})
    return rows


def most_memory(work: Path) -> dict[str, Any]:
    """300 pictures of 1400 px; nerfstudio's from its slope over 20 and 60 of them, where it does not fit."""
    large = scene_of(work, 1400, LARGE_FRAMES)
    found: dict[str, Any] = {}
    hosts = {}
    for frames in (20, 60):
        with temporary(work) as folder:
            memory.multiplied(large, frames, folder)
            hosts[frames] = memory.measured("nerfstudio", folder)
    slope_mb = (hosts[60]["anonymous_mb"] - hosts[20]["anonymous_mb"]) / 40
    of_60_mb = hosts[60]["anonymous_mb"] - hosts[60]["begun_mb"]
    found["nerfstudio"] = {"computed_mb": of_60_mb + slope_mb * 240, "mb_a_picture": slope_mb}
    with temporary(work) as folder:
        memory.multiplied(large, 300, folder)
        found["ours"] = memory.measured("ours", folder)
    return found


PREPARE = """
import json, os, resource, sys, time
os.sched_setaffinity(0, range(int(sys.argv[1])))
from edge_depth_nerf.entry import main
sys.argv = sys.argv[2:]
started = time.perf_counter()
main()
used = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps({"s": time.perf_counter() - started, "cpu_s": used.ru_utime, "peak_mb": used.ru_maxrss / 1024}))
"""


def make_frame(size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A frame's LiDAR, monocular map and mask: smooth surfaces with edges, LiDAR points on 2.6 % of the pixels."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:size, :size]
    mono = 25 + 12 * np.sin(x / 130) + y / 100 + rng.normal(0, 0.05, x.shape)
    for left in range(size // 10, size, size // 7):
        mono[size // 4 :, left : left + size // 40] = rng.uniform(4, 12)
    lidar = np.where(rng.random(x.shape) < 0.026, mono * 1.05 + rng.normal(0, 0.02, x.shape), 0)
    valid = np.hypot(x - size / 2, y - size / 2) < 0.49 * size
    return torch.from_numpy(lidar).float(), torch.from_numpy(mono).float(), torch.from_numpy(valid)


def integration_s(threads: int) -> float:
    """Best of five: the prior of a frame of 1400 px, in the default form."""
    before, frame, options = torch.get_num_threads(), make_frame(1400), IntegrationOptions(normalise="residual")
    torch.set_num_threads(threads)
    best = min(turns.seconds(lambda: integrate_depth(*frame, options)) for _ in range(6))
    torch.set_num_threads(before)
    return best


def preparation(work: Path) -> list[dict[str, Any]]:
    """`process` of a drive of 1400 px on one core and on all (pictures, sweeps, masks, maps); integration likewise."""
    raw = drive(work, 1400, LARGE_FRAMES)
    rows = []
    for cores in sorted({1, os.cpu_count() or 1}):
        with temporary(work) as folder:
            command = [sys.executable, "-c", PREPARE, str(cores), *process_command(raw, folder / "scene")]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            row = {"cores": cores, "pictures": 2 * LARGE_FRAMES, **json.loads(done.stdout.splitlines()[-1])}
            rows.append({**row, "integration_s": integration_s(cores)})
    return rows


def commit() -> str:
    """The checked-out commit; with a + if files differ from it."""
    git = ["git", "-C", str(HERE)]
    shown = subprocess.run([*git, "rev-parse", "--short=7", "HEAD"], check=True, capture_output=True, text=True)
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "../../edge_depth_nerf"]).returncode
    return shown.stdout.strip() + ("+" if changed else "")


@contextlib.contextmanager
def temporary(work: Path) -> Iterator[Path]:
    """A folder beside the scenes (pictures are linked into it), removed in the end."""
    with tempfile.TemporaryDirectory(dir=work) as folder:
        yield Path(folder)


def parts(work: Path) -> dict[str, Callable[[], Any]]:
    """What is measured, by name."""
    sample = ROOT / "data" / "sample_drive"
    every = turns.ON_EVERY_MACHINE
    return {
        "lite": lambda: turns.race(turns.configurations("lite", sample, every), 5, 10, 1 << 16),
        "full": lambda: turns.race(turns.configurations("full", sample, every), 3, 3, 1 << 13),
        "frames": lambda: by_frames(work),
        "memory": lambda: most_memory(work),
        "preparation": lambda: preparation(work),
    }


def main() -> None:
    """Measure what is not there yet, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("outputs/benchmark"))
    parser.add_argument("--results", type=Path, default=HERE / "results.json")
    parser.add_argument("--parts", nargs="*", default=list(parts(Path())), choices=list(parts(Path())))
    options = parser.parse_args()
    results = read_json(options.results) if options.results.is_file() else {}
    for name, measure in parts(options.work.resolve()).items():
        if name in options.parts and name not in results:
            CONSOLE.rule(name)
            started = time.perf_counter()
            found = measure()
            results[name] = found
            results.setdefault("seconds", {})[name] = round(time.perf_counter() - started, 1)
            results.setdefault("of", {})[name] = {"commit": commit(), **turns.machine()}
            results["sizes"] = {preset: turns.sizes_of(preset) for preset in turns.PRESETS}
            write_json(options.results, results)
    write_tables(results, [ROOT / "docs" / "speed.md"])


if __name__ == "__main__":
    main()
