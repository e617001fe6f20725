"""The one error for input that a user can fix.

Its message names the file (and line, frame or field), what was found, what was expected and what to do.
The command line prints it as one paragraph; a missing file may also be a plain `FileNotFoundError`. Here stands, too,
what our command and nerfstudio's share in ending early.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PROGRAM = "edge-depth-nerf"
DEBUG_VARIABLE = "EDGE_DEPTH_NERF_DEBUG"
"""Set to anything, it stands for --debug; nerfstudio's commands know no such option."""
STOPPED_STATUS = 130
"""Exit status after Ctrl-C."""

LONGEST_MESSAGE = 4000
"""In characters; what is longer quotes a file that holds anything, and is cut in the middle."""


class InputError(ValueError):
    """Data or options from outside that cannot be used.

    Messages quote files that may hold anything: what a terminal would take as an order is written as its code.
    """

    def __init__(self, message: str) -> None:
        if len(message) > LONGEST_MESSAGE:
            half = LONGEST_MESSAGE // 2
            message = f"{message[:half]} … {message[-half:]}"
        super().__init__("".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in message))


def require(fine: bool, found: str, expected: str) -> None:
    """Raise an InputError unless all is fine."""
    if not fine:
        raise InputError(f"{found}: expected {expected}.")


@contextmanager
def found_in(where: str) -> Iterator[None]:
    """Put in front of an InputError's message where the faulty input stands."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def debugging() -> bool:
    """Tell whether tracebacks are asked for."""
    return bool(os.environ.get(DEBUG_VARIABLE))


def of_package(filename: str) -> bool:
    """Tell whether a source file is one of ours."""
    return Path(__file__).parents[1] in Path(filename).parents
