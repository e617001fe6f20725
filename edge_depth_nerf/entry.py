"""How commands end early: one line or one paragraph on stderr, an exit status, and a traceback only if asked for.

It imports next to nothing, so that Ctrl-C works immediately.
"""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from types import FrameType
from typing import NoReturn

from edge_depth_nerf import __version__
from edge_depth_nerf.base.errors import DEBUG_VARIABLE, PROGRAM, STOPPED_STATUS, InputError, debugging, of_package

DEBUG_OPTION = "--debug"
BUG_STATUS, INPUT_STATUS, PIPE_STATUS = 1, 2, 141

_SWALLOWERS = ("trimesh",)
"""Packages that catch every exception, KeyboardInterrupt with them, while they are imported and while they work."""

_SWALLOWERS_WAIT_S = 0.05


def main() -> None:
    """Entry point of `edge-depth-nerf`.

    Exit status: 0; 1 for a bug; 2 for what the user can fix (wrong options included); 130 after Ctrl-C; 141 when the
    reader of the output has gone.
    """
    try:
        # before OpenMP is loaded, and for the commands that this one starts; why: openmp.py
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        _interrupt_between_swallowers()
        words = sys.argv[1:]
        arguments = [word for word in words if word != DEBUG_OPTION]
        if len(arguments) < len(words):
            os.environ[DEBUG_VARIABLE] = "1"  # for the commands that this one starts, too
        if arguments == ["--version"]:
            sys.stdout.write(f"{PROGRAM} {__version__}\n")
            return
        from edge_depth_nerf.cli import parse, run

        run(parse(arguments))
    except KeyboardInterrupt:
        _stopped()
    except BrokenPipeError:
        # who read our output has enough of it (`… | head`); nor can the rest that is buffered be written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(PIPE_STATUS)
    except Exception as error:
        if _interrupted(error):
            _stopped()
        if debugging():
            traceback.print_exc()
        is_input = isinstance(error, (InputError, OSError))
        sys.stderr.write(f"{PROGRAM}: {_explained(error) if is_input else _bug(error)}\n")
        sys.exit(INPUT_STATUS if is_input else BUG_STATUS)


def _interrupt_between_swallowers() -> None:
    """Let Ctrl-C wait until none of `_SWALLOWERS` is at work, in which it would be lost."""
    import signal
    import threading
    from _thread import interrupt_main

    def interrupt(_: int, frame: FrameType | None) -> None:
        while frame is not None:
            if frame.f_globals.get("__name__", "").partition(".")[0] in _SWALLOWERS:
                again = threading.Timer(_SWALLOWERS_WAIT_S, interrupt_main)
                again.daemon = True
                again.start()
                return
            frame = frame.f_back
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def _interrupted(error: BaseException | None) -> bool:
    """Whether it only tells of Ctrl-C; compiled modules raise ImportError from it while they are imported."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _stopped() -> NoReturn:
    import signal

    # threads may still be writing their last file: whoever does not want to wait for them gets no traceback either
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stderr.write("\nStopped. Run the same command again to resume.\n")
    sys.exit(STOPPED_STATUS)


def _bug(error: Exception) -> str:
    """One paragraph about what should not have happened."""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in frames if of_package(frame.filename) and frame.filename != __file__]
    place = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    said = " ".join(str(error).split())
    return (
        f"a bug in version {__version__}{place}: {type(error).__name__}{': ' if said else ''}{said}. Please report "
        f"it: run the same command with {DEBUG_OPTION}, and put its output and that of `{PROGRAM} doctor` "
        "into an issue."
    )


def _explained(error: Exception) -> str:
    """What to tell of it, with what to do about a full disk."""
    from edge_depth_nerf.base.files import explain  # OpenCV: not before it is needed

    return explain(error)
