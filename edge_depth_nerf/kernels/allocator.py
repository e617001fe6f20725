"""Makes the C library keep the memory of large tensors on the CPU for the next ones.

By default glibc takes memory for each tensor above 32 MB from the system and gives it back when the tensor dies, many
times a step, and the system clears every page each time.
"""

from __future__ import annotations

import ctypes
import platform

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""glibc's numbers of the settings."""
KEPT_BYTES = 1 << 30
"""Up to this size freed memory is kept for the next tensor."""


def keep_freed_memory() -> bool:
    """Let freed memory of this process be used again instead of given back; what lies idle now is given back first.

    Returns:
        Whether the allocator does: glibc's alone has the settings.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    libc.malloc_trim(0)
    # the other way round, a limit that is refused would leave the system asked for every tensor above 128 kB
    return bool(libc.mallopt(M_MMAP_THRESHOLD, KEPT_BYTES) and libc.mallopt(M_TRIM_THRESHOLD, KEPT_BYTES))
