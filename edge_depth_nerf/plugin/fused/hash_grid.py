"""nerfstudio's hash encoding with its arithmetic fused.

Parameters, their names and their initial values stay nerfstudio's, so checkpoints go back and forth.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.field_components.encodings import HashEncoding
from torch import Tensor, nn

from edge_depth_nerf.kernels.back_ends import made_by_autocast
from edge_depth_nerf.kernels.functions import HASH_GRID
from edge_depth_nerf.kernels.table_adam import SUMS_LATER


class FusedHashEncoding(HashEncoding):
    """nerfstudio's `HashEncoding(implementation="torch")`, several times faster.

    Its results are nerfstudio's: on the CPU to the last bit forward, and to float32's noise else. What the fused form
    does not do (double precision, a half-precision table, devices without back end) is left to nerfstudio's.
    """

    def forward(self, in_tensor: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs encoded"]:
        """Encode positions in 0..1 of any leading shape; half precision is encoded in float32, as in nerfstudio."""
        dtypes = (torch.float32, torch.float16, torch.bfloat16)
        compute = None
        if self.tcnn_encoding is None and self.hash_table.dtype == torch.float32 and in_tensor.dtype in dtypes:
            compute = HASH_GRID.on(in_tensor.device)
        if compute is None:
            return super().forward(in_tensor)
        # moved once, not at each call
        self.scalings = self.scalings.to(in_tensor.device, torch.float32)
        dtype = made_by_autocast(in_tensor.device)
        encoded = compute(in_tensor.reshape(-1, 3).float(), self.hash_table, self.scalings, dtype=dtype)
        return encoded.view(*in_tensor.shape[:-1], self.get_out_dim())


def sum_tables_later(module: nn.Module) -> None:
    """Let optimisers sum up the gradients of all hash tables below `module`, if they can.

    Not where, within a step, `torch.autograd.grad` asks for the gradient by positions: backward cannot tell that from
    a step's own.
    """
    for part in module.modules():
        if isinstance(part, FusedHashEncoding):
            setattr(part.hash_table, SUMS_LATER, False)  # until an optimiser says that it can do with it
