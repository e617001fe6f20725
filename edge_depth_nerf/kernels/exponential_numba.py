"""exp of float32 that LLVM makes vector instructions of; Numba's own calls the system's library number by number.

Importing this module imports Numba.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from edge_depth_nerf.kernels.compiled import compiled

HALF, ONE = np.float32(0.5), np.float32(1)
PER_OCTAVE = np.float32(1 / np.log(2))
OCTAVE, OCTAVES_REST = np.float32(0.693359375), np.float32(np.log(2) - 0.693359375)
"""log(2) as a sum, whose first term is exact in a few bits: the product with a whole number is, too."""
SMALLEST, LARGEST = np.float32(-87.3), np.float32(88.3)
INFINITE, NOTHING = np.float32(np.inf), np.float32(0)
C7, C6, C5, C4, C3, C2 = (np.float32(1 / each) for each in (5040, 720, 120, 24, 6, 2))
"""Taylor's series, whose rest is below 1e-8 within half an octave."""
BIAS, PLACE = np.int32(127), np.int32(23)
"""Of float32's exponent."""


@compiled()
@no_type_check
def exp(x):
    """Give e to the power of x, float32, to 1.5 units in the last place.

    0 below -87.3, where float32 has no full precision any more, and infinite above 88.3; NaN stays NaN.
    """
    near = min(max(x, SMALLEST), LARGEST)
    octaves = np.floor(near * PER_OCTAVE + HALF)
    rest = near - octaves * OCTAVE - octaves * OCTAVES_REST
    series = (((((C7 * rest + C6) * rest + C5) * rest + C4) * rest + C3) * rest + C2) * rest * rest + rest + ONE
    scale = np.int32((np.int32(octaves) + BIAS) << PLACE).view(np.float32)
    value = series * scale
    value = INFINITE if x > LARGEST else value
    value = NOTHING if x < SMALLEST else value
    return value if x == x else x
