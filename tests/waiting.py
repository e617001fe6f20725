"""Waiting for what other threads and processes do."""

import time
from collections.abc import Callable
from typing import Any


def until(happened: Callable[[], Any], seconds: float = 300.0, wait: Callable[[float], None] = time.sleep) -> Any:
    """What `happened` gives as soon as that is something."""
    deadline = time.monotonic() + seconds
    while not (found := happened()):
        assert time.monotonic() < deadline
        wait(0.1)
    return found
