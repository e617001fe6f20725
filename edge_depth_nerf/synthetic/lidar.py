"""A Velodyne HDL-64E on the moving car: one sweep a frame, each firing from the pose of its own time.

Frames: velodyne (x forward, y left, z up), world (z up); metres, seconds. 64 beams from +2° to -24.8°; 0.2° of azimuth
between firings, clockwise seen from above. A sweep begins and ends facing backwards; at the frame's time the laser
faces forwards. A firing at azimuth a (counter-clockwise from x) happens at -a/360° of a turn after it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S, Drive
from edge_depth_nerf.synthetic.render import World
from edge_depth_nerf.synthetic.rig import VELO_TO_POSE


@dataclass(frozen=True)
class Scanner:
    """A turning scanner: clockwise, a turn a frame, beginning and ending backwards."""

    elevation_rad: NDArray[np.float64]
    """Elevations of its beams."""
    azimuth_rad: NDArray[np.float64]
    """Azimuths in the order of firing, counter-clockwise from its x axis."""
    to_pose: NDArray[np.float64]
    """4×4, from its frame (x forward, y left, z up) to the vehicle's."""

    @staticmethod
    def turning(top_deg: float, bottom_deg: float, beams: int, firings: int, to_pose: NDArray[np.float64]) -> Scanner:
        """A scanner whose beams lie evenly between two elevations, and its firings evenly on a turn."""
        # half a step off the rear, so that no firing lies on the seam of ±180°
        azimuth_rad = np.deg2rad(180.0 - (np.arange(firings) + 0.5) * 360.0 / firings)
        return Scanner(np.deg2rad(np.linspace(top_deg, bottom_deg, beams)), azimuth_rad, to_pose)

    @property
    def offset_s(self) -> NDArray[np.float64]:
        """When each firing happens, counted from the time that the laser faces forwards."""
        return -self.azimuth_rad / (2 * np.pi) * FRAME_INTERVAL_S


HDL_64E = Scanner.turning(2.0, -24.8, 64, 1800, VELO_TO_POSE)
"""KITTI-360's scanner."""

RANGE_M = (0.9, 80.0)
"""Nearest and farthest point."""

RANGE_NOISE_M = 0.02
"""Standard deviation of the range."""

DROPOUT = 0.05
"""Share of LiDAR points that are lost."""


@dataclass(frozen=True)
class Sweep:
    """N points in the order of firing, beam by beam."""

    raw: NDArray[np.float32]
    """N×4: x, y, z in the scanner's frame at the firing's own time, with range noise; reflectance in 0-1."""
    offset_s: NDArray[np.float64]
    """N: when each was measured, counted from the sweep's time."""
    deskewed: NDArray[np.float32]
    """N×4: the same points without noise, in the scanner's frame at the sweep's time; reflectance.

    Only the recording car's own motion is taken out: a car that drives stays where each firing met it.
    """


def sweep(world: World, drive: Drive, time_s: float, rng: Generator, scanner: Scanner = HDL_64E) -> Sweep:
    """Take the sweep that faces forwards at `time_s`."""
    offset_s, azimuth = scanner.offset_s, scanner.azimuth_rad[:, None]
    velo_to_world = drive.pose_to_world(time_s + offset_s) @ scanner.to_pose
    cos, sin = np.cos(scanner.elevation_rad), np.sin(scanner.elevation_rad)
    directions = np.stack(np.broadcast_arrays(np.cos(azimuth) * cos, np.sin(azimuth) * cos, sin), -1)
    world_directions = np.einsum("fij,fbj->fbi", velo_to_world[:, :3, :3], directions).reshape(-1, 3)
    world_origins = np.repeat(velo_to_world[:, :3, 3], len(cos), axis=0)
    times = np.repeat(time_s + offset_s, len(cos))
    origins, rays = world_origins.astype(np.float32), world_directions.astype(np.float32)
    hits = world.trace(origins, rays, times)
    echo = world.laser_echo(origins, rays, hits, times)
    range_m = hits.distance_m.astype(np.float64)
    # drawn for every ray, so that one ray's fate does not depend on the others'
    noise, fate = rng.normal(0, RANGE_NOISE_M, len(range_m)), rng.random(len(range_m))
    seen = (range_m >= RANGE_M[0]) & (range_m <= RANGE_M[1]) & (fate >= DROPOUT)
    range_m, noise = range_m[seen], noise[seen]
    raw = directions.reshape(-1, 3)[seen] * (range_m + noise)[:, None]
    points = world_origins[seen] + world_directions[seen] * range_m[:, None]
    world_to_velo = np.linalg.inv(drive.pose_to_world(np.array([time_s]))[0] @ scanner.to_pose)
    deskewed = points @ world_to_velo[:3, :3].T + world_to_velo[:3, 3]
    # the sensor counts reflectance in steps of 1/100
    reflectance = np.round(np.clip(echo[seen], 0, 0.99), 2)
    return Sweep(
        np.column_stack((raw, reflectance)).astype(np.float32),
        np.repeat(offset_s, len(cos))[seen],
        np.column_stack((deskewed, reflectance)).astype(np.float32),
    )
