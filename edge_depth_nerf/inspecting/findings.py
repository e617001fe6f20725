"""What is wrong with a scene, or may be: each finding one sentence that names the frame and what to do."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from edge_depth_nerf.inspecting.figures import PictureFigures, Step, recorded, steps, usual_length_m
from edge_depth_nerf.inspecting.pose_check import BAD_MEDIAN_PX, bad_steps, pose_figures
from edge_depth_nerf.masks.ego_files import ego_mask_path, vehicles_unknown
from edge_depth_nerf.poses.matches import Agreement
from edge_depth_nerf.scene.reader import SceneFolder
from edge_depth_nerf.scene.writer import best_holdout

GAP_FACTOR = 10
"""Frames so many times farther apart than usual are a gap."""
LARGEST_TURN_DEG = 20.0
"""A turn between two frames is a jump above this, and above ten times the usual one."""
LITTLE_LIDAR = 0.25
"""A frame with less than this part of the usual LiDAR coverage has little."""
LARGEST_HIDDEN_SHARE = 0.5
"""A mask that hides more of the lens than this is worth a look."""
BRIGHTNESS_FACTOR = 2.0
"""A picture so many times darker or brighter than usual is worth a look."""
LARGEST_FIT_RMS_PX = 0.1
"""A fit worse than this shifts what training sees against LiDAR."""
LARGEST_SCALE_FACTOR = 1.25
"""Monocular distance that is off by more than this against LiDAR is not aligned to it."""
LARGEST_SHAPE_ERROR = 0.2
"""Where monocular and LiDAR distance differ by more than this whatever the scale, they are not of the same things. On
rendered drives it is 0.04-0.07, with one camera's transform inverted 0.31."""
_NAMED = 5


@dataclass(frozen=True)
class Finding:
    """One thing to mend or to know."""

    kind: str
    """A word for it, such as gap."""
    text: str
    """One sentence."""
    cameras: tuple[str, ...] = ()
    """The cameras concerned; none for all."""
    frames: tuple[int, ...] = ()
    """The moments concerned; none for all."""

    def to_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def find(scene: SceneFolder, measured: Sequence[PictureFigures], agreements: Sequence[Agreement] = ()) -> list[Finding]:
    """Look for everything that this module knows; the gravest first."""
    return [
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
    """Name some frames, the first few in full."""
    listed = sorted(set(numbers))
    some = ", ".join(map(str, listed[:_NAMED]))
    more = f" and {len(listed) - _NAMED} more" if len(listed) > _NAMED else ""
    return f"frame{'s' if len(listed) > 1 else ''} {some}{more}"


def _layers(scene: SceneFolder) -> Iterator[Finding]:
    has_lidar, has_mono = scene.has("lidar"), scene.has("mono")
    if not has_lidar and not has_mono:
        yield Finding(
            "no_prior",
            "The scene has neither LiDAR nor monocular maps, so no ray has a prior and training is plain nerfacto; "
            "process the drive with its sweeps, or with --mono.",
        )
    elif not has_lidar:
        yield Finding(
            "no_lidar",
            "The scene has no LiDAR maps, so the prior is monocular alone and its scale is not checked; process the "
            "drive with its sweeps.",
        )
    elif not has_mono:
        yield Finding(
            "no_mono",
            "The scene has no monocular maps, so only pixels with a return have a prior; make them, or finish those "
            "that were begun, with `edge-depth-nerf estimate-depth`, or process the drive with --mono.",
        )
    if not scene.has("mask"):
        yield Finding(
            "no_mask",
            "The scene has no masks, so the vehicle itself and moving things are trained on; give --ego-mask when you "
            "process the drive, or mask_path in transforms.json.",
        )
    for key, count in scene.incomplete.items():
        yield Finding(
            "incomplete",
            f"{key} is given for {count} of {len(scene.pictures)} frames, which training refuses; give it for every "
            "frame or for none.",
        )
    if scene.points_path is None:
        yield Finding(
            "no_points",
            "The scene names no point cloud (ply_file_path), so the top view shows the poses alone; process the drive "
            "again if you want one.",
        )


def _split(scene: SceneFolder) -> Iterator[Finding]:
    if not scene.split_known:
        yield Finding(
            "no_split",
            "The scene does not say which pictures are held out, so ns-train takes every eighth picture, whatever "
            "moment it is of; give train_filenames and test_filenames in transforms.json to judge by whole moments.",
        )
    elif not any(picture.held_out for picture in scene.pictures):
        moments = len({picture.moment for picture in scene.pictures})
        advice = (
            f"process the drive with --holdout-every {best_holdout(moments)}" if moments > 1 else "take more frames"
        )
        yield Finding(
            "no_held_out",
            f"No frame is held out, so the figures of ns-eval are of pictures that were trained on; {advice}.",
        )


def _path(scene: SceneFolder) -> Iterator[Finding]:
    gaps: dict[tuple[int, int], list[tuple[Step, float]]] = {}
    jumps: dict[tuple[int, int], list[tuple[Step, float]]] = {}
    for pictures in scene.cameras().values():
        found = steps(pictures)
        usual_m = usual_length_m(found, scene.own)
        usual_deg = float(np.median([step.turn_deg for step in found])) if found else 0.0
        for step in found:
            between = (step.before.moment, step.after.moment)
            if usual_m > 0 and step.length_m > GAP_FACTOR * usual_m:
                gaps.setdefault(between, []).append((step, usual_m))
            elif step.turn_deg > max(LARGEST_TURN_DEG, GAP_FACTOR * usual_deg):
                jumps.setdefault(between, []).append((step, usual_deg))
    unit = "m" if scene.own else "scene units"
    for (before, after), seen in gaps.items():
        step, usual_m = max(seen, key=lambda item: item[0].length_m)
        yield Finding(
            "gap",
            f"Frames {before} and {after} lie {step.length_m:.3g} {unit} apart, {step.length_m / usual_m:.0f} times "
            f"the usual {usual_m:.2g} {unit}; look for poses that are missing or wrong there, or make two scenes of "
            "the drive with --first and --frames.",
            tuple(step.before.camera for step, _ in seen),
            (before, after),
        )
    for (before, after), seen in jumps.items():
        step, usual_deg = max(seen, key=lambda item: item[0].turn_deg)
        yield Finding(
            "turn",
            f"From frame {before} to {after} the camera turns by {step.turn_deg:.0f} degrees where {usual_deg:.1f} are "
            "usual; check both poses, and leave the frame out whose pose is wrong.",
            tuple(step.before.camera for step, _ in seen),
            (before, after),
        )


def _poses(scene: SceneFolder, agreements: Sequence[Agreement]) -> Iterator[Finding]:
    source = scene.meta.get("source")
    refined = isinstance(source, dict) and source.get("refine_poses") is True
    remedy = (
        "find them anew with --poses lidar or --poses colmap, and check the lens and the times of the pictures"
        if refined
        else "process the drive with --refine-poses (needs pycolmap), or find them anew with --poses lidar or "
        "--poses colmap"
    )
    for name in scene.cameras():
        figures, bad = pose_figures(agreements, name), bad_steps(agreements, name)
        if figures is not None and figures["median_px"] > BAD_MEDIAN_PX:
            yield Finding(
                "poses",
                f"Features of {name} lie {figures['median_px']:.2f} px from where the poses have their epipolar lines "
                f"(median, at the scene's size; 0.1 to 0.2 are usual); {remedy}.",
                (name,),
            )
        elif figures is not None and bad:
            worst = max(bad, key=lambda one: one.median_px)
            yield Finding(
                "poses",
                f"From frame {worst.first} to {worst.second} of {name}"
                + (f" and at {len(bad) - 1} more steps" if len(bad) > 1 else "")
                + f" features lie {worst.median_px:.1f} px from where the poses have their epipolar lines, where "
                f"{figures['median_px']:.2f} px are usual; {remedy}.",
                (name,),
                tuple(sorted({moment for one in bad for moment in (one.first, one.second)})),
            )


def _timestamps(scene: SceneFolder) -> Iterator[Finding]:
    for name, pictures in scene.cameras().items():
        wrong = [step.after.moment for step in steps(pictures) if step.seconds is not None and step.seconds <= 0]
        if wrong:
            yield Finding(
                "timestamps",
                f"The timestamps of {name} do not increase at {_frames(wrong)}; mend the recording's timestamps, by "
                "which sweeps are de-skewed and poses are found.",
                (name,),
                tuple(wrong),
            )


def _fits(scene: SceneFolder) -> Iterator[Finding]:
    for name in scene.cameras():
        rms_px = recorded(scene, "camera_fits", name).get("rms_px")
        if isinstance(rms_px, (int, float)) and rms_px > LARGEST_FIT_RMS_PX:
            yield Finding(
                "fit",
                f"The fisheye camera that stands for {name} is off by {rms_px:.2f} px rms; check its calibration, or "
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
                f"The vehicle itself was not found in the pictures of {name}, too few or all alike, so what is seen of "
                f"it is trained on; paint it black in {ego_mask_path(scene.path.parent, name)} and process the drive "
                "again.",
                (name,),
            )


def _masks(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    for name, figures in _by_camera(measured).items():
        hidden = {one.picture.moment: one.hidden_share for one in figures if one.hidden_share > LARGEST_HIDDEN_SHARE}
        if not hidden:
            continue
        which = f"The mask of {name}" if len(hidden) == len(figures) else f"The mask of {_frames(hidden)} of {name}"
        yield Finding(
            "mask",
            f"{which} hides {max(hidden.values()):.0%} of the lens; see whether it is meant so (255 = use the pixel, "
            "0 = ignore it).",
            (name,),
            () if len(hidden) == len(figures) else tuple(hidden),
        )


def _outliers(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    """Pictures with far less LiDAR, or far darker or brighter, than the others of their camera."""
    for name, figures in _by_camera(measured).items():
        coverage = {one.picture.moment: one.lidar_coverage for one in figures if one.lidar_coverage is not None}
        usual = float(np.median(list(coverage.values()))) if coverage else 0.0
        if coverage and usual == 0:
            yield Finding(
                "lidar",
                f"Most LiDAR maps of {name} hold no return; check the calibration from the scanner to this camera.",
                (name,),
            )
        little = [moment for moment, share in coverage.items() if share < LITTLE_LIDAR * usual]
        if little:
            yield Finding(
                "lidar",
                f"LiDAR covers {min(coverage[moment] for moment in little):.2%} of {_frames(little)} of {name} where "
                f"{usual:.2%} is usual; see whether the sweep is whole and the pose right.",
                (name,),
                tuple(little),
            )
        brightness = {one.picture.moment: one.brightness for one in figures}
        usual = float(np.median(list(brightness.values())))
        strange = {
            "dark": [moment for moment, grey in brightness.items() if grey * BRIGHTNESS_FACTOR < usual],
            "bright": [moment for moment, grey in brightness.items() if grey > BRIGHTNESS_FACTOR * usual],
        }
        for word, moments in strange.items():
            if moments:
                yield Finding(
                    word,
                    f"The picture of {_frames(moments)} of {name} is {word}, mean grey {brightness[moments[0]]:.0f} "
                    f"where {usual:.0f} is usual; look at it, and leave it out if it is badly exposed.",
                    (name,),
                    tuple(moments),
                )


def _mono_scale(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    def off(ratio: float) -> bool:
        return max(ratio, 1 / ratio) > LARGEST_SCALE_FACTOR

    for name, figures in _by_camera(measured).items():
        ratios = {
            one.picture.moment: float(np.median(one.mono_over_lidar)) for one in figures if len(one.mono_over_lidar)
        }
        wrong = {moment: ratio for moment, ratio in ratios.items() if off(ratio)}
        if not wrong:
            continue
        every = len(wrong) * 2 > len(ratios)
        ratio = float(np.median(list(wrong.values())))
        which = name if every else f"{_frames(wrong)} of {name}"
        yield Finding(
            "mono_scale",
            f"Monocular distance is {ratio:.2f} times LiDAR's in {which} (median); align the maps to LiDAR before "
            "training, or see whether they hold metres along the ray in steps of 1/256 m.",
            (name,),
            () if every else tuple(wrong),
        )


def _mono_shape(measured: Sequence[PictureFigures]) -> Iterator[Finding]:
    """What a wrong transform looks like: LiDAR may cover as much of the pictures, but not with what they show."""
    for name, figures in _by_camera(measured).items():
        ratios = [one.mono_over_lidar for one in figures if len(one.mono_over_lidar)]
        if not ratios:
            continue
        # whatever scale each map has
        off = float(np.median(np.concatenate([np.abs(ratio / np.median(ratio) - 1) for ratio in ratios])))
        if off > LARGEST_SHAPE_ERROR:
            yield Finding(
                "mono_shape",
                f"Monocular distance and LiDAR's differ by {off:.0%} in {name} (median, with each map's scale set "
                "right). See in the sheets whether LiDAR lies on the things it hit: if not, a transform or a clock is "
                "wrong.",
                (name,),
            )


def limited(findings: Sequence[Finding], of_a_kind: int = _NAMED) -> list[str]:
    """Give the sentences to print; of many of one kind only the first."""
    counts: dict[str, int] = {}
    lines = []
    for finding in findings:
        counts[finding.kind] = counts.get(finding.kind, 0) + 1
        if counts[finding.kind] <= of_a_kind:
            lines.append(finding.text)
    dropped = {kind: count - of_a_kind for kind, count in counts.items() if count > of_a_kind}
    lines += [f"{count} more of the kind '{kind}' are in summary.json." for kind, count in dropped.items()]
    return lines
