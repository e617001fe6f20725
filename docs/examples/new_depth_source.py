"""A source of depth of one's own beside LiDAR and mono: a radar, whose maps are put into a scene that exists.

    python new_depth_source.py SCENE

The line that declares the layer is all that reader, writer, checks and DataManager need: they take what there is from
one table. Here LiDAR points, thinned to a tenth and in steps of 0.2 m, stand in for the radar's.
"""

from __future__ import annotations

import copy
import sys
from pathlib import Path

import numpy as np
from nerfstudio.plugins.types import MethodSpecification
from numpy.typing import NDArray

from edge_depth_nerf.plugin.config import edge_depth_nerf_lite
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.scene.format import LAYERS, Layer
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture, read_scene

LAYERS["radar"] = Layer("radar_file_path", "radar/{camera}", "distance", "radar maps")

SHARE = 0.1
STEP_M = 0.2


def measure(scene: SceneFolder, picture: ScenePicture) -> NDArray[np.float32]:
    """Metres along each pixel's ray, H×W; 0 = none."""
    lidar_m = scene.lidar_m(picture)
    kept = np.random.default_rng(picture.frame).random(lidar_m.shape) < SHARE
    return np.where(kept, np.round(lidar_m / STEP_M) * STEP_M, 0).astype(np.float32)


def radar() -> MethodSpecification:
    """The method that nerfstudio registers: edge-depth-nerf-lite, with the radar for its prior."""
    config = copy.deepcopy(edge_depth_nerf_lite.config)
    config.method_name = "radar"
    data = config.pipeline.datamanager
    assert isinstance(data, FisheyeDepthDataManagerConfig)
    data.depth_source = "radar"
    return MethodSpecification(config=config, description="A prior of radar alone.")


def main(scene_folder: Path) -> None:
    """Put a map for every picture into the scene."""
    scene = read_scene(scene_folder)
    maps = ((picture.name, measure(scene, picture)) for picture in scene.pictures)
    write_maps(scene_folder, "radar", maps, {"made_by": "a tenth of the LiDAR"})


if __name__ == "__main__":
    main(Path(sys.argv[1]))
