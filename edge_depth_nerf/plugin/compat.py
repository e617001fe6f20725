"""Workarounds for faults of the host: what each works around, the issue that reports it, and what ends it.

Everything here is about nerfstudio 1.1.5 and what it is installed with; no other module changes anything of the host's.
(Subclasses that do more than the host's classes, such as the trainer that writes checkpoints whole, stand in modules of
their own.) The weekly workflow runs the tests against nerfstudio's newest: a workaround that has ended fails there.
"""

from __future__ import annotations

import inspect
import os
import warnings
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfstudio.cameras.cameras import Cameras
    from nerfstudio.engine.trainer import Trainer
    from nerfstudio.viewer.viewer import Viewer


def allow_numpy_scalars_in_checkpoints() -> None:
    """Let `torch.load` read the checkpoints that nerfstudio writes, with safe loading left on.

    They hold NumPy scalars (learning rates of schedulers), which torch >= 2.6 refuses by default. Naming the types that
    they consist of keeps safe loading on; nerfstudio's own proposal (pull request 3702) switches it off. NumPy 2 calls
    the module `numpy._core`; files written under either name are to be read under both.

    Works around: https://github.com/nerfstudio-project/nerfstudio/issues/3683.
    Ends with: a nerfstudio that saves Python floats.
    """
    import numpy as np
    import torch

    scalar = np.float64(0).__reduce__()[0]
    allowed: list[Any] = [(scalar, "numpy.core.multiarray.scalar"), (scalar, "numpy._core.multiarray.scalar"), np.dtype]
    allowed += [type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64)]
    torch.serialization.add_safe_globals(allowed)


@contextmanager
def lpips_not_built() -> Iterator[None]:
    """Keep nerfacto from building LPIPS, which downloads AlexNet's weights at start and enters the state dict.

    nerfacto's `populate_modules` imports the class when it is called, so the name in torchmetrics is swapped for the
    duration.

    Works around: https://github.com/nerfstudio-project/nerfstudio/issues/2415.
    Ends with: a nerfstudio that builds its metrics at first use.
    """
    import torchmetrics.image.lpip as module  # a second and more; nerfstudio's commands start without it

    original = module.LearnedPerceptualImagePatchSimilarity
    module.LearnedPerceptualImagePatchSimilarity = lambda **_: None  # pyrefly: ignore[bad-assignment]
    try:
        yield
    finally:
        module.LearnedPerceptualImagePatchSimilarity = original


def without_undefined_ray(cameras: Cameras) -> Cameras:
    """Move principal points that lie on a pixel's centre by a thousandth of a pixel, of fisheye cameras.

    nerfstudio's ray of that pixel is 0/0 (its viewer's fisheye preview has one whenever the picture's sides are odd).

    No issue reports it; this is what brought it.

    Works around: https://github.com/nerfstudio-project/nerfstudio/pull/305.
    Ends with: a nerfstudio whose `generate_rays` knows the limit.
    """
    from nerfstudio.cameras.cameras import CameraType

    on_centre = (cameras.camera_type == CameraType.FISHEYE.value) & (cameras.cx % 1 == 0.5) & (cameras.cy % 1 == 0.5)
    if not on_centre.any():
        return cameras
    moved = copy(cameras)
    moved.cx = cameras.cx + 1e-3 * on_centre
    return moved


@contextmanager
def quiet_host() -> Iterator[None]:
    """Keep back what nerfstudio says at its import and at each split that its parser reads.

    Its imports warn of names that torch gives up, as in the log of the issue; its parser prints to a console of its
    own, whatever the level of logging.

    Works around: https://github.com/nerfstudio-project/nerfstudio/issues/3528.
    Ends with: a nerfstudio that uses torch.amp, and logs through the logging module.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        from nerfstudio.utils.rich_utils import CONSOLE

        before, CONSOLE.quiet = CONSOLE.quiet, True
        try:
            yield
        finally:
            CONSOLE.quiet = before


def ignore_deprecations_of_host() -> None:
    """Keep back what torch warns nerfstudio's developers of, from here on: ten lines that hide what concerns users.

    What the host's imports warn of comes before a plugin is asked for anything, so it stays.

    Works around: https://github.com/nerfstudio-project/nerfstudio/issues/3528.
    Ends with: a nerfstudio that uses torch.amp, and indexes with tuples.
    """
    warnings.filterwarnings("ignore", category=FutureWarning, module=r"nerfstudio\.")
    warnings.filterwarnings("ignore", message="Using a non-tuple sequence", category=UserWarning, module="nerfstudio")


def know_modules_of_importer() -> None:
    """Tell Python's `inspect` which modules the frames of Python's importer are of.

    nerfstudio asks for its callers once for each external method while it is imported. For each of these frames, whose
    files do not exist, `inspect` searches all modules in vain, which takes a fifth of the start of a command.

    Works around: https://github.com/python/cpython/issues/92041.
    Ends with: a Python that finds the module of a frame by its name.
    """
    for name in ("importlib._bootstrap", "importlib._bootstrap_external"):
        inspect.modulesbyfile.setdefault(os.path.normcase(os.path.abspath(f"<frozen {name}>")), name)


def outlive_leaving_browsers(viewer: Viewer) -> None:
    """Let what asks for the renderer of a browser that has left get one that does nothing, instead of a KeyError.

    A training asks at its steps, and would end. A camera's movement asks within viser's `atomic`, which would keep its
    lock: no browser would get anything more.

    No issue reports it; this is what brought it.

    Works around: https://github.com/nerfstudio-project/nerfstudio/pull/2519.
    Ends with: a nerfstudio that looks whether a browser is still there.
    """
    nothing: Any = SimpleNamespace(action=lambda _: None)
    viewer.render_statemachines = defaultdict(lambda: nothing, viewer.render_statemachines)


def total_steps(trainer: Trainer) -> int:
    """Count all steps of a training, also those before it was resumed; `max_num_iterations` are those to come.

    Works around: https://github.com/nerfstudio-project/nerfstudio/issues/3096.
    Ends with: a nerfstudio that has its pull request 3526, where `max_num_iterations` are all steps.
    """
    return trainer._start_step + trainer.config.max_num_iterations


def join_lines_of_option_help() -> None:
    """Let tyro wrap an option's help by itself: docstrings keep the line breaks and indentation of the source.

    tyro 1.0 joins such lines only where they are not indented, which those of a class always are; it prints words left
    alone on a line. For our own command; nerfstudio's help is unchanged.

    The issue is of the same code, which joins too much of a class's docstring and too little of a field's.

    Works around: https://github.com/brentyi/tyro/issues/429.
    Ends with: a tyro that cleans docstrings before it joins their lines.
    """
    from tyro import _docstrings

    parse = getattr(_docstrings, "parse_docstring_from_object", None)
    if parse is None or getattr(parse, "__module__", None) == __name__:
        return

    def joined(described: object) -> dict[str, str]:
        return {name: " ".join(text.split()) for name, text in parse(described).items()}  # pyrefly: ignore

    _docstrings.parse_docstring_from_object = joined  # pyrefly: ignore[bad-assignment]
