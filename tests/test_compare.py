"""Comparisons: configurations field by field, figures and tables by hand, and the command once for real."""

from __future__ import annotations

import csv
import html
import json
import math
import re
import shutil
import statistics
import subprocess
import sys
import time
from copy import deepcopy
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils.eval_utils import eval_setup
from rich.console import Console
from scenes import copy_sample_drive, write_scene
from test_pipeline import build

from edge_depth_nerf.compare import command, search, tables
from edge_depth_nerf.compare.configuration import (
    REGISTERED,
    configuration,
    described,
    flattened,
    literal_form,
    setting_of,
)
from edge_depth_nerf.compare.figures import BinnedErrors, affine_fitted
from edge_depth_nerf.compare.judging import choose_pixels, judge_pixels, shifted_views
from edge_depth_nerf.compare.methods import Setting, default_methods
from edge_depth_nerf.compare.options import CompareOptions, Preset
from edge_depth_nerf.compare.protocol import departures
from edge_depth_nerf.compare.results import Results, RunResult, check_fair
from edge_depth_nerf.compare.specification import OF_A_RUN, RunSpecification
from edge_depth_nerf.config import make_specifications, read_method_file
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_image, read_json, write_json

QUIET = Console(quiet=True)


# --- configurations ---------------------------------------------------------------------------------------------------


def resolved(method, preset: Preset = "lite", **changes):
    run = RunSpecification(scene="/scenes/a", scene_sha256="", preset=preset, method=method, seed=0, steps=10)
    return flattened(configuration(replace(run, **changes))[0])


def differing(one, other):
    return {name: (one[name], other[name]) for name in one if repr(one[name]) != repr(other[name])}


LOSS, SOURCE = "pipeline.model.depth_loss", "pipeline.datamanager.depth_source"
RIVAL = {LOSS, SOURCE, "pipeline.model.depth_loss_mult", "pipeline.model.depth_sigma", LOSS + "_final"}
ALLOWED = {
    "nerfacto": {LOSS, SOURCE},
    "nerfacto-embedding": {LOSS, SOURCE, "pipeline.model.exposure"},
    "urban-nerf": RIVAL,
    "ds-nerf": RIVAL,
    "edge-lidar": {SOURCE},
    "edge-mono": {SOURCE},
    "edge-gaussian": {"pipeline.datamanager.integration"},
    "edge": set(),
}


@pytest.mark.parametrize("preset", ["lite", "full", "paper"])
@pytest.mark.parametrize("method", ALLOWED)
def test_configurations_differ_in_the_named_fields_alone(preset, method):
    ours, other = resolved("edge", preset), resolved(method, preset)
    assert set(ours) == set(other) and len(ours) > 100
    assert set(differing(ours, other)) <= ALLOWED[method]


def test_each_method_is_what_its_name_says():
    def loss_and_source(method):
        found = resolved(method)
        return found[LOSS], found[SOURCE], found["pipeline.datamanager.integration"]

    assert loss_and_source("nerfacto")[0] == loss_and_source("nerfacto-embedding")[0] == "none"
    exposures = {method: resolved(method)["pipeline.model.exposure"] for method in ALLOWED}
    assert {name for name, exposure in exposures.items() if exposure == "embedding"} == {"nerfacto-embedding"}
    # nerfstudio's losses keep their weight
    assert {resolved(method)[LOSS + "_final"] for method in ("urban-nerf", "ds-nerf")} == {1.0}
    assert loss_and_source("urban-nerf") == ("urban-nerf", "lidar", "edge-aware")
    assert loss_and_source("ds-nerf") == ("ds-nerf", "lidar", "edge-aware")
    assert loss_and_source("edge-lidar") == ("edge", "lidar", "edge-aware")
    assert loss_and_source("edge-mono") == ("edge", "mono", "edge-aware")
    assert loss_and_source("edge-gaussian") == ("edge", "integrated", "spatial-gaussian")
    assert loss_and_source("edge") == loss_and_source("edge-paper") == ("edge", "integrated", "edge-aware")


@pytest.mark.parametrize("preset", ["lite", "full"])
def test_the_literal_method_is_the_registered_one_in_another_size(preset):
    ours, literal = resolved("edge", preset), resolved("edge-paper", preset)
    paper = flattened(make_specifications(read_method_file())[REGISTERED["paper"]].config)
    changed = differing(ours, literal)
    assert {"pipeline.datamanager.sigma_mode", "pipeline.datamanager.align", LOSS + "_mult"} <= set(changed)
    assert set(changed) <= {*literal_form()}
    for name in changed:
        assert literal[name] == paper[name], name


def test_the_paper_has_the_size_of_full():
    presets = read_method_file()["presets"]
    assert {**presets["paper"], **presets["full"]} == presets["paper"]
    assert not [name for name in literal_form() if not name.startswith(("pipeline.model.", "pipeline.datamanager."))]


def test_under_the_preset_paper_edge_is_the_literal_method():
    literal, ours = resolved("edge-paper", "full"), resolved("edge", "paper")
    assert set(differing(literal, ours)) <= {"method_name"}
    assert "edge-paper" not in default_methods("paper") and "edge-paper" in default_methods("lite")


def test_only_seed_scene_and_folder_are_a_runs_own():
    one = flattened(configuration(RunSpecification("/s/a", "", "lite", "edge", 0, 9), Path("/o/a/edge_seed-0"))[0])
    two = flattened(configuration(RunSpecification("/s/b", "", "lite", "edge", 1, 9), Path("/o/b/edge_seed-1"))[0])
    assert set(differing(one, two)) == {*OF_A_RUN}


def test_a_configuration_reads_the_same_in_every_process():
    words = described(configuration(RunSpecification("/s/a", "", "lite", "edge", 0, 9))[0])
    assert words["pipeline.datamanager.collate_fn"] == "nerfstudio_collate"
    assert not [name for name, word in words.items() if " at 0x" in word]


def test_lambda_and_sigma_go_where_each_method_has_them():
    rival = resolved("ds-nerf", weight=0.07, sigma_m=0.2)
    assert (rival["pipeline.model.depth_loss_mult"], rival["pipeline.model.depth_sigma"]) == (0.07, 0.2)
    assert set(differing(rival, resolved("ds-nerf"))) == {LOSS + "_mult", "pipeline.model.depth_sigma"}
    ours = resolved("edge", weight=0.07, sigma_m=0.2)
    data = "pipeline.datamanager."
    assert (ours[data + "sigma_mode"], ours[data + "sigma_constant"]) == ("constant", 0.2)
    own = resolved("edge", weight=0.07, sigma_m="own")
    assert set(differing(own, resolved("edge"))) == {LOSS + "_mult"}

    def setting(method, **changes):
        run = RunSpecification("/s/a", "", "lite", method, 0, 9, **changes)
        return setting_of(configuration(run)[0], method)

    assert setting("ds-nerf", weight=0.07, sigma_m=0.2) == (0.07, 0.2)
    assert setting("edge", weight=0.07, sigma_m=0.2) == (0.07, 0.2)
    assert setting("edge", weight=0.07, sigma_m="own") == (0.07, "calibrated")
    assert setting("nerfacto") == (None, None)


def test_rivals_in_torch_change_nothing_else():
    assert set(differing(resolved("ds-nerf", implementation="torch"), resolved("ds-nerf"))) == {
        "pipeline.model.implementation"
    }


# --- figures ----------------------------------------------------------------------------------------------------------


def test_a_colour_fit_takes_out_gain_offset_and_tint():
    generator = torch.Generator().manual_seed(0)
    target = 0.3 + 0.4 * torch.rand(20, 30, 3, generator=generator)
    mixing = torch.tensor([[0.8, 0.1, 0.0], [0.0, 0.7, 0.1], [0.1, 0.0, 0.9]])
    mask = torch.ones(20, 30, dtype=torch.bool)
    mask[:, :4] = False
    pred = target @ mixing + 0.05
    pred[~mask] = 0.9  # what is outside has no part in the fit
    fitted = affine_fitted(pred, target, mask)
    assert torch.allclose(fitted[mask], target[mask], atol=1e-5)
    noisy = (target + 0.1 * torch.randn(target.shape, generator=generator)).clamp(0, 1)
    design = np.concatenate([noisy[mask].numpy(), np.ones((int(mask.sum()), 1))], axis=1)
    best, *_ = np.linalg.lstsq(design, target[mask].numpy(), rcond=None)
    assert np.allclose(affine_fitted(noisy, target, mask)[mask].numpy(), np.clip(design @ best, 0, 1), atol=1e-5)
    flat = torch.full_like(target, 0.5)  # one colour: as good as a mean
    mean = target[mask].mean(0)
    assert torch.allclose(affine_fitted(flat, target, mask)[mask], mean.expand(int(mask.sum()), 3), atol=1e-4)


def test_binned_errors_are_pooled_over_pictures():
    rng = np.random.default_rng(0)
    edges = (0.0, 10.0, 20.0, 40.0)
    binned = BinnedErrors(edges)
    pixels = {index: ([], [], []) for index in range(3)}
    for _ in range(2):
        values = rng.uniform(-5, 45, (6, 7))
        values[0, 0] = np.nan
        mask = rng.random((6, 7)) < 0.8
        pred, target = rng.random((2, 6, 7, 3)).astype(np.float32)
        pred_m = rng.uniform(1, 80, (6, 7)).astype(np.float32)
        true_m = np.where(rng.random((6, 7)) < 0.3, 0, rng.uniform(0.5, 90, (6, 7))).astype(np.float32)
        arrays = (torch.from_numpy(array) for array in (pred, target, pred_m, true_m))
        binned.update(torch.from_numpy(values.astype(np.float32)), torch.from_numpy(mask), *arrays)
        for row, column in zip(*np.nonzero(mask), strict=True):
            for index, (low, high) in enumerate(pairwise(edges)):
                if low <= np.float32(values[row, column]) < high:
                    pixels[index][0].append(((pred[row, column] - target[row, column]) ** 2).mean())
                    true = true_m[row, column]
                    if 1 <= true <= 60:
                        pixels[index][1].append(abs(pred_m[row, column] - true) / true)
                        pixels[index][2].append(max(pred_m[row, column] / true, true / pred_m[row, column]) < 1.25)
    found = binned.compute()
    assert [entry["low"] for entry in found] == [0, 10, 20]
    for index, entry in enumerate(found):
        squared, relative, within = pixels[index]
        assert entry["pixels"] == len(squared)
        assert entry["psnr"] == pytest.approx(-10 * math.log10(np.mean(squared)), abs=1e-4)
        assert entry["abs_rel"] == pytest.approx(np.mean(relative), abs=1e-5)
        assert entry["delta_1_25"] == pytest.approx(np.mean(within), abs=1e-9)


# --- judging ----------------------------------------------------------------------------------------------------------


def test_judging_leaves_no_trace_in_a_training(tmp_path):
    pipeline, _ = build(write_scene(tmp_path), depth_loss="edge", num_proposal_samples_per_ray=(8, 8))
    pipeline.datamanager.train_pixel_sampler.set_num_rays_per_batch(32)
    start = deepcopy(pipeline.state_dict())
    chosen = choose_pixels(pipeline.datamanager.eval_dataset)
    ends, figures = [], []
    for judged in (False, True):
        pipeline.load_state_dict(start)
        pipeline.datamanager.train_pixel_sampler._drawn = pipeline.datamanager._surface_sampler._drawn = 0
        sampler = pipeline.model.proposal_sampler
        sampler._steps_since_update, sampler._step = 0, 0
        config = make_specifications(read_method_file())["edge-depth-nerf-lite"].config
        optimisers = Optimizers(deepcopy(config.optimizers), pipeline.get_param_groups())
        torch.manual_seed(0)
        pipeline.train()
        for step in range(16):
            sampler.set_anneal(0.5)
            sampler.step_cb(step)
            optimisers.zero_grad_all()
            torch.stack(list(pipeline.get_train_loss_dict(0)[1].values())).sum().backward()
            optimisers.optimizer_step_all()
            if judged and step in (11, 12, 13):
                figures.append(judge_pixels(pipeline, chosen))
                assert pipeline.model.training
        ends.append(deepcopy(pipeline.state_dict()))
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    assert {"psnr", "truth_psnr", "lidar_abs_rel", "truth_abs_rel"} <= set(figures[0])
    assert figures[0] != figures[-1]


def test_the_pixels_are_always_the_same_and_inside_the_mask(tmp_path):
    pipeline, _ = build(write_scene(tmp_path))
    dataset = pipeline.datamanager.eval_dataset
    one, other = choose_pixels(dataset, most=40), choose_pixels(dataset, most=40)
    assert torch.equal(one[0].indices, other[0].indices)
    assert len(one) == len(dataset) and len(one[0].indices) == 40 // len(dataset)
    for view, chosen in enumerate(one):
        index, row, column = chosen.indices.T
        assert (index == view).all() and dataset.mask(view)[row, column].all()
        assert torch.equal(chosen.known["image"], dataset[view]["image"][row, column])


def test_shifted_views_stand_where_the_scene_says(tmp_path):
    scene = write_scene(tmp_path)
    meta = read_json(scene / "transforms.json")
    for frame in meta["frames"]:
        frame["camera"] = "only"
    held_out = next(frame for frame in meta["frames"] if frame["file_path"] == meta["test_filenames"][0])
    moved = np.array(held_out["transform_matrix"])
    moved[:3, 3] += [0.3, -0.2, 0.1]
    files = {key: held_out[key] for key in ("truth_rgb_file_path", "truth_distance_file_path")}
    meta["shifted_views"] = {
        "0": [{"camera": "only", "transform_matrix": held_out["transform_matrix"], **files}],
        "1": [
            {"camera": "only", "transform_matrix": moved.tolist(), **files},
            {"camera": "none there", "transform_matrix": moved.tolist(), **files},
        ],
    }
    write_json(scene / "transforms.json", meta)
    pipeline, _ = build(scene)
    dataset = pipeline.datamanager.eval_dataset
    views = shifted_views(scene, dataset)
    assert [len(views[metres]) for metres in ("0", "1")] == [1, 1]
    same, beside = (views[metres][0]() for metres in ("0", "1"))
    assert torch.allclose(same.camera.camera_to_worlds[0], dataset.cameras[0].camera_to_worlds, atol=1e-6)
    offset = beside.camera.camera_to_worlds[0, :, 3] - dataset.cameras[0].camera_to_worlds[:, 3]
    metres = offset.norm() * dataset.metadata["metres_per_unit"]
    assert float(metres) == pytest.approx(np.linalg.norm([0.3, -0.2, 0.1]), abs=1e-5)
    assert same.batch["image"].shape == (28, 32, 3) and same.batch["mask"].shape == (28, 32, 1)
    assert (same.batch["truth_distance_m"] > 0).any()


# --- tables -----------------------------------------------------------------------------------------------------------


def fake(scene, method, seed, psnr=20.0, steps=100, seconds=10.0, named=(), **more):
    figures = {"truth_masked_psnr": psnr, "truth_masked_ssim": psnr / 40, "truth_abs_rel": 1 / psnr, **more}
    curve = [
        {"step": steps * share, "seconds": seconds * share, "cpu_seconds": seconds * share, "truth_psnr": psnr * share}
        for share in (0.5, 1.0)
    ]
    content = {
        "run": {"scene": f"/scenes/{scene}", "method": method, "seed": seed, "implementation": "same"},
        "named": list(named),
        "configuration": {"a": "1", "machine.seed": str(seed)},
        "lambda": None if method == "nerfacto" else 0.01,
        "sigma": None if method == "nerfacto" else 0.5,
        "steps": steps,
        "device": "cpu",
        "source": "kitti360",
        "departures": [],
        "figures": figures,
        "curve": curve,
    }
    return RunResult(Path(f"/runs/{scene}/{method}_seed-{seed}"), content["run"], content)


PSNR_OF = {
    ("street", "nerfacto"): (20.0, 21.0, 22.5),
    ("turn", "nerfacto"): (24.0, 23.0, 25.0),
    ("street", "edge"): (23.0, 24.5, 24.0),
    ("turn", "edge"): (25.0, 26.0, 27.5),
    ("street", "ds-nerf"): (22.0, 22.0, 22.0),
    ("turn", "ds-nerf"): (28.0, 25.0, 25.0),
}


@pytest.fixture
def results():
    runs = [
        fake(scene, method, seed, psnr)
        for (scene, method), figures in PSNR_OF.items()
        for seed, psnr in enumerate(figures)
    ]
    return Results(runs, {"preset": "lite", "tuned": {}}, {"nerfstudio": "1.1.5"}, 2)


def table(results, label):
    return next(made for made in tables.make_tables(results) if made.label == label)


def test_where_the_weights_come_from(results):
    results.options |= {"tuned": {"ds-nerf": {}}, "tuned_on": "/scenes/tuning"}
    made = table(results, "7")
    assert [row.cells[2].text() for row in made.rows] == ["–", "searched", "default"]
    assert "Searched on tuning." in made.notes and "flatter" not in made.caption
    results.options["tuned_on"] = "/scenes/street"
    made = table(results, "7")
    assert "Searched on street." in made.notes and "flatter" in made.caption
    results.options["tuned_on"] = 7  # a file written by hand
    assert "Searched on 7." in table(results, "7").notes


def test_table_1_by_hand(results):
    made = table(results, "1")
    headings = made.headings()
    assert headings[0] == ("street", "PSNR ↑") and headings[2] == ("turn", "PSNR ↑")
    assert headings[4] == ("average", "PSNR ↑") and headings[-2:] == [("ours ahead", "dB"), ("ours ahead", "paper, dB")]
    assert [row.title for row in made.rows] == ["nerfacto", "DS-NeRF loss", "ours"]
    nerfacto, ds_nerf, ours = made.rows
    # street, nerfacto: mean of 20, 21, 22.5 = 21.1667; deviation sqrt((1.3611 + 0.0278 + 1.7778) / 2) = 1.2583
    assert nerfacto.cells[0].text() == "21.17 ± 1.26"
    # average by seed: (20 + 24) / 2, (21 + 23) / 2, (22.5 + 25) / 2 = 22, 22, 23.75
    assert nerfacto.cells[4].text() == "22.58 ± 1.01"
    # ours by seed: 24, 25.25, 25.75; ahead by 2, 3.25, 2
    assert nerfacto.cells[-2].text() == f"{7.25 / 3:+.2f} ± {statistics.stdev([2, 3.25, 2]):.2f}"
    assert nerfacto.cells[-1].text() == "+0.65" and ds_nerf.cells[-1].text() == "+0.44"
    assert ours.cells[-1].text() == ours.cells[-2].text() == "–"
    assert [row.cells[0].best for row in made.rows] == [False, False, True]
    assert [row.cells[2].best for row in made.rows] == [False, False, True]  # 24, 26, 26.17
    assert "averages do not follow" in made.caption


def test_one_seed_has_no_spread_and_one_drive_no_average(results):
    results.runs = [run for run in results.runs if run.seed == 1 and run.scene == "turn"]
    made = table(results, "1")
    assert made.rows[0].cells[0].text() == "23.00"
    assert {group for group, _ in made.headings()} == {"turn", "ours ahead"}


def test_a_seed_that_a_drive_lacks_is_left_out_of_the_average(results):
    results.runs = [run for run in results.runs if (run.scene, run.method, run.seed) != ("turn", "nerfacto", 2)]
    nerfacto = table(results, "1").rows[0]
    assert nerfacto.cells[4].text() == "22.00 ± 0.00"
    assert nerfacto.cells[-2].text() == f"{5.25 / 2:+.2f} ± {statistics.stdev([2, 3.25]):.2f}"


def test_tables_2_to_4_are_of_their_methods(results):
    assert not [made for made in tables.make_tables(results) if made.label in ("2", "3", "4")]
    results.runs += [
        fake("street", method, 0, psnr)
        for method, psnr in (("edge-lidar", 23.5), ("edge-mono", 22.0), ("edge-gaussian", 23.004))
    ]
    results.runs += [fake("garage", method, 0, 30.0) for method in ("nerfacto", "ds-nerf", "edge")]
    for run in results.runs[-3:]:
        run.content["source"] = "jbnu-depth360"
    results = Results(results.runs, results.options, results.versions, 2)
    jbnu = table(results, "2")
    assert {group for group, _ in jbnu.headings()} == {"garage", "ours ahead"}
    assert [row.cells[-1].text() for row in jbnu.rows] == ["+0.12", "+0.04", "–"]
    assert "garage" not in {group for group, _ in table(results, "1").headings()}
    third = table(results, "3")
    assert [row.title for row in third.rows] == ["LiDAR alone", "monocular alone", "ours"]
    assert "row of DS-NeRF" in third.caption
    fourth = table(results, "4")
    column = fourth.headings().index(("street", "PSNR ↑"))
    assert [row.cells[column].text() for row in fourth.rows] == ["23.00", "23.83 ± 0.76"]


def test_without_truth_everywhere_figures_are_against_the_pictures(results):
    results.runs[0].figures["masked_psnr"] = 17.0
    del results.runs[0].figures["truth_masked_psnr"]
    assert tables.psnr_metric(results).name == "masked_psnr"


CURVE = [
    {"step": 10.0, "seconds": 1.0, "psnr": 10.0},
    {"step": 20.0, "seconds": 3.0, "psnr": 16.0},
    {"step": 40.0, "seconds": 7.0, "psnr": 18.0},
]


@pytest.mark.parametrize(
    ("seconds", "psnr"), [(0.5, 10.0), (1.0, 10.0), (2.0, 13.0), (3.0, 16.0), (6.0, 17.5), (9.0, 18.0)]
)
def test_psnr_at_a_time(seconds, psnr):
    assert tables.psnr_at(CURVE, seconds, "psnr", "seconds") == pytest.approx(psnr)


@pytest.mark.parametrize(("psnr", "steps"), [(9.0, 10), (13.0, 15), (16.0, 20), (17.5, 35), (18.1, None)])
def test_steps_to_a_psnr(psnr, steps):
    assert tables.steps_to(CURVE, psnr, "psnr") == (None if steps is None else pytest.approx(steps))


def test_time_to_the_psnr_of_nerfacto(results):
    made = table(results, "6, street")
    ours = made.rows[-1]
    # by seed: nerfacto ends at 20, 21, 22.5; ours has 11.5 at 50 steps and 23 at 100, and so on
    expected = [50 + 50 * (end - own / 2) / (own / 2) for end, own in ((20, 23), (21, 24.5), (22.5, 24))]
    assert ours.cells[-1].text() == f"{np.mean(expected):.0f} ± {np.std(expected, ddof=1):.0f}"


def test_a_run_that_never_gets_there_leaves_no_mean(results):
    last = next(run for run in results.runs if (run.scene, run.method, run.seed) == ("street", "edge", 2))
    for point in last.curve:
        point["truth_psnr"] = 22.4
    for label in ("6, street", "6, average"):
        assert table(results, label).rows[-1].cells[-1].text() == "never"
    assert table(results, "6, turn").rows[-1].cells[-1].text() != "never"


def test_latex_and_markdown_hold_the_same_cells(results):
    made = tables.make_tables(results)
    markdown, latex = tables.as_markdown(results, made), tables.as_latex(results, made)
    assert "| nerfacto | 21.17 ± 1.26 |" in markdown
    assert r"nerfacto & 21.17 $\pm$ 1.26 &" in latex
    assert latex.count(r"\toprule") == latex.count(r"\bottomrule") == latex.count(r"\end{table}") == len(made)
    body = "\n".join(line for line in latex.splitlines() if not line.startswith("%"))
    assert body.isascii() and "\\usepackage" not in body
    for rows in body.split(r"\begin{tabular}")[1:]:
        columns = len(rows[: rows.index("\n")].strip("{}"))
        cells = [line for line in rows.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
        assert {line.count(" & ") + 1 for line in cells} == {columns}


def test_runs_that_differ_in_unnamed_fields_are_refused(results):
    check_fair(results)
    results.runs[-1].content["configuration"]["b"] = "2"
    with pytest.raises(InputError, match=r"its b is 2, that of .* is None.*another version"):
        check_fair(results)
    results.runs[-1].content["named"] = ["b"]
    with pytest.raises(InputError, match=r"ds-nerf_seed-2: its b"):  # the same method with another seed lacks it
        check_fair(results)
    for run in results.runs:
        if run.method == "ds-nerf":
            run.content["named"], run.content["configuration"]["b"] = ["b"], "2"
    check_fair(results)


# --- options and errors -----------------------------------------------------------------------------------------------


def options(*scenes, **changes):
    return CompareOptions(scenes=tuple(scenes), **{"output": Path("/nonexistent/out"), **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 0}, "--steps 0"),
        ({"jobs": 0}, "--jobs 0"),
        ({"seeds": ()}, "--seeds"),
        ({"seeds": (1, 1)}, "--seeds 1 1: expected each once"),
        ({"methods": ("edge", "edge")}, "--methods edge edge"),
        ({"preset": "paper", "methods": ("edge-paper",)}, "edge, which is the literal method"),
        ({"lambdas": (0.1,)}, "without --search"),
        ({"search": True}, "--lambdas"),
        ({"search": True, "lambdas": (1.0, 2.0, 3.0, 4.0)}, "--sigmas-m"),
        ({"search": True, "lambdas": (1.0, 2.0, 3.0, -4.0), "sigmas_m": (1.0, 2.0, 3.0)}, "positive"),
        ({"search": True, "lambdas": (1.0, 2.0, 3.0, 4.0), "sigmas_m": ("own", 1.0)}, "at least 3"),
        ({"search": True, "seeds": (0, 1)}, "2 seeds"),
        ({"search": True, "methods": ("nerfacto",)}, "depth loss"),
        ({"search": True, "tuned": Path("x")}, "--tuned"),
    ],
)
def test_options_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        options(Path("a"), **changes).check()


def test_no_scene_is_an_error():
    with pytest.raises(InputError, match="at least one scene"):
        options().check()


def test_input_is_checked_before_anything_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "do_runs", lambda *_: pytest.fail("started"))

    def refused(error, message, *scenes, **changes):
        output = changes.pop("output", tmp_path / "out")
        with pytest.raises(error, match=message):
            command.compare(options(*scenes, output=output, **changes), QUIET)
        assert changes.get("left", False) or not (tmp_path / "out").exists()

    refused(FileNotFoundError, "transforms.json: no such file", tmp_path / "nothing")
    scene, twin = write_scene(tmp_path / "a" / "x"), write_scene(tmp_path / "b" / "x")
    refused(InputError, "one folder name", scene, twin)
    refused(InputError, "one folder name", scene, scene)
    bare = write_scene(tmp_path / "bare", lidar=False)
    refused(InputError, r"no LiDAR maps, which the method .*needs", bare, preset="paper")
    refused(InputError, r"no LiDAR maps", bare, methods=("ds-nerf",))
    refused(
        InputError, r"no monocular maps.*estimate-depth", write_scene(tmp_path / "c", mono=False), methods=("edge",)
    )
    all_trained = write_scene(tmp_path / "d", split=False)
    refused(InputError, "found 0 pictures under test_filenames", all_trained)
    tuned = tmp_path / "tuned.json"
    refused(FileNotFoundError, "no such file", scene, tuned=tuned)
    for content in ([], {"methods": {"nerfacto": {"lambda": 1, "sigma_m": 1}}}, {"methods": {"edge": {"lambda": 0.1}}}):
        write_json(tuned, content)
        refused(InputError, r"tuned.json: (.*expected \{|holds no JSON object)", scene, tuned=tuned)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    refused(InputError, "holds other things", scene, output=tmp_path / "full")


def test_a_folder_keeps_what_its_runs_share(tmp_path, monkeypatch):
    class Stop(Exception):
        pass

    def stop(*_):
        raise Stop

    monkeypatch.setattr(command, "do_runs", stop)
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    first = options(scene, output=output, steps=5, methods=("nerfacto",))
    with pytest.raises(Stop):
        command.compare(first, QUIET)
    assert read_json(output / "runs" / "x" / "nerfacto_seed-0" / "run.json")["steps"] == 5
    for more in ({"methods": ("edge",)}, {"seeds": (0, 1)}, {}):  # these come to what is there
        with pytest.raises(Stop):
            command.compare(replace(first, **more), QUIET)
    begun = f"edge-depth-nerf compare {scene} --output {output} --methods"
    assert read_json(output / "compare.json")["commands"] == [
        f"{begun} nerfacto --steps 5",
        f"{begun} edge --steps 5",
        f"{begun} nerfacto --steps 5 --seeds 0 1",
    ]
    with pytest.raises(InputError, match="steps 5, not 6"):
        command.compare(replace(first, steps=6), QUIET)
    with pytest.raises(InputError, match="preset lite, not full"):
        command.compare(replace(first, preset="full"), QUIET)
    with monkeypatch.context() as patched:
        # said at once, not after whoever writes there
        patched.setattr(command, "only_writer", lambda *_: pytest.fail("waits for the folder"))
        with pytest.raises(InputError, match="steps 5, not 6"):
            command.compare(replace(first, steps=6), QUIET)
    meta = read_json(scene / "transforms.json")
    write_json(scene / "transforms.json", {**meta, "processed": "anew"})
    with pytest.raises(InputError, match="begun with scene_sha256"):
        command.compare(first, QUIET)


def test_methods_may_be_tuned_after_others(tmp_path):
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"

    def open_with(methods: tuple[str, ...], **tuned: float) -> None:
        path = tmp_path / "tuned.json"
        content = {name.replace("_", "-"): {"lambda": value, "sigma_m": 0.5} for name, value in tuned.items()}
        write_json(path, {"scene": "tuning", "methods": content})
        asked = options(scene, output=output, steps=5, methods=methods, tuned=path)
        command.open_output(asked, command.read_tuned(path))
        for name in methods:
            (output / "runs" / "x" / f"{name}_seed-0").mkdir(parents=True, exist_ok=True)

    open_with(("ds-nerf",), ds_nerf=0.1)
    open_with(("edge",), ds_nerf=0.1, edge=0.01)
    assert read_json(output / "compare.json")["tuned"] == {
        "ds-nerf": {"lambda": 0.1, "sigma_m": 0.5},
        "edge": {"lambda": 0.01, "sigma_m": 0.5},
    }
    open_with(("nerfacto",), ds_nerf=0.1, edge=0.01)
    for tuned in ({"ds_nerf": 0.1, "edge": 0.02}, {"ds_nerf": 0.1}):  # another value; one that is gone
        with pytest.raises(InputError, match="holds a comparison with tuned"):
            open_with(("edge",), **tuned)
    (output / "runs" / "x" / "edge-lidar_seed-0").mkdir()  # trained with the default
    with pytest.raises(InputError, match="holds a comparison with tuned"):
        open_with(("edge-lidar",), ds_nerf=0.1, edge=0.01, edge_lidar=0.01)


def test_a_run_that_fails_names_its_log(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "executable", shutil.which("false"))
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    with pytest.raises(InputError, match=r"status 1.*nerfacto_seed-0/run\.log"):
        command.compare(options(scene, output=output, steps=5, methods=("nerfacto", "edge"), jobs=1), QUIET)
    assert not (output / "runs" / "x" / "edge_seed-0" / "run.log").exists()  # nothing more was begun


CHILD = """
import os, sys, time
from pathlib import Path
from edge_depth_nerf.runs import end_with_parent
end_with_parent()
Path(sys.argv[1]).write_text(str(os.getpid()))
time.sleep(600)
"""
PARENT = """
import sys
from pathlib import Path
from edge_depth_nerf.runs import LoggedCommands
LoggedCommands().call([sys.executable, "-c", sys.argv[1], sys.argv[2]], Path(sys.argv[2] + ".log"), 1, print)
"""


def test_a_program_ends_with_the_one_that_started_it(tmp_path):
    pid = tmp_path / "pid"
    deadline = time.monotonic() + 300

    def wait_for(happened):
        while not happened():
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def is_gone():
        done = subprocess.run(["ps", "-o", "stat=", "-p", pid.read_text()], capture_output=True, text=True, check=False)
        return done.stdout.strip() in ("", "Z")

    with subprocess.Popen([sys.executable, "-c", PARENT, CHILD, str(pid)]) as parent:
        wait_for(lambda: pid.is_file() and pid.read_text())
        assert not is_gone()
        parent.kill()
    wait_for(is_gone)


def test_departures_from_the_papers_protocol(tmp_path):
    names = [f"{index:03d}.png" for index in range(188)]
    meta = {
        "frames": [{"file_path": name, "frame": index} for index, name in enumerate(names)],
        "train_filenames": names[:150],
        "test_filenames": names[150:],
        "source": {"kind": "kitti360", "sweeps": 0, "deskew": False, "occlusion": False, "find_ego": False},
    }
    assert departures(meta) == []
    meta["source"] |= {"sweeps": 3, "deskew": True, "find_ego": True}
    meta["train_filenames"] = names[:70]
    found = " ".join(departures(meta))
    for part in ("70 training frames, not 150", "35% held out", "7 sweeps", "de-skewed", "vehicle itself"):
        assert part in found


# --- search -----------------------------------------------------------------------------------------------------------


def test_folders_of_runs_say_their_setting(tmp_path):
    """As far as they have one: benchmarks/equal_seconds.py trains nerfacto without whole views, too."""
    nerfacto = RunSpecification("/x/street", "0", "lite", "nerfacto", 3, 10, whole_views=False)
    searched = replace(nerfacto, method="ds-nerf", weight=0.01, sigma_m="own")
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
            write_json(run.folder / "figures.json", {**result.content, "run": spec.to_dict()})

    monkeypatch.setattr(command, "do_runs", train)
    scene, output = write_scene(tmp_path / "x"), tmp_path / "out"
    asked = options(
        scene,
        output=output,
        search=True,
        seeds=(7,),
        methods=("ds-nerf", "edge"),
        lambdas=(0.01, 0.1, 0.3, 1.0),
        sigmas_m=("own", 0.1, 0.5, 2.0),
    )
    found = command.compare(asked, QUIET)
    assert len(found.runs) == 2 * 4 * 4
    tuned = read_json(output / "tuned.json")
    assert tuned["scene"] == str(scene) and tuned["seed"] == 7
    assert tuned["methods"]["ds-nerf"] == {"lambda": 0.1, "sigma_m": 0.5, "psnr": 30.0}
    assert tuned["methods"]["edge"]["lambda"] == 1.0 and tuned["methods"]["edge"]["sigma_m"] == "own"
    ds_nerf, ours = search.grids(found)
    assert ds_nerf.at_the_edge == [] and ours.at_the_edge == ["λ"]
    text = (output / "search.md").read_text()
    assert "| λ | σ 0.1 m | σ 0.5 m | σ 2 m | σ its own |" in text
    assert "**30.00**" in text and "best λ is at an end" in text
    read = command.read_tuned(output / "tuned.json")
    assert read == {"ds-nerf": Setting(0.1, 0.5), "edge": Setting(1.0, "own")}
    # more values come to those that are there
    assert len(command.compare(replace(asked, lambdas=(0.01, 0.1, 0.3, 3.0)), QUIET).runs) == 2 * 5 * 4


# --- the command, for real --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    copy_sample_drive(folder / "sample")
    asked = options(folder / "sample", output=folder / "out", methods=("nerfacto", "edge"), steps=12, jobs=2)
    return asked, command.compare(asked, QUIET)


@pytest.mark.slow
def test_it_leaves_figures_tables_and_pictures(finished):
    asked, results = finished
    with (asked.output / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["scene"], row["method"], row["seed"]) for row in rows} == {
        ("sample", "nerfacto", "0"),
        ("sample", "edge", "0"),
    }
    metrics = {row["metric"] for row in rows if row["method"] == "edge"}
    assert {"masked_psnr", "truth_masked_ssim", "truth_affine_masked_psnr", "truth_abs_rel", "seconds"} <= metrics
    assert {"shifted_1m_masked_psnr", "shifted_2m_masked_psnr", "shifted_1m_truth_abs_rel"} <= metrics
    assert np.isfinite([float(row["value"]) for row in rows]).all()
    tidy = json.loads((asked.output / "results.json").read_text())["rows"]
    assert [(row["metric"], row["value"]) for row in tidy] == [(row["metric"], float(row["value"])) for row in rows]
    fitted, plain = (
        [float(row["value"]) for row in rows if row["metric"] == f"truth_{name}masked_psnr"] for name in ("affine_", "")
    )
    assert all(one > other for one, other in zip(fitted, plain, strict=True))
    text = (asked.output / "tables.md").read_text()
    assert "## Table 1." in text and "## Table 5" in text and "| ours |" in text
    assert r"\bottomrule" in (asked.output / "tables.tex").read_text()
    assert read_image(asked.output / "comparison_sample.png").std() > 5
    for name in ("psnr_by_steps", "psnr_by_seconds", "error_by_angle", "error_by_distance"):
        plot = ElementTree.parse(asked.output / f"{name}.svg").getroot()
        # each method's line in its own colour
        styles = [each.get("style", "") for each in plot.iter("{http://www.w3.org/2000/svg}path")]
        assert all(any(f"stroke: {colour}" in style for style in styles) for colour in ("#888888", "#d62828"))
    for run in results.runs:
        assert [point["step"] for point in run.curve][-1] == 12
        seconds = [point["seconds"] for point in run.curve]
        assert seconds == sorted(seconds) and seconds[0] > 0
        assert sum(entry["pixels"] for entry in run.content["by_angle_deg"]) > 1000


@pytest.mark.slow
def test_the_page_shows_what_is_there(finished):
    asked, results = finished
    page = (asked.output / "report.html").read_text(encoding="utf-8").replace("&#39;", "&#x27;")
    for made in tables.make_tables(results):
        assert f"Table {made.label}</i> {html.escape(made.title)}</span>" in page
        for row in made.rows:
            assert all(f">{html.escape(cell.text())}</td>" in page for cell in row.cells)
    assert "2 of 2 held-out views" in page and page.count('"distance-error": "data:image/webp') == 2 * 2
    assert page.count("data:image/svg+xml;base64,") == 2 * 4
    (command_line,) = results.options["commands"]
    assert command_line.startswith("edge-depth-nerf compare /") and f"<code>{command_line}</code>" in page
    assert page.count("<code>ns-viewer --load-config ") == 2
    # of the configuration, what differs and what is shared
    loss = ['<th scope="row">pipeline.model.depth_loss</th>', "<td>none</td>", "<td>edge</td>"]
    assert re.search(r"\s*".join(map(re.escape, loss)), page)
    assert "<dt>pipeline.model.near_m</dt>" in page
    for name, value in results.versions.items():
        assert f"<dt>{name}</dt><dd>{value}</dd>" in page


@pytest.mark.slow
def test_trained_configurations_differ_in_the_named_fields_alone(finished):
    _, results = finished
    nerfacto, ours = (next(run for run in results.runs if run.method == name) for name in ("nerfacto", "edge"))
    texts = [next(run.folder.rglob("config.yml")).read_text().splitlines() for run in (nerfacto, ours)]
    different = {(a.strip(), b.strip()) for a, b in zip(*texts, strict=True) if a != b}
    assert different == {
        ("experiment_name: nerfacto_seed-0", "experiment_name: edge_seed-0"),
        ("depth_loss: none", "depth_loss: edge"),
        ("depth_source: auto", "depth_source: integrated"),
    }


@pytest.mark.slow
def test_judging_gives_the_figures_of_ns_eval(finished):
    _, results = finished
    run = next(run for run in results.runs if run.method == "edge")
    _, pipeline, *_ = eval_setup(next(run.folder.rglob("config.yml")), test_mode="test")
    found: Any = pipeline.get_average_eval_image_metrics()
    for name, value in found.items():
        if name not in ("fps", "num_rays_per_sec"):
            assert run.figures[name] == pytest.approx(value, rel=1e-4, abs=1e-4), name


@pytest.mark.slow
def test_what_is_there_is_not_done_again(finished, monkeypatch):
    asked, results = finished
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    assert command.compare(asked, QUIET).rows() == results.rows()


@pytest.mark.slow
@pytest.mark.parametrize("kept", [(), ("edge",)])
def test_runs_of_which_only_the_figures_are_left_count_in_the_tables(finished, tmp_path, monkeypatch, kept):
    asked, results = finished
    output = tmp_path / "out"
    shutil.copytree(asked.output, output)
    (output / "comparison_sample.png").unlink()
    for folder in (output / "runs" / "sample").iterdir():
        for each in folder.iterdir():
            if folder.name.partition("_")[0] in kept or each.name in ("run.json", "figures.json"):
                continue
            shutil.rmtree(each) if each.is_dir() else each.unlink()
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    assert command.compare(replace(asked, output=output), QUIET).rows() == results.rows()
    assert "| nerfacto |" in (output / "tables.md").read_text()
    assert (output / "comparison_sample.png").is_file() == bool(kept)
    page = (output / "report.html").read_text(encoding="utf-8")
    assert page.count("<code>ns-viewer --load-config ") == len(kept)
    assert page.count('"distance-error": "data:image/webp') == 2 * len(kept)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_at_its_checkpoint(finished, tmp_path):
    """As if it had been killed after four of ours' twelve steps."""
    asked, results = finished
    output = tmp_path / "out"
    shutil.copytree(asked.output, output)
    folder = output / "runs" / "sample" / "edge_seed-0"
    (folder / "figures.json").unlink()
    checkpoints = next(folder.rglob("nerfstudio_models"))
    saved = torch.load(checkpoints / "step-000000011.ckpt", weights_only=True)
    (checkpoints / "step-000000011.ckpt").unlink()
    torch.save({**saved, "step": 3}, checkpoints / "step-000000003.ckpt")
    progress = read_json(folder / "progress.json")
    progress["times"] = {"4": {"seconds": 100.0, "cpu_seconds": 50.0}}
    write_json(folder / "progress.json", progress)
    again = command.compare(replace(asked, output=output), QUIET)
    before, after = (next(run for run in found.runs if run.method == "edge") for found in (results, again))
    assert [path.name for path in checkpoints.iterdir()] == ["step-000000011.ckpt"]
    steps = [point["step"] for point in before.curve]
    assert [point["step"] for point in after.curve] == steps
    assert after.curve[: steps.index(4.0) + 1] == before.curve[: steps.index(4.0) + 1]
    assert after.curve[-1] != before.curve[-1]
    assert 100 < after.figures["seconds"] < 100 + before.figures["seconds"] + 60
    assert {row["value"] for row in again.rows() if row["method"] == "nerfacto"} == {
        row["value"] for row in results.rows() if row["method"] == "nerfacto"
    }
