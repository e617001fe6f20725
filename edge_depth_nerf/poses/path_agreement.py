"""How far two paths of the same drive agree, found in two ways: in two worlds, and maybe at other times."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_json, write_json
from edge_depth_nerf.lidar.trajectory import Trajectory

PATHS_AGREE = "paths_agree.json"
"""File of a scene whose path was found in two ways: a `PathAgreement`, and the checksum of the first path."""
MIN_COMMON_TIMES = 3
"""Fewer in common say nothing."""


@dataclass(frozen=True)
class PathAgreement:
    """Distances between two paths that lie on each other as well as they can, without a change of scale."""

    mean_m: float
    max_m: float
    length_m: float
    """How long the path is that was compared."""
    scale: float
    """How much longer the second path is."""

    def text(self) -> str:
        """In words, for people."""
        return f"{self.mean_m:.2f} m away (mean), {self.max_m:.2f} m at most, over {self.length_m:.1f} m"


def write_agreement(scene: Path, found: PathAgreement, first: Trajectory) -> None:
    """Write down in a scene's folder how far two paths agree."""
    write_json(scene / PATHS_AGREE, {"poses_sha256": _sum(first), **asdict(found)})


def read_agreement(scene: Path, first: Trajectory | None = None) -> PathAgreement | None:
    """Read it from a scene's folder; None where it was not written, or of another first path.

    Raises:
        InputError: the file holds something else.
    """
    path = scene / PATHS_AGREE
    if not path.is_file():
        return None
    content = read_json(path)
    names = [field.name for field in fields(PathAgreement)]
    if not isinstance(content, dict) or not all(isinstance(content.get(name), float) for name in names):
        raise InputError(f"{path}: expected {', '.join(names)} as numbers. Delete it; `process` then writes it again.")
    if first is not None and content.get("poses_sha256") != _sum(first):
        return None
    return PathAgreement(**{name: content[name] for name in names})


def _sum(path: Trajectory) -> str:
    return hashlib.sha256(path.vehicle_to_world.tobytes()).hexdigest()


def compare_paths(first: Trajectory, second: Trajectory) -> PathAgreement | None:
    """Lay a path over another by a rotation and a shift (Kabsch, Acta Crystallographica 1976).

    The second, of the same vehicle's frame, is asked where it was at the times of the first; None if they have fewer
    than three in common.
    """
    common = np.array([second.outside_s(time) == 0 for time in first.times_s.tolist()])
    if common.sum() < MIN_COMMON_TIMES:
        return None
    places = first.vehicle_to_world[common, :3, 3]
    others = second.at(first.times_s[common])[:, :3, 3]
    centred, other_centred = places - places.mean(0), others - others.mean(0)
    left, _, right = np.linalg.svd(centred.T @ other_centred)
    turn = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    apart = np.linalg.norm(other_centred @ turn.T - centred, axis=-1)
    lengths = [float(np.linalg.norm(np.diff(path, axis=0), axis=-1).sum()) for path in (places, others)]
    return PathAgreement(float(apart.mean()), float(apart.max()), lengths[0], lengths[1] / max(lengths[0], 1e-9))
