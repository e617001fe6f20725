"""The search for weights: its folders and what it writes."""

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from comparisons import QUIET, fake
from scenes import write_scene

from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.compare import command, search
from edge_depth_nerf.compare.methods import Setting
from edge_depth_nerf.compare.options import SearchOptions
from edge_depth_nerf.compare.specification import RunSpecification


def test_folders_of_runs_say_their_setting(tmp_path):
    """As far as they have one."""
    nerfacto = RunSpecification("/x/street", "0", "lite", "nerfacto", 3, 10)
    searched = replace(nerfacto, whole_views=False, method="ds-nerf", weight=0.01, sigma_m="own")
    names = [command.Run(each, tmp_path).folder.relative_to(tmp_path) for each in (nerfacto, searched)]
    assert names == [Path("street/nerfacto_seed-3"), Path("street/ds-nerf_lambda-0.01_sigma-own_seed-3")]


def test_a_search_writes_what_compare_takes(tmp_path, monkeypatch):
    """Training is replaced by a formula: best at λ = 0.1 and σ = 0.5 m for ds-nerf, λ = 1 and its own σ for edge."""

    def train(runs, options, console):
        for run in runs:
            spec = run.specification
            assert not spec.whole_views
            sigma = 3.0 if spec.sigma_m == "own" else spec.sigma_m
            assert isinstance(sigma, float)
            best = {"ds-nerf": (0.1, 0.5), "edge": (1.0, 3.0)}[spec.method]
            assert spec.weight is not None
            loss = abs(math.log(spec.weight / best[0])) + abs(math.log(sigma / best[1]))
            result = fake("x", spec.method, spec.seed, pixels_truth_psnr=30 - loss)
            write_json(run.folder / "figures.json", {**result.content, "run": asdict(spec)})

    monkeypatch.setattr(command, "do_runs", train)
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    tried: dict[str, Any] = {"lambdas": (0.01, 0.1, 0.3, 1.0), "sigmas_m": ("own", 0.1, 0.5, 2.0)}
    asked = SearchOptions(scenes=(scene,), output=output, seeds=(7,), methods=("ds-nerf", "edge"), **tried)
    found = search.search(asked, QUIET)
    assert len(found.runs) == 2 * 4 * 4
    tuned = read_json(output / "tuned.json")
    assert tuned["scenes"] == [str(scene)] and tuned["seed"] == 7
    assert tuned["methods"]["ds-nerf"] == {"lambda": 0.1, "sigma_m": 0.5, "psnr": 30.0}
    assert tuned["methods"]["edge"]["lambda"] == 1.0 and tuned["methods"]["edge"]["sigma_m"] == "own"
    ds_nerf, ours = search.grids(found)
    assert ds_nerf.at_the_edge == [] and ours.at_the_edge == ["λ"]
    text = (output / "search.md").read_text()
    assert "| | σ 0.1 m | σ 0.5 m | σ 2 m | σ its own |" in text and "| λ 0.01 |" in text
    assert "**30.00**" in text and "best λ is at an end" in text
    read = command.read_tuned(output / "tuned.json")
    assert read == {"ds-nerf": Setting(0.1, 0.5), "edge": Setting(1.0, "own")}
    # more values come to those that are there
    assert len(search.search(replace(asked, lambdas=(0.01, 0.1, 0.3, 3.0)), QUIET).runs) == 2 * 5 * 4
    # seeds do not compete with each other: those count that most values have
    first, more = (0.01, 0.1, 0.3, 1.0, 3.0), (0.1, 5.0, 6.0, 7.0)
    every = tuple(sorted({*first, *more}))
    for seed, lambdas, counts, of in ((8, more, (7,), first), (8, first, (8,), every), (7, more, (7, 8), every)):
        found = search.search(replace(asked, seeds=(seed,), lambdas=lambdas), QUIET)
        assert {(grid.seeds, *grid.lambdas) for grid in search.grids(found)} == {(counts, *of)}
    assert "x, seeds 7, 8, preset" in (output / "search.md").read_text()
    assert read_json(output / "tuned.json")["seed"] == [7, 8]
