"""Commands killed by SIGKILL at random moments and started again: do they finish, with an undisturbed run's results?

    python -m benchmarks.robustness.kill [--part process estimate-depth train compare] [--kills 20]
                                         [--output FOLDER]

A small drive is rendered and made a scene. Each command then runs once undisturbed; that is the reference. In each
round it is started in an empty folder, killed at a random moment between its first sign of life on the disk and the
reference's end, started again, and so on, five times at most; then it may finish. `compare` is killed itself, or its
worker is. What is compared:

    process         every file, by its bytes; nothing else may be there
    estimate-depth  likewise: maps, weights, calibration
    train           the last checkpoint is whole, of the last step, and finite; config.yml is the reference's
    compare         every run's configuration, and the tables without their figures

Rounds are written to FOLDER/kills.json; the same command goes on until so many kills were done.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import torch

from edge_depth_nerf.base.files import write_json
from edge_depth_nerf.jobs.runs import newest_checkpoint, steps_done
from edge_depth_nerf.plugin.compat import allow_numpy_scalars_in_checkpoints

SEQUENCE = "2013_05_28_drive_0000_sync"
KILLS_A_ROUND = 5
STEPS = 30
SMALL = (
    *("--pipeline.datamanager.train-num-rays-per-batch", "256", "--pipeline.model.num-levels", "4"),
    *("--pipeline.model.log2-hashmap-size", "12", "--logging.local-writer.max-log-size", "0", "--vis", "tensorboard"),
)


def words(*command: object) -> list[str]:
    """A command of this environment."""
    program, *rest = map(str, command)
    if program == "edge-depth-nerf":
        return [sys.executable, "-m", "edge_depth_nerf", *rest]
    return [str(Path(sys.executable).with_name(program)), *rest]


def digests(folder: Path) -> dict[str, str]:
    """Every file of a folder, by name, with what is in it."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# ---- the commands ----------------------------------------------------------------------------------------------


@dataclass
class Part:
    """A command, and what of its results must be the same each time."""

    prepare: Callable[[Path], None]
    """Put into a new folder what the command needs there."""
    command: Callable[[Path], list[str] | None]
    """How to begin or go on; None = nothing is left to do."""
    result: Callable[[Path], Any]
    """As JSON."""


def process_part(work: Path) -> Part:
    """From a raw drive to a scene with monocular maps and their calibration."""
    drive = work / "drive"

    def command(folder: Path) -> list[str]:
        return words(
            *("edge-depth-nerf", "process", "kitti360", "--root", drive, "--sequence", SEQUENCE),
            *("--output", folder / "scene", "--mono", drive / "simulated_mono" / SEQUENCE, "--sweeps", 2),
        )

    return Part(lambda folder: None, command, lambda folder: digests(folder / "scene"))


def estimate_part(work: Path) -> Part:
    """A network trained on a scene's LiDAR, its maps, their calibration."""

    def prepare(folder: Path) -> None:
        shutil.copytree(work / "scene", folder / "scene")

    def command(folder: Path) -> list[str]:
        return words("edge-depth-nerf", "estimate-depth", folder / "scene", "--train-steps", 80)

    return Part(prepare, command, lambda folder: digests(folder / "scene"))


def train_part(work: Path) -> Part:
    """ns-train, its checkpoints and the caches in the scene."""

    def prepare(folder: Path) -> None:
        shutil.copytree(work / "with_mono", folder / "scene")

    def run(folder: Path) -> Path:
        return folder / "runs" / "killed" / "edge-depth-nerf-lite" / "run"

    def command(folder: Path) -> list[str] | None:
        checkpoints = run(folder) / "nerfstudio_models"
        done = steps_done(checkpoints)
        if done >= STEPS:
            return None
        return words(
            *("ns-train", "edge-depth-nerf-lite", "--data", folder / "scene", "--output-dir", folder / "runs"),
            *("--experiment-name", "killed", "--timestamp", "run", "--steps-per-save", 3, *SMALL),
            *("--max-num-iterations", STEPS - done, *(["--load-dir", checkpoints] if done else [])),
        )

    def result(folder: Path) -> Any:
        allow_numpy_scalars_in_checkpoints()
        newest = newest_checkpoint(run(folder) / "nerfstudio_models")
        if newest is None:
            return "no checkpoint"
        saved = torch.load(newest, weights_only=True)
        tensors = saved["pipeline"].items()
        finite = all(bool(torch.isfinite(tensor).all()) for _, tensor in tensors if tensor.is_floating_point())
        # what differs where a training was taken up again
        config = re.sub(
            r"(?m)^(max_num_iterations|load_dir):.*\n(- .*\n)*", "", (run(folder) / "config.yml").read_text()
        )
        shapes = {name: list(tensor.shape) for name, tensor in tensors}
        return {
            "step": saved["step"],
            "finite": finite,
            "shapes": shapes,
            "config": config.replace(str(folder), "").replace(folder.name, ""),
            "left over": [path.name for path in run(folder).rglob(".*")],
        }

    return Part(prepare, command, result)


def compare_part(work: Path) -> Part:
    """Two methods trained, judged and put into tables."""

    def prepare(folder: Path) -> None:
        shutil.copytree(work / "with_mono", folder / "scene")

    def command(folder: Path) -> list[str]:
        return words(
            *("edge-depth-nerf", "compare", folder / "scene", "--output", folder / "out", "--methods", "nerfacto"),
            *("edge", "--steps", 12, "--jobs", 1),
        )

    def result(folder: Path) -> Any:
        found: dict[str, Any] = {}
        for path in sorted((folder / "out" / "runs").glob("*/*/figures.json")):
            content = json.loads(path.read_text())
            found[path.parent.name] = {
                **{key: content[key] for key in ("named", "configuration", "steps", "lambda", "sigma")},
                "figures": sorted(content["figures"]),
                "curve": [point["step"] for point in content["curve"]],
            }
        rows = (folder / "out" / "results.csv").read_text().splitlines()
        return {
            "runs": json.loads(json.dumps(found).replace(str(folder), "")),
            "rows": [row.rsplit(",", 1)[0] for row in rows],
            "tables": re.sub(r"[-+]?\d+(\.\d+)?", "0", (folder / "out" / "tables.md").read_text().replace("**", "")),
            "files": sorted(path.name for path in (folder / "out").iterdir()),
        }

    return Part(prepare, command, result)


PARTS = {"process": process_part, "estimate-depth": estimate_part, "train": train_part, "compare": compare_part}


# ---- killing ---------------------------------------------------------------------------------------------------


def children(process: int) -> list[int]:
    """Processes that a process has started (Linux)."""
    tasks = Path(f"/proc/{process}/task")
    try:
        return [int(child) for task in tasks.iterdir() for child in (task / "children").read_text().split()]
    except OSError:
        return []


def begun(command: list[str], sink: IO[str]) -> subprocess.Popen[bytes]:
    """Start a command on one thread."""
    return subprocess.Popen(command, stdout=sink, stderr=subprocess.STDOUT, env={**os.environ, "OMP_NUM_THREADS": "1"})


def run_for(command: list[str], log: Path, seconds: float | None, worker: bool) -> bool:
    """Run a command, to its end or for so many seconds; whether it was killed.

    Raises:
        RuntimeError: it failed by itself.
    """
    with log.open("a", encoding="utf-8") as sink:
        sink.write(f"$ {' '.join(command)}\n")
        sink.flush()
        process = begun(command, sink)
        try:
            status = process.wait(seconds)
        except subprocess.TimeoutExpired:
            workers = children(process.pid) if worker else []
            os.kill(workers[0] if workers else process.pid, signal.SIGKILL)
            sink.write("\n--- killed\n")
            process.wait()
            return True
    if status:
        raise RuntimeError(f"{log}: ended with status {status}:\n{log.read_text()[-3000:]}")
    return False


def timed_run(part: Part, folder: Path) -> tuple[float, float]:
    """Run a command undisturbed: seconds until its first file, and until its end."""
    part.prepare(folder)
    before, first, started = len(list(folder.rglob("*"))), 0.0, time.monotonic()
    command = part.command(folder)
    assert command is not None
    with (folder / "log.txt").open("w") as sink:
        process = begun(command, sink)
        while process.poll() is None:
            if not first and len(list(folder.rglob("*"))) > before + 1:
                first = time.monotonic() - started
            time.sleep(0.05)
    if process.returncode:
        raise RuntimeError((folder / "log.txt").read_text()[-3000:])
    return first, time.monotonic() - started


def one_round(name: str, part: Part, folder: Path, reference: dict[str, Any], kills: int, seed: int) -> dict[str, Any]:
    """Kill a command up to so many times, let it finish, compare."""
    chance = random.Random(f"{name} {seed}")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    part.prepare(folder)
    killed_s: list[float] = []
    fault, began = None, time.monotonic()
    try:
        while (command := part.command(folder)) is not None:
            began = time.monotonic()
            seconds = (
                chance.uniform(0.8 * reference["first_s"], reference["seconds"]) if len(killed_s) < kills else None
            )
            if not run_for(command, folder / "log.txt", seconds, worker=name == "compare" and chance.random() < 0.5):
                break
            assert seconds is not None
            killed_s.append(round(seconds, 2))
        found = json.loads(json.dumps(part.result(folder)))
        if found != reference["result"]:
            different = differences(found, reference["result"])
            fault = f"{len(different)} things differ: {'; '.join(different[:3])}"
    except (RuntimeError, OSError, KeyError, ValueError) as error:
        fault = repr(error)
    ended_s = round(time.monotonic() - began, 2)
    return {"seed": seed, "kills": len(killed_s), "moments_s": killed_s, "ended_s": ended_s, "fault": fault}


def differences(found: Any, expected: Any, where: str = "") -> list[str]:
    """Where two results differ."""
    if isinstance(found, dict) and isinstance(expected, dict):
        return [
            line
            for key in sorted({*found, *expected})
            for line in differences(found.get(key), expected.get(key), f"{where}/{key}")
        ]
    return [] if found == expected else [f"{where}: {str(found)[:200]} instead of {str(expected)[:200]}"]


def make_scenes(work: Path) -> None:
    """A small drive, a scene without monocular maps, and one with."""
    drive = work / "drive"
    process = ("process", "kitti360", "--root", drive, "--sequence", SEQUENCE)
    commands = [
        ("synthesize", "--output", drive, "--scene", "street", "--frames", 10, "--size", 96, "--seed", 3),
        (*process, "--output", work / "scene", "--sweeps", 1, "--no-estimate-depth"),
        (*process, "--output", work / "with_mono", "--mono", drive / "simulated_mono" / SEQUENCE),
    ]
    for command in commands:
        subprocess.run(words("edge-depth-nerf", *command), check=True, stdout=subprocess.DEVNULL)


def main() -> None:
    """Kill, compare, tell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--part", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--output", type=Path, default=Path("outputs/kills"))
    options = parser.parse_args()
    work = options.output.resolve()
    work.mkdir(parents=True, exist_ok=True)
    make_scenes(work)
    record_path = work / "kills.json"
    record: dict[str, Any] = json.loads(record_path.read_text()) if record_path.is_file() else {}

    for name in options.part:
        part = PARTS[name](work)
        kept = record.setdefault(name, {"rounds": []})
        if "result" not in kept:
            folder = work / "rounds" / name
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            kept["first_s"], kept["seconds"] = timed_run(part, folder)
            kept["result"] = json.loads(json.dumps(part.result(folder)))
        while (left := options.kills - sum(found["kills"] for found in kept["rounds"])) > 0:
            seed = len(kept["rounds"])
            found = one_round(name, part, work / "rounds" / name, kept, min(left, KILLS_A_ROUND), seed)
            kept["rounds"].append(found)
            if not found["kills"]:
                # the machine was busier when the reference ran
                kept["first_s"] *= found["ended_s"] / kept["seconds"]
                kept["seconds"] = found["ended_s"]
            write_json(record_path, record)
            print(f"{name}: round {seed}, {found['kills']} kills, {found['fault'] or 'as undisturbed'}", flush=True)
            if found["fault"]:
                shutil.move(work / "rounds" / name, work / "rounds" / f"{name}_fault_{seed}_{int(time.time())}")

    print(f"\n{'':>15} {'kills':>6} {'rounds':>7} {'as undisturbed':>15}")
    for name, kept in record.items():
        rounds = kept["rounds"]
        good = sum(found["fault"] is None for found in rounds)
        print(f"{name:>15} {sum(found['kills'] for found in rounds):6} {len(rounds):7} {good:15}")
    sys.exit(any(found["fault"] for kept in record.values() for found in kept["rounds"]))


if __name__ == "__main__":
    main()
