"""How commands end early: one line or one paragraph on stderr, an exit status, and a traceback only if asked for.

Imports next to nothing, so that Ctrl-C is answered from the first moment on.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from edge_depth_nerf import __version__
from edge_depth_nerf.errors import InputError

PROGRAM = "edge-depth-nerf"
DEBUG_OPTION = "--debug"
DEBUG_VARIABLE = "EDGE_DEPTH_NERF_DEBUG"
"""Set to anything, it stands for --debug; nerfstudio's commands know no such option."""
BUG_STATUS, INPUT_STATUS, STOPPED_STATUS, PIPE_STATUS = 1, 2, 130, 141


def main() -> None:
    """Entry point of `edge-depth-nerf`.

    Exit status: 0; 1 for a bug; 2 for what the user can mend (also of options); 130 after Ctrl-C; 141 when
    whoever reads the output has gone.
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
    except BrokenPipeError:
        # who read our output has enough of it (`… | head`); nor can the rest that is buffered be written
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(PIPE_STATUS)
    except Exception as error:
        if _debugging():
            traceback.print_exc()
        is_input = isinstance(error, (InputError, OSError))
        sys.stderr.write(f"{PROGRAM}: {_explained(error) if is_input else _bug(error)}\n")
        sys.exit(INPUT_STATUS if is_input else BUG_STATUS)


class _Hook:
    """nerfstudio's commands' last word about an exception."""

    def __init__(self, before: Callable[..., Any]) -> None:
        """Leave to `before` what is not for us to say."""
        self.before, self.ours = before, False

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        said = None if _debugging() else _config_slip(error, trace)
        if self.ours and not _debugging():
            if issubclass(kind, KeyboardInterrupt):
                sys.stderr.write("\nStopped.\n")
                return
            said = said or _own_words(error, trace)
        if said is None:
            self.before(kind, error, trace)
        else:
            sys.stderr.write(f"{PROGRAM}: {said}\n(The traceback: set {DEBUG_VARIABLE}=1.)\n")


def say_config_slips_plainly() -> None:
    """Make nerfstudio's commands answer a wrong --load-config in one paragraph, whatever the method."""
    if not isinstance(sys.excepthook, _Hook):
        sys.excepthook = _Hook(sys.excepthook)


def say_errors_plainly() -> None:
    """Make nerfstudio's commands say our errors as ours are said; all other exceptions stay with who had them."""
    say_config_slips_plainly()
    assert isinstance(sys.excepthook, _Hook)
    sys.excepthook.ours = True


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


def _own_words(error: BaseException, trace: TracebackType | None) -> str | None:
    """One paragraph for the user: an `InputError`, or a missing file in our own words; else None."""
    if isinstance(error, InputError):
        return str(error)
    frames = traceback.extract_tb(trace)
    if isinstance(error, OSError) and error.errno is None and frames and _of_package(frames[-1].filename):
        return str(error)
    return None


def _config_slip(error: BaseException, trace: TracebackType | None) -> str | None:
    """What is wrong with the file after --load-config, where nerfstudio could not read it; else None."""
    for frame, _ in traceback.walk_tb(trace):
        found = frame.f_locals
        if frame.f_code.co_name != "eval_setup" or "config_path" not in found:
            continue
        if hasattr(found.get("config"), "get_checkpoint_dir"):
            return None  # it was read; the fault is another
        kinds = {
            FileNotFoundError: "no such file",
            IsADirectoryError: "is a folder",
            AssertionError: "holds something else than a training's configuration",
        }
        first_line = (str(error).splitlines() or [""])[0]
        what = kinds.get(type(error), f"cannot be read ({type(error).__name__}: {first_line})")
        return (
            f"{found['config_path']}: {what}. --load-config takes a training's config.yml, such as "
            "outputs/NAME/METHOD/TIME/config.yml; paths count from the folder you are in."
        )
    return None


def _of_package(filename: str) -> bool:
    return Path(__file__).parent in Path(filename).parents
