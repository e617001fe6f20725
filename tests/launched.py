"""Launches of Triton kernels on another device than that of their tensors."""

from typing import Any

import interpreted
import torch
from torch.utils._pytree import tree_map_only

from edge_depth_nerf.kernels import triton_launch

SLACK = 20.0
"""A GPU's exp, log and division are approximations, which the interpreter's are not."""


def launch_on(device: str) -> None:
    """Let all kernels of modules that are imported from now on run on a device, whatever their tensors are on.

    At each launch the memory of all tensors is copied there and back, so that a view is a view there too.
    """
    if device != "cpu":
        interpreted.slack = SLACK
    launch = triton_launch.launch

    def launched(kernel: Any, grid: tuple[int, ...], *arguments: Any, **constants: Any) -> None:
        memory: dict[int, tuple[torch.UntypedStorage, torch.UntypedStorage]] = {}

        def moved(tensor: torch.Tensor) -> torch.Tensor:
            here = tensor.untyped_storage()
            if here._cdata not in memory:
                memory[here._cdata] = here, torch.UntypedStorage(here.nbytes(), device=device)
                memory[here._cdata][1].copy_(here)
            there, at = memory[here._cdata][1], tensor.storage_offset()
            return torch.empty(0, dtype=tensor.dtype, device=device).set_(there, at, tensor.shape, tensor.stride())

        given = tree_map_only(torch.Tensor, moved, arguments)
        launch(kernel, grid, *given, **constants)
        for here, there in memory.values():
            here.copy_(there)

    triton_launch.launch = launched
