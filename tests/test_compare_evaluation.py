"""Evaluation: on which pixels and views, and without a trace in the training."""

import math
from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from models import pipeline_of
from nerfstudio.engine.optimizers import Optimizers
from scenes import transforms, write_scene

from edge_depth_nerf.base.files import write_mask
from edge_depth_nerf.compare.evaluation import (
    ViewEvaluator,
    choose_pixels,
    evaluate_beams,
    evaluate_pixels,
    shifted_views,
)
from edge_depth_nerf.compare.figures import affine_fitted
from edge_depth_nerf.method.edges import EdgeRecall, depth_edges_found, picture_edges_found
from edge_depth_nerf.method.metrics import masked_psnr
from edge_depth_nerf.plugin.config import make_specifications, read_method_file
from edge_depth_nerf.plugin.evaluation import evaluated


def test_evaluation_leaves_no_trace_in_a_training(tmp_path):
    pipeline = pipeline_of(write_scene(tmp_path), depth_loss="edge", num_proposal_samples_per_ray=(8, 8))
    pipeline.datamanager.train_pixel_sampler.num_rays_per_batch = 32
    start = deepcopy(pipeline.state_dict())
    chosen = choose_pixels(pipeline.datamanager.eval_dataset, most=200)
    trained_on = choose_pixels(pipeline.datamanager.train_dataset, most=200)
    ends, figures, of_trained = [], [], []
    for evaluating in (False, True):
        pipeline.load_state_dict(start)
        pipeline.datamanager.train_pixel_sampler._drawn = pipeline.datamanager._surface_sampler._drawn = 0
        sampler = pipeline.model.proposal_sampler
        sampler._steps_since_update, sampler._step = 0, 0
        config = make_specifications(read_method_file())["edge-depth-nerf-lite"].config
        optimisers = Optimizers(deepcopy(config.optimizers), pipeline.get_param_groups())
        torch.manual_seed(0)
        pipeline.train()
        for step in range(16):
            sampler.set_anneal(0.5)
            sampler.step_cb(step)
            optimisers.zero_grad_all()
            torch.stack(list(pipeline.get_train_loss_dict(0)[1].values())).sum().backward()
            optimisers.optimizer_step_all()
            if evaluating and step in (11, 12, 13):
                figures.append(evaluate_pixels(pipeline, chosen))
                of_trained.append(evaluate_pixels(pipeline, trained_on, trained_on=True))
                assert pipeline.model.training
        ends.append(deepcopy(pipeline.state_dict()))
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    assert {"psnr", "truth_psnr", "lidar_abs_rel", "truth_abs_rel"} <= set(figures[0])
    assert figures[0] != figures[-1]
    assert of_trained[0]["psnr"] != figures[0]["psnr"] and of_trained[0] != of_trained[-1]


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    return pipeline_of(with_shifted_views(write_scene(tmp_path_factory.mktemp("scene"))))


def test_pixels_of_a_few_views_are_spread_evenly(pipeline):
    dataset = pipeline.datamanager.train_dataset
    every = [int(view.indices[0, 0]) for view in choose_pixels(dataset, per_view=2)]
    assert every == [*range(len(dataset))]
    few = choose_pixels(dataset, most=6, most_views=2)
    chosen = [int(view.indices[0, 0]) for view in few]
    assert len(few) == 2 and [len(view.indices) for view in few] == [3, 3]
    assert chosen == [len(dataset) // 4, 3 * len(dataset) // 4]


def test_a_view_without_a_usable_pixel_is_passed_over(tmp_path):
    scene = write_scene(tmp_path)
    with transforms(scene) as meta:
        write_mask(scene / "masks/none.png", np.zeros((28, 32), bool))
        for frame in meta["frames"]:
            if frame["file_path"] == meta["train_filenames"][2]:
                frame["mask_path"] = "masks/none.png"
    pipeline = pipeline_of(scene)
    chosen = choose_pixels(pipeline.datamanager.train_dataset)
    assert [int(view.indices[0, 0]) for view in chosen] == [0, 1, 3, 4, 5, 6, 7]
    assert math.isfinite(evaluate_pixels(pipeline, chosen, trained_on=True)["psnr"])


def test_the_pixels_are_always_the_same_and_inside_the_mask(pipeline):
    dataset = pipeline.datamanager.eval_dataset
    one, other = choose_pixels(dataset, most=40), choose_pixels(dataset, most=40)
    assert torch.equal(one[0].indices, other[0].indices)
    assert len(one) == len(dataset) and len(one[0].indices) == 40 // len(dataset)
    for view, chosen in enumerate(one):
        index, row, column = chosen.indices.T
        assert (index == view).all() and dataset.mask(view)[row, column].all()
        assert torch.equal(chosen.known["image"], dataset[view]["image"][row, column])


def with_shifted_views(scene):
    """Views where a held-out picture stands and beside it, with that picture's files as their truth."""
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            frame["camera"] = "only"
        held_out = next(frame for frame in meta["frames"] if frame["file_path"] == meta["test_filenames"][0])
        moved = np.array(held_out["transform_matrix"])
        moved[:3, 3] += [0.3, -0.2, 0.1]
        files = {key: held_out[key] for key in ("truth_rgb_file_path", "truth_distance_file_path")}
        meta["shifted_views"] = {
            "0": [{"camera": "only", "transform_matrix": held_out["transform_matrix"], **files}],
            "1": [
                {"camera": "only", "transform_matrix": moved.tolist(), **files},
                {"camera": "none there", "transform_matrix": moved.tolist(), **files},
            ],
        }
    return scene


def test_shifted_views_stand_where_the_scene_says(pipeline):
    dataset = pipeline.datamanager.eval_dataset
    views = shifted_views(dataset)
    assert [len(views[metres]) for metres in ("0", "1")] == [1, 1]
    same, beside = (views[metres][0]() for metres in ("0", "1"))
    assert torch.allclose(same.camera.camera_to_worlds[0], dataset.cameras[0].camera_to_worlds, atol=1e-6)
    offset = beside.camera.camera_to_worlds[0, :, 3] - dataset.cameras[0].camera_to_worlds[:, 3]
    metres = offset.norm() * dataset.metadata["metres_per_unit"]
    assert float(metres) == pytest.approx(np.linalg.norm([0.3, -0.2, 0.1]), abs=1e-5)
    assert same.batch["image"].shape == (28, 32, 3) and same.batch["mask"].shape == (28, 32, 1)
    assert (same.batch["truth_distance_m"] > 0).any()


def test_shifted_views_have_the_figures_of_the_whole_picture(pipeline, monkeypatch):
    """Only what lies inside the mask is rendered: the figures are those of a rendering of everything."""
    model, dataset = pipeline.model, pipeline.datamanager.eval_dataset
    rendered, original = [], model.forward
    monkeypatch.setattr(
        model, "forward", lambda ray_bundle: (rendered.append(len(ray_bundle)), original(ray_bundle))[1]
    )
    monkeypatch.setattr(model.config, "eval_num_rays_per_chunk", 100)
    views, told = shifted_views(dataset), []
    found = ViewEvaluator(pipeline, lambda: told.append(1)).shifted(views)
    assert len(told) == 2 and max(rendered) <= 100
    assert sum(rendered) == 2 * int(dataset.mask(0).sum()) < 2 * dataset.mask(0).size
    expected = {}
    with evaluated(model):
        for metres in views:
            view = views[metres][0]()
            model.evaluation.reset()
            outputs = model.get_outputs_for_camera(view.camera)
            figures, _ = model.get_image_metrics_and_images(outputs, view.batch)
            mask, target = view.batch["mask"][..., 0], view.batch["image"]
            fitted = affine_fitted(outputs["rgb"].clamp(0, 1), target, mask)
            figures["affine_masked_psnr"] = float(masked_psnr(fitted, target, mask))
            figures |= model.evaluation.pooled()
            distance_m, true_m = (
                outputs["depth"][..., 0] * model.metres_per_unit,
                view.batch["truth_distance_m"][..., 0],
            )
            edges = EdgeRecall()
            edges.update("edge_recall", picture_edges_found(fitted, target, mask))
            edges.update("truth_depth_edge_recall", depth_edges_found(distance_m, true_m, mask))
            expected |= {f"shifted_{metres}m_{name}": value for name, value in edges.compute().items()}
            kept = ("masked_", "affine_", "truth_")
            expected |= {f"shifted_{metres}m_{name}": value for name, value in figures.items() if name.startswith(kept)}
    assert {"shifted_1m_masked_psnr", "shifted_1m_masked_ssim", "shifted_0m_truth_abs_rel"} <= set(found)
    assert found == pytest.approx(expected, rel=1e-5) and found["shifted_0m_truth_pixels"] > 100


def test_training_views_are_evaluated_by_the_beams_that_were_held_out(pipeline, tmp_path, monkeypatch):
    assert evaluate_beams(pipeline) == {}
    scene = write_scene(tmp_path)
    with transforms(scene) as meta:
        for frame in meta["frames"]:
            frame["beams_file_path"] = frame["truth_distance_file_path"]
    pipeline = pipeline_of(scene)
    found = evaluate_beams(pipeline, most=200)
    count = len(pipeline.datamanager.train_dataset)
    assert found["beams_pixels"] <= 200 and found["beams_pixels"] > 0.5 * (200 // count) * count
    assert found == evaluate_beams(pipeline, most=200)
    # a model that renders what is there, from the poses that training ended with
    dataset, model = pipeline.datamanager.train_dataset, pipeline.model
    true_m = [torch.from_numpy(dataset.distance_m(view, "beams")) for view in range(count)]
    moved = []

    def exact(pixels):
        depth = torch.stack([true_m[view][row, column] for view, row, column in pixels.tolist()])
        return {"depth": depth[:, None] / model.metres_per_unit}

    monkeypatch.setattr(model, "forward", exact)
    monkeypatch.setattr(model.camera_optimizer, "apply_to_raybundle", moved.append)
    manager = SimpleNamespace(train_dataset=dataset, train_ray_generator=lambda pixels: pixels)
    assert evaluate_beams(SimpleNamespace(model=model, datamanager=manager), most=200)["beams_abs_rel"] < 1e-6
    assert len(moved) == count
