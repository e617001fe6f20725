"""The scenes: a street, the same with traffic, an underground car park, a turn at a junction, a roundabout.

World frame: x along the first stretch of road, y left of it, z up, the road at z = 0, metres. Everything stands
still and looks the same in every frame, but for what moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.optimize import root_scalar

from edge_depth_nerf.synthetic import objects
from edge_depth_nerf.synthetic.geometry import Colour, Geometry, MeshBuilder, Pair, Real, Triple, placement
from edge_depth_nerf.synthetic.materials import Material
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S, Drive, Mover, Route, Turn, WindingRoute
from edge_depth_nerf.synthetic.options import SynthesizeOptions
from edge_depth_nerf.synthetic.traffic import traffic

LANE_M = 3.5
KERB_Y_M = 5.7
"""From the middle of the road to the kerb: a lane and a row of parked cars."""
HOUSE_Y_M = 8.7
KERB_HEIGHT_M = 0.12

_ASPHALT: Colour = (0.115, 0.113, 0.11)
_CONCRETE: Colour = (0.23, 0.23, 0.225)
_PAVING: Colour = (0.27, 0.255, 0.235)
_KERB: Colour = (0.36, 0.35, 0.33)
_GRASS: Colour = (0.085, 0.125, 0.04)
_LINE: Colour = (0.62, 0.62, 0.6)


@dataclass(frozen=True)
class Lighting:
    """What lights a scene; linear RGB."""

    exposure: Real
    """Factor from radiance to the picture's 0-1."""
    ambient_up: Colour
    """Light on what faces up."""
    ambient_down: Colour
    """Light on what faces down."""
    sun_direction: Triple | None = None
    """Unit vector to the sun; none = indoors, without a sky."""
    sun: Colour = (0.0, 0.0, 0.0)
    """The sun's light on what faces it."""
    lamps: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """Positions of lamps, N×3."""
    lamp: Colour = (0.0, 0.0, 0.0)
    """A lamp's light at 1 m on what faces it."""
    lamp_reach_m: Real = 8.0
    """Distance at which a lamp's light has faded to nothing."""


@dataclass(frozen=True)
class SceneModel:
    """All that sensors can see, and how the recording car drives through it."""

    static: Geometry
    movers: list[Mover]
    lighting: Lighting
    contacts: list[NDArray[np.float64]]
    """Convex outlines (N×2) of what stands on the ground and keeps light from it."""
    drive: Drive


class _Site:
    """A mesh and the outlines of what stands in it."""

    def __init__(self) -> None:
        self.mesh = MeshBuilder()
        self.contacts: list[NDArray[np.float64]] = []

    def put(self, geometry: Geometry, transform: NDArray, outline: Sequence[Pair] = ()) -> None:
        """Add an object; its outline is given in its own frame."""
        self.mesh.add(geometry, transform)
        if outline:
            flat = np.asarray(outline, np.float64)
            self.contacts.append(flat @ transform[:2, :2].T + transform[:2, 3])

    def put_site(self, other: _Site, transform: NDArray) -> None:
        self.mesh.add(other.mesh.build(), transform)
        self.contacts += [outline @ transform[:2, :2].T + transform[:2, 3] for outline in other.contacts]


def _rectangle(x: Pair, y: Pair) -> list[Pair]:
    return [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]


_POST = _rectangle((-0.14, 0.14), (-0.14, 0.14))
"""Outline of what is as thin as a post."""


def _car_outline(shape: objects.CarShape) -> list[Pair]:
    length, width = shape.length / 2 - 0.1, shape.width / 2 - 0.05
    return _rectangle((-length, length), (-width, width))


def _parked_row(site: _Site, x: Pair, facing_rad: Real, rng: Generator) -> None:
    """Cars parked one behind the other along the kerb, with gaps."""
    at = x[0] + rng.uniform(0, 2)
    while True:
        geometry, shape = objects.random_car(rng)
        if at + shape.length > x[1]:
            return
        if rng.random() < 0.78:
            yaw = facing_rad + rng.normal(0, 0.015) + (np.pi if rng.random() < 0.06 else 0.0)
            where = placement(at + shape.length / 2, 4.62 + rng.normal(0, 0.06), 0, yaw)
            site.put(geometry, where, _car_outline(shape))
        else:
            at += rng.uniform(0, 2.5)
        at += shape.length + rng.uniform(0.6, 1.3)


def _houses(site: _Site, x: Pair, rng: Generator, corner_first: bool = False) -> None:
    """A row of houses at the back of the pavement, with gaps, front gardens, hedges and walls."""
    at = x[0]
    while at < x[1]:
        width = rng.uniform(8, 13.5)
        at_corner = at == x[0] and corner_first
        set_back = 0.0 if at_corner or rng.random() < 0.6 else rng.uniform(2.0, 3.5)
        depth = rng.uniform(9, 11) if not at_corner else 10.0
        shop = set_back == 0 and rng.random() < 0.35
        front = HOUSE_Y_M + set_back
        house = objects.house(width, depth, rng, shop)
        site.put(house, placement(at, front, KERB_HEIGHT_M), _rectangle((0, width), (0, depth)))
        if set_back:
            garden = (at - 0.3, at + width + 0.3), (HOUSE_Y_M, front)
            site.mesh.add_rectangle(*garden, KERB_HEIGHT_M + 0.015, Material.GRASS, _GRASS)
            if rng.random() < 0.6:
                plant = objects.hedge(width - 3.0, rng.uniform(0.8, 1.3), rng)
                site.put(plant, placement(at, HOUSE_Y_M + 0.35, KERB_HEIGHT_M), _rectangle((0, width - 3), (-0.3, 0.3)))
            else:
                size = (width - 3.0, 0.25, rng.uniform(0.7, 1.1))
                centre = (at + size[0] / 2, HOUSE_Y_M + 0.15, KERB_HEIGHT_M + size[2] / 2)
                site.mesh.add_box(centre, size, Material.BRICK, (0.36, 0.17, 0.11))
        for _ in range(int(rng.integers(0, 3))):
            colour = objects.choice(rng, ((0.05, 0.06, 0.06), (0.08, 0.18, 0.07), (0.45, 0.35, 0.02)))
            along = at + rng.uniform(0.5, width - 0.5)
            where = placement(along, HOUSE_Y_M - 0.45, KERB_HEIGHT_M, rng.normal(1.57, 0.1))
            site.put(objects.bin_on_wheels(colour), where, _rectangle((-0.28, 0.28), (-0.28, 0.28)))
        at += width
        if rng.random() < 0.3 and not at_corner:
            gap = rng.uniform(3, 7)
            lawn = (at, at + gap), (HOUSE_Y_M, HOUSE_Y_M + 25)
            site.mesh.add_rectangle(*lawn, KERB_HEIGHT_M + 0.01, Material.GRASS, _GRASS)
            hedge = objects.hedge(gap, rng.uniform(1.0, 1.8), rng)
            site.put(hedge, placement(at, HOUSE_Y_M + 0.5, KERB_HEIGHT_M), _rectangle((0, gap), (-0.3, 0.3)))
            small = objects.tree(rng.uniform(5, 8), rng, leaves=5000)
            site.put(small, placement(at + gap / 2, HOUSE_Y_M + rng.uniform(3.5, 8), KERB_HEIGHT_M))
            at += gap


def _street_side(x: Pair, clear_m: Real, facing_rad: Real, rng: Generator, corner_first: bool = False) -> _Site:
    """One side of a street, y > 0, along x: parked cars, trees, lamps, signs, houses.

    The first `clear_m` are without cars and trees: a junction. `facing_rad` is the heading of the parked cars.
    """
    site = _Site()
    begin = x[0] + clear_m
    _parked_row(site, (begin, x[1]), facing_rad, rng)
    _houses(site, x, rng, corner_first)
    edge, ground = KERB_Y_M + 0.75, KERB_HEIGHT_M
    at = begin + rng.uniform(1, 6)
    while at < x[1]:
        trunk = placement(at, edge + rng.normal(0, 0.05), ground, rng.uniform(0, 6.28))
        site.put(objects.tree(rng.uniform(6.5, 10.5), rng), trunk, _POST)
        bed = (at - 0.65, at + 0.65), (edge - 0.6, edge + 0.6)
        site.mesh.add_rectangle(*bed, ground + 0.004, Material.GRASS, (0.10, 0.09, 0.055))
        at += rng.uniform(8, 17)
    at = begin + rng.uniform(0, 8)
    while at < x[1]:
        site.put(objects.street_lamp(), placement(at, KERB_Y_M + 0.45, ground), _POST)
        at += rng.uniform(22, 28)
    at = begin - 0.5 * clear_m + rng.uniform(0, 4)
    while at < x[1]:
        kind = int(rng.integers(4))
        # signs face the traffic on their own side
        yaw = facing_rad + rng.normal(0, 0.08)
        site.put(objects.road_sign(kind), placement(at, KERB_Y_M + 0.4, ground, yaw), _POST)
        at += rng.uniform(9, 20)
    at = begin + rng.uniform(0, 10)
    while at < x[1]:
        choice = rng.random()
        if choice < 0.4:
            for step in range(int(rng.integers(3, 6))):
                site.put(objects.bollard(), placement(at + 1.5 * step, KERB_Y_M + 0.35, ground), _POST)
        elif choice < 0.7:
            where = placement(at, HOUSE_Y_M - 0.3, ground)
            site.put(objects.cabinet(), where, _rectangle((-0.45, 0.45), (-0.17, 0.17)))
        else:
            colour = objects.choice(rng, ((0.06, 0.25, 0.1), (0.08, 0.15, 0.4), (0.45, 0.12, 0.05)))
            site.put(objects.billboard(colour), placement(at, HOUSE_Y_M - 0.5, ground))
        at += rng.uniform(14, 28)
    mesh = site.mesh
    for bay in np.arange(begin, x[1], 5.6):
        mesh.add_rectangle((bay - 0.05, bay + 0.05), (LANE_M, KERB_Y_M), 0.003, Material.MARKING, _LINE)
    mesh.add_rectangle((begin, x[1]), (LANE_M - 0.05, LANE_M + 0.05), 0.0025, Material.MARKING, _LINE)
    # gutter of small stones along the kerb
    mesh.add_rectangle((begin, x[1]), (KERB_Y_M - 0.3, KERB_Y_M), 0.002, Material.PAVING, (0.17, 0.165, 0.155))
    return site


def _road_details(mesh: MeshBuilder, x: Pair, rng: Generator) -> None:
    """Middle line, repaired patches, manholes along a road on the x axis."""
    for dash in np.arange(x[0], x[1] - 3, 6.0):
        mesh.add_rectangle((dash, dash + 3.0), (-0.06, 0.06), 0.003, Material.MARKING, _LINE)
    for at in np.arange(x[0], x[1], 7.0):
        if rng.random() < 0.6:
            start, width = at + rng.uniform(0, 4), rng.uniform(0.6, 1.6)
            y, length = rng.uniform(-3.2, 2.2), rng.uniform(1, 4)
            tone = rng.uniform(0.05, 0.085)
            mesh.add_rectangle((start, start + length), (y, y + width), 0.0015, Material.ASPHALT, (tone, tone, tone))
        if rng.random() < 0.5:
            where = (at + rng.uniform(0, 7), rng.uniform(-3, 3), 0.004)
            mesh.add_disc(where, (0, 0, 1), 0.36, Material.STONE, (0.2, 0.195, 0.19), 24)
            mesh.add_disc((*where[:2], 0.005), (0, 0, 1), 0.29, Material.METAL, (0.07, 0.065, 0.06), 24)


def _block(mesh: MeshBuilder, outline: NDArray[np.float64]) -> None:
    """A raised block of pavement with a kerb, from a convex counter-clockwise outline (N×2)."""
    following = np.roll(outline, -1, axis=0)
    for a, b in zip(outline, following, strict=True):
        face = [(*a, 0.0), (*b, 0.0), (*b, KERB_HEIGHT_M), (*a, KERB_HEIGHT_M)]
        mesh.add_polygon(face, Material.STONE, _KERB)
    mesh.add_ground_polygon(outline, KERB_HEIGHT_M, Material.PAVING, _PAVING)
    # the kerb stones' tops: a strip along each edge, moved inwards along the mean of the edges' normals
    edge = following - outline
    inward = np.stack((-edge[:, 1], edge[:, 0]), -1) / np.linalg.norm(edge, axis=1, keepdims=True)
    joint = inward + np.roll(inward, 1, axis=0)
    joint = joint / np.sum(joint * inward, axis=1, keepdims=True) * 0.16
    inner = outline + joint
    for strip in zip(outline, following, np.roll(inner, -1, axis=0), inner, strict=True):
        mesh.add_ground_polygon(strip, KERB_HEIGHT_M + 0.002, Material.STONE, _KERB)


_DAYLIGHT = Lighting(
    exposure=0.56,
    ambient_up=(0.68, 0.76, 0.92),
    ambient_down=(0.30, 0.27, 0.23),
    # ahead and left, so that one camera looks into the light and the other with it
    sun_direction=(0.479, 0.628, 0.613),
    sun=(2.5, 2.35, 2.05),
)


def _driven_through(
    options: SynthesizeOptions, site: _Site, lighting: Lighting, route: Route | WindingRoute, start_m: Real = 0.0
) -> SceneModel:
    """The scene with the recording car on its route, from an arc length on, and what moves."""
    drive = Drive.random(route, start_m, options.mean_speed_m_s, np.random.default_rng([options.seed, 2]))
    movers = []
    if options.scene == "traffic":
        movers = traffic(drive, options.frames * FRAME_INTERVAL_S, np.random.default_rng([options.seed, 4]))
    return SceneModel(site.mesh.build(), movers, lighting, site.contacts, drive)


def _end(site: _Site, reach: Real, rng: Generator) -> None:
    """What closes the view along a road on the x axis: houses across it, and a belt of trees."""
    far = _Site()
    _houses(far, (-30.0, 26.0), rng)
    site.put_site(far, placement(reach + 15, 0, 0, -np.pi / 2))
    site.put(objects.thicket(2 * reach, 12.0, rng), placement(reach + 25, -reach, 0, np.pi / 2))


def _street(options: SynthesizeOptions, length: Real, rng: Generator) -> SceneModel:
    x = (-60.0, length + 75.0)
    site = _Site()
    mesh = site.mesh
    mesh.add_rectangle((x[0] - 150, x[1] + 150), (-200, 200), -0.01, Material.GRASS, _GRASS)
    mesh.add_rectangle((x[0] - 60, x[1] + 60), (-KERB_Y_M, KERB_Y_M), 0.0, Material.ASPHALT, _ASPHALT)
    _road_details(mesh, x, rng)
    for side in (1, -1):
        outline = np.array(_rectangle((x[0] - 60, x[1] + 60), (KERB_Y_M, 45.0)))
        _block(mesh, outline if side > 0 else -outline)
        row = _street_side(x, 0.0, np.pi if side > 0 else 0.0, rng)
        site.put_site(row, placement(0, 0, mirror_y=side < 0))
        back = objects.thicket(x[1] - x[0] + 80, 12.0, rng)
        site.put(back, placement(x[0] - 40, side * 42.0))
    for end, yaw in ((x[0] - 40, np.pi / 2), (x[1] + 40, -np.pi / 2)):
        row = _Site()
        _houses(row, (-30.0, 26.0), rng)
        site.put_site(row, placement(end, 0, 0, yaw))
    return _driven_through(options, site, _DAYLIGHT, Route((0.0, -1.75)))


_CORNER_M = 4.0
"""Radius of the kerb at a junction's corners."""


def _traffic_light(site: _Site, x: Real, y: Real, yaw_rad: Real) -> None:
    mesh = MeshBuilder()
    mesh.add_rod((0, 0, 0), (0, 0, 3.3), 0.055, Material.METAL, (0.2, 0.21, 0.21))
    mesh.add_box((-0.12, 0, 2.85), (0.2, 0.3, 0.9), Material.PAINTED, (0.02, 0.02, 0.02))
    for z, colour in ((3.13, (0.6, 0.02, 0.01)), (2.85, (0.2, 0.12, 0.01)), (2.57, (0.01, 0.12, 0.05))):
        mesh.add_disc((-0.225, 0, z), (1, 0, 0), 0.1, Material.PAINTED, colour)
    site.put(mesh.build(), placement(x, y, KERB_HEIGHT_M, yaw_rad), _rectangle((-0.1, 0.1), (-0.1, 0.1)))


def _crossing(mesh: MeshBuilder, near: Real) -> None:
    """Zebra stripes from x = `near` on, and a stop line, across the arm that leaves the origin along x."""
    for y in np.arange(-KERB_Y_M + 0.35, KERB_Y_M - 0.5, 1.0):
        mesh.add_rectangle((near, near + 3.0), (y, y + 0.5), 0.003, Material.MARKING, _LINE)
    mesh.add_rectangle((near + 3.7, near + 4.15), (0.1, LANE_M), 0.003, Material.MARKING, _LINE)


def _turn(options: SynthesizeOptions, length: Real, rng: Generator) -> SceneModel:
    straight = 15.0
    route = Route((0.0, -1.75), 0.0, Turn(-np.pi / 2, 8.0, straight))
    # a drive too short for all of it has the turn in its middle
    start = max(0.0, straight + route.turn_length_m / 2 - length / 2)
    after, _ = route.at(np.array([straight + route.turn_length_m]))
    centre_x = float(after[0, 0]) + 1.75
    site = _Site()
    mesh = site.mesh
    mesh.add_rectangle((-260, 320), (-320, 260), -0.01, Material.GRASS, _GRASS)
    reach = max(65.0, length + 45.0)
    for half_x, half_y, z in ((reach + 60, KERB_Y_M, 0.0), (KERB_Y_M, reach + 60, -0.001)):
        mesh.add_rectangle((centre_x - half_x, centre_x + half_x), (-half_y, half_y), z, Material.ASPHALT, _ASPHALT)
    # the road's full width at the corners, where the kerb is round
    inner = KERB_Y_M + _CORNER_M
    mesh.add_rectangle((centre_x - inner, centre_x + inner), (-inner, inner), 0.0007, Material.ASPHALT, _ASPHALT)
    house_gap = HOUSE_Y_M + 10.0 + 2.5
    for arm in range(4):
        local = _Site()
        # two opposite arms own the corner houses, the others begin behind them
        corner = arm % 2 == 0
        begin = HOUSE_Y_M if corner else house_gap
        clear = 16.5 - HOUSE_Y_M if corner else 1.0
        for side in (1, -1):
            row = _street_side((begin, reach), clear, np.pi if side > 0 else 0.0, rng, corner)
            local.put_site(row, placement(0, 0, mirror_y=side < 0))
            angles = np.linspace(np.pi, 1.5 * np.pi, 9)
            arc = inner + _CORNER_M * np.column_stack((np.cos(angles), np.sin(angles)))
            if side > 0:
                far = [(reach + 60, KERB_Y_M), (reach + 60, reach + 60), (KERB_Y_M, reach + 60)]
                _block(local.mesh, np.concatenate((arc, far)))
            _traffic_light(local, inner + 3.4, side * (KERB_Y_M + 0.35), np.pi if side > 0 else 0.0)
        _crossing(local.mesh, inner + 0.3)
        _road_details(local.mesh, (inner + 4.5, reach), rng)
        _end(local, reach, rng)
        site.put_site(local, placement(centre_x, 0, 0, arm * np.pi / 2))
    return _driven_through(options, site, _DAYLIGHT, route, start)


ISLAND_M = 7.5
"""Radius of a roundabout's island."""
_RING_M = 10.25
"""Radius that is driven around it."""
_RING_KERB_M = 13.0
_ENTRY_RADIUS_M = 12.0
_FLARE_M = 8.0
"""Radius of the kerb where a road meets the roundabout."""
_APPROACH_M = 12.0
"""Straight stretch before the first turn."""


def roundabout_route() -> tuple[WindingRoute, NDArray[np.float64]]:
    """The way into a roundabout along x, around its island, and out to the left; and the island's centre, x and y."""

    def laid_out(entry_rad: float) -> tuple[WindingRoute, NDArray[np.float64]]:
        entry = Turn(-entry_rad, _ENTRY_RADIUS_M, _APPROACH_M)
        around = Turn(np.pi / 2 + 2 * entry_rad, _RING_M)
        route = WindingRoute((0.0, -1.75), 0.0, (entry, around, Turn(-entry_rad, _ENTRY_RADIUS_M)))
        place, heading = route.at(np.array([(route.ends_m[0] + route.ends_m[1]) / 2]))
        return route, place[0] + _RING_M * np.array((-np.sin(heading[0]), np.cos(heading[0])))

    # a sharper entry moves the ring to the right; the roads' middle lines meet in the island's centre
    entry_rad = root_scalar(lambda angle: laid_out(angle)[1][1], bracket=(0.4, 1.4)).root
    return laid_out(float(entry_rad))


def _island(rng: Generator) -> _Site:
    """A roundabout's island about the origin: a kerb, a strip of paving, a mound of grass with trees and shrubs."""
    site = _Site()
    around = np.linspace(0, 2 * np.pi, 73)[:-1]
    circle = np.column_stack((np.cos(around), np.sin(around)))
    _block(site.mesh, ISLAND_M * circle)
    rings = [
        np.column_stack((radius * circle, np.full(len(circle), KERB_HEIGHT_M + height)))
        for radius, height in ((6.2, 0.0), (5.6, 0.12), (4.4, 0.32), (2.8, 0.48), (1.2, 0.55), (0.05, 0.56))
    ]
    site.mesh.add_loft(np.array(rings), Material.GRASS, _GRASS, closed=False)
    first, trees = rng.uniform(0, 2 * np.pi), int(rng.integers(5, 7))
    for number in range(trees):
        # one in the middle, the others around it
        angle = first + 2 * np.pi * number / (trees - 1) + rng.normal(0, 0.12)
        away = 0.0 if number == 0 else rng.uniform(3.4, 4.4)
        where = placement(away * np.cos(angle), away * np.sin(angle), KERB_HEIGHT_M + 0.25, rng.uniform(0, 6.28))
        site.put(objects.tree(rng.uniform(6.0, 9.5), rng, leaves=12000), where, _POST)
    for number in range(7):
        angle, length = first + 0.4 + 2 * np.pi * number / 7 + rng.normal(0, 0.08), rng.uniform(1.2, 2.6)
        shrub = objects.hedge(length, rng.uniform(0.5, 0.9), rng)
        # along the rim
        start = 5.1 * np.array((np.cos(angle), np.sin(angle))) + length / 2 * np.array((np.sin(angle), -np.cos(angle)))
        where = placement(start[0], start[1], KERB_HEIGHT_M + 0.12, angle + np.pi / 2)
        site.put(shrub, where, _rectangle((0, length), (-0.3, 0.3)))
    return site


def _chevrons(site: _Site, distance_m: Real, angle_rad: Real) -> None:
    """A board with stripes on the island that faces away from the origin, towards those who come in."""
    mesh = MeshBuilder()
    for y in (-0.8, 0.8):
        mesh.add_rod((-0.06, y, 0), (-0.06, y, 1.1), 0.03, Material.METAL, (0.3, 0.31, 0.32), 8)
    mesh.add_box((0, 0, 0.85), (0.05, 2.0, 0.5), Material.PAINTED, (0.7, 0.7, 0.68))
    for y in np.arange(-0.8, 0.6, 0.5):
        for edge in (0.6, 1.1):
            stripe = [(0.027, y, edge), (0.027, y + 0.25, edge), (0.027, y + 0.37, 0.85), (0.027, y + 0.12, 0.85)]
            mesh.add_polygon(stripe, Material.PAINTED, (0.5, 0.02, 0.02))
    where = placement(distance_m * np.cos(angle_rad), distance_m * np.sin(angle_rad), KERB_HEIGHT_M, angle_rad)
    site.put(mesh.build(), where, _rectangle((-0.1, 0.1), (-1.0, 1.0)))


def _ring_corner(reach: Real, rng: Generator) -> _Site:
    """What lies between two arms of a roundabout, along x and y: pavement with a kerb, a house, trees, furniture."""
    site = _Site()
    # the kerb's arcs about points from which they touch the road's kerb and the ring
    along = np.sqrt((_RING_KERB_M + _FLARE_M) ** 2 - (KERB_Y_M + _FLARE_M) ** 2)
    touch = np.arctan2(KERB_Y_M + _FLARE_M, along)
    bend = np.linspace(1.5 * np.pi, np.pi + touch, 9)
    flare = (along, KERB_Y_M + _FLARE_M) + _FLARE_M * np.column_stack((np.cos(bend), np.sin(bend)))
    ring = np.linspace(touch, np.pi / 2 - touch, 7)[1:-1]
    arc = _RING_KERB_M * np.column_stack((np.cos(ring), np.sin(ring)))
    kerb = np.concatenate(([(reach + 60, KERB_Y_M)], flare, arc, flare[::-1, ::-1], [(KERB_Y_M, reach + 60)]))
    _pavement(site.mesh, kerb[::-1], (reach + 60, reach + 60))
    width = rng.uniform(9, 11)
    outward, sideways = np.array((np.sqrt(0.5), np.sqrt(0.5))), np.array((np.sqrt(0.5), -np.sqrt(0.5)))

    def put(thing: Geometry, out: Real, side: Real, half: Pair) -> None:
        """Put a thing at a distance from the centre; its y axis points away from there."""
        x, y = out * outward + side * sideways
        outline = _rectangle((-half[0], half[0]), (-half[1], half[1]))
        site.put(thing, placement(x, y, KERB_HEIGHT_M, -np.pi / 4), outline)

    corner = 19.0 * outward - width / 2 * sideways
    house = placement(corner[0], corner[1], KERB_HEIGHT_M, -np.pi / 4)
    site.put(objects.house(width, 10.0, rng, rng.random() < 0.5), house, _rectangle((0, width), (0, 10.0)))
    for side in (-1, 1):
        put(objects.tree(rng.uniform(6.0, 9.0), rng), 16.6, side * rng.uniform(3.2, 4.2), (0.14, 0.14))
        garden = objects.tree(rng.uniform(5, 8), rng, leaves=5000)
        put(garden, rng.uniform(24.0, 26.0), side * rng.uniform(8.0, 8.8), (0.14, 0.14))
        length = rng.uniform(3.0, 4.0)
        hedge = objects.hedge(length, rng.uniform(0.9, 1.5), rng)
        x, y = (20.0, 9.6) if side > 0 else (9.6, 20.0 + length)
        yaw = 0.0 if side > 0 else -np.pi / 2
        site.put(hedge, placement(x, y, KERB_HEIGHT_M, yaw), _rectangle((0, length), (-0.3, 0.3)))
    # its arm reaches over the road
    put(objects.street_lamp(), 13.6, 0.0, (0.1, 0.1))
    if rng.random() < 0.4:
        put(objects.billboard((0.06, 0.25, 0.1)), 18.6, 0.5 * width - 1.6, (1.8, 0.1))
    for step in range(int(rng.integers(2, 5))):
        put(objects.bollard(), 14.0, 1.2 + 1.2 * step, (0.06, 0.06))
    put(objects.cabinet(), 18.4, -rng.uniform(1.0, 3.0), (0.45, 0.17))
    return site


def _pavement(mesh: MeshBuilder, kerb: NDArray[np.float64], far: Pair) -> None:
    """Raised pavement with a kerb along a line (N×2) that has it on its right; `far` sees all of the line."""
    low, high = (np.column_stack((kerb, np.full(len(kerb), z))) for z in (0.0, KERB_HEIGHT_M))
    edge = np.diff(kerb, axis=0)
    inward = np.stack((edge[:, 1], -edge[:, 0]), -1) / np.linalg.norm(edge, axis=1, keepdims=True)
    joint = np.concatenate((inward[:1], inward[:-1] + inward[1:], inward[-1:]))
    inner = kerb + 0.16 * joint / np.sum(joint * np.concatenate((inward[:1], inward)), axis=1, keepdims=True)
    for i in range(len(edge)):
        mesh.add_polygon([low[i], low[i + 1], high[i + 1], high[i]], Material.STONE, _KERB)
        mesh.add_ground_polygon([far, kerb[i], kerb[i + 1]], KERB_HEIGHT_M, Material.PAVING, _PAVING)
        strip = [kerb[i], kerb[i + 1], inner[i + 1], inner[i]]
        mesh.add_ground_polygon(strip, KERB_HEIGHT_M + 0.002, Material.STONE, _KERB)


def _ring_arm(reach: Real, rng: Generator) -> _Site:
    """A road that leaves a roundabout along x, with what stands on both of its sides."""
    site, begin = _Site(), 27.0
    mesh = site.mesh
    for side in (1, -1):
        row = _street_side((begin, reach), 1.0, np.pi if side > 0 else 0.0, rng)
        site.put_site(row, placement(0, 0, mirror_y=side < 0))
    # an island between those who come and those who leave
    _block(mesh, np.array([(14.8, -0.55), (18.2, -0.3), (18.2, 0.3), (14.8, 0.55)]))
    site.put(objects.road_sign(2), placement(17.8, 0.0, KERB_HEIGHT_M, np.pi), _POST)
    site.put(objects.bollard(), placement(15.2, 0.0, KERB_HEIGHT_M), _POST)
    site.put(objects.road_sign(1), placement(19.5, KERB_Y_M + 0.35, KERB_HEIGHT_M, np.pi), _POST)
    _crossing(mesh, 19.0)
    _road_details(mesh, (begin - 2.0, reach), rng)
    # where those who come in give way: short bars across the mouth
    for angle in np.arange(0.07, 0.6, 0.06):
        bar = [(r, a) for r, a in ((13.1, angle), (13.5, angle), (13.5, angle + 0.03), (13.1, angle + 0.03))]
        corners = [(r * np.cos(a), r * np.sin(a)) for r, a in bar]
        mesh.add_ground_polygon(corners, 0.003, Material.MARKING, _LINE)
    _end(site, reach, rng)
    return site


def _roundabout(options: SynthesizeOptions, length: Real, rng: Generator) -> SceneModel:
    route, centre = roundabout_route()
    # a drive too short for all of it has its middle beside the island
    start = max(0.0, (route.ends_m[0] + route.ends_m[1] - length) / 2)
    reach = max(65.0, length + 45.0)
    site, middle = _Site(), _Site()
    site.mesh.add_rectangle((-260, 320), (-320, 260), -0.01, Material.GRASS, _GRASS)
    for half_x, half_y, z in ((reach + 60, KERB_Y_M, 0.0), (KERB_Y_M, reach + 60, -0.001)):
        middle.mesh.add_rectangle((-half_x, half_x), (-half_y, half_y), z, Material.ASPHALT, _ASPHALT)
    middle.mesh.add_disc((0, 0, 0.0007), (0, 0, 1), 24.0, Material.ASPHALT, _ASPHALT, 48)
    middle.put_site(_island(rng), np.eye(4))
    for arm in range(4):
        turned = placement(0, 0, 0, arm * np.pi / 2)
        middle.put_site(_ring_arm(reach, rng), turned)
        middle.put_site(_ring_corner(reach, rng), turned)
        # the first thing that those who come in by this arm see of the island
        _chevrons(middle, ISLAND_M - 0.6, arm * np.pi / 2 + 0.2)
    site.put_site(middle, placement(centre[0], centre[1]))
    return _driven_through(options, site, _DAYLIGHT, route, start)


_CEILING_M = 2.6
_BAY_M = 2.5
_AISLE_HALF_M = 3.0
_BAY_DEPTH_M = 5.0
_LINE_COLOUR: Colour = (0.62, 0.52, 0.10)


def _bays(site: _Site, x: Pair, front_y: Real, side: int, share: Real, rng: Generator) -> None:
    """Parking bays across the aisle from `front_y` on, with lines, numbers and some cars."""
    back_y = front_y + side * _BAY_DEPTH_M
    y = (min(front_y, back_y), max(front_y, back_y))
    for start in np.arange(x[0], x[1] - _BAY_M + 0.01, _BAY_M):
        site.mesh.add_rectangle((start - 0.05, start + 0.05), y, 0.003, Material.MARKING, _LINE_COLOUR)
        low, high = sorted((front_y + side * 0.3, front_y + side * 0.7))
        site.mesh.add_rectangle((start + 0.8, start + 1.7), (low, high), 0.003, Material.PRINT, (0.25, 0.24, 0.22))
        if rng.random() < share:
            geometry, shape = objects.random_car(rng)
            yaw = side * np.pi / 2 * (1 if rng.random() < 0.7 else -1) + rng.normal(0, 0.025)
            depth = front_y + side * (shape.length / 2 + rng.uniform(0.1, 0.3 + _BAY_DEPTH_M - shape.length))
            where = placement(start + _BAY_M / 2 + rng.normal(0, 0.08), depth, 0, yaw)
            site.put(geometry, where, _car_outline(shape))


def _pillar(site: _Site, x: Real, y: Real, number: int) -> None:
    mesh, half = site.mesh, 0.26
    mesh.add_box((x, y, _CEILING_M / 2), (2 * half, 2 * half, _CEILING_M), Material.CONCRETE, (0.40, 0.39, 0.37))
    for band in range(5):
        colour: Colour = (0.55, 0.40, 0.02) if band % 2 == 0 else (0.03, 0.03, 0.03)
        size = 2 * half + 0.012
        mesh.add_box((x, y, 0.1 + 0.2 * band), (size, size, 0.2), Material.PAINTED, colour)
    colour = ((0.05, 0.2, 0.45), (0.4, 0.05, 0.05), (0.06, 0.3, 0.1))[number % 3]
    mesh.add_box((x, y, 1.75), (2 * half + 0.012, 2 * half + 0.012, 0.45), Material.PRINT, colour)
    site.contacts.append(np.array(_rectangle((x - half, x + half), (y - half, y + half))))


def _parking(options: SynthesizeOptions, length: Real, rng: Generator) -> SceneModel:
    bays = 7.5
    x0, x1 = -15.0, bays * np.ceil((length + 18.0) / bays)
    wall_left = _AISLE_HALF_M + _BAY_DEPTH_M + 0.2
    second = -(_AISLE_HALF_M + 2 * _BAY_DEPTH_M + _AISLE_HALF_M)
    wall_right = second - _AISLE_HALF_M - _BAY_DEPTH_M - 0.2
    site = _Site()
    mesh = site.mesh
    whole = (x0, x1), (wall_right, wall_left)
    mesh.add_rectangle(*whole, 0.0, Material.CONCRETE, _CONCRETE)
    mesh.add_rectangle(*whole, _CEILING_M, Material.CONCRETE, (0.42, 0.41, 0.39))
    corners = [np.array(corner) for corner in _rectangle(*whole)]
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        inward = np.array([-(b - a)[1], (b - a)[0]]) / np.linalg.norm(b - a)
        for low, high, inset, kind, tint in (
            (0.0, _CEILING_M, 0.0, Material.CONCRETE, (0.46, 0.45, 0.43)),
            (0.0, 1.1, 0.004, Material.PLASTER, (0.16, 0.27, 0.24)),
            (1.1, 1.2, 0.006, Material.PAINTED, (0.50, 0.38, 0.03)),
        ):
            start, end = a + inward * inset, b + inward * inset
            mesh.add_polygon([(*start, low), (*end, low), (*end, high), (*start, high)], kind, tint)
    for middle, share in ((0.0, 0.62), (second, 0.5)):
        for side in (1, -1):
            _bays(site, (x0, x1), middle + side * _AISLE_HALF_M, side, share, rng)
    number = 0
    for x in np.arange(x0 + bays, x1 - 0.1, bays):
        for y in (3.9, -3.9, -_AISLE_HALF_M - _BAY_DEPTH_M, second + 3.9, second - 3.9):
            _pillar(site, x, y, number)
            number += 1
        beam = (x, (wall_left + wall_right) / 2, _CEILING_M - 0.14)
        mesh.add_box(beam, (0.45, wall_left - wall_right, 0.28), Material.CONCRETE, (0.40, 0.39, 0.37))
    lamps = []
    for y in (0.0, second):
        for x in np.arange(x0 + bays / 4, x1, bays / 2):
            mesh.add_box((x, y, _CEILING_M - 0.10), (1.3, 0.16, 0.07), Material.PAINTED, (0.5, 0.5, 0.5))
            mesh.add_box((x, y, _CEILING_M - 0.145), (1.2, 0.07, 0.03), Material.LAMP, (0.95, 1.0, 0.92))
            lamps.append((x, y, _CEILING_M - 0.20))
    middle, span = (x0 + x1) / 2, x1 - x0
    mesh.add_rod((x0, 2.1, 2.26), (x1, 2.1, 2.26), 0.05, Material.PAINTED, (0.38, 0.03, 0.025), 12)
    mesh.add_rod((x0, 2.45, 2.27), (x1, 2.45, 2.27), 0.035, Material.METAL, (0.32, 0.33, 0.33), 12)
    mesh.add_box((middle, -2.2, 2.25), (span, 0.32, 0.05), Material.METAL, (0.34, 0.35, 0.35))
    mesh.add_box((middle, 6.2, 2.33), (span, 0.7, 0.34), Material.METAL, (0.40, 0.41, 0.42))
    for x in np.arange(x0 + 4, x1, 3.0):
        mesh.add_rod((x, 2.1, 2.26), (x, 2.1, 2.10), 0.02, Material.METAL, (0.4, 0.4, 0.4), 8)
    for x in np.arange(x0 + 6, x1, 22.5):
        mesh.add_box((x, wall_left - 0.03, 1.05), (1.0, 0.06, 2.1), Material.PAINTED, (0.33, 0.35, 0.36))
        mesh.add_box((x, wall_left - 0.08, 2.28), (0.6, 0.06, 0.22), Material.LAMP, (0.05, 0.42, 0.12))
        mesh.add_box((x + 1.4, wall_left - 0.1, 1.3), (0.3, 0.2, 0.7), Material.PAINTED, (0.45, 0.03, 0.02))
    for x in np.arange(x0 + 7, x1 - 4, 11.0):
        for y, facing in ((-1.4, 1), (1.4, -1)):
            mesh.add_rectangle((x - 0.8, x + 0.8), (y - 0.08, y + 0.08), 0.003, Material.MARKING, _LINE)
            head = [(x + facing * 1.5, y), (x + facing * 0.8, y + 0.35), (x + facing * 0.8, y - 0.35)]
            mesh.add_ground_polygon(head, 0.003, Material.MARKING, _LINE)
    lighting = Lighting(
        exposure=1.05,
        ambient_up=(0.30, 0.305, 0.28),
        ambient_down=(0.20, 0.20, 0.185),
        lamps=np.array(lamps),
        lamp=(1.9, 2.0, 1.8),
        lamp_reach_m=8.0,
    )
    return _driven_through(options, site, lighting, Route((0.0, -1.1)))


_BUILDERS = {"street": _street, "traffic": _street, "turn": _turn, "parking": _parking, "roundabout": _roundabout}


def build_scene(options: SynthesizeOptions) -> SceneModel:
    """Build the scene that the options name, as large as the drive needs; the same for the same options."""
    length = options.mean_speed_m_s * options.frames * FRAME_INTERVAL_S
    return _BUILDERS[options.scene](options, length, np.random.default_rng([options.seed, 1]))
