"""What a comparison was to reach, and what it did: a Markdown table of its runs.

    python benchmarks/goals.py comparison --torch comparison_torch > goals.md

Of each goal the mean over drives and seeds as the comparison's tables have it. Goals whose methods the folder lacks are
left out. `--torch` is the folder of `benchmarks/equal_seconds.py`: the rivals in nerfstudio's own torch code.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from equal_seconds import EqualSeconds, at_equal_seconds

from edge_depth_nerf.compare.command import RUNS
from edge_depth_nerf.compare.methods import METHODS
from edge_depth_nerf.compare.options import MethodName
from edge_depth_nerf.compare.results import Results, RunResult, read_results
from edge_depth_nerf.compare.tables import curve_metric, per_seed, steps_to

LOSSES: tuple[MethodName, ...] = ("urban-nerf", "ds-nerf")
"""The rivals with a depth loss."""
RIVALS: tuple[MethodName, ...] = ("nerfacto", *LOSSES)
SOURCES_AND_KERNELS: tuple[tuple[str, MethodName], ...] = (
    ("3", "edge-lidar"),
    ("3", "edge-mono"),
    ("4", "edge-gaussian"),
)
"""What ours is to be ahead of in Tables 3 and 4."""
Value = Callable[[RunResult], float | None]
"""What a run has; None if it has no such thing."""


@dataclass(frozen=True)
class Goal:
    """A figure to reach, and what came out."""

    title: str
    wanted: float
    found: float
    form: str = "+.2f"
    at_least: bool = True

    @property
    def reached(self) -> bool:
        """Whether it was; ahead of another by nothing is not ahead."""
        if self.wanted == 0:
            return self.found > 0
        return self.found >= self.wanted if self.at_least else self.found <= self.wanted

    @property
    def row(self) -> str:
        """Of the table."""
        sign = "≥" if self.at_least else "≤"
        wanted = f"{sign} {self.wanted:{self.form}}" if self.wanted else "> 0"
        return f"| {self.title} | {wanted} | {self.found:{self.form}} | {'yes' if self.reached else '**no**'} |"


class Figures:
    """Figures of a comparison by drive, means over seeds."""

    def __init__(self, results: Results) -> None:
        self.results, self.scenes = results, results.scenes()

    def has(self, *methods: MethodName) -> bool:
        """Whether all drives have runs of all these."""
        runs = {(run.scene, run.method) for run in self.results.runs}
        return all((scene, method) in runs for scene in self.scenes for method in methods)

    def by_drive(self, method: MethodName, value: str | Value) -> list[float]:
        """A figure's mean over the seeds that have it, for each drive."""
        return [self._mean([scene], method, value) for scene in self.scenes]

    def mean(self, method: MethodName, value: str | Value) -> float:
        """Its mean over drives, of the seeds that all drives have it for."""
        return self._mean(self.scenes, method, value)

    def _mean(self, scenes: Sequence[str], method: MethodName, value: str | Value) -> float:
        get = (lambda run: run.figures[value]) if isinstance(value, str) else value
        return statistics.fmean(per_seed(self.results, scenes, method, get).values())

    def least_ahead(self, others: Sequence[MethodName], value: str) -> float:
        """By how much ours is ahead of the best of others on the worst drive."""
        ours = self.by_drive("edge", value)
        best = [max(values) for values in zip(*(self.by_drive(name, value) for name in others), strict=True)]
        return min(one - other for one, other in zip(ours, best, strict=True))


def goals(comparison: Results) -> Iterator[Goal]:
    """The goals at equal steps."""
    figures = Figures(comparison)
    psnr, ssim, abs_rel, beside = (
        "truth_masked_psnr",
        "truth_masked_ssim",
        "truth_abs_rel",
        "shifted_1m_masked_psnr",
    )
    if figures.has("edge", *RIVALS):
        ours = figures.mean("edge", psnr)
        yield Goal("PSNR, dB over nerfacto", 2.5, ours - figures.mean("nerfacto", psnr))
        better = max(figures.mean(name, psnr) for name in LOSSES)
        yield Goal("PSNR, dB over the better of DS-NeRF and UrbanNeRF", 0.5, ours - better)
        yield Goal("PSNR, dB over the best rival on the worst drive", 0.0, figures.least_ahead(RIVALS, psnr))
        least = figures.least_ahead(RIVALS, ssim)
        yield Goal("SSIM over the best rival on the worst drive", 0.0, least, "+.3f")
        best = min(figures.mean(name, abs_rel) for name in RIVALS)
        share = figures.mean("edge", abs_rel) / best
        yield Goal("AbsRel, share of the best rival's", 0.5, share, ".2f", at_least=False)
        yield Goal("δ<1.25", 0.98, figures.mean("edge", "truth_delta_1_25"), ".3f")
        best = max(figures.mean(name, beside) for name in RIVALS)
        yield Goal("PSNR 1 m beside, dB over the best rival", 1.5, figures.mean("edge", beside) - best)
        yield Goal(
            "Steps to nerfacto's final PSNR, share of its steps", 1 / 3, _share_of_steps(figures), ".2f", at_least=False
        )
    for table, name in SOURCES_AND_KERNELS:
        if figures.has("edge", name):
            least = figures.least_ahead([name], psnr)
            yield Goal(f"Table {table}: dB over {METHODS[name].title} on the worst drive", 0.0, least)


def goals_in_time(comparison: Results, torch: Results) -> Iterator[Goal]:
    """The goals at equal seconds: of the seeds that the rivals in torch have."""
    ours, rivals = Figures(comparison), Figures(torch)
    if not ours.has("edge") or not rivals.has(*RIVALS):
        return

    def of(method: MethodName, value: Callable[[EqualSeconds], float]) -> float:
        def get(run: RunResult) -> float | None:
            found = at_equal_seconds(comparison, run)
            return None if found is None else value(found)

        return rivals.mean(method, get)

    def ahead(methods: Sequence[MethodName]) -> float:
        return min(of(each, lambda found: found.ours) - of(each, lambda found: found.psnr) for each in methods)

    yield Goal("At equal seconds: dB over nerfacto in torch", 4.0, ahead(["nerfacto"]))
    yield Goal("At equal seconds: dB over the better of DS-NeRF and UrbanNeRF in torch", 2.0, ahead(LOSSES))


def _share_of_steps(figures: Figures) -> float:
    name = curve_metric(figures.results)

    def share(run: RunResult) -> float | None:
        base = figures.results.run(run.scene, "nerfacto", run.seed)
        if base is None:
            return None
        steps = steps_to(run.curve, base.curve[-1][name], name)
        return math.inf if steps is None else steps / base.content["steps"]

    return figures.mean("edge", share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("comparison", type=Path)
    parser.add_argument("--torch", type=Path)
    options = parser.parse_args()
    comparison = read_results(options.comparison / RUNS)
    found = [*goals(comparison)]
    if options.torch:
        found += goals_in_time(comparison, read_results(options.torch / RUNS))
    print("\n".join(["| | goal | found | reached |", "|---|---|---|---|", *(goal.row for goal in found)]))


if __name__ == "__main__":
    main()
