"""The one error for input that a user can mend.

Its message names the file (and line, frame or field), what was found, what was expected and what to do.
The command line prints it as one paragraph; a missing file may also be a plain `FileNotFoundError`.
"""

from __future__ import annotations

LONGEST_MESSAGE = 4000
"""In characters; what is longer quotes a file that holds anything, and is cut in the middle."""


class InputError(ValueError):
    """Data or options from outside that cannot be used as they are.

    Messages quote files that may hold anything: what a terminal would take as an order is written as its code.
    """

    def __init__(self, message: str) -> None:
        if len(message) > LONGEST_MESSAGE:
            half = LONGEST_MESSAGE // 2
            message = f"{message[:half]} … {message[-half:]}"
        super().__init__("".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in message))
