from __future__ import annotations

import dataclasses
import itertools
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method import integration, integration_numba
from edge_depth_nerf.method.integration import (
    IntegratedDepth,
    IntegrationOptions,
    combined_sigma_m,
    integrate_by_torch,
    integrate_depth,
    join_estimates,
    select_prior,
    weight_of_errors,
)


def random_maps(
    seed: int, height: int = 11, width: int = 13, dtype: torch.dtype = torch.float32, ragged: bool = True
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """LiDAR, mono, valid: smooth surfaces near 20 and 100 m with an edge between; ragged: holes and broken values.

    No two values lie 37 to 39 σ_d (1 m) apart, where float64 underflows and twin and fast form part.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    mono = np.where(x + 0.5 * y < 0.8 * width, 20, 100) + 2 * np.sin(x / 4 + seed) + rng.normal(0, 0.4, x.shape)
    lidar = np.where(rng.random(x.shape) < 0.25, mono * rng.uniform(0.97, 1.05) + rng.normal(0, 0.3, x.shape), 0)
    valid = np.ones(x.shape, bool)
    if ragged:
        broken = [0, -3.0, np.nan, np.inf, -np.inf]
        mono = np.where(rng.random(x.shape) < 0.15, rng.choice(broken, x.shape), mono)
        lidar = np.where(rng.random(x.shape) < 0.1, rng.choice(broken, x.shape), lidar)
        valid = rng.random(x.shape) > 0.15
    return torch.tensor(lidar, dtype=dtype), torch.tensor(mono, dtype=dtype), torch.tensor(valid)


def everywhere(image: torch.Tensor) -> torch.Tensor:
    return torch.ones(image.shape, dtype=torch.bool)


def assert_same(a: IntegratedDepth, b: IntegratedDepth, atol: float = 1e-5) -> None:
    for field in dataclasses.fields(IntegratedDepth):
        torch.testing.assert_close(getattr(a, field.name), getattr(b, field.name), rtol=0, atol=atol, msg=field.name)


def by_torch(
    lidar: torch.Tensor, mono: torch.Tensor, valid: torch.Tensor, options: IntegrationOptions | None = None
) -> IntegratedDepth:
    """What a GPU computes: the equations in torch, where the loops for the CPU go from shift to shift."""
    with mock.patch.object(integration, "_integrate_on_cpu", integrate_by_torch):
        return integrate_depth(lidar, mono, valid, options)


BOTH = pytest.mark.parametrize("integrate", [integrate_depth, by_torch], ids=["loops", "torch"])


def assert_equal(found: IntegratedDepth, exact: IntegratedDepth, atol: float) -> None:
    torch.testing.assert_close(found.distance_m.double(), exact.distance_m, rtol=0, atol=atol)
    # a root near 0 has half the digits; the sums' x is at most some 80 m
    torch.testing.assert_close(found.spread_m.double() ** 2, exact.spread_m**2, rtol=1e-5, atol=atol)
    torch.testing.assert_close(found.mono_share.double(), exact.mono_share, rtol=0, atol=atol / 10)


CHOICES = list(
    itertools.product(["edge-aware", "spatial-gaussian"], ["pooled", "residual"], [False, True], [0.7, 0.0, 1.0])
)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize(("kind", "normalise", "keep_returns", "alpha"), CHOICES)
def test_both_forms_are_equal(kind, normalise, keep_returns, alpha, dtype):
    options = IntegrationOptions(alpha=alpha, kernel=kind, normalise=normalise, keep_returns=keep_returns)
    lidar, mono, valid = random_maps(CHOICES.index((kind, normalise, keep_returns, alpha)), dtype=dtype)
    result, exact = (
        integrate_depth(lidar, mono, valid, options),
        by_torch(lidar.double(), mono.double(), valid, options),
    )
    assert result.distance_m.dtype == dtype
    assert_equal(result, exact, 1e-4 if dtype == torch.float32 else 1e-9)
    assert 0 < (exact.distance_m > 0).double().mean() < 1
    if dtype == torch.float32:
        # one rounding of the same numbers
        assert_same(by_torch(lidar, mono, valid, options), result, atol=2e-6)


@pytest.mark.parametrize(
    "fields",
    [
        {"kernel_size": 1},
        {"kernel_size": 3, "sigma_space_px": 0.5},
        {"kernel_size": 21},
        {"sigma_depth_m": 0.05},
        {"sigma_depth_m": 30.0, "normalise": "residual"},
        {"sigma_depth_m": 0.05, "sigma_depth_growth_per_m": 0.01},
        {"sigma_depth_growth_per_m": 0.05, "normalise": "residual"},
        {"least_returns": 4.0, "normalise": "residual"},
        {"least_returns": 4.0, "normalise": "pooled"},
    ],
    ids=str,
)
def test_both_forms_are_equal_with_other_kernels(fields):
    lidar, mono, valid = random_maps(5)
    options = IntegrationOptions(**fields)
    assert_equal(
        integrate_depth(lidar, mono, valid, options), by_torch(lidar.double(), mono.double(), valid, options), 1e-4
    )


@BOTH
def test_one_point_by_hand(integrate):
    # 3×3 window, σ_s = 3: sides weigh a = exp(-1/18) = 0.945959, corners b = exp(-2/18) = 0.894839.
    # mono is 10 everywhere (distance factor 1); the right neighbour has a return of 12.
    #   LiDAR's weight  0.7 · a              = 0.662171
    #   mono's weight   0.3 · (1 + 3a + 4b)  = 2.225171
    #   η               = 2.887342
    #   d̃ = 10 + 2 · 0.662171 / 2.887342     = 10.458672
    #   share of mono   2.225171 / 2.887342  = 0.770664
    #   spread: a value of 12 with p = 0.229336, 10 with 1 - p:  2 · sqrt(p (1 - p)) = 0.840812
    mono = torch.full((3, 3), 10.0)
    lidar = torch.zeros(3, 3)
    lidar[1, 2] = 12.0
    result = integrate(lidar, mono, everywhere(mono), IntegrationOptions(kernel_size=3))
    assert float(result.distance_m[1, 1]) == pytest.approx(10.458672, abs=2e-6)
    assert float(result.mono_share[1, 1]) == pytest.approx(0.770664, abs=2e-6)
    assert float(result.spread_m[1, 1]) == pytest.approx(0.840812, abs=2e-6)
    # residual: 12 is 1.2 times the average 10; of 2 returns it weighs a / 2 = 0.472980: 10 · 1.2^0.472980 = 10.900619
    options = IntegrationOptions(kernel_size=3, normalise="residual", least_returns=2.0)
    result = integrate(lidar, mono, everywhere(mono), options)
    assert float(result.distance_m[1, 1]) == pytest.approx(10.900619, abs=2e-6)
    assert float(result.mono_share[1, 1]) == pytest.approx(1 - 0.472980, abs=2e-6)
    assert float(result.spread_m[1, 1]) == pytest.approx(0, abs=2e-6)
    # (1, 0) does not see the return in its 3×3 window
    assert float(result.distance_m[1, 0]) == pytest.approx(10.0, abs=1e-6)
    # a second return of 9 at the centre, weight 1: mean (a ln 1.2 + ln 0.9) / (1 + a), at a weight of
    # 1.945959 / 2 = 0.972980; spread: that of the logarithms, by the same part
    lidar[1, 1] = 9.0
    result = integrate(lidar, mono, everywhere(mono), options)
    mean = (0.945959 * np.log(1.2) + np.log(0.9)) / 1.945959
    variance = (0.945959 * np.log(1.2) ** 2 + np.log(0.9) ** 2) / 1.945959 - mean**2
    distance = 10 * np.exp(0.972980 * mean)
    assert float(result.distance_m[1, 1]) == pytest.approx(distance, abs=2e-5)
    assert float(result.spread_m[1, 1]) == pytest.approx(distance * np.sqrt(0.972980 * variance), abs=2e-4)


@BOTH
def test_a_lone_point_makes_no_square(integrate):
    # one return of 12 among 10: with its whole weight all of its 9×9 window is 12 and what lies beyond is 10;
    # with least_returns it corrects by its weight, exp(-(k² + l²)/18), over 4
    mono = torch.full((15, 15), 10.0)
    lidar = torch.zeros(15, 15)
    lidar[7, 7] = 12.0
    square = integrate(
        lidar, mono, everywhere(mono), IntegrationOptions(normalise="residual", least_returns=0.1)
    ).distance_m
    assert float(square[7, 8]) == pytest.approx(12.0, abs=1e-5) == float(square[3, 3])
    assert float(square[7, 12]) == 10
    options = IntegrationOptions(normalise="residual", least_returns=4.0)
    soft = integrate(lidar, mono, everywhere(mono), options).distance_m
    for down, right in ((0, 1), (2, 3), (4, 4)):
        expected = 10 * 1.2 ** (np.exp(-(down**2 + right**2) / 18) / 4)
        assert float(soft[7 + down, 7 + right]) == pytest.approx(expected, abs=1e-5)
    # where returns are dense nothing changes
    dense = torch.full((15, 15), 12.0)
    dense[:, ::3] = 0
    known, unchanged = (
        integrate(dense, mono, everywhere(mono), one)
        for one in (options, IntegrationOptions(normalise="residual", least_returns=0.1))
    )
    assert_same(known, unchanged, 1e-6)


@BOTH
def test_lidar_on_a_slope_corrects_the_slope(integrate):
    # road: distances grow along the rows; LiDAR says 4 % more, in every fourth row. Its values, averaged in a window
    # (pooled), say what is at other rows; its differences say 4 % everywhere
    mono = (8 * 1.06 ** torch.arange(20.0, dtype=torch.float64))[:, None].expand(20, 9).contiguous()
    lidar = torch.zeros_like(mono)
    lidar[2::4] = 1.04 * mono[2::4]
    options = IntegrationOptions(sigma_depth_m=100.0, sigma_space_px=1.0, normalise="residual", least_returns=0.1)
    none = integrate(torch.zeros_like(mono), mono, everywhere(mono), options).distance_m
    found = integrate(lidar, mono, everywhere(mono), options).distance_m
    inner = slice(8, 12)
    # the window's average of the map itself is a little more than its middle, and is what LiDAR is compared with
    above = none[10, 4] / mono[10, 4]
    torch.testing.assert_close(found[inner], 1.04 / above * none[inner], rtol=1e-6, atol=0)
    pooled = integrate(lidar, mono, everywhere(mono), IntegrationOptions(sigma_depth_m=100.0, sigma_space_px=1.0))
    off = (pooled.distance_m[inner] / (1.04 * mono[inner]) - 1).abs().mean()
    assert (found[inner] / (1.04 * mono[inner]) - 1).abs().max() < 1e-6 < 0.01 < off


@pytest.mark.parametrize("kind", ["edge-aware", "spatial-gaussian"])
@pytest.mark.parametrize("normalise", ["pooled", "residual"])
@BOTH
def test_constant_map_stays(integrate, kind, normalise):
    mono = torch.full((12, 15), 73.3)
    lidar = torch.where(torch.rand(12, 15, generator=torch.Generator().manual_seed(0)) < 0.2, 73.3, 0.0)
    valid = random_maps(1, 12, 15)[2]
    result = integrate(lidar, mono, valid, IntegrationOptions(kernel=kind, normalise=normalise))
    assert torch.equal(result.distance_m > 0, valid)
    torch.testing.assert_close(result.distance_m[valid], mono[valid], rtol=0, atol=1e-5)
    assert float(result.spread_m.max()) < 1e-5


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 1000), scale=st.floats(0.05, 20))
@pytest.mark.parametrize("normalise", ["pooled", "residual"])
def test_scaling_distances_scales_the_prior(normalise, seed, scale):
    lidar, mono, valid = random_maps(seed, dtype=torch.float64)
    options = IntegrationOptions(sigma_depth_m=1.3, normalise=normalise)
    before = integrate_depth(lidar, mono, valid, options)
    after = integrate_depth(lidar * scale, mono * scale, valid, dataclasses.replace(options, sigma_depth_m=1.3 * scale))
    assert_same(
        after, IntegratedDepth(before.distance_m * scale, before.spread_m * scale, before.mono_share), atol=1e-6
    )


@BOTH
def test_adding_a_distance_adds_it_to_the_prior(integrate):
    lidar, mono, valid = random_maps(3, dtype=torch.float64)
    before = integrate(lidar, mono, valid)
    usable = torch.isfinite(mono) & (mono > 0)
    lidar_points = torch.isfinite(lidar) & (lidar > 0)
    after = integrate(torch.where(lidar_points, lidar + 7, 0), torch.where(usable, mono + 7, 0), valid)
    exists = (before.distance_m > 0).double()
    assert_same(after, IntegratedDepth(before.distance_m + 7 * exists, before.spread_m, before.mono_share))


@BOTH
def test_moves_and_flips_with_the_picture(integrate):
    lidar, mono, valid = random_maps(4)
    expected = integrate(lidar, mono, valid)

    def changed(change) -> IntegratedDepth:
        return IntegratedDepth(*(change(getattr(expected, f.name)) for f in dataclasses.fields(expected)))

    for change in (lambda t: torch.nn.functional.pad(t, (3, 6, 5, 2)), lambda t: t.flip(0).contiguous(), lambda t: t.T):
        assert_same(integrate(change(lidar), change(mono), change(valid)), changed(change))


@BOTH
def test_limits_of_alpha(integrate):
    lidar, mono, valid = random_maps(6, 30, 30, ragged=False)
    lidar[:, :15] = 0
    only_lidar = integrate(lidar, mono, valid, IntegrationOptions(alpha=1.0))
    # α = 1: a prior only within 4 px of a return, made of LiDAR alone
    assert (only_lidar.distance_m[:, :11] == 0).all()
    assert (only_lidar.mono_share == 0).all()
    # α = 0: LiDAR does not count, whatever it says
    only_mono = IntegrationOptions(alpha=0.0)
    assert_same(integrate(lidar, mono, valid, only_mono), integrate(lidar * 3, mono, valid, only_mono))
    no_lidar = torch.zeros_like(mono)
    for options in (only_mono, IntegrationOptions(), IntegrationOptions(normalise="residual")):
        alone = integrate(no_lidar, mono, valid, options)
        assert_same(alone, integrate(no_lidar, mono, valid))
        assert (alone.mono_share == 1).all()
    # LiDAR everywhere: no monocular value counts
    dense = integrate(mono + 1, mono, valid, IntegrationOptions(normalise="residual"))
    assert (dense.mono_share == 0).all()


@BOTH
def test_a_masked_pixel_gives_nothing_and_gets_nothing(integrate):
    lidar, mono, valid = random_maps(7)
    expected = integrate(lidar, mono, valid)
    for field in dataclasses.fields(expected):
        assert (getattr(expected, field.name)[~valid] == 0).all()
    for rubbish in (21.0, 1e4, float("nan")):
        assert_same(integrate(torch.where(valid, lidar, rubbish), torch.where(valid, mono, rubbish), valid), expected)


@BOTH
def test_a_point_without_estimate_gives_nothing(integrate):
    mono = torch.full((9, 9), 10.0)
    mono[4, 4] = 0
    lidar = torch.zeros(9, 9)
    lidar[4, 4] = 12.0
    for options in (IntegrationOptions(), IntegrationOptions(keep_returns=True)):
        result = integrate(lidar, mono, everywhere(mono), options)
        assert result.distance_m[4, 4] == 0
        assert (result.mono_share[mono > 0] == 1).all()


@BOTH
def test_an_edge_keeps_the_sides_apart(integrate):
    mono = torch.full((9, 20), 10.0)
    mono[:, 10:] = 30.0
    lidar = torch.zeros(9, 20)
    lidar[4, 12] = 31.0
    for normalise in ("pooled", "residual"):
        near = integrate(lidar, mono, everywhere(mono), IntegrationOptions(normalise=normalise)).distance_m
        torch.testing.assert_close(near[:, :10], mono[:, :10], rtol=0, atol=1e-5)
        assert float(near[4, 12]) > 30.01
    mixed = integrate(lidar, mono, everywhere(mono), IntegrationOptions(kernel="spatial-gaussian"))
    assert float(mixed.distance_m[4, 9]) > 15


@BOTH
def test_no_pixel_that_agrees_is_no_prior(integrate):
    # α = 1 and the only return lies 40 σ_d behind the centre: its weight is 0 in float64, and so is η
    mono, lidar = torch.tensor([[10.0, 50.0]]), torch.tensor([[0.0, 50.0]])
    result = integrate(lidar, mono, everywhere(mono), IntegrationOptions(alpha=1.0))
    assert result.distance_m.tolist() == [[0.0, 50.0]]
    # 30 σ_d behind it is the only one there is, and η is small but not 0
    result = integrate(lidar - 10, mono - torch.tensor([[0.0, 10.0]]), everywhere(mono), IntegrationOptions(alpha=1.0))
    assert result.distance_m.tolist() == [[40.0, 40.0]]


@BOTH
def test_far_from_every_estimate_the_nearest_counts(integrate):
    # A return of 40 at the middle, which does not count. d̂ there is 40, left 25, right 24.
    # 15 σ_d against 16: exp(-112.5) against exp(-128), both below float32's least number.
    mono, lidar = torch.tensor([[25.0, 40.0, 24.0]]), torch.tensor([[0.0, 40.0, 0.0]])
    options = IntegrationOptions(alpha=0.0)
    result = integrate(lidar, mono, everywhere(mono), options)
    assert float(result.distance_m[0, 1]) == pytest.approx(25.0, abs=1e-4)
    # beyond 37 σ_d there is none
    shift = torch.tensor([[0.0, 30.0, 0.0]])
    result = integrate(lidar + shift, mono + shift, everywhere(mono), options)
    assert result.distance_m[0, 1] == 0


@BOTH
def test_keep_points(integrate):
    lidar, mono, valid = random_maps(8, ragged=False)
    kept = integrate(lidar, mono, valid, IntegrationOptions(keep_returns=True))
    averaged = integrate(lidar, mono, valid)
    lidar_points = lidar > 0
    assert torch.equal(kept.distance_m[lidar_points], lidar[lidar_points])
    assert (kept.spread_m[lidar_points] == 0).all() and (kept.mono_share[lidar_points] == 0).all()
    assert torch.equal(kept.distance_m[~lidar_points], averaged.distance_m[~lidar_points])


def test_strips_change_nothing(monkeypatch):
    maps = [random_maps(seed) for seed in range(6)]
    whole = [integrate_depth(*each) for each in maps]
    monkeypatch.setattr(integration, "CPU_STRIP_PIXELS", 5)
    for each, expected in zip(maps, whole, strict=True):
        assert_same(integrate_depth(*each), expected, atol=1e-6)


def test_leaves_the_number_of_threads_alone():
    before = torch.get_num_threads()
    integrate_depth(*random_maps(0))
    assert torch.get_num_threads() == before


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("normalise", ["pooled", "residual"])
def test_threads_and_concurrent_callers_change_no_bit(normalise, two_threads, monkeypatch):
    options = IntegrationOptions(normalise=normalise)
    maps = [random_maps(seed, 120, 150) for seed in range(3)]
    monkeypatch.setattr(integration, "CPU_STRIP_PIXELS", 1 << 30)
    in_one_piece = [integrate_depth(lidar, mono, valid, options) for lidar, mono, valid in maps]
    monkeypatch.setattr(integration, "CPU_STRIP_PIXELS", 7 * 512)  # seven rows
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda m: integrate_depth(m[0], m[1], m[2], options), maps * 8))
    for result, expected in zip(results, in_one_piece * 8, strict=True):
        assert_same(result, expected, atol=0)


@pytest.mark.parametrize("normalise", ["pooled", "residual"])
@pytest.mark.parametrize("width", [511, 512, 513, 1030])
def test_both_forms_are_equal_on_wide_maps(width, normalise):
    # on the CPU the columns are worked on 512 at a time
    lidar, mono, valid = random_maps(14, 3, width, dtype=torch.float64)
    valid[1, :520] = False
    options = IntegrationOptions(kernel_size=5, normalise=normalise)
    assert_equal(integrate_depth(lidar, mono, valid, options), by_torch(lidar, mono, valid, options), 1e-9)


def test_distance_factor_is_exact_down_to_the_smallest():
    # Two pixels, the right one x farther. Seen from the left one its part is p = a·w / (1 + a·w) with
    # w = exp(-x²/2), a = exp(-1/18), and spread² = x²·p·(1 - p), which follows w over 300 powers of ten.
    x = torch.linspace(0, 37.3, 2001, dtype=torch.float64)
    mono = torch.stack([torch.full_like(x, 10), 10 + x], 1)[:, None]
    options = IntegrationOptions(kernel_size=3)
    spreads = [integrate_depth(torch.zeros_like(each), each, everywhere(each), options).spread_m for each in mono]
    spread = torch.stack(spreads)
    moved = (mono[:, 0, 1] - mono[:, 0, 0]).numpy()
    weight = np.exp(-(moved**2) / 2 - 1 / 18)
    part = weight / (1 + weight)
    np.testing.assert_allclose(spread[:, 0, 0] ** 2, moved**2 * part * (1 - part), rtol=1e-11, atol=0)


def test_compiles_where_nothing_can_be_kept():
    # a function without a file is one that Numba has no folder for
    names: dict = {}
    exec("def double(x): return 2 * x", names)
    with pytest.raises(RuntimeError, match="cannot cache"):
        numba.njit(cache=True)(names["double"])
    assert integration_numba._compiled(names["double"])(21) == 42


@pytest.mark.parametrize("shape", [(0, 5), (4, 0), (4, 5)])
@BOTH
def test_nothing_valid_is_no_prior(integrate, shape):
    result = integrate(torch.ones(shape), torch.ones(shape), torch.zeros(shape, dtype=torch.bool))
    assert result.distance_m.shape == shape
    assert not result.distance_m.any() and not result.spread_m.any() and not result.mono_share.any()


def test_half_precision_and_gradients_do_not_matter():
    lidar, mono, valid = random_maps(9, ragged=False)
    half = integrate_depth(lidar.half(), mono.half().requires_grad_(), valid)
    assert half.distance_m.dtype == torch.float32 and not half.distance_m.requires_grad
    assert_same(half, integrate_depth(lidar.half().float(), mono.half().float(), valid))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("normalise", ["pooled", "residual"])
def test_equals_the_cpu_on_a_gpu(normalise):
    lidar, mono, valid = random_maps(10)
    options = IntegrationOptions(normalise=normalise)
    there = integrate_depth(lidar, mono, valid, options, device="cuda")
    assert there.distance_m.device.type == "cpu"
    assert_same(there, integrate_depth(lidar, mono, valid, options), atol=2e-6)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"alpha": 1.5}, "alpha is 1.5; expected a finite number from 0 to 1"),
        ({"alpha": float("nan")}, "alpha is nan"),
        ({"kernel_size": 8}, "kernel_size is 8; expected an odd whole number"),
        ({"kernel_size": -1}, "kernel_size is -1"),
        ({"sigma_space_px": 0.0}, "sigma_space_px is 0.0; expected a finite number from 0.001"),
        ({"sigma_depth_m": float("inf")}, "sigma_depth_m is inf"),
        ({"kernel": "bilateral"}, "kernel is 'bilateral'; expected one of 'edge-aware', 'spatial-gaussian'"),
        ({"normalise": "none"}, "normalise is 'none'"),
    ],
)
def test_bad_options(fields, words, unchecked_types):
    with pytest.raises(InputError, match=words):
        IntegrationOptions(**fields)


def test_wrong_shapes(unchecked_types):
    image = torch.ones(4, 5)
    with pytest.raises(InputError, match=r"integrate_depth.*lidar_m \(5, 4\).*mono_m \(4, 5\).*one shape"):
        integrate_depth(image.T, image, everywhere(image))
    with pytest.raises(InputError, match="integrate_depth"):
        integrate_depth(image[0], image[0], everywhere(image[0]))
    with pytest.raises(InputError, match="select_prior"):
        select_prior("mono", {"mono": image}, everywhere(image.T))


def test_sources_alone():
    lidar, mono, valid = random_maps(11)
    only_lidar = select_prior("lidar", {"lidar": lidar}, valid)
    lidar_points = valid & torch.isfinite(lidar) & (lidar > 0)
    assert torch.equal(only_lidar.distance_m, torch.where(lidar_points, lidar, 0))
    assert not only_lidar.spread_m.any() and not only_lidar.mono_share.any()
    only_mono = select_prior("mono", {"mono": mono}, valid)
    usable = valid & torch.isfinite(mono) & (mono > 0)
    assert torch.equal(only_mono.distance_m, torch.where(usable, mono, 0))
    assert torch.equal(only_mono.mono_share > 0, usable)
    assert_same(select_prior("integrated", {"lidar": lidar, "mono": mono}, valid), integrate_depth(lidar, mono, valid))


@pytest.mark.parametrize(
    ("source", "missing"), [("lidar", "lidar"), ("mono", "mono"), ("integrated", "lidar and mono")]
)
def test_a_missing_source_is_named(source, missing):
    with pytest.raises(InputError, match=f"'{source}' needs {missing} distance maps"):
        select_prior(source, {}, torch.ones(3, 3, dtype=torch.bool))


def test_sigma_by_hand():
    maps = [0.0, 10.0, 14.0], [0.0, 0.3, 0.01], [0.0, 0.5, 1.0]
    prior = IntegratedDepth(*(torch.tensor([row]) for row in maps))
    mono = torch.tensor([[float("nan"), 12.0, 14.0]])
    # σ̂² = spread² + (0.1 · d̂ · share)² + 0.05²
    #   0.09 + (0.1 · 12 · 0.5)² + 0.0025   = 0.4525    root 0.672681
    #   0.0001 + (0.1 · 14 · 1)² + 0.0025   = 1.9626    root 1.400928
    torch.testing.assert_close(
        combined_sigma_m(prior, mono), torch.tensor([[0.0, 0.672681, 1.400928]]), rtol=0, atol=1e-6
    )


def test_sigma_is_positive_exactly_where_there_is_a_prior():
    lidar, mono, valid = random_maps(12)
    prior = integrate_depth(lidar, mono, valid, IntegrationOptions(keep_returns=True))
    sigma = combined_sigma_m(prior, mono)
    assert torch.isfinite(sigma).all()
    assert torch.equal(sigma > 0, prior.distance_m > 0)


def test_lidar_alone_has_the_floor_for_its_sigma():
    lidar, _, valid = random_maps(13)
    assert float(combined_sigma_m(select_prior("lidar", {"lidar": lidar}, valid), lidar).max()) == pytest.approx(0.05)


def random_motion(seed: int, mono: torch.Tensor) -> torch.Tensor:
    """Distances from motion near the monocular ones, with holes, broken values, and some where mono has none."""
    rng = np.random.default_rng([1, seed])
    near = np.where(np.isfinite(mono) & (mono.numpy() > 0), mono, 20.0) * rng.uniform(0.97, 1.03, mono.shape)
    near = np.where(rng.random(mono.shape) < 0.3, 0, near)
    return torch.tensor(np.where(rng.random(mono.shape) < 0.1, rng.choice([-1, np.nan, np.inf], mono.shape), near))


@pytest.mark.parametrize("fields", [{}, {"normalise": "residual", "least_returns": 4.0, "keep_returns": True}], ids=str)
@pytest.mark.parametrize("weight", [0.0, 0.8, 1.0])
def test_three_sources(fields, weight):
    lidar, mono, valid = random_maps(11, dtype=torch.float64)
    motion = random_motion(11, mono)
    joined = torch.from_numpy(join_estimates(mono.numpy(), motion.numpy(), weight))
    # (1-α) d̂ becomes (1-α) (ρ m + (1-ρ) d̂) where there are both
    expected = mono.clone()
    for place, distance in np.ndenumerate(motion.numpy()):
        if 0 < distance < np.inf:
            both = 0 < mono[place] < np.inf
            expected[place] = weight * distance + (1 - weight) * mono[place] if both else distance
    torch.testing.assert_close(joined, expected, rtol=1e-15, atol=0, equal_nan=True)
    result = integrate_depth(lidar, joined, valid, IntegrationOptions(**fields))
    two = integrate_depth(lidar, mono, valid, IntegrationOptions(**fields))
    assert (result.distance_m > 0).sum() > (two.distance_m > 0).sum()  # motion fills holes of mono
    assert not torch.equal(torch.where(two.distance_m > 0, result.distance_m, 0), two.distance_m)


def test_without_motion_the_estimate_stays_bit_for_bit():
    _, mono, _ = random_maps(12)
    for nothing in (torch.zeros_like(mono), torch.full_like(mono, torch.nan), torch.full_like(mono, -1.0)):
        assert join_estimates(mono.numpy(), nothing.numpy(), 0.9).tobytes() == mono.numpy().tobytes()


def test_the_weight_makes_the_mean_best():
    assert weight_of_errors(0.02, 0.02) == pytest.approx(0.5)
    # variances 1 and 9: the mean with 0.9 has the least, 0.9
    assert weight_of_errors(0.01, 0.03) == pytest.approx(0.9)
    assert weight_of_errors(0.1, 0.0) == 0.0
    with pytest.raises(InputError, match="motion_weight"):
        join_estimates(np.ones((2, 2)), np.ones((2, 2)), 1.2)
