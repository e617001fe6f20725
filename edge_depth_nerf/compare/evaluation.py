"""Evaluates a model: on random pixels, cheaply and often, and on whole views, held out and from beside the path.

Host-facing. Masks and metrics of whole views are those of `ns-eval`, the same for all methods.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from edge_depth_nerf.base.files import read_distance_png, read_image, write_json, write_png
from edge_depth_nerf.compare.figures import ANGLE_EDGES_DEG, DISTANCE_EDGES_M, BinnedErrors, affine_fitted
from edge_depth_nerf.method.edges import EdgeRecall, depth_edges_found, picture_edges_found
from edge_depth_nerf.method.metrics import (
    LEAST_SQUARED_ERROR,
    DepthErrors,
    masked_flip,
    masked_lpips,
    masked_psnr,
    masked_ssim,
)
from edge_depth_nerf.plugin.dataset import FisheyeDepthDataset
from edge_depth_nerf.plugin.detail import detail_shown
from edge_depth_nerf.plugin.evaluation import evaluated
from edge_depth_nerf.plugin.model import EdgeDepthNerfModel
from edge_depth_nerf.report.compared_views import BY_VIEW

PIXELS_PER_VIEW = 3000
MOST_PIXELS = 20_000
"""Over all views; so many take about a second on one core."""
MOST_TRAINED_VIEWS, MOST_TRAINED_PIXELS = 10, 10_000
"""Of training pictures, whose PSNR says how much has been learned at all."""
COLOURS = {"psnr": "image", "truth_psnr": "truth_rgb"}
DISTANCES = {name: f"{name}_distance_m" for name in ("lidar", "truth", "beams")}


@dataclass(frozen=True, eq=False)
class EvaluatedView:
    """A view to render, with what it is evaluated by."""

    number: int
    """Of the held-out picture whose lens and mask it has."""
    camera: Cameras
    batch: dict[str, Any]
    """As the dataset gives it."""


@dataclass(frozen=True, eq=False)
class ChosenPixels:
    """Some pixels of a view with what they are evaluated by."""

    indices: Tensor
    """n×3: picture, row, column."""
    known: dict[str, Tensor]
    """By the dataset's names: colours n×3, distances n×1 metres."""


def _chosen(
    view: int, usable: Tensor, most: int, generator: torch.Generator, maps: dict[str, Any]
) -> list[ChosenPixels]:
    """Random pixels of a view where it is usable, with their values in the maps that there are; none without any."""
    at = usable.nonzero()
    at = at[torch.randperm(len(at), generator=generator)[: max(1, most)]]
    row, column = at.T
    known = {name: values[row, column] for name, values in maps.items() if values is not None}
    return [ChosenPixels(torch.cat([torch.full((len(at), 1), view), at], dim=1), known)] if len(at) else []


def main_views(dataset: FisheyeDepthDataset) -> list[int]:
    """Give the numbers of the views of cameras that are trained on; of all, if no such camera has any."""
    return [each for each in range(len(dataset)) if each not in dataset.of_held_out_cameras] or [*range(len(dataset))]


def choose_pixels(
    dataset: FisheyeDepthDataset,
    per_view: int = PIXELS_PER_VIEW,
    most: int = MOST_PIXELS,
    most_views: int | None = None,
) -> list[ChosenPixels]:
    """Choose random pixels inside the masks of a split's views; always the same ones.

    At most `per_view` of a view and `most` of all, of `most_views` spread evenly; None: of every view. A view that its
    mask hides has none. Views of cameras that are held out as a whole are chosen only if there are no others.
    """
    generator = torch.Generator().manual_seed(0)
    views = main_views(dataset)
    count = len(views) if most_views is None else min(len(views), most_views)
    chosen = []
    for view in (views[len(views) * (2 * number + 1) // (2 * count)] for number in range(count)):
        item = dataset[view]
        maps = {name: item.get(name) for name in (*COLOURS.values(), *DISTANCES.values())}
        chosen += _chosen(view, item["mask"][..., 0], min(per_view, most // count), generator, maps)
    return chosen


def evaluate_beams(pipeline: Any, most: int = MOST_PIXELS) -> dict[str, float]:
    """Evaluate training views by the LiDAR beams that were held out of everything (`process --holdout-beams`).

    Returns:
        The depth errors beams_abs_rel and so on, pooled over random LiDAR points of all training views, rendered from
        the poses that training ended with; nothing for a scene without such beams.
    """
    dataset = pipeline.datamanager.train_dataset
    if "beams" not in dataset.sources():
        return {}
    generator, chosen = torch.Generator().manual_seed(0), []
    for view in range(len(dataset)):
        true_m = torch.from_numpy(dataset.distance_m(view, "beams"))[..., None]
        usable = (true_m[..., 0] > 0) & torch.from_numpy(dataset.mask(view))
        chosen += _chosen(view, usable, most // len(dataset), generator, {DISTANCES["beams"]: true_m})
    return evaluate_pixels(pipeline, chosen, trained_on=True)


def evaluate_pixels(pipeline: Any, chosen: list[ChosenPixels], trained_on: bool = False) -> dict[str, float]:
    """Evaluate chosen pixels of a pipeline that trains, or has trained.

    Those of training pictures (`trained_on`) have the poses that training has now; their colours are neutral, without
    the pictures' exposures.

    Returns:
        psnr and, where it is known, truth_psnr against the picture without noise: means over views, dB; and the
        depth errors against LiDAR and truth, pooled over pixels.
    """
    model, manager = pipeline.model, pipeline.datamanager
    generator = manager.train_ray_generator if trained_on else manager.eval_ray_generator
    psnr: dict[str, list[float]] = {name: [] for name in COLOURS}
    errors = {name: DepthErrors() for name in DISTANCES}
    with evaluated(model):
        for view in chosen:
            parts = []
            for part in view.indices.split(model.config.eval_num_rays_per_chunk):
                rays = generator(part.to(model.device))
                if trained_on:
                    model.camera_optimizer.apply_to_raybundle(rays)
                parts.append(model(rays))
            for name in (name for name, key in COLOURS.items() if key in view.known):
                rgb = torch.cat([part["rgb"] for part in parts]).cpu().clamp(0, 1)
                squared = float((rgb - view.known[COLOURS[name]][:, :3]).square().mean())
                psnr[name].append(-10 * math.log10(max(squared, LEAST_SQUARED_ERROR)))
            distance_m = torch.cat([part["depth"][:, 0] for part in parts]).cpu()[None] * model.metres_per_unit
            everywhere = torch.ones_like(distance_m, dtype=torch.bool)
            for name in (name for name, key in DISTANCES.items() if key in view.known):
                errors[name].update(distance_m, view.known[DISTANCES[name]][None, :, 0], everywhere)
    figures = {name: float(np.mean(found)) for name, found in psnr.items() if found}
    for name, pool in errors.items():
        figures |= pool.compute(f"{name}_")
    return figures


def shifted_views(dataset: FisheyeDepthDataset) -> dict[str, list[Callable[[], EvaluatedView]]]:
    """The views from beside the path whose truth a rendered drive brings; none in recorded ones.

    Returns:
        By the metres that they lie sideways, what loads each. They have lens and mask of the first held-out picture
        of their camera.
    """
    scene, outputs = dataset.scene, dataset._dataparser_outputs
    to_scene = outputs.dataparser_transform.double()
    of_camera = {picture.camera: number for number, picture in reversed([*enumerate(dataset.pictures)])}

    def load(entry: dict[str, Any]) -> EvaluatedView:
        number = of_camera[entry["camera"]]
        pose = to_scene @ torch.tensor(entry["transform_matrix"], dtype=torch.float64)
        pose[:, 3] *= outputs.dataparser_scale
        camera = dataset.cameras[number : number + 1]
        camera.camera_to_worlds = pose[None].to(camera.camera_to_worlds)
        rgb = read_image(scene.folder / entry["truth_rgb_file_path"]).astype(np.float32) / 255
        distance_m = read_distance_png(scene.folder / entry["truth_distance_file_path"])
        return EvaluatedView(
            number,
            camera,
            {
                "image": torch.from_numpy(rgb),
                "mask": torch.from_numpy(dataset.mask(number))[..., None],
                "truth_distance_m": torch.from_numpy(distance_m)[..., None],
            },
        )

    return {
        metres: [partial(load, entry) for entry in entries if entry["camera"] in of_camera]
        for metres, entries in scene.meta.get("shifted_views", {}).items()
    }


class ViewEvaluator:
    """Evaluates whole views, one after the other."""

    def __init__(self, pipeline: Any, on_view: Callable[[], None]) -> None:
        """Take a pipeline; `on_view` is called after each view."""
        self.pipeline = pipeline
        self.model: EdgeDepthNerfModel = pipeline.model
        self.on_view = on_view
        self._by_view: dict[int, dict[str, float]] = {}

    def held_out(self, folder: Path) -> tuple[dict[str, float], dict[str, list[dict[str, float]]]]:
        """Evaluate all held-out views; colours and distance of each are saved in a folder, as `ns-eval` names them.

        The figures of each view are saved there, too, in by_view.json.

        Returns:
            The figures of `ns-eval` and, under affine_… and truth_affine_…, those after a colour fit; masked_flip,
            edge_recall and so on; under camera_… the same of the cameras that are held out as a whole, which the
            others leave out unless these are all; and the bins by_angle_deg and by_distance_m, against ground truth
            where it is known, else against picture and LiDAR.
        """
        dataset = self.pipeline.datamanager.eval_dataset
        by_angle, by_distance = BinnedErrors(ANGLE_EDGES_DEG), BinnedErrors(DISTANCE_EDGES_M)

        def save(view: EvaluatedView, rgb: Tensor, distance_m: Tensor, images: dict[str, Tensor]) -> None:
            for name in ("img", "distance"):
                _save(images[name], folder / f"eval_{name}_{view.number:04d}.png")

        def look(view: EvaluatedView, rgb: Tensor, distance_m: Tensor, images: dict[str, Tensor]) -> None:
            save(view, rgb, distance_m, images)
            number, batch, mask = view.number, view.batch, view.batch["mask"][..., 0].cpu()
            target = batch.get("truth_rgb", batch["image"])[..., :3].cpu()
            true_m = batch.get("truth_distance_m", batch.get("lidar_distance_m"))
            true_m = None if true_m is None else true_m[..., 0].cpu()
            cos_theta = dataset.scene.rays(dataset.pictures[number]).cos_theta
            angle_deg = torch.rad2deg(torch.from_numpy(np.arccos(np.clip(cos_theta, -1, 1))))
            by_angle.update(angle_deg, mask, rgb, target, distance_m, true_m)
            if true_m is not None:
                by_distance.update(true_m, mask, rgb, target, distance_m, true_m)

        main, beside = main_views(dataset), dataset.of_held_out_cameras
        figures = self._mean(self._held_out_views(main), look)
        if beside:
            # they were evaluated above if there are no others
            of_cameras = figures if {*main} == beside else self._mean(self._held_out_views(beside), save)
            figures |= {f"camera_{name}": value for name, value in of_cameras.items()}
        write_json(folder / BY_VIEW, self._by_view)
        return figures, {"by_angle_deg": by_angle.compute(), "by_distance_m": by_distance.compute()}

    def with_detail(
        self, folder: Path, beside: dict[str, list[Callable[[], EvaluatedView]]] | None = None
    ) -> dict[str, float]:
        """Evaluate all held-out views, and those beside the path, with the detail of training pictures.

        The colours of each held-out view are saved in a folder, as eval_detail_0000.png and so on.

        Returns:
            The figures of colours inside the mask: detail_masked_psnr, detail_truth_masked_psnr,
            detail_shifted_1m_masked_psnr, and so on. Distances are the same as without.
        """

        def look(view: EvaluatedView, rgb: Tensor, distance_m: Tensor, images: dict[str, Tensor]) -> None:
            _save(rgb, folder / f"eval_detail_{view.number:04d}.png")

        with detail_shown(True):
            main = main_views(self.pipeline.datamanager.eval_dataset)
            found = self._mean(self._held_out_views(main), look) | self.shifted(beside or {})
        return {f"detail_{name}": value for name, value in found.items() if "masked_" in name}

    def _held_out_views(self, wanted: Collection[int]) -> Iterator[EvaluatedView]:
        loader = enumerate(self.pipeline.datamanager.fixed_indices_eval_dataloader)
        return (EvaluatedView(number, camera, batch) for number, (camera, batch) in loader if number in wanted)

    def shifted(self, views: dict[str, list[Callable[[], EvaluatedView]]]) -> dict[str, float]:
        """Evaluate views beside the path against their ground truth, inside the mask: shifted_1m_masked_psnr etc.

        No figure reads what lies outside the mask, so it is not rendered.
        """
        figures: dict[str, float] = {}
        for metres, chosen in views.items():
            found, errors, edges = [], DepthErrors(), EdgeRecall()
            with evaluated(self.model):
                for view in (load() for load in chosen):
                    found.append(self._inside_mask(view, errors, edges))
                    self.on_view()
            pooled = errors.compute("truth_") | edges.compute()
            figures |= {f"shifted_{metres}m_{name}": value for name, value in {**_means(found), **pooled}.items()}
        return figures

    def _inside_mask(self, view: EvaluatedView, errors: DepthErrors, edges: EdgeRecall) -> dict[str, float]:
        """Render the pixels of a view inside its mask; its figures there, and what is pooled added to the others."""
        model, mask, target = self.model, view.batch["mask"][..., 0].cpu(), view.batch["image"][..., :3].cpu()
        rgb, distance_m = torch.zeros(*mask.shape, 3), torch.zeros(mask.shape)
        # as a picture of one row
        rays = model.rays_of_view(view.camera.to(model.device))[mask.to(model.device)].reshape((1, int(mask.sum())))
        outputs = model.get_outputs_for_camera_ray_bundle(rays)
        rgb[mask] = outputs["rgb"][0].cpu().clamp(0, 1)
        distance_m[mask] = outputs["depth"][0, :, 0].cpu() * model.metres_per_unit
        true_m = view.batch["truth_distance_m"][..., 0].cpu()
        errors.update(distance_m, true_m, mask)
        fitted = affine_fitted(rgb, target, mask)
        edges.update("edge_recall", picture_edges_found(fitted, target, mask))
        edges.update("truth_depth_edge_recall", depth_edges_found(distance_m, true_m, mask))
        figures = {
            "masked_psnr": float(masked_psnr(rgb, target, mask)),
            "masked_ssim": float(masked_ssim(rgb, target, mask)),
            "affine_masked_psnr": float(masked_psnr(fitted, target, mask)),
        }
        lpips = model.lpips.load(model.device)
        if lpips is not None:
            device = model.device
            figures["masked_lpips"] = float(masked_lpips(rgb.to(device), target.to(device), mask.to(device), lpips))
        return figures

    def _mean(self, views: Iterator[EvaluatedView], look: Callable[..., None]) -> dict[str, float]:
        """Means over views of the model's own figures and of those after a colour fit.

        Depth errors and edges are pooled.
        """
        model, found, edges = self.model, [], EdgeRecall()
        model.evaluation.reset()
        with evaluated(model):
            for view in views:
                outputs = model.get_outputs_for_camera(view.camera.to(model.device))
                figures, images = model.get_image_metrics_and_images(outputs, view.batch)
                rgb = outputs["rgb"].clamp(0, 1).cpu()
                mask = view.batch["mask"][..., 0].cpu()
                for prefix, key in (("", "image"), ("truth_", "truth_rgb")):
                    if key in view.batch:
                        target = view.batch[key][..., :3].cpu()
                        fitted = affine_fitted(rgb, target, mask)
                        figures[f"{prefix}affine_masked_psnr"] = float(masked_psnr(fitted, target, mask))
                        if find_spec("flip_evaluator"):
                            figures[f"{prefix}masked_flip"] = float(masked_flip(rgb, target, mask))
                        edges.update(f"{prefix}edge_recall", picture_edges_found(fitted, target, mask))
                distance_m = outputs["depth"][..., 0].cpu() * model.metres_per_unit
                of_view = self._by_view[view.number] = dict(figures)
                for name in ("lidar", "truth"):
                    if (true_m := view.batch.get(DISTANCES[name])) is not None:
                        true_m = true_m[..., 0].cpu()
                        edges.update(f"{name}_depth_edge_recall", depth_edges_found(distance_m, true_m, mask))
                        errors = DepthErrors()
                        errors.update(distance_m, true_m, mask)
                        of_view |= errors.compute(f"{name}_")
                look(view, rgb, distance_m, images)
                found.append(figures)
                self.on_view()
        return _means(found) | model.evaluation.pooled() | edges.compute()


def _save(colours: Tensor, path: Path) -> None:
    """Save colours of 0 to 1 as a PNG."""
    write_png(path, (colours.clamp(0, 1).cpu().numpy() * 255).round().astype(np.uint8))


def _means(found: list[dict[str, float]]) -> dict[str, float]:
    """Means over views of those figures whose mean is finite."""
    means = {name: float(np.mean([figures[name] for figures in found])) for name in (found[0] if found else {})}
    return {name: value for name, value in means.items() if math.isfinite(value)}
