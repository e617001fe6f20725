"""The figures of all runs of a comparison in one small file, and a comparison's folder made of it again.

    python benchmarks/kept_runs.py keep benchmarks/comparison.json.xz comparison
    python benchmarks/kept_runs.py lay benchmarks/comparison.json.xz comparison --scenes scenes

What was laid out is in the tables of the next `edge-depth-nerf compare … --output comparison`, which does not train it
again; pictures it has none. The scenes are to be the same: the SHA-256 of their transforms.json is checked.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import lzma
from pathlib import Path

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json_object, write_bytes, write_json
from edge_depth_nerf.compare.command import RECORD, RUNS
from edge_depth_nerf.compare.results import Results, RunResult
from edge_depth_nerf.compare.specification import FIGURES, OF_A_RUN, SPECIFICATION


def keep(file: Path, *comparisons: Path) -> int:
    """Gather the figures of all finished runs; the scenes' folders are left out, their names stay.

    What was gathered of several comparisons can make tables, but cannot be laid out.

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
    record_path = comparisons[0] / RECORD
    # benchmarks/equal_seconds.py leaves none
    of_one = len(comparisons) == 1 and record_path.exists()
    record = {**read_json_object(record_path), "commands": []} if of_one else None
    text = json.dumps({"record": record, "runs": runs}, separators=(",", ":"))
    write_bytes(file, lzma.compress(text.encode(), preset=9 | lzma.PRESET_EXTREME))
    return len(runs)


def results_of(file: Path) -> Results:
    """The runs that `keep` gathered, to make tables of."""
    runs = json.loads(lzma.decompress(file.read_bytes()))["runs"]
    return Results([RunResult(Path(name), figures["run"], figures) for name, figures in runs.items()])


def lay(file: Path, comparison: Path, scenes: Path) -> int:
    """Write what `keep` gathered as the folders that `compare` goes on with; what is there stays as it is.

    Returns:
        How many runs were written.

    Raises:
        InputError: a scene is another than the one that was trained on.

    """
    kept = json.loads(lzma.decompress(file.read_bytes()))
    digests = {}
    for figures in kept["runs"].values():
        name, wanted = figures["run"]["scene"], figures["run"]["scene_sha256"]
        path = scenes.resolve() / name / "transforms.json"
        digests.setdefault(name, hashlib.sha256(path.read_bytes()).hexdigest())
        if digests[name] != wanted:
            raise InputError(
                f"{path}: is not the scene of {file}: its SHA-256 is {digests[name]}, expected {wanted}. Make it by "
                "the commands of docs/results.md."
            )
    written = 0
    for name, figures in kept["runs"].items():
        folder = comparison / RUNS / name
        if (folder / FIGURES).exists():
            continue
        figures["run"]["scene"] = str(scenes.resolve() / figures["run"]["scene"])
        write_json(folder / SPECIFICATION, figures["run"])
        write_json(folder / FIGURES, figures)
        written += 1
    if kept["record"] is not None and not (comparison / RECORD).exists():
        write_json(comparison / RECORD, kept["record"])
    return written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    keeping = commands.add_parser("keep")
    keeping.add_argument("file", type=Path)
    keeping.add_argument("comparisons", type=Path, nargs="+")
    laying = commands.add_parser("lay")
    laying.add_argument("file", type=Path)
    laying.add_argument("comparison", type=Path)
    laying.add_argument("--scenes", type=Path, default=Path("scenes"))
    options = parser.parse_args()
    if options.command == "keep":
        print(f"{keep(options.file, *options.comparisons)} runs, {options.file.stat().st_size / 1024:.0f} KiB")
    else:
        print(f"{lay(options.file, options.comparison, options.scenes)} runs")


if __name__ == "__main__":
    main()
