"""The parts of `benchmarks.speed.gpu`: what each measures on a GPU, as a dictionary for JSON.

Each runs with `Settings` that say whether it is meant: without a GPU (`fake`) sizes are tiny, everything is on the CPU,
and the figures mean nothing; what runs is the same code. In what a part gives, numbers and words stand for themselves,
and lists of rows are tables. A part with several rows keeps them as they come, for the case that it is ended.
"""

from __future__ import annotations

import copy
import importlib.util
import itertools
import os
import random
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests"
STARTED_STEPS = 60
"""So many are enough for both kinds of steps to be recorded."""
TRAINED_STEPS = 5_000
PROFILED_STEPS = 20
LATE = 20_000
"""A step of the schedule by which proposal networks rest in most steps."""
RENDERED_RAYS = 1 << 20
CALLS = 20
"""So many calls of a function are recorded as one CUDA graph."""
GRIDS = {
    "field": (16, 19, 4096 * 48 + 4096 + 16384, 2048),
    "proposal 0": (5, 17, 4096 * 256, 128),
    "proposal 1": (5, 17, 4096 * 96, 256),
}
"""Hash grids of a step of the full preset: levels, log2 of a level's rows, points, finest resolution. The field has
4,096 rays with the sky behind them, and 16,384 surface pixels."""
LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch")
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize", "cudaMemcpy")
CACHES = {"TRITON_CACHE_DIR": "triton", "TORCHINDUCTOR_CACHE_DIR": "inductor", "NUMBA_CACHE_DIR": "numba"}
"""The variables of the environment that say where compiled kernels are kept, and folders for them."""
Found = dict[str, Any]


@dataclass(frozen=True)
class Settings:
    """What a part is to measure."""

    scene: Path
    folder: Path
    """For what is written on the way."""
    fake: bool = False
    began: float = field(default_factory=time.time)
    """When the part's process was started, as `time.time` counts."""
    keep: Callable[[Found], object] = lambda _: None
    """Takes what is known so far."""

    @property
    def device(self) -> str:
        """Where it runs."""
        return "cpu" if self.fake else "cuda"

    @property
    def caches(self) -> Path:
        """For compiled kernels and what is made of the scene: empty at the first start."""
        return self.folder / "caches"

    @property
    def alone(self) -> Path:
        """This file is there as soon as nothing is timed any more that runs alone."""
        return self.folder / "nothing_runs_alone"

    def adjust(self, config: Any) -> None:
        """Keep the scene as it is; make what is trained tiny, where it is not meant."""
        config.pipeline.datamanager.cache_dir = self.caches / "scene"
        if self.fake:
            shrink(config)


@dataclass(frozen=True)
class Part:
    """A measurement with a limit of its own."""

    run: Callable[[Settings], Found]
    limit_s: int
    group: str = ""
    """Parts of a group run at the same time."""


# ---- trainings ----------------------------------------------------------------------------------------------------


def configuration(settings: Settings, method: str = "edge", seed: int = 0, steps: int | None = None) -> Any:
    """The full preset on the scene, as `compare` makes it of a method; schedules are as long as the training."""
    from edge_depth_nerf.compare.configuration import configuration as compared
    from edge_depth_nerf.compare.specification import RunSpecification

    config, _ = compared(RunSpecification(str(settings.scene), "", "full", method, seed, steps))
    settings.adjust(config)
    return config


def shrink(config: Any) -> None:
    """Make what is trained tiny."""
    model, data = config.pipeline.model, config.pipeline.datamanager
    model.num_levels, model.log2_hashmap_size = 2, 8
    model.proposal_net_args_list = [{**each, "log2_hashmap_size": 8} for each in model.proposal_net_args_list]
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (8, 8), 8
    data.train_num_rays_per_batch, data.eval_num_rays_per_batch = 64, 64
    if data.surface_rays_per_batch:
        data.surface_rays_per_batch = 64


def synchronise() -> None:
    """Wait for a GPU, where there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def started(settings: Settings) -> Found:
    """The first steps of a training in this process, which has done nothing before; whether they were recorded."""
    import triton
    from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

    from benchmarks.speed.turns import KINDS_OF_STEPS, Runner, machine

    config = configuration(settings)
    about: Found = {**machine(), "triton": triton.__version__, "cuda": torch.version.cuda}
    # Numba's is made by imports
    about["caches before"] = "filled" if (settings.caches / "scene").exists() else "empty"
    ready = time.time()
    runner = Runner(config, settings.folder / "started")
    set_up, steps_s = time.time(), []

    def after_step(step: int) -> None:
        synchronise()
        steps_s.append(time.time())

    after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    runner.trainer.callbacks.append(TrainingCallback(after, after_step))
    runner.trainer.config.max_num_iterations = 2 if settings.fake else STARTED_STEPS
    runner.trainer.train()
    recorded = runner.graphs(None)
    lasted_ms = [1e3 * (end - start) for start, end in itertools.pairwise(steps_s)]
    return {
        "graphs recorded": recorded,
        "both kinds of steps recorded": recorded == KINDS_OF_STEPS,
        "imports, s": ready - settings.began,
        "set-up, s": set_up - ready,
        "first step, s": steps_s[0] - set_up,
        "until the first step is done, s": steps_s[0] - settings.began,
        "longest step after it, ms": max(lasted_ms),
        "last steps, each waited for, ms": lasted_ms[-20:],
        **about,
    }


def trained(settings: Settings, method: str, seed: int) -> Found:
    """A training from start to figures, as `ns-train` and `ns-eval` do it."""
    from benchmarks.speed.turns import Runner

    steps = 2 if settings.fake else TRAINED_STEPS
    config = configuration(settings, method, seed, steps)
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 (nerfstudio draws from the global generator)
    runner = Runner(config, settings.folder / f"{method}_{seed}", seed)
    set_up = time.time()
    runner.trainer.train()
    synchronise()
    ended = time.time()
    with torch.no_grad():
        figures: Any = runner.trainer.pipeline.get_average_eval_image_metrics()
    return {
        "steps": steps,
        "start, s": set_up - settings.began,
        "steps, s": ended - set_up,
        "graphs recorded": runner.graphs(None),
        **{name: float(value) for name, value in figures.items()},
    }


def cloud_of_prior(settings: Settings) -> Path:
    """The scene as `export` writes it, whose points.ply is the prior's cloud: at most as many points as LiDAR's."""
    from rich.console import Console

    from edge_depth_nerf.export.command import export_scene
    from edge_depth_nerf.export.options import ExportOptions
    from edge_depth_nerf.scene.points import MAX_POINTS

    output = settings.folder / "with_the_priors_cloud"
    return export_scene(ExportOptions(settings.scene, output=output, most_points=MAX_POINTS), Console(quiet=True))


def splatted(settings: Settings, scene: Path, name: str) -> Found:
    """A training of nerfstudio's splatfacto, judged on its rectified pictures, inside their masks."""
    from nerfstudio.configs.method_configs import method_configs
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from benchmarks.speed.turns import Runner
    from edge_depth_nerf.method.metrics import masked_psnr

    config: Any = copy.deepcopy(method_configs["splatfacto"])
    config.pipeline.datamanager.dataparser = NerfstudioDataParserConfig(data=scene, load_3D_points=True)
    config.max_num_iterations = config.optimizers["means"]["scheduler"].max_steps = TRAINED_STEPS
    config.pipeline.model.stop_split_at = TRAINED_STEPS // 2
    config.steps_per_eval_batch = config.steps_per_eval_image = config.steps_per_eval_all_images = 0
    began = time.time()
    runner = Runner(config, settings.folder / "splats" / name)
    runner.trainer.train()
    synchronise()
    taken_s = time.time() - began
    pipeline: Any = runner.trainer.pipeline.eval()
    psnr = []
    with torch.no_grad():
        for camera, batch in pipeline.datamanager.fixed_indices_eval_dataloader:
            rgb = pipeline.model.get_outputs_for_camera(camera.to(pipeline.device))["rgb"]
            mask = batch.get("mask", torch.ones(rgb.shape[:2], dtype=torch.bool)).reshape(rgb.shape[:2]).to(rgb.device)
            psnr.append(float(masked_psnr(rgb, pipeline.model.get_gt_img(batch["image"]), mask)))
    return {"points": name, "steps": TRAINED_STEPS, "s": taken_s, "masked PSNR, dB": statistics.fmean(psnr)}


def splats(settings: Settings) -> Found:
    """splatfacto from LiDAR's points and from the prior's cloud, where gsplat compiles; it trains beside the others."""
    if settings.fake or importlib.util.find_spec("gsplat") is None:
        return {"left out": "there is no GPU, or no gsplat"}
    began = time.time()
    # most cores are left to what is timed meanwhile
    os.environ.setdefault("MAX_JOBS", "4")
    from gsplat.cuda import _backend  # compiles

    if getattr(_backend, "_C", None) is None:
        return {"left out": "gsplat found no CUDA compiler; the log says more"}
    found: Found = {"gsplat compiled, s": time.time() - began, "rows": []}
    while not settings.alone.exists():
        time.sleep(0.2)
    for name, scene in (("LiDAR", lambda: settings.scene), ("prior", lambda: cloud_of_prior(settings))):
        found["rows"].append(splatted(settings, scene(), name))
        settings.keep(found)
    return found


# ---- steps --------------------------------------------------------------------------------------------------------


def steps(settings: Settings) -> Found:
    """Milliseconds of a step of ours, as it is and without graphs, and of nerfacto in torch, in turns."""
    from benchmarks.speed import report, turns

    count, rounds = (1, 1) if settings.fake else (20, 2)
    names = [turns.REFERENCE, "ours", *([] if settings.fake else [turns.EAGER])]
    configs = turns.configurations("full", settings.scene, names, settings.adjust)
    firsts = [first + number * count for first in (turns.WARM_UPS, LATE) for number in range(rounds)]
    found = turns.race(configs, len(firsts), count, firsts=firsts)
    rays = configs["ours"].pipeline.datamanager.train_num_rays_per_batch
    rows = []
    for name, each in found.items():
        early, late = ([1e3 * taken for taken in part] for part in (each["step_s"][:rounds], each["step_s"][rounds:]))
        row = {"trainer": name, "ms a step, early": early, "ms a step, late": late}
        row["rays/s, late"] = 1e3 * rays / statistics.median(late)
        faster = report.ratios(found[turns.REFERENCE]["step_s"], each["step_s"])
        row |= {"× nerfacto in torch, late": faster[rounds:], "graphs": each["graphs"]}
        rows.append(row)
    return {"rays": rays, "early, from step": firsts[0], "late, from step": LATE, "rows": rows}


def profile(settings: Settings) -> Found:
    """A step of ours as the driver sees it: kernels, launches, copies, waits, memory; then a view."""
    from torch.profiler import ProfilerActivity

    from benchmarks.speed.turns import WARM_UPS, Runner

    runner = Runner(configuration(settings), settings.folder / "profile")
    runner.iterate(range(1 if settings.fake else WARM_UPS))
    chosen = range(LATE, LATE + (1 if settings.fake else PROFILED_STEPS))
    runner.iterate(chosen)
    started_s = time.perf_counter()
    for step in chosen:
        runner._iterate(step)
    host_s = time.perf_counter() - started_s
    synchronise()
    both_s = time.perf_counter() - started_s
    memory = {}
    if not settings.fake:
        memory = {"allocated, GB": torch.cuda.max_memory_allocated() / 1e9}
        memory["reserved, GB"] = torch.cuda.max_memory_reserved() / 1e9
    activities = [ProfilerActivity.CPU] + [ProfilerActivity.CUDA] * (not settings.fake)
    with torch.profiler.profile(activities=activities) as profiler:
        for step in chosen:
            runner._iterate(step)
        synchronise()
    events = profiler.key_averages()

    def calls(names: Sequence[str]) -> float:
        return sum(event.count for event in events if event.key in names) / len(chosen)

    on_device = [event for event in events if event.device_type == torch.autograd.DeviceType.CUDA]
    on_device.sort(key=lambda event: -event.self_device_time_total)
    runner.render(RENDERED_RAYS)
    rendered_s, (height, width) = runner.render(RENDERED_RAYS)
    return {
        "graphs recorded": runner.graphs(None),
        "ms a step": 1e3 * both_s / len(chosen),
        "ms of the host": 1e3 * host_s / len(chosen),
        "ms of the device": sum(event.self_device_time_total for event in on_device) / len(chosen) / 1e3,
        "kernels": sum(event.count for event in on_device) / len(chosen),
        "launches": calls(LAUNCHES),
        "copies": calls(("cudaMemcpyAsync", "cudaMemcpy")),
        # the profiler waits once itself, at the end
        "waits": max(0.0, calls(WAITS) - 1 / len(chosen)),
        **memory,
        f"a view of {width} × {height} px, s": rendered_s,
        "rendered rays/s": width * height / rendered_s,
        "rows": [
            {
                "kernel": event.key[:120],
                "ms a step": event.self_device_time_total / len(chosen) / 1e3,
                "calls a step": event.count / len(chosen),
            }
            for event in on_device[:40]
        ],
    }


# ---- kernels ------------------------------------------------------------------------------------------------------


def device_us(work: Callable[[], object], settings: Settings) -> float:
    """Microseconds of a call on the device: many in one replayed CUDA graph, as launches hide what is below 50."""
    if settings.fake:
        began = time.perf_counter()
        work()
        return 1e6 * (time.perf_counter() - began)
    beside = torch.cuda.Stream()
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):
        for _ in range(3):
            work()
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        for _ in range(CALLS):
            work()
    taken_ms = []
    for _ in range(6):
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        start.record()
        graph.replay()
        end.record()
        torch.cuda.synchronize()
        taken_ms.append(start.elapsed_time(end))
    return 1e3 * statistics.median(taken_ms[1:]) / CALLS


def worked(
    function: Callable[..., Any], given: dict[str, Any], factors: Sequence[Tensor] | None = None
) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """What a function gives, and the gradients of it, times factors, to what wants one."""
    found = function(**given)
    results = found if isinstance(found, tuple) else (found,)
    wanting = [each for each in given.values() if isinstance(each, Tensor) and each.requires_grad]
    if not wanting:
        return results, ()
    return results, torch.autograd.grad(results, wanting, factors or [torch.ones_like(each) for each in results])


def outcome(function: Callable[..., Any], given: dict[str, Any]) -> Tensor:
    """What a function and its gradients give, in one row."""
    results, gradients = worked(function, given)
    return torch.cat([each.detach().flatten().double() for each in (*results, *gradients)])


def call_us(function: Callable[..., Any], given: dict[str, Any], settings: Settings) -> float:
    """Microseconds of a call, with its gradients."""
    factors = [torch.ones_like(each) for each in worked(function, given)[0]]
    return device_us(partial(worked, function, given, factors), settings)


def make_points(count: int, *, along_rays: bool) -> Tensor:
    """Points in the unit cube; 32 to a ray, as those of a training batch, or anywhere."""
    if not along_rays:
        return torch.rand(count, 3)
    starts = torch.rand(count // 32, 1, 3)
    ends = torch.rand(count // 32, 1, 3)
    places, _ = torch.rand(count // 32, 32, 1).sort(dim=1)
    return (starts + places * (ends - starts)).view(-1, 3)


def arguments(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """What each function with a form for a GPU is given in a step of the full preset, by the form's name."""
    from edge_depth_nerf.kernels.functions import PROPOSALS, STEP

    device, dtype = settings.device, torch.float32 if settings.fake else torch.float16
    sizes = STEP._replace(dtypes=(dtype,))
    if not settings.fake:
        sizes = sizes._replace(rays=4096, points=4096 * PROPOSALS[0])

    def grid(levels: int, log2_rows: int, count: int, finest: int, along_rays: bool) -> dict[str, Any]:
        if settings.fake:
            count, log2_rows = 320, 8
        scalings = torch.floor(16 * (finest / 16) ** (torch.arange(levels, device=device) / (levels - 1)))
        # as large as at the beginning of a training
        table = 1e-4 * (2 * torch.rand(levels << log2_rows, 2, device=device) - 1)
        points = make_points(count, along_rays=along_rays).to(device)
        return {"positions": points, "table": table.requires_grad_(), "scalings": scalings, "dtype": dtype}

    grids = [grid(*size, along) for size in GRIDS.values() for along in (True, False)]
    given = {
        name: each.on_gpu.in_a_step(torch.device(device), sizes=sizes) for name, each in functions_of_a_gpu().items()
    }
    return given | {"hash grid": grids}


def functions_of_a_gpu() -> dict[str, Any]:
    """The functions that have a form for a GPU, by the form's name."""
    from edge_depth_nerf.kernels import functions
    from edge_depth_nerf.kernels.back_ends import Function
    from edge_depth_nerf.method import losses

    every = [each for module in (functions, losses) for each in vars(module).values() if isinstance(each, Function)]
    return {each.on_gpu.name: each for each in every if each.on_gpu is not None}


def beside_torch(name: str, function: Any, given: dict[str, Any], settings: Settings) -> Found:
    """Times of a function's form for a GPU and of its formula, and how far it is off; `failed` says why it has none."""
    shapes = ", ".join("×".join(map(str, each.shape)) for each in given.values() if isinstance(each, Tensor))
    kinds = ("kernel, µs", "torch, µs", "off torch", "off the CPU", "failed")
    row: Found = {"function": name, "of": shapes, **dict.fromkeys(kinds)}
    # the CPU has no half precision
    whole = {key: torch.float32 if key == "dtype" else each for key, each in given.items()}
    try:
        kernel, formula = function.on(torch.device(settings.device)), function.on_gpu.formula
        if kernel is None and settings.fake:
            kernel = formula  # most have no form for the CPU
        assert kernel is not None
        row["torch, µs"] = call_us(formula, given, settings)
        row["kernel, µs"] = call_us(kernel, given, settings)
        ours, host = outcome(kernel, whole), outcome(formula, whole)
        row["off torch"] = float((ours - host).norm() / host.norm())
        if name == "hash grid":
            there = {
                key: each.detach().cpu().requires_grad_(each.requires_grad) if isinstance(each, Tensor) else each
                for key, each in whole.items()
            }
            on_cpu = outcome(function.on_cpu(), there)
            row["off the CPU"] = float((ours.cpu() - on_cpu).norm() / on_cpu.norm())
    except Exception as error:  # as of a function that cannot be recorded
        row["failed"] = f"{type(error).__name__}: {error}"[:200]
    return row


def kernels(settings: Settings) -> Found:
    """Each function that has a form for a GPU beside its formula in torch; hash grids beside the CPU's, too."""
    torch.manual_seed(0)
    given = arguments(settings)
    copied = torch.empty(1 << (16 if settings.fake else 28), device=settings.device)
    copied_us = device_us(copied.clone, settings)
    found: Found = {"a copy, GB/s": 2 * copied.numel() * copied.element_size() / copied_us / 1e3, "rows": []}
    # hash grids last, as the CPU's are slow
    for name, function in sorted(functions_of_a_gpu().items(), key=lambda item: item[0] == "hash grid"):
        for each in given[name]:
            found["rows"].append(beside_torch(name, function, each, settings))
            settings.keep(found)
    return found


# ---- tests --------------------------------------------------------------------------------------------------------


def tests_of_a_gpu() -> list[Path]:
    """The files that have such tests."""
    return [path for path in sorted(TESTS.glob("test_*.py")) if "_on_a_gpu(" in path.read_text(encoding="utf-8")]


def gpu_tests(settings: Settings) -> Found:
    """The tests that a machine without a GPU skips, by number: their names end with `on_a_gpu`."""
    files = [TESTS / "test_grad_scaler.py"] if settings.fake else tests_of_a_gpu()
    command = [sys.executable, "-m", "pytest", *map(str, files), "-p", "no:cacheprovider"]
    command += [f"--basetemp={settings.folder / 'tests'}", *(["-n", "0"] if settings.fake else ["-n", "8"])]
    command += [] if settings.fake else ["-k", "on_a_gpu"]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    last = done.stdout.strip().rpartition("\n")[2]
    counted: Found = {what: int(number) for number, what in re.findall(r"(\d+) (passed|failed|skipped|error)", last)}
    if done.returncode:
        counted |= {"failed": f"pytest ended with status {done.returncode}", "said": done.stdout[-4000:]}
    return counted


def counts(settings: Settings) -> Found:
    """What a step would ask for, counted on fake tensors, as the tests do."""
    from benchmarks.speed import gpu_counts

    if reason := gpu_counts.why_not():
        return {"left out": reason}
    cases = ["lite"] if settings.fake else ["full", "full, proposals rest"]
    found = gpu_counts.in_a_process(cases, settings.scene, settings.folder / "counts")
    return {
        "rows": [
            {
                "step": case,
                "kernels": each["kernels"],
                "GB of torch's operations": each["gigabytes"],
                "uploads": len(each["uploads"]),
                "places that wait": len(each["synchronisations"]),
            }
            for case, each in found.items()
        ]
    }


TRAININGS = "trainings"
SPLATS = "splats"
METHODS = {
    "ours": ("edge", 0),
    "nerfacto": ("nerfacto", 0),
    "DS-NeRF on LiDAR": ("ds-nerf", 0),
    "ours again": ("edge", 1),
}
"""Methods of `compare`, and seeds: the rivals have no extras, as they were published."""
PARTS = {
    "recording": Part(started, 50),
    "steps": Part(steps, 60),
    "profile": Part(profile, 40),
    "start": Part(started, 35),
    "kernels": Part(kernels, 60),
    **{name: Part(partial(trained, method=m, seed=s), 130, TRAININGS) for name, (m, s) in METHODS.items()},
    SPLATS: Part(splats, 470),
    "tests": Part(gpu_tests, 60, "checks"),
    "counts": Part(counts, 60, "checks"),
}
"""In the order of what is missed most if time runs out; `recording` is the first start, `start` the second."""
