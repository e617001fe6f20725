"""The command `edge-depth-nerf`. Only light modules are imported before a command is chosen."""

from __future__ import annotations

import difflib
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args

import tyro
from rich.console import Console

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.compare.options import CompareOptions, GridOptions, SearchOptions
from edge_depth_nerf.demo.options import DemoOptions
from edge_depth_nerf.films.options import CameraPathOptions
from edge_depth_nerf.inspecting.options import InspectOptions
from edge_depth_nerf.mono.options import EstimateDepthOptions
from edge_depth_nerf.plugin.compat import join_lines_of_option_help
from edge_depth_nerf.process.converters import CONVERTERS
from edge_depth_nerf.process.options import ProcessOptions
from edge_depth_nerf.synthetic.options import SynthesizeOptions

if TYPE_CHECKING:
    Converter = ProcessOptions
else:
    _members = tuple(Annotated[each.options, tyro.conf.subcommand(name)] for name, each in CONVERTERS.items())
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
    | Annotated[Process, tyro.conf.subcommand("process")]
    | Annotated[EstimateDepthOptions, tyro.conf.subcommand("estimate-depth")]
    | Annotated[InspectOptions, tyro.conf.subcommand("inspect")]
    | Annotated[CameraPathOptions, tyro.conf.subcommand("camera-path")]
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


@contextmanager
def _starting() -> Iterator[None]:
    """Say that something happens while libraries are imported, which takes seconds."""
    with Console(stderr=True).status("Starting …"):
        yield


def run(command: Command) -> None:
    """Carry out a command.

    Raises:
        InputError, OSError: what the user can fix.

    """
    if isinstance(command, SynthesizeOptions):
        with _starting():
            from edge_depth_nerf.synthetic.drive import synthesize_drive

        synthesize_drive(command)
        _say_next("Make a scene of it", f"edge-depth-nerf process {_converter(command)} --output SCENE")
    elif isinstance(command, Process):
        with _starting():
            from edge_depth_nerf.process.many import process_drive

        scenes = process_drive(command.options)
        scene = shlex.quote(str(scenes[0]))
        _say_next("Look at it", f"edge-depth-nerf inspect {scene}")
        _say_next("Train (-lite: without a GPU)", f"ns-train edge-depth-nerf-lite --data {scene}")
    elif isinstance(command, EstimateDepthOptions):
        with _starting():
            from edge_depth_nerf.mono.estimate import estimate_depth
            from edge_depth_nerf.mono.many import estimate_on_cluster

        estimate_depth(command) if command.cluster is None else estimate_on_cluster(command)
    elif isinstance(command, InspectOptions):
        with _starting():
            from edge_depth_nerf.inspecting.command import inspect_scene

        inspect_scene(command)
    elif isinstance(command, CameraPathOptions):
        with _starting():
            from edge_depth_nerf.films.command import write_camera_path

        write_camera_path(command)
    elif isinstance(command, CompareOptions):
        with _starting():
            from edge_depth_nerf.compare.command import compare

        compare(command)
    elif isinstance(command, GridOptions):
        with _starting():
            from edge_depth_nerf.compare.grid import grid

        grid(command)
    elif isinstance(command, SearchOptions):
        with _starting():
            from edge_depth_nerf.compare.search import search

        search(command)
    elif isinstance(command, Doctor):
        from edge_depth_nerf.doctor import run_doctor

        sys.exit(run_doctor())
    else:
        with _starting():
            from edge_depth_nerf.demo.command import run_demo

        run_demo(command)


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
