"""Memory and time over drives of growing length: process, then integration and training.

    python -m benchmarks.robustness.long_drive DRIVE [--pictures 100 400 1000 4000] [--sweeps 3] [--broken]

DRIVE is one that `synthesize` has written. Its pictures, sweeps and simulated monocular maps are linked again and
again under new numbers, along a path that goes on: repetition r is shifted by r times the drive's length. What is seen
repeats itself, its amount and its extent are those of a drive of that length. Each length goes through
`edge-depth-nerf process kitti360` and then through building the DataManager and 20 steps of edge-depth-nerf-lite, each
in a process of its own; told is the most anonymous memory that each had (RssAnon, looked at every 20 ms; memory-mapped
files do not count). --broken spoils a picture, a sweep and a monocular map in the middle.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TRAIN = """
import copy, sys, tempfile
from pathlib import Path
import torch
from nerfstudio.configs.method_configs import all_methods
config = copy.deepcopy(all_methods["edge-depth-nerf-lite"])
config.machine.device_type, config.vis, config.data = "cpu", "tensorboard", Path(sys.argv[1])
config.pipeline.datamanager.dataparser.data = Path(sys.argv[1])
config.max_num_iterations, config.output_dir = 20, Path(tempfile.mkdtemp(dir=sys.argv[1]))
config.logging.local_writer.enable = False
torch.manual_seed(0)
trainer = config.setup()
trainer.setup(test_mode="val")
trainer.train()
"""


def lengthened(drive: Path, folder: Path, frames: int) -> str:
    """Write a drive of so many moments, linked from a short one; give its sequence."""
    (images,) = (drive / "data_2d_raw").iterdir()
    sequence = images.name
    lines = (drive / f"data_poses/{sequence}/poses.txt").read_text().splitlines()
    poses = {int(line.split()[0]): np.array(line.split()[1:], float).reshape(3, 4) for line in lines if line.strip()}
    originals = sorted(poses)
    first, last = poses[originals[0]][:, 3], poses[originals[-1]][:, 3]
    length = (last - first) * len(originals) / (len(originals) - 1)
    shutil.copytree(drive / "calibration", folder / "calibration")
    cameras = sorted(path.name for path in images.iterdir() if (path / "data_rgb").is_dir())
    places = {f"data_2d_raw/{sequence}/{name}/data_rgb": ".png" for name in cameras}
    places |= {f"simulated_mono/{sequence}/{name}": ".png" for name in cameras}
    places[f"data_3d_raw/{sequence}/velodyne_points/data"] = ".bin"
    for place, suffix in places.items():
        (folder / place).mkdir(parents=True)
        for number in range(frames):
            source = drive / place / f"{originals[number % len(originals)]:010d}{suffix}"
            os.symlink(source.resolve(), folder / place / f"{number:010d}{suffix}")
    written = []
    for number in range(frames):
        pose = poses[originals[number % len(originals)]].copy()
        pose[:, 3] += number // len(originals) * length
        written.append(f"{number} " + " ".join(f"{value!r}" for value in pose.ravel().tolist()))
    path = folder / f"data_poses/{sequence}/poses.txt"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(written) + "\n")
    return sequence


def spoil(folder: Path, sequence: str, frames: int) -> None:
    """Break a picture, a sweep and a monocular map in the middle."""
    middle = frames // 2
    for place, number, suffix in (
        (f"data_2d_raw/{sequence}/image_02/data_rgb", middle, ".png"),
        (f"simulated_mono/{sequence}/image_03", middle + 1, ".png"),
        (f"data_3d_raw/{sequence}/velodyne_points/data", middle + 3, ".bin"),
    ):
        path = folder / place / f"{number:010d}{suffix}"
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content[: len(content) // 2 + 1])


def watched(command: list[str]) -> dict[str, float]:
    """Run a command; its seconds and the most anonymous memory it had, MB."""
    started, most = time.monotonic(), 0
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT)
        while process.poll() is None:
            try:
                status = Path(f"/proc/{process.pid}/status").read_text()
            except OSError:
                break
            most = max([most, *(int(line.split()[1]) for line in status.splitlines() if line.startswith("RssAnon"))])
            time.sleep(0.02)
        process.wait()
        said.seek(0)
        text = said.read()
    if process.returncode:
        raise RuntimeError(text[-3000:])
    for line in text.splitlines():
        if line.startswith("Left out") or "broken or missing" in line:
            print(f"    {line[:150]}")
    return {"seconds": round(time.monotonic() - started, 1), "most_mb": round(most / 1024, 1)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--pictures", type=int, nargs="+", default=[100, 400, 1000, 4000])
    parser.add_argument("--work", type=Path, default=Path("outputs/long_drive"))
    parser.add_argument("--sweeps", type=int, default=3)
    parser.add_argument("--broken", action="store_true")
    options = parser.parse_args()
    print(f"{'pictures':>8} {'process':>10} {'':>9} {'training':>10} {'':>9}")
    for pictures in options.pictures:
        folder = options.work.resolve() / str(pictures)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        cameras = 2
        sequence = lengthened(options.drive, folder / "drive", pictures // cameras)
        if options.broken:
            spoil(folder / "drive", sequence, pictures // cameras)
        process = watched(
            [
                *(sys.executable, "-m", "edge_depth_nerf", "process", "kitti360"),
                *("--root", str(folder / "drive"), "--sequence", sequence),
                *("--output", str(folder / "scene"), "--mono", str(folder / f"drive/simulated_mono/{sequence}")),
                *("--sweeps", str(options.sweeps), "--no-motion"),
            ]
        )
        training = watched([sys.executable, "-c", TRAIN, str(folder / "scene")])
        print(
            f"{pictures:8} {process['most_mb']:7.0f} MB {process['seconds']:7.0f} s "
            f"{training['most_mb']:7.0f} MB {training['seconds']:7.0f} s",
            flush=True,
        )
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
