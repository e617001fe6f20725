"""The depth prior against truth: alignment, integration, rivals and calibration, on drives of the own generator.

    python benchmarks/prior.py --output outputs/prior [--mono network|simulated] [--drives street parking turn]
        [--seeds 0 1 2] [--frames 40] [--size 350] [--seconds 300] [--variants] [--scenes DIR …]
        [--real kitti360_fisheye_frame [--real-mono MAP.png]]

Synthesises, processes and, with `--mono network`, trains a network on the training frames (the default; some four
minutes a drive), or takes finished scenes that have truth. Drives, scenes, networks and figures stay under the output
folder: a run that was stopped goes on there. Then prints, for training and for held-out pictures, per drive, mean and
standard deviation over its seeds, against truth from 1 to 60 m inside the mask:

  coverage, AbsRel, RMSE and δ<1.25 of LiDAR alone, mono as it came, fitted by one curve a frame, aligned locally,
  aligned with the returns put in and no kernel, integrated with a spatial Gaussian (pooled as in the paper, and with
  the options of the integration), integrated, and completed along the picture's colours (`mono/completion.py`, of mono
  as it came and of the aligned map);
  the same inside and outside LiDAR's field of elevation (± 3°), within 4 px of depth edges, by ring of angle from the
  axis, and by distance in pixels from the nearest return;
  the part of the prior's pixels whose error is within 1 and 2 of its sigma;
  for each drive and seed, whether the prior reaches what it is meant to.

All figures are kept in figures/ as JSON as well. `--variants` compares the ways to integrate. `--real` holds a fifth of
one real frame's LiDAR out in blocks of 64 px and judges against it; its monocular map is a network's, trained on the
other blocks, or the one given; a picture of it lies beside.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from edge_depth_nerf.base.files import read_distance_png, read_image, read_json, write_json, write_png
from edge_depth_nerf.base.pictures import colour_distance
from edge_depth_nerf.cameras import MEI
from edge_depth_nerf.method.alignment import Fit, align
from edge_depth_nerf.method.error_model import Trust
from edge_depth_nerf.method.integration import integrate_depth
from edge_depth_nerf.method.metrics import JUDGED_RANGE_M
from edge_depth_nerf.method.prior import Prior, PriorOptions, View, make_prior, view_of
from edge_depth_nerf.mono.calibration import find_trust
from edge_depth_nerf.mono.completion import complete
from edge_depth_nerf.mono.estimate import estimate_depth
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.process.kitti360.converter import process_kitti360
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene.reader import read_scene
from edge_depth_nerf.scene.writer import FrameContent, SceneCamera, SceneFrame, write_scene
from edge_depth_nerf.synthetic.drive import synthesize_drive
from edge_depth_nerf.synthetic.options import SynthesizeOptions

EDGE_STEP = 1.2
"""Neighbouring true distances with a larger ratio are a depth edge; the sky is beyond everything."""
EDGE_PX = 4
RINGS_DEG = (0, 30, 60, 90, 180)
NEAREST_PX = (0, 1, 3, 9, 33)
"""Least distances of the classes: at a return, 1-2, 3-8, 9-32 and more."""
REAL_BLOCK_PX, REAL_PART = 64, 0.2
MONO_SIGMA = 0.1
"""Standard deviation of a monocular map that nothing is known of, as a part of its distance."""
IN_FIELD, AT_EDGES = "in LiDAR's field", "in it, at edges"
MONO_AT_MOST, ALIGNED_AT_MOST = 0.15, 0.7
"""What the prior is meant to reach: AbsRel of mono, and that of aligned mono as a part of mono's."""
PATTERNS = ("{:.0%}", "{:.4f}", "{:.2f}", "{:.3f}")
WITHIN, WITHIN_MARGIN = (0.68, 0.95), 0.05

Maps = dict[str, NDArray[np.float32]]


@dataclass
class Sums:
    """Errors of many pixels."""

    pixels: int = 0
    known: int = 0
    relative: float = 0.0
    squared: float = 0.0
    close: int = 0

    def add(self, estimate_m: NDArray, truth_m: NDArray) -> None:
        """Add pixels that are all to be judged; 0 = no estimate."""
        has = estimate_m > 0
        found, true = estimate_m[has].astype(np.float64), truth_m[has].astype(np.float64)
        self.pixels += len(has)
        self.known += len(found)
        self.relative += float((np.abs(found - true) / true).sum())
        self.squared += float(((found - true) ** 2).sum())
        self.close += int((np.maximum(found / true, true / found) < 1.25).sum())

    def figures(self) -> list[float | None]:
        """Coverage, AbsRel, RMSE, δ; None where there is nothing to judge."""
        if not self.known:
            return [None] * 4
        shares = [self.relative / self.known, (self.squared / self.known) ** 0.5, self.close / self.known]
        return [self.known / self.pixels, *shares]


@dataclass
class Within:
    """Calibration of sigma over many pixels."""

    pixels: int = 0
    one: int = 0
    two: int = 0

    def add(self, scaled_error: NDArray) -> None:
        """Add errors in units of sigma."""
        self.pixels += len(scaled_error)
        self.one += int((scaled_error <= 1).sum())
        self.two += int((scaled_error <= 2).sum())

    def figures(self) -> list[float | None]:
        """Part within 1 and 2; None without pixels."""
        return [n / self.pixels if self.pixels else None for n in (self.one, self.two)]


@dataclass(frozen=True)
class Frame:
    """A picture and its maps."""

    rgb: NDArray[np.uint8]
    lidar_m: NDArray[np.float32]
    mono_m: NDArray[np.float32]
    truth_m: NDArray[np.float32]
    usable: NDArray[np.bool_]
    view: View
    held_out: bool


def frames_of(scene: Path, training_stride: int) -> Iterator[Frame]:
    """All held-out pictures and some of those for training."""
    read = read_scene(scene)
    training = [picture for picture in read.pictures if not picture.held_out][::training_stride]
    for picture in [*training, *(picture for picture in read.pictures if picture.held_out)]:
        maps = read.maps(picture)
        if maps.lidar_m is None or maps.mono_m is None or maps.truth_m is None:
            raise SystemExit(f"{scene}: {picture.name} has not all of LiDAR, mono and truth; nothing to judge by")
        view = view_of(picture.lens, picture.up_in_camera)
        yield Frame(maps.rgb, maps.lidar_m, maps.mono_m, maps.truth_m, maps.usable, view, picture.held_out)


def integrated(frame: Frame, mono_m: NDArray[np.float32], **changed: object) -> NDArray[np.float32]:
    """The integration of the default prior, but for some options."""
    options = replace(PriorOptions().integration, **changed)  # pyright: ignore[reportArgumentType]
    lidar, mono, usable = (torch.from_numpy(pixels) for pixels in (frame.lidar_m, mono_m, frame.usable))
    return integrate_depth(lidar, mono, usable, options).distance_m.float().numpy()


def rivals(frame: Frame, drive_fit: Fit | None, prior: Prior | None, variants: bool) -> Maps:
    """All maps to be compared; the completion of the aligned map has the prior's sigma where there is one."""
    aligned = align(frame.lidar_m, frame.mono_m, frame.usable, "local", drive_fit).mono_m
    one_curve = align(frame.lidar_m, frame.mono_m, frame.usable, "global", drive_fit).mono_m
    guess_m = (MONO_SIGMA * aligned).astype(np.float32)
    sigma_m = guess_m if prior is None else np.where(prior.sigma_m > 0, prior.sigma_m, guess_m)
    literal = {"normalise": "pooled", "keep_returns": False, "sigma_depth_growth_per_m": 0.0}

    def completed(mono_m: NDArray[np.float32], mono_sigma_m: NDArray[np.float32]) -> NDArray[np.float32]:
        return complete(frame.rgb, frame.lidar_m, mono_m, mono_sigma_m, frame.usable)

    maps = {
        "LiDAR": frame.lidar_m,
        "mono": frame.mono_m,
        "mono, one curve a frame": one_curve,
        "mono aligned": aligned,
        "aligned, returns kept": np.where(frame.usable & (frame.lidar_m > 0), frame.lidar_m, aligned),
        "spatial Gaussian, pooled": integrated(frame, aligned, integration="spatial-gaussian", **literal),
        "spatial Gaussian": integrated(frame, aligned, integration="spatial-gaussian"),
        "integrated": integrated(frame, aligned),
        "completion of mono": completed(frame.mono_m, (MONO_SIGMA * frame.mono_m).astype(np.float32)),
        "completion of aligned": completed(aligned, sigma_m),
    }
    if variants:
        maps["paper: not aligned, pooled"] = integrated(frame, frame.mono_m, **literal)
        maps["not aligned, as integrated"] = integrated(frame, frame.mono_m)
        maps["sigma of 1 m at any distance"] = integrated(frame, aligned, sigma_depth_growth_per_m=0.0)
        for normalise in ("pooled", "per-source"):
            for guide in ("mono", "lidar"):
                changed = {**literal, "normalise": normalise, "range_guide": guide}
                maps[f"returns averaged, {normalise}, guide {guide}"] = integrated(frame, aligned, **changed)
        maps["pooled, returns kept"] = integrated(frame, aligned, normalise="pooled")
    return maps


def regions(frame: Frame, trust: Trust) -> dict[str, NDArray[np.bool_]]:
    """Where figures are taken, among the pixels that are judged."""
    low, high = JUDGED_RANGE_M
    judged = frame.usable & (frame.truth_m >= low) & (frame.truth_m <= high)
    in_field = trust.in_field(frame.view.elevation_rad)
    kernel = np.ones((3, 3), np.uint8)
    far = np.where(frame.truth_m > 0, frame.truth_m, np.float32(1e4))
    # the unusable pixels around the picture are no edge
    farthest = cv2.dilate(np.where(frame.usable, far, 0), kernel)
    nearest = cv2.erode(np.where(frame.usable, far, np.float32(1e9)), kernel)
    edge = frame.usable & (farthest > EDGE_STEP * nearest)
    near_edge = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 5) <= EDGE_PX
    returns = frame.usable & (frame.lidar_m > 0)
    to_return = cv2.distanceTransform((~returns).astype(np.uint8), cv2.DIST_L2, 5)
    theta_deg = np.degrees(frame.view.theta_rad)
    found = {
        "overall": judged,
        IN_FIELD: judged & in_field,
        AT_EDGES: judged & in_field & near_edge,
        "in it, off edges": judged & in_field & ~near_edge,
        "outside it": judged & ~in_field,
        "at edges": judged & near_edge,
    }
    for least, beyond in itertools.pairwise(RINGS_DEG):
        name = f"beyond {least}°" if beyond == RINGS_DEG[-1] else f"{least}-{beyond}°"
        found[name] = judged & (theta_deg >= least) & (theta_deg < beyond)
    for least, beyond in itertools.pairwise((*NEAREST_PX, np.inf)):
        name = "at a return" if least == 0 else f"{least}-{beyond - 1:.0f} px" if beyond < np.inf else f"{least} px on"
        found[name] = judged & (np.floor(to_return) >= least) & (np.floor(to_return) < beyond)
    return found


Figures = dict[str, dict[str, dict[str, list]]]
"""errors: for each region and map coverage, AbsRel, RMSE in metres, δ. sigma: for each region the parts within."""


class Result:
    """Sums over the pictures of a scene."""

    def __init__(self) -> None:
        self.errors: dict[str, dict[str, Sums]] = {}
        self.calibration: dict[str, Within] = {}

    def add(self, frame: Frame, trust: Trust, variants: bool) -> None:
        """Add a picture."""
        where = regions(frame, trust)
        prior = make_prior(frame.lidar_m, frame.mono_m, frame.usable, PriorOptions(), trust, frame.view)
        maps = rivals(frame, trust.drive_fit, prior, variants)
        has = prior.distance_m > 0
        for region, pixels in where.items():
            for name, estimate in maps.items():
                sums = self.errors.setdefault(region, {}).setdefault(name, Sums())
                sums.add(estimate[pixels], frame.truth_m[pixels])
            chosen = pixels & has
            scaled = np.abs(prior.distance_m[chosen] - frame.truth_m[chosen]) / prior.sigma_m[chosen]
            self.calibration.setdefault(region, Within()).add(scaled)

    def figures(self) -> Figures:
        """As they are kept."""
        errors = {r: {name: sums.figures() for name, sums in maps.items()} for r, maps in self.errors.items()}
        return {"errors": errors, "sigma": {r: {"sigma": within.figures()} for r, within in self.calibration.items()}}


def mean_and_spread(values: list[float | None], pattern: str) -> str:
    """Mean of the seeds and their standard deviation."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    spread = f" ± {pattern.format(np.std(known))}" if len(values) > 1 else ""
    return pattern.format(np.mean(known)) + spread


def show(console: Console, title: str, seeds: list[Figures]) -> None:
    """Print both tables of a drive."""
    table = Table("where", "map", "coverage", "AbsRel", "RMSE, m", "δ<1.25", title=title)
    for region, maps in seeds[0]["errors"].items():
        for name in maps:
            columns = zip(*(figures["errors"][region][name] for figures in seeds), strict=True)
            cells = [mean_and_spread(list(c), pattern) for c, pattern in zip(columns, PATTERNS, strict=True)]
            table.add_row(region if name == next(iter(maps)) else "", name, *cells)
        table.add_section()
    console.print(table)
    table = Table("where", "within 1 sigma", "within 2 sigma", title=f"{title}: calibration of sigma")
    for region in seeds[0]["sigma"]:
        columns = zip(*(figures["sigma"][region]["sigma"] for figures in seeds), strict=True)
        table.add_row(region, *(mean_and_spread(list(column), "{:.1%}") for column in columns))
    console.print(table)


def show_goals(console: Console, drives: dict[str, dict[str, Figures]]) -> None:
    """Print for each scene whether the prior reaches what it is meant to; what misses is marked."""
    title = "in LiDAR's field (at edges), pictures for training; ! misses"
    table = Table("scene", "mono", "aligned", "of mono", "spatial G.", "integrated", "1 sigma", "2 sigma", title=title)
    for scenes in drives.values():
        for scene, figures in scenes.items():
            field, edges = (
                {name: values[1] for name, values in figures["errors"][region].items()}
                for region in (IN_FIELD, AT_EDGES)
            )
            best = all(
                errors["integrated"] < min(errors["mono aligned"], errors["spatial Gaussian"])
                for errors in (field, edges)
            )
            share = field["mono aligned"] / field["mono"]
            cells = [f"{field['mono']:.4f}{'' if field['mono'] <= MONO_AT_MOST else ' !'}"]
            cells += [f"{field['mono aligned']:.4f} ({edges['mono aligned']:.4f})"]
            cells += [f"{share:.2f}{'' if share <= ALIGNED_AT_MOST else ' !'}"]
            cells += [f"{field['spatial Gaussian']:.4f} ({edges['spatial Gaussian']:.4f})"]
            cells += [f"{field['integrated']:.4f} ({edges['integrated']:.4f}){'' if best else ' !'}"]
            for found, wanted in zip(figures["sigma"][IN_FIELD]["sigma"], WITHIN, strict=True):
                cells.append(f"{found:.1%}{'' if abs(found - wanted) <= WITHIN_MARGIN else ' !'}")
            table.add_row(scene, *cells)
    console.print(table)


def make_scene(arguments: argparse.Namespace, drive: str, seed: int, console: Console) -> Path:
    """Synthesise and process a drive, once."""
    scene = arguments.output / f"{drive}-{seed}-{arguments.mono}"
    if (scene / "finished").is_file():
        return scene
    raw = arguments.output / f"{drive}-{seed}-raw"
    options = SynthesizeOptions(output=raw, scene=drive, frames=arguments.frames, size=arguments.size, seed=seed)  # pyright: ignore[reportArgumentType]
    console.print(f"{drive}, seed {seed}")
    synthesize_drive(options)
    process_kitti360(
        Kitti360Options(
            root=raw,
            sequence=options.sequence,
            output=scene,
            sweeps=arguments.sweeps,
            # a network's maps replace them
            mono=raw / "simulated_mono" / options.sequence,
        ),
        console,
    )
    if arguments.mono == "network":
        estimate_depth(EstimateDepthOptions(scenes=(scene,), seconds=arguments.seconds), console)
    (scene / "finished").touch()
    return scene


def judge(scene: Path, arguments: argparse.Namespace, console: Console) -> dict[str, Figures]:
    """Figures of a scene's pictures for training and of the held-out ones, from before if nothing has changed."""
    trust = find_trust(scene, PriorOptions(), console=console)
    console.print(f"{scene}: {trust.summary()}", soft_wrap=True)
    made_of = [trust.made_of, arguments.stride, arguments.variants]
    kept = arguments.output / "figures" / f"{scene.name}.json"
    if kept.is_file() and (found := read_json(kept))["made_of"] == made_of:
        return found["figures"]
    results = {"training": Result(), "held out": Result()}
    for frame in track(list(frames_of(scene, arguments.stride)), f"{scene.name}…", console=console, transient=True):
        results["held out" if frame.held_out else "training"].add(frame, trust, arguments.variants)
    figures = {part: result.figures() for part, result in results.items()}
    write_json(kept, {"made_of": made_of, "figures": figures})
    return figures


def run_drives(arguments: argparse.Namespace, console: Console) -> None:
    """Figures of all drives."""
    if arguments.scenes:
        groups = {scene.name: [scene] for scene in arguments.scenes}
    else:
        groups = {d: [make_scene(arguments, d, seed, console) for seed in arguments.seeds] for d in arguments.drives}
    training: dict[str, dict[str, Figures]] = {}
    for drive, scenes in groups.items():
        figures = {scene.name: judge(scene, arguments, console) for scene in scenes}
        show(console, f"{drive}, pictures for training", [found["training"] for found in figures.values()])
        show(console, f"{drive}, held-out pictures", [found["held out"] for found in figures.values()])
        training[drive] = {scene: found["training"] for scene, found in figures.items()}
    show_goals(console, training)


# ---- one real frame -------------------------------------------------------------------------------------------------


def real_scene(folder: Path, output: Path, held_out: NDArray[np.bool_]) -> Path:
    """The real frame as a scene of one picture, without the LiDAR of the held-out blocks."""
    sample = read_json(folder / "kitti360_sample.json")["cam_params"]
    # KITTI-360 counts integer pixel centres
    centre = {"cx": sample["cx"] + 0.5, "cy": sample["cy"] + 0.5}
    rest = {name: sample[name] for name in ("fx", "fy", "xi", "k1", "k2", "p1", "p2")}
    camera = MEI(width=1400, height=1400, **centre, **rest)
    usable = ~np.load(folder / "mask_left_fisheye.npy")
    lidar = np.where(held_out, np.float32(0), read_distance_png(folder / "kitti360_depth.png"))
    # the camera looks to the left, its x axis along the drive: z of the world is up
    pose = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    content = FrameContent(image=read_image(folder / "kitti360_rgb.png"), lidar=lidar)
    frame = SceneFrame(camera="image_02", frame=0, camera_to_world=pose, content=content, held_out=False)
    cameras = [SceneCamera("image_02", camera, usable)]
    write_scene(output, cameras, [frame], layers=("lidar",), source={"recording": "KITTI-360, one fisheye frame"})
    return output


def filled(lidar_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """A stand-in for a network: LiDAR spread smoothly over the whole picture, with a slow error of 15 %."""
    known = (lidar_m > 0).astype(np.float32)
    logs = np.log(np.where(lidar_m > 0, lidar_m, 1)).astype(np.float32)
    total, weight = np.zeros_like(logs), np.zeros_like(logs)
    for sigma_px, share in ((12, 1.0), (50, 0.03), (200, 0.001)):
        total += share * cv2.GaussianBlur(logs * known, (0, 0), sigma_px)
        weight += share * cv2.GaussianBlur(known, (0, 0), sigma_px)
    height, width = lidar_m.shape
    y, x = np.mgrid[:height, :width] / max(height, width)
    error = 0.15 * np.sin(5 * x + 1) * np.cos(4 * y)
    return np.exp(total / np.maximum(weight, 1e-9) + error).astype(np.float32)


def run_real(arguments: argparse.Namespace, console: Console) -> None:
    """Figures of the real frame at its held-out returns, and a picture."""
    folder = arguments.real
    lidar_m = read_distance_png(folder / "kitti360_depth.png")
    blocks = -(-1400 // REAL_BLOCK_PX)
    chosen = (np.random.default_rng(0).permutation(blocks**2) < round(REAL_PART * blocks**2)).reshape(blocks, blocks)
    held_out = np.kron(chosen, np.ones((REAL_BLOCK_PX, REAL_BLOCK_PX), bool))[:1400, :1400]
    scene = arguments.output / "real"
    if not (scene / "transforms.json").is_file():
        real_scene(folder, scene, held_out)
    kept_m = np.where(held_out, np.float32(0), lidar_m)
    if arguments.real_mono is not None:
        mono_m, label = read_distance_png(arguments.real_mono), f"mono from {arguments.real_mono.name}"
    elif arguments.mono == "network":
        mono_file = scene / "mono" / "image_02" / "0000000000.png"
        if not mono_file.is_file():
            estimate_depth(EstimateDepthOptions(scenes=(scene,), seconds=arguments.seconds), console)
        mono_m, label = read_distance_png(mono_file), "mono from a network trained on the other blocks"
    else:
        mono_m, label = filled(kept_m), "STAND-IN for mono: LiDAR of the other blocks spread smoothly, no network"
    read = read_scene(scene)
    picture = read.pictures[0]
    found = read.maps(picture)
    usable = found.usable
    view = view_of(picture.lens, picture.up_in_camera)
    frame = Frame(found.rgb, kept_m, mono_m, np.where(held_out, lidar_m, np.float32(0)), usable, view, held_out=True)
    maps = rivals(frame, None, None, arguments.variants)
    low, high = JUDGED_RANGE_M
    judged = usable & held_out & (lidar_m >= low) & (lidar_m <= high)
    returns = usable & (kept_m > 0)
    near = cv2.distanceTransform((~returns).astype(np.uint8), cv2.DIST_L2, 5)
    table = Table("where", "map", "coverage", "AbsRel", "RMSE, m", "δ<1.25", title=f"real frame; {label}")
    for region, pixels in {"held-out blocks": judged, "up to 8 px from a return": judged & (near <= 8)}.items():
        for name, estimate in maps.items():
            sums = Sums()
            sums.add(estimate[pixels], lidar_m[pixels])
            cells = [mean_and_spread([v], pattern) for pattern, v in zip(PATTERNS, sums.figures(), strict=True)]
            table.add_row(region if name == "LiDAR" else "", name, *cells)
        table.add_section()
    console.print(table)
    panels = [read_image(folder / "kitti360_rgb.png")]
    panels += [colour_distance(np.where(usable, maps[n], 0)) for n in ("LiDAR", "mono", "mono aligned", "integrated")]
    # a return is a pixel of 1400: made larger to be seen
    panels[1] = colour_distance(cv2.dilate(np.where(usable, maps["LiDAR"], np.float32(0)), np.ones((5, 5), np.uint8)))
    small = [cv2.resize(panel, (700, 700), interpolation=cv2.INTER_AREA) for panel in panels]
    write_png(arguments.output / "real.png", np.concatenate(small, 1))
    console.print(f"{arguments.output / 'real.png'}: picture, LiDAR used, mono, mono aligned, integrated")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--output", type=Path, default=Path("outputs/prior"), help="drives, scenes and pictures")
    parser.add_argument("--mono", choices=("network", "simulated"), default="network", help="source of the maps")
    parser.add_argument("--drives", nargs="*", default=["street", "parking", "turn"], help="of the own generator")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="of the drives")
    parser.add_argument("--frames", type=int, default=40, help="of a drive")
    parser.add_argument("--size", type=int, default=350, help="width and height, pixels")
    parser.add_argument("--sweeps", type=int, default=3, help="sweeps before and after a picture's own")
    parser.add_argument("--seconds", type=float, default=300, help="training of a drive's network at most")
    parser.add_argument("--stride", type=int, default=4, help="every so manieth training picture is judged")
    parser.add_argument("--variants", action="store_true", help="compare the ways to integrate")
    parser.add_argument("--scenes", nargs="*", type=Path, default=[], help="finished scenes with truth, as they are")
    parser.add_argument("--real", type=Path, help="folder of the real fisheye frame")
    parser.add_argument("--real-mono", type=Path, help="16-bit PNG of its monocular distance")
    arguments = parser.parse_args()
    console = Console(width=None if Console().is_terminal else 120)
    if arguments.scenes or arguments.drives:
        run_drives(arguments, console)
    if arguments.real is not None:
        run_real(arguments, console)


if __name__ == "__main__":
    main()
