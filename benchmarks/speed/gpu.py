"""What a GPU makes of this project, in eight minutes: starts, steps, kernels, trainings, tests, and a page of it.

    python -m benchmarks.speed.gpu [--output outputs/gpu] [--scene FOLDER] [--parts NAME ...] [--again] [--fake]

or `make gpu`. Each part is a process with a limit of its own, which ends it with all that it started. It leaves a file,
NAME.json, and what it said, NAME.log. A part that fails, or takes too long, ends no other. Called again, it does what
is missing or failed (`--again`: everything), so that a machine that is lent for some minutes at a time will do. After
each part report.md is written from the files. Parts of a group run at the same time. gsplat is compiled from the
beginning, and splats are trained when nothing is timed alone any more. A number that is none (NaN, infinity) is null;
`not finite` says where.

`--fake` goes the same way on any machine, with tiny sizes on the CPU, in this process: its figures mean nothing, and
say so.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import itertools
import math
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.speed.gpu_parts import CACHES, PARTS, ROOT, SPLATS, TRAININGS, Found, Settings
from benchmarks.speed.report import rows_of
from edge_depth_nerf.base.files import read_json, write_json, write_text
from edge_depth_nerf.jobs.runs import end_with_parent

FAKE = "**Tiny sizes on a CPU, to see that everything runs: no figure here means anything.**"


def file_of(output: Path, name: str) -> Path:
    """The results of a part."""
    return output / f"{name.replace(' ', '_')}.json"


def is_done(path: Path) -> bool:
    """Whether a part has come to its end."""
    return path.is_file() and "failed" not in read_json(path)


def finite(found: Any, place: str, odd: dict[str, str]) -> Any:
    """The same for JSON: None for a number that is none; `odd` then has what it was, by its place."""
    if isinstance(found, float) and not math.isfinite(found):
        odd[place] = str(found)
        return None
    if isinstance(found, dict):
        return {name: finite(each, f"{place} / {name}", odd) for name, each in found.items()}
    if isinstance(found, (list, tuple)):
        return [finite(each, f"{place} / {number}", odd) for number, each in enumerate(found)]
    return found


def write(path: Path, found: Found) -> None:
    """Write what a part has found."""
    odd: dict[str, str] = {}
    plain = finite(found, path.stem, odd)
    write_json(
        path, plain | ({"not finite": ", ".join(f"{place}: {was}" for place, was in odd.items())} if odd else {})
    )


class InAProcess:
    """A part in a process that is ended with all that it started when its limit is over, or this process ends."""

    def __init__(self, name: str, options: argparse.Namespace) -> None:
        self.limit_s, self.path = options.patience * PARTS[name].limit_s, file_of(options.output, name)
        self.path.unlink(missing_ok=True)
        caches = settings_of(options).caches
        environment = {variable: str((caches / folder).absolute()) for variable, folder in CACHES.items()}
        self._began = time.time()
        command = [sys.executable, "-m", "benchmarks.speed.gpu", "--only", name, "--began", str(self._began)]
        command += ["--output", str(options.output.absolute()), "--scene", str(options.scene.absolute())]
        command += ["--fake"] if options.fake else []
        with self.path.with_suffix(".log").open("w") as said:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,  # it ends when this is closed
                stdout=said,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
                env={**os.environ, **environment, "PYTHONUNBUFFERED": "1"},
                start_new_session=True,
            )

    def found(self) -> Found:
        """What it has found, if need be until it was ended, and what it said of CUDA graphs."""
        try:
            status = self._process.wait(max(0.0, self._began + self.limit_s - time.time()))
            failed = f"status {status}; {self.path.stem}.log says more"
        except subprocess.TimeoutExpired:
            failed = f"not done after {self.limit_s:g} s (--patience 3 gives it three times as long)"
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()
        kept = read_json(self.path) if self.path.is_file() else {"failed": ""}
        kept |= {"failed": kept["failed"] or failed} if "failed" in kept else {}
        log = self.path.with_suffix(".log").read_text(errors="replace").splitlines()
        said = dict.fromkeys(line.strip() for line in log if "CUDA graph" in line)
        return kept | ({"said of CUDA graphs": "\n".join(said)} if said else {})


def here(name: str, settings: Settings, path: Path) -> Found:
    """Do a part in this process; what it keeps on the way lies at `path` and counts as failed."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    known: Found = {}

    def keep(found: Found) -> None:
        known.update(found)
        write(path, {**found, "failed": ""})

    try:
        return PARTS[name].run(dataclasses.replace(settings, keep=keep))
    except Exception as error:  # a part that fails ends no other
        traceback.print_exc()
        return known | {"failed": f"{type(error).__name__}: {error}"[:2000]}


def cell(value: Any) -> str:
    """A value in a table: the median and range of several, a dash for none."""
    if isinstance(value, (list, tuple)):
        known = [each for each in value if each is not None]
        several = f" ({cell(min(known))}-{cell(max(known))})" if len(known) > 1 else ""
        return f"{cell(statistics.median(known))}{several}" if known else "–"
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value).replace("|", "/")


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown; all columns but the first are numbers."""
    return rows_of(heads, [[cell(each) for each in row] for row in rows])


def section(name: str, parts: dict[str, Found | None]) -> str:
    """What the parts of a group have found: a column for each, then their tables and what has several lines."""
    lines = [f"## {name[0].upper()}{name[1:]}"]
    for part, found in parts.items():
        before = f"{part}: " if len(parts) > 1 else ""
        if found is None:
            lines.append(f"{before}Not done yet.")
        elif "failed" in found:
            lines.append(f"{before}Failed: {found['failed']}.")
    known = {part: found for part, found in parts.items() if found}
    words = ("failed", "said", "said of CUDA graphs", "not finite")
    keys = dict.fromkeys(key for found in known.values() for key in found if key not in (*words, "rows"))
    if keys:
        heads = ["", *(known if len(parts) > 1 else [""])]
        lines.append(table(heads, [[key, *(found.get(key) for found in known.values())] for key in keys]))
    for found in known.values():
        if rows := found.get("rows"):
            heads = list(rows[0])
            lines.append(table(heads, [[row.get(head) for head in heads] for row in rows]))
        lines += [f"{word}:\n\n```\n{found[word]}\n```" for word in words[1:] if word in found]
    return "\n\n".join(lines)


def write_report(output: Path, fake: bool) -> None:
    """Write the page from the files there are."""
    results = {name: read_json(path) if (path := file_of(output, name)).is_file() else None for name in PARTS}
    lines = ["# On a GPU", *([FAKE] if fake else [])]
    for title, members in itertools.groupby(PARTS, lambda name: PARTS[name].group or name):
        lines.append(section(title, {name: results[name] for name in members}))
    write_text(output / "report.md", "\n\n".join(lines) + "\n")


def settings_of(options: argparse.Namespace) -> Settings:
    """What the parts are to measure."""
    return Settings(options.scene, options.output / "work", options.fake)


def do(names: Sequence[str], options: argparse.Namespace) -> int:
    """Do parts, group by group; the number of those that failed."""
    settings, failed = settings_of(options), 0
    began: dict[str, float] = {}

    def finish(name: str, found: Found) -> None:
        nonlocal failed
        write(file_of(options.output, name), found)
        write_report(options.output, options.fake)
        failed += "failed" in found
        print(f"{name}: {found.get('failed', 'done')}, {time.time() - began[name]:.0f} s", flush=True)

    settings.alone.unlink(missing_ok=True)
    began[SPLATS] = time.time()
    splats = InAProcess(SPLATS, options) if SPLATS in names and not options.fake else None
    for group, members in itertools.groupby(names, lambda name: PARTS[name].group or name):
        if group == "recording":
            shutil.rmtree(settings.caches, ignore_errors=True)
        if group in (TRAININGS, SPLATS):
            settings.folder.mkdir(parents=True, exist_ok=True)
            settings.alone.touch()
        if group == SPLATS and splats is not None:
            continue
        chosen = list(members)
        began |= dict.fromkeys(chosen, time.time())
        if options.fake:
            for name in chosen:
                finish(name, here(name, settings, file_of(options.output, name)))
        else:
            for name, process in {name: InAProcess(name, options) for name in chosen}.items():
                finish(name, process.found())
    if splats is not None:
        finish(SPLATS, splats.found())
    return failed


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the parts; the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu"))
    parser.add_argument("--scene", type=Path, default=Path("data/sample_drive"))
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="NAME")
    parser.add_argument("--again", action="store_true", help="also what was done before")
    parser.add_argument("--fake", action="store_true", help="tiny sizes on the CPU")
    parser.add_argument("--patience", type=float, default=1, help="times the limits, which are an H200's")
    parser.add_argument("--only", choices=list(PARTS), help=argparse.SUPPRESS)
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.only:
        end_with_parent(lambda: os.killpg(0, signal.SIGKILL))
        path = file_of(options.output, options.only)
        write(path, here(options.only, dataclasses.replace(settings_of(options), began=options.began), path))
        return 0
    import torch

    if not options.fake and not torch.cuda.is_available():
        parser.exit(
            2, "There is no GPU here (torch.cuda.is_available() is False); --fake shows that everything runs.\n"
        )
    options.output.mkdir(parents=True, exist_ok=True)
    done = [name for name in options.parts if is_done(file_of(options.output, name)) and not options.again]
    for name in done:
        print(f"{name}: done before")
    failed = do([name for name in PARTS if name in options.parts and name not in done], options)
    print(f"{options.output / 'report.md'}")
    return failed


if __name__ == "__main__":
    sys.exit(min(1, main()))
