"""`edge-depth-nerf export`: a scene's prior for nerfstudio, for programs that read COLMAP, and as a cloud."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from edge_depth_nerf import __version__
from edge_depth_nerf.base.console import run_jobs, say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import open_folder, remove_leftovers, write_bytes, write_json
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.export.cloud import Cloud, cloud_rows, figures_of, merge_parts, part_of, write_part
from edge_depth_nerf.export.colmap_form import MODEL, write_model
from edge_depth_nerf.export.nerfstudio_form import POINTS, write_transforms
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.export.pictures import LARGEST_COUNT, MILLIMETRES, ExportedView, ViewWriter, views_of
from edge_depth_nerf.export.priors import Priors
from edge_depth_nerf.lidar.ply import ply_bytes
from edge_depth_nerf.scene.format import CALIBRATION_FILE, EXPORT_FIGURES, TRANSFORMS
from edge_depth_nerf.scene.reader import SceneFolder, read_scene

RECORD = "export.json"
"""What the export is made of; written first."""
LAST = {"nerfstudio": TRANSFORMS, "colmap": f"{MODEL}/images.bin", "points": POINTS}
"""The file that is written last: with it an export is complete."""
LEAST_SHARE = 1e-3
"""Less of the prior may be too far away without a message."""
WORK = ".partial"
"""Folder of what is only needed until the export is complete."""


def export_scene(options: ExportOptions, console: Console | None = None) -> Path:
    """Export a scene. A run that was interrupted continues.

    Returns:
        The folder that was written.

    Raises:
        FileNotFoundError: there is no scene.
        InputError: an option or a file cannot be used, the scene has no prior, or the folder holds something else.
    """
    options.check()
    console = console or Console()
    scene, output = read_scene(options.scene), options.folder()
    priors = Priors(scene, output / WORK / "priors")
    if not any(not picture.held_out for picture in scene.pictures):
        raise InputError(f"{scene.path}: has no training picture, and the cloud is made of these. Check its split.")
    with only_writer(output, console):
        open_folder(output, output / RECORD, _record(options, scene), "exports")
        if (output / LAST[options.form]).is_file():
            say(console, f"{output}: is complete already.")
        else:
            remove_leftovers(output)
            _write(output, options, scene, priors, console)
            shutil.rmtree(output / WORK, ignore_errors=True)
    return output


def _record(options: ExportOptions, scene: SceneFolder) -> dict[str, Any]:
    """Describe what an export is made of: the options, and the scene's files by size and time of change."""
    paths = {scene.path, scene.folder / CALIBRATION_FILE}
    paths |= {path for picture in scene.pictures for path in picture.files.values()}
    stamps = [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in sorted(paths) if path.is_file()]
    given = {key: value for key, value in dataclasses.asdict(options).items() if key not in ("scene", "output")}
    return {
        "made_by": f"edge-depth-nerf {__version__}",
        "scene": str(scene.path.absolute()),
        "files_of_the_scene": hashlib.sha256(json.dumps(stamps).encode()).hexdigest(),
        **given,
        "world_offset_m": list(scene.meta.get("world_offset_m", [0.0, 0.0, 0.0])),
    }


def _write(output: Path, options: ExportOptions, scene: SceneFolder, priors: Priors, console: Console) -> None:
    training = [picture for picture in scene.pictures if not picture.held_out]
    only_cloud = options.form == "points" or options.pictures == "training"
    needed = training if only_cloud else scene.pictures
    run_jobs([partial(priors.make, each) for each in needed if not priors.is_made(each)], "Making the prior", console)
    cloud = _cloud(output / WORK / "cloud", options, priors, training, console)
    figures = figures_of(cloud, scene.points_m())
    write_json(output / EXPORT_FIGURES, figures)
    if options.form == "points":
        write_bytes(output / POINTS, ply_bytes(cloud_rows(cloud, scene.world_offset_m, "<f8")))
        _show(console, output, figures, [])
        return
    views, writer = views_of(scene, priors.stems, options), ViewWriter(output, priors, options)
    of_pictures = [list(group) for _, group in groupby(views, lambda view: view.picture.name)]
    missing = [group for group in of_pictures if not all(map(writer.is_written, group))]
    counts = run_jobs([partial(writer.write, group) for group in missing], "Writing pictures and maps", console)
    if options.form == "nerfstudio":
        write_bytes(output / POINTS, ply_bytes(cloud_rows(cloud, np.zeros(3))))
        write_transforms(output, scene, views, writer)
    else:
        seen = run_jobs([partial(writer.seen, view, cloud) for view in views], "Finding what each view sees", console)
        write_model(output, views, seen, cloud)
        if empty := [view.file_name for view, each in zip(views, seen, strict=True) if not len(each.index)]:
            say(
                console,
                f"{len(empty)} of {len(views)} views see no point of the cloud ({empty[0]} …). They are in the model, "
                "but the depth loss of gsplat's trainer cannot read such views.",
                "yellow",
            )
    known, too_far = (sum(each) for each in zip(*counts, strict=True)) if counts else (0, 0)
    if too_far > LEAST_SHARE * known:
        say(
            console,
            f"{too_far / known:.1%} of the prior's pixels are further away than {LARGEST_COUNT / MILLIMETRES:.1f} m, "
            "which PNGs of millimetres cannot hold. --depth-files npy keeps them.",
            "yellow",
        )
    _show(console, output, figures, views)


def _cloud(folder: Path, options: ExportOptions, priors: Priors, training: Sequence[Any], console: Console) -> Cloud:
    """Make the cloud of the training pictures, each of which has a file of its own until all are there."""
    paths = {picture.name: folder / f"{priors.stems[picture.name]}.npz" for picture in training}

    def make(picture: Any) -> None:
        write_part(paths[picture.name], part_of(priors, picture, training, options.voxel_m, options.most_error))

    missing = [picture for picture in training if not paths[picture.name].is_file()]
    run_jobs([partial(make, picture) for picture in missing], "Fusing the cloud", console)
    cloud = merge_parts(list(paths.values()), options.voxel_m, options.most_points)
    if not len(cloud.points_m):
        raise InputError(
            f"{priors.scene.path}: no pixel of a training picture has a prior whose error is known to be at most "
            f"{options.most_error:g} of the distance, so the cloud is empty. Give a larger --most-error, or check the "
            "prior with `edge-depth-nerf inspect`."
        )
    return cloud


def _show(console: Console, output: Path, figures: dict[str, Any], views: Sequence[ExportedView]) -> None:
    pictures = f"{len(views)} pictures with depth and " if views else ""
    say(console, f"{pictures}{figures['text']}: {output}")
