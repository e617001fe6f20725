"""Time and memory of integrating one frame: the package against a plain NumPy form and torch's unfold.

    python benchmarks/integration.py [--size 1400] [--repeat 7] [--threads 2]

The frame is a picture circle over smooth surfaces with edges, 2.6 % of its pixels with a LiDAR return, as in a real
KITTI-360 frame. Largest differences are to the NumPy form, which computes in float64. Wall time is the best and the
median of the runs, CPU time the best (it does not count what else the machine does). Memory is the peak beyond what
was there before, with the result, as a number of H×W float32 maps; measured on Linux only.
"""

from __future__ import annotations

import argparse
import ctypes
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from edge_depth_nerf.method.integration import IntegrationOptions, integrate_depth

ALPHA, RADIUS, SIGMA_SPACE_PX, SIGMA_DEPTH_M = 0.7, 4, 3.0, 1.0


def make_frame(size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """LiDAR, mono, valid."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:size, :size]
    mono = 25 + 12 * np.sin(x / 130) + y / 100 + rng.normal(0, 0.05, x.shape)
    for left in range(size // 10, size, size // 7):
        mono[size // 4 :, left : left + size // 40] = rng.uniform(4, 12)
    lidar = np.where(rng.random(x.shape) < 0.026, mono * 1.05 + rng.normal(0, 0.02, x.shape), 0)
    valid = np.hypot(x - size / 2, y - size / 2) < 0.49 * size
    return lidar.astype(np.float32), mono.astype(np.float32), valid


def numpy_form(lidar: np.ndarray, mono: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Eq. 5 by shifted slices over the whole frame."""
    height, width = mono.shape
    is_return = lidar > 0
    value = np.pad(np.where(is_return, lidar, mono).astype(np.float64), RADIUS)
    weight = np.pad(valid * np.where(is_return, ALPHA, 1 - ALPHA), RADIUS)
    padded = np.pad(mono.astype(np.float64), RADIUS)
    total, eta = np.zeros((2, height, width))
    for k in range(-RADIUS, RADIUS + 1):
        for l in range(-RADIUS, RADIUS + 1):
            window = (
                slice(RADIUS + k, RADIUS + k + height),
                slice(RADIUS + l, RADIUS + l + width),
            )
            g = np.exp(
                -(k * k + l * l) / (2 * SIGMA_SPACE_PX**2) - (padded[window] - mono) ** 2 / (2 * SIGMA_DEPTH_M**2)
            )
            g *= weight[window]
            eta += g
            total += g * value[window]
    return np.where(valid, total / np.where(valid, eta, 1), 0)


def unfold_form(lidar: np.ndarray, mono: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Eq. 5 over all windows at once, 64 rows at a time (the whole frame would take gigabytes)."""
    height, width = mono.shape
    is_return = lidar > 0
    maps = np.stack([mono, np.where(is_return, lidar, mono), valid * np.where(is_return, ALPHA, 1 - ALPHA)])
    padded = torch.nn.functional.pad(torch.tensor(maps, dtype=torch.float32), (RADIUS,) * 4)
    steps = torch.arange(-RADIUS, RADIUS + 1) ** 2
    spatial = (steps[:, None] + steps).reshape(-1, 1) / (2 * SIGMA_SPACE_PX**2)
    strips = []
    for top in range(0, height, 64):
        strip = padded[:, top : top + 64 + 2 * RADIUS]
        around, value, weight = torch.nn.functional.unfold(strip[:, None], 2 * RADIUS + 1)
        centre = around[len(around) // 2]
        g = torch.exp(-spatial - (around - centre) ** 2 / (2 * SIGMA_DEPTH_M**2)) * weight
        strips.append((g * value).sum(0) / g.sum(0))
    return np.where(valid, torch.cat(strips).reshape(height, width).numpy(), 0)


def package_form(device: str = "cpu", **fields) -> Callable[..., np.ndarray]:
    options = IntegrationOptions(**fields)

    def integrate(*maps: np.ndarray) -> np.ndarray:
        lidar, mono, valid = (torch.from_numpy(image).to(device) for image in maps)
        return integrate_depth(lidar, mono, valid, options).distance_m.cpu().numpy()

    return integrate


def peak_bytes(work: Callable[[], object]) -> int | None:
    """Measure how far the process's memory rises above where it stood; None where the system does not say."""
    if sys.platform != "linux":
        return None

    def kib(name: str) -> int:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))

    ctypes.CDLL(None).malloc_trim(0)  # freed memory that is still held would hide what is used anew
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts again from here
    except OSError:
        return None
    before = kib("VmRSS")
    work()
    return 1024 * (kib("VmHWM") - before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=1400, help="height and width, pixels")
    parser.add_argument("--repeat", type=int, default=7, help="how often each form runs")
    parser.add_argument("--threads", type=int, default=2, help="the most threads that torch and the package may use")
    arguments = parser.parse_args()

    start = time.perf_counter()
    package_form()(*make_frame(64))
    first_call = time.perf_counter() - start
    frame = make_frame(arguments.size)
    expected = numpy_form(*frame)
    several = sorted({1, arguments.threads})
    # name, form, threads to try, whether its result is the NumPy form's
    forms: list[tuple[str, Callable[..., np.ndarray], list[int], bool]] = [
        ("NumPy, shifted slices, float64", numpy_form, [1], True),
        ("torch unfold, float32", unfold_form, several, True),
        ("package", package_form(), several, True),
        ("package, per-source", package_form(normalise="per-source"), several, False),
        ("package, spatial-gaussian", package_form(kernel="spatial-gaussian"), several, False),
        ("package, range_guide lidar", package_form(range_guide="lidar"), several, False),
    ]
    if torch.cuda.is_available():
        forms.append(("package, CUDA", package_form("cuda"), [1], True))
    print(f"one frame of {arguments.size}×{arguments.size}, torch {torch.__version__}")
    print("The package also gives spread and monocular share, NumPy's and unfold's forms do not.")
    print(
        f"The package's first call took {first_call:.1f} s: loading Numba, and compiling where that is not on disk.\n"
    )
    print("| form | threads | s, best | s, median | s of CPU | memory, maps | largest difference, m |")
    print("|---|---|---|---|---|---|---|")
    for name, form, thread_counts, comparable in forms:
        for threads in thread_counts:
            torch.set_num_threads(threads)
            difference = f"{np.abs(form(*frame) - expected).max():.1e}" if comparable else ""
            form(*frame)
            wall, cpu = [], []
            for _ in range(arguments.repeat):
                start, start_cpu = time.perf_counter(), time.process_time()
                form(*frame)
                wall.append(time.perf_counter() - start)
                cpu.append(time.process_time() - start_cpu)
            used = None if "CUDA" in name else peak_bytes(lambda form=form: form(*frame))
            maps = "" if used is None else f"{used / frame[1].nbytes:.1f}"
            best, median = min(wall), statistics.median(wall)
            print(
                f"| {name} | {threads} | {best:.2f} | {median:.2f} | {min(cpu):.2f} | {maps} | {difference} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
