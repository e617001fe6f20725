"""A scene folder on disk: its pictures with their lenses, poses, maps and frame numbers.

Reads this project's scenes and other people's nerfstudio scenes, without nerfstudio, whose import takes longer than
most commands. A map that is missing is no error here, a file that is named and missing is one. Maps are H×W,
distances metres along the ray with 0 = none, masks True = use. Lengths are the scene's, which are metres in scenes of
this project.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, UInt8
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError, found_in
from edge_depth_nerf.base.files import (
    DISTANCE_STEPS_PER_METRE,
    read_distance_png,
    read_image,
    read_json,
    read_mask,
    read_npy,
)
from edge_depth_nerf.cameras import KannalaBrandt, Pinhole
from edge_depth_nerf.cameras.rays import Rays, distance_from_z_depth, rays
from edge_depth_nerf.cameras.transforms import Transform, opencv_to_opengl, rigid
from edge_depth_nerf.lidar.scans import read_cloud
from edge_depth_nerf.scene.format import (
    CHECKS,
    DEPTH_KEY,
    DISTORTION,
    DISTORTION_PARAMS,
    INTRINSICS,
    LAYERS,
    TRANSFORMS,
    DepthKind,
    number_of,
    path_keys,
    pose_of,
    read_transforms,
)

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
FISHEYE_MODEL = "OPENCV_FISHEYE"
_IN_METRES = ("distance", "sigma", "check")


@dataclass(frozen=True)
class ScenePicture:
    """One picture of the scene."""

    name: str
    """Its file_path in transforms.json."""
    camera: str
    """The frame's own word, or the folder of its pictures."""
    frame: int
    """Number of the frame in the drive; in other people's scenes its place in the order of names."""
    lens: KannalaBrandt | Pinhole
    """The camera that nerfstudio sees."""
    position_m: Float64[np.ndarray, "3"]
    """Centre of the camera in the scene."""
    rotation: Float64[np.ndarray, "3 3"]
    """Camera axes (OpenGL: x right, y up, z backward) in the scene, as columns."""
    held_out: bool
    """Whether transforms.json keeps it from training."""
    timestamp_s: float | None
    """Seconds, where the scene knows them."""
    files: dict[str, Path]
    """File of each layer of `LAYERS` that it has."""

    def __deepcopy__(self, memo: dict[int, Any]) -> ScenePicture:
        # nothing in it changes, and nerfstudio's dataset copies all that it is given
        return self

    @property
    def pose(self) -> Transform:
        """Camera (OpenCV: x right, y down, z forward) to scene."""
        return opencv_to_opengl(rigid(self.rotation, self.position_m))

    def pixels_of(self, points_m: Float[np.ndarray, "points 3"]) -> tuple[NDArray, NDArray, NDArray]:
        """Numbers of the points in the scene that lie in the picture, hidden ones included; their rows and columns."""
        in_camera = (points_m - self.position_m) @ self.rotation * np.array([1.0, -1.0, -1.0])
        pixels, valid = self.lens.project(torch.from_numpy(in_camera))
        seen = np.flatnonzero((valid & self.lens.inside(pixels)).numpy())
        column, row = pixels.numpy()[seen].astype(int).T
        return seen, row, column

    @property
    def looks_along(self) -> Float64[np.ndarray, "3"]:
        """Unit vector of the optical axis in the scene."""
        return -self.rotation[:, 2]

    @property
    def up_in_camera(self) -> Float64[np.ndarray, "3"]:
        """The scene's upward direction, z, in the camera's axes (OpenCV)."""
        return self.rotation[2] * np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PictureMaps:
    """All that one picture has, at its own size."""

    rgb: UInt8[np.ndarray, "h w 3"]
    lens: Bool[np.ndarray, "h w"]
    """Where the lens model gives a ray within the scene's theta_max_deg."""
    usable: Bool[np.ndarray, "h w"]
    """The mask within the lens: what training draws rays from."""
    distances_m: dict[str, Float32[np.ndarray, "h w"]]
    """Of each distance layer that the picture has: LiDAR, monocular, true distance; and of the standard deviation of
    those from motion."""

    @property
    def lidar_m(self) -> Float32[np.ndarray, "h w"] | None:
        """LiDAR distance."""
        return self.distances_m.get("lidar")

    @property
    def mono_m(self) -> Float32[np.ndarray, "h w"] | None:
        """Monocular distance."""
        return self.distances_m.get("mono")

    @property
    def truth_m(self) -> Float32[np.ndarray, "h w"] | None:
        """True distance."""
        return self.distances_m.get("truth_distance")


@dataclass(frozen=True)
class SceneFolder:
    """A scene folder, checked; maps are read when asked for."""

    path: Path
    """Its transforms.json."""
    camera_model: str
    """nerfstudio's name."""
    own: bool
    """Whether it has this project's keys: then its lengths are metres."""
    meta: dict[str, Any]
    """transforms.json without its frames."""
    theta_max_rad: float
    """The angle from the axis beyond which the scene uses no ray."""
    crop_radius_px: float | None
    """Of a fisheye scene of nerfstudio's: the circle around each picture's middle beyond which no pixel is used."""
    lidar_metres_per_count: float
    """Unit of the LiDAR files."""
    lidar_is_z_depth: bool
    """Whether they hold the coordinate along the axis, as in other people's pinhole scenes."""
    pictures: tuple[ScenePicture, ...]
    """By camera, then by frame."""
    split_known: bool
    """Whether transforms.json says which pictures are for training."""
    incomplete: dict[str, int]
    """Keys of transforms.json that only some frames have, with how many."""
    points_path: Path | None
    """The point cloud it names."""

    def __deepcopy__(self, memo: dict[int, Any]) -> SceneFolder:
        # as its pictures: a long drive's would be copied twice
        return self

    @property
    def folder(self) -> Path:
        """Where its files are relative to."""
        return self.path.parent

    @property
    def world_offset_m(self) -> Float64[np.ndarray, "3"]:
        """The scene's origin in the recording's world."""
        return np.array(self.meta.get("world_offset_m", [0.0, 0.0, 0.0]), np.float64)

    def cameras(self) -> dict[str, tuple[ScenePicture, ...]]:
        """The pictures of each camera, in order of their frames."""
        names = dict.fromkeys(picture.camera for picture in self.pictures)
        return {name: tuple(picture for picture in self.pictures if picture.camera == name) for name in names}

    def recorded(self, table: str, camera: str) -> dict[str, Any]:
        """Return a camera's entry in a table of transforms.json; empty in scenes of other makers."""
        found = self.meta.get(table)
        found = found.get(camera) if isinstance(found, dict) else None
        return found if isinstance(found, dict) else {}

    def held_out_cameras(self) -> set[str]:
        """The cameras none of whose pictures is for training; other people's scenes have folders, not cameras."""
        every = self.cameras().items() if self.own and self.split_known else ()
        return {name for name, pictures in every if all(each.held_out for each in pictures)}

    def checks(self) -> dict[str, Any]:
        """What `process` found when it held LiDAR, poses and masks against the pictures; empty if it did not."""
        path = self.folder / CHECKS
        content = read_json(path) if path.is_file() else {}
        return content if isinstance(content, dict) else {}

    def frames(self) -> list[int]:
        """The numbers of all frames that any camera has, in order."""
        return sorted({picture.frame for picture in self.pictures})

    def has(self, layer: str) -> bool:
        """Whether any picture has this layer."""
        return any(layer in picture.files for picture in self.pictures)

    def rays(self, picture: ScenePicture) -> Rays:
        """The rays of a picture's pixels, within the scene's theta_max_deg."""
        return rays(picture.lens, self.theta_max_rad)

    def rgb(self, picture: ScenePicture, layer: str = "image") -> UInt8[np.ndarray, "h w 3"]:
        """Read a picture, the recorded one or one of another layer of pictures.

        Raises:
            InputError: it cannot be decoded, or has another size than the camera.
        """
        return self._checked(picture, layer, read_image(picture.files[layer]))

    def usable(self, picture: ScenePicture) -> Bool[np.ndarray, "h w"]:
        """Where a picture may be used: the scene's mask, as far as the lens model gives a ray.

        Raises:
            InputError: the mask cannot be decoded, or has another size than the camera.
        """
        # the size in transforms.json may be anything, that of a decoded mask is in memory already
        mask = self.mask(picture)
        usable = self.rays(picture).within.copy()
        if self.crop_radius_px is not None:
            row, column = np.indices(usable.shape) + 0.5
            height, width = usable.shape
            usable &= np.hypot(column - width / 2, row - height / 2) <= self.crop_radius_px
        return usable if mask is None else mask & usable

    def mask(self, picture: ScenePicture) -> Bool[np.ndarray, "h w"] | None:
        """Read a picture's mask, True = use; None if it has none. Raises as `usable`."""
        return self._checked(picture, "mask", read_mask(picture.files["mask"])) if "mask" in picture.files else None

    def distance_m(self, picture: ScenePicture, layer: str) -> Float32[np.ndarray, "h w"] | None:
        """Read a map of a distance layer: metres along the ray, 0 = none; None if the picture has none.

        Raises:
            InputError: it cannot be decoded, or has another size than the camera.
        """
        path = picture.files.get(layer)
        if path is None:
            return None
        metres_per_count = self.lidar_metres_per_count if layer == "lidar" else 1 / DISTANCE_STEPS_PER_METRE
        if path.suffix == ".npy":
            counts = read_npy(path)
            counts = counts[..., 0] if counts.ndim == 3 and counts.shape[2] == 1 else counts
            metres = counts.astype(np.float32) * np.float32(metres_per_count)
        else:
            metres = read_distance_png(path, metres_per_count)
        metres = self._checked(picture, layer, metres)
        if path.suffix == ".npy":
            # other tools write infinity, NaN or -1 for none
            metres = np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
        if layer == "lidar" and self.lidar_is_z_depth:
            return distance_from_z_depth(metres, self.rays(picture))
        return metres

    def lidar_m(self, picture: ScenePicture) -> Float32[np.ndarray, "h w"]:
        """Read a picture's LiDAR map: metres along the ray, 0 = none; all 0 if it has none.

        Raises:
            InputError: it cannot be decoded, or has another size than the camera.
        """
        found = self.distance_m(picture, "lidar")
        return np.zeros((picture.lens.height, picture.lens.width), np.float32) if found is None else found

    def maps(self, picture: ScenePicture) -> PictureMaps:
        """Read all that a picture has.

        Raises:
            InputError: a file cannot be decoded, or has another size than the camera.
        """
        rgb = self.rgb(picture)
        usable = self.usable(picture)
        found = {layer: self.distance_m(picture, layer) for layer in picture.files if LAYERS[layer].kind in _IN_METRES}
        distances_m = {layer: metres for layer, metres in found.items() if metres is not None}
        return PictureMaps(rgb, self.rays(picture).within, usable, distances_m)

    def _checked(self, picture: ScenePicture, layer: str, pixels: NDArray) -> NDArray:
        """The pixels, if they have the size of their camera."""
        width, height = picture.lens.width, picture.lens.height
        if pixels.shape[:2] != (height, width) or pixels.ndim > 3:
            raise InputError(
                f"{picture.files[layer]}: is {'×'.join(map(str, pixels.shape[1::-1]))} pixels (width × height), "
                f"but {self.path} gives the camera of {picture.name} {width}×{height}. Pictures, masks and "
                "distance maps of a frame must have one size; make the file again at that size."
            )
        return pixels

    def points_m(self) -> Float64[np.ndarray, "points 3"] | None:
        """Read the points of the point cloud, if there is one.

        Raises:
            InputError: it cannot be read.
        """
        cloud = self.cloud()
        return None if cloud is None else cloud[0]

    def cloud(self) -> tuple[Float64[np.ndarray, "points 3"], UInt8[np.ndarray, "points 3"] | None] | None:
        """Read the point cloud, if there is one: points in the scene (metres), and their colours where it has any.

        Raises:
            InputError: it cannot be read.
        """
        if self.points_path is None:
            return None
        try:
            points, colours = read_cloud(self.points_path)
        except InputError as error:
            raise InputError(
                f"{error} It cannot be read as a PLY point cloud: make the file again, or remove ply_file_path from "
                f"{self.path}."
            ) from None
        known = np.isfinite(points).all(1)
        return points[known], None if colours is None else colours[known]


def read_scene(scene: Path) -> SceneFolder:
    """Read transforms.json, itself given or by its folder, and check what it says.

    Raises:
        FileNotFoundError: no scene there.
        InputError: the file is broken, or names a file that is missing.
    """
    path = scene if scene.suffix == ".json" else scene / TRANSFORMS
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: no such file. A scene folder has a transforms.json; `edge-depth-nerf process` makes one from a "
            "raw drive."
        )
    found = scene_of(read_transforms(path), path)
    _check_files(path, found.pictures, found.points_path)
    return found


def scene_of(
    meta: dict[str, Any], path: Path, depth_kind: DepthKind = "auto", depth_metres_per_count: float | None = None
) -> SceneFolder:
    """The scene that a transforms.json describes; whether its files are there is not looked at.

    Args:
        meta: what `read_transforms` gave.
        path: of the file.
        depth_kind: what files under depth_file_path hold. auto: distance along the ray in scenes of this project and
            in fisheye scenes, z_depth (nerfstudio's convention) in other people's pinhole scenes.
        depth_metres_per_count: unit of these files; None: as transforms.json says, else nerfstudio's 0.001.

    Raises:
        InputError: a camera model that is not known, or a value that cannot be used.
    """
    frames = meta["frames"]
    model = meta.get("camera_model", "PINHOLE")
    if model not in (*PINHOLE_MODELS, FISHEYE_MODEL):
        raise InputError(
            f"{path}: camera_model is {model!r}; expected one of {', '.join((*PINHOLE_MODELS, FISHEYE_MODEL))}. "
            "Convert the cameras, for example with `edge-depth-nerf process`."
        )
    own_lidar = LAYERS["lidar"].key in frames[0]
    # monocular maps say nothing about that: `estimate-depth` puts them into other people's scenes, too
    own = own_lidar or "world_offset_m" in meta
    held_out, split_known = _held_out(meta)
    numbers = _frame_numbers(frames)
    pictures = [
        _picture(meta, frame, path, model, numbers[frame["file_path"]], frame["file_path"] in held_out)
        for frame in frames
    ]
    given = Counter(key for frame in frames for key in path_keys() if key in frame)
    if depth_metres_per_count is None:
        depth_metres_per_count = float(meta.get("depth_unit_scale_factor", 1e-3))
    if depth_kind == "auto":
        depth_kind = "distance" if own or model == FISHEYE_MODEL else "z_depth"
    return SceneFolder(
        path=path,
        camera_model=model,
        own=own,
        meta={key: value for key, value in meta.items() if key != "frames"},
        theta_max_rad=math.radians(meta.get("theta_max_deg", 180.0)),
        crop_radius_px=meta.get("fisheye_crop_radius") if model == FISHEYE_MODEL else None,
        # of this project's own key both are known
        lidar_metres_per_count=1 / DISTANCE_STEPS_PER_METRE if own_lidar else depth_metres_per_count,
        lidar_is_z_depth=not own_lidar and depth_kind == "z_depth",
        pictures=tuple(sorted(pictures, key=lambda picture: (picture.camera, picture.frame))),
        split_known=split_known,
        incomplete={key: count for key, count in given.items() if count < len(frames)},
        points_path=path.parent / meta["ply_file_path"] if meta.get("ply_file_path") else None,
    )


def _picture(
    meta: dict[str, Any], frame: dict[str, Any], path: Path, model: str, number: int, held_out: bool
) -> ScenePicture:
    name, time = frame["file_path"], frame.get("timestamp_s")
    pose = pose_of(frame, f"{path}: {name}")
    return ScenePicture(
        name=name,
        camera=_camera_name(frame),
        frame=number,
        lens=_lens(meta, frame, model, path),
        position_m=pose[:3, 3],
        rotation=pose[:3, :3],
        held_out=held_out,
        timestamp_s=None if time is None else float(time),
        # a scene has one kind of LiDAR maps: its first frame's
        files=_files(frame, path.parent, LAYERS["lidar"].key in meta["frames"][0]),
    )


def _held_out(meta: dict[str, Any]) -> tuple[set[str], bool]:
    """Names that are kept from training, and whether the scene has a split at all."""
    train, val, test = ({*meta.get(f"{split}_filenames", ())} for split in ("train", "val", "test"))
    if train:
        # what no list names is not trained on either
        return {frame["file_path"] for frame in meta["frames"]} - train, True
    return val | test, bool(val | test)


def _camera_name(frame: dict[str, Any]) -> str:
    folder = Path(frame["file_path"]).parent
    return frame.get("camera", folder.as_posix() if folder.name else "camera")


def _frame_numbers(frames: list[dict[str, Any]]) -> dict[str, int]:
    """The frame number of each picture: the given one, else its place by name, in its folder if all have such names."""
    if all("frame" in frame for frame in frames):
        return {frame["file_path"]: frame["frame"] for frame in frames}
    ordered = sorted(frame["file_path"] for frame in frames)
    folders: dict[Path, list[str]] = {}
    for name in ordered:
        folders.setdefault(Path(name).parent, []).append(name)
    # else folders are no cameras, but a split or whatever
    are_cameras = len({tuple(Path(name).stem for name in names) for names in folders.values()}) == 1
    together = list(folders.values()) if are_cameras else [ordered]
    return {name: number for names in together for number, name in enumerate(names)}


def _lens(meta: dict[str, Any], frame: dict[str, Any], model: str, path: Path) -> KannalaBrandt | Pinhole:
    where = f"{path}: {frame['file_path']}"
    # as nerfstudio's parser: what the scene gives for all its pictures goes first
    size_and_focal = [number_of(meta.get(key, frame.get(key)), f"{where}: {key}") for key in ("w", "h", *INTRINSICS)]
    of_all = any(key in meta for key in ("k1", "k2", "k3", "p1", "p2", DISTORTION_PARAMS))
    given = meta if of_all else frame
    values = given.get(DISTORTION_PARAMS, [given.get(key, 0.0) for key in DISTORTION])
    distortion = dict(zip(DISTORTION, map(float, values), strict=True))
    width, height, fx, fy, cx, cy = size_and_focal
    kind = KannalaBrandt if model == FISHEYE_MODEL else Pinhole
    with found_in(where):
        return kind(int(width), int(height), fx, fy, cx, cy, **distortion)


def _files(frame: dict[str, Any], folder: Path, own_lidar: bool) -> dict[str, Path]:
    keys = {name: layer.key for name, layer in LAYERS.items()}
    if not own_lidar:
        keys["lidar"] = DEPTH_KEY
    return {layer: folder / frame[key] for layer, key in keys.items() if key in frame}


def _check_files(path: Path, pictures: tuple[ScenePicture, ...], points_path: Path | None) -> None:
    named = dict.fromkeys(file for picture in pictures for file in picture.files.values())
    missing = [file for file in (*named, *([points_path] if points_path else [])) if not file.is_file()]
    if missing:
        others = f" and {len(missing) - 1} others" if len(missing) > 1 else ""
        raise InputError(
            f"{missing[0]}: no such file{others}, but {path} names it. Copy the missing files, or process the drive "
            "again."
        )
