"""What `demo` and `compare` share: trainings in processes of their own, their logs, checkpoints and pictures."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, get_type_hints

import tyro

from edge_depth_nerf.base.errors import InputError

COMMAND = "$ "
"""Before each command in a log."""


class LoggedCommands:
    """The commands of one run, one after another, with what they say in log files; another thread can stop them."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False
        self._lock = Lock()

    def call(
        self,
        command: Sequence[str | Path],
        log: Path,
        threads: int,
        on_line: Callable[[str], None],
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Run a command to its end.

        Its standard input stays open and empty until this process ends, however it ends; a program that reads it
        learns by that.

        Args:
            command: program and arguments.
            log: file that the command and its output are appended to.
            threads: for OMP_NUM_THREADS, unless the environment has it already.
            on_line: called with each line of output.
            environment: variables that it gets whatever the environment has.

        Raises:
            InputError: it ended with another status than 0; names the log, the command and the last line.

        """
        log.parent.mkdir(parents=True, exist_ok=True)
        words = [str(word) for word in command]
        last = ""
        with log.open("a", encoding="utf-8") as sink:
            sink.write(f"{COMMAND}{shlex.join(words)}\n")
            sink.flush()
            with self._lock:
                if self._stopped:
                    raise InputError(f"{words[0]}: stopped before it began.")
                process = self._process = subprocess.Popen(
                    words,
                    env={"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1", **os.environ, **(environment or {})},
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            assert process.stdout is not None
            for line in process.stdout:
                sink.write(line)
                sink.flush()
                last = line.strip() or last
                on_line(line)
            status = process.wait()
        if status:
            raise InputError(
                f"{Path(words[0]).name} ended with status {status}. What it said is in {log}, at last: {last} The "
                f"command was\n{shlex.join(words)}"
            )

    def stop(self) -> None:
        """Kill what runs and let nothing more begin."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.kill()


def host_program(name: str) -> Path:
    """One of nerfstudio's commands: the one beside this Python, or else on the path.

    Raises:
        InputError: it is in neither place.

    """
    beside = Path(sys.executable).with_name(name)
    found = beside if beside.is_file() else shutil.which(name)
    if found is None:
        raise InputError(
            f"{name}: neither beside {sys.executable} nor on PATH. `edge-depth-nerf doctor` says what is amiss."
        )
    return Path(found)


@contextmanager
def files_counted(folder: Path | None, pattern: str, tell: Callable[[int], None]) -> Iterator[None]:
    """Tell, once a second, how many files of a folder have been written since; without a folder nothing."""
    begun, ended = time.time() - 1.0, Event()  # file systems keep coarser clocks

    def watch(folder: Path) -> None:
        while not ended.wait(1.0):
            tell(sum(path.stat().st_mtime >= begun for path in folder.glob(pattern)))

    if folder is not None:
        Thread(target=watch, args=(folder,), daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def end_with_parent() -> None:
    """Let a program that `LoggedCommands` started die when the process that did so is gone, killed or not.

    That process's end of our standard input closes then.
    """

    def wait() -> None:
        # not sys.stdin: Python would wait for its lock when it ends
        while os.read(0, 1024):
            pass
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def checkpoints_in(folder: Path) -> list[Path]:
    """Files of a folder that have a checkpoint's name, the newest last."""
    return sorted(path for path in folder.glob("step-*.ckpt") if re.fullmatch(r"step-\d{9,}", path.stem))


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint of a folder that is whole: torch writes archives with a checksum of each part.

    nerfstudio's own trainer writes in place, so a killed training may leave half a file.
    """
    return next((path for path in reversed(checkpoints_in(folder)) if _is_whole(path)), None)


def _is_whole(archive: Path) -> bool:
    try:
        with zipfile.ZipFile(archive) as opened:
            return opened.testzip() is None
    except (OSError, ValueError, NotImplementedError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return False


def steps_done(checkpoints: Path) -> int:
    """How many steps the newest whole checkpoint of a folder has behind it; 0 without any."""
    newest = newest_checkpoint(checkpoints)
    return 0 if newest is None else int(newest.stem.removeprefix("step-")) + 1


def step_of_line(line: str) -> int | None:
    """The step that a line of nerfstudio's progress tells; None for other lines."""
    step = re.match(r"\s*(\d+) \(\d", line)
    return int(step.group(1)) if step else None


def viewer_command(config: Path) -> str:
    """How to look around in a trained model, on this machine alone."""
    return f"ns-viewer --load-config {config} --viewer.websocket-host 127.0.0.1"


def command_line(words: Sequence[str], options: Any) -> str:
    """Write the command that gives options: those that are not at their defaults.

    Args:
        words: the command, such as `edge-depth-nerf demo`.
        options: its options, a dataclass as tyro reads it; what has no flag comes first.

    """
    found = [*words]
    hints = get_type_hints(type(options), include_extras=True)
    for entry in fields(options):
        value = getattr(options, entry.name)
        if value == entry.default:
            continue
        values = [str(each) for each in (value if isinstance(value, tuple) else (value,))]
        if tyro.conf.Positional in getattr(hints[entry.name], "__metadata__", ()):
            found += values
            continue
        flag = entry.name.replace("_", "-")
        if isinstance(value, bool):
            found.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            found += [f"--{flag}", *values]
    return shlex.join(found)


def logged_commands(log: Path) -> list[str]:
    """The commands that `LoggedCommands` wrote to a log, each once, programs without their folder.

    Of a training that was stopped and taken up again the first alone: it asks for all the steps.
    """
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log.is_file() else []
    found = []
    for line in lines:
        if line.startswith(COMMAND):
            program, *rest = shlex.split(line.removeprefix(COMMAND))
            if found and "--load-dir" in rest:
                continue
            found.append(shlex.join([Path(program).name, *rest]))
    return list(dict.fromkeys(found))
