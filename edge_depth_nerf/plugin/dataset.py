"""Pictures, validity masks and distance maps of one split.

Host-facing. Every map is H×W, distances are metres along the ray with 0 = no value, masks are True where a pixel
may be used. A ray that the lens model cannot give (beyond its validity, or beyond the scene's theta_max) is never
valid, whether the scene brings a mask or not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import picture_size, read_distance_png, read_image, read_mask, read_npy
from edge_depth_nerf.cameras import Camera, KannalaBrandt, Pinhole


class FisheyeDepthDataset(InputDataset):
    """Adds to nerfstudio's dataset: the validity mask, held-out LiDAR and, where it is known, the truth."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        if scale_factor != 1.0:
            raise InputError(
                f"camera_res_scale_factor is {scale_factor}; distance maps are not resized. "
                "Run `edge-depth-nerf process … --downscale K` instead."
            )
        if "metres_per_unit" not in self.metadata:
            raise InputError(
                "this method reads scenes with the parser fisheye-depth-data; leave the other parser away (ours reads "
                "nerfstudio's own scenes, too)."
            )

    def camera(self, image_idx: int) -> Camera:
        """The lens of a picture, as one of the project's own camera models."""
        cameras = self.cameras[image_idx]
        width, height = int(cameras.width), int(cameras.height)
        fx, fy, cx, cy = (float(value) for value in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
        distortion = [0.0] * 6 if cameras.distortion_params is None else cameras.distortion_params.tolist()
        k1, k2, k3, k4, p1, p2 = distortion
        if int(cameras.camera_type) == CameraType.FISHEYE.value:
            return KannalaBrandt(width, height, fx, fy, cx, cy, k1, k2, k3, k4, p1, p2)
        return Pinhole(width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3, k4)

    def valid_rays(self, image_idx: int) -> NDArray[np.bool_]:
        """H×W, True where the lens model gives a ray within the scene's theta_max."""
        return self._rays_of(image_idx)[0]

    def cos_theta(self, image_idx: int) -> NDArray[np.float64]:
        """H×W cosine of the rays' angle from the optical axis; NaN where there is no ray."""
        return self._rays_of(image_idx)[1]

    def _rays_of(self, image_idx: int) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Validity and cosine of the angle from the axis, H×W each."""
        return _rays_of(self.camera(image_idx), self.metadata["theta_max_rad"])

    def mask_key(self, image_idx: int) -> tuple[Path | None, Camera]:
        """Pictures with the same key have the same mask."""
        mask_filenames = self._dataparser_outputs.mask_filenames
        return (mask_filenames[image_idx] if mask_filenames else None), self.camera(image_idx)

    def mask(self, image_idx: int) -> NDArray[np.bool_]:
        """H×W, True where the picture may be used: the scene's mask within the validity of the lens."""
        valid = self.valid_rays(image_idx)
        path, _ = self.mask_key(image_idx)
        if path is None:
            return valid
        mask = read_mask(path)
        self._check_size(path, mask, image_idx)
        return mask & valid

    def rgb(self, image_idx: int) -> NDArray[np.uint8]:
        """H×W×3 colours; an alpha channel is left away."""
        pixels = self._decoded(image_idx, self.get_numpy_image)[..., :3]
        self._check_size(self.image_filenames[image_idx], pixels, image_idx)
        return pixels

    def lidar_distance_m(self, image_idx: int) -> NDArray[np.float32] | None:
        """H×W LiDAR distance along the ray, metres, 0 = no return; None without LiDAR."""
        path = self._map_path("lidar_filenames", image_idx)
        if path is None:
            return None
        metres_per_count = self.metadata["lidar_metres_per_count"]
        if path.suffix == ".npy":
            distance = read_npy(path).astype(np.float32) * np.float32(metres_per_count)
            if distance.ndim == 3 and distance.shape[2] == 1:
                distance = distance[..., 0]
        else:
            distance = read_distance_png(path, metres_per_count)
        self._check_size(path, distance, image_idx)
        if self.metadata["lidar_is_z_depth"]:
            valid, cos_theta = self._rays_of(image_idx)
            valid = valid & (cos_theta > 0)
            distance = np.where(valid, distance / np.where(valid, cos_theta, 1), 0).astype(np.float32)
        return distance

    def mono_distance_m(self, image_idx: int) -> NDArray[np.float32] | None:
        """H×W monocular distance along the ray, metres, 0 = none; None without monocular maps."""
        return self._own_map("mono_filenames", image_idx)

    def truth_distance_m(self, image_idx: int) -> NDArray[np.float32] | None:
        """H×W true distance along the ray, metres, 0 = sky or unknown; None for recorded drives."""
        return self._own_map("truth_distance_filenames", image_idx)

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict[str, Any]:
        """Picture, mask and maps of judgement of one frame.

        Returns:
            nerfstudio's image_idx, image and mask (H×W×1), and where the scene has them: lidar_distance_m and
            truth_distance_m (H×W×1 float32), truth_rgb (H×W×3 float32).

        """
        image = self._decoded(image_idx, self.get_image_uint8 if image_type == "uint8" else self.get_image_float32)
        self._check_size(self.image_filenames[image_idx], image, image_idx)
        mask = torch.from_numpy(self.mask(image_idx))[..., None]
        data: dict[str, Any] = {"image_idx": image_idx, "image": image, "mask": mask}
        data.update(self.get_metadata(data))
        return data

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Tensor]:
        """The maps that judge a rendered view."""
        image_idx = data["image_idx"]
        maps = {
            "lidar_distance_m": self.lidar_distance_m(image_idx),
            "truth_distance_m": self.truth_distance_m(image_idx),
        }
        found: dict[str, Tensor] = {
            name: torch.from_numpy(distance)[..., None] for name, distance in maps.items() if distance is not None
        }
        truth_rgb = self._map_path("truth_rgb_filenames", image_idx)
        if truth_rgb is not None:
            pixels = read_image(truth_rgb)
            self._check_size(truth_rgb, pixels, image_idx)
            found["truth_rgb"] = torch.from_numpy(pixels.astype(np.float32) / 255)
        return found

    def _decoded(self, image_idx: int, decode: Callable[[int], Any]) -> Any:
        path = self.image_filenames[image_idx]
        # Pillow decodes pictures of any size
        picture_size(path)
        try:
            return decode(image_idx)
        except Exception as error:  # Pillow raises whatever its readers meet
            raise InputError(f"{path}: cannot be decoded as a picture ({error}). Copy or make it again.") from error

    def _map_path(self, name: str, image_idx: int) -> Path | None:
        filenames = self.metadata[name]
        return filenames[image_idx] if filenames else None

    def _own_map(self, name: str, image_idx: int) -> NDArray[np.float32] | None:
        path = self._map_path(name, image_idx)
        if path is None:
            return None
        distance = read_distance_png(path)
        self._check_size(path, distance, image_idx)
        return distance

    def _check_size(self, path: Path, pixels: NDArray | Tensor, image_idx: int) -> None:
        expected = int(self.cameras.height[image_idx]), int(self.cameras.width[image_idx])
        if pixels.shape[:2] != expected or pixels.ndim > 3:
            raise InputError(
                f"{path}: is {pixels.shape[1]}×{pixels.shape[0]} pixels (width × height), but the camera of "
                f"{self.image_filenames[image_idx].name} has {expected[1]}×{expected[0]}. Pictures, masks and "
                "distance maps of a frame must have one size; make the file again at that size."
            )


@functools.lru_cache(maxsize=8)
def _rays_of(camera: Camera, theta_max_rad: float | None) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Validity of a lens's rays within an angle, and the cosine of that angle; seconds, and 18 MB, at 1400 px.

    Kept of the lenses used last: a scene may have one for each picture.
    """
    directions, valid = camera.unproject(camera.pixel_centres())
    cos_theta = directions[..., 2]
    if theta_max_rad is not None:
        valid = valid & (cos_theta >= math.cos(theta_max_rad))
    return valid.numpy(), cos_theta.numpy()
