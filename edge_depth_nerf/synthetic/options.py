"""The options of `edge-depth-nerf synthesize`; light to import, so that the command line starts at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

import tyro

from edge_depth_nerf.base.errors import InputError

SceneName = Literal["street", "parking", "turn", "traffic", "roundabout"]
LayoutName = Literal["kitti-360", "jbnu-depth360", "rig"]

MEAN_SPEED_M_S: dict[SceneName, float] = {
    "street": 8.0,
    "parking": 4.0,
    "turn": 6.0,
    "traffic": 6.0,
    "roundabout": 5.0,
}
"""How fast the car drives in each scene; a frame is 0.1 s."""


_SIZE_RANGE_PX = (32, 4096)
_MOVING_MAX = 8


@dataclass(frozen=True)
class SynthesizeOptions:
    """A drive with fisheye pictures, LiDAR sweeps, poses and ground truth, in KITTI-360's raw layout or another."""

    sequence: ClassVar[str] = "2013_05_28_drive_0000_sync"
    """Name of the sequence in the folders of KITTI-360's layout."""

    output: Path
    """Folder to write the drive to. Run the same command again to resume."""
    scene: SceneName = "street"
    """A street, an underground car park, a junction, a street with moving cars and people, or a roundabout."""
    frames: int = 40
    """Number of frames, 0.1 s apart, each with two pictures and one LiDAR sweep."""
    size: int = 350
    """Width and height of the pictures in pixels; KITTI-360's own are 1400."""
    seed: int = 0
    """Seed of everything random. Same options, same bytes."""
    moving: tyro.conf.Suppress[int] = 0
    """Number of other cars that drive through the scene; their masks are written as truth/<sequence>/moving_masks."""
    shifts_m: tuple[float, ...] = (1.0, 2.0)
    """kitti-360: distances to the left of the path from which true views are rendered, of every eighth frame, metres;
    negative to the right. `compare` evaluates methods by them."""
    layout: LayoutName = "kitti-360"
    """kitti-360: two fisheyes; jbnu-depth360: four fisheyes; rig: two fisheyes and a pinhole with a rig.toml."""

    @property
    def has_movers(self) -> bool:
        """Whether anything but the recording car moves."""
        return self.moving > 0 or self.scene == "traffic"

    @property
    def mean_speed_m_s(self) -> float:
        """The mean speed that applies, in m/s."""
        return MEAN_SPEED_M_S[self.scene]

    def check(self) -> None:
        """Check every field's range.

        Raises:
            InputError: a value cannot be used; names the option, the value and the range.
        """
        for name, choices in (("scene", SceneName), ("layout", LayoutName)):
            if (given := getattr(self, name)) not in get_args(choices):
                expected = ", ".join(get_args(choices))
                raise InputError(f"--{name} {given}: no such {name}, expected one of {expected}.")
        if self.frames < 1:
            raise InputError(f"--frames {self.frames}: expected at least 1.")
        if not _SIZE_RANGE_PX[0] <= self.size <= _SIZE_RANGE_PX[1]:
            raise InputError(f"--size {self.size}: expected {_SIZE_RANGE_PX[0]} to {_SIZE_RANGE_PX[1]} pixels.")
        if self.seed < 0:
            raise InputError(f"--seed {self.seed}: expected 0 or more.")
        if not all(abs(shift_m) <= 99 and round(shift_m, 2) == shift_m for shift_m in self.shifts_m):
            given = " ".join(map(str, self.shifts_m))
            raise InputError(f"--shifts-m {given}: expected metres, -99 to 99, with at most two decimals.")
        if not 0 <= self.moving <= _MOVING_MAX:
            raise InputError(f"--moving {self.moving}: expected 0 to {_MOVING_MAX} driving cars.")
