"""The vehicle's path: poses at some times, and between them the screw motion from one to the next.

Frames: vehicle (as the recording has it) and world; transforms are 4×4, float64, metres; times are seconds of one
clock. Between two poses the vehicle is taken to turn and advance evenly: T(s) = T0 · exp(s · log(T0⁻¹·T1)), the
geodesic of SE(3), 0 <= s <= 1. So a missing pose is bridged. Before the first and after the last pose, the nearest
motion continues.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.transforms import rigid

MAX_POSE_GAP_S = 1.0
"""Between poses further apart than this the path is not known well enough to place pictures or points."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of a vehicle over time.

    Raises:
        InputError: fewer than two poses, or times that do not increase.
    """

    times_s: Float64[np.ndarray, "poses"]
    """Increasing."""
    vehicle_to_world: Float64[np.ndarray, "poses 4 4"]

    def __post_init__(self) -> None:
        check_times(self.times_s)

    @cached_property
    def _screws(self) -> tuple[Tensor, Tensor, Tensor]:
        """Each interval's motion: in the frame of its first pose, a point p goes to p + A(s)·p + B(s)·v.

        Unit axes of rotation (n×3; anything where nothing turns), angles (n×1, radians) and v (n×3, metres), which is
        the translation's part of log(T0⁻¹·T1).
        """
        rotation, position = self.vehicle_to_world[:, :3, :3], self.vehicle_to_world[:, :3, 3]
        turn = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
        shift = np.einsum("nji,nj->ni", rotation[:-1], np.diff(position, axis=0))
        vector = Rotation.from_matrix(turn).as_rotvec()
        angle = np.linalg.norm(vector, axis=-1)
        axis = vector / np.where(angle > 0, angle, 1)[:, None]
        # V⁻¹ = 1 - K·θ/2 + (1 - θ/2·cot(θ/2))·K², K the cross product with the axis
        half = angle / 2
        cotangent = np.where(angle > 1e-6, half / np.tan(np.where(angle > 1e-6, half, 1)), 1 - half**2 / 3)
        once = np.cross(axis, shift)
        velocity = shift - half[:, None] * once + (1 - cotangent)[:, None] * np.cross(axis, once)
        return torch.from_numpy(axis), torch.from_numpy(angle[:, None]), torch.from_numpy(velocity)

    def gap_s(self, time_s: float) -> float:
        """How far apart the two poses around a time are; beyond the ends, infinite."""
        after = int(np.searchsorted(self.times_s, time_s, side="left"))
        if after < len(self.times_s) and self.times_s[after] == time_s:
            return 0.0
        if after in (0, len(self.times_s)):
            return float("inf")
        return float(self.times_s[after] - self.times_s[after - 1])

    def outside_s(self, time_s: float) -> float:
        """How far a time lies before the first or after the last pose; 0 between them."""
        return float(max(self.times_s[0] - time_s, time_s - self.times_s[-1], 0.0))

    def at(self, times_s: Float64[np.ndarray, "times"]) -> Float64[np.ndarray, "times 4 4"]:
        """The vehicle's poses at some times, vehicle to world."""
        corners = np.concatenate((np.zeros((1, 3)), np.eye(3)))
        stacked = torch.from_numpy(np.tile(corners, (len(times_s), 1)))
        moved = self.to_world(stacked, torch.from_numpy(np.repeat(times_s, 4))).numpy().reshape(-1, 4, 3)
        poses = rigid(np.swapaxes(moved[:, 1:] - moved[:, :1], 1, 2), moved[:, 0])
        # a pose that is given is given exactly
        known = np.searchsorted(self.times_s, times_s).clip(max=len(self.times_s) - 1)
        same = self.times_s[known] == times_s
        poses[same] = self.vehicle_to_world[known[same]]
        return poses

    def to_world(
        self, points_in_vehicle: Float[Tensor, "points 3"], times_s: Float[Tensor, "points"]
    ) -> Float[Tensor, "points 3"]:
        """Express points in the world, each by the vehicle's pose at its own time; float64."""
        times = times_s.to(torch.float64)
        known = torch.from_numpy(np.ascontiguousarray(self.times_s))
        index = (torch.searchsorted(known, times, right=True) - 1).clamp(0, len(known) - 2)
        # how far along the interval, less than 0 or more than 1 beyond the ends
        along = ((times - known[index]) / (known[index + 1] - known[index]))[:, None]
        axis, angle, velocity = (part[index] for part in self._screws)
        points, angle, velocity = points_in_vehicle.to(torch.float64), along * angle, along * velocity
        small = angle.abs() < 1e-6
        safe = torch.where(small, torch.ones_like(angle), angle)
        # Rodrigues' formula, and the integral of it for the translation
        sine, cosine = torch.sin(angle), 1 - torch.cos(angle)
        first = torch.where(small, angle / 2, (1 - torch.cos(safe)) / safe)
        second = torch.where(small, angle.square() / 6, 1 - torch.sin(safe) / safe)
        turned = torch.linalg.cross(axis, points)
        driven = torch.linalg.cross(axis, velocity)
        moved = points + sine * turned + cosine * torch.linalg.cross(axis, turned)
        moved = moved + velocity + first * driven + second * torch.linalg.cross(axis, driven)
        start = torch.from_numpy(self.vehicle_to_world)
        rotation, position = start[:, :3, :3][index], start[:, :3, 3][index]
        return (rotation @ moved[:, :, None]).squeeze(-1) + position


def check_times(times_s: Float64[np.ndarray, "poses"], of: str = "pose") -> None:
    """Raise an InputError unless there are two times or more, and they increase."""
    if len(times_s) < 2:
        raise InputError(f"a path needs at least two {of}s for the vehicle's motion, found {len(times_s)}.")
    if not (np.diff(times_s) > 0).all():
        first = int(np.argmax(~(np.diff(times_s) > 0)))
        raise InputError(
            f"the times of a path must increase, but {of} {first + 2} is of {times_s[first + 1]:.6f} s, the one before "
            f"of {times_s[first]:.6f} s."
        )
