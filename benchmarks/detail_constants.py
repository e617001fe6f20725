"""How much the detail of training pictures depends on its constants: a Markdown table.

    python benchmarks/detail_constants.py SCENE... --steps 1000 [--json FILE] [--page FILE]

Trains ours on each scene and renders its held-out views once. Then it adds the detail of training pictures with each
constant changed, one at a time. PSNR is against the noise-free picture where it is known, inside the mask, mean over
the views. Use drives that no results table is made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import ablate
import numpy as np

from edge_depth_nerf.compare.judging import evaluated
from edge_depth_nerf.method import detail as formulas
from edge_depth_nerf.method.metrics import masked_psnr
from edge_depth_nerf.plugin import detail as host
from edge_depth_nerf.plugin.detail import detail_shown

RESULTS = Path(__file__).with_name("detail_constants.json")
PART = "detail constants"
CONSTANTS: dict[str, tuple[Any, str, tuple[float, ...]]] = {
    "PICTURES": (host, "pictures", (3, 5, 12, 16)),
    "AGREEMENT": (formulas, "distances agree within", (0.01, 0.02, 0.05, 0.1)),
    "TURN": (formulas, "directions", (0.05, 0.1, 0.4, 0.8)),
    "LEAST": (formulas, "added to the weights", (0.01, 0.03, 0.3, 1.0)),
}
"""Where each stands, what the table calls it, and what it is changed to."""


@contextmanager
def changed(name: str, value: float) -> Iterator[None]:
    """Set a constant for a while."""
    module = CONSTANTS[name][0]
    before = getattr(module, name)
    setattr(module, name, value)
    try:
        yield
    finally:
        setattr(module, name, before)


def found_with(pipeline: Any) -> dict[str, float]:
    """PSNR of the held-out views without detail, with it, and with each constant changed."""
    model, dataset = pipeline.model, pipeline.datamanager.eval_dataset
    with evaluated(model):
        views = []
        for number in range(len(dataset)):
            camera, item = dataset.cameras[number : number + 1], dataset[number]
            with detail_shown(False):
                outputs = model.get_outputs_for_camera(camera)
            rays = camera.generate_rays(camera_indices=0, keep_shape=True)
            target = item.get("truth_rgb", item["image"])[..., :3]
            views.append((rays, outputs["rgb"], outputs["depth"], target, item["mask"][..., 0]))

        def psnr(with_detail: bool = True) -> float:
            figures = []
            for rays, rgb, depth, target, mask in views:
                picture = rgb + pipeline.detail.of_view(rays, depth) if with_detail else rgb
                figures.append(float(masked_psnr(picture.clamp(0, 1), target, mask)))
            return float(np.mean(figures))

        figures = {"without detail": psnr(False), "with detail": psnr()}
        for name, (_, words, values) in CONSTANTS.items():
            for value in values:
                with changed(name, value):
                    figures[f"{words}: {value:g}"] = psnr()
    return figures


def table(results: dict[str, Any]) -> str:
    """PSNR of each, as Markdown; of changed constants, what they gain."""
    scenes: dict[str, dict[str, float]] = results["scenes"]
    rows = {}
    for name in next(iter(scenes.values())):
        plain = name in ("without detail", "with detail")
        rows[name] = [
            f"{each[name]:.2f}" if plain else f"{round(each[name] - each['with detail'], 2) + 0.0:+.2f}"
            for each in scenes.values()
        ]
    return ablate.table_of_scenes("PSNR, dB", scenes, rows)


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, partial(ablate.of_trained, found_with))


if __name__ == "__main__":
    main()
