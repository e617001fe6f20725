"""What a camera does to the colours of a scene, picture by picture: exposure, white balance, vignetting.

Each training picture has a map of colours of its own. Whatever the kind, the maps' mean over the pictures is held at
the identity, so that a view from elsewhere is rendered without any map, and neutrally. Pure torch.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

GRID_SHAPE = (4, 8, 8)
"""Cells of a bilateral grid: brightness, rows, columns."""
_LUMA = (0.299, 0.587, 0.114)
_CHANNELS = 12
_SLOWLY = 0.1
"""Maps learn at so much of the fields' rate: as fast as these, they follow each batch's noise."""

ExposureKind = Literal["gain", "affine", "grid"]


class Gains(nn.Module):
    """A factor for each colour of each picture; their geometric mean is 1."""

    def __init__(self, pictures: int) -> None:
        super().__init__()
        self.log_gains = nn.Parameter(torch.zeros(pictures, 3))

    @property
    def gains(self) -> Float[Tensor, "pictures 3"]:
        """The factors."""
        return (self.log_gains - self.log_gains.mean(dim=0)).exp()

    def forward(
        self, colours: Float[Tensor, "rays 3"], picture: Int[Tensor, "rays"], place: Float[Tensor, "rays 2"] | None
    ) -> Float[Tensor, "rays 3"]:
        """Colours as the pictures have them."""
        # faster than an index, forward and backward
        return colours * self.gains.index_select(0, picture)

    def beyond(
        self, image: Float[Tensor, "h w 3"], rendered: Float[Tensor, "h w 3"], picture: int
    ) -> Float[Tensor, "h w 3"]:
        """What a picture shows beyond its neutral rendering, in neutral colours."""
        return image / self.gains[picture] - rendered

    def unevenness(self) -> Float[Tensor, ""]:
        """How far the maps are from the identity, or from smooth: nothing that needs a penalty."""
        return self.log_gains.new_zeros(())


class AffineMaps(nn.Module):
    """An affine map of colours for each picture; their mean is the identity."""

    def __init__(self, pictures: int) -> None:
        super().__init__()
        self.slow_offsets = nn.Parameter(torch.zeros(pictures, 3, 4))

    @property
    def offsets(self) -> Float[Tensor, "pictures 3 4"]:
        """The maps, less the identity, less their mean."""
        return _SLOWLY * (self.slow_offsets - self.slow_offsets.mean(dim=0))

    def forward(
        self, colours: Float[Tensor, "rays 3"], picture: Int[Tensor, "rays"], place: Float[Tensor, "rays 2"] | None
    ) -> Float[Tensor, "rays 3"]:
        """Colours as the pictures have them."""
        return _mapped(colours, self.offsets[picture])

    def beyond(
        self, image: Float[Tensor, "h w 3"], rendered: Float[Tensor, "h w 3"], picture: int
    ) -> Float[Tensor, "h w 3"]:
        """What a picture shows beyond its neutral rendering, in neutral colours."""
        return _unmapped(image, rendered, self.offsets[picture].expand(*image.shape[:2], 3, 4))

    def unevenness(self) -> Float[Tensor, ""]:
        """Mean square of what the maps do beyond the identity."""
        return self.offsets.square().mean()


class BilateralGrids(nn.Module):
    """Affine maps that vary over each picture and with brightness (Wang et al., SIGGRAPH 2024); their mean is identity.

    A grid of `GRID_SHAPE` for each picture; between its corners maps are interpolated linearly.
    """

    luma: Float[Tensor, "3"]

    def __init__(self, pictures: int) -> None:
        super().__init__()
        self.slow_offsets = nn.Parameter(torch.zeros(pictures, _CHANNELS, *GRID_SHAPE))
        # made at each step it would be copied to a GPU, which waits for that
        self.register_buffer("luma", torch.tensor(_LUMA), persistent=False)

    @property
    def offsets(self) -> Float[Tensor, "pictures channels depth rows columns"]:
        """The maps at the corners of the grids, less the identity, less their mean."""
        return _SLOWLY * (self.slow_offsets - self.slow_offsets.mean(dim=0))

    def forward(
        self, colours: Float[Tensor, "rays 3"], picture: Int[Tensor, "rays"], place: Float[Tensor, "rays 2"] | None
    ) -> Float[Tensor, "rays 3"]:
        """Colours as the pictures have them; `place`: column and row of each pixel, 0 to 1 over its picture."""
        assert place is not None
        return _mapped(colours, self._maps(colours, picture, place))

    def beyond(
        self, image: Float[Tensor, "h w 3"], rendered: Float[Tensor, "h w 3"], picture: int
    ) -> Float[Tensor, "h w 3"]:
        """What a picture shows beyond its neutral rendering, in neutral colours; by the maps of the rendering."""
        height, width = image.shape[:2]
        at = [(torch.arange(size, device=image.device) + 0.5) / size for size in (height, width)]
        row, column = torch.meshgrid(*at, indexing="ij")
        place = torch.stack([column, row], dim=-1).view(-1, 2)
        pictures = torch.full((height * width,), picture, device=image.device)
        maps = self._maps(rendered.reshape(-1, 3), pictures, place)
        return _unmapped(image, rendered, maps.view(height, width, 3, 4))

    def _maps(
        self, colours: Float[Tensor, "rays 3"], picture: Int[Tensor, "rays"], place: Float[Tensor, "rays 2"]
    ) -> Float[Tensor, "rays 3 4"]:
        """The maps of pixels, less the identity."""
        depth = GRID_SHAPE[0]
        offsets = self.offsets
        # all pictures' grids one behind the other: one call for rays of many pictures, no cell between two of them
        volume = offsets.movedim(1, 0).flatten(1, 2)[None]
        brightness = (colours * self.luma).sum(dim=-1).clamp(0, 1)
        layers = len(offsets) * depth
        behind = (picture * depth + brightness * (depth - 1)) / max(1, layers - 1)
        at = 2 * torch.cat([place, behind[:, None]], dim=-1) - 1
        return F.grid_sample(volume, at.view(1, 1, 1, -1, 3), align_corners=True)[0, :, 0, 0].t().view(-1, 3, 4)

    def unevenness(self) -> Float[Tensor, ""]:
        """Total variation, squared, and a little of the mean square."""
        grids = self.offsets
        steps = [grids.diff(dim=axis).square().mean() for axis in (2, 3, 4)]
        return torch.stack(steps).sum() + 0.1 * grids.square().mean()


def _mapped(colours: Float[Tensor, "*pixels 3"], offsets: Float[Tensor, "*pixels 3 4"]) -> Float[Tensor, "*pixels 3"]:
    """Apply affine maps, given less the identity."""
    return colours + (offsets[..., :3] * colours[..., None, :]).sum(dim=-1) + offsets[..., 3]


def _unmapped(
    image: Float[Tensor, "h w 3"], rendered: Float[Tensor, "h w 3"], offsets: Float[Tensor, "h w 3 4"]
) -> Float[Tensor, "h w 3"]:
    """What a picture shows beyond a rendering that affine maps would have made like it, before these maps."""
    linear = torch.eye(3, device=offsets.device, dtype=offsets.dtype) + offsets[..., :3]
    return torch.linalg.solve(linear, image - _mapped(rendered, offsets))


KINDS: dict[str, type[Gains | AffineMaps | BilateralGrids]] = {
    "gain": Gains,
    "affine": AffineMaps,
    "grid": BilateralGrids,
}
"""The maps by the name of the option."""
