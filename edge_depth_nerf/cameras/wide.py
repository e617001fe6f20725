"""Lens models of calibration tools beside OpenCV's: the double sphere, EUCM, and OCamCalib's polynomial.

Kalibr and Basalt write the first two, OCamCalib the third. Conventions are those of `cameras.models`.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.distortion import first_positive_root
from edge_depth_nerf.cameras.models import MEI, Camera

_TABLE_SIZE = 4096
_NEWTON_STEPS = 7
_BEYOND_CORNER = 1.5
"""A polynomial is used up to so many times the distance of the picture's farthest corner: it was fitted within."""


@dataclass(frozen=True)
class _Unified(Camera):
    """A model that moves a ray and then projects it by the unified model: u = fx · x / (α·|ray| + (1 - α)·z)."""

    alpha: float
    """0 (a pinhole) up to, but not, 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.alpha < 1:
            raise InputError(f"{self.model} camera: alpha is {self.alpha}, expected 0 or more and less than 1.")

    @abstractmethod
    def _moved(self, points: Tensor) -> Tensor:
        """Rays to those that the unified model projects."""

    @abstractmethod
    def _back(self, rays: Tensor) -> Tensor:
        """Unit rays of the unified model to unit rays."""

    @cached_property
    def _mei(self) -> MEI:
        """The unified model with ξ = α / (1 - α), whose plane is smaller by `_shrinks`."""
        return MEI(self.width, self.height, 1.0, 1.0, 0.0, 0.0, self.alpha / (1.0 - self.alpha), 0.0, 0.0, 0.0, 0.0)

    @property
    def _shrinks(self) -> float:
        return 1.0 - self.alpha

    @cached_property
    def theta_max_rad(self) -> float:
        """Where the unified model ends for the moved ray, at most `theta_limit_rad`."""
        psi = self._mei.theta_max_rad
        rim = self._back(torch.tensor([math.sin(psi), 0.0, math.cos(psi)], dtype=torch.float64))
        return min(math.atan2(float(rim[0]), float(rim[2])), self.theta_limit_rad)

    @cached_property
    def _radius_max(self) -> float:
        rim = torch.tensor([math.sin(self.theta_max_rad), 0.0, math.cos(self.theta_max_rad)], dtype=torch.float64)
        plane, defined = self._to_plane(rim)
        return float(plane[0]) if defined and self.theta_max_rad < math.pi else math.inf

    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        plane, defined = self._mei._to_plane(self._moved(points))
        return plane / self._shrinks, defined

    def _from_plane(self, plane: Tensor) -> Tensor:
        return self._back(self._mei._from_plane(plane * self._shrinks))


@dataclass(frozen=True)
class DoubleSphere(_Unified):
    """The double-sphere model (Usenko, Demmel & Cremers, 3DV 2018, eq. 40-52); Kalibr's and Basalt's `ds`."""

    model: ClassVar[str] = "DOUBLE_SPHERE"

    xi: float
    """Shift between the spheres, in their radii; more than -1, at most 1."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not -1 < self.xi <= 1:
            raise InputError(f"{self.model} camera: xi is {self.xi}, expected more than -1 and at most 1.")

    def _moved(self, points: Tensor) -> Tensor:
        length = points.norm(dim=-1, keepdim=True)
        return torch.cat((points[..., :2], points[..., 2:] + self.xi * length), -1)

    def _back(self, rays: Tensor) -> Tensor:
        z = rays[..., 2:]
        root = (1.0 - self.xi**2 * (1.0 - z * z)).clamp_min(0.0).sqrt()
        moved = (self.xi * z + root) * rays
        return torch.cat((moved[..., :2], moved[..., 2:] - self.xi), -1)


@dataclass(frozen=True)
class EUCM(_Unified):
    """The extended unified model (Khomutenko, Garcia & Martinet, RA-L 2016, eq. 4-14); Kalibr's and Basalt's `eucm`."""

    model: ClassVar[str] = "EUCM"

    beta: float
    """Stretches x² + y²; more than 0, and 1 makes it the unified model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.beta > 0:
            raise InputError(f"{self.model} camera: beta is {self.beta}, expected more than 0.")

    @property
    def _shrinks(self) -> float:
        return (1.0 - self.alpha) * math.sqrt(self.beta)

    def _moved(self, points: Tensor) -> Tensor:
        return torch.cat((math.sqrt(self.beta) * points[..., :2], points[..., 2:]), -1)

    def _back(self, rays: Tensor) -> Tensor:
        moved = torch.cat((rays[..., :2] / math.sqrt(self.beta), rays[..., 2:]), -1)
        return moved / moved.norm(dim=-1, keepdim=True)


@dataclass(frozen=True)
class OCam(Camera):
    """OCamCalib's model (Scaramuzza, Martinelli & Siegwart, IROS 2006, eq. 2-4).

    A ray is (x, y, 1 + b1·ρ + b2·ρ² + …) with ρ² = x² + y², and its place in the plane is (x + shear_x·y, y +
    shear_y·x). Lengths are in units of the polynomial's value at 0.
    """

    model: ClassVar[str] = "OCAM"

    b1: float = 0.0
    b2: float = 0.0
    b3: float = 0.0
    b4: float = 0.0
    b5: float = 0.0
    b6: float = 0.0
    shear_x: float = 0.0
    shear_y: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.shear_x) + abs(self.shear_y) > 0.5:
            raise InputError(f"{self.model} camera: sheared by {self.shear_x}, {self.shear_y}; expected less than 0.5.")

    @cached_property
    def _coefficients(self) -> tuple[float, ...]:
        return (1.0, self.b1, self.b2, self.b3, self.b4, self.b5, self.b6)

    @cached_property
    def _reach(self) -> float:
        """The largest ρ: where the angle stops to grow with it, or well beyond the picture."""
        fold = first_positive_root([1.0, 0.0, *(-(k - 1) * b for k, b in enumerate(self._coefficients) if k > 1)])
        corner = math.hypot(max(self.cx, self.width - self.cx) / self.fx, max(self.cy, self.height - self.cy) / self.fy)
        return min(fold, _BEYOND_CORNER * corner)

    @cached_property
    def _table(self) -> tuple[np.ndarray, np.ndarray]:
        """Angles and radii, both rising."""
        rho = np.linspace(0.0, self._reach, _TABLE_SIZE)
        return np.arctan2(rho, np.polynomial.polynomial.polyval(rho, self._coefficients)), rho

    @cached_property
    def theta_max_rad(self) -> float:
        """The angle of the largest radius, at most `theta_limit_rad`."""
        return min(float(self._table[0][-1]), self.theta_limit_rad)

    @cached_property
    def _radius_max(self) -> float:
        # a disc around the sheared one; what is in it beyond the rim is taken out again
        return (
            float(np.interp(self.theta_max_rad, *self._table)) * (1.0 + abs(self.shear_x) + abs(self.shear_y)) * 1.001
        )

    def _z(self, rho: Tensor) -> tuple[Tensor, Tensor]:
        """The polynomial and its derivative."""
        value, slope = torch.zeros_like(rho), torch.zeros_like(rho)
        for b in reversed(self._coefficients):
            slope = slope * rho + value
            value = value * rho + b
        return value, slope

    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        z = points[..., 2:]
        square = (points[..., :2] * points[..., :2]).sum(-1, keepdim=True)
        on_axis = square == 0
        across = torch.where(on_axis, 1.0, square).sqrt()
        theta, smallest = torch.atan2(across, z), torch.finfo(z.dtype).eps
        rho = torch.from_numpy(np.interp(theta.double().cpu().numpy(), *self._table)).to(points)
        for _ in range(_NEWTON_STEPS):
            value, slope = self._z(rho)
            # its derivative is positive up to the rim
            rise = (z - across * slope).clamp_min(smallest)
            rho = (rho - (rho * z - across * value) / rise).clamp(0.0, self._reach)
        factor = torch.where(on_axis, 1.0 / torch.where(on_axis & (z > 0), z, 1.0), rho / across)
        x, y = (factor * points[..., :2]).unbind(-1)
        plane = torch.stack((x + self.shear_x * y, y + self.shear_y * x), -1)
        return plane, ~(on_axis & (z <= 0)).squeeze(-1)

    def _from_plane(self, plane: Tensor) -> Tensor:
        x, y = plane.unbind(-1)
        level = torch.stack((x - self.shear_x * y, y - self.shear_y * x), -1) / (1.0 - self.shear_x * self.shear_y)
        rho = (level * level).sum(-1, keepdim=True).sqrt()
        rays = torch.cat((level, self._z(rho)[0]), -1)
        return rays / rays.norm(dim=-1, keepdim=True)

    def unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Find the rays of pixels, as `Camera.unproject`; the sheared disc's rim is taken by the angle."""
        rays, valid = super().unproject(pixels)
        theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
        valid = valid & (theta <= self.theta_max_rad * (1.0 + 8.0 * torch.finfo(pixels.dtype).eps))
        return torch.where(valid[..., None], rays, math.nan), valid
