"""Ours and the rivals in nerfstudio's own torch code after equal seconds of training: a Markdown table.

    python benchmarks/equal_seconds.py comparison scenes/street scenes/parking scenes/turn --steps 900 \
        --tuned benchmarks/tuned.json --output comparison_torch > equal_seconds.md

Trains the rivals for at least as long as ours took in the comparison, judged by random held-out pixels on
the way; a run that is there is not made again. `benchmarks/goals.py --torch comparison_torch` reads the same runs.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.compare.command import RUNS, Run, check_scene, do_runs, read_tuned
from edge_depth_nerf.compare.methods import METHODS, Setting
from edge_depth_nerf.compare.options import CompareOptions, MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.specification import RunSpecification
from edge_depth_nerf.compare.tables import clock_metric, curve_metric, psnr_at

RIVALS: tuple[MethodName, ...] = ("nerfacto", "urban-nerf", "ds-nerf")


@dataclass(frozen=True)
class EqualSeconds:
    """A rival when ours of the same drive and seed had ended."""

    psnr: float
    """The rival's, dB."""
    ours: float
    """Ours in the end, dB."""
    seconds: float
    """Of training."""
    steps: float
    """That the rival had done."""


def at_equal_seconds(ours: Results, rival: RunResult) -> EqualSeconds | None:
    """A rival's PSNR of random pixels at ours' seconds; None if ours lacks its drive or seed.

    Raises:
        InputError: the rival was not trained as long as ours.

    """
    run = ours.run(rival.scene, "edge", rival.seed)
    if run is None:
        return None
    name, clock = curve_metric(ours), clock_metric(ours)
    seconds, last = run.curve[-1][clock], rival.curve[-1]
    if last[clock] < seconds:
        raise InputError(
            f"{rival.folder}: was trained for {last[clock]:.0f} s, ours for {seconds:.0f} s. Give the rivals "
            f"{last['step'] * seconds / last[clock] * 1.1:.0f} --steps, in a new folder."
        )
    psnr, steps = (psnr_at(rival.curve, seconds, each, clock) for each in (name, "step"))
    return EqualSeconds(psnr, run.curve[-1][name], seconds, steps)


def table(ours: Results, rivals: Results) -> str:
    """PSNR by drive and on average, with what ours is ahead by and the steps that a rival had done."""
    scenes = rivals.scenes()
    lines = [
        f"| | {' | '.join(scenes)} | average | ours ahead dB | steps |",
        "|" + "---|" * (len(scenes) + 4),
    ]
    last: list[float] = []
    for method in rivals.methods():
        found = [
            [each for run in rivals.runs if (run.scene, run.method) == (scene, method) for each in _known(ours, run)]
            for scene in scenes
        ]
        means = [_mean([each.psnr for each in drive]) for drive in found]
        last = [_mean([each.ours for each in drive]) for drive in found]
        steps = _mean([each.steps for drive in found for each in drive])
        cells = [*(f"{mean:.2f}" for mean in means), f"{_mean(means):.2f}", f"{_mean(last) - _mean(means):+.2f}"]
        lines.append(f"| {METHODS[method].title} | {' | '.join(cells)} | {steps:.0f} |")
    seconds = _mean([each.seconds for run in rivals.runs for each in _known(ours, run)])
    steps = _mean([run.content["steps"] for run in ours.runs if run.method == "edge"])
    cells = [*(f"**{mean:.2f}**" for mean in last), f"**{_mean(last):.2f}**", "–"]
    lines.append(f"| ours | {' | '.join(cells)} | {steps:.0f} |")
    note = f"After {seconds:.0f} processor seconds of training on average: the time of ours on each drive."
    return "\n".join([*lines, "", note])


def _known(ours: Results, run: RunResult) -> list[EqualSeconds]:
    found = at_equal_seconds(ours, run)
    return [] if found is None else [found]


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def train(options: argparse.Namespace) -> None:
    """Train the rivals, as far as they are not there."""
    tuned = read_tuned(options.tuned)
    runs = []
    for scene in map(Path.resolve, options.scenes):
        digest = check_scene(scene, RIVALS, "lite")
        for method in RIVALS:
            setting = tuned.get(method, Setting())
            specification = RunSpecification(
                scene=str(scene),
                scene_sha256=digest,
                preset="lite",
                method=method,
                seed=options.seed,
                steps=options.steps,
                weight=setting.weight,
                sigma_m=setting.sigma_m,
                implementation="torch",
                whole_views=False,
            )
            runs.append(Run(specification, options.output / RUNS))
    for run in runs:
        run.open()
    jobs = CompareOptions(scenes=tuple(options.scenes), output=options.output, jobs=options.jobs)
    do_runs([run for run in runs if not run.finished], jobs, Console(stderr=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("comparison", type=Path)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tuned", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--output", type=Path, required=True)
    options = parser.parse_args()
    try:
        train(options)
        found = table(read_results(options.comparison / RUNS), read_results(options.output / RUNS))
    except InputError as error:
        sys.exit(str(error))
    print(found)


if __name__ == "__main__":
    main()
