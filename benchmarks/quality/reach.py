"""What distances from motion are worth: our method with them and without, on drives of four kinds.

    python -m benchmarks.quality.reach --output outputs/reach

Each drive is rendered, processed with and without `--no-motion`, and trained alike, with lambda and sigma of
tuned.json. The table has figures of held-out pictures, and of views 1 m beside the path. Nothing was chosen on these
drives: their seeds (`DRIVES`) were written down before anything was run. Writes table.md and table.json. A stopped run
resumes with the same command.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

from benchmarks.commands import TUNED, ours
from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.results import Results, read_results
from edge_depth_nerf.synthetic.options import SynthesizeOptions

DRIVES = {"street": 201, "parking": 202, "turn": 203, "roundabout": 204}
"""Kinds of drives and their seeds."""
SCENES = {"without": ("--no-motion",), "motion": ()}
"""Scenes of a drive, and the options that they are processed with."""
COLUMNS = {
    "PSNR to clean": ("truth_masked_psnr", ".2f"),
    "AbsRel": ("truth_abs_rel", ".3f"),
    "PSNR 1 m beside": ("shifted_1m_masked_psnr", ".2f"),
}
"""Figures of a trained model, and how they are written."""


def make_scenes(kind: str, seed: int, options: argparse.Namespace) -> list[Path]:
    """Render a drive, and process it without and with motion."""
    drive = options.output / "drives" / f"{kind}_{seed}"
    ours(
        *("synthesize", "--output", drive, "--scene", kind, "--seed", seed),
        *("--frames", options.frames, "--size", options.size),
    )
    raw = ("--root", drive, "--sequence", SynthesizeOptions(drive).sequence)
    scenes = [options.output / "scenes" / f"{kind}_{seed}_{name}" for name in SCENES]
    for scene, more in zip(scenes, SCENES.values(), strict=True):
        ours("process", "kitti360", *raw, "--output", scene, *more)
    return scenes


def table(results: Results, drives: Mapping[str, int]) -> Iterator[str]:
    """Figures without and with motion, drive by drive, as Markdown."""
    yield "| " + " | ".join(("drive", *COLUMNS)) + " |"
    yield "|---" * (1 + len(COLUMNS)) + "|"
    for kind, seed in drives.items():
        runs = [results.run(f"{kind}_{seed}_{name}", "edge", 0) for name in SCENES]
        cells = [
            " → ".join(f"{run.figures[metric]:{form}}" if run else "–" for run in runs)
            for metric, form in COLUMNS.values()
        ]
        yield "| " + " | ".join((kind, *cells)) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/reach"))
    parser.add_argument("--kinds", nargs="+", choices=DRIVES, default=list(DRIVES))
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", type=int, default=256, help="of the pictures, in pixels")
    parser.add_argument("--steps", type=int, default=1000, help="of each training")
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    compared = options.output / "compared"
    where = ("--output", compared, "--jobs", options.jobs, "--steps", options.steps)
    common = ("--methods", "edge", "--tuned", TUNED, *where)
    done: dict[str, int] = {}
    for kind in options.kinds:
        ours("compare", *make_scenes(kind, DRIVES[kind], options), *common)
        # a drive is whole before the next begins: a stopped benchmark has a table of those it has
        done[kind] = DRIVES[kind]
        results = read_results(compared / RUNS)
        write_text(options.output / "table.md", "\n".join((*table(results, done), "")))
        write_json(options.output / "table.json", results.rows())


if __name__ == "__main__":
    main()
