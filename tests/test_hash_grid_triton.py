"""The hash grid's Triton kernels against the CPU's kernels, in Triton's interpreter; and compiled."""

import pytest
import torch
from ahead_of_time import ARCHITECTURES, check_registers
from interpreted import NEEDS_A_GPU, assert_near, on_a_gpu

from edge_depth_nerf.kernels import hash_grid_numba

SIZES = ((2, 2, 150), (2, 4, 5), (1, 1, 128), (5, 3, 20))
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


def check_encoding() -> None:
    from edge_depth_nerf.kernels import hash_grid_triton as kernels

    for levels, features, count in SIZES:
        x, table, scalings, gradient = inputs(levels, features, count)
        expected = hash_grid_numba.encode(x, table, scalings)
        slope = hash_grid_numba.position_gradient(x, table, gradient, scalings)
        found = kernels.encode(x, table, scalings)
        assert_near(found, expected, 1e-6)
        # in half precision it is rounded at the end
        assert torch.equal(kernels.encode(x, table, scalings, torch.float16), found.half())
        assert_near(kernels.position_gradient(x, table, gradient, scalings), slope, 1e-5)
    column_major = gradient.t().contiguous().t()
    assert_near(kernels.position_gradient(x, table, column_major, scalings), slope, 1e-5)
    nowhere = kernels.encode(x[:0], table, scalings)
    assert nowhere.shape == (0, expected.shape[1])
    assert kernels.position_gradient(x[:0], table, gradient[:0], scalings).shape == (0, 3)


def check_the_tables_gradient() -> None:
    from edge_depth_nerf.kernels import hash_grid_triton as kernels

    for levels, features, count in SIZES:
        x, table, scalings, gradient = inputs(levels, features, count)
        expected = hash_grid_numba.table_gradient(x, gradient, scalings, len(table))
        assert_near(kernels.table_gradient(x, gradient, scalings, len(table)), expected, 2e-6)
    column_major = gradient.t().contiguous().t()
    assert_near(kernels.table_gradient(x, column_major, scalings, len(table)), expected, 2e-6)
    whole = kernels.table_gradient(x, gradient.half().float(), scalings, len(table))
    for half in (gradient.half(), column_major.half()):
        assert_near(kernels.table_gradient(x, half, scalings, len(table)), whole, 1e-6)
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
    found = kernels.table_gradient(x, gradient, scalings, len(table))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5, equal_nan=True)
    x[5, 1], x[6] = float("nan"), float("inf")
    usable = x.isfinite().all(1)
    found = kernels.encode(x, table, scalings)
    assert found[~usable].isnan().any(1).all()
    assert_near(found[usable], hash_grid_numba.encode(x[usable], table, scalings), 1e-6)


CHECKS = check_encoding, check_the_tables_gradient, check_what_is_not_finite
"""In Triton's interpreter test_back_ends.py runs them, those of all kernels in one process."""


@NEEDS_A_GPU
def test_the_same_on_a_gpu():
    on_a_gpu(*CHECKS)


@pytest.mark.slow
@pytest.mark.parametrize(("architecture", "features"), [*((each, 2) for each in ARCHITECTURES), (90, 4)])
def test_compiled_without_spills(architecture, features, tmp_path):
    kernels = pytest.importorskip("edge_depth_nerf.kernels.hash_grid_triton")
    x, table, scalings, gradient = inputs(5, features, 1000)

    def run():
        # as under autocast; float32 takes no more registers
        kernels.encode(x, table, scalings, torch.float16)
        kernels.table_gradient(x, gradient.half(), scalings, len(table))
        kernels.position_gradient(x, table, gradient, scalings)

    names = {"_encode_kernel", "_position_gradient_kernel", "_table_gradient_kernel"}
    found = check_registers(run, architecture, tmp_path, names, 36 * features)
    # a product and a sum are two roundings, as in torch: a point's cell must not depend on the compiler
    instructions = {kernel.name: kernel.instructions() for kernel in found}
    every = {name for each in instructions.values() for name in each}
    assert "FMUL" in every and not any(name.startswith("FFMA") for name in every)
    # a row's features in one instruction, where the architecture has it
    additions = [n for name, n in instructions["_table_gradient_kernel"].items() if name.startswith("RED")]
    assert sum(additions) == (8 if architecture >= 90 else 8 * features)
