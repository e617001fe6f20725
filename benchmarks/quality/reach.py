"""What a prior beyond LiDAR's field is worth: drives of four kinds, with distances from motion and without.

    python -m benchmarks.quality.reach --output outputs/reach

Each drive is rendered, and processed three times: by the default pipeline without motion (its own network), with it,
and with simulated monocular maps in place of the network's, which reach everywhere: the ceiling. The first table judges
the prior of the training pictures against the truth: what share of the pixels that are no sky has one, its AbsRel, and
how many errors are within one and two sigma, in LiDAR's field and outside it. The second compares nerfacto, DS-NeRF on
LiDAR, and ours with each of the three priors, all trained alike, with lambda and sigma of tuned.json: held-out pictures
and distances, and views 1 m beside the path. The last table says how far motion goes from the first prior to the
ceiling. Nothing was chosen on these drives: their seeds (`DRIVES`) were written down before anything was run, and no
other measurement uses a seed of 200 or more.

Writes table.md, table.json, and priors/, the first table's figures. What is there is not made again: stopped at any
moment, the same command goes on.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.commands import TUNED, ours
from benchmarks.quality.unseen import IN_SECONDS
from edge_depth_nerf.base.files import read_json, write_json, write_text
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.method.integration import INTEGRATED
from edge_depth_nerf.method.prior import PriorOptions, make_prior, ray_angles
from edge_depth_nerf.mono.calibration import find_calibration
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.synthetic.options import SynthesizeOptions

DRIVES = {"street": 201, "parking": 202, "turn": 203, "roundabout": 204}
"""Kinds of drives and their seeds."""
PRIORS = {"without": "without motion", "motion": "with motion", "everywhere": "a prior everywhere"}
"""Scenes of a drive, by what their prior is made of."""
RIVALS: dict[MethodName, str] = {"nerfacto": "nerfacto", "ds-nerf": "DS-NeRF on LiDAR"}
"""They use no monocular maps: trained on one of the scenes."""
PLACES = {"everywhere": "all", "in_field": "in the field", "outside": "outside it"}
COLUMNS = {**IN_SECONDS, "PSNR 1 m beside": ("shifted_1m_masked_psnr", ".2f")}
"""Figures of a trained model, and how they are written."""


@dataclass(frozen=True)
class PriorFigures:
    """How good a prior is on some pixels: shares of 0-1."""

    have_one: float
    abs_rel: float
    median: float
    within_1: float
    """Of the priors, how many have an error of one sigma at most."""
    within_2: float


Evaluated = Mapping[str, PriorFigures | None]
"""How good a prior is, by place."""


def prior_pixels(scene: SceneFolder, options: PriorOptions) -> NDArray[np.float64]:
    """Each used pixel of the training pictures: the true distance (0: sky), the prior's and its sigma (metres), and
    whether it lies outside LiDAR's field; 4×N.
    """
    calibration, rows = find_calibration(scene, options), []
    for picture in [picture for picture in scene.pictures if not picture.held_out]:
        maps, view_angles = scene.maps(picture), ray_angles(picture.lens, picture.up_in_camera)
        prior = make_prior(maps.distances_m, maps.usable, INTEGRATED, options, calibration, view_angles)
        outside = ~calibration.in_field(view_angles.elevation_rad)
        of_pixels = (maps.distances_m["truth_distance"], prior.distance_m, prior.sigma_m, outside)
        rows.append(np.stack([each[maps.usable] for each in of_pixels], -1))
    return np.concatenate(rows).T


def prior_figures(pixels: NDArray[np.float64]) -> PriorFigures | None:
    """Of those pixels that `prior_pixels` gives and that are no sky; None if none has a prior."""
    pixels = pixels[:, pixels[0] > 0]
    truth, distance, sigma, _ = pixels[:, pixels[1] > 0]
    if not len(truth):
        return None
    error = np.abs(distance - truth)
    within = [float((error <= times * sigma).mean()) for times in (1, 2)]
    relative = error / truth
    return PriorFigures(len(truth) / pixels.shape[1], float(relative.mean()), float(np.median(relative)), *within)


def make_scenes(kind: str, seed: int, options: argparse.Namespace) -> dict[str, Path]:
    """Render a drive and process it, by prior."""
    drive = options.output / "drives" / f"{kind}_{seed}"
    made = SynthesizeOptions(drive)
    ours(
        *("synthesize", "--output", drive, "--scene", kind, "--seed", seed),
        *("--frames", options.frames, "--size", options.size),
    )
    maps = drive / "simulated_mono" / made.sequence
    ways = {
        "without": ("--no-motion",),
        "motion": (),
        "everywhere": ("--no-motion", "--mono", maps),
    }
    scenes = {prior: options.output / "scenes" / f"{kind}_{seed}_{prior}" for prior in PRIORS}
    for prior, scene in scenes.items():
        ours("process", "kitti360", "--root", drive, "--sequence", made.sequence, "--output", scene, *ways[prior])
    return scenes


def evaluated(scene: Path, kept: Path) -> Evaluated:
    """How good a scene's default prior is; read from `kept` if it is there."""
    if not kept.is_file():
        pixels = prior_pixels(read_scene(scene), PriorOptions())
        parts = {"everywhere": pixels, **{name: pixels[:, pixels[3] == i] for i, name in enumerate(list(PLACES)[1:])}}
        found = {name: prior_figures(part) for name, part in parts.items()}
        write_json(kept, {name: figures and dataclasses.asdict(figures) for name, figures in found.items()})
    return {name: figures and PriorFigures(**figures) for name, figures in read_json(kept).items()}


def prior_table(priors: Mapping[str, Mapping[str, Evaluated]]) -> Iterator[str]:
    """All priors of all drives, as Markdown."""
    yield "| drive | prior | pixels | have one | AbsRel | median | within σ̂ | within 2 σ̂ |"
    yield "|---|---|---|---|---|---|---|---|"
    for drive, by_prior in priors.items():
        for prior, by_place in by_prior.items():
            for place, found in by_place.items():
                if found:
                    cells = (f"{found.have_one:.1%}", f"{found.abs_rel:.4f}", f"{found.median:.4f}")
                    within = (f"{found.within_1:.1%}", f"{found.within_2:.1%}")
                else:
                    cells, within = ("0 %", "–", "–"), ("–", "–")
                yield "| " + " | ".join((drive, PRIORS[prior], PLACES[place], *cells, *within)) + " |"


def rows_of(results: Results, drive: str) -> Iterator[tuple[str, RunResult]]:
    """The trained models of a drive, with their titles."""
    for method, title in RIVALS.items():
        if run := results.run(f"{drive}_without", method, 0):
            yield title, run
    for prior, title in PRIORS.items():
        if run := results.run(f"{drive}_{prior}", "edge", 0):
            yield f"ours, {title}", run


def model_table(results: Results, drives: Mapping[str, int]) -> Iterator[str]:
    """All models, as Markdown."""
    yield "| " + " | ".join(("drive", "method", *COLUMNS)) + " |"
    yield "|---" * (2 + len(COLUMNS)) + "|"
    for drive in (f"{kind}_{seed}" for kind, seed in drives.items()):
        for title, run in rows_of(results, drive):
            figures = run.figures
            cells = [f"{figures[metric]:{form}}" if metric in figures else "–" for metric, form in COLUMNS.values()]
            yield "| " + " | ".join((drive, title, *cells)) + " |"


def way_table(results: Results, drives: Mapping[str, int]) -> Iterator[str]:
    """How far motion goes from ours without it to the ceiling, as Markdown."""
    yield "| " + " | ".join(("drive", *COLUMNS)) + " |"
    yield "|---" * (1 + len(COLUMNS)) + "|"
    for kind, seed in drives.items():
        runs = {prior: results.run(f"{kind}_{seed}_{prior}", "edge", 0) for prior in PRIORS}
        cells = []
        for metric, form in COLUMNS.values():
            values = {prior: run.figures[metric] for prior, run in runs.items() if run and metric in run.figures}
            if len(values) < len(PRIORS):
                cells.append("–")
                continue
            gain, whole = values["motion"] - values["without"], values["everywhere"] - values["without"]
            share = f" ({gain / whole:.0%})" if whole else ""
            cells.append(f"{gain:+{form}} of {whole:+{form}}{share}")
        yield "| " + " | ".join((f"{kind}_{seed}", *cells)) + " |"


def page(results: Results, priors: Mapping[str, Mapping[str, Evaluated]], drives: Mapping[str, int]) -> str:
    """All tables, as Markdown."""
    lines = ["# What a prior beyond LiDAR's field is worth", "", "## The prior", "", *prior_table(priors)]
    lines += ["", "## The trained models", "", *model_table(results, drives)]
    lines += ["", "## From no motion to a prior everywhere", "", *way_table(results, drives), ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/reach"))
    parser.add_argument("--kinds", nargs="+", choices=DRIVES, default=list(DRIVES))
    parser.add_argument("--seeds", nargs="+", type=int, help="of the drives, one for each kind; those of DRIVES")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--size", type=int, default=350, help="of the pictures, in pixels")
    parser.add_argument("--steps", type=int, help="of each training; the preset's, if not set")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    seeds = options.seeds or [DRIVES[kind] for kind in options.kinds]
    if len(seeds) != len(options.kinds):
        sys.exit(f"--seeds {' '.join(map(str, seeds))}: expected one for each of {' '.join(options.kinds)}.")
    drives = dict(zip(options.kinds, seeds, strict=True))
    compared = options.output / "compared"
    steps = ("--steps", options.steps) if options.steps else ()
    common = ("--tuned", TUNED, "--output", compared, "--jobs", options.jobs, *steps)
    priors: dict[str, dict[str, Evaluated]] = {}
    for kind, seed in drives.items():
        scenes = make_scenes(kind, seed, options)
        name = f"{kind}_{seed}"
        priors[name] = {
            prior: evaluated(scene, options.output / "priors" / f"{scene.name}.json") for prior, scene in scenes.items()
        }
        ours("compare", scenes["without"], "--methods", *RIVALS, *common)
        ours("compare", *scenes.values(), "--methods", "edge", *common)
        # a drive is whole before the next begins: a stopped benchmark has a table of those it has
        done = {each: drives[each] for each in options.kinds[: len(priors)]}
        results = read_results(compared / RUNS)
        write_text(options.output / "table.md", page(results, priors, done))
        write_json(options.output / "table.json", results.rows())


if __name__ == "__main__":
    main()
