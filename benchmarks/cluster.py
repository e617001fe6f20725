"""Storage and time for many pictures, from rates measured on few; and what a cluster adds to a task.

    python benchmarks/cluster.py DRIVE [DRIVE …] [--frames 2 6] [--pictures 160000] [--frames-per-scene 150]

DRIVE is one that `synthesize` has written (two cameras). Two stretches of it go through `process` without monocular
maps, through `estimate-depth` with weights that exist (its time does not depend on what is in them), and through
building the DataManager (trust, prior, tables); 30 steps of edge-depth-nerf-lite follow. Each command is a process on
one thread. The cost of a picture is the slope between the two stretches, in seconds of a core: other work on the
machine counts less in these than in seconds of the clock. What starts and ends a command is the rest. Bytes are those
of the longer stretch's scene, without the truth.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

TRAIN = """
import copy, sys, tempfile, time
from pathlib import Path
import torch
torch.set_num_threads(1)
from nerfstudio.configs.method_configs import all_methods
scene, steps = Path(sys.argv[1]), 30
config = copy.deepcopy(all_methods["edge-depth-nerf-lite"])
config.pipeline.datamanager.dataparser.data = scene
before = time.process_time()
config.pipeline.datamanager.setup(test_mode="val")
print("SETUP", time.process_time() - before)
if sys.argv[2] == "train":
    with tempfile.TemporaryDirectory() as folder:
        config.output_dir, config.vis, config.data = Path(folder), "tensorboard", scene
        config.logging.local_writer.enable = False
        trainer = config.setup()
        trainer.setup()
        for step in range(steps):
            if step == 10:
                before = time.process_time()
            trainer.train_iteration(step)
    print("STEP", (time.process_time() - before) / (steps - 10))
"""
TRIVIAL_TASKS = 8
OF_A_SCENE = (".cache/rays", "ego_masks", "masks")
"""What a scene has once for each of its lenses, however many pictures it has."""


def run(command: Sequence[str | Path]) -> tuple[float, str]:
    """Run a command on one thread; seconds of a core, and what it said."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [str(word) for word in command],
        env={**os.environ, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stdout[-3000:] + done.stderr[-3000:])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


def said(text: str, word: str) -> float:
    """The number behind a word."""
    return float(text.split(word)[1].split()[0])


def bytes_by_kind(scene: Path) -> dict[str, int]:
    """Of all files of a scene; links count as what they lead to."""
    found: dict[str, int] = {}
    for path in scene.rglob("*"):
        if path.is_file():
            parts = path.relative_to(scene).parts
            kind = "/".join(parts[:2]) if parts[0] == ".cache" else parts[0] if len(parts) > 1 else "files"
            found[kind] = found.get(kind, 0) + path.stat().st_size
    return found


def measure(drive: Path, frames: Sequence[int], work: Path) -> dict[str, float]:
    """Rates of one drive: seconds of a core and bytes a picture, and seconds of a core a command."""
    own = [sys.executable, "-m", "edge_depth_nerf"]
    (sequence,) = [path.name for path in (drive / "data_2d_raw").iterdir()]
    seconds: dict[str, list[float]] = {"process": [], "maps": [], "prior and tables": []}
    rates: dict[str, float] = {}
    for count in frames:
        scene = work / f"{drive.name}_{count}"
        given = ["--root", drive, "--sequence", sequence, "--frames", str(count), "--output", scene]
        seconds["process"].append(run([*own, "process", "kitti360", *given, "--no-estimate-depth"])[0])
        weights = work / "weights.safetensors"
        if not weights.exists():
            run([*own, "estimate-depth", scene, "--train-steps", "3", "--no-predict", "--output", weights])
        seconds["maps"].append(run([*own, "estimate-depth", scene, "--model", weights])[0])
        _, text = run([sys.executable, "-c", TRAIN, scene, "train" if count == frames[-1] else "prepare"])
        seconds["prior and tables"].append(said(text, "SETUP"))
        if count == frames[-1]:
            rates["training step"] = said(text, "STEP")
            pictures = 2 * count
            for kind, size in sorted(bytes_by_kind(scene).items()):
                if kind in OF_A_SCENE:
                    rates[f"MB of {kind}, a scene"] = size / 1e6
                elif kind != "truth":
                    rates[f"MB of {kind}"] = size / 1e6 / pictures
    apart = 2 * (frames[-1] - frames[0])
    for name, (few, many) in seconds.items():
        rates[f"s of {name}"] = (many - few) / apart
        rates[f"s to start {name}"] = few - 2 * frames[0] * (many - few) / apart
    return rates


def overhead(work: Path) -> tuple[float, float]:
    """Seconds that a local cluster takes to be there, and what each further task takes beyond its own process."""
    from rich.console import Console

    from edge_depth_nerf.jobs.cluster import on_cluster
    from edge_depth_nerf.jobs.tasks import Task, do_tasks

    quiet = Console(quiet=True)
    code = "from pathlib import Path; import sys; Path(sys.argv[1]).touch()"

    def tasks(count: int) -> list[Task]:
        made = [work / f"made{number}" for number in range(count)]
        return [Task(path.name, ("-c", code, str(path)), work / "logs" / path.name, path) for path in made]

    begun = time.monotonic()
    with on_cluster("local", tasks(1), [], quiet) as place:
        ready = time.monotonic()
        do_tasks(tasks(1), place, quiet)
        first = time.monotonic()
        do_tasks(tasks(TRIVIAL_TASKS), place, quiet)
        end = time.monotonic()
    alone = time.monotonic()
    subprocess.run([sys.executable, "-c", code, str(work / "made0")], check=True)
    alone = time.monotonic() - alone
    return ready - begun + (first - ready), (end - first) / TRIVIAL_TASKS - alone


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("drives", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, nargs=2, default=[2, 6])
    parser.add_argument("--pictures", type=int, default=160_000)
    parser.add_argument("--frames-per-scene", type=int, default=150)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        start_s, task_s = overhead(work)
        print(f"a local cluster, until its first task has ended: {start_s:.1f} s; a further task: {task_s:.2f} s\n")
        for drive in options.drives:
            rates = measure(drive.resolve(), options.frames, work)
            print(f"{drive.name}, {2 * options.frames[0]} and {2 * options.frames[1]} pictures\n")
            print(f"| a picture, or a step | measured | × {options.pictures:,} (computed) |\n|---|---:|---:|")
            scenes = -(-options.pictures // (2 * options.frames_per_scene))
            for name, value in rates.items():
                if name.endswith("a scene"):
                    print(f"| {name} | {value:.2f} | {value * scenes / 1e6:.2f} TB, of {scenes:,} scenes |")
                elif name.startswith("MB"):
                    print(f"| {name} | {value:.3f} | {value * options.pictures / 1e6:.2f} TB |")
                elif name.startswith("s to start"):
                    print(f"| {name} | {value:.1f} | {value * scenes / 3600:.0f} h, of {scenes:,} scenes |")
                elif name.startswith("s of"):
                    print(f"| {name} | {value:.2f} | {value * options.pictures / 3600:,.0f} h |")
                else:
                    hours = value * 2000 * scenes / 3600
                    print(f"| {name}, lite | {value:.3f} | {hours:,.0f} h, 2,000 steps of {scenes:,} scenes |")
            print(flush=True)
            for path in work.glob(f"{drive.name}_*"):
                shutil.rmtree(path)


if __name__ == "__main__":
    main()
