"""Running the installed commands, for benchmarks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def command(name: str, *words: object, shown: bool = False) -> None:
    """Run one of the commands of this environment; ends the program if it fails.

    Args:
        name: of the command.
        words: its arguments.
        shown: whether its output is; else only the end of what a failed one wrote.

    """
    pipe = None if shown else subprocess.PIPE
    call = [str(Path(sys.executable).with_name(name)), *map(str, words)]
    done = subprocess.run(call, stdout=pipe, stderr=None if shown else subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        sys.exit(f"{name} {' '.join(map(str, words))} failed.\n{(done.stdout or '')[-3000:]}")
