"""What a camera's exposure and white balance do to the colours of a scene, picture by picture. Pure torch."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from edge_depth_nerf.base.errors import InputError

Exposure = Literal["gain", "embedding", "none"]


class Gains(nn.Module):
    """A factor for each colour of each picture.

    Their geometric mean over the pictures is 1, so that a view from elsewhere is rendered neutrally.
    """

    def __init__(self, pictures: int) -> None:
        super().__init__()
        self.log_gains = nn.Parameter(torch.zeros(pictures, 3))

    @property
    def gains(self) -> Float[Tensor, "pictures 3"]:
        """Give the factors."""
        return (self.log_gains - self.log_gains.mean(dim=0)).exp()

    def forward(self, colours: Float[Tensor, "rays 3"], picture: Int[Tensor, "rays"]) -> Float[Tensor, "rays 3"]:
        """Give colours the exposure of their pictures."""
        # faster than an index, forward and backward
        return colours * self.gains.index_select(0, picture)

    def beyond(
        self, image: Float[Tensor, "h w 3"], rendered: Float[Tensor, "h w 3"], picture: int
    ) -> Float[Tensor, "h w 3"]:
        """Subtract a neutral rendering from a picture, in neutral colours."""
        return image / self.gains[picture] - rendered


def exposure_model(exposure: str, pictures: int) -> Gains | None:
    """Give what models the exposure of pictures; None where nerfacto's embedding does, or nothing.

    Raises:
        InputError: config.yml of an earlier version has a model that there is no more.
    """
    if exposure not in (known := get_args(Exposure)):
        raise InputError(
            f"--pipeline.model.exposure {exposure}: there is no such model; expected one of {', '.join(known)}. Train "
            "again, or load this training with the version that made it."
        )
    return Gains(pictures) if exposure == "gain" else None
