"""The parts of `benchmarks.speed.gpu`: what each measures on a GPU, as a dictionary for JSON.

Each runs with `Settings` that say whether it is meant: without a GPU (`fake`) sizes are tiny, everything is on the CPU,
and the figures mean nothing; what runs is the same code.
"""

from __future__ import annotations

import copy
import importlib.util
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
TRAINED_STEPS = 500
EQUAL_STEPS = 40
"""So many steps are made on the CPU as well: each takes about a second."""
PROFILED_STEPS = 20
LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch")
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize", "cudaMemcpy")


@dataclass(frozen=True)
class Settings:
    """What a part is to measure."""

    scene: Path
    folder: Path
    """For what is written on the way."""
    fake: bool = False

    @property
    def device(self) -> str:
        """Where it runs."""
        return "cpu" if self.fake else "cuda"

    def adjust(self, config: Any) -> None:
        """Keep the scene as it is; make what is trained tiny, where it is not meant."""
        config.pipeline.datamanager.cache_dir = self.folder / "cache"
        if self.fake:
            shrink(config)


@dataclass(frozen=True)
class Part:
    """A measurement with a limit of its own."""

    run: Callable[[Settings], dict[str, Any]]
    limit_s: int


def synchronise() -> None:
    """Wait for a GPU, where there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def milliseconds(work: Callable[[], object], settings: Settings) -> float:
    """Median of many runs on the device, whose cache is emptied in between."""
    if settings.fake:
        started = time.perf_counter()
        work()
        return 1e3 * (time.perf_counter() - started)
    from triton.testing import do_bench

    taken: Any = do_bench(work, return_mode="median")
    return float(taken)


# ---- the device and its kernels -----------------------------------------------------------------------------------


def device(settings: Settings) -> dict[str, Any]:
    """What it is, and how many bytes a second it copies."""
    import triton

    from benchmarks.speed.turns import machine

    x = torch.empty(1 << (16 if settings.fake else 28), device=settings.device)
    taken_ms = milliseconds(lambda: x.clone(), settings)
    about: dict[str, Any] = {**machine(), "triton": triton.__version__, "cuda": torch.version.cuda}
    if not settings.fake:
        properties = torch.cuda.get_device_properties(0)
        about |= {
            "memory_gb": properties.total_memory / 1e9,
            "capability": f"{properties.major}.{properties.minor}",
            "multiprocessors": properties.multi_processor_count,
        }
    return {**about, "copied_gb_s": 2 * x.numel() * x.element_size() / taken_ms / 1e6}


def tests_of_a_gpu() -> list[Path]:
    """The files that have such tests."""
    return [path for path in sorted(TESTS.glob("test_*.py")) if "_on_a_gpu(" in path.read_text(encoding="utf-8")]


def gpu_tests(settings: Settings) -> dict[str, Any]:
    """The tests that a machine without a GPU skips, by number: their names end with `on_a_gpu`."""
    files = [TESTS / "test_grad_scaler.py"] if settings.fake else tests_of_a_gpu()
    command = [sys.executable, "-m", "pytest", *map(str, files), "-p", "no:cacheprovider"]
    command += [f"--basetemp={settings.folder / 'tests'}", *(["-n", "0"] if settings.fake else ["-n", "4"])]
    command += [] if settings.fake else ["-k", "on_a_gpu"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    last = done.stdout.strip().rpartition("\n")[2]
    counts = {what: int(number) for number, what in re.findall(r"(\d+) (passed|failed|skipped|error)", last)}
    return {"counts": counts, "said": done.stdout[-4000:] if done.returncode else ""}


def kernels(settings: Settings) -> dict[str, Any]:
    """The hash grid's kernels: beside the CPU's numbers, and timed at the sizes of a full step."""
    from nerfstudio.field_components.encodings import HashEncoding

    from benchmarks.speed.hash_grid import SIZES, SIZES_ON_CUDA, make_points, moved_bytes
    from edge_depth_nerf.kernels import hash_grid_numba as on_cpu
    from edge_depth_nerf.kernels.functions import HASH_GRID

    if HASH_GRID.on(torch.device(settings.device)) is None:
        raise RuntimeError("Triton's kernels do not work on this GPU; the warning above says why")
    work: Any = on_cpu
    if not settings.fake:
        from edge_depth_nerf.kernels import hash_grid_triton as work
    rows = []
    for name, (levels, log2_rows, count, finest) in (SIZES if settings.fake else SIZES_ON_CUDA).items():
        if settings.fake:
            count, log2_rows = 320, 8
        torch.manual_seed(0)
        grid = HashEncoding(num_levels=levels, log2_hashmap_size=log2_rows, max_res=finest, implementation="torch")
        table, scalings, features = grid.hash_table.detach(), grid.scalings.float(), grid.get_out_dim()
        moved = moved_bytes(count, features)
        for along_rays in (True, False):
            x, gradient = make_points(count, along_rays=along_rays), torch.randn(count, features)
            calls: dict[str, tuple[Sequence[Any], int]] = {
                "encode": ((x, table, scalings), moved["forward"]),
                "table_gradient": ((x, gradient, scalings, len(table)), moved["backward"]),
                "position_gradient": ((x, table, gradient, scalings), moved["forward"]),
            }
            for kernel, (arguments, size) in calls.items():
                there = [each.to(settings.device) if isinstance(each, torch.Tensor) else each for each in arguments]
                expected, found = getattr(on_cpu, kernel)(*arguments), getattr(work, kernel)(*there).cpu()
                off = float((found - expected).abs().max() / expected.abs().max())
                taken_ms = milliseconds(lambda k=kernel, a=there: getattr(work, k)(*a), settings)
                rows.append(
                    {
                        "size": name,
                        "points": count,
                        "along_rays": along_rays,
                        "kernel": kernel,
                        "ms": taken_ms,
                        "gb_s": size / taken_ms / 1e6,
                        "off_the_cpu": off,
                    }
                )
    return {"rows": rows}


Pair = tuple[Callable[[], torch.Tensor], Callable[[], torch.Tensor]]
"""The same work by Triton's kernels and by torch."""


def has_kernels(settings: Settings) -> bool:
    """Whether Triton's kernels run: on a GPU, or interpreted; else torch's form stands for them."""
    return not settings.fake or os.environ.get("TRITON_INTERPRET") == "1"


def followed(found: torch.Tensor, *given: torch.Tensor) -> torch.Tensor:
    """The sum and its gradients, in one row."""
    return torch.cat(
        [found.sum().view(1), *(each.flatten().float() for each in torch.autograd.grad(found.sum(), given))]
    )


def spaced(distance: torch.Tensor) -> torch.Tensor:
    """nerfstudio's piecewise spacing."""
    return torch.where(distance < 1, distance / 2, 1 - 1 / (2 * distance))


def sorted_edges(rays: int, samples: int, settings: Settings) -> torch.Tensor:
    """Edges of samples anywhere in 0..1."""
    return torch.rand(rays, samples + 1, device=settings.device).sort(dim=1)[0]


def work_by_number(rays: int, samples: int, settings: Settings) -> dict[str, Pair]:
    """Distances, contraction and directions."""
    import torch.nn.functional as F
    from nerfstudio.utils.math import components_from_spherical_harmonics

    from edge_depth_nerf.kernels import pointwise_triton
    from edge_depth_nerf.plugin.fused.fields import CubeContraction

    near, far = (torch.full((rays, 1), value, device=settings.device) for value in (0.01, 50.0))
    edges = sorted_edges(rays, samples, settings)
    directions = F.normalize(torch.randn(rays, 3, device=settings.device), dim=1)
    anywhere = 3 * torch.randn(rays * samples, 3, device=settings.device)
    contraction = CubeContraction(order=float("inf"))

    def distances() -> torch.Tensor:
        x = torch.lerp(spaced(near), spaced(far), edges)
        return torch.where(x < 0.5, 2 * x, 1 / (2 - 2 * x))

    return {
        "contraction": (
            lambda: pointwise_triton.contract(anywhere)[0],
            lambda: (contraction(anywhere) + 2) / 4,
        ),
        "distances": (lambda: pointwise_triton.distances(edges, near, far), distances),
        "directions": (
            lambda: pointwise_triton.harmonics(directions, torch.float32),
            lambda: components_from_spherical_harmonics(4, (directions + 1) / 2),
        ),
    }


def work_along_rays(rays: int, samples: int, settings: Settings) -> dict[str, Pair]:
    """Placing samples, and the losses on samples with their gradients."""
    from nerfstudio.model_components.losses import lossfun_distortion, lossfun_outer

    from edge_depth_nerf.kernels import ray_triton
    from edge_depth_nerf.method import edge_loss_triton
    from edge_depth_nerf.method.losses import EPS, NARROW, edge_loss

    final = max(2, samples // 5)
    outer_edges, edges = (sorted_edges(rays, each, settings) for each in (samples, final))
    outer, weights = (
        torch.rand(rays, each, device=settings.device).pow(4).div(each).requires_grad_() for each in (samples, final)
    )
    prior, sigma = 1 + 19 * torch.rand(rays, device=settings.device), torch.full((rays,), 0.2, device=settings.device)
    wanted = torch.linspace(0.01, 0.99, final, device=settings.device).expand(rays, -1).contiguous()
    levels = [
        (each, 20 * of_each[:, :-1], 20 * of_each[:, 1:], prior, sigma)
        for each, of_each in ((outer, outer_edges), (weights, edges))
    ]

    def placed() -> torch.Tensor:
        share = outer.detach() + 0.01
        cumulative = torch.nn.functional.pad((share / share.sum(1, keepdim=True)).cumsum(1), (1, 0))
        above = torch.searchsorted(cumulative, wanted, side="right").clamp(1, samples)
        low, high = (cumulative.gather(1, each) for each in (above - 1, above))
        start, end = (outer_edges.gather(1, each) for each in (above - 1, above))
        return start + (wanted - low) / (high - low) * (end - start)

    def by_triton() -> torch.Tensor:
        form = {"interval": True, "divide_by_norm": True, "eps": EPS, "narrow": NARROW}
        return followed(
            torch.stack([edge_loss_triton.edge_loss(*level, **form).sum() for level in levels]), outer, weights
        )

    def by_torch() -> torch.Tensor:
        form: dict[str, Any] = {"gaussian": "interval", "divide_by_norm": True}
        return followed(torch.stack([edge_loss(*level, **form).sum() for level in levels]), outer, weights)

    return {
        "placing samples": (lambda: ray_triton.sample_pdf(outer, outer_edges, wanted, 0.01, 1e-5), placed),
        "proposal loss": (
            lambda: followed(ray_triton.interlevel_loss(edges, weights.detach(), outer_edges, outer), outer),
            lambda: followed(lossfun_outer(edges, weights.detach(), outer_edges, outer).mean(), outer),
        ),
        "distortion loss": (
            lambda: followed(ray_triton.distortion_loss(edges, weights), weights),
            lambda: followed(lossfun_distortion(edges, weights).mean(), weights),
        ),
        "edge loss": (by_triton, by_torch),
    }


def samples_and_losses(settings: Settings) -> dict[str, Any]:
    """Triton's kernels for samples and losses beside torch's, at the sizes of a full step."""
    torch.manual_seed(0)
    rays, samples = (16, 8) if settings.fake else (4096, 256)
    pairs = {
        **work_by_number(rays, samples, settings),
        **work_along_rays(rays, samples, settings),
    }
    rows = []
    for name, (by_triton, by_torch) in pairs.items():
        work = by_triton if has_kernels(settings) else by_torch
        found, beside = work().double(), by_torch().double()
        rows.append(
            {
                "what": name,
                "triton_ms": milliseconds(work, settings),
                "torch_ms": milliseconds(by_torch, settings),
                "off_torch": float((found - beside).norm() / beside.norm()),
            }
        )
    return {"rows": rows}


def counts(settings: Settings) -> dict[str, Any]:
    """What a step would ask for, counted on fake tensors, as the tests do."""
    from benchmarks.speed import gpu_counts

    if reason := gpu_counts.why_not():
        return {"left_out": reason}
    cases = ["lite"] if settings.fake else ["full", "full, proposals rest", "full, torch"]
    return gpu_counts.in_a_process(cases, settings.scene, settings.folder / "counts")


# ---- steps --------------------------------------------------------------------------------------------------------


def configuration(settings: Settings) -> Any:
    """The full preset on the scene."""
    from edge_depth_nerf.plugin import config as methods

    config: Any = copy.deepcopy(methods.edge_depth_nerf.config)
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = settings.scene
    config.machine.device_type, config.vis = settings.device, "tensorboard"
    settings.adjust(config)
    return config


def shrink(config: Any) -> None:
    """Make what is trained tiny."""
    model, data = config.pipeline.model, config.pipeline.datamanager
    model.num_levels, model.log2_hashmap_size = 2, 8
    model.proposal_net_args_list = [{**each, "log2_hashmap_size": 8} for each in model.proposal_net_args_list]
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (8, 8), 8
    data.train_num_rays_per_batch, data.eval_num_rays_per_batch = 64, 64
    if hasattr(data, "surface_rays_per_batch"):
        data.surface_rays_per_batch = 64


class Here:
    """A contestant of `turns.race` in this process, which leaves its folder to tensorboard's thread."""

    def __init__(self, config: Any, folder: Path) -> None:
        from benchmarks.speed.turns import Runner

        self._runner = Runner(config, folder)
        self.step_s: list[float] = []
        self.render_s: list[float] = []
        self.rendered_px = (0, 0)

    def wait(self) -> None:
        """It is ready."""

    def ask(self, name: str, argument: Any) -> Any:
        """Let it do one thing."""
        return getattr(self._runner, name)(argument)

    def stop(self) -> None:
        """Forget it."""
        del self._runner


def raced(settings: Settings, names: Sequence[str]) -> dict[str, Any]:
    """Milliseconds of a step of several trainers, in turn."""
    from benchmarks.speed import turns

    rounds, steps = (1, 1) if settings.fake else (5, 100)
    every = list(dict.fromkeys((turns.REFERENCE, *names)))
    configs = turns.configurations("full", settings.scene, every, settings.adjust)
    of: Any = partial(Here, folder=settings.folder / "race") if settings.fake else turns.Contestant
    found = turns.race(configs, rounds, steps, contestant_of=of)
    return {
        name: {
            "rays_per_second": None if name == turns.SPLATS else result["rays_per_second"],
            "step_ms": [1e3 * each for each in result["step_s"]],
            "ratio_to_nerfacto": result["step_ratio"],
            "graphs": result["graphs"],
        }
        for name, result in found.items()
    }


def beside_others(settings: Settings, name: str) -> dict[str, Any]:
    """Race a trainer that may fail on its own, so that it ends no other; `left_out` says why it has no figures."""
    try:
        found = raced(settings, [name])[name]
    except Exception as error:
        return {"left_out": {name: f"{type(error).__name__}: {error}"[:500]}}
    if found["graphs"] == 0:
        return {"left_out": {name: "no graph was recorded; the log says why"}}
    return {name: found}


def our_steps(settings: Settings) -> dict[str, Any]:
    """Ours, fused (launched one by one, and as CUDA graphs) and in torch, beside nerfstudio's nerfacto."""
    from benchmarks.speed import turns

    found = raced(settings, ["ours"] if settings.fake else ["ours", "ours, torch"])
    if settings.fake:
        return {**found, "left_out": {turns.GRAPHS: "there is no GPU"}}
    return found | beside_others(settings, turns.GRAPHS)


def other_steps(settings: Settings) -> dict[str, Any]:
    """depth-nerfacto; tiny-cuda-nn's nerfacto and ours where it is installed, splatfacto where gsplat works."""
    from nerfstudio.utils.external import TCNN_EXISTS

    names = ["depth-nerfacto"]
    left_out = {}
    if TCNN_EXISTS and not settings.fake:
        names += ["nerfacto, tiny-cuda-nn", "ours, tiny-cuda-nn"]
    else:
        left_out["tiny-cuda-nn"] = "not installed"
    found = {} if settings.fake else raced(settings, names)
    if settings.fake or importlib.util.find_spec("gsplat") is None:
        left_out["splatfacto"] = "gsplat is not installed, or there is no GPU"
    else:
        splats = beside_others(settings, "splatfacto")  # gsplat compiles at its first call
        found, left_out = {**found, **splats}, {**left_out, **splats.get("left_out", {})}
    return {**found, "left_out": left_out}


def profile(settings: Settings) -> dict[str, Any]:
    """Launches and waiting as the driver sees them, seconds of host and device, memory; of a step of ours."""
    from torch.profiler import ProfilerActivity

    from benchmarks.speed.turns import Runner

    runner = Runner(configuration(settings), settings.folder / "profile")
    first = 20_000
    steps = range(first, first + (1 if settings.fake else PROFILED_STEPS))
    runner.iterate(steps)
    started = time.perf_counter()
    for step in steps:
        runner._iterate(step)
    host_s = time.perf_counter() - started
    synchronise()
    both_s = time.perf_counter() - started
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (not settings.fake)
    with torch.profiler.profile(activities=activities) as profiler:
        for step in steps:
            runner._iterate(step)
        synchronise()
    events = profiler.key_averages()

    def calls(names: Sequence[str]) -> float:
        return sum(event.count for event in events if event.key in names) / len(steps)

    on_device = [event for event in events if event.device_type == torch.autograd.DeviceType.CUDA]
    on_device.sort(key=lambda event: -event.self_device_time_total)
    memory = {}
    if not settings.fake:
        memory = {"allocated_gb": torch.cuda.max_memory_allocated() / 1e9}
        memory["reserved_gb"] = torch.cuda.max_memory_reserved() / 1e9
    return {
        "steps": len(steps),
        "host_ms": 1e3 * host_s / len(steps),
        "step_ms": 1e3 * both_s / len(steps),
        "device_ms": sum(event.self_device_time_total for event in on_device) / len(steps) / 1e3,
        "launches": calls(LAUNCHES),
        "copies": calls(("cudaMemcpyAsync", "cudaMemcpy")),
        # the profiler waits once itself, at the end
        "waits": max(0.0, calls(WAITS) - 1 / len(steps)),
        **memory,
        "slowest": [
            {"kernel": event.key[:120], "ms": event.self_device_time_total / len(steps) / 1e3, "calls": event.count}
            for event in on_device[:15]
        ],
    }


# ---- trainings ----------------------------------------------------------------------------------------------------


def trained(settings: Settings, steps: int, device_type: str) -> dict[str, Any]:
    """Train as `ns-train` does once it has read its arguments, and judge as `ns-eval` does."""
    from nerfstudio.scripts.train import main
    from nerfstudio.utils.eval_utils import eval_setup

    config = configuration(settings)
    config.machine.device_type, config.max_num_iterations = device_type, steps
    config.output_dir, config.experiment_name = settings.folder / "trained", f"{device_type}_{steps}"
    config.timestamp = f"{time.time():.0f}"
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    started = time.perf_counter()
    main(config)
    synchronise()
    taken_s = time.perf_counter() - started
    _, pipeline, _, _ = eval_setup(config.get_base_dir() / "config.yml")
    with torch.no_grad():
        figures: Any = pipeline.get_average_eval_image_metrics()
    kept = {name: float(value) for name, value in figures.items() if math.isfinite(float(value))}
    return {"steps": steps, "seconds_with_start": taken_s, "figures": kept}


def training(settings: Settings) -> dict[str, Any]:
    """A training of some hundred steps, from start to figures."""
    return trained(settings, 2 if settings.fake else TRAINED_STEPS, settings.device)


def beside_the_cpu(settings: Settings) -> dict[str, Any]:
    """The same steps on GPU and CPU, from the same seed: figures that should agree."""
    if settings.fake:
        return {"left_out": "there is no GPU"}
    return {kind: trained(settings, EQUAL_STEPS, kind) for kind in ("cuda", "cpu")}


PARTS = {
    "device": Part(device, 60),
    "counts": Part(counts, 120),
    "tests": Part(gpu_tests, 180),
    "kernels": Part(kernels, 120),
    "samples and losses": Part(samples_and_losses, 120),
    "our steps": Part(our_steps, 180),
    "other steps": Part(other_steps, 180),
    "profile": Part(profile, 120),
    "training": Part(training, 180),
    "beside the CPU": Part(beside_the_cpu, 180),
}
"""In the order of what is missed most if time runs out."""
