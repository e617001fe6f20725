"""Memory of the training pictures, and seconds until the first batch: ours beside nerfstudio's DataManager.

    python benchmarks/memory.py SCENE [--frames 10 100 300] [--json FILE]

The scene's pictures, masks and maps are linked under new names until there are as many as asked for; they are as large
as they were, and it is calibrated anew, as `process` leaves it. Each DataManager is built in a process of its own, on
the CPU, and gives ten batches of 4,096 rays; then the process's anonymous memory is read (RssAnon: what a memory-
mapped file needs does not count, it is given back when others want it). "begun" is the same process before anything
was read. Ours gives ten batches more after the system was told to forget its pixel table, as if it were larger than
memory: "cold". nerfstudio's VanillaDataManager keeps all pictures as float32; it reads no depth here. Where it does
not fit into half of the machine's memory it is computed: its slope over smaller drives times the pictures, which is
said.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

BATCHES = 10
CALIBRATE = "import sys, pathlib, edge_depth_nerf.mono.calibration as t; t.calibrate_scene(pathlib.Path(sys.argv[1]))"


def anonymous_mb() -> float:
    """Anonymous resident memory of this process (Linux)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon"):
            return int(line.split()[1]) / 1024
    raise RuntimeError("no RssAnon in /proc/self/status")


def forget(path: Path) -> None:
    """Let the system drop what it holds of a file in memory."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def multiplied(scene: Path, frames: int, folder: Path) -> None:
    """A scene of so many pictures, linked from another's."""
    meta = json.loads((scene / "transforms.json").read_text())
    training = set(meta["train_filenames"])
    originals = [frame for frame in meta["frames"] if frame["file_path"] in training]
    entries = []
    for number in range(frames):
        entry = dict(originals[number % len(originals)])
        for key, value in list(entry.items()):
            if key.endswith("_path") and not key.startswith("truth"):
                source = scene / value
                # masks of a camera stay one file
                name = value if key == "mask_path" else str(Path(value).with_stem(f"{number:010d}"))
                target = folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                if not target.exists():
                    os.link(source.resolve(), target)
                entry[key] = name
            elif key.startswith("truth"):
                del entry[key]
        entry["frame"] = number
        entries.append(entry)
    meta["frames"] = entries
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        names = [entry["file_path"] for entry in entries]
        meta[key] = names[:-1] if key == "train_filenames" else names[-1:]
    for key in ("shifted_views", "ply_file_path"):
        meta.pop(key, None)
    (folder / "transforms.json").write_text(json.dumps(meta))
    if "mono_file_path" in entries[0] and "lidar_file_path" in entries[0]:
        # as `process` leaves a scene
        subprocess.run([sys.executable, "-c", CALIBRATE, str(folder)], check=True)


def build(which: str, scene: Path) -> dict[str, float]:
    """Build one DataManager and measure."""
    import torch
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
    from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig

    torch.manual_seed(0)
    before = anonymous_mb()
    started = time.perf_counter()
    if which == "ours":
        config: Any = FisheyeDepthDataManagerConfig(dataparser=FisheyeDepthDataParserConfig(data=scene))
    else:
        config = VanillaDataManagerConfig(dataparser=NerfstudioDataParserConfig(data=scene))
    config.train_num_rays_per_batch = 4096
    manager = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    manager.next_train(0)
    ready_s = time.perf_counter() - started
    started = time.perf_counter()
    for step in range(BATCHES):
        manager.next_train(step + 1)
    batch_s = (time.perf_counter() - started) / BATCHES
    found = {"begun_mb": before, "anonymous_mb": anonymous_mb(), "first_batch_s": ready_s, "batch_s": batch_s}
    tables = list((scene / ".cache" / "pixels").glob("*.npy"))
    if which == "ours" and tables:
        found["table_mb"] = sum(path.stat().st_size for path in tables) / 2**20
        cold_s = 0.0
        for step in range(BATCHES):
            for path in tables:
                forget(path)
            started = time.perf_counter()
            manager.next_train(BATCHES + step + 1)
            cold_s += time.perf_counter() - started
        found["cold_batch_s"] = cold_s / BATCHES
    return found


def measured(which: str, scene: Path) -> dict[str, float]:
    """Run `build` in a process of its own."""
    command = [sys.executable, __file__, str(scene), "--only", which]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stdout[-3000:] + done.stderr[-3000:])
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 100, 300])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--only", choices=("ours", "nerfstudio"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        found = build(options.only, options.scene)
        print("\n" + json.dumps(found))
        return
    total_mb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**20
    rows: list[dict[str, Any]] = []
    print(f"{'pictures':>8} {'':>22} {'RssAnon':>9} {'begun':>9} {'first batch':>12} {'a batch':>10}")
    for frames in sorted(options.frames):
        with tempfile.TemporaryDirectory(dir=options.scene.resolve().parent) as name:
            folder = Path(name)
            multiplied(options.scene, frames, folder)
            for label, which in (("ours", "ours"), ("ours, second start", "ours"), ("nerfstudio", "nerfstudio")):
                there = [row for row in rows if row["which"] == "nerfstudio" and "slope" not in row]
                slope = max(((row["anonymous_mb"] - row["begun_mb"]) / row["pictures"] for row in there), default=0.0)
                if which == "nerfstudio" and slope * frames > total_mb / 2:
                    begun = there[-1]["begun_mb"]
                    row = {"begun_mb": begun, "anonymous_mb": begun + slope * frames, "slope": slope}
                    print(f"{frames:8} {label:>22} {row['anonymous_mb']:6.0f} MB, computed: {slope:.1f} MB a picture")
                else:
                    row = measured(which, folder)
                    print(
                        f"{frames:8} {label:>22} {row['anonymous_mb']:6.0f} MB {row['begun_mb']:6.0f} MB "
                        f"{row['first_batch_s']:10.1f} s {row['batch_s'] * 1e3:7.1f} ms"
                        + (f", {row['cold_batch_s'] * 1e3:.1f} ms cold" if "cold_batch_s" in row else "")
                    )
                rows.append({"pictures": frames, "which": label, **row})
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
