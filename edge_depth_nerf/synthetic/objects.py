"""The things scenes are made of: cars, houses, trees, street furniture, and the recording car itself.

Each function returns a `Geometry` in the object's own frame: x forward (of a car) or along the street (of a
house), y left or away from the street, z up from the ground, metres. Random choices come from the generator given.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
import trimesh
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from edge_depth_nerf.synthetic.geometry import Colour, Geometry, MeshBuilder, Pair, Real, Triple, placement
from edge_depth_nerf.synthetic.materials import Material

_DARK: Colour = (0.02, 0.02, 0.022)
_WHITE: Colour = (0.7, 0.7, 0.68)
_STEEL: Colour = (0.3, 0.31, 0.32)
_PANE: Colour = (0.03, 0.035, 0.04)

CAR_COLOURS: tuple[Colour, ...] = (
    (0.55, 0.56, 0.57),
    (0.30, 0.31, 0.33),
    (0.72, 0.72, 0.70),
    (0.03, 0.03, 0.035),
    (0.10, 0.11, 0.12),
    (0.05, 0.09, 0.22),
    (0.35, 0.03, 0.03),
    (0.08, 0.20, 0.12),
    (0.45, 0.38, 0.25),
    (0.10, 0.25, 0.45),
)
"""Linear RGB of car paints."""


def choice(rng: Generator, values: tuple):
    """One of some values, all equally likely."""
    return values[int(rng.integers(len(values)))]


# ------------------------------------------------------------------------------------------------- cars


@dataclass(frozen=True)
class CarShape:
    """Measures of a car; shares run from -1 (rear bumper) to 1 (front bumper)."""

    length: Real
    width: Real
    height: Real
    rear_deck: Pair
    """Shares where the rear window starts and ends (base, roof)."""
    windscreen: Pair
    """Shares where the windscreen ends (base, roof)."""
    panes: tuple[Pair, ...]
    """Side windows, as shares of the cabin from rear to front."""
    bonnet_height: Real
    belt_height: Real
    wheelbase: Real


CAR_SHAPES = {
    "hatchback": CarShape(
        4.05, 1.75, 1.48, (-0.97, -0.72), (0.52, 0.16), ((0.06, 0.27), (0.31, 0.6), (0.64, 0.94)), 0.82, 0.95, 2.55
    ),
    "saloon": CarShape(4.65, 1.80, 1.44, (-0.68, -0.36), (0.44, 0.12), ((0.1, 0.48), (0.52, 0.93)), 0.80, 0.93, 2.75),
    "estate": CarShape(
        4.77, 1.82, 1.50, (-0.96, -0.80), (0.45, 0.14), ((0.05, 0.29), (0.32, 0.62), (0.65, 0.94)), 0.82, 0.95, 2.75
    ),
    "van": CarShape(5.0, 1.92, 1.98, (-0.985, -0.93), (0.72, 0.42), ((0.64, 0.95),), 0.98, 1.12, 3.0),
}
"""The cars that are parked and driven."""


def _body(mesh: MeshBuilder, shape: CarShape, colour: Colour) -> None:
    # close stations at the bumpers, where the outline bends
    share = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 45))
    belt, bonnet = shape.belt_height, shape.bonnet_height
    deck = belt if shape.rear_deck[0] < -0.9 else belt - 0.02
    top = PchipInterpolator(
        [-1, -0.98, -0.94, -0.6, shape.windscreen[0], shape.windscreen[0] + 0.04, 0.92, 0.97, 1],
        [0.58, 0.80, deck, belt, belt, belt - 0.03, bonnet - 0.06, bonnet - 0.16, 0.5],
    )(share)
    bottom = np.interp(share, [-1, -0.93, 0.93, 1], [0.36, 0.22, 0.22, 0.30])
    narrowing = PchipInterpolator(
        [-1, -0.96, -0.82, -0.3, 0.6, 0.86, 0.96, 1], [0.7, 0.88, 0.97, 1, 1, 0.95, 0.82, 0.66]
    )
    half = shape.width / 2 * narrowing(share)
    turn, knots = np.linspace(0, 1, 15), np.linspace(0, 1, 11)
    across = PchipInterpolator(knots, (0, 0, 0.85, 0.95, 1.0, 1.0, 0.985, 0.95, 0.86, 0.6, 0))(turn)
    rise = PchipInterpolator(knots, (0, 0, 0, 0.08, 0.3, 0.55, 0.82, 0.94, 0.99, 1.01, 1.03))(turn)
    y = half[:, None] * np.concatenate((across, -across[-2:0:-1]))
    z = bottom[:, None] + (top - bottom)[:, None] * np.concatenate((rise, rise[-2:0:-1]))
    x = np.broadcast_to(share[:, None] * shape.length / 2, y.shape)
    mesh.add_loft(np.stack((x, y, z), -1), Material.CAR_PAINT, colour)


def _cabin(mesh: MeshBuilder, shape: CarShape, colour: Colour) -> None:
    half_length = shape.length / 2
    low, high = shape.belt_height - 0.04, shape.height
    base = (shape.rear_deck[0] * half_length, shape.windscreen[0] * half_length, 0.46 * shape.width)
    roof = (shape.rear_deck[1] * half_length, shape.windscreen[1] * half_length, 0.36 * shape.width)

    def at(share: Real) -> list[Real]:
        return [low + (high - low) * share for low, high in zip(base, roof, strict=True)]

    rings = []
    for share, rise, shrink in ((0, 0, 0), (0.9, 0.9, 0), (0.96, 0.965, 0.03), (1, 1, 0.12), (1, 1.025, 0.35)):
        rear, front, half = at(share)
        rear, front, half = rear + shrink, front - shrink, half - shrink
        cut = 0.10
        corner = [
            (rear, half - cut),
            (rear, cut - half),
            (rear + cut, -half),
            (front - cut, -half),
            (front, cut - half),
            (front, half - cut),
            (front - cut, half),
            (rear + cut, half),
        ]
        rings.append([(x, y, low + (high - low) * rise) for x, y in corner])
    mesh.add_loft(np.array(rings), Material.CAR_PAINT, colour)
    out = 0.012
    bottom_share, top_share = 0.08, 0.86
    for first, last in shape.panes:
        for side in (-1, 1):
            corners = []
            for along, share in ((first, bottom_share), (last, bottom_share), (last, top_share), (first, top_share)):
                rear, front, half = at(share)
                # the outermost panes end upright-ish inside the pillar
                corners.append((rear + along * (front - rear), side * (half + out), low + (high - low) * share))
            mesh.add_polygon(corners, Material.GLASS, _PANE)
    for end, sign in ((1, 1), (0, -1)):
        corners = []
        for across, share in ((-1, bottom_share), (1, bottom_share), (1, top_share), (-1, top_share)):
            values = at(share)
            corners.append((values[end] + sign * out, across * (values[2] - 0.13), low + (high - low) * share))
        mesh.add_polygon(corners, Material.GLASS, _PANE)


def _wheels(mesh: MeshBuilder, shape: CarShape) -> None:
    radius = 0.31 if shape.height < 1.8 else 0.34
    for x in (-shape.wheelbase / 2 - 0.05, shape.wheelbase / 2 - 0.05):
        for side in (-1, 1):
            outer = side * (shape.width / 2 + 0.004)
            angles = np.linspace(-0.25, np.pi + 0.25, 16)
            around = x + (radius + 0.055) * np.cos(angles), radius + (radius + 0.055) * np.sin(angles)
            arch = np.column_stack((around[0], np.full(16, outer), around[1]))
            mesh.add_polygon(arch, Material.RUBBER, (0.008, 0.008, 0.008))
            start, end = (x, side * (shape.width / 2 - 0.2), radius), (x, outer + side * 0.012, radius)
            mesh.add_rod(start, end, radius, Material.RUBBER, _DARK, sections=24)
            hub = (x, outer + side * 0.016, radius)
            mesh.add_disc(hub, (0, 1, 0), 0.68 * radius, Material.METAL, (0.42, 0.43, 0.44))
            for spoke in range(5):
                angle = 2 * np.pi * (spoke + 0.3) / 5
                hole = (x + 0.42 * radius * np.cos(angle), outer + side * 0.019, radius + 0.42 * radius * np.sin(angle))
                mesh.add_disc(hole, (0, 1, 0), 0.155 * radius, Material.RUBBER, _DARK, sections=10)


def _fittings(mesh: MeshBuilder, shape: CarShape) -> None:
    front, half = shape.length / 2, shape.width / 2
    for side in (-1, 1):
        y = side * 0.62 * half
        mesh.add_box((front * 0.945, y, 0.64), (0.18, 0.30, 0.13), Material.GLASS, (0.55, 0.55, 0.52))
        rear = (-front * 0.955, side * 0.68 * half, 0.74)
        mesh.add_box(rear, (0.16, 0.22, 0.17), Material.GLASS, (0.32, 0.015, 0.012))
        mirror = (shape.windscreen[0] * front - 0.22, side * (half + 0.07), shape.belt_height + 0.06)
        mesh.add_box(mirror, (0.09, 0.19, 0.13), Material.RUBBER, _DARK)
        # gaps of the doors and the sill, as thin dark strips just proud of the side
        for share in (0.36, -0.06, -0.46) if shape.height < 1.8 else (0.55, 0.1):
            mesh.add_box((share * front, side * (half + 0.001), 0.61), (0.012, 0.008, 0.52), Material.RUBBER, _DARK)
        for share in (0.02, -0.40) if shape.height < 1.8 else (0.16,):
            handle = (share * front, side * (half + 0.004), 0.76)
            mesh.add_box(handle, (0.17, 0.03, 0.03), Material.RUBBER, (0.06, 0.06, 0.06))
        mesh.add_box((0, side * (half - 0.015), 0.29), (0.58 * shape.length, 0.05, 0.06), Material.RUBBER, _DARK)
    for sign in (1, -1):
        mesh.add_box((sign * front * 0.992, 0, 0.47), (0.05, 0.52, 0.11), Material.PAINTED, _WHITE)
        mesh.add_box((sign * front * 0.975, 0, 0.33), (0.10, 1.3, 0.10), Material.RUBBER, _DARK)
    mesh.add_box((front * 0.965, 0, 0.63), (0.08, 0.62, 0.10), Material.RUBBER, _DARK)


@cache
def car(kind: str, colour: Colour) -> Geometry:
    """A car of `CAR_SHAPES`, centred, on its wheels."""
    shape = CAR_SHAPES[kind]
    mesh = MeshBuilder()
    _body(mesh, shape, colour)
    _cabin(mesh, shape, colour)
    _wheels(mesh, shape)
    _fittings(mesh, shape)
    return mesh.build()


def driven_car(rng: Generator) -> Geometry:
    """A car that is not parked."""
    kind = str(rng.choice(["hatchback", "saloon", "estate"]))
    return car(kind, choice(rng, CAR_COLOURS))


def random_car(rng: Generator) -> tuple[Geometry, CarShape]:
    """A car of any kind and colour; its shape tells the room it needs."""
    kind = str(rng.choice(["hatchback", "saloon", "estate", "van"], p=[0.36, 0.27, 0.27, 0.10]))
    return car(kind, choice(rng, CAR_COLOURS)), CAR_SHAPES[kind]


def recording_car() -> Geometry:
    """The car that carries the sensors, an estate, with the origin on the road below the pose's origin.

    The fisheye cameras look past its roof and its side; roof bars, the sensor box, cables, a beacon and an
    aerial are in their view. The sensor rig stands 0.30 m left of the vehicle's middle, as the calibration has it.
    """
    shape = CAR_SHAPES["estate"]
    mesh = MeshBuilder()
    colour: Colour = (0.42, 0.44, 0.47)
    mesh.add(car("estate", colour))
    for side in (-1, 1):
        rail = 0.60 * side
        mesh.add_rod((-1.75, rail, 1.56), (0.30, rail, 1.56), 0.022, Material.METAL, _STEEL)
        for x in (-1.7, -0.7, 0.25):
            mesh.add_box((x, rail, 1.52), (0.10, 0.04, 0.07), Material.RUBBER, _DARK)
        # the arm of the camera beside, and a strip of cables along the roof
        mesh.add_box((-0.15, 0.52 * side, 1.60), (0.34, 0.16, 0.10), Material.RUBBER, (0.03, 0.03, 0.032))
        cable = [(-1.5, 0.5, 1.545), (-0.9, 0.56, 1.56), (-0.3, 0.50, 1.56), (0.1, 0.57, 1.55)]
        for a, b in pairwise(cable):
            mesh.add_rod((a[0], side * a[1], a[2]), (b[0], side * b[1], b[2]), 0.012, Material.RUBBER, _DARK, 6)
    for x in (-1.25, 0.05):
        mesh.add_box((x, 0, 1.60), (0.09, 1.34, 0.035), Material.METAL, (0.35, 0.36, 0.37))
        for side in (-1, 1):
            mesh.add_box((x, 0.64 * side, 1.57), (0.14, 0.05, 0.07), Material.RUBBER, _DARK)
    mesh.add_box((-1.1, 0, 1.64), (0.7, 0.7, 0.08), Material.METAL, (0.30, 0.30, 0.31))
    dome = trimesh.creation.icosphere(subdivisions=3, radius=0.075)
    mesh.add_mesh(dome.copy().apply_translation((-1.28, 0.60, 1.70)), Material.PAINTED, _WHITE)
    mesh.add_box((-0.98, 0.64, 1.60), (0.14, 0.10, 0.10), Material.PAINTED, (0.75, 0.42, 0.03))
    beacon = dome.copy().apply_scale(0.7).apply_translation((-0.98, 0.64, 1.67))
    mesh.add_mesh(beacon, Material.PAINTED, (0.55, 0.03, 0.015))
    # the pose's origin lies near the rear axle
    return mesh.build().transformed(placement(shape.wheelbase / 2, -0.2985))


# ------------------------------------------------------------------------------------------------- houses


_Look = tuple[Material, Colour, Colour, Colour]
"""Material and colour of walls, colours of doors and of window frames."""


@dataclass(frozen=True)
class _Opening:
    """A window or door in a wall, in the wall's own coordinates."""

    u: Pair
    v: Pair
    is_door: bool = False


def _wall(
    mesh: MeshBuilder, start: NDArray, end: NDArray, height: Real, openings: list[_Opening], look: _Look, rng: Generator
) -> None:
    """An upright wall from start to end (x, y), outside on the right-hand side, with openings set back in it."""
    material, tint, door, frame = look
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    outward = np.array([along[1], -along[0]])

    def point(u: Real, v: Real, depth: Real) -> Triple:
        x, y = start + along * u - outward * depth
        return float(x), float(y), v

    def panel(u: Pair, v: Pair, depth: Real, kind: Material, colour: Colour) -> None:
        corners = ((u[0], v[0]), (u[1], v[0]), (u[1], v[1]), (u[0], v[1]))
        mesh.add_polygon([point(*corner, depth) for corner in corners], kind, colour)

    us = sorted({0.0, length, *(edge for o in openings for edge in o.u)})
    vs = sorted({0.0, height, *(edge for o in openings for edge in o.v)})
    for u0, u1 in pairwise(us):
        for v0, v1 in pairwise(vs):
            middle = ((u0 + u1) / 2, (v0 + v1) / 2)
            if not any(o.u[0] < middle[0] < o.u[1] and o.v[0] < middle[1] < o.v[1] for o in openings):
                panel((u0, u1), (v0, v1), 0.0, material, tint)
    for o in openings:
        depth, (u0, u1), (v0, v1) = 0.16, o.u, o.v
        for u in o.u:
            jamb = [point(u, v0, 0.0), point(u, v0, depth), point(u, v1, depth), point(u, v1, 0.0)]
            mesh.add_polygon(jamb, Material.PLASTER, tint)
        for v in o.v:
            reveal = [point(u0, v, 0.0), point(u1, v, 0.0), point(u1, v, depth), point(u0, v, depth)]
            mesh.add_polygon(reveal, Material.PLASTER, tint)
        if o.is_door:
            panel(o.u, o.v, depth, Material.PAINTED, door)
            light = (v0 + 0.62 * (v1 - v0), v1 - 0.15)
            panel((u0 + 0.15, u1 - 0.15), light, depth - 0.01, Material.GLASS, (0.03, 0.03, 0.035))
            continue
        glass = choice(rng, ((0.02, 0.025, 0.03), (0.05, 0.05, 0.05), (0.12, 0.11, 0.09)))
        panel(o.u, o.v, depth, Material.GLASS, glass)
        if rng.random() < 0.3:
            drop = v1 - rng.uniform(0.2, 0.8) * (v1 - v0)
            panel(o.u, (drop, v1), depth - 0.015, Material.PAINTED, (0.55, 0.53, 0.48))
        bar, middle = 0.06, (u0 + u1) / 2
        bars = [
            ((u0, u0 + bar), (v0, v1)),
            ((u1 - bar, u1), (v0, v1)),
            ((u0, u1), (v0, v0 + bar)),
            ((u0, u1), (v1 - bar, v1)),
            ((middle - bar / 2, middle + bar / 2), (v0, v1)),
        ]
        for u, v in bars:
            panel(u, v, depth - 0.035, Material.PAINTED, frame)
        sill = point(middle, v0 - 0.03, -0.03)
        yaw = float(np.arctan2(along[1], along[0]))
        mesh.add_box(sill, (u1 - u0 + 0.16, 0.16, 0.05), Material.STONE, (0.42, 0.40, 0.37), yaw)


_WALLS: tuple[tuple[Material, Colour], ...] = (
    (Material.BRICK, (0.34, 0.12, 0.075)),
    (Material.BRICK, (0.42, 0.20, 0.11)),
    (Material.BRICK, (0.30, 0.16, 0.12)),
    (Material.PLASTER, (0.62, 0.56, 0.42)),
    (Material.PLASTER, (0.60, 0.42, 0.24)),
    (Material.PLASTER, (0.62, 0.61, 0.57)),
    (Material.PLASTER, (0.35, 0.42, 0.46)),
    (Material.PLASTER, (0.52, 0.30, 0.24)),
    (Material.PLASTER, (0.42, 0.46, 0.33)),
)
_ROOFS: tuple[Colour, ...] = ((0.24, 0.075, 0.045), (0.16, 0.06, 0.045), (0.07, 0.07, 0.075), (0.13, 0.10, 0.08))
_DOORS: tuple[Colour, ...] = (
    (0.20, 0.09, 0.04),
    (0.05, 0.14, 0.10),
    (0.30, 0.04, 0.04),
    (0.06, 0.09, 0.22),
    (0.5, 0.5, 0.48),
)
_FRAMES: tuple[Colour, ...] = ((0.68, 0.68, 0.66), (0.68, 0.68, 0.66), (0.16, 0.09, 0.05), (0.25, 0.28, 0.28))


def _openings(
    length: Real, storeys: int, storey_m: Real, with_door: bool, shop: bool, rng: Generator
) -> list[_Opening]:
    columns = max(1, int(length / rng.uniform(2.2, 2.9)))
    bay = length / columns
    width = min(rng.uniform(1.0, 1.4), 0.62 * bay)
    height = rng.uniform(1.3, 1.7)
    door_column = int(rng.integers(columns)) if with_door else -1
    openings = []
    for column in range(columns):
        middle = (column + 0.5) * bay
        for storey in range(storeys):
            bottom = storey * storey_m + 0.95
            if storey == 0 and column == door_column:
                openings.append(_Opening((middle - 0.55, middle + 0.55), (0.0, 2.25), is_door=True))
            elif storey == 0 and shop:
                openings.append(_Opening((middle - 0.42 * bay, middle + 0.42 * bay), (0.5, 2.5)))
            else:
                openings.append(_Opening((middle - width / 2, middle + width / 2), (bottom, bottom + height)))
    return openings


def house(width: Real, depth: Real, rng: Generator, shop: bool = False) -> Geometry:
    """A house with its front along x at y = 0 and its body towards positive y; from x = 0 to `width`.

    All four walls have openings, so that it may stand at a corner.
    """
    mesh = MeshBuilder()
    storeys = int(rng.choice([2, 3, 4], p=[0.4, 0.42, 0.18]))
    storey = rng.uniform(2.8, 3.2)
    height = storeys * storey + 0.4
    material, tint = choice(rng, _WALLS)
    door, frame, roof = choice(rng, _DOORS), choice(rng, _FRAMES), choice(rng, _ROOFS)
    corner = [np.array(p) for p in ((0.0, 0.0), (width, 0.0), (width, depth), (0.0, depth))]
    for side in range(4):
        start, end = corner[side], corner[(side + 1) % 4]
        openings = _openings(float(np.linalg.norm(end - start)), storeys, storey, side == 0, shop and side == 0, rng)
        if side % 2 and rng.random() < 0.3:
            openings = []
        _wall(mesh, start, end, height, openings, (material, tint, door, frame), rng)
    mesh.add_box((width / 2, -0.02, 0.22), (width, 0.08, 0.44), Material.STONE, (0.28, 0.27, 0.25))
    if rng.random() < 0.5:
        for level in range(1, storeys):
            centre = (width / 2, -0.02, level * storey + 0.2)
            mesh.add_box(centre, (width, 0.1, 0.14), Material.STONE, (0.5, 0.47, 0.42))
    if shop:
        sign = choice(rng, ((0.4, 0.03, 0.03), (0.03, 0.1, 0.35), (0.05, 0.25, 0.1), (0.5, 0.3, 0.03)))
        mesh.add_box((width / 2, -0.08, 2.85), (0.9 * width, 0.12, 0.5), Material.PRINT, sign)
        if rng.random() < 0.6:
            left, right = 0.1 * width, 0.9 * width
            awning = [(left, -0.02, 2.6), (right, -0.02, 2.6), (right, -1.1, 2.25), (left, -1.1, 2.25)]
            mesh.add_polygon(awning, Material.PRINT, choice(rng, ((0.5, 0.06, 0.04), (0.1, 0.25, 0.4))))
    _roof(mesh, width, depth, height, roof, (material, tint), rng)
    for x in (0.12, width - 0.12):
        mesh.add_rod((x, -0.07, 0), (x, -0.07, height), 0.045, Material.METAL, (0.2, 0.2, 0.19), 8)
    return mesh.build()


def _roof(
    mesh: MeshBuilder,
    width: Real,
    depth: Real,
    height: Real,
    roof: Colour,
    wall: tuple[Material, Colour],
    rng: Generator,
) -> None:
    if rng.random() < 0.25:
        mesh.add_rectangle((0, width), (0, depth), height, Material.CONCRETE, (0.2, 0.2, 0.2))
        for y in (0, depth):
            mesh.add_box((width / 2, y, height), (width + 0.3, 0.35, 0.5), Material.STONE, (0.4, 0.38, 0.35))
        for x in (0, width):
            mesh.add_box((x, depth / 2, height), (0.35, depth + 0.3, 0.5), Material.STONE, (0.4, 0.38, 0.35))
        return
    rise = rng.uniform(0.32, 0.5) * depth
    over, slope = 0.4, rise / (depth / 2)
    ridge = height + rise
    for y, sign in ((-over, 1), (depth + over, -1)):
        low = height - over * slope
        corners = [(-0.2, y, low), (width + 0.2, y, low), (width + 0.2, depth / 2, ridge), (-0.2, depth / 2, ridge)]
        mesh.add_polygon(corners, Material.ROOF, roof)
        mesh.add_rod((-0.2, y, low), (width + 0.2, y, low), 0.07, Material.METAL, (0.22, 0.22, 0.21), 8)
        if rng.random() < 0.5:
            for x in np.linspace(0, width, int(width / 3.5) + 2)[1:-1]:
                at = 0.18 * depth
                body = (float(x), depth / 2 - sign * (depth / 2 - at - 0.9), height + slope * at + 0.55)
                mesh.add_box(body, (1.3, 1.8, 1.3), *wall)
                face, low_m, high_m = body[1] - sign * 0.905, body[2] - 0.3, body[2] + 0.5
                frame = ((x - 0.45, low_m), (x + 0.45, low_m), (x + 0.45, high_m), (x - 0.45, high_m))
                mesh.add_polygon([(u, face, v) for u, v in frame], Material.GLASS, (0.03, 0.03, 0.035))
                mesh.add_box((body[0], body[1], body[2] + 0.7), (1.6, 2.1, 0.12), Material.ROOF, roof)
    for x in (0.0, width):
        mesh.add_polygon([(x, 0, height), (x, depth, height), (x, depth / 2, ridge)], *wall)
    chimney = rng.uniform(0.2, 0.8) * width
    mesh.add_box((chimney, 0.62 * depth, ridge), (0.6, 0.5, 1.6), Material.BRICK, (0.3, 0.13, 0.08))


# ------------------------------------------------------------------------------------------------- plants


@cache
def _ball(subdivisions: int) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions)


def _lump(rng: Generator, centre: NDArray, radius: NDArray, roughness: Real, subdivisions: int) -> trimesh.Trimesh:
    """A ball with bumps at two scales."""
    ball = _ball(subdivisions)
    directions = np.asarray(ball.vertices)
    bumps = np.zeros(len(directions))
    for frequency, amplitude in ((3.0, 0.6), (7.0, 0.4)):
        for _ in range(6):
            axis = rng.normal(size=3)
            axis /= np.linalg.norm(axis)
            bumps += amplitude * np.sin(frequency * directions @ axis + rng.uniform(0, 2 * np.pi)) / 2.5
    vertices = directions * (1 + roughness * bumps)[:, None] * radius + centre
    return trimesh.Trimesh(vertices, ball.faces, process=False)


def _leaves(mesh: MeshBuilder, rng: Generator, points: NDArray, outward: NDArray, size: Real, tint: Colour) -> None:
    """Clusters of leaves, as small triangles at the points, roughly across `outward`."""
    count = len(points)
    facing = outward + 0.7 * rng.normal(size=(count, 3))
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    side = np.cross(facing, rng.normal(size=(count, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    scale = (size * rng.uniform(0.6, 1.3, count))[:, None]
    side, up = side * scale, np.cross(facing, side) * scale
    corners = np.stack((points + up, points - 0.5 * up + side, points - 0.5 * up - side), 1)
    # lit as part of the crown, not each by its own angle: from afar a crown is a soft body
    lit = 0.8 * outward + 0.2 * facing
    lit /= np.linalg.norm(lit, axis=1, keepdims=True)
    mesh.add_triangles(corners, Material.LEAF, tint, np.repeat(lit[:, None], 3, axis=1))


def tree(height: Real, rng: Generator, leaves: int = 9000) -> Geometry:
    """A broad-leaved tree: trunk, branches, a crown of lumps with clusters of leaves about them."""
    mesh = MeshBuilder()
    bark: Colour = (0.13, 0.10, 0.075)
    stem = rng.uniform(0.28, 0.36) * height
    radius = 0.022 * height
    lean = rng.normal(0, 0.12, 2)
    fork = np.array([*lean, stem])
    mesh.add_rod((0, 0, -0.1), fork, (1.25 * radius, radius), Material.BARK, bark, 14)
    tint = np.array([0.075, 0.135, 0.032]) * rng.uniform(0.75, 1.3) * (1 + 0.25 * rng.normal(size=3) * (1, 0.3, 1))
    green: Colour = (float(tint[0]), float(tint[1]), float(max(tint[2], 0.01)))
    crown = np.array([0.27, 0.27, 0.36]) * height
    middle = fork + np.array((0, 0, 0.75 * crown[2]))
    lumps = 22
    for number in range(lumps):
        # spread over the crown by the golden angle, with some disorder
        level = 1 - 2 * (number + 0.5) / lumps
        angle = 2.399963 * number + rng.uniform(-0.5, 0.5)
        flat = np.sqrt(1 - level**2)
        direction = np.array([flat * np.cos(angle), flat * np.sin(angle), level])
        centre = middle + direction * crown * rng.uniform(0.5, 0.95)
        size = crown * rng.uniform(0.24, 0.46)
        lump = _lump(rng, centre, size * 0.85, 0.12, 2)
        mesh.add_mesh(lump, Material.LEAF, (0.5 * green[0], 0.5 * green[1], 0.5 * green[2]))
        start = fork - (0, 0, rng.uniform(0, 0.3) * stem)
        mesh.add_rod(start, centre, (0.45 * radius, 0.12 * radius), Material.BARK, bark, 7)
        around = rng.normal(size=(leaves // lumps, 3))
        around /= np.linalg.norm(around, axis=1, keepdims=True)
        points = centre + around * size * rng.uniform(0.8, 1.12, (len(around), 1))
        outward = (points - middle) / crown
        outward = 0.5 * around + 0.5 * outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 0.3)
        _leaves(mesh, rng, points, outward, 0.115, green)
    return mesh.build()


def hedge(length: Real, height: Real, rng: Generator) -> Geometry:
    """A clipped hedge along x from 0 to `length`, 0.7 m wide."""
    mesh = MeshBuilder()
    green: Colour = (0.05, 0.11, 0.028)
    box = trimesh.creation.box((length, 0.6, height))
    for _ in range(4):
        box = box.subdivide()
    vertices = np.asarray(box.vertices) + rng.normal(0, 0.035, np.asarray(box.vertices).shape)
    body = trimesh.Trimesh(vertices + np.array((length / 2, 0, height / 2)), box.faces, process=False)
    mesh.add_mesh(body, Material.LEAF, (0.7 * green[0], 0.7 * green[1], 0.7 * green[2]))
    count = int(260 * length)
    faces = rng.choice(len(body.faces), count, p=body.area_faces / body.area)
    weights = rng.dirichlet((1, 1, 1), count)
    points = np.einsum("ij,ijk->ik", weights, np.asarray(body.triangles)[faces])
    _leaves(mesh, rng, points, np.asarray(body.face_normals)[faces], 0.09, green)
    return mesh.build()


def thicket(length: Real, height: Real, rng: Generator) -> Geometry:
    """A far belt of trees along x from 0 to `length`: lumps alone."""
    mesh = MeshBuilder()
    for x in np.arange(0, length, 0.45 * height):
        green = np.array([0.05, 0.095, 0.03]) * rng.uniform(0.7, 1.4)
        size = np.array([0.42, 0.42, 0.55]) * height * rng.uniform(0.75, 1.2)
        centre = np.array([x, rng.uniform(-0.3, 0.3) * height, 0.85 * size[2]])
        tint: Colour = (float(green[0]), float(green[1]), float(green[2]))
        mesh.add_mesh(_lump(rng, centre, size, 0.16, 3), Material.LEAF, tint)
    return mesh.build()


# ------------------------------------------------------------------------------------------------- furniture


def street_lamp() -> Geometry:
    """A thin steel post with an arm towards negative y."""
    mesh = MeshBuilder()
    grey: Colour = (0.22, 0.24, 0.24)
    mesh.add_rod((0, 0, 0), (0, 0, 1.2), 0.075, Material.METAL, grey)
    mesh.add_rod((0, 0, 1.2), (0, 0, 7.0), (0.055, 0.04), Material.METAL, grey)
    mesh.add_rod((0, 0, 7.0), (0, -1.3, 7.35), 0.032, Material.METAL, grey)
    mesh.add_box((0, -1.6, 7.36), (0.22, 0.7, 0.12), Material.PAINTED, (0.4, 0.4, 0.4))
    return mesh.build()


def road_sign(kind: int) -> Geometry:
    """A sign on a thin post that faces negative x: a ban, a priority road, a car park or a sign with text."""
    mesh = MeshBuilder()
    mesh.add_rod((0, 0, 0), (0, 0, 2.75), 0.03, Material.METAL, _STEEL, 8)
    facing, red, blue = (-1.0, 0.0, 0.0), (0.5, 0.02, 0.02), (0.02, 0.08, 0.4)
    mesh.add_disc((-0.040, 0, 2.45), facing, 0.31, Material.METAL, (0.25, 0.25, 0.25), 24) if kind < 2 else None
    if kind == 0:
        mesh.add_disc((-0.042, 0, 2.45), facing, 0.31, Material.PAINTED, red, 24)
        mesh.add_disc((-0.045, 0, 2.45), facing, 0.22, Material.PAINTED, _WHITE, 24)
    elif kind == 1:
        mesh.add_disc((-0.042, 0, 2.45), facing, 0.34, Material.PAINTED, _WHITE, 4)
        mesh.add_disc((-0.045, 0, 2.45), facing, 0.26, Material.PAINTED, (0.75, 0.45, 0.02), 4)
    elif kind == 2:
        mesh.add_box((-0.05, 0, 2.45), (0.02, 0.55, 0.55), Material.PAINTED, blue)
        mesh.add_box((-0.062, 0.09, 2.45), (0.01, 0.07, 0.36), Material.PAINTED, _WHITE)
        mesh.add_box((-0.062, -0.04, 2.54), (0.01, 0.24, 0.18), Material.PAINTED, _WHITE)
        mesh.add_box((-0.068, -0.02, 2.54), (0.01, 0.12, 0.07), Material.PAINTED, blue)
    else:
        mesh.add_box((-0.05, 0, 2.35), (0.02, 0.9, 0.4), Material.PRINT, (0.65, 0.5, 0.05))
    return mesh.build()


def billboard(colour: Colour) -> Geometry:
    """A board of 3.6 m × 2.5 m on two posts that faces negative y."""
    mesh = MeshBuilder()
    for x in (-1.3, 1.3):
        mesh.add_rod((x, 0.06, 0), (x, 0.06, 3.6), 0.06, Material.METAL, _STEEL, 8)
    mesh.add_box((0, 0, 2.5), (3.6, 0.08, 2.5), Material.PAINTED, (0.4, 0.4, 0.4))
    mesh.add_box((0, -0.045, 2.5), (3.4, 0.02, 2.3), Material.PRINT, colour)
    return mesh.build()


def bollard() -> Geometry:
    """A post of 0.9 m with a reflecting band."""
    mesh = MeshBuilder()
    mesh.add_rod((0, 0, 0), (0, 0, 0.9), 0.05, Material.PAINTED, (0.05, 0.05, 0.05))
    mesh.add_rod((0, 0, 0.70), (0, 0, 0.80), 0.053, Material.PAINTED, (0.6, 0.05, 0.04))
    return mesh.build()


def bin_on_wheels(colour: Colour) -> Geometry:
    """A household bin."""
    mesh = MeshBuilder()
    rings = [[(-h, -h, z), (h, -h, z), (h, h, z), (-h, h, z)] for h, z in ((0.22, 0.06), (0.29, 0.98))]
    mesh.add_loft(np.array(rings), Material.PAINTED, (0.05, 0.06, 0.06), smooth=False)
    mesh.add_box((0, 0, 1.02), (0.62, 0.66, 0.09), Material.PAINTED, colour)
    for y in (-0.24, 0.24):
        mesh.add_rod((-0.2, y - 0.03, 0.1), (-0.2, y + 0.03, 0.1), 0.1, Material.RUBBER, _DARK)
    return mesh.build()


def cabinet() -> Geometry:
    """A grey box of the telephone company."""
    mesh = MeshBuilder()
    mesh.add_box((0, 0, 0.6), (0.9, 0.35, 1.2), Material.PAINTED, (0.33, 0.34, 0.31))
    mesh.add_box((0, 0, 1.22), (0.96, 0.41, 0.06), Material.PAINTED, (0.25, 0.26, 0.24))
    mesh.add_box((0.1, -0.18, 0.7), (0.45, 0.01, 0.5), Material.PRINT, (0.5, 0.45, 0.3))
    return mesh.build()
