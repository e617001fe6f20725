"""Scans of a trained model: which rays come back, and how true the scans are. Host-facing."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.numbers import spread_over
from edge_depth_nerf.films.intensities import Intensities
from edge_depth_nerf.films.scan_files import Scan
from edge_depth_nerf.jobs.runs import newest_checkpoint
from edge_depth_nerf.lidar.patterns import ScanPattern, pattern_of_scan
from edge_depth_nerf.lidar.sweeps import MIN_RANGE_M
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.plugin.scanning import MOST_RAYS, Cast, Caster, errors, held_out_sweeps, in_pictures, some_of
from edge_depth_nerf.scene.reader import SceneFolder
from edge_depth_nerf.scene.sweeps import UNKNOWN_RING, SceneScanner, SceneSweep, SweepRays

CHECKPOINTS = "nerfstudio_models"
"""nerfstudio's folder of them, beside config.yml."""
HIT = 0.5
"""A ray that stops less than this share of its light hits nothing."""
_LOOKED_AT = 16
"""So many sweeps are searched for one with all rings."""
MOST_LEARNED_SWEEPS = 4
"""For learning which rays come back, `MOST_RAYS` of all together."""


def load_model(load_config: Path, scene: Path) -> Any:
    """Load a training's model, as nerfstudio does."""
    from nerfstudio.utils.eval_utils import eval_setup

    def of_scene(config: Any) -> Any:
        config.pipeline.datamanager.data = scene
        config.pipeline.datamanager.dataparser.data = scene
        # wherever the training lies now, and from whichever folder it was started
        config.relative_model_dir = load_config.parent.absolute() / CHECKPOINTS
        return config

    _, pipeline, _, _ = eval_setup(load_config, test_mode="inference", update_config_callback=of_scene)
    return pipeline.model


def check_checkpoint(load_config: Path) -> None:
    """Raise an InputError if there is no whole checkpoint beside a training's config.yml."""
    folder = load_config.parent / CHECKPOINTS
    if newest_checkpoint(folder) is None:
        raise InputError(
            f"{folder}: has no whole checkpoint (step-….ckpt), which a training writes beside its config.yml. Train "
            "on, or copy the whole folder of the training."
        )


def scan(caster: Caster, pattern: ScanPattern, time_s: float, scanner: Trajectory) -> tuple[Cast, NDArray, NDArray]:
    """Cast all rays of a turn at `time_s` while the scanner moves.

    Returns:
        What they meet, [rings, firings]; and their origins [firings, 3] and directions [rings, firings, 3] in the
        scene.
    """
    poses = scanner.at(time_s + pattern.offset_s)
    directions = np.einsum("fij,rfj->rfi", poses[:, :3, :3], pattern.directions)
    origins = poses[:, :3, 3]
    return caster.cast(np.broadcast_to(origins, directions.shape), directions), origins, directions


def in_scanner(sweep: SceneSweep, rays: SweepRays, scanner: Trajectory) -> Float[np.ndarray, "rays 3"]:
    """Give a sweep's points in the scanner's frame at each point's own time."""
    poses = scanner.at(sweep.time_s + rays.offset_s.astype(np.float64))
    along = np.einsum("nji,nj->ni", poses[:, :3, :3], rays.direction.astype(np.float64))
    return along * rays.distance_m[:, None].astype(np.float64)


def recorded_pattern(scanner: SceneScanner) -> ScanPattern | None:
    """Find the pattern of a drive's own scanner, from the sweep with most rings; None if none has the highest one.

    Raises:
        InputError: the sweep's points do not lie at regular azimuths.
    """

    def whole(places: Iterable[int]) -> Iterator[tuple[SceneSweep, SweepRays]]:
        for sweep in (scanner.sweeps[place] for place in places):
            rays = sweep.read()
            if rays.ring.min(initial=UNKNOWN_RING + 2) == 0:
                yield sweep, rays

    some = whole(spread_over(len(scanner.sweeps), _LOOKED_AT))
    found = max(some, key=lambda each: len(np.unique(each[1].ring)), default=None)
    found = found or next(whole(range(len(scanner.sweeps))), None)
    if len(scanner.sweeps) < 2 or found is None:
        return None
    sweep, rays = found
    points_m = in_scanner(sweep, rays, scanner.trajectory)
    return pattern_of_scan(points_m, rays.ring, scanner.timing, str(sweep.path))


def came_back(
    sweep: SceneSweep, rays: SweepRays, pattern: ScanPattern, scanner: Trajectory
) -> Bool[np.ndarray, "rings firings"]:
    """Say which rays of the recorded pattern gave a point in a sweep."""
    points_m = in_scanner(sweep, rays, scanner)
    found = np.zeros((len(pattern.elevation_rad), pattern.firings), bool)
    known = (rays.ring >= 0) & (rays.ring < len(found))
    found[rays.ring[known], pattern.columns(points_m[known])] = True
    # firings are not as regular as the pattern: one between two that came back did, too
    return found | (np.roll(found, 1, axis=1) & np.roll(found, -1, axis=1))


def _has_rings(rays: SweepRays) -> bool:
    """Whether it is known which ring measured each point: else nothing tells which rays did not come back."""
    return bool(rays.ring.min(initial=0) > UNKNOWN_RING)


class RayDrop:
    """Which rays a scanner gets back, learned from a drive's own: a logistic regression on what they meet."""

    def __init__(self, weights: NDArray[np.float64] | None = None) -> None:
        """Take what `learned` found; without it every ray that hits something comes back."""
        self._weights = weights

    @staticmethod
    def _features(cast: Cast) -> NDArray[np.float64]:
        hit, far = cast.hit.astype(np.float64), np.log(np.maximum(cast.distance_m, MIN_RANGE_M).astype(np.float64))
        return np.stack([np.ones_like(hit), hit, far, np.square(far), hit * far], axis=-1).astype(np.float64)

    @classmethod
    def learned(cls, cast: Cast, back: Bool[np.ndarray, "*rays"]) -> RayDrop:
        """Learn from rays, and which of them came back."""
        features, wanted = cls._features(cast).reshape(-1, 5), np.where(back.reshape(-1), 1.0, -1.0)
        if len(np.unique(wanted)) < 2:
            # all came back, or none: nothing tells them apart
            return cls()

        def loss(weights: NDArray) -> tuple[float, NDArray]:
            margin = wanted * (features @ weights)
            slope = -wanted / (1 + np.exp(np.clip(margin, -50, 50)))
            value = np.logaddexp(0, -margin).mean() + 1e-6 * weights @ weights
            return float(value), slope @ features / len(wanted) + 2e-6 * weights

        return cls(minimize(loss, np.zeros(5), jac=True, method="L-BFGS-B").x)

    def kept(self, cast: Cast, reach_m: float) -> Bool[np.ndarray, "*rays"]:
        """Say which rays come back from within the scanner's reach."""
        within = (cast.distance_m >= MIN_RANGE_M) & (cast.distance_m <= reach_m)
        if self._weights is None:
            return within & (cast.hit >= HIT)
        return within & (self._features(cast) @ self._weights > 0)


def learn_ray_drop(caster: Caster, scanner: SceneScanner, pattern: ScanPattern) -> RayDrop:
    """Learn from a drive's own sweeps which rays come back; only from those that the training saw."""
    training = [sweep for sweep in scanner.sweeps if not sweep.held_out]
    rng, casts, back = np.random.default_rng(0), [], []
    for sweep in (training[place] for place in spread_over(len(training), MOST_LEARNED_SWEEPS)):
        rays = sweep.read()
        if not _has_rings(rays):
            continue
        whole = came_back(sweep, rays, pattern, scanner.trajectory)
        rows, columns = (rng.integers(count, size=MOST_RAYS // MOST_LEARNED_SWEEPS) for count in whole.shape)
        poses = scanner.trajectory.at(sweep.time_s + pattern.offset_s)[columns]
        along = np.einsum("nij,nj->ni", poses[:, :3, :3], pattern.directions[rows, columns])
        casts.append(caster.cast(poses[:, :3, 3], along))
        back.append(whole[rows, columns])
    if not casts:
        return RayDrop()
    together = Cast(*(np.concatenate([getattr(each, name) for each in casts]) for name in ("distance_m", "hit")))
    return RayDrop.learned(together, np.concatenate(back))


def chamfer_m(points_m: Float[np.ndarray, "points 3"], others_m: Float[np.ndarray, "others 3"]) -> float:
    """Give the mean distance from a point of one scan to the nearest of the other, mean of both ways, metres."""
    ways = (KDTree(others_m).query(points_m)[0], KDTree(points_m).query(others_m)[0])
    return float(np.mean([way.mean() for way in ways]))


@dataclass(frozen=True, eq=False)
class LearnedScanner:
    """What is known of a drive's scanner in a trained scene; nothing but the scene if the drive has none."""

    caster: Caster
    pattern: ScanPattern | None = None
    """Its own."""
    ray_drop: RayDrop = field(default_factory=RayDrop)
    intensities: Intensities | None = None

    def render(self, pattern: ScanPattern, time_s: float, path: Trajectory) -> Scan:
        """Render the scan of a pattern at `time_s` while the scanner moves along a path."""
        cast, origins, directions = scan(self.caster, pattern, time_s, path)
        # in the order of time: firing by firing
        firing, ring = np.nonzero(self.ray_drop.kept(cast, pattern.reach_m).T)
        distance_m = cast.distance_m[ring, firing][:, None]
        intensity = None
        if self.intensities is not None and len(ring):
            # another scanner's rings say nothing
            known = ring if pattern is self.pattern else np.full_like(ring, UNKNOWN_RING)
            met_m = origins[firing] + directions[ring, firing] * distance_m
            intensity = self.intensities.at(met_m, known, distance_m[:, 0])
        points_m = (pattern.directions[ring, firing] * distance_m).astype(np.float32)
        return Scan(points_m, pattern.offset_s[firing].astype(np.float32), ring.astype(np.int16), intensity)


def evaluate(learned: LearnedScanner, scene: SceneFolder, scanner: SceneScanner) -> dict[str, dict[str, float]]:
    """Hold the model against what no training saw: held-out sweeps, and held-out beams of the others.

    Along each recorded ray, of at most `MOST_RAYS` a sweep, the rendered distance is compared with the measured one.

    Returns:
        Figures of `sweeps` and `beams`, where there are any, and the same of `…_in_pictures`, the rays that end inside
        a picture of their frame. With a pattern those of sweeps have also `drop_f1` (of rays that did not come back)
        and `chamfer_m` between the whole rendered scan and the recorded one. Where intensities are known, those of
        `sweeps_in_pictures` have also `intensity_error`, the mean error as a share of the mean difference of recorded
        intensities from their median.
    """
    lengths: dict[str, list[tuple[NDArray, NDArray]]] = {}
    more: list[dict[str, float]] = []
    bright: list[tuple[NDArray, NDArray]] = []
    for kind, sweep, rays, counts in held_out_sweeps(scanner):
        chosen = some_of(counts)
        both = rays.distance_m[chosen], learned.caster.cast_at(rays, chosen)
        shown = in_pictures(scene, sweep, rays)[chosen]
        for name, part in ((kind, slice(None)), (f"{kind}_in_pictures", shown)):
            lengths.setdefault(name, []).append((both[0][part], both[1][part]))
        if learned.intensities is not None and kind == "sweeps" and shown.any():
            asked = chosen[shown]
            met_m = rays.origin_m[asked] + rays.direction[asked] * both[1][shown][:, None]
            bright.append((rays.intensity[asked], learned.intensities.at(met_m, rays.ring[asked], both[1][shown])))
        if learned.pattern is not None and kind == "sweeps":
            more.append(_of_whole(learned, learned.pattern, scanner.trajectory, sweep, rays))
    together = {name: tuple(map(np.concatenate, zip(*each, strict=True))) for name, each in lengths.items()}
    found = {name: errors(*both) for name, both in together.items() if len(both[0])}
    if bright:
        recorded, rendered = map(np.concatenate, zip(*bright, strict=True))
        if usual := float(np.abs(recorded - np.median(recorded)).mean()):  # pyrefly: ignore[no-matching-overload]
            # pyrefly: ignore[unsupported-operation]
            found["sweeps_in_pictures"]["intensity_error"] = float(np.abs(rendered - recorded).mean()) / usual
    for key in ("drop_f1", "chamfer_m"):
        if of_scans := [each[key] for each in more if key in each]:
            found["sweeps"][key] = float(np.mean(of_scans))
    return found


def _of_whole(
    learned: LearnedScanner, pattern: ScanPattern, scanner: Trajectory, sweep: SceneSweep, rays: SweepRays
) -> dict[str, float]:
    cast, origins, directions = scan(learned.caster, pattern, sweep.time_s, scanner)
    kept = learned.ray_drop.kept(cast, pattern.reach_m)
    points_m = (origins[None] + directions * cast.distance_m[..., None])[kept]
    figures = {}
    if _has_rings(rays):
        lost, truly = ~kept, ~came_back(sweep, rays, pattern, scanner)
        figures["drop_f1"] = float(2 * (lost & truly).sum() / max(1, lost.sum() + truly.sum()))
    # a scan without points is no distance away
    return figures | {"chamfer_m": chamfer_m(points_m, rays.points_m)} if len(points_m) else figures
