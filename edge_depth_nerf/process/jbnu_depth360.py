"""JBNU-Depth360 (Jeonbuk National University): 183° fisheyes of 1920×1080 and an Ouster OS0-32 in a car park.

A sequence, 230329/test_1 and so on, as published:

    image/000000.png                 pictures of the front camera
    bin/000000.bin                   scans; a scan's number is that of its picture

Calibration and poses are not published: users provide them as a rig file, as docs/rig.md describes. What the
data set is known, or taken, to have stands in `_fill_in` and may be left out there. All else is as for any rig.
"""

from __future__ import annotations

from typing import Any

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.process.options import JbnuDepth360Options
from edge_depth_nerf.process.recording import Recording
from edge_depth_nerf.process.rig import recording_of_rig
from edge_depth_nerf.process.rig_file import read_rig
from edge_depth_nerf.scene.checks import require_folder

RATE_HZ = 10.0
"""Pictures and scans a second; the data set has numbers instead of times."""
SCANNER = "ouster"
"""The scanner's name, if the rig file has none."""


def read_jbnu_depth360(options: JbnuDepth360Options) -> Recording:
    """Find and check what the scene of a sequence is made of.

    Raises:
        FileNotFoundError: a folder or file of the data set is missing.
        InputError: an option or a file of the data set cannot be used.
    """
    for folder in ("image", "bin"):
        require_folder(options.root / folder, "--root takes a sequence's folder such as 230329/test_1")
    rig = read_rig(options.calibration, options.calibration.parent, _fill_in)
    if len(rig.lidars) != 1:
        raise InputError(f"{rig.path}: {len(rig.lidars)} scanners in [lidars]; the data set has one.")
    return recording_of_rig(rig, options, "jbnu-depth360")


def _fill_in(content: dict[str, Any]) -> None:
    """Add what a file does not say. Tables that are no tables are left for the check that follows."""
    cameras = content.get("cameras")
    cameras = cameras if isinstance(cameras, dict) else {}
    for name, camera in cameras.items():
        if isinstance(camera, dict):
            images = "image" if len(cameras) == 1 else f"image/{name}"
            _add(camera, model="kannala-brandt", width=1920, height=1080, images=images)
    # the vehicle's frame is the scanner's, if the file does not say otherwise
    identity = [[float(row == column) for column in range(4)] for row in range(4)]
    lidars = content.setdefault("lidars", {SCANNER: {}})
    for lidar in lidars.values() if isinstance(lidars, dict) else ():
        if isinstance(lidar, dict):
            turn = {} if "point_times" in lidar else {"turn_s": 1 / RATE_HZ, "timestamp": "middle"}
            turned = {} if {"point_times", "corrected_to"} & lidar.keys() else {"direction": "clockwise"}
            _add(lidar, to_vehicle=identity, scans="bin", **turn, **turned)
    poses = content.get("poses")
    if isinstance(poses, dict):
        poses.setdefault("format", "tum")
        if poses["format"] == "kitti":
            _add(poses)


def _add(table: dict[str, Any], **known: Any) -> None:
    """Add what a table does not say, and its clock."""
    if not {"times_file", "times_from_names", "rate_hz"} & table.keys():
        table["rate_hz"] = RATE_HZ
    table.update({**known, **table})
