"""Where the pixels of a picture from above are: a strip along the driven path. Pure.

Frames: the scene (metres, z up). Rows go from north (large y) to south, columns from west to east.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import KDTree

from edge_depth_nerf.base.errors import InputError

STEP_M = 0.5
"""The path between two frames is filled with places so far apart."""
GAP_M = 30.0
"""Between frames further apart nothing was driven."""
MOST_PIXELS = 100_000_000
"""Colours and heights of so many take 0.8 GB of memory."""
TILE_PX = 128


def driven_path(
    frames: Sequence[int], positions_m: Float64[np.ndarray, "pictures 3"]
) -> Float64[np.ndarray, "places 3"]:
    """Give places along the path: in the middle of each frame's cameras, as high as the highest of them.

    Args:
        frames: number of each picture's frame.
        positions_m: where each picture was taken.
    """
    of_frame: dict[int, list[Float64[np.ndarray, "3"]]] = defaultdict(list)
    for frame, position in zip(frames, positions_m, strict=True):
        of_frame[frame].append(position)
    path = [np.array([*np.mean(of_frame[f], axis=0)[:2], np.max(of_frame[f], axis=0)[2]]) for f in sorted(of_frame)]
    places = [path[:1]]
    for before, after in itertools.pairwise(path):
        apart_m = float(np.linalg.norm(after - before))
        steps = max(1, math.ceil(apart_m / STEP_M)) if apart_m <= GAP_M else 1
        places.append([before + (after - before) * share for share in np.arange(1, steps + 1) / steps])
    return np.array([place for some in places for place in some])


@dataclass(frozen=True)
class Tile:
    """A part of the picture: its first row and column, and its size."""

    row: int
    column: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Where it is in the picture."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)


class GroundPlan:
    """Pixels within a distance of the path."""

    def __init__(self, path_m: Float64[np.ndarray, "places 3"], metres_per_pixel: float, margin_m: float) -> None:
        """Lay them out.

        Raises:
            InputError: there are too many.
        """
        self._path_m, self._side_m, self._margin_m = path_m, metres_per_pixel, margin_m
        self._tree = KDTree(path_m[:, :2])
        low, high = path_m.min(axis=0) - margin_m, path_m.max(axis=0) + margin_m
        # in whole pixels from the scene's origin
        self._west, self._north = math.floor(low[0] / metres_per_pixel), math.ceil(high[1] / metres_per_pixel)
        self.width = math.ceil(high[0] / metres_per_pixel) - self._west
        self.height = self._north - math.floor(low[1] / metres_per_pixel)
        if self.width * self.height > MOST_PIXELS:
            raise InputError(
                f"--metres-per-pixel {metres_per_pixel:g}: the picture would be {self.width}×{self.height} px, "
                f"more than {MOST_PIXELS // 1_000_000} million. Use larger pixels, or train on a shorter stretch."
            )

    def tiles(self) -> Iterator[Tile]:
        """Give the tiles, row by row, that may have pixels within the margin."""
        half_m = TILE_PX * self._side_m / math.sqrt(2)
        for row in range(0, self.height, TILE_PX):
            for column in range(0, self.width, TILE_PX):
                middle = self._place(np.array([row + TILE_PX / 2]), np.array([column + TILE_PX / 2]))[0]
                if self._tree.query(middle)[0] <= self._margin_m + half_m:
                    yield Tile(row, column, min(TILE_PX, self.height - row), min(TILE_PX, self.width - column))

    def _place(self, row: np.ndarray, column: np.ndarray) -> Float64[np.ndarray, "n 2"]:
        return np.stack([self._west + column, self._north - row], axis=-1) * self._side_m

    def of_tile(
        self, tile: Tile
    ) -> tuple[Float64[np.ndarray, "height width 2"], Float64[np.ndarray, "height width"], Bool[np.ndarray, "h w"]]:
        """Give the places of the centres of a tile's pixels, the path's height beside each, and which are near it."""
        row, column = np.indices((tile.height, tile.width)).reshape(2, -1) + 0.5
        place = self._place(tile.row + row, tile.column + column)
        apart_m, nearest = self._tree.query(place)
        shape = tile.height, tile.width
        near = (apart_m <= self._margin_m).reshape(shape)
        return place.reshape(*shape, 2), self._path_m[nearest, 2].reshape(shape), near

    def world_file(self, world_offset_m: Float64[np.ndarray, "3"]) -> str:
        """Give the world file: sides of a pixel, and the centre of the first one in the recording's world."""
        first = self._place(np.array([0.5]), np.array([0.5]))[0] + world_offset_m[:2]
        side = self._side_m
        return "".join(f"{value:.9f}\n" for value in (side, 0, 0, -side, *first))
