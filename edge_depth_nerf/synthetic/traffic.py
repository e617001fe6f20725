"""What moves in a street: cars that pass, one that stops and starts again, a bus, people on foot, a cyclist.

In the scene `traffic` all of it is laid out in shares of the drive's length in time, so that each is met during the
drive, however long that is. World frame: the road runs along x, the recording car in the lane at y < 0, towards
positive x. Each shape is a `Geometry` in the thing's own frame: x forward, y left, z up from the ground, metres.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh
from numpy.random import Generator

from edge_depth_nerf.synthetic.geometry import Colour, Geometry, MeshBuilder, Pair, Real, Triple
from edge_depth_nerf.synthetic.materials import Material
from edge_depth_nerf.synthetic.motion import Drive, Mover, Route
from edge_depth_nerf.synthetic.objects import CAR_COLOURS, choice, driven_car

_SKIN: Colour = (0.45, 0.28, 0.2)
_DARK: Colour = (0.02, 0.02, 0.022)
_CLOTHES: tuple[Colour, ...] = (
    (0.05, 0.06, 0.09),
    (0.40, 0.04, 0.05),
    (0.45, 0.43, 0.38),
    (0.06, 0.14, 0.30),
    (0.50, 0.38, 0.05),
    (0.10, 0.20, 0.10),
)
_ONCOMING_Y_M = 1.75
_PAVEMENT_Y_M, _PAVEMENT_HEIGHT_M = 7.3, 0.12
_CROSSING_M = 9.0
"""Length of the longest way across the road."""
_SHORTEST_S = 3.0
"""In a drive that is shorter than this, cars would drive into each other."""


def traffic(own: Drive, duration_s: float, rng: Generator) -> list[Mover]:
    """Lay out what moves while the recording car drives for `duration_s`."""
    whole_s = max(duration_s, _SHORTEST_S)
    return [*_oncoming(own, whole_s, rng), *_same_way(own, whole_s, rng), *_on_foot(own, whole_s, rng)]


def _ahead_m(own: Drive, time_s: float) -> float:
    """Where the recording car is along the road at a time."""
    return own.start_m + own.speed_m_s * time_s


def _oncoming(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """A car; one that stands while the recording car comes past it; a bus behind it."""

    def meeting(geometry: Geometry, share: Real, stands: Pair | None = None) -> Mover:
        speed = own.speed_m_s * float(rng.uniform(0.95, 1.05))
        jitter = float(rng.normal(0, 0.08))
        stands_s = None if stands is None else (float(stands[0] * whole_s), float(stands[1] * whole_s))
        from_origin = Mover(geometry, Route((0.0, 0.0), np.pi), 0.0, speed, stands_s)
        driven_m = -float(from_origin.at(np.array([share * whole_s]))[0][0, 0])
        route = Route((_ahead_m(own, float(share * whole_s)), _ONCOMING_Y_M + jitter), np.pi)
        return Mover(geometry, route, -driven_m, speed, stands_s)

    bus_ = bus(choice(rng, CAR_COLOURS))
    return [meeting(driven_car(rng), 0.18), meeting(driven_car(rng), 0.5, (0.35, 0.65)), meeting(bus_, 0.9)]


def _same_way(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """A car ahead, and a cyclist beside the parked cars who is overtaken."""
    speed = own.speed_m_s * float(rng.uniform(1.0, 1.1))
    lead = Mover(driven_car(rng), own.route, own.start_m + float(rng.uniform(10, 13)), speed)
    speed = 0.6 * own.speed_m_s
    start_m = own.start_m + (own.speed_m_s - speed) * 0.6 * whole_s
    overtaken = Mover(cyclist(rng), Route((0.0, -3.25 + float(rng.normal(0, 0.05)))), start_m, speed)
    return [lead, overtaken]


def _on_foot(own: Drive, whole_s: float, rng: Generator) -> list[Mover]:
    """Two on the pavements, of whom one stands for a while, and one who crosses the road behind the recording car."""
    found = []
    for side, share, stands_s in ((1, 0.35, None), (-1, 0.6, (0.3 * whole_s, 0.6 * whole_s))):
        speed, heading = float(rng.uniform(1.2, 1.6)), float(rng.choice([0.0, np.pi]))
        y = side * (_PAVEMENT_Y_M + float(rng.uniform(-0.3, 0.4)))
        route = Route((_ahead_m(own, share * whole_s), y), heading)
        start_m = -0.5 * speed * whole_s
        found.append(Mover(pedestrian(rng), route, start_m, speed, stands_s, _PAVEMENT_HEIGHT_M))
    speed = min(float(rng.uniform(1.3, 1.6)), _CROSSING_M / whole_s)
    crossing = Route((own.start_m - float(rng.uniform(5, 7)), 0.5 * speed * whole_s), -np.pi / 2)
    found.append(Mover(pedestrian(rng), crossing, 0.0, speed))
    return found


def _head(mesh: MeshBuilder, centre: Triple, radius: Real) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.add_mesh(ball.apply_translation(centre), Material.PAINTED, _SKIN)


def _torso(mesh: MeshBuilder, low: Triple, high: Triple, colour: Colour) -> None:
    """An upright or leaning trunk, narrow at the hip and wide at the shoulders."""
    angles = np.linspace(0, 2 * np.pi, 17)[:-1]
    rings = []
    for share, deep, wide in (
        (0, 0.11, 0.15),
        (0.25, 0.12, 0.17),
        (0.75, 0.13, 0.21),
        (0.95, 0.11, 0.20),
        (1, 0.05, 0.08),
    ):
        middle = (1 - share) * np.array(low) + share * np.array(high)
        rings.append(middle + np.column_stack((deep * np.cos(angles), wide * np.sin(angles), np.zeros(16))))
    mesh.add_loft(np.array(rings), Material.PAINTED, colour)


def pedestrian(rng: Generator) -> Geometry:
    """Somebody of 1.6 to 1.9 m in mid-stride; the limbs do not move."""
    mesh, tall = MeshBuilder(), float(rng.uniform(1.6, 1.9)) / 1.75
    top, trousers = choice(rng, _CLOTHES), choice(rng, _CLOTHES)
    for side in (-1, 1):
        hip, knee, foot = (0, 0.09 * side, 0.88), (0.14 * side, 0.09 * side, 0.48), (0.20 * side, 0.09 * side, 0.06)
        mesh.add_rod(hip, knee, (0.085, 0.065), Material.PAINTED, trousers)
        mesh.add_rod(knee, foot, (0.065, 0.05), Material.PAINTED, trousers)
        mesh.add_box((foot[0] + 0.06, foot[1], 0.045), (0.27, 0.09, 0.09), Material.RUBBER, _DARK)
        shoulder, hand = (0, 0.22 * side, 1.40), (-0.24 * side, 0.25 * side, 0.82)
        mesh.add_rod(shoulder, hand, (0.055, 0.035), Material.PAINTED, top)
    _torso(mesh, (0, 0, 0.84), (0, 0, 1.50), top)
    _head(mesh, (0.01, 0, 1.63), 0.12)
    return mesh.build().transformed(np.diag([tall, tall, tall, 1.0]))


def cyclist(rng: Generator) -> Geometry:
    """Somebody on a bicycle, 1.7 m long; wheels and legs do not move."""
    mesh = MeshBuilder()
    top, trousers, frame = choice(rng, _CLOTHES), choice(rng, _CLOTHES), choice(rng, _CLOTHES)
    for x in (-0.53, 0.53):
        rim = np.linspace(0, 2 * np.pi, 19)
        around = np.column_stack((x + 0.33 * np.cos(rim), np.zeros(19), 0.34 + 0.33 * np.sin(rim)))
        for start, end in pairwise(around):
            mesh.add_rod(start, end, 0.02, Material.RUBBER, _DARK, 6)
        for spoke in around[:-1:2]:
            mesh.add_rod((x, 0, 0.34), spoke, 0.004, Material.METAL, (0.4, 0.4, 0.4), 4)
    saddle, crank, bars, hub = (-0.22, 0, 0.95), (-0.05, 0, 0.32), (0.40, 0, 1.02), (0.53, 0, 0.34)
    for start, end in ((saddle, crank), (crank, (0.36, 0, 0.85)), ((-0.18, 0, 0.85), (0.36, 0, 0.85)), (bars, hub)):
        mesh.add_rod(start, end, 0.022, Material.METAL, frame, 8)
    mesh.add_rod((-0.53, 0, 0.34), crank, 0.018, Material.METAL, frame, 8)
    mesh.add_rod((0.40, -0.27, 1.04), (0.40, 0.27, 1.04), 0.018, Material.METAL, _DARK, 8)
    mesh.add_box(saddle, (0.25, 0.14, 0.06), Material.RUBBER, _DARK)
    for side in (-1, 1):
        knee, foot = (0.16 + 0.06 * side, 0.11 * side, 0.70 + 0.1 * side), (0.0 + 0.12 * side, 0.12 * side, 0.30)
        mesh.add_rod((-0.18, 0.10 * side, 0.98), knee, (0.085, 0.06), Material.PAINTED, trousers)
        mesh.add_rod(knee, foot, (0.06, 0.05), Material.PAINTED, trousers)
        mesh.add_rod((0.12, 0.20 * side, 1.42), (0.40, 0.24 * side, 1.06), (0.05, 0.035), Material.PAINTED, top)
    _torso(mesh, (-0.18, 0, 0.96), (0.16, 0, 1.52), top)
    _head(mesh, (0.26, 0, 1.66), 0.13)
    return mesh.build()


def bus(colour: Colour) -> Geometry:
    """A city bus, higher than a scanner sees near by."""
    length, width, height = 10.5, 2.5, 3.0
    mesh = MeshBuilder()
    mesh.add_box((0, 0, 0.3 + (height - 0.3) / 2), (length, width, height - 0.3), Material.CAR_PAINT, colour)
    mesh.add_box((-1.0, 0, height + 0.1), (3.0, 1.6, 0.2), Material.PAINTED, (0.5, 0.5, 0.5))
    glass: Colour = (0.03, 0.035, 0.04)
    for side in (-1, 1):
        for x in np.arange(-length / 2 + 0.3, length / 2 - 1.3, 1.45):
            mesh.add_box((x + 0.65, side * width / 2, 1.95), (1.3, 0.02, 1.0), Material.GLASS, glass)
        for x in (-2.9, 2.9):
            start, end = (x, side * (width / 2 - 0.3), 0.48), (x, side * (width / 2 + 0.012), 0.48)
            mesh.add_rod(start, end, 0.48, Material.RUBBER, _DARK, sections=24)
            mesh.add_disc((x, side * (width / 2 + 0.016), 0.48), (0, 1, 0), 0.28, Material.METAL, (0.3, 0.3, 0.3))
        mesh.add_box(
            (0, side * (width / 2 + 0.003), 1.2), (length - 0.4, 0.01, 0.25), Material.PAINTED, (0.6, 0.6, 0.58)
        )
    for end in (-1, 1):
        mesh.add_box((end * length / 2, 0, 1.85), (0.02, width - 0.3, 1.3), Material.GLASS, glass)
        mesh.add_box((end * length / 2, 0, 2.72), (0.03, 1.6, 0.28), Material.PRINT, (0.5, 0.3, 0.02))
        mesh.add_box((end * length / 2, 0, 0.5), (0.06, width - 0.1, 0.25), Material.RUBBER, _DARK)
    return mesh.build()
