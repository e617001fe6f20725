"""Distances of all pictures of a drive: each swept, then confirmed by the sweeps of those it was compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from edge_depth_nerf.stereo.consistency import MotionDistance, confirm, worth_asking
from edge_depth_nerf.stereo.sweep import Swept, sweep_view
from edge_depth_nerf.stereo.views import View, choose_neighbours, nearest_views

_KEPT_VIEWS = 96
"""So many views, half a megabyte each, are kept in memory."""


class Motion:
    """The pictures of a drive that take part: held-out ones are not among them."""

    def __init__(
        self, positions_m: Float64[np.ndarray, "views 3"], cameras: Sequence[str], view: Callable[[int], View]
    ) -> None:
        """Take the cameras' centres and names, and what gives a picture; it is asked again for one that was dropped."""
        self._positions_m, self._cameras = positions_m, cameras
        self.view = lru_cache(_KEPT_VIEWS)(view)
        """Gives one of the pictures, from memory if it was asked for lately."""
        self.neighbours = lru_cache(None)(self._choose)
        """Gives the pictures that one is compared with, the best first."""

    def _choose(self, index: int) -> tuple[int, ...]:
        near = nearest_views(self._positions_m, index, self._cameras)
        chosen = choose_neighbours(self.view(index), [self.view(other) for other in near])
        return tuple(near[place] for place in chosen)

    def sweep(self, index: int) -> Swept:
        """What a picture's neighbours say of it; the long part of the work."""
        return sweep_view(self.view(index), [self.view(other) for other in self.neighbours(index)])

    def confirm(self, index: int, sweeps: Callable[[int], Swept]) -> MotionDistance:
        """Keep what the neighbours confirm."""
        neighbours = self.neighbours(index)
        theirs = []
        for other in neighbours:
            swept = sweeps(other)
            theirs.append(np.where(worth_asking(swept), swept.inverse_per_m, np.float32(0)))
        return confirm(self.view(index), sweeps(index), [self.view(other) for other in neighbours], theirs)
