"""How pixels are made of samples: networks and rendering in one pass where that serves, else nerfacto's renderers.

Host-facing. Where the sky is known, its colour is the field's at infinity, behind what the samples stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components import renderers
from nerfstudio.model_components.losses import scale_gradients_by_distance_squared
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer, RGBRenderer
from torch import Tensor

from edge_depth_nerf.kernels.rendering import Background, Rendered
from edge_depth_nerf.method.uncertainty import termination_std
from edge_depth_nerf.plugin.fused.fields import FusedNerfactoField
from edge_depth_nerf.plugin.fused.ray_samplers import in_a_row, rays_of, samples_along

INFINITELY_FAR = 1e4
"""Scene units: so far that the place in the contracted scene is the direction alone."""
BACKGROUNDS = {"last_sample": Background.LAST_SAMPLE, "black": Background.BLACK, "random": Background.BLACK}
"""What the model's backgrounds add to a rendered pixel; a random one is added where losses are computed."""
LEAST_HIT = 0.05
"""Rays that stop less than this share of their light count as hitting nothing."""


class NoBackground(RGBRenderer):
    """nerfstudio's colours of what the samples stop, with nothing behind."""

    def __init__(self) -> None:
        super().__init__(background_color="black")
        self.shows_last_sample = False
        """Rays that end before the far plane have the colour of their last sample behind them, as in nerfacto."""

    def forward(self, rgb: Tensor, weights: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """Give the colours, [rays, 3]."""
        if self.training and not args and not kwargs and not self.shows_last_sample:
            # nerfstudio would also sum up the weights, and copy a black pixel for each ray to a GPU
            return (weights * rgb).sum(dim=-2)
        # random: its word for a background that is added later
        background = "last_sample" if self.shows_last_sample else "random"
        return super().forward(rgb, weights, *args, **{**kwargs, "background_color": background})  # pyrefly: ignore


class MedianDepth(DepthRenderer):
    """nerfstudio's median depth, of that share of a ray that hits something; in training nothing, as nobody reads it.

    At an outline a pixel is half sky, half house: the house's distance is its distance.
    """

    def forward(self, weights: Tensor, ray_samples: RaySamples, *args: Any, **kwargs: Any) -> Any:
        """Give the depth, [rays, 1]; in training None."""
        if self.training:
            return None
        stopped = torch.cumsum(weights[..., 0], dim=-1)
        hit = stopped[..., -1:]
        half = (hit / 2).masked_fill(hit <= LEAST_HIT, 0.5)
        sample = torch.searchsorted(stopped, half).clamp(max=stopped.shape[-1] - 1)
        at = ray_samples.frustums
        starts, ends = (edges[..., 0].gather(-1, sample) for edges in (at.starts, at.ends))
        return torch.lerp(starts, ends, 0.5)


class DepthMoments(DepthRenderer):
    """nerfstudio's expected depth and, beside it, the standard deviation; nothing in training."""

    def __init__(self) -> None:
        super().__init__(method="expected")

    def forward(self, weights: Tensor, ray_samples: RaySamples, *args: Any, **kwargs: Any) -> Any:
        """Give [rays, 2]; in training None."""
        if self.training:
            return None
        expected = super().forward(weights, ray_samples, *args, **kwargs)
        starts, ends = ray_samples.frustums.starts[..., 0], ray_samples.frustums.ends[..., 0]
        return torch.cat([expected, termination_std(weights[..., 0], starts, ends)[..., None]], dim=-1)


def points_on(bundles: Sequence[RayBundle], distances: Sequence[Tensor], fused: bool) -> RaySamples:
    """Make a sample without length on each ray, one set of rays after the other, at distances in scene units.

    `fused` says whether the samples are of our form.
    """
    origins, directions, areas, pictures = (
        in_a_row([getattr(bundle, name) for bundle in bundles])
        for name in ("origins", "directions", "pixel_area", "camera_indices")
    )
    at = torch.cat([*distances])[:, None, None]
    along = samples_along if fused else RayBundle.get_ray_samples
    return along(rays_of(origins, directions, areas, pictures), at, at)


def background_of(name: Any, has_sky: bool, sky: bool) -> Background | None:
    """Give what is behind rays: the sky if there is one, else what the model's option says; None for other colours."""
    if has_sky:
        return Background.POINT if sky else Background.LAST_SAMPLE
    return BACKGROUNDS.get(str(name))


def with_sky(rendered: Rendered) -> Rendered:
    """Give pixels with the first of the single points, one for each ray, behind what the samples stop."""
    count = len(rendered.rgb)
    sky, others = rendered.point_rgb.split([count, len(rendered.point_rgb) - count])
    return rendered._replace(rgb=torch.addcmul(rendered.rgb, 1 - rendered.accumulation, sky), point_rgb=others)


def render(
    field: Any,
    samples: RaySamples,
    points: RaySamples | None,
    background: Background | None,
    renderer_rgb: RGBRenderer,
    renderer_accumulation: AccumulationRenderer,
    scales_gradients: bool,
) -> Rendered:
    """Render pixels of samples, and the colours of single points.

    Args:
        field: nerfacto's or ours.
        samples: of the rays, [rays, samples].
        points: single points, [points, 1]; with `Background.POINT` those behind the rays come first.
        background: what is behind the rays; None for colours that nerfstudio's renderer knows.
        renderer_rgb: for the colours, where one pass does not serve.
        renderer_accumulation: likewise for the accumulated weights.
        scales_gradients: nerfacto's option, which lowers gradients near the camera.

    Returns:
        Pixels with their background; at evaluation in 0..1.
    """
    plain = not scales_gradients and renderers.BACKGROUND_COLOR_OVERRIDE is None
    if plain and background is not None and isinstance(field, FusedNerfactoField) and field.may_render(samples, points):
        rendered = field.render(samples, points, background)
        # nerfstudio's, at evaluation
        rgb = rendered.rgb if field.training else torch.nan_to_num(rendered.rgb).clamp(0, 1)
        return rendered._replace(rgb=rgb)
    parts = [samples, *([] if points is None else [points])]
    together = isinstance(field, FusedNerfactoField)
    found, *others = field.forward_together(parts) if together else [field.forward(each) for each in parts]
    if scales_gradients:
        found = scale_gradients_by_distance_squared(found, samples)
    weights = samples.get_weights(found[FieldHeadNames.DENSITY])
    rendered = Rendered(
        rgb=renderer_rgb(rgb=found[FieldHeadNames.RGB], weights=weights),
        accumulation=renderer_accumulation(weights=weights),
        weights=weights.squeeze(-1),
        point_rgb=others[0][FieldHeadNames.RGB].squeeze(1) if others else weights.new_empty(0, 3),
    )
    return with_sky(rendered) if background == Background.POINT else rendered


def depths(
    weights_list: Sequence[Tensor],
    samples_list: Sequence[RaySamples],
    renderer_depth: DepthRenderer,
    renderer_expected_depth: DepthRenderer,
) -> dict[str, Any]:
    """Render nerfacto's depths, of the final samples, which come last, and of those of the proposal networks."""
    with torch.no_grad():
        *before, depth = (
            renderer_depth(weights=weights, ray_samples=samples)
            for weights, samples in zip(weights_list, samples_list, strict=True)
        )
    expected = renderer_expected_depth(weights=weights_list[-1], ray_samples=samples_list[-1])
    named = {f"prop_depth_{number}": each for number, each in enumerate(before)}
    return {"depth": depth, "expected_depth": expected, **named}
