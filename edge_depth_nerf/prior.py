"""The depth prior of a frame: integrated once, kept on disk.

Maps are H×W metres along the ray, 0 = no prior. A cached prior carries a key of everything it was made of (the
maps, the mask, the options, the version of this format); a file that does not load or does not fit is made anew.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from edge_depth_nerf.files import write_atomically
from edge_depth_nerf.integration import DepthSource, IntegrationOptions, SigmaMode, select_prior, sigma_m

CACHE_VERSION = 2
"""Part of every key: raised whenever the same inputs give another prior."""


@dataclass(frozen=True)
class PriorOptions:
    """How LiDAR and monocular distance become a prior."""

    depth_source: DepthSource = "integrated"
    """Both sources integrated, or one alone."""
    sigma_mode: SigmaMode = "combined"
    """See `integration.sigma_m`."""
    sigma_constant_m: float = 1.0
    """The standard deviation under sigma_mode constant, metres."""
    integration: IntegrationOptions = field(default_factory=IntegrationOptions)
    """Eq. 5-7 and their variants."""


@dataclass(frozen=True)
class Prior:
    """Distance prior and its standard deviation, both H×W float32 metres; 0 = no prior."""

    distance_m: NDArray[np.float32]
    sigma_m: NDArray[np.float32]


def make_prior(
    lidar_m: NDArray[np.float32] | None,
    mono_m: NDArray[np.float32] | None,
    mask: NDArray[np.bool_],
    options: PriorOptions,
) -> Prior:
    """Integrate one frame (Eq. 5-7) and say how far each pixel is trusted.

    Args:
        lidar_m: H×W LiDAR distance, 0 = no return; None if the options use monocular distance alone.
        mono_m: H×W monocular distance, 0 = none; None if the options use LiDAR alone.
        mask: H×W, True where the picture may be used.
        options: what is made of them.

    Raises:
        InputError: a source that the options need is None, or the maps differ in size.
    """
    lidar, mono = (None if maps is None else torch.from_numpy(maps) for maps in (lidar_m, mono_m))
    integrated = select_prior(options.depth_source, lidar, mono, torch.from_numpy(mask), options.integration)
    sigma = sigma_m(integrated, options.sigma_mode, mono_m=mono, constant_m=options.sigma_constant_m)
    return Prior(integrated.distance_m.float().numpy(), sigma.float().numpy())


class PriorCache:
    """Priors on disk, one file each, found by what they were made of.

    A folder that cannot be written (a read-only scene) is not an error: the prior is then made each time.
    """

    def __init__(self, folder: Path, options: PriorOptions):
        self.folder = folder
        self.options = options
        described = {"version": CACHE_VERSION, **dataclasses.asdict(options)}
        self._options_key = json.dumps(described, sort_keys=True).encode()

    def prior(
        self,
        lidar_m: NDArray[np.float32] | None,
        mono_m: NDArray[np.float32] | None,
        mask: NDArray[np.bool_],
    ) -> Prior:
        """As `make_prior`, from the cache where it is there."""
        path = self.folder / f"{self._key(lidar_m, mono_m, mask)}.npz"
        cached = _read(path, mask.shape)
        if cached is not None:
            return cached
        prior = make_prior(lidar_m, mono_m, mask, self.options)

        def write(temporary: Path) -> None:
            with temporary.open("wb") as file:
                np.savez_compressed(file, distance_m=prior.distance_m, sigma_m=prior.sigma_m)

        try:
            write_atomically(path, write)
        except OSError:
            pass
        return prior

    def _key(self, *maps: NDArray | None) -> str:
        digest = hashlib.sha256(self._options_key)
        for pixels in maps:
            digest.update(b"none" if pixels is None else f"{pixels.dtype}{pixels.shape}".encode())
            digest.update(b"" if pixels is None else np.ascontiguousarray(pixels).tobytes())
        return digest.hexdigest()[:32]


def _read(path: Path, shape: tuple[int, ...]) -> Prior | None:
    try:
        # np.load would leave the file open on a broken archive
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            prior = Prior(archive["distance_m"], archive["sigma_m"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    fits = all(m.shape == shape and m.dtype == np.float32 for m in (prior.distance_m, prior.sigma_m))
    return prior if fits else None
