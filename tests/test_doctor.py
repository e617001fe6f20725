"""`doctor`: every check, with what it looks for there and missing."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest
from rich.console import Console

from edge_depth_nerf import doctor
from edge_depth_nerf.doctor import Finding, run_doctor
from edge_depth_nerf.method import metrics


def found(check) -> dict[str, Finding]:
    return {finding.what: finding for finding in check()}


@pytest.mark.slow
def test_the_command_is_content_with_this_environment():
    """As a user gives it: this environment passes the tests, so there is nothing to mend."""
    program = Path(sys.executable).with_name("edge-depth-nerf")
    done = subprocess.run([program, "doctor"], capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Nothing to fix" in done.stdout
    for what in ("Python", "PyTorch", "Device", "Hash grids", "nerfstudio", "Methods", "OpenCV", "LPIPS"):
        assert what in done.stdout
    assert "Free memory" in done.stdout


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


@pytest.mark.parametrize(
    ("running", "state"), [((3, 9), "problem"), ((3, 10), "ok"), ((3, 12), "ok"), ((3, 13), "problem")]
)
def test_pythons(monkeypatch, running, state):
    monkeypatch.setattr(sys, "version_info", (*running, 0))
    assert found(doctor.check_python)["Python"].state == state


def test_missing_libraries_are_findings(monkeypatch):
    spec = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in hidden else spec(name))
    hidden = {"pycolmap", "kiss_icp", "transformers", "distributed", "tinycudann", "numba"}
    extras = found(doctor.check_extras)
    for name, extra in (("COLMAP", "colmap"), ("KISS-ICP", "odometry"), ("transformers", "hf"), ("Dask", "cluster")):
        assert extras[name].state == "note" and f"'.[{extra}]'" in extras[name].remedy
    assert found(doctor.check_kernels)["Hash grids"].state == "problem"
    hidden.remove("numba")
    assert found(doctor.check_kernels)["Hash grids"].state == "ok"


def test_a_module_of_another_package(monkeypatch):
    """pycolmap-cuda12 installs the module pycolmap."""

    def version(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(doctor, "version", version)
    assert found(doctor.check_extras)["COLMAP"].found == "installed"


def test_methods_that_are_not_registered(monkeypatch):
    monkeypatch.setattr(doctor, "entry_points", lambda **_: [])
    finding = found(doctor.check_nerfstudio)["Methods"]
    assert finding.state == "problem" and "edge-depth-nerf-lite" in finding.found and "pip install" in finding.remedy


def test_another_nerfstudio(monkeypatch):
    monkeypatch.setattr(doctor, "version", lambda _: "1.2.0")
    assert found(doctor.check_nerfstudio)["nerfstudio"].state == "problem"


def test_lpips_weights(monkeypatch, tmp_path):
    monkeypatch.setattr(metrics.torch.hub, "get_dir", lambda: str(tmp_path))
    missing = found(doctor.check_lpips)["LPIPS"]
    assert missing.state == "note" and str(tmp_path) in missing.remedy and "https://" in missing.remedy
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


@pytest.mark.parametrize(("free_gb", "state"), [(1.0, "problem"), (16.0, "ok")])
def test_memory(monkeypatch, free_gb, state):
    monkeypatch.setattr(doctor, "_free_memory_gb", lambda: free_gb)
    assert found(doctor.check_room)["Free memory"].state == state


def test_a_driver_without_a_usable_gpu(monkeypatch):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(
        doctor.shutil, "which", lambda name, **_: "/usr/bin/nvidia-smi" if name == "nvidia-smi" else None
    )
    assert found(doctor.check_torch)["Device"].state == "problem"
    monkeypatch.setattr(doctor.shutil, "which", lambda *_, **__: None)
    device = found(doctor.check_torch)["Device"]
    assert device.state == "note" and "edge-depth-nerf-lite" in device.remedy
