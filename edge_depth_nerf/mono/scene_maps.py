"""Monocular maps put into a scene that exists."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.progress import Progress

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.scene.put_maps import write_maps


def write_mono_maps(
    scene: Path,
    maps: Iterable[tuple[str, Float[np.ndarray, "h w"]]],
    source: Mapping[str, Any],
    progress: Progress | None = None,
) -> None:
    """Write a monocular map for every frame of a scene, not aligned to LiDAR: see `write_maps`.

    Args:
        scene: the folder, or its transforms.json.
        maps: `file_path` of a frame, and its H×W metres along the ray.
        source: where they come from, as JSON. "trained_on" says what the maker has seen: "scene" for a network that was
            trained on LiDAR and knows nothing beyond the scanner's field, "elsewhere" for others.
        progress: where to show how far it is.

    Raises:
        FileNotFoundError: no scene there.
        InputError: as `write_maps`; or "trained_on" is missing.

    """
    if source.get("trained_on") not in ("scene", "elsewhere"):
        raise InputError(
            f"source of the monocular maps: trained_on is {source.get('trained_on')!r}; expected scene or elsewhere."
        )
    write_maps(scene, "mono", maps, source, progress)
