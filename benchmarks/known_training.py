"""Whether trainings learn more in the same time if rays with a sharp prior get few samples: PSNR and AbsRel.

    python benchmarks/known_training.py SCENE... [--steps 1000] [--json FILE] [--page FILE]

A ray knows its surface where σ̂ is at most 5 % of the prior's distance, and where it shows the sky. Its samples are
placed without the proposal networks. To a known distance, a quarter of them lies in front of it, the others within
±3 σ̂, and the last one reaches twice as far; in the sky they lie from the near plane to the far one. Behind them is
the sky's colour, as behind every ray. All other rays have samples as today. So have all rays of a step that trains the
proposal networks, because views are rendered with these.

- By the prior: this, with several numbers of samples.
- Corrected: the distance is the prior's times what rendered distances are to it in a block of 16 × 16 pixels. Its σ is
  how much that varies there, and at least 1 %.
- At first: by the prior, for the first third of the steps alone, while the prior is sharper than the model.

Before a scene's trainings, steps of all ways take turns, with today's number of rays and with twice as many. From then
on a way has so many rays that a step takes as long as today's. Some rows have another number, to show what more rays
give. PSNR and AbsRel (against LiDAR if the truth is not known) are of 3,000 random pixels of each held-out view. Run it
on an idle machine, with drives that no results table is made of.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ablate
import speed
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from torch import Tensor

from edge_depth_nerf.plugin.fused.nerfacto_losses import distortion_loss
from edge_depth_nerf.plugin.fused.ray_samplers import edges_of, samples_along

RESULTS = Path(__file__).with_name("known_training.json")
PART = "known training"
SHARP = 0.05
"""The largest σ̂ of a ray that knows, as a share of the distance."""
AROUND = 3.0
"""Standard deviations before and behind a known distance."""
BLOCK_PX = 16
LEAST_SEEN, LEAST_SIGMA, LATEST = 4, 0.01, 0.1
"""Of a block: rays before it corrects the prior, least σ as a share of the distance, weight of the latest ray."""
FARTHEST_OFF = 0.5
"""A rendered distance that is so much off the prior, as a share of it, is of another surface."""
AT_FIRST = 1 / 3
STEPS_IN_A_TURN, ROUNDS, UNTIMED_ROUNDS = 20, 6, 3
TODAY, IN_TWO = "today's way", "today's way, in two calls"


@dataclass(frozen=True)
class Way:
    """How the rays that know are sampled."""

    samples: int | None
    """None: as all others."""
    corrected: bool = False
    at_first: bool = False
    rays: int | None = None
    """None: as many as take as long as today's."""


WAYS = {
    TODAY: Way(None),
    f"{TODAY}, more rays": Way(None, rays=1536),
    **{f"by the prior, {samples} samples": Way(samples) for samples in (24, 16, 8)},
    "at first, 16 samples": Way(16, at_first=True),
    "corrected, 16 samples": Way(16, corrected=True),
    "corrected, 8 samples": Way(8, corrected=True),
    "corrected, 8 samples, more rays": Way(8, corrected=True, rays=2048),
}


class Correction:
    """What rendered distances are to the prior's, in blocks of pixels."""

    def __init__(self, cameras: Cameras) -> None:
        shape = ablate.blocks_of(cameras, BLOCK_PX)
        self.ratio, self.variance, self.seen = torch.ones(shape), torch.zeros(shape), torch.zeros(shape)

    def at(self, indices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Ratio, σ as a share of the distance, and whether enough rays were seen."""
        block = ablate.block_of(indices, BLOCK_PX)
        sigma = self.variance[block].sqrt().clamp(min=LEAST_SIGMA)
        return self.ratio[block], sigma, self.seen[block] >= LEAST_SEEN

    def see(self, indices: Tensor, ratio: Tensor) -> None:
        """Take rendered distances into the means; of several in a block one counts."""
        block = ablate.block_of(indices, BLOCK_PX)
        self.seen[block] += 1
        latest = (1 / self.seen[block]).clamp(min=LATEST)
        off = ratio - self.ratio[block]
        self.ratio[block] += latest * off
        self.variance[block] += latest * (off.square() - self.variance[block])


class Steps:
    """Training steps of a pipeline in which rays that know are sampled in a way of their own."""

    def __init__(self, pipeline: Any, way: Way, steps: int) -> None:
        self.model, self.way, self.steps = pipeline.model, way, steps
        self.correction = Correction(pipeline.datamanager.train_dataset.cameras)
        self.pixels = pipeline.datamanager.train_pixel_sampler
        self.rays_today = pipeline.datamanager.config.train_num_rays_per_batch
        self.as_today = pipeline._computed

    def computed(self, rays: RayBundle, batch: dict[str, Any]) -> Any:
        """Outputs, losses and metrics of a batch."""
        if self.way.at_first and self.model._step >= AT_FIRST * self.steps:
            self.pixels.set_num_rays_per_batch(self.rays_today)
            return self.as_today(rays, batch)
        distance_m, sigma_m, known = self._surfaces(batch)
        if self.model.updates_proposals() or not 0 < int(known.sum()) < len(known):
            outputs, losses, metrics = self.as_today(rays, batch)
            self._see(batch, outputs)
            return outputs, losses, metrics
        of_rays, surfaces = _apart(batch)
        others, own = _some(of_rays, ~known), _some(of_rays, known)
        outputs, losses, metrics = self.as_today(rays[~known], others | surfaces)
        self._see(others, outputs)
        share = known.float().mean()
        # means over all rays
        losses = {name: loss * (1 if name == "surface_loss" else 1 - share) for name, loss in losses.items()}
        for name, loss in self._losses_of_known(rays[known], own, distance_m[known], sigma_m[known]).items():
            losses[name] = losses[name] + share * loss
        return outputs, losses, metrics

    def in_two_calls(self, rays: RayBundle, batch: dict[str, Any]) -> Any:
        """Today's step with every other ray in a call of its own, where `computed` would take two."""
        if self.model.updates_proposals():
            return self.as_today(rays, batch)
        of_rays, surfaces = _apart(batch)
        half = torch.arange(len(rays)) % 2 == 0
        outputs, losses, metrics = self.as_today(rays[half], _some(of_rays, half) | surfaces)
        _, others, _ = self.as_today(rays[~half], _some(of_rays, ~half))
        return outputs, {name: loss + others.get(name, 0) for name, loss in losses.items()}, metrics

    def _surfaces(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor, Tensor]:
        """Distance and σ of each ray in metres, a distance of 0 in the sky, and which rays know."""
        prior_m, sigma_m, sky = (batch[name][:, 0] for name in ("prior_distance_m", "prior_sigma_m", "sky"))
        known = self.model._can_be_met(prior_m) & (sigma_m <= SHARP * prior_m)
        if self.way.corrected:
            ratio, share, seen = self.correction.at(batch["indices"])
            known &= seen & (share <= SHARP)
            prior_m = prior_m * ratio
            sigma_m = prior_m * share
        return torch.where(sky, 0, prior_m), sigma_m, sky | known

    def _see(self, batch: dict[str, Any], outputs: dict[str, Any]) -> None:
        """Let rendered median distances correct the prior."""
        if not self.way.corrected:
            return
        weights, frustums = outputs["weights_list"][-1][..., 0].detach(), outputs["ray_samples_list"][-1].frustums
        prior_m, hit = batch["prior_distance_m"][:, 0], weights.sum(dim=1, keepdim=True)
        median = (weights.cumsum(dim=1) < hit / 2).sum(dim=1, keepdim=True).clamp(max=weights.shape[1] - 1)
        middles = (frustums.starts + frustums.ends)[..., 0] / 2
        ratio = middles.gather(1, median)[:, 0] * self.model.metres_per_unit / prior_m
        met = (prior_m > 0) & (hit[:, 0] > 0.5) & ((ratio - 1).abs() < FARTHEST_OFF)
        self.correction.see(batch["indices"][met], ratio[met])

    def _losses_of_known(
        self, rays: RayBundle, batch: dict[str, Any], distance_m: Tensor, sigma_m: Tensor
    ) -> dict[str, Tensor]:
        """The losses on rays that know; means over these."""
        model, sampler = self.model, self.model.proposal_sampler
        propose, levels = sampler.forward, len(model.density_fns) + 1
        sampler.forward = lambda rays, **_: (self.samples(rays, distance_m, sigma_m), [], [])
        try:
            outputs = model(rays, batch)
        finally:
            sampler.forward = propose
        weights, samples = outputs["weights_list"][-1], outputs["ray_samples_list"][-1]
        losses = {
            "rgb_loss": model.rgb_loss(batch["image"], outputs["rgb"]),
            "distortion_loss": model.config.distortion_loss_mult * distortion_loss(edges_of(samples), weights[..., 0]),
            # the others' are means over the levels of samples, too
            "edge_loss": model._depth_weight() * model._depth_losses(outputs, batch) / levels,
            "sky_loss": model._sky_and_surface_losses(outputs, batch)["sky_loss"] / levels,
        }
        model.camera_optimizer.get_loss_dict(losses)
        return losses

    def samples(self, rays: RayBundle, distance_m: Tensor, sigma_m: Tensor) -> RaySamples:
        """Place samples, each edge but the outer ones anywhere within its interval."""
        count, nears, fars = self.way.samples, rays.nears, rays.fars
        assert count is not None and nears is not None and fars is not None
        first = self.model.proposal_sampler.initial_sampler
        low, high = first.spacing_fn(nears), first.spacing_fn(fars)

        def place(distance: Tensor) -> Tensor:
            return (first.spacing_fn(distance) - low) / (high - low)

        known, sigma = (each[:, None] / self.model.metres_per_unit for each in (distance_m, sigma_m))
        nearest = torch.maximum(known - AROUND * sigma, nears)
        farthest = torch.maximum(known + AROUND * sigma, nears)
        free, jitter = count // 4, torch.rand(len(rays), 1)
        in_front = place(nearest) * (torch.arange(1, free) + jitter) / free
        around = place(torch.lerp(nearest, farthest, (torch.arange(count - free) + jitter) / (count - free)))
        edges = torch.cat([torch.zeros_like(low), in_front, around, place(2 * farthest)], dim=1)
        in_sky = (torch.arange(count + 1) + jitter - 0.5) / count
        edges = torch.where(known > 0, edges, in_sky).clamp(0, 1)[..., None]
        at = first.spacing_fn_inv(torch.lerp(low, high, edges[..., 0]))[..., None]
        return samples_along(
            rays, at[:, :-1], at[:, 1:], spacing_starts=edges[:, :-1], spacing_ends=edges[:, 1:]
        )  # fmt: skip


def _apart(batch: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a batch has of its rays, and of its surface pixels."""
    surfaces = {name: value for name, value in batch.items() if name.startswith("surface_")}
    return {name: value for name, value in batch.items() if name not in surfaces}, surfaces


def _some(of_rays: dict[str, Any], chosen: Tensor) -> dict[str, Any]:
    return {name: value[chosen] for name, value in of_rays.items()}


def timed(scene: Path, steps: int) -> tuple[dict[str, int], dict[str, float]]:
    """Rays of each way whose steps take as long as today's, and milliseconds of a step with today's rays."""
    config = speed.configurations("lite", scene, ["ours"])["ours"]
    today = config.pipeline.datamanager.train_num_rays_per_batch
    spread = [int((k + 0.5) * steps / STEPS_IN_A_TURN) for k in range(STEPS_IN_A_TURN)]
    seconds: dict[tuple[str, int], list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        runner = speed.Runner(config, Path(folder))
        pipeline: Any = runner.trainer.pipeline
        turns: dict[tuple[str, int], Callable[..., Any]] = {
            (TODAY, today): pipeline._computed,
            (IN_TWO, today): Steps(pipeline, WAYS[TODAY], steps).in_two_calls,
        }
        for name, way in WAYS.items():
            if way.samples is not None and way.rays is None:
                # what is compared is the first third's steps
                computed = Steps(pipeline, replace(way, at_first=False), steps).computed
                turns |= {(name, today): computed, (name, 2 * today): computed}
        for number in range(-UNTIMED_ROUNDS, ROUNDS):
            for turn in turns if number % 2 else reversed(turns):
                pipeline._computed = turns[turn]
                pipeline.datamanager.train_pixel_sampler.set_num_rays_per_batch(turn[1])
                took = runner.iterate(spread)
                if number >= 0:
                    seconds.setdefault(turn, []).append(took)
    ms = {turn: statistics.median(took) / STEPS_IN_A_TURN * 1e3 for turn, took in seconds.items()}
    rays = {}
    for name, way in WAYS.items():
        rays[name] = way.rays or today
        if way.rays is None and way.samples is not None:
            fewer, more = ms[name, today], ms[name, 2 * today]
            rays[name] = round(today * (1 + (ms[TODAY, today] - fewer) / (more - fewer)))
    return rays, {name: found for (name, count), found in ms.items() if count == today}


def measure(scene: Path, results: dict[str, Any], keep: Callable[[], None]) -> None:
    steps, found = results["steps"], ablate.of_scene(results, scene)
    if not found:
        found["rays"], found["ms"] = timed(scene, steps)
        found["ways"] = {}
        keep()
    for name, way in WAYS.items():
        if name in found["ways"]:
            continue

        def know(pipeline: Any, way: Way = way, rays: int = found["rays"][name]) -> None:
            pipeline.datamanager.train_pixel_sampler.set_num_rays_per_batch(rays)
            if way.samples is not None:
                pipeline._computed = Steps(pipeline, way, steps).computed

        figures = ablate.train(scene, ablate.falling_over(steps), steps, 0, know)
        found["ways"][name] = {**ablate.against_truth(figures), "ms": figures["seconds a step"] * 1e3}
        keep()


def table(results: dict[str, Any]) -> str:
    """Rays, milliseconds of a step, PSNR and AbsRel of each way and scene, as Markdown."""
    scenes: dict[str, Any] = results["scenes"]

    def cell(of: dict[str, Any], name: str) -> str:
        found = of["ways"][name]
        return f"{of['rays'][name]:,}, {found['ms']:.0f}, {found['psnr']:.2f} dB, {found['abs_rel']:.4f}"

    rows = {name: [cell(of, name) for of in scenes.values()] for name in WAYS}
    return ablate.table_of_scenes("rays, ms a step, PSNR, AbsRel", scenes, rows)


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, measure)


if __name__ == "__main__":
    main()
