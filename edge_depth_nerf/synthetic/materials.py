"""Procedural surface colours: noise at several scales as a function of position, the same from every view.

Units: metres. Colours are linear RGB reflectances, N×3. `footprint_m` (N) is the width on the surface that one
sample stands for: detail finer than it is faded out (a pattern to its mean), so that nothing flickers with
distance. Coordinates u, v (N, metres) lie in the surface: along the horizontal and up the slope; on level ground
they are x and y.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum, auto
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_TILE = 512
_TEXELS_PER_WAVE = 8
_CELLS = 256
_REMAP_WIDTH = 1024


class Material(IntEnum):
    """What a triangle is made of."""

    ASPHALT = 0
    PAVING = auto()
    STONE = auto()
    GRASS = auto()
    MARKING = auto()
    BRICK = auto()
    PLASTER = auto()
    GLASS = auto()
    PAINTED = auto()
    ROOF = auto()
    CAR_PAINT = auto()
    RUBBER = auto()
    METAL = auto()
    BARK = auto()
    LEAF = auto()
    CONCRETE = auto()
    PRINT = auto()
    LAMP = auto()


MIRROR_REFLECTANCE = np.zeros(len(Material), np.float32)
"""Share of light that a material mirrors at normal incidence; 0 = dull."""
MIRROR_REFLECTANCE[[Material.GLASS, Material.CAR_PAINT, Material.METAL]] = (0.06, 0.04, 0.05)

TRANSLUCENCY = np.zeros(len(Material), np.float32)
"""Share of the sun's light from behind that a material passes on."""
TRANSLUCENCY[Material.LEAF] = 0.5

LASER_REFLECTANCE = np.full(len(Material), 1.0, np.float32)
"""How much brighter a material is for the infrared laser than for the eye."""
LASER_REFLECTANCE[[Material.LEAF, Material.GRASS, Material.MARKING]] = (3.0, 2.5, 1.3)
LASER_REFLECTANCE[[Material.GLASS, Material.RUBBER]] = 0.5


def read_map(values: Array, x: Array, y: Array, border: int) -> Array:
    """Values of an H×W map at N points, linear in between; outside by one of OpenCV's ways, a constant being 1."""
    # cv2 takes at most 2**15 points in a row
    rows = max(1, -(-len(x) // _REMAP_WIDTH))
    at = np.zeros((2, rows * _REMAP_WIDTH), np.float32)
    at[0, : len(x)], at[1, : len(x)] = x, y
    at = at.reshape(2, rows, _REMAP_WIDTH)
    found: Any = cv2.remap(values, at[0], at[1], cv2.INTER_LINEAR, borderMode=border, borderValue=(1.0,))
    return found.reshape(-1)[: len(x)]


class Noise:
    """Smooth, zero-mean noise and random cells, tables made from one seed."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 101])
        frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(_TILE), np.fft.fftfreq(_TILE)))
        band = np.exp(-0.5 * ((frequency * _TEXELS_PER_WAVE - 1.0) / 0.35) ** 2)
        tile = np.fft.ifft2(np.fft.fft2(rng.standard_normal((_TILE, _TILE))) * band).real
        self._smooth = (tile / tile.std() * 0.5).astype(np.float32)
        self._cells = rng.random((_CELLS, _CELLS), np.float32)

    def wave(self, u: Array, v: Array, wavelength_m: float | tuple[float, float], layer: int) -> Array:
        """Zero-mean noise of standard deviation 0.5 with features as long as the wavelength (of u and of v)."""
        along_u, along_v = wavelength_m if isinstance(wavelength_m, tuple) else (wavelength_m, wavelength_m)
        # cv2 takes coordinates up to 2**15 only: wrapped here
        x = np.mod(u * (_TEXELS_PER_WAVE / along_u) + 61.7 * layer, _TILE)
        y = np.mod(v * (_TEXELS_PER_WAVE / along_v) + 37.3 * layer, _TILE)
        return read_map(self._smooth, x, y, cv2.BORDER_WRAP)

    def waves(
        self, u: Array, v: Array, footprint_m: Array, spectrum: Sequence[tuple[float, float]], layer: int = 0
    ) -> Array:
        """Sum of `wave` over (wavelength in m, amplitude), each faded out where the footprint exceeds it."""
        total = np.zeros(len(u), np.float32)
        for number, (wavelength, amplitude) in enumerate(spectrum):
            fade = np.clip(wavelength / (2 * footprint_m) - 0.5, 0, 1)
            seen = np.flatnonzero(fade)
            if len(seen):
                part = self.wave(u[seen], v[seen], wavelength, 5 * layer + number)
                total[seen] += amplitude * fade[seen] * part
        return total

    def cell(self, column: Array, row: Array, layer: int) -> Array:
        """A random number in [0, 1) for each integer cell."""
        i = (column.astype(np.int64) + 71 * layer) % _CELLS
        j = (row.astype(np.int64) + 29 * layer) % _CELLS
        return self._cells[i, j]


@dataclass(frozen=True)
class Surface:
    """N points of one material."""

    tint: Array
    """N×3."""
    u: Array
    """N, metres."""
    v: Array
    """N, metres."""
    position: Array
    """N×3, metres, in the frame of the object."""
    normal: Array
    """N×3, flat."""
    footprint_m: Array
    """N."""


def _coverage(distance_m: Array, half_width_m: float, footprint_m: Array) -> Array:
    """How much of a footprint a line of that half width covers, at that distance from its middle."""
    covered = np.clip((half_width_m - distance_m) / footprint_m + 0.5, 0, 1)
    return covered * np.minimum(1, 2 * half_width_m / footprint_m)


def _fade(size_m: float, footprint_m: Array) -> Array:
    return np.clip(size_m / footprint_m - 0.75, 0, 1)


def _to_joint(coordinate: Array, spacing_m: float) -> Array:
    """Distance to the nearest multiple of the spacing."""
    phase = np.mod(coordinate, spacing_m)
    return np.minimum(phase, spacing_m - phase)


def _bond(noise: Noise, s: Surface, length_m: float, height_m: float, joint_m: float, layer: int) -> tuple:
    """A running bond: random number of each stone (faded to its mean) and how much is joint."""
    row = np.floor(s.v / height_m)
    along = s.u + np.where(row % 2 == 0, 0.0, length_m / 2).astype(np.float32)
    stone = noise.cell(np.floor(along / length_m), row, layer)
    stone = 0.5 + (stone - 0.5) * _fade(height_m, s.footprint_m)
    joint = np.maximum(
        _coverage(_to_joint(along, length_m), joint_m / 2, s.footprint_m),
        _coverage(_to_joint(s.v, height_m), joint_m / 2, s.footprint_m),
    )
    return stone, joint


def _scaled(tint: Array, factor: Array) -> Array:
    return tint * np.maximum(factor, 0.05)[:, None]


def _mixed(colour: Array, other: Sequence[float], share: Array) -> Array:
    return colour + (np.asarray(other, np.float32) - colour) * share[:, None]


def _asphalt(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.025, 0.25), (0.09, 0.16), (0.45, 0.16), (1.9, 0.16), (7.0, 0.14)))
    patch = (noise.wave(s.u, s.v, 9.0, 7) > 0.75).astype(np.float32)
    crack = np.abs(noise.wave(s.u, s.v, 2.3, 9)) * 0.25
    broken = noise.wave(s.u, s.v, 11.0, 11) > 0.1
    line = _coverage(crack, 0.004, s.footprint_m) * broken
    return _mixed(_scaled(s.tint, 1 + tone - 0.22 * patch), (0.025, 0.024, 0.022), 0.75 * line)


def _paving(noise: Noise, s: Surface) -> Array:
    stone, joint = _bond(noise, s, 0.4, 0.2, 0.012, 1)
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.03, 0.12), (0.13, 0.12), (0.7, 0.14), (4.0, 0.16)), 2)
    return _mixed(_scaled(s.tint, 0.8 + 0.4 * stone + tone), (0.07, 0.065, 0.055), 0.8 * joint)


def _stone(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.02, 0.12), (0.1, 0.12), (0.6, 0.12), (3.0, 0.12)), 3)
    joint = _coverage(_to_joint(s.u + s.v, 1.0), 0.006, s.footprint_m)
    return _mixed(_scaled(s.tint, 1 + tone), (0.06, 0.055, 0.05), 0.7 * joint)


def _grass(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.04, 0.45), (0.15, 0.3), (0.8, 0.25), (5.0, 0.3)), 4)
    bare = np.clip(noise.wave(s.u, s.v, 3.1, 23) - 0.45, 0, 1)
    return _mixed(_scaled(s.tint, 1 + tone), (0.16, 0.12, 0.08), bare)


def _marking(noise: Noise, s: Surface) -> Array:
    wear = noise.waves(s.u, s.v, s.footprint_m, ((0.03, 0.35), (0.11, 0.35), (0.5, 0.35), (2.5, 0.3)), 5)
    return _mixed(_scaled(s.tint, 1 + 0.1 * wear), (0.11, 0.11, 0.11), np.clip(0.9 * wear - 0.05, 0, 0.8))


def _brick(noise: Noise, s: Surface) -> Array:
    stone, joint = _bond(noise, s, 0.25, 0.08, 0.012, 2)
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.03, 0.1), (0.15, 0.08), (0.9, 0.12), (5.0, 0.16)), 6)
    return _mixed(_scaled(s.tint, 0.72 + 0.56 * stone + tone), (0.36, 0.34, 0.31), 0.8 * joint)


def _plaster(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.025, 0.1), (0.12, 0.08), (0.6, 0.08), (2.5, 0.1), (9.0, 0.08)), 7)
    streak = np.clip(noise.wave(s.u, s.v, (0.35, 5.0), 43), 0, 1) * _fade(0.2, s.footprint_m)
    damp = np.clip(0.9 - s.position[:, 2] + 0.4 * noise.wave(s.u, s.v, 1.2, 44), 0, 1)
    return _scaled(s.tint, 1 + tone - 0.22 * streak - 0.35 * damp)


def _glass(noise: Noise, s: Surface) -> Array:
    return _scaled(s.tint, 1 + noise.waves(s.u, s.v, s.footprint_m, ((0.25, 0.2), (0.9, 0.45)), 8))


def _painted(noise: Noise, s: Surface) -> Array:
    return _scaled(s.tint, 1 + noise.waves(s.u, s.v, s.footprint_m, ((0.05, 0.05), (0.3, 0.08), (1.5, 0.08)), 9))


def _roof(noise: Noise, s: Surface) -> Array:
    row = np.floor(s.v / 0.32)
    column = np.floor(s.u / 0.22 + 0.5 * (row % 2))
    tile = (noise.cell(column, row, 3) - 0.5) * _fade(0.22, s.footprint_m)
    lap = np.mod(s.v, 0.32) / 0.32 - 0.5
    ridge = np.cos(2 * np.pi * (s.u / 0.22 + 0.5 * (row % 2)))
    relief = (0.35 * lap + 0.15 * ridge) * _fade(0.3, s.footprint_m)
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.05, 0.1), (0.5, 0.15), (3.0, 0.18)), 10)
    return _scaled(s.tint, 1 + 0.45 * tile + relief + tone)


def _car_paint(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.4, 0.03), (1.5, 0.03)), 11)
    dirt = np.clip(0.55 - 1.1 * s.position[:, 2] + 0.25 * noise.wave(s.u, s.v, 0.3, 61), 0, 0.5)
    return _mixed(_scaled(s.tint, 1 + tone), (0.14, 0.12, 0.1), dirt)


def _bark(noise: Noise, s: Surface) -> Array:
    around = np.arctan2(s.u, s.v) * 0.2
    groove = noise.wave(around + s.position[:, 0], s.position[:, 2], (0.05, 0.3), 71) * _fade(0.05, s.footprint_m)
    x, y, z = s.position.T
    tone = noise.waves(x + y, z, s.footprint_m, ((0.3, 0.2), (1.5, 0.2)), 12)
    return _scaled(s.tint, 1 + 0.6 * groove + tone)


def _leaf(noise: Noise, s: Surface) -> Array:
    # seen along the axis that the surface faces most: foliage hides the seams
    axis = np.argmax(np.abs(s.normal), axis=1)
    rows = np.arange(len(axis))
    first, second = s.position[rows, (axis + 1) % 3], s.position[rows, (axis + 2) % 3]
    tone = noise.waves(first, second, s.footprint_m, ((0.07, 0.5), (0.22, 0.5), (0.8, 0.4), (2.5, 0.25)), 13)
    return _scaled(s.tint, np.exp(tone))


def _concrete(noise: Noise, s: Surface) -> Array:
    tone = noise.waves(s.u, s.v, s.footprint_m, ((0.03, 0.14), (0.12, 0.12), (0.5, 0.14), (2.0, 0.2), (7.0, 0.24)), 15)
    stain = np.clip(noise.wave(s.u, s.v, (0.6, 2.5), 81) - 0.35, 0, 1)
    seam = np.maximum(
        _coverage(_to_joint(s.u, 2.5), 0.006, s.footprint_m), _coverage(_to_joint(s.v, 1.25), 0.006, s.footprint_m)
    )
    hole = np.hypot(_to_joint(s.u - 0.6, 1.25), _to_joint(s.v - 0.6, 1.25))
    hole = np.clip((0.018 - hole) / s.footprint_m + 0.5, 0, 1) * _fade(0.03, s.footprint_m)
    return _scaled(s.tint, (1 + tone - 0.5 * stain) * (1 - 0.45 * np.maximum(seam, hole)))


def _print(noise: Noise, s: Surface) -> Array:
    block = noise.cell(np.floor(s.u / 0.35), np.floor(s.v / 0.18), 4)
    letter = noise.wave(s.u, s.v, 0.3, 91) > 0.25
    ink = np.where(block > 0.55, letter, block < 0.15) * _fade(0.25, s.footprint_m)
    return _mixed(s.tint, (0.85, 0.85, 0.8), 0.85 * ink)


_COLOURS: dict[Material, Callable[[Noise, Surface], Array]] = {
    Material.ASPHALT: _asphalt,
    Material.PAVING: _paving,
    Material.STONE: _stone,
    Material.GRASS: _grass,
    Material.MARKING: _marking,
    Material.BRICK: _brick,
    Material.PLASTER: _plaster,
    Material.GLASS: _glass,
    Material.PAINTED: _painted,
    Material.ROOF: _roof,
    Material.CAR_PAINT: _car_paint,
    Material.RUBBER: _painted,
    Material.METAL: _painted,
    Material.BARK: _bark,
    Material.LEAF: _leaf,
    Material.CONCRETE: _concrete,
    Material.PRINT: _print,
    Material.LAMP: lambda noise, s: s.tint,
}


def reflectance(
    noise: Noise, material: NDArray[np.uint8], tint: Array, position: Array, normal: Array, footprint_m: Array
) -> Array:
    """Linear RGB (N×3) of N points of any materials.

    Position and flat normal (N×3) are in the frame of the object, so that patterns move with it.
    """
    horizontal = np.hypot(normal[:, 0], normal[:, 1])
    upright = horizontal > 0.2
    # (cos, sin) of the horizontal direction in the surface; level ground takes x
    cos = np.where(upright, -normal[:, 1] / np.maximum(horizontal, 1e-6), 1.0).astype(np.float32)
    sin = np.where(upright, normal[:, 0] / np.maximum(horizontal, 1e-6), 0.0).astype(np.float32)
    u = cos * position[:, 0] + sin * position[:, 1]
    slope = -sin * position[:, 0] + cos * position[:, 1]
    v = np.where(upright, position[:, 2] * horizontal + slope * normal[:, 2], slope)
    colour = np.empty_like(tint)
    order = np.argsort(material, kind="stable")
    kinds, starts = np.unique(material[order], return_index=True)
    for kind, rows in zip(kinds, np.split(order, starts[1:]), strict=True):
        at = (position[rows], normal[rows], footprint_m[rows])
        surface = Surface(tint[rows], u[rows], v[rows].astype(np.float32), *at)
        colour[rows] = _COLOURS[Material(kind)](noise, surface)
    return np.clip(colour, 0, 0.95)
