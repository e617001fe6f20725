"""The same seed gives the same training: in two processes, single-threaded, bit for bit."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from scenes import fisheye, write_scene

from edge_depth_nerf.kernels import hash_grid_numba as cpu
from edge_depth_nerf.plugin.compat import allow_numpy_scalars_in_checkpoints

pytestmark = pytest.mark.slow

STEPS = 12


def test_two_trainings_are_the_same_bit_for_bit(tmp_path: Path) -> None:
    """The first one makes the caches, the second finds them; their dictionaries and sets hash differently."""
    scene = write_scene(tmp_path / "scene", [fisheye(24, 20)], frames=9)
    allow_numpy_scalars_in_checkpoints()
    found = []
    for number in ("1", "2"):
        command = [
            *(str(Path(sys.executable).with_name("ns-train")), "edge-depth-nerf-lite", "--data", str(scene)),
            *("--output-dir", str(tmp_path / number), "--experiment-name", "same", "--timestamp", "run"),
            *("--max-num-iterations", str(STEPS), "--vis", "tensorboard", "--machine.seed", "5"),
            *("--pipeline.datamanager.train-num-rays-per-batch", "128", "--pipeline.model.num-levels", "4"),
            *("--pipeline.model.log2-hashmap-size", "12", "--logging.local-writer.max-log-size", "0"),
        ]
        done = subprocess.run(
            command,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONHASHSEED": number},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=240,
            check=False,
        )
        assert done.returncode == 0, done.stdout[-3000:]
        run = tmp_path / number / "same" / "edge-depth-nerf-lite" / "run" / "nerfstudio_models"
        saved = torch.load(run / f"step-{STEPS - 1:09d}.ckpt", weights_only=True)
        digests = {
            name: hashlib.sha256(tensor.contiguous().numpy().tobytes()).hexdigest()
            for name, tensor in saved["pipeline"].items()
        }
        found.append((digests, saved["optimizers"]["fields"]["state"][0]["exp_avg"]))
    assert found[0][0] == found[1][0]
    assert torch.equal(found[0][1], found[1][1]) and found[0][1].any()


def test_threads_add_in_one_order(monkeypatch) -> None:
    """Whichever thread is ready first: a level that several share is added up in the same order."""
    torch.manual_seed(0)
    positions, gradient = torch.rand(20000, 3), torch.randn(20000, 4)
    scalings = torch.tensor([15.0, 40.0])
    monkeypatch.setattr(cpu, "_threads", lambda *_: 7)
    expected = cpu.table_gradient(positions, gradient, scalings, 2 * 64)

    def backwards(work, shares) -> None:
        for share in reversed(shares):
            work(share)

    monkeypatch.setattr(cpu, "share_out", backwards)
    assert torch.equal(cpu.table_gradient(positions, gradient, scalings, 2 * 64), expected)
