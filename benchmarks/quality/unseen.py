"""What a claim is about, on drives that took part in no choice: three seeds, equal seconds, the paper's tables.

    python -m benchmarks.quality.unseen --drives drives --scenes scenes --grid grid --output unseen

`--drives` and `--scenes` hold the drives of docs/results.md. The cells of the grid are trained in `--grid`, and say
which rivals are the best. λ and σ are those of the kept searches (`*_search.json.xz`). The spatial Gaussian has λ and σ
of ours, so that the kernel is the only difference. Then, in folders of their own under `--output`:

    claims       nerfacto, the best rival of the grid, the literal method and ours: 2,000 steps, three seeds
    seconds      the grid's best rival without extras, for as many steps as ours' processor seconds allow
    tables       Tables 3 and 4 of the paper, with ours and with the literal method, beside the grid, and UrbanNeRF's
                 line-of-sight form: 1,000 steps, one seed
    large        pictures of 700 px, 2,000 steps, one seed: nerfacto, DS-NeRF's loss, the literal method and ours on
                 the street (the last view of comparison_street_301_700.png is docs/unseen.jpg), nerfacto and ours on
                 all drives
    large_seconds    there, the best rival without extras, for as many steps as `seconds`

Writes table.md. To resume a stopped run, start the same command again.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.commands import ours
from benchmarks.kept_runs import results_of
from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.grid import BEST_OF_ALL, BEST_WITHOUT_EXTRAS, best_rivals
from edge_depth_nerf.compare.methods import GRID, METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.search import grids

DRIVES = {"street": 301, "parking": 302, "turn": 303, "roundabout": 304}
"""Kinds of drives and their seeds, which were chosen before any drive was made."""
DRIVE_TITLES = {"street": "street", "parking": "car park", "turn": "turn by 90°", "roundabout": "roundabout"}
SEQUENCE = "2013_05_28_drive_0000_sync"
LITERAL: tuple[MethodName, ...] = ("edge-paper-lidar", "edge-paper-mono", "edge-paper-gaussian")
"""The literal method with one thing changed; λ and σ are the literal method's."""
BESIDE_THE_GRID: tuple[MethodName, ...] = (
    "edge-paper",
    *LITERAL,
    "edge-mono",
    "edge-gaussian",
    "urban-nerf-los",
)
SETTINGS_OF: dict[MethodName, MethodName] = {"edge-gaussian": "edge", **dict.fromkeys(LITERAL, "edge-paper")}
"""Methods that have λ and σ of another one, so that one thing alone differs."""
LARGE_PX = 700
LARGE: tuple[MethodName, ...] = ("nerfacto", "ds-nerf", "edge-paper", "edge")
ON_ALL_LARGE: tuple[MethodName, ...] = ("nerfacto", "edge")
FOLDERS = ("claims", "seconds", "tables", "large", "large_seconds")
STEPS, GRIDS_STEPS = 2000, 1000
CELLS: tuple[MethodName, ...] = tuple(
    name for cell, name in GRID.items() if cell.loss != "urban-nerf-los" and name != "nerfacto-lidar-extras"
)
"""The cells of the grid on docs/results.md: LiDAR shows no sky, so without a loss it has little to give."""
KEPT_SEARCHES = [Path(__file__).with_name(f"{name}_search.json.xz") for name in ("grid", "unseen")]
REAL = [Path(__file__).with_name(f"{name}.json.xz") for name in ("real_drive", "real_drive_cells")]
"""Runs of the real drive: ours, and methods that differ from it in one part."""
USUAL: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "urban-nerf-los", "ds-nerf", "edge-paper", "edge")
"""Methods as usual: the depth losses of others on LiDAR alone, without extras."""
TITLES: dict[MethodName, str] = {
    "urban-nerf-los": "UrbanNeRF loss, authors' form",
    "urban-nerf-integrated": "UrbanNeRF loss on our prior",
    "ds-nerf-integrated-extras": "DS-NeRF loss on our prior, with our extras",
}
"""What the page calls methods that `METHODS` calls otherwise."""
PSNR, ABS_REL, BESIDE = "truth_masked_psnr", "truth_abs_rel", "shifted_1m_masked_psnr"
FIGURES = {
    "PSNR to clean": (PSNR, ".2f"),
    "AbsRel": (ABS_REL, ".3f"),
    "δ": ("truth_delta_1_25", ".3f"),
    "PSNR 1 m beside": (BESIDE, ".2f"),
}
"""Figures of the tables of methods, and how they are written."""


@dataclass(frozen=True)
class Part:
    """A part of ours, and methods that lack it alone."""

    title: str
    instead: str
    other: MethodName
    real: bool = True
    """Whether the real drive has runs of the other method."""
    literal: MethodName | None = None
    """The literal method with the same change."""


PARTS = (
    Part("prior of LiDAR and pictures", "LiDAR alone", "edge-lidar", literal="edge-paper-lidar"),
    Part("prior of LiDAR and pictures", "monocular maps alone", "edge-mono", real=False, literal="edge-paper-mono"),
    Part("edge-aware kernel", "spatial Gaussian", "edge-gaussian", real=False, literal="edge-paper-gaussian"),
    Part("edge loss", "DS-NeRF loss", "ds-nerf-integrated-extras"),
    Part("extras", "none", "edge-plain"),
)


def claimed(grid: Results) -> tuple[MethodName, ...]:
    """What the claims are about: the best rival is the grid's, with all that it can use."""
    return ("nerfacto", best_rivals(grid)[BEST_OF_ALL], "edge-paper", "edge")


def without_extras(grid: Results) -> MethodName:
    """The best rival of the grid without extras."""
    return best_rivals(grid)[BEST_WITHOUT_EXTRAS]


def write_kept(path: Path) -> Path:
    """Write λ and σ of all methods as the searches found them that the repository keeps."""
    best = {grid.method: grid.best for file in KEPT_SEARCHES for grid in grids(results_of(file))}
    best |= {name: best[other] for name, other in SETTINGS_OF.items()}
    write_json(path, {"methods": {name: {"lambda": each[0], "sigma_m": each[1]} for name, each in best.items()}})
    return path


def processor_seconds(results: Results, method: MethodName) -> float:
    """Mean over drives and seeds, of training alone."""
    return statistics.fmean(run.curve[-1]["cpu_seconds"] for run in results.runs if run.method == method)


def steps_in_our_seconds(grid: Results) -> int:
    """How many steps the best rival without extras does in ours' 2,000, by the grid's seconds, in fifties upwards."""
    ratio = processor_seconds(grid, "edge") / processor_seconds(grid, without_extras(grid))
    return 50 * math.ceil(STEPS * ratio / 50)


def of(runs: Results, methods: Iterable[MethodName], seeds: Iterable[int] | None = None) -> Results:
    """Some methods and seeds of the runs."""
    chosen, some = set(methods), None if seeds is None else set(seeds)
    return Results([run for run in runs.runs if run.method in chosen and (some is None or run.seed in some)])


def with_spread(values: Sequence[float], form: str) -> str:
    """Mean and standard deviation; the latter only if it is not 0 as written."""
    spread = f"{statistics.stdev(values):{form}}" if len(values) > 1 else "0"
    return f"{statistics.fmean(values):{form}}" + (f" ± {spread}" if float(spread) else "")


def figures_of(runs: Iterable[RunResult], name: str, form: str = ".2f") -> str:
    """Mean over drives, with its standard deviation over seeds where there are several."""
    runs = list(runs)
    seeds = sorted({run.seed for run in runs})
    return with_spread(
        [statistics.fmean(run.figures[name] for run in runs if run.seed == seed) for seed in seeds], form
    )


def title_of(method: MethodName) -> str:
    """What the page calls a method."""
    return TITLES.get(method, METHODS[method].title)


def row(*cells: str) -> str:
    """A row of a table, as Markdown."""
    return "| " + " | ".join(cells) + " |"


def methods_table(by_method: Mapping[MethodName, Results]) -> Iterator[str]:
    """Means over the drives, with their standard deviation over seeds, as Markdown."""
    yield row("method", *FIGURES, "processor seconds")
    yield "|---" * (len(FIGURES) + 2) + "|"
    for method, results in by_method.items():
        cells = [figures_of(of(results, [method]).runs, name, form) for name, form in FIGURES.values()]
        yield row(title_of(method), *cells, f"{processor_seconds(results, method):.0f}")


def lead(results: Results, other: MethodName, name: str = PSNR, others: Results | None = None, kind: str = "") -> float:
    """By how much a figure of ours is above another method's, over drives of a kind and seeds that both have."""
    mine, theirs = (
        {(run.scene, run.seed): run.figures[name] for run in of(each, [method]).runs if run.scene.startswith(kind)}
        for each, method in ((results, "edge"), (others or results, other))
    )
    return statistics.fmean(mine[key] - theirs[key] for key in mine.keys() & theirs.keys())


def drives_table(parts: Mapping[str, Results], grid: Results) -> Iterator[str]:
    """By how many dB ours is ahead, drive by drive, as Markdown."""
    best, rival = claimed(grid)[1], without_extras(grid)
    claims, seconds, large = parts["claims"], parts["seconds"], parts["large"]
    yield row(
        "drive",
        "nerfacto",
        "nerfacto, 1 m beside",
        f"{title_of(rival)}, equal time",
        title_of(best),
        f"nerfacto, {LARGE_PX} px",
    )
    yield "|---" * 6 + "|"
    for kind, title in {**DRIVE_TITLES, "": "mean"}.items():
        leads = [
            lead(claims, "nerfacto", kind=kind),
            lead(claims, "nerfacto", BESIDE, kind=kind),
            lead(claims, rival, others=seconds, kind=kind),
            lead(claims, best, kind=kind),
            lead(large, "nerfacto", kind=kind),
        ]
        yield row(title, *(f"{each:+.2f}" for each in leads))


def parts_table(one_seed: Results, real: Results) -> Iterator[str]:
    """What each part of ours is worth, all else equal, as Markdown.

    Args:
        one_seed: the grid, and what is trained beside it.
        real: the real drive.
    """

    def psnr(results: Results, method: MethodName, name: str) -> float:
        return statistics.fmean(run.figures[name] for run in of(results, [method], [0]).runs)

    def gain(results: Results, one: MethodName, other: MethodName, name: str = PSNR) -> str:
        return f"{psnr(results, one, name) - psnr(results, other, name):+.2f}"

    yield row("part", "instead of", "dB", "AbsRel ×", "real drive, dB", "as published, dB")
    yield "|---" * 6 + "|"
    for part in PARTS:
        ratio = psnr(one_seed, "edge", ABS_REL) / psnr(one_seed, part.other, ABS_REL)
        recorded = gain(real, "edge", part.other, "masked_psnr") if part.real else "–"
        literal = gain(one_seed, "edge-paper", part.literal) if part.literal else "–"
        yield row(part.title, part.instead, gain(one_seed, "edge", part.other), f"{ratio:.2f}", recorded, literal)


def page(parts: Mapping[str, Results], grid: Results, real: Results) -> str:
    """All tables as Markdown.

    Args:
        parts: by folder.
        grid: the runs of the grid.
        real: runs of the real drive.
    """
    claims = parts["claims"]
    nerfacto, best, literal, edge = claimed(grid)
    short = {nerfacto: claims, literal: claims, without_extras(grid): parts["seconds"], best: claims, edge: claims}
    one_seed = Results([*of(grid, METHODS, [0]).runs, *parts["tables"].runs])
    tables = {
        "Methods": methods_table(short),
        "Methods as usual": methods_table(dict.fromkeys(USUAL, one_seed)),
        "Drives": drives_table(parts, grid),
        "Parts": parts_table(one_seed, real),
    }
    lines = ["# Unseen drives", ""]
    for name, table in tables.items():
        lines += [f"## {name}", "", *table, ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, words in (
        ("drives", "the raw drives, such as street_301"),
        ("scenes", "its scenes"),
        ("grid", "where its cells are trained"),
    ):
        parser.add_argument(f"--{name}", type=Path, required=True, help=words)
    parser.add_argument("--output", type=Path, default=Path("outputs/unseen"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    options = parser.parse_args()
    out = options.output
    names = [f"{kind}_{seed}" for kind, seed in DRIVES.items()]
    scenes = [options.scenes / name for name in names]

    def compare(folder: Path, where: Iterable[Path], methods: Iterable[MethodName], steps: int, *seeds: int) -> None:
        of_run = ("--steps", steps, "--seeds", *(seeds or (0,)), "--tuned", tuned, "--jobs", options.jobs)
        ours("compare", *where, "--methods", *methods, *of_run, "--output", folder)

    tuned = write_kept(out / "tuned.json")
    compare(options.grid / "comparison", scenes, CELLS, GRIDS_STEPS)
    grid = read_results(options.grid / "comparison" / RUNS)

    compare(out / "claims", scenes, claimed(grid), STEPS, options.seeds[0])
    compare(out / "seconds", scenes, [without_extras(grid)], steps_in_our_seconds(grid), options.seeds[0])
    compare(out / "tables", scenes, BESIDE_THE_GRID, GRIDS_STEPS)
    for seed in options.seeds[1:]:
        # a seed is whole before the next begins: a stopped benchmark has a table of those it has
        compare(out / "claims", scenes, claimed(grid), STEPS, seed)
        compare(out / "seconds", scenes, [without_extras(grid)], steps_in_our_seconds(grid), seed)
    process = ("process", "kitti360", "--sequence", SEQUENCE)
    large = [out / f"{name}_{LARGE_PX}" for name in names]
    for (kind, seed), scene in zip(DRIVES.items(), large, strict=True):
        raw = out / f"drive_{kind}_{LARGE_PX}"
        ours("synthesize", "--output", raw, "--scene", kind, "--seed", seed, "--frames", 24, "--size", LARGE_PX)
        ours(*process, "--root", raw, "--output", scene)
    compare(out / "large", large[:1], LARGE, STEPS)
    compare(out / "large_seconds", large, [without_extras(grid)], steps_in_our_seconds(grid))
    compare(out / "large", large, ON_ALL_LARGE, STEPS)
    parts = {folder: read_results(out / folder / RUNS) for folder in FOLDERS}
    write_text(out / "table.md", page(parts, grid, Results([run for file in REAL for run in results_of(file).runs])))


if __name__ == "__main__":
    main()
