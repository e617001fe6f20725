"""Which of several forms of a kernel runs: the one that the environment names, else on a GPU the fastest."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Hashable, Sequence
from dataclasses import fields
from typing import Any, TypeVar

from edge_depth_nerf.kernels.back_ends import undisturbed

Form = TypeVar("Form")

_fastest: dict[tuple[Hashable, ...], Any] = {}
"""What was measured before, by size."""


def form_for(
    variable: str,
    forms: Sequence[Form],
    size: tuple[Hashable, ...],
    run: Callable[[Form], Any],
    on_gpu: bool,
    seconds: Callable[[Callable[[], Any]], float] | None = None,
) -> Form:
    """Give the form of a kernel to run.

    Args:
        variable: environment variable that names a form, as `field=value,…`; what it does not mention is as by
            default. Where it is set nothing is measured.
        forms: those to measure, dataclasses of plain numbers; the first one runs where nothing is measured.
        size: of the work, with the device; work of the same size is measured once.
        run: does the work in a form.
        on_gpu: whether to measure.
        seconds: measures a call, in any unit; by default Triton's clock on the device.

    Raises:
        ValueError: the variable names a field that there is not, or no number.

    """
    given = os.environ.get(variable)
    if given:
        return _named(variable, given, type(forms[0]))
    if not on_gpu:
        return forms[0]
    key = variable, tuple(forms), *size
    if key not in _fastest:
        measure = seconds or _on_the_device
        with undisturbed():
            _fastest[key] = min(forms, key=lambda form: _took(measure, run, form))
    return _fastest[key]


def _took(measure: Callable[[Callable[[], Any]], float], run: Callable[[Form], Any], form: Form) -> float:
    """How long a form takes, for ever if this GPU cannot run it."""
    try:
        return measure(lambda: run(form))
    except Exception:  # too few registers, too little memory on the chip; the first form was tried out before
        return math.inf


def _on_the_device(call: Callable[[], Any]) -> float:
    from triton.testing import do_bench

    milliseconds = do_bench(call, warmup=3, rep=15)
    assert isinstance(milliseconds, float)
    return milliseconds


@functools.lru_cache
def _named(variable: str, given: str, kind: type[Form]) -> Form:
    """Read a form from the environment."""
    kinds = {field.name: type(field.default) for field in fields(kind)}  # pyright: ignore[reportArgumentType]
    values = {}
    for part in given.split(","):
        name, _, value = part.partition("=")
        try:
            values[name] = bool(int(value)) if kinds[name] is bool else kinds[name](value)
        except (KeyError, ValueError):
            known = ", ".join(f"{name}=…" for name in kinds)
            raise ValueError(f"{variable}={given}: {part!r} names no form of the kernels; expected {known}.") from None
    return kind(**values)
