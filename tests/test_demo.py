"""The demo, small: every stage for real."""

import html
import re
import shlex
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from comparisons import copied, fake, run_here, write_rendered
from drives import SEQUENCE, write_room_drive
from rich.console import Console

from edge_depth_nerf import cli
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_image, read_json, write_json
from edge_depth_nerf.base.pictures import NO_VALUE_RGB, colour_distance, side_by_side
from edge_depth_nerf.compare import command as comparing
from edge_depth_nerf.compare.command import Run
from edge_depth_nerf.compare.specification import FIGURES, VIEWS
from edge_depth_nerf.demo import command as demo
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.demo.recording import options_of
from edge_depth_nerf.mono import estimate
from edge_depth_nerf.process import build
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.lidar_checks import LidarCheck
from edge_depth_nerf.process.options import Kitti360Options, RigOptions
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

pytestmark = pytest.mark.slow

QUIET = Console(quiet=True)
SHOWN = {
    **dict.fromkeys(("truth_masked_ssim", "truth_abs_rel", "truth_delta_1_25"), ".3f"),
    **dict.fromkeys(("truth_masked_psnr", "truth_affine_masked_psnr", "masked_psnr", "truth_rmse_m"), ".2f"),
    "shifted_1m_masked_psnr": ".2f",
}
"""Figures in the page's tables."""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    options = DemoOptions(output=tmp_path_factory.mktemp("demo") / "out", scene="parking", frames=5, size=32, steps=4)
    lite = estimate.PRESETS["lite"]
    with pytest.MonkeyPatch.context() as patch:
        # a process for each training is seen in test_compare_worker.py
        patch.setattr(comparing, "do_runs", run_here)
        patch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
        patch.setitem(estimate.PRESETS, "lite", replace(lite, training=replace(lite.training, steps=4)))
        return options, demo.run_demo(options, QUIET)


def runs_of(output: Path) -> Path:
    return output / "comparison" / "runs" / "parking"


def test_it_leaves_figures_and_a_picture(finished):
    options, results = finished
    assert read_json(options.output / "results.json") == results
    for name in ("nerfacto", "ours"):
        assert {*SHOWN, "masked_ssim", "lidar_abs_rel"} <= set(results["figures"][name])
        assert np.isfinite(list(results["figures"][name].values())).all()
    assert list(results["figures"]) == ["nerfacto", "ours"]
    assert set(results["seconds"]) == {"synthesize", "process", "compare"} and min(results["seconds"].values()) > 0
    assert set(results["versions"]) == {"edge-depth-nerf", "nerfstudio", "torch", "numpy", "python"}
    picture = read_image(options.output / "comparison.png")
    # a frame of two cameras is held out: each view has a row of colours and one of distances, of three pictures 220 px
    # wide
    assert picture.shape == (34 + 4 * 226 - 6 + 40, 3 * 226 - 6, 3), "with the scale of distances below"
    page = (options.output / "report.html").read_text(encoding="utf-8")
    assert "<h1>Demo: nerfacto and ours on a rendered parking</h1>" in page and "for 4 steps each" in page
    assert '<p class="verdict">Ours renders held-out pictures ' in page and " than nerfacto (PSNR" in page
    assert "Table 1</i> Rivals" in page and "All 2 held-out views" in page
    for name, form in SHOWN.items():
        assert f">{results['figures']['ours'][name]:{form}}</td>" in page
    assert page.count('"colour-error": "data:image/webp') == 2 * 2
    assert page.count('<img src="data:image/svg+xml;base64,') == 5 and "Errors of held-out scans" in page
    for stage, seconds in results["seconds"].items():
        assert f"<dt>{stage.capitalize()}</dt><dd>{seconds}</dd>" in page


def test_its_commands_are_what_a_user_can_type(finished):
    options, results = finished
    typed = [shlex.split(command) for command in results["commands"]]
    assert {words[0] for words in typed} == {"edge-depth-nerf"}
    assert [words[1] for words in typed] == ["demo", "synthesize", "process", "compare"]
    stages = demo.stages_of(options)
    processing = cli.Process(stages.processing)
    assert [cli.parse(words[1:]) for words in typed] == [options, stages.synthesis, processing, stages.comparison]
    # what the last one would say of itself
    assert read_json(options.output / "comparison" / "compare.json")["commands"] == results["commands"][-1:]
    assert len(results["viewer_commands"]) == 2
    for command, name in zip(results["viewer_commands"], ("nerfacto", "edge"), strict=True):
        words = shlex.split(command)
        assert words[:2] == ["ns-viewer", "--load-config"] and "--viewer.websocket-host 127.0.0.1" in command
        config = Path(words[2])
        assert config.is_file() and (runs_of(options.output) / f"{name}_seed-0") in config.parents
    page = (options.output / "report.html").read_text(encoding="utf-8").replace("&#39;", "&#x27;")
    assert all(html.escape(command) in page for command in [*results["commands"], *results["viewer_commands"]])


def test_what_is_there_is_not_done_again(finished, monkeypatch, capsys):
    options, results = finished
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    written = {path: path.stat().st_mtime_ns for path in options.output.rglob("*") if path.is_file()}
    again = demo.run_demo(options, Console(width=200))
    assert again == results
    assert written == {path: path.stat().st_mtime_ns for path in options.output.rglob("*") if path.is_file()}
    said = capsys.readouterr().out
    assert f"{results['figures']['ours']['truth_masked_psnr']:.2f}" in said
    assert results["viewer_commands"][1] in said
    *_, address, first, second, third = said.splitlines()
    assert address == f"Open in a browser: {(options.output / 'report.html').as_uri()}"
    assert ["nerfacto's" in first, "Distance error" in second, "bold" in third] == [True] * 3


def test_an_interrupted_demo_is_finished(finished, tmp_path, monkeypatch):
    """Only what is not there is done; test_compare_worker.py interrupts a training."""
    options, results = finished
    output = copied(options.output, tmp_path / "out")
    (output / "results.json").unlink()
    for name in ("run.json", "figures.json"):
        for path in runs_of(output).rglob(name):
            path.write_text(path.read_text().replace(str(options.output), str(output)))
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("started a command"))
    monkeypatch.setattr(comparing, "draw_plots", lambda *_: [])
    found = demo.run_demo(replace(options, output=output), QUIET)
    assert found["figures"] == results["figures"]
    assert found["seconds"]["compare"] > results["seconds"]["compare"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("recorded") / "my drive"
    synthesize_drive(SynthesizeOptions(output=root, layout="rig", scene="parking", frames=6, size=32))
    return root


def test_a_recording_of_ones_own(recording, tmp_path, monkeypatch, capsys):
    """Read and written for real; maps and trainings are made up."""
    monkeypatch.setattr("edge_depth_nerf.demo.recording.LEAST_FRAMES", 5)

    def train(runs: Sequence[Run], *_: object) -> None:
        for run in runs:
            better = run.specification.method == "edge"
            write_rendered(Path(run.specification.scene), run.folder / VIEWS, 0.9 if better else 0.6)
            (run.folder / "config.yml").touch()
            made = fake("my drive", run.specification.method, 0, 25.0 if better else 22.5)
            write_json(run.folder / FIGURES, {**made.content, "run": asdict(run.specification)})

    monkeypatch.setattr(comparing, "do_runs", train)
    monkeypatch.setattr(comparing, "draw_plots", lambda *_: [])
    # whether LiDAR lies on the pictures takes a minute, and is of test_wrong_recordings.py
    monkeypatch.setattr(build, "check_lidar", lambda *_: LidarCheck((), ()))
    monkeypatch.setattr(comparing, "check_scene", lambda folder, *_: read_scene(folder))
    monkeypatch.setattr(demo, "process", lambda given, console: convert(replace(given, refine_poses=False), console))
    monkeypatch.chdir(tmp_path)
    recording = copied(recording, tmp_path / "my drive")
    results = demo.run_demo(DemoOptions(real=recording, frames=5, steps=9), Console(width=200))
    page = (tmp_path / "outputs/demo_my drive/report.html").read_text(encoding="utf-8")
    assert "<h1>Demo: nerfacto and ours on my drive</h1>" in page
    assert "2.5 dB better than nerfacto (PSNR, a measure of quality); its distances are wrong by 4.0%" in page
    typed = [cli.parse(shlex.split(line)[1:]) for line in results["commands"]]
    assert typed[0] == DemoOptions(real=recording, frames=5, steps=9) and len(typed) == 3
    scene = Path("outputs/demo_my drive/scenes/my drive")
    assert typed[1] == cli.Process(RigOptions(root=recording, output=scene, frames=5))
    assert len(read_json(scene / "transforms.json")["frames"]) == 5 * 3
    assert "file:///" in capsys.readouterr().out
    # the same by another path; and another one in its place
    Path("outputs/demo_my drive/report.html").unlink()
    again = demo.run_demo(DemoOptions(real=Path("my drive"), frames=5, steps=9), QUIET)
    assert [again[name] for name in ("figures", "seconds")] == [results[name] for name in ("figures", "seconds")]
    assert Path("outputs/demo_my drive/report.html").is_file()
    rig = recording / "rig.toml"
    rig.write_text(re.sub(r"(?m)^fx = .*", "fx = 99.0", rig.read_text()))
    with pytest.raises(InputError, match="another scene"):
        demo.run_demo(DemoOptions(real=recording, frames=5, steps=9), QUIET)


def test_a_recording_is_checked_before_long_work(recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    without = copied(recording, tmp_path / "without")
    text = (without / "rig.toml").read_text()
    (without / "rig.toml").write_text(re.sub(r"\[lidars.*?(?=\n\[(?!lidars)|$)", "", text, flags=re.DOTALL))
    empty = tmp_path / "empty"
    empty.mkdir()
    for root, frames, message in (
        (tmp_path / "nowhere", None, "no such folder"),
        (empty, None, "no recording that can be read. Expected rig.toml"),
        (without, None, "no LiDAR"),
        (recording, 5, "5 usable frames, at --frames 5"),
    ):
        with pytest.raises((InputError, FileNotFoundError), match=message):
            demo.run_demo(DemoOptions(real=root, frames=frames), QUIET)
    for options, message in (
        (DemoOptions(real=recording, frames=-5), "--frames -5: expected 1 or more"),
        (DemoOptions(real=recording, size=512), "--size is of rendered"),
    ):
        with pytest.raises(InputError, match=message):
            demo.run_demo(options, QUIET)
    assert not Path("outputs").exists()


def test_what_kind_of_recording_a_folder_holds(tmp_path):
    drive = write_room_drive(tmp_path / "room", frames=20)
    found = options_of(drive.root, tmp_path / "out", 14)
    assert isinstance(found, Kitti360Options) and (found.sequence, found.frames) == (SEQUENCE, 14)
    for folder in ("2011_09_26/2011_09_26_drive_0005_sync", "sequences/07"):
        root = tmp_path / folder.split("/")[0]
        (root / folder).mkdir(parents=True)
        with pytest.raises((InputError, FileNotFoundError), match=folder):
            options_of(root, tmp_path / "out", 14)


def test_other_options_need_another_folder_and_are_checked_before_anything_starts(finished, tmp_path):
    with pytest.raises(InputError, match="other options"):
        demo.run_demo(replace(finished[0], steps=9), QUIET)
    output = tmp_path / "out"
    changes: dict[str, Any]
    for changes, message in (({"steps": 0}, "--steps 0"), ({"frames": 0}, "--frames 0")):
        with pytest.raises(InputError, match=message):
            demo.run_demo(replace(DemoOptions(output=output), **changes), QUIET)  # pyrefly: ignore[bad-argument-type]
    assert not output.exists()


def test_colours_of_distance():
    distance = np.array([[1.0, 60.0, 0.0, np.nan, np.inf, 200.0]])
    colours = colour_distance(distance)
    red, blue = colours[0, 0].astype(int), colours[0, 1].astype(int)
    assert red[0] > 100 > red[2]  # near is red
    assert blue[2] > blue[0] - 30 and red[0] > blue[0]
    assert (colours[0, 2:5] == NO_VALUE_RGB).all()
    assert (colours[0, 5] == colours[0, 1]).all()  # beyond the range: its last colour
    assert (colour_distance(distance, np.zeros(distance.shape, bool)) == NO_VALUE_RGB).all()


def test_a_sheet_holds_pictures_of_cameras_of_different_sizes():
    small, other_small = (np.full((8, 24, 3), grey, np.uint8) for grey in (90, 120))
    large, other_large = (np.full((20, 30, 3), grey, np.uint8) for grey in (10, 50))
    sheet = side_by_side([[small, other_small], [large, other_large]], ["a", "b"])
    assert sheet.shape == (34 + 8 + 6 + 20, 66, 3)
    assert (sheet[34:42, 3:27] == 90).all() and (sheet[34:42, 39:63] == 120).all()
    assert (sheet[48:, :30] == 10).all() and (sheet[48:, 36:] == 50).all()
    assert (sheet[34:42, :3] == 255).all()
