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

_IMPORTS = "<frozen importlib._bootstrap>"
"""The file of Python's own frames while a module is imported. Modules may turn any exception into one of their own."""
_DEAF = "trimesh"
"""A package that catches every exception while it works, KeyboardInterrupt included."""
_WAIT_S = 0.05
"""Ctrl-C asks again after so long whether it may interrupt."""
_STOPPED = "\nStopped. Run the same command again to resume.\n"


def main() -> None:
    """Entry point of `edge-depth-nerf`.

    Exit status: 0; 1 for a bug; 2 for what the user can fix (wrong options included); 130 after Ctrl-C; 141 when the
    reader of the output has gone.
    """
    try:
        # before OpenMP is loaded, and for the commands that this one starts; why: openmp.py
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        _interrupt_between_imports()
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
        if debugging():
            traceback.print_exc()
        is_input = isinstance(error, (InputError, OSError))
        sys.stderr.write(f"{PROGRAM}: {_explained(error) if is_input else _bug(error)}\n")
        sys.exit(INPUT_STATUS if is_input else BUG_STATUS)


def _interrupt_between_imports() -> None:
    """Let Ctrl-C wait until no import is running, in which it could be lost; a second one ends the program at once."""
    import signal
    import time
    from _thread import get_ident, interrupt_main, start_new_thread

    waiting = asks_again = False
    main_thread = get_ident()

    def ask_again() -> None:
        nonlocal asks_again
        time.sleep(_WAIT_S)
        if waiting:
            asks_again = True
            if sys.platform == "win32":
                interrupt_main()
            else:
                signal.pthread_kill(main_thread, signal.SIGINT)  # ends a wait of the system's, too

    def interrupt(_: int, frame: FrameType | None) -> None:
        nonlocal waiting, asks_again
        pressed, asks_again = not asks_again, False
        if not _would_be_lost(frame):
            waiting = False
            raise KeyboardInterrupt
        if waiting and pressed:
            # a line that shows progress has hidden the cursor
            os.write(2, (("\033[?25h" if os.isatty(2) else "") + _STOPPED).encode())
            os._exit(STOPPED_STATUS)
        waiting = True
        start_new_thread(ask_again, ())

    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt)


def _would_be_lost(frame: FrameType | None) -> bool:
    """Whether code is at work, in this frame or around it, that may swallow an exception or make another one of it."""
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTS or frame.f_globals.get("__name__", "").partition(".")[0] == _DEAF:
            return True
        frame = frame.f_back
    return False


def _stopped() -> NoReturn:
    import signal

    # threads may still be writing their last file: whoever does not want to wait for them gets no traceback either
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stderr.write(_STOPPED)
    sys.exit(STOPPED_STATUS)


def _bug(error: Exception) -> str:
    """One paragraph about what should not have happened."""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in frames if of_package(frame.filename) and frame.filename != __file__]
    place = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    said = " ".join(str(error).split())
    return (
        f"a bug in version {__version__}{place}: {type(error).__name__}{': ' if said else ''}{said}. Please report it: "
        f"run the same command with {DEBUG_OPTION}, and put its output and that of `{PROGRAM} doctor` into an issue."
    )


def _explained(error: Exception) -> str:
    """What to tell of it, with what to do about a full disk."""
    from edge_depth_nerf.base.files import explain  # OpenCV: not before it is needed

    return explain(error)
