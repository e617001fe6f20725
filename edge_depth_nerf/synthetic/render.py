"""Casting rays into a scene, lighting what they hit, and pictures through a fisheye lens.

Frames: world (z up), camera (x right, y down, z forward); metres, seconds. Distances run along unit rays, `inf`
where nothing is hit. Radiance is linear RGB; a picture's values come from it by `Lighting.exposure`, clipping at 1
and sRGB's curve. Surfaces are dull (Lambert) under sun, lamps and a sky, with a slight mirror on glass and paint;
the sun and lamps cast shadows. Nothing but what moves depends on time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from edge_depth_nerf.base.interrupts import ctrl_c_put_off
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.synthetic.geometry import Geometry, flat_normals
from edge_depth_nerf.synthetic.materials import (
    LASER_REFLECTANCE,
    MIRROR_REFLECTANCE,
    TRANSLUCENCY,
    Material,
    Noise,
    read_map,
    reflectance,
)
from edge_depth_nerf.synthetic.motion import Mover
from edge_depth_nerf.synthetic.objects import recording_car
from edge_depth_nerf.synthetic.scenes import SceneModel

Array = NDArray[np.float32]

LENS_THETA_DEG = 97.0
"""KITTI-360's lens circle: rays up to here are seen in full."""

_RIM_WIDTH_DEG = np.array((2.2, 2.7, 3.4))
"""How far outside the lens circle red, green and blue have faded to nothing."""

_SUBSAMPLES = ((-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
"""Offsets from the pixel's centre, in pixels."""
_CHUNK_PIXELS = 1 << 17
_SHADOW_OFFSET_M = 4e-3
_STATIC = 0
_NOTHING = -1


def _f32(values: Sequence[float | int] | NDArray[np.float64]) -> Array:
    return np.array(values, np.float32)


class Caster:
    """First hits and shadows on one geometry, by Embree."""

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self.flat_normals = flat_normals(geometry.corners)
        from_middle = geometry.corners.reshape(-1, 3) - (0.0, 0.0, 0.8)
        self.reach_m = max(3.0, float(np.linalg.norm(from_middle, axis=-1).max()))
        """Radius of a ball about a point 0.8 m above the ground that holds all of it; a car's is 3 m."""
        faces = np.arange(3 * len(geometry.corners), dtype=np.int32).reshape(-1, 3)
        self._scene = EmbreeScene()
        # embree's wrapper swallows what is raised while it builds, Ctrl-C included
        with ctrl_c_put_off():
            TriangleMesh(scene=self._scene, vertices=geometry.corners.reshape(-1, 3).astype(np.float32), indices=faces)

    def first_hits(self, origins: Array, directions: Array) -> tuple[Array, NDArray[np.int32], Array]:
        """Distance (inf = none), triangle (-1 = none) and barycentric u, v of the first hit of N rays."""
        if not len(origins):
            return np.zeros(0, np.float32), np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        hit = self._scene.run(origins, directions, query="INTERSECT", output=1)
        distance = np.where(hit["primID"] >= 0, hit["tfar"], np.float32(np.inf))
        return distance, hit["primID"], np.stack((hit["u"], hit["v"]), -1)

    def blocked(self, origins: Array, directions: Array, reach_m: float | int | Array) -> NDArray[np.bool_]:
        """Whether anything lies within reach along N rays."""
        if not len(origins):
            return np.zeros(0, bool)
        reach = np.broadcast_to(np.asarray(reach_m, np.float32), (len(origins),)).copy()
        return self._scene.run(origins, directions, reach, query="OCCLUDED") != -1


@dataclass(frozen=True)
class Hits:
    """First hits of N rays on anything."""

    distance_m: Array
    """N, inf = none."""
    thing: NDArray[np.int32]
    """N: -1 nothing, 0 the static scene, k the k-th thing that moves."""
    triangle: NDArray[np.int32]
    """N, within the thing."""
    barycentric: Array
    """N×2."""


def _rotated_by(vectors: Array, cos: Array, sin: Array) -> Array:
    """Turn N×3 vectors about z."""
    x, y, z = vectors.T
    return np.stack((cos * x - sin * y, sin * x + cos * y, z), -1).astype(np.float32)


class World:
    """A scene ready for rays."""

    def __init__(self, model: SceneModel, seed: int) -> None:
        self.model = model
        self._noise = Noise(seed)
        self._static = Caster(model.static)
        self._movers = [(mover, Caster(mover.geometry)) for mover in model.movers]
        self._ground = _GroundLight(model.contacts)
        direction = model.lighting.sun_direction
        self._sun = None if direction is None else _f32(direction)

    def trace(self, origins: Array, directions: Array, time_s: float | NDArray[np.float64]) -> Hits:
        """First hits of N rays, each at its own time."""
        distance, triangle, barycentric = self._static.first_hits(origins, directions)
        thing = np.where(triangle >= 0, _STATIC, _NOTHING).astype(np.int32)
        times = np.broadcast_to(np.asarray(time_s, np.float64), (len(origins),))
        for number, (mover, caster) in enumerate(self._movers, start=1):
            near, its_origins, its_directions = _in_frame_of(mover, caster.reach_m, times, origins, directions)
            its_distance, its_triangle, its_barycentric = caster.first_hits(its_origins, its_directions)
            closer = its_distance < distance[near]
            rows = near[closer]
            distance[rows], triangle[rows] = its_distance[closer], its_triangle[closer]
            barycentric[rows], thing[rows] = its_barycentric[closer], number
        return Hits(distance, thing, triangle, barycentric)

    def _lit(self, origins: Array, directions: Array, reach_m: float | int | Array, time_s: float) -> NDArray[np.bool_]:
        free = ~self._static.blocked(origins, directions, reach_m)
        reach = np.broadcast_to(np.asarray(reach_m, np.float32), (len(origins),))
        times = np.full(len(origins), time_s)
        for mover, caster in self._movers:
            near, its_origins, its_directions = _in_frame_of(mover, caster.reach_m, times, origins, directions)
            free[near] &= ~caster.blocked(its_origins, its_directions, reach[near])
        return free

    def _surfaces(
        self, origins: Array, directions: Array, hits: Hits, rows: NDArray, time_s: NDArray, pixel_rad: float
    ) -> tuple[Array, Array, Array, Array, NDArray[np.uint8]]:
        """Position, flat normal, shading normal (both facing the ray), reflectance and material, of rows that hit."""
        distance = hits.distance_m[rows, None]
        position = origins[rows] + directions[rows] * distance
        count = len(rows)
        flat, smooth, tint = (np.empty((count, 3), np.float32) for _ in range(3))
        colour = np.empty((count, 3), np.float32)
        material = np.empty(count, np.uint8)
        things = hits.thing[rows]
        for number in np.unique(things):
            own = np.flatnonzero(things == number)
            caster = self._static if number == _STATIC else self._movers[number - 1][1]
            geometry, triangle = caster.geometry, hits.triangle[rows[own]]
            u, v = hits.barycentric[rows[own], :, None].transpose(1, 0, 2)
            normals = geometry.normals[triangle]
            smooth_own = (1 - u - v) * normals[:, 0] + u * normals[:, 1] + v * normals[:, 2]
            flat_own, local, ray = caster.flat_normals[triangle], position[own], directions[rows[own]]
            material[own], tint[own] = geometry.material[triangle], geometry.tint[triangle]
            if number != _STATIC:
                cos, sin, shift = _pose_of(self._movers[number - 1][0], time_s[rows[own]])
                local, ray = _rotated_by(local - shift, cos, -sin), _rotated_by(ray, cos, -sin)
            slant = np.abs(np.sum(ray * flat_own, -1))
            footprint = distance[own, 0] * pixel_rad / np.sqrt(np.maximum(slant, 0.02)) + np.float32(1e-5)
            colour[own] = reflectance(self._noise, material[own], tint[own], local, flat_own, footprint)
            if number != _STATIC:
                flat_own, smooth_own = _rotated_by(flat_own, cos, sin), _rotated_by(smooth_own, cos, sin)
            flat[own], smooth[own] = flat_own, smooth_own
        flat *= -np.sign(np.sum(flat * directions[rows], -1, keepdims=True))
        smooth *= np.where(np.sum(smooth * flat, -1, keepdims=True) < 0, -1, 1)
        smooth /= np.maximum(np.linalg.norm(smooth, axis=-1, keepdims=True), 1e-6)
        return position, flat, smooth, colour, material

    def radiance(self, origins: Array, directions: Array, hits: Hits, time_s: float, pixel_rad: float) -> Array:
        """Linear RGB that N rays bring, N×3; `pixel_rad` is the angle between neighbouring rays."""
        light = self.model.lighting
        result = np.zeros((len(origins), 3), np.float32)
        if self._sun is not None:
            missed = np.flatnonzero(hits.thing == _NOTHING)
            result[missed] = self._sky(directions[missed], self._sun)
        rows = np.flatnonzero(hits.thing != _NOTHING)
        if not len(rows):
            return result
        times = np.full(len(origins), time_s)
        position, flat, normal, colour, material = self._surfaces(origins, directions, hits, rows, times, pixel_rad)
        start = position + flat * np.float32(_SHADOW_OFFSET_M) + flat * (1e-4 * hits.distance_m[rows, None])
        up = 0.5 + 0.5 * normal[:, 2:]
        irradiance = up * _f32(light.ambient_up) + (1 - up) * _f32(light.ambient_down)
        irradiance *= self._ground.openness(position, normal)[:, None]
        if self._sun is not None:
            self._add_sun(self._sun, irradiance, start, flat, normal, material, time_s)
        for lamp in light.lamps:
            self._add_lamp(irradiance, lamp, start, normal, time_s)
        radiance = colour * irradiance
        mirror = MIRROR_REFLECTANCE[material]
        shiny = np.flatnonzero(mirror)
        if len(shiny):
            ray, its_normal = directions[rows[shiny]], normal[shiny]
            facing = np.clip(-np.sum(ray * its_normal, -1), 0, 1)
            share = mirror[shiny] + (1 - mirror[shiny]) * (1 - facing) ** 5
            reflected = ray + 2 * facing[:, None] * its_normal
            seen = self._surroundings(reflected)
            radiance[shiny] += share[:, None] * (seen - radiance[shiny])
        lamps = material == Material.LAMP
        radiance[lamps] = 2.2 * colour[lamps]
        result[rows] = radiance
        return result

    def _add_sun(
        self, sun: Array, irradiance: Array, start: Array, flat: Array, normal: Array, material: NDArray, time_s: float
    ) -> None:
        facing = normal @ sun
        strength = np.where((flat @ sun > 0) | (TRANSLUCENCY[material] > 0), np.maximum(facing, 0), 0)
        strength = np.maximum(strength, TRANSLUCENCY[material] * np.maximum(-facing, 0))
        rows = np.flatnonzero(strength)
        # from the far side of a leaf that the light shines through
        side = np.where(flat[rows] @ sun > 0, 0.0, -2.2 * _SHADOW_OFFSET_M).astype(np.float32)
        free = self._lit(start[rows] + side[:, None] * flat[rows], np.tile(sun, (len(rows), 1)), 400.0, time_s)
        irradiance[rows] += (strength[rows] * free)[:, None] * _f32(self.model.lighting.sun)

    def _add_lamp(self, irradiance: Array, lamp: NDArray, start: Array, normal: Array, time_s: float) -> None:
        light = self.model.lighting
        # x alone rules most points out, at a third of the cost
        rows = np.flatnonzero(np.abs(start[:, 0] - np.float32(lamp[0])) < light.lamp_reach_m)
        to_lamp = _f32(lamp) - start[rows]
        square = np.sum(to_lamp * to_lamp, -1)
        within = np.flatnonzero(square < light.lamp_reach_m**2)
        rows, to_lamp, square = rows[within], to_lamp[within], square[within]
        distance = np.sqrt(square)
        direction = to_lamp / np.maximum(distance, 1e-3)[:, None]
        facing = np.sum(direction * normal[rows], -1)
        window = (1 - (distance / light.lamp_reach_m) ** 2) ** 2
        # a tube shines down, and some light reaches the ceiling about it
        strength = np.maximum(facing, 0) * window / (0.6 + square) * (0.35 + 0.65 * np.maximum(direction[:, 2], 0))
        bright = np.flatnonzero(strength > 2e-3)
        rows, direction, distance = rows[bright], direction[bright], distance[bright]
        free = self._lit(start[rows], direction, distance - 0.02, time_s)
        irradiance[rows] += (strength[bright] * free)[:, None] * _f32(light.lamp)

    def _sky(self, directions: Array, sun: Array) -> Array:
        """Radiance of the sky, N×3: a gradient, thin clouds, and a wide glare about the sun."""
        height = np.clip(directions[:, 2], 0, 1)
        low, high = _f32((1.05, 1.18, 1.32)), _f32((0.22, 0.46, 0.98))
        colour = low + (high - low) * (height**0.45)[:, None]
        flat = directions[:, :2] / (height + 0.18)[:, None]
        veil = np.zeros(len(directions), np.float32)
        for wavelength, amplitude in ((1.9, 0.5), (0.8, 0.3), (0.33, 0.18), (0.14, 0.1)):
            veil += amplitude * self._noise.wave(flat[:, 0], flat[:, 1], wavelength, 97)
        cloud = np.clip(1.1 * veil - 0.12, 0, 0.6) * np.clip(height * 6, 0, 1)
        colour = colour + (_f32((1.5, 1.53, 1.58)) - colour) * cloud[:, None]
        apart = np.arccos(np.clip(directions @ sun, -1, 1))
        glare = 2.6 * np.exp(-((apart / 0.62) ** 2)) + 0.7 * np.exp(-apart / 0.6)
        return (colour + glare[:, None] * _f32((1.0, 0.97, 0.9))).astype(np.float32)

    def _surroundings(self, directions: Array) -> Array:
        """What a mirror shows: the sky above, something dull below it."""
        if self._sun is None:
            share = np.clip(0.5 + directions[:, 2:], 0, 1)
            return share * _f32((0.34, 0.34, 0.31)) + (1 - share) * _f32((0.07, 0.07, 0.07))
        share = np.clip((directions[:, 2:] - 0.12) / 0.25, 0, 1)
        return share * np.minimum(self._sky(directions, self._sun), 1.6) + (1 - share) * _f32((0.16, 0.155, 0.14))

    def laser_echo(self, origins: Array, directions: Array, hits: Hits, time_s: NDArray[np.float64]) -> Array:
        """Strength of a laser's echo for N rays, 0-1; 0 where nothing is hit."""
        result = np.zeros(len(origins), np.float32)
        rows = np.flatnonzero(hits.thing != _NOTHING)
        if len(rows):
            _, _, normal, colour, material = self._surfaces(origins, directions, hits, rows, time_s, 3e-3)
            slant = np.abs(np.sum(normal * directions[rows], -1))
            result[rows] = np.clip(colour.mean(-1) * LASER_REFLECTANCE[material] * (0.3 + 0.7 * slant), 0, 1)
        return result

    def to_picture(self, radiance: Array, gain: float = 1.0) -> Array:
        """Picture values in 0-1 (sRGB) of linear radiance."""
        linear = np.clip(radiance * np.asarray(self.model.lighting.exposure * gain, np.float32), 0, 1)
        return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def _pose_of(mover: Mover, times: NDArray[np.float64]) -> tuple[Array, Array, Array]:
    """Cosine and sine of the heading (N) and the position (N×3) at N times."""
    distinct_s, which = np.unique(times, return_inverse=True)
    place, heading = mover.at(distinct_s)
    shift = np.column_stack((place, np.full(len(distinct_s), float(mover.ground_m))))
    return _f32(np.cos(heading))[which], _f32(np.sin(heading))[which], _f32(shift)[which]


def _in_frame_of(
    mover: Mover, reach_m: float, times: NDArray[np.float64], origins: Array, directions: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Rays that pass near a thing, in its frame at each ray's own time: their rows, origins and directions."""
    cos, sin, shift = _pose_of(mover, times)
    apart = shift + _f32((0, 0, 0.8)) - origins
    along = np.sum(apart * directions, -1)
    off = np.sum(apart * apart, -1) - along * along
    near = np.flatnonzero((off < reach_m**2) & (along > -reach_m))
    cos, sin, shift = cos[near], sin[near], shift[near]
    return near, _rotated_by(origins[near] - shift, cos, -sin), _rotated_by(directions[near], cos, -sin)


class _GroundLight:
    """How open to the sky the ground is: darker under and beside what stands on it; walls are darker at their feet."""

    _CELL_M = 0.08

    def __init__(self, contacts: list[NDArray[np.float64]]) -> None:
        if not contacts:
            self._map = None
            return
        every = np.concatenate(contacts)
        self._low = every.min(0) - 2.0
        size = np.ceil((every.max(0) + 2.0 - self._low) / self._CELL_M).astype(int)
        # a very long drive gets a coarser map: OpenCV's maps end at 2**15
        self._cell_m = self._CELL_M * max(1.0, float(size.max()) / 30000)
        size = np.ceil((every.max(0) + 2.0 - self._low) / self._cell_m).astype(int)
        covered = np.zeros((size[1], size[0]), np.uint8)
        for outline in contacts:
            pixels = np.rint((outline - self._low) / self._cell_m).astype(np.int32)
            cv2.fillConvexPoly(covered, pixels, (255,))
        near = cv2.GaussianBlur(covered, (0, 0), 0.14 / self._cell_m).astype(np.float32)
        far = cv2.GaussianBlur(covered, (0, 0), 0.55 / self._cell_m).astype(np.float32)
        self._map = 1 - (0.55 * near + 0.35 * far) / 255

    def openness(self, position: Array, normal: Array) -> Array:
        """Factor on the ambient light of N points, 0-1."""
        foot = 1 - 0.30 * np.exp(-np.maximum(position[:, 2], 0) / 0.5)
        level = np.flatnonzero((normal[:, 2] > 0.7) & (position[:, 2] < 0.35))
        factor = np.where(normal[:, 2] > 0.7, 1.0, foot).astype(np.float32)
        if self._map is not None:
            x, y = ((position[level, :2] - self._low) / self._cell_m - 0.5).astype(np.float32).T
            factor[level] = read_map(self._map, x, y, cv2.BORDER_CONSTANT)
        return factor


@dataclass(frozen=True)
class RenderedView:
    """What a camera sees, H×W."""

    radiance: Array
    """H×W×3, linear, behind the lens."""
    distance_m: Array
    """At pixel centres; 0 = sky, own car or outside the lens."""
    moving: NDArray[np.bool_]
    """Whether any part of the pixel shows a thing that moves."""


class FisheyeCamera:
    """A camera on the recording car, of any model: its rays, its lens, and the own car in its picture.

    Colours are the mean of 2×2 rays a pixel; distances belong to the pixel's centre.
    """

    def __init__(
        self,
        camera: Camera,
        own_car: World,
        camera_to_ground: NDArray[np.float64],
        lens_theta_deg: float = LENS_THETA_DEG,
    ) -> None:
        """Prepare rays and the own car's picture.

        `own_car` is a world that holds the own car alone, its origin on the road below the pose's, and
        `camera_to_ground` (4×4) leads from the camera to it; `lens_theta_deg` is half of the lens's field of view.
        """
        lens_theta_rad = float(np.deg2rad(lens_theta_deg))
        rim_theta_rad = np.deg2rad(lens_theta_deg + _RIM_WIDTH_DEG)
        self.height, self.width = camera.height, camera.width
        self.pixel_rad = 2 * lens_theta_rad / self.width
        centres = camera.pixel_centres().reshape(-1, 2)
        rays, valid = camera.unproject(centres)
        theta = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
        seen = valid & (theta <= rim_theta_rad.max())
        self.lens = (seen & (theta <= lens_theta_rad)).reshape(self.height, self.width).numpy()
        """H×W, True inside the lens circle."""
        self._pixels = np.flatnonzero(seen.numpy())
        self._centre_rays = rays[seen].numpy().astype(np.float32)
        past = (theta[seen].numpy()[:, None] - lens_theta_rad) / (rim_theta_rad - lens_theta_rad)
        past = np.clip(past, 0, 1)
        self._transmission = (1 - past**2 * (3 - 2 * past)).astype(np.float32)
        # a quarter of a pixel off the centre the ray is linear in the pixel, to some thousandths of a pixel
        grid = rays.reshape(self.height, self.width, 3).numpy()
        # beside a pixel that the lens cannot reach the slope is unknown
        slopes = (np.nan_to_num(slope, nan=0.0) for slope in np.gradient(grid, axis=(0, 1)))
        along_y, along_x = (slope.reshape(-1, 3)[self._pixels] for slope in slopes)
        fine = np.stack([grid.reshape(-1, 3)[self._pixels] + x * along_x + y * along_y for x, y in _SUBSAMPLES], 1)
        self._fine_rays = (fine / np.linalg.norm(fine, axis=-1, keepdims=True)).astype(np.float32)
        self._own_hit = np.zeros(self._fine_rays.shape[:2], bool)
        self._own_radiance = np.zeros(self._fine_rays.shape, np.float32)
        for part in self._chunks():
            origins, directions = _rays_from(camera_to_ground, self._fine_rays[part].reshape(-1, 3))
            hits = own_car.trace(origins, directions, 0.0)
            colour = own_car.radiance(origins, directions, hits, 0.0, self.pixel_rad / 2)
            self._own_hit[part] = np.isfinite(hits.distance_m).reshape(-1, len(_SUBSAMPLES))
            self._own_radiance[part] = colour.reshape(-1, len(_SUBSAMPLES), 3)
        own_m = own_car.trace(*_rays_from(camera_to_ground, self._centre_rays), 0.0).distance_m
        own_distance = np.where(np.isfinite(own_m), own_m, 0)
        self.own_distance_m = self._spread(own_distance.astype(np.float32))
        """H×W, distance of the own car at pixel centres, 0 elsewhere."""
        own = self._own_hit.any(-1) | (own_distance > 0)
        self.own_car = self._spread(own)
        """H×W, True where any part of the pixel shows the own car."""

    def _chunks(self) -> list[slice]:
        return [slice(first, first + _CHUNK_PIXELS) for first in range(0, len(self._pixels), _CHUNK_PIXELS)]

    def _spread(self, values: NDArray) -> NDArray:
        whole = np.zeros((self.height * self.width, *values.shape[1:]), values.dtype)
        whole[self._pixels] = values
        return whole.reshape(self.height, self.width, *values.shape[1:])

    def view(
        self, world: World, camera_to_world: NDArray[np.float64], time_s: float, with_own_car: bool = True
    ) -> RenderedView:
        """Render the world from a 4×4 camera pose."""
        count = len(self._pixels)
        colour, distance = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        moving = np.zeros(count, bool)
        for part in self._chunks():
            own = self._own_hit[part] if with_own_car else np.zeros_like(self._own_hit[part])
            samples = self._own_radiance[part].copy()
            origins, directions = _rays_from(camera_to_world, self._fine_rays[part][~own])
            hits = world.trace(origins, directions, time_s)
            samples[~own] = world.radiance(origins, directions, hits, time_s, self.pixel_rad / 2)
            colour[part] = samples.mean(1)
            things = np.full(own.shape, _NOTHING, np.int32)
            things[~own] = hits.thing
            moving[part] = (things > _STATIC).any(-1)
            seen_m = world.trace(*_rays_from(camera_to_world, self._centre_rays[part]), time_s).distance_m
            distance[part] = np.where(np.isfinite(seen_m), seen_m, 0)
        colour *= self._transmission
        distance = self._spread(distance)
        keep = self.lens & ~self.own_car if with_own_car else self.lens
        return RenderedView(self._spread(colour), np.where(keep, distance, 0), self._spread(moving))


def _rays_from(camera_to_world: NDArray[np.float64], rays: Array) -> tuple[Array, Array]:
    """Origins and directions in the world of a camera's rays, N×3."""
    directions = np.ascontiguousarray(rays @ _f32(camera_to_world[:3, :3].T))
    return np.tile(_f32(camera_to_world[:3, 3]), (len(directions), 1)), directions


def own_car_world(model: SceneModel, seed: int) -> World:
    """The recording car alone, under the scene's light; indoors it has two lamps above it."""
    lamps = np.array([(x + 1.4, -0.3, 2.4) for x in (-1.9, 1.9)])
    lighting = replace(model.lighting, lamps=lamps if len(model.lighting.lamps) else model.lighting.lamps)
    return World(SceneModel(recording_car(), [], lighting, [], model.drive), seed)
