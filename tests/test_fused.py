"""The fused forms of nerfacto's parts against nerfstudio's own: fields, samples, losses, rays, whole training steps."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from dataclasses import fields
from typing import Any

import pytest
import torch
from models import build, bundle, layers, supervision, surface
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.field_components.mlp import MLP
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.fields.nerfacto_field import NerfactoField
from nerfstudio.model_components.losses import lossfun_distortion, lossfun_outer
from nerfstudio.model_components.ray_samplers import PDFSampler, UniformLinDispPiecewiseSampler
from nerfstudio.models import nerfacto

from edge_depth_nerf.kernels import hash_grid_numba, network_numba
from edge_depth_nerf.kernels.contraction_numba import contract
from edge_depth_nerf.kernels.network import network
from edge_depth_nerf.plugin.config import FusedAdamConfig
from edge_depth_nerf.plugin.fused.build import FORMS, fused_forms
from edge_depth_nerf.plugin.fused.fields import FusedDensityField, FusedMLP, FusedNerfactoField
from edge_depth_nerf.plugin.fused.hash_grid import FusedHashEncoding
from edge_depth_nerf.plugin.fused.ray_samplers import (
    FirstSampler,
    FusedFrustums,
    FusedPDFSampler,
    FusedProposalSampler,
    FusedRaySamples,
    edges_of,
    samples_along,
)
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel
from edge_depth_nerf.plugin.step_losses import distortion_loss, interlevel_loss


@pytest.fixture(autouse=True)
def small_shares(monkeypatch):
    """Let even a few points be shared out to several threads."""
    monkeypatch.setattr(network_numba, "LEAST_SHARE", 64)
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def straight(x: torch.Tensor, weights: list[torch.Tensor], biases: list[torch.Tensor]) -> torch.Tensor:
    """The network in float64, with the first bias repeated for its group."""
    group = len(x) // biases[0].view(-1, biases[0].shape[-1]).shape[0]
    for number, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        rows = bias.repeat_interleave(group, 0) if bias.ndim == 2 else bias
        x = x @ weight.T + rows
        x = x.clamp(min=0) if number < len(weights) - 1 else x
    return x


NETWORKS = list(itertools.product([600], [(16, 64, 16), (15, 64, 64, 3), (4, 2)], [0, 1, 25, 600], [1, 2]))
NOT_FULL = [(points, (5, 33, 7), 0, 1) for points in (1, 63, 64, 95, 96, 97, 129)]


@pytest.mark.parametrize(("points", "widths", "groups", "threads"), [*NETWORKS, *NOT_FULL], ids=str)
def test_the_network_in_tiles(points, widths, groups, threads):
    torch.manual_seed(0)
    torch.set_num_threads(threads)
    weights, biases = layers(*widths)
    if groups:
        biases[0] = torch.randn(groups, widths[1], requires_grad=True)
    x = torch.randn(points, 20)[:, 1 : widths[0] + 1].requires_grad_()
    leaves = [x, *weights, *biases]
    found = network(x, weights, biases)
    gradient = torch.randn(found.shape)
    gradients = torch.autograd.grad(found, leaves, gradient)
    exact = [leaf.detach().double().requires_grad_() for leaf in leaves]
    expected = straight(exact[0], exact[1 : 1 + len(weights)], exact[1 + len(weights) :])
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=1e-4)
    for each, other in zip(gradients, torch.autograd.grad(expected, exact, gradient.double()), strict=True):
        assert float((each - other).abs().max()) <= 1e-5 * float(other.abs().max())
    assert all(each.is_contiguous() for each in gradients)
    with torch.no_grad():
        assert torch.equal(network(x, weights, biases), found)


NARROW = """
import llvmlite.binding as llvm
import torch
from edge_depth_nerf.kernels import hash_grid_numba  # Numba has read the features by now
features = llvm.get_host_cpu_features()
llvm.get_host_cpu_features = lambda: {**features, "avx512f": not features.get("avx512f", False)}
from edge_depth_nerf.kernels import network_numba as compiled
torch.manual_seed(0)
weights, biases = [torch.randn(33, 15), torch.randn(40, 33), torch.randn(3, 40)], [torch.randn(50, 33)]
biases += [torch.randn(1, 40), torch.randn(1, 3)]
x, gradient = torch.randn(150, 15), torch.randn(150, 3)
exact = [each.double().requires_grad_() for each in (x, *weights, *biases)]
expected = exact[0]
for number, (weight, bias) in enumerate(zip(exact[1:4], exact[4:], strict=True)):
    expected = expected.relu() if number else expected
    expected = expected @ weight.T + bias.repeat_interleave(150 // len(bias), 0)
arrays = compiled.Arrays(x, weights, biases)
to_x, to_weights, to_biases = compiled.backward(arrays, gradient, True)
found = [compiled.forward(arrays), to_x, *to_weights, *to_biases]
for each, other in zip(found, [expected, *torch.autograd.grad(expected, exact, gradient.double())], strict=True):
    assert float((each - other).abs().max()) <= 1e-5 * float(other.abs().max())
print("vectors of", compiled.VECTOR)
"""


@pytest.mark.slow
def test_the_network_of_other_processors(tmp_path):
    """Vectors have 16 numbers with AVX-512, else 8: here the form that this processor does not have."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", NARROW], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == str(24 - network_numba.VECTOR)


def test_one_bad_point_spoils_no_other():
    torch.manual_seed(0)
    weights, biases = layers(6, 40, 20, 3)
    x = torch.randn(300, 6)
    x[70] = float("nan")
    found = network(x, weights, biases)
    assert found[70].isnan().all()
    sound = torch.arange(300) != 70
    expected = straight(x[sound].double(), [w.double() for w in weights], [b.double() for b in biases])
    torch.testing.assert_close(found[sound].double(), expected, rtol=1e-5, atol=1e-4)


def test_the_network_has_no_second_derivative():
    weights, biases = layers(3, 4, 1)
    x = torch.randn(5, 3, requires_grad=True)
    (slope,) = torch.autograd.grad(network(x, weights, biases).sum(), x, create_graph=True)
    with pytest.raises(NotImplementedError, match="implementation torch"):
        slope.square().sum().backward()


def test_networks_that_are_not_covered_stay_nerfstudios():
    fused, *others = (
        FusedMLP(4, 2, 8, 3, implementation="torch"),
        FusedMLP(4, 3, 8, 3, skip_connections=(1,), implementation="torch"),
        FusedMLP(4, 2, 8, 3, activation=torch.nn.Softplus(), implementation="torch"),
    )
    x = torch.randn(2, 5, 4)
    assert [part.is_plain for part in (fused, *others)] == [True, False, False]
    assert all(torch.equal(part(x), MLP.forward(part, x)) for part in others)
    assert torch.allclose(fused(x), MLP.forward(fused, x), atol=1e-6)
    assert fused(x[:, :0]).shape == (2, 0, 3)
    assert fused.double()(x.double()).dtype == torch.float64
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert fused.float()(x).dtype == torch.bfloat16


def test_the_contraction_is_nerfactos():
    at = torch.tensor([-30.0, -2.0, -1.0, -0.5, 0.0, 1e-30, 0.3, 1.0, 2.0, 1e6, 1e30])
    x = torch.cat([torch.cartesian_prod(at, at, at), 3 * torch.randn(500, 3)])
    expected = (SceneContraction(order=float("inf"))(x) + 2) / 4
    inside = ((expected > 0) & (expected < 1)).all(-1)
    assert inside.any() and not inside.all()
    places, marked = contract(x)
    assert torch.equal(marked, inside.float())
    assert torch.equal(places, expected * inside[:, None])


JITTERED = pytest.mark.parametrize(("training", "single_jitter"), [(True, True), (True, False), (False, False)])


@JITTERED
def test_samples_lie_where_nerfstudio_puts_them(training, single_jitter):
    rays = bundle(planes=True)
    first = UniformLinDispPiecewiseSampler(num_samples=30).train(training)(rays)
    generator = torch.Generator().manual_seed(5)
    weights = torch.rand(40, 30, 1, generator=generator) ** 8
    weights[3:5], weights[5] = 0, 1e-9
    weights[4, 7] = 1
    found = []
    for kind in (PDFSampler, FusedPDFSampler):
        sampler = kind(include_original=False, single_jitter=single_jitter).train(training)
        torch.manual_seed(2)
        samples = sampler(rays, first, weights, num_samples=17)
        found.append((edges_of(samples), samples.frustums.starts, samples.frustums.ends))
    for expected, placed in zip(*found, strict=True):
        torch.testing.assert_close(placed, expected, rtol=1e-4, atol=1e-5)
    assert found[1][0].diff().min() >= 0


def test_all_samples_of_a_fused_model_have_fused_weights():
    model = build().train()
    outputs = model(bundle())
    # nor is depth rendered that nobody reads
    assert not [name for name in outputs if "depth" in name or "distance" in name]
    assert [type(samples) for samples in outputs["ray_samples_list"]] == [FusedRaySamples] * 3
    samples, densities = outputs["ray_samples_list"][0], torch.rand(outputs["weights_list"][0].shape)
    torch.testing.assert_close(
        samples.get_weights(densities), RaySamples.get_weights(samples, densities), rtol=1e-5, atol=1e-7
    )
    torch_form = build(implementation="torch").train()(bundle())
    assert FusedRaySamples not in {type(samples) for samples in torch_form["ray_samples_list"]}


@JITTERED
def test_the_first_samples_lie_where_nerfstudio_puts_them(training, single_jitter):
    rays = bundle(planes=True)
    sampler = FirstSampler(single_jitter).train(training)
    found = []
    for place in (UniformLinDispPiecewiseSampler(single_jitter=single_jitter).train(training), sampler):
        torch.manual_seed(2)
        samples = place(rays, 30)
        assert samples.spacing_to_euclidean_fn is not None
        again = samples.spacing_to_euclidean_fn(torch.linspace(0, 1, 7))
        found.append((edges_of(samples), samples.frustums.starts, samples.frustums.ends, samples.deltas, again))
    for expected, placed in zip(*found, strict=True):
        torch.testing.assert_close(placed, expected, rtol=1e-5, atol=1e-5)
    assert found[0][1].std() > 1


def test_nerfactos_parts_are_built_as_ours_and_nobody_elses():
    """Their constructors' names are nerfstudio's again afterwards."""
    kinds = {type(part) for part in build().modules()}
    assert {FusedNerfactoField, FusedDensityField, FusedMLP, FusedHashEncoding, FusedProposalSampler} < kinds
    assert {FirstSampler, FusedPDFSampler} < kinds and not {MLP, HashEncoding, PDFSampler} & kinds
    for module, forms in FORMS:
        assert not [name for name, form in forms.items() if getattr(module, name) is form]
    with pytest.raises(ZeroDivisionError), fused_forms():
        assert nerfacto.NerfactoField is FusedNerfactoField
        raise ZeroDivisionError
    assert nerfacto.NerfactoField is NerfactoField
    torch_form = {type(part) for part in build(implementation="torch").modules()}
    assert {MLP, HashEncoding, PDFSampler} < torch_form and not {FusedMLP, FusedHashEncoding} & torch_form


@pytest.mark.parametrize("shape", [(40,), (20, 2)], ids=str)
def test_samples_along_rays_are_nerfstudios_field_by_field(shape):
    rays = bundle(planes=True)
    metadata: dict[str, Any] = rays.metadata
    metadata |= {"directions_norm": torch.rand(40, 1), "cam_idx": 0}
    rays = rays.reshape(shape)
    edges = torch.rand(*rays.shape, 8, 1).cumsum(-2)
    more = {"spacing_starts": edges[..., :-1, :] / 9, "spacing_to_euclidean_fn": torch.exp}
    expected = rays.get_ray_samples(bin_starts=edges[..., :-1, :], bin_ends=edges[..., 1:, :], **more)
    found = samples_along(rays, edges[..., :-1, :], edges[..., 1:, :], **more)
    kinds = (FusedRaySamples, FusedFrustums) if len(shape) == 1 else (RaySamples, Frustums)
    assert (type(found), type(found.frustums)) == kinds
    assert found.shape == expected.shape == (*rays.shape, 7)
    assert found.metadata is not None and expected.metadata is not None
    assert found.metadata.keys() == expected.metadata.keys() and found.metadata["cam_idx"] == 0
    assert torch.equal(found.metadata["directions_norm"], expected.metadata["directions_norm"])
    compared = 0
    for part in (
        lambda samples: samples,
        lambda samples: samples.frustums,
        lambda samples: samples.frustums[2:4],
        lambda samples: samples.frustums.reshape((2, -1)),
    ):
        mine, theirs = part(found), part(expected)
        assert mine.shape == theirs.shape
        for name in {field.name for field in fields(mine)} - {"frustums", "metadata"}:
            value, wanted = getattr(mine, name), getattr(theirs, name)
            of_tensors = isinstance(wanted, torch.Tensor)
            assert torch.equal(value, wanted) if of_tensors else value is wanted, name
            compared += of_tensors
    assert compared == 3 + 3 * 5


def histograms(rays: int = 50) -> tuple[torch.Tensor, ...]:
    """Edges and weights of final samples and of a proposal; some edges are common to both."""
    generator = torch.Generator().manual_seed(0)
    outer_edges = torch.rand(rays, 13, generator=generator).sort(dim=1)[0]
    edges = torch.rand(rays, 9, generator=generator).sort(dim=1)[0]
    edges[: rays // 2, 2:5] = outer_edges[: rays // 2, 4:7]
    edges = edges.sort(dim=1)[0]
    weights, outer_weights = (torch.rand(rays, count, generator=generator) for count in (8, 12))
    return edges, weights / 8, outer_edges, outer_weights / 20


@pytest.mark.parametrize(
    ("form", "of_nerfstudio"), [(interlevel_loss, lossfun_outer), (distortion_loss, lossfun_distortion)]
)
def test_the_losses_of_samples_are_nerfstudios(form, of_nerfstudio):
    """The one by the weights of proposals, the other by those of the samples."""
    *given, outer = histograms()
    given, weights = (given, outer) if form is interlevel_loss else (given[:1], given[1])
    both = [weights.clone().requires_grad_() for _ in range(2)]
    expected, found = of_nerfstudio(*given, both[0]).mean(), form(*given, both[1])
    assert float(found) == pytest.approx(float(expected), rel=1e-5) and expected > 0
    expected.backward()
    found.backward()
    assert both[0].grad is not None and both[1].grad is not None
    torch.testing.assert_close(both[1].grad, both[0].grad, rtol=1e-4, atol=1e-7)
    assert not form(*given, weights).requires_grad


def train(model: EdgeDepthNerfModel, optimiser: AdamOptimizerConfig, steps: int) -> list[dict[str, float]]:
    """The losses of some steps, from random numbers of one seed."""
    model.train()
    steps_of = optimiser.setup([p for group in model.get_param_groups().values() for p in group])
    history = []
    for step in range(steps):
        rays, batch = bundle(64, seed=step), supervision(64, step)
        torch.manual_seed(step)
        outputs = model(rays)
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        steps_of.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        steps_of.step()
        history.append({name: float(loss.detach()) for name, loss in losses.items()})
    return history


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"poses": "SO3xR3"}, {"depth_loss": "urban-nerf"}], ids=str)
def test_training_goes_as_with_torch(options):
    """The same seed gives the same losses, step after step, with nerfstudio's arithmetic and with the fused one."""
    of_torch, fused = (build(small=False, implementation=kind, **options) for kind in ("torch", "fused"))
    torch_history = train(of_torch, AdamOptimizerConfig(lr=1e-2, eps=1e-15), 6)
    fused_history = train(fused, FusedAdamConfig(lr=1e-2, eps=1e-15), 6)
    loss = f"{options.get('depth_loss', 'edge').replace('-', '_')}_loss"
    assert torch_history[-1][loss] < torch_history[0][loss]
    for step, (expected, found) in enumerate(zip(torch_history, fused_history, strict=True)):
        assert set(found) == set(expected)
        for name, value in expected.items():
            if name == "interlevel_loss" and step > 0:
                # what is left of it are squares of differences near 0, which rounding and Adam make larger
                near = pytest.approx(value, rel=2e-3, abs=0.01 * torch_history[0][name])
            else:
                near = pytest.approx(value, rel=2e-4, abs=1e-9)
            assert found[name] == near, (step, name)


TABLE = "field.mlp_base.model.0.hash_table"


@pytest.mark.parametrize("planes", [False, True])
def test_samples_sky_and_surfaces_are_looked_up_together(monkeypatch, planes):
    """One gradient of the field's table a step, not three that are added; the numbers are those of torch's calls.

    Rays with planes of their own have no sky.
    """
    models = [build(implementation=kind).train() for kind in ("torch", "fused")]
    models[1].load_state_dict(models[0].state_dict())
    table = models[1].get_parameter(TABLE)
    made = []
    whole = hash_grid_numba.table_gradient
    monkeypatch.setattr(hash_grid_numba, "table_gradient", lambda *a: (made.append(a[-1]), whole(*a))[1])
    found = []
    for model in models:
        torch.manual_seed(1)
        outputs = model(bundle(planes=planes), surface(30))
        (outputs["rgb"].sum() + outputs["surface_rgb"].square().sum()).backward()
        found.append((outputs["rgb"], outputs["surface_rgb"], model.get_parameter(TABLE).grad))
    assert made.count(len(table)) == 1
    assert found[0][1].shape == (30, 3)
    for expected, other in zip(*found, strict=True):
        torch.testing.assert_close(other, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("average", [True, False])
def test_a_rendered_view_is_the_torch_view(average):
    options = {"exposure": "embedding", "use_average_appearance_embedding": average}
    models = [build(implementation=kind, **options) for kind in ("torch", "fused")]
    train(models[0], AdamOptimizerConfig(lr=1e-2, eps=1e-15), 3)
    models[1].load_state_dict(models[0].state_dict())
    rays = bundle(60)
    with torch.no_grad():
        outputs = [model.eval()(rays) for model in models]
    assert {"rgb", "depth", "expected_depth", "accumulation", "prop_depth_0", "prop_depth_1"} <= set(outputs[0])
    assert set(outputs[1]) == set(outputs[0])
    for name in ("rgb", "accumulation", "expected_depth"):
        torch.testing.assert_close(outputs[1][name], outputs[0][name], rtol=1e-3, atol=1e-5)


def test_a_fields_normals_can_be_had_at_evaluation():
    """ns-export asks the field for normals, whatever the model was trained with."""
    model = build().eval()
    assert isinstance(model.field, FusedNerfactoField)
    samples, _, _ = model.proposal_sampler(bundle(planes=True), density_fns=model.density_fns)
    with torch.no_grad():
        outputs = model.field(samples, compute_normals=True)
    normals = next(value for key, value in outputs.items() if key.name == "NORMALS")
    assert normals.shape == (40, 24, 3)
    assert bool((normals.norm(dim=-1) > 0.5).any())
