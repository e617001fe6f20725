"""Camera models: MEI, Kannala-Brandt, pinhole. Project and unproject, exact beyond 90°, in torch.

Frames and units. Camera frame: x right, y down, z forward (OpenCV). Pixels are (x, y) with centres at +0.5:
the picture covers 0 <= x < width, 0 <= y < height. (OpenCV and KITTI-360's calibration count integer centres:
their u0 is `cx` - 0.5.) Angles in radians; θ is the angle between a ray and the z axis. Leading dimensions
are free. Results have the dtype and device of the input; parameters are plain floats.

Validity. Every model ends at its own `theta_max_rad`, beyond which its formulas fold back into the picture.
What is beyond is marked as not valid and is NaN; gradients of what is valid stay finite, and what is not
valid gets a gradient of zero. Validity says nothing about the picture's borders: that is `inside`.
"""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from edge_depth_nerf.base.bounds import check_pixels
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras.distortion import Distortion

MAX_PARAMETER = 1e9
"""No parameter of a lens is larger; float32 bears its square."""
AnyCamera = TypeVar("AnyCamera", bound="Camera")


@dataclass(frozen=True)
class Camera(ABC):
    """What the models share: a map from rays to a plane, the plane's distortion, and the pixel grid.

    Size, focal lengths and principal point are in pixels, with pixel centres at +0.5.

    Raises:
        InputError: a parameter is not finite or out of its range.
    """

    model: ClassVar[str]
    """The model's name in files."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    theta_limit_rad: float = dataclasses.field(default=math.pi, kw_only=True)
    """The angle up to which the parameters were fitted; the model is not valid beyond."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise InputError(f"{self.model} camera: {field.name} is {value}, expected a finite number.")
            if abs(value) > MAX_PARAMETER:
                raise InputError(f"{self.model} camera: {field.name} is {value:g}, expected at most {MAX_PARAMETER:g}.")
            if value <= 0 and field.name in ("width", "height", "fx", "fy"):
                raise InputError(f"{self.model} camera: {field.name} is {value}, expected more than 0.")
        check_pixels(self.width, self.height, f"{self.model} camera")
        if not 0 < self.theta_limit_rad <= math.pi:
            raise InputError(
                f"{self.model} camera: theta_limit_rad is {self.theta_limit_rad}, expected more than 0 and at most pi."
            )

    @property
    @abstractmethod
    def theta_max_rad(self) -> float:
        """The largest angle from the z axis up to which the model is one-to-one, at most `theta_limit_rad`."""

    @cached_property
    def _distortion(self) -> Distortion:
        """By those of k1 to k4, p1 and p2 that the model has."""
        radial = tuple(getattr(self, name) for name in ("k1", "k2", "k3", "k4") if hasattr(self, name))
        return Distortion(radial, getattr(self, "p1", 0.0), getattr(self, "p2", 0.0))

    @cached_property
    @abstractmethod
    def _radius_max(self) -> float:
        """Radius in the undistorted plane that belongs to `theta_max_rad`."""

    @abstractmethod
    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Rays, of any positive length near 1, to the undistorted plane; second, whether that can be."""

    @abstractmethod
    def _from_plane(self, plane: Tensor) -> Tensor:
        """Points within `_radius_max` of the undistorted plane to unit rays."""

    def project(self, points: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 2"], Bool[Tensor, "*batch"]]:
        """Project points or directions to pixels (NaN where not valid); second, whether θ <= `theta_max_rad`.

        A point at the origin, or with a coordinate that is not finite, is not valid.
        """
        largest = points.abs().amax(-1, keepdim=True)
        usable = (largest > 0) & torch.isfinite(largest)
        forward = points.new_tensor([0.0, 0.0, 1.0])
        # division by the largest coordinate keeps squares from overflow
        rays = torch.where(usable, points, forward) / torch.where(usable, largest, 1.0)
        theta = torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])
        # a ray of the rim itself may come out a rounding beyond it
        limit = self.theta_max_rad * (1.0 + 8.0 * torch.finfo(points.dtype).eps)
        usable = usable & (theta <= limit)[..., None]
        plane, defined = self._to_plane(torch.where(usable, rays, forward))
        pixels = self._distortion.distort(plane) * plane.new_tensor([self.fx, self.fy])
        pixels = pixels + plane.new_tensor([self.cx, self.cy])
        valid = usable.squeeze(-1) & defined & torch.isfinite(pixels).all(-1)
        return torch.where(valid[..., None], pixels, math.nan), valid

    def unproject(self, pixels: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "*batch 3"], Bool[Tensor, "*batch"]]:
        """Find the rays of pixels, also of pixels outside the picture, as unit directions (NaN where not valid).

        Second, whether the pixel is the image of a ray with θ <= `theta_max_rad`.
        """
        focal, principal = pixels.new_tensor([self.fx, self.fy]), pixels.new_tensor([self.cx, self.cy])
        usable = torch.isfinite(((pixels - principal) / focal).square().sum(-1))
        pixels = torch.where(usable[..., None], pixels, principal)
        distorted = (pixels - principal) / focal
        rounding = torch.finfo(pixels.dtype).eps * ((pixels.abs() + principal.abs()) / focal).amax(-1)
        plane, solved = self._distortion.undistort(distorted, self._radius_max, rounding)
        valid = usable & solved
        directions = self._from_plane(torch.where(valid[..., None], plane, 0.0))
        return torch.where(valid[..., None], directions, math.nan), valid

    def inside(self, pixels: Float[Tensor, "*batch 2"]) -> Bool[Tensor, "*batch"]:
        """Whether pixels lie in the picture; NaN does not."""
        x, y = pixels.unbind(-1)
        return (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)

    def pixel_centres(self, dtype: torch.dtype = torch.float64) -> Float[Tensor, "height width 2"]:
        """The centres (x, y) of all pixels, row by row."""
        y, x = torch.meshgrid(
            torch.arange(self.height, dtype=dtype) + 0.5, torch.arange(self.width, dtype=dtype) + 0.5, indexing="ij"
        )
        return torch.stack((x, y), -1)

    def downscaled(self: AnyCamera, factor: int) -> AnyCamera:
        """The camera of the picture whose pixels are `factor`×`factor` blocks; incomplete blocks are dropped.

        Raises:
            InputError: the factor is below 1 or leaves no pixel.
        """
        if not 1 <= factor <= min(self.width, self.height):
            raise InputError(
                f"downscale factor {factor}: expected 1 to {min(self.width, self.height)} "
                f"for a picture of {self.width}x{self.height} pixels."
            )
        return dataclasses.replace(
            self,
            width=self.width // factor,
            height=self.height // factor,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=self.cx / factor,
            cy=self.cy / factor,
        )

    def to_dict(self) -> dict[str, Any]:
        """All parameters under their names, and "model"."""
        return {"model": self.model, **dataclasses.asdict(self)}


@dataclass(frozen=True)
class MEI(Camera):
    """The unified model of Mei & Rives (ICRA 2007, eq. 2-7), as in KITTI-360 and cv2.omnidir.

    A unit ray (X, Y, Z) goes to the plane (X, Y)/(Z + ξ), is distorted (radially by k1 and k2, tangentially by p1 and
    p2), and scaled by fx = γ1, fy = γ2.
    """

    model: ClassVar[str] = "MEI"

    xi: float
    """Shift of the projection centre along the axis, in radii of the unit sphere; more than -1."""
    k1: float
    k2: float
    p1: float
    p2: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.xi <= -1:
            raise InputError(f"MEI camera: xi is {self.xi}, expected more than -1.")

    @cached_property
    def theta_max_rad(self) -> float:
        """For ξ > 1 the angle arccos(-1/ξ), beyond which the plane's radius shrinks again; else where Z = -ξ.

        It is less where the distortion folds before that angle, or where `theta_limit_rad` is less.
        """
        return min(self._theta_of_model, self.theta_limit_rad)

    @cached_property
    def _theta_of_model(self) -> float:
        fold = self._distortion.radius_max
        if fold >= self._radius_of_sphere:
            return math.acos(-1.0 / self.xi) if self.xi > 1 else math.acos(-self.xi)
        root = math.sqrt(1.0 - (self.xi - 1.0) * (self.xi + 1.0) * fold**2)
        return math.atan2((self.xi + root) * fold, root - self.xi * fold**2)

    @property
    def _radius_of_sphere(self) -> float:
        """The largest radius in the plane that the sphere reaches."""
        return 1.0 / math.sqrt((self.xi - 1.0) * (self.xi + 1.0)) if self.xi > 1 else math.inf

    @cached_property
    def _radius_max(self) -> float:
        if self.theta_limit_rad < self._theta_of_model:
            return math.sin(self.theta_limit_rad) / (math.cos(self.theta_limit_rad) + self.xi)
        return min(self._distortion.radius_max, self._radius_of_sphere)

    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        z, length = points[..., 2:], points.norm(dim=-1, keepdim=True)
        # z + ξ·length; behind, z + length is taken from x² + y² = (length + z)(length - z), lest digits cancel
        square = (points[..., :2] * points[..., :2]).sum(-1, keepdim=True)
        behind = z < 0
        from_the_back = torch.where(behind, square / torch.where(behind, length - z, 1.0), z + length)
        denominator = (self.xi - 1.0) * length + from_the_back
        defined = denominator > torch.finfo(points.dtype).eps
        return points[..., :2] / torch.where(defined, denominator, 1.0), defined.squeeze(-1)

    def _from_plane(self, plane: Tensor) -> Tensor:
        square = (plane * plane).sum(-1, keepdim=True)
        argument = 1.0 - (self.xi - 1.0) * (self.xi + 1.0) * square
        # zero at the rim, where rounding makes it negative and the root has no derivative
        positive = argument > 0
        root = torch.where(positive, torch.where(positive, argument, 1.0).sqrt(), 0.0)
        return torch.cat(((self.xi + root) * plane, root - self.xi * square), -1) / (1.0 + square)


@dataclass(frozen=True)
class KannalaBrandt(Camera):
    """The fisheye model θ_d = θ(1 + k1θ² + k2θ⁴ + k3θ⁶ + k4θ⁸) (Kannala & Brandt, PAMI 2006, eq. 6).

    With p1 = p2 = 0 it is OpenCV's fisheye model and COLMAP's OPENCV_FISHEYE. The tangential terms act in the
    plane of θ, as in nerfstudio's OPENCV_FISHEYE cameras, whose six parameters mean the same here.
    """

    model: ClassVar[str] = "KANNALA_BRANDT"

    k1: float
    k2: float
    k3: float
    k4: float
    p1: float = 0.0
    p2: float = 0.0

    @cached_property
    def theta_max_rad(self) -> float:
        """Where the polynomial stops to rise, at most `theta_limit_rad`."""
        return min(self._distortion.radius_max, self.theta_limit_rad)

    @property
    def _radius_max(self) -> float:
        return self.theta_max_rad

    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        z = points[..., 2:]
        square = (points[..., :2] * points[..., :2]).sum(-1, keepdim=True)
        on_axis = square == 0
        rho = torch.where(on_axis, 1.0, square).sqrt()
        # θ/ρ tends to 1/z on the axis ahead; on the axis behind it has no limit
        ahead = torch.where(on_axis & (z > 0), z, 1.0)
        factor = torch.where(on_axis, 1.0 / ahead, torch.atan2(rho, z) / rho)
        return factor * points[..., :2], ~(on_axis & (z <= 0)).squeeze(-1)

    def _from_plane(self, plane: Tensor) -> Tensor:
        square = (plane * plane).sum(-1, keepdim=True)
        on_axis = square == 0
        theta = torch.where(on_axis, 1.0, square).sqrt()
        # straight behind, θ = π may be rounded up, and a sine below zero would turn the ray to the other side
        factor = torch.where(on_axis, 1.0, theta.sin().abs() / theta)
        return torch.cat((factor * plane, torch.where(on_axis, 1.0, theta.cos())), -1)


@dataclass(frozen=True)
class Pinhole(Camera):
    """The pinhole with radial (k) and tangential (p) distortion: nerfstudio's OPENCV, and with k4 = 0 OpenCV's."""

    model: ClassVar[str] = "PINHOLE"

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    """Radial distortion, r⁸ (nerfstudio's; OpenCV has a denominator there)."""

    @cached_property
    def theta_max_rad(self) -> float:
        """90°, which no ray reaches; less where the distortion folds before, or where `theta_limit_rad` is less."""
        return math.atan(self._radius_max)

    @property
    def _radius_max(self) -> float:
        limit = self.theta_limit_rad
        return min(self._distortion.radius_max, math.tan(limit) if limit < math.pi / 2 else math.inf)

    def _to_plane(self, points: Tensor) -> tuple[Tensor, Tensor]:
        z = points[..., 2:]
        defined = z > torch.finfo(points.dtype).eps
        return points[..., :2] / torch.where(defined, z, 1.0), defined.squeeze(-1)

    def _from_plane(self, plane: Tensor) -> Tensor:
        rays = torch.cat((plane, torch.ones_like(plane[..., :1])), -1)
        return rays / rays.norm(dim=-1, keepdim=True)
