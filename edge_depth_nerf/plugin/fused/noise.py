"""Random numbers of a training step, which a recorded step reads where they were drawn before it. Host-facing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from jaxtyping import Float
from torch import Tensor


class Noise:
    """Random numbers that are drawn for a whole step at once, as many as an earlier step asked for."""

    def __init__(self, device: torch.device | str) -> None:
        """Draw nothing yet."""
        self._uniform, self._normal = torch.empty(0, device=device), torch.empty(0, device=device)
        self.asked = [0, 0]
        """So many uniform and normal numbers the last step asked for."""

    def draw(self) -> None:
        """Draw the numbers of the next step, uniform ones in 0..1 and those of a standard normal distribution."""
        if [len(self._uniform), len(self._normal)] != self.asked:
            self._uniform, self._normal = (self._uniform.new_empty(count) for count in self.asked)
        self._uniform.uniform_()
        self._normal.normal_()

    @contextmanager
    def given(self) -> Iterator[None]:
        """Let `uniform` and `normal` give these numbers, from the first one on."""
        self.asked = [0, 0]
        before = _source.set(self)
        try:
            yield
        finally:
            _source.reset(before)

    def take(self, kind: int, count: int, more: Callable[[int], Tensor]) -> Tensor:
        """Give the next uniform (0) or normal (1) numbers; those of a first step are drawn as it asks for them."""
        first = self.asked[kind]
        self.asked[kind] += count
        drawn = (self._uniform, self._normal)[kind]
        return drawn[first : first + count] if first + count <= len(drawn) else more(count)


_source: ContextVar[Noise | None] = ContextVar("_source", default=None)


def uniform(rows: int, columns: int, device: torch.device) -> Float[Tensor, "rows columns"]:
    """Give random numbers in 0..1."""
    noise = _source.get()
    if noise is None:
        return torch.rand(rows, columns, device=device)
    return noise.take(0, rows * columns, lambda count: torch.rand(count, device=device)).view(rows, columns)


def normal(count: int, device: torch.device) -> Float[Tensor, "count"]:
    """Give random numbers of a standard normal distribution."""
    noise = _source.get()
    if noise is None:
        return torch.randn(count, device=device)
    return noise.take(1, count, lambda count: torch.randn(count, device=device))
