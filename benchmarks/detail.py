"""What training pictures could add to a new view: what they show beyond their own rendering, carried there by distance.

    python benchmarks/detail.py SCENE... [--methods nerfacto ds-nerf edge] [--steps 1000] [--json FILE] [--page FILE]

A trial, not a part of the package. After a training, each training picture is rendered, and what it shows beyond its
rendering is kept: its detail. A held-out view is rendered, too. Each of its pixels has a place in the scene, by its
rendered distance. This place is looked up in the eight training pictures next to the view. Where a picture's own
rendered distance agrees, it sees the place, and its detail counts; closer pictures and similar directions count more.
The mean of the details is added to the view. PSNR is against the noise-free picture inside the mask, mean over all
held-out views. λ and σ of the methods are their defaults in `compare`.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ablate
import numpy as np
import pages
import torch
import torch.nn.functional as F
from nerfstudio.cameras.cameras import Cameras, CameraType
from rich.console import Console
from torch import Tensor

from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.method.metrics import masked_psnr, masked_ssim

RESULTS = Path(__file__).with_name("detail.json")
PART = "detail"
PICTURES = 8
"""So many training pictures, the ones nearest to a view, are looked at."""
AGREEMENT = 0.03
"""Standard deviation of the ratio of two distances that agree."""
TURN = 0.2
"""Directions count exp((cos - 1) / TURN): 40° count a third."""
LEAST = 0.1
"""Added to the sum of the weights: where no picture counts, nothing is added."""


@dataclass(frozen=True)
class Seen:
    """A training picture after the training, H×W each."""

    detail: Tensor
    distance: Tensor
    """Scene units."""
    mask: Tensor


def rendered(model: Any, cameras: Cameras, number: int) -> tuple[Tensor, Tensor]:
    """Colours and median distances (scene units) of a view."""
    with torch.no_grad():
        outputs = model.get_outputs_for_camera(cameras[number : number + 1])
    return outputs["rgb"].clamp(0, 1), outputs["depth"][..., 0]


def details(pipeline: Any) -> list[Seen]:
    """What each training picture shows beyond its rendering, without its exposure."""
    model, dataset = pipeline.model, pipeline.datamanager.train_dataset
    log_gains = model.exposure.log_gains.detach()
    gains = (log_gains - log_gains.mean(dim=0)).exp()
    found = []
    for number in range(len(dataset)):
        rgb, distance = rendered(model, dataset.cameras, number)
        item = dataset[number]
        found.append(Seen(item["image"][..., :3] / gains[number] - rgb, distance, item["mask"][..., 0].float()))
    return found


def pixels_of(cameras: Cameras, number: int, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Column and row (the first pixel's centre is 0.5) and distance of points in a fisheye picture."""
    assert int(cameras.camera_type[number]) == CameraType.FISHEYE.value and cameras.distortion_params is not None
    pose, lens = cameras.camera_to_worlds[number], cameras.distortion_params[number]
    x, y, z = ((points - pose[:, 3]) @ pose[:, :3] * torch.tensor([1.0, -1, -1])).unbind(-1)
    radius = torch.hypot(x, y)
    theta = torch.atan2(radius, z)
    squared = theta.square()
    series = 1 + squared * (lens[0] + squared * (lens[1] + squared * (lens[2] + squared * lens[3])))
    scale = theta * series / radius.clamp(min=1e-9)
    column = cameras.fx[number, 0] * x * scale + cameras.cx[number, 0]
    row = cameras.fy[number, 0] * y * scale + cameras.cy[number, 0]
    return column, row, torch.sqrt(x.square() + y.square() + z.square())


def looked_up(values: Tensor, column: Tensor, row: Tensor, mode: str = "bilinear") -> Tensor:
    """Values of a picture, H×W×n, at places between its pixels."""
    height, width = values.shape[:2]
    at = torch.stack([2 * column / width - 1, 2 * row / height - 1], dim=-1)[None]
    return F.grid_sample(values.movedim(-1, 0)[None], at, mode=mode, align_corners=False)[0].movedim(0, -1)


def carried(cameras: Cameras, seen: list[Seen], view: Cameras, number: int, distance: Tensor) -> Tensor:
    """The detail of a view, H×W×3, from training pictures."""
    rays = view.generate_rays(camera_indices=number)
    points = rays.origins + rays.directions * distance[..., None]
    away = (cameras.camera_to_worlds[:, :, 3] - view.camera_to_worlds[number][:, 3]).norm(dim=-1)
    total, weights = torch.zeros_like(points), torch.zeros_like(distance)
    for picture in away.argsort()[:PICTURES].tolist():
        column, row, own_distance = pixels_of(cameras, picture, points)
        kept = seen[picture]
        inside = looked_up(kept.mask[..., None], column, row)[..., 0] > 0.999
        rendered_distance = looked_up(kept.distance[..., None], column, row, "nearest")[..., 0]
        agrees = torch.exp(-0.5 * ((rendered_distance / own_distance - 1) / AGREEMENT).square())
        to_points = F.normalize(points - cameras.camera_to_worlds[picture][:, 3], dim=-1)
        turned = torch.exp(((to_points * rays.directions).sum(-1) - 1) / TURN)
        weight = inside * agrees * turned * (distance / own_distance).clamp(max=1)
        total += weight[..., None] * looked_up(kept.detail, column, row)
        weights += weight
    return total / (weights + LEAST)[..., None]


def judged(pipeline: Any) -> dict[str, float]:
    """PSNR and SSIM of held-out views as they are rendered, and with the detail of training pictures."""
    model, manager = pipeline.model.eval(), pipeline.datamanager
    seen, dataset = details(pipeline), manager.eval_dataset
    figures: dict[str, list[float]] = {}
    for number in range(len(dataset)):
        rgb, distance = rendered(model, dataset.cameras, number)
        item = dataset[number]
        target, mask = item["truth_rgb"][..., :3], item["mask"][..., 0].bool()
        detail = carried(manager.train_dataset.cameras, seen, dataset.cameras, number, distance)
        for name, picture in (("rendered", rgb), ("with detail", (rgb + detail).clamp(0, 1))):
            figures.setdefault(f"{name}, PSNR", []).append(float(masked_psnr(picture, target, mask)))
            figures.setdefault(f"{name}, SSIM", []).append(float(masked_ssim(picture, target, mask)))
    return {name: float(np.mean(found)) for name, found in figures.items()}


def trained(scene: Path, overrides: Mapping[str, Any], steps: int) -> dict[str, float]:
    """Train a method, and judge it."""
    kept: list[Any] = []
    ablate.train(scene, {**overrides, **ablate.falling_over(steps)}, steps, 0, kept.append)
    return judged(kept[0])


def table(results: dict[str, Any]) -> str:
    """PSNR and SSIM of each, as Markdown."""
    scenes: dict[str, Any] = results["scenes"]
    lines = ["| PSNR, SSIM | " + " | ".join(scenes) + " |", "|---|" + "---|" * len(scenes)]
    for method in next(iter(scenes.values())):
        for name in ("rendered", "with detail"):
            cells = [
                f"{each[method][f'{name}, PSNR']:.2f}, {each[method][f'{name}, SSIM']:.3f}" for each in scenes.values()
            ]
            lines.append(f"| {METHODS[method].title}, {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--methods", nargs="+", default=["nerfacto", "ds-nerf", "edge"], choices=list(METHODS))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--json", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path)
    options = parser.parse_args()
    results = ablate.begun(options.json, options.steps)
    for scene in options.scenes:
        found = results["scenes"].setdefault(scene.resolve().name, {})
        for method in options.methods:
            if method not in found:
                found[method] = trained(scene, METHODS[method].overrides, options.steps)
                write_json(options.json, results)
    Console(width=200).print(table(results), markup=False)
    if options.page:
        text = options.page.read_text(encoding="utf-8")
        write_text(options.page, pages.with_part(text, PART, table(results)))


if __name__ == "__main__":
    main()
