"""What kind of recording a folder holds, and how much of it a demo takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.options import (
    JbnuDepth360Options,
    Kitti360Options,
    KittiOptions,
    ProcessOptions,
    RigOptions,
)

LARGEST_PX = 704
"""Wider pictures are averaged down to this or less: whole views of two models are rendered on a CPU."""
LEAST_FRAMES = 12
"""With fewer, little would be left to train on and to evaluate with."""


def options_of(root: Path, output: Path, frames: int) -> ProcessOptions:
    """Say how `process` makes a small scene of a recording; every file is checked, nothing large is read.

    Args:
        root: the recording's folder.
        output: the scene folder.
        frames: how many are used at most, from the first one on.

    Raises:
        FileNotFoundError: the folder or a file of it is missing.
        InputError: it is no recording, one of its files cannot be used, or a demo needs more than it has.
    """
    if not root.is_dir():
        raise FileNotFoundError(f"--real {root}: no such folder; expected that of a recording.")
    whole = next(_kinds(root, output), None)
    if whole is None:
        raise InputError(
            f"--real {root}: is no recording that can be read. Expected rig.toml or rig.json, which describes your own "
            "(docs/rig.md), or data_3d_raw (KITTI-360), sequences or 2011_09_26 (KITTI), or image, bin and "
            "calibration.toml (JBNU-Depth360)."
        )
    whole.check()
    recording = read_drive(whole)
    if not recording.sweeps and not any(picture.depth for picture in recording.pictures):
        raise InputError(f"--real {root}: has no LiDAR sweeps and no depth maps, which ours is trained with.")
    numbers = sorted({picture.frame for picture in recording.pictures})[:frames]
    if len(numbers) < LEAST_FRAMES:
        raise InputError(
            f"--real {root}: {len(numbers)} usable frames, at --frames {frames}; expected {LEAST_FRAMES} or more."
        )
    width = max(camera.camera.width for camera in recording.cameras)
    count = numbers[-1] - numbers[0] + 1
    return replace(whole, first=numbers[0], frames=count, downscale=-(-width // LARGEST_PX))


def _kinds(root: Path, output: Path) -> Iterator[ProcessOptions]:
    """Give the options of each converter that the folder is laid out for, for the first of its sequences."""
    if any((root / name).is_file() for name in ("rig.toml", "rig.json")):
        yield RigOptions(root=root, output=output)
    # before Python 3.11 this finds files, too
    for path in filter(Path.is_dir, sorted(root.glob("data_3d_raw/*/"))):
        yield Kitti360Options(root=root, sequence=path.name, output=output)
    for path in filter(Path.is_dir, [*sorted(root.glob("*_*_*/*_sync/")), *sorted(root.glob("sequences/*/"))]):
        yield KittiOptions(root=root, sequence=path.name, output=output)
    if all((root / name).exists() for name in ("image", "bin", "calibration.toml")):
        yield JbnuDepth360Options(root=root, calibration=root / "calibration.toml", output=output)
