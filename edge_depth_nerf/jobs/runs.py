"""Commands in processes of their own, with logs; the checkpoints of trainings; commands as a user would type them."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from threading import Lock, Thread
from typing import Any, get_type_hints

import tyro

from edge_depth_nerf.base.errors import InputError


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
        # Windows' own encoding lacks the letters of progress bars
        told = {"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}
        last = ""
        with log.open("a", encoding="utf-8") as sink:
            sink.write(f"$ {shlex.join(words)}\n")
            sink.flush()
            with self._lock:
                if self._stopped:
                    raise InputError(f"{words[0]}: stopped before it started.")
                process = self._process = subprocess.Popen(
                    words,
                    env={**told, **os.environ, **(environment or {})},
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    encoding="utf-8",
                    errors="replace",
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
                f"{Path(words[0]).name} ended with status {status}. Its log is {log}. The last line is: {last} The "
                f"command was\n{shlex.join(words)}"
            )

    def stop(self) -> None:
        """Kill what runs and let nothing more begin."""
        with self._lock:
            self._stopped = True
            if self._process is not None:
                self._process.kill()


def end_with_parent(end: Callable[[], object] = lambda: os._exit(1)) -> None:
    """Let a program that `LoggedCommands` started die when the process that did so is gone, killed or not.

    That process's end of our standard input closes then, and `end` is called.
    """

    def wait() -> None:
        # not sys.stdin: Python would wait for its lock when it ends
        while os.read(0, 1024):
            pass
        end()

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


def viewer_command(config: Path) -> str:
    """How to look around in a trained model, on this machine alone."""
    return f"ns-viewer --load-config {shlex.quote(str(config))} --viewer.websocket-host 127.0.0.1"


def commands_after(config: Path, scene: Path, preset: str, compares: bool = True) -> dict[str, str]:
    """What to do with a trained model next, and the command for it; `compares`: whether the scene can be compared."""
    given = f"--load-config {shlex.quote(str(config))}"
    compared = f"{shlex.quote(str(scene))} --output {shlex.quote(str(config.parents[2] / 'comparison'))}"
    found = {
        "View it": viewer_command(config),
        "Evaluate it": f"ns-eval {given} --output-path {shlex.quote(str(config.with_name('figures.json')))} "
        f"--render-output-path {shlex.quote(str(config.with_name('held_out')))}",
        "Make a film": f"edge-depth-nerf camera-path {given}",
    }
    if compares:
        found["Compare"] = f"edge-depth-nerf compare {compared} --preset {preset} --methods nerfacto edge"
    return found


def command_line(words: Sequence[str], options: Any) -> str:
    """Write the command that gives those options that are not at their defaults; what has no flag comes first."""
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
