"""Sweeps and their projection."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from edge_depth_nerf.cameras import MEI, Pinhole
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.lidar.scans import ScanFormat, read_scan

FISHEYE = MEI(70, 70, 66.8, 66.8, 35.9, 35.3, 2.2134, 0.0168, 1.6549, 4e-4, 4e-4)
PINHOLE = Pinhole(20, 10, 10.0, 10.0, 10.0, 5.0)


def write(path: Path, rows: list[list[float]]) -> Path:
    path.write_bytes(np.array(rows, "<f4").tobytes())
    return path


def test_reads_points_and_reflectance_in_order(tmp_path: Path) -> None:
    sweep = read_scan(write(tmp_path / "a.bin", [[1, 2, 3, 0.25], [-4, 5, -6, 1.0]]), ScanFormat())
    assert sweep.points_m.dtype == torch.float64
    assert sweep.points_m.tolist() == [[1, 2, 3], [-4, 5, -6]]
    assert sweep.reflectance.tolist() == [0.25, 1.0]
    assert (sweep.not_finite, sweep.out_of_range) == (0, 0)


def test_leaves_out_and_counts_what_is_no_point(tmp_path: Path) -> None:
    rows = [[1, 0, 0], [math.nan, 0, 0], [0, -math.inf, 0], [0, 0, 0], [0.2, 0.2, 0.2], [300, 0, 0], [0, 0, 9]]
    sweep = read_scan(write(tmp_path / "a.bin", [[*row, 0] for row in rows]), ScanFormat())
    assert sweep.points_m.tolist() == [[1, 0, 0], [0, 0, 9]]
    assert (sweep.not_finite, sweep.out_of_range) == (2, 3)
    with pytest.raises(FileNotFoundError, match=r"b\.bin"):
        read_scan(tmp_path / "b.bin", ScanFormat())


def test_transform_points() -> None:
    # a quarter turn about z, then 1 m along x: (1, 0, 2) -> (0, 1, 2) -> (1, 1, 2)
    a_to_b = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    there = transform_points(a_to_b, torch.tensor([[1.0, 0, 2], [0, 0, 0]], dtype=torch.float64))
    assert there.tolist() == [[1, 1, 2], [1, 0, 0]]
    assert transform_points(torch.linalg.inv(a_to_b), there)[0].tolist() == [1, 0, 2]


def test_projects_to_the_pixel_that_holds_the_point() -> None:
    # x = 10 · 0.25 / 2 + 10 = 11.25, y = 10 · -0.5 / 2 + 5 = 2.5: column 11, row 2; |(0.25, -0.5, 2)| = 2.0767
    seen = project_points(torch.tensor([[0.25, -0.5, 2.0]], dtype=torch.float64), PINHOLE)
    assert torch.nonzero(seen.distance_m).tolist() == [[2, 11]]
    assert seen.distance_m[2, 11].item() == pytest.approx(math.sqrt(0.0625 + 0.25 + 4))
    assert seen.point_index[2, 11] == 0
    assert (seen.point_index >= 0).sum() == 1


def test_nearest_surface_wins_and_on_it_the_point_nearest_to_the_centre() -> None:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(4000, 3, generator=generator, dtype=torch.float64)
    points = directions * (4.0 + 2 * torch.rand(4000, 1, generator=generator, dtype=torch.float64))
    seen = project_points(points, FISHEYE)
    # the same by plain loops
    lidar_points: dict[tuple[int, int], list[tuple[float, float]]] = {}
    pixels, valid = FISHEYE.project(points)
    for (x, y), point, usable in zip(pixels.tolist(), points.tolist(), valid.tolist(), strict=True):
        if usable and 0 <= x < 70 and 0 <= y < 70:
            off_centre = math.hypot(x % 1 - 0.5, y % 1 - 0.5)
            lidar_points.setdefault((int(y), int(x)), []).append((off_centre, math.hypot(*point)))
    expected = np.zeros((70, 70))
    for pixel, found in lidar_points.items():
        limit = 1.1 * min(distance for _, distance in found)
        expected[pixel] = min(entry for entry in found if entry[1] <= limit)[1]
    assert np.count_nonzero(expected) > 500
    np.testing.assert_allclose(seen.distance_m.numpy(), expected, rtol=1e-14)

    order = torch.randperm(4000, generator=generator)
    permuted = project_points(points[order], FISHEYE)
    assert torch.equal(permuted.distance_m, seen.distance_m)
    hit = seen.point_index >= 0
    assert torch.equal(hit, seen.distance_m > 0)
    assert torch.equal(order[permuted.point_index[hit]], seen.point_index[hit])


def test_what_is_behind_never_shows_through() -> None:
    # one pixel: a pole at 5 m in its corner, a wall at 9 m in its middle
    middle = torch.tensor([0.05, 0.05, 1.0], dtype=torch.float64)
    corner = torch.tensor([0.002, 0.002, 1.0], dtype=torch.float64)
    seen = project_points(torch.stack((9 * middle, 5 * corner)), PINHOLE)
    assert seen.point_index.max() == 1 and (seen.point_index >= 0).sum() == 1
    # on one slanted surface the middle is the better measurement of the pixel
    seen = project_points(torch.stack((5.4 * middle, 5 * corner)), PINHOLE)
    assert seen.point_index.max() == 0


def test_of_equal_points_the_first_counts() -> None:
    points = torch.tensor([[0.0, 0, 9], [0, 0, 3], [0, 0, 3]], dtype=torch.float64)
    assert project_points(points, PINHOLE).point_index.max() == 1


def test_indices_name_the_points_and_distances_scale_with_them() -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    one, four = project_points(points, FISHEYE), project_points(4 * points, FISHEYE)
    torch.testing.assert_close(four.distance_m, 4 * one.distance_m)
    assert torch.equal(one.point_index, four.point_index)
    hit = one.point_index >= 0
    assert torch.equal(points[one.point_index[hit]].norm(dim=-1), one.distance_m[hit])


def test_sees_beside_and_behind_but_nothing_folds_back() -> None:
    def seen(theta_deg: float) -> int:
        theta = math.radians(theta_deg)
        phi = torch.linspace(0, 2 * math.pi, 50, dtype=torch.float64)
        ring = torch.stack((math.sin(theta) * phi.cos(), math.sin(theta) * phi.sin(), 0 * phi), -1)
        ring[:, 2] = math.cos(theta)
        return int((project_points(5 * ring, FISHEYE).distance_m > 0).sum())

    assert seen(92) > 30, "z < 0 is within the lens"
    # MEI's formula alone would put these into the picture: its range ends at arccos(-1/2.2134) = 117°
    assert seen(120) == seen(150) == seen(179) == 0


def test_no_points_no_points() -> None:
    seen = project_points(torch.empty(0, 3, dtype=torch.float64), PINHOLE)
    assert seen.distance_m.shape == (10, 20)
    assert not seen.distance_m.any()
    assert (seen.point_index == -1).all()
