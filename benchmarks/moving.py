"""How good the masks of moving things are, on drives with traffic whose truth is known, and on a real one.

    python benchmarks/moving.py --output outputs/moving
    python benchmarks/moving.py --drives drives/traffic --overlays outputs/overlays
    python benchmarks/moving.py --train --output outputs/moving

Prints, for each drive, the share of the pixels that show what moves that `--find-moving` masks out (recall), and the
share of the others that it masks out too (lost), with the poses that come with it and with poses disturbed by 3 cm and
0.1°. Drives in which nothing moves are among them: there all that is masked is lost. Without --drives it synthesises
them, once. Ends with status 1 if a figure misses its goal.

With --train it measures what the masks are worth instead: a drive with traffic is processed without masks, with those
of `--find-moving` and with the true ones, and each scene is trained. Held-out pictures are judged where nothing moves,
by the true masks in all three.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from commands import command
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_image, read_json, read_mask, write_json, write_png
from edge_depth_nerf.masks.lens import lens_circle
from edge_depth_nerf.process.converters import read_drive
from edge_depth_nerf.process.moving import find_moving
from edge_depth_nerf.process.options import Kitti360Options, ProcessOptions, RigOptions
from edge_depth_nerf.process.recording import RecordedPicture, Recording
from edge_depth_nerf.scene.writer import held_out_frames
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import LayoutName, SceneName, SynthesizeOptions

DRIVES: tuple[tuple[SceneName, LayoutName, int, int], ...] = (
    ("traffic", "kitti-360", 350, 0),
    ("traffic", "kitti-360", 350, 1),
    ("traffic", "kitti-360", 700, 3),
    ("traffic", "rig", 350, 2),
    ("street", "kitti-360", 350, 0),
)
"""Scene, layout, width of the pictures and seed of the drives that are made."""
FRAMES = 40
TRAINED: tuple[SceneName, int, int, int] = ("traffic", 24, 256, 0)
"""Scene, frames, width of the pictures and seed of the drive that is trained on."""
RECALL_GOAL, LOST_GOAL = 0.9, 0.01
METHOD, SEQUENCE = "edge-depth-nerf-lite", "2013_05_28_drive_0000_sync"
DISTURBED_M, DISTURBED_DEG = 0.03, 0.1

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Drive:
    """A drive with the options that read it, and where the truth of its pictures lies."""

    root: Path
    options: ProcessOptions
    sequence: str | None

    @staticmethod
    def of(root: Path, output: Path) -> Drive:
        """Recognise a synthetic drive's layout."""
        if not (root / "data_2d_raw").is_dir():
            return Drive(root, RigOptions(root=root, output=output), None)
        sequence = next((root / "data_2d_raw").iterdir()).name
        ego = root / "truth/masks"
        options = Kitti360Options(root=root, sequence=sequence, output=output, ego_mask=ego)
        return Drive(root, options, sequence)

    def true_moving(self, picture: RecordedPicture) -> Mask | None:
        """What moves; None where the drive has no such truth: nothing does."""
        if self.sequence is not None:
            path = self.root / f"truth/{self.sequence}/moving_masks/{picture.camera}/{picture.path.name}"
        else:
            path = self.root / f"truth/{picture.camera}/moving_masks/{picture.path.name}"
        return ~read_mask(path) if path.is_file() else None


def disturbed(recording: Recording) -> Recording:
    """The recording with wrong poses."""
    rng, path = np.random.default_rng(0), recording.trajectory
    assert path is not None
    poses = path.vehicle_to_world.copy()
    turns = rng.normal(0, np.radians(DISTURBED_DEG), (len(poses), 3))
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(turns).as_matrix()
    poses[:, :3, 3] += rng.normal(0, DISTURBED_M, (len(poses), 3))
    return replace(recording, trajectory=replace(path, vehicle_to_world=poses))


def masks_of(
    recording: Recording, options: ProcessOptions, console: Console
) -> Iterator[tuple[RecordedPicture, Mask, Mask]]:
    """Find what moves, and go through the pictures: what is used of each, and what of it was found to move."""
    moments = sorted({picture.frame for picture in recording.pictures})
    held_out = {m for m, out in zip(moments, held_out_frames(len(moments), options.holdout_every), strict=True) if out}
    ego = {}
    for camera in recording.cameras:
        path = options.ego_mask_of(camera.name) or camera.ego_mask
        if path is not None:
            ego[camera.name] = read_mask(path)
    found, _ = find_moving(recording, options, held_out, ego, console)
    lens = {camera.name: lens_circle(camera.camera, options.theta_max_deg) for camera in recording.cameras}
    for picture in found.pictures:
        assert picture.moving_mask is not None
        usable = lens[picture.camera]
        if picture.camera in ego:
            usable = usable & ego[picture.camera]
        yield picture, usable, usable & ~read_mask(picture.moving_mask)


def judge(drive: Drive, recording: Recording, overlays: Path | None, console: Console) -> tuple[float, float, float]:
    """Recall, share lost, and the share of the pictures that moves."""
    counts = np.zeros(4)
    for picture, usable, found in masks_of(recording, drive.options, console):
        true = drive.true_moving(picture)
        true = np.zeros_like(usable) if true is None else true & usable
        counts += ((found & true).sum(), true.sum(), (found & ~true).sum(), (usable & ~true).sum())
        if overlays is not None:
            image = read_image(picture.path)
            for where, colour in (
                (found & true, (0, 200, 0)),
                (found & ~true, (255, 0, 0)),
                (true & ~found, (0, 0, 255)),
            ):
                image[where] = (0.5 * image[where] + 0.5 * np.array(colour)).astype(np.uint8)
            write_png(overlays / drive.root.name / f"{picture.camera}_{picture.frame:04d}.png", image)
    good, true_px, wrong, still = counts
    return good / true_px if true_px else 1.0, wrong / still, true_px / (true_px + still)


def real_table(root: Path, overlays: Path | None, console: Console) -> Table:
    """How much of a real drive is masked; whether that moves is for the eye."""
    table = Table("drive", "pictures", "with a mask", "masked of all", "most in one", title="A real drive")
    with tempfile.TemporaryDirectory() as folder:
        options = RigOptions(root=root, output=Path(folder))
        shares = []
        for picture, usable, found in masks_of(read_drive(options), options, console):
            shares.append(found.sum() / usable.sum())
            if overlays is not None:
                image = read_image(picture.path)
                image[found] = (0.4 * image[found] + 0.6 * np.array((255, 0, 0))).astype(np.uint8)
                write_png(overlays / root.name / f"{picture.camera}_{picture.frame:04d}.png", image)
    some = sum(share > 0 for share in shares)
    table.add_row(root.name, str(len(shares)), str(some), f"{np.mean(shares):.2%}", f"{np.max(shares):.2%}")
    return table


def judge_by(scene: Path, true: Path) -> None:
    """Give a scene's held-out pictures the masks of another."""
    meta, of = read_json(scene / "transforms.json"), read_json(true / "transforms.json")
    masks = {frame["file_path"]: frame["mask_path"] for frame in of["frames"]}
    for frame in meta["frames"]:
        if frame["file_path"] in meta["test_filenames"]:
            name = Path("judged_masks") / frame["file_path"]
            write_png(scene / name, read_image(true / masks[frame["file_path"]]))
            frame["mask_path"] = str(name)
    write_json(scene / "transforms.json", meta)


def worth(output: Path, steps: int) -> Table:
    """Train a drive with traffic without masks of what moves, with those that are found, and with the true ones."""
    scene, frames, size, seed = TRAINED
    drive = output / f"trained_{scene}_{size}_{seed}"
    made = ("--scene", scene, "--frames", frames, "--size", size, "--seed", seed)
    command("edge-depth-nerf", "synthesize", "--output", drive, *made)
    words = ("process", "kitti360", "--root", drive, "--sequence", SEQUENCE)
    mono = ("--mono", drive / "simulated_mono" / SEQUENCE)
    given = {
        "true": ("--frame-masks", drive / "truth" / SEQUENCE / "moving_masks"),
        "none": (),
        "found": ("--find-moving",),
    }
    scenes = {name: output / f"scene_{name}" for name in given}
    for name, masks in given.items():
        if not (scenes[name] / "is_judged_by_true").is_file():
            command("edge-depth-nerf", *words, *mono, *masks, "--output", scenes[name])
            if name != "true":
                judge_by(scenes[name], scenes["true"])
            (scenes[name] / "is_judged_by_true").touch()
    columns = ("truth_masked_psnr", "truth_masked_ssim", "truth_abs_rel")
    table = Table("masks of what moves", *columns, title=f"{drive.name}: held-out pixels where nothing moves")
    for name in ("none", "found", "true"):
        folder = output / "runs" / name
        if not (folder / "figures.json").is_file():
            command(
                *("ns-train", METHOD, "--data", scenes[name], "--output-dir", output / "runs"),
                *("--experiment-name", name, "--timestamp", "run", "--vis", "tensorboard"),
                *("--max-num-iterations", steps, "--optimizers.fields.scheduler.max-steps", steps),
                *("--optimizers.proposal_networks.scheduler.max-steps", steps),
            )
            config = folder / METHOD / "run" / "config.yml"
            command("ns-eval", "--load-config", config, "--output-path", folder / "figures.json")
        found = read_json(folder / "figures.json")["results"]
        table.add_row(name, *(f"{found[column]:.3f}" for column in columns))
    return table


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=Path, nargs="+", help="synthetic drives; without, small ones are made")
    parser.add_argument("--output", type=Path, default=Path("outputs/moving"), help="where they are made")
    parser.add_argument("--real", type=Path, help="a recorded drive with a rig file")
    parser.add_argument("--overlays", type=Path, help="write pictures: found, too much, missed in green, red, blue")
    parser.add_argument("--train", action="store_true", help="measure what the masks are worth to a trained model")
    parser.add_argument("--steps", type=int, default=1000, help="of each training")
    arguments = parser.parse_args()
    if arguments.train:
        Console(width=120).print(worth(arguments.output, arguments.steps))
        return
    roots = arguments.drives or []
    if not roots:
        for scene, layout, size, seed in DRIVES:
            root = arguments.output / f"{scene}_{layout}_{size}_{seed}"
            made = SynthesizeOptions(output=root, scene=scene, frames=FRAMES, size=size, seed=seed, layout=layout)
            roots.append(synthesize_drive(made))
    console, quiet = Console(width=120), Console(quiet=True)
    table = Table("drive", "poses", "moves", "recall", "lost", "s", title="Moving things (shares of what is used)")
    reached = True
    for root in roots:
        for poses in ("given", "disturbed"):
            with tempfile.TemporaryDirectory() as folder:
                drive = Drive.of(root, Path(folder))
                recording = read_drive(drive.options)
                if poses == "disturbed":
                    recording = disturbed(recording)
                begin = time.perf_counter()
                overlays = arguments.overlays if poses == "given" else None
                recall, lost, share = judge(drive, recording, overlays, quiet)
            reached &= recall >= RECALL_GOAL and lost <= LOST_GOAL
            seconds = f"{time.perf_counter() - begin:.0f}"
            table.add_row(root.name, poses, f"{share:.1%}", f"{recall:.3f}" if share else "–", f"{lost:.2%}", seconds)
            console.print(root.name, poses, f"recall {recall:.4f}, lost {lost:.4f}")
    console.print(table)
    if arguments.real is not None:
        console.print(real_table(arguments.real, arguments.overlays, quiet))
    console.print(f"Recall {RECALL_GOAL:g} and at most {LOST_GOAL:.0%} lost: {'reached' if reached else 'MISSED'}")
    sys.exit(not reached)


if __name__ == "__main__":
    main()
