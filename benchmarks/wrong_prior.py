"""What a prior that is wrong on purpose costs: our method beside the DS-NeRF loss with the same prior and extras.

    python benchmarks/wrong_prior.py SCENE... [--steps 1000] [--json FILE] [--page docs/ablation.md]

A tenth of the pixels get a prior that is 30 % too far or too near, and their σ̂ says nothing of it. Either single pixels
are wrong, or blocks of 16 by 16 pixels, as a depth network errs; the same ones in each step. All trainings of a scene
start from the same seed and are judged on the same pixels, as in `ablate.py`. The DS-NeRF loss has the λ and σ of its
search (docs/results.md), ours its defaults.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import ablate
import torch

RESULTS = Path(__file__).with_name("wrong_prior.json")
PART = "wrong prior"
SHARE, BY = 0.1, 0.3
"""Of the pixels; of their distance."""
BLOCKS = {"unchanged": 0, "single pixels wrong": 1, "blocks of pixels wrong": 16}
"""Sides of what is wrong together, pixels; 0: nothing is."""
METHODS: dict[str, dict[str, Any]] = {
    "ours": {},
    "DS-NeRF loss": {
        "pipeline.model.depth_loss": "ds-nerf",
        "pipeline.model.depth_loss_mult": 0.03,
        "pipeline.model.depth_sigma": 0.3,
    },
}


def factors(indices: torch.Tensor, block: int) -> torch.Tensor:
    """What the prior of pixels (picture, row, column) is multiplied by; always the same for a pixel."""
    picture, row, column = indices.cpu().unbind(-1)
    # splitmix64's constants; products wrap around
    state = picture * 0x9E3779B9 + (row // block) * 0x85EBCA6B + (column // block) * 0xC2B2AE35
    for _ in range(2):
        state = (state ^ (state >> 29)) * 0x1F58476D1CE4E5B9
    drawn = ((state >> 20) & 0xFFFFF).double() / 0x100000
    wrong, too_far = drawn < SHARE, drawn < SHARE / 2
    return torch.where(wrong, torch.where(too_far, 1 + BY, 1 - BY), 1.0).float()[:, None].to(indices.device)


def spoil(pipeline: Any, block: int) -> None:
    """Let a pipeline's batches have the wrong prior."""
    manager = pipeline.datamanager
    served = manager.next_train

    def next_train(step: int) -> tuple[Any, dict[str, Any]]:
        rays, batch = served(step)
        for prefix, distance in (("", "prior_distance_m"), ("surface_", "surface_distance_m")):
            if distance in batch:
                batch[distance] = batch[distance] * factors(batch[f"{prefix}indices"], block)
        return rays, batch

    manager.next_train = next_train


def table(results: dict[str, Any]) -> str:
    """PSNR and AbsRel of each, as Markdown."""
    scenes: dict[str, Any] = results["scenes"]
    rows = {}
    for method in METHODS:
        for title in BLOCKS:
            found = [each[f"{method}, {title}"] for each in scenes.values()]
            cells = [f"{each['truth_psnr']:.2f}, {each['truth_abs_rel']:.4f}" for each in found]
            rows[f"{method}, prior {title}"] = cells
    return ablate.table_of_scenes("PSNR, AbsRel", scenes, rows)


def measure(scene: Path, results: dict[str, Any], keep: Callable[[], None]) -> None:
    steps, found = results["steps"], ablate.of_scene(results, scene)
    for method, overrides in METHODS.items():
        for title, block in BLOCKS.items():
            key = f"{method}, {title}"
            if key not in found:
                change = (lambda pipeline, block=block: spoil(pipeline, block)) if block else None
                found[key] = ablate.train(scene, {**overrides, **ablate.falling_over(steps)}, steps, 0, change)
                keep()


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, measure)


if __name__ == "__main__":
    main()
