import math

import numpy as np
import pytest
import reference
import torch

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method import losses
from edge_depth_nerf.method.losses import EPS, Gaussian, sky_loss

GAUSSIANS: tuple[Gaussian, ...] = ("point", "interval")
FORMS = [(gaussian, norm) for gaussian in GAUSSIANS for norm in (False, True)]


def random_rays(seed: int, rays: int = 12, samples: int = 30, dtype: torch.dtype = torch.float64) -> dict:
    """Rays up to 150 m with samples of very different lengths; some rays without a prior, some samples of no length."""
    rng = np.random.default_rng(seed)
    steps = rng.exponential(1, (rays, samples + 1)) * rng.choice([0, 0.01, 1, 5], (rays, samples + 1))
    ends = 0.2 + np.cumsum(steps, 1) * 150 / np.maximum(steps.sum(1, keepdims=True), 1)
    weights = rng.dirichlet(np.full(samples, 0.3), rays)
    weights[:, 3] = 0
    prior = rng.uniform(3, 120, rays)
    prior[:4] = [0, np.nan, np.inf, -2]
    sigma = 10 ** rng.uniform(-1.3, 1.3, rays)
    sigma[4:6] = [0, np.nan]
    arrays = {"weights": weights, "starts_m": ends[:, :-1], "ends_m": ends[:, 1:], "prior_m": prior, "sigma_m": sigma}
    return {name: torch.tensor(array, dtype=dtype) for name, array in arrays.items()}


def edge_loss(weights, starts_m, ends_m, prior_m, sigma_m, **form) -> torch.Tensor:
    """Mean of Eq. 4 over the rays that have a prior, as a training takes it; `sigma_m` may be one number."""
    sigma_m = sigma_m if isinstance(sigma_m, torch.Tensor) else torch.full_like(prior_m, sigma_m)
    has_prior = (prior_m > 0) & prior_m.isfinite() & (sigma_m > 0) & sigma_m.isfinite()
    per_ray = losses.edge_loss(weights, starts_m, ends_m, prior_m, sigma_m, **form)
    assert not per_ray[~has_prior].any()
    return per_ray.sum() / has_prior.sum().clamp(min=1)


def urban_nerf_loss(weights, starts_m, ends_m, prior_m, sigma_m, expected=0.01, empty=1.0, near=1.0) -> torch.Tensor:
    """Mean of UrbanNeRF's loss over the rays that have a prior."""
    has_prior = (prior_m > 0) & prior_m.isfinite()
    terms = {"expected": expected, "empty": empty, "near": near}
    per_ray = losses.urban_nerf_loss(weights, starts_m, ends_m, prior_m, sigma_m, **terms)
    assert not per_ray[~has_prior].any()
    return per_ray.sum() / has_prior.sum().clamp(min=1)


def one_ray(weights, edges, prior: float, sigma: float, loss_of=edge_loss, **form) -> float:
    edges = torch.tensor(edges, dtype=torch.float64)[None]
    given = torch.tensor(weights, dtype=torch.float64)[None]
    return float(loss_of(given, edges[:, :-1], edges[:, 1:], torch.tensor([prior]).double(), sigma, **form))


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-6), (torch.float32, 1e-4)], ids=str)
@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
@pytest.mark.parametrize("seed", range(5))
def test_equals_twin(seed, gaussian, norm, dtype, rtol):
    rays = random_rays(seed, dtype=dtype)
    loss = edge_loss(**rays, gaussian=gaussian, divide_by_norm=norm)
    arrays = {name: tensor.numpy() for name, tensor in rays.items()}
    twin = reference.edge_loss(**arrays, gaussian=gaussian, divide_by_norm=norm)
    assert loss.dtype == dtype
    assert twin > 0
    assert float(loss) == pytest.approx(twin, rel=rtol)


@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
def test_gradient_equals_finite_differences(gaussian, norm):
    rays = random_rays(1, rays=8, samples=6)
    weights = (rays.pop("weights") + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: edge_loss(w, **rays, gaussian=gaussian, divide_by_norm=norm), (weights,))


def test_value_by_hand():
    # samples [1, 2], [2, 4] m, weights 0.2 and 0.8, prior 3 m, σ̂ = 1 m
    #   K = exp(-1.5²/2) = 0.324652 and exp(0) = 1;  Δt = 1 and 2;  log 0.2 = -1.609438, log 0.8 = -0.223144
    #   point:    1.609438 · 0.324652 · 1 + 0.223144 · 1 · 2 = 0.522508 + 0.446287 = 0.968795
    #   with the norm, divided by √(2π) = 2.506628:                                  0.386493
    #   interval: Φ(-1) - Φ(-2) = 0.135905, Φ(1) - Φ(-1) = 0.682689
    #             1.609438 · 0.135905 + 0.223144 · 0.682689 = 0.218731 + 0.152338 =  0.371068
    #   without the norm, times 2.506628:                                            0.930130
    for (gaussian, norm), value in zip(FORMS, (0.968795, 0.386493, 0.930130, 0.371068), strict=True):
        loss = one_ray([0.2, 0.8], [1.0, 2.0, 4.0], 3.0, 1.0, gaussian=gaussian, divide_by_norm=norm)
        assert loss == pytest.approx(value, abs=3e-6)


def test_order_of_rays_and_rays_without_prior_do_not_matter():
    rays = random_rays(2)
    loss = edge_loss(**rays)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(edge_loss(**{name: tensor[order] for name, tensor in rays.items()}), loss)
    with_prior = {name: tensor[6:] for name, tensor in rays.items()}
    torch.testing.assert_close(edge_loss(**with_prior), loss)


@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
def test_longer_units(gaussian, norm):
    # all lengths in another unit: Eq. 4 grows with Δt, with the norm it has no unit
    rays = random_rays(3)
    scaled = {name: tensor if name == "weights" else 7 * tensor for name, tensor in rays.items()}
    before, after = (edge_loss(**r, gaussian=gaussian, divide_by_norm=norm) for r in (rays, scaled))
    torch.testing.assert_close(after, before if norm else 7 * before, rtol=1e-6, atol=0)


@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
def test_weight_at_the_prior_is_best(gaussian, norm):
    edges = [float(t) for t in range(1, 42)]
    losses = []
    for sample in (10, 19, 30):  # 19 spans 20 to 21 m
        weights = np.full(40, 0.002)
        weights[sample] = 1 - 39 * 0.002
        losses.append(one_ray(weights, edges, 20.5, 1.5, gaussian=gaussian, divide_by_norm=norm))
    assert losses[1] < min(losses[0], losses[2])


def test_a_wide_gaussian_pulls_harder_only_without_the_norm():
    edges = np.linspace(1, 101, 401).tolist()
    weights = np.full(400, 1 / 400)
    literal = [one_ray(weights, edges, 50.0, sigma) for sigma in (1.0, 4.0)]
    assert literal[1] == pytest.approx(4 * literal[0], rel=1e-6)
    for gaussian in ("point", "interval"):
        normed = [one_ray(weights, edges, 50.0, sigma, gaussian=gaussian, divide_by_norm=True) for sigma in (1.0, 4.0)]
        # the Gaussian's integral is 1: the loss is -log of the (equal) weights
        assert normed == pytest.approx([math.log(400)] * 2, rel=1e-4)


@pytest.mark.parametrize("norm", [False, True])
def test_interval_becomes_point_for_short_samples(norm):
    for length, rel in ((1.0, 5e-2), (0.1, 1e-3), (0.01, 1e-5), (1e-5, 1e-11)):
        edges = [10.3, 10.3 + length]
        interval, point = (
            one_ray([0.3], edges, 10.0, 1.0, gaussian=gaussian, divide_by_norm=norm)
            for gaussian in ("interval", "point")
        )
        assert interval == pytest.approx(point, rel=rel)


def test_interval_of_short_samples_in_float32():
    # 1 mm samples around a prior of 60 m, σ̂ = 12 m: the difference of two values of Φ would keep three digits
    edges = 59.5 + torch.arange(3)[None] * 0.001
    weights, prior = torch.full((1, 2), 0.5), torch.tensor([60.0])
    losses = [
        float(
            edge_loss(
                weights.to(dtype), edges[:, :-1].to(dtype), edges[:, 1:].to(dtype), prior, 12.0, gaussian="interval"
            )
        )
        for dtype in (torch.float32, torch.float64)
    ]
    assert losses[0] == pytest.approx(losses[1], rel=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_interval_is_smooth_where_its_two_forms_meet(dtype):
    # ∫ exp(-z²/2) over lengths around NARROW = 0.05, against 1,000 midpoints
    for length in (0.04, 0.0499, 0.0501, 0.06):
        for start in (-3.0, -1.0, 0.0, 2.0):
            z = start + (np.arange(1000) + 0.5) / 1000 * length
            expected = math.log(2) * np.exp(-0.5 * z**2).mean() * length
            edges = torch.tensor([[start + 4, start + 4 + length]], dtype=dtype)
            loss = edge_loss(
                torch.full((1, 1), 0.5, dtype=dtype), edges[:, :1], edges[:, 1:], torch.full((1,), 4.0), 1.0,
                gaussian="interval",
            )  # fmt: skip
            assert float(loss) == pytest.approx(expected, rel=1e-4 if dtype == torch.float32 else 1e-6)


def test_a_narrow_gaussian_between_samples_still_pulls_as_interval():
    # 80 m away samples are 4 m long, σ̂ is 0.1 m: no middle is near the prior of 81 m
    weights, prior = torch.full((1, 3), 0.1, requires_grad=True), torch.tensor([81.0])
    edges = torch.tensor([[76.0, 80.0, 84.0, 88.0]])
    for gaussian, pull in zip(GAUSSIANS, (0.0, -10.0), strict=True):  # -d log(w)/dw · mass = -1/0.1 · 1
        loss = edge_loss(weights, edges[:, :-1], edges[:, 1:], prior, 0.1, gaussian=gaussian, divide_by_norm=True)
        (gradient,) = torch.autograd.grad(loss, weights)
        assert gradient[0].tolist() == pytest.approx([0.0, pull, 0.0], abs=1e-4)


@pytest.mark.parametrize("gaussian", ["point", "interval"])
def test_samples_that_are_none_give_nothing(gaussian):
    weights, starts, ends = torch.tensor([[0.3, 0.5]]), torch.tensor([[1.0, 2.0]]), torch.tensor([[2.0, 3.0]])
    prior = torch.tensor([2.2])
    expected = edge_loss(weights, starts, ends, prior, 1.0, gaussian=gaussian)
    inf, nan = math.inf, math.nan
    weights, starts, ends = (
        torch.cat([tensor, torch.tensor([extra])], 1)
        for tensor, extra in (
            (weights, [0.0, 0.1, 0.1, 0.1]),
            (starts, [2.2, 2.3, 3.0, nan]),
            (ends, [2.2, 2.1, inf, 3.0]),
        )
    )
    torch.testing.assert_close(edge_loss(weights, starts, ends, prior, 1.0, gaussian=gaussian), expected)


@pytest.mark.parametrize(("gaussian", "norm"), FORMS)
def test_no_prior_is_a_connected_zero(gaussian, norm):
    for count in (6, 0):
        rays = {name: tensor[:count] for name, tensor in random_rays(4).items()}
        rays["weights"].requires_grad_()
        loss = edge_loss(**rays, gaussian=gaussian, divide_by_norm=norm)
        assert loss.item() == 0
        loss.backward()
        assert torch.equal(rays["weights"].grad, torch.zeros(count, 30, dtype=torch.float64))


def test_gradient_at_weight_zero():
    # weight 0: d(-log(w + EPS))/dw · mass, mass = exp(0) · 1
    weights = torch.zeros(1, 1, requires_grad=True)
    edge_loss(weights, torch.tensor([[1.0]]), torch.tensor([[2.0]]), torch.tensor([1.5]), 1.0).backward()
    assert weights.grad is not None
    assert float(weights.grad) == pytest.approx(-1 / EPS)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"starts_m": torch.ones(12, 29)}, r"edge_loss: starts_m \(12, 29\) does not fit weights \(12, 30\)"),
        ({"ends_m": torch.ones(12, 30, 1)}, r"ends_m \(12, 30, 1\) does not fit"),
        ({"prior_m": torch.ones(12, 1)}, r"prior_m \(12, 1\) does not fit weights \(12, 30\); expected \(12,\)"),
        ({"sigma_m": torch.ones(11)}, r"sigma_m \(11,\) does not fit"),
        ({"weights": torch.ones(12, 30, 1)}, r"weights \(12, 30, 1\); expected two dimensions"),
        ({"gaussian": "line"}, "gaussian is 'line'; expected one of"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_input(change, words, unchecked_types):
    with pytest.raises(InputError, match=words):
        losses.edge_loss(**{**random_rays(7), **change})


def test_the_sky_loss_is_the_mean_share_that_is_stopped():
    weights = torch.tensor([[0.2, 0.3], [0.0, 0.0], [0.9, 0.1], [0.4, 0.5]], dtype=torch.float64, requires_grad=True)
    loss = sky_loss(weights, torch.tensor([True, True, False, True]))
    assert float(loss) == pytest.approx((0.5 + 0 + 0.9) / 3)
    loss.backward()
    assert weights.grad is not None
    assert weights.grad.tolist() == [[pytest.approx(1 / 3)] * 2] * 2 + [[0, 0]] + [[pytest.approx(1 / 3)] * 2]
    none = sky_loss(weights, torch.zeros(4, dtype=torch.bool))
    assert float(none) == 0 and none.requires_grad
    assert sky_loss(weights.half(), torch.ones(4, dtype=torch.bool)).dtype == torch.float32


def test_far_distances_in_half_precision_are_computed_in_float32():
    weights, edges = torch.tensor([[0.2, 0.7]]).half(), torch.tensor([[899.0, 901.0, 903.0]]).half()
    given = [weights, edges[:, :-1], edges[:, 1:], torch.tensor([902.0]).half(), torch.tensor([901.5]).half()]
    found = losses.urban_nerf_loss_of_nerfstudio(*given, sigma_m=3.0)
    whole = losses.urban_nerf_loss_of_nerfstudio(*[each.float() for each in given], sigma_m=3.0)
    assert found.dtype == torch.float32 and found.item() == whole.item()


def urban_rays(seed: int, dtype: torch.dtype = torch.float64) -> dict:
    rays = random_rays(seed, dtype=dtype)
    del rays["sigma_m"]
    return rays


TERMS = [
    {"expected": expected, "empty": empty, "near": near}
    for expected, empty, near in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.3, 2.0, 0.7))
]


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-5), (torch.float32, 1e-3)], ids=str)
@pytest.mark.parametrize("terms", TERMS, ids=str)
@pytest.mark.parametrize("sigma_m", [0.05, 0.6, 8.0])
@pytest.mark.parametrize("seed", range(3))
def test_urban_nerfs_loss_equals_its_twin(seed, sigma_m, terms, dtype, rtol):
    rays = urban_rays(seed, dtype)
    rays["weights"][:, ::5] = 0
    loss = urban_nerf_loss(**rays, sigma_m=sigma_m, **terms)
    arrays = {name: tensor.numpy().astype(np.float64) for name, tensor in rays.items()}
    twin = reference.urban_nerf_loss(**arrays, sigma_m=sigma_m, **terms)
    assert loss.dtype == dtype and twin > 0
    assert float(loss) == pytest.approx(twin, rel=rtol)


@pytest.mark.parametrize("terms", TERMS, ids=str)
def test_urban_nerfs_gradient_equals_finite_differences(terms):
    rays = {name: tensor[:8, :10] if tensor.ndim == 2 else tensor[:8] for name, tensor in urban_rays(1).items()}
    weights = (rays.pop("weights") + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: urban_nerf_loss(w, **rays, sigma_m=4.0, **terms), (weights,))


def test_urban_nerfs_terms_by_hand():
    # samples [1, 2], [2, 5], [5, 9] m, weights 0.2, 0.3, 0.4; prior 4 m, σ = 1/3 m, so ε = 1 m
    weights, edges = [0.2, 0.3, 0.4], [1.0, 2.0, 5.0, 9.0]
    found = [one_ray(weights, edges, 4.0, 1 / 3, urban_nerf_loss, **terms) for terms in TERMS[:3]]
    # expected 0.2 · 1.5 + 0.3 · 3.5 + 0.4 · 7 = 4.15, less 4 m
    assert found[0] == pytest.approx(0.15**2)
    # up to 3 m: 0.2² · 1 + 0.1² · 1
    assert found[1] == pytest.approx(0.05)
    # 3 to 5 m lie in the second sample: 0.1² · 2 - 2 · 0.1 · 1 + ∫K²; without the cut that is 3 / (2√π) = 0.846284,
    # cut at 3σ it is times erf(3) / erf(3/√2)² = 0.999978 / 0.994608
    assert found[2] == pytest.approx(0.02 - 0.2 + 0.846284 * 0.999978 / 0.994608, abs=2e-6)


def test_urban_nerfs_loss_is_least_where_light_ends_as_the_kernel_says():
    edges = np.linspace(1, 9, 801)
    midpoints = (edges[:-1] + edges[1:]) / 2
    losses = {}
    for at in (4.0, 5.0, 6.0):
        for width in (0.1, 0.3, 0.9):
            weights = np.exp(-((midpoints - at) ** 2) / (2 * width**2))
            losses[at, width] = one_ray(weights / weights.sum(), edges.tolist(), 5.0, 0.3, urban_nerf_loss)
    assert min(losses, key=lambda key: losses[key]) == (5.0, 0.3)
    # the kernel itself, but for its cut ends: nothing is left
    assert losses[5.0, 0.3] == pytest.approx(0, abs=1e-2)
    assert all(value > -1e-9 for value in losses.values())


def test_urban_nerfs_loss_does_not_depend_on_how_a_ray_is_cut_into_samples():
    """nerfstudio's does: its target grows with no sample's length."""
    coarse = one_ray([0.2, 0.3, 0.4], [1.0, 2.0, 5.0, 9.0], 4.2, 0.2, urban_nerf_loss)
    fine = one_ray([0.1, 0.1, 0.1, 0.2, 0.4], [1.0, 1.5, 2.0, 3.0, 5.0, 9.0], 4.2, 0.2, urban_nerf_loss)
    assert fine == pytest.approx(coarse, rel=1e-9)


def test_urban_nerfs_rays_without_a_prior_do_not_count():
    rays = urban_rays(2)
    with_prior = {name: tensor[4:] for name, tensor in rays.items()}
    torch.testing.assert_close(urban_nerf_loss(**with_prior, sigma_m=0.5), urban_nerf_loss(**rays, sigma_m=0.5))
    none = {name: tensor[:4] for name, tensor in rays.items()}
    none["weights"].requires_grad_()
    loss = urban_nerf_loss(**none, sigma_m=0.5)
    assert loss.item() == 0
    loss.backward()
    assert torch.equal(none["weights"].grad, torch.zeros(4, 30, dtype=torch.float64))
    assert float(urban_nerf_loss(**{name: tensor[:0] for name, tensor in rays.items()}, sigma_m=0.5)) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"starts_m": torch.ones(12, 29)}, r"urban_nerf_loss: starts_m \(12, 29\) does not fit weights \(12, 30\)"),
        ({"sigma_m": 0.0}, "urban_nerf_loss: sigma_m is 0.0; expected a positive number"),
        ({"sigma_m": math.nan}, "sigma_m is nan"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_wrong_input_of_urban_nerfs_loss(change, words, unchecked_types):
    with pytest.raises(InputError, match=words):
        urban_nerf_loss(**{**urban_rays(7), "sigma_m": 0.5, **change})
