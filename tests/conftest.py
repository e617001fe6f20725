"""Shared fixtures: where real data may lie, and no surprises from the machine."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import jaxtyping
import pytest

# more threads than cores only slow each other down when tests run side by side
os.environ.setdefault("OMP_NUM_THREADS", "1")
# where tests run in the background of a shell Ctrl-C is ignored, by whatever they start, too
signal.signal(signal.SIGINT, signal.default_int_handler)

HOST = "nerfstudio"
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "real"


class SkipWhatImportsTheHost:
    """A finder that skips whatever test or module of tests comes to import nerfstudio, which takes 20 s."""

    def find_spec(self, name: str, *_: object) -> None:
        if name.partition(".")[0] == HOST:
            pytest.skip(f"imports {HOST}, and is part of `make test`", allow_module_level=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help=f"neither what imports {HOST} nor what is marked slow")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--fast"):
        sys.meta_path.insert(0, SkipWhatImportsTheHost())  # pyright: ignore[reportArgumentType]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--fast"):
        slow = [item for item in items if item.get_closest_marker("slow")]
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if item not in slow]


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
