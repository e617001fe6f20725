"""Options of `edge-depth-nerf compare`, `search` and `grid`; a module of its own: the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_depth_nerf.base.errors import require
from edge_depth_nerf.compare.methods import GRID, METHODS, MethodName, Preset, Setting, Sigma, check_name
from edge_depth_nerf.jobs.cluster_address import check_address

LEAST_LAMBDAS, LEAST_SIGMAS = 4, 3
"""A search over less says little."""


def _words(values: tuple[object, ...]) -> str:
    return " ".join(map(str, values))


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """What the three commands train."""

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders; the tables use their names."""
    output: Path
    """Folder for the runs, and for all that is made of them."""
    methods: tuple[MethodName, ...] = ()
    """Names of methods, such as nerfacto, ds-nerf or edge-lidar, and the defaults: docs/compare.md."""
    steps: int | None = None
    """Training steps of each run. Not set: the preset's."""
    seeds: tuple[int, ...] = (0,)
    """Seeds; each method is trained once with each. A grid searches with the first."""
    preset: Preset = "lite"
    """What all methods share. lite: for a CPU; full: for a GPU; paper: full, and edge-… is the literal method."""
    jobs: int | None = None
    """Parallel trainings. Not set: one per core; on a GPU, one."""
    cluster: str | None = None
    """Train on a Dask cluster: local, or a scheduler's address (docs/cluster.md)."""

    def check(self) -> None:
        """Check what can be checked without looking at the disk.

        Raises:
            InputError: an option is out of its range, or two do not go together.
        """
        require(len(self.scenes) > 0, "no scene", "at least one scene folder")
        require(self.steps is None or self.steps >= 1, f"--steps {self.steps}", "1 or more")
        require(self.jobs is None or self.jobs >= 1, f"--jobs {self.jobs}", "1 or more")
        check_address(self.cluster)
        require(
            self.jobs is None or self.cluster is None,
            "--jobs with --cluster",
            "one of them: a cluster runs one training per worker",
        )
        require(len(self.seeds) > 0 and min(self.seeds) >= 0, f"--seeds {self.seeds}", "at least one, each 0 or more")
        _check_once("methods", self.methods)
        _check_once("seeds", self.seeds)
        for name in self.methods:
            check_name(name)
        # they would be trained like others, and be called otherwise
        same = [name for name in self.methods if not METHODS[name].differs_without_extras]
        require(
            not same or self.preset != "paper",
            f"--preset paper --methods {_words(tuple(same))}",
            "edge, edge-lidar, edge-mono, edge-gaussian, which are of the literal method in this preset, and rivals "
            "without -extras: it has none",
        )


def _check_once(name: str, values: tuple[object, ...]) -> None:
    require(len(set(values)) == len(values), f"--{name} {_words(values)}", "each once")


@dataclass(frozen=True, kw_only=True)
class CompareOptions(TrainingOptions):
    """Train each method on each scene, evaluate all alike, and make tables of all that is in the folder.

    You can stop at any time; run the same command again to resume.
    """

    tuned: Path | None = None
    """λ and σ of the methods: tuned.json of a search. Not set: the defaults."""
    detail: bool = False
    """Evaluate all views twice, also with the detail of training pictures. This takes longer."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions(TrainingOptions):
    """Train each method with each λ and σ, and write the best to tuned.json, for `compare --tuned`.

    You can stop at any time; run the same command again to resume, also with more values.
    """

    lambdas: tuple[float, ...]
    """The weights λ of the depth loss to try, 4 at least."""
    sigmas_m: tuple[Sigma, ...]
    """The standard deviations σ to try, metres, 3 at least; own: the method's own σ."""

    def check(self) -> None:
        """Check what can be checked without looking at the disk; raises InputError."""
        super().check()
        self._check_methods()
        _check_once("lambdas", self.lambdas)
        _check_once("sigmas-m", self.sigmas_m)
        require(
            len(self.lambdas) >= LEAST_LAMBDAS and all(math.isfinite(x) and x > 0 for x in self.lambdas),
            f"--lambdas {_words(self.lambdas)}",
            f"at least {LEAST_LAMBDAS} positive numbers",
        )
        require(
            len(self.sigmas_m) >= LEAST_SIGMAS
            and all(x == "own" or (math.isfinite(float(x)) and float(x) > 0) for x in self.sigmas_m),
            f"--sigmas-m {_words(self.sigmas_m)}",
            f"at least {LEAST_SIGMAS} of positive metres or own",
        )

    @property
    def tried(self) -> list[Setting]:
        """Each λ with each σ."""
        return [Setting(weight, sigma_m) for weight in self.lambdas for sigma_m in self.sigmas_m]

    def _check_methods(self) -> None:
        without = tuple(name for name in self.methods if METHODS[name].loss == "none")
        require(not without, f"--methods {_words(without)}", "methods with a depth loss")


@dataclass(frozen=True, kw_only=True)
class GridOptions(SearchOptions):
    """Train each loss with each prior, with and without extras, to see what each is worth.

    λ and σ of each are searched on the tuning scenes first. You can stop at any time; run the same command again to
    resume.
    """

    tuning: tuple[Path, ...]
    """Scene folders to search λ and σ on, of other drives than the evaluated ones."""

    def check(self) -> None:
        """Check what can be checked without looking at the disk; raises InputError."""
        super().check()
        require(self.preset != "paper", "--preset paper", "lite or full: paper has no extras")
        require(len(self.tuning) > 0, "--tuning", "at least one scene that is not evaluated")
        both = {scene.resolve() for scene in self.tuning} & {scene.resolve() for scene in self.scenes}
        require(not both, f"--tuning {_words(tuple(both))}", "other drives than those that are evaluated")

    def _check_methods(self) -> None:
        others = tuple(name for name in self.methods if METHODS[name] not in GRID)
        require(not others, f"--methods {_words(others)}", f"cells of the grid, {', '.join(GRID.values())}")
        with_loss = any(METHODS[name].loss != "none" for name in self.methods or GRID.values())
        require(with_loss, f"--methods {_words(self.methods)}", "at least one that has a loss on the prior")
