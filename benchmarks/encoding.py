"""Time of the fused hash grid beside nerfstudio's torch form, forward and backward, in one run.

    python benchmarks/encoding.py [--repeat 15] [--threads 1 2] [--device cpu|cuda] [--json FILE]

Three sizes: the lite preset's field, nerfacto's proposal networks, nerfacto's field. Points lie along rays, 32 to a
ray, as a training batch's do, or (last row of a size) anywhere. The two forms run in turn, each from rest, and a ratio
is taken between neighbouring runs, so that what else the machine does hits both; median and quartiles over the
repeats. Wall time is the median; CPU time counts all threads. "with positions" has the gradient to the positions
besides the table's. Backward's results are compared before it is timed: largest difference by the largest value.

On CUDA (Triton) the sizes are those of the full preset's step, as smaller ones time the host's launches, and each form
is timed by `triton.testing.do_bench`, which repeats it and empties the device's cache in between. The traffic that
cannot be avoided (positions, features or their gradient once, eight corners a level, read, or read and written) is set
against the time: GB/s.
"""

from __future__ import annotations

import argparse
import copy
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor

from edge_depth_nerf.plugin.fused.hash_grid import use_fused_encodings

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


def clock(work: Callable[[], object]) -> tuple[float, float]:
    """Seconds of wall and of CPU."""
    start, start_cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - start, time.process_time() - start_cpu


def on_the_device(encoding: HashEncoding, x: Tensor, gradient: Tensor) -> dict[str, tuple[float, float]]:
    """Clock the parts of one step on CUDA, launched over and over; the host's seconds are not the form's."""
    from triton.testing import do_bench

    encoded = encoding(x)
    milliseconds: dict[str, Any] = {
        "forward": do_bench(lambda: encoding(x), return_mode="median"),
        "backward": do_bench(
            lambda: encoded.backward(gradient, retain_graph=True),
            grad_to_none=[encoding.hash_table, x],
            return_mode="median",
        ),
    }
    times = {part: (taken / 1e3, 0.0) for part, taken in milliseconds.items()}
    return {**times, "both": (sum(milliseconds.values()) / 1e3, 0.0)}


def moved_bytes(points: int, features: int) -> dict[str, int]:
    """What the parts of a step cannot but read and write; `features` of all levels together, float32."""
    corners, once = 8 * points * features * 4, 4 * points * (3 + features)
    return {"forward": once + corners, "backward": once + 2 * corners, "both": 2 * once + 3 * corners}


def one_run(
    encoding: HashEncoding, x: Tensor, gradient: Tensor, device: str, pause_s: float
) -> dict[str, tuple[float, float]]:
    """Clock the parts of one step."""
    if device != "cpu":
        return on_the_device(encoding, x, gradient)
    encoded = [torch.empty(0)]
    time.sleep(pause_s)

    def forward() -> None:
        encoded[0] = encoding(x)

    times = {"forward": clock(forward), "backward": clock(lambda: encoded[0].backward(gradient))}
    encoding.hash_table.grad = None
    x.grad = None
    wall, cpu = zip(*times.values(), strict=True)
    return {**times, "both": (sum(wall), sum(cpu))}


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


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """First quartile, median, third quartile."""
    low, middle, high = statistics.quantiles(values, n=4)
    return low, middle, high


def measure(
    size: str, device: str, threads: int, repeat: int, *, along_rays: bool, of_positions: bool, pause_s: float = PAUSE_S
) -> list[dict]:
    """Run the two forms in turn; a dictionary for forward, backward and both."""
    levels, log2_rows, count, finest = (SIZES | SIZES_ON_CUDA)[size]
    torch.manual_seed(0)
    torch.set_num_threads(threads)
    host = HashEncoding(num_levels=levels, log2_hashmap_size=log2_rows, max_res=finest, implementation="torch").to(
        device
    )
    fused = copy.deepcopy(host)
    use_fused_encodings(fused)
    x = make_points(count, along_rays=along_rays).to(device).requires_grad_(of_positions)
    gradient = torch.randn(count, host.get_out_dim(), device=device)
    difference = differences(host, fused, x, gradient)
    runs = [[one_run(encoding, x, gradient, device, pause_s) for encoding in (host, fused)] for _ in range(repeat)]
    rows = []
    for part in ("forward", "backward", "both"):
        torch_wall, fused_wall = ([pair[form][part][0] for pair in runs] for form in (0, 1))
        torch_cpu, fused_cpu = ([pair[form][part][1] for pair in runs] for form in (0, 1))
        ratios = quartiles([a / b for a, b in zip(torch_wall, fused_wall, strict=True)])
        seconds = statistics.median(fused_wall)
        moved = moved_bytes(count, host.get_out_dim())[part]
        rows.append(
            {
                "size": size,
                "levels": levels,
                "rows": 2**log2_rows,
                "points": count,
                "along_rays": along_rays,
                "with_positions": of_positions,
                "device": device,
                "threads": threads,
                "part": part,
                "torch_ms": 1e3 * statistics.median(torch_wall),
                "fused_ms": 1e3 * seconds,
                "torch_cpu_ms": 1e3 * statistics.median(torch_cpu),
                "fused_cpu_ms": 1e3 * statistics.median(fused_cpu),
                "ratio_quartiles": ratios,
                "ratio_of_cpu": statistics.median(torch_cpu) / max(1e-9, statistics.median(fused_cpu)),
                "fused_gb_s": moved / seconds / 1e9,
                "differences": difference,
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--repeat", type=int, default=15, help="how often each form runs")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="threads that both forms may use")
    parser.add_argument("--device", nargs="+", default=["cpu"] + ["cuda"] * torch.cuda.is_available())
    parser.add_argument("--pause", type=float, default=PAUSE_S, help="seconds of rest before each run")
    parser.add_argument("--json", type=Path, help="write the figures here too")
    arguments = parser.parse_args()

    print(f"torch {torch.__version__}, {platform.machine()}, repeats {arguments.repeat}")
    if "cuda" in arguments.device:
        print(f"CUDA: {torch.cuda.get_device_name()}")
    else:
        print("No CUDA here: Triton's kernels are not timed.")
    print()
    print("| size | points | gradient | device, threads | part | torch ms (CPU) | fused ms (CPU) | ratio (quartiles) |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for device in arguments.device:
        for size in SIZES if device == "cpu" else SIZES_ON_CUDA:
            for threads in arguments.threads if device == "cpu" else [1]:
                for along_rays, of_positions in ((True, False), (True, True), (False, False)):
                    found = measure(
                        size,
                        device,
                        threads,
                        arguments.repeat if device == "cpu" else 3,
                        along_rays=along_rays,
                        of_positions=of_positions,
                        pause_s=arguments.pause,
                    )
                    rows += found
                    for row in found:
                        low, middle, high = row["ratio_quartiles"]
                        speed = f", {row['fused_gb_s']:.0f} GB/s" if device == "cuda" else ""
                        print(
                            f"| {size} ({row['levels']} × {row['rows']}) "
                            f"| {row['points']} {'along rays' if along_rays else 'anywhere'} "
                            f"| {'with positions' if of_positions else 'table'} | {device}, {threads} | {row['part']} "
                            f"| {row['torch_ms']:.1f} ({row['torch_cpu_ms']:.1f}) "
                            f"| {row['fused_ms']:.2f} ({row['fused_cpu_ms']:.2f}){speed} "
                            f"| {middle:.1f} ({low:.1f}-{high:.1f}) |",
                            flush=True,
                        )
    print()
    for name in ("forward", "table", "positions"):
        largest = max(row["differences"][name] for row in rows)
        print(f"largest difference, {name}: {largest:.1e} of the largest value")
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
