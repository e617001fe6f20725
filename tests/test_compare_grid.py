"""The grid of losses, priors and extras: its cells, its searches and its tables; nothing is trained."""

import math
from dataclasses import asdict, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from comparisons import QUIET, differing, fake, resolved
from scenes import write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.compare import command
from edge_depth_nerf.compare.grid import grid, grid_tables
from edge_depth_nerf.compare.methods import (
    GRID,
    LOSS_TITLES,
    METHODS,
    RIVALS,
    SIGMA_FIELDS,
    WITHOUT_EXTRAS,
    Method,
    MethodName,
    Sigma,
    default_methods,
)
from edge_depth_nerf.compare.options import GridOptions
from edge_depth_nerf.compare.results import Results
from edge_depth_nerf.compare.search import Grid

SOURCE, LOSS = "pipeline.datamanager.depth_source", "pipeline.model.depth_loss"
WITH_LOSS: list[MethodName] = [name for cell, name in GRID.items() if cell.loss != "none"]
LAMBDAS = (0.001, 0.01, 0.1, 1.0)
SIGMAS_M: tuple[Sigma, ...] = ("own", 0.1, 2.0)


def test_the_grid_has_each_loss_with_each_prior_without_and_with_extras():
    wanted = {
        Method(loss, None if loss == "none" and not extras else prior, extras)
        for loss in LOSS_TITLES
        for prior in ("lidar", "integrated")
        for extras in (False, True)
    }
    assert set(GRID) == wanted and len(GRID) == 4 * len(LOSS_TITLES) - 1
    assert {"nerfacto-lidar-extras", "edge-plain", "ds-nerf-extras"} < {*GRID.values()} - {*default_methods("lite")}
    assert {"nerfacto", "ds-nerf", "edge-lidar", "edge"} < set(GRID.values())


def test_cells_that_differ_in_one_thing_differ_in_its_fields_alone():
    """As long as λ and σ are the defaults; those are searched for each."""
    settings = {"pipeline.model.depth_loss_mult", *(SIGMA_FIELDS[loss] for loss in RIVALS)}
    seen = {"prior": 0, "extras": 0, "loss": 0}
    for (one, first), (other, second) in combinations(GRID.items(), 2):
        found = {*differing(resolved(first), resolved(second))}
        if (one.loss, one.extras) == (other.loss, other.extras):
            assert found == {SOURCE}
            seen["prior"] += 1
        elif (one.loss, one.prior) == (other.loss, other.prior):
            assert found == {*WITHOUT_EXTRAS}
            seen["extras"] += 1
        elif (one.prior, one.extras) == (other.prior, other.extras):
            # without a loss λ is 0, and the prior serves the extras alone
            assert found <= {LOSS, *settings} and found & {LOSS, "pipeline.model.depth_loss_mult"}
            seen["loss"] += 1
    losses = len(LOSS_TITLES)
    pairs_of_losses = 2 * math.comb(losses, 2) + 2 * math.comb(losses - 1, 2)
    assert seen == {"prior": 2 * losses - 1, "extras": 2 * (losses - 1), "loss": pairs_of_losses}


def psnr_of(name: MethodName, scene: str) -> float:
    """A made-up figure: 20 dB, 0.5 for the integrated prior, the loss's, 2 for extras, and 1 on the turn."""
    cell = METHODS[name]
    loss = {"none": 0.0, "ds-nerf": 1.0, "edge": 1.25}.get(cell.loss, 0.75)
    return 20 + loss + 0.5 * (cell.prior == "integrated") + 2.0 * cell.extras + (scene == "turn")


def finished(scene, name, seed=0):
    psnr = psnr_of(name, scene)
    return fake(scene, name, seed, psnr, truth_abs_rel=0.1 * 0.5 ** METHODS[name].extras)


EVERY_CELL = tuple(GRID.values())


def evaluated(names=EVERY_CELL, scenes=("street", "turn")):
    return Results([finished(scene, name) for scene in scenes for name in names])


def searched(count=12):
    pairs = {(0.01 * 10**place, sigma): 20.0 for place in range(count // 3) for sigma in ("own", 0.1, 0.5)}
    best = (0.1, 0.1)
    lambdas, sigmas = sorted({weight for weight, _ in pairs}), [0.05, 0.1, 0.5, "own"]
    return [Grid(name, lambdas, sigmas, {**pairs, best: 21.0}) for name in WITH_LOSS]


def test_the_tables_say_what_each_is_worth_by_hand():
    made = {table.label: table for table in grid_tables(evaluated(), searched())}
    assert [*made] == ["G1", "G2", "G3", "G4", "G5"]
    assert [group for group, _ in made["G1"].headings()][::2] == ["street", "turn", "average"]

    def cells(label, title):
        return [cell.text() for row in made[label].rows if row.title == title for cell in row.cells]

    # everything but the loss is worth the same everywhere
    assert cells("G1", "edge loss, with extras") == ["+0.50", "1.00"] * 3 == cells("G1", "mean")
    assert "no depth loss, without extras" not in {row.title for row in made["G1"].rows}
    assert cells("G2", "LiDAR, without extras: DS-NeRF loss over none") == ["+1.00", "1.00"] * 3
    # nerfacto has no prior, so half a decibel comes with it
    assert cells("G2", "integrated, without extras: edge loss over none") == ["+1.75", "1.00"] * 3
    title = "integrated, with extras: edge loss over DS-NeRF loss, the best other"
    assert cells("G2", title) == ["+0.25", "1.00"] * 3
    assert cells("G2", "mean of the edge loss over the best other") == ["+0.25", "1.00"] * 3
    assert cells("G3", "edge loss, LiDAR") == ["+2.00", "0.50"] * 3
    assert cells("G3", "no depth loss, LiDAR") == ["+2.00", "0.50"] * 3
    assert cells("G4", "over nerfacto") == ["+3.75", "0.50"] * 3
    rival = "over the best rival without extras, DS-NeRF loss, integrated, without extras"
    assert cells("G4", rival) == ["+2.25", "0.50"] * 3
    assert cells("G4", "over the best rival of all, DS-NeRF loss, integrated, with extras") == ["+0.25", "1.00"] * 3
    assert cells("G5", "edge loss, integrated, with extras")[:2] == ["23.75", "0.050"]
    assert cells("G5", "edge loss, integrated, with extras")[-3:] == ["0.1", "0.1", "12"]
    assert cells("G5", "no depth loss, LiDAR, with extras")[-3:] == ["–", "–", "–"]
    assert len(made["G5"].rows) == len(GRID) and "unequal" not in made["G5"].caption


def test_a_part_of_the_grid_has_the_tables_that_it_is_enough_for():
    made = grid_tables(evaluated(("nerfacto", "ds-nerf", "edge-lidar-plain"), ("street",)), searched())
    assert [table.label for table in made] == ["G2", "G5"]
    titles = ["DS-NeRF loss over none", "edge loss over none", "edge loss over DS-NeRF loss, the best other"]
    assert [row.title.partition(": ")[2] for row in made[0].rows] == titles


def test_searches_of_unequal_length_are_said_to_be():
    searches = searched()
    searches[0] = searched(15)[0]
    assert "have different sizes" in grid_tables(evaluated(), searches)[-1].caption


@pytest.fixture
def made_up(monkeypatch):
    """Training replaced by formulas: every cell has its own best λ and σ. Gives the runs that were done."""
    done = []

    def train(runs, options, console):
        for run in runs:
            spec = run.specification
            if len(done) in stops:
                stops.clear()
                raise KeyboardInterrupt
            done.append(run)
            result = finished(Path(spec.scene).name, spec.method, spec.seed)
            if not spec.whole_views:
                assert isinstance(spec.weight, float)
                sigma = 0.5 if spec.sigma_m == "own" else spec.sigma_m
                best = best_of(spec.method)
                off = abs(math.log(spec.weight / best[0])) + abs(math.log(sigma / best[1]))
                # of the other drive alone σ would be another
                off += {"tune_a": 0.0, "tune_b": 1.5 * (sigma == 2.0)}[Path(spec.scene).name]
                result.figures["pixels_truth_psnr"] = 30 - off
            result.content["lambda"], result.content["sigma"] = spec.weight, spec.sigma_m
            write_json(run.folder / "figures.json", {**result.content, "run": asdict(spec)})

    stops: set[int] = set()
    monkeypatch.setattr(command, "do_runs", train)
    # plots of all cells take as long as all else
    monkeypatch.setattr(command, "draw_plots", lambda output, results: [])
    return done, stops


def best_of(name):
    return {"edge": (0.1, 0.5), "ds-nerf": (1.0, 0.1)}.get(name, (0.01, 2.0))


def asked(folder: Path, **changes):
    scenes = {name: folder / name for name in ("street", "turn", "tune_a", "tune_b")}
    for scene in scenes.values():
        if not scene.is_dir():
            write_scene(scene)
    drives = {"scenes": (scenes["street"], scenes["turn"]), "tuning": (scenes["tune_a"], scenes["tune_b"])}
    given: dict[str, Any] = {"lambdas": LAMBDAS, "sigmas_m": SIGMAS_M, "output": folder / "out", "steps": 5, **drives}
    return GridOptions(**given | changes)


@pytest.mark.slow
def test_a_grid_searches_every_cell_alike_and_goes_on_where_it_was(tmp_path, made_up):
    done, stops = made_up
    options = asked(tmp_path)
    searches, evaluations = len(WITH_LOSS) * len(LAMBDAS) * len(SIGMAS_M) * 2, len(GRID) * 2
    # stopped in the search, and in the comparison
    stops.add(50)
    with pytest.raises(KeyboardInterrupt):
        grid(options, QUIET)
    assert len(done) == 50
    stops.add(searches + 3)
    with pytest.raises(KeyboardInterrupt):
        grid(options, QUIET)
    results = grid(options, QUIET)
    assert len(done) == searches + evaluations == len({run.folder for run in done})
    assert len(results.runs) == evaluations and results.scenes() == ["street", "turn"]
    grid(options, QUIET)
    assert len(done) == searches + evaluations

    tries: dict[str, set] = {name: set() for name in WITH_LOSS}
    for run in done:
        spec = run.specification
        assert spec.steps == 5
        if not spec.whole_views:
            tries[spec.method].add((Path(spec.scene).name, spec.weight, spec.sigma_m))
        else:
            assert Path(spec.scene).name in ("street", "turn")
    every = {(scene, weight, sigma) for scene in ("tune_a", "tune_b") for weight in LAMBDAS for sigma in SIGMAS_M}
    assert set(map(frozenset, tries.values())) == {frozenset(every)}

    tuned = read_json(options.output / "search" / "tuned.json")
    assert tuned["scenes"] == sorted(map(str, options.tuning)) and set(tuned["methods"]) == set(WITH_LOSS)
    assert tuned["methods"]["ds-nerf"]["lambda"] == 1.0 and tuned["methods"]["ds-nerf"]["sigma_m"] == 0.1
    assert tuned["methods"]["edge"] == {"lambda": 0.1, "sigma_m": "own", "psnr": 30.0}
    # one drive alone would have 2 m, at 30 dB; of both that is 29.25, and 0.5 m is 28.61
    assert tuned["methods"]["edge-plain"] == {"lambda": 0.01, "sigma_m": 2.0, "psnr": 29.25}
    evaluated_with = {run.specification.method: run.specification for run in done if run.specification.whole_views}
    for name in WITH_LOSS:
        found = tuned["methods"][name]
        assert (evaluated_with[name].weight, evaluated_with[name].sigma_m) == (found["lambda"], found["sigma_m"])
    assert evaluated_with["nerfacto"].weight is None and evaluated_with["nerfacto-lidar-extras"].weight is None

    text = (options.output / "grid.md").read_text(encoding="utf-8")
    places = [text.index(f"What {words} worth") for words in ("the prior is", "the loss is", "the extras are")]
    assert places == sorted(places) and places[-1] < text.index("What the whole is worth")
    assert "on tune_a and tune_b" in text and "tune_a" in (options.output / "comparison" / "tables.md").read_text()
    # a finer search comes too late for what was evaluated with another
    with pytest.raises(InputError, match="this run was started with"):
        grid(replace(options, sigmas_m=(1.5, *SIGMAS_M)), QUIET)


def test_a_grid_that_cannot_be(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "do_runs", lambda *_: pytest.fail("started"))
    options = asked(tmp_path)

    def refused(message, **changes):
        with pytest.raises(InputError, match=message):
            grid(replace(options, **changes), QUIET)
        assert changes.get("output") or not options.output.exists()

    refused("--tuning: expected at least one scene", tuning=())
    refused("other drives than those that are evaluated", tuning=(*options.tuning, tmp_path / "street"))
    refused("paper has no extras", preset="paper")
    refused("at least 4", lambdas=(1.0, 2.0))
    refused("--methods edge-mono: expected cells", methods=("edge", "edge-mono"))
    refused("--methods nerfacto: expected at least one that has a loss", methods=("nerfacto",))
    refused("no monocular maps", scenes=(write_scene(tmp_path / "bare", mono=False),))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    refused("contains other files", output=tmp_path / "full")
