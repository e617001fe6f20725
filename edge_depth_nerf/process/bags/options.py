"""The options of `edge-depth-nerf unpack`; light to import, so that the command line starts at once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from edge_depth_nerf.base.errors import InputError


@dataclass(frozen=True)
class UnpackOptions:
    """Write the pictures, scans, calibration and poses of a ROS bag as a recording for `process rig`. No ROS needed."""

    bag: tyro.conf.Positional[Path]
    """A ROS 1 bag (.bag), a ROS 2 bag (its folder, .mcap or .db3), or a folder with the parts of one."""
    output: Path | None = None
    """The recording's folder to write. Run the same command again to resume."""
    list: bool = False
    """Only list the topics, with types and rates, and what each would be taken for."""
    topics: tuple[str, ...] = ()
    """Take pictures and scans of these topics only. Not set: one topic of each camera, and all scans."""
    poses: str | None = None
    """The topic of the poses, such as /odometry/filtered. Not set: the first of Odometry, PoseStamped, /tf, NavSatFix
    with Imu."""
    vehicle: str | None = None
    """The frame of the vehicle. Not set: that of the poses, or base_link."""
    start_s: float = 0.0
    """Begin so many seconds after the start of the bag."""
    seconds: float | None = None
    """Take so many seconds. Not set: to the end of the bag."""

    def check(self) -> None:
        """Check the ranges.

        Raises:
            InputError: an option is out of its range.
        """
        if self.output is None and not self.list:
            raise InputError("--output: is not set; it takes the folder to write. Or use --list to see the topics.")
        if self.start_s < 0:
            raise InputError(f"--start-s {self.start_s:g}: expected 0 or more.")
        if self.seconds is not None and self.seconds <= 0:
            raise InputError(f"--seconds {self.seconds:g}: expected more than 0.")
