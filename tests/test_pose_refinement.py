"""Poses that training mends: shared by a frame, in metres, without drift."""

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle

from edge_depth_nerf.plugin.pose_refinement import PoseRefiner, PoseRefinerConfig

METRES_PER_UNIT = 4.0
CONFIG = PoseRefinerConfig(mode="SO3xR3", sigma_m=0.05, sigma_deg=0.2)


def refiner(frames=(7, 7, 9, 9)) -> PoseRefiner:
    found = PoseRefiner(CONFIG, len(frames), "cpu")
    found.settle(list(frames), METRES_PER_UNIT)
    return found


def bundle(pictures) -> RayBundle:
    count = len(pictures)
    return RayBundle(
        origins=torch.zeros(count, 3),
        directions=torch.tensor([[1.0, 0.0, 0.0]]).repeat(count, 1),
        pixel_area=torch.ones(count, 1),
        camera_indices=torch.tensor(pictures)[:, None],
    )


def test_the_pictures_of_a_frame_move_together_by_metres_and_degrees():
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
    assert float(losses["camera_opt_regularizer"].detach()) == pytest.approx(1e-4 * 4 / 12)
    off: dict[str, torch.Tensor] = {}
    PoseRefiner(PoseRefinerConfig(), 3, "cpu").get_loss_dict(off)
    assert off == {}
