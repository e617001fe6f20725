"""Ctrl-C, kept back while what runs would lose it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def ctrl_c_put_off() -> Iterator[None]:
    """Answer Ctrl-C after what is done here: for compiled code that swallows exceptions.

    In other threads than the main one, which no signal reaches, nothing is done.

    Raises:
        KeyboardInterrupt: it was asked for meanwhile; or whatever the handler before raises.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    asked = False

    def remember(*_: object) -> None:
        nonlocal asked
        asked = True

    signal.signal(signal.SIGINT, remember)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        signal.raise_signal(signal.SIGINT)
