"""What a claim is about, on drives that took no part in any choice: three seeds, equal seconds, the paper's tables.

    python -m benchmarks.quality.unseen --drives drives --scenes scenes --grid grid --output unseen

`--drives` and `--scenes` hold the drives of docs/results.md. The cells of the grid are trained in `--grid`, and say
which rivals are the best. λ and σ are those of the kept searches (`*_search.json.xz`). The spatial Gaussian has λ and σ
of ours, so that the kernel is the only difference. Then, in folders of their own under `--output`:

    claims       nerfacto, the best rival of the grid, the literal method and ours: 2,000 steps, three seeds
    seconds      the grid's best rival without extras, for as many steps as ours' processor seconds allow
    tables       Tables 3 and 4 of the paper, with ours and with the literal method, beside the grid, and UrbanNeRF's
                 line-of-sight form beside nerfstudio's: 1,000 steps, one seed
    simulated    the claims with simulated monocular maps in place of the drive's own network
    large        pictures of 700 px, 2,000 steps, one seed: nerfacto, DS-NeRF's loss, the literal method and ours on
                 the street (the last view of comparison_street_301_700.png is docs/unseen.jpg), nerfacto and ours on
                 all drives
    large_seconds    there, the best rival without extras, for as many steps as `seconds`

Writes table.md. Stopped at any moment, the same command goes on.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterable, Iterator
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
from edge_depth_nerf.compare.tables import make_tables
from edge_depth_nerf.report.tables import page_of_tables

DRIVES = {"street": 301, "parking": 302, "turn": 303, "roundabout": 304}
"""Kinds of drives and their seeds; written down before any was made. 101 to 104 showed a fault that is corrected."""
SEQUENCE = "2013_05_28_drive_0000_sync"
LITERAL: tuple[MethodName, ...] = ("edge-paper-lidar", "edge-paper-mono", "edge-paper-gaussian")
"""The literal method with one thing changed; λ and σ are the literal method's."""
BESIDE_THE_GRID: tuple[MethodName, ...] = (
    "edge-paper",
    *LITERAL,
    "edge-mono",
    "edge-gaussian",
    "urban-nerf-los-integrated",
    "urban-nerf-los",
    # of the grid, too; trained beside the other form
    "urban-nerf-integrated",
    "urban-nerf",
)
SETTINGS_OF: dict[MethodName, MethodName] = {"edge-gaussian": "edge", **dict.fromkeys(LITERAL, "edge-paper")}
"""Methods that have λ and σ of another one, so that one thing alone differs."""
LARGE_PX = 700
LARGE: tuple[MethodName, ...] = ("nerfacto", "ds-nerf", "edge-paper", "edge")
ON_ALL_LARGE: tuple[MethodName, ...] = ("nerfacto", "edge")
FOLDERS = ("claims", "seconds", "tables", "simulated", "large", "large_seconds")
STEPS, GRIDS_STEPS = 2000, 1000
CELLS: tuple[MethodName, ...] = tuple(
    name for cell, name in GRID.items() if cell.loss != "urban-nerf-los" and name != "nerfacto-lidar-extras"
)
"""The cells of the grid on docs/results.md: LiDAR shows no sky, so without a loss it has little to give."""
KEPT_SEARCHES = [Path(__file__).with_name(f"{name}_search.json.xz") for name in ("grid", "unseen")]
IN_SECONDS = {
    "PSNR": ("truth_masked_psnr", ".2f"),
    "SSIM": ("truth_masked_ssim", ".3f"),
    "AbsRel": ("truth_abs_rel", ".4f"),
    "δ": ("truth_delta_1_25", ".3f"),
}
"""Figures of the README's table and of those at equal seconds, and how they are written."""


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


def steps_of(runs: Iterable[RunResult]) -> str:
    """How many steps runs have, as a table says it."""
    return " to ".join(f"{each:,}" for each in sorted({run.content["steps"] for run in runs}))


def figures_of(runs: Iterable[RunResult], name: str, form: str = ".2f") -> str:
    """Mean over drives, with its standard deviation over seeds where there are several."""
    runs = list(runs)
    seeds = sorted({run.seed for run in runs})
    means = [statistics.fmean(run.figures[name] for run in runs if run.seed == seed) for seed in seeds]
    spread = f" ± {statistics.stdev(means):{form}}" if len(means) > 1 else ""
    return f"{statistics.fmean(means):{form}}{spread}"


def short_table(claims: Results) -> Iterator[str]:
    """Means over the drives, with their standard deviation over seeds, as Markdown: the README's table."""
    yield "| " + " | ".join(["method", *IN_SECONDS, "steps", "processor seconds"]) + " |"
    yield "|---" * (len(IN_SECONDS) + 3) + "|"
    for method in claims.methods():
        runs = of(claims, [method]).runs
        cells = [figures_of(runs, name, form) for name, form in IN_SECONDS.values()]
        seconds = f"{processor_seconds(claims, method):.0f}"
        yield "| " + " | ".join([METHODS[method].title, *cells, steps_of(runs), seconds]) + " |"


def seconds_table(claims: Results, longer: Results) -> Iterator[str]:
    """Ours and the rival after as many processor seconds, drive by drive, as Markdown."""
    rival = longer.methods()[0]
    both = {METHODS[rival].title: longer, METHODS["edge"].title: of(claims, ["edge"], longer.seeds())}
    yield "| | " + " | ".join(["drive", *IN_SECONDS, "steps", "processor seconds"]) + " |"
    yield "|---" * (len(IN_SECONDS) + 4) + "|"
    for scene in [*longer.scenes(), "average"]:
        for title, results in both.items():
            runs = [run for run in results.runs if scene in (run.scene, "average")]
            means = {name: statistics.fmean(run.figures[name] for run in runs) for name, _ in IN_SECONDS.values()}
            cells = [f"{means[name]:{form}}" for name, form in IN_SECONDS.values()]
            seconds = f"{statistics.fmean(run.curve[-1]['cpu_seconds'] for run in runs):.0f}"
            yield "| " + " | ".join([title, scene, *cells, steps_of(runs), seconds]) + " |"


def page(parts: dict[str, Results], grid: Results) -> str:
    """All tables as Markdown; a folder without runs has none.

    Args:
        parts: by folder.
        grid: the runs of the grid, for Tables 3 and 4.
    """
    lines = ["# Unseen drives", ""]

    def add(title: str, results: Results, *labels: str) -> None:
        made = [table for table in make_tables(results) if table.label in labels] if results.runs else []
        if made:
            # a heading for each, and the tables under it without theirs
            text = page_of_tables("", [], made).split("\n\n")
            kept = [part for part in text if not part.startswith("#")]
            lines.extend([f"## {title}", "", "\n\n".join(kept).strip(), ""])

    claims = parts["claims"]
    add("Claims: pictures", claims, "1")
    if claims.runs:
        lines += ["## Claims: short", "", *short_table(claims), ""]
    add("Claims: geometry", claims, "5, average")
    add("Claims: time", claims, "6, average")
    if claims.runs and parts["seconds"].runs:
        lines += ["## Equal seconds", "", *seconds_table(claims, parts["seconds"]), ""]
    beside = parts["tables"]
    one_seed = of(grid, ["edge", "edge-lidar", *BESIDE_THE_GRID], [0])
    add("Sources", Results([*one_seed.runs, *of(beside, ["edge-mono"]).runs]), "3")
    kernels = Results([*of(one_seed, ["edge"]).runs, *of(beside, ["edge-gaussian"]).runs])
    add("Kernels: pictures", kernels, "4")
    add("Kernels: geometry", kernels, "5, average")
    literal = of(beside, ["edge-paper", *LITERAL])
    add("As published, sources", literal, "3, as published")
    add("As published, kernels", literal, "4, as published")
    add("As published, geometry", literal, "5, average")
    forms = of(beside, [name for name in BESIDE_THE_GRID if name.startswith("urban-nerf")])
    add("Line of sight", forms, "5, average")
    add("Simulated maps: pictures", parts["simulated"], "1")
    add("Simulated maps: geometry", parts["simulated"], "5, average")
    large = parts["large"]
    add("700 px", large, *(f"5, {scene}" for scene in large.scenes() if scene.startswith("street")))
    add("All drives at 700 px", of(large, ON_ALL_LARGE), "1")
    if large.runs and parts["large_seconds"].runs:
        lines += ["## Equal seconds at 700 px", "", *seconds_table(large, parts["large_seconds"]), ""]
    used = [run for results in (claims, beside) for run in results.runs]
    if used:
        add("λ and σ", Results(used), "7")
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
    for name in names:
        raw = options.drives / name
        maps = ("--mono", raw / "simulated_mono" / SEQUENCE)
        ours(*process, "--root", raw, *maps, "--output", out / "simulated_scenes" / name)
    simulated = [out / "simulated_scenes" / name for name in names]
    for seed in options.seeds:
        compare(out / "simulated", simulated, claimed(grid), STEPS, seed)
    parts = {folder: read_results(out / folder / RUNS) for folder in FOLDERS}
    write_text(out / "table.md", page(parts, grid))


if __name__ == "__main__":
    main()
