"""How near `--refine-poses` comes to the truth of synthetic drives, from their true poses and from disturbed ones.

    edge-depth-nerf synthesize --output outputs/street --frames 24 --size 500
    edge-depth-nerf synthesize --output outputs/rig --layout rig --frames 24 --size 500
    python benchmarks/refine.py outputs/street outputs/rig

Each pose is disturbed by itself: normal shifts and turns whose length has the given standard deviation. A step's error
is that of the motion from one moment to the next; that of the path, of the cameras' centres after a rigid alignment.
Epipolar medians are those of `--refine-poses`, of features that took no part.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.process.colmap.refine import refine_poses
from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions, RigOptions
from edge_depth_nerf.process.recording import Recording

NOISES = ((0.0, 0.0), (1.0, 0.03), (3.0, 0.1), (10.0, 0.3))
"""cm and degrees."""
COLUMNS = ("drive", "noise", "step cm", "step °", "path cm", "what refine-poses says")


def options_of(drive: Path, output: Path) -> ProcessOptions:
    if (drive / "data_poses").is_dir():
        sequence = next((drive / "data_poses").iterdir()).name
        return Kitti360Options(root=drive, sequence=sequence, output=output)
    return RigOptions(root=drive, output=output)


def disturbed(recording: Recording, shift_cm: float, turn_deg: float, seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    assert recording.trajectory is not None
    path = recording.trajectory.vehicle_to_world
    off = np.tile(np.eye(4), (len(path), 1, 1))
    each = np.sqrt(3)
    off[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, np.radians(turn_deg) / each, (len(path), 3))).as_matrix()
    off[:, :3, 3] = rng.normal(0, shift_cm / 100 / each, (len(path), 3))
    pictures = tuple(dataclasses.replace(picture, camera_to_world=None) for picture in recording.pictures)
    trajectory = Trajectory(recording.trajectory.times_s, path @ off)
    return dataclasses.replace(recording, trajectory=trajectory, pictures=pictures)


def errors(found: Recording, truth: Recording) -> tuple[float, float, float]:
    """Of the steps, mean, cm and degrees; of the path, mean, cm."""
    lengths_cm, turns_deg = [], []
    for camera in truth.cameras:
        of_camera = [index for index, picture in enumerate(truth.pictures) if picture.camera == camera.name]
        true = [truth.pose(truth.pictures[index]) for index in of_camera]
        ours = [found.pose(found.pictures[index]) for index in of_camera]
        for a, b, c, d in zip(true, true[1:], ours, ours[1:], strict=False):
            off = np.linalg.inv(np.linalg.inv(a) @ b) @ np.linalg.inv(c) @ d
            lengths_cm.append(100 * np.linalg.norm(off[:3, 3]))
            turns_deg.append(np.degrees(np.linalg.norm(Rotation.from_matrix(off[:3, :3]).as_rotvec())))
    centres = [np.stack([one.pose(picture)[:3, 3] for picture in one.pictures]) for one in (found, truth)]
    ours, true = (points - points.mean(0) for points in centres)
    turn = Rotation.align_vectors(true, ours)[0]
    apart_cm = 100 * np.linalg.norm(turn.apply(ours) - true, axis=-1)
    return float(np.mean(lengths_cm)), float(np.mean(turns_deg)), float(apart_cm.mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drives", nargs="+", type=Path, help="folders written by `edge-depth-nerf synthesize`")
    parser.add_argument("--seeds", type=int, default=1, help="of the noise")
    arguments = parser.parse_args()
    console = Console(width=160)
    table = Table(*COLUMNS, title="Poses refined by the pictures, against the truth: before → after")
    for drive in arguments.drives:
        for shift_cm, turn_deg in NOISES:
            for seed in range(arguments.seeds if shift_cm else 1):
                with tempfile.TemporaryDirectory() as folder:
                    options = options_of(drive, Path(folder) / "scene")
                    truth = read_drive(options)
                    given = disturbed(truth, shift_cm, turn_deg, seed) if shift_cm else truth
                    refined = refine_poses(given, options, console)
                pairs = zip(errors(given, truth), errors(refined, truth), (2, 4, 2), strict=True)
                cells = [f"{before:.{digits}f} → {after:.{digits}f}" for before, after, digits in pairs]
                table.add_row(drive.name, f"{shift_cm:g} cm {turn_deg:g}°", *cells, refined.notices[-1])
    console.print(table)


if __name__ == "__main__":
    main()
