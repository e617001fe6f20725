"""Cameras and rays that several test modules use, and nerfstudio's own rays to compare with."""

import math

import pytest
import torch
from drives import FULL_SIZE, MEI_NUMBERS
from torch import Tensor

from edge_depth_nerf.cameras import MEI, KannalaBrandt, Pinhole


def kitti_360(name: str) -> MEI:
    """KITTI-360's published calibration; its u0, v0 count integer pixel centres."""
    xi, k1, k2, p1, p2, gamma1, gamma2, u0, v0 = MEI_NUMBERS[name]
    return MEI(FULL_SIZE, FULL_SIZE, gamma1, gamma2, u0 + 0.5, v0 + 0.5, xi, k1, k2, p1, p2)


IMAGE_02, IMAGE_03 = kitti_360("image_02"), kitti_360("image_03")
KITTI = [pytest.param(IMAGE_02, id="image_02"), pytest.param(IMAGE_03, id="image_03")]

# near to what image_02 is fitted by: rises to 114°
FISHEYE = KannalaBrandt(
    1400, 1400, 415.92, 415.75, 717.45, 706.27, -0.01032, 0.01065, -0.00254, -0.000276, 1.137e-4, 1.143e-4
)


def rays(theta_rad: Tensor | float, phi_count: int = 24) -> Tensor:
    """Unit directions, theta × phi × 3."""
    theta = torch.atleast_1d(torch.as_tensor(theta_rad, dtype=torch.float64))[:, None]
    phi = torch.arange(phi_count, dtype=torch.float64) * (2 * math.pi / phi_count) + 0.01
    x, y = theta.sin() * phi.cos(), theta.sin() * phi.sin()
    return torch.stack((x, y, theta.cos().expand_as(x)), -1)


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between unit vectors; precise for small ones, where arccos is not."""
    return 2 * torch.atan2((a - b).norm(dim=-1), (a + b).norm(dim=-1))


def nerfstudio_directions(camera: KannalaBrandt | Pinhole, pixels: Tensor) -> Tensor:
    """What nerfstudio makes of the camera's parameters, turned to OpenCV's axes."""
    from nerfstudio.cameras.camera_utils import get_distortion_params
    from nerfstudio.cameras.cameras import Cameras, CameraType

    kind = CameraType.FISHEYE if isinstance(camera, KannalaBrandt) else CameraType.PERSPECTIVE
    numbers = [getattr(camera, key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")]
    host = Cameras(
        camera_to_worlds=torch.eye(4)[:3],
        **{key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
        distortion_params=get_distortion_params(*numbers),
        camera_type=kind,
    )
    bundle = host.generate_rays(camera_indices=0, coords=pixels.flip(-1).float())
    # OpenGL: y up, z backwards
    return (bundle.directions * torch.tensor([1.0, -1.0, -1.0])).double()
