"""The figures of all runs of comparisons in one small file, which tables are made of.

    python -m benchmarks.kept_runs grid.json.xz grid/comparison

writes one of a folder of `edge-depth-nerf compare`.
"""

from __future__ import annotations

import argparse
import json
import lzma
from pathlib import Path

from edge_depth_nerf.base.files import read_json_object, write_bytes
from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.specification import FIGURES, OF_A_RUN


def keep(file: Path, *comparisons: Path) -> int:
    """Gather the figures of all finished runs; the scenes' folders are left out, their names stay.

    Returns:
        How many.
    """
    runs = {}
    for comparison in comparisons:
        for path in sorted(comparison.glob(f"{RUNS}/*/*/{FIGURES}")):
            figures = read_json_object(path)
            figures["run"]["scene"] = Path(figures["run"]["scene"]).name
            # paths of this machine are among them
            for name in OF_A_RUN:
                figures["configuration"].pop(name, None)
            key = path.parent.relative_to(comparison / RUNS).as_posix()
            runs[key if len(comparisons) == 1 else f"{comparison.name}/{key}"] = figures
    text = json.dumps({"runs": runs}, separators=(",", ":"))
    write_bytes(file, lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))
    return len(runs)


def results_of(file: Path) -> Results:
    """The runs that `keep` gathered, to make tables of."""
    runs = json.loads(lzma.decompress(file.read_bytes()))["runs"]
    return Results([RunResult(Path(name), figures["run"], figures) for name, figures in runs.items()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("comparisons", type=Path, nargs="+")
    options = parser.parse_args()
    print(f"{keep(options.file, *options.comparisons)} runs, {options.file.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
