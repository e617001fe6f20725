"""The command `edge-depth-nerf`. Only light modules are imported before a command is chosen."""

from __future__ import annotations

import difflib
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

import tyro
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.compare.options import CompareOptions, GridOptions, SearchOptions
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.export.options import ExportOptions
from edge_depth_nerf.films.options import BirdsEyeOptions, CameraPathOptions, RenderLidarOptions
from edge_depth_nerf.inspecting.options import InspectOptions
from edge_depth_nerf.mono.options import EstimateDepthOptions, FisheyeDepthOptions
from edge_depth_nerf.plugin.compat import join_lines_of_option_help
from edge_depth_nerf.process.bags.options import UnpackOptions
from edge_depth_nerf.process.converters import CONVERTERS
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.synthetic.options import SynthesizeOptions

if TYPE_CHECKING:
    Converter = ProcessOptions
else:
    _members = tuple(Annotated[options, tyro.conf.subcommand(name)] for name, (options, *_) in CONVERTERS.items())
    Converter = Union[_members]  # noqa: UP007


@dataclass
class Process:
    """Turn a raw drive into a scene folder that nerfstudio trains on."""

    options: Annotated[Converter, tyro.conf.arg(name="")]


@dataclass
class Doctor:
    """List what is installed and what is missing, and say how to fix it. Exit status 1 if something must be fixed."""


Command = (
    Annotated[SynthesizeOptions, tyro.conf.subcommand("synthesize")]
    | Annotated[UnpackOptions, tyro.conf.subcommand("unpack")]
    | Annotated[Process, tyro.conf.subcommand("process")]
    | Annotated[EstimateDepthOptions, tyro.conf.subcommand("estimate-depth")]
    | Annotated[FisheyeDepthOptions, tyro.conf.subcommand("fisheye-depth")]
    | Annotated[InspectOptions, tyro.conf.subcommand("inspect")]
    | Annotated[CameraPathOptions, tyro.conf.subcommand("camera-path")]
    | Annotated[RenderLidarOptions, tyro.conf.subcommand("render-lidar")]
    | Annotated[ExportOptions, tyro.conf.subcommand("export")]
    | Annotated[BirdsEyeOptions, tyro.conf.subcommand("birds-eye")]
    | Annotated[CompareOptions, tyro.conf.subcommand("compare")]
    | Annotated[SearchOptions, tyro.conf.subcommand("search")]
    | Annotated[GridOptions, tyro.conf.subcommand("grid")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)


def parse(arguments: list[str]) -> Command:
    """Read a command line; wrong options and --help end the program.

    Raises:
        InputError: there is no such command, or one of its options has another name.
    """
    _check_name(arguments, Command, "command")
    if arguments[:1] == ["process"]:
        _check_name(arguments[1:], Converter, "converter of `process`")
    if arguments[:1] == ["camera-path"] and any(word.split("=")[0] == "--frames" for word in arguments):
        raise InputError(
            "--frames: camera-path has no such option. --seconds sets how long the film runs, and --fps how many "
            "pictures it has a second."
        )
    join_lines_of_option_help()
    names, options = _named(arguments)
    if options is not None:
        # a parser of this command alone: of a wrong option, one of all commands would suggest those of the others
        found = tyro.cli(options, prog=" ".join(("edge-depth-nerf", *names)), args=arguments[len(names) :])
        return Process(found) if len(names) == 2 else found
    return tyro.cli(
        Command,
        prog="edge-depth-nerf",
        description="NeRFs of driving scenes from fisheye cameras, LiDAR and monocular "
        "depth. Add --debug anywhere for tracebacks; --version prints the version.",
        args=arguments,
    )


def _choices(union: object) -> dict[str, Any]:
    """Names of subcommands, with their options."""
    return {name.name: options for options, name in map(get_args, get_args(union))}


def _named(arguments: list[str]) -> tuple[list[str], Any]:
    """The words that name a command, and its options; None where they name none, or not all of it."""
    names = arguments[:1]
    options = _choices(Command).get("".join(names))
    if options is Process:
        names = arguments[:2]
        options = _choices(Converter).get("".join(names[1:]))
    return names, options


def _check_name(words: list[str], choices: object, what: str) -> None:
    """Of a name with a slip, tyro would speak of its options."""
    known = list(_choices(choices))
    if not words or words[0].startswith("-") or words[0] in known:
        return
    close = difflib.get_close_matches(words[0], known, 1, 0.6)
    meant = f" Is {close[0]} meant?" if close else ""
    raise InputError(f"{words[0]}: no such {what}.{meant} There are {', '.join(known)}.")


def run(command: Command) -> None:
    """Carry out a command.

    Raises:
        InputError, OSError: what the user can fix.
    """
    # libraries are imported, which takes seconds
    with Console(stderr=True).status("Starting …"):
        work = _work_of(command)
    if isinstance(command, Doctor):
        sys.exit(work())
    done = work(command.options if isinstance(command, Process) else command)
    if isinstance(command, SynthesizeOptions):
        _say_next("Make a scene of it", f"edge-depth-nerf process {_converter(command)} --output SCENE")
    elif isinstance(command, UnpackOptions):
        if done is not None:
            from edge_depth_nerf.process.bags.command import todo_lines

            if todo := todo_lines(done):
                _say_next("First fill in", f"{done}/rig.toml, lines {', '.join(map(str, todo))}")
            _say_next(
                "Make a scene of it", f"edge-depth-nerf process rig --root {shlex.quote(str(done))} --output SCENE"
            )
    elif isinstance(command, Process):
        scene = shlex.quote(str(done[0]))
        _say_next("Look at it", f"edge-depth-nerf inspect {scene}")
        _say_next("Train (-lite: without a GPU)", f"ns-train edge-depth-nerf-lite --data {scene}")


def _work_of(command: Command) -> Callable[..., Any]:
    """Import what carries out a command."""
    if isinstance(command, SynthesizeOptions):
        from edge_depth_nerf.synthetic.drive import synthesize_drive as work
    elif isinstance(command, UnpackOptions):
        from edge_depth_nerf.process.bags.command import unpack as work
    elif isinstance(command, Process):
        from edge_depth_nerf.process.command import process_drive as work
    elif isinstance(command, EstimateDepthOptions) and command.cluster is None:
        from edge_depth_nerf.mono.estimate import estimate_depth as work
    elif isinstance(command, EstimateDepthOptions):
        from edge_depth_nerf.mono.many import estimate_on_cluster as work
    elif isinstance(command, FisheyeDepthOptions):
        from edge_depth_nerf.mono.fisheye import fisheye_depth as work
    elif isinstance(command, InspectOptions):
        from edge_depth_nerf.inspecting.command import inspect_scene as work
    elif isinstance(command, CameraPathOptions):
        from edge_depth_nerf.films.command import write_camera_path as work
    elif isinstance(command, RenderLidarOptions):
        from edge_depth_nerf.films.scan_command import render_lidar as work
    elif isinstance(command, ExportOptions):
        from edge_depth_nerf.export.command import export_scene as work
    elif isinstance(command, BirdsEyeOptions):
        from edge_depth_nerf.films.birds_eye import render_birds_eye as work
    elif isinstance(command, CompareOptions):
        from edge_depth_nerf.compare.command import compare as work
    elif isinstance(command, GridOptions):
        from edge_depth_nerf.compare.grid import grid as work
    elif isinstance(command, SearchOptions):
        from edge_depth_nerf.compare.search import search as work
    elif isinstance(command, Doctor):
        from edge_depth_nerf.doctor import run_doctor as work
    else:
        from edge_depth_nerf.demo.command import run_demo as work
    return work


def _converter(options: SynthesizeOptions) -> str:
    """What reads a drive that was synthesised, with its options."""
    root = shlex.quote(str(options.output))
    if options.layout == "rig":
        return f"rig --root {root}"
    if options.layout == "jbnu-depth360":
        return f"jbnu-depth360 --root {root} --calibration {root}/calibration.toml"
    return f"kitti360 --root {root} --sequence {options.sequence}"


def _say_next(what: str, command: str) -> None:
    from edge_depth_nerf.base.console import say

    say(Console(), f"{what}: {command}")
