"""What `demo` and `compare` share, apart from them."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from edge_depth_nerf.base.errors import InputError
from edge_depth_nerf.jobs.runs import files_counted, host_program


def test_files_are_counted_while_they_are_written(tmp_path):
    (tmp_path / "eval_img_0000.png").touch()
    os.utime(tmp_path / "eval_img_0000.png", (1, 1))  # of an earlier, interrupted run
    told: list[int] = []
    with files_counted(tmp_path, "eval_img_*.png", told.append):
        for number in (1, 2):
            (tmp_path / f"eval_img_000{number}.png").touch()
        (tmp_path / "eval_distance_0001.png").touch()
        deadline = time.monotonic() + 120
        while not told:
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert set(told) == {2}
    with files_counted(None, "*", lambda _: pytest.fail("told")):
        pass


def test_the_host_s_commands_are_found(tmp_path, monkeypatch):
    """Beside Python, as in a virtual environment, else on the path, as after `pip install --user`."""
    for folder in ("python", "path"):
        (tmp_path / folder).mkdir()
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python" / "python3"))
    monkeypatch.setenv("PATH", str(tmp_path / "path"))
    with pytest.raises(InputError, match=r"ns-train: neither beside .* nor on PATH\..*doctor"):
        host_program("ns-train")
    for folder in ("path", "python"):
        program = tmp_path / folder / "ns-train"
        program.touch(mode=0o755)
        assert host_program("ns-train") == program
    assert isinstance(host_program("ns-train"), Path)
