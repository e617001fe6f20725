"""What benchmarks share: the project's command, and λ and σ of the methods that take part in no search."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TUNED = Path(__file__).with_name("tuned.json")
"""λ and σ that an old search on a rendered drive found, by method (docs/earlier_results.md of commit fc8242a)."""


def ours(*words: object) -> None:
    """Run `edge-depth-nerf` of this environment with its output shown; a failure ends the program."""
    call = [str(Path(sys.executable).with_name("edge-depth-nerf")), *map(str, words)]
    if subprocess.run(call, check=False).returncode:
        sys.exit(f"{' '.join(call)} failed.")
