"""How commands end early: one line or one paragraph on stderr, an exit status, and a traceback only if asked for.

Imports next to nothing, so that Ctrl-C is answered from the first moment on.
"""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from types import TracebackType
from typing import NoReturn

from edge_depth_nerf import __version__
from edge_depth_nerf.errors import InputError

PROGRAM = "edge-depth-nerf"
DEBUG_OPTION = "--debug"
DEBUG_VARIABLE = "EDGE_DEPTH_NERF_DEBUG"
"""Set to anything, it stands for --debug; nerfstudio's commands know no such option."""
BUG_STATUS, INPUT_STATUS, STOPPED_STATUS = 1, 2, 130


def main() -> None:
    """Entry point of `edge-depth-nerf`.

    Exit status: 0; 1 for a bug; 2 for what the user can mend (also of options); 130 after Ctrl-C.
    """
    try:
        # before OpenMP is loaded, and for the commands that this one starts; why: openmp.py
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
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
    except Exception as error:
        if _debugging():
            traceback.print_exc()
        is_input = isinstance(error, (InputError, OSError))
        sys.stderr.write(f"{PROGRAM}: {_explained(error) if is_input else _bug(error)}\n")
        sys.exit(INPUT_STATUS if is_input else BUG_STATUS)


def say_errors_plainly() -> None:
    """Make nerfstudio's commands say our errors as ours are said; all other exceptions stay with who had them."""
    before = sys.excepthook
    if getattr(before, "__module__", None) == __name__:
        return

    def hook(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, KeyboardInterrupt) and not _debugging():
            sys.stderr.write("\nStopped.\n")
        elif _is_ours(error, trace) and not _debugging():
            sys.stderr.write(f"{PROGRAM}: {error}\n(The traceback: set {DEBUG_VARIABLE}=1.)\n")
        else:
            before(kind, error, trace)

    sys.excepthook = hook


def _debugging() -> bool:
    return bool(os.environ.get(DEBUG_VARIABLE))


def _stopped() -> NoReturn:
    import signal

    # threads may still be writing their last file: whoever does not want to wait for them gets no traceback either
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    sys.stderr.write("\nStopped. The same command takes up where it was.\n")
    sys.exit(STOPPED_STATUS)


def _bug(error: Exception) -> str:
    """One paragraph about what should not have happened."""
    frames = traceback.extract_tb(error.__traceback__)
    frames = [frame for frame in frames if _of_package(frame.filename) and frame.filename != __file__]
    place = f", in {Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else ""
    said = " ".join(str(error).split())
    return (
        f"a bug in version {__version__}{place}: {type(error).__name__}{': ' if said else ''}{said}. Please report it: "
        f"give the same command with {DEBUG_OPTION}, and put what it prints and what `{PROGRAM} doctor` says into an "
        "issue."
    )


def _explained(error: Exception) -> str:
    """What to tell of it, with what to do about a full disk."""
    from edge_depth_nerf.files import explain  # OpenCV: not before it is needed

    return explain(error)


def _is_ours(error: BaseException, trace: TracebackType | None) -> bool:
    """Whether an error is one paragraph for the user: an `InputError`, or a missing file in our own words."""
    if isinstance(error, InputError):
        return True
    frames = traceback.extract_tb(trace)
    own_words = isinstance(error, OSError) and error.errno is None
    return own_words and bool(frames) and _of_package(frames[-1].filename)


def _of_package(filename: str) -> bool:
    return Path(__file__).parent in Path(filename).parents
