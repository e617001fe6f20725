"""`edge-depth-nerf doctor`: what is installed here, what that means, and what to do about it.

Each check stands alone and never fails itself: a library that cannot be imported is a finding, not a traceback.
"""

from __future__ import annotations

import ctypes.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distributions, entry_points, version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from edge_depth_nerf import __version__

if TYPE_CHECKING:
    import torch

State = Literal["ok", "note", "problem"]
MARKS: dict[State, str] = {"ok": "[green]ok[/green]", "note": "[yellow]–[/yellow]", "problem": "[bold red]✗[/bold red]"}
METHODS = ("edge-depth-nerf", "edge-depth-nerf-lite", "edge-depth-nerf-paper")
SUPPORTED = ((3, 10), (3, 13))
"""From this Python to before that one."""
LEAST_FREE_MEMORY_GB = 4.0
"""Less does not hold nerfstudio and a training of the lite preset."""
LEAST_FREE_DISK_GB = 5.0


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    what: str
    state: State
    """ok; note: works, but something could be better or is left out; problem: something does not work."""
    found: str
    remedy: str = ""
    """What to do, for notes and problems."""


def _finding(what: str, fine: bool, found: str, remedy: str, otherwise: State = "problem") -> Finding:
    """Say that something is ok, or else what it is and what to do."""
    return Finding(what, "ok", found) if fine else Finding(what, otherwise, found, remedy)


def check_python() -> Iterator[Finding]:
    """The interpreter."""
    first, end = SUPPORTED
    wanted = f"{first[0]}.{first[1]} to {end[0]}.{end[1] - 1}"
    fine = first <= sys.version_info[:2] < end
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    remedy = (
        f"Create an environment with Python {wanted}: nerfstudio's dependencies have wheels only for these versions."
    )
    yield _finding("Python", fine, found, remedy)


def check_torch() -> Iterator[Finding]:
    """PyTorch, and what it computes on."""
    try:
        import torch
    except Exception as error:  # whatever keeps it from loading
        yield _broken("PyTorch", "torch", error)
        return
    yield Finding("PyTorch", "ok", torch.__version__)
    if torch.cuda.is_available():
        name = torch.cuda.get_device_name()
        versions = f"driver {_driver()}, CUDA {torch.version.cuda}, Triton {_version_of('triton')}"
        try:
            torch.ones(1, device="cuda").sum().item()
            free, total = (size / 2**30 for size in torch.cuda.mem_get_info())
        except Exception as error:  # no code for this card, no memory for a context, a card that is used alone
            found = f"{name}, on which torch cannot compute ({_first_line(error)}); {versions}"
            remedy = "Install a torch for this GPU (https://pytorch.org/get-started), or end what has its memory."
            yield Finding("Device", "problem", found, remedy)
            return
        yield Finding("Device", "ok", f"{name}, {total:.0f} GiB, of which {free:.0f} are free; {versions}")
        return
    built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
    found = f"CPU, {os.cpu_count()} cores; torch is built {built}"
    if shutil.which("nvidia-smi") is None:
        yield Finding("Device", "note", found, "Train with edge-depth-nerf-lite; the full preset needs a GPU.")
        return
    remedy = (
        "There is an NVIDIA driver, but torch finds no GPU: install a torch with a CUDA version that the driver "
        "supports (https://pytorch.org/get-started)."
    )
    yield Finding("Device", "problem", found, remedy)


def check_kernels() -> Iterator[Finding]:
    """What computes hash grids."""
    numba, triton = find_spec("numba") is not None, find_spec("triton") is not None
    found = " and ".join(name for name, there in (("Numba (CPU)", numba), ("Triton (CUDA)", triton)) if there)
    found = f"fused kernels: {found or 'none'}; tiny-cuda-nn is not used"
    yield _finding("Hash grids", numba, found, "Reinstall edge-depth-nerf: it brings Numba.")


def check_gpu() -> Iterator[Finding]:
    """What a training asks of the GPU: right kernels, and steps as CUDA graphs; nothing without a GPU."""
    device = _gpu()
    if device is None:
        return
    from edge_depth_nerf.kernels.back_ends import undisturbed
    from edge_depth_nerf.method.losses import step_kernels

    forms, failures = step_kernels(), []
    for form in forms:
        try:
            with undisturbed():
                form.try_out(device)
        except Exception as error:  # whatever keeps it from working
            failures.append(f"{form.name} ({_first_line(error)})")
    right = f"{len(forms) - len(failures)} of {len(forms)} give the numbers of their formulas in torch"
    remedy = (
        "A training computes these in torch, with the same results but slower. Triton needs a C compiler and Python's "
        "headers (apt-get install gcc python3-dev), a folder to write to (TRITON_CACHE_DIR), and the version that came "
        "with this torch (pip install --force-reinstall torch)."
    )
    yield _finding("GPU kernels", not failures, "; ".join([right, *failures]), remedy, "note")
    try:
        sums = replayed_sums(device)
        found = "are recorded and replayed" if sums == [8.0, 24.0] else f"are replayed with wrong results ({sums})"
    except Exception as error:  # whatever keeps it from working
        found = f"cannot be recorded ({_first_line(error)})"
    remedy = (
        "A training launches each kernel by itself, which takes several times as long. Unset CUDA_LAUNCH_BLOCKING, end "
        "debuggers and profilers, or update the driver."
    )
    yield _finding("CUDA graphs", found.endswith("replayed"), found, remedy, "note")


def replayed_sums(device: torch.device) -> list[float]:
    """Record the sum of twice four numbers as a CUDA graph; give that of ones, and then that of threes.

    Raises:
        RuntimeError: it cannot be recorded, or not be replayed.
    """
    import torch

    numbers = torch.ones(4, device=device)
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        (2 * numbers).sum()  # kernels are loaded before the recording
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        total = (2 * numbers).sum()
    found = []
    for value in (1.0, 3.0):
        numbers.fill_(value)
        graph.replay()
        found.append(float(total))
    return found


def check_nerfstudio() -> Iterator[Finding]:
    """The host, and whether it finds our methods."""
    remedy = "pip install 'nerfstudio>=1.1.5,<1.2'"
    try:
        found = version("nerfstudio")
    except PackageNotFoundError:
        yield Finding("nerfstudio", "problem", "not installed", remedy)
        return
    yield _finding("nerfstudio", found.startswith("1.1."), found, remedy)
    registered = {point.name for point in entry_points(group="nerfstudio.method_configs")}
    missing = [name for name in METHODS if name not in registered]
    found = f"not registered: {', '.join(missing)}" if missing else ", ".join(METHODS)
    remedy = "Install the package into this environment (`pip install .` in a clone), not only onto the path."
    yield _finding("Methods", not missing, found, remedy)
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    on_path = shutil.which("ns-train", path=folders)
    remedy = "Activate the environment that nerfstudio is installed in."
    yield _finding("ns-train", on_path is not None, on_path or "not on the path", remedy)


def check_opencv() -> Iterator[Finding]:
    """Which of OpenCV's wheels won."""
    wheels = sorted(
        f"{name} {found.version}"
        for found in distributions()
        if (name := (found.metadata["Name"] or "").lower().replace("_", "-")).startswith("opencv-")
    )
    try:
        import cv2
    except Exception as error:
        yield _broken("OpenCV", "opencv-contrib-python-headless", error)
        return
    # they overwrite each other, the last one wins; any of them will do
    yield Finding("OpenCV", "ok", f"{cv2.__version__}; installed: {', '.join(wheels) or 'unknown'}")


def check_lpips() -> Iterator[Finding]:
    """The weights of one metric."""
    try:
        from edge_depth_nerf.method.metrics import lpips_weights
    except Exception as error:
        yield _broken("LPIPS", "torchmetrics", error)
        return
    path, url = lpips_weights()
    there = path.is_file()
    found = str(path) if there else "no weights of AlexNet: ours leave LPIPS out, nerfstudio's own methods need them"
    remedy = f"Without a network nerfstudio's own methods fail at their start until the file of {url} is at {path}."
    yield _finding("LPIPS", there, found, remedy, "note")


def _version_of(package: str) -> str:
    """The version of an installed module, as far as a package of its name says it (pycolmap-cuda12 has another)."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "installed"


def check_extras() -> Iterator[Finding]:
    """Optional libraries and programs."""
    for name, package, extra, what in (
        ("COLMAP", "pycolmap", "colmap", "refined poses (by default in process) and --poses colmap"),
        ("KISS-ICP", "kiss_icp", "odometry", "poses from LiDAR (process --poses lidar)"),
        ("rosbags", "rosbags", "bags", "ROS bags (unpack)"),
        ("transformers", "transformers", "hf", "ready-made depth networks (--hf)"),
        ("laspy", "laspy", "las", "scans in .las and .laz files"),
        ("Dask", "distributed", "cluster", "many machines (--cluster)"),
    ):
        there = find_spec(package) is not None
        found = _version_of(package) if there else f"not installed; needed only for {what}"
        yield _finding(name, there, found, f"pip install '.[{extra}]'", "note")
    ffmpeg = shutil.which("ffmpeg")
    found = ffmpeg or "not found; needed only for films (ns-render)"
    yield _finding("ffmpeg", ffmpeg is not None, found, "apt-get install ffmpeg", "note")
    usb = ctypes.util.find_library("usb-1.0")
    found = usb or "not found; needed only for meshes and normals (ns-export)"
    fine = usb is not None or platform.system() != "Linux"
    yield _finding("libusb", fine, found, "apt-get install libusb-1.0-0", "note")


def check_room() -> Iterator[Finding]:
    """Free memory and disk."""
    free_gb = _free_memory_gb()
    if free_gb is not None:
        remedy = f"A training takes {LEAST_FREE_MEMORY_GB:g} GiB or more: close other programs."
        yield _finding("Free memory", free_gb >= LEAST_FREE_MEMORY_GB, f"{free_gb:.1f} GiB", remedy)
    disk_gb = shutil.disk_usage(Path.cwd()).free / 2**30
    found = f"{disk_gb:.0f} GiB in {Path.cwd()}"
    remedy = "Scenes, tables of pixels and checkpoints need more space: work in a folder with more of it."
    yield _finding("Free disk", disk_gb >= LEAST_FREE_DISK_GB, found, remedy, "note")


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_python,
    check_torch,
    check_kernels,
    check_gpu,
    check_nerfstudio,
    check_opencv,
    check_lpips,
    check_extras,
    check_room,
)


def run_doctor(console: Console | None = None) -> int:
    """Run all checks and show them; give the command's exit status: 0 without problems, 1 with."""
    console = console or Console()
    with console.status("Checking the installation …"):
        findings = [finding for check in CHECKS for finding in check()]
    table = Table(title=f"edge-depth-nerf {__version__}", show_edge=False, title_justify="left")
    for heading in ("", "", "found", "what to do"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        # what was found is no markup: an extra's name stands in brackets
        table.add_row(MARKS[finding.state], finding.what, escape(finding.found), escape(finding.remedy))
    console.print(table)
    problems = [finding.what for finding in findings if finding.state == "problem"]
    if problems:
        console.print(f"\n[bold red]{len(problems)} to fix: {', '.join(problems)}[/bold red]")
    else:
        console.print("\nNothing to fix.")
    return 1 if problems else 0


def _broken(what: str, package: str, error: Exception) -> Finding:
    found = f"cannot be imported ({_first_line(error)})"
    return Finding(what, "problem", found, f"pip install --force-reinstall {package}")


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".strip().split("\n")[0]


def _gpu() -> torch.device | None:
    """The GPU that torch takes; None without, or where it cannot compute."""
    try:
        import torch

        torch.ones(1, device="cuda").sum().item()
    except Exception:  # which another check reports
        return None
    return torch.device("cuda", torch.cuda.current_device())


def _driver() -> str:
    """The version of NVIDIA's driver, as its own program says it."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip().split("\n")[0] or "unknown"


def _free_memory_gb() -> float | None:
    """Memory that programs can still take; None where the system does not tell."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable"):
                return int(line.split()[1]) / 2**20
    except OSError:
        pass
    return None
