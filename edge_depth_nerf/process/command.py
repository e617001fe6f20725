"""`edge-depth-nerf process`: from a raw drive to scenes that are ready to be trained on.

A drive becomes one scene, or is cut into several, here or on a cluster. First the converter writes the scene; then
distances from motion are found; then, if it has no monocular maps, a network is trained on its LiDAR and predicts them;
then it is measured how far the maps can be trusted. Each step that is done is not done again.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.jobs.tasks import Task, do_tasks, own_command
from edge_depth_nerf.process.converters import convert, name_of, read_drive
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.scene.format import OWN_MOTION
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.scene.writer import ProcessReport


def process_drive(options: ProcessOptions, console: Console | None = None) -> list[Path]:
    """Write the scenes of a drive, or continue them; give their folders.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: an option, a file of the drive, an output folder or the cluster cannot be used.
    """
    console = console or Console()
    options.check()
    parts = [options] if options.frames_per_scene is None else cut(options, console)
    # a scene is held by who writes it
    held = nullcontext() if options.frames_per_scene is None else only_writer(options.output, console)
    with held:
        if options.cluster is not None:
            _on_cluster(parts, options.cluster, console)
        else:
            for number, part in enumerate(parts, 1):
                if len(parts) > 1:
                    say(console, f"Scene {number} of {len(parts)}: {part.output}")
                process(part, console)
    return [part.output for part in parts]


def cut(options: ProcessOptions, console: Console) -> list[ProcessOptions]:
    """Options of the scenes that a drive is cut into: each is a stretch of consecutive frames.

    Raises:
        FileNotFoundError: a file of the drive is missing.
        InputError: a file of the drive cannot be used, or the output folder is a scene itself.
    """
    if (options.output / "transforms.json").exists():
        raise InputError(
            f"{options.output}: is a scene; --frames-per-scene would write other scenes into it. Choose another "
            "--output."
        )
    with console.status("Reading the drive …"):
        frames = sorted({picture.frame for picture in read_drive(options).pictures})
    assert options.frames_per_scene is not None
    count = -(-len(frames) // options.frames_per_scene)
    digits = max(3, len(str(count - 1)))
    parts: list[ProcessOptions] = []
    for number, stretch in enumerate(np.array_split(frames, count)):
        first, last = int(stretch[0]), int(stretch[-1])
        parts.append(
            replace(
                options,
                output=options.output / f"{number:0{digits}d}",
                first=first,
                frames=(last - first) // options.stride + 1,
                frames_per_scene=None,
                cluster=None,
            )
        )
    say(console, f"{len(frames)} usable frames, split into {count} scenes.")
    return parts


def _on_cluster(parts: list[ProcessOptions], cluster: str, console: Console) -> None:
    from edge_depth_nerf.jobs.cluster import on_cluster  # imports Dask

    tasks = []
    for part in parts:
        scene = part.output.absolute()
        trains = part.estimate_depth and part.mono is None
        words = own_command(("process", name_of(part)), replace(part, cluster=None))
        log = scene.with_name(f"{scene.name}.log")
        tasks.append(Task(str(part.output), words, log, scene / "transforms.json", trains))
    root: Path = vars(parts[0])["root"]  # which the options of each converter have
    with on_cluster(cluster, tasks, [root.absolute()], console) as place:
        do_tasks(tasks, place, console)
    say(console, f"Scenes: {', '.join(task.title for task in tasks)}. Each one's log is beside it.")


def process(options: ProcessOptions, console: Console | None = None) -> ProcessReport:
    """Write the scene of a drive, its monocular maps and their calibration, or continue where a run stopped.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: an option, a file of the drive, or the output folder cannot be used.
    """
    console = console or Console()
    options.check()
    with only_writer(options.output, console):
        report = convert(options, console)
        _add_motion(read_scene(report.scene), options, console)
        _add_mono(read_scene(report.scene), options, console)
        for warning in report.warnings:
            say(console, f"Warning: {warning}", "bold red")
        return report


def _has_motion(scene: SceneFolder) -> bool:
    """Whether a scene has distances from motion, with all that today's `process` puts beside its own."""
    source = scene.meta.get("motion")
    own = isinstance(source, dict) and source.get("kind") == OWN_MOTION
    return scene.has("motion") and (scene.has("motion_around") or not own)


def _add_motion(scene: SceneFolder, options: ProcessOptions, console: Console) -> None:
    """Give the scene distances from motion, if it has none."""
    if not options.motion and scene.has("motion"):
        say(
            console,
            f"{scene.folder}: has distances from motion already, which are kept and used. For a scene without them, "
            "give another --output.",
            "yellow",
        )
    if options.motion and not _has_motion(scene):
        from edge_depth_nerf.process.motion import add_motion

        add_motion(scene, console)


def _add_mono(scene: SceneFolder, options: ProcessOptions, console: Console) -> None:
    """Give the scene monocular maps, if it has none, and the calibration of those it has."""
    lidar = scene.has("lidar")
    if not scene.has("mono") and options.estimate_depth:
        if lidar:
            with console.status("Starting the depth network …"):
                from edge_depth_nerf.mono.estimate import estimate_depth
                from edge_depth_nerf.mono.options import EstimateDepthOptions

            estimate_depth(EstimateDepthOptions((scene.folder,)), console)
            return
        say(
            console,
            "There is no LiDAR to train a network on. Give monocular maps with --mono, or weights of another drive's "
            "network: `edge-depth-nerf estimate-depth SCENE --model …`.",
            "yellow",
        )
    if scene.has("mono") and lidar:
        from edge_depth_nerf.method.prior import PriorOptions
        from edge_depth_nerf.mono.calibration import calibrate_scene, saved_calibration

        if saved_calibration(scene, PriorOptions()) is None:
            calibration = calibrate_scene(scene.path, console=console)
            say(console, calibration.headline())
