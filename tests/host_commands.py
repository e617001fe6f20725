"""Several commands, one after another in one process, as starting nerfstudio takes 10 s: `host_commands.py JOBS.json`.

Each job has the `words` of a command, an `environment` of its own and a `log` for what it says. Beside the log,
LOG.status gets its exit status; a job without one was not begun.
"""

import json
import os
import runpy
import subprocess
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

TIMEOUT_S = 960


def status_of(words: list[str]) -> int:
    """Run a program of this Python's environment within this process, or a file that Python is to run."""
    program = words[1] if words[0] == "python" else str(Path(sys.executable).with_name(words[0]))
    sys.argv = [program, *words[2 if words[0] == "python" else 1 :]]
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except Exception:
        traceback.print_exc()
        return 1
    return 0


def in_one_process(
    commands: Mapping[str, Sequence[object]],
    folder: Path,
    environments: Mapping[str, Mapping[str, str]] | None = None,
    cwd: Path | None = None,
    variables: Mapping[str, str] | None = None,
) -> Callable[[str], str]:
    """Run commands by their names, with logs in a folder; the result asserts that one ended well, and gives its log.

    Each may have an environment of its own; variables are those of all.
    """
    jobs = [
        {
            "words": [str(word) for word in words],
            "environment": {**(environments or {}).get(name, {})},
            "log": str(folder / f"{name}.log"),
        }
        for name, words in commands.items()
    ]
    (folder / "jobs.json").write_text(json.dumps(jobs))
    program = [sys.executable, __file__, folder / "jobs.json"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **(variables or {})}
    paths = [each["PYTHONPATH"] for each in (variables or {}, os.environ) if each.get("PYTHONPATH")]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    subprocess.run(program, env=environment, cwd=cwd, timeout=TIMEOUT_S, check=False)

    def ended_well(name: str) -> str:
        status, said = folder / f"{name}.log.status", (folder / f"{name}.log").read_text()
        assert status.is_file() and status.read_text() == "0", said[-4000:]
        return said

    return ended_well


def main() -> None:
    for job in json.loads(Path(sys.argv[1]).read_text()):
        log = Path(job["log"])
        with log.open("w") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
            before = dict(os.environ)
            os.environ.update(job["environment"])
            status = status_of(job["words"])
            os.environ.clear()
            os.environ.update(before)
            sys.stdout.flush()
            sys.stderr.flush()
        log.with_name(f"{log.name}.status").write_text(str(status))


if __name__ == "__main__":
    main()
