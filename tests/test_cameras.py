"""Laws of the camera models, golden values, and agreement with OpenCV and nerfstudio."""

import json
import math
import pickle
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from lenses import FISHEYE, IMAGE_02, IMAGE_03, KITTI, angle, nerfstudio_directions, rays

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import EUCM, MEI, Camera, DoubleSphere, KannalaBrandt, OCam, Pinhole
from edge_depth_nerf.cameras.distortion import Distortion

PINHOLE = Pinhole(640, 480, 500.0, 505.0, 320.5, 239.0, -0.3, 0.1, 1e-3, -2e-3)
# polynomial of OCamCalib's own example: -69.7 + 0.000529 ρ² - 1.75e-6 ρ³ + 4.33e-9 ρ⁴
OCAM = OCam(640, 480, 69.6915, 69.6, 320.8, 240.6, b2=-0.03689, b3=0.008505, b4=-0.001466, shear_x=4e-4, shear_y=-3e-4)
CAMERAS = [
    *KITTI,
    pytest.param(replace(IMAGE_02, k2=-2.0), id="mei-folding-distortion"),
    pytest.param(MEI(640, 480, 300.0, 310.0, 321.3, 239.1, 1.0, -0.02, 0.001, 0.001, -0.002), id="mei-parabolic"),
    pytest.param(MEI(640, 480, 300.0, 310.0, 321.3, 239.1, 0.7, 0.0, 0.0, 0.0, 0.0), id="mei-xi-0.7"),
    pytest.param(FISHEYE, id="fisheye"),
    pytest.param(replace(FISHEYE, theta_limit_rad=math.radians(95)), id="fisheye-fitted-to-95"),
    pytest.param(KannalaBrandt(800, 600, 200.0, 201.0, 400.2, 299.8, 0.0, 0.0, 0.0, 0.0), id="fisheye-equidistant"),
    pytest.param(
        KannalaBrandt(800, 600, 250.0, 250.0, 400.0, 300.0, -0.08, 0.0, 0.0, 0.0, 0.003, 0.01), id="fisheye-folding"
    ),
    pytest.param(KannalaBrandt(800, 600, 99.0, 99.0, 400.0, 300.0, 0.3, -0.09, 0.0, 1e-4, 1e-3), id="fisheye-s-shaped"),
    pytest.param(Pinhole(640, 480, 500.0, 505.0, 320.5, 239.0), id="pinhole"),
    pytest.param(PINHOLE, id="pinhole-barrel"),
    pytest.param(Pinhole(640, 480, 500.0, 505.0, 320.5, 239.0, -0.2), id="pinhole-folding"),
    pytest.param(DoubleSphere(512, 512, 158.0, 157.5, 254.9, 256.9, xi=-0.18, alpha=0.59), id="double-sphere"),
    pytest.param(DoubleSphere(512, 512, 158.0, 157.5, 254.9, 256.9, xi=0.2, alpha=0.35), id="double-sphere-open"),
    pytest.param(EUCM(512, 512, 158.0, 157.5, 254.9, 256.9, alpha=0.65, beta=1.1), id="eucm"),
    pytest.param(EUCM(512, 512, 158.0, 157.5, 254.9, 256.9, alpha=0.4, beta=0.8), id="eucm-open"),
    pytest.param(OCAM, id="ocam"),
    pytest.param(replace(OCAM, shear_x=0.0, shear_y=0.0, theta_limit_rad=math.radians(95)), id="ocam-to-95"),
]
each_camera = pytest.mark.parametrize("camera", CAMERAS)


def open_rim(camera: Camera) -> bool:
    """Whether the rim lies at infinity in the picture."""
    return math.isinf(camera._radius_max)


# -- round trips --------------------------------------------------------------------------------------------
@pytest.mark.parametrize("camera", KITTI)
@pytest.mark.parametrize(("dtype", "bound_rad"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_mei_round_trip_to_100_degrees(camera: MEI, dtype: torch.dtype, bound_rad: float) -> None:
    there = rays(torch.linspace(0, math.radians(100), 2001, dtype=torch.float64)).to(dtype)
    pixels, seen = camera.project(there)
    back, found = camera.unproject(pixels)
    assert pixels.dtype == back.dtype == dtype
    assert seen.all() and found.all()
    assert angle(there.double(), back.double()).max() < bound_rad


@each_camera
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_round_trip_dense_to_the_rim(camera: Camera, dtype: torch.dtype) -> None:
    # ever closer to the rim, and on it unless it lies at infinity; behind, the axis is the image of a circle
    near = camera.theta_max_rad * (1 - torch.logspace(-7, -1, 61, dtype=torch.float64))
    rim = [] if open_rim(camera) or camera.theta_max_rad == math.pi else [camera.theta_max_rad]
    inner = torch.linspace(0, 0.95 * camera.theta_max_rad, 400, dtype=torch.float64)
    theta = torch.cat((inner, near, torch.tensor(rim, dtype=torch.float64)))
    if open_rim(camera):
        theta = theta[theta < camera.theta_max_rad - 0.1]
    there = rays(theta).to(dtype)
    pixels, seen = camera.project(there)
    assert seen.all()
    back, found = camera.unproject(pixels)
    assert found.all()
    # a pixel's rounding decides how well the angle can be known; near a fold that is its square root
    again, seen = camera.project(back)
    assert seen.all()
    eps = torch.finfo(dtype).eps
    scale = pixels.abs().amax(-1) + max(camera.cx, camera.cy)
    assert ((again - pixels).norm(dim=-1) / scale).max() < (2000 if open_rim(camera) else 40) * eps
    error = angle(there.double(), back.double()).amax(-1)
    assert error.max() < 20 * math.sqrt(eps)
    assert (back.norm(dim=-1) - 1).abs().max() < 8 * eps


@each_camera
def test_every_valid_pixel_of_the_picture_returns_to_itself(camera: Camera) -> None:
    pixels = camera.pixel_centres()[::7, ::7]
    directions, found = camera.unproject(pixels)
    again, seen = camera.project(directions)
    assert torch.equal(found, seen)
    assert found.float().mean() > 0.2
    assert (again - pixels)[found].abs().max() < 1e-9
    assert directions[~found].isnan().all() and not directions[found].isnan().any()


def test_straight_behind_stays_on_its_side() -> None:
    # in 32 bits π is rounded up, and so is the radius of pixels next to it; the sine beyond π is negative
    camera = KannalaBrandt(800, 600, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    radius = torch.tensor([math.pi], dtype=torch.float32)
    assert radius.sin() < 0
    for pixel in ((radius.item(), 0.0), (0.0, radius.item()), (-radius.item(), 0.0)):
        pixels = torch.tensor(pixel)
        direction, found = camera.unproject(pixels)
        assert found and (direction[:2] * pixels).sum() > 0
        torch.testing.assert_close(camera.project(direction)[0], pixels)


@pytest.mark.parametrize("camera", [p for p in CAMERAS if p.id in ("pinhole-barrel", "mei-parabolic")])
def test_far_pixels_are_inverted_beside_near_ones(camera: Camera) -> None:
    # up to where r⁵ has brought them: what lies far out must not spoil the start for the others
    reach = torch.cat((torch.logspace(0, 15, 400, dtype=torch.float64), torch.tensor([1e30])))
    pixels = torch.tensor([camera.cx, camera.cy]) + reach[:, None] * rays(math.pi / 2, 1)[0, :, :2]
    directions, found = camera.unproject(pixels)
    assert found.all()
    assert (torch.atan2(directions[:, :2].norm(dim=-1), directions[:, 2]).diff() >= 0).all()
    again, seen = camera.project(directions[reach < 1e6])
    assert seen.all()
    torch.testing.assert_close(again, pixels[reach < 1e6], rtol=1e-9, atol=1e-9)


def test_mei_keeps_its_digits_close_behind() -> None:
    # ξ = 1 images the whole sphere: r = tan(θ/2); at 179.9° that is 1145.9, from z + 1 = 1.5e-6
    camera = MEI(640, 480, 100.0, 100.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0)
    for degrees in (100.0, 150.0, 179.0, 179.9):
        theta = math.radians(degrees)
        pixel = camera.project(torch.tensor([math.sin(theta), 0.0, math.cos(theta)]))[0]
        assert pixel[0].item() == pytest.approx(100 * math.tan(theta / 2), rel=3e-6)


def test_random_lenses_are_inverted_up_to_their_folds() -> None:
    generator = torch.Generator().manual_seed(5)

    largest = torch.tensor([0.3, 0.1, 0.02, 0.002, 0.03, 0.03])
    folding = 0
    for _ in range(40):
        drawn = largest * (2 * torch.rand(6, generator=generator) - 1)
        camera = KannalaBrandt(1000, 1000, 300.0, 300.0, 500.0, 500.0, *drawn.tolist())
        folding += camera.theta_max_rad < math.pi
        there = rays(torch.linspace(0, camera.theta_max_rad * 0.9999, 150, dtype=torch.float64), 24)
        pixels, seen = camera.project(there)
        back, found = camera.unproject(pixels)
        assert seen.all() and found.all(), camera
        assert angle(there, back).max() < 1e-9, camera
    assert 10 < folding < 40


# -- validity -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("camera", "degrees"), [(IMAGE_02, 116.8588), (IMAGE_03, 113.0552)])
def test_mei_ends_at_arccos_of_minus_one_over_xi(camera: MEI, degrees: float) -> None:
    # cos(116.8588°) = -0.451794 = -1/2.213405;  cos(113.0552°) = -0.391617 = -1/2.553514
    assert math.degrees(camera.theta_max_rad) == pytest.approx(degrees, abs=1e-4)
    # the radius in the picture grows up to there and shrinks from there on
    without = replace(camera, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    theta = torch.linspace(0, camera.theta_max_rad, 500, dtype=torch.float64)
    radius = (without.project(rays(theta, 1))[0] - torch.tensor([camera.cx, camera.cy])).norm(dim=-1).squeeze(-1)
    assert (radius.diff() > 0).all()
    assert radius[-1] - radius[-2] < 1e-2 * (radius[1] - radius[0])


@pytest.mark.parametrize("camera", [*KITTI, *(p for p in CAMERAS if p.id in ("fisheye", "fisheye-folding"))])
def test_nothing_folds_back_into_the_picture(camera: Camera) -> None:
    theta = torch.deg2rad(torch.tensor([120.0, 150.0, 179.9, 180.0], dtype=torch.float64))
    points = rays(theta) * torch.tensor([0.1, 1.0, 80.0, 200.0]).repeat(6)[:, None]
    pixels, valid = camera.project(points)
    assert not valid.any()
    assert pixels.isnan().all()
    assert not camera.inside(pixels).any()


@each_camera
def test_no_two_rays_share_a_pixel(camera: Camera) -> None:
    # rays all over the sphere: what projects is found again by the pixel alone
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(20000, 3, generator=generator, dtype=torch.float64)
    points = points[points[:, 2] / points.norm(dim=-1) > -0.999]
    pixels, valid = camera.project(points)
    theta = torch.atan2(points[:, :2].norm(dim=-1), points[:, 2])
    assert torch.equal(valid, theta <= camera.theta_max_rad)
    assert camera.project(rays(camera.theta_max_rad - 1e-7))[1].all()
    assert camera.theta_max_rad == math.pi or not camera.project(rays(camera.theta_max_rad + 1e-9))[1].any()
    back, found = camera.unproject(pixels[valid])
    assert found.all()
    assert angle(back, torch.nn.functional.normalize(points[valid], dim=-1)).max() < 1e-6


@each_camera
def test_pixels_beyond_the_rim_are_not_valid(camera: Camera) -> None:
    centre = torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    if open_rim(camera):
        assert camera.unproject(centre + rays(math.pi / 2)[..., :2] * 1e6)[1].all()
        return
    rim = camera.project(rays(camera.theta_max_rad * (1 - 1e-12)))[0]
    outward = (rim - centre) / (rim - centre).norm(dim=-1, keepdim=True)
    assert camera.unproject(rim - 1e-3 * outward)[1].all()
    for beyond_px in (1e-3, 1.0, 100.0, 1e4, 1e12):
        directions, valid = camera.unproject(rim + beyond_px * outward)
        assert not valid.any()
        assert directions.isnan().all()


def test_kannala_brandt_ends_where_its_polynomial_does() -> None:
    # d/dθ (θ + k1 θ³) = 1 + 3 k1 θ² = 0 at θ = 1/√(-3 k1) = 1/√0.24 = 2.041241
    camera = KannalaBrandt(800, 800, 200.0, 200.0, 400.0, 400.0, -0.08, 0.0, 0.0, 0.0)
    assert camera.theta_max_rad == pytest.approx(2.0412414523193152, abs=1e-12)
    # 1 + 9 k4 θ⁸ = 0 at θ = (1/0.009)^(1/8) = 1.801833
    only_k4 = replace(camera, k1=0.0, k4=-0.001)
    assert only_k4.theta_max_rad == pytest.approx(0.009**-0.125, abs=1e-12)
    assert replace(camera, k1=0.08, k4=0.001).theta_max_rad == math.pi
    assert replace(camera, theta_limit_rad=1.5).theta_max_rad == 1.5
    assert replace(camera, theta_limit_rad=2.5).theta_max_rad == camera.theta_max_rad


def test_mei_ends_where_its_distortion_does() -> None:
    # 1 + 3 k1 r² = 0 at r = 1/√3 for k1 = -1; with ξ = 1, r = tan(θ/2), so θ = 60°
    camera = MEI(800, 800, 200.0, 200.0, 400.0, 400.0, 1.0, -1.0, 0.0, 0.0, 0.0)
    assert math.degrees(camera.theta_max_rad) == pytest.approx(60.0, abs=1e-9)
    assert replace(camera, k1=0.0).theta_max_rad == pytest.approx(math.pi)
    # for ξ < 1 the plane ends where Z = -ξ: 120° for ξ = 1/2
    assert math.degrees(replace(camera, k1=0.0, xi=0.5).theta_max_rad) == pytest.approx(120.0)


def test_pinhole_ends_below_90_degrees() -> None:
    camera = Pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert camera.theta_max_rad == math.pi / 2
    assert not camera.project(torch.tensor([[1.0, 0, 0], [1, 0, -1], [0, 0, -1]]))[1].any()
    # 1 + 3 k1 r² = 0 at r = 1 for k1 = -1/3: 45°
    assert math.degrees(replace(camera, k1=-1 / 3).theta_max_rad) == pytest.approx(45.0)


@pytest.mark.parametrize(
    "distortion",
    [
        Distortion((-0.08, 0.0, 0.0, 0.0), 0.003, 0.01),
        Distortion((0.3, -0.09, 0.0, 1e-4), 0.02, -0.05),
        Distortion((-0.5, 0.1), -0.01, 0.02),
        Distortion((), 0.05, 0.05),
    ],
)
def test_radius_max_is_where_the_jacobian_stops_being_positive(distortion: Distortion) -> None:
    radius_max = distortion.radius_max
    assert math.isfinite(radius_max)
    directions = rays(math.pi / 2, 180)[0, :, :2]

    def smallest_eigenvalue(radius: float) -> float:
        jacobian = torch.func.vmap(torch.func.jacrev(distortion.distort))(radius * directions)
        assert torch.allclose(jacobian, jacobian.mT)
        return float(torch.linalg.eigvalsh(jacobian).min())

    for share in (0.0, 0.5, 0.8, 0.99, 0.999):
        assert smallest_eigenvalue(share * radius_max) > 0
    assert smallest_eigenvalue(radius_max) == pytest.approx(0.0, abs=1e-3)
    assert smallest_eigenvalue(1.01 * radius_max) < 0


# -- golden values ------------------------------------------------------------------------------------------
def test_mei_by_hand() -> None:
    plain = MEI(800, 800, 200.0, 210.0, 400.5, 300.5, 1.0, 0.0, 0.0, 0.0, 0.0)
    points = torch.tensor([[1.0, 0, 0], [0, 3.0, 0], [0.6, 0, -0.8], [0, 0, 7.0]], dtype=torch.float64)
    # ξ = 1: (1, 0)/(0 + 1) -> 400.5 + 200;  likewise 300.5 + 210;  0.6/(-0.8 + 1) = 3 -> 400.5 + 600
    expected = [[600.5, 300.5], [400.5, 510.5], [1000.5, 300.5], [400.5, 300.5]]
    np.testing.assert_allclose(plain.project(points)[0], expected, rtol=0, atol=1e-9)

    bent = replace(plain, k1=0.1, k2=0.01, p1=0.001, p2=0.002)
    # at 90° to the right x = 1, r = 1: x' = 1·1.11 + 0.002·(1 + 2) = 1.116,  y' = 0.001·1
    expected = [[400.5 + 200 * 1.116, 300.5 + 210 * 0.001]]
    np.testing.assert_allclose(bent.project(points[:1])[0], expected, rtol=0, atol=1e-9)


def test_kannala_brandt_by_hand() -> None:
    camera = KannalaBrandt(800, 800, 200.0, 210.0, 400.5, 300.5, 0.1, 0.01, 0.001, 0.0001, 0.001, 0.002)
    # to the right at θ = 1: θ_d = 1.1111;  x' = 1.1111 + 0.002·3 = 1.1171,  y' = 0.001
    # straight behind the limit π/2 + 0.4 = 1.970796 it still goes on: θ = 2 below (0, sin 2, cos 2):
    # θ² = 4, 1 + 0.4 + 0.16 + 0.064 + 0.0256 = 1.6496, θ_d = 3.2992;  y' = 3.2992 + 0.001·12,  x' = 0.002·4
    points = torch.tensor([[math.sin(1.0), 0, math.cos(1.0)], [0, math.sin(2.0), math.cos(2.0)]], dtype=torch.float64)
    expected = [[400.5 + 200 * 1.1171, 300.5 + 210 * 0.001], [400.5 + 200 * 0.008, 300.5 + 210 * 3.3112]]
    np.testing.assert_allclose(camera.project(points)[0], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("camera", KITTI)
def test_mei_agrees_with_cv2_omnidir(camera: MEI) -> None:
    if not hasattr(cv2, "omnidir"):
        pytest.skip("this OpenCV is built without its contrib modules, which hold cv2.omnidir")
    theta = torch.linspace(1e-3, camera.theta_max_rad, 300, dtype=torch.float64)
    points = (rays(theta) * torch.linspace(0.5, 80, 24, dtype=torch.float64)[:, None]).reshape(-1, 3)
    # OpenCV's pixel centres are whole numbers
    matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    bent = np.array([camera.k1, camera.k2, camera.p1, camera.p2])
    theirs, _ = cv2.omnidir.projectPoints(points.numpy()[:, None], np.zeros(3), np.zeros(3), matrix, camera.xi, bent)
    ours, valid = camera.project(points)
    assert valid.all()
    assert np.abs(ours.numpy() - 0.5 - theirs.reshape(-1, 2)).max() < 1e-9


@pytest.mark.parametrize(
    ("camera", "theta_max_rad", "project", "terms"),
    [
        # cv2.fisheye knows neither tangential terms nor rays from 90° on
        (replace(FISHEYE, p1=0.0, p2=0.0), math.radians(89), cv2.fisheye.projectPoints, ("k1", "k2", "k3", "k4")),
        (PINHOLE, 0.6, cv2.projectPoints, ("k1", "k2", "p1", "p2")),
    ],
    ids=["fisheye", "pinhole"],
)
def test_cameras_agree_with_cv2(camera: Camera, theta_max_rad: float, project: Callable, terms: tuple[str]) -> None:
    points = rays(torch.linspace(1e-3, theta_max_rad, 200, dtype=torch.float64)).reshape(-1, 1, 3)
    matrix = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    k = np.array([getattr(camera, name) for name in terms])
    theirs, _ = project(points.numpy(), np.zeros(3), np.zeros(3), matrix, k)
    assert np.abs(camera.project(points)[0].numpy() - 0.5 - theirs).max() < 1e-9


# -- the axis, 90°, and what is no point at all -------------------------------------------------------------
@each_camera
def test_the_axis_goes_exactly_to_the_principal_point(camera: Camera) -> None:
    for dtype in (torch.float64, torch.float32):
        pixels, seen = camera.project(torch.tensor([[0, 0, 1], [0, 0, 1e-3], [0, 0, 250]], dtype=dtype))
        assert seen.all()
        assert torch.equal(pixels, torch.tensor([[camera.cx, camera.cy]] * 3, dtype=dtype))
        direction, found = camera.unproject(torch.tensor([camera.cx, camera.cy], dtype=dtype))
        assert found and direction.tolist() == [0.0, 0.0, 1.0]


@each_camera
def test_only_the_direction_of_a_point_counts(camera: Camera) -> None:
    points = rays(torch.linspace(0, 0.9 * camera.theta_max_rad, 30, dtype=torch.float64)).float()
    expected, _ = camera.project(points)
    for factor in (1e-20, 1e-3, 80.0, 1e20):
        pixels, valid = camera.project(points * factor)
        assert valid.all()
        torch.testing.assert_close(pixels, expected, rtol=1e-4, atol=1e-3)


@each_camera
def test_what_is_no_point_is_not_valid(camera: Camera) -> None:
    nan, inf = math.nan, math.inf
    bad = [[0, 0, 0], [nan, 0, 1], [0, nan, nan], [inf, 0, 1], [0, 0, inf], [0, 0, -1], [1e-30, 0, -1]]
    points = torch.tensor([*bad, [0.0, 0.0, 1.0], [0.1, 0.1, 1.0]])
    pixels, valid = camera.project(points)
    assert valid.tolist() == [False] * len(bad) + [True, True]
    assert pixels[: len(bad)].isnan().all() and pixels[valid].isfinite().all()


@each_camera
def test_what_is_no_pixel_is_not_valid(camera: Camera) -> None:
    bad = [[math.nan, 3.0], [5.0, math.inf], [math.nan, math.nan], [3e38, 3e38], [-1e25, 0.0]]
    pixels = torch.tensor([*bad, [camera.cx, camera.cy], [camera.cx + 9, camera.cy]])
    directions, valid = camera.unproject(pixels)
    assert valid.tolist() == [False] * len(bad) + [True, True]
    assert directions[: len(bad)].isnan().all() and directions[valid].isfinite().all()


# -- the picture, files, errors -----------------------------------------------------------------------------
def test_shapes_and_empty_input() -> None:
    assert IMAGE_02.project(torch.rand(3))[0].shape == (2,)
    assert IMAGE_02.project(torch.rand(2, 5, 3))[1].shape == (2, 5)
    for camera in (IMAGE_02, FISHEYE, Pinhole(6, 4, 5.0, 5.0, 3.0, 2.0)):
        assert camera.project(torch.zeros(0, 3))[0].shape == (0, 2)
        assert camera.unproject(torch.zeros(0, 2))[0].shape == (0, 3)


def test_pixel_centres_and_inside() -> None:
    camera = Pinhole(3, 2, 5.0, 5.0, 1.5, 1.0)
    assert camera.pixel_centres().tolist() == [[[x, y] for x in (0.5, 1.5, 2.5)] for y in (0.5, 1.5)]
    assert camera.pixel_centres(torch.float32).dtype == torch.float32
    assert camera.inside(camera.pixel_centres()).all()
    probes = torch.tensor([[0.0, 0.0], [3.0, 1.0], [2.99, 1.99], [1.0, 2.0], [-0.01, 1.0], [math.nan, 1.0]])
    assert camera.inside(probes).tolist() == [True, False, True, False, False, False]


@each_camera
@pytest.mark.parametrize("factor", [1, 3])
def test_downscaled_projects_to_pixels_over_factor(camera: Camera, factor: int) -> None:
    small = camera.downscaled(factor)
    assert type(small) is type(camera)
    assert (small.width, small.height) == (camera.width // factor, camera.height // factor)
    assert small.theta_max_rad == camera.theta_max_rad
    points = rays(torch.linspace(0, 0.99 * camera.theta_max_rad, 50, dtype=torch.float64))
    torch.testing.assert_close(small.project(points)[0], camera.project(points)[0] / factor, rtol=1e-12, atol=1e-9)


def test_downscaled_refuses_what_leaves_no_picture() -> None:
    for factor in (0, -2, 1401):
        with pytest.raises(InputError, match=rf"{factor}.*1 to 1400"):
            IMAGE_02.downscaled(factor)


@each_camera
def test_cameras_survive_files_and_processes(camera: Camera) -> None:
    parameters = json.loads(json.dumps(camera.to_dict()))
    assert parameters.pop("model") == camera.model and type(camera)(**parameters) == camera
    camera.project(torch.rand(4, 3))  # fills what is computed once
    copy = pickle.loads(pickle.dumps(camera))
    assert copy == camera and hash(copy) == hash(camera)


@pytest.mark.parametrize(
    "camera", [IMAGE_02, FISHEYE, Pinhole(640, 480, 300.0, 300.0, 320.0, 240.0, -0.1, 0.01)], ids=lambda c: c.model
)
def test_no_camera_goes_beyond_what_it_was_calibrated_for(camera: Camera) -> None:
    limited = replace(camera, theta_limit_rad=0.6)
    assert limited.theta_max_rad == pytest.approx(0.6, abs=1e-12)
    assert replace(camera, theta_limit_rad=3.0).theta_max_rad == camera.theta_max_rad
    directions = rays(torch.tensor([0.3, 0.599999, 0.600001, 0.9], dtype=torch.float64))
    pixels, valid = limited.project(directions)
    assert valid.all(-1).tolist() == [True, True, False, False] and not valid[2:].any()
    unlimited, _ = camera.project(directions)
    assert torch.equal(pixels[:2], unlimited[:2])
    assert limited.unproject(unlimited)[1].all(-1).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fy": 0.0}, "fy is 0.0, expected more than 0"),
        ({"width": 0}, "width is 0, expected more than 0"),
        ({"xi": -1.0}, "xi is -1.0, expected more than -1"),
    ],
)
def test_bad_parameters_are_named(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(IMAGE_02, **change)


def test_a_limit_that_is_no_angle_is_refused() -> None:
    for limit in (0.0, -1.0, 3.2):
        with pytest.raises(InputError, match="theta_limit_rad"):
            replace(FISHEYE, theta_limit_rad=limit)


# -- nerfstudio ---------------------------------------------------------------------------------------------
def test_kannala_brandt_is_nerfstudios_fisheye_camera() -> None:
    # half pixels and centres; none on the principal point, where nerfstudio's camera divides zero by zero
    x = torch.arange(0.25, 1400, 12.5, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 2)
    ours, valid = FISHEYE.unproject(pixels)
    kept = valid & (torch.atan2(ours[:, :2].norm(dim=-1), ours[:, 2]) <= math.radians(95))
    assert kept.float().mean() > 0.7
    theirs = nerfstudio_directions(FISHEYE, pixels[kept])
    # their rays are float32: 1e-6 rad is 4e-4 px here
    assert angle(ours[kept], theirs).max() < 2e-6


def test_pinhole_is_nerfstudios_perspective_camera() -> None:
    pixels = PINHOLE.pixel_centres()[::5, ::5].reshape(-1, 2)
    ours, valid = PINHOLE.unproject(pixels)
    assert valid.all()
    theirs = nerfstudio_directions(PINHOLE, pixels)
    assert angle(ours, theirs).max() < 2e-6
