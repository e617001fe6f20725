import math
from pathlib import Path

import numpy as np
import pytest
import torch
from models import pipeline_config, pipeline_of
from scenes import transforms, write_scene

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import read_distance_png, write_distance_png
from edge_depth_nerf.plugin.pipeline import NotFiniteError


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A scene that no test changes, with what trainings keep beside it."""
    return write_scene(tmp_path_factory.mktemp("shared"))


def test_a_depth_loss_without_any_prior_is_an_error(tmp_path):
    scene = write_scene(tmp_path, lidar=False, frames=2)
    for path in (scene / "mono").iterdir():
        write_distance_png(path, np.zeros((28, 32)))
    with pytest.raises(InputError, match=r"no training pixel has a depth prior.*estimate-depth.*depth-loss none"):
        pipeline_of(scene)
    pipeline = pipeline_of(scene, depth_loss="none")
    assert np.isfinite(float(pipeline.get_train_loss_dict(0)[1]["rgb_loss"].detach()))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"near_m": 50.0, "far_m": 10.0},
            r"near-m 50 and --pipeline\.model\.far-m 10: expected 0 or more",
        ),
        ({"near_m": -5.0}, r"near-m -5 and .*: expected 0 or more metres"),
        ({"depth_loss_mult": -1.0}, r"--pipeline\.model\.depth-loss-mult -1: expected 0 or more"),
        ({"depth_loss_sharp": math.nan}, r"--pipeline\.model\.depth-loss-sharp nan: expected 0 or more"),
    ],
)
def test_options_out_of_range(shared, options, said):
    with pytest.raises(InputError, match=said):
        pipeline_of(shared, **options)


def test_a_prior_in_another_unit_is_named(tmp_path):
    """Maps in metres, read as nerfstudio's millimetres."""
    scene = write_scene(tmp_path, mono=False, frames=3, depth_unit_scale_factor=1e-3)
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            counts = read_distance_png(scene / frame.pop("lidar_file_path"), 1 / 256)
            frame["depth_file_path"] = f"{Path(frame['file_path']).stem}.npy"
            np.save(scene / frame["depth_file_path"], counts.astype(np.float32))
    with pytest.raises(
        InputError, match=r"no depth prior is between .*0\.2 m.*their median.*--depth-unit-scale-factor 1"
    ):
        pipeline_of(scene)
    config = pipeline_config(scene)
    config.datamanager.dataparser.depth_unit_scale_factor = 1.0
    assert config.setup(device="cpu", test_mode="val").get_train_loss_dict(0)[1]["edge_loss"] > 0


def test_a_scene_without_depth_maps_is_trained_as_plain_nerfacto(tmp_path, capsys):
    scene = write_scene(tmp_path, lidar=False, mono=False, frames=2)
    pipeline = pipeline_of(scene)
    assert "no depth maps" in (said := " ".join(capsys.readouterr().out.split())) and "this is nerfacto without" in said
    losses = pipeline.get_train_loss_dict(0)[1]
    assert np.isfinite(float(losses["rgb_loss"].detach())) and not any("depth" in name for name in losses)
    with pytest.raises(InputError, match="the scene has no LiDAR maps, but depth_source lidar needs them"):
        config = pipeline_config(scene)
        config.datamanager.depth_source = "lidar"
        config.setup(device="cpu", test_mode="val")


def test_nothing_is_integrated_for_a_model_without_depth_loss(shared, monkeypatch):
    monkeypatch.setattr("edge_depth_nerf.plugin.datamanager.PriorCache", lambda *_: pytest.fail("integrated"))
    config = pipeline_config(shared, depth_loss="none")
    pipeline = config.setup(device="cpu", test_mode="val")
    assert pipeline.datamanager.config.depth_source == "none"
    assert config.datamanager.depth_source == "auto"  # what the user gave is left as it was


def test_depth_errors_are_pooled_and_every_figure_is_finite(shared):
    pipeline = pipeline_of(shared)
    for metrics in (
        pipeline.get_average_eval_image_metrics(get_std=True),
        pipeline.get_eval_image_metrics_and_images(0)[0],
    ):
        assert {"masked_psnr", "truth_masked_ssim", "lidar_abs_rel", "truth_delta_1_25"} <= set(metrics)
        assert "lidar_abs_rel_std" not in metrics
        assert np.isfinite([float(value) for value in metrics.values()]).all()


def test_a_checkpoint_of_tiny_cuda_nn_is_refused(shared):
    pipeline = pipeline_of(shared)
    state = pipeline.state_dict()
    assert any(name.endswith("hash_table") for name in state)
    pipeline.load_pipeline(state, 0)
    of_tcnn = {"_model.field.mlp_base.tcnn_encoding.params": torch.zeros(3)}
    with pytest.raises(InputError, match=r"made with tiny-cuda-nn.*Train again"):
        pipeline.load_pipeline(of_tcnn, 0)


def counted(pipeline, steps, odd):
    """Let the GPU's count run over some steps, of which `odd` have a loss that is not finite."""
    for step in steps:
        _, losses, _ = pipeline.get_train_loss_dict(step)
        losses["rgb_loss"] = losses["rgb_loss"] * (float("nan") if step in odd else 1.0)
        pipeline.count_not_finite(sum(losses.values()))
        pipeline.look_for_not_finite(step, {"rgb": torch.zeros(64, 3)}, losses)


def test_on_a_gpu_several_losses_that_are_not_finite_end_a_training(shared, capsys):
    pipeline = pipeline_of(shared)
    counted(pipeline, (1, 2, 50), {1, 50})
    assert "In 2 of the last 50 steps a loss was not finite" in " ".join(capsys.readouterr().out.split())
    counted(pipeline, (99, 100), set())  # counted anew
    assert "not finite" not in capsys.readouterr().out
    with pytest.raises(NotFiniteError, match=r"all losses are finite\. In 6 of the last 50"):
        counted(pipeline, (*range(101, 107), 150), set(range(101, 107)))
    with pytest.raises(NotFiniteError, match=r"rgb_loss is nan.*pictures: .*\.png.*In 6 of the last 50"):
        counted(pipeline, (*range(195, 200), 200), set(range(195, 201)))
    with torch.no_grad():
        next(pipeline.model.proposal_networks.parameters()).view(-1)[0] = math.nan
    # no picture is to blame
    with pytest.raises(NotFiniteError, match=r"is nan, as the parameter proposal_networks\.0\S* is not finite"):
        counted(pipeline, (*range(245, 250), 250), set(range(245, 251)))
