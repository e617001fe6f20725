"""How good the masks are, against the truth of synthetic drives and against KITTI-360's real masks.

    python benchmarks/masks.py --output outputs/masks
    python benchmarks/masks.py --drives drives/street drives/turn --overlays outputs/overlays

Prints tables: the lens circle from the dark rim, the vehicle found from the pictures (of few frames, and under light
that changes), the sky with and without monocular maps, and what can be said of the real frame. Without --drives it
synthesises five small drives, once; in one of them the vehicle has the ground's colour. Ends with status 1 if a figure
misses its goal.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from edge_depth_nerf.base.files import read_distance_png, read_image, read_mask, write_png
from edge_depth_nerf.cameras import MEI
from edge_depth_nerf.masks.ego import EgoMask, NoEgo, find_ego
from edge_depth_nerf.masks.lens import dark_rim, lens_circle
from edge_depth_nerf.masks.sky import find_sky
from edge_depth_nerf.process.kitti360.calibration import read_cam_to_pose, read_mei_camera, read_poses
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import BodyName, SceneName, SynthesizeOptions

ROOT = Path(__file__).parents[1]
CAMERAS = ("image_02", "image_03")
SMALL_DRIVES: tuple[tuple[SceneName, int, BodyName], ...] = (
    ("street", 0, "grey"),
    ("turn", 0, "grey"),
    ("parking", 0, "grey"),
    ("turn", 7, "grey"),
    ("parking", 1, "ground"),
)
"""Scenes, seeds and vehicles of the drives that are made, 24 frames of 350 pixels each."""
LENS_DEG = 97.0
"""The generator's lens circle."""
EGO_GOAL, SKY_GOAL = 0.95, 0.98
FAR_M = 80.0
"""A prior that is removed from beyond is no loss."""

Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Drive:
    """A synthetic drive."""

    root: Path

    @property
    def sequence(self) -> str:
        """The one there is."""
        return next((self.root / "data_2d_raw").iterdir()).name

    def camera(self, name: str) -> MEI:
        """The camera at the size of its pictures."""
        return read_mei_camera(self.root / "calibration" / f"{name}.yaml")

    def frames(self, camera: str) -> list[int]:
        """Numbers of the pictures, in order."""
        folder = self.root / "data_2d_raw" / self.sequence / camera / "data_rgb"
        return sorted(int(path.stem) for path in folder.glob("*.png"))

    def picture(self, camera: str, frame: int) -> Picture:
        """A picture, RGB."""
        return read_image(self.root / "data_2d_raw" / self.sequence / camera / "data_rgb" / f"{frame:010d}.png")

    def truth(self, camera: str, frame: int) -> NDArray[np.float32]:
        """True distance, 0 = sky, own car, outside the lens."""
        return read_distance_png(self.root / "truth" / self.sequence / camera / "distance" / f"{frame:010d}.png")

    def mono(self, camera: str, frame: int) -> NDArray[np.float32]:
        """Simulated monocular distance."""
        return read_distance_png(self.root / "simulated_mono" / self.sequence / camera / f"{frame:010d}.png")

    def mask(self, name: str) -> Mask:
        """One of the true masks, True = use."""
        return read_mask(self.root / "truth" / "masks" / f"{name}.png")

    def up(self, camera: str) -> dict[int, NDArray[np.float64]]:
        """The world's upward direction in the camera's frame, by frame."""
        poses = read_poses(self.root / "data_poses" / self.sequence / "poses.txt")
        to_pose = read_cam_to_pose(self.root / "calibration" / "calib_cam_to_pose.txt")[camera]
        return {frame: (pose @ to_pose)[:3, :3].T @ (0.0, 0.0, 1.0) for frame, pose in poses.items()}


def iou(found: Mask, true: Mask) -> float:
    """Intersection over union."""
    return float((found & true).sum() / max((found | true).sum(), 1))


def spread(frames: Sequence[int], count: int) -> list[int]:
    """So many frames, evenly over the drive."""
    return [frames[index] for index in np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))]


def change_light(picture: Picture, where: Mask, strength: float, rng: np.random.Generator) -> Picture:
    """Let light and shade fall on a part of the picture, other ones each time."""
    knots = rng.standard_normal((5, 5)).astype(np.float32)
    field = np.asarray(cv2.resize(knots, where.shape[::-1], interpolation=cv2.INTER_CUBIC))
    lit = picture * np.where(where, np.exp(strength * field), 1)[..., None]
    return np.clip(np.rint(lit), 0, 255).astype(np.uint8)


# ---- synthetic drives ------------------------------------------------------------------------------------------


def lens_table(drives: Sequence[Drive]) -> Table:
    """Lens circles against the generator's."""
    table = Table(
        "drive",
        "camera",
        "calibration, IoU",
        "dark rim of 1, IoU",
        "of 4",
        title="Lens circle (97°; light fades to half at 98°, where the dark rim is put)",
    )
    for drive in drives:
        for camera in CAMERAS:
            true = drive.mask(f"{camera}_lens")
            row = [f"{iou(lens_circle(drive.camera(camera), LENS_DEG), true):.4f}"]
            for count in (1, 4):
                rim = dark_rim(drive.picture(camera, frame) for frame in spread(drive.frames(camera), count))
                row.append("none found" if rim is None else f"{iou(rim, true):.4f}")
            table.add_row(drive.root.name, camera, *row)
    return table


def ego_table(drives: Sequence[Drive], overlays: Path | None) -> tuple[Table, float]:
    """The vehicle against the generator's; second, the worst IoU of pictures as they are."""
    table = Table(
        *("drive", "camera", "pictures", "IoU hidden", "IoU kept", "missed", "too much", "certainty", "s"),
        title="The vehicle, inside the lens circle (missed and too much: shares of the vehicle)",
    )
    worst = 1.0
    for drive in drives:
        for camera in CAMERAS:
            lens, frames = drive.mask(f"{camera}_lens"), drive.frames(camera)
            true = lens & ~drive.mask(f"{camera}_ego")
            cases: dict[str, list[Callable[[], Picture]]] = {
                f"{len(chosen)} {what}": [partial(drive.picture, camera, frame) for frame in chosen]
                for what, chosen in (("all", frames), ("spread", spread(frames, 16)), ("in a row", frames[:16]))
            }

            def shaded(frame: int, camera: str = camera, drive: Drive = drive, true: Mask = true) -> Picture:
                return change_light(drive.picture(camera, frame), true, 0.1, np.random.default_rng(frame))

            cases["16 in changing light"] = [partial(shaded, frame) for frame in spread(frames, 16)]
            for name, pictures in cases.items():
                begin = time.perf_counter()
                found = find_ego(pictures, lens)
                seconds = time.perf_counter() - begin
                if isinstance(found, NoEgo):
                    table.add_row(drive.root.name, camera, name, found.reason)
                    worst = 0.0
                    continue
                hidden = lens & ~found.keep
                figure = iou(hidden, true)
                if "light" not in name:
                    worst = min(worst, figure)
                table.add_row(
                    *(drive.root.name, camera, name, f"{figure:.4f}", f"{iou(lens & found.keep, lens & ~true):.4f}"),
                    *(f"{(true & ~hidden).sum() / true.sum():.1%}", f"{(hidden & ~true).sum() / true.sum():.1%}"),
                    *(f"{found.certainty:.2f}", f"{seconds:.1f}"),
                )
                if overlays is not None and name.endswith("all"):
                    picture = pictures[len(pictures) // 2]()
                    write_png(
                        overlays / f"{drive.root.name}_{camera}_ego.png",
                        painted(picture, hidden & true, hidden & ~true, true & ~hidden),
                    )
    return table, worst


def sky_table(drives: Sequence[Drive], overlays: Path | None, every: int) -> tuple[Table, float]:
    """The sky against the truth; second, the worst precision of a drive."""
    table = Table(
        *("drive", "mono", "frames", "share found", "recall", "precision", "worst frame: recall", "precision", "ms"),
        title=f"Sky (wrong: true distance below {FAR_M:g} m)",
    )
    worst = 1.0
    for drive in drives:
        for with_mono in (True, False):
            rows, milliseconds = [], []
            for camera in CAMERAS:
                model, mask, ups = drive.camera(camera), drive.mask(camera), drive.up(camera)
                for frame in drive.frames(camera)[::every]:
                    picture, truth = drive.picture(camera, frame), drive.truth(camera, frame)
                    mono = drive.mono(camera, frame) if with_mono else None
                    begin = time.perf_counter()
                    found = find_sky(picture, mask, ups[frame], model, np.zeros_like(truth), mono)
                    milliseconds.append(1e3 * (time.perf_counter() - begin))
                    true, wrong = mask & (truth == 0), found & (truth > 0) & (truth < FAR_M)
                    rows.append([(found & true).sum(), true.sum(), wrong.sum(), found.sum(), mask.sum()])
                    if overlays is not None and with_mono and frame == drive.frames(camera)[0]:
                        painting = painted(picture, found & ~wrong, wrong, true & ~found)
                        write_png(overlays / f"{drive.root.name}_{camera}_sky.png", painting)
            counts = np.array(rows, float)
            recalls = counts[:, 0] / np.maximum(counts[:, 1], 1)
            precisions = 1 - counts[:, 2] / np.maximum(counts[:, 3], 1)
            good, there, wrong_px, found_px, used = counts.sum(0)
            precision = 1 - wrong_px / max(found_px, 1)
            worst = min(worst, precision)
            seen = there > 0
            table.add_row(
                *(drive.root.name, "yes" if with_mono else "no", str(len(rows)), f"{found_px / used:.1%}"),
                *(f"{good / there:.4f}" if seen else "no sky", f"{precision:.4f}" if found_px else "nothing found"),
                *(f"{recalls.min():.4f}" if seen else "–", f"{precisions.min():.4f}" if found_px else "–"),
                f"{np.median(milliseconds):.0f}",
            )
    return table, worst


def painted(picture: Picture, right: Mask, wrong: Mask, missed: Mask) -> Picture:
    """The picture with what was found in green, too much in red, missed in blue."""
    result = picture.copy()
    for where, colour in ((right, (0, 200, 0)), (wrong, (255, 0, 0)), (missed, (0, 0, 255))):
        result[where] = (0.5 * result[where] + 0.5 * np.array(colour)).astype(np.uint8)
    return result


# ---- the real frame --------------------------------------------------------------------------------------------


def sliding_world(picture: Picture, hidden: Mask, count: int, light: float) -> Iterator[Picture]:
    """The real vehicle before the real street, which slides sideways; what the vehicle hides is stretched from above.

    Light changes on the vehicle, exposure drifts by 8 %, and there is noise of one level.
    """
    rng = np.random.default_rng(0)
    height, width = hidden.shape
    upper_edge = np.where(hidden.any(0), hidden.argmax(0), height - 1).astype(np.float32)
    upper_edge = np.asarray(cv2.blur(upper_edge[None], (31, 1)))[0] - 15
    y = np.arange(height, dtype=np.float32)[:, None]
    half = np.float32(0.45 * height)
    source = np.where(y < half, y, half + (y - half) * (upper_edge - half) / (height - half))
    x = np.tile(np.arange(width, dtype=np.float32), (height, 1))
    street = np.asarray(cv2.remap(picture, x, source.astype(np.float32), cv2.INTER_LINEAR))
    street = np.concatenate((street, street[:, ::-1]), 1)
    for number in range(count):
        slid = np.roll(street, 37 * number, 1)[:, :width]
        seen = np.where(hidden[..., None], change_light(picture, hidden, light, rng), slid)
        seen = seen * (1 + 0.08 * np.sin(number / 3)) + rng.standard_normal(seen.shape)
        yield np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def real_tables(real: Path, overlays: Path | None) -> list[Table]:
    """What the one real frame and the two real masks say."""
    folder = real / "kitti360_fisheye_frame"
    picture = read_image(folder / "kitti360_rgb.png")
    rim = dark_rim([picture])
    circles = Table(
        *("camera", "circle", "IoU with the dark rim", "of the real mask: outside", "inside: the vehicle"),
        *("outside, not in the mask",),
        title="KITTI-360's masks (vehicle and lower dark corners; the last column: share of the picture)",
    )
    for camera, name in (("image_02", "left"), ("image_03", "right")):
        hidden = np.load(folder / f"mask_{name}_fisheye.npy")
        model = read_mei_camera(real / "kitti360_calibration" / f"{camera}.yaml")
        limit = np.degrees(model.theta_max_rad)
        found = {"95°": lens_circle(model, 95.0), f"limit, {limit:.1f}°": lens_circle(model, 180.0)}
        if camera == "image_02" and rim is not None:
            found["dark rim of one picture"] = rim
        for what, circle in found.items():
            agreement = "–" if rim is None or camera != "image_02" else f"{iou(circle, rim):.4f}"
            circles.add_row(
                *(camera, what, agreement, f"{(hidden & ~circle).sum() / hidden.sum():.1%}"),
                *(f"{(hidden & circle).sum() / hidden.sum():.1%}", f"{(~hidden & ~circle).mean():.1%}"),
            )
    hidden = np.load(folder / "mask_left_fisheye.npy")
    lens = lens_circle(read_mei_camera(real / "kitti360_calibration" / "image_02.yaml"), 95.0)
    ego = Table("light changes by", "IoU hidden", "certainty", title="The real vehicle before a street that slides")
    for light in (0.0, 0.1, 0.2):
        result = find_ego(sliding_world(picture, hidden, 24, light), lens)
        if isinstance(result, EgoMask):
            ego.add_row(f"{light:.0%}", f"{iou(lens & ~result.keep, lens & hidden):.4f}", f"{result.certainty:.2f}")
            if overlays is not None:
                ours, theirs = lens & ~result.keep, lens & hidden
                painting = painted(picture, ours & theirs, ours & ~theirs, theirs & ~ours)
                write_png(overlays / f"real_ego_light_{100 * light:.0f}.png", painting)
        else:
            ego.add_row(f"{light:.0%}", result.reason)
    if overlays is not None and rim is not None:
        write_png(overlays / "real_rim.png", painted(picture, lens, rim & ~lens, lens & ~rim))
    return [circles, ego]


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=Path, nargs="+", help="synthetic drives; without, small ones are made")
    parser.add_argument("--output", type=Path, default=Path("outputs/masks"), help="where they are made")
    parser.add_argument("--real", type=Path, default=ROOT.parent / "shared" / "real")
    parser.add_argument("--overlays", type=Path, help="write pictures of what was found there")
    parser.add_argument("--sky-every", type=int, default=4, help="look for the sky in every so many-th frame")
    options = parser.parse_args()
    if options.drives:
        drives = [Drive(root) for root in options.drives]
    else:
        drives = []
        for scene, seed, body in SMALL_DRIVES:
            root = options.output / (f"{scene}_{seed}" if body == "grey" else f"{scene}_{seed}_{body}")
            synthesize_drive(SynthesizeOptions(output=root, scene=scene, frames=24, size=350, seed=seed, body=body))
            drives.append(Drive(root))
    console = Console(width=150)
    console.print(lens_table(drives))
    ego, worst_iou = ego_table(drives, options.overlays)
    console.print(ego)
    sky, worst_precision = sky_table(drives, options.overlays, options.sky_every)
    console.print(sky)
    if options.real.is_dir():
        for table in real_tables(options.real, options.overlays):
            console.print(table)
    else:
        console.print(f"{options.real}: no real excerpts there (they are not part of the project).")
    for what, figure, goal in (
        ("IoU of the vehicle", worst_iou, EGO_GOAL),
        ("sky precision", worst_precision, SKY_GOAL),
    ):
        console.print(f"Worst {what}: {figure:.4f}, goal {goal}: {'reached' if figure >= goal else 'MISSED'}")
    sys.exit(not (worst_iou >= EGO_GOAL and worst_precision >= SKY_GOAL))


if __name__ == "__main__":
    main()
