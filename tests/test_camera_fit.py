"""The Kannala-Brandt camera fitted to KITTI-360's, alone and as nerfstudio takes it."""

import functools
import math
from dataclasses import replace

import pytest
import torch
from lenses import FISHEYE, IMAGE_02, IMAGE_03, KITTI, nerfstudio_directions, rays

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole, fit_kannala_brandt, host_residual

fitted = functools.cache(fit_kannala_brandt)


@pytest.mark.parametrize(("camera", "rms_px", "max_px"), [(IMAGE_02, 0.012, 0.07), (IMAGE_03, 0.033, 0.16)])
def test_kitti_360_is_fitted_to_95_degrees(camera: MEI, rms_px: float, max_px: float) -> None:
    fit = fitted(camera)
    assert fit.rms_px < rms_px
    assert fit.max_px < max_px
    assert math.degrees(fit.theta_max_rad) == pytest.approx(95)
    assert fit.camera.theta_max_rad == fit.theta_max_rad
    assert (fit.camera.width, fit.camera.height) == (1400, 1400)
    # what is reported holds for rays between those of the grid, all over the picture
    directions = rays(torch.linspace(0, fit.theta_max_rad, 500, dtype=torch.float64), 180)
    pixels, _ = camera.project(directions)
    replaced, valid = fit.camera.project(directions)
    assert valid.all()
    distance = (replaced - pixels).norm(dim=-1)[camera.inside(pixels)]
    assert distance.max() == pytest.approx(fit.max_px, rel=0.1)


@pytest.mark.parametrize("camera", KITTI)
def test_kitti_360_through_nerfstudios_camera(camera: MEI) -> None:
    """The whole way: nerfstudio's own rays for the fitted parameters against the lens as calibrated."""
    fit = fitted(camera).camera
    distance = host_error_px(camera, fit, math.radians(95))
    assert len(distance) > 0.7 * (1400 / 6) ** 2
    assert distance.square().mean().sqrt() < 0.035
    assert distance.max() < 0.16


def test_the_tangential_terms_are_needed() -> None:
    # without p1, p2 in the lens the fit finds next to none; with them it finds the like of them
    without = fit_kannala_brandt(replace(IMAGE_03, p1=0.0, p2=0.0)).camera
    assert abs(without.p1) < 1e-6 and abs(without.p2) < 1e-6
    camera = fitted(IMAGE_03).camera
    assert camera.p1 > 1e-4 and camera.p2 < -1e-4
    directions = rays(torch.linspace(0, math.radians(95), 200, dtype=torch.float64))
    error = IMAGE_03.project(directions)[0] - replace(camera, p1=0.0, p2=0.0).project(directions)[0]
    assert error.norm(dim=-1).max() > 1.0


@pytest.mark.parametrize(
    "camera", [FISHEYE, KannalaBrandt(800, 600, 250.0, 251.0, 401.0, 299.0, -0.08, 0.0, 0.0, 1e-5, 0.003, 0.01)]
)
def test_a_kannala_brandt_camera_is_found_again(camera: KannalaBrandt) -> None:
    fit = fit_kannala_brandt(camera, math.radians(90))
    assert fit.max_px < 1e-9
    for name, value in camera.to_dict().items():
        if isinstance(value, float) and name != "theta_limit_rad":
            assert getattr(fit.camera, name) == pytest.approx(value, rel=1e-8, abs=1e-9), name


def test_the_residual_scales_with_the_picture() -> None:
    full, small = fitted(IMAGE_02), fit_kannala_brandt(IMAGE_02.downscaled(4))
    assert small.rms_px == pytest.approx(full.rms_px / 4, rel=1e-3)
    assert small.camera.fx == pytest.approx(full.camera.fx / 4, rel=1e-6)
    assert small.camera.k3 == pytest.approx(full.camera.k3, rel=1e-4)


def test_a_smaller_angle_is_fitted_closer() -> None:
    errors = [fit_kannala_brandt(IMAGE_03, math.radians(degrees)).rms_px for degrees in (60, 80, 95)]
    assert errors == sorted(errors)
    assert errors[0] < 0.2 * errors[2]


def test_the_limit_is_what_the_picture_sees() -> None:
    # a long lens: the corner lies at atan(√(320² + 240²)/2000) = atan(0.2) = 11.309932°
    fit = fit_kannala_brandt(Pinhole(640, 480, 2000.0, 2000.0, 320.0, 240.0))
    assert math.degrees(fit.theta_max_rad) == pytest.approx(11.309932, abs=1e-6)
    assert fit.max_px < 1e-6
    # tan θ = θ + θ³/3 + ...
    assert fit.camera.k1 == pytest.approx(1 / 3, abs=1e-3)


@pytest.mark.parametrize(
    ("camera", "degrees", "message"),
    [
        (IMAGE_02, 0.0, "theta_max_rad is 0.0, expected more than 0"),
        (IMAGE_02, math.nan, "theta_max_rad is nan, expected more than 0"),
        (replace(IMAGE_02, cx=1e5), 95.0, "only 0 of 22500 pixels sampled in the picture of 1400x1400"),
        (IMAGE_03, 113.0, r"no rising Kannala-Brandt polynomial .* MEI camera .*Fit up to a smaller angle"),
        (Pinhole(640, 480, 30.0, 30.0, 320.0, 240.0), 95.0, "PINHOLE camera .*Fit up to a smaller angle"),
    ],
)
def test_what_cannot_be_fitted_is_said(camera: Camera, degrees: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        fit_kannala_brandt(camera, math.radians(degrees))


# ---- nerfstudio's rays up to 110° ------------------------------------------------------------------------------
def filling(camera: Camera, degrees: float) -> Camera:
    """The camera with focal lengths that put this angle at 0.48 of the picture's width from its middle."""
    theta = min(math.radians(degrees), 0.999 * camera.theta_max_rad)
    pixels, _ = camera.project(torch.tensor([[math.sin(theta), 0.0, math.cos(theta)]], dtype=torch.float64))
    scale = 0.48 * camera.width / (float(pixels[0, 0]) - camera.cx)
    return replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)


def mei(xi: float, degrees: float) -> Camera:
    return filling(MEI(1000, 1000, 1.0, 1.0, 500.3, 499.8, xi, 0.0, 0.0, 0.0, 0.0), degrees)


def kannala_brandt(degrees: float, *coefficients: float) -> Camera:
    return filling(KannalaBrandt(1000, 1000, 1.0, 1.0, 500.3, 499.8, *coefficients), degrees)


def host_error_px(camera: Camera, replacement: KannalaBrandt | Pinhole, limit_rad: float) -> torch.Tensor:
    """How far from its pixel the camera sees the ray that nerfstudio itself generates; infinite if it does not."""
    pixels = camera.pixel_centres()[::6, ::6].reshape(-1, 2)
    true, valid = camera.unproject(pixels)
    kept = valid & (torch.atan2(true[:, :2].norm(dim=-1), true[:, 2]) <= limit_rad)
    assert kept.float().mean() > 0.1
    seen, visible = camera.project(nerfstudio_directions(replacement, pixels[kept]))
    return torch.where(visible, (seen - pixels[kept]).norm(dim=-1), math.inf)


@pytest.mark.parametrize(
    ("camera", "degrees"),
    [
        # a MEI with ξ = 0 is a pinhole; with ξ < 1 its picture grows faster than a polynomial of θ can follow
        pytest.param(mei(0.0, 60), 60, id="xi=0"),
        pytest.param(mei(0.5, 95), 95, id="xi=0.5"),
        pytest.param(mei(1.0, 110), 110, id="xi=1"),
        pytest.param(mei(1.5, 110), 110, id="xi=1.5"),
        pytest.param(mei(2.5, 110), 110, id="xi=2.5"),
        pytest.param(Pinhole(1000, 700, 700.0, 705.0, 503.3, 349.8, -0.12, 0.02, 1e-3, -5e-4), 95, id="pinhole"),
    ],
)
def test_a_fitted_camera_gives_nerfstudio_the_right_rays(camera: Camera, degrees: float) -> None:
    limit = min(math.radians(degrees), 0.999 * camera.theta_max_rad)
    replacement = fit_kannala_brandt(camera, limit).camera
    reported, wrong = host_residual(camera, replacement, limit)
    error = host_error_px(camera, replacement, limit)
    assert error.square().mean().sqrt() == pytest.approx(reported.rms_px, rel=0.05, abs=5e-4)
    assert reported.rms_px < 0.5 and (wrong == math.inf) == (reported.max_px < 0.5)


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param(kannala_brandt(110, 0.0, 0.0, 0.0, 0.0), id="equidistant"),
        pytest.param(kannala_brandt(110, 1 / 12, 1 / 120, 17 / 20160, 31 / 362880), id="stereographic"),
        pytest.param(kannala_brandt(110, -1 / 24, 1 / 1920, -1 / 322560, 0.0), id="equisolid"),
        pytest.param(kannala_brandt(110, -0.08, 0.0, 0.0, 0.0, 1e-3, -5e-4), id="folds at 117°"),
    ],
)
def test_a_kannala_brandt_camera_gives_nerfstudio_the_right_rays(camera: KannalaBrandt) -> None:
    limit = math.radians(110)
    assert host_error_px(camera, camera, limit).max() < 2e-3  # their rays are float32
    fit, wrong = host_residual(camera, camera, limit)
    assert fit.max_px < 1e-6 and wrong == math.inf
    assert math.degrees(fit.theta_max_rad) == pytest.approx(110)


def test_where_nerfstudio_goes_astray_is_told() -> None:
    """A polynomial that first rises faster, then slower: Newton's steps from the distorted point overshoot its fold."""
    camera = kannala_brandt(106, 0.0652, 0.0189, -0.0042, -0.0013)
    assert isinstance(camera, KannalaBrandt)
    fit, wrong = host_residual(camera, camera, math.radians(105))
    assert fit.rms_px == math.inf and 85 < math.degrees(wrong) < 95
    assert host_error_px(camera, camera, math.radians(105)).max() > 10
    # up to there all is well, for us and for nerfstudio
    assert host_residual(camera, camera, wrong - 0.01)[0].max_px < 1e-6
    assert host_error_px(camera, camera, wrong - 0.01).max() < 2e-3
