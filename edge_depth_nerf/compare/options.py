"""Options of `edge-depth-nerf compare`; a module of its own so that the command line starts fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.cluster_address import check_address

Preset = Literal["lite", "full", "paper"]
Implementation = Literal["same", "torch"]
MethodName = Literal[
    "nerfacto",
    "nerfacto-embedding",
    "urban-nerf",
    "urban-nerf-los",
    "ds-nerf",
    "edge-lidar",
    "edge-mono",
    "edge-gaussian",
    "edge-paper",
    "edge",
    "nerfacto-lidar-extras",
    "nerfacto-integrated-extras",
    "urban-nerf-integrated",
    "urban-nerf-extras",
    "urban-nerf-integrated-extras",
    "urban-nerf-los-integrated",
    "urban-nerf-los-extras",
    "urban-nerf-los-integrated-extras",
    "ds-nerf-integrated",
    "ds-nerf-extras",
    "ds-nerf-integrated-extras",
    "edge-lidar-plain",
    "edge-plain",
    "edge-paper-lidar",
    "edge-paper-mono",
    "edge-paper-gaussian",
]
Sigma = float | Literal["own"]

LEAST_LAMBDAS, LEAST_SIGMAS = 4, 3
"""A search over less says little."""


@dataclass(frozen=True, kw_only=True)
class CompareOptions:
    """Train each method on each scene with one configuration, evaluate all alike, and make the paper's tables.

    You can stop at any time; run the same command again to resume. You can add scenes, methods and seeds to the folder
    later; the tables include everything in it.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders written by `edge-depth-nerf process`; the tables use their names."""
    output: Path
    """Folder for the runs, results.csv and results.json, tables.md and tables.tex, pictures and plots."""
    methods: tuple[MethodName, ...] = ()
    """Which methods. Not set: all except those of the grid and edge-paper-…; with --preset paper also without
    edge-paper, which equals edge there; with --grid all its cells."""
    steps: int | None = None
    """Training steps of each run; the learning rates fall over them. Not set: the preset's."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the training; each method is trained once with each."""
    preset: Preset = "lite"
    """The configuration that all methods share. lite: a laptop's CPU; full: a GPU; paper: full size, and edge-… is the
    literal method."""
    tuned: Path | None = None
    """λ and σ of the methods: tuned.json of a search, or a file of that form. Not set: the defaults."""
    rivals_implementation: Implementation = "same"
    """torch: nerfacto, ds-nerf and both forms of UrbanNeRF run in nerfstudio's own torch code, with the same results,
    to compare at equal seconds."""
    detail: bool = False
    """Evaluate all views twice, for all methods: as the model renders them, and with the detail that training pictures
    show beyond their own renderings (with detail). Training pictures are rendered for it, which takes time."""
    jobs: int | None = None
    """Parallel trainings. Not set: one per core; on a GPU, one."""
    cluster: str | None = None
    """Train on a Dask cluster: local (processes on this machine, one for each GPU or core), or the address of a
    scheduler, such as tcp://10.0.0.1:8786. Needs `pip install '.[cluster]'`; see docs/cluster.md."""
    search: bool = False
    """Instead of tables: train each method with each λ and σ on tuning scenes and one seed, and write the best to
    tuned.json."""
    grid: bool = False
    """Each loss with each prior, without and with the extras: search λ and σ of each on --tuning, then train and
    evaluate all on the scenes, and report what prior, loss, extras and the whole are worth (grid.md)."""
    tuning: tuple[Path, ...] = ()
    """With --grid: scene folders to search λ and σ on, of other drives than the evaluated ones."""
    search_steps: int | None = None
    """With --grid: training steps of each run of the search. Not set: as many as --steps."""
    lambdas: tuple[float, ...] = ()
    """With --search or --grid: the weights λ of the depth loss to try, 4 at least."""
    sigmas_m: tuple[Sigma, ...] = ()
    """With --search or --grid: the standard deviations σ to try, metres, 3 at least; own: the method's own σ (for
    edge-…: the prior's σ at each pixel)."""

    def check(self) -> None:
        """Check what can be checked without looking at the disk.

        Raises:
            InputError: an option is out of its range, or two do not go together.

        """

        def require(fine: bool, found: str, expected: str) -> None:
            if not fine:
                raise InputError(f"{found}: expected {expected}.")

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
        for name, values in (
            ("methods", self.methods),
            ("seeds", self.seeds),
            ("lambdas", self.lambdas),
            ("sigmas-m", self.sigmas_m),
        ):
            require(len(set(values)) == len(values), f"--{name} {' '.join(map(str, values))}", "each once")
        literal = [name for name in self.methods if name.startswith("edge-paper")]
        require(
            not literal or self.preset != "paper",
            f"--preset paper --methods {' '.join(literal)}",
            "edge, edge-lidar, edge-mono, edge-gaussian, which are of the literal method in this preset",
        )
        require(
            self.grid or self.search_steps is None,
            f"--search-steps {self.search_steps} without --grid",
            "both, or --steps for the runs of --search",
        )
        require(self.search_steps is None or self.search_steps >= 1, f"--search-steps {self.search_steps}", "1 or more")
        require(not (self.search and self.detail), "--search with --detail", "one of them: a search renders no views")
        require(not (self.search and self.grid), "--search with --grid", "one of them: the grid searches first")
        require(self.grid or not self.tuning, "--tuning without --grid", "both, or --search on the tuning scenes")
        if not self.search and not self.grid:
            require(
                not self.lambdas and not self.sigmas_m,
                "--lambdas or --sigmas-m without --search or --grid",
                "both with one of these, or --tuned FILE with what a search found",
            )
            return
        require(self.tuned is None, f"--{'grid' if self.grid else 'search'} with --tuned", "one of them")
        if self.grid:
            require(self.preset != "paper", "--grid with --preset paper", "lite or full: paper has no extras")
            require(len(self.tuning) > 0, "--grid without --tuning", "at least one scene that is not judged")
            tuned_on = {scene.resolve() for scene in self.tuning} & {scene.resolve() for scene in self.scenes}
            require(not tuned_on, f"--tuning {' '.join(map(str, tuned_on))}", "other drives than those that are judged")
        else:
            require(len(self.seeds) == 1, f"--search with {len(self.seeds)} seeds", "one, which no table uses")
            without = [name for name in self.methods if name.startswith("nerfacto")]
            require(not without, f"--search --methods {' '.join(without)}", "methods with a depth loss")
        require(
            len(self.lambdas) >= LEAST_LAMBDAS and all(math.isfinite(x) and x > 0 for x in self.lambdas),
            f"--lambdas {' '.join(map(str, self.lambdas))}",
            f"at least {LEAST_LAMBDAS} positive numbers",
        )
        require(
            len(self.sigmas_m) >= LEAST_SIGMAS
            and all(x == "own" or (math.isfinite(float(x)) and float(x) > 0) for x in self.sigmas_m),
            f"--sigmas-m {' '.join(map(str, self.sigmas_m))}",
            f"at least {LEAST_SIGMAS} of positive metres or own",
        )
