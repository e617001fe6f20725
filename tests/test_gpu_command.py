"""`make gpu` in its form without a GPU: all parts to their ends, taken up again, and the page of them."""

from __future__ import annotations

import argparse
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_modules import benchmark_modules
from scenes import copy_sample_drive, transforms
from scipy.spatial import KDTree
from waiting import until

from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.plugin.trainer import EdgeDepthTrainer

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def load() -> Iterator[Any]:
    with benchmark_modules() as load:
        yield load


@pytest.fixture(scope="module")
def gpu(load) -> Any:
    return load("speed.gpu")


@pytest.fixture(scope="module")
def parts(gpu, load) -> Any:
    return load("speed.gpu_parts")


@pytest.fixture(scope="module")
def few_frames(tmp_path_factory) -> Path:
    """The sample drive's held-out frame, and the one before it."""
    scene = copy_sample_drive(tmp_path_factory.mktemp("few") / "scene")
    with transforms(scene) as meta:
        meta["frames"] = [frame for frame in meta["frames"] if frame["frame"] in (3, 4)]
        names = {frame["file_path"] for frame in meta["frames"]}
        meta["train_filenames"] = [name for name in meta["train_filenames"] if name in names]
        meta.pop("shifted_views")
    return scene


def in_this_process(turns: Any, folder: Path) -> type:
    """A contestant of `turns.race` without a process of its own, which would import everything anew."""

    class Here:
        def __init__(self, config: Any, _: Path | None = None) -> None:
            self.runner, self.step_s, self.render_s, self.rendered_px = turns.Runner(config, folder), [], [], (0, 0)

        def ask(self, name: str, argument: Any) -> Any:
            return getattr(self.runner, name)(argument)

        def wait(self) -> None: ...

        def stop(self) -> None: ...

    return Here


def test_every_part_runs_to_its_end_without_a_gpu(gpu, load, few_frames, tmp_path, capsys, monkeypatch):
    turns = load("speed.turns")
    monkeypatch.setattr(turns, "Contestant", in_this_process(turns, tmp_path / "race"))
    # an evaluation would be timed with the steps
    monkeypatch.setattr(EdgeDepthTrainer, "tell", None)
    # what is counted is a test of its own
    names = [name for name in gpu.PARTS if name != "counts"]
    # a part that did not come to its end is done anew, one that did is not
    write_json(gpu.file_of(tmp_path, "steps"), {"failed": "not done after 60 s"})
    write_json(gpu.file_of(tmp_path, "ours again"), {"steps": 5000})
    assert gpu.main(["--fake", "--scene", str(few_frames), "--output", str(tmp_path), "--parts", *names]) == 0
    assert "ours again: done before" in capsys.readouterr().out
    found = {name: read_json(gpu.file_of(tmp_path, name)) for name in names}
    assert not [name for name, each in found.items() if "failed" in each]

    first, second = found["recording"], found["start"]
    assert (first["caches before"], second["caches before"]) == ("empty", "filled")
    assert first["first step, s"] > 0 and first["both kinds of steps recorded"] is False
    assert [row["trainer"] for row in found["steps"]["rows"]] == ["nerfacto", "ours"]
    assert all(row["ms a step, early"][0] > 0 < row["ms a step, late"][0] for row in found["steps"]["rows"])
    assert found["profile"]["launches"] == 0 and found["profile"]["ms a step"] > 0
    for row in found["kernels"]["rows"]:
        assert row["failed"] is None and row["off torch"] < 1e-3 and row["kernel, µs"] > 0 < row["torch, µs"], row
        assert (row["off the CPU"] == 0) == (row["function"] == "hash grid"), row
    for name in ("ours", "nerfacto", "DS-NeRF on LiDAR"):
        assert found[name]["masked_psnr"] > 0 and found[name]["lidar_abs_rel"] > 0 and found[name]["steps"] == 2, name
    assert found["tests"]["passed"] > 0 and "said" not in found["tests"]

    page = (tmp_path / "report.md").read_text()
    assert "no figure here means anything" in page and page.count("Not done yet.") == 1 and "Failed" not in page
    assert all(f"## {part.group or name}"[3:].lower() in page.lower() for name, part in gpu.PARTS.items())
    assert "|  | ours | nerfacto | DS-NeRF on LiDAR | ours again |" in page


def test_each_function_of_a_gpu_is_timed(parts, tmp_path):
    functions = set(parts.functions_of_a_gpu())
    assert {"hash grid", "edge loss"} < functions == set(parts.arguments(parts.Settings(tmp_path, tmp_path, fake=True)))


def test_a_function_that_fails_ends_no_other(parts, tmp_path):
    class Broken:
        def on(self, device: torch.device) -> Any:
            raise RuntimeError("cannot be recorded")

    row = parts.beside_torch("it", Broken(), {"x": torch.ones(2, 3)}, parts.Settings(tmp_path, tmp_path, fake=True))
    assert (row["of"], row["failed"], row["kernel, µs"]) == ("2×3", "RuntimeError: cannot be recorded", None)


def test_the_priors_cloud_lies_where_lidars_points_do(parts, sample_drive, tmp_path):
    folder = parts.cloud_of_prior(parts.Settings(sample_drive, tmp_path, fake=True))
    (prior_m, prior_rgb), (lidar_m, lidar_rgb) = (read_cloud(scene / "points.ply") for scene in (folder, sample_drive))
    assert prior_rgb is not None and lidar_rgb is not None
    off_m, nearest = KDTree(prior_m).query(lidar_m)
    assert len(prior_m) > len(lidar_m) and np.median(off_m) < 0.3
    assert np.corrcoef(lidar_rgb.ravel(), prior_rgb[nearest].ravel())[0, 1] > 0.8
    assert read_json(folder / "transforms.json")["ply_file_path"] == "points.ply" and (folder / "images").is_dir()


def test_a_part_that_fails_says_so_and_ends_no_other(gpu, tmp_path, monkeypatch):
    def fails(settings: Any) -> dict[str, Any]:
        settings.keep({"rows": [{"ms": 1.5, "off": float("nan")}]})
        raise RuntimeError("out of memory")

    part = gpu.PARTS["tests"].__class__
    monkeypatch.setitem(gpu.PARTS, "tests", part(fails, 60))
    monkeypatch.setitem(gpu.PARTS, "counts", part(lambda settings: {"kernels": 5, "off": float("inf")}, 60))
    assert gpu.main(["--fake", "--output", str(tmp_path), "--parts", "counts", "tests"]) == 1
    # what it had found stays, and numbers that are none are null
    kept = {"rows": [{"ms": 1.5, "off": None}], "failed": "RuntimeError: out of memory"}
    assert read_json(tmp_path / "tests.json") == {**kept, "not finite": "tests / rows / 0 / off: nan"}
    assert read_json(tmp_path / "counts.json") == {"kernels": 5, "off": None, "not finite": "counts / off: inf"}
    assert gpu.is_done(tmp_path / "counts.json") and not gpu.is_done(tmp_path / "tests.json")
    page = (tmp_path / "report.md").read_text()
    assert "Failed: RuntimeError: out of memory" in page and "| 1.5 | – |" in page


@pytest.fixture
def options(tmp_path) -> argparse.Namespace:
    return argparse.Namespace(output=tmp_path, scene=tmp_path, fake=True, patience=1)


def test_a_part_has_a_process_of_its_own(gpu, options):
    found = gpu.InAProcess("splats", options).found()
    assert found == {"left out": "there is no GPU, or no gsplat"}, (options.output / "splats.log").read_text()


def test_a_process_that_takes_too_long_is_ended_with_all_that_it_started(gpu, options, monkeypatch):
    kept, child = options.output / "tests.json", options.output / "child"
    known = '{"a": 1, "failed": ""}'
    said = f"sleep 60 & echo $! > {child}; echo '{known}' > {kept}; echo 'Step 20: without CUDA graphs'; wait"
    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda _, **given: start(["sh", "-c", said], **given))
    monkeypatch.setitem(gpu.PARTS, "tests", gpu.PARTS["tests"].__class__(lambda _: {}, 2))
    found = gpu.InAProcess("tests", options).found()
    failed = "not done after 2 s (--patience 3 gives it three times as long)"
    assert found == {"a": 1, "failed": failed, "said of CUDA graphs": "Step 20: without CUDA graphs"}
    state = Path(f"/proc/{int(child.read_text())}/stat")
    until(lambda: not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z", 5.0)


def test_a_process_ends_with_the_one_that_began_it(gpu, options):
    process = gpu.InAProcess("profile", options)
    process._process.stdin.close()  # as the system does it for a process that is gone
    # with all that it started: it leads a group of processes
    assert process.found() == {"failed": f"status {-signal.SIGKILL}; profile.log says more"}


def test_trainings_run_together_and_splats_beside_everything(gpu, options, monkeypatch):
    seen: list[str] = []

    class Process:
        def __init__(self, name: str, given: argparse.Namespace) -> None:
            self.name, settings = name, gpu.settings_of(given)
            caches, alone = settings.caches.is_dir(), settings.alone.exists()
            seen.append(f"{name} begins" + " with caches" * caches + " after the timing" * alone)

        def found(self) -> dict[str, Any]:
            seen.append(f"{self.name} ends")
            gpu.settings_of(options).caches.mkdir(parents=True, exist_ok=True)
            return {}

    monkeypatch.setattr(gpu, "InAProcess", Process)
    options.fake = False
    gpu.settings_of(options).caches.mkdir(parents=True)
    assert gpu.do(["recording", "start", "ours", "nerfacto", "splats", "tests"], options) == 0
    late = "with caches after the timing"
    assert seen == [
        *("splats begins with caches", "recording begins", "recording ends", "start begins with caches", "start ends"),
        *(f"ours begins {late}", f"nerfacto begins {late}", "ours ends", "nerfacto ends"),
        *(f"tests begins {late}", "tests ends", "splats ends"),
    ]


def test_the_tests_of_a_gpu_are_found(parts):
    found = {path.name for path in parts.tests_of_a_gpu()}
    needing = {
        path.name
        for path in (ROOT / "tests").glob("test_*.py")
        if "@NEEDS_A_GPU" in (text := path.read_text(encoding="utf-8")) or "skipif(not torch.cuda" in text
    } - {Path(__file__).name}
    assert found >= needing and len(needing) == 7


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(gpu, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        gpu.main(["--output", str(tmp_path)])
    assert ended.value.code == 2 and "There is no GPU here" in capsys.readouterr().err


def test_all_parts_together_fit_into_eight_minutes(gpu):
    limits: dict[str, int] = {}
    for name, part in gpu.PARTS.items():
        group = part.group or name
        limits[group] = max(limits.get(group, 0), part.limit_s)
    # beside the others from the beginning
    assert limits.pop("splats") <= 480 >= sum(limits.values())
    assert limits.pop("trainings") <= 150 and max(limits.values()) <= 60


def test_the_pages_memory_is_that_of_the_presets(load):
    text = (ROOT / "docs" / "gpu.md").read_text(encoding="utf-8").partition("| levels, rows of a level |")[2]
    rows = re.findall(r"^\| (\d+), 2\^(\d+)(?: \(`(.*)`\))? \| ([\d.]+) \|$", text, re.MULTILINE)
    presets = {"edge-depth-nerf-lite": "lite", "edge-depth-nerf": "full"}
    assert {row[2] for row in rows} == {"", *presets} and len(rows) == 5
    for levels, log2_rows, method, gigabytes in rows:
        sizes = load("speed.turns").sizes_of(presets.get(method, "full"))
        grids = [(int(levels), int(log2_rows))]
        assert not method or grids == [(sizes["num_levels"], sizes["log2_hashmap_size"])]
        grids += [(each["num_levels"], each["log2_hashmap_size"]) for each in sizes["proposal_networks"]]
        numbers = sum(count * 2**log2 * sizes["features_per_level"] for count, log2 in grids)
        assert gigabytes == f"{16 * numbers / 1e9:.2f}"
