"""Networks and rendering in one pass, against the same arithmetic in float64 and against nerfstudio's."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from models import build, bundle, layers
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components import renderers
from torch import Tensor

from edge_depth_nerf.kernels import rendering_numba
from edge_depth_nerf.kernels.rendering import Background, Networks, Rendered
from edge_depth_nerf.kernels.rendering_numba import STEEPEST, render
from edge_depth_nerf.plugin.fused.fields import FusedNerfactoField
from edge_depth_nerf.plugin.scanning import Caster, SceneToModel


@pytest.fixture(autouse=True)
def threads(request, monkeypatch):
    """Let even a few points be shared out to several threads; two of them where a test does not say."""
    monkeypatch.setattr(rendering_numba, "LEAST_SHARE", 16)
    before = torch.get_num_threads()
    torch.set_num_threads(getattr(request, "param", 2))
    yield
    torch.set_num_threads(before)


ON_THREADS = pytest.mark.parametrize("threads", [1, 2], indirect=True, ids=["one thread", "two threads"])


def straight_networks(x: Tensor, of_points: Tensor, first: Any, second: Any, by_ray: Tensor) -> Tensor:
    (weights, biases), (more_weights, more_biases) = first, second
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        x = (x.relu() if number else x) @ weight.T + bias
    density, x = x[:, :1], x[:, 1:] @ more_weights[0].T + of_points @ by_ray.T + more_biases[0]
    for weight, bias in zip(more_weights[1:], more_biases[1:], strict=True):
        x = x.relu() @ weight.T + bias
    return torch.cat([density, x], dim=1).T


@ON_THREADS
@pytest.mark.parametrize("widths", [((24, 64, 16), (64, 64, 3)), ((5, 7), (33, 3)), ((6, 18, 20, 4), (3,))], ids=str)
@pytest.mark.parametrize(
    ("shape", "of_pictures"), [((40, 24, 300), True), ((50, 3, 0), False), ((1, 7, 1), True), ((30, 1, 30), False)]
)
def test_both_networks_and_the_rays_in_one_pass(widths, shape, of_pictures):
    torch.manual_seed(0)
    rays, samples, single_points = shape
    background = Background.POINT if single_points >= rays else Background.LAST_SAMPLE
    first = layers(*widths[0])
    second = layers(widths[0][-1] - 1, *widths[1])
    by_ray = torch.randn(widths[1][0], 9, requires_grad=True)
    of_rays = torch.randn(rays + single_points, 9, requires_grad=of_pictures)
    points = rays * samples + single_points
    x = (0.3 * torch.randn(points, widths[0][0])).requires_grad_()
    with torch.no_grad():
        for weight in (*first[0], *second[0], by_ray):
            weight *= 0.3
    leaves = [x, *([of_rays] if of_pictures else []), *first[0], *first[1], *second[0], *second[1], by_ray]
    inside, deltas = (torch.rand(points) > 0.1).float(), 0.3 * torch.rand(rays, samples)
    networks = Networks(first, second, by_ray)
    found = render(x, of_rays, networks, inside, deltas, 0.7, background)
    factors = [torch.randn(each.shape) for each in found]
    gradients = torch.autograd.grad(found, leaves, factors)

    exact = {leaf: leaf.detach().double().requires_grad_() for leaf in leaves}
    of_points = exact.get(of_rays, of_rays.double())
    repeated = torch.cat([of_points[:rays].repeat_interleave(samples, 0), of_points[rays:]])
    one, other = ([[exact[each] for each in part] for part in network] for network in (first, second))
    values = straight_networks(exact[x], repeated, one, other, exact[by_ray])
    expected = straight_pixels(values, inside.double(), deltas.double(), 0.7, background)
    for each, right in zip(found, expected, strict=True):
        torch.testing.assert_close(each.double(), right, rtol=1e-4, atol=1e-5)
    slopes = torch.autograd.grad(expected, list(exact.values()), [each.double() for each in factors])
    for each, right in zip(gradients, slopes, strict=True):
        assert float((each - right).abs().max()) <= 5e-5 * float(right.abs().max()), each.shape
    assert gradients[0].t().is_contiguous() and all(each.is_contiguous() for each in gradients[1:])
    with torch.no_grad():
        again = render(x, of_rays, networks, inside, deltas, 0.7, background)
    for each, right in zip(again, found, strict=True):
        torch.testing.assert_close(each, right.detach(), rtol=1e-5, atol=1e-6)


def test_positions_that_nobody_follows_cost_no_gradient():
    first, second = layers(4, 8, 3), layers(2, 8, 3)
    x, by_ray = torch.randn(20, 4), torch.randn(8, 2)
    given = torch.ones(20), torch.rand(6, 3), 1.0, Background.BLACK
    rendered = render(x, torch.randn(8, 2), Networks(first, second, by_ray), *given)
    torch.stack([each.sum() for each in rendered]).sum().backward()
    assert x.grad is None and by_ray.grad is None
    assert all(each.grad is not None for part in (*first, *second) for each in part)


def render_values(values: Tensor, inside: Tensor, deltas: Tensor, scale: float, background: Background) -> Rendered:
    """Render what networks give, [4, points]: behind networks that pass it on."""
    networks = Networks(([torch.eye(4)], [torch.zeros(4)]), ([torch.eye(3)], [torch.zeros(3)]), torch.zeros(3, 1))
    single_points = values.shape[1] - deltas.numel()
    nothing = torch.zeros(len(deltas) + single_points, 1)
    return render(values.t(), nothing, networks, inside, deltas, scale, background)


def straight_pixels(
    values: Tensor, inside: Tensor, deltas: Tensor, scale: float, background: Background
) -> list[Tensor]:
    """What `render_values` gives, step by step; the density's slope limited as in nerfstudio's trunc_exp."""
    rays, samples = deltas.shape
    before = values[0, : rays * samples]
    slope = before.detach().clamp(-STEEPEST, STEEPEST).exp()
    density = before.detach().exp() + slope * (before - before.detach())
    depths = (scale * density * inside[: rays * samples]).view(rays, samples) * deltas
    reached = torch.cumsum(depths, 1) - depths
    weights = (1 - torch.exp(-depths)) * torch.exp(-reached)
    weights = torch.nan_to_num(weights, nan=0.0)
    colours = torch.sigmoid(values[1:].T)
    of_samples, single_points = colours[: rays * samples].view(rays, samples, 3), colours[rays * samples :]
    hit = weights.sum(1, keepdim=True)
    rgb = (weights[..., None] * of_samples).sum(1)
    if background == Background.LAST_SAMPLE:
        rgb = rgb + (1 - hit) * of_samples[:, -1]
    elif background == Background.POINT:
        rgb, single_points = rgb + (1 - hit) * single_points[:rays], single_points[rays:]
    return [rgb, hit, weights, single_points]


@ON_THREADS
@pytest.mark.parametrize("background", list(Background))
@pytest.mark.parametrize("shape", [(37, 24, 100), (5, 1, 8), (1, 13, 1), (70, 7, 70)], ids=str)
def test_pixels_and_their_gradients(background, shape):
    torch.manual_seed(1)
    rays, samples, single_points = shape
    points = rays * samples + single_points
    values = (2 * torch.randn(4, points)).requires_grad_()
    with torch.no_grad():
        values[0, ::11] = 16
        values[0, 1::11] = -17
    inside, deltas = (torch.rand(points) > 0.1).float(), 0.3 * torch.rand(rays, samples)
    found = render_values(values, inside, deltas, 1.7, background)
    exact = values.detach().double().requires_grad_()
    expected = straight_pixels(exact, inside.double(), deltas.double(), 1.7, background)
    for each, other in zip(found, expected, strict=True):
        assert each.shape == other.shape
        torch.testing.assert_close(each.double(), other, rtol=1e-5, atol=1e-6)
    gradients = [torch.randn(each.shape) for each in found]
    (slope,) = torch.autograd.grad(found, values, gradients)
    (other,) = torch.autograd.grad(expected, exact, [each.double() for each in gradients])
    assert float((slope - other).abs().max()) <= 2e-5 * float(other.abs().max())
    # whatever a loss reads alone
    for number in range(4):
        if found[number].numel():
            once_more = render_values(values, inside, deltas, 1.7, background)
            (slope,) = torch.autograd.grad(once_more[number].square().sum(), values)
            again = straight_pixels(exact, inside.double(), deltas.double(), 1.7, background)[number].square().sum()
            (other,) = torch.autograd.grad(again, exact)
            assert float((slope - other).abs().max()) <= 2e-5 * float(other.abs().max()) + 1e-6


def test_a_density_that_is_not_a_number_weighs_nothing_and_shows():
    values = torch.zeros(4, 9)
    values[0, 4] = float("nan")
    values.requires_grad_()
    rendered = render_values(values, torch.ones(9), torch.full((3, 3), 0.5), 1.0, Background.BLACK)
    assert rendered.weights[1, 1:].tolist() == [0, 0] and rendered.weights[0].min() > 0
    rendered.rgb.sum().backward()
    assert values.grad is not None and values.grad[:, :3].isfinite().all() and values.grad[0, 3:6].isnan().any()


def both_ways(model: Any, monkeypatch: Any, rays: Callable[[], RayBundle] = bundle) -> list[dict[str, Any]]:
    """The model's outputs as rendered at once, and step by step from the same samples."""
    torch.manual_seed(3)
    at_once = model(rays())
    monkeypatch.setattr(FusedNerfactoField, "may_render", lambda *_: False)
    torch.manual_seed(3)
    return [at_once, model(rays())]


@pytest.mark.parametrize("training", [True, False], ids=["training", "evaluation"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"sky_background": False},
        {"depth_loss": "none", "background_color": "random"},
        {"exposure": "embedding"},
        {"exposure": "embedding", "use_average_appearance_embedding": False, "depth_loss": "none"},
    ],
    ids=str,
)
def test_a_model_renders_the_same_at_once_and_step_by_step(options, training, monkeypatch):
    model = build(**options).train(training)
    with torch.no_grad():
        for network in (model.field, *model.proposal_networks):
            for parameter in network.parameters():
                if parameter.shape[-1] == 2:
                    parameter.uniform_(-0.5, 0.5)
    at_once, by_steps = both_ways(model, monkeypatch)
    assert set(at_once) == set(by_steps)
    for name in ("rgb", "accumulation"):
        torch.testing.assert_close(at_once[name], by_steps[name], rtol=1e-4, atol=1e-5)
    assert float(at_once["rgb"].std()) > 1e-3


def test_rays_that_end_early_have_no_sky(monkeypatch):
    """Those of a mesh's texture: behind them is what their last sample shows, as in nerfacto, not the far sky."""
    model, whole = build(depth_loss="edge").eval(), bundle()
    model.field.average_init_density = 0.1
    with torch.no_grad():
        for name, parameter in model.field.named_parameters():
            if "hash_table" in name:
                parameter.uniform_(-0.5, 0.5)

    def short() -> RayBundle:
        rays = bundle()
        rays.nears, rays.fars = (torch.full((len(rays), 1), distance) for distance in (0.0, 0.05))
        return rays

    with_sky = model(whole)
    assert whole.fars is None and torch.equal(model(whole)["rgb"], with_sky["rgb"])  # and once more
    colours: list[Any] = []
    at: Any = model.field.forward_together
    monkeypatch.setattr(
        model.field, "forward_together", lambda parts: [colours.append(each) or each for each in at(parts)]
    )
    at_once, by_steps = both_ways(model, monkeypatch, short)
    torch.testing.assert_close(at_once["rgb"], by_steps["rgb"], rtol=1e-4, atol=1e-5)
    (found,) = colours
    last_alone = found[FieldHeadNames.RGB][:, -1]
    nearly_empty = by_steps["accumulation"][:, 0] < 0.02
    assert nearly_empty.any()
    assert (by_steps["rgb"] - last_alone)[nearly_empty].abs().max() < 0.03


def test_a_crop_shows_its_background_alone(monkeypatch):
    """What is cut away has the chosen colour, not the sky as well, which would exceed 1."""
    model = build(depth_loss="edge").eval()
    model.field.average_init_density = 1e-3
    rendered = []
    for colour in (0.0, 1.0):
        monkeypatch.setattr(renderers, "BACKGROUND_COLOR_OVERRIDE", torch.full((3,), colour))
        torch.manual_seed(3)
        rendered.append(model(bundle()))
    black, white = rendered
    assert float(white["rgb"].max()) <= 1 + 1e-6 and float(black["accumulation"].min()) < 0.9
    torch.testing.assert_close(white["rgb"] - black["rgb"], (1 - black["accumulation"]).expand(-1, 3))


@pytest.mark.parametrize("case", ["a background of the exporter's", "gradients scaled by distance", "normals"])
def test_what_is_not_covered_is_rendered_step_by_step(case, monkeypatch):
    options = {"gradients scaled by distance": {"use_gradient_scaling": True}, "normals": {"predict_normals": True}}
    model = build(depth_loss="none", **options.get(case, {})).eval()
    if case == "a background of the exporter's":
        monkeypatch.setattr(renderers, "BACKGROUND_COLOR_OVERRIDE", torch.ones(3))
    used = []
    monkeypatch.setattr(rendering_numba, "render", lambda *_: used.append(1))
    assert model(bundle())["rgb"].isfinite().all() and not used


@pytest.mark.parametrize("implementation", ["fused", "torch"])
@pytest.mark.parametrize("reach_m", [None, 8.0])
def test_lengths_are_the_same_without_colours(implementation: str, reach_m: float | None) -> None:
    """In parts of 16 rays; of nerfstudio's own field, too."""
    model = build(implementation=implementation, eval_num_rays_per_chunk=16).eval()
    rng = np.random.default_rng(0)
    origin_m, along = rng.uniform(-3, 3, (40, 3)), rng.normal(size=(40, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    caster = Caster(model, SceneToModel(np.eye(3), np.zeros(3), 1 / 20))
    coloured, alone = (caster.cast(origin_m, along, reach_m, colours) for colours in (True, False))
    assert alone.rgb is None and coloured.rgb is not None and coloured.rgb.shape == (40, 3)
    np.testing.assert_allclose(alone.distance_m, coloured.distance_m, rtol=1e-5)
    np.testing.assert_allclose(alone.hit, coloured.hit, atol=1e-5)
    assert np.ptp(alone.distance_m) > 0 and (0 < alone.hit).all()
