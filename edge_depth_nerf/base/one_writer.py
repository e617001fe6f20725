"""One process at a time writes a scene; the next one waits, and then finds what was done."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from edge_depth_nerf.base.console import say

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
try:
    import msvcrt
except ImportError:  # everywhere else
    msvcrt = None

POLL_S = 0.2
_held: set[tuple[Path, int]] = set()
"""Folders that a thread of this process holds."""


@contextmanager
def only_writer(folder: Path, console: Console) -> Iterator[None]:
    """Hold a folder while it is written to, or wait until nobody else does.

    The folder itself is locked, so nothing is left behind; on Windows, which locks no folders, a file beside it is. The
    system lets go of either when a process is killed. A folder that is not there is made, and taken away again if
    nothing was written to it. A thread may hold a folder twice. Where there are no locks (some network disks) nothing
    is waited for.
    """
    key = (folder.resolve(), threading.get_ident())
    if key in _held:
        yield
        return
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        handle, place = _locked(folder, console)
    except OSError:
        # cannot be made or locked: who writes to it tells why, or can
        yield
        return
    _held.add(key)
    try:
        yield
    finally:
        _held.discard(key)
        for path in missing:
            try:
                path.rmdir()
            except OSError:
                break  # something is in it
        _unlock(handle, place)


def _locked(folder: Path, console: Console) -> tuple[int, Path]:
    """Lock a folder, or on Windows a file beside it; give what is to be closed, and what is locked."""
    whole, said = folder.resolve(), False
    place = folder if fcntl is not None else whole.with_name(f".{whole.name}.lock")
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(place, os.O_RDONLY if fcntl is not None else os.O_RDWR | os.O_CREAT)
        try:
            _try_lock(handle)
            # whoever held it may have taken it away
            if os.path.samestat(os.fstat(handle), os.stat(place)):
                return handle, place
        except FileNotFoundError:
            pass
        except BlockingIOError:
            if not said:
                say(console, f"{folder}: another process writes there; waiting for it to end.", "yellow")
                said = True
            time.sleep(POLL_S)
        except OSError:
            os.close(handle)
            raise
        os.close(handle)


def _try_lock(handle: int) -> None:
    """Lock what was opened; a BlockingIOError says that somebody else holds it, another OSError that it cannot be."""
    if fcntl is not None:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    assert msvcrt is not None
    try:
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # pyrefly: ignore[missing-attribute]
    except PermissionError as error:
        raise BlockingIOError from error


def _unlock(handle: int, place: Path) -> None:
    """Let go of what `_locked` gave."""
    if msvcrt is not None:
        msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)  # pyrefly: ignore[missing-attribute]
    os.close(handle)
    if fcntl is None:
        try:
            place.unlink(missing_ok=True)
        except OSError:
            pass  # whoever waits for it has it open, and removes it
