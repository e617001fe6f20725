"""What all functions compiled by Numba share.

Importing this module imports Numba. The first calls ever on a machine compile (a second or two each module); the
result is kept beside the module, or in the user's cache if that folder cannot be written.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numba import njit
from torch import Tensor

_folders: set[Path] = set()
"""Where Numba keeps what it compiled."""


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Compile a function without Python's lock; on disk if there is a folder for it, else once in each process.

    Put `no_type_check` below it: the tests' type checker would wrap what Numba has to read. `options` are njit's.
    """

    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        try:
            kernel = njit(cache=True, nogil=True, **options)(function)
            folder = Path(str(kernel.stats.cache_path))
            if folder not in _folders:
                _folders.add(folder)
                _forget_older(folder, Path(function.__code__.co_filename).parent)
            return kernel
        except RuntimeError:  # Numba found no folder that can be written
            return njit(nogil=True, **options)(function)

    return decorate


def _forget_older(compiled_in: Path, sources: Path) -> None:
    """Forget what was compiled before the newest change of a folder of sources.

    Numba compiles a function again if its own module changed, not if that of a function did which it calls.
    """
    changed = [source.stat().st_mtime for source in sources.glob("*.py")]
    # nothing is newer than a time that is still to come
    newest = max((at for at in changed if at <= time.time()), default=0.0)
    for index in compiled_in.glob("*.nbi"):
        # another process may do the same
        with suppress(FileNotFoundError):
            if index.stat().st_mtime < newest:
                index.unlink()


def flat(values: Tensor) -> np.ndarray:
    """Give a tensor's numbers in a row, for a kernel; a contiguous tensor is not copied."""
    return values.detach().contiguous().view(-1).numpy()


def flat_rows(matrix: Float[Tensor, "rows columns"]) -> tuple[np.ndarray, int]:
    """Give a matrix as a flat array, and how many numbers lie from one row's begin to the next one's.

    Where samples begin is a view of all edges, which need not be copied.
    """
    matrix = matrix.detach()
    rows, columns = matrix.shape
    if matrix.numel() == 0:
        return np.empty(0, np.float32), columns
    if columns > 1 and matrix.stride(1) != 1:
        matrix = matrix.contiguous()
    stride = matrix.stride(0)
    return matrix.as_strided(((rows - 1) * stride + columns,), (1,)).numpy(), stride


def all_on_disk() -> bool:
    """Say whether the folder of each imported module of kernels holds compiled code."""
    return bool(_folders) and all(any(folder.glob("*.nbi")) for folder in _folders)
