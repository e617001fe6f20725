"""Whether views render faster if rays know where their surface is: seconds a view, PSNR and AbsRel of three ways.

    python benchmarks/known_rays.py SCENE... [--steps 1000] [--json FILE] [--page FILE]

Ours is trained on each scene. Its held-out views are rendered as they are today, with two proposal networks; and then
with fewer samples, placed without proposal networks, on those rays that know their surface:

- from neighbours: every other pixel of every other row is rendered as today. A ray between four of them whose distances
  agree has its samples by their weights, moved by the distance between them.
- from training pictures: what the eight nearest training pictures render is projected into the view. Where two of them
  agree, samples lie around that distance. The training pictures are rendered first; the seconds do not count it.

All other rays are rendered as today. For comparison, today's way with fewer samples of the proposal networks, or with
fewer final ones. PSNR is against the noise-free picture, inside the mask; AbsRel is against the true distance. Run it
on an idle machine, with drives that no results table is made of.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import ablate
import numpy as np
import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from edge_depth_nerf.compare.judging import evaluated
from edge_depth_nerf.kernels.back_ends import along_rays
from edge_depth_nerf.method.detail import seen_from
from edge_depth_nerf.method.metrics import DepthErrors, masked_psnr
from edge_depth_nerf.plugin.compat import without_undefined_ray
from edge_depth_nerf.plugin.detail import detail_shown
from edge_depth_nerf.plugin.fused.ray_samplers import samples_along

RESULTS = Path(__file__).with_name("known_rays.json")
PART = "known rays"
NEIGHBOURS_AGREE = 1.15
"""The largest of four distances by the smallest."""
PICTURES, PICTURES_AGREE = 8, 0.03
"""The training pictures, and the share by which two of their distances may differ."""
AROUND = 3.0
"""Standard deviations before and behind a known distance."""
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Rendered:
    """Rays of a view."""

    rgb: Tensor
    """[rays, 3]."""
    depth: Tensor
    """[rays, 1], scene units."""
    edges: Tensor
    """Of the final samples, [rays, samples + 1], scene units."""
    weights: Tensor
    """[rays, samples]."""


class View:
    """A held-out view; its rays are a row."""

    def __init__(self, pipeline: Any, number: int) -> None:
        self.pipeline, self.model, self.number = pipeline, pipeline.model, number
        self.camera = pipeline.datamanager.eval_dataset.cameras[number : number + 1]
        rays = without_undefined_ray(self.camera).generate_rays(camera_indices=0, keep_shape=True)
        self.height, self.width = rays.shape
        self.rays: RayBundle = rays.flatten()
        self.rgb, self.depth = torch.empty(len(self.rays), 3), torch.empty(len(self.rays), 1)

    def render(self, chosen: Tensor, edges: Tensor | None = None) -> Rendered:
        """Render chosen rays as today, or with samples between given edges, [chosen, samples + 1]."""
        model, parts, seen = self.model, [], []
        if not chosen.any():
            nothing = torch.zeros(0, 1)
            return Rendered(nothing.expand(0, 3), nothing, nothing, nothing)

        def look(weights: list[Tensor], samples: list[Any]) -> dict[str, Tensor]:
            seen.append((samples[-1].frustums, weights[-1][..., 0]))
            return depths(weights, samples)

        rays, size = self.rays[chosen], model.config.eval_num_rays_per_chunk
        depths, propose = model._depths, model.proposal_sampler.forward
        model._depths = look
        try:
            for first in range(0, len(rays), size):
                if edges is not None:
                    given = edges[first : first + size, :, None]
                    samples = samples_along(rays[first : first + size], given[:, :-1], given[:, 1:])
                    model.proposal_sampler.forward = lambda *_, samples=samples, **__: (samples, [], [])
                parts.append(model(rays[first : first + size]))
        finally:
            model._depths, model.proposal_sampler.forward = depths, propose
        rgb, depth = (torch.cat([each[name] for each in parts]) for name in ("rgb", "depth"))
        self.rgb[chosen], self.depth[chosen] = rgb, depth
        ends = torch.cat([torch.cat([each.starts[..., 0], each.ends[:, -1:, 0]], dim=1) for each, _ in seen])
        return Rendered(rgb, depth, ends, torch.cat([weights for _, weights in seen]))

    def as_today(self) -> float:
        """Render all rays as today; none knows its surface."""
        self.render(torch.ones(len(self.rays), dtype=torch.bool))
        return 0.0

    def from_neighbours(self, samples: int) -> float:
        """Render rays by those around them; the share of rays that know their surface."""
        height, width = self.height, self.width
        first = torch.zeros(height, width, dtype=torch.bool)
        first[::2, ::2] = True
        found = self.render(first.flatten())
        nearness = 1 / found.depth.view(len(range(0, height, 2)), -1).clamp(min=1e-6)
        rows, columns = torch.arange(height), torch.arange(width)
        above, left = rows // 2, columns // 2
        below, right = ((each + 1).div(2, rounding_mode="floor") for each in (rows, columns))
        below, right = below.clamp(max=len(nearness) - 1), right.clamp(max=nearness.shape[1] - 1)
        around = torch.stack([nearness[row][:, column] for row in (above, below) for column in (left, right)])
        agree = around.amax(dim=0) / around.amin(dim=0) < NEIGHBOURS_AGREE
        known = (agree & ~first).flatten()
        # a plane's nearness is linear in the picture, nearly
        moved = (around[0] / around.mean(dim=0)).flatten()[known]
        neighbour = (above[:, None] * nearness.shape[1] + left).flatten()[known]
        wanted = ((torch.arange(samples + 1) + 0.5) / (samples + 1)).expand(len(neighbour), -1)
        weights = found.weights[neighbour].contiguous()
        kernels = along_rays(weights)
        assert kernels is not None
        placed = kernels.place_samples(weights, found.edges[neighbour].contiguous(), wanted, 0.01, 1e-5)
        self.render(known, placed * moved[:, None])
        self.render(~(agree | first).flatten())
        return float(known.float().mean())

    def from_pictures(self, places: Places, sigma: float, samples: int) -> float:
        """Render rays by what training pictures render; the share of rays that know their surface."""
        distance, known = self._projected(places)
        distance = distance[known][:, None]
        near = torch.full_like(distance, self.model.config.near_m / self.model.metres_per_unit)
        # one before the surface and one behind it, so that what is in front is seen, and what lies further away, too
        around = torch.linspace(1 - AROUND * sigma, 1 + AROUND * sigma, samples - 1) * distance
        self.render(known, torch.cat([near, around, 2 * distance], dim=1))
        self.render(~known)
        return float(known.float().mean())

    def _projected(self, places: Places) -> tuple[Tensor, Tensor]:
        """The distance that training pictures give each pixel, and where two of them agree."""
        pose, pixels = self.camera.camera_to_worlds[0], len(self.rays)
        lens = self.pipeline.datamanager.eval_dataset.camera(self.number)
        nearest = (places.poses[:, :, 3] - pose[:, 3]).norm(dim=-1).argsort()[:PICTURES].tolist()
        place, _, distance = seen_from(lens, pose, torch.cat([places.of_pictures[number] for number in nearest]))
        inside = (place.abs() < 1).all(dim=-1)
        column, row = ((place[inside] + 1) / 2 * place.new_tensor([self.width, self.height])).long().unbind(dim=-1)
        at, distance = row * self.width + column, distance[inside]
        front = torch.full((pixels,), torch.inf).scatter_reduce(0, at, distance, "amin")
        close = distance < front[at] * (1 + PICTURES_AGREE)
        at, distance = at[close], distance[close]
        count = torch.zeros(pixels).index_add_(0, at, torch.ones_like(distance))
        mean = torch.zeros(pixels).index_add_(0, at, distance) / count.clamp(min=1)
        # beside an outline the nearer surface may be missed
        front = torch.where(count > 0, front, 1e9).view(1, 1, self.height, self.width)
        beside = -F.max_pool2d(-front, 3, stride=1, padding=1).flatten()
        return mean, (count >= 2) & (beside > mean * (1 - 4 * PICTURES_AGREE))


class Places:
    """The places that the training pictures of a pipeline render."""

    def __init__(self, pipeline: Any) -> None:
        self.model, self.dataset = pipeline.model, pipeline.datamanager.train_dataset
        self.poses = pipeline.detail._poses()

    @cached_property
    def of_pictures(self) -> list[Tensor]:
        """Of each training picture, [points, 3]."""
        found = []
        for number in range(len(self.dataset)):
            camera = self.dataset.cameras[number : number + 1]
            camera.camera_to_worlds = self.poses[number : number + 1]
            depth = self.model.rendered_alone(camera)["depth"]
            rays = without_undefined_ray(camera).generate_rays(camera_indices=0, keep_shape=True)
            found.append((rays.origins + rays.directions * depth)[torch.from_numpy(self.dataset.mask(number))])
        return found


@contextmanager
def sampled(model: Any, proposals: tuple[int, ...], final: int) -> Iterator[None]:
    """Render with other numbers of samples."""
    sampler = model.proposal_sampler
    before = sampler.num_proposal_samples_per_ray, sampler.num_nerf_samples_per_ray
    sampler.num_proposal_samples_per_ray, sampler.num_nerf_samples_per_ray = proposals, final
    try:
        yield
    finally:
        sampler.num_proposal_samples_per_ray, sampler.num_nerf_samples_per_ray = before


def judged(pipeline: Any, way: Callable[[View], float]) -> dict[str, float]:
    """Seconds a view, share of rays that know their surface, PSNR and AbsRel of the held-out views."""
    model, dataset = pipeline.model, pipeline.datamanager.eval_dataset
    psnr, shares, seconds, errors = [], [], [], DepthErrors()
    for number in range(len(dataset)):
        item, view, took = dataset[number], View(pipeline, number), []
        for _ in range(ROUNDS):
            start = time.perf_counter()
            share = way(view)
            took.append(time.perf_counter() - start)
        mask, size = item["mask"][..., 0], (view.height, view.width)
        psnr.append(float(masked_psnr(view.rgb.view(*size, 3).clamp(0, 1), item["truth_rgb"][..., :3], mask)))
        errors.update(view.depth.view(size) * model.metres_per_unit, item["truth_distance_m"][..., 0], mask)
        shares.append(share)
        seconds.append(statistics.median(took))
    figures = {"psnr": psnr, "share": shares, "seconds": seconds}
    return {**{name: float(np.mean(each)) for name, each in figures.items()}, "abs_rel": errors.compute("")["abs_rel"]}


def ways(pipeline: Any) -> Iterator[tuple[str, dict[str, float]]]:
    """Judge each way to render."""
    model, places = pipeline.model, Places(pipeline)
    proposals, final = tuple(model.config.num_proposal_samples_per_ray), model.config.num_nerf_samples_per_ray
    with evaluated(model), detail_shown(False):
        _ = places.of_pictures
        for counts, samples in ((proposals, final), (tuple(count // 2 for count in proposals), final), (proposals, 12)):
            with sampled(model, counts, samples):
                name = f"today's way, {' + '.join(map(str, counts))} + {samples} samples"
                yield name, judged(pipeline, View.as_today)
        for samples in (24, 16, 12, 8):
            way = partial(View.from_neighbours, samples=samples)
            yield f"from neighbours, {samples} samples", judged(pipeline, way)
        for sigma in (0.02, 0.04):
            for samples in (24, 8):
                way = partial(View.from_pictures, places=places, sigma=sigma, samples=samples)
                yield f"from training pictures, σ of {sigma:.0%}, {samples} samples", judged(pipeline, way)


def table(results: dict[str, Any]) -> str:
    """Of each way: share of rays, seconds, PSNR and AbsRel, as Markdown."""
    scenes: dict[str, dict[str, dict[str, float]]] = results["scenes"]

    def cell(found: dict[str, float]) -> str:
        seconds, psnr, errors = found["seconds"], found["psnr"], found["abs_rel"]
        return f"{found['share']:.0%}, {seconds:.2f} s, {psnr:.2f} dB, {errors:.4f}"

    rows = {name: [cell(of[name]) for of in scenes.values()] for name in next(iter(scenes.values()))}
    return ablate.table_of_scenes("rays that know, s a view, PSNR, AbsRel", scenes, rows)


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, partial(ablate.of_trained, ways))


if __name__ == "__main__":
    main()
