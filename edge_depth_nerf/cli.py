"""The command `edge-depth-nerf`. Only light modules are imported before a command is chosen."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from edge_depth_nerf.demo_options import DemoOptions
from edge_depth_nerf.errors import InputError
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.synthetic.options import SynthesizeOptions


@dataclass
class Process:
    """Turn a raw drive into a scene folder that nerfstudio trains on."""

    dataset: tyro.conf.Positional[Literal["kitti360"]]
    """Layout of the raw drive."""
    options: Annotated[Kitti360Options, tyro.conf.arg(name="")]


Command = (
    Annotated[SynthesizeOptions, tyro.conf.subcommand("synthesize")]
    | Annotated[Process, tyro.conf.subcommand("process")]
    | Annotated[DemoOptions, tyro.conf.subcommand("demo")]
)


def run(command: Command) -> None:
    """Carry out a command.

    Raises:
        InputError, OSError: what the user can mend.

    """
    if isinstance(command, SynthesizeOptions):
        from edge_depth_nerf.synthetic.drive import synthesize_drive

        synthesize_drive(command)
    elif isinstance(command, Process):
        from edge_depth_nerf.process.kitti360 import process_kitti360

        process_kitti360(command.options)
    else:
        from edge_depth_nerf.demo import run_demo

        run_demo(command)


def main() -> None:
    """Entry point: errors of input are one paragraph on stderr and exit status 2."""
    command = tyro.cli(Command, prog="edge-depth-nerf", description="Fisheye driving scenes with integrated depth.")
    try:
        run(command)
    except (InputError, OSError) as error:
        sys.stderr.write(f"edge-depth-nerf: {error}\n")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.stderr.write("\nStopped. The same command takes up where it was.\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
