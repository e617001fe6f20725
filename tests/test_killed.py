"""Killed at any moment, broken caches, two at once, full disks: what is there afterwards is right, or made again."""

import copy
import errno
import io
import os
import platform
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from drives import SEQUENCE, RoomDrive, write_room_drive
from rich.console import Console
from scenes import tree as contents
from scenes import write_scene

from edge_depth_nerf import entry
from edge_depth_nerf.base.checked_cache import content_of, is_whole, keep_last, write_checked
from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.base.files import explain, remove_leftovers, write_bytes, write_text
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.jobs.runs import newest_checkpoint, steps_done
from edge_depth_nerf.method.error_model import read_calibration
from edge_depth_nerf.method.integration import IntegrationOptions
from edge_depth_nerf.method.prior import PriorOptions
from edge_depth_nerf.mono import estimate
from edge_depth_nerf.mono.calibration import calibrate_scene
from edge_depth_nerf.mono.network import DepthNetwork, NetworkSettings, read_tensors, write_tensors
from edge_depth_nerf.plugin import datamanager
from edge_depth_nerf.plugin.datamanager import FisheyeDepthDataManagerConfig
from edge_depth_nerf.plugin.dataparser import FisheyeDepthDataParserConfig
from edge_depth_nerf.process.command import process
from edge_depth_nerf.process.options import Kitti360Options
from edge_depth_nerf.scene import put_maps
from edge_depth_nerf.scene.put_maps import write_maps
from edge_depth_nerf.scene.reader import read_scene

pytestmark = pytest.mark.slow

DEAD = 2**22 + 1
"""No process has such a number."""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomDrive:
    return write_room_drive(tmp_path_factory.mktemp("room") / "drive", frames=4, beams=800, size=32)


def options_of(room: RoomDrive, output: Path) -> Kitti360Options:
    left_out: dict[str, Any] = dict.fromkeys(("find_ego", "refine_poses", "motion", "estimate_depth"), False)
    return Kitti360Options(root=room.root, sequence=SEQUENCE, output=output, sweeps=1, **left_out)


def words_of(room: RoomDrive) -> list[str]:
    """The same on the command line, but for the output."""
    left_out = ["--no-find-ego", "--no-refine-poses", "--no-motion", "--no-estimate-depth"]
    return ["process", "kitti360", "--root", str(room.root), "--sequence", SEQUENCE, "--sweeps", "1", *left_out]


@pytest.fixture(scope="module")
def whole(room: RoomDrive, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What is in the scene that nothing disturbs."""
    folder = tmp_path_factory.mktemp("whole") / "scene"
    process(options_of(room, folder), Console(quiet=True))
    return contents(folder)


# ---- files and caches ------------------------------------------------------------------------------------------
def test_a_sealed_file_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    write_checked(path, 3, lambda file: [file.write(b"one"), file.write(b" two")])
    assert content_of(path, 3) == b"one two" and is_whole(path, 3)
    stored = path.read_bytes()
    spoiled = [stored[:-1], stored[1:], b"", stored + b"x", stored[:5]]
    spoiled += [stored[:i] + bytes([stored[i] ^ 4]) + stored[i + 1 :] for i in range(len(stored))]
    for broken in spoiled:
        path.write_bytes(broken)
        assert content_of(path, 3) is None and not is_whole(path, 3), broken
    path.write_bytes(stored)
    assert is_whole(path, 3) and not is_whole(path, 4) and content_of(path, 4) is None
    assert not is_whole(tmp_path / "none", 3) and content_of(tmp_path / "none", 3) is None


@pytest.mark.parametrize("of_the_seal", [False, True])
def test_a_spoiled_cache_is_made_again(tmp_path: Path, of_the_seal: bool) -> None:
    scene = write_scene(tmp_path, frames=3)
    config = FisheyeDepthDataManagerConfig(dataparser=FisheyeDepthDataParserConfig(data=scene))

    def first_batch() -> tuple[torch.Tensor, ...]:
        torch.manual_seed(0)
        rays, batch = config.setup(test_mode="val").next_train(0)
        return rays.directions, batch["indices"], batch["image"], batch["prior_distance_m"], batch["prior_sigma_m"]

    whole = first_batch()
    for kind in ("prior", "rays", "pixels"):
        folder = scene / ".cache" / kind
        before = {path: path.read_bytes() for path in sorted(folder.glob("*.np[yz]"))}
        assert before, kind
        for path, content in before.items():
            place = len(content) - 8 if of_the_seal else len(content) // 2
            path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        if kind == "prior":
            shutil.rmtree(scene / ".cache" / "pixels")  # or nobody would look at them
        assert all(torch.equal(now, then) for now, then in zip(first_batch(), whole, strict=True)), kind
        assert {path: path.read_bytes() for path in sorted(folder.glob("*.np[yz]"))} == before, kind


def test_a_changed_calibration_is_not_believed(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, frames=4)
    calibrate_scene(scene)
    path = scene / "mono_trust.json"
    text = path.read_text()
    read_calibration(path)
    place = text.index('"field_rad"') + 20
    digit = next(i for i in range(place, len(text)) if text[i].isdigit())
    path.write_text(text[:digit] + str((int(text[digit]) + 1) % 10) + text[digit + 1 :])
    with pytest.raises(InputError, match="checksum"):
        read_calibration(path)


def test_caches_do_not_grow_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge_depth_nerf.method.prior.KEPT_SETS", 2)
    monkeypatch.setattr("edge_depth_nerf.mono.calibration.KEPT_CALIBRATIONS", 2)
    scene = write_scene(tmp_path, frames=3)
    config = FisheyeDepthDataManagerConfig(dataparser=FisheyeDepthDataParserConfig(data=scene))
    for alpha in (0.3, 0.4, 0.5, 0.6):
        config.prior = PriorOptions(integration=IntegrationOptions(alpha=alpha))
        # what a killed process left
        write_bytes(scene / ".cache/prior" / f".x.{platform.node()}~{DEAD}~1.npz", b"half")
        config.setup(test_mode="val")
    count = len(config.setup(test_mode="val").train_dataset)
    assert len(list((scene / ".cache/prior").glob("*.npz"))) == 2 * count
    assert len(list((scene / ".cache").glob("mono_trust_*"))) == 2
    assert len(list((scene / ".cache/rays").iterdir())) == 1


def test_the_files_used_last_are_kept(tmp_path: Path) -> None:
    for number in range(4):
        path = tmp_path / f"{number}.npy"
        path.write_bytes(b"x")
        os.utime(path, ns=(number, number))
    (tmp_path / ".being_written.npy").write_bytes(b"x")
    keep_last(tmp_path, "*.npy", 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".being_written.npy", "2.npy", "3.npy"]


def test_leftovers_of_killed_processes_alone_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = platform.node()
    left = {
        f".a.{here}~{DEAD}~7.png": False,
        f".a.{here}~{os.getpid()}~7.png": True,  # being written
        f".a.elsewhere.example~{DEAD}~7.png": True,  # perhaps being written on another machine
        ".hidden.png": True,
        "a.png": True,
    }
    for name in left:
        (tmp_path / name).write_bytes(b"")
    old = tmp_path / f".b.elsewhere~{DEAD}~7.npz"
    old.write_bytes(b"")
    os.utime(old, (0, 0))
    remove_leftovers(tmp_path)
    assert {name: (tmp_path / name).exists() for name in left} == left and not old.exists()
    # a file that is being written has such a name
    seen = []
    monkeypatch.setattr(os, "replace", lambda temporary, path: seen.append(temporary))
    write_text(tmp_path / "x" / "a.json", "{}")
    (tmp_path / "x" / seen[0].name.replace(f"~{os.getpid()}~", f"~{DEAD}~")).write_bytes(b"")
    remove_leftovers(tmp_path / "x")
    assert not list((tmp_path / "x").iterdir())


def test_the_same_weights_are_the_same_bytes(tmp_path: Path) -> None:
    """safetensors orders its header by chance."""
    tensors = {name: torch.arange(6.0).view(2, 3) + number for number, name in enumerate("cab")}
    for number in range(20):
        write_tensors(tmp_path / f"{number}.safetensors", tensors, {"settings": {"b": 1, "a": [2]}})
    assert len(set(contents(tmp_path).values())) == 1
    found, header = read_tensors(tmp_path / "0.safetensors")
    assert header == {"settings": {"b": 1, "a": [2]}}
    assert all(torch.equal(found[name], tensors[name]) for name in tensors)


# ---- two at once -----------------------------------------------------------------------------------------------
HOLD = """
import sys, time
from pathlib import Path
from rich.console import Console
from edge_depth_nerf.base.one_writer import only_writer
with only_writer(Path(sys.argv[1]), Console()):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_writer_waits_until_the_first_is_gone(tmp_path: Path) -> None:
    folder = tmp_path / "not" / "there"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None and first.stdout.readline() == "held\n"
        console = Console(file=io.StringIO(), width=300)
        threading.Timer(0.6, lambda: first.send_signal(signal.SIGKILL)).start()
        begun = time.monotonic()
        with only_writer(folder, console), only_writer(folder, console):
            assert time.monotonic() - begun > 0.4
            write_text(folder / "a", "")
        assert isinstance(console.file, io.StringIO)
        assert console.file.getvalue().count("another process writes there") == 1
    assert (folder / "a").exists()


def test_a_folder_that_nothing_was_written_to_is_taken_away(tmp_path: Path) -> None:
    with pytest.raises(InputError), only_writer(tmp_path / "a" / "b", Console(quiet=True)):
        assert (tmp_path / "a" / "b").is_dir()
        raise InputError("in vain")
    assert not (tmp_path / "a").exists()


# ---- killed ----------------------------------------------------------------------------------------------------
FORKS = """
import os, sys
from pathlib import Path
from edge_depth_nerf.entry import main

folder, lasts = Path(sys.argv.pop(1)), sys.argv.pop(1).split()
sys.argv += ["--output", str(folder / "whole")]
main()  # what it imports, and what it finds of lenses, is there for all
replace = os.replace

def begin(name, log, last=None):
    child = os.fork()
    if child:
        return child

    def dying(temporary, path):
        if last and str(path).endswith(last):
            os.kill(os.getpid(), 9)
        return replace(temporary, path)

    for stream in 1, 2:
        os.dup2(os.open(folder / log, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
    os.replace, sys.argv[-1] = dying, str(folder / name)
    main()
    sys.stdout.flush()
    os._exit(0)

for last in lasts:
    assert os.waitpid(begin("killed", "killed.log", last), 0)[1] == 9, last
    assert not (folder / "killed" / "transforms.json").exists(), last
both = [begin("both", log) for log in ("one.log", "other.log")]
assert [os.waitpid(child, 0)[1] for child in both] == [0, 0]
"""


def test_process_killed_before_a_file_appears_and_two_on_one_scene(
    room: RoomDrive, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """One run, killed again and again, each time further on; and another scene that two write at once."""
    lasts = "process.json image_03/0000000003.npz points.ply transforms.json"
    command = [sys.executable, "-c", FORKS, tmp_path, lasts, *words_of(room)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = [log.read_text() for log in sorted(tmp_path.glob("*.log"))]
    assert done.returncode == 0, (done.stderr, said)
    process(options_of(room, tmp_path / "killed"), Console(quiet=True))
    assert contents(tmp_path / "killed") == contents(tmp_path / "both") == whole
    assert sum("all of them were there" in text for text in said[1:]) == 1


def test_weights_that_were_read_predict_what_trained_ones_did(sample_drive: Path) -> None:
    """Trained ones lie in another order in memory, and convolutions then add up otherwise."""
    scene = read_scene(sample_drive)
    scene = replace(scene, pictures=scene.pictures[:1])
    torch.manual_seed(0)
    network = DepthNetwork(NetworkSettings((16, 32, 64), 128, 1.6, 10.0)).eval()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.1)
    trained = copy.deepcopy(network).to(memory_format=torch.channels_last)
    ((_, read_m),), ((_, trained_m),) = (estimate.predicted_maps(each, scene) for each in (network, trained))
    assert (read_m > 0).any() and np.array_equal(read_m, trained_m)


def test_the_newest_whole_checkpoint_is_taken(tmp_path: Path) -> None:
    for step in (9, 19, 29, 39):
        torch.save({"step": step, "weights": torch.arange(4000.0)}, tmp_path / f"step-{step:09d}.ckpt")
    (tmp_path / "step-latest.ckpt").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("nerfstudio would stumble over this")
    assert steps_done(tmp_path) == 40
    newest = tmp_path / "step-000000039.ckpt"
    newest.write_bytes(newest.read_bytes()[:-200])
    flipped = bytearray((tmp_path / "step-000000029.ckpt").read_bytes())
    flipped[len(flipped) // 2] ^= 1
    (tmp_path / "step-000000029.ckpt").write_bytes(flipped)
    assert newest_checkpoint(tmp_path) == tmp_path / "step-000000019.ckpt" and steps_done(tmp_path) == 20
    (tmp_path / "step-000000019.ckpt").write_bytes(b"")
    (tmp_path / "step-000000009.ckpt").write_bytes(b"no archive")
    assert newest_checkpoint(tmp_path) is None and steps_done(tmp_path) == 0
    assert steps_done(tmp_path / "nowhere") == 0


# ---- disks -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.ENOSPC, "free some space"), (errno.EROFS, "read-only"), (errno.EACCES, "has no permission")],
)
def test_a_file_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    write_bytes(tmp_path / "a.bin", b"before")

    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))  # as a full disk does it: without a name

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OSError, match=r"a\.bin") as error:
        write_bytes(tmp_path / "a.bin", b"after")
    monkeypatch.undo()
    assert contents(tmp_path) == {"a.bin": b"before"}
    said = explain(error.value)
    assert said.startswith(f"{tmp_path / 'a.bin'}: {os.strerror(number)}. ") and words in said and "\n" not in said


def test_a_full_disk_and_then_a_larger_one(
    room: RoomDrive, whole: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=24k", "tmpfs", str(disk)]
    if os.geteuid() != 0 or shutil.which("mount") is None or subprocess.run(mounted, check=False).returncode:
        pytest.skip("only root may mount a small disk")
    try:
        command = ["edge-depth-nerf", *words_of(room), "--output", str(disk / "scene")]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", command)
            with pytest.raises(SystemExit) as ended:
                entry.main()
            assert ended.value.code == 2
            said = capsys.readouterr().err
            assert "edge-depth-nerf: " in said and "The disk is full" in said and str(disk / "scene") in said
            assert not (disk / "scene/transforms.json").exists()
            assert not [path for path in disk.rglob(".*") if "~" in path.name]
            subprocess.run(["mount", "-o", "remount,size=4m", str(disk)], check=True)
            entry.main()
        assert contents(disk / "scene") == whole
        # one that can read-only
        subprocess.run(["mount", "--bind", str(disk), str(disk)], check=True)
        subprocess.run(["mount", "-o", "remount,bind,ro", str(disk)], check=True)
        with pytest.raises((OSError, InputError), match="scene"):
            write_maps(disk / "scene", "mono", [], {"trained_on": "elsewhere"})
        with pytest.raises(InputError, match="cannot be written"):
            process(options_of(room, disk / "other"), Console(quiet=True))
        assert contents(disk / "scene") == whole
    finally:
        while subprocess.run(["umount", "-l", str(disk)], capture_output=True, check=False).returncode == 0:
            pass


def test_a_disk_that_fills_up_while_maps_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_scene(tmp_path, frames=3)
    before, write, left = contents(scene), put_maps.write_distance_png, [2]

    def filling(path: Path, metres: np.ndarray) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write(path, metres)

    monkeypatch.setattr(put_maps, "write_distance_png", filling)
    maps = ((f"images/{number:04d}.png", np.full((28, 32), 3.0)) for number in range(3))
    with pytest.raises(OSError, match="No space"):
        write_maps(scene, "mono", maps, {"trained_on": "elsewhere"})
    assert contents(scene) == before


def test_no_room_for_the_table_of_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = write_scene(tmp_path, frames=3)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(datamanager, "write_table", full)
    config = FisheyeDepthDataManagerConfig(dataparser=FisheyeDepthDataParserConfig(data=scene))
    with pytest.raises(InputError, match=r"pixels: the table of pixels cannot be written \(No space.*cache-dir"):
        config.setup(test_mode="val")
    monkeypatch.undo()
    config.setup(test_mode="val")
