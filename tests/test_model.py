import math
from dataclasses import replace

import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.losses import ds_nerf_depth_loss, urban_radiance_field_depth_loss
from nerfstudio.models.nerfacto import NerfactoModel

from edge_depth_nerf.compat import lpips_not_built
from edge_depth_nerf.losses import edge_loss
from edge_depth_nerf.model import EdgeDepthNerfModel

METRES_PER_UNIT = 20.0


def build(**options) -> EdgeDepthNerfModel:
    torch.manual_seed(0)
    config = replace(all_methods["edge-depth-nerf-lite"].pipeline.model, **options)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    model = config.setup(scene_box=box, num_train_data=3, metadata={"metres_per_unit": METRES_PER_UNIT}, device="cpu")
    return model


def rays(count=16) -> RayBundle:
    generator = torch.Generator().manual_seed(1)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return RayBundle(
        origins=torch.zeros(count, 3),
        directions=directions,
        pixel_area=torch.full((count, 1), 1e-4),
        camera_indices=torch.zeros(count, 1, dtype=torch.long),
    )


def batch(count=16) -> dict:
    generator = torch.Generator().manual_seed(2)
    prior = 3 + 10 * torch.rand(count, 1, generator=generator)
    prior[::4] = 0
    return {
        "image": torch.rand(count, 3, generator=generator),
        "prior_distance_m": prior,
        "prior_sigma_m": 0.1 * prior,
    }


def trained_step(model):
    """Outputs and losses of one training step; the same samples for every model of the same seed."""
    model.train()
    torch.manual_seed(3)
    outputs = model(rays())
    return outputs, model.get_loss_dict(outputs, batch(), model.get_metrics_dict(outputs, batch()))


def test_near_and_far_are_metres_and_are_not_reset():
    model = build(near_m=0.4, far_m=500.0)
    for training in (True, False):
        model.train(training)
        bundle = model.collider(rays())
        assert torch.allclose(bundle.nears * METRES_PER_UNIT, torch.tensor(0.4))
        assert torch.allclose(bundle.fars * METRES_PER_UNIT, torch.tensor(500.0))
    samples = trained_step(model)[0]["ray_samples_list"][0].frustums
    assert samples.starts.min() * METRES_PER_UNIT >= 0.4 * (1 - 1e-5)


def test_a_far_near_plane_is_warned_of(capsys):
    build(near_m=0.6)
    assert "near plane is at 0.6 m" in capsys.readouterr().out
    build(near_m=0.5)
    assert "near plane" not in capsys.readouterr().out


def test_the_edge_loss_is_eq_4_in_metres():
    model = build(depth_loss_mult=0.25, depth_loss_levels="final", edge_gaussian="point", edge_divide_by_norm=False)
    outputs, losses = trained_step(model)
    weights, samples = outputs["weights_list"][-1], outputs["ray_samples_list"][-1]
    starts, ends = (edge[..., 0] * METRES_PER_UNIT for edge in (samples.frustums.starts, samples.frustums.ends))
    supervision = batch()
    prior, sigma = supervision["prior_distance_m"][:, 0], supervision["prior_sigma_m"][:, 0]
    expected = 0.25 * edge_loss(weights[..., 0], starts, ends, prior, sigma, gaussian="point", divide_by_norm=False)
    assert torch.allclose(losses["edge_loss"], expected)
    assert losses["edge_loss"] > 0
    losses["edge_loss"].backward()
    gradients = [p.grad for p in model.field.mlp_base.parameters()]
    assert any(g is not None and g.abs().sum() > 0 for g in gradients)


def test_all_levels_reach_the_proposal_networks():
    for levels, reached in (("all", True), ("final", False)):
        model = build(depth_loss_levels=levels)
        _, losses = trained_step(model)
        losses["edge_loss"].backward()
        gradients = [p.grad for p in model.proposal_networks.parameters()]
        assert any(g is not None and bool(g.abs().sum() > 0) for g in gradients) == reached


@pytest.mark.parametrize("kind", ["ds-nerf", "urban-nerf"])
def test_baselines_are_the_host_own_losses_in_metres(kind):
    model = build(depth_loss=kind, depth_loss_mult=0.5, depth_sigma=0.3)
    outputs, losses = trained_step(model)
    total = torch.zeros(())
    prior, sigma = batch()["prior_distance_m"], torch.tensor([0.3])
    for weights, samples in zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True):
        starts, ends = samples.frustums.starts * METRES_PER_UNIT, samples.frustums.ends * METRES_PER_UNIT
        middles = (starts + ends) / 2
        if kind == "ds-nerf":
            total += ds_nerf_depth_loss(weights, prior, middles, ends - starts, sigma**2)
        else:
            rendered = outputs["expected_depth"] * METRES_PER_UNIT
            total += urban_radiance_field_depth_loss(weights, prior, rendered, middles, sigma)
    assert torch.allclose(losses["depth_loss"], 0.5 * total / 3)
    assert "edge_loss" not in losses


def test_sigma_of_ds_nerf_is_a_standard_deviation_in_metres():
    """One sample a ray, one sigma from the prior: it is pulled exp(-1/2) as hard as one at the prior."""
    model = build(depth_loss="ds-nerf", depth_sigma=0.3, depth_loss_mult=1.0)
    pulls = []
    for middle_m in (5.0, 5.3):
        starts, ends = (torch.full((1, 1, 1), (middle_m + half) / METRES_PER_UNIT) for half in (-0.05, 0.05))
        zero = torch.zeros(1, 1, 3)
        frustums = Frustums(origins=zero, directions=zero, starts=starts, ends=ends, pixel_area=starts)
        supervision = {"prior_distance_m": torch.full((1, 1), 5.0)}
        weights = torch.full((1, 1, 1), 0.5)
        pulls.append(float(model._depth_loss(weights, RaySamples(frustums=frustums), {}, supervision)))
    assert pulls[1] / pulls[0] == pytest.approx(math.exp(-0.5), rel=1e-4)


def test_without_a_depth_loss_it_is_nerfacto():
    _, losses = trained_step(build(depth_loss="none"))
    assert set(losses) == {"rgb_loss", "interlevel_loss", "distortion_loss"}
    with_loss = trained_step(build())[1]
    assert set(with_loss) == {*losses, "edge_loss"}
    for name, value in losses.items():
        assert torch.equal(value, with_loss[name])


def test_rays_without_prior_add_nothing():
    model = build()
    outputs, _ = trained_step(model)
    supervision = batch()
    supervision["prior_distance_m"] = torch.zeros(16, 1)
    losses = model.get_loss_dict(outputs, supervision, model.get_metrics_dict(outputs, supervision))
    assert losses["edge_loss"] == 0


def test_no_download_and_no_lpips_in_the_checkpoint(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: pytest.fail("downloads"))
    model = build()
    assert not [name for name in model.state_dict() if "lpips" in name]
    assert math.isnan(model.lpips(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)))


def judged_view(height=24, width=20):
    generator = torch.Generator().manual_seed(4)
    model = build().eval()
    distance = 2 + 3 * torch.rand(height, width, 1, generator=generator)
    outputs = {
        "rgb": torch.rand(height, width, 3, generator=generator),
        "depth": distance / METRES_PER_UNIT,
        "accumulation": torch.ones(height, width, 1),
        "prop_depth_0": distance,
        "prop_depth_1": distance,
    }
    mask = torch.zeros(height, width, 1, dtype=torch.bool)
    mask[:, 4:] = True
    truth = {
        "image": torch.rand(height, width, 3, generator=generator),
        "mask": mask,
        "lidar_distance_m": distance * 1.25,
        "truth_distance_m": distance * 2,
        "truth_rgb": outputs["rgb"].clone(),
    }
    return model, outputs, truth


def test_views_are_judged_inside_the_mask(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    model, outputs, truth = judged_view()
    metrics, images = model.get_image_metrics_and_images(outputs, truth)
    assert set(metrics) == {
        *("psnr", "ssim", "masked_psnr", "masked_ssim", "truth_masked_psnr", "truth_masked_ssim"),
    }
    inside = ((outputs["rgb"] - truth["image"])[:, 4:] ** 2).mean()
    assert metrics["masked_psnr"] == pytest.approx(-10 * math.log10(inside), abs=1e-4)
    assert metrics["truth_masked_ssim"] == pytest.approx(1)
    assert images["distance"].shape == (24, 20, 3)
    # |d - 1.25 d| / 1.25 d = 0.2, and |d - 2 d| / 2 d = 0.5 at every pixel
    pooled = model.pooled_depth_errors()
    assert pooled["lidar_abs_rel"] == pytest.approx(0.2, abs=1e-5)
    assert pooled["truth_abs_rel"] == pytest.approx(0.5, abs=1e-5)
    assert pooled["truth_pixels"] == 24 * 16
    truth["mask"][:, 4:] = False
    truth["mask"][:, :4] = True
    truth["lidar_distance_m"] = outputs["depth"] * METRES_PER_UNIT
    model.get_image_metrics_and_images({**outputs}, {**truth, "mask": torch.ones_like(truth["mask"])})
    # 384 pixels of 0.2 and 480 of 0: pooled over pixels 384 · 0.2 / 864, not (0.2 + 0) / 2
    assert model.pooled_depth_errors()["lidar_abs_rel"] == pytest.approx(384 * 0.2 / 864, abs=1e-5)
    model.reset_depth_errors()
    assert model.pooled_depth_errors() == {}


def test_lpips_is_used_where_its_weights_are(monkeypatch):
    model, outputs, truth = judged_view()
    monkeypatch.setattr("edge_depth_nerf.model.load_lpips", lambda: _MeanDifference())
    metrics, _ = model.get_image_metrics_and_images(outputs, truth)
    difference = (outputs["rgb"] - truth["image"]).abs()
    assert metrics["lpips"] == pytest.approx(difference.mean().item(), abs=1e-5)
    assert metrics["masked_lpips"] == pytest.approx((difference * truth["mask"]).mean().item(), abs=1e-5)
    assert metrics["truth_masked_lpips"] == pytest.approx(0)


class _MeanDifference(torch.nn.Module):
    """Stands for LPIPS, whose weights may not be here."""

    def forward(self, image, other):
        return (image - other).abs().mean()


def test_same_parameters_as_nerfacto():
    """Checkpoints go back and forth between nerfacto and this model (but for LPIPS, which nerfacto stores)."""
    ours = build()
    with lpips_not_built():
        host = NerfactoModel(config=ours.config, scene_box=ours.scene_box, num_train_data=3)
    shapes = [{name: value.shape for name, value in model.state_dict().items()} for model in (ours, host)]
    assert shapes[0] == shapes[1]
    host.load_state_dict(ours.state_dict())
