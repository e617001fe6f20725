"""A depth network of one's own: writes a map for every picture of a scene, for `estimate-depth --maps`.

    python new_network.py SCENE MAPS

Its place is taken here by a flat road: whatever a ray meets is on the ground, at the camera's height.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge_depth_nerf.base.files import read_image
from edge_depth_nerf.scene.reader import ScenePicture, read_scene

CAMERA_HEIGHT_M = 1.6
HORIZON_M = 80.0


def predict(rgb: NDArray[np.uint8], picture: ScenePicture) -> NDArray[np.float32]:
    """Distance along each pixel's ray, metres, H×W; 0 = none. A network would look at `rgb`."""
    lens = picture.lens
    rays, valid = lens.unproject(lens.pixel_centres())  # unit vectors, x right, y down, z forward
    falls = -rays.numpy() @ picture.up_in_camera
    distance_m = np.where(falls > CAMERA_HEIGHT_M / HORIZON_M, CAMERA_HEIGHT_M / np.maximum(falls, 1e-6), HORIZON_M)
    return np.where(valid.numpy(), distance_m, 0).astype(np.float32)


def main(scene_folder: Path, maps: Path) -> None:
    """Write MAPS/CAMERA/FRAME.npy for every picture."""
    for picture in read_scene(scene_folder).pictures:
        path = maps / picture.camera / f"{Path(picture.name).stem}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, predict(read_image(picture.files["image"]), picture))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
