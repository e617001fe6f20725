"""What the runs of a comparison left, read from their folders."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from edge_depth_nerf.base.bounds import finite
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json_object, write_json, write_text
from edge_depth_nerf.compare.methods import METHODS, MethodName
from edge_depth_nerf.compare.specification import FIGURES, OF_A_RUN, VIEWS


@dataclass
class RunResult:
    """A finished run."""

    folder: Path
    """Its folder."""
    specification: dict[str, Any]
    """What was trained: the fields of `RunSpecification`."""
    content: dict[str, Any]
    """Its figures.json."""

    @property
    def scene(self) -> str:
        """Name of the drive."""
        return Path(self.specification["scene"]).name

    @property
    def method(self) -> MethodName:
        """Name of the method."""
        return self.specification["method"]

    @property
    def seed(self) -> int:
        """Seed of the training."""
        return self.specification["seed"]

    @property
    def to_look_at(self) -> bool:
        """Whether its rendered views and its config.yml are there: all but the figures may be removed to save space."""
        return (self.folder / VIEWS).is_dir() and self.config is not None

    @property
    def config(self) -> Path | None:
        """Its config.yml, beside its checkpoints."""
        return next(self.folder.rglob("config.yml"), None)

    @property
    def figures(self) -> dict[str, float]:
        """Figures by name."""
        return self.content["figures"]

    @property
    def curve(self) -> list[dict[str, float]]:
        """Figures of the random pixels on the way: step, seconds, psnr and so on."""
        return self.content["curve"]


@dataclass
class Results:
    """All finished runs of a folder."""

    runs: list[RunResult]
    options: dict[str, Any] = field(default_factory=dict)
    """What all runs share."""
    versions: dict[str, str] = field(default_factory=dict)
    cores: int = 0

    @cached_property
    def _by_key(self) -> dict[tuple[str, MethodName, int], RunResult]:
        return {(run.scene, run.method, run.seed): run for run in self.runs}

    def scenes(self) -> list[str]:
        """Names of the drives, sorted."""
        return sorted({run.scene for run in self.runs})

    def methods(self) -> list[MethodName]:
        """Names of the methods, in the tables' order: ours comes last."""
        there = {run.method for run in self.runs}
        return sorted((name for name in METHODS if name in there), key=lambda name: name == "edge")

    def seeds(self) -> list[int]:
        """All seeds."""
        return sorted({run.seed for run in self.runs})

    def figure_names(self) -> set[str]:
        """Names of all figures that any run has."""
        return {name for run in self.runs for name in run.figures}

    def has(self, method: MethodName, seed: int) -> bool:
        """Whether any drive has a run of a method with a seed."""
        return any((scene, method, seed) in self._by_key for scene in self.scenes())

    def run(self, scene: str, method: MethodName, seed: int) -> RunResult | None:
        """One run, if it is there."""
        return self._by_key.get((scene, method, seed))

    def rows(self) -> list[dict[str, Any]]:
        """Tidy rows: scene, method, seed, metric, value."""
        return [
            {"scene": run.scene, "method": run.method, "seed": run.seed, "metric": metric, "value": value}
            for run in self.runs
            for metric, value in run.figures.items()
        ]


def read_results(runs: Path) -> Results:
    """Read the finished runs under a folder.

    Raises:
        InputError: a file of a run is broken, or of another form.
    """
    found = []
    for path in sorted(runs.glob(f"*/*/{FIGURES}")):
        content = read_json_object(path, "run", "named", "configuration", "figures", "curve", "steps")
        _check_run(content, path)
        for figures in (content["figures"], *content["curve"]):
            figures.update({name: float(value) for name, value in figures.items()})
        found.append(RunResult(path.parent, content["run"], content))
    return Results(sorted(found, key=lambda run: (run.scene, list(METHODS).index(run.method), run.seed)))


def _check_run(content: dict[str, Any], path: Path) -> None:
    run, curve = content["run"], content["curve"]
    fine = (
        isinstance(run, dict)
        and all(isinstance(run.get(key), str) for key in ("scene", "preset", "method"))
        and run["method"] in METHODS
        and isinstance(run.get("seed"), int)
        and isinstance(content["named"], list)
        and all(isinstance(name, str) for name in content["named"])
        and isinstance(content["configuration"], dict)
        and isinstance(content["steps"], int)
        and isinstance(curve, list)
        and all(_is_figures(figures) for figures in (content["figures"], *curve))
    )
    if not fine:
        raise InputError(
            f"{path}: is not a run of this version. Remove its folder; the same command then trains it again."
        )


def _is_figures(found: Any) -> bool:
    return isinstance(found, dict) and all(finite(value) is not None for value in found.values())


def check_fair(results: Results) -> None:
    """Make sure that runs differ in the fields that their methods name, and in no other.

    Raises:
        InputError: two runs differ otherwise: one is of another version of the program, or was tampered with.
    """
    firsts: dict[MethodName, RunResult] = {}
    for run in results.runs:
        first = firsts.setdefault(run.method, run)
        for other in (first, *firsts.values()):
            named = set() if other is first else {*run.content["named"], *other.content["named"]}
            ours, theirs = run.content["configuration"], other.content["configuration"]
            for name in sorted({*ours, *theirs} - named - {*OF_A_RUN}):
                if ours.get(name) != theirs.get(name):
                    raise InputError(
                        f"{run.folder}: its {name} is {ours.get(name)}, that of {other.folder} is {theirs.get(name)}. "
                        "Compared runs may differ only in the fields that their methods set; one was trained by "
                        "another version of this program. Remove its folder; the same command then trains it again."
                    )


def write_rows(output: Path, results: Results) -> None:
    """Write results.csv (tidy rows) and results.json (the same with options, versions, curves and bins)."""
    rows, text = results.rows(), io.StringIO()
    table = csv.DictWriter(text, ["scene", "method", "seed", "metric", "value"], lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_text(output / "results.csv", text.getvalue())
    left_out = ("figures", "configuration")
    runs = [{key: value for key, value in run.content.items() if key not in left_out} for run in results.runs]
    shared = {"options": results.options, "versions": results.versions, "cores": results.cores}
    write_json(output / "results.json", {**shared, "rows": rows, "runs": runs})
