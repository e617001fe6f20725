"""Patterns of turning scanners: known ones, and those found from scans."""

import numpy as np
import pytest
import torch

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.lidar.patterns import SENSORS, ScanPattern, pattern_of_scan, rings_of
from edge_depth_nerf.lidar.sweeps import SweepTiming

ELEVATION = np.radians([12.0, 7.0, 3.0, 0.5, -2.0, -6.0, -11.0, -16.0])


def pattern(clockwise: bool = True, reference_rad: float = 0.0) -> ScanPattern:
    return ScanPattern("test", ELEVATION, 360, 80.0, SweepTiming(0.1, clockwise, reference_rad))


def scan(of: ScanPattern, ring_by_ring: bool, lost: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """Points at 9 to 60 m with beams that leave the scanner up to 4 cm above its centre; and their rings."""
    rng = np.random.default_rng(0)
    distance = rng.uniform(9, 60, of.directions.shape[:2])
    points = of.directions * distance[..., None]
    points[..., 2] += np.linspace(0.04, 0, len(of.elevation_rad))[:, None]
    ring = np.broadcast_to(np.arange(len(points))[:, None], distance.shape)
    kept = rng.random(distance.shape) > lost
    if ring_by_ring:
        return points[kept], ring[kept]
    return points.swapaxes(0, 1)[kept.T], ring.T[kept.T]


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("ring_by_ring", [True, False])
def test_rings_and_pattern_are_found_in_both_orders_of_a_file(clockwise, ring_by_ring):
    true = pattern(clockwise, reference_rad=np.pi)
    points, ring = scan(true, ring_by_ring)
    np.testing.assert_array_equal(rings_of(points, "a scan"), ring)
    found = pattern_of_scan(points, ring, true.timing, "a scan")
    np.testing.assert_allclose(found.elevation_rad, ELEVATION, atol=np.radians(0.1))
    assert found.firings == 360 and found.timing is true.timing
    assert found.reach_m == pytest.approx(np.linalg.norm(points, axis=1).max())


def test_a_ring_that_begins_anywhere_is_one_ring():
    points, ring = scan(pattern(), ring_by_ring=True, lost=0.0)
    rolled = np.concatenate([np.roll(points[ring == each], 100, axis=0) for each in range(len(ELEVATION))])
    np.testing.assert_array_equal(rings_of(rolled, "a scan"), ring)


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("reference_rad", [0.0, np.pi, -1.2])
def test_firings_have_the_times_of_their_azimuths(clockwise, reference_rad):
    of = pattern(clockwise, reference_rad)
    points = 10 * of.directions.reshape(-1, 3)
    np.testing.assert_array_equal(of.columns(points), np.tile(np.arange(360), len(ELEVATION)))
    by_azimuth = of.timing.offsets_s(torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(by_azimuth, np.tile(of.offset_s, len(ELEVATION)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(of.directions, axis=-1), 1, atol=1e-12)
    assert (np.diff(of.offset_s) > 0).all()


def test_points_in_all_directions_have_no_rings():
    rays = np.random.default_rng(0).normal(size=(4000, 3))
    with pytest.raises(InputError, match=r"a.bin: the rings of its 4000 points .* --sensor hdl-64"):
        rings_of(10 * rays, "a.bin")


def test_one_ring_is_no_pattern():
    points, ring = scan(pattern(), ring_by_ring=True)
    with pytest.raises(InputError, match="cannot be told apart"):
        rings_of(points[ring == 3], "a.bin")


def test_known_scanners_are_those_of_the_data_sheets():
    sheets = {"hdl-64": (64, 2.0, -24.33), "vlp-16": (16, 15.0, -15.0), "os1-128": (128, 22.5, -22.5)}
    for name, (rings, highest, lowest) in sheets.items():
        elevation = np.degrees(SENSORS[name].elevation_rad)
        assert len(elevation) == rings and (np.diff(elevation) < 0).all()
        assert (elevation[0], elevation[-1]) == pytest.approx((highest, lowest))
