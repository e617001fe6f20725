"""`edge-depth-nerf inspect`: writes pictures and summary.json, prints figures and warnings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import run_jobs, say
from edge_depth_nerf.base.files import check_is_folder, read_json, write_json, write_png
from edge_depth_nerf.base.pictures import drawn
from edge_depth_nerf.inspecting.figures import (
    PictureFigures,
    camera_figures,
    map_figures,
    measure,
    measured_frames,
    path_figures,
)
from edge_depth_nerf.inspecting.findings import find, limited
from edge_depth_nerf.inspecting.options import InspectOptions
from edge_depth_nerf.inspecting.pose_check import check_poses, known_steps, pose_figures
from edge_depth_nerf.inspecting.sheets import draw_sheet
from edge_depth_nerf.inspecting.shown_prior import ShownScene
from edge_depth_nerf.inspecting.top_view import pose_check_figure, top_view
from edge_depth_nerf.poses.path_agreement import read_agreement
from edge_depth_nerf.scene.reader import ScenePicture, read_scene

SUMMARY = "summary.json"
TOP_VIEW = "top_view.png"
POSES = "poses.png"
CAMERAS_IN_A_TABLE = 4
"""More would not fit a terminal."""
CAPTION = "mean (smallest to largest); coverage: of the pixels used; distances: median (5 to 95 %)"


def inspect_scene(options: InspectOptions, console: Console | None = None) -> dict[str, Any]:
    """Inspect a scene: draw sheets of some frames and a view from above, print figures and warnings.

    Returns:
        The content of summary.json.

    Raises:
        FileNotFoundError: there is no scene.
        InputError: the scene, one of its files, an option or the output folder cannot be used.
    """
    options.check()
    console = console or Console()
    scene = read_scene(options.scene)
    points_m = scene.points_m()
    folder = scene.folder.resolve()
    output = options.output or folder.with_name(f"{folder.name}_inspection")
    agreement = read_agreement(folder)
    _open_output(output)

    measured, shown = measured_frames(scene, options.frames)
    chosen = [picture for picture in scene.pictures if picture.frame in set(measured)]
    sheets = _sheet_names(picture for picture in chosen if picture.frame in shown)
    # one that is interrupted leaves them to the next inspection
    write_json(output / SUMMARY, {"sheets": list(sheets.values())})
    shown_scene = ShownScene(scene)
    sheet_of = {name: output / sheet for name, sheet in sheets.items()}
    jobs = [partial(_look_at, shown_scene, picture, sheet_of.get(picture.name), options) for picture in chosen]
    figures = run_jobs(jobs, "Inspecting the pictures", console)

    agreements = check_poses(scene, console)
    findings = find(scene, figures, agreements)
    write_png(output / TOP_VIEW, drawn(top_view(scene, points_m, findings, shown)))
    if known_steps(agreements):
        write_png(output / POSES, drawn(pose_check_figure(scene, agreements)))
    held_out = sum(picture.held_out for picture in scene.pictures)
    summary = {
        "made_by": f"edge-depth-nerf {__version__}",
        "scene": str(folder),
        "camera_model": scene.camera_model,
        "lengths_are_metres": scene.own,
        "moments": len(scene.frames()),
        "pictures": len(scene.pictures),
        "training": len(scene.pictures) - held_out if scene.split_known else None,
        "held_out": held_out if scene.split_known else None,
        "points": None if points_m is None else len(points_m),
        "path": path_figures(scene),
        "paths_agree": None if agreement is None else {**asdict(agreement), "text": agreement.text()},
        "calibration": shown_scene.calibration.sentences() if shown_scene.calibration else [],
        "measured": _sample(len(figures), len(scene.pictures)),
        "maps": map_figures(figures),
        "cameras": {
            name: {
                **camera_figures(scene, name, figures),
                "epipolar": pose_figures(agreements, name),
                "lidar_fit": [one for one in scene.checks().get("figures", ()) if one["camera"] == name],
            }
            for name in scene.cameras()
        },
        "warnings": [asdict(finding) for finding in findings],
        "frames": [one.to_dict() for one in figures],
        "epipolar": pose_figures(agreements),
        "steps": [asdict(one) for one in known_steps(agreements)],
        "sheets": list(sheets.values()),
    }
    write_json(output / SUMMARY, summary)
    _show(summary, console)
    for line in limited(findings):
        say(console, f"Warning: {line}", "yellow")
    written = [TOP_VIEW, *([POSES] if known_steps(agreements) else []), SUMMARY]
    say(console, f"{output}: {len(sheets)} sheets, {', '.join(written)}")
    return summary


def _sample(measured: int, pictures: int) -> str:
    if measured == pictures:
        return "measured on all pictures"
    return f"measured on {measured} of the {pictures} pictures, evenly over the drive"


def _open_output(output: Path) -> None:
    """Create the folder. Remove the sheets of an earlier inspection, which may be of another scene."""
    check_is_folder(output)
    output.mkdir(parents=True, exist_ok=True)
    if (output / SUMMARY).is_file():
        earlier = read_json(output / SUMMARY)
        for name in [POSES, *(earlier.get("sheets", ()) if isinstance(earlier, dict) else ())]:
            if re.fullmatch(r"[\w.-]+\.png", str(name)):
                (output / name).unlink(missing_ok=True)


def _sheet_names(pictures: Iterable[ScenePicture]) -> dict[str, str]:
    """Name each picture's sheet by its camera and frame, by the pictures' names."""
    found: dict[str, str] = {}
    for picture in pictures:
        camera = re.sub(r"[^\w-]+", "_", picture.camera)
        name = f"{camera}_{picture.frame:010d}.png"
        while name in found.values():
            name = f"_{name}"
        found[picture.name] = name
    return found


def _look_at(shown: ShownScene, picture: ScenePicture, sheet: Path | None, options: InspectOptions) -> PictureFigures:
    """Measure one picture, and draw its sheet if it has one."""
    maps = shown.maps(picture)
    figures = measure(picture, maps)
    if sheet is not None:
        write_png(sheet, draw_sheet(shown.scene, figures, maps, options.size))
    return figures


# ---- the terminal ----------------------------------------------------------------------------------------------


def _number(value: float | int | None, form: str, unit: str = "") -> str:
    return "–" if value is None else format(value, form) + unit


def _spread(values: dict[str, float] | None, form: str) -> str:
    """Format a mean, with the smallest and largest value in brackets."""
    return _filled(f"{{mean:{form}}} ({{min:{form}}} to {{max:{form}}})", values)


def _filled(form: str, values: dict[str, Any] | None) -> str:
    return "–" if values is None else form.format(**values)


def _show(summary: dict[str, Any], console: Console) -> None:
    path, unit = summary["path"], "m" if summary["lengths_are_metres"] else "units"
    drive = Table("drive", "", title=summary["scene"], show_header=False)
    split = "no split given"
    if summary["held_out"] is not None:
        split = f"{summary['training']} for training, {summary['held_out']} held out"
    drive.add_row("pictures", f"{summary['pictures']} in {summary['moments']} frames: {split}")
    drive.add_row("path", f"{path['length_m']:.1f} {unit} ({path['camera']})")
    drive.add_row("spacing", f"{path['spacing_median_m']:.2f} {unit} (median), {path['spacing_max_m']:.2f} at most")
    if path["duration_s"] is not None:
        speeds = (_number(path[key], ".1f", " m/s") for key in ("speed_mean_mps", "speed_max_mps"))
        drive.add_row("time", "{:.1f} s; {} on average, {} at most".format(path["duration_s"], *speeds))
    if summary["paths_agree"] is not None:
        drive.add_row("LiDAR odometry", summary["paths_agree"]["text"])
    drive.add_row("points.ply", _number(summary["points"], ",", " points"))
    if (found := summary["epipolar"]) is not None:
        drive.add_row(
            "poses",
            f"features are {found['median_px']:.2f} px from their epipolar lines (median; {found['min_px']:.2f} to "
            f"{found['max_px']:.2f} px over {found['steps']} steps)",
        )
    if summary["calibration"]:
        drive.add_row("prior", "\n".join(summary["calibration"]))
    console.print(drive)

    cameras = summary["cameras"]
    names = list(cameras)
    for first in range(0, len(names), CAMERAS_IN_A_TABLE):
        some = {name: cameras[name] for name in names[first : first + CAMERAS_IN_A_TABLE]}
        table = Table("", *some, caption=f"{summary['measured']}; {CAPTION}")
        for label, cells in _rows(list(some.values())):
            if any(cell != "–" for cell in cells):
                table.add_row(label, *cells)
        console.print(table)


def _rows(cameras: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    def lens(camera: dict[str, Any]) -> str:
        original = camera["original_model"]
        return camera["model"] if original in (None, camera["model"]) else f"{camera['model']} for {original}"

    def fit(camera: dict[str, Any]) -> str:
        if camera["fit_rms_px"] is None:
            return "–"
        return f"{camera['fit_rms_px']:.3f} / {_number(camera['fit_max_px'], '.3f')}"

    def mono(camera: dict[str, Any]) -> str:
        if camera["mono_over_lidar_median"] is None:
            return "–"
        return f"{camera['mono_over_lidar_median']:.2f}, {camera['mono_against_lidar_abs_rel']:.2f}"

    def fitted(camera: dict[str, Any], form: str) -> str:
        found = [one for one in camera["lidar_fit"] if all(one[key] is not None for key in re.findall(r"{(\w+)", form))]
        return ", ".join(form.format(**one) for one in found) or "–"

    quantiles = "{median:.1f} m ({p5:.1f} to {p95:.1f})"
    rows = {
        "pictures (held out)": lambda c: f"{c['pictures']} ({c['held_out']})",
        "lens": lens,
        "size, px": lambda c: "{}×{}".format(*c["size_px"]) + ("" if c["one_lens"] else ", varies"),
        "fit rms / max, px": fit,
        "to epipolar lines, px": lambda c: _filled("{median_px:.2f} ({min_px:.2f} to {max_px:.2f})", c["epipolar"]),
        "largest angle off-axis": lambda c: _number(c["angle_limit_deg"], ".0f", "°"),
        "pixels used": lambda c: _spread(c["used_share"], ".0%"),
        "LiDAR coverage": lambda c: _spread(c["lidar_coverage"], ".1%"),
        "mono coverage": lambda c: _spread(c["mono_coverage"], ".0%"),
        "motion coverage": lambda c: _spread(c["motion_coverage"], ".0%"),
        "pixels with a prior": lambda c: _spread(c["prior_share"], ".0%"),
        "without a prior (sky, …)": lambda c: _number(c["no_prior_share"], ".0%"),
        "LiDAR / motion's distance": lambda c: fitted(c, "{ratio:.2f} (±{ratio_spread:.2f})"),
        "the same left, ahead, right": lambda c: (
            " ".join(_number(part, ".2f") for one in c["lidar_fit"] for part in one["ratio_by_side"]) or "–"
        ),
        "contrast agrees at LiDAR": lambda c: fitted(c, "{correlation:.2f}"),
        "edges at LiDAR's / beside": lambda c: fitted(c, "{edge:.2f}"),
        "sweeps apart": lambda c: fitted(c, "{apart_m:.3f} m"),
        "LiDAR distance": lambda c: _filled(quantiles, c["lidar_distance_m"]),
        "prior distance": lambda c: _filled(quantiles, c["prior_distance_m"]),
        "sigma, median": lambda c: _number(c["sigma_median_m"], ".2f", " m"),
        "mono / LiDAR, AbsRel": mono,
        "prior / ground truth, AbsRel": lambda c: _number(c["prior_against_truth_abs_rel"], ".3f"),
    }
    return [(label, [cell(camera) for camera in cameras]) for label, cell in rows.items()]
