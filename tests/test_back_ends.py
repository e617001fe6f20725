"""Which form serves: kernels of a GPU are compared with their formulas first, and left out one by one."""

from __future__ import annotations

import sys
import warnings
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from interpreted import NEEDS_A_GPU, in_interpreter
from torch._subclasses.fake_tensor import FakeTensorMode

from edge_depth_nerf.kernels import back_ends, contraction_numba, formulas, functions
from edge_depth_nerf.kernels.back_ends import GpuForm, tried_out
from edge_depth_nerf.kernels.functions import (
    CONTRACT,
    DENSITY,
    DISTANCES,
    DISTORTION_LOSS,
    HARMONICS,
    HASH_GRID,
    INTERLEVEL_LOSS,
    MOST,
    SAMPLE_PDF,
    WEIGHTS,
)
from edge_depth_nerf.kernels.triton_launch import launch
from edge_depth_nerf.method.losses import EDGE_LOSS, step_kernels
from edge_depth_nerf.plugin.step_losses import distortion_loss

CPU = torch.device("cpu")
FUNCTIONS = SAMPLE_PDF, INTERLEVEL_LOSS, DISTORTION_LOSS, WEIGHTS, CONTRACT, DISTANCES, HARMONICS
EVERY: tuple[Any, ...] = tuple(step_kernels())
FEW_RAYS = functions.STEP._replace(rays=2)
"""A step's, as the interpreter is slow."""
ALL = (*(each for each in vars(functions).values() if isinstance(each, back_ends.Function)), EDGE_LOSS)


@pytest.fixture(autouse=True)
def nothing_tried(monkeypatch):
    monkeypatch.setattr(back_ends, "_tried", {})


def changed(results: Any, change: Any) -> Any:
    return tuple(map(change, results)) if isinstance(results, tuple) else change(results)


class Detour(torch.autograd.Function):
    """The numbers as they are, a gradient that is not theirs: a thousandth too large, or no number."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, factor: float) -> torch.Tensor:
        ctx.factor = factor
        return values.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        return gradients[0] * ctx.factor, None


def spoilt(form: GpuForm, how: str) -> GpuForm:
    """A form whose kernel is the formula, but for a fault."""

    def kernel(**given: Any) -> Any:
        result = form.formula(**given)
        if how == "raises":
            raise RuntimeError("no compiler")
        changes = {
            "right": lambda each: each,
            "wrong": lambda each: each * 1.002,
            "no number": lambda each: each * float("nan"),
            "wrong gradient": lambda each: Detour.apply(each, 1.002),
            "gradient of no number": lambda each: Detour.apply(each, float("nan")),
            "no gradient": lambda each: each.detach().requires_grad_(),
            "another shape": lambda each: each[None],
        }
        return changed(result, changes[how])

    return replace(form, load=lambda: kernel)


REASONS = {
    "raises": "RuntimeError: no compiler",
    "wrong": "its result is off by 2.0e-03 of the largest value",
    "no number": "its result is off by nan",
    "another shape": "its result is missing or has another shape",
}
OF_GRADIENTS = {
    "wrong gradient": "its gradient is off by 2.0e-03 of the largest value",
    "gradient of no number": "its gradient is off by nan",
    "no gradient": "its gradient is missing",
}


FOLLOWED = {each.on_gpu.name for each in ALL if each.on_gpu is not None and each.follows and each is not SAMPLE_PDF}
FAULTS = [
    pytest.param(form, how, id=f"{form.name}, {how}")
    for form in EVERY
    for how in (*REASONS, *(OF_GRADIENTS if form.name in FOLLOWED else ()))
]


@pytest.mark.parametrize(("form", "how"), FAULTS)
def test_a_kernel_with_a_fault_is_left_out_by_name(form, how):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = spoilt(form, "right")
        assert tried_out(right, CPU) is right.load()
    wrong = spoilt(form, how)
    with pytest.warns(UserWarning) as said:
        assert tried_out(wrong, CPU) is None
    (warning,) = said
    assert f"The fused {form.name} does not work on cpu ({(REASONS | OF_GRADIENTS)[how]}" in str(warning.message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # once
        assert tried_out(wrong, CPU) is None


def check_that_trials_run_each_kernel() -> None:
    """All kernels give what their formulas give; where one is spoilt, it alone is left out."""
    from edge_depth_nerf.kernels import hash_grid_triton, pointwise_triton, ray_triton
    from edge_depth_nerf.method import edge_loss_triton

    modules: list[Any] = [hash_grid_triton, pointwise_triton, ray_triton, edge_loss_triton]
    launch, launched = modules[0].launch, set()

    def launching(kernel: Any, *given: Any, **constants: Any) -> None:
        launched.add(kernel.__name__)
        launch(kernel, *given, **constants)

    for module in modules:
        module.launch = launching
    forms = {form.name: replace(form, in_a_step=partial(form.in_a_step, sizes=FEW_RAYS)) for form in EVERY}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert all(callable(tried_out(form, CPU)) for form in forms.values())
    assert launched == {name for module in modules for name in vars(module) if name.endswith("_kernel")}

    # the others are known to be right
    del back_ends._tried[forms["distortion loss"], CPU]
    right = modules[2].distortion_loss

    def off(edges: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        return right(edges, weights) + (weights - weights.detach()).sum()

    modules[2].distortion_loss = off
    with pytest.warns(UserWarning, match="fused distortion loss does not work .*gradient") as said:
        found = {name: tried_out(form, CPU) for name, form in forms.items()}
    assert len(said) == 1 and [name for name, each in found.items() if each is None] == ["distortion loss"]


@pytest.mark.slow
def test_all_kernels_in_the_interpreter():
    pytest.importorskip("triton")
    import test_edge_loss_triton
    import test_hash_grid_triton
    import test_ray_triton

    checks = [*test_edge_loss_triton.CHECKS, *test_hash_grid_triton.CHECKS, *test_ray_triton.CHECKS]
    in_interpreter(*checks, check_that_trials_run_each_kernel)  # which changes what the others need


@NEEDS_A_GPU
def test_each_kernel_is_right_on_a_gpu():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = [tried_out(form, torch.device("cuda", 0)) for form in EVERY]
    assert all(map(callable, found))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_rendering_may_be_the_first_that_needs_a_kernel(mode):
    """Without gradients, and traced by the viewer, which raises an error to end a picture."""

    class Interrupted(Exception):
        pass

    def traced(*_: Any) -> Any:
        if asked:
            raise Interrupted
        return traced

    asked = []
    right = spoilt(EVERY[-1], "right")

    def examples(device: torch.device) -> Any:
        asked.append(device)
        return right.examples(device)

    form = replace(right, examples=examples)
    before = sys.gettrace()
    with mode(), warnings.catch_warnings():
        warnings.simplefilter("error")
        sys.settrace(traced)
        try:
            tried_out(form, CPU)
        except Interrupted:
            pass  # after the trial, where it is a rendering that ends
        finally:
            sys.settrace(before)
    assert tried_out(form, CPU) is right.load() and asked == [CPU]


def test_no_picture_ends_within_the_compilation_of_a_kernel():
    seen = []

    def traced(*_: Any) -> Any:
        return traced

    before = sys.gettrace()
    sys.settrace(traced)
    try:
        launch({(1,): lambda *_, **__: seen.append(sys.gettrace())}, (1,), torch.zeros(1))
        seen.append(sys.gettrace())
    finally:
        sys.settrace(before)
    assert seen == [None, traced]


def test_nothing_is_tried_while_a_cuda_graph_is_recorded(monkeypatch):
    form, recorded = spoilt(EVERY[0], "right"), spoilt(EVERY[1], "right")
    assert tried_out(form, CPU)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    assert tried_out(form, CPU) is not None
    with pytest.raises(RuntimeError, match="was not tried out before a CUDA graph is recorded"):
        tried_out(recorded, CPU)
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    assert tried_out(recorded, CPU) is not None


def of_size(*shape: int, device: str = "cuda", dtype: torch.dtype = torch.float32, followed: bool = False) -> Any:
    with FakeTensorMode():
        return torch.empty(shape, device=device, dtype=dtype, requires_grad=followed)


def test_what_kernels_serve(monkeypatch):
    """float32 of one device; on a GPU rays that stay on the chip, and numbers without a gradient."""
    monkeypatch.setattr(back_ends, "tried_out", lambda form, device: form.load if device.type == "cuda" else None)
    loads: Any = {function: getattr(function.on_gpu, "load", None) for function in FUNCTIONS}
    x, half, on_cpu = of_size(4, 48), of_size(4, 48, dtype=torch.float16), of_size(4, 48, device="cpu")
    followed, longest, too_long = of_size(4, 48, followed=True), of_size(4, MOST), of_size(4, MOST + 1)
    for function in FUNCTIONS[:4]:
        assert function.compiled_for(x, longest, followed) is loads[function]
        assert not any(map(function.compiled_for, (half, too_long, of_size(4, 48, dtype=torch.float64))))
        assert function.compiled_for(x, on_cpu) is None
    for function in FUNCTIONS[4:]:
        assert function.compiled_for(x, too_long) is loads[function]
        assert not any(map(function.compiled_for, (half, followed)))
        with torch.no_grad():
            assert function.compiled_for(followed) is loads[function]
    # torch serves the CPU as fast
    assert WEIGHTS.compiled_for(torch.empty(4, 48)) is None
    assert CONTRACT.compiled_for(torch.empty(4, 3)) is contraction_numba.contract
    assert HASH_GRID.on(torch.device("mps")) is None
    assert DENSITY.compiled_for(on_cpu, of_size(4, 48, device="cpu", dtype=torch.float16)) is None


def test_torch_takes_the_place_of_what_is_left_out(monkeypatch):
    monkeypatch.setattr(back_ends, "tried_out", lambda form, device: None)
    edges, weights = torch.linspace(0, 1, 6).expand(3, -1), torch.rand(3, 5)
    taken = []
    monkeypatch.setattr(formulas, "distortion_loss", lambda *given: taken.append(given) or torch.zeros(()))
    given = of_size(3, 6), of_size(3, 5)
    distortion_loss(*given)
    assert taken == [given]
    monkeypatch.undo()
    found, expected = distortion_loss(edges, weights), formulas.distortion_loss(edges.double(), weights.double())
    assert float(found) == pytest.approx(float(expected), rel=1e-6)


def test_formulas_are_nerfstudios():
    """Those that nothing else compares with nerfstudio."""
    from nerfstudio.model_components.losses import lossfun_distortion, lossfun_outer
    from nerfstudio.utils.math import components_from_spherical_harmonics

    generator = torch.Generator().manual_seed(0)
    edges, outer_edges = (torch.rand(9, each, generator=generator).double().sort(dim=1)[0] for each in (30, 41))
    weights, outer = (torch.rand(9, each, generator=generator).double() ** 4 for each in (29, 40))
    exact = lossfun_distortion(edges, weights).mean()
    torch.testing.assert_close(formulas.distortion_loss(edges, weights), exact)
    # beyond the outermost intervals nerfstudio's differs by nothing here
    outer_edges[:, 0], outer_edges[:, -1] = 0, 1
    exact = lossfun_outer(edges, weights, outer_edges, outer).mean()
    torch.testing.assert_close(formulas.interlevel_loss(edges, weights, outer_edges, outer), exact)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator).double(), dim=1)
    exact = components_from_spherical_harmonics(4, (directions + 1) / 2)
    torch.testing.assert_close(formulas.harmonics(directions), exact.double(), rtol=1e-6, atol=1e-6)
