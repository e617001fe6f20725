"""The command once for real: worker, report, plots, and going on where it was."""

import csv
import html
import json
import math
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from comparisons import QUIET, copied, options, run_here, write_compared_scene
from nerfstudio.utils.eval_utils import eval_setup
from numba import njit
from numba.core.event import install_listener

from edge_depth_nerf.base.files import read_image, read_json, write_json
from edge_depth_nerf.compare import command, tables, worker
from edge_depth_nerf.compare.worker import Clock

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compare")
    scene, both = write_compared_scene(folder / "sample"), ("nerfacto", "edge")
    asked = options(scene, output=folder / "out", methods=both, steps=6, jobs=2, detail=True)
    do_runs = command.do_runs

    def do_one_in_a_process(runs: Sequence[command.Run], *given: Any) -> None:
        do_runs([run for run in runs if run.specification.method == "nerfacto"], *given)
        run_here([run for run in runs if run.specification.method == "edge"])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "do_runs", do_one_in_a_process)
        return asked, command.compare(asked, QUIET)


def test_it_leaves_figures_tables_and_pictures(finished):
    asked, results = finished
    with (asked.output / "results.csv").open() as file:
        rows = list(csv.DictReader(file))
    runs = {(row["scene"], row["method"], row["seed"]) for row in rows}
    assert runs == {("sample", "nerfacto", "0"), ("sample", "edge", "0")}
    metrics = {row["metric"] for row in rows if row["method"] == "edge"}
    assert {"masked_psnr", "truth_masked_ssim", "truth_affine_masked_psnr", "truth_abs_rel", "seconds"} <= metrics
    assert {"shifted_1m_masked_psnr", "shifted_2m_masked_psnr", "shifted_1m_truth_abs_rel"} <= metrics
    assert {"detail_truth_masked_psnr", "detail_shifted_1m_masked_psnr", "truth_masked_flip"} <= metrics
    by_view = read_json(results.runs[0].folder / "views/by_view.json")
    for name in ("truth_masked_psnr", "truth_masked_flip"):
        mean = np.mean([figures[name] for figures in by_view.values()])
        assert mean == pytest.approx(results.runs[0].figures[name]) and len(by_view) == 2
    pixels = [(figures["truth_pixels"], figures["truth_delta_1_25"]) for figures in by_view.values()]
    pooled = np.average([share for _, share in pixels], weights=[count for count, _ in pixels])
    assert pooled == pytest.approx(results.runs[0].figures["truth_delta_1_25"])
    assert np.isfinite([float(row["value"]) for row in rows]).all()
    tidy = json.loads((asked.output / "results.json").read_text())["rows"]
    assert [(row["metric"], row["value"]) for row in tidy] == [(row["metric"], float(row["value"])) for row in rows]
    fitted, plain = (
        [float(row["value"]) for row in rows if row["metric"] == f"truth_{name}masked_psnr"] for name in ("affine_", "")
    )
    assert all(one > other for one, other in zip(fitted, plain, strict=True))
    text = (asked.output / "tables.md").read_text()
    assert "## Table 1. Rivals" in text and "## Table 2. Pictures and geometry" in text and "| ours |" in text
    assert "## Fields in which the methods differ" in text
    assert "| pipeline.model.depth_loss | none | edge |" in text
    assert "| pipeline.model.exposure |" not in text
    assert " with detail ↑ |" in text and " 1 m beside, with detail ↑ |" in text
    assert r"\bottomrule" in (asked.output / "tables.tex").read_text()
    assert read_image(asked.output / "comparison_sample.png").std() > 5
    for name in ("psnr_by_steps", "psnr_by_seconds", "error_by_angle", "error_by_distance"):
        plot = ElementTree.parse(asked.output / f"{name}.svg").getroot()
        # each method's line in its own colour
        styles = [each.get("style", "") for each in plot.iter("{http://www.w3.org/2000/svg}path")]
        assert all(any(f"stroke: {colour}" in style for style in styles) for colour in ("#888888", "#d62828"))
    for run in results.runs:
        assert run.content["mono_trained_on"] == "scene"
        # six steps render a blur: the pictures around a view show more
        assert run.figures["detail_truth_masked_psnr"] > run.figures["truth_masked_psnr"] + 1
        assert len([*(run.folder / "views").glob("eval_detail_*.png")]) == 2
        assert [point["step"] for point in run.curve][-1] == 6
        assert all(math.isfinite(point["trained_psnr"]) for point in run.curve)
        seconds = [point["seconds"] for point in run.curve]
        assert seconds == sorted(seconds) and seconds[0] > 0
        assert sum(entry["pixels"] for entry in run.content["by_angle_deg"]) > 1000


def test_the_page_shows_what_is_there(finished):
    asked, results = finished
    page = (asked.output / "report.html").read_text(encoding="utf-8").replace("&#39;", "&#x27;")
    for made in tables.make_tables(results):
        assert f"Table {made.label}</i> {html.escape(made.title)}</span>" in page
        for row in made.rows:
            assert all(f">{html.escape(cell.text())}</td>" in page for cell in row.cells)
    assert "All 2 held-out views." in page and page.count('"distance-error": "data:image/webp') == 2 * 2
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


def test_evaluation_gives_the_figures_of_ns_eval(finished):
    _, results = finished
    run = next(run for run in results.runs if run.method == "edge")
    _, pipeline, *_ = eval_setup(next(run.folder.rglob("config.yml")), test_mode="test")
    found: Any = pipeline.get_average_eval_image_metrics()
    assert {"masked_psnr", "truth_masked_ssim", "lidar_abs_rel"} <= set(found)
    for name, value in found.items():
        if name not in ("fps", "num_rays_per_sec"):
            assert run.figures[name] == pytest.approx(value, rel=1e-4, abs=1e-4), name


def test_a_finished_training_gets_detail_by_a_line_of_its_configuration(finished, tmp_path):
    """As docs/method.md says."""
    asked, results = finished
    copied(asked.output, tmp_path / "out")
    run = next(run for run in results.runs if run.method == "edge")
    config = next((tmp_path / "out" / run.folder.relative_to(asked.output)).rglob("config.yml"))
    before = config.read_text().splitlines()
    subprocess.run(["sed", "-i", "s/detail: false/detail: true/", config], check=True)
    after = config.read_text().splitlines()
    assert [line.strip() for line, other in zip(after, before, strict=True) if line != other] == ["detail: true"]
    _, pipeline, *_ = eval_setup(config, test_mode="test")
    found: Any = pipeline.get_average_eval_image_metrics()
    assert found["truth_masked_psnr"] == pytest.approx(run.figures["detail_truth_masked_psnr"], abs=1e-3)


@pytest.mark.parametrize("kept", [(), ("edge",)])
def test_runs_of_which_only_the_figures_are_left_count_in_the_tables(finished, tmp_path, monkeypatch, kept):
    asked, results = finished
    output = tmp_path / "out"
    copied(asked.output, output)
    (output / "comparison_sample.png").unlink()
    for folder in (output / "runs" / "sample").iterdir():
        for each in folder.iterdir():
            if folder.name.partition("_")[0] in kept or each.name in ("run.json", "figures.json"):
                continue
            shutil.rmtree(each) if each.is_dir() else each.unlink()
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    monkeypatch.setattr(command, "draw_plots", lambda *_: [])
    assert command.compare(replace(asked, output=output), QUIET).rows() == results.rows()
    assert "| nerfacto |" in (output / "tables.md").read_text()
    assert (output / "comparison_sample.png").is_file() == bool(kept)
    page = (output / "report.html").read_text(encoding="utf-8")
    assert page.count("<code>ns-viewer --load-config ") == len(kept)
    assert page.count('"distance-error": "data:image/webp') == 2 * len(kept)


def test_an_interrupted_run_goes_on_at_its_checkpoint(finished, tmp_path, monkeypatch):
    """As if it had been killed after four of ours' six steps."""
    asked, results = finished
    output = tmp_path / "out"
    copied(asked.output, output)
    folder = output / "runs" / "sample" / "edge_seed-0"
    (folder / "figures.json").unlink()
    checkpoints = next(folder.rglob("nerfstudio_models"))
    saved = torch.load(checkpoints / "step-000000005.ckpt", weights_only=True)
    (checkpoints / "step-000000005.ckpt").unlink()
    torch.save({**saved, "step": 3}, checkpoints / "step-000000003.ckpt")
    progress = read_json(folder / "progress.json")
    progress["times"] = {"4": {"seconds": 100.0, "cpu_seconds": 50.0}}
    write_json(folder / "progress.json", progress)
    begun = []

    def work(runs: Sequence[command.Run], *_: object) -> None:
        for run in runs:
            monkeypatch.setattr(sys, "argv", ["worker", str(run.folder.absolute())])
            worker.main()

    monkeypatch.setattr(worker, "end_with_parent", lambda: begun.append("ends with its parent"))
    monkeypatch.setattr(command, "do_runs", work)
    monkeypatch.setattr(command, "draw_plots", lambda *_: [])
    again = command.compare(replace(asked, output=output), QUIET)
    assert begun == ["ends with its parent"]
    before, after = (next(run for run in found.runs if run.method == "edge") for found in (results, again))
    assert [path.name for path in checkpoints.iterdir()] == ["step-000000005.ckpt"]
    steps = [point["step"] for point in before.curve]
    assert [point["step"] for point in after.curve] == steps
    assert after.curve[: steps.index(4.0) + 1] == before.curve[: steps.index(4.0) + 1]
    assert after.curve[-1] != before.curve[-1]
    assert 100 < after.figures["seconds"] < 100 + before.figures["seconds"] + 60
    ended, resumed = (
        {row["value"] for row in found.rows() if row["method"] == "nerfacto"} for found in (results, again)
    )
    assert ended == resumed


def test_the_clock_stands_while_kernels_are_compiled():
    clock, asked = Clock("cpu"), time.process_time()
    with install_listener("numba:compile", clock):
        clock.start()
        njit(lambda numbers: (numbers * numbers).sum())(np.ones(3))  # which compiles further functions
        with clock.stopped():
            njit(lambda numbers: numbers.max())(np.ones(3))
        compiled = time.process_time() - asked
        while time.process_time() < asked + compiled + 0.1:
            pass
        with clock.stopped():
            pass
    assert 0.1 <= clock.passed["cpu_seconds"] < 0.1 + compiled / 2 and compiled > 0.2
