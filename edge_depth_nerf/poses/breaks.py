"""Where a path cannot be a vehicle's: it would have to brake, speed up, swerve or turn faster than wheels let it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from edge_depth_nerf.lidar.trajectory import Trajectory

MOST_M_S2 = 10.0
"""Tyres on dry asphalt hold about as much as the vehicle weighs, in any direction."""
MOST_RAD_S = math.radians(120)
"""A car on its smallest circle turns by 40° a second, a robot on the spot by 90°."""
_WINDOW_S = 0.5
"""Velocities are taken over so long, or from one pose to the next where these are further apart."""
_JITTER_M = 0.1
"""Places may be wrong by this much without a break."""
_JITTER_RAD = math.radians(2)


@dataclass(frozen=True)
class Break:
    """A place where a path breaks."""

    first: int
    """Index of the pose where the time looked at begins."""
    last: int
    """Index of the pose where it ends."""
    what: str
    """What the vehicle would have to do there."""


def find_break(path: Trajectory) -> Break | None:
    """Find where a path is furthest from what a vehicle can do; None if it is nowhere beyond it."""
    times, poses = path.times_s, path.vehicle_to_world
    found: list[tuple[float, Break]] = []
    for middle in range(1, len(times) - 1):
        first = int(np.searchsorted(times, times[middle] - _WINDOW_S - 1e-9))
        last = int(np.searchsorted(times, times[middle] + _WINDOW_S + 1e-9)) - 1
        first, last = min(first, middle - 1), max(last, middle + 1)
        before_s, after_s = float(times[middle] - times[first]), float(times[last] - times[middle])
        before = (poses[middle, :3, 3] - poses[first, :3, 3]) / before_s
        after = (poses[last, :3, 3] - poses[middle, :3, 3]) / after_s
        apart_s = (before_s + after_s) / 2
        change = float(np.linalg.norm(after - before))
        excess = change / (MOST_M_S2 * apart_s + 2 * _JITTER_M / min(before_s, after_s))
        what = (
            f"within {apart_s:.2g} s the vehicle would go from {np.linalg.norm(before):.1f} to "
            f"{np.linalg.norm(after):.1f} m/s and turn its course by {_angle_deg(before, after):.0f}°"
        )
        found.append((excess, Break(first, last, what)))
        turned = Rotation.from_matrix(poses[first, :3, :3].T @ poses[middle, :3, :3]).magnitude()
        excess = float(turned) / (MOST_RAD_S * before_s + _JITTER_RAD)
        what = f"within {before_s:.2g} s the vehicle would turn by {math.degrees(turned):.0f}°"
        found.append((excess, Break(first, middle, what)))
    excess, worst = max(found, key=lambda each: each[0], default=(0.0, None))
    return worst if excess > 1 else None


def _angle_deg(before: np.ndarray, after: np.ndarray) -> float:
    lengths = float(np.linalg.norm(before) * np.linalg.norm(after))
    return math.degrees(math.acos(np.clip(float(before @ after) / lengths, -1, 1))) if lengths > 0 else 0.0
