"""Rays read from the table of a lens against nerfstudio's own."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.ray_generators import RayGenerator

from edge_depth_nerf.plugin import ray_table
from edge_depth_nerf.plugin.ray_table import KEPT_VIEWS, TableRayGenerator, ViewRays


def cameras(kind: CameraType = CameraType.FISHEYE, **extra) -> Cameras:
    """Five cameras with two lenses of different sizes, turned and moved."""
    generator = torch.Generator().manual_seed(0)
    turned, _ = torch.linalg.qr(torch.randn(5, 3, 3, generator=generator))
    second = torch.tensor([0, 1, 0, 1, 1])[:, None]
    return Cameras(
        camera_to_worlds=torch.cat([turned, torch.randn(5, 3, 1, generator=generator)], dim=-1),
        fx=20.0 + 3 * second,
        fy=21.0 + second,
        cx=15.5 + second,
        cy=14.0 + second,
        width=32 + 4 * second,
        height=28 + 2 * second,
        distortion_params=torch.tensor([0.02, -0.004, 0.0, 0.0, 1e-3, 2e-3]) * (1 + second),
        camera_type=kind,
        **extra,
    )


@pytest.mark.parametrize("kind", [CameraType.FISHEYE, CameraType.PERSPECTIVE])
def test_rays_of_the_table_are_nerfstudios(tmp_path, kind, monkeypatch):
    given = cameras(kind)
    assert TableRayGenerator.suits(given)
    indices = torch.stack([torch.randint(5, (300,)), torch.randint(28, (300,)), torch.randint(32, (300,))], dim=-1)
    indices[:2] = torch.tensor([[1, 29, 35], [0, 27, 31]])  # last pixels
    expected = RayGenerator(given)(indices)
    made = TableRayGenerator(given, tmp_path / "rays")
    assert len(list(tmp_path.rglob("*.npy"))) == 1
    monkeypatch.setattr("edge_depth_nerf.plugin.ray_table._make", lambda *_: pytest.fail("made again"))
    for generator in (made, TableRayGenerator(given, tmp_path / "rays")):
        assert_the_same(generator(indices), expected)


def test_a_pixel_that_is_not_there(tmp_path):
    generator = TableRayGenerator(cameras(), tmp_path / "rays")
    assert len(generator(torch.zeros(0, 3, dtype=torch.long))) == 0
    for indices in ([0, 1000, 0], [0, -5, 0], [5, 0, 0]):
        with pytest.raises(IndexError):
            generator(torch.tensor([[0, 0, 0], indices]))


def test_a_table_of_rays_that_cannot_be_kept_stays_in_memory(tmp_path):
    given = cameras()
    expected = TableRayGenerator(given, tmp_path / "rays").table
    (tmp_path / "file").write_text("in the way")
    assert torch.equal(TableRayGenerator(given, tmp_path / "file").table, expected)


def test_cameras_without_a_table(monkeypatch):
    assert not TableRayGenerator.suits(cameras(CameraType.EQUIRECTANGULAR))
    assert not TableRayGenerator.suits(cameras(times=torch.zeros(5, 1)))
    monkeypatch.setattr("edge_depth_nerf.plugin.ray_table.MOST_PIXELS", 1000)
    assert not TableRayGenerator.suits(cameras())


def assert_the_same(rays: RayBundle, expected: RayBundle) -> None:
    assert rays.shape == expected.shape
    assert rays.camera_indices is not None and expected.camera_indices is not None
    assert torch.equal(rays.origins, expected.origins) and torch.equal(rays.camera_indices, expected.camera_indices)
    torch.testing.assert_close(rays.directions, expected.directions, rtol=0, atol=3e-7)
    torch.testing.assert_close(rays.pixel_area, expected.pixel_area, rtol=2e-4, atol=0)
    assert rays.metadata.keys() == expected.metadata.keys()
    for name, values in expected.metadata.items():
        torch.testing.assert_close(rays.metadata[name], values)


@pytest.mark.parametrize("kind", [CameraType.FISHEYE, CameraType.PERSPECTIVE])
def test_rays_of_views_are_nerfstudios_and_those_of_a_lens_are_made_once(kind, monkeypatch):
    made, make = [], ray_table._make

    def counted(lenses: torch.Tensor, advance: Callable[[int], object]) -> np.ndarray:
        made.append(len(lenses))
        return make(lenses, advance)

    monkeypatch.setattr(ray_table, "_make", counted)
    views, given = ViewRays(), cameras(kind)
    for _ in range(2):
        for number in range(5):
            camera = given[number : number + 1]
            assert_the_same(views.of(camera), camera.generate_rays(camera_indices=0, keep_shape=True))
    assert made == [1, 1]


@pytest.mark.parametrize("extra", [{"times": torch.zeros(5, 1)}, {"metadata": {"of_it": torch.ones(5, 1)}}])
def test_rays_of_a_view_without_a_table_are_nerfstudios_own(extra, monkeypatch):
    monkeypatch.setattr(ray_table, "_make", lambda *_: pytest.fail("made a table"))
    camera = cameras(**extra)[1:2]
    rays, expected = ViewRays().of(camera), camera.generate_rays(camera_indices=0, keep_shape=True)
    assert_the_same(rays, expected)
    assert torch.equal(rays.directions, expected.directions)


def test_no_more_lenses_are_kept_than_is_said():
    views, given = ViewRays(), cameras()[:1]
    for number in range(KEPT_VIEWS + 3):
        given.fx = given.fx + number
        views.of(given)
    assert views._of_lens.cache_info().currsize == KEPT_VIEWS
