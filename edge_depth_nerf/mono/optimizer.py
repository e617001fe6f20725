"""Muon for a network's hidden convolutions, AdamW for the rest.

Muon (Jordan et al., 2024, "Muon: an optimizer for hidden layers in neural networks") replaces the averaged
gradient of a matrix by an orthogonal matrix near it: the weights then change by the same amount in all directions. A
small depth network needs half as many steps with it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

_ITERATION = (3.4445, -4.7750, 2.0315)
"""The authors' a, b, c: X becomes aX + bAX + cA²X, where A = XXᵀ. Singular values come to lie between 0.7 and 1.2."""
_ITERATIONS = 5
_MOMENTUM = 0.95

Mapped = Callable[[Callable[[Tensor], Tensor], Iterable[Tensor]], Iterable[Tensor]]
"""What `map` does, perhaps with several threads."""


class HiddenMuon:
    """Muon for the weights of all convolutions but the last one, AdamW for biases, norms and the last one."""

    def __init__(
        self,
        network: nn.Module,
        last: nn.Module,
        *,
        learning_rate: float,
        hidden_learning_rate: float | None,
        weight_decay: float,
    ) -> None:
        """Take a network's parameters, with its last convolution, and the highest rates of AdamW and of Muon.

        Without a hidden rate AdamW has all.
        """
        muon = hidden_learning_rate is not None
        hidden = [m.weight for m in network.modules() if muon and isinstance(m, nn.Conv2d) and m is not last]
        apart = {id(weight) for weight in hidden}
        rest = [parameter for parameter in network.parameters() if id(parameter) not in apart]
        self.parameters = [*hidden, *rest]
        self._hidden = hidden
        self._momenta = [torch.zeros_like(weight) for weight in hidden]
        self._adam = torch.optim.AdamW(rest, lr=learning_rate, weight_decay=weight_decay)
        self._rate, self._hidden_rate, self._decay = learning_rate, hidden_learning_rate or 0.0, weight_decay

    @torch.no_grad()
    def step(self, share: float, mapped: Mapped = map) -> None:
        """Change the parameters by their gradients, at a share of the highest rates; `mapped` may have threads."""
        for group in self._adam.param_groups:
            group["lr"] = share * self._rate
        self._adam.step()
        gradients = []
        for weight, momentum in zip(self._hidden, self._momenta, strict=True):
            assert weight.grad is not None
            momentum.lerp_(weight.grad, 1 - _MOMENTUM)
            gradients.append(weight.grad.lerp(momentum, _MOMENTUM).flatten(1))
        rate, decay = share * self._hidden_rate, share * self._rate * self._decay
        for weight, change in zip(self._hidden, mapped(orthogonalised, gradients), strict=True):
            # a change of all rows by as much, whatever the matrix's form
            size = max(1.0, change.shape[0] / change.shape[1]) ** 0.5
            weight.mul_(1 - decay).add_(change.reshape(weight.shape), alpha=-rate * size)

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """What `load` needs to continue."""
        for number, momentum in enumerate(self._momenta):
            yield f"momentum/{number}", momentum
        for number, moments in self._adam.state_dict()["state"].items():
            for name, tensor in moments.items():
                yield f"adam/{number}/{name}", tensor

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Continue from what `tensors` gave."""
        moments: dict[int, dict[str, Any]] = {}
        for name, tensor in tensors.items():
            kind, _, rest = name.partition("/")
            if kind == "momentum":
                self._momenta[int(rest)].copy_(tensor)
                continue
            number, _, moment = rest.partition("/")
            moments.setdefault(int(number), {})[moment] = tensor
        self._adam.load_state_dict({**self._adam.state_dict(), "state": moments})


def orthogonalised(matrix: Float[Tensor, "rows columns"]) -> Float[Tensor, "rows columns"]:
    """Bring a matrix's singular values near 1: U·S·Vᵀ becomes about U·Vᵀ, by a Newton-Schulz iteration.

    The iteration is done on the small side's square matrix A = XXᵀ alone. Each step multiplies X by a polynomial Q of
    A, so A by Q on both sides. These are 2.5 times fewer operations for convolutions, which have nine columns a row.
    """
    tall = matrix.shape[0] > matrix.shape[1]
    wide = (matrix.T if tall else matrix) / (matrix.norm() + 1e-7)
    a, b, c = _ITERATION
    square, product = wide @ wide.T, None
    for step in range(_ITERATIONS):
        polynomial = torch.addmm(square, square, square, beta=b, alpha=c)
        polynomial.diagonal().add_(a)
        product = polynomial if product is None else polynomial @ product
        if step + 1 < _ITERATIONS:
            square = polynomial @ square @ polynomial
    assert product is not None
    changed = product @ wide
    return changed.T if tall else changed
