"""Each fault of a value or a file, one by one, with what is said of it; test_bad_input.py spoils files at random."""

import errno
import os
import threading
import time
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_input import npy
from rich.console import Console

from edge_depth_nerf.base import bounds, files, one_writer
from edge_depth_nerf.base.bounds import finite, path_inside, shown, text_lines
from edge_depth_nerf.base.errors import LONGEST_MESSAGE, InputError
from edge_depth_nerf.base.files import read_json, read_json_object, read_npz, write_json
from edge_depth_nerf.base.one_writer import only_writer
from edge_depth_nerf.scene.format import read_transforms

POSE = np.eye(4).tolist()


@pytest.mark.parametrize(
    ("value", "number"),
    [(1, 1.0), (-2.5, -2.5), (10**400, None), (True, None), ("1", None), (None, None), (float("nan"), None)],
)
def test_numbers_of_files(value: Any, number: float | None) -> None:
    assert finite(value) == number


class Silent:
    def __repr__(self) -> str:
        raise ValueError("no words")


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (7, "7"),
        (10**120, "a whole number of more than a hundred digits"),
        ([0] * 121, "a list of 121"),
        (dict.fromkeys(range(121)), "a table of 121"),
        ("x" * 500, f"'{'x' * 119} …"),
        ([0] * 120, f"{str([0] * 120)[:120]} …"),
        (Silent(), "a Silent"),
    ],
)
def test_values_are_shown_cut_short(value: object, words: str) -> None:
    assert shown(value) == words


def test_long_messages_keep_both_ends() -> None:
    said = str(InputError("a" * LONGEST_MESSAGE + "b" * LONGEST_MESSAGE))
    half = LONGEST_MESSAGE // 2
    assert said == f"{'a' * half} … {'b' * half}"
    assert str(InputError("red\x1b[31m\nnext")) == "red\\x1b[31m\nnext"


@pytest.mark.parametrize("name", ["\ud800", "é" * 128, "a/../../b", "/a", "", 3])
def test_names_that_are_no_path_inside(tmp_path: Path, name: object) -> None:
    with pytest.raises(InputError, match=r"here is .*, expected the path of a file"):
        path_inside(tmp_path, name, "here")
    assert path_inside(tmp_path, "é" * 127, "here") == tmp_path / ("é" * 127)
    assert path_inside(tmp_path, "a/../b", "here") == tmp_path / "a/../b"


def test_text_has_not_too_many_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "times.txt"
    path.write_text("1\n\n 2 \n3\n")
    assert list(text_lines(path)) == [(1, "1"), (3, "2"), (4, "3")]
    monkeypatch.setattr(bounds, "MAX_LINES", 2)
    with pytest.raises(InputError, match=r"more than 2 lines\. Split"):
        list(text_lines(path))


def test_json_has_not_too_many_values_and_what_is_needed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    path.write_text("[1, 2, [3]]")
    assert read_json(path) == [1, 2, [3]]
    monkeypatch.setattr(files, "MAX_JSON_VALUES", 3)
    with pytest.raises(InputError, match="more than 3 values"):
        read_json(path)
    monkeypatch.undo()
    write_json(path, {"a": 1})
    assert read_json_object(path, "a") == {"a": 1}
    with pytest.raises(InputError, match="has no 'b'"):
        read_json_object(path, "a", "b")
    write_json(path, [])
    with pytest.raises(InputError, match="does not contain a JSON object"):
        read_json_object(path)


def test_arrays_of_an_archive_come_back(tmp_path: Path) -> None:
    given = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3))}
    np.savez_compressed(tmp_path / "a.npz", **given)
    found = read_npz(tmp_path / "a.npz", given, 1000)
    assert set(found) == {"a", "b"}
    for name, array in given.items():
        assert found[name].dtype == array.dtype and np.array_equal(found[name], array)


@pytest.mark.parametrize(
    ("content", "compression", "said"),
    [
        (npy(np.arange(3.0)), zipfile.ZIP_BZIP2, "a uses an unsupported compression"),
        (npy(np.array(["words"])), zipfile.ZIP_STORED, "a: an array of <U5"),
        (npy(np.arange(126.0)), zipfile.ZIP_STORED, r"a: an array of float64 and shape \(126,\); .* at most 1000"),
        (npy(np.arange(9.0))[:-8], zipfile.ZIP_STORED, "a: an array .* all that the header promises"),
        (b"no array", zipfile.ZIP_STORED, "a.npz: a"),
    ],
)
def test_arrays_of_an_archive_that_cannot_be_read(tmp_path: Path, content: bytes, compression: int, said: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.npz", "w", compression) as archive:
        archive.writestr("a.npy", content)
    with pytest.raises(InputError, match=said):
        read_npz(tmp_path / "a.npz", ["a"], 1000)


def test_a_folder_that_cannot_be_locked_is_not_waited_for(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    done = []
    with only_writer(tmp_path / "file" / "folder", Console(quiet=True)):
        done.append("who writes there tells why it cannot")
    assert done and (tmp_path / "file").is_file()


class WindowsLocks:
    """What msvcrt has, by what Linux has."""

    LK_NBLCK, LK_UNLCK = 2, 0

    @staticmethod
    def locking(handle: int, mode: int, count: int) -> None:
        import fcntl

        assert count == 1
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB if mode else fcntl.LOCK_UN)
        except BlockingIOError:
            raise PermissionError(errno.EACCES, "Permission denied") from None


@pytest.mark.skipif(os.name == "nt", reason="test_killed.py has the real locks")
def test_windows_locks_a_file_beside_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_writer, "fcntl", None)
    monkeypatch.setattr(one_writer, "msvcrt", WindowsLocks)
    folder, order, console = tmp_path / "scene", [], Console(record=True, quiet=True)
    began = threading.Event()

    def first() -> None:
        with only_writer(folder, console):
            began.set()
            assert list(folder.iterdir()) == [] and (tmp_path / ".scene.lock").is_file()
            time.sleep(0.1)
            order.append("first")
            (folder / "a").touch()

    thread = threading.Thread(target=first)
    thread.start()
    assert began.wait(10)
    with only_writer(folder, console), only_writer(folder, console):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_windows_is_not_asked_whether_a_process_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """There os.kill(number, 0) is Ctrl-C."""
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("killed"))
    with monkeypatch.context() as windows:
        windows.setattr(os, "name", "nt")
        assert files._runs(os.getpid())


def transforms(frame: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    return {"frames": [{"file_path": "a.png", "transform_matrix": POSE, **(frame or {})}], **more}


VIEW = {"camera": "a", "transform_matrix": POSE, "truth_rgb_file_path": "a", "truth_distance_file_path": "b"}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ([], "has no list of frames"),
        ({"frames": [{}]}, "frame 0 has no file_path"),
        ({"frames": transforms()["frames"] * 2}, "frame 1: 'a.png' has a frame already"),
        (transforms({"transform_matrix": POSE[:3]}), "frame 0: transform_matrix must be 4×4 finite numbers"),
        (transforms({"transform_matrix": [[1e9] * 4] * 4}), "transform_matrix holds 1e.09, more than .* in metres"),
        (transforms({"frame": 1.5}), "frame is 1.5, expected a frame number"),
        (transforms({"frame": -1}), "frame is -1, expected a frame number"),
        (transforms({"camera": "../a"}), "frame 0: camera is '../a'"),
        (transforms({"mask_path": "../a"}), "frame 0: mask_path is '../a'"),
        (transforms({"fl_x": "9"}), "frame 0: fl_x is '9', expected a number"),
        (transforms(cx=None), "cx is None, expected a number"),
        (transforms({"w": 7.5}), r"w and h are \[7.5\], expected whole numbers of pixels"),
        (transforms({"h": 10**6}, w=10**6), "frame 0: "),
        (transforms({"distortion_params": [0.0] * 5}), r"frame 0: distortion_params is \[.*expected 6 numbers"),
        (transforms(orientation_override="sideways"), "orientation_override is 'sideways', expected one of pca"),
        (transforms(applied_transform=[[0.0] * 4] * 2), "applied_transform must be 3×4 finite numbers"),
        (transforms(applied_scale=0), "applied_scale is 0, expected a number above"),
        (transforms(ply_file_path="/a"), "ply_file_path is '/a'"),
        (transforms(train_filenames="a.png"), "train_filenames is 'a.png', expected a list of file_paths"),
        (transforms(shifted_views=[]), "shifted_views are none"),
        (transforms(shifted_views={"far": [VIEW]}), "shifted_views are none"),
        (transforms(shifted_views={"1": [{**VIEW, "transform_matrix": 1}]}), "1 m, view 0: transform_matrix must be"),
        (transforms(shifted_views={"1": [VIEW, {**VIEW, "truth_rgb_file_path": 1}]}), "view 1: truth_rgb_file_path"),
        (
            transforms(shifted_views={"1": [{**VIEW, "truth_distance_file_path": "../../a.png"}]}),
            r"view 0: truth_distance_file_path is .*not leading out",
        ),
    ],
)
def test_each_fault_of_a_scene_is_said(tmp_path: Path, content: Any, said: str) -> None:
    write_json(tmp_path / "transforms.json", content)
    with pytest.raises(InputError, match=said):
        read_transforms(tmp_path / "transforms.json")


def test_a_scene_without_fault(tmp_path: Path) -> None:
    content = transforms(
        {"w": 8, "timestamp_s": None, "frame": 7, "camera": "a"},
        **{"h": 8, "applied_transform": POSE, "applied_scale": 2, "ply_file_path": "a.ply", "train_filenames": []},
        **{"orientation_override": "none", "shifted_views": {"-1": [VIEW]}, "distortion_params": [0] * 6},
    )
    write_json(tmp_path / "transforms.json", content)
    assert read_transforms(tmp_path / "transforms.json") == content
