"""Memory of the training pictures, and seconds until the first batch: parts of `benchmarks.speed.run`.

The pictures, masks and maps of a scene are linked under new names until there are as many as asked for. They keep their
size, and the scene is calibrated anew, as `process` leaves it. Each DataManager is built in a process of its own, on
the CPU, and gives ten batches of 4,096 rays. Then the anonymous memory of the process is read (RssAnon: a memory-mapped
file does not count, because the system takes it back when others need memory). "begun" is the same process before
anything was read. VanillaDataManager of nerfstudio keeps all pictures as float32; it reads no depth here.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
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
    for step in range(BATCHES):
        manager.next_train(step + 1)
    found = {"begun_mb": before, "anonymous_mb": anonymous_mb(), "first_batch_s": ready_s}
    tables = list((scene / ".cache" / "pixels").glob("*.npy"))
    if which == "ours" and tables:
        found["table_mb"] = sum(path.stat().st_size for path in tables) / 2**20
    return found


def measured(which: str, scene: Path) -> dict[str, float]:
    """Run `build` in a process of its own."""
    command = [sys.executable, __file__, which, str(scene)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(done.stdout[-3000:] + done.stderr[-3000:])
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    print("\n" + json.dumps(build(sys.argv[1], Path(sys.argv[2]))))
