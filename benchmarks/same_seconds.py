"""What else the seconds of a training could pay for: PSNR and AbsRel of variants that all take as long as today's.

    python benchmarks/same_seconds.py SCENE... [--steps 1000] [--json FILE] [--page FILE]

A variant has another number of rays, surface pixels or samples, another grid, or wider networks; or it draws pixels by
how wrong the model was when it last saw their 8 × 8 pixels, as likely as the root of that squared error. Before a
scene's trainings, steps of all variants take turns. Then each is trained for as many steps as take as long as today's,
and its learning rates fall over these. PSNR and AbsRel (against LiDAR if the truth is not known) are of 3,000 random
pixels of each held-out view. The defaults and the variants that gained most are trained with more seeds. Run it on an
idle machine, with drives that no results table is made of.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import ablate
import speed
import torch
from nerfstudio.cameras.rays import RayBundle

from edge_depth_nerf.plugin.config import apply_overrides
from edge_depth_nerf.plugin.datamanager import TablePixelSampler
from edge_depth_nerf.plugin.pixel_table import PixelBatch

RESULTS = Path(__file__).with_name("same_seconds.json")
PART = "same seconds"
BLOCK_PX = 8
READ = 3
"""Of so many times the pixels of a batch, it is drawn by their last error."""
UNSEEN = 0.05
"""The squared error of what was not seen yet."""
LEAST_ERROR = 1e-5
STEPS_IN_A_TURN, ROUNDS = 20, 4
TODAY = "today's defaults"


class LastErrors:
    """Squared errors of blocks of pixels when a training last saw them, by which it draws pixels."""

    def __init__(self, pipeline: Any, samplers: tuple[str, ...]) -> None:
        manager = pipeline.datamanager
        self.of_blocks = torch.full(ablate.blocks_of(manager.train_dataset.cameras, BLOCK_PX), UNSEEN)
        self.as_today = pipeline._computed
        for name in samplers:
            sampler: Any = getattr(manager, name)
            sampler.sample = partial(self.drawn, sampler)
        pipeline._computed = self.computed

    def drawn(self, sampler: TablePixelSampler, step: int, keep: Callable[..., Any] | None = None) -> PixelBatch:
        """Draw a batch."""
        count = sampler.num_rays_per_batch
        pixels = sampler.table.batch(sampler.draw(step).start * READ, READ * count, keep)
        errors = self.of_blocks[ablate.block_of(pixels.indices, BLOCK_PX)]
        chosen = torch.zeros(len(errors), dtype=torch.bool)
        chosen[torch.multinomial(errors.sqrt(), len(errors) // READ)] = True
        return pixels[chosen]

    def computed(self, rays: RayBundle, batch: dict[str, Any]) -> Any:
        """Outputs, losses and metrics of a batch, as today; and see its errors."""
        outputs, losses, metrics = self.as_today(rays, batch)
        for prefix in ("surface_", ""):
            error = (outputs[f"{prefix}rgb"].detach() - batch[f"{prefix}image"]).square().mean(dim=1)
            self.of_blocks[ablate.block_of(batch[f"{prefix}indices"], BLOCK_PX)] = error.clamp(min=LEAST_ERROR)
        return outputs, losses, metrics


@dataclass(frozen=True)
class Variant:
    """What differs from today's defaults."""

    overrides: dict[str, Any] = field(default_factory=dict)
    drawn_by_error: tuple[str, ...] = ()
    """The samplers that draw so."""

    def change(self, pipeline: Any) -> None:
        """Change a pipeline of its overrides."""
        if self.drawn_by_error:
            LastErrors(pipeline, self.drawn_by_error)


def _model(**overrides: Any) -> Variant:
    return Variant({f"pipeline.model.{name}": value for name, value in overrides.items()})


def _data(**overrides: Any) -> Variant:
    return Variant({f"pipeline.datamanager.{name}": value for name, value in overrides.items()})


VARIANTS = {
    TODAY: Variant(),
    "512 rays, not 1,024": _data(train_num_rays_per_batch=512),
    "1,536 rays": _data(train_num_rays_per_batch=1536),
    "8,192 surface pixels, not 16,384": _data(surface_rays_per_batch=8192),
    "24,576 surface pixels": _data(surface_rays_per_batch=24576),
    "16 final samples, not 24": _model(num_nerf_samples_per_ray=16),
    "48 + 24 proposal samples, not 64 + 32": _model(num_proposal_samples_per_ray=[48, 24]),
    "4 features a level, not 2": _model(features_per_level=4),
    "2^18 rows a level, not 2^19": _model(log2_hashmap_size=18),
    "finest level 4,096, not 2,048": _model(max_res=4096),
    "networks 128 wide, not 64": _model(hidden_dim=128, hidden_dim_color=128),
    "rays by their last error": Variant(drawn_by_error=("train_pixel_sampler",)),
    "rays and surface pixels by their last error": Variant(drawn_by_error=("train_pixel_sampler", "_surface_sampler")),
}

BEST = (TODAY, "16 final samples, not 24", "rays by their last error")
"""Trained with more seeds."""
SEEDS = (0, 1, 2)
"""The first is that of the table."""


def timed(scene: Path, steps: int) -> dict[str, float]:
    """Milliseconds of a step of each variant, median over turns."""
    spread = [int((k + 0.5) * steps / STEPS_IN_A_TURN) for k in range(STEPS_IN_A_TURN)]
    found: dict[str, list[float]] = {name: [] for name in VARIANTS}
    with tempfile.TemporaryDirectory() as folder:
        runners = {}
        for name, variant in VARIANTS.items():
            config = speed.configurations("lite", scene, ["ours"])["ours"]
            apply_overrides(config, variant.overrides, name)
            runners[name] = speed.Runner(config, Path(folder) / str(len(runners)))
            variant.change(runners[name].trainer.pipeline)
            runners[name].iterate(spread)
        for number in range(ROUNDS):
            for name in runners if number % 2 else reversed(runners):
                found[name].append(runners[name].iterate(spread))
    return {name: statistics.median(took) / STEPS_IN_A_TURN * 1e3 for name, took in found.items()}


def measure(scene: Path, results: dict[str, Any], keep: Callable[[], None]) -> None:
    found = ablate.of_scene(results, scene)
    if not found:
        found["ms"], found["variants"] = timed(scene, results["steps"]), {}
        keep()
    for seed in SEEDS:
        for name in BEST if seed else VARIANTS:
            of_seeds = found["variants"].setdefault(name, {})
            if str(seed) not in of_seeds:
                of_seeds[str(seed)] = trained(scene, name, results["steps"], found["ms"], seed)
                keep()


def trained(scene: Path, name: str, steps_today: int, ms: dict[str, float], seed: int) -> dict[str, float]:
    """Steps, seconds, PSNR and AbsRel of a variant that takes as long as so many steps of today's defaults."""
    steps, variant = round(steps_today * ms[TODAY] / ms[name]), VARIANTS[name]
    figures = ablate.train(scene, variant.overrides | ablate.falling_over(steps), steps, seed, variant.change)
    return {"steps": steps, **ablate.against_truth(figures), "seconds": figures["seconds a step"] * steps}


def gains(results: dict[str, Any], name: str, seed: int) -> list[float]:
    """How much higher the PSNR of a variant is than that of today's defaults, of each scene."""
    every = [of["variants"] for of in results["scenes"].values()]
    return [of[name][str(seed)]["psnr"] - of[TODAY][str(seed)]["psnr"] for of in every]


def table(results: dict[str, Any]) -> str:
    """Steps, PSNR and AbsRel of each variant and scene, as Markdown."""
    scenes: dict[str, Any] = results["scenes"]

    def cell(of: dict[str, Any], name: str) -> str:
        found = of["variants"][name][str(SEEDS[0])]
        return f"{found['steps']:,}, {found['psnr']:.2f} dB, {found['abs_rel']:.4f}"

    rows = {name: [cell(of, name) for of in scenes.values()] for name in VARIANTS}
    return ablate.table_of_scenes("steps, PSNR, AbsRel", scenes, rows)


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, measure)


if __name__ == "__main__":
    main()
