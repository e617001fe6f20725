"""Triangles with a material and a colour, and the simple shapes that scenes are built from.

Frame: x, y horizontal, z up, metres. Angles about z in radians, counter-clockwise. Triangles are seen from both
sides. `tint` is a linear RGB colour in [0, 1] whose meaning is the material's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import trimesh
from numpy.typing import NDArray

from edge_depth_nerf.synthetic.materials import Material

Real = float | int
Pair = tuple[Real, Real]
Triple = tuple[Real, Real, Real]
Colour = Triple
Point = NDArray | Triple

_UNIT_BOX = np.asarray(trimesh.creation.box((1, 1, 1)).triangles)


def placement(x: Real, y: Real, z: Real = 0.0, yaw_rad: Real = 0.0, mirror_y: bool = False) -> NDArray:
    """The 4×4 transform that turns by yaw, after mirroring y where asked, and moves to (x, y, z)."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    side = -1.0 if mirror_y else 1.0
    return np.array([[cos, -sin * side, 0, x], [sin, cos * side, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], np.float64)


@dataclass(frozen=True)
class Geometry:
    """F triangles."""

    corners: NDArray[np.float64]
    """F×3×3, corner by corner."""
    normals: NDArray[np.float32]
    """F×3×3, unit normals at the corners, for shading."""
    material: NDArray[np.uint8]
    """F, values of `Material`."""
    tint: NDArray[np.float32]
    """F×3, linear RGB."""

    def transformed(self, transform: NDArray) -> Geometry:
        """Move by a 4×4 rigid transform, mirrored or not."""
        rotation = transform[:3, :3].T
        corners = (self.corners.reshape(-1, 3) @ rotation + transform[:3, 3]).reshape(-1, 3, 3)
        normals = (self.normals.reshape(-1, 3) @ rotation.astype(np.float32)).reshape(-1, 3, 3)
        return Geometry(corners, normals, self.material, self.tint)

    @staticmethod
    def joined(parts: Sequence[Geometry]) -> Geometry:
        """All triangles of several geometries."""
        return Geometry(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(Geometry)))


def flat_normals(corners: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals of F×3×3 triangles, F×3; zero for one without area."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    return (normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)).astype(np.float32)


def _circle(axis: NDArray[np.float64], sections: int) -> NDArray[np.float64]:
    """Unit vectors across a unit vector, evenly around it, the last one equal to the first: (sections + 1)×3."""
    side = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * np.pi, sections + 1)
    return np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)


class MeshBuilder:
    """Collects shapes into one geometry."""

    def __init__(self) -> None:
        self._parts: list[Geometry] = []
        # scenes have tens of thousands of small flat shapes: gathered first, made into arrays once
        self._flat: list[tuple[NDArray[np.float64], Material, Colour]] = []

    def build(self) -> Geometry:
        """All that was added."""
        if not self._flat:
            return Geometry.joined(self._parts)
        parts, materials, tints = zip(*self._flat, strict=True)
        counts, corners = list(map(len, parts)), np.concatenate(parts)
        normals = np.repeat(flat_normals(corners)[:, None], 3, axis=1)
        material = np.repeat(np.array(materials, np.uint8), counts)
        tint = np.repeat(np.array(tints, np.float32), counts, axis=0)
        return Geometry.joined([*self._parts, Geometry(corners, normals, material, tint)])

    def add(self, geometry: Geometry, transform: NDArray | None = None) -> None:
        """Add triangles, moved by a 4×4 transform."""
        self._parts.append(geometry if transform is None else geometry.transformed(transform))

    def add_triangles(self, corners: NDArray, material: Material, tint: Colour, normals: NDArray | None = None) -> None:
        """Add F×3×3 corners; without normals (F×3×3) each triangle is flat."""
        corners = np.asarray(corners, np.float64)
        if normals is None:
            self._flat.append((corners, material, tint))
            return
        count = len(corners)
        tints = np.broadcast_to(np.asarray(tint, np.float32), (count, 3))
        self._parts.append(Geometry(corners, normals.astype(np.float32), np.full(count, material, np.uint8), tints))

    def add_polygon(self, points: NDArray | Sequence, material: Material, tint: Colour) -> None:
        """Add a flat convex polygon, N×3."""
        points = np.asarray(points, np.float64)
        fan = np.empty((len(points) - 2, 3, 3))
        fan[:, 0], fan[:, 1], fan[:, 2] = points[0], points[1:-1], points[2:]
        self.add_triangles(fan, material, tint)

    def add_ground_polygon(self, points: NDArray | Sequence, z: Real, material: Material, tint: Colour) -> None:
        """Add a horizontal convex polygon, N×2, at height z."""
        points = np.asarray(points, np.float64)
        self.add_polygon(np.column_stack((points, np.full(len(points), z))), material, tint)

    def add_rectangle(self, x: Pair, y: Pair, z: Real, material: Material, tint: Colour) -> None:
        """Add a horizontal rectangle at height z."""
        corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        self.add_ground_polygon(corners, z, material, tint)

    def add_mesh(self, mesh: trimesh.Trimesh, material: Material, tint: Colour, smooth: bool = True) -> None:
        """Add a trimesh mesh, with its vertex normals or flat."""
        normals = np.asarray(mesh.vertex_normals)[mesh.faces] if smooth else None
        self.add_triangles(np.asarray(mesh.triangles), material, tint, normals)

    def add_box(self, centre: Triple, size: Triple, material: Material, tint: Colour, yaw_rad: Real = 0.0) -> None:
        """Add a box of `size` (x, y, z) about `centre`, turned about its upright axis."""
        corners = _UNIT_BOX * size
        if yaw_rad:
            corners = corners @ placement(0, 0, 0, yaw_rad)[:3, :3].T
        self.add_triangles(corners + centre, material, tint)

    def add_rod(
        self, start: Point, end: Point, radius: Real | Pair, material: Material, tint: Colour, sections: int = 10
    ) -> None:
        """Add a round rod between two points, of one radius or of one at each end; flat ends."""
        start, end = np.asarray(start, np.float64), np.asarray(end, np.float64)
        first, last = (radius, radius) if isinstance(radius, int | float) else radius
        round_ = _circle((end - start) / np.linalg.norm(end - start), sections)
        a, b = start + first * round_, end + last * round_
        walls = np.concatenate((np.stack((a[:-1], a[1:], b[1:]), 1), np.stack((a[:-1], b[1:], b[:-1]), 1)))
        normals = np.concatenate(
            (np.stack((round_[:-1], round_[1:], round_[1:]), 1), np.stack((round_[:-1], round_[1:], round_[:-1]), 1))
        )
        self.add_triangles(walls, material, tint, normals)
        self.add_polygon(a[:-1], material, tint)
        self.add_polygon(b[:-1], material, tint)

    def add_disc(
        self, centre: Point, axis: Point, radius: Real, material: Material, tint: Colour, sections: int = 20
    ) -> None:
        """Add a flat disc across `axis` (a unit vector)."""
        rim = _circle(np.asarray(axis, np.float64), sections)[:-1]
        self.add_polygon(np.asarray(centre, np.float64) + radius * rim, material, tint)

    def add_loft(
        self, rings: NDArray, material: Material, tint: Colour, closed: bool = True, smooth: bool = True
    ) -> None:
        """Add the skin over R rings of N points, R×N×3; the first and last ring are filled where `closed`."""
        count, points = rings.shape[:2]
        index = np.arange(count * points).reshape(count, points)
        following = np.roll(index, -1, axis=1)
        quads = np.stack((index[:-1], following[:-1], following[1:], index[1:]), -1).reshape(-1, 4)
        faces = [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
        for ring in (index[0], index[-1]) if closed else ():
            faces.append(np.column_stack((np.full(points - 2, ring[0]), ring[1:-1], ring[2:])))
        self.add_mesh(
            trimesh.Trimesh(rings.reshape(-1, 3), np.concatenate(faces), process=False), material, tint, smooth
        )
