"""Camera poses that training corrects; a cost keeps them near the given ones.

Host-facing: nerfstudio's camera optimiser in other units. Its own learns scene units and radians for each picture, and
hardly anything holds them. Here an adjustment is the vehicle's, shared by the pictures of a frame, in standard
deviations that are expected of the given poses. The drive's mean adjustment is kept at zero: it would move the scene,
not correct it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

FRAMES = "frames"
"""Metadata of the training dataset: the number of each picture's frame."""
PRIOR_MULT = 1e-4
"""Weight of the mean square of the adjustments, in the standard deviations that are expected."""


@dataclass
class PoseRefinerConfig(CameraOptimizerConfig):
    """Whether and how far training may move the poses."""

    _target: type = field(default_factory=lambda: PoseRefiner)
    """Target class to instantiate."""
    mode: Literal["off", "SO3xR3"] = "off"  # pyrefly: ignore
    """SO3xR3: training refines the poses, except those of held-out pictures. off: no pose is refined."""
    sigma_m: float = 0.03
    """Expected error of the given positions: standard deviation in metres."""
    sigma_deg: float = 0.1
    """Expected error of the given rotations: standard deviation in degrees."""


class PoseRefiner(CameraOptimizer):
    """Adjusts the vehicle's pose at each frame."""

    config: PoseRefinerConfig
    frame: Int[Tensor, "pictures"]
    sigmas: Float[Tensor, "6"]
    """What one means of an adjustment: scene units of translation, radians of rotation."""

    def __init__(self, config: PoseRefinerConfig, num_cameras: int, device: torch.device | str, **kwargs: Any) -> None:
        super().__init__(config, num_cameras, device, **kwargs)
        self.register_buffer("frame", torch.arange(num_cameras), persistent=False)
        self.register_buffer("sigmas", _sigmas(config, 1.0, torch.empty(0)), persistent=False)

    def settle(self, frames: list[int], metres_per_unit: float) -> None:
        """Set which pictures share a frame and how long the scene's unit is; before any step."""
        _, frame = torch.unique(torch.tensor(frames), return_inverse=True)
        self.frame = frame.to(self.frame)
        self.sigmas = _sigmas(self.config, metres_per_unit, self.sigmas)
        if self.config.mode != "off":
            rows = self.pose_adjustment.new_zeros(int(frame.max()) + 1, 6)
            self.pose_adjustment = torch.nn.Parameter(rows)

    def forward(self, indices: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3 4"]:
        """Give the correction of the rays of pictures, in the world: a turn about the camera, and a shift."""
        if self.config.mode == "off":
            # the viewer asks also then
            return super().forward(indices)
        centred = self.pose_adjustment - self.pose_adjustment.mean(dim=0)
        return exp_map_SO3xR3(centred * self.sigmas)[self.frame[indices]]

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Move rays, in place."""
        if self.config.mode != "off":
            assert raybundle.camera_indices is not None
            correction = self(raybundle.camera_indices[:, 0])
            raybundle.origins = raybundle.origins + correction[:, :3, 3]
            # a product of matrices would be one of half precision
            raybundle.directions = (correction[:, :3, :3] * raybundle.directions[:, None]).sum(-1)

    def get_loss_dict(self, loss_dict: dict[str, Any]) -> None:
        """Add what the adjustments cost."""
        if self.config.mode != "off":
            loss_dict["camera_opt_regularizer"] = PRIOR_MULT * self.pose_adjustment.square().mean()

    def get_metrics_dict(self, metrics_dict: dict[str, Any]) -> None:
        """Add how far the poses have moved: metres and degrees."""
        if self.config.mode != "off":
            moved = (self.pose_adjustment - self.pose_adjustment.mean(dim=0)).detach()
            for name, values, unit in (
                ("translation", moved[:, :3], self.config.sigma_m),
                ("rotation", moved[:, 3:], self.config.sigma_deg),
            ):
                lengths = values.norm(dim=-1) * unit
                metrics_dict[f"camera_opt_{name}_max"] = lengths.max()
                metrics_dict[f"camera_opt_{name}_mean"] = lengths.mean()


def without_gradient_to_positions(density_fn: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Give a proposal network's density with no gradient to where it is asked for."""
    return lambda positions, *args, **kwargs: density_fn(positions.detach(), *args, **kwargs)


def _sigmas(config: PoseRefinerConfig, metres_per_unit: float, like: Tensor) -> Float[Tensor, "6"]:
    length, angle = config.sigma_m / metres_per_unit, math.radians(config.sigma_deg)
    return like.new_tensor([length] * 3 + [angle] * 3)


def moved_pose(
    poses: Float[Tensor, "pictures 3 4"], correction: Float[Tensor, "*pictures 3 4"]
) -> Float[Tensor, "pictures 3 4"]:
    """Correct camera poses as their rays: turn about each camera, and shift, both in the world."""
    turned = correction[..., :3] @ poses[..., :3]
    return torch.cat([turned, poses[..., 3:] + correction[..., 3:]], dim=-1)
