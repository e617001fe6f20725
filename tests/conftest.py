"""Shared fixtures and options: which tests are fast, where real data may lie, no surprises from the machine."""

import ast
import gc
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
from packaging.version import Version

# more threads than cores only slow each other down when tests run side by side
os.environ.setdefault("OMP_NUM_THREADS", "1")
# where tests run in the background of a shell Ctrl-C is ignored, by whatever they start, too
signal.signal(signal.SIGINT, signal.default_int_handler)

if (3, 11) <= sys.version_info < (3, 11, 8):
    parse = ast.parse

    def parse_without_collection(*arguments: Any, **options: Any) -> Any:
        """Parse while no finalizer can, which raises SystemError in these versions (their issue 106905)."""
        collects = gc.isenabled()
        gc.disable()
        try:
            return parse(*arguments, **options)
        finally:
            if collects:
                gc.enable()

    ast.parse = parse_without_collection

# the last versions for Python 3.10 would wrap what Numba and Triton have to read
if Version(version("jaxtyping")) < Version("0.3.11"):
    for finder in sys.meta_path:
        if type(finder).__module__ == "jaxtyping._import_hook":
            finder.modules = [each for each in finder.modules if each != "edge_depth_nerf.kernels"]  # pyrefly: ignore

ARRAYS = re.compile(r"\b(Bool|Float|Int|Shaped|UInt)\d*\[")
with_shapes = jaxtyping.jaxtyped


def jaxtyped(checked: Any = None, *, typechecker: Any) -> Any:
    """Check calls of what has arrays in its signature: jaxtyping's checks are slow, and pyrefly knows other types."""
    if checked is None:
        return lambda function: jaxtyped(function, typechecker=typechecker)
    if isinstance(checked, type) or ARRAYS.search(str(getattr(checked, "__annotations__", ""))):
        return with_shapes(checked, typechecker=typechecker)
    return checked


jaxtyping.jaxtyped = jaxtyped  # pyrefly: ignore

HOST = "nerfstudio"
LARGE_BYTES = 2 << 20
REAL_DATA = Path(__file__).resolve().parents[2] / "shared" / "real"


class SkipWhatImportsTheHost:
    """A finder that skips whatever module of tests, or test, comes to import nerfstudio, which takes 10 s."""

    def find_spec(self, name: str, *_: object) -> None:
        if name.partition(".")[0] == HOST:
            pytest.skip(f"imports {HOST}, and is part of `make test`", allow_module_level=True)


class NoProcess(subprocess.Popen):
    """Skips whatever test starts a program: most of these import nerfstudio."""

    allowed = False

    def __init__(self, *arguments: Any, **options: Any) -> None:
        if not self.allowed:
            pytest.skip("starts a program, and is part of `make test`")
        super().__init__(*arguments, **options)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help=f"nothing that imports {HOST}, starts a program or is slow")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--fast"):
        sys.meta_path.insert(0, SkipWhatImportsTheHost())


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no module whose tests are slow all together."""
    if config.getoption("--fast") and collection_path.suffix == ".py":
        return "\npytestmark = pytest.mark.slow" in collection_path.read_text(encoding="utf-8") or None
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let files with slow tests go first, so that none of them is left for one worker at the end; or leave them out."""
    slow = [item for item in items if item.get_closest_marker("slow")]
    if config.getoption("--fast"):
        subprocess.Popen = NoProcess  # not earlier: pytest-xdist starts its workers with it
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if item not in slow]
    files = {item.path for item in slow}
    # one worker compiles what trains while the other does not need it yet
    items.sort(key=lambda item: (item.path.name != "test_commands.py", item.path not in files))


@pytest.fixture
def may_start_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that have to, with --fast as well."""
    monkeypatch.setattr(NoProcess, "allowed", True)


@pytest.fixture
def real_data() -> Path:
    """Folder of real KITTI-360 excerpts, beside the checkout; not part of the project."""
    if not REAL_DATA.is_dir():
        pytest.skip("no real data beside the checkout (they are not part of the project)")
    return REAL_DATA


@pytest.fixture(scope="module", autouse=True)
def nothing_large_is_left(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Remove a module's large files, checkpoints above all, once all of its tests have passed.

    Folders and small files stay until the next run: tensorboard's writer lives on in the process and needs its own.
    """
    base, failed = tmp_path_factory.getbasetemp(), request.session.testsfailed
    before = set(base.iterdir())
    yield
    if request.session.testsfailed == failed:
        for folder in set(base.iterdir()) - before:
            for path in folder.rglob("*"):
                if path.is_file() and not path.is_symlink() and path.stat().st_size > LARGE_BYTES:
                    path.unlink()


@pytest.fixture(scope="session")
def sample_drive(tmp_path_factory) -> Iterator[Path]:
    """A copy of the sample drive, without anybody's `.cache`, to be read; tests that write make their own."""
    from scenes import copy_sample_drive

    scene = copy_sample_drive(tmp_path_factory.mktemp("sample") / "sample_drive")
    before = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    yield scene
    assert {path: path.stat().st_mtime_ns for path in scene.rglob("*")} == before, "a test wrote into the shared copy"


@pytest.fixture(scope="module")
def browser():
    """For pages that tests open; see browser.py."""
    from browser import open_browser

    with open_browser() as found:
        yield found


@pytest.fixture
def unchecked_types():
    """Switch the tests' type checker off, to reach the package's own errors."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
