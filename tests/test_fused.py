"""The fused forms of nerfacto's parts against nerfstudio's own: fields, samples, losses, rays, whole training steps."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.model_components.losses import lossfun_distortion, lossfun_outer
from nerfstudio.model_components.ray_samplers import PDFSampler, UniformLinDispPiecewiseSampler

from edge_depth_nerf.config import FusedAdamConfig
from edge_depth_nerf.fused.losses import distortion_loss, proposal_loss
from edge_depth_nerf.fused.sampler import FusedPDFSampler, edges_of
from edge_depth_nerf.model import EdgeDepthNerfModel


def bundle(count: int = 40, seed: int = 1) -> RayBundle:
    generator = torch.Generator().manual_seed(seed)
    return RayBundle(
        origins=torch.rand(count, 3, generator=generator) - 0.5,
        directions=torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1),
        pixel_area=torch.full((count, 1), 1e-4),
        camera_indices=torch.arange(count)[:, None] % 3,
        nears=torch.full((count, 1), 0.01),
        fars=torch.full((count, 1), 50.0),
    )


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("single_jitter", [True, False])
def test_samples_lie_where_nerfstudio_puts_them(training, single_jitter):
    rays = bundle()
    first = UniformLinDispPiecewiseSampler(num_samples=30).train(training)(rays)
    generator = torch.Generator().manual_seed(5)
    weights = torch.rand(40, 30, 1, generator=generator) ** 8
    weights[3] = 0
    weights[4] = 0
    weights[4, 7] = 1
    weights[5, :] = 1e-9
    found = []
    for kind in (PDFSampler, FusedPDFSampler):
        sampler = kind(include_original=False, single_jitter=single_jitter).train(training)
        torch.manual_seed(2)
        samples = sampler(rays, first, weights, num_samples=17)
        found.append((edges_of(samples), samples.frustums.starts, samples.frustums.ends))
    for expected, placed in zip(*found, strict=True):
        torch.testing.assert_close(placed, expected, rtol=1e-4, atol=1e-5)
    assert found[1][0].diff().min() >= 0


def histograms(seed: int = 0, rays: int = 50) -> tuple[torch.Tensor, ...]:
    """Edges and weights of final samples and of a proposal; some edges are common to both."""
    generator = torch.Generator().manual_seed(seed)
    outer_edges = torch.rand(rays, 13, generator=generator).sort(dim=1)[0]
    edges = torch.rand(rays, 9, generator=generator).sort(dim=1)[0]
    edges[: rays // 2, 2:5] = outer_edges[: rays // 2, 4:7]
    edges = edges.sort(dim=1)[0]
    return (
        edges,
        torch.rand(rays, 8, generator=generator) / 8,
        outer_edges,
        torch.rand(rays, 12, generator=generator) / 20,
    )


def test_the_proposal_loss_is_nerfstudios():
    edges, weights, outer_edges, outer = histograms()
    outers = [outer.clone().requires_grad_() for _ in range(2)]
    expected = lossfun_outer(edges, weights, outer_edges, outers[0]).mean()
    found = proposal_loss(edges, weights, outer_edges, outers[1])
    assert float(found) == pytest.approx(float(expected), rel=1e-5)
    assert expected > 0
    expected.backward()
    found.backward()
    assert outers[0].grad is not None and outers[1].grad is not None
    torch.testing.assert_close(outers[1].grad, outers[0].grad, rtol=1e-4, atol=1e-7)
    assert not proposal_loss(edges, weights, outer_edges, outer).requires_grad


def test_the_distortion_loss_is_nerfstudios():
    edges, weights, _, _ = histograms()
    both = [weights.clone().requires_grad_() for _ in range(2)]
    expected = lossfun_distortion(edges, both[0]).mean()
    found = distortion_loss(edges, both[1])
    assert float(found) == pytest.approx(float(expected), rel=1e-5)
    expected.backward()
    found.backward()
    assert both[0].grad is not None and both[1].grad is not None
    torch.testing.assert_close(both[1].grad, both[0].grad, rtol=1e-4, atol=1e-7)


def build(**options) -> EdgeDepthNerfModel:
    torch.manual_seed(0)
    config = all_methods["edge-depth-nerf-lite"].pipeline.model
    camera_optimizer = replace(config.camera_optimizer, mode=options.pop("poses", "off"))
    config = replace(config, camera_optimizer=camera_optimizer, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    return config.setup(scene_box=box, num_train_data=3, metadata={"metres_per_unit": 20.0}, device="cpu")


def train(model: EdgeDepthNerfModel, optimiser: AdamOptimizerConfig, steps: int) -> list[dict[str, float]]:
    """The losses of some steps, from random numbers of one seed."""
    model.train()
    steps_of = optimiser.setup([p for group in model.get_param_groups().values() for p in group])
    history = []
    for step in range(steps):
        rays = bundle(64, seed=step)
        generator = torch.Generator().manual_seed(step)
        prior = 3 + 10 * torch.rand(64, 1, generator=generator)
        prior[::4] = 0
        batch = {
            "image": torch.rand(64, 3, generator=generator),
            "prior_distance_m": prior,
            "prior_sigma_m": 0.1 * prior + 0.01,
        }
        torch.manual_seed(step)
        outputs = model(rays)
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        steps_of.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        steps_of.step()
        history.append({name: float(loss.detach()) for name, loss in losses.items()})
    return history


@pytest.mark.parametrize("options", [{}, {"poses": "SO3xR3"}, {"depth_loss": "urban-nerf"}], ids=str)
def test_training_goes_as_with_torch(options):
    """The same seed gives the same losses, step after step, with nerfstudio's arithmetic and with the fused one."""
    torch_history = train(build(implementation="torch", **options), AdamOptimizerConfig(lr=1e-2, eps=1e-15), 6)
    fused_history = train(build(implementation="fused", **options), FusedAdamConfig(lr=1e-2, eps=1e-15), 6)
    assert torch_history[-1]["rgb_loss"] < torch_history[0]["rgb_loss"]
    for expected, found in zip(torch_history, fused_history, strict=True):
        assert set(found) == set(expected)
        for name, value in expected.items():
            assert found[name] == pytest.approx(value, rel=2e-3, abs=1e-7), name


def test_training_renders_no_depth_that_nobody_reads():
    for loss, expected in (("edge", set()), ("urban-nerf", {"expected_depth"})):
        model = build(depth_loss=loss).train()
        outputs = model(bundle())
        assert {name for name in outputs if "depth" in name} == expected
