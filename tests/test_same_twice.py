"""The same seed gives the same training: in two processes, single-threaded, bit for bit."""

import sys
from pathlib import Path

import pytest
import torch
from host_commands import in_one_process, status_of
from scenes import fisheye, write_scene

from edge_depth_nerf.kernels import hash_grid_numba as cpu
from edge_depth_nerf.plugin.compat import allow_numpy_scalars_in_checkpoints

pytestmark = pytest.mark.slow

STEPS = 12


def test_two_trainings_are_the_same_bit_for_bit(tmp_path: Path, monkeypatch, unchecked_types) -> None:
    """The first makes the caches, the second, a process of its own, finds them; their dictionaries hash differently."""
    scene = write_scene(tmp_path / "scene", [fisheye(24, 20)], frames=9)
    allow_numpy_scalars_in_checkpoints()
    monkeypatch.setattr(sys, "argv", sys.argv)
    threads = torch.get_num_threads()
    found = []
    for number in ("1", "2"):
        words = [
            *("ns-train", "edge-depth-nerf-lite", "--data", str(scene)),
            *("--output-dir", str(tmp_path / number), "--experiment-name", "same", "--timestamp", "run"),
            *("--max-num-iterations", str(STEPS), "--vis", "tensorboard", "--machine.seed", "5"),
            *("--pipeline.datamanager.train-num-rays-per-batch", "128", "--pipeline.model.num-levels", "4"),
            *("--pipeline.model.log2-hashmap-size", "12", "--logging.local-writer.max-log-size", "0"),
        ]
        if number == "1":
            torch.set_num_threads(1)
            assert status_of(words) == 0
            torch.set_num_threads(threads)
        else:
            in_one_process({number: words}, tmp_path, variables={"PYTHONHASHSEED": "2"})(number)
        run = tmp_path / number / "same" / "edge-depth-nerf-lite" / "run" / "nerfstudio_models"
        saved = torch.load(run / f"step-{STEPS - 1:09d}.ckpt", weights_only=True)
        found.append((saved["pipeline"], saved["optimizers"]["fields"]["state"][0]["exp_avg"]))
    assert found[0][0].keys() == found[1][0].keys()
    assert all(torch.equal(one, other) for one, other in zip(found[0][0].values(), found[1][0].values(), strict=True))
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
