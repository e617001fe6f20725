"""The scene in the repository is what its README says, and trains as it is."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from edge_depth_nerf.base.files import read_distance_png, read_json, read_mask

ROOT = Path(__file__).parents[1]
SAMPLE = ROOT / "data" / "sample_drive"


def test_it_is_small_and_whole():
    files = [path for path in SAMPLE.rglob("*") if path.is_file() and ".cache" not in path.parts]
    assert sum(path.stat().st_size for path in files) <= 3_000_000
    transforms = read_json(SAMPLE / "transforms.json")
    assert len(transforms["frames"]) == 24
    for frame in transforms["frames"]:
        for key, name in frame.items():
            if key.endswith("_path"):
                assert (SAMPLE / name).is_file(), name
    assert not set(transforms["train_filenames"]) & set(transforms["test_filenames"])


def test_its_maps_agree():
    """LiDAR, monocular distance and truth of a frame are of one world."""
    for frame in read_json(SAMPLE / "transforms.json")["frames"][::5]:
        lidar, mono, truth = (
            read_distance_png(SAMPLE / frame[f"{name}_file_path"]) for name in ("lidar", "mono", "truth_distance")
        )
        mask = read_mask(SAMPLE / frame["mask_path"])
        returns = (lidar > 0) & (truth > 0)
        assert returns.sum() > 300
        assert not (lidar > 0)[~mask].any()
        # a return lies anywhere in its pixel, the truth in its middle: at edges they differ
        off = np.abs(lidar[returns] / truth[returns] - 1)
        assert np.median(off) < 0.02 and (off < 0.05).mean() > 0.85
        both = (mono > 0) & (truth > 0) & mask
        assert 0.01 < np.median(np.abs(mono[both] / truth[both] - 1)) < 0.2


def test_the_stated_command_trains(tmp_path):
    scene = tmp_path / "sample_drive"
    shutil.copytree(SAMPLE, scene, ignore=shutil.ignore_patterns(".cache"))
    command = [
        *(str(Path(sys.executable).with_name("ns-train")), "edge-depth-nerf-lite", "--data", str(scene)),
        *("--output-dir", str(tmp_path / "outputs"), "--max-num-iterations", "5", "--vis", "tensorboard"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout[-3000:]
    assert list((tmp_path / "outputs").rglob("step-000000004.ckpt"))
