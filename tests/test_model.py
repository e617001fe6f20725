import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from models import build, bundle, supervision, surface
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.losses import ds_nerf_depth_loss, urban_radiance_field_depth_loss
from nerfstudio.model_components.renderers import DepthRenderer
from nerfstudio.models.nerfacto import NerfactoModel

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.method.depth_losses import DsNerfLoss, EdgeLoss, Level, UrbanNerfLoss, UrbanNerfSightLoss
from edge_depth_nerf.method.losses import edge_loss, urban_nerf_loss
from edge_depth_nerf.plugin.compat import lpips_not_built
from edge_depth_nerf.plugin.model import LossOptions
from edge_depth_nerf.plugin.renderers import MedianDepth
from edge_depth_nerf.plugin.step_losses import Planes, Step, draw_surface_m

METRES_PER_UNIT = 20.0
LOSSES = {name: f"{name.replace('-', '_')}_loss" for name in ("edge", "ds-nerf", "urban-nerf", "urban-nerf-los")}
NO_EXTRAS = {"sky_loss_mult": 0.0, "sky_background": False, "surface_loss_mult": 0.0, "depth_loss_final": 1.0}


def rays() -> RayBundle:
    return bundle(16)


def batch() -> dict:
    return supervision(16, 2)


def losses_of(model, outputs, supervision):
    return model.get_loss_dict(outputs, supervision, model.get_metrics_dict(outputs, supervision))


def trained_step(model, further=None):
    """Outputs and losses of one training step; the same samples for every model of the same seed."""
    supervision = batch() | (further or {})
    model.train()
    torch.manual_seed(3)
    outputs = model(rays(), supervision)
    return outputs, losses_of(model, outputs, supervision)


def are_taught(parameters) -> bool:
    return any(each.grad is not None and bool(each.grad.any()) for each in parameters)


def levels_of(outputs) -> list[Level]:
    """All samples along the rays of a batch, in metres, with its prior."""
    prior, sigma = batch()["prior_distance_m"][:, 0], batch()["prior_sigma_m"][:, 0]
    found = []
    for weights, samples in zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True):
        starts, ends = (each[..., 0] * METRES_PER_UNIT for each in (samples.frustums.starts, samples.frustums.ends))
        found.append(Level(weights[..., 0], starts, ends, prior, sigma))
    return found


def test_near_and_far_are_metres_and_are_not_reset():
    model = build(near_m=0.4, far_m=500.0)
    for training in (True, False):
        model.train(training)
        bundle = model.collider(rays())  # pyrefly: ignore[not-callable]
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
    literal = LossOptions(edge=EdgeLoss(gaussian="point", divide_by_norm=False))
    model = build(depth_loss_mult=0.25, depth_loss_levels="final", losses=literal)
    outputs, losses = trained_step(model)
    final = levels_of(outputs)[-1]
    along = (final.weights, final.starts_m, final.ends_m)
    per_ray = edge_loss(*along, final.prior_m, final.sigma_m, gaussian="point", divide_by_norm=False)
    assert torch.allclose(losses["edge_loss"], 0.25 * per_ray.sum() / 12)
    assert losses["edge_loss"] > 0
    losses["edge_loss"].backward()
    assert are_taught(model.field.mlp_base.parameters()) and not are_taught(model.proposal_networks.parameters())
    all_levels = build(depth_loss_levels="all")
    trained_step(all_levels)[1]["edge_loss"].backward()
    assert are_taught(all_levels.proposal_networks.parameters())


@pytest.mark.parametrize("kind", ["ds-nerf", "urban-nerf"])
def test_baselines_are_the_host_own_losses_in_metres(kind):
    options = LossOptions(ds_nerf=DsNerfLoss(sigma_m=0.3), urban_nerf=UrbanNerfLoss(sigma_m=0.3))
    model = build(depth_loss=kind, depth_loss_mult=0.5, losses=options)
    outputs, losses = trained_step(model)
    total = torch.zeros(())
    prior, sigma = batch()["prior_distance_m"], torch.tensor([0.3])
    for weights, samples in zip(outputs["weights_list"], outputs["ray_samples_list"], strict=True):
        starts, ends = samples.frustums.starts * METRES_PER_UNIT, samples.frustums.ends * METRES_PER_UNIT
        midpoints = (starts + ends) / 2
        if kind == "ds-nerf":
            total += ds_nerf_depth_loss(weights, prior, midpoints, ends - starts, sigma**2)
        else:
            final = outputs["weights_list"][-1], outputs["ray_samples_list"][-1]
            rendered = DepthRenderer(method="expected")(*final) * METRES_PER_UNIT
            total += urban_radiance_field_depth_loss(weights, prior, rendered, midpoints, sigma)
    assert torch.allclose(losses[LOSSES[kind]], 0.5 * total / 3)
    assert "edge_loss" not in losses


def test_urban_nerf_of_its_authors_is_in_metres_and_narrows():
    terms = {"expected": 0.1, "empty": 2.0, "near": 0.5}
    options = LossOptions(urban_nerf_los=UrbanNerfSightLoss(sigma_m=0.3, **terms, narrowing=4.0))
    model = build(depth_loss="urban-nerf-los", depth_loss_mult=0.5, depth_loss_final=1.0, losses=options)
    for step, sigma_m in ((0, 1.2), (15_000, 0.6), (30_000, 0.3)):
        model._step = step
        outputs, losses = trained_step(model)
        total = torch.zeros(())
        for each in levels_of(outputs):
            per_ray = urban_nerf_loss(each.weights, each.starts_m, each.ends_m, each.prior_m, sigma_m, **terms)
            total += per_ray.sum() / 12
        assert torch.allclose(losses["urban_nerf_los_loss"], 0.5 * total / 3)
    losses["urban_nerf_los_loss"].backward()
    assert are_taught(model.field.mlp_base.parameters())


def test_a_loss_that_varies_without_saying_so_is_not_trained(monkeypatch):
    """A CUDA graph would repeat it as it was when it was recorded."""
    monkeypatch.setattr(UrbanNerfSightLoss, "varies", False)
    with pytest.raises(InputError, match="sigma_m is nan"):
        trained_step(build(depth_loss="urban-nerf-los"))


def test_without_a_depth_loss_it_is_nerfacto():
    _, losses = trained_step(build(depth_loss="none"))
    assert set(losses) == {"rgb_loss", "interlevel_loss", "distortion_loss"}
    with_loss = trained_step(build(sky_background=False))[1]
    assert set(with_loss) == {*losses, "edge_loss", "sky_loss"}
    for name, value in losses.items():
        assert torch.equal(value, with_loss[name])


def step_with_surface(model):
    """Outputs and losses of a training step that brings further pixels."""
    torch.manual_seed(3)
    with torch.no_grad():
        for parameter in model.field.parameters():
            parameter.normal_(0, 0.3)  # a new field has one colour everywhere
    return trained_step(model, surface())


@pytest.mark.parametrize("kind", LOSSES)
def test_surface_sky_and_falling_weight_are_options_of_any_depth_loss(kind):
    name = LOSSES[kind]
    model, plain = build(depth_loss=kind), build(depth_loss=kind, **NO_EXTRAS)
    outputs, losses = step_with_surface(model)
    plain_outputs, without = step_with_surface(plain)
    assert set(losses) - set(without) == {"sky_loss", "surface_loss"} and name in without
    of_edge = step_with_surface(build())[1]
    # the same samples: what surface and sky make of them has nothing to do with the depth loss
    for extra in ("sky_loss", "surface_loss"):
        assert float(losses[extra].detach()) == pytest.approx(float(of_edge[extra].detach()), rel=1e-5)
    assert not torch.allclose(outputs["rgb"], plain_outputs["rgb"], atol=1e-2)
    for each, share in ((model, 0.01), (plain, 1.0)):
        weight, surface_weight = each.weights_now()
        each._step = 30_000
        assert each.weights_now() == (pytest.approx(share * weight), surface_weight)


def test_without_weight_the_prior_serves_surface_and_sky_alone():
    outputs, losses = step_with_surface(build(depth_loss_mult=0.0))
    of_edge_outputs, of_edge = step_with_surface(build())
    assert set(of_edge) - set(losses) == {"edge_loss"} and {"sky_loss", "surface_loss"} < set(losses)
    assert torch.equal(outputs["rgb"], of_edge_outputs["rgb"])


def colours_at(model, bundle: RayBundle, distance_units) -> torch.Tensor:
    places = bundle.get_ray_samples(bin_starts=distance_units[:, None, None], bin_ends=distance_units[:, None, None])
    return model.field(places)[FieldHeadNames.RGB][:, 0]


def test_weights_of_depth_and_surfaces_fall_over_the_training():
    model = build(depth_loss_mult=0.5, depth_loss_final=0.01, surface_loss_final=0.1)
    model._training_steps = 100
    depth, surfaces = (float(step_with_surface(model)[1][name].detach()) for name in ("edge_loss", "surface_loss"))
    (tell,) = (
        callback
        for callback in model.get_training_callbacks(TrainingCallbackAttributes(None, None, None, None))
        if callback.func.__name__ == "remember"
    )
    for step, share in ((0, 1.0), (50, 0.1), (100, 0.01), (5000, 0.01)):
        tell.run_callback_at_location(step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        losses = step_with_surface(model)[1]
        assert float(losses["edge_loss"].detach()) == pytest.approx(depth * share, rel=1e-4)
        assert float(losses["surface_loss"].detach()) == pytest.approx(surfaces * share**0.5, rel=1e-4)


@pytest.mark.parametrize(("sharp", "scheduled"), [(0.0, False), (0.02, False), (0.02, True)])
def test_what_lidar_measured_keeps_its_weight(sharp, scheduled):
    model = build(depth_loss_mult=0.5, depth_loss_final=0.01, depth_loss_sharp=sharp)
    model._training_steps = model._step = 100
    supervision = batch()
    known = supervision["prior_distance_m"]
    measured = (torch.arange(16) % 2 == 0)[:, None]
    supervision["prior_sigma_m"] = torch.where(measured, 0.019 * known + 0.02, 0.022 * known + 0.02)
    outputs, losses = trained_step(model, supervision)
    weights = torch.where(measured[:, 0] & (sharp > 0), 0.5, 0.005)
    if scheduled:
        # as in a recorded step, which reads λ from the device
        model.scheduled_weights = torch.tensor(0.005), torch.tensor(1.0)
        losses = losses_of(model, outputs, supervision)
    levels = [replace(each, sigma_m=supervision["prior_sigma_m"][:, 0]) for each in levels_of(outputs)]
    expected = sum((weights * EdgeLoss()(each)).sum() for each in levels) / 12 / 3
    assert float(losses["edge_loss"]) == pytest.approx(float(expected), rel=1e-5)


def test_what_nothing_stops_has_the_colour_of_the_direction():
    """Empty space shows the field at infinity: the same from wherever the camera stands."""
    model, plain = build(small=False).eval(), build(small=False, sky_background=False).eval()
    with torch.no_grad():
        # a new field has one colour everywhere
        for of_model, of_plain in zip(model.field.parameters(), plain.field.parameters(), strict=True):
            of_plain.copy_(of_model.normal_(0, 0.3))
        behind = colours_at(model, rays(), torch.full((16,), 1e4))
        elsewhere = replace(rays(), origins=torch.full((16, 3), 0.4))
        assert torch.allclose(colours_at(model, elsewhere, torch.full((16,), 1e6)), behind, atol=5e-2)
        assert not torch.allclose(model(rays())["rgb"], behind, atol=5e-2)
        model.field.average_init_density = 0.0  # nothing anywhere
        assert torch.allclose(model(rays())["rgb"], behind, atol=1e-3)
        assert torch.allclose(model(elsewhere)["rgb"], behind, atol=5e-2)
        plain.field.average_init_density = 0.0
        assert not torch.allclose(plain(rays())["rgb"], behind, atol=5e-2)


def test_views_have_the_geometric_mean_of_the_pictures_gains():
    model = build()
    gains: Any = model.exposure
    with torch.no_grad():
        gains.log_gains.copy_(torch.tensor([[0.1, 0.2, 0.3], [0.3, 0.2, 0.1], [0.5, 0.2, 0.2]]))
    bundle = replace(rays(), camera_indices=(torch.arange(16) % 3)[:, None])
    colours = torch.rand(16, 3)
    expected = colours * torch.tensor([[-0.2, 0, 0.1], [0, 0, -0.1], [0.2, 0, 0]]).exp()[torch.arange(16) % 3]
    bundles = [bundle[:10], bundle[10:]]
    exposed = model.train()._exposed([colours[:10], colours[10:]], bundles)
    assert torch.allclose(torch.cat([*exposed]), expected)
    assert torch.equal(model.eval()._exposed([colours], [bundle])[0], colours)
    # they are learned, and kept with the rest
    assert any(parameter is gains.log_gains for parameter in model.get_param_groups()["fields"])
    torch.stack(list(trained_step(model)[1].values())).sum().backward()
    assert are_taught([gains.log_gains])
    assert "exposure.log_gains" in model.state_dict() and model.field.embedding_appearance is None
    embedded = build(exposure="embedding")
    assert embedded.exposure is None and embedded.field.embedding_appearance is not None


def test_the_sky_loss_is_what_rays_into_the_sky_hit():
    model = build(sky_loss_mult=0.5)
    outputs, losses = trained_step(model)
    sky = batch()["sky"][:, 0]
    hit = [float(weights[sky].sum(dim=1).mean()) for weights in outputs["weights_list"]]
    assert float(losses["sky_loss"]) == pytest.approx(0.5 * sum(hit) / 3, rel=1e-4)
    assert "sky_loss" not in trained_step(build(sky_loss_mult=0.0))[1]


def test_the_surface_loss_is_the_field_colour_error_at_the_prior():
    model, given = build(surface_loss_mult=0.5), surface()
    _, losses = trained_step(model, given)
    where = torch.where(given["surface_sky"], 1e4, given["surface_distance_m"] / METRES_PER_UNIT)[:, 0]
    colours = colours_at(model, given["surface_rays"], where)
    expected = 0.5 * (colours - given["surface_image"]).square().mean()
    assert float(losses["surface_loss"]) == pytest.approx(float(expected), rel=1e-3)
    losses["surface_loss"].backward()
    assert are_taught(model.field.mlp_base.parameters())


def test_surface_pixels_that_do_not_count_change_no_loss():
    """On a GPU all of them are served, and which are of use; on the CPU these alone."""
    found = []
    for counts in (None, torch.tensor([True, False, True, True, False, True])[:, None]):
        model, given = build(surface_loss_mult=0.5), surface()
        if counts is None:
            chosen = torch.tensor([0, 2, 3, 5])
            given = {name: value[chosen] for name, value in given.items()}
        else:
            given["surface_counts"] = counts
        loss = trained_step(model, given)[1]["surface_loss"]
        loss.backward()
        found.append((loss.detach(), [each.grad for each in model.field.mlp_head.parameters()]))
    assert float(found[1][0]) == pytest.approx(float(found[0][0]), rel=1e-4) and found[0][0] > 0
    for one, other in zip(found[0][1], found[1][1], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-6)
    nowhere = surface() | {"surface_counts": torch.zeros(6, 1, dtype=torch.bool)}
    loss = trained_step(model, nowhere)[1]["surface_loss"]
    assert float(loss.detach()) == 0 and loss.requires_grad


def test_losses_of_final_samples_alone():
    """Rays whose samples are known have no proposals."""
    model = build(sky_loss_mult=0.5).train()
    propose, supervision = model.proposal_sampler.forward, batch()
    model.proposal_sampler.forward = lambda *given, **more: (propose(*given, **more)[0], [], [])
    outputs = model(rays(), supervision)
    (weights,) = outputs["weights_list"]
    step = Step(outputs, supervision, model.planes, 0.0, 1.0)
    hit = weights[supervision["sky"][:, 0]].sum(dim=1).mean()
    assert float(model.step_losses["sky_loss"](step)) == pytest.approx(0.5 * float(hit), rel=1e-4)
    assert float(model.step_losses["edge_loss"](step)) > 0


def test_the_surface_is_drawn_between_the_planes():
    planes = Planes(0.2, 50.0, METRES_PER_UNIT)
    count = 4000
    near, far = torch.full((count, 1), 0.25), torch.full((count, 1), 49.0)
    given = {"surface_distance_m": torch.cat([near, far]), "surface_sigma_m": torch.cat([0.1 + 0 * near, 4 + 0 * far])}
    torch.manual_seed(0)
    drawn_m = draw_surface_m(given, planes)
    assert 0.2 <= float(drawn_m.min()) and float(drawn_m.max()) <= 50
    close, distant = drawn_m.split(count)
    # it does not pile up at the planes: a tenth of the Gaussian beyond one sigma to the inside is a sixth now
    assert float((close == 0.2).float().mean()) < 0.01 and float((distant == 50).float().mean()) < 0.01
    assert float((close > 0.35).float().mean()) == pytest.approx(2 * 0.1587, abs=0.03)
    assert float((distant < 45).float().mean()) == pytest.approx(2 * 0.1587, abs=0.03)
    # between them it is the Gaussian
    given = {"surface_distance_m": torch.full((count, 1), 20.0), "surface_sigma_m": torch.full((count, 1), 2.0)}
    drawn_m = draw_surface_m(given, planes)
    assert float(drawn_m.mean()) == pytest.approx(20, abs=0.15)
    assert float(drawn_m.std()) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize("distance_m", [0.1, 60.0])
def test_a_surface_that_is_not_between_the_planes_says_nothing(distance_m):
    model, given = build(near_m=0.2, far_m=50.0), surface()
    given["surface_distance_m"][0] = distance_m
    losses = []
    # another pixel's colour does matter
    for pixel, colour in ((0, 0.0), (0, 1.0), (1, 1 - given["surface_image"][1].round())):
        given["surface_image"][pixel] = colour
        losses.append(float(trained_step(model, given)[1]["surface_loss"].detach()))
    assert losses[0] == pytest.approx(losses[1], rel=1e-5) and losses[0] > 0
    assert losses[2] != pytest.approx(losses[0], rel=1e-3)


@pytest.mark.parametrize("kind", LOSSES)
@pytest.mark.parametrize("distance_m", [0.199, 51.0])
def test_a_prior_that_is_not_between_the_planes_is_none(kind, distance_m):
    model, name = build(depth_loss=kind, near_m=0.2, far_m=50.0), LOSSES[kind]
    outputs, _ = trained_step(model)
    found = []
    for value in (0.0, distance_m):
        supervision = batch()
        supervision["prior_distance_m"][1] = value
        metrics = model.get_metrics_dict(outputs, supervision)
        losses = model.get_loss_dict(outputs, supervision, metrics)
        assert torch.isfinite(losses[name])
        found.append((float(losses[name]), float(metrics["share_with_prior"])))
    assert found[0] == found[1] and found[0][1] == 11 / 16
    # what is just inside counts
    supervision = batch()
    supervision["prior_distance_m"][1] = 0.2 if distance_m < 1 else 50.0
    assert float(model.get_metrics_dict(outputs, supervision)["share_with_prior"]) == 12 / 16


def test_distance_is_that_of_what_a_ray_hits():
    """A ray that is half sky is as far as what the other half hits; one that hits nothing is far."""
    starts = torch.arange(4.0)[None, :, None].expand(3, -1, -1)
    zero = torch.zeros(3, 4, 3)
    samples = RaySamples(
        frustums=Frustums(origins=zero, directions=zero, starts=starts, ends=starts + 1, pixel_area=starts)
    )
    weights = torch.tensor([[0.0, 0.3, 0.0, 0.0], [0.0, 0.0, 0.8, 0.2], [0.01, 0.0, 0.0, 0.0]])[..., None]
    renderer = MedianDepth().eval()
    assert renderer(weights, samples)[:, 0].tolist() == [1.5, 2.5, 3.5]


def evaluated_view(height=24, width=20):
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


def test_views_are_evaluated_inside_the_mask(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    model, outputs, truth = evaluated_view()
    metrics, images = model.get_image_metrics_and_images(outputs, truth)
    assert set(metrics) == {*("psnr", "ssim", "masked_psnr", "masked_ssim", "truth_masked_psnr", "truth_masked_ssim")}
    inside = ((outputs["rgb"] - truth["image"])[:, 4:] ** 2).mean()
    assert metrics["masked_psnr"] == pytest.approx(-10 * math.log10(inside), abs=1e-4)
    assert metrics["truth_masked_ssim"] == pytest.approx(1)
    assert images["distance"].shape == (24, 20, 3)
    # |d - 1.25 d| / 1.25 d = 0.2, and |d - 2 d| / 2 d = 0.5 at every pixel
    pooled = model.evaluation.pooled()
    assert pooled["lidar_abs_rel"] == pytest.approx(0.2, abs=1e-5)
    assert pooled["truth_abs_rel"] == pytest.approx(0.5, abs=1e-5)
    assert pooled["truth_pixels"] == 24 * 16
    truth["mask"][:, 4:] = False
    truth["mask"][:, :4] = True
    truth["lidar_distance_m"] = outputs["depth"] * METRES_PER_UNIT
    model.get_image_metrics_and_images({**outputs}, {**truth, "mask": torch.ones_like(truth["mask"])})
    # 384 pixels of 0.2 and 480 of 0: pooled over pixels 384 · 0.2 / 864, not (0.2 + 0) / 2
    assert model.evaluation.pooled()["lidar_abs_rel"] == pytest.approx(384 * 0.2 / 864, abs=1e-5)
    model.evaluation.reset()
    assert model.evaluation.pooled() == {}


def test_lpips_is_used_where_its_weights_are(monkeypatch):
    model, outputs, truth = evaluated_view()
    monkeypatch.setattr("edge_depth_nerf.plugin.evaluation.load_lpips", lambda: _MeanDifference())
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
    ours = build(exposure="embedding")
    with lpips_not_built():
        host = NerfactoModel(config=ours.config, scene_box=ours.scene_box, num_train_data=3)
    shapes = [{name: value.shape for name, value in model.state_dict().items()} for model in (ours, host)]
    assert shapes[0] == shapes[1]
    host.load_state_dict(ours.state_dict())


@pytest.mark.parametrize("loss", LOSSES)
def test_levels_that_do_not_learn_are_left_out_and_the_others_pull_as_before(loss):
    """nerfstudio lets its proposal networks rest in most steps; their levels would give a number, and no gradient.

    nerfstudio's form of UrbanNeRF's loss has the final samples' expected distance in them, too.
    """
    for rests in (False, True):
        model = build(depth_loss=loss, depth_loss_mult=1.0).train()
        if rests:
            model.proposal_sampler._step, model.proposal_sampler._steps_since_update = 1000, 1
        outputs, losses = trained_step(model)
        assert [weights.requires_grad for weights in outputs["weights_list"]] == [not rests] * 2 + [True]
        levels = levels_of(outputs)
        object_of = model.step_losses[LOSSES[loss]].loss  # pyrefly: ignore[missing-attribute]
        counted = 16 if object_of.over_all_rays else 12
        used = levels[-1:] if rests and loss != "urban-nerf" else levels
        found = [object_of(replace(level, final=levels[-1])).sum() / counted for level in used]
        assert float(losses[LOSSES[loss]]) == pytest.approx(float(sum(found)) / 3, rel=1e-5)


def test_sigma_of_ds_nerf_is_a_standard_deviation_in_metres():
    """One sample a ray, one sigma from the prior: it is pulled exp(-1/2) as hard as one at the prior."""
    pulls = []
    for midpoint_m in (5.0, 5.3):
        starts_m, ends_m = (torch.full((1, 1), midpoint_m + half) for half in (-0.05, 0.05))
        level = Level(torch.full((1, 1), 0.5), starts_m, ends_m, torch.tensor([5.0]), torch.tensor([9.0]))
        pulls.append(float(DsNerfLoss(sigma_m=0.3)(level)))
    assert pulls[1] / pulls[0] == pytest.approx(math.exp(-0.5), rel=1e-4)


def test_no_download_and_no_lpips_in_the_checkpoint(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", lambda *_, **__: pytest.fail("downloads"))
    model = build()
    assert not [name for name in model.state_dict() if "lpips" in name]
    assert math.isnan(model.lpips(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 8)))
