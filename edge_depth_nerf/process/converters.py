"""The table of converters: what `edge-depth-nerf process` reads. A new data set is a file of its own and a line here.

Light to import, for the command line: what reads a drive is imported when it is needed. So a converter's options stand
in a module that imports little (`process/options.py`, or the head of the converter's own).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from rich.console import Console

from edge_depth_nerf.process.options import (
    JbnuDepth360Options,
    Kitti360Options,
    KittiOptions,
    ProcessOptions,
    RigOptions,
)

if TYPE_CHECKING:
    from edge_depth_nerf.process.recording import Recording
    from edge_depth_nerf.scene.writer import ProcessReport


CONVERTERS: dict[str, tuple[type[ProcessOptions], str, str]] = {
    "kitti360": (Kitti360Options, "kitti360.converter", "read_kitti360"),
    "kitti": (KittiOptions, "kitti.converter", "read_kitti"),
    "jbnu-depth360": (JbnuDepth360Options, "jbnu_depth360", "read_jbnu_depth360"),
    "rig": (RigOptions, "rig", "read_rig_recording"),
}
"""By the name of the command: the options, with `root`, the drive's folder; and the module in this folder with the
function that takes them and gives a Recording."""


def name_of(options: ProcessOptions) -> str:
    """The command that takes these options."""
    return next(name for name, (kind, *_) in CONVERTERS.items() if type(options) is kind)


def read_drive(options: ProcessOptions) -> Recording:
    """Say what a drive consists of; every file is checked, nothing large is read.

    Raises:
        FileNotFoundError: a folder or file of the drive is missing.
        InputError: an option or a file of the drive cannot be used.
    """
    options.check()
    _, module, reader = CONVERTERS[name_of(options)]
    return getattr(import_module(f"{__package__}.{module}"), reader)(options)


def convert(options: ProcessOptions, console: Console | None = None) -> ProcessReport:
    """Write the scene folder of a drive, or continue one, without monocular maps of its own.

    Raises:
        FileNotFoundError: a folder or file of the drive is missing.
        InputError: an option, a file of the drive, or the output folder cannot be used.
    """
    from edge_depth_nerf.process.build import process_recording

    console = console or Console()
    with console.status("Reading the drive …"):
        recording = read_drive(options)
    return process_recording(recording, options, console)
