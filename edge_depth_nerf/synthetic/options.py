"""The options of `edge-depth-nerf synthesize`; light to import, so that the command line starts at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal, get_args

from edge_depth_nerf.base.errors import InputError, require

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
    """Number of frames, 0.1 s apart, each with a picture of every camera and one LiDAR sweep."""
    size: int = 350
    """Width of the pictures in pixels, and height of fisheyes; KITTI-360's own are 1400."""
    seed: int = 0
    """Seed of everything random. Same options, same bytes."""
    shifts_m: tuple[float, ...] = (1.0, 2.0)
    """kitti-360: distances to the left of the path from which true views are rendered, of every eighth frame, metres;
    negative to the right. `compare` evaluates methods by them."""
    layout: LayoutName = "kitti-360"
    """kitti-360: two fisheyes; jbnu-depth360: four fisheyes; rig: two fisheyes and a pinhole with a rig.toml."""

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
        smallest, largest = _SIZE_RANGE_PX
        require(self.frames >= 1, f"--frames {self.frames}", "at least 1")
        require(smallest <= self.size <= largest, f"--size {self.size}", f"{smallest} to {largest} pixels")
        require(self.seed >= 0, f"--seed {self.seed}", "0 or more")
        fine = all(abs(shift_m) <= 99 and round(shift_m, 2) == shift_m for shift_m in self.shifts_m)
        given = " ".join(map(str, self.shifts_m))
        has_views = self.layout == "kitti-360" or self.shifts_m == type(self).shifts_m
        require(has_views, f"--shifts-m {given} --layout {self.layout}", "kitti-360, which alone has such views")
        require(fine, f"--shifts-m {given}", "metres, -99 to 99, with at most two decimals")
