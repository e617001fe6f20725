"""Shared fixtures: where real data may lie, and no surprises from the machine."""

from __future__ import annotations

import os
import signal
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


@pytest.fixture
def unchecked_types():
    """Switch the tests' type checker off, to reach the package's own errors."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
