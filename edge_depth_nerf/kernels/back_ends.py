"""Which form of a function serves some tensors: Numba's on the CPU, Triton's on a GPU if it gives torch's numbers.

Triton may be missing, find no C compiler, not know the GPU, or compile something that computes something else. So the
first use of a kernel on a device compares it with its formula in torch.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from edge_depth_nerf.kernels.triton_launch import untraced

Example = dict[str, Any]
"""Arguments of a function by their names; tensors that require a gradient get one."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Enable gradients, taken in this thread, and stop tracing, to try out kernels.

    The first caller may be a rendering. It has no gradients, which a trial needs. Otherwise one thread of torch would
    compile the gradients of all kernels that are tried out side by side.
    """
    with untraced(), torch.inference_mode(False), torch.enable_grad(), torch.autograd.set_multithreading_enabled(False):
        yield


def _nothing() -> None:
    """Nobody counts."""


class KernelDiffersError(Exception):
    """Says how far a kernel is from its formula."""


@dataclass(frozen=True, eq=False)
class GpuForm:
    """A kernel of Triton beside its formula, and what both are tried out on."""

    name: str
    """As a warning calls it."""
    load: Callable[[], Callable[..., Any]]
    """Gives the kernel's function. It imports Triton, which takes half a second."""
    formula: Callable[..., Any]
    """The same in torch, of float64."""
    examples: Callable[[torch.device], Sequence[Example]]
    """Makes arguments of a few hundred numbers, of no round sizes."""
    tolerance: float
    """Greatest difference of results and of gradients, relative to the largest value."""
    most_columns: int | None = None
    """So many columns of a matrix it serves; None: any number."""
    in_a_step: Callable[[torch.device], Sequence[Example]] = lambda _: ()
    """Makes arguments as a training step of the full preset has them, of few rays: Triton compiles a kernel once more
    for other block sizes, types, and numbers that 16 divides."""

    def every_example(self, device: torch.device) -> list[Example]:
        """Make all arguments that it is tried out on."""
        return [*self.examples(device), *self.in_a_step(device)]

    def try_out(self, device: torch.device, passed: Callable[[], None] = _nothing) -> Callable[..., Any]:
        """Give the kernel's function if its results and gradients on a GPU are those of the formula.

        `passed` is called after each example.

        Raises:
            KernelDiffersError: they are not.
            Exception: whatever keeps it from working.
        """
        kernel = self.load()
        for example in self.every_example(device):
            expected = _outcome(self.formula, example, torch.float64)
            for (what, found), (_, exact) in zip(_twice(kernel, example), expected, strict=True):
                self._compare(what, found, exact)
            passed()
        return kernel

    def _compare(self, what: str, found: Tensor | None, exact: Tensor | None) -> None:
        if found is None or exact is None or found.shape != exact.shape:
            raise KernelDiffersError(f"its {what} is missing or has another shape")
        allowed = max(self.tolerance, torch.finfo(found.dtype).eps)
        off, largest = (found.double() - exact).abs().max(), exact.abs().max()
        # so that what is no number fails; one number for the host to wait for
        if not bool(off <= allowed * largest):
            share = float(off / largest)
            raise KernelDiffersError(f"its {what} is off by {share:.1e} of the largest value, allowed is {allowed:.0e}")


def _twice(kernel: Callable[..., Any], example: Example) -> list[tuple[str, Tensor | None]]:
    """Give a kernel's outcome, at a second attempt if need be: Triton's compiler may stumble over other threads."""
    try:
        return _outcome(kernel, example)
    except Exception:  # the second one tells
        return _outcome(kernel, example)


def _outcome(
    function: Callable[..., Any], example: Example, dtype: torch.dtype | None = None
) -> list[tuple[str, Tensor | None]]:
    """Give what a function returns, and the gradients to its arguments, each with a word for it.

    Args:
        function: takes the example's arguments.
        example: is not changed.
        dtype: that of tensors of floats; None: their own.
    """
    leaves: list[Tensor] = []

    def given(value: Any) -> Any:
        if isinstance(value, (list, tuple)):
            return type(value)(map(given, value))
        if not isinstance(value, Tensor) or not value.is_floating_point():
            return value
        # a view stays a view
        made = value if dtype is None else value.to(dtype)
        if value.requires_grad:
            made = made.detach().requires_grad_()
            leaves.append(made)
        return made

    found = function(**{name: given(value) for name, value in example.items()})
    results = found if isinstance(found, tuple) else (found,)
    if leaves:
        # factors that differ, as errors may cancel out in a sum, and have no more digits than half precision
        every = torch.cat([each.flatten().double() for each in results])
        (every * (torch.arange(len(every), device=every.device) % 7 - 2.5)).sum().backward()
    return [*(("result", each.detach()) for each in results), *(("gradient", leaf.grad) for leaf in leaves)]


_tried: dict[tuple[GpuForm, torch.device], Callable[..., Any] | None] = {}
"""What trials have found."""
_locks: dict[tuple[GpuForm, torch.device], threading.Lock] = {}
"""A thread that needs a kernel which another one is trying out waits for it."""


def tried_out(form: GpuForm, device: torch.device, passed: Callable[[], None] = _nothing) -> Callable[..., Any] | None:
    """Give a kernel's function if it works on a device; else None.

    The first call runs the kernel, and warns where it does not work.

    Args:
        form: the kernel.
        device: of a GPU, with its number.
        passed: is called after each example of a trial.

    Raises:
        RuntimeError: a CUDA graph is recorded, which a trial would spoil.
    """
    key = form, device
    if key not in _tried:
        if torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing():
            raise RuntimeError(f"the kernel of the {form.name} was not tried out before a CUDA graph is recorded")
        # one lock for all threads, as `setdefault` is one step
        with _locks.setdefault(key, threading.Lock()):
            if key not in _tried:
                with undisturbed():
                    _tried[key] = _try_out(form, device, passed)
    return _tried[key]


def _try_out(form: GpuForm, device: torch.device, passed: Callable[[], None]) -> Callable[..., Any] | None:
    try:
        return form.try_out(device, passed)
    except KernelDiffersError as error:
        failure = str(error)
    except Exception as error:  # whatever keeps Triton from working here
        failure = f"{type(error).__name__}: {error}"
    warnings.warn(
        f"The fused {form.name} does not work on {device} ({failure}); torch's form takes its place, with the same "
        "results but slower (`edge-depth-nerf doctor` says more).",
        stacklevel=2,
    )
    return None


@dataclass(frozen=True, eq=False)
class Function:
    """A function that has compiled forms, which give what torch gives in fewer passes."""

    on_cpu: Callable[[], Callable[..., Any]] | None = None
    """Gives the form of the CPU. It imports Numba, which takes half a second. None: torch serves the CPU as fast."""
    on_gpu: GpuForm | None = None
    """None: torch serves a GPU as fast."""
    follows: bool = True
    """Whether compiled forms have gradients."""

    def on(self, device: torch.device) -> Callable[..., Any] | None:
        """Give the form for a device; None where torch's has to serve."""
        if device.type == "cpu":
            return None if self.on_cpu is None else self.on_cpu()
        if device.type != "cuda" or self.on_gpu is None:
            return None
        return tried_out(self.on_gpu, device)

    def compiled_for(self, *tensors: Tensor) -> Callable[..., Any] | None:
        """Give the form for float32 tensors of one device; None where torch's has to serve."""
        device = tensors[0].device
        if any(each.device.type != device.type or each.dtype != torch.float32 for each in tensors):
            return None
        if not self.follows and torch.is_grad_enabled() and any(each.requires_grad for each in tensors):
            return None
        most = None if self.on_gpu is None or device.type == "cpu" else self.on_gpu.most_columns
        if most is not None and any(each.shape[1] > most for each in tensors):
            return None
        return self.on(device)


def made_by_autocast(device: torch.device) -> torch.dtype:
    """Give the type that autocast makes of what enters a product on a GPU; float32 without it, and on the CPU.

    What is kept in that type to begin with is neither copied nor cast, and the products are the same.
    """
    if device.type == "cuda" and torch.is_autocast_enabled("cuda"):
        return torch.get_autocast_dtype("cuda")
    return torch.float32
