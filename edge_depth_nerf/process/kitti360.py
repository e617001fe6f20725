"""From a KITTI-360 drive, real or synthesised, to a scene folder.

Read from the data set's folder, for each frame number f:

    calibration/{image_02.yaml,image_03.yaml,calib_cam_to_pose.txt,calib_cam_to_velo.txt}
    data_2d_raw/SEQUENCE/image_02/data_rgb/f.png     and image_02/timestamps.txt, if it is there
    data_3d_raw/SEQUENCE/velodyne_points/data/f.bin
    data_poses/SEQUENCE/poses.txt
    truth/SEQUENCE/…                                 what only synthesised drives have

A LiDAR sweep goes to a camera by velo → vehicle → camera, at the frame's own moment: inv(camera→pose) ·
(cam_0→pose) · inv(cam_0→velo). cam0_to_world.txt is of the rectified camera 0 and not used. Everything is checked
by sizes and headers before the first map is made.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from rich.console import Console
from torch import Tensor

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.lidar import Sweep, project_points, read_sweep, transform_points
from edge_depth_nerf.process.downscale import downscale_distance, downscale_image, downscale_mask
from edge_depth_nerf.process.kitti360_calibration import Kitti360Rig, read_poses, read_rig
from edge_depth_nerf.process.kitti360_drive import FrameFiles, Kitti360Drive, check_distance, check_size, summarise
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.process.points import PointCloud
from edge_depth_nerf.process.scene import (
    CLOUD,
    DistanceMap,
    FrameContent,
    Picture,
    ProcessReport,
    SceneCamera,
    SceneFrame,
    ShiftedView,
    held_out_frames,
    write_scene,
)
from edge_depth_nerf.process.transforms import Transform, check_rigid


def process_kitti360(options: Kitti360Options, console: Console | None = None) -> ProcessReport:
    """Write the scene folder that `options` describe, or continue it.

    Raises:
        FileNotFoundError: a folder or file of the drive is missing.
        InputError: an option, a file of the drive, or the output folder cannot be used.

    """
    console = console or Console()
    drive = Kitti360Drive(options)
    rig = read_rig(drive.calibration, options.cameras)
    poses = read_poses(drive.poses)
    kept, skipped = drive.select(poses)
    if skipped:
        _say(console, f"Skipped {summarise(skipped)}", "yellow")
    files = drive.check_files(rig, kept)
    cameras = [_scene_camera(drive, rig, name) for name in options.cameras]
    moments = sorted({frame for _, frame in kept})
    times = {name: drive.read_timestamps(name, moments) for name in options.cameras}
    held_out = dict(zip(moments, held_out_frames(len(moments), options.holdout_every), strict=True))
    dropped = _Dropped()

    def scene_frame(name: str, frame: int) -> SceneFrame:
        return SceneFrame(
            camera=name,
            frame=frame,
            camera_to_world=poses[frame] @ rig.camera_to_pose[name],
            content=partial(
                _load,
                files[name, frame],
                rig,
                name,
                poses[frame],
                factor=options.downscale,
                training=not held_out[frame],
                dropped=dropped,
            ),
            timestamp_s=times[name].get(frame),
            held_out=held_out[frame],
            inputs=files[name, frame].paths,
        )

    shifted = _shifted_views(drive, rig, {(name, frame) for name, frame in kept if held_out[frame]})
    report = write_scene(
        options.output,
        cameras,
        [scene_frame(name, frame) for name, frame in kept],
        layers=_layers(drive),
        source=_source(drive, files.values(), shifted),
        theta_max_deg=options.theta_max_deg,
        shifted=shifted,
        console=console,
    )
    timeless = [
        f"{drive.timestamps_file(name)}: no such file; the frames of {name} have no timestamp_s."
        for name, found in times.items()
        if not found
    ]
    report = dataclasses.replace(
        report, skipped=tuple(skipped), notices=(*timeless, *dropped.notices(), *report.notices)
    )
    _show(report, console)
    return report


# ---- making the maps -------------------------------------------------------------------------------------------


class _Dropped:
    """Counts the points left out, once a sweep: each is read by several threads, for each camera again."""

    def __init__(self) -> None:
        self._by_file: dict[Path, tuple[int, int]] = {}

    def add(self, path: Path, sweep: Sweep) -> None:
        self._by_file[path] = (sweep.not_finite, sweep.out_of_range)

    def notices(self) -> list[str]:
        not_finite, out_of_range = np.sum([*self._by_file.values(), (0, 0)], axis=0)
        found = {"NaN or infinite": not_finite, "zero, nearer than 0.5 m or beyond 255 m": out_of_range}
        return [
            f"{count} LiDAR points left out of {len(self._by_file)} sweeps: {why}."
            for why, count in found.items()
            if count
        ]


def _points_in_pose(sweep: Sweep, rig: Kitti360Rig) -> Float[Tensor, "returns 3"]:
    """Express a sweep in the vehicle's frame at the frame's moment; metres.

    The sweep is taken as if it had been measured at one moment. The vehicle's motion during the scanner's turn
    belongs here.
    """
    return transform_points(torch.from_numpy(rig.velo_to_pose), sweep.points_m)


def _load(
    files: FrameFiles,
    rig: Kitti360Rig,
    name: str,
    pose_to_world: Transform,
    *,
    factor: int,
    training: bool,
    dropped: _Dropped,
) -> FrameContent:
    """Make the maps of one picture, at the scene's size."""
    camera = rig.cameras[name].downscaled(factor)
    sweep = read_sweep(files.sweep)
    dropped.add(files.sweep, sweep)
    in_pose = _points_in_pose(sweep, rig)
    pose_to_camera = torch.from_numpy(np.linalg.inv(rig.camera_to_pose[name]))
    seen = project_points(transform_points(pose_to_camera, in_pose), camera)
    image = downscale_image(read_image(files.image), factor)
    mask = None if files.mask is None else downscale_mask(read_mask(files.mask), factor)
    return FrameContent(
        image=files.image if factor == 1 else image,
        mask=mask,
        lidar=seen.distance_m.numpy(),
        mono=None if files.mono is None else _distance(files.mono, factor),
        truth_distance=None if files.truth_distance is None else _distance(files.truth_distance, factor),
        truth_rgb=None if files.truth_rgb is None else _picture(files.truth_rgb, factor),
        cloud=_cloud(seen.point_index, in_pose, pose_to_world, image) if training else None,
    )


def _cloud(
    point_index: Int[Tensor, "height width"],
    in_pose: Float[Tensor, "returns 3"],
    pose_to_world: Transform,
    image: UInt8[np.ndarray, "height width 3"],
) -> PointCloud:
    """Gather the points that a picture sees, in the world, with its colours."""
    hit = point_index >= 0
    points = in_pose[point_index[hit]]
    return PointCloud(
        points_m=transform_points(torch.from_numpy(pose_to_world), points).numpy(),
        colours=image[hit.numpy()],
        pixels=torch.nonzero(hit).numpy(),
    )


def _picture(path: Path, factor: int) -> Picture:
    return path if factor == 1 else downscale_image(read_image(path), factor)


def _distance(path: Path, factor: int) -> DistanceMap:
    return path if factor == 1 else downscale_distance(read_distance_png(path), factor)


def _scene_camera(drive: Kitti360Drive, rig: Kitti360Rig, name: str) -> SceneCamera:
    factor = drive.options.downscale
    mask = drive.read_ego_mask(name, rig.cameras[name])
    return SceneCamera(
        name, rig.cameras[name].downscaled(factor), None if mask is None else downscale_mask(mask, factor)
    )


def _layers(drive: Kitti360Drive) -> list[str]:
    given = {
        "mask": drive.options.frame_masks is not None,
        "lidar": True,
        "mono": drive.options.mono is not None,
        "truth_distance": drive.has_truth,
        "truth_rgb": drive.has_truth,
        CLOUD: True,
    }
    return [layer for layer, present in given.items() if present]


def _shifted_views(drive: Kitti360Drive, rig: Kitti360Rig, held_out: set[tuple[str, int]]) -> list[ShiftedView]:
    """Find the true views beside the path, of the frames held out: next to a training frame, judging is too easy."""
    path = drive.truth / "shifted.json"
    if not path.is_file():
        return []
    poses = {
        (metres, name, int(frame)): matrix
        for metres, cameras in read_json(path).items()
        for name, frames in cameras.items()
        for frame, matrix in frames.items()
    }
    views = []
    for (metres, name, frame), matrix in poses.items():
        if (name, frame) not in held_out:
            continue
        where = f"{path}: {metres} m, {name}, frame {frame}"
        camera_to_world = np.array(matrix, np.float64)
        if camera_to_world.shape != (4, 4):
            raise InputError(f"{where}: expected a 4×4 matrix. Synthesise the drive again.")
        check_rigid(camera_to_world, where)
        folder = drive.truth / name / f"shifted_{metres}m"
        picture, distance = (folder / kind / f"{frame:010d}.png" for kind in ("rgb", "distance"))
        check_size(picture, rig.cameras[name])
        check_distance(distance, rig.cameras[name])
        views.append(
            ShiftedView(
                metres=int(metres),
                camera=name,
                frame=frame,
                camera_to_world=camera_to_world,
                content=partial(_load_shifted, picture, distance, drive.options.downscale),
                inputs=(picture, distance),
            )
        )
    return views


def _load_shifted(picture: Path, distance: Path, factor: int) -> tuple[Picture, DistanceMap]:
    return _picture(picture, factor), _distance(distance, factor)


# ---- what the scene says of itself -----------------------------------------------------------------------------


def _source(drive: Kitti360Drive, files: Iterable[FrameFiles], shifted: list[ShiftedView]) -> dict[str, Any]:
    """Describe what the scene is made of, without the machine's paths."""
    options = drive.options
    digest = hashlib.sha256()
    whole = [drive.calibration / "calib_cam_to_pose.txt", drive.calibration / "calib_cam_to_velo.txt", drive.poses]
    whole += [drive.calibration / f"{name}.yaml" for name in options.cameras]
    whole += [path for name in options.cameras if (path := drive.ego_mask_file(name))]
    for path in whole:
        digest.update(path.read_bytes())
    # the maps' sizes tell one drive from another; reading them all would take as long as the work
    sized = [path for found in files for path in found.paths] + [path for view in shifted for path in view.inputs]
    for path in sized:
        digest.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
    return {
        "kind": "kitti360",
        "root": options.root.resolve().name,
        "sequence": options.sequence,
        "first": options.first,
        "frames": options.frames,
        "stride": options.stride,
        "cameras": list(options.cameras),
        "downscale": options.downscale,
        "ego_mask": options.ego_mask is not None,
        "frame_masks": options.frame_masks is not None,
        "mono": options.mono is not None,
        "theta_max_deg": options.theta_max_deg,
        "holdout_every": options.holdout_every,
        "inputs_sha256": digest.hexdigest(),
    }


def _say(console: Console, text: str, style: str | None = None) -> None:
    console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def _show(report: ProcessReport, console: Console) -> None:
    for name, fit in report.fits.items():
        _say(
            console,
            f"{name}: fisheye camera fitted within {fit.rms_px:.4f} px rms, {fit.max_px:.3f} px at most; the mask "
            f"keeps {report.mask_share[name]:.0%} of the picture",
        )
    for notice in report.notices:
        _say(console, notice, "yellow")
    done = "" if report.written else "; nothing was left to do"
    _say(console, f"{report.scene}: {report.training} pictures for training, {report.held_out} held out{done}")
