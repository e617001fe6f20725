"""Camera poses that training corrects; a cost keeps them near the given ones.

Host-facing: nerfstudio's camera optimiser in other units. Its own learns scene units and radians for each picture, at
the fields' learning rate and with next to nothing that holds them. Here an adjustment is the vehicle's, shared by the
pictures of a frame. Its unit is the standard deviation that is expected of the given poses, and each frame pays for its
adjustment. The drive's mean adjustment is kept at zero: it would move the scene, not correct it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Bool, Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.lie_groups import exp_map_SO3xR3
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

MOMENTS = "moments"
"""Metadata of the training dataset: the number of each picture's frame."""
FIT_STEPS, FIT_RAYS, FIT_LEARNING_RATE = 150, 1024, 0.05
"""How the pose of a held-out picture is fitted."""
_FIT_PIXELS = 32_768


@dataclass
class PoseRefinerConfig(CameraOptimizerConfig):
    """Whether and how far training may move the poses."""

    _target: type = field(default_factory=lambda: PoseRefiner)
    """Target class to instantiate."""
    mode: Literal["off", "SO3xR3"] = "off"  # pyright: ignore[reportIncompatibleVariableOverride]
    """SO3xR3: poses are refined in training, except those of held-out pictures. off: no pose is refined."""
    sigma_m: float = 0.03
    """Expected error of the given positions: standard deviation in metres."""
    sigma_deg: float = 0.1
    """Expected error of the given rotations: standard deviation in degrees."""
    prior_mult: tyro.conf.Suppress[float] = 1e-4
    """Weight of the mean square of the adjustments, in these standard deviations."""


class PoseRefiner(CameraOptimizer):
    """Adjusts the vehicle's pose at each frame."""

    config: PoseRefinerConfig
    moment: Int[Tensor, "pictures"]
    sigmas: Float[Tensor, "6"]
    """What one means of an adjustment: scene units of translation, radians of rotation."""

    def __init__(self, config: PoseRefinerConfig, num_cameras: int, device: torch.device | str, **kwargs: Any) -> None:
        super().__init__(config, num_cameras, device, **kwargs)
        self.register_buffer("moment", torch.arange(num_cameras), persistent=False)
        self.register_buffer("sigmas", _sigmas(config, 1.0, torch.empty(0)), persistent=False)

    def settle(self, moments: list[int], metres_per_unit: float) -> None:
        """Set which pictures share a frame and how long the scene's unit is; before any step."""
        _, moment = torch.unique(torch.tensor(moments), return_inverse=True)
        self.moment = moment.to(self.moment)
        self.sigmas = _sigmas(self.config, metres_per_unit, self.sigmas)
        if self.config.mode != "off":
            rows = self.pose_adjustment.new_zeros(int(moment.max()) + 1, 6)
            self.pose_adjustment = torch.nn.Parameter(rows)

    def forward(self, indices: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3 4"]:
        """What is to be done to the rays of pictures, in the world: a turn about the camera, and a shift."""
        if self.config.mode == "off":
            # the viewer asks also then
            return super().forward(indices)
        centred = self.pose_adjustment - self.pose_adjustment.mean(dim=0)
        return exp_map_SO3xR3(centred * self.sigmas)[self.moment[indices]]

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Move rays, in place."""
        if self.config.mode != "off":
            assert raybundle.camera_indices is not None
            _move(raybundle, self(raybundle.camera_indices[:, 0]))

    def get_loss_dict(self, loss_dict: dict[str, Any]) -> None:
        """Add what the adjustments cost."""
        if self.config.mode != "off":
            loss_dict["camera_opt_regularizer"] = self.config.prior_mult * self.pose_adjustment.square().mean()

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


def _sigmas(config: PoseRefinerConfig, metres_per_unit: float, like: Tensor) -> Float[Tensor, "6"]:
    length, angle = config.sigma_m / metres_per_unit, math.radians(config.sigma_deg)
    return like.new_tensor([length] * 3 + [angle] * 3)


def _move(rays: RayBundle, correction: Float[Tensor, "rays 3 4"]) -> None:
    rays.origins = rays.origins + correction[:, :3, 3]
    rays.directions = (correction[:, :3, :3] @ rays.directions[..., None])[..., 0]


def fit_pose(
    model: Any, camera: Cameras, image: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"], config: PoseRefinerConfig
) -> Cameras:
    """Fit the pose of a picture to what a model shows, with a cost for leaving the given pose.

    Args:
        model: an EdgeDepthNerfModel in evaluation; nothing of it is changed.
        camera: the picture's, one.
        image: its colours, 0 to 1.
        mask: which pixels count.
        config: the expected errors and their weight.

    Returns:
        A camera with the pose that fits best. A gain for each colour is fitted beside it, and forgotten.

    """
    # nerfstudio's loader leaves the picture on the CPU, and puts all else on the model's device
    at = mask.nonzero().to(image.device)
    generator = torch.Generator().manual_seed(0)
    at = at[torch.randperm(len(at), generator=generator)[:_FIT_PIXELS]]
    target = image[at[:, 0], at[:, 1]].to(model.device)
    rays = camera.to(model.device).generate_rays(torch.zeros(len(at), 1, dtype=torch.long), at + 0.5)
    adjustment = torch.nn.Parameter(torch.zeros(1, 6, device=model.device))
    sigmas = _sigmas(config, model.metres_per_unit, adjustment)
    log_gains = torch.nn.Parameter(torch.zeros(3, device=model.device))
    optimizer = torch.optim.Adam([adjustment, log_gains], FIT_LEARNING_RATE)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, FIT_STEPS)
    with torch.enable_grad(), _constant(model):
        for _ in range(FIT_STEPS):
            chosen = torch.randint(len(at), (min(FIT_RAYS, len(at)),), generator=generator)
            part = rays[chosen]
            correction = exp_map_SO3xR3(adjustment * sigmas)
            _move(part, correction.expand(len(chosen), 3, 4))
            colours = model(part)["rgb"] * log_gains.exp()
            loss = (colours - target[chosen]).square().mean()
            loss = loss + config.prior_mult * adjustment.square().mean()
            gradients = torch.autograd.grad(loss, [adjustment, log_gains])
            adjustment.grad, log_gains.grad = gradients
            optimizer.step()
            scheduler.step()
    with torch.no_grad():
        correction = exp_map_SO3xR3(adjustment * sigmas)[0].to(camera.camera_to_worlds)
    found = camera[:]
    found.camera_to_worlds = moved_pose(camera.camera_to_worlds, correction)
    return found


@contextmanager
def _constant(model: torch.nn.Module) -> Iterator[None]:
    """Let no parameter of a model ask for a gradient: hash tables on the CPU would keep what gives theirs."""
    learning = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learning:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learning:
            parameter.requires_grad_(True)


def moved_pose(
    poses: Float[Tensor, "pictures 3 4"], correction: Float[Tensor, "*pictures 3 4"]
) -> Float[Tensor, "pictures 3 4"]:
    """Camera poses after a correction of their rays: a turn about each camera, and a shift, both in the world."""
    turned = correction[..., :3] @ poses[..., :3]
    return torch.cat([turned, poses[..., 3:] + correction[..., 3:]], dim=-1)


def halves(mask: Bool[Tensor, "h w 1"]) -> tuple[Bool[Tensor, "h w 1"], Bool[Tensor, "h w 1"]]:
    """Split a mask into its left and its right half: as many pixels of use in both, whole columns each."""
    columns = mask[..., 0].sum(dim=0).cumsum(dim=0)
    left = (columns <= columns[-1] // 2)[None, :, None]
    return mask & left, mask & ~left
