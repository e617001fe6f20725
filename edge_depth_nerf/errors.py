"""The one error for input that a user can mend.

Its message names the file (and line, frame or field), what was found, what was expected and what to do.
The command line prints it as one paragraph; a missing file may also be a plain `FileNotFoundError`.
"""


class InputError(ValueError):
    """Data or options from outside that cannot be used as they are."""
