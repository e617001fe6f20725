"""A trained model as a scanner sees it: how far rays go, and how true that is along a scanner's own. Host-facing."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from nerfstudio.cameras.rays import RayBundle
from numpy.typing import NDArray
from torch import Tensor

from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.cameras.transforms import rigid
from edge_depth_nerf.lidar.roughness import roughness
from edge_depth_nerf.method.metrics import EVALUATED_RANGE_M
from edge_depth_nerf.scene.reader import SceneFolder, ScenePicture
from edge_depth_nerf.scene.sweeps import SceneScanner, SceneSweep, SweepRays, scanners_of

MOST_SWEEPS = 10
MOST_RAYS = 30_000
"""Of a sweep, for figures."""
FOLIAGE = 0.02
"""Rays with a larger roughness hit leaves, fences or outlines; others hit something solid."""
PARTS = {
    "distance_m": (EVALUATED_RANGE_M[0], 10.0, 20.0, 40.0, EVALUATED_RANGE_M[1]),
    "elevation_deg": (-90.0, -8.0, -3.0, 0.0, 90.0),
    "roughness": (0.0, FOLIAGE, np.inf),
}
"""Edges of the parts that rays are told apart by."""
WITHIN_M = np.geomspace(0.01, 10, 13)
"""Errors whose shares are kept."""
_PIXEL_AREA = 1e-6
"""Of a beam at distance 1; nerfacto does not use it."""


@dataclass(frozen=True)
class SceneToModel:
    """Transform from a scene to the coordinates that its model was trained in."""

    rotation: Float64[np.ndarray, "3 3"]
    shift_m: Float64[np.ndarray, "3"]
    """Added after the rotation and before the scaling."""
    units_per_metre: float

    @classmethod
    def of(cls, outputs: Any, meta: Mapping[str, Any]) -> SceneToModel:
        """Take a dataparser's outputs on a scene, and its transforms.json, which nerfstudio may have changed."""
        # of three rows or four
        applied = np.vstack((meta.get("applied_transform", np.eye(4))[:3], [0, 0, 0, 1])).astype(np.float64)
        transform = outputs.dataparser_transform.numpy().astype(np.float64) @ np.linalg.inv(applied)
        scale = float(outputs.dataparser_scale) / float(meta.get("applied_scale", 1.0))
        return cls(transform[:, :3], transform[:, 3], scale)

    def points(self, points_m: Float[np.ndarray, "*points 3"]) -> Float64[np.ndarray, "*points 3"]:
        """Turn places in the scene (metres) into places in the model's coordinates."""
        return self.units_per_metre * (points_m @ self.rotation.T + self.shift_m)

    def poses(self, camera_to_scene: Float64[np.ndarray, "n 4 4"]) -> Float64[np.ndarray, "n 4 4"]:
        """Turn poses in the scene (metres) into poses in the model's coordinates."""
        return rigid(self.rotation @ camera_to_scene[:, :3, :3], self.points(camera_to_scene[:, :3, 3]))


@dataclass(frozen=True, eq=False)
class Cast:
    """What rays meet."""

    distance_m: Float32[np.ndarray, "*rays"]
    """Where half of the light that is stopped is stopped."""
    hit: Float32[np.ndarray, "*rays"]
    """The share of the light that is stopped, 0 to 1."""
    rgb: Float32[np.ndarray, "*rays 3"] | None = None
    """Colours, 0 to 1, if they were asked for."""


class Caster:
    """Casts rays into a trained model."""

    def __init__(self, model: Any, to_model: SceneToModel) -> None:
        """Take nerfstudio's model, ours or nerfacto, and the scene's place in it."""
        self._model, self._to_model = model, to_model

    @torch.no_grad()
    def cast(
        self,
        origin_m: Float[np.ndarray, "*rays 3"],
        direction: Float[np.ndarray, "*rays 3"],
        reach_m: float | None = None,
        colours: bool = False,
    ) -> Cast:
        """Cast rays from places in the scene (metres) along unit vectors in the scene.

        They begin at the model's near plane and end at its far plane; with `reach_m` they begin at their origins, end
        after so many metres, and meet no sky. Colours take a third more time.
        """
        shape = direction.shape[:-1]
        flat = [each.reshape(1, -1, 3) for each in (origin_m, direction)]
        place = self._to_model
        given = (
            torch.from_numpy(each.astype(np.float32)) for each in (place.points(flat[0]), flat[1] @ place.rotation.T)
        )
        origins, directions = (each.to(self._model.device) for each in given)
        one = origins.new_ones(*origins.shape[:-1], 1)
        rays = RayBundle(origins, directions, _PIXEL_AREA * one, torch.zeros_like(one, dtype=torch.long))
        rays.metadata = {"directions_norm": one}
        if reach_m is not None:
            rays.nears, rays.fars = torch.zeros_like(one), one * reach_m * place.units_per_metre
        outputs = self._model.get_outputs_for_camera_ray_bundle(rays) if colours else self._lengths(rays)
        depth, hit = (outputs[name].reshape(shape).float().cpu().numpy() for name in ("depth", "accumulation"))
        rgb = outputs["rgb"].reshape(*shape, 3).float().cpu().numpy() if colours else None
        return Cast(depth / np.float32(place.units_per_metre), hit, rgb)

    def _lengths(self, rays: RayBundle) -> dict[str, Tensor]:
        """The model's depth and accumulation, without its colours."""
        model, most = self._model, self._model.config.eval_num_rays_per_chunk
        found: list[tuple[Tensor, Tensor]] = []
        for first in range(0, len(rays), most):
            part = rays.get_row_major_sliced_ray_bundle(first, first + most)
            bounded = part if model.collider is None else model.collider(part)
            samples, _, _ = model.proposal_sampler(bounded, density_fns=model.density_fns)
            weights = samples.get_weights(model.field.get_density(samples)[0])
            depth = model.renderer_depth(weights=weights, ray_samples=samples)
            found.append((depth, model.renderer_accumulation(weights=weights)))
        depth, hit = (torch.cat(each) for each in zip(*found, strict=True))
        return {"depth": depth, "accumulation": hit}

    def cast_at(self, rays: SweepRays, chosen: NDArray[np.intp]) -> Float32[np.ndarray, "chosen"]:
        """Give the rendered distance along some rays of a sweep, metres."""
        return self.cast(rays.origin_m[chosen].astype(np.float64), rays.direction[chosen].astype(np.float64)).distance_m


def errors(measured_m: Float[np.ndarray, "rays"], rendered_m: Float[np.ndarray, "rays"]) -> dict[str, float]:
    """Give figures of rendered distances along rays whose length a scanner measured.

    far_25: the share of rays that are rendered more than 25 % too long; short_25: whose measured length is more than
    25 % above the rendered one.
    """
    rendered_m = rendered_m.astype(np.float64)
    error_m, ratio = np.abs(rendered_m - measured_m), rendered_m / measured_m
    return {
        "rays": float(len(error_m)),
        "median_m": float(np.median(error_m)),
        "p95_m": float(np.quantile(error_m, 0.95)),
        "within_10_cm": float((error_m <= 0.1).mean()),
        "within_30_cm": float((error_m <= 0.3).mean()),
        "abs_rel": float((error_m / measured_m).mean()),
        "delta_1_25": float(((ratio < 1.25) & (ratio > 1 / 1.25)).mean()),
        **{f"far_{percent}": float((ratio > 1 + percent / 100).mean()) for percent in (10, 25)},
        **{f"short_{percent}": float((ratio < 1 / (1 + percent / 100)).mean()) for percent in (10, 25)},
    }


def held_out_sweeps(
    scanner: SceneScanner, kinds: Sequence[str] = ("sweeps", "beams")
) -> Iterator[tuple[str, SceneSweep, SweepRays, Bool[np.ndarray, "rays"]]]:
    """Give what no training saw of a scanner: "sweeps" that are held out, and held-out "beams" of the others.

    Of each kind at most `MOST_SWEEPS`, spread over the drive; each with its rays, and which of them count.
    """
    for kind in kinds:
        held_out = kind == "sweeps"
        sweeps = [sweep for sweep in scanner.sweeps if sweep.held_out == held_out]
        for sweep in (sweeps[place] for place in spread_over(len(sweeps), MOST_SWEEPS)):
            rays = sweep.read()
            counts = np.ones(len(rays.ring), bool) if held_out else rays.held_out
            if counts.any():
                yield kind, sweep, rays, counts


def some_of(counts: Bool[np.ndarray, "rays"]) -> NDArray[np.intp]:
    """Give the numbers of rays that count, of too many always the same ones."""
    chosen = np.flatnonzero(counts)
    return np.random.default_rng(0).choice(chosen, MOST_RAYS, replace=False) if len(chosen) > MOST_RAYS else chosen


def points_within(
    picture: ScenePicture, usable: Bool[np.ndarray, "h w"], points_m: Float[np.ndarray, "points 3"]
) -> NDArray[np.intp]:
    """Give the numbers of the points that lie inside a picture's mask, hidden there or not."""
    inside, row, column = picture.pixels_of(points_m)
    return inside[usable[row, column]]


def in_pictures(scene: SceneFolder, sweep: SceneSweep, rays: SweepRays) -> Bool[np.ndarray, "rays"]:
    """Say which points of a sweep lie inside the mask of a picture of its frame, hidden there or not.

    Cameras that training saw nothing of do not count.
    """
    found, unseen = np.zeros(len(rays.ring), bool), scene.held_out_cameras()
    for picture in scene.pictures:
        if sweep.frame is not None and picture.frame == sweep.frame and picture.camera not in unseen:
            found[points_within(picture, scene.usable(picture), rays.points_m)] = True
    return found


@dataclass(frozen=True, eq=False)
class HeldOutRays:
    """The rays of a scene's held-out sweeps that end inside a picture of their frame, 1 to 60 m."""

    origin_m: Float32[np.ndarray, "rays 3"]
    """In the scene, as `direction`."""
    direction: Float32[np.ndarray, "rays 3"]
    distance_m: Float32[np.ndarray, "rays"]
    elevation_deg: Float[np.ndarray, "rays"]
    """Above the scanner's xy plane."""
    roughness: Float64[np.ndarray, "rays"]

    @classmethod
    def of(cls, scene: SceneFolder) -> HeldOutRays | None:
        """Read them; None if there are none.

        Raises:
            FileNotFoundError, InputError: the file of a sweep is missing or broken.
        """
        parts: list[tuple[NDArray, ...]] = []
        for scanner in scanners_of(scene.meta, scene.path).values():
            for _, sweep, rays, counts in held_out_sweeps(scanner, ["sweeps"]):
                within = (rays.distance_m >= EVALUATED_RANGE_M[0]) & (rays.distance_m <= EVALUATED_RANGE_M[1])
                chosen = some_of(counts & within & in_pictures(scene, sweep, rays))
                along = rays.direction[chosen]
                elevation_deg = np.rad2deg(np.arcsin(np.clip(along @ sweep.scanner_to_scene[:3, 2], -1, 1)))
                rough = roughness(rays.distance_m, rays.ring, rays.offset_s)[chosen]
                parts.append((rays.origin_m[chosen], along, rays.distance_m[chosen], elevation_deg, rough))
        if not any(len(each[0]) for each in parts):
            return None
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def evaluate_scans(pipeline: Any, rays: HeldOutRays) -> tuple[dict[str, float], dict[str, list[dict[str, Any]]]]:
    """Hold a trained pipeline against recorded rays.

    Returns:
        The figures of `errors`, as scan_median_m and so on, of foliage as scan_foliage_…; and, as scan_parts, the same
        in the parts of `PARTS`, each with by, low and high, and as scan_within the share of rays whose error is at
        most error_m.
    """
    dataset = pipeline.datamanager.train_dataset
    caster = Caster(pipeline.model, SceneToModel.of(dataset._dataparser_outputs, dataset.scene.meta))
    found_m = caster.cast(rays.origin_m.astype(np.float64), rays.direction.astype(np.float64)).distance_m
    true_m = rays.distance_m
    by = {"distance_m": true_m, "elevation_deg": rays.elevation_deg, "roughness": rays.roughness}
    parts: list[dict[str, Any]] = []
    for name, edges in PARTS.items():
        for low, high in itertools.pairwise(edges):
            part = (by[name] >= low) & (by[name] < high)
            if part.any():
                parts.append({"by": name, "low": low, "high": min(high, 1e9)} | errors(true_m[part], found_m[part]))
    figures = errors(true_m, found_m)
    foliage = by["roughness"] >= FOLIAGE
    if foliage.any():
        figures |= {f"foliage_{name}": value for name, value in errors(true_m[foliage], found_m[foliage]).items()}
    off_m = np.abs(found_m - true_m)
    shares: list[dict[str, Any]] = [
        {"error_m": float(most_m), "share": float((off_m <= most_m).mean())} for most_m in WITHIN_M
    ]
    return {f"scan_{name}": value for name, value in figures.items()}, {"scan_parts": parts, "scan_within": shares}
