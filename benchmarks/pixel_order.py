"""Whether training pixels should come in another order than a random one.

    python benchmarks/pixel_order.py SCENE... [--steps 1000] [--json FILE] [--page FILE]

- In blocks: the pixels of a block of a picture follow each other, and share rows of the hash table; the blocks come in
  random order.
- Spread evenly: as many pixels as one likes that follow each other are spread evenly over all pictures and over each.

First, on the first scene, steps with each order take turns; then, for each scene, a training with each order. PSNR and
AbsRel are of 3,000 random pixels of each held-out view. Run it on an idle machine, with drives that no results table is
made of.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import ablate
import numpy as np
import speed
from numpy.typing import NDArray
from step_parts import Clock

RESULTS = Path(__file__).with_name("pixel_order.json")
PART = "pixel order"
STEPS_IN_A_TURN, ROUNDS = 20, 8
PARTS = {"whole": "a step", "hash grid": "… hash grid", "optimisers": "… gradient of its table, and Adam"}
GOLDEN_RATIO = (1 + math.sqrt(5)) / 2


def in_blocks(records: NDArray, side_px: int) -> NDArray:
    """Order the pixels of a table by blocks of their pictures, and the blocks at random."""
    blocks = np.stack([records["picture"], records["row"] // side_px, records["column"] // side_px], axis=1)
    _, block = np.unique(blocks, axis=0, return_inverse=True)
    drawn = np.random.default_rng(0).permutation(block.max() + 1)[block.reshape(-1)]
    return records[np.lexsort((records["column"], records["row"], drawn))]


def spread_evenly(records: NDArray) -> NDArray:
    """Order the pixels so that those that follow each other are far apart.

    They are put into one line, picture by picture and within it by the Z-order of row and column; then every n-th is
    taken, with n the line's length over the golden ratio.
    """
    nearby = _every_other_bit(records["row"]) << np.uint64(1) | _every_other_bit(records["column"])
    line = records[np.lexsort((nearby, records["picture"]))]
    stride = int(len(line) / GOLDEN_RATIO)
    while math.gcd(stride, len(line)) > 1:
        stride += 1
    return line[np.arange(len(line), dtype=np.int64) * stride % len(line)]


def _every_other_bit(numbers: NDArray) -> NDArray[np.uint64]:
    """Put a 0 between the bits of numbers below 2^16."""
    spread = numbers.astype(np.uint64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
    return spread


ORDERS: dict[str, Callable[[NDArray], NDArray]] = {
    "random": lambda records: records,
    **{f"blocks of {side} × {side} px": partial(in_blocks, side_px=side) for side in (2, 4, 8)},
    "spread evenly": spread_evenly,
}
"""The first is the one that a training has."""


def put_in_order(order: str, pipeline: Any) -> None:
    """Let a training read its pixels in an order."""
    table = pipeline.datamanager.train_pixel_sampler.table
    table._records = ORDERS[order](np.asarray(table._records))


def timed(scene: Path) -> dict[str, dict[str, float]]:
    """Milliseconds of steps and of their parts, by the order of pixels; median over turns."""
    config = speed.configurations("lite", scene, ["ours"])["ours"]
    spread = [int((k + 0.5) * config.max_num_iterations / STEPS_IN_A_TURN) for k in range(STEPS_IN_A_TURN)]
    found: dict[str, dict[str, list[float]]] = {order: defaultdict(list) for order in ORDERS}
    with tempfile.TemporaryDirectory() as folder:
        runner = speed.Runner(config, Path(folder))
        table: Any = runner.trainer.pipeline.datamanager.train_pixel_sampler.table
        as_written = np.asarray(table._records)
        records = {order: arrange(as_written) for order, arrange in ORDERS.items()}
        clock = Clock()
        clock.measure_step(runner.trainer)
        runner.iterate(spread)
        for number in range(ROUNDS):
            for order in ORDERS if number % 2 else reversed(ORDERS):
                table._records = records[order]
                clock.seconds.clear()
                found[order]["whole"].append(runner.iterate(spread))
                for part in ("hash grid", "optimisers"):
                    found[order][part].append(clock.seconds[part])
    ms = 1e3 / STEPS_IN_A_TURN
    return {order: {name: statistics.median(each) * ms for name, each in of.items()} for order, of in found.items()}


def table(results: dict[str, Any]) -> str:
    """PSNR and AbsRel of the scenes, and the times of steps, by the order of pixels; as Markdown."""
    scenes, ms = results["scenes"], results["ms"]
    heads = [*(f"{name}: PSNR, AbsRel" for name in scenes), *(f"{title}, ms" for title in PARTS.values())]
    lines = ["| | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for order in ORDERS:
        cells = [f"{found[order]['psnr']:.2f}, {found[order]['abs_rel']:.4f}" for found in scenes.values()]
        cells += [f"{ms[order][part]:.1f}" for part in PARTS]
        lines.append(f"| {order} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def measure(scene: Path, results: dict[str, Any], keep: Callable[[], None]) -> None:
    steps, found = results["steps"], ablate.of_scene(results, scene)
    if "ms" not in results:
        results["ms"] = timed(scene)
        keep()
    for order in ORDERS:
        if order not in found:
            figures = ablate.train(scene, ablate.falling_over(steps), steps, 0, partial(put_in_order, order))
            found[order] = {"psnr": figures["truth_psnr"], "abs_rel": figures["truth_abs_rel"]}
            keep()


def main() -> None:
    ablate.scene_by_scene(__doc__, RESULTS, PART, table, measure)


if __name__ == "__main__":
    main()
