"""What moves in the scene `traffic`: cars that pass, one that stops and starts again, a bus, people on foot, a cyclist.

All of it is laid out in shares of the drive's length in time, so that each is met during the drive, however long that
is. World frame: the road runs along x, the recording car in the lane at y < 0, towards positive x.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from edge_depth_nerf.synthetic import objects, road_users
from edge_depth_nerf.synthetic.geometry import Geometry, Real
from edge_depth_nerf.synthetic.motion import Drive, Mover, Route

_ONCOMING_Y_M = 1.75
_PAVEMENT_Y_M, _PAVEMENT_HEIGHT_M = 7.3, 0.12
_CROSSING_M = 9.0
"""Length of the longest way across the road."""
_SHORTEST_S = 3.0
"""In a drive that is shorter than this, cars would drive into each other."""


def traffic(own: Drive, duration_s: float, rng: Generator) -> list[Mover]:
    """Lay out what moves during a drive.

    Args:
        own: the recording car's motion.
        duration_s: how long it drives.
        rng: colours, kinds, and how far from the middle of their way they go.

    """
    whole_s = max(duration_s, _SHORTEST_S)
    return [*_oncoming(own, whole_s, rng), *_same_way(own, whole_s, rng), *_on_foot(own, whole_s, rng)]


def _ahead_m(own: Drive, time_s: float) -> float:
    """Where the recording car is along the road at a time."""
    return own.start_m + own.speed_m_s * time_s


def _some_car(rng: Generator) -> Geometry:
    kind = str(rng.choice(["hatchback", "saloon", "estate"]))
    return objects.car(kind, objects.CAR_COLOURS[int(rng.integers(len(objects.CAR_COLOURS)))])


def _oncoming(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """A car; one that stands while the recording car comes past it; a bus behind it."""

    def meeting(geometry: Geometry, share: Real, stands: tuple[Real, Real] | None = None) -> Mover:
        speed = own.speed_m_s * float(rng.uniform(0.95, 1.05))
        jitter = float(rng.normal(0, 0.08))
        stands_s = None if stands is None else (float(stands[0] * whole_s), float(stands[1] * whole_s))
        from_origin = Mover(geometry, Route((0.0, 0.0), np.pi), 0.0, speed, stands_s)
        driven_m = -float(from_origin.at(np.array([share * whole_s]))[0][0, 0])
        route = Route((_ahead_m(own, float(share * whole_s)), _ONCOMING_Y_M + jitter), np.pi)
        return Mover(geometry, route, -driven_m, speed, stands_s)

    colour = objects.CAR_COLOURS[int(rng.integers(len(objects.CAR_COLOURS)))]
    return [
        meeting(_some_car(rng), 0.18),
        meeting(_some_car(rng), 0.5, (0.35, 0.65)),
        meeting(road_users.bus(colour), 0.9),
    ]


def _same_way(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """A car ahead, and a cyclist beside the parked cars who is overtaken."""
    speed = own.speed_m_s * float(rng.uniform(1.0, 1.1))
    lead = Mover(_some_car(rng), own.route, own.start_m + float(rng.uniform(10, 13)), speed)
    speed = 0.6 * own.speed_m_s
    start_m = own.start_m + (own.speed_m_s - speed) * 0.6 * whole_s
    cyclist = Mover(road_users.cyclist(rng), Route((0.0, -3.25 + float(rng.normal(0, 0.05)))), start_m, speed)
    return [lead, cyclist]


def _on_foot(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """Two on the pavements, of whom one stands for a while, and one who crosses the road behind the recording car."""
    found = []
    for side, share, stands_s in ((1, 0.35, None), (-1, 0.6, (0.3 * whole_s, 0.6 * whole_s))):
        speed, heading = float(rng.uniform(1.2, 1.6)), float(rng.choice([0.0, np.pi]))
        y = side * (_PAVEMENT_Y_M + float(rng.uniform(-0.3, 0.4)))
        route = Route((_ahead_m(own, share * whole_s), y), heading)
        start_m = -0.5 * speed * whole_s
        found.append(Mover(road_users.pedestrian(rng), route, start_m, speed, stands_s, _PAVEMENT_HEIGHT_M))
    speed = min(float(rng.uniform(1.3, 1.6)), _CROSSING_M / whole_s)
    crossing = Route((own.start_m - float(rng.uniform(5, 7)), 0.5 * speed * whole_s), -np.pi / 2)
    found.append(Mover(road_users.pedestrian(rng), crossing, 0.0, speed))
    return found
