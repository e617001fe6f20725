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
from dataclasses import dataclass, fields
from pathlib import Path
from threading import Event, Lock, Thread
from typing import Any, get_type_hints

import numpy as np
import tyro
from numpy.typing import NDArray

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_distance_png, read_image, read_mask
from edge_depth_nerf.pictures import colour_distance
from edge_depth_nerf.scene_format import read_transforms

DISTANCE_KEYS = ("truth_distance_file_path", "lidar_file_path")
"""What a view's distances are shown by, the better one first."""

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


def held_out_frames(scene: Path) -> list[dict[str, Any]]:
    """The held-out frames of a scene's transforms.json, in the order in which they are judged."""
    transforms = read_transforms(scene / "transforms.json")
    names = set(transforms.get("test_filenames", ()))
    frames = [frame for frame in transforms["frames"] if frame["file_path"] in names]
    return sorted(frames, key=lambda frame: frame["file_path"])


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A held-out view: what is known of it, and what each run made of it. Pictures are H×W×3 uint8, maps H×W."""

    name: str
    """Its file in the scene."""
    rgb: NDArray[np.uint8]
    """The recorded picture."""
    clean_rgb: NDArray[np.uint8] | None
    """The same without noise and exposure drift, where that is known."""
    mask: NDArray[np.bool_]
    """True = judge the pixel."""
    distance_m: NDArray[np.float32]
    """Metres along the ray, 0 = unknown."""
    distance_key: str | None
    """Which of `DISTANCE_KEYS` that is; None without any."""
    colours: dict[str, NDArray[np.uint8]]
    """What each run rendered, black outside the mask."""
    distances: dict[str, NDArray[np.uint8]]
    """The median distances that it rendered, in the colours of `colour_distance`."""

    def rows(self) -> tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]:
        """Its colours, then its distances: the recorded ones first, then each run's."""
        known = colour_distance(self.distance_m, self.mask)
        return [self.rgb, *self.colours.values()], [known, *self.distances.values()]


def spread_over(count: int, most: int) -> list[int]:
    """Choose at most `most` of `count` numbers from 0 on, evenly spread, the first and the last among them."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()


def compared_view(scene: Path, frame: Mapping[str, Any], index: int, views_of: Mapping[str, Path]) -> ComparedView:
    """Read a held-out view.

    Args:
        scene: the scene folder.
        frame: one of its `held_out_frames`.
        index: its place among these.
        views_of: for each run the folder of its judged views, as `ns-eval --render-output-path` writes them.

    """
    rgb = read_image(scene / frame["file_path"])
    mask = read_mask(scene / frame["mask_path"]) if "mask_path" in frame else np.ones(rgb.shape[:2], bool)
    key = next((key for key in DISTANCE_KEYS if key in frame), None)
    clean = frame.get("truth_rgb_file_path")
    colours, distances = {}, {}
    for name, folder in views_of.items():
        # nerfstudio saves truth and rendering side by side
        rendered = read_image(folder / f"eval_img_{index:04d}.png")[:, rgb.shape[1] :]
        colours[name] = np.where(mask[..., None], rendered, 0).astype(np.uint8)
        distances[name] = read_image(folder / f"eval_distance_{index:04d}.png")
    return ComparedView(
        name=frame["file_path"],
        rgb=rgb,
        clean_rgb=None if clean is None else read_image(scene / clean),
        mask=mask,
        distance_m=np.zeros(mask.shape, np.float32) if key is None else read_distance_png(scene / frame[key]),
        distance_key=key,
        colours=colours,
        distances=distances,
    )


def compared_views(scene: Path, views_of: Mapping[str, Path], most: int | None = None) -> Iterator[ComparedView]:
    """Read some held-out views, spread over the drive, or all.

    Args:
        scene: the scene folder.
        views_of: for each run the folder of its judged views.
        most: how many views at most; None: all.

    """
    frames = held_out_frames(scene)
    for index in spread_over(len(frames), len(frames) if most is None else most):
        yield compared_view(scene, frames[index], index, views_of)


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
