"""Real KITTI-360 excerpts go the whole way: scene, prior, training, evaluation. Here the geometry must hold and the
training must learn; how good it gets is a matter of benchmarks/quality/real_drive.py."""

import numpy as np
import pytest
from real_scenes import fisheye_frame_scene, stereo_scene
from trainings import train

from edge_depth_nerf.base.files import read_distance_png, read_json, read_mask

pytestmark = pytest.mark.slow


def test_the_real_fisheye_frame(real_data, tmp_path):
    scene = fisheye_frame_scene(real_data, tmp_path / "scene", downscale=10)
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


def test_the_real_stereo_drive(real_data, tmp_path):
    scene = stereo_scene(real_data, tmp_path / "scene", downscale=16)
    transforms = read_json(scene / "transforms.json")
    assert len(transforms["frames"]) == 10 and len(transforms["test_filenames"]) == 2
    distance = read_distance_png(scene / transforms["frames"][0]["mono_file_path"])
    known = distance > 0
    assert known.mean() > 0.4
    # a street seen from a car: the road some metres ahead, nothing nearer than its bonnet
    assert 2 < np.percentile(distance[known], 5) < np.percentile(distance[known], 95) < 120
    pipeline, losses = train(scene, tmp_path, 200)
    assert np.mean(losses[-10:]) < 0.3 * np.mean(losses[:5])
    metrics = pipeline.get_average_eval_image_metrics()
    assert np.isfinite(metrics["masked_psnr"])
    assert "lidar_abs_rel" not in metrics
