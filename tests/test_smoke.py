"""The plugin runs: a tiny scene, some steps of nerfstudio's trainer, finite losses. For `make test-fast` alone."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
from scenes import fisheye, write_scene

STEPS = 5


def main(scene: Path, folder: Path) -> None:
    """Some steps, in a process of their own; their losses go to losses.json."""
    import torch
    from trainings import trainer_of

    torch.set_num_threads(1)
    trainer = trainer_of(scene, folder, max_num_iterations=STEPS)
    step, losses = trainer.train_iteration, list[dict[str, float]]()

    def watched(number: int) -> tuple[torch.Tensor, dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        total, each, metrics = step(number)
        losses.append({"total": float(total)} | {name: float(value) for name, value in each.items()})
        return total, each, metrics

    trainer.train_iteration = watched  # pyrefly: ignore[bad-assignment]
    trainer.train()
    (folder / "losses.json").write_text(json.dumps(losses))


@pytest.mark.usefixtures("may_start_programs")
def test_some_steps_have_finite_losses_and_a_checkpoint(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if not request.config.getoption("--fast"):
        pytest.skip("test_same_twice.py and test_finite.py train, too")
    scene = write_scene(tmp_path / "scene", [fisheye(24, 20)], frames=5)
    command = [sys.executable, __file__, scene, tmp_path / "runs"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=240)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-3000:]
    losses = json.loads((tmp_path / "runs" / "losses.json").read_text())
    assert len(losses) == STEPS
    for step in losses:
        assert {"total", "rgb_loss", "edge_loss", "interlevel_loss"} <= set(step)
        assert all(math.isfinite(value) for value in step.values()), step
        assert step["edge_loss"] > 0
    assert [path.name for path in (tmp_path / "runs").rglob("*.ckpt")] == [f"step-{STEPS - 1:09d}.ckpt"]


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
