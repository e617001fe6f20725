"""The plugin runs: a tiny scene, some steps of nerfstudio's trainer, finite losses. `make test-fast` has this of it."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
from scenes import fisheye, write_scene

HERE = Path(__file__).parent
STEPS = 5


@pytest.mark.usefixtures("may_start_programs")
def test_some_steps_have_finite_losses_and_a_checkpoint(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "scene", [fisheye(24, 20)], frames=5)
    command = [sys.executable, HERE / "smoke.py", scene, tmp_path / "runs", str(STEPS)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    losses = json.loads((tmp_path / "runs" / "losses.json").read_text())
    assert len(losses) == STEPS
    for step in losses:
        assert {"total", "rgb_loss", "edge_loss", "interlevel_loss"} <= set(step)
        assert all(math.isfinite(value) for value in step.values()), step
        assert step["edge_loss"] > 0
    assert [path.name for path in (tmp_path / "runs").rglob("*.ckpt")] == [f"step-{STEPS - 1:09d}.ckpt"]
