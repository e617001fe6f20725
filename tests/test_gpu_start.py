"""What a training on a GPU does before its first step: none of the CPU's kernels, and the GPU's ahead of it."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
import warnings
from typing import Any

import numpy as np
import pytest
import torch
from scenes import write_scene

from edge_depth_nerf.kernels import back_ends, functions, preparation
from edge_depth_nerf.kernels.back_ends import GpuForm, tried_out
from edge_depth_nerf.kernels.preparation import Preparation, told_of_compilation
from edge_depth_nerf.method.losses import step_kernels

CPU = torch.device("cpu")
SOON_S = 60.0

WITHOUT_NUMBA = """
import sys

sys.modules["numba"] = None  # whatever imports it fails

from pathlib import Path

import torch

CPU, to = torch.device("cpu"), torch.Tensor.to


def here(value):
    return CPU if isinstance(value, (str, torch.device)) and str(value).startswith("cuda") else value


# what goes to the GPU stays where it is
torch.Tensor.to = lambda tensor, *given, **more: to(tensor, *map(here, given), **{k: here(v) for k, v in more.items()})
torch.cuda.mem_get_info = lambda device: (1 << 40, 1 << 40)

from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig

config = FisheyeDepthDataManagerConfig(
    dataparser=FisheyeDepthDataParserConfig(data=Path(sys.argv[1])), cache_dir=Path(sys.argv[2])
)
manager = config.setup(device="cuda:0", test_mode="val")
assert manager.train_pixel_sampler.table.share_with_prior > 0.1
# the rays of a batch come from where their pixels are, which is the CPU here
manager.eval_ray_generator = torch.nn.Identity()
pixels, batch = manager.next_eval(0)
assert len(pixels) == len(batch["image"]) == config.eval_num_rays_per_batch
print("set up")
"""


@pytest.mark.slow
def test_set_up_on_a_gpu_needs_no_numba_and_gives_the_priors_of_the_cpu(tmp_path):
    """With a device in Numba's place; calibration, priors, tables of pixels and of rays, a batch of evaluation."""
    from test_datamanager import manager

    scene = write_scene(tmp_path / "scene", frames=4)
    command = [sys.executable, "-c", WITHOUT_NUMBA, str(scene), str(tmp_path / "gpu")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.stdout.endswith("set up\n"), done.stdout + done.stderr
    manager(scene, cache_dir=tmp_path / "cpu")
    for kind in ("pixels", "rays"):
        of_gpu, of_cpu = (
            {path.name: path.read_bytes() for path in (tmp_path / where / kind).glob("*.npy")}
            for where in ("gpu", "cpu")
        )
        assert of_gpu and of_gpu == of_cpu, kind
    priors = [sorted((tmp_path / where / "prior").glob("*.npz")) for where in ("gpu", "cpu")]
    assert len(priors[0]) == len(priors[1]) > 0
    for of_gpu, of_cpu in zip(*priors, strict=True):
        for name in ("distance_m", "sigma_m"):
            np.testing.assert_allclose(np.load(of_gpu)[name], np.load(of_cpu)[name], rtol=0, atol=2e-6)


@pytest.fixture
def nothing_tried(monkeypatch):
    monkeypatch.setattr(back_ends, "_tried", {})
    monkeypatch.setattr(preparation.os, "cpu_count", lambda: 4)


def doubling(name: str, load: Any = lambda: lambda x: 2 * x, tries: int = 1) -> GpuForm:
    """A stand-in for a kernel, which doubles a number."""
    examples = [{"x": torch.ones(3, requires_grad=True)}] * tries
    return GpuForm(name, load, lambda x: 2 * x, lambda _: examples, 1e-6, in_a_step=lambda _: examples)


def test_kernels_are_tried_out_side_by_side_after_the_first(nothing_tried):
    together, begun = threading.Barrier(2, timeout=SOON_S), []

    def load() -> Any:
        assert not gc.isenabled(), "a collection lets another thread parse, which Python 3.11.7 does not bear"
        begun.append("first is done" if (first, CPU) in back_ends._tried else "too early")
        together.wait()  # for the other one
        return lambda x: 2 * x

    first = doubling("first", tries=2)
    forms = [first, doubling("second", load), doubling("third", load), doubling("wrong", lambda: lambda x: 3 * x)]
    with pytest.warns(UserWarning, match="fused wrong does not work") as said:
        prepared = Preparation(forms, CPU)
        assert prepared.wait(SOON_S)
    assert gc.isenabled() and len(said) == 1 and begun == ["first is done"] * 2
    # a trial counts each example, at sizes of a step too; one that fails ends there
    assert (prepared.total, prepared.done) == (4 + 3 * 2, 4 + 2 * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [callable(tried_out(form, CPU)) for form in forms] == [True, True, True, False]
    assert len(begun) == 2


def test_what_fails_once_beside_others_is_tried_again(nothing_tried):
    calls = []

    def kernel(x: torch.Tensor) -> torch.Tensor:
        calls.append(x)
        if len(calls) == 1:
            raise RuntimeError("dictionary changed size during iteration")
        return 2 * x

    prepared = Preparation([doubling("first"), doubling("stumbles", lambda: kernel, tries=2)], CPU)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert prepared.wait(SOON_S)
    assert back_ends._tried[next(form for form, _ in back_ends._tried if form.name == "stumbles"), CPU] is kernel
    assert len(calls) == 5 and prepared.done == prepared.total


def test_who_needs_a_kernel_meanwhile_waits_for_its_trial(nothing_tried):
    loads, begun, may_end = [], threading.Event(), threading.Event()

    def load() -> Any:
        loads.append(threading.current_thread().name)
        begun.set()
        assert may_end.wait(SOON_S)
        return lambda x: 2 * x

    form = doubling("slow", load)
    prepared = Preparation([doubling("first"), form], CPU)
    assert begun.wait(SOON_S)
    found: list[Any] = []
    step = threading.Thread(target=lambda: found.append(tried_out(form, CPU)), daemon=True)
    step.start()
    step.join(0.2)
    assert step.is_alive() and not prepared.wait(0.0)
    may_end.set()
    step.join(SOON_S)
    assert prepared.wait(SOON_S) and callable(found[0]) and len(loads) == 1


def test_nothing_is_begun_after_it_is_given_up(nothing_tried):
    begun, may_end = threading.Event(), threading.Event()

    def load() -> Any:
        begun.set()
        assert may_end.wait(SOON_S)
        return lambda x: 2 * x

    forms = [doubling("first", load), doubling("second")]
    prepared = Preparation(forms, CPU)
    assert begun.wait(SOON_S)
    prepared.give_up()
    may_end.set()
    assert prepared.wait(SOON_S) and [form.name for form, _ in back_ends._tried] == ["first"]


class Prepared:
    """A stand-in for trials: `steps` are what each look finds, how many are done and whether one was compiled."""

    def __init__(self, *steps: tuple[int, bool]) -> None:
        self.steps, self.total, self.done, self.compiles = list(steps), 31, 0, False
        self.given: list[Any] = []
        self.given_up = False

    def __call__(self, forms: Any, device: torch.device) -> Prepared:
        self.given.append((len(forms), device))
        return self

    def wait(self, seconds: float) -> bool:
        if self.steps:
            self.done, self.compiles = self.steps.pop(0)
        return not self.steps

    def give_up(self) -> None:
        self.given_up = True


@pytest.mark.parametrize(
    ("device", "compiles", "line"),
    [("cuda:0", True, True), ("cuda:0", False, False), ("cpu", True, False)],
    ids=["compiles", "is on disk", "on the CPU"],
)
def test_a_line_counts_what_is_compiled_for_a_gpu(device, compiles, line, monkeypatch, capsys):
    from edge_depth_nerf.plugin.fused import build

    prepared = Prepared((0, False), (1, compiles), (12, compiles), (31, compiles))
    monkeypatch.setattr(build, "Preparation", prepared)
    with build.kernels_prepared(device):
        assert prepared.given == ([(len(step_kernels()), torch.device("cuda:0"))] if device != "cpu" else [])
        assert len(prepared.steps) == 4
    said = capsys.readouterr().out
    assert ("Compiling for this GPU, once:" in said and "31/31" in said) == line and bool(said) == line
    assert len(prepared.steps) == (4 if device == "cpu" else 0)


def test_an_error_of_the_set_up_does_not_wait_for_kernels(monkeypatch):
    from edge_depth_nerf.plugin.fused import build

    prepared = Prepared((0, False), (31, True))
    monkeypatch.setattr(build, "Preparation", prepared)
    with pytest.raises(ValueError, match="no scene"), build.kernels_prepared("cuda:0"):
        raise ValueError("no scene")
    assert prepared.given_up and len(prepared.steps) == 2


def test_a_training_prepares_kernels_around_its_set_up(monkeypatch, tmp_path):
    """Those of a GPU; a pipeline that only evaluates, or computes with torch, prepares none."""
    from contextlib import contextmanager

    from models import pipeline_config

    from edge_depth_nerf.plugin import pipeline

    order, scene = list[str](), write_scene(tmp_path / "scene", frames=2)

    @contextmanager
    def around(device: Any) -> Any:
        order.append(f"begins on {device}")
        yield
        order.append("ends")

    def set_up(*_: Any, **__: Any) -> None:
        order.append("set-up")
        raise InterruptedError  # enough

    monkeypatch.setattr(pipeline, "kernels_prepared", around)
    monkeypatch.setattr(pipeline.VanillaPipeline, "__init__", set_up)
    for more, begins in (({}, ["begins on cuda:0"]), ({"implementation": "torch"}, [])):
        for mode in ("val", "test", "inference"):
            order.clear()
            with pytest.raises(InterruptedError):
                pipeline_config(scene, **more).setup(device="cuda:0", test_mode=mode)
            assert order == [*(begins if mode == "val" else []), "set-up"]


def test_the_cpus_line_is_not_of_a_gpu(monkeypatch, capsys):
    from models import build

    from edge_depth_nerf.plugin import model

    asked = []
    monkeypatch.setattr(model, "compiled_before", lambda: asked.append(1))
    build(device="cuda:0")
    assert "Compiling" not in capsys.readouterr().out and not asked
    build()
    assert "Compiling kernels for the first steps" in capsys.readouterr().out


def test_examples_of_a_step_have_the_full_presets_sizes():
    from nerfstudio.configs.method_configs import all_methods

    model: Any = all_methods["edge-depth-nerf"].pipeline.model
    assert model.num_proposal_samples_per_ray == functions.PROPOSALS
    assert model.num_nerf_samples_per_ray == functions.SAMPLES
    assert (model.num_levels, model.proposal_net_args_list[0]["num_levels"]) == functions.LEVELS
    assert all(form.in_a_step(CPU) for form in step_kernels())
    # the field's densities are a column of its network's outputs
    strides, form = [], next(each for each in step_kernels() if each.name == "density")
    for example in form.in_a_step(CPU):
        back_ends._outcome(lambda before, **_: strides.append(before.stride(0)) or before, example)
    assert strides == [1, 16]


@pytest.mark.slow
def test_each_example_is_compiled_once_side_by_side(nothing_tried, monkeypatch, tmp_path):
    """By Triton itself, for a GPU that is not there: kernels are compiled and not run."""
    pytest.importorskip("triton")
    import ahead_of_time

    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(GpuForm, "_compare", lambda *_: None)
    for compiles in (True, False):
        back_ends._tried.clear()
        with warnings.catch_warnings(), ahead_of_time._compiling_for(90) as found:
            warnings.simplefilter("error")
            prepared = Preparation(step_kernels(), CPU)
            assert prepared.wait(600.0)
        assert prepared.compiles == compiles and prepared.done == prepared.total > len(step_kernels())
        assert len(found) > prepared.total  # forward and backward
        assert all(callable(each) for each in back_ends._tried.values())


def test_other_listeners_of_triton_still_hear(monkeypatch):
    knobs: Any = pytest.importorskip("triton.knobs")
    heard, told = [], []
    monkeypatch.setattr(knobs.compilation, "listener", lambda **given: heard.append(given))
    before = knobs.compilation.listener
    with told_of_compilation(lambda: told.append(1)):
        for cache_hit in (True, False):
            knobs.compilation.listener(src=None, cache_hit=cache_hit)
    assert [each["cache_hit"] for each in heard] == [True, False] and told == [1]
    assert knobs.compilation.listener is before
