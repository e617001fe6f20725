"""The scene in the repository is what its README says, and trains as it is."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scenes import copy_sample_drive

from edge_depth_nerf.base.files import read_distance_png, read_json, read_mask
from edge_depth_nerf.method.error_model import Calibration, read_calibration
from edge_depth_nerf.method.prior import PriorOptions
from edge_depth_nerf.mono.calibration import calibrate_scene, saved_calibration
from edge_depth_nerf.scene.format import CALIBRATION_FILE
from edge_depth_nerf.scene.reader import read_scene


def test_it_is_small_and_whole(sample_drive):
    files = [path for path in sample_drive.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= 3_000_000
    transforms = read_json(sample_drive / "transforms.json")
    assert len(transforms["frames"]) == 24
    for frame in transforms["frames"]:
        for key, name in frame.items():
            if key.endswith("_path"):
                assert (sample_drive / name).is_file(), name
    assert not set(transforms["train_filenames"]) & set(transforms["test_filenames"])


def test_its_maps_agree(sample_drive):
    """LiDAR, monocular distance and truth of a frame are of one world."""
    frames = read_json(sample_drive / "transforms.json")["frames"][::5]
    assert frames
    for frame in frames:
        lidar, mono, truth = (
            read_distance_png(sample_drive / frame[f"{name}_file_path"]) for name in ("lidar", "mono", "truth_distance")
        )
        mask = read_mask(sample_drive / frame["mask_path"])
        lidar_points = (lidar > 0) & (truth > 0)
        assert lidar_points.sum() > 300
        assert not (lidar > 0)[~mask].any()
        # a return lies anywhere in its pixel, the truth in its middle: at edges they differ
        off = np.abs(lidar[lidar_points] / truth[lidar_points] - 1)
        assert np.median(off) < 0.02 and (off < 0.05).mean() > 0.85
        both = (mono > 0) & (truth > 0) & mask
        assert 0.01 < np.median(np.abs(mono[both] / truth[both] - 1)) < 0.2


def test_its_calibration_is_accepted(sample_drive):
    """The folder's own file, without any cache; where this fails, the sample drive has to be made anew."""
    assert not (sample_drive / ".cache").exists()
    found = saved_calibration(read_scene(sample_drive), PriorOptions())
    assert found is not None and found == read_calibration(sample_drive / CALIBRATION_FILE)
    assert found.drive_fit is not None and found.error_model is not None


@pytest.mark.slow
def test_its_calibration_is_what_is_measured(sample_drive, tmp_path):
    """Measured again it is of the same files, with the same figures but for the order in which a processor adds."""
    shipped, found = (
        read_calibration(sample_drive / CALIBRATION_FILE),
        calibrate_scene(copy_sample_drive(tmp_path / "scene")),
    )
    assert found.made_of == shipped.made_of
    assert (found.everywhere, len(found.frames)) == (shipped.everywhere, len(shipped.frames)) == (True, 22)
    np.testing.assert_allclose(numbers(found), numbers(shipped), atol=0.005)


def numbers(calibration: Calibration) -> list[float]:
    """Fits, logarithms of factors, angles and relative errors, in one order."""
    assert (
        calibration.drive_fit is not None
        and calibration.error_model is not None
        and calibration.return_model is not None
    )
    found = [*calibration.field_rad, *dataclasses.astuple(calibration.drive_fit)]
    for model in (calibration.error_model, calibration.return_model):
        found += [model.log_base, *(value for _, values in sorted(model.log_factors.items()) for value in values)]
    for frame in calibration.frames:
        assert frame.held_out_before is not None and frame.held_out_after is not None
        found += [*dataclasses.astuple(frame.fit), frame.held_out_before, frame.held_out_after]
    return found


def test_tests_work_on_copies():
    """Who trains on the repository's own folder leaves a `.cache` there, which no test may see."""
    named = [path.name for path in Path(__file__).parent.glob("*.py") if '"data" / "sample' in path.read_text()]
    assert sorted(named) == ["scenes.py", Path(__file__).name]
