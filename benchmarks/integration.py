"""Time the integration of one frame: the package against a plain NumPy form and torch's unfold.

    python benchmarks/integration.py [--size 1400] [--repeat 3] [--threads 2]

The frame is a picture circle over smooth surfaces with edges, 2.6 % of its pixels with a LiDAR return, as in a real
KITTI-360 frame. The largest difference is to the NumPy form, which computes in float64.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable

import numpy as np
import torch

from edge_depth_nerf.integration import IntegrationOptions, integrate_depth

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--size", type=int, default=1400, help="height and width, pixels")
    parser.add_argument("--repeat", type=int, default=3, help="the best of so many runs is printed")
    parser.add_argument("--threads", type=int, default=2, help="torch's threads; NumPy and the package use one")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    frame = make_frame(arguments.size)
    expected = numpy_form(*frame)
    forms: dict[str, tuple[Callable[..., np.ndarray], bool]] = {
        "NumPy, shifted slices, float64": (numpy_form, True),
        "torch unfold, float32": (unfold_form, True),
        "package": (package_form(), True),
        "package, per-source": (package_form(normalise="per-source"), False),
        "package, spatial-gaussian": (package_form(integration="spatial-gaussian"), False),
        "package, range_guide lidar": (package_form(range_guide="lidar"), False),
    }
    if torch.cuda.is_available():
        forms["package, CUDA"] = (package_form("cuda"), True)
    print(f"one frame of {arguments.size}×{arguments.size}, {arguments.threads} threads, torch {torch.__version__}")
    print("The package also gives spread and monocular share, the other two forms do not.\n")
    print("| form | s | of CPU | largest difference, m |\n|---|---|---|---|")
    for name, (form, comparable) in forms.items():
        best = math.inf, math.inf
        for _ in range(arguments.repeat):
            start, start_cpu = time.perf_counter(), time.process_time()
            result = form(*frame)
            best = min(best, (time.perf_counter() - start, time.process_time() - start_cpu))
        difference = f"{np.abs(result - expected).max():.1e}" if comparable else ""
        print(f"| {name} | {best[0]:.2f} | {best[1]:.2f} | {difference} |", flush=True)


if __name__ == "__main__":
    main()
