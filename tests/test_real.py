"""The real KITTI-360 frame goes the whole way: scene, prior, training, evaluation. Here the geometry must hold and the
training must learn; how good it gets is a matter of benchmarks/quality/real_drive.py."""

from pathlib import Path

import numpy as np
import pytest
from trainings import train

from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.cameras import MEI
from edge_depth_nerf.process.reading import downscale_image, downscale_mask
from edge_depth_nerf.scene.writer import FrameContent, SceneCamera, SceneFrame, write_scene

pytestmark = pytest.mark.slow

BLOCK_PX = 64
HELD_OUT_SHARE = 0.1
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From a world whose axes are a camera's (x right, y down, z forward) to a scene's, whose z is up."""


def nearest_of_blocks(distance_m: np.ndarray, factor: int) -> np.ndarray:
    """The nearest distance of each factor × factor block, 0 where there is none."""
    height, width = distance_m.shape[0] // factor, distance_m.shape[1] // factor
    blocks = distance_m[: height * factor, : width * factor].reshape(height, factor, width, factor)
    nearest = np.where(blocks > 0, blocks, np.inf).min(axis=(1, 3))
    return np.where(np.isfinite(nearest), nearest, 0)


def held_out_blocks(size_px: int) -> np.ndarray:
    """True in whole blocks of a square map, drawn at random."""
    count = -(-size_px // BLOCK_PX)
    chosen = np.random.default_rng(0).permutation(count**2) < round(HELD_OUT_SHARE * count**2)
    return np.kron(chosen.reshape(count, count), np.ones((BLOCK_PX, BLOCK_PX), bool))[:size_px, :size_px]


def write_frame_twice(real_data: Path, output: Path, downscale: int) -> None:
    """The frame as a scene: trained with nine tenths of its LiDAR, evaluated on the rest, in whole blocks of 64 px."""
    folder = real_data / "kitti360_fisheye_frame"
    sample = read_json(folder / "kitti360_sample.json")["cam_params"]
    # KITTI-360 counts integer pixel centres
    size = (1400, 1400, sample["fx"], sample["fy"], sample["cx"] + 0.5, sample["cy"] + 0.5)
    camera = MEI(*size, *(sample[name] for name in ("xi", "k1", "k2", "p1", "p2"))).downscaled(downscale)
    mask = downscale_mask(~np.load(folder / "mask_left_fisheye.npy"), downscale)
    lidar_m, others = read_distance_png(folder / "kitti360_depth.png"), held_out_blocks(1400)
    image = downscale_image(read_image(folder / "kitti360_rgb.png"), downscale)
    contents = [FrameContent(image, lidar=nearest_of_blocks(lidar_m * kept, downscale)) for kept in (~others, others)]
    frames = [SceneFrame("image_02", n, UPRIGHT, content, held_out=n == 1) for n, content in enumerate(contents)]
    source = {"recording": "KITTI-360, one fisheye frame", "downscale": downscale}
    write_scene(output, [SceneCamera("image_02", camera, mask)], frames, layers=("lidar",), source=source)


def test_the_real_fisheye_frame(real_data, tmp_path):
    scene = tmp_path / "scene"
    write_frame_twice(real_data, scene, downscale=10)
    frames = read_json(scene / "transforms.json")["frames"]
    mask = read_mask(scene / frames[0]["mask_path"])
    trained, evaluated = (read_distance_png(scene / frame["lidar_file_path"]) for frame in frames)
    assert not (trained > 0)[~mask].any() and not (evaluated > 0)[~mask].any()
    share = (evaluated > 0).sum() / ((evaluated > 0).sum() + (trained > 0).sum())
    assert 0.03 < share < 0.25  # a tenth of the blocks; blocks differ in returns
    hidden = np.load(real_data / "kitti360_fisheye_frame" / "mask_left_fisheye.npy")
    assert mask.mean() < 1 - hidden.mean()  # the real mask keeps more than the lens circle

    pipeline, losses = train(scene, tmp_path, 200)
    assert np.mean(losses[-10:]) < 0.3 * np.mean(losses[:5])
    metrics = pipeline.get_average_eval_image_metrics()
    assert np.isfinite(metrics["masked_psnr"]) and metrics["lidar_pixels"] > 20
