"""Draw docs/fisheye_depth.jpg: a rendered fisheye picture, exact disparities of its views, and what they are joined to.

    python docs/make_fisheye_picture.py

Each view's disparity has a scale and shift of its own, as a network's has. It takes half a minute.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from edge_depth_nerf.base.files import read_distance_png, read_image
from edge_depth_nerf.base.pictures import resize, side_by_side
from edge_depth_nerf.mono.fisheye import COLOURED, fisheye_depth, open_fisheyes
from edge_depth_nerf.mono.options import FisheyeDepthOptions
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

PICTURE = Path(__file__).with_name("fisheye_depth.jpg")
SIZE_PX, FRAME = 480, "000000"
LARGE_PX, SMALL_PX = 480, 160
TITLES = ("Picture", "Network's maps of seven views", "Joined: distance along the ray")


def main() -> None:
    """Render a drive, write the maps of its first picture's views, and join them."""
    rng, quiet = np.random.default_rng(4), Console(quiet=True)
    with tempfile.TemporaryDirectory() as folder:
        drive, maps = Path(folder) / "drive", Path(folder) / "maps"
        synthesize_drive(SynthesizeOptions(drive, frames=1, size=SIZE_PX, layout="rig"))
        options = FisheyeDepthOptions(
            drive / "images/left",
            drive / "rig.toml",
            Path(folder) / "out",
            camera="left",
            mask=drive / "masks/left.png",
            maps=maps,
            maps_kind="inverse",
        )
        truth_m = read_distance_png(drive / f"truth/left/distance/{FRAME}.png")
        maps.mkdir()
        shown = []
        for number, view in enumerate(open_fisheyes(options).views):
            distance_m = cv2.remap(truth_m, view.picture_xy[..., 0], view.picture_xy[..., 1], cv2.INTER_NEAREST)
            x, y = np.meshgrid(np.arange(view.width), np.arange(view.height))
            x, y = x + 0.5 - view.width / 2, y + 0.5 - view.height / 2
            z_m = distance_m * view.focal_px / np.sqrt(x**2 + y**2 + view.focal_px**2)
            scale, shift = rng.uniform(0.3, 3), rng.uniform(0.01, 0.1)
            disparity = np.where(z_m > 0, scale / np.where(z_m > 0, z_m, 1), 0) + shift
            np.save(maps / f"{FRAME}_{number}.npy", disparity)
            grey = np.clip(255 * disparity / np.quantile(disparity, 0.98), 0, 255).astype(np.uint8)
            shown.append(resize(np.repeat(grey[..., None], 3, -1), (SMALL_PX, SMALL_PX)))
        joined = read_image(fisheye_depth(options, quiet) / COLOURED / f"{FRAME}.png")
    # ahead in the middle, the views above and below it around
    blank = np.full_like(shown[0], 255)
    rows = [shown[3], blank, shown[4]], [shown[1], shown[0], shown[2]], [shown[5], blank, shown[6]]
    middle = np.vstack([np.hstack(row) for row in rows])
    panels = [resize(joined[:, :SIZE_PX], (LARGE_PX, LARGE_PX)), middle, joined[:, SIZE_PX:]]
    cv2.imwrite(str(PICTURE), side_by_side([panels], TITLES)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])


if __name__ == "__main__":
    main()
