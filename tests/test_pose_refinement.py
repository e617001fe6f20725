"""Poses that training mends: shared by a moment, in metres, without drift; and those of judged pictures."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Literal

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle

from edge_depth_nerf.plugin.pipeline import JudgedViews
from edge_depth_nerf.plugin.pose_refinement import PoseRefiner, PoseRefinerConfig, fit_pose, halves

METRES_PER_UNIT = 4.0
CONFIG = PoseRefinerConfig(mode="SO3xR3", sigma_m=0.05, sigma_deg=0.2, prior_mult=0.5)


def refiner(moments=(7, 7, 9, 9)) -> PoseRefiner:
    found = PoseRefiner(CONFIG, len(moments), "cpu")
    found.settle(list(moments), METRES_PER_UNIT)
    return found


def bundle(pictures) -> RayBundle:
    count = len(pictures)
    return RayBundle(
        origins=torch.zeros(count, 3),
        directions=torch.tensor([[1.0, 0.0, 0.0]]).repeat(count, 1),
        pixel_area=torch.ones(count, 1),
        camera_indices=torch.tensor(pictures)[:, None],
    )


def test_the_pictures_of_a_moment_move_together_by_metres_and_degrees():
    found = refiner()
    assert found.pose_adjustment.shape == (2, 6)
    with torch.no_grad():
        # one standard deviation up and a turn about z, once each way
        found.pose_adjustment[:] = torch.tensor([[0, 0, 1.0, 0, 0, 1.0], [0, 0, -1.0, 0, 0, -1.0]])
    rays = bundle([0, 1, 2, 3])
    found.apply_to_raybundle(rays)
    up = 0.05 / METRES_PER_UNIT
    torch.testing.assert_close(rays.origins[:, 2], torch.tensor([up, up, -up, -up]))
    turned = torch.rad2deg(torch.atan2(rays.directions[:, 1], rays.directions[:, 0]))
    torch.testing.assert_close(turned, torch.tensor([0.2, 0.2, -0.2, -0.2]))
    metrics: dict[str, torch.Tensor] = {}
    found.get_metrics_dict(metrics)
    assert metrics["camera_opt_translation_max"] == pytest.approx(0.05)
    assert metrics["camera_opt_rotation_mean"] == pytest.approx(0.2)


def test_the_drive_as_a_whole_stays():
    found = refiner()
    with torch.no_grad():
        found.pose_adjustment[:] = 3.0
    rays = bundle([0, 2])
    found.apply_to_raybundle(rays)
    assert torch.equal(rays.origins, torch.zeros(2, 3))
    torch.testing.assert_close(rays.directions, bundle([0, 2]).directions)


def test_without_refinement_nothing_moves_and_nothing_is_learned():
    found = PoseRefiner(PoseRefinerConfig(), 3, "cpu")
    found.settle([1, 1, 2], METRES_PER_UNIT)
    assert list(found.parameters()) == []
    # as nerfstudio's viewer asks for the poses to show
    torch.testing.assert_close(found(torch.arange(3)), torch.eye(4)[None, :3].tile(3, 1, 1))
    rays = bundle([0, 2])
    found.apply_to_raybundle(rays)
    assert torch.equal(rays.origins, torch.zeros(2, 3))


def test_adjustments_cost_their_square_in_standard_deviations():
    found = refiner()
    with torch.no_grad():
        found.pose_adjustment[0, 0] = 2.0
    losses: dict[str, torch.Tensor] = {}
    found.get_loss_dict(losses)
    assert float(losses["camera_opt_regularizer"].detach()) == pytest.approx(0.5 * 4 / 12)
    off: dict[str, torch.Tensor] = {}
    PoseRefiner(PoseRefinerConfig(), 3, "cpu").get_loss_dict(off)
    assert off == {}


class PaintedWall(torch.nn.Module):
    """A wall at x = 8 units, painted in waves; what a model would render of it."""

    device, metres_per_unit = torch.device("cpu"), METRES_PER_UNIT

    def __init__(self) -> None:
        super().__init__()
        self.brightness = torch.nn.Parameter(torch.ones(()))
        self.asked_for_gradients = 0

    def forward(self, rays: RayBundle) -> dict[str, torch.Tensor]:
        at = rays.origins + rays.directions * ((8 - rays.origins[:, :1]) / rays.directions[:, :1])
        y, z = at[:, 1], at[:, 2]
        waves = [torch.sin(3 * y + z), torch.sin(2 * z - y), torch.cos(4 * y) * torch.sin(3 * z)]
        self.asked_for_gradients += self.brightness.requires_grad and rays.origins.requires_grad
        return {"rgb": self.brightness * (0.5 + 0.4 * torch.stack(waves, dim=-1))}


def camera(pose: torch.Tensor) -> Cameras:
    return Cameras(pose[None, :3], fx=60.0, fy=60.0, cx=40.0, cy=30.0, width=80, height=60)


def looking_along_x(position, yaw_deg: float) -> torch.Tensor:
    yaw = math.radians(yaw_deg)
    ahead = torch.tensor([math.cos(yaw), math.sin(yaw), 0.0])
    up = torch.tensor([0.0, 0.0, 1.0])
    right = torch.linalg.cross(ahead, up)
    pose = torch.eye(4)
    pose[:3] = torch.stack([right, up, -ahead, torch.tensor(position)], dim=1)
    return pose


def fits_a_pictures_pose(device: str) -> None:
    """The picture is on the CPU, as nerfstudio's loader leaves it."""
    true, given = looking_along_x([0.0, 0.0, 0.0], 0.0), looking_along_x([0.0, 0.01, -0.008], 0.15)
    model = PaintedWall()
    picture = 0.9 * model(camera(true).generate_rays(0).flatten())["rgb"].detach().view(60, 80, 3)
    mask = torch.ones(60, 80, dtype=torch.bool)
    mask[:, 60:] = False
    config = PoseRefinerConfig(mode="SO3xR3", sigma_m=0.05, sigma_deg=0.2, prior_mult=1e-6)
    before = camera(given)
    model.device, mask = torch.device(device), mask.to(device)
    fitted = fit_pose(model, before, picture, mask, config)
    assert torch.equal(before.camera_to_worlds[0], given[:3])

    def wrong_by(found: Cameras) -> float:
        shown = 0.9 * model(found.generate_rays(0).flatten())["rgb"].view(60, 80, 3)
        return float((shown - picture)[:, 60:].square().mean().sqrt())

    assert wrong_by(fitted) < 0.15 * wrong_by(before)
    # a hash table would keep what gives its gradient, for an optimiser
    assert not model.asked_for_gradients and model.brightness.requires_grad and model.brightness.grad is None
    # all but the given pose is forgotten where it costs more than it gains
    strict = fit_pose(model, before, picture, mask, PoseRefinerConfig(mode="SO3xR3", sigma_m=0.05, prior_mult=1e6))
    torch.testing.assert_close(strict.camera_to_worlds, before.camera_to_worlds, atol=2e-3, rtol=0)


def test_a_pictures_pose_is_found_again_also_when_its_exposure_differs():
    fits_a_pictures_pose("cpu")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_pictures_pose_is_found_again_on_a_gpu():
    fits_a_pictures_pose("cuda")


def test_halves_are_columns_with_as_many_pixels():
    mask = torch.ones(10, 30, 1, dtype=torch.bool)
    mask[:, :10] = False
    left, right = halves(mask)
    assert not (left & right).any() and bool(((left | right) == mask).all())
    assert int(left.sum()) == int(right.sum()) == 100
    assert left[:, 10:20].all() and right[:, 20:].all()


def test_judged_pictures_are_fitted_on_the_left_and_judged_on_the_right(monkeypatch):
    fitted_on = []

    def fit(model, camera, image, mask, config):
        fitted_on.append(mask)
        return "fitted"

    monkeypatch.setattr("edge_depth_nerf.plugin.pipeline.fit_pose", fit)
    from edge_depth_nerf.plugin.model import EdgeDepthNerfModelConfig
    from edge_depth_nerf.plugin.pipeline import EdgeDepthPipelineConfig

    mask = torch.ones(12, 20, 1, dtype=torch.bool)
    batch = {"image": torch.rand(12, 20, 3), "mask": mask}
    cases: list[tuple[Literal["given", "refined"], str]] = [("given", "given camera"), ("refined", "fitted")]
    for poses, expected in cases:
        pipeline = SimpleNamespace(
            config=EdgeDepthPipelineConfig(eval_poses=poses), model=SimpleNamespace(config=EdgeDepthNerfModelConfig())
        )
        views = JudgedViews(pipeline, [("given camera", batch)])
        assert len(views) == 1
        ((found, judged),) = views
        assert found == expected
        assert int(judged["mask"].sum()) == (mask.numel() if poses == "given" else mask.numel() // 2)
    assert len(fitted_on) == 1 and fitted_on[0][:, :10].all() and not fitted_on[0][:, 10:].any()
