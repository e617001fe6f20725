"""The fused hash grid and its formula against nerfstudio's class."""

import multiprocessing
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from interpreted import NEEDS_A_GPU, assert_near
from models import build, bundle, supervision
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.field_components.spatial_distortions import SceneContraction

from edge_depth_nerf.kernels import formulas
from edge_depth_nerf.kernels import hash_grid_numba as cpu
from edge_depth_nerf.kernels.functions import HASH_GRID
from edge_depth_nerf.kernels.table_adam import TableAdam
from edge_depth_nerf.plugin.fused.fields import CubeContraction
from edge_depth_nerf.plugin.fused.hash_grid import FusedHashEncoding
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel

SIZES = {
    "many levels": {"num_levels": 16, "log2_hashmap_size": 15, "max_res": 2048},
    "proposal 1": {"num_levels": 5, "log2_hashmap_size": 17, "max_res": 128},
    "lite": {"num_levels": 8, "log2_hashmap_size": 16, "max_res": 512},
    "big": {"num_levels": 2, "log2_hashmap_size": 21, "max_res": 8192},
    "one level": {"num_levels": 1, "log2_hashmap_size": 10},
    "four features": {"num_levels": 3, "log2_hashmap_size": 12, "features_per_level": 4, "max_res": 100},
    "one feature": {"num_levels": 3, "log2_hashmap_size": 12, "features_per_level": 1, "max_res": 100},
}


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def small_shares(monkeypatch):
    monkeypatch.setattr(cpu, "LEAST_SHARE", 1)


def both(seed: int = 0, **size) -> tuple[HashEncoding, FusedHashEncoding]:
    """nerfstudio's encoding and a fused one with the same table, its values between -1 and 1."""
    made: list[Any] = []
    for kind in (HashEncoding, FusedHashEncoding):
        torch.manual_seed(seed)
        made.append(kind(**{"hash_init_scale": 1.0, **size}, implementation="torch"))  # pyrefly: ignore
    assert torch.equal(made[0].hash_table, made[1].hash_table)
    return made[0], made[1]


def points(scalings: torch.Tensor, count: int = 1000) -> torch.Tensor:
    """Anywhere, on borders of cells, at -1, 0 and 1 on one to three axes, just beside them, and outside."""
    random = torch.rand(count, 3)
    at = torch.tensor([-1.0, 0.0, 1.0, 1e-8, 1 - 6e-8, -1e-8, 0.5, -0.3, 1.7])
    corners = torch.cartesian_prod(at, at, at)
    cells = torch.floor(random[None] * scalings[:, None, None].float()) / scalings[:, None, None].float()
    borders = cells[:, :200].reshape(-1, 3)
    mixed = torch.where(torch.rand(len(borders), 3) < 0.5, borders, torch.rand(len(borders), 3))
    return torch.cat([random, corners, borders, mixed])


@pytest.mark.slow
@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NEEDS_A_GPU)])
def test_equals_nerfstudio(name, device):
    host, fused = (encoding.to(device) for encoding in both(**SIZES[name]))
    assert HASH_GRID.on(torch.device(device)) is not None
    x = points(host.scalings.cpu(), 500).to(device)
    xs = [x.clone().requires_grad_() for _ in range(2)]
    encoded = [encoding(each) for encoding, each in zip((host, fused), xs, strict=True)]
    assert_near(encoded[1], encoded[0], 0.0 if device == "cpu" else 1e-6)
    gradient = torch.randn(encoded[0].shape, device=device)
    for each in encoded:
        each.backward(gradient)
    assert_near(fused.hash_table.grad, host.hash_table.grad, 1e-5)
    assert_near(xs[1].grad, xs[0].grad, 1e-5)
    with torch.no_grad():
        exact = formulas.hash_grid(x.double(), fused.hash_table.double(), fused.scalings.double())
    # a place in a cell has lost digits where it was of float32
    assert_near(encoded[0].detach(), exact, 2e-7 * float(fused.scalings.max()))


def test_many_additions_to_one_row():
    """Positions outside the scene box all become 0: a hundred thousand gradients in one row."""
    host, fused = both(**SIZES["proposal 1"])
    x = torch.zeros(100_000, 3)
    gradient = torch.rand(len(x), host.get_out_dim())
    fused(x).backward(gradient)
    exact = gradient.double().sum(0).view(5, 2)
    assert fused.hash_table.grad is not None
    assert_near(fused.hash_table.grad.view(5, -1, 2)[:, 0], exact, 1e-5)
    assert int((fused.hash_table.grad != 0).sum()) == 10


@pytest.mark.parametrize("count", [1, 256, 257, 5000])
@pytest.mark.parametrize("levels", [1, 5])
def test_threads_do_not_change_the_result(small_shares, levels, count):
    _, fused = both(num_levels=levels, log2_hashmap_size=8, max_res=64)
    x, gradient = torch.rand(count, 3), torch.randn(count, 2 * levels)
    table, scalings = fused.hash_table.detach(), fused.scalings.float()

    def all_three():
        return (
            cpu.encode(x, table, scalings),
            cpu.table_gradient(x, gradient, scalings, len(table)),
            cpu.position_gradient(x, table, gradient, scalings),
        )

    torch.set_num_threads(1)
    expected = all_three()
    for number in (2, 3, 7):
        torch.set_num_threads(number)
        found = all_three()
        assert torch.equal(found[0], expected[0]) and torch.equal(found[2], expected[2])
        assert_near(found[1], expected[1], 1e-6)


def test_callers_at_once_do_not_mix(small_shares):
    torch.set_num_threads(2)
    encodings = [both(seed, num_levels=4, log2_hashmap_size=8)[1] for seed in range(6)]
    x = torch.rand(3000, 3)

    def work(encoding: FusedHashEncoding):
        torch.set_num_threads(2)
        encoding.hash_table.grad = None
        encoded = encoding(x)
        encoded.square().sum().backward()
        return encoded.detach(), encoding.hash_table.grad

    expected = [work(encoding) for encoding in encodings]
    with ThreadPoolExecutor(6) as pool:
        for _ in range(5):
            for found, alone in zip(pool.map(work, encodings), expected, strict=True):
                assert torch.equal(found[0], alone[0])
                assert found[1] is not None and alone[1] is not None
                torch.testing.assert_close(found[1], alone[1])


def _encode_in_child(queue, x, table, scalings):
    queue.put(cpu.encode(x, table, scalings).numpy())


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
def test_a_forked_process_starts_its_own_threads(small_shares):
    torch.set_num_threads(2)
    _, fused = both(num_levels=2, log2_hashmap_size=6)
    arguments = torch.rand(500, 3), fused.hash_table.detach(), fused.scalings
    expected = cpu.encode(*arguments)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_encode_in_child, args=(queue, *arguments), daemon=True)
    child.start()
    assert np.array_equal(queue.get(timeout=30), expected.numpy())
    child.join(30)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64], ids=str)
def test_other_types_of_positions_and_of_the_table(dtype):
    host, fused = both(**SIZES["four features"])
    x = torch.rand(50, 3).to(dtype)
    xs = [x.clone().requires_grad_() for _ in range(2)]
    encoded = [encoding(x) for encoding, x in zip((host, fused), xs, strict=True)]
    assert encoded[0].dtype == encoded[1].dtype and torch.equal(*encoded)
    for each in encoded:
        each.square().sum().backward()
    torch.testing.assert_close(xs[0].grad, xs[1].grad)
    assert_near(fused.hash_table.grad, host.hash_table.grad, 1e-5)
    if dtype != torch.bfloat16:
        of_table = [encoding.to(dtype)(x.float()) for encoding in (host, fused)]
        assert torch.equal(*of_table) and of_table[0].dtype == of_table[1].dtype


def test_under_mixed_precision():
    host, fused = both(**SIZES["lite"])
    layer = torch.nn.Linear(16, 4)
    gradients = []
    for encoding in (host, fused):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            encoded = encoding(torch.linspace(0, 1, 300).view(-1, 3))
            assert encoded.dtype == torch.float32
            layer(encoded).float().square().sum().backward()
        gradients.append(encoding.hash_table.grad)
    assert_near(gradients[1], gradients[0], 1e-5)


@pytest.mark.parametrize("shape", [(3,), (0, 3), (7, 0, 3), (4, 3), (2, 5, 3), (2, 1, 3, 3)])
def test_any_leading_shape(shape):
    host, fused = both(**SIZES["four features"])
    x = torch.rand(shape)
    assert fused(x).shape == (*shape[:-1], 12)
    assert torch.equal(host(x), fused(x))
    x.requires_grad_()
    fused(x).sum().backward()
    assert x.grad is not None and x.grad.shape == x.shape
    assert fused.hash_table.grad is not None and fused.hash_table.grad.any() == (x.numel() > 0)


def test_strided_tensors():
    host, fused = both(**SIZES["lite"])
    wide = torch.rand(6, 500).t()[:, ::2]
    assert not wide.is_contiguous()
    encoded = [encoding(wide) for encoding in (host, fused)]
    assert torch.equal(*encoded)
    for each in encoded:  # a gradient of stride 0, then one of strange strides
        each.sum().backward(retain_graph=True)
        each.backward(torch.linspace(-1, 1, each.numel()).view(each.shape[::-1]).t())
    assert_near(fused.hash_table.grad, host.hash_table.grad, 1e-5)


@pytest.mark.parametrize(("of_positions", "of_table"), [(True, False), (False, True), (False, False)])
def test_only_the_gradients_asked_for(of_positions, of_table, monkeypatch):
    _, fused = both(**SIZES["four features"])
    for name, wanted in (("position_gradient", of_positions), ("table_gradient", of_table)):
        if not wanted:
            monkeypatch.setattr(cpu, name, lambda *_: pytest.fail("not asked for"))
    x = torch.rand(20, 3).requires_grad_(of_positions)
    fused.hash_table.requires_grad_(of_table)
    encoded = fused(x)
    assert encoded.requires_grad == (of_positions or of_table)
    if encoded.requires_grad:
        encoded.sum().backward()
    assert (x.grad is not None, fused.hash_table.grad is not None) == (of_positions, of_table)
    with torch.no_grad():
        assert not fused(x).requires_grad


def test_a_second_derivative_is_refused():
    _, fused = both(**SIZES["four features"])
    x = torch.rand(20, 3, requires_grad=True)
    (slope,) = torch.autograd.grad(fused(x).sum(), x, create_graph=True)
    with pytest.raises(NotImplementedError, match="implementation torch"):
        slope.square().sum().backward()


def test_nan_stays_nan_and_breaks_nothing():
    host, fused = both(**SIZES["four features"])
    x = torch.rand(10, 3)
    x[3, 1] = float("nan")
    x[5, 0] = float("inf")
    x[7] = 1e30
    encoded = fused(x)
    assert encoded[[3, 5]].isnan().any(1).all()
    kept = [0, 1, 2, 4, 6, 8, 9]
    assert torch.equal(encoded[kept], host(x[kept]))
    encoded.sum().backward()


def step(model: EdgeDepthNerfModel) -> dict[str, torch.Tensor]:
    """Losses of a training step, their gradients in the parameters."""
    model.train()
    batch = supervision(32, 1)
    torch.manual_seed(3)
    outputs = model(bundle(32))
    losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
    torch.stack(list(losses.values())).sum().backward()
    return losses


def encodings_of(model: torch.nn.Module) -> list[HashEncoding]:
    return [part for part in model.modules() if isinstance(part, HashEncoding)]


@pytest.mark.parametrize(
    "options",
    [
        {"max_res": 512, "predict_normals": True},
        {"max_res": 512, "poses": "SO3xR3"},
        {"max_res": 2048},
    ],
    ids=str,
)
def test_a_training_step_is_the_torch_step(options):
    # places round to some 1e-7 of the scene, which is a share of a cell that grows with their number
    tolerance = 4e-7 * options["max_res"]
    models = [build(implementation=implementation, **options) for implementation in ("torch", "fused")]
    losses = [step(model) for model in models]
    for name, loss in losses[0].items():
        assert float(losses[1][name].detach()) == pytest.approx(float(loss.detach()), rel=3e-5), name
    found = dict(models[1].named_parameters())
    compared = 0
    for name, parameter in models[0].named_parameters():
        if parameter.grad is not None and parameter.grad.any():
            assert_near(found[name].grad, parameter.grad, tolerance)
            compared += 1
    assert compared > 10
    # the normals' own gradient, and that of poses, ask for positions; nothing else does
    assert models[1].field.follows_positions == bool({"predict_normals", "poses"} & set(options))
    models[0].load_state_dict(models[1].state_dict())
    models[1].load_state_dict(models[0].state_dict())


def test_gradients_by_positions_alone_leave_the_tables_be():
    """Normals ask for them in each step; from the second one on, gradients could be summed up later."""
    options = {"max_res": 512, "predict_normals": True}
    models = [build(implementation=implementation, **options) for implementation in ("torch", "fused")]
    for model in models:
        # a rate of next to nothing: both stay the same model
        optimiser = TableAdam(model.parameters(), lr=1e-12, eps=1e-15)
        step(model)
        optimiser.step()
        optimiser.zero_grad()
        step(model)
    for ours, of_torch in zip(*(encodings_of(model) for model in reversed(models)), strict=True):
        assert of_torch.hash_table.grad.any()
        assert_near(ours.hash_table.grad, of_torch.hash_table.grad, 4e-7 * 512)


def test_the_contraction_is_nerfactos():
    """Inside and outside the unit cube, on its border, and where two or three axes are equally far."""
    at = torch.tensor([-30.0, -2.0, -1.0, -0.5, 0.0, 1e-30, 0.3, 1.0, 2.0, 1e6])
    x = torch.cat([torch.cartesian_prod(at, at, at), 3 * torch.randn(500, 3)])
    assert isinstance(build().field.spatial_distortion, CubeContraction)
    found = []
    for kind in (SceneContraction, CubeContraction):
        each = x.clone().requires_grad_()
        contracted = kind(order=float("inf"))(each)
        (contracted * torch.linspace(-1, 1, x.numel()).view_as(x)).sum().backward()
        found.append((contracted, each.grad))
    assert torch.equal(found[0][0], found[1][0])
    # at the very centre both give NaN, from 0 / 0 in the branch that is not selected
    torch.testing.assert_close(found[1][1], found[0][1], equal_nan=True)


def test_a_border_has_no_gradient_across_it():
    _, fused = both(num_levels=1, log2_hashmap_size=10)
    x = torch.tensor([[0.5, 0.26, 0.77], [0.26, 0.77, 0.5]], requires_grad=True)  # 16 cells: 0.5 is a border
    fused(x).sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad == 0, torch.tensor([[True, False, False], [False, False, True]]))
