"""What the detail of training pictures adds to views: unseen drives, equal seconds, and a real drive.

    python -m benchmarks.quality.detail --scenes scenes --output detail --jobs 2
    python -m benchmarks.quality.detail --page docs/results.md docs/real_drive.md

`--scenes` holds the rendered drives of docs/results.md and kitti360_half, the real drive at half size as
`real_drive.py` processes it. In folders of their own under `--output`, all with `compare --detail`:

    claims          nerfacto, the best rival with our prior and extras, and ours: 2,000 steps
    seconds         the best rival without extras, for as many steps as unseen.json.xz has of it
    real            nerfacto, the DS-NeRF loss on LiDAR and ours on the real drive: 1,000 steps
    real_seconds    there, the DS-NeRF loss for as many steps as real_drive_seconds.json.xz has of it

λ and σ are those of the kept searches. Each run is judged twice: as the model renders, and with detail. Stopped at any
moment, the same command goes on, and at its end it keeps all runs in detail.json.xz and detail_real.json.xz.
The second command puts tables of kept runs into pages.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Iterable
from pathlib import Path

from benchmarks.commands import TUNED, ours
from benchmarks.kept_runs import keep, results_of
from benchmarks.pages import with_part
from benchmarks.quality.unseen import DRIVES, GRIDS_STEPS, STEPS, figures_of, steps_of, write_kept
from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results

HERE = Path(__file__).parent
KEPT = {HERE / "detail.json.xz": ("claims", "seconds"), HERE / "detail_real.json.xz": ("real", "real_seconds")}
"""Which folders' runs are kept in which file."""
REAL = "kitti360_half"
REAL_STEPS = GRIDS_STEPS
CLAIMS: tuple[MethodName, ...] = ("nerfacto", "ds-nerf-integrated-extras", "edge")
OF_REAL: tuple[MethodName, ...] = ("nerfacto", "ds-nerf", "edge")
TRUE, RECORDED = "truth_masked_psnr", "masked_psnr"


def longer(kept: str, but: Iterable[int]) -> tuple[MethodName, int]:
    """The rival of a kept comparison at equal seconds, and its steps, which no other method has."""
    runs = [run for run in results_of(HERE / f"{kept}.json.xz").runs if run.content["steps"] not in but]
    assert len({(run.method, run.content["steps"]) for run in runs}) == 1
    return runs[0].method, runs[0].content["steps"]


def table(results: Results, name: str, methods: Iterable[tuple[MethodName, int]]) -> str:
    """PSNR without and with detail, drive by drive, as Markdown."""
    of_each = ([run for run in results.runs if (run.method, run.content["steps"]) == each] for each in methods)
    rows = [(METHODS[runs[0].method].title, runs) for runs in of_each if runs]
    scenes = sorted({run.scene for _, runs in rows for run in runs})
    shown = [*scenes, "average"] if len(scenes) > 1 else scenes
    lines = ["| method | " + " | ".join([*shown, "steps", "processor seconds"]) + " |", "|---" * (len(shown) + 3) + "|"]
    for title, runs in rows:
        seconds = f"{statistics.fmean(run.curve[-1]['cpu_seconds'] for run in runs):.0f}"
        for words, metric in (("", name), (", with detail", f"detail_{name}")):
            cells = [figures_of((run for run in runs if scene in (run.scene, "average")), metric) for scene in shown]
            lines.append("| " + " | ".join([title + words, *cells, steps_of(runs), seconds]) + " |")
    return "\n".join(lines)


def tables() -> dict[str, str]:
    """The pages' parts by their names, of the kept runs."""
    rendered: list[tuple[MethodName, int]] = [(method, STEPS) for method in CLAIMS]
    rendered.insert(1, longer("unseen", (STEPS, GRIDS_STEPS)))
    of_real: list[tuple[MethodName, int]] = [(method, REAL_STEPS) for method in OF_REAL]
    of_real.insert(2, longer("real_drive_seconds", (REAL_STEPS,)))
    on_rendered, on_real = (results_of(file) for file in KEPT)
    return {
        "detail: pictures": table(on_rendered, TRUE, rendered),
        "detail: beside": table(on_rendered, "shifted_1m_masked_psnr", rendered),
        "detail_real": table(on_real, RECORDED, of_real),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=Path("scenes"))
    parser.add_argument("--output", type=Path, default=Path("outputs/detail"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--page", type=Path, nargs="*", default=[], help="only put the tables of the kept runs there")
    options = parser.parse_args()
    if options.page:
        for page in options.page:
            text = page.read_text(encoding="utf-8")
            for name, part in tables().items():
                text = with_part(text, name, part)
            write_text(page, text)
        return
    out, scenes = options.output, [options.scenes / f"{kind}_{seed}" for kind, seed in DRIVES.items()]
    tuned = write_kept(out / "tuned.json")

    def compare(folder: str, where: list[Path], methods: Iterable[MethodName], steps: int, seed: int) -> None:
        settings = TUNED if where == real else tuned
        of_run = ("--steps", steps, "--seeds", seed, "--tuned", settings, "--jobs", options.jobs, "--detail")
        ours("compare", *where, "--methods", *methods, *of_run, "--output", out / folder)

    real = [options.scenes / REAL]
    rival, rivals_steps = longer("unseen", (STEPS, GRIDS_STEPS))
    of_real, of_reals_steps = longer("real_drive_seconds", (REAL_STEPS,))
    for seed in options.seeds:
        compare("claims", scenes, CLAIMS, STEPS, seed)
        compare("seconds", scenes, [rival], rivals_steps, seed)
        compare("real", real, OF_REAL, REAL_STEPS, seed)
        compare("real_seconds", real, [of_real], of_reals_steps, seed)
    for file, folders in KEPT.items():
        keep(file, *(out / folder for folder in folders))


if __name__ == "__main__":
    main()
