"""The demo, small: every stage for real."""

from __future__ import annotations

import html
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from comparisons import copied
from rich.console import Console

from edge_depth_nerf import demo
from edge_depth_nerf.compat import allow_numpy_scalars_in_checkpoints
from edge_depth_nerf.console import progress_bars
from edge_depth_nerf.demo_options import DemoOptions
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_image, read_json
from edge_depth_nerf.pictures import NO_VALUE_RGB, colour_distance, side_by_side

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    options = DemoOptions(output=tmp_path_factory.mktemp("demo") / "out", frames=13, size=64, steps=8, mono_seconds=3.0)
    return options, demo.run_demo(options, Console(quiet=True))


def test_it_leaves_figures_and_a_picture(finished):
    options, results = finished
    assert read_json(options.output / "results.json") == results
    for name in ("nerfacto", "ours"):
        assert {metric.name for metric in demo.COLUMNS} <= set(results["figures"][name])
        assert np.isfinite(list(results["figures"][name].values())).all()
    picture = read_image(options.output / "comparison.png")
    # two moments of two cameras are held out (4 and 12), of which three views are shown: three rows of six pictures
    assert picture.shape == (34 + 3 * 70 - 6 + 40, 6 * 70 - 6, 3), "with the scale of distances below"
    assert len(results["viewer_commands"]) == 2
    page = (options.output / "report.html").read_text(encoding="utf-8")
    assert "<caption><span>Held-out views</span></caption>" in page and "4 of 4 held-out views" in page
    for metric in demo.COLUMNS:
        assert f"{results['figures']['ours'][metric.name]:{metric.form}}</td>" in page
    assert page.count('"colour-error": "data:image/webp') == 4 * 2
    assert page.count('<img src="data:image/svg+xml;base64,') == 2
    programs = [command.split()[0] for command in results["commands"]]
    assert programs == [*["edge-depth-nerf"] * 3, *["ns-train", "ns-eval"] * 2]
    assert all(html.escape(command) in page.replace("&#39;", "&#x27;") for command in results["commands"])
    assert all("--viewer.websocket-host 127.0.0.1" in command for command in results["viewer_commands"])


def test_the_two_models_differ_in_the_depth_loss_alone(finished):
    options, _ = finished
    texts = []
    for name in demo.RUNS:
        text = next((options.output / "runs" / name).rglob("config.yml")).read_text()
        texts.append(text.replace(f"experiment_name: {name}", "experiment_name: X").splitlines())
    different = [(a, b) for a, b in zip(*texts, strict=True) if a != b]
    assert [(a.strip(), b.strip()) for a, b in different] == [("depth_loss: none", "depth_loss: edge")]


def test_what_is_there_is_not_done_again(finished, monkeypatch):
    options, results = finished
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    again = demo.run_demo(options, Console(quiet=True))
    assert again["figures"] == results["figures"]


def test_an_interrupted_demo_is_finished(finished, tmp_path):
    """As if it had been stopped after four of ours' eight steps: only the rest is done, from the checkpoint."""
    options, results = finished
    output = tmp_path / "out"
    copied(options.output, output)
    (output / "results.json").unlink()
    metrics = output / "runs" / "ours" / "metrics.json"
    metrics.write_text(metrics.read_text()[:100])  # killed while it was written
    folder = output / "runs" / "ours" / demo.METHOD / "run" / "nerfstudio_models"
    allow_numpy_scalars_in_checkpoints()
    saved = torch.load(folder / "step-000000007.ckpt", weights_only=True)
    (folder / "step-000000007.ckpt").unlink()
    torch.save({**saved, "step": 3}, folder / "step-000000003.ckpt")
    again = demo.run_demo(replace(options, output=output), Console(quiet=True))
    assert again["figures"]["nerfacto"] == results["figures"]["nerfacto"]
    assert again["figures"]["ours"].keys() == results["figures"]["ours"].keys()
    assert [path.name for path in folder.iterdir()] == ["step-000000007.ckpt"]
    assert "--max-num-iterations 4" in (output / "runs" / "ours" / "train.log").read_text()
    assert again["seconds"]["train"] > results["seconds"]["train"]


def test_other_options_need_another_folder(finished):
    options, _ = finished
    with pytest.raises(InputError, match="other options"):
        demo.run_demo(replace(options, steps=9), Console(quiet=True))


def test_a_stage_that_fails_names_its_log(finished, tmp_path, monkeypatch):
    options, _ = finished
    run = demo._Run("nerfacto", tmp_path / "no scene", tmp_path / "runs", options)
    with pytest.raises(InputError, match=r"train\.log.*\n.*ns-train edge-depth-nerf-lite"):
        run.train(progress_bars(Console(quiet=True)))
    assert "no such file" in (tmp_path / "runs" / "nerfacto" / "train.log").read_text()


def test_the_command_says_what_is_wrong_without_a_traceback(tmp_path):
    done = subprocess.run(
        [
            *(sys.executable, "-m", "edge_depth_nerf.cli", "process", "kitti360", "--root", str(tmp_path)),
            *("--sequence", "drive", "--output", str(tmp_path / "scene")),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("edge-depth-nerf: ")
    assert str(tmp_path) in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "scene").exists()


def test_colours_of_distance():
    distance = np.array([[1.0, 60.0, 0.0, np.nan, np.inf, 200.0, 7.7]])
    colours = colour_distance(distance)
    assert colours.dtype == np.uint8
    red, blue = colours[0, 0].astype(int), colours[0, 1].astype(int)
    assert red[0] > 100 > red[2]  # near is red
    assert blue[2] > blue[0] - 30 and red[0] > blue[0]
    for none in (2, 3, 4):
        assert tuple(colours[0, none]) == NO_VALUE_RGB
    assert (colours[0, 5] == colours[0, 1]).all()  # beyond the range: its last colour
    hidden = colour_distance(distance, np.zeros(distance.shape, bool))
    assert (hidden == np.array(NO_VALUE_RGB)).all()


def test_a_sheet_holds_its_pictures():
    red, green = (np.full((20, 30, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 255, 0)))
    sheet = side_by_side([[red, green], [green, red]], ["a", "b"])
    assert sheet.shape == (34 + 46, 66, 3)
    assert (sheet[34:54, :30] == red).all() and (sheet[60:80, 36:] == red).all()
    assert (sheet[34:54, 36:] == green).all()


def test_a_sheet_holds_pictures_of_cameras_of_different_sizes():
    large, small = (np.full((*size, 3), colour, np.uint8) for size, colour in (((20, 30), 10), ((8, 24), 90)))
    sheet = side_by_side([[small, small], [large, large]], ["a", "b"])
    assert sheet.shape == (34 + 8 + 6 + 20, 66, 3)
    assert (sheet[34:42, 3:27] == 90).all() and (sheet[34:42, 39:63] == 90).all()
    assert (sheet[48:, :30] == 10).all() and (sheet[48:, 36:] == 10).all()
    assert (sheet[34:42, :3] == 255).all()
