"""Numbers that several rooms count by."""

from __future__ import annotations

import numpy as np


def spread_over(count: int, most: int) -> list[int]:
    """Choose at most `most` of `count` numbers from 0 on, all different, evenly spread, with the first and the last."""
    return np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()
