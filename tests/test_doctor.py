"""`doctor`: every check, with what it looks for there and missing."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from typing import Any

import pytest
import torch
from interpreted import NEEDS_A_GPU
from rich.console import Console

from edge_depth_nerf import doctor
from edge_depth_nerf.doctor import Finding, run_doctor
from edge_depth_nerf.method import losses, metrics


def found(check) -> dict[str, Finding]:
    return {finding.what: finding for finding in check()}


@pytest.mark.slow
def test_it_is_content_with_this_environment(capsys):
    """This environment passes the tests, so there is nothing to mend."""
    status, said = run_doctor(Console(width=200)), capsys.readouterr().out
    assert status == 0 and "Nothing to fix" in said, said
    named = ("Hash grids", "Free memory", "Python", "PyTorch", "Device", "nerfstudio", "Methods", "OpenCV", "LPIPS")
    assert all(what in said for what in named)


@pytest.mark.parametrize(
    ("finding", "status", "words"),
    [
        # brackets are no markup
        (Finding("Thing", "note", "[none]", "pip install '.[hf]'"), 0, ("[none]", "'.[hf]'")),
        (Finding("Thing", "problem", "is not there", "Get it."), 1, ("1 to fix: Thing", "Get it.")),
    ],
)
def test_one_problem_is_enough_for_the_exit_status(monkeypatch, capsys, finding, status, words):
    monkeypatch.setattr(doctor, "CHECKS", (lambda: [finding],))
    assert run_doctor(Console(width=100)) == status
    said = capsys.readouterr().out
    assert all(word in said for word in words)


def test_pythons(monkeypatch):
    for minor, state in ((9, "problem"), (10, "ok"), (12, "ok"), (13, "problem")):
        monkeypatch.setattr(sys, "version_info", (3, minor, 0))
        assert found(doctor.check_python)["Python"].state == state


def test_missing_libraries_are_findings(monkeypatch):
    spec = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in hidden else spec(name))
    hidden = {"pycolmap", "kiss_icp", "transformers", "rosbags", "distributed", "tinycudann", "numba"}
    extras = found(doctor.check_extras)
    names = {"COLMAP": "colmap", "KISS-ICP": "odometry", "transformers": "hf", "rosbags": "bags", "Dask": "cluster"}
    for name, extra in names.items():
        assert extras[name].state == "note" and f"'.[{extra}]'" in extras[name].remedy
    assert found(doctor.check_kernels)["Hash grids"].state == "problem"
    hidden -= {"numba", "pycolmap"}
    assert found(doctor.check_kernels)["Hash grids"].state == "ok"

    def version(name: str) -> str:
        raise PackageNotFoundError(name)

    # pycolmap-cuda12 installs the module pycolmap
    monkeypatch.setattr(doctor, "version", version)
    assert found(doctor.check_extras)["COLMAP"].found == "installed"


def test_methods_that_are_not_registered_and_another_nerfstudio(monkeypatch):
    monkeypatch.setattr(doctor, "entry_points", lambda **_: [])
    finding = found(doctor.check_nerfstudio)["Methods"]
    assert finding.state == "problem" and "edge-depth-nerf-lite" in finding.found and "pip install" in finding.remedy
    monkeypatch.setattr(doctor, "version", lambda _: "1.2.0")
    assert found(doctor.check_nerfstudio)["nerfstudio"].state == "problem"


def test_lpips_weights(monkeypatch, tmp_path):
    monkeypatch.setattr(metrics.torch.hub, "get_dir", lambda: str(tmp_path))
    missing = found(doctor.check_lpips)["LPIPS"]
    assert missing.state == "note" and "AlexNet" in missing.found and "nerfstudio's own methods need" in missing.found
    assert str(tmp_path) in missing.remedy and "https://" in missing.remedy
    path, _ = metrics.lpips_weights()
    path.parent.mkdir(parents=True)
    path.write_bytes(b"")
    assert found(doctor.check_lpips)["LPIPS"].state == "ok"


def test_an_opencv_that_does_not_load_and_one_that_does(monkeypatch, tmp_path):
    (tmp_path / "cv2.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')")
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    broken = found(doctor.check_opencv)["OpenCV"]
    assert broken.state == "problem" and "libGL" in broken.found
    plain = type("cv2", (), {"__version__": "4.10"})
    monkeypatch.setitem(sys.modules, "cv2", plain)
    finding = found(doctor.check_opencv)["OpenCV"]
    assert finding.state == "ok" and finding.found.startswith("4.10; installed: ")


def test_memory(monkeypatch):
    for free_gb, state in ((1.0, "problem"), (16.0, "ok")):
        monkeypatch.setattr(doctor, "_free_memory_gb", lambda free_gb=free_gb: free_gb)
        assert found(doctor.check_room)["Free memory"].state == state


def test_a_driver_without_a_usable_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(doctor.shutil, "which", lambda name, **_: {"nvidia-smi": "/usr/bin/nvidia-smi"}.get(name))
    assert found(doctor.check_torch)["Device"].state == "problem"
    monkeypatch.setattr(doctor.shutil, "which", lambda *_, **__: None)
    device = found(doctor.check_torch)["Device"]
    assert device.state == "note" and "edge-depth-nerf-lite" in device.remedy
    # nothing is tried on it, nor without PyTorch
    assert found(doctor.check_gpu) == {}
    monkeypatch.setitem(sys.modules, "torch", None)
    assert found(doctor.check_gpu) == {}


def test_a_gpu_is_named_with_its_memory_and_versions(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "NVIDIA H200")
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (100 << 30, 140 << 30))
    monkeypatch.setattr(torch, "ones", lambda count, device: torch.zeros(count))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(doctor, "_version_of", lambda package: {"triton": "3.6.0"}[package])
    ran = subprocess.CompletedProcess([], 0, stdout="580.65.06\n580.65.06\n")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: ran)
    device = found(doctor.check_torch)["Device"]
    said = "NVIDIA H200, 140 GiB, of which 100 are free; driver 580.65.06, CUDA 13.0, Triton 3.6.0"
    assert (device.state, device.found) == ("ok", said)

    def missing(*_: object, **__: object) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(doctor.subprocess, "run", missing)
    assert "driver unknown" in found(doctor.check_torch)["Device"].found
    monkeypatch.setattr(torch, "ones", missing)  # as it raises where a card cannot be used
    device = found(doctor.check_torch)["Device"]
    assert device.state == "problem" and "torch cannot compute (FileNotFoundError" in device.found
    assert found(doctor.check_gpu) == {}


@pytest.fixture
def as_gpu(monkeypatch):
    """The CPU in a GPU's place, kernels that are their formulas, and graphs that are replayed."""
    right = [replace(form, load=lambda form=form: form.formula) for form in losses.step_kernels()]
    monkeypatch.setattr(losses, "step_kernels", lambda: right)
    monkeypatch.setattr(doctor, "_gpu", lambda: torch.device("cpu"))
    monkeypatch.setattr(doctor, "replayed_sums", lambda _: [8.0, 24.0])
    return right


def test_a_gpu_on_which_all_works_and_one_with_wrong_kernels(as_gpu):
    every = found(doctor.check_gpu)
    assert {name: each.state for name, each in every.items()} == {"GPU kernels": "ok", "CUDA graphs": "ok"}
    assert every["GPU kernels"].found.startswith(f"{len(as_gpu)} of {len(as_gpu)} give the numbers of their formulas")

    def broken() -> Any:
        raise RuntimeError("no C compiler\nfound")

    def doubled() -> Any:
        return lambda **given: 2 * as_gpu[0].formula(**given)

    as_gpu[0], as_gpu[1] = replace(as_gpu[0], load=doubled), replace(as_gpu[1], load=broken)
    kernels = found(doctor.check_gpu)["GPU kernels"]
    assert kernels.state == "note" and "gcc" in kernels.remedy
    assert kernels.found.startswith(f"{len(as_gpu) - 2} of {len(as_gpu)} give the numbers")
    assert f"{as_gpu[0].name} (KernelDiffersError: its result is off by 1.0e+00" in kernels.found
    assert kernels.found.endswith(f"{as_gpu[1].name} (RuntimeError: no C compiler)")


def test_graphs_that_do_not_work(as_gpu, monkeypatch):
    def refused(_: Any) -> Any:
        raise RuntimeError("CUDA error: operation not permitted\nwhen stream is capturing")

    for replayed, words in (
        (refused, ("cannot be recorded", "operation not permitted")),
        (lambda _: [8.0, 8.0], ("are replayed with wrong results",)),
    ):
        monkeypatch.setattr(doctor, "replayed_sums", replayed)
        graphs = found(doctor.check_gpu)["CUDA graphs"]
        assert graphs.state == "note" and "\n" not in graphs.found and "CUDA_LAUNCH_BLOCKING" in graphs.remedy
        assert all(word in graphs.found for word in words)


@NEEDS_A_GPU
def test_a_graph_is_replayed_on_a_gpu():
    assert doctor.replayed_sums(torch.device("cuda", 0)) == [8.0, 24.0]
