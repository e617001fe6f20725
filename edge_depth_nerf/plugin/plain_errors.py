"""How nerfstudio's commands end on our errors: one paragraph on stderr, a traceback only if it is asked for."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from types import TracebackType
from typing import Any

from edge_depth_nerf.base.errors import PROGRAM, InputError, debugging, of_package


class _Hook:
    """nerfstudio's commands' last word about an exception."""

    def __init__(self, before: Callable[..., Any]) -> None:
        """Leave to `before` what is not for us to say."""
        self.before, self.ours = before, False

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        said = None if debugging() else _config_slip(error, trace)
        if self.ours and not debugging():
            if issubclass(kind, KeyboardInterrupt):
                sys.stderr.write("\nStopped.\n")
                return
            said = said or _own_words(error, trace)
        if said is None:
            self.before(kind, error, trace)
        else:
            # apart from the warnings and figures before it
            sys.stderr.write(f"\n{PROGRAM}: {said}\n")


def say_config_slips_plainly() -> None:
    """Make nerfstudio's commands answer a wrong --load-config in one paragraph, whatever the method."""
    if not isinstance(sys.excepthook, _Hook):
        sys.excepthook = _Hook(sys.excepthook)


def say_errors_plainly() -> None:
    """Make nerfstudio's commands print our errors as our commands do; earlier hooks handle all other exceptions."""
    say_config_slips_plainly()
    assert isinstance(sys.excepthook, _Hook)
    sys.excepthook.ours = True


def _own_words(error: BaseException, trace: TracebackType | None) -> str | None:
    """One paragraph for the user: an `InputError`, or a missing file in our own words; else None."""
    if isinstance(error, InputError):
        return str(error)
    frames = traceback.extract_tb(trace)
    if isinstance(error, OSError) and error.errno is None and frames and of_package(frames[-1].filename):
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
            AssertionError: "is not the configuration of a training",
        }
        first_line = (str(error).splitlines() or [""])[0]
        what = kinds.get(type(error), f"cannot be read ({type(error).__name__}: {first_line})")
        return (
            f"{found['config_path']}: {what}. --load-config takes a training's config.yml, such as "
            "outputs/NAME/METHOD/TIME/config.yml; relative paths start at the current folder."
        )
    return None
