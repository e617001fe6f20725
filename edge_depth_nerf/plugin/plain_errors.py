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
        self.before = before

    def __call__(self, kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if debugging():
            self.before(kind, error, trace)
        elif issubclass(kind, KeyboardInterrupt):
            sys.stderr.write("\nStopped.\n")
        elif (said := _own_words(error, trace)) is not None:
            # apart from the warnings and figures before it
            sys.stderr.write(f"\n{PROGRAM}: {said}\n")
        else:
            self.before(kind, error, trace)


def say_errors_plainly() -> None:
    """Make nerfstudio's commands print our errors as our commands do; earlier hooks handle all other exceptions."""
    if not isinstance(sys.excepthook, _Hook):
        sys.excepthook = _Hook(sys.excepthook)


def _own_words(error: BaseException, trace: TracebackType | None) -> str | None:
    """Give one paragraph for the user: an `InputError`, or a missing file in our own words; else None."""
    if isinstance(error, InputError):
        return str(error)
    frames = traceback.extract_tb(trace)
    if isinstance(error, OSError) and error.errno is None and frames and of_package(frames[-1].filename):
        return str(error)
    return None
