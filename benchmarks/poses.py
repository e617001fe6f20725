"""What refining poses is worth, in training and before it: a rendered drive with true poses and with disturbed ones.

    python benchmarks/poses.py --output outputs/poses

The drive is processed with its own poses, and with poses that are each off by 3 cm and 0.1° (root mean square), which
its LiDAR is accumulated by, too. Both are trained with and without `--pipeline.model.camera-optimizer.mode SO3xR3`;
their held-out pictures have the true poses, so that what is judged is the scene. The disturbed poses are processed once
more with `--refine-poses`, held-out ones included. Writes table.md: the figures, how much of what the disturbance costs
is won back, and what refining true poses costs. What is there is not made again.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np
from commands import command
from scipy.spatial.transform import Rotation

from edge_depth_nerf.base.files import read_json, write_json, write_text

METHOD = "edge-depth-nerf-lite"
GROUPS = ("fields", "proposal_networks", "camera_opt")
"""Of parameters; their learning rates fall over the steps asked for."""
SEQUENCE = "2013_05_28_drive_0000_sync"
COLUMNS = ("truth_masked_psnr", "truth_masked_ssim", "truth_abs_rel")
ROWS = (
    ("true", "off"),
    ("true", "SO3xR3"),
    ("disturbed", "off"),
    ("disturbed", "SO3xR3"),
    ("refined", "off"),
)
"""Poses of a scene, and whether training moves them."""
WON_BACK_GOAL, HARM_GOAL_DB = 0.9, 0.1


def disturbed_drive(drive: Path, folder: Path, shift_m: float, turn_deg: float) -> Path:
    """The same drive with other poses: each shifted and turned by as much, root mean square, in random directions."""
    rng = np.random.default_rng(0)
    shutil.copytree(drive, folder)
    path = folder / "data_poses" / SEQUENCE / "poses.txt"
    lines = []
    for line in path.read_text(encoding="utf-8").splitlines():
        frame, *numbers = line.split()
        pose = np.reshape(np.array(numbers, np.float64), (3, 4))
        turn = Rotation.from_rotvec(np.radians(turn_deg) / np.sqrt(3) * rng.standard_normal(3)).as_matrix()
        pose[:, :3] = pose[:, :3] @ turn
        pose[:, 3] += shift_m / np.sqrt(3) * rng.standard_normal(3)
        lines.append(" ".join([frame, *(f"{value!r}" for value in pose.ravel().tolist())]))
    write_text(path, "\n".join([*lines, ""]))
    return folder


def process(drive: Path, scene: Path, downscale: int, refine: bool = False) -> None:
    """Make a scene of a drive, with its simulated monocular maps."""
    words = ("process", "kitti360", "--root", drive, "--sequence", SEQUENCE, "--output", scene)
    mono = drive / "simulated_mono" / SEQUENCE
    refining = "--refine-poses" if refine else "--no-refine-poses"
    command("edge-depth-nerf", *words, "--mono", mono, "--downscale", downscale, refining)


def with_true_held_out(scene: Path, true: Path) -> None:
    """Give a scene's held-out pictures the poses of another."""
    meta, of = read_json(scene / "transforms.json"), read_json(true / "transforms.json")
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in of["frames"]}
    # both count from an origin of their own
    shift = np.subtract(of["world_offset_m"], meta["world_offset_m"])
    for frame in meta["frames"]:
        if frame["file_path"] in meta["test_filenames"]:
            pose = np.array(poses[frame["file_path"]])
            pose[:3, 3] += shift
            frame["transform_matrix"] = pose.tolist()
    write_json(scene / "transforms.json", meta)


def figures_of(scene: Path, folder: Path, mode: str, steps: int) -> dict[str, float]:
    """Train and judge, unless it is done."""
    figures = folder / mode / "figures.json"
    if not figures.is_file():
        command(
            *("ns-train", METHOD, "--data", scene, "--output-dir", folder, "--experiment-name", mode),
            *("--timestamp", "run", "--vis", "tensorboard", "--max-num-iterations", steps),
            *("--pipeline.model.camera-optimizer.mode", mode),
            *(f"--optimizers.{group}.scheduler.max-steps={steps}" for group in GROUPS),
        )
        config = folder / mode / METHOD / "run" / "config.yml"
        command("ns-eval", "--load-config", config, "--output-path", figures)
    return read_json(figures)["results"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/poses"))
    parser.add_argument("--scene", default="street")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--size", type=int, default=700, help="of the recorded pictures, which poses are refined by")
    parser.add_argument("--downscale", type=int, default=2, help="of the pictures that are trained on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--shift-m", type=float, default=0.03)
    parser.add_argument("--turn-deg", type=float, default=0.1)
    options = parser.parse_args()
    drive = options.output / "drive"
    words = ("--scene", options.scene, "--frames", options.frames, "--size", options.size, "--seed", options.seed)
    command("edge-depth-nerf", "synthesize", "--output", drive, *words)
    scenes = {name: options.output / f"scene_{name}" for name in ("true", "disturbed", "refined")}
    other = options.output / "drive_disturbed"
    if not (other / "is_whole").is_file():
        shutil.rmtree(other, ignore_errors=True)
        disturbed_drive(drive, other, options.shift_m, options.turn_deg)
        (other / "is_whole").touch()
    process(drive, scenes["true"], options.downscale)
    process(other, scenes["refined"], options.downscale, refine=True)
    if not (scenes["disturbed"] / "held_out_is_true").is_file():
        process(other, scenes["disturbed"], options.downscale)
        with_true_held_out(scenes["disturbed"], scenes["true"])
        (scenes["disturbed"] / "held_out_is_true").touch()
    found: dict[tuple[str, str], dict[str, float]] = {}
    lines = ["| poses | refined in training | " + " | ".join(COLUMNS) + " |", "|---|---|" + "---|" * len(COLUMNS)]
    for name, mode in ROWS:
        figures = figures_of(scenes[name], options.output / f"runs_{name}", mode, options.steps)
        found[name, mode] = figures
        cells = [name, "no" if mode == "off" else "yes", *(f"{figures[key]:.3f}" for key in COLUMNS)]
        lines.append("| " + " | ".join(cells) + " |")
    psnr = {row: figures["truth_masked_psnr"] for row, figures in found.items()}
    lost = psnr["true", "off"] - psnr["disturbed", "off"]
    harm = psnr["true", "off"] - psnr["true", "SO3xR3"]
    lines += ["", f"The disturbance costs {lost:.2f} dB. Refining true poses in training costs {harm:+.2f} dB."]
    for row, where in ((("disturbed", "SO3xR3"), "in training"), (("refined", "off"), "before training")):
        lines.append(f"Refining {where} wins back {(psnr[row] - psnr['disturbed', 'off']) / lost:.0%} of it.")
    lines.append(f"Goals: {WON_BACK_GOAL:.0%} won back, at most {HARM_GOAL_DB:g} dB of harm.")
    write_text(options.output / "table.md", "\n".join([*lines, ""]))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
