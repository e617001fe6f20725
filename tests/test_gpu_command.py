"""`make gpu` in its form without a GPU: all parts to their ends, taken up again, and the page of them."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from benchmark_modules import benchmark_modules
from interpreted import in_interpreter

from edge_depth_nerf.base.files import read_json, write_json

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def gpu() -> Any:
    with benchmark_modules() as load:
        yield load("speed.gpu")


def test_every_part_runs_to_its_end_without_a_gpu(gpu, sample_drive, tmp_path, capsys):
    # what is counted is a test of its own
    parts = [name for name in gpu.PARTS if name != "counts"]
    words = ["--fake", "--scene", str(sample_drive), "--output", str(tmp_path)]
    # a part that did not come to its end is done anew, one that did is not
    write_json(tmp_path / "device.json", {"failed": "not done after 60 s"})
    write_json(tmp_path / "beside_the_CPU.json", {"left_out": "done before"})
    assert gpu.main([*words, "--parts", *parts]) == 0
    assert "beside the CPU: done before" in capsys.readouterr().out
    found = {name: read_json(gpu.file_of(tmp_path, name)) for name in parts}
    assert not [name for name, each in found.items() if "failed" in each]
    assert found["device"]["copied_gb_s"] > 0
    assert found["tests"]["counts"]["passed"] > 0 and not found["tests"]["said"]
    assert {row["kernel"] for row in found["kernels"]["rows"]} == {"encode", "table_gradient", "position_gradient"}
    beside_torch = found["samples and losses"]["rows"]
    assert len(beside_torch) == 7 and all(row["off_torch"] == 0 and row["torch_ms"] > 0 for row in beside_torch)
    assert set(found["our steps"]) == {"nerfacto", "ours", "left_out"} and found["our steps"]["ours"]["step_ms"][0] > 0
    assert found["profile"]["launches"] == 0 and found["profile"]["step_ms"] > 0
    assert "masked_psnr" in found["training"]["figures"]
    page = (tmp_path / "report.md").read_text()
    assert "no figure here means anything" in page and "Not done yet." in page and "Failed" not in page
    assert all(f"## {name[0].upper()}{name[1:]}" in page for name in gpu.PARTS)


def test_a_part_that_fails_or_takes_too_long_says_so_and_ends_no_other(gpu, tmp_path, monkeypatch):
    def fails(settings: Any) -> dict[str, Any]:
        raise RuntimeError("out of memory")

    monkeypatch.setitem(gpu.PARTS, "device", gpu.PARTS["device"].__class__(fails, 60))
    monkeypatch.setitem(gpu.PARTS, "kernels", gpu.PARTS["kernels"].__class__(lambda settings: {"rows": []}, 60))
    words = ["--fake", "--output", str(tmp_path), "--parts", "device", "kernels"]
    assert gpu.main(words) == 1
    assert read_json(tmp_path / "device.json") == {"failed": "RuntimeError: out of memory"}
    assert "Failed: RuntimeError: out of memory" in (tmp_path / "report.md").read_text()
    assert gpu.is_done(tmp_path / "kernels.json") and not gpu.is_done(tmp_path / "device.json")
    # in a process of its own, as with a GPU
    monkeypatch.setitem(gpu.PARTS, "device", gpu.PARTS["device"].__class__(fails, 0.2))
    start = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda command, **given: start(["sleep", "30"], **given))
    options = gpu.argparse.Namespace(output=tmp_path, scene=tmp_path)
    assert gpu.in_a_process("device", options) == {"failed": "not done after 0.2 s"}


def check_the_work_that_is_timed() -> None:
    sys.path.insert(0, str(ROOT))
    gpu_parts: Any = importlib.import_module("benchmarks.speed.gpu_parts")
    settings = gpu_parts.Settings(Path(), Path(), fake=True)
    assert gpu_parts.has_kernels(settings)
    off = {row["what"]: row["off_torch"] for row in gpu_parts.samples_and_losses(settings)["rows"]}
    assert len(off) == 7
    for what, found in off.items():
        assert found < 1e-5, (what, found)


def test_the_kernels_that_are_timed_do_the_work_of_torch():
    pytest.importorskip("triton")
    in_interpreter(check_the_work_that_is_timed)


def test_the_tests_of_a_gpu_are_found(gpu):
    parts = importlib.import_module("benchmarks.speed.gpu_parts")
    found = {path.name for path in parts.tests_of_a_gpu()}
    needing = {
        path.name
        for path in (ROOT / "tests").glob("test_*.py")
        if "@NEEDS_A_GPU" in (text := path.read_text(encoding="utf-8")) or "skipif(not torch.cuda" in text
    } - {Path(__file__).name}
    assert found >= needing and len(needing) == 6


def test_a_trainer_that_fails_ends_no_other(gpu, monkeypatch):
    parts = importlib.import_module("benchmarks.speed.gpu_parts")
    settings = parts.Settings(ROOT, ROOT)

    def raced(_: Any, names: list[str]) -> dict[str, Any]:
        if names == ["breaks"]:
            raise EOFError
        return {"nerfacto": {"graphs": None}, names[0]: {"graphs": {"waits": 0, "graphs": 2}.get(names[0])}}

    monkeypatch.setattr(parts, "raced", raced)
    assert parts.beside_others(settings, "breaks") == {"left_out": {"breaks": "EOFError: "}}
    assert list(parts.beside_others(settings, "waits")) == ["left_out"]
    assert parts.beside_others(settings, "graphs") == {"graphs": {"graphs": 2}}
    assert parts.beside_others(settings, "splatfacto") == {"splatfacto": {"graphs": None}}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(gpu, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        gpu.main(["--output", str(tmp_path)])
    assert ended.value.code == 2 and "There is no GPU here" in capsys.readouterr().err


def test_each_part_fits_into_three_minutes(gpu):
    assert gpu.PARTS and all(0 < part.limit_s <= 180 for part in gpu.PARTS.values())
