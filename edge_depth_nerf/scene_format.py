"""What tells this project's scenes from other people's. Light: both readers of transforms.json import it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def is_own_scene(meta: Mapping[str, Any]) -> bool:
    """Whether a scene was written by `process`: its lengths are metres, its maps distances along the ray.

    Monocular maps say nothing about that: `estimate-depth` puts them into other people's scenes, too.
    """
    return "world_offset_m" in meta or "lidar_file_path" in meta["frames"][0]
