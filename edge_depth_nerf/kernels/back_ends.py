"""Which kernels serve some tensors: Numba's on the CPU, Triton's on a GPU if they work there.

Triton may be missing, find no C compiler, or not know the GPU. A module of kernels says how to find out: its function
`try_out` calls each of them once on a few numbers.
"""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType

import torch
from torch import Tensor

MODULES: dict[str, Callable[[], ModuleType]] = {
    # imported when they are asked for, because Triton takes half a second to load
    "contraction_triton": lambda: import_module("edge_depth_nerf.kernels.contraction_triton"),
    "edge_loss_triton": lambda: import_module("edge_depth_nerf.kernels.edge_loss_triton"),
    "hash_grid_triton": lambda: import_module("edge_depth_nerf.kernels.hash_grid_triton"),
    "network_triton": lambda: import_module("edge_depth_nerf.kernels.network_triton"),
    "pointwise_triton": lambda: import_module("edge_depth_nerf.kernels.pointwise_triton"),
    "ray_triton": lambda: import_module("edge_depth_nerf.kernels.ray_triton"),
}
"""The modules of kernels by their names."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Enable gradients and stop tracing, to try out and measure kernels.

    The first caller may be a rendering. It has no gradients, which `try_out` needs. In the viewer's thread nerfstudio
    also traces each line of Python, and ends a picture by an error there. It would look like an error of the kernel.
    """
    trace = sys.gettrace()
    sys.settrace(None)
    try:
        with torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        sys.settrace(trace)


@functools.lru_cache
def working(module: str, device: torch.device, what: str) -> ModuleType | None:
    """Give a module of `edge_depth_nerf.kernels` whose kernels work on a device, None where they do not.

    The first call for a CUDA device runs the kernels and warns where one fails.

    Args:
        module: its name; it has a function `try_out(device)`.
        device: of the tensors; without a GPU there is nothing to try.
        what: what the kernels compute, for the warning.

    """
    if device.type != "cuda":
        return None
    failure = None
    with undisturbed():
        try:
            kernels = MODULES[module]()
            kernels.try_out(device)
        except Exception as error:  # whatever keeps Triton from working here
            failure = error
    if failure is None:
        return kernels
    warnings.warn(
        f"The fused {what} does not work on {device} ({type(failure).__name__}: {failure}); "
        "nerfstudio's torch form takes its place, with the same results but slower.",
        stacklevel=2,
    )
    return None


def _on_the_cpu(tensors: Sequence[Tensor]) -> bool:
    """Whether these are float32 on the CPU."""
    return all(each.device.type == "cpu" and each.dtype == torch.float32 for each in tensors)


def along_rays(*tensors: Tensor) -> ModuleType | None:
    """Give the kernels along rays for matrices that have a row a ray; None where none serve them.

    On the CPU they are `ray_numba`. On CUDA they are `ray_triton`, for rays whose samples stay on the chip. Both serve
    float32.
    """
    if _on_the_cpu(tensors):
        # imported here, because Numba takes half a second to load
        from edge_depth_nerf.kernels import ray_numba

        return ray_numba
    if any(each.device.type != "cuda" or each.dtype != torch.float32 for each in tensors):
        return None
    kernels = working("ray_triton", tensors[0].device, "form of samples along rays")
    return kernels if kernels is not None and kernels.fits(*(each.shape[1] for each in tensors)) else None


def by_number(*tensors: Tensor) -> ModuleType | None:
    """Give the kernels of what is computed number by number, Numba's or Triton's; None where none serve it.

    They serve float32 where nobody asks for a gradient to these tensors.
    """
    if torch.is_grad_enabled() and any(each.requires_grad for each in tensors):
        return None
    if _on_the_cpu(tensors):
        from edge_depth_nerf.kernels import pointwise_numba

        return pointwise_numba
    if any(each.device.type != "cuda" or each.dtype != torch.float32 for each in tensors):
        return None
    return working("pointwise_triton", tensors[0].device, "arithmetic of samples")


def of_edge_loss(device: torch.device) -> ModuleType | None:
    """Give the kernels of the edge loss, Numba's or Triton's; None where none serve a device."""
    if device.type == "cpu":
        from edge_depth_nerf.kernels import edge_loss_numba

        return edge_loss_numba
    return working("edge_loss_triton", device, "edge loss")


def made_by_autocast(device: torch.device) -> torch.dtype:
    """Give the type that autocast makes of what enters a product on a GPU; float32 without it, and on the CPU.

    What is kept in that type to begin with is neither copied nor cast, and the products are the same.
    """
    if device.type == "cuda" and torch.is_autocast_enabled("cuda"):
        return torch.get_autocast_dtype("cuda")
    return torch.float32


NETWORK = "EDGE_DEPTH_NERF_NETWORK"
"""Environment variable that turns on the kernels of networks; no GPU has compared them yet. `triton`: networks.
`triton+encoding`: also networks together with the hash grid in front of them, where nobody follows gradients."""


def of_network(x: Tensor, weights: Sequence[Tensor]) -> ModuleType | None:
    """Give the kernels of networks, `network_triton`; None where not requested, or for an unsupported network.

    They serve what autocast would compute in float16 on CUDA.
    """
    if os.environ.get(NETWORK) not in ("triton", "triton+encoding") or x.device.type != "cuda":
        return None
    if not torch.is_autocast_enabled("cuda") or torch.get_autocast_dtype("cuda") != torch.float16:
        return None
    kernels = working("network_triton", x.device, "network")
    return kernels if kernels is not None and kernels.fits(weights) else None


def of_encoded_network(positions: Tensor, weights: Sequence[Tensor]) -> ModuleType | None:
    """Give the kernels of networks that encode positions first; None as for `of_network`, or with gradients."""
    if os.environ.get(NETWORK) != "triton+encoding" or torch.is_grad_enabled() or positions.dtype != torch.float32:
        return None
    return of_network(positions, weights)
