"""Workarounds for faults of the host, each with what it works around and what would end it.

Everything here is about nerfstudio 1.1.5 and what it is installed with; no other module patches the host.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType


def allow_numpy_scalars_in_checkpoints() -> None:
    """Let `torch.load` read the checkpoints that nerfstudio writes.

    They hold NumPy scalars (learning rates of schedulers), which torch >= 2.6 refuses by default
    (nerfstudio issue 3561). Naming the three types keeps safe loading on. NumPy 2 calls the module
    `numpy._core`; files written under either name are to be read under both.
    Ends with: a nerfstudio that saves Python floats.
    """
    if tuple(map(int, torch.__version__.split(".")[:2])) < (2, 6):
        return  # loads everything by default, and knows no second names for what is allowed
    scalar = np.float64(0).__reduce__()[0]
    allowed = [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype]
    allowed += [type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64)]
    torch.serialization.add_safe_globals(allowed)


@contextmanager
def lpips_not_built() -> Iterator[None]:
    """Keep nerfacto from building LPIPS, which downloads AlexNet's weights at start and enters the state dict.

    nerfacto's `populate_modules` imports the class at that moment, so the name in torchmetrics is swapped for
    the duration. Ends with: a nerfstudio that builds its metrics at first use.
    """
    import torchmetrics.image.lpip as module  # a second and more; nerfstudio's commands start without it

    original = module.LearnedPerceptualImagePatchSimilarity
    module.LearnedPerceptualImagePatchSimilarity = lambda **_: None
    try:
        yield
    finally:
        module.LearnedPerceptualImagePatchSimilarity = original


def without_undefined_ray(cameras: Cameras) -> Cameras:
    """Move principal points that lie on a pixel's centre by a thousandth of a pixel, of fisheye cameras.

    nerfstudio's ray of that pixel is 0/0 (its viewer's fisheye preview has one whenever the picture's sides are odd).
    Ends with: a nerfstudio whose `generate_rays` knows the limit.
    """
    on_centre = (cameras.camera_type == CameraType.FISHEYE.value) & (cameras.cx % 1 == 0.5) & (cameras.cy % 1 == 0.5)
    if not on_centre.any():
        return cameras
    moved = copy(cameras)
    moved.cx = cameras.cx + 1e-3 * on_centre
    return moved
