"""What the detail of training pictures adds to views: unseen drives, and a real drive.

    python -m benchmarks.quality.detail --scenes scenes --output detail --jobs 2
    python -m benchmarks.quality.detail --page docs/results.md

`--scenes` holds the rendered drives of docs/results.md and kitti360_half, the real drive at half size as
`real_drive.py` processes it. In folders of their own under `--output`, all with `compare --detail`:

    claims          nerfacto, the best rival with our prior and extras, and ours: 2,000 steps
    real            nerfacto, the DS-NeRF loss on LiDAR and ours on the real drive: 1,000 steps

λ and σ are those of the kept searches. Each run is evaluated twice: as the model renders, and with detail. To resume a
stopped run, start the same command again. At its end it keeps all runs in detail.json.xz and detail_real.json.xz.
The second command puts the table of kept runs into a page.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from benchmarks.commands import TUNED, ours
from benchmarks.kept_runs import keep, results_of
from benchmarks.pages import with_part
from benchmarks.quality.unseen import DRIVES, GRIDS_STEPS, STEPS, figures_of, of, row, title_of, write_kept
from edge_depth_nerf.base.files import write_text
from edge_depth_nerf.compare.options import MethodName

HERE = Path(__file__).parent
KEPT = {HERE / "detail.json.xz": ("claims",), HERE / "detail_real.json.xz": ("real",)}
"""Which folders' runs are kept in which file."""
REAL = "kitti360_half"
REAL_STEPS = GRIDS_STEPS
CLAIMS: tuple[MethodName, ...] = ("nerfacto", "ds-nerf-integrated-extras", "edge")
OF_REAL: tuple[MethodName, ...] = ("nerfacto", "ds-nerf", "edge")
TRUE, RECORDED = "truth_masked_psnr", "masked_psnr"
PART = "detail"
"""The page's part."""


def table() -> str:
    """PSNR without and with detail, means over the drives, as Markdown."""
    on_rendered, on_real = (results_of(file) for file in KEPT)
    lines = [row("method", "real", "real, with detail", "rendered", "rendered, with detail"), "|---" * 5 + "|"]
    for method in (CLAIMS[0], OF_REAL[1], *CLAIMS[1:]):
        cells = []
        for results, name in ((on_real, RECORDED), (on_rendered, TRUE)):
            runs = of(results, [method]).runs
            cells += [figures_of(runs, metric) if runs else "–" for metric in (name, f"detail_{name}")]
        lines.append(row(title_of(method), *cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=Path("scenes"))
    parser.add_argument("--output", type=Path, default=Path("outputs/detail"))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="trainings at a time")
    parser.add_argument("--page", type=Path, nargs="*", default=[], help="only put the table of the kept runs there")
    options = parser.parse_args()
    if options.page:
        for page in options.page:
            write_text(page, with_part(page.read_text(encoding="utf-8"), PART, table()))
        return
    out, scenes = options.output, [options.scenes / f"{kind}_{seed}" for kind, seed in DRIVES.items()]
    tuned = write_kept(out / "tuned.json")

    def compare(folder: str, where: list[Path], methods: Iterable[MethodName], steps: int, seed: int) -> None:
        settings = TUNED if where == real else tuned
        of_run = ("--steps", steps, "--seeds", seed, "--tuned", settings, "--jobs", options.jobs, "--detail")
        ours("compare", *where, "--methods", *methods, *of_run, "--output", out / folder)

    real = [options.scenes / REAL]
    for seed in options.seeds:
        compare("claims", scenes, CLAIMS, STEPS, seed)
        compare("real", real, OF_REAL, REAL_STEPS, seed)
    for file, folders in KEPT.items():
        keep(file, *(out / folder for folder in folders))


if __name__ == "__main__":
    main()
