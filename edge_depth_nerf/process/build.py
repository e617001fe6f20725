"""From a recording to a scene folder: poses, masks, and the maps of each picture.

What every converter shares. LiDAR points go to the world by the vehicle's pose at their own time, from there to the
camera, and through its lens to a sparse map of distances; what is hidden from the camera is left out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
import threading
from collections import defaultdict
from collections.abc import Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import is_newer, read_distance_png, read_image, read_json, write_json
from edge_depth_nerf.cameras import Camera
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.masks.ego_files import EGO_MASKS, ego_mask_path
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.masks.sky import find_sky
from edge_depth_nerf.process.found_path import with_all_cameras
from edge_depth_nerf.process.held_out import check_holdout_cameras, is_held_out, of_training_cameras
from edge_depth_nerf.process.kept_sweeps import keep_sweeps
from edge_depth_nerf.process.lidar_checks import LidarCheck, check_lidar
from edge_depth_nerf.process.mask_checks import mask_warnings
from edge_depth_nerf.process.moving import find_moving
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.path_checks import path_warnings
from edge_depth_nerf.process.pose_checks import features_say, lidar_says
from edge_depth_nerf.process.reading import (
    downscale_distance,
    downscale_image,
    downscale_mask,
    load_distance,
    load_picture,
    read_depth,
)
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.process.sweep_store import SweepStore
from edge_depth_nerf.process.vehicle import find_vehicle, vehicle_masks, with_given_masks
from edge_depth_nerf.scene.checks import read_camera_mask
from edge_depth_nerf.scene.format import CHECKS, TRANSFORMS
from edge_depth_nerf.scene.points import PointCloud
from edge_depth_nerf.scene.writer import (
    CLOUD,
    INCOMPLETE,
    INPUTS,
    WHOLE,
    DistanceMap,
    FrameContent,
    ProcessReport,
    SceneCamera,
    SceneFrame,
    best_holdout,
    check_cameras,
    held_out_frames,
    open_scene,
    summarise,
    world_offset_m,
    write_scene,
)

FOUND_POSES = "found_poses.json"
"""File of the scene with poses that were found or refined: camera, frame, held out, camera to world."""
MOST_LISTED = 50
"""So many files that were left out are listed."""


def process_recording(recording: Recording, options: ProcessOptions, console: Console | None = None) -> ProcessReport:
    """Write the scene folder of a recording, or continue it.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: an option, a file of the drive, or the output folder cannot be used.
    """
    console = console or Console()
    options.check()
    recording = with_given_masks(recording, options)
    check_holdout_cameras(recording, options)
    _check_poses(recording, options)
    with console.status("Checking cameras and files …"):
        source = _source(recording, options)
        check_cameras(_scene_cameras(recording, vehicle_masks(recording), options), options.theta_max_deg)
    open_scene(options.output, source)
    if options.poses == "lidar":
        from edge_depth_nerf.process.lidar_poses import lidar_poses

        recording = lidar_poses(recording, options, console)
    notices: list[str] = []
    masked_before = (options.output / EGO_MASKS).exists()
    if options.find_ego:
        held_out = _held_out(recording, options)
        # a camera that is held out needs a mask, too, which no other camera's pictures depend on
        training = [picture for picture in recording.pictures if picture.frame not in held_out]
        recording, notices = find_vehicle(recording, training, options, console)
    checked = None
    if options.poses == "recorded":
        # poses that come with the drive are checked before anything long; the vehicle, unmasked, looks like an error
        try:
            checked = _checked(recording, options, console)
        except (InputError, KeyboardInterrupt):
            # what is corrected begins anew
            if not masked_before:
                shutil.rmtree(options.output / EGO_MASKS, ignore_errors=True)
            raise
    recording, said = _posed(recording, options, console)
    notices += said
    checked = checked or _checked(recording, options, console)
    if recording.skipped:
        say(console, f"Left out: {summarise(recording.skipped)}", "yellow")
    held_out, masks = _held_out(recording, options), vehicle_masks(recording)
    if options.find_moving:
        recording, more = find_moving(recording, options, held_out, masks, console)
        notices += more
    cameras = _scene_cameras(recording, masks, options)
    builder = _Builder(recording, options, held_out, cameras)
    frames = [
        SceneFrame(
            camera=picture.camera,
            frame=picture.frame,
            camera_to_world=recording.pose(picture),
            content=partial(builder.content, picture),
            timestamp_s=picture.timestamp_s,
            held_out=is_held_out(picture, held_out, options),
            inputs=builder.inputs(picture),
        )
        for picture in recording.pictures
    ]
    shifted = [view for view in recording.shifted if view.frame in held_out]
    if recording.shifted and not shifted:
        notices.append("The drive's true views beside the path are left out: none is of a held-out frame.")
    scanners = keep_sweeps(recording, options, held_out, world_offset_m(frames), console)
    report = write_scene(
        options.output,
        cameras,
        frames,
        layers=builder.layers,
        source=source,
        theta_max_deg=options.theta_max_deg,
        shifted=shifted,
        scanners=scanners,
        strict=options.strict,
        console=console,
    )
    notices += _never_held_out(of_training_cameras(recording, options), held_out, options.holdout_every)
    if not report.held_out:
        notices.append(_none_held_out(len({picture.frame for picture in recording.pictures}), options.holdout_every))
    report = dataclasses.replace(
        report,
        skipped=recording.skipped,
        left_out=(*recording.left_out, *report.left_out),
        notices=(*recording.notices, *notices, *builder.notices(), *report.notices),
        warnings=checked.warnings,
    )
    _show(report, console)
    return report


def _none_held_out(frames: int, holdout_every: int) -> str:
    """Say that a drive of so many frames has no held-out one, and what to do."""
    text = "No frame is held out, so evaluation runs on the training pictures and means little."
    best = best_holdout(frames)
    if frames == 1:
        return f"{text} The drive has only one frame: take a longer stretch."
    if not holdout_every:
        return f"{text} Use --holdout-every {best} to hold frames out."
    if any(held_out_frames(frames, holdout_every)):
        return f"{text} All held-out frames were left out because of broken or missing files."
    return f"{text} {frames} frames are too few for --holdout-every {holdout_every}: use --holdout-every {best}."


def _never_held_out(recording: Recording, held_out: Collection[int], holdout_every: int) -> list[str]:
    """Name cameras whose pictures all are for training although others' are held out, as of two that take turns."""
    of_camera: dict[str, set[int]] = defaultdict(set)
    for picture in recording.pictures:
        of_camera[picture.camera].add(picture.frame)
    never = [name for name, frames in of_camera.items() if len(frames) >= holdout_every and not frames & {*held_out}]
    if not held_out or not never:
        return []
    return [
        f"No picture of {', '.join(never)} is held out, so nothing evaluates it. Use --holdout-every "
        f"{holdout_every + 1}, which meets other frames."
    ]


def _checked(recording: Recording, options: ProcessOptions, console: Console) -> LidarCheck:
    """Hold LiDAR, the pictures, the path and the masks against each other, and keep what is found.

    A complete scene was checked before, unless files are newer.

    Raises:
        InputError: under `strict`, something seems to be wrong.
    """
    path = options.output / CHECKS
    made_of = [*(file for one in recording.pictures for file in one.inputs), *(one.path for one in recording.sweeps)]
    made_of += [camera.ego_mask for camera in recording.cameras if camera.ego_mask is not None]
    kept = (options.output / TRANSFORMS).is_file() and is_newer(path, made_of)
    found = LidarCheck((), tuple(read_json(path)["warnings"])) if kept else _compared(recording, options, console)
    if options.strict and found.warnings:
        raise InputError(" ".join(found.warnings) + " Without --strict this is a warning.")
    if not kept:
        # they are repeated at the end; whoever sees them now may stop
        for warning in found.warnings:
            say(console, warning, "yellow")
        write_json(path, dataclasses.asdict(found))
    return found


def _compared(recording: Recording, options: ProcessOptions, console: Console) -> LidarCheck:
    if recording.trajectory is None:
        raise InputError("the recording has no poses. Give them, or compute them: --poses lidar, --poses colmap.")
    masks = vehicle_masks(recording)
    usable = {one.name: lens_circle(one.camera, options.theta_max_deg) for one in recording.cameras}
    with console.status("Comparing LiDAR with the pictures"):
        # where the path or a mask is wrong, LiDAR seems to be, too
        of_masks = mask_warnings(_with_given_masks_alone(recording, options.output), usable)
        for name, mask in masks.items():
            usable[name] = usable[name] & mask
        of_path, lost = path_warnings(recording, usable) if options.poses == "recorded" else ([], False)
        # where lengths or masks are wrong, LiDAR seems to be, too
        found = LidarCheck((), ()) if lost or of_masks else check_lidar(recording, usable)
        return dataclasses.replace(found, warnings=(*of_path, *of_masks, *found.warnings))


def _with_given_masks_alone(recording: Recording, output: Path) -> Recording:
    """Leave out the masks that were found: they may hide most of a lens, whose dark rim is in them."""
    cameras = [
        dataclasses.replace(camera, ego_mask=None) if camera.ego_mask == ego_mask_path(output, camera.name) else camera
        for camera in recording.cameras
    ]
    return dataclasses.replace(recording, cameras=tuple(cameras))


def _check_poses(recording: Recording, options: ProcessOptions) -> None:
    """Find out before anything long begins whether poses can be found as the options say."""
    if options.poses == "colmap":
        from edge_depth_nerf.process.colmap.poses import check_colmap

        check_colmap(recording, options)
    elif options.poses == "lidar":
        from edge_depth_nerf.process.lidar_poses import check_sweeps

        check_sweeps(recording)


def _posed(recording: Recording, options: ProcessOptions, console: Console) -> tuple[Recording, list[str]]:
    """Find or refine the poses as the options ask, but for those of `--poses lidar`, and say how good they are."""
    notices = []
    if options.poses == "colmap":
        from edge_depth_nerf.process.colmap.poses import colmap_poses

        found = colmap_poses(of_training_cameras(recording, options), options, console)
        recording = found if found.cameras == recording.cameras else with_all_cameras(found, recording)
        notices = lidar_says(recording, options.output, console)
    elif options.poses == "lidar":
        notices = features_say(recording, options, console)
    if options.refine_poses:
        from edge_depth_nerf.process.colmap.refine import check_refining, refine_poses

        try:
            check_refining(recording, options)
        except InputError as error:
            notices.append(f"The given poses are used unchanged. {error}")
        else:
            recording = refine_poses(recording, options, console)
    return recording, notices


def _held_out(recording: Recording, options: ProcessOptions) -> set[int]:
    """Numbers of the frames that are kept from training."""
    frames = sorted({picture.frame for picture in recording.pictures})
    return {
        frame for frame, out in zip(frames, held_out_frames(len(frames), options.holdout_every), strict=True) if out
    }


def _scene_cameras(
    recording: Recording, masks: dict[str, NDArray[np.bool_]], options: ProcessOptions
) -> list[SceneCamera]:
    """The cameras at the scene's size."""
    factor = options.downscale
    return [
        SceneCamera(
            recorded.name,
            recorded.camera.downscaled(factor),
            downscale_mask(masks[recorded.name], factor) if recorded.name in masks else None,
        )
        for recorded in recording.cameras
    ]


# ---- making the maps -------------------------------------------------------------------------------------------


class _Builder:
    """Makes the maps of pictures; called from several threads."""

    def __init__(
        self, recording: Recording, options: ProcessOptions, held_out: set[int], cameras: Sequence[SceneCamera]
    ) -> None:
        self._options, self._held_out, self._recording = options, held_out, recording
        self._cameras = {recorded.name: recorded for recorded in recording.cameras}
        self._store = SweepStore(recording, options, held_out)
        self._usable: dict[str, NDArray[np.bool_]] = {}
        for scene_camera in cameras:
            usable = lens_circle(scene_camera.original, options.theta_max_deg)
            self._usable[scene_camera.name] = usable if scene_camera.mask is None else usable & scene_camera.mask
        self.found = self._keep_poses()
        self._lock = threading.Lock()
        self._coverage: dict[str, list[float]] = defaultdict(list)
        self._without: list[str] = []
        pictures = recording.pictures
        present = {
            "mask": any(picture.mask or picture.moving_mask for picture in pictures),
            "lidar": bool(recording.sweeps) or any(picture.depth for picture in pictures),
            "mono": any(picture.mono for picture in pictures),
            "beams": bool(recording.sweeps) and options.holdout_beams > 0,
            "truth_distance": any(picture.truth_distance for picture in pictures),
            "truth_rgb": any(picture.truth_rgb for picture in pictures),
        }
        present[CLOUD] = present["lidar"]
        self.layers = [layer for layer, there in present.items() if there]

    def _keep_poses(self) -> Path:
        """Write down the poses, and what is held out: other ones make other maps."""
        path = self._options.output / FOUND_POSES
        pictures, pose = self._recording.pictures, self._recording.pose
        poses = [[p.camera, p.frame, self._is_held_out(p), pose(p).tolist()] for p in pictures]
        if not path.is_file() or read_json(path) != poses:
            write_json(path, poses)
        return path

    def inputs(self, picture: RecordedPicture) -> tuple[Path, ...]:
        """Files that a picture's maps are made from."""
        sweeps = [sweep.path for sweep in self._store.used(picture.frame, picture.time_s)]
        ego = self._cameras[picture.camera].ego_mask
        return (*picture.inputs, *sweeps, self.found, *([] if ego is None else [ego]))

    def content(self, picture: RecordedPicture) -> FrameContent:
        """Make the maps of one picture, at the scene's size."""
        factor = self._options.downscale
        camera = self._cameras[picture.camera].camera
        image = downscale_image(read_image(picture.path), factor)
        mask = self._mask(picture, camera)
        lidar, cloud = self._lidar(picture, camera, image)
        mono = None if picture.mono is None else self._mono(picture, camera, image, lidar)
        return FrameContent(
            image=picture.path if factor == 1 else image,
            mask=None if mask is None else downscale_mask(mask, factor),
            lidar=lidar,
            mono=mono,
            beams=self._beams(picture, camera) if "beams" in self.layers else None,
            truth_distance=None if picture.truth_distance is None else load_distance(picture.truth_distance, factor),
            truth_rgb=None if picture.truth_rgb is None else load_picture(picture.truth_rgb, factor),
            cloud=None if self._is_held_out(picture) else cloud,
        )

    def _is_held_out(self, picture: RecordedPicture) -> bool:
        return is_held_out(picture, self._held_out, self._options)

    def _mask(self, picture: RecordedPicture, camera: Camera) -> NDArray[np.bool_] | None:
        """What of the picture holds still, as far as that is given."""
        if "mask" not in self.layers:
            return None
        masks = [read_camera_mask(path, camera) for path in (picture.mask, picture.moving_mask) if path is not None]
        return np.all([np.ones((camera.height, camera.width), bool), *masks], axis=0)

    def _lidar(
        self, picture: RecordedPicture, full: Camera, image: UInt8[np.ndarray, "h w 3"]
    ) -> tuple[Float[np.ndarray, "h w"] | None, PointCloud | None]:
        """LiDAR's map, and the points that it holds."""
        camera = full.downscaled(self._options.downscale)
        camera_to_world = self._recording.pose(picture)
        if picture.depth is not None:
            distance_m = downscale_distance(read_depth(picture.depth, full), self._options.downscale)
            points = torch.from_numpy(rays(camera).directions * distance_m[..., None])
            index = torch.where(
                torch.from_numpy(distance_m) > 0, torch.arange(distance_m.size).view(distance_m.shape), -1
            )
            in_camera = points.reshape(-1, 3).double()
        elif "lidar" in self.layers:
            hides = not self._options.raw_lidar
            around = self._store.around(picture.frame, picture.time_s, camera_to_world, hide=hides)
            in_camera = transform_points(torch.from_numpy(np.linalg.inv(camera_to_world)), around.points_m)
            seen = project_points(
                in_camera.float(),
                camera,
                spacing_m=around.spacing_m if hides else None,
                age_s=around.age_s,
                only_hides=around.only_hides,
            )
            distance_m, index = seen.distance_m.numpy(), seen.point_index
            # what moved is in the picture, but no part of the cloud; -1, no point, is the one put at the end
            moved = torch.cat([around.moved, around.moved.new_zeros(1)])
            index = torch.where(moved[index], -1, index)
        else:
            return None, None
        has_lidar = distance_m[self._usable[picture.camera]] > 0
        with self._lock:
            self._coverage[picture.camera].append(float(has_lidar.mean()))
            if not has_lidar.any():
                self._without.append(f"{picture.frame} of {picture.camera}")
        return distance_m, _cloud(index, in_camera, camera_to_world, image)

    def _beams(self, picture: RecordedPicture, full: Camera) -> Float[np.ndarray, "h w"]:
        """The LiDAR points that are held out of everything, as far as nothing hides them."""
        camera_to_world = self._recording.pose(picture)
        around = self._store.around(picture.frame, picture.time_s, camera_to_world)
        beams = self._store.beams(picture.frame, picture.time_s)
        points_m = torch.cat((around.points_m, beams))
        seen = project_points(
            transform_points(torch.from_numpy(np.linalg.inv(camera_to_world)), points_m).float(),
            full.downscaled(self._options.downscale),
            spacing_m=torch.cat((around.spacing_m, torch.zeros(len(beams)))),
            age_s=torch.cat((around.age_s, torch.zeros(len(beams)))),
            only_hides=torch.arange(len(points_m)) < len(around.points_m),
        )
        return seen.distance_m.numpy()

    def _mono(
        self,
        picture: RecordedPicture,
        full: Camera,
        image: UInt8[np.ndarray, "h2 w2 3"],
        lidar: Float[np.ndarray, "h2 w2"] | None,
    ) -> DistanceMap:
        """The monocular map, without the sky."""
        assert picture.mono is not None
        factor = self._options.downscale
        whole = read_distance_png(picture.mono)
        if not whole.any():
            raise InputError(
                f"{picture.mono}: its monocular map contains no distance. Expected 16-bit counts of 1/256 m along "
                "the ray. Networks give every picture a depth, so its export has failed: make the map "
                "again."
            )
        if not self._options.sky:
            return load_distance(picture.mono, factor)
        mono = downscale_distance(whole, factor)
        up = np.linalg.inv(self._recording.pose(picture))[:3, 2]
        lidar = np.zeros(mono.shape, np.float32) if lidar is None else lidar
        sky = find_sky(image, self._usable[picture.camera], up, full.downscaled(factor), lidar, mono)
        return np.where(sky, 0, mono).astype(np.float32)

    def notices(self) -> list[str]:
        """What the user should know of the maps that were made now."""
        found = self._store.notices()
        if "lidar" not in self.layers:
            prior = (
                "the prior is made of monocular maps only, and nothing checks their scale"
                if "mono" in self.layers
                else "the prior is made of distances from motion only, where there are any"
                if self._options.motion
                else "no ray has a prior, and training equals plain nerfacto"
            )
            found.append(
                f"The drive has neither LiDAR nor depth maps: {prior}. Name its scans or depth maps in the "
                "description of the drive, or give metric monocular maps with --mono."
            )
        if self._coverage:
            shares = ", ".join(f"{np.mean(shares):.1%} of {name}" for name, shares in sorted(self._coverage.items()))
            found.append(f"LiDAR covers this share of the pixels inside the masks: {shares}.")
        if self._without:
            found.append(
                f"No LiDAR point in {len(self._without)} pictures: frames {', '.join(sorted(self._without)[:10])}"
                f"{' …' if len(self._without) > 10 else ''}. If LiDAR's field meets that camera's, check to_vehicle "
                "of both (in metres?) and the clocks."
            )
        return found


def _cloud(
    point_index: Int[Tensor, "height width"],
    in_camera: Float[Tensor, "points 3"],
    camera_to_world: Transform,
    image: UInt8[np.ndarray, "height width 3"],
) -> PointCloud:
    """Gather the points that a picture sees, in the world, with its colours."""
    hit = point_index >= 0
    points = in_camera[point_index[hit]]
    return PointCloud(
        points_m=transform_points(torch.from_numpy(camera_to_world), points).numpy(),
        colours=image[hit.numpy()],
        pixels=torch.nonzero(hit).numpy(),
    )


# ---- what the scene says of itself -----------------------------------------------------------------------------


def _source(recording: Recording, options: ProcessOptions) -> dict[str, Any]:
    """Describe what the scene is made of, without the machine's paths."""
    digest = hashlib.sha256()
    ego_masks = [recorded.ego_mask for recorded in recording.cameras if recorded.ego_mask is not None]
    for path in (*recording.whole_inputs, *ego_masks):
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: no such file; --ego-mask takes a PNG, or a folder with a PNG for each camera "
                f"({', '.join(recorded.name for recorded in recording.cameras)})."
            )
        digest.update(path.read_bytes())
    whole_sha256 = digest.hexdigest()
    # the maps' sizes tell one drive from another; reading them all would take as long as the work
    sized = [path for picture in recording.pictures for path in picture.inputs]
    sized += [sweep.path for sweep in recording.sweeps]
    sized += [path for view in recording.shifted for path in view.inputs]
    for path in sized:
        digest.update(f"{path.parent.name}/{path.name} {path.stat().st_size}\n".encode())
    return {
        **recording.source,
        **{name: getattr(options, name) for name in ("first", "frames", "stride", "downscale", "poses")},
        **({"refine_poses": True} if options.refine_poses else {}),
        "sweeps": options.sweeps,
        "deskew": not options.raw_lidar,
        "occlusion": not options.raw_lidar,
        "ego_mask": options.ego_mask is not None,
        "find_ego": options.find_ego,
        "frame_masks": options.frame_masks is not None,
        **({"find_moving": True} if options.find_moving else {}),
        "mono": options.mono is not None,
        **({"mono_trained_on": "elsewhere"} if any(picture.mono for picture in recording.pictures) else {}),
        **{name: getattr(options, name) for name in ("sky", "theta_max_deg", "holdout_every")},
        **({"holdout_beams": options.holdout_beams} if options.holdout_beams else {}),
        **({"holdout_cameras": sorted(options.holdout_cameras)} if options.holdout_cameras else {}),
        WHOLE: whole_sha256,
        INPUTS: digest.hexdigest(),
        **({INCOMPLETE: True} if recording.left_out else {}),
    }


def _show(report: ProcessReport, console: Console) -> None:
    for name, share in report.mask_share.items():
        fit = report.fits[name]
        fits = f"fits within {fit.rms_px:.4f} px rms, {fit.max_px:.3f} px at most" if fit.max_px >= 5e-4 else "is exact"
        say(console, f"{name}: the camera model for nerfstudio {fits}; the mask keeps {share:.0%} of the picture")
    for notice in (*report.notices, *report.warnings):
        say(console, notice, "yellow")
    for item in report.left_out[:MOST_LISTED]:
        say(console, f"Left out: {item.key}. {item.fault}", "yellow")
    if report.left_out:
        count = len(report.left_out)
        more = f", {count - MOST_LISTED} of them are not listed" if count > MOST_LISTED else ""
        say(console, f"{count} broken or missing files{more}; with --strict the first one is an error.", "yellow")
    done = "" if report.written else "; all of them were there"
    say(console, f"{report.scene}: {report.training} training pictures, {report.held_out} held out{done}")
