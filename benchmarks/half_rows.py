"""What rows of the hash table in bfloat16 would save: encoding, and Adam that has to write them, beside float32.

    python benchmarks/half_rows.py [--rounds 15]

The points are those of a step of `edge-depth-nerf-lite`: 1,024 rays with 24 samples each, and 17,408 single points. A
row has two features, which are one word in bfloat16. Adam keeps the table in float32 and writes each new number in
bfloat16, too. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from edge_depth_nerf.kernels.hash_grid_numba import (
    BLOCK,
    ONE,
    TILE,
    _by_column,
    _call_corners,
    _find_corners,
    encode_points,
)
from edge_depth_nerf.kernels.table_adam_numba import _adam
from edge_depth_nerf.kernels.threads import share_out, stretches

LEVELS, ROWS, RAYS, SAMPLES, SINGLE = 12, 1 << 19, 1024, 24, 1024 + 16384
HIGH, HALF_WORD = np.uint32(0xFFFF0000), np.uint32(16)


@intrinsic
@no_type_check
def _as_float(_, word):
    return types.float32(types.uint32), lambda context, build, signature, given: build.bitcast(given[0], ir.FloatType())


@intrinsic
@no_type_check
def _as_word(_, number):
    return types.uint32(types.float32), lambda context, build, signature, given: build.bitcast(given[0], ir.IntType(32))


@njit(nogil=True)
@no_type_check
def _between(a, b, c, d, e, f, g, h, x, y, z):
    """Interpolate between the corners of a cell, in the order of `encode_points`."""
    low = (d * x + c * (ONE - x)) * y + (b * x + a * (ONE - x)) * (ONE - y)
    high = (h * x + g * (ONE - x)) * y + (f * x + e * (ONE - x)) * (ONE - y)
    return high * z + low * (ONE - z)


@njit(nogil=True)
@no_type_check
def _encode_words(axes, table, scalings, encoded, first_point, last_point):
    """Encode points with rows of one word; as `encode_points`."""
    rows = len(table) // len(scalings)
    begins, offsets = np.empty(8 * TILE, np.uint32), np.empty(3 * TILE, np.float32)
    for block in range(first_point, last_point, BLOCK):
        block_end = min(block + BLOCK, last_point)
        for level in range(len(scalings)):
            grid = table[level * rows : (level + 1) * rows]
            for first in range(block, block_end, TILE):
                count = min(TILE, block_end - first)
                x_from, y_from, z_from = axes[0, first:], axes[1, first:], axes[2, first:]
                _find_corners(x_from, y_from, z_from, count, scalings[level], rows, (0,), begins, offsets)
                _call_corners(grid, begins, count)
                for j in range(count):
                    x, y, z = offsets[j], offsets[TILE + j], offsets[2 * TILE + j]
                    a, b, c, d, e, f, g, h = (
                        grid[begins[j]], grid[begins[TILE + j]], grid[begins[2 * TILE + j]], grid[begins[3 * TILE + j]],
                        grid[begins[4 * TILE + j]], grid[begins[5 * TILE + j]], grid[begins[6 * TILE + j]],
                        grid[begins[7 * TILE + j]],
                    )  # fmt: skip
                    encoded[first + j, 2 * level] = _between(
                        _as_float(np.uint32(a << HALF_WORD)), _as_float(np.uint32(b << HALF_WORD)),
                        _as_float(np.uint32(c << HALF_WORD)), _as_float(np.uint32(d << HALF_WORD)),
                        _as_float(np.uint32(e << HALF_WORD)), _as_float(np.uint32(f << HALF_WORD)),
                        _as_float(np.uint32(g << HALF_WORD)), _as_float(np.uint32(h << HALF_WORD)), x, y, z,
                    )  # fmt: skip
                    encoded[first + j, 2 * level + 1] = _between(
                        _as_float(a & HIGH), _as_float(b & HIGH), _as_float(c & HIGH), _as_float(d & HIGH),
                        _as_float(e & HIGH), _as_float(f & HIGH), _as_float(g & HIGH), _as_float(h & HIGH), x, y, z,
                    )  # fmt: skip


@njit(nogil=True, error_model="numpy")
@no_type_check
def _adam_and_half(values, gradient, mean, square, beta1, beta2, rate, spread, eps, half):
    """Do Adam's step as `_adam`, and write the new numbers in bfloat16, rounded to the nearest."""
    fresh, fresh_square = np.float32(1 - beta1), np.float32(1 - beta2)
    kept_square, rate, spread, eps = np.float32(beta2), np.float32(rate), np.float32(spread), np.float32(eps)
    for i in range(len(values)):
        g = gradient[i]
        m = mean[i] + fresh * (g - mean[i])
        v = kept_square * square[i] + fresh_square * g * g
        mean[i] = m
        square[i] = v
        value = values[i] - rate * (m / (np.sqrt(v) / spread + eps))
        values[i] = value
        gradient[i] = np.float32(0)
        word = _as_word(value)
        half[i] = np.uint16((word + np.uint32(0x7FFF) + ((word >> HALF_WORD) & np.uint32(1))) >> HALF_WORD)


def median_ms(call: Callable[[], object], rounds: int) -> float:
    call()
    took = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        took.append((time.perf_counter() - start) * 1e3)
    return statistics.median(took)


def points() -> torch.Tensor:
    """Positions in 0..1, ray by ray, then single ones."""
    origins = 0.1 * torch.rand(RAYS, 1, 3) + 0.45
    directions = torch.nn.functional.normalize(torch.randn(RAYS, 1, 3), dim=-1)
    along = 0.4 * torch.rand(RAYS, SAMPLES, 1).sort(dim=1).values
    single = 0.5 * torch.rand(SINGLE, 3) + 0.25
    return torch.cat([(origins + along * directions).reshape(-1, 3), single]).clamp(0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    rounds: int = parser.parse_args().rounds
    torch.manual_seed(0)
    at, table = points(), torch.rand(LEVELS * ROWS, 2) - 0.5
    scalings = torch.tensor([16 * 256 ** (level / (LEVELS - 1)) for level in range(LEVELS)]).floor().numpy()
    words = table.to(torch.bfloat16).view(torch.int16).numpy().view(np.uint32).reshape(-1)
    axes, flat = _by_column(at), table.view(-1).numpy()
    encoded = [np.empty((len(at), 2 * LEVELS), np.float32) for _ in range(2)]
    values, means, squares = (np.random.default_rng(0).random((LEVELS, 2 * ROWS), np.float32) for _ in range(3))
    half = np.empty(values.shape, np.uint16)

    for threads in sorted({1, len(os.sched_getaffinity(0))}):

        def whole(threads: int = threads) -> None:
            arrays = axes, flat, (0, 0), scalings, encoded[0]
            share_out(lambda part: encode_points(*arrays, *part), stretches(len(at), threads))

        def halved(threads: int = threads) -> None:
            arrays = axes, words, scalings, encoded[1]
            share_out(lambda part: _encode_words(*arrays, *part), stretches(len(at), threads))

        def adam(kernel: Any, more: tuple[np.ndarray, ...], threads: int = threads) -> None:
            def work(part: tuple[int, int]) -> None:
                gradient = np.ones(2 * ROWS, np.float32)
                for level in range(*part):
                    kernel(
                        *(values[level], gradient, means[level], squares[level], 0.9, 0.99, 0.01, 1.0, 1e-15),
                        *(each[level] for each in more),
                    )

            share_out(work, stretches(LEVELS, threads))

        print(
            f"{threads} threads: encode {median_ms(whole, rounds):.1f} ms,",
            f"in bfloat16 {median_ms(halved, rounds):.1f};",
            f"Adam {median_ms(lambda: adam(_adam, ()), rounds):.1f} ms,",
            f"writing bfloat16, too, {median_ms(lambda: adam(_adam_and_half, (half,)), rounds):.1f}",
        )
    print(f"largest difference of what is encoded: {np.abs(encoded[0] - encoded[1]).max():.2g}")


if __name__ == "__main__":
    main()
