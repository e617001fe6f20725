"""Pictures, validity masks and distance maps of one split.

Host-facing. All are read by the scene's one reader (`scene.reader`): every map is H×W, distances are metres along the
ray with 0 = no value, masks are True where a pixel may be used. A ray that the lens model cannot give (beyond its
validity, or beyond the scene's theta_max) is never valid, whether the scene brings a mask or not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture

EVALUATED_DISTANCES = ("lidar", "truth_distance")
"""Layers of distances that a rendered view is evaluated by."""


class FisheyeDepthDataset(InputDataset):
    """Adds to nerfstudio's dataset: the validity mask, held-out LiDAR and, where it is known, ground truth."""

    scene: SceneFolder
    """Where the pictures are from."""
    pictures: list[ScenePicture]
    """Those of this split, in the dataset's order."""

    def __init__(self, dataparser_outputs: DataparserOutputs, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        if scale_factor != 1.0:
            raise InputError(
                f"camera_res_scale_factor is {scale_factor}; distance maps are not resized. "
                "Run `edge-depth-nerf process … --downscale K` instead."
            )
        if "scene" not in self.metadata:
            raise InputError(
                "this method reads scenes with the parser fisheye-depth-data; leave out the other parser (ours "
                "also reads nerfstudio's own scenes)."
            )
        # not for the model, which gets what is left of the metadata
        self.scene, self.pictures = self.metadata.pop("scene"), self.metadata.pop("pictures")
        held_out = self.scene.held_out_cameras()
        self.of_held_out_cameras = {
            number for number, picture in enumerate(self.pictures) if picture.camera in held_out
        }
        """Numbers of the pictures whose whole camera is held out."""
        self._trained_frames = {picture.frame for picture in self.scene.pictures if not picture.held_out}

    def mask(self, image_idx: int) -> NDArray[np.bool_]:
        """Give H×W, True where the picture may be used: the scene's mask within the validity of the lens."""
        return self.scene.usable(self.pictures[image_idx])

    def rgb(self, image_idx: int) -> NDArray[np.uint8]:
        """Read H×W×3 colours, without an alpha channel."""
        return self.scene.rgb(self.pictures[image_idx])

    def distance_m(self, image_idx: int, layer: str) -> NDArray[np.float32] | None:
        """H×W distance along the ray of a layer (lidar, mono, …), metres, 0 = none; None if the scene has none."""
        return self.scene.distance_m(self.pictures[image_idx], layer)

    def sources(self) -> set[str]:
        """Layers that all pictures of the split have."""
        return set.intersection(*(set(picture.files) for picture in self.pictures))

    def get_data(self, image_idx: int, image_type: str = "float32") -> dict[str, Any]:
        """Give the picture, the mask and the maps that evaluate a rendered view.

        Returns:
            nerfstudio's image_idx, image and mask (H×W×1), and where the scene has them: lidar_distance_m and
            truth_distance_m (H×W×1 float32), truth_rgb (H×W×3 float32).
        """
        rgb = torch.from_numpy(self.rgb(image_idx))
        data: dict[str, Any] = {
            "image_idx": image_idx,
            "image": rgb if image_type == "uint8" else rgb.float() / 255,
            "mask": torch.from_numpy(self.mask(image_idx))[..., None],
        }
        data.update(self.get_metadata(data))
        return data

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Tensor]:
        """Give the maps that evaluate a rendered view."""
        image_idx = data["image_idx"]
        found: dict[str, Tensor] = {}
        for layer in EVALUATED_DISTANCES:
            # a camera that is held out shares its sweeps with cameras that are trained on
            shared = image_idx in self.of_held_out_cameras and self.pictures[image_idx].frame in self._trained_frames
            distance_m = None if shared and layer == "lidar" else self.distance_m(image_idx, layer)
            if distance_m is not None:
                found[f"{layer.removesuffix('_distance')}_distance_m"] = torch.from_numpy(distance_m)[..., None]
        picture = self.pictures[image_idx]
        if "truth_rgb" in picture.files:
            pixels = self.scene.rgb(picture, "truth_rgb")
            found["truth_rgb"] = torch.from_numpy(pixels.astype(np.float32) / 255)
        return found
