"""COLMAP itself: from a recording's pictures to models of camera poses and sparse points, each of its own scale.

It works in a folder of its own, so that an interrupted run resumes where it stopped:

    inputs.json      what the folder was made from; with other inputs it is emptied
    pictures/        links to the pictures, named CAMERA/0000000123.png
    masks/           what of each picture is searched for features
    database.db      COLMAP's features and matches; these three are deleted once the models are there
    pairs.txt        the pairs of pictures being matched
    models/0, 1, …   COLMAP's models in its own format, which its viewer and other tools read
    models.json      their checksum

Lenses are known and stay fixed. The pictures are matched in the order they were taken. COLMAP does not get the rig.
With a rig whose cameras share no view, such as KITTI-360's left and right fisheye, COLMAP starts from a pair of frames.
In a straight drive their scale cannot be seen, and paths come out wrong by 3 to 50 % of their length (synthetic drives,
COLMAP 4.2). Without the rig, the cameras that share no view become a model each, and `colmap_scale` joins them.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64
from rich.console import Console

from edge_depth_nerf.base.console import progress_bars
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import (
    file_stamp,
    read_json,
    write_atomically,
    write_bytes,
    write_json,
    write_mask,
    write_text,
)
from edge_depth_nerf.cameras import Camera, KannalaBrandt, Pinhole, fit_kannala_brandt
from edge_depth_nerf.cameras.transforms import Transform
from edge_depth_nerf.process.feature_masks import FeatureMasks
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.process.recording import Recording

THETA_MAX_DEG = 85.0
"""Features further from the axis are not used: COLMAP's lenses end at 90°, and calibrations are worst at the rim."""

INSTALL = "pip install '.[colmap]'"

_OLDEST = (4, 2)
_RECORD = "inputs.json"
_MODELS_SUM = "models.json"
_VERSION = 2
"""Of what is done with the inputs; raised when results change."""
_NEIGHBOURS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20)
"""How many frames apart the matched pictures are: densely near, and further for a slow vehicle."""
_SHARED_VIEW_DEG = 30.0
"""Cameras whose pictures overlap by at least this much are matched with each other."""
_CHUNK_PICTURES = 16
_CHUNK_PAIRS = 256
"""Features and matches are made in lots: between two of them progress is shown and an interruption is heeded."""
_MIN_TRACK = 3
"""Points that fewer pictures see have distances that are not to be trusted."""
_POSE_POINTS = (30, 15)
"""So many of a model's points a picture must see to get its pose: COLMAP's own number, and one for small pictures.

Two of these often have some forty points in common, of which the next one sees half: by its own number COLMAP then ends
with a model of two pictures, whose points have no distance to be trusted.
"""
_ENOUGH = 0.75
"""Where a smaller share of the pictures gets a pose that way, the second number is tried, too."""
_SEED = 0


@dataclass(frozen=True)
class SparseView:
    """What one picture sees of a model's points."""

    rays: Float64[np.ndarray, "points 3"]
    """Unit directions in the camera's frame, from the features' pixels."""
    distance: Float64[np.ndarray, "points"]
    """From the camera to each point, in the model's unit."""


@dataclass(frozen=True)
class ColmapModel:
    """Poses and points that hang together, in a world and a unit of their own."""

    camera_to_model: dict[int, Transform]
    """Of the registered pictures, by their index in the recording; lengths in the model's unit."""
    views: dict[int, SparseView]
    """What each of them sees."""
    points: int
    """How many points there are."""
    error_px: float
    """Mean distance between a point's projection and its feature."""

    def placed(self) -> set[int]:
        """Pictures that see points whose distance is to be trusted; none in a model of two pictures."""
        return {index for index, view in self.views.items() if len(view.distance)}


@dataclass(frozen=True)
class ColmapLens:
    """A camera as COLMAP has it."""

    model: str
    parameters: tuple[float, ...]
    theta_max_rad: float
    """Up to which it is used."""


@functools.lru_cache(maxsize=64)
def colmap_lens(camera: Camera, theta_max_rad: float = math.radians(THETA_MAX_DEG)) -> ColmapLens:
    """Express a camera in one of COLMAP's models, whose pixel centres are at +0.5 as well.

    COLMAP's THIN_PRISM_FISHEYE without its prism is `KannalaBrandt`, tangential terms included, and its FULL_OPENCV
    without a denominator is `Pinhole`; any other lens is replaced by the nearest Kannala-Brandt one.

    Raises:
        InputError: no Kannala-Brandt camera comes near.
    """
    limit = min(theta_max_rad, camera.theta_max_rad)
    if isinstance(camera, Pinhole) and not camera.k4:
        k = camera
        parameters = (k.fx, k.fy, k.cx, k.cy, k.k1, k.k2, k.p1, k.p2, k.k3, 0.0, 0.0, 0.0)
        return ColmapLens("FULL_OPENCV", parameters, limit)
    k = camera if isinstance(camera, KannalaBrandt) else fit_kannala_brandt(camera, limit).camera
    parameters = (k.fx, k.fy, k.cx, k.cy, k.k1, k.k2, k.p1, k.p2, k.k3, k.k4, 0.0, 0.0)
    return ColmapLens("THIN_PRISM_FISHEYE", parameters, limit)


def colmap_lenses(recording: Recording, options: ProcessOptions) -> dict[str, ColmapLens]:
    """A recording's cameras in COLMAP's models, by name.

    Raises:
        InputError: one has no counterpart.
    """
    limit = math.radians(min(options.theta_max_deg, THETA_MAX_DEG))
    return {camera.name: colmap_lens(camera.camera, limit) for camera in recording.cameras}


def import_pycolmap(option: str = "--poses colmap") -> Any:
    """The module pycolmap, for an option that needs it.

    Raises:
        InputError: it is not installed, or too old.
    """
    try:
        import pycolmap
    except ImportError as error:
        recorded = "use the poses of the recording (--poses recorded)"
        without = "leave it out (--no-refine-poses)" if "refine" in option else recorded
        raise InputError(
            f"{option}: needs COLMAP's Python package, which cannot be imported ({error}). Install it with "
            f"`{INSTALL}`, or {without}."
        ) from error
    if tuple(int(number) for number in pycolmap.__version__.split(".")[:2]) < _OLDEST:
        raise InputError(
            f"{option}: pycolmap {pycolmap.__version__} is too old, expected 4.2 or newer. Install it with `{INSTALL}`."
        )
    return pycolmap


def check_folder(folder: Path) -> None:
    """Check that a folder to work in is new, or ours.

    Raises:
        InputError: it holds something else.
    """
    if folder.is_dir() and any(folder.iterdir()) and not (folder / _RECORD).is_file():
        raise InputError(
            f"{folder}: this folder is for COLMAP's features and models, but contains other files. Move them, or "
            "choose another --output."
        )


def find_models(recording: Recording, options: ProcessOptions, folder: Path, console: Console) -> list[ColmapModel]:
    """Let COLMAP find the poses of three pictures or more, in the order of their frames, in a folder of its own.

    Returns:
        The models, that with the most pictures first; none if no two pictures could be related.

    Raises:
        InputError: pycolmap is missing, or `folder` holds something else.
    """
    run = _Run(import_pycolmap(), recording, options, folder, console)
    run.prepare()
    if not run.has_models():
        run.extract()
        run.match()
        run.map()
    # features and descriptors of a long drive take gigabytes
    run.database.unlink(missing_ok=True)
    for left in (run.masks, run.pictures):
        shutil.rmtree(left, ignore_errors=True)
    return run.read_models(run.models)


def shared_views(recording: Recording, lenses: Mapping[str, ColmapLens]) -> set[tuple[str, str]]:
    """Pairs of cameras, in the recording's order, whose pictures overlap enough to be matched with each other."""
    shared = set()
    cameras = recording.cameras
    for index, first in enumerate(cameras):
        for second in cameras[index + 1 :]:
            between = float(first.to_vehicle[:3, 2] @ second.to_vehicle[:3, 2])
            reach = sum(_reach_rad(c.camera, lenses[c.name].theta_max_rad) for c in (first, second))
            if reach - math.acos(np.clip(between, -1, 1)) >= math.radians(_SHARED_VIEW_DEG):
                shared.add((first.name, second.name))
    return shared


def pairs_to_match(
    recording: Recording, lenses: Mapping[str, ColmapLens], apart: Sequence[int], across: Sequence[int]
) -> list[tuple[int, int]]:
    """Pictures to match, as indices, in the order of the drive.

    Args:
        recording: whose pictures.
        lenses: of its cameras.
        apart: how many frames lie between two pictures of one camera; 1 is the next.
        across: likewise between those of two cameras that share views.
    """
    pictures, shared = recording.pictures, shared_views(recording, lenses)
    cameras = dict.fromkeys(picture.camera for picture in pictures)
    number_of = {frame: number for number, frame in enumerate(sorted({p.frame for p in pictures}))}
    seen = {(p.camera, number_of[p.frame]): index for index, p in enumerate(pictures)}
    pairs = []
    for (camera, number), index in sorted(seen.items(), key=lambda item: item[0][1]):
        for other in cameras:
            related = {(camera, other), (other, camera)} & shared
            for offset in apart if other == camera else across if related else ():
                later = seen.get((other, number + offset))
                if later is not None and (offset > 0 or later > index):
                    pairs.append((index, later))
    return pairs


class _Run:
    """One folder's work."""

    def __init__(
        self, pycolmap: Any, recording: Recording, options: ProcessOptions, folder: Path, console: Console
    ) -> None:
        self.pycolmap = pycolmap
        self.recording = recording
        self.options = options
        self.folder = folder
        self.console = console
        self.database = folder / "database.db"
        self.masks = folder / "masks"
        self.models = folder / "models"
        self.lenses = colmap_lenses(recording, options)
        limits_rad = {name: lens.theta_max_rad for name, lens in self.lenses.items()}
        self.feature_masks = FeatureMasks(recording, options, limits_rad)
        # COLMAP names pictures by their paths below one folder, and a space ends a name
        self.pictures = folder / "pictures"
        self.names = [f"{p.camera}/{p.frame:010d}{p.path.suffix.lower()}" for p in recording.pictures]
        pycolmap.logging.minloglevel = 3  # what it says is replaced by progress bars and our own errors
        pycolmap.set_random_seed(_SEED)

    def prepare(self) -> None:
        """Empty the folder unless it was made from the same inputs."""
        record = self.folder / _RECORD
        inputs = {"kind": "COLMAP's work for edge-depth-nerf", "digest": self._digest()}
        if record.is_file() and read_json(record) == inputs:
            return
        check_folder(self.folder)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        write_json(record, inputs)

    def _digest(self) -> str:
        """Of everything the models depend on, pictures and masks by size and time of change."""
        cameras = [
            [c.name, c.ego_mask and file_stamp(c.ego_mask), dataclasses.asdict(self.lenses[c.name])]
            for c in self.recording.cameras
        ]
        pictures = [
            [p.camera, p.frame, *(path and file_stamp(path) for path in (p.path, p.mask))]
            for p in self.recording.pictures
        ]
        related = [_NEIGHBOURS, sorted(shared_views(self.recording, self.lenses))]
        content = json.dumps([_VERSION, self.pycolmap.__version__, cameras, pictures, related])
        return hashlib.sha256(content.encode()).hexdigest()

    def _error_px(self) -> float:
        """How far a feature may be from where geometry puts it: 0.3° on the axis, within 1 px and COLMAP's own 4."""
        focal_px = np.mean([sum(lens.parameters[:2]) / 2 for lens in self.lenses.values()])
        return float(np.clip(math.radians(0.3) * focal_px, 1.0, 4.0))

    def extract(self) -> None:
        """Find the features that the masks leave."""
        if not self.database.is_file():
            write_atomically(self.database, self._write_database)
        colmap = self.pycolmap
        reader = colmap.ImageReaderOptions()
        reader.mask_path = self.masks
        with progress_bars(self.console, counted=True) as progress:
            task = progress.add_task("Finding features", total=len(self.names))
            for chunk in _chunks(range(len(self.names)), _CHUNK_PICTURES):
                for index in chunk:
                    self._write_mask(index)
                    self._link_picture(index)
                colmap.extract_features(
                    self.database,
                    self.pictures,
                    image_names=[self.names[index] for index in chunk],
                    reader_options=reader,
                    device=colmap.Device.cpu,
                )
                progress.advance(task, len(chunk))

    def _write_database(self, path: Path) -> None:
        """Cameras and pictures, each camera a rig of its own: COLMAP's words for "nothing known of one another"."""
        colmap = self.pycolmap
        database = colmap.Database.open(path)
        cameras = {}
        for number, camera in enumerate(self.recording.cameras, start=1):
            lens = self.lenses[camera.name]
            cameras[camera.name] = number
            entry = colmap.Camera(
                camera_id=number,
                model=lens.model,
                width=camera.camera.width,
                height=camera.camera.height,
                params=list(lens.parameters),
                has_prior_focal_length=True,
            )
            database.write_camera(entry, use_camera_id=True)
            rig = colmap.Rig(rig_id=number)
            rig.add_ref_sensor(entry.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for index, (name, picture) in enumerate(zip(self.names, self.recording.pictures, strict=True)):
            image = colmap.Image(name=name, camera_id=cameras[picture.camera], image_id=index + 1)
            frame = colmap.Frame(frame_id=index + 1, rig_id=cameras[picture.camera])
            frame.add_data_id(image.data_id)
            database.write_image(image, use_image_id=True)
            database.write_frame(frame, use_frame_id=True)
        database.close()

    def _write_mask(self, index: int) -> None:
        target = self.masks / f"{self.names[index]}.png"
        if not target.is_file():
            mask = self.feature_masks.of(self.recording.pictures[index])
            # a feature at the edge of a mask looks at what is masked
            reach = 1 + 2 * max(1, round(mask.shape[1] / 350))
            write_mask(target, cv2.erode(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0)

    def _link_picture(self, index: int) -> None:
        source, target = self.recording.pictures[index].path.absolute(), self.pictures / self.names[index]
        if not target.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                target.symlink_to(source)
            except OSError:
                # not every system and disk has links
                write_bytes(target, source.read_bytes())

    def match(self) -> None:
        """Match the pictures that were taken shortly after one another, and check each pair's geometry."""
        colmap = self.pycolmap
        geometry = colmap.TwoViewGeometryOptions()
        geometry.ransac.max_error = self._error_px()
        geometry.ransac.random_seed = _SEED
        # what stays where it is in the picture is the vehicle, or dirt on the lens
        geometry.filter_stationary_matches = True
        geometry.stationary_matches_max_error = 1.0
        pairing = colmap.ImportedPairingOptions()
        pairing.match_list_path = self.folder / "pairs.txt"
        pairs = pairs_to_match(self.recording, self.lenses, _NEIGHBOURS, (0, *_NEIGHBOURS))
        with progress_bars(self.console, counted=True) as progress:
            task = progress.add_task("Matching pictures", total=len(pairs))
            for chunk in _chunks(pairs, _CHUNK_PAIRS):
                write_text(pairing.match_list_path, "".join(f"{self.names[a]} {self.names[b]}\n" for a, b in chunk))
                colmap.match_image_pairs(
                    self.database, pairing_options=pairing, verification_options=geometry, device=colmap.Device.cpu
                )
                progress.advance(task, len(chunk))

    def map(self) -> None:
        """Find poses and points with fixed lenses; by the number of points that gives more pictures their pose."""
        tried: dict[Path, int] = {}
        for pose_points in _POSE_POINTS:
            made = self._map(pose_points)
            tried[made] = len({index for model in self.read_models(made) for index in model.placed()})
            if tried[made] >= _ENOUGH * len(self.names):
                break
        best = max(tried, key=lambda made: tried[made])
        write_json(self.folder / _MODELS_SUM, {"sha256": sum_of_files(best)})
        shutil.rmtree(self.models, ignore_errors=True)
        os.replace(best, self.models)
        for unfinished in self.folder.glob("models.[0-9]*"):
            shutil.rmtree(unfinished, ignore_errors=True)

    def _map(self, pose_points: int) -> Path:
        """Run COLMAP's mapper; gives the folder with what it wrote."""
        colmap = self.pycolmap
        error_px = self._error_px()
        options = colmap.IncrementalPipelineOptions()
        for seeded in (options, options.mapper, options.triangulation):
            seeded.random_seed = _SEED
        # threads would add numbers up in another order each time
        options.num_threads = 1
        options.extract_colors = False
        options.ba_refine_focal_length = False
        options.ba_refine_principal_point = False
        options.ba_refine_extra_params = False
        options.min_model_size = 3
        options.mapper.init_max_error = error_px
        options.mapper.filter_max_reproj_error = error_px
        options.mapper.abs_pose_max_error = 3 * error_px
        options.mapper.abs_pose_min_num_inliers = pose_points
        # a camera that looks ahead, too, may start a model
        options.mapper.init_max_forward_motion = 1.0
        options.mapper.init_min_tri_angle = 8.0
        options.triangulation.merge_max_reproj_error = error_px
        options.triangulation.complete_max_reproj_error = error_px
        unfinished = self.folder / f"models.{pose_points}"
        shutil.rmtree(unfinished, ignore_errors=True)
        unfinished.mkdir()
        with progress_bars(self.console, counted=True) as progress:
            task, total = progress.add_task("Finding poses", total=len(self.names)), len(self.names)

            def registered(pictures: int) -> None:
                # a picture may be in two models
                progress.update(task, completed=min(progress.tasks[0].completed + pictures, total))

            colmap.incremental_mapping(
                self.database,
                self.pictures,
                unfinished,
                options,
                initial_image_pair_callback=lambda: registered(2),
                next_image_callback=lambda: registered(1),
            )
        return unfinished

    def has_models(self) -> bool:
        """Whether models exist and are unchanged: COLMAP's reader ends the whole process at a damaged one."""
        record = self.folder / _MODELS_SUM
        if not (self.models.is_dir() and record.is_file()):
            return False
        return read_json(record) == {"sha256": sum_of_files(self.models)}

    def read_models(self, models: Path) -> list[ColmapModel]:
        """The models of a folder, that with the most pictures first.

        Raises:
            InputError: a model in the folder is broken, or of other pictures.
        """
        found = []
        for folder in sorted(models.iterdir()):
            try:
                found.append(self._read_model(folder))
            except Exception as error:  # COLMAP raises whatever its readers meet
                raise InputError(
                    f"{folder}: cannot be read as a COLMAP model of these pictures ({type(error).__name__}: {error}). "
                    f"Delete {models}; the same command then makes it again."
                ) from error
        return sorted(found, key=lambda model: -len(model.camera_to_model))

    def _read_model(self, folder: Path) -> ColmapModel:
        index_of = {name: index for index, name in enumerate(self.names)}
        model = self.pycolmap.Reconstruction(folder)
        poses, views = {}, {}
        for image in model.images.values():
            if not image.has_pose:
                continue
            model_to_camera = np.vstack((image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]))
            seen = [(point.xy, model.point3D(point.point3D_id)) for point in image.get_observation_points2D()]
            seen = [(pixel, point) for pixel, point in seen if point.track.length() >= _MIN_TRACK]
            pixels = np.array([pixel for pixel, _ in seen]).reshape(-1, 2)
            points = np.array([point.xyz for _, point in seen]).reshape(-1, 3)
            in_camera = points @ model_to_camera[:3, :3].T + model_to_camera[:3, 3]
            index = index_of[image.name]
            poses[index] = np.linalg.inv(model_to_camera)
            views[index] = SparseView(
                np.array(image.camera.cam_ray_from_img(pixels)).reshape(-1, 3), np.linalg.norm(in_camera, axis=-1)
            )
        if not all(np.isfinite(pose).all() for pose in poses.values()):
            raise ValueError("a pose is not finite")
        return ColmapModel(poses, views, model.num_points3D(), model.compute_mean_reprojection_error())


def sum_of_files(folder: Path) -> str:
    """What tells the files of a folder, names and bytes, from others."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        digest.update(json.dumps([path.relative_to(folder).as_posix(), len(content)]).encode() + content)
    return digest.hexdigest()


def _chunks(items: Sequence, size: int) -> Iterator[Sequence]:
    for start in range(0, len(items), size):
        yield items[start : start + size]


def _reach_rad(camera: Camera, theta_max_rad: float) -> float:
    """The largest angle from the axis, up to a limit, that the middle row of the picture sees."""
    rays, valid = camera.unproject(camera.pixel_centres()[camera.height // 2])
    inside = valid & (rays[..., 2] >= math.cos(theta_max_rad))
    return math.acos(float(rays[..., 2][inside].min())) if inside.any() else 0.0
