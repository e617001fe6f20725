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
except ImportError:  # Windows has no such locks
    fcntl = None

POLL_S = 0.2
_held: set[tuple[Path, int]] = set()
"""Folders that a thread of this process holds."""


@contextmanager
def only_writer(folder: Path, console: Console) -> Iterator[None]:
    """Hold a folder while it is written to, or wait until nobody else does.

    The folder itself is locked, so nothing is left behind, and the system lets go of it when a process is killed. One
    that is not there is made, and taken away again if nothing was written to it. A thread may hold a folder twice.
    Where there are no such locks (some network disks, Windows) nothing is waited for.
    """
    key = (folder.resolve(), threading.get_ident())
    if fcntl is None or key in _held:
        yield
        return
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        handle = _locked(folder, console)
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
        os.close(handle)


def _locked(folder: Path, console: Console) -> int:
    """Lock a folder; give what is to be closed."""
    assert fcntl is not None
    said = False
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # whoever held it may have taken an empty folder away
            if os.path.samestat(os.fstat(handle), os.stat(folder)):
                return handle
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
