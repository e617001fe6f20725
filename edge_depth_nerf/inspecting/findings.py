"""Faults and possible faults of a scene. Each finding names the frame and says what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from edge_depth_nerf.inspecting.figures import PictureFigures, Step, steps, usual_length_m
from edge_depth_nerf.inspecting.pose_check import BAD_MEDIAN_PX, bad_steps, pose_figures
from edge_depth_nerf.masks.ego_files import ego_mask_path, vehicles_unknown
from edge_depth_nerf.poses.matches import EpipolarAgreement
from edge_depth_nerf.scene.format import REFINED_POSES
from edge_depth_nerf.scene.reader import SceneFolder
from edge_depth_nerf.scene.writer import best_holdout

GAP_FACTOR = 10
"""Frames are a gap if they are this many times farther apart than usual."""
LARGEST_TURN_DEG = 20.0
"""A turn between two frames is a jump if it is above this and above ten times the usual one."""
LITTLE_LIDAR = 0.25
"""Coverage below this share of the usual LiDAR coverage is reported."""
LARGEST_HIDDEN_SHARE = 0.5
"""A mask that hides more of the lens than this is reported."""
BRIGHTNESS_FACTOR = 2.0
"""A picture this many times darker or brighter than usual is reported."""
LARGEST_FIT_RMS_PX = 0.1
"""A fit worse than this shifts the pictures against LiDAR."""
LARGEST_SCALE_FACTOR = 1.25
"""Monocular distance that differs from LiDAR by more than this factor is not aligned to it."""
LARGEST_SHAPE_ERROR = 0.2
"""Monocular and LiDAR distances that differ by more than this, at the best scale, show different things. On rendered
drives they differ by 0.04 to 0.07; with one camera's transform inverted, by 0.31."""
_NAMED = 5


@dataclass(frozen=True)
class Finding:
    """One thing to fix or to know."""

    kind: str
    """A word for it, such as gap."""
    text: str
    """What is wrong, and what to do."""
    cameras: tuple[str, ...] = ()
    """The cameras concerned; empty for all."""
    frames: tuple[int, ...] = ()
    """The frames concerned; empty for all."""


def find(
    scene: SceneFolder, measured: Sequence[PictureFigures], agreements: Sequence[EpipolarAgreement] = ()
) -> list[Finding]:
    """Run all checks of this module; the most serious findings come first."""
    return [
        *_checks(scene),
        *_layers(scene),
        *_split(scene),
        *_path(scene),
        *_poses(scene, agreements),
        *_timestamps(scene),
        *_fits(scene),
        *_vehicles(scene),
        *_masks(measured),
        *_outliers(measured),
        *_mono_scale(measured),
        *_mono_shape(measured),
    ]


def _frames(numbers: Iterable[int]) -> str:
    """Name some frames: the first few, and the number of the others."""
    listed = sorted(set(numbers))
    some = ", ".join(map(str, listed[:_NAMED]))
    more = f" and {len(listed) - _NAMED} more" if len(listed) > _NAMED else ""
    return f"frame{'s' if len(listed) > 1 else ''} {some}{more}"


def _checks(scene: SceneFolder) -> Iterator[Finding]:
    for said in scene.checks().get("warnings", ()):
        yield Finding("recording", f"{said} Correct it and process the drive again.")


def _layers(scene: SceneFolder) -> Iterator[Finding]:
    has_lidar, has_mono = scene.has("lidar"), scene.has("mono")
    if not has_lidar and not has_mono:
        prior = "there is no prior and training is plain nerfacto"
        if scene.has("motion"):
            prior = "the prior is made of distances from motion alone"
        yield Finding(
            "no_prior",
            f"The scene has neither LiDAR nor monocular maps, so {prior}. Process the drive with its sweeps, or with "
            "--mono.",
        )
    elif not has_lidar:
        yield Finding(
            "no_lidar",
            "The scene has no LiDAR maps, so the prior is from monocular maps alone and its scale is not checked. "
            "Process the drive with its sweeps.",
        )
    elif not has_mono:
        yield Finding(
            "no_mono",
            "The scene has no monocular maps, or not all of them, so only pixels with a LiDAR point have a prior. Run "
            "`edge-depth-nerf estimate-depth`, or process the drive with --mono.",
        )
    if not scene.has("mask"):
        yield Finding(
            "no_mask",
            "The scene has no masks, so training includes the vehicle itself and moving things. Process the drive with "
            "--ego-mask, or add mask_path to transforms.json.",
        )
    for key, count in scene.incomplete.items():
        yield Finding(
            "incomplete",
            f"{key} is given for {count} of {len(scene.pictures)} pictures, which training refuses. Give it for every "
            "picture or for none.",
        )
    if scene.points_path is None:
        yield Finding(
            "no_points",
            "The scene names no point cloud (ply_file_path), so the top view shows only the poses. Process the drive "
            "again if you want a point cloud.",
        )


def _split(scene: SceneFolder) -> Iterator[Finding]:
    if not scene.split_known:
        yield Finding(
            "no_split",
            "The scene does not list its held-out pictures, so ns-train holds out every eighth picture, not whole "
            "frames. Add train_filenames and test_filenames to transforms.json to hold out whole frames.",
        )
    elif not any(picture.held_out for picture in scene.pictures):
        frames = len({picture.frame for picture in scene.pictures})
        advice = f"process the drive with --holdout-every {best_holdout(frames)}" if frames > 1 else "take more frames"
        yield Finding("no_held_out", f"No frame is held out, so ns-eval would use training pictures. Remedy: {advice}.")


def _path(scene: SceneFolder) -> Iterator[Finding]:
    gaps: dict[tuple[int, int], list[tuple[Step, float]]] = {}
    jumps: dict[tuple[int, int], list[tuple[Step, float]]] = {}
    for pictures in scene.cameras().values():
        found = steps(pictures)
        usual_m = usual_length_m(found, scene.own)
        usual_deg = float(np.median([step.turn_deg for step in found])) if found else 0.0
        for step in found:
            between = (step.before.frame, step.after.frame)
            if usual_m > 0 and step.length_m > GAP_FACTOR * usual_m:
                gaps.setdefault(between, []).append((step, usual_m))
            elif step.turn_deg > max(LARGEST_TURN_DEG, GAP_FACTOR * usual_deg):
                jumps.setdefault(between, []).append((step, usual_deg))
    unit = "m" if scene.own else "scene units"
    for (before, after), seen in gaps.items():
        step, usual_m = max(seen, key=lambda item: item[0].length_m)
        yield Finding(
            "gap",
            f"Frames {before} and {after} are {step.length_m:.3g} {unit} apart, {step.length_m / usual_m:.0f} times "
            f"the usual {usual_m:.2g} {unit}. Check for missing or wrong poses there, or make two scenes of the drive "
            "with --first and --frames.",
            tuple(step.before.camera for step, _ in seen),
            (before, after),
        )
    for (before, after), seen in jumps.items():
        step, usual_deg = max(seen, key=lambda item: item[0].turn_deg)
        yield Finding(
            "turn",
            f"From frame {before} to {after} the camera turns by {step.turn_deg:.0f} degrees; {usual_deg:.1f} are "
            "usual. Check both poses, and leave out the frame whose pose is wrong.",
            tuple(step.before.camera for step, _ in seen),
            (before, after),
        )


def _poses(scene: SceneFolder, agreements: Sequence[EpipolarAgreement]) -> Iterator[Finding]:
    refined = scene.path.with_name(REFINED_POSES).is_file()
    remedy = (
        "find new poses with --poses lidar or --poses colmap, and check the lens and the times of the pictures"
        if refined
        else "process the drive with --refine-poses (needs pycolmap), or find new poses with --poses lidar or "
        "--poses colmap"
    )
    for name in scene.cameras():
        figures, bad = pose_figures(agreements, name), bad_steps(agreements, name)
        if figures is not None and figures["median_px"] > BAD_MEDIAN_PX:
            yield Finding(
                "poses",
                f"Features of {name} are {figures['median_px']:.2f} px from their epipolar lines (median; 0.1 to 0.2 "
                f"px are usual), so the poses are inaccurate. Remedy: {remedy}.",
                (name,),
            )
        elif figures is not None and bad:
            worst = max(bad, key=lambda one: one.median_px)
            yield Finding(
                "poses",
                f"From frame {worst.first} to {worst.second} of {name}"
                + (f" and at {len(bad) - 1} more steps" if len(bad) > 1 else "")
                + f" features are {worst.median_px:.1f} px from their epipolar lines; {figures['median_px']:.2f} px "
                f"are usual. Remedy: {remedy}.",
                (name,),
                tuple(sorted({frame for one in bad for frame in (one.first, one.second)})),
            )


def _timestamps(scene: SceneFolder) -> Iterator[Finding]:
    for name, pictures in scene.cameras().items():
        wrong = [step.after.frame for step in steps(pictures) if step.seconds is not None and step.seconds <= 0]
        if wrong:
            yield Finding(
                "timestamps",
                f"The timestamps of {name} do not increase at {_frames(wrong)}. Correct the recording's timestamps; "
                "sweeps are de-skewed and poses are interpolated with them.",
                (name,),
                tuple(wrong),
            )


def _fits(scene: SceneFolder) -> Iterator[Finding]:
    for name in scene.cameras():
        rms_px = scene.recorded("camera_fits", name).get("rms_px")
        if isinstance(rms_px, (int, float)) and rms_px > LARGEST_FIT_RMS_PX:
            yield Finding(
                "fit",
                f"The fisheye model fitted to {name} has an error of {rms_px:.2f} px rms. Check the calibration, or "
                "process the drive with a smaller --theta-max-deg.",
                (name,),
            )


def _by_camera(measured: Sequence[PictureFigures]) -> dict[str, list[PictureFigures]]:
    found: dict[str, list[PictureFigures]] = {}
    for figures in measured:
        found.setdefault(figures.picture.camera, []).append(figures)
    return found


def _vehicles(scene: SceneFolder) -> Iterator[Finding]:
    cameras = scene.cameras()
    for name in vehicles_unknown(scene.path.parent):
        if name in cameras:
            yield Finding(
                "vehicle",
                f"The vehicle itself was not found in the pictures of {name}: they are too few or too similar. If it "
                f"is visible, paint it black in {ego_mask_path(scene.path.parent, name)} and process the drive again.",
                (name,),
            )


def _masks(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    for name, figures in _by_camera(measured).items():
        hidden = {one.picture.frame: one.hidden_share for one in figures if one.hidden_share > LARGEST_HIDDEN_SHARE}
        if not hidden:
            continue
        which = f"The mask of {name}" if len(hidden) == len(figures) else f"The mask of {_frames(hidden)} of {name}"
        yield Finding(
            "mask",
            f"{which} hides {max(hidden.values()):.0%} of the lens. Check that this is intended (255 = use the pixel, "
            "0 = ignore it).",
            (name,),
            () if len(hidden) == len(figures) else tuple(hidden),
        )


def _little_lidar(camera: str, measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    """Find pictures with far less LiDAR than the others of their camera; held-out ones may have one sweep alone."""
    for held_out in (False, True):
        shares = {
            one.picture.frame: one.lidar_coverage
            for one in measured
            if one.lidar_coverage is not None and one.picture.held_out == held_out
        }
        usual = float(np.median(list(shares.values()))) if shares else 0.0
        little = [frame for frame, share in shares.items() if share < LITTLE_LIDAR * usual]
        if little:
            of_split = "held-out pictures" if held_out else "training pictures"
            yield Finding(
                "lidar",
                f"LiDAR covers {min(shares[frame] for frame in little):.2%} of {_frames(little)} of {camera}; "
                f"{usual:.2%} is usual for {of_split}. Check that the sweep is complete and the pose is right.",
                (camera,),
                tuple(little),
            )


def _outliers(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    """Find pictures with far less LiDAR, or far darker or brighter, than the others of their camera."""
    for name, figures in _by_camera(measured).items():
        coverage = {one.picture.frame: one.lidar_coverage for one in figures if one.lidar_coverage is not None}
        usual = float(np.median(list(coverage.values()))) if coverage else 0.0
        if coverage and usual == 0:
            yield Finding(
                "lidar",
                f"Most LiDAR maps of {name} are empty. Check the calibration from the scanner to this camera.",
                (name,),
            )
        yield from _little_lidar(name, figures)
        brightness = {one.picture.frame: one.brightness for one in figures}
        usual = float(np.median(list(brightness.values())))
        strange = {
            "dark": [frame for frame, grey in brightness.items() if grey * BRIGHTNESS_FACTOR < usual],
            "bright": [frame for frame, grey in brightness.items() if grey > BRIGHTNESS_FACTOR * usual],
        }
        for word, frames in strange.items():
            if frames:
                yield Finding(
                    word,
                    f"The picture of {_frames(frames)} of {name} is {word}: mean grey {brightness[frames[0]]:.0f}, "
                    f"{usual:.0f} is usual. Leave it out if it is badly exposed.",
                    (name,),
                    tuple(frames),
                )


def _mono_scale(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    def off(ratio: float) -> bool:
        return max(ratio, 1 / ratio) > LARGEST_SCALE_FACTOR

    for name, figures in _by_camera(measured).items():
        ratios = {
            one.picture.frame: float(np.median(one.mono_over_lidar)) for one in figures if len(one.mono_over_lidar)
        }
        wrong = {frame: ratio for frame, ratio in ratios.items() if off(ratio)}
        if not wrong:
            continue
        every = len(wrong) * 2 > len(ratios)
        ratio = float(np.median(list(wrong.values())))
        which = name if every else f"{_frames(wrong)} of {name}"
        yield Finding(
            "mono_scale",
            f"Monocular distance is {ratio:.2f} times LiDAR's in {which} (median). Check that the maps contain metres "
            "along the ray in steps of 1/256 m, or align them to LiDAR.",
            (name,),
            () if every else tuple(wrong),
        )


def _mono_shape(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    """Find wrong transforms: LiDAR covers the pictures as usual, but with other objects than they show."""
    for name, figures in _by_camera(measured).items():
        ratios = [one.mono_over_lidar for one in figures if len(one.mono_over_lidar)]
        if not ratios:
            continue
        # the scale of each map does not matter
        off = float(np.median(np.concatenate([np.abs(ratio / np.median(ratio) - 1) for ratio in ratios])))
        if off > LARGEST_SHAPE_ERROR:
            yield Finding(
                "mono_shape",
                f"Monocular and LiDAR distances differ by {off:.0%} in {name} (median, after each map was scaled). "
                "Check in the sheets that LiDAR points are on their objects. If not, a transform or a clock is wrong.",
                (name,),
            )


def limited(findings: Sequence[Finding]) -> list[str]:
    """Return the sentences to print: of each kind at most the first few."""
    counts: dict[str, int] = {}
    lines = []
    for finding in findings:
        counts[finding.kind] = counts.get(finding.kind, 0) + 1
        if counts[finding.kind] <= _NAMED:
            lines.append(finding.text)
    dropped = {kind: count - _NAMED for kind, count in counts.items() if count > _NAMED}
    lines += [f"{count} more of the kind '{kind}' are in summary.json." for kind, count in dropped.items()]
    return lines
