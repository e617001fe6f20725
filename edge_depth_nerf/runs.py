"""What `demo` and `compare` share: trainings in processes of their own, their logs, checkpoints and pictures."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Lock, Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from edge_depth_nerf.errors import InputError
from edge_depth_nerf.files import read_distance_png, read_image, read_json, read_mask
from edge_depth_nerf.pictures import colour_distance

DISTANCE_KEYS = ("truth_distance_file_path", "lidar_file_path")
"""What a view's distances are shown by, the better one first."""


class LoggedCommands:
    """The commands of one run, one after another, with what they say in log files; another thread can stop them."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False
        self._lock = Lock()

    def call(self, command: Sequence[str | Path], log: Path, threads: int, on_line: Callable[[str], None]) -> None:
        """Run a command to its end.

        Its standard input stays open and empty until this process ends, however it ends; a program that reads it
        learns by that.

        Args:
            command: program and arguments.
            log: file that the command and its output are appended to.
            threads: for OMP_NUM_THREADS, unless the environment has it already.
            on_line: called with each line of output.

        Raises:
            InputError: it ended with another status than 0; names the log, the command and the last line.

        """
        log.parent.mkdir(parents=True, exist_ok=True)
        words = [str(word) for word in command]
        last = ""
        with log.open("a", encoding="utf-8") as sink:
            sink.write(f"$ {shlex.join(words)}\n")
            sink.flush()
            with self._lock:
                if self._stopped:
                    raise InputError(f"{words[0]}: stopped before it began.")
                process = self._process = subprocess.Popen(
                    words,
                    env={"OMP_NUM_THREADS": str(threads), "PYTHONUNBUFFERED": "1", **os.environ},
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


def steps_done(checkpoints: Path) -> int:
    """How many steps the newest checkpoint of a folder has behind it; 0 without any."""
    steps = [int(path.stem.removeprefix("step-")) for path in checkpoints.glob("step-*.ckpt")]
    return max(steps, default=-1) + 1


def step_of_line(line: str) -> int | None:
    """The step that a line of nerfstudio's progress tells; None for other lines."""
    step = re.match(r"\s*(\d+) \(\d", line)
    return int(step.group(1)) if step else None


def viewer_command(config: Path) -> str:
    """How to look around in a trained model, on this machine alone."""
    return f"ns-viewer --load-config {config} --viewer.websocket-host 127.0.0.1"


def progress_bars(console: Console) -> Progress:
    """Bars with a description, the time passed and the time left."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    return Progress(*columns, console=console)


def held_out_frames(scene: Path) -> list[dict[str, Any]]:
    """The held-out frames of a scene's transforms.json, in the order in which they are judged."""
    transforms = read_json(scene / "transforms.json")
    names = {name: number for number, name in enumerate(transforms["test_filenames"])}
    frames = [frame for frame in transforms["frames"] if frame["file_path"] in names]
    return sorted(frames, key=lambda frame: frame["file_path"])


def compared_views(
    scene: Path, views_of: Mapping[str, Path], most: int
) -> list[tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]]]:
    """Colours and distances of some held-out views, spread over the drive: the truth, then each run's.

    Args:
        scene: the scene folder.
        views_of: for each run the folder of its judged views, as `ns-eval --render-output-path` writes them.
        most: how many views at most.

    Returns:
        For each view its colours (picture, then each run's) and its distances (true ones, or LiDAR's, then each
        run's), H×W×3 each, black outside the mask.

    """
    frames = held_out_frames(scene)
    chosen = np.linspace(0, len(frames) - 1, min(most, len(frames))).round().astype(int)
    views = []
    for index in chosen:
        frame = frames[index]
        rgb = read_image(scene / frame["file_path"])
        mask = read_mask(scene / frame["mask_path"]) if "mask_path" in frame else np.ones(rgb.shape[:2], bool)
        key = next((key for key in DISTANCE_KEYS if key in frame), None)
        distance_m = np.zeros(mask.shape, np.float32) if key is None else read_distance_png(scene / frame[key])
        colours, distances = [rgb], [colour_distance(distance_m, mask)]
        for folder in views_of.values():
            # nerfstudio saves truth and rendering side by side
            rendered = read_image(folder / f"eval_img_{index:04d}.png")[:, rgb.shape[1] :]
            rendered[~mask] = 0
            colours.append(rendered)
            distances.append(read_image(folder / f"eval_distance_{index:04d}.png"))
        views.append((colours, distances))
    return views
