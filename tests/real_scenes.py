"""Scene folders made of the real KITTI-360 excerpts (not part of the project; see the fixture `real_data`)."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from edge_depth_nerf.base.files import read_distance_png, read_image, read_json
from edge_depth_nerf.cameras import MEI, Pinhole
from edge_depth_nerf.process.reading import downscale_image, downscale_mask
from edge_depth_nerf.scene.writer import FrameContent, SceneCamera, SceneFrame, write_scene

BLOCK_PX = 64
HELD_OUT_SHARE = 0.1
HELD_OUT_STEREO_FRAME = 702
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world whose axes are a camera's (x right, y down, z forward) to a scene's, whose z is up."""


def nearest_of_blocks(distance_m: np.ndarray, factor: int) -> np.ndarray:
    """The nearest return of each factor × factor block, 0 where there is none."""
    height, width = distance_m.shape[0] // factor, distance_m.shape[1] // factor
    blocks = distance_m[: height * factor, : width * factor].reshape(height, factor, width, factor)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    return np.where(np.isfinite(nearest), nearest, 0)


def held_out_blocks(size_px: int) -> np.ndarray:
    """True in whole blocks of a square map, drawn at random."""
    count = -(-size_px // BLOCK_PX)
    chosen = np.random.default_rng(0).permutation(count**2) < round(HELD_OUT_SHARE * count**2)
    return np.kron(chosen.reshape(count, count), np.ones((BLOCK_PX, BLOCK_PX), bool))[:size_px, :size_px]


def fisheye_frame_scene(real_data: Path, output: Path, downscale: int) -> Path:
    """The one real fisheye frame as a scene: trained with nine tenths of its LiDAR, evaluated on the rest.

    LiDAR is held out in whole blocks of 64 px. The frame stands twice in the scene: once for training, once, with the
    other returns, for evaluation.
    """
    folder = real_data / "kitti360_fisheye_frame"
    sample = read_json(folder / "kitti360_sample.json")["cam_params"]
    # KITTI-360 counts integer pixel centres
    size = (1400, 1400, sample["fx"], sample["fy"], sample["cx"] + 0.5, sample["cy"] + 0.5)
    camera = MEI(*size, *(sample[name] for name in ("xi", "k1", "k2", "p1", "p2")))
    hidden = np.load(folder / "mask_left_fisheye.npy")
    lidar = read_distance_png(folder / "kitti360_depth.png")
    evaluated = held_out_blocks(1400)
    image = downscale_image(read_image(folder / "kitti360_rgb.png"), downscale)
    frames = [
        SceneFrame(
            camera="image_02",
            frame=number,
            camera_to_world=UPRIGHT,
            content=FrameContent(image=image, lidar=nearest_of_blocks(lidar * kept, downscale)),
            held_out=number == 1,
        )
        for number, kept in enumerate((~evaluated, evaluated))
    ]
    cameras = [SceneCamera("image_02", camera.downscaled(downscale), downscale_mask(~hidden, downscale))]
    source = {"recording": "KITTI-360, one fisheye frame", "downscale": downscale}
    write_scene(output, cameras, frames, layers=("lidar",), source=source)
    return output


def stereo_distance(left: np.ndarray, right: np.ndarray, camera: Pinhole, baseline_m: float) -> np.ndarray:
    """Distance along the rays of the left of two rectified pictures, by semi-global matching; 0 = no match."""
    grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (left, right)]
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=128, blockSize=5, P1=200, P2=800, uniquenessRatio=10, speckleWindowSize=100,
        speckleRange=2, disp12MaxDiff=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(*grey).astype(np.float64) / 16
    z_depth = np.where(disparity > 1, camera.fx * baseline_m / np.maximum(disparity, 1), 0)
    directions, _ = camera.unproject(camera.pixel_centres())
    return z_depth / directions[..., 2].numpy()


def stereo_scene(real_data: Path, output: Path, downscale: int) -> Path:
    """Ten real rectified pictures with poses; distance of the left ones by stereo matching, as a monocular source.

    Both pictures of one frame are held out. The right pictures get theirs by matching mirrored pictures.
    """
    folder = real_data / "kitti360_stereo"
    meta = read_json(folder / "transforms.json")
    camera = Pinhole(meta["w"], meta["h"], meta["fl_x"], meta["fl_y"], meta["cx"], meta["cy"])
    poses = {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in meta["frames"]}
    opengl_to_opencv = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = []
    for number in sorted({name.split("_")[0] for name in poses}):
        pictures = [read_image(folder / f"{number}_{side}.png") for side in ("00", "01")]
        baseline_m = float(np.linalg.norm(poses[f"{number}_00"][:3, 3] - poses[f"{number}_01"][:3, 3]))
        mirrored = [np.ascontiguousarray(picture[:, ::-1]) for picture in pictures]
        mirrored_camera = replace(camera, cx=camera.width - camera.cx)
        distances = [
            stereo_distance(pictures[0], pictures[1], camera, baseline_m),
            stereo_distance(mirrored[1], mirrored[0], mirrored_camera, baseline_m)[:, ::-1],
        ]
        for side, (picture, distance) in enumerate(zip(pictures, distances, strict=True)):
            midpoints = distance[downscale // 2 :: downscale, downscale // 2 :: downscale].copy()
            content = FrameContent(image=downscale_image(picture, downscale), mono=midpoints)
            frames.append(
                SceneFrame(
                    camera=f"image_0{side}",
                    frame=int(number),
                    camera_to_world=UPRIGHT @ poses[f"{number}_0{side}"] @ opengl_to_opencv,
                    content=content,
                    held_out=int(number) == HELD_OUT_STEREO_FRAME,
                )
            )
    cameras = [SceneCamera(f"image_0{side}", camera.downscaled(downscale)) for side in (0, 1)]
    source = {"recording": "KITTI-360, five rectified stereo pairs", "downscale": downscale}
    write_scene(output, cameras, frames, layers=("mono",), source=source)
    return output
