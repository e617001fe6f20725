"""A handful of steps with nerfstudio's trainer: `python smoke.py SCENE FOLDER STEPS` writes FOLDER/losses.json."""

import json
import sys
from pathlib import Path

import torch
from trainings import trainer_of


def main() -> None:
    torch.set_num_threads(1)
    folder = Path(sys.argv[2])
    trainer = trainer_of(Path(sys.argv[1]), folder, max_num_iterations=int(sys.argv[3]))
    step = trainer.train_iteration
    losses: list[dict[str, float]] = []

    def watched(number: int) -> tuple[torch.Tensor, dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        total, each, metrics = step(number)
        losses.append({"total": float(total)} | {name: float(value) for name, value in each.items()})
        return total, each, metrics

    trainer.train_iteration = watched  # pyright: ignore[reportAttributeAccessIssue]
    trainer.train()
    (folder / "losses.json").write_text(json.dumps(losses))


if __name__ == "__main__":
    main()
