"""Cameras and rays that several test modules use, and nerfstudio's own rays to compare with."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt

# KITTI-360's published calibration; its u0, v0 count integer pixel centres
IMAGE_02 = MEI(
    width=1400,
    height=1400,
    fx=1.3363220825849971e03,
    fy=1.3357883350012958e03,
    cx=7.1694323510126321e02 + 0.5,
    cy=7.0576498308221585e02 + 0.5,
    xi=2.2134047507854890e00,
    k1=1.6798235660113681e-02,
    k2=1.6548773243373522e00,
    p1=4.2223943394772046e-04,
    p2=4.2462134260997584e-04,
)
IMAGE_03 = MEI(
    width=1400,
    height=1400,
    fx=1.4854388981875156e03,
    fy=1.4849477411748708e03,
    cx=6.9888316784030962e02 + 0.5,
    cy=6.9814541887723055e02 + 0.5,
    xi=2.5535139132482758e00,
    k1=4.9370396274089505e-02,
    k2=4.5068455478645308e00,
    p1=1.3477698472982495e-03,
    p2=-7.0340482615055284e-04,
)
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


def nerfstudio_directions(camera: Camera, camera_type: str, parameters: dict[str, float], pixels: Tensor) -> Tensor:
    """What nerfstudio makes of the same parameters, turned to OpenCV's axes."""
    from nerfstudio.cameras.camera_utils import get_distortion_params
    from nerfstudio.cameras.cameras import Cameras, CameraType

    host = Cameras(
        camera_to_worlds=torch.eye(4)[:3],
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        width=camera.width,
        height=camera.height,
        distortion_params=get_distortion_params(**parameters),
        camera_type=CameraType[camera_type],
    )
    bundle = host.generate_rays(camera_indices=0, coords=pixels.flip(-1).float())
    # OpenGL: y up, z backwards
    return (bundle.directions * torch.tensor([1.0, -1.0, -1.0])).double()
