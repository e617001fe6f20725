"""How good the sky finder is with any lens and in other light, against the truth of rendered scenes.

    python benchmarks/sky.py

`benchmarks/masks.py` judges it on the fisheye pictures of synthetic drives. Here the same scenes are seen by fisheyes
and by pinholes of 60° to 120°. The generator has one kind of light, a bright day with thin clouds. Of each view two
more pictures are made: one of two and a half times the exposure, in which sky and white walls are blown out alike, and
one under an overcast sky, a grey one that darkens upwards above a scene in dull light. Ends with status 1 if precision
by day misses its goal.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.cameras import Camera, Pinhole
from edge_depth_nerf.masks.sky import find_sky
from edge_depth_nerf.synthetic import rig
from edge_depth_nerf.synthetic.layout import PICTURE_NOISE, VEHICLE_TO_POSE, MountedCamera
from edge_depth_nerf.synthetic.motion import FRAME_INTERVAL_S
from edge_depth_nerf.synthetic.options import SceneName, SynthesizeOptions
from edge_depth_nerf.synthetic.render import FisheyeCamera, View, World, own_car_world
from edge_depth_nerf.synthetic.rig_drive import looking
from edge_depth_nerf.synthetic.scenes import build_scene
from edge_depth_nerf.synthetic.simulated_mono import simulated_estimate

SCENES: tuple[tuple[SceneName, int], ...] = (("street", 0), ("turn", 0), ("parking", 0), ("turn", 7))
"""Scenes and seeds, as in `benchmarks/masks.py`."""
DRIVE_FRAMES = 24
OVEREXPOSED = 2.5
"""Exposure of the blown-out pictures over the scene's."""
LIGHTS = ("day", "blown out", "overcast")
FAR_M = 80.0
"""A prior that is removed from beyond is no loss."""
OUTLINE_PX = 2.0
"""Nearer to the sky than this a wrong pixel is one of its outline's, not of another thing."""
TOP_OF_SCANNER_DEG = 2.0
"""LiDAR, where the table says so: the true distance of every second pixel of every fourth row below."""
PRECISION_GOAL = 0.995


@dataclass(frozen=True)
class SkyView:
    """A picture whose sky is known."""

    camera_name: str
    light: str
    """One of `LIGHTS`."""
    picture: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    """True = use."""
    up_in_camera: NDArray[np.float64]
    camera: Camera
    truth_m: NDArray[np.float32]
    """True distance, 0 = sky, own car, outside the lens."""
    mono_m: NDArray[np.float32]
    """Simulated monocular distance."""


def sky_cameras(size: int) -> dict[str, MountedCamera]:
    """KITTI-360's fisheyes, pinholes of 60°, 90° and 120° ahead, and one of 90° to the front left."""

    def pinhole(field_deg: float, yaw_deg: float) -> MountedCamera:
        # real ones have more pixels a degree than fisheyes
        width, height = 2 * size, round(1.25 * size)
        focal = width / 2 / math.tan(math.radians(field_deg / 2))
        camera = Pinhole(width, height, focal, focal, width / 2, height / 2)
        return MountedCamera(camera, VEHICLE_TO_POSE @ looking(yaw_deg, 0.0, (1.58, 0.05, 0.65)), 89.0)

    fisheyes = {name: MountedCamera(rig.camera(name, size), rig.CAMERA_TO_POSE[name]) for name in rig.CAMERAS}
    pinholes = {f"pinhole {field:g}°": pinhole(field, 0.0) for field in (60.0, 90.0, 120.0)}
    return fisheyes | pinholes | {"pinhole 90°, left": pinhole(90.0, 60.0)}


def sky_views(options: SynthesizeOptions, frames: list[int]) -> Iterator[SkyView]:
    """Render a scene by the lenses of `sky_cameras` in the three lights."""
    model = build_scene(options)
    world, own_car = World(model, options.seed), own_car_world(model, options.seed)
    overcast = dataclasses.replace(model.lighting, sun=(0.0, 0.0, 0.0), exposure=2.0 * model.lighting.exposure)
    dull = World(dataclasses.replace(model, lighting=overcast), options.seed)
    pose_to_ground = np.diag([1.0, -1.0, -1.0, 1.0])
    pose_to_ground[2, 3] = rig.POSE_HEIGHT_M
    for number, (name, mounted) in enumerate(sky_cameras(options.size).items()):
        camera = FisheyeCamera(mounted.camera, own_car, pose_to_ground @ mounted.to_pose, mounted.lens_theta_deg)
        mask = camera.lens & ~camera.own_car
        for frame in frames:
            time_s = frame * FRAME_INTERVAL_S
            to_world = model.drive.pose_to_world(np.array([time_s]))[0] @ mounted.to_pose
            view, dull_view = (camera.view(each, to_world, time_s) for each in (world, dull))
            up = to_world[:3, :3].T @ (0.0, 0.0, 1.0)
            mono = simulated_estimate(view.distance_m, camera.own_distance_m, camera.lens, frame, options.seed, number)
            pictures = (
                world.to_picture(view.radiance),
                world.to_picture(view.radiance, OVEREXPOSED),
                _overcast(dull, dull_view, mask, up, mounted.camera),
            )
            rng = np.random.default_rng([options.seed, number, frame])
            for light, picture in zip(LIGHTS, pictures, strict=True):
                noisy = picture + rng.standard_normal(picture.shape, np.float32) * np.float32(PICTURE_NOISE)
                taken = np.rint(np.clip(noisy, 0, 1) * 255).astype(np.uint8)
                yield SkyView(name, light, taken, mask, up, mounted.camera, view.distance_m, mono)


def _overcast(
    world: World, view: View, mask: NDArray[np.bool_], up: NDArray[np.float64], camera: Camera
) -> NDArray[np.float32]:
    """The picture with its sky replaced by a grey one, brighter at the horizon, with soft clouds."""
    directions = camera.unproject(camera.pixel_centres())[0].numpy()
    height = np.clip(np.nan_to_num(directions @ up), 0, 1)
    clouds = np.random.default_rng(5).standard_normal((6, 9)).astype(np.float32)
    clouds = np.asarray(cv2.resize(clouds, mask.shape[::-1], interpolation=cv2.INTER_CUBIC))
    grey = (0.88 - 0.16 * height + 0.02 * clouds)[..., None] * np.array((0.98, 1.0, 1.02))
    # pixels half sky have to mix
    share = cv2.GaussianBlur((mask & (view.distance_m == 0)).astype(np.float32), (0, 0), 0.6)[..., None]
    return (share * grey + (1 - share) * world.to_picture(view.radiance)).astype(np.float32)


def judged(view: SkyView, with_lidar: bool, with_mono: bool) -> list[float]:
    """Pixels right, of the sky, wrong, wrong beyond the outline, found; and milliseconds."""
    directions = np.nan_to_num(view.camera.unproject(view.camera.pixel_centres())[0].numpy())
    hit = view.mask & (directions @ view.up_in_camera < math.sin(math.radians(TOP_OF_SCANNER_DEG)))
    lidar = np.zeros_like(view.truth_m)
    if with_lidar:
        lidar[::4, ::2] = np.where(hit, view.truth_m, 0)[::4, ::2]
    begin = time.process_time()
    found = find_sky(view.picture, view.mask, view.up_in_camera, view.camera, lidar, view.mono_m if with_mono else None)
    spent_ms = 1e3 * (time.process_time() - begin)
    true, wrong = view.mask & (view.truth_m == 0), found & (view.truth_m > 0) & (view.truth_m < FAR_M)
    away_px = np.asarray(cv2.distanceTransform((~true).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5))
    beyond = wrong & (away_px > OUTLINE_PX)
    return [*(float(where.sum()) for where in (found & true, true, wrong, beyond, found)), spent_ms]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 10, 20], help="of each drive")
    parser.add_argument("--size", type=int, default=350, help="of the fisheyes; the pinholes are twice as wide")
    chosen = parser.parse_args()
    figures: dict[tuple[str, str, str], list[list[float]]] = defaultdict(list)
    for scene, seed in SCENES:
        options = SynthesizeOptions(output=Path(), scene=scene, frames=DRIVE_FRAMES, size=chosen.size, seed=seed)
        for view in sky_views(options, chosen.frames):
            name = "fisheyes" if view.camera_name in rig.CAMERAS else view.camera_name
            for known in ("nothing", "LiDAR", "mono"):
                figures[name, view.light, known].append(judged(view, known == "LiDAR", known == "mono"))
    table = Table(
        *("lens", "light", "known", "pictures", "recall", "precision", "wrong beyond the outline", "ms"),
        title=f"Sky (wrong: true distance below {FAR_M:g} m; beyond: more than {OUTLINE_PX:g} px from the sky)",
    )
    worst = 1.0
    for (name, light, known), rows in figures.items():
        right, true, wrong, beyond, found, _ = np.sum(rows, 0)
        precision = 1 - wrong / max(found, 1)
        if light == "day":
            worst = min(worst, precision)
        table.add_row(
            *(name, light, known, str(len(rows)), f"{right / max(true, 1):.4f}", f"{precision:.4f}"),
            *(f"{beyond / max(found, 1):.2%}", f"{np.median([row[-1] for row in rows]):.0f}"),
        )
    console = Console(width=130)
    console.print(table)
    verdict = "reached" if worst >= PRECISION_GOAL else "MISSED"
    console.print(f"Worst precision by day: {worst:.4f}, goal {PRECISION_GOAL}: {verdict}")
    sys.exit(worst < PRECISION_GOAL)


if __name__ == "__main__":
    main()
