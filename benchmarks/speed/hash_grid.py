"""The fused hash grid beside nerfstudio's torch form, forward and backward: a part of `benchmarks.speed.run`.

Points lie along rays, 32 to a ray, as those of a training batch do. The two forms take turns, each from rest, and each
ratio is that of neighbouring runs. What else the machine does then hits both. The sizes on CUDA are those of a step of
the full preset, because smaller ones time the host's launches; `benchmarks.speed.gpu` times the kernels of these.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import torch
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor

from edge_depth_nerf.plugin.fused.hash_grid import FusedHashEncoding

PAUSE_S = 0.02
"""Before each run: torch's threads spin for some milliseconds after their work, which would be the next form's time."""
# levels, log2 of a level's rows, points, finest resolution
SIZES = {
    "field, lite": (8, 16, 24576, 512),
    "proposal": (5, 17, 65536, 128),
    "field, nerfacto": (16, 19, 49152, 2048),
}
SIZES_ON_CUDA = {
    "field, full": (16, 19, 4096 * 48 + 4096 + 16384, 2048),
    "proposal 0, full": (5, 17, 4096 * 256, 128),
    "proposal 1, full": (5, 17, 4096 * 96, 256),
}
"""A step of the full preset: 4,096 rays, in the field with the sky behind them and 16,384 surface pixels."""


def make_points(count: int, *, along_rays: bool) -> Tensor:
    """Points in the unit cube."""
    if not along_rays:
        return torch.rand(count, 3)
    starts = torch.rand(count // 32, 1, 3)
    ends = torch.rand(count // 32, 1, 3)
    places, _ = torch.rand(count // 32, 32, 1).sort(dim=1)
    return (starts + places * (ends - starts)).view(-1, 3)


def differences(host: HashEncoding, fused: HashEncoding, x: Tensor, gradient: Tensor) -> dict[str, float]:
    """Largest differences, relative to the largest value."""
    results = []
    for encoding in (host, fused):
        place = x.detach().clone().requires_grad_()
        encoded = encoding(place)
        encoded.backward(gradient)
        results.append({"forward": encoded.detach(), "table": encoding.hash_table.grad, "positions": place.grad})
        encoding.hash_table.grad = None
    return {
        name: float((results[1][name] - value).abs().max() / value.abs().max()) for name, value in results[0].items()
    }


def step_ms(encoding: HashEncoding, x: Tensor, gradient: Tensor) -> float:
    """Milliseconds of one forward and backward pass on the CPU, from rest."""
    time.sleep(PAUSE_S)
    started = time.perf_counter()
    encoding(x).backward(gradient)
    taken = time.perf_counter() - started
    encoding.hash_table.grad = None
    return 1e3 * taken


def measure(size: str, repeat: int = 15) -> dict[str, Any]:
    """Run the two forms in turn; a row of the summary, with quartiles of the ratio."""
    levels, log2_rows, count, finest = SIZES[size]
    made = []
    for kind in (HashEncoding, FusedHashEncoding):
        torch.manual_seed(0)
        made.append(kind(num_levels=levels, log2_hashmap_size=log2_rows, max_res=finest, implementation="torch"))
    host, fused = made
    x, gradient = make_points(count, along_rays=True), torch.randn(count, host.get_out_dim())
    difference = differences(host, fused, x, gradient)
    torch_ms, fused_ms = zip(
        *([step_ms(each, x, gradient) for each in (host, fused)] for _ in range(repeat)), strict=True
    )
    return {
        "size": size,
        "levels": levels,
        "rows": 2**log2_rows,
        "points": count,
        "torch_ms": statistics.median(torch_ms),
        "fused_ms": statistics.median(fused_ms),
        "ratio_quartiles": statistics.quantiles([a / b for a, b in zip(torch_ms, fused_ms, strict=True)], n=4),
        "differences": difference,
    }
