"""`edge-depth-nerf process`: from a raw drive to a scene that is ready to be trained on.

First the converter writes the scene; then distances from motion are found; then, if it has no monocular maps, a
network is trained on its LiDAR and predicts them; then it is measured how far the maps can be trusted. Each step that
is done is not done again.
"""

from __future__ import annotations

from rich.console import Console

from edge_depth_nerf.base.console import say
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.process.converters import convert
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.scene.format import OWN_MOTION
from edge_depth_nerf.scene.reader import SceneFolder, read_scene
from edge_depth_nerf.scene.writer import ProcessReport


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
        from edge_depth_nerf.mono.calibration import calibrate_scene, saved_trust

        if saved_trust(scene, PriorOptions()) is None:
            trust = calibrate_scene(scene.path, console=console)
            say(console, trust.summary())
