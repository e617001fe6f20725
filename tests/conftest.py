"""Shared fixtures: where real data may lie, and no surprises from the machine."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import jaxtyping
import pytest

# more threads than cores only slow each other down when tests run side by side
os.environ.setdefault("OMP_NUM_THREADS", "1")
# where tests run in the background of a shell Ctrl-C is ignored, by whatever they start, too
signal.signal(signal.SIGINT, signal.default_int_handler)

REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "real"


@pytest.fixture
def real_data() -> Path:
    """Folder of real KITTI-360 excerpts, beside the checkout; not part of the project."""
    if not REAL_DATA.is_dir():
        pytest.skip("no real data beside the checkout (they are not part of the project)")
    return REAL_DATA


@pytest.fixture(scope="session")
def sample_drive(tmp_path_factory) -> Iterator[Path]:
    """A copy of the sample drive, without anybody's `.cache`, to be read; tests that write make their own."""
    from scenes import copy_sample_drive

    scene = copy_sample_drive(tmp_path_factory.mktemp("sample") / "sample_drive")
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    yield scene
    assert {path: path.stat().st_mtime_ns for path in scene.rglob("*")} == before, "a test wrote into the shared copy"


@pytest.fixture
def unchecked_types():
    """Switch the tests' type checker off, to reach the package's own errors."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
