"""The prior (Eq. 5 to 7) on real dense truth: KITTI stereo 2015, with a network's maps.

    python -m benchmarks.quality.kitti_stereo --data FOLDER --output outputs/kitti_stereo

FOLDER has, as NAME.png or NAME.bin, `prediction` and `gt/disp_occ_0` (disparities, 16 bits, 1/256 px), `gt/obj_map`
(what moves) and `velodyne_points` (a raw sweep), all of 26 September 2011. The folder data of this repository on GitHub
has them: ziliHarvey/LiDAR-Guided-Boundary-Bleeding-Refinement-for-Depth-Map. Every second frame, from the second on, is
evaluated; the others (`--half a`) are for choices. Calibration uses sweeps alone. The ground truth is of many sweeps,
which scatter: `scatter` measures that by the planes of its surroundings, and the shares within 1 and 2 standard
deviations count it. Writes table.md and table.json.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import torch
from rich.progress import track
from scipy.ndimage import distance_transform_edt

from edge_depth_nerf.base.files import write_json, write_text
from edge_depth_nerf.cameras import Pinhole
from edge_depth_nerf.cameras.rays import rays
from edge_depth_nerf.lidar import project_points, transform_points
from edge_depth_nerf.lidar.scans import ScanFormat, read_scan
from edge_depth_nerf.lidar.trajectory import Trajectory
from edge_depth_nerf.lidar.world import sweep_in_world
from edge_depth_nerf.method.alignment import align
from edge_depth_nerf.method.integration import IntegrationOptions
from edge_depth_nerf.method.prior import PriorOptions, make_prior, ray_angles
from edge_depth_nerf.mono.calibration import combine, fit_of_drive, measure_frame, points_of_both

KEPT = Path(__file__).with_suffix(".json")
"""The figures of the page."""
FOCAL_PX, CENTRE, FOURTH = 721.5377, np.array([609.5593, 172.8540]), np.array([44.85728, 0.2163791, 0.002745884])
"""P_rect_02 of KITTI's calibration of that day; f times the stereo pair's base is its fourth column less that of 03."""
BASE_PX_M = 44.85728 + 339.5242
RECTIFY = [
    [0.9999239, 0.00983776, -0.007445048],
    [-0.009869795, 0.9999421, -0.004278459],
    [0.007402527, 0.004351614, 0.9999631],
]
VELO_TO_CAM = [
    [0.007533745, -0.9999714, -0.000616602, -0.004069766],
    [0.01480249, 0.0007280733, -0.9998902, -0.07631618],
    [0.9998621, 0.00752379, 0.01480755, -0.2717806],
    [0.0, 0.0, 0.0, 1.0],
]
CAMERA = Pinhole(width=1242, height=375, fx=FOCAL_PX, fy=FOCAL_PX, cx=CENTRE[0] + 0.5, cy=CENTRE[1] + 0.5)
VIEW = ray_angles(CAMERA, np.array([0.0, -1.0, 0.0]))
EVERYWHERE = np.ones((CAMERA.height, CAMERA.width), bool)
OURS = PriorOptions()
LITERAL = PriorOptions(align="none", motion=False, sigma_mode="combined", integration=IntegrationOptions())
NEAR_PX, EDGE = 4.0, 1.1
"""So near a LiDAR point is near; an edge is where ground truth within two pixels differs by this factor."""
FARTHEST_M = 80.0
BINS_M = (6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0, 80.0)


def lidar_map(path: Path, one_of: int) -> np.ndarray:
    """Distances of a sweep's rings, or of one of so many, in the picture."""
    sweep = read_scan(path, ScanFormat())
    points = sweep.points_m.numpy()
    elevation = np.degrees(np.arctan2(points[:, 2], np.linalg.norm(points[:, :2], axis=-1)))
    kept = torch.from_numpy(np.round((2 - elevation) / 26.8 * 63).astype(int) % one_of == 0)
    sweep = replace(sweep, points_m=sweep.points_m[kept], reflectance=sweep.reflectance[kept])
    still = Trajectory(np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)))
    scan = sweep_in_world(sweep, 0.5, np.eye(4), still, None)
    rectify, shift = np.eye(4), np.eye(4)
    rectify[:3, :3] = RECTIFY
    shift[:3, 3] = [*(FOURTH[:2] - CENTRE * FOURTH[2]) / FOCAL_PX, FOURTH[2]]
    in_camera = transform_points(torch.from_numpy(shift @ rectify @ np.array(VELO_TO_CAM)), scan.points_m)
    return project_points(in_camera.float(), CAMERA, spacing_m=scan.spacing_m).distance_m.numpy()


def read(folder: Path, name: str, one_of: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """LiDAR, network and ground truth, metres along the ray, and what moves."""
    maps = [lidar_map(folder / "velodyne_points" / f"{name}.bin", one_of)]
    for kind in ("prediction", "gt/disp_occ_0"):
        disparity = cv2.imread(str(folder / kind / f"{name}.png"), cv2.IMREAD_UNCHANGED) / np.float32(256)
        distance = BASE_PX_M / np.maximum(disparity, 1e-3) / rays(CAMERA).cos_theta
        maps.append(np.where(disparity > 0, distance, 0).astype(np.float32))
    moving = cv2.imread(str(folder / "gt/obj_map" / f"{name}.png"), cv2.IMREAD_UNCHANGED) > 0
    return maps[0], maps[1], maps[2], moving


def scatter(truth: np.ndarray) -> np.ndarray:
    """Relative difference of ground truth from the plane through what is within 5 px of it; NaN if unknown."""
    known = (truth > 0).astype(np.float64)
    inverse = np.where(truth > 0, 1 / np.maximum(truth, 1e-3), 0)
    y, x = np.mgrid[-1 : 1 : truth.shape[0] * 1j, -1 : 1 : truth.shape[1] * 1j]
    terms = np.stack([x, y, np.ones_like(x)])

    def around(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, -1, (11, 11), normalize=False, borderType=cv2.BORDER_CONSTANT) - values

    left = np.array([[around(known * a * b) for a in terms] for b in terms]).transpose(2, 3, 0, 1)
    right = np.array([around(inverse * a) for a in terms]).transpose(1, 2, 0)
    enough = (known > 0) & (left[..., 2, 2] >= 20) & (np.linalg.cond(left) < 1e12)
    found = np.full(truth.shape, np.nan)
    plane = np.linalg.solve(left[enough], right[enough][..., None])[..., 0]
    found[enough] = np.abs((plane * terms.transpose(1, 2, 0)[enough]).sum(-1) * truth[enough] - 1)
    return found


def figures(found: np.ndarray, sigma: np.ndarray | None, truth: np.ndarray, noise: np.ndarray) -> dict[str, float]:
    """Errors at some pixels."""
    error, factor = np.abs(found - truth), np.maximum(found / truth, truth / found)
    result = {"abs_rel": error / truth, "rmse": error**2, "delta": factor < 1.25}
    if sigma is not None:
        within = error / np.hypot(sigma, noise * truth)
        result |= {"within_1": within < 1, "within_2": within < 2}
    means = {name: float(np.mean(values)) for name, values in result.items()}
    return {**means, "rmse": means["rmse"] ** 0.5, "pixels": len(found)}


def evaluate(folder: Path, names: list[str], one_of: int) -> dict[str, dict[str, list[dict[str, float]]]]:
    """Figures of each frame by region and method."""
    data = [read(folder, name, one_of) for name in track(names, "Projecting sweeps")]
    drive_fit = fit_of_drive([points_of_both(i, *maps[:2], EVERYWHERE) for i, maps in enumerate(data)], OURS)
    measured = [
        measure_frame(name, i, *maps[:2], EVERYWHERE, VIEW, OURS, drive_fit)
        for i, (name, maps) in enumerate(zip(names, data, strict=True))
    ]
    calibration = combine(measured, "", everywhere=False, drive_fit=drive_fit)
    rough = [np.stack([scatter(maps[2]), maps[2]])[:, (maps[2] > 0) & ~maps[3]] for maps in data]
    off, at = np.concatenate(rough, 1)
    # the median of a normal distribution's absolute values is 0.6745 of its standard deviation
    noise = [np.nanmedian(off[(at >= low) & (at < high)]) / 0.6745 for low, high in pairwise(BINS_M)]
    result: dict[str, dict[str, list[dict[str, float]]]] = defaultdict(lambda: defaultdict(list))
    for lidar, mono, truth, moving in track(data, "Making priors"):
        maps = {"lidar": lidar, "mono": mono}
        ours, literal = (make_prior(maps, EVERYWHERE, "integrated", one, calibration, VIEW) for one in (OURS, LITERAL))
        aligned = align(lidar, mono, EVERYWHERE, OURS.align, calibration.drive_fit).mono_m
        methods = {"LiDAR": (lidar, None), "network": (mono, None), "network, aligned": (aligned, None)}
        methods |= {"Eq. 5-7, literal": (literal.distance_m, None), "ours": (ours.distance_m, ours.sigma_m)}
        known = (truth > 0) & (truth < FARTHEST_M) & ~moving & (ours.distance_m > 0) & (mono > 0)
        away, none = np.asarray(distance_transform_edt(lidar <= 0)) > NEAR_PX, lidar <= 0
        farthest = cv2.dilate(truth, np.ones((5, 5)))
        edge = farthest > EDGE * cv2.erode(np.where(truth > 0, truth, np.float32(1e6)), np.ones((5, 5)))
        regions = {"at LiDAR points": known & ~none, "near": known & none & ~away, "away": known & away}
        regions |= {"at edges": known & none & edge, "all without a point": known & none}
        per_pixel = np.interp(truth, (np.array(BINS_M[1:]) + BINS_M[:-1]) / 2, noise)
        for region, where in regions.items():
            for method, (found, sigma) in methods.items():
                if (inside := where & (found > 0)).sum() >= 20:
                    values = (None if sigma is None else sigma[inside], truth[inside], per_pixel[inside])
                    result[region][method].append(figures(found[inside], *values))
    return result


def summary(
    result: Mapping[str, Mapping[str, Sequence[Mapping[str, float]]]],
) -> dict[str, dict[str, dict[str, float]]]:
    """Means over frames by region and method, shares over pixels, and in how many frames ours has the lower AbsRel."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for region, methods in result.items():
        for method, frames in methods.items():
            pixels = [one["pixels"] for one in frames]
            weights = {name: pixels if name.startswith("within") else None for name in frames[0]}
            means = {
                name: round(float(np.average([one[name] for one in frames], weights=weight)), 5)
                for name, weight in weights.items()
            }
            better = [a["abs_rel"] < b["abs_rel"] for a, b in zip(methods["ours"], frames, strict=True)]
            found.setdefault(region, {})[method] = {**means, "frames": len(frames), "ours_ahead": sum(better)}
    return found


def table(results: Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]]) -> Iterator[str]:
    """AbsRel of pixels without a LiDAR point, as Markdown."""
    yield "| pixels | network, fitted to LiDAR | Eq. 5 to 7 | ours | within 1 and 2 σ̂ | ours ahead of the fitted in |"
    yield "|---|---|---|---|---|---|"
    for rings, regions in results.items():
        for region, title in (("near", "within 4 px of a point"), ("away", "farther"), ("at edges", "at depth edges")):
            fitted, literal, ours = (regions[region][name] for name in ("network, aligned", "Eq. 5-7, literal", "ours"))
            errors = " | ".join(f"{one['abs_rel']:.2%}".replace("%", " %") for one in (fitted, literal, ours))
            shares = " and ".join(f"{ours[name]:.0%}".replace("%", " %") for name in ("within_1", "within_2"))
            ahead = f"{fitted['ours_ahead']} of {fitted['frames']}"
            yield f"| {rings} rings, {title} | {errors} | {shares} | {ahead} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--half", choices=("a", "b"), default="b")
    parser.add_argument("--rings", type=int, choices=(64, 32, 16), nargs="+", default=[64, 16])
    options = parser.parse_args()
    names = sorted(path.stem for path in (options.data / "gt/disp_occ_0").glob("*.png"))["ab".index(options.half) :: 2]
    results = {str(rings): summary(evaluate(options.data, names, 64 // rings)) for rings in options.rings}
    write_json(options.output / "table.json", results)
    write_text(options.output / "table.md", "\n".join(["# Stereo", "", *table(results)]) + "\n")
    print((options.output / "table.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
