"""Radial and tangential lens distortion of a plane, and its inverse.

Camera models with distortion bend a plane of undistorted coordinates x (2-vectors, no unit; what they mean is the
camera's business) by the same map

    F(x) = d(r²)·x + r²·p + 2(p·x)·x,    r = |x|,  d = 1 + Σ k_i r^(2i),  p = (p2, p1)

which, written out, is OpenCV's x·d + 2·p1·x·y + p2·(r² + 2x²) and its twin for y.

Where the map is used. Its Jacobian, (d + 2p·x)·I + 2d'·xxᵀ + 2(pxᵀ + xpᵀ), is symmetric, and a map whose
Jacobian is symmetric and positive definite over a convex domain takes no value twice there. The domain is the
largest disc r <= `radius_max` on which that holds: outside of it the image folds back over itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

_MAX_ITERATIONS = 80
"""At the fold itself Newton's method only halves the error: some 26 steps to float64's precision."""
_TABLE_SIZE = 1024
"""Radii for which the radial part is tabulated, to start from."""
_SHORTEST_STEP = 2.0**-10
"""The share of a Newton step below which a point counts as one that cannot be improved."""
_ROUNDING = 16.0
"""By how many times the type's eps, relative to its terms, the map's value may be off."""


@dataclass(frozen=True)
class Distortion:
    """The map F of the module's head; `radial` holds k1, k2, ... and may be empty."""

    radial: tuple[float, ...] = ()
    p1: float = 0.0
    p2: float = 0.0

    @cached_property
    def radius_max(self) -> float:
        """Radius of the disc on which the map is one-to-one; infinite where it is so everywhere.

        Let g = d(r·d)/dr and p = |p|. Of all angles between x and p the Jacobian is worst at 180°, where its
        eigenvalues are g - 6pr and d - 2pr. (That it is worst there takes g + 3d >= 16pr, which g >= 6pr and
        d >= 4pr ensure. The latter never decides for a real lens, whose pr is below 0.01.)
        """
        tangential = math.hypot(self.p1, self.p2)
        rise = [1.0, -6.0 * tangential]
        scale = [1.0, -4.0 * tangential]
        for power, k in enumerate(self.radial, start=1):
            rise += [(2 * power + 1) * k, 0.0]
            scale += [k, 0.0]
        return min(first_positive_root(rise), first_positive_root(scale))

    def distort(self, plane: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Apply F; the result means something only for |plane| <= `radius_max`."""
        square = (plane * plane).sum(-1, keepdim=True)
        distorted = self._scale(square) * plane
        if self.p1 or self.p2:
            along = self.p2 * plane[..., :1] + self.p1 * plane[..., 1:]
            offset = torch.cat((self.p2 * square, self.p1 * square), -1)
            distorted = distorted + offset + 2.0 * along * plane
        return distorted

    def undistort(
        self, distorted: Float[Tensor, "*batch 2"], radius_max: float, tolerance: Float[Tensor, "*batch"]
    ) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Find x with F(x) = distorted, by damped Newton steps, to the precision of the type.

        Args:
            distorted: finite coordinates in the distorted plane.
            radius_max: the function searches for x within |x| <= radius_max, at most this distortion's own.
            tolerance: by how much `distorted` may be off by earlier rounding, in the plane's unit; it decides
                which points just beyond the rim still count as on it.

        Returns:
            x, and whether there is one. Where there is none, x is some point of the disc.
        """
        target, tolerance = distorted.reshape(-1, 2), tolerance.reshape(-1)
        eps = torch.finfo(target.dtype).eps
        length = target.norm(dim=-1, keepdim=True)
        plane = self._radial_guess(target, length, radius_max)
        residual = self.distort(plane) - target
        share = torch.ones_like(length)
        active = residual.norm(dim=-1) > eps * self._magnitude(plane)
        if math.isfinite(radius_max):
            # what lies beyond the image of the rim has no solution; the bound is exact for p = 0
            reach = radius_max * float(self._scale(torch.tensor(radius_max**2, dtype=torch.float64)))
            reach += 3.0 * radius_max**2 * math.hypot(self.p1, self.p2)
            active &= length.squeeze(-1) <= reach * (1.0 + _ROUNDING * eps) + tolerance
        index = active.nonzero().squeeze(-1)
        for _ in range(_MAX_ITERATIONS):
            if index.numel() == 0:
                break
            here, there, old = plane[index], target[index], residual[index]
            step, determinant = self._newton_step(here, old)
            # at the rim the determinant may be zero; a finite inverse there keeps steps finite
            new = here - share[index] * step / determinant.clamp_min(eps)
            new = new * (radius_max / new.norm(dim=-1, keepdim=True).clamp_min(eps)).clamp_max(1.0)
            new_residual = self.distort(new) - there
            better = (new_residual.norm(dim=-1) < old.norm(dim=-1))[:, None]
            plane[index] = torch.where(better, new, here)
            residual[index] = torch.where(better, new_residual, old)
            share[index] = torch.where(better, (2.0 * share[index]).clamp_max(1.0), 0.25 * share[index])
            unsolved = residual[index].norm(dim=-1) > eps * self._magnitude(plane[index])
            index = index[unsolved & (share[index].squeeze(-1) >= _SHORTEST_STEP)]
        valid = residual.norm(dim=-1) <= _ROUNDING * eps * self._magnitude(plane) + tolerance
        return plane.reshape(distorted.shape), valid.reshape(distorted.shape[:-1])

    def _radial_guess(self, target: Tensor, length: Tensor, radius_max: float) -> Tensor:
        """The solution for p = 0, from a table; close to a fold Newton's steps from elsewhere go astray."""
        if not any(self.radial) or target.numel() == 0:
            return target * (radius_max / length.clamp_min(torch.finfo(target.dtype).eps)).clamp_max(1.0)
        nodes = torch.linspace(0.0, 1.0, _TABLE_SIZE, dtype=torch.float64)
        end = radius_max
        if math.isinf(radius_max):
            # as far as needed, and dense near the axis
            end, longest = 1.0, float(length.max())
            while end * float(self._scale(torch.tensor(end**2, dtype=torch.float64))) < longest:
                end *= 2.0
            nodes = nodes**3
        distorted = (end * nodes * self._scale((end * nodes) ** 2)).to(length)
        radius = (end * nodes).to(length)
        upper = torch.searchsorted(distorted, length).clamp(1, _TABLE_SIZE - 1)
        below, above = distorted[upper - 1], distorted[upper]
        part = ((length - below) / (above - below).clamp_min(torch.finfo(target.dtype).tiny)).clamp(0.0, 1.0)
        found = radius[upper - 1] + part * (radius[upper] - radius[upper - 1])
        # in the last interval before a fold the secant is no guide; from below Newton's steps get there
        found = found.clamp_max(float(radius[-2]))
        # near the axis the table's secant has the precision of its step only; there F is the identity
        return target * torch.where(upper > 1, found / length, 1.0)

    def _scale(self, square: Tensor) -> Tensor:
        scale = torch.ones_like(square)
        if self.radial:
            scale = torch.full_like(square, self.radial[-1])
            for k in (*self.radial[-2::-1], 1.0):
                scale = scale * square + k
        return scale

    def _magnitude(self, plane: Tensor) -> Tensor:
        """The sum of the sizes of the map's terms, to which rounding errors are in proportion."""
        square = (plane * plane).sum(-1)
        scale = Distortion(tuple(abs(k) for k in self.radial))._scale(square)
        return square.sqrt() * scale + 3.0 * math.hypot(self.p1, self.p2) * square

    def newton(self, distorted: Float[Tensor, "*batch 2"], steps: int, smallest_determinant: float) -> Tensor:
        """Make undamped Newton steps from the distorted point, as simple solvers do; they may end anywhere.

        Where all is well, they reach the undistorted plane. A point stays where the Jacobian's determinant is smaller
        than `smallest_determinant`.
        """
        plane = distorted
        for _ in range(steps):
            step, determinant = self._newton_step(plane, self.distort(plane) - distorted)
            moves = determinant.abs() > smallest_determinant
            plane = plane - torch.where(moves, step / torch.where(moves, determinant, 1.0), 0.0)
        return plane

    def _newton_step(self, plane: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
        """What a residual divided by the symmetric Jacobian is, times its determinant; and that."""
        x, y = plane.unbind(-1)
        square = x * x + y * y
        slope = torch.zeros_like(square)
        for power, k in reversed(list(enumerate(self.radial, start=1))):
            slope = slope * square + power * k
        diagonal = self._scale(square) + 2.0 * (self.p2 * x + self.p1 * y)
        xx = diagonal + 2.0 * slope * x * x + 4.0 * self.p2 * x
        yy = diagonal + 2.0 * slope * y * y + 4.0 * self.p1 * y
        xy = 2.0 * slope * x * y + 2.0 * (self.p1 * x + self.p2 * y)
        u, v = residual.unbind(-1)
        return torch.stack((yy * u - xy * v, xx * v - xy * u), -1), (xx * yy - xy * xy)[..., None]


def first_positive_root(ascending: list[float]) -> float:
    """The smallest positive real root of a polynomial with value 1 at zero; infinity without one."""
    roots = np.roots(ascending[::-1])
    real = roots.real[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)]
    return float(real.min()) if real.size else math.inf
