"""What a GPU makes of this project, in one go: its tests, kernels, steps, a training, and a page of it.

    python -m benchmarks.speed.gpu [--output outputs/gpu] [--scene FOLDER] [--parts NAME ...] [--again] [--fake]

or `make gpu`. Each part is a process of its own with a limit of at most three minutes, and leaves a file, NAME.json,
and what it said, NAME.log. A part that fails, or takes too long, ends no other. Called again, it does what is missing
or failed (`--again`: everything), so that a machine that is lent for some minutes at a time will do. After each part
report.md is written from the files.

`--fake` goes the same way on any machine, with tiny sizes on the CPU, in this process: its figures mean nothing, and
say so.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.speed.gpu_parts import EQUAL_STEPS, PARTS, ROOT, Settings
from edge_depth_nerf.base.files import read_json, write_json, write_text


def file_of(output: Path, name: str) -> Path:
    """The results of a part."""
    return output / f"{name.replace(' ', '_')}.json"


def is_done(path: Path) -> bool:
    """Whether a part has come to its end."""
    return path.is_file() and "failed" not in read_json(path)


def in_a_process(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Do a part in a process that is ended with all that it started when its limit is over."""
    path, log = file_of(options.output, name), file_of(options.output, name).with_suffix(".log")
    path.unlink(missing_ok=True)
    command = [sys.executable, "-m", "benchmarks.speed.gpu", "--only", name]
    command += ["--output", str(options.output.absolute()), "--scene", str(options.scene.absolute())]
    with log.open("w") as said:
        process = subprocess.Popen(command, stdout=said, stderr=subprocess.STDOUT, cwd=ROOT, start_new_session=True)
        try:
            status = process.wait(PARTS[name].limit_s)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return {"failed": f"not done after {PARTS[name].limit_s} s"}
    if not path.is_file():
        return {"failed": f"status {status}; {log} says more"}
    return read_json(path)


def here(name: str, settings: Settings) -> dict[str, Any]:
    """Do a part in this process."""
    settings.folder.mkdir(parents=True, exist_ok=True)
    try:
        return PARTS[name].run(settings)
    except Exception as error:  # a part that fails ends no other
        traceback.print_exc()
        return {"failed": f"{type(error).__name__}: {error}"[:2000]}


def table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown; all columns but the first are numbers."""
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def about_device(found: dict[str, Any]) -> str:
    """What was measured on."""
    names = ("gpu", "memory_gb", "capability", "processor", "cores", "torch", "triton", "cuda")
    known = [(name, found[name]) for name in names if found.get(name) is not None]
    return table(["", ""], [*known, ("copies, GB/s", f"{found['copied_gb_s']:,.0f}")])


def about_counts(found: dict[str, Any]) -> str:
    """What was counted."""
    rows = [
        (case, f"{each['kernels']:,}", f"{each['gigabytes']:.1f}", len(each["uploads"]), len(each["synchronisations"]))
        for case, each in found.items()
    ]
    return table(["", "kernels", "GB of torch", "uploads", "places that wait"], rows)


def about_tests(found: dict[str, Any]) -> str:
    """How the tests went."""
    said = f"\n\n```\n{found['said']}\n```" if found["said"] else ""
    return ", ".join(f"{count} {what}" for what, count in found["counts"].items()) + f".{said}"


def about_kernels(found: dict[str, Any], copied_gb_s: float | None) -> str:
    """Times and bytes of kernels."""
    rows = [
        (
            f"{row['size']}, {row['points']:,} points {'along rays' if row['along_rays'] else 'anywhere'}",
            row["kernel"],
            f"{row['ms']:.3f}",
            f"{row['gb_s']:,.0f}",
            f"{row['gb_s'] / copied_gb_s:.0%}" if copied_gb_s else "–",
            f"{row['off_the_cpu']:.1e}",
        )
        for row in found["rows"]
    ]
    return table(["", "kernel", "ms", "GB/s", "of a copy's", "off the CPU"], rows)


def about_samples_and_losses(found: dict[str, Any]) -> str:
    """Times of kernels beside torch's."""
    rows = [
        (row["what"], f"{row['triton_ms']:.3f}", f"{row['torch_ms']:.3f}", f"{row['off_torch']:.1e}")
        for row in found["rows"]
    ]
    return table(["", "ms, Triton", "ms, torch", "off torch"], rows)


def about_steps(found: dict[str, Any]) -> str:
    """Times of steps."""
    rows = []
    for name, each in found.items():
        if name != "left_out":
            rays = each["rays_per_second"]
            ratios = each["ratio_to_nerfacto"]
            rows.append(
                (
                    name,
                    f"{statistics.median(each['step_ms']):.2f}",
                    f"{rays:,.0f}" if rays else "–",
                    f"{statistics.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f})",
                )
            )
    left_out = "".join(f"\n\n{name}: left out, {why}." for name, why in found.get("left_out", {}).items())
    return table(["", "ms a step", "rays/s", "× nerfacto in torch"], rows) + left_out


def about_profile(found: dict[str, Any]) -> str:
    """What a step is made of."""
    kinds = ("step_ms", "host_ms", "device_ms", "launches", "copies", "waits", "allocated_gb", "reserved_gb")
    rows = [(name.replace("_", ", "), f"{found[name]:.2f}") for name in kinds if name in found]
    slowest = [(each["kernel"].replace("|", "/"), f"{each['ms']:.3f}", each["calls"]) for each in found["slowest"]]
    return f"{table(['a step of ours', ''], rows)}\n\n{table(['slowest kernels', 'ms a step', 'calls'], slowest)}"


def about_training(found: dict[str, Any]) -> str:
    """Figures of a training."""
    rows = [(name, f"{value:.4g}") for name, value in found["figures"].items()]
    return f"{found['steps']} steps in {found['seconds_with_start']:.0f} s, start included.\n\n{table(['', ''], rows)}"


def about_both(found: dict[str, Any]) -> str:
    """Figures of the same training on GPU and CPU."""
    gpu, cpu = found["cuda"]["figures"], found["cpu"]["figures"]
    rows = [(name, f"{gpu[name]:.4g}", f"{cpu[name]:.4g}") for name in gpu if name in cpu]
    return f"{EQUAL_STEPS} steps each.\n\n{table(['', 'GPU', 'CPU'], rows)}"


def report(results: dict[str, dict[str, Any]], fake: bool) -> str:
    """The page, from what the parts have left."""
    copied = results.get("device", {}).get("copied_gb_s")
    write = {
        "device": about_device,
        "counts": about_counts,
        "tests": about_tests,
        "kernels": lambda found: about_kernels(found, copied),
        "samples and losses": about_samples_and_losses,
        "our steps": about_steps,
        "other steps": about_steps,
        "profile": about_profile,
        "training": about_training,
        "beside the CPU": about_both,
    }
    lines = ["# On a GPU", ""]
    if fake:
        lines += ["**Tiny sizes on a CPU, to see that everything runs: no figure here means anything.**", ""]
    for name in PARTS:
        found = results.get(name)
        if found is None:
            text = "Not done yet."
        elif "failed" in found:
            text = f"Failed: {found['failed']}"
        elif isinstance(found.get("left_out"), str):
            text = f"Left out: {found['left_out']}."
        else:
            text = write[name](found)
        lines += [f"## {name[0].upper()}{name[1:]}", "", text, ""]
    return "\n".join(lines)


def write_report(output: Path, fake: bool) -> None:
    """Write the page from the files there are."""
    paths = {name: file_of(output, name) for name in PARTS}
    results = {name: read_json(path) for name, path in paths.items() if path.is_file()}
    write_text(output / "report.md", report(results, fake))


def main(arguments: Sequence[str] | None = None) -> int:
    """Do the parts; the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu"))
    parser.add_argument("--scene", type=Path, default=Path("data/sample_drive"))
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS), metavar="NAME")
    parser.add_argument("--again", action="store_true", help="also what was done before")
    parser.add_argument("--fake", action="store_true", help="tiny sizes on the CPU")
    parser.add_argument("--only", choices=list(PARTS), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    import torch

    if not options.fake and not torch.cuda.is_available():
        parser.exit(
            2, "There is no GPU here (torch.cuda.is_available() is False); --fake shows that everything runs.\n"
        )
    options.output.mkdir(parents=True, exist_ok=True)
    settings = Settings(options.scene, options.output / "work", options.fake)
    if options.only:
        write_json(file_of(options.output, options.only), here(options.only, settings))
        return 0
    failed = 0
    for name in options.parts:
        path = file_of(options.output, name)
        if is_done(path) and not options.again:
            print(f"{name}: done before")
            continue
        began = time.perf_counter()
        found = here(name, settings) if options.fake else in_a_process(name, options)
        write_json(path, found)
        write_report(options.output, options.fake)
        failed += "failed" in found
        print(f"{name}: {found.get('failed', 'done')}, {time.perf_counter() - began:.0f} s", flush=True)
    print(f"{options.output / 'report.md'}")
    return failed


if __name__ == "__main__":
    sys.exit(min(1, main()))
