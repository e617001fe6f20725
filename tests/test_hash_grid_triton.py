"""The forms of the hash grid's Triton kernels against the CPU's kernels, and which of them runs."""

from __future__ import annotations

import dataclasses
import os
from dataclasses import dataclass

import pytest
import torch
from ahead_of_time import ARCHITECTURES, compiled
from interpreted import NEEDS_A_GPU, assert_near, in_interpreter, on_a_gpu

from edge_depth_nerf.kernels import form_choice, hash_grid_numba
from edge_depth_nerf.kernels.form_choice import form_for

SIZES = ((3, 2, 150), (2, 4, 5), (1, 1, 128), (5, 3, 65))
"""Levels, features and points."""


def inputs(levels: int, features: int, count: int) -> tuple[torch.Tensor, ...]:
    """Points, many of which follow each other in one cell, on borders, outside or at one place; table and gradient."""
    torch.manual_seed(count)
    x = torch.rand(count // 20 + 1, 1, 3).add(0.01 * torch.rand(20, 3)).reshape(-1, 3)[:count]
    x[count // 2 : count // 2 + 8] = torch.tensor([0.0, 1.0, -1.0, 0.5])[torch.randint(0, 4, (8, 1))][
        : count - count // 2
    ]
    x[3 * count // 4 :] = 0
    scalings = torch.tensor([4.0, 16.0, 23.0, 64.0, 2000.0])[:levels]
    return x, torch.randn(levels * 256, features), scalings, torch.randn(count, levels * features)


FORMS_OF_ADDING = "points=128", "points=64,sums_below=60", "points=32,sums_below=1000"


def check_encoding() -> None:
    from edge_depth_nerf.kernels import hash_grid_triton as kernels

    for levels, features, count in SIZES:
        x, table, scalings, gradient = inputs(levels, features, count)
        expected = hash_grid_numba.encode(x, table, scalings)
        slope = hash_grid_numba.position_gradient(x, table, gradient, scalings)
        for form in ("points=256", "points=64,level_major=1"):
            os.environ[kernels.VARIABLE] = form
            found = kernels.encode(x, table, scalings)
            assert_near(found, expected, 1e-6)
            assert (found.stride(0) == 1) == ("level_major" in form or levels * features == 1)
            # in half precision it is rounded at the end
            assert torch.equal(kernels.encode(x, table, scalings, torch.float16), found.half())
        for given in (gradient, gradient.t().contiguous().t()):
            assert_near(kernels.position_gradient(x, table, given, scalings), slope, 1e-5)
    nowhere = kernels.encode(x[:0], table, scalings)
    assert nowhere.shape == (0, expected.shape[1])
    assert kernels.position_gradient(x[:0], table, gradient[:0], scalings).shape == (0, 3)


def check_the_tables_gradient() -> None:
    from edge_depth_nerf.kernels import hash_grid_triton as kernels

    for levels, features, count in SIZES:
        x, table, scalings, gradient = inputs(levels, features, count)
        expected = hash_grid_numba.table_gradient(x, gradient, scalings, len(table))
        for form in FORMS_OF_ADDING:
            os.environ[kernels.VARIABLE] = form
            given = gradient.t().contiguous().t() if form == FORMS_OF_ADDING[0] else gradient
            assert_near(kernels.table_gradient(x, given, scalings, len(table)), expected, 2e-6)
            whole = kernels.table_gradient(x, given.half().float(), scalings, len(table))
            assert_near(kernels.table_gradient(x, given.half(), scalings, len(table)), whole, 1e-6)
    same = torch.ones(1, 1).expand(gradient.shape)  # strides of 0, as the gradient of a sum has them
    expected = hash_grid_numba.table_gradient(x, same, scalings, len(table))
    assert_near(kernels.table_gradient(x, same, scalings, len(table)), expected, 2e-6)
    assert not kernels.table_gradient(x[:0], gradient[:0], scalings, len(table)).any()


def check_what_is_not_finite() -> None:
    """It spoils the rows that it is added to, and no others."""
    from edge_depth_nerf.kernels import hash_grid_triton as kernels

    x, table, scalings, gradient = inputs(2, 2, 70)
    gradient[33, 1], gradient[40, 2] = float("nan"), float("inf")
    expected = hash_grid_numba.table_gradient(x, gradient, scalings, len(table))
    assert expected.isnan().any() and not expected.isnan().all()
    for form in FORMS_OF_ADDING:
        os.environ[kernels.VARIABLE] = form
        found = kernels.table_gradient(x, gradient, scalings, len(table))
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5, equal_nan=True)
    x[5, 1], x[6] = float("nan"), float("inf")
    usable = x.isfinite().all(1)
    found = kernels.encode(x, table, scalings)
    assert found[~usable].isnan().any(1).all()
    assert_near(found[usable], hash_grid_numba.encode(x[usable], table, scalings), 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("check", [check_encoding, check_the_tables_gradient, check_what_is_not_finite])
def test_in_the_interpreter(check):
    pytest.importorskip("triton")
    in_interpreter(check)


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(check_encoding, check_the_tables_gradient, check_what_is_not_finite)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ARCHITECTURES)
@pytest.mark.parametrize("features", [2, 4])
def test_each_form_compiles_without_spills(architecture, features, tmp_path, monkeypatch):
    kernels = pytest.importorskip("edge_depth_nerf.kernels.hash_grid_triton")
    x, table, scalings, gradient = inputs(5, features, 1000)

    def run():
        for form in dict.fromkeys((*kernels.ENCODING, *kernels.ADDING)):
            numbers = dataclasses.asdict(form).items()
            monkeypatch.setenv(kernels.VARIABLE, ",".join(f"{name}={int(number)}" for name, number in numbers))
            # as under autocast; float32 takes no more registers
            kernels.encode(x, table, scalings, torch.float16)
            kernels.table_gradient(x, gradient.half(), scalings, len(table))
        kernels.position_gradient(x, table, gradient, scalings)

    found = compiled(run, architecture, tmp_path)
    assert sorted({kernel.name.split()[0] for kernel in found}) == [
        "_encode_kernel",
        "_position_gradient_kernel",
        "_table_gradient_kernel",
    ]
    assert {kernel.spilled for kernel in found} == {0}
    assert max(kernel.registers for kernel in found) <= 32 * features
    # a product and a sum are two roundings, as in torch: a point's cell must not depend on the compiler
    instructions = {name for kernel in found for name in kernel.instructions}
    assert "FMUL" in instructions and not any(name.startswith("FFMA") for name in instructions)
    additions = {
        sum(count for name, count in kernel.instructions.items() if name.startswith("RED"))
        for kernel in found
        if kernel.name.startswith("_table_gradient")
    }
    # a row's features in one instruction, where the architecture has it
    assert additions == {8 if architecture >= 90 else 8 * features}


@dataclass(frozen=True)
class Form:
    points: int = 128
    share: float = 0.5
    wide: bool = False


def not_run(form: Form) -> None:
    pytest.fail(f"{form} is not to be run")


FORMS = Form(), Form(256), Form(64, wide=True)


def test_the_fastest_form_is_measured_once_for_each_size(monkeypatch):
    monkeypatch.setattr(form_choice, "_fastest", {})
    monkeypatch.delenv("A_FORM", raising=False)
    ran = []

    def run(form: Form) -> None:
        ran.append(form)
        if form.points == 64:
            raise RuntimeError("out of registers")

    def seconds(call) -> float:
        call()
        return {128: 3.0, 256: 2.0}[ran[-1].points]

    for _ in range(2):
        assert form_for("A_FORM", FORMS, (7,), run, True, seconds) == Form(256)
    assert ran == [*FORMS]
    assert form_for("A_FORM", FORMS, (8,), run, True, seconds) == Form(256)
    assert ran == [*FORMS, *FORMS]


def test_without_a_gpu_the_first_form_runs_and_the_environment_names_another(monkeypatch):
    monkeypatch.delenv("A_FORM", raising=False)
    assert form_for("A_FORM", FORMS, (7,), not_run, False) == Form()
    monkeypatch.setenv("A_FORM", "points=32,wide=1,share=0.25")
    for on_gpu in (True, False):
        assert form_for("A_FORM", FORMS, (7,), not_run, on_gpu) == Form(32, 0.25, True)


@pytest.mark.parametrize("given", ["size=3", "points=many", "points", "points=64,"])
def test_a_form_that_there_is_not(given, monkeypatch):
    monkeypatch.setenv("A_FORM", given)
    with pytest.raises(ValueError, match=r"A_FORM=.*expected points=…, share=…, wide=…"):
        form_for("A_FORM", FORMS, (7,), not_run, False)
