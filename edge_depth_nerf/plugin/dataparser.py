"""Reads a scene folder: nerfstudio's own format, with metric scale and the maps of this project beside it.

Host-facing. Poses and cameras are read by nerfstudio's parser; here come the scale in metres, the files of LiDAR,
monocular and true maps, and errors that name what is wrong. The scene's axes are kept (z up), so that a distance
in scene units times `metres_per_unit` is metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from numpy.typing import NDArray

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.plugin.compat import without_undefined_ray
from edge_depth_nerf.plugin.pose_refinement import FRAMES
from edge_depth_nerf.plugin.scanning import SceneToModel
from edge_depth_nerf.scene.format import DepthKind, read_transforms
from edge_depth_nerf.scene.reader import scene_of

SMALLEST_METRES_PER_UNIT = 10.0
"""What stands around the road is some 10 m away, however short the drive."""
LARGEST_METRES_PER_UNIT = 128.0
"""The finest of 2048 cells is then 0.25 m: larger ones would blur kerbs and poles. The drive's ends are squeezed."""


FAR_FROM_ORIGIN_M = 8192.0
"""From here on float32 steps by a millimetre."""


def default_metres_per_unit(camera_positions_m: NDArray) -> float:
    """Give half of a drive's extent along its longest axis, within the limits above: metres for one unit of the scene.

    nerfacto's scene contraction keeps the cube |x|_inf <= 1 unit and squeezes the rest into 1..2, its hash grid spans
    the contracted -2..2, and its sampler spends half of its samples below 1 unit. The drive should lie inside the
    cube: beyond r units, cells grow with r². The finest cell, 4 · metres_per_unit / resolution, should stay small.
    """
    half_extent_m = float(np.ptp(camera_positions_m, axis=0).max()) / 2
    return float(np.clip(half_extent_m, SMALLEST_METRES_PER_UNIT, LARGEST_METRES_PER_UNIT))


@dataclass
class SceneOptions:
    """Our options, before nerfstudio's in the help."""

    metres_per_unit: float | None = None
    """Metres per scene unit. Not set: half of the drive's extent, from 10 m to 128 m."""
    depth_kind: DepthKind = "auto"
    """What the files under depth_file_path contain. auto: distance along the ray, but z_depth in other people's pinhole
    scenes."""


@dataclass
class FisheyeDepthDataParserConfig(NerfstudioDataParserConfig, SceneOptions):
    """Scene with fisheye (or pinhole) cameras, metric poses and distance maps."""

    _target: type = field(default_factory=lambda: FisheyeDepth)
    """Target class to instantiate."""
    depth_unit_scale_factor: float | None = None  # pyrefly: ignore
    """Metres per count of the files under depth_file_path. Not set: what transforms.json says, else nerfstudio's
    0.001."""
    downscale_factor: tyro.conf.Suppress[int | None] = 1
    """How much smaller pictures nerfstudio reads from folders images_K; maps have one size, so it is 1."""
    orientation_method: tyro.conf.Suppress[Literal["pca", "up", "vertical", "none"]] = "none"
    """The method to use for orientation; the drive's own axes by default."""
    auto_scale_poses: tyro.conf.Suppress[bool] = False
    """nerfstudio's scaling of all poses into +-1. It is off: metres_per_unit sets the scale."""
    eval_mode: Literal["fraction", "filename", "interval", "all"] = "interval"
    """How a scene without split files is divided. interval holds out every eval_interval-th picture; filename those
    with eval in their names, and train in the others'."""


def check_split(meta: dict[str, Any], path: Path) -> None:
    """Check the lists of training and held-out pictures.

    A frame is either trained on or held out, with all its cameras: they share one LiDAR sweep. Cameras that are held
    out as a whole do not count. (A scene with nothing held out has the same pictures in both lists.)

    Raises:
        InputError: a name that is no picture's, or a frame that is in both.
    """
    by_name = {frame["file_path"]: frame for frame in meta["frames"]}
    lists = {split: meta[f"{split}_filenames"] for split in ("train", "val", "test") if f"{split}_filenames" in meta}
    for split, names in lists.items():
        unknown = [name for name in names if name not in by_name]
        if unknown:
            raise InputError(f"{path}: {split}_filenames names {unknown[0]}, which is the file_path of no frame.")
    if "train" not in lists:
        return
    trained = {by_name[name].get("camera") for name in lists["train"]}
    for split in ("val", "test"):
        held_out = lists.get(split, [])
        if set(held_out) == set(lists["train"]):
            continue
        of_trained = [name for name in held_out if by_name[name].get("camera") in trained]
        of_split = [{by_name[name].get("frame", name) for name in names} for names in (lists["train"], of_trained)]
        shared = sorted(of_split[0] & of_split[1], key=str)
        if shared:
            raise InputError(
                f"{path}: frame {shared[0]} is in train_filenames and in {split}_filenames. All cameras of a frame "
                "share one LiDAR sweep, so a frame is either for training or held out. Process the drive "
                "again."
            )


def transforms_path(data: Path) -> Path:
    """Find the transforms.json that `--data` means: a scene folder's, or the file itself.

    Raises:
        FileNotFoundError: no scene there.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    if not path.is_file():
        relative = (
            f" It was searched in {Path.cwd()}: relative paths start at the current folder, including those in a "
            "config.yml."
        )
        raise FileNotFoundError(
            f"{path}: no such file. --data takes a scene folder with a transforms.json; `edge-depth-nerf process` "
            f"makes one from a raw drive.{'' if path.is_absolute() else relative}"
        )
    return path


def _place_exactly(
    outputs: DataparserOutputs, meta: dict[str, Any], frames: dict[Path, dict[str, Any]], from_colmap: bool
) -> None:
    """Place cameras that are far from the origin again, in float64.

    nerfstudio's parser rounds positions to float32 before it subtracts their mean, which puts those of UTM, some 5,000
    km away, off by up to half a metre. The parser's own transform stays, for exporters to invert.

    Args:
        outputs: the parser's; its cameras are changed.
        meta: of transforms.json.
        frames: its frames by their pictures.
        from_colmap: whether there is COLMAP's model beside it, for which the parser has a transform of its own.
    """
    matrices = np.array([frames[image]["transform_matrix"] for image in outputs.image_filenames], np.float64)
    positions_m = matrices[:, :3, 3]
    if np.abs(positions_m).max() < FAR_FROM_ORIGIN_M:
        return
    of_colmap = {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]} if from_colmap else {}
    moved = SceneToModel.of(outputs, of_colmap | meta).points(positions_m)
    outputs.cameras.camera_to_worlds[:, :, 3] = torch.from_numpy(moved).float()


class FisheyeDepth(Nerfstudio):
    """Parser of scene folders."""

    config: FisheyeDepthDataParserConfig

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        """Cameras, pictures, masks and the files of distance maps of one split.

        Raises:
            FileNotFoundError: no scene there, or a file it names is missing.
            InputError: the scene cannot be used.
        """
        path = transforms_path(Path(self.config.data))
        meta = read_transforms(path)
        frames = meta["frames"]
        # nerfstudio's parser takes for granted that every frame has a pose, a lens, and the maps that any frame has
        scene = scene_of(meta, path, self.config.depth_kind, self.config.depth_unit_scale_factor)
        for key in scene.incomplete:
            missing = [frame["file_path"] for frame in frames if key not in frame]
            raise InputError(
                f"{path}: {key} is given for {len(frames) - len(missing)} of {len(frames)} frames; it is missing "
                f"for {', '.join(missing[:3])}{' …' if len(missing) > 3 else ''}. Give it for every frame or none."
            )
        check_split(meta, path)
        self._check_config(meta, path)
        metres_per_unit = self._metres_per_unit(frames)
        # nerfstudio's parser takes the scale from its config; the user's own stays
        self.config = replace(self.config, scale_factor=1.0 / metres_per_unit)
        if len(frames) == 1 and "train_filenames" not in meta:
            self.config.eval_mode = "all"  # the one picture is for training and for evaluation
        names = [Path(frame["file_path"]).name for frame in frames]
        by_name = self.config.eval_mode == "filename" and "train_filenames" not in meta
        if by_name and not all("train" in name or "eval" in name for name in names):
            raise InputError(f"{path}: --eval-mode filename needs names of pictures with train or eval in them.")
        outputs = super()._generate_dataparser_outputs(split)
        if not outputs.image_filenames:
            raise InputError(f"{path}: no picture is left for the split {split!r}; it needs one at least.")
        outputs.cameras = without_undefined_ray(outputs.cameras)
        by_picture = {self._get_fname(Path(frame["file_path"]), path.parent): frame for frame in frames}
        _place_exactly(outputs, meta, by_picture, (Path(self.config.data) / "colmap/sparse/0").exists())

        by_name = {picture.name: picture for picture in scene.pictures}
        pictures = [by_name[by_picture[image]["file_path"]] for image in outputs.image_filenames]
        outputs.metadata.update(
            scene=scene,
            pictures=pictures,
            metres_per_unit=metres_per_unit,
            depth_unit_scale_factor=scene.lidar_metres_per_count,
        )
        outputs.metadata[FRAMES] = [picture.frame for picture in pictures]
        for file in dict.fromkeys(file for picture in pictures for file in picture.files.values()):
            if not file.is_file():
                raise FileNotFoundError(f"{file}: no such file, but {path} names it. Process the drive again.")
        return outputs

    def _check_config(self, meta: dict[str, Any], path: Path) -> None:
        """Check what the options, and the commands after a training, ask of the scene."""
        lists = [f"{name}_filenames" for name in ("train", "val", "test")]
        lacking = [name for name in lists if not meta.get(name)]
        if lacking and any(name in meta for name in lists):
            raise InputError(
                f"{path}: names no pictures in {' and '.join(lacking)}. Give all of {', '.join(lists)}, or none; "
                "val and test may have the same."
            )
        if self.config.downscale_factor != 1:
            raise InputError(
                f"{path}: downscale_factor is {self.config.downscale_factor}, but pictures and maps are used in the "
                "size that the scene has. Leave the option out, or process the drive with --downscale."
            )

    def _metres_per_unit(self, frames: list[dict[str, Any]]) -> float:
        """Give the scale that was asked for, or the one that suits the drive."""
        metres_per_unit = self.config.metres_per_unit
        if metres_per_unit is None:
            positions_m = np.array([frame["transform_matrix"] for frame in frames], dtype=np.float64)[:, :3, 3]
            metres_per_unit = default_metres_per_unit(positions_m)
        if not (np.isfinite(metres_per_unit) and metres_per_unit > 0):
            raise InputError(f"metres_per_unit is {metres_per_unit}; expected a positive number of metres.")
        return metres_per_unit
