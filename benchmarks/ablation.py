"""What each part of the loss is worth: every variant on every drive, and the table of docs/ablation.md.

    python benchmarks/ablation.py SCENE [SCENE ...] [--steps 1000] [--seed 0] [--only WORD ...] \
        [--json FILE] [--page docs/ablation.md]

Each variant differs from edge-depth-nerf-lite, as it was before this decided about it, in what its row says. All start
from the same seed and are judged on the same random pixels of every held-out view, as `ablate.py` does. `--json` keeps
each training's figures, and takes up from there; two processes with different `--only` or scenes and files of their own
can work side by side, and a last one with all files given to `--json` writes the page.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ablate import train
from pages import with_part
from rich.console import Console
from tried import guided_samples, line_of_sight

from edge_depth_nerf.base.files import read_json, write_json, write_text

MODEL, DATA = "pipeline.model.", "pipeline.datamanager."


@dataclass(frozen=True)
class Variant:
    """A row."""

    title: str
    overrides: dict[str, Any] = field(default_factory=dict)
    change: Callable[[Any], None] | None = None
    """What is done to the pipeline before it is trained."""


DEFAULTS = "as it was"
BASE = {DATA + "surface_rays_per_batch": 4096}
"""In what every row differs from edge-depth-nerf-lite: its options before this table decided about them."""
STUDY: dict[str, tuple[Variant, ...]] = {
    "": (
        Variant(DEFAULTS),
        Variant("no depth loss, sky or surface: nerfacto", {MODEL + "depth_loss": "none"}),
    ),
    "λ, 0.01 falling to a hundredth": (
        *(Variant(f"{value:g}", {MODEL + "depth_loss_mult": value}) for value in (0.003, 0.03, 0.1)),
        Variant("falling to a tenth", {MODEL + "depth_loss_final": 0.1}),
        Variant("not falling", {MODEL + "depth_loss_final": 1.0}),
    ),
    "Eq. 4, the Gaussian's mass over the sample, divided by its norm, on all levels": (
        Variant("its value at the sample's middle", {MODEL + "edge_gaussian": "point"}),
        Variant("not divided by its norm", {MODEL + "edge_divide_by_norm": False}),
        Variant("on the last level alone", {MODEL + "depth_loss_levels": "final"}),
        Variant("line of sight punished too, 0.01", change=partial(line_of_sight, mult=0.01)),
        Variant("half of the last samples placed by the prior", change=partial(guided_samples, share=0.5)),
    ),
    "σ̂, measured at returns left out": (
        *(
            Variant(f"{value:g} m", {DATA + "sigma_mode": "constant", DATA + "sigma_constant": value})
            for value in (0.05, 0.1, 0.2, 1.0)
        ),
        Variant("one of a frame (the paper)", {DATA + "sigma_mode": "image"}),
        Variant("the spread of what was integrated", {DATA + "sigma_mode": "spread"}),
        Variant("the spread, a floor and a share", {DATA + "sigma_mode": "combined"}),
    ),
    "Pixels, with and without a prior alike": (
        Variant("those with a prior twice as often", {DATA + "prior_weight": 2.0}),
    ),
    "The sky, a loss of 0.01 and a colour at infinity": (
        Variant("no loss", {MODEL + "sky_loss_mult": 0.0}),
        Variant("loss 0.1", {MODEL + "sky_loss_mult": 0.1}),
        Variant("no colour at infinity", {MODEL + "sky_background": False}),
    ),
    "The surface, 4,096 pixels": (
        Variant("none", {MODEL + "surface_loss_mult": 0.0, DATA + "surface_rays_per_batch": 0}),
        *(Variant(f"{count:,}", {DATA + "surface_rays_per_batch": count}) for count in (1024, 16384, 32768)),
    ),
    "The exposure, a gain": (Variant("nerfacto's embedding", {MODEL + "exposure": "embedding"}),),
    "The scene": (
        Variant("no distortion loss", {MODEL + "distortion_loss_mult": 0.0}),
        Variant("near plane 0.05 m", {MODEL + "near_m": 0.05}),
        *(
            Variant(f"a unit of {value:g} m in place of 10 to 16", {DATA + "dataparser.metres_per_unit": value})
            for value in (5.0, 20.0)
        ),
        Variant("poses refined", {MODEL + "camera_optimizer.mode": "SO3xR3"}),
    ),
}


def key_of(scene: str, options: argparse.Namespace, group: str, variant: Variant) -> str:
    return f"{scene}, {options.steps} steps, seed {options.seed}: {group or 'whole'}: {variant.title}"


def table(done: dict[str, dict[str, float]], options: argparse.Namespace) -> list[str]:
    """Rows of Markdown: of each variant PSNR by drive and mean, how far that is from the defaults, and depth errors."""
    names = [scene.resolve().name for scene in options.scenes]

    def found(group: str, variant: Variant) -> list[dict[str, float]]:
        keys = [key_of(name, options, group, variant) for name in names]
        return [done[key] for key in keys if key in done]

    whole = found("", STUDY[""][0])
    base = np.mean([each["truth_psnr"] for each in whole])
    lines = [
        f"| | {' | '.join(names)} | mean PSNR | against “{DEFAULTS}” | AbsRel | δ < 1.25 |",
        "|---|" + "---|" * (len(names) + 4),
    ]
    for group, members in STUDY.items():
        rows = [(variant, each) for variant in members if len(each := found(group, variant)) == len(names)]
        if group and rows:
            lines.append(f"| **{group}** |" + " |" * (len(names) + 4))
        for variant, each in rows:
            psnr = [one["truth_psnr"] for one in each]
            lines.append(
                f"| {variant.title} | {' | '.join(f'{value:.2f}' for value in psnr)} | {np.mean(psnr):.2f} | "
                f"{np.mean(psnr) - base:+.2f} | {np.mean([one['truth_abs_rel'] for one in each]):.3f} | "
                f"{np.mean([one['truth_delta_1_25'] for one in each]):.3f} |"
            )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", nargs="*", help="variants whose title or group has one of these words; none: page only"
    )
    parser.add_argument("--json", type=Path, nargs="+", default=[], help="read all; new figures go to the first")
    parser.add_argument("--page", type=Path, help="put the table between this page's marks")
    options = parser.parse_args()
    console = Console(width=200)
    own: dict[str, dict[str, float]] = read_json(options.json[0]) if options.json and options.json[0].is_file() else {}
    done = {key: value for path in options.json[1:] if path.is_file() for key, value in read_json(path).items()} | own
    for group, members in STUDY.items():
        for variant in members:
            chosen = options.only is None or any(word in f"{group} {variant.title}" for word in options.only)
            for scene in options.scenes if chosen else ():
                key = key_of(scene.resolve().name, options, group, variant)
                if key not in done:
                    # no trainer tells the model how many
                    overrides = {MODEL + "depth_loss_steps": options.steps, **BASE, **variant.overrides}
                    own[key] = done[key] = train(scene, overrides, options.steps, options.seed, variant.change)
                    if options.json:
                        write_json(options.json[0], own)
                    console.print(key, {name: round(value, 4) for name, value in done[key].items()})
    rows = "\n".join(table(done, options))
    console.print(rows)
    if options.page:
        write_text(options.page, with_part(options.page.read_text(encoding="utf-8"), "ablation", rows))


if __name__ == "__main__":
    main()
