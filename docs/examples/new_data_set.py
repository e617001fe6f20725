"""Your own converter: it reads a drive in its own layout into a Recording, and writes the scene.

DRIVE/pictures/000000.png …   one camera, a Kannala-Brandt lens whose calibration is known
DRIVE/scans/000000.npy …      points × 3, float32, metres in the scanner's frame
DRIVE/poses.txt               one line per frame: x y heading (metres, radians), 10 per second
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
import tyro

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.cameras import KannalaBrandt
from edge_depth_nerf.lidar import Sweep, SweepTiming
from edge_depth_nerf.lidar.sweeps import usable_points
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.build import process_recording
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import RecordedCamera, RecordedPicture, RecordedSweep, Recording
from edge_depth_nerf.scene.writer import ProcessReport

INTERVAL_S = 0.1
LENS = KannalaBrandt(width=128, height=96, fx=40.0, fy=40.0, cx=64.0, cy=48.0, k1=0.01, k2=0.0, k3=0.0, k4=0.0)
"""Pixel centres lie at +0.5: OpenCV's cx and cy plus a half."""
CAMERA_TO_VEHICLE = np.array([[0.0, 0, 1, 0.5], [-1, 0, 0, 0], [0, -1, 0, 1.4], [0, 0, 0, 1]])
"""The camera looks ahead: x right, y down, z forward to x forward, y left, z up."""
SCANNER_TO_VEHICLE = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1.8], [0, 0, 0, 1]])


@dataclass(frozen=True, kw_only=True)
class MyDriveOptions(ProcessOptions):
    """Turn a drive of mine into a scene folder."""

    root: Path
    """The drive's folder."""


def read_scan(path: Path) -> Sweep:
    """One turn of the scanner; what is no LiDAR point is left out."""
    points_m = torch.from_numpy(np.load(path, allow_pickle=False).astype(np.float64))
    return usable_points(path, points_m, torch.zeros(len(points_m), dtype=torch.float64))


def read_poses(path: Path) -> np.ndarray:
    """The vehicle's poses, frames × 4 × 4, vehicle to world, z up."""
    table = np.loadtxt(path, ndmin=2)
    if table.shape[1] != 3:
        raise InputError(f"{path}: {table.shape[1]} numbers a line; expected x y heading.")
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    cos, sin = np.cos(table[:, 2]), np.sin(table[:, 2])
    poses[:, :2, :2] = np.moveaxis(np.array([[cos, -sin], [sin, cos]]), -1, 0)
    poses[:, :2, 3] = table[:, :2]
    return poses


def read_drive(options: MyDriveOptions) -> Recording:
    """Say what the drive consists of. Nothing large is read here."""
    poses = read_poses(options.root / "poses.txt")
    times_s = np.arange(len(poses)) * INTERVAL_S
    chosen = range(options.first, len(poses), options.stride)[: options.frames]
    pictures = [
        RecordedPicture("front", frame, options.root / f"pictures/{frame:06d}.png", float(times_s[frame]))
        for frame in chosen
    ]
    sweeps = []
    for frame, time_s in enumerate(times_s):
        path = options.root / f"scans/{frame:06d}.npy"
        sweeps.append(
            RecordedSweep(
                path=path,
                time_s=float(time_s),
                frame=frame,
                scanner="roof",
                to_vehicle=SCANNER_TO_VEHICLE,
                read=partial(read_scan, path),
                timing=SweepTiming(INTERVAL_S),  # clockwise, facing ahead at its time: points are de-skewed
            )
        )
    missing = [each.path for each in (*pictures, *sweeps) if not each.path.is_file()]
    if missing:
        raise InputError(f"{missing[0]}: no such file, but {options.root}/poses.txt has {len(poses)} frames.")
    return Recording(
        cameras=(RecordedCamera("front", LENS, CAMERA_TO_VEHICLE),),
        pictures=tuple(pictures),
        sweeps=tuple(sweeps),
        trajectory=Trajectory(times_s, poses),
        source={"kind": "my-drive", "root": options.root.resolve().name},
        whole_inputs=(options.root / "poses.txt",),
    )


def convert(options: MyDriveOptions) -> ProcessReport:
    """Write the scene folder; de-skewing, accumulation, masks and the rest happen here."""
    options.check()
    return process_recording(read_drive(options), options)


if __name__ == "__main__":
    convert(tyro.cli(MyDriveOptions))
