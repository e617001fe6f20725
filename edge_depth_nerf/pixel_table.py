"""The training pixels that count, as flat arrays.

Pure. Only valid pixels of each picture are kept: colour as uint8, prior distance and sigma as uint16 in 1/256 m
(0 = no prior). Pictures may differ in size; those with the same mask share one list of pixel positions.
A batch is drawn uniformly, with replacement, over all valid pixels of all pictures.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import DISTANCE_STEPS_PER_METRE


def to_steps(distance_m: NDArray) -> NDArray[np.uint16]:
    """Metres as counts of 1/256 m; what is beyond the range of 16 bits or not positive becomes 0 (none)."""
    steps = np.rint(np.nan_to_num(distance_m, nan=0.0, posinf=0.0, neginf=0.0) * DISTANCE_STEPS_PER_METRE)
    return np.where((steps > 0) & (steps <= 65535), steps, 0).astype(np.uint16)


def _sigma_steps(sigma_m: NDArray) -> NDArray[np.uint16]:
    """As `to_steps`, but what is too small or too large for 16 bits stays a standard deviation."""
    usable = np.isfinite(sigma_m) & (sigma_m > 0)
    steps = np.clip(np.rint(np.where(usable, sigma_m, 0) * DISTANCE_STEPS_PER_METRE), 1, 65535)
    return np.where(usable, steps, 0).astype(np.uint16)


@dataclass
class PixelBatch:
    """A batch of n training pixels."""

    indices: Int[Tensor, "n 3"]
    """Picture, row, column."""
    rgb: Float[Tensor, "n 3"]
    """Colour in 0..1."""
    prior_distance_m: Float[Tensor, "n 1"]
    """Prior of the distance along the ray, metres, 0 = none."""
    prior_sigma_m: Float[Tensor, "n 1"]
    """Its standard deviation, metres."""


@dataclass
class _Frozen:
    """n valid pixels of p pictures."""

    rgb: NDArray[np.uint8]
    distance: NDArray[np.uint16]
    sigma: NDArray[np.uint16]
    ends: NDArray[np.int64]
    """p: one past the last pixel of each picture."""
    pixels: NDArray[np.int32]
    """Positions (row · width + column) of the valid pixels of all masks, one after the other."""
    shifts: NDArray[np.int64]
    """p: first pixel of each picture less the start of its mask's list in `pixels`."""
    widths: NDArray[np.int64]


@dataclass
class PixelTable:
    """Flat arrays of all valid pixels; filled picture by picture with `add`, then sampled."""

    _rgb: list[NDArray[np.uint8]] = field(default_factory=list)
    _distance: list[NDArray[np.uint16]] = field(default_factory=list)
    _sigma: list[NDArray[np.uint16]] = field(default_factory=list)
    _widths: list[int] = field(default_factory=list)
    _masks: dict[Hashable, NDArray[np.int32]] = field(default_factory=dict)
    _mask_of_picture: list[Hashable] = field(default_factory=list)
    _frozen: _Frozen | None = None

    def add(
        self,
        rgb: NDArray[np.uint8],
        mask: NDArray[np.bool_],
        mask_key: Hashable,
        prior_distance_m: NDArray[np.float32] | None,
        prior_sigma_m: NDArray[np.float32] | None,
    ) -> None:
        """Add a picture (H×W×3) with its mask (H×W); pictures with equal `mask_key` have equal masks.

        Maps of the prior are H×W metres; None means no prior anywhere.
        """
        assert rgb.shape[:2] == mask.shape
        if mask_key not in self._masks:
            self._masks[mask_key] = np.flatnonzero(mask).astype(np.int32)
        pixels = self._masks[mask_key]
        none = np.zeros(len(pixels), np.uint16)
        self._rgb.append(rgb.reshape(-1, 3)[pixels])
        self._distance.append(none if prior_distance_m is None else to_steps(prior_distance_m.reshape(-1)[pixels]))
        self._sigma.append(none if prior_sigma_m is None else _sigma_steps(prior_sigma_m.reshape(-1)[pixels]))
        self._widths.append(mask.shape[1])
        self._mask_of_picture.append(mask_key)

    def finish(self) -> None:
        """Join what was added.

        Raises:
            InputError: no valid pixel in any picture.

        """
        if not sum(map(len, self._rgb)):
            raise InputError(
                f"None of the {len(self._rgb)} pictures has a valid pixel: the masks leave nothing. "
                "Masks are 255 where a pixel may be used; check that they are not inverted."
            )
        keys = list(self._masks)
        mask_starts = np.cumsum([0, *(len(self._masks[key]) for key in keys)])
        first_of_mask = dict(zip(keys, mask_starts, strict=False))
        ends = np.cumsum([len(rgb) for rgb in self._rgb])
        starts = ends - [len(rgb) for rgb in self._rgb]
        self._frozen = _Frozen(
            rgb=np.concatenate(self._rgb),
            distance=np.concatenate(self._distance),
            sigma=np.concatenate(self._sigma),
            ends=ends,
            pixels=np.concatenate([self._masks[key] for key in keys]),
            shifts=starts - np.array([first_of_mask[key] for key in self._mask_of_picture]),
            widths=np.array(self._widths),
        )
        for joined in (self._rgb, self._distance, self._sigma, self._masks):
            joined.clear()

    def __len__(self) -> int:
        """Number of valid pixels."""
        return 0 if self._frozen is None else int(self._frozen.ends[-1])

    @property
    def share_with_prior(self) -> float:
        """Share of the valid pixels that have a prior."""
        assert self._frozen is not None
        return float((self._frozen.distance > 0).mean())

    def sample(self, count: int, generator: torch.Generator | None = None) -> PixelBatch:
        """Draw `count` pixels uniformly, with replacement."""
        assert self._frozen is not None, "finish() first"
        table = self._frozen
        drawn = torch.randint(len(self), (count,), generator=generator).numpy()
        picture = np.searchsorted(table.ends, drawn, side="right")
        pixel = table.pixels[drawn - table.shifts[picture]]
        rows, columns = np.divmod(pixel, table.widths[picture])

        def metres(steps: NDArray[np.uint16]) -> Tensor:
            return torch.from_numpy(steps[drawn].astype(np.float32) / DISTANCE_STEPS_PER_METRE)[:, None]

        return PixelBatch(
            indices=torch.from_numpy(np.stack([picture, rows, columns], axis=1)),
            rgb=torch.from_numpy(table.rgb[drawn].astype(np.float32) / 255),
            prior_distance_m=metres(table.distance),
            prior_sigma_m=metres(table.sigma),
        )
