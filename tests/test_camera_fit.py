"""The Kannala-Brandt camera fitted to KITTI-360's, alone and as nerfstudio takes it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from lenses import FISHEYE, IMAGE_02, IMAGE_03, KITTI, nerfstudio_directions, rays

from edge_depth_nerf.cameras import MEI, Camera, KannalaBrandt, Pinhole, fit_kannala_brandt
from edge_depth_nerf.errors import InputError


@pytest.mark.parametrize(("camera", "rms_px", "max_px"), [(IMAGE_02, 0.012, 0.07), (IMAGE_03, 0.033, 0.16)])
def test_kitti_360_is_fitted_to_95_degrees(camera: MEI, rms_px: float, max_px: float) -> None:
    fit = fit_kannala_brandt(camera)
    assert fit.rms_px < rms_px
    assert fit.max_px < max_px
    assert math.degrees(fit.theta_max_rad) == pytest.approx(95)
    assert fit.camera.theta_max_rad == fit.theta_max_rad
    assert (fit.camera.width, fit.camera.height) == (1400, 1400)
    # what is reported holds for rays between those of the grid, all over the picture
    directions = rays(torch.linspace(0, fit.theta_max_rad, 500, dtype=torch.float64), 180)
    pixels, _ = camera.project(directions)
    fitted, valid = fit.camera.project(directions)
    assert valid.all()
    distance = (fitted - pixels).norm(dim=-1)[camera.inside(pixels)]
    assert distance.max() == pytest.approx(fit.max_px, rel=0.1)


@pytest.mark.parametrize("camera", KITTI)
def test_kitti_360_through_nerfstudios_camera(camera: MEI) -> None:
    """The whole way: nerfstudio's own rays for the fitted parameters against the lens as calibrated."""
    fit = fit_kannala_brandt(camera).camera
    x = torch.arange(0.25, 1400, 10.25, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 2)
    true, valid = camera.unproject(pixels)
    kept = valid & (torch.atan2(true[:, :2].norm(dim=-1), true[:, 2]) <= math.radians(95))
    assert kept.float().mean() > 0.7
    parameters = {name: getattr(fit, name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
    theirs = nerfstudio_directions(fit, "FISHEYE", parameters, pixels[kept])
    back, seen = camera.project(theirs)
    assert seen.all()
    distance = (back - pixels[kept]).norm(dim=-1)
    assert distance.square().mean().sqrt() < 0.035
    assert distance.max() < 0.16


def test_the_tangential_terms_are_needed() -> None:
    # without p1, p2 in the lens the fit finds next to none; with them it finds the like of them
    without = fit_kannala_brandt(replace(IMAGE_03, p1=0.0, p2=0.0)).camera
    assert abs(without.p1) < 1e-6 and abs(without.p2) < 1e-6
    camera = fit_kannala_brandt(IMAGE_03).camera
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
    full, small = fit_kannala_brandt(IMAGE_02), fit_kannala_brandt(IMAGE_02.downscaled(4))
    assert small.rms_px == pytest.approx(full.rms_px / 4, rel=1e-3)
    assert small.camera.fx == pytest.approx(full.camera.fx / 4, rel=1e-6)
    assert small.camera.k3 == pytest.approx(full.camera.k3, rel=1e-4)


def test_a_smaller_angle_is_fitted_closer() -> None:
    errors = [fit_kannala_brandt(IMAGE_03, math.radians(degrees)).rms_px for degrees in (60, 80, 95, 105)]
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


def test_the_constants_are_kitti_360s_own(real_data: Path) -> None:
    for name, camera in (("image_02", IMAGE_02), ("image_03", IMAGE_03)):
        storage = cv2.FileStorage(str(real_data / "kitti360_calibration" / f"{name}.yaml"), cv2.FILE_STORAGE_READ)
        mirror, distortion = storage.getNode("mirror_parameters"), storage.getNode("distortion_parameters")
        projection = storage.getNode("projection_parameters")
        assert camera == MEI(
            int(storage.getNode("image_width").real()),
            int(storage.getNode("image_height").real()),
            projection.getNode("gamma1").real(),
            projection.getNode("gamma2").real(),
            projection.getNode("u0").real() + 0.5,
            projection.getNode("v0").real() + 0.5,
            mirror.getNode("xi").real(),
            *(distortion.getNode(key).real() for key in ("k1", "k2", "p1", "p2")),
        )
